"""Light of bounces and lamps in exported pages: transfer vectors of what it adds to the irradiance of the vertices."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt.relit.scene import RelitScene
from jaxprt.scene import Environment
from jaxprt.sphere import cubemap, harmonics
from jaxprt.systems.bounces.exported import DEGREE, ROWS
from jaxprt.systems.harmonic.exported import upright_cosine
from jaxprt.systems.lamps import LitByLamps

_EDGE = 32  # texels along the edges of environments of one harmonic
_ARRIVING = 3  # degree of the light that arrives from other surfaces


def transfer(relit: RelitScene) -> list[Float[np.ndarray, "k 3 _"]] | None:
    """Irradiance / pi that bounces and lamps add at the vertices of each part; None for a scene without both.

    Rows are those of environments of one harmonic, without lamps; the last row is that of the lamps alone, and the only
    one of a scene without bounces.
    """
    if relit.bounces is None and relit.lamps is None:
        return None
    basis = harmonics.evaluate(cubemap.direction(size=_EDGE), degree=DEGREE)
    count = 0 if relit.bounces is None else ROWS - 1
    rows = [_reflected(relit, Environment(basis[..., k, None]), None) for k in range(count)]
    lamp = relit.stage.radiance
    last = _reflected(relit, Environment(jnp.zeros_like(basis[..., :1])), lamp)
    if relit.lamps is not None and lamp is not None:
        last = [row + _direct(group, lamp) for row, group in zip(last, relit.lamps.group, strict=True)]
    groups = [np.stack(group) for group in zip(*rows, last, strict=True)]
    spans = zip(relit.layout.group, relit.layout.start, relit.layout.counts, strict=True)
    return [groups[number][..., first : first + count] for number, first, count in spans]


def _reflected(
    relit: RelitScene, light: Environment, lamp: Float[Array, "n 3"] | None
) -> list[Float[np.ndarray, "3 _"]]:
    """Irradiance / pi of reflected light at the vertices of each group."""
    if relit.bounces is None:
        return [np.zeros((3, count)) for count in relit.layout.size]
    arriving = relit.bounces.shade(relit.bounces.light(light), relit.stage.blends, lamp)
    factor, zonal = upright_cosine(_ARRIVING), np.arange(_ARRIVING + 1)
    rows = [np.asarray(group, np.float64)[zonal * (zonal + 1)] for group in arriving]
    return [np.broadcast_to(np.einsum("l,lcv->cv", factor, row), (3, row.shape[2])) for row in rows]


def _direct(group: LitByLamps, lamp: Float[Array, "n 3"]) -> Float[np.ndarray, "3 v"]:
    """Irradiance / pi of the light of lamps at the vertices of a group."""
    white = LitByLamps(group.transport)
    return np.asarray(white.combine(lamp, white.view(jnp.zeros(3))), np.float64).T
