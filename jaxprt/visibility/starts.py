"""Origins of the rays of vertices: off the surface by what rounding needs, and on the open side of what touches it.

Such a vertex sees nothing, and no picture shows it. But visibility is interpolated over its triangles, so the part of
them outside of the solid would turn black towards it. It gets the visibility of the nearest place outside instead.
"""

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from jaxprt.scene.mesh import Mesh
from jaxprt.scene.points import Points
from jaxprt.visibility.occluder import Occluder, check, offsets

_RAYS = 48  # rays over the hemisphere of a vertex, none of which leaves a solid
_BATCHES = [1, 2, 4, 8, 16, 32]  # the first ones of rays that are traced together
_INSIDE = 0.25  # share of these that hit a surface from behind; half of them do beside a second solid
_STEEP = 0.5  # cosine between the normal and rays that count as steep
_CLOSE = 1e-3  # distance of a sheet that covers a vertex, relative to the scene's diagonal
_CROSSINGS = 4  # surfaces that are passed on the way out
# Largest depth of a vertex inside a simplified occluder, as a share of the scene's diagonal, and of the longest edge of
# the triangle above.
_SINK, _SINK_EDGE = 0.02, 1.0
_BACK = 1.25  # how far rays go back to the vertex, in offsets
_STEEPEST = 0.25  # smallest cosine between the direction off the surface and the normals of faces around a vertex
_TURNS = 16  # steps that turn this direction off faces which it grazes
_INWARD, _FLAT = 4.0, 0.999  # step to the inside of faces, in offsets, and smallest cosine between faces of one plane


def out_of_solids(
    mesh: Mesh,
    occluder: Occluder,
    start: Float32[np.ndarray, "v 3"],
    out: Float32[np.ndarray, "v 3"],
    offset: Float32[np.ndarray, "v 1"],
    *,
    wanted: Int[np.ndarray, " w"] | slice = slice(None),
) -> tuple[Float32[np.ndarray, "v 3"], Bool[np.ndarray, " v"]]:
    """Moves ray origins of vertices inside of solids to where their triangles come out of these.

    A vertex counts as inside if no ray of its hemisphere escapes, and many hit surfaces from behind, or all steep ones
    a surface so close that no light comes in between, such as the second side of a sheet. Its origin moves
    towards the other corners of its triangles, and the middles of the opposite edges, past the surfaces on the way, to
    the nearest place that is not inside. Vertices whose triangles stay inside keep their origin.

    Args:
        mesh: The mesh.
        occluder: Geometry that casts shadows.
        start: Ray origins on the open side of the mesh's faces.
        out: Unit vectors off the surface.
        offset: Distance of the origins from the surface.
        wanted: Vertices whose origins move; others keep theirs.

    Returns:
        The ray origins, and whether each of the wanted vertices is inside; False for others.
    """
    buried = np.zeros(len(start), bool)
    buried[wanted] = inside(occluder, start[wanted], out[wanted])
    if not buried.any():
        return start, buried
    vertex, goal = _escape_goals(mesh, start, buried)
    place, length = _outside(occluder, start[vertex], goal, out[vertex], offset[vertex, 0])
    reachable = np.flatnonzero(np.isfinite(length))
    reachable = reachable[np.lexsort((length[reachable], vertex[reachable]))]
    reachable = reachable[np.unique(vertex[reachable], return_index=True)[1]]  # the nearest place of each vertex
    result = start.copy()
    result[vertex[reachable]] = place[reachable]
    return result, buried


def inside(
    occluder: Occluder, start: Float32[np.ndarray, "n 3"], out: Float32[np.ndarray, "n 3"]
) -> Bool[np.ndarray, " n"]:
    """Whether ray origins are inside of solids, or just below another sheet: see `out_of_solids`.

    Args:
        occluder: Geometry that casts shadows.
        start: Ray origins.
        out: Unit vectors off the surface. Most points are told by the first ray, which is near this vector.
    """
    number = np.arange(_RAYS) + 0.5
    height = 1 - number / _RAYS
    angle = np.pi * (3 - np.sqrt(5)) * number
    ring = np.sqrt(1 - height**2)
    local = np.stack([ring * np.cos(angle), ring * np.sin(angle), height], -1).astype(np.float32)
    hidden, behind, covered = np.arange(len(start)), np.zeros(len(start)), np.ones(len(start), bool)
    side = np.cross(out, np.eye(3, dtype=np.float32)[np.argmin(np.abs(out), 1)])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(out, side)
    # Most points are told by the first ray. Later ones are traced several at a time, as few are left.
    for ways in np.split(local, _BATCHES):
        height = ways[:, 2:]
        way = ways[:, :1, None] * side[hidden] + ways[:, 1:2, None] * other[hidden] + height[..., None] * out[hidden]
        # Where two faces coincide, `facing_hit` returns the front, so that rays count no backs on sheets.
        flat = way.reshape(-1, 3)
        triangle, distance, _ = occluder.facing_hit(np.tile(start[hidden], (len(ways), 1)), flat)
        back = (occluder.hits_back(triangle, flat) & (triangle >= 0)).reshape(len(ways), -1)
        close = distance.reshape(back.shape) * height < _CLOSE * occluder.diagonal
        behind[hidden] += back.sum(0)
        covered[hidden] &= (close | (height <= _STEEP)).all(0)
        hidden = hidden[(triangle >= 0).reshape(back.shape).all(0)]
        if not hidden.size:
            break
    result = np.zeros(len(start), bool)
    result[hidden] = covered[hidden] | (behind[hidden] >= _INSIDE * _RAYS)
    return result


def _escape_goals(mesh: Mesh, start: np.ndarray, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For each corner of a triangle at a vertex inside of a solid: the vertex, and three goals on the triangle."""
    face = np.asarray(mesh.face)
    vertices, goals = [], []
    for corner in range(3):
        row = face[chosen[face[:, corner]]]
        one, other = start[row[:, (corner + 1) % 3]], start[row[:, (corner + 2) % 3]]
        for goal in (one, other, (one + other) / 2):
            vertices.append(row[:, corner])
            goals.append(goal)
    return np.concatenate(vertices), np.concatenate(goals)


def _outside(
    occluder: Occluder, origin: np.ndarray, goal: np.ndarray, out: np.ndarray, offset: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The first place on each way that is not inside of a solid, and its distance; infinite where there is none."""
    way = goal - origin
    length = np.linalg.norm(way, axis=1)
    way = way / np.maximum(length, 1e-30)[:, None]
    place, travelled = origin.copy(), np.zeros(len(origin), np.float32)
    reached = np.full(len(origin), np.inf, np.float32)
    active = np.flatnonzero(length > 4 * offset)
    for _ in range(_CROSSINGS):
        triangle, distance, _ = occluder.facing_hit(place[active], way[active])
        step = distance + 2 * offset[active]
        on_way = (triangle >= 0) & (travelled[active] + step < length[active])
        active, step = active[on_way], step[on_way]
        if not active.size:
            break
        travelled[active] += step
        place[active] += step[:, None] * way[active]
        done = active[~inside(occluder, place[active], out[active])]
        reached[done] = travelled[done]
        active = np.setdiff1d(active, done)
    return place, reached


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
    return start_points_and_buried(mesh, occluder, offset=offset, apart=apart)[0]


def start_points_and_buried(
    mesh: Mesh,
    occluder: Occluder,
    *,
    offset: Float[np.ndarray, " f"] | None = None,
    apart: bool = False,
    wanted: Int[np.ndarray, " w"] | slice = slice(None),
) -> tuple[Float32[np.ndarray, "v 3"], Bool[np.ndarray, " v"]]:
    """The result of `start_points`, and whether each of the wanted vertices lies inside of another solid."""
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
    return out_of_solids(mesh, occluder, start, out, distance, wanted=wanted)


def _inward(position: np.ndarray, face: np.ndarray, out: np.ndarray) -> Float32[np.ndarray, "v 3"]:
    """Steps along the surface, in offsets, from vertices at the border of flat faces to the inside of these faces."""
    position = position.astype(np.float64)
    toward = position[face].mean(1)[:, None] - position[face]
    toward /= np.maximum(np.linalg.norm(toward, axis=-1, keepdims=True), 1e-30)
    count = np.maximum(np.bincount(face.ravel(), minlength=len(position)), 1)[:, None]
    mean = _sum_by_index(face.ravel(), toward.reshape(-1, 3), len(position)) / count
    # Faces that are not in one plane have no inside that is above all of them.
    flat = np.ones(len(position))
    np.minimum.at(
        flat, face.ravel(), np.abs(np.sum(np.repeat(_face_normal(position, face), 3, 0) * out[face.ravel()], 1))
    )
    mean -= np.sum(mean * out, 1, keepdims=True) * out
    # Where such a vertex lies in a wall that stands on its face, rays start in front of the wall, and not in it.
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
    """Unit vectors off the surface, to the side of shading normals, and the smallest cosine of each with its faces."""
    position, face, normal = np.asarray(mesh.position), np.asarray(mesh.face), np.asarray(mesh.normal, np.float64)
    facing = _face_normal(position, face)
    sided = np.stack(
        [np.where(np.sum(facing * normal[corner], 1) < 0, -1.0, 1.0)[:, None] * facing for corner in face.T]
    )
    of_vertex = _sum_by_index(face.T.ravel(), sided.reshape(-1, 3), len(normal))
    _, place = np.unique(_rows(position), return_inverse=True)
    if apart:
        _, place = np.unique(place + len(position) * np.asarray(mesh.region, np.int64), return_inverse=True)
    # Faces across a crease count too, within a region if `apart`; otherwise a ray could start inside of them.
    joint = _sum_by_index(place, of_vertex, len(normal))[place]
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
    """The smallest cosine of each vector with its faces, and vectors turned off faces that they graze, step by step."""

    def smallest(vector: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        cosine, least = np.sum(facing * vector[group], 1), np.ones(len(vector))
        np.minimum.at(least, group, cosine)
        return cosine, least

    # `group` is the vector of each corner of a face, `facing` the unit normal of that face on the vector's side.
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


def _sum_by_index(index: np.ndarray, vector: np.ndarray, count: int) -> np.ndarray:
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
    """Moves ray origins that were pushed through a touching surface back to its open side, by reflection."""
    facing = _face_normal(occluder.position, occluder.face)
    side = np.cross(out, np.eye(3, dtype=np.float32)[np.argmin(np.abs(out), 1)])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    result = start.copy()
    open_start = np.ones(len(start), bool)
    # Rays beside the vertex find a touching surface even where it passes through the vertex.
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
        # A ray back towards the vertex meets a touching surface from behind, and the vertex's own faces from the front.
        touching = ~seam & (np.sum(back * out[hit], 1) < 0)
        hit, back, corner = hit[touching], back[touching], corner[touching]
        height = np.sum((corner[:, 0] - start[hit]) * back, 1, keepdims=True)
        result[hit] = start[hit] + 2 * height * back
        open_start[hit] = False
    return result


def point_starts(mesh: Mesh, points: Points) -> Float32[np.ndarray, "p 3"]:
    """Origins of rays from surface points, off the triangle by what rounding needs, on the side of the shading normal.

    Args:
        mesh: The mesh.
        points: Points on the mesh's triangles.

    Raises:
        ValueError: The points do not have three corners.
    """
    if len(points.corner) != 3:
        raise ValueError(f"points must have three corners, got {len(points.corner)}")
    corner = np.asarray(points.corner)
    position = np.asarray(mesh.position, np.float32)
    normal = np.asarray(points.carry(mesh.normal), np.float64)
    facing = _face_normal(position, corner.T)
    facing = np.where(facing.any(1, keepdims=True), facing, normal)
    side = np.where(np.sum(facing * normal, 1, keepdims=True) < 0, -1.0, 1.0)
    weight = np.asarray(points.weight, np.float64)  # a rounded sum would move points out of the plane
    place = np.einsum("kp,kpi->pi", weight / weight.sum(0), position[corner].astype(np.float64))
    return (place + offsets(position, corner.T)[:, None] * side * facing).astype(np.float32)
