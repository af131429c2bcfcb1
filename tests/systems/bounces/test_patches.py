"""Diffuse light between patches: series and furnaces in closed form, textures, closed rooms, surfaces twice."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt import bounces, separable
from jaxprt.brdf import Lambert
from jaxprt.scene import Environment, Mesh, builtin
from jaxprt.scene.mesh import join, make_mesh
from jaxprt.systems.bounces import GroupBounces
from tests.systems.bounces.reflected import of_regions, radiance

pytestmark = pytest.mark.usefixtures("coarse")

EYE = jnp.array([0.3, 3.0, 0.2])
SKY = Environment(jnp.ones((6, 8, 8, 3)))
OPTIONS = {"components": 40, "modes": 24, "edge": 2, "size": 16}


@functools.cache
def bowl() -> Mesh:
    """Half a sphere, seen from inside: every point sees the bowl over half of its horizon, weighted by the cosine."""
    ball = builtin.sphere(rings=16, sectors=20)
    low = np.all(np.asarray(ball.position)[np.asarray(ball.face), 1] < 1e-3, 1)
    used, face = np.unique(np.asarray(ball.face)[low][:, ::-1], return_inverse=True)
    return make_mesh(ball.position[used], face.reshape(-1, 3), normal=-np.asarray(ball.normal)[used])


def made(mesh: Mesh, albedo: float = 1.0, **options) -> GroupBounces:
    """Reflected light between matte regions."""
    regions = np.unique(np.asarray(mesh.region)).tolist()
    matte = separable.factor(Lambert(albedo), terms=1, resolution=8)
    tensor = bounces.precompute(mesh, [matte] * len(regions), **OPTIONS | options)
    return of_regions(mesh, [Lambert(albedo)] * len(regions), tensor)


def shown(system: GroupBounces, materials=None) -> np.ndarray:
    return np.asarray(radiance(system, SKY, EYE, materials))


@functools.cache
def settled() -> GroupBounces:
    return made(bowl(), bounces="all")


@pytest.mark.parametrize("albedo", [1.0, 0.8])
def test_after_all_bounces_a_bowl_has_the_light_of_the_closed_form(albedo):
    """The furnace: 1/2 by direct light, and for albedo 1 the other half by all bounces."""
    count = len(bowl().position)
    blend = prt.Blend(jnp.full((count, 1, 1), albedo))
    color = shown(settled(), [blend])
    half = albedo / 2
    inside = np.asarray(bowl().position)[:, 1] < -0.1
    expected = half * half / (1 - half)
    np.testing.assert_allclose(color[inside], expected, rtol=0.03)
    np.testing.assert_allclose(color[inside].mean(), expected, rtol=0.01)


def test_every_bounce_adds_half_of_the_one_before_and_is_worth_it():
    tensor = made(bowl(), bounces=5).tensor
    np.testing.assert_allclose(tensor.worth, 0.5 ** np.arange(2, 7), rtol=0.04)
    rest = settled().tensor.worth
    assert rest.shape == (3,)
    np.testing.assert_allclose(rest[2], 0.125, rtol=0.03)
    white = jnp.ones((len(tensor.function), 1))
    lit = bounces.tensor.light_side(tensor, SKY)

    def arriving(count):
        patches = tensor.patches
        own = bounces.Patches(**{**vars(patches), "bounces": count})
        held = bounces.TransferTensor(**{**vars(tensor), "patches": own})
        whole = bounces.tensor.collect(held, lit, white * tensor.factor[0])
        return float(jnp.mean(whole[0])) * np.sqrt(4 * np.pi)

    each = np.array([arriving(count) for count in (2, 3, 4, 5, None)])
    added = np.diff(each)
    np.testing.assert_allclose(added[1:3] / added[:2], 0.5, rtol=0.02)
    np.testing.assert_allclose(added[3], added[2], rtol=0.02)  # All that follow bring as much as the last of a half.


def test_form_factors_and_the_light_add_up_to_one():
    patches = settled().tensor.patches
    inside = np.asarray(bowl().position)[:, 1] < -0.1
    whole = np.asarray(patches.factor, np.float64).sum(1)
    np.testing.assert_allclose(whole[inside], 0.5, atol=0.02)
    np.testing.assert_allclose(np.sum(patches.between, 1) + np.sum(patches.light, 1), 1, atol=2e-3)
    np.testing.assert_allclose(patches.strength[0] @ settled().tensor.factor[0], 1, rtol=0.01)
    irradiance = np.sum(np.asarray(patches.spread) * bounces.gather.cosines(np.asarray(bowl().normal)), 1)
    np.testing.assert_allclose(irradiance, 1, atol=2e-3)


def corner(*, split: bool) -> Mesh:
    """A floor and a wall, the wall as one region or as its two halves."""
    floor = builtin.plane(cells=14)
    position = (np.asarray(floor.position)[:, [0, 2, 1]] * [1, -1, 1] + [0, 1, -1]).astype(np.float32)
    face, left = np.asarray(floor.face), position[:, 0] < 1e-3
    parts = [floor]
    for side in (left, position[:, 0] > -1e-3) if split else (left | True,):
        used, own = np.unique(face[side[face].all(1)], return_inverse=True)
        parts.append(make_mesh(position[used], own.reshape(-1, 3)))
    return join(parts)


# Relative L2 of what 256 patches of 450 vertices make of the border between two colors.
MIXED = 0.08


@pytest.mark.parametrize("count", [2, "all"])
def test_a_wall_of_two_colors_lights_a_floor_as_two_walls_of_a_color_each(count):
    red, blue = np.array([0.9, 0.1, 0.1], np.float32), np.array([0.1, 0.1, 0.9], np.float32)
    exact_mesh, mesh = corner(split=True), corner(split=False)
    regions = np.bincount(np.asarray(exact_mesh.region))
    blends = [prt.Blend(jnp.full((regions[0], 1, 1), 0.9))]
    blends += [prt.Blend(jnp.tile(color, (n, 1, 1))) for n, color in zip(regions[1:], (red, blue), strict=True)]
    exact = shown(made(exact_mesh, bounces=count), blends)[: regions[0]]
    position = np.asarray(mesh.position)[np.asarray(mesh.region) == 1]
    share = np.clip(0.5 - position[:, :1] * 3.5, 0, 1)
    painted = prt.Blend(jnp.asarray((share * red + (1 - share) * blue)[:, None], jnp.float32))
    system = made(mesh, bounces=count)
    found = shown(system, [blends[0], painted])[: regions[0]]
    assert np.linalg.norm(found - exact) < MIXED * np.linalg.norm(exact)
    mean = jnp.broadcast_to(jnp.mean(painted.weight, 0), painted.weight.shape)
    plain = shown(system, [blends[0], prt.Blend(mean)])[: regions[0]]
    assert np.linalg.norm(plain - exact) > 0.3 * np.linalg.norm(exact)


def test_gradients_of_all_bounces_are_finite_differences():
    system, count = settled(), len(bowl().position)
    texture = jnp.asarray(np.random.default_rng(0).uniform(0.2, 0.8, (count, 1, 3)), jnp.float32)

    @jax.jit
    def total(step, light_step):
        blend = prt.Blend(texture * (1 + step * jnp.arange(count)[:, None, None] / count))
        light = Environment(SKY.radiance.at[2].multiply(1 + light_step))
        return jnp.mean(radiance(system, light, EYE, [blend]))

    slope = jax.grad(total, (0, 1))(0.0, 0.0)
    for number, each in enumerate(slope):
        ends = [float(total(*np.eye(2)[number] * step)) for step in (0.05, -0.05)]
        np.testing.assert_allclose(each, (ends[0] - ends[1]) / 0.1, rtol=5e-3)


def test_a_closed_white_room_without_light_stays_dark():
    ball = builtin.sphere(rings=10, sectors=12)
    room = make_mesh(ball.position, ball.face[:, ::-1], normal=-ball.normal)
    system = made(room, bounces="all")
    np.testing.assert_allclose(system.tensor.worth, 0, atol=1e-6)
    np.testing.assert_allclose(shown(system), 0, atol=1e-6)
    np.testing.assert_allclose(np.sum(system.tensor.patches.between, 1), 1, atol=2e-3)
    slope = jax.grad(lambda x: jnp.sum(radiance(system, Environment(x), EYE)))(SKY.radiance)
    assert np.isfinite(slope).all()


def test_faces_twice_in_opposite_orientation_reflect_as_their_fronts():
    """The bowl with a second skin that faces outward: what is inside stays as it was."""
    inner = bowl()
    outer = make_mesh(inner.position, inner.face[:, ::-1], normal=-inner.normal)
    both = shown(made(join([inner, outer]), bounces="all"))
    assert np.isfinite(both).all()
    inside = np.asarray(inner.position)[:, 1] < -0.1
    np.testing.assert_allclose(both[: len(inside)][inside].mean(), 0.5, rtol=0.03)
    np.testing.assert_allclose(both[len(inside) :][inside], 0, atol=1e-5)


def test_one_triangle_has_one_patch_and_no_reflected_light():
    one = make_mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, -1]]), np.array([[0, 1, 2]]))
    system = made(one, bounces="all")
    assert system.tensor.patches.between.shape == (1, 1)
    np.testing.assert_array_equal(shown(system), 0)


@pytest.mark.usefixtures("unchecked")
def test_numbers_of_patches_and_bounces_that_are_none_are_refused():
    for options, message in (
        ({"bounces": "both"}, "bounces must be a whole number of at least 1, or 'all', got 'both'"),
        ({"patches": 0}, "patches must be at least 1, got 0"),
    ):
        with pytest.raises(ValueError, match=message):
            made(bowl(), **options)
