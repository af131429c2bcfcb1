"""Triangle meshes: construction from files and arrays, joining, splitting, rotation, and a ground plane."""

import dataclasses
import math
import pathlib
from collections.abc import Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int, Integer

from jaxprt import require
from jaxprt.scene import origin as origins
from jaxprt.scene.formats.geometry import Geometry, has_area, rows_of
from jaxprt.sphere import directions

BLEND = -1.0  # in place of a cutoff, for surfaces that stop the share alpha
CLEAR = 1 / 512  # share of light that no 8-bit image resolves: less is nothing, and all but this is everything
# Axes after the first of each field of a mesh, and whether it holds integers.
_FIELDS = {
    "position": ((3,), False),
    "face": ((3,), True),
    "normal": ((3,), False),
    "tangent": ((3,), False),
    "region": ((), True),
    "texture": ((2,), False),
}
_WRONG = float, complex, str, bytes, list, tuple, dict, set
_CREASE = np.cos(np.radians(40))  # smallest cosine between a shared normal and that of each split vertex
_GAP = 5e-4  # gap above the ground, relative to the diagonal; larger than the offset of ray origins
_BLOCK = 8192
_DENSE = 0.4  # spacing of the ground's vertices at its center, relative to that of a uniform grid


class Opacity(eqx.Module):
    """Opacity of the vertices of a mesh, and the images that multiply it.

    The opacity of a point is interpolated between the vertices and multiplied by the texel. All arrays are in NumPy.

    Attributes:
        coordinate: Where each vertex lies in its image; v points up.
        factor: Opacity of each vertex, without its image.
        layer: Row of each vertex in the fields below; row 0 is opaque.
        cutoff: Opacity from which on the surface is there; `BLEND` for surfaces that stop this share of light.
        wrap: Wrap mode of the image along u and v, as an index into `texture.WRAPS`.
        start: Index of the image's first texel; -1 without an image.
        shape: Height and width of the image.
        texel: The texels of all images, row by row, first row on top.
        passing: Color of the light that passes each layer, relative to its mean: 1 for alpha, a tint for glass.
        glass: Whether a layer lets light through without being reflected less, as glass does and holes do not.
    """

    coordinate: Float[Array | np.ndarray, "v 2"]
    factor: Float[Array | np.ndarray, " v"]
    layer: Int[Array | np.ndarray, " v"]
    cutoff: Float[Array | np.ndarray, " m"]
    wrap: Int[Array | np.ndarray, "m 2"]
    start: Int[Array | np.ndarray, " m"]
    shape: Int[Array | np.ndarray, "m 2"]
    texel: Float[Array | np.ndarray, " t"]
    passing: Float[Array | np.ndarray, "m 3"]
    glass: Bool[Array | np.ndarray, " m"]

    @property
    def blends(self) -> bool:
        """Whether some surfaces stop a share of the light."""
        return bool(np.any(np.asarray(self.cutoff) == BLEND))


def _as_array(value: object) -> Any:
    """NumPy arrays and lists of real numbers as JAX arrays, in float32 and int32 unless float64 is enabled."""
    if isinstance(value, jax.Array) or not isinstance(value, np.ndarray | list | tuple):
        return value
    if require.unreal(value):
        return value
    known = np.asarray(value)
    if jnp.issubdtype(known.dtype, jnp.floating):
        return require.floating(value)
    return jax.device_put(known.astype(np.int32)) if np.all(np.abs(known) < 2**31) else value


def _check_shapes(mesh: "Mesh") -> None:
    """Refuses a mesh whose arrays have other types than its fields, or other lengths than its positions."""
    origin = mesh.origin
    if (
        not isinstance(origin, tuple)
        or len(origin) != 3
        or not all(type(x) is float and math.isfinite(x) for x in origin)
    ):
        got = require.shown(origin)
        raise ValueError(f"origin of a mesh must be a tuple of three finite numbers of class float, got {got}")
    for name, (width, whole) in _FIELDS.items():
        value = getattr(mesh, name)
        # Placeholders such as the axes of `jax.vmap` pass.
        if not isinstance(value, jax.Array | np.ndarray):
            if isinstance(value, _WRONG):
                raise TypeError(
                    f"{name} of a mesh must be an array of numbers, got one of class {type(value).__name__}"
                )
            continue
        require.real(f"{name} of a mesh", value)
        if not jnp.issubdtype(value.dtype, jnp.integer if whole else jnp.floating):
            kind = "integers" if whole else "real numbers"
            raise TypeError(f"{name} of a mesh must be {kind}, got {value.dtype}: `make_mesh` converts lists")
        rows = None if name in ("face", "position") else np.shape(mesh.position)[:1]
        shape = value.shape
        if shape[1:] != width or not shape or (rows and shape[:1] != rows):
            count = "any" if not rows else rows[0]
            required = ", ".join(map(str, (count, *width)))
            raise ValueError(f"{name} of a mesh must be [{required}], got {list(shape)}")


def check_mesh(value: object) -> None:
    """Refuses anything but a mesh."""
    if not all(hasattr(value, field) for field in _FIELDS):
        source = "jaxprt.scene.mesh.make_mesh or jaxprt.load_mesh"
        raise TypeError(f"the mesh must be of class Mesh, which {source} makes, got {require.shown(value)}")


def _check_meshes(value: object) -> None:
    """Refuses anything but a list of meshes, by TypeError."""
    if not isinstance(value, list | tuple):
        raise TypeError(f"meshes must be a list of meshes, got {require.shown(value)}")
    for mesh in value:
        check_mesh(mesh)


def check_kinds(mesh: Any, name: str) -> None:
    """Refuses a mesh with fields that are not arrays, which only placeholders are."""
    for field in _FIELDS:
        value = getattr(mesh, field)
        if value is not None or field != "texture":
            require.array(f"{field} of {name}", value, "v", "v _")


def check_values(mesh: Any, name: str) -> None:
    """Refuses a mesh with values that are not finite, or faces that refer to missing vertices."""
    check_kinds(mesh, name)
    for field in _FIELDS:
        value = getattr(mesh, field)
        if value is not None:
            require.finite(f"{field} of {name}", value)
    if len(mesh.face) and len(mesh.position):
        require.within(f"faces of {name}", mesh.face, 0, len(mesh.position) - 1)
    if len(mesh.region):
        require.within(f"regions of {name}", mesh.region, 0, 2**31 - 1)


def vertex_normals(
    position: Float[np.ndarray, "v 3"], face: Integer[np.ndarray, "f 3"], welded: bool
) -> Float[np.ndarray, "v 3"]:
    """Unit normals: means of face normals, weighted by their angles at the vertex.

    Args:
        position: Positions of the vertices, in float64.
        face: Vertex indices of each triangle.
        welded: Whether vertices at one position share such a mean, unless they form a crease.
    """
    corner = position[face]
    edge = np.roll(corner, -1, 1) - corner
    cross = np.cross(edge[:, 0], edge[:, 1])
    area = np.linalg.norm(cross, axis=1)
    # The normal of a face thinner than the resolution of float32 is only rounding error.
    thickness = 2 * np.spacing(np.abs(corner).max((1, 2)).astype(np.float32)).astype(np.float64)
    thin = area <= thickness * np.linalg.norm(edge, axis=2).max(1)
    unit = cross / np.where(area > 0, area, 1)[:, None]
    angle = np.arctan2(area[:, None], -(edge * np.roll(edge, 1, 1)).sum(2))
    weighted = (np.where(thin[:, None], 0, angle)[:, :, None] * unit[:, None]).reshape(-1, 3)

    def mean(index, count):
        total = np.stack([np.bincount(index, weighted[:, axis], count) for axis in range(3)], -1)
        length = np.linalg.norm(total, axis=1, keepdims=True)
        return np.where(length > 1e-6, total / np.maximum(length, 1e-6), 0)

    vertex = face.ravel()
    normal = mean(vertex, len(position))
    if welded:
        _, place = np.unique(position, axis=0, return_inverse=True)
        shared = mean(place.reshape(-1)[vertex], place.max() + 1)[place.reshape(-1)]
        smooth = (shared * normal).sum(1, keepdims=True) > _CREASE
        normal = np.where(smooth, shared, normal)
    # Where face normals cancel, any of them is used, thin faces last.
    order = np.argsort(~thin, kind="stable")
    some = np.tile([0.0, 1.0, 0.0], (len(position), 1))
    order = order[area[order] > 0]
    some[face[order]] = unit[order, None]
    return np.where((normal == 0).all(1, keepdims=True), some, normal)


class Mesh(eqx.Module):
    """A triangle mesh with one shading frame per vertex.

    Attributes:
        position: Vertex positions in world units, relative to the origin.
        face: Vertex indices of each triangle, counterclockwise as seen from the front.
        normal: Unit shading normals.
        tangent: Unit tangents, orthogonal to the normals.
        region: Index of the material region that each vertex belongs to, from 0.
        texture: Texture coordinates (u, v) of each vertex, with (0, 0) at the lower left corner of the image; None if
            there are none.
        origin: Where position (0, 0, 0) is in the coordinates of the mesh's file. It is zero unless the mesh is farther
            from zero than 64 times its size, as at map coordinates, which float32 would round. Scenes, cameras, lamps,
            pictures and `reference.radiance` keep the coordinates of the file. Systems that were precomputed for a mesh
            take eyes relative to the origin.
        opacity: Opacity of the vertices for rays and pictures; None if all are opaque. `jaxprt.Scene.mesh` has it.
    """

    position: Float[Array, "v 3"] = eqx.field(converter=_as_array)
    face: Int[Array, "f 3"] = eqx.field(converter=_as_array)
    normal: Float[Array, "v 3"] = eqx.field(converter=_as_array)
    tangent: Float[Array, "v 3"] = eqx.field(converter=_as_array)
    region: Int[Array, " v"] = eqx.field(converter=_as_array)
    texture: Float[Array, "v 2"] | None = eqx.field(converter=_as_array, default=None)
    origin: origins.Origin = eqx.field(static=True, default=origins.ZERO)
    opacity: Opacity | None = None

    def __check_init__(self):
        """Refuses arrays of other types and lengths. `make_mesh` and `jaxprt.Part` check values too."""
        _check_shapes(self)


@require.arguments(path=partial(require.path, "path"))
def from_file(geometry: Geometry, path: pathlib.Path) -> Mesh:
    """A mesh from the geometry of a file, with the normals and checks of `load_mesh`."""
    frame, welded = (geometry.normal, geometry.tangent), path.suffix.lower() != ".stl"
    fields = geometry.position, geometry.face, *frame, geometry.region, geometry.texture
    mesh = _make(*fields, name=str(path), welded=welded)
    count = len(geometry.face)
    blocks = (geometry.face[first : first + _BLOCK] for first in range(0, count, _BLOCK))
    if not any(has_area(geometry.position, block).any() for block in blocks):
        raise ValueError(f"{path} must hold faces with an area, got {count} faces without: nothing of them is visible")
    return mesh


def make_mesh(
    position: Float[ArrayLike, "v 3"],
    face: Integer[ArrayLike, "f 3"],
    *,
    normal: Float[ArrayLike, "v 3"] | None = None,
    tangent: Float[ArrayLike, "v 3"] | None = None,
    region: Integer[ArrayLike, " v"] | None = None,
    texture: Float[ArrayLike, "v 2"] | None = None,
    name: str = "mesh",
) -> Mesh:
    """Makes a mesh from arrays in memory, with the checks of ``load_mesh``.

    Args:
        position: Vertex positions in world units.
        face: Vertex indices of each triangle, counterclockwise as seen from the front.
        normal: Normals of any length. Normals that are zero or NaN, and all if None, become means of the adjacent face
            normals, weighted by angle. For a crease, split the vertex. If the face normals cancel, one of them is used;
            a vertex without faces gets +y.
        tangent: Tangents of any length; they are made orthogonal to the normals. If None, and for tangents that are
            zero, NaN or parallel to the normal, ``directions.tangent`` is used.
        region: Index of each vertex's region, from 0; None makes all 0.
        texture: Texture coordinates, (0, 0) at the lower left corner of the image and (1, 1) at the upper right one.
        name: Name of the mesh in error messages.

    Returns:
        The mesh, in float32 and int32. If it is far from zero, its positions are relative to `Mesh.origin`.

    Raises:
        ValueError: An array has a wrong shape or type, there are no vertices or faces, a position or texture coordinate
            is not finite, a face refers to a missing vertex, or a region is negative.
    """
    return _make(position, face, normal, tangent, region, texture, name=name, welded=False)


def join(meshes: Sequence[Mesh]) -> Mesh:
    """Joins meshes into one. Regions are renumbered consecutively, mesh by mesh.

    Args:
        meshes: One or more meshes. The indices of their regions may have gaps.

    Returns:
        The joined mesh; ``split`` takes it apart again. If only some meshes have texture coordinates, those of the
        others are (0, 0).

    Raises:
        ValueError: There are no meshes.
    """
    _check_meshes(meshes)
    if not meshes:
        raise ValueError("meshes must hold at least one mesh, got none")
    meshes = aligned(meshes)
    region, face = [], []
    first_region = first_vertex = 0
    for mesh in meshes:
        used, dense = np.unique(mesh.region, return_inverse=True)
        region.append(dense + first_region)
        face.append(np.asarray(mesh.face) + first_vertex)
        first_region += len(used)
        first_vertex += len(mesh.position)
    # NumPy, here and below, so that new shapes do not cause compilation.
    position, normal, tangent = (
        jax.device_put(np.concatenate([getattr(mesh, field) for mesh in meshes]))
        for field in ("position", "normal", "tangent")
    )
    face, region = (jax.device_put(np.concatenate(field).astype(np.int32)) for field in (face, region))
    texture = None
    if any(mesh.texture is not None for mesh in meshes):
        coordinates = [np.zeros((len(mesh.position), 2)) if mesh.texture is None else mesh.texture for mesh in meshes]
        texture = jax.device_put(np.concatenate(coordinates).astype(position.dtype))
    return Mesh(position, face, normal, tangent, region, texture, meshes[0].origin)


def aligned(meshes: Sequence[Mesh]) -> list[Mesh]:
    """The same meshes with one origin: that of all if they have the same, or else that of the joined mesh."""
    if len({mesh.origin for mesh in meshes}) < 2:
        return list(meshes)
    corner = [np.stack(bounds(mesh)) for mesh in meshes]
    origin = origins.mesh_origin(np.concatenate(corner))
    return [relative(mesh, origin) for mesh in meshes]


def relative(mesh: Mesh, origin: origins.Origin) -> Mesh:
    """The same mesh with positions relative to another origin, moved in float64."""
    if mesh.origin == origin:
        return mesh
    shift = np.asarray(mesh.origin) - np.asarray(origin)
    exact = np.asarray(mesh.position, np.float64) + shift
    origins.warn_of_rounding(exact, np.asarray(mesh.face), "the mesh, joined with others")
    position = jax.device_put(exact.astype(mesh.position.dtype))
    return dataclasses.replace(mesh, position=position, origin=origin)


def centered(mesh: Mesh) -> Mesh:
    """The mesh with its origin moved to zero: positions stay as they are."""
    return mesh if mesh.origin == origins.ZERO else dataclasses.replace(mesh, origin=origins.ZERO)


@require.arguments(mesh=check_mesh)
def split(mesh: Mesh) -> list[Mesh]:
    """Splits a mesh into one mesh per region, in ascending order. Each part becomes region 0 of its mesh.

    Raises:
        ValueError: The corners of a face are in different regions. Duplicate such vertices first.
    """
    region, face = np.asarray(mesh.region), np.asarray(mesh.face)
    corner = region[face]
    mixed = np.flatnonzero((corner != corner[:, :1]).any(1))
    if mixed.size:
        raise ValueError(
            f"the corners of a face must be in one region, got {mixed.size} of {len(face)} faces with corners in "
            f"several, the first is face {mixed[0]} in the regions {corner[mixed[0]].tolist()}"
        )
    frame = [np.asarray(field) for field in (mesh.position, mesh.normal, mesh.tangent)]
    place = None if mesh.texture is None else np.asarray(mesh.texture)
    index = np.zeros(len(region), np.int32)
    parts = []
    used = np.unique(region)
    for vertices, faces in zip(rows_of(region, used), rows_of(corner[:, 0], used), strict=True):
        index[vertices] = np.arange(len(vertices))
        position, normal, tangent = (jax.device_put(field[vertices]) for field in frame)
        texture = None if place is None else jax.device_put(place[vertices])
        zero = jax.device_put(np.zeros(len(vertices), np.int32))
        parts.append(Mesh(position, jax.device_put(index[face[faces]]), normal, tangent, zero, texture, mesh.origin))
    return parts


@require.arguments(mesh=check_mesh, rotation=partial(require.rotation, "rotation"))
def rotate(mesh: Mesh, rotation: ArrayLike) -> Mesh:
    """Rotates a mesh about the origin: positions, normals and tangents.

    Raises:
        ValueError: The matrix is not a proper rotation: it mirrors, scales or shears.
    """
    matrix = np.asarray(rotation, np.float64)
    place, normal, tangent = (
        jnp.matmul(vector, jnp.asarray(matrix.T, vector.dtype), precision="highest")
        for vector in (mesh.position, mesh.normal, mesh.tangent)
    )
    x, y, z = (matrix @ np.asarray(mesh.origin)).tolist()
    return Mesh(place, mesh.face, normal, tangent, mesh.region, mesh.texture, (x, y, z), mesh.opacity)


@require.arguments(mesh=check_mesh, direction=partial(require.real, "direction"))
def brush(mesh: Mesh, direction: ArrayLike) -> Mesh:
    """Sets the tangents of a mesh to a direction of brushing, projected to the tangent plane of each vertex.

    Where the direction is parallel to the normal, the default tangent of `sphere.directions` is used instead.

    Args:
        mesh: The mesh.
        direction: Direction in world coordinates, of any length. Either one for all vertices, or one for each vertex,
            such as the result of `texture.dpdu`. A zero direction of a single vertex counts as parallel to the normal.

    Raises:
        ValueError: The common direction is zero, or a direction is not three finite numbers.

    Reference: Kautz, Sloan, Snyder 2002, section 6.
    """
    along = np.asarray(direction, np.float64)
    if along.ndim > 1:
        along = _finite(along, "direction", mesh.normal.shape, "mesh")
    elif along.shape != (3,) or not np.all(np.isfinite(along)) or not np.any(along):
        raise ValueError(f"direction must be three finite numbers that are not all zero, got {along.tolist()}")
    scaled = along / np.maximum(np.abs(along).max(-1, keepdims=True), np.finfo(np.float64).tiny)
    tangent = jnp.broadcast_to(jnp.asarray(scaled, mesh.normal.dtype), mesh.normal.shape)
    return eqx.tree_at(lambda m: m.tangent, mesh, directions.frame(mesh.normal, tangent)[:, 0])


@require.arguments(mesh=check_mesh, vertices=partial(require.count, "vertices", least=-1, most=1 << 26))
def ground_plane(mesh: Mesh, *, vertices: int = 22000, extent: float = 4.0) -> Mesh:
    """A square ground plane centered under a mesh.

    It lies below the lowest face by 5e-4 of the mesh's diagonal. Compared with a uniform grid, vertices are 2.5 times
    as dense at the center and half as dense at the edge, because shadows are sharpest where the mesh touches the
    ground.

    Args:
        mesh: The mesh that stands on the ground. Vertices without faces do not count.
        vertices: Approximate number of vertices. The nearest square number of at least 4 is used.
        extent: Side of the square, relative to the longer horizontal side of the mesh.

    Returns:
        A mesh of one region with normals +y.

    Raises:
        ValueError: Fewer than 4 vertices, or an extent that is not positive.
    """
    if vertices < 4:
        raise ValueError(f"vertices must be at least 4, got {vertices}")
    require.number("extent", extent, 0.0, above=True)
    low, high = bounds(mesh)
    diagonal = float(np.linalg.norm(high - low)) or 1.0
    half = extent / 2 * (max(high[0] - low[0], high[2] - low[2]) or diagonal)
    n = max(2, round(vertices**0.5))
    u = np.linspace(-1, 1, n)
    z, x = np.meshgrid(*[half * (_DENSE * u + (1 - _DENSE) * u**3)] * 2, indexing="ij")
    center = (low + high) / 2
    height = np.full_like(x, low[1] - _GAP * diagonal)
    position = np.stack([center[0] + x, height, center[2] + z], -1).reshape(-1, 3)
    return make_mesh(position, grid_face(rows=n, columns=n), name="ground plane")


def bounds(mesh: Mesh) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Lowest and highest coordinates of the bounding box, in float64 and in the coordinates of the mesh's file.

    Vertices without faces do not count.
    """
    corner = np.asarray(mesh.position, np.float64)[np.asarray(mesh.face)].reshape(-1, 3)
    return corner.min(0) + mesh.origin, corner.max(0) + mesh.origin


def grid_face(*, rows: int, columns: int) -> Int[np.ndarray, "f 3"]:
    """Triangles of a grid of vertices. The front is the side to which (next row) x (next column) points."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1, 1)
    return (corner + np.array([0, columns, columns + 1, 0, columns + 1, 1])).reshape(-1, 3)


def _make(position, face, normal, tangent, region, texture, *, name: str, welded: bool) -> Mesh:
    position = _array(position, "position", (None, 3), name)
    count = len(position)
    face = _array(face, "face", (None, 3), name, whole=True)
    region = np.zeros(count, np.int32) if region is None else _array(region, "region", (count,), name, whole=True)
    _check(position, face, region, name)
    used = np.zeros(count, bool)
    used[face.ravel()] = True
    origin = origins.mesh_origin(position[used])
    exact = position.astype(np.float64) - origin
    origins.warn_of_rounding(exact, face, name)
    position = exact.astype(np.float32)
    if texture is not None:
        texture = jax.device_put(_finite(texture, "texture", (count, 2), name).astype(np.float32))
    normal = np.zeros((count, 3)) if normal is None else _array(normal, "normal", (count, 3), name).astype(np.float64)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    bad = ~(np.isfinite(length) & (length > 0))
    normal = np.where(bad, 0, normal) / np.where(bad, 1, length)
    if bad.any():
        normal = np.where(bad, vertex_normals(exact, face, welded), normal)
    tangent = np.zeros((count, 3)) if tangent is None else _array(tangent, "tangent", (count, 3), name)
    tangent = tangent.astype(np.float64)
    tangent = np.where(np.isfinite(tangent).all(1, keepdims=True), tangent, 0)
    normal, tangent = _frame(normal, tangent)
    face, region = (jax.device_put(index.astype(np.int32)) for index in (face, region))
    return Mesh(jax.device_put(position), face, normal, tangent, region, texture, origin)


def _array(value, field: str, shape: tuple[int | None, ...], name: str, *, whole: bool = False) -> np.ndarray:
    """A field as an array, checked for its shape. None in `shape` stands for any size."""
    if isinstance(value, np.ma.MaskedArray | list | tuple):  # lists of different lengths
        require.real(f"{name}: {field}", value)
    array = np.asarray(value)
    fits = array.ndim == len(shape) and all(must in (None, n) for must, n in zip(shape, array.shape, strict=True))
    kinds = (jnp.integer,) if whole else (jnp.integer, jnp.floating)
    if not fits or not any(jnp.issubdtype(array.dtype, kind) for kind in kinds):
        must = f"{'integers' if whole else 'real numbers'} [{', '.join(str(n or 'any') for n in shape)}]"
        raise ValueError(f"{name}: {field} must be {must}, got {array.dtype} {list(array.shape)}")
    return array


def _finite(value, field: str, shape: tuple[int, ...], name: str) -> np.ndarray:
    """A field as an array of finite numbers."""
    array = _array(value, field, shape, name)
    with np.errstate(over="ignore"):
        wrong = np.flatnonzero(~np.isfinite(array.astype(np.float32)).all(1))
    if wrong.size:
        raise ValueError(
            f"{name}: {field} must be finite, got {wrong.size} of {len(array)} that are not, "
            f"the first is {array[wrong[0]].tolist()} at vertex {wrong[0]}"
        )
    return array


def _check(position: np.ndarray, face: np.ndarray, region: np.ndarray, name: str) -> None:
    if not len(position) or not len(face):
        raise ValueError(f"{name} must hold vertices and faces, got {len(position)} vertices and {len(face)} faces")
    _finite(position, "positions", position.shape, name)
    wrong = np.flatnonzero(((face < 0) | (face >= len(position))).any(1))
    if wrong.size:
        raise ValueError(
            f"{name}: faces must refer to vertices 0 to {len(position) - 1}, got {wrong.size} of {len(face)} faces "
            f"that refer to others, the first is {face[wrong[0]].tolist()} at face {wrong[0]}"
        )
    wrong = np.flatnonzero(region < 0)
    if wrong.size:
        raise ValueError(
            f"{name}: regions must not be negative, got {wrong.size} of {len(region)} that are, "
            f"the first is {region[wrong[0]]} at vertex {wrong[0]}"
        )


def _frame(normal: np.ndarray, tangent: np.ndarray) -> tuple[Array, ...]:
    """Unit normals and tangents, computed in blocks of one shape so that new meshes do not cause compilation."""
    count = len(normal)
    pad = ((0, -count % _BLOCK), (0, 0))
    normal, tangent = (np.pad(field.astype(np.float32), pad).reshape(-1, _BLOCK, 3) for field in (normal, tangent))
    unit = [directions.normalize(block) for block in normal]
    across = [directions.frame(n, t)[:, 0] for n, t in zip(unit, tangent, strict=True)]
    return tuple(jax.device_put(np.concatenate(block)[:count]) for block in (unit, across))


def frames(normal: ArrayLike, tangent: ArrayLike) -> Float[np.ndarray, "v 3 3"]:
    """Shading frames of vertices, as `jaxprt.sphere.directions.frame` has them, by one program for any number of them.

    Args:
        normal: Unit normals.
        tangent: Tangents.
    """
    normal, tangent = np.asarray(normal), np.asarray(tangent)
    count = len(normal)
    if not count:
        return np.zeros((0, 3, 3), normal.dtype)
    rows = (
        np.pad(vector, ((0, -count % _BLOCK), (0, 0)), mode="edge").reshape(-1, _BLOCK, 3)
        for vector in (normal, tangent)
    )
    return np.concatenate([np.asarray(directions.frame(*row)) for row in zip(*rows, strict=True)])[:count]


def areas(mesh: Mesh) -> Float[np.ndarray, " v"]:
    """A third of the area of the triangles around each vertex: weights for means over the surface."""
    face = np.asarray(mesh.face)
    corner = np.asarray(mesh.position, np.float64)[face]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1) / 2
    return np.bincount(face.ravel(), np.repeat(area / 3, 3), len(mesh.position))
