"""Animations of glTF files: the transforms of nodes and the weights of morph targets at one time.

References in comments are to sections of the glTF 2.0 specification, https://registry.khronos.org/glTF/specs/2.0.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxprt.scene.formats.gltf_file import Document, Elements
from jaxprt.scene.formats.gltf_header import excerpt

_WIDTH = {"translation": 3, "rotation": 4, "scale": 3, "weights": 1}
_INTERPOLATION = ("LINEAR", "STEP", "CUBICSPLINE")
_POINTER = "KHR_animation_pointer"
_STRAIGHT = 1e-9  # sine of the angle between two rotations below which their mean is linear


class Sampler(NamedTuple):
    """The keys of one channel.

    Attributes:
        time: Times of the keys in seconds, in ascending order [k].
        value: The elements of the accessor of values: n for each key, or 3 n in a cubic spline.
        kind: How values between keys are interpolated.
        name: Name for messages.
    """

    time: np.ndarray
    value: Elements
    kind: str
    name: str


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

    Raises:
        ValueError: The file has no such animation, or it is damaged: times that are not in ascending order, values
            that are missing or not finite, a node with a matrix.
    """
    index = _index(document, animation)
    owner = f"animation {index}"
    item = document.items("animations")[index]
    samplers, ignored = document.array(item, "samplers", owner), set()
    moved: dict[int, dict[str, Any]] = {}
    for number, channel in enumerate(document.array(item, "channels", owner)):
        name = f"channel {number} of {owner}"
        if not isinstance(channel, dict):
            raise document.error(f"must have an object for {name}", excerpt(channel))
        target = document.object(channel, "target", name)
        path = document.string(target, "path", name)
        if path not in _WIDTH:
            ignored.add(_POINTER if path == "pointer" else f"animations of {excerpt(path)}")
            continue
        if "node" not in target:
            continue  # section 3.11: the channel is ignored
        node = document.index("nodes", target["node"], name)
        if path != "weights" and "matrix" in document.items("nodes")[node]:
            raise document.error(f"must have no matrix in node {node}, which {name} moves", "one")
        sampler = _sampler(document, samplers, channel.get("sampler"), path, name)
        value = _sampled(document, sampler, path, time)
        if path == "rotation" and not value.any():
            raise document.error(f"must have a nonzero quaternion in {name} at {time:g} s", "zero")
        moved.setdefault(node, {})[path] = value.ravel().tolist()
    document.change("nodes", moved)
    return ignored


def _index(document: Document, animation: str | int | None) -> int:
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
        raise document.error(f"must have an animation of the name {animation!r}", f"those of the names {names}")
    return names.index(animation)


def _sampler(document: Document, samplers: list, value: Any, path: str, name: str) -> Sampler:
    """The keys of a channel, with the checks of their counts and times."""
    right = type(value) is int and 0 <= value < len(samplers) and isinstance(samplers[value], dict)
    if not right:
        raise document.error(f"must refer to one of its {len(samplers)} samplers in {name}", excerpt(value))
    item = samplers[value]
    kind = item.get("interpolation", "LINEAR")
    if kind not in _INTERPOLATION:
        raise document.error(f"must have one of {', '.join(_INTERPOLATION)} as interpolation of {name}", excerpt(kind))
    keys = document.accessor(item.get("input"), f"times of {name}", 1).numbers()[:, 0]
    if not (np.isfinite(keys).all() and (np.diff(keys) >= 0).all() and keys[0] >= 0):
        wrong = np.flatnonzero(~np.isfinite(keys) | (np.diff(keys, prepend=0) < 0))[0]
        must = f"must have finite times from 0 on in ascending order in {name}"
        raise document.error(must, f"{keys[wrong]:g} s at key {wrong}")
    values = document.accessor(item.get("output"), f"values of {name}", _WIDTH[path])
    size = len(keys) * (3 if kind == "CUBICSPLINE" else 1)
    count = len(values.value)
    if count % size if path == "weights" else count != size:
        must = f"{'a multiple of ' if path == 'weights' else ''}{size} values for the {len(keys)} keys"
        raise document.error(f"must have {must} of {name}, whose interpolation is {kind}", str(count))
    return Sampler(keys, values, kind, name)


def _sampled(document: Document, sampler: Sampler, path: str, time: float) -> np.ndarray:
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
    if last < 0 or last == len(keys) - 1:
        value = middle(max(last, 0))
    else:
        step = keys[last + 1] - keys[last]
        along = (time - keys[last]) / step
        if sampler.kind == "STEP":
            value = middle(last)
        elif cubic:
            value = _hermite(np.split(rows(last), 3), np.split(rows(last + 1), 3), step, along)
        elif path == "rotation":
            value = slerp(middle(last)[0], middle(last + 1)[0], along)[None]
        else:
            value = (1 - along) * middle(last) + along * middle(last + 1)
    return value


def _hermite(before: Sequence[np.ndarray], after: Sequence[np.ndarray], step: float, along: float) -> np.ndarray:
    """The cubic spline between two keys, each with its in-tangent, its value and its out-tangent (appendix C.5).

    Args:
        before: The key before.
        after: The key after.
        step: Seconds between them, by which tangents are multiplied.
        along: Fraction of the way from one to the other.
    """
    square, cube = along**2, along**3
    start, end = 2 * cube - 3 * square + 1, 3 * square - 2 * cube
    leaving, entering = cube - 2 * square + along, cube - square
    return start * before[1] + step * leaving * before[2] + end * after[1] + step * entering * after[0]


def slerp(start: np.ndarray, end: np.ndarray, along: float) -> np.ndarray:
    """Unit quaternion at a fraction of the shorter way between two rotations (appendix C.4).

    Args:
        start: Quaternion [4] of any length. Zero gives zero.
        end: Quaternion [4] of any length.
        along: Fraction of the way, from 0 to 1.
    """
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
