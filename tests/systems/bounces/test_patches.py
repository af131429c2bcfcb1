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
from tests.systems.bounces.reflected import EYE, OPTIONS, SKY, bowl, of_regions, radiance, repeated

pytestmark = pytest.mark.usefixtures("coarse")

COUNT = len(bowl().position)  # vertices of each region in all scenes, so that they are compiled once
INSIDE = np.asarray(bowl().position)[:, 1] < -0.1


@functools.cache
def matte() -> separable.SeparableBrdf:
    return separable.factor(Lambert(1.0), terms=1, resolution=8)


def made(mesh: Mesh, **options) -> GroupBounces:
    """All bounces between white matte regions."""
    regions = np.unique(np.asarray(mesh.region)).tolist()
    tensor = bounces.precompute(mesh, [matte()] * len(regions), **OPTIONS | {"bounces": "all"} | options)
    return of_regions(mesh, [Lambert(1.0)] * len(regions), tensor)


@jax.jit
def shown(system: GroupBounces, materials=None) -> jax.Array:
    return radiance(system, SKY, EYE, materials)


@functools.cache
def settled() -> GroupBounces:
    return made(bowl())


@pytest.mark.parametrize("albedo", [1.0, 0.8])
def test_after_all_bounces_a_bowl_has_the_light_of_the_closed_form(albedo):
    """The furnace: 1/2 by direct light, and for albedo 1 the other half by all bounces."""
    color = np.asarray(shown(settled(), [prt.Blend(jnp.full((COUNT, 1, 1), albedo))]))
    half = albedo / 2
    expected = half * half / (1 - half)
    np.testing.assert_allclose(color[INSIDE], expected, rtol=0.03)
    np.testing.assert_allclose(color[INSIDE].mean(), expected, rtol=0.01)


def test_every_bounce_adds_half_of_the_one_before_and_is_worth_it():
    tensor = settled().tensor
    np.testing.assert_allclose(tensor.worth, [0.25, 0.125, 0.125], rtol=0.04)
    white = jnp.ones((len(tensor.function), 1))
    lit = bounces.tensor.light_side(tensor, SKY)

    def arriving(count):
        patches = bounces.Patches(**{**vars(tensor.patches), "bounces": count})
        held = bounces.TransferTensor(**{**vars(tensor), "patches": patches})
        return np.mean(bounces.tensor.collect(held, lit, white * tensor.factor[0])[0]) * np.sqrt(4 * np.pi)

    added = np.diff([arriving(count) for count in (2, 3, 4, None)])
    np.testing.assert_allclose(added[1] / added[0], 0.5, rtol=0.02)
    np.testing.assert_allclose(added[2], added[1], rtol=0.02)  # All that follow bring as much as the last of a half.


def test_form_factors_and_the_light_add_up_to_one():
    patches = settled().tensor.patches
    whole = np.asarray(patches.factor, np.float64).sum(1)
    np.testing.assert_allclose(whole[INSIDE], 0.5, atol=0.02)
    np.testing.assert_allclose(np.sum(patches.between, 1) + np.sum(patches.light, 1), 1, atol=2e-3)
    np.testing.assert_allclose(np.dot(patches.strength[0], settled().tensor.factor[0]), 1, rtol=0.01)
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
    red, blue = np.float32([0.9, 0.1, 0.1]), np.float32([0.1, 0.1, 0.9])
    halves = np.bincount(np.asarray(corner(split=True).region))[1:]
    floor = prt.Blend(jnp.full((COUNT, 1, 1), 0.9))
    walls = [prt.Blend(jnp.asarray(np.tile(color, (n, 1, 1)))) for n, color in zip(halves, (red, blue), strict=True)]
    exact = np.asarray(shown(made(corner(split=True), bounces=count), [floor, *walls]))[:COUNT]
    position = np.asarray(corner(split=False).position)[COUNT:]
    share = np.clip(0.5 - position[:, :1] * 3.5, 0, 1)
    painted = (share * red + (1 - share) * blue)[:, None].astype(np.float32)
    system = made(corner(split=False), bounces=count)
    found, plain = (
        np.asarray(shown(system, [floor, prt.Blend(jnp.asarray(weight))]))[:COUNT]
        for weight in (painted, np.broadcast_to(painted.mean(0), painted.shape))
    )
    assert np.linalg.norm(found - exact) < MIXED * np.linalg.norm(exact)
    assert np.linalg.norm(plain - exact) > 0.3 * np.linalg.norm(exact)


def test_gradients_of_all_bounces_are_finite_differences():
    texture = np.random.default_rng(0).uniform(0.2, 0.8, (COUNT, 1, 3)).astype(np.float32)
    along = np.arange(COUNT, dtype=np.float32)[:, None, None] / COUNT

    @jax.jit
    def total(step, light_step):
        light = Environment(SKY.radiance.at[2].multiply(1 + light_step))
        return jnp.mean(radiance(settled(), light, EYE, [prt.Blend(texture * (1 + step * along))]))

    slope = jax.jit(jax.grad(total, (0, 1)))(0.0, 0.0)
    for number, each in enumerate(slope):
        ends = [float(total(*np.eye(2)[number] * step)) for step in (0.05, -0.05)]
        np.testing.assert_allclose(each, (ends[0] - ends[1]) / 0.1, rtol=5e-3)


def test_a_closed_white_room_without_light_stays_dark():
    ball = builtin.sphere(rings=8, sectors=31)
    inward = make_mesh(ball.position, np.asarray(ball.face)[:, ::-1], normal=-np.asarray(ball.normal))
    system = made(repeated(inward, COUNT))
    np.testing.assert_allclose(system.tensor.worth, 0, atol=1e-6)
    np.testing.assert_allclose(shown(system), 0, atol=1e-6)
    between = np.sum(system.tensor.patches.between, 1)  # Patches of what is repeated have no area.
    np.testing.assert_allclose(between[between > 0], 1, atol=2e-3)
    assert np.mean(between > 0) > 0.9


def test_faces_twice_in_opposite_orientation_reflect_as_their_fronts():
    """The bowl with a second skin that faces outward: what is inside stays as it was."""
    outer = make_mesh(bowl().position, np.asarray(bowl().face)[:, ::-1], normal=-np.asarray(bowl().normal))
    both = np.asarray(shown(made(join([bowl(), outer]))))
    assert np.isfinite(both).all()
    np.testing.assert_allclose(both[:COUNT][INSIDE].mean(), 0.5, rtol=0.03)
    np.testing.assert_allclose(both[COUNT:][INSIDE], 0, atol=1e-5)


def test_backs_of_surfaces_send_no_light():
    """A lid over the bowl that faces up: the bowl sees its back."""
    lid = builtin.plane(cells=14)
    above = make_mesh(np.asarray(lid.position) + np.float32([0, 0.2, 0]), lid.face, normal=lid.normal)
    traced = bounces.patches.exchange(join([bowl(), above]), patches=64, size=16, edge=2)
    own, back = (traced.factor[:COUNT, traced.region == region] for region in (0, 1))
    assert own.max() > 0.01
    np.testing.assert_array_equal(back, np.zeros((COUNT, np.sum(traced.region == 1))))


@pytest.mark.usefixtures("unchecked")
def test_numbers_of_patches_and_bounces_that_are_none_are_refused():
    for options, message in (
        ({"bounces": "both"}, "bounces must be a whole number of at least 1, or 'all', got 'both'"),
        ({"bounces": 0}, "bounces must be a whole number of at least 1, or 'all', got 0"),
        ({"patches": 0}, "patches must be at least 1, got 0"),
    ):
        with pytest.raises(ValueError, match=message):
            made(bowl(), **options)
