"""Files that commands read, small sizes of what they compute, and the exit status of a command."""

from types import SimpleNamespace

import numpy as np
import pytest

import jaxprt as prt
from jaxprt.cli import inputs, measure, play
from jaxprt.cli import report as cli_report
from jaxprt.cli.main import program
from jaxprt.relit import measuring, refinement

OBJ = "v 0 1 0\nv -1 -0.5 1\nv 1 -0.5 1\nv 0 -0.5 -1\nf 1 2 3\nf 1 3 4\nf 1 4 2\nf 2 4 3\n"


@pytest.fixture(scope="module", autouse=True)
def small(coarse, bound):
    """Coarse maps, tables and ground, few judged pixels: what commands do with them is the same.

    Meshes are divided only where --refine has a number: divided by default, a tetrahedron has 5,000 vertices.
    """
    divided = refinement.divided

    def on_demand(scene, wanted, **options):
        return divided(scene, False if wanted is True else wanted, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(inputs.refinement, "divided", on_demand)
        for function, limits in (
            (prt.separable.factor, {"resolution": 8}),
            (prt.harmonic.precompute, {"size": 8}),
            (prt.harmonic.precompute_diffuse, {"size": 8}),
            (prt.harmonic.tabulate, {"resolution": 8, "error": 1.0}),
            (prt.lobe.tabulate, {"resolution": 8}),
            (prt.scene.mesh.ground_plane, {"vertices": 49}),
            (prt.bounces.precompute, {"edge": 2, "size": 8, "components": 8, "modes": 8}),
        ):
            bound(patch, function, **limits)
        sizes = {"TERMS": (1, 4), "KEEP": (32, 96), "DEGREES": (1, 3), "LOBES": (1, 4), "TEXELS": (0, 16)}
        for name, values in sizes.items():
            patch.setattr(cli_report, f"TABLE_{name}", values)
        patch.setattr(cli_report, "PIXELS", 200)
        patch.setattr(measuring, "_PICTURE", 32)
        patch.setattr(measuring, "_PIXELS", 20)
        patch.setattr(measure, "_RINGS", 6)
        patch.setattr(measure, "_SECTORS", 8)
        yield


@pytest.fixture(scope="session")
def place(tmp_path_factory):
    """A folder with two tetrahedra, skies, and files that are neither."""
    folder = tmp_path_factory.mktemp("command")
    (folder / "mesh.obj").write_text(OBJ)
    (folder / "two.obj").write_text(OBJ.replace("v 0 1 0", "v 0 2 0"))
    sky = np.random.default_rng(0).uniform(0.1, 2, size=(4, 8, 3)).astype(np.float32)
    gray = np.full((8, 16, 3), 0.5, np.float32)
    sun = gray.copy()
    sun[3, 4] = 90
    nan = np.where(sky > 1.9, np.nan, sky).astype(np.float32)
    images = {"sky": sky, "dusk": sky[::-1] / 3, "negative": sky - 0.3, "square": sky[:, :5], "nan": nan}
    for name, image in {**images, "gray": gray, "sun": sun}.items():
        prt.files.write_exr(folder / f"{name}.exr", image)
    (folder / "text.exr").write_text("not a picture")
    (folder / "empty.obj").write_text("# nothing\n")
    (folder / "notes.txt").write_text("neither\n")
    (folder / "broken.glb").write_bytes(b"glTF and no more")
    return folder


@pytest.fixture(scope="session")
def main():
    """The function from arguments of the command line to its exit status."""

    def run(*arguments):
        with pytest.raises(SystemExit) as end:
            program(list(map(str, arguments)), prog_name="jaxprt")
        return end.value.code or 0

    return run


@pytest.fixture(scope="session")
def chosen():
    """The function from arguments of `jaxprt view` to its options."""
    return lambda *arguments: SimpleNamespace(**play.command.make_context("view", list(map(str, arguments))).params)
