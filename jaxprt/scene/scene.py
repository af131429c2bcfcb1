"""Scenes: meshes with materials, cameras, and lights."""

import collections
import dataclasses
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float

from jaxprt import require
from jaxprt.compile import known
from jaxprt.scene import material, mesh
from jaxprt.scene import mesh as meshes
from jaxprt.scene import origin as origins
from jaxprt.scene.camera import Camera, orbit
from jaxprt.scene.environment import Environment, Sun
from jaxprt.scene.material import MaterialValues, TexturedMaterial
from jaxprt.scene.mesh import Mesh, brush
from jaxprt.scene.texture import dpdu, handedness

_EDGE = 1e-3  # smallest difference of the cosines of a cone's angles, as in KHR_lights_punctual
_ROUNDING = 1e-6  # by which float32 may round pi upward


class Part(eqx.Module):
    """A mesh with one material.

    Vertex attributes that only textured materials use are stored here and not in the mesh.

    Attributes:
        name: Name of the part, unique within a scene.
        mesh: The mesh. Its regions are ignored.
        material: A material with textures, or any BRDF: a callable (wi, wo) -> value in 1/sr.
        color: Linear vertex colors, which multiply the base color; None for white.
        second: Second set of texture coordinates (`Mesh.texture` is the first); None if there is none.
        handedness: 1 where the bitangent of the textures is cross(normal, tangent), and -1 where it is opposite. If it
            is None and the material has a normal map or anisotropy, the tangents of the mesh become those along u of
            the texture, with their handedness.
        alpha: Opacity of the vertices, from 0 to 1, which multiplies that of the material; None for 1.

    Raises:
        TypeError: The name is not a string, the mesh is not a `Mesh`, or the material is neither a `TexturedMaterial`
            nor callable.
        ValueError: The mesh has no vertices or faces, an array does not have one row per vertex or is not finite, or
            the material has textures but the mesh lacks their texture coordinates.
    """

    name: str = eqx.field(static=True)
    mesh: Mesh
    material: TexturedMaterial | Callable
    color: Float[Array, "v 3"] | None = eqx.field(converter=require.floating, default=None)
    second: Float[Array, "v 2"] | None = eqx.field(converter=require.floating, default=None)
    handedness: Float[Array, " v"] | None = eqx.field(converter=require.floating, default=None)
    alpha: Float[Array, " v"] | None = eqx.field(converter=require.floating, default=None)

    def __post_init__(self):
        """Turns tangents along the texture of a normal map, or of anisotropy, where no handedness is given."""
        if not isinstance(self.material, TexturedMaterial) or not isinstance(self.mesh, Mesh):
            return  # refused below, or a BRDF
        source = self.material.oriented
        place: Any = self.second if source is not None and source.set else self.mesh.texture
        turns = source is not None or not known(self.material.anisotropy) or np.asarray(self.material.anisotropy) > 0
        if turns and self.handedness is None and _placed(self.mesh, place):
            self.mesh, hand = along_texture(self.mesh, place)
            self.handedness = jax.device_put(np.asarray(hand, np.float32))

    def __check_init__(self):
        """Refuses a wrong type of name or mesh, a mesh without vertices, and arrays of other vertices."""
        if not isinstance(self.name, str):
            raise TypeError(f"the name of a part must be text, got {self.name!r}")
        require.kind(
            f"the mesh of part {self.name!r}", self.mesh, Mesh, source="jaxprt.scene.mesh.make_mesh or jaxprt.load_mesh"
        )
        mesh.check_values(self.mesh, f"the mesh of part {self.name!r}")
        count = len(self.mesh.position)
        if not count or not len(self.mesh.face):
            raise ValueError(
                f"part {self.name!r} must have vertices and faces, got {count} vertices and {len(self.mesh.face)} faces"
            )
        for name in ("color", "second", "handedness", "alpha"):
            value = getattr(self, name)
            if value is not None:
                require.real(f"{name} of part {self.name!r}", value)
                require.length(f"rows of {name} of part {self.name!r}", value, count)
                shape = {"color": (count, 3), "second": (count, 2)}.get(name, (count,))
                if jnp.shape(value) != shape:
                    raise ValueError(
                        f"{name} of part {self.name!r} must be {list(shape)}, got {list(jnp.shape(value))}"
                    )
                require.finite(f"{name} of part {self.name!r}", value)
        if self.alpha is not None:
            require.within(f"alpha of part {self.name!r}", self.alpha, 0, 1)
        if not isinstance(self.material, TexturedMaterial):
            if not callable(self.material):
                got = type(self.material).__name__
                raise TypeError(f"the material of part {self.name!r} must be a TexturedMaterial or a BRDF, got {got}")
            return
        for texture in self.material.textures:
            if (self.mesh.texture, self.second)[texture.set] is None:
                field = ("mesh.texture", "second")[texture.set]
                raise ValueError(f"part {self.name!r} must have {field} for the textures of its material, got None")

    def surface(self) -> MaterialValues:
        """Material parameters at the vertices."""
        name = f"the material of part {self.name!r}"
        material = require.kind(name, self.material, TexturedMaterial, source="jaxprt.load_scene")
        place = self.mesh.texture
        place = jnp.zeros((len(self.mesh.position), 2), self.mesh.position.dtype) if place is None else place
        return material.at(place, self.second, color=self.color, handedness=self.handedness)


def _placed(of: Mesh, place: Any) -> bool:
    """Whether a mesh and its texture coordinates are known and right."""
    count = len(of.position)
    if place is None or np.shape(place) != (count, 2) or not known(of, place) or not len(of.face):
        return False
    face = np.asarray(of.face)
    return bool(face.min() >= 0 and face.max() < count and np.isfinite(np.asarray(place)).all())


def along_texture(
    of: Mesh, place: ArrayLike, *, stated: Bool[np.ndarray, " v"] | None = None, side: ArrayLike | None = None
) -> tuple[Mesh, Float[np.ndarray, " v"]]:
    """A mesh with tangents along u of a texture, and the handedness of the texture at all vertices.

    Args:
        of: The mesh.
        place: Texture coordinates of the vertices.
        stated: Vertices that keep their tangents; None for none.
        side: Handedness of these; 1 if None.
    """
    image = dataclasses.replace(of, texture=jnp.asarray(place, jnp.float32))
    along, hand = dpdu(image), handedness(image)
    if stated is not None:
        along = np.where(stated[:, None], of.tangent, along)
        hand = np.where(stated, 1 if side is None else side, hand)
    return brush(of, along), hand


def _place(value: Any) -> Any:
    """Three coordinates, or one number for three. What is not of numbers is left for the class to refuse."""
    value = origins.coordinates(value)
    if isinstance(value, np.ndarray) and value.ndim == 0:  # in float64, where float32 would round it
        return np.broadcast_to(value, (3,))
    return jnp.broadcast_to(value, (3,)) if isinstance(value, jax.Array) and value.ndim == 0 else value


def _axis(value: Any) -> Any:
    """A direction as an array; None stays."""
    return None if value is None else require.floating(value)


class PointLight(eqx.Module):
    """A point light near the objects that emits equally in all directions, or a spot that emits into a cone.

    Attributes:
        name: Name of the light, different from those of all parts and other point lights of the scene.
        position: Position in world units, in the coordinates of the scene's file. Coordinates above 64 that float32
            would round stay in a NumPy array in float64.
        intensity: Radiant intensity, in units of radiance times squared world units. That of a spot is along its axis.
        axis: Direction into which a spot shines, of any length; None for light into all directions.
        cone: Angles from the axis in radians: up to the first one a spot has its whole intensity, from the second one
            on none.

    Raises:
        TypeError: The name is not a string.
        ValueError: The position, the intensity or the axis is not finite, the intensity is negative, the axis is zero,
            or the angles are not ascending from 0 to pi.
    """

    name: str = eqx.field(static=True)
    position: Float[Array | np.ndarray, "3"] = eqx.field(converter=_place)
    intensity: Float[Array, "3"] = eqx.field(converter=partial(require.repeated, length=3), default=1.0)
    axis: Float[Array, "3"] | None = eqx.field(converter=_axis, default=None)
    cone: tuple[float, float] = eqx.field(static=True, default=(0.0, np.pi / 4))

    def __check_init__(self):
        """Refuses values that are not finite."""
        if not isinstance(self.name, str):
            raise TypeError(f"the name of a point light must be text, got {self.name!r}")
        require.position(f"the position of point light {self.name!r}", self.position)
        require.at_least(f"the intensity of point light {self.name!r}", self.intensity, 0.0)
        if jnp.shape(self.intensity) != (3,):
            got = list(jnp.shape(self.intensity))
            raise ValueError(f"the intensity of point light {self.name!r} must be one number or a color [3], got {got}")
        if self.axis is not None:
            require.finite(f"the axis of point light {self.name!r}", self.axis)
            if jnp.shape(self.axis) != (3,) or not (isinstance(self.axis, Tracer) or np.any(self.axis)):
                raise ValueError(f"the axis of point light {self.name!r} must be a direction, got {self.axis}")
        angles = self.cone
        if len(angles) != 2 or not 0 <= angles[0] <= angles[1] <= np.pi + _ROUNDING or not angles[1] > 0:
            must = f"the cone of point light {self.name!r} must be two ascending angles from 0 to pi"
            raise ValueError(f"{must}, got {angles}")

    def share(self, direction: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b"]:
        """The intensity into some directions, relative to that along the axis: 1 for all without an axis.

        Between the two angles of the cone it is the square of a line in the cosine, as KHR_lights_punctual recommends.

        Args:
            direction: Unit directions from the light.
        """
        if self.axis is None:
            return np.ones(direction.shape[:-1], direction.dtype)
        inner, outer = np.cos(self.cone)
        axis = np.asarray(self.axis, np.float64)
        cosine = direction @ (axis / np.linalg.norm(axis)).astype(direction.dtype)
        return np.clip((cosine - outer) / max(inner - outer, _EDGE), 0, 1) ** 2


def _tuple(items: object) -> tuple:
    """A sequence as a tuple."""
    if isinstance(items, eqx.Module | str | bytes) or not isinstance(items, Iterable):
        lists = "parts, cameras, environments, point_lights and suns"
        raise TypeError(f"a scene takes lists of {lists}, got one {type(items).__name__}")
    return tuple(items)


def _align_parts(parts: object) -> tuple:
    """Parts whose meshes have one origin. Values that are not parts pass; the scene refuses them."""
    parts = _tuple(parts)
    if not all(isinstance(part, Part) for part in parts):
        return parts
    moved = meshes.aligned([part.mesh for part in parts])
    return tuple(
        part if mesh is part.mesh else eqx.tree_at(lambda p: p.mesh, part, mesh)
        for part, mesh in zip(parts, moved, strict=True)
    )


class Scene(eqx.Module):
    """A scene: parts with their materials, cameras, and lights.

    The meshes of all parts have the same origin. Cameras and point lights are in the coordinates of the file.

    Attributes:
        parts: The parts, in order.
        cameras: The cameras; may be empty.
        environments: The distant lights; may be empty.
        point_lights: The point lights; may be empty. Parts that emit light are area lights.
        suns: Distant lights of one direction each; may be empty. They are no part of any environment: `with_suns` adds
            them to one.

    Raises:
        TypeError: A field holds an object of another class.
        ValueError: There are no parts, or two parts or point lights have the same name.
    """

    parts: tuple[Part, ...] = eqx.field(converter=_align_parts)
    cameras: tuple[Camera, ...] = eqx.field(converter=_tuple, default=())
    environments: tuple[Environment, ...] = eqx.field(converter=_tuple, default=())
    point_lights: tuple[PointLight, ...] = eqx.field(converter=_tuple, default=())
    suns: tuple[Sun, ...] = eqx.field(converter=_tuple, default=())

    def __check_init__(self):
        """Refuses scenes without parts, equal names, and objects of other classes."""
        for name, kind, source in (
            ("parts", Part, "scene.Part"),
            ("cameras", Camera, "scene.Camera"),
            ("environments", Environment, "load_environment"),
            ("point_lights", PointLight, "scene.PointLight"),
            ("suns", Sun, "scene.Sun"),
        ):
            for item in getattr(self, name):
                require.kind(f"each of the scene's {name}", item, kind, source=source)
        if not self.parts:
            raise ValueError("a scene must have at least one part, got none")
        count = collections.Counter(item.name for item in (*self.parts, *self.point_lights))
        twice = sorted(name for name, times in count.items() if times > 1)
        if twice:
            raise ValueError(f"the parts of a scene must have different names, got several named {twice}")

    @property
    def names(self) -> list[str]:
        """Names of the parts."""
        return [part.name for part in self.parts]

    @property
    def counts(self) -> list[int]:
        """Number of vertices of each part."""
        return [len(part.mesh.position) for part in self.parts]

    def __getitem__(self, name: str) -> Part:
        """The part with a given name.

        Raises:
            KeyError: No part has this name.
        """
        for part in self.parts:
            if part.name == name:
                return part
        raise KeyError(f"there is no part {name!r}, only {self.names}")

    @property
    def mesh(self) -> Mesh:
        """All parts joined into one mesh. It is computed at each access.

        Regions are the indices of the parts, so `mesh.split` takes the mesh apart again. Parts with holes and
        translucent ones give it its `opacity`.
        """
        whole = meshes.join(
            [
                eqx.tree_at(lambda m: m.region, part.mesh, np.zeros(len(part.mesh.position), np.int32))
                for part in self.parts
            ]
        )
        opacity = material.opacity_of_parts(self.parts)
        return whole if opacity is None else dataclasses.replace(whole, opacity=opacity)


def centered(scene: Scene) -> Scene:
    """The scene with its origin moved to zero: what is computed inside needs no coordinates of the file."""
    origin = scene.parts[0].mesh.origin
    if origin == origins.ZERO:
        return scene
    parts = [eqx.tree_at(lambda p: p.mesh, part, meshes.centered(part.mesh)) for part in scene.parts]
    lamps = [
        eqx.tree_at(
            lambda light: light.position, lamp, origins.local(f"point light {lamp.name!r}", lamp.position, origin)
        )
        for lamp in scene.point_lights
    ]
    return Scene(parts, [camera.local(origin) for camera in scene.cameras], scene.environments, lamps, scene.suns)


def default_camera(scene: Scene, mesh: Mesh) -> Camera:
    """The first camera of a scene. If it has none, one that shows the mesh of all parts from slightly above."""
    return scene.cameras[0] if scene.cameras else orbit(mesh, azimuth=0.5, elevation=0.3)


def unique_names(names: Sequence[str]) -> list[str]:
    """Makes names unique by appending numbers to repeated ones: "wood", "wood 2", "wood 3"."""
    taken: set[str] = set()
    latest: dict[str, int] = {}  # the number that each name got last, because counting anew takes quadratic time
    result = []
    for name in names:
        number, unique = latest.get(name, 1), name
        while unique in taken:
            number += 1
            unique = f"{name} {number}"
        latest[name] = number
        taken.add(unique)
        result.append(unique)
    return result
