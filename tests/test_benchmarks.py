"""Every benchmark runs to its end on its small case, and says what a measurement must say."""

import importlib
import json
import pathlib
import subprocess
import sys

import jax
import pytest

import jaxprt as prt
from jaxprt import lobe
from jaxprt.image import raster

pytestmark = pytest.mark.documents

ROOT = pathlib.Path(__file__).parents[1]
BENCHMARKS = sorted(
    path.stem
    for path in (ROOT / "benchmarks").glob("*.py")
    if path.stem
    not in (
        "__init__",
        "asset_files",
        "asset_scenes",
        "cubemap_light",
        "denoised",
        "harness",
        "paper_figures",
        "paper_recipes",
        "path_tracing",
        "plugins",
        "prb",
    )
)
# Small cases bound the error too: rounding, or thin features of coarse meshes.
MOST_ERROR = {
    "accuracy": 0.1,
    "assets": 0.4,  # a ball on four vertices under a sun
    "compression": 1.0,
    "concave": 0.5,  # of all bounces against one alone
    "dataset": 0.6,
    "daylight": 0.05,  # of a sixteenth of the rays
    "device": 0.0,  # Here it is the CPU itself.
    "endurance": 1e-3,  # of half floats
    "factorization": 1e-4,
    "failures": 0.3,
    "first_picture": 1e-6,  # Kept programs and stores change nothing.
    "gradients": 1e-7,
    "interreflection": 0.7,
    "inverse": 0.16,  # of an exponent that pictures of 32 x 32 pixels determine to 6 %
    "lights": 1e-5,  # A batch is its lights.
    "lobes": 0.15,
    "low_frequency": 0.06,  # of nine coefficients of irradiance
    "million": 1e-5,
    "paper_scenes": 0.5,  # of tensors of few components
    "pictures": 0.6,
    "precompute_separable": 3e-3,
    "rasterize": 0.03,  # of the coverage at edges
    "refinement": 0.4,
    "reflections": 0.15,
    "relight_dynamic": 0.08,
    "relight_harmonic": 0.7,
    "relight_separable": 5e-3,
    "rotation": 1e-5,
    "scenes": 0.45,
    "standard_tables": 0.03,
    "tables": 1.0,
    "three": 0.25,  # of image based light without shadows; of transfer .14
    "tucker": 0.52,
    "view": 1e-3,  # of half floats
}


@pytest.fixture(scope="module")
def small(coarse, bound):
    """Coarse tables, and blocks so short that quick cases have several."""
    with pytest.MonkeyPatch.context() as patch:
        for function, limits in (
            (prt.separable.factor, {"resolution": 12}),
            (prt.harmonic.tabulate, {"error": 1e-2}),
            (prt.lobe.tabulate, {"resolution": 16}),
            (prt.bounces.precompute, {"edge": 2, "size": 8, "components": 8, "modes": 24}),
        ):
            bound(patch, function, **limits)
        for room, name, value in (
            (prt.separable.factorization, "_BLOCK", 64),
            (lobe.pyramid, "_BLOCK", 64),
            (raster, "CHUNK", 1024),
        ):
            patch.setattr(room, name, value)
        yield  # Benchmarks share compiled programs, which have these sizes in them.
    jax.clear_caches()


@pytest.mark.parametrize("name", BENCHMARKS)
def test_quick_case_reports_each_measurement_with_its_error_and_peer(name, small, tmp_path):
    output = tmp_path / "lines.jsonl"
    importlib.import_module(f"benchmarks.{name}").main(["--quick", "--output", str(output)])
    lines = [json.loads(line) for line in output.read_text().splitlines()]
    assert any(line["error"] is not None for line in lines)
    for line in lines:
        assert line["benchmark"] == name
        assert line["seconds"] > 0
        assert line["bytes"] > 0
        assert line["error"] is None or line["error"] <= MOST_ERROR[name]
        if "peer" not in line:
            continue
        assert line["ratio"] == pytest.approx(line["peer_seconds"] / line["seconds"])


def test_a_benchmark_runs_as_a_program(tmp_path):
    output = tmp_path / "lines.jsonl"
    command = [sys.executable, "-m", "benchmarks.rasterize", "--quick", "--output", str(output)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    assert json.loads(output.read_text().splitlines()[0])["benchmark"] == "rasterize"
