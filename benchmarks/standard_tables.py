"""How exact are the tables of lobes that are shipped, at roughnesses between their knots, and what does a fit cost?

    python -m benchmarks.standard_tables [--quick] [--output FILE]

Radiance without shadows for 64 random views and frames under three lights (from JAXPRT_DATA; the embedded daylight
where that is not set, and with --quick), against the BRDF itself. Both are integrated at 96 x 128 directions around the
mirror direction. `error` is the mean over the lights of the relative L2 over all views, of the light without its 16
brightest texels, which systems sum exactly; `all_light` is that of the whole light. `seconds` is the time of the first
reading of the shipped table from its file. The peer is a table of the material's own, fitted to its roughness and its
channels, as for a BRDF that is not metallic-roughness.
"""

import time
import warnings
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import harness
from jaxprt import bright_texels, lobe
from jaxprt.brdf import MetallicRoughness
from jaxprt.scene import Environment, builtin, load_environment
from jaxprt.sphere import cubemap, hemisphere
from jaxprt.systems import standard
from jaxprt.systems.standard.families import RoughnessFamily

LIGHTS = ("uffizi_latlong_256x128.hdr", "grace_cross.hdr", "polyhaven_sunrise_1k.exr")
ROUGHNESS = (0.05, 0.12, 0.25, 0.45, 0.7, 1.0)
GOLD = (1.0, 0.766, 0.336)
KINDS = {
    "dielectric": {"base_color": (0.8, 0.5, 0.3), "metallic": 0.0},
    "gold": {"base_color": GOLD, "metallic": 1.0},
    "mixed": {"base_color": (0.8, 0.5, 0.3), "metallic": 0.3, "specular": 0.5},
}
SUN = 16
RARE = 0.02  # smallest scale of a channel, relative to the largest, of a table of its own


def main(options: Sequence[str] | None = None) -> None:
    arguments = harness.parser(str(__doc__).splitlines()[0]).parse_args(options)
    for line in measure(arguments.quick):
        harness.report(line, arguments.output)


def measure(quick: bool):
    """Lines of all materials."""
    standard.tables.forget()
    start = time.perf_counter()
    table = jax.block_until_ready(standard.METALLIC_ROUGHNESS.lobes())
    seconds = time.perf_counter() - start
    scene = Scene(lights(quick), views=16 if quick else 64, rings=48 if quick else 96)
    for roughness in ROUGHNESS[2:4] if quick else ROUGHNESS:
        place = np.log(roughness)
        exact = scene.radiance(standard.METALLIC_ROUGHNESS.family(place))
        found = scene.radiance(chosen(table, jnp.asarray(place, jnp.float32)))
        for name, options in KINDS.items():
            weight = weights(options) / standard.METALLIC_ROUGHNESS.scale[:, None]
            term = tuple(int(k) for k in np.flatnonzero(np.any(weight, 1)))
            scale = np.mean(np.abs(weights(options)[np.asarray(term)]), 1)
            scale = np.maximum(scale, RARE * np.max(scale)).astype(np.float32)
            family = RoughnessFamily(term, jnp.asarray(scale), jnp.zeros(()))
            start = time.perf_counter()
            own = jax.block_until_ready(lobe.tabulate(family(place), lobes=12, resolution=12 if quick else 32))
            fitted = time.perf_counter() - start
            peer = errors(scene.radiance(own), exact, weights(options)[np.asarray(term)] / scale[:, None], weight)
            wrong = errors(found, exact, weight, weight)
            yield {
                **{"benchmark": "standard_tables", "case": f"{name}, roughness {roughness}"},
                **{"seconds": seconds, "compile_seconds": 0.0, "error": wrong[1], "all_light": wrong[0]},
                **{"bytes": table.nbytes, "peer": "a table of its own", "peer_seconds": fitted},
                **{"peer_error": peer[1], "peer_all_light": peer[0]},
            }


def lights(quick: bool) -> list[Environment]:
    """The real lights, or an embedded one."""
    data = harness.data()
    if quick or not data.is_dir():
        return [builtin.daylight(size=64)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # negative pixels of lossy files
        return [load_environment(data / "env" / name) for name in LIGHTS]


def weights(options: dict) -> np.ndarray:
    """Weights of the terms of a material in each color."""
    return np.asarray(MetallicRoughness(**options).coefficient(), np.float64)


class Scene:
    """Random views and frames, and the light that arrives at each from the directions of a quadrature.

    Args:
        lights: The lights.
        views: Number of views.
        rings: Rings of the quadrature around the mirror direction of a view.
    """

    def __init__(self, lights: list[Environment], *, views: int, rings: int):
        self.rings = rings
        random = np.random.default_rng(5)
        height, angle = random.uniform(0.05, 1, views), random.uniform(0, 2 * np.pi, views)
        radius = np.sqrt(1 - height**2)
        self.wo = jnp.asarray(np.stack([radius * np.cos(angle), radius * np.sin(angle), height], -1), jnp.float32)
        turn = np.linalg.qr(random.normal(size=(views, 3, 3)))[0]
        rest = [bright_texels.split(light, count=SUN)[2] for light in lights]
        self.radiances = jnp.stack([each.radiance.reshape(-1, 3) for each in (*lights, *rest)])
        self.texel = jnp.asarray(self._texels(turn, lights[0].radiance.shape[-2]))

    def _texels(self, turn: np.ndarray, size: int) -> np.ndarray:
        """Index of the texel at each direction of the quadrature, in the frame of each view."""
        wi = np.stack([np.asarray(arcs(wo, rings=self.rings)[0]) for wo in self.wo])
        return np.asarray(texels(jnp.asarray(wi @ turn, jnp.float32), size=size))

    def radiance(self, brdf: Callable) -> np.ndarray:
        """Radiance [light, view, channel, color] of a BRDF, or of a table that holds the cosine."""
        return np.asarray(radiance(brdf, self.wo, self.texel, self.radiances, rings=self.rings), np.float64)


@eqx.filter_jit
def arcs(wo, *, rings: int):
    return hemisphere.arcs(lobe.em.mirror(wo), rings=rings, sectors=rings * 4 // 3)


def texels(direction, *, size: int):
    """Index of the texel of a cubemap in each direction, by the face whose axis is nearest."""
    axes = jnp.asarray(cubemap.axes(), direction.dtype)
    along = direction @ axes[:, 2].T
    face = jnp.argmax(along, -1)
    most = jnp.max(along, -1)
    s, t = (jnp.sum(direction * axes[face, k], -1) / most for k in (0, 1))
    column, row = (jnp.clip((each + 1) / 2 * size, 0, size - 1).astype(jnp.int32) for each in (s, t))
    return (face * size + row) * size + column


@eqx.filter_jit
def radiance(brdf, wo, texel, light, *, rings: int):
    cosine = not getattr(brdf, "holds_cosine", False)

    def one(argument):
        view, texel = argument
        wi, area = arcs(view, rings=rings)
        value = brdf(wi, jnp.broadcast_to(view, wi.shape)) * area[:, None]
        value = value * jnp.maximum(wi[:, 2:], 0) if cosine else value
        return jnp.einsum("dk,ldc->lkc", value, light[:, texel], precision="highest")

    return jnp.moveaxis(jax.lax.map(one, (wo, texel)), 0, 1)


@eqx.filter_jit
def chosen(table, *parameter):
    """The table for given parameters."""
    return table.at(*parameter)


def errors(found: np.ndarray, exact: np.ndarray, own: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """Relative L2 error, mean over lights, of the whole light and of what remains without the brightest texels.

    Args:
        found: Radiance of each channel of a table under each light and then under each remainder.
        exact: The same of the channels of the standard table's BRDF.
        own: Weights of the table's channels.
        weight: Weights of the standard table's channels.
    """
    wrong, truth = np.einsum("lvkc,kc->lvc", found, own), np.einsum("lvkc,kc->lvc", exact, weight)
    each = np.linalg.norm((wrong - truth).reshape(len(truth), -1), axis=1)
    each = each / np.linalg.norm(truth.reshape(len(truth), -1), axis=1)
    whole, rest = np.split(each, 2)
    return float(np.mean(whole)), float(np.mean(rest))


if __name__ == "__main__":
    main()
