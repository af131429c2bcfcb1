"""The notebooks: readable as committed, without running; and every cell runs, at the small size of the tests."""

import gc
import json
import linecache
import pathlib
import re
import sys

import matplotlib
import matplotlib.pyplot as plt
import pytest

from jaxprt import bounces

pytestmark = pytest.mark.documents

FOLDER = pathlib.Path(__file__).parent.parent / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
LARGEST = 2_000_000  # bytes
# A folder of some machine: a home, a temporary or an installed one, on POSIX or Windows.
MACHINE = re.compile(r"(?<![\w.])/(?:home|root|Users|tmp|var|opt|usr|mnt|work|private)/|site-packages|[A-Z]:\\")


def _cells(path: pathlib.Path) -> list[dict]:
    return json.loads(path.read_text())["cells"]


def _code(path: pathlib.Path) -> list[dict]:
    return [cell for cell in _cells(path) if cell["cell_type"] == "code"]


def _texts(value: object) -> list[str]:
    """All strings in a JSON value, keys and pictures excepted; lists of lines are joined."""
    if isinstance(value, str):
        return [value]
    if isinstance(value, list) and all(isinstance(each, str) for each in value):
        return ["".join(value)]
    if isinstance(value, dict):
        return [text for key, each in value.items() if not key.startswith("image/") for text in _texts(each)]
    return [text for each in value for text in _texts(each)] if isinstance(value, list) else []


@pytest.fixture
def small(coarse, bound, unchecked, monkeypatch):
    """The small size, the folder and the drawing of a notebook that runs in this process."""
    monkeypatch.setenv("JAXPRT_NOTEBOOKS", "small")
    monkeypatch.chdir(FOLDER)
    monkeypatch.setattr("sys.path", [*sys.path])
    monkeypatch.setattr(plt, "show", lambda: None)
    bound(monkeypatch, bounces.precompute, edge=2, components=8, modes=8)
    with matplotlib.rc_context({"backend": "agg"}):
        yield
    gc.collect()  # Its temporary folders warn when they go, here rather than in another test.


def execute(path: pathlib.Path) -> None:
    """Runs the code cells in order, as a kernel does; an error is told with its cell. Lines of magics are left out."""
    namespace = {"__name__": "__main__"}
    for number, cell in enumerate(_code(path), 1):
        source = "".join("\n" if line.startswith("%") else line for line in cell["source"])
        place = f"{path.name}, cell {number}"
        # Tracebacks show the line.
        linecache.cache[place] = (len(source), None, source.splitlines(keepends=True), place)
        try:
            exec(compile(source, place, "exec"), namespace)
        except Exception as error:
            error.add_note(f"in {place}")
            raise
        finally:
            plt.close("all")


# The size may cause warnings. The outputs of full size hold none.
@pytest.mark.filterwarnings("default", "ignore:Implicitly cleaning up:ResourceWarning")  # the folders of a notebook
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_every_cell_of_a_notebook_runs(path, small):
    execute(path)


def test_a_cell_that_fails_is_named(tmp_path):
    cells = [["first = 1\n"], ["%config InlineBackend.figure_formats = []\n", "first / 0"]]
    written = {"cells": [{"cell_type": "code", "source": source} for source in cells]}
    (tmp_path / "broken.ipynb").write_text(json.dumps(written))
    with pytest.raises(ZeroDivisionError) as caught:
        execute(tmp_path / "broken.ipynb")
    assert caught.value.__notes__ == ["in broken.ipynb, cell 2"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_a_notebook_is_small_and_readable_without_a_kernel_as_it_is_committed(path):
    """A notebook ran once from the top. It shows pictures, and no errors, warnings, widgets or folders of a machine."""
    assert path.stat().st_size <= LARGEST
    notebook, code = json.loads(path.read_text()), _code(path)
    assert notebook["metadata"]["kernelspec"]["name"] == "python3"
    assert "widgets" not in notebook["metadata"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    outputs = [output for cell in code for output in cell["outputs"]]
    assert not [output for output in outputs if output["output_type"] == "error" or output.get("name") == "stderr"]
    shown = [kind for output in outputs for kind in output.get("data", {})]
    assert "image/jpeg" in shown
    assert not [kind for kind in shown if "widget" in kind]
    assert not [match.group() for text in _texts(notebook) for match in MACHINE.finditer(text)]


@pytest.mark.parametrize(
    "text", ["/home/a/b.py", "at /tmp/x", "File /root/.pyenv/lib", r"C:\\Users", "x/site-packages/y"]
)
def test_folders_of_a_machine_are_recognized(text):
    assert MACHINE.search(text)


@pytest.mark.parametrize("text", ["output/demo", "5 / 6", "notebooks/01.ipynb", "https://example.org/home/page"])
def test_other_paths_are_not(text):
    assert not MACHINE.search(text)
