"""Skins of glTF files: meshes in the pose that the joints of the file have.

References in comments are to sections of the glTF 2.0 specification, https://registry.khronos.org/glTF/specs/2.0.
"""

from typing import NamedTuple

import numpy as np

from jaxprt.scene.formats.geometry import Geometry, cofactors
from jaxprt.scene.formats.gltf_file import Document, Elements


class Binding(NamedTuple):
    """The joints of vertices.

    Attributes:
        joint: Numbers of joints in the skin [v k].
        weight: Weights of the joints [v k].
    """

    joint: np.ndarray
    weight: np.ndarray


def binding(
    document: Document, attribute: dict[str, Elements], sets: int, used: np.ndarray, name: str
) -> Binding | None:
    """The joints of the used vertices of a primitive, from JOINTS_n and WEIGHTS_n (section 3.7.3.3).

    Weights are scaled to a sum of 1. A vertex without weights follows its first joint.

    Args:
        document: The file.
        attribute: Attributes of the primitive.
        sets: Number of sets of joints; 0 gives None.
        used: Indices of the used vertices.
        name: Name of the primitive, for messages.

    Raises:
        ValueError: A weight is negative or not finite.
    """
    if not sets:
        return None
    joint = np.concatenate([attribute[f"JOINTS_{number}"].rows(used) for number in range(sets)], 1).astype(np.int64)
    weight = np.concatenate([attribute[f"WEIGHTS_{number}"].numbers(used) for number in range(sets)], 1)
    wrong = np.flatnonzero(~(np.isfinite(weight) & (weight >= 0)).all(1))
    if wrong.size:
        got = f"{len(wrong)} of {len(weight)} vertices without, the first has {weight[wrong[0]].tolist()}"
        raise document.error(f"must have weights of joints of at least 0 in {name}", got)
    total = weight.sum(1, keepdims=True)
    first = np.eye(1, weight.shape[1])
    return Binding(joint, np.where(total > 0, weight / np.where(total > 0, total, 1), first))


def joints(document: Document, skin: int) -> list[int]:
    """Indices of the nodes that are the joints of a skin.

    Raises:
        ValueError: A joint is missing, or there are none.
    """
    item, owner = document.items("skins")[skin], f"skin {skin}"
    named = [document.index("nodes", joint, owner) for joint in document.array(item, "joints", owner)]
    if not named:
        raise document.error(f"must have one or more joints in {owner}", "none")
    return named


def joint_matrices(document: Document, skin: int, world: dict[int, np.ndarray]) -> np.ndarray:
    """Transforms from the space of a mesh to world coordinates, one for each joint of a skin [j 4 4] (section 3.7.3).

    Args:
        document: The file.
        skin: Index of the skin.
        world: World transforms of nodes by their indices.

    Raises:
        ValueError: A joint is missing, or there are fewer inverse bind matrices than joints.
    """
    item, owner, named = document.items("skins")[skin], f"skin {skin}", joints(document, skin)
    for joint in named:
        if joint not in world:
            raise document.error(f"must have joints of {owner} that belong to trees of nodes", f"node {joint}")
    matrix = np.array([world[joint] for joint in named])
    if "inverseBindMatrices" not in item:
        return matrix
    inverse = document.accessor(item["inverseBindMatrices"], f"inverseBindMatrices of {owner}", 16)
    if len(inverse.value) < len(named):
        must = f"must have an inverse bind matrix for each of the {len(named)} joints of {owner}"
        raise document.error(must, str(len(inverse.value)))
    columns = inverse.numbers(slice(len(named))).reshape(-1, 4, 4)
    if not np.isfinite(columns).all():
        raise document.error(f"must have finite inverse bind matrices in {owner}", "others")
    with np.errstate(over="ignore", invalid="ignore"):  # meshes refuse positions that are not finite
        return matrix @ columns.transpose(0, 2, 1)


def pose(document: Document, geometry: Geometry, bound: Binding, matrices: np.ndarray, name: str) -> Geometry:
    """A geometry in world coordinates, each vertex moved by the weighted mean of the transforms of its joints.

    Normals are transformed by the cofactors of this mean. Where it mirrors, faces are flipped.

    Args:
        document: The file.
        geometry: The geometry in the space of its mesh.
        bound: The joints of its vertices.
        matrices: Transforms of the joints [j 4 4].
        name: Name of the primitive, for messages.

    Raises:
        ValueError: A vertex refers to a joint that the skin does not have.
    """
    joint, weight = bound
    far = np.flatnonzero(((joint >= len(matrices)) & (weight > 0)).any(1))
    if far.size:
        got = f"{len(far)} of {len(joint)} vertices that refer to others, the first to {joint[far[0]].tolist()}"
        raise document.error(f"must refer to joints 0 to {len(matrices) - 1} in {name}", got)
    joint = np.minimum(joint, len(matrices) - 1)
    with np.errstate(over="ignore", invalid="ignore"):  # meshes refuse positions that are not finite
        mean = np.zeros((len(joint), 3, 4))
        for column in range(joint.shape[1]):
            mean += weight[:, column, None, None] * matrices[joint[:, column], :3]
        linear = mean[:, :, :3]
        cofactor = cofactors(linear)
        side = np.where((linear[:, 0] * cofactor[:, 0]).sum(1) < 0, -1.0, 1.0)
        turned = geometry._replace(position=_transform(linear, geometry.position) + mean[:, :, 3])
        if geometry.normal is not None:
            turned = turned._replace(normal=_transform(cofactor, geometry.normal) * side[:, None])
        if geometry.tangent is not None:
            plain = np.ones(len(joint)) if geometry.handedness is None else geometry.handedness
            turned = turned._replace(tangent=_transform(linear, geometry.tangent), handedness=plain * side)
    face = geometry.face
    mirrored = side[face].sum(1, keepdims=True) < 0
    return turned._replace(face=np.where(mirrored, face[:, ::-1], face))


def _transform(linear: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Each vector [v 3] transformed by the linear map of its vertex [v 3 3]."""
    return np.einsum("vij,vj->vi", linear, vector)
