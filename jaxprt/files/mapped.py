"""Arrays in files of NumPy's own format, mapped into memory instead of read.

A mapped array takes no memory of its own: the system reads its pages when they are first used, and drops them when
memory is short. `jax.device_put` on CPUs takes such an array as it is, without a copy, because its values begin at a
multiple of 64 bytes; on other devices it copies.
"""

import mmap
import os
import weakref
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

ALIGN = 64  # bytes at a multiple of which JAX takes an array without a copy, and NumPy's format begins its values
_VERSION = (1, 0)


def write_header(file: BinaryIO, shape: tuple[int, ...], dtype: str) -> None:
    """Writes what precedes the values of an array in NumPy's format."""
    descr = np.lib.format.dtype_to_descr(np.dtype(dtype))
    np.lib.format.write_array_header_1_0(file, {"descr": descr, "fortran_order": False, "shape": shape})


def read_header(path: Path, shape: tuple[int, ...], dtype: str) -> int:
    """Where the values of an array begin in its file.

    Raises:
        ValueError: It is no file of NumPy's format, or of another shape or type.
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
    """An array in a file, as a map that nothing can be assigned to.

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
    """Where the values of an array lie in a file: what travels to other processes in place of a map.

    Attributes:
        path: The file, by its whole path.
        offset: First byte.
        shape: Shape of the array.
        dtype: Element type of the array, as NumPy names it.
    """

    path: str
    offset: int
    shape: tuple[int, ...]
    dtype: str

    def open(self) -> np.ndarray:
        """The array, mapped here.

        Raises:
            FileNotFoundError: This machine does not see the file.
        """
        try:
            return open_array(Path(self.path), *self[1:])
        except FileNotFoundError as error:
            raise FileNotFoundError(f"{self.path} must be seen by all workers, in a folder that they share") from error


def reference(array: np.ndarray) -> np.ndarray | Reference:
    """A reference to the file of which an array is a map from its first value on.

    The array itself if it is no map, or if the file is not there any more or was replaced by another.
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


# Files, first bytes, and devices and numbers of these files, of living maps, by their addresses.
_maps: dict[int, tuple[str, int, tuple[int, int]]] = {}


def empty(shape: tuple[int, ...], dtype: str) -> np.ndarray:
    """An array in memory, without values, that JAX takes without a copy."""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    flat = np.empty(size + ALIGN, np.uint8)
    first = -flat.ctypes.data % ALIGN
    return flat[first : first + size].view(dtype).reshape(shape)


def read_into(file: Any, value: np.ndarray) -> None:
    """Fills an array with the bytes that follow in an unbuffered file.

    Raises:
        EOFError: The file ends before.
    """
    left = value.reshape(-1).view(np.uint8).data
    while left:
        count = file.readinto(left)
        if not count:
            raise EOFError(f"{file.name} ends {len(left)} bytes too early")
        left = left[count:]
