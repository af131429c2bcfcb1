"""The store: what is read back is what was written, or reported missing."""

import json
import os
import pathlib
import pickle
import resource
import subprocess
import sys
from contextlib import ExitStack

import numpy as np
import pytest

from jaxprt.files import arrays
from jaxprt.files.arrays import BlockStore, Layout

LAYOUT = {"index": Layout((3, 4), 1, "uint16"), "value": Layout((3, 4, 2), 1, "float32")}
HEADER = {"system": "test", "keep": 3}
BLOCKS = 5


def block(number):
    random = np.random.default_rng(number)
    return {
        "index": random.integers(1, 1 << 16, size=(3, 4)).astype(np.uint16),
        "value": random.normal(size=(3, 4, 2)).astype(np.float32),
    }


def open_store(path, **change):
    return BlockStore(path, HEADER | change.pop("header", {}), change.pop("layout", LAYOUT), BLOCKS, **change)


@pytest.fixture
def path(tmp_path):
    """A finished store."""
    store = open_store(tmp_path / "a.prt")
    for number in range(BLOCKS):
        store.write(number, block(number))
    return store.path


def found(path):
    """Numbers of the blocks that read back as they were written; others must be reported missing."""
    store = open_store(path)
    result = []
    for number in range(BLOCKS):
        array = store.read(number)
        if array is not None:
            for name, expected in block(number).items():
                np.testing.assert_array_equal(array[name], expected)
                assert array[name].dtype == expected.dtype
            result.append(number)
    return result


def place(path, name, number):
    """The file of an array, and where a block lies in it."""
    size = 4 if name == "checksum" else block(0)[name].nbytes
    file = path / f"{name}.npy"
    start = file.stat().st_size - BLOCKS * size
    return file, slice(start + number * size, start + (number + 1) * size)


def test_blocks_read_back_as_written_in_any_order(tmp_path):
    store = open_store(tmp_path / "some" / "where" / "a.prt")
    for number in (3, 0, 4):
        store.write(number, block(number))
    assert found(store.path) == [0, 3, 4]


def test_blocks_of_zeros_count_as_written(tmp_path):
    store = open_store(tmp_path / "a.prt")
    zero = {name: np.zeros_like(array) for name, array in block(0).items()}
    store.write(1, zero)
    np.testing.assert_array_equal(open_store(store.path).read(1)["value"], zero["value"])
    assert store.read(0) is None


def test_a_store_has_one_file_for_each_array_and_leaves_nothing_aside(path):
    files = {file.name for file in path.iterdir()}
    assert files == {"store.json", "index.npy", "value.npy", "checksum.npy"}
    assert list(path.parent.iterdir()) == [path]


def test_any_program_that_knows_the_format_of_numpy_can_map_it(path):
    value = np.load(path / "value.npy", mmap_mode="r", allow_pickle=False)
    np.testing.assert_array_equal(value[1], block(1)["value"])
    header = json.loads((path / "store.json").read_text())
    assert (header["system"], header["version"]) == ("test", arrays.VERSION)


@pytest.mark.parametrize("count", [1, 17, 20])
def test_whole_arrays_are_cut_to_their_entries_and_mapped_where_blocks_follow_each_other(tmp_path, count):
    layout = LAYOUT | {"first": Layout((4, 3), 0, "float16")}
    store = BlockStore(tmp_path / "a.prt", HEADER, layout, BLOCKS)
    for number in reversed(range(BLOCKS)):
        store.write(number, block(number) | {"first": np.full((4, 3), number, np.float16)})
    for name, axis in (("index", 1), ("value", 1)):
        expected = np.concatenate([block(number)[name] for number in range(BLOCKS)], axis)
        found = store.whole(name, count)
        np.testing.assert_array_equal(found, np.take(expected, np.arange(count), axis))
        assert found.ctypes.data % arrays.ALIGN == 0
        assert arrays.reference(found) is found
    first = store.whole("first", count)
    np.testing.assert_array_equal(first[:, 1], np.arange(count) // 4)
    there = arrays.reference(first)
    assert isinstance(there, arrays.Reference)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(there)).open(), first)
    assert arrays.reference(first[1:]) is not None
    (store.path / "first.npy").rename(tmp_path / "gone")
    with pytest.raises(FileNotFoundError, match=r"first\.npy must be seen by all workers"):
        there.open()


@pytest.mark.parametrize("name", ["index", "value", "checksum"])
@pytest.mark.parametrize("damage", ["cut off", "one bit", "zeroed", "longer"])
def test_damaged_blocks_are_reported_missing_and_can_be_written_again(path, name, damage):
    file, at = place(path, name, 2)
    content = bytearray(file.read_bytes())
    if damage == "cut off":
        del content[at.start + 3 :]
    elif damage == "one bit":
        content[at.start] ^= 4
    elif damage == "zeroed":
        content[at] = bytes(at.stop - at.start)
    else:
        content += b"more"
    file.write_bytes(content)
    left = {"cut off": [0, 1], "longer": list(range(BLOCKS))}.get(damage, [0, 1, 3, 4])
    assert found(path) == left
    store = open_store(path)
    for number in set(range(BLOCKS)) - set(left):
        store.write(number, block(number))
    assert found(path) == list(range(BLOCKS))


def test_blocks_swapped_on_disk_are_reported_missing(path):
    value = np.load(path / "value.npy", mmap_mode="r+")
    value[[1, 3]] = value[[3, 1]]
    del value
    assert found(path) == [0, 2, 4]


def test_blocks_of_another_shape_are_refused(path):
    with pytest.raises(ValueError, match=r"index must have blocks of \[3, 4\], got \[4, 3\]"):
        open_store(path).write(0, block(0) | {"index": block(0)["index"].T})


@pytest.mark.parametrize("name", ["index", "checksum"])
def test_a_store_without_one_of_its_arrays_is_refused_by_name(path, name):
    (path / f"{name}.npy").unlink()
    with pytest.raises(ValueError, match=r"a\.prt lacks the array " + name):
        open_store(path)


@pytest.mark.parametrize(
    "content", [b"", b"no array", b"\x93NUMPY\x01\x00v\x00{'descr': '<f4', 'fortran_order': False, 'sh"]
)
def test_arrays_whose_headers_are_damaged_are_refused(path, content):
    (path / "index.npy").write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.prt exists but is not a readable store"):
        open_store(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"header": {"keep": 4}},
            r"a\.prt holds arrays that were computed from other inputs \(keep: stored 3, now 4\)",
        ),
        ({"header": {"system": "other"}}, r"\(system: stored test, now other\)"),
        ({"header": {"more": 1}}, r"\(more: stored None, now 1\)"),
    ],
)
def test_stores_of_something_else_are_refused(path, change, message):
    with pytest.raises(ValueError, match=message):
        open_store(path, **change)
    assert found(path) == list(range(BLOCKS))


def test_stores_of_another_version_are_refused(path, monkeypatch):
    monkeypatch.setattr(arrays, "VERSION", arrays.VERSION + 1)
    with pytest.raises(ValueError, match=r"a\.prt has format version 4, this package writes 5; delete it"):
        open_store(path)


def test_stores_of_versions_that_zarr_wrote_are_refused_by_their_version(tmp_path):
    (tmp_path / "a.prt").mkdir()
    header = {"zarr_format": 3, "node_type": "group", "attributes": {"format": "jaxprt blocks", "version": 3}}
    (tmp_path / "a.prt" / "zarr.json").write_text(json.dumps(header))
    with pytest.raises(ValueError, match=r"a\.prt has format version 3, this package writes 4; delete it"):
        open_store(tmp_path / "a.prt")


@pytest.mark.parametrize("kind", ["empty folder", "foreign folder", "foreign zarr", "plain file", "broken header"])
def test_what_is_no_store_is_refused_and_left_alone(tmp_path, kind):
    path = tmp_path / "a.prt"
    if kind == "plain file":
        path.write_text("precious")
    elif kind == "foreign zarr":
        path.mkdir()
        (path / "zarr.json").write_text('{"zarr_format": 3, "node_type": "group", "attributes": {"mine": 1}}')
    elif kind == "broken header":
        (open_store(path).path / "store.json").write_text("{")
    else:
        path.mkdir()
        if kind == "foreign folder":
            (path / "precious.txt").write_text("precious")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(ValueError, match=r"a\.prt exists but is n"):
        open_store(path)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("held", [(1, 1), (2, 4), (3, 4), (1, 2)])
def test_parts_of_one_number_are_written_at_once_and_others_are_refused(path, held):
    with ExitStack() as writers:
        writers.enter_context(open_store(path).writing(held))
        for part in ((1, 1), (2, 4), (4, 4), (1, 2)):
            allowed = part != held and part[1] == held[1]
            with ExitStack() as more:
                if not allowed:
                    more.enter_context(pytest.raises(BlockingIOError, match=r"a\.prt is being written by another"))
                with open_store(path).writing(part):
                    assert allowed
    with open_store(path).writing():
        pass


def test_a_full_disk_is_told_and_finished_blocks_stay(tmp_path):
    store, limits = open_store(tmp_path / "a.prt"), resource.getrlimit(resource.RLIMIT_FSIZE)
    store.write(0, block(0))
    full = (store.path / "value.npy").stat().st_size + block(0)["value"].nbytes // 2
    resource.setrlimit(resource.RLIMIT_FSIZE, (full, limits[1]))
    try:
        with pytest.raises(OSError, match=r"a\.prt cannot grow \(.*\); finished blocks are kept: call again"):
            store.write(1, block(1))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert found(store.path) == [0]
    store.write(1, block(1))
    assert found(store.path) == [0, 1]


def test_a_store_knows_itself_after_a_journey_and_no_other_in_its_place(path, tmp_path):
    store = pickle.loads(pickle.dumps(open_store(path)))
    assert store.here
    path.rename(tmp_path / "moved")
    assert not store.here
    open_store(path)
    assert not store.here


def test_a_lock_left_behind_by_a_killed_process_does_not_hold(path):
    script = (
        (
            "import os, signal, sys\n"
            "from jaxprt.files.arrays import BlockStore, Layout\n"
            f"layout = {{k: Layout(*v) for k, v in {dict(LAYOUT)!r}.items()}}\n"
            f"store = BlockStore({str(path)!r}, {HEADER!r}, layout, 5)\n"
            "with store.writing():\n"
            "    os.kill(os.getpid(), signal.SIGKILL)\n"
        )
        .replace("Layout(shape=", "dict(shape=")
        .replace("Layout(*v)", "Layout(**v)")
    )
    done = subprocess.run([sys.executable, "-c", script], check=False, capture_output=True, text=True)
    assert done.returncode == -9, done.stderr
    with open_store(path).writing():
        pass


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_folders_that_cannot_be_written_are_refused(tmp_path):
    folder = tmp_path / "sealed"
    folder.mkdir(mode=0o500)
    with pytest.raises(PermissionError, match="sealed"):
        open_store(folder / "a.prt")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_finished_stores_can_be_read_where_nothing_can_be_written(path):
    for each in [path, *path.rglob("*")]:
        pathlib.Path(each).chmod(0o500 if each.is_dir() else 0o400)
    try:
        assert found(path) == list(range(BLOCKS))
    finally:
        for each in [path, *path.rglob("*")]:
            pathlib.Path(each).chmod(0o700 if each.is_dir() else 0o600)


def test_sketches_are_as_far_apart_as_the_arrays_and_tell_where_values_are(monkeypatch):
    monkeypatch.setattr(arrays, "_PART", 64)
    random = np.random.default_rng(0)
    value = random.normal(size=(30, 50))
    first = arrays.sketch(value)
    np.testing.assert_allclose(first[:2], [1e-3, np.linalg.norm(value)])
    for scale in (1e-3, 1.0):
        change = scale * random.normal(size=value.shape)
        distance = np.linalg.norm(np.subtract(arrays.sketch(value + change)[2:], first[2:]))
        assert 0.6 < distance / np.linalg.norm(change) < 1.5
    for other in (value[::-1], value.T, -value, np.roll(value, 64)):
        assert np.linalg.norm(np.subtract(arrays.sketch(other), first)) > 0.5 * first[1]
    assert arrays.sketch(np.zeros((0, 3)), tolerance=1e-6)[:2] == [1e-6, 0]


def test_stores_compare_sketches_up_to_rounding_and_headers_by_the_version_of_their_algorithm(tmp_path):
    header, value = {"algorithm": {"test": 1}}, np.linspace(0, 1, 99, dtype=np.float32)
    path, near = tmp_path / "a.prt", {"brdf": arrays.sketch(value)}
    open_store(path, header=header, near=near)
    open_store(path, header=header, near={"brdf": arrays.sketch(np.nextafter(value, 2))})
    for wrong in (1.01 * value, np.full(99, np.nan, np.float32)):
        with pytest.raises(ValueError, match=r"computed from other inputs \(brdf: stored and given values differ by"):
            open_store(path, header=header, near={"brdf": arrays.sketch(wrong)})
    with pytest.raises(ValueError, match=r"must have sketches of \[\], got \['brdf'\]"):
        open_store(path, header=header)
    with pytest.raises(
        ValueError, match=r"was made by version {'test': 1} of the algorithm, this package has version {'test': 2}"
    ):
        open_store(path, header={"algorithm": {"test": 2}}, near=near)


@pytest.mark.parametrize("damaged", [None, 3, ["brdf"], {"brdf": None}, {"brdf": [0.1]}, {"brdf": ["x"] * 66}])
def test_damaged_sketches_are_told(tmp_path, damaged):
    path, near = tmp_path / "a.prt", {"brdf": arrays.sketch(np.ones(9))}
    open_store(path, header={}, near=near)
    file = path / arrays._HEADER
    file.write_text(json.dumps(json.loads(file.read_text()) | {"near": damaged}))
    with pytest.raises(ValueError, match=r"a\.prt is damaged: .* must have"):
        open_store(path, header={}, near=near)


WRONG_HEADERS = {
    "cut off": lambda text: text[: len(text) // 2],
    "empty": lambda text: "",
    "nested": lambda text: "[" * 100_000,
    "a list": lambda text: "[1]",
    "a number": lambda text: "1" * 5000,
    "no key": lambda text: json.dumps({k: v for k, v in json.loads(text).items() if k != "key"}),
    "another key": lambda text: json.dumps(json.loads(text) | {"key": ["../.."]}),
    "no shapes": lambda text: json.dumps({k: v for k, v in json.loads(text).items() if k != "shapes"}),
    "other shapes": lambda text: json.dumps(json.loads(text) | {"shapes": {"index": [10**30, None]}}),
    "no version": lambda text: json.dumps({k: v for k, v in json.loads(text).items() if k != "version"}),
    "a number in place of sketches": lambda text: json.dumps(json.loads(text) | {"near": 10**400}),
}


@pytest.mark.parametrize("case", WRONG_HEADERS)
def test_damaged_headers_are_refused_and_nothing_is_lost(path, case):
    header = path / "store.json"
    text = header.read_text()
    header.write_text(WRONG_HEADERS[case](text))
    with pytest.raises(ValueError, match=r"a\.prt (exists but is not|is damaged|holds arrays|has format version)"):
        open_store(path)
    header.write_text(text)
    assert found(path) == list(range(BLOCKS))


@pytest.mark.parametrize("name", ["store.json", "index.npy", "checksum.npy", ".lock.1-of-1"])
def test_pipes_and_links_in_place_of_the_files_of_a_store_are_refused(path, tmp_path, name):
    outside = tmp_path / "outside"
    outside.write_bytes((path / name).read_bytes() if (path / name).exists() else b"mine")
    content = outside.read_bytes()
    for kind, make in (("link", lambda file: file.symlink_to(outside)), ("special file", os.mkfifo)):
        (path / name).unlink(missing_ok=True)
        make(path / name)
        with pytest.raises(ValueError, match=rf"a\.prt exists but is not a readable store.*got a {kind}"):
            open_store(path)
    assert outside.read_bytes() == content
