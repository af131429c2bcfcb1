"""Output files: written beside the old file, checked, and renamed, so that a failure leaves the old file as it was."""

import contextlib
import os
import pathlib
import secrets
import stat
from collections.abc import Iterator

from jaxprt import require


def target(path: str | os.PathLike, suffix: str) -> pathlib.Path:
    """Checks, before the work begins, that a file with this suffix can be written.

    Raises:
        TypeError: The path is not a path.
        ValueError: The suffix is another one.
        OSError: For the reasons of `replacing`, as far as they are known before the file is written.
    """
    require.path("path", path)
    if pathlib.Path(path).suffix.lower() != suffix:
        raise ValueError(f"path must end in {suffix}, because the file will be of that format, got {os.fspath(path)!r}")
    path = pathlib.Path(path)
    _old_mode(path, pathlib.Path(os.path.realpath(path)))
    return path


@contextlib.contextmanager
def replacing(path: str | os.PathLike) -> Iterator[pathlib.Path]:
    """A new, empty file in the same folder, which replaces `path` when the block ends without an error.

        with outputs.replacing("page.html") as file:
            file.write_text(page)

    The bytes are on the disk before the file is renamed. After an error, or Ctrl-C, the old file is unchanged, and the
    new one is removed. The permissions of an old file are kept. If the path is a symbolic link, its target is replaced.

    Args:
        path: The file.

    Yields:
        Path of the new file, with the suffix of `path`.

    Raises:
        FileNotFoundError: The folder does not exist.
        OSError: The path is a directory, a pipe or a device; the old file or the folder cannot be written; or the disk
            is full. The message names the path.
    """
    target = pathlib.Path(os.path.realpath(path))
    mode = _old_mode(path, target)
    # A short name: one made of the file's name could be too long for the file system.
    new = target.with_name(f".{secrets.token_hex(8)}.new{target.suffix if len(target.suffix) < 10 else ''}")
    try:
        new.open("xb").close()
    except OSError as error:
        raise _failed(path, error) from error
    try:
        yield new
        if mode is not None:
            new.chmod(mode)
        with new.open("rb+") as file:
            os.fsync(file.fileno())  # Some file systems report a full disk only here.
        new.replace(target)
    except OSError as error:
        raise _failed(path, error) from error
    finally:
        new.unlink(missing_ok=True)


def write(path: str | os.PathLike, content: bytes | str) -> None:
    """Writes a file as `replacing` does. Text is encoded as UTF-8, with the line ends that it has.

    Args:
        path: The file. An old one is replaced.
        content: The bytes or the text.

    Raises:
        OSError: The file cannot be written. The old file, if any, is unchanged.
    """
    with replacing(path) as file:
        file.write_bytes(content.encode() if isinstance(content, str) else content)


def _old_mode(path: str | os.PathLike, target: pathlib.Path) -> int | None:
    """Permissions of the file that will be replaced; None if there is none."""
    try:
        mode = target.stat().st_mode
    except FileNotFoundError:
        if not target.parent.is_dir():
            raise FileNotFoundError(f"{os.fspath(path)}: there is no folder {target.parent}") from None
        return None
    except OSError as error:
        raise _failed(path, error) from error
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(f"{os.fspath(path)} must be a file, got a directory")
    if not stat.S_ISREG(mode):  # Renaming would put a file in place of the device.
        raise OSError(f"{os.fspath(path)} must be a regular file, got a pipe, a socket or a device")
    if not os.access(target, os.W_OK):
        raise PermissionError(f"{os.fspath(path)} cannot be written: it is read-only")
    return stat.S_IMODE(mode)


def _failed(path: str | os.PathLike, error: OSError) -> OSError:
    """The same error about the file that the caller named."""
    words = f"{os.fspath(path)} cannot be written: {error.strerror or error}"
    named = type(error)(words)
    named.errno = error.errno
    return named
