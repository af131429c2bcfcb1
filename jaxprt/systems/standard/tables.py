"""Tables of metallic-roughness, Blinn-Phong and Cook-Torrance materials and of sheens over roughness, shipped.

Each material has one file. `benchmarks.standard.fit` writes it. Reading runs on the host: it compiles no program.
Numbers are stored in half precision, directions in 16-bit fixed point.
"""

import dataclasses
import functools
import pathlib
from collections.abc import Mapping
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Float

from jaxprt import require
from jaxprt.sphere import harmonics, hemisphere
from jaxprt.systems import dynamic, lobe
from jaxprt.systems.bounces import traced
from jaxprt.systems.bounces.functions import FunctionWeights
from jaxprt.systems.dynamic import DynamicBrdf
from jaxprt.systems.harmonic import HarmonicBrdf
from jaxprt.systems.lobe import LobeBrdf
from jaxprt.systems.separable import SeparableBrdf
from jaxprt.systems.standard.families import RoughnessFamily, SheenFamily, ShininessFamily, SlopeFamily

LOBES = 12  # default number of lobes
DEGREE = 4  # of the harmonics
UNIT = 32767  # a component of 1 of a direction, in fixed point
TENSOR_LOBES, RANKS = 12, (4, 8, 8)  # of the tensors that are shipped: number of lobes beside, and ranks
TEXELS = 64  # edge of the cubemap faces for which numbers of samples are stored


@dataclass(frozen=True)
class StandardTable:
    """The tables of one kind of material over the logarithm of its roughness.

    The channels are the terms of the material, times `scale`. Weights of a `Blend` are divided by `scale`.

    Attributes:
        name: Name of the material, and of the file.
    """

    name: str

    @property
    def scale(self) -> Float[np.ndarray, " k"]:
        """Factor of each channel."""
        return np.array(self._stored["channel"], np.float64)

    @property
    def term(self) -> tuple[int, ...]:
        """Indices of the channels."""
        return tuple(range(len(self._stored["channel"])))

    @property
    def knot(self) -> Float[np.ndarray, " n"]:
        """Logarithms of roughness at which lobes are tabulated."""
        return np.array(self._stored["knot"], np.float64)

    @property
    def knots(self) -> tuple[np.ndarray, ...]:
        """The knots of each parameter of the table: those of the roughness."""
        return (self.knot,)

    @property
    def most_exponent(self) -> float:
        """The exponent of `BlinnPhong` at the smallest tabulated roughness."""
        return float(2 * np.exp(-2 * self.range[0]) - 2)

    @property
    def range(self) -> tuple[float, float]:
        """Logarithms of the smallest and the largest tabulated roughness; others are clamped to them."""
        knot = self._stored["knot"]
        return float(knot[0]), float(knot[-1])

    @property
    def counts(self) -> tuple[int, ...]:
        """Numbers of lobes whose tables are shipped."""
        names = (name for name in self._stored if name.startswith("lobes") and name.endswith(".mean"))
        return tuple(sorted(int(name[5:-5]) for name in names))

    @property
    def family(self) -> RoughnessFamily | ShininessFamily | SlopeFamily | SheenFamily:
        """Function from the logarithm of a roughness to the BRDF with all channels."""
        scale = constant(self._stored["channel"])
        if self.name == "blinn_phong":
            return ShininessFamily(scale)
        if self.name == "cook_torrance":
            return SlopeFamily(scale)
        if self.name == "sheen":
            return SheenFamily(scale)
        return RoughnessFamily(tuple(range(len(scale))), scale, constant(np.zeros(())))

    def lobes(self, count: int = LOBES) -> LobeBrdf:
        """The BRDF as lobes.

        The error is the largest of those at and halfway between the knots, of the sum of all channels.

        Args:
            count: Number of lobes. Tables of other numbers than `counts` are fitted when they are first asked for, by
                `jaxprt.lobe.tabulate` without the descent of the shipped ones, and kept for this process.

        Raises:
            ValueError: The number of lobes is below 1.
        """
        require.count("count", count, least=1)
        return _lobes(self, int(count), _dtype())

    def errors(self, count: int = LOBES) -> Float[np.ndarray, " n"]:
        """Errors of a shipped table of lobes at its knots and halfway between them; see `lobes`."""
        return np.array(self._stored[f"lobes{count}.error"], np.float64)

    def harmonics(self, degree: int = DEGREE) -> HarmonicBrdf:
        """The BRDF in spherical harmonics up to a degree, with the error of the whole table.

        Raises:
            ValueError: The degree is negative or above that of the table, 4.
        """
        most = harmonics.degree_of(len(self._stored["harmonics"]))
        if not 0 <= degree <= most:
            raise ValueError(f"degree must be between 0 and the table's {most}, got {degree}")
        return _harmonics(self, degree, _dtype())

    def has_tensor(self, lobes: int, ranks: tuple[int, int, int] | None) -> bool:
        """Whether a tensor of these ranks is shipped for what so many lobes leave; without ranks, whether lobes are."""
        if ranks is None:
            return lobes in self.counts
        return lobes == TENSOR_LOBES and tuple(ranks) == RANKS and "tensor.core" in self._stored

    def tensor(self, lobes: int = TENSOR_LOBES, ranks: tuple[int, int, int] | None = RANKS) -> DynamicBrdf:
        """The BRDF as lobes, a diffuse part and a tensor, for the dynamic system.

        Args:
            lobes: Number of lobes.
            ranks: Ranks of the tensor; None for lobes alone. Other sizes than the shipped ones are fitted when they are
                first asked for, and kept for this process.
        """
        return _tensor(self, int(lobes), None if ranks is None else tuple(ranks), _dtype())

    def paths(self) -> tuple[SeparableBrdf, FunctionWeights]:
        """The functions with which parts send light to others, and their weights over roughness."""
        if "path.view" not in self._stored:
            raise ValueError(f"no functions of light paths are shipped for {self.name}")
        return _paths(self, _dtype())

    def curvature(self, log_roughness: float, weight: Float[np.ndarray, " k"], degree: int | None = None) -> float:
        """RMS Laplacian of radiance over the mirror direction; see `jaxprt.relit.curvature.of_part`.

        Args:
            log_roughness: Logarithm of the smallest roughness of a part. Between knots the logarithm of the curvature
                is interpolated.
            weight: Mean weights of the channels, relative to `scale`, averaged over colors.
            degree: Degree of a part's harmonics; None if it has none.
        """
        zonal = np.einsum("nlk,k->nl", self._stored["zonal"], np.asarray(weight, np.float64))
        zonal = zonal if degree is None else zonal[:, : degree + 1]
        band = np.arange(zonal.shape[1])
        power = (2 * band + 1) / (band + 0.5) ** 2 * zonal**2
        total, square = power.sum(1), (power * (band * (band + 1.0)) ** 2).sum(1)
        if not np.all((total > 0) & (square > 0)):
            return 0.0
        return float(np.exp(np.interp(log_roughness, self._stored["knot"], np.log(square / total) / 2)))

    def samples(self, log_roughness: float, size: int = TEXELS) -> int:
        """Samples along the edge of a texel; see `jaxprt.bright_texels.samples_for`.

        Numbers are stored for faces of 64 texels and for the channels with equal weights. A diffuse part would need
        fewer. What counts is the width of the lobe in texels, so those of other sizes are read at another roughness.

        Args:
            log_roughness: Logarithm of the smallest roughness of a part.
            size: Edge of the cubemap faces in texels.
        """
        knot = self._stored["samples.knot"]
        power = 2 if self.name == "metallic_roughness" else 1  # the width of lobes is proportional to that of roughness
        place = max(log_roughness, self.range[0]) + np.log(size / TEXELS) / power
        return int(self._stored["samples"][max(int(np.searchsorted(knot, place + 1e-6)) - 1, 0)])

    def is_sharp(self, log_roughness: float, weight: Float[np.ndarray, " k"] | None = None) -> bool:
        """Whether lobes are narrow enough to be traced; see `jaxprt.systems.bounces.traced.is_sharp`.

        Args:
            log_roughness: Logarithm of the smallest roughness of a part.
            weight: Mean weights of the channels, relative to `scale`, of one color or of their mean; None for ones.
        """
        return bool(traced.is_traced(*self.albedos(log_roughness, weight)))

    def albedos(self, log_roughness: float, weight: Float[np.ndarray, " k"] | None = None) -> Float[np.ndarray, "3"]:
        """Albedos of traced lobes, of all lobes, and of the diffuse part; arguments as of `is_sharp`."""
        albedo = self._stored["albedo"].astype(np.float64)
        albedo = albedo.sum(2) if weight is None else albedo @ np.asarray(weight, np.float64)
        return np.array([np.interp(log_roughness, self._stored["knot"], row) for row in albedo])

    @property
    def _stored(self) -> Mapping[str, np.ndarray]:
        return _read(self.name)


METALLIC_ROUGHNESS = StandardTable("metallic_roughness")
BLINN_PHONG = StandardTable("blinn_phong")
COOK_TORRANCE = StandardTable("cook_torrance")
SHEEN = StandardTable("sheen")


def path(name: str) -> pathlib.Path:
    """The file of a table."""
    return pathlib.Path(__file__).with_name(f"{name}.npz")


def forget() -> None:
    """Forgets the tables of this process, so that the next use reads them again."""
    for reader in (_read, _lobes, _tensor, _harmonics, _paths):
        reader.cache_clear()


@functools.cache
def _read(name: str) -> Mapping[str, np.ndarray]:
    with np.load(path(name), allow_pickle=False) as file:
        return {key: file[key] for key in file.files}


@functools.cache
def _lobes(table: StandardTable, count: int, dtype: DTypeLike) -> LobeBrdf:
    if count not in table.counts:
        with jax.ensure_compile_time_eval():
            return lobe.tabulate(table.family, lobes=count, knot=(np.asarray(table._stored["knot"]),))
    stored = {name: table._stored[f"lobes{count}.{name}"] for name in ("scale", "weight", "diffuse")}
    mean = table._stored[f"lobes{count}.mean"].astype(np.float64) / UNIT
    scale, weight, diffuse = (constant(value, dtype=dtype) for value in stored.values())
    knot, error = (
        constant(table._stored["knot"], dtype=dtype),
        constant(np.asarray(np.max(table.errors(count))), dtype=dtype),
    )
    return LobeBrdf(constant(mean / np.linalg.norm(mean, axis=0), dtype=dtype), scale, weight, diffuse, (knot,), error)


@functools.cache
def _tensor(table: StandardTable, lobes: int, ranks: tuple[int, int, int] | None, dtype: DTypeLike) -> DynamicBrdf:
    if not table.has_tensor(lobes, ranks):
        with jax.ensure_compile_time_eval():
            knot = (np.asarray(table._stored["knot"]),)
            return dynamic.tabulate(table.family, lobes=table.lobes(lobes) if lobes else 0, ranks=ranks, knot=knot)
    if ranks is None:
        return dynamic.table.without_tensor(table.lobes(lobes))
    brdf = table.lobes(lobes)
    diffuse = constant(np.asarray(brdf.diffuse) + table._stored["tensor.diffuse"], dtype=dtype)
    names = "core", "factor", "view", "light", "error"
    rows = (constant(table._stored[f"tensor.{name}"], dtype=dtype) for name in names)
    return DynamicBrdf(dataclasses.replace(brdf, diffuse=diffuse), *rows)


@functools.cache
def _harmonics(table: StandardTable, degree: int, dtype: DTypeLike) -> HarmonicBrdf:
    stored = table._stored
    value = constant(stored["harmonics"][: (degree + 1) ** 2], dtype=dtype)
    return HarmonicBrdf(
        value, (constant(stored["harmonics.knot"], dtype=dtype),), constant(stored["harmonics.error"], dtype=dtype)
    )


@functools.cache
def _paths(table: StandardTable, dtype: DTypeLike) -> tuple[SeparableBrdf, FunctionWeights]:
    names = "light", "view", "factor", "error"
    light, view, factor, error = (constant(table._stored[f"path.{name}"], dtype=dtype) for name in names)
    knot = (constant(table._stored["knot"], dtype=dtype),)
    return SeparableBrdf(light, view, error, hemisphere.parabolic_coordinates), FunctionWeights(knot, factor)


def _dtype() -> DTypeLike:
    return jnp.result_type(float)


def constant(value: np.ndarray, *, dtype: DTypeLike | None = None) -> jax.Array:
    """An array on the device, also while JAX traces a function. No program is compiled."""
    with jax.ensure_compile_time_eval():
        return jax.device_put(np.asarray(value, _dtype() if dtype is None else dtype))
