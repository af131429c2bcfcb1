"""The vertices of a scene as a few groups of arrays: one for all parts whose materials are of one kind.

A program depends on the kind of a group and on padded sizes, and not on parts, names or views. Parts stand one after
another in their group, and where each part stands is known on the host.
"""

import dataclasses
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxprt import require
from jaxprt.brdf import grid
from jaxprt.compile import compile_time, jit, known, put, shared_size
from jaxprt.relit import channels
from jaxprt.relit.channels import Appearance, Shading
from jaxprt.scene import Environment, Mesh, PointLight
from jaxprt.scene import origin as origins
from jaxprt.scene.material_table import MaterialLook, MaterialTable, at_vertices
from jaxprt.scene.mesh import frames, join
from jaxprt.scene.points import VERTICES, Points
from jaxprt.systems import protocol
from jaxprt.systems.bounces import GroupBounces, ReflectingPart
from jaxprt.systems.bright_texels import BrightTexels
from jaxprt.systems.lamps import LitByLamps
from jaxprt.systems.protocol import Blend, System

T = TypeVar("T")
_FEWEST = 64  # vertices of a group
_NARROW = 3  # samples along the edge of a bright texel from which on lobes are narrower than texels


class Surface(eqx.Module):
    """The vertices of a group, with everything that their shading requires.

    Attributes:
        system: The system of direct light from the environment.
        position: Positions of the vertices.
        frame: Their shading frames; rows are tangent, bitangent, normal.
        brdf: The BRDF, with one channel for each weight of a blend.
        reflecting: How they reflect light from other surfaces; None without bounces.
        lit: How they reflect light from lamps; None without lamps.
        scale: Factor of each channel of the BRDF; None for a BRDF that cannot change.
        term: Indices of the channels among the coefficients of a `MaterialLook`.
        varies: Whether the system takes the roughness of each point.
    """

    system: System
    position: Float[Array, "v 3"]
    frame: Float[Array, "v 3 3"]
    brdf: Callable
    reflecting: ReflectingPart | None
    lit: LitByLamps | None
    scale: Float[Array, " k"] | None
    term: tuple[int, ...] = eqx.field(static=True)
    varies: bool = eqx.field(static=True)

    def blend(self, look: MaterialLook) -> Blend | None:
        """Weights of the channels at points with given materials."""
        if self.scale is None:
            return None
        return channels.blend(look, self.term, self.scale, varies=self.varies)

    @property
    def matte(self) -> bool:
        """Whether the surface is ideally diffuse."""
        return self.system.matte

    @property
    def has_rays(self) -> bool:
        """Whether rays represent the narrow lobes with which the surface reflects other surfaces."""
        return self.reflecting is not None and self.reflecting.lobe is not None

    @property
    def without_rays(self) -> "Surface":
        """The surface as rays see it: it reflects other surfaces by harmonics alone."""
        if self.reflecting is None or self.reflecting.lobe is None:
            return self
        return dataclasses.replace(self, reflecting=self.reflecting.harmonics_alone)


def sampled(surface: Surface, samples: int) -> Surface:
    """The surface with another number of sample points along the edge of each bright texel."""

    def changed(part: Any) -> Any:
        fixed = not isinstance(part, BrightTexels) or part.samples in (None, samples)
        return part if fixed else dataclasses.replace(part, samples=samples)

    system = jax.tree.map(changed, surface.system, is_leaf=lambda part: isinstance(part, BrightTexels))
    return dataclasses.replace(surface, system=system)


class VertexMaterials(eqx.Module):
    """Materials that users give at the vertices of some parts of a group, in place of evaluated ones.

    Attributes:
        blend: Weights of the channels at all vertices of the group.
        emitted: Radiance that they emit.
        flag: 1 at vertices of these parts, 0 at others.
    """

    blend: Blend
    emitted: Float[Array | np.ndarray, "v 3"]
    flag: Float[Array | np.ndarray, " v"]


class Layout(eqx.Module):
    """Where the vertices of all parts stand, on the host.

    Attributes:
        counts: Number of vertices of each part.
        parts: Indices of the parts of each group.
        size: Number of vertices of each group, with padding.
    """

    counts: tuple[int, ...] = eqx.field(static=True)
    parts: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    size: tuple[int, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, counts: Sequence[int], parts: Sequence[Sequence[int]], joins: Sequence[bool]) -> "Layout":
        """The layout of parts with given numbers of vertices. Groups whose recipe does not join parts have no padding.

        Args:
            counts: Number of vertices of each part.
            parts: Indices of the parts of each group.
            joins: Whether the recipe of each group joins parts.
        """
        exact = [sum(counts[part] for part in members) for members in parts]
        pairs = zip(exact, joins, strict=True)
        size = [max(shared_size(count), _FEWEST) if padded else count for count, padded in pairs]
        return cls(tuple(counts), tuple(tuple(members) for members in parts), tuple(size))

    @classmethod
    def apart(cls, counts: Sequence[int]) -> "Layout":
        """The layout of parts each of which is a group of its own, without padding."""
        return cls(tuple(counts), tuple((part,) for part in range(len(counts))), tuple(counts))

    @cached_property
    def group(self) -> Int[np.ndarray, " n"]:
        """Group of each part."""
        result = np.empty(len(self.counts), np.int32)
        for group, members in enumerate(self.parts):
            result[list(members)] = group
        return result

    @cached_property
    def first(self) -> Int[np.ndarray, " n"]:
        """Index of the first vertex of each part in the scene."""
        return np.cumsum([0, *self.counts])[:-1].astype(np.int32)

    @cached_property
    def start(self) -> Int[np.ndarray, " n"]:
        """Index of the first vertex of each part in its group."""
        result = np.empty(len(self.counts), np.int32)
        for members in self.parts:
            result[list(members)] = np.cumsum([0, *(self.counts[part] for part in members)])[:-1]
        return result

    @cached_property
    def shift(self) -> Int[np.ndarray, " n"]:
        """Index of a vertex of each part in the scene, minus its index in its group."""
        return self.first - self.start

    def of_group(self, group: int, values: Sequence[T] | np.ndarray) -> list[T]:
        """The values of the parts of a group, from those of all parts."""
        return [values[part] for part in self.parts[group]]

    def vertices(self, group: int) -> Int[np.ndarray, " v"]:
        """Index in the scene of each vertex of a group, without padding."""
        pairs = zip(self.of_group(group, self.first), self.of_group(group, self.counts), strict=True)
        return np.concatenate([first + np.arange(count) for first, count in pairs])

    def order(self, points: Points | Sequence[Points] = VERTICES) -> Int[np.ndarray, " p"]:
        """Index of each vertex of the scene, or of each point, among those of all groups."""
        if not isinstance(points, Points):
            counts = [len(of_part) for of_part in points]
            size = [sum(self.of_group(group, counts)) for group in range(len(self.parts))]
            return Layout(tuple(counts), self.parts, tuple(size)).order()
        begin = np.cumsum([0, *self.size])[self.group] + self.start
        return np.concatenate([first + np.arange(n) for first, n in zip(begin, self.counts, strict=True)])

    def points(self, group: int, points: Points | Sequence[Points]) -> tuple[Points, Points]:
        """The vertices of a group, or the points on it, as points of the scene and of the group."""
        if isinstance(points, Points):
            vertex = self.column(group, [self.vertices(group)])
            return at_vertices(vertex.astype(np.int32)), VERTICES
        members = self.of_group(group, points)
        xp = np if known(members) else jnp
        in_scene, corner = (
            [of_part.corner + row for of_part, row in zip(members, self.of_group(group, first), strict=True)]
            for first in (self.first, self.start)
        )
        weight = xp.concatenate([of_part.weight for of_part in members], 1)
        slopes: list[Any] = [of_part.slope for of_part in members]
        slope = None if any(rows is None for rows in slopes) else xp.concatenate(slopes, 2)
        corners = (xp.concatenate(rows, 1) for rows in (in_scene, corner))
        scene, of_group = (Points(jnp.asarray(rows), jnp.asarray(weight), slope) for rows in corners)
        return scene, of_group

    def column(self, group: int, rows: Sequence[Any]) -> Any:
        """One array of a group from those of its parts. Padding repeats the last row."""
        xp = np if known(rows) else jnp
        whole = xp.concatenate([xp.asarray(row) for row in rows])
        room = [(0, self.size[group] - len(whole)), *[(0, 0)] * (whole.ndim - 1)]
        return xp.pad(whole, room, mode="edge")

    def gathered(self, group: int, appearances: Sequence[Appearance]) -> Appearance:
        """The appearance of a group from those of all parts."""
        members = self.of_group(group, appearances)
        emitted = None
        if any(look.emitted is not None for look in members):
            none = [np.zeros((count, 3), jnp.result_type(float)) for count in self.of_group(group, self.counts)]
            pairs = zip(members, none, strict=True)
            emitted = self.column(group, [zero if look.emitted is None else look.emitted for look, zero in pairs])
        if members[0].blend is None:
            return Appearance(None, emitted)
        blends = [look.blend for look in members if look.blend is not None]
        colors = max(blend.weight.shape[2] for blend in blends)
        wide = [_colored(blend.weight, colors) for blend in blends]
        parameter = zip(*(blend.parameter for blend in blends), strict=True)
        columns = tuple(self.column(group, rows) for rows in parameter)
        return Appearance(Blend(self.column(group, wide), columns), emitted)

    def fixed(self, group: int, look: Appearance, chosen: Sequence[bool]) -> VertexMaterials | None:
        """Materials that users give at the vertices of some parts, out of all materials of a group; None without."""
        flags, counts = self.of_group(group, chosen), self.of_group(group, self.counts)
        if look.blend is None or not any(flags):
            return None
        dtype = jnp.result_type(float)
        flag = self.column(group, [np.full(*row, dtype) for row in zip(counts, flags, strict=True)])
        emitted = np.zeros((self.size[group], 3), dtype) if look.emitted is None else look.emitted
        return put(VertexMaterials(look.blend, emitted, flag))


def _colored(weight: Any, colors: int) -> Any:
    """Weights repeated to a number of colors."""
    if weight.shape[2] == colors:
        return weight
    return (np if known(weight) else jnp).broadcast_to(weight, (*weight.shape[:2], colors))


class SceneLight(eqx.Module):
    """A light, before materials are known.

    Attributes:
        direct: The light in the form of the system of each group.
        transferred: The light after bounces; None without.
    """

    direct: tuple[PyTree, ...]
    transferred: PyTree


class Arriving(NamedTuple):
    """The light that arrives at a scene.

    Attributes:
        direct: Direct light, in the form of the system of each group.
        reflected: Reflected light at the vertices of each group; None without bounces.
        lamp: Radiance of each lamp; for a point light, its intensity. None without lamps.
    """

    direct: tuple[PyTree, ...]
    reflected: tuple[PyTree, ...] | None
    lamp: Float[Array, "n 3"] | None

    def at(self, group: int) -> tuple[PyTree, PyTree, PyTree]:
        """Direct light, reflected light and the lamps of a group."""
        return self.direct[group], None if self.reflected is None else self.reflected[group], self.lamp


class Stage(eqx.Module):
    """A scene with its materials at present: all that its methods, pictures and reflections read of materials.

    What is done for each row of points is a function and not a method: Equinox flattens an object whenever one of its
    methods is used.

    Attributes:
        whole: The mesh of all parts, whose regions are the parts.
        mesh: The same mesh, padded to shared sizes with faces without area.
        surfaces: One `Surface` for each group, as precomputed; `surface_of` has the rays that the materials need.
        table: The materials of all parts.
        appearance: The materials at the vertices of each group.
        fixed: For each group, materials that users give at vertices; None without.
        curvature: How fast the radiance of each part varies with direction, from `jaxprt.relit.curvature.of_part`.
        layout: Where the vertices of the parts stand.
        samples: Number of sample points along the edge of each bright texel, for each part.
        sharp: Whether narrow lobes of each part are traced by rays.
        rays: Number of reflection rays that each vertex or point of a sharp part sends.
        lamp: Index of the lamp that each part is; -1 for a part that does not emit.
        hidden: Whether cameras see through the backs of each part.
        point_lights: The point lights, in the coordinates of the mesh.
        power: Power of each lamp as precomputed, by which lamps share rays; None without lamps.
        radiance: Radiance of each lamp; for a point light, its intensity. None without lamps.
    """

    whole: Mesh
    mesh: Mesh
    surfaces: tuple[Surface, ...]
    table: MaterialTable
    appearance: tuple[Appearance, ...]
    fixed: tuple[VertexMaterials | None, ...]
    curvature: Float[Array | np.ndarray, " n"]
    layout: Layout
    samples: tuple[int, ...] = eqx.field(static=True)
    sharp: tuple[bool, ...] = eqx.field(static=True)
    rays: int = eqx.field(static=True)
    lamp: tuple[int, ...] = eqx.field(static=True)
    hidden: tuple[bool, ...] = eqx.field(static=True)
    point_lights: tuple[PointLight, ...] = ()
    power: Float[Array | np.ndarray, " l"] | None = None
    radiance: Float[Array, "l 3"] | None = None

    @property
    def hidden_faces(self) -> Bool[Array | np.ndarray, " f"] | None:
        """Triangles that cameras do not see from behind; None without."""
        return None if not any(self.hidden) else faces_of(self.whole, np.asarray(self.hidden)[self.part])

    @property
    def face(self) -> Int[Array | np.ndarray, "f 3"]:
        """Triangles of the mesh, in NumPy unless JAX traces them."""
        return np.asarray(self.mesh.face) if known(self.mesh.face) else self.mesh.face

    @property
    def part(self) -> Int[np.ndarray, " v"]:
        """Part of each vertex."""
        return np.repeat(np.arange(len(self.layout.counts)), self.layout.counts)

    @property
    def shift(self) -> Int[np.ndarray, " v"]:
        """Index of each vertex, minus its index in its group."""
        return self.layout.shift[self.part]

    @property
    def blends(self) -> list[Blend | None]:
        """Weights of the channels at the vertices of each group."""
        return [look.blend for look in self.appearance]

    @property
    def bend(self) -> Float[Array, " v"]:
        """Curvature of the radiance of each vertex of the padded mesh."""
        part = np.pad(self.part, (0, len(self.mesh.position) - len(self.part)), mode="edge")
        return put(np.asarray(self.curvature)[part]) if known(self.curvature) else jnp.asarray(self.curvature)[part]

    @property
    def sharp_groups(self) -> list[int]:
        """Indices of the groups from which reflection rays start."""
        return [group for group in range(len(self.surfaces)) if _has_rays(self, group)]

    def finer(self, group: int) -> bool:
        """Whether lobes of a group are so narrow that they read texels which `shadows.sharpened` light has."""
        samples = max(self.layout.of_group(group, self.samples))
        return samples >= _NARROW and self.surfaces[group].system.lobe_part is not None

    def sharp_at(self, group: int, points: Points) -> Float[Array, " p"] | None:
        """1 at points of the scene whose narrow lobes are traced, 0 at others; None for a group without rays."""
        if not _has_rays(self, group):
            return None
        flag = np.asarray(self.sharp, jnp.result_type(float))[self.part]
        if known(points):
            return put(flag[np.asarray(points.corner)[0]])
        return jnp.asarray(flag)[points.corner[0]]

    def blend(self, group: int, points: Points, on_group: Points) -> tuple[Blend | None, Points]:
        """Weights of the channels of a group's BRDF at some points, and the points with the normals of normal maps.

        Args:
            group: Index of the group.
            points: The points in the scene.
            on_group: The same points on the group, which the second result is made of.
        """
        look, surface = self.table.at(points), surface_of(self, group)
        with compile_time(look, on_group, self.fixed[group], surface.scale):
            return material(surface, on_group, look, self.fixed[group])[0], on_group.tilted(look.normal)


def _has_rays(stage: Stage, group: int) -> bool:
    """Whether reflection rays start from a group: some of its parts are sharp."""
    return stage.rays > 0 and stage.surfaces[group].has_rays and any(stage.layout.of_group(group, stage.sharp))


def surface_of(stage: Stage, group: int) -> Surface:
    """A group of a stage, with rays for its reflections if any of its parts is sharp."""
    surface = stage.surfaces[group]
    if surface.reflecting is None or not _has_rays(stage, group):
        return surface.without_rays
    return dataclasses.replace(surface, reflecting=dataclasses.replace(surface.reflecting, count=stage.rays))


def check_points(points: Any, counts: Sequence[int]) -> None:
    """Refuses anything but all vertices, or one list of points for each of the parts with some numbers of vertices."""
    if isinstance(points, Points) and points.all_vertices:
        return
    if isinstance(points, Points) or not isinstance(points, Sequence) or len(points) != len(counts):
        raise TypeError(f"the points must be a list, one for each of {len(counts)} parts, got {require.shown(points)}")
    for of_part, count in zip(points, counts, strict=True):
        protocol.check_points(of_part, count)


def light(surfaces: Sequence[Surface], bounces: GroupBounces | None, environment: Environment) -> SceneLight:
    """Projects an environment for the systems of all groups and for bounces."""
    return SceneLight(direct(surfaces, environment), None if bounces is None else bounces.light(environment))


def direct(surfaces: Sequence[Surface], environment: Environment) -> tuple[PyTree, ...]:
    """Projects an environment for the systems of all groups. Systems with the same `shared_light` share one result."""
    shared: dict[Any, PyTree] = {}
    result = []
    for surface in surfaces:
        key = surface.system.shared_light
        lit = surface.system.light(environment) if key is None or key not in shared else shared[key]
        if key is not None:
            shared[key] = lit
        result.append(lit)
    return tuple(result)


def projected(surfaces: Sequence[Surface], lights: Float[Array, "l 6 n n c"]) -> tuple[PyTree, ...]:
    """`protocol.projected` for the systems of all groups. Systems with the same `shared_light` share one result."""
    shared: dict[Any, PyTree] = {}
    for surface in surfaces:
        if surface.system.shared_light not in shared:
            shared[surface.system.shared_light] = protocol.projected(surface.system, lights)
    return tuple(shared[surface.system.shared_light] for surface in surfaces)


def kinds(shadings: Sequence[Shading], recipes: Sequence[Any]) -> list[list[int]]:
    """Indices of the parts of each group: parts with one BRDF and one recipe, if the recipe joins parts."""
    result: list[list[int]] = []
    for part, (shading, recipe) in enumerate(zip(shadings, recipes, strict=True)):
        for members in result:
            if recipe.joins and recipes[members[0]] == recipe and alike(shadings[members[0]], shading):
                members.append(part)
                break
        else:
            result.append([part])
    return result


def alike(one: Shading, other: Shading) -> bool:
    """Whether two parts have one BRDF, apart from the weights of its channels, and tables for the same roughness."""
    if one.table is not None or other.table is not None:
        return one.table is other.table
    if (one.blend is None) != (other.blend is None) or one.term != other.term or len(one.knot) != len(other.knot):
        return False
    leaves, kind = zip(*(jax.tree.flatten((shading.brdf, shading.knot)) for shading in (one, other)), strict=True)
    if kind[0] != kind[1] or not all(eqx.is_array(leaf) for arrays in leaves for leaf in arrays):
        return False
    return all(np.shape(a) == np.shape(b) and np.array_equal(a, b) for a, b in zip(*leaves, strict=True))


def faces_of(mesh: Mesh, vertex: Bool[np.ndarray, " v"]) -> Bool[Array | np.ndarray, " f"]:
    """What holds for the first vertex of each triangle, in NumPy unless JAX traces the mesh."""
    if known(mesh.face):
        return vertex[np.asarray(mesh.face)[:, 0]]
    return jnp.asarray(vertex)[mesh.face[:, 0]]


def joined_mesh(shadings: Sequence[Shading]) -> Mesh:
    """The meshes of several parts as one mesh, whose regions are the parts."""
    meshes = [shading.mesh for shading in shadings]
    return join([dataclasses.replace(mesh, region=np.zeros(len(mesh.position), np.int32)) for mesh in meshes])


def joined(shadings: Sequence[Shading]) -> Shading:
    """The `Shading` of several parts of one kind. The regions of its mesh are the parts."""
    first = dataclasses.replace(shadings[0], mesh=joined_mesh(shadings))
    if first.blend is None or len(shadings) == 1:
        return first
    blends = [shading.blend for shading in shadings if shading.blend is not None]
    parameter = tuple(np.concatenate(rows) for rows in zip(*(blend.parameter for blend in blends), strict=True))
    blend = Blend(np.concatenate([blend.weight for blend in blends]), parameter)
    return dataclasses.replace(first, blend=blend)


def surface(
    group: int,
    shadings: Sequence[Shading],
    layout: Layout,
    system: System,
    reflecting: ReflectingPart | None,
    lit: LitByLamps | None,
) -> Surface:
    """A group of a scene.

    Args:
        group: Index of the group.
        shadings: The `Shading` of each part of the scene.
        layout: Where the vertices of the parts stand.
        system: The system of direct light.
        reflecting: How the group reflects light from other surfaces; None without bounces.
        lit: How it reflects light from lamps; None without lamps.
    """
    members = layout.of_group(group, shadings)
    shading, dtype = members[0], jnp.result_type(float)
    scale = None
    if shading.scale is not None and shading.blend is not None:
        scale = jax.device_put(np.asarray(shading.scale, dtype))
    if (seen := system.texel_visibility) is not None:
        position, frame = put((seen.position, seen.frame))
    else:
        pairs = [
            (np.asarray(part.mesh.position, dtype), frames(part.mesh.normal, part.mesh.tangent)) for part in members
        ]
        position, frame = (
            jax.device_put(layout.column(group, rows).astype(dtype)) for rows in zip(*pairs, strict=True)
        )
    brdf, varies = grid.as_argument(shading.brdf), bool(shading.knot)
    return Surface(system, position, frame, brdf, reflecting, lit, scale, shading.term, varies)


def padded(mesh: Mesh) -> Mesh:
    """A mesh relative to its origin, padded to shared sizes: vertices repeat the last one, and faces have no area."""
    if not known(mesh):
        return mesh
    count = shared_size(len(mesh.position)) - len(mesh.position)
    fields = {name: getattr(mesh, name) for name in ("position", "normal", "tangent", "region")}
    rows = {
        name: np.pad(value, [(0, count)] + [(0, 0)] * (value.ndim - 1), mode="edge") for name, value in fields.items()
    }
    face = np.pad(mesh.face, ((0, shared_size(len(mesh.face)) - len(mesh.face)), (0, 0)))
    return put(dataclasses.replace(mesh, **rows, face=face, texture=None, origin=origins.ZERO, opacity=None))


@jit
def ordered(colors: tuple[Float[Array, "_ _"], ...], order: Int[Array, " v"]) -> Float[Array, "v c"]:
    """Colors of all vertices in the order of the scene, from those of the groups."""
    most = max(rows.shape[1] for rows in colors)
    return jnp.concatenate([jnp.broadcast_to(rows, (len(rows), most)) for rows in colors])[order]


@jit
def material(
    surface: Surface, points: Points, look: MaterialLook, fixed: VertexMaterials | None
) -> tuple[Blend | None, Float[Array, "p 3"]]:
    """Weights of the channels at points of a group, and the radiance that they emit.

    Args:
        surface: The group.
        points: The points.
        look: The materials at the points.
        fixed: Materials that users give at vertices; None without.
    """
    blend = surface.blend(look)
    if fixed is None or blend is None:
        return blend, jnp.asarray(look.emitted)
    flag = points.carry(fixed.flag) > 0.5  # All corners belong to one part.
    weight = jnp.where(flag[:, None, None], points.carry(fixed.blend.weight), blend.weight)
    pairs = zip(fixed.blend.parameter, blend.parameter, strict=True)
    parameter = tuple(jnp.where(flag, points.carry(one), other) for one, other in pairs)
    return Blend(weight, parameter), jnp.where(flag[:, None], points.carry(fixed.emitted), look.emitted)
