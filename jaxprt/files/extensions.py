"""Data classes of other packages that files may hold, and the installed packages that register them."""

import dataclasses
import functools
import importlib.metadata
import warnings
from collections.abc import Sequence

GROUP = "jaxprt"  # of entry points, each of which names a module
CLASSES: dict[str, type] = {}  # by full name


def full_name(kind: type) -> str:
    """The name under which files store a class: its module and its name."""
    return f"{kind.__module__}:{kind.__qualname__}"


def is_data(kind: type) -> bool:
    """Whether a class is a data class or a named tuple."""
    return dataclasses.is_dataclass(kind) or (issubclass(kind, tuple) and hasattr(kind, "_fields"))


def allow(kinds: Sequence[type]) -> None:
    """Lets files hold objects of data classes of another package. Their fields are annotated as those of jaxprt are."""
    for kind in kinds:
        if not isinstance(kind, type) or not is_data(kind):
            name = getattr(kind, "__name__", kind)
            raise TypeError(f"what is registered must consist of data classes, such as equinox.Module, got {name}")
    CLASSES.update({full_name(kind): kind for kind in kinds})


def modules() -> set[str]:
    """Modules with registered classes, those of installed packages included."""
    discover()
    return {kind.__module__ for kind in CLASSES.values()}


@functools.cache
def discover() -> None:
    """Imports the modules that installed packages name as entry points, once. A module that fails is left out.

    Files never decide what is imported: what is installed does.
    """
    for entry in importlib.metadata.entry_points(group=GROUP):
        try:
            entry.load()
        except Exception as error:
            warnings.warn(f"the extension {entry.value!r} of jaxprt is left out: {error}", stacklevel=2)
