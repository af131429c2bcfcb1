"""Tables of metallic-roughness materials under a clear coat, made of those of materials without one.

A table has two parameters: the logarithms of the roughness of the base and of the coat. Its channels are the four
terms of the base, these terms under the coat, and the coat. Lobes of the base and of the coat stand one after another,
so no lobe is fitted, and between knots the lobes of one do not change with the roughness of the other.
"""

import functools
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.brdf import GGX, CoatedModel, MetallicRoughness, coat_reflectance
from jaxprt.brdf.varying import Channels
from jaxprt.systems.bounces.varying import Sent
from jaxprt.systems.harmonic import HarmonicBrdf
from jaxprt.systems.lobe import LobeBrdf
from jaxprt.systems.separable import SeparableBrdf
from jaxprt.systems.standard import tables
from jaxprt.systems.standard.tables import METALLIC_ROUGHNESS, StandardTable

BASE = 4  # number of terms of the base
_MIRROR = 1  # index of the term whose lobe is that of the coat
_MEAN = 0.04 + 0.96 / 21  # reflectance of the coat, averaged over the cosine of views


class CoatedFamily(eqx.Module):
    """Maps the roughness of the base and of the coat to the BRDF of all channels.

    Attributes:
        scale: Factor of each channel.
    """

    scale: Float[Array, " k"]

    def __call__(self, log_roughness: Float[Array, ""] | float, log_coat: Float[Array, ""] | float) -> Channels:
        """The BRDF for the natural logarithms of both roughnesses."""
        base = MetallicRoughness(roughness=jnp.exp(log_roughness)).terms()
        coat = GGX(1.0, jnp.exp(log_coat))
        under = tuple(CoatedModel(each, transmits=True) for each in base)
        return Channels((*base, *under, CoatedModel(coat, transmits=False)), self.scale)


@dataclass(frozen=True)
class CoatedTable(StandardTable):
    """The tables of metallic-roughness materials under a clear coat; see `StandardTable`.

    Where that takes the logarithm of a roughness, this takes those of the base and of the coat.
    """

    name: str = "coated metallic_roughness"

    @property
    def scale(self) -> Float[np.ndarray, " k"]:
        """Factor of each channel."""
        scale = METALLIC_ROUGHNESS.scale
        return np.concatenate([scale, scale, scale[[_MIRROR]]])

    @property
    def term(self) -> tuple[int, ...]:
        """Indices of the channels."""
        return tuple(range(2 * BASE + 1))

    @property
    def knots(self) -> tuple[np.ndarray, ...]:
        """Logarithms of the roughness of the base, and of that of the coat, at which lobes are tabulated."""
        return (self.knot, self.knot)

    @property
    def family(self) -> Any:
        """Function from the logarithms of both roughnesses to the BRDF with all channels."""
        return CoatedFamily(tables.constant(self.scale))

    def lobes(self, count: int = tables.LOBES) -> LobeBrdf:
        """The BRDF as lobes: `count` for the base, and as many for the coat."""
        require.count("count", count, least=1)
        return _lobes(int(count), jnp.result_type(float))

    def harmonics(self, degree: int = tables.DEGREE) -> HarmonicBrdf:
        """The BRDF in spherical harmonics up to a degree."""
        return _harmonics(degree, jnp.result_type(float))

    def paths(self) -> tuple[SeparableBrdf, Sent]:
        """The functions with which parts send light to others, and their weights over both roughnesses."""
        return _paths(jnp.result_type(float))

    def curvature(self, log_roughness: Any, weight: Float[np.ndarray, " k"], degree: int | None = None) -> float:
        """RMS Laplacian of radiance over the mirror direction: that of the base or of the coat, whichever is larger."""
        base, coat = _apart(weight)
        each = zip(log_roughness, (base, coat), strict=True)
        return max(METALLIC_ROUGHNESS.curvature(place, own, degree) for place, own in each if np.any(own))

    def samples(self, log_roughness: Any, size: int = tables.TEXELS) -> int:
        """Samples along the edge of a texel, for the smoother one of base and coat."""
        return METALLIC_ROUGHNESS.samples(min(log_roughness), size)

    def is_sharp(self, log_roughness: Any, weight: Float[np.ndarray, " k"] | None = None) -> bool:
        """Whether lobes of the base and of the coat together are narrow enough to be traced."""
        weight = np.ones(2 * BASE + 1) if weight is None else np.asarray(weight, np.float64)
        each = [
            METALLIC_ROUGHNESS.albedos(place, own) for place, own in zip(log_roughness, _apart(weight), strict=True)
        ]
        return tables.is_traced(np.sum(each, 0))

    @property
    def _stored(self) -> Any:
        return METALLIC_ROUGHNESS._stored


COATED = CoatedTable()


def _apart(weight: Float[np.ndarray, " k"]) -> tuple[np.ndarray, np.ndarray]:
    """Mean weights of the terms of the base, and of those of the coat."""
    weight = np.asarray(weight, np.float64)
    base = weight[:BASE] + (1 - _MEAN) * weight[BASE : 2 * BASE]
    coat = np.zeros(BASE)
    coat[_MIRROR] = _MEAN * weight[-1]
    return base, coat


def _reflectance(tangent: np.ndarray) -> np.ndarray:
    """Reflectance of the coat at the view nodes of a table, given by tan(theta / 2)."""
    return np.asarray(coat_reflectance((1 - tangent**2) / (1 + tangent**2)))


@functools.cache
def _lobes(count: int, dtype: Any) -> LobeBrdf:
    table = METALLIC_ROUGHNESS.lobes(count)
    mean, scale, weight, diffuse = (np.asarray(each) for each in (table.mean, table.scale, table.weight, table.diffuse))
    knots, nodes = scale.shape[1:]
    share = _reflectance(np.linspace(0, 1, nodes))

    def over(base: np.ndarray, coat: np.ndarray | None, axis: int) -> np.ndarray:
        """Entries of the base over the second parameter, and of the coat over the first."""
        shape = (*base.shape[:-2], knots, knots, nodes)
        rows = [np.broadcast_to(base[..., :, None, :], shape)]
        if coat is not None:
            rows.append(np.broadcast_to(coat[..., None, :, :], shape))
        return np.concatenate(rows, axis)

    under = np.concatenate([weight, weight * (1 - share), 0 * weight[:1]])
    above = np.concatenate([np.zeros((2 * BASE, *weight.shape[1:]), weight.dtype), weight[[_MIRROR]] * share])
    flat = np.concatenate([over(np.concatenate([diffuse, diffuse * (1 - share)]), None, 0)])
    flat = np.concatenate([flat, np.broadcast_to((diffuse[[_MIRROR]] * share)[:, None], (1, knots, knots, nodes))])
    arrays = (over(mean, mean, 1), over(scale, scale, 0), over(under, above, 1), flat)
    mean, scale, weight, diffuse = (tables.constant(each, dtype=dtype) for each in arrays)
    return LobeBrdf(mean, scale, weight, diffuse, (table.knot[0], table.knot[0]), table.error)


@functools.cache
def _harmonics(degree: int, dtype: Any) -> HarmonicBrdf:
    table = METALLIC_ROUGHNESS.harmonics(degree)
    value = np.asarray(table.table)
    rows, _, knots, nodes = value.shape
    share = _reflectance(np.arange(nodes) / table.steps)
    base = np.concatenate([value, value * (1 - share)], 1)[:, :, :, None]
    coat = (value[:, [_MIRROR]] * share)[:, :, None]
    whole = [np.broadcast_to(each, (rows, each.shape[1], knots, knots, nodes)) for each in (base, coat)]
    return HarmonicBrdf(tables.constant(np.concatenate(whole, 1), dtype=dtype), (table.knot[0],) * 2, table.error)


@functools.cache
def _paths(dtype: Any) -> tuple[SeparableBrdf, Sent]:
    brdf, sent = METALLIC_ROUGHNESS.paths()
    factor = np.asarray(sent.factor)
    base = np.concatenate([factor, (1 - _MEAN) * factor], 1)[:, None]
    coat = (_MEAN * factor[:, [_MIRROR]])[None]
    shape = (len(factor), len(factor))
    whole = np.concatenate([np.broadcast_to(each, (*shape, *each.shape[2:])) for each in (base, coat)], 2)
    return brdf, Sent((sent.knot[0],) * 2, tables.constant(whole, dtype=dtype))
