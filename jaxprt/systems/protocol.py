"""The four verbs that every system has, and what they give together: radiance, sums of systems, bytes.

L = system.light(environment)          redone when the light changes
A = system.shade(L, materials)         redone when materials change what arrives; the light itself but for bounces
V = system.view(eye, materials)        redone when the view or the materials change
radiance = system.combine(A, V)        in the mesh's order of vertices
"""

import abc
import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxprt import require
from jaxprt.scene.environment import Environment
from jaxprt.scene.points import Points, placed


class System(eqx.Module):
    """Precomputed transport together with the form of the BRDF that it needs: a frozen pytree with four verbs.

    Subclasses say what `light` and `view` return. Each verb may be called inside `jax.jit`, and all are differentiable
    in what they are given.
    """

    @abc.abstractmethod
    def light(self, environment: Environment) -> PyTree:
        """What a light is to this system. Redone when the light changes.

        Raises:
            TypeError: It is no Environment.
            ValueError: It is a batch, has another size than the transport, or is not finite.
        """

    def shade(self, light: PyTree, materials: PyTree = None) -> PyTree:
        """What arrives at the vertices. Redone when materials change that; without bounces it is the light itself."""
        return light

    @abc.abstractmethod
    def view(self, eye: Float[Array, "3"], materials: PyTree = None) -> PyTree:
        """What a view and the materials are to this system. Redone when either changes.

        Args:
            eye: Position of the viewer in world units.
            materials: What the vertices are made of, where that is free: `Blend`, or as the system names it.

        Raises:
            TypeError: The materials are of another kind.
            ValueError: The eye is not one position or not finite, or materials do not fit the vertices.
        """

    @abc.abstractmethod
    def combine(self, light: PyTree, view: PyTree) -> Float[Array, "v c"]:
        """Radiance that each vertex sends to the eye, linear, in the mesh's order of vertices.

        Args:
            light: From `shade`, or from `light` without bounces.
            view: From `view`.

        Raises:
            TypeError: Light or view were not made by this kind of system.
        """

    @abc.abstractmethod
    def at(self, points: Any) -> "System":
        """The same system at points between the vertices instead of the vertices: light is that of the system itself.

        `radiance(system.at(points), ...)` is at the points, in their order, and so are materials. What belongs to the
        transport of vertices is interpolated; position, frame, view and BRDF are the point's own.

        Args:
            points: `Points` on the triangles of the mesh, of a system of several parts a list of one for each.

        Raises:
            TypeError: They are no points.
        """

    @property
    @abc.abstractmethod
    def vertices(self) -> int:
        """Number of vertices, or of points."""

    @property
    def shared_light(self) -> tuple | None:
        """What `light` depends on besides the environment: systems of equal values have equal lights. None: on more."""
        return None


class VertexSystem(System):
    """A system of the vertices of one mesh, and of points between them.

    Attributes:
        points: Where radiance is asked for; None for the vertices.
    """

    points: Points | None = eqx.field(default=None, kw_only=True)

    def at(self, points: Points) -> "VertexSystem":
        """The same system at points: `System.at`.

        Raises:
            ValueError: Points are not on triangles of the mesh.
        """
        require.kind("the points", points, Points, source="jaxprt.scene.points.on_triangles")
        every = eqx.tree_at(lambda each: each.points, self, None, is_leaf=lambda each: each is None)
        points.check(every.vertices)
        return eqx.tree_at(lambda each: each.points, self, points, is_leaf=lambda each: each is None)

    def carried(self, attribute: Float[Array, "..."], *, axis: int = 0) -> Float[Array, "..."]:
        """What is linear in an attribute of the vertices, where radiance is asked for."""
        return attribute if self.points is None else self.points.carry(attribute, axis=axis)

    def place(self, transport: Any) -> tuple[Float[Array, "v 3"], Float[Array, "v 3 3"]]:
        """Positions and frames of where radiance is asked for; `transport` has those of the vertices."""
        return placed(transport.position, transport.frame, self.points)


class Blend(eqx.Module):
    """What each vertex is made of, over a BRDF of several channels.

    A BRDF with textures is a sum of a few fixed gray BRDFs with weights that vary: the system holds the fixed ones as
    channels, the blend the weights. Radiance is linear in the weights, and differentiable in them.

    Attributes:
        weight: How much each vertex has of each channel k, in each color.
        parameter: The parameters of each vertex, for a BRDF that was tabulated over some.
    """

    weight: Float[Array, "v k c"]
    parameter: tuple[Float[Array, " v"], ...] = ()

    def __check_init__(self):
        """Refuses weights and parameters that are not finite, and parameters of other numbers of vertices."""
        require.finite("the weights of the blend", self.weight)
        for each in self.parameter:
            require.finite("the parameters of the blend", each)
            require.length("the parameters of the blend", each, len(self.weight))

    def check(self, vertices: int, channels: int) -> None:
        """Refuses a blend of other numbers of vertices or channels.

        Raises:
            ValueError: It has others.
        """
        if self.weight.shape[:2] != (vertices, channels):
            raise ValueError(
                f"the blend must have weights [{vertices} vertices, {channels} channels, c], "
                f"got {list(self.weight.shape)}"
            )


def check_blend(value: Any) -> None:
    """Refuses materials that are neither None nor a `Blend`."""
    if value is not None:
        require.kind("the materials", value, Blend, source="jaxprt.systems.protocol.Blend")


class Total(System):
    """The sum of several systems over the same vertices, such as direct and reflected light.

    Attributes:
        part: The systems. All get the same materials.
    """

    part: tuple[System, ...]

    def __check_init__(self):
        """Refuses systems of different vertices."""
        counts = [each.vertices for each in self.part]
        if len(set(counts)) != 1:
            raise ValueError(f"systems must be one or more, of as many vertices, got {counts}")

    def light(self, environment: Environment) -> tuple[PyTree, ...]:
        """The light of each system."""
        return tuple(each.light(environment) for each in self.part)

    def shade(self, light: tuple[PyTree, ...], materials: PyTree = None) -> tuple[PyTree, ...]:
        """What arrives, of each system."""
        require.kind("the light", light, tuple, source="Total.light")
        return tuple(each.shade(lit, materials) for each, lit in zip(self.part, light, strict=True))

    def view(self, eye: Float[Array, "3"], materials: PyTree = None) -> tuple[PyTree, ...]:
        """The view of each system."""
        return tuple(each.view(eye, materials) for each in self.part)

    def combine(self, light: tuple[PyTree, ...], view: tuple[PyTree, ...]) -> Float[Array, "v c"]:
        """The sum of the radiance of all systems."""
        require.kind("the light", light, tuple, source="Total.light")
        require.kind("the view", view, tuple, source="Total.view")
        parts = (each.combine(*sides) for each, *sides in zip(self.part, light, view, strict=True))
        return sum(parts, start=jnp.zeros((), jnp.result_type(float)))

    def at(self, points: Any) -> "Total":
        """The sum at points: `System.at`."""
        return Total(tuple(each.at(points) for each in self.part))

    @property
    def vertices(self) -> int:
        """Number of vertices, or of points."""
        return self.part[0].vertices


class Joined(System):
    """Systems of different vertices, those of one after those of the next, as `scene.mesh.join` puts them.

    Materials are one of each system, or None.

    Attributes:
        part: The systems.
    """

    part: tuple[System, ...]

    def light(self, environment: Environment) -> tuple[PyTree, ...]:
        """The light of each system; of systems that share it made once."""
        made: dict[tuple, PyTree] = {}
        result = []
        for each in self.part:
            key = each.shared_light
            lit = each.light(environment) if key is None or key not in made else made[key]
            if key is not None:
                made[key] = lit
            result.append(lit)
        return tuple(result)

    def shade(self, light: tuple[PyTree, ...], materials: Sequence | None = None) -> tuple[PyTree, ...]:
        """What arrives, of each system."""
        require.kind("the light", light, tuple, source="Joined.light")
        triples = zip(self.part, light, self._given(materials), strict=True)
        return tuple(each.shade(lit, own) for each, lit, own in triples)

    def view(self, eye: Float[Array, "3"], materials: Sequence | None = None) -> tuple[PyTree, ...]:
        """The view of each system."""
        return tuple(each.view(eye, own) for each, own in zip(self.part, self._given(materials), strict=True))

    def combine(self, light: tuple[PyTree, ...], view: tuple[PyTree, ...]) -> Float[Array, "v c"]:
        """Radiance of all vertices; gray systems get as many colors as the others have."""
        require.kind("the light", light, tuple, source="Joined.light")
        require.kind("the view", view, tuple, source="Joined.view")
        parts = [each.combine(*sides) for each, *sides in zip(self.part, light, view, strict=True)]
        colors = max(each.shape[1] for each in parts)
        return jnp.concatenate([jnp.broadcast_to(each, (len(each), colors)) for each in parts])

    def at(self, points: Sequence) -> "Joined":
        """Points of each system, one list after the other: `System.at`."""
        check_list(points, len(self.part))
        return Joined(tuple(each.at(own) for each, own in zip(self.part, points, strict=True)))

    def _given(self, materials: Sequence | None) -> Sequence:
        if materials is None:
            return [None] * len(self.part)
        if not isinstance(materials, Sequence) or len(materials) != len(self.part):
            raise TypeError(f"the materials must be a list, one for each of {len(self.part)} parts, got {materials}")
        return materials

    @property
    def vertices(self) -> int:
        """Number of vertices."""
        return sum(each.vertices for each in self.part)

    @property
    def shared_light(self) -> tuple | None:
        """Those of the systems, if all have one."""
        keys = tuple(each.shared_light for each in self.part)
        return None if None in keys else (Joined, *keys)


def check_list(points: Any, parts: int) -> None:
    """Refuses what is no list of points for each of so many parts.

    Raises:
        TypeError: It is none.
    """
    if not isinstance(points, Sequence) or len(points) != parts:
        raise TypeError(f"the points must be a list, one for each of {parts} parts, got {type(points).__name__}")


def check_points(points: Any, vertices: Sequence[int]) -> tuple[Points, ...]:
    """Refuses what is no list of points for each part, of so many vertices.

    Raises:
        TypeError: It is none.
        ValueError: Points are not on triangles of their part.
    """
    check_list(points, len(vertices))
    for each, count in zip(points, vertices, strict=True):
        require.kind("the points", each, Points, source="jaxprt.scene.points.on_triangles")
        each.check(count)
    return tuple(points)


def total(*systems: System) -> Total:
    """The sum of systems: `total(direct, bounces)`.

    Raises:
        TypeError: One of them is no system.
        ValueError: There are none, or they are of different vertices.
    """
    for each in systems:
        _check(each)
    return Total(systems)


def radiance(
    system: System, environment: Environment, *, eye: Float[Array, "3"], materials: PyTree = None
) -> Float[Array, "*l v c"]:
    """Radiance that each vertex sends to the eye: all four verbs of any system.

    Args:
        system: The system.
        environment: The light, or a batch of them along leading axes.
        eye: Position of the viewer in world units.
        materials: As in `System.view`.

    Returns:
        Linear radiance in the light's units, in the mesh's order of vertices. Differentiable in the light, the eye and
        the materials.

    Raises:
        TypeError: The first argument is no system, the light no Environment, or materials are of another kind.
        ValueError: As in the verbs of the system.
    """
    _check(system)
    require.kind("the light", environment, Environment, source="jaxprt.scene.load_environment")
    *batch, faces, rows, columns, colors = environment.radiance.shape
    view = system.view(eye, materials)
    if not batch:
        return system.combine(system.shade(system.light(environment), materials), view)
    if not math.prod(batch):
        raise ValueError(f"a batch of lights must hold at least one, got {list(environment.radiance.shape)}")
    lights = [Environment(each) for each in environment.radiance.reshape(-1, faces, rows, columns, colors)]
    color = [system.combine(system.shade(system.light(each), materials), view) for each in lights]
    return jnp.stack(color).reshape(*batch, *color[0].shape)


def memory(system: System) -> int:
    """Bytes that a system holds: transport, and the form of its BRDF."""
    _check(system)
    return sum(each.nbytes for each in {id(x): x for x in jax.tree.leaves(system) if hasattr(x, "nbytes")}.values())


def _check(system: Any) -> None:
    if not isinstance(system, System):
        raise TypeError(
            "the system must be one of jaxprt, such as jaxprt.lobe.LobeSystem(transport, table), "
            f"got {type(system).__name__}"
        )
