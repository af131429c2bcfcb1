"""Surfaces that are lit and seen from both sides: their backs become faces of their own.

Transport at a vertex holds the hemisphere of its normal alone. A face whose back is lit therefore gets a reversed copy
at the same place, with vertices of its own, whose normals point the other way. Both shells are then seen from their
fronts only.
"""

import dataclasses

import jax
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float, Int

from jaxprt.scene.material import TexturedMaterial
from jaxprt.scene.mesh import Mesh
from jaxprt.scene.scene import Part, Scene, centered
from jaxprt.scene.subdivision import places

_THIN = 1e-9  # volume of a closed surface, relative to the cube of its extent, below which it encloses nothing
_INSIDE = 0.5  # winding number from which on a point is inside


def two_sided(scene: Scene) -> Scene:
    """The scene with a reversed copy of each face whose back is lit and can be seen.

    Faces are copied if their material has `back="lit"`, unless nothing sees their back: they belong to a closed surface
    with outward faces, without holes, that contains no camera of the scene; or the mesh has a reversed copy of
    them already. The copies, with their vertices, follow those of their part. Materials then have `back="hidden"`, so
    that a scene without lit backs, or one that this function has made, is returned unchanged.

    Args:
        scene: The scene.
    """
    return with_copies(scene)[0]


def with_copies(scene: Scene) -> tuple[Scene, tuple[Int[np.ndarray, " _"], ...]]:
    """The result of `two_sided`, and for each part, the vertices of which the added ones are copies.

    Args:
        scene: The scene.
    """
    none = np.zeros(0, np.int64)
    materials = (part.material for part in scene.parts)
    lit = [value if isinstance(value, TexturedMaterial) and value.back == "lit" else None for value in materials]
    if not any(lit):
        return scene, (none,) * len(lit)
    rows = zip(scene.parts, lit, _visible_backs(centered(scene)), strict=True)
    pairs = (_double(part, material, face) if material else (part, none) for part, material, face in rows)
    parts, copied = zip(*pairs, strict=True)
    return dataclasses.replace(scene, parts=list(parts)), copied


def hidden_backs(scene: Scene) -> Bool[np.ndarray, " n"]:
    """Whether cameras see through the back of each part, so that they see what is behind it."""
    return np.array(
        [isinstance(part.material, TexturedMaterial) and part.material.back != "black" for part in scene.parts]
    )


def _visible_backs(scene: Scene) -> list[Bool[np.ndarray, " f"]]:
    """Whether something may see the back of each face, for each part."""
    mesh = scene.mesh
    face, position = np.asarray(mesh.face), np.asarray(mesh.position, np.float64)
    corner = places(position)[face]
    piece = _pieces(corner)
    clear = np.zeros(len(position)) if mesh.opacity is None else np.asarray(mesh.opacity.layer) > 0
    pierced = np.bincount(piece, clear[face[:, 0]]) > 0
    closed = _is_closed(corner, piece) & ~pierced & (_volumes(position[face], piece) > 0)
    for camera in scene.cameras:
        closed &= _windings(position[face], piece, np.asarray(camera.eye, np.float64)) < _INSIDE
    seen = ~closed[piece] & ~_has_twin(corner)
    return np.split(seen, np.cumsum([len(part.mesh.face) for part in scene.parts])[:-1])


def _pieces(corner: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, " f"]:
    """Connected piece of each face; faces that share a position are connected."""
    count = int(corner.max()) + 1
    ends = corner.ravel(), np.roll(corner, 1, 1).ravel()
    graph = scipy.sparse.coo_array((np.ones(corner.size, bool), ends), (count, count))
    label = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    return np.unique(label[corner[:, 0]], return_inverse=True)[1].reshape(-1)


def _is_closed(corner: Int[np.ndarray, "f 3"], piece: Int[np.ndarray, " f"]) -> Bool[np.ndarray, " n"]:
    """Whether each piece is closed and consistently oriented: its faces run along each edge equally often both ways."""
    count = int(corner.max()) + 1
    start, end = corner.astype(np.int64), np.roll(corner, -1, 1).astype(np.int64)
    solid = start != end
    key = np.minimum(start, end) * count + np.maximum(start, end)
    edge, number = np.unique(key[solid], return_inverse=True)
    balance = np.bincount(number.reshape(-1), np.where(start < end, 1, -1)[solid], len(edge))
    owner = np.zeros(len(edge), np.int64)
    owner[number.reshape(-1)] = np.repeat(piece[:, None], 3, 1)[solid]
    return np.bincount(owner, balance != 0, int(piece.max()) + 1) == 0


def _volumes(corner: Float[np.ndarray, "f 3 3"], piece: Int[np.ndarray, " f"]) -> Float[np.ndarray, " n"]:
    """Volume that each piece encloses, in cubes of its extent; 0 where it is too thin to tell."""
    count = int(piece.max()) + 1
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, piece, corner.min(1))
    np.maximum.at(high, piece, corner.max(1))
    extent = np.linalg.norm(high - low, axis=1)
    extent = np.where(extent > 0, extent, 1)
    a, b, c = np.moveaxis((corner - ((low + high) / 2)[piece, None]) / extent[piece, None, None], 1, 0)
    volume = np.bincount(piece, np.sum(a * np.cross(b, c), 1) / 6, count)
    return np.where(np.abs(volume) > _THIN, volume, 0)


def _windings(
    corner: Float[np.ndarray, "f 3 3"], piece: Int[np.ndarray, " f"], point: Float[np.ndarray, "3"]
) -> Float[np.ndarray, " n"]:
    """How often each piece winds around a point: 1 inside of a closed piece with outward faces, 0 outside."""
    a, b, c = np.moveaxis(corner - point, 1, 0)
    # Van Oosterom and Strackee 1983, "The solid angle of a plane triangle".
    la, lb, lc = (np.linalg.norm(edge, axis=1) for edge in (a, b, c))
    below = la * lb * lc + np.sum(a * b, 1) * lc + np.sum(b * c, 1) * la + np.sum(c * a, 1) * lb
    angle = 2 * np.arctan2(np.sum(a * np.cross(b, c), 1), below)
    return np.bincount(piece, angle) / (4 * np.pi)


def _has_twin(corner: Int[np.ndarray, "f 3"]) -> Bool[np.ndarray, " f"]:
    """Whether there is a face with the same corners and the opposite orientation."""
    order = np.argsort(corner, axis=1)
    odd = (order[:, 0] > order[:, 1]) ^ (order[:, 0] > order[:, 2]) ^ (order[:, 1] > order[:, 2])
    rows, number = np.unique(np.take_along_axis(corner, order, 1), axis=0, return_inverse=True)
    sides = np.zeros((len(rows), 2), bool)
    sides[number.reshape(-1), odd.astype(int)] = True
    return sides[number.reshape(-1), 1 - odd.astype(int)]


def _double(
    part: Part, material: TexturedMaterial, copied: Bool[np.ndarray, " f"]
) -> tuple[Part, Int[np.ndarray, " _"]]:
    """The part with reversed copies of some faces, and the vertices that were copied."""
    material = dataclasses.replace(material, back="hidden")
    mesh, count = part.mesh, len(part.mesh.position)
    vertex, corner = np.unique(np.asarray(mesh.face)[copied], return_inverse=True)
    if not len(vertex):
        return dataclasses.replace(part, material=material), vertex

    def rows(value: Array | np.ndarray | None, sign: float = 1.0) -> Array | None:
        """Values of all vertices and of their copies."""
        return None if value is None else jax.device_put(np.concatenate([value, sign * np.asarray(value)[vertex]]))

    face = np.concatenate([mesh.face, count + corner.reshape(-1, 3)[:, ::-1]]).astype(np.int32)
    region = np.concatenate([mesh.region, np.asarray(mesh.region)[vertex]])
    # Opposite frames: normal maps bend both sides as one surface, and a bump of the front is a dent of the back.
    frame = rows(mesh.normal, -1.0), rows(mesh.tangent, -1.0)
    whole = Mesh(rows(mesh.position), face, *frame, region, rows(mesh.texture), mesh.origin)
    side = np.ones(count, np.float32) if part.handedness is None else part.handedness
    colors = rows(part.color), rows(part.second), rows(side, -1.0), rows(part.alpha)
    return Part(part.name, whole, material, *colors), vertex
