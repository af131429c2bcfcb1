"""Compares precomputed scenes with the exact sum: pictures, errors, times and sizes."""

import dataclasses
import itertools
import timeit
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxprt import files, image, relit, visibility
from jaxprt.files import objects
from jaxprt.files.inputs import JsonObject
from jaxprt.image import pixels
from jaxprt.relit import measuring
from jaxprt.relit.channels import Shading, of_part
from jaxprt.relit.exact import ExactPicture, ExactPixels, exact_picture, exact_pixels, importance
from jaxprt.relit.exact_lamps import Lamps
from jaxprt.relit.recipes import Known, Recipe, Target, harmonic_table
from jaxprt.relit.scene import RelitScene
from jaxprt.scene import Camera, Environment, Scene, sides
from jaxprt.scene.scene import centered
from jaxprt.systems import harmonic, protocol, reference
from jaxprt.systems.harmonic import HarmonicSystem, TransferMatrix
from jaxprt.systems.protocol import System
from jaxprt.systems.separable import SeparableSystem

TABLE_TERMS = (1, 4, 16, 64)
TABLE_KEEP = (32, 96, 256)
TABLE_DEGREES = (2, 4, 6, 9)
TABLE_LAPLACIAN = (1.0, 0.4)
TABLE_LOBES = (4, 12, 24)
TABLE_TEXELS = (0, 16, 64)
PIXELS = 1000  # pixels at which pictures are measured
POINTS = 26_000  # largest number of points of the exact picture: half a minute on two cores
VERTICES = 300  # vertices of each part at which radiance is measured
_AMPLIFY = 4.0  # brightness of the difference picture relative to the others
_TIMED = 1 << 10  # pixels along an edge of the largest picture whose view is timed, about a gigabyte


class View(NamedTuple):
    """The scene that a command relights, the lights by name, the camera, and tone and stops of `image.display`."""

    scene: Scene
    lights: dict[str, Environment]
    camera: Camera
    tone: str = "srgb"
    stops: float | None = None  # automatic


class Truth(NamedTuple):
    """Exact radiance under direct light, for each light.

    Attributes:
        pixels: Exact values of some pixels, for measuring.
        picture: An exact picture, for display.
        vertex: For each part, the indices of some visible vertices.
        radiance: Exact radiance of these vertices towards the eye.
        seconds: Time to compute each of these.
    """

    pixels: ExactPixels
    picture: ExactPicture
    vertex: list[Int[np.ndarray, " _"]]
    radiance: list[Float[np.ndarray, "l _ c"]]
    seconds: dict[str, float]


def make(
    view: View, recipe: Recipe | Mapping[str, Recipe] | None, output: Path, **options: Any
) -> tuple[RelitScene, JsonObject]:
    """Precomputes a scene by one recipe, by one for each part, or by a plan. Finished work is kept in a folder.

    Returns:
        The scene, and the costs of its precomputation for the report.

    Raises:
        ValueError: `jaxprt.precompute` refuses its arguments, or the folder holds other data. The message then states
            what to do.
    """
    start, existed = timeit.default_timer(), output.exists()
    size = None if recipe is None else next(iter(view.lights.values())).radiance.shape[-2]
    try:
        scene = relit.precompute(view.scene, system=recipe, size=size, refine=False, path=output, **options)
    except ValueError as error:
        raise ValueError(f"{error}; on the command line, name another --output" if existed else str(error)) from error
    cost = {"seconds": timeit.default_timer() - start, "bytes": scene.nbytes}
    if recipe is None:
        recipe = objects.load(output / "plan").recipes
    recipes = recipe if isinstance(recipe, Mapping) else dict.fromkeys(view.scene.names, recipe)
    return scene, cost | {part: {"recipe": type(of).__name__, **vars(of)} for part, of in recipes.items()}


def pictures(scene: RelitScene, view: View, *, camera: Camera | None = None) -> Float[np.ndarray, "l h w c"]:
    """Pictures under all lights."""
    return scene.pictures(list(view.lights.values()), [camera or view.camera])[:, 0]


def exact(view: View, drawn: Sequence[Float[np.ndarray, "l h w c"]]) -> Truth:
    """Exact pixels, pictures and vertices of a view. Pixels are sampled mostly where drawn pictures may be wrong."""
    arguments = view.scene, [of_part(part) for part in view.scene.parts], list(view.lights.values()), view.camera
    times = [timeit.default_timer()]
    weight = importance(itertools.chain(*drawn))
    sampled = exact_pixels(*arguments, pixels=PIXELS, importance=weight, progress=True)
    times.append(timeit.default_timer())
    picture = exact_picture(*arguments, most=POINTS, progress=True)
    times.append(timeit.default_timer())
    random = np.random.default_rng(0)
    vertex = [random.permutation(vertices)[:VERTICES] for vertices in _visible_vertices(view)]
    radiance = exact_vertices(view, vertex)
    times.append(timeit.default_timer())
    seconds: dict[str, float] = dict(zip(("pixels", "picture", "vertices"), np.diff(times).tolist(), strict=True))
    return Truth(sampled, picture, vertex, radiance, seconds)


def exact_vertices(view: View, vertices: list[Int[np.ndarray, " _"]]) -> list[Float[np.ndarray, "l _ c"]]:
    """Exact radiance of some vertices of the first parts."""
    lights = Environment(jnp.stack([light.radiance for light in view.lights.values()]))
    options = {"eye": view.camera.eye, "occluder": view.scene.mesh, "progress": True}
    result, shadings = [], [of_part(part) for part in view.scene.parts]
    lamps = Lamps.of(centered(view.scene), shadings)
    eye = jnp.asarray(view.camera.local(view.scene.mesh.origin).eye)
    for shading, vertex in zip(shadings, vertices, strict=False):
        color = np.asarray(reference.radiance(shading.mesh, shading.exact, lights, vertex=vertex, **options))
        color = color + lamps.at_vertices(shading.mesh, measuring.exact_brdf(shading, vertex), vertex, eye)
        result.append(color if shading.emitted is None else color + np.asarray(shading.emitted)[vertex])
    return result


def _visible_vertices(view: View) -> list[Int[np.ndarray, " _"]]:
    """For each part, the vertices of the triangles in the picture."""
    mesh = view.scene.mesh
    hidden = sides.hidden_backs(view.scene)[np.asarray(mesh.region)[np.asarray(mesh.face)[:, 0]]]
    occluder = None if mesh.opacity is None else visibility.Occluder(mesh)
    triangle = np.asarray(
        pixels.visible_points(mesh, view.camera, samples=4, hidden=hidden, occluder=occluder).triangle
    )
    vertex = np.unique(np.asarray(mesh.face)[triangle[triangle >= 0]])
    first = np.cumsum([0, *view.scene.counts])
    return [vertex[(vertex >= low) & (vertex < high)] - low for low, high in itertools.pairwise(first)]


def compare(view: View, scenes: dict[str, RelitScene], output: Path) -> JsonObject:
    """Writes all pictures. Returns the part of the report on the exact sum, and each system's errors under each light.

    Args:
        view: The scene, its lights and the camera.
        scenes: The scene, precomputed by each system.
        output: Folder for the pictures.
    """
    direct = {system: scene.without_bounces() for system, scene in scenes.items()}
    drawn = {system: pictures(scene, view) for system, scene in direct.items()}
    truth, mesh, result = exact(view, list(drawn.values())), view.scene.mesh, {}
    camera, alike = truth.picture.camera, drawn
    if camera.width != view.camera.width:
        alike = {system: pictures(scene, view, camera=camera) for system, scene in direct.items()}
    whole = {system: pictures(scene, view) for system, scene in scenes.items() if scene.bounces is not None}
    cover = image.render(mesh, jnp.ones((len(mesh.position), 1)), camera, background=None)
    uncovered = 1 - next(iter(direct.values())).coverage(view.camera)[..., None]
    for number, (name, light) in enumerate(view.lights.items()):
        right = jnp.asarray(truth.picture.color[number])
        stops = image.automatic_exposure(right * cover) if view.stops is None else jnp.asarray(view.stops)
        result[name] = {system: _errors(view, number, direct[system], drawn[system], truth) for system in drawn}
        for system in drawn:
            difference = jnp.abs(alike[system][number] - right)
            _write(output / f"{name}_{system}", drawn[system][number], stops, tone=view.tone)
            _write(output / f"{name}_{system}_difference", difference, stops, gain=_AMPLIFY)
        for system in whole:
            both, first = whole[system][number], drawn[system][number]
            _write(output / f"{name}_{system}_bounces", both, stops, tone=view.tone)
            total = float(np.sum(both - image.sky(light, view.camera) * uncovered))
            result[name][system]["reflected_fraction"] = float(np.sum(both - first)) / total if total > 0 else 0.0
        result[name]["exposure_stops"] = stops
        result[name]["exact_pixels_error"] = truth.pixels.error[number]
        result[name]["exact_picture_error"] = truth.picture.error[number]
        _write(output / f"{name}_reference", right, stops, tone=view.tone)
        rows, columns = (np.arange(n) * m // n for n, m in zip(uncovered.shape[:2], right.shape, strict=False))
        row = jnp.concatenate([*(drawn[system][number] for system in drawn), right[rows][:, columns]], 1)
        files.write_png(output / f"{name}.png", np.asarray(image.display(row, tone=view.tone, stops=stops)))
    vertices = {name: len(vertex) for name, vertex in zip(view.scene.names, truth.vertex, strict=True)}
    sizes = {"pixels": len(truth.pixels.pixel), "picture_width": camera.width, "vertices": vertices}
    return {"exact": {"seconds": truth.seconds, **sizes}, "lights": result}


def _errors(
    view: View, number: int, scene: RelitScene, drawn: Float[np.ndarray, "l h w c"], truth: Truth
) -> JsonObject:
    """Relative L2 errors of a picture and of vertices, and the number of vertices with negative radiance."""
    light = list(view.lights.values())[number]
    color = scene.radiance(light, eye=jnp.asarray(view.camera.eye))[scene.file_vertex]
    parts = zip(jnp.split(color, np.cumsum(view.scene.counts)[:-1]), truth.vertex, truth.radiance, strict=True)
    errors = [image.relative_l2(part[vertex], right[number]) for part, vertex, right in parts]
    error, spread = truth.pixels.relative_l2(drawn[number], light=number)
    return {
        "picture_error": error,
        "picture_error_spread": spread,
        "vertex_error": dict(zip(view.scene.names, map(float, errors), strict=True)),
        "negative_vertices": jnp.sum(jnp.any(color < 0, -1)),
    }


def write_layers(view: View, system: str, scene: RelitScene, layers: Sequence[str], output: Path) -> None:
    """Writes a file with layers of the picture for each light, without the light behind it."""
    names, lights = list(view.lights), list(view.lights.values())
    for block in scene.picture_blocks(lights, [view.camera], background=None, layers=layers):
        for number, light in enumerate(block.lights):
            picture = {name: layer[number] for name, layer in block.pictures.items()}
            files.write_exr(output / f"{names[light]}_{system}_layers.exr", picture)


def _write(path: Path, picture: Array | np.ndarray, stops: Array, *, gain: float = 1.0, tone: str = "srgb") -> None:
    files.write_exr(path.with_name(f"{path.name}.exr"), np.asarray(picture))
    shown = image.display(jnp.asarray(picture) * gain, tone=tone, stops=stops)
    files.write_png(path.with_name(f"{path.name}.png"), np.asarray(shown))


def times(view: View, scene: RelitScene) -> dict[str, float]:
    """Median seconds per picture: with a new light from a cached view, and with a new view from the start."""
    light, camera, number = next(iter(view.lights.values())), view.camera, itertools.count(1)
    camera = dataclasses.replace(camera, width=min(camera.width, _TIMED), height=min(camera.height, _TIMED))
    still, away = scene.picture_view(camera), camera.eye - camera.target

    def moved():
        return dataclasses.replace(camera, eye=camera.target + away * (1 + 0.01 * next(number)))

    return {
        "light_change_seconds": measuring.seconds(lambda: still.picture(light)),
        "view_change_seconds": measuring.seconds(lambda: scene.picture_view(moved()).picture(light)),
    }


def tables(view: View, systems: Sequence[str], count: int) -> tuple[list[JsonObject], int]:
    """Errors of systems at several sizes on some vertices of the first part that face the eye, and their number."""
    mesh, eye, lights = view.scene.parts[0].mesh, view.camera.eye, list(view.lights.values())
    facing = np.flatnonzero(np.sum(np.asarray(mesh.normal * (eye - mesh.position)), 1) > 0)
    vertex = np.random.default_rng(0).permutation(facing)[:count]
    (truth,) = exact_vertices(view, [vertex])
    shading = of_part(view.scene.parts[0], takes=lambda table: False)
    size, run = lights[0].radiance.shape[-2], visibility.Run(progress=False)
    target = Target(view.scene.mesh, size=size, vertex=vertex, run=run)
    blend = None if shading.blend is None else jax.tree.map(lambda leaf: leaf[vertex], shading.blend)
    rows = []
    for name in systems:
        for sizes, system in TABLES[name](shading, target) if name in TABLES else ():
            seconds = measuring.seconds(lambda light=system.light: light(lights[0]))
            row = {"system": name, **sizes, "bytes_per_vertex": protocol.memory(system) / system.vertices}
            row["light_change_nanoseconds_per_vertex"] = seconds / system.vertices * 1e9
            for light, environment, right in zip(view.lights, lights, truth, strict=True):
                color = protocol.radiance(system, environment, eye=eye, materials=blend)
                row[f"error {light}"] = float(image.relative_l2(color, right))
            rows.append(row)
    return rows, len(vertex)


def row_text(row: JsonObject) -> str:
    """A row of a table as text."""
    return "  ".join(
        f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}" for key, value in row.items()
    )


def _separable(shading: Shading, target: Target) -> Iterator[tuple[JsonObject, System]]:
    """Systems with several numbers of terms and kept coefficients."""
    full: Any = relit.Terms(max(TABLE_TERMS), max(TABLE_KEEP)).make(shading, target)
    for terms, keep in itertools.product(TABLE_TERMS, TABLE_KEEP):
        if terms <= full.brdf.terms:
            short = full.transport.truncate(keep, terms=terms)
            yield {"terms": terms, "keep": keep}, SeparableSystem(short, full.brdf.truncate(terms))


def _harmonic(shading: Shading, target: Target) -> Iterator[tuple[JsonObject, System]]:
    """Systems of several degrees, with and without a window."""
    full = harmonic.precompute(shading.mesh, degree=max(TABLE_DEGREES), **target.traced("matrices"))
    brdf = harmonic_table(shading, degree=max(TABLE_DEGREES))
    for degree, laplacian in itertools.product(TABLE_DEGREES, TABLE_LAPLACIAN):
        terms = (degree + 1) ** 2
        short = TransferMatrix(full.matrix[..., :terms, :terms], full.position, full.frame)
        yield {"degree": degree, "laplacian": laplacian}, HarmonicSystem(short, brdf.truncate(degree=degree), laplacian)


def _lobe(shading: Shading, target: Target) -> Iterator[tuple[JsonObject, System]]:
    """Systems with several numbers of lobes and single texels."""
    seen = visibility.precompute(shading.mesh, size=target.size, **target.traced("visibility"))
    target = dataclasses.replace(target, known=Known(seen))
    for lobes, texels in itertools.product(TABLE_LOBES, TABLE_TEXELS):
        yield {"lobes": lobes, "texels": texels}, relit.Lobes(lobes, texels).make(shading, target)


TABLES: dict[str, Callable[[Shading, Target], Iterator[tuple[JsonObject, System]]]] = {
    "separable": _separable,
    "harmonic": _harmonic,
    "lobe": _lobe,
}
