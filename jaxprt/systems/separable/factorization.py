"""Factored BRDFs: sums of products of a light map and a view map, f(wi, wo) = sum_r g_r(wi) h_r(wo); their errors."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.brdf import grid
from jaxprt.compile import isolated, jit
from jaxprt.decompose import eigen
from jaxprt.files import objects
from jaxprt.scene.environment import Environment
from jaxprt.sphere import cubemap, directions, harmonics, hemisphere

_DEGREE = 36  # of the light prior; maps of 48 x 48 texels resolve nothing finer
_MOST_TERMS = 256
_BLOCK = 2048  # directions looked up at once, and again for gradients, which saves memory
_NEAR = 1e-3  # tolerance relative to the norm; larger than rounding differences between processors
_MORE = 4  # terms computed beyond those requested, because their singular values may equal the last one's
_NULL = 4  # singular values below this many rounding errors of the largest count as zero

# Points on square maps, inside the disk and off its symmetry axes, at which light factors are compared.
_RADIUS, _TURN = 0.45 * np.sqrt((np.arange(16) + 0.5) / 16), 2.4 * np.arange(16) + 0.3
_MARKS = 0.5 + _RADIUS * np.stack([np.cos(_TURN), np.sin(_TURN)])


class SeparableBrdf(eqx.Module):
    """A factored BRDF, with factors stored in maps of the hemisphere.

    Attributes:
        light_map: Factors g_r of the incident direction. The last axis is 1 (shared by all colors) or one per color.
        view_map: Factors h_r of the view direction, per color. The product light_map * view_map is in 1/sr.
        error: Relative error of the terms kept. From `factor` without lights, it is the mean error of reflected
            radiance under natural light, without shadows; with lights, the largest of their `light_errors`. From other
            factorizations, it is the error in the norm that they minimize. Under a small bright light such as a sun,
            radiance can have a many times larger error.
        coordinates: Function from local directions to map coordinates, one of `sphere.hemisphere`. Lookup in polar maps
            is periodic in azimuth.
    """

    light_map: Float[Array, "r n n l"]
    view_map: Float[Array, "r n n c"]
    error: Float[Array, ""]
    coordinates: Callable = eqx.field(static=True, default=hemisphere.disk_coordinates)

    @property
    def terms(self) -> int:
        """Number of terms r."""
        return self.light_map.shape[0]

    def __reduce__(self):
        """Pickles the `coordinates` function by its name, because pickle cannot store jitted functions."""
        return objects.reduced(self)

    def truncate(self, terms: int) -> "SeparableBrdf":
        """The BRDF with its first `terms` terms. If terms are dropped, its error is unknown and set to NaN."""
        if not 1 <= terms <= self.terms:
            raise ValueError(f"terms must be between 1 and {self.terms}, got {terms}")
        error = self.error if terms == self.terms else jnp.full_like(self.error, jnp.nan)
        return SeparableBrdf(self.light_map[:terms], self.view_map[:terms], error, self.coordinates)

    def light(self, wi: Float[Array, "*b 3"]) -> Float[Array, "*b r l"]:
        """Light factors g_r(wi). They are not zero below the horizon, where the cosine that multiplies them is."""
        return self._read(self.light_map, wi)

    def view(self, wo: Float[Array, "*b 3"]) -> Float[Array, "*b r c"]:
        """View factors h_r(wo), which are zero below the horizon."""
        value = self._read(self.view_map, wo)
        return jnp.where(wo[..., 2:, None] > 0, value, 0)

    def __call__(self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> Float[Array, "*b c"]:
        """Value of the factored BRDF in 1/sr, by bilinear lookup. It is zero below the horizon."""
        return jnp.where(wi[..., 2:] > 0, jnp.sum(self.light(wi) * self.view(wo), -2), 0)

    def _read(self, texel: Array, direction: Array) -> Array:
        polar = self.coordinates is hemisphere.polar_coordinates
        return _look_up(jnp.moveaxis(texel, 0, 2), self.coordinates(direction), polar=polar)


@partial(isolated, static=("polar",))
def _look_up(texel: Array, coordinates: Array, *, polar: bool) -> Array:
    lookup = hemisphere.polar_lookup if polar else hemisphere.lookup
    if texel.shape[-1] == 1:  # With a trailing axis of 1, gradients with respect to coordinates take ten times as long.
        return _look_up(texel[..., 0], coordinates, polar=polar)[..., None]
    *batch, axes = coordinates.shape
    if math.prod(batch) <= _BLOCK or not texel.size:  # An empty array cannot be divided into blocks.
        return lookup(texel, coordinates)
    look_up = jax.checkpoint(lambda place: lookup(texel, place))
    return jax.lax.map(look_up, coordinates.reshape(-1, axes), batch_size=_BLOCK).reshape(*batch, *texel.shape[2:])


def mark_of(light_map: Float[Array | np.ndarray, "r n n l"]) -> Float[np.ndarray, "r m"]:
    """Samples of the light factors at a few texels, by which transport recognizes the BRDF it was made for."""
    edge = light_map.shape[1]
    row, column = (_MARKS * edge).astype(int)
    value = np.asarray(light_map)[:, row, column]
    return value.reshape(len(value), value.shape[1] * value.shape[2])


def check_mark(known: Array | None, light_map: Array, *, name: str = "the BRDF") -> None:
    """Refuses light factors that differ from those of the transport by more than rounding on another processor.

    Nothing is checked if the samples are unknown, or inside a JAX transformation, where values are not known.

    Args:
        known: Samples of the transport's light factors, from `mark_of`, or None.
        light_map: Light maps of the BRDF, for all terms of the transport or the first ones.
        name: Name of the BRDF in the error message.
    """
    if known is None or isinstance(known, Tracer) or isinstance(light_map, Tracer) or len(light_map) > len(known):
        return
    expected, actual = np.asarray(known)[: len(light_map)], mark_of(light_map)
    same_colors = expected.shape == actual.shape
    distance, norm = float(np.linalg.norm(actual - expected)) if same_colors else math.inf, np.linalg.norm(expected)
    if not distance <= _NEAR * norm:
        raise ValueError(
            f"{name} must be the one that the transport was made for, got another: its light factors differ from the "
            f"transport's by {distance / (norm or 1):.2g} of their norm"
        )


def factor(
    brdf: Callable,
    *,
    terms: int | None = None,
    error: float | None = None,
    light: Sequence[Environment] | None = None,
    resolution: int = 48,
) -> SeparableBrdf:
    """Factors a BRDF, with all colors together, by a singular value decomposition weighted for natural light.

    View maps are the leading left singular vectors U of M diag(cos dw) C^(1/2). M[wo c, wi] is the BRDF, and C(wi, wi')
    = sum_l (l + 1/2)^-2 (2l + 1) / (4 pi) P_l(wi . wi') is the covariance of natural light. Light maps are the
    projections U^T M. They are gray for any BRDF, so the transport is gray too.

    The result depends little on the assumed spectrum of light. Diffuse and specular parts are better factored together:
    separate factorizations need more terms in all.

    Maps are parabolic, because the orthographic disk is too coarse at grazing angles, where glossy BRDFs are brightest:
    at 48 x 48 its last texel before the rim spans 14 degrees.

    Runs on the host. Derivatives with respect to BRDF parameters are not supported: singular vectors have none where
    singular values coincide, as they do for isotropic BRDFs, and existing transport would keep the old light maps. For
    such derivatives use `jaxprt.reference.radiance`.

    Args:
        brdf: BRDF (wi, wo) -> value [*b c] in 1/sr on local directions.
        terms: Number of terms. Give either `terms` or `error`.
        error: Relative L2 error that the terms must meet. With `light`, it holds under each of these lights, by
            `jaxprt.separable.light_errors`. Otherwise it is the mean over natural light with the covariance above, and
            single lights may exceed it. Both are without shadows; `jaxprt.relit.measuring.measure` includes them.
        light: Environments under which `error` must hold.
        resolution: Edge of the square maps in texels.

    Returns:
        The factored BRDF, with its terms in order of decreasing contribution.

    Raises:
        ValueError: Neither or both of `terms` and `error` are given, `light` is given without `error`, there are more
            terms than texels, 256 terms do not meet the error, or the BRDF returns values that are not finite or have
            no color axis.

    Reference: Wang, Tran, Luebke 2004, section 3.2, with the prior in place of their Frobenius norm.
    """
    if (terms is None) == (error is None):
        raise ValueError(f"give either terms or error, got terms={terms} and error={error}")
    grid.check(brdf)
    if error is not None:
        require.number("error", error, 0.0, above=True)
    if light is not None:
        if isinstance(light, Environment) or not isinstance(light, Sequence):
            raise TypeError(f"light must be a list of Environment, got {require.shown(light)}")
        for environment in light:
            require.kind("each light", environment, Environment, source="jaxprt.load_environment")
        return _factor_for(brdf, light, terms, error, resolution)
    _check_resolution(resolution)
    direction = np.asarray(hemisphere.parabolic_texel_direction(resolution=resolution)).reshape(-1, 3)
    solid_angle = np.asarray(hemisphere.parabolic_texel_area(resolution=resolution)).ravel()
    inside = np.flatnonzero(solid_angle)
    _check_terms(1 if terms is None else terms, inside.size)
    table = tabulate(brdf, jnp.asarray(direction))
    flux, matrix, covariance = _matrices(table, direction, solid_angle, inside)
    value, vector, remainder, terms = _leading(matrix, covariance, terms, error or 0.0)
    light_map, view_map = _maps(table, solid_angle, flux, matrix, covariance, value, vector)
    # Fix the signs and the order of coinciding terms, so that transport from another machine fits the factors made
    # here.
    turn = eigen.orientation(np.asarray(value), np.asarray(vector))[:, :terms].T.astype(value.dtype)
    light_map, view_map = _turn_maps(turn, light_map, view_map, resolution=resolution)
    return SeparableBrdf(light_map, view_map, jnp.asarray(remainder[terms - 1]), hemisphere.parabolic_coordinates)


@jit
def _matrices(table: Array, direction: Array, solid_angle: Array, inside: Array) -> tuple[Array, Array, Array]:
    """M diag(cos dw), the same with rows (view and color) weighted by the view's solid angle, and the covariance C."""
    flux = table[:, :, inside] * (direction[:, 2] * solid_angle)[inside]
    matrix = (flux * jnp.sqrt(solid_angle)[:, None]).reshape(-1, inside.size)
    return flux, matrix, light_covariance(direction[inside], degree=_DEGREE)


@partial(jit, static_argnames="resolution")
def _turn_maps(turn: Array, *value: Array, resolution: int) -> tuple[Array, ...]:
    """Maps [r n n c] of the terms after the orthogonal transformation `turn` of the singular vectors."""
    return tuple(jnp.tensordot(turn, maps, 1).reshape(len(turn), resolution, resolution, -1) for maps in value)


@jit
def _maps(
    table: Array, solid_angle: Array, flux: Array, matrix: Array, covariance: Array, value: Array, vector: Array
) -> tuple[Array, Array]:
    """Light and view maps [r d c] from singular vectors."""
    color = table.shape[0]
    project = vector.reshape(color, -1, value.size) * jnp.sqrt(solid_angle)[:, None]
    light_map = jnp.einsum("cor,coi->ri", project, table)
    # M C M^T u = value u extends the view map to texels of zero weight, which bilinear lookup reads at the rim.
    response = covariance @ (matrix.T @ vector)
    # Singular values that are zero up to rounding are not divided by.
    known = value > _NULL * jnp.finfo(value.dtype).eps * jnp.max(value)
    inverse = jnp.where(known, 1 / jnp.where(known, value, 1), 0)
    view_map = jnp.einsum("coi,ir->roc", flux, response * inverse)
    return light_map[..., None], view_map


def _factor_for(brdf: Callable, light: Sequence[Environment], terms: int | None, error: float | None, resolution: int):
    """`factor` with the smallest number of terms that meets the error under each light."""
    if error is None or not len(light):
        raise ValueError(
            f"lights must be at least one, and error must be given with them, got {len(light)} lights and terms={terms}"
        )
    count, most = 4, min(_MOST_TERMS, int(jnp.sum(hemisphere.parabolic_texel_area(resolution=resolution) > 0)))
    while True:
        factored = factor(brdf, terms=count, resolution=resolution)
        reached = np.max([light_errors(brdf, factored, environment) for environment in light], 0)
        good = np.flatnonzero(reached <= error)
        if good.size:
            shortest = factored.truncate(int(good[0]) + 1)
            number = jnp.asarray(reached[good[0]], factored.error.dtype)
            return SeparableBrdf(shortest.light_map, shortest.view_map, number, shortest.coordinates)
        if count == most:
            raise ValueError(f"error must be at least {reached[-1]:.3g}, which {count} terms reach; got {error}")
        count = min(4 * count, most)


@runtime_checkable
class FactoredBrdf(Protocol):
    """A BRDF given by a light factor and a view factor for each term, such as `jaxprt.separable.SeparableBrdf`."""

    def light(self, wi: Float[Array, "*b 3"]) -> Float[Array, "*b r l"]:
        """Light factors of all terms r, gray or per color l."""
        ...

    def view(self, wo: Float[Array, "*b 3"]) -> Float[Array, "*b r c"]:
        """View factors of all terms r, per color c."""
        ...


def light_errors(
    brdf: Callable, factored: FactoredBrdf, light: Environment, *, frames: int = 32, views: int = 32
) -> Float[Array, " r"]:
    """Relative L2 error of radiance reflected under a light, without shadows, for each number of terms.

    Normals are spread evenly over the sphere, and views over the hemisphere. The BRDF and its terms are both sampled at
    the centers of the light's texels, so the error is that of the factorization only.

    Args:
        brdf: BRDF (wi, wo) -> value [*b c] in 1/sr on local directions.
        factored: The factored BRDF.
        light: One environment.
        frames: Number of normals.
        views: Number of views for each normal.

    Returns:
        Error of the first term, of the first two terms, and so on. Zero if all radiance is zero.

    Raises:
        ValueError: The light is a batch.
    """
    if light.radiance.ndim != 4:
        raise ValueError(f"the light must be one environment [6, n, n, c], got {list(light.radiance.shape)}")
    return _light_errors(jax.tree_util.Partial(brdf), factored, light, _spiral(frames, -1), _spiral(views, 0))


@jit
def _light_errors(brdf: Callable, factored: FactoredBrdf, light: Environment, normal: Array, view: Array) -> Array:
    size = light.radiance.shape[1]
    direction, area = (quantity(size=size).reshape(-1, 3) for quantity in (cubemap.direction, cubemap.vector_area))
    table = light.radiance.reshape(len(direction), -1)
    factor = factored.view(view)

    def one(axes):
        wi = directions.to_local(axes, direction)
        received = table * jnp.maximum(directions.to_local(axes, area)[:, 2:], 0)
        response = jnp.einsum("drl,dc->rlc", factored.light(wi), received)
        response = response[:, 0] if response.shape[1] == 1 else jnp.einsum("rcc->rc", response)
        by_terms = jnp.cumsum(factor * response, 1)

        def exact(wo):
            return jnp.sum(brdf(wi, jnp.broadcast_to(wo, wi.shape)) * received, 0)

        true = jax.lax.map(exact, view)
        return jnp.sum((by_terms - true[:, None]) ** 2, (0, 2)), jnp.sum(true**2)

    error, whole = jax.lax.map(one, directions.frame(normal, jnp.zeros_like(normal)))
    whole = jnp.sum(whole)
    return jnp.sqrt(jnp.sum(error, 0) / jnp.where(whole > 0, whole, 1))


def _spiral(count: int, lowest: int) -> Array:
    """Directions with z above `lowest`, spread evenly on a golden spiral."""
    height = 1 - (1 - lowest) * (np.arange(count) + 0.5) / count
    turn = np.pi * (1 + np.sqrt(5)) * np.arange(count)
    radius = np.sqrt(1 - height**2)
    return jnp.asarray(np.stack([radius * np.cos(turn), radius * np.sin(turn), height], -1), jnp.result_type(float))


def tabulate(brdf: Callable, direction: Float[Array, "d 3"]) -> Float[Array, "c d d"]:
    """Values of the BRDF at all pairs of directions, [c, view, light].

    Args:
        brdf: BRDF (wi, wo) -> value [*b c] in 1/sr on local directions.
        direction: Unit directions above the horizon.

    Returns:
        Values in 1/sr.

    Raises:
        ValueError: The BRDF returns values that are not finite or have no color axis.
    """
    shape = eqx.filter_eval_shape(_row, brdf, direction, direction[0]).shape
    if len(shape) != 2 or shape[0] != direction.shape[0] or not shape[1]:
        raise ValueError(f"a BRDF must map directions [b 3] to values [b c], got {shape} for {direction.shape}")
    table, broken = _rows(brdf, direction)
    if broken:
        raise ValueError(f"a BRDF must be finite above the horizon, got {broken} of {table.size} values that are not")
    return table


def _row(brdf: Callable, direction: Array, wo: Array) -> Array:
    return brdf(direction, jnp.broadcast_to(wo, direction.shape))


@eqx.filter_jit
def _rows(brdf: Callable, direction: Array) -> tuple[Array, Array]:
    """Values at all pairs of directions, [c, view, light], and the number of values that are not finite."""
    rows = jax.lax.map(lambda wo: _row(brdf, direction, wo), direction, batch_size=64)
    return jnp.moveaxis(rows, 2, 0), jnp.sum(~jnp.isfinite(rows))


def light_covariance(direction: Float[Array, "d 3"], *, degree: int) -> Float[Array, "d d"]:
    """Covariance of natural light between pairs of directions, sum_l s_l^2 (2l + 1) / (4 pi) P_l(cos).

    Args:
        direction: Unit directions.
        degree: Highest degree of the sum.

    Returns:
        A positive semidefinite matrix, in relative units.

    Reference: the addition theorem, with s_l from `jaxprt.sphere.harmonics.natural`.
    """
    cosine = jnp.clip(jnp.matmul(direction, direction.T, precision="highest"), -1, 1)

    def step(carry, band):
        (before, legendre, total), (order, size) = carry, band
        total = total + size**2 * (2 * order + 1) / (4 * jnp.pi) * legendre
        after = ((2 * order + 1) * cosine * legendre - order * before) / (order + 1)
        return (legendre, after, total), None

    start = (jnp.zeros_like(cosine), jnp.ones_like(cosine), jnp.zeros_like(cosine))
    band = jnp.arange(degree + 1, dtype=cosine.dtype), harmonics.natural(degree=degree).astype(cosine.dtype)
    (_, _, total), _ = jax.lax.scan(step, start, band)
    return total


def _leading(matrix: Array, covariance: Array, terms: int | None, error: float) -> tuple[Array, Array, np.ndarray, int]:
    """Squared singular values, singular vectors, errors by number of terms; `terms` or the least that meet `error`."""
    total = _total(matrix, covariance)
    most = min(_MOST_TERMS, matrix.shape[1])
    # With `terms`, a few more, because terms with equal singular values must be oriented together.
    count = min(4, most) if terms is None else min(terms + _MORE, *matrix.shape)
    while True:
        value, vector, _ = eigen.left_singular(matrix, metric=covariance, terms=count)
        remainder = np.asarray(_remainder(value, total))
        if terms is not None:
            return value, vector, remainder, terms
        reached = np.flatnonzero(remainder <= error)
        if reached.size:
            return value, vector, remainder, int(reached[0]) + 1
        if count == most:
            raise ValueError(f"error must be at least {remainder[-1]:.3g}, which {count} terms reach; got {error}")
        count = min(4 * count, most)


@jit
def _total(matrix: Array, covariance: Array) -> Array:
    return jnp.sum((matrix @ covariance) * matrix)


@jit
def _remainder(value: Array, total: Array) -> Array:
    """Relative errors of the first 1, 2, ... terms."""
    lost = jnp.maximum(1 - jnp.cumsum(value) / jnp.where(total > 0, total, 1), 0)
    return jnp.where(total > 0, jnp.sqrt(lost), 0)  # a black BRDF has no error


def _check_resolution(resolution: int) -> None:
    require.count("resolution", resolution, least=-1, most=1 << 12)
    if resolution < 2:
        raise ValueError(f"resolution must be at least 2, got {resolution}")


def _check_terms(terms: int, most: int) -> None:
    require.count("terms", terms, least=-1)
    if not 1 <= terms <= most:
        raise ValueError(f"terms must be between 1 and {most}, got {terms}")
