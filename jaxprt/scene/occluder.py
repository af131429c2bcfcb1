"""Simplified meshes that cast shadows in place of the original mesh."""

import dataclasses

import fast_simplification
import numpy as np
import scipy

from jaxprt import require
from jaxprt.scene.mesh import Mesh, bounds, centered, check_mesh, join, make_mesh

_UNIT = 1000.0  # meshes are scaled to this diagonal, because thresholds are absolute: the first is 1.5e-6 of it


def simplify(mesh: Mesh, *, faces: int) -> Mesh:
    """Simplifies a mesh by collapsing edges with the smallest quadric error, for use as an occluder.

    Vertices of one region at the same position count as one, so seams of texture coordinates do not matter. The two
    sides of a sheet (faces with the same three positions) are not simplified, because each side would end up in front
    of the other somewhere. Boundaries are preserved, including those between regions. A ground of two triangles
    therefore remains, a finely divided plane keeps little more than its rim, and most faces remain where the mesh is
    curved. The result is the same in every run and, up to rounding, at every scale of the mesh.

    Args:
        mesh: The mesh to simplify. Degenerate faces and vertices without faces are removed.
        faces: Target number of faces. More remain if boundaries require them.

    Returns:
        The simplified mesh, with new normals. A connected piece gets the most frequent of its original regions. If the
        mesh does not have more faces than `faces`, it is returned unchanged.

    Raises:
        TypeError: `mesh` is not a mesh, or `faces` is not a whole number.
        ValueError: `faces` is below 4, or all faces are degenerate.

    Reference: Garland, Heckbert 1997, implemented by fast-simplification, which collapses edges below a rising
    threshold in the order of their faces instead of the best edge first; Wang, Tran, Luebke 2004, section 4.2, for the
    use.
    """
    check_mesh(mesh)
    require.count("faces", faces, least=4)
    if len(mesh.face) <= faces:
        return mesh
    position = np.asarray(mesh.position, np.float64)
    _, place = np.unique(position, axis=0, return_inverse=True)
    edge = position[np.asarray(mesh.face)[:, 1:]] - position[np.asarray(mesh.face)[:, :1]]
    solid = np.flatnonzero(np.linalg.norm(np.cross(edge[:, 0], edge[:, 1]), axis=1))
    if not solid.size:
        raise ValueError(f"mesh must have at least one face with an area above 0, got {len(edge)} faces without")
    corner = np.sort(place.reshape(-1)[np.asarray(mesh.face)[solid]], 1)
    _, alike, count = np.unique(corner, axis=0, return_inverse=True, return_counts=True)
    twin = (count > 1)[alike.reshape(-1)]
    parts = [_part(mesh, solid[twin])] if twin.any() else []
    if not twin.all():
        parts.append(_collapse(mesh, solid[~twin], max(4, faces - int(np.count_nonzero(twin)))))
    result = join(parts)  # in coordinates relative to the mesh's origin
    x, y, z = np.add(result.origin, mesh.origin).tolist()
    return dataclasses.replace(result, origin=(x, y, z))


def _part(mesh: Mesh, chosen: np.ndarray) -> Mesh:
    """Some faces of a mesh, and their vertices."""
    vertex, face = np.unique(np.asarray(mesh.face)[chosen], return_inverse=True)
    position, region = np.asarray(mesh.position)[vertex], np.asarray(mesh.region)[vertex]
    return make_mesh(position, face.reshape(-1, 3), region=region, name="simplified mesh")


def _collapse(mesh: Mesh, chosen: np.ndarray, faces: int) -> Mesh:
    """`simplify` for some faces, no two of which coincide."""
    low, high = bounds(centered(mesh))
    unit = _UNIT / (float(np.linalg.norm(high - low)) or 1.0)
    place = np.column_stack([(np.asarray(mesh.position, np.float64) - low) * unit, mesh.region])
    place, index = np.unique(place, axis=0, return_inverse=True)
    face = index.reshape(-1)[np.asarray(mesh.face)[chosen]]
    face = np.ascontiguousarray(face, np.int32)
    result = fast_simplification.simplify(
        place[:, :3].copy(), face, target_count=min(faces, len(face)), preserve_border=True
    )
    position, face = result[0], result[1]
    # Each piece gets the region that is nearest to most of its vertices; at seams two regions are equally near.
    graph = scipy.sparse.coo_array(
        (np.ones(face.size), (face.ravel(), np.roll(face, 1, 1).ravel())), (len(position),) * 2
    )
    _, piece = scipy.sparse.csgraph.connected_components(graph, directed=False)
    nearest = place[scipy.spatial.KDTree(place[:, :3]).query(position)[1], 3].astype(np.int32)
    votes = np.zeros((piece.max() + 1, nearest.max() + 1), np.int32)
    np.add.at(votes, (piece, nearest), 1)
    return make_mesh(position / unit + low, face, region=votes.argmax(1)[piece], name="simplified mesh")
