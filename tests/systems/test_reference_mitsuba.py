"""Mitsuba 3 judges the reference: orientation of the light, frames, shadows, units, and the Ashikhmin-Shirley model.

Both sides get the same picture of the sky (broad lobes of distinct colors around distinct directions), the same mesh
(a sphere over a ground) and the same eye. Mitsuba estimates, by path tracing of direct light with many samples, the
radiance that leaves points next to chosen vertices; its noise is told from the spread of independent renderings. What
it finds is kept beside this file; `make_mitsuba.py` writes it.
"""

import math
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt.scene import Environment
from jaxprt.scene.environment import environment_from_image
from tests.systems import rendered
from tests.systems.rendered import EYE, LIVE, RENDERINGS, STALE

SIZE = 64  # Texels along the edge of the reference's cubemap.
# A sum over texels and sixteenths of visibility against an integral: with 2^20 samples, 0.1 % of Mitsuba's noise, the
# Lambert values differ by at most 0.6 %, where a vertex sees little light. Three standard errors are added.
TOLERANCE = 0.01
KEPT = pathlib.Path(__file__).with_name("reference_mitsuba.npz")
ALBEDO = [0.8, 0.5, 0.3]
GLOSSY = {"diffuse": 0.5, "specular": 0.75, "nu": 10.0, "nv": 100.0}
SHARPNESS = [8.0, 6.0, 10.0, 7.0, 12.0, 5.0]  # of the lobes of the sky
IMAGE, MITSUBA_IMAGE = rendered.pictures(256, SHARPNESS)


@pytest.fixture(scope="module")
def scene():
    return build_scene()


def build_scene():
    return rendered.ball_over_ground(subdivisions=4, height=0.6)


@pytest.fixture(scope="module")
def mitsuba():
    return load_mitsuba()


def load_mitsuba():
    """Mitsuba in its scalar variant, with the Ashikhmin-Shirley model as a plugin written from the paper."""
    import mitsuba

    mitsuba.set_variant("scalar_rgb")
    _register_ashikhmin_shirley(mitsuba)
    return mitsuba


def _register_ashikhmin_shirley(mi):
    class AshikhminShirley(mi.BSDF):
        """The published formula in scalar Python; half the samples by the cosine, half by the lobe."""

        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            self.rd, self.rs, self.nu, self.nv = (props[name] for name in ("diffuse", "specular", "nu", "nv"))
            self.m_components = [mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide]
            self.m_flags = self.m_components[0]

        def sample(self, ctx, si, sample1, sample2, active=True):
            wo = mi.warp.square_to_cosine_hemisphere(sample2) if sample1 < 0.5 else self.mirrored(si, *sample2)
            result = mi.BSDFSample3f()
            result.wo, result.eta, result.sampled_component = wo, 1.0, 0
            result.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
            result.pdf = self.pdf(ctx, si, wo)
            return result, self.eval(ctx, si, wo) / result.pdf if result.pdf > 0 else mi.Color3f(0)

        def pdf(self, ctx, si, wo, active=True):
            if si.wi.z <= 0 or wo.z <= 0:
                return 0.0
            (hu, hv, nh), hk, _, _ = self.angles(si, wo)
            return wo.z / (2 * math.pi) + self.lobe(hu, hv, nh) / (2 * math.pi) / (8 * hk)

        def eval(self, ctx, si, wo, active=True):
            if si.wi.z <= 0 or wo.z <= 0:
                return mi.Color3f(0)
            (hu, hv, nh), hk, n1, n2 = self.angles(si, wo)
            fresnel = self.rs + (1 - self.rs) * (1 - hk) ** 5
            specular = self.lobe(hu, hv, nh) / (8 * math.pi) / (hk * max(n1, n2)) * fresnel
            diffuse = 28 * self.rd / (23 * math.pi) * (1 - self.rs)
            diffuse *= (1 - (1 - n1 / 2) ** 5) * (1 - (1 - n2 / 2) ** 5)
            return mi.Color3f((specular + diffuse) * wo.z)

        def lobe(self, hu, hv, nh):
            power = (self.nu * hu * hu + self.nv * hv * hv) / max(1 - nh * nh, 1e-9)
            return math.sqrt((self.nu + 1) * (self.nv + 1)) * nh**power

        def angles(self, si, wo):
            """Half vector in the frame (u, v, n), and its and the normal's cosines with the directions."""
            u, v, n = axes(si)
            k1, k2 = list(si.to_world(wo)), list(si.to_world(si.wi))
            h = [a + b for a, b in zip(k1, k2, strict=True)]
            length = math.sqrt(dot(h, h))
            h = [a / length for a in h]
            return (dot(h, u), dot(h, v), dot(h, n)), dot(h, k1), dot(n, k1), dot(n, k2)

        def mirrored(self, si, sample1, sample2):
            """The view mirrored at a half vector drawn from the lobe."""
            phi = math.atan2(
                math.sqrt((self.nu + 1) / (self.nv + 1)) * math.sin(2 * math.pi * sample1),
                math.cos(2 * math.pi * sample1),
            )
            power = self.nu * math.cos(phi) ** 2 + self.nv * math.sin(phi) ** 2
            nh = (1 - sample2) ** (1 / (power + 1))
            across = math.sqrt(1 - nh * nh)
            weight = (across * math.cos(phi), across * math.sin(phi), nh)
            h = [dot(weight, component) for component in zip(*axes(si), strict=True)]
            k2 = list(si.to_world(si.wi))
            return si.to_local([2 * dot(h, k2) * a - b for a, b in zip(h, k2, strict=True)])

        def traverse(self, callback):
            pass

        def to_string(self):
            return "AshikhminShirley"

    mi.register_bsdf("published_ashikhmin_shirley", AshikhminShirley)


def axes(si):
    """The frame (u, v, n); u is the tangent of Wang's equation 7, as where a mesh brings none."""
    x, y, z = si.sh_frame.n
    u = (1 - x * x / (1 + y), -x, -x * z / (1 + y))
    return u, (y * u[2] - z * u[1], z * u[0] - x * u[2], x * u[1] - y * u[0]), (x, y, z)


def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cases():
    """What Mitsuba renders, by model."""
    matte = {"type": "diffuse", "reflectance": {"type": "rgb", "value": ALBEDO}}
    glossy = {"type": "published_ashikhmin_shirley", **GLOSSY}
    return {
        "matte": {"bsdf": matte, "samples": (1 << 17) // RENDERINGS},
        "glossy": {"bsdf": glossy, "samples": (1 << 14) // RENDERINGS},
    }


def render(mi, scene, **options):
    return rendered.render(mi, scene, MITSUBA_IMAGE, **options)


def excess(actual, mean, error):
    """By how much values differ beyond the tolerance and three standard errors, singly and in the sum over vertices."""
    single = np.abs(actual - mean) - TOLERANCE * mean - 3 * error
    total, noise = np.sum(actual - mean, 0), np.sqrt(np.sum(error**2, 0))
    return np.append(single, np.abs(total) - TOLERANCE / 2 * np.sum(mean, 0) - 3 * noise)


TURNED = {
    "as it is": lambda image: image,
    "x mirrored": lambda image: image[:, ::-1],
    "y mirrored": lambda image: image[::-1],
    "a quarter turn": lambda image: np.roll(image, image.shape[1] // 4, 1),
    "5 % brighter": lambda image: 1.05 * image,
}


@pytest.fixture(scope="module")
def skies():
    """The light as it is, and turned: one batch, which serves the tests of Lambert by one program."""
    each = [environment_from_image(turn(IMAGE), size=SIZE).radiance for turn in TURNED.values()]
    return Environment(jax.device_put(np.stack(each)))


@pytest.fixture(scope="module")
def light(skies):
    return Environment(jax.device_put(np.asarray(skies.radiance)[0]))


def reference(scene, brdf, light, occluder=None):
    eye = jnp.asarray(EYE, jnp.float32)
    return np.asarray(
        prt.reference.radiance(scene.mesh(), brdf, light, eye=eye, vertex=scene.vertex, occluder=occluder)
    )


@pytest.fixture(scope="module")
def lambert(scene, skies):
    """Radiance of Lambert by the name of the light."""
    return dict(zip(TURNED, reference(scene, prt.brdf.Lambert(albedo=ALBEDO), skies), strict=True))


def estimate(name):
    """What is kept of a model: mean and its standard error, [v, 3]."""
    with np.load(KEPT) as kept:
        result = kept[name]
    return np.mean(result, 0), np.std(result, 0, ddof=1) / math.sqrt(RENDERINGS)


@pytest.fixture(scope="module")
def matte():
    return estimate("matte")


@pytest.fixture(scope="module")
def glossy():
    return estimate("glossy")


@pytest.mark.parametrize("name", cases())
def test_what_is_kept_is_what_mitsuba_renders(mitsuba, scene, close, name):
    live = render(mitsuba, scene, **cases()[name] | {"samples": LIVE, "seeds": range(1)})
    with np.load(KEPT) as kept:
        close(live, kept[f"{name} live"], tolerance=STALE)


def test_environment_looks_the_same_in_every_direction(mitsuba, light):
    map_of_mitsuba = mitsuba.load_dict({"type": "envmap", "bitmap": mitsuba.Bitmap(MITSUBA_IMAGE)})
    direction = np.random.default_rng(0).normal(size=(200, 3))
    direction = np.concatenate([direction, np.eye(3), -np.eye(3)])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    theirs = []
    for each in direction:
        seen = mitsuba.SurfaceInteraction3f()
        seen.wi = -mitsuba.Vector3f(each)
        theirs.append(list(map_of_mitsuba.eval(seen)))
    ours = prt.scene.environment.background(light, jnp.asarray(direction, jnp.float32))
    # Texel means and bilinear interpolation soften the sharpest lobe by so much.
    np.testing.assert_allclose(theirs, rendered.sky(direction, SHARPNESS), rtol=2e-3)
    np.testing.assert_allclose(ours, theirs, rtol=1e-2)


def test_reference_agrees_on_lambert(lambert, matte):
    assert excess(lambert["as it is"], *matte).max() < 0


def test_reference_agrees_on_ashikhmin_shirley(scene, light, glossy):
    assert excess(reference(scene, prt.brdf.AshikhminShirley(**GLOSSY), light), *glossy).max() < 0


@pytest.mark.long
@pytest.mark.parametrize("name", cases())
def test_other_random_numbers_of_mitsuba_agree_within_their_noise(mitsuba, scene, name):
    kept, error = estimate(name)
    other = render(mitsuba, scene, **cases()[name] | {"seeds": range(RENDERINGS, 2 * RENDERINGS)})
    noise = np.hypot(error, other.std(0, ddof=1) / math.sqrt(RENDERINGS))
    assert np.linalg.norm(other.mean(0) - kept) < 3 * np.linalg.norm(noise)


def test_noise_of_mitsuba_is_small_beside_what_is_judged(matte, glossy):
    for (mean, error), bound in ((matte, 0.005), (glossy, 0.02)):
        assert np.linalg.norm(error) < bound * np.linalg.norm(mean)


@pytest.mark.parametrize("change", list(TURNED)[1:])
def test_another_environment_would_be_noticed(lambert, matte, change):
    assert excess(lambert[change], *matte).max() > 0


@pytest.mark.parametrize("change", [{"nu": 100.0, "nv": 10.0}, {"specular": 0.7}])
def test_another_brdf_would_be_noticed(scene, light, glossy, change):
    assert excess(reference(scene, prt.brdf.AshikhminShirley(**GLOSSY | change), light), *glossy).max() > 0


def test_missing_shadows_would_be_noticed(scene, skies, matte):
    far_away = scene._replace(position=scene.position - 100).mesh()
    actual = reference(scene, prt.brdf.Lambert(albedo=ALBEDO), skies, occluder=far_away)
    assert excess(actual[0], *matte).max() > 0
