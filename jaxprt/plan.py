"""An error in, a plan out: what precomputed transport an error needs, and what that costs, before it is made.

wanted = prt.plan.separable(mesh, brdf, [light], error=0.05)  # or prt.plan.lobe
ready = prt.plan.precompute(mesh, brdf, wanted, path="bunny")
color = prt.plan.radiance(ready, light, eye=eye)
"""

import math
import os
import pathlib
import statistics
import time
import timeit
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import tqdm
from jaxtyping import Array, Float

from jaxprt import require, visibility
from jaxprt.scene.environment import Environment
from jaxprt.scene.mesh import Mesh, bounds
from jaxprt.systems import bright_texels, reference
from jaxprt.systems import lobe as lobe_system
from jaxprt.systems import separable as separable_system
from jaxprt.systems.lobe import LobeBrdf, LobeTransport
from jaxprt.systems.separable import ClusteredTransport, SeparableBrdf, combine, light_tuple, view_tuple
from jaxprt.visibility import StoredVisibility

MARGIN = 1.25  # plans are made for an error smaller by this factor: lights and views that they did not see differ
_MEMBERS = 225  # vertices in a cluster
_SAMPLE = 24  # clusters that are measured: of the bunny, half of the squared error is in an eighth of all
_JUDGED = 1350  # vertices whose exact radiance is summed, or fewer


class _Sizes(NamedTuple):
    """Those of `Plan`."""

    terms: int
    resolution: int
    vectors: int
    modes: int
    keep: int
    texels: int


# Each a step up, about in balance.
_LADDER = (
    _Sizes(2, 64, 4, 8, 192, 2),
    _Sizes(4, 64, 8, 24, 256, 4),
    _Sizes(8, 64, 8, 32, 384, 4),
    _Sizes(16, 64, 12, 48, 512, 8),
    _Sizes(32, 64, 16, 80, 768, 16),
    _Sizes(48, 64, 16, 96, 1024, 16),
    _Sizes(64, 64, 24, 128, 1024, 32),
    _Sizes(96, 96, 32, 192, 1536, 64),
    _Sizes(128, 96, 48, 256, 1536, 64),
    _Sizes(192, 96, 64, 384, 2048, 128),
)
_LOBES = ((2, 4), (4, 8), (8, 16), (12, 16), (16, 32), (24, 64))  # and texels


class Plan(eqx.Module):
    """Sizes of precomputed transport, and what they are predicted to bring and to cost.

    Attributes:
        clusters: Clusters of vertices.
        terms: BRDF terms.
        resolution: Edge of their maps in texels.
        vectors: Vectors of each cluster.
        modes: Modes of the light of each cluster.
        keep: Wavelet coefficients of each cluster.
        texels: Brightest texels that are summed one by one.
        error: Relative L2 error of radiance, of the worst of the lights that the plan was made with.
        seconds: Of a light change on this machine.
        nbytes: Of transport and visibility.
        precompute_seconds: On this machine.
        vertices: Number of vertices of the mesh that it was made for.
        size: Edge of the cubemap faces of the lights that it was made with, in texels.
    """

    clusters: int
    terms: int
    resolution: int
    vectors: int
    modes: int
    keep: int
    texels: int
    error: float
    seconds: float
    nbytes: int
    precompute_seconds: float
    vertices: int
    size: int


class LobePlan(eqx.Module):
    """The same of relighting by lobes.

    Attributes:
        lobes: Lobes of the BRDF.
        texels: Brightest texels that are summed one by one.
        error: Relative L2 error of radiance, of the worst of the lights that the plan was made with.
        seconds: Of a change of light or view on this machine.
        nbytes: Of visibility.
        precompute_seconds: On this machine, the fit of the lobes included.
        vertices: Number of vertices of the mesh that it was made for.
        size: Edge of the cubemap faces of the lights that it was made with, in texels.
    """

    lobes: int
    texels: int
    error: float
    seconds: float
    nbytes: int
    precompute_seconds: float
    vertices: int
    size: int


class Ready(eqx.Module):
    """What `radiance` needs.

    Attributes:
        visible: Visibility of every vertex.
        brdf: The BRDF itself, for single texels.
        factored: Its terms, for the rest of the light.
        transport: Transport of the terms.
        texels: Number of single texels.
        samples: Points along the edge of each, from `jaxprt.bright_texels.samples_for`.
    """

    visible: StoredVisibility
    brdf: Callable
    factored: SeparableBrdf
    transport: ClusteredTransport
    texels: int = eqx.field(static=True)
    samples: int = eqx.field(static=True)


class LobeReady(eqx.Module):
    """What `radiance` needs to relight by lobes.

    Attributes:
        transport: What every vertex sees.
        brdf: The BRDF itself, for single texels.
        table: Its lobes, for the rest of the light.
        texels: Number of single texels.
        samples: Points along the edge of each, from `jaxprt.bright_texels.samples_for`.
    """

    transport: LobeTransport
    brdf: Callable
    table: LobeBrdf
    texels: int = eqx.field(static=True)
    samples: int = eqx.field(static=True)


def separable(
    mesh: Mesh,
    brdf: Callable,
    environments: Sequence[Environment],
    *,
    error: float = 0.05,
    occluder: Mesh | None = None,
    progress: bool = True,
) -> Plan:
    """Finds the cheapest sizes that meet an error, by measuring them on some clusters of the mesh.

    Steps of a ladder of sizes are made for the sampled clusters and judged from eight views by summing all texels
    with the BRDF itself. The plan is the first step whose error under each light is below `error` / 1.25. On lights
    and views that the plan did not see the error is then below `error` if they are of the same kind: a plan made
    under an overcast sky promises nothing for a sun.

    Args:
        mesh: The vertices to light.
        brdf: A model, (wi, wo) -> value [*b c] in 1/sr on local directions.
        environments: Lights that the error must hold for, of one size.
        error: Relative L2 error of the radiance of all vertices.
        occluder: What casts shadows; the mesh itself if None.
        progress: Whether to show a progress bar.

    Returns:
        The plan.

    Raises:
        ValueError: No lights, lights of different sizes, NaN or infinity in them, in the error or from the BRDF, an
            error that is not positive, or one that no step reaches.
    """
    size = _checked(environments, error)
    clusters = max(1, round(len(mesh.position) / _MEMBERS))
    member = separable_system.clustered.cluster(mesh.position, mesh.normal, clusters=clusters)
    chosen = member[np.random.default_rng(0).permutation(clusters)[:_SAMPLE]]
    share, member = clusters / len(chosen), np.arange(chosen.size).reshape(chosen.shape)
    start = time.perf_counter()
    visible = visibility.precompute(mesh, size=size, occluder=occluder, vertex=chosen.ravel(), progress=False)
    rays = time.perf_counter() - start
    judged = np.sort(np.random.default_rng(1).permutation(chosen.size)[:_JUDGED])
    views = _views(mesh)
    exact = _exact(visible, judged, brdf, environments, views)
    samples = bright_texels.samples_for(brdf, size=size)
    low, high, plan, wrong = 0, len(_LADDER), None, math.inf
    with tqdm.tqdm(total=high.bit_length(), desc="plan", disable=not progress) as bar:
        while low < high:  # The first step that is good enough lies in between: errors fall along the ladder.
            middle = (low + high) // 2
            sizes = _fitted(_LADDER[middle], chosen.shape[1], size)
            start = time.perf_counter()
            ready = _ready(visible, brdf, sizes, samples, member=member, progress=False)
            seconds = share * (rays + time.perf_counter() - start)
            wrong = max(_error(ready, light, judged, views, at) for light, at in zip(environments, exact, strict=True))
            bar.update()
            if wrong * MARGIN > error:
                low = middle + 1
                continue
            nbytes = int((ready.transport.nbytes + visible.nbytes) * share)
            once = share * _seconds(lambda ready=ready: radiance(ready, environments[0], eye=jnp.asarray(views[0])))
            high, plan = middle, Plan(clusters, *sizes, wrong, once, nbytes, seconds, len(mesh.position), size)
    if plan is None:
        raise ValueError(f"error must be at least {wrong * MARGIN:.3g}, which the largest sizes reach; got {error}")
    return plan


def lobe(
    mesh: Mesh,
    brdf: Callable,
    environments: Sequence[Environment],
    *,
    error: float = 0.05,
    occluder: Mesh | None = None,
    progress: bool = True,
) -> LobePlan:
    """Finds the fewest lobes and texels that meet an error, measured like the plan of `separable`, and promised alike.

    Lobes store what vertices see and nothing else, and small errors are reached by terms alone. Where both plans can be
    had, the one with fewer `seconds` relights faster.

    Arguments and errors as of `separable`.
    """
    size = _checked(environments, error)
    number = min(len(mesh.position), _JUDGED)
    chosen = np.sort(np.random.default_rng(0).permutation(len(mesh.position))[:number])
    share = len(mesh.position) / number
    start = time.perf_counter()
    visible = visibility.precompute(mesh, size=size, occluder=occluder, vertex=chosen, progress=False)
    transport = lobe_system.compress(visible)
    rays = share * (time.perf_counter() - start)
    views, judged = _views(mesh), np.arange(number)
    exact = _exact(visible, judged, brdf, environments, views)
    reached, samples = math.inf, bright_texels.samples_for(brdf, size=size)
    for count, single in tqdm.tqdm(_LOBES, desc="plan", disable=not progress):
        start = time.perf_counter()
        table = lobe_system.tabulate(brdf, lobes=count)
        seconds = rays + time.perf_counter() - start
        ready = LobeReady(transport, brdf, table, min(single, 6 * size * size - 1), samples)
        wrong = max(_error(ready, light, judged, views, at) for light, at in zip(environments, exact, strict=True))
        reached = min(reached, wrong)
        if wrong * MARGIN <= error:
            # What blurs the light does not grow with the mesh.
            light = _seconds(lambda: lobe_system.prefilter(environments[0]))
            once = _seconds(lambda ready=ready: radiance(ready, environments[0], eye=jnp.asarray(views[0])))
            once = light + share * max(once - light, 0)
            cost = wrong, once, int(share * transport.nbytes), seconds
            return LobePlan(count, ready.texels, *cost, len(mesh.position), size)
    raise ValueError(f"error must be at least {reached * MARGIN:.3g}, which the most lobes reach; got {error}")


def precompute(
    mesh: Mesh,
    brdf: Callable,
    plan: Plan | LobePlan,
    *,
    occluder: Mesh | None = None,
    path: str | os.PathLike | None = None,
    executor: Executor | None = None,
    progress: bool = True,
) -> Ready | LobeReady:
    """Carries out a plan.

    Args:
        mesh: The vertices to light, as in the plan.
        brdf: Their BRDF, as in the plan.
        plan: The plan.
        occluder: What casts shadows; the mesh itself if None.
        path: Folder that keeps what is finished; a call that was stopped, or killed, goes on from there.
        executor: Where blocks are computed; this machine's cores if None.
        progress: Whether to show progress bars.

    Returns:
        What `radiance` needs.

    Raises:
        ValueError: Another number of vertices than the plan's, or as in `precompute` of the transports.
    """
    if len(mesh.position) != plan.vertices:
        raise ValueError(f"the mesh must have the plan's {plan.vertices} vertices, got {len(mesh.position)}")
    folder = None if path is None else pathlib.Path(path)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    run = {"executor": executor, "progress": progress}
    samples = bright_texels.samples_for(brdf, size=plan.size)
    if isinstance(plan, LobePlan):
        at = folder and folder / "lobes.prt"
        transport = lobe_system.precompute(mesh, size=plan.size, occluder=occluder, path=at, **run)
        return LobeReady(transport, brdf, lobe_system.tabulate(brdf, lobes=plan.lobes), plan.texels, samples)
    at = folder and folder / "visibility.prt"
    visible = visibility.precompute(mesh, size=plan.size, occluder=occluder, path=at, **run)
    at = folder and folder / "clusters.prt"
    return _ready(visible, brdf, plan, samples, clusters=plan.clusters, path=at, **run)


def radiance(ready: Ready | LobeReady, light: Environment, *, eye: Float[Array, "3"]) -> Float[Array, "v c"]:
    """Radiance that each vertex sends to the eye: the brightest texels exactly, the rest through terms or lobes.

    Args:
        ready: From `precompute`.
        light: The environment.
        eye: Position of the viewer in world units.

    Returns:
        Linear radiance per vertex, in the light's units. Differentiable in the light and the eye.
    """
    texel, excess, rest = bright_texels.split(light, count=ready.texels)
    if isinstance(ready, Ready):
        view = view_tuple(ready.transport, ready.factored, eye)
        visible, smooth = ready.visible, combine(light_tuple(ready.transport, rest), view)
    else:
        visible, smooth = ready.transport, lobe_system.radiance(ready.transport, ready.table, rest, eye=eye)
    return smooth + bright_texels.radiance(visible, ready.brdf, texel, excess, eye=eye, samples=ready.samples)


def _checked(environments: Sequence[Environment], error: float) -> int:
    """The size of the lights' faces, if a plan can be made for them."""
    if not environments:
        raise ValueError("environments must be at least one, got none")
    shapes = sorted({str(list(light.radiance.shape)) for light in environments})
    if len(shapes) != 1 or environments[0].radiance.ndim != 4:
        raise ValueError(f"environments must be of one size [6, n, n, c], got {', '.join(shapes)}")
    for number, light in enumerate(environments):
        require.finite(f"the radiance of environment {number}", light.radiance)
    if not 0 < error < math.inf:
        raise ValueError(f"error must be positive and finite, got {error}")
    return environments[0].radiance.shape[1]


def _views(mesh: Mesh) -> np.ndarray:
    """Eight viewers around the mesh, at two heights."""
    low, high = bounds(mesh)
    turn, rise = np.pi / 4 * np.arange(8), np.resize([0.2, 0.7], 8)
    around = np.stack([np.sin(turn) * np.cos(rise), np.sin(rise), np.cos(turn) * np.cos(rise)], -1)
    return ((low + high) / 2 + 1.6 * np.linalg.norm(high - low) * around).astype(np.float32)


def _exact(visible: StoredVisibility, judged: np.ndarray, brdf, environments, views) -> np.ndarray:
    """Radiance [light, view, vertex, color] of some vertices by all texels."""
    batch = Environment(jnp.stack([light.radiance for light in environments]))
    seen, position, frame = jnp.asarray(visible.seen(judged)), visible.position[judged], visible.frame[judged]
    each = [reference.integrate(seen, position, frame, brdf, batch, jnp.asarray(eye)) for eye in views]
    exact = np.stack(each, 1)
    require.finite("what the BRDF makes of the lights, by light, view, vertex and color,", exact)
    return exact


def _fitted(step: _Sizes, members: int, size: int) -> _Sizes:
    """A step of the ladder, cut to what clusters and lights of this size have."""
    terms, resolution, vectors, modes, keep, count = step
    vectors, keep = min(vectors, members), min(keep, 6 * size * size)
    return _Sizes(terms, resolution, vectors, min(modes, keep, vectors * terms), keep, min(count, 6 * size * size - 1))


def _ready(visible: StoredVisibility, brdf: Callable, sizes: Plan | _Sizes, samples: int, **options) -> Ready:
    """Transport in these sizes; the options are those of `clustered.precompute`."""
    factored = separable_system.factor(brdf, terms=sizes.terms, resolution=sizes.resolution)
    limits = {name: getattr(sizes, name) for name in ("vectors", "modes", "keep")}
    transport = separable_system.clustered.precompute(visible, factored, **limits, **options)
    return Ready(visible, brdf, factored, transport, sizes.texels, samples)


def _error(ready, light: Environment, judged: np.ndarray, views: np.ndarray, exact: np.ndarray) -> float:
    """Relative L2 error of some vertices over all views, as far as they face the viewer."""
    visible = ready.visible if isinstance(ready, Ready) else ready.transport
    normal, position = np.asarray(visible.frame)[judged, 2], np.asarray(visible.position)[judged]
    facing = np.einsum("vi,wvi->wv", normal, views[:, None] - position) > 0
    now = np.stack([np.asarray(radiance(ready, light, eye=jnp.asarray(eye)))[judged] for eye in views])[facing]
    wrong, whole = (float(np.linalg.norm(each)) for each in (now - exact[facing], exact[facing]))
    return float(np.nan_to_num(wrong, nan=np.inf)) / (whole if whole > 0 else 1.0)


def _seconds(function: Callable) -> float:
    """Median of five calls, compiled before."""
    jax.block_until_ready(function())
    return statistics.median(timeit.repeat(lambda: jax.block_until_ready(function()), number=1, repeat=5))
