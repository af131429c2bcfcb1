import pathlib
import re
import tomllib

import jaxprt

ROOT = pathlib.Path(__file__).parents[1]


def test_citation_names_this_version():
    found = re.search(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert found is not None
    assert found[1] == jaxprt.__version__


def test_the_wheel_holds_every_file_of_the_package_that_is_not_python():
    patterns = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]["jaxprt"]
    package = ROOT / "jaxprt"
    listed = {path for pattern in patterns for path in package.glob(pattern)}
    other = {
        path
        for path in package.rglob("*")
        if path.is_file() and path.suffix not in {".py", ".pyc"} and "__pycache__" not in path.parts
    }
    assert (package / "py.typed") in listed
    assert other == listed


def test_each_pin_satisfies_the_bounds_of_the_project():
    from packaging.requirements import Requirement
    from packaging.utils import canonicalize_name

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = [x for group in project["optional-dependencies"].values() for x in group]
    pins = {
        canonicalize_name(line.split("==")[0]): line.split("==")[1].split(";")[0].strip()
        for line in (ROOT / "constraints.txt").read_text().splitlines()
        if "==" in line and not line.startswith("#")
    }
    for requirement in map(Requirement, project["dependencies"] + extras):
        if not {"cuda12", "cuda13"} & requirement.extras:
            assert pins[canonicalize_name(requirement.name)] in requirement.specifier, requirement
