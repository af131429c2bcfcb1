"""Distant light on a cubemap: environment maps, their loading, resampling, rotation and lookup, and suns."""

import functools
import pathlib
import warnings
from collections.abc import Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Float64

from jaxprt import require
from jaxprt.compile import jit, known, put
from jaxprt.files import images
from jaxprt.scene import panorama
from jaxprt.scene.panorama import Panorama
from jaxprt.sphere import cubemap

# Arrangement of the six faces in each layout: its height and width in faces; the row and column of each face (+x, -x,
# +y, -y, +z, -z); and the steps in row and column that bring a face's pixels into OpenGL's order.
_PLAIN = ((1, 1),) * 6
_CROSS_STEP = ((1, -1), (1, -1), (-1, 1), (-1, 1), (-1, 1), (1, -1))
_OPENEXR_STEP = ((1, -1), (1, -1), (-1, 1), (-1, 1), (1, -1), (1, -1))
_CUBES = {
    "vertical-cross": ((4, 3), ((1, 2), (1, 0), (0, 1), (2, 1), (3, 1), (1, 1)), _CROSS_STEP),
    "vertical-strip": ((6, 1), tuple((i, 0) for i in range(6)), _PLAIN),
    "horizontal-strip": ((1, 6), tuple((0, i) for i in range(6)), _PLAIN),
    "openexr-cube": ((6, 1), tuple((i, 0) for i in range(6)), _OPENEXR_STEP),
}
_AROUND = 4096  # smallest number of parts around the horizon into which a latlong picture is divided
_CHUNK = 2**20  # pixels that are checked per step
LAYOUTS = ("latlong", "openexr-latlong", *_CUBES)
_STATED = {"latlong": "openexr-latlong", "cube": "openexr-cube"}  # values of the EXR attribute envmap
_PARTS = 8  # A pixel is divided into at most this many parts per direction; larger pixels are subdivided first.
_PARTS_AT_ONCE = 2**20  # parts of pixels per step


def _resampling_bytes(shape: tuple[int, ...], size: int, *, faces_down: int | None, around: int) -> int:
    """Upper bound in bytes of what resampling takes besides the picture, and of the light in float32 of the result."""
    # `faces_down`: faces of a cube layout from top to bottom. `around`: smallest number of parts around the horizon.
    height, width, channels = shape
    texels = 6 * size**2
    # The mean radiance and two temporary arrays of one channel in float64, and the light in float32.
    needed = texels * (8 * (channels + 3) + 8 * channels)
    if faces_down:  # the faces, and where their pixels are cut by texels
        return needed + 8 * height * width * channels + 5 * 8 * (size + height // faces_down) ** 2
    # Some twelve arrays of the parts in one row of pixels, or in a step.
    return needed + 12 * 8 * max(_PARTS * max(2 * width, 12 * size * 7, around), _PARTS_AT_ONCE)


def _box_edges(count: int, *, on_edge: bool) -> np.ndarray:
    """Ascending edges of the boxes around equidistant samples on [-1, 1]; half boxes at the ends if `on_edge`."""
    if not on_edge or count == 1:
        return np.linspace(-1, 1, count + 1)
    return np.clip((2 * np.arange(count + 1) - 1) / (count - 1) - 1, -1, 1)


def _means_of_cube(face: np.ndarray, edge: np.ndarray, size: int) -> Float64[np.ndarray, "6 n n c"]:
    """Exact area means of a cube [6, m, m, c]: pixels, texels and their overlaps are all rectangles on a face."""
    texel_edge = np.linspace(-1, 1, size + 1)
    cut = np.union1d(edge, texel_edge)
    pixel = np.searchsorted(edge, (cut[1:] + cut[:-1]) / 2) - 1
    start = np.searchsorted(cut, texel_edge[:-1])
    weight = _solid_angle(cut)

    def total(value):
        return np.add.reduceat(np.add.reduceat(value, start, axis=0), start, axis=1)

    area = total(weight)
    result = np.empty((6, size, size, face.shape[-1]))
    for f in range(6):
        for c in range(face.shape[-1]):
            result[f, :, :, c] = total(face[f, :, :, c][np.ix_(pixel, pixel)] * weight) / area
    return result


def _means_of_latlong(
    image: np.ndarray, latitude: np.ndarray, longitude: np.ndarray, size: int, *, around: int
) -> Float64[np.ndarray, "6 n n c"]:
    """Area means of a latlong picture [h, w, c]: small parts of the pixels are distributed to the texels."""
    # A texel is at least 2 / (3 size) wide, in the corners of a face. About eight parts should fall across it.
    around = max(int(np.ceil(12 * size * 2 * np.pi)), around)
    parts = [max(2, int(np.ceil(around / count))) for count in (2 * image.shape[0], image.shape[1])]
    repeat = [-(-count // _PARTS) for count in parts]
    pixel_row, pixel_column = (
        np.arange(count).repeat(times) for count, times in zip(image.shape[:2], repeat, strict=True)
    )
    rows, columns = (-(-count // times) for count, times in zip(parts, repeat, strict=True))
    # `latitude` and `longitude` are the edges of the rows and columns, descending.
    latitude = _subdivide(_subdivide(latitude, repeat[0]), rows).reshape(-1)
    longitude = _subdivide(_subdivide(longitude, repeat[1]), columns).reshape(-1)

    # Axes: rows of pixels, rows of parts, columns of pixels, columns of parts. The samples of a pixel lie on a
    # sheared lattice: on a regular one, all samples along a texel's edge would fall on the same side of it.
    height, width = (
        -np.diff(np.sin(latitude)).reshape(-1, rows, 1, 1),
        -np.diff(longitude).reshape(-1, columns),
    )
    across, down = (np.arange(columns) + 0.5) / columns, (np.arange(rows)[:, None, None] + 0.5) / rows
    latitude = latitude[:-1].reshape(-1, rows, 1, 1) + np.diff(latitude).reshape(-1, rows, 1, 1) * across
    longitude = longitude[:-1].reshape(-1, columns) - width * down

    flux, weight = np.zeros((image.shape[-1], 6 * size**2)), np.zeros(6 * size**2)
    step = max(1, _PARTS_AT_ONCE // (width.size * rows))
    for first in range(0, len(pixel_row), step):
        row = slice(first, first + step)
        index = _texel_index(latitude[row], longitude, size).ravel()
        area = height[row] * width
        weight += np.bincount(index, area.ravel(), minlength=weight.size)
        for c in range(len(flux)):
            radiance = image[pixel_row[row], :, c][:, pixel_column]
            flux[c] += np.bincount(index, (radiance[:, None, :, None] * area).ravel(), minlength=weight.size)
    before = flux.sum(axis=1)
    mean = np.divide(flux, weight, out=flux).reshape(-1, 6, size, size)

    # Parts approximate the texels' areas. The resulting change of the integral, about 0.1 %, is spread over the sphere.
    solid_angle = _solid_angle(np.linspace(-1, 1, size + 1))
    after = np.array([(color * solid_angle).sum() for color in mean])
    scale = np.divide(before, after, out=np.ones_like(before), where=after != 0)
    mean *= scale[:, None, None, None]
    return np.moveaxis(mean, 0, -1)


def _solid_angle(edge: np.ndarray) -> np.ndarray:
    """Solid angles of the rectangles of a grid on a face, given its lines, which are the same for rows and columns."""
    corner = np.arctan2(edge[:, None] * edge, np.sqrt(1 + edge[:, None] ** 2 + edge**2))
    return np.diff(np.diff(corner, axis=0), axis=1)


def _subdivide(edge: np.ndarray, parts: int) -> np.ndarray:
    """Divides every interval into equal parts."""
    fraction = np.arange(parts) / parts
    inner = edge[:-1, None] * (1 - fraction) + edge[1:, None] * fraction
    return np.append(inner.ravel(), edge[-1])


def _texel_index(latitude: np.ndarray, longitude: np.ndarray, size: int) -> np.ndarray:
    """Flat indices of the texels at given latitudes and longitudes, which are broadcast."""
    # On the four side faces, each spans a quarter turn and the column depends only on the longitude.
    turn = np.round(longitude / (np.pi / 2)).astype(int)
    offset = longitude - turn * (np.pi / 2)
    side = np.array([4, 0, 5, 1])[turn % 4]  # +z, +x, -z, -x
    height = np.tan(latitude)
    row = -height / np.cos(offset)
    cap = np.abs(row) > 1
    flat = 1 / height
    column = np.where(cap, np.sin(longitude) * np.abs(flat), np.tan(offset))
    row = np.where(cap, np.cos(longitude) * flat, row)
    face = np.where(cap, np.where(height > 0, 2, 3), side)
    i, j = (np.clip((size / 2 * (x + 1)).astype(int), 0, size - 1) for x in (row, column))
    return (face * size + i) * size + j


class Environment(eqx.Module):
    """Distant light: the mean linear radiance of each cubemap texel.

    The radiance must be finite, at most 1e32 in magnitude, and have six square faces. Lists, NumPy arrays and integers
    are converted to JAX arrays of floating point, and half precision to float32. Negative radiance is allowed, because
    relighting is linear: a difference of two lights, the light of one basis function and the gradient of a light are
    environments too. `load_environment` sets negative pixels of files to zero. Inside `jax.jit` values are not known
    and not checked: a NaN then reaches every vertex that the texel lights.

    A light that comes from a file also remembers the file's pixels, up to 8192 columns of them, as its `panorama`:
    `sky` shows them behind objects, `rotate` turns them, and `finer` makes larger cubemaps of them. They belong
    to this object on the host and are no part of the pytree, so lights of all files share programs. What `jax.jit`,
    `jax.vmap`, `jax.grad`, `jax.tree.map`, `copy`, `pickle`, `jaxprt.files.load` and `Environment(light.radiance)`
    return has the texels alone, and is shown by them.

    Attributes:
        radiance: Mean radiance over each texel in linear Rec. 709. Leading axes, if any, are a batch of lights.

    Raises:
        TypeError: The radiance does not consist of real numbers, or is a masked array.
        ValueError: The radiance has another shape, is not finite, or is above 1e32.
    """

    # Not a field: as a leaf of the pytree, files of unlike sizes would need programs of their own, and as static data
    # every file would. Not in __dict__ either, of which equinox makes pytrees.
    __slots__ = ("_panorama",)

    radiance: Float[Array, "*l 6 n n c"] = eqx.field(converter=require.floating)

    def __check_init__(self):
        """Refuses radiance that is not of real numbers, not on six square faces, or not finite."""
        require.real("the light's radiance", self.radiance)
        shape = jnp.shape(self.radiance)
        if len(shape) < 4 or shape[-4] != 6 or shape[-3] != shape[-2] or 0 in shape[-3:]:
            raise ValueError(f"the light's radiance must be [..., 6, n, n, c], got {list(shape)}")
        require.finite("the light's radiance", self.radiance)

    @property
    def panorama(self) -> Panorama | None:
        """The pixels of the light's file; None if it comes from no file, or has been transformed by JAX."""
        return getattr(self, "_panorama", None)

    def __getstate__(self) -> dict[str, object]:
        """What is copied and pickled: the texels alone."""
        return dict(self.__dict__)


def _with_panorama(radiance: Array | np.ndarray, panorama: Panorama | None) -> Environment:
    """A light that remembers the pixels of its file."""
    light = Environment(radiance)
    if panorama is not None:
        object.__setattr__(light, "_panorama", panorama)  # of a new object, before others see it
    return light


_size = functools.partial(require.count, "size", least=1)


@require.arguments(path=functools.partial(require.path, "path"), size=_size)
def load_environment(path: str | pathlib.Path, *, size: int = 64, layout: str | None = None) -> Environment:
    """Loads distant light from an image file.

    The layout is determined from the EXR attribute ``envmap``, or else from the ratio of width to height: 2 : 1 is
    "latlong", 3 : 4 "vertical-cross", 1 : 6 "vertical-strip" and 6 : 1 "horizontal-strip". A single pixel is constant
    light. ``resample`` explains the layouts.

    Args:
        path: The file, in a format that ``jaxprt.files.read_image`` reads.
        size: Texels along the edge of a cube face.
        layout: One of ``LAYOUTS``; needed only if it cannot be determined.

    Returns:
        Light in three colors. Negative values, which lossy files may contain, are set to zero with a warning.

    Raises:
        FileNotFoundError: The file does not exist.
        TypeError: The size is not a whole number.
        ValueError: The file is damaged, not an image, of an unknown layout, or holds NaN or infinity; or the size is
            below 1.
        MemoryError: The image or the cubemap does not fit into memory.
    """
    _check_size((1, 1, 3), "latlong", size)  # before the file is read
    image, attributes = images.read_image(path)
    layout = layout or layout_of(image, attributes, str(path))
    return environment_from_image(image, size=size, layout=layout, name=str(path))


@require.arguments(image=functools.partial(require.real, "image"), size=_size)
def environment_from_image(
    image: Float[np.ndarray | Array, "h w c"],
    *,
    size: int = 64,
    layout: str | None = None,
    name: str = "image",
) -> Environment:
    """Makes distant light from an image in memory, with the checks of ``load_environment``.

    Args:
        image: Linear radiance with 1 (gray), 2 (gray, alpha), 3 (RGB) or 4 (RGBA) channels; alpha is ignored.
        size: Texels along the edge of a cube face.
        layout: One of ``LAYOUTS``; None determines it from the shape.
        name: Name of the image in error messages.

    Returns:
        Light in three colors.

    Raises:
        TypeError: The size is not a whole number.
        ValueError: The image has an unknown layout or number of channels, or holds NaN or infinity; or the size is
            below 1.
        MemoryError: The cubemap does not fit into memory.
    """
    image = np.asarray(image)
    require.array("image", image, "h w c")
    if layout is not None and not isinstance(layout, str):
        raise TypeError(f"layout must be one of {', '.join(LAYOUTS)}, got {require.shown(layout)}")
    layout = layout or layout_of(image, {}, name)
    _check_layout(image, layout, name)
    image = _clean(image, name)
    light = jnp.asarray(resample(image, layout=layout, size=size))
    on_edge = layout.startswith("openexr")
    if layout in _CUBES:
        return _with_panorama(light, panorama.from_faces(_cut_faces(image, layout), on_edge=on_edge))
    return _with_panorama(light, panorama.from_latlong(image, on_edge=on_edge))


def resample(
    image: Float[np.ndarray, "h w c"], *, layout: str = "latlong", size: int = 64
) -> Float64[np.ndarray, "6 n n c"]:
    """Resamples a picture of the whole sphere to a cubemap: texels are area means over pixels of constant radiance.

    The integral over the sphere is conserved for each channel, and constants are reproduced, both up to rounding,
    whether pixels are larger or smaller than texels. Cube layouts are resampled exactly. Layouts:

    * "latlong": the top row is +y, the center column +z, and +x a quarter of the width from the left;
      direction (sin lon cos lat, sin lat, cos lon cos lat), lon from pi on the left to -pi.
    * "openexr-latlong": the same, but pixels are point samples that include both poles and both ends of the
      longitude, so boxes on the border are half as large.
    * "vertical-cross": 3 x 4 faces seen from inside: +y on top; -x, -z and +x in the second row; then -y; and
      +z at the bottom, upside down.
    * "vertical-strip", "horizontal-strip": faces +x, -x, +y, -y, +z, -z in OpenGL's orientation.
    * "openexr-cube": OpenEXR's faces, from top to bottom, whose pixels are point samples that include the edges.

    Args:
        image: Radiance with any number of channels.
        layout: One of ``LAYOUTS``.
        size: Texels along the edge of a cube face.

    Returns:
        Mean radiance of each texel.
    """
    _check_layout(image, layout, "image")
    _check_size(image.shape, layout, size)
    if layout in _CUBES:
        face = _cut_faces(image, layout)
        return _means_of_cube(face, _box_edges(face.shape[1], on_edge=layout == "openexr-cube"), size)
    on_edge = layout == "openexr-latlong"
    latitude, longitude = (-_box_edges(count, on_edge=on_edge) for count in image.shape[:2])
    return _means_of_latlong(image, np.pi / 2 * latitude, np.pi * longitude, size, around=_AROUND)


def _environment(value: object) -> None:
    require.kind("the light", value, Environment, source="jaxprt.load_environment")


@require.arguments(
    light=_environment,
    rotation=functools.partial(require.rotation, "rotation"),
    samples=functools.partial(require.count, "samples", least=1),
)
def rotate(light: Environment, rotation: Float[Array, "3 3"], *, samples: int = 2) -> Environment:
    """Rotates distant light: radiance from direction s arrives from direction R s afterwards.

    A light with the pixels of a file (`Environment.panorama`) is made of these anew, in the same number of texels, so
    that turning it often or by little does not blur it. Inside `jax.jit`, and for other lights, the texels are turned:

    Each texel is the mean of ``samples`` x ``samples`` parts. The value of a part is interpolated bilinearly, with a
    transition between texels that is as wide as a part. The mean then approximates the overlap of rotated texels with
    those of the cube. A sun in one texel therefore moves smoothly instead of flickering, and rotations that map the
    cube onto itself permute the texels. Parts cover some texels of the original light more than others; its values are
    weighted to compensate. The light should not be negative.

    Both ways, each color is scaled so that its integral over the sphere is conserved, and constant light does not
    change. When texels are turned, the result is differentiable in both arguments. At the identity the gradient is the
    central one of a piecewise smooth function.

    Args:
        light: One light, or a batch of them.
        rotation: A proper rotation matrix. Inside `jax.jit` it is not checked, and others give wrong results.
        samples: Parts along the edge of a texel, when texels are turned.

    Returns:
        The rotated light.

    Raises:
        TypeError: The light is not an `Environment`, the rotation does not consist of real numbers, or the number of
            samples is not a whole number.
        ValueError: The rotation is another matrix, or the number of samples is below 1.

    Reference: the weights are one step of the balancing in Sinkhorn and Knopp 1967.
    """
    if light.panorama is None or not known(light, rotation):
        return _rotated_texels(light, rotation, samples=samples)
    turned = light.panorama.rotated(np.asarray(rotation))
    radiance = turned.cubemap(light.radiance.shape[-2]).astype(light.radiance.dtype)
    return _with_panorama(put(radiance), turned)


@functools.partial(jit, static_argnames="samples")
def _rotated_texels(light: Environment, rotation: Float[Array, "3 3"], *, samples: int) -> Environment:
    radiance = light.radiance
    n = radiance.shape[-2]
    # Points on the cube have coordinates in fractions of texels, which quarter turns preserve exactly.
    point = cubemap.point(size=n * samples).astype(radiance.dtype)
    source = (point[..., None] * rotation.astype(radiance.dtype)).sum(-2)
    area = cubemap.solid_angle(size=n).astype(radiance.dtype)[..., None]
    weight = cubemap.solid_angle(size=n * samples).astype(radiance.dtype).reshape(6, n, samples, n, samples, 1)

    def flux(value):
        part = cubemap.lookup(value, source, sharpness=samples)
        return (part.reshape(6, n, samples, n, samples, -1) * weight).sum((2, 4))

    one = jnp.ones_like(area)
    (covered,) = jax.linear_transpose(flux, one)(one)
    balance = jnp.where(covered > 0, area / jnp.where(covered > 0, covered, 1), 1)
    flat = jnp.moveaxis(radiance.reshape(-1, 6, n, n, radiance.shape[-1]), 0, 3).reshape(6, n, n, -1)
    total = flux(jnp.concatenate([flat * balance, balance], axis=-1))
    turned = total[..., :-1] / total[..., -1:]

    before, after = ((area * value).sum((0, 1, 2)) for value in (flat, turned))
    turned = turned * jnp.where(after == 0, 1, before / jnp.where(after == 0, 1, after))
    batched = turned.reshape(6, n, n, -1, radiance.shape[-1])
    return Environment(jnp.moveaxis(batched, 3, 0).reshape(radiance.shape))


def _toward(value: object) -> np.ndarray:
    require.finite("direction", value)
    direction = np.asarray(value, np.float64)
    if direction.shape != (3,) or not direction.any():
        raise ValueError(f"direction must be one direction, [3], and not zero, got {require.shown(value)}")
    return direction / np.linalg.norm(direction)


def _colors(value: object) -> np.ndarray:
    require.finite("radiance", value)
    color = np.asarray(value, np.float64)
    if color.shape not in ((), (1,), (3,)):
        raise ValueError(f"radiance must be one number or three, got an array of shape {list(color.shape)}")
    return np.broadcast_to(color, (3,))


@require.arguments(
    light=_environment,
    direction=_toward,
    angle=functools.partial(require.number, "angle", low=1e-4, high=np.pi),
    radiance=_colors,
)
def add_disk(light: Environment, direction: ArrayLike, *, angle: float, radiance: ArrayLike) -> Environment:
    """Adds a round lamp to distant light, such as a sun. It adds to the light that is behind it.

    A lamp of irradiance E on a surface that faces it has about the radiance E / (pi angle^2). Lamps that are smaller
    than a texel keep their flux: the texel around their center has it. Pictures show lamps as disks if the light has
    the pixels of a file (`Environment.panorama`). Not for use inside `jax.jit`.

    Args:
        light: One light, not a batch. The result has three colors.
        direction: Direction towards the lamp, in world coordinates.
        angle: Angular radius in radians; the sun's is 0.00465.
        radiance: Radiance of the lamp, one number or three colors.

    Returns:
        The light with the lamp.

    Raises:
        TypeError: The light is not an `Environment`, or the lamp does not consist of real numbers.
        ValueError: The light is a batch or has other colors than one or three, the direction is zero, the angle is not
            between 1e-4 and pi, or the radiance is not finite.
    """
    require.colors("the light", light.radiance)
    require.array("the light's radiance", light.radiance, "6 n n c")
    texels = panorama.disk_texels(np.asarray(direction), float(angle), light.radiance.shape[-2])
    total = np.asarray(light.radiance, np.float64) + texels[..., None] * np.asarray(radiance)
    pixels = light.panorama
    if pixels is not None:
        pixels = pixels.with_disk(np.concatenate([np.asarray(direction), [float(angle)], np.asarray(radiance)]))
    return _with_panorama(put(total.astype(light.radiance.dtype)), pixels)


def disk_share(direction: ArrayLike | Sequence[float], *, angle: float, size: int) -> Float[np.ndarray, "6 n n"]:
    """Share of each texel of a light that lies in a disk, such as that of a sun with the glow around it.

    Args:
        direction: Direction towards the center of the disk, in world coordinates.
        angle: Angular radius of the disk in radians.
        size: Texels along the edge of the light's faces.

    Raises:
        ValueError: The direction is zero, or the angle is not between 1e-4 and pi.
    """
    require.number("angle", angle, 1e-4, high=np.pi)
    require.count("size", size, least=1)
    return np.clip(panorama.disk_texels(_toward(direction), angle, size), 0, 1)


def _direction(value: object) -> Array:
    require.finite("direction", value)
    direction = require.floating(value)
    if direction.shape[-1:] != (3,):
        raise ValueError(f"direction must be [..., 3], got an array of shape {list(direction.shape)}")
    return direction


@require.arguments(light=_environment, size=_size)
def finer(light: Environment, *, size: int = 256) -> Environment:
    """The same light in texels of another size, from the pixels of its file.

    Texels are area means over the pixels, turned as `rotate` has turned the light, and the integral over the sphere is
    conserved. Use it where the texels of the light are too coarse, as for shadow rays towards a small sun.

    Args:
        light: One light, not a batch.
        size: Texels along the edge of a cube face.

    Returns:
        The light with faces of size x size texels; or the given light itself if it does not have the pixels of a file
        (`Environment.panorama` is None).

    Raises:
        TypeError: The light is not an `Environment`, or the size is not a whole number.
        ValueError: The size is below 1.
        MemoryError: The cubemap does not fit into memory.
    """
    pixels = light.panorama
    if pixels is None or size == light.radiance.shape[-2]:
        return light
    require.memory(f"a cubemap of 6 x {size} x {size} texels", 100 * 6 * size**2, "choose a smaller size")
    return _with_panorama(put(pixels.cubemap(size).astype(light.radiance.dtype)), pixels)


def resized(light: Environment, *, size: int) -> Environment:
    """The same light in texels of another size, with the same integral over the sphere.

    Texels come from the pixels of the light's file as in `finer`, or else from its texels: means of them, or each
    repeated.
    """
    edge = light.radiance.shape[-2]
    if edge == size or light.panorama is not None:
        return finer(light, size=size)
    if edge % size == 0:
        return Environment(cubemap.reduced(light.radiance, size=size))
    if size % edge:
        raise ValueError(f"the edge of a light of {edge} texels must divide {size} or be a multiple of it")
    return Environment(jnp.repeat(jnp.repeat(light.radiance, size // edge, -3), size // edge, -2))


@require.arguments(light=_environment, direction=_direction)
@jit
def background(light: Environment, direction: Float[Array, "*b 3"]) -> Float[Array, "*b c"]:
    """Radiance that arrives from given directions in world coordinates, interpolated bilinearly between texels.

    Args:
        light: One light, not a batch.
        direction: Directions of any length, in world coordinates.

    Returns:
        Radiance for each direction, in the units of the light.
    """
    return cubemap.lookup(light.radiance, direction)


@require.arguments(
    light=_environment, direction=_direction, angle=functools.partial(require.at_least, "angle", least=0.0)
)
def sky(
    light: Environment,
    direction: Float[Array | np.ndarray, "*b 3"],
    *,
    angle: Float[Array | np.ndarray, "*b"] | float = 0.0,
) -> Float[Array, "*b c"]:
    """Radiance that a picture shows in given directions, from the pixels of the light's file.

    It is interpolated bilinearly between pixels, and averaged over the pixels of the picture by mip maps. A light
    without the pixels of a file (`Environment.panorama` is None) has the radiance of `background`; so has every light
    inside `jax.jit` and for derivatives.

    Args:
        light: One light, not a batch.
        direction: Directions of any length, in world coordinates.
        angle: Width in radians of the pixel of the picture that looks in each direction; 0 does not average.

    Returns:
        Radiance for each direction, in the units of the light.
    """
    if light.panorama is None or not known(light, direction, angle):
        return background(light, direction)
    ray = np.asarray(direction).reshape(-1, 3)
    width = np.broadcast_to(np.asarray(angle, ray.dtype), direction.shape[:-1]).reshape(-1)
    color = light.panorama.sampled(ray, width).astype(light.radiance.dtype)
    return put(color.reshape(*direction.shape[:-1], 3))


def layout_of(image: np.ndarray, attributes: Mapping[str, object], name: str) -> str:
    """The layout that an image file states in its EXR attribute ``envmap``, or else that its shape implies."""
    if (stated := _STATED.get(str(attributes.get("envmap")))) is not None:
        return stated
    height, width = image.shape[:2]
    if width == 2 * height or height == width == 1:
        return "latlong"
    for layout, ((rows, columns), *_) in _CUBES.items():
        if height * columns == width * rows and height % rows == 0:
            return layout
    raise ValueError(
        f"{name} must be 2 : 1 (latlong), 3 : 4 (vertical cross), 1 : 6 or 6 : 1 (faces in a strip), "
        f"got {width} x {height} (width x height); or name its layout, one of {', '.join(LAYOUTS)}"
    )


def _check_layout(image: np.ndarray, layout: str, name: str) -> None:
    if not isinstance(layout, str) or layout not in LAYOUTS:
        raise ValueError(f"layout must be one of {', '.join(LAYOUTS)}, got {layout!r}")
    height, width = image.shape[:2]
    if 0 in image.shape:
        raise ValueError(f"{name} must have pixels, got the shape {image.shape}")
    if layout in _CUBES:
        rows, columns = _CUBES[layout][0]
        if height % rows or width % columns or height // rows != width // columns:
            raise ValueError(
                f"{name} must be {columns} n x {rows} n pixels (width x height) for the layout {layout}, "
                f"got {width} x {height}"
            )


def _check_size(shape: tuple[int, ...], layout: str, size: int) -> None:
    """Refuses sizes below 1, and cubemaps that do not fit into memory, before anything is made."""
    require.count("size", size, least=1)
    rows = _CUBES[layout][0][0] if layout in _CUBES else None
    needed = _resampling_bytes(shape, int(size), faces_down=rows, around=_AROUND)
    require.memory(f"a cubemap of 6 x {size} x {size} texels", needed, "choose a smaller size")


def _clean(image: np.ndarray, name: str) -> np.ndarray:
    """Three finite, non-negative channels. Large images are not copied unless they have negative values."""
    channels = image.shape[-1]
    if channels > 4:
        raise ValueError(f"{name} must have 1 to 4 channels, got {channels}")
    image = image[..., :3] if channels > 2 else image[..., :1]
    step = max(1, _CHUNK // image.shape[1])
    blocks = [image[first : first + step] for first in range(0, len(image), step)]
    if not all(np.isfinite(block).all() for block in blocks):
        wrong = np.argwhere(~np.isfinite(image).all(axis=-1))
        row, column = wrong[0]
        raise ValueError(
            f"{name} must hold finite radiance, got NaN or infinity in {len(wrong)} pixels, "
            f"the first at row {row}, column {column}"
        )
    negative = sum(int((block < 0).any(axis=-1).sum()) for block in blocks)
    if negative:
        warnings.warn(
            f"{name}: {negative} of {image.shape[0] * image.shape[1]} pixels are negative, the lowest "
            f"{image.min():.3g}; they are set to 0",
            stacklevel=4,
        )
        image = np.maximum(image, 0)
    return np.broadcast_to(image, (*image.shape[:2], 3))


def _cut_faces(image: np.ndarray, layout: str) -> np.ndarray:
    (rows, _), corners, steps = _CUBES[layout]
    n = image.shape[0] // rows
    cut = [image[i * n : (i + 1) * n, j * n : (j + 1) * n] for i, j in corners]
    return np.stack([face[::down, ::right] for face, (down, right) in zip(cut, steps, strict=True)])


class Sun(eqx.Module):
    """A distant light of one direction, such as a directional light of a glTF file.

    Attributes:
        name: Name of the light.
        direction: Direction from the scene towards the light, in world coordinates, of any length.
        irradiance: Irradiance of a surface that faces the light, in units of radiance times steradian.

    Raises:
        TypeError: The name is not a string.
        ValueError: The direction or the irradiance is not finite or of another shape, the direction is zero, or the
            irradiance is negative.
    """

    name: str = eqx.field(static=True)
    direction: Float[Array, "3"] = eqx.field(converter=require.floating)
    irradiance: Float[Array, "3"] = eqx.field(converter=functools.partial(require.repeated, length=3), default=1.0)

    def __check_init__(self):
        """Refuses values that are not finite, and directions of no length."""
        if not isinstance(self.name, str):
            raise TypeError(f"the name of a sun must be text, got {self.name!r}")
        require.finite(f"the direction of sun {self.name!r}", self.direction)
        require.at_least(f"the irradiance of sun {self.name!r}", self.irradiance, 0.0)
        for name in ("direction", "irradiance"):
            shape = list(jnp.shape(getattr(self, name)))
            if shape != [3]:
                raise ValueError(f"the {name} of sun {self.name!r} must be three numbers, got an array {shape}")
        if not isinstance(self.direction, Tracer) and not self.direction.any():
            raise ValueError(f"the direction of sun {self.name!r} must not be zero, got {self.direction}")


def _light(value: object) -> None:
    require.kind("the light", value, Environment, source="jaxprt.load_environment")


def _suns(value: object) -> tuple[Sun, ...]:
    if not isinstance(value, Sequence) or isinstance(value, str | bytes):
        raise TypeError(f"suns must be a list of suns, got {require.shown(value)}")
    for sun in value:
        require.kind("each of the suns", sun, Sun, source="jaxprt.scene.Sun")
    return tuple(value)


@require.arguments(light=_light, suns=_suns)
@jit
def with_suns(light: Environment, suns: Sequence[Sun]) -> Environment:
    """Adds suns to distant light: each fills one texel, whose flux is the sun's irradiance.

    A texel of 6 x 64 x 64 has a width of 1.4 degrees, which is 2.6 times that of the sun in the sky. The result is
    linear in the light and in the irradiances. It does not change as a direction moves within a texel, so its
    gradient by directions is zero.

    Args:
        light: One light, or a batch of them, in three colors or in one. One color becomes three.
        suns: The suns, such as `suns` of a scene; may be empty.

    Returns:
        The light with the suns, in three colors.

    Raises:
        TypeError: The light is not an `Environment`, or `suns` is not a list of suns.
        ValueError: The light has another number of colors than one and three.
    """
    radiance = light.radiance
    if radiance.shape[-1] not in (1, 3):
        raise ValueError(f"the light must have one color or three for suns, got {radiance.shape[-1]}")
    radiance = jnp.broadcast_to(radiance, (*radiance.shape[:-1], 3))
    size = radiance.shape[-2]
    area = cubemap.solid_angle(size=size).astype(radiance.dtype)
    for sun in suns:
        face, place = cubemap.coordinates(jax.lax.stop_gradient(sun.direction))
        column, row = (jnp.clip(jnp.floor((place[i] + 1) / 2 * size), 0, size - 1).astype(jnp.int32) for i in (0, 1))
        value = sun.irradiance.astype(radiance.dtype) / area[face, row, column]
        radiance = radiance.at[..., face, row, column, :].add(value)
    return Environment(radiance)
