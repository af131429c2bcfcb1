"""Forms of BRDFs as published: eigenvectors of each color, one normalized term, mirror lobes, tensors of sets.

Maps are orthographic or polar. Either samples the BRDF at its texels; every texel counts by the integral of
cos(theta) d omega over it. On the orthographic disk these are all equal, so that the matrix is the published one.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxprt.brdf import dynamic, lobe, lobe_em, models, reflected
from jaxprt.brdf.separable import SeparableBrdf, tabulate
from jaxprt.linalg import eigen, mixture
from jaxprt.sphere import hemisphere

_RECIPROCAL = 1e-3  # Asymmetry beyond which the eigenvectors of M are not its singular vectors.
_TEXELS: dict[Callable, tuple[Callable, Callable]] = {
    hemisphere.disk_coordinates: (hemisphere.texel_direction, hemisphere.texel_area),
    hemisphere.polar_coordinates: (hemisphere.polar_texel_direction, hemisphere.polar_texel_area),
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

    The light and the view map of a term differ by the sign of its eigenvalue. Optimal in the Frobenius norm of the
    disk, which a few grazing texels dominate: prefer `separable.factor` unless the published form itself is wanted.

    Polar maps minimize the same norm and resolve grazing directions more finely: their last row of 48 spans 2.4
    degrees, the last texel of the disk 14. One term of Ashikhmin-Shirley's BRDF, for which the paper finds them
    significantly better, has the same `errors.sample_error` in both, 0.98; with 4 terms that of the disk is 0.93 and
    that of polar maps 0.98, since they spend their terms on the large values that they resolve.

    Args:
        brdf: A reciprocal BRDF, any callable (wi, wo) -> value [*b c] in 1/sr on local directions.
        terms: Number of terms.
        resolution: Edge of the square maps in texels.
        coordinates: `hemisphere.disk_coordinates` or `hemisphere.polar_coordinates`.
        solve: Gives eigenpairs of a matrix: `eigen.symmetric`, or `eigen.power` for the iteration as printed, which
            need not converge; the error then says what came of it.

    Returns:
        The factored BRDF with one light map per color; its error is relative, in the Frobenius norm.

    Raises:
        ValueError: More terms than texels, other coordinates, or a BRDF that is not finite, not reciprocal or has no
            channel axis.

    Reference: Wang, Tran, Luebke 2004, section 3.2, equations 7 and 8, and appendix (S = |D|, not D^2).
    """
    direction, area = _texels(resolution, coordinates)
    inside = np.flatnonzero(area)
    if not 1 <= terms <= inside.size:
        raise ValueError(f"terms must be between 1 and {inside.size}, got {terms}")
    table = tabulate(brdf, direction)
    light_map, view_map, error, asymmetry = _eigenvectors(table, area, inside, terms=terms, solve=solve)
    if asymmetry > _RECIPROCAL:
        raise ValueError(f"the BRDF must be reciprocal; f(wi, wo) and f(wo, wi) differ by {asymmetry:.3g}")
    return SeparableBrdf(light_map, view_map, error, coordinates)


@partial(jax.jit, static_argnames=("terms", "solve"))
def _eigenvectors(
    table: Array, area: Array, inside: Array, *, terms: int, solve: Callable
) -> tuple[Array, Array, Array, Array]:
    """Light and view maps, their error, and how far the BRDF is from reciprocal."""
    root = jnp.sqrt(area[inside])
    matrix = table[:, inside][:, :, inside] * root * root[:, None]
    total = jnp.sum(matrix**2)
    asymmetry = jnp.sqrt(jnp.sum((matrix - matrix.swapaxes(1, 2)) ** 2) / jnp.maximum(total, 1e-30))
    value, vector, _ = jax.vmap(lambda m: solve(m, terms=terms))(matrix)
    image = matrix @ vector
    # M v continues an eigenvector v to texels outside the disk, which bilinear lookup needs at the rim; divided by its
    # own norm, which is |value| for an eigenvector and more for what has not converged to one.
    norm = jnp.linalg.norm(image, axis=1, keepdims=True) * jnp.sign(value)[:, None]
    beyond = table[:, :, inside] @ (vector * root[:, None]) / jnp.where(norm == 0, 1, norm)
    light_map = beyond.at[:, inside].set(vector / root[:, None]) * jnp.sqrt(jnp.abs(value))[:, None]
    shape = (terms, math.isqrt(area.size), -1, table.shape[0])
    light_map = jnp.moveaxis(light_map, -1, 0).swapaxes(1, 2).reshape(shape)
    view_map = light_map * jnp.sign(value).T[:, None, None, :]
    # |M - V D V^T|^2, whether or not the vectors are eigenvectors.
    overlap = jnp.einsum("cir,cis->crs", vector, vector) ** 2
    kept = 2 * jnp.sum(value * jnp.sum(vector * image, 1)) - jnp.einsum("cr,crs,cs->", value, overlap, value)
    return light_map, view_map, jnp.sqrt(jnp.maximum(total - kept, 0) / jnp.maximum(total, 1e-30)), asymmetry


def factor_normalized(
    brdf: Callable, *, resolution: int = 48, coordinates: Callable = hemisphere.disk_coordinates
) -> SeparableBrdf:
    """One term by normalized decomposition: norms of the BRDF's rows, and the mean of the rows divided by them.

    A row holds the values of one view direction and color over all incident directions. Its norm here is the sum of
    its absolute values by texel area, which is the reflectance of that view in that color: the one term reflects
    constant light without occluders as the BRDF does, in every direction of view. The norms are the view map, per
    color; the light map is gray and its integral over the disk is one. One pass over the BRDF, without iteration.

    Args:
        brdf: Any callable (wi, wo) -> value [*b c] in 1/sr on local directions; need not be reciprocal.
        resolution: Edge of the square maps in texels.
        coordinates: `hemisphere.disk_coordinates` or `hemisphere.polar_coordinates`.

    Returns:
        A factored BRDF of one term; its error is relative, in the Frobenius norm by texel area.

    Raises:
        ValueError: Other coordinates, a resolution below two, or a BRDF that is not finite or has no channel axis.

    Reference: Kautz and McCool 1999, "Interactive rendering with arbitrary BRDFs using separable approximations", for
        the decomposition by any norm; which norm, and color in the view map alone, are choices here.
    """
    direction, area = _texels(resolution, coordinates)
    light_map, view_map, error = _normalized(tabulate(brdf, direction), area)
    return SeparableBrdf(light_map, view_map, error, coordinates)


@jax.jit
def _normalized(table: Array, area: Array) -> tuple[Array, Array, Array]:
    """Light and view map, and their error."""
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
    """A red plastic; Wang et al. show one and print no parameters, these are chosen here."""
    return models.BlinnPhong(diffuse=jnp.array([0.45, 0.05, 0.04]), specular=0.15, exponent=60.0)


def brown_plastic() -> models.BlinnPhong:
    """A light brown plastic; Wang et al. show one and print no parameters, these are chosen here.

    The other materials of their section 4.1 are `AshikhminShirley` as it stands, and clay and skin of Lafortune et al.,
    which `load_lafortune` reads.
    """
    return models.BlinnPhong(diffuse=jnp.array([0.45, 0.3, 0.17]), specular=0.12, exponent=40.0)


def _texels(resolution: int, coordinates: Callable) -> tuple[Array, Array]:
    """Directions and areas of the texels of a map."""
    if resolution < 2:
        raise ValueError(f"resolution must be at least 2, got {resolution}")
    if coordinates not in _TEXELS:
        raise ValueError(f"coordinates must be hemisphere.disk_coordinates or polar_coordinates, got {coordinates}")
    direction, area = _TEXELS[coordinates]
    return direction(resolution=resolution).reshape(-1, 3), area(resolution=resolution).ravel()


def mirror_lobes(
    brdf: Callable, *, angles: tuple[int | float, ...] = (0, 7, 14, 21), resolution: int = 32
) -> lobe.LobeBrdf:
    """Separates lobes around the mirror direction, of fixed widths, from a BRDF times cosine.

    A lobe of k degrees is a Gaussian of which three standard deviations cover k degrees, and 0 degrees the perfect
    mirror, for which a lobe of an eighth of a degree stands. EM finds their weights for each view and color, against a
    uniform density above the horizon that stands for what remains; that is not in the table. The samples are those of
    `lobe.tabulate`, dense around the mirror direction, and above the horizon alone: EM compares the parts of the lobes
    that are there. The weights in the table are those of whole lobes, as for all tables.

    Args:
        brdf: A BRDF (wi, wo) -> value [*b c] in 1/sr.
        angles: Degrees that each lobe covers.
        resolution: As of `lobe.tabulate`.

    Returns:
        A table of lobes without a diffuse part. What is left of the BRDF is `lobe.Remainder`, of either sign.

    Raises:
        ValueError: No angles, negative ones, or a BRDF that is negative or not finite.

    Reference: Sun et al. 2007, section 4.1.
    """
    if not angles or min(angles) < 0:
        raise ValueError(f"angles must be at least one, none below 0, got {angles}")
    wo, (sample, mass, _, extent) = lobe.sampled(brdf, resolution=resolution)
    width = np.radians(np.asarray(angles, np.float64)) / 3
    concentration = (1 / np.maximum(width**2, 1 / lobe_em.FINEST)).astype(wo.dtype)
    mean, scale, weight, diffuse = _mirror_lobes(wo, sample, mass, extent, concentration)
    return lobe.LobeBrdf(mean, scale, weight, diffuse, (), jax.device_put(np.asarray(np.nan, wo.dtype)))


@jax.jit
def _mirror_lobes(
    wo: Array, sample: Array, mass: Array, extent: Array, concentration: Array
) -> tuple[Array, Array, Array, Array]:
    """Directions, logarithms of the concentrations, weights, and no diffuse part, on the nodes `wo` [*q 3]."""
    nodes, mean, count = wo.shape[:-1], lobe_em.mirror(wo.reshape(-1, 3)), len(concentration)

    def one(argument):
        sample, mass, extent, mean = argument
        every = jnp.broadcast_to(mean, (count, 3))
        rest = jnp.full((len(sample), 1), -np.log(2 * np.pi), sample.dtype)
        density = mixture.log_density(sample, every, concentration)
        above = 4 * np.pi * extent @ jnp.exp(density)  # Part of each lobe; half at least, as means are not below.
        density = jnp.concatenate([density - jnp.log(above), rest], 1)
        start = jnp.ones(count + 1, sample.dtype)
        found = jax.vmap(lambda m: mixture.weigh(density, m, start, steps=200)[0], in_axes=1)(mass)
        return found[:, :-1] / above

    weight = jnp.moveaxis(jax.lax.map(one, (sample, mass, extent, mean)), 0, -1)
    table = jnp.broadcast_to(mean.T[:, None], (3, count, len(mean))).reshape(3, -1, *nodes)
    scale = jnp.broadcast_to(jnp.log(concentration)[:, None], (count, len(mean))).reshape(-1, *nodes)
    weight = weight.reshape(*weight.shape[:2], *nodes)
    return table, scale, weight, 0 * weight[:, 0]


def factor_tensor(
    brdfs: Sequence[Callable], *, ranks: tuple[int, int, int] = (4, 8, 8), resolution: int = 48
) -> dynamic.DynamicBrdf:
    """Decomposes a set of BRDFs, sampled at the texels of the orthographic disk.

    Optimal in the Frobenius norm of the disk, which the largest values, those of sharp lobes and at grazing angles,
    dominate: prefer `jaxprt.brdf.dynamic.factor` unless the published form itself is wanted. Lobes are
    narrower than its texels and cannot be taken out of these samples; with lobes, too, take the other. The error is
    relative, in the same norm.

    Arguments, result and errors as of `jaxprt.brdf.dynamic.factor`.

    Reference: Sun et al. 2007, section 3.2, equation 2.
    """
    dynamic.check(brdfs, None, resolution=resolution)
    direction, area = _texels(resolution, hemisphere.disk_coordinates)
    # Texels outside the disk, which bilinear lookup needs at the rim, count next to nothing.
    flux = jnp.sqrt(jnp.maximum(area, 1e-6 * jnp.max(area)))
    tensor = jnp.asarray(np.stack([np.asarray(tabulate(brdf, direction) * flux) for brdf in brdfs]))
    reflected.check_values([jnp.min(tensor, (1, 2, 3))])
    whole = jnp.sum(jnp.sum(tensor**2, (0, 1, 3)) * area)
    rest = (None, reflected.stacked(brdfs))
    return dynamic.decompose(
        tensor, jnp.diag(1 / flux), jnp.sqrt(area), whole, ranks, rest, hemisphere.disk_coordinates
    )
