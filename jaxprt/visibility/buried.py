"""Rays of vertices inside of other solids, or just below another sheet, start where their triangles come out.

Such a vertex sees nothing, and no picture shows it. But visibility is interpolated over its triangles, so the part of
them outside of the solid would turn black towards it. It gets the visibility of the nearest place outside instead.
"""

import numpy as np
from jaxtyping import Bool, Float32

from jaxprt.scene.mesh import Mesh
from jaxprt.visibility.occluder import Occluder

_RAYS = 48  # rays over the hemisphere of a vertex, none of which leaves a solid
_INSIDE = 0.25  # share of these that hit a surface from behind; half of them do beside a second solid
_STEEP = 0.5  # cosine between the normal and rays that count as steep
_CLOSE = 1e-3  # distance of a sheet that covers a vertex, relative to the scene's diagonal
_CROSSINGS = 4  # surfaces that are passed on the way out


def out_of_solids(
    mesh: Mesh,
    occluder: Occluder,
    start: Float32[np.ndarray, "v 3"],
    out: Float32[np.ndarray, "v 3"],
    offset: Float32[np.ndarray, "v 1"],
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

    Returns:
        The ray origins, and whether each vertex is inside.
    """
    buried = inside(occluder, start, out)
    if not buried.any():
        return start, buried
    vertex, goal = _ways(mesh, start, buried)
    place, length = _outside(occluder, start[vertex], goal, out[vertex], offset[vertex, 0])
    found = np.flatnonzero(np.isfinite(length))
    found = found[np.lexsort((length[found], vertex[found]))]
    found = found[np.unique(vertex[found], return_index=True)[1]]  # the nearest place of each vertex
    result = start.copy()
    result[vertex[found]] = place[found]
    return result, buried


def _normals(occluder: Occluder) -> Float32[np.ndarray, "f 3"]:
    """Normals of triangles by their winding, not of unit length."""
    a, b, c = (occluder.position[occluder.face[:, corner]] for corner in range(3))
    return np.cross(b - a, c - a)


def _hit(occluder: Occluder, start: np.ndarray, way: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The first triangle on each ray, -1 for none, and its distance. Of the two sides of a sheet no ray hits a back."""
    triangle, distance, weight = occluder.hit(start, way)
    met = np.flatnonzero(triangle >= 0)
    triangle[met] = occluder.toward(triangle[met], way[met], weight[met])[0]
    return triangle, distance


def inside(
    occluder: Occluder, start: Float32[np.ndarray, "n 3"], out: Float32[np.ndarray, "n 3"]
) -> Bool[np.ndarray, " n"]:
    """Whether ray origins are inside of solids, or just below another sheet: see `out_of_solids`.

    Args:
        occluder: Geometry that casts shadows.
        start: Ray origins.
        out: Unit vectors off the surface. Most points are told by the first ray, which is near this vector.
    """
    facing = _normals(occluder)
    number = np.arange(_RAYS) + 0.5
    height = 1 - number / _RAYS
    angle = np.pi * (3 - np.sqrt(5)) * number
    ring = np.sqrt(1 - height**2)
    local = np.stack([ring * np.cos(angle), ring * np.sin(angle), height], -1).astype(np.float32)
    hidden, behind, covered = np.arange(len(start)), np.zeros(len(start)), np.ones(len(start), bool)
    side = np.cross(out, np.eye(3, dtype=np.float32)[np.argmin(np.abs(out), 1)])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(out, side)
    for x, y, z in local:
        way = x * side[hidden] + y * other[hidden] + z * out[hidden]
        triangle, distance = _hit(occluder, start[hidden], way)
        back = np.sum(facing[triangle] * way, 1) > 0
        behind[hidden] += back & (triangle >= 0)
        if z > _STEEP:
            covered[hidden] &= distance * z < _CLOSE * occluder.diagonal
        hidden = hidden[triangle >= 0]
        if not hidden.size:
            break
    result = np.zeros(len(start), bool)
    result[hidden] = covered[hidden] | (behind[hidden] >= _INSIDE * _RAYS)
    return result


def _ways(mesh: Mesh, start: np.ndarray, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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
        triangle, distance = _hit(occluder, place[active], way[active])
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
