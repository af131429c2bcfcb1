"""Named arrays on disk, written block by block along one axis: zarr, with what makes it safe to be killed.

A store is a folder. Each block of each array is one file, written aside and renamed; then the block's checksum is
entered. A block counts only if its checksum is there and right, so a process may be killed at any moment, files may
be lost or cut off, and what is read back is either what was written or reported missing.
"""

import os
import shutil
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import filelock
import numpy as np
import zarr

VERSION = 2
_FORMAT = "jaxprt blocks"


class Layout(NamedTuple):
    """Shape of one block of an array, and the axis along which blocks follow each other."""

    shape: tuple[int, ...]
    axis: int
    dtype: str


class BlockStore:
    """Arrays on disk in blocks.

    Args:
        path: Folder of the store; made when it is not there.
        header: What the arrays were made from, JSON values; must equal what an existing store says.
        layout: Per array, its blocks.
        blocks: Number of blocks.

    Raises:
        ValueError: The path holds something else, another format version, or arrays made from something else.
    """

    def __init__(self, path: str | os.PathLike, header: Mapping[str, Any], layout: Mapping[str, Layout], blocks: int):
        self.path = Path(path)
        self._layout = dict(layout)
        shapes = {name: [*at.shape, at.dtype] for name, at in layout.items()}
        header = {"format": _FORMAT, "version": VERSION, "blocks": blocks, "shapes": shapes, **header}
        if not self.path.exists():
            _create(self.path, header, self._layout, blocks)
        self._group = _open(self.path, header)
        lost = [name for name in (*self._layout, "checksum") if name not in self._group]
        if lost:
            raise ValueError(f"{self.path} lacks the array {lost[0]}: it is damaged; delete it to start anew")

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Holds the store for writing; the lock goes with the process, however it ends.

        Raises:
            BlockingIOError: Another process is writing to it.
        """
        lock = filelock.FileLock(self.path / ".lock", timeout=0)
        try:
            with lock:
                yield
        except filelock.Timeout:
            raise BlockingIOError(
                f"{self.path} is being written by another process; wait for it or name another path"
            ) from None

    def write(self, block: int, array: Mapping[str, np.ndarray]) -> None:
        """Writes one block of every array, in the layout's types, then its checksum."""
        array = {name: np.asarray(array[name], layout.dtype) for name, layout in self._layout.items()}
        for name, layout in self._layout.items():
            self._array(name)[_place(layout, block)] = array[name]
        self._array("checksum")[block] = _checksum(array)

    def read(self, block: int) -> dict[str, np.ndarray] | None:
        """One block of every array, or None where it was not written or is not what was written."""
        try:
            expected = int(self._read("checksum", block, ()))
            if not expected:
                return None
            array = {name: self._read(name, _place(at, block), at.shape) for name, at in self._layout.items()}
        except (ValueError, OSError, RuntimeError):
            return None
        return array if _checksum(array) == expected else None

    def _array(self, name: str) -> zarr.Array:
        found = self._group[name]
        assert isinstance(found, zarr.Array)
        return found

    def _read(self, name: str, place: Any, shape: tuple[int, ...]) -> np.ndarray:
        return np.asarray(self._array(name)[place]).reshape(shape)


def _create(path: Path, header: Mapping[str, Any], layout: Mapping[str, Layout], blocks: int) -> None:
    """Makes an empty store aside and moves it into place, so that a half-made one is never met."""
    aside = path.with_name(f"{path.name}.{os.getpid()}.new")
    shutil.rmtree(aside, ignore_errors=True)
    group = zarr.create_group(aside, attributes=dict(header))
    for name, (shape, axis, dtype) in layout.items():
        whole = (*shape[:axis], shape[axis] * blocks, *shape[axis + 1 :])
        group.create_array(name, shape=whole, chunks=shape, dtype=dtype, compressors=None, fill_value=0)
    group.create_array("checksum", shape=(blocks,), chunks=(1,), dtype="uint32", compressors=None, fill_value=0)
    try:
        aside.rename(path)
    except OSError:  # another process was faster; what it made is checked like any other
        shutil.rmtree(aside, ignore_errors=True)


def _open(path: Path, header: Mapping[str, Any]) -> zarr.Group:
    try:
        group = zarr.open_group(path, mode="r+")
        found = dict(group.attrs)
    except Exception as error:
        raise ValueError(f"{path} exists but is not a readable store of arrays ({error}); name another path") from error
    if found.get("format") != _FORMAT:
        raise ValueError(f"{path} exists but is no store of this package; name another path")
    if found.get("version") != VERSION:
        raise ValueError(f"{path} has format version {found.get('version')}, this package writes {VERSION}; delete it")
    differ = [key for key in header if found.get(key) != header[key]]
    if differ:
        told = "; ".join(f"{key}: there {found.get(key)}, now {header[key]}" for key in differ)
        raise ValueError(f"{path} holds arrays made from something else ({told}); name another path or delete it")
    return group


def _place(layout: Layout, block: int) -> tuple[slice, ...]:
    """Where a block lies in the whole array."""
    size = layout.shape[layout.axis]
    place = [slice(None)] * len(layout.shape)
    place[layout.axis] = slice(block * size, (block + 1) * size)
    return tuple(place)


def _checksum(array: Mapping[str, np.ndarray]) -> int:
    """CRC-32 of a block, never 0, which stands for not written."""
    value = 0
    for name in sorted(array):
        value = zlib.crc32(np.ascontiguousarray(array[name]).data, value)
    return value or 1
