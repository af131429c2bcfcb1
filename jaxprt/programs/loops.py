"""Loops that numba has compiled, kept in the store of programs.

numba's own cache names a loop by the file that holds it, although numba compiles constants and functions of other
modules into it, and it loads files that others may have written. Here the name of a file holds the code of the loop and
of all functions that it calls, and the values of all that they read.
"""

import contextlib
import hashlib
import os
import pickle
import platform
from collections.abc import Iterator, Sequence
from types import CodeType, FunctionType, ModuleType
from typing import Any

import llvmlite
import numba
import numpy as np
from numba.core.caching import NullCache
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps

from jaxprt.programs.executables import UnnamedError
from jaxprt.programs.jax_cache import process_store
from jaxprt.programs.store import is_enabled, processor

_VERSIONED = ("builtins", "llvmlite", "math", "numba", "numpy")  # packages whose versions are in the name


def keep(compiled: Any) -> Any:
    """Lets a function of numba load its compiled code from the store and keep it there, and returns the function."""
    if is_enabled():
        compiled._cache = Cache(compiled)
    return compiled


class Cache(NullCache):
    """Compiled code of a loop in the store.

    Args:
        loop: The function, as `numba.njit` or `numba.core.ccallback.CFunc` returned it.
    """

    def __init__(self, loop: Any):
        self._loop = loop

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled code for arguments of some types; None if there is none."""
        target_context.refresh()
        with contextlib.suppress(Exception):  # of any kind: what can go wrong is up to numba
            content = process_store().read(self._name(sig, target_context.codegen()))
            # The store has made sure that the user wrote the file.
            return None if content is None else CompileResult._rebuild(target_context, *pickle.loads(content))

    def save_overload(self, sig: Any, cres: CompileResult) -> None:
        """Keeps the compiled code for arguments of some types, unless it holds addresses of this process."""
        if not (cres.lifted or cres.library.has_dynamic_globals):
            with contextlib.suppress(Exception):
                process_store().write(self._name(sig, cres.codegen), dumps(cres._reduce()))

    def _name(self, sig: Any, codegen: Any) -> str:
        version = numba.__version__, llvmlite.__version__, np.__version__, platform.python_version()
        option = sorted(f"{name}={value}" for name, value in os.environ.items() if name.startswith("NUMBA_"))
        target = type(self._loop).__name__, codegen.magic_tuple(), processor(), version, option
        return hashlib.sha256(f"{target}\n{sig}\n{describe(self._loop)}".encode()).hexdigest()


def describe(loop: object) -> str:
    """A text that changes with all that numba compiles into a loop: its code, what it calls, and what these read."""
    return "\n".join(_texts(loop, (), set()))


def _texts(value: object, names: Sequence[str], seen: set) -> Iterator[str]:
    """Texts of a function or of what it reads from outside, such as the attributes `names` of a module."""
    if value is None or value is ... or isinstance(value, bool | int | float | complex | str | bytes):
        yield repr(value)
    elif isinstance(value, np.ndarray | np.generic) and not value.dtype.hasobject:
        yield f"{value.dtype} {value.shape} {value.tobytes().hex()}"
    elif isinstance(value, np.dtype):
        yield f"{value!r} {value.fields}"
    elif isinstance(value, tuple | list):
        yield f"{type(value).__qualname__} {len(value)}"
        for item in value:
            yield from _texts(item, names, seen)
    elif isinstance(value, CodeType):
        yield repr((value.co_code, value.co_exceptiontable, value.co_names, value.co_varnames, value.co_argcount))
        yield from _texts(value.co_consts, names, seen)
    elif (key := (id(value), *names) if isinstance(value, ModuleType) else id(value)) in seen:
        yield str(getattr(value, "__name__", ""))
    else:
        seen.add(key)
        yield from _definition_texts(value, names, seen)


def _definition_texts(value: Any, names: Sequence[str], seen: set) -> Iterator[str]:
    """Texts of a module, a class or a function."""
    module = isinstance(value, ModuleType)
    home = value.__name__ if module else getattr(value, "__module__", None) or ""
    function = getattr(value, "__wrapped__", value) if type(value).__module__.startswith("numba.") else value
    if module and home.partition(".")[0] not in _VERSIONED:
        for name in names:
            if hasattr(value, name):
                yield from _texts(getattr(value, name), names, seen)
    elif isinstance(function, FunctionType) and function.__module__.partition(".")[0] not in _VERSIONED:
        names = sorted(_names(function.__code__))
        yield f"{function.__module__}.{function.__qualname__} {getattr(value, 'targetoptions', None)}"
        yield from _texts(function.__code__, names, seen)
        cells = [cell.cell_contents for cell in function.__closure__ or ()]
        yield from _texts([cells, function.__defaults__, *(function.__kwdefaults__ or {}).items()], names, seen)
        for name in names:
            if name in function.__globals__:
                yield name
                yield from _texts(function.__globals__[name], names, seen)
    elif home.partition(".")[0] in _VERSIONED and hasattr(value, "__name__"):
        yield f"{home}.{value.__name__}"
    else:
        raise UnnamedError(f"{value}")


def _names(code: CodeType) -> set[str]:
    """Names in a code and in those of the functions in it."""
    return set(code.co_names).union(*(_names(part) for part in code.co_consts if isinstance(part, CodeType)))
