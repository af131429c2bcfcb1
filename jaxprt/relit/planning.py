"""An error in, a plan out: for each part of a scene the system and the sizes that meet an error with the fewest bytes.

Recipes of all systems are carried out for a sample of each part's vertices and judged by the exact sum, from eight
views, under every light. Bytes and times are those of the sample, scaled to the part.
"""

import math
import statistics
import time
import timeit
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import tqdm
from jaxtyping import Array, Float

from jaxprt import require, visibility
from jaxprt.brdf import Lambert, grid
from jaxprt.brdf.varying import PerVertex
from jaxprt.relit.channels import Shading, of_part
from jaxprt.relit.recipes import Clusters, Harmonics, Job, Lobes, Recipe
from jaxprt.scene import Environment, Mesh, Scene, builtin
from jaxprt.scene.mesh import bounds
from jaxprt.systems import protocol, reference, separable
from jaxprt.systems.bright_texels import BrightTexels
from jaxprt.systems.protocol import Blend, System

MARGIN = 1.25  # plans are made for an error smaller by this factor: lights and views that they did not see differ
_MEMBERS = 225  # vertices in a cluster
_CLUSTERS = 24  # of all parts together that are measured: of the bunny, half of the squared error is in an eighth
_JUDGED = 1350  # vertices of all parts together whose exact radiance is summed
_FEWEST = 100  # of one part
_PYRAMID, _BITS = 5900, 3072  # least bytes of a vertex of lobes, and of terms with single texels

# Steps up in size, the cheapest first. Terms, resolution, vectors, modes, kept coefficients and texels are in balance.
_DIFFUSE = tuple(Harmonics(degree=degree) for degree in (2, 3, 4, 6, 8))
_HARMONIC = tuple(Harmonics(degree=degree) for degree in (2, 3, 4))
_LOBES = tuple(Lobes(*each) for each in ((2, 4), (4, 8), (8, 16), (12, 16), (16, 32), (24, 64)))
_SIZES = (
    (2, 64, 4, 8, 192, 2),
    (4, 64, 8, 24, 256, 4),
    (8, 64, 8, 32, 384, 4),
    (16, 64, 12, 48, 512, 8),
    (32, 64, 16, 80, 768, 16),
    (48, 64, 16, 96, 1024, 16),
    (64, 64, 24, 128, 1024, 32),
    (96, 96, 32, 192, 1536, 64),
    (128, 96, 48, 256, 1536, 64),
    (192, 96, 64, 384, 2048, 128),
)
_TERMS = tuple(Clusters(*each, members=_MEMBERS) for each in _SIZES)


class Candidate(eqx.Module):
    """What one recipe brings and costs for one part, measured on a sample.

    Attributes:
        recipe: The recipe.
        error: Relative L2 error of radiance, under the worst of the lights.
        seconds: Of a frame with new light and new view on this machine, without drawing.
        nbytes: Of transport and BRDF.
        precompute_seconds: On this machine.
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


class PartPlan(eqx.Module):
    """The plan of one part.

    Attributes:
        name: Name of the part.
        vertices: Number of its vertices.
        chosen: What was chosen.
        considered: All that was measured, in this order.
    """

    name: str
    vertices: int
    chosen: Candidate
    considered: tuple[Candidate, ...]


class Plan(eqx.Module):
    """The plan of a scene; `print` shows its decisions as a table.

    Attributes:
        part: Of each part.
        asked: The error that was asked for.
        rate: Frames per second that were asked for.
        size: Edge of the lights' cubemap faces in texels.
    """

    part: tuple[PartPlan, ...]
    asked: float
    rate: float
    size: int

    @property
    def error(self) -> float:
        """Predicted relative L2 error of the part that is farthest off."""
        return max(each.chosen.error for each in self.part)

    @property
    def seconds(self) -> float:
        """Of a frame with new light and new view on this machine, without drawing."""
        return sum(each.chosen.seconds for each in self.part)

    @property
    def nbytes(self) -> int:
        """Of transport and BRDFs."""
        return sum(each.chosen.nbytes for each in self.part)

    @property
    def recipes(self) -> dict[str, Recipe]:
        """The recipe of each part, for `jaxprt.precompute`."""
        return {each.name: each.chosen.recipe for each in self.part}

    def __str__(self) -> str:
        """The table of what was considered; a star marks what was chosen."""
        rows = [f"error asked {100 * self.asked:g} %, {self.rate:g} frames per second"]
        for part in self.part:
            rows.append(f"{part.name}: {part.vertices} vertices")
            rows += [f"  {'*' if each is part.chosen else ' '} {each}" for each in part.considered]
        total = f"{100 * self.error:.1f} %, {1e3 * self.seconds:.1f} ms a frame, {self.nbytes / 1e6:.2f} MB"
        slow = "" if self.seconds * self.rate <= 1 else f"; slower than the {self.rate:g} frames per second asked for"
        return "\n".join([*rows, f"in all: {total}{slow}"])


def plan(
    scene: Scene,
    *,
    environments: Sequence[Environment] | None = None,
    error: float = 0.05,
    rate: float = 30.0,
    progress: bool = True,
) -> Plan:
    """Chooses for each part of a scene the system that meets an error at a rate with the fewest bytes.

    Of each system the cheapest sizes are taken whose error is below `error` / 1.25. On lights and views that the plan
    did not see the error is then below `error` if they are of the same kind: a plan made under an overcast sky promises
    nothing for a sun. If no system reaches the rate, the fastest one is taken, and the table says so.

    Args:
        scene: The scene.
        environments: Lights that the error must hold for, of one size; the scene's own, or else the two embedded ones.
        error: Relative L2 error of the radiance of the vertices of each part.
        rate: Frames per second with new light and new view, for the scene as a whole, without drawing.
        progress: Whether to show a progress bar.

    Returns:
        The plan, for `jaxprt.precompute(scene, system=plan.recipes)`.

    Raises:
        TypeError: No scene.
        ValueError: No lights, lights of different sizes, NaN or infinity in them or from a BRDF, an error or a rate
            that is not positive and finite, or an error that no system reaches for some part; the message has the best.
    """
    require.kind("the scene", scene, Scene, source="jaxprt.load_scene")
    environments = lights_of(scene) if environments is None else environments
    size = _checked(environments, error, rate)
    mesh, views = scene.mesh, _views(scene.mesh)
    total, parts = len(mesh.position), []
    for part in tqdm.tqdm(scene.parts, desc="plan", unit="part", disable=not progress):
        sample = Sample.make(of_part(part), mesh, total, size, environments, views)
        count = len(part.mesh.position)
        considered = tuple(_considered(sample, error))
        good = [each for each in considered if each.error * MARGIN <= error]
        if not good:
            best = min(considered, key=lambda each: each.error)
            raise ValueError(
                f"error must be at least {best.error * MARGIN:.3g} for part {part.name!r}, which "
                f"{best.recipe} reaches; got {error}"
            )
        fast = [each for each in good if each.seconds * rate <= count / total]
        chosen = min(fast, key=lambda each: each.nbytes) if fast else min(good, key=lambda each: each.seconds)
        parts.append(PartPlan(part.name, count, chosen, considered))
    return Plan(tuple(parts), float(error), float(rate), size)


def lights_of(scene: Scene) -> tuple[Environment, ...]:
    """The scene's lights, or the two embedded ones."""
    return scene.environments or (builtin.daylight(), builtin.studio())


class Sample(eqx.Module):
    """Some vertices of a part, and what is known of them.

    Attributes:
        shading: The part.
        job: Which vertices, and what they see.
        share: How many times as many the part has.
        judged: Which of them are judged.
        facing: Which of the judged ones face each view.
        exact: Their exact radiance.
        environments: Under these lights.
        views: From these places.
        rays_seconds: What tracing took.
    """

    shading: Shading
    job: Job
    share: float
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
        clusters = max(1, round(count / _MEMBERS))
        member = separable.clustered.cluster(mesh.position, mesh.normal, clusters=clusters)
        some = min(clusters, max(2, round(_CLUSTERS * count / total)))
        vertex = np.unique(member[np.random.default_rng(0).permutation(clusters)[:some]])
        start = time.perf_counter()
        visible = visibility.precompute(mesh, size=size, occluder=scene, vertex=vertex, progress=False)
        seconds = time.perf_counter() - start
        few = max(_FEWEST, round(_JUDGED * count / total))
        judged = np.sort(np.random.default_rng(1).permutation(len(vertex))[:few])
        job = Job(scene, size=size, vertex=vertex, visible=visible, progress=False)
        normal, position = np.asarray(visible.frame)[judged, 2], np.asarray(visible.position)[judged]
        facing = np.einsum("vi,wvi->wv", normal, views[:, None] - position) > 0
        exact = _exact(visible, judged, _exact_brdf(shading, vertex[judged]), environments, views)
        share = count / len(vertex)
        return cls(shading, job, share, judged, facing, exact, tuple(environments), views, seconds)

    @property
    def blend(self) -> Blend | None:
        """What the sampled vertices are made of."""
        whole, vertex = self.shading.blend, self.job.vertex
        return None if whole is None else jax.tree.map(lambda each: each[vertex], whole)

    def measure(self, recipe: Recipe) -> Candidate:
        """What a recipe brings and costs."""
        start = time.perf_counter()
        system = recipe.make(self.shading, self.job)
        seconds = self.share * (self.rays_seconds + time.perf_counter() - start)
        wrong = max(self._error(system, *each) for each in zip(self.environments, self.exact, strict=True))
        return Candidate(recipe, wrong, self._frame(system), _bytes(system, self.share), seconds)

    def _error(self, system: System, light: Environment, exact: np.ndarray) -> float:
        """Relative L2 error over all views, as far as vertices face the viewer."""
        lit = system.shade(system.light(light), self.blend)
        views = (system.view(jnp.asarray(eye), self.blend) for eye in self.views)
        now = np.stack([np.asarray(system.combine(lit, view))[self.judged] for view in views])
        now, exact = np.broadcast_to(now, exact.shape)[self.facing], exact[self.facing]
        wrong, whole = (float(np.linalg.norm(each)) for each in (now - exact, exact))
        return float(np.nan_to_num(wrong, nan=np.inf)) / (whole if whole > 0 else 1.0)

    def _frame(self, system: System) -> float:
        """Seconds of a frame of the whole part. A light that all vertices share does not grow with them."""
        light, eye = self.environments[0], jnp.asarray(self.views[0])
        lit, view = system.light(light), system.view(eye, self.blend)
        once = _seconds(lambda: system.light(light))
        rest = _seconds(lambda: system.view(eye, self.blend)) + _seconds(lambda: system.combine(lit, view))
        return once * (self.share if system.shared_light is None else 1) + self.share * rest


def _considered(sample: Sample, error: float):
    """Candidates of each system: by bisection, those around the first step of its ladder that meets the error."""
    if isinstance(sample.shading.brdf, Lambert):
        ladders = [(_DIFFUSE, 0)]
    else:
        ladders = [(_HARMONIC, 0), (_LOBES, _PYRAMID)] + ([] if sample.shading.knot else [(_TERMS, _BITS)])
    fewest = math.inf
    for ladder, least in ladders:
        if least * len(sample.shading.mesh.position) > fewest:
            continue  # Nothing of this system is as small as what meets the error already.
        low, high = 0, len(ladder)
        while low < high:  # Errors fall along a ladder.
            middle = (low + high) // 2
            each = sample.measure(ladder[middle])
            yield each
            if each.error * MARGIN <= error:
                high, fewest = middle, min(fewest, each.nbytes)
            else:
                low = middle + 1


def _checked(environments: Sequence[Environment], error: float, rate: float) -> int:
    """The size of the lights' faces, if a plan can be made for them."""
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
        if not 0 < value < math.inf:
            raise ValueError(f"{name} must be positive and finite, got {value}")
    return environments[0].radiance.shape[1]


def _views(mesh: Mesh) -> Float[np.ndarray, "w 3"]:
    """Eight viewers around the mesh, at two heights."""
    low, high = bounds(mesh)
    turn, rise = np.pi / 4 * np.arange(8), np.resize([0.2, 0.7], 8)
    around = np.stack([np.sin(turn) * np.cos(rise), np.sin(rise), np.cos(turn) * np.cos(rise)], -1)
    return ((low + high) / 2 + 1.6 * np.linalg.norm(high - low) * around).astype(np.float32)


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


def _bytes(system: System, share: float) -> int:
    """Bytes of a system of so many times as many vertices."""
    if isinstance(system, BrightTexels):
        transports: list[Array] = jax.tree.leaves((system.system.transport, system.visibility))  # pyright: ignore
    else:
        transports = jax.tree.leaves(system.transport)  # pyright: ignore[reportAttributeAccessIssue]
    grown = sum({id(each): each.nbytes for each in transports}.values())
    return int(protocol.memory(system) - grown + share * grown)


def _seconds(function: Callable) -> float:
    """Median of five calls, compiled before."""
    jax.block_until_ready(function())
    return statistics.median(timeit.repeat(lambda: jax.block_until_ready(function()), number=1, repeat=5))
