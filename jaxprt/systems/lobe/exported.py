"""What an exported page holds of lobes: their table, averaged visibility, and transfer vectors for the diffuse part."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from jaxprt.files.inputs import JsonObject
from jaxprt.scene.points import VERTICES
from jaxprt.systems.lobe import pyramid
from jaxprt.systems.lobe.pyramid import LobeTransport, Scales
from jaxprt.systems.lobe.table import LobeBrdf
from jaxprt.systems.protocol import CHANNELS, Exported, System

DEGREE = 6  # of the harmonics by which pages light diffuse parts
_LIGHT = 64  # most texels along a face's edge of the light that lobes read


class CoarseTransport(LobeTransport):
    """Visibility without its finest scales, for a light of another size.

    Attributes:
        vector: Transfer vectors in spherical harmonics.
        edge: Texels along a face's edge of the visibility.
        spread: Width of the finest remaining scale.
    """

    vector: Float[Array, "lm v"]
    edge: int = eqx.field(static=True)
    spread: float = eqx.field(static=True)

    def lobe_visibility(self, face, s, t, spread, points=VERTICES):
        """Visible fraction of each vertex's lobes, from the remaining scales."""
        none = jnp.zeros((0, len(self.position)), jnp.uint8)
        whole = LobeTransport(self.pyramid, none, self.position, self.frame, self.edge)
        return whole.lobe_visibility(face, s, t, jnp.maximum(spread, self.spread), points)


class ExportedLobes(Exported):
    """What an exported page holds of a `LobeSystem`.

    Attributes:
        level: Finest scale of the visibility that the page holds.
        by_bits: Whether the page makes the means of visibility from the bits of texels, which it holds too.
    """

    level: int = eqx.field(static=True, default=0)
    by_bits: bool = eqx.field(static=True, default=False)

    @property
    def brdf(self) -> LobeBrdf:
        """The table of lobes."""
        return self.system.brdf

    @property
    def channels(self) -> int:
        """Number of channels of the table."""
        return len(self.brdf.weight)

    @property
    def light_size(self) -> int:
        """Edge of the faces of the light, in texels."""
        return min(_LIGHT, self.system.transport.size)

    @property
    def scales(self) -> Scales:
        """Scales of the visibility."""
        return pyramid.scales(self.system.transport.size)

    @property
    def means(self) -> UInt8[np.ndarray, "v n"]:
        """Mean visibility from the finest scale on; nothing where the page makes it from bits."""
        if self.by_bits:
            return np.zeros((0, 0), np.uint8)
        return np.ascontiguousarray(np.asarray(self.system.transport.pyramid)[:, self.scales.start[self.level] :])

    @property
    def description(self) -> JsonObject:
        """Numbers by which the page's module reads the table."""
        return super().description | lobe_description(self.brdf)

    def table(self, what: str) -> Float[np.ndarray, "h q e 4"]:
        """For each knot and view node: mean, log concentration and weights of each lobe, and albedos."""
        self.check_table(what)
        return lobe_entries(self.brdf)

    def texel_brdf(self, brdf: Callable) -> Callable:
        """The lobes alone."""
        return self.brdf.value

    def with_table(self, table: Any) -> "ExportedLobes":
        """The same visibility with the BRDF of a standard table: the half of the lobes that are the base's."""
        brdf = table.lobes(self.brdf.lobes // 2)
        return dataclasses.replace(self, system=dataclasses.replace(self.system, brdf=brdf))

    def reduced(self, level: int, degree: int | None) -> "ExportedLobes":
        """The same with visibility from a scale on."""
        return dataclasses.replace(self, level=level)

    def means_by_bits(self) -> "ExportedLobes":
        """The same with means of visibility that the page makes from the bits of texels."""
        return dataclasses.replace(self, by_bits=True)

    def relit(self) -> System:
        """The lobes with the remaining visibility, under a light of fewer texels."""
        old, spread = self.system.transport, float(self.scales.spread[self.level])
        old = pyramid.from_bits(old) if self.by_bits else old
        vector = jnp.asarray(self.vector, jnp.result_type(float))
        places = old.position, old.frame, self.light_size
        return self.system.coarse(CoarseTransport(old.pyramid, vector, *places, old.size, spread))


def lobe_description(brdf: LobeBrdf) -> JsonObject:
    """Numbers by which the page's module reads a table of lobes."""
    return {"lobes": brdf.lobes, "steps": float(brdf.weight.shape[-1] - 1)}


def lobe_entries(brdf: LobeBrdf) -> Float[np.ndarray, "h q e 4"]:
    """A table of lobes for pages: for each knot and view node the mean, log concentration and weights of each lobe.

    The albedos follow the lobes.
    """
    mean, scale, weight, albedo = map(np.asarray, (brdf.mean, brdf.scale, brdf.weight, brdf.diffuse))
    if not brdf.knot:
        mean, scale, weight, albedo = mean[:, :, None], scale[:, None], weight[:, :, None], albedo[:, None]
    lobes, count, nodes = scale.shape
    result = np.zeros((count, nodes, 2 * lobes + 1, CHANNELS))
    result[:, :, 0:-1:2, :3] = mean.transpose(2, 3, 1, 0)
    result[:, :, 0:-1:2, 3] = scale.transpose(1, 2, 0)
    result[:, :, 1::2, : len(weight)] = weight.transpose(2, 3, 1, 0)
    result[:, :, -1, : len(albedo)] = albedo.transpose(1, 2, 0)
    return result
