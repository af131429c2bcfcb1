"""Light from the brightest texels and cells of an environment: stored visibility times the BRDF itself.

A lobe that is half hidden reads the mean of the light times the mean of what is visible, which is wrong where the light
varies within the lobe. Cells are squares of texels whose mean radiance is taken out of the light, from fine to coarse:

    L = rest + sum_j excess_j box_j        radiance = lobes(rest) + sum_j excess_j v_j f(wi_j, wo) ∫_cell j wi · n dwi

where box_j is 1 in cell j and 0 elsewhere, v_j is the visible share of the cell, and wi_j its middle. A BRDF with lobes
narrower than cells varies within these. Of such a BRDF, given as lobes, only the wide ones W read the rest:

    radiance = wide(rest) + narrow(rest + sum_j excess_j box_j) + sum_j excess_j v_j ∫_cell j W(wi, wo) dwi
"""

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, PyTree, UInt8

from jaxprt import require
from jaxprt.brdf import grid
from jaxprt.compile import TOGETHER, jit, mapped, total
from jaxprt.scene.environment import Environment
from jaxprt.scene.points import VERTICES, Points, placed
from jaxprt.sphere import cubemap, directions
from jaxprt.systems import adaptive, light_cells, protocol
from jaxprt.systems.protocol import Blend, System, VertexSystem
from jaxprt.visibility.picture_rays import FULL

_ROW = 32  # texels per row, of which only the brightest is sorted at first
_SAMPLES = (1, 2, 3, 4, 6, 8, 12, 16)
_TOGETHER = 32  # texels whose visibility is read at once
_value = jit(adaptive.value)


@runtime_checkable
class Visibility(Protocol):
    """Interface of transport that stores the visibility of single texels."""

    @property
    def position(self) -> Float[Array, "v 3"]:
        """Vertex positions in world units."""
        ...

    @property
    def frame(self) -> Float[Array, "v 3 3"]:
        """Shading frame of each vertex; rows are tangent, bitangent, normal."""
        ...

    @property
    def size(self) -> int:
        """Edge of the cubemap faces in texels."""
        ...

    def visible(self, texel: Int[Array, " t"]) -> Float[Array, "t v"]:
        """Visible share of each of the given texels, from 0 to 1, for every vertex."""
        ...


@runtime_checkable
class CellVisibility(Visibility, Protocol):
    """Interface of transport that has the visibility of cells too."""

    def cells(self, cell: Int[Array, " t"], *, edge: int) -> Float[Array, "t v"]:
        """Visible share of each of the given cells of faces with an edge of so many cells, for every vertex."""
        ...


class BrightLight(eqx.Module):
    """A light whose brightest texels are kept separately.

    Attributes:
        rest: The rest of the light, in the form of the underlying system.
        texel: Indices of the brightest texels, and then of cells from level to level.
        excess: Radiance taken out of each of these texels and cells.
        seen: Visible share of each of them for every vertex, in 240ths; None before `BrightTexels.shade`.
        flux: Vector irradiance / pi of every vertex by all of these texels, and then its irradiance / pi, for ideally
            diffuse surfaces; None before `BrightTexels.shade`, and for others.
        here: Visible shares at the points of one view, in 240ths, in place of `seen`; None to interpolate that.
    """

    rest: PyTree
    texel: Int[Array, " t"]
    excess: Float[Array, "t c"]
    seen: UInt8[Array, "t v"] | None = None
    flux: Float[Array, "c 4 v"] | None = None
    here: UInt8[Array, "t p"] | None = None


class BrightView(eqx.Module):
    """A view for `BrightTexels`.

    Attributes:
        rest: The view in the form of the underlying system.
        frame: Shading frames of the vertices or points; rows are tangent, bitangent, normal.
        wo: Unit directions to the viewer in these frames.
        blend: Materials of the vertices or points; None for those of the BRDF.
    """

    rest: PyTree
    frame: Float[Array, "v 3 3"]
    wo: Float[Array, "v 3"]
    blend: Blend | None


class BrightTexels(VertexSystem):
    """A system that sums the brightest texels of the light exactly, and relights the rest by another system.

    Attributes:
        system: System that relights the rest of the light.
        visibility: Visibility of single texels for the same vertices, such as `StoredVisibility` or `LobeTransport`.
        brdf: BRDF (wi, wo) -> value [*b c] in 1/sr on local directions. With a `Blend`, its channels must be those of
            the system.
        count: Number of texels that are summed exactly.
        samples: Number of sample points along the edge of each texel, from `samples_for`; None for its center, whatever
            the material.
        cells: Whether cells of the light are summed too. The visibility must have their shares, as that of
            `jaxprt.lobe.precompute` does.
        by_lobes: Whether wide lobes and diffuse parts of the system, one of lobes, are integrated over cells, and
            narrow ones read the light with them, for BRDFs that have lobes narrower than cells; otherwise the BRDF is
            evaluated there.
    """

    system: System
    visibility: Any
    brdf: Callable
    count: int = eqx.field(static=True, default=16)
    samples: int | None = eqx.field(static=True, default=1)
    cells: bool = eqx.field(static=True, default=False)
    by_lobes: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        """Refuses arguments that are not a system or visibility, and visibility of other vertices."""
        source = "jaxprt.lobe.precompute" if self.cells else "precompute of jaxprt.visibility or jaxprt.lobe"
        require.kind("the system", self.system, System, source="jaxprt.lobe.LobeSystem or another system")
        require.kind("the visibility", self.visibility, CellVisibility if self.cells else Visibility, source=source)
        if self.by_lobes and not (self.cells and self.system.lobe_part is self.system):
            system = type(self.system).__name__
            raise ValueError(f"by_lobes must be with cells and a LobeSystem, got cells={self.cells} and a {system}")
        require.length("vertices of the visibility", self.visibility.position, self.system.vertices)

    def light(self, environment: Environment) -> BrightLight:
        """Splits the light into its brightest texels and the rest, which the underlying system converts."""
        environment = protocol.light_for(self, environment)
        if not self.cells:
            texel, excess, rest = split(environment, count=self.count)
            return BrightLight(self.system.light(rest), texel, excess)
        texel, excess, rest, even = _with_cells(environment, count=self.count)
        if self.by_lobes:
            lobes: Any = self.system
            return BrightLight(lobes.two_lights(rest, even), texel, excess)
        return BrightLight(self.system.light(even), texel, excess)

    @property
    def _diffuse_alone(self) -> bool:
        """Whether texels are summed at vertices as one vector, since only their irradiance counts."""
        return self.matte and getattr(self.brdf, "matte", False)

    @property
    def _numbers(self) -> tuple[tuple[int, int], ...]:
        """Edge of a face in texels or cells, and number of them, in the order of `BrightLight`."""
        return tuple((edge, number) for edge, number, _ in self.squares)

    @property
    def squares(self) -> tuple["Squares", ...]:
        """The texels and the cells of each level, in the order of `BrightLight`."""
        size, samples = self.visibility.size, self.samples or 1
        texels = Squares(size, self.count, samples)
        if not self.cells:
            return (texels,)
        # Wide lobes need the middle of a cell alone. Materials that become smoother need more places in wide cells.
        samples = 1 if self.by_lobes else samples
        wide = samples if samples == 1 else 2 * samples
        counts = light_cells.counts(size).items()
        return texels, *(
            Squares(edge, count, wide if edge == light_cells.WIDEST else samples) for edge, count in counts
        )

    @property
    def parts(self) -> tuple[slice, slice]:
        """The texels and the cells among both."""
        return slice(self.count), slice(self.count, None)

    def shade(self, light: BrightLight, materials: PyTree = None) -> BrightLight:
        """Light of the rest that arrives at the vertices, and what they see of the bright texels."""
        return self._seen(dataclasses.replace(light, rest=self.system.shade(light.rest, materials)))

    def _seen(self, light: BrightLight) -> BrightLight:
        """The light with what vertices see of the bright texels."""
        if light.seen is not None:
            return light
        seen, flux = _shares(self.visibility, light.texel, light.excess, self._numbers), None
        if self._diffuse_alone:
            flux = _vector_flux(self.visibility.frame, light.texel, light.excess, seen, numbers=self._numbers)
        return dataclasses.replace(light, seen=seen, flux=flux)

    def tilted(self, light: BrightLight, normal: Float[Array, "v 3"]) -> BrightLight:
        """The light, whose rest is that of the underlying system: `System.tilted`."""
        return dataclasses.replace(light, rest=self.system.tilted(light.rest, normal))

    def view(
        self, eye: Float[Array, "*p 3"], materials: PyTree = None, points: Points = VERTICES, **options: Any
    ) -> BrightView:
        """The view of the underlying system, and the frames and directions for which the bright texels are summed.

        `options` are those of the underlying system.
        """
        options |= {"two_lights": True} if self.by_lobes else {}
        rest = self.system.view(eye, materials, points, **options)
        position, frame = placed(self.visibility.position, self.visibility.frame, points)
        eye = require.position("the eye", eye, points=len(position))
        return BrightView(rest, frame, directions.view(frame, position, eye), materials)

    def combine(self, light: BrightLight, view: BrightView, points: Points = VERTICES) -> Float[Array, "p c"]:
        """Radiance: the sum of that of the underlying system and that of the bright texels."""
        require.kind("the light", light, BrightLight, source="BrightTexels.light")
        require.kind("the view", view, BrightView, source="BrightTexels.view")
        light, rest = self._seen(light), self.system.combine(light.rest, view.rest, points)
        if light.flux is not None:
            sent = self._diffuse(light.flux, view, points) if light.here is None else self._traced(light, view)
            return rest + sent.T * self.system.diffuse_albedo(view.rest)
        shares: Any = light.seen if light.here is None else light.here
        points = points if light.here is None else VERTICES
        texels, squares = (light.texel, light.excess / FULL, shares), self.squares
        if self.by_lobes:
            lobes: Any = self.system
            texels, cells = (tuple(rows[part] for rows in texels) for part in self.parts)
            rest = rest + lobes.over_cells(view.rest, view.frame, cells, points, squares=squares[1:])
            squares = squares[:1]
        brdf = grid.as_argument(self.brdf)
        return rest + texel_radiance(brdf, view.frame, view.wo, texels, points, view.blend, squares=squares)

    def _diffuse(self, flux: Float[Array, "c 4 v"], view: BrightView, points: Points) -> Float[Array, "c _"]:
        """Irradiance / pi by the bright texels: max(F . n + max(E - F . m, 0), 0)."""
        if points.all_vertices and points.normal is None:
            return flux[:, 3]
        # F and E are the vector and irradiance of vertices, interpolated; m is the smooth normal, n that with the map.
        flux, normal = points.carry(flux, axis=2), view.frame[:, 2].T
        smooth = normal
        if points.normal is not None:
            smooth = points.tilted(None).frame(self.visibility.frame)[:, 2].T
        upright, tilted = (jnp.sum(flux[:, :3] * axis, 1) for axis in (smooth, normal))
        # Between vertices a sun's vector stays as it is, that of light from everywhere turns with the normal. F is too
        # short for the second kind, and E too dark for the first.
        return jnp.maximum(tilted + jnp.maximum(flux[:, 3] - upright, 0), 0)

    def _traced(self, light: BrightLight, view: BrightView) -> Float[Array, "c p"]:
        """Irradiance / pi by the bright texels, of which points know what they see."""
        share: Any = jnp.asarray(light.here, view.frame.dtype)
        area = _areas(light.texel, self._numbers).astype(share.dtype)
        cosine = jnp.maximum(_component(view.frame[:, 2].T, area[:, None]), 0)
        return jnp.einsum("tc,tp->cp", light.excess / (np.pi * FULL), share * cosine, precision="highest")

    def diffuse_albedo(self, view: BrightView) -> Float[Array, "v c"]:
        """The albedo of the underlying system."""
        return self.system.diffuse_albedo(view.rest)

    @property
    def matte(self) -> bool:
        """Whether the underlying system is ideally diffuse."""
        return self.system.matte

    @property
    def vertices(self) -> int:
        """Number of vertices."""
        return self.system.vertices

    @property
    def lobe_part(self) -> Any:
        """The lobes of the underlying system, which can be widened."""
        return self.system.lobe_part

    @property
    def degree(self) -> int | None:
        """The degree of the underlying system."""
        return self.system.degree

    @property
    def light_size(self) -> int:
        """Edge of the faces of the light, whose texels have visibility bit by bit."""
        return self.visibility.size

    @property
    def texel_visibility(self) -> Any:
        """The visibility of single texels."""
        return self.visibility

    def exported(self, what: str) -> protocol.Exported:
        """That of the underlying system."""
        return self.system.exported(what)

    @property
    def growing(self) -> PyTree:
        """The transport of the underlying system, and the visibility."""
        return self.system.growing, self.visibility

    @property
    def shared_light(self) -> tuple | None:
        """Key of the light: that of the underlying system, with the number of texels and the kind of cells."""
        rest = self.system.shared_light
        return rest and (BrightTexels, self.count, self.cells, self.by_lobes, self._diffuse_alone, rest)


class Squares(NamedTuple):
    """Squares of faces of one size.

    Attributes:
        edge: Number along the edge of a face.
        number: How many there are.
        samples: Number of sample points along the edge of each.
    """

    edge: int
    number: int
    samples: int


@require.arguments(light=protocol.one_light, count=partial(require.count, "the number of texels", least=-1))
@partial(jit, static_argnames=("count",))
def split(light: Environment, *, count: int) -> tuple[Int[Array, " t"], Float[Array, "t c"], Environment]:
    """Takes the excess radiance of the brightest texels out of a light.

    Args:
        light: One environment.
        count: Number of texels.

    Returns:
        Indices of the brightest texels; the radiance taken out of each, in the color of the texel; and the rest of the
        environment. In the rest, each of these texels keeps the flux (radiance times solid angle) of the brightest
        texel that is not one of them.

    Raises:
        TypeError: The light is not an `Environment`.
        ValueError: The light is a batch, or `count` is negative or not below the number of texels.
    """
    size, colors = light.radiance.shape[-2:]
    if not 0 <= count < 6 * size * size:
        raise ValueError(f"the number of texels must be from 0 to {6 * size * size - 1}, got {count}")
    radiance = light.radiance.reshape(-1, colors)
    flux = jnp.sum(radiance, -1) * cubemap.solid_angle(size=size).ravel()
    texel = _largest(jax.lax.stop_gradient(flux), count + 1)
    bright = flux[texel]
    fraction = jnp.maximum(1 - bright[-1] / jnp.where(bright[:-1] > 0, bright[:-1], 1), 0)
    texel, excess = texel[:-1], radiance[texel[:-1]] * fraction[:, None].astype(radiance.dtype)
    rest = radiance.at[texel].add(-excess).reshape(light.radiance.shape)
    return texel, excess, Environment(rest)


@partial(jit, static_argnames=("count", "rank"))
def brightest(
    light: Environment, *, count: int, rank: int, least: Float[ArrayLike, ""]
) -> tuple[Int[Array, " t"], Float[Array, "t c"], Environment]:
    """Takes the radiance of the brightest texels out of a light, as far as they are brighter than many others.

    Unlike with `split`, some brighter texels stay in the rest, which another system may split again.

    Args:
        light: One environment.
        count: Number of texels.
        rank: What exceeds the flux of so many brighter texels is taken out.
        least: Smallest share of the light's flux that is taken out of a texel; others keep their radiance.

    Returns:
        Indices of the texels with the most flux, radiance times solid angle, the most first; the radiance taken out of
        each, in its color; and the rest of the environment.
    """
    flux = _flux_of(light)
    texel = _largest(flux, min(count, len(flux)))
    return texel, *without(light, texel, rank=rank, least=least)


@partial(jit, static_argnames=("rank",))
def without(
    light: Environment, texel: Int[Array, " t"], *, rank: int, least: Float[ArrayLike, ""]
) -> tuple[Float[Array, "t c"], Environment]:
    """The radiance taken out of given texels, and the rest of the environment: see `brightest`."""
    flux = _flux_of(light)
    level = flux[_largest(flux, min(rank + 1, len(flux)))[-1]]
    bright = flux[texel]
    fraction = jnp.maximum(1 - level / jnp.where(bright > 0, bright, 1), 0)
    fraction = jnp.where(bright * fraction >= least * jnp.sum(flux), fraction, 0)
    radiance = light.radiance.reshape(-1, light.radiance.shape[-1])
    excess = radiance[texel] * fraction[:, None].astype(radiance.dtype)
    return excess, Environment(radiance.at[texel].add(-excess).reshape(light.radiance.shape))


def _flux_of(light: Environment) -> Float[Array, " d"]:
    size, colors = light.radiance.shape[-2:]
    flux = jnp.sum(light.radiance.reshape(-1, colors), -1) * cubemap.solid_angle(size=size).ravel()
    return jax.lax.stop_gradient(flux)


def radiance(
    transport: Visibility,
    brdf: Callable,
    texel: Int[Array, " t"],
    excess: Float[Array, "t c"],
    *,
    eye: Float[Array, "3"],
    samples: int = 1,
    blend: Blend | None = None,
) -> Float[Array, "v e"]:
    """Radiance that vertices send to the eye, under light from the given texels.

    Args:
        transport: Visibility of single texels for the vertices, such as `StoredVisibility` or `LobeTransport`.
        brdf: BRDF (wi, wo) -> value [*b c] in 1/sr on local directions that is a callable pytree, as the models are.
        texel: Indices of the texels.
        excess: Radiance of each texel, from `split`.
        eye: Position of the viewer in world units.
        samples: Number of points along the edge of a texel at which the BRDF is sampled: 1 is the texel's center, more
            are a Gauss rule. A BRDF that varies over a texel, such as a mirror, needs more than one; `samples_for`
            tells how many. The time grows with the square.
        blend: Weights of the BRDF's channels at each vertex; None for the BRDF as it is. If the blend has parameters,
            `brdf` must be a function of these parameters that returns a BRDF.

    Returns:
        Linear radiance per vertex, in units of the light's radiance. Where the eye is below a vertex's horizon, it is
        that of a grazing view. Differentiable in the BRDF's parameters, the excess and the eye.

    Raises:
        TypeError: The BRDF is a table whose values include the cosine of the light direction.
        ValueError: `samples` is below 1, or the eye is not one finite position, or the excess is not finite. Values
            cannot be checked inside `jax.jit`, where NaN reaches the vertices.

    Reference: Wang, Tran, Luebke 2004, equation 1, for single texels.
    """
    brdf = grid.as_argument(brdf)
    require.count("samples", samples, least=-1, most=64)
    if samples < 1:
        raise ValueError(f"samples must be at least 1, got {samples}")
    excess = _floating_excess(transport, texel, excess)
    eye = require.position("the eye", eye)
    wo = directions.view(transport.frame, transport.position, eye)
    light = texel, excess, transport.visible(texel)
    squares = (Squares(transport.size, len(texel), samples),)
    return texel_radiance(brdf, transport.frame, wo, light, VERTICES, blend, squares=squares)


def _floating_excess(transport: Visibility, texel: Array, excess: Array) -> Array:
    """Checks that texels and excess fit each other and the transport; returns the excess in floating point."""
    require.length("rows of the excess", excess, len(texel))
    require.finite("the excess", excess)
    require.within("the texels", texel, 0, 6 * transport.size**2 - 1)
    return require.floating(excess)


@partial(jit, static_argnames=("squares",))
def texel_radiance(
    brdf: Callable,
    frame: Float[Array, "p 3 3"],
    wo: Float[Array, "p 3"],
    light: tuple[Int[Array, " t"], Float[Array, "t c"], UInt8[Array, "t v"] | Float[Array, "t v"]],
    points: Points,
    blend: Blend | None,
    *,
    squares: tuple[Squares, ...],
    above: Float[Array, "p 3"] | None = None,
    spot: Float[Array, "t 4"] | None = None,
) -> Float[Array, "p e"]:
    """Radiance that vertices or points send: the sum over texels of light x BRDF x cosine x visibility.

    Args:
        brdf: BRDF (wi, wo) -> value [*b c] in 1/sr on local directions.
        frame: Shading frames; rows are tangent, bitangent, normal.
        wo: Unit directions to the viewer in these frames.
        light: Indices of the texels or cells, their radiance, and their visible share at the vertices. Only the product
            of the last two matters, so shares may be in 240ths if the radiance is divided by 240.
        points: Points to which the shares are interpolated; all vertices for shares of the points themselves.
        blend: Weights of the BRDF's channels, and parameters; None for the BRDF as it is.
        squares: Size and number of the texels or cells, in their order, and of their sample points.
        above: Normals below whose horizon no light arrives, in addition to those of the frames; None without.
        spot: Where in each texel its light comes from, from `jaxprt.scene.light_samples.spots_in_texels`; None for
            everywhere.
    """
    texel, excess, visible = light
    protocol.check_colors(excess.shape[1], 1 if blend is None else blend.weight.shape[2])
    # Vertices are the last axis, over which XLA vectorizes CPU code.
    frame, wo = jnp.moveaxis(frame, 0, 2), wo.T
    parameter = () if blend is None else blend.parameter
    weight = None if blend is None else jnp.moveaxis(blend.weight, 0, 2)

    def one(wi, wo, *parameter):
        # Channels apart: XLA on CPUs would compute an array of all with a branch for each of its values.
        return list(brdf(*parameter)(wi, wo) if parameter else brdf(wi, wo))

    value = jax.vmap(one, in_axes=(1, 1, *(0 for _ in parameter)))

    def lit(argument):
        direction, area, number = argument
        share = visible[number] if carried else points.carry(visible[number])
        channel, cosine = point(direction, area)
        reflected = jnp.stack(channel) if weight is None else sum(map(jnp.multiply, channel, weight))
        return reflected * (cosine * share.astype(wo.dtype)) * excess[number][:, None]

    def counts(rows):
        # No vertex of many rows sees some texels, such as those that do not stand out.
        return jnp.any(visible[rows[2]] > 0)

    def point(direction, area):
        wi = jnp.stack([_component(axis, direction) for axis in frame])
        cosine = jnp.maximum(_component(frame[2], area), 0)
        if above is not None:
            cosine = jnp.where(_component(above.T, direction) > 0, cosine, 0)
        return value(wi, wo, *parameter), cosine

    if not len(texel):  # Rows are read by number: one that brings nothing.
        texel, spot, squares = jnp.zeros(1, jnp.int32), None, (Squares(1, 1, 1),)
        excess, visible = (jnp.zeros((1, rows.shape[1]), rows.dtype) for rows in (excess, visible))
    carried = any(square.samples > 1 for square in squares) and not points.all_vertices
    if carried:
        visible = mapped(points.carry, visible)
    # Sample points are processed one by one, so that intermediate arrays stay in the processor's cache. A loop over the
    # points of a texel within one over texels takes three times as long on CPUs.
    direction, area, number = _sample_points(texel, squares, spot)
    # The last point is repeated without an area. A direction of zero would have derivatives that are not finite.
    real = np.arange(-(-len(number) // TOGETHER) * TOGETHER)
    index = np.minimum(real, len(number) - 1)
    area = jnp.where((real < len(number))[:, None], area[index], 0)
    rows = direction[index].astype(excess.dtype), area.astype(excess.dtype), number[index]
    return total(lit, rows, counts=counts).T


@partial(jit, static_argnames=("numbers",))
def _shares(
    visibility: Any, texel: Int[Array, " t"], excess: Float[Array, "t c"], numbers: tuple[tuple[int, int], ...]
) -> UInt8[Array, "t v"]:
    """Visible share of each of the given texels and cells for every vertex, in 240ths; 0 for those not used."""
    rows, first = [], 0
    for edge, count in numbers:
        at, whole = slice(first, first + count), edge == visibility.size

        def seen(cell: Array, edge: int = edge, whole: bool = whole) -> Array:
            share = visibility.visible(cell) if whole else visibility.cells(cell, edge=edge)
            return jnp.round(share * FULL).astype(jnp.uint8)

        none = jnp.zeros((count, len(visibility.position)), jnp.uint8)
        used = jnp.any(excess[at] != 0)
        rows.append(seen(texel[at]) if whole else jax.lax.cond(used, seen, lambda _, none=none: none, texel[at]))
        first += count
    return jnp.concatenate(rows)


@require.arguments(size=partial(require.count, "size", least=1))
def samples_for(brdf: Callable, *, size: int = 64, error: float = 0.02) -> int:
    """Number of sample points along the edge of a texel that `radiance` needs for a BRDF.

    For sixteen views, down to 15 degrees above the surface, the integrals of BRDF x cosine over texels around the
    mirror direction are compared with those by 32 x 32 points. Runs on the host: call it once per BRDF and keep the
    number. Inside `jax.jit`, where parameters are not known, use the number for the sharpest BRDF.

    Args:
        brdf: BRDF (wi, wo) -> value [b c] in 1/sr on local directions: a model or any function.
        size: Edge of the cubemap faces in texels.
        error: Largest relative L2 error over the texels of a view.

    Returns:
        The smallest number tried that meets the error, or 16, the largest.

    Raises:
        ValueError: The error is not positive.
    """
    require.number("error", error, 0.0, above=True)
    grid.check(brdf)
    rule = [np.polynomial.legendre.leggauss(count) for count in (*_SAMPLES, 32)]
    place = np.concatenate([np.stack(np.meshgrid(x, x), -1).reshape(-1, 2) for x, _ in rule])
    weight = np.concatenate([np.outer(w, w).ravel() for _, w in rule])
    first = np.cumsum([0, *(len(x) ** 2 for x, _ in rule[:-1])])
    offset = np.random.default_rng(0).uniform(-2, 2, (12, 1, 2))  # centers of texels, in texels
    s, t = np.moveaxis((2 * offset + place) / size, -1, 0)[..., None]
    brdf = grid.as_argument(brdf)
    need = 0
    for angle, turn in itertools.product(np.radians([0, 30, 60, 75]), np.pi / 4 * np.arange(4)):
        wo = np.array([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)])
        axes = np.asarray(directions.frame(jnp.asarray(wo * [-1, -1, 1]), jnp.zeros(3)), np.float64)
        wi = s * axes[0] + t * axes[1] + axes[2]
        wi = (wi / np.linalg.norm(wi, axis=-1, keepdims=True)).reshape(-1, 3)
        value = _value(brdf, *(jnp.asarray(row, jnp.result_type(float)) for row in (wi, wo)))
        sent = np.asarray(value, np.float64).mean(-1) * np.maximum(wi[:, 2], 0)
        mean = np.add.reduceat(sent.reshape(len(offset), -1) * weight, first, axis=1)
        off = np.linalg.norm(mean - mean[:, -1:], axis=0)
        good = np.flatnonzero(off <= error * np.linalg.norm(mean[:, -1]))
        need = max(need, min(int(good[0]), len(_SAMPLES) - 1))
    return _SAMPLES[need]


def irradiance(transport: Visibility, texel: Int[Array, " t"], excess: Float[Array, "t c"]) -> Float[Array, "v c"]:
    """Irradiance / pi under light from the given texels: the radiance of diffuse vertices of albedo 1.

    `radiance` describes the arguments.

    Raises:
        ValueError: A texel index is out of range, or the excess is not finite or does not have one row for each texel.
            Values cannot be checked inside `jax.jit`, where NaN reaches the vertices.
    """
    return _irradiance(transport, texel, _floating_excess(transport, texel, excess))


@jit
def _irradiance(transport: Visibility, texel: Array, excess: Array) -> Array:
    flux = _flux(transport.frame[:, 2].T, texel, transport.visible(texel), size=transport.size)
    return (excess.T @ flux).T / np.pi


def _sample_points(
    texel: Int[Array, " t"], squares: Sequence[Squares], spot: Float[Array, "t 4"] | None
) -> tuple[Array, Array, Array]:
    """Directions of all sample points, the integral of direction that each stands for, and the number of its texel."""
    parts, first = [], 0
    for edge, count, samples in squares:
        at, number = slice(first, first + count), np.repeat(np.arange(first, first + count), samples**2)
        parts.append((*_points(texel[at], edge, samples, None if spot is None else spot[at]), number))
        first += count
    direction, area, number = zip(*parts, strict=True)
    way, solid = (jnp.concatenate([part.reshape(-1, 3) for part in rows]) for rows in (direction, area))
    return way, solid, jnp.asarray(np.concatenate(number))


def _points(texel: Int[Array, " t"], size: int, samples: int, spot: Float[Array, "t 4"] | None) -> tuple[Array, Array]:
    """Directions of the k sample points in texels t, and the integral of direction that each stands for, [t k 3]."""
    if samples == 1 and spot is None:
        direction, area = (texels(size=size).reshape(-1, 3) for texels in (cubemap.direction, cubemap.vector_area))
        return direction[texel, None], area[texel, None]
    place, weight = np.polynomial.legendre.leggauss(samples)
    face, row = jnp.divmod(texel[:, None, None], size**2)
    row, column = jnp.divmod(row, size)
    axis = jnp.asarray(cubemap.axes())[face]

    def points(across: Any, down: Any) -> tuple[Array, Array]:
        s, t = (2 * column + 1 + across) / size - 1, (2 * row + 1 + down) / size - 1
        point = s[..., None] * axis[..., 0, :] + t[..., None] * axis[..., 1, :] + axis[..., 2, :]
        length = jnp.linalg.norm(point, axis=-1, keepdims=True)
        return point / length, (weight * weight[:, None] / size**2)[..., None] / length**3

    direction, area = points(place, place[:, None])
    if spot is not None:  # Points move to where the light is, with the flux that they stand for.
        middle, width = jnp.moveaxis(spot.reshape(-1, 2, 2, 1, 1), 0, 2)
        direction, _ = points(middle[0] + width[0] * place, middle[1] + width[1] * place[:, None])
    return direction.reshape(len(texel), -1, 3), (area * direction).reshape(len(texel), -1, 3)


def _areas(texel: Int[Array, " t"], numbers: tuple[tuple[int, int], ...]) -> Float[Array, "t 3"]:
    """Integrals of direction over texels and cells."""
    ends = np.cumsum([number for _, number in numbers])[:-1]
    tables = (cubemap.vector_area(size=edge).reshape(-1, 3) for edge, _ in numbers)
    return jnp.concatenate([table[rows] for table, rows in zip(tables, jnp.split(texel, ends), strict=True)])


@partial(jit, static_argnames=("count",))
def _with_cells(
    light: Environment, *, count: int
) -> tuple[Int[Array, " t"], Float[Array, "t c"], Environment, Environment]:
    """Texels and cells of a light, their excess, and the light without the texels and without both."""
    texel, excess, rest = split(light, count=count)
    cell, taken, even = light_cells.split(rest)
    return jnp.concatenate([texel, cell]), jnp.concatenate([excess, taken]), rest, even


@partial(jit, static_argnames=("numbers",))
def _vector_flux(
    frame: Float[Array, "v 3 3"],
    texel: Int[Array, " t"],
    excess: Float[Array, "t c"],
    seen: UInt8[Array, "t v"],
    *,
    numbers: tuple[tuple[int, int], ...],
) -> Float[Array, "c 4 v"]:
    """Vector irradiance / pi of every vertex by texels and cells that its normal faces, and its irradiance / pi."""
    count, area, normal = len(texel), _areas(texel, numbers), frame[:, 2].T
    blocks = max(-(-count // _TOGETHER), 1)

    def rows(value: Array) -> Array:
        return jnp.pad(value, ((0, blocks * _TOGETHER - count), (0, 0))).reshape(blocks, _TOGETHER, -1)

    def flux(block: tuple[Array, Array, Array]) -> Array:
        area, excess, seen = block
        share = jnp.where(_component(normal, area[:, None]) > 0, seen, 0).astype(excess.dtype)
        light = (excess[:, :, None] * area[:, None]).reshape(_TOGETHER, -1) / (np.pi * FULL)
        return jnp.matmul(light.T, share, precision="highest")

    whole = total(flux, (rows(area.astype(excess.dtype)), rows(excess), rows(seen)))
    result = whole.reshape(excess.shape[1], 3, -1)
    return jnp.concatenate([result, jnp.sum(result * normal, 1, keepdims=True)], 1)


def _flux(normal: Float[Array, "3 v"], texel: Array, visible: Float[Array, "t v"], *, size: int) -> Array:
    """Visible solid angle of texels times the cosine."""
    area = cubemap.vector_area(size=size).reshape(-1, 3)[texel]
    return jnp.maximum(_component(normal, area[:, None]), 0) * visible


def _largest(value: Float[Array, " n"], count: int) -> Int[Array, " t"]:
    """Indices of the largest values, largest first. Only the rows with the largest maxima are sorted, which is fast."""
    rows = len(value) // _ROW
    if rows <= count or len(value) % _ROW:
        return jax.lax.top_k(value, count)[1]
    table = value.reshape(rows, _ROW)
    row = jnp.sort(jax.lax.top_k(jnp.max(table, 1), count)[1])  # in order, so that the first of equal values is taken
    place = jax.lax.top_k(table[row].ravel(), count)[1]
    return row[place // _ROW] * _ROW + place % _ROW


def _component(axis: Float[Array, "3 v"], direction: Float[Array, "*t 3"]) -> Array:
    """Components of directions along one axis of each vertex's frame."""
    return axis[0] * direction[..., 0] + axis[1] * direction[..., 1] + axis[2] * direction[..., 2]
