"""Families of BRDFs with coordinates: coordinates are mapped to interpolation weights, which sum to one.

A family holds purely specular gray BRDFs of unit weight. Diffuse and specular weights and colors are applied elsewhere.
The interpolation weights apply to everything that is linear in the BRDF, such as its coefficients and the reflected
radiance.

Reference: Sun et al. 2007, "Interactive relighting with dynamic BRDFs", section 4.2.
"""

import csv
import math
import pathlib
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxprt.brdf import models
from jaxprt.brdf.places import Columns, Line, Plane, columns, identity, in_columns, triangulate
from jaxprt.files import inputs

_identity = identity  # Files of earlier releases use this name.
_LEAST = 1e-30  # smallest exponent whose logarithm is taken
_SMOOTHEST = 1e-3  # smallest roughness that the models distinguish
_SCALE = np.array([1.0, 1.15, 1.66])  # MERL's color scale, which the fits of Ngan et al. lack
_COLUMNS = ("kd_r", "kd_g", "kd_b", "ks_r", "ks_g", "ks_b", "m", "F0")
_LARGEST = 1e9  # largest number of a fit; larger ones would overflow float32 in BRDFs
_NO_MATERIAL = np.array([0.0, 1.0])[:, None, None]  # diffuse and specular weights


def _log_roughness(coordinate: Array) -> Array:
    """F0 and the logarithm of the roughness."""
    return jnp.stack([coordinate[..., 0], jnp.log(jnp.maximum(coordinate[..., 1], _SMOOTHEST))], -1)


def _log(coordinate: Array) -> Array:
    """The logarithm of a positive coordinate."""
    return jnp.log(jnp.maximum(coordinate, _LEAST))


class Family(eqx.Module):
    """A set of BRDFs and the map from coordinates to interpolation weights.

    Attributes:
        brdf: Purely specular gray BRDFs of unit weight. Material m is diffuse_m / pi + specular_m brdf_m.
        navigation: Map from coordinates to a weight for each BRDF.
        name: Name of each BRDF.
        diffuse: Diffuse reflectance of each material in linear RGB; zero for sets without materials.
        specular: Weight of each material's lobe in linear RGB; one for sets without materials.
    """

    brdf: tuple[Callable, ...]
    navigation: Line | Plane | Columns
    name: tuple[str, ...] = eqx.field(static=True)
    diffuse: Float[Array, "m 3"]
    specular: Float[Array, "m 3"]


def blinn_phong(*, exponents: Sequence[int | float] = range(1, 201)) -> Family:
    """Family of Blinn-Phong lobes with their exponent as coordinate; by default the integers 1 to 200, as published.

    The lobes are normalized like `models.BlinnPhong`: each reflects all light at normal incidence. Weights are linear
    in the logarithm of the exponent, or in the exponent itself if one of the exponents is 0.

    Args:
        exponents: Exponent of each BRDF.

    Returns:
        The family. Its coordinate is the exponent.
    """
    knot = np.asarray(exponents, float)
    if knot.ndim != 1 or len(knot) < 2 or not (np.isfinite(knot).all() and knot[0] >= 0 and np.all(np.diff(knot) > 0)):
        raise ValueError(f"exponents must be at least two finite increasing numbers from 0 up, got {knot}")
    brdf = tuple(models.BlinnPhong(diffuse=0.0, specular=1.0, exponent=n) for n in knot)
    line = Line(jnp.asarray(knot, jnp.result_type(float)), _log if knot[0] > 0 else identity)
    return _family(brdf, line, tuple(f"exponent {n:g}" for n in knot), _NO_MATERIAL)


def cook_torrance(*, path: str | pathlib.Path | None = None, point: Float[ArrayLike, "m 2"] | None = None) -> Family:
    """Family of Cook-Torrance lobes with two coordinates: Fresnel reflectance F0 and roughness m.

    Points may lie in columns, each with one value of F0 and a range of m that is the same for all columns. Then
    `Columns` interpolates linearly in log m along each column, and between two columns in F0, in which the model is
    linear. Scattered points, such as those of a file, are interpolated in triangles (`Plane`) in the plane of F0 and
    log m. The paper uses m instead of log m; log m predicts measured materials from the others with a smaller error.
    A roughness below 0.001 is replaced by 0.001.

    Without a file or points, the family has 49 BRDFs in three columns. For F0 of 0 and 1 they have 16 values of m in
    geometric progression, from 0.02, where lobes are few texels of 6 x 64 x 64 wide, to 1. For F0 of 0.3 m lies between
    those values.

    Args:
        path: A CSV file of fits by Ngan et al. Its first row names the columns material, kd_r, kd_g, kd_b, ks_r, ks_g,
            ks_b, m and F0. The fitted data lacked MERL's color scale (1, 1.15, 1.66), so kd and ks are multiplied by it
            here. The coordinates of a material are its F0 and m.
        point: F0 and m of each BRDF, instead of a file.

    Returns:
        The family. Its coordinates are (F0, m).

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: Both a file and points are given; points are out of range; the file is empty or not text, lacks
            columns, has cells that are not numbers or out of range, or names a material twice; or there are fewer than
            three points, two coincide, or all lie on one line.

    Reference: Ngan, Durand, Matusik 2005, "Experimental analysis of BRDF models", for the fits.
    """
    if path is not None and point is not None:
        raise ValueError("give either path or point, got both")
    if path is None:
        place = _grid() if point is None else np.asarray(point, float).reshape(-1, 2)
        if not (np.isfinite(place).all() and np.all((place >= 0) & (place[:, :1] <= 1))):
            raise ValueError(f"points must have F0 from 0 to 1 and m of at least 0, got {place.tolist()}")
        name, weight = tuple(f"F0 {f0:g}, m {m:.3g}" for f0, m in place), _NO_MATERIAL
    else:
        name, weight, place = _read(pathlib.Path(path))
    try:
        grid = path is None and in_columns(place, chart=_log_roughness)
        plane = (columns if grid else triangulate)(place, chart=_log_roughness, name=name)
    except ValueError as error:
        raise error if path is None else ValueError(f"{path}: {error}") from error
    brdf = tuple(models.CookTorrance(diffuse=0.0, specular=1.0, roughness=m, f0=f0) for f0, m in place)
    return _family(brdf, plane, name, weight)


def _family(brdf: tuple, navigation: Line | Plane | Columns, name: tuple[str, ...], weight: np.ndarray) -> Family:
    diffuse, specular = np.broadcast_to(weight, (2, len(brdf), 3)).astype(jnp.result_type(float))
    return Family(brdf, navigation, name, jax.device_put(diffuse), jax.device_put(specular))


def _grid() -> np.ndarray:
    """F0 and m of the default family."""
    knot = np.geomspace(0.02, 1, 16)
    between = np.concatenate([knot[:1], np.sqrt(knot[1:] * knot[:-1]), knot[-1:]])
    return np.array([(f0, m) for f0, column in ((0, knot), (0.3, between), (1, knot)) for m in column])


def _read(path: pathlib.Path) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Names, kd and ks [2, m, 3], and F0 and m [m, 2] of the materials in a CSV file."""
    inputs.check(path, "a table of materials")
    table: dict[str, list[float]] = {}
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            columns = [column.strip() for column in reader.fieldnames or ()]
            missing = [column for column in ("material", *_COLUMNS) if column not in columns]
            if missing:
                came = f"a file without {', '.join(missing)}" if columns else "an empty file"
                raise ValueError(f"the first row must name material, {', '.join(_COLUMNS)}, got {came}")
            reader.fieldnames = columns
            for row in reader:
                name = (row["material"] or "").strip()
                if name in table:
                    raise ValueError(f"line {reader.line_num}: every material must have one row, got {name!r} again")
                table[name] = [_number(row, column, reader.line_num) for column in _COLUMNS]
    except (ValueError, csv.Error) as error:
        raise ValueError(f"{path}: {error}") from error
    if len(table) < 3:
        raise ValueError(f"{path}: must hold at least three materials, got {len(table)}")
    value = np.array(list(table.values()))
    return tuple(table), value[:, :6].reshape(-1, 2, 3).swapaxes(0, 1) * _SCALE, value[:, [7, 6]]


def _number(row: dict, column: str, line: int) -> float:
    """One cell of a row as a number, checked."""
    if None in row:
        raise ValueError(f"line {line}: must have as many cells as the first row, got {len(row[None])} more")
    try:
        value = float(row[column] or "")
    except ValueError:
        came = repr(row[column]) if row[column] else "nothing"
        raise ValueError(f"line {line}: {column} must be a number, got {came}") from None
    least, most = {"m": (math.ulp(0), _LARGEST), "F0": (0, 1)}.get(column, (0, _LARGEST))
    if not least <= value <= most:
        required = {"m": "positive", "F0": "between 0 and 1"}.get(column, "not negative")
        required += f", at most {most:g}" if _LARGEST < value < math.inf else ""
        raise ValueError(f"line {line}: {column} must be finite and {required}, got {value}")
    return value
