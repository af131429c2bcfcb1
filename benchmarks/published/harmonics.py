"""Low-frequency light as in Kautz et al. 2002, sections 4 and 5: without shadows, and for a view that is fixed.

`jaxprt.harmonic.HarmonicSystem` brings the light to each vertex. While the view is fixed, it is cheaper to bring the
view to the world once, by `world_view` or, with shadows, `transferred_view`; its product with the distant light is
radiance.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxprt.compile import jit
from jaxprt.scene.mesh import Mesh
from jaxprt.sphere import directions, rotation
from jaxprt.systems.harmonic import HarmonicBrdf, TransferMatrix
from jaxprt.systems.harmonic.system import combine, local_light, view_coefficients
from jaxprt.systems.harmonic.transfer import right_handed


@jit
def unshadowed_radiance(
    mesh: Mesh,
    brdf: HarmonicBrdf,
    light: Float[Array, "lm c *w"],
    *parameter: Float[Array, " v"],
    eye: Float[Array, "3"],
) -> Float[Array, "v _"]:
    """Radiance of every vertex towards the eye, without shadows. Only the BRDF table is precomputed.

    Args:
        mesh: The mesh.
        brdf: BRDF table, from `jaxprt.harmonic.tabulate`.
        light: SH coefficients of the distant light in the world, from `jaxprt.harmonic.project`: one set, or one for
            each vertex.
        parameter: Values of each BRDF parameter at the vertices, if the table has parameters.
        eye: Position of the viewer in world units.

    Returns:
        Linear radiance. Ringing of the harmonics can make it negative.

    Raises:
        ValueError: Light and table differ in degree, or an array has other axes.

    Reference: Kautz, Sloan, Snyder 2002, section 4.
    """
    frame = directions.frame(mesh.normal, mesh.tangent)
    return combine(local_light(frame, light), view_coefficients(brdf, mesh.position, frame, *parameter, eye=eye))


@jit
def world_view(frame: Float[Array, "v 3 3"], view: Float[Array, "lm c v"]) -> Float[Array, "lm c v"]:
    """Rotates `view_coefficients` to the world frame, where all vertices share the same light: for a fixed view."""
    return rotation.rotate_each(view, right_handed(frame).swapaxes(1, 2))


@jit
def transferred_view(transport: TransferMatrix, view: Float[Array, "lm c v"]) -> Float[Array, "lm _ v"]:
    """Applies transposed transfer matrices to `view_coefficients`: for a fixed view with shadows.

    The result is combined with the coefficients of the distant light in the world.

    Args:
        transport: Transfer matrices, from `jaxprt.harmonic.precompute`.
        view: The result of `view_coefficients`.
    """
    count, colors, terms, _ = transport.matrix.shape
    rows = view.transpose(2, 1, 0)
    if colors == 1:
        # One color at a time: a product of one vector and one matrix per vertex.
        part = [jnp.einsum("voi,vo->iv", transport.matrix[:, 0], rows[:, c]) for c in range(view.shape[1])]
        return jnp.stack(part, 1)
    return jnp.einsum("vcoi,vco->icv", transport.matrix, jnp.broadcast_to(rows, (count, colors, terms)))
