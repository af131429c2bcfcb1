"""Pictures of a year from one view: one for each patch of the sky, whose products with the hours are the others."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.relit import RelitScene
from jaxprt.scene import Camera, Environment
from jaxprt.sensors.bases import Patches

_SIZE = 64  # texels along an edge of the lights, where the scene takes any


def picture_matrix(
    relit: RelitScene, *, camera: Camera | None = None, subdivision: int = 1, samples: int = 4
) -> Float[np.ndarray, "b h w 3"]:
    """Pictures of a scene in the light of each patch of the sky alone, with radiance 1.

    `np.tensordot(hours.T, matrix, 1)`, with `hours` from `jaxprt.daylight.sky_matrix`, are the pictures of all hours
    under the sky. Light of the sun is as wide as a patch there; `relit.picture` with a sun shows it as it is.

    Args:
        relit: The scene, from `jaxprt.precompute`.
        camera: The camera; that of the scene if None.
        subdivision: Patches of the sky; see `jaxprt.sensors.Patches`.
        samples: Samples of each pixel; see `RelitScene.picture`.

    Returns:
        Pictures in linear radiance, the ground first. Behind surfaces they show the patch itself.
    """
    require.kind("the scene", relit, RelitScene, source="jaxprt.precompute")
    camera = relit.camera if camera is None else camera
    return relit.pictures(lights(subdivision, size=relit.light_size or _SIZE), [camera], samples=samples)[:, 0]


def lights(subdivision: int, *, size: int) -> list[Environment]:
    """An environment of each patch alone. Texels at its edge have its share of them."""
    share: Array = jnp.asarray(Patches(subdivision).means(size).toarray(), jnp.result_type(float))
    rows = share.reshape(-1, 6, size, size, 1)
    return [Environment(jnp.broadcast_to(row, (6, size, size, 3))) for row in rows]
