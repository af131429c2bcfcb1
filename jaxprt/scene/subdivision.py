"""Subdivision of triangles at the midpoints of their edges, to add vertices where they are needed.

Edges are identified by the positions of their endpoints. Both sides of a seam are therefore divided in the same way,
and so are parts of a scene that share a border, even if rounding moved the two sides apart. Subdivision opens no gaps
in the surface.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int, Integer

from jaxprt import require
from jaxprt.brdf.varying import PerVertex
from jaxprt.compile import known
from jaxprt.scene.mesh import Mesh, make_mesh
from jaxprt.scene.scene import Part, Scene

# Steps of the additive recurrence R2, which fills a square evenly.
_R2 = np.array([0.7548776662466927, 0.5698402909980532])
_FACE = 300  # bytes of a triangle and its share of vertices, in the scene and while it is divided
# Corners that a file has at one place differ by rounding in float32. Transforming them sums four products, each rounded
# twice, on either side of the joint: at most 8 steps of 2^-23 times the largest coordinate.
_ROUNDING = 2.0**-20
# No two corners of a triangle are one place, unless its shortest edge is below this share of its longest.
_SLIVER = 2.0**-10
_CANCELED = 1e-6  # two unit normals cancel if their mean is shorter than this

# Triangles that replace a triangle, by which of its edges are cut, counted from the longest edge. Corners are 0 to 2,
# from the start of that edge; 3 to 5 are the midpoints of the edges in the same order.
_CHILDREN = {
    (False, False, False): [[0, 1, 2]],
    (True, False, False): [[0, 3, 2], [3, 1, 2]],
    (True, True, False): [[0, 3, 2], [3, 1, 4], [3, 4, 2]],
    (True, False, True): [[3, 1, 2], [0, 3, 5], [3, 2, 5]],
    (True, True, True): [[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]],
}


class Division(NamedTuple):
    """The result of a subdivision step. Added vertices follow the existing ones.

    Attributes:
        face: Vertex indices of each triangle.
        origin: Index of the triangle from which each was cut, in ascending order.
        parent: The two vertices between which each added vertex lies, the lower index first.
    """

    face: Int[np.ndarray, "f 3"]
    origin: Int[np.ndarray, " f"]
    parent: Int[np.ndarray, "n 2"]


class TrianglePoints(NamedTuple):
    """Points on triangles.

    Attributes:
        triangle: Index of each point's triangle.
        weight: Barycentric coordinates of each point.
    """

    triangle: Int[np.ndarray, " p"]
    weight: Float[np.ndarray, "p 3"]


class Edges:
    """The edges of a mesh, identified by the positions of their endpoints.

    Args:
        position: Positions of the vertices.
        face: Vertex indices of each triangle.
        joint: Pairs of vertices at one place whose positions differ by rounding: those of `joints` for a mesh that was
            not divided, and those of `joints_after` for one that was. If None, the result of `joints`.

    Attributes:
        face: Vertex indices of each triangle.
        joint: The pairs of vertices at one place whose positions differ.
        number: Index of the edge from each corner of a triangle to the next. All triangles at an edge share its index.
        length: Length of each edge.
        added: Number of vertices that the midpoint of each edge needs: two at a seam.
        longest: Index of each triangle's longest edge; among equally long ones, the highest index.
    """

    def __init__(
        self,
        position: Float[ArrayLike, "v 3"],
        face: Integer[ArrayLike, "f 3"],
        joint: Int[np.ndarray, "n 2"] | None = None,
    ):
        self.face = np.asarray(face, np.int64)
        self._position = position = np.asarray(position)
        self.joint = joints(position, self.face) if joint is None else joint
        self._vertices = len(position)
        self._ends = np.stack([self.face, np.roll(self.face, -1, 1)], -1)
        low, high = np.moveaxis(np.sort(_joined(places(position), self.joint)[self._ends], -1), -1, 0)
        _, first, number = np.unique(low * self._vertices + high, return_index=True, return_inverse=True)
        self.number = number.reshape(-1, 3)
        start, stop = position.astype(np.float64)[self._ends.reshape(-1, 2)[first].T]
        self.length = np.linalg.norm(stop - start, axis=1)
        rank = np.empty(len(first), np.int64)
        rank[np.argsort(self.length, kind="stable")] = np.arange(len(first))
        self._turn = np.argmax(rank[self.number], 1)
        self.longest = np.take_along_axis(self.number, self._turn[:, None], 1)[:, 0]
        _, one = np.unique(self._pairs(), return_index=True)
        self.added = np.bincount(self.number.ravel()[one], minlength=len(first))

    def closed(self, marked: Bool[np.ndarray, " e"]) -> Bool[np.ndarray, " e"]:
        """Extends marked edges by the longest edge of each triangle that has a marked edge, until none is missing.

        These edges can be cut without gaps, and angles stay above half of the smallest original angle. Edges of zero
        length are not cut.

        Reference: Rivara 1984, "Algorithms for refining triangular grids suitable for adaptive and multigrid
        techniques".
        """
        marked = marked & (self.length > 0)
        while (open_ := marked[self.number].any(1) & ~marked[self.longest]).any():
            marked[self.longest[open_]] = True
        return marked

    def divide(self, marked: Bool[np.ndarray, " e"]) -> Division:
        """Cuts marked edges at their midpoints.

        A triangle whose three edges are marked is divided into four similar ones. Other triangles are first cut from
        the midpoint of their longest edge to the opposite corner.

        Args:
            marked: Mask of the edges, from `closed`.

        Reference: Carstensen 2004, "An adaptive mesh-refining algorithm allowing for an H1 stable L2 projection onto
        Courant finite element spaces": red, green and blue refinement.
        """
        cut = marked[self.number]
        parent, index = np.unique(self._pairs()[cut], return_inverse=True)
        middle = np.full(cut.shape, -1)
        middle[cut] = self._vertices + index
        turn = (self._turn[:, None] + np.arange(3)) % 3
        corner, middle = (np.take_along_axis(corners, turn, 1) for corners in (self.face, middle))
        node = np.concatenate([corner, middle], 1)
        face, origin = [], []
        for which, children in _CHILDREN.items():
            rows = np.flatnonzero(((middle >= 0) == which).all(1))
            face.append(node[rows][:, children].reshape(-1, 3))
            origin.append(np.repeat(rows, len(children)))
        order = np.argsort(np.concatenate(origin), kind="stable")
        ends = np.stack(np.divmod(parent, self._vertices), -1)
        return Division(np.concatenate(face)[order], np.concatenate(origin)[order], ends)

    def joints_after(self, division: Division) -> Int[np.ndarray, "n 2"]:
        """Pairs of vertices at one place whose positions differ, after a step of `divide`.

        Vertices added to one edge are at one place, however its endpoints were rounded.
        """
        if not self.joint.size:
            return self.joint
        parent, first = np.unique(self._pairs(), return_index=True)
        key = division.parent[:, 0] * self._vertices + division.parent[:, 1]
        edge = self.number.ravel()[first[np.searchsorted(parent, key)]]
        order = np.argsort(edge, kind="stable")
        pair = np.stack([order[:-1], order[1:]], -1)[edge[order[:-1]] == edge[order[1:]]]
        added = middle(self._position, division.parent)
        pair = pair[(added[pair[:, 0]] != added[pair[:, 1]]).any(1)]
        return np.concatenate([self.joint, self._vertices + pair])

    def _pairs(self) -> np.ndarray:
        """One integer key for the two endpoints of each triangle's edges."""
        low, high = np.moveaxis(np.sort(self._ends, -1), -1, 0)
        return low * self._vertices + high


def middle(value: Float[np.ndarray, " v *c"], parent: Int[np.ndarray, "n 2"]) -> Float[np.ndarray, " n *c"]:
    """Values at the midpoints between vertices, in the type of the values."""
    return value[parent].mean(1)


def middle_normal(normal: Float[np.ndarray, "v 3"], parent: Int[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Normals at the midpoints between vertices, not of unit length. If two cancel, that of the first vertex."""
    mean = middle(normal, parent)
    return np.where(np.linalg.norm(mean, axis=1, keepdims=True) > _CANCELED, mean, normal[parent[:, 0]])


def scatter(count: Int[np.ndarray, " f"]) -> TrianglePoints:
    """A given number of evenly distributed points in each triangle; the same in every run.

    Points follow the additive recurrence R2, folded from the square into the triangle.
    """
    triangle = np.repeat(np.arange(len(count)), count)
    rank = np.arange(len(triangle)) - np.repeat(np.cumsum(count) - count, count)
    place = ((rank + 0.5)[:, None] * _R2) % 1
    place = np.where(place.sum(1, keepdims=True) > 1, 1 - place, place)
    return TrianglePoints(triangle, np.column_stack([place, 1 - place.sum(1)]))


def relocate(points: TrianglePoints, face: Int[np.ndarray, "f 3"], division: Division) -> TrianglePoints:
    """Finds the triangles of points after a subdivision step. The positions do not change.

    Args:
        points: The points. None lies in a triangle with a repeated vertex.
        face: Vertex indices of each triangle before the step.
        division: The subdivision step.
    """
    children = np.bincount(division.origin, minlength=len(face))[points.triangle]
    first = np.searchsorted(division.origin, points.triangle)
    before = division.face.max() + 1 - len(division.parent)
    ends = np.concatenate([np.repeat(np.arange(before)[:, None], 2, 1), division.parent])
    triangle, weight = first, np.full(points.weight.shape, -np.inf)
    for number in range(4):
        child = first + np.minimum(number, children - 1)
        # Barycentric coordinates of the new triangle's corners in the old triangle.
        corner = (ends[division.face[child]][..., None] == face[points.triangle][:, None, None]).mean(2)
        now = np.linalg.solve(np.swapaxes(corner, 1, 2), points.weight[..., None])[..., 0]
        better = now.min(1) > weight.min(1)
        triangle, weight = np.where(better, child, triangle), np.where(better[:, None], now, weight)
    return TrianglePoints(triangle, weight)


def subdivide(mesh: Mesh, divisions: Sequence[Division]) -> Mesh:
    """Applies successive subdivision steps to a mesh.

    Positions and texture coordinates are interpolated, so the surface and its textures do not change. Normals are
    interpolated in the same way as for shading and normalized; tangents are made orthogonal to them. An added vertex
    gets the region of the first of the two vertices between which it lies. Existing vertices do not change.
    """
    return _subdivide_mesh(mesh, [division.parent for division in divisions], divisions[-1].face) if divisions else mesh


def subdivide_scene(scene: Scene, divisions: Sequence[Division]) -> Scene:
    """Applies successive subdivision steps of `scene.mesh` to a scene.

    Parts keep their materials. Vertex colors and second texture coordinates are interpolated. `subdivide` explains what
    happens to the meshes.
    """
    for part in scene.parts:
        if isinstance(part.material, PerVertex):
            raise TypeError(
                f"the material of part {part.name!r} must be one BRDF for all vertices or a TexturedMaterial, "
                "got a BRDF for each vertex"
            )
    if not divisions:
        return scene
    counts = scene.counts
    parents, owner, number = _of_parts(counts, [division.parent for division in divisions])
    face = divisions[-1].face
    faces = [number[face[owner[face[:, 0]] == part]] for part in range(len(counts))]
    parts = [_subdivide_part(*row) for row in zip(scene.parts, parents, faces, strict=True)]
    return dataclasses.replace(scene, parts=parts)


def part_parents(counts: Sequence[int], parents: Sequence[Int[np.ndarray, "_ 2"]]) -> list[list[np.ndarray]]:
    """For each part and each step, the two vertices of the part between which each added vertex lies.

    Args:
        counts: Number of vertices of each part before the steps.
        parents: The two vertices of the whole scene between which each added vertex lies, for each step.
    """
    return _of_parts(counts, parents)[0]


def _of_parts(
    counts: Sequence[int], parents: Sequence[np.ndarray]
) -> tuple[list[list[np.ndarray]], np.ndarray, np.ndarray]:
    """The result of `part_parents`, the part of each vertex in the end, and its index in this part."""
    owner = np.repeat(np.arange(len(counts)), counts)
    number = np.concatenate([np.arange(count) for count in counts])
    result: list[list[np.ndarray]] = [[] for _ in counts]
    for parent in parents:
        of_added, place = owner[parent[:, 0]], np.empty(len(parent), np.int64)
        for part, all_parents in enumerate(result):
            rows = np.flatnonzero(of_added == part)
            place[rows] = np.count_nonzero(owner == part) + np.arange(len(rows))
            all_parents.append(number[parent[rows]])
        owner, number = np.concatenate([owner, of_added]), np.concatenate([number, place])
    return result, owner, number


def divide(scene: Scene, *, edge: float) -> Scene:
    """Subdivides a scene until no edge is longer than a given length.

    Args:
        scene: The scene.
        edge: Largest length of an edge, in world units.

    Returns:
        The scene with more vertices. Materials do not change; attributes of added vertices are interpolated.

    Raises:
        TypeError: `scene` is not a `Scene`, or the material of a part has one BRDF for each vertex.
        ValueError: The length is not positive and finite.
        MemoryError: The scene would not fit into memory.
    """
    require.kind("the scene", scene, Scene, source="jaxprt.load_scene")
    require.number("edge", edge, 0.0, above=True)
    mesh = scene.mesh
    position, face = np.asarray(mesh.position), np.asarray(mesh.face)
    divisions, joint = [], None
    corner = position[face].astype(np.float64)
    longest = np.linalg.norm(np.roll(corner, -1, 1) - corner, axis=2).max(1)
    faces = float(np.sum(np.maximum(longest / float(edge), 1) ** 2)) / 2  # of slim triangles fewer are made
    require.memory(f"some {faces:.2g} triangles", int(min(faces, 1e30)) * _FACE, "give a longer edge")
    while True:
        edges = Edges(position, face, joint)
        marked = edges.length > edge
        if not marked.any():
            return subdivide_scene(scene, divisions)
        divisions.append(edges.divide(edges.closed(marked)))
        joint = edges.joints_after(divisions[-1])
        face = divisions[-1].face
        position = np.concatenate([position, middle(position, divisions[-1].parent)])


def _subdivide_mesh(mesh: Mesh, parents: Sequence[np.ndarray], face: np.ndarray) -> Mesh:
    """The mesh with added vertices, each between two earlier ones."""
    triangle = jax.device_put(face.astype(np.asarray(mesh.face).dtype))
    if not any(len(parent) for parent in parents):
        return eqx.tree_at(lambda m: m.face, mesh, triangle)
    count = len(mesh.position)
    position, tangent = spread(mesh.position, parents), spread(np.asarray(mesh.tangent, np.float64), parents)
    normal = np.asarray(mesh.normal, np.float64)
    for parent in parents:
        normal = np.concatenate([normal, middle_normal(normal, parent)])
    # A single degenerate face, because only frames are computed here.
    new = make_mesh(position[count:], np.zeros((1, 3), int), normal=normal[count:], tangent=tangent[count:])

    def appended(old, rows):
        return jax.device_put(np.concatenate([old, np.asarray(rows).astype(np.asarray(old).dtype)]))

    texture = None if mesh.texture is None else jax.device_put(spread(mesh.texture, parents))
    frame = appended(mesh.normal, new.normal), appended(mesh.tangent, new.tangent)
    region = jax.device_put(_first(mesh.region, parents))
    return Mesh(jax.device_put(position), triangle, *frame, region, texture, mesh.origin)


def _subdivide_part(part: Part, parents: Sequence[np.ndarray], face: np.ndarray) -> Part:
    """The part with added vertices, each between two earlier ones."""
    color, second, alpha = (
        None if attribute is None else jax.device_put(spread(attribute, parents))
        for attribute in (part.color, part.second, part.alpha)
    )
    handedness = None if part.handedness is None else jax.device_put(_first(part.handedness, parents))
    return Part(part.name, _subdivide_mesh(part.mesh, parents, face), part.material, color, second, handedness, alpha)


def spread(value: Array | np.ndarray, parents: Sequence[np.ndarray]) -> Array | np.ndarray:
    """Values of all vertices, given those before division. Added vertices get the mean of their two parents."""
    xp = np if known(value) else jnp
    value = xp.asarray(value)
    for parent in parents:
        value = xp.concatenate([value, value[parent].mean(1)])
    return value


def _first(value, parents: Sequence[np.ndarray]) -> np.ndarray:
    """Values of all vertices. Added vertices get the value of their first parent."""
    value = np.asarray(value)
    for parent in parents:
        value = np.concatenate([value, value[parent[:, 0]]])
    return value


def places(position: np.ndarray) -> np.ndarray:
    """Integers that are equal for vertices at the same position."""
    order = np.lexsort(position.T)
    another = (position[order[1:]] != position[order[:-1]]).any(1)
    place = np.empty(len(position), np.int64)
    place[order] = np.concatenate([[0], np.cumsum(another)])
    return place


def orientations(
    position: Float[np.ndarray, "v 3"], face: Int[np.ndarray, "f 3"]
) -> tuple[Int[np.ndarray, " f"], Int[np.ndarray, " f"], Int[np.ndarray, "f 3"]]:
    """What coincident faces have in common.

    Args:
        position: Positions of the vertices.
        face: Vertex indices of each triangle.

    Returns:
        A number that faces with corners at the same positions share; 0 or 1, which differ between opposite
        orientations; and for each face the order of its corners that all such faces share.
    """
    corner = places(position)[face]
    order = np.argsort(corner, axis=1)
    _, alike = np.unique(np.take_along_axis(corner, order, 1), axis=0, return_inverse=True)
    # Odd permutations of the sorted corners have one orientation, even permutations the other.
    odd = (order[:, 0] > order[:, 1]) ^ (order[:, 0] > order[:, 2]) ^ (order[:, 1] > order[:, 2])
    return alike.reshape(-1), odd.astype(int), order


def joints(position: Float[np.ndarray, "v 3"], face: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "n 2"]:
    """Pairs of vertices at one place whose positions differ by rounding, the lower index first.

    Such vertices are not farther apart than rounding in float32 moves them, nor than 2^-10 of the longest edge of any
    triangle at them. The result is empty for a mesh whose parts touch at equal positions.

    Args:
        position: Positions of the vertices, finite.
        face: Vertex indices of each triangle.
    """
    position, face = np.asarray(position, np.float64), np.asarray(face, np.int64)
    corner = position[face]
    longest = np.linalg.norm(np.roll(corner, -1, 1) - corner, axis=2).max(1)
    extended = longest > 0
    if not extended.any():
        return np.zeros((0, 2), np.int64)
    place = places(position)
    reach = np.full(place.max() + 1, np.inf)
    np.minimum.at(reach, place[face[extended]].ravel(), np.repeat(_SLIVER * longest[extended], 3))
    _, vertex = np.unique(place, return_index=True)
    vertex, reach = vertex[np.isfinite(reach)], reach[np.isfinite(reach)]
    reach = np.minimum(reach, _ROUNDING * np.abs(corner[extended]).max())
    tree = scipy.spatial.cKDTree(position[vertex], balanced_tree=False, compact_nodes=False)
    nearest = tree.query(position[vertex], k=[2], distance_upper_bound=np.nextafter(reach.max(), np.inf))[0][:, 0]
    near = np.flatnonzero(nearest <= reach)
    around = tree.query_ball_point(position[vertex[near]], reach[near])
    first, second = np.repeat(near, [len(other) for other in around]), np.concatenate([[], *around]).astype(np.int64)
    apart = np.linalg.norm(position[vertex[first]] - position[vertex[second]], axis=1)
    both = (first != second) & (apart <= reach[second])
    return np.unique(np.sort(np.stack([vertex[first], vertex[second]], -1)[both], 1), axis=0)


def _joined(place: np.ndarray, joint: np.ndarray) -> np.ndarray:
    """The integers `place`, made equal for pairs of vertices: the smallest of all that are joined."""
    if not joint.size:
        return place
    count, (first, second) = int(place.max()) + 1, place[joint].T
    graph = scipy.sparse.coo_array((np.ones(len(joint), np.int8), (first, second)), shape=(count, count))
    group = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    return np.unique(group, return_index=True)[1][group][place]
