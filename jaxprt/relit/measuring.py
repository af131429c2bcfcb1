"""Measures precomputed scenes: errors of pictures and vertices against the sum over all texels, times and bytes."""

import dataclasses
import math
import statistics
import timeit
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxprt import require, visibility
from jaxprt.brdf import grid
from jaxprt.brdf.varying import PerVertex
from jaxprt.relit import refinement
from jaxprt.relit.channels import Shading
from jaxprt.relit.exact import exact_pixels
from jaxprt.relit.exact_lamps import Lamps
from jaxprt.scene import Environment, Mesh, Scene, builtin
from jaxprt.scene.camera import orbit
from jaxprt.scene.mesh import bounds
from jaxprt.scene.scene import centered
from jaxprt.systems import protocol, reference

POINTS = 1350  # number of points, of all parts together, whose exact radiance is computed
FEWEST = 100  # smallest number of points of one part
_PICTURE = 192  # edge of the measured pictures in pixels
_PIXELS = 120  # number of pixels that are measured in each picture


class PartReport(NamedTuple):
    """Errors and size of one part of a scene, in direct light.

    Attributes:
        name: Name of the part.
        vertices: Number of its vertices.
        errors: Relative L2 error of its pixels under each light; NaN if no picture shows it.
        vertex_errors: Relative L2 error of the radiance of its vertices under each light.
        nbytes: Size of its transport and BRDF in bytes.
    """

    name: str
    vertices: int
    errors: tuple[float, ...]
    vertex_errors: tuple[float, ...]
    nbytes: int


class Report(NamedTuple):
    """Errors, times and size of a precomputed scene; `print` shows it as a table.

    Attributes:
        part: One entry for each part of the scene.
        errors: Relative L2 error of the pictures under each light.
        uncertainty: Estimated relative L2 error of the reference pixels under each light.
        light_seconds: Time of a new light for all vertices on this machine.
        view_seconds: Time of a new view for all vertices on this machine.
        interpolation_error: Relative L2 error of pictures by visibility that is interpolated between vertices, as
            `jaxprt.refine` estimates it.
        nbytes: Size of all transport and BRDFs in bytes.
    """

    part: tuple[PartReport, ...]
    errors: tuple[float, ...]
    uncertainty: tuple[float, ...]
    interpolation_error: float
    light_seconds: float
    view_seconds: float
    nbytes: int

    def __str__(self) -> str:
        """The table, with one row for each part."""
        rows = [
            f"{part.name}: {part.vertices} vertices, {part.nbytes / 1e6:.2f} MB, pixels off by "
            f"{_percent(part.errors)}, vertices by {_percent(part.vertex_errors)}"
            for part in self.part
        ]
        rows.append(f"pictures off by {_percent(self.errors)}, measured to {_percent(self.uncertainty)}")
        rows.append(f"visibility between vertices off by {_percent([self.interpolation_error])}")
        times = f"{1e3 * self.light_seconds:.1f} ms for a new light, {1e3 * self.view_seconds:.1f} ms for a new view"
        return "\n".join([*rows, f"in all: {self.nbytes / 1e6:.2f} MB, {times}"])


def _percent(errors: Sequence[float]) -> str:
    return ", ".join("-" if math.isnan(error) else f"{100 * error:.1f} %" for error in errors)


def measure(scene: Any, environments: Sequence[Environment]) -> Report:
    """Measures a scene against the exact sum: pixels of pictures, and a sample of its vertices from eight views.

    Args:
        scene: The relit scene, with its origin at zero. Times and bytes include bounces; errors are of direct light.
        environments: Environments of one size.
    """
    size, mesh, shadings = check_lights(environments, 1.0, 1.0), scene.mesh, scene.shading
    for light in environments:
        protocol.light_for(scene, light)
    lamps = Lamps.of(centered(scene.scene), shadings)
    direct, views = scene.without_bounces(), views_around(mesh)
    seen = [direct.view(jnp.asarray(eye)) for eye in views]
    lit = [direct.shade(direct.light(light)) for light in environments]
    color = np.stack([[np.asarray(direct.combine(light, view)) for view in seen] for light in lit])
    pixels = _pictures(direct.picture, scene.camera, scene.scene, shadings, environments)
    parts, first = [], 0
    for number, (part, shading) in enumerate(zip(scene.scene.parts, shadings, strict=True)):
        count = len(part.mesh.position)
        few = max(FEWEST, round(POINTS * count / len(mesh.position)))
        vertex = np.sort(np.random.default_rng(1).permutation(count)[:few])
        visible = visibility.precompute(
            shading.mesh, size=size, occluder=mesh, vertex=vertex, run=visibility.Run(progress=False)
        )
        index = np.arange(len(vertex))
        brdf = exact_brdf(shading, vertex)
        exact = _exact(visible, index, brdf, environments, views)
        if lamps.lamp:
            exact += np.stack([lamps.at_vertices(shading.mesh, brdf, vertex, jnp.asarray(eye)) for eye in views])
        facing, now = _facing(visible, index, views), color[:, :, first + vertex]
        if shading.emitted is not None:
            now = now - np.asarray(shading.emitted)[vertex]
        pairs = zip(np.broadcast_to(now, exact.shape), exact, strict=True)
        vertex_errors = tuple(relative_error(a[facing], b[facing]) for a, b in pairs)
        shown = tuple(pixels[1][:, number])
        nbytes = protocol.memory(scene.part_system(number))
        parts.append(PartReport(part.name, count, shown, vertex_errors, nbytes))
        first += count

    def arriving():
        return scene.shade(scene.light(environments[0]))

    def view():
        return scene.view(jnp.asarray(views[0]))

    arrived, viewed = arriving(), view()
    new_light, new_view = (
        seconds(lambda: scene.combine(arriving(), viewed)),
        seconds(lambda: scene.combine(arrived, view())),
    )
    between = refinement.interpolation_error(scene.scene)
    return Report(tuple(parts), tuple(pixels[0]), tuple(pixels[2]), between, new_light, new_view, scene.nbytes)


def _pictures(picture, camera, scene, shadings, environments) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors of pictures [light], errors of their parts [light, part], and errors of the reference pixels [light]."""
    around = [orbit(scene.mesh, azimuth=turn, elevation=0.4) for turn in (2.2, 4.4)]
    wrong, right, unsure = (np.zeros((len(environments), len(scene.parts))) for _ in range(3))
    for view in (camera, *around):
        small = dataclasses.replace(view, width=_PICTURE, height=_PICTURE)
        exact = exact_pixels(scene, shadings, environments, small, pixels=_PIXELS)
        for number, light in enumerate(environments):
            off = np.asarray(picture(light, small)).reshape(_PICTURE**2, -1)[exact.pixel] - exact.color[number]
            for part in range(len(scene.parts)):
                pixel = exact.part == part
                wrong[number, part] += np.sum(off[pixel] ** 2)
                right[number, part] += np.sum(exact.color[number][pixel] ** 2)
            unsure[number, 0] += exact.error[number] ** 2 * np.sum(exact.color[number] ** 2)
    whole = np.maximum(right.sum(1), np.finfo(float).tiny)
    with np.errstate(invalid="ignore", divide="ignore"):
        parts = np.sqrt(wrong / right)  # NaN for parts that no picture shows
    return np.sqrt(wrong.sum(1) / whole), parts, np.sqrt(unsure.sum(1) / whole)


def lights_of(scene: Scene) -> tuple[Environment, ...]:
    """The environments of the scene, or the two built-in ones if it has none."""
    return scene.environments or (builtin.daylight(), builtin.studio())


def check_lights(environments: Sequence[Environment], error: float, rate: float) -> int:
    """Refuses invalid environments, errors and frame rates; returns the edge of the environments' faces in texels."""
    if not isinstance(environments, Sequence) or isinstance(environments, str | bytes):
        raise TypeError(f"environments must be a list of lights, got one {type(environments).__name__}")
    if not environments:
        raise ValueError("environments must be at least one, got none")
    for number, light in enumerate(environments):
        require.kind(f"environment {number}", light, Environment, source="jaxprt.load_environment")
        require.colors(f"environment {number}", light.radiance)
    shapes = sorted({str(list(light.radiance.shape)) for light in environments})
    if len(shapes) != 1 or environments[0].radiance.ndim != 4:
        raise ValueError(f"environments must all have the same size [6, n, n, c], got {', '.join(shapes)}")
    for number, light in enumerate(environments):
        require.finite(f"the radiance of environment {number}", light.radiance)
    for name, value in (("error", error), ("rate", rate)):
        if isinstance(value, bool) or not isinstance(value, int | float | np.number) or not 0 < value < math.inf:
            raise ValueError(f"{name} must be positive and finite, got {value!r}")
    return environments[0].radiance.shape[1]


def views_around(mesh: Mesh) -> Float[np.ndarray, "w 3"]:
    """Eight positions of a viewer around the mesh, at two heights."""
    low, high = bounds(mesh)
    turn, rise = np.pi / 4 * np.arange(8), np.resize([0.2, 0.7], 8)
    around = np.stack([np.sin(turn) * np.cos(rise), np.sin(rise), np.cos(turn) * np.cos(rise)], -1)
    return ((low + high) / 2 + 1.6 * np.linalg.norm(high - low) * around).astype(np.float32)


def _facing(visible, index: np.ndarray, views: np.ndarray) -> np.ndarray:
    """Which of some vertices face each view, [view, vertex]."""
    normal, position = np.asarray(visible.frame)[index, 2], np.asarray(visible.position)[index]
    return np.einsum("vi,wvi->wv", normal, views[:, None] - position) > 0


def relative_error(now: np.ndarray, exact: np.ndarray) -> float:
    """Relative L2 error; infinite if the value contains NaN."""
    wrong, whole = (float(np.linalg.norm(color)) for color in (now - exact, exact))
    return float(np.nan_to_num(wrong, nan=np.inf)) / (whole if whole > 0 else 1.0)


def exact_brdf(shading: Shading, vertex: np.ndarray) -> Callable:
    """The exact BRDF of some vertices."""
    exact = shading.exact
    return PerVertex(exact.of(jnp.asarray(vertex))) if isinstance(exact, PerVertex) else grid.as_argument(exact)


def _exact(visible, index: np.ndarray, brdf: Callable, environments, views: np.ndarray) -> np.ndarray:
    """Radiance [light, view, vertex, color] of some vertices, summed over all texels."""
    batch = Environment(jnp.stack([light.radiance for light in environments]))
    seen, position, frame = jnp.asarray(visible.seen(index)), visible.position[index], visible.frame[index]
    exact = np.stack([reference.integrate(seen, position, frame, brdf, batch, jnp.asarray(eye)) for eye in views], 1)
    require.finite("the radiance that the BRDF reflects, by light, view, vertex and color,", exact)
    return exact


def seconds(function: Callable) -> float:
    """Median time of five calls in seconds, without compilation."""
    jax.block_until_ready(function())
    return statistics.median(timeit.repeat(lambda: jax.block_until_ready(function()), number=1, repeat=5))
