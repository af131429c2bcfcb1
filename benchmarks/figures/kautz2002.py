"""Kautz, Sloan and Snyder 2002: Figures 1, 2, 3, 7 and 8, and Table 1.

All pictures have the paper's 25 coefficients, and are shaded at pixels. Errors are relative L2 of the radiance of
random points that face the eye, against the integral over all texels of the light.
"""

from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import jaxprt as prt
from benchmarks import harness, relight_harmonic
from benchmarks.figures import drawing
from benchmarks.figures.run import LIGHTS, Clock, Run
from benchmarks.published.harmonics import unshadowed_radiance
from jaxprt import harmonic, image, reference, visibility
from jaxprt.brdf import AshikhminShirley, Phong, PoulinFournier, load_scattered
from jaxprt.scene import Camera, Environment, Mesh, camera
from jaxprt.scene.mesh import brush, rotate
from jaxprt.scene.points import on_triangles
from jaxprt.sphere import directions, rotation
from jaxprt.systems.harmonic import HarmonicBrdf, HarmonicSystem

DEGREE = 4
BRUSHED = AshikhminShirley(diffuse=0.1, specular=0.5, nu=100, nv=5)
UPWARDS, SIDEWAYS = np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])  # brushing directions
POINTS = 300  # at which errors are measured


def view_of(run: Run, mesh: Mesh, azimuth: float, edge: int = 384) -> Camera:
    """A little from above."""
    edge = 16 if run.quick else edge
    return camera.orbit(mesh, azimuth=azimuth, elevation=0.2, width=edge, height=edge)


def tabulated(run: Run, brdf: Callable) -> HarmonicBrdf:
    """The table of a BRDF, with maps as fine as the paper's where it is anisotropic."""
    return harmonic.tabulate(brdf, degree=DEGREE, resolution=16 if run.quick else 128)


def unshadowed(
    run: Run, mesh: Mesh, brdf: Callable, light: Environment, view: Camera, table: HarmonicBrdf | None = None
) -> tuple[np.ndarray, dict[str, float]]:
    """A picture without shadows, and what is measured of it."""
    table = tabulated(run, brdf) if table is None else table
    shaded = drawing.shaded(mesh, view)
    coefficient = harmonic.project(light, degree=DEGREE)
    color = unshadowed_radiance(shaded.point, table, coefficient, eye=view.eye)
    number = drawing.some(shaded.point, view.eye, 20 if run.quick else POINTS)
    exact = drawing.unshadowed(shaded.point, brdf, light, view.eye, number)
    return shaded.picture(color), measured(color[number], exact)


def measured(color: Any, exact: np.ndarray) -> dict[str, float]:
    """Relative error, and the share of points with a channel below zero."""
    color = np.asarray(color)
    return {
        "error": float(np.linalg.norm(color - exact) / np.linalg.norm(exact)),
        "negative": float(np.mean(np.any(color < 0, -1))),
    }


def row(pictures: list[np.ndarray]) -> list[np.ndarray]:
    """Pictures over white, at the exposure of all of them together."""
    every = np.concatenate([each[..., :3] for each in pictures])
    stops = image.automatic_exposure(jnp.asarray(every))
    return [drawing.on_white(each, stops=stops) for each in pictures]


def figure_2(run: Run) -> Iterator[dict[str, Any]]:
    """Coefficients of a BRDF times cosine over the view, band by band, and their energy."""
    edge = 16 if run.quick else 128
    brdf = AshikhminShirley(diffuse=0.1, specular=0.5, nu=48, nv=16)
    clock = Clock()
    table = np.asarray(harmonic.tabulate(brdf, degree=DEGREE, resolution=edge).table)[:, 0]
    seconds = clock.seconds
    inside = np.hypot(*np.mgrid[1 - edge : edge : 2, 1 - edge : edge : 2]) < edge
    blank, largest = np.ones((edge, edge, 3)), np.abs(table[:, inside]).max()
    rows, energy, left = [], [], np.sum(table[:, inside] ** 2)
    for band in range(DEGREE + 1):
        mine = table[band**2 : (band + 1) ** 2]
        square = np.sum(mine**2, 0)
        share = float(np.sum(square[inside]) / left)
        step = np.abs(np.diff(mine, axis=1))[:, inside[1:] & inside[:-1]].max() / largest
        yield {"band": band, "energy": share, "largest_step": float(step), "seconds": seconds, "edge": edge}
        side = [blank] * (DEGREE - band)
        rows.append([*side, *(signed(np.where(inside, each / largest, np.nan)) for each in mine), *side])
        energy.append(np.where(inside, square, np.nan))
    names = [["" for _ in each] for each in rows]
    most = np.nanmax(energy)
    squares = [gray(each / most, 2) for each in energy]
    captions = [f"band {band}, sum of squares" for band in range(DEGREE + 1)]
    drawing.sheet(run.picture("kautz2002_figure_2.jpg"), [*rows, squares], [*names, captions])


def signed(value: np.ndarray) -> np.ndarray:
    """Red where positive, blue where negative, white where there is nothing."""
    strength = np.sqrt(np.abs(value))
    color = np.stack([np.where(value > 0, strength, 0), 0 * strength, np.where(value < 0, strength, 0)], -1)
    return np.where(np.isnan(value)[..., None], 1, color)


def gray(value: np.ndarray, times: int) -> np.ndarray:
    """Gray values, each texel as a square of pixels."""
    color = np.repeat(np.where(np.isnan(value), 1, value)[..., None], 3, -1)
    return np.kron(color, np.ones((times, times, 1)))


def bust(run: Run) -> Mesh:
    """Nefertiti, whose file has +z up, upright and brushed upwards."""
    upright = rotate(run.mesh("nefertiti.ply"), np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]))
    return brush(upright, UPWARDS)


def figure_3(run: Run) -> Iterator[dict[str, Any]]:
    """A brushed head in four environments."""
    mesh = bust(run)
    view, table = view_of(run, mesh, 0.4), tabulated(run, BRUSHED)
    pictures, captions = [], []
    for name in ("grace",) if run.quick else LIGHTS:
        picture, found = unshadowed(run, mesh, BRUSHED, run.light(name), view, table)
        pictures += row([picture])
        captions.append(f"{name}: {100 * found['error']:.0f} % off")
        yield {"light": name, "vertices": len(mesh.position), **found}
    drawing.sheet(run.picture("kautz2002_figure_3.jpg"), [pictures], [captions])


def shadowed(
    run: Run, mesh: Mesh, system: HarmonicSystem, brdf: Callable, light: Environment, view: Camera
) -> tuple[np.ndarray, dict[str, float]]:
    """A picture with precomputed transfer, and what is measured of it."""
    shaded = drawing.shaded(mesh, view)
    pixels = shaded.pixels
    inside = np.asarray(pixels.triangle) >= 0
    triangle = np.where(inside, np.asarray(pixels.triangle), 0)
    weight = np.where(inside[:, None], np.asarray(pixels.barycentric), np.array([1.0, 0, 0]))
    points = on_triangles(mesh.face, triangle, weight.astype(np.float32))
    color = prt.radiance(system, light, eye=view.eye, points=points)
    number = drawing.some(shaded.point, view.eye, 20 if run.quick else POINTS)
    few = on_triangles(mesh.face, triangle[number], weight[number].astype(np.float32))
    exact = reference.radiance(mesh, brdf, light, eye=view.eye, points=few)
    return shaded.picture(color), measured(color[number], np.asarray(exact))


def transfer(run: Run, mesh: Mesh, name: str):
    """Transfer matrices of a mesh, from the store where they are."""
    size = 8 if run.quick else 32
    return harmonic.precompute(
        mesh, degree=DEGREE, size=size, run=visibility.Run(run.keep(f"{name}_matrices.prt"), progress=False)
    )


def figure_7(run: Run) -> Iterator[dict[str, Any]]:
    """Precomputed transfer with BRDFs of the same gloss: radially symmetric, and brushed along two directions."""
    mesh, pictures, captions = run.mesh("happy_buddha_100k.ply"), [], []
    round_lobe = Phong(diffuse=0.1, specular=0.5, exponent=20)
    cases = {
        "Phong, as before": (mesh, round_lobe),
        "brushed upwards": (brush(mesh, UPWARDS), BRUSHED),
        "brushed sideways": (brush(mesh, SIDEWAYS), BRUSHED),
    }
    transport = transfer(run, mesh, "buddha")
    view = view_of(run, mesh, 0.0)
    for light in ("grace",) if run.quick else ("grace", "uffizi"):
        line = []
        for name, (turned, brdf) in cases.items():
            system = HarmonicSystem(turned_to(transport, turned), tabulated(run, brdf))
            picture, found = shadowed(run, turned, system, brdf, run.light(light), view)
            line.append(picture)
            captions.append(f"{name}, {light}\n{100 * found['error']:.0f} % off")
            yield {"light": light, "brdf": name, "vertices": len(mesh.position), "bytes": transport.nbytes, **found}
        pictures.append(row(line))
    width = len(cases)
    names = [captions[first : first + width] for first in range(0, len(captions), width)]
    drawing.sheet(run.picture("kautz2002_figure_7.jpg"), pictures, names)


def turned_to(transport, mesh: Mesh):
    """Transfer matrices in the frames of a mesh with other tangents: arriving light turned about the normal."""
    frame = directions.frame(mesh.normal, mesh.tangent)
    turn = jnp.einsum("vij,vkj->vik", frame, transport.frame)
    matrix = rotation.rotate_each(jnp.moveaxis(transport.matrix[:, 0], 0, 2), turn)
    return eqx.tree_at(lambda t: (t.matrix, t.frame), transport, (jnp.moveaxis(matrix, 2, 0)[:, None], frame))


MEASURED = ("acryl_blue", "cayman", "mystique")
MODELS = {"Ashikhmin-Shirley": BRUSHED, "Poulin-Fournier": PoulinFournier(diffuse=0.1, specular=0.5, exponent=60)}
MESHES = {"nefertiti.ply": "grace", "teapot.obj": "st_peters", "dragon_100k.ply": "uffizi"}


def column(run: Run, name: str) -> dict[str, Any]:
    """Pictures of one BRDF on all meshes, each in a light of its own, and what is measured of them."""
    clock, brdf = Clock(), MODELS.get(name)
    if brdf is None:
        brdf = load_scattered(harness.data() / "brdf" / f"{name}.brdf")
    times = {"interpolated_seconds": 0.0 if name in MODELS else clock.seconds}
    clock = Clock()
    table = harmonic.tabulate(brdf, degree=DEGREE, error=0.1 if run.quick else 0.01)
    times["projected_seconds"] = clock.seconds
    result: dict[str, Any] = {}
    for file, light in list(MESHES.items())[: 1 if run.quick else None]:
        mesh = bust(run) if file == "nefertiti.ply" else brush(run.mesh(file), UPWARDS)
        view = view_of(run, mesh, 0.5)
        picture, found = unshadowed(run, mesh, brdf, run.light(light, size=32), view, table)
        result[file] = {"picture": picture, "line": {"mesh": file, "light": light, "brdf": name, **times, **found}}
    return result


def figure_8(run: Run) -> Iterator[dict[str, Any]]:
    """Models and measured BRDFs on three meshes, in a light each."""
    names = [*MODELS, *(() if run.quick else MEASURED)]
    made = [run.kept(f"kautz_8_{name}", lambda name=name: column(run, name)) for name in names]
    rows, captions = [], []
    for file in made[0]:
        lines = [each[file]["line"] for each in made]
        yield from lines
        rows.append([each for one in made for each in row([np.asarray(one[file]["picture"])])])
        captions.append([f"{x['brdf']}\n{100 * x['error']:.0f} % off, {100 * x['negative']:.0f} % < 0" for x in lines])
    drawing.sheet(run.picture("kautz2002_figure_8.jpg"), rows, captions)


def figure_1(run: Run) -> Iterator[dict[str, Any]]:
    """The teapot in a point light, as a glossy surface, brushed, and brushed with shadows."""
    mesh = brush(run.mesh("") if run.quick else relight_harmonic.table_mesh("teapot"), UPWARDS)
    glossy, light = Phong(diffuse=0.1, specular=0.5, exponent=20), run.light("grace")
    view, names = view_of(run, mesh, 0.6), ["point light", "glossy", "brushed", "brushed, with shadows"]
    shaded = drawing.shaded(mesh, view)
    towards = jnp.array([0.5, 0.7, 0.5]) / jnp.sqrt(0.99)
    pictures = row([shaded.picture(point_light(shaded.point, BRUSHED, towards, view.eye))])
    system = HarmonicSystem(transfer(run, mesh, "teapot"), tabulated(run, BRUSHED))
    for name, brdf in zip(names[1:], (glossy, BRUSHED, BRUSHED), strict=True):
        dark = name.endswith("shadows")
        made = shadowed(run, mesh, system, brdf, light, view) if dark else unshadowed(run, mesh, brdf, light, view)
        pictures += row([made[0]])
        yield {"panel": name, "vertices": len(mesh.position), **made[1]}
    drawing.sheet(run.picture("kautz2002_figure_1.jpg"), [pictures], [names])


def point_light(point: Mesh, brdf: Callable, towards: Any, eye: Any) -> Any:
    """Radiance of points under one direction of light of irradiance pi, without shadows."""
    frame = directions.frame(point.normal, point.tangent)
    wo = directions.view(frame, point.position, eye)
    wi = jnp.einsum("vij,j->vi", frame, towards)
    value = jnp.pi * brdf(wi, wo) * jnp.maximum(wi[:, 2:], 0)
    return jnp.broadcast_to(jnp.where(jnp.isfinite(value), value, 0), (len(wo), 3))


def table_1(run: Run) -> Iterator[dict[str, Any]]:
    """Frames of all rows of Table 1; meshes of the paper's sizes stand in where its own are not to be had."""
    edge = 16 if run.quick else 128
    table = harmonic.tabulate(relight_harmonic.BRDFS["glossy (12, 4)"], degree=DEGREE, resolution=edge)
    sky = run.light("grace")
    light = harmonic.project(sky, degree=DEGREE)
    rows = relight_harmonic.meshes(run.quick)
    for name, mesh in rows.items():
        wrong = table_errors(run, mesh, table, sky)
        for line in relight_harmonic.frame(name, mesh, table, light, 3 if run.quick else 15):
            shadows = "transfer" in line["case"].split(f", {name}")[0]
            yield {"row": name, "vertices": len(mesh.position), **line, "radiance_error": wrong[shadows]}


def table_errors(run: Run, mesh: Mesh, table: HarmonicBrdf, light: Environment) -> tuple[float, float]:
    """Errors of the radiance that Table 1 times, at some vertices that face the eye: without shadows, and with them."""
    brdf, view = relight_harmonic.BRDFS["glossy (12, 4)"], view_of(run, mesh, 0.6)
    number = drawing.some(mesh, view.eye, 20 if run.quick else POINTS)
    coefficient = harmonic.project(light, degree=DEGREE)
    plain = unshadowed_radiance(mesh, table, coefficient, eye=view.eye)
    exact = drawing.unshadowed(mesh, brdf, light, view.eye, number)
    size = 8 if run.quick else 32
    matrix = harmonic.precompute(mesh, degree=DEGREE, size=size, vertex=number, run=prt.Run(progress=False))
    shadowed = prt.radiance(HarmonicSystem(matrix, table), coefficient, eye=jnp.asarray(view.eye))
    truth = reference.radiance(mesh, brdf, light, eye=view.eye, vertex=number)
    return measured(plain[number], exact)["error"], measured(shadowed, np.asarray(truth))["error"]
