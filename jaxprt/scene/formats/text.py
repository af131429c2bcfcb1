"""Text files: their encodings and line ends, and conversion of their words to numbers."""

import codecs
import contextlib
import io
import itertools
import pathlib
import warnings
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from jaxprt.files import inputs

# Marks of the encoding at the start of a file. Those of UTF-32 come first, because they start like those of UTF-16.
_MARKS = {
    codecs.BOM_UTF32_LE: "utf-32",
    codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
    codecs.BOM_UTF8: "utf-8-sig",
}
_BLANK = np.isin(np.arange(256), list(b" \t\n\v\f\r"))  # whether a byte separates words
_BLOCK = 1 << 16  # rows whose words are in memory at once


def read(path: pathlib.Path, what: str) -> bytes:
    """The content of a text file without a byte order mark, and with line feeds as line ends.

    UTF-16 and UTF-32 with a byte order mark become UTF-8. Other encodings stay, since only names use more than ASCII.

    Args:
        path: The file.
        what: Kind of the file for messages, such as "an OBJ file".

    Raises:
        ValueError: It is not a regular file, or not text.
    """
    content = inputs.content(path, what)
    try:
        content = plain(content)
        if b"\0" in content:
            raise ValueError
    except ValueError:  # UnicodeDecodeError is one
        raise ValueError(f"{path} must be {what}, got one that is not text") from None
    return content


def plain(content: bytes) -> bytes:
    """Text without a byte order mark, and with line feeds as line ends."""
    encoding = next((encoding for mark, encoding in _MARKS.items() if content.startswith(mark)), None)
    if encoding == "utf-8-sig":
        content = content[len(codecs.BOM_UTF8) :]
    elif encoding:
        content = content.decode(encoding).encode()
    if b"\r" in content:
        content = content.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    return content


def name(word: bytes) -> str:
    """A name in a text file: in UTF-8, or else in Windows-1252."""
    try:
        return word.decode()
    except UnicodeDecodeError:
        return word.decode("cp1252", errors="replace")


class Words(NamedTuple):
    """The words of rows of text."""

    text: bytes  # the rows, with line feeds between them
    start: np.ndarray  # position of the first byte of each word
    per_row: np.ndarray  # number of words of each row


def words(rows: Sequence[bytes]) -> Words:
    """Finds the words of rows of text."""
    joined = b"\n".join([row.rstrip() for row in rows])
    byte = np.frombuffer(joined, np.uint8)
    blank = np.ones(len(byte) + 1, bool)
    blank[1:] = _BLANK[byte]
    start = np.flatnonzero(blank[:-1] & ~blank[1:])
    end = np.append(np.flatnonzero(byte == ord("\n")), len(byte))
    return Words(joined, start, np.diff(np.searchsorted(start, end), prepend=0))


class RowError(ValueError):
    """A row of words, the index of which is `row`, that are not all numbers, or too few."""

    def __init__(self, row: int):
        super().__init__(f"row {row} has words that are not numbers, or too few")
        self.row = row


def numbers(words: Words, *, kind: type = float) -> np.ndarray:
    """Numbers from words, as float or int in 64 bits. Integers beyond these become the nearest one."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # older NumPy only warns of words that are not numbers
        number = _parse(words.text, len(words.start), kind)
        if number is not None:
            return number
        # The rows are parsed in the same way: other parsers take other words, such as Python's "1_000".
        for index, (row, count) in enumerate(zip(words.text.split(b"\n"), words.per_row.tolist(), strict=True)):
            if _parse(row, count, kind) is None:
                raise RowError(index)
    raise RowError(0)


def _parse(words: bytes, count: int, kind: type) -> np.ndarray | None:
    """The numbers of `count` words; None if they are not all numbers."""
    if not count:
        return np.zeros(0, kind)
    try:
        number = np.fromstring(words, kind, sep=" ")
    except (DeprecationWarning, ValueError):
        return None
    return number if len(number) == count else None  # "1-2" would be two numbers


class Table:
    """A block of rows of numbers, read from the left: the next number of all rows, or a list that states its length."""

    def __init__(self, rows: Sequence[bytes], what: str, first: int):
        """Splits rows into numbers.

        Args:
            rows: The rows.
            what: Name of the rows for messages, such as "vertex".
            first: Index of the first row.
        """
        self._what, self._first = what, first
        row_words = words(rows)
        try:
            self._number = numbers(row_words)
        except RowError as error:
            row = rows[error.row].strip()
            raise ValueError(
                f"row {first + error.row + 1} of the {what} rows must be numbers, got {name(row)[:80]!r}"
            ) from None
        self._end = np.cumsum(row_words.per_row)
        self._at = self._end - row_words.per_row

    def column(self, rest: int = 0) -> np.ndarray:
        """The next number of each row, of which `rest` or more must follow."""
        self._require(self._at + 1 + rest)
        value = self._number[self._at]
        self._at = self._at + 1
        return value

    def lists(self, rest: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """The next list of each row: all items, and the length of each list."""
        start, number = self._at, self.column(rest)
        count = whole(number)
        wrong = np.flatnonzero(has_fraction(number) | (count < 0))
        if wrong.size:
            raise ValueError(
                f"row {self._first + wrong[0] + 1} of the {self._what} rows must have a list of 0 or more numbers, "
                f"got {number[wrong[0]]:g}"
            )
        count = np.minimum(count, len(self._number) + 1)
        self._require(start + 1 + count + rest)
        value = self._number[list_indices(self._at, count)]
        self._at = self._at + count
        return value, count

    def remaining(self) -> tuple[np.ndarray, np.ndarray]:
        """The rest of each row: all numbers, and how many there are in each row."""
        count = self._end - self._at
        return self._number[list_indices(self._at, count)], count

    def _require(self, end: np.ndarray) -> None:
        wrong = np.flatnonzero(end > self._end)
        if wrong.size:
            row = wrong[0]
            length = self._end[row] - (self._end[row - 1] if row else 0)
            raise ValueError(
                f"row {self._first + row + 1} of the {self._what} rows must have {length + end[row] - self._end[row]} "
                f"numbers, but has {length}"
            )


def tables(rows: Iterator[bytes], count: int, what: str) -> Iterator[Table]:
    """Blocks of the next `count` rows, named `what` in messages. Refuses fewer rows, and those that are not numbers."""
    for first in range(0, count, _BLOCK):
        size = min(_BLOCK, count - first)
        block = list(itertools.islice(rows, size))
        if len(block) < size:
            raise ValueError(f"its header counts {count} {what} rows, but it has {first + len(block)}")
        yield Table(block, what, first)


def rows(content: bytes) -> Iterator[bytes]:
    """The lines of a text that are not empty."""
    return filter(bytes.strip, io.BytesIO(content))


def has_fraction(value: np.ndarray) -> np.ndarray:
    """Where numbers are finite, but not whole."""
    return np.isfinite(value) & (value != np.floor(value)) if value.dtype.kind == "f" else np.zeros(len(value), bool)


def whole(value: np.ndarray) -> np.ndarray:
    """Integers in 64 bits. Numbers that are too large or not finite become -1."""
    if value.dtype.kind in "iu":
        return value.astype(np.int64)
    limit = 1 << 62
    return np.where(np.abs(value) < limit, value, -1).astype(np.int64)


def whole_lists(value: np.ndarray, length: np.ndarray, what: str) -> np.ndarray:
    """Integers in 64 bits, as `whole` gives them, from the items of lists of given lengths, in rows named `what`."""
    wrong = np.flatnonzero(has_fraction(value))
    if wrong.size:
        row = np.searchsorted(np.cumsum(length), wrong[0], side="right")
        raise ValueError(f"row {row + 1} of the {what} rows must have whole numbers in its list, got {value[wrong[0]]}")
    return whole(value)


def list_indices(start: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Indices of the items of lists, from the index of the first item and the length of each list."""
    end = np.cumsum(count)
    return np.arange(end[-1] if len(end) else 0) + np.repeat(start - (end - count), count)


@contextlib.contextmanager
def name_file_in_errors(path: pathlib.Path, kind: str) -> Iterator[None]:
    """Makes all errors that a damaged file of a kind, such as "glTF", causes name the file."""
    must = f"{path} must be an undamaged {kind} file, got one that"
    try:
        yield
    except KeyError as error:
        raise ValueError(f"{must} lacks {error} where it is needed") from error
    except (IndexError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise ValueError(f"{must} cannot be read: {type(error).__name__}: {error}") from error
    except (ValueError, MemoryError) as error:
        if str(path) in str(error):
            raise
        if isinstance(error, MemoryError):
            raise MemoryError(f"{path}: {error}") from error
        raise ValueError(f"{must} cannot be read: {error}") from error
