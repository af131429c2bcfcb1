"""Light that the parts of a scene reflect onto each other: estimates of its size, and its precomputation."""

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np
import scipy
from jaxtyping import Array, Float, Int

from jaxprt.relit import curvature, paths
from jaxprt.relit.channels import Shading
from jaxprt.relit.groups import Layout, Surface, joined_mesh
from jaxprt.relit.recipes import Target, harmonic_table, lobe_table, samples_of
from jaxprt.scene import Environment, Mesh, PointLight
from jaxprt.scene.mesh import Opacity, frames
from jaxprt.systems import bounces, lamps
from jaxprt.systems.bounces import GroupBounces, ReflectingPart, traced
from jaxprt.systems.bounces.jobs import DEGREE
from jaxprt.systems.lamps import LampTransport
from jaxprt.systems.lobe import LobeBrdf
from jaxprt.systems.protocol import System
from jaxprt.visibility import Run

_TEXELS = 64  # edge of the light's faces for which samples of traced texels are chosen, for systems of any size
ALL = bounces.build.ALL
_EACH = 3  # number of bounces that are estimated one by one; further ones are extrapolated as a geometric series
_EDGE = 8  # largest edge of the faces of light that is reflected
_PATCHES, _REFLECTED, _SAMPLES = 256, 8, 16  # of the estimate: patches, edge of the faces of rays, and points of lamps
_SLOWEST = 0.95  # largest ratio of a bounce to the previous one
_REGIONS = 16  # most regions of the transfer tensor, besides one for each group: its time and memory grow with them
_LOBES = 8  # number of lobes for sharp parts whose system has no table of lobes


def check(count: int | str | None) -> None:
    """Refuses invalid numbers of bounces.

    Raises:
        TypeError: `count` is not a whole number, "all" or None.
        ValueError: `count` is negative, or a word other than "all".
    """
    if count is None or (isinstance(count, str) and count == ALL):
        return
    if isinstance(count, str):
        raise ValueError(f"bounces must be a whole number or {ALL!r}, got {count!r}")
    if not (type(count) is int or isinstance(count, np.integer)):
        raise TypeError(f"bounces must be a whole number or {ALL!r}, got {count!r}")
    if not 0 <= count < 1 << 31:
        raise ValueError(f"bounces must be at least 0, and below 2^31, or {ALL!r}, got {count}")


def make(
    shadings: Sequence[Shading],
    layout: Layout,
    count: int | str,
    target: Target,
    *,
    lamp: LampTransport | None = None,
    systems: Sequence[System] | None = None,
) -> GroupBounces:
    """Precomputes the light of the environment and of lamps that all parts reflect onto each other and themselves.

    In a scene of more than 16 parts, those parts of a group whose materials are similar send light with the mean of
    their materials. Patches add the differences between their colors, as for textures.

    Args:
        shadings: One `Shading` for each part: its mesh, BRDF and channel weights.
        layout: Where the vertices of the parts stand in their groups.
        count: Number of bounces, at least 1; or "all".
        target: Size of the light, and where and how to compute. All parts occlude each other, and all vertices are lit.
        lamp: Transport of the lamps to the vertices of all parts; None without lamps.
        systems: The systems of the groups for direct light, whose tables of lobes are used where rays represent lobes
            that are too sharp for harmonics; None to reflect by harmonics alone.

    Returns:
        The system of reflected light alone.
    """
    first = [shadings[members[0]] for members in layout.parts]
    of_group = [paths.factor(shading) for shading in first]
    typical = [paths.typical(shading, of_group[group]) for shading, group in zip(shadings, layout.group, strict=True)]
    region, members = _regions(layout, typical)
    mesh = dataclasses.replace(
        joined_mesh(shadings), region=np.repeat(region, layout.counts), opacity=target.occluder.opacity
    )
    sent = [of_group[layout.group[parts[0]]] for parts in members]
    weights = [_mean([typical[part] for part in parts], [layout.counts[part] for part in parts]) for parts in members]
    options = {"edge": min(_EDGE, target.size), "run": target.run.within("bounces.prt")}
    # Omit nothing: the number of bounces is decided, and later materials may reflect more.
    tensor = bounces.precompute(
        mesh, [path.brdf for path in sent], weights=weights, lamps=lamp, bounces=count, **options
    )
    groups = []
    for group, (shading, path) in enumerate(zip(first, of_group, strict=True)):
        parts = layout.of_group(group, shadings)
        frame = [frames(part.mesh.normal, part.mesh.tangent) for part in parts]
        position = layout.column(group, [part.mesh.position for part in parts])
        table = harmonic_table(shading, degree=DEGREE)
        position, axes = jax.device_put((position, layout.column(group, frame)))
        lobe = None if systems is None else _lobes(parts, systems[group])
        groups.append(ReflectingPart(position, axes, table, sent=path.sent, lobe=lobe))
    return GroupBounces.make(tensor, groups, [layout.vertices(group) for group in range(len(groups))])


def _regions(layout: Layout, typical: Sequence[Array | None]) -> tuple[Int[np.ndarray, " n"], list[list[int]]]:
    """Each part's region of the transfer tensor, and each region's parts, which send light with one mean material."""
    region = np.full(len(layout.counts), -1, np.int32)
    for parts in map(list, layout.parts):
        label = np.arange(len(parts))
        most = -(-_REGIONS * len(parts) // len(region))
        # A group whose material cannot change is one region.
        if typical[parts[0]] is None:
            label = np.zeros_like(label)
        elif most < len(parts):
            # Too many for regions of their own: parts with the most similar weights share one, by Ward's clustering.
            rows = _stacked([typical[part] for part in parts]).reshape(len(parts), -1)
            label = scipy.cluster.hierarchy.fcluster(scipy.cluster.hierarchy.ward(rows), most, "maxclust") - 1
        region[parts] = np.max(region) + 1 + label
    return region, [np.flatnonzero(region == one).tolist() for one in range(np.max(region) + 1)]


def _mean(weights: Sequence[Array | None], counts: Sequence[int]) -> Float[Array, "p c"] | None:
    """Mean of the weights of some parts over their vertices; None without weights."""
    if weights[0] is None:
        return None
    rows = _stacked(weights)
    return jax.device_put(np.average(rows, axis=0, weights=list(counts)).astype(rows.dtype))


def _stacked(weights: Sequence[Array | None]) -> Float[np.ndarray, "n p c"]:
    """Weights in one array; gray ones are repeated to the colors of the others."""
    return np.stack(np.broadcast_arrays(*map(np.asarray, weights)))


def _lobes(shadings: Sequence[Shading], system: System) -> LobeBrdf | None:
    """The BRDF of a group as lobes if some of its parts are sharp, or may become so; None for other groups."""
    if shadings[0].matte:
        return None
    table = lobe_table(shadings[0], _LOBES, system=system)
    return table if shadings[0].table is not None or any(is_sharp(part, table) for part in shadings) else None


def is_sharp(shading: Shading, table: LobeBrdf | None) -> bool:
    """Whether reflections of a part are too sharp for the harmonics of arriving light, so that they are traced."""
    if table is None or shading.matte:
        return False
    if shading.table is not None:
        weight = np.mean(np.asarray(shading.weighted.weight, np.float64), 0)
        brightest = np.argmax(np.asarray(shading.scale) @ weight)
        return shading.table.is_sharp(shading.smoothest, weight[:, brightest])
    return bool(traced.is_sharp(table))


def fractions(
    shadings: Sequence[Shading],
    environments: Sequence[Environment],
    *,
    opacity: Opacity | None = None,
    point_lights: Sequence[PointLight] = (),
) -> Float[np.ndarray, "b p"]:
    """Estimates the fraction of each part's radiance that surfaces reflected at least once, twice and three times.

    The estimate treats all surfaces as diffuse, with the mean albedo of their parts.

    Args:
        shadings: One `Shading` for each part: its mesh, BRDF and channel weights.
        environments: Environments. The result is the largest fraction under any of them, with the lamps of the scene,
            and in the light of the lamps alone.
        opacity: Opacity of the vertices of all parts; None if all are opaque.
        point_lights: Point lights, in the coordinates of the meshes.

    Returns:
        Relative L2 fraction for each number of bounces (rows) and part (columns).
    """
    mesh = dataclasses.replace(joined_mesh(shadings), opacity=opacity)
    exchange = bounces.patches.exchange(mesh, patches=_PATCHES, size=_REFLECTED, edge=_REFLECTED)
    region, result = np.asarray(mesh.region), np.zeros((_EACH, len(shadings)))
    albedo = np.stack([np.broadcast_to(paths.albedo(shading), 3) for shading in shadings])[exchange.region]
    lamp = _irradiance(mesh, shadings, point_lights)
    sources = [np.broadcast_to(exchange.lit(light), lamp.shape) + lamp for light in environments]
    for source in [*sources, lamp] if lamp.any() else sources:
        lit = np.stack(exchange.reflected(source, albedo, bounces=_EACH))
        for part in range(len(shadings)):
            of_part = lit[:, region == part]
            # The ratio is taken over two bounces, because odd and even bounces between two surfaces differ.
            before, _, last = (float(np.linalg.norm(bounce)) for bounce in of_part[-3:])
            ratio = min((last / before) ** 0.5, _SLOWEST) if before > 0 else 0.0
            of_part = np.concatenate([of_part[:-1], of_part[-1:] / (1 - ratio)])
            whole = max(float(np.linalg.norm(of_part.sum(0))), 1e-30)
            left = [float(np.linalg.norm(of_part[count:].sum(0))) / whole for count in range(1, _EACH + 1)]
            result[:, part] = np.maximum(result[:, part], np.asarray(left))
    return result


def _irradiance(
    mesh: Mesh, shadings: Sequence[Shading], point_lights: Sequence[PointLight]
) -> Float[np.ndarray, "v 3"]:
    """Irradiance over pi of all vertices from lamps."""
    glowing = [shading for shading in shadings if shading.emitted is not None]
    radiance = [np.mean(np.asarray(shading.emitted), 0) for shading in glowing]
    radiance += [np.asarray(light.intensity) for light in point_lights]
    if not radiance:
        return np.zeros((len(mesh.position), 3), np.float32)
    sources = [*(shading.mesh for shading in glowing), *point_lights]
    transport = lamps.precompute(mesh, sources, samples=_SAMPLES, pieces=1, apart=True, run=Run(progress=False))
    return np.asarray(transport.cosine).T @ np.stack(radiance).astype(np.float32) / np.float32(np.pi)


def needed(reflected: Float[np.ndarray, "b p"], error: float) -> int | str:
    """Smallest number of bounces that omits at most `error` of each part's radiance; "all" if two omit more."""
    enough = np.flatnonzero(np.all(reflected <= error, 1))
    return int(enough[0]) if enough.size else ALL


def traits(shading: Shading, surface: Surface) -> tuple[float, int, bool]:
    """Curvature of a part's radiance, samples of bright texels, and whether its reflections are traced.

    Args:
        shading: The part with its material.
        surface: The group that the part belongs to.
    """
    seen = surface.system.texel_visibility
    size = _TEXELS if seen is None else seen.size
    # Powers of two, so that few programs are compiled for parts of different roughness.
    samples = 1 << (samples_of(shading, size) - 1).bit_length()
    lobes = None if surface.reflecting is None else surface.reflecting.lobe
    return curvature.of_part(shading, surface.system), samples, is_sharp(shading, lobes)
