"""The viewer's module for browsers, joined from its files."""

import functools
import pathlib
import re

FOLDER = pathlib.Path(__file__).parent
# Each file imports from files before it.
_FILES = (
    "common",
    "camera",
    "state",
    "shading",
    "harmonics",
    "lights",
    "pixels",
    "drawing",
    "files",
    "panel",
    "gestures",
    "style",
    "saving",
    "frame",
    "piece",
    "answers",
    "waiting",
    "picking",
    "gpu",
    "colors",
    "rests",
    "scenes",
    "viewer",
    "widget",
)


@functools.cache
def module() -> str:
    """One module of JavaScript with all files, because notebooks load a widget's module from a single text.

    Imports between the files are dropped: their names are those of one scope.
    """
    texts = [(FOLDER / f"{name}.js").read_text("utf-8") for name in _FILES]
    return "\n".join(re.sub(r"^import [^;]*;\n", "", text, flags=re.MULTILINE) for text in texts)
