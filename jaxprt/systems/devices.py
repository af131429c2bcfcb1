"""Systems, transports and scenes laid over several devices by their vertices.

Fields of the package's classes say what their axes are. Arrays of vertices are cut along the axis ``v`` and those of
clusters of vertices along ``p`` or ``g``; all else lies whole on every device. The same functions then run on it.
"""

from collections.abc import Sequence
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
from jaxprt.systems.axes import leaves
from jaxprt.systems.protocol import Blend, System, VertexSystem
from jaxprt.visibility.rays import BLOCK

Laid = TypeVar("Laid", bound=PyTree)

_AXES = "v", "block", "p", "g"  # vertices, blocks of them, clusters of them


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
    if not any("v" in axes for axes, _ in leaves(value)):
        raise TypeError(f"only transports, systems and scenes of jaxprt have vertices, got {type(value).__name__}")
    even = jax.tree.map(lambda each: _even(each, across.size), value, is_leaf=lambda x: isinstance(x, VertexSystem))
    if not isinstance(value, System):
        _check_shares(value, across.size)
    made: dict[int, Any] = {}  # What is held twice stays one array.
    every = list(leaves(even))
    for axes, leaf in every:
        if id(leaf) not in made:
            made[id(leaf)] = _put(axes, leaf, across)
    return jax.tree.unflatten(jax.tree.structure(even), [made[id(leaf)] for _, leaf in every])


def _mesh(devices: Any) -> jax.sharding.Mesh:
    each = list(devices) if isinstance(devices, Sequence | np.ndarray) else [devices]
    if not each or not all(isinstance(one, jax.Device) for one in each) or len(set(each)) < len(each):
        raise ValueError(f"the devices must be one or more different ones of {jax.devices()}, got {devices}")
    return jax.sharding.Mesh(np.array(each), ("vertex",))


def _even(value: Any, shares: int) -> Any:
    """A system whose vertices divide."""
    if not isinstance(value, VertexSystem) or value.points is not None:
        return value
    step = shares * (BLOCK if any("block" in axes for axes, _ in leaves(value)) else 1)
    count = value.vertices
    return value if count % step == 0 else Padded(_padded(value, count, count + -count % step), count)


def _padded(value: Laid, count: int, size: int) -> Laid:
    """What has so many vertices, with more that repeat the last."""

    def longer(axes: list[str], leaf: Any) -> Any:
        for name, before, after in (("v", count, size), ("block", -(-count // BLOCK), -(-size // BLOCK))):
            if name in axes and leaf.shape[axes.index(name)] == before:
                return jnp.pad(leaf, [(0, after - before if each == name else 0) for each in axes], mode="edge")
        return leaf

    return jax.tree.unflatten(jax.tree.structure(value), [longer(*each) for each in leaves(value)])


def _check_shares(value: PyTree, shares: int) -> None:
    """Refuses a transport whose vertices do not divide."""
    for axes, leaf in leaves(value):
        if "v" in axes and leaf.shape[axes.index("v")] % shares:
            raise ValueError(
                f"the transport's {leaf.shape[axes.index('v')]} vertices must divide by {shares} devices; "
                "lay a system over them, which may have any number"
            )


def _put(axes: list[str], leaf: Any, across: jax.sharding.Mesh) -> Any:
    if not isinstance(leaf, jax.Array):  # Numbers and tables of the host stay there.
        return leaf
    cut = [name for name in _AXES if name in axes and leaf.shape[axes.index(name)]]
    cut = [name for name in cut if leaf.shape[axes.index(name)] % across.size == 0][:1]
    spec = PartitionSpec(*("vertex" if name in cut else None for name in axes))
    return jax.device_put(leaf, NamedSharding(across, spec))
