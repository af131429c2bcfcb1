"""Origins of the rays of vertices: off the surface by what rounding needs, and on the open side of what touches it."""

import numpy as np
from jaxtyping import Bool, Float, Float32

from jaxprt.scene.mesh import Mesh
from jaxprt.visibility.buried import out_of_solids
from jaxprt.visibility.occluder import Occluder, check, offsets

# Largest depth of a vertex inside a simplified occluder, as a share of the scene's diagonal, and of the longest edge of
# the triangle above.
_SINK, _SINK_EDGE = 0.02, 1.0
_BACK = 1.25  # how far rays go back to the vertex, in offsets
_STEEPEST = 0.25  # smallest cosine between the direction off the surface and the normals of faces around a vertex
_TURNS = 16  # steps that turn this direction off faces which it grazes
_INWARD, _FLAT = 4.0, 0.999  # step to the inside of faces, in offsets, and smallest cosine between faces of one plane


def start_points(
    mesh: Mesh, occluder: Occluder, *, offset: Float[np.ndarray, " f"] | None = None, apart: bool = False
) -> Float32[np.ndarray, "v 3"]:
    """Origins of the rays of each vertex, slightly off the surface.

    The origin lies on the side of all faces around the vertex to which its shading normal points. A face therefore
    never shadows its own front, however far the shading normal leans. The distance from these faces is what rounding
    needs there. If a vertex lies inside a simplified occluder, its rays start where they leave the occluder. If a
    vertex touches another surface, its rays start on the open side of that surface, so that light does not leak in
    from below. If a vertex lies inside of another solid, its rays start where its triangles come out of it.

    Args:
        mesh: The mesh.
        occluder: Geometry that casts shadows.
        offset: Distance of the origins from each face of the mesh; None computes it from the face's corners. A face
            that lies in a larger triangle of the occluder needs the offset of that triangle.
        apart: Whether the regions of the mesh are separate surfaces. Faces at the same position in another region then
            do not count as faces around a vertex.

    Raises:
        ValueError: The mesh has no faces, a face refers to a missing vertex, or positions, normals or tangents are not
            finite.
    """
    return starts_and_buried(mesh, occluder, offset=offset, apart=apart)[0]


def starts_and_buried(
    mesh: Mesh, occluder: Occluder, *, offset: Float[np.ndarray, " f"] | None = None, apart: bool = False
) -> tuple[Float32[np.ndarray, "v 3"], Bool[np.ndarray, " v"]]:
    """The result of `start_points`, and whether each vertex lies inside of another solid."""
    check(mesh, "mesh")
    position, face = np.asarray(mesh.position, np.float32), np.asarray(mesh.face)
    out, steepness = _outward(mesh, apart)
    distance = offsets(position, np.arange(len(position))[:, None])  # of vertices without faces
    np.maximum.at(distance, face.ravel(), np.repeat(offsets(position, face) if offset is None else offset, 3))
    distance = (distance / np.maximum(steepness, _STEEPEST))[:, None].astype(np.float32)
    start = position + distance * (out + _inward(position, face, out))
    foreign = ~np.isin(_rows(position), _rows(occluder.position[np.unique(occluder.face)]))
    if foreign.any():
        start[foreign] = _surface(occluder, position[foreign], out[foreign], distance[foreign])
    exact = ~foreign
    if exact.any():
        start[exact] = _off_contact(occluder, position[exact], start[exact], out[exact], distance[exact])
    return out_of_solids(mesh, occluder, start, out, distance)


def _inward(position: np.ndarray, face: np.ndarray, out: np.ndarray) -> Float32[np.ndarray, "v 3"]:
    """Steps along the surface, in offsets, from vertices at the border of flat faces to the inside of these faces.

    Where such a vertex lies in a wall that stands on its face, rays start in front of the wall, and not in it.
    """
    position = position.astype(np.float64)
    toward = position[face].mean(1)[:, None] - position[face]
    toward /= np.maximum(np.linalg.norm(toward, axis=-1, keepdims=True), 1e-30)
    count = np.maximum(np.bincount(face.ravel(), minlength=len(position)), 1)[:, None]
    mean = _added(face.ravel(), toward.reshape(-1, 3), len(position)) / count
    # Faces that are not in one plane have no inside that is above all of them.
    flat = np.ones(len(position))
    np.minimum.at(
        flat, face.ravel(), np.abs(np.sum(np.repeat(_face_normal(position, face), 3, 0) * out[face.ravel()], 1))
    )
    mean -= np.sum(mean * out, 1, keepdims=True) * out
    return (_INWARD * np.where(flat[:, None] > _FLAT, mean, 0)).astype(np.float32)


def _rows(position: np.ndarray) -> np.ndarray:
    """Each position as one opaque item, so that whole positions can be compared; -0 becomes 0."""
    return np.ascontiguousarray(position + np.float32(0)).view(np.dtype((np.void, 12))).ravel()


def _face_normal(position: np.ndarray, face: np.ndarray) -> np.ndarray:
    """Unit face normals from the winding order; zero for degenerate faces."""
    a, b, c = (position[face[:, i]].astype(np.float64) for i in range(3))
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)


def _outward(mesh: Mesh, apart: bool) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors that point off the surface, to the side of each vertex's shading normal.

    They average the normals of all faces at the same position. Where vertices are split along a crease, faces across
    the crease count too; otherwise a ray could start inside of them. With `apart`, they count within a region. Where
    the mean grazes a face, or is behind it, the vector is turned off that face.

    Returns:
        The vectors, and for each vertex the smallest cosine between its vector and the normals of the faces that count.
    """
    position, face, normal = np.asarray(mesh.position), np.asarray(mesh.face), np.asarray(mesh.normal, np.float64)
    facing = _face_normal(position, face)
    sided = np.stack(
        [np.where(np.sum(facing * normal[corner], 1) < 0, -1.0, 1.0)[:, None] * facing for corner in face.T]
    )
    of_vertex = _added(face.T.ravel(), sided.reshape(-1, 3), len(normal))
    _, place = np.unique(_rows(position), return_inverse=True)
    if apart:
        _, place = np.unique(place + len(position) * np.asarray(mesh.region, np.int64), return_inverse=True)
    joint = _added(place, of_vertex, len(normal))[place]
    # The normals of the two sides of a sheet cancel; each vertex then uses its own faces only.
    shared = np.sum(joint * of_vertex, 1) > 1e-6 * np.sum(of_vertex * of_vertex, 1)
    total = np.where(shared[:, None], joint, of_vertex)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    out = np.where(length > 1e-6, total / np.maximum(length, 1e-6), normal)
    # Vertices with the same faces have the same vector: number them, and keep the faces with an area.
    joined = np.where(shared, place, len(normal) + np.arange(len(normal)))
    _, first, group = np.unique(joined, return_index=True, return_inverse=True)
    solid = np.any(facing, axis=1)
    steepness, turned = _off_faces(out[first], group[face[solid].T.ravel()], sided[:, solid].reshape(-1, 3))
    return turned[group].astype(np.float32), steepness[group]


def _off_faces(out: np.ndarray, group: np.ndarray, facing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Turns vectors off the faces that they graze, by steps towards the normal of the worst face.

    Args:
        out: Unit vectors.
        group: Index of the vector of each corner of a face.
        facing: Unit normal of the face of each corner, on the vector's side.

    Returns:
        For each vector the smallest cosine with the normals of its faces, and the turned vectors.
    """

    def smallest(vector: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        cosine, least = np.sum(facing * vector[group], 1), np.ones(len(vector))
        np.minimum.at(least, group, cosine)
        return cosine, least

    cosine, least = smallest(out)
    grazing = least < _STEEPEST
    if not grazing.any():
        return least, out
    touched = grazing[group]
    group, facing = group[touched], facing[touched]
    best, vector, steepness = out.copy(), out.copy(), np.where(grazing, least, 1.0)
    for _ in range(_TURNS):
        cosine, now = smallest(vector)
        better = grazing & (now > steepness)
        best[better], steepness[better] = vector[better], now[better]
        worst = cosine <= now[group]
        vector[group[worst]] += 0.5 * facing[worst]
        vector /= np.linalg.norm(vector, axis=1, keepdims=True)
    return np.where(grazing, steepness, least), best


def _added(index: np.ndarray, vector: np.ndarray, count: int) -> np.ndarray:
    """Sums of vectors by index."""
    return np.stack([np.bincount(index, vector[:, axis], count) for axis in range(3)], 1)


def _surface(occluder: Occluder, position: np.ndarray, out: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Ray origins of vertices that are not vertices of the occluder, which then only approximates the mesh."""
    triangle, distance, _ = occluder.hit(position - offset * out, out, solid=True)
    corner = occluder.position[occluder.face[triangle]]
    edge = np.linalg.norm(corner - np.roll(corner, 1, 1), axis=2).max(1)
    sink = np.minimum(_SINK * occluder.diagonal, _SINK_EDGE * edge)
    facing = _face_normal(occluder.position, occluder.face)[triangle]
    leaving = (triangle >= 0) & (distance < sink) & (np.sum(facing * out, 1) > 0)
    depth = np.where(leaving, distance + occluder.offset[triangle], offset[:, 0])
    return (position + depth[:, None] * out).astype(np.float32)


def _off_contact(
    occluder: Occluder, position: np.ndarray, start: np.ndarray, out: np.ndarray, offset: np.ndarray
) -> np.ndarray:
    """Moves ray origins that were pushed through a touching surface back to its open side, by reflection.

    A ray traced back towards the vertex meets a touching surface from behind, and the vertex's own faces from the
    front. Rays beside the vertex find a touching surface even where it passes through the vertex.
    """
    facing = _face_normal(occluder.position, occluder.face)
    side = np.cross(out, np.eye(3, dtype=np.float32)[np.argmin(np.abs(out), 1)])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    result = start.copy()
    open_start = np.ones(len(start), bool)
    for beside in (0 * side, side, -side, np.cross(out, side), -np.cross(out, side)):
        triangle, distance, _ = occluder.hit(start + offset / 2 * beside, -out, solid=True)
        # Distances of a few spacings of float32 are themselves rounded by one or two.
        hit = np.flatnonzero(open_start & (triangle >= 0) & (distance < _BACK * offset[:, 0]))
        if not hit.size:
            continue
        back = facing[triangle[hit]]
        corner = occluder.position[occluder.face[triangle[hit]]]
        # The two sides of a seam may differ by rounding.
        seam = np.abs(corner - position[hit, None]).max(2).min(1, initial=np.inf) <= offset[hit, 0] / 4
        touching = ~seam & (np.sum(back * out[hit], 1) < 0)
        hit, back, corner = hit[touching], back[touching], corner[touching]
        height = np.sum((corner[:, 0] - start[hit]) * back, 1, keepdims=True)
        result[hit] = start[hit] + 2 * height * back
        open_start[hit] = False
    return result
