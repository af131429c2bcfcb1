"""Names of programs that are the same in every process, and change with everything that a program depends on."""

import enum
import functools
import hashlib
import os
import pathlib
import platform
import re
import sys
import time
from typing import Any

import equinox
import jax
import numpy as np
from jax._src import config
from jax._src.lib import version_str

from jaxprt.programs.store import processor

_PACKAGE = pathlib.Path(__file__).parents[1]
_STARTED = time.time()
_KNOWN = ("builtins", "jaxprt", "equinox", "numpy", "jax", "jaxlib", "collections")  # packages whose code has a version
_CLEAN = re.compile(r"<jax\._src\.core\.AxisEnv object at 0x[0-9a-f]+>")  # empty where no trace is under way


class UnnamedError(Exception):
    """A value has no name that is the same in every process and changes with the value."""


def surroundings() -> str:
    """All that a program depends on besides its function and arguments.

    Raises:
        UnnamedError: The files of the package have changed since they were imported.
        OSError: The files of the package cannot be read.
    """
    device = jax.devices()[0]
    context = _CLEAN.sub("", str(config.trace_context()))
    if " at 0x" in context:
        raise UnnamedError(context)
    variable = sorted(
        f"{name}={value}" for name, value in os.environ.items() if name.startswith(("JAX_", "XLA_", "TF_"))
    )
    option = sorted(jax.config.values.items())
    backend = device.platform, device.device_kind, device.client.platform_version
    return "\n".join([_fixed(), str(variable), str(option), str(backend), context])


@functools.cache
def _fixed() -> str:
    """Versions, the code of the package, and the processor."""
    digest = hashlib.sha256()
    for path in sorted(_PACKAGE.rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts:  # where Numba writes too
            if path.stat().st_mtime > _STARTED:
                raise UnnamedError(f"{path} has changed")
            digest.update(f"{path.relative_to(_PACKAGE)}\0{path.stat().st_size}\0".encode() + path.read_bytes())
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    version = (
        platform.python_version(),
        np.__version__,
        jax.__version__,
        version_str,
        equinox.__version__,
    )
    return "\n".join([digest.hexdigest(), str(version), processor(), str(cores)])


def described(value: Any) -> str:
    """A text that names a static value or the structure of a pytree, the same in every process.

    Raises:
        UnnamedError: The value is an object of unknown code, such as a class of the user.
    """
    kind = type(value)
    if value is None or kind in (bool, int, float, complex, str, bytes):
        return repr(value)
    if kind in (tuple, list):
        return f"{kind.__name__}({','.join(map(described, value))})"
    if kind is dict:
        return f"dict({','.join(f'{described(name)}:{described(each)}' for name, each in value.items())})"
    if isinstance(value, enum.Enum | np.dtype):
        return f"{_known(kind)}.{value.name}"
    if isinstance(value, type) or hasattr(value, "__qualname__"):
        return _known(value)
    structure = value if isinstance(value, jax.tree_util.PyTreeDef) else jax.tree.structure(value)
    node = structure.node_data()
    if structure is value and node is None:
        return "*"
    if node is None or (structure is not value and structure.num_leaves):  # a static value must have no arrays
        raise UnnamedError(f"{kind}")
    if node[0] is type(None):
        return "None"
    return f"{_known(node[0])}<{described(node[1])}>({','.join(map(described, structure.children()))})"


def _known(thing: Any) -> str:
    """Name of a class or function at the top level of a module whose code has a version."""
    module, name = thing.__module__, thing.__qualname__
    found: Any = sys.modules.get(module)
    for part in name.split("."):
        found = getattr(found, part, None)
    while found is not thing and hasattr(found, "__wrapped__"):
        found = found.__wrapped__
    if found is not thing or module.split(".")[0] not in _KNOWN:
        raise UnnamedError(f"{module}.{name}")
    return f"{module}.{name}"
