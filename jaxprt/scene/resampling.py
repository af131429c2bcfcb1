"""Area means of pictures over the texels of a cubemap."""

import numpy as np
from jaxtyping import Float64

_PARTS = 8  # A pixel is divided into at most this many parts per direction; larger pixels are subdivided first.
_CHUNK = 2**20  # parts of pixels per step


def bytes_needed(shape: tuple[int, ...], size: int, *, faces_down: int | None, around: int) -> int:
    """Memory that resampling takes besides the picture, and the light in float32 that is made of the result.

    Args:
        shape: Rows, columns and channels of the picture.
        size: Texels along the edge of a cube face.
        faces_down: Faces of a cube layout from top to bottom; None for latlong pictures.
        around: Smallest number of parts around the horizon.

    Returns:
        An upper bound in bytes.
    """
    height, width, channels = shape
    texels = 6 * size**2
    # The mean radiance and two temporary arrays of one channel in float64, and the light in float32.
    needed = texels * (8 * (channels + 3) + 8 * channels)
    if faces_down:  # the faces, and where their pixels are cut by texels
        return needed + 8 * height * width * channels + 5 * 8 * (size + height // faces_down) ** 2
    # Some twelve arrays of the parts in one row of pixels, or in a step.
    return needed + 12 * 8 * max(_PARTS * max(2 * width, 12 * size * 7, around), _CHUNK)


def box_edge(count: int, *, on_edge: bool) -> np.ndarray:
    """Edges of the boxes around equidistant samples on [-1, 1].

    Args:
        count: Number of samples.
        on_edge: Whether the outer samples are at the ends, where their boxes are half as large.

    Returns:
        The edges, ascending, one more than samples.
    """
    if not on_edge or count == 1:
        return np.linspace(-1, 1, count + 1)
    return np.clip((2 * np.arange(count + 1) - 1) / (count - 1) - 1, -1, 1)


def from_cube(face: np.ndarray, edge: np.ndarray, size: int) -> Float64[np.ndarray, "6 n n c"]:
    """Exact area means of a cube: pixels, texels and their overlaps are all rectangles on a face.

    Args:
        face: Pixels of the six faces, [6, m, m, c], in OpenGL's orientation.
        edge: Edges of the pixels on [-1, 1], the same for rows and columns.
        size: Texels along the edge of a face.

    Returns:
        Mean radiance of each texel.
    """
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


def from_latlong(
    image: np.ndarray, latitude: np.ndarray, longitude: np.ndarray, size: int, *, around: int
) -> Float64[np.ndarray, "6 n n c"]:
    """Area means of a latlong picture: small parts of the pixels are distributed to the texels.

    Args:
        image: Radiance, [h, w, c].
        latitude: Edges of the rows, descending.
        longitude: Edges of the columns, descending.
        size: Texels along the edge of a cube face.
        around: Smallest number of parts around the horizon.

    Returns:
        Mean radiance of each texel. The integral over the sphere is that of the picture.
    """
    # A texel is at least 2 / (3 size) wide, in the corners of a face. About eight parts should fall across it.
    around = max(int(np.ceil(12 * size * 2 * np.pi)), around)
    parts = [max(2, int(np.ceil(around / count))) for count in (2 * image.shape[0], image.shape[1])]
    repeat = [-(-count // _PARTS) for count in parts]
    pixel_row, pixel_column = (
        np.arange(count).repeat(times) for count, times in zip(image.shape[:2], repeat, strict=True)
    )
    rows, columns = (-(-count // times) for count, times in zip(parts, repeat, strict=True))
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
    step = max(1, _CHUNK // (width.size * rows))
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
