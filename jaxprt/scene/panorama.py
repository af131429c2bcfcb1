"""The pixels of an environment's file, for pictures of the sky and for cubemaps of any size."""

import dataclasses
import math

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64, UInt16

from jaxprt.sphere import cubemap as cubemaps

WIDEST = 8192  # columns of the finest level; wider pictures are halved first
_LARGEST = 2.0**15  # the largest value in half precision, after scaling by a power of two
_BRIGHT = 32  # times the mean radiance: pixels that are cut into more pieces
_RIM = 4  # parts along the edge of a texel, to resolve the rim of a lamp
_ACROSS = 2  # pieces of pixels across the smallest texel of a cubemap, at least


@dataclasses.dataclass(frozen=True, eq=False)
class Panorama:
    """Radiance from every direction in the resolution of a file, as a pyramid of ever coarser pictures.

    Values have half precision, scaled by a power of two: 11 bits from the brightest pixel down to 2e-9 of it. With the
    pyramid a pixel takes 8 bytes: 17 MB for 2048 x 1024 pixels, 67 MB for 4096 x 2048 and 268 MB for 8192 x 4096.

    Attributes:
        half: Bit patterns of the pixels of all levels, the finest level first.
        radiance: Radiance of each bit pattern.
        first: Index of the first pixel of each level.
        height: Rows of each level, or of each face of a cube.
        width: Columns.
        cube: Whether pixels lie on six faces as in `jaxprt.sphere.cubemap`, and not in a latlong picture.
        turn: Rotation from the directions of the file to those of the world.
        integral: Integral over the sphere, for each color, without the disks.
        disk: Round lamps in front of the pixels: unit direction in the world, angular radius in radians, and radiance.
    """

    half: UInt16[np.ndarray, "p 3"]
    radiance: Float32[np.ndarray, " 65536"]
    first: Int64[np.ndarray, " k"]
    height: Int64[np.ndarray, " k"]
    width: Int64[np.ndarray, " k"]
    cube: bool
    turn: Float64[np.ndarray, "3 3"]
    integral: Float64[np.ndarray, " 3"]
    disk: Float64[np.ndarray, "d 7"]

    @property
    def rows(self) -> int:
        """Rows of a latlong picture that shows all pixels."""
        return int(self.height[0] * (2 if self.cube else 1))

    def rotated(self, rotation: Float[np.ndarray, "3 3"]) -> "Panorama":
        """The same pixels, turned: radiance from direction s arrives from direction R s afterwards."""
        rotation = np.asarray(rotation, np.float64)
        disk = np.concatenate([np.einsum("ij,dj->di", rotation, self.disk[:, :3]), self.disk[:, 3:]], 1)
        return dataclasses.replace(self, turn=rotation @ self.turn, disk=disk)

    def with_disk(self, disk: Float64[np.ndarray, " 7"]) -> "Panorama":
        """The same pixels behind one more round lamp."""
        return dataclasses.replace(self, disk=np.concatenate([self.disk, disk[None]]))

    def sampled(
        self, direction: Float[np.ndarray, "n 3"], angle: Float[np.ndarray, " n"] | float
    ) -> Float32[np.ndarray, "n 3"]:
        """Radiance from some directions, averaged over the pixels of a picture.

        Args:
            direction: Directions in the world, of any length.
            angle: Width of the pixel around each direction, in radians; 0 for the finest level.
        """
        from jaxprt.scene import panorama_loops  # numba takes half a second to import

        ray = np.ascontiguousarray(direction, np.float32)
        width = np.ascontiguousarray(np.broadcast_to(np.asarray(angle, np.float32), len(ray)))
        color = np.empty((len(ray), 3), np.float32)
        levels = self.half, self.radiance, self.first, self.height, self.width
        panorama_loops.sample(*levels, self.cube, self.turn, ray, width, color)
        if len(self.disk):
            panorama_loops.add_disks(self.disk, ray, width, color)
        return color

    def cubemap(self, size: int) -> Float64[np.ndarray, "6 n n 3"]:
        """Mean radiance over the texels of a cubemap. The integral over the sphere is that of the file.

        Args:
            size: Texels along the edge of a face.
        """
        from jaxprt.scene import panorama_loops  # numba takes half a second to import

        # A texel is at least 2 / (3 size) wide, in the corners of a face.
        needed = math.ceil(1.5 * _ACROSS * size * (2 if self.cube else 2 * np.pi))
        # The coarsest level that is fine enough; pixels of the finest one may be cut into pieces.
        enough = np.flatnonzero(self.width >= needed)
        level = int(enough[-1]) if len(enough) else 0
        parts = -(-needed // int(min(self.width[level], 2 * self.height[level])))
        shape = int(self.height[level]), int(self.width[level])
        bright = _BRIGHT * float(self.integral.max()) / (4 * np.pi)
        flux = panorama_loops.cube_flux if self.cube else panorama_loops.latlong_flux
        total, excess = np.zeros((2, 6 * size**2, 4))
        flux(self.half[self.first[level] :], self.radiance, *shape, parts, bright, self.turn, size, total, excess)
        solid_angle = np.asarray(cubemaps.solid_angle(size=size), np.float64)[..., None]
        # Pieces approximate the texels' areas. What is far above the mean is too little area to tell it.
        mean = (total[:, :3] / total[:, 3:]).reshape(6, size, size, 3)
        mean += excess[:, :3].reshape(mean.shape) / solid_angle
        after = (solid_angle * mean).sum((0, 1, 2))
        mean *= np.divide(self.integral, after, out=np.ones(3), where=after != 0)
        for disk in self.disk:
            mean += disk_texels(disk[:3], float(disk[3]), size)[..., None] * disk[4:]
        return mean


def disk_texels(direction: Float[np.ndarray, "3"], angle: float, size: int) -> Float64[np.ndarray, "6 n n"]:
    """Mean radiance over the texels of a cubemap of a round lamp of radiance 1. Small lamps keep their flux too.

    Args:
        direction: Unit direction towards the lamp.
        angle: Angular radius in radians.
        size: Texels along the edge of a face.
    """
    part = np.asarray(cubemaps.direction(size=size * _RIM), np.float64)
    area = np.asarray(cubemaps.solid_angle(size=size * _RIM), np.float64)
    toward = np.einsum("...i,i->...", part, direction)
    inside = area * (toward >= min(np.cos(angle), toward.max()))
    flux = inside.reshape(6, size, _RIM, size, _RIM).sum((2, 4))
    flux *= 2 * np.pi * (1 - np.cos(angle)) / flux.sum()
    return flux / np.asarray(cubemaps.solid_angle(size=size), np.float64)


def from_latlong(image: Float[np.ndarray, "h w 3"], *, on_edge: bool) -> Panorama:
    """A panorama of a latlong picture: the top row is +y, the center column +z, a quarter of the width +x.

    Args:
        image: Finite radiance, not negative.
        on_edge: Whether pixels are samples that include both poles and both ends of the longitude.
    """
    if on_edge:
        image = _center_pixels(_center_pixels(image, 0), 1)
    image = image[None]
    while image.shape[2] > WIDEST:
        image = _halve(image, latlong=True)
    return _pyramid(image, latlong=True)


def from_faces(face: Float[np.ndarray, "6 n n 3"], *, on_edge: bool) -> Panorama:
    """A panorama of six faces as in `jaxprt.sphere.cubemap`.

    Args:
        face: Finite radiance, not negative.
        on_edge: Whether pixels are samples that include the edges of the faces.
    """
    if on_edge:
        face = _center_pixels(_center_pixels(face, 1), 2)
    while 4 * face.shape[2] > WIDEST:
        face = _halve(face, latlong=False)
    return _pyramid(face, latlong=False)


def _pyramid(image: np.ndarray, *, latlong: bool) -> Panorama:
    brightest = float(image.max())
    scale = 2.0 ** (np.floor(np.log2(_LARGEST)) - np.ceil(np.log2(brightest))) if brightest > 0 else 1.0
    integral = _integral(image, latlong=latlong)
    levels, shapes = [], []
    while True:
        shapes.append(image.shape[1:3])
        picture = _isotropic(image[0])[None] if latlong else image
        scaled = np.multiply(picture, np.float32(scale), dtype=np.float32)
        levels.append(scaled.reshape(-1, 3).astype(np.float16).view(np.uint16))
        if max(shapes[-1]) <= 2:
            break
        image = _halve(image, latlong=latlong)
    with np.errstate(over="ignore", invalid="ignore"):  # patterns of infinity and NaN, which no pixel has
        radiance = (np.arange(2**16, dtype=np.uint16).view(np.float16).astype(np.float64) / scale).astype(np.float32)
    first = np.cumsum([0, *map(len, levels[:-1])])
    height, width = np.array(shapes, np.int64).T.copy()
    return Panorama(
        np.concatenate(levels), radiance, first, height, width, not latlong, np.eye(3), integral, np.zeros((0, 7))
    )


def _integral(image: np.ndarray, *, latlong: bool) -> Float64[np.ndarray, " 3"]:
    height = image.shape[1]
    if latlong:
        edge = np.sin(np.pi * (0.5 - np.arange(height + 1) / height))
        return -np.diff(edge) @ image[0].mean(1, dtype=np.float64) * 2 * np.pi
    area = np.asarray(cubemaps.solid_angle(size=height), np.float64)
    return np.einsum("fij,fijc->c", area, image, dtype=np.float64)


def _isotropic(image: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """A latlong picture whose pixels near the poles are averaged over as many columns as are as wide as a row."""
    height, width, _ = image.shape
    latitude = np.pi * (0.5 - (np.arange(height) + 0.5) / height)
    # A pixel of a picture of the sky then need not read hundreds of columns near a pole.
    span = np.minimum(width / (2 * height) / np.cos(latitude) - 1, width)  # columns to average over
    result = image.copy()
    for row in np.flatnonzero(span > 1):  # 60 degrees or more from the horizon
        around = np.cumsum(np.concatenate([np.zeros((1, 3)), image[row], image[row], image[row]]), 0)
        middle = width + 0.5 + np.arange(width)
        total = _interpolate_rows(around, middle + span[row] / 2) - _interpolate_rows(around, middle - span[row] / 2)
        result[row] = total / span[row]
    return result


def _interpolate_rows(value: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Rows of an array at fractional places, interpolated linearly."""
    row = np.minimum(place.astype(int), len(value) - 2)
    share = (place - row)[:, None]
    return (1 - share) * value[row] + share * value[row + 1]


def _center_pixels(image: np.ndarray, axis: int) -> np.ndarray:
    """Pixels of one width for samples that include both ends of an axis: two for each, one at each end."""
    count = image.shape[axis]
    return image if count == 1 else np.take(image, np.arange(1, 2 * count - 1) // 2, axis)


def _halve(image: np.ndarray, *, latlong: bool) -> np.ndarray:
    """Means over 2 x 2 pixels, or a little less where a number of rows or columns is odd."""
    height, width = image.shape[1:3]
    down = np.sin(np.pi / 2 * np.linspace(-1, 1, height + 1)) if latlong else np.linspace(-1, 1, height + 1)
    return _coarser(_coarser(image, 1, down), 2, np.linspace(-1, 1, width + 1))


def _coarser(image: np.ndarray, axis: int, edge: np.ndarray) -> np.ndarray:
    """Means over intervals of half the number of pixels, rounded up, along an axis."""
    count = image.shape[axis]
    fewer = (count + 1) // 2
    place = np.arange(fewer + 1) * (count / fewer)
    # `edge` is where pixels begin and end along the axis, in a coordinate in which areas are equal.
    new = np.interp(place, np.arange(count + 1), edge)
    first = np.floor(place[:-1]).astype(int)
    result = np.zeros((*image.shape[:axis], fewer, *image.shape[axis + 1 :]), image.dtype)
    for step in range(2 if count % 2 == 0 else 3):
        low, high = np.minimum(first + step, count), np.minimum(first + step + 1, count)
        overlap = np.minimum(edge[high], new[1:]) - np.maximum(edge[low], new[:-1])
        share = np.maximum(overlap, 0) / np.diff(new)
        shape = [1] * image.ndim
        shape[axis] = fewer
        result += np.take(image, np.minimum(low, count - 1), axis) * share.reshape(shape).astype(image.dtype)
    return result
