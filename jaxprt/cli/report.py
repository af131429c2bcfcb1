"""Holds a scene that systems have made ready beside the exact sum: pictures, errors, times and sizes."""

import itertools
import statistics
import timeit
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxprt import files, image, relit, visibility
from jaxprt.files import objects
from jaxprt.relit.channels import Shading, of_part
from jaxprt.relit.recipes import Known, Recipe, Target
from jaxprt.scene import Camera, Environment, Scene
from jaxprt.scene.environment import background
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
_AMPLIFY = 4.0  # brightness of the difference picture beside the others


class View(NamedTuple):
    """What the command relights, in which lights, and from where.

    Attributes:
        scene: The scene.
        lights: Lights by name.
        camera: The camera.
    """

    scene: Scene
    lights: dict[str, Environment]
    camera: Camera


class Made(NamedTuple):
    """A scene that one system has made ready.

    Attributes:
        direct: The system of all vertices under direct light alone, as exact pictures have it.
        system: The same with bounces, or `direct` without any.
        materials: What they are relit with.
        cost: What they took, for the report.
    """

    direct: System
    system: System
    materials: Any
    cost: dict[str, Any]

    def color(self, light: Environment, eye: Array) -> Array:
        """Radiance of direct light of all vertices."""
        return protocol.radiance(self.direct, light, eye=eye, materials=self.materials)


def plan(view: View, output: Path, *, error: float, bounces: int | None) -> Made:
    """Makes a scene ready by a plan, which is kept with all else: the same command goes on with the same one.

    Raises:
        ValueError: As `jaxprt.precompute`; for a folder that holds something else, with what to do.
    """
    lights = list(view.lights.values())
    made = _made(view, output, error=error, environments=lights, bounces=bounces)
    for part in objects.load(output / "plan").part:
        made.cost[part.name] = {"recipe": type(part.chosen.recipe).__name__, **vars(part.chosen.recipe)}
    return made


def make(view: View, recipe: Recipe, output: Path, *, bounces: int | None) -> Made:
    """Makes a scene ready by one recipe; what is finished is kept in a folder.

    Raises:
        ValueError: As `jaxprt.precompute`; for a folder that holds something else, with what to do.
    """
    size = next(iter(view.lights.values())).radiance.shape[-2]
    made = _made(view, output, system=recipe, size=size, bounces=bounces)
    for part in view.scene.parts:
        made.cost[part.name] = {"recipe": type(recipe).__name__, **vars(recipe)}
    return made


def _made(view: View, output: Path, **options: Any) -> Made:
    start, found = timeit.default_timer(), output.exists()
    try:
        ready = relit.precompute(view.scene, path=output, **options)
    except ValueError as error:
        raise ValueError(f"{error}; here: name another --output" if found else str(error)) from error
    direct = relit.RelitScene(ready.scene, ready.direct, ready.shading)
    cost = {"seconds": timeit.default_timer() - start, "bytes": protocol.memory(ready)}
    return Made(direct, direct if ready.bounces is None else ready, None, cost)


def exact(view: View, vertices: list[np.ndarray]) -> list[np.ndarray]:
    """Radiance by the exact sum of some vertices of the first parts, [light v c]."""
    lights = Environment(jnp.stack([each.radiance for each in view.lights.values()]))
    options = {"eye": view.camera.eye, "occluder": view.scene.mesh, "progress": True}
    result = []
    for part, vertex in zip(view.scene.parts, vertices, strict=False):
        shading = of_part(part)
        result.append(np.asarray(reference.radiance(shading.mesh, shading.exact, lights, vertex=vertex, **options)))
        if shading.emitted is not None:
            result[-1] = result[-1] + np.asarray(shading.emitted)[vertex]
    return result


def visible(view: View) -> np.ndarray:
    """Numbers of the triangles in the picture."""
    triangle = np.unique(np.asarray(image.rasterize(view.scene.mesh, view.camera, samples=4).triangle))
    return triangle[triangle >= 0]


def seen(view: View) -> list[np.ndarray]:
    """Per part, the vertices of the triangles in the picture."""
    vertex = np.unique(np.asarray(view.scene.mesh.face)[visible(view)])
    first = np.cumsum([0, *_counts(view.scene)])
    return [vertex[(vertex >= a) & (vertex < b)] - a for a, b in itertools.pairwise(first)]


def _counts(scene: Scene) -> list[int]:
    return [len(part.mesh.position) for part in scene.parts]


def compare(
    view: View, name: str, made: dict[str, Made], truth: list[np.ndarray], vertices: list[np.ndarray], output: Path
) -> dict[str, Any]:
    """Writes the pictures of one light, and returns each system's errors.

    Args:
        view: The scene, its lights and the camera.
        name: Name of the light.
        made: The systems.
        truth: Exact radiance of some vertices of every part.
        vertices: Those vertices: all that the picture shows.
        output: Folder of the pictures.
    """
    light, scene, mesh = view.lights[name], view.scene, view.scene.mesh
    sky = background(light, image.ray_direction(view.camera))

    def draw(color: Array) -> Array:
        return image.render(mesh, color, view.camera, background=sky)

    full = [
        jnp.zeros((count, values.shape[-1])).at[vertex].set(values)
        for count, values, vertex in zip(_counts(scene), truth, vertices, strict=True)
    ]
    surface = image.render(mesh, jnp.ones((len(mesh.position), 1)), view.camera, background=None)
    right = draw(jnp.concatenate(full))
    stops = image.automatic_exposure(right * surface)
    errors: dict[str, Any] = {"exposure_stops": float(stops)}
    pictures = {}
    for system, each in made.items():
        color = each.color(light, view.camera.eye)
        pictures[system] = draw(color)
        parts = jnp.split(color, np.cumsum(_counts(scene))[:-1])
        errors[system] = {
            "image_error": float(image.relative_l2(pictures[system] * surface, right * surface)),
            "vertex_error": {
                part.name: float(image.relative_l2(mine[vertex], values))
                for part, mine, values, vertex in zip(scene.parts, parts, truth, vertices, strict=True)
            },
            "negative_vertices": int(jnp.sum(jnp.any(color < 0, -1))),
        }
        _write(output, f"{name}_{system}_difference", jnp.abs(pictures[system] - right), stops, _AMPLIFY)
    for kind, picture in (pictures | {"reference": right}).items():
        _write(output, f"{name}_{kind}", picture, stops, 1.0)
    row = jnp.concatenate([*pictures.values(), right], 1)
    files.write_png(output / f"{name}.png", np.asarray(image.display(image.expose(row, stops=stops))))
    return errors


def reflect(view: View, name: str, system: str, made: Made, stops: float, output: Path) -> float:
    """Writes the picture of one light with reflected light too; returns what fraction of the light that is."""
    light, mesh, eye = view.lights[name], view.scene.mesh, view.camera.eye
    direct = made.color(light, eye)
    color = protocol.radiance(made.system, light, eye=eye, materials=made.materials)
    sky = background(light, image.ray_direction(view.camera))
    picture = image.render(mesh, color, view.camera, background=sky)
    _write(output, f"{name}_{system}_bounces", picture, jnp.asarray(stops, picture.dtype), 1.0)
    first, both = (image.render(mesh, each, view.camera, background=None) for each in (direct, color))
    total = float(jnp.sum(both))
    return float(jnp.sum(both - first)) / total if total > 0 else 0.0


def _write(output: Path, name: str, picture: Array, stops: Array, gain: float) -> None:
    files.write_exr(output / f"{name}.exr", np.asarray(picture))
    shown = image.display(image.expose(picture * gain, stops=stops))
    files.write_png(output / f"{name}.png", np.asarray(shown))


def times(view: View, made: Made) -> dict[str, float]:
    """Median seconds of what a frame needs."""
    system, materials = made.system, made.materials
    light, eye, mesh = next(iter(view.lights.values())), view.camera.eye, view.scene.mesh

    def arriving():
        return system.shade(system.light(light), materials)

    lit, seen = arriving(), system.view(eye, materials)
    color = system.combine(lit, seen)
    return {
        "light_change_seconds": _median(lambda: system.combine(arriving(), seen)),
        "view_change_seconds": _median(lambda: system.combine(lit, system.view(eye, materials))),
        "render_seconds": _median(lambda: image.render(mesh, color, view.camera, background=None)),
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
    """Errors of one system by its sizes, on some vertices of the first part."""
    shading = of_part(view.scene.parts[0])
    size = next(iter(view.lights.values())).radiance.shape[-2]
    target = Target(view.scene.mesh, size=size, vertex=vertex, progress=False)
    blend = None if shading.blend is None else jax.tree.map(lambda each: each[vertex], shading.blend)
    rows = []
    for sizes, system in TABLES[name](shading, target):
        rows.append({"system": name, **sizes, **_row(system, blend, view, truth)})
    return rows


def _row(system: System, blend: Blend | None, view: View, truth: np.ndarray) -> dict[str, float]:
    """Bytes, time and errors of one row."""
    light, eye = next(iter(view.lights.values())), view.camera.eye
    seconds = _median(lambda: system.light(light))
    row = {
        "bytes_per_vertex": protocol.memory(system) / system.vertices,
        "light_change_nanoseconds_per_vertex": seconds / system.vertices * 1e9,
    }
    for number, (name, each) in enumerate(view.lights.items()):
        mine = protocol.radiance(system, each, eye=eye, materials=blend)
        row[f"error {name}"] = float(image.relative_l2(mine, truth[number]))
    return row


def _separable(shading: Shading, target: Target):
    """Systems by terms and kept coefficients."""
    full: Any = relit.Terms(max(TABLE_TERMS), max(TABLE_KEEP)).make(shading, target)
    for terms, keep in itertools.product(TABLE_TERMS, TABLE_KEEP):
        if terms <= full.brdf.terms:
            short = full.transport.truncate(keep, terms=terms)
            yield {"terms": terms, "keep": keep}, SeparableSystem(short, full.brdf.truncate(terms))


def _harmonic(shading: Shading, target: Target):
    """Systems by degree, with a window and without."""
    degree = max(TABLE_DEGREES)
    options = {"degree": degree, **target.traced(), "progress": False}
    full = harmonic.precompute(shading.mesh, **options)
    brdf = harmonic.tabulate(shading.brdf, degree=degree, knot=shading.knot)
    for degree, laplacian in itertools.product(TABLE_DEGREES, TABLE_LAPLACIAN):
        terms = (degree + 1) ** 2
        short = TransferMatrix(full.matrix[..., :terms, :terms], full.position, full.frame)
        system = HarmonicSystem(short, brdf.truncate(degree=degree), laplacian)
        yield {"degree": degree, "laplacian": laplacian}, system


def _lobe(shading: Shading, target: Target):
    """Systems by lobes and single texels."""
    options = {"size": target.size, **target.traced(), "progress": False}
    seen = visibility.precompute(shading.mesh, **options)
    target = Target(target.occluder, size=target.size, vertex=target.vertex, known=Known(seen), progress=False)
    for lobes, texels in itertools.product(TABLE_LOBES, TABLE_TEXELS):
        yield {"lobes": lobes, "texels": texels}, relit.Lobes(lobes, texels).make(shading, target)


TABLES: dict[str, Callable] = {"separable": _separable, "harmonic": _harmonic, "lobe": _lobe}
