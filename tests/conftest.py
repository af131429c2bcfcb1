"""Fixtures that every test may ask for.

They are ``data``, ``coarse``, ``bound``, ``x64``, ``unchecked``, ``close``, ``loose`` and ``elsewhere``.
"""

import ctypes
import functools
import gc
import importlib.metadata
import mmap
import os
import pathlib
import sys
from collections.abc import Callable, Iterator
from typing import Any

# Both workers, and programs and notebooks that tests start, share compiled programs, and a later run finds them;
# `make clean` removes them. Keeping a program takes an eighth of the time of compiling it, finding it much less.
# Set before jax is imported, and inherited by what tests start.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(pathlib.Path(__file__).parents[1] / ".pytest_cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
# Benchmarks turn kept programs off, and their tests run in these processes: loops of numba would be compiled in each.
os.environ.setdefault("JAXPRT_KEEP_PROGRAMS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # Its threads, in jax's QR, wait by spinning beside other processes.
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")  # of no use here, and 3 % of the time
# Compiled without optimization tests take half the processor time. XLA_FLAGS="" tests what users get. Splitting small
# programs for several compiling threads costs a fifth of the time of compiling them.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1 "
    "--xla_force_host_platform_device_count=4"  # for what is laid over several devices; all else is on the first
    # jaxlib 0.11 ends the process when it meets this flag, which it no longer has.
    + " --xla_cpu_use_fusion_emitters=false"
    * importlib.metadata.version("jaxlib").startswith("0.10."),
)

import jax
import jaxtyping
import numpy as np
import pytest
from numpy.typing import ArrayLike

from tests import programs

# Compiling the package's source anew takes each process that tests start a second, and workers three.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# Rounding error that a few thousand operations may leave, relative to the norm of the result.
TOLERANCE = {"float64": 1e-12, "float32": 1e-5}

# Linux gives a process 65,530 memory mappings, and each compiled program takes several, and 2 MB.
MAPPINGS, RESIDENT = 40_000, 4e9


def pytest_addoption(parser: pytest.Parser) -> None:
    """Adds the options of `tests/programs.py` and `tests/test_contract.py`."""
    parser.addoption("--keep-programs", action="store_true", help="keep how many programs each test file asks for")
    parser.addoption("--only", default="", help="the contract's rules for functions with this word in their name alone")


def pytest_configure(config: pytest.Config) -> None:
    """Counts the programs of test files."""
    counts = programs.Programs(config, forget)
    programs.watch(counts.count)
    config.pluginmanager.register(counts)


def pytest_collection_finish() -> None:
    """Keeps the garbage collector from walking modules and tests, which stay, and from running every 700 objects."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)


def pytest_unconfigure() -> None:
    """Lets the interpreter free at its end what was kept from the garbage collector."""
    gc.unfreeze()


# These files take minutes each. One that came last would leave the other process idle.
LONG = ("test_notebooks.py", "test_benchmarks.py", "test_docs.py", "cli/test_relight.py")
COARSE = pytest.StashKey[set[pathlib.Path]]()  # files with tests that ask for `coarse`


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Puts the tests of the longest files first, then those at coarse directions: changing over forgets programs."""
    coarse = {item.path for item in items if "coarse" in getattr(item, "fixturenames", ())}
    config.stash[COARSE] = coarse
    items.sort(key=lambda item: (not str(item.path).endswith(LONG), item.path not in coarse))


@pytest.fixture(autouse=True, scope="module")
def room(request: pytest.FixtureRequest) -> Iterator[None]:
    """Forgets what is compiled when the process has too many mappings or bytes; until then, files share programs."""
    if request.path not in request.config.stash[COARSE]:
        set_coarse(False)
    yield
    mappings, pages = pathlib.Path("/proc/self/maps"), pathlib.Path("/proc/self/statm")
    if (
        not mappings.exists()
        or mappings.read_bytes().count(b"\n") > MAPPINGS
        or int(pages.read_text().split()[1]) * mmap.PAGESIZE > RESIDENT
    ):
        forget()


def forget() -> None:
    """Forgets what is compiled, and gives its memory back, which glibc would keep."""
    jax.clear_caches()
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None
    if trim is not None:
        trim(0)


@pytest.fixture(scope="session")
def data() -> pathlib.Path:
    """The folder of real meshes, environments and BRDFs, named by JAXPRT_DATA.

    Without it the test is skipped, or fails where JAXPRT_DATA_REQUIRED=1 says that it must be there.
    """
    name = os.environ.get("JAXPRT_DATA", "")
    if name and pathlib.Path(name).is_dir():
        return pathlib.Path(name).resolve()
    reason = (
        f"JAXPRT_DATA must name the data folder, got {name!r}, which is no folder" if name else "JAXPRT_DATA is not set"
    )
    if os.environ.get("JAXPRT_DATA_REQUIRED") == "1":
        pytest.fail(f"{reason}; JAXPRT_DATA_REQUIRED=1 asks for it")
    pytest.skip(reason)


@pytest.fixture(scope="module")
def coarse() -> None:
    """For one file, BRDFs are fitted and tabulated at fewer directions; the code that does it is the same."""
    set_coarse(True)


_finer: dict[tuple[Any, str], Any] = {}  # what `set_coarse` has replaced


def set_coarse(on: bool) -> None:
    """Sets numbers of directions, fewer or those of the package. Files that ask for fewer share their programs."""
    if on == bool(_finer):
        return
    from jaxprt import bounces, dynamic, harmonic, lobe

    forget()  # Programs hold the numbers that they were compiled with.
    dynamic.reflected._dual.cache_clear()
    if not on:
        for (room, name), value in _finer.items():
            setattr(room, name, value)
        _finer.clear()
        return
    fewer = {
        lobe.em: {"RINGS": 20, "SECTORS": 28},
        dynamic.reflected: {"_RINGS": 20, "_SECTORS": 28},
        bounces.functions: {"_RINGS": 20, "_SECTORS": 28},
        harmonic.table: {
            "_RULES": ((16, 48), (20, 64)),
            "_ANGLES": (48,),
            "_EDGES": (16,),
            "_PROBES": 8,
            "_ERROR": 0.5,
        },
    }
    for room, values in fewer.items():
        for name, value in values.items():
            _finer[room, name] = getattr(room, name)
            setattr(room, name, value)


@pytest.fixture(scope="session")
def bound() -> Callable[..., None]:
    """The function ``bound_options``: ``bound(patch, function, resolution=8)``."""
    return bound_options


def bound_options(patch: pytest.MonkeyPatch, function: Callable, **limits: float) -> None:
    """Bounds options of a function wherever the package calls it, whether callers give them or not.

    Args:
        patch: Takes it back.
        function: A function of jaxprt, replaced under every name that a module of jaxprt has for it.
        limits: The largest value of each option; of ``error``, the smallest.
    """

    @functools.wraps(function)
    def bounded(*arguments: Any, **options: Any) -> Any:
        for name, limit in limits.items():
            given = options.get(name)
            options[name] = limit if given is None else (max if name == "error" else min)(given, limit)
        return function(*arguments, **options)

    modules = [module for name, module in sys.modules.items() if name.partition(".")[0] == "jaxprt"]
    names = [(module, name) for module in modules for name, value in vars(module).items() if value is function]
    assert names, f"no module of jaxprt has {function}"
    for module, name in names:
        patch.setattr(module, name, bounded)


@pytest.fixture
def x64() -> Iterator[None]:
    """Float64 for one test."""
    with jax.enable_x64(True):
        yield


@pytest.fixture
def unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """No shape checks, as users run: for what the package itself says of wrong shapes."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The programs of GPUs, run here: what depends on the platform takes the form for others than CPUs."""
    jax.clear_caches()
    monkeypatch.setattr(jax.lax, "platform_dependent", lambda *arguments, default, **forms: default(*arguments))
    yield
    jax.clear_caches()


@pytest.fixture(scope="session")
def loose() -> Callable[..., list[str]]:
    """The function ``loose_products``: ``assert not loose(function, *arguments)``."""
    return loose_products


def loose_products(function: Callable, *arguments: Any) -> list[str]:
    """Products of floating-point numbers in a function, wherever they are, that GPUs may round to TF32."""
    return list(_loose(jax.make_jaxpr(function)(*arguments).jaxpr))


def _loose(jaxpr: Any) -> Iterator[str]:
    highest = (jax.lax.Precision.HIGHEST,) * 2
    for equation in jaxpr.eqns:
        given, name = equation.params, equation.primitive.name
        floats = any(jax.numpy.issubdtype(each.aval.dtype, np.inexact) for each in equation.invars)
        if name in ("dot_general", "conv_general_dilated", "ragged_dot_general") and floats:
            if given["precision"] != highest:
                yield f"{equation} with precision {given['precision']}"
        elif name == "linear":  # `jaxprt.compile.linear` has its map traced when it is lowered.
            inner = jax.make_jaxpr(functools.partial(equation.primitive.impl, **given))
            yield from _loose(inner(*(each.aval for each in equation.invars)).jaxpr)
        for leaf in jax.tree.leaves(given, is_leaf=lambda x: hasattr(x, "eqns") or hasattr(x, "jaxpr")):
            inner = getattr(leaf, "jaxpr", leaf)
            if hasattr(inner, "eqns"):
                yield from _loose(inner)


@pytest.fixture(scope="session")
def close() -> Callable[..., None]:
    """The function ``assert_close``: ``close(actual, expected, tolerance=None)``."""
    return assert_close


def assert_close(actual: ArrayLike, expected: ArrayLike, *, tolerance: float | None = None) -> None:
    """Asserts that |actual - expected| <= tolerance |expected| in the Euclidean norm over all elements.

    Shapes must agree, NaN and infinity never pass. Where ``expected`` is zero the bound is absolute.

    Args:
        actual: What was computed.
        expected: What it should be.
        tolerance: Another bound than ``TOLERANCE`` has for the dtype of ``actual``; integers and booleans
            must be equal.
    """
    actual, expected = np.asarray(actual), np.asarray(expected)
    assert actual.shape == expected.shape, f"shape {actual.shape}, expected {expected.shape}"
    if tolerance is None:
        tolerance = 0.0 if actual.dtype.kind in "biu" else TOLERANCE[actual.dtype.name]
    wide = np.result_type(actual, expected, np.float64)
    actual, expected = actual.astype(wide), expected.astype(wide)
    assert np.isfinite(expected).all(), "the expected value must be finite"
    broken = np.argwhere(~np.isfinite(actual))
    assert not len(broken), f"{len(broken)} values are not finite, the first at {tuple(map(int, broken[0]))}"
    difference, size = np.linalg.norm(actual - expected), np.linalg.norm(expected)
    error = difference / size if size else difference
    worst = np.unravel_index(np.argmax(np.abs(actual - expected)), actual.shape) if actual.size else ()
    assert error <= tolerance, (
        f"relative error {error:.3g}, tolerance {tolerance:.3g}; largest difference at "
        f"{tuple(map(int, worst))}: {actual[worst]}, expected {expected[worst]}"
    )
