"""Nodes of glTF files: the trees of a scene, their transforms to world coordinates, and their animations.

References in comments are to sections of the glTF 2.0 specification, https://registry.khronos.org/glTF/specs/2.0.
"""

import contextlib
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxprt.files import inputs
from jaxprt.files.inputs import JsonObject
from jaxprt.scene.formats.gltf_file import INSTANCING, LARGEST_FLOAT, Document, Elements, excerpt

_TRANSFORM = {"TRANSLATION": (3,), "ROTATION": (4,), "SCALE": (3,)}  # attributes of instances, and their components
_CHANNEL_WIDTH = {"translation": 3, "rotation": 4, "scale": 3, "weights": 1}
_INTERPOLATION = ("LINEAR", "STEP", "CUBICSPLINE")
_POINTER = "KHR_animation_pointer"
_AFFINE = 1e-5  # deviation of the last row of a matrix from 0 0 0 1, due to rounding
_STRAIGHT = 1e-9  # sine of the angle between two rotations below which their mean is linear


class Node(NamedTuple):
    """A node with its transform to world coordinates."""

    number: int  # index of the node
    item: JsonObject  # its JSON object
    matrix: np.ndarray  # [4 4]


def nodes(document: Document) -> list[Node]:
    """All nodes of the default scene, parents before their children."""
    if document.items("scenes"):
        number = document.index("scenes", document.header.get("scene", 0), "the default scene")
        owner = f"scene {number}"
        return _tree_nodes(document, document.field(document.items("scenes")[number], "nodes", owner, list), owner)
    return _tree_nodes(document, _roots(document), "the file")


def joint_transforms(document: Document, scene: Sequence[Node], joints: Iterable[int]) -> dict[int, np.ndarray]:
    """World transforms of the nodes of the scene, and of joints outside of it. Joints in a circle of nodes have none.

    The reader skips all other nodes outside of the scene, so damage in them does not matter.
    """
    matrices = {node.number: node.matrix for node in scene}
    outside = [joint for joint in dict.fromkeys(joints) if joint not in matrices]
    parents = _parents(document) if outside else {}
    place: dict[int, int] = {}  # in the order of `above`
    above: list[int] = []
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
            place[child], node = len(place), child
    return matrices | {node.number: node.matrix for node in _in_world(document, list(place), above)}


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
    """How often a node repeats its mesh: once, or as often as EXT_mesh_gpu_instancing says."""
    return _instance_attributes(document, node)[0]


def instances(document: Document, node: Node) -> np.ndarray:
    """World transforms of the instances of a node's mesh [n 4 4]."""
    count, attributes = _instance_attributes(document, node)
    if not attributes:
        return node.matrix[None]
    value = {key: attributes[key].numbers() for key in _TRANSFORM if key in attributes}
    for key, array in value.items():
        wrong = np.flatnonzero(~(np.isfinite(array).all(1) & ((key != "ROTATION") | array.any(1))))
        if wrong.size:
            got = f"{len(wrong)} of {count} that are not, the first is {array[wrong[0]].tolist()} at {wrong[0]}"
            must = "nonzero quaternions" if key == "ROTATION" else "finite numbers"
            raise document.error(f"must have {must} in {key} of {INSTANCING} of node {node.number}", got)
    local = np.tile(np.eye(4), (count, 1, 1))
    if "ROTATION" in value:
        local[:, :3, :3] = _rotations(value["ROTATION"])
    local[:, :3, :3] *= value.get("SCALE", np.ones((1, 3)))[:, None]
    local[:, :3, 3] = value.get("TRANSLATION", 0)
    return node.matrix @ local


def _instance_attributes(document: Document, node: Node) -> tuple[int, dict[str, Elements]]:
    """The number of a node's instances, and their attributes; none for a node without instances."""
    owner = f"node {node.number}"
    extensions = document.field(node.item, "extensions", owner, dict)
    if INSTANCING not in extensions:
        return 1, {}
    owner = f"{INSTANCING} of {owner}"
    attribute = document.field(document.field(extensions, INSTANCING, owner, dict), "attributes", owner, dict)
    # Attributes of other names are for applications, but they count instances too.
    elements = {
        key: document.accessor(value, f"{inputs.shortened(key)} of {owner}", *_TRANSFORM.get(key, (1, 2, 3, 4)))
        for key, value in attribute.items()
    }
    if not elements:
        raise document.error(f"must have TRANSLATION, ROTATION or SCALE in {owner}", "none")
    counts = {key: len(one.value) for key, one in elements.items()}
    if len(set(counts.values())) > 1:
        raise document.error(f"must have attributes of one count in {owner}", excerpt(counts))
    return next(iter(counts.values())), elements


def _roots(document: Document) -> list[int]:
    """The nodes that are children of no node."""
    items = document.items("nodes")
    children = {
        document.index("nodes", child, f"node {number}")
        for number, item in enumerate(items)
        if "children" in item
        for child in document.field(item, "children", f"node {number}", list)
    }
    return [number for number in range(len(items)) if number not in children]


def _tree_nodes(document: Document, roots: list, owner: str) -> list[Node]:
    """The nodes of trees, parents before their children, from the roots that `owner` has in the file."""
    items = document.items("nodes")
    order: list[int] = []
    parent: list[int] = []
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
            children = document.field(items[index], "children", f"node {index}", list)
            waiting += [(child, len(order)) for child in reversed(children)]
        order.append(index)
        parent.append(above)
    return _in_world(document, order, parent)


def _in_world(document: Document, order: list[int], parent: list[int]) -> list[Node]:
    """Nodes with their transforms to world coordinates. Each `parent` is an earlier index in `order`, -1 for roots."""
    if not order:
        return []
    level: list[int] = []
    for above in parent:
        level.append(level[above] + 1 if above >= 0 else 0)
    items = document.items("nodes")
    matrix = _transforms(document, order)
    parents, by_level = np.array(parent), np.argsort(level, kind="stable")
    with np.errstate(over="ignore", invalid="ignore"):  # reported below
        for rows in np.split(by_level, np.cumsum(np.bincount(level)))[1:-1]:
            matrix[rows] = matrix[parents[rows]] @ matrix[rows]
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
    local[rows, :3, :3] = _rotations(rotation)
    rows, scale = values("scale", 3)
    local[rows, :3, :3] *= scale[:, None]
    rows, translation = values("translation", 3)
    local[rows, :3, 3] = translation
    rows, matrix = values("matrix", 16)
    local[rows] = matrix.reshape(-1, 4, 4).transpose(0, 2, 1)
    wrong = np.flatnonzero((np.abs(local[:, 3] - [0, 0, 0, 1]).max(1) > _AFFINE) & local.any((1, 2)))
    if wrong.size:
        must = f"must have a matrix by columns, the last row of which is 0 0 0 1, in node {order[wrong[0]]}"
        raise document.error(must, str(local[wrong[0], 3].tolist()))
    return local


def _rotations(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrices [n 3 3] of quaternions x, y, z, w [n 4] of any length but zero."""
    scaled = quaternion / np.abs(quaternion).max(1, keepdims=True, initial=0)  # the length neither over- nor underflows
    x, y, z, w = (scaled / np.linalg.norm(scaled, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


class _Sampler(NamedTuple):
    """The keys of one channel."""

    time: np.ndarray  # of the keys in seconds, in ascending order [k]
    value: Elements  # n for each key, or 3 n in a cubic spline
    kind: str  # how values between keys are interpolated
    name: str  # for messages


def pose(document: Document, time: float, animation: str | int | None) -> set[str]:
    """Moves the nodes of a file to where an animation has them at a time.

    Each channel holds its first value before its first key and its last value after its last key (section 3.11), so
    times beyond the end show the end. What the animation does not move stays as the file has it.

    Args:
        document: The file. The fields of its nodes are replaced.
        time: Time in seconds from the start of the animation.
        animation: Name or index of the animation; None for the first one.

    Returns:
        Names of features of the animation that are not read.
    """
    index = _animation_index(document, animation)
    owner, item = f"animation {index}", document.items("animations")[index]
    samplers, ignored = document.field(item, "samplers", owner, list), set()
    moved: dict[int, JsonObject] = {}
    for name, channel in document.objects(item, "channels", owner, "channel"):
        target = document.field(channel, "target", name, dict)
        path = document.field(target, "path", name, str)
        if path not in _CHANNEL_WIDTH:
            ignored.add(_POINTER if path == "pointer" else f"animations of {excerpt(path)}")
        elif "node" in target:  # section 3.11: other channels are ignored
            node = document.index("nodes", target["node"], name)
            if path != "weights" and "matrix" in document.items("nodes")[node]:
                raise document.error(f"must have no matrix in node {node}, which {name} moves", "one")
            sampler = _sampler(document, samplers, channel.get("sampler"), path, name)
            value = _channel_value(document, sampler, path, time)
            if path == "rotation" and not value.any():
                raise document.error(f"must have a nonzero quaternion in {name} at {time:g} s", "zero")
            moved.setdefault(node, {})[path] = value.ravel().tolist()
    document.change("nodes", moved)
    return ignored


def _animation_index(document: Document, animation: str | int | None) -> int:
    """The index of an animation."""
    items = document.items("animations")
    if not items:
        raise document.error("must have animations where a time is given", "none")
    if not isinstance(animation, str):
        number = 0 if animation is None else animation
        if not 0 <= number < len(items):
            raise document.error(f"must have animation {number}", f"{len(items)} animations, numbered from 0")
        return number
    names = [item.get("name") for item in items]
    if animation not in names:
        raise document.error(
            f"must have an animation of the name {animation!r}", f"those of the names {excerpt(names)}"
        )
    return names.index(animation)


def _sampler(document: Document, samplers: list, value: Any, path: str, name: str) -> _Sampler:
    """The keys of a channel, with the checks of their counts and times."""
    item = samplers[document.index("samplers", value, name, samplers)]
    kind = item.get("interpolation", "LINEAR")
    if kind not in _INTERPOLATION:
        raise document.error(f"must have one of {', '.join(_INTERPOLATION)} as interpolation of {name}", excerpt(kind))
    keys = document.accessor(item.get("input"), f"times of {name}", 1).numbers()[:, 0]
    if not (np.isfinite(keys).all() and (np.diff(keys) >= 0).all() and keys[0] >= 0):
        wrong = np.flatnonzero(~np.isfinite(keys) | (np.diff(keys, prepend=0) < 0))[0]
        must = f"must have finite times from 0 on in ascending order in {name}"
        raise document.error(must, f"{keys[wrong]:g} s at key {wrong}")
    values = document.accessor(item.get("output"), f"values of {name}", _CHANNEL_WIDTH[path])
    if path == "weights" and values.value.dtype.kind != "f" and not values.most:
        raise document.error(f"must have floats or normalized integers as values of {name}", "others")
    size = len(keys) * (3 if kind == "CUBICSPLINE" else 1)
    count = len(values.value)
    if count % size if path == "weights" else count != size:
        must = f"{'a multiple of ' if path == 'weights' else ''}{size} values for the {len(keys)} keys"
        raise document.error(f"must have {must} of {name}, whose interpolation is {kind}", count)
    return _Sampler(keys, values, kind, name)


def _channel_value(document: Document, sampler: _Sampler, path: str, time: float) -> np.ndarray:
    """The value of a channel at a time (appendix C): rows of the elements of one key."""
    keys, cubic = sampler.time, sampler.kind == "CUBICSPLINE"
    height = len(sampler.value.value) // len(keys)

    def rows(key: int) -> np.ndarray:
        value = sampler.value.numbers(slice(key * height, (key + 1) * height))
        if not np.isfinite(value).all():
            raise document.error(f"must have finite values in {sampler.name}", f"others at key {key}")
        return value

    def middle(key: int) -> np.ndarray:
        return np.split(rows(key), 3)[1] if cubic else rows(key)

    last = int(np.searchsorted(keys, time, side="right")) - 1
    if last < 0 or last == len(keys) - 1 or sampler.kind == "STEP":
        return middle(max(last, 0))
    step = keys[last + 1] - keys[last]
    along = (time - keys[last]) / step
    if cubic:
        return _hermite(np.split(rows(last), 3), np.split(rows(last + 1), 3), step, along)
    if path == "rotation":
        return slerp(middle(last)[0], middle(last + 1)[0], along)[None]
    return (1 - along) * middle(last) + along * middle(last + 1)


def _hermite(before: Sequence[np.ndarray], after: Sequence[np.ndarray], step: float, along: float) -> np.ndarray:
    """The cubic spline between two keys, each with its in-tangent, its value and its out-tangent (appendix C.5)."""
    # `along` is the fraction of the way, `step` the seconds between the keys, by which tangents are multiplied.
    square, cube = along**2, along**3
    start, end = 2 * cube - 3 * square + 1, 3 * square - 2 * cube
    leaving, entering = cube - 2 * square + along, cube - square
    return start * before[1] + step * leaving * before[2] + end * after[1] + step * entering * after[0]


def slerp(start: np.ndarray, end: np.ndarray, along: float) -> np.ndarray:
    """Unit quaternion at a fraction of the shorter way between two rotations (appendix C.4). Zero gives zero."""
    scale = np.linalg.norm(start) * np.linalg.norm(end)
    if scale == 0:
        return np.zeros(4)
    start, end = start / np.linalg.norm(start), end / np.linalg.norm(end)
    end = -end if start @ end < 0 else end
    sine, cosine = np.linalg.norm(start - end) * np.linalg.norm(start + end) / 2, start @ end
    if sine < _STRAIGHT:
        return (1 - along) * start + along * end
    angle = np.arctan2(sine, cosine)
    return (np.sin((1 - along) * angle) * start + np.sin(along * angle) * end) / sine
