"""Stages of picture computation, each cached until its inputs change."""

import dataclasses
import math
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree, UInt32

from jaxprt.brdf import BlinnPhong, CookTorrance
from jaxprt.compile import Between
from jaxprt.files.inputs import JsonObject
from jaxprt.relit.channels import Appearance, Changeable, Shading, roughness_range
from jaxprt.relit.scene import RelitScene
from jaxprt.scene import Camera, Environment, Mesh, Scene, TexturedMaterial
from jaxprt.scene.environment import add_disk, rotate, sky
from jaxprt.systems import standard
from jaxprt.view.messages import Lamp, Look, Message
from jaxprt.view.unshadowed import Unshadowed

_KEPT = 4  # cached results of each stage
_SKY = 128  # height of the picture of an environment in pixels
_TURN = 0.01  # radians, and share of the distance to the eye, by which rehearsed looks differ
_VALUES = 4  # of roughness that are tried for their programs
_PARTS = 8  # most parts whose materials are changed for their programs

Made = TypeVar("Made")


def relit(scene: RelitScene | Unshadowed) -> RelitScene:
    """The scene, if its rays have been traced."""
    if isinstance(scene, Unshadowed):
        raise ValueError("colors must have rays, which are still being traced")
    return scene


class Stages:
    """Lights, materials, views and pictures of several systems of one scene. It is safe to share between threads.

    Attributes:
        systems: Relit scene of each system, by name; before rays are traced, the scene without shadows.
        origin: Origin of the scene in its files.
        lights: Environments of equal size.
        name: Names of the lights.
    """

    def __init__(self, systems: Mapping[str, RelitScene | Unshadowed], environments: Mapping[str, Environment]):
        """Stores the systems and lights. More lights may be added later."""
        # The browser draws in float32: positions, eyes and targets are relative to the scene's origin.
        self.origin = next(iter(systems.values())).origin
        systems = {name: scene.centered() for name, scene in systems.items()}
        self.systems = systems
        self.name, self.lights = list(environments), list(environments.values())
        self._bare = {name: system.without_bounces() for name, system in systems.items()}
        self._kept: dict[str, OrderedDict[Hashable, Any]] = {}
        self._lock = threading.Lock()

    @property
    def scene(self) -> RelitScene | Unshadowed:
        """The scene of the first system."""
        return next(iter(self.systems.values()))

    @property
    def size(self) -> int:
        """Edge of the lights' cubemap faces in texels."""
        return self.lights[0].radiance.shape[-2]

    def system(self, look: Look) -> RelitScene:
        """The relit scene of the system that a look names."""
        return relit((self.systems if look.bounces else self._bare)[look.system])

    def unturned(self, number: int, lamps: tuple[Lamp, ...]) -> Environment:
        """A light with the lamps added, before rotation."""
        return self._once("unturned", (number, lamps), lambda: with_lamps(self.lights[number], lamps))

    def environment(self, look: Look) -> Environment:
        """The rotated light of a look."""
        unturned = self.unturned(look.light, look.lamps)
        if look.turn == 0:
            return unturned
        key = look.light, look.lamps, look.turn
        return self._once("environment", key, lambda: rotate(unturned, about(look.turn)))

    def sky(self, number: int, lamps: tuple[Lamp, ...], *, rows: int = _SKY) -> list[Float[np.ndarray, "_ _ 3"]]:
        """Latitude-longitude pictures of a light before rotation: +y on top, +z in the center.

        Args:
            number: Index of the light.
            lamps: Lamps that are added to it.
            rows: Most rows of the first picture; 128 at least, and no more than the file of the light has.

        Returns:
            Pictures of rows, half as many, and so on to 128.
        """
        light = self.unturned(number, lamps)
        finest = _SKY if light.panorama is None else light.panorama.rows
        heights = [_SKY << level for level in range(10) if level == 0 or _SKY << level <= min(rows, finest)]
        return [_latlong(light, height) for height in reversed(heights)]

    def materials(self, look: Look) -> dict[str, Changeable]:
        """The materials that a look changes, by part."""
        parts = {part.name: part for part in self.scene.scene.parts}
        unknown = [name for name, _ in look.material if name not in parts]
        if unknown:
            raise ValueError(f"materials must be for the parts {', '.join(parts)}, got one for {unknown[0]!r}")
        return {
            name: change_material(parts[name].material, name, dict(values)) for name, values in look.material if values
        }

    def appearances(self, look: Look) -> dict[str, Appearance]:
        """The changed materials of a look, evaluated at the vertices."""
        key = look.system, look.material
        return self._once("material", key, lambda: self.system(look).appearances(self.materials(look)))

    def light_side(self, look: Look) -> PyTree:
        """The part of the system's computation that depends only on the light."""
        system = self.system(look)
        light_key = look.system, look.bounces, look.light, look.lamps, look.turn
        light = self._once("light", light_key, lambda: system.light(self.environment(look)))
        if not look.bounces and system.lamps is None:
            return light
        key = (*light_key, look.material)
        return self._once("shade", key, lambda: system.shade(light, self.appearances(look)))

    def view_side(self, look: Look) -> PyTree:
        """The part of the system's computation that depends only on the eye and the materials."""
        key = look.system, look.bounces, look.eye, look.material
        eye = jnp.asarray(look.eye, jnp.result_type(float))
        return self._once("view", key, lambda: self.system(look).view(eye, self.appearances(look)))

    def color(self, look: Look) -> Float[np.ndarray, "v 3"]:
        """Radiance at the vertices towards the eye."""

        def combined() -> Float[np.ndarray, "v 3"]:
            color = np.asarray(self.system(look).combine(self.light_side(look), self.view_side(look)))
            return np.broadcast_to(color, (len(color), 3))  # gray scenes have one channel

        return self._once("color", look, combined)

    def facing(self, look: Look) -> Bool[np.ndarray, " v"]:
        """Whether each vertex belongs to a triangle whose front faces the eye."""
        mesh = self.scene.mesh

        def faces() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            face, position = counterclockwise(mesh), np.asarray(mesh.position)
            corner, left, right = (position[face[:, k]] for k in range(3))
            normal = np.cross(left - corner, right - corner)
            return face, normal, np.sum(normal * corner, -1)

        def seen() -> Bool[np.ndarray, " v"]:
            face, normal, distance = self._once("faces", None, faces)
            result = np.zeros(len(mesh.position), bool)
            result[face[normal @ np.asarray(look.eye, normal.dtype) > distance]] = True
            return result

        return self._once("facing", look.eye, seen)

    def picture(
        self, look: Look, width: int, height: int, *, samples: int = 4, between: Between = None
    ) -> Float[np.ndarray, "h w 3"]:
        """The picture with shading at pixels. `RelitScene.picture` explains the options."""
        arguments = self.environment(look), camera(look, width, height)
        options = {"samples": samples, "between": between}
        color = self.system(look).picture(*arguments, materials=self.materials(look), **options)
        return np.broadcast_to(np.asarray(color), (height, width, 3))

    def cutout(
        self, look: Look, width: int, height: int, *, samples: int = 4, between: Between = None
    ) -> Float[np.ndarray, "h w 4"]:
        """The picture without the environment behind it: linear colors, not premultiplied, and alpha."""
        system, eye = self.system(look), camera(look, width, height)
        options = {"samples": samples, "background": None, "between": between}
        picture = np.asarray(system.picture(self.environment(look), eye, materials=self.materials(look), **options))
        return straight(picture[..., :-1], picture[..., -1:])

    def direct_picture(self, look: Look, width: int, height: int, *, between: Between) -> Float[np.ndarray, "h w 3"]:
        """The picture under direct light of the environment only."""
        arguments = self.environment(look), camera(look, width, height)
        color = self.system(look._replace(bounces=False)).picture(
            *arguments, materials=self.materials(look), between=between
        )
        return np.broadcast_to(np.asarray(color), (height, width, 3))

    def rehearsal(self, width: int, height: int) -> Iterator[float]:
        """Computes what first changes of light, view and materials ask for, so that their programs are compiled.

        Args:
            width: Columns of a picture.
            height: Rows of a picture.

        Yields:
            The share that is done, after each step.
        """
        looks = [look for name in self.systems for look in self._first_looks(name)]
        for number, look in enumerate(looks):
            self.color(look)
            yield (number + 1) / (len(looks) + 1)
        self.picture(looks[0], width, height)
        yield 1.0

    def _first_looks(self, name: str) -> Iterator[Look]:
        """A look of a system, and looks in which one thing is changed."""
        system = self.systems[name]
        eye, target = (tuple(np.asarray(place, float).tolist()) for place in (system.camera.eye, system.camera.target))
        angle, bounces = float(system.camera.field_of_view), system.bounces is not None
        first = Look(name, 0, 0.0, (), eye, target, angle, bounces, ())
        yield first
        yield first._replace(turn=_TURN, eye=(eye[0] + _TURN * math.dist(eye, target), *eye[1:]))
        pairs = zip(system.scene.parts, system.shading, strict=True)
        for part, shading in sorted(pairs, key=lambda pair: -len(pair[0].mesh.position))[:_PARTS]:
            values = freedom(shading, part.material) or {}
            changed = {name: tuple(values[name]) for name in ("diffuse", "specular") if name in values}
            changed |= {name: values[name] for name in ("f0",) if name in values}
            # The number of points along the edges of bright texels, which is static, depends on them.
            scales = [name for name in ("roughness", "exponent") if f"{name}_range" in values]
            rows = [changed | {name: value} for name in scales for value in _between(values[f"{name}_range"])]
            for row in rows or [changed]:
                if row:
                    yield first._replace(material=((part.name, tuple(sorted(row.items()))),))

    def changed_scene(self, look: Look) -> Scene:
        """The scene with the changed materials."""
        new, scene = self.materials(look), self.scene.scene
        parts = [dataclasses.replace(part, material=new.get(part.name, part.material)) for part in scene.parts]
        return dataclasses.replace(scene, parts=parts)

    def _once(self, stage: str, key: Hashable, make: Callable[[], Made]) -> Made:
        """The cached result for a key, computed now if it is missing."""
        with self._lock:
            results = self._kept.setdefault(stage, OrderedDict())
            if key in results:
                results.move_to_end(key)
                return results[key]
        result = jax.block_until_ready(make())
        with self._lock:
            results[key] = result
            while len(results) > _KEPT:
                results.popitem(last=False)
        return result


def _between(ends: Sequence[float]) -> list[float]:
    """Values from one end of a range to the other."""
    return np.linspace(ends[0], ends[1], _VALUES).tolist()


def counterclockwise(mesh: Mesh) -> UInt32[np.ndarray, "f 3"]:
    """Faces with corners in counterclockwise order as seen from the side to which their normals point."""
    face = np.asarray(mesh.face).astype("<u4")
    position, normal = np.asarray(mesh.position, np.float64), np.asarray(mesh.normal, np.float64)
    edge, other = (position[face[:, k]] - position[face[:, 0]] for k in (1, 2))
    clockwise = np.sum(np.cross(edge, other) * normal[face].sum(1), -1) < 0
    face[clockwise] = face[clockwise][:, ::-1]
    return face


def straight(color: Float[np.ndarray, "h w c"], alpha: Float[np.ndarray, "h w 1"]) -> Float[np.ndarray, "h w 4"]:
    """Colors that are multiplied by alpha, divided by it, and alpha. They are 0 where nothing is seen."""
    result = np.divide(color, alpha, out=np.zeros(color.shape, np.float32), where=alpha > 0)
    return np.concatenate([np.broadcast_to(result, (*color.shape[:2], 3)), alpha], -1)


def about(angle: float) -> Float[Array, "3 3"]:
    """Rotation matrix about the vertical by an angle in radians, from +z towards +x."""
    c, s = np.cos(angle), np.sin(angle)
    return jnp.asarray([[c, 0, s], [0, 1, 0], [-s, 0, c]], jnp.result_type(float))


def _latlong(light: Environment, rows: int) -> Float[np.ndarray, "h w 3"]:
    """A latitude-longitude picture of a light."""
    latitude = np.pi * (0.5 - (np.arange(rows) + 0.5) / rows)[:, None]
    longitude = np.pi * (1 - 2 * (np.arange(2 * rows) + 0.5) / (2 * rows))
    ring = np.cos(latitude)
    way = [ring * np.sin(longitude), np.sin(latitude) + 0 * longitude, ring * np.cos(longitude)]
    color = np.asarray(sky(light, np.stack(way, -1).astype(np.float32), angle=np.pi / rows))
    return np.broadcast_to(color, (*color.shape[:2], 3))


def camera(look: Look, width: int, height: int) -> Camera:
    """The camera of a look."""
    return Camera(list(look.eye), list(look.target), [0.0, 1.0, 0.0], look.field_of_view, width, height)


def freedom(shading: Shading, material: object) -> JsonObject | None:
    """Parameters of a part's material that the viewer can change, with their values; None for a fixed BRDF."""
    if isinstance(material, BlinnPhong) and shading.blend is not None:
        specular = np.broadcast_to(np.asarray(material.specular, float), (3,))
        return {
            "diffuse": np.broadcast_to(np.asarray(material.diffuse, float), (3,)).tolist(),
            "exponent": float(material.exponent),
            "exponent_range": [1.0, standard.BLINN_PHONG.most_exponent],  # of which the viewer takes logarithms
            "f0": float(specular.max()),
            "specular": (specular / max(specular.max(), 1e-6)).tolist(),
        }
    if isinstance(material, CookTorrance) and shading.blend is not None:
        diffuse, specular, f0 = (
            np.broadcast_to(np.asarray(value, float), (3,))
            for value in (material.diffuse, material.specular, material.f0)
        )
        return {
            "diffuse": diffuse.tolist(),
            "roughness": float(material.roughness),
            "roughness_range": np.exp(standard.COOK_TORRANCE.range).tolist(),
            "f0": float(f0.max()),
            "specular": specular.tolist(),
        }
    if not isinstance(material, TexturedMaterial):
        return None
    free: JsonObject = {"diffuse": np.asarray(material.base_color).tolist()}
    if shading.matte:
        return free
    low, high = roughness_range(shading)
    tint = np.asarray(material.specular_color)
    if material.metallic_texture is None:
        free["metallic"] = float(material.metallic)
    if high > low and material.roughness_texture is None:
        free |= {"roughness": float(material.roughness), "roughness_range": [low, high]}
    if "metallic" in free or float(material.metallic) < 1:
        free |= {"f0": min(float(tint.max()) * _f0(material), 1.0), "specular": (tint / max(tint.max(), 1e-6)).tolist()}
    return free


def change_material(material: object, name: str, values: Message) -> Changeable:
    """The material with other values of roughness, metallicity, reflectance and colors."""
    if isinstance(material, BlinnPhong):
        new = {key: jnp.asarray(values[key]) for key in ("diffuse", "exponent") if key in values}
        if "f0" in values or "specular" in values:
            new["specular"] = _tint(material.specular, 1.0, values)
        return dataclasses.replace(material, **new)
    if isinstance(material, CookTorrance):
        names = ("diffuse", "roughness", "specular")
        new = {key: jnp.asarray(values[key]) for key in names if key in values}
        if "f0" in values:
            most = float(jnp.max(material.f0))
            new["f0"] = material.f0 * (values["f0"] / most) if most > 0 else jnp.full_like(material.f0, values["f0"])
        return dataclasses.replace(material, **new)
    if not isinstance(material, TexturedMaterial):
        raise ValueError(f"the material of part {name!r} is a BRDF, which cannot change in the viewer")
    new: JsonObject = {key: values[key] for key in ("roughness", "metallic") if key in values}
    if "diffuse" in values:
        new["base_color"] = jnp.asarray(values["diffuse"])
    if "f0" in values or "specular" in values:
        new["specular_color"] = _tint(material.specular_color, _f0(material), values)
    return dataclasses.replace(material, **new)


def _tint(color: Array | np.ndarray, white: float, values: Message) -> Float[Array, "3"]:
    """A specular color with another strength or tint. A strength of 1 has the reflectance `white`."""
    old = np.broadcast_to(np.asarray(color), (3,))
    strength = values["f0"] / white if "f0" in values else float(old.max())
    tint = np.asarray(values["specular"]) if "specular" in values else old / max(old.max(), 1e-6)
    return jnp.asarray(strength * tint)


def _f0(material: TexturedMaterial) -> float:
    """Reflectance at normal incidence of a white dielectric of the material's index of refraction."""
    ior = float(material.ior)
    return 1.0 if ior == 0 else max(((ior - 1) / (ior + 1)) ** 2, 1e-6)


def with_lamps(light: Environment, lamps: tuple[Lamp, ...]) -> Environment:
    """A light with lamps added as disks."""
    for lamp in lamps:
        light = add_disk(light, np.asarray(lamp.direction), angle=lamp.angle, radiance=np.asarray(lamp.radiance))
    return light
