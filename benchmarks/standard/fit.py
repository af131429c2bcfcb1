"""Fits the tables that are shipped, and writes their files.

    python -m benchmarks.standard.fit [--lobes 12 ...] [--only lobes|harmonics|...] [MATERIAL ...]

What is not fitted anew stays in the file as it is. Lobes are fitted by EM jointly over roughness and view, and improved
by descent at roughnesses whose lobes are wide enough for its quadrature. Errors are those of the rounded numbers.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from benchmarks.standard import descent
from jaxprt.brdf import MetallicRoughness, sheen
from jaxprt.brdf.varying import Channels
from jaxprt.sphere import hemisphere
from jaxprt.systems import bounces, bright_texels, dynamic, harmonic, lobe
from jaxprt.systems.bounces import traced
from jaxprt.systems.lobe import LobeBrdf, em
from jaxprt.systems.lobe.table import brdf_samples, measured_error
from jaxprt.systems.standard import tables
from jaxprt.systems.standard.families import RoughnessFamily, SheenFamily, ShininessFamily, SlopeFamily

KNOTS, FEW = 20, 10  # FEW for lobes of sheens, which are wide
STEPS = 1000  # of the descent
ANGLES = 48  # view nodes of the harmonics
BANDS = 128  # degree of the zonal harmonics from which curvatures are computed
FINER = 4  # roughnesses for which numbers of samples are stored, per knot; and step of sizes
SMALLEST = 16  # edge of the smallest cubemap faces with numbers of samples of their own
_RINGS, _SECTORS = 96, 64  # quadrature of the zonal harmonics
_VIEW = np.array([0.6, 0.0, 0.8], np.float32)
_FUNCTIONS, _TERMS, _RESOLUTION = 2, 24, 32  # of light paths
_WIDTH = 0.09  # smallest alpha of lobes along light paths
_DIFFUSE = (0, 3)  # channels of metallic-roughness and Cook-Torrance without lobes
_SENDING = ("metallic_roughness", "cook_torrance")  # materials whose functions of light paths are shipped
_DARK = 1e-6


class StandardMaterial(NamedTuple):
    """What is tabulated.

    Attributes:
        family: Function from the logarithm of roughness to the BRDF.
        scale: Factor of each channel. Diffuse channels have small ones, so that EM fits the lobes to the others.
        smoothest: Smallest roughness.
        weight: Weights of the channels in typical materials, relative to the scales.
        first: Roughness from which on descent improves the lobes.
        knot: Knots of the harmonics.
        power: Power of the roughness to which the width of lobes is proportional.
        knot_count: Number of knots of everything but the harmonics.
    """

    family: RoughnessFamily | ShininessFamily | SlopeFamily | SheenFamily
    scale: np.ndarray
    smoothest: float
    weight: np.ndarray
    first: float
    knot: np.ndarray
    power: int
    knot_count: int = KNOTS

    @property
    def knots(self) -> np.ndarray:
        """Knots of everything but the harmonics, evenly spaced in the logarithm of roughness."""
        return np.linspace(np.log(self.smoothest), 0, self.knot_count)


def material_of(name: str) -> StandardMaterial:
    """The material of a file."""
    random = np.random.default_rng(0)
    base, other = random.uniform(0.05, 1, (2, 60, 1)).astype(np.float32)
    if name == "blinn_phong":
        scale = np.array([0.1, 1.0], np.float32)
        # Every other one has no diffuse base.
        weight = np.concatenate([base * (np.arange(60) % 2)[:, None], other], 1) / scale
        return StandardMaterial(
            ShininessFamily(jnp.asarray(scale)), scale, 10**-2.5, weight, 0.1, _spread(10**-2.5, 1), 1
        )
    if name == "cook_torrance":
        scale, f0 = np.array([0.1, 1.0, 1.0], np.float32), np.linspace(0, 1, 60, dtype=np.float32)[:, None]
        rows = [base * (np.arange(60) % 2)[:, None], other * f0, other * (1 - f0)]
        weight = np.concatenate(rows, 1) / scale
        return StandardMaterial(SlopeFamily(jnp.asarray(scale)), scale, 10**-2.5, weight, 0.3, _spread(10**-2.5, 1), 1)
    if name == "sheen":
        scale, knot = np.ones(1, np.float32), _spread(sheen.SMOOTHEST, 1)
        return StandardMaterial(
            SheenFamily(jnp.asarray(scale)), scale, sheen.SMOOTHEST, base, sheen.SMOOTHEST, knot, 1, FEW
        )
    scale = np.array([0.1, 1.0, 1.0, 0.02], np.float32)
    metallic, specular = (
        np.resize(values, 60).astype(np.float32) for values in ([0, 0, 1, 1, 0.3, 0.6], [1, 0.6, 1, 1, 0.5])
    )
    brdf = MetallicRoughness(base_color=base, metallic=metallic, specular=specular)
    weight = np.asarray(brdf.coefficient())[..., 0] / scale
    family = RoughnessFamily((0, 1, 2, 3), jnp.asarray(scale), jnp.zeros(()))
    return StandardMaterial(family, scale, 1e-3**0.5, weight, 0.3, _spread(1e-3**0.5, 2), 2)


def _spread(smoothest: float, power: int, count: int = 16) -> np.ndarray:
    """Knots of harmonics: equal steps of the root of the width of lobes, because narrow ones have equal harmonics."""
    return np.log(np.linspace(smoothest ** (power / 2), 1, count)) * 2 / power


def lobes(material: StandardMaterial, count: int) -> dict[str, np.ndarray]:
    """Arrays of a table of lobes: those of the `LobeBrdf`, rounded, and its errors at and halfway between the knots."""
    table = lobe.tabulate(material.family, lobes=count, knot=(material.knots,))
    least = np.stack([_least(material.family(jnp.asarray(knot)), count) for knot in material.knots], 1)
    table = descent.improve(
        table, material.family, material.weight, least, first=float(np.log(material.first)), steps=STEPS
    )
    mean = np.round(np.asarray(table.mean) * tables.UNIT).astype(np.int16)
    scale, weight, diffuse = (np.asarray(row).astype(np.float16) for row in (table.scale, table.weight, table.diffuse))
    rounded = LobeBrdf(
        jnp.asarray(mean / tables.UNIT, jnp.float32),
        jnp.asarray(scale, jnp.float32),
        jnp.asarray(weight, jnp.float32),
        jnp.asarray(diffuse, jnp.float32),
        table.knot,
        table.error,
    )
    error = errors(rounded, material.family, between(material.knots)).astype(np.float32)
    return {"mean": mean, "scale": scale, "weight": weight, "diffuse": diffuse, "error": error}


def _least(brdf: Channels, count: int) -> np.ndarray:
    """Bounds of the concentrations of lobes in EM."""
    wo, (sample, mass, _, _) = brdf_samples(brdf, resolution=32)
    return np.asarray(em.start(wo, sample, jnp.sum(mass, -1), lobes=count)[1]).T


def between(knot: np.ndarray) -> np.ndarray:
    """Knots and the points halfway between them."""
    return np.interp(np.arange(2 * len(knot) - 1) / 2, np.arange(len(knot)), knot)


def errors(
    table: LobeBrdf, family: RoughnessFamily | ShininessFamily | SlopeFamily | SheenFamily, places: np.ndarray
) -> np.ndarray:
    """Error of a table at each of some roughnesses, under natural light, of the sum of all channels."""
    knots = (jnp.asarray(place, table.scale.dtype) for place in places)
    return np.array([measured_error(family(knot), table.at(knot)) for knot in knots])


def harmonics(material: StandardMaterial) -> dict[str, np.ndarray]:
    """Arrays of the table of harmonics, up to degree 4."""
    table = harmonic.tabulate(material.family, degree=4, error=0.02, resolution=ANGLES, knot=(material.knot,))
    return {
        "harmonics": np.asarray(table.table).astype(np.float16),
        "harmonics.knot": np.asarray(material.knot, np.float32),
        "harmonics.error": np.asarray(table.error, np.float32),
    }


def columns(material: StandardMaterial, table: LobeBrdf) -> dict[str, np.ndarray]:
    """What does not follow the table: curvatures, numbers of samples, and albedos of the traced lobes, at the knots.

    A sheen has no numbers of samples: it is dark around the mirror direction, where these are measured, and wide
    elsewhere.
    """
    arrays = {
        "zonal": np.stack([_zonal(material.family(jnp.asarray(knot))) for knot in material.knots]).astype(np.float16),
        "albedo": np.moveaxis(np.asarray(traced.albedos(table)), 1, 2).astype(np.float32),
    }
    if isinstance(material.family, SheenFamily):
        return arrays
    finer = np.interp(np.arange(FINER * (KNOTS - 1) + 1) / FINER, np.arange(KNOTS), material.knots)
    # A cubemap of fewer texels needs as many samples for the smoothest lobes as 64 x 64 texels for smoother ones.
    coarse = np.arange(SMALLEST, tables.TEXELS, FINER)
    place = np.append(finer[0] + np.log(coarse / tables.TEXELS) / material.power, finer)
    size = np.append(coarse, np.full(len(finer), tables.TEXELS))
    samples = [
        bright_texels.samples_for(material.family(jnp.asarray(max(where, finer[0]))), size=int(edge))
        for where, edge in zip(place, size, strict=True)
    ]
    return arrays | {"samples": np.array(samples, np.uint8), "samples.knot": place.astype(np.float32)}


def tensor(material: StandardMaterial, table: LobeBrdf) -> dict[str, np.ndarray]:
    """Arrays of the tensor for what the lobes of a table leave, and what its diffuse part is to be changed by."""
    brdf = dynamic.tabulate(material.family, lobes=table, ranks=tables.RANKS, knot=(material.knots,))
    return {
        "tensor.core": np.asarray(brdf.core, np.float32),
        "tensor.factor": np.asarray(brdf.factor, np.float32),
        "tensor.view": np.asarray(brdf.view_map).astype(np.float16),
        "tensor.light": np.asarray(brdf.light_map).astype(np.float16),
        "tensor.diffuse": (np.asarray(brdf.lobe.diffuse) - np.asarray(table.diffuse)).astype(np.float16),
        "tensor.error": np.asarray(brdf.error, np.float32),
    }


def _zonal(brdf: Channels) -> Float[np.ndarray, "l k"]:
    """Zonal harmonics of BRDF x cosine about the mirror direction; see `jaxprt.relit.curvature.of_part`."""
    mirror = _VIEW * [-1, -1, 1]
    wi, area = hemisphere.arcs(jnp.asarray(mirror), rings=_RINGS, sectors=_SECTORS)
    value = np.asarray(brdf(wi, jnp.broadcast_to(jnp.asarray(_VIEW), wi.shape)), np.float64)
    wi, area = np.asarray(wi, np.float64), np.asarray(area, np.float64)
    mass = value * (area * np.maximum(wi[:, 2], 0))[:, None]
    return np.polynomial.legendre.legvander(np.clip(wi @ mirror, -1, 1), BANDS).T @ mass


def paths(material: StandardMaterial) -> dict[str, np.ndarray]:
    """Functions of light paths for all roughnesses, and their weights; see `jaxprt.relit.paths.factor`."""
    scale = np.asarray(material.scale, np.float64)
    matte = np.isin(np.arange(len(scale)), _DIFFUSE)
    place = np.maximum(material.knots, np.log(_WIDTH) / material.power)
    first = np.flatnonzero(np.append(np.diff(place) > 0, True))
    models = [np.array(material.family(jnp.asarray(knot)).model, object)[~matte] for knot in place[first]]
    brdfs = [Channels(tuple(model), jnp.ones(len(model))) for model in models]
    options = {"functions": _FUNCTIONS, "terms": _TERMS, "resolution": _RESOLUTION}
    brdf, weight = bounces.functions.shared(brdfs, **options)
    factor = np.zeros((KNOTS, len(scale), brdf.view_map.shape[-1]))
    factor[:, ~matte] = np.asarray(weight)[np.searchsorted(first, np.arange(KNOTS))]
    factor[:, matte, -1] = 1
    albedo = factor @ np.asarray(bounces.functions.albedo(brdf), np.float64)
    exact = np.stack([_albedo(material.family(jnp.asarray(knot))) for knot in material.knots])
    factor *= np.where(albedo > _DARK, exact / np.maximum(albedo, _DARK), 1)[..., None]
    return {
        "path.light": np.asarray(brdf.light_map).astype(np.float16),
        "path.view": np.asarray(brdf.view_map).astype(np.float16),
        "path.factor": factor.astype(np.float32),
        "path.error": np.asarray(brdf.error, np.float32),
    }


def _albedo(brdf: Channels) -> np.ndarray:
    """Mean albedo of each channel, over views from above."""
    cosine = np.sqrt((np.arange(16) + 0.5) / 16)  # Uniform in projected solid angle.
    wo = np.stack([np.sqrt(1 - cosine**2), 0 * cosine, cosine], -1).astype(np.float32)
    sent = harmonic.table.project(brdf, jnp.asarray(wo), degree=0, rings=48, sectors=320)
    return np.sqrt(4 * np.pi) * np.mean(np.asarray(sent[0], np.float64), -1)


def main(options: Sequence[str]) -> None:
    """Writes the files."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    standard = tables.METALLIC_ROUGHNESS, tables.BLINN_PHONG, tables.COOK_TORRANCE, tables.SHEEN
    names = [table.name for table in standard]
    kinds = "lobes", "harmonics", "columns", "paths", "tensor"
    parser.add_argument("material", nargs="*", help=", ".join(names))
    parser.add_argument("--lobes", type=int, nargs="*", help="numbers of lobes; those of the file if not given")
    parser.add_argument("--only", nargs="*", default=kinds, choices=kinds)
    arguments = parser.parse_args(options)
    for name in arguments.material or names:
        material = material_of(name)
        _add(name, {"channel": material.scale, "knot": material.knots.astype(np.float32)})
        counts = tables.StandardTable(name).counts if arguments.lobes is None else arguments.lobes
        for count in counts if "lobes" in arguments.only else ():
            _add(name, {f"lobes{count}.{key}": value for key, value in _report(lobes, material, count).items()})
        if "harmonics" in arguments.only:
            _add(name, _report(harmonics, material))
        if "columns" in arguments.only:
            _add(name, _report(columns, material, tables.StandardTable(name).lobes()))
        if "paths" in arguments.only and name in _SENDING:
            _add(name, _report(paths, material))
        if "tensor" in arguments.only and name != tables.SHEEN.name:
            _add(name, _report(tensor, material, tables.StandardTable(name).lobes(tables.TENSOR_LOBES)))


def _report(function, *argument):
    """The arrays that a function returns; prints their bytes and the processor seconds."""
    start = time.process_time()
    result = function(*argument)
    error = [f"{key} {np.max(value):.4f}" for key, value in result.items() if key.endswith("error")]
    size = sum(np.asarray(value).nbytes for value in result.values())
    what = f"{function.__name__} {argument[1] if isinstance(argument[-1], int) else ''}"
    print(f"{what}: {time.process_time() - start:.0f} s, {size:,} bytes", *error, flush=True)
    return result


def _add(name: str, arrays: dict[str, np.ndarray]) -> None:
    """Writes arrays to a file, besides those that it holds."""
    file = tables.path(name)
    old = dict(np.load(file, allow_pickle=False)) if file.exists() else {}
    np.savez_compressed(file, allow_pickle=False, **{**old, **arrays})
    tables.forget()


if __name__ == "__main__":
    main(sys.argv[1:])
