"""A set of BRDFs that can be interpolated at run time: lobes of each BRDF, and the residual as one small tensor.

    f(h, wi, wo) ~ lobes_h(wi, wo) + sum_ijk D(i, j, k) U^h(h, i) U^wo(wo, j) U^wi(wi, k)

Transport depends only on the light factors U^wi, which all BRDFs of the set share. A BRDF that is chosen at run time is
a separable BRDF with these light factors and its own view maps, plus a table of lobes. Diffuse parts do not belong to
the set: every transport has a separate term for them. A set of gray BRDFs is gray. In a set of colored BRDFs, the
tensor treats each color as a separate BRDF.
"""

import math
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt.compile import jit
from jaxprt.decompose import tucker
from jaxprt.files import objects
from jaxprt.sphere import hemisphere
from jaxprt.systems.dynamic import reflected
from jaxprt.systems.lobe import LobeBrdf, tabulate
from jaxprt.systems.lobe.table import mean
from jaxprt.systems.separable import SeparableBrdf

_GRAZING = 1e-3  # smallest cosine in a division
_RANK = 1e-3  # smaller singular values, relative to the largest, are rounding in float32


class Mixed(eqx.Module):
    """The BRDF at one place of a set. `__call__` gives its value in 1/sr, as represented by lobes and terms.

    Attributes:
        terms: The separable BRDF of the residual.
        lobe: The lobes; None if the set has none.
        brdf: The analytic model with interpolated parameters; None if the BRDFs of the set are not of one model.
    """

    terms: SeparableBrdf
    lobe: LobeBrdf | None
    brdf: Callable | None

    def __call__(self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> Float[Array, "*b c"]:
        """Value of the BRDF in 1/sr; zero below the horizon."""
        value = self.terms(wi, wo)
        if self.lobe is None:
            return value
        return value + self.lobe(wi, wo) / jnp.maximum(wi[..., 2:], _GRAZING)


class BrdfSet(eqx.Module):
    """A set of BRDFs without their diffuse parts.

    Attributes:
        core: Core tensor D, with the ranks of the set, the view and the light as its dimensions.
        factor: Factor U^h of each BRDF and color. In sets for light paths, of each pair of BRDFs; see `combined`.
        view_map: Factor U^wo as maps over the view direction.
        light_map: Factor U^wi as maps over the incident direction, in 1/sr. They are scaled such that the view factors
            of a BRDF have a mean square of about one.
        lobe: Lobes of each BRDF, along the single parameter of the table; None without lobes.
        brdf: The set as one model whose parameters have a leading axis; None if the BRDFs are not of one model.
        error: Relative L2 error of the light that all BRDFs reflect to all views, under light with a natural spectrum.
        coordinates: Function from a local direction to coordinates in the maps.
    """

    core: Float[Array, "h o i"]
    factor: Float[Array, "m *_ c h"]
    view_map: Float[Array, "o n n"]
    light_map: Float[Array, "i n n"]
    lobe: LobeBrdf | None
    brdf: Callable | None
    error: Float[Array, ""]
    coordinates: Callable = eqx.field(static=True, default=hemisphere.parabolic_coordinates)

    def __reduce__(self):
        """Pickles the function of coordinates by name, because pickle cannot store jitted functions."""
        return objects.reduced(self)

    @property
    def size(self) -> int:
        """Number of BRDFs in the set."""
        return self.factor.shape[0]

    @property
    def nbytes(self) -> int:
        """Bytes of the tensor and of the lobes."""
        tensor = (self.core, self.factor, self.view_map, self.light_map)
        return sum(each.nbytes for each in tensor) + (0 if self.lobe is None else self.lobe.nbytes)

    @jit
    def at(self, weight: Float[Array, " m"]) -> Mixed:
        """The BRDF for given weights of the set's BRDFs. `jaxprt.brdf.navigation` makes weights from coordinates.

        Weights should sum to one. Factors are interpolated by `combined`. Free lobes are interpolated in position and
        width; published lobes are the same in all BRDFs. Differentiable in the weights.

        Raises:
            ValueError: There is not one weight for each BRDF of the set.
        """
        if weight.shape != (self.size,):
            raise ValueError(f"weights must be one for each of {self.size} BRDFs, got {list(weight.shape)}")
        view = jnp.einsum("ch,hoi,oyx->iyxc", combined(self.factor, weight), self.core, self.view_map)
        terms = SeparableBrdf(self.light_map[..., None], view, self.error, self.coordinates)
        lobe = None if self.lobe is None else mean(self.lobe, weight)
        return Mixed(terms, lobe, jax.tree.map(lambda x: between(x, weight), self.brdf))


@jit
def combined(factor: Float[Array, "m *_ c h"], weight: Float[Array, " m"]) -> Float[Array, "c h"]:
    """Interpolated factors of a BRDF between those of a set.

    Factors of single BRDFs are interpolated linearly. Factors of pairs are interpolated by a quadratic form, divided by
    the sum of the weights. The factor of a pair can then be chosen such that equal weights of the two BRDFs give the
    model whose parameters are halfway between.

    Args:
        factor: Factors of each BRDF and color, or of each pair of BRDFs and color.
        weight: Weight of each BRDF.
    """
    if factor.ndim == 3:
        return jnp.tensordot(weight, factor, 1)
    whole = jnp.sum(weight)
    return jnp.einsum("m,n,mnch->ch", weight, weight, factor) / jnp.where(whole == 0, 1, whole)


@jit
def between(parameter: Float[Array, "m *c"], weight: Float[Array, " m"]) -> Float[Array, "*c"]:
    """Interpolated parameter of a model.

    A parameter without colors that is positive in the whole set (a width or an exponent) is interpolated in its
    logarithm, as the lobes are. All others are interpolated linearly.

    Args:
        parameter: Value of the parameter for each BRDF of the set.
        weight: Weight of each BRDF.
    """
    linear = jnp.tensordot(weight, parameter, 1)
    if parameter.ndim > 1:
        return linear
    positive = jnp.all(parameter > 0)
    return jnp.where(positive, jnp.exp(weight @ jnp.log(jnp.where(positive, parameter, 1))), linear)


def separate(brdfs: Sequence[Callable], *, lobes: int = 8, separator: Callable | None = None) -> LobeBrdf:
    """Fits lobes to every BRDF of a set; returns one table whose parameter is the index of the BRDF.

    Args:
        brdfs: BRDFs (wi, wo) -> value [*b c] in 1/sr, either all isotropic or all anisotropic.
        lobes: Number of free lobes that `jaxprt.lobe.tabulate` fits to each BRDF.
        separator: Function from a BRDF to its table, in place of that fit. The published form is
            `mirror_lobes` in `benchmarks/published/lobes.py`.

    Raises:
        ValueError: There are no BRDFs, some are isotropic and some are not, or for the reasons that
            `jaxprt.lobe.tabulate` gives.

    Reference: Sun et al. 2007, section 4.1.
    """
    _check_sequence(brdfs)
    tables = [tabulate(each, lobes=lobes) if separator is None else separator(each) for each in brdfs]
    if len({each.isotropic for each in tables}) > 1:
        found = ", ".join("isotropic" if each.isotropic else "anisotropic" for each in tables)
        raise ValueError(f"brdfs must be all isotropic or none, got {found}")
    colors = max(len(each.weight) for each in tables)

    def stack(name: str, axis: int, colored: bool = False) -> Array:
        every = [np.asarray(getattr(each, name)) for each in tables]
        if colored:
            every = [np.broadcast_to(each, (colors, *each.shape[1:])) for each in every]
        return jax.device_put(np.stack(every, axis))

    number = jnp.asarray(np.arange(len(tables)), tables[0].scale.dtype)
    error = jnp.asarray(np.max([each.error for each in tables]))
    parts = (stack("mean", 2), stack("scale", 1), stack("weight", 2, True), stack("diffuse", 1, True))
    return LobeBrdf(*parts, (number,), error)


def factor(
    brdfs: Sequence[Callable],
    lobe: LobeBrdf | None,
    *,
    ranks: tuple[int, int, int] | None = None,
    resolution: int = 32,
) -> BrdfSet:
    """Makes a set of BRDFs from their lobes and a Tucker decomposition of the residual.

    Eight free lobes leave a residual that is not visible, so `ranks` can be None. With the published
    lobes, or without lobes, give `ranks`.

    The decomposed tensor holds the light that each BRDF reflects to each view from each spherical harmonic, weighted by
    the natural power spectrum. This minimizes the squared error of pictures, as in `jaxprt.separable.factor`, even with
    sharp peaks. Maps are parabolic. Light maps are limited to the bandwidth of the harmonics. For the published norm
    and maps, see `factor_tensor` in `benchmarks/published/tensors.py`.

    Args:
        brdfs: BRDFs (wi, wo) -> value [*b c] in 1/sr on local directions, without diffuse parts.
        lobe: Lobes of the BRDFs, from `separate`; None decomposes the whole BRDFs.
        ranks: Ranks of the set, the view and the light; None for no tensor. The published ranks are (4, 8, 8) for
            Cook-Torrance; Blinn-Phong has 3 for the set.
        resolution: Edge of the square maps in texels.

    Returns:
        The set. Its error is that of lobes and tensor together; without a tensor, the largest error of the lobes.

    Raises:
        ValueError: Neither lobes nor ranks are given; there are no BRDFs; the lobes are those of another number of
            BRDFs; a BRDF is negative or not finite; BRDFs have different numbers of colors; a rank is below 1 or above
            the size of the tensor; or `resolution` is below 4.

    Reference: Sun et al. 2007, section 3.2, equation 2, with the natural power spectrum in place of the Frobenius norm.
    """
    colors = check(brdfs, lobe, resolution=resolution)
    together = reflected.stacked(brdfs)
    if ranks is None:
        if lobe is None:
            raise ValueError("a set needs lobes, or ranks of a tensor, or both; got neither")
        shapes = ((0, 0, 0), (len(brdfs), len(lobe.weight), 0), (0, 4, 4))
        core, along, maps = (jnp.zeros(each, lobe.scale.dtype) for each in shapes)
        return BrdfSet(core, along, maps, maps, lobe, together, lobe.error)
    inside = int(np.count_nonzero(hemisphere.parabolic_texel_area(resolution=resolution)))
    check_ranks(ranks, (len(brdfs) * colors, inside, (reflected.DEGREE + 1) ** 2))
    found = reflected.reflect(brdfs, lobe, resolution=resolution)
    weight, rest = jnp.sqrt(found.area), (lobe, together)
    return decompose(found.tensor, found.to_map, weight, found.whole, ranks, rest, hemisphere.parabolic_coordinates)


def decompose(
    tensor: Float[Array, "m c d b"],
    to_map: Float[Array, "b e"],
    weight: Float[Array, " d"],
    whole: Float[Array, ""],
    ranks: tuple[int, int, int],
    rest: tuple[LobeBrdf | None, Callable | None],
    coordinates: Callable,
) -> BrdfSet:
    """Tucker decomposition of the light that a set of BRDFs reflects, and the maps of its factors.

    View maps, and then light maps, are the least-squares solution for fixed other factors. View maps also cover texels
    of zero weight.

    Args:
        tensor: Light that each BRDF and color reflects to the view of each texel from each basis function of the light.
        to_map: Light map that reflects the light of one basis function only, for each basis function.
        weight: Square root of the weight of each view.
        whole: Squared norm of the light that the whole BRDFs reflect.
        ranks: Ranks of the set, the view and the light.
        rest: Lobes and model of the set.
        coordinates: Function from a local direction to coordinates in the maps.

    Raises:
        ValueError: A rank is below 1 or above the size of the tensor.
    """
    count, colors = tensor.shape[:2]
    inside = np.flatnonzero(np.asarray(weight))
    check_ranks(ranks, (count * colors, len(inside), tensor.shape[3]))
    flat, met = _met(tensor, weight, inside)
    found = tucker.orient(tucker.truncated(met, ranks=tuple(ranks)))
    core, along, view, light, error = _maps(found, flat, met, to_map, weight, whole, inside)
    return BrdfSet(core, along.reshape(count, colors, -1), view, light, *rest, error, coordinates)


@jit
def _met(tensor: Array, weight: Array, inside: Array) -> tuple[Array, Array]:
    """The tensor with BRDFs and colors in one mode; and the same, weighted, for the views of nonzero weight only."""
    flat = tensor.reshape(-1, *tensor.shape[2:])
    return flat, flat[:, inside] * weight[inside, None]


@jit
def _maps(
    found: tucker.Tucker, flat: Array, met: Array, to_map: Array, weight: Array, whole: Array, inside: Array
) -> tuple[Array, ...]:
    """Core, factor of the set, view maps, light maps and relative error of a decomposition."""
    core, (along, _, across) = found.core, found.factor
    seen = tucker.multiply(tucker.multiply(flat, across, mode=2), along, mode=0)  # [h, view, k]
    unfolded = core.transpose(1, 0, 2).reshape(core.shape[1], -1)
    view = jnp.moveaxis(seen, 1, 0).reshape(len(weight), -1) @ jnp.linalg.pinv(unfolded, rtol=_RANK)
    made = jnp.einsum("mh,hok,do->mdk", along, core, view * weight[:, None])[:, inside]
    square = jnp.einsum("mdk,mdl->kl", made, made)
    light = jnp.linalg.pinv(square, rtol=_RANK**2, hermitian=True) @ jnp.einsum("mdk,mdb->kb", made, met)
    left = jnp.vdot(met, met) - jnp.vdot(light, square @ light)
    # Light maps carry the size of each term, so that the compression of transport can weight terms by it.
    size = jnp.sqrt(jnp.diagonal(square) / (jnp.sum(weight**2) * len(flat)))
    edge = math.isqrt(len(weight))
    view, light = (each.reshape(-1, edge, edge) for each in (view.T, size[:, None] * light @ to_map))
    return (
        core / jnp.where(size > 0, size, 1),
        along,
        view,
        light,
        jnp.sqrt(jnp.maximum(left, 0) / jnp.where(whole > 0, whole, 1)),
    )


def check(brdfs: Sequence[Callable], lobe: LobeBrdf | None, *, resolution: int) -> int:
    """Refuses an empty set, lobes of another set, and maps that are too small; returns the number of colors."""
    if resolution < 4:
        raise ValueError(f"resolution must be at least 4, got {resolution}")
    _check_sequence(brdfs)
    if lobe is not None and (len(lobe.knot) != 1 or lobe.scale.shape[1] != len(brdfs)):
        raise ValueError(
            f"the lobes must be made for the {len(brdfs)} BRDFs, got a table of shape {list(lobe.scale.shape)}"
        )
    direction = jax.ShapeDtypeStruct((1, 3), jnp.result_type(float))
    shapes = [eqx.filter_eval_shape(brdf, direction, direction).shape for brdf in brdfs]
    if len(set(shapes)) > 1 or len(shapes[0]) != 2 or shapes[0][1] not in (1, 3):
        raise ValueError(f"all BRDFs must map directions [b 3] to values [b 1], or all to [b 3], got {set(shapes)}")
    return shapes[0][1]


def _check_sequence(brdfs: Sequence[Callable]) -> None:
    if not isinstance(brdfs, Sequence):
        raise TypeError(f"brdfs must be a sequence of BRDFs, as Family.brdf is, got {type(brdfs).__name__}")
    if not brdfs:
        raise ValueError("brdfs must be at least one, got none")


def check_ranks(ranks: tuple[int, int, int], most: tuple[int, int, int]) -> None:
    """Refuses ranks that are not three whole numbers from 1 to the tensor's size."""
    whole = len(ranks) == 3 and all(isinstance(each, int | np.integer) for each in ranks)
    if not whole or any(not 1 <= r <= n for r, n in zip(ranks, most, strict=True)):
        raise ValueError(f"ranks must be three whole numbers, from 1 to the tensor's size {most}, got {ranks}")
