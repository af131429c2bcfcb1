"""Programs survive the process: other processes load them, and whatever is wrong with a file means compiling."""

import importlib
import inspect
import io
import json
import logging
import os
import pathlib
import pickle
import subprocess
import sys
import threading
import types
from typing import Any

import equinox
import jax
import jax.numpy as jnp
import numba
import numpy as np
import pytest
from jax._src import compilation_cache
from numba.core import types as numba_types
from numba.core.caching import NullCache

from jaxprt import Camera
from jaxprt.compile import kept, numba_loop
from jaxprt.image import raster
from jaxprt.programs import executables, jax_cache, loops, store
from jaxprt.programs.store import Store
from jaxprt.scene import panorama_loops
from jaxprt.visibility import embree, packets, picture_loops

ROOT = pathlib.Path(__file__).parents[1]
axes = inspect.unwrap(raster.view_axes)  # a small function of a camera

# A process that compiles two programs, one of them by `kept`, and says what JAX did.
SCRIPT = """
import inspect, json, sys
import jax
import numpy as np

count = {}
def note(event, *_, **__):
    name = event.rpartition("/")[2]
    count[name] = count.get(name, 0) + 1
jax.monitoring.register_event_listener(note)
jax.monitoring.register_event_duration_secs_listener(note)
exec(sys.argv[1])
import jaxprt
from jaxprt.compile import jit, kept
from jaxprt.image import raster
exec(sys.argv[2])
camera = jaxprt.Camera(np.float32([1, 2, 3]), np.zeros(3, np.float32), np.float32([0, 1, 0]), 0.5, 4, 3)
camera = jax.tree.map(np.float32, camera)
axes = kept(inspect.unwrap(raster.view_axes))(camera)
sums = jit(lambda x: np.float32(7) * (x @ x.T).sum(1))(np.ones((3, 3), np.float32))
print(json.dumps({
    "result": np.concatenate([np.asarray(axes).ravel(), sums]).tobytes().hex(),
    "compiled": count.get("backend_compile_duration", 0) - count.get("cache_hits", 0),
    "traced": count.get("jaxpr_to_mlir_module_duration", 0),
    "configuration": {name: getattr(jax.config, name) for name in jaxprt.programs.jax_cache._DEFAULTS},
}))
"""


def start(cache: pathlib.Path, before: str = "", after: str = "", **environment: str) -> subprocess.Popen:
    unset = (*jax_cache._VARIABLES, "JAXPRT_KEEP_PROGRAMS")  # which benchmarks set, and tests of them
    clean = {name: value for name, value in os.environ.items() if not name.startswith(unset)}
    command = [sys.executable, "-W", "error", "-c", SCRIPT, before, after]
    environment = {**clean, "XDG_CACHE_HOME": str(cache), "HOME": str(cache), "PYTHONPATH": str(ROOT), **environment}
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)


def said(process: subprocess.Popen) -> dict[str, Any]:
    out, error = process.communicate(timeout=120)
    assert process.returncode == 0, error
    assert not error
    return json.loads(out)


def damage(folder: pathlib.Path) -> None:
    for number, path in enumerate(sorted(folder.iterdir())):
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(content[: len(content) // 3] if number % 2 else content)


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """Two processes that began at once with an empty folder: the cache folder, and what they say."""
    cache = tmp_path_factory.mktemp("cache")
    both = [start(cache), start(cache)]
    return cache, [said(each) for each in both]


def test_a_second_process_compiles_nothing_and_a_damaged_file_is_compiled_anew(first):
    cache, (one, other) = first
    assert one["compiled"] + other["compiled"] >= 2
    assert one["result"] == other["result"]
    assert one["configuration"] == {**jax_cache._DEFAULTS, "jax_persistent_cache_min_compile_time_secs": 0}
    folder = cache / "jaxprt" / "programs"
    assert not [path for path in folder.iterdir() if path.stat().st_mode & 0o077 or path.name.startswith(".new")]
    assert not folder.stat().st_mode & 0o077
    second = said(start(cache))
    assert (second["compiled"], second["result"]) == (0, one["result"])
    assert second["traced"] < one["traced"]  # `kept` does not trace
    count = len(list(folder.iterdir()))
    damage(folder)
    third, flagged = (
        start(cache),
        start(cache, XLA_FLAGS=os.environ["XLA_FLAGS"] + " --xla_cpu_enable_fast_min_max=true"),
    )
    third, flagged = said(third), said(flagged)
    assert (third["compiled"], third["result"]) == (flagged["compiled"], one["result"])
    assert flagged["compiled"] >= one["compiled"]  # the first two processes may have loaded each other's programs
    assert len(list(folder.iterdir())) == 2 * count


def test_the_cache_that_the_user_configures_later_takes_over(tmp_path):
    place = str(tmp_path / "theirs")
    told = said(start(tmp_path, after=f"jax.config.update('jax_compilation_cache_dir', {place!r})"))
    assert told["configuration"] == {**jax_cache._DEFAULTS, "jax_compilation_cache_dir": place}
    assert not (tmp_path / "jaxprt").exists()


@pytest.fixture
def untouched(monkeypatch):
    """JAX as it is where nobody has configured its cache: its options, which tests may change."""
    for name in os.environ:
        if name.startswith(jax_cache._VARIABLES) or name == "JAXPRT_KEEP_PROGRAMS":  # which benchmarks set
            monkeypatch.delenv(name)
    options = types.SimpleNamespace(**jax_cache._DEFAULTS)
    options.update = options.__setattr__
    monkeypatch.setattr(jax_cache, "jax", types.SimpleNamespace(config=options))
    monkeypatch.setattr(compilation_cache, "_cache", None)
    monkeypatch.setattr(compilation_cache, "_cache_initialized", False)
    return options


@pytest.mark.parametrize(
    "set_by_user",
    [
        lambda patch, options: patch.setenv("JAXPRT_KEEP_PROGRAMS", "0"),
        lambda patch, options: patch.setenv("JAX_COMPILATION_CACHE_DIR", "theirs"),
        lambda patch, options: patch.setattr(options, "jax_compilation_cache_dir", "theirs"),
        lambda patch, options: patch.setattr(options, "jax_persistent_cache_min_compile_time_secs", 5.0),
        lambda patch, options: patch.setattr(compilation_cache, "_cache_initialized", True),
    ],
)
def test_one_line_and_any_configuration_of_the_user_turn_it_off(set_by_user, untouched, monkeypatch):
    set_by_user(monkeypatch, untouched)
    before = vars(untouched).copy()
    jax_cache.install()
    assert vars(untouched) == before
    assert not jax_cache.active()


@pytest.fixture
def files(tmp_path):
    return Store(tmp_path / "cache" / "programs")


def test_files_hold_what_was_written_under_their_own_name_only(files):
    files.write("name", b"content")
    assert files.read("name") == b"content"
    assert files.read("other") is None
    (files.folder / "name").rename(files.folder / "other")
    assert files.read("other") is None


@pytest.mark.parametrize("place", [0, 32, -1])
@pytest.mark.parametrize("change", ["flipped", "cut"])
def test_a_damaged_file_counts_as_absent_and_is_replaced(place, change, files):
    files.write("name", bytes(range(100)))
    content = bytearray((files.folder / "name").read_bytes())
    content[place] ^= 1
    (files.folder / "name").write_bytes(content if change == "flipped" else content[:place])
    assert files.read("name") is None
    files.write("name", b"new")
    assert files.read("name") == b"new"


def test_the_files_that_were_used_least_recently_are_deleted(tmp_path):
    files = Store(tmp_path, most=10_000)
    tmp_path.chmod(0o700)
    for number in range(100):
        files.write(str(number), bytes(500))
        os.utime(tmp_path / str(number), (number, number))
        assert number < 3 or files.read("2") is not None  # used each time
    sizes = [path.stat().st_size for path in tmp_path.iterdir()]
    assert 5_000 < sum(sizes) <= 10_000 * 17 / 16 + 600
    assert files.read("99") is not None
    assert files.read("50") is None


def test_unfinished_files_of_processes_that_ended_are_deleted(files):
    files.write("name", b"content")
    for name, age in ((".new-old", 10_000), (".new-young", 10)):
        path = files.folder / name
        path.write_bytes(b"")
        os.utime(path, (path.stat().st_mtime - age,) * 2)
    Store(files.folder).write("other", b"content")
    assert sorted(path.name for path in files.folder.iterdir()) == [".new-young", "name", "other"]


posix = pytest.mark.skipif(os.name != "posix", reason="links, pipes and permissions of POSIX")


@posix
def test_folders_and_files_that_others_may_write_are_not_trusted(files, caplog):
    files.write("name", b"content")
    (files.folder / "name").chmod(0o622)
    assert files.read("name") is None
    (files.folder / "name").chmod(0o600)
    for mode in (0o770, 0o1777, 0o777):
        files.folder.chmod(mode)
        assert files.read("name") is None
        files.write("other", b"content")
    assert [record.getMessage() for record in caplog.records] == [
        f"compiled programs are not kept: other users may write into {files.folder}; chmod 700 makes it private"
    ]
    assert [path.name for path in files.folder.iterdir()] == ["name"]


@posix
@pytest.mark.parametrize(("mode", "trusted"), [(0o1777, True), (0o777, False), (0o775, False)])
@pytest.mark.parametrize("above", [0, 2])
def test_every_folder_above_is_private_or_sticky(mode, trusted, above, tmp_path, caplog):
    files = Store(tmp_path / "cache" / "jaxprt" / "programs")
    files.write("name", b"content")
    path = files.folder.parents[above]
    path.chmod(mode)
    assert files.read("name") == (b"content" if trusted else None)
    Store(path / "new" / "programs").write("name", b"content")
    assert (path / "new").exists() == trusted
    fault = f"other users may write into {path}; chmod go-w makes it private"
    assert set(caplog.messages) == (set() if trusted else {f"compiled programs are not kept: {fault}"})


@posix
@pytest.mark.parametrize(("mode", "trusted"), [(0o755, True), (0o1777, False), (0o777, False)])
def test_a_link_counts_where_nobody_else_may_make_one(mode, trusted, tmp_path):
    planted = Store(tmp_path / "repository" / "jaxprt" / "programs")
    planted.write("name", b"planted")
    (tmp_path / "cache").mkdir()
    (tmp_path / "cache" / "user").symlink_to("../repository")
    (tmp_path / "cache").chmod(mode)
    files = Store(tmp_path / "cache" / "user" / "jaxprt" / "programs")
    assert files.read("name") == (b"planted" if trusted else None)
    files.write("other", b"content")
    assert (planted.folder / "other").exists() == trusted


@posix
@pytest.mark.parametrize("link", ["jaxprt", "jaxprt/programs"])
def test_links_in_place_of_the_folder_are_not_followed(link, tmp_path, caplog):
    planted = Store(tmp_path / "repository" / "jaxprt" / "programs")
    planted.write("name", b"planted")
    path = tmp_path / "cache" / link
    path.parent.mkdir(parents=True)
    path.symlink_to(tmp_path / "repository" / link)
    files = Store(tmp_path / "cache" / "jaxprt" / "programs")
    assert files.read("name") is None
    files.write("other", b"content")
    assert [file.name for file in planted.folder.iterdir()] == ["name"]
    assert caplog.messages == [f"compiled programs are not kept: {path} is a symbolic link"]


def sparse(path, _):
    with path.open("wb") as file:
        file.truncate(8 << 30)


@posix
@pytest.mark.parametrize(
    "plant",
    [
        lambda path, other: path.symlink_to(other),
        lambda path, other: path.hardlink_to(other),
        lambda path, _: os.mkfifo(path, 0o600),
        lambda path, _: path.symlink_to("/dev/zero"),
        sparse,
    ],
    ids=["link", "hard link", "pipe", "device", "8 GB"],
)
def test_whatever_else_stands_in_place_of_a_file_is_not_read_and_gives_way(plant, files, tmp_path):
    files.write("name", b"content")
    (files.folder / "name").rename(tmp_path / "planted")
    plant(files.folder / "name", tmp_path / "planted")
    assert files.read("name") is None
    files.write("name", b"new")
    assert files.read("name") == b"new"
    assert (tmp_path / "planted").read_bytes().endswith(b"content")


@pytest.mark.skipif(getattr(os, "geteuid", lambda: 1)() != 0, reason="only root may give folders away")
@pytest.mark.parametrize("above", [0, 2])
def test_folders_above_belong_to_root_or_the_user(above, tmp_path, caplog):
    files = Store(tmp_path / "cache" / "jaxprt" / "programs")
    files.write("name", b"content")
    path = files.folder.parents[above]
    os.chown(path, 12_345, 0)
    assert files.read("name") is None
    assert caplog.messages == [f"compiled programs are not kept: {path} belongs to another user"]


@pytest.mark.parametrize("content", [None, "", "processor : 0\n", "vendor_id : A\nmodel : 1\nflags :\n"])
def test_a_processor_that_the_system_does_not_name_keeps_nothing(content, untouched, monkeypatch, caplog):
    def read(*_, **__):
        if content is None:
            raise PermissionError
        return io.StringIO(content)

    assert store.is_enabled()
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(store, "open", read, raising=False)
    monkeypatch.setattr(store, "processor", inspect.unwrap(store.processor))
    monkeypatch.setattr(store, "_warn", inspect.unwrap(store._warn))
    assert store.processor() == ""
    jax_cache.install()
    assert not jax_cache.active()
    assert isinstance(vars(loops.keep(numba.njit(doubled)))["_cache"], NullCache)
    assert caplog.messages[0] == "compiled programs are not kept: the system does not name the processor"


def test_two_processors_have_two_names(monkeypatch):
    text = "vendor_id : A\nmodel : {}\nflags : avx {}\n\nprocessor : 1\n"
    monkeypatch.setattr(sys, "platform", "linux")
    names = set()
    for model in (1, 2):
        for flag in ("avx2", "avx512f"):
            monkeypatch.setattr(
                store, "open", lambda *_, m=model, f=flag, **__: io.StringIO(text.format(m, f)), raising=False
            )
            names.add(inspect.unwrap(store.processor)())
    assert len(names) == 4
    assert "" not in names


def test_after_a_full_disk_nothing_more_is_written(files, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    files.write("name", b"content")
    monkeypatch.setattr(os, "replace", full)
    files.write("other", b"content")
    monkeypatch.undo()
    files.write("third", b"content")
    assert [path.name for path in files.folder.iterdir()] == ["name"]
    assert files.read("name") == b"content"


@pytest.mark.parametrize("noisy", [False, True])
def test_a_processor_whose_programs_xla_complains_about_keeps_none(noisy, monkeypatch, files, caplog, capfd):
    def load(*_, **__):
        os.write(2, b"doesn't match the machine type for execution" if noisy else b"of another thread")

    monkeypatch.setattr(jax_cache.serialize_executable, "deserialize_and_load", load)
    monkeypatch.setattr(jax_cache, "process_store", lambda: files)
    asked = inspect.unwrap(jax_cache.loads_quietly)
    assert asked() is asked() is not noisy  # the second time from a file
    assert capfd.readouterr().err == ("" if noisy else "of another thread")
    assert [record.levelno for record in caplog.records] == [logging.WARNING] * noisy


@pytest.fixture
def kept_files(monkeypatch, files):
    """Executables are kept in a folder of the test."""
    monkeypatch.setattr(compilation_cache, "_cache", None)  # XLA cannot write again what the tests' cache holds
    monkeypatch.setattr(compilation_cache, "_cache_initialized", True)
    monkeypatch.setattr(jax_cache, "active", lambda: True)
    monkeypatch.setattr(jax_cache, "loads_quietly", lambda: True)
    monkeypatch.setattr(jax_cache, "process_store", lambda: files)
    return files


def camera(x: float = 1.0, width: int = 4) -> Camera:
    eye, target, up = np.array([[x, 2, 3], [0, 0, 0], [0, 1, 0]], np.float32)
    return jax.tree.map(jnp.asarray, Camera(jnp.asarray(eye), jnp.asarray(target), jnp.asarray(up), 0.5, width, 3))


def test_an_executable_is_loaded_without_tracing(kept_files, monkeypatch):
    expected = np.asarray(kept(axes)(camera()))
    assert len(list(kept_files.folder.iterdir())) == 1
    later = kept(axes)
    monkeypatch.setattr(later, "_compiled", None)
    np.testing.assert_array_equal(later(camera()), expected)
    np.testing.assert_array_equal(later(camera()), expected)


def test_an_executable_compiled_quickly_is_another_one(kept_files):
    expected = np.asarray(kept(axes)(camera()))
    np.testing.assert_allclose(kept(axes, quick=True)(camera()), expected, rtol=1e-6)
    assert len(list(kept_files.folder.iterdir())) == 2


def test_an_option_that_the_compiler_lacks_is_left_out(kept_files, monkeypatch):
    expected = np.asarray(kept(axes)(camera()))
    monkeypatch.setattr(executables, "_QUICK", {"xla_cpu_emitters_of_no_version": False})
    np.testing.assert_array_equal(kept(axes, quick=True)(camera()), expected)


def test_an_executable_that_cannot_be_loaded_again_is_not_kept(kept_files, monkeypatch):
    def fail(*_, **__):
        raise RuntimeError("NOT_FOUND: Function sub.7_kernel not found")

    monkeypatch.setattr(executables.serialize_executable, "deserialize_and_load", fail)
    assert kept(axes)(camera()).shape == (3, 3)
    assert not kept_files.folder.exists()


def test_calls_that_are_traced_or_elsewhere_go_through_jit(kept_files):
    function = kept(axes)
    slope = jax.jacobian(lambda x: function(equinox.tree_at(lambda c: c.eye, camera(), x)))(camera().eye)
    assert np.isfinite(slope).all()
    jax.jit(function)(camera())
    jax.vmap(function)(jax.tree.map(lambda x: jnp.stack([x, x]), camera()))
    with jax.debug_nans(True):
        function(camera())
    with jax.disable_jit():
        function(camera())
    if jax.device_count() > 1:
        assert function(jax.device_put(camera(), jax.devices()[1])).devices() == {jax.devices()[1]}
    assert not kept_files.folder.exists()


class Theirs(Camera):
    """A camera of another class: its code is unknown."""


def called_back(x):
    """It calls Python."""
    return jax.pure_callback(lambda x: x, jax.ShapeDtypeStruct(x.shape, x.dtype), x)


def test_programs_of_unknown_code_and_calls_of_python_are_not_kept(kept_files, monkeypatch):
    function = kept(axes)
    theirs = Theirs(**{name: getattr(camera(), name) for name in vars(camera())})
    np.testing.assert_array_equal(function(theirs), function(camera()))
    assert len(list(kept_files.folder.iterdir())) == 1
    assert kept(lambda x: x + 1)(jnp.ones(2)).tolist() == [2, 2]
    monkeypatch.setattr(raster, "called_back", called_back, raising=False)
    monkeypatch.setattr(called_back, "__module__", raster.__name__)
    assert kept(called_back)(jnp.ones(2)).tolist() == [1, 1]
    assert len(list(kept_files.folder.iterdir())) == 1


@pytest.mark.parametrize("content", [b"", b"no zlib", pickle.dumps(1)])
def test_a_file_that_cannot_be_loaded_is_compiled_anew(content, kept_files):
    expected = np.asarray(kept(axes)(camera()))
    (path,) = kept_files.folder.iterdir()
    kept_files.write(path.name, content)
    np.testing.assert_array_equal(kept(axes)(camera()), expected)
    assert len(kept_files.read(path.name)) > 1000


def test_a_call_does_not_wait_for_a_program_of_another_shape(kept_files, monkeypatch):
    function = kept(axes)
    began, release, results = threading.Event(), threading.Event(), []
    compile_now = function._executable

    def held(operand, option, tree, aval):
        if threading.current_thread() is slow:
            began.set()
            release.wait(60)
        return compile_now(operand, option, tree, aval)

    monkeypatch.setattr(function, "_executable", held)
    slow = threading.Thread(target=lambda: results.append(function(camera(width=5))))
    slow.start()
    assert began.wait(60)
    assert function(camera()).shape == (3, 3)
    assert slow.is_alive()
    release.set()
    slow.join()
    assert len(results) == 1


def test_threads_compile_an_executable_once(kept_files):
    function = kept(axes)
    results: list[Any] = [None] * 4

    def work(number):
        results[number] = np.asarray(function(camera()))

    threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    assert np.ptp(np.stack(results), 0).max() == 0
    assert len(function._executables) == 1
    assert executables.count() >= 1
    executables.forget()
    assert executables.count() == 0
    assert not function._executables


def test_surroundings_change_with_versions_flags_options_processor_and_code(monkeypatch, tmp_path):
    found = {executables.surroundings()}
    fixed = inspect.unwrap(executables._process_facts)
    monkeypatch.setattr(executables, "_process_facts", fixed)
    for change in (
        lambda: monkeypatch.setattr(executables, "version_str", "0.0.1"),
        lambda: monkeypatch.setattr(executables, "processor", lambda: "another"),
        lambda: monkeypatch.setenv("XLA_FLAGS", "--another"),
        lambda: monkeypatch.setattr(executables, "_PACKAGE", tmp_path),
        lambda: (tmp_path / "module.py").write_text("1"),
        lambda: (tmp_path / "module.py").write_text("2"),
    ):
        change()
        monkeypatch.setattr(executables, "_STARTED", np.inf)
        assert executables.surroundings() not in found
        found.add(executables.surroundings())
    with jax.default_matmul_precision("float32"):
        assert executables.surroundings() not in found
    (tmp_path / "__pycache__").mkdir()
    (tmp_path / "__pycache__" / "module.nbi").write_text("of Numba")
    assert executables.surroundings() in found
    monkeypatch.setattr(executables, "_STARTED", 0.0)
    with pytest.raises(executables.UnnamedError, match="has changed"):
        executables.surroundings()


@pytest.mark.parametrize("value", [lambda: 0, object(), np.ones(2), np.float32(1), {"a": object()}, called_back])
def test_values_that_have_no_name_are_refused(value):
    with pytest.raises(executables.UnnamedError):
        executables.describe(value)


def test_names_tell_values_apart():
    values = [None, 0, 0.0, False, "0", (0,), [0], {"a": 0}, {"b": 0}, np.dtype("f4"), np.dtype("f8"), Camera, axes]
    assert len({executables.describe(each) for each in values}) == len(values)
    structures = [jax.tree.structure(each) for each in (camera(), camera(width=5), (1,), [1], {"a": 1}, None)]
    assert len({executables.describe(each) for each in structures}) == len(structures)


@pytest.fixture
def loop_files(monkeypatch, files):
    """Loops of numba are kept in a folder of the test."""
    monkeypatch.setattr(loops, "is_enabled", lambda: True)  # benchmarks turn it off
    monkeypatch.setattr(loops, "process_store", lambda: files)
    return files


def test_a_later_process_loads_a_loop_unless_something_that_it_reads_has_changed(loop_files, monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    (tmp_path / "kept_loop.py").write_text("""
import kept_constants
import numpy as np
from jaxprt.compile import numba_loop
from kept_constants import SCALE, shift

@numba_loop
def last(x):
    return x + kept_constants.LAST

@numba_loop
def loop(x):
    return last(SCALE * shift(x) + kept_constants.TABLE[1] + np.float32(0))
""")
    text = """
import numpy as np
from jaxprt.compile import numba_loop

SCALE, TABLE, STEP, LAST, UNREAD = 2.0, np.array([0.0, 10.0]), 1, 0.0, 7

@numba_loop
def shift(x):
    return x + STEP
"""

    def compute(text):
        """The value of the loop at 1 in new modules, and whether it was loaded."""
        (tmp_path / "kept_constants.py").write_text(text)
        for name in ("kept_loop", "kept_constants"):
            sys.modules.pop(name, None)
        importlib.invalidate_caches()
        loop = importlib.import_module("kept_loop").loop
        return loop(1.0), loop.stats.cache_hits.total() == 1

    assert compute(text) == (14.0, False)
    assert compute(text) == (14.0, True)
    assert compute(text.replace("7", "8")) == (14.0, True)
    assert compute(text.replace("2.0", "3.0")) == (16.0, False)
    assert compute(text.replace("10.0", "20.0")) == (24.0, False)
    assert compute(text.replace("1, 0.0", "2, 0.0")) == (16.0, False)
    assert compute(text.replace("1, 0.0", "1, 5.0")) == (19.0, False)
    assert compute(text.replace("x + STEP", "x - STEP")) == (10.0, False)
    assert compute(text) == (14.0, True)
    for path in loop_files.folder.iterdir():
        loop_files.write(path.name, b"no pickle")
    assert compute(text) == (14.0, False)
    loop_files.folder.chmod(0o777)
    assert compute(text) == (14.0, os.name != "posix")


def test_every_loop_of_the_package_is_kept_under_a_name_of_its_own(loop_files, monkeypatch):
    modules = embree, packets, picture_loops, panorama_loops
    every = [value for module in modules for value in vars(module).values() if hasattr(value, "_cache")]
    assert len(every) > 30
    assert len({loops.describe(loop) for loop in every}) == len(every)
    hits = packets._compiled_filter()
    before = loops.describe(hits)
    turned = np.dtype([(name, "i8") for name in reversed(packets._TABLE.names)])
    for name, value in {"_CLEAR": 2 * packets._CLEAR, "_TABLE": turned}.items():
        with monkeypatch.context() as patch:
            patch.setattr(packets, name, value)  # which `_alpha` reads, and the filter calls
            assert loops.describe(hits) != before


def test_a_function_that_c_calls_is_kept_too(loop_files):
    for hits in (0, 1):
        twice = embree.callback(numba_types.float64(numba_types.float64), doubled)
        assert twice.ctypes(4.0) == 8
        assert twice.cache_hits == hits


def doubled(x):
    """Twice a number."""
    return 2 * x


@pytest.mark.parametrize("value", [object(), {"a": 1}, np.array([None]), Camera])
def test_loops_that_read_values_of_other_kinds_are_not_kept(value):
    with pytest.raises(executables.UnnamedError):
        loops.describe(value)


@pytest.mark.parametrize("granted", [2, 10**9])
def test_programs_are_forgotten_before_memory_mappings_run_out(granted, monkeypatch, tmp_path):
    if not executables._MAPS.exists():
        pytest.skip("this system does not list memory mappings")
    (tmp_path / "most").write_text(str(granted))
    monkeypatch.setattr(executables, "_MOST", tmp_path / "most")
    monkeypatch.setattr(executables, "_FEW", 1)
    program = jax.jit(lambda x: 3 * x)
    forgotten = []
    monkeypatch.setattr(jax, "clear_caches", lambda: forgotten.append(program.clear_cache()))
    assert program(2.0) == 6
    jax.jit(lambda x: [executables.make_room(), x][1])(1.0)
    assert not forgotten  # not while a program is being traced
    executables.make_room()
    assert program._cache_size() == (granted > 2)
    executables.make_room()
    assert len(forgotten) == (granted == 2)  # nothing new since
    assert program(2.0) == 6


def test_folders_and_homes_of_another_user_are_left_alone(files, monkeypatch):
    files.write("name", b"content")
    monkeypatch.setattr(os, "geteuid", lambda: files.folder.stat().st_uid + 1)
    assert files.read("name") is None
    other = Store(files.folder.parent / "other" / "programs")
    other.write("name", b"content")
    assert not other.folder.parent.exists()


def test_what_differs_in_shape_type_or_static_values_is_another_executable(kept_files, x64):
    function = kept(axes)
    for each in (camera(), camera(width=5), jax.tree.map(lambda x: x.astype(float), camera())):
        np.testing.assert_array_equal(function(each), raster.view_axes(each))
    with jax.enable_x64(False):
        function(camera())
    assert len(list(kept_files.folder.iterdir())) == 4
    with pytest.raises(ValueError, match="Non-hashable static"):
        kept(inspect.unwrap(raster.rasterize), static=("samples",))(None, camera(), samples=[1])


def test_one_line_turns_it_off_for_loops(monkeypatch):
    monkeypatch.setenv("JAXPRT_KEEP_PROGRAMS", "0")
    loop = numba_loop(doubled)
    assert isinstance(vars(loop)["_cache"], NullCache)
    assert loop(2.0) == 4
