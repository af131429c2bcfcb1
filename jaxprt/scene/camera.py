"""The camera: where the picture is taken from."""

import equinox as eqx
from jaxtyping import Array, Float


class Camera(eqx.Module):
    """A pinhole camera.

    Attributes:
        eye: Position in world units.
        target: The point that falls on the picture's centre.
        up: Direction that points up in the picture; not parallel to the view.
        field_of_view: Full vertical angle of view in radians.
        width: Picture width in pixels.
        height: Picture height in pixels.
    """

    eye: Float[Array, "3"]
    target: Float[Array, "3"]
    up: Float[Array, "3"]
    field_of_view: Float[Array, ""]
    width: int = eqx.field(static=True)
    height: int = eqx.field(static=True)
