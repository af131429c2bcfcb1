"""The command `jaxprt view`: shows scenes in the interactive viewer in a browser."""

import errno
import sys
import threading
import time
import webbrowser
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace

import click

from jaxprt.cli import inputs, options
from jaxprt.relit import RelitScene
from jaxprt.relit.build import precompute
from jaxprt.view import serve
from jaxprt.view.progress import COMPILING
from jaxprt.view.server import Server
from jaxprt.view.session import Session
from jaxprt.view.unshadowed import Unshadowed

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
_PREVIEW, _DIVISION, _RAYS, _COMPILING = ("preview", 0.05), ("refine", 0.3), ("visibility", 1.0), 0.3
_REFLECTION = (("response", 0.1), ("patches", 0.2), ("bounce", 0.3))


@options.command(
    "view",
    options.FILES,
    Scene=options.SCENE,
    Light=options.LIGHT,
    System=[
        options.systems(("lobe", "harmonic", "dynamic"), "One, or several to switch by a key."),
        options.NO_BOUNCES,
    ],
    Sizes=options.FEW_SIZES,
    Output=[options.folder("Folder that keeps precomputed data for later runs.")],
    Viewer=[
        *options.options_of(serve, port=options.Range(0, 65535), address=str),
        {"no_browser": (bool,)},
    ],
)
def command(chosen: SimpleNamespace) -> None:
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

    Options:
        no_browser: Print the address without opening a browser.
    """  # noqa: D301
    options.make_folder(chosen.output)
    options.call(inputs.check, chosen)
    session = Session()
    try:
        server = Server(session, port=chosen.port, address=chosen.address)
    except ValueError as error:
        raise ValueError(f"--address: {error}") from error
    except OSError as error:
        why = {errno.EADDRINUSE: "another program uses it", errno.EACCES: "only the administrator may use it"}
        reason = f"{why.get(error.errno or 0, error.strerror)}; without --port a free one is taken"
        raise ValueError(f"--port must be free, got {chosen.port}: {reason}") from error
    through = "" if chosen.address is None else f" through port {server.port} of this machine"
    click.echo(f"jaxprt: {server.url} shows the scene{through}; Ctrl-C ends it")
    sys.stdout.flush()
    if not chosen.no_browser and chosen.address is None:  # a browser at another address is on another machine
        threading.Thread(target=webbrowser.open, args=(server.url,), daemon=True).start()
    reset = {"output": None, "brdf": None, "material": ()}  # what belongs to the files of the command

    def opener(paths: Sequence[Path]) -> None:
        files = [path for path in paths if inputs.kind(path)]  # others belong to them
        prepare(session, SimpleNamespace(**vars(chosen) | reset | {"files": files}))

    session.opener = opener
    session.prepare(lambda: prepare(session, chosen))
    ready = False
    try:
        session.progress.wait(patience=0.0 if chosen.no_browser else _OPENING)
        ready = True
        server.wait()
    except KeyboardInterrupt:
        if not ready:
            raise
    finally:
        server.close(patience=_PATIENCE)


def _reporter(session: Session) -> Callable[[str, float | None], None]:
    """A function that tells the page and the terminal what is done, and which share of it if that is known."""
    told = ""

    def report(label: str, share: float | None) -> None:
        nonlocal told
        stage = _STAGES.get(label) or _STAGES.get(label.split()[0], label)
        session.report(stage, share)
        if stage != told:
            told = stage
            click.echo(f"jaxprt: {stage}", err=True)

    return report


def prepare(session: Session, chosen: SimpleNamespace) -> None:
    """Reads files and precomputes their scene by each system, while the session shows what there is so far."""
    report, began = _reporter(session), time.perf_counter()
    report(f"reading {', '.join(path.name for path in chosen.files) or 'the embedded scene'}", None)
    # `precompute` divides the meshes, after a preview without division.
    scene = options.call(inputs.scene, chosen, refine=False, playable=True)
    # A scene that is opened later has the lights that are there.
    lights = dict(zip(session.stages.name, session.stages.lights, strict=True)) if session.version else None
    environments = lights or options.call(inputs.lights, chosen)
    refine = bool(inputs.split_files(chosen.files)[0]) and chosen.refine
    recipes = {
        {"lobe": f"{getattr(recipe, 'lobes', 0)} lobes", "harmonic": "harmonics"}.get(system, name): (system, recipe)
        for system in chosen.system
        for name, recipe in options.recipes(system, chosen).items()
    }
    session.progress.plan(_stages(len(recipes), refine=bool(refine), bounces=bool(chosen.bounces)))
    report("evaluating materials", None)
    first, (_, recipe) = next(iter(recipes.items()))
    session.show_unshadowed(Unshadowed.of(scene, recipe), name=first, environments=environments)
    size = next(iter(environments.values())).radiance.shape[-2]
    wanted = {"bounces": chosen.bounces, "size": size, "refine": refine}
    systems: dict[str, RelitScene] = {}
    for title, (system, recipe) in recipes.items():
        # A folder is shared by systems with any number of lobes.
        path = chosen.output and chosen.output / system
        preview = None if systems else lambda relit: session.show({first: relit}, preview=True)
        systems[title] = precompute(scene, system=recipe, path=path, preview=preview, progress=report, **wanted)
        # The lights are those of the session, because files may have been dropped on it.
        session.show(systems, preview=len(systems) < len(recipes))
    vertices = len(next(iter(systems.values())).mesh.position)
    click.echo(f"jaxprt: ready after {time.perf_counter() - began:.1f} s, {vertices:,} vertices", err=True)


def _stages(systems: int, *, refine: bool, bounces: bool) -> list[tuple[str, float]]:
    """The stages of `prepare`, each with its part of the time. The first system has previews."""
    system = [*([_DIVISION] if refine else ()), _RAYS, *(_REFLECTION if bounces else ())]
    first = [_PREVIEW, *([_DIVISION, _PREVIEW] if refine else ()), *system[bool(refine) :]]
    stages = [*first, *(systems - 1) * system]
    return [*((_STAGES[name], part) for name, part in stages), (COMPILING, _COMPILING)]
