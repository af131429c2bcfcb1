"""Executes notebooks in place: `python notebooks/execute.py NOTEBOOK...`.

A saved viewer keeps its picture alone: without a kernel there is no widget to show, and JupyterLab would print an error
instead.
"""

import pathlib
import sys

import nbformat
from nbclient import NotebookClient

_WIDGET = "application/vnd.jupyter.widget-view+json"


def execute(path: pathlib.Path) -> None:
    """Runs all cells in a new kernel, in the notebook's folder, and saves what they show."""
    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(
        notebook,
        kernel_name="python3",
        store_widget_state=False,
        record_timing=False,
        resources={"metadata": {"path": path.parent}},
    )
    client.execute()
    for cell in notebook.cells:
        for output in cell.get("outputs", []):
            output.get("data", {}).pop(_WIDGET, None)
    nbformat.write(notebook, path)


if __name__ == "__main__":
    for name in sys.argv[1:]:
        execute(pathlib.Path(name))
