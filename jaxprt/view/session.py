"""Answers the messages of a viewer."""

import dataclasses
import os
import pathlib
import re
import tempfile
import threading
import time
import zlib
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from typing import Any

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
from jaxprt.view import messages, stages
from jaxprt.view.content import light_texels, mip_edges, page_content
from jaxprt.view.messages import Lamp, Look, Reply
from jaxprt.view.reduced import PageScene
from jaxprt.view.stages import Stages

_LARGEST = 2048.0  # most pixels along an edge of a picture
_PICTURE = 480, 360  # columns and rows of the picture that a saved notebook keeps
_PIXELS = 400  # pixels of a picture at which the exact sum is compared
_COARSE = {"still": 2, "exact": 4}  # downscaling factor of coarse pictures
_LARGEST_FILE = 8192.0  # most pixels along an edge of a picture that is saved
_MOST_PIXELS = 1 << 24  # of a picture that is saved
_FINE_PIXELS = 1 << 22  # up to which such a picture has 16 samples a pixel in place of 4
_SKY_ROWS = 2048.0  # most rows of the picture of a light
_VIEWERS = 64  # most viewers whose newest look is remembered


class _LateError(Exception):
    """The viewer that requested a picture has sent a newer look."""


class Session:
    """State of the viewer and its answers to messages, for notebooks and browsers alike.

    There is no queue, because the browser requests one look at a time. Looks are answered while full-quality pictures
    are being computed. A picture is abandoned between two of its steps when the same viewer has sent a newer look.

    Attributes:
        stages: Lights, materials and views.
    """

    def __init__(
        self, systems: RelitScene | Mapping[str, RelitScene], *, environments: Mapping[str, Environment] | None = None
    ):
        """Checks that all systems have the same scene and all lights the same size.

        Args:
            systems: A relit scene, or a dictionary from names to several systems of one scene.
            environments: Dictionary from names to lights; the scene's own or the two embedded ones if None.

        Raises:
            TypeError: A system is not a relit scene, or a light is not an `Environment`.
            ValueError: There is no system or light, the scenes differ, the lights have different sizes, or one is a
                batch.
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
        lights = _name_lights(lights_of(scene.scene)) if environments is None else dict(environments)
        _check_lights(lights)
        self.stages = Stages(by_name, lights)
        self._lock = threading.Lock()
        self._newest: OrderedDict[str, int] = OrderedDict()  # sequence number of the newest look of each viewer
        self._ended = False

    def end(self) -> None:
        """Abandons the pictures that are being computed, because nobody waits for them any more."""
        self._ended = True

    def answer(self, message: Mapping[str, Any], buffers: Sequence[bytes] = ()) -> Reply:
        """Answers a message of the browser. The answer to an invalid message states the error."""
        kinds: dict[str, Callable[[Mapping[str, Any], Sequence[bytes]], Reply]] = {
            "scene": self._scene,
            "look": self._look,
            "still": self._still,
            "exact": self._exact,
            "picture": self._picture,
            "sky": self._sky,
            "drop": self._drop,
            "page": self._page,
        }
        kind = message.get("kind")
        kind = kind if isinstance(kind, str) else type(kind).__name__
        try:
            if kind not in kinds:
                raise ValueError(f"the kind of a message must be one of {', '.join(kinds)}, got {kind[:80]!r}")
            return kinds[kind](message, buffers)
        except _LateError:
            return Reply({"kind": "late", "seq": message.get("seq")}, [])
        except (ValueError, TypeError, OSError, MemoryError) as error:
            return Reply({"kind": "error", "of": kind, "message": str(error)}, [])
        except Exception as error:  # a fault of the viewer: its page tells the user, and goes on
            return Reply({"kind": "error", "of": kind, "message": f"{type(error).__name__}: {error}"}, [])

    def picture(self) -> Float[np.ndarray, "h w 3"]:
        """The first picture of the viewer, from vertex radiance, encoded for display."""
        scene = self.stages.scene
        camera = dataclasses.replace(scene.camera, width=_PICTURE[0], height=_PICTURE[1])
        color = scene.radiance(self.stages.lights[0], eye=camera.eye)
        behind = sky(self.stages.lights[0], camera)
        mesh = seen_from_front(scene.mesh, camera, self._hidden_faces())
        return np.asarray(display(render(mesh, color, camera, background=behind)))

    def sky(self, number: int, lamps: tuple[Lamp, ...] = (), *, rows: int) -> Reply:
        """Pictures of a light before rotation, as `Stages.sky` makes them, in half floats one after another."""
        levels = self.stages.sky(number, lamps, rows=rows)
        height, width, _ = levels[0].shape
        data, scale = messages.encode(np.concatenate([level.reshape(-1, 3) for level in levels]), stops=None)
        return Reply({"kind": "sky", "scale": scale, "width": width, "height": height, "levels": len(levels)}, [data])

    def _hidden_faces(self) -> Bool[np.ndarray, " f"]:
        """Triangles that cameras do not see from behind."""
        mesh = self.stages.scene.mesh
        return sides.hidden_backs(self.stages.scene.scene)[np.asarray(mesh.region)[np.asarray(mesh.face)[:, 0]]]

    def _scene(self, message: Mapping[str, Any], buffers: Sequence[bytes]) -> Reply:
        scene = self.stages.scene
        mesh, low, high = scene.mesh, *bounds(scene.mesh)
        parts = [
            {"name": part.name, "vertices": len(part.mesh.position), "free": stages.freedom(shading, part.material)}
            for part, shading in zip(scene.scene.parts, scene.shading, strict=True)
        ]
        camera = scene.camera
        content = {
            "kind": "scene",
            "parts": parts,
            "lights": self.stages.name,
            "systems": {name: {"bounces": system.bounces is not None} for name, system in self.stages.systems.items()},
            "rests": ["still", "exact", "picture"],
            "vertices": len(mesh.position),
            "triangles": len(mesh.face),
            "center": ((low + high) / 2).tolist(),
            "radius": float(np.linalg.norm(high - low) / 2) or 1.0,
            "eye": np.asarray(camera.eye, float).tolist(),
            "target": np.asarray(camera.target, float).tolist(),
            "field_of_view": float(camera.field_of_view),
        }
        hidden, face = self._hidden_faces(), stages.counterclockwise(mesh)
        # Those with black backs come first: of the others the viewer draws no backs.
        content["backs"] = int(np.count_nonzero(~hidden))
        arrays = np.asarray(mesh.position, "<f4"), face[np.argsort(hidden, kind="stable")]
        return Reply(content, [array.tobytes() for array in arrays])

    def _page(self, message: Mapping[str, Any], buffers: Sequence[bytes]) -> Reply:
        """What the browser's GPU shades pixels from, or why it cannot."""
        name = messages.system(message, list(self.stages.systems))
        try:
            content, arrays = page_content(PageScene.for_gpu(self.stages.systems[name]), self.stages.lights)
        except ValueError as error:
            return Reply({"kind": "page", "system": name, "missing": str(error)}, [])
        return Reply(content | {"kind": "page", "system": name}, arrays)

    def _parse(self, message: Mapping[str, Any]) -> tuple[Look, int]:
        look = messages.look(message, systems=list(self.stages.systems), lights=len(self.stages.lights))
        return look, int(messages.number(message, "seq", 0.0, 2.0**53))

    def _look(self, message: Mapping[str, Any], buffers: Sequence[bytes]) -> Reply:
        look, seq = self._parse(message)
        viewer = _viewer(message)
        with self._lock:
            self._newest[viewer] = max(self._newest.pop(viewer, 0), seq)
            while len(self._newest) > _VIEWERS:
                self._newest.popitem(last=False)
        began = time.perf_counter()
        self.stages.light_side(look)
        lit = time.perf_counter()
        self.stages.view_side(look)
        viewed = time.perf_counter()
        color, which = self.stages.color(look), self._which(message, look)
        data, scale = messages.encode(
            color if which is None else color[which], stops=_stops(message), tone=_tone(message)
        )
        done = time.perf_counter()
        spent = {"light": lit - began, "view": viewed - lit, "combine": done - viewed}
        times = {name: 1000 * seconds for name, seconds in spent.items()}
        content = {"kind": "color", "seq": seq, "scale": scale, "ms": times}
        return Reply(content, [data] if which is None else [data, np.packbits(which).tobytes()])

    def _which(self, message: Mapping[str, Any], look: Look) -> Bool[np.ndarray, " v"] | None:
        """Mask of the vertices that a message requests: those that face the eye, or the others; None for all."""
        asked = message.get("vertices", "all")
        if asked not in ("all", "seen", "unseen"):
            raise ValueError(f"vertices must be all, seen or unseen, got {str(asked)[:80]!r}")
        if asked == "all":
            return None
        seen = self.stages.facing(look)
        return seen if asked == "seen" else ~seen

    def _still(self, message: Mapping[str, Any], buffers: Sequence[bytes]) -> Reply:
        look, seq = self._parse(message)
        width, height, coarse = _size(message)
        began, between = time.perf_counter(), self._between(message, seq)
        between()
        clear = messages.truth(message, "transparent")
        make = self.stages.cutout if clear else self.stages.picture
        picture = make(look, width, height, samples=1 if coarse else 4, between=between)
        data, scale = messages.encode(picture[..., :3], stops=_stops(message), tone=_tone(message))
        alpha = [zlib.compress(np.round(255 * picture[..., 3]).astype(np.uint8).tobytes(), 1)] if clear else []
        spent = 1000 * (time.perf_counter() - began)
        size = {"width": width, "height": height}
        return Reply({"kind": "still", "seq": seq, "scale": scale, "ms": spent, **size}, [data, *alpha])

    def _exact(self, message: Mapping[str, Any], buffers: Sequence[bytes]) -> Reply:
        """The exact picture under direct light of the environment, and the relit picture's error at some pixels."""
        look, seq = self._parse(message)
        width, height, coarse = _size(message)
        between = self._between(message, seq)
        between()
        scene, camera = self.stages.changed_scene(look), stages.camera(look, width, height)
        arguments = scene, [of_part(part) for part in scene.parts], [self.stages.environment(look)], camera
        told = {}
        if not coarse:
            pixels = exact.exact_pixels(*arguments, pixels=_PIXELS, between=between)
            error, spread = pixels.relative_l2(self.stages.direct_picture(look, width, height, between=between))
            told = {"error": error, "spread": spread} if np.isfinite([error, spread]).all() else {}
        truth = exact.exact_picture(*arguments, between=between)
        data, scale = messages.encode(truth.color[0], stops=_stops(message), tone=_tone(message))
        size = {"width": truth.camera.width, "height": truth.camera.height}
        return Reply({"kind": "still", "seq": seq, "scale": scale, "exact": True, **told, **size}, [data])

    def _picture(self, message: Mapping[str, Any], buffers: Sequence[bytes]) -> Reply:
        """A PNG file of a picture of any size. Newer looks do not abandon it."""
        look, _ = self._parse(message)
        width, height = (int(messages.number(message, key, 1.0, _LARGEST_FILE)) for key in ("width", "height"))
        if width * height > _MOST_PIXELS:
            raise ValueError(f"a picture must have at most {_MOST_PIXELS} pixels, got {width} x {height}")
        options = {"samples": 16 if width * height <= _FINE_PIXELS else 4, "between": self._until_ended}
        clear = messages.truth(message, "transparent")
        picture = (self.stages.cutout if clear else self.stages.picture)(look, width, height, **options)
        exposure = {"stops": _stops(message) or 0.0, "tone": _tone(message)}
        shown = [messages.displayed(picture[..., :3], **exposure), picture[..., 3:]]
        with tempfile.TemporaryDirectory() as folder:
            path = pathlib.Path(folder) / "picture.png"
            files.write_png(path, np.concatenate(shown, -1))
            return Reply({"kind": "picture", "width": width, "height": height}, [path.read_bytes()])

    def _until_ended(self) -> None:
        if self._ended:
            raise _LateError

    def _sky(self, message: Mapping[str, Any], buffers: Sequence[bytes]) -> Reply:
        """Pictures of a light before rotation, each of half as many rows as the one before."""
        look, seq = self._parse(message)
        rows = int(messages.number(message, "rows", 1.0, _SKY_ROWS)) if "rows" in message else 1
        reply = self.sky(look.light, look.lamps, rows=rows)
        return Reply(reply.content | {"seq": seq}, reply.buffers)

    def _drop(self, message: Mapping[str, Any], buffers: Sequence[bytes]) -> Reply:
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
            texels = light_texels(light, mip_edges(self.stages.size)[0])
            content = {"kind": "lights", "lights": list(self.stages.name), "light": len(self.stages.name) - 1}
            return Reply(content, [texels])

    def _between(self, message: Mapping[str, Any], seq: int) -> Callable[[], None]:
        """A function to call between the steps of a picture. It raises if the viewer has sent a newer look."""
        viewer = _viewer(message)

        def between() -> None:
            with self._lock:
                late = self._ended or seq < self._newest.get(viewer, 0)
            if late:
                raise _LateError

        return between


def _viewer(message: Mapping[str, Any]) -> str:
    """The name that a viewer has chosen. Each viewer numbers its own looks."""
    return messages.text(message, "viewer")[:64]


def _size(message: Mapping[str, Any]) -> tuple[int, int, bool]:
    """Width and height of the picture that a message requests, and whether it is a coarse one, which is smaller."""
    width, height = (int(messages.number(message, key, 1.0, _LARGEST)) for key in ("width", "height"))
    coarse = messages.truth(message, "coarse")
    step = _COARSE[message["kind"]] if coarse else 1
    return max(width // step, 1), max(height // step, 1), coarse


def _name_lights(lights: Sequence[Environment]) -> dict[str, Environment]:
    return {f"light {number}": light for number, light in enumerate(lights, 1)}


def _stops(message: Mapping[str, Any]) -> float | None:
    return None if message.get("stops") is None else messages.number(message, "stops", -60.0, 60.0)


def _tone(message: Mapping[str, Any]) -> str:
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
