"""Scenes and recipes measured on samples of their vertices: errors by the exact sum, times and bytes."""

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
from jaxprt.relit.channels import Shading
from jaxprt.relit.recipes import Known, Recipe, Target
from jaxprt.scene import Environment, Mesh, Scene, builtin
from jaxprt.scene.mesh import bounds
from jaxprt.systems import protocol, reference, separable
from jaxprt.systems.bright_texels import BrightTexels
from jaxprt.systems.protocol import Blend, Joined, System

MEMBERS = 225  # vertices in a cluster
_CLUSTERS = 24  # of all parts together that are measured: of the bunny, half of the squared error is in an eighth
_JUDGED = 1350  # vertices of all parts together whose exact radiance is summed
_FEWEST = 100  # of one part


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
    """How one part of a scene does: relative L2 error of its radiance under each light, its vertices and bytes."""

    name: str
    vertices: int
    errors: tuple[float, ...]
    nbytes: int


class Report(NamedTuple):
    """How a scene that was made ready does; `print` shows it as a table.

    Attributes:
        part: One entry for each part of the scene.
        light_seconds: Time of a new light on this machine.
        view_seconds: Time of a new view on this machine.
        nbytes: Size of all transport and BRDFs in bytes.
    """

    part: tuple[PartReport, ...]
    light_seconds: float
    view_seconds: float
    nbytes: int

    def __str__(self) -> str:
        """One row for each part."""
        rows = [
            f"{each.name}: {each.vertices} vertices, {each.nbytes / 1e6:.2f} MB, off by "
            + ", ".join(f"{100 * error:.1f} %" for error in each.errors)
            for each in self.part
        ]
        times = f"{1e3 * self.light_seconds:.1f} ms for a new light, {1e3 * self.view_seconds:.1f} ms for a new view"
        return "\n".join([*rows, f"in all: {self.nbytes / 1e6:.2f} MB, {times}"])


def measure(
    direct: Joined,
    system: System,
    scene: Scene,
    shadings: Sequence[Shading],
    environments: Sequence[Environment],
) -> Report:
    """Measures the parts of a scene against the exact sum, on a sample of their vertices, from eight views.

    Args:
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
        errors = tuple(_relative(a[facing], b[facing]) for a, b in pairs)
        parts.append(PartReport(part.name, count, errors, protocol.memory(each)))
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
    return Report(tuple(parts), new_light, new_view, protocol.memory(system))


def lights_of(scene: Scene) -> tuple[Environment, ...]:
    """The scene's lights, or the two embedded ones."""
    return scene.environments or (builtin.daylight(), builtin.studio())


@dataclasses.dataclass(frozen=True)
class Sample:
    """Some vertices of a part, and what is known of them.

    Attributes:
        shading: The part.
        target: Which vertices, and what they see.
        vertex_ratio: How many times as many the part has.
        judged: Which of them are judged.
        facing: Which of the judged ones face each view.
        exact: Their exact radiance.
        environments: Under these lights.
        views: From these places.
        rays_seconds: What tracing took.
    """

    shading: Shading
    target: Target
    vertex_ratio: float
    judged: np.ndarray
    facing: np.ndarray
    exact: np.ndarray
    environments: tuple[Environment, ...]
    views: np.ndarray
    rays_seconds: float

    @classmethod
    def make(cls, shading: Shading, scene: Mesh, total: int, size: int, environments, views: np.ndarray) -> "Sample":
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
        judged = np.sort(np.random.default_rng(1).permutation(len(vertex))[:few])
        target = Target(scene, size=size, vertex=vertex, known=Known(visible), progress=False)
        facing = _facing(visible, judged, views)
        exact = _exact(visible, judged, _exact_brdf(shading, vertex[judged]), environments, views)
        vertex_ratio = count / len(vertex)
        return cls(shading, target, vertex_ratio, judged, facing, exact, tuple(environments), views, seconds)

    @property
    def blend(self) -> Blend | None:
        """What the sampled vertices are made of."""
        whole, vertex = self.shading.blend, self.target.vertex
        return None if whole is None else jax.tree.map(lambda each: each[vertex], whole)

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
        """Relative L2 error over all views, as far as vertices face the viewer."""
        lit = system.shade(system.light(light), self.blend)
        views = (system.view(jnp.asarray(eye), self.blend) for eye in self.views)
        now = np.stack([np.asarray(system.combine(lit, view))[self.judged] for view in views])
        return _relative(np.broadcast_to(now, exact.shape)[self.facing], exact[self.facing])

    def _frame(self, system: System) -> float:
        """Seconds of a frame of the whole part. A light that all vertices share does not grow with them."""
        light, eye = self.environments[0], jnp.asarray(self.views[0])
        lit, view = system.light(light), system.view(eye, self.blend)
        once = _seconds(lambda: system.light(light))
        rest = _seconds(lambda: system.view(eye, self.blend)) + _seconds(lambda: system.combine(lit, view))
        return once * (self.vertex_ratio if system.shared_light is None else 1) + self.vertex_ratio * rest


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
