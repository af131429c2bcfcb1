"""Systems, transports and scenes laid over several devices by their vertices.

Fields of the package's classes say what their axes are. Arrays of vertices are cut along the axis ``v`` and those of
clusters of vertices along ``p`` or ``g``; all else lies whole on every device. The same functions then run on it.
"""

import dataclasses
import typing
from collections.abc import Iterator, Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec
from jaxtyping import Array, Float, PyTree

from jaxprt.scene.environment import Environment
from jaxprt.scene.points import Points
from jaxprt.systems import protocol
from jaxprt.systems.protocol import Blend, System, VertexSystem
from jaxprt.visibility.rays import BLOCK

Laid = TypeVar("Laid", bound=PyTree)

_AXES = "v", "pair", "p", "g"  # vertices, pairs of them, clusters of them


class Padded(System):
    """A system with spare vertices at its end, so that each device has as many, seen without them.

    Attributes:
        system: The system with its spare vertices, which repeat the last.
        count: Number of vertices without them.
    """

    system: VertexSystem
    count: int = eqx.field(static=True)

    def light(self, environment: Environment) -> PyTree:
        """The light of the system."""
        return self.system.light(environment)

    def shade(self, light: PyTree, materials: Blend | None = None) -> PyTree:
        """What arrives at the vertices, and at the spare ones."""
        return self.system.shade(light, self._padded(materials))

    def view(self, eye: Float[Array, "3"], materials: Blend | None = None) -> PyTree:
        """The view of the system."""
        return self.system.view(eye, self._padded(materials))

    def combine(self, light: PyTree, view: PyTree) -> Float[Array, "v c"]:
        """Radiance of the vertices."""
        return self.system.combine(light, view)[: self.count]

    def at(self, points: Points) -> System:
        """The system at points: `System.at`."""
        if isinstance(points, Points):
            points.check(self.count)
        return self.system.at(points)

    @property
    def vertices(self) -> int:
        """Number of vertices, without spare ones."""
        return self.count

    @property
    def shared_light(self) -> tuple | None:
        """That of the system."""
        return self.system.shared_light

    def _padded(self, materials: Blend | None) -> Blend | None:
        protocol.check_blend(materials)
        if materials is None:
            return None
        materials.check(self.count, materials.weight.shape[1])
        return _padded(materials, self.count, self.system.vertices)


def shard(value: Laid, devices: Sequence[jax.Device]) -> Laid:  # pyright: ignore[reportInvalidTypeForm]
    """Lays a transport, a system or a scene over devices, each of which gets an equal share of the vertices.

    What is made of it, light, views, radiance, pictures and gradients, is computed where the vertices are. Systems
    whose vertices do not divide get a few spare ones, which nobody sees. Other arrays that do not divide, such as those
    of the regions of a dynamic system, lie whole on every device.

    Args:
        value: What is laid: `scene = jaxprt.shard(scene, jax.devices())`.
        devices: The devices, one or more.

    Returns:
        The same on the devices. A system whose vertices do not divide is a `Padded` one.

    Raises:
        TypeError: What is laid has no vertices.
        ValueError: There are no devices, what is given are none, or one is given twice; or the vertices of a transport
            do not divide.
    """
    across = _mesh(devices)
    if not any(_axis(hint, leaf, "v") is not None for hint, leaf in _leaves(value)):
        raise TypeError(f"only transports, systems and scenes of jaxprt have vertices, got {type(value).__name__}")
    even = jax.tree.map(lambda each: _even(each, across.size), value, is_leaf=lambda x: isinstance(x, VertexSystem))
    if not isinstance(value, System):
        _check_shares(value, across.size)
    made: dict[int, Any] = {}  # What is held twice stays one array.
    leaves = list(_leaves(even))
    for hint, leaf in leaves:
        if id(leaf) not in made:
            made[id(leaf)] = _put(hint, leaf, across)
    return jax.tree.unflatten(jax.tree.structure(even), [made[id(leaf)] for _, leaf in leaves])


def _mesh(devices: Any) -> jax.sharding.Mesh:
    each = list(devices) if isinstance(devices, Sequence | np.ndarray) else [devices]
    if not each or not all(isinstance(one, jax.Device) for one in each) or len(set(each)) < len(each):
        raise ValueError(f"the devices must be one or more different ones of {jax.devices()}, got {devices}")
    return jax.sharding.Mesh(np.array(each), ("vertex",))


def _even(value: Any, shares: int) -> Any:
    """A system whose vertices divide."""
    if not isinstance(value, VertexSystem) or value.points is not None or value.vertices % shares == 0:
        return value
    count = value.vertices
    return Padded(_padded(value, count, count + -count % shares), count)


def _padded(value: Laid, count: int, size: int) -> Laid:
    """What has so many vertices, with more that repeat the last."""

    def longer(hint: Any, leaf: Any) -> Any:
        for name, before, after in (("v", count, size), ("pair", _pairs(count), _pairs(size))):
            axis = _axis(hint, leaf, name)
            if axis is not None and leaf.shape[axis] == before:
                return jnp.pad(leaf, [(0, after - before if n == axis else 0) for n in range(leaf.ndim)], mode="edge")
        return leaf

    return jax.tree.unflatten(jax.tree.structure(value), [longer(*each) for each in _leaves(value)])


def _pairs(vertices: int) -> int:
    """Bytes that `StoredVisibility` has for so many vertices."""
    return -(-vertices // BLOCK) * BLOCK // 2


def _leaves(value: PyTree) -> Iterator[tuple[Any, Any]]:
    """The leaves, in order, each with the annotation of the field that holds it; None where none does."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(value):
        yield _hint(value, path), leaf


def _hint(node: Any, path: Sequence[Any]) -> Any:
    """The annotation of the last field on a path."""
    hint = None
    for key in path:
        if isinstance(key, jax.tree_util.GetAttrKey) and dataclasses.is_dataclass(node):
            hint = {each.name: each.type for each in dataclasses.fields(node)}[key.name]
            node = getattr(node, key.name)
        elif isinstance(key, jax.tree_util.SequenceKey):
            node = node[key.idx]
        elif isinstance(key, jax.tree_util.DictKey):
            node = node[key.key]
        else:  # of a class that is not the package's
            return None
    return hint


def _axis(hint: Any, leaf: Any, name: str) -> int | None:
    """Which axis of an array is called so by the annotation of its field; None if none is."""
    if not isinstance(leaf, jax.Array | np.ndarray):
        return None
    for names in _names(hint):
        if name in names and len(names) == leaf.ndim:
            return names.index(name)
    return None


def _names(hint: Any) -> Iterator[list[str]]:
    """Names of axes that an annotation has."""
    if hasattr(hint, "dim_str"):
        yield hint.dim_str.split()
    for each in typing.get_args(hint):
        yield from _names(each)


def _check_shares(value: PyTree, shares: int) -> None:
    """Refuses a transport whose vertices do not divide."""
    for hint, leaf in _leaves(value):
        axis = _axis(hint, leaf, "v")
        if axis is not None and leaf.shape[axis] % shares:
            raise ValueError(
                f"the transport's {leaf.shape[axis]} vertices must divide by {shares} devices; "
                "lay a system over them, which may have any number"
            )


def _put(hint: Any, leaf: Any, across: jax.sharding.Mesh) -> Any:
    if not isinstance(leaf, jax.Array):  # Numbers and tables of the host stay there.
        return leaf
    axes = [axis for name in _AXES if (axis := _axis(hint, leaf, name)) is not None and leaf.shape[axis]]
    cut = [axis for axis in axes if leaf.shape[axis] % across.size == 0][:1]
    spec = PartitionSpec(*("vertex" if n in cut else None for n in range(leaf.ndim)))
    return jax.device_put(leaf, NamedSharding(across, spec))
