"""BRDFs that change, as lobes, a diffuse part and one small tensor, over the parameters of the BRDF.

    f(k, r, wi, wo) ~ lobes(k, r) + d(k, r, wo) / pi + sum_hol D(h, o, l) U(k, r, h) U^wo(wo, o) U^wi(wi, l)

k are the channels of the BRDF, such as the terms of a material model, and r are its parameters, such as the logarithm
of roughness. The transport depends on the light factors U^wi alone. The factors U(k, r, h) are tabulated at knots of
the parameters, interpolated, and multiplied by the weights of the channels at each vertex.
"""

import functools
import math
from collections.abc import Callable, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.brdf import Lambert, grid
from jaxprt.compile import jit
from jaxprt.decompose import tucker
from jaxprt.sphere import hemisphere
from jaxprt.systems import lobe as lobe_system
from jaxprt.systems.dynamic import reflected
from jaxprt.systems.dynamic.reflected import Reflected
from jaxprt.systems.lobe import LobeBrdf
from jaxprt.systems.protocol import Blend

RESOLUTION = 32  # edge of the maps in texels
_GRAZING = 1e-3  # smallest cosine in a division
_RANK = 1e-3  # smaller singular values, relative to the largest, are rounding in float32


class DynamicBrdf(eqx.Module):
    """A BRDF with channels over its parameters.

    The axes *n are one for each parameter, as in the table of lobes.

    Attributes:
        lobe: The lobes and the diffuse part of all channels.
        core: Core tensor D, with the ranks of the BRDFs, the view and the light as its dimensions.
        factor: Factor U of each channel at the knots of the parameters.
        view_map: Factor U^wo as parabolic maps over the view direction.
        light_map: Factor U^wi as parabolic maps over the direction of the light, in 1/sr. They are scaled such that the
            view factors of a BRDF have a mean square of about one.
        error: Relative L2 error of the light that the BRDFs at all knots reflect to all views, under light of natural
            spectrum. NaN if unknown.
    """

    lobe: LobeBrdf
    core: Float[Array, "h o i"]
    factor: Float[Array, "*n k h"]
    view_map: Float[Array, "o e e"]
    light_map: Float[Array, "i e e"]
    error: Float[Array, ""]

    @property
    def knot(self) -> tuple[Float[Array, " _"], ...]:
        """Increasing values of each parameter at which the BRDF is tabulated."""
        return self.lobe.knot

    @property
    def channels(self) -> int:
        """Number of channels."""
        return self.factor.shape[-2]

    @property
    def terms(self) -> int:
        """Number of light factors."""
        return len(self.light_map)

    @property
    def nbytes(self) -> int:
        """Bytes of the tensor and of the lobes."""
        return self.lobe.nbytes + sum(x.nbytes for x in (self.core, self.factor, self.view_map, self.light_map))

    @jit
    def view(self, wo: Float[Array, "v 3"], blend: Blend | None = None) -> Float[Array, "v i c"]:
        """Factors of the light terms for given views, which are zero below the horizon.

        Args:
            wo: Unit directions to the viewer in the local frame.
            blend: Weights of the channels and values of the parameters for these views; None for channels as colors.
        """
        if not self.terms:
            return jnp.zeros((len(wo), 0, 1), wo.dtype)
        seen = hemisphere.lookup(jnp.moveaxis(self.view_map, 0, 2), hemisphere.parabolic_coordinates(wo))
        seen = jnp.where(wo[:, 2:] > 0, seen, 0).T
        weight = self._along(() if blend is None else blend.parameter)
        if blend is not None:
            # Views are the last axis, over which XLA vectorizes CPU code.
            of_view = jnp.moveaxis(blend.weight, 0, 2)
            rows = [weight[:, number, None] * of_view[number] for number in range(self.channels)]
            weight = functools.reduce(jnp.add, rows)
        terms = jnp.zeros((self.terms, 1, len(wo)), wo.dtype)
        for core, of_brdf in zip(self.core, weight, strict=True):
            terms = terms + jnp.matmul(core.T, seen, precision="highest")[:, None] * of_brdf
        return jnp.moveaxis(terms, 2, 0)

    def _along(self, parameter: Sequence[Float[Array, " v"]]) -> Float[Array, "h k _"]:
        """Factors of the channels at values of the parameters."""
        if len(parameter) != len(self.knot):
            raise ValueError(f"the BRDF needs {len(self.knot)} parameters for each view, got {len(parameter)}")
        if not self.knot:
            return self.factor.T[..., None]
        if not self.terms:
            return jnp.zeros((0, self.channels, len(parameter[0])), self.factor.dtype)
        rows = jnp.moveaxis(self.factor.reshape(*self.factor.shape[:-2], -1), -1, 0)
        axis = grid.among(self.knot, parameter)
        return jnp.swapaxes(grid.read(rows, axis).reshape(self.channels, -1, len(parameter[0])), 0, 1)

    def at(self, *parameter: Float[Array, ""]) -> "DynamicBrdf":
        """The BRDF at given values of its parameters, without their axes. Values are clamped to the range of the knots.

        Raises:
            ValueError: The number of parameters differs from the table's.
        """
        lobe = self.lobe.at(*parameter)
        along = self._along([jnp.asarray(value).reshape(1) for value in parameter])[..., 0]
        return DynamicBrdf(lobe, self.core, along.T, self.view_map, self.light_map, self.error)

    def __call__(self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> Float[Array, "*b k"]:
        """Value in 1/sr of each channel, reconstructed. It is zero below the horizon."""
        lobes = self.lobe(wi, wo) / jnp.maximum(wi[..., 2:], _GRAZING)
        if not self.terms:
            return lobes
        light = hemisphere.lookup(jnp.moveaxis(self.light_map, 0, 2), hemisphere.parabolic_coordinates(wi))
        seen = self.view(wo.reshape(-1, 3)).reshape(*wo.shape[:-1], self.terms, -1)
        return lobes + jnp.where(wi[..., 2:] > 0, jnp.sum(light[..., None] * seen, -2), 0)


def tabulate(
    brdf: Callable,
    *,
    lobes: int | LobeBrdf = 12,
    ranks: tuple[int, int, int] | None = (4, 8, 8),
    resolution: int = RESOLUTION,
    knot: Sequence[np.ndarray] = (),
) -> DynamicBrdf:
    """Fits lobes to a BRDF, and a Tucker decomposition to what they leave.

    The decomposed tensor holds the light that each channel at each knot reflects to each view from each spherical
    harmonic, weighted by the natural power spectrum. This minimizes the squared error of pictures, as in
    `jaxprt.separable.factor`. The diffuse part takes what is proportional to irradiance, at each view.

    Args:
        brdf: BRDF (wi, wo) -> value [*b k] in 1/sr on local directions. With `knot`, a function of the parameters that
            returns such a BRDF.
        lobes: Number of lobes, 0 for none; or a table of them with the same channels and knots.
        ranks: Ranks of the BRDFs, the view and the light, limited by the size of the tensor; None for no tensor. The
            published ranks are (4, 8, 8) for Cook-Torrance.
        resolution: Edge of the maps in texels.
        knot: Increasing values of each parameter, as for `jaxprt.lobe.tabulate`.

    Raises:
        ValueError: There are neither lobes nor ranks, a rank is below 1, `resolution` is below 4, or for the reasons
            that `jaxprt.lobe.tabulate` gives.

    Reference: Sun et al. 2007, sections 3.2 and 4.1, with the natural power spectrum in place of the Frobenius norm,
    and free lobes.
    """
    require.count("resolution", resolution, least=4)
    grid.check_family(brdf, knot)
    if ranks is not None and (len(ranks) != 3 or not all(isinstance(rank, int) and rank >= 1 for rank in ranks)):
        raise ValueError(f"ranks must be three whole numbers of at least 1, got {ranks}")
    table = lobes if isinstance(lobes, LobeBrdf) else None
    if isinstance(lobes, int) and lobes:
        table = lobe_system.tabulate(brdf, lobes=lobes, knot=knot)
    if ranks is None:
        if table is None:
            raise ValueError("a BRDF needs lobes, or ranks of a tensor, or both; got neither")
        return without_tensor(table)
    knots, size = grid.check_knots(knot), [len(values) for values in knot]
    places = np.stack(np.meshgrid(*knots, indexing="ij"), -1).reshape(-1, len(knots)) if knots else ()
    members = [brdf(*map(jnp.asarray, place)) for place in places] if knots else [brdf]
    flat = None if table is None else _flat(table, len(members))
    rest = reflected.reflect(members, flat, resolution=resolution)
    rest, base = _without_irradiance(rest)
    factored = _decomposed(rest, ranks)
    nodes = None if table is None else table.diffuse.shape[1 + len(size) :]
    diffuse = _at_nodes(base, rest.direction, nodes, size, all(map(lobe_system.table.is_isotropic, members)))
    if table is None:
        table = _no_lobes(jnp.zeros_like(diffuse), knots)
    table = eqx.tree_at(lambda x: x.diffuse, table, table.diffuse + diffuse)
    core, along, view, light, error = factored
    return DynamicBrdf(table, core, along.reshape(*size, -1, len(core)), view, light, error)


def without_tensor(lobe: LobeBrdf) -> DynamicBrdf:
    """A BRDF of lobes and a diffuse part alone."""
    dtype, knots = lobe.scale.dtype, [len(knot) for knot in lobe.knot]
    maps = jnp.zeros((0, 4, 4), dtype)
    factor = jnp.zeros((*knots, len(lobe.weight), 0), dtype)
    return DynamicBrdf(lobe, jnp.zeros((0, 0, 0), dtype), factor, maps, maps, lobe.error)


def _flat(lobe: LobeBrdf, members: int) -> LobeBrdf:
    """The table with all knots along one axis."""
    nodes = lobe.scale.shape[1 + len(lobe.knot) :]

    def flat(value: Array, lead: int) -> Array:
        return value.reshape(*value.shape[:lead], members, *nodes)

    number = jnp.arange(members, dtype=lobe.scale.dtype)
    rows = flat(lobe.mean, 2), flat(lobe.scale, 1), flat(lobe.weight, 2), flat(lobe.diffuse, 1)
    return LobeBrdf(*rows, (number,), lobe.error)


def _no_lobes(diffuse: Float[Array, " c *q"], knots: Sequence[np.ndarray]) -> LobeBrdf:
    """A table of a diffuse part and of one lobe without weight, because arrays without lobes have no shape."""
    shape, dtype = diffuse.shape[1:], diffuse.dtype
    mean = jnp.zeros((3, 1, *shape), dtype).at[2].set(1)
    rows = mean, jnp.zeros((1, *shape), dtype), jnp.zeros((len(diffuse), 1, *shape), dtype)
    return LobeBrdf(*rows, diffuse, tuple(jnp.asarray(knot, dtype) for knot in knots), jnp.asarray(jnp.nan, dtype))


def _without_irradiance(rest: Reflected) -> tuple[Reflected, Float[Array, "m c d"]]:
    """What is left when the part that is proportional to irradiance is taken out at each view, and that albedo."""
    irradiance = reflected.reflect([Lambert(1.0)], None, resolution=math.isqrt(len(rest.area))).tensor[0, 0]  # [d b]
    # That of each view by the view's own quadrature, so that its error cancels in the ratio.
    base = jnp.sum(rest.tensor * irradiance, -1) / jnp.sum(irradiance**2, -1)
    return rest._replace(tensor=rest.tensor - base[..., None] * irradiance), base


def _at_nodes(
    base: Float[Array, "m c d"],
    direction: Float[Array, "d 3"],
    nodes: tuple[int, ...] | None,
    size: Sequence[int],
    isotropic: bool,
) -> Float[Array, " c *q"]:
    """Albedos at the texels of parabolic maps, as those at the nodes of a table of lobes."""
    albedo, way = np.asarray(base), np.asarray(direction)
    edge = math.isqrt(len(way))
    if isotropic:
        (count,) = (edge,) if nodes is None else nodes
        radius = np.sqrt(np.maximum(1 - way[:, 2] ** 2, 0)) / (1 + way[:, 2])  # tan(theta / 2)
        radius, first = np.unique(np.round(np.where(way[:, 2] > 0, radius, np.inf), 5), return_index=True)
        radius, first = radius[np.isfinite(radius)], first[np.isfinite(radius)]
        rows = [np.interp(np.linspace(0, 1, count), radius, row[first]) for row in albedo.reshape(-1, albedo.shape[-1])]
        shape: tuple[int, ...] = (count,)
    else:
        count = edge // 2 if nodes is None else nodes[0]
        texel = hemisphere.parabolic_texel_direction(resolution=count)
        maps = jnp.asarray(albedo.reshape(-1, edge, edge)).transpose(1, 2, 0)
        rows = np.moveaxis(np.asarray(hemisphere.lookup(maps, hemisphere.parabolic_coordinates(texel))), -1, 0)
        shape = (count, count)
    value = np.moveaxis(np.reshape(rows, (*albedo.shape[:2], *shape)), 1, 0)
    return jnp.asarray(value.reshape(albedo.shape[1], *size, *shape), albedo.dtype)


def _decomposed(rest: Reflected, ranks: tuple[int, int, int]) -> tuple[Array, ...]:
    """Core, factors of the BRDFs and channels, view maps, light maps and relative error."""
    inside = np.flatnonzero(np.asarray(rest.area))
    flat, seen = _weighted(rest.tensor, jnp.sqrt(rest.area), inside)
    least = tuple(min(rank, size) for rank, size in zip(ranks, seen.shape, strict=True))
    return _maps(tucker.orient(tucker.truncated(seen, ranks=least)), flat, seen, rest, inside)


@jit
def _weighted(tensor: Array, weight: Array, inside: Array) -> tuple[Array, Array]:
    """The tensor with knots and channels in one mode; and the same, weighted, for the views of nonzero weight only."""
    flat = tensor.reshape(-1, *tensor.shape[2:])
    return flat, flat[:, inside] * weight[inside, None]


@jit
def _maps(least: tucker.Tucker, flat: Array, seen: Array, rest: Reflected, inside: Array) -> tuple[Array, ...]:
    """Maps of a decomposition. Views, and then light, are the least-squares solution for fixed other factors."""
    core, (along, _, across), weight = least.core, least.factor, jnp.sqrt(rest.area)
    by_view = tucker.multiply(tucker.multiply(flat, across, mode=2), along, mode=0)  # [h, d, i]
    unfolded = core.transpose(1, 0, 2).reshape(core.shape[1], -1)
    # View maps also cover texels of zero weight.
    view = jnp.moveaxis(by_view, 1, 0).reshape(len(weight), -1) @ jnp.linalg.pinv(unfolded, rtol=_RANK)
    sent = jnp.einsum("mh,hoi,do->mdi", along, core, view * weight[:, None])[:, inside]
    square = jnp.einsum("mdi,mdj->ij", sent, sent)
    light = jnp.linalg.pinv(square, rtol=_RANK**2, hermitian=True) @ jnp.einsum("mdi,mdb->ib", sent, seen)
    left = jnp.vdot(seen, seen) - jnp.vdot(light, square @ light)
    # Light maps carry the size of each term, so that the compression of transport can weight terms by it.
    size = jnp.sqrt(jnp.diagonal(square) / (jnp.sum(rest.area) * len(flat)))
    edge = math.isqrt(len(weight))
    view, light = (value.reshape(-1, edge, edge) for value in (view.T, size[:, None] * light @ rest.to_map))
    error = jnp.sqrt(jnp.maximum(left, 0) / jnp.where(rest.whole > 0, rest.whole, 1))
    return core / jnp.where(size > 0, size, 1), along, view, light, error
