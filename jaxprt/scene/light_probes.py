"""Light probes: the first nine harmonics of an environment, as other tools have them."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.scene.environment import Environment
from jaxprt.sphere import harmonics

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
