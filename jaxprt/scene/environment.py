"""Environment maps: distant light on a cubemap."""

import equinox as eqx
from jaxtyping import Array, Float


class Environment(eqx.Module):
    """Distant light: mean linear radiance of each cubemap texel.

    Attributes:
        radiance: Mean radiance over each texel, linear Rec. 709; leading axes, if any, are a batch of lights.
    """

    radiance: Float[Array, "*l 6 n n c"]
