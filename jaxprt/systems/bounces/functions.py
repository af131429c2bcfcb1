"""BRDFs along light paths: a few functions whose weighted sums represent all BRDFs that a part can have.

    f_h(wi, wo) ~ sum_p H(h, p) f_p(wi, wo),    f_p(wi, wo) = sum_k g_kp(wo) u_k(wi)

Reflected light is linear in the weights H of every surface that it met. Transport along paths of functions p therefore
serves all BRDFs. Each function is factored over the two directions, so that a bounce consists of gathers and products.
A point receives reflected light from many directions and represents it by a few harmonics. The functions therefore
minimize the error of the reflected light after smoothing over directions. Fewer factors are then enough than if they
were chosen for pictures.

The material of a part may vary, in the weights w_k of the channels of its BRDF and in its roughness r:

    H_p = sum_k w_k A(k, p, r)

A is tabulated at knots of r. Light that a vertex sends to other surfaces thus has the same roughness as light that it
sends to the eye.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt.brdf import grid
from jaxprt.compile import jit
from jaxprt.decompose import tucker
from jaxprt.sphere import harmonics, hemisphere
from jaxprt.systems.dynamic import reflected
from jaxprt.systems.dynamic.reflected import Reflected
from jaxprt.systems.protocol import Blend
from jaxprt.systems.separable import SeparableBrdf

_RINGS, _SECTORS = 32, 64  # quadrature of a bilinear map times low-order harmonics
_SMOOTH = 5  # degree of smoothing: 4 loses more of the light from the horizon, 6 more of all light
_RANK = 1e-3  # smaller singular values, relative to the largest, are rounding in float32
_NOTHING = 1e-3  # smaller singular values, relative to the largest: a color is a multiple of another


def shared(
    brdfs: Sequence[Callable], *, functions: int, terms: int = 32, resolution: int = 32
) -> tuple[SeparableBrdf, Float[Array, "m c p"]]:
    """Functions that represent several BRDFs and their colors, factored over the light, with equal weights of BRDFs.

    The decomposition minimizes the squared error of the light that the BRDFs reflect under light with a natural
    spectrum, smoothed over outgoing directions to degree 5. Views are not compressed, because transport does not depend
    on their number.

    Args:
        brdfs: BRDFs (wi, wo) -> value [*b c] in 1/sr on local directions, all with the same number of colors, without
            diffuse parts.
        functions: Number of functions, limited by the number of BRDFs times colors.
        terms: Number of light factors that they share, limited by what the maps can represent.
        resolution: Edge of the square maps in texels.

    Returns:
        The functions as colors of one factored BRDF, followed by a diffuse function of albedo 1; and their weights for
        each BRDF and color. The weights of the diffuse function are zero, and the largest weight of every other
        function is 1.

    Raises:
        ValueError: A BRDF is negative or not finite.
    """
    light, size = _evened(reflected.reflect(brdfs, None, resolution=resolution))
    smooth, colors = _smoothed(light), light.tensor.shape[1]
    kinds = min(smooth.shape[1], len(light.area))
    ranks = (min(functions, len(smooth)), kinds, min(terms, light.tensor.shape[3]))
    least = tucker.orient(tucker.truncated(smooth, ranks=ranks))
    view, light = _maps(light, least)
    along = _projected(smooth, least)
    error = _missed(smooth, along, least)
    weight = along.reshape(len(brdfs), colors, -1) * size[:, None, None]
    most = jnp.max(jnp.abs(weight), (0, 1))
    most = jnp.where(most > 0, most, 1)
    core = jnp.eye(len(most) * ranks[2], dtype=view.dtype).reshape(len(most), ranks[2], -1).swapaxes(1, 2)
    light_map, view_map = _functions(core * most[:, None, None], view, light)
    weight = jnp.pad(weight / most, ((0, 0), (0, 0), (0, 1)))
    return SeparableBrdf(light_map, view_map, error, hemisphere.parabolic_coordinates), weight


@jit
def _evened(light: Reflected) -> tuple[Reflected, Float[Array, " m"]]:
    """The reflected light of each BRDF, divided by its norm, and the norms."""
    sent = _smoothed(light).reshape(len(light.tensor), -1)
    size = jnp.sqrt(jnp.sum(sent**2, 1))
    size = jnp.where(size > 0, size, 1)
    return light._replace(tensor=light.tensor / size[:, None, None, None]), size


@jit
def _smoothed(light: Reflected) -> Float[Array, "m s b"]:
    """The light that each BRDF and color reflects, as harmonics of the view."""
    seen = harmonics.evaluate(light.direction, degree=_SMOOTH) * light.area[:, None]
    return tucker.multiply(light.tensor.reshape(-1, *light.tensor.shape[2:]), seen, mode=1)


@jit
def _maps(light: Reflected, least: tucker.Tucker) -> tuple[Array, Array]:
    """View maps of each function and term, and light maps, of a decomposition."""
    along, _, across = least.factor
    flat = light.tensor.reshape(-1, *light.tensor.shape[2:])
    view = tucker.multiply(tucker.multiply(flat, across, mode=2), along, mode=0)  # [h, d, k]
    # Light maps carry the size of each term, so that view factors have a mean square of about one.
    square = jnp.einsum("hdk,d->k", view**2, light.area) / (jnp.sum(light.area) * len(flat))
    size = jnp.where(square > 0, jnp.sqrt(square), 1)
    edge = math.isqrt(len(light.area))
    return (
        jnp.moveaxis(view / size, 1, 2).reshape(-1, edge, edge),
        (size[:, None] * (across.T @ light.to_map)).reshape(-1, edge, edge),
    )


@jit
def _projected(smooth: Float[Array, "n s b"], least: tucker.Tucker) -> Float[Array, "n h"]:
    """Least-squares weights of the functions for the light that BRDFs reflect."""
    core = least.core.reshape(len(least.core), -1)
    sent = tucker.multiply(tucker.multiply(smooth, least.factor[2], mode=2), least.factor[1], mode=1)
    square = jnp.linalg.pinv(core @ core.T, rtol=_RANK**2, hermitian=True)
    return sent.reshape(len(smooth), -1) @ core.T @ square


@jit
def _missed(smooth: Float[Array, "n s b"], along: Float[Array, "n h"], least: tucker.Tucker) -> Float[Array, ""]:
    """Relative error of the light that functions with given weights reflect."""
    sent = tucker.Tucker(least.core, (along, *least.factor[1:])).full()
    whole = jnp.vdot(smooth, smooth)
    return jnp.sqrt(jnp.vdot(sent - smooth, sent - smooth) / jnp.where(whole > 0, whole, 1))


def basis(brdf: SeparableBrdf) -> SeparableBrdf:
    """The path functions f_p of a factored BRDF, as the colors of another one.

    There are as many as its colors need: one if all are multiples of one color.
    Reference: Sun et al. 2007, section 3.1.
    """
    view = jnp.matmul(brdf.view_map, fixed_weights(brdf).T, precision="highest")
    return SeparableBrdf(brdf.light_map, view, brdf.error, brdf.coordinates)


@jit
def _functions(core: Array, view_map: Array, light_map: Array) -> tuple[Array, Array]:
    """Light and view maps of the functions of a set, followed by those of a constant function."""
    view = jnp.einsum("hoi,oyx->iyxh", core, view_map)
    light = jnp.concatenate([light_map, jnp.ones_like(light_map[:1])])[..., None]
    return light, jnp.pad(view, ((0, 1), (0, 0), (0, 0), (0, 1))).at[-1, ..., -1].set(1 / np.pi)


@partial(jit, static_argnames=("degree",))
def project(basis: SeparableBrdf, *, degree: int) -> Float[Array, "s k"]:
    """Projection of light factors on harmonics in the local frame: integrals over the hemisphere with the cosine.

    Reference: Sun et al. 2007, section 3.3, the matrix C of one-bounce interreflection.
    """
    up = jnp.zeros(3, basis.light_map.dtype).at[2].set(1)
    direction, area = hemisphere.arcs(up, rings=_RINGS, sectors=_SECTORS)
    factor = basis.light(direction)[..., 0] * (direction[:, 2] * area)[:, None]
    return harmonics.evaluate(direction, degree=degree).T @ factor


@jit
def albedo(basis: SeparableBrdf) -> Float[Array, " p"]:
    """Hemispherical albedo of each function: the fraction of uniform light that it reflects into all directions."""
    up = jnp.zeros(3, basis.light_map.dtype).at[2].set(1)
    direction, area = hemisphere.arcs(up, rings=_RINGS, sectors=_SECTORS)
    flux = direction[:, 2] * area
    response = flux @ basis.light(direction)[..., 0]
    return jnp.einsum("d,dkp,k->p", flux / np.pi, basis.view(direction), response)


def fixed_weights(brdf: SeparableBrdf) -> Float[Array, "p c"]:
    """Weights of the functions of one BRDF that cannot change. They are orthonormal, and as few as its colors need."""
    if brdf.light_map.shape[-1] != 1:
        raise ValueError(
            f"light maps must have one channel that all colors share, got {brdf.light_map.shape[-1]} channels"
        )
    light, view = (np.asarray(maps, np.float64) for maps in (brdf.light_map, brdf.view_map))
    rows = view * np.sqrt(np.mean(light**2, (1, 2, 3), keepdims=True))
    _, value, axis = np.linalg.svd(rows.reshape(-1, brdf.view_map.shape[-1]), full_matrices=False)
    # Fix the signs, which rounding would decide otherwise.
    axis = axis * np.where(axis.sum(1, keepdims=True) < 0, -1, 1)
    return jnp.asarray(axis[value > _NOTHING * max(value[0], np.finfo(np.float32).tiny)], brdf.view_map.dtype)


class FunctionWeights(eqx.Module):
    """Weights of path functions for the channels of a BRDF.

    Attributes:
        knot: Increasing values of each parameter; empty for a BRDF without a parameter.
        factor: Weight of each function p for each channel k at each knot, with one axis for each parameter; one row
            without knots.
    """

    knot: tuple[Float[Array, " _"], ...]
    factor: Float[Array, "*n k p"]

    def __check_init__(self):
        """Refuses factors for another number of knots."""
        knots = [len(values) for values in self.knot] or [1]
        if list(self.factor.shape[:-2]) != knots:
            raise ValueError(
                f"the factors must have {knots} rows, one for each knot, got {list(self.factor.shape[:-2])}"
            )

    def weights(self, blend: Blend) -> Float[Array, "v p c"]:
        """Weights of the functions for the material of each vertex, given the weights of the BRDF channels there."""
        return _weights(self, blend)


@jit
def _weights(sent: FunctionWeights, blend: Blend) -> Array:
    if not sent.knot:
        return jnp.einsum("kp,vkc->vpc", sent.factor[0], blend.weight, precision="highest")
    between = [((low, 1 - upper), (low + 1, upper)) for low, upper in grid.among(sent.knot, blend.parameter)]
    total: Array | float = 0.0
    for corner in itertools.product(*between):
        share = jnp.asarray(math.prod(part for _, part in corner))
        total = total + sent.factor[tuple(place for place, _ in corner)] * share[:, None, None]
    return jnp.einsum("vkp,vkc->vpc", total, blend.weight, precision="highest")
