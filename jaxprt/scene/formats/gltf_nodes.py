"""Nodes of glTF files: the trees of a scene, and the transforms of nodes and instances to world coordinates.

References in comments are to sections of the glTF 2.0 specification, https://registry.khronos.org/glTF/specs/2.0.
"""

import contextlib
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxprt.scene.formats.gltf_extensions import INSTANCING
from jaxprt.scene.formats.gltf_file import Document, Elements
from jaxprt.scene.formats.gltf_header import LARGEST_FLOAT

_TRANSFORM = {"TRANSLATION": (3,), "ROTATION": (4,), "SCALE": (3,)}  # attributes of instances, and their components


class Node(NamedTuple):
    """A node with its transform to world coordinates.

    Attributes:
        number: Index of the node.
        item: The JSON object of the node.
        matrix: Transform from the node to world coordinates [4 4].
    """

    number: int
    item: dict[str, Any]
    matrix: np.ndarray


def nodes(document: Document) -> list[Node]:
    """All nodes of the default scene, parents before their children.

    Raises:
        ValueError: A node is missing, is reached twice, or has a transform that is not finite.
    """
    if document.items("scenes"):
        number = document.index("scenes", document.header.get("scene", 0), "the default scene")
        owner = f"scene {number}"
        return _tree_nodes(document, document.array(document.items("scenes")[number], "nodes", owner), owner)
    return _tree_nodes(document, _roots(document), "the file")


def joint_transforms(document: Document, scene: Sequence[Node], joints: Iterable[int]) -> dict[int, np.ndarray]:
    """World transforms of the nodes of the scene, and of joints outside of it. Joints in a circle of nodes have none.

    The reader skips all other nodes outside of the scene, so damage in them does not matter.

    Args:
        document: The file.
        scene: The nodes of the default scene.
        joints: Indices of the joints.

    Raises:
        ValueError: A joint or its ancestor has several parents, or a transform that is not finite.
    """
    matrices = {node.number: node.matrix for node in scene}
    outside = [joint for joint in dict.fromkeys(joints) if joint not in matrices]
    parents = _parents(document) if outside else {}
    place: dict[int, int] = {}  # in the order of `above` and `level`
    above: list[int] = []
    level: list[int] = []
    for joint in outside:
        way: dict[int, None] = {}  # from the joint up
        node: int | None = joint
        while node is not None and node not in place and node not in way:
            way[node] = None
            owners = parents.get(node, [])
            if len(owners) > 1:
                got = f"node {node} twice, the second time in node {owners[1]}"
                raise document.error("must have nodes that form trees", got)
            node = owners[0] if owners else None
        if node in way:
            continue  # a circle
        for child in reversed(way):
            above.append(-1 if node is None else place[node])
            level.append(0 if node is None else level[place[node]] + 1)
            place[child], node = len(place), child
    return matrices | {node.number: node.matrix for node in _placed(document, list(place), above, level)}


def _parents(document: Document) -> dict[int, list[int]]:
    """The parents of all nodes. What is no index of a node is left out."""
    parents: dict[int, list[int]] = {}
    for number, item in enumerate(document.items("nodes")):
        children = item.get("children")
        for child in children if isinstance(children, list) else []:
            with contextlib.suppress(ValueError):
                parents.setdefault(document.index("nodes", child, f"node {number}"), []).append(number)
    return parents


def instance_count(document: Document, node: Node) -> int:
    """How often a node repeats its mesh: once, or as often as EXT_mesh_gpu_instancing says.

    Raises:
        ValueError: The attributes of the instances have different counts, or there are none.
    """
    attributes = _instancing(document, node)
    if attributes is None:
        return 1
    owner = f"{INSTANCING} of node {node.number}"
    if not attributes:
        raise document.error(f"must have TRANSLATION, ROTATION or SCALE in {owner}", "none")
    counts = {key: len(elements.value) for key, elements in attributes.items()}
    if len(set(counts.values())) > 1:
        raise document.error(f"must have attributes of one count in {owner}", f"{counts}")
    return next(iter(counts.values()))


def instances(document: Document, node: Node) -> np.ndarray:
    """World transforms of the instances of a node's mesh [n 4 4].

    Raises:
        ValueError: The counts of attributes differ, or a number is not finite, or a rotation is zero.
    """
    count, attributes, owner = instance_count(document, node), _instancing(document, node), f"node {node.number}"
    if attributes is None:
        return node.matrix[None]
    value = {key: attributes[key].numbers() for key in _TRANSFORM if key in attributes}
    for key, array in value.items():
        right = np.isfinite(array).all(1) & ((key != "ROTATION") | array.any(1))
        if not right.all():
            wrong = np.flatnonzero(~right)
            got = f"{len(wrong)} of {count} that are not, the first is {array[wrong[0]].tolist()} at {wrong[0]}"
            must = "nonzero quaternions" if key == "ROTATION" else "finite numbers"
            raise document.error(f"must have {must} in {key} of {INSTANCING} of {owner}", got)
    local = np.tile(np.eye(4), (count, 1, 1))
    if "ROTATION" in value:
        local[:, :3, :3] = _turns(value["ROTATION"])
    if "SCALE" in value:
        local[:, :3, :3] *= value["SCALE"][:, None]
    if "TRANSLATION" in value:
        local[:, :3, 3] = value["TRANSLATION"]
    return node.matrix @ local


def _instancing(document: Document, node: Node) -> dict[str, Elements] | None:
    """The attributes of a node's instances; None if it has one without attributes."""
    owner = f"node {node.number}"
    extensions = document.object(node.item, "extensions", owner)
    if INSTANCING not in extensions:
        return None
    owner = f"{INSTANCING} of {owner}"
    attribute = document.object(document.object(extensions, INSTANCING, owner), "attributes", owner)
    # Attributes of other names are for applications, but they count instances too.
    return {
        key: document.accessor(value, f"{key} of {owner}", *_TRANSFORM.get(key, (1, 2, 3, 4)))
        for key, value in attribute.items()
    }


def _roots(document: Document) -> list[int]:
    """The nodes that are children of no node."""
    items = document.items("nodes")
    children = {
        document.index("nodes", child, f"node {number}")
        for number, item in enumerate(items)
        if "children" in item
        for child in document.array(item, "children", f"node {number}")
    }
    return [number for number in range(len(items)) if number not in children]


def _tree_nodes(document: Document, roots: list, owner: str) -> list[Node]:
    """The nodes of trees, parents before their children.

    Args:
        document: The file.
        roots: Indices of the roots, as they stand in the file.
        owner: The object that has these roots, for error messages.
    """
    items = document.items("nodes")
    order: list[int] = []
    parent: list[int] = []  # place of the parent in `order`; -1 for roots
    level: list[int] = []
    seen = set()
    waiting = [(root, -1) for root in reversed(roots)]
    while waiting:
        value, above = waiting.pop()
        name = owner if above < 0 else f"node {order[above]}"
        index = document.index("nodes", value, name)
        if index in seen:
            raise document.error("must have nodes that form trees", f"node {index} twice, the second time in {name}")
        seen.add(index)
        if "children" in items[index]:
            children = document.array(items[index], "children", f"node {index}")
            waiting += [(child, len(order)) for child in reversed(children)]
        order.append(index)
        parent.append(above)
        level.append(level[above] + 1 if above >= 0 else 0)
    return _placed(document, order, parent, level)


def _placed(document: Document, order: list[int], parent: list[int], level: list[int]) -> list[Node]:
    """Nodes with their transforms to world coordinates.

    Args:
        document: The file.
        order: Indices of the nodes, parents before their children.
        parent: Place of each node's parent in `order`; -1 for roots.
        level: Number of ancestors of each node.
    """
    if not order:
        return []
    items = document.items("nodes")
    matrix = _transforms(document, order)
    above, by_level = np.array(parent), np.argsort(level, kind="stable")
    with np.errstate(over="ignore", invalid="ignore"):  # reported below
        for rows in np.split(by_level, np.cumsum(np.bincount(level)))[1:-1]:
            matrix[rows] = matrix[above[rows]] @ matrix[rows]
    wrong = np.flatnonzero(~(np.abs(matrix) <= LARGEST_FLOAT).all((1, 2)))
    if wrong.size:
        got = f"numbers that are not finite at node {order[wrong[0]]}"
        raise document.error("must have finite transforms to world coordinates", got)
    return [Node(index, items[index], transform) for index, transform in zip(order, matrix, strict=True)]


def _transforms(document: Document, order: list[int]) -> np.ndarray:
    """Transforms of nodes to their parents, from matrices or from translation, rotation and scale (section 3.5.2)."""
    items = document.items("nodes")
    local = np.tile(np.eye(4), (len(order), 1, 1))

    def values(key: str, size: int) -> tuple[list[int], np.ndarray]:
        """Places in the order, and values, of the nodes that have a field."""
        rows = [row for row, index in enumerate(order) if key in items[index]]
        numbers = [document.numbers(items[order[row]][key], (size,), f"the {key} of node {order[row]}") for row in rows]
        return rows, np.array(numbers).reshape(-1, size)

    rows, rotation = values("rotation", 4)
    zero = np.flatnonzero(~rotation.any(1))
    if zero.size:
        raise document.error(f"must have a nonzero quaternion for the rotation of node {order[rows[zero[0]]]}", "zero")
    local[rows, :3, :3] = _turns(rotation)
    rows, scale = values("scale", 3)
    local[rows, :3, :3] *= scale[:, None]
    rows, translation = values("translation", 3)
    local[rows, :3, 3] = translation
    rows, matrix = values("matrix", 16)
    local[rows] = matrix.reshape(-1, 4, 4).transpose(0, 2, 1)
    return local


def _turns(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrices [n 3 3] of quaternions x, y, z, w [n 4] of any length but zero."""
    scaled = quaternion / np.abs(quaternion).max(1, keepdims=True, initial=0)  # the length neither over- nor underflows
    x, y, z, w = (scaled / np.linalg.norm(scaled, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)
