"""Reflected radiance of surfaces that are lit by lamps.

Flat and convex lamps are polygons, over which lobes are integrated to .001 (`jaxprt.systems.lamps.outline`). What hides
of them is the mean over their pieces, as far as each lobe sees these as other lobes.

The visible part of another lamp is approximated by a disk on the sphere with the same mean direction d and the same
mean resultant length R; its squared chord from center to rim is r^2 = 4 (1 - R). In the chord, a von Mises-Fisher lobe
with mean m and concentration k is a normal distribution of variance 1 / k. So

    ∫ p(wi; m, k) V dwi ~ Omega / (pi r^2) P(X <= k r^2)

where Omega is the visible solid angle and X is noncentral chi-squared with two degrees of freedom and noncentrality k
|m - d|^2.

For disks larger than the lobe, P is computed by Sankaran's approximation. For smaller disks, the disk is treated as a
lobe too, and the variances r^2 / 4 and 1 / k add.

Where narrow lobes are traced by rays, for reflections of other surfaces, the rays also hit the lamps and show their
true shapes. The share of a lobe that is narrow relative to the lamp is then left to the rays, and the rest is computed
here.
"""

import dataclasses
from collections.abc import Sequence
from functools import partial, reduce

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.brdf.models import color
from jaxprt.compile import jit, total
from jaxprt.scene.points import VERTICES, Points, placed
from jaxprt.sphere import directions
from jaxprt.systems.lamps.outline import above_horizon, disk, lobe_integral, solid_angle
from jaxprt.systems.lamps.transport import LampTransport
from jaxprt.systems.lobe import LobeBrdf
from jaxprt.systems.lobe.table import LobeMixture, traced_share
from jaxprt.systems.protocol import Blend, check_blend

_SMALL, _LARGE = 0.5, 2.0  # squared chords, in variances of the lobe, between which the two approximations blend
_RATHER = np.log(9.0)  # the share of rays rises while the lamp's radius goes from 1 to 3 standard deviations
_TINY = 1e-30
_LEAST = 1e-14  # solid angle of a lamp, below which it is seen edge-on or from behind
_FAR = 1e-6  # density of lobes far from a lamp
_ALIKE = 0.01  # Visible shares of pieces that differ by less count as one, from twice as much on as they are.


class LitByLamps(eqx.Module):
    """Vertices lit by lamps: their transport, and a BRDF as lobes or an albedo.

    Attributes:
        transport: Transport from `jaxprt.lamps.precompute`.
        brdf: Table of lobes from `jaxprt.lobe.tabulate`; None for an ideal diffuse surface.
        albedo: Albedo of an ideal diffuse surface, gray or per color. A blend replaces it.
    """

    transport: LampTransport
    brdf: LobeBrdf | None = None
    albedo: Float[Array, " c"] = eqx.field(converter=color, default=1.0)

    def __check_init__(self):
        """Refuses other transport and BRDFs, and an albedo that is negative or has neither one nor three colors."""
        require.kind("the transport", self.transport, LampTransport, source="jaxprt.lamps.precompute")
        if self.brdf is not None:
            require.kind("the BRDF", self.brdf, LobeBrdf, source="jaxprt.lobe.tabulate")
        require.array("the albedo", self.albedo, "1", "3")
        require.at_least("the albedo", self.albedo, 0.0)

    def view(
        self,
        eye: Float[Array, "*p 3"],
        blend: Blend | None = None,
        points: Points = VERTICES,
        traced: Float[Array, " p"] | None = None,
    ) -> Float[Array, "n p c"]:
        """Radiance that each vertex or point sends to the eye, per lamp, for lamps of radiance 1.

        Args:
            eye: Position of the viewer in world units: one, or one for each point.
            blend: Weights of the BRDF's channels at each point; without a BRDF, the albedo of each. None for `brdf` or
                `albedo` as they are.
            points: Points at which radiance is evaluated; by default the vertices.
            traced: Share of the narrow lobes of each point that is traced by rays; None for zero.

        Returns:
            Radiance per lamp n, vertex and color, to be multiplied by the radiance of each lamp. Differentiable in the
            eye, the blend and the table.

        Raises:
            TypeError: The blend is not a `Blend`.
            ValueError: The blend has another number of vertices or channels, or the eye is not finite.
        """
        count = points.count(len(self.transport.position))
        eye = require.position("the eye", eye, points=count)
        check_blend(blend)
        if blend is not None:
            blend.check(count, 1 if self.brdf is None else len(self.brdf.weight))
        return _view(self, eye, blend, points, traced)

    def at(self, transport: LampTransport) -> "LitByLamps":
        """The same surface at points that have a transport of their own: its vertices are these points.

        Args:
            transport: Transport from `jaxprt.systems.lamps.places.at_points`.
        """
        return dataclasses.replace(self, transport=transport)

    def chord(self, points: Points = VERTICES) -> Float[Array, "n _"]:
        """Squared chord, from center to rim, of the disk that approximates each lamp at each vertex or point."""
        return _chord(self.transport, points)

    def combine(self, radiance: Float[Array, "n d"], view: Float[Array, "n v c"]) -> Float[Array, "v e"]:
        """Radiance of each vertex or point, summed over lamps.

        Args:
            radiance: Radiance of each lamp, or intensity of a point light, gray or per color.
            view: The result of `view`.

        Raises:
            ValueError: The number of rows of `radiance` differs from the number of lamps.
        """
        require.length("rows of the lamps' radiance", radiance, self.transport.lamps)
        return combine(radiance, view)


@jit
def combine(radiance: Float[Array, "n d"], view: Float[Array, "n v c"]) -> Float[Array, "v e"]:
    """`LitByLamps.combine`, of views of any surface."""
    return reduce(jnp.add, (lamp * response for lamp, response in zip(radiance, view, strict=True)))


@jit
def _view(
    lit: LitByLamps, eye: Array, blend: Blend | None, points: Points, traced: Array | None
) -> Float[Array, "n v c"]:
    transport = lit.transport
    solid, cosine, way = _integrals(transport, points)
    matte, numbers = cosine / np.pi, np.asarray(transport.lamp)
    if lit.brdf is None:
        rows = matte[:, None] * (lit.albedo[:, None] if blend is None else 1)
    else:
        position, frame = placed(transport.position, transport.frame, points)
        parameter = () if blend is None else blend.parameter
        lobe = lit.brdf.lookup(directions.view(frame, position, eye), *parameter)
        whole, flat = _chord(transport, points), list(transport.flat)
        others = np.flatnonzero(~np.isin(numbers, flat))
        reflect = partial(_reflect, lobe, frame, traced)
        rows = jax.lax.map(reflect, (solid[others], way[others], matte[others], whole[numbers[others]]))
        if transport.outline is not None:
            piece = np.stack([np.flatnonzero(numbers == number) for number in flat])
            reflect = partial(_reflect_flat, lobe, position, frame, traced)
            more = jax.lax.map(reflect, (transport.outline, solid[piece], matte[piece], whole[np.asarray(flat)]))
            rows, numbers = jnp.concatenate([rows, more]), np.concatenate([numbers[others], flat])
    value = jnp.zeros((transport.lamps, *rows.shape[1:]), rows.dtype).at[numbers].add(rows)  # [n, k, v]
    if blend is None:
        return jnp.moveaxis(value, 1, 2)
    return jnp.einsum("nkv,vkc->nvc", value, blend.weight, precision="highest")


def _integrals(transport: LampTransport, points: Points) -> tuple[Array, Array, Array]:
    """The transport's integrals, interpolated to points."""
    rows = transport.solid_angle, transport.cosine, transport.direction
    solid, cosine, way = (points.carry(row, axis=-1) for row in rows)
    if points.normal is not None:
        # The integral of direction gives that of the cosine with the tilted normal.
        tilt = points.normal - points.tilted(None).frame(transport.frame)[:, 2].T
        cosine = jnp.maximum(cosine + jnp.sum(way * tilt, -2), 0)
    return solid, cosine, way


@jit
def _chord(transport: LampTransport, points: Points) -> Float[Array, "n v"]:
    solid, _, way = _integrals(transport, points)
    numbers = np.asarray(transport.lamp)
    whole, moment = (
        jax.ops.segment_sum(row, numbers, transport.lamps, indices_are_sorted=True) for row in (solid, way)
    )
    return 4 * jnp.clip(1 - jnp.sqrt(jnp.sum(moment**2, 1)) / jnp.maximum(whole, _TINY), 0, 1)


@jit
def ray_share(concentration: Float[Array, "*b"], chord: Float[Array, "*c"]) -> Float[Array, "..."]:
    """Share of a lobe that rays may trace to a lamp: 1 for lobes much narrower than the lamp, 0 for wider ones.

    Args:
        concentration: Concentration of each lobe.
        chord: Squared chord from the center of the lamp to its rim. Its axes align with the last axes of
            `concentration`.
    """
    place = jnp.clip(jnp.log(jnp.maximum(concentration * chord, _TINY)) / _RATHER, 0, 1)
    return place**2 * (3 - 2 * place)


def _reflect(lobe: LobeMixture, frame: Array, traced: Array | None, piece: tuple[Array, ...]) -> Float[Array, "k v"]:
    """Radiance reflected by each channel of the BRDF, from one piece of a lamp of radiance 1."""
    solid, way, matte, whole = piece
    local = jnp.stack([sum(way[j] * frame[:, i, j] for j in range(3)) for i in range(3)])
    return _sent(lobe, traced, whole, mean_density(lobe.mean, lobe.concentration, *_disk(solid, local)) * solid, matte)


def _sent(lobe: LobeMixture, traced: Array | None, whole: Array, share: Array, matte: Array) -> Float[Array, "k v"]:
    """Radiance reflected by each channel, from the share of each lobe that a lamp fills, without what rays trace."""
    if traced is not None:
        share = share * (1 - traced * traced_share(lobe.concentration) * ray_share(lobe.concentration, whole))
    return jnp.sum(lobe.weight * share, 1) + lobe.diffuse * matte


def _disk(solid: Array, way: Array) -> tuple[list[Array], Array]:
    """Center and squared chord of the disk with the same integrals of 1 and of the direction."""
    length = jnp.sqrt(jnp.maximum(jnp.sum(way**2, 0), _TINY))
    return [axis / length for axis in way], 4 * jnp.clip(1 - length / jnp.maximum(solid, _TINY), 0, 1)


def _reflect_flat(
    lobe: LobeMixture, position: Array, frame: Array, traced: Array | None, lamp: tuple[Array, ...]
) -> Float[Array, "k v"]:
    """Radiance reflected by each channel of the BRDF, from a flat lamp of radiance 1."""
    outline, solid, matte, whole = lamp
    way = outline[..., None] - position.T
    local = jnp.stack([sum(way[:, :, j] * frame[:, i, j] for j in range(3)) for i in range(3)], 2)  # [q k 3 v]
    local = local / jnp.sqrt(jnp.maximum(jnp.sum(local**2, 2, keepdims=True), _TINY))
    filled = jax.lax.cond(  # Clipping doubles the number of edges.
        jnp.any(local[:, :, 2] < 0),
        lambda: _filled(lobe, jax.vmap(above_horizon)(local), solid),
        lambda: _filled(lobe, local, solid),
    )
    return _sent(lobe, traced, whole, filled, jnp.sum(matte, 0))


def _filled(lobe: LobeMixture, corner: Float[Array, "q k 3 v"], solid: Float[Array, "p v"]) -> Float[Array, "l v"]:
    """Share of each lobe that the visible part of a flat lamp fills, by the corners of the lamp and of its pieces."""
    full = jnp.maximum(jax.vmap(solid_angle)(corner[1:]), 0)
    size = jnp.sum(full, 0)
    faces = size > _LEAST
    size = jnp.where(faces, size, 1)
    # What vertices see, interpolated, may be more than there is.
    share = jnp.clip(jnp.where(full > 0, solid / jnp.where(full > 0, full, 1), 0), 0, 1)
    visible = jnp.clip(jnp.sum(solid, 0) / size, 0, 1)

    def seen(row: tuple[Array, ...]) -> Array:
        corner, full, share = row
        part = (_as_lobes(lobe.mean, lobe.concentration, *disk(corner))[0] + _FAR) * full / size
        return jnp.stack([part, part * share])

    def partly() -> Array:
        part, lit = total(seen, (corner[1:], full, share))
        return jnp.where(faces, lit / jnp.where(faces, part, 1), 0)

    apart = jnp.clip(jnp.max(jnp.abs(share - visible), 0) / _ALIKE - 1, 0, 1)
    same = jnp.broadcast_to(visible, lobe.concentration.shape)
    shown = jax.lax.cond(jnp.any(apart > 0), lambda: same + apart * (partly() - same), lambda: same)
    # The integral over a polygon that is small beside the lobe is a difference of large terms.
    toward, chord = disk(corner[0])
    small = _as_lobes(lobe.mean, lobe.concentration, toward, chord)[0] * size
    exact = lobe_integral(lobe.mean, lobe.concentration, corner[0])
    filled = small + _smooth(lobe.concentration * chord) * (exact - small)
    return jnp.where(faces, filled * shown, 0)


def _smooth(size: Array) -> Array:
    """Share of the approximation for large lamps, by their squared chord in variances of the lobe."""
    share = jnp.clip((size - _SMALL) / (_LARGE - _SMALL), 0, 1)
    return share**2 * (3 - 2 * share)


def mean_density(mean: Array, concentration: Array, toward: Sequence[Array], chord: Array) -> Float[Array, "l v"]:
    """Mean density of lobes over disks on the sphere, in 1/sr.

    Args:
        mean: Unit directions of the lobes, [3 l v].
        concentration: Concentrations of the lobes, [l v].
        toward: Unit directions of the centers of the disks: three components of shape [v].
        chord: Squared chord from the center of each disk to its rim, [v]; 0 for a point.

    Returns:
        Mean densities. Times pi times the squared chord, they are the integrals of the lobes over the disks.
    """
    small, apart = _as_lobes(mean, concentration, toward, chord)
    size = concentration * chord
    share = _smooth(size)
    inside = _inside(jnp.maximum(size, _SMALL), concentration * apart)
    large = inside / (np.pi * jnp.maximum(chord, _SMALL / concentration))
    return small + share * (large / _within(concentration) - small)


def _as_lobes(mean: Array, concentration: Array, toward: Sequence[Array], chord: Array) -> tuple[Array, Array]:
    """Mean density of lobes over disks that are treated as lobes too, and squared distances from their centers."""
    apart = reduce(jnp.add, ((mean[i] - toward[i]) ** 2 for i in range(3)))
    variance = 1 / concentration + chord / 4
    return jnp.exp(-apart / (2 * variance)) / (2 * np.pi * variance * _within(concentration)), apart


def _within(concentration: Array) -> Array:
    """Share of a normal distribution in the chord up to its largest value, 2, by which densities are divided."""
    return -jnp.expm1(-2 * concentration)


def _inside(size: Array, offset: Array) -> Array:
    """Probability that a noncentral chi-squared variable with two degrees of freedom is at most `size`."""
    # Sankaran, "Approximations to the non-central chi-square distribution", Biometrika 1963.
    first, second, third = 2 + offset, 2 + 2 * offset, 2 + 3 * offset
    h = 1 - 2 * first * third / (3 * second**2)
    p = second / first**2
    m = (h - 1) * (1 - 3 * h)
    center = 1 + h * p * (h - 1 - (2 - h) * m * p / 2)
    return jax.scipy.special.ndtr(((size / first) ** h - center) / (h * jnp.sqrt(2 * p) * (1 + m * p / 2)))
