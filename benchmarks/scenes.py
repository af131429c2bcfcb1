"""What do scenes with textured materials cost per frame, and how wrong are they? Pictures beside Mitsuba 3's.

    python -m benchmarks.scenes [--quick] [--pictures FOLDER] [--store FOLDER] [--output FILE]

Scenes are glTF files of JAXPRT_DATA, one of them also with all of its triangles divided and with those at shadows
refined, and spheres with sharper materials.
`seconds` are of a picture: light, view and materials redone, and drawing. `bytes` are what the system holds.

Mitsuba gets the same surfaces, and the same materials as a plugin, with their parameters interpolated between the
vertices; triangles with textures are divided for it until they are as small as pixels. Direct light alone.
`peer_error` is the noise of one of its pictures, relative L2, from two of unlike seeds; `peer_seconds` is the time of
one. `error` is the relative L2 of ours against both, in whose product their noise has no part. `bias` is the error of
the sums over all pixels, with its sign. The pixels are those that the object fills. Pixels are means over their squares
on both sides.

Lines of `lobe, 2 bounces` are held to Mitsuba's pictures of as many bounces, and so are those of `lobe, no bounces`,
which tell what bounces bring.

Lines of `vertices` are of the exact sum over all texels at the vertices: what interpolating radiance between them
leaves. Without LLVM of version 17 or newer Mitsuba is very slow.
"""

import pathlib
import time
from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from benchmarks import harness, path_tracing
from jaxprt import RelitScene, files, image, memory, precompute, reference, refine
from jaxprt.image import raster, render
from jaxprt.relit import Harmonics, Lobes, Terms
from jaxprt.relit.channels import of_part
from jaxprt.scene import (
    Camera,
    Environment,
    Mesh,
    Part,
    Scene,
    Texture,
    TexturedMaterial,
    builtin,
    load_environment,
    load_scene,
    subdivision,
)
from jaxprt.scene.camera import orbit
from jaxprt.scene.mesh import brush, grid_face, ground_plane, join, make_mesh
from jaxprt.scene.texture import dpdu

EDGE, SAMPLES = 384, 150  # samples that Mitsuba traces in whole squares
POINTS = 3  # along the edge of a pixel
LIGHTS = {
    "grace": "grace_cross.hdr",
    "eucalyptus": "eucalyptus_rnl_cross.hdr",
    "courtyard": "polyhaven_courtyard_1k.exr",
}
AZIMUTH = {"duck": 0.5, "truck": 0.9, "truck, divided": 0.9, "truck, refined": 0.9, "spheres": 0.25}
LONGEST = 0.03  # edge of divided triangles, over the diagonal of the scene
FINEST = 0.004  # edge of triangles whose materials Mitsuba interpolates
REFLECTING = ("duck", "spheres")  # scenes that are relit with bounces too
BOUNCES = 2
RAMP = "ramp"  # the part whose roughness varies, which the separable system does not take


def main(options: Sequence[str] | None = None) -> None:
    parser = harness.parser(str(__doc__).splitlines()[0])
    parser.add_argument("--store", type=pathlib.Path, metavar="FOLDER", help="keep what was precomputed")
    parser.add_argument("--pictures", type=pathlib.Path, metavar="FOLDER", help="write ours, Mitsuba's, 4 x difference")
    parser.add_argument("--only", metavar="SCENE", help=f"one of {', '.join(AZIMUTH)}")
    arguments = parser.parse_args(options)
    for name, scene in scenes(arguments.quick).items():
        if arguments.only in (None, name):
            for line in measure(name, scene, arguments.quick, arguments.store, arguments.pictures):
                harness.report(line, arguments.output)


def scenes(quick: bool) -> dict[str, Scene]:
    """What is relit."""
    if quick:
        return {"spheres": Scene(spheres(sectors=16, ground=64).parts[1:3])}
    folder = harness.data() / "scenes"
    paths = {"duck": folder / "Duck.glb", "truck": folder / "CesiumMilkTruck.glb"}
    found = {name: load_scene(path) for name, path in paths.items() if path.is_file()}
    if "truck" in found:
        found["truck, divided"] = divided(found["truck"], LONGEST)
        found["truck, refined"] = refine(found["truck"], environments=list(lights(quick).values()))
    return found | {"spheres": spheres(sectors=112, ground=6400)}


def lights(quick: bool) -> dict[str, Environment]:
    """What they are lit by."""
    if quick:
        return {"studio": builtin.studio(size=8)}
    paths = {name: harness.data() / "env" / file for name, file in LIGHTS.items()}
    found = {name: load_environment(path) for name, path in paths.items() if path.is_file()}
    return found or {"daylight": builtin.daylight(), "studio": builtin.studio()}


def systems(scene: Scene, quick: bool) -> dict[str, Any]:
    """Systems by name, as `jaxprt.precompute` takes them. The separable one refuses roughness that varies."""
    lobes, harmonics, terms = (
        (Lobes(lobes=3, texels=4), Harmonics(degree=2, laplacian=0.4), Terms(terms=2, keep=16))
        if quick
        else (Lobes(), Harmonics(laplacian=0.4), Terms())
    )
    if all(part.name != RAMP for part in scene.parts):
        return {"lobe": lobes, "harmonic": harmonics, "separable": terms}
    mixed = {part.name: lobes if part.name == RAMP else terms for part in scene.parts}
    every = {"lobe": lobes, "harmonic": harmonics, "separable, ramp by lobe": mixed}
    return dict(list(every.items())[-1:]) if quick else every


def measure(name: str, scene: Scene, quick: bool, store: pathlib.Path | None, pictures: pathlib.Path | None):
    """Lines of one scene."""
    camera = camera_of(name, scene, 16 if quick else EDGE)
    given = lights(quick)
    size = next(iter(given.values())).radiance.shape[-2]
    relit: dict[str, RelitScene] = {}
    for system, recipe in systems(scene, quick).items():
        path = store and store / file_name(name, system)
        relit[system] = precompute(scene, refine=False, system=recipe, size=size, path=path, progress=False)
    for light_name, light in given.items():
        judge = Judge(scene, light, camera, 16 if quick else SAMPLES)
        for system, timing, drawn, held in frames(scene, relit, light, camera, quick):
            yield line((name, light_name, system), timing, judge, drawn, held)
            if pictures is not None:
                write(pictures / f"{file_name(name, light_name, system)}.png", drawn, judge)
    if name in REFLECTING:
        yield from reflected(name, scene, quick, store, pictures)


def reflected(name: str, scene: Scene, quick: bool, store: pathlib.Path | None, pictures: pathlib.Path | None):
    """Lines of one scene that lights itself."""
    camera, given = camera_of(name, scene, 16 if quick else EDGE), lights(quick)
    size, lobes = next(iter(given.values())).radiance.shape[-2], Lobes(lobes=3, texels=4) if quick else Lobes()
    path = store and store / file_name(name, "lobe")
    whole = precompute(scene, refine=False, system=lobes, bounces=BOUNCES, size=size, path=path, progress=False)
    direct = whole.without_bounces()
    for light_name, light in given.items():
        judge = Judge(scene, light, camera, 16 if quick else SAMPLES, bounces=BOUNCES)
        for system, each in {"lobe, 2 bounces": whole, "lobe, no bounces": direct}.items():
            timing = harness.measure(
                lambda each=each, light=light: each.picture(light, camera), repeats=3 if quick else 9
            )
            drawn = np.asarray(each.picture(light, camera))
            yield line((name, light_name, system), timing, judge, drawn, memory(each))
            if pictures is not None:
                write(pictures / f"{file_name(name, light_name, system)}.png", drawn, judge)


def frames(scene: Scene, relit: Mapping[str, RelitScene], light: Environment, camera: Camera, quick: bool):
    """System, time of a picture, the picture, and bytes, of each system and of the exact sum at the vertices."""
    for system, each in relit.items():
        timing = harness.measure(lambda each=each: each.picture(light, camera), repeats=3 if quick else 9)
        yield system, timing, np.asarray(each.picture(light, camera)), memory(each)
    start = time.perf_counter()
    color = exact_radiance(scene, light, camera)
    timing = harness.Timing(time.perf_counter() - start, 0.0, 1)  # with compiling, since it is slow
    sky = image.sky(light, finer(camera))
    drawn = render(scene.mesh, jnp.asarray(color), finer(camera), background=sky)
    yield "vertices", timing, averaged(drawn), color.nbytes


def camera_of(name: str, scene: Scene, edge: int) -> Camera:
    """From where a scene is seen."""
    if name == "spheres":
        return Camera([2.4, 3.4, 10.2], [0, -0.3, 0.2], [0, 1, 0], 0.6, edge, edge)
    return orbit(scene.mesh, azimuth=AZIMUTH[name], elevation=0.3, width=edge, height=edge)


def file_name(*names: str) -> str:
    """Names of a case as that of a file."""
    return "_".join(names).replace(", ", "_").replace(" ", "_")


def line(case: tuple[str, str, str], timing: harness.Timing, judge: "Judge", drawn: np.ndarray, held: int) -> dict:
    """What is reported of one picture."""
    return {
        **{
            "benchmark": "scenes",
            "case": ", ".join(case),
            **dict(zip(("scene", "light", "system"), case, strict=True)),
        },
        **{**timing.line(), "error": judge.error(drawn), "bias": judge.bias(drawn), "bytes": held},
        **{"peer": "mitsuba", "peer_seconds": judge.seconds, "peer_error": judge.noise, "peer_samples": judge.samples},
    }


class Judge:
    """Two pictures by Mitsuba, and what a picture is off from them, where the object fills pixels."""

    def __init__(self, scene: Scene, light: Environment, camera: Camera, samples: int, *, bounces: int = 0):
        parts, depth = traced_parts(scene if samples < SAMPLES else divided(scene, FINEST)), 2 + bounces
        path_tracing.trace(parts, light, camera, depth=depth, samples=1)  # compiles
        self.samples, drawn, seconds = samples, [], []
        for seed in (1, 2):
            start = time.perf_counter()
            drawn.append(path_tracing.trace(parts, light, camera, depth=depth, samples=samples, seed=seed, sky=True))
            seconds.append(time.perf_counter() - start)
        self.seconds = float(np.mean(seconds))
        triangle = np.asarray(raster.rasterize(scene.mesh, finer(camera)).triangle)
        self.inside = np.asarray(averaged((triangle >= 0)[..., None]))[..., 0] > 1 - 1e-6
        self.mean = np.mean(drawn, 0)
        self.one, self.other = (each[self.inside] for each in drawn)
        self.size = float(np.linalg.norm(self.mean[self.inside]))
        self.noise = float(np.linalg.norm(self.one - self.other) / 2**0.5 / self.size)

    def error(self, drawn: np.ndarray) -> float:
        """Relative L2, without the noise."""
        mine = drawn[self.inside]
        square = np.sum((mine - self.one) * (mine - self.other), dtype=np.float64)
        return float(max(square, 0) ** 0.5 / self.size)

    def bias(self, drawn: np.ndarray) -> float:
        """How much brighter the whole is."""
        return float(np.sum(drawn[self.inside], dtype=float) / np.sum(self.mean[self.inside], dtype=float) - 1)


def traced_parts(scene: Scene) -> list[tuple[Mesh, Any]]:
    """Meshes with the frames of their normal maps and anisotropy, and materials of their vertices."""
    return [(shading.mesh, shading.exact) for shading in map(of_part, scene.parts)]


def exact_radiance(scene: Scene, light: Environment, camera: Camera) -> np.ndarray:
    """Radiance of the vertices of what is seen, by summing all texels; zero for others."""
    triangle = np.asarray(raster.rasterize(scene.mesh, finer(camera), samples=4).triangle)
    seen = np.unique(np.asarray(scene.mesh.face)[np.unique(triangle[triangle >= 0])])
    color = np.zeros((len(scene.mesh.position), 3), np.float32)
    first = 0
    for mesh, material in traced_parts(scene):
        vertex = seen[(seen >= first) & (seen < first + len(mesh.position))]
        if len(vertex):
            options = {"eye": camera.eye, "vertex": vertex - first, "occluder": scene.mesh}
            color[vertex] = reference.radiance(mesh, material, light, **options)
        first += len(mesh.position)
    return color


def finer(camera: Camera) -> Camera:
    """A camera with several points in each pixel."""
    width, height = POINTS * camera.width, POINTS * camera.height
    return Camera(camera.eye, camera.target, camera.up, camera.field_of_view, width, height)


def averaged(picture) -> np.ndarray:
    """Means over the points of each pixel."""
    height, width, colors = picture.shape
    return np.asarray(picture).reshape(height // POINTS, POINTS, width // POINTS, POINTS, colors).mean((1, 3))


def write(path: pathlib.Path, drawn: np.ndarray, judge: Judge) -> None:
    """Writes ours, Mitsuba's, and four times the difference, with the exposure that Mitsuba's object asks for."""
    path.parent.mkdir(parents=True, exist_ok=True)
    stops = image.automatic_exposure(jnp.asarray(np.where(judge.inside[..., None], judge.mean, 0)))
    row = np.concatenate([drawn, judge.mean, 4 * np.abs(drawn - judge.mean)], 1)
    files.write_png(path, np.asarray(image.display(image.expose(jnp.asarray(row), stops=stops))))


def spheres(*, sectors: int, ground: int) -> Scene:
    """Three unit spheres on a ground: gold, a checkered dielectric, and brushed steel whose roughness varies.

    Args:
        sectors: Vertices around each sphere.
        ground: Vertices of the ground, about.
    """
    gold = TexturedMaterial(base_color=[1.0, 0.766, 0.336], roughness=0.25)
    check = np.where(np.add.outer(np.arange(8), np.arange(16)) % 2, 0.75, 0.08)[..., None] * [1.0, 0.45, 0.35]
    # Texels that are larger than the mesh's cells, with borders as wide as these.
    check = np.repeat(np.repeat(check, 8, 0), 8, 1).astype(np.float32)
    checkered = TexturedMaterial(metallic=0.0, roughness=0.3, base_color_texture=Texture(check))
    across = np.broadcast_to(np.linspace(0.2, 1.0, 64, dtype=np.float32)[:, None, None], (64, 64, 1))
    ramp = TexturedMaterial(
        base_color=[0.56, 0.57, 0.58], roughness=0.8, roughness_texture=Texture(across, wrap=("repeat", "clamp"))
    )
    parts = [
        Part(name, ball(sectors, np.array([2.15 * (number - 1), 0.0, 0.0])), material)
        for number, (name, material) in enumerate({"gold": gold, "checker": checkered, RAMP: ramp}.items())
    ]
    plane = ground_plane(join([part.mesh for part in parts]), vertices=ground, extent=1.7)
    return Scene(
        [*parts, Part("ground", plane, TexturedMaterial(base_color=[0.4, 0.42, 0.4], metallic=0.0, roughness=0.7))]
    )


def ball(sectors: int, center: np.ndarray) -> Mesh:
    """A unit sphere with texture coordinates, a seam at the back, and tangents along the parallels."""
    rings = sectors // 2
    u, v = np.meshgrid(np.linspace(0, 1, sectors + 1), np.linspace(0.01, 0.99, rings + 1), indexing="xy")
    longitude, latitude = 2 * np.pi * u - np.pi, np.pi * (v - 0.5)
    across = np.cos(latitude)
    normal = np.stack([across * np.sin(longitude), np.sin(latitude), across * np.cos(longitude)], -1).reshape(-1, 3)
    face = grid_face(rows=rings + 1, columns=sectors + 1)
    texture = np.stack([u, v], -1).reshape(-1, 2)
    mesh = make_mesh(normal + center, face, normal=normal, texture=texture, name="ball")
    return brush(mesh, dpdu(mesh))


def divided(scene: Scene, longest: float) -> Scene:
    """The same surfaces in triangles whose edges are at most so long, over the diagonal of the scene."""
    low, high = np.asarray(scene.mesh.position).min(0), np.asarray(scene.mesh.position).max(0)
    return subdivision.divide(scene, edge=longest * float(np.linalg.norm(high - low)))


if __name__ == "__main__":
    main()
