"""The layer table of the design: who may import whom, and the few rules on what a module may do.

Rooms are folders; imports point down ``ROOMS``, never up. Inside a room, systems (files of the same name in each
room) build on the room's helpers and never on each other, except where ``SIDEWAYS`` says so.
"""

import ast
import itertools
import pathlib
import re
import sys
import tomllib
from collections.abc import Iterator

import pytest

ROOT = pathlib.Path(__file__).parents[1]
PACKAGE = ROOT / "jaxprt"

# From the top. A module may import from rooms further down.
ROOMS = ["__main__", "animation", "report", "inverse", "plan", "relight", "image", "transport", "brdf", "scene"]
ROOMS += ["linalg", "sphere", "files", "staging", "require"]
SYSTEMS = {"harmonic", "separable", "lobe", "dynamic", "direct", "reference"}

# Which module of a room may import which of the same room, besides systems their helpers; "*" is every room.
SIDEWAYS = {
    ("*", "dynamic", "lobe"),  # Sun's system is built on the lobes of its own section 4.1.
    ("*", "dynamic", "separable"),  # Its terms are separable ones, with view maps that change.
    ("brdf", "cylinders", "models"),
    ("brdf", "measured", "models"),
    ("brdf", "navigation", "models"),
    ("brdf", "paths", "dynamic"),
    ("brdf", "paths", "separable"),
    ("brdf", "published", "dynamic"),
    ("brdf", "published", "models"),
    ("brdf", "published", "separable"),
    ("brdf", "paths", "reflected"),
    ("brdf", "published", "reflected"),
    ("brdf", "reflected", "grid"),
    ("brdf", "reflected", "lobe"),
    ("brdf", "reflected", "lobe_em"),
    ("brdf", "scattered", "measured"),
    ("inverse", "fit", "numbers"),
    ("inverse", "fit", "pictures"),
    ("inverse", "fit", "solve"),
    ("inverse", "pictures", "numbers"),
    ("inverse", "solve", "numbers"),
    ("linalg", "clustering", "eigen"),
    ("linalg", "tucker", "eigen"),
    ("scene", "builtin", "environment"),
    ("scene", "builtin", "mesh"),
    ("scene", "builtin", "shapes"),
    ("scene", "camera", "mesh"),
    ("scene", "interiors", "builtin"),
    ("scene", "interiors", "mesh"),
    ("scene", "interiors", "shapes"),
    ("scene", "mesh", "mesh_file"),
    ("brdf", "published", "lobe"),
    ("brdf", "published", "lobe_em"),
    ("relight", "dynamic", "direct"),
    ("sphere", "harmonics", "cubemap"),
    ("sphere", "hemisphere", "directions"),
    ("sphere", "rotation", "harmonics"),
    ("scene", "occluder", "mesh"),
    ("scene", "shapes", "mesh"),
    ("scene", "texture", "mesh"),
    ("transport", "bounce", "visibility"),
    ("transport", "bounce", "hits"),
    ("transport", "hits", "visibility"),
    ("transport", "interreflection", "hits"),
    ("transport", "bounce", "paths"),
    ("relight", "transfer", "dynamic"),
    ("transport", "transfer", "blocks"),
    ("transport", "transfer", "clustered"),
    ("transport", "transfer", "transfer_job"),
    ("transport", "transfer_job", "blocks"),
    ("transport", "transfer_job", "bounce"),
    ("transport", "transfer_job", "clustered"),
    ("transport", "transfer_job", "visibility"),
    ("transport", "clustered", "blocks"),
    ("transport", "clustered", "direct"),
    ("transport", "clustered", "separable"),
    ("transport", "clustered", "visibility"),
    ("transport", "direct", "blocks"),
    ("transport", "direct", "visibility"),
    ("transport", "dynamic", "direct"),
    ("transport", "lobe", "direct"),
    ("transport", "lobe", "harmonic"),
    ("transport", "quantized", "sparse"),
    ("transport", "sparse", "visibility"),
    ("transport", "visibility", "blocks"),
    ("transport", "interreflection", "blocks"),
    ("transport", "interreflection", "harmonic"),
    ("transport", "interreflection", "visibility"),
}

# Libraries that only some modules touch: everything that reads files, and the rays.
ONLY_IN = {
    "embreex": "jaxprt.transport.visibility",
    "OpenEXR": "jaxprt.files",
    "OpenImageIO": "jaxprt.files",
    "zarr": "jaxprt.files",
    "jaxopt": "jaxprt.inverse.solve",
    "fast_simplification": "jaxprt.scene.occluder",
}

MOST_LINES = 400
VAGUE = {"utils", "util", "common", "helpers", "misc", "_src", "core"}


def _name(path: pathlib.Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


PATHS = {_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}
TREES = {name: ast.parse(path.read_text(), str(path)) for name, path in PATHS.items()}
each_module = pytest.mark.parametrize("module", PATHS)


def imports(tree: ast.AST) -> Iterator[str]:
    """Full names of what a module imports, anywhere in it; names from jaxprt resolved to modules."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = "." * node.level + (node.module or "")
            for alias in node.names:
                inner = f"{base}.{alias.name}"
                yield inner if inner in PATHS else base


def violation(importer: str, imported: str) -> str | None:
    """What is wrong with one module of the package importing another, or None."""
    if importer == "jaxprt":
        return None
    if imported == "jaxprt":
        return None if importer == "jaxprt.__main__" else "imports the root package"
    room, target = importer.split(".")[1], imported.split(".")[1]
    unknown = {room, target} - set(ROOMS)
    if unknown:
        return f"{unknown} is no room"
    if room == target:
        return _sideways(room, importer.split(".")[2:], imported.split(".")[2:])
    if ROOMS.index(room) > ROOMS.index(target):
        return f"points up, from {room} to {target}"
    return None


def _sideways(room: str, importer: list[str], imported: list[str]) -> str | None:
    if not importer:  # The room's __init__.
        return None
    if not imported:
        return "imports its own room's __init__; name the module"
    pair = (importer[0], imported[0])
    allowed = (room, *pair) in SIDEWAYS or ("*", *pair) in SIDEWAYS
    onto_helper = importer[0] in SYSTEMS and imported[0] not in SYSTEMS
    return None if allowed or onto_helper else f"{pair[0]} on {pair[1]} is not listed in SIDEWAYS"


@each_module
def test_imports_point_down(module):
    wrong = [
        f"{module} -> {name}: {reason}"
        for name in imports(TREES[module])
        if name.partition(".")[0] == "jaxprt" and (reason := violation(module, name))
    ]
    assert not wrong, "\n".join(wrong)


@each_module
def test_imports_are_absolute(module):
    relative = [name for name in imports(TREES[module]) if name.startswith(".")]
    assert not relative, f"write out {relative}"


@each_module
def test_a_library_is_imported_only_where_its_business_is(module):
    for name in imports(TREES[module]):
        home = ONLY_IN.get(name.partition(".")[0])
        assert home is None or module == home or module.startswith(f"{home}."), f"{name} belongs to {home}"


@each_module
def test_linalg_and_sphere_know_no_brdf_and_no_scene(module):
    if module.split(".")[1:2] in (["linalg"], ["sphere"]):
        known = {name.split(".")[1] for name in imports(TREES[module]) if name.startswith("jaxprt.")}
        assert known <= {"linalg", "sphere"}


@each_module
def test_jax_is_not_configured(module):
    text = PATHS[module].read_text()
    names = {ast.unparse(node) for node in ast.walk(TREES[module]) if isinstance(node, ast.Attribute)}
    assert not {name for name in names if re.match(r"jax\.(config|enable_x64|experimental\.enable_x64)\b", name)}
    assert not re.search(r"from jax(\.\w+)* import .*\b(config|enable_x64)\b", text)
    assert not re.search(r"environ\S*[\"'](JAX|XLA)_", text)


@each_module
def test_module_has_a_subject_and_fits_on_a_few_screens(module):
    assert not VAGUE & set(module.split("."))
    lines = len(PATHS[module].read_text().splitlines())
    assert lines <= MOST_LINES, f"{lines} lines: {module} has two subjects"


@each_module
def test_annotations_are_not_deferred(module):
    assert "__future__" not in set(imports(TREES[module])), "a linter then unquotes shapes"


@each_module
def test_third_party_imports_are_declared(module):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extra = itertools.chain.from_iterable(project["optional-dependencies"].values())
    declared = {re.split(r"[^\w-]", line)[0].replace("-", "_") for line in (*project["dependencies"], *extra)}
    used = {name.partition(".")[0] for name in imports(TREES[module])}
    assert used - set(sys.stdlib_module_names) - {"jaxprt"} <= declared


def test_rooms_hold_what_the_table_names():
    rooms = {name.split(".")[1] for name in PATHS if "." in name}
    assert rooms <= set(ROOMS), f"{rooms - set(ROOMS)} must be given a place in ROOMS"


def test_every_sideways_permission_of_one_room_is_used():
    pairs = {
        (*importer.split(".")[1:3], *name.split(".")[2:3]) for importer in PATHS for name in imports(TREES[importer])
    }
    assert {entry for entry in SIDEWAYS if entry[0] != "*"} <= pairs


@pytest.mark.parametrize(
    ("importer", "imported"),
    [
        ("jaxprt.sphere.haar", "jaxprt.scene.mesh"),
        ("jaxprt.transport.separable", "jaxprt.relight.separable"),
        ("jaxprt.brdf.separable", "jaxprt.brdf.harmonic"),
        ("jaxprt.brdf.lobe", "jaxprt.brdf.dynamic"),
        ("jaxprt.brdf.models", "jaxprt.brdf.separable"),
        ("jaxprt.sphere.haar", "jaxprt.sphere"),
        ("jaxprt.linalg.eigen", "jaxprt.brdf"),
        ("jaxprt.image.raster", "jaxprt"),
        ("jaxprt.extra", "jaxprt.sphere"),
    ],
)
def test_the_table_forbids(importer, imported):
    assert violation(importer, imported)


@pytest.mark.parametrize(
    ("importer", "imported"),
    [
        ("jaxprt", "jaxprt.relight"),
        ("jaxprt.brdf", "jaxprt.brdf.models"),
        ("jaxprt.brdf.separable", "jaxprt.brdf.models"),
        ("jaxprt.brdf.dynamic", "jaxprt.brdf.lobe"),
        ("jaxprt.relight.dynamic", "jaxprt.relight.lobe"),
        ("jaxprt.relight.separable", "jaxprt.transport.separable"),
        ("jaxprt.transport.separable", "jaxprt.transport.blocks"),
        ("jaxprt.__main__", "jaxprt"),
        ("jaxprt.__main__", "jaxprt.files"),
    ],
)
def test_the_table_allows(importer, imported):
    assert violation(importer, imported) is None
