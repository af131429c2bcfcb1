"""Executes notebooks in place: `python notebooks/execute.py NOTEBOOK...`.

A saved viewer keeps its picture alone, and that once.
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
        if "outputs" in cell:
            cell.outputs = [output for output in cell.outputs if _WIDGET not in output.get("data", {})]
        for output in cell.get("outputs", []):
            if "jaxprt-picture" in output.get("data", {}).get("text/html", ""):
                del output["data"]["text/html"]
    nbformat.write(notebook, path)


if __name__ == "__main__":
    for name in sys.argv[1:]:
        execute(pathlib.Path(name))
