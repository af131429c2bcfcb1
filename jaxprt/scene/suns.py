"""Suns: distant lights of one direction each, and environments to which they are added."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.compile import jit
from jaxprt.scene.environment import Environment
from jaxprt.sphere import cubemap


def _three(value: Any) -> Any:
    """A number or three numbers as an array of shape [3]. What is not of numbers is left for the class to refuse."""
    value = require.floating(value, dtype=jnp.result_type(float))
    return jnp.broadcast_to(value, (3,)) if isinstance(value, jax.Array) and value.ndim == 0 else value


class Sun(eqx.Module):
    """A distant light of one direction, such as a directional light of a glTF file.

    Attributes:
        name: Name of the light.
        direction: Direction from the scene towards the light, in world coordinates, of any length.
        irradiance: Irradiance of a surface that faces the light, in units of radiance times steradian.

    Raises:
        TypeError: The name is not a string.
        ValueError: The direction or the irradiance is not finite or of another shape, the direction is zero, or the
            irradiance is negative.
    """

    name: str = eqx.field(static=True)
    direction: Float[Array, "3"] = eqx.field(converter=require.floating)
    irradiance: Float[Array, "3"] = eqx.field(converter=_three, default=1.0)

    def __check_init__(self):
        """Refuses values that are not finite, and directions of no length."""
        if not isinstance(self.name, str):
            raise TypeError(f"the name of a sun must be text, got {self.name!r}")
        require.finite(f"the direction of sun {self.name!r}", self.direction)
        require.at_least(f"the irradiance of sun {self.name!r}", self.irradiance, 0.0)
        for name in ("direction", "irradiance"):
            shape = list(jnp.shape(getattr(self, name)))
            if shape != [3]:
                raise ValueError(f"the {name} of sun {self.name!r} must be three numbers, got an array {shape}")
        if not isinstance(self.direction, Tracer) and not self.direction.any():
            raise ValueError(f"the direction of sun {self.name!r} must not be zero, got {self.direction}")


def _light(value: Any) -> None:
    require.kind("the light", value, Environment, source="jaxprt.load_environment")


def _suns(value: Any) -> tuple[Sun, ...]:
    if not isinstance(value, Sequence) or isinstance(value, str | bytes):
        raise TypeError(f"suns must be a list of suns, got {require.shown(value)}")
    for sun in value:
        require.kind("each of the suns", sun, Sun, source="jaxprt.scene.Sun")
    return tuple(value)


@require.arguments(light=_light, suns=_suns)
@jit
def with_suns(light: Environment, suns: Sequence[Sun]) -> Environment:
    """Adds suns to distant light: each fills one texel, whose flux is the sun's irradiance.

    A texel of 6 x 64 x 64 has a width of 1.4 degrees, which is 2.6 times that of the sun in the sky. The result is
    linear in the light and in the irradiances. It does not change as a direction moves within a texel, so its
    gradient by directions is zero.

    Args:
        light: One light, or a batch of them, in three colors or in one. One color becomes three.
        suns: The suns, such as `suns` of a scene; may be empty.

    Returns:
        The light with the suns, in three colors.

    Raises:
        TypeError: The light is not an `Environment`, or `suns` is not a list of suns.
        ValueError: The light has another number of colors than one and three.
    """
    radiance = light.radiance
    if radiance.shape[-1] not in (1, 3):
        raise ValueError(f"the light must have one color or three for suns, got {radiance.shape[-1]}")
    radiance = jnp.broadcast_to(radiance, (*radiance.shape[:-1], 3))
    size = radiance.shape[-2]
    area = cubemap.solid_angle(size=size).astype(radiance.dtype)
    for sun in suns:
        face, place = cubemap.coordinates(jax.lax.stop_gradient(sun.direction))
        column, row = (jnp.clip(jnp.floor((place[i] + 1) / 2 * size), 0, size - 1).astype(jnp.int32) for i in (0, 1))
        value = sun.irradiance.astype(radiance.dtype) / area[face, row, column]
        radiance = radiance.at[..., face, row, column, :].add(value)
    return Environment(radiance)
