"""Input files: only regular ones that fit into memory, and, for what a scene refers to, only those in its folder."""

import collections
import errno
import json
import os
import pathlib
import stat
from typing import Any

from jaxprt import require


def check(path: pathlib.Path, what: str) -> None:
    """Refuses what is not a regular file. A pipe in place of a file would block forever.

    Args:
        path: The file.
        what: Kind of the file for messages, such as "a mesh file".

    Raises:
        FileNotFoundError: Nothing has this name.
        ValueError: It is a directory, a pipe, a device or a socket; or the name is too long, has a null character, or
            is a link that leads to itself.
    """
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError) as error:
        raise FileNotFoundError(f"{path} must be {what}, and there is no such file") from error
    except ValueError as error:  # a null character
        raise ValueError(f"{str(path)!r} must be the path of {what}, got one that no file can have") from error
    except OSError as error:
        if error.errno not in (errno.ENAMETOOLONG, errno.ELOOP):
            raise
        raise ValueError(f"{str(path)[:200]!r} must be the path of {what}, got one with {error.strerror}") from error
    if not stat.S_ISREG(mode):
        raise ValueError(f"{path} must be {what}, got a {'directory' if stat.S_ISDIR(mode) else 'special file'}")


def check_unlinked(path: pathlib.Path, what: str) -> None:
    """Refuses, besides what `check` refuses, links, which may lead out of a folder from a stranger.

    Args:
        path: The file.
        what: Kind of the file for messages, such as "an array of a saved object".
    """
    if path.is_symlink():
        raise ValueError(f"{path.name} must be a file in the folder, got a link")
    check(path, what)


def content(path: pathlib.Path, what: str) -> bytes:
    """The bytes of a regular file.

    Args:
        path: The file.
        what: Kind of the file for messages, such as "a mesh file".

    Raises:
        FileNotFoundError: Nothing has this name.
        ValueError: It is a directory, a pipe, a device or a socket.
        MemoryError: The file does not fit into memory.
    """
    check(path, what)
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

    Raises:
        ValueError: The file is outside of the folder. The message names the file.
    """
    if outside:
        return path
    try:
        target, home = path.resolve(), folder.resolve()
    except (OSError, ValueError, RuntimeError) as error:  # a null character, or links in a circle
        raise ValueError(f"{owner} must refer to a file, got {str(path)!r}: {error}") from error
    if not target.is_relative_to(home):
        raise ValueError(
            f"{owner} must refer to files in the folder of the scene, {home}, got {target}, which is outside of it: "
            "move the file into the folder or, if you trust the scene, call load_scene(path, outside=True) or give "
            "--outside to the command"
        )
    return path


def json_object(path: pathlib.Path, what: str) -> dict[str, Any]:
    """The object that a JSON file holds.

    Args:
        path: The file.
        what: Kind of the file for messages, such as "a file of BRDFs".

    Raises:
        FileNotFoundError: Nothing has this name.
        ValueError: It is no regular file, no JSON in UTF-8, nested too deeply, has a name twice in one object, or holds
            something other than an object.
        MemoryError: The file does not fit into memory.
    """
    data = content(path, what)
    try:
        value = json.loads(data.decode("utf-8-sig"), object_pairs_hook=unique_names)
    except RecursionError:
        raise ValueError(f"{path} must be {what} in JSON, got lists or objects that are nested too deeply") from None
    except ValueError as error:
        raise ValueError(f"{path} must be {what} in JSON, got other content: {error}") from error
    if not isinstance(value, dict):
        raise ValueError(f"{path} must be {what} in JSON, an object in braces, got a {type(value).__name__}")
    return value


def unique_names(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A JSON object from its pairs, for `json.loads`. A name that stands twice in it raises ValueError."""
    result = dict(pairs)
    if len(result) < len(pairs):
        name, count = collections.Counter(name for name, _ in pairs).most_common(1)[0]
        raise ValueError(f"an object has the name {name[:80]!r} {count} times")
    return result


def reference(name: str, base: pathlib.Path, *, folder: pathlib.Path, owner: str, outside: bool) -> pathlib.Path:
    r"""The path of a file that a scene names, with the checks of `require_inside`.

    A \ belongs to the name, or separates folders, as on Windows, if there is no file of that name. Both paths must be
    inside.

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
    return path if os.path.lexists(path) else on_windows
