"""What is fitted once, and kept in a folder."""

import contextlib
import pathlib
import shutil
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx

from jaxprt.files import objects

Made = TypeVar("Made")


def kept(path: pathlib.Path | None, key: Any, make: Callable[[], Made]) -> Made:
    """What a folder has for a key, or else what is made for it now, which the folder then keeps.

    What was kept for another key, by an algorithm that is no longer the same, or is damaged, is made again.

    Args:
        path: The folder; None keeps nothing.
        key: All that the result depends on: objects of this package, arrays and plain values. Nothing is kept for one
            that holds others, as functions that no file can name.
        make: Makes the result, an object of this package.
    """
    if path is None:
        return make()
    try:
        before, found = objects.load(path)
        if eqx.tree_equal(before, key):
            return found
    except (OSError, ValueError, TypeError):
        pass  # Nothing, or nothing that can be used.
    made = make()
    shutil.rmtree(path, ignore_errors=True)
    # Another process may be quicker, and a key may hold what cannot be kept.
    with contextlib.suppress(FileExistsError, TypeError):
        objects.save(path, (key, made))
    return made
