import os
import stat

import pytest

from jaxprt.files import outputs


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
