"""Messages between browser and Python: JSON with binary arrays, validated on receipt."""

import json
import math
import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxprt import require
from jaxprt.files.inputs import JsonObject
from jaxprt.image.tonemap import apply_curve

Changes = tuple[tuple[str, Any], ...]  # names of parameters of a material, and their values
Message = Mapping[str, Any]  # of the browser: the object that its JSON holds

MOST_BYTES = 1 << 29  # largest message, such as one with an environment map
_MOST_JSON = 1 << 24  # bytes of the JSON of a message; it takes many times its size in memory
_MOST_LAMPS = 1000
_LARGEST_INTEGER = 1 << 1000  # integers below it are floats too
_LARGEST_HALF = 65504.0


class Reply(NamedTuple):
    """An answer: its JSON content, and arrays as bytes."""

    content: JsonObject
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
    material: tuple[tuple[str, Changes], ...]


# Material parameters that can change: their number of values and largest value.
MATERIAL = {
    "roughness": (1, 1.0),
    "exponent": (1, 1e6),
    "metallic": (1, 1.0),
    "f0": (1, 1.0),
    "diffuse": (3, 1.0),
    "specular": (3, 1.0),
}


def look(message: Message, *, systems: Sequence[str], lights: int) -> Look:
    """Parses the look that a message requests.

    Raises:
        ValueError: A field is missing, is not a finite number in its range, or names something that does not exist.
    """
    name = system(message, systems)
    light = message.get("light")
    if type(light) is not int or not 0 <= light < lights:
        raise ValueError(f"the light must be a number from 0 to {lights - 1}, got {_shorten(light)}")
    eye, target = (numbers(message, name, 3) for name in ("eye", "target"))
    if eye == target:
        raise ValueError(f"eye and target must be different points, got {list(eye)} for both")
    return Look(
        name,
        light,
        number(message, "turn", -math.inf, math.inf),
        _lamps(message),
        eye,
        target,
        number(message, "field_of_view", 1e-3, math.pi - 1e-3),
        truth(message, "bounces"),
        _materials(message.get("materials", {})),
    )


def system(message: Message, systems: Sequence[str]) -> str:
    """The name of the system that a message requests."""
    name = message.get("system")
    if not isinstance(name, str) or name not in systems:
        raise ValueError(f"the system must be one of {', '.join(systems)}, got {_shorten(name)}")
    return name


def number(message: Message, name: str, low: float, high: float) -> float:
    """Reads a finite number from a message."""
    value = message.get(name)
    large = isinstance(value, int) and abs(value) >= _LARGEST_INTEGER  # float() would raise OverflowError
    if isinstance(value, bool) or not isinstance(value, int | float) or large or not math.isfinite(value):
        raise ValueError(f"{name} must be a finite number, got {_shorten(value)}")
    if not low <= value <= high:
        raise ValueError(f"{name} must be from {low:g} to {high:g}, got {value:g}")
    return float(value)


def truth(message: Message, name: str) -> bool:
    """Reads a field that is true or false; false if it is missing."""
    value = message.get(name, False)
    if not isinstance(value, bool):
        raise ValueError(f"{name} must be true or false, got {_shorten(value)}")
    return value


def text(message: Message, name: str) -> str:
    """Reads a field that is text; empty if it is missing.

    Raises:
        ValueError: The field is something else.
    """
    value = message.get(name, "")
    if not isinstance(value, str):
        raise ValueError(f"{name} must be text, got {_shorten(value)}")
    return value


def _shorten(value: object) -> str:
    """A value in an error message, cut off where it is long."""
    if isinstance(value, int) and abs(value) >= _LARGEST_INTEGER:
        return f"an integer of {value.bit_length()} bits"
    if isinstance(value, str | int | float | None):
        return ascii(value[:80]) if isinstance(value, str) else repr(value)
    return f"a {type(value).__name__}"


def numbers(message: Message, name: str, count: int, *, low: float = -1e30, high: float = 1e30) -> tuple[float, ...]:
    """Reads a list of `count` finite numbers from a message."""
    value = _items(message, name)
    if len(value) != count:
        raise ValueError(f"{name} must be {count} numbers, got {len(value)}")
    return tuple(number({name: item}, name, low, high) for item in value)


def pack(content: Message, buffers: Sequence[bytes]) -> bytes:
    """Packs a message and its arrays into bytes: the length of the JSON, the JSON, and the arrays."""
    head = json.dumps({"content": content, "lengths": [len(buffer) for buffer in buffers]}, allow_nan=False).encode()
    head += b" " * (-(len(head) + 4) % 8)  # arrays are aligned to eight bytes
    return b"".join([struct.pack("<I", len(head)), head, *(buffer + bytes(-len(buffer) % 8) for buffer in buffers)])


def unpack(data: bytes | bytearray) -> tuple[JsonObject, list[bytes]]:
    """Unpacks bytes from `pack` into the message and its arrays."""
    try:
        (length,) = struct.unpack_from("<I", data)
        if length > _MOST_JSON:
            raise ValueError(f"its JSON has {length} bytes")
        head = json.loads(bytes(data[4 : 4 + length]), parse_constant=_finite, parse_float=_finite, parse_int=_whole)
        content, lengths, buffers, place = head["content"], head["lengths"], [], 4 + length
        if not isinstance(content, dict) or not isinstance(lengths, list):
            raise TypeError("its JSON must have an object, `content`, and a list, `lengths`")
        for size in lengths:
            if type(size) is not int or not 0 <= size <= len(data) - place:
                raise ValueError(f"an array has {size} bytes")
            buffers.append(bytes(data[place : place + size]))
            place += size + -size % 8
    except (struct.error, ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(
            f"a message must have the binary form that the viewer sends, got {len(data)} bytes in another form: {error}"
        ) from None
    return content, buffers


def most_bytes() -> int:
    """Size of the largest message that is accepted: a quarter of the free memory, but not above `MOST_BYTES`.

    A dropped file is held as bytes, as an array and as a decoded picture.
    """
    free = require.available_memory()
    return MOST_BYTES if free is None else max(min(MOST_BYTES, free // 4), _MOST_JSON)


def _finite(text: str) -> float:
    """A number of JSON. `NaN` and `Infinity`, which Python also reads, and numbers beyond float64 are refused."""
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"numbers must be finite, got {text[:40]}")
    return value


def _whole(text: str) -> int:
    if len(text) > 400 or abs(int(text)) >= _LARGEST_INTEGER:
        raise ValueError(f"numbers must be in the range of float64, got {text[:40]}.. of {len(text)} digits")
    return int(text)


def encode(color: ArrayLike, *, stops: float | None, tone: str = "srgb") -> tuple[bytes, float]:
    """Encodes linear colors as bytes.

    Args:
        color: Linear colors with three channels in the last axis.
        stops: Exposure in stops. Colors are then exposed, encoded as 8-bit sRGB and compressed with zlib. None encodes
            half floats.
        tone: Tone curve of the bytes, as `jaxprt.image.display` takes it. Half floats are linear.

    Returns:
        The bytes, and the factor by which half floats must be multiplied. It is 1 unless the brightest color exceeds
        the range of half floats.
    """
    # Pictures of absurd looks may not be finite, which neither half floats nor JSON can tell.
    value = np.nan_to_num(np.asarray(color, np.float32))
    if stops is None:
        scale = max(1.0, float(np.max(np.abs(value), initial=0.0)) / _LARGEST_HALF)
        return np.clip(value / np.float32(scale), -_LARGEST_HALF, _LARGEST_HALF).astype("<f2").tobytes(), scale
    level = np.round(255 * displayed(value, stops=stops, tone=tone)).astype(np.uint8)
    # Differences between successive entries of a channel compress better, because neighbors are similar.
    flat = np.moveaxis(level.reshape(-1, level.shape[-1]), -1, 0)
    return zlib.compress(np.diff(flat, axis=1, prepend=np.uint8(0)).tobytes(), 1), 1.0


def displayed(color: ArrayLike, *, stops: float, tone: str) -> Float[np.ndarray, "..."]:
    """Linear colors as `jaxprt.image.display` shows them, without a compiled program for each size."""
    exposed = apply_curve(np.asarray(color, np.float32) * np.float32(2.0**stops), tone, np)
    return np.where(exposed <= 0.0031308, 12.92 * exposed, 1.055 * exposed ** (1 / 2.4) - 0.055)


def _items(message: Message, name: str) -> Sequence[Any]:
    value = message.get(name, [])
    if not isinstance(value, list | tuple):
        raise ValueError(f"{name} must be a list, got {_shorten(value)}")
    return value


def _lamps(message: Message) -> tuple[Lamp, ...]:
    lamps = _items(message, "lamps")
    if len(lamps) > _MOST_LAMPS:
        raise ValueError(f"lamps must be at most {_MOST_LAMPS}, got {len(lamps)}")
    return tuple(_lamp(lamp) for lamp in lamps)


def _lamp(message: object) -> Lamp:
    if not isinstance(message, Mapping):
        raise ValueError(f"a lamp must have a direction, an angle and a radiance, got {_shorten(message)}")
    direction = numbers(message, "direction", 3)
    if not 1e-6 < math.hypot(*direction) < 1e6:
        raise ValueError(f"the direction of a lamp must have a length between 1e-6 and 1e6, got {list(direction)}")
    return Lamp(direction, number(message, "angle", 1e-3, math.pi), numbers(message, "radiance", 3, low=0.0, high=1e9))


def _materials(message: object) -> tuple[tuple[str, Changes], ...]:
    if not isinstance(message, Mapping):
        raise ValueError(f"materials must be a dictionary from names of parts, got {_shorten(message)}")
    return tuple(sorted((str(name), _material(name, value)) for name, value in message.items()))


def _material(part: str, message: object) -> Changes:
    if not isinstance(message, Mapping) or not set(message) <= set(MATERIAL):
        raise ValueError(
            f"the material of part {_shorten(part)} must be a dictionary with keys among {', '.join(MATERIAL)}, got "
            f"{', '.join(map(_shorten, message)) if isinstance(message, Mapping) else _shorten(message)}"
        )
    result = []
    for name in sorted(message):
        count, most = MATERIAL[name]
        entry = numbers(message, name, count, low=0.0, high=most) if count > 1 else number(message, name, 0.0, most)
        result.append((name, entry))
    return tuple(result)
