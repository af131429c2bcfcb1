"""Published factorizations of BRDFs: eigenvectors of each color, one normalized term, and the published error.

Maps are orthographic or polar. The BRDF is sampled at the texels, and each texel is weighted by the integral of
cos(theta) d omega over it. On the orthographic disk all weights are equal, so the matrix is the published one.
"""

import math
from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks.published import maps
from jaxprt.brdf import models
from jaxprt.compile import jit
from jaxprt.decompose import eigen
from jaxprt.sphere import hemisphere
from jaxprt.systems.separable.factorization import SeparableBrdf, tabulate

_RECIPROCAL = 1e-3  # largest relative asymmetry of M at which its eigenvectors count as singular vectors
_TEXELS: dict[Callable, tuple[Callable, Callable]] = {
    hemisphere.disk_coordinates: (maps.texel_direction, maps.texel_area),
    hemisphere.polar_coordinates: (maps.polar_texel_direction, maps.polar_texel_area),
}


def factor_symmetric(
    brdf: Callable,
    *,
    terms: int,
    resolution: int = 48,
    coordinates: Callable = hemisphere.disk_coordinates,
    solve: Callable = eigen.symmetric,
) -> SeparableBrdf:
    """Factors each color of a reciprocal BRDF by the eigenvectors of its matrix, as published.

    The light map and the view map of a term differ by the sign of its eigenvalue only. The factorization is optimal in
    the Frobenius norm on the disk, which a few grazing texels dominate. Use `separable.factor` unless you need the
    published form.

    Polar maps minimize the same norm and resolve grazing directions more finely: at 48 x 48 their last row spans 2.4
    degrees, the last texel of the disk 14 degrees.

    Args:
        brdf: Reciprocal BRDF (wi, wo) -> value [*b c] in 1/sr on local directions.
        terms: Number of terms.
        resolution: Edge of the square maps in texels.
        coordinates: `hemisphere.disk_coordinates` or `hemisphere.polar_coordinates`.
        solve: Function that returns eigenpairs of a symmetric matrix: `eigen.symmetric`, or `eigen.power` for the
            published power iteration. The latter may not converge; `error` of the result then shows it.

    Returns:
        The factored BRDF with one light map per color. Its error is relative, in the Frobenius norm.

    Raises:
        ValueError: There are more terms than texels, `coordinates` is another function, or the BRDF is not reciprocal
            or returns values that are not finite or have no color axis.

    Reference: Wang, Tran, Luebke 2004, section 3.2, equations 7 and 8, and appendix (S = |D|, not D^2).
    """
    direction, area = texels(resolution, coordinates)
    inside = np.flatnonzero(area)
    if not 1 <= terms <= inside.size:
        raise ValueError(f"terms must be between 1 and {inside.size}, got {terms}")
    table = tabulate(brdf, direction)
    light_map, view_map, error, asymmetry = _eigenvectors(table, area, inside, terms=terms, solve=solve)
    if asymmetry > _RECIPROCAL:
        raise ValueError(f"the BRDF must be reciprocal; f(wi, wo) and f(wo, wi) differ by {asymmetry:.3g}")
    return SeparableBrdf(light_map, view_map, error, coordinates)


@partial(jit, static_argnames=("terms", "solve"))
def _eigenvectors(
    table: Array, area: Array, inside: Array, *, terms: int, solve: Callable
) -> tuple[Array, Array, Array, Array]:
    """Light and view maps, their error, and the relative asymmetry of the BRDF."""
    root = jnp.sqrt(area[inside])
    matrix = table[:, inside][:, :, inside] * root * root[:, None]
    total = jnp.sum(matrix**2)
    asymmetry = jnp.sqrt(jnp.sum((matrix - matrix.swapaxes(1, 2)) ** 2) / jnp.maximum(total, 1e-30))
    value, vector, _ = jax.vmap(lambda m: solve(m, terms=terms))(matrix)
    image = matrix @ vector
    # M v extends an eigenvector v to texels outside the disk, which bilinear lookup reads at the rim. It is divided by
    # its own norm, which is |value| for an eigenvector and larger for a vector that has not converged.
    norm = jnp.linalg.norm(image, axis=1, keepdims=True) * jnp.sign(value)[:, None]
    beyond = table[:, :, inside] @ (vector * root[:, None]) / jnp.where(norm == 0, 1, norm)
    light_map = beyond.at[:, inside].set(vector / root[:, None]) * jnp.sqrt(jnp.abs(value))[:, None]
    shape = (terms, math.isqrt(area.size), -1, table.shape[0])
    light_map = jnp.moveaxis(light_map, -1, 0).swapaxes(1, 2).reshape(shape)
    view_map = light_map * jnp.sign(value).T[:, None, None, :]
    # |M - V D V^T|^2, which is valid for any vectors V
    overlap = jnp.einsum("cir,cis->crs", vector, vector) ** 2
    kept = 2 * jnp.sum(value * jnp.sum(vector * image, 1)) - jnp.einsum("cr,crs,cs->", value, overlap, value)
    return light_map, view_map, jnp.sqrt(jnp.maximum(total - kept, 0) / jnp.maximum(total, 1e-30)), asymmetry


def factor_normalized(
    brdf: Callable, *, resolution: int = 48, coordinates: Callable = hemisphere.disk_coordinates
) -> SeparableBrdf:
    """Factors a BRDF into one term by normalized decomposition: norms of its rows, and the mean of the normalized rows.

    A row holds the values of one view direction and color over all incident directions. Its norm is the sum of its
    absolute values weighted by texel area, which is the reflectance for that view and color. The term therefore
    reflects constant light without shadows exactly like the BRDF, for every view. The norms form the view map, per
    color. The light map is gray, with integral one over the disk. There is no iteration.

    Args:
        brdf: BRDF (wi, wo) -> value [*b c] in 1/sr on local directions. It need not be reciprocal.
        resolution: Edge of the square maps in texels.
        coordinates: `hemisphere.disk_coordinates` or `hemisphere.polar_coordinates`.

    Returns:
        A factored BRDF of one term. Its error is relative, in the Frobenius norm weighted by texel area.

    Raises:
        ValueError: `coordinates` is another function, the resolution is below 2, or the BRDF returns values that are
            not finite or have no color axis.

    Reference: Kautz and McCool 1999, "Interactive rendering with arbitrary BRDFs using separable approximations", for
    the decomposition with any norm. The norm, and colors in the view map only, are our choices.
    """
    direction, area = texels(resolution, coordinates)
    light_map, view_map, error = _normalized(tabulate(brdf, direction), area)
    return SeparableBrdf(light_map, view_map, error, coordinates)


@jit
def _normalized(table: Array, area: Array) -> tuple[Array, Array, Array]:
    """Light map, view map and their error."""
    view_map = jnp.sum(jnp.abs(table) * area, -1)
    weight = area * (view_map > 0)
    rows = weight / jnp.where(view_map > 0, view_map, 1) / jnp.maximum(jnp.sum(weight), 1e-30)
    light_map = jnp.einsum("co,coi->i", rows, table)
    both = area * area[:, None]
    total = jnp.sum(table**2 * both)
    lost = jnp.sum((table - view_map[..., None] * light_map) ** 2 * both)
    shape = (1, edge := math.isqrt(area.size), edge, -1)
    return light_map.reshape(shape), view_map.T.reshape(shape), jnp.sqrt(lost / jnp.maximum(total, 1e-30))


def red_plastic() -> models.BlinnPhong:
    """A red plastic. Wang et al. show one without parameters; these parameters are ours."""
    return models.BlinnPhong(diffuse=jnp.array([0.45, 0.05, 0.04]), specular=0.15, exponent=60.0)


def brown_plastic() -> models.BlinnPhong:
    """A light brown plastic. Wang et al. show one without parameters; these parameters are ours.

    The other materials of their section 4.1 are `AshikhminShirley` with its default parameters, and the clay and skin
    of Lafortune et al., which `load_lafortune` reads.
    """
    return models.BlinnPhong(diffuse=jnp.array([0.45, 0.3, 0.17]), specular=0.12, exponent=40.0)


def texels(resolution: int, coordinates: Callable) -> tuple[Array, Array]:
    """Directions of the texels of a map, and the integral of cos(theta) d omega over each.

    Raises:
        ValueError: `coordinates` is neither disk nor polar, or the resolution is below 2.
    """
    if resolution < 2:
        raise ValueError(f"resolution must be at least 2, got {resolution}")
    if coordinates not in _TEXELS:
        raise ValueError(f"coordinates must be hemisphere.disk_coordinates or polar_coordinates, got {coordinates}")
    direction, area = _TEXELS[coordinates]
    return direction(resolution=resolution).reshape(-1, 3), area(resolution=resolution).ravel()


def sample_error(
    brdf: Callable, factored: Callable, *, samples: int = 80_000
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """RMS difference of two BRDFs over random pairs of directions, weighted by the cosine of the incident direction.

    The error is sqrt(sum cos_i |f - g|^2 / sum cos_i), with squares averaged over colors. Both directions are drawn
    independently, uniformly in solid angle above the horizon; every call draws the same ones. Half of the views lie
    within 30 degrees of the horizon, where glossy BRDFs have their largest values and contribute most of the error. The
    error of rendered radiance can be much smaller; `jaxprt.separable.light_errors` measures it.

    Args:
        brdf: BRDF (wi, wo) -> value [*b c] in 1/sr on local directions.
        factored: The factored BRDF, or any other BRDF with the same number of colors, or gray.
        samples: Number of pairs of directions.

    Returns:
        The error in 1/sr, and the error relative to the root mean square of the BRDF with the same weights. The latter
        is zero if both are zero.

    Raises:
        ValueError: `samples` is below 1.

    Reference: Wang, Tran, Luebke 2004, section 4.3. The paper does not state the distribution of its samples; uniform
    sampling is our choice.
    """
    if samples < 1:
        raise ValueError(f"samples must be at least 1, got {samples}")
    return _sample_error(brdf, factored, samples)


@eqx.filter_jit
def _sample_error(brdf: Callable, factored: Callable, samples: int) -> tuple[Array, Array]:
    height, turn = jax.random.uniform(jax.random.key(0), (2, 2, samples), jnp.result_type(float))
    height = 1 - height  # in (0, 1], above the horizon
    radius, angle = jnp.sqrt(1 - height**2), 2 * jnp.pi * turn
    wi, wo = jnp.stack([radius * jnp.cos(angle), radius * jnp.sin(angle), height], -1)
    value = brdf(wi, wo)
    weight = wi[:, 2:] / jnp.sum(wi[:, 2])
    error, size = (jnp.sqrt(jnp.sum(weight * f**2) / f.shape[-1]) for f in (factored(wi, wo) - value, value))
    return error, error / jnp.where((error == 0) & (size == 0), 1, size)
