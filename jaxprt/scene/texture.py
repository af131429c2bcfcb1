"""Images on surfaces: the color of a texture at each vertex."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


@jax.jit
def lookup(image: Float[Array, "h w c"], coordinate: Float[Array, "*b 2"]) -> Float[Array, "*b c"]:
    """Bilinear interpolation of a texture that repeats in both directions.

    Coordinates are as in OBJ files, and as trimesh gives those of glTF: (0, 0) is the lower left corner of the image
    and (1, 1) the upper right one. Centers of texels lie half a texel inside.

    A vertex takes the texture at one place: details finer than the mesh's edges are not averaged but missed.
    Linear in the image; in the coordinates differentiable except where they pass the center of a row or column.

    Args:
        image: The texture, first row on top; linear values, not sRGB-encoded ones, if it is to be an albedo.
        coordinate: Places u to the right and v up, over width and height.

    Returns:
        Values of the image, for example weights of `relight.separable.modulate`.
    """
    height, width = image.shape[:2]
    u, v = coordinate[..., 0], coordinate[..., 1]
    # Reduced to one period first: multiplied by the width, far coordinates would lose digits.
    x, y = (u - jnp.floor(u)) * width - 0.5, (1 - (v - jnp.floor(v))) * height - 0.5
    column, row = jnp.floor(x), jnp.floor(y)
    right, down = (x - column)[..., None], (y - row)[..., None]

    def texel(below: int, beside: int) -> Array:
        return image[(row.astype(jnp.int32) + below) % height, (column.astype(jnp.int32) + beside) % width]

    upper = (1 - right) * texel(0, 0) + right * texel(0, 1)
    lower = (1 - right) * texel(1, 0) + right * texel(1, 1)
    return (1 - down) * upper + down * lower
