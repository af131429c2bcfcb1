"""A cache on disk for results of fits."""

import contextlib
import pathlib
import shutil
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx

from jaxprt.files import objects

Made = TypeVar("Made")


def kept(path: pathlib.Path | None, key: Any, make: Callable[[], Made]) -> Made:
    """Loads a result from a folder if it was stored there for the same key. Otherwise computes and stores it.

    A stored result is replaced if its key differs, if the algorithm has changed, or if the files are damaged.

    Args:
        path: The folder; None stores nothing.
        key: Everything that the result depends on: objects of this package, arrays and plain values. If it holds
            anything else, such as a function that cannot be found by name, nothing is stored.
        make: Function () -> the result, an object of this package.
    """
    if path is None:
        return make()
    try:
        stored_key, result = objects.load(path)
        if eqx.tree_equal(stored_key, key):
            return result
    except (OSError, ValueError, TypeError):
        pass  # There is no stored result, or it cannot be read.
    result = make()
    shutil.rmtree(path, ignore_errors=True)
    # Another process may have stored it meanwhile, or the key may hold objects that cannot be stored.
    with contextlib.suppress(FileExistsError, TypeError):
        objects.save(path, (key, result))
    return result
