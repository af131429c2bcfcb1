"""Files of compiled programs in a folder of the user's cache.

A process that loads a program runs code from its file. The folder must therefore belong to the user, and nobody else
may write into it or replace a folder on the way to it. Files start with a checksum of their name and content, so that a
damaged file counts as absent. New files appear by renaming, so that other processes see whole files only. Nothing here
raises an error: a program that cannot be kept is compiled again.
"""

import contextlib
import functools
import hashlib
import logging
import os
import pathlib
import platform
import re
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
    """Whether programs are kept: not if JAXPRT_KEEP_PROGRAMS is 0 or false, nor for unnamed processors."""
    return os.environ.get("JAXPRT_KEEP_PROGRAMS", "1").strip().lower() not in ("0", "false") and bool(processor())


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
    """The processor's model and instruction sets: programs of one processor may crash on another.

    It is empty, and one line says so, where the system does not tell them: the architecture alone names no processor.
    """
    facts = ""
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        if sys.platform == "darwin":
            facts = subprocess.check_output(["/usr/sbin/sysctl", "-n", "machdep.cpu.brand_string"], text=True).strip()
        elif sys.platform == "win32":
            facts = platform.processor()
        else:
            with open("/proc/cpuinfo", errors="replace") as file:
                first = file.read(1 << 15).split("\n\n")[0]
            if re.search(r"^(flags|Features)\s*:.*\w", first, re.MULTILINE):
                facts = "\n".join(line for line in first.split("\n") if line.startswith(_FEATURES))
    if not facts:
        _warn("the system does not name the processor")
        return ""
    return f"{platform.machine()}\n{facts}"


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
            with open(path, "rb", opener=_open_file) as file:
                status = os.fstat(file.fileno())
                if not _is_own_file(status) or status.st_size > self._largest:
                    return None
                content = file.read(status.st_size)
            if content[:_DIGEST] != _digest(name, content[_DIGEST:]):
                path.unlink()
                return None
            with contextlib.suppress(OSError):  # a folder that can be read only
                os.utime(path)
        except (OSError, MemoryError):
            return None
        return content[_DIGEST:]

    @property
    def _largest(self) -> int:
        """Bytes of the largest file."""
        return int(self.most * (1 - _LEFT))

    def write(self, name: str, content: bytes) -> None:
        """Writes a file. After a failure, such as a full disk, this process writes no more files."""
        if not self._writable or _DIGEST + len(content) > self._largest:
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


def _open_file(path: str, flags: int) -> int:
    """Opens a file, but neither a link nor, which would wait for its other end, a pipe."""
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0))


def _make_folder(folder: pathlib.Path) -> bool:
    """Creates the folder if it is absent, and says whether it can be trusted."""
    if not os.path.lexists(folder):
        parent = next(parent for parent in folder.parents if os.path.lexists(parent))
        status = parent.stat()
        # It is created in a folder of the user, or where everybody may create folders, as in /tmp.
        if not (_is_owner(status) or status.st_mode & stat.S_ISVTX):  # for example a folder of the user who called sudo
            return False
        if fault := _fault(parent, private=False):
            _warn(fault)
            return False
        for directory in (*reversed(folder.parents), folder):
            directory.mkdir(mode=0o700, exist_ok=True)
    return _is_trusted(folder)


def _is_trusted(folder: pathlib.Path) -> bool:
    fault = _fault(folder)
    if fault:
        _warn(fault)
    return not fault


def _fault(folder: pathlib.Path, *, private: bool = True) -> str:
    """Why another user may decide what is in a folder; empty if only root and the user may."""
    if not folder.is_absolute() or not stat.S_ISDIR(folder.stat().st_mode):
        return f"{folder} is not the absolute path of a folder"
    if os.name != "posix":
        return ""
    path, rest, shared = pathlib.Path(), list(reversed(folder.parts)), False
    # From the root down: nobody else can replace an entry of a folder that has passed, nor one of root or the user in a
    # folder like /tmp. Therefore nothing that has passed can change before a file is opened.
    while rest:
        path /= rest.pop()
        status, last = path.lstat(), private and not rest
        if not (_is_owner(status) or (status.st_uid == 0 and not last)):
            return f"{path} belongs to another user"
        # Links count where nobody else can create any; the last two folders, jaxprt's own if `private`, must be none.
        if stat.S_ISLNK(status.st_mode):
            if shared or (private and len(rest) < 2):
                return f"{path} is a symbolic link"
            rest += reversed(pathlib.Path(os.readlink(path)).parts)
            path = path.parent
            continue
        shared = not _unshared(status)
        if shared and (last or not status.st_mode & stat.S_ISVTX):
            return f"other users may write into {path}; chmod {'700' if last else 'go-w'} makes it private"
    return ""


@functools.cache
def _warn(fault: str) -> None:
    log.warning("compiled programs are not kept: %s", fault)


def _is_owner(status: os.stat_result) -> bool:
    return not hasattr(os, "geteuid") or status.st_uid == os.geteuid()


def _unshared(status: os.stat_result) -> bool:
    """Whether nobody but the owner may write into a file or folder."""
    return os.name != "posix" or not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _is_own_file(status: os.stat_result) -> bool:
    """Whether it is a file of the user, of one name, into which nobody else may write."""
    return stat.S_ISREG(status.st_mode) and _is_owner(status) and _unshared(status) and status.st_nlink <= 1
