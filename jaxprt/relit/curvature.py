"""Curvature of radiance: how fast that of a part varies with direction, and which pixels need several points for it.

The radiance of a glossy surface varies with the mirror direction of the eye.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from jaxprt.brdf import grid
from jaxprt.compile import jit
from jaxprt.image import raster
from jaxprt.image.pixels import FACET
from jaxprt.relit.channels import Shading
from jaxprt.scene import Camera, Mesh
from jaxprt.sphere import directions, hemisphere
from jaxprt.systems.protocol import System

_DEGREE = 128  # degree of the harmonics that represent BRDFs
_RINGS, _SECTORS = 96, 64
_VIEW = np.array([0.6, 0.0, 0.8], np.float32)
# Allowed relative difference of a pixel's mean from its center, times 24, with one point, and with one for each sample.
_WITHIN, _WITHIN_SAMPLES = 24 * 0.005, 24 * 0.16
_RIM = 0.15  # allowed change of the cosine within a pixel, relative to the cosine plus this
_MATTE = 0.83  # curvature up to which a surface counts as diffuse
_FLAT = 1e-6  # squared difference of the normals of a flat triangle
_FACETS = 40.0  # curvature from which on facets beside each other may be as different as light and dark
_EDGE_ON = 1e-6  # smallest area of a projected triangle in square pixels


def of_part(shading: Shading, system: System) -> float:
    """RMS Laplacian of a part's radiance as a function of the mirror direction, divided by the RMS radiance.

    The light has the natural power spectrum C_l = (l + 1/2)^-2. The view is at 37 degrees from the normal. BRDF times
    cosine is represented by zonal harmonics about the mirror direction, up to the degree of the system if it is
    harmonic.

    Args:
        shading: The `Shading` of the part. Channels are weighted by their mean weights.
        system: The system of the part.

    Returns:
        The ratio in 1 / radian^2.
    """
    degree_of = system.degree
    if shading.table is not None:
        weight = np.mean(np.asarray(shading.weighted.weight, np.float64), (0, 2))
        return shading.table.curvature(shading.smoothest, weight, degree_of)
    brdf: Callable = shading.brdf(jnp.asarray(shading.knot[0][0])) if shading.knot else shading.brdf
    wo = jnp.asarray(_VIEW)
    mirror = jnp.asarray(_VIEW * [-1, -1, 1])
    wi, area = hemisphere.arcs(mirror, rings=_RINGS, sectors=_SECTORS)
    value = np.asarray(grid.as_argument(brdf)(wi, jnp.broadcast_to(wo, wi.shape)), np.float64)
    if shading.blend is not None:
        value = value @ np.mean(np.asarray(shading.blend.weight, np.float64), 0)
    mass = value.mean(-1) * np.asarray(area) * np.maximum(np.asarray(wi)[:, 2], 0)
    cosine = np.clip(np.asarray(wi, np.float64) @ np.asarray(mirror, np.float64), -1, 1)
    degree = np.arange(_DEGREE + 1)
    # Each column of the Vandermonde matrix is the Legendre polynomial of one degree.
    zonal = mass @ np.polynomial.legendre.legvander(cosine, _DEGREE)
    zonal = zonal[: None if degree_of is None else degree_of + 1]
    degree = degree[: len(zonal)]
    power = (2 * degree + 1) / (degree + 0.5) ** 2 * zonal**2
    total = power.sum()
    return float(np.sqrt((power * (degree * (degree + 1.0)) ** 2).sum() / total)) if total > 0 else 0.0


@jit
def detail(mesh: Mesh, camera: Camera, curvature: Float[Array, " v"]) -> UInt8[Array, " f"]:
    """How much the radiance of each triangle varies within a pixel, as `jaxprt.image.pixels.shading_points` takes it.

    The mean over a pixel differs from the value at its center by 1/24 of the Laplacian; the first criterion limits this
    for the change of the mirror direction. Near the silhouette of a glossy surface, radiance follows the cosine of the
    view angle; the second criterion limits the change of that cosine.

    Args:
        mesh: The triangles.
        camera: The camera.
        curvature: Result of `of_part` for the part of each vertex.
    """
    mesh, camera = jax.lax.stop_gradient((mesh, camera))
    x, y, q = raster.project(mesh.position, camera)
    toward = directions.normalize(camera.eye - mesh.position)
    cosine = jnp.sum(mesh.normal * toward, -1)
    mirror = 2 * cosine[:, None] * mesh.normal - toward
    a, b, c = mesh.face.T
    across, down = (coordinate * jnp.sign(q) for coordinate in (x, y))
    first, second = (across[b] - across[a], down[b] - down[a]), (across[c] - across[a], down[c] - down[a])
    area = first[0] * second[1] - first[1] * second[0]
    scale = 1 / jnp.where(jnp.abs(area) > _EDGE_ON, area, _EDGE_ON)

    def square(value: Array) -> Array:
        """Squared change of a value per pixel, summed over the horizontal and the vertical direction."""
        value = value.reshape(len(value), -1)
        one, other = (value[corner] - value[a] for corner in (b, c))
        right = (one * second[1][:, None] - other * first[1][:, None]) * scale[:, None]
        below = (other * first[0][:, None] - one * second[0][:, None]) * scale[:, None]
        return jnp.sum(right**2 + below**2, -1)

    change = square(mirror) * curvature[a]
    mean = jnp.maximum((cosine[a] + cosine[b] + cosine[c]) / 3, 0)
    # Diffuse radiance does not depend on the view.
    rim = (square(cosine) > (_RIM * (mean + _RIM)) ** 2) & (curvature[a] > _MATTE)
    within = jnp.where(change > _WITHIN_SAMPLES, 2, (change > _WITHIN) | rim)
    bend = jnp.maximum(*(jnp.sum((mesh.normal[corner] - mesh.normal[a]) ** 2, -1) for corner in (b, c)))
    return (within + FACET * ((bend < _FLAT) & (curvature[a] > _FACETS))).astype(jnp.uint8)
