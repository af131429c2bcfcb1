"""Executables that a later process loads without tracing or compiling them.

JAX's persistent cache spares compiling only. Tracing and lowering a large program take seconds too. `StoredFunction`
keeps the whole executable, for calls whose program can be named without tracing it: concrete arrays on the default CPU,
and static values and containers that this package, Equinox or Python define. Everything else goes through `jax.jit`.
"""

import contextlib
import enum
import functools
import gc
import hashlib
import os
import pathlib
import pickle
import platform
import re
import sys
import threading
import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox
import jax
import numpy as np
from jax._src import config, core
from jax._src.lib import version_str
from jax.experimental import serialize_executable
from jax.sharding import SingleDeviceSharding
from jaxtyping import PyTree

from jaxprt.programs import jax_cache
from jaxprt.programs.store import processor

_PACKAGE = pathlib.Path(__file__).parents[1]
_STARTED = time.time()
_KNOWN = ("builtins", "jaxprt", "equinox", "numpy", "jax", "jaxlib", "collections")  # packages whose code has a version
_CLEAN = re.compile(r"<jax\._src\.core\.AxisEnv object at 0x[0-9a-f]+>")  # empty where no trace is under way
_QUICK = {"xla_cpu_use_fusion_emitters": False}  # the older emitters of loops
_functions: list["StoredFunction"] = []
_MAPS, _MOST = pathlib.Path("/proc/self/maps"), pathlib.Path("/proc/sys/vm/max_map_count")
_FILLED = 0.7  # share of the memory mappings at which programs are forgotten
_FEW = 32  # new programs after which mappings are counted again, which takes milliseconds


class UnnamedError(Exception):
    """A value has no name that is the same in every process and changes with the value."""


def surroundings() -> str:
    """All that a program depends on besides its function and arguments."""
    device = jax.devices()[0]
    context = _CLEAN.sub("", str(config.trace_context()))
    if " at 0x" in context:
        raise UnnamedError(context)
    variable = sorted(
        f"{name}={value}" for name, value in os.environ.items() if name.startswith(("JAX_", "XLA_", "TF_"))
    )
    option = sorted(jax.config.values.items())
    backend = device.platform, device.device_kind, device.client.platform_version
    return "\n".join([_process_facts(), str(variable), str(option), str(backend), context])


@functools.cache
def _process_facts() -> str:
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


def describe(value: Any) -> str:
    """A text that names a static value or the structure of a pytree, the same in every process."""
    kind = type(value)
    if value is None or kind in (bool, int, float, complex, str, bytes):
        return repr(value)
    if kind in (tuple, list):
        return f"{kind.__name__}({','.join(map(describe, value))})"
    if kind is dict:
        return f"dict({','.join(f'{describe(name)}:{describe(item)}' for name, item in value.items())})"
    if isinstance(value, enum.Enum | np.dtype):
        return f"{_qualified_name(kind)}.{value.name}"
    if isinstance(value, type) or hasattr(value, "__qualname__"):
        return _qualified_name(value)
    structure = value if isinstance(value, jax.tree_util.PyTreeDef) else jax.tree.structure(value)
    node = structure.node_data()
    if structure is value and node is None:
        return "*"
    if node is None or (structure is not value and structure.num_leaves):  # a static value must have no arrays
        raise UnnamedError(f"{kind}")
    if node[0] is type(None):
        return "None"
    return f"{_qualified_name(node[0])}<{describe(node[1])}>({','.join(map(describe, structure.children()))})"


def _qualified_name(thing: Any) -> str:
    """Name of a class or function at the top level of a module whose code has a version."""
    module, name = thing.__module__, thing.__qualname__
    target: Any = sys.modules.get(module)
    for part in name.split("."):
        target = getattr(target, part, None)
    while target is not thing and hasattr(target, "__wrapped__"):
        target = target.__wrapped__
    if target is not thing or module.split(".")[0] not in _KNOWN:
        raise UnnamedError(f"{module}.{name}")
    return f"{module}.{name}"


class StoredFunction:
    """A compiled function. Executables of calls with concrete arrays are kept for later processes.

    Other attributes are those of the function that `jax.jit` returned. The function must be at the top level of a
    module of this package, because its code is known by the files of the package.

    Args:
        function: A function whose arguments are arrays and pytrees of arrays. Static options are passed by name.
        compiled: The same function by `jax.jit`.
        static: Names of the static options.
        quick: Whether to compile with XLA's older emitters of loops: see `jaxprt.compile.kept`.
    """

    def __init__(self, function: Callable, compiled: Any, static: tuple[str, ...], *, quick: bool = False):
        functools.update_wrapper(self, function)
        self._function, self._compiled, self._static, self._quick = function, compiled, static, quick
        self._executables: dict[tuple, Callable] = {}
        self._locks: dict[tuple, contextlib.AbstractContextManager] = {}  # a lock for each signature
        _functions.append(self)

    def __call__(self, *argument: PyTree, **named: Any) -> PyTree:
        """Calls the function."""
        if not jax_cache.active():
            return self._compiled(*argument, **named)
        option = {name: named[name] for name in self._static if name in named}
        operand = argument, {name: value for name, value in named.items() if name not in option}
        leaf, tree = jax.tree.flatten(operand)
        if not (core.trace_state_clean() and _ordinary() and _concrete(leaf)):
            return self._compiled(*argument, **named)
        aval = tuple((value.shape, value.dtype, getattr(value, "weak_type", False)) for value in leaf)
        signature = tree, aval, tuple(sorted(option.items())), config.trace_context()
        try:
            executable = self._executables.get(signature)
        except TypeError:  # a static value that has no hash: JAX says so
            return self._compiled(*argument, **named)
        if executable is None:
            # A call waits for its program alone, and not for those of other shapes that are being compiled.
            with self._locks.setdefault(signature, threading.RLock()):
                executable = self._executables.get(signature)
                if executable is None:
                    executable = self._executables[signature] = self._executable(operand, option, tree, aval)
        return executable(*argument, **operand[1])

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or "_compiled" not in self.__dict__:
            raise AttributeError(name)
        return getattr(self._compiled, name)

    def forget(self) -> None:
        """Forgets the executables of this process. Those in files stay."""
        self._executables.clear()

    def _executable(self, operand: tuple, option: Mapping[str, object], tree: Any, aval: tuple) -> Callable:
        """The executable from its file, or compiled and then kept."""
        argument, named = operand
        aval = tuple((shape, str(dtype), weak) for shape, dtype, weak in aval)
        try:
            parts = (surroundings(), *map(describe, (self._function, tree, aval, option, self._quick)))
            name = hashlib.sha256("\n".join(parts).encode()).hexdigest()
        except Exception:  # no name, or none that can be found: classes of users may do anything
            return functools.partial(self._compiled, **option)
        content = jax_cache.process_store().read(name)
        if content is not None:
            with contextlib.suppress(Exception):  # of any kind: what can go wrong is up to JAX and XLA
                return _unpack(content, tree)
        lowered = self._compiled.lower(*argument, **named, **option)
        with jax_cache.paused():  # An executable that comes from JAX's cache cannot be written again.
            executable = _compile(lowered, quick=self._quick)
        # Custom calls are addresses in this process, or need libraries that JAX prepares when it traces.
        if not _calls_out(lowered) and jax_cache.loads_quietly():
            with contextlib.suppress(Exception):
                content = _pack(executable)
                _unpack(content, tree)  # or an error
                jax_cache.process_store().write(name, content)
        return executable


def count() -> int:
    """Number of executables that this process holds."""
    return sum(len(program._executables) for program in _functions)


def forget() -> None:
    """Forgets the executables of this process, as `jax.clear_caches` forgets other programs."""
    for program in _functions:
        program.forget()


class _Compiled:
    """Counts the programs that this process compiles or loads; `counted` are those when mappings were counted last."""

    def __init__(self) -> None:
        self.programs = self.counted = 0
        jax.monitoring.register_event_duration_secs_listener(self._add)

    def _add(self, event: str, duration_secs: float, **_: object) -> None:
        self.programs += event == "/jax/core/compile/backend_compile_duration"


_compiled = _Compiled()


def make_room() -> None:
    """Forgets the programs of this process, JAX's too, when they fill most of the memory mappings that Linux grants it.

    These are 65,530, and each program takes several. A process that draws pictures of hundreds of sizes, or scenes one
    after another, would be ended by the compiler.
    """
    programs = _compiled.programs + count()
    if programs - _compiled.counted < _FEW or not core.trace_state_clean():
        return
    _compiled.counted = programs
    with contextlib.suppress(OSError, ValueError):  # not on Linux
        if _MAPS.read_bytes().count(b"\n") > _FILLED * int(_MOST.read_text()):
            forget()
            jax.clear_caches()
            gc.collect()
            _compiled.counted = _compiled.programs


def _concrete(leaves: Sequence[object]) -> bool:
    """Whether all leaves are arrays on the default device, with their values."""
    place = _place_of(jax.devices()[0])
    for leaf in leaves:
        if isinstance(leaf, np.ndarray | np.generic):
            if jax.dtypes.canonicalize_dtype(leaf.dtype) != leaf.dtype:
                return False
        elif not isinstance(leaf, jax.Array) or isinstance(leaf, core.Tracer) or leaf.sharding != place:
            return False
    return True


@functools.cache
def _place_of(device: Any) -> SingleDeviceSharding:
    return SingleDeviceSharding(device)


def _ordinary() -> bool:
    """Whether JAX computes by executables on the first device, which is a CPU. On GPUs nothing of this was tested."""
    return not (
        jax.default_backend() != "cpu"
        or config.disable_jit.value
        or config.debug_nans.value
        or config.debug_infs.value
        or config.default_device.value is not None
        or jax.process_count() > 1
    )


def _compile(lowered: Any, *, quick: bool) -> jax.stages.Compiled:
    if quick:
        with contextlib.suppress(jax.errors.JaxRuntimeError):  # where XLA has these emitters no more
            return lowered.compile(_QUICK)
    return lowered.compile()


def _calls_out(lowered: Any) -> bool:
    text = lowered.compiler_ir("stablehlo").operation.get_asm(large_elements_limit=8)
    return "custom_call" in text


def _pack(executable: jax.stages.Compiled) -> bytes:
    content, _, out = serialize_executable.serialize(executable)
    # Structures of results cannot be pickled, but results with numbers in place of arrays can.
    return zlib.compress(pickle.dumps((content, out.unflatten(range(out.num_leaves)))), 1)


def _unpack(content: bytes, tree: Any) -> Callable:
    # The store has made sure that the user wrote the file.
    executable, example = pickle.loads(zlib.decompress(content))
    return serialize_executable.deserialize_and_load(
        executable, tree, jax.tree.structure(example), execution_devices=jax.devices()[:1]
    )
