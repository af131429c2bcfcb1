"""Stores: named arrays on disk, written in blocks along one axis by any number of processes.

A store is a folder with a JSON header, one NumPy file for each array, and one NumPy file for the checksums of all
blocks. Every block has its own place in each file, so processes on one machine or several can write without
coordination. Any program that reads NumPy's format can map the arrays. A block counts only if its checksum is present
and correct. A process may therefore be killed at any moment, and files may be lost or truncated: every block that is
read is either as written or reported missing.

A mapped array takes no memory of its own: the operating system reads its pages when they are first used, and drops
them when memory is short. On CPUs, `jax.device_put` uses such an array without a copy, because its values begin at a
multiple of 64 bytes. On other devices it copies.
"""

import contextlib
import functools
import json
import mmap
import os
import re
import uuid
import weakref
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import filelock
import numpy as np

from jaxprt.files import inputs, outputs

ALIGN = 64  # alignment in bytes at which JAX needs no copy; values in NumPy's format have it too
_VERSION = (1, 0)
VERSION = 4
_FORMAT = "jaxprt blocks"
_HEADER = "store.json"
_CHECKSUM = "checksum"
_PATIENCE = 2.0  # seconds to wait for another writer's check
_SUMS = 32
_PART = 1 << 20  # values per partial sum
_MOST = 1e300  # largest number in a sketch
_STRIDE = 7919  # shift of the random signs from one part to the next


def write_header(file: BinaryIO, shape: tuple[int, ...], dtype: str) -> None:
    """Writes the header of an array in NumPy's format, which precedes its values."""
    descr = np.lib.format.dtype_to_descr(np.dtype(dtype))
    np.lib.format.write_array_header_1_0(file, {"descr": descr, "fortran_order": False, "shape": shape})


def read_header(path: Path, shape: tuple[int, ...], dtype: str) -> int:
    """Byte offset of the values of an array in its file."""
    with path.open("rb") as file:
        version = np.lib.format.read_magic(file)
        if version != _VERSION:
            raise ValueError(f"{path} must have version {_VERSION} of NumPy's format, got {version}")
        stored, fortran, kind = np.lib.format.read_array_header_1_0(file)
        if (stored, fortran, kind) != (tuple(shape), False, np.dtype(dtype)):
            raise ValueError(f"{path} must be {dtype} {list(shape)}, got {kind} {list(stored)}")
        return file.tell()


def open_array(path: Path, offset: int, shape: tuple[int, ...], dtype: str) -> np.ndarray:
    """A read-only memory map of an array in a file."""
    if 0 in shape:
        return np.zeros(shape, dtype)
    end = offset + int(np.prod(shape)) * np.dtype(dtype).itemsize
    with path.open("rb") as file:
        status = os.fstat(file.fileno())
        try:
            memory = mmap.mmap(file.fileno(), end, access=mmap.ACCESS_READ)
        except ValueError as error:
            raise ValueError(f"{path} must have {end} bytes, got {path.stat().st_size}: it is cut off") from error
    result = np.frombuffer(memory, dtype, int(np.prod(shape)), offset).reshape(shape)
    _maps[result.ctypes.data] = str(path.absolute()), offset, (status.st_dev, status.st_ino)
    weakref.finalize(memory, _maps.pop, result.ctypes.data)
    return result


class Reference(NamedTuple):
    """Location of an array's values in a file. It is sent to other processes in place of the memory map.

    Attributes:
        path: Absolute path of the file.
        offset: Offset of the first value in bytes.
        shape: Shape of the array.
        dtype: Element type of the array, in NumPy's notation.
    """

    path: str
    offset: int
    shape: tuple[int, ...]
    dtype: str

    def open(self) -> np.ndarray:
        """Maps the array in this process."""
        try:
            return open_array(Path(self.path), *self[1:])
        except FileNotFoundError as error:
            raise FileNotFoundError(f"{self.path} must be seen by all workers, in a folder that they share") from error


def reference(array: np.ndarray) -> np.ndarray | Reference:
    """Returns the file reference of a memory-mapped array.

    Returns the array itself if it is not a memory map, or if its file has been deleted or replaced.
    """
    mapping = _maps.get(array.ctypes.data) if array.size and array.flags.c_contiguous else None
    if mapping is None:
        return array
    path, offset, file = mapping
    try:
        status = os.stat(path)
    except OSError:
        return array
    same = (status.st_dev, status.st_ino) == file
    return Reference(path, offset, array.shape, array.dtype.str) if same else array


# For each live map, by address: its file, its offset, and the device and inode of the file.
_maps: dict[int, tuple[str, int, tuple[int, int]]] = {}


def empty(shape: tuple[int, ...], dtype: str) -> np.ndarray:
    """An uninitialized array in memory, aligned so that JAX uses it without a copy."""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    flat = np.empty(size + ALIGN, np.uint8)
    first = -flat.ctypes.data % ALIGN
    return flat[first : first + size].view(dtype).reshape(shape)


def read_into(file: Any, value: np.ndarray) -> None:
    """Fills an array with the next bytes of an unbuffered file."""
    left = value.reshape(-1).view(np.uint8).data
    while left:
        count = file.readinto(left)
        if not count:
            raise EOFError(f"{file.name} ends {len(left)} bytes too early")
        left = left[count:]


Header = Mapping[str, Any]  # of a store: what its arrays are computed from


class Layout(NamedTuple):
    """Shape of one block of an array, and the axis along which blocks follow each other."""

    shape: tuple[int, ...]
    axis: int
    dtype: str


class BlockStore:
    """Arrays on disk in blocks. It can be pickled; the pickle holds the path and the layout, not the arrays.

    Args:
        path: Folder of the store. It is created if it does not exist.
        header: Description of the inputs from which the arrays are computed, as JSON values. It must equal the header
            of an existing store.
        layout: Block shape, block axis and element type of each array.
        blocks: Number of blocks.
        near: Sketches, by `sketch`, of input arrays that were themselves computed. They must equal those of an existing
            store up to rounding, which differs between kinds of processors.

    Attributes:
        path: Folder of the store.
    """

    def __init__(
        self,
        path: str | os.PathLike,
        header: Header,
        layout: Mapping[str, Layout],
        blocks: int,
        near: Mapping[str, list[float]] | None = None,
    ):
        self.path = Path(path).absolute()
        self._layout = dict(layout)
        self._blocks = blocks
        shapes = {name: [*at.shape, at.dtype] for name, at in layout.items()}
        header = {"format": _FORMAT, "version": VERSION, "blocks": blocks, "shapes": shapes, **header}
        near = dict(near or {})
        files = {name: (_file_shape(at, blocks), at.dtype) for name, at in layout.items()}
        files[_CHECKSUM] = (blocks,), "uint32"
        if not self.path.exists():
            _create(self.path, {**header, "near": near}, files)
        self._key = _check_store(self.path, header, near)
        self._offset = {name: _offset(self.path, name, *form) for name, form in files.items()}

    @property
    def here(self) -> bool:
        """Whether the path is the same store on this machine: a worker may not share the file system."""
        try:
            return json.loads((self.path / _HEADER).read_text()).get("key") == self._key
        except (OSError, ValueError):
            return False

    @contextmanager
    def writing(self, part: tuple[int, int] = (1, 1)) -> Iterator[None]:
        """Locks the k-th of n parts of the store for writing. The lock is released however the process ends."""
        number, count = part
        lock = self.path / f".lock.{number}-of-{count}"
        try:
            with filelock.FileLock(lock, timeout=0):
                # Writers that divide the store into the same number of parts have other blocks. Others may overlap.
                for other in self.path.glob(".lock.*-of-*"):
                    if not other.name.endswith(f"-of-{count}"):
                        # Another writer may hold this lock for an instant, for the same check.
                        with filelock.FileLock(other, timeout=_PATIENCE):
                            pass
                yield
        except filelock.Timeout:
            what = "" if count == 1 else f", or part {number}/{count} of it runs already"
            raise BlockingIOError(
                f"{self.path} is being written by another process{what}; wait for it or name another path"
            ) from None

    def write(self, block: int, array: Mapping[str, np.ndarray]) -> None:
        """Writes one block of every array, converted to the layout's types, and then its checksum."""
        value = {name: np.ascontiguousarray(array[name], at.dtype) for name, at in self._layout.items()}
        for name, at in self._layout.items():
            if value[name].shape != at.shape:
                raise ValueError(f"{name} must have blocks of {list(at.shape)}, got {list(value[name].shape)}")
        try:
            for name, rows in value.items():
                self._put(name, block, rows)
            self._put(_CHECKSUM, block, np.array(self._checksum(block, value), np.uint32))
        except OSError as error:
            words = f"{self.path} cannot grow ({error.strerror}); finished blocks are kept: call again to go on"
            raise OSError(error.errno, words) from error

    def read(self, block: int) -> dict[str, np.ndarray] | None:
        """Reads one block of every array. Returns None if it was not written or its checksum is wrong."""
        try:
            expected = int(self._get(_CHECKSUM, block, (), "uint32"))
            if not expected:
                return None
            array = {name: self._get(name, block, at.shape, at.dtype) for name, at in self._layout.items()}
        except (EOFError, OSError):
            return None
        return array if self._checksum(block, array) == expected else None

    def written(self) -> np.ndarray:
        """Mask of the blocks that have a checksum. Only `read` verifies it."""
        sums = np.zeros(self._blocks, np.uint32)
        try:
            with (self.path / f"{_CHECKSUM}.npy").open("rb") as file:
                file.seek(self._offset[_CHECKSUM])
                data = file.read(sums.nbytes)
                there = np.frombuffer(data[: len(data) // 4 * 4], np.uint32)
        except OSError:
            return sums > 0
        sums[: len(there)] = there
        return sums > 0

    def whole(self, name: str, count: int) -> np.ndarray:
        """A whole array, cut to `count` entries along its block axis. All blocks must have been found by `read`.

        If the blocks follow each other along the first axis, the array is memory-mapped: pages are read when they are
        first used. Other arrays are copied into memory.
        """
        at = self._layout[name]
        if not at.axis:
            shape = _file_shape(at, self._blocks)
            return open_array(self.path / f"{name}.npy", self._offset[name], shape, at.dtype)[:count]
        size, before = at.shape[at.axis], (slice(None),) * at.axis
        result = empty((*at.shape[: at.axis], count, *at.shape[at.axis + 1 :]), at.dtype)
        for block in range(self._blocks):
            first = block * size
            values = self._get(name, block, at.shape, at.dtype)
            result[(*before, slice(first, first + size))] = values[(*before, slice(count - first))]
        return result

    def _checksum(self, block: int, array: Mapping[str, np.ndarray]) -> int:
        """CRC-32 of a block, its index and the store's key; never 0, which stands for a missing block."""
        value = zlib.crc32(f"{self._key} {block}".encode())
        for name in sorted(array):
            value = zlib.crc32(array[name].reshape(-1).view(np.uint8).data, value)
        return value or 1

    def _put(self, name: str, block: int, value: np.ndarray) -> None:
        """Writes a block of one array and closes the file, so that other machines see it."""
        left = value.reshape(-1).view(np.uint8).data
        with (self.path / f"{name}.npy").open("r+b", buffering=0) as file:
            file.seek(self._offset[name] + block * value.nbytes)
            while left:
                left = left[file.write(left) :]

    def _get(self, name: str, block: int, shape: tuple[int, ...], dtype: str) -> np.ndarray:
        value = np.empty(shape, dtype)
        with (self.path / f"{name}.npy").open("rb", buffering=0) as file:
            file.seek(self._offset[name] + block * value.nbytes)
            read_into(file, value)
        return value


def sketch(array: Any, *, tolerance: float = 1e-3) -> list[float]:
    """A short fingerprint of an array that tolerates rounding: its norm, and sums of its values with random signs.

    The distance between the sums of two arrays approximates the distance between the arrays.

    Args:
        array: An array of numbers.
        tolerance: Largest distance, relative to the norm, at which two arrays count as equal. It should be larger than
            the rounding differences between processors and smaller than visible differences.

    Returns:
        A list of the tolerance, the norm and the sums.
    """
    flat = np.asarray(array).reshape(-1)
    sign = _signs(2 * _PART)
    total, square = np.zeros(_SUMS), 0.0
    for number, first in enumerate(range(0, len(flat), _PART)):
        part = flat[first : first + _PART].astype(np.float64)
        start = _STRIDE * number % _PART
        signed = part * sign[start : start + len(part)]
        total += np.pad(signed, (0, -len(part) % _SUMS)).reshape(-1, _SUMS).sum(0)
        square += float(part @ part)
    return [tolerance, float(np.sqrt(square)), *total.tolist()]


@functools.cache
def _signs(count: int) -> np.ndarray:
    """The random signs of all sketches, cached because making them takes longer than most sums."""
    return np.random.default_rng(0).choice(np.array([-1, 1], np.int8), count)


def _create(path: Path, header: Header, files: Mapping[str, tuple[tuple[int, ...], str]]) -> None:
    """Creates an empty store."""
    try:
        with outputs.new_folder(path) as new:
            for name, (shape, dtype) in files.items():
                with (new / f"{name}.npy").open("xb") as file:
                    write_header(file, shape, dtype)
            (new / _HEADER).write_text(json.dumps({**header, "key": uuid.uuid4().hex}))
    except OSError:  # another process was faster; its store is checked like any other
        if not path.exists():
            raise


def _check_store(path: Path, header: Header, near: Mapping[str, list[float]]) -> str:
    """Refuses a store of other inputs. Returns the key of the store."""
    try:
        # Files are also written, so a link in a folder from a stranger could replace other files of the user.
        for lock in path.glob(".lock.*"):
            with contextlib.suppress(FileNotFoundError):  # released by another process
                inputs.check(lock, "a lock of a store of arrays", links=False)
        stored = inputs.store_header(path, _HEADER, "the header of a store of arrays")
    except Exception as error:
        raise ValueError(
            f"{path} exists but is not a readable store of arrays, or is damaged ({error}); name another path"
        ) from error
    if stored.get("format") != _FORMAT:
        raise ValueError(f"{path} exists but is not a store that jaxprt wrote; name another path")
    if stored.get("version") != VERSION:
        raise ValueError(f"{path} has format version {stored.get('version')}, this package writes {VERSION}; delete it")
    before, now = stored.get("algorithm"), header.get("algorithm")
    if before != now and stored.get("system") == header.get("system"):
        raise ValueError(
            f"{path} was made by version {before} of the algorithm, this package has version {now}, which gives other "
            "results; delete it or name another path"
        )
    differ = [key for key in header if stored.get(key) != header[key]]
    if differ:
        told = "; ".join(f"{key}: stored {str(stored.get(key))[:200]}, now {header[key]}" for key in differ)
        raise ValueError(
            f"{path} holds arrays that were computed from other inputs ({told}); name another path or delete it"
        )
    _check_near(path, stored.get("near", {}), near)
    key = stored.get("key")
    if not (isinstance(key, str) and re.fullmatch("[0-9a-f]{32}", key)):
        raise ValueError(f"{path} is damaged: its key must be 32 hexadecimal digits, got {str(key)[:80]}; delete it")
    return key


def _offset(path: Path, name: str, shape: tuple[int, ...], dtype: str) -> int:
    """Byte offset of the values of an array in its file."""
    file = path / f"{name}.npy"
    try:
        inputs.check(file, "a part of a store of arrays", links=False)
        return read_header(file, shape, dtype)
    except FileNotFoundError:
        raise ValueError(f"{path} lacks the array {name}: it is damaged; delete it to start anew") from None
    except Exception as error:  # NumPy raises other errors for some damaged headers
        raise ValueError(
            f"{path} exists but is not a readable store of arrays, or is damaged ({error}); name another path"
        ) from error


def _check_near(path: Path, stored: object, near: Mapping[str, list[float]]) -> None:
    """Refuses a store whose input arrays differ from these by more than rounding."""
    if not isinstance(stored, Mapping) or sorted(stored) != sorted(near):
        told = sorted(stored) if isinstance(stored, Mapping) else stored
        raise ValueError(f"{path} is damaged: it must have sketches of {sorted(near)}, got {told}; delete it")
    for name, now in near.items():
        before = stored[name]
        numbers = isinstance(before, list) and all(type(x) in (int, float) and abs(x) < _MOST for x in before)
        if not (numbers and len(before) == len(now)):
            raise ValueError(f"{path} is damaged: the sketch of {name} must have {len(now)} numbers; delete it")
    for name, now in near.items():
        norm = max(now[1], stored[name][1])
        distance = float(np.linalg.norm(np.subtract(now[2:], stored[name][2:])))
        if not distance <= now[0] * norm:
            raise ValueError(
                f"{path} holds arrays that were computed from other inputs ({name}: stored and given values differ by "
                f"{distance / (norm or 1):.2g} of the norm); name another path or delete it. Where it was factored or "
                "traced again on another machine, save it there by jaxprt.files.save and load it here"
            )


def _file_shape(at: Layout, blocks: int) -> tuple[int, ...]:
    """Shape of an array's file: that of the whole array if blocks are contiguous, else with a leading block axis."""
    return (blocks, *at.shape) if at.axis else (blocks * at.shape[0], *at.shape[1:])
