"""The API reference: one page for each public module, written from what the package exports."""

import importlib
import inspect
import pathlib
import pkgutil
import re
import types
from collections.abc import Iterator

from sphinx.application import Sphinx

import jaxprt

# Users reach these by the command `python -m jaxprt`, or not at all.
_HIDDEN = {"jaxprt.__main__", "jaxprt.cli", "jaxprt.public", "jaxprt.compile", "jaxprt.require"}
_CODE = re.compile(r"(``.+?``|`[^`]+`)")
_SPECIAL = re.compile(r"[*|]|_(?=\W|$)")


def modules() -> dict[str, types.ModuleType]:
    """All modules by the names that users write: `jaxprt.lobe` for `jaxprt.systems.lobe`."""
    names = [each.name for each in pkgutil.walk_packages(jaxprt.__path__, "jaxprt.")]
    found = {"jaxprt": jaxprt}
    for name in names:
        if any(name == hidden or name.startswith(hidden + ".") for hidden in _HIDDEN) or "._" in name:
            continue
        module = importlib.import_module(name)
        short = name.replace("jaxprt.systems.", "jaxprt.")
        head = short.split(".")[1]
        found[short if hasattr(jaxprt, head) else name] = module
    found.pop("jaxprt.systems", None)
    return found


def members(module: types.ModuleType) -> list[str]:
    """The public functions and classes of a module, in the order of its source."""
    listed = getattr(module, "__all__", None)
    names = [name for name in vars(module) if not name.startswith("_")] if listed is None else listed
    found = []
    for name in names:
        value = getattr(module, name)
        known = inspect.isclass(value) or inspect.isroutine(value) or hasattr(value, "__wrapped__")
        if known and (listed is not None or getattr(value, "__module__", None) == module.__name__):
            found.append(name)
    return found


def pages() -> dict[str, str]:
    """The text of each page by its path. Pages of packages list those of their modules, in a folder of their name."""
    found = dict(_pages())
    path = {}
    for name in found:
        outer = [each for each in found if name.startswith(f"{each}.") and each != "jaxprt"]
        short = name.removeprefix("jaxprt.")
        if outer:
            first = min(outer, key=len).removeprefix("jaxprt.")
            short = f"{first}/{short.removeprefix(f'{first}.')}"
        path[name] = short
    for name in found:
        inner = sorted(each for each in path.values() if each.startswith(f"{path[name]}/"))
        if inner:
            found[name] += "\n.. toctree::\n   :maxdepth: 1\n\n" + "".join(f"   /reference/{each}\n" for each in inner)
    return {path[name]: text for name, text in found.items()}


def _pages() -> Iterator[tuple[str, str]]:
    """An object stands at the first of its names, the shortest."""
    seen: set[int] = set()
    everything = modules()
    for name in sorted(everything, key=lambda each: (each.count("."), each)):
        module = everything[name]
        lines = [f"{name}", "=" * len(name), "", *plain(inspect.cleandoc(module.__doc__ or "").splitlines()), ""]
        shown = 0
        for member in members(module):
            value = getattr(module, member)
            if id(value) in seen or not getattr(value, "__doc__", None):
                continue
            seen.add(id(value))
            shown += 1
            kind = "autoclass" if inspect.isclass(value) else "autofunction"
            lines += [f".. {kind}:: {name}.{member}"]
            lines += ["   :members:", ""] if kind == "autoclass" else [""]
        if shown:
            yield name, "\n".join(lines)


def _write(app: Sphinx) -> None:
    folder = pathlib.Path(app.srcdir) / "reference"
    wanted = {folder / f"{name}.rst": text for name, text in pages().items()}
    for old in folder.rglob("*.rst"):
        if old not in wanted:
            old.unlink()
    for path, text in wanted.items():
        path.parent.mkdir(exist_ok=True)
        if not path.exists() or path.read_text() != text:
            path.write_text(text)


def plain(lines: list[str]) -> list[str]:
    """Docstrings are plain text with backticks: other than in code, bars, stars and underscores are no markup."""
    code = None  # the indentation of the line that a literal block follows
    written = []
    for line in lines:
        indent = len(line) - len(line.lstrip())
        if code is not None and line.strip() and indent <= code:
            code = None
        if code is None and not line.lstrip().startswith((">>>", "...")):
            line = "".join(_SPECIAL.sub(r"\\\g<0>", x) if x[:1] != "`" else x for x in _CODE.split(line))
            line = re.sub(r"^(\s*)\\\* ", r"\1* ", line)  # of a list
            code = indent if line.rstrip().endswith("::") else None
        written.append(line)
    return written


def _escape(app: Sphinx, what: str, name: str, value: object, options: dict, lines: list[str]) -> None:
    lines[:] = plain(lines)


def _skip(app: Sphinx, what: str, name: str, value: object, skip: bool, options: dict) -> bool | None:
    """Fields of named tuples stand among the attributes of their class already."""
    return True if (getattr(value, "__doc__", None) or "").startswith("Alias for field number") else None


def setup(app: Sphinx) -> dict:
    """Writes before pages are looked for."""
    app.connect("builder-inited", _write)
    app.connect("autodoc-process-docstring", _escape, priority=400)  # before Napoleon
    app.connect("autodoc-skip-member", _skip)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
