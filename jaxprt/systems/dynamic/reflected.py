"""The light that a set of BRDFs reflects under natural light, as a tensor. Sets and light paths decompose it."""

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxprt.brdf import grid
from jaxprt.compile import jit
from jaxprt.sphere import harmonics, hemisphere
from jaxprt.systems import lobe as lobe_system
from jaxprt.systems.lobe import LobeBrdf
from jaxprt.systems.lobe.table import is_isotropic

DEGREE = 24  # degree of the harmonics of natural light for which factors are chosen
_RINGS, _SECTORS = 48, 64  # quadrature around the mirror direction
_NULL = 1e-4  # smaller eigenvalues, relative to the largest: harmonics are linearly dependent on a hemisphere

_stack = jit(lambda brdfs: jax.tree.map(lambda *leaf: jnp.stack(leaf), *brdfs))


class Reflected(NamedTuple):
    """Light that BRDFs reflect to the views of a parabolic map's texels, under light with a natural power spectrum.

    Attributes:
        tensor: Reflected radiance for each BRDF, color, view and spherical harmonic of the light.
        to_map: For each harmonic, the light map that reflects this harmonic and no other.
        direction: Unit direction of each view.
        area: Solid angle of each view; zero outside the map's disk.
        whole: Squared norm of the reflected light before lobes are subtracted.
    """

    tensor: Float[Array, "m c d b"]
    to_map: Float[Array, "b e"]
    direction: Float[Array, "d 3"]
    area: Float[Array, " d"]
    whole: Float[Array, ""]


def reflect(brdfs: Sequence[Callable], lobe: LobeBrdf | None, *, resolution: int) -> Reflected:
    """The light that BRDFs reflect, minus that of their lobes.

    Args:
        brdfs: BRDFs (wi, wo) -> value [*b c] in 1/sr on local directions, all with the same number of colors.
        lobe: Lobes of the BRDFs, one table along the index of the BRDF; None to subtract nothing.
        resolution: Edge of the map of views in texels.
    """
    direction = jnp.asarray(np.asarray(hemisphere.parabolic_texel_direction(resolution=resolution)).reshape(-1, 3))
    area = jnp.asarray(np.asarray(hemisphere.parabolic_texel_area(resolution=resolution)).ravel())
    together = stacked(brdfs)
    # BRDFs of one model are evaluated together, others one by one.
    parts = [(together, np.arange(len(brdfs)))]
    if together is None:
        parts = [(_stack((grid.as_argument(brdf),)), np.array([n])) for n, brdf in enumerate(brdfs)]
    # Isotropic BRDFs need only one view at each height.
    turned = all(map(is_isotropic, brdfs))
    view, back = _heights(direction) if turned else (direction, np.arange(len(direction)))
    rows = [_reflected(part, lobe, number, view) for part, number in parts]
    check_values([least for _, _, least in rows])
    tensor, square = (np.concatenate([np.asarray(row[part]) for row in rows]) for part in (0, 1))
    tensor = _turn(tensor, back, direction) if turned else jnp.asarray(tensor)
    whole = jnp.asarray(np.sum(square[:, :, back] * area))
    return Reflected(tensor, _to_map(direction, _dual()), direction, area, whole)


def check_values(least: Sequence[Float[Array, " _"]]) -> None:
    """Refuses BRDFs by their minimum values, which are negative or NaN for a BRDF that is negative or not finite."""
    value = np.concatenate([np.asarray(values) for values in least])
    wrong = np.flatnonzero(~(value >= 0))
    if wrong.size:
        raise ValueError(
            f"a BRDF must be finite and not negative above the horizon, got {wrong.size} of {len(value)} BRDFs that "
            f"are not, the first is number {wrong[0]}"
        )


def stacked(brdfs: Sequence[Callable]) -> Callable | None:
    """One model whose parameters have a leading axis along the set; None if the BRDFs are not of one model."""
    leaves = [jax.tree.leaves(brdf) for brdf in brdfs]
    if not leaves[0] or not all(eqx.is_inexact_array(leaf) for arrays in leaves for leaf in arrays):
        return None
    kinds = {
        (jax.tree.structure(brdf), tuple(map(jnp.shape, arrays))) for brdf, arrays in zip(brdfs, leaves, strict=True)
    }
    if len(kinds) > 1:
        return None
    return _stack(tuple(brdfs))


@jit
def _reflected(
    brdf: Callable, lobe: LobeBrdf | None, number: Array, view: Float[Array, "d 3"]
) -> tuple[Float[Array, "m c d b"], Float[Array, "m c d"], Float[Array, " m"]]:
    """Residual reflected from each harmonic to each view, squared norm of the whole, and minimum value of each BRDF."""

    def row(wo):
        wi, area = hemisphere.arcs(lobe_system.em.mirror(wo), rings=_RINGS, sectors=_SECTORS)
        cosine = jnp.maximum(wi[:, 2:], 0)
        light = area * harmonics.convolve(harmonics.evaluate(wi, degree=DEGREE).T, harmonics.natural(degree=DEGREE))

        def values(number, brdf):
            value = brdf(wi, jnp.broadcast_to(wo, wi.shape))
            least = jnp.min(jnp.where(jnp.isfinite(value), value, -1))
            value = value * cosine
            return value, value if lobe is None else value - _one(lobe, number).lookup(wo[None]).evaluate(wi).T, least

        whole, rest, least = jax.vmap(values)(number, brdf)
        whole, rest = (jnp.einsum("mdc,bd->mcb", value, light) for value in (whole, rest))
        return rest, jnp.sum(whole**2, -1), least

    rest, square, least = jax.lax.map(row, view)
    return jnp.moveaxis(rest, 0, 2), jnp.moveaxis(square, 0, 2), jnp.min(least, 0)


@jit
def _to_map(direction: Array, dual: Array) -> Array:
    """For each harmonic, a smooth function of the light's direction that reflects this harmonic and no other."""
    smooth = dual.astype(direction.dtype) @ harmonics.evaluate(direction, degree=DEGREE).T
    return harmonics.convolve(smooth, 1 / harmonics.natural(degree=DEGREE))


@lru_cache(maxsize=1)
def _dual() -> np.ndarray:
    """Inverse of the Gram matrix of the harmonics on the hemisphere, with the cosine as weight."""
    wi, area = hemisphere.arcs(jnp.array([0.0, 0, 1]), rings=_RINGS, sectors=_SECTORS)
    light = np.asarray(harmonics.evaluate(wi, degree=DEGREE), np.float64)
    value, vector = np.linalg.eigh(light.T @ (light * np.asarray(wi[:, 2:] * area[:, None], np.float64)))
    known = value > _NULL * value[-1]
    return (vector[:, known] / value[known]) @ vector[:, known].T


def _heights(direction: Array) -> tuple[Array, np.ndarray]:
    """One view in the xz plane for each height among some directions, and the index of each direction's height."""
    height, first, back = np.unique(np.round(np.asarray(direction)[:, 2], 5), return_index=True, return_inverse=True)
    height = np.asarray(direction)[first, 2]
    return jnp.asarray(np.stack([np.sqrt(1 - height**2), 0 * height, height], -1)), back


@jit
def _turn(tensor: Float[ArrayLike, "m c h b"], back: ArrayLike, direction: Float[Array, "d 3"]) -> Array:
    """Rotates the harmonics reflected to views in the xz plane about the normal, to the azimuth of each view."""
    azimuth = jnp.arctan2(direction[:, 1], direction[:, 0])
    order = np.concatenate([np.arange(-band, band + 1) for band in range(DEGREE + 1)])
    opposite = np.arange(len(order)) - 2 * order
    angle = azimuth[:, None] * order
    tensor = jnp.asarray(tensor)[:, :, back]
    return tensor * jnp.cos(angle) - tensor[..., opposite] * jnp.sin(angle)


def _one(table: LobeBrdf, number) -> LobeBrdf:
    """Lobes of one BRDF of the set."""
    mean, weight = table.mean[:, :, number], table.weight[:, :, number]
    return LobeBrdf(mean, table.scale[:, number], weight, table.diffuse[:, number], (), table.error)
