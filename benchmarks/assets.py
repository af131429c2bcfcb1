"""Are files that others made drawn right? README's ten lines beside Mitsuba 3, for all glTF and OBJ files of folders.

    python -m benchmarks.assets FOLDER... [--quick] [--only TEXT] [--light FILE] [--edge N] [--samples N]
        [--model NAME] [--warm] [--limit SECONDS] [--store FOLDER] [--pictures FOLDER] [--table FILE] [--output FILE]
        [--dark] [--bounces]

Every file is relit by README's lines, with their defaults, in a process of its own with a time limit. It starts without
compiled programs, unless `--warm` is given. The judge is Mitsuba in another process: `benchmarks.asset_files` reads the
file, and `benchmarks.asset_scenes` writes its materials and the environment file down for Mitsuba, none of it with
jaxprt's code; images are decoded by Pillow and the light by OpenImageIO, which jaxprt uses too. Only the camera is
jaxprt's: the first of the file, or the default one. Light is direct, as it is by
default; with `--bounces` it is reflected as often as that brings something, 39 times by Mitsuba. With `--dark` it is
that of the file's lamps alone. `--model principled` judges by Mitsuba's own BSDF in place of the formula of the glTF
specification.

Each file is one line. `error` is relative L2 over the pixels that surfaces fill, without Mitsuba's noise, the largest
of the lights; `errors`, `flips`, `biases` and `noises` have all of them. `judged` is the share of these pixels among
all that surfaces touch; `whole` is the error of all, with outlines and alpha over a black background. Mitsuba takes
samples until its noise is below a third of `whole`, or `BLOCKS` times as many as asked for: glints of a sun on
smooth metal may stay uncertain. `mismatch` is the share of pixels in which the shares that surfaces cover differ by
more than a half. `backs` is the share of pixels that show the back of a surface of one side: black here, while glTF's
viewers see through it. `undefined` is the share of pixels that are left out, because interpolated normals look away
from the eye. `precompute_seconds` and `picture_seconds` are processor seconds, the first with loading; `seconds` are
those of the clock from the start of the process to the first picture. `warnings` are jaxprt's. `unjudged` names what
the judge leaves out of the materials, such as a clear coat: `error` then has the judge's fault in it too. A file that
is not drawn has `refused` (jaxprt's reason) or `unreadable` (the judge's), and no error.

The last line counts files: `valid` can be read by the judge or by jaxprt, `loaded` are drawn, `judged` have errors of
whole materials, whose median is `error`, and `partly` errors of others; `silent` are files of more than 10 % of which
nothing warned.
"""

import argparse
import dataclasses
import hashlib
import inspect
import os
import pathlib
import pickle
import resource
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from benchmarks import asset_files, asset_scenes, denoised, harness

EDGE, SAMPLES = 512, 256
# A sun, an open sky, and soft boxes.
LIGHTS = "polyhaven_sunrise_1k.exr", "polyhaven_courtyard_1k.exr", "polyhaven_studio_1k.exr"
BLOCKS = 16  # times the samples of Mitsuba's pictures, at most
_CERTAIN = 3  # times the noise that an error must be
BOUNCES = 39  # of Mitsuba, with `--bounces`
LIMIT = 900.0  # seconds of the clock
LARGE = 0.1  # error of which something should warn
SUFFIXES = ".glb", ".gltf", ".obj"


def main(options: Sequence[str] | None = None) -> None:
    parser = harness.parser(str(__doc__).splitlines()[0])
    parser.add_argument("folder", nargs="*", type=pathlib.Path, help="folders or files")
    parser.add_argument("--only", metavar="TEXT", default="", help="files whose paths have TEXT")
    parser.add_argument(
        "--light", type=pathlib.Path, metavar="FILE", action="append", help="instead of a sun, a sky and a studio"
    )
    parser.add_argument(
        "--edge", type=int, metavar="N", default=EDGE, help=f"pixels along an edge; {EDGE} if not given"
    )
    parser.add_argument("--samples", type=int, metavar="N", default=SAMPLES, help="of Mitsuba's pictures, at least")
    parser.add_argument("--dark", action="store_true", help="the light of lamps alone")
    parser.add_argument("--bounces", action="store_true", help="light that surfaces reflect onto each other too")
    parser.add_argument("--model", choices=asset_scenes.MODELS, default=asset_scenes.MODELS[0], help="Mitsuba's BSDF")
    parser.add_argument("--warm", action="store_true", help="use and keep compiled programs")
    parser.add_argument("--limit", type=float, metavar="SECONDS", default=LIMIT, help="of each process")
    parser.add_argument("--store", type=pathlib.Path, metavar="FOLDER", help="keep Mitsuba's pictures")
    parser.add_argument("--pictures", type=pathlib.Path, metavar="FOLDER", help="write ours, Mitsuba's, 4 x difference")
    parser.add_argument("--table", type=pathlib.Path, metavar="FILE", help="write the lines as a table in Markdown")
    parser.add_argument("--process", nargs=2, metavar=("STEP", "FILE"), help=argparse.SUPPRESS)
    arguments = parser.parse_args(options)
    if arguments.process:
        step, request = arguments.process
        STEPS[step](pickle.loads(pathlib.Path(request).read_bytes()))
        return
    with tempfile.TemporaryDirectory() as temporary:
        folder = pathlib.Path(temporary)
        files, lights, options_of = _quick(folder) if arguments.quick else _asked(parser, arguments)
        lights = [_black(folder)] if arguments.dark else lights
        lines = []
        for path in files:
            line = judge(path, lights, folder, **options_of)
            lines.append(harness.report(line, arguments.output))
    harness.report(summary(lines), arguments.output)
    if arguments.table is not None:
        arguments.table.write_text(table(lines, [light.stem for light in lights]))


def _asked(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> tuple[list, list, dict[str, Any]]:
    """Files, lights, and options of `judge`."""
    if not arguments.folder:
        parser.error("name folders of glTF or OBJ files")
    files = [path for path in found(arguments.folder) if arguments.only in str(path)]
    lights = [path.absolute() for path in arguments.light or [harness.data() / "env" / name for name in LIGHTS]]
    missing = [str(path) for path in lights if not path.is_file()]
    if missing or not files:
        parser.error(f"missing: {', '.join(missing)}" if missing else "no glTF or OBJ file in these folders")
    names = ("edge", "samples", "model", "warm", "limit", "store", "pictures", "bounces")
    return files, lights, {name: getattr(arguments, name) for name in names}


def _black(folder: pathlib.Path) -> pathlib.Path:
    """A light file without light."""
    from jaxprt import files

    files.write_exr(folder / "dark.exr", np.zeros((16, 32, 3), np.float32))
    return folder / "dark.exr"


def _quick(folder: pathlib.Path) -> tuple[list, list, dict[str, Any]]:
    """A small file and a small light for `judge`, which are written into a folder."""
    from jaxprt import files

    file, light = folder / "small.gltf", folder / "small.exr"
    asset_files.write_small(file)
    radiance = np.full((16, 32, 3), 0.2, np.float32)
    radiance[:8] = 1.0
    radiance[3:5, 18:22] = 20.0
    files.write_exr(light, radiance)
    options = {"edge": 32, "samples": 64, "model": asset_scenes.MODELS[0], "warm": True, "limit": LIMIT, "size": 16}
    return [file], [light], {**options, "store": None, "pictures": folder, "bounces": False}


def found(folders: Sequence[pathlib.Path]) -> list[pathlib.Path]:
    """Files of folders, glTF and OBJ, by name; files as they are."""
    result = []
    for folder in folders:
        inside = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES)
        result += [folder] if folder.is_file() else inside
    return [path.absolute() for path in result]


def judge(
    path: pathlib.Path,
    lights: Sequence[pathlib.Path],
    folder: pathlib.Path,
    *,
    edge: int,
    samples: int,
    model: str,
    warm: bool,
    limit: float,
    store: pathlib.Path | None,
    pictures: pathlib.Path | None,
    bounces: bool,
    size: int | None = None,
) -> dict[str, Any]:
    """The line of a file.

    Args:
        path: The file.
        lights: Environment files.
        folder: A folder for what processes hand over.
        edge: Pixels along an edge.
        samples: Smallest number of samples of a pixel in each of Mitsuba's two pictures, which have independent noise.
            Up to `BLOCKS` times as many are taken.
        model: One of `asset_scenes.MODELS`.
        warm: Whether compiled programs may be there.
        limit: Seconds of the clock for each process.
        store: A folder that keeps Mitsuba's pictures.
        pictures: A folder for sheets.
        bounces: Whether surfaces reflect light onto each other, as often as that brings something.
        size: Texels along an edge of the light; None for the default.
    """
    start = time.perf_counter()
    request = {"path": path, "lights": lights, "edge": edge, "size": size, "samples": samples, "model": model}
    request["bounces"] = BOUNCES * bounces
    ours, reason = in_process("relight", request, folder, warm=warm, limit=limit)
    line = {"benchmark": "assets", "case": "/".join(path.parts[-2:]), "compile_seconds": None, "error": None}
    line |= {"bytes": path.stat().st_size, "seconds": time.perf_counter() - start, "loaded": ours is not None}
    if ours is None:
        readable = _readable(path)
        return line | {"refused": reason} | ({"unreadable": readable} if readable else {})
    keys = ("bytes", "seconds", "precompute_seconds", "picture_seconds", "vertices", "warnings")
    line |= {key: ours[key] for key in keys}
    if store is not None:
        store.mkdir(parents=True, exist_ok=True)
    request |= {"camera": ours["camera"], "pictures": ours["pictures"], "store": store and store.absolute()}
    theirs, reason = in_process("trace", request, folder, warm=True, limit=limit)
    if theirs is None:
        return line | {"unreadable": reason}
    return line | compared(ours, theirs, [light.stem for light in lights], path, pictures)


def compared(
    ours: dict[str, Any],
    theirs: dict[str, Any],
    lights: Sequence[str],
    path: pathlib.Path,
    pictures: pathlib.Path | None,
) -> dict[str, Any]:
    """What our pictures are off."""
    rows, columns = [], {name: {} for name in ("errors", "flips", "biases", "noises", "whole")}
    (backs, undefined), judged = theirs["sides"], 0.0
    for light, drawn, halves in zip(lights, ours["pictures"], theirs["halves"], strict=True):
        try:
            kept = np.where(undefined[..., None], 0, halves)  # without coverage, they are not compared
            truth = denoised.Truth(kept, theirs["samples"])
        except ValueError as error:
            return {"unreadable": str(error)}
        judged = float(truth.inside.sum() / (halves[..., 3] > 0).all(0).sum())
        row, flip = sheet(drawn, halves.mean(0), truth.inside)
        whole = denoised.Truth(kept, theirs["samples"], covered=0.0).error(drawn)
        figures = truth.error(drawn), flip, truth.bias(drawn), truth.noise, whole
        for name, value in zip(columns, figures, strict=True):
            columns[name][light] = round(value, 4)
        rows.append(row)
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
        write(pictures / f"{path.parent.name}_{path.stem}.png", np.concatenate(rows))
    mismatch = np.abs(ours["covered"] - theirs["halves"][0].mean(0)[..., 3]) > 0.5
    shares = {"mismatch": mismatch, "backs": backs, "undefined": undefined}
    extra = {name: float(value.mean()) for name, value in shares.items()} | {"unjudged": theirs["unjudged"]}
    return {"error": max(columns["errors"].values()), **columns, **extra, "judged": judged}


def summary(lines: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The last line."""
    judged = [line for line in lines if line["error"] is not None]
    errors = [line["error"] for line in judged if not line.get("unjudged")]
    silent = [line["case"] for line in lines if (line["error"] or 0) > LARGE and not line["warnings"]]
    return {
        **{"benchmark": "assets", "case": "all files", "compile_seconds": None},
        **{"error": statistics.median(errors) if errors else None, "seconds": sum(line["seconds"] for line in lines)},
        **{"bytes": sum(line["bytes"] for line in lines), "files": len(lines), "judged": len(errors)},
        "partly": len(judged) - len(errors),
        "valid": sum(line["loaded"] or "unreadable" not in line for line in lines),
        "loaded": sum(line["loaded"] for line in lines),
        **{"above": sum(error > LARGE for error in errors), "silent": len(silent), "silent_files": silent},
    }


def table(lines: Sequence[dict[str, Any]], lights: Sequence[str]) -> str:
    """The lines as a table in Markdown."""
    names = ["file", "vertices", *lights, "whole", "FLIP", "precomputation, picture", "warnings", "not judged"]
    rows = [names, ["---"] * len(names)]
    for line in lines:
        row = [line["case"]]
        if line["loaded"]:
            seconds = f"{line['precompute_seconds']:.0f}, {line['picture_seconds']:.0f} s"
            errors = [f"{line['errors'][light]:.1%}" if "errors" in line else "-" for light in lights]
            flip = f"{max(line['flips'].values()):.3f}" if "flips" in line else "-"
            whole = f"{max(line['whole'].values()):.1%}" if "whole" in line else "-"
            rest = [f"{1 - line['judged']:.0%} of pixels"] if "judged" in line else ["all"]
            warned = str(len(line["warnings"]) or "none")
            left_out = ", ".join(rest + line.get("unjudged", []))
            row += [f"{line['vertices']:,}", *errors, whole, flip, seconds, warned, left_out]
        else:
            row += ["-"] * (len(names) - 2) + [f"refused: {line['refused']}"]
        rows.append([cell.replace("|", "\\|") for cell in row])
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def _readable(path: pathlib.Path) -> str | None:
    """Why the judge cannot read a file; None if it can."""
    try:
        asset_files.read(path)
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return None


def in_process(
    step: str, request: dict[str, Any], folder: pathlib.Path, *, warm: bool, limit: float
) -> tuple[dict[str, Any] | None, str]:
    """The result of one of `STEPS` in a process of its own, or None and the reason why there is none."""
    question, answer = folder / f"{step}.request", folder / f"{step}.answer"
    answer.unlink(missing_ok=True)
    jax_cache = ("JAX_COMPILATION_CACHE", "JAX_PERSISTENT_CACHE")  # with these set, jaxprt keeps no programs
    environment = dict(os.environ)
    if not warm:
        environment = {name: value for name, value in environment.items() if not name.startswith(jax_cache)}
        empty = tempfile.mkdtemp(dir=folder)
        environment |= dict.fromkeys(("XDG_CACHE_HOME", "HOME", "LOCALAPPDATA"), empty)
    question.write_bytes(pickle.dumps(request | {"answer": answer, "started": time.time()}))
    command = [sys.executable, "-m", "benchmarks.assets", "--process", step, str(question)]
    root = pathlib.Path(__file__).parents[1]
    try:
        done = subprocess.run(command, cwd=root, env=environment, timeout=limit, capture_output=True, text=True)
    except subprocess.TimeoutExpired:
        return None, f"not done after {limit:.0f} s"
    if answer.is_file():
        result = pickle.loads(answer.read_bytes())
        return (None, result["reason"]) if "reason" in result else (result, "")
    last = (done.stderr.strip().splitlines() or ["no message"])[-1]
    return None, f"the process ended with {done.returncode}: {last}"


def _answered(function: Callable[[dict[str, Any]], dict[str, Any]]) -> Callable[[dict[str, Any]], None]:
    """A step that writes its result, or the error that it raised, for the process that has started it."""

    def step(request: dict[str, Any]) -> None:
        try:
            result = function(request)
        except Exception as error:
            result = {"reason": f"{type(error).__name__}: {error}"}
        request["answer"].write_bytes(pickle.dumps(result))

    return step


@_answered
def relight(request: dict[str, Any]) -> dict[str, Any]:
    """README's lines, at an edge of pixels of our choice: pictures, times and warnings."""
    import jaxprt as prt
    from jaxprt import image

    size = request["size"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of lights, such as negative values
        lights = [prt.load_environment(path, size=size or 64) for path in request["lights"]]
    with warnings.catch_warnings(record=True) as raised, tempfile.TemporaryDirectory() as store:
        warnings.simplefilter("always")
        scene, options = prt.load_scene(request["path"]), {"size": size}
        if request["bounces"]:
            options["bounces"] = "all"
        relit = prt.precompute(scene, system="lobe", path=f"{store}/scene.prt", progress=False, **options)
        precomputed = _processor_seconds()
        camera = dataclasses.replace(relit.camera, width=request["edge"], height=request["edge"])
        pictures = [np.asarray(relit.picture(lights[0], camera, background=None))]
        drawn, seconds = _processor_seconds(), time.time() - request["started"]
        pictures += [np.asarray(relit.picture(light, camera, background=None)) for light in lights[1:]]
        pixels = image.shading_points(image.rasterize(relit.mesh, camera, samples=4), relit.mesh, camera)
    shown = [warning for warning in raised if issubclass(warning.category, UserWarning)]
    return {
        **{"pictures": pictures, "camera": camera, "covered": 1 - np.asarray(pixels.background)},
        **{"precompute_seconds": precomputed, "picture_seconds": drawn - precomputed, "seconds": seconds},
        **{"vertices": relit.vertices, "bytes": prt.memory(relit)},
        "warnings": sorted(
            {str(warning.message).replace(str(request["path"]), request["path"].name) for warning in shown}
        ),
    }


def _processor_seconds() -> float:
    """Processor seconds of all threads of this process so far."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


@_answered
def trace(request: dict[str, Any]) -> dict[str, Any]:
    """Mitsuba's pictures, two of each light."""
    surfaces = asset_files.read(request["path"])
    halves, sides = [], np.zeros(())
    for light, drawn in zip(request["lights"], request["pictures"], strict=True):
        code = "".join(inspect.getsource(module) for module in (asset_files, asset_scenes))
        camera = [np.asarray(value).tolist() for value in vars(request["camera"]).values()]
        asked = [request[name] for name in ("samples", "model", "bounces")]
        what = pickle.dumps((surfaces, light.read_bytes(), camera, asked, code))
        path = request["store"] and request["store"] / f"{hashlib.sha256(what).hexdigest()}.npz"
        known = None
        if path is not None and path.is_file():
            with np.load(path) as kept:
                known = kept["total"], int(kept["blocks"]), kept["sides"]
        total, blocks, sides = rendered(surfaces, light, request, drawn, known)
        if path is not None:
            np.savez(path, total=total, blocks=blocks, sides=sides)
        halves.append(total / blocks)
    unjudged = sorted(set().union(*map(asset_scenes.unjudged, surfaces)))
    return {"halves": halves, "samples": 2 * request["samples"], "sides": sides, "unjudged": unjudged}


def rendered(
    surfaces: Sequence[asset_files.Surface],
    light: pathlib.Path,
    request: dict[str, Any],
    drawn: np.ndarray,
    known: tuple[np.ndarray, int, np.ndarray] | None,
) -> tuple[np.ndarray, int, np.ndarray]:
    """The sum of blocks of two pictures [2 h w 4], their number, and the pixels [2 h w] of `asset_scenes.View.sides`.

    Blocks are added to those that are `known` until the error of the picture that was `drawn` is certain.
    """
    if known is not None and _certain(*known, drawn):
        return known
    options = {name: request[name] for name in ("model", "bounces")}
    view = asset_scenes.View(surfaces, light, request["camera"], **options)
    total, blocks, sides = (np.zeros(()), 0, np.stack(view.sides())) if known is None else known
    while not blocks or not _certain(total, blocks, sides, drawn):
        seeds = (2 * blocks + 1, 2 * blocks + 2)
        total = total + np.stack([view.picture(request["samples"], seed).astype(np.float64) for seed in seeds])
        blocks += 1
    return total, blocks, sides


def _certain(total: np.ndarray, blocks: int, sides: np.ndarray, drawn: np.ndarray) -> bool:
    """Whether Mitsuba's noise is small beside the error of a picture, or as small as it gets."""
    halves = np.where(sides[1][..., None], 0, total / blocks)
    if blocks >= BLOCKS or not (halves[..., 3] > 0).all(0).any():
        return True
    truth = denoised.Truth(halves, blocks, covered=0.0)
    return _CERTAIN * truth.noise <= truth.error(drawn)


def sheet(drawn: np.ndarray, truth: np.ndarray, inside: np.ndarray) -> tuple[np.ndarray, float]:
    """Ours, Mitsuba's, and four times the difference of the pixels that are compared; and FLIP over these pixels.

    The exposure is Mitsuba's: the largest color of a twentieth of the compared pixels is above .8. FLIP is of what is
    displayed, with black in place of other pixels.
    """
    import flip_evaluator

    scale = 0.8 / max(float(np.quantile(truth[inside][:, :3].max(-1), 0.95)), 1e-6)
    difference = np.where(inside[..., None], 4 * np.abs(drawn[..., :3] - truth[..., :3]), 0)
    shown = [_displayed(scale * picture) for picture in (drawn[..., :3], truth[..., :3], difference)]
    mine, theirs = (np.ascontiguousarray(np.where(inside[..., None], picture, 0), np.float32) for picture in shown[:2])
    flip, _, _ = flip_evaluator.evaluate(theirs, mine, "LDR", inputsRGB=True, applyMagma=False, parameters={})
    return np.concatenate(shown, 1), float(np.squeeze(flip)[inside].mean())


def _displayed(linear: np.ndarray) -> np.ndarray:
    """Radiance up to 1 in sRGB."""
    value = np.clip(linear, 0, 1)
    return np.where(value <= 0.0031308, 12.92 * value, 1.055 * np.maximum(value, 0.0031308) ** (1 / 2.4) - 0.055)


def write(path: pathlib.Path, picture: np.ndarray) -> None:
    """Writes values from 0 to 1 as PNG."""
    import PIL.Image

    PIL.Image.fromarray(np.round(255 * picture).astype(np.uint8)).save(path)


STEPS = {"relight": relight, "trace": trace}


if __name__ == "__main__":
    main()
