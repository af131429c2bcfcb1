"""JAX's persistent cache of compiled programs, with files in the user's cache folder.

JAX reads the folder of its cache, the size and the thresholds from `jax.config`, which belongs to the user. Therefore
this cache is handed to JAX as an object, and only the threshold of compile time is set, because JAX has no other way to
lower it. If the user has configured JAX's cache, before or after the import, nothing of this happens.
"""

import contextlib
import functools
import hashlib
import os
import tempfile
import threading
from collections.abc import Iterator
from typing import Any, BinaryIO

import jax
import jax.numpy as jnp
from jax._src import compilation_cache
from jax._src.compilation_cache_interface import CacheInterface
from jax._src.lib import version_str
from jax.experimental import serialize_executable

from jaxprt.programs.store import Store, folder, is_enabled, log, processor

_THRESHOLD = "jax_persistent_cache_min_compile_time_secs"
_DEFAULTS = {
    "jax_enable_compilation_cache": True,
    "jax_compilation_cache_dir": None,
    "jax_compilation_cache_max_size": -1,
    "jax_persistent_cache_min_entry_size_bytes": 0,
    _THRESHOLD: 1.0,
}
_VARIABLES = ("JAX_COMPILATION_CACHE", "JAX_ENABLE_COMPILATION_CACHE", "JAX_PERSISTENT_CACHE")
_thread = threading.local()
_MISMATCH = b"machine type for execution"  # in XLA's message about features of the processor


class Cache(CacheInterface):
    """Programs of this processor in a store. JAX's keys hold the program, the versions and the flags."""

    def __init__(self, store: Store):
        self._path = store.folder
        self.store = store

    def get(self, key: str) -> Any:
        """A program as JAX has packed it; None if there is none, or if the user has configured JAX's cache since."""
        if _is_configured():
            _remove(self)
            return None
        return None if _is_paused() else self.store.read(_name(key))

    def put(self, key: str, value: bytes) -> None:
        """Keeps a program as JAX has packed it, where XLA will load it without complaint."""
        if not (_is_configured() or _is_paused()) and loads_quietly():
            self.store.write(_name(key), value)


@functools.cache
def process_store() -> Store:
    """The store of this process."""
    return Store(folder())


def install() -> None:
    """Gives JAX the cache, unless programs are not wanted, or the user or a program has configured JAX's own."""
    if any(name.startswith(_VARIABLES) for name in os.environ) or _is_configured() or not is_enabled():
        return
    with compilation_cache._cache_initialized_mutex:
        if compilation_cache._cache_initialized:
            return
        compilation_cache._cache = Cache(process_store())
        compilation_cache._cache_initialized = True
    jax.config.update(_THRESHOLD, 0.0)


def active() -> bool:
    """Whether JAX uses this cache."""
    return isinstance(compilation_cache._cache, Cache) and not _is_configured()


@contextlib.contextmanager
def paused() -> Iterator[None]:
    """Programs that this thread compiles meanwhile are neither loaded from the cache nor kept in it."""
    before, _thread.paused = _is_paused(), True
    try:
        yield
    finally:
        _thread.paused = before


def _is_paused() -> bool:
    return getattr(_thread, "paused", False)


def _is_configured() -> bool:
    """Whether an option of JAX's cache has another value than JAX's default."""
    installed = isinstance(compilation_cache._cache, Cache)  # then the threshold has been set here
    return any(
        getattr(jax.config, name) != value
        for name, value in _DEFAULTS.items()
        if not (installed and name == _THRESHOLD)
    )


def _remove(cache: Cache) -> None:
    """Leaves the place to the cache that the user has configured."""
    with compilation_cache._cache_initialized_mutex:
        if compilation_cache._cache is cache:
            compilation_cache._cache = None
            compilation_cache._cache_initialized = False
    if getattr(jax.config, _THRESHOLD) == 0:
        jax.config.update(_THRESHOLD, _DEFAULTS[_THRESHOLD])


@functools.cache
def _processor() -> bytes:
    # Messages of XLA are hidden by this variable, so that programs can be kept that it would complain about.
    return f"{processor()}\n{os.environ.get('TF_CPP_MIN_LOG_LEVEL')}\n".encode()


def _name(key: str) -> str:
    return hashlib.sha256(_processor() + key.encode()).hexdigest()


@functools.cache
def loads_quietly() -> bool:
    """Whether XLA loads programs of this processor without complaint.

    On some processors it writes 2 kB to the standard error for each program that it loads (jax-ml/jax#38445). The
    answer is found by loading a small program once, and kept.
    """
    if jax.default_backend() != "cpu":
        return True
    name = _name(f"quiet {jax.__version__} {version_str} {os.environ.get('XLA_FLAGS')}")
    answer = process_store().read(name)
    if answer is None:
        answer = b"1" if _quiet() else b"0"
        process_store().write(name, answer)
        if answer == b"0":
            log.warning(
                "compiled programs are not kept on this processor, because XLA reports each that it loads "
                "(jax-ml/jax#38445); where TF_CPP_MIN_LOG_LEVEL=3 hides these reports, programs are kept"
            )
    return answer == b"1"


def _quiet() -> bool:
    try:
        with paused():
            program = jax.jit(lambda x: x + 1).lower(jax.ShapeDtypeStruct((), jnp.float32)).compile()
        packed = serialize_executable.serialize(program)
        with _standard_error() as said:
            serialize_executable.deserialize_and_load(*packed, execution_devices=jax.devices()[:1])
            said.seek(0)
            text = said.read()
    except Exception:  # of any kind: XLA may reject its own program
        return False
    if text and _MISMATCH not in text:  # written by another thread
        os.write(2, text)
    return _MISMATCH not in text


@contextlib.contextmanager
def _standard_error() -> Iterator[BinaryIO | Any]:
    """A file that receives what compiled code writes to the standard error meanwhile."""
    with tempfile.TemporaryFile() as file:
        old = os.dup(2)
        os.dup2(file.fileno(), 2)
        try:
            yield file
        finally:
            os.dup2(old, 2)
            os.close(old)
