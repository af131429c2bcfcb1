"""The layer table of the design: who may import whom, and the few rules on what a module may do.

Rooms are folders; imports point down ``ROOMS``, never up. In ``systems`` each system is a folder or file of its own,
and imports point down ``LADDER``. Inside a folder modules may import each other. No imports form a circle.
docs/architecture.md says the same to readers, and names only what exists.
"""

import ast
import builtins
import functools
import graphlib
import importlib
import itertools
import pathlib
import re
import sys
import tomllib
from collections.abc import Iterable, Iterator

ROOT = pathlib.Path(__file__).parents[1]
PACKAGE = ROOT / "jaxprt"
PAGE = (ROOT / "docs" / "architecture.md").read_text()

# From the top. A module may import from rooms further down.
ROOMS = [
    "__main__",
    "public",
    "cli",
    "view",
    "inverse",
    "daylight",
    "sensors",
    "relit",
    "systems",
    "image",
    "visibility",
    "scene",
    "brdf",
]
ROOMS += ["decompose", "sphere", "files", "compile", "programs", "require"]

# The ladder of systems, from the top: each builds on those of lower rungs, and on none of its own.
LADDER = [
    {"standard"},
    {"bounces", "ranges"},
    {"dynamic", "lamps"},
    {"separable", "lobe"},
    {"harmonic"},
    {"reference", "bright_texels", "devices"},
]
LADDER += [{"light_cells"}, {"adaptive", "protocol"}, {"axes"}]
RUNG = {system: number for number, rung in enumerate(LADDER) for system in rung}

# Libraries that only some modules touch: everything that reads files, and the rays.
ONLY_IN = {
    "click": "jaxprt.cli",
    "embreex": "jaxprt.visibility.occluder",
    "numba": ("jaxprt.visibility", "jaxprt.compile", "jaxprt.programs.loops"),
    "llvmlite": ("jaxprt.visibility.embree", "jaxprt.programs.loops"),
    "OpenImageIO": "jaxprt.files",
    "mmap": "jaxprt.files.arrays",
    "jaxopt": "jaxprt.inverse.solve",
    "IPython": "jaxprt.view.widget",
    "anywidget": "jaxprt.view.widget",
    "traitlets": "jaxprt.view.widget",
    "DracoPy": "jaxprt.scene.formats.gltf_geometry",
    "meshopt": "jaxprt.scene.formats.gltf_file",
    "opengl_basisu": "jaxprt.files.images",
    "fast_simplification": "jaxprt.scene.occluder",
}

MOST_LINES = 800
MOST_LINES_OF_A_FUNCTION = 60  # its docstring apart
# Variables, arguments and loop targets are named by what they hold: part, texel, vertex, row, hit, path, value.
FILLERS = {"each", "found", "own", "made", "every", "kept", "given", "met"}
VAGUE = {"utils", "util", "common", "helpers", "misc", "_src", "core"}


def _name(path: pathlib.Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


PATHS = {_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}
TEXTS = {name: path.read_text() for name, path in PATHS.items()}
NODES = {name: list(ast.walk(ast.parse(text, str(PATHS[name])))) for name, text in TEXTS.items()}


def imports(nodes: Iterable[ast.AST]) -> Iterator[str]:
    """Full names of what a module imports, anywhere in it; names from jaxprt resolved to modules."""
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = "." * node.level + (node.module or "")
            for alias in node.names:
                inner = f"{base}.{alias.name}"
                yield inner if inner in PATHS else base


IMPORTED = {module: set(imports(nodes)) for module, nodes in NODES.items()}


def violation(importer: str, imported: str) -> str | None:
    """What is wrong with one module of the package importing another, or None."""
    if importer == "jaxprt":
        return None
    if imported == "jaxprt":
        return (
            None
            if importer in ("jaxprt.cli.main", "jaxprt.cli.info", "jaxprt.cli.relight")
            else "imports the root package"
        )
    room, target = importer.split(".")[1], imported.split(".")[1]
    unknown = {room, target} - set(ROOMS)
    if unknown:
        return f"{unknown} is no room"
    if room == target:
        return _inside(importer.split("."), imported.split("."))
    if ROOMS.index(room) > ROOMS.index(target):
        return f"points up, from {room} to {target}"
    return None


def _inside(importer: list[str], imported: list[str]) -> str | None:
    """The same of two modules of one room."""
    if len(importer) > len(imported) and importer[: len(imported)] == imported:
        return "imports the __init__ of its own folder; name the module"
    if importer[1] != "systems" or len(importer) < 3 or importer[2] == imported[2]:
        return None
    unknown = {importer[2], imported[2]} - set(RUNG)
    if unknown:
        return f"{unknown} has no place on the ladder"
    same = RUNG[importer[2]] >= RUNG[imported[2]]
    return f"points up the ladder, from {importer[2]} to {imported[2]}" if same else None


def test_imports_point_down():
    wrong = [
        f"{module} -> {name}: {reason}"
        for module, names in IMPORTED.items()
        for name in names
        if name.partition(".")[0] == "jaxprt" and (reason := violation(module, name))
    ]
    assert not wrong, "\n".join(wrong)


def test_imports_are_absolute():
    relative = [f"{module}: {name}" for module, names in IMPORTED.items() for name in names if name.startswith(".")]
    assert not relative, f"write out {relative}"


def test_a_library_is_imported_only_where_its_business_is():
    strangers = []
    for module, names in IMPORTED.items():
        for name in names:
            home = ONLY_IN.get(name.partition(".")[0])
            homes = (home,) if isinstance(home, str) else home
            if homes is not None and not any(module == room or module.startswith(f"{room}.") for room in homes):
                strangers.append(f"{name} belongs to {home}, not to {module}")
    assert not strangers


def test_decompositions_and_the_sphere_know_no_brdf_and_no_scene():
    known = {
        module: {name.split(".")[1] for name in names if name.startswith("jaxprt.")}
        for module, names in IMPORTED.items()
        if module.split(".")[1:2] in (["decompose"], ["sphere"])
    }
    assert not [module for module, rooms in known.items() if not rooms <= {"decompose", "sphere", "compile"}]


def test_jax_is_not_configured():
    for module, text in TEXTS.items():
        if module == "jaxprt.programs.xla_flags":  # avoids wrong sums of jaxlib 0.10.2
            continue
        if module.startswith("jaxprt.programs."):  # reads all options; the one that it sets is a default of the user's
            changed = re.findall(r"(?:config\.update|environ\S*\]\s*=[^=]).*", text)
            assert all(line.startswith("config.update(_THRESHOLD, ") for line in changed), changed
            continue
        names = {ast.unparse(node) for node in NODES[module] if isinstance(node, ast.Attribute)}
        configured = {name for name in names if re.match(r"jax\.(config|enable_x64|experimental\.enable_x64)\b", name)}
        assert not configured, module
        assert not re.search(r"from jax(\.\w+)* import .*\b(config|enable_x64)\b", text), module
        assert not re.search(r"environ\S*[\"'](JAX|XLA)_", text), module


def test_what_is_compiled_states_the_precision_of_its_products():
    jitted = [
        module
        for module in PATHS.keys() - {"jaxprt.compile", "jaxprt.programs.jax_cache"}  # the latter adds 1 to a number
        if any(isinstance(node, ast.Attribute) and node.attr == "jit" for node in NODES[module])
    ]
    assert not jitted, f"jax.jit leaves products to TF32 on GPUs: take jaxprt.compile.jit in {jitted}"


def test_modules_have_a_subject_and_fit_on_a_few_screens():
    vague = [module for module in PATHS if VAGUE & set(module.split("."))]
    assert not vague
    lines = {module: len(text.splitlines()) for module, text in TEXTS.items()}
    long = {module: count for module, count in lines.items() if count > MOST_LINES}
    assert not long, f"these modules have two subjects: {long}"


def test_functions_have_one_idea():
    long = {}
    for module, nodes in NODES.items():
        for function in nodes:
            if isinstance(function, ast.FunctionDef):
                documented = len((ast.get_docstring(function) or "").splitlines())
                lines = (function.end_lineno or 0) - function.lineno + 1 - documented
                if lines > MOST_LINES_OF_A_FUNCTION:
                    long[f"{module}.{function.name}"] = lines
    assert not long, f"lines without docstrings, at most {MOST_LINES_OF_A_FUNCTION}: {long}"


def private(node: ast.AST) -> Iterator[ast.FunctionDef | ast.ClassDef]:
    """Private functions and classes, with all inside of them."""
    for child in ast.iter_child_nodes(node):
        named = isinstance(child, ast.FunctionDef | ast.ClassDef)
        if named and child.name.startswith("_") and not child.name.startswith("__"):
            yield from (each for each in ast.walk(child) if isinstance(each, ast.FunctionDef | ast.ClassDef))
        else:
            yield from private(child)


def test_docstrings_of_private_functions_are_a_line():
    long = {
        f"{module}.{function.name}"
        for module in TEXTS
        for function in private(ast.parse(TEXTS[module]))
        if "\n" in (ast.get_docstring(function) or "")
    }
    assert not long


def fillers(nodes: Iterable[ast.AST]) -> Iterator[str]:
    """Fillers that a module binds as names of variables, arguments or loop targets, with their lines."""
    for node in nodes:
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id in FILLERS:
            yield f"{node.lineno}: {node.id}"
        elif isinstance(node, ast.arg) and node.arg in FILLERS:
            yield f"{node.lineno}: {node.arg}"


def test_names_say_what_they_hold():
    wrong = [f"{module}:{place}" for module, nodes in NODES.items() for place in fillers(nodes)]
    assert not wrong, "\n".join(wrong)


def test_annotations_are_not_deferred():
    deferred = [module for module, names in IMPORTED.items() if "__future__" in names]
    assert not deferred, f"a linter then unquotes shapes in {deferred}"


def test_third_party_imports_are_declared():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extra = itertools.chain.from_iterable(project["optional-dependencies"].values())
    declared = {re.split(r"[^\w-]", line)[0].replace("-", "_") for line in (*project["dependencies"], *extra)}
    used = {name.partition(".")[0]: module for module, names in IMPORTED.items() for name in names}
    unknown = used.keys() - set(sys.stdlib_module_names) - {"jaxprt"} - declared
    assert not unknown, {name: used[name] for name in unknown}


def rows(page: str, heading: str) -> list[list[str]]:
    """Cells of the first table under a heading, without its head."""
    section = re.split(r"^## ", page.partition(f"## {heading}\n")[2], flags=re.MULTILINE)[0]
    table = re.findall(r"^\| .* \|$", section, re.MULTILINE)
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table[1:]]


def named(text: str) -> list[str]:
    """What stands between backticks."""
    return re.findall(r"`([^`\n]+)`", text)


def exists(name: str) -> bool:
    """Whether there is such a file, folder or command of the project, or such an attribute or module of jaxprt."""
    if "/" in name:
        return (ROOT / name).exists()
    whole, *parts = name.split(".")
    try:
        functools.reduce(getattr, parts, importlib.import_module(whole))
    except AttributeError:
        return False
    return True


def test_the_page_lists_the_rooms_from_the_top():
    assert [named(first) for first, *_ in rows(PAGE, "Folders")] == [[room] for room in ROOMS]
    assert {name.split(".")[1] for name in PATHS if "." in name} == set(ROOMS)


def test_the_page_lists_the_rungs_of_the_ladder_from_the_top():
    table = rows(PAGE, "Systems")
    assert [set(named(systems)) for _, systems, *_ in table] == LADDER
    assert [int(number) for number, *_ in table] == list(range(len(LADDER), 0, -1))
    assert {name.split(".")[2] for name in PATHS if re.match(r"jaxprt\.systems\.", name)} == set(RUNG)


def test_what_the_page_names_exists():
    names = {name for name in named(PAGE) if re.fullmatch(r"\w+[./][\w./]+", name)}
    # A bare name of a file, such as `system.py`, is one that every system has.
    files = {name for name in names if re.fullmatch(r"\w+\.py", name)}
    missing = [name for name in files if not list(PACKAGE.glob(f"systems/*/{name}"))]
    assert not missing
    missing = [name for name in names - files if not exists(name)]
    assert not missing


def test_no_imports_form_a_circle():
    needs = {module: {name for name in names if name in PATHS and name != module} for module, names in IMPORTED.items()}
    # Inside a folder its own __init__ does not count: what imports a module of it runs that first.
    graphlib.TopologicalSorter(needs).prepare()


FORBIDDEN = [
    ("sphere.haar", "scene.mesh"),
    ("visibility.stored", "systems.lobe"),
    ("systems.separable.sparse", "systems.lobe"),
    ("systems.lobe.table", "systems.dynamic.table"),
    ("systems.lobe.table", "systems.lobe"),
    ("systems.lobe.table", "systems"),
    ("decompose.eigen", "brdf"),
    ("systems.extra", "systems.lobe"),
    ("extra", "sphere"),
]
ALLOWED = [
    ("brdf", "brdf.models"),
    ("systems.lobe.system", "systems.lobe.table"),
    ("systems.dynamic.system", "systems.lobe"),
    ("systems.bounces.functions", "systems.dynamic.reflected"),
    ("systems.separable.sparse", "visibility.blocks"),
]


def test_the_table_forbids_and_allows():
    assert [pair for pair in FORBIDDEN if not violation(*(f"jaxprt.{name}" for name in pair))] == []
    assert [pair for pair in ALLOWED if violation(*(f"jaxprt.{name}" for name in pair))] == []
    assert violation("jaxprt.image.raster", "jaxprt")
    assert not violation("jaxprt.cli.main", "jaxprt")
    assert not violation("jaxprt", "jaxprt.systems")


def test_every_name_that_a_module_reads_is_bound_in_it():
    """Linters take the shapes of annotations for names, so they are told not to look for unbound names."""
    missing = {}
    for module, text in TEXTS.items():
        loads, bound = set(), set(dir(builtins)) | {"__file__", "__path__"}
        for node in ast.walk(ast.parse(text)):
            match node:
                case ast.Name(id=name, ctx=ast.Load()):
                    loads.add(name)
                case ast.Name(id=name):
                    bound.add(name)
                case ast.FunctionDef(name=name) | ast.ClassDef(name=name) | ast.AsyncFunctionDef(name=name):
                    bound.add(name)
                case ast.arg(arg=name):
                    bound.add(name)
                case ast.alias(name=name, asname=other):
                    bound.add(other or name.partition(".")[0])
                case ast.ExceptHandler(name=str(name)) | ast.MatchAs(name=str(name)) | ast.MatchStar(name=str(name)):
                    bound.add(name)
        if loads - bound:
            missing[module] = sorted(loads - bound)
    assert not missing
