"""Checks that built pages load nothing from a network: `python docs/offline.py build/docs`."""

import html.parser
import pathlib
import re
import sys

# What a browser fetches without a click.
_LOADING = {"audio", "embed", "iframe", "img", "input", "object", "script", "source", "track", "video"}
_STYLE = re.compile(r"""(?:url\(\s*|@import\s+)["']?((?:https?:)?//[^"')\s]+)""")
_REMOTE = re.compile(r"\s*(?:https?:)?//")


class _Finder(html.parser.HTMLParser):
    def __init__(self):
        super().__init__()
        self.found: list[str] = []
        self.inside = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.inside = tag
        names = ["src", "data", "poster"] if tag in _LOADING else []
        if tag == "link" and not {"canonical", "alternate", "license", "author"} & set(given.get("rel", "").split()):
            names = ["href"]
        self.found += [given[name] for name in names if _REMOTE.match(given.get(name, ""))]
        for each in given.get("srcset", "").split(","):
            self.found += [each.split()[0]] if _REMOTE.match(each) else []
        self.found += _STYLE.findall(given.get("style", ""))

    def handle_endtag(self, tag: str) -> None:
        self.inside = ""

    def handle_data(self, data: str) -> None:
        if self.inside == "style":
            self.found += _STYLE.findall(data)


def remote(text: str, *, style: bool = False) -> list[str]:
    """Addresses that a page, or a style sheet, loads from elsewhere."""
    if style:
        return _STYLE.findall(text)
    finder = _Finder()
    finder.feed(text)
    return finder.found


def main(folder: pathlib.Path) -> int:
    """Names each page with what it loads; the number of these."""
    pages = [*sorted(folder.rglob("*.html")), *sorted(folder.rglob("*.css"))]
    if not pages:
        print(f"{folder} holds no page", file=sys.stderr)
        return 1
    found = [
        (path, address)
        for path in pages
        for address in remote(path.read_text(errors="replace"), style=path.suffix == ".css")
    ]
    for path, address in found:
        print(f"{path} loads {address}", file=sys.stderr)
    print(f"{len(pages)} pages and style sheets, {len(found)} addresses of a network")
    return len(found)


if __name__ == "__main__":
    sys.exit(min(main(pathlib.Path(sys.argv[1])), 1))
