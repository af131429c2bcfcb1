"""The JSON header of glTF 2.0 files: objects that refer to each other by index, and fields whose types are checked."""

import json
import math
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxprt import require
from jaxprt.files import inputs

_SLACK = 64  # bytes of compressed data besides which a header can be short
_SHOWN = 80  # characters of a wrong value in messages
_LARGEST = 2**53  # JSON numbers are exact up to here
LARGEST_FLOAT = float(np.finfo(np.float32).max)


class Header:
    """The header of a glTF file. Errors name the file, the object and the field.

    Only what is used is checked, so that damage elsewhere does no harm. Each list is checked once.

    Attributes:
        path: The file.
        header: The JSON object.
    """

    def __init__(self, path: pathlib.Path, text: bytes):
        """Parses the header.

        Args:
            path: The file.
            text: The JSON text; a byte order mark is allowed.

        Raises:
            ValueError: The text is not JSON, holds a name twice in one object, or is not of version 2.
        """
        self.path = path
        self._items: dict[str, list[dict[str, Any]]] = {}
        self._decoded = 0  # bytes
        try:
            header = json.loads(text, object_pairs_hook=inputs.unique_names)  # section 2.6
        except (ValueError, RecursionError) as error:
            raise self.error("must be an undamaged glTF file", f"a header that is not JSON: {error}") from error
        if not isinstance(header, dict):
            raise self.error("must be an undamaged glTF file with an object as its header", excerpt(header))
        self.header: dict[str, Any] = header
        asset = self.object(header, "asset", "the file")
        version = str(asset.get("version", "none"))
        if not version.startswith("2."):
            raise self.error("must be an undamaged glTF file of version 2", f"version {version[:_SHOWN]}")
        least = str(asset.get("minVersion", "2.0"))
        if least != "2.0":
            raise self.error("must be a glTF file that needs no more than version 2.0", f"minVersion {least[:_SHOWN]}")

    def error(self, required: str, got: str) -> ValueError:
        """An error that names the file."""
        return ValueError(f"{self.path} {required}, got {got}")

    def items(self, kind: str) -> list[dict[str, Any]]:
        """All objects of a kind, such as "meshes"; may be empty."""
        if kind not in self._items:
            items = self.header.get(kind, [])
            must = f"must be an undamaged glTF file with a list of {kind}"
            if not isinstance(items, list):
                raise self.error(must, type(items).__name__)
            for number, item in enumerate(items):
                if not isinstance(item, dict):
                    raise self.error(f"{must}, all of them objects", f"{excerpt(item)} at {number}")
            self._items[kind] = items
        return self._items[kind]

    def change(self, kind: str, fields: Mapping[int, Mapping[str, Any]]) -> None:
        """Replaces fields of some objects of a kind, which the header itself keeps.

        Args:
            kind: The kind, such as "nodes".
            fields: New fields by the index of the object.
        """
        items = self.items(kind)
        self._items[kind] = [{**item, **fields.get(number, {})} for number, item in enumerate(items)]

    def index(self, kind: str, value: Any, owner: str) -> int:
        """The index of an object of a kind.

        Args:
            kind: The kind, such as "meshes".
            value: The index, read from the file and not checked yet.
            owner: The object that refers to it, for error messages.

        Raises:
            ValueError: There is no object with this index.
        """
        count = len(self.items(kind))
        if not _is_whole(value) or not 0 <= value < count:
            raise self.error(f"must refer to one of its {count} {kind} in {owner}", excerpt(value))
        return int(value)

    def item(self, kind: str, value: Any, owner: str) -> dict[str, Any]:
        """The object of a kind that has an index; arguments and errors are those of `index`."""
        return self.items(kind)[self.index(kind, value, owner)]

    def object(self, item: dict[str, Any], key: str, owner: str) -> dict[str, Any]:
        """A field that is an object; empty if it is missing."""
        return self._field(item, key, owner, dict, "an object", {})

    def array(self, item: dict[str, Any], key: str, owner: str) -> list:
        """A field that is a list; empty if it is missing."""
        return self._field(item, key, owner, list, "a list", [])

    def strings(self, item: dict[str, Any], key: str, owner: str) -> list[str]:
        """A field that is a list of strings; empty if it is missing."""
        values = self.array(item, key, owner)
        for value in values:
            if not isinstance(value, str):
                raise self.error(f"must have a list of strings for {key} of {owner}", f"{excerpt(value)} in it")
        return values

    def string(self, item: dict[str, Any], key: str, owner: str) -> str:
        """A field that is a string.

        Raises:
            ValueError: It is missing or of another type.
        """
        return self._field(item, key, owner, str, "a string", None)

    def boolean(self, item: dict[str, Any], key: str, owner: str) -> bool:
        """A field that is true or false; false if it is missing."""
        return self._field(item, key, owner, bool, "true or false", False)

    def integer(self, item: dict[str, Any], key: str, owner: str, default: int | None = None) -> int:
        """A field that is a whole number and not negative.

        Raises:
            ValueError: It is of another type, negative, or beyond 2^53; or it is missing and there is no default.
        """
        value = self._present(item, key, owner) if default is None else item.get(key, default)
        if not _is_whole(value) or not 0 <= value <= _LARGEST:
            raise self.error(f"must have a whole number of at least 0 for {key} of {owner}", excerpt(value))
        return int(value)

    def numbers(self, value: Any, shape: tuple[int, ...], what: str) -> np.ndarray:
        """Checks one number, or a list of numbers, and converts it to float64.

        Raises:
            ValueError: The numbers are of another type or count, or not finite in float32.
        """
        listed = value if shape else [value]
        right = isinstance(listed, list | tuple) and len(listed) == math.prod(shape)
        if not right or not all(type(number) in (int, float) and abs(number) <= LARGEST_FLOAT for number in listed):
            must = f"{math.prod(shape)} finite numbers" if shape else "a finite number"
            raise self.error(f"must have {must} for {what}", excerpt(value))
        return np.array(value, np.float64)

    def decoding(self, size: int, length: int, name: str, *, most: int) -> None:
        """Refuses compressed data that would become larger than they can, or than memory. Counts what is decoded.

        Args:
            size: Bytes that the header states for the decoded data.
            length: Bytes of the compressed data.
            name: The compressed data, for messages.
            most: Decoded bytes that one compressed byte can hold at most.
        """
        if size > most * (length + _SLACK):
            raise self.error(f"must have at most {most} decoded bytes for each byte of {name}", f"{size} for {length}")
        self._decoded += size
        require.memory(f"the decoded data of {self.path}", self._decoded, "load a smaller scene")

    def _field(self, item: dict[str, Any], key: str, owner: str, kind: type, name: str, default: Any) -> Any:
        value = self._present(item, key, owner) if default is None else item.get(key, default)
        if not isinstance(value, kind):
            raise self.error(f"must have {name} for {key} of {owner}", excerpt(value))
        return value

    def _present(self, item: dict[str, Any], key: str, owner: str) -> Any:
        if key not in item:
            raise self.error("must be an undamaged glTF file", f"one that lacks {key!r} in {owner}")
        return item[key]


def excerpt(value: Any) -> str:
    """A value of a header for an error message, cut where it is long."""
    text = repr(value)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."


def _is_whole(value: Any) -> bool:
    """Whether a JSON number is whole, as 3 and 3.0 are. Booleans are no numbers."""
    return type(value) is int or (type(value) is float and value.is_integer())
