"""Files that are written: complete, or not at all."""

import os
import pathlib
import stat
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt.files import outputs, pixels, read_image, write_exr, write_png
from tests.files.samples import encode_srgb, random_image


def test_the_new_file_replaces_the_old_one_at_the_end(tmp_path):
    path = tmp_path / "page.html"
    path.write_text("old")
    with outputs.replacing(path) as new:
        assert new.parent == tmp_path
        assert new.suffix == ".html"
        new.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def half_write(path, error):
    with outputs.replacing(path) as new:
        new.write_text("half a page")
        raise error


@pytest.mark.parametrize("error", [ValueError, OSError, KeyboardInterrupt])
def test_after_an_error_the_old_file_is_as_it_was_and_the_new_one_is_gone(tmp_path, error):
    path = tmp_path / "page.html"
    for old in (None, "old"):
        if old:
            path.write_text(old)
        with pytest.raises(error):
            half_write(path, error)
        assert [file.read_text() for file in tmp_path.iterdir()] == ([old] if old else [])


def test_bytes_and_text_are_written_as_they_are(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for content, stored in ((b"a\r\n\0", b"a\r\n\0"), ("é\n", b"\xc3\xa9\n"), (b"", b"")):
        outputs.write("file", content)
        assert (tmp_path / "file").read_bytes() == stored


def test_permissions_and_links_stay(tmp_path):
    (tmp_path / "folder").mkdir()
    target, link = tmp_path / "folder" / "file", tmp_path / "link"
    link.symlink_to(target)
    outputs.write(link, "first")  # The target is new.
    target.chmod(0o640)
    outputs.write(link, "second")
    assert link.is_symlink()
    assert target.read_text() == "second"
    assert stat.S_IMODE(target.stat().st_mode) == 0o640
    umask = os.umask(0o027)
    try:
        outputs.write(tmp_path / "new", "")
    finally:
        os.umask(umask)
    assert stat.S_IMODE((tmp_path / "new").stat().st_mode) == 0o640


def test_long_names_are_written(tmp_path):
    for name in ("a" * 255, "a." + "b" * 253):
        outputs.write(tmp_path / name, "text")
        assert (tmp_path / name).read_text() == "text"
    with pytest.raises(OSError, match="cannot be written: File name too long"):
        outputs.write(tmp_path / ("a" * 256), "text")


def test_files_that_cannot_be_replaced_are_refused_by_name(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"missing/page: there is no folder"):
        outputs.write(tmp_path / "missing" / "page", "")
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="file/page cannot be written: Not a directory"):
        outputs.write(tmp_path / "file" / "page", "")
    with pytest.raises(IsADirectoryError, match="must be a file, got a directory"):
        outputs.write(tmp_path, "")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OSError, match="pipe must be a regular file, got a pipe"):
        outputs.write(tmp_path / "pipe", "")


def test_read_only_files_and_folders_are_refused(tmp_path, monkeypatch):
    path = tmp_path / "file"
    path.write_text("old")
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # A superuser may write everywhere.
    with pytest.raises(PermissionError, match="file cannot be written: it is read-only"):
        outputs.write(path, "new")
    assert path.read_text() == "old"
    monkeypatch.undo()

    def refused(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(type(path), "open", refused)
    with pytest.raises(PermissionError, match="file cannot be written: Permission denied"):
        outputs.write(path, "new")


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_disk_that_is_full_only_at_the_end_leaves_the_old_file(tmp_path, monkeypatch, call):
    path = tmp_path / "file"
    path.write_text("old")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(*((os, "fsync") if call == "fsync" else (type(path), "replace")), full)
    with pytest.raises(OSError, match="file cannot be written: No space left on device") as error:
        outputs.write(path, "new")
    assert error.value.errno == 28
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_exr_of_arrays_that_are_not_contiguous_or_not_numpy_is_written_rightly(tmp_path):
    image = random_image(6, 8, 3)
    for i, view in enumerate((image.transpose(1, 0, 2), image[::-1, ::2], image[..., ::-1], jnp.asarray(image))):
        write_exr(tmp_path / f"{i}.exr", view)
        np.testing.assert_array_equal(read_image(tmp_path / f"{i}.exr")[0], view)


def test_png_holds_the_display_values_clamped_and_rounded(tmp_path):
    image = np.linspace(-0.5, 1.5, 60, dtype=np.float32).reshape(4, 5, 3)
    write_png(tmp_path / "image.png", image)
    expected = np.round(np.clip(image, 0, 1) * 255)
    np.testing.assert_allclose(encode_srgb(read_image(tmp_path / "image.png")[0]) * 255, expected, atol=1e-3)


@pytest.mark.usefixtures("unchecked")
def test_unwritable_images_are_refused(tmp_path):
    for write, suffix in ((write_exr, "exr"), (write_png, "png")):
        path = tmp_path / f"image.{suffix}"
        with pytest.raises(ValueError, match=r"image must be of floating point, with 1 for white .*, got uint8"):
            write(path, np.full((4, 4, 3), 255, np.uint8))
        with pytest.raises(ValueError, match=r"\(4, 4, 2\)"):
            write(path, random_image(4, 4, 2))
        with pytest.raises(ValueError, match=r"\(0, 4, 3\)"):
            write(path, random_image(0, 4, 3))
        with pytest.raises(FileNotFoundError, match="no folder"):
            write(tmp_path / "missing" / path.name, random_image(4, 4, 3))
    image = random_image(4, 4, 3)
    image[1, 2, 0] = np.nan
    with pytest.raises(ValueError, match=r"1 such pixels, first at \(1, 2\)"):
        write_png(tmp_path / "image.png", image)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("write", "suffix"), [(write_exr, ".exr"), (write_png, ".png")])
def test_names_of_other_formats_are_refused(tmp_path, write, suffix):
    for name in ("image.jpg", "image", "image.", f"{suffix}", f"image{suffix}.gz", "image.hdr"):
        with pytest.raises(ValueError, match=rf"path must end in \{suffix}, .* got '.*{name}'"):
            write(tmp_path / name, random_image(2, 2, 3))
    assert not list(tmp_path.iterdir())
    write(tmp_path / f"image{suffix.upper()}", random_image(2, 2, 3))
    write(str(tmp_path / f"a.b{suffix}"), random_image(2, 2, 3))


FULL = """
import resource, signal, sys
import numpy as np
from jaxprt.files import write_exr, write_png
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
write = {".exr": write_exr, ".png": write_png}[sys.argv[1][-4:]]
for limit in map(int, sys.argv[2:]):
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
    try:
        write(sys.argv[1], np.random.default_rng(1).random((90, 80, 3)).astype(np.float32))
    except OSError as error:
        print(limit, type(error).__name__, error)
    else:
        print(limit, "written")
"""


@pytest.mark.parametrize(("write", "suffix"), [(write_exr, ".exr"), (write_png, ".png")])
def test_a_full_disk_raises_an_os_error_and_leaves_the_old_file(tmp_path, write, suffix):
    path, whole = tmp_path / f"image{suffix}", tmp_path / f"whole{suffix}"
    write(path, random_image(4, 5, 3))
    old = path.read_bytes()
    write(whole, random_image(90, 80, 3, seed=1))
    size = whole.stat().st_size
    # Nothing fits; the header does; half does; all but the last bytes do; everything does.
    limits = [0, 100, size // 2, size - 1, size]
    command = [sys.executable, "-c", FULL, str(path), *map(str, limits[:-1])]
    lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
    assert len(lines) == 4
    for limit, line in zip(limits, lines, strict=False):
        assert line.startswith((f"{limit} OSError", f"{limit} PermissionError")), line
        assert f"{path} cannot be written" in line
    assert path.read_bytes() == old
    assert sorted(tmp_path.iterdir()) == [path, whole]
    write(path, random_image(90, 80, 3, seed=1))
    np.testing.assert_array_equal(read_image(path)[0], read_image(whole)[0])


@pytest.mark.parametrize(("write", "suffix"), [(write_exr, ".exr"), (write_png, ".png")])
def test_a_file_that_does_not_hold_what_was_written_is_not_accepted(tmp_path, monkeypatch, write, suffix):
    path = tmp_path / f"image{suffix}"
    write(path, random_image(4, 5, 3))
    old, compare = path.read_bytes(), outputs._compare

    def damaged(change):
        def check(new, *values, **names):
            new.write_bytes(change(new.read_bytes()))
            compare(new, *values, **names)

        return check

    other = tmp_path / f"other{suffix}"
    write(other, random_image(90, 80, 3, seed=2))
    changes = [lambda data: b"", lambda data: data[:-1], lambda data: data[: len(data) // 2]]
    changes += [lambda data: data[:3000] + bytes(500) + data[3500:], lambda data: other.read_bytes()]
    for change in changes:
        monkeypatch.setattr(outputs, "_compare", damaged(change))
        with pytest.raises(OSError, match=rf"image{suffix} cannot be written: the file is incomplete"):
            write(path, random_image(90, 80, 3))
        assert path.read_bytes() == old
    assert sorted(tmp_path.iterdir()) == [path, other]


def test_what_is_not_finite_and_large_images_are_written_in_blocks(tmp_path, monkeypatch):
    monkeypatch.setattr(pixels, "_VALUES", 1)
    image = random_image(50, 20, 3)
    image[3, 4], image[40, 2] = [np.nan, np.inf, -np.inf], [-1.0, 1e38, 1e-40]
    write_exr(tmp_path / "image.exr", image)
    np.testing.assert_array_equal(read_image(tmp_path / "image.exr")[0], image)
    for channels in (1, 3, 4):
        write_png(tmp_path / "image.png", random_image(50, 20, channels))


@pytest.mark.parametrize(("write", "suffix"), [(write_exr, ".exr"), (write_png, ".png")])
def test_directories_pipes_and_devices_are_not_replaced(tmp_path, write, suffix):
    image = random_image(4, 5, 3)
    for name in ("folder", "pipe", "full", "circle"):
        path = tmp_path / f"{name}{suffix}"
        if name == "folder":
            path.mkdir()
        elif name == "pipe":
            os.mkfifo(path)
        elif name == "full":
            path.symlink_to("/dev/full")
        else:
            path.symlink_to(path)
        with pytest.raises(OSError, match=rf"{name}{suffix} (must be a|cannot be written)"):
            write(path, image)
    assert pathlib.Path("/dev/full").is_char_device()
    assert len(list(tmp_path.iterdir())) == 4
