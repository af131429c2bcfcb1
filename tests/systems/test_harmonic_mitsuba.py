"""Mitsuba 3 judges the harmonic system, with and without two bounces: Lambert by vectors and matrices, and a gloss.

Both sides get the same picture of a sky of broad lobes, the same mesh (a sphere over a ground) and the same eye.
Mitsuba traces paths to the radiance that leaves points next to chosen vertices; its noise is told from the spread of
independent renderings. What it finds is kept beside this file; `make_mitsuba.py` writes it. The gloss is Mitsuba's
own: half Lambert, half a GGX conductor, whose formula stands here too.
"""

import math
import pathlib

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

import jaxprt as prt
from benchmarks.published.interreflection import interreflect, interreflect_diffuse
from jaxprt import harmonic
from jaxprt.scene.environment import environment_from_image
from jaxprt.systems.harmonic import precompute, precompute_diffuse, tabulate
from tests.systems import rendered
from tests.systems.rendered import EYE, LIVE, RENDERINGS, STALE

DEGREE = 4
BOUNCES = 2
BOUNCED = 8  # edge of the cubemaps of rays that collect reflected light
SAMPLES = 1 << 16
KEPT = pathlib.Path(__file__).with_name("harmonic_mitsuba.npz")
ALBEDO = [0.8, 0.5, 0.3]
SPECULAR = [0.9, 0.8, 0.6]
ALPHA = 0.4

# Relative L2 over the vertices; three standard errors are added. Measured, noise included, without and with bounces:
# vectors 0.54 and 0.76 %, matrices 0.54 and 0.76 %, the gloss 0.79 and 0.87 %.
TOLERANCE = 0.01
# No single vertex may be off by more of the mean radiance: bounces come from 331 vertices, by one ray per texel.
# Measured at most 2.7 % beyond three standard errors.
SINGLE = 0.03
# Lobes so broad that a thousandth of them lies above degree 4.
IMAGE, MITSUBA_IMAGE = rendered.pictures(128, 2.0)


def relight(transport, table, light, *, eye):
    return prt.radiance(harmonic.HarmonicSystem(transport, table), light, eye=eye)


def diffuse(transport, albedo, light):
    return prt.radiance(harmonic.DiffuseSystem(transport, albedo), light, eye=jnp.zeros(3))


class HalfGgx(eqx.Module):
    """Half Lambert and half GGX without Fresnel, as Mitsuba's blend of diffuse and roughconductor.

    Reference: Walter et al. 2007, equations 20, 33 and 34.
    """

    albedo: Float[Array, " c"]
    specular: Float[Array, " c"]
    alpha: Float[Array, ""]

    def __call__(self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> Float[Array, "*b c"]:
        """Value in 1/sr."""
        cos_i, cos_o = jnp.maximum(wi[..., 2:], 1e-4), jnp.maximum(wo[..., 2:], 1e-4)
        half = prt.sphere.directions.normalize(wi + wo)
        square = self.alpha**2
        normals = square / (jnp.pi * (half[..., 2:] ** 2 * (square - 1) + 1) ** 2)

        def seen(cosine):
            return 2 / (1 + jnp.sqrt(1 + square * (1 / cosine**2 - 1)))

        lobe = self.specular * normals * seen(cos_i) * seen(cos_o) / (4 * cos_i * cos_o)
        above = (wi[..., 2:] > 0) & (wo[..., 2:] > 0)
        return jnp.where(above, 0.5 * self.albedo / jnp.pi + 0.5 * lobe, 0)


DIFFUSE = {"type": "diffuse", "reflectance": {"type": "rgb", "value": ALBEDO}}
GLOSSY = {
    "type": "blendbsdf",
    "weight": 0.5,
    "first": DIFFUSE,
    "second": {
        "type": "roughconductor",
        "material": "none",
        "distribution": "ggx",
        "alpha": ALPHA,
        "specular_reflectance": {"type": "rgb", "value": SPECULAR},
    },
}
GLOSS = HalfGgx(jnp.asarray(ALBEDO), jnp.asarray(SPECULAR), jnp.asarray(ALPHA))


@pytest.fixture(scope="module")
def scene():
    return build_scene()


def build_scene():
    return rendered.ball_over_ground(subdivisions=2, height=0.8)


@pytest.fixture(scope="module")
def mitsuba():
    return load_mitsuba()


def load_mitsuba():
    """Mitsuba in its scalar variant."""
    import mitsuba

    mitsuba.set_variant("scalar_rgb")
    return mitsuba


def cases():
    """What Mitsuba renders, by the model and the number of bounces."""
    return {
        (name, bounces): {"bsdf": bsdf, "bounces": bounces, "samples": SAMPLES // RENDERINGS}
        for name, bsdf in (("matte", DIFFUSE), ("glossy", GLOSSY))
        for bounces in (0, BOUNCES)
    }


def render(mi, scene, **options):
    return rendered.render(mi, scene, MITSUBA_IMAGE, **options)


def excess(actual, mean, error):
    """By how much values differ beyond the tolerances and three standard errors: over all vertices, and singly."""
    difference = np.abs(np.asarray(actual) - mean)
    whole = np.linalg.norm(difference) - TOLERANCE * np.linalg.norm(mean) - 3 * np.linalg.norm(error)
    return max(whole, np.max(difference - SINGLE * np.mean(mean) - 3 * error))


@pytest.fixture(scope="module")
def estimates():
    """Mean and its standard error, [v, 3], by model and number of bounces."""
    with np.load(KEPT) as kept:
        each = {(name, bounces): kept[f"{name} {bounces}"] for name, bounces in cases()}
    error = 1 / math.sqrt(RENDERINGS)
    return {key: (value.mean(0), value.std(0, ddof=1) * error) for key, value in each.items()}


@pytest.fixture(scope="module")
def ours(scene):
    """Radiance by way and number of bounces."""
    mesh, eye, result = scene.mesh(), jnp.asarray(EYE, jnp.float32), {}
    matrix = precompute(mesh, degree=DEGREE, size=32)
    vector = precompute_diffuse(mesh, degree=DEGREE, size=32)
    light = harmonic.project(environment_from_image(IMAGE, size=32), degree=DEGREE)
    bounced = interreflect_diffuse(mesh, vector, np.array([ALBEDO]), bounces=BOUNCES, size=BOUNCED)
    for bounces, transport in ((0, vector), (BOUNCES, bounced)):
        result["vector", bounces] = diffuse(transport, jnp.asarray(ALBEDO), light)[scene.vertex]
    for name, brdf in (("matrix", prt.brdf.Lambert(ALBEDO)), ("glossy", GLOSS)):
        table = tabulate(brdf, degree=DEGREE, resolution=16)
        bounced = interreflect(mesh, matrix, [table], bounces=BOUNCES, size=BOUNCED)
        for bounces, transport in ((0, matrix), (BOUNCES, bounced)):
            result[name, bounces] = relight(transport, table, light, eye=eye)[scene.vertex]
    return result


def test_the_gloss_is_that_of_mitsuba(mitsuba):
    bsdf = mitsuba.load_dict(GLOSSY)
    direction = np.random.default_rng(0).normal(size=(2, 100, 3))
    direction[..., 2] = np.abs(direction[..., 2])
    wi, wo = (direction / np.linalg.norm(direction, axis=-1, keepdims=True)).astype(np.float32)
    expected = []
    for a, b in zip(wi, wo, strict=True):
        seen = mitsuba.SurfaceInteraction3f()
        seen.wi = mitsuba.Vector3f(b)
        expected.append(list(bsdf.eval(mitsuba.BSDFContext(), seen, mitsuba.Vector3f(a))))
    np.testing.assert_allclose(GLOSS(jnp.asarray(wi), jnp.asarray(wo)) * wi[:, 2:], expected, rtol=1e-4)


@pytest.mark.parametrize(("name", "bounces"), cases())
def test_what_is_kept_is_what_mitsuba_renders(mitsuba, scene, close, name, bounces):
    live = render(mitsuba, scene, **cases()[name, bounces] | {"samples": LIVE, "seeds": range(1)})
    with np.load(KEPT) as kept:
        close(live, kept[f"{name} {bounces} live"], tolerance=STALE)


@pytest.mark.long
@pytest.mark.parametrize(("name", "bounces"), cases())
def test_other_random_numbers_of_mitsuba_agree_within_their_noise(mitsuba, scene, estimates, name, bounces):
    kept, error = estimates[name, bounces]
    other = render(mitsuba, scene, **cases()[name, bounces] | {"seeds": range(RENDERINGS, 2 * RENDERINGS)})
    noise = np.hypot(error, other.std(0, ddof=1) / math.sqrt(RENDERINGS))
    assert np.linalg.norm(other.mean(0) - kept) < 3 * np.linalg.norm(noise)


def test_noise_of_mitsuba_is_small_beside_what_is_judged(estimates):
    for mean, error in estimates.values():
        assert np.linalg.norm(error) < 0.004 * np.linalg.norm(mean)


@pytest.mark.parametrize("bounces", [0, BOUNCES])
@pytest.mark.parametrize(("way", "model"), [("vector", "matte"), ("matrix", "matte"), ("glossy", "glossy")])
def test_radiance_agrees_with_path_tracing(ours, estimates, way, model, bounces):
    assert excess(ours[way, bounces], *estimates[model, bounces]) < 0


@pytest.mark.parametrize(("way", "model"), [("vector", "matte"), ("matrix", "matte"), ("glossy", "glossy")])
def test_missing_bounces_and_another_brdf_would_be_noticed(ours, estimates, way, model):
    assert excess(ours[way, 0], *estimates[model, BOUNCES]) > 0
    assert excess(ours[way, BOUNCES], *estimates[model, 0]) > 0
    other = "glossy" if model == "matte" else "matte"
    assert excess(ours[way, 0], *estimates[other, 0]) > 0
