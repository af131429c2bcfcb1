"""The lobe system: the texels of the blurred light that each lobe reads, and how much of them is visible.

Light L and visibility V are correlated over a lobe. The visible part of a lobe is treated as a narrower lobe around
another direction. For a normal distribution of variance k, the mean of the visible part is shifted by k grad E[V] /
E[V] (Stein's lemma); the gradient comes from the bilinear lookup of visibility. Assuming that the occluder is a
straight edge, the shift also determines the variance that remains across the edge. E[L V] is then E[V] times the light
blurred to that width, read at the shifted mean. This is exact for light that is linear over the lobe, and never
negative.
"""

import dataclasses
from functools import partial, reduce
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from jaxprt import require
from jaxprt.compile import isolated, jit, promoted, total
from jaxprt.decompose import mixture
from jaxprt.scene.environment import Environment
from jaxprt.scene.points import VERTICES, Points, placed
from jaxprt.sphere import cubemap, directions
from jaxprt.systems import harmonic, protocol
from jaxprt.systems.lobe import diffuse
from jaxprt.systems.lobe import squares as over_squares
from jaxprt.systems.lobe.blurred_light import LobeLight, finer_scales, prefilter, scales
from jaxprt.systems.lobe.exported import DEGREE, CoarseTransport, ExportedLobes
from jaxprt.systems.lobe.pyramid import LobeTransport, Scales, between, corners, of_scale
from jaxprt.systems.lobe.table import LobeBrdf, LobeMixture, traced_visibility
from jaxprt.systems.protocol import Blend

_LEAST = 1e-3  # smallest visibility by which the shift of a lobe is divided
_FARTHEST = 2.5  # largest shift of the mean of the visible part, in standard deviations
_TINY = 1e-12
_WIDE = 0.05  # standard deviation of the narrowest wide lobes: a quarter of the edge of a cell of 6 x 8 x 8
_FLANK = 0.55  # spread of a lobe whose flanks, at 50 degrees, are as steep as those of a cosine


class LobeView(eqx.Module):
    """A view: the texels of the blurred light that each vertex reads, and their weights.

    Attributes:
        place: Indices of texels of the blurred light, or of the second one of two, eight arrays with one texel for
            each lobe l.
        visible: Weights of these texels: interpolation weight times visibility.
        weight: Weight of each lobe, gray or per color.
        diffuse: Albedo of the diffuse part, gray or per color.
        vector: Transfer vectors of the vertices, for the diffuse part; no rows if the light holds the irradiance.
        points: Points that the view belongs to.
        size: Edge of the environment's cubemap faces in texels.
        mean: Unit directions of the lobes in local frames; None if wide lobes do not read a light of their own.
        concentration: Their concentrations.
        finer: Whether very narrow lobes read texels that only `sharpened` light has.
    """

    place: tuple[Int[Array, "l v"], ...]
    visible: tuple[Float[Array, "l v"], ...]
    weight: Float[Array, "c l v"]
    diffuse: Float[Array, "c v"]
    vector: UInt8[Array, "h _"] | Float[Array, "h _"]
    points: Points
    size: int = eqx.field(static=True)
    mean: Float[Array, "3 l v"] | None = None
    concentration: Float[Array, "l v"] | None = None
    finer: bool = eqx.field(static=True, default=False)


class LobeSystem(protocol.VertexSystem):
    """Visibility pyramids with a BRDF as a table of lobes. Light, view and BRDF may all change without precomputation.

    A `Blend` weights the channels of the BRDF table and holds the parameters of each vertex. Next to bright texels, hat
    functions can make the diffuse part slightly negative. Shadows of a small sun are lost where lobes are wider than
    the occluders; `jaxprt.bright_texels.BrightTexels` keeps them.

    Attributes:
        transport: Visibility pyramids, from `jaxprt.lobe.precompute`.
        brdf: The table, from `jaxprt.lobe.tabulate`.

    Reference: Sun et al. 2007, section 4.1, with free lobes and the second term.
    """

    transport: LobeTransport
    brdf: LobeBrdf

    def __check_init__(self):
        """Refuses transport and BRDFs of other systems."""
        require.kind("the transport", self.transport, LobeTransport, source="jaxprt.lobe.precompute")
        require.kind("the BRDF", self.brdf, LobeBrdf, source="jaxprt.lobe.tabulate")

    def light(self, environment: Environment) -> LobeLight:
        """The light, blurred by lobes of about a dozen widths."""
        return prefilter(protocol.one_light(environment, size=self.transport.size))

    def two_lights(self, narrow: Environment, wide: Environment) -> LobeLight:
        """A light of which narrow lobes read another one than wide lobes and the diffuse part.

        Args:
            narrow: The light of narrow lobes.
            wide: The light of wide lobes and the diffuse part.
        """
        first, second = self.light(narrow), self.light(wide)
        return dataclasses.replace(second, pyramid=jnp.concatenate([first.pyramid, second.pyramid], 1))

    def shade(self, light: LobeLight, materials: Blend | None = None) -> LobeLight:
        """The light with the irradiance of the vertices, for the diffuse part. Materials do not change it."""
        require.kind("the light", light, LobeLight, source="LobeSystem.light")
        irradiance = diffuse.irradiance(light.coefficient, self.transport.vector)
        return LobeLight(light.pyramid, light.coefficient, light.size, irradiance)

    def tilted(self, light: LobeLight, normal: Float[Array, "v 3"]) -> LobeLight:
        """The light with vector irradiance, for the diffuse part: `System.tilted`."""
        flux = diffuse.flux(light.coefficient, self.transport.vector, normal, size=self.transport.size)
        return dataclasses.replace(light, flux=flux)

    def view(
        self,
        eye: Float[Array, "*p 3"],
        materials: Blend | None = None,
        points: Points = VERTICES,
        *,
        variance: Float[Array, " p"] | None = None,
        two_lights: bool = False,
        missed: Float[Array, " p"] | None = None,
        finer: bool = False,
    ) -> LobeView:
        """Texels at which each point reads the blurred light, with visibility.

        `variance`, in squared radians, widens the lobes of each point. With `two_lights` the view is of such a light.
        `missed`, the share of the rays of narrow lobes that hit nothing, is the visibility of these; -1 without rays.
        With `finer`, very narrow lobes read texels that only `sharpened` light has.
        """
        protocol.check_blend(materials)
        options = {"eye": eye, "points": points, "variance": variance, "two_lights": two_lights}
        options |= {"missed": missed, "finer": finer}
        # The irradiance comes with the light: each row of points would hold a copy of the vectors.
        transport = eqx.tree_at(lambda stored: stored.vector, self.transport, self.transport.vector[:0])
        if materials is None:
            return view_lobes(transport, self.brdf, **options)
        materials.check(points.count(self.vertices), len(self.brdf.weight))
        seen = view_lobes(transport, self.brdf, *materials.parameter, **options)
        # Channel by channel with the vertices last: an einsum would be a small matrix product for each vertex.
        channel = jnp.moveaxis(materials.weight, 0, 2)
        pairs = list(zip(seen.weight, seen.diffuse, channel, strict=True))
        weight = reduce(jnp.add, (lobe * part[:, None] for lobe, _, part in pairs))
        diffuse = reduce(jnp.add, (albedo * part for _, albedo, part in pairs))
        return eqx.tree_at(lambda looked: (looked.weight, looked.diffuse), seen, (weight, diffuse))

    def combine(self, light: LobeLight, view: LobeView, points: Points = VERTICES) -> Float[Array, "p c"]:
        """Radiance: the blurred light, read at the texels of the view, which has its points, and weighted."""
        require.kind("the light", light, LobeLight, source="LobeSystem.light")
        require.kind("the view", view, LobeView, source="LobeSystem.view")
        if light.irradiance is None:
            light = self.shade(light)
        return combine(light, view)

    def over_cells(
        self,
        view: LobeView,
        frame: Float[Array, "p 3 3"],
        cells: tuple[Array, Array, Array],
        points: Points,
        *,
        squares: tuple[tuple[int, int, int], ...],
    ) -> Float[Array, "p c"]:
        """Radiance that wide lobes and the diffuse part reflect from cells that are not in their light.

        Args:
            view: A view of two lights.
            frame: Shading frames of the points; rows are tangent, bitangent, normal.
            cells: Indices of the cells, their radiance and their visible share; see `squares.radiance`.
            points: Points to which the shares are interpolated.
            squares: Edge of a face in cells, and number of them.
        """
        mean, concentration = view.mean, view.concentration
        if mean is None or concentration is None:
            raise ValueError("the view must be of two lights, got one of one light")
        wide = jnp.where(_is_wide(concentration), view.weight, 0)
        lobe = LobeMixture(mean, concentration, wide, view.diffuse)
        return over_squares.radiance(lobe, frame, cells, points, squares=squares)

    def diffuse_albedo(self, view: LobeView) -> Float[Array, "v c"]:
        """Albedo of the diffuse part: `System.diffuse_albedo`."""
        return view.diffuse.T

    def exported(self, what: str) -> ExportedLobes:
        """The table of lobes, averaged visibility, and transfer vectors for the diffuse part: `System.exported`."""
        vector = diffuse.harmonics_of(self.transport.vector, size=self.transport.size, degree=DEGREE)
        return ExportedLobes(self, np.asarray(vector, np.float64), np.zeros((0, self.vertices)))

    def coarse(self, transport: CoarseTransport) -> "CoarseLobes":
        """The same lobes with coarser visibility, for a light that is reduced to the size of the transport."""
        return CoarseLobes(transport, self.brdf)

    @property
    def lobe_part(self) -> "LobeSystem":
        """The system itself."""
        return self

    @property
    def shared_light(self) -> tuple:
        """Key of the light, which depends on the environment and its size only."""
        return LobeSystem, self.transport.size


class CoarseLobes(LobeSystem):
    """A lobe system that reduces the resolution of its light, and lights diffuse parts by harmonics."""

    def light(self, environment: Environment) -> LobeLight:
        """The light at reduced resolution, blurred for lobes."""
        radiance = cubemap.reduced(environment.radiance, size=self.transport.size)
        light = super().light(Environment(radiance))
        return dataclasses.replace(light, coefficient=harmonic.project(environment, degree=DEGREE))

    def tilted(self, light: LobeLight, normal: Float[Array, "v 3"]) -> LobeLight:
        """The light as it is: what arrives at tilted normals changes as it would without shadows, in `combine`."""
        return light

    def combine(self, light: LobeLight, view: LobeView, points: Points = VERTICES) -> Float[Array, "p c"]:
        """Radiance: `LobeSystem.combine`."""
        if view.points.normal is None:
            return super().combine(light, view)
        smooth = view.points.tilted(None).frame(self.transport.frame)[:, 2]
        before, after = (_upon(light, normal) for normal in (smooth.T, view.points.normal))
        diffuse = view.diffuse * harmonic.system.tilted_share(before, after)
        return super().combine(light, dataclasses.replace(view, diffuse=diffuse))


def _brdf(value: Any) -> None:
    require.kind("the BRDF", value, LobeBrdf, source="jaxprt.lobe.tabulate")


@require.arguments(brdf=_brdf)
def view_lobes(
    transport: LobeTransport,
    brdf: LobeBrdf,
    *parameter: Float[Array, " v"],
    eye: Float[Array, "*p 3"],
    points: Points = VERTICES,
    variance: Float[Array, " p"] | None = None,
    two_lights: bool = False,
    missed: Float[Array, " p"] | None = None,
    finer: bool = False,
) -> LobeView:
    """Finds the texels of the blurred light that each vertex or point reads for a view, and their visibility.

    Args:
        transport: Visibility pyramids, from `precompute`.
        brdf: Table of lobes, from `tabulate`.
        parameter: Values of each BRDF parameter at the points, if the table has parameters.
        eye: Position of the viewer in world units: one, or one for each point.
        points: Points at which radiance is evaluated; by default the vertices.
        variance: Variance in squared radians, along one axis, by which the lobes of each point are widened; None for
            zero.
        two_lights: Whether wide lobes read a light of their own; see `LobeSystem.two_lights`.
        missed: Share of the rays of narrow lobes that hit nothing, which is their visibility; -1 at points without
            rays. None without rays.
        finer: Whether very narrow lobes read texels that only `sharpened` light has.
    """
    count = len(transport.position)
    protocol.check_points(points, count)
    eye = require.position("the eye", eye, points=points.count(count))
    return _view_lobes(transport, brdf, parameter, eye, points, variance, missed, two_lights=two_lights, finer=finer)


@partial(jit, static_argnames=("two_lights", "finer"))
def _view_lobes(
    transport: LobeTransport,
    brdf: LobeBrdf,
    parameter: tuple[Array, ...],
    eye: Array,
    points: Points,
    variance: Array | None,
    missed: Array | None,
    *,
    two_lights: bool,
    finer: bool,
) -> LobeView:
    placing = *placed(transport.position, transport.frame, points), brdf, eye, variance
    lobe, (face, s, t, spread) = _places(*placing, *parameter)
    seen = transport.lobe_visibility(face, s, t, spread, points)
    if missed is not None:
        seen = _partly_traced(seen, missed, lobe.concentration)
    size, coarse = transport.size, scales(transport.size).total
    before = coarse * (1 + two_lights) if finer else 0
    place, visible = _taps(face, s, t, spread, lobe.concentration, seen, size=size, before=before)
    view = LobeView(place, visible, lobe.weight, lobe.diffuse, transport.vector, points, size, finer=finer)
    if not two_lights:
        return view
    after = jnp.where(_is_wide(lobe.concentration), coarse, 0)
    place = tuple(texel + after for texel in place)
    return dataclasses.replace(view, place=place, mean=lobe.mean, concentration=lobe.concentration)


def _partly_traced(
    seen: tuple[Array, Array, Array], missed: Float[Array, " v"], concentration: Float[Array, "l v"]
) -> tuple[Array, Array, Array]:
    """Visibility of lobes and its derivatives, those of narrow ones by rays, which do not move what a lobe reads."""
    share = jnp.where(missed < 0, 0, traced_visibility(concentration))
    stored, by_s, by_t = (rows * (1 - share) for rows in seen)
    return stored + missed * share, by_s, by_t


def _is_wide(concentration: Float[Array, "*b"]) -> Bool[Array, "*b"]:
    """Whether lobes are wide enough to represent the widest cells of the light as lobes too."""
    return concentration < _WIDE**-2


@isolated
def _places(
    position: Array, frame: Array, brdf: LobeBrdf, eye: Array, variance: Array | None, *parameter: Array
) -> tuple[LobeMixture, tuple[Array, ...]]:
    """Lobes of each vertex; and cubemap face, coordinates s and t on it, and spread of each lobe."""
    lobe = brdf.lookup(directions.view(frame, position, eye), *parameter)
    lobe = lobe if variance is None else lobe.widened(variance)
    world = [sum(lobe.mean[j] * frame[:, j, i] for j in range(3)) for i in range(3)]
    return lobe, (*cubemap.project(*world), mixture.drop(lobe.concentration))


@partial(isolated, static=("size", "before"))
def _taps(
    face, s, t, spread, concentration, visible, *, size: int, before: int
) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """Texels of the blurred light that each lobe reads, and their weights; with `before`, of a finer light."""
    seen, face, s, t, spread = _seen_part(visible, face, s, t, spread, concentration)
    scale = scales(size)
    if before:
        spread = jnp.where(_is_wide(concentration), jnp.maximum(spread, scale.spread[0]), spread)
        scale = finer_scales(size, before=before)
    place, weight = zip(*_blurred(face, s, t, spread, scale), strict=True)
    return place, tuple(seen * part for part in weight)


def _blurred(face: Array, s: Array, t: Array, spread: Array, scale: Scales) -> list[tuple[Array, Array]]:
    """Texels of the light that is blurred by a spread, and their weights, which sum to 1."""
    result = []
    number, upper = between(scale, spread)
    for step, part in ((0, 1 - upper), (1, upper)):
        edge, start = (of_scale(x, number + step) for x in (scale.edge, scale.start))
        row, column, weights = corners(edge, s, t)
        for (down, right), (value, _, _) in weights:
            place = start + (face * (edge + 2) + row + down) * (edge + 2) + column + right
            result.append((place, value * part))
    return result


@isolated
def _upon(light: LobeLight, normal: Float[Array, "3 p"]) -> Float[Array, "c p"]:
    """What changes with the normal about as irradiance does without shadows: the light, widely blurred."""
    face, s, t = cubemap.project(*normal)
    taps = _blurred(face, s, t, jnp.full_like(s, _FLANK), scales(light.size))
    return reduce(jnp.add, (light.pyramid[:, texel] * part for texel, part in taps))


def _seen_part(visible, face, s, t, spread, concentration) -> tuple[Array, Array, Array, Array, Array]:
    """Visibility of each lobe; and face, coordinates and spread of its visible part."""
    seen, by_s, by_t = visible
    # Derivatives on the face become a gradient on the sphere, times the variance of the lobe, 1 / (k (1 - spread)).
    variance = (1 + s**2 + t**2) / (concentration * (1 - spread))
    along_s = variance * (by_s * (1 + s**2) + by_t * s * t)
    along_t = variance * (by_t * (1 + t**2) + by_s * s * t)
    part = jnp.maximum(seen, _LEAST)
    # Shift in standard deviations of the lobe, limited where almost nothing is visible.
    shift = jnp.sqrt((along_s * by_s + along_t * by_t) / part**2 + _TINY)
    reach = 1 / (part * jnp.maximum(shift / _FARTHEST, 1))
    shift = jnp.minimum(shift, _FARTHEST)
    # Variance across an edge at a: 1 - m (m + a) with mean m = phi(a) / Phi(a), here as a fit over m.
    across = 1 / (1 + shift * (2 + 0.42 * shift))
    # In the tangent plane of the lobe's direction: on the plane of the face, long steps would depend on the face.
    by_s, by_t = along_s * reach, along_t * reach
    inward = (s * by_s + t * by_t) / (1 + s**2 + t**2)
    center, moved = cubemap.unproject(face, s, t), cubemap.unproject(face, s + by_s, t + by_t)
    face, s, t = cubemap.project(*(x - inward * y for x, y in zip(moved, center, strict=True)))
    return seen, face, s, t, spread * (1 + across) / 2


@isolated
def combine(light: LobeLight, view: LobeView) -> Float[Array, "v e"]:
    """Radiance of a view under a light.

    Args:
        light: The result of `prefilter`.
        view: The result of `view_lobes`.

    Returns:
        Linear radiance of each vertex or point, in units of the light's radiance.

    Raises:
        ValueError: The light has another size than the transport of the view, or lacks the finer texels of the view.
    """
    if light.size != view.size:
        raise ValueError(
            f"the light's faces must have as many texels along an edge as the transport's, {view.size}, "
            f"got {light.size}"
        )
    if view.finer and not light.finer:
        raise ValueError("the light must be that of sharpened for a view with finer=True, got one of prefilter")
    protocol.check_colors(len(light.pyramid), view.weight.shape[0])
    irradiance = light.irradiance
    if irradiance is None:
        irradiance = diffuse.irradiance(light.coefficient, view.vector)
    irradiance = diffuse.at_points(irradiance, light.flux, view.points)
    # Colors are contiguous, so that one read gets all. Lobes are summed one by one, so that sums stay in the cache.
    rows = light.pyramid.T

    def lit(lobe):
        place, visible, weight = lobe
        taps = zip(place, visible, strict=True)
        read = reduce(jnp.add, (rows.at[texel].get(mode="promise_in_bounds") * part[:, None] for texel, part in taps))
        return read * weight.T

    glossy = total(lit, (view.place, view.visible, jnp.swapaxes(view.weight, 0, 1)))
    return glossy + (irradiance * view.diffuse).T


class MatteTransport(eqx.Module):
    """Transfer vectors of the vertices of ideally diffuse surfaces.

    Attributes:
        vector: Transfer vectors in hat functions, as bytes; see `jaxprt.systems.lobe.diffuse`.
        position: Vertex positions in world units.
        size: Edge of the cubemap faces in texels.
    """

    vector: UInt8[Array, "h v"]
    position: Float[Array, "v 3"]
    size: int = eqx.field(static=True)

    @property
    def nbytes(self) -> int:
        """Bytes of the vectors."""
        return self.vector.nbytes


class MatteLight(eqx.Module):
    """Light for ideally diffuse surfaces.

    Attributes:
        coefficient: Coefficients of the light; see `jaxprt.systems.lobe.diffuse`.
        irradiance: Irradiance / pi of the vertices; None before `MatteSystem.shade`.
        flux: Vector irradiance / pi of the vertices, for normals tilted by normal maps; None before
            `MatteSystem.tilted`.
    """

    coefficient: Float[Array, "h c"]
    irradiance: Float[Array, "c v"] | None = None
    flux: Float[Array, "c 3 v"] | None = None


class MatteSystem(protocol.VertexSystem):
    """Transfer vectors of hat functions for ideally diffuse surfaces, whose radiance is the same for all views.

    A `Blend` has one channel, the albedo of each vertex, and replaces `albedo`.

    Attributes:
        transport: Transfer vectors, from `matte_transport`.
        albedo: Albedo of all vertices, gray or per color.
    """

    transport: MatteTransport
    albedo: Float[Array, " c"]

    def __check_init__(self):
        """Refuses other transport, and an albedo that is negative or has neither one nor three colors."""
        require.kind("the transport", self.transport, MatteTransport, source="jaxprt.lobe.matte_transport")
        require.array("the albedo", self.albedo, "1", "3")
        require.at_least("the albedo", self.albedo, 0.0)

    def light(self, environment: Environment) -> MatteLight:
        """Coefficients of the light in hat functions."""
        light = protocol.one_light(environment, size=self.transport.size)
        return MatteLight(diffuse.coefficients(light.radiance))

    def shade(self, light: MatteLight, materials: Blend | None = None) -> MatteLight:
        """The light with the irradiance of the vertices. Materials do not change it."""
        require.kind("the light", light, MatteLight, source="MatteSystem.light")
        return MatteLight(light.coefficient, diffuse.irradiance(light.coefficient, self.transport.vector))

    def tilted(self, light: MatteLight, normal: Float[Array, "v 3"]) -> MatteLight:
        """The light with vector irradiance: `System.tilted`."""
        flux = diffuse.flux(light.coefficient, self.transport.vector, normal, size=self.transport.size)
        return dataclasses.replace(light, flux=flux)

    def view(
        self, eye: Float[Array, "*p 3"], materials: Blend | None = None, points: Points = VERTICES
    ) -> Float[Array, "_ d"]:
        """Albedo of all points, or of each point with a blend. It does not depend on the eye."""
        return protocol.albedo_view(self, eye, materials, points)

    @promoted
    def combine(self, light: MatteLight, view: Float[Array, "_ d"], points: Points = VERTICES) -> Float[Array, "p e"]:
        """Radiance: irradiance / pi times the albedo."""
        require.kind("the light", light, MatteLight, source="MatteSystem.light")
        require.array("the view", view, "v c", source="MatteSystem.view")
        irradiance = light.irradiance
        if irradiance is None:
            irradiance = diffuse.irradiance(light.coefficient, self.transport.vector)
        protocol.check_colors(len(irradiance), view.shape[1])
        return diffuse.at_points(irradiance, light.flux, points).T * view

    def exported(self, what: str) -> protocol.Exported:
        """The transfer vectors in spherical harmonics: `System.exported`."""
        vector = diffuse.harmonics_of(self.transport.vector, size=self.transport.size, degree=DEGREE)
        transport = harmonic.TransferVector(vector[:, None], self.transport.position)
        return harmonic.DiffuseSystem(transport, self.albedo).exported(what)

    @property
    def matte(self) -> bool:
        """True: surfaces are ideally diffuse."""
        return True

    @property
    def shared_light(self) -> tuple:
        """Key of the light, which depends on the environment and its size only."""
        return MatteSystem, self.transport.size


def matte_transport(transport: LobeTransport) -> MatteTransport:
    """The transfer vectors of a lobe transport, without its pyramids."""
    return MatteTransport(transport.vector, transport.position, transport.size)
