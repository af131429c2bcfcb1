"""How far are pictures off Mitsuba 3, over meshes, materials and lights? The table that other pages quote.

    python -m benchmarks.accuracy [--quick] [--only TEXT]... [--bounces N] [--edge N] [--samples N] [--store FOLDER]
        [--pictures FOLDER] [--table FILE] [--output FILE]

Ten meshes, five of them with sharp edges, in seven materials under eight lights. Four meshes stand on a matte ground of
four vertices. Scenes are precomputed by `system="lobe"` with its defaults. Light is direct, or reflected `--bounces`
times. The judge is that of `benchmarks.assets`: Mitsuba with the original light file, and with formulas of materials
that share no code with jaxprt. It takes samples until its noise is below a third of the error, or 16 times `--samples`.

Each case is one line. `error` is relative L2 over the pixels that surfaces fill, without Mitsuba's noise, `noise`.
`even` is that without their brightest hundredth: a few pixels with glints of a sun can make most of `error`.
`bias` is how much brighter the whole is. `contact` is the error of the ground's pixels that are closer to the mesh than
.03 of its diagonal. `cells` is the share of cells of 8 x 8 filled pixels whose mean differs by more than a tenth and by
more than three times its own noise. `seconds` are of a picture in a new light and a new view.

Cases that `--output FILE` has already are not measured again. The last line, and the table that `--table` writes, are
of all cases of that file.
"""

import itertools
import json
import pathlib
import statistics
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import KDTree

import jaxprt as prt
from benchmarks import asset_files, assets, denoised, harness
from benchmarks.asset_files import Map, Surface
from jaxprt import files
from jaxprt.brdf import AshikhminShirley, Lambert, MetallicRoughness
from jaxprt.scene import Camera, Environment, Mesh, Part, Scene, Texture, TexturedMaterial, builtin, load_mesh
from jaxprt.scene.camera import orbit
from jaxprt.scene.mesh import bounds, ground_plane, make_mesh

EDGE, SAMPLES = 256, 16
CELL, BIASED, SIGMAS = 8, 0.1, 3
CONTACT = 0.03  # of the diagonal
# File, azimuth, and whether it stands on a ground. Every second one has sharp edges.
MESHES = {
    "spot": ("meshes/spot.obj", 2.6, True),
    "feature part": ("meshes_awkward/featuretype.STL", 0.5, True),
    "rocker arm": ("meshes/rocker_arm.ply", 0.5, True),
    "boolean": ("foreign/boolean.glb", 0.5, True),
    "max planck": ("meshes/max_planck_decimated.ply", 0.5, False),
    "pins": ("foreign/pins.glb", 0.5, False),
    "suzanne": ("meshes/suzanne.obj", 0.5, False),
    "beetle": ("meshes/beetle_open.ply", 0.5, False),
    "bunny": ("meshes/stanford_bunny.ply", 0.35, False),
    "gears": ("meshes_awkward/cycloidal.ply", 0.5, False),
}
LIGHTS = {
    "sunrise": "polyhaven_sunrise_1k.exr",
    "beach": "polyhaven_spiaggia_di_mondello_1k.hdr",
    "courtyard": "polyhaven_courtyard_1k.exr",
    "uffizi": "uffizi_latlong_256x128.hdr",
    "grace": "grace_latlong_pbrt.exr",
    "studio": "polyhaven_studio_1k.exr",
    "overcast": "",
    "interior": "ennis_latlong_256x128.hdr",
}
GOLD, GRAY = (0.8, 0.6, 0.4), 0.5
METALS = (0.15, 0.3, 0.5)  # roughness
MATERIALS = "matte", "plastic", "exponent 20", *(f"metal {roughness}" for roughness in METALS), "textured"


class Subject(NamedTuple):
    """A mesh in a material, as jaxprt and as the judge see it."""

    scene: Scene
    surfaces: list[Surface]
    camera: Camera


def main(options: Sequence[str] | None = None) -> None:
    parser = harness.parser(str(__doc__).splitlines()[0])
    parser.add_argument("--only", metavar="TEXT", action="append", help="cases whose names have TEXT, as 'spot, matte'")
    parser.add_argument("--bounces", type=int, metavar="N", default=0, help="reflections of light; none if not given")
    parser.add_argument("--edge", type=int, metavar="N", default=EDGE, help=f"pixels; {EDGE} if not given")
    parser.add_argument("--samples", type=int, metavar="N", default=SAMPLES, help="of Mitsuba's pictures, at least")
    parser.add_argument("--store", type=pathlib.Path, metavar="FOLDER", help="keep Mitsuba's pictures")
    parser.add_argument("--pictures", type=pathlib.Path, metavar="FOLDER", help="write ours, Mitsuba's, 4 x difference")
    parser.add_argument("--table", type=pathlib.Path, metavar="FILE", help="write the tables in Markdown")
    arguments = parser.parse_args(options)
    if arguments.quick:
        arguments.edge, arguments.samples = 24, 16
    known = []
    if arguments.output is not None and arguments.output.is_file():
        text = arguments.output.read_text(encoding="utf-8").splitlines()
        known = [line for line in map(json.loads, text) if line["case"] != SUMMARY]
    done = {line["case"] for line in known}
    meshes = ["sphere"] if arguments.quick else list(MESHES)
    with tempfile.TemporaryDirectory() as temporary:
        lights = light_files(pathlib.Path(temporary), arguments.quick)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of negative values
            size = 8 if arguments.quick else 64
            environments = {light: prt.load_environment(path, size=size) for light, path in lights.items()}
        for name, material in itertools.product(meshes, MATERIALS[1:2] if arguments.quick else MATERIALS):
            names = {light: ", ".join((name, material, light)) for light in lights}
            wanted = {light: case for light, case in names.items() if case not in done and _asked(case, arguments.only)}
            if wanted:
                subject = subject_of(name, material, arguments.edge)
                shown = {case: (lights[light], environments[light]) for light, case in wanted.items()}
                known += [harness.report(line, arguments.output) for line in measure(subject, shown, arguments)]
    if known:
        harness.report(summary(known), arguments.output)
    if arguments.table is not None:
        arguments.table.write_text(tables(known), encoding="utf-8")


def _asked(case: str, only: Sequence[str] | None) -> bool:
    return only is None or any(text in case for text in only)


def light_files(folder: pathlib.Path, quick: bool) -> dict[str, pathlib.Path]:
    """The files of the lights, by name; the overcast sky is written into a folder."""
    files.write_exr(folder / "overcast.exr", overcast(16 if quick else 128))
    known = {} if quick else {name: harness.data() / "env" / file for name, file in LIGHTS.items() if file}
    return {name: known.get(name, folder / "overcast.exr") for name in (["overcast"] if quick else LIGHTS)}


def overcast(rows: int) -> np.ndarray:
    """The CIE's overcast sky (ISO 15469, type 16) over a ground that reflects a fifth, as a panorama [h w 3]."""
    height = np.sin(np.pi * (0.5 - (np.arange(rows) + 0.5) / rows))
    sky = (1 + 2 * height) / 3
    ground = 0.2 * 7 / 9  # irradiance of the sky over pi
    return np.broadcast_to(np.where(height > 0, sky, ground)[:, None, None], (rows, 2 * rows, 3)).astype(np.float32)


def subject_of(name: str, material: str, edge: int) -> Subject:
    """A mesh of the table in one of its materials."""
    if name == "sphere":
        mesh, azimuth, stands = builtin.sphere(rings=24, sectors=32), 0.5, True
    else:
        file, azimuth, stands = MESHES[name]
        path = harness.data() / file
        mesh = load_mesh(path) if path.suffix != ".glb" else prt.load_scene(path).mesh
    mesh = boxed(mesh) if material == "textured" else mesh
    ours, theirs = materials(material)
    parts, surfaces = [Part(name, mesh, ours)], [surface(mesh, theirs)]
    if stands:
        ground = ground_plane(mesh, vertices=4)
        parts.append(Part("ground", ground, Lambert(GRAY)))
        surfaces.append(surface(ground, asset_files.Material(np.full(3, GRAY), metallic=0.0, specular=0.0)))
    return Subject(Scene(parts), surfaces, orbit(mesh, azimuth=azimuth, elevation=0.3, width=edge, height=edge))


def boxed(mesh: Mesh) -> Mesh:
    """The mesh with texture coordinates along two axes, whichever the faces look at least; vertices are split."""
    position, face = np.asarray(mesh.position), np.asarray(mesh.face)
    corner = position[face]
    out = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    axis = np.argmax(np.abs(out), 1)
    side = np.sign(np.take_along_axis(out, axis[:, None], 1)[:, 0])
    key = np.stack([face, *np.broadcast_arrays(axis[:, None], side[:, None], face)[:2]], -1).reshape(-1, 3)
    split, index = np.unique(key.astype(int), axis=0, return_inverse=True)
    vertex, axis, side = split.T
    rows, scale = np.arange(len(split)), 4 / np.ptp(position, 0).max()
    coordinates = position[vertex] * scale
    texture = np.stack([side * coordinates[rows, (axis + 1) % 3], coordinates[rows, (axis + 2) % 3]], -1)
    normal = np.asarray(mesh.normal)[vertex]
    return make_mesh(position[vertex], index.reshape(-1, 3), normal=normal, texture=texture)


def materials(name: str) -> tuple[Any, asset_files.Material]:
    """A material of the table, for jaxprt and for the judge."""
    color = np.array(GOLD)
    if name == "matte":
        return Lambert(GOLD), asset_files.Material(color, metallic=0.0, specular=0.0)
    if name == "exponent 20":
        brdf = AshikhminShirley(diffuse=0.5, specular=0.25, nu=20, nv=20)
        return brdf, asset_files.Material(brdf=brdf)
    if name == "textured":
        color, normal = images()
        ours = TexturedMaterial(
            metallic=0.0, roughness=0.4, base_color_texture=Texture(color), normal_texture=Texture(normal)
        )
        theirs = {"base_map": Map(color), "normal_map": Map(normal), "metallic": 0.0, "roughness": 0.4}
        return ours, asset_files.Material(**theirs)  # pyright: ignore[reportArgumentType]
    metallic, roughness = (0.0, 0.4) if name == "plastic" else (1.0, float(name.split()[1]))
    ours = MetallicRoughness(GOLD, metallic=metallic, roughness=roughness)
    return ours, asset_files.Material(color, metallic=metallic, roughness=roughness)


def images(edge: int = 128) -> tuple[np.ndarray, np.ndarray]:
    """Colors of large tiles, and the normals of bumps, as images [h w 3] that repeat."""
    row, column = 2 * np.pi * (np.indices((edge, edge)) + 0.5) / edge
    tile = (0.5 + 0.5 * np.tanh(4 * np.sin(2 * column) * np.sin(2 * row)))[..., None]
    color = tile * np.array(GOLD) + (1 - tile) * np.array([0.25, 0.3, 0.45])
    slope = 0.35 * np.stack([np.cos(4 * column) * np.sin(4 * row), -np.sin(4 * column) * np.cos(4 * row)], -1)
    normal = np.concatenate([-slope, np.ones((edge, edge, 1))], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return color.astype(np.float32), ((normal + 1) / 2).astype(np.float32)


def surface(mesh: Mesh, material: asset_files.Material) -> Surface:
    """A mesh as the judge has it: the same triangles, normals and texture coordinates."""
    position, normal = (np.asarray(x, np.float64) for x in (mesh.position, mesh.normal))
    texture = {} if mesh.texture is None else {0: np.asarray(mesh.texture) * [1, -1] + [0, 1]}
    return Surface(position, np.asarray(mesh.face), normal, texture, None, material)


def measure(
    subject: Subject, lights: dict[str, tuple[pathlib.Path, Environment]], arguments: Any
) -> Iterator[dict[str, Any]]:
    """Lines of one mesh in one material, by the lights and their files."""
    size = next(iter(lights.values()))[1].radiance.shape[-2]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of vertices that are many
        relit = prt.precompute(subject.scene, system="lobe", bounces=arguments.bounces, size=size, progress=False)
    request = {"camera": subject.camera, "samples": arguments.samples, "model": "gltf", "bounces": arguments.bounces}
    for case, (path, light) in lights.items():
        names = case.split(", ")
        layers = ("color", "position", "part", "alpha")
        drawn = relit.picture(light, subject.camera, background=None, layers=layers)
        timing = harness.measure(lambda light=light: relit.picture(light, subject.camera), repeats=1)
        picture = np.asarray(drawn["color"])
        file = arguments.store and arguments.store / f"{'_'.join(names).replace(' ', '-')}_{arguments.bounces}.npz"
        total, blocks, sides = traced(subject, path, request, picture, file)
        halves = np.where(sides[1][..., None], 0, total / blocks)
        truth = denoised.Truth(halves, 2 * blocks * arguments.samples)
        if arguments.pictures is not None:
            arguments.pictures.mkdir(parents=True, exist_ok=True)
            row, _ = assets.sheet(picture, (total / blocks).mean(0), truth.inside)
            assets.write(arguments.pictures / f"{'_'.join(names).replace(' ', '-')}_{arguments.bounces}.png", row)
        yield {
            **{"benchmark": "accuracy", "case": case, **timing.line(), "error": truth.error(picture)},
            **{"bytes": prt.memory(relit), "bias": truth.bias(picture), "noise": truth.noise},
            **{
                "even": even(picture, truth, halves),
                "contact": contact(subject, drawn, truth, halves),
                "cells": cells(picture, truth, halves),
            },
            **{"bounces": arguments.bounces, "vertices": relit.vertices, "samples": truth.samples},
        }


def traced(
    subject: Subject, light: pathlib.Path, request: dict[str, Any], picture: np.ndarray, file: pathlib.Path | None
) -> tuple[np.ndarray, int, np.ndarray]:
    """The judge's pictures, as `assets.rendered` has them, which a file keeps."""
    known = None
    if file is not None and file.is_file():
        with np.load(file) as kept:
            known = kept["total"].astype(np.float64), int(kept["blocks"]), kept["sides"]
    total, blocks, sides = assets.rendered(subject.surfaces, light, request, picture, known)
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        np.savez(file, total=total.astype(np.float32), blocks=blocks, sides=sides)
    return total, blocks, sides


def even(picture: np.ndarray, truth: denoised.Truth, halves: np.ndarray) -> float:
    """Relative L2 of the filled pixels without the brightest hundredth in either picture."""
    mine, one, other = (x[truth.inside][:, :3].astype(np.float64) for x in (picture, *halves))
    bright = np.maximum(mine, (one + other) / 2).max(1)
    kept = bright <= np.quantile(bright, 0.99)
    return relative(mine[kept], one[kept], other[kept])


def relative(mine: np.ndarray, one: np.ndarray, other: np.ndarray) -> float:
    """Relative L2 of values from the mean of two with independent noise, without this noise."""
    return float(np.sqrt(max(np.sum((mine - one) * (mine - other)), 0) / np.sum(one * other)))


def contact(subject: Subject, drawn: dict[str, Any], truth: denoised.Truth, halves: np.ndarray) -> float | None:
    """Relative L2 of the ground's pixels beside the mesh; None without a ground, or if none is seen."""
    mesh, picture = subject.scene.parts[0].mesh, np.asarray(drawn["color"])
    low, high = bounds(mesh)
    distance, _ = KDTree(np.asarray(mesh.position)).query(np.asarray(drawn["position"]))
    beside = truth.inside & (np.asarray(drawn["part"]) == 1) & (distance < CONTACT * np.linalg.norm(high - low))
    if not beside.any():
        return None
    mine, one, other = (x[beside][:, :3].astype(np.float64) for x in (picture, *halves))
    return relative(mine, one, other)


def cells(picture: np.ndarray, truth: denoised.Truth, halves: np.ndarray) -> float | None:
    """Share of cells of filled pixels whose mean is off by more than `BIASED`, certainly; None without cells."""

    def means(values: np.ndarray) -> np.ndarray:
        rows, columns = (CELL * (size // CELL) for size in values.shape[:2])
        return values[:rows, :columns].reshape(rows // CELL, CELL, columns // CELL, CELL, -1).mean((1, 3, 4))

    inside = means(truth.inside[..., None]) == 1
    if not inside.any():
        return None
    mine, one, other = (means(x[..., :3].astype(np.float64))[inside] for x in (picture, *halves))
    mean, noise = (one + other) / 2, np.abs(one - other) / 2
    return float(np.mean(np.abs(mine - mean) > np.maximum(BIASED * mean, SIGMAS * noise)))


SUMMARY = "all"


def summary(lines: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The last line."""
    errors = [line["error"] for line in lines]
    worst = max(lines, key=lambda line: line["error"])
    return {
        **{"benchmark": "accuracy", "case": SUMMARY, "compile_seconds": None, "cases": len(lines)},
        **{"error": statistics.median(errors), "worst": worst["error"], "worst_case": worst["case"]},
        "even": statistics.median(line["even"] for line in lines),
        **{"seconds": statistics.median(line["seconds"] for line in lines)},
        **{"bytes": max(line["bytes"] for line in lines)},
    }


def tables(lines: Sequence[dict[str, Any]]) -> str:
    """Medians and largest errors over the meshes, by material and light; then the meshes; then the worst cases."""
    rows = [(line["case"].split(", "), line) for line in lines]
    lights = [light for light in LIGHTS if any(names[2] == light for names, _ in rows)]

    def cell(chosen: Sequence[dict[str, Any]], key: str = "error") -> str:
        values = [line[key] for line in chosen if line[key] is not None]
        return f"{100 * statistics.median(values):.1f}, {100 * max(values):.1f}" if values else "-"

    def select(**names: str) -> list[dict[str, Any]]:
        place = {"mesh": 0, "material": 1, "light": 2}
        return [line for row, line in rows if all(row[place[key]] == value for key, value in names.items())]

    result = [["material", *lights, "all"]]
    for material in (name for name in MATERIALS if select(material=name)):
        each = [cell(select(material=material, light=light)) for light in lights]
        result.append([material, *each, cell(select(material=material))])
    result.append(["all", *(cell(select(light=light)) for light in lights), cell(lines)])
    pixels = (cell(select(light=light), "even") for light in lights)
    result.append(["all, without the brightest", *pixels, cell(lines, "even")])
    other = [["mesh", "error", "without the brightest", "contact shadows", "biased cells", "bias", "seconds"]]
    for mesh in dict.fromkeys(names[0] for names, _ in rows):
        chosen = select(mesh=mesh)
        bias = statistics.median(line["bias"] for line in chosen)
        seconds = statistics.median(line["seconds"] for line in chosen)
        each = [cell(chosen, key) for key in ("error", "even", "contact", "cells")]
        other.append([mesh, *each, f"{100 * bias:+.1f}", f"{seconds:.2f}"])
    worst = [["case", "error", "without the brightest", "noise", "bias"]]
    for line in sorted(lines, key=lambda line: -line["error"])[:10]:
        worst.append([line["case"], *(f"{100 * line[key]:.1f}" for key in ("error", "even", "noise", "bias"))])
    return "\n".join(map(markdown, (result, other, worst)))


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """A table, from its head and its rows."""
    lined = [rows[0], ["---"] * len(rows[0]), *rows[1:]]
    return "".join(f"| {' | '.join(row)} |\n" for row in lined)


if __name__ == "__main__":
    main()
