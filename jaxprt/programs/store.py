"""Files of compiled programs in a folder of the user's cache.

A process that loads a program runs code from its file. The folder must therefore belong to the user, and nobody else
may write into it. Files start with a checksum of their name and content, so that a damaged file counts as absent. New
files appear by renaming, so that other processes see whole files only. Nothing here raises an error: a program that
cannot be kept is compiled again.
"""

import contextlib
import functools
import hashlib
import logging
import os
import pathlib
import platform
import stat
import subprocess
import sys
import tempfile
import time

MOST = 1 << 30  # bytes of all files; those that were used least recently are deleted
_LEFT = 0.75  # share of `MOST` that stays when files are deleted
_SCAN = 1 / 16  # share of `MOST` that a process writes before it measures the folder again
_ABANDONED = 3600  # seconds after which an unfinished file belongs to a process that has ended
_UNFINISHED = ".new-"
_DIGEST = hashlib.sha256().digest_size
_FEATURES = ("vendor_id", "cpu family", "model", "stepping", "flags", "Features", "CPU ")  # lines of /proc/cpuinfo

log = logging.getLogger("jaxprt")


def is_enabled() -> bool:
    """Whether programs are kept: not if the environment variable JAXPRT_KEEP_PROGRAMS is 0."""
    return os.environ.get("JAXPRT_KEEP_PROGRAMS", "1") != "0"


def folder() -> pathlib.Path:
    """The folder `jaxprt/programs` in the user's cache folder."""
    if sys.platform == "darwin":
        cache = "~/Library/Caches"
    elif sys.platform == "win32":
        cache = os.environ.get("LOCALAPPDATA", "~/AppData/Local")
    else:
        cache = os.environ.get("XDG_CACHE_HOME", "")
        cache = cache if os.path.isabs(cache) else "~/.cache"
    return pathlib.Path(os.path.expanduser(cache), "jaxprt", "programs")


@functools.cache
def processor() -> str:
    """The processor's model and instruction sets: programs of one processor may crash on another."""
    words = [platform.machine(), platform.processor()]
    with contextlib.suppress(OSError):
        if sys.platform == "darwin":
            words.append(subprocess.check_output(["/usr/sbin/sysctl", "-n", "machdep.cpu.brand_string"], text=True))
        else:
            with open("/proc/cpuinfo") as file:
                first = file.read(1 << 15).split("\n\n")[0]
            words += [line for line in first.split("\n") if line.startswith(_FEATURES)]
    return "\n".join(words)


class Store:
    """Files in a folder, of bounded size.

    Args:
        folder: The folder. It is created when the first file is written.
        most: Largest number of bytes of all files. Several processes that write at once may exceed it by 1/16 each.
    """

    def __init__(self, folder: pathlib.Path, most: int = MOST):
        self.folder = folder
        self.most = most
        self._written: int | None = None  # bytes since the folder was measured; None before
        self._writable = True

    def read(self, name: str) -> bytes | None:
        """Content of a file; None if there is no such file, or if it is damaged or belongs to another user."""
        path = self.folder / name
        try:
            if not _is_trusted(self.folder):
                return None
            with path.open("rb") as file:
                if not _private(os.fstat(file.fileno())):
                    return None
                content = file.read()
            if content[:_DIGEST] != _digest(name, content[_DIGEST:]):
                path.unlink()
                return None
            with contextlib.suppress(OSError):  # a folder that can be read only
                os.utime(path)
        except OSError:
            return None
        return content[_DIGEST:]

    def write(self, name: str, content: bytes) -> None:
        """Writes a file. After a failure, such as a full disk, this process writes no more files."""
        if not self._writable or len(content) > self.most * (1 - _LEFT):
            return
        try:
            self._writable = _make_folder(self.folder)
            if self._writable:
                _replace(self.folder / name, _digest(name, content) + content)
                self._bound(len(content))
        except OSError:
            self._writable = False

    def _bound(self, size: int) -> None:
        """Deletes the files that were used least recently, if all files together have more than `most` bytes."""
        if self._written is not None and self._written + size < self.most * _SCAN:
            self._written += size
            return
        self._written = 0
        files = []
        for entry in os.scandir(self.folder):
            with contextlib.suppress(OSError):  # another process may have deleted it
                status = entry.stat(follow_symlinks=False)
                if not entry.name.startswith(_UNFINISHED):
                    files.append((status.st_mtime_ns, status.st_size, entry.path))
                elif time.time() - status.st_mtime > _ABANDONED:
                    os.unlink(entry.path)
        total = sum(size for _, size, _ in files)
        if total <= self.most:
            return
        for _, size, path in sorted(files):
            with contextlib.suppress(OSError):
                os.unlink(path)
            total -= size
            if total <= self.most * _LEFT:
                return


def _digest(name: str, content: bytes) -> bytes:
    return hashlib.sha256(name.encode() + b"\0" + content).digest()


def _replace(path: pathlib.Path, content: bytes) -> None:
    handle, new = tempfile.mkstemp(prefix=_UNFINISHED, dir=path.parent)  # only the user may read and write it
    try:
        with open(handle, "wb") as file:
            file.write(content)
        os.replace(new, path)
    except OSError:
        with contextlib.suppress(OSError):
            os.unlink(new)
        raise


def _make_folder(folder: pathlib.Path) -> bool:
    """Creates the folder if it is absent, in a folder of the user, and says whether it can be trusted."""
    if not folder.exists():
        parent = next(parent for parent in folder.parents if parent.exists())
        if not folder.is_absolute() or not _is_owner(parent.stat()):  # for example the home of the user who called sudo
            return False
        for directory in (*reversed(folder.parents), folder):
            directory.mkdir(mode=0o700, exist_ok=True)
    return _is_trusted(folder)


def _is_trusted(folder: pathlib.Path) -> bool:
    status = folder.stat()
    if _is_owner(status) and not _private(status):
        _warn_of(folder)
    return stat.S_ISDIR(status.st_mode) and _private(status)


@functools.cache
def _warn_of(folder: pathlib.Path) -> None:
    log.warning("compiled programs are not kept: other users may write into %s; chmod 700 makes it private", folder)


def _is_owner(status: os.stat_result) -> bool:
    return not hasattr(os, "geteuid") or status.st_uid == os.geteuid()


def _private(status: os.stat_result) -> bool:
    """Whether a file or folder belongs to the user, and nobody else may write into it."""
    return _is_owner(status) and (os.name != "posix" or not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH))
