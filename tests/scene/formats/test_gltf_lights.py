"""Lights of glTF files, against three.js (`peers/three_poses.mjs`)."""

import json
import pathlib

import numpy as np
import pytest

from jaxprt.scene import load_scene
from tests.scene.formats.gltf_writer import Writer, one

PEER = json.loads((pathlib.Path(__file__).parent / "peers/three_poses.json").read_text())["lit.glb"]["lights"]
LIGHTS = "KHR_lights_punctual"


def lit() -> Writer:
    """A square and a light of each type; their nodes are turned, and below one that is moved and scaled."""
    writer = Writer()
    one(writer.square(), writer=writer)
    lights = [
        {"type": "point", "color": [1, 0.5, 0.25], "intensity": 3, "name": "bulb"},
        {"type": "spot", "intensity": 40, "spot": {"innerConeAngle": 0.2, "outerConeAngle": 0.5}, "name": "bulb"},
        {"type": "directional", "color": [1, 1, 0.5], "intensity": 2, "name": "sun"},
        {"type": "spot", "spot": {}},
    ]
    turns = [[0, 0, 0, 1], [0.5, 0.5, -0.5, 0.5], [0.36, 0.48, 0, 0.8], [0, 0, 0.6, 0.8]]
    nodes = [
        {"translation": [number, 2, 3], "rotation": turn, "extensions": {LIGHTS: {"light": number}}}
        for number, turn in enumerate(turns)
    ]
    above = {"children": [2, 3, 4, 5], "translation": [10, 0, 0], "scale": [2, 2, 2]}
    writer.header["nodes"] = [{"mesh": 0}, above, *nodes]
    writer.header["scenes"][0]["nodes"] = [0, 1]
    writer.header |= {"extensions": {LIGHTS: {"lights": lights}}, "extensionsUsed": [LIGHTS]}
    return writer


def test_lights_are_those_of_three_js(tmp_path):
    path = lit().write(tmp_path / "a.glb")
    with pytest.warns(UserWarning, match=r"its directional lights \(1\) are in scene\.suns: jaxprt\.scene\.with_suns"):
        scene, dim = load_scene(path), load_scene(path, lights=1 / 683)
    assert [lamp.name for lamp in scene.point_lights] == ["bulb", "bulb 2", "light 3"]
    suns = [peer for peer in PEER if peer["type"] == "DirectionalLight"]
    lamps = [peer for peer in PEER if peer["type"] != "DirectionalLight"]
    for sun, peer in zip(scene.suns, suns, strict=True):
        np.testing.assert_allclose(sun.irradiance, np.multiply(peer["color"], peer["intensity"]), rtol=1e-6)
        np.testing.assert_allclose(sun.direction, np.negative(peer["target"]), atol=1e-6)
    for lamp, peer in zip(scene.point_lights, lamps, strict=True):
        np.testing.assert_allclose(lamp.position, peer["position"], atol=1e-6)
        np.testing.assert_allclose(lamp.intensity, np.multiply(peer["color"], peer["intensity"]), rtol=1e-6)
        assert (lamp.axis is None) == (peer["type"] == "PointLight")
        if lamp.axis is not None:
            np.testing.assert_allclose(lamp.axis, peer["target"], atol=1e-6)
            np.testing.assert_allclose(lamp.cone, [peer["angle"] * (1 - peer["penumbra"]), peer["angle"]], atol=1e-6)
    np.testing.assert_allclose(dim.suns[0].irradiance, [2 / 683, 2 / 683, 1 / 683], rtol=1e-6)
    assert not load_scene(path, lights=0).point_lights


DAMAGE = {
    r"must refer to one of its 4 lights in node 2, got 4": lambda h, _: h["nodes"][2]["extensions"][LIGHTS].update(
        light=4
    ),
    r"must have a string for type of light 0, got 3": lambda _, lights: lights[0].update(type=3),
    r"must have a finite number for the intensity of light 1, got inf": lambda _, lights: lights[1].update(
        intensity=float("inf")
    ),
    r"must have an intensity and a color of at least 0 in light 0": lambda _, lights: lights[0].update(intensity=-1),
    r"from 0 to pi / 2 in light 1, got 0\.6 and 0\.5": lambda _, lights: lights[1]["spot"].update(innerConeAngle=0.6),
    r"must have a scale above 0 in node 4 of light 2": lambda h, _: h["nodes"][4].update(scale=[1, 1, 0]),
    r"must have a list for lights of KHR_lights_punctual": lambda h, _: h["extensions"][LIGHTS].update(lights=1),
}


@pytest.mark.parametrize("message", DAMAGE)
def test_damaged_lights_are_refused(tmp_path, message):
    writer = lit()
    DAMAGE[message](writer.header, writer.header["extensions"][LIGHTS]["lights"])
    with pytest.raises(ValueError, match=rf"a\.glb {message}|a\.glb.*{message}"):
        load_scene(writer.write(tmp_path / "a.glb"))


def test_what_is_not_read_of_lights_is_named_once(tmp_path):
    writer = lit()
    lights = writer.header["extensions"][LIGHTS]["lights"]
    del lights[2]["type"]
    lights[2]["type"], lights[0]["range"], lights[1]["range"] = "area", 5, 6
    message = r"ignored are lights of type 'area', ranges of lights \(their light decreases with the squared distance"
    with pytest.warns(UserWarning, match=message):
        scene = load_scene(writer.write(tmp_path / "a.glb"))
    assert not scene.suns
