"""Tables of metallic-roughness materials under a clear coat or a sheen, made of the tables of both.

A table has two parameters: the logarithms of the roughness of the base and of the layer. Its channels are the four
terms of the base, these terms under a full layer, and the layer. Lobes of the base and of the layer stand one after
another, so no lobe is fitted, and between knots the lobes of one do not change with the roughness of the other.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.brdf import GGX, Charlie, CoatedModel, MetallicRoughness, UnderSheen, coat_reflectance, sheen_albedo
from jaxprt.brdf.varying import Channels
from jaxprt.systems.bounces import traced
from jaxprt.systems.bounces.functions import FunctionWeights
from jaxprt.systems.dynamic import DynamicBrdf
from jaxprt.systems.harmonic import HarmonicBrdf
from jaxprt.systems.lobe import LobeBrdf
from jaxprt.systems.separable import SeparableBrdf
from jaxprt.systems.standard import tables
from jaxprt.systems.standard.tables import METALLIC_ROUGHNESS, SHEEN, StandardTable

BASE = 4  # number of terms of the base
# Coefficients of a `MaterialLook`: terms of the base, terms under a coat and the coat, those under a sheen and it.
_UNDER_COAT, _UNDER_SHEEN = BASE, 2 * BASE + 1
_MIRROR = 1  # index of the term of metallic-roughness whose lobe is that of a coat
_WHITE = 3  # index of the ideally diffuse term
_VIEWS = np.sqrt((np.arange(16) + 0.5) / 16)  # cosines of views, uniform in projected solid angle


class _Layer(NamedTuple):
    """What lies over a material."""

    first: int  # index of the first of its coefficients
    table: StandardTable  # with the lobe of the layer
    channel: int  # index in the table
    # Share of the light that a full layer takes from what is under it: a function of the cosines of views and of the
    # logarithms of the roughness.
    loss: Callable[[Float[np.ndarray, " v"], Float[np.ndarray, " n"]], Float[np.ndarray, "n v"]]
    reflects: bool  # whether that share multiplies the lobe, of albedo 1; the lobe of a sheen has its own albedo

    def lobe_factor(self, loss: Float[np.ndarray, "..."] | np.floating) -> Float[np.ndarray, "..."] | np.floating:
        """Factor of the lobe of the table for the loss of what is under it."""
        return loss if self.reflects else np.ones_like(loss)


def _coat_loss(cosine: np.ndarray, knot: np.ndarray) -> np.ndarray:
    return np.broadcast_to(coat_reflectance(cosine), (len(knot), len(cosine)))


def _sheen_loss(cosine: np.ndarray, knot: np.ndarray) -> np.ndarray:
    return sheen_albedo(cosine, np.exp(knot)[:, None])


_LAYERS = {
    "clear coat": _Layer(_UNDER_COAT, METALLIC_ROUGHNESS, _MIRROR, _coat_loss, reflects=True),
    "sheen": _Layer(_UNDER_SHEEN, SHEEN, 0, _sheen_loss, reflects=False),
}


class LayeredFamily(eqx.Module):
    """Maps the roughness of the base and of the layer to the BRDF of all channels.

    Attributes:
        coat: Whether the layer is a clear coat; else it is a sheen.
        scale: Factor of each channel.
    """

    coat: bool = eqx.field(static=True)
    scale: Float[Array, " k"]

    def __call__(self, log_roughness: Float[Array, ""] | float, log_layer: Float[Array, ""] | float) -> Channels:
        """The BRDF for the natural logarithms of both roughnesses."""
        base, roughness = MetallicRoughness(roughness=jnp.exp(log_roughness)).terms(), jnp.exp(log_layer)
        if self.coat:
            under = tuple(CoatedModel(model, transmits=True) for model in base)
            return Channels((*base, *under, CoatedModel(GGX(1.0, roughness), transmits=False)), self.scale)
        return Channels((*base, *(UnderSheen(model, roughness) for model in base), Charlie(roughness)), self.scale)


@dataclass(frozen=True)
class LayeredTable(StandardTable):
    """The tables of metallic-roughness materials under a layer; see `StandardTable`.

    Where that takes the logarithm of a roughness, this takes those of the base and of the layer.

    Attributes:
        over: Name of the layer, "clear coat" or "sheen".
    """

    over: str

    @property
    def layer(self) -> _Layer:
        """The layer."""
        return _LAYERS[self.over]

    @property
    def scale(self) -> Float[np.ndarray, " k"]:
        """Factor of each channel."""
        scale = METALLIC_ROUGHNESS.scale
        return np.concatenate([scale, scale, self.layer.table.scale[[self.layer.channel]]])

    @property
    def term(self) -> tuple[int, ...]:
        """Indices of the channels among the coefficients of a `MaterialLook`."""
        return (*range(BASE), *range(self.layer.first, self.layer.first + BASE + 1))

    @property
    def knots(self) -> tuple[np.ndarray, ...]:
        """Logarithms of the roughness of the base, and of that of the layer, at which lobes are tabulated."""
        return (self.knot, self.layer.table.knot)

    @property
    def family(self) -> Any:
        """Function from the logarithms of both roughnesses to the BRDF with all channels."""
        return LayeredFamily(self.layer.reflects, tables.constant(self.scale))

    def lobes(self, count: int = tables.LOBES) -> LobeBrdf:
        """The BRDF as lobes: `count` for the base, and as many for the layer."""
        require.count("count", count, least=1)
        return _lobes(self.over, int(count), jnp.result_type(float))

    def has_tensor(self, lobes: int, ranks: tuple[int, int, int] | None) -> bool:
        """Whether there are lobes, and the table of the base has such a tensor."""
        return METALLIC_ROUGHNESS.has_tensor(lobes, ranks) and lobes in self.layer.table.counts

    def tensor(
        self, lobes: int = tables.TENSOR_LOBES, ranks: tuple[int, int, int] | None = tables.RANKS
    ) -> DynamicBrdf:
        """The BRDF as lobes, a diffuse part and a tensor: `lobes` for the base, and as many for the layer.

        The tensor is that of the base, with the mean of what a layer takes. The layer has lobes alone.
        """
        return _tensor(self.over, int(lobes), ranks, jnp.result_type(float))

    def harmonics(self, degree: int = tables.DEGREE) -> HarmonicBrdf:
        """The BRDF in spherical harmonics up to a degree."""
        return _harmonics(self.over, degree, jnp.result_type(float))

    def paths(self) -> tuple[SeparableBrdf, FunctionWeights]:
        """The functions with which parts send light to others, and their weights over both roughnesses.

        Others receive the light of a sheen as that of a matte surface of the same albedo.
        """
        return _paths(self.over, jnp.result_type(float))

    def curvature(self, log_roughness: Any, weight: Float[np.ndarray, " k"], degree: int | None = None) -> float:
        """RMS Laplacian of radiance over the mirror direction: that of base or layer, whichever is larger."""
        rows = self._apart(log_roughness, weight)
        return max(table.curvature(place, part, degree) for table, place, part in rows if np.any(part))

    def samples(self, log_roughness: Any, size: int = tables.TEXELS) -> int:
        """Samples along the edge of a texel, for the smoother one of base and coat. A sheen needs one."""
        return METALLIC_ROUGHNESS.samples(min(log_roughness) if self.layer.reflects else log_roughness[0], size)

    def is_sharp(self, log_roughness: Any, weight: Float[np.ndarray, " k"] | None = None) -> bool:
        """Whether lobes of base and layer together are narrow enough to be traced."""
        weight = np.ones(2 * BASE + 1) if weight is None else np.asarray(weight, np.float64)
        rows = self._apart(log_roughness, weight)
        albedo = np.sum([table.albedos(place, part) for table, place, part in rows], 0)
        return bool(traced.is_traced(*albedo))

    def _apart(
        self, log_roughness: Any, weight: Float[np.ndarray, " k"]
    ) -> list[tuple[StandardTable, float, np.ndarray]]:
        """The tables of base and layer, the logarithm of the roughness of each, and mean weights of their channels."""
        weight, layer = np.asarray(weight, np.float64), self.layer
        loss = layer.loss(_VIEWS, np.array([log_roughness[1]])).mean()
        above = np.zeros(len(layer.table.scale))
        above[layer.channel] = weight[-1] * layer.lobe_factor(loss)
        base = weight[:BASE] + (1 - loss) * weight[BASE : 2 * BASE]
        return [(METALLIC_ROUGHNESS, log_roughness[0], base), (layer.table, log_roughness[1], above)]

    @property
    def _stored(self) -> Any:
        return METALLIC_ROUGHNESS._stored


COATED = LayeredTable("metallic_roughness under a clear coat", "clear coat")
SHEENED = LayeredTable("metallic_roughness under a sheen", "sheen")


def _cosine(tangent: np.ndarray) -> np.ndarray:
    """Cosines of views, given by tan(theta / 2)."""
    return (1 - tangent**2) / (1 + tangent**2)


def _over(base: ArrayLike, layer: ArrayLike, axis: int) -> np.ndarray:
    """Entries [... n v] of the base over the second parameter, and of the layer [... m v] over the first."""
    base, layer = np.asarray(base), np.asarray(layer)
    shape = (base.shape[-2], layer.shape[-2], base.shape[-1])
    rows = np.broadcast_to(base[..., :, None, :], (*base.shape[:-2], *shape))
    return np.concatenate([rows, np.broadcast_to(layer[..., None, :, :], (*layer.shape[:-2], *shape))], axis)


def _under(base: ArrayLike, layer: ArrayLike, loss: np.ndarray) -> np.ndarray:
    """Channels [k ... n v] of the base, these under a full layer, and that of the layer [1 ... m v]."""
    whole = _over(base, layer, 0)
    return np.concatenate([whole[:-1], whole[:-1] * (1 - loss), whole[-1:]])


@functools.cache
def _lobes(over: str, count: int, dtype: DTypeLike) -> LobeBrdf:
    return _layered_lobes(_LAYERS[over], METALLIC_ROUGHNESS.lobes(count), _LAYERS[over].table.lobes(count), dtype)


@functools.cache
def _tensor(over: str, count: int, ranks: tuple[int, int, int] | None, dtype: DTypeLike) -> DynamicBrdf:
    layer = _LAYERS[over]
    base = METALLIC_ROUGHNESS.tensor(count, ranks)
    lobes, factor = _layered_lobes(layer, base.lobe, layer.table.lobes(count), dtype), np.asarray(base.factor)
    loss = layer.loss(_VIEWS, layer.table.knot).mean(1)[:, None, None]
    shape = (len(factor), len(loss), *factor.shape[1:])
    rows = np.broadcast_to(factor[:, None], shape)
    none = np.zeros_like(rows[:, :, :1])
    whole = tables.constant(np.concatenate([rows, rows * (1 - loss), none], 2), dtype=dtype)
    return DynamicBrdf(lobes, base.core, whole, base.view_map, base.light_map, base.error)


def _layered_lobes(layer: _Layer, base: LobeBrdf, top: LobeBrdf, dtype: DTypeLike) -> LobeBrdf:
    """The lobes of the base, and those of the layer."""
    cosine = _cosine(np.linspace(0, 1, base.scale.shape[-1]))
    loss = layer.loss(cosine, layer.table.knot)
    rows = (np.asarray(row)[[layer.channel]] for row in (top.weight, top.diffuse))
    strength, matte = (row * layer.lobe_factor(loss) for row in rows)
    # Lobes of the base have no weight in the channel of the layer, and its lobes none in those of the base.
    weight = np.concatenate(
        [
            _under(base.weight, 0 * strength, loss),
            _under(np.zeros((BASE, *top.scale.shape[:1], *base.scale.shape[1:])), strength, loss),
        ],
        1,
    )
    arrays = (
        _over(base.mean, top.mean, 1),
        _over(base.scale, top.scale, 0),
        weight,
        _under(base.diffuse, matte, loss),
    )
    mean, scale, weight, diffuse = (tables.constant(array, dtype=dtype) for array in arrays)
    return LobeBrdf(mean, scale, weight, diffuse, (base.knot[0], top.knot[0]), jnp.maximum(base.error, top.error))


@functools.cache
def _harmonics(over: str, degree: int, dtype: DTypeLike) -> HarmonicBrdf:
    layer = _LAYERS[over]
    base, top = METALLIC_ROUGHNESS.harmonics(degree), layer.table.harmonics(degree)
    cosine, knot = _cosine(np.arange(base.table.shape[-1]) / base.steps), np.asarray(top.knot[0], np.float64)
    loss = layer.loss(cosine, knot)
    lobe = np.asarray(top.table)[:, [layer.channel]] * layer.lobe_factor(loss)
    channels = _under(np.moveaxis(np.asarray(base.table), 1, 0), np.moveaxis(lobe, 1, 0), loss)
    return HarmonicBrdf(
        tables.constant(np.moveaxis(channels, 0, 1), dtype=dtype),
        (base.knot[0], top.knot[0]),
        jnp.maximum(base.error, top.error),
    )


@functools.cache
def _paths(over: str, dtype: DTypeLike) -> tuple[SeparableBrdf, FunctionWeights]:
    layer = _LAYERS[over]
    brdf, path = METALLIC_ROUGHNESS.paths()
    factor, knot = np.asarray(path.factor), layer.table.knot
    loss = layer.loss(_VIEWS, knot).mean(1)
    if layer.reflects:
        row = factor[:, layer.channel] * loss[:, None]
    else:
        row = factor[0, _WHITE] / METALLIC_ROUGHNESS.scale[_WHITE] * loss[:, None]
    shape = (len(factor), len(knot))
    base = np.broadcast_to(factor[:, None], (*shape, *factor.shape[1:]))
    layers = np.broadcast_to(row[:, None], (*shape, 1, factor.shape[2]))
    whole = np.concatenate([base, base * (1 - loss[:, None, None]), layers], 2)
    return brdf, FunctionWeights(
        (path.knot[0], tables.constant(knot, dtype=dtype)), tables.constant(whole, dtype=dtype)
    )
