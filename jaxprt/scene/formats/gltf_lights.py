"""Lights of glTF files: KHR_lights_punctual.

The extension gives point lights and spots in candela and directional lights in lux. One candela is taken as one unit of
radiance times squared world units, and one lux as one unit of radiance times steradian, as three.js takes them: the
numbers of the file are those of the scene, times one factor. Programs that convert from watts multiply by 683 lm/W or
another luminous efficacy, which a factor of 1 / 683 takes back.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxprt.scene.formats.gltf_file import Document
from jaxprt.scene.formats.gltf_header import excerpt
from jaxprt.scene.formats.gltf_nodes import Node
from jaxprt.scene.scene import PointLight, numbered
from jaxprt.scene.suns import Sun

LIGHTS = "KHR_lights_punctual"
_RANGE = "ranges of lights (their light decreases with the squared distance alone)"


def lights(
    document: Document, nodes: Sequence[Node], names: Sequence[str], scale: float
) -> tuple[list[PointLight], list[Sun], set[str]]:
    """The lights of all nodes; none for a scale of 0.

    Args:
        document: The file.
        nodes: The nodes of the default scene.
        names: Names of the parts, which lights must not have.
        scale: Units of radiance for one candela per square world unit.

    Returns:
        Point lights and spots, suns, and the names of what is not read.

    Raises:
        ValueError: A light is missing, a number is not finite or negative, the angles of a cone are not ascending from
            0 to pi / 2, or the node of a spot or a sun has a scale of zero.
    """
    if scale == 0:
        return [], [], set()
    placed: list[tuple[dict[str, Any], str, Node]] = []
    ignored: set[str] = set()
    items = document.array(_extension(document, document.header, "the file"), "lights", LIGHTS)
    for node in nodes:
        extension = _extension(document, node.item, f"node {node.number}")
        if "light" not in extension:
            continue
        number = extension["light"]
        if type(number) is not int or not 0 <= number < len(items) or not isinstance(items[number], dict):
            raise document.error(f"must refer to one of its {len(items)} lights in node {node.number}", excerpt(number))
        item, owner = items[number], f"light {number}"
        kind = document.string(item, "type", owner)
        if kind in ("point", "spot", "directional"):
            placed.append((item, owner, node))
        else:
            ignored.add(f"lights of type {excerpt(kind)}")
        if "range" in item and kind != "directional":
            ignored.add(_RANGE)
    given = [str(item.get("name") or owner).encode(errors="replace").decode() for item, owner, _ in placed]
    unique = numbered([*names, *given])[len(names) :]
    points, suns = [], []
    for (item, owner, node), name in zip(placed, unique, strict=True):
        color = document.numbers(item.get("color", [1.0] * 3), (3,), f"the color of {owner}")
        strength = scale * color * document.numbers(item.get("intensity", 1.0), (), f"the intensity of {owner}")
        if not (strength >= 0).all():
            raise document.error(f"must have an intensity and a color of at least 0 in {owner}", str(strength.tolist()))
        if item["type"] == "directional":
            suns.append(Sun(name, -_axis(document, node, owner), np.float32(strength)))
        else:
            shape = _cone(document, item, node, owner) if item["type"] == "spot" else {}
            points.append(PointLight(name, node.matrix[:3, 3], np.float32(strength), **shape))
    return points, suns, ignored


def _extension(document: Document, item: dict[str, Any], owner: str) -> dict[str, Any]:
    return document.object(document.object(item, "extensions", owner), LIGHTS, owner)


def _axis(document: Document, node: Node, owner: str) -> np.ndarray:
    """Unit direction into which a light shines: the axis -z of its node."""
    axis = -node.matrix[:3, 2]
    length = np.linalg.norm(axis)
    if not length > 0:
        raise document.error(f"must have a scale above 0 in node {node.number} of {owner}", "zero")
    return axis / length


def _cone(document: Document, item: dict[str, Any], node: Node, owner: str) -> dict[str, Any]:
    """The axis and the angles of a spot."""
    spot = document.object(item, "spot", owner)
    inner = float(document.numbers(spot.get("innerConeAngle", 0.0), (), f"innerConeAngle of {owner}"))
    outer = float(document.numbers(spot.get("outerConeAngle", np.pi / 4), (), f"outerConeAngle of {owner}"))
    if not 0 <= inner <= outer <= np.pi / 2 + 1e-6 or not outer > 0:  # float32 rounds pi / 2 upward
        must = f"must have innerConeAngle and outerConeAngle in ascending order from 0 to pi / 2 in {owner}"
        raise document.error(must, f"{inner:g} and {outer:g}")
    return {"axis": _axis(document, node, owner), "cone": (inner, outer)}
