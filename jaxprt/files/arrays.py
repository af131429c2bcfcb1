"""Named arrays on disk, written block by block along one axis: zarr, with what makes it safe to be killed.

A store is a folder. Each block of each array is one file, written aside and renamed; then the block's checksum is
entered. A block counts only if its checksum is there and right, so a process may be killed at any moment, files may
be lost or cut off, and what is read back is either what was written or reported missing.
"""

import functools
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

VERSION = 3
_FORMAT = "jaxprt blocks"
_SUMS = 32
_PART = 1 << 20  # values that are summed at a time
_STRIDE = 7919  # by which signs move from one part to the next


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
        near: Sketches, by `sketch`, of computed arrays that the store's were made from. They must equal those of an
            existing store up to rounding, which differs between kinds of processors.

    Raises:
        ValueError: The path holds something else, another version of the format or of the algorithm, or arrays made
            from something else.
    """

    def __init__(
        self,
        path: str | os.PathLike,
        header: Mapping[str, Any],
        layout: Mapping[str, Layout],
        blocks: int,
        near: Mapping[str, list[float]] | None = None,
    ):
        self.path = Path(path)
        self._layout = dict(layout)
        shapes = {name: [*at.shape, at.dtype] for name, at in layout.items()}
        header = {"format": _FORMAT, "version": VERSION, "blocks": blocks, "shapes": shapes, **header}
        near = dict(near or {})
        if not self.path.exists():
            _create(self.path, {**header, "near": near}, self._layout, blocks)
        self._group = _open(self.path, header, near)
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


def sketch(array: Any, *, tolerance: float = 1e-3) -> list[float]:
    """What tells an array from others of its shape: its norm, and sums of its values with random signs.

    The distance between the sums of two arrays is about that between the arrays.

    Args:
        array: Numbers.
        tolerance: Distance, as a share of the norm, up to which arrays count as the same: more than rounding changes
            on another kind of processor, and less than would be seen.

    Returns:
        The tolerance, the norm and the sums.
    """
    flat = np.asarray(array).reshape(-1)
    sign = _signs()
    total, square = np.zeros(_SUMS), 0.0
    for number, first in enumerate(range(0, len(flat), _PART)):
        part = flat[first : first + _PART].astype(np.float64)
        start = _STRIDE * number % _PART
        signed = part * sign[start : start + len(part)]
        total += np.pad(signed, (0, -len(part) % _SUMS)).reshape(-1, _SUMS).sum(0)
        square += float(part @ part)
    return [tolerance, float(np.sqrt(square)), *total.tolist()]


@functools.cache
def _signs() -> np.ndarray:
    """The signs of all sketches; making them takes longer than most sums."""
    return np.random.default_rng(0).choice(np.array([-1, 1], np.int8), 2 * _PART)


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


def _open(path: Path, header: Mapping[str, Any], near: Mapping[str, list[float]]) -> zarr.Group:
    try:
        group = zarr.open_group(path, mode="r+")
        found = dict(group.attrs)
        for each in path.iterdir():  # Arrays have headers of their own, which may be damaged too.
            if each.is_dir():
                group[each.name]
    except Exception as error:
        raise ValueError(f"{path} exists but is not a readable store of arrays ({error}); name another path") from error
    if found.get("format") != _FORMAT:
        raise ValueError(f"{path} exists but is no store of this package; name another path")
    if found.get("version") != VERSION:
        raise ValueError(f"{path} has format version {found.get('version')}, this package writes {VERSION}; delete it")
    before, now = found.get("algorithm"), header.get("algorithm")
    if before != now and found.get("system") == header.get("system"):
        raise ValueError(
            f"{path} was made by version {before} of the algorithm, this package has version {now}, which gives other "
            "results; delete it or name another path"
        )
    differ = [key for key in header if found.get(key) != header[key]]
    if differ:
        told = "; ".join(f"{key}: there {found.get(key)}, now {header[key]}" for key in differ)
        raise ValueError(f"{path} holds arrays made from something else ({told}); name another path or delete it")
    _check_near(path, found.get("near", {}), near)
    return group


def _check_near(path: Path, found: Any, near: Mapping[str, list[float]]) -> None:
    """Refuses a store whose arrays were made from others than these by more than rounding."""
    if sorted(found) != sorted(near):
        raise ValueError(f"{path} is damaged: it must have sketches of {sorted(near)}, got {sorted(found)}; delete it")
    for name, now in near.items():
        norm = max(now[1], found[name][1])
        distance = float(np.linalg.norm(np.subtract(now[2:], found[name][2:])))
        if not distance <= now[0] * norm:
            raise ValueError(
                f"{path} holds arrays made from something else ({name}: there and now differ by "
                f"{distance / (norm or 1):.2g} of the norm); name another path or delete it. Where it was factored or "
                "traced again on another machine, save it there by jaxprt.files.save and load it here"
            )


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
