"""Systems, transports and scenes sharded over several devices by their vertices.

Type annotations of fields name the axes of arrays. Arrays of vertices are sharded along the axis ``v``, and arrays of
clusters of vertices along ``p`` or ``g``. All other arrays are replicated on every device. The same functions run on
sharded arrays.
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
from jaxprt.scene.points import VERTICES, Points
from jaxprt.systems import protocol
from jaxprt.systems.axes import leaves, map_leaves
from jaxprt.systems.protocol import Blend, System, VertexSystem
from jaxprt.visibility.rays import BLOCK

Value = TypeVar("Value", bound=PyTree)

_AXES = "v", "block", "p", "g"  # vertices, blocks of them, clusters of them


class Padded(System):
    """A system padded with vertices so that each device holds the same number. Radiance is returned without padding.

    Attributes:
        system: The system with padding at its end, which repeats the last vertex.
        count: Number of vertices without padding.
    """

    system: VertexSystem
    count: int = eqx.field(static=True)

    def light(self, environment: Environment) -> PyTree:
        """The light of the system."""
        return self.system.light(environment)

    def shade(self, light: PyTree, materials: Blend | None = None) -> PyTree:
        """Light that arrives at the vertices, padding included."""
        return self.system.shade(light, self._pad(materials))

    def view(self, eye: Float[Array, "3"], materials: Blend | None = None, points: Points = VERTICES) -> PyTree:
        """The view of the system."""
        protocol.check_points(points, self.count)
        return self.system.view(eye, self._pad(materials) if points.all_vertices else materials, points)

    def combine(self, light: PyTree, view: PyTree, points: Points = VERTICES) -> Float[Array, "p c"]:
        """Radiance of the points, without padding."""
        return self.system.combine(light, view, points)[: points.count(self.count)]

    @property
    def vertices(self) -> int:
        """Number of vertices, without padding."""
        return self.count

    @property
    def shared_light(self) -> tuple | None:
        """Key of the system's light."""
        return self.system.shared_light

    def _pad(self, materials: Blend | None) -> Blend | None:
        protocol.check_blend(materials)
        if materials is None:
            return None
        materials.check(self.count, materials.weight.shape[1])
        return _pad(materials, self.count, self.system.vertices)


def shard(value: Value, devices: Sequence[jax.Device]) -> Value:  # pyright: ignore[reportInvalidTypeForm]
    """Shards a transport, a system or a scene over devices, each of which gets an equal share of the vertices.

    For example `scene = jaxprt.shard(scene, jax.devices())`. Light, views, radiance, pictures and gradients are then
    computed on the devices that hold the vertices. A system whose number of vertices is not divisible by the number of
    devices is padded with vertices, which do not appear in the results. Other arrays that are not divisible, such as
    those of the regions of a dynamic system, are replicated on every device.

    Args:
        value: A transport, a system or a scene.
        devices: One or more devices.

    Returns:
        The same object with its arrays on the devices. A system that needed padding is a `Padded` system.

    Raises:
        TypeError: `value` has no vertices.
        ValueError: `devices` is empty, holds something other than devices, or names one twice; or the number of
            vertices of a transport is not divisible by that of the devices.
    """
    across = _mesh(devices)
    if not any("v" in axes for axes, _ in leaves(value)):
        raise TypeError(
            f"value must be a transport, system or scene of jaxprt, which have vertices, got {type(value).__name__}"
        )
    even = jax.tree.map(lambda part: _even(part, across.size), value, is_leaf=lambda x: isinstance(x, VertexSystem))
    if not isinstance(value, System):
        _check_shares(value, across.size)
    return map_leaves(even, lambda axes, leaf: _put(axes, leaf, across))


def _mesh(devices: Any) -> jax.sharding.Mesh:
    row = list(devices) if isinstance(devices, Sequence | np.ndarray) else [devices]
    if not row or not all(isinstance(device, jax.Device) for device in row) or len(set(row)) < len(row):
        raise ValueError(f"the devices must be one or more of {jax.devices()}, each at most once, got {devices}")
    return jax.sharding.Mesh(np.array(row), ("vertex",))


def _even(value: PyTree, shares: int) -> PyTree:
    """The system, padded if its number of vertices is not divisible by the number of shares."""
    if not isinstance(value, VertexSystem):
        return value
    step = shares * (BLOCK if any("block" in axes for axes, _ in leaves(value)) else 1)
    count = value.vertices
    return value if count % step == 0 else Padded(_pad(value, count, count + -count % step), count)


def _pad(value: Value, count: int, size: int) -> Value:
    """Pads the arrays of `count` vertices to `size` by repeating the last vertex."""

    def longer(axes, leaf):
        for name, before, after in (("v", count, size), ("block", -(-count // BLOCK), -(-size // BLOCK))):
            if name in axes and leaf.shape[axes.index(name)] == before:
                return jnp.pad(leaf, [(0, after - before if axis == name else 0) for axis in axes], mode="edge")
        return leaf

    return map_leaves(value, longer)


def _check_shares(value: PyTree, shares: int) -> None:
    """Refuses a transport whose number of vertices is not divisible by the number of shares."""
    for axes, leaf in leaves(value):
        if "v" in axes and leaf.shape[axes.index("v")] % shares:
            raise ValueError(
                f"the number of vertices of a transport must be divisible by the {shares} devices, got "
                f"{leaf.shape[axes.index('v')]}: distribute a system instead, which may have any number of vertices"
            )


def _put(axes: list[str], leaf: Any, across: jax.sharding.Mesh) -> Any:
    if not isinstance(leaf, jax.Array):  # NumPy arrays and Python numbers stay on the host.
        return leaf
    cut = [name for name in _AXES if name in axes and leaf.shape[axes.index(name)]]
    cut = [name for name in cut if leaf.shape[axes.index(name)] % across.size == 0][:1]
    spec = PartitionSpec(*("vertex" if name in cut else None for name in axes))
    return jax.device_put(leaf, NamedSharding(across, spec))
