"""README and the pages of docs/: every block of Python runs, and every link and anchor within the repository is there.

Blocks marked `python` run in order, page by page, in one namespace and one folder. The folder holds small files of
the names in `FILES`. Lights, maps and tables are bound to small sizes; the code that runs is the same.
"""

import collections
import gc
import importlib
import json
import linecache
import os
import pathlib
import re
import sys
from collections.abc import Iterator

import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
import trimesh

import jaxprt as prt
from jaxprt.files import extensions
from jaxprt.relit import Clusters, Harmonics, recipes, registry
from jaxprt.scene.formats import gltf_file, nerf

pytestmark = pytest.mark.documents

ROOT = pathlib.Path(__file__).parents[1]
DOCS = ROOT / "docs"
# The other folders hold what is written when the pages are built.
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"]
PAGES += [page for page in sorted(DOCS.rglob("*.md")) if page.relative_to(DOCS).parts[0] not in ("notebooks", "_build")]
FILES = ("scene.glb", "mesh.ply", "mesh.obj", "light.hdr", "light.exr", "sky.hdr", "measured.brdf", "photograph.exr")
FILES += ("transforms.json",)
MOST_LINES_OF_README = 150
each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))

_FENCE = re.compile(r"^(?P<fence>`{3,}|:{3,}|~{3,})(?P<kind>.*)$")
_LINK = re.compile(r"!?\[(?:[^\[\]]|\[[^\]]*\])*\]\(\s*<?([^)\s>]+)>?(?:\s+\"[^\"]*\")?\s*\)")
_DRAWN = re.compile(r"^[`:]{3,}\{(?:figure|image|literalinclude|include|download)\}\s+(\S+)", re.MULTILINE)
MERL_SCALE = np.array([[1.0], [1.15], [1.66]])  # of red, green and blue in files of the database, over 1500
SIZE = 16  # texels along a face of all lights and transports


def blocks(text: str) -> list[tuple[int, str, str]]:
    """The first line, the kind and the source of each fenced block."""
    found, opened = [], None
    for number, line in enumerate(text.splitlines(), 1):
        match = _FENCE.match(line)
        if opened is None and match:
            opened = (match["fence"], number + 1, match["kind"].strip(), [])
        elif opened is not None and match and match["fence"].startswith(opened[0]) and not match["kind"].strip():
            found.append((opened[1], opened[2], "\n".join(opened[3]) + "\n"))
            opened = None
        elif opened is not None:
            opened[3].append(line)
    return found


def prose(text: str) -> str:
    """A page without its blocks of code and without code within lines. Directives keep their content."""
    lines, code, depth = [], None, 0
    for line in text.splitlines():
        match = _FENCE.match(line)
        if code is not None:
            if match and match["fence"].startswith(code) and not match["kind"].strip():
                code = None
        elif match and match["fence"][0] != ":" and not match["kind"].strip().startswith("{"):
            if match["kind"].strip() or not depth:
                code = match["fence"]
            else:
                depth -= 1
        else:
            depth += bool(match and match["kind"].strip().startswith("{") and match["fence"][0] != ":")
            lines.append(line)
    return re.sub(r"(`+)(?!`).+?(?<!`)\1(?!`)", "", "\n".join(lines))


def anchors(text: str) -> set[str]:
    """The anchors of a page: of its headings, as GitHub and MyST make them, and of its labels."""
    found: set[str] = set(re.findall(r"^\((\S+)\)=$", text, re.MULTILINE))
    counts = collections.Counter[str]()
    body = re.sub(r"^(`{3,}).*?^\1\s*$", "", text, flags=re.MULTILINE | re.DOTALL)
    for title in re.findall(r"^#{1,6}\s+(.+?)\s*#*$", body, re.MULTILINE):
        title = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", title).replace("`", "")
        slug = re.sub(r"[^\w\- ]", "", title.strip().lower()).replace(" ", "-")
        found.add(f"{slug}-{counts[slug]}" if counts[slug] else slug)
        counts[slug] += 1
    return found


def links(text: str) -> list[str]:
    """Targets of links and pictures within the repository."""
    found = _LINK.findall(prose(text)) + _DRAWN.findall(text)
    return [each for each in found if not re.match(r"[a-z][a-z+.-]*:", each)]


@pytest.fixture(scope="module", autouse=True)
def small(coarse: None, bound) -> Iterator[None]:
    """Small lights, maps and tables, and plans of few candidates, for the blocks of all pages alike."""
    planning = importlib.import_module("jaxprt.relit.planning")
    measuring = importlib.import_module("jaxprt.relit.measuring")
    sampling = importlib.import_module("jaxprt.relit.sampling")
    views = measuring.views_around
    with pytest.MonkeyPatch.context() as patch:
        for function in _with_size():
            bound(patch, function, size=SIZE)
        for function, limits in (
            (prt.separable.factor, {"resolution": 8, "terms": 8}),
            (prt.harmonic.tabulate, {"resolution": 8, "error": 1.0}),
            (prt.lobe.tabulate, {"resolution": 8, "lobes": 4}),
            (prt.dynamic.tabulate, {"resolution": 8}),
            (prt.dynamic.compress, {"components": 8, "modes": 16, "keep": 64}),
            (prt.scene.mesh.ground_plane, {"vertices": 100}),
            (prt.bounces.precompute, {"edge": 2, "components": 8, "modes": 8}),
        ):
            bound(patch, function, **limits)
        patch.setattr(recipes, "_CLUSTERS", tuple(Clusters(step.terms, 12) for step in recipes._CLUSTERS[:1]))
        patch.setattr(recipes, "_LOBES", recipes._LOBES[:2])
        patch.setattr(recipes, "_HARMONIC", (Harmonics(degree=2),))
        patch.setattr(measuring, "_PICTURE", 32)
        patch.setattr(measuring, "_PIXELS", 30)
        for module in (measuring, planning):
            patch.setattr(module, "views_around", lambda mesh: views(mesh)[1::3])
        for module in (measuring, sampling):
            patch.setattr(module, "POINTS", 200)
            patch.setattr(module, "FEWEST", 40)
        yield


def _with_size() -> list:
    systems = [prt.harmonic.precompute, prt.harmonic.precompute_diffuse, prt.lobe.precompute, prt.dynamic.precompute]
    systems += [prt.separable.precompute, prt.bounces.precompute]
    systems += [prt.visibility.precompute, prt.precompute]
    return [*systems, prt.load_environment, prt.scene.builtin.daylight, prt.scene.builtin.studio]


@pytest.fixture(scope="session")
def files(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """A folder of small files: a scene of two parts with a camera, a mesh, lights, a measured BRDF, a photograph."""
    folder = tmp_path_factory.mktemp("pages")
    ball = trimesh.creation.icosphere(subdivisions=2)
    ball.vertices *= [1.0, 1.2, 0.8]
    for suffix in ("ply", "obj"):
        ball.export(folder / f"mesh.{suffix}")
    _scene(ball).export(folder / "scene.glb", include_normals=True)
    for name, sun in (("light", [0.4, 0.5, 0.2]), ("sky", [-0.5, 0.7, 0.4])):
        _light(folder, name, np.array(sun))
    _measured(folder / "measured.brdf")
    mesh = prt.load_mesh(folder / "mesh.ply")
    system = prt.harmonic.DiffuseSystem(prt.harmonic.precompute_diffuse(mesh, size=8), jnp.full(3, 0.5))
    camera = prt.scene.camera.orbit(mesh, azimuth=0.5, elevation=0.3, width=64, height=64)
    light = prt.load_environment(folder / "light.exr", size=8)
    frames = nerf.content([camera], [{"file_path": "./0000_light.exr"}], [0])
    (folder / "transforms.json").write_text(json.dumps(frames))
    image = prt.image.render(mesh, prt.radiance(system, light, eye=camera.eye), camera)
    prt.files.write_exr(folder / "photograph.exr", np.asarray(image)[..., :3])
    assert sorted(path.name for path in folder.iterdir()) == sorted(FILES)
    return folder


def _scene(ball: trimesh.Trimesh) -> trimesh.Scene:
    ground = trimesh.creation.box([6.0, 0.1, 6.0]).subdivide().subdivide()
    ground.apply_translation([0.0, -1.25, 0.0])
    scene = trimesh.Scene()
    for name, geometry, color, metallic in (("ball", ball, [0.8, 0.5, 0.3], 1.0), ("ground", ground, [0.5] * 3, 0.0)):
        material = trimesh.visual.material.PBRMaterial(
            name=name, baseColorFactor=[*color, 1.0], metallicFactor=metallic, roughnessFactor=0.4
        )
        shown = trimesh.Trimesh(geometry.vertices, geometry.faces, process=False)
        shown.visual = trimesh.visual.TextureVisuals(uv=np.zeros((len(shown.vertices), 2)), material=material)
        assert len(shown.vertex_normals)  # so that they are written
        scene.add_geometry(shown, node_name=name, geom_name=name)
    scene.camera = trimesh.scene.cameras.Camera(name="camera", resolution=(96, 72), fov=(50.0, 38.0))
    scene.camera_transform = trimesh.transformations.translation_matrix([0.0, 0.3, 5.0])
    return scene


def _light(folder: pathlib.Path, name: str, sun: np.ndarray) -> None:
    """A blue sky with a soft sun over brown ground, of latitude and longitude."""
    height, width = 32, 64
    latitude = np.pi * (0.5 - (np.arange(height) + 0.5) / height)[:, None]
    longitude = np.pi * (1 - 2 * (np.arange(width) + 0.5) / width)[None]
    direction = [np.sin(longitude) * np.cos(latitude), np.sin(latitude) + 0 * longitude]
    direction = np.stack([*direction, np.cos(longitude) * np.cos(latitude)], axis=-1)
    image = np.where(direction[..., 1:2] > 0, [0.4, 0.5, 0.8], [0.2, 0.15, 0.1])
    image = image + 8 * np.exp(20 * (direction @ (sun / np.linalg.norm(sun)) - 1))[..., None]
    _write_hdr(folder / f"{name}.hdr", image)
    if name == "light":
        prt.files.write_exr(folder / "light.exr", image.astype(np.float32))


def _write_hdr(path: pathlib.Path, image: np.ndarray) -> None:
    """Radiance's format, without its run lengths."""
    mantissa, exponent = np.frexp(image.max(axis=-1))
    scale = mantissa * 256 / image.max(axis=-1)
    pixels = np.concatenate([image * scale[..., None], exponent[..., None] + 128], axis=-1).astype(np.uint8)
    head = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {image.shape[0]} +X {image.shape[1]}\n"
    path.write_bytes(head.encode() + pixels.tobytes())


def _measured(path: pathlib.Path) -> None:
    """A table in the form of MERL: a matte color, and a highlight that fades with the angle of the half vector."""
    shape = (90, 90, 180)
    half = (np.arange(shape[0]) / shape[0]) ** 2 * np.pi / 2
    value = 0.05 + np.exp(-((half / 0.3) ** 2))
    table = (value * np.array([[1.0], [0.8], [0.6]]) * 1500 / MERL_SCALE)[:, :, None, None]
    table = np.broadcast_to(table, (3, *shape))
    path.write_bytes(np.array(shape, "<i4").tobytes() + np.ascontiguousarray(table, "<f8").tobytes())


@pytest.fixture
def place(files: pathlib.Path, unchecked: None, tmp_path: pathlib.Path, monkeypatch) -> Iterator[pathlib.Path]:
    """A folder with the files, where blocks run as users run them; no browser opens, and no program waits for a key."""
    for name in FILES:
        os.link(files / name, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("JAXPRT_NOTEBOOKS", "small")
    monkeypatch.setattr("webbrowser.open", lambda *arguments, **options: True)
    monkeypatch.setattr(prt.view.Server, "wait", prt.view.Server.close)
    for module, name in ((registry, "SYSTEMS"), (registry, "MATERIALS"), (extensions, "CLASSES")):
        monkeypatch.setattr(module, name, dict(getattr(module, name)))  # What a page registers, no other page has.
    monkeypatch.setattr(plt, "show", lambda: None)
    with matplotlib.rc_context({"backend": "agg"}):
        yield tmp_path
    plt.close("all")
    gc.collect()


def run(page: pathlib.Path) -> int:
    """Runs the Python blocks of a page; an error is told with its line of the page. The number of blocks."""
    namespace = {"__name__": "__main__"}
    name = page.name
    sources = [(line, source) for line, kind, source in blocks(page.read_text()) if kind == "python"]
    for line, source in sources:
        padded = "\n" * (line - 1) + source  # Tracebacks show the page's line.
        linecache.cache[name] = (len(padded), None, padded.splitlines(keepends=True), name)
        try:
            exec(compile(padded, name, "exec"), namespace)
        except Exception as error:
            error.add_note(f"in the block at line {line} of {page}")
            raise
    for value in namespace.values():
        if isinstance(value, prt.view.Server):
            value.close()
    return len(sources)


@pytest.mark.filterwarnings("default")
@each_page
def test_every_block_of_a_page_runs(page, place):
    sys.path.insert(0, str(place))
    try:
        run(page)
    finally:
        sys.path.remove(str(place))


def test_a_block_that_fails_is_named_with_its_line(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# Title\n\n```python\nfirst = 1\n```\n\n```text\n1 / 0\n```\n\n```python\nfirst / 0\n```\n")
    with pytest.raises(ZeroDivisionError) as caught:
        run(page)
    assert caught.value.__notes__ == [f"in the block at line 12 of {page}"]
    assert caught.traceback[-1].lineno == 11


@each_page
def test_every_link_of_a_page_leads_somewhere(page):
    broken = []
    for target in links(page.read_text()):
        name, _, anchor = target.partition("#")
        path = (page.parent / name).resolve() if name else page
        there = path.exists() and (not anchor or path.suffix != ".md" or anchor in anchors(path.read_text()))
        broken += [] if there else [target]
    assert not broken


def test_broken_links_are_found_and_code_holds_none():
    text = "[a](b.md) `[no](no.md)` ![c](d.png)\n\n```python\n[no](no.md)\n```\n\n[e](https://example.org) [f](#g)\n"
    text += "\n```{figure} h.png\n[i](j.md)\n```\n\n[k](l.md#m-n)\n\n````{tab} x\n```python\n[no](no.md)\n```\n````\n"
    assert links(text) == ["b.md", "d.png", "#g", "j.md", "l.md#m-n", "h.png"]


def test_anchors_are_those_of_github():
    text = "# A title: `code`, 2 words\n\n(label)=\n\n## Same\n\n## Same\n\n"
    text += "```python\n# none\n```\n\n## [Link](x.md) & more\n"
    assert anchors(text) == {"a-title-code-2-words", "label", "same", "same-1", "link--more"}


def test_the_table_of_gltf_has_every_extension_that_is_read_and_says_so():
    rows = [line for line in (DOCS / "guides/gltf.md").read_text().splitlines() if line.startswith("| `")]
    stated = {}
    for row in rows:
        name, word = row.split("|")[1:3]
        stated |= dict.fromkeys(re.findall(r"`((?:KHR|EXT|MSFT)_\w+)`", name), word.strip())
    assert {name for name, word in stated.items() if word != "no"} == gltf_file.HONORED


def test_readme_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= MOST_LINES_OF_README


def test_pages_that_load_from_a_network_are_found(monkeypatch):
    monkeypatch.syspath_prepend(DOCS)
    remote = importlib.import_module("offline").remote
    page = """<a href="https://a.org">x</a><script src="//b.org/x.js"></script><link rel="stylesheet" href="http://c.org/y.css">
    <link rel="canonical" href="https://d.org"><img src="e.png"><img srcset="f.png 1x, https://g.org/h.png 2x">
    <style>@import "https://i.org/j.css"; p { background: url(k.png) }</style><script src="l.js"></script>"""
    assert remote(page) == ["//b.org/x.js", "http://c.org/y.css", "https://g.org/h.png", "https://i.org/j.css"]
    assert remote("@font-face { src: url('https://m.org/n.woff2') url(o.woff2) }", style=True) == [
        "https://m.org/n.woff2"
    ]
    assert not remote('<a href="https://a.org">https://a.org</a><img src="data:image/png;base64,xx">')
