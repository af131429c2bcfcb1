"""Shows scenes to play with in the browser: `python -m jaxprt view [FILES]`."""

import argparse
import dataclasses
import os
import sys
import threading
import webbrowser
from collections.abc import Sequence
from pathlib import Path

import equinox as eqx
import jax

import jaxprt as prt
from jaxprt.relit import Harmonics, Lobes, RelitScene
from jaxprt.relit.recipes import Recipe
from jaxprt.scene import Environment, Part, Scene, TexturedMaterial, builtin
from jaxprt.scene.mesh import ground_plane, split
from jaxprt.scene.scene import numbered
from jaxprt.view import export, serve

_LIGHTS = {".exr", ".hdr", ".pic"}
_PLASTIC = TexturedMaterial(base_color=(0.4, 0.1, 0.08), metallic=0.0, roughness=0.4)
_ROUGHNESS = (0.25, 0.8)  # that materials can have; smoother ones take more time for each look


def main(arguments: Sequence[str]) -> None:
    """Runs the command until it is stopped.

    Raises:
        ValueError: A file is none that can be shown.
        OSError: It cannot be read, or the port cannot be taken.
    """
    options = _parser().parse_args(arguments)
    if options.export is not None and options.export.suffix.lower() != ".html":
        raise ValueError(f"--export takes a file *.html, got {options.export}")
    if options.export is not None and (len(options.system) > 1 or len(options.lobes) > 1):
        raise ValueError("--export takes one system, and one number of lobes, got several")
    made, lights = ready(options)
    if options.export is not None:
        piece = export(next(iter(made.values())), options.export, environments=lights)
        print(f"jaxprt: {piece.path}, {piece.nbytes:,} bytes, {100 * piece.error:.1f} % off the whole scene")
        return
    server = serve(made, environments=lights, port=options.port)
    print(f"jaxprt: {server.url} shows the scene; Ctrl-C ends it", flush=True)
    if options.browser:
        threading.Thread(target=webbrowser.open, args=(server.url,), daemon=True).start()
    try:
        server.wait()
    except KeyboardInterrupt:
        server.close()


def keep_programs() -> None:
    """Lets JAX keep compiled programs for the user's later runs, unless the environment says where or whether."""
    if any(name.startswith(("JAX_COMPILATION_CACHE", "JAX_ENABLE_COMPILATION_CACHE")) for name in os.environ):
        return
    kept = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxprt" / "programs"
    jax.config.update("jax_compilation_cache_dir", str(kept))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    jax.config.update("jax_compilation_cache_max_size", 2**31)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m jaxprt view", description=__doc__)
    parser.add_argument(
        "files", type=Path, nargs="*", metavar="FILE", help="meshes and scenes, HDR and EXR environments; embedded ones"
    )
    parser.add_argument("--system", choices=["lobe", "harmonic"], nargs="+", default=["lobe"], help="one, or both")
    parser.add_argument("--lobes", type=_counts, default=[6], help="of each BRDF: 6, or several as 3,6,12 (default 6)")
    parser.add_argument(
        "--bounces", type=bounces, metavar="N", default=0, help='of light between parts, or "all" (default 0)'
    )
    parser.add_argument("--ground", action="store_true", help="stand the scene on a diffuse ground plane")
    parser.add_argument("--output", type=Path, help="folder that keeps what was precomputed, for later runs")
    parser.add_argument("--export", type=Path, metavar="HTML", help="write a page that needs no Python, and end")
    parser.add_argument("--port", type=int, default=0, help="of this machine (default: a free one)")
    parser.add_argument("--no-browser", dest="browser", action="store_false", help="only print the address")
    return parser


def bounces(text: str) -> int | str:
    """How many times light is reflected: a whole number, or "all"."""
    if text != "all" and not text.isdecimal():
        raise argparse.ArgumentTypeError(f'must be a whole number of at least 0, or "all", got {text!r}')
    return text if text == "all" else int(text)


def _counts(text: str) -> list[int]:
    """Numbers with commas between them."""
    try:
        return list(dict.fromkeys(int(each) for each in text.split(",")))
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be a whole number, or several as 3,6,12, got {text!r}") from None


def ready(options: argparse.Namespace) -> tuple[dict[str, RelitScene], dict[str, Environment]]:
    """The scene of the options, made ready by each system, and its lights."""
    if not all(1 <= each <= 64 for each in options.lobes):
        raise ValueError(f"--lobes must be from 1 to 64, got {', '.join(map(str, options.lobes))}")
    if not 0 <= options.port < 2**16:
        raise ValueError(f"--port must be from 0 to 65535, got {options.port}")
    scene, lights = _scene(options), _lights(options.files)
    recipes: list[tuple[str, str, Recipe]] = [("lobe", f"{count} lobes", Lobes(count)) for count in options.lobes]
    recipes.append(("harmonic", "harmonics", Harmonics(laplacian=0.4)))
    made = {
        name: prt.precompute(
            scene,
            system=recipe,
            bounces=options.bounces,
            roughness=_ROUGHNESS,
            path=None if options.output is None else options.output / system,  # what lobes of any number share
            progress=sys.stderr.isatty(),
        )
        for system, name, recipe in recipes
        if system in options.system
    }
    return made, lights


def _scene(options: argparse.Namespace) -> Scene:
    meshes = [path for path in options.files if path.suffix.lower() not in _LIGHTS]
    if not meshes:
        if options.ground:
            raise ValueError("--ground needs a mesh: the embedded scene has a board")
        return embedded()
    loaded = [prt.load_scene(path) for path in meshes]
    parts = [_playable(part) for scene in loaded for part in scene.parts]
    names = numbered([part.name for part in parts])
    parts = [dataclasses.replace(part, name=name) for name, part in zip(names, parts, strict=True)]
    if options.ground:
        parts.append(Part("ground", ground_plane(Scene(parts).mesh), _matte(0.5)))
    return Scene(parts, cameras=loaded[0].cameras)


def embedded() -> Scene:
    """Chess pieces of plastic on a board."""
    pieces, light, dark = split(builtin.chess())
    return Scene(
        [
            Part("pieces", pieces, _PLASTIC),
            Part("light squares", light, _matte((0.6, 0.55, 0.45))),
            Part("dark squares", dark, _matte((0.12, 0.08, 0.06))),
        ]
    )


def _playable(part: Part) -> Part:
    """A part without a material of its own is plastic, so that there is something to play with."""
    return dataclasses.replace(part, material=_PLASTIC) if eqx.tree_equal(part.material, _matte(0.5)) else part


def _matte(color: float | tuple[float, ...]) -> TexturedMaterial:
    return TexturedMaterial(base_color=color, metallic=0.0, specular=0.0)


def _lights(files: Sequence[Path]) -> dict[str, Environment]:
    found = [path for path in files if path.suffix.lower() in _LIGHTS]
    if not found:
        return {"daylight": builtin.daylight(), "studio": builtin.studio()}
    names = numbered([path.stem for path in found])
    return {name: prt.load_environment(path) for name, path in zip(names, found, strict=True)}
