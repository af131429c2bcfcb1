"""Input files: only regular ones that fit into memory, and, for what a scene refers to, only those in its folder."""

import collections
import errno
import json
import os
import pathlib
import stat
import unicodedata
from collections.abc import Callable
from typing import Any

from jaxprt import require

JsonObject = dict[str, Any]  # by name: numbers, text, lists and objects

_SHOWN = 400  # characters of a name in messages; what is longer is data


def shortened(text: object) -> str:
    """A name or a path for a message: one line, without the middle of a long one, such as a URI that holds data."""
    words = "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in str(text))
    return words if len(words) <= _SHOWN else f"{words[: _SHOWN // 2]}...{words[-_SHOWN // 4 :]}"


def check(path: pathlib.Path, what: str, *, links: bool = True) -> None:
    """Refuses what is not a regular file. A pipe in place of a file would block forever.

    Args:
        path: The file.
        what: Kind of the file for messages, such as "a mesh file".
        links: Whether it may be a link. In a folder from a stranger a link may lead out of the folder.

    Raises:
        FileNotFoundError: Nothing has this name.
        ValueError: It is a directory, a pipe, a device, a socket or a link that is not allowed; or the name is too
            long, has a null character, or is a link that leads to itself.
    """
    try:
        mode = path.stat(follow_symlinks=links).st_mode
    except (FileNotFoundError, NotADirectoryError) as error:
        raise FileNotFoundError(f"{shortened(path)} must be {what}, and there is no such file") from error
    except ValueError as error:  # a null character
        raise ValueError(f"{shortened(path)!r} must be the path of {what}, got one that no file can have") from error
    except OSError as error:
        if error.errno not in (errno.ENAMETOOLONG, errno.ELOOP):
            raise
        raise ValueError(f"{str(path)[:200]!r} must be the path of {what}, got one with {error.strerror}") from error
    if not stat.S_ISREG(mode):
        came = {stat.S_IFDIR: "a directory", stat.S_IFLNK: "a link"}.get(stat.S_IFMT(mode), "a special file")
        raise ValueError(f"{path} must be {what}, got {came}")


def absence(path: pathlib.Path) -> str:
    """Why a path is not that of a regular file; empty if it is."""
    try:
        check(path, "a file")
    except FileNotFoundError:
        return "which does not exist"
    except ValueError:
        return "which is not a regular file"
    return ""


def content(path: pathlib.Path, what: str, *, links: bool = True) -> bytes:
    """The bytes of a regular file, with the arguments of `check`."""
    check(path, what, links=links)
    require.memory(f"the bytes of {path}", path.stat().st_size, "free some memory, or make the file smaller")
    return path.read_bytes()


def require_inside(path: pathlib.Path, folder: pathlib.Path, *, owner: str, outside: bool) -> pathlib.Path:
    """Refuses a file that a scene refers to and that is not in the scene's folder.

    `..`, absolute paths and symbolic links are resolved first. A scene from a stranger could otherwise read any file of
    the user, whose bytes would become vertices or texels and leave with an exported page.

    Args:
        path: The file, as the scene refers to it.
        folder: Folder of the scene.
        owner: What refers to the file, for the message: "scene.gltf, image 2".
        outside: Whether files outside of the folder are allowed.

    Returns:
        The path, unchanged.
    """
    if outside:
        return path
    try:
        target, home = path.resolve(), folder.resolve()
    except (OSError, ValueError, RuntimeError) as error:  # a null character, or links in a circle
        raise ValueError(f"{owner} must refer to a file, got {shortened(path)!r}: {shortened(error)}") from error
    if not target.is_relative_to(home):
        raise ValueError(
            f"{owner} must refer to files in the folder of the scene, {home}, got {shortened(target)}, "
            "which is outside of it: move the file into the folder or, if you trust the scene, call "
            "load_scene(path, outside=True) or give --outside to the command"
        )
    return path


def store_header(folder: pathlib.Path, name: str, what: str) -> JsonObject:
    """The header of a folder that this package wrote, or that its first versions wrote by zarr.

    Args:
        folder: The folder.
        name: Name of the header's file.
        what: Kind of the file for messages.
    """
    zarr = folder / "zarr.json"
    if zarr.exists() and not (folder / name).exists():
        return dict(json_object(zarr, what, links=False).get("attributes", {}))
    return json_object(folder / name, what, links=False)


def json_object(path: pathlib.Path, what: str, *, links: bool = True) -> JsonObject:
    """The object that a JSON file holds, with the arguments of `check`."""
    data = content(path, what, links=links)
    try:
        value = json.loads(data.decode("utf-8-sig"), object_pairs_hook=unique_names)
    except RecursionError:
        raise ValueError(f"{path} must be {what} in JSON, got lists or objects that are nested too deeply") from None
    except ValueError as error:
        raise ValueError(f"{path} must be {what} in JSON, got other content: {error}") from error
    if not isinstance(value, dict):
        raise ValueError(f"{path} must be {what} in JSON, an object in braces, got a {type(value).__name__}")
    return value


def unique_names(pairs: list[tuple[str, Any]]) -> JsonObject:
    """A JSON object from its pairs, for `json.loads`. A name that stands twice in it raises ValueError."""
    result = dict(pairs)
    if len(result) < len(pairs):
        name, count = collections.Counter(name for name, _ in pairs).most_common(1)[0]
        raise ValueError(f"an object has the name {name[:80]!r} {count} times")
    return result


def reference(name: str, base: pathlib.Path, *, folder: pathlib.Path, owner: str, outside: bool) -> pathlib.Path:
    r"""The path of a file that a scene names, with the checks of `require_inside`.

    A \ belongs to the name, or separates folders, as on Windows, if there is no file of that name. Both paths must be
    inside. If there is no file of either name, but one in the folder of the scene whose name differs only in the case
    of letters or in its Unicode form, that is meant: other systems do not distinguish these.

    Args:
        name: Name of the file in the scene.
        base: Folder to which names are relative.
        folder: Folder of the scene.
        owner: What refers to the file, for the message: "scene.gltf, image 2".
        outside: Whether files outside of the folder of the scene are allowed.

    Raises:
        ValueError: The file is outside of the folder. The message names the file.
    """
    on_windows = require_inside(base / name.replace("\\", "/"), folder, owner=owner, outside=outside)
    path = require_inside(base / name, folder, owner=owner, outside=outside)
    if os.path.lexists(path):
        return path
    other = (
        None if os.path.lexists(on_windows) else _other_spelling(path, folder) or _other_spelling(on_windows, folder)
    )
    return on_windows if other is None else require_inside(other, folder, owner=owner, outside=outside)


def _other_spelling(path: pathlib.Path, folder: pathlib.Path) -> pathlib.Path | None:
    """The path in a folder that differs from another in case and Unicode form alone; None unless there is one."""
    try:
        here = home = folder.resolve()
        parts = path.resolve().relative_to(home).parts
        for number, part in enumerate(parts):
            # Folders outside are not searched: what a link to one leads to keeps its spelling.
            if not here.resolve().is_relative_to(home):
                return here.joinpath(*parts[number:])
            if not os.path.lexists(here / part):
                part = _same_name(part, os.listdir(here))
                if part is None:
                    return None
            here = here / part
    except (OSError, ValueError, RuntimeError):  # outside, a null character, links in a circle, or no folder
        return None
    return here


def _same_name(name: str, names: list[str]) -> str | None:
    """The only one of some names that equals another but for its Unicode form, or else for that and its case."""
    forms: tuple[Callable[[str], str], ...] = (_composed, lambda text: _composed(_composed(text).casefold()))
    for form in forms:
        same = [other for other in names if form(other) == form(name)]
        if same:
            return same[0] if len(same) == 1 else None
    return None


def _composed(text: str) -> str:
    return unicodedata.normalize("NFC", text)
