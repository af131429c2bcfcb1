"""States of a viewer as files: what was seen, which other programs can draw again."""

import dataclasses
import os
import pathlib
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from jaxprt.files import inputs
from jaxprt.image.tonemap import TONES
from jaxprt.scene import Camera, Environment, Scene
from jaxprt.scene.environment import rotate
from jaxprt.view import messages, stages
from jaxprt.view.messages import Look


class State(NamedTuple):
    """What a viewer showed, of a scene with its origin at the file's.

    Attributes:
        look: What pictures depend on. Its number of the light means nothing.
        light: Name of the light.
        aspect: Width of the picture over its height.
        tone: Tone curve of `jaxprt.image.display`.
        stops: Exposure; None if it was automatic.
    """

    look: Look
    light: str
    aspect: float
    tone: str
    stops: float | None

    def environment(self, lights: Mapping[str, Environment]) -> Environment:
        """The light as it was turned, with the lamps.

        Raises:
            ValueError: There is no light of the name.
        """
        if self.light not in lights:
            raise ValueError(f"the state is of the light {self.light!r}, got {', '.join(map(repr, lights))}")
        light = stages.with_lamps(lights[self.light], self.look.lamps)
        return rotate(light, stages.about(self.look.turn)) if self.look.turn else light

    def changed(self, scene: Scene) -> Scene:
        """The scene with the materials of the state.

        Raises:
            ValueError: A part does not exist, or its material cannot change.
        """
        new, names = dict(self.look.material), scene.names
        unknown = [name for name in new if name not in names]
        if unknown:
            raise ValueError(f"the state is of a scene with the part {unknown[0]!r}, got {', '.join(map(repr, names))}")
        parts = [
            dataclasses.replace(part, material=stages.change_material(part.material, part.name, dict(new[part.name])))
            if new.get(part.name)
            else part
            for part in scene.parts
        ]
        return dataclasses.replace(scene, parts=parts)

    def camera(self, height: int) -> Camera:
        """The camera, in coordinates of the scene's files.

        Args:
            height: Rows of its pictures.
        """
        width, up = max(1, round(self.aspect * height)), [0.0, 1.0, 0.0]
        eye, target = (np.array(place, float) for place in (self.look.eye, self.look.target))
        return Camera(eye, target, up, self.look.field_of_view, width, height)


def load_state(path: str | os.PathLike) -> State:
    """Reads a state that the viewer has saved.

    Raises:
        OSError: The file cannot be read.
        ValueError: It is not a state, or a value is out of its range.
    """
    path = pathlib.Path(path)
    content = inputs.json_object(path, "the state")
    if content.get("jaxprt") != "state":
        raise ValueError(f'{path} must be a state of the viewer, JSON with "jaxprt": "state"')
    try:
        system, light = messages.text(content, "system"), messages.text(content, "light")
        look = messages.look({**content, "light": 0, "system": system}, systems=[system], lights=1)
        tone, aspect = messages.text(content, "tone"), messages.number(content, "aspect", 1e-3, 1e3)
        stops = None if content.get("stops") is None else messages.number(content, "stops", -60.0, 60.0)
        if tone not in TONES:
            raise ValueError(f"tone must be one of {', '.join(TONES)}, got {tone[:80]!r}")
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return State(look, light, aspect, tone, stops)
