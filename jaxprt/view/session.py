"""Answers the messages of a viewer."""

import contextlib
import dataclasses
import os
import pathlib
import re
import tempfile
import threading
import time
import zlib
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from jaxprt import files, require
from jaxprt.image import display, render, sky
from jaxprt.image.pixels import seen_from_front
from jaxprt.image.tonemap import TONES
from jaxprt.relit import exact
from jaxprt.relit.channels import of_part
from jaxprt.relit.measuring import lights_of
from jaxprt.relit.scene import RelitScene
from jaxprt.scene import Environment, load_environment, sides
from jaxprt.scene.mesh import bounds
from jaxprt.systems import protocol
from jaxprt.view import messages, stages
from jaxprt.view.content import light_texels, mip_edges, page_content, unshadowed_content
from jaxprt.view.gltf import export_gltf
from jaxprt.view.messages import Lamp, Look, Message, Reply
from jaxprt.view.progress import COMPILING, EndedError, Progress
from jaxprt.view.reduced import PageScene
from jaxprt.view.stages import Stages
from jaxprt.view.unshadowed import Unshadowed

_LARGEST = 2048.0  # most pixels along an edge of a picture
_PICTURE = 480, 360  # columns and rows of the picture that a saved notebook keeps
_PIXELS = 400  # pixels of a picture at which the exact sum is compared
_COARSE = {"still": 2, "exact": 4}  # downscaling factor of coarse pictures
_LARGEST_FILE = 8192.0  # most pixels along an edge of a picture that is saved
_MOST_PIXELS = 1 << 24  # of a picture that is saved
_FINE_PIXELS = 1 << 22  # up to which such a picture has 16 samples a pixel in place of 4
_SKY_ROWS = 2048.0  # most rows of the picture of a light
_VIEWERS = 64  # most viewers whose newest look is remembered
_WORKER = "jaxprt-prepare"  # name of threads that prepare
_LONGEST = 1000  # characters of a file's name, with its folders
_YIELD = 0.5  # most seconds for which each step of what is prepared waits for answers


class _LateError(Exception):
    """The viewer that requested a picture has sent a newer look."""


class _Version(NamedTuple):
    """A scene that a session shows."""

    number: int  # of scenes that the session has shown, this one included
    stages: Stages  # lights, materials and views of the scene
    preview: bool  # whether a better scene follows


class Session:
    """State of the viewer and its answers to messages, for notebooks and browsers alike.

    There is no queue, because the browser requests one look at a time. Looks are answered while full-quality pictures
    are being computed. A picture is abandoned between two of its steps when the same viewer has sent a newer look.
    Between two steps of what is prepared, answers come first.

    A session may start without a scene: `prepare` computes scenes in a thread, the page shows what is being done, and
    `show` replaces the scene by a better one, while camera, light and materials stay.

    Attributes:
        progress: What is being prepared.
        opener: Function that computes the scene of files, with `report` and `show`; None if pages open no files.
    """

    def __init__(
        self,
        systems: RelitScene | Mapping[str, RelitScene] | None = None,
        *,
        environments: Mapping[str, Environment] | None = None,
    ):
        """Starts with a scene, or without one for `prepare`.

        Args:
            systems: A relit scene, or a dictionary from names to several systems of one scene; None for none yet.
            environments: Dictionary from names to lights; the scene's own or the two embedded ones if None.

        Raises:
            TypeError: `show` says when.
            ValueError: `show` says when.
        """
        self.progress, self.opener = Progress(), None
        self._worker, self._scenes = None, 0  # the thread that prepares, and the number of scenes that were opened
        self._lock = threading.Lock()
        self._quiet, self._answering = threading.Condition(), 0
        self._newest: OrderedDict[str, int] = OrderedDict()  # sequence number of the newest look of each viewer
        self._ended = False
        self._version: _Version | None = None
        self._size = _PICTURE  # columns and rows of the pictures of the page
        if systems is not None:
            self.show(systems, environments=environments)
            self.progress.finish()

    opener: Callable[[Sequence[pathlib.Path]], None] | None
    _worker: threading.Thread | None

    @property
    def stages(self) -> Stages:
        """Lights, materials and views of the scene that is shown."""
        return self._shown().stages

    @property
    def version(self) -> int:
        """Number of scenes that the session has shown, each better than the one before."""
        return 0 if self._version is None else self._version.number

    def _shown(self) -> _Version:
        if self._version is None:
            raise ValueError("the viewer must have a scene, and is still preparing it")
        return self._version

    def show(
        self,
        systems: RelitScene | Mapping[str, RelitScene],
        *,
        environments: Mapping[str, Environment] | None = None,
        preview: bool = False,
    ) -> None:
        """Shows a scene in place of the one before. All systems must have the same scene and all lights the same size.

        Args:
            systems: A relit scene, or a dictionary from names to several systems of one scene.
            environments: Dictionary from names to lights. If None, the lights of the scene before, with those that were
                dropped on the viewer; for the first scene its own lights, or the two embedded ones.
            preview: Whether a better scene follows. A preview has no full-quality pictures.

        Raises:
            TypeError: A system is not a relit scene, or a light is not an `Environment`.
            ValueError: There is no system or light, the scenes differ, the lights have different sizes, or one is a
                batch or of a size that a system does not take.
        """
        if not isinstance(systems, RelitScene | Mapping):
            require.kind("the scene", systems, RelitScene, source="jaxprt.precompute")
        if environments is not None and not isinstance(environments, Mapping):
            got = require.shown(environments)
            raise TypeError(f"environments must be a dictionary from names to lights, got {got}")
        by_name = {"system": systems} if isinstance(systems, RelitScene) else dict(systems)
        if not by_name:
            raise ValueError("a viewer must have a system, got none")
        for name, system in by_name.items():
            require.kind(f"the system {name!r}", system, RelitScene, source="jaxprt.precompute")
        scene = next(iter(by_name.values()))
        shape = [(part.name, part.mesh.position.shape) for part in scene.scene.parts]
        for name, system in by_name.items():
            if [(part.name, part.mesh.position.shape) for part in system.scene.parts] != shape:
                raise ValueError(f"systems must be of the same scene, got another scene for {name!r}")
        lights = environments
        if lights is None and self._version is None:
            lights = {f"light {number}": light for number, light in enumerate(lights_of(scene.scene), 1)}
        if lights is not None:
            _check_lights(lights)
        self._replace(by_name, lights, preview=preview)

    def show_unshadowed(self, scene: Unshadowed, *, name: str, environments: Mapping[str, Environment]) -> None:
        """Shows another scene before its rays are traced. A page can show it if its GPU shades pixels.

        Args:
            scene: The scene.
            name: Name of the first system that it will have.
            environments: Dictionary from names to lights.
        """
        _check_lights(environments)
        self._replace({name: scene}, environments, preview=True, another=True)

    def _replace(
        self,
        systems: Mapping[str, RelitScene | Unshadowed],
        environments: Mapping[str, Environment] | None,
        *,
        preview: bool,
        another: bool = False,
    ) -> None:
        new = Stages(systems, environments or {})
        with self._lock:
            if self._superseded:
                raise EndedError
            self._scenes += another
            old = self._version
            if environments is None and old is not None:
                new.name, new.lights = old.stages.name, old.stages.lights
            for system in new.systems.values():
                for light in new.lights if isinstance(system, RelitScene) else ():
                    protocol.light_for(system, light)
            self._version = _Version(1 if old is None else old.number + 1, new, preview)

    def prepare(self, make: Callable[[], None]) -> None:
        """Computes the scene in a thread. Programs that the first changes need are compiled after it.

        Args:
            make: Function that calls `report` and `show`. An error that it raises is told to the page, and `wait`
                raises it.
        """
        progress = self.progress
        self._worker = threading.Thread(target=self._prepare, args=(make, progress), name=_WORKER, daemon=True)
        self._worker.start()

    def _prepare(self, make: Callable[[], None], progress: Progress) -> None:
        try:
            make()
            progress.prepared()
            for share in self.stages.rehearsal(*self._size) if self.version else ():
                self.report(COMPILING, share)
        except EndedError:
            pass
        except BaseException as error:
            progress.fail(error)
        progress.finish()

    @property
    def _superseded(self) -> bool:
        """Whether this thread prepares a scene in whose place another one has been opened."""
        thread = threading.current_thread()
        return thread.name == _WORKER and thread is not self._worker

    def report(self, stage: str, share: float | None) -> None:
        """Tells the page what is being done, and which share of it is done; None if nobody knows.

        Raises:
            EndedError: The session has ended.
        """
        if not self._superseded:
            self.progress.report(stage, share)
        with self._quiet:
            self._quiet.wait_for(lambda: self._ended or not self._answering, _YIELD)
        if self._ended or self._superseded:
            raise EndedError

    def end(self) -> None:
        """Abandons what is being computed, because nobody waits for it any more."""
        self._ended = True

    def answer(self, message: Message, buffers: Sequence[bytes] = ()) -> Reply:
        """Answers a message of the browser. The answer to an invalid message states the error."""
        kinds: dict[str, Callable[[Message, Sequence[bytes]], Reply]] = {
            "scene": self._scene,
            "look": self._look,
            "still": self._still,
            "exact": self._exact,
            "picture": self._picture,
            "glb": self._glb,
            "sky": self._sky,
            "drop": self._drop,
            "open": self._open,
            "lights": self._lights,
            "page": self._page,
            "progress": self._progress,
        }
        kind = message.get("kind")
        kind = kind if isinstance(kind, str) else type(kind).__name__
        try:
            if kind not in kinds:
                raise ValueError(f"the kind of a message must be one of {', '.join(kinds)}, got {kind[:80]!r}")
            with self._answered():
                return kinds[kind](message, buffers)
        except _LateError:
            return Reply({"kind": "late", "seq": message.get("seq")}, [])
        except (ValueError, TypeError, OSError, MemoryError) as error:
            return Reply({"kind": "error", "of": kind, "message": str(error)}, [])
        except Exception as error:  # a fault of the viewer: its page tells the user, and goes on
            return Reply({"kind": "error", "of": kind, "message": f"{type(error).__name__}: {error}"}, [])

    @contextlib.contextmanager
    def _answered(self) -> Iterator[None]:
        """Counts the messages that are being answered."""
        with self._quiet:
            self._answering += 1
        try:
            yield
        finally:
            with self._quiet:
                self._answering -= 1
                self._quiet.notify_all()

    def picture(self) -> Float[np.ndarray, "h w 3"]:
        """The first picture of the viewer, from vertex radiance, encoded for display."""
        scene = stages.relit(self.stages.scene)
        camera = dataclasses.replace(scene.camera, width=_PICTURE[0], height=_PICTURE[1])
        color = scene.radiance(self.stages.lights[0], eye=camera.eye)
        behind = sky(self.stages.lights[0], camera)
        mesh = seen_from_front(scene.mesh, camera, _hidden_faces(scene))
        return np.asarray(display(render(mesh, color, camera, background=behind)))

    def sky(self, number: int, lamps: tuple[Lamp, ...] = (), *, rows: int) -> Reply:
        """Pictures of a light before rotation, as `Stages.sky` makes them, in half floats one after another."""
        levels = self.stages.sky(number, lamps, rows=rows)
        height, width, _ = levels[0].shape
        data, scale = messages.encode(np.concatenate([level.reshape(-1, 3) for level in levels]), stops=None)
        return Reply({"kind": "sky", "scale": scale, "width": width, "height": height, "levels": len(levels)}, [data])

    def _progress(self, message: Message, buffers: Sequence[bytes]) -> Reply:
        """What is being prepared, and the numbers of scenes so far and of lights, by which pages see what is new."""
        # A page says how large its pictures are, so that their programs can be compiled ahead.
        if "width" in message:
            self._size = _size(message)[:2]
        lights = 0 if self._version is None else len(self.stages.name)
        return Reply(self.progress.content() | {"version": self.version, "lights": lights}, [])

    def _scene(self, message: Message, buffers: Sequence[bytes]) -> Reply:
        if self._version is None:
            return self._progress(message, buffers)
        number, shown, preview = self._version
        scene = shown.scene
        mesh, low, high = scene.mesh, *bounds(scene.mesh)
        parts = [
            {"name": part.name, "vertices": len(part.mesh.position), "free": stages.freedom(shading, part.material)}
            for part, shading in zip(scene.scene.parts, scene.shading, strict=True)
        ]
        camera = scene.camera
        content = {
            "kind": "scene",
            "version": number,
            "scene": self._scenes,
            "finished": self.progress.finished,
            "parts": parts,
            "lights": shown.name,
            "systems": {name: {"bounces": system.bounces is not None} for name, system in shown.systems.items()},
            "rests": [] if preview else ["still", "exact", "picture"],
            "vertices": len(mesh.position),
            "triangles": len(mesh.face),
            "center": ((low + high) / 2).tolist(),
            "origin": list(shown.origin),
            "radius": float(np.linalg.norm(high - low) / 2) or 1.0,
            "eye": np.asarray(camera.eye, float).tolist(),
            "target": np.asarray(camera.target, float).tolist(),
            "field_of_view": float(camera.field_of_view),
        }
        hidden, face = _hidden_faces(scene), stages.counterclockwise(mesh)
        # Those with black backs come first: of the others the viewer draws no backs.
        content["backs"] = int(np.count_nonzero(~hidden))
        arrays = np.asarray(mesh.position, "<f4"), face[np.argsort(hidden, kind="stable")]
        return Reply(content, [array.tobytes() for array in arrays])

    def _page(self, message: Message, buffers: Sequence[bytes]) -> Reply:
        """What the browser's GPU shades pixels from, or why it cannot."""
        shown = self.stages
        name = messages.system(message, list(shown.systems))
        system: RelitScene | Unshadowed = shown.systems[name]
        try:
            if isinstance(system, Unshadowed):
                content, arrays = unshadowed_content(system.scene.parts, system.shading, shown.lights)
            else:
                content, arrays = page_content(PageScene.for_gpu(system), shown.lights)
        except ValueError as error:
            return Reply({"kind": "page", "system": name, "missing": str(error)}, [])
        return Reply(content | {"kind": "page", "system": name}, arrays)

    def _parse(self, message: Message) -> tuple[Stages, Look, int]:
        """The scene that is shown, the look of a message, and its number. It is late if the page has another scene."""
        shown = self._shown()
        if "version" in message and messages.number(message, "version", 0.0, 2.0**53) != shown.number:
            raise _LateError
        look = messages.look(message, systems=list(shown.stages.systems), lights=len(shown.stages.lights))
        return shown.stages, look, int(messages.number(message, "seq", 0.0, 2.0**53))

    def _look(self, message: Message, buffers: Sequence[bytes]) -> Reply:
        shown, look, seq = self._parse(message)
        viewer = _viewer(message)
        with self._lock:
            self._newest[viewer] = max(self._newest.pop(viewer, 0), seq)
            while len(self._newest) > _VIEWERS:
                self._newest.popitem(last=False)
        began = time.perf_counter()
        shown.light_side(look)
        lit = time.perf_counter()
        shown.view_side(look)
        viewed = time.perf_counter()
        color, which = shown.color(look), _which(message, look, shown)
        data, scale = messages.encode(
            color if which is None else color[which], stops=_stops(message), tone=_tone(message)
        )
        done = time.perf_counter()
        spent = {"light": lit - began, "view": viewed - lit, "combine": done - viewed}
        times = {name: 1000 * seconds for name, seconds in spent.items()}
        content = {"kind": "color", "seq": seq, "scale": scale, "ms": times}
        return Reply(content, [data] if which is None else [data, np.packbits(which).tobytes()])

    def _still(self, message: Message, buffers: Sequence[bytes]) -> Reply:
        shown, look, seq = self._parse(message)
        width, height, coarse = _size(message)
        began, between = time.perf_counter(), self._between(message, seq, shown)
        between()
        clear = messages.truth(message, "transparent")
        make = shown.cutout if clear else shown.picture
        picture = make(look, width, height, samples=1 if coarse else 4, between=between)
        data, scale = messages.encode(picture[..., :3], stops=_stops(message), tone=_tone(message))
        alpha = [_alpha(picture)] if clear else []
        spent = 1000 * (time.perf_counter() - began)
        size = {"width": width, "height": height}
        return Reply({"kind": "still", "seq": seq, "scale": scale, "ms": spent, **size}, [data, *alpha])

    def _exact(self, message: Message, buffers: Sequence[bytes]) -> Reply:
        """The exact picture under direct light of the environment, and the relit picture's error at some pixels."""
        shown, look, seq = self._parse(message)
        width, height, coarse = _size(message)
        between = self._between(message, seq, shown)
        between()
        scene, camera = shown.changed_scene(look), stages.camera(look, width, height)
        arguments = scene, [of_part(part) for part in scene.parts], [shown.environment(look)], camera
        told = {}
        if not coarse:
            pixels = exact.exact_pixels(*arguments, pixels=_PIXELS, between=between)
            error, spread = pixels.relative_l2(shown.direct_picture(look, width, height, between=between))
            told = {"error": error, "spread": spread} if np.isfinite([error, spread]).all() else {}
        truth = exact.exact_picture(*arguments, between=between)
        clear = messages.truth(message, "transparent")
        picture = stages.straight(truth.surface[0], truth.alpha[..., None]) if clear else truth.color[0]
        data, scale = messages.encode(picture[..., :3], stops=_stops(message), tone=_tone(message))
        size, alpha = {"width": truth.camera.width, "height": truth.camera.height}, [_alpha(picture)] if clear else []
        return Reply({"kind": "still", "seq": seq, "scale": scale, "exact": True, **told, **size}, [data, *alpha])

    def _picture(self, message: Message, buffers: Sequence[bytes]) -> Reply:
        """A PNG or EXR file of a picture of any size. Newer looks do not abandon it."""
        shown, look, _ = self._parse(message)
        width, height = (int(messages.number(message, key, 1.0, _LARGEST_FILE)) for key in ("width", "height"))
        if width * height > _MOST_PIXELS:
            raise ValueError(f"a picture must have at most {_MOST_PIXELS} pixels, got {width} x {height}")
        samples = 16 if width * height <= _FINE_PIXELS else 4
        if "samples" in message:
            samples = int(messages.number(message, "samples", 1.0, 16.0))
        options = {"samples": samples, "between": self._until_ended}
        clear = messages.truth(message, "transparent")
        picture = (shown.cutout if clear else shown.picture)(look, width, height, **options)
        color, alpha = picture[..., :3], picture[..., 3:]
        exposure = {"stops": _stops(message) or 0.0, "tone": _tone(message)}
        with tempfile.TemporaryDirectory() as folder:
            path = pathlib.Path(folder) / ("picture.exr" if _is_exr(message) else "picture.png")
            if _is_exr(message):  # colors of EXR files are multiplied by alpha
                files.write_exr(path, np.concatenate([color * alpha if clear else color, alpha], -1))
            else:
                files.write_png(path, np.concatenate([messages.displayed(color, **exposure), alpha], -1))
            return Reply({"kind": "picture", "width": width, "height": height}, [path.read_bytes()])

    def _glb(self, message: Message, buffers: Sequence[bytes]) -> Reply:
        """The scene with the materials of the look, as binary glTF."""
        shown, look, _ = self._parse(message)
        scene = shown.changed_scene(look)
        meshes = [dataclasses.replace(part.mesh, origin=shown.origin) for part in scene.parts]
        parts = [dataclasses.replace(part, mesh=mesh) for part, mesh in zip(scene.parts, meshes, strict=True)]
        changed = eqx.tree_at(lambda relit: relit.scene.parts, shown.system(look), parts)
        with tempfile.TemporaryDirectory() as folder:
            path = pathlib.Path(folder) / "scene.glb"
            export_gltf(changed, path, degree=None)
            return Reply({"kind": "glb"}, [path.read_bytes()])

    def _until_ended(self) -> None:
        if self._ended:
            raise _LateError

    def _sky(self, message: Message, buffers: Sequence[bytes]) -> Reply:
        """Pictures of a light before rotation, each of half as many rows as the one before."""
        _, look, seq = self._parse(message)
        rows = int(messages.number(message, "rows", 1.0, _SKY_ROWS)) if "rows" in message else 1
        reply = self.sky(look.light, look.lamps, rows=rows)
        return Reply(reply.content | {"seq": seq}, reply.buffers)

    def _drop(self, message: Message, buffers: Sequence[bytes]) -> Reply:
        """Adds a light from a file that was dropped on the viewer."""
        # Only a name, because browsers of Windows may send paths too.
        file = pathlib.PurePath(
            messages.text(message, "name").replace("\\", "/").replace("\0", "")[-100:] or "light.hdr"
        )
        suffix = file.suffix if re.fullmatch(r"\.\w{1,8}", file.suffix, re.ASCII) else ""
        if len(buffers) != 1 or not len(buffers[0]):
            raise ValueError(f"{file.name} must hold an environment, got no bytes")
        handle, path = tempfile.mkstemp(suffix=suffix)
        try:
            with os.fdopen(handle, "wb") as stream:
                stream.write(buffers[0])
            light = load_environment(path, size=self.stages.size)
        except (ValueError, OSError, MemoryError) as error:
            raise ValueError(str(error).replace(path, file.name)) from None
        finally:
            os.unlink(path)
        with self._lock:
            self.stages.lights.append(light)
            self.stages.name.append(file.stem)
            first = len(self.stages.name) - 1
        return self._lights({"first": first}, [])

    def _open(self, message: Message, buffers: Sequence[bytes]) -> Reply:
        """Prepares the scene of files that were dropped on the viewer, in place of the one that is shown."""
        names, opener = message.get("names"), self.opener
        if opener is None:
            raise ValueError("this viewer shows the scene of a program; `jaxprt view` opens files")
        if not isinstance(names, list) or len(names) != len(buffers) or not names:
            raise ValueError(f"names must be those of the {len(buffers)} files that came, at least one")
        paths = [_inside(name) for name in names]

        def make() -> None:
            with tempfile.TemporaryDirectory() as folder:
                places = [pathlib.Path(folder, *path.parts) for path in paths]
                for place, data in zip(places, buffers, strict=True):
                    place.parent.mkdir(parents=True, exist_ok=True)
                    place.write_bytes(data)
                try:
                    opener(places)
                except (ValueError, OSError) as error:
                    raise ValueError(str(error).replace(f"{folder}{os.sep}", "")) from None

        self.progress = Progress()
        self.prepare(make)
        return Reply({"kind": "open"}, [])

    def _lights(self, message: Message, buffers: Sequence[bytes]) -> Reply:
        """Names of all lights, and texels of those from a number on, `light`."""
        with self._lock:
            names, lights = list(self.stages.name), list(self.stages.lights)
        first, edge = int(messages.number(message, "first", 0.0, float(len(names)))), mip_edges(self.stages.size)[0]
        content = {"kind": "lights", "lights": names, "light": first}
        return Reply(content, [light_texels(light, edge) for light in lights[first : len(names)]])

    def _between(self, message: Message, seq: int, shown: Stages) -> Callable[[], None]:
        """A function to call between the steps of a picture. It raises if there is a newer look or a better scene."""
        viewer = _viewer(message)

        def between() -> None:
            with self._lock:
                late = self._ended or seq < self._newest.get(viewer, 0) or self.stages is not shown
            if late:
                raise _LateError

        return between


def _inside(name: object) -> pathlib.PurePosixPath:
    """The place of a dropped file in a folder of its own."""
    path = pathlib.PurePosixPath(str(name).replace("\\", "/").replace("\0", ""))
    if not isinstance(name, str) or not path.name or path.is_absolute() or ".." in path.parts or len(name) > _LONGEST:
        raise ValueError(f"names of files must be relative and without .., got {str(name)[:80]!r}")
    return path


def _alpha(picture: Float[np.ndarray, "h w 4"]) -> bytes:
    """The alpha of a picture in bytes, compressed."""
    return zlib.compress(np.round(255 * picture[..., 3]).astype(np.uint8).tobytes(), 1)


def _hidden_faces(scene: RelitScene | Unshadowed) -> Bool[np.ndarray, " f"]:
    """Triangles that cameras do not see from behind."""
    return sides.hidden_backs(scene.scene)[np.asarray(scene.mesh.region)[np.asarray(scene.mesh.face)[:, 0]]]


def _which(message: Message, look: Look, shown: Stages) -> Bool[np.ndarray, " v"] | None:
    """Mask of the vertices that a message requests: those that face the eye, or the others; None for all."""
    asked = message.get("vertices", "all")
    if asked not in ("all", "seen", "unseen"):
        raise ValueError(f"vertices must be all, seen or unseen, got {str(asked)[:80]!r}")
    if asked == "all":
        return None
    seen = shown.facing(look)
    return seen if asked == "seen" else ~seen


def _viewer(message: Message) -> str:
    """The name that a viewer has chosen. Each viewer numbers its own looks."""
    return messages.text(message, "viewer")[:64]


def _size(message: Message) -> tuple[int, int, bool]:
    """Width and height of the picture that a message requests, and whether it is a coarse one, which is smaller."""
    width, height = (int(messages.number(message, key, 1.0, _LARGEST)) for key in ("width", "height"))
    coarse = messages.truth(message, "coarse")
    step = _COARSE.get(message["kind"], 1) if coarse else 1
    return max(width // step, 1), max(height // step, 1), coarse


def _stops(message: Message) -> float | None:
    return None if message.get("stops") is None else messages.number(message, "stops", -60.0, 60.0)


def _is_exr(message: Message) -> bool:
    name = message.get("format", "png")
    if name not in ("png", "exr"):
        raise ValueError(f"the format must be png or exr, got {str(name)[:80]!r}")
    return name == "exr"


def _tone(message: Message) -> str:
    tone = message.get("tone", "srgb")
    if tone not in TONES:
        raise ValueError(f"tone must be one of {', '.join(TONES)}, got {str(tone)[:80]!r}")
    return tone


def _check_lights(lights: Mapping[str, Environment]) -> None:
    if not lights:
        raise ValueError("a viewer must have a light, got none")
    for name, light in lights.items():
        require.kind(f"the light {name!r}", light, Environment, source="jaxprt.load_environment")
        require.colors(f"the light {name!r}", light.radiance)
        if light.radiance.ndim != 4:
            raise ValueError(f"the light {name!r} must be one light, [6, n, n, c], got {list(light.radiance.shape)}")
    sizes = {light.radiance.shape[-2] for light in lights.values()}
    if len(sizes) > 1:
        raise ValueError(f"lights must be of one size, got faces of {', '.join(map(str, sorted(sizes)))} texels")
