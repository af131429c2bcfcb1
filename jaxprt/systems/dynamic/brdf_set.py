"""A set of BRDFs in a form that can change at run time: lobes of each, and what they leave as one small tensor.

    f(h, wi, wo) ~ lobes_h(wi, wo) + sum_ijk D(i, j, k) U^h(h, i) U^wo(wo, j) U^wi(wi, k)

Transport needs the light factors U^wi alone, which all BRDFs of the set share. A BRDF chosen at run time is a
separable one on these, with view maps of its own, and a table of lobes. Diffuse parts are kept out of the set: every
transport has a term for them. The set is gray where its BRDFs are; of colored ones each color is a BRDF of its own.
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

_GRAZING = 1e-3  # least cosine that a product with it is divided by
_RANK = 1e-3  # of the largest singular value, below which float32 has no more


class Mixed(eqx.Module):
    """The BRDF at one place of a set; `__call__` gives its value in 1/sr, as far as lobes and terms carry it.

    Attributes:
        terms: What the lobes leave.
        lobe: The lobes, if the set has any.
        brdf: The model whose parameters are between those of the set, where they have such a mean.
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


class DynamicBrdf(eqx.Module):
    """A set of BRDFs, without their diffuse parts.

    Attributes:
        core: D, with as many numbers along each axis as its rank: of the set, of the view, of the light.
        factor: U^h of each BRDF and color, gray or per color; or of each pair of BRDFs, see `combined`.
        view_map: U^wo on the view direction.
        light_map: U^wi on the incident direction, in 1/sr; view factors of a BRDF have a mean square of about one.
        lobe: Lobes of each BRDF, along the one parameter of the table; none if None.
        brdf: The set as one model whose parameters have a leading axis; None where the BRDFs have no such form.
        error: Relative L2 error of the light that all BRDFs reflect to all views, under light of natural spectrum.
        coordinates: From local direction to coordinates in the maps.
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
        """Pickles the function of coordinates by its name: pickle cannot take jitted functions."""
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
        """The BRDF with a weight for each of the set, as `jaxprt.brdf.navigation` makes them from coordinates.

        Weights sum to one. Terms are mixed, as `combined` has it. Lobes move from the place and width that they have in
        one BRDF to those that they have in the next; the published ones are the same in all. Differentiable in the
        weights.

        Raises:
            ValueError: The weights are not one for each BRDF of the set.
        """
        if weight.shape != (self.size,):
            raise ValueError(f"weights must be one for each of {self.size} BRDFs, got {list(weight.shape)}")
        view = jnp.einsum("ch,hoi,oyx->iyxc", combined(self.factor, weight), self.core, self.view_map)
        terms = SeparableBrdf(self.light_map[..., None], view, self.error, self.coordinates)
        lobe = None if self.lobe is None else mean(self.lobe, weight)
        return Mixed(terms, lobe, jax.tree.map(lambda x: between(x, weight), self.brdf))


@jit
def combined(factor: Float[Array, "m *_ c h"], weight: Float[Array, " m"]) -> Float[Array, "c h"]:
    """Factors of a BRDF between those of a set.

    Factors of each BRDF are mixed linearly. Those of each pair are mixed by a quadratic form, divided by the sum of the
    weights: what one pair makes half and half is then free, and can be that of the BRDF which is really there.

    Args:
        factor: Of each BRDF, or of each pair, with colors.
        weight: The weight of each BRDF.
    """
    if factor.ndim == 3:
        return jnp.tensordot(weight, factor, 1)
    whole = jnp.sum(weight)
    return jnp.einsum("m,n,mnch->ch", weight, weight, factor) / jnp.where(whole == 0, 1, whole)


@jit
def between(parameter: Float[Array, "m *c"], weight: Float[Array, " m"]) -> Float[Array, "*c"]:
    """A parameter of a model between those of a set.

    A width or exponent, which has no colors, has its mean in the logarithm if it is positive in the whole set, as lobes
    have it; all others are mixed linearly.
    """
    linear = jnp.tensordot(weight, parameter, 1)
    if parameter.ndim > 1:
        return linear
    positive = jnp.all(parameter > 0)
    return jnp.where(positive, jnp.exp(weight @ jnp.log(jnp.where(positive, parameter, 1))), linear)


def separate(brdfs: Sequence[Callable], *, lobes: int = 8, separator: Callable | None = None) -> LobeBrdf:
    """Lobes of every BRDF of a set, as one table along the number of the BRDF.

    Args:
        brdfs: BRDFs (wi, wo) -> value [*b c] in 1/sr, all isotropic or none.
        lobes: Number of free lobes, which `jaxprt.lobe.tabulate` fits; or
        separator: what makes a table of one BRDF: `jaxprt.lobe.published.mirror_lobes` for the published form.

    Raises:
        ValueError: No BRDFs, some isotropic and some not, or as of `jaxprt.lobe.tabulate`.

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
) -> DynamicBrdf:
    """Makes a set of BRDFs of their lobes, and decomposes what these leave, for the light that it will meet.

    Of eight free lobes a percent of the light is left, and terms of that change nothing that can be seen: they need no
    ranks. The published lobes, or none, do.

    The tensor is the light that each BRDF reflects to each view from each spherical harmonic, weighted as natural light
    has it: least squares for the picture, as in `jaxprt.separable.factor`, whatever sharp peaks there are. Maps
    are parabolic, and light maps limited to the band of the harmonics. The published norm and maps are
    `jaxprt.dynamic.published.factor_tensor`.

    Args:
        brdfs: BRDFs (wi, wo) -> value [*b c] in 1/sr on local directions, without diffuse parts.
        lobe: Their lobes, from `separate`; None decomposes the BRDFs whole.
        ranks: Factors of the set, of the view and of the light; no terms if None. The published ones are (4, 8, 8) for
            Cook-Torrance's model, 3 of the set for Blinn-Phong's.
        resolution: Edge of the square maps in texels.

    Returns:
        The set. Its error is what lobes and terms together leave; without terms the largest error of the lobes.

    Raises:
        ValueError: Neither lobes nor ranks, no BRDFs, lobes of another number of them, BRDFs that are negative or not
            finite or of unequal numbers of colors, a rank below 1 or above the tensor's size, or a resolution below 4.

    Reference: Sun et al. 2007, section 3.2, equation 2, with the prior in place of their Frobenius norm.
    """
    colors = check(brdfs, lobe, resolution=resolution)
    together = reflected.stacked(brdfs)
    if ranks is None:
        if lobe is None:
            raise ValueError("a set needs lobes, or ranks of a tensor, or both; got neither")
        shapes = ((0, 0, 0), (len(brdfs), len(lobe.weight), 0), (0, 4, 4))
        core, along, maps = (jnp.zeros(each, lobe.scale.dtype) for each in shapes)
        return DynamicBrdf(core, along, maps, maps, lobe, together, lobe.error)
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
) -> DynamicBrdf:
    """Tucker decomposition of what a set of BRDFs reflects, and the maps of its factors.

    View maps and then light maps are least squares with all other factors as they are, also on texels of no weight.

    Args:
        tensor: What each BRDF and color reflects to the view of each texel from each of some kinds of light.
        to_map: Light maps of what reflects one kind of light each.
        weight: Root of what the square of each view counts.
        whole: Squared norm of what the whole BRDFs reflect.
        ranks: As of `factor`.
        rest: Lobes and model of the set.
        coordinates: Of the maps.

    Raises:
        ValueError: Ranks below 1 or above the tensor's size.
    """
    count, colors = tensor.shape[:2]
    inside = np.flatnonzero(np.asarray(weight))
    check_ranks(ranks, (count * colors, len(inside), tensor.shape[3]))
    flat, met = _met(tensor, weight, inside)
    found = tucker.oriented(tucker.truncated(met, ranks=tuple(ranks)))
    core, along, view, light, error = _maps(found, flat, met, to_map, weight, whole, inside)
    return DynamicBrdf(core, along.reshape(count, colors, -1), view, light, *rest, error, coordinates)


@jit
def _met(tensor: Array, weight: Array, inside: Array) -> tuple[Array, Array]:
    """The tensor with BRDFs and colors in one mode, whole and with the weights of the views that have one."""
    flat = tensor.reshape(-1, *tensor.shape[2:])
    return flat, flat[:, inside] * weight[inside, None]


@jit
def _maps(
    found: tucker.Tucker, flat: Array, met: Array, to_map: Array, weight: Array, whole: Array, inside: Array
) -> tuple[Array, ...]:
    """Core, factor of the set, view maps and light maps of a decomposition, and their error."""
    core, (along, _, across) = found.core, found.factor
    seen = tucker.multiply(tucker.multiply(flat, across, mode=2), along, mode=0)  # [h, view, k]
    unfolded = core.transpose(1, 0, 2).reshape(core.shape[1], -1)
    view = jnp.moveaxis(seen, 1, 0).reshape(len(weight), -1) @ jnp.linalg.pinv(unfolded, rtol=_RANK)
    made = jnp.einsum("mh,hok,do->mdk", along, core, view * weight[:, None])[:, inside]
    square = jnp.einsum("mdk,mdl->kl", made, made)
    light = jnp.linalg.pinv(square, rtol=_RANK**2, hermitian=True) @ jnp.einsum("mdk,mdb->kb", made, met)
    left = jnp.vdot(met, met) - jnp.vdot(light, square @ light)
    # Light maps carry the size, so that what compresses transport knows what each is worth.
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
    """Refuses a set without BRDFs, lobes of another set, and maps too small; returns the number of colors."""
    if resolution < 4:
        raise ValueError(f"resolution must be at least 4, got {resolution}")
    _check_sequence(brdfs)
    if lobe is not None and (len(lobe.knot) != 1 or lobe.scale.shape[1] != len(brdfs)):
        raise ValueError(f"the lobes must be those of the {len(brdfs)} BRDFs, got {list(lobe.scale.shape)}")
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
