"""Scenes and recipes measured: errors of pictures by the exact sum, times and bytes.

A recipe is carried out for some vertices of a part, and judged at points of the triangles between them. A scene that is
ready is judged by pixels of its pictures, and by its vertices.
"""

import dataclasses
import math
import statistics
import time
import timeit
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt import require, visibility
from jaxprt.brdf import grid
from jaxprt.brdf.varying import PerVertex
from jaxprt.relit.channels import Shading, at_points, exact_at
from jaxprt.relit.exact import exact_pixels
from jaxprt.relit.recipes import Known, Recipe, Target
from jaxprt.scene import Camera, Environment, Mesh, Part, Scene, builtin
from jaxprt.scene.camera import orbit
from jaxprt.scene.mesh import bounds
from jaxprt.scene.points import Points, placed
from jaxprt.sphere import directions
from jaxprt.systems import protocol, reference, separable
from jaxprt.systems.bright_texels import BrightTexels
from jaxprt.systems.protocol import Blend, Joined, System

MEMBERS = 225  # vertices in a cluster
_CLUSTERS = 24  # of all parts together that are measured: of the bunny, half of the squared error is in an eighth
_JUDGED = 1350  # points of all parts together whose exact radiance is summed
_FEWEST = 100  # of one part
_PICTURE = 192  # edge of the pictures that are judged
_PIXELS = 120  # of each picture


class Candidate(eqx.Module):
    """What one recipe brings and costs for one part, measured on a sample.

    Attributes:
        recipe: The recipe.
        error: Relative L2 error of radiance, under the worst of the lights.
        seconds: Time of a frame with new light and new view on this machine, without drawing.
        nbytes: Size of transport and BRDF in bytes.
        precompute_seconds: Time of precomputation on this machine, without what candidates share.
    """

    recipe: Any
    error: float
    seconds: float
    nbytes: int
    precompute_seconds: float

    def __str__(self) -> str:
        """One row of the table."""
        sizes = ", ".join(f"{name} {value:g}" for name, value in vars(self.recipe).items())
        cost = f"{1e3 * self.seconds:7.1f} ms {self.nbytes / 1e6:8.2f} MB {self.precompute_seconds:7.0f} s"
        return f"{100 * self.error:6.1f} % {cost}   {type(self.recipe).__name__}({sizes})"


class PartReport(NamedTuple):
    """How one part of a scene does in direct light.

    Attributes:
        name: Of the part.
        vertices: Their number.
        errors: Relative L2 error of its pixels under each light.
        vertex_errors: Relative L2 error of the radiance of its vertices under each light.
        nbytes: Size of transport and BRDF in bytes.
    """

    name: str
    vertices: int
    errors: tuple[float, ...]
    vertex_errors: tuple[float, ...]
    nbytes: int


class Report(NamedTuple):
    """How a scene that was made ready does; `print` shows it as a table.

    Attributes:
        part: One entry for each part of the scene.
        errors: Relative L2 error of the pictures under each light.
        uncertainty: How much of that the exact pixels themselves may be off by.
        light_seconds: Time of a new light for all vertices on this machine.
        view_seconds: Time of a new view for all vertices on this machine.
        nbytes: Size of all transport and BRDFs in bytes.
    """

    part: tuple[PartReport, ...]
    errors: tuple[float, ...]
    uncertainty: tuple[float, ...]
    light_seconds: float
    view_seconds: float
    nbytes: int

    def __str__(self) -> str:
        """One row for each part."""
        rows = [
            f"{each.name}: {each.vertices} vertices, {each.nbytes / 1e6:.2f} MB, pixels off by "
            f"{_percent(each.errors)}, vertices by {_percent(each.vertex_errors)}"
            for each in self.part
        ]
        rows.append(f"pictures off by {_percent(self.errors)}, measured to {_percent(self.uncertainty)}")
        times = f"{1e3 * self.light_seconds:.1f} ms for a new light, {1e3 * self.view_seconds:.1f} ms for a new view"
        return "\n".join([*rows, f"in all: {self.nbytes / 1e6:.2f} MB, {times}"])


def _percent(errors: Sequence[float]) -> str:
    return ", ".join("-" if math.isnan(each) else f"{100 * each:.1f} %" for each in errors)


def measure(
    picture: Callable[[Environment, Camera], Array],
    camera: Camera,
    direct: Joined,
    system: System,
    scene: Scene,
    shadings: Sequence[Shading],
    environments: Sequence[Environment],
) -> Report:
    """Measures a scene against the exact sum: pixels of pictures, and a sample of its vertices from eight views.

    Args:
        picture: Draws the scene in direct light.
        camera: From where it is looked at; two more stand on other sides of it.
        direct: The systems of all parts, whose radiance is that of direct light.
        system: The system whose bytes and times are reported, with bounces if there are any.
        scene: The scene.
        shadings: What its parts are to systems.
        environments: Lights of one size.
    """
    size, mesh = checked(environments, 1.0, 1.0), scene.mesh
    views, blends = views_around(mesh), [each.blend for each in shadings]
    seen = [direct.view(jnp.asarray(eye), blends) for eye in views]
    lit = [direct.light(each) for each in environments]
    color = np.stack([[np.asarray(direct.combine(light, view)) for view in seen] for light in lit])
    pixels = _pictures(picture, camera, scene, shadings, environments)
    parts, first = [], 0
    for part, shading, each in zip(scene.parts, shadings, direct.part, strict=True):
        count = len(part.mesh.position)
        few = max(_FEWEST, round(_JUDGED * count / len(mesh.position)))
        vertex = np.sort(np.random.default_rng(1).permutation(count)[:few])
        visible = visibility.precompute(shading.mesh, size=size, occluder=mesh, vertex=vertex, progress=False)
        judged = np.arange(len(vertex))
        exact = _exact(visible, judged, _exact_brdf(shading, vertex), environments, views)
        facing, now = _facing(visible, judged, views), color[:, :, first + vertex]
        pairs = zip(np.broadcast_to(now, exact.shape), exact, strict=True)
        vertex_errors = tuple(_relative(a[facing], b[facing]) for a, b in pairs)
        shown = tuple(pixels[1][:, len(parts)])
        parts.append(PartReport(part.name, count, shown, vertex_errors, protocol.memory(each)))
        first += count

    def arriving():
        return system.shade(system.light(environments[0]), blends)

    def view():
        return system.view(jnp.asarray(views[0]), blends)

    arrived, viewed = arriving(), view()
    new_light, new_view = (
        _seconds(lambda: system.combine(arriving(), viewed)),
        _seconds(lambda: system.combine(arrived, view())),
    )
    return Report(tuple(parts), tuple(pixels[0]), tuple(pixels[2]), new_light, new_view, protocol.memory(system))


def _pictures(picture, camera, scene, shadings, environments) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors of pictures from three sides [light], of their parts [light, part], and of the yardstick [light]."""
    around = [orbit(scene.mesh, azimuth=turn, elevation=0.4) for turn in (2.2, 4.4)]
    wrong, right, unsure = (np.zeros((len(environments), len(scene.parts))) for _ in range(3))
    for each in (camera, *around):
        small = dataclasses.replace(each, width=_PICTURE, height=_PICTURE)
        exact = exact_pixels(scene, shadings, environments, small, pixels=_PIXELS)
        for number, light in enumerate(environments):
            off = np.asarray(picture(light, small)).reshape(_PICTURE**2, -1)[exact.pixel] - exact.color[number]
            for part in range(len(scene.parts)):
                own = exact.part == part
                wrong[number, part] += np.sum(off[own] ** 2)
                right[number, part] += np.sum(exact.color[number][own] ** 2)
            unsure[number, 0] += exact.error[number] ** 2 * np.sum(exact.color[number] ** 2)
    whole = np.maximum(right.sum(1), np.finfo(float).tiny)
    with np.errstate(invalid="ignore", divide="ignore"):
        parts = np.sqrt(wrong / right)  # NaN for parts that no picture shows
    return np.sqrt(wrong.sum(1) / whole), parts, np.sqrt(unsure.sum(1) / whole)


def lights_of(scene: Scene) -> tuple[Environment, ...]:
    """The scene's lights, or the two embedded ones."""
    return scene.environments or (builtin.daylight(), builtin.studio())


@dataclasses.dataclass(frozen=True)
class Sample:
    """Some vertices of a part, points on the triangles between them, and what is known of both.

    Attributes:
        shading: The part, as systems take it.
        target: Which vertices, and what they see.
        vertex_ratio: How many times as many the part has.
        points: Where recipes are judged, numbered as the vertices of the sample are.
        blend: What the points are made of.
        facing: Which of the points face each view.
        exact: Their exact radiance.
        environments: Under these lights.
        views: From these places.
        rays_seconds: What tracing the vertices took.
    """

    shading: Shading
    target: Target
    vertex_ratio: float
    points: Points
    blend: Blend | None
    facing: np.ndarray
    exact: np.ndarray
    environments: tuple[Environment, ...]
    views: np.ndarray
    rays_seconds: float

    @classmethod
    def make(
        cls, part: Part, shading: Shading, scene: Mesh, total: int, size: int, environments, views: np.ndarray
    ) -> "Sample":
        """Traces and sums for whole clusters of vertices, a share of all that are measured."""
        mesh = shading.mesh
        count = len(mesh.position)
        clusters = max(1, round(count / MEMBERS))
        member = separable.clustered.cluster(mesh.position, mesh.normal, clusters=clusters)
        some = min(clusters, max(2, round(_CLUSTERS * count / total)))
        vertex = np.unique(member[np.random.default_rng(0).permutation(clusters)[:some]])
        start = time.perf_counter()
        visible = visibility.precompute(mesh, size=size, occluder=scene, vertex=vertex, progress=False)
        seconds = time.perf_counter() - start
        few = max(_FEWEST, round(_JUDGED * count / total))
        points = _scattered(mesh, vertex, few)
        target = Target(scene, size=size, vertex=vertex, known=Known(visible), progress=False)
        whole = Points(jnp.asarray(vertex)[points.corner], points.weight)
        blend = at_points(part, shading, None, whole).blend
        facing, exact = _judged(part, shading, whole, scene, environments, views)
        ratio = count / len(vertex)
        return cls(shading, target, ratio, points, blend, facing, exact, tuple(environments), views, seconds)

    def least_bytes(self, recipe: Any) -> int:
        """Bytes that a recipe has at least for the whole part."""
        count = len(self.shading.mesh.position)
        return recipe.least_bytes(self.shading, vertices=count, size=self.target.size)

    def measure(self, recipe: Recipe) -> Candidate:
        """What a recipe brings and costs."""
        start = time.perf_counter()
        system = recipe.make(self.shading, self.target)
        seconds = self.vertex_ratio * (self.rays_seconds + time.perf_counter() - start)
        wrong = max(self._error(system, *each) for each in zip(self.environments, self.exact, strict=True))
        return Candidate(recipe, wrong, self._frame(system), _bytes(system, self.vertex_ratio), seconds)

    def _error(self, system: System, light: Environment, exact: np.ndarray) -> float:
        """Relative L2 error over all views, as far as points face the viewer."""
        lit, placed = system.light(light), system.at(self.points)
        views = (placed.view(jnp.asarray(eye), self.blend) for eye in self.views)
        now = np.stack([np.asarray(placed.combine(lit, view)) for view in views])
        return _relative(np.broadcast_to(now, exact.shape)[self.facing], exact[self.facing])

    def _frame(self, system: System) -> float:
        """Seconds of a frame of the whole part. A light that all vertices share does not grow with them."""
        light, eye = self.environments[0], jnp.asarray(self.views[0])
        whole, vertex = self.shading.blend, self.target.vertex
        blend = None if whole is None else jax.tree.map(lambda each: each[vertex], whole)
        lit, view = system.light(light), system.view(eye, blend)
        once = _seconds(lambda: system.light(light))
        rest = _seconds(lambda: system.view(eye, blend)) + _seconds(lambda: system.combine(lit, view))
        return once * (self.vertex_ratio if system.shared_light is None else 1) + self.vertex_ratio * rest


def _scattered(mesh: Mesh, vertex: np.ndarray, count: int) -> Points:
    """Points by chance on the triangles between some vertices, by area; numbered as these vertices are."""
    number = np.full(len(mesh.position), -1)
    number[vertex] = np.arange(len(vertex))
    corner = number[np.asarray(mesh.face)]
    corner = corner[np.all(corner >= 0, 1)]
    a, b, c = np.asarray(mesh.position, np.float64)[vertex[corner]].swapaxes(0, 1)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    random = np.random.default_rng(1)
    if not len(corner) or not area.sum() > 0:
        # Vertices without triangles among them stand for points.
        alone = random.integers(len(vertex), size=count)
        corner, chosen = np.repeat(alone[:, None], 3, 1), np.arange(count)
    else:
        chosen = random.choice(len(corner), count, p=area / area.sum())
    weight = random.dirichlet(np.ones(3), count).astype(np.float32)
    return Points(jnp.asarray(corner[chosen].T), jnp.asarray(weight.T))


def _judged(
    part: Part, shading: Shading, points: Points, scene: Mesh, environments: Sequence[Environment], views: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Which points face each view, and their exact radiance [light, view, point, color]."""
    mesh = shading.mesh
    position, frame = placed(mesh.position, directions.frame(mesh.normal, mesh.tangent), points)
    toward = views[:, None] - np.asarray(position)
    facing = np.einsum("vi,wvi->wv", np.asarray(frame)[:, 2], toward) > 0
    brdf, _ = exact_at(part, shading, points)
    batch = Environment(jnp.stack([light.radiance for light in environments]))
    rays = visibility.Occluder(scene)
    start, normal = visibility.point_starts(mesh, points, rays), np.asarray(frame[:, 2], np.float32)
    seen, _ = visibility.fractional(rays, start, normal, size=batch.radiance.shape[-2])
    brdf = brdf if isinstance(brdf, PerVertex) else grid.as_argument(brdf)
    each = [reference.integrate(jnp.asarray(seen), position, frame, brdf, batch, jnp.asarray(eye)) for eye in views]
    exact = np.stack(each, 1)
    require.finite("what the BRDF makes of the lights, by light, view, point and color,", exact)
    return facing, exact


def checked(environments: Sequence[Environment], error: float, rate: float) -> int:
    """The size of the lights' faces, if a plan can be made for them."""
    if not isinstance(environments, Sequence):
        raise TypeError(f"environments must be a list of lights, got one {type(environments).__name__}")
    if not environments:
        raise ValueError("environments must be at least one, got none")
    for number, light in enumerate(environments):
        require.kind(f"environment {number}", light, Environment, source="jaxprt.load_environment")
    shapes = sorted({str(list(light.radiance.shape)) for light in environments})
    if len(shapes) != 1 or environments[0].radiance.ndim != 4:
        raise ValueError(f"environments must be of one size [6, n, n, c], got {', '.join(shapes)}")
    for number, light in enumerate(environments):
        require.finite(f"the radiance of environment {number}", light.radiance)
    for name, value in (("error", error), ("rate", rate)):
        if not isinstance(value, int | float | np.number) or not 0 < value < math.inf:
            raise ValueError(f"{name} must be positive and finite, got {value!r}")
    return environments[0].radiance.shape[1]


def views_around(mesh: Mesh) -> Float[np.ndarray, "w 3"]:
    """Eight viewers around the mesh, at two heights."""
    low, high = bounds(mesh)
    turn, rise = np.pi / 4 * np.arange(8), np.resize([0.2, 0.7], 8)
    around = np.stack([np.sin(turn) * np.cos(rise), np.sin(rise), np.cos(turn) * np.cos(rise)], -1)
    return ((low + high) / 2 + 1.6 * np.linalg.norm(high - low) * around).astype(np.float32)


def _facing(visible, judged: np.ndarray, views: np.ndarray) -> np.ndarray:
    """Which of some vertices face each view."""
    normal, position = np.asarray(visible.frame)[judged, 2], np.asarray(visible.position)[judged]
    return np.einsum("vi,wvi->wv", normal, views[:, None] - position) > 0


def _relative(now: np.ndarray, exact: np.ndarray) -> float:
    """Relative L2 error; infinite for NaN."""
    wrong, whole = (float(np.linalg.norm(each)) for each in (now - exact, exact))
    return float(np.nan_to_num(wrong, nan=np.inf)) / (whole if whole > 0 else 1.0)


def _exact_brdf(shading: Shading, vertex: np.ndarray) -> Callable:
    """The BRDF of some vertices."""
    exact = shading.exact
    return PerVertex(exact.of(jnp.asarray(vertex))) if isinstance(exact, PerVertex) else grid.as_argument(exact)


def _exact(visible, judged: np.ndarray, brdf: Callable, environments, views: np.ndarray) -> np.ndarray:
    """Radiance [light, view, vertex, color] of some vertices by all texels."""
    batch = Environment(jnp.stack([light.radiance for light in environments]))
    seen, position, frame = jnp.asarray(visible.seen(judged)), visible.position[judged], visible.frame[judged]
    each = [reference.integrate(seen, position, frame, brdf, batch, jnp.asarray(eye)) for eye in views]
    exact = np.stack(each, 1)
    require.finite("what the BRDF makes of the lights, by light, view, vertex and color,", exact)
    return exact


def _bytes(system: System, vertex_ratio: float) -> int:
    """Bytes of a system of so many times as many vertices."""
    if isinstance(system, BrightTexels):
        transports: list[Array] = jax.tree.leaves((system.system.transport, system.visibility))  # pyright: ignore
    else:
        transports = jax.tree.leaves(system.transport)  # pyright: ignore[reportAttributeAccessIssue]
    grown = sum({id(each): each.nbytes for each in transports}.values())
    return int(protocol.memory(system) - grown + vertex_ratio * grown)


def _seconds(function: Callable) -> float:
    """Median of five calls, compiled before."""
    jax.block_until_ready(function())
    return statistics.median(timeit.repeat(lambda: jax.block_until_ready(function()), number=1, repeat=5))
