"""Spherical harmonics of an environment: light probes in the conventions of other tools, and irradiance."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jaxprt import require
from jaxprt.scene.environment import Environment
from jaxprt.sphere import harmonics, low_frequency

_DEGREE = 2
_COSINE = (1.0, 2 / 3, 1 / 4)  # factor of a clamped cosine over pi on each band: Ramamoorthi and Hanrahan 2001
_MIRRORED = (3, 4, 7)  # harmonics that are odd in x
TOOLS = ("three.js", "Filament", "Unity")


def light_probe(environment: Environment, *, tool: str) -> Float[Array, "9 3"]:
    """The first nine spherical harmonics of a light, in the scaling and axes of a tool, for its diffuse lighting.

    Let c be the coefficients in the orthonormal basis, in the order 1, y, z, x, xy, yz, 3 z^2 - 1, xz, x^2 - y^2. Then:

    * "three.js" gets c, the coefficients of radiance, for `new SphericalHarmonics3().fromArray(probe.flat())`, which a
      `LightProbe` takes. Its shaders multiply the bands by pi, 2 pi / 3 and pi / 4 for irradiance.
    * "Filament" gets c times the factors of the clamped cosine over pi and of the basis. The sum of coefficients times
      the bare polynomials above is then irradiance over pi: `IndirectLight.Builder.irradiance(3, probe)`.
    * "Unity" gets the same for `SphericalHarmonicsL2`, with `probe[k, color]` for its `sh[color, k]`. Unity's axes are
      left-handed: its x is our -x, the convention of glTF importers.

    Args:
        environment: One light.
        tool: "three.js", "Filament" or "Unity".

    Returns:
        Coefficients of each color, in the units of the radiance. Nothing is clamped.

    Raises:
        TypeError: `environment` is not an `Environment`.
        ValueError: `environment` is a batch of lights, or the tool is unknown.

    Reference: three.js r187, src/math/SphericalHarmonics3.js; Filament, IndirectLight.h and
    shaders/src/surface_light_indirect.fs; Unity's core render pipeline library, EntityLighting.hlsl; Ramamoorthi and
    Hanrahan 2001, "An efficient representation for irradiance environment maps".
    """
    require.kind("the light", environment, Environment, source="jaxprt.load_environment")
    if environment.radiance.ndim != 4:
        raise ValueError(f"the light must be one environment [6, n, n, c], got {list(environment.radiance.shape)}")
    if tool not in TOOLS:
        raise ValueError(f"the tool must be one of {', '.join(TOOLS)}, got {tool!r}")
    coefficient = harmonics.project(jnp.asarray(environment.radiance), degree=_DEGREE)
    coefficient = jnp.broadcast_to(coefficient, (len(coefficient), 3))
    if tool == "three.js":
        return coefficient
    band = np.repeat(_COSINE, [1, 3, 5])
    basis = np.sqrt(np.array([1 / 4, 3 / 4, 3 / 4, 3 / 4, 15 / 4, 15 / 4, 5 / 16, 15 / 4, 15 / 16]) / np.pi)
    if tool == "Unity":
        basis[list(_MIRRORED)] *= -1
    return coefficient * jnp.asarray(band * basis, coefficient.dtype)[:, None]


def irradiance(environment: Environment, normal: ArrayLike, *, degree: int = 8) -> Float[Array, "... c"]:
    """Irradiance of an environment for given surface normals, without shadows.

    It is computed from the light's spherical harmonics. Degree 2 (nine coefficients) is usual; higher degrees cost
    little.

    Args:
        environment: One light.
        normal: Unit normals in world coordinates.
        degree: Largest degree l of the harmonics.

    Returns:
        Irradiance in the units of the radiance times sr. It may be slightly negative because of ringing around a small
        sun. It is differentiable in the light and the normals.

    Raises:
        TypeError: `environment` is not an `Environment`.
        ValueError: `environment` is a batch of lights or not finite, normals are not [.., 3] or not finite, or the
            degree is negative.

    Reference: Ramamoorthi and Hanrahan 2001, "An efficient representation for irradiance environment maps".
    """
    require.kind("the light", environment, Environment, source="jaxprt.load_environment")
    if environment.radiance.ndim != 4:
        raise ValueError(f"the light must be one environment [6, n, n, c], got {list(environment.radiance.shape)}")
    require.finite("the light", environment.radiance)
    if np.ndim(normal) < 1 or np.shape(normal)[-1] != 3:
        raise ValueError(f"normals must be [.., 3], got {list(np.shape(normal))}")
    require.finite("normals", normal)
    coefficient = harmonics.project(environment.radiance, degree=degree)
    return low_frequency.irradiance(coefficient, jnp.asarray(normal, coefficient.dtype))
