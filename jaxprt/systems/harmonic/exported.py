"""What an exported page holds of transfer matrices: harmonics of the visibility, and the BRDF by zonal harmonics.

Transfer matrices have many more entries than the visibility that they come from. A page stores the visibility in the
world, of twice the degree, and makes the matrices from it.
"""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxprt.files.inputs import JsonObject
from jaxprt.sphere import harmonics
from jaxprt.systems.harmonic.table import HarmonicBrdf
from jaxprt.systems.harmonic.transfer import TransferMatrix, from_visibility, to_visibility
from jaxprt.systems.protocol import CHANNELS, Exported, System

_EQUAL = 1e-3  # largest relative error at which matrices count as products of a visibility, and tables as symmetric


class ExportedMatrices(Exported):
    """What an exported page holds of a `HarmonicSystem`."""

    @classmethod
    def of(cls, what: str, system: Any) -> "ExportedMatrices":
        """What a page holds of a `HarmonicSystem`. `what` names it in messages."""
        transport = system.transport
        if transport.matrix.shape[1] != 1:
            raise ValueError(
                f"{what} must have gray transfer matrices to be exported, got {transport.matrix.shape[1]} colors"
            )
        matrix = transport.matrix[:, 0]
        visible = to_visibility(matrix, transport.frame)
        again = from_visibility(visible, transport.frame, degree=system.degree)
        if not float(jnp.linalg.norm(again - matrix)) <= _EQUAL * float(jnp.linalg.norm(matrix)):
            raise ValueError(
                f"{what} must have the transfer matrices of direct light to be exported, got others, as with "
                "interreflection"
            )
        return cls(system, np.zeros((0, system.vertices)), np.asarray(visible, np.float64))

    @property
    def brdf(self) -> HarmonicBrdf:
        """The table of harmonics, up to the degree of the matrices."""
        return self.system.brdf.truncate(degree=self.degree)

    @property
    def channels(self) -> int:
        """Number of channels of the table."""
        return self.brdf.table.shape[1]

    @property
    def diffuse(self) -> Float[np.ndarray, "lm v"]:
        """Transfer vectors of an ideally diffuse response: the matrices times a clamped cosine about the normal."""
        zonal = np.arange(self.system.degree + 1)
        matrix = np.asarray(self.system.transport.matrix, np.float64)[:, 0]
        return np.einsum("l,vli->iv", upright_cosine(self.system.degree), matrix[:, zonal * (zonal + 1)])

    @property
    def degree(self) -> int:
        """Degree of the matrices."""
        return harmonics.degree_of(len(self.visible)) // 2

    @property
    def description(self) -> JsonObject:
        """Numbers by which the page's module reads the visibility and the table."""
        visible = {"bands": self.degree + 1, "words": -(-len(self.visible) // 4)}
        return super().description | visible | {"steps": self.brdf.steps, "laplacian": float(self.system.laplacian)}

    def table(self, what: str) -> Float[np.ndarray, "h q e 4"]:
        """Table of the BRDF by zonal harmonics: for each knot, view node, band and each of `degree + 1` directions.

        A BRDF that is symmetric about the plane of the view direction and the normal can be written, in each band, as a
        sum of zonal harmonics about directions in this plane. Its dot product with the light is then the sum of the
        light's bands, evaluated in these directions, times the entries. The page therefore does not rotate harmonics.
        """
        self.check_table(what)
        brdf = self.brdf
        value = np.asarray(brdf.table, np.float64)
        value = value if brdf.knot else value[:, :, None]
        bands = brdf.degree + 1
        angle = np.pi * (np.arange(bands) + 0.5) / bands
        way = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], -1)
        basis = np.asarray(harmonics.evaluate(jnp.asarray(way, jnp.result_type(float)), degree=brdf.degree), np.float64)
        result = np.zeros((*value.shape[2:], bands, bands, CHANNELS))
        missed = 0.0
        for band in range(bands):
            rows = slice(band**2, (band + 1) ** 2)
            factor = np.einsum("jm,mchq->hqjc", np.linalg.pinv(basis[:, rows].T), value[rows])
            missed += float(np.sum((np.einsum("jm,hqjc->mchq", basis[:, rows], factor) - value[rows]) ** 2))
            result[:, :, band, :, : value.shape[1]] = factor
        if not np.sqrt(missed) <= _EQUAL * np.linalg.norm(value):
            raise ValueError(f"{what} must have a BRDF that is symmetric about the plane of the view to be exported")
        return result.reshape(*value.shape[2:], bands**2, CHANNELS)

    def with_table(self, table: Any) -> "ExportedMatrices":
        """The same matrices with the BRDF of a standard table."""
        brdf = table.harmonics(self.system.degree)
        return dataclasses.replace(self, system=dataclasses.replace(self.system, brdf=brdf))

    def reduced(self, level: int, degree: int | None) -> "ExportedMatrices":
        """The same with matrices up to a degree; None for all."""
        return self if degree is None else dataclasses.replace(self, visible=self.visible[: (2 * degree + 1) ** 2])

    def relit(self) -> System:
        """The system with the matrices of the visibility."""
        old = self.system.transport
        visible = jnp.asarray(self.visible, old.matrix.dtype)
        matrix = from_visibility(visible, old.frame, degree=self.degree)[:, None]
        transport = TransferMatrix(matrix, old.position, old.frame)
        return dataclasses.replace(self.system, transport=transport, brdf=self.brdf)


def upright_cosine(degree: int) -> Float[np.ndarray, " l"]:
    """Factors of the harmonics of order zero in a vertex's frame, whose sum is irradiance / pi."""
    band = np.arange(degree + 1)
    return np.asarray(harmonics.cosine(degree=degree), np.float64) / np.pi * np.sqrt((2 * band + 1) / (4 * np.pi))
