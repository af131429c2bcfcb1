"""The command `jaxprt view`: shows scenes in the interactive viewer in a browser."""

import errno
import socket
import sys
import threading
import time
import webbrowser
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click

from jaxprt.cli import inputs, options, relight
from jaxprt.cli.options import option
from jaxprt.relit import RelitScene
from jaxprt.relit.build import precompute
from jaxprt.scene import Environment, Scene
from jaxprt.view.progress import COMPILING
from jaxprt.view.server import Server, parse
from jaxprt.view.session import Session
from jaxprt.view.unshadowed import Unshadowed

LOBES = 8  # the smallest number whose tables are shipped; fewer lobes take less time per look
_PATIENCE = 0.5  # seconds; `jaxprt.cli.main.run` ends a process whose threads still compute
_OPENING = 5.0  # most seconds in which a browser that was opened can still learn of an error
# What the names of the work of `jaxprt.precompute` mean.
_STAGES = {
    "refine": "dividing the meshes where shadows are fine",
    "preview": "tracing rays for a preview",
    "visibility": "tracing rays",
    "lamps": "tracing rays to lamps",
    "compress": "compressing what the rays have seen",
    "response": "computing what surfaces reflect",
    "patches": "tracing light between surfaces",
    "bounce": "tracing the first bounce",
    "bounce 2": "tracing the second bounce",
}
# Parts of the time that stages take, roughly: those before the rays of a system, and after them.
_PREVIEW, _DIVISION, _RAYS, _COMPILING = 0.05, 0.3, 1.0, 0.3
_REFLECTION = (("response", 0.1), ("patches", 0.2), ("bounce", 0.3))


@click.command(cls=options.Command, short_help="Show a scene in the interactive viewer in a browser.")
@options.scene
@options.light
@options.systems(
    ("lobe", "harmonic", "dynamic"), default="lobe", words="One, or several to switch by a key.  [default: lobe]"
)
@options.no_bounces
@options.few_sizes
@options.folder("Folder that keeps precomputed data for later runs.")
@option(
    "--port",
    group="Viewer",
    type=options.Whole(0, 65535),
    default=0,
    help="Port of this machine.  [default: a free one]",
)
@option(
    "--address",
    group="Viewer",
    metavar="URL",
    help="Address by which the browser comes, through a tunnel or a proxy.  [default: that of this machine]",
)
@option(
    "--no-browser",
    "browser",
    group="Viewer",
    is_flag=True,
    flag_value=False,
    default=True,
    help="Print the address without opening a browser.",
)
def command(**arguments: Any) -> None:
    """Show a scene in the interactive viewer in a browser.

    FILEs are meshes, scenes and environments in any order. Without files there is an embedded scene with embedded
    lights. Parts without a material become red plastic. Ctrl-C ends the viewer.

    \b
    Examples:
      jaxprt view
      jaxprt view scene.glb grace.hdr --output kept
      jaxprt view bunny.ply --ground --system lobe,harmonic --lobes 3,6,12 --bounces 1
      jaxprt view bunny.ply --brdf metallic-roughness:base_color=.9/.6/.2,roughness=.3 --port 8080 --no-browser
      jaxprt view scene.glb --port 8765 --address http://localhost:9000
    """  # noqa: D301
    check_port(arguments["port"])
    check_address(arguments["address"])
    if arguments["output"] is not None:
        relight.make_folder(arguments["output"])
    chosen, session = SimpleNamespace(**arguments), Session()
    inputs.check(chosen)
    server = _serve(session, chosen.port, chosen.address)
    way = "" if arguments["address"] is None else f" through port {server.port} of this machine"
    click.echo(f"jaxprt: {server.url} shows the scene{way}; Ctrl-C ends it")
    sys.stdout.flush()
    if arguments["browser"] and arguments["address"] is None:  # a browser at another address is on another machine
        threading.Thread(target=webbrowser.open, args=(server.url,), daemon=True).start()
    session.prepare(lambda: prepare(session, chosen))
    ready = False
    try:
        session.progress.wait(patience=_OPENING if arguments["browser"] else 0.0)
        ready = True
        server.wait()
    except KeyboardInterrupt:
        if not ready:
            raise
    finally:
        server.close(patience=_PATIENCE)


def parse_options(arguments: Sequence[str]) -> SimpleNamespace:
    """Parses arguments into options."""
    return SimpleNamespace(**command.make_context("view", list(arguments)).params)


def check_port(port: int) -> None:
    """Refuses a port that cannot be used, before anything is computed."""
    if port:
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as attempt:
            attempt.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # the same option that servers set
            try:
                attempt.bind(("127.0.0.1", port))
            except OSError as error:
                raise _no_port(port, error) from error


def check_address(address: str | None) -> None:
    """Refuses an address that no browser can come by, before anything is computed."""
    if address is not None:
        try:
            parse(address)
        except ValueError as error:
            raise ValueError(f"--address: {error}") from error


def _no_port(port: int, error: OSError) -> ValueError:
    why = {errno.EADDRINUSE: "another program uses it", errno.EACCES: "only the administrator may use it"}
    reason = why.get(error.errno or 0, error.strerror)
    return ValueError(f"--port must be free, got {port}: {reason}; without --port a free one is taken")


def _serve(session: Session, port: int, address: str | None) -> Server:
    try:
        return Server(session, port=port, address=address)
    except OSError as error:
        raise _no_port(port, error) from error


class Report:
    """Tells the page and the terminal what is being done: a line for each stage."""

    def __init__(self, session: Session):
        self._session, self._stage = session, ""

    def __call__(self, label: str, share: float | None) -> None:
        """Tells which share of a stage is done, from 0 to 1; None if nobody knows."""
        stage = _STAGES.get(label) or _STAGES.get(label.split()[0], label)
        self._session.report(stage, share)
        if stage != self._stage:
            self._stage = stage
            click.echo(f"jaxprt: {stage}", err=True)


def prepare(session: Session, chosen: SimpleNamespace) -> None:
    """Reads files and precomputes their scene by each system, while the session shows what there is so far."""
    report, began = Report(session), time.perf_counter()
    report(f"reading {', '.join(path.name for path in chosen.files) or 'the embedded scene'}", None)
    # `precompute` divides the meshes, after a preview without division.
    scene = inputs.scene(SimpleNamespace(**vars(chosen) | {"refine": False}), playable=True)
    lights = inputs.lights(chosen)
    refine = bool(inputs.split_files(chosen.files)[0]) and chosen.refine
    recipes = {
        {"lobe": f"{getattr(recipe, 'lobes', 0)} lobes", "harmonic": "harmonics"}.get(system, name): (system, recipe)
        for system in chosen.system
        for name, recipe in options.recipes(system, chosen, lobes=LOBES).items()
    }
    session.progress.plan(_way(len(recipes), refine=bool(refine), bounces=bool(chosen.bounces)))
    report("evaluating materials", None)
    first, (_, recipe) = next(iter(recipes.items()))
    session.show_unshadowed(Unshadowed.of(scene, recipe), name=first, environments=lights)
    systems: dict[str, RelitScene] = {}
    for title, (system, recipe) in recipes.items():

        def preview(relit: RelitScene, title: str = title) -> None:
            session.show({title: relit}, preview=True)

        # A folder is shared by systems with any number of lobes.
        path = None if chosen.output is None else chosen.output / system
        options_ = {"refine": refine, "preview": None if systems else preview, "progress": report}
        systems[title] = precompute_scene(scene, lights, recipe, chosen.bounces, path, **options_)
        # The lights are those of the session, because files may have been dropped on it.
        session.show(systems, preview=len(systems) < len(recipes))
    vertices = len(next(iter(systems.values())).mesh.position)
    click.echo(f"jaxprt: ready after {time.perf_counter() - began:.1f} s, {vertices:,} vertices", err=True)


def _way(systems: int, *, refine: bool, bounces: bool) -> list[tuple[str, float]]:
    """The stages of `prepare`, each with its part of the time. The first system has previews."""
    stages = []
    for number in range(systems):
        preview = [("preview", _PREVIEW)] if number == 0 else []
        division = [("refine", _DIVISION), *preview] if refine else []
        stages += [*preview, *division, ("visibility", _RAYS), *(_REFLECTION if bounces else ())]
    return [*((_STAGES[name], part) for name, part in stages), (COMPILING, _COMPILING)]


def precompute_scene(
    scene: Scene, lights: dict[str, Environment], recipe: Any, bounces: int | str, path: Path | None, **more: Any
) -> RelitScene:
    """The scene, precomputed by one recipe. Its meshes are not divided, unless `refine` says so."""
    size = next(iter(lights.values())).radiance.shape[-2]
    chosen = {"refine": False, "progress": sys.stderr.isatty(), **more}
    return precompute(scene, system=recipe, bounces=bounces, size=size, path=path, **chosen)
