"""The path tracer that judges interreflection is itself judged: its camera, its material, its direct light."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import path_tracing, plugins
from jaxprt import reference
from jaxprt.brdf import AshikhminShirley, BlinnPhong, CookTorrance, Lambert, MetallicRoughness
from jaxprt.image import pixels, raster
from jaxprt.scene import Camera, Environment, builtin
from jaxprt.scene.mesh import ground_plane, join
from jaxprt.sphere import cubemap

pytestmark = pytest.mark.skipif(not path_tracing.available(), reason="drjit finds no LLVM of version 17 or newer")

# Of the norm: the noise of 4,096 samples, and what differs between pixels' squares and centers. Pictures of 128 x 128
# pixels and 16,384 samples agree to 0.2 % beyond their noise of 0.4 %.
DIRECT = 0.015
MATERIALS = (
    CookTorrance([0.4, 0.2, 0.1], [0.5, 0.6, 0.7], 0.3, [0.1, 0.3, 0.2]),
    AshikhminShirley(0.3, 0.5, 150.0, 20.0),
)
SHARP = (
    BlinnPhong([0.4, 0.2, 0.1], [0.1, 0.3, 0.2], 30.0),
    *(CookTorrance([0.4, 0.2, 0.1], [0.5, 0.6, 0.7], roughness, [0.1, 0.3, 0.2]) for roughness in (0.1, 0.3, 0.5)),
    *(AshikhminShirley([0.4, 0.2, 0.1], [0.1, 0.3, 0.2], nu, nv) for nu, nv in ((20.0, 150.0), (8.0, 2.0))),
    MetallicRoughness([0.8, 0.4, 0.2], 0.5, 0.4),
    MetallicRoughness([0.8, 0.4, 0.2], 0.2, 0.5, 1.7, 0.6, [1.0, 0.5, 0.3], anisotropy=0.6, rotation=0.4),
    MetallicRoughness([0.8, 0.4, 0.2], 1.0, 0.35),
)


@pytest.fixture(scope="module")
def scene():
    """A ball over a ground, finer than the pixels, so that vertices' radiance can be interpolated."""
    ball = builtin.sphere(rings=96, sectors=192)
    return join([ball, ground_plane(ball, vertices=10000, extent=3.0)])


@pytest.fixture(scope="module")
def camera():
    """Off the middle, tilted, and not square: a mirrored or turned picture is another one."""
    return Camera([1.5, 2.0, 4.0], [0.3, -0.4, 0.1], [0.2, 1.0, 0.1], 0.5, 32, 24)


@pytest.fixture(scope="module")
def light():
    """Three broad lobes of distinct colors."""
    axis = np.array([[1.0, 0.4, 0.1], [-0.5, 0.8, 0.3], [0.1, 0.3, 1.0]])
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    lobe = np.exp(6 * (np.asarray(cubemap.direction(size=32)) @ axis.T - 1))
    radiance = lobe @ np.array([[3.0, 0.2, 0.1], [0.1, 2.0, 0.3], [0.1, 0.4, 3.0]]) + 0.1
    return Environment(jnp.asarray(radiance, jnp.float32))


@pytest.fixture(scope="module")
def plugin():
    """Makes Mitsuba's material, and an interaction seen from a direction."""
    import drjit
    import mitsuba

    mitsuba.set_variant("llvm_ad_rgb")

    def make(material, wi):
        seen = drjit.zeros(mitsuba.SurfaceInteraction3f)
        seen.wi = mitsuba.Vector3f(np.asarray(wi, float).tolist())
        return mitsuba, plugins.bsdf(material), seen

    return make


evaluate = jax.jit(lambda material, wi, wo: material(wi, wo))


def hemisphere():
    """Directions and solid angles: Gauss's nodes in the cosine, even steps around."""
    node, weight = np.polynomial.legendre.leggauss(200)
    cosine, turn = np.meshgrid((node + 1) / 2, 2 * np.pi * np.arange(400) / 400, indexing="ij")
    sine = np.sqrt(1 - cosine**2)
    direction = np.stack([sine * np.cos(turn), sine * np.sin(turn), cosine], -1).reshape(-1, 3)
    return direction.astype(np.float32), np.repeat(weight / 2, 400) * 2 * np.pi / 400


def inclined(angle):
    return np.array([np.sin(angle), 0.0, np.cos(angle)], np.float32)


@pytest.mark.parametrize("material", SHARP)
@pytest.mark.parametrize("angle", [0.02, 1.0, 1.4])
def test_material_is_that_of_jaxprt_and_samples_follow_its_density(plugin, material, angle):
    wo, area = hemisphere()
    mitsuba, bsdf, seen = plugin(material, inclined(angle))
    context = mitsuba.BSDFContext()
    actual, density = (np.array(x) for x in bsdf.eval_pdf(context, seen, mitsuba.Vector3f(wo.T)))
    expected = np.asarray(evaluate(material, wo, np.broadcast_to(inclined(angle), wo.shape))) * wo[:, 2:]
    assert np.linalg.norm(actual.T - expected) < 1e-4 * np.linalg.norm(expected)
    random = np.random.default_rng(0).random((3, 1 << 18), np.float32)
    drawn, weight = bsdf.sample(context, seen, mitsuba.Float(random[0]), mitsuba.Point2f(random[1:]))
    direction, weight = np.array(drawn.wo), np.array(weight)
    above = direction[2] > 0
    # Some four standard errors each: the share above the horizon, the mean direction, the albedo.
    assert abs(density @ area - above.mean()) < 2e-3
    np.testing.assert_allclose((direction * above).mean(1), wo.T @ (density * area), atol=4e-3)
    np.testing.assert_allclose(weight.mean(1), actual @ area, rtol=6e-3)


def test_no_sample_of_a_metal_weighs_more_than_its_color_at_grazing_angles(plugin):
    # A visible normal leaves only the masking of the other direction, however sharp the metal and low the eye.
    material = MetallicRoughness([1.0, 0.6, 0.2], 1.0, 0.1, anisotropy=0.5)
    for angle in (0.02, 1.0, 1.4, 1.55):
        mitsuba, bsdf, seen = plugin(material, inclined(angle))
        random = np.random.default_rng(0).random((3, 1 << 12), np.float32)
        _, weight = bsdf.sample(mitsuba.BSDFContext(), seen, mitsuba.Float(random[0]), mitsuba.Point2f(random[1:]))
        assert np.array(weight).max() < 1 + 1e-4
        assert np.array(weight)[0].mean() > 0.85


@pytest.mark.parametrize(
    ("material", "expected"),
    [
        (MATERIALS[0], [0.4 + 0.5 * 0.1, 0.2 + 0.6 * 0.3, 0.1 + 0.7 * 0.2]),
        (MATERIALS[1], [0.5 + 0.3 * 0.5] * 3),
        (MetallicRoughness([0.8, 0.4, 0.2], 1.0, 0.4), [0.8, 0.4, 0.2]),
        (MetallicRoughness([0.8, 0.4, 0.2], 0.0, 0.4), 0.04 + 0.96 * np.array([0.8, 0.4, 0.2])),
    ],
)
def test_denoisers_get_the_color_of_all_that_is_reflected(plugin, material, expected):
    _, bsdf, seen = plugin(material, inclined(1.0))
    np.testing.assert_allclose(np.array(bsdf.eval_diffuse_reflectance(seen)).ravel(), expected, rtol=1e-5)


def test_back_of_material_is_black(plugin):
    wo, _ = hemisphere()
    for sign_i, sign_o in ((-1, 1), (1, -1), (-1, -1)):
        mitsuba, bsdf, seen = plugin(MATERIALS[0], sign_i * inclined(0.5))
        value, density = bsdf.eval_pdf(mitsuba.BSDFContext(), seen, mitsuba.Vector3f(sign_o * wo.T))
        assert not np.any(np.array(value))
        assert not np.any(np.array(density))


def test_rays_are_those_of_jaxprt(plugin, camera):
    mitsuba, _, _ = plugin(MATERIALS[0], inclined(0.5))
    sensor = mitsuba.load_dict(path_tracing.sensor(mitsuba, camera))
    x, y = np.meshgrid((np.arange(32) + 0.5) / 32, (np.arange(24) + 0.5) / 24)
    ray, _ = sensor.sample_ray(0.0, 0.5, mitsuba.Point2f(x.ravel(), y.ravel()), mitsuba.Point2f(0.5, 0.5))
    np.testing.assert_allclose(np.array(ray.d).T, raster.ray_direction(camera).reshape(-1, 3), atol=1e-6)


def test_silhouette_is_that_of_the_rasterizer(camera):
    white = Environment(jnp.ones((6, 4, 4, 3)))
    ball = builtin.sphere()
    covered = path_tracing.picture(ball, [Lambert(1.0)], white, camera, depth=2, samples=256)[..., 0]
    expected = np.asarray(pixels.render(ball, jnp.ones((len(ball.position), 1)), camera, samples=1))[..., 0]
    # A convex white body in white light has its light's radiance, so that pixels show which part of them it covers.
    np.testing.assert_allclose(covered.sum(), expected.sum(), rtol=0.02)
    assert np.sum((covered > 0.5) != (expected > 0.5)) <= 3


def test_direct_light_is_that_of_the_reference(scene, camera, light):
    fragments = raster.rasterize(scene, camera)
    triangle = np.asarray(fragments.triangle)
    face, region = np.asarray(scene.face), np.asarray(scene.region)
    corner = face[np.maximum(triangle, 0)]
    seen = np.where(triangle >= 0, region[corner[..., 0]], -1)
    # Two pixels away from the silhouettes, of which pixels' centers and squares see different shares.
    rows, columns = (np.arange(2, n - 2) for n in seen.shape)
    around = np.stack([seen[rows[:, None] + i, columns + j] for i in range(-2, 3) for j in range(-2, 3)])
    inner = np.zeros_like(triangle, bool)
    inner[2:-2, 2:-2] = (around == around[0]).all(0) & (around[0] >= 0)
    inner &= np.arange(inner.size).reshape(inner.shape) % 4 == 0  # enough, since the reference is slow
    asked = np.unique(corner[inner])
    color = np.zeros((len(region), 3), np.float32)
    for number, material in enumerate(MATERIALS):
        vertex = asked[region[asked] == number]
        color[vertex] = reference.radiance(scene, material, light, eye=camera.eye, vertex=vertex)
    expected = np.asarray(pixels.interpolate(fragments, scene.face, jnp.asarray(color)))[inner]

    def error(materials, samples):
        image = path_tracing.picture(scene, materials, light, camera, depth=2, samples=samples)[inner]
        return np.linalg.norm(image - expected) / np.linalg.norm(expected)

    assert inner.sum() > 60
    assert error(MATERIALS, samples=4096) < DIRECT
    assert error(MATERIALS[::-1], samples=256) > 10 * DIRECT


def test_bounces_only_add_light_and_less_each_time(scene, camera, light):
    one, two, three = (
        path_tracing.picture(scene, [Lambert(0.8)] * 2, light, camera, depth=depth, samples=400).mean()
        for depth in (2, 3, 4)
    )
    assert 0.02 * one < two - one < 0.3 * one
    assert 0 < three - two < 0.5 * (two - one)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"materials": MATERIALS[:1]}, "materials must have one for each region, got 1 and region 1"),
        ({"materials": [MATERIALS[0], None]}, "materials must be CookTorrance, .* or PerVertex, got NoneType"),
        ({"light": Environment(jnp.ones((2, 6, 4, 4, 3)))}, r"light must be one environment, got a batch \[2\]"),
        ({"depth": 1}, "depth must be at least 2 and samples at least 1, got 1 and 4"),
        ({"samples": 0}, "depth must be at least 2 and samples at least 1, got 2 and 0"),
    ],
)
def test_what_cannot_be_traced_is_refused(scene, camera, light, change, message):
    options = {"materials": MATERIALS, "light": light, "depth": 2, "samples": 4} | change
    with pytest.raises(ValueError, match=message):
        path_tracing.picture(scene, camera=camera, **options)
