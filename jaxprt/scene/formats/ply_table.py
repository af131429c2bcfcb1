"""Elements of PLY files: the header, and tables in text or in bytes."""

import collections
import re
import struct
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from jaxprt.scene.formats import text

_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float32": "f4",
    "float64": "f8",
}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_CODES = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "i8": "q", "u8": "Q"}  # of struct
_BLOCK, _BYTES = 1 << 16, 1 << 24  # most rows with lists, and bytes of them, that are read at once


class Lists(NamedTuple):
    """The lists of one property: all items one after the other, and the length of each list."""

    value: np.ndarray
    length: np.ndarray


class Property(NamedTuple):
    """A property of an element. `length` is the type of the lengths of lists; None for single numbers."""

    name: str
    dtype: np.dtype
    length: np.dtype | None


class Element(NamedTuple):
    """A table of a PLY file, without its rows."""

    name: str
    rows: int
    properties: list[Property]

    @property
    def row_size(self) -> int:
        """Fewest bytes of a row in a binary file."""
        return sum((item.length or item.dtype).itemsize for item in self.properties)


class Header(NamedTuple):
    """The header of a PLY file.

    Attributes:
        order: Byte order, "<" or ">"; "" for text.
        elements: The elements, in the order of their tables.
        comments: Comments without their keyword.
        end: Position of the first byte after the header.
    """

    order: str
    elements: list[Element]
    comments: list[str]
    end: int


Columns = dict[str, np.ndarray | Lists]


def read_header(content: bytes) -> Header:
    """Reads the header.

    Raises:
        ValueError: The header is damaged, or counts more rows than the file has bytes for.
    """
    start = re.match(rb"ply[ \t]*(\r\n|\n|\r)", content)
    if not start:
        raise ValueError(f"it must start with a line 'ply', got {content[:8]!r}")
    line_end = rb"\r" if start[1] == b"\r" else rb"\r?\n"
    end = re.compile(rb"[\r\n]end_header[ \t]*(?:" + line_end + rb"|\Z)").search(content)
    if not end:
        raise ValueError("its header must end with a line 'end_header'")
    order, comments = None, []
    elements: list[Element] = []
    for line in re.split(rb"[\r\n]+", content[start.end() : end.start()]):
        keyword, rest = [*text.name(line).split(None, 1), "", ""][:2]
        words = rest.split()
        try:
            if keyword == "format":
                order = _ORDERS[words[0]]
            elif keyword == "element":
                elements.append(Element(words[0], int(words[1]), []))
            elif keyword == "property":
                elements[-1].properties.append(_property(words, order or ""))
            elif keyword == "comment":
                comments.append(rest.strip())
        except (KeyError, IndexError, ValueError):
            raise ValueError(f"its header has a line that is not known, {text.name(line)[:80]!r}") from None
    if order is None:
        raise ValueError(f"its header must state a format, one of {', '.join(_ORDERS)}")
    header = Header(order, elements, comments, end.end())
    _check_counts(header, len(content) - header.end)
    return header


def _property(words: list[str], order: str) -> Property:
    types = [np.dtype(order + _TYPES[word]) for word in words[:-1] if word != "list"]
    if (words[0] == "list") != (len(types) == 2) or (len(types) == 2 and types[0].kind == "f"):
        raise ValueError
    return Property(words[-1].lower(), types[-1], types[0] if len(types) == 2 else None)


def _check_counts(header: Header, size: int) -> None:
    """Refuses headers that count more rows than the file can hold, before memory is allocated for them."""
    names: set[str] = set()
    for element in header.elements:
        if element.rows < 0 or element.name in names:
            raise ValueError(f"its header must have one element {element.name!r} with 0 or more rows")
        names.add(element.name)
    # In text a number takes a digit and a space or line end, and the last line end may be missing.
    needed = sum(e.rows * (e.row_size if header.order else 2 * len(e.properties)) for e in header.elements)
    needed -= 0 if header.order else 1
    if needed > size:
        rows = ", ".join(f"{element.rows} {element.name}" for element in header.elements)
        raise ValueError(
            f"its header counts the rows {rows}, which take {needed} bytes or more, but {size} bytes follow"
        )


def memory(header: Header, size: int) -> int:
    """Most bytes that `read_elements` needs, as measured, for a file of `size` bytes."""
    rows = sum(element.rows for element in header.elements if any(item.length for item in element.properties))
    return 3 * size + 20 * rows + 4 * min(_BYTES, size) if header.order else 16 * size


def read_elements(content: bytes, header: Header, names: set[str], lists: set[str]) -> dict[str, Columns]:
    """Reads the tables of the named elements: the columns by the names of their properties.

    Numbers of text files are float64, and others have the type of the header.

    Args:
        content: The file.
        header: The header of the file.
        names: Names of the elements.
        lists: Names of the properties whose lists are read. Other lists have their lengths, but no items.

    Raises:
        ValueError: A row is damaged or missing.
    """
    tables: dict[str, Columns] = {}
    rows = text.rows(content[header.end :].replace(b"\r\n", b"\n").replace(b"\r", b"\n")) if not header.order else None
    at = header.end
    for element in header.elements:
        if not element.properties:
            continue
        read = element.name in names
        if rows is not None:
            columns = (_columns(table, element, lists) for table in text.tables(rows, element.rows, element.name))
            blocks = [block for block in columns if read]  # other rows are read too, because the next ones follow
        elif all(item.length is None for item in element.properties):
            blocks, at = [_fixed(content, at, element)], at + element.rows * element.row_size
        else:
            blocks, at = _variable(content, at, element, lists if read else None)
        if read:
            tables[element.name] = _joined(blocks, element)
    return tables


def _columns(table: text.Table, element: Element, lists: set[str]) -> Columns:
    """The columns of a block of rows of text."""
    columns: Columns = {}
    for index, item in enumerate(element.properties, 1):
        rest = len(element.properties) - index
        if item.length is None:
            columns[item.name] = _typed(table.column(rest), item.dtype)
        else:
            value, length = table.lists(rest)
            columns[item.name] = Lists(value if item.name in lists else value[:0].copy(), length)
    return columns


def _typed(value: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Numbers of text in the type of the header, which states the largest value of colors. Fractions stay floats."""
    if dtype.kind == "f" or (value != np.round(value)).any():
        return value
    limit = np.iinfo(dtype)
    return np.clip(value, limit.min, limit.max).astype(dtype) if limit.bits < 64 else value


def _fixed(content: bytes, at: int, element: Element) -> Columns:
    """The columns of rows without lists."""
    fields = [(f"{index}", item.dtype) for index, item in enumerate(element.properties)]
    row = np.frombuffer(content, np.dtype(fields), element.rows, at)
    return {item.name: row[f"{index}"] for index, item in enumerate(element.properties)}


def _variable(content: bytes, at: int, element: Element, lists: set[str] | None) -> tuple[list[Columns], int]:
    """The columns of rows with lists, in blocks, and the position after the last row. Without `lists`, no columns."""
    if not element.rows:
        return [], at
    equal = _equal_rows(content, at, element)
    if equal is not None:
        return [] if lists is None else [_equal_columns(equal, element, lists)], at + equal.nbytes
    starts = _row_starts(content, at, element)
    if lists is None:
        (end,) = collections.deque(starts, maxlen=1)
        return [], end
    start = np.fromiter(starts, np.int64, element.rows + 1)
    byte = np.frombuffer(content, np.uint8)
    blocks, first = [], 0
    while first < element.rows:
        end = int(np.searchsorted(start, start[first] + _BYTES, side="right")) - 1
        end = max(first + 1, min(end, first + _BLOCK))
        part = byte[start[first] : start[end]]
        blocks.append(_block_columns(part, start[first:end] - start[first], element, lists))
        first = end
    return blocks, int(start[-1])


def _block_columns(byte: np.ndarray, start: np.ndarray, element: Element, lists: set[str]) -> Columns:
    """The columns of the bytes of some rows, which start at the positions `start` in them."""

    def gather(dtype: np.dtype) -> np.ndarray:
        return byte[start[:, None] + np.arange(dtype.itemsize)].reshape(-1).view(dtype)

    columns: Columns = {}
    for item in element.properties:
        if item.length is None:
            columns[item.name] = gather(item.dtype)
            start = start + item.dtype.itemsize
            continue
        count = gather(item.length).astype(np.int64)
        start = start + item.length.itemsize
        end = start + item.dtype.itemsize * count
        items = byte[_within(start, end, len(byte))] if item.name in lists else byte[:0]
        columns[item.name] = Lists(items.view(item.dtype), count)
        start = end
    return columns


def _within(start: np.ndarray, end: np.ndarray, size: int) -> np.ndarray:
    """Whether each of `size` places is in one of several spans, which do not overlap."""
    step = np.zeros(size + 1, np.int8)
    np.add.at(step, start, 1)  # empty spans start and end at one place
    np.add.at(step, end, -1)
    return np.cumsum(step[:-1], dtype=np.int8).view(bool)


def _equal_rows(content: bytes, at: int, element: Element) -> np.ndarray | None:
    """A view of rows whose lists are all as long as those of the first row; None if they are not."""
    fields, offset = [], at
    for index, item in enumerate(element.properties):
        size = 1
        if item.length is not None:
            fields.append((f"length {index}", item.length))
            size = int(np.frombuffer(content, item.length, 1, offset)[0]) if offset < len(content) - 8 else -1
            offset += item.length.itemsize
        if size < 0 or offset + size * item.dtype.itemsize > len(content):
            return None
        fields.append((f"{index}", item.dtype, (size,)))
        offset += size * item.dtype.itemsize
    dtype = np.dtype(fields)
    if at + element.rows * dtype.itemsize > len(content):
        return None
    row = np.frombuffer(content, dtype, element.rows, at)
    counts = (row[f"length {index}"] for index, item in enumerate(element.properties) if item.length is not None)
    return None if any((count != count[0]).any() for count in counts) else row


def _equal_columns(row: np.ndarray, element: Element, lists: set[str]) -> Columns:
    """The columns of the rows of `_equal_rows`."""
    columns: Columns = {}
    for index, item in enumerate(element.properties):
        value = row[f"{index}"]
        if item.length is None:
            columns[item.name] = value[:, 0]
            continue
        items = value.reshape(-1) if item.name in lists else np.zeros(0, item.dtype)
        columns[item.name] = Lists(items, row[f"length {index}"].astype(np.int64))
    return columns


def _row_starts(content: bytes, at: int, element: Element) -> Iterator[int]:
    """The position of each row with lists, and of the end of the last one."""
    steps, skip = [], 0  # before each list: bytes to skip, reader of the length, bytes of the length and of an item
    for item in element.properties:
        if item.length is None:
            skip += item.dtype.itemsize
        else:
            length = struct.Struct(item.length.str[:-2].replace("|", "<") + _CODES[item.length.str[-2:]])
            steps.append((skip, length.unpack_from, length.size, item.dtype.itemsize))
            skip = 0
    for row in range(element.rows):
        yield at
        try:
            for before, unpack, size, step in steps:
                at += before
                (count,) = unpack(content, at)
                at += size + int(count) * step
                if count < 0:
                    raise ValueError(f"row {row + 1} of the {element.name} rows has a list of {count} items")
        except struct.error:
            at = len(content) + 1
        at += skip
        if at > len(content):
            raise ValueError(f"its header counts {element.rows} {element.name} rows, but it ends in row {row + 1}")
    yield at


def _joined(blocks: list[Columns], element: Element) -> Columns:
    """Joins the columns of blocks."""
    columns: Columns = {}
    for item in element.properties:
        parts = [block[item.name] for block in blocks]
        empty = np.zeros(0, item.dtype), np.zeros(0, np.int64)
        if len(parts) == 1:
            columns[item.name] = parts[0]
        elif item.length is None:
            columns[item.name] = np.concatenate(parts) if parts else empty[0]
        else:
            columns[item.name] = Lists(*map(np.concatenate, zip(*parts, strict=True))) if parts else Lists(*empty)
    return columns
