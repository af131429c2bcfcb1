"""Messages between browser and Python: JSON with binary arrays, validated on receipt."""

import json
import math
import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

MOST_BYTES = 1 << 29  # largest message, such as one with an environment map
_LARGEST_HALF = 65504.0


class Reply(NamedTuple):
    """An answer: its JSON content, and arrays as bytes."""

    content: dict[str, Any]
    buffers: list[bytes]


class Lamp(NamedTuple):
    """A light that the user has added: a disk of constant radiance at infinity.

    Attributes:
        direction: Direction to the center of the disk, in the environment before it is rotated.
        angle: Angle from the center to the rim, in radians.
        radiance: Linear radiance of the disk.
    """

    direction: tuple[float, ...]
    angle: float
    radiance: tuple[float, ...]


class Look(NamedTuple):
    """Everything that a picture depends on. It is hashable, so that results can be cached by its fields.

    Attributes:
        system: Name of the system.
        light: Index of the light.
        turn: Angle by which the light is rotated about +y, in radians.
        lamps: Lights that the user has added.
        eye: Position of the viewer in world units.
        target: Point that the viewer looks at.
        field_of_view: Full vertical angle of view in radians.
        bounces: Whether interreflection between parts is included.
        material: Changed material parameters, named in `MATERIAL`, for each changed part.
    """

    system: str
    light: int
    turn: float
    lamps: tuple[Lamp, ...]
    eye: tuple[float, ...]
    target: tuple[float, ...]
    field_of_view: float
    bounces: bool
    material: tuple[tuple[str, tuple[tuple[str, Any], ...]], ...]


# Material parameters that can change: their number of values and largest value.
MATERIAL = {"roughness": (1, 1.0), "exponent": (1, 1e6), "f0": (1, 1.0), "diffuse": (3, 1.0), "specular": (3, 1.0)}


def look(message: Mapping[str, Any], *, systems: Sequence[str], lights: int) -> Look:
    """Parses the look that a message requests.

    Raises:
        ValueError: A field is missing, is not a finite number in its range, or names something that does not exist.
    """
    system = message.get("system")
    if not isinstance(system, str) or system not in systems:
        raise ValueError(f"the system must be one of {', '.join(systems)}, got {system!r}")
    light = message.get("light")
    if type(light) is not int or not 0 <= light < lights:
        raise ValueError(f"the light must be a number from 0 to {lights - 1}, got {light!r}")
    eye, target = (numbers(message, name, 3) for name in ("eye", "target"))
    if eye == target:
        raise ValueError(f"eye and target must be different points, got {list(eye)} for both")
    return Look(
        system,
        light,
        number(message, "turn", -math.inf, math.inf),
        tuple(_lamp(each) for each in _items(message, "lamps")),
        eye,
        target,
        number(message, "field_of_view", 1e-3, math.pi - 1e-3),
        bool(message.get("bounces", False)),
        _materials(message.get("materials", {})),
    )


def number(message: Mapping[str, Any], name: str, low: float, high: float) -> float:
    """Reads a finite number from a message.

    Raises:
        ValueError: The field is not a finite number, or is out of range.
    """
    value = message.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{name} must be a finite number, got {value!r}")
    if not low <= value <= high:
        raise ValueError(f"{name} must be from {low:g} to {high:g}, got {value:g}")
    return float(value)


def numbers(
    message: Mapping[str, Any], name: str, count: int, *, low: float = -1e30, high: float = 1e30
) -> tuple[float, ...]:
    """Reads a list of `count` finite numbers from a message.

    Raises:
        ValueError: The field has another number of values, or a value is not a finite number in the range.
    """
    value = _items(message, name)
    if len(value) != count:
        raise ValueError(f"{name} must be {count} numbers, got {len(value)}")
    return tuple(number({name: each}, name, low, high) for each in value)


def pack(content: Mapping[str, Any], buffers: Sequence[bytes]) -> bytes:
    """Packs a message and its arrays into bytes: the length of the JSON, the JSON, and the arrays."""
    head = json.dumps({"content": content, "lengths": [len(each) for each in buffers]}, allow_nan=False).encode()
    head += b" " * (-(len(head) + 4) % 8)  # arrays are aligned to eight bytes
    return b"".join([struct.pack("<I", len(head)), head, *(each + bytes(-len(each) % 8) for each in buffers)])


def unpack(data: bytes) -> tuple[dict[str, Any], list[bytes]]:
    """Unpacks bytes from `pack` into the message and its arrays.

    Raises:
        ValueError: The bytes are not a packed message.
    """
    try:
        (length,) = struct.unpack_from("<I", data)
        head = json.loads(data[4 : 4 + length])
        content, lengths, buffers, place = dict(head["content"]), head["lengths"], [], 4 + length
        for each in lengths:
            if type(each) is not int or not 0 <= each <= len(data) - place:
                raise ValueError(each)
            buffers.append(data[place : place + each])
            place += each + -each % 8
    except (struct.error, ValueError, KeyError, TypeError, RecursionError):
        raise ValueError(
            f"a message must have the binary form that the viewer sends, got {len(data)} bytes in another form"
        ) from None
    return content, buffers


def encode(color: ArrayLike, *, stops: float | None) -> tuple[bytes, float]:
    """Encodes linear colors as bytes.

    Args:
        color: Linear colors with three channels in the last axis.
        stops: Exposure in stops. Colors are then exposed, encoded as 8-bit sRGB and compressed with zlib. None encodes
            half floats.

    Returns:
        The bytes, and the factor by which half floats must be multiplied. It is 1 unless the brightest color exceeds
        the range of half floats.
    """
    value = np.asarray(color, np.float32)
    if stops is None:
        scale = max(1.0, float(np.max(np.abs(value), initial=0.0)) / _LARGEST_HALF)
        return np.clip(value / np.float32(scale), -_LARGEST_HALF, _LARGEST_HALF).astype("<f2").tobytes(), scale
    exposed = np.clip(value * np.float32(2.0**stops), 0, 1)
    display = np.where(exposed <= 0.0031308, 12.92 * exposed, 1.055 * exposed ** (1 / 2.4) - 0.055)
    level = np.round(255 * display).astype(np.uint8)
    # Differences between successive entries of a channel compress better, because neighbors are similar.
    flat = np.moveaxis(level.reshape(-1, level.shape[-1]), -1, 0)
    return zlib.compress(np.diff(flat, axis=1, prepend=np.uint8(0)).tobytes(), 1), 1.0


def _items(message: Mapping[str, Any], name: str) -> Sequence[Any]:
    value = message.get(name, [])
    if not isinstance(value, list | tuple):
        raise ValueError(f"{name} must be a list, got {value!r}")
    return value


def _lamp(message: Any) -> Lamp:
    if not isinstance(message, Mapping):
        raise ValueError(f"a lamp must have a direction, an angle and a radiance, got {message!r}")
    direction = numbers(message, "direction", 3)
    if not 1e-6 < math.hypot(*direction) < 1e6:
        raise ValueError(f"the direction of a lamp must have a length between 1e-6 and 1e6, got {list(direction)}")
    return Lamp(direction, number(message, "angle", 1e-3, math.pi), numbers(message, "radiance", 3, low=0.0, high=1e9))


def _materials(message: Any) -> tuple[tuple[str, tuple[tuple[str, Any], ...]], ...]:
    if not isinstance(message, Mapping):
        raise ValueError(f"materials must be a dictionary from names of parts, got {message!r}")
    return tuple(sorted((str(name), _material(name, value)) for name, value in message.items()))


def _material(part: str, message: Any) -> tuple[tuple[str, Any], ...]:
    if not isinstance(message, Mapping) or not set(message) <= set(MATERIAL):
        raise ValueError(
            f"the material of part {part!r} must be a dictionary with keys among {', '.join(MATERIAL)}, got {message!r}"
        )
    result = []
    for name in sorted(message):
        count, most = MATERIAL[name]
        found = numbers(message, name, count, low=0.0, high=most) if count > 1 else number(message, name, 0.0, most)
        result.append((name, found))
    return tuple(result)
