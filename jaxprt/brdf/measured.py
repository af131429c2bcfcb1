"""Measured BRDFs: MERL files, and a published table of fits to them.

Loaders run on the host and check the data. They return a BRDF like any other, differentiable in its directions and its
table. ``HalfDifferenceTable`` and ``MicrofacetTable`` are tabulated over the half-difference angles of Rusinkiewicz
1998: theta_h between normal and half vector, theta_d between half vector and either direction, and the rotation phi_d
of the directions about the half vector. Values and gradients are finite where these angles are undefined.
"""

import collections
import difflib
import pathlib

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float, Float64

from jaxprt.files import inputs

_MERL_SHAPE = (90, 90, 180)
_MERL_SCALE = np.array([1.0, 1.15, 1.66]) / 1500
_BINS = 90  # bins of each factor of the microfacet table
_ROWS, _COLUMNS = 256, 512
_TINY = 1e-12
# Largest value in 1/sr that a file may hold. A lobe of this height that reflects all light is a millionth of a radian
# wide. Much larger values would overflow float32 in sums over the light.
LARGEST = 1e12


def _norm(vector: Array) -> Array:
    """Length of vectors. Its gradient at zero is defined as zero."""
    square = jnp.sum(vector**2, -1)
    return jnp.where(square < _TINY, 0, jnp.sqrt(jnp.where(square < _TINY, 1, square)))


def _lit(wi: Array, wo: Array) -> tuple[Array, Array, Array]:
    """Whether both directions are above the horizon, and the directions, with valid ones in place of those below."""
    lit = (wi[..., 2:] > 0) & (wo[..., 2:] > 0)
    normal = jnp.array([0, 0, 1], jnp.result_type(wi, wo))
    return lit, jnp.where(lit, wi, normal), jnp.where(lit, wo, normal)


def _polar_angles(wi: Array, wo: Array) -> tuple[Array, Array]:
    """theta_h and theta_d. |wi + wo| = 2 cos(theta_d) and |wi - wo| = 2 sin(theta_d) keep both accurate near zero."""
    total = wi + wo
    return jnp.arctan2(_norm(total[..., :2]), total[..., 2]), jnp.arctan2(_norm(wi - wo), _norm(total))


def _turn(wi: Array, wo: Array) -> Array:
    """phi_d. Exchanging the directions adds pi. It is zero, with zero gradient, where it is undefined."""
    # In the frame that is rotated with the half vector, wi - wo is along, up to a positive factor,
    # (-(wi - wo).n, n.(wi x wo) (-2) / |wi + wo|).
    x = wo[..., 2] - wi[..., 2]
    y = 2 * (wi[..., 1] * wo[..., 0] - wi[..., 0] * wo[..., 1]) / jnp.maximum(_norm(wi + wo), 1e-6)
    pole = x**2 + y**2 < _TINY
    return jnp.arctan2(jnp.where(pole, 0, y), jnp.where(pole, 1, x))


def _root_place(theta: Array, count: int) -> Array:
    """Fractional index of theta_h among the centers of ``count`` cells that are uniform in its square root."""
    first = np.pi / 2 * (0.5 / count) ** 2
    return count * jnp.sqrt(jnp.maximum(theta, first) * (2 / jnp.pi)) - 0.5


def _neighbors(place: Array, count: int) -> tuple[Array, Array, Array]:
    """The two cells whose centers enclose a fractional index, and the weight of the second; clamped at the ends."""
    place = jnp.clip(place, 0, count - 1)
    low = jnp.clip(jnp.floor(place), 0, max(count - 2, 0))
    index = low.astype(jnp.int32)
    return index, jnp.minimum(index + 1, count - 1), place - low


class HalfDifferenceTable(eqx.Module):
    """An isotropic BRDF tabulated over half-difference angles. Cube roots of its values are interpolated linearly.

    Cells are uniform in sqrt(theta_h), in theta_d (both up to a quarter turn) and in phi_d (up to half a turn, after
    which it repeats by reciprocity). Beyond the outermost centers the value is constant. The BRDF is reciprocal, and
    not negative if no root is negative. Cube roots are interpolated because highlights fall by orders of magnitude from
    cell to cell, and linear interpolation of the values themselves would widen them.

    Gradients are those of the interpolant. Where angles are undefined (theta_h or theta_d zero) they are zero across
    that angle; ``tabulate`` makes the adjacent cells equal for all phi_d.

    Attributes:
        root: Cube root of the BRDF, in 1/sr, at the cell centers ``cell_angles``.
        filled: Fraction of the cells above the horizon that were not measured and have the value of the nearest
            measured cell.

    Reference: Rusinkiewicz 1998 for the angles; Matusik et al. 2003 for the spacing.
    """

    root: Float[Array, "h d p c"] = eqx.field(converter=jnp.asarray)
    filled: Float[Array, ""] = eqx.field(converter=lambda value: jnp.asarray(value, jnp.result_type(float)), default=0)

    def __call__(self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> Float[Array, "*b c"]:
        """Value of the BRDF in 1/sr."""
        lit, wi, wo = _lit(wi, wo)
        theta_h, theta_d = _polar_angles(wi, wo)
        rows, columns, turns, channels = self.root.shape
        h = _neighbors(_root_place(theta_h, rows), rows)
        d = _neighbors(theta_d * (2 * columns / jnp.pi) - 0.5, columns)
        place = _turn(wi, wo) * (turns / jnp.pi) - 0.5
        low = jnp.floor(place)
        p = (low.astype(jnp.int32) % turns, (low.astype(jnp.int32) + 1) % turns, place - low)
        table = self.root.reshape(-1, channels)

        def between(h_index, d_index):
            start = (h_index * columns + d_index) * turns
            return _mix(table[start + p[0]], table[start + p[1]], p[2])

        near = _mix(between(h[0], d[0]), between(h[0], d[1]), d[2])
        far = _mix(between(h[1], d[0]), between(h[1], d[1]), d[2])
        return jnp.where(lit, _mix(near, far, h[2]) ** 3, 0)


def _mix(first: Array, second: Array, weight: Array) -> Array:
    return first * (1 - weight[..., None]) + second * weight[..., None]


class MicrofacetTable(eqx.Module):
    """A microfacet BRDF with tabulated factors, interpolated linearly between the centers of bins.

    For each color, pi f = diffuse + specular D(theta_h) F(theta_d) G(theta_i) G(theta_o) / (cos_i cos_o).

    Bins of D are uniform in sqrt(theta_h), those of F and G in their angle, all up to a quarter turn. Published
    renderings look up D and F without interpolation, which shows as rings. Beyond the outermost centers the factors and
    G / cos are constant, so the value is bounded at grazing angles.

    Attributes:
        diffuse: Reflectance of the diffuse part.
        specular: Scale of the specular part.
        distribution: D, normalized to a maximum of 1.
        fresnel: F, normalized to a maximum of 1.
        masking: G, normalized to a maximum of 1.

    Reference: Bagher, Snyder, Nowrouzezahrai 2016.
    """

    diffuse: Float[Array, " c"] = eqx.field(converter=jnp.asarray)
    specular: Float[Array, " c"] = eqx.field(converter=jnp.asarray)
    distribution: Float[Array, "h c"] = eqx.field(converter=jnp.asarray)
    fresnel: Float[Array, "d c"] = eqx.field(converter=jnp.asarray)
    masking: Float[Array, "t c"] = eqx.field(converter=jnp.asarray)

    def __call__(self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> Float[Array, "*b c"]:
        """Value of the BRDF in 1/sr."""
        lit, wi, wo = _lit(wi, wo)
        theta_h, theta_d = _polar_angles(wi, wo)
        lobe = _between(self.distribution, _root_place(theta_h, self.distribution.shape[0]))
        lobe = lobe * _between(self.fresnel, theta_d * (2 * self.fresnel.shape[0] / jnp.pi) - 0.5)
        lobe = lobe * self._masking_per_cosine(wi) * self._masking_per_cosine(wo)
        return jnp.where(lit, (self.diffuse + self.specular * lobe) / jnp.pi, 0)

    def _masking_per_cosine(self, direction: Array) -> Array:
        count = self.masking.shape[0]
        theta = jnp.arctan2(_norm(direction[..., :2]), direction[..., 2])
        last = np.pi / 2 * (1 - 0.5 / count)
        cosine = jnp.maximum(direction[..., 2:], np.cos(last))
        return _between(self.masking, theta * (2 * count / jnp.pi) - 0.5) / cosine


def _between(table: Array, place: Array) -> Array:
    low, high, weight = _neighbors(place, table.shape[0])
    return _mix(table[low], table[high], weight)


def cell_angles(
    resolution: tuple[int, int, int],
) -> tuple[Float64[np.ndarray, "h 1 1"], Float64[np.ndarray, "1 d 1"], Float64[np.ndarray, "1 1 p"]]:
    """theta_h, theta_d and phi_d of the cell centers of a ``HalfDifferenceTable``, each along its own axis."""
    h, d, p = (
        ((np.arange(n) + 0.5) / n).reshape([-1 if i == j else 1 for j in range(3)]) for i, n in enumerate(resolution)
    )
    return np.pi / 2 * h**2, np.pi / 2 * d, np.pi * p


def lower_cosine(resolution: tuple[int, int, int]) -> Float64[np.ndarray, "h d p"]:
    """The smaller of cos_i and cos_o at the cell centers; negative where a direction is below the horizon."""
    theta_h, theta_d, phi_d = cell_angles(resolution)
    return np.cos(theta_h) * np.cos(theta_d) - np.abs(np.sin(theta_h) * np.sin(theta_d) * np.cos(phi_d))


def tabulate(
    value: Float64[np.ndarray, "h d p c"], valid: Bool[np.ndarray, "h d p"] | np.ndarray
) -> HalfDifferenceTable:
    """Makes a BRDF from its values at cell centers, some of which may be missing.

    Each missing cell gets the value of the nearest valid cell, by distance in cells. Cells below the horizon are filled
    too, because interpolation just above the horizon uses them. The first cells in theta_h and in theta_d get their
    mean over phi_d, which is undefined there.

    Args:
        value: The BRDF in 1/sr at ``cell_angles``; not negative where valid.
        valid: Mask of the cells that have a value.

    Returns:
        The BRDF. Its ``filled`` is the fraction of missing cells among those above the horizon.

    Raises:
        ValueError: No cell is valid.
    """
    if not valid.any():
        raise ValueError(f"at least one cell must be valid, got none of {valid.size}")
    half = value.shape[2] // 2
    around = np.pad(valid, ((0, 0), (0, 0), (half, half)), mode="wrap")  # The table repeats after half a turn.
    nearest = np.asarray(scipy.ndimage.distance_transform_edt(~around, return_distances=False, return_indices=True))
    row, column, turn = nearest[..., half : half + value.shape[2]]
    value = value[row, column, (turn - half) % value.shape[2]]
    value[0] = value[0].mean(1, keepdims=True)
    value[:, 0] = value[:, 0].mean(1, keepdims=True)
    above = lower_cosine(value.shape[:3]) > 0
    return HalfDifferenceTable(np.cbrt(value).astype(jnp.result_type(float)), 1 - np.sum(valid & above) / np.sum(above))


def load_merl(path: str | pathlib.Path) -> HalfDifferenceTable:
    """Loads a BRDF in the binary format of the MERL database.

    The file has three int32, (90, 90, 180), followed by 90 x 90 x 180 float64 each for red, green and blue, which must
    be multiplied by (1, 1.15, 1.66) / 1500. Cells with a negative value in any color are invalid, mostly because a
    direction would be below the horizon. ``tabulate`` fills them.

    Args:
        path: The file.

    Returns:
        The BRDF in linear RGB. Its ``filled`` is the fraction of invalid cells above the horizon.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file has other dimensions or another length, holds NaN, infinity or values above ``LARGEST``,
            or no valid cell.

    Reference: Matusik, Pfister, Brand, McMillan 2003.
    """
    path = pathlib.Path(path)
    inputs.check(path, "a BRDF in MERL's format")
    with path.open("rb") as file:
        start = file.read(12)
    if len(start) < 12:
        raise ValueError(f"{path}: must begin with three int32 {_MERL_SHAPE}, got {len(start)} bytes")
    shape = tuple(np.frombuffer(start, "<i4").tolist())
    if shape != _MERL_SHAPE:
        raise ValueError(f"{path}: the dimensions must be {_MERL_SHAPE}, got {shape}")
    _check_size(path, 12 + 3 * 8 * int(np.prod(_MERL_SHAPE)))
    plane = np.fromfile(path, "<f8", offset=12).reshape(3, *_MERL_SHAPE)
    place = "value at color, theta_h, theta_d, phi_d"
    require(path, plane, np.isfinite(plane), "finite", place)
    require(path, plane, plane <= 1500 * LARGEST, f"at most {1500 * LARGEST:g}", place)
    valid = np.all(plane >= 0, 0)
    if not valid.any():
        raise ValueError(f"{path}: must hold at least one cell without a negative value, got none of {valid.size}")
    return tabulate(np.moveaxis(plane, 0, -1) * _MERL_SCALE, valid)


def load_npf(path: str | pathlib.Path, material: str, *, names: str | pathlib.Path | None = None) -> MicrofacetTable:
    """Loads one material from the table of non-parametric microfacet factors of the 100 MERL materials.

    The file has 256 rows of 512 columns of three little-endian float32. A row holds the diffuse and specular
    reflectance of one material, then D, G and F with 90 bins each, then zeros. The first bins of G and F were not
    fitted and are zero in the file; they get the value of the second bin.

    Args:
        path: The table.
        material: Name of the material, such as "gold-metallic-paint".
        names: Text file with the name of each row of the table; if None, ``merl_npf_materials.txt`` in the same folder.

    Returns:
        The BRDF in linear RGB.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The material is unknown, two materials have one name, the table has another size, or the row holds
            values that are negative, not finite, or make a BRDF above ``LARGEST``.

    Reference: Bagher, Snyder, Nowrouzezahrai 2016.
    """
    path = pathlib.Path(path)
    names = pathlib.Path(names or path.with_name("merl_npf_materials.txt"))
    known = inputs.content(names, "the names of materials").decode("utf-8", "replace").split()
    if len(known) > _ROWS:
        raise ValueError(f"{names}: must hold at most {_ROWS} names, got {len(known)}")
    check_unique(names, known)
    index = known.index(one_of(material, known, names))
    inputs.check(path, "a table of microfacet factors")
    _check_size(path, _ROWS * _COLUMNS * 3 * 4)
    row = np.fromfile(path, "<f4").reshape(_ROWS, _COLUMNS, 3)[index].astype(float)
    good = np.isfinite(row) & (row >= 0)
    require(path, row, good, "finite and non-negative", f"value of {material} at column, color")
    distribution, masking, fresnel = row[2 : 2 + 3 * _BINS].reshape(3, _BINS, 3)
    for factor in (masking, fresnel):
        factor[0] = np.where(factor[0] > 0, factor[0], factor[1])
    lowest = np.cos(np.pi / 2 * (1 - 0.5 / _BINS))
    peak = row[0] + row[1] * distribution.max(0) * fresnel.max(0) * (masking.max(0) / lowest) ** 2
    require(
        path, peak, peak <= LARGEST, f"at most {LARGEST:g} per sr", f"product of the factors of {material} at color"
    )
    factors = (row[0], row[1], distribution, fresnel, masking)
    return MicrofacetTable(*(jnp.asarray(factor, jnp.result_type(float)) for factor in factors))


def _check_size(path: pathlib.Path, required: int) -> None:
    size = path.stat().st_size
    if size != required:
        raise ValueError(f"{path}: must have {required} bytes, got {size}")


def check_unique(path: str | pathlib.Path, names: list[str]) -> None:
    """Raises ValueError if a file has two materials of one name."""
    counts = collections.Counter(names)
    twice = [name for name, count in counts.items() if count > 1]
    if twice:
        raise ValueError(
            f"{path}: materials must have different names, got {len(twice)} names twice, first {twice[0]!r}"
        )


def one_of(material: str, known: list[str], path: str | pathlib.Path) -> str:
    """Returns the name of the material if the file has it."""
    if material not in known:
        near = difflib.get_close_matches(material, known, 5, 0.4) or known[:5]
        raise ValueError(
            f"{path}: material must be one of {len(known)} names such as {', '.join(near)}, got {material!r}"
        )
    return material


def require(path: str | pathlib.Path, value: np.ndarray, good: np.ndarray, required: str, what: str) -> None:
    """Raises ValueError, with the count and the first offender, unless all values are good.

    Args:
        path: The file that the values come from.
        value: Values of any shape.
        good: Whether each value is good, of the same shape.
        required: What the values must be, for the message.
        what: What the values are, for the message: a word and the names of the axes.
    """
    if not good.all():
        place = np.unravel_index(np.argmin(good), good.shape)
        raise ValueError(
            f"{path}: every {what.split()[0]} must be {required}, got {np.sum(~good)} that are not, "
            f"the first {what} {tuple(map(int, place))}: {value[place]}"
        )
