"""Memory-mapped arrays in files of NumPy's format.

A mapped array takes no memory of its own: the operating system reads its pages when they are first used, and drops
them when memory is short. On CPUs, `jax.device_put` uses such an array without a copy, because its values begin at a
multiple of 64 bytes. On other devices it copies.
"""

import mmap
import os
import weakref
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

ALIGN = 64  # alignment in bytes at which JAX needs no copy; values in NumPy's format have it too
_VERSION = (1, 0)


def write_header(file: BinaryIO, shape: tuple[int, ...], dtype: str) -> None:
    """Writes the header of an array in NumPy's format, which precedes its values."""
    descr = np.lib.format.dtype_to_descr(np.dtype(dtype))
    np.lib.format.write_array_header_1_0(file, {"descr": descr, "fortran_order": False, "shape": shape})


def read_header(path: Path, shape: tuple[int, ...], dtype: str) -> int:
    """Byte offset of the values of an array in its file.

    Raises:
        ValueError: The file is not in NumPy's format, or has another shape or type.
    """
    with path.open("rb") as file:
        version = np.lib.format.read_magic(file)
        if version != _VERSION:
            raise ValueError(f"{path} must have version {_VERSION} of NumPy's format, got {version}")
        found, fortran, kind = np.lib.format.read_array_header_1_0(file)
        if (found, fortran, kind) != (tuple(shape), False, np.dtype(dtype)):
            raise ValueError(f"{path} must be {dtype} {list(shape)}, got {kind} {list(found)}")
        return file.tell()


def open_array(path: Path, offset: int, shape: tuple[int, ...], dtype: str) -> np.ndarray:
    """A read-only memory map of an array in a file.

    Raises:
        ValueError: The file is too short.
    """
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
        """Maps the array in this process.

        Raises:
            FileNotFoundError: This machine has no access to the file.
        """
        try:
            return open_array(Path(self.path), *self[1:])
        except FileNotFoundError as error:
            raise FileNotFoundError(f"{self.path} must be seen by all workers, in a folder that they share") from error


def reference(array: np.ndarray) -> np.ndarray | Reference:
    """Returns the file reference of a memory-mapped array.

    Returns the array itself if it is not a memory map, or if its file has been deleted or replaced.
    """
    found = _maps.get(array.ctypes.data) if array.size and array.flags.c_contiguous else None
    if found is None:
        return array
    path, offset, file = found
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
    """Fills an array with the next bytes of an unbuffered file.

    Raises:
        EOFError: The file ends too early.
    """
    left = value.reshape(-1).view(np.uint8).data
    while left:
        count = file.readinto(left)
        if not count:
            raise EOFError(f"{file.name} ends {len(left)} bytes too early")
        left = left[count:]
