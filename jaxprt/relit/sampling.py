"""Measures recipes: runs them for some vertices of a part, and compares radiance at points on the triangles between."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxprt import require, visibility
from jaxprt.brdf import grid
from jaxprt.brdf.varying import PerVertex
from jaxprt.relit import channels, groups
from jaxprt.relit.channels import Shading
from jaxprt.relit.measuring import FEWEST, POINTS, relative_error, seconds
from jaxprt.relit.recipes import Known, Recipe, Target
from jaxprt.scene import Environment, Mesh, Part
from jaxprt.scene.mesh import frames
from jaxprt.scene.points import Points, placed
from jaxprt.systems import protocol, reference
from jaxprt.systems.protocol import Blend, System
from jaxprt.visibility import Run, members

MEMBERS = 225  # number of vertices in a cluster
_CLUSTERS = 24  # number of measured clusters, of all parts together: errors differ much between clusters


class Candidate(eqx.Module):
    """Error and cost of one recipe for one group, measured on a sample.

    Attributes:
        recipe: The recipe.
        error: Relative L2 error of radiance under the worst of the lights.
        seconds: Time of a frame with a new light and a new view on this machine, without rasterization.
        nbytes: Size of transport and BRDF in bytes.
        precompute_seconds: Time of precomputation on this machine. What candidates share, other than tracing rays, is
            counted only for the first.
    """

    recipe: Any
    error: float
    seconds: float
    nbytes: int
    precompute_seconds: float

    def __str__(self) -> str:
        """One row of the plan's table."""
        sizes = ", ".join(f"{name} {value:g}" for name, value in vars(self.recipe).items())
        cost = f"{1e3 * self.seconds:7.1f} ms {self.nbytes / 1e6:8.2f} MB {self.precompute_seconds:7.0f} s"
        return f"{100 * self.error:6.1f} % {cost}   {type(self.recipe).__name__}({sizes})"


@dataclasses.dataclass(frozen=True)
class Sample:
    """Some vertices of a group of parts, points on the triangles between them, and the points' reference radiance.

    Attributes:
        shading: Mesh, BRDF and channel weights of the part.
        target: The vertices of the sample, and their visibility.
        vertex_ratio: Number of vertices of the part, divided by that of the sample.
        points: Points at which recipes are compared. Their corners are indices into the vertices of the sample.
        blend: Material weights at the points; None for a part with a BRDF that cannot change.
        facing: Which points face each view.
        exact: Reference radiance of the points, with the visibility interpolated from the corners of their triangles.
        mesh_error: Relative L2 error of the reference due to interpolated visibility, under the worst light. It comes
            from shadows that are finer than the triangles.
        environments: The environments of the comparison.
        views: Positions of the viewers.
        rays_seconds: Time to trace the visibility of the vertices.
    """

    shading: Shading
    target: Target
    vertex_ratio: float
    points: Points
    blend: Blend | None
    facing: np.ndarray
    exact: np.ndarray
    mesh_error: float
    environments: tuple[Environment, ...]
    views: np.ndarray
    rays_seconds: float

    @classmethod
    def make(
        cls,
        parts: Sequence[Part],
        shadings: Sequence[Shading],
        scene: Mesh,
        total: int,
        size: int,
        environments: Sequence[Environment],
        views: np.ndarray,
    ) -> "Sample":
        """Chooses whole clusters of vertices, traces their visibility, and computes the reference radiance.

        Args:
            parts: The parts of a group.
            shadings: The `Shading` of each of them.
            scene: The mesh of all parts of the scene.
            total: Number of its vertices.
            size: Edge of the lights' cubemap faces in texels.
            environments: The lights.
            views: Positions of the viewers.
        """
        shading = groups.joined(shadings)
        mesh = shading.mesh
        count = len(mesh.position)
        clusters = max(1, round(count / MEMBERS))
        member = members.cluster(mesh.position, mesh.normal, clusters=clusters)
        some = min(clusters, max(2, round(_CLUSTERS * count / total)))
        vertex = np.unique(member[np.random.default_rng(0).permutation(clusters)[:some]])
        quiet, start = Run(progress=False), time.perf_counter()
        visible = visibility.precompute(mesh, size=size, occluder=scene, vertex=vertex, run=quiet)
        seconds = time.perf_counter() - start
        few = max(FEWEST, round(POINTS * count / total))
        points = _scatter(mesh, vertex, few)
        target = Target(scene, size=size, vertex=vertex, known=Known(visible), run=quiet)
        whole = Points(jnp.asarray(vertex)[points.corner], points.weight)
        blend, brdf = channels.materials_at(parts, shading, whole)
        level = points.carry(jnp.asarray(visible.seen(np.arange(len(vertex))), jnp.float32))
        seen = np.asarray(jnp.round(level)).astype(np.uint8)
        facing, exact, mesh_error = _exact(mesh, brdf, whole, seen, scene, environments, views)
        ratio, lights = count / len(vertex), tuple(environments)
        return cls(shading, target, ratio, points, blend, facing, exact, mesh_error, lights, views, seconds)

    def alone(self, part: Part, shading: Shading) -> "Sample | None":
        """The sample of the group's only part with a BRDF of its own; None if that varies over the surface."""
        if shading.knot or shading.matte:
            return None
        vertex, corner = self.target.vertex, self.points.corner
        whole = Points(corner if vertex is None else jnp.asarray(vertex)[corner], self.points.weight)
        blend, _ = channels.materials_at([part], shading, whole)
        return dataclasses.replace(self, shading=shading, blend=blend)

    def least_bytes(self, recipe: Any) -> int:
        """Smallest number of bytes that a recipe needs for the whole part."""
        count = len(self.shading.mesh.position)
        return recipe.least_bytes(self.shading, vertices=count, size=self.target.size)

    def measure(self, recipe: Recipe) -> Candidate:
        """Runs a recipe on the sample and measures its error and cost."""
        start = time.perf_counter()
        system = recipe.make(self.shading, self.target)
        seconds = self.vertex_ratio * (self.rays_seconds + time.perf_counter() - start)
        wrong = max(self._error(system, *pair) for pair in zip(self.environments, self.exact, strict=True))
        return Candidate(recipe, wrong, self._frame(system), _bytes(system, self.vertex_ratio), seconds)

    def _error(self, system: System, light: Environment, exact: np.ndarray) -> float:
        """Relative L2 error over all views, at points that face the viewer."""
        lit = system.light(light)
        views = (system.view(jnp.asarray(eye), self.blend, self.points) for eye in self.views)
        now = np.stack([np.asarray(system.combine(lit, view, self.points)) for view in views])
        return relative_error(np.broadcast_to(now, exact.shape)[self.facing], exact[self.facing])

    def _frame(self, system: System) -> float:
        """Seconds of a frame of the whole part. The time of a light that all vertices share is not scaled."""
        light, eye = self.environments[0], jnp.asarray(self.views[0])
        whole, vertex = self.shading.blend, self.target.vertex
        blend = None if whole is None else jax.tree.map(lambda column: column[vertex], whole)
        lit, view = system.light(light), system.view(eye, blend)
        once = seconds(lambda: system.light(light))
        rest = seconds(lambda: system.view(eye, blend)) + seconds(lambda: system.combine(lit, view))
        return once * (self.vertex_ratio if system.shared_light is None else 1) + self.vertex_ratio * rest


def _scatter(mesh: Mesh, vertex: np.ndarray, count: int) -> Points:
    """Random points, uniform by area, on the triangles between some vertices. Corners are indices into these."""
    number = np.full(len(mesh.position), -1)
    number[vertex] = np.arange(len(vertex))
    corner = number[np.asarray(mesh.face)]
    corner = corner[np.all(corner >= 0, 1)]
    a, b, c = np.asarray(mesh.position, np.float64)[vertex[corner]].swapaxes(0, 1)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    random = np.random.default_rng(1)
    if not len(corner) or not area.sum() > 0:
        # No triangle has all its corners among the vertices: use the vertices as points.
        alone = random.integers(len(vertex), size=count)
        corner, chosen = np.repeat(alone[:, None], 3, 1), np.arange(count)
    else:
        chosen = random.choice(len(corner), count, p=area / area.sum())
    weight = random.dirichlet(np.ones(3), count).astype(np.float32)
    return Points(jnp.asarray(corner[chosen].T), jnp.asarray(weight.T))


def _exact(
    mesh: Mesh,
    brdf: Callable,
    points: Points,
    visible: np.ndarray,
    scene: Mesh,
    environments: Sequence[Environment],
    views: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Which points face each view, their radiance [light, view, point, color], and the error of `visible`."""
    position, frame = placed(mesh.position, jnp.asarray(frames(mesh.normal, mesh.tangent)), points)
    toward = views[:, None] - np.asarray(position)
    facing = np.einsum("vi,wvi->wv", np.asarray(frame)[:, 2], toward) > 0
    brdf = brdf if isinstance(brdf, PerVertex) else grid.as_argument(brdf)
    batch = Environment(jnp.stack([light.radiance for light in environments]))
    rays = visibility.Occluder(scene)
    start, normal = visibility.point_starts(mesh, points), np.asarray(frame[:, 2], np.float32)
    traced, _ = visibility.fractional(rays, start, normal, size=batch.radiance.shape[-2])

    def radiance(seen: np.ndarray) -> np.ndarray:
        integrand = jnp.asarray(seen), position, frame, brdf, batch
        return np.stack([reference.integrate(*integrand, jnp.asarray(eye)) for eye in views], 1)

    exact, true = radiance(visible), radiance(traced)
    require.finite("the radiance that the BRDF reflects, by light, view, point and color,", exact)
    # Relative L2 between radiance with `visible` and with rays traced from the points, under the worst light.
    return facing, exact, max(relative_error(a[facing], b[facing]) for a, b in zip(exact, true, strict=True))


def _bytes(system: System, vertex_ratio: float) -> int:
    """Bytes of a system with `vertex_ratio` times as many vertices."""
    grown = sum({id(leaf): leaf.nbytes for leaf in jax.tree.leaves(system.growing)}.values())
    return int(protocol.memory(system) - grown + vertex_ratio * grown)
