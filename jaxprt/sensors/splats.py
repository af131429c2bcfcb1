"""Relightable Gaussian splats: the centers of a cloud receive light past a proxy mesh of the same object."""

import dataclasses
import os
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Int
from scipy.spatial import KDTree

from jaxprt import image, require
from jaxprt.files import inputs, outputs
from jaxprt.files.pixels import srgb_to_linear
from jaxprt.scene import Environment, Scene
from jaxprt.scene.formats import ply
from jaxprt.scene.mesh import Mesh
from jaxprt.sensors.bases import Harmonics
from jaxprt.sensors.build import transport
from jaxprt.sensors.matrix import PointTransport
from jaxprt.visibility.blocks import Progress

_CONSTANT = 0.28209479177387814  # the spherical harmonic of degree 0
_POSITION, _COLOR = ("x", "y", "z"), ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALE, _ROTATION = ("scale_0", "scale_1", "scale_2"), ("rot_0", "rot_1", "rot_2", "rot_3")
_FIELDS = (*_POSITION, *_COLOR, "opacity", *_SCALE, *_ROTATION)
_PACKED = "packed_position"  # a field of compressed clouds
_DISK = 0.7  # largest ratio of the shortest axis of a disk to its middle one
_SAMPLES, _PER_FACE = 200_000, 4  # least samples of a proxy's surface, and samples for each face
_BLOCK = 1 << 16  # splats whose nearest points are computed at once
_SINK, _LIFT = 1e-2, 1e-4  # depth up to which splats are moved out of the proxy, and height above it, by its diagonal
_BRIGHT, _WHITE = 99.0, 0.8  # percentile of the albedo, and its value under an unknown light
_DIM = 0.02  # least irradiance that albedo is divided by, relative to that percentile of it


@dataclass(frozen=True)
class Splats:
    """A cloud of 3-D Gaussians, as training programs write it.

    Attributes:
        record: One row for each splat, with the fields of the file.
        header: The header of the file, to its end.
    """

    record: np.ndarray
    header: bytes

    def __len__(self) -> int:
        """Number of splats."""
        return len(self.record)

    def columns(self, names: tuple[str, ...]) -> Float[np.ndarray, "n k"]:
        """Some fields, side by side."""
        return np.stack([self.record[name] for name in names], -1)

    @property
    def position(self) -> Float[np.ndarray, "n 3"]:
        """Centers, in the coordinates of the file."""
        return self.columns(_POSITION)

    @property
    def color(self) -> Float[np.ndarray, "n 3"]:
        """Linear color without the part that depends on the view. The file has it as sRGB; below 0 it counts as 0."""
        return srgb_to_linear(np.maximum(0.5 + _CONSTANT * self.columns(_COLOR), 0))

    @property
    def scale(self) -> Float[np.ndarray, "n 3"]:
        """Standard deviations along the axes, as logarithms."""
        return self.columns(_SCALE)

    @property
    def axes(self) -> Float[np.ndarray, "n 3 3"]:
        """Unit axes of the Gaussians, one in each row, in the order of their scales."""
        turn = self.columns(_ROTATION).astype(np.float64)
        w, x, y, z = (turn / np.linalg.norm(turn, axis=1, keepdims=True)).T
        first = [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]
        second = [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)]
        third = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]
        return np.moveaxis(np.array([first, second, third]), -1, 0)


class Nearest(NamedTuple):
    """Nearest points of a surface: their positions, the unit normals of their faces, and how high splats are above."""

    point: Float[np.ndarray, "n 3"]
    normal: Float[np.ndarray, "n 3"]
    height: Float[np.ndarray, " n"]


def load_splats(path: str | os.PathLike) -> Splats:
    """Reads a cloud of 3-D Gaussian splats from a binary PLY file.

    Args:
        path: The file, with one element "vertex" of the fields x y z, f_dc_0 to f_dc_2, opacity, scale_0 to scale_2
            (logarithms) and rot_0 to rot_3 (a quaternion w x y z). Further fields, such as f_rest_0, are kept.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is no PLY file, is text, big-endian or compressed, holds other elements or no splats, lacks
            fields, or holds values that are not finite.
    """
    require.path("path", path)
    content = inputs.content(Path(path), "a PLY file of Gaussian splats")
    try:
        header = ply.read_header(content)
        record = _record(content, header)
    except ValueError as error:
        raise ValueError(f"{path} must be a PLY file of Gaussian splats: {error}") from error
    splats = Splats(record, content[: header.end])
    for what, names in (("centers", _POSITION), ("colors", _COLOR), ("scales", _SCALE), ("rotations", _ROTATION)):
        require.finite(f"{what} of {path}", splats.columns(names))
    without = np.flatnonzero(~splats.columns(_ROTATION).any(1))
    if len(without):
        raise ValueError(f"rotations of {path} must not be zero, got {len(without)} that are, first splat {without[0]}")
    return splats


def _record(content: bytes, header: ply.PlyHeader) -> np.ndarray:
    """The rows of the only element."""
    names = [element.name for element in header.elements]
    fields = [item for element in header.elements for item in element.properties]
    if any(item.name == _PACKED for item in fields):
        raise ValueError("it must not be compressed, got packed fields: export it as a standard PLY file")
    if header.order != "<":
        order = "text" if not header.order else "big-endian bytes"
        raise ValueError(f"its format must be binary_little_endian, got {order}")
    if names != ["vertex"]:
        raise ValueError(f"it must have one element 'vertex', got {', '.join(names) or 'none'}")
    missing = [name for name in _FIELDS if name not in {item.name for item in fields}]
    if missing:
        raise ValueError(f"each splat must have the fields {', '.join(_FIELDS)}; missing are {', '.join(missing)}")
    wrong = [item.name for item in fields if item.length is not None or (item.name in _FIELDS and item.dtype != "<f4")]
    if wrong:
        raise ValueError(f"fields must be single numbers, and those of splats of type float; got another {wrong[0]}")
    count, dtype = header.elements[0].rows, np.dtype([(item.name, item.dtype) for item in fields])
    left = len(content) - header.end - count * dtype.itemsize
    if left or not count:
        raise ValueError(f"it must hold one splat or more and nothing else, got {count} splats and {left} more bytes")
    return np.frombuffer(content, dtype, count, header.end)


def write_splats(path: str | os.PathLike, splats: Splats) -> None:
    """Writes a cloud as a PLY file, with the header and the fields of the file that it was read from.

    Args:
        path: The file, *.ply. An old one is replaced.
        splats: The cloud.

    Raises:
        ValueError: The path does not end in .ply.
        OSError: The file cannot be written. The old file, if any, is unchanged.
    """
    outputs.write(outputs.target(path, ".ply"), splats.header + splats.record.tobytes())


def splat_normals(splats: Splats, mesh: Mesh, *, nearest: Nearest | None = None) -> Float32[np.ndarray, "n 3"]:
    """Unit normals of splats: their shortest axes, on the side that the proxy's surface faces at its nearest point.

    Splats that are no disks, whose shortest axis is longer than 0.7 of the middle one, get the normal of the proxy's
    face.

    Args:
        splats: The cloud.
        mesh: The proxy. Its faces are counterclockwise as seen from outside.
        nearest: Result of `nearest_points`, if it is known.
    """
    surface = nearest_points(splats, mesh).normal if nearest is None else nearest.normal
    length = np.sort(splats.scale.astype(np.float64), 1)
    axis = splats.axes[np.arange(len(splats)), np.argmin(splats.scale, 1)]
    side = np.where(np.sum(axis * surface, 1, keepdims=True) < 0, -1, 1)
    disk = length[:, :1] - length[:, 1:2] <= np.log(_DISK)
    return np.where(disk, side * axis, surface).astype(np.float32)


def nearest_points(splats: Splats, mesh: Mesh) -> Nearest:
    """The nearest points of a mesh's surface to the centers of splats, in the coordinates of the file.

    The face is that of the nearest of many samples, four for each face and 200,000 or more in all; on this face the
    point is exact. Next to an edge the face may therefore be the neighbor of the nearest one.

    Args:
        splats: The cloud.
        mesh: The surface.

    Raises:
        ValueError: The mesh has no faces with an area.
    """
    import trimesh  # imported here, because importing takes a second

    require.kind("the proxy", mesh, Mesh, source="jaxprt.load_scene(path).mesh")
    triangle = np.asarray(mesh.position, np.float64)[np.asarray(mesh.face)] + np.asarray(mesh.origin)
    normal = np.cross(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0])
    area = np.linalg.norm(normal, axis=1)
    if not area.any():
        raise ValueError(f"the proxy must have faces with an area, got {len(area)} without")
    normal /= np.where(area > 0, area, 1)[:, None]
    face, sample = _surface_samples(triangle, area)
    tree = KDTree(sample, balanced_tree=False, compact_nodes=False)
    position = splats.position.astype(np.float64)
    face = face[tree.query(position, workers=-1)[1]]
    point = np.concatenate(
        [
            trimesh.triangles.closest_point(triangle[face[first : first + _BLOCK]], position[first : first + _BLOCK])
            for first in range(0, len(position), _BLOCK)
        ]
    )
    return Nearest(point, normal[face], np.sum((position - point) * normal[face], 1))


def _surface_samples(triangle: np.ndarray, area: np.ndarray) -> tuple[Int[np.ndarray, " s"], Float[np.ndarray, "s 3"]]:
    """Faces and positions of samples: the centers of all faces, and points that are evenly spread over the area."""
    count = max(_SAMPLES, _PER_FACE * len(area))
    total = np.cumsum(area)
    face = np.searchsorted(total, (np.arange(count) + 0.5) / count * total[-1])
    u, v = (np.arange(count)[:, None] * [0.7548776662466927, 0.5698402909980532] % 1).T  # the R2 sequence
    outside = u + v > 1
    u, v = np.where(outside, 1 - u, u), np.where(outside, 1 - v, v)
    weight = np.stack([1 - u - v, u, v], -1)
    whole = np.flatnonzero(area > 0)
    position = np.einsum("sk,ski->si", weight, triangle[face])
    return np.concatenate([whole, face]), np.concatenate([triangle[whole].mean(1), position])


def splat_transport(
    splats: Splats,
    scene: Scene,
    *,
    degree: int = 2,
    bounces: int = 0,
    size: int = 8,
    path: str | None = None,
    executor: Executor | None = None,
    progress: Progress = True,
) -> PointTransport:
    """What splats receive of distant light: their irradiance from each spherical harmonic of it.

    The proxy casts the shadows. Splats scatter about its surface: those that are inside of it, within a hundredth of
    the diagonal of its bounding box from the nearest point of the surface, receive the light just above this point.
    Those deeper inside receive none.

    Args:
        splats: The cloud.
        scene: The proxy, in the coordinates of the cloud.
        degree: Largest degree of the harmonics, which have (degree + 1)^2 coefficients.
        bounces: How often the proxy's surfaces reflect light before it arrives, by its own materials.
        size: Texels along the edge of a cube through which rays go; see `jaxprt.sensors.transport`.
        path: Folder of finished blocks, with which a call goes on where an earlier one stopped.
        executor: Where blocks are computed; see `jaxprt.sensors.transport`.
        progress: Whether to show progress bars, or a function; see `jaxprt.Run`.

    Returns:
        The transport, one row for each splat. A warning counts the splats that no light reaches.

    Raises:
        TypeError: The scene is something else.
        ValueError: The degree or the number of bounces is negative, or the folder holds results of other inputs.
    """
    require.kind("the scene", scene, Scene, source="jaxprt.load_scene")
    require.count("degree", degree)
    mesh = scene.mesh
    nearest = nearest_points(splats, mesh)
    position = np.asarray(mesh.position, np.float64)
    diagonal = float(np.linalg.norm(np.ptp(position[np.asarray(mesh.face).ravel()], axis=0)))
    start = _above(splats.position.astype(np.float64), nearest, diagonal)
    normal = splat_normals(splats, mesh, nearest=nearest)
    more: dict[str, Any] = {"path": path, "executor": executor, "progress": progress}
    return transport(scene, start, normal, basis=Harmonics(degree), bounces=bounces, size=size, **more)


def _above(position: np.ndarray, nearest: Nearest, diagonal: float) -> Float[np.ndarray, "n 3"]:
    """The positions; those just below the surface, or on it, are moved just above it."""
    distance = np.linalg.norm(position - nearest.point, axis=1)
    below = (nearest.height < _LIFT * diagonal) & (distance <= _SINK * diagonal)
    return np.where(below[:, None], nearest.point + _LIFT * diagonal * nearest.normal, position)


def albedo_guess(splats: Splats, transport: PointTransport, captured: Environment | None) -> Float32[np.ndarray, "n 3"]:
    """Guesses the albedo of splats: their color over the radiance that a white surface would have in the same light.

    It is a guess, because colors of training pictures have an unknown exposure and tone curve, and hold highlights.
    Irradiance below a fiftieth of its 99th percentile counts as that much, so that dark splats have a bounded albedo.

    Args:
        splats: The cloud.
        transport: Result of `splat_transport`.
        captured: The light of the training pictures. If None, the light is assumed to be white and the same from all
            directions, and so bright that the 99th percentile of the albedo is 0.8.

    Returns:
        Albedo from 0 to 1, in linear Rec. 709.
    """
    light = Environment(jnp.ones((6, 1, 1, 1))) if captured is None else captured
    white = white_radiance(transport, light)
    albedo = splats.color / np.maximum(white, max(_DIM * np.percentile(white, _BRIGHT), 1e-30))
    if captured is None:
        albedo *= _WHITE / max(float(np.percentile(albedo, _BRIGHT)), 1e-30)
    return np.clip(albedo, 0, 1).astype(np.float32)


def white_radiance(transport: PointTransport, light: Environment) -> Float[np.ndarray, "n c"]:
    """Radiance of white, diffuse splats: irradiance / pi. Where harmonics ring below zero it is zero."""
    return np.maximum(np.asarray(transport.apply(light)), 0) / np.pi


def relit(
    splats: Splats,
    transport: PointTransport,
    albedo: Float[np.ndarray | Array, "n 3"],
    light: Environment,
    *,
    stops: float | None = None,
) -> Splats:
    """The cloud in another light, as diffuse splats: the color is albedo times irradiance / pi, encoded as sRGB.

    Args:
        splats: The cloud.
        transport: Result of `splat_transport`.
        albedo: Diffuse reflectance of each splat, such as a result of `albedo_guess`.
        light: The light.
        stops: Exposure. If None, the 99th percentile of the luminance is brought to 0.9; see
            `jaxprt.image.automatic_exposure`.

    Returns:
        The cloud with other f_dc, and f_rest of zero. All other fields are unchanged.

    Raises:
        ValueError: The albedo or the transport is of another number of splats.
    """
    for name, rows in (("albedo", albedo), ("transport", np.zeros(transport.points))):
        require.length(f"rows of the {name}", rows, len(splats))
    radiance = jnp.asarray(np.asarray(albedo) * white_radiance(transport, light), jnp.float32)
    exposure = image.automatic_exposure(radiance[None]) if stops is None else stops
    color = np.asarray(image.display(radiance, stops=exposure))
    record = splats.record.copy()
    for channel, name in enumerate(_COLOR):
        record[name] = (color[:, channel] - 0.5) / _CONSTANT
    for name in record.dtype.names or ():
        if name.startswith("f_rest_"):
            record[name] = 0
    return dataclasses.replace(splats, record=record)
