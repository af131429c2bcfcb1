"""Executables that a later process loads without tracing or compiling them.

JAX's persistent cache spares compiling only. Tracing and lowering a large program take seconds too. `Kept` keeps the
whole executable, for calls whose program can be named without tracing it: concrete arrays on the default CPU, and
static values and containers that this package, Equinox or Python define. Everything else goes through `jax.jit`.
"""

import contextlib
import functools
import hashlib
import pickle
import threading
import zlib
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax._src import config, core
from jax.experimental import serialize_executable
from jax.sharding import SingleDeviceSharding
from jaxtyping import PyTree

from jaxprt.programs import jax_cache, names

_every: list["Kept"] = []


class Kept:
    """A compiled function. Executables of calls with concrete arrays are kept for later processes.

    Other attributes are those of the function that `jax.jit` returned. The function must be at the top level of a
    module of this package, because its code is known by the files of the package.

    Args:
        function: A function whose arguments are arrays and pytrees of arrays. Static options are passed by name.
        compiled: The same function by `jax.jit`.
        static: Names of the static options.
    """

    def __init__(self, function: Callable, compiled: Any, static: tuple[str, ...]):
        functools.update_wrapper(self, function)
        self._function, self._compiled, self._static = function, compiled, static
        self._executables: dict[Any, Any] = {}
        self._lock = threading.RLock()
        _every.append(self)

    def __call__(self, *argument: PyTree, **named: Any) -> PyTree:
        """Calls the function."""
        if not jax_cache.active():
            return self._compiled(*argument, **named)
        option = {name: named[name] for name in self._static if name in named}
        operand = argument, {name: value for name, value in named.items() if name not in option}
        leaf, tree = jax.tree.flatten(operand)
        if not (core.trace_state_clean() and _ordinary() and _concrete(leaf)):
            return self._compiled(*argument, **named)
        aval = tuple((each.shape, each.dtype, getattr(each, "weak_type", False)) for each in leaf)
        signature = tree, aval, tuple(sorted(option.items())), config.trace_context()
        try:
            executable = self._executables.get(signature)
        except TypeError:  # a static value that has no hash: JAX says so
            return self._compiled(*argument, **named)
        if executable is None:
            with self._lock:
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

    def _executable(self, operand: tuple, option: dict[str, Any], tree: Any, aval: tuple) -> Callable:
        """The executable from its file, or compiled and then kept."""
        argument, named = operand
        aval = tuple((shape, str(dtype), weak) for shape, dtype, weak in aval)
        try:
            parts = (names.surroundings(), *map(names.described, (self._function, tree, aval, option)))
            name = hashlib.sha256("\n".join(parts).encode()).hexdigest()
        except Exception:  # no name, or none that can be found: classes of users may do anything
            return functools.partial(self._compiled, **option)
        content = jax_cache.kept().read(name)
        if content is not None:
            with contextlib.suppress(Exception):  # of any kind: what can go wrong is up to JAX and XLA
                return _loaded(content, tree)
        lowered = self._compiled.lower(*argument, **named, **option)
        with jax_cache.paused():  # An executable that comes from JAX's cache cannot be written again.
            executable = lowered.compile()
        # Custom calls are addresses in this process, or need libraries that JAX prepares when it traces.
        if not _calls_out(lowered) and jax_cache.loads_quietly():
            with contextlib.suppress(Exception):
                content = _packed(executable)
                _loaded(content, tree)  # or an error
                jax_cache.kept().write(name, content)
        return executable


def count() -> int:
    """Number of executables that this process holds."""
    return sum(len(each._executables) for each in _every)


def forget() -> None:
    """Forgets the executables of this process, as `jax.clear_caches` forgets other programs."""
    for each in _every:
        each.forget()


def _concrete(leaves: Sequence[Any]) -> bool:
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


def _calls_out(lowered: Any) -> bool:
    text = lowered.compiler_ir("stablehlo").operation.get_asm(large_elements_limit=8)
    return "custom_call" in text


def _packed(executable: Any) -> bytes:
    content, _, out = serialize_executable.serialize(executable)
    # Structures of results cannot be pickled, but results with numbers in place of arrays can.
    return zlib.compress(pickle.dumps((content, out.unflatten(range(out.num_leaves)))), 1)


def _loaded(content: bytes, tree: Any) -> Callable:
    # The store has made sure that the user wrote the file.
    executable, example = pickle.loads(zlib.decompress(content))
    return serialize_executable.deserialize_and_load(
        executable, tree, jax.tree.structure(example), execution_devices=jax.devices()[:1]
    )
