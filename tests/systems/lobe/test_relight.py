"""Relighting by lobes against the sum over all texels."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt import bright_texels, lobe, reference
from jaxprt.brdf import AshikhminShirley, CookTorrance
from jaxprt.decompose import mixture
from jaxprt.scene import Environment, builtin
from jaxprt.sphere import cubemap
from tests.systems.scenes import SIZE, pyramids_on_ground, seen_on_ground

pytestmark = pytest.mark.usefixtures("few_samples")
EYE = jnp.array([1.2, 1.5, 2.5])
# Errors of total radiance; what was measured, and half as much again.
COARSE = {"matte": 0.01, "glossy": 0.03, "sharp": 0.021, "brushed": 0.013}
BLUR = 0.08  # Measured .077 at the finest scale that texels resolve: the lookup's tent is taken out of the blur.
COVARIANCE = 0.25  # Of the covariance, what splines bring too much where an edge lies between texels: measured .24.
BRDFS = {
    "matte": CookTorrance(diffuse=[0.8, 0.5, 0.2], specular=0.0),  # Lambert, by programs that the next two share.
    "glossy": CookTorrance(diffuse=[0.0, 0.0, 0.0], roughness=0.3),
    "sharp": CookTorrance(diffuse=[0.3, 0.2, 0.1], roughness=0.1),
    "brushed": AshikhminShirley(nu=8, nv=60),
}


def relight(transport, table, light, *, eye):
    return prt.radiance(lobe.LobeSystem(transport, table), light, eye=eye)


@pytest.fixture(scope="module")
def visible():
    return seen_on_ground()


@pytest.fixture(scope="module")
def transport():
    return pyramids_on_ground()


@pytest.fixture(scope="module")
def tables():
    return {name: lobe.tabulate(brdf, lobes=6, resolution=16) for name, brdf in BRDFS.items()}


@pytest.fixture(scope="module")
def light():
    return builtin.daylight(size=SIZE)


def facing(visible):
    """Vertices that the eye sees from above their horizon."""
    return np.einsum("vi,vi->v", np.asarray(visible.frame)[:, 2], np.asarray(EYE) - visible.position) > 0


def all_texels(visible, brdf, light):
    seen = jnp.asarray(visible.seen(np.arange(len(visible.position))))
    return np.asarray(reference.integrate(seen, visible.position, visible.frame, brdf, light, EYE))


@pytest.mark.parametrize("name", BRDFS)
def test_radiance_is_that_of_all_texels(name, visible, transport, tables, light, close):
    texel, excess, rest = bright_texels.split(light, count=8)
    color = np.asarray(relight(transport, tables[name], rest, eye=EYE))
    color = color + np.asarray(jax.jit(bright_texels.radiance)(transport, BRDFS[name], texel, excess, eye=EYE))
    seen = facing(visible)
    close(color[seen], all_texels(visible, BRDFS[name], light)[seen], tolerance=COARSE[name])


def test_rays_that_hit_nothing_are_what_an_open_plane_sees(tables, close):
    """Narrow lobes fall short of the horizon, at grazing angles too, so that rays need not know it."""
    plane = lobe.precompute(builtin.plane(cells=1), size=64, run=prt.visibility.Run(progress=False))
    height = np.array([0.011, 0.02, 0.04, 0.9])
    way = np.stack([np.sqrt(1 - height**2), height, 0 * height], 1)
    eye = jnp.asarray(np.asarray(plane.position) + 10 * way, jnp.float32)

    def seen(missed):
        view = lobe.system.view_lobes(plane, tables["sharp"], eye=eye, missed=missed)
        return jnp.sum(view.weight[0] * sum(view.visible), 0)

    close(seen(jnp.ones(4)), seen(None), tolerance=0.01)
    assert seen(jnp.zeros(4))[0] < 0.12 * seen(None)[0]
    np.testing.assert_array_equal(seen(-jnp.ones(4)), seen(None))


def test_light_that_grows_towards_the_open_side_counts_more():
    """Half of a lobe is seen, the bright half: the product of means is off by the covariance, which slopes bring."""
    center = np.asarray(cubemap.direction(size=SIZE), np.float64).reshape(-1, 3)
    area = np.asarray(cubemap.solid_angle(size=SIZE), np.float64).ravel()
    open_side = (center[:, 2] > 0) & (center[:, 0] > 0)
    pyramid = lobe.pyramid.pyramid(jnp.asarray(np.where(open_side, 16, 0)[None], jnp.uint8))
    frame = jnp.eye(3)[None]
    half = lobe.LobeTransport(
        pyramid, jnp.zeros((lobe.diffuse.count(SIZE), 1), jnp.uint8), jnp.zeros((1, 3)), frame, SIZE
    )
    radiance = 1 + 0.8 * center[:, 0]
    light = Environment(jnp.asarray(radiance.reshape(6, SIZE, SIZE, 1), jnp.float32))
    for concentration in (8.0, 20.0, 60.0):
        nodes, up = np.ones((1, 1, 4), np.float32), np.tile(np.float32([0, 0, 1])[:, None, None], (1, 1, 4))
        rows = up, np.float32(np.log(concentration)) * nodes[0], nodes, 0 * nodes[0]
        one = lobe.LobeBrdf(*map(jnp.asarray, rows), (), jnp.array(0.0))
        weight = area * np.exp(concentration * (center[:, 2] - 1))
        weight /= weight.sum()
        exact, apart = weight @ (open_side * radiance), (weight @ open_side) * (weight @ radiance)
        value = float(relight(half, one, light, eye=jnp.array([0.0, 0.0, 5.0]))[0, 0])
        assert abs(value - exact) < COVARIANCE * abs(apart - exact)


def test_blurred_light_is_the_mean_over_lobes(light):
    """Against sums over all texels, at the texel centers of each scale."""
    filtered, scale = lobe.blurred_light.prefilter(light), lobe.blurred_light.scales(SIZE)
    center = np.asarray(cubemap.direction(size=SIZE), np.float64).reshape(-1, 3)
    area = np.asarray(cubemap.solid_angle(size=SIZE), np.float64).ravel()
    radiance = np.asarray(light.radiance, np.float64).reshape(-1, 3)
    for number in range(3, len(scale.edge)):
        edge, start = int(scale.edge[number]), int(scale.start[number])
        concentration = float(mixture.concentration_of(jnp.asarray(scale.spread[number])))
        place = np.asarray(cubemap.direction(size=edge), np.float64).reshape(-1, 3)
        weight = area * np.exp(concentration * (place @ center.T - 1))
        expected = (weight / weight.sum(1, keepdims=True)) @ radiance
        level = np.asarray(filtered.pyramid)[:, start : start + 6 * (edge + 2) ** 2].reshape(3, 6, edge + 2, edge + 2)
        value = level[:, :, 1:-1, 1:-1].reshape(3, -1).T
        assert np.linalg.norm(value - expected) < BLUR * np.linalg.norm(expected)


def test_finer_scales_hold_the_texels_of_what_is_left_of_a_light(close):
    """Taking half of each texel takes half of its finer ones; without these, the light is interpolated."""
    finer, texels = lobe.blurred_light.FINER * SIZE, np.random.default_rng(0).uniform(0.5, 1, (6, SIZE, SIZE, 16, 3))
    texels = np.float32(texels.reshape(6, SIZE, SIZE, 4, 4, 3).swapaxes(2, 3).reshape(6, finer, finer, 3))
    whole = lobe.blurred_light.prefilter(Environment(cubemap.reduced(texels, size=SIZE)))
    scale = lobe.blurred_light.finer_scales(SIZE, before=whole.pyramid.shape[1])
    assert scale.edge[0] == finer
    assert (np.diff(scale.edge) <= 0).all()
    assert (np.diff(scale.spread) > 0).all()

    def level(made, number):
        edge, start = int(scale.edge[number]), int(scale.start[number])
        rows = np.asarray(made.pyramid)[:, start : start + 6 * (edge + 2) ** 2]
        return rows.T.reshape(6, edge + 2, edge + 2, 3)[:, 1:-1, 1:-1]

    for share in (1.0, 0.5, 0.0):
        left = dataclasses.replace(whole, pyramid=share * whole.pyramid)
        made = lobe.blurred_light.sharpened(left, texels)
        assert made.pyramid.shape[1] == scale.total
        for number, edge in enumerate(scale.edge[:3].tolist()):
            close(level(made, number), share * np.asarray(cubemap.reduced(texels, size=edge)), tolerance=1e-5)
    even = lobe.blurred_light.prefilter(Environment(jnp.full((6, SIZE, SIZE, 3), 2.5)))
    close(lobe.blurred_light.sharpened(even, None).pyramid, np.full((3, scale.total), 2.5), tolerance=1e-5)


def test_constant_light_stays_constant_at_all_scales(close):
    filtered = lobe.blurred_light.prefilter(Environment(jnp.full((6, SIZE, SIZE, 3), 2.5)))
    close(filtered.pyramid, np.full(filtered.pyramid.shape, 2.5))


def test_a_gray_light_on_a_colored_brdf_and_the_other_way_round(transport, tables, light, close):
    gray = Environment(jnp.asarray(np.mean(light.radiance, -1, keepdims=True)))
    colored = Environment(jnp.asarray(np.repeat(gray.radiance, 3, -1)))
    for name in ("sharp", "brushed"):
        color = relight(transport, tables[name], gray, eye=EYE)
        expected = relight(transport, tables[name], colored, eye=EYE)
        close(np.broadcast_to(color, expected.shape), expected)


def test_a_batch_of_lights_is_refused(light, unchecked):
    with pytest.raises(ValueError, match=r"must be one environment \[6, n, n, c\].* got \[2, 6, 16, 16, 3\]"):
        lobe.blurred_light.prefilter(Environment(jnp.stack([light.radiance] * 2)))
