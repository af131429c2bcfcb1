"""Harmonics of an environment: light probes as other tools have them, and irradiance."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jaxprt import require
from jaxprt.scene.environment import Environment
from jaxprt.sphere import harmonics, lighting

_DEGREE = 2
_COSINE = (1.0, 2 / 3, 1 / 4)  # what a clamped cosine over pi leaves of each band: Ramamoorthi and Hanrahan 2001
_MIRRORED = (3, 4, 7)  # harmonics that are odd in x
TOOLS = ("three.js", "Filament", "Unity")


def light_probe(environment: Environment, *, tool: str) -> Float[Array, "9 3"]:
    """The first nine harmonics of a light, in the scaling and the axes of a tool: light for its diffuse materials.

    With c the coefficients of the orthonormal basis, in the order 1, y, z, x, xy, yz, 3 z^2 - 1, xz, x^2 - y^2:

    * "three.js": c, the coefficients of radiance. `new LightProbe(new SphericalHarmonics3().fromArray(probe.flat()))`;
      its shaders multiply the bands by pi, 2 pi / 3 and pi / 4 for irradiance.
    * "Filament": c times the clamped cosine over pi and times the factors of the basis, so that the sum of
      coefficients times the bare polynomials above is irradiance over pi. `IndirectLight.Builder.irradiance(3, probe)`.
    * "Unity": the same for `SphericalHarmonicsL2`, `probe[k, color]` for its `sh[color, k]`. Unity's axes are
      left-handed: its x is our -x, as importers of glTF have it.

    Args:
        environment: One light.
        tool: "three.js", "Filament" or "Unity".

    Returns:
        Coefficients of each color, in the radiance's units; nothing is clamped.

    Raises:
        TypeError: The light is no Environment.
        ValueError: It is a batch of lights, or there is no such tool.

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
    """Irradiance of surfaces under an environment by their normals, without shadows and without a table.

    By the harmonics of the light. Degree 2, nine coefficients, is what is usual; higher degrees cost little.

    Args:
        environment: One light.
        normal: Unit normals in the world.
        degree: The largest l.

    Returns:
        Irradiance in the radiance's units times sr; it can be slightly negative where a small sun rings.
        Differentiable in light and normals.

    Raises:
        TypeError: The light is no Environment.
        ValueError: It is a batch of lights or not finite, normals are not [.., 3] or not finite, or the degree is
            negative.

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
    return lighting.irradiance(coefficient, jnp.asarray(normal, coefficient.dtype))
