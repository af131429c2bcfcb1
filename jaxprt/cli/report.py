"""Compares precomputed scenes with the exact sum: pictures, errors, times and sizes."""

import dataclasses
import itertools
import math
import statistics
import timeit
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxprt import files, image, relit, visibility
from jaxprt.files import objects
from jaxprt.image import pixels
from jaxprt.relit import measuring
from jaxprt.relit.channels import Shading, of_part
from jaxprt.relit.exact import ExactPicture, ExactPixels, exact_picture, exact_pixels, importance
from jaxprt.relit.exact_lamps import Lamps
from jaxprt.relit.pictures import PictureView
from jaxprt.relit.recipes import Known, Recipe, Target, harmonic_table
from jaxprt.relit.scene import RelitScene
from jaxprt.scene import Camera, Environment, Scene, sides
from jaxprt.scene.scene import centered
from jaxprt.systems import harmonic, protocol, reference
from jaxprt.systems.harmonic import HarmonicSystem, TransferMatrix
from jaxprt.systems.protocol import Blend, System
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
_KEPT = 1 << 20  # pixels of the largest picture whose view is cached, about a gigabyte


class View(NamedTuple):
    """The scene that a command relights, the lights, and the camera.

    Attributes:
        scene: The scene.
        lights: Lights by name.
        camera: The camera.
        tone: Tone curve of pictures for display, as `jaxprt.image.display` takes it.
    """

    scene: Scene
    lights: dict[str, Environment]
    camera: Camera
    tone: str = "srgb"


class SystemScene(NamedTuple):
    """A scene that one system has precomputed.

    Attributes:
        direct: The scene with direct light alone, to compare with exact pictures.
        system: The same including bounces; equal to `direct` if there are none.
        cost: Costs of the precomputation, for the report.
    """

    direct: RelitScene
    system: RelitScene
    cost: dict[str, Any]

    def color(self, light: Environment, eye: Array) -> Array:
        """Radiance of the vertices of the scene's file under direct light."""
        return protocol.radiance(self.direct, light, eye=eye)[self.direct.file_vertex]

    def view(self, camera: Camera, *, reflected: bool = False) -> PictureView:
        """The part of a picture that does not depend on the light, for direct light or with bounces."""
        return (self.system if reflected else self.direct).picture_view(camera)

    def pictures(self, lights: list[Environment], camera: Camera, *, reflected: bool = False) -> list[Array]:
        """Pictures under several lights, for direct light or with bounces."""
        system = self.system if reflected else self.direct
        if camera.width * camera.height > _KEPT:
            return [system.picture(light, camera) for light in lights]
        seen = self.view(camera, reflected=reflected)
        return [seen.picture(light) for light in lights]


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
    vertex: list[np.ndarray]
    radiance: list[np.ndarray]
    seconds: dict[str, float]


def plan(
    view: View, output: Path, *, error: float | None, bounces: int | str | None, executor: Executor | None = None
) -> SystemScene:
    """Precomputes a scene by a plan. The plan is stored too, so that the same command continues with the same plan.

    Raises:
        ValueError: `jaxprt.precompute` refuses its arguments, or the folder holds other data. The message then states
            what to do.
    """
    lights = list(view.lights.values())
    candidate = _precompute(view, output, error=error, environments=lights, bounces=bounces, executor=executor)
    for part in objects.load(output / "plan").part:
        candidate.cost[part.name] = {"recipe": type(part.chosen.recipe).__name__, **vars(part.chosen.recipe)}
    return candidate


def make(
    view: View,
    recipe: Recipe | dict[str, Recipe],
    output: Path,
    *,
    bounces: int | str | None,
    executor: Executor | None = None,
) -> SystemScene:
    """Precomputes a scene by one recipe, or by one recipe for each part. Finished work is kept in a folder.

    Raises:
        ValueError: `jaxprt.precompute` refuses its arguments, or the folder holds other data. The message then states
            what to do.
    """
    size = next(iter(view.lights.values())).radiance.shape[-2]
    candidate = _precompute(view, output, system=recipe, size=size, bounces=bounces, executor=executor)
    for part in view.scene.parts:
        chosen = recipe[part.name] if isinstance(recipe, dict) else recipe
        candidate.cost[part.name] = {"recipe": type(chosen).__name__, **vars(chosen)}
    return candidate


def _precompute(view: View, output: Path, **options: Any) -> SystemScene:
    start, existed = timeit.default_timer(), output.exists()
    try:
        ready = relit.precompute(view.scene, refine=False, path=output, **options)
    except ValueError as error:
        raise ValueError(f"{error}; on the command line, name another --output" if existed else str(error)) from error
    direct = ready.without_bounces()
    cost = {"seconds": timeit.default_timer() - start, "bytes": ready.nbytes}
    return SystemScene(direct, direct if ready.bounces is None else ready, cost)


def draw(view: View, reports: dict[str, SystemScene]) -> dict[str, list[Array]]:
    """Pictures under direct light by each system, for all lights."""
    return {
        system: candidate.pictures(list(view.lights.values()), view.camera) for system, candidate in reports.items()
    }


def exact(view: View, drawn: dict[str, list[Array]]) -> Truth:
    """Exact pixels, pictures and vertices of a view. Pixels are sampled mostly where drawn pictures may be wrong."""
    shadings, lights = [of_part(part) for part in view.scene.parts], list(view.lights.values())
    seconds, start = {}, timeit.default_timer()
    options = {"pixels": PIXELS, "importance": importance(itertools.chain(*drawn.values())), "progress": True}
    pixels = exact_pixels(view.scene, shadings, lights, view.camera, **options)
    seconds["pixels"], start = timeit.default_timer() - start, timeit.default_timer()
    picture = exact_picture(view.scene, shadings, lights, view.camera, most=POINTS, progress=True)
    seconds["picture"], start = timeit.default_timer() - start, timeit.default_timer()
    random = np.random.default_rng(0)
    vertex = [random.permutation(vertices)[:VERTICES] for vertices in visible_vertices(view)]
    radiance = exact_vertices(view, vertex)
    seconds["vertices"] = timeit.default_timer() - start
    return Truth(pixels, picture, vertex, radiance, seconds)


def exact_vertices(view: View, vertices: list[np.ndarray]) -> list[np.ndarray]:
    """Exact radiance of some vertices of the first parts, [light v c]."""
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


def visible(view: View) -> np.ndarray:
    """Indices of the triangles in the picture."""
    triangle = np.unique(np.asarray(_points(view).triangle))
    return triangle[triangle >= 0]


def _points(view: View) -> image.Pixels:
    """The points of the picture."""
    mesh = view.scene.mesh
    hidden = sides.hidden_backs(view.scene)[np.asarray(mesh.region)[np.asarray(mesh.face)[:, 0]]]
    occluder = None if mesh.opacity is None else visibility.Occluder(mesh)
    return pixels.visible_points(mesh, view.camera, samples=4, hidden=hidden, occluder=occluder)


def visible_vertices(view: View) -> list[np.ndarray]:
    """For each part, the vertices of the triangles in the picture."""
    vertex = np.unique(np.asarray(view.scene.mesh.face)[visible(view)])
    first = np.cumsum([0, *view.scene.counts])
    return [vertex[(vertex >= a) & (vertex < b)] - a for a, b in itertools.pairwise(first)]


def compare(
    view: View, candidates: dict[str, SystemScene], drawn: dict[str, list[Array]], truth: Truth, output: Path
) -> dict[str, dict[str, Any]]:
    """Writes the pictures and returns each system's errors under each light.

    Args:
        view: The scene, its lights and the camera.
        candidates: The systems.
        drawn: The pictures by each system.
        truth: Exact radiance of the view.
        output: Folder for the pictures.
    """
    lights, mesh, camera = list(view.lights.values()), view.scene.mesh, truth.picture.camera
    surface = image.render(mesh, jnp.ones((len(mesh.position), 1)), camera, background=None)
    result: dict[str, dict[str, Any]] = {name: {} for name in view.lights}
    rows: dict[str, list[Array]] = {name: [] for name in view.lights}
    right = dict(zip(view.lights, map(jnp.asarray, truth.picture.color), strict=True))
    stops = {name: image.automatic_exposure(picture * surface) for name, picture in right.items()}
    for system, candidate in candidates.items():
        alike = drawn[system] if camera.width == view.camera.width else candidate.pictures(lights, camera)
        for number, (name, picture) in enumerate(zip(view.lights, drawn[system], strict=True)):
            result[name][system] = _errors(view, name, candidate, picture, truth)
            _write(output, f"{name}_{system}", picture, stops[name], tone=view.tone)
            _write(
                output, f"{name}_{system}_difference", jnp.abs(alike[number] - right[name]), stops[name], gain=_AMPLIFY
            )
            rows[name].append(picture)
    for number, (name, truth_picture) in enumerate(right.items()):
        result[name]["exposure_stops"] = float(stops[name])
        result[name]["exact_pixels_error"] = float(truth.pixels.error[number])
        result[name]["exact_picture_error"] = float(truth.picture.error[number])
        _write(output, f"{name}_reference", truth_picture, stops[name], tone=view.tone)
        row = jnp.concatenate([*rows[name], _enlarge(truth_picture, view.camera)], 1)
        files.write_png(output / f"{name}.png", np.asarray(image.display(row, tone=view.tone, stops=stops[name])))
    return result


def _errors(view: View, name: str, candidate: SystemScene, picture: Array, truth: Truth) -> dict[str, Any]:
    """Relative L2 errors of a picture and of vertices, and the number of vertices with negative radiance."""
    number, color = list(view.lights).index(name), candidate.color(view.lights[name], jnp.asarray(view.camera.eye))
    parts = jnp.split(color, np.cumsum(view.scene.counts)[:-1])
    rows = zip(view.scene.parts, parts, truth.vertex, truth.radiance, strict=True)
    error, spread = truth.pixels.relative_l2(picture, light=number)
    return {
        "picture_error": error,
        "picture_error_spread": spread,
        "vertex_error": {
            part.name: float(image.relative_l2(mine[vertex], right[number])) for part, mine, vertex, right in rows
        },
        "negative_vertices": int(jnp.sum(jnp.any(color < 0, -1))),
    }


def reflect(view: View, system: str, candidate: SystemScene, stops: dict[str, float], output: Path) -> dict[str, float]:
    """Writes pictures that include interreflection. Returns its fraction of each picture's light."""
    lights, camera, pixels = list(view.lights.values()), view.camera, _points(view)
    direct, whole = (candidate.pictures(lights, camera, reflected=bounces) for bounces in (False, True))
    result = {}
    for name, light, first, both in zip(view.lights, lights, direct, whole, strict=True):
        _write(output, f"{name}_{system}_bounces", both, jnp.asarray(stops[name], both.dtype), tone=view.tone)
        total = float(jnp.sum(both - image.sky(light, camera) * pixels.background[..., None]))
        result[name] = float(jnp.sum(both - first)) / total if total > 0 else 0.0
    return result


def write_layers(view: View, system: str, candidate: SystemScene, layers: Sequence[str], output: Path) -> None:
    """Writes a file with layers of the picture for each light, without the light behind it."""
    names, lights = list(view.lights), list(view.lights.values())
    for block in candidate.system.picture_blocks(lights, [view.camera], background=None, layers=layers):
        for number, light in enumerate(block.lights):
            picture = {name: image[number] for name, image in block.pictures.items()}
            files.write_exr(output / f"{names[light]}_{system}_layers.exr", picture)


def _enlarge(picture: Array, camera: Camera) -> Array:
    """A picture scaled to a camera's number of pixels by nearest neighbors."""
    row, column = (np.arange(n) * m // n for n, m in zip((camera.height, camera.width), picture.shape, strict=False))
    return picture[row][:, column]


def _write(output: Path, name: str, picture: Array, stops: Array, *, gain: float = 1.0, tone: str = "srgb") -> None:
    files.write_exr(output / f"{name}.exr", np.asarray(picture))
    shown = image.display(picture * gain, tone=tone, stops=stops)
    files.write_png(output / f"{name}.png", np.asarray(shown))


def times(view: View, candidate: SystemScene) -> dict[str, float]:
    """Median seconds per picture: with a new light from a cached view, and with a new view from the start."""
    light, camera = next(iter(view.lights.values())), view.camera
    edge = math.isqrt(_KEPT)
    camera = dataclasses.replace(camera, width=min(camera.width, edge), height=min(camera.height, edge))
    still, away, number = candidate.view(camera, reflected=True), camera.eye - camera.target, itertools.count(1)

    def moved():
        return dataclasses.replace(camera, eye=camera.target + away * (1 + 0.01 * next(number)))

    return {
        "light_change_seconds": _median(lambda: still.picture(light)),
        "view_change_seconds": _median(lambda: candidate.view(moved(), reflected=True).picture(light)),
    }


def _median(function: Callable[[], Any]) -> float:
    jax.block_until_ready(function())
    return statistics.median(timeit.repeat(lambda: jax.block_until_ready(function()), number=1, repeat=7))


def sample(view: View, count: int) -> np.ndarray:
    """Some vertices of the first part that face the eye."""
    mesh, eye = view.scene.parts[0].mesh, view.camera.eye
    facing = np.flatnonzero(np.sum(np.asarray(mesh.normal * (eye - mesh.position)), 1) > 0)
    return np.random.default_rng(0).permutation(facing)[:count]


def table(name: str, view: View, vertex: np.ndarray, truth: np.ndarray) -> list[dict[str, Any]]:
    """Errors of one system at several sizes, on some vertices of the first part."""
    shading = of_part(view.scene.parts[0], takes=lambda table: False)
    size = next(iter(view.lights.values())).radiance.shape[-2]
    target = Target(view.scene.mesh, size=size, vertex=vertex, run=visibility.Run(progress=False))
    blend = None if shading.blend is None else jax.tree.map(lambda leaf: leaf[vertex], shading.blend)
    rows = []
    for sizes, system in TABLES[name](shading, target):
        rows.append({"system": name, **sizes, **_row(system, blend, view, truth)})
    return rows


def row_text(row: dict[str, Any]) -> str:
    """A row of a table as text."""
    return "  ".join(
        f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}" for key, value in row.items()
    )


def _row(system: System, blend: Blend | None, view: View, truth: np.ndarray) -> dict[str, float]:
    """Bytes, time and errors of one row."""
    light, eye = next(iter(view.lights.values())), view.camera.eye
    seconds = _median(lambda: system.light(light))
    row = {
        "bytes_per_vertex": protocol.memory(system) / system.vertices,
        "light_change_nanoseconds_per_vertex": seconds / system.vertices * 1e9,
    }
    for number, (name, environment) in enumerate(view.lights.items()):
        mine = protocol.radiance(system, environment, eye=eye, materials=blend)
        row[f"error {name}"] = float(image.relative_l2(mine, truth[number]))
    return row


def _separable(shading: Shading, target: Target):
    """Systems with several numbers of terms and kept coefficients."""
    full: Any = relit.Terms(max(TABLE_TERMS), max(TABLE_KEEP)).make(shading, target)
    for terms, keep in itertools.product(TABLE_TERMS, TABLE_KEEP):
        if terms <= full.brdf.terms:
            short = full.transport.truncate(keep, terms=terms)
            yield {"terms": terms, "keep": keep}, SeparableSystem(short, full.brdf.truncate(terms))


def _harmonic(shading: Shading, target: Target):
    """Systems of several degrees, with and without a window."""
    degree = max(TABLE_DEGREES)
    full = harmonic.precompute(shading.mesh, degree=degree, **target.traced("matrices"))
    brdf = harmonic_table(shading, degree=degree)
    for degree, laplacian in itertools.product(TABLE_DEGREES, TABLE_LAPLACIAN):
        terms = (degree + 1) ** 2
        short = TransferMatrix(full.matrix[..., :terms, :terms], full.position, full.frame)
        system = HarmonicSystem(short, brdf.truncate(degree=degree), laplacian)
        yield {"degree": degree, "laplacian": laplacian}, system


def _lobe(shading: Shading, target: Target):
    """Systems with several numbers of lobes and single texels."""
    seen = visibility.precompute(shading.mesh, size=target.size, **target.traced("visibility"))
    target = dataclasses.replace(target, known=Known(seen))
    for lobes, texels in itertools.product(TABLE_LOBES, TABLE_TEXELS):
        yield {"lobes": lobes, "texels": texels}, relit.Lobes(lobes, texels).make(shading, target)


TABLES: dict[str, Callable] = {"separable": _separable, "harmonic": _harmonic, "lobe": _lobe}
