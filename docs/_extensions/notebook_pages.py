"""The notebooks as pages: copied from `notebooks/` into the documentation, and links to them led there."""

import pathlib
import re

from sphinx.application import Sphinx

_LINK = re.compile(r"(\]\((?:\.\./)*)\.\./notebooks/([^)\s]+\.ipynb)")


def _copy(app: Sphinx) -> None:
    source, target = pathlib.Path(app.srcdir).parent / "notebooks", pathlib.Path(app.srcdir) / "notebooks"
    target.mkdir(exist_ok=True)
    wanted = {path.name: path.read_bytes() for path in sorted(source.glob("*.ipynb"))}
    for old in target.glob("*.ipynb"):
        if old.name not in wanted:
            old.unlink()
    for name, data in wanted.items():
        if not (target / name).exists() or (target / name).read_bytes() != data:
            (target / name).write_bytes(data)


def _lead(app: Sphinx, page: str, source: list[str]) -> None:
    """`../notebooks/x.ipynb`, right in the repository, is `notebooks/x.ipynb` within the documentation."""
    if not page.startswith("notebooks/"):
        source[0] = _LINK.sub(r"\1notebooks/\2", source[0])


def setup(app: Sphinx) -> dict:
    """Copies before pages are looked for."""
    app.connect("builder-inited", _copy)
    app.connect("source-read", _lead)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
