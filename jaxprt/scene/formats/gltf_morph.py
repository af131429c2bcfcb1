"""Morph targets of glTF files: differences of vertex attributes, added with the weights that a node or its mesh gives.

References in comments are to sections of the glTF 2.0 specification, https://registry.khronos.org/glTF/specs/2.0.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxprt.scene.formats.gltf_file import Document
from jaxprt.scene.formats.gltf_header import excerpt
from jaxprt.scene.formats.gltf_nodes import Node

# Attributes that targets change, and their numbers of components. The sign of a tangent stays (section 3.7.2.2).
_ATTRIBUTES = {"POSITION": (3,), "NORMAL": (3,), "TANGENT": (3,), "COLOR_0": (3, 4)}
_ATTRIBUTES |= {"TEXCOORD_0": (2,), "TEXCOORD_1": (2,)}


def weights(document: Document, node: Node, mesh: int, count: int) -> tuple[float, ...]:
    """The weights of the morph targets of a node's mesh: those of the node, or else of the mesh, or else 0.

    Args:
        document: The file.
        node: The node.
        mesh: Index of its mesh.
        count: Number of targets of the mesh.

    Raises:
        ValueError: There are more or fewer weights than targets, or they are not finite.
    """
    if not count:
        return ()
    for item, owner in ((node.item, f"node {node.number}"), (document.items("meshes")[mesh], f"mesh {mesh}")):
        if "weights" in item:
            what = f"the weights of {owner}, one for each morph target of mesh {mesh}"
            return tuple(document.numbers(item["weights"], (count,), what).tolist())
    return (0.0,) * count


def change(
    document: Document,
    targets: Sequence[Any],
    weight: Sequence[float],
    *,
    key: str,
    used: np.ndarray,
    count: int,
    name: str,
) -> np.ndarray | float:
    """What the morph targets of a primitive add to one attribute of some vertices. Targets of weight 0 are not read.

    Args:
        document: The file.
        targets: The targets, as they stand in the file; may be empty.
        weight: Weights of the targets.
        key: Name of the attribute.
        used: Indices of the vertices.
        count: Number of vertices of the primitive.
        name: Name of the primitive, for messages.

    Raises:
        ValueError: The primitive has another number of targets, or a target has other vertices or is not finite.
    """
    if not targets:
        return 0.0
    if len(targets) != len(weight):
        raise document.error(f"must have {len(weight)} morph targets in {name}, as in its mesh", str(len(targets)))
    total: np.ndarray | float = 0.0
    for number, (target, share) in enumerate(zip(targets, weight, strict=True)):
        owner = f"morph target {number} of {name}"
        if not isinstance(target, dict):
            raise document.error(f"must have an object for {owner}", excerpt(target))
        if not share or key not in target:
            continue
        elements = document.accessor(target[key], f"{key} of {owner}", *_ATTRIBUTES[key])
        if len(elements.value) != count:
            got = str(len(elements.value))
            raise document.error(f"must have {count} elements in {key} of {owner}, as in POSITION", got)
        difference = elements.numbers(used)
        if not np.isfinite(difference).all():
            wrong = np.flatnonzero(~np.isfinite(difference).all(1))
            got = f"{len(wrong)} of {len(used)} that are not, the first at vertex {used[wrong[0]]}"
            raise document.error(f"must have finite numbers in {key} of {owner}", got)
        total = total + share * difference
    return total
