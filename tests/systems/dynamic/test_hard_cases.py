"""The dynamic system where something degenerates: nothing may become NaN, infinite or absurd."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt import dynamic, lobe, reference
from jaxprt.brdf import BlinnPhong, CookTorrance, Lambert, navigation
from jaxprt.scene import Environment, builtin

SIZE = 8
HORIZON = 1e-3  # 2 x 2 points in each texel that the horizon cuts, against the integral: measured 4.5e-4.
RESOLUTION = 8
ENDS = [CookTorrance(diffuse=0.0, specular=1.0, roughness=m, f0=0.5) for m in (0.01, 1.0)]


@pytest.fixture(scope="module", autouse=True)
def quick():
    """Lobes without their error, which no test here asks for and which takes longer than the fit."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lobe.table, "_natural_error", lambda brdf, table: 0.0)
        yield


@jax.jit
def value(family, weight, wi, wo):
    return family.at(weight)(wi, wo)


@jax.jit
def slope(family, weight, wi, wo):
    """Value, and derivative of its sum by the weights."""
    return value(family, weight, wi, wo), jax.grad(lambda weight: jnp.sum(value(family, weight, wi, wo)))(weight)


@jax.jit
def weights(plane, coordinate):
    return plane.weight(coordinate), jax.jacobian(plane.weight)(coordinate)


def fit(brdf):
    return lobe.tabulate(brdf, lobes=2, resolution=8)


def directions(*height):
    """Views at some heights, and incident directions in front, behind and at the same place."""
    sine = [np.sqrt(1 - h**2) for h in height]
    wo = np.array([[x, 0, h] for x, h in zip(sine, height, strict=True)])
    wi = wo[:, None] * np.array([[1, 1, 1], [-1, 1, 1]])
    return jnp.asarray(wi, jnp.float32), jnp.asarray(np.repeat(wo[:, None], 2, 1), jnp.float32)


@pytest.fixture(scope="module")
def mesh():
    return builtin.sphere(rings=6, sectors=8)


@pytest.fixture(scope="module")
def family():
    return dynamic.factor(ENDS, dynamic.separate(ENDS, separator=fit))


@pytest.fixture(scope="module")
def transport(mesh, family):
    return dynamic.precompute_sets(mesh, [family], size=SIZE, progress=False)


def color(transport, family, weight, light, eye=(0.5, 1.0, 3.0), diffuse=0.2, specular=1.0):
    matter = dynamic.Material(jnp.asarray(weight), jnp.full(1, diffuse), jnp.full(1, specular))
    return dynamic.radiance(transport, [family], [matter], light, eye=jnp.asarray(eye), texels=4)


@pytest.mark.parametrize(
    "members",
    [
        [CookTorrance(diffuse=0.0, specular=1.0, roughness=0.3)],
        [CookTorrance(diffuse=0.0, specular=1.0, roughness=0.3)] * 3,
        [CookTorrance(diffuse=0.0, specular=s, roughness=0.3) for s in (0.0, 0.5, 1.0)],
        [CookTorrance(diffuse=0.0, specular=0.0, roughness=0.3)] * 2,
    ],
    ids=["one alone", "identical", "multiples of one", "black"],
)
def test_sets_of_low_rank(members):
    """Of rank one or less, whatever is asked for."""
    ranks = (min(2, len(members)), 4, 4)
    many = dynamic.factor(members, None, ranks=ranks, resolution=RESOLUTION)
    one = dynamic.factor(members[-1:], None, ranks=(1, 4, 4), resolution=RESOLUTION)
    assert all(np.isfinite(np.asarray(each)).all() for each in jax.tree.leaves(many))
    wi, wo = directions(0.3, 0.7, 0.99)
    last = value(many, np.eye(len(members), dtype=np.float32)[-1], wi, wo)
    np.testing.assert_allclose(last, value(one, np.ones(1, np.float32), wi, wo), rtol=1e-5, atol=1e-6)


def test_a_constant_tensor():
    members = [lambda wi, wo: 0 * wi[:, 2:] + 0.25, lambda wi, wo: 0 * wi[:, 2:] + 0.25]
    flat = dynamic.factor(members, None, ranks=(2, 3, 3), resolution=RESOLUTION)
    wi, wo = directions(0.3, 0.7, 0.99)
    np.testing.assert_allclose(value(flat, jnp.array([0.5, 0.5]), wi, wo), 0.25, rtol=2.5e-3)
    assert flat.error < 1e-3


def test_shininess_at_the_ends():
    members = [BlinnPhong(diffuse=0.0, specular=1.0, exponent=n) for n in (1.0, 200.0)]
    family = dynamic.factor(members, dynamic.separate(members, separator=fit))
    wi, wo = directions(0.2, 0.7, 1.0)
    for exponent in (0.0, 1.0, 200.0, 1e9):
        weight = navigation.Line(jnp.array([1.0, 200.0])).weight(jnp.asarray(exponent))
        assert np.isfinite(value(family, weight, wi, wo)).all()
        np.testing.assert_allclose(family.at(weight).brdf.exponent, np.clip(exponent, 1, 200), rtol=1e-5)


@pytest.mark.parametrize("height", [0.0, 1e-30, 1e-6, 1e-3, 1.0])
@pytest.mark.parametrize("number", [0, 1])
def test_views_down_to_the_horizon(family, number, height):
    wi, wo = directions(height, 0.5)
    assert all(np.isfinite(each).all() for each in slope(family, np.eye(2, dtype=np.float32)[number], wi, wo))


@pytest.mark.parametrize("weight", [(1.0, 0.0), (0.0, 1.0), (0.5, 0.5)])
def test_zero_light_gives_zero(transport, family, weight):
    dark = Environment(jnp.zeros((6, SIZE, SIZE, 3)))
    np.testing.assert_array_equal(color(transport, family, weight, dark), 0)


def test_a_sun_in_one_texel_is_exact(mesh, transport, family):
    """All of the light is lit by one by one, with the BRDF at the center of the texel."""
    texel = 77
    sun = jnp.zeros((6 * SIZE * SIZE, 3)).at[texel].set(100.0).reshape(6, SIZE, SIZE, 3)
    lit = color(transport, family, (0.0, 1.0), Environment(sun))
    model = CookTorrance(diffuse=0.2, specular=1.0, roughness=1.0, f0=0.5)
    exact = reference.radiance(mesh, model, Environment(sun), eye=jnp.array([0.5, 1.0, 3.0]), error=np.inf)
    assert float(jnp.linalg.norm(lit - exact) / jnp.linalg.norm(exact)) < 1e-6


def test_a_furnace_of_diffuse_parts_is_white(mesh, transport, family):
    """Constant light, and no specular part; what a vertex of a coarse sphere does not see are its own faces."""
    white = Environment(jnp.ones((6, SIZE, SIZE, 3)))
    value = np.asarray(color(transport, family, (0.5, 0.5), white, diffuse=1.0, specular=0.0))[:, 0]
    exact = np.asarray(reference.radiance(mesh, Lambert(1.0), white, eye=jnp.array([0.5, 1.0, 3.0]), error=1e-5))[:, 0]
    assert (exact > 0.9).sum() > 5
    np.testing.assert_allclose(value, exact, atol=HORIZON)


@pytest.mark.parametrize("coordinate", [(-1e6, 0.5), (0.5, -3.0), (2.0, 100.0), (0.3, 1e-30), (1.0, 1.0)])
def test_coordinates_outside_the_hull(coordinate):
    plane = navigation.cook_torrance().navigation
    weight, along = map(np.asarray, weights(plane, jnp.asarray(coordinate)))
    assert np.isfinite(weight).all()
    assert np.isfinite(along).all()
    np.testing.assert_allclose(weight.sum(), 1, rtol=1e-5)
    assert weight.min() >= 0


def test_an_eye_at_a_vertex(mesh, transport, family):
    light = builtin.daylight(size=SIZE)
    assert bool(jnp.isfinite(color(transport, family, (0.5, 0.5), light, eye=mesh.position[3])).all())
