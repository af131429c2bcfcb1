"""Unit vectors, tangents, shading frames and local view directions."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxprt.compile import jit

_GRAZING = 0.01  # smallest cosine of a view direction
_PARALLEL = 32  # A tangent within this many rounding errors of the normal counts as parallel to it.


@jit
def normalize(vector: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    """Scales vectors of any length to unit length, without overflow or underflow.

    Zero and denormal vectors become (0, 1, 0) with zero gradient.

    Args:
        vector: Any finite vectors.

    Returns:
        Unit vectors.

    Example:
        >>> print(normalize(jnp.array([[0.0, 3e-30, 4e-30], [0.0, 0.0, 0.0]])))
        [[0.  0.6 0.8]
         [0.  1.  0. ]]
    """
    scaled, zero = _scale(vector)
    safe = jnp.where(zero, _axis(1, vector.dtype), scaled)
    return safe / jnp.sqrt(jnp.sum(safe**2, axis=-1, keepdims=True))


@jit
def tangent(normal: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    """Tangent for a normal where the surface provides none: s of Wang's equation 7.

    It is the x axis after the shortest rotation from +y to the normal. It is smooth everywhere except at (0, -1, 0),
    where it has no limit. There, and within 4e-10 of it (1e-77 in float64), it is (1, 0, 0) with zero gradient.
    Elsewhere it is accurate to rounding.

    Args:
        normal: Unit normals.

    Returns:
        Unit tangents, orthogonal to the normals.

    Reference: Wang, Tran, Luebke 2004, equation 7.

    Example:
        >>> print(tangent(jnp.array([0.0, 0.0, 1.0])), tangent(jnp.array([1.0, 0.0, 0.0])))
        [ 1. -0. -0.] [ 0. -1. -0.]
    """
    x, y, z = normal[..., 0], normal[..., 1], normal[..., 2]
    horizontal = x**2 + z**2
    # Below the horizon 1 + y cancels; (1 + y)(1 - y) = x^2 + z^2 does not.
    below = y < 0
    singular = below & (horizontal < jnp.finfo(normal.dtype).tiny ** 0.5)
    rise = jnp.where(below, jnp.where(singular, 1, horizontal), 1 + y) / jnp.where(below, 1 - y, 1)
    result = jnp.stack([1 - x**2 / rise, -x, -x * z / rise], axis=-1)
    return normalize(jnp.where(singular[..., None], _axis(0, normal.dtype), result))


@jit
def frame(normal: Float[Array, "*b 3"], tangent: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """Shading frames: rotations from the world to local frames, with the normal as z. ``frame @ w_world`` is local.

    The tangent is made orthogonal to the normal. Where it is zero or parallel to the normal, it is replaced by
    ``tangent(normal)``, and so is its gradient.

    Args:
        normal: Unit normals.
        tangent: Tangents of any length and at any angle to the normals.

    Returns:
        Proper rotations; the rows are tangent, bitangent (normal x tangent) and normal.
    """
    scaled, _ = _scale(tangent)
    across = _reject(scaled, normal)
    limit = (_PARALLEL * jnp.finfo(normal.dtype).eps) ** 2
    parallel = jnp.sum(across**2, axis=-1, keepdims=True) < limit
    across = normalize(jnp.where(parallel, _tangent(normal), across))
    # Again, because a tangent near the normal lost digits to cancellation.
    across = normalize(_reject(across, normal))
    return jnp.stack([across, jnp.cross(normal, across), normal], axis=-2)


@jit
def to_local(frame: Float[Array, "*b 3 3"], direction: Float[Array, "d 3"]) -> Float[Array, "*b d 3"]:
    """Rotates world directions to every local frame.

    The products are written out by component, which XLA fuses with the code that uses the result. Its CPU code for a
    matrix product with an inner dimension of three is much slower.

    Args:
        frame: Shading frames; rows are tangent, bitangent, normal.
        direction: Directions in the world, the same for all frames.

    Returns:
        The directions in each local frame.
    """
    axes = jnp.expand_dims(frame, -1)
    local = [sum(direction[:, j] * axes[..., i, j, :] for j in range(3)) for i in range(3)]
    return jnp.stack(local, -1)


@jit
def view(
    frame: Float[Array, "*v 3 3"], position: Float[Array, "*v 3"], eye: Float[Array, "3"] | Float[Array, "*v 3"]
) -> Float[Array, "*v 3"]:
    """Unit directions to the eye in local frames, raised to at least 0.6 degrees above the horizon.

    At silhouettes, a vertex can face away from the eye while one of its triangles is visible. Interpolation over the
    triangle then needs a radiance at this vertex: that of a grazing view. A radiance of zero would draw a dark rim.

    Args:
        frame: Shading frames; rows are tangent, bitangent, normal.
        position: Positions in world units.
        eye: Position of the viewer in world units: one for all positions, or one for each.

    Returns:
        Unit directions. Where the eye is exactly behind a point, the direction is that of the tangent, raised likewise.
    """
    offset = [eye[..., i] - position[..., i] for i in range(3)]
    local = normalize(jnp.stack([sum(frame[..., i, j] * offset[j] for j in range(3)) for i in range(3)], -1))
    low = local[..., 2] < _GRAZING
    square = local[..., 0] ** 2 + local[..., 1] ** 2
    behind = low & (square < jnp.finfo(local.dtype).eps)
    scale = jnp.sqrt((1 - _GRAZING**2) / jnp.where(low & ~behind, square, 1))
    raised = [jnp.where(behind, scale, local[..., 0] * scale), jnp.where(behind, 0, local[..., 1] * scale)]
    flat = jnp.stack([*raised, jnp.full_like(raised[0], _GRAZING)], -1)
    return jnp.where(low[..., None], flat, local)


_tangent = tangent  # an argument of ``frame`` has the same name


def _axis(index: int, dtype: jnp.dtype) -> Float[Array, "3"]:
    return jnp.zeros(3, dtype).at[index].set(1)


def _scale(vector: Float[Array, "*b 3"]) -> tuple[Float[Array, "*b 3"], Array]:
    """Vectors over their largest component, so that squares neither overflow nor underflow; and which are zero."""
    size = jax.lax.stop_gradient(jnp.max(jnp.abs(vector), axis=-1, keepdims=True))
    tiny = jnp.finfo(vector.dtype).tiny
    zero = size < tiny
    size = jnp.minimum(size, 1 / tiny)  # XLA may multiply by its reciprocal, which must not underflow
    return jnp.where(zero, 0, vector / jnp.where(zero, 1, size)), zero


def _reject(vector: Float[Array, "*b 3"], normal: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    return vector - jnp.sum(vector * normal, axis=-1, keepdims=True) * normal
