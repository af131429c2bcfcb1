"""Light between the parts of a scene: a bowl, whose light is known in closed form, blends of channels, and bad input.

Every point of a bowl that is half a sphere sees the bowl over half of its horizon, weighted by the cosine, and the sky
over the other half. Under a sky of radiance 1 the irradiance is pi / 2, and each bounce off albedo a is a / 2 of the
one before.
"""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt import bounces, harmonic, separable
from jaxprt.brdf import CookTorrance, Lambert
from jaxprt.brdf.varying import Channels
from jaxprt.relit import paths, reflection
from jaxprt.relit.channels import of_part
from jaxprt.scene import Environment, Mesh, TexturedMaterial, builtin
from jaxprt.scene.mesh import join, make_mesh
from jaxprt.systems.bounces import GroupBounces, ReflectingPart
from tests.systems.bounces.reflected import EYE, OPTIONS, SKY, bowl, of_regions, radiance

pytestmark = pytest.mark.usefixtures("coarse")

ALBEDO = 0.8
GLOSSY = CookTorrance(diffuse=0.3, specular=0.7, roughness=0.5, f0=0.5)
HALF = 2**-11  # relative rounding of the tensors, which are held in half precision
TERMS = 20
MISSED = 0.15  # of what two functions and 24 factors make of the harmonics of light


@functools.cache
def corner() -> Mesh:
    """Two squares that meet at a right angle, one region each."""
    floor = builtin.plane(cells=5)
    wall = make_mesh(np.asarray(floor.position)[:, [0, 2, 1]] * [1, -1, 1] + [0, 1, -1], floor.face)
    return join([floor, wall])


@jax.jit
def shown(system: GroupBounces, light: Environment, materials: list | None) -> jax.Array:
    return radiance(system, light, EYE, materials)


class Reflected(NamedTuple):
    """Reflected light of groups of one part each."""

    bounces: GroupBounces

    def radiance(self, light: Environment, materials: list | None = None) -> np.ndarray:
        return np.asarray(shown(self.bounces, light, materials))


def made(mesh: Mesh, brdfs: list) -> Reflected:
    """Light of one bounce between the regions of a mesh."""
    factored = [separable.factor(each, terms=TERMS, resolution=16) for each in brdfs]
    return Reflected(of_regions(mesh, brdfs, bounces.precompute(mesh, factored, bounces=1, **OPTIONS)))


@functools.cache
def white() -> Reflected:
    """Light between the white squares of the corner."""
    return made(corner(), [Lambert(1.0)] * 2)


def test_parts_of_one_group_send_what_they_send_in_groups_of_their_own(close):
    """In another order than that of the scene, and with padding."""
    mesh = join([corner(), make_mesh(np.asarray(corner().position) + 3, corner().face)])
    mesh = eqx.tree_at(lambda each: each.region, mesh, np.repeat([0, 1, 2], [36, 36, 72]).astype(np.int32))
    channels = Channels((Lambert(1.0), GLOSSY), jnp.ones(2))
    alone = made(mesh, [channels] * 3)
    weight = np.random.default_rng(0).uniform(0.1, 0.9, (144, 2, 3)).astype(np.float32)
    ends = np.split(weight, [36, 72])
    expected = alone.radiance(SKY, [prt.Blend(each) for each in ends])
    first = alone.bounces.group
    rows = [np.concatenate([np.asarray(getattr(first[n], name)) for n in (2, 0)]) for name in ("position", "frame")]
    rows = [np.pad(each, [(0, 20)] + [(0, 0)] * (each.ndim - 1), mode="edge") for each in rows]
    both = ReflectingPart(*map(jnp.asarray, rows), first[0].brdf), first[1]
    joined = Reflected(GroupBounces.make(alone.bounces.tensor, both, [np.r_[72:144, 0:36], np.r_[36:72]]))
    wide = np.pad(np.concatenate([ends[2], ends[0]]), ((0, 20), (0, 0), (0, 0)), mode="edge")
    found = joined.radiance(SKY, [prt.Blend(wide), prt.Blend(ends[1])])
    close(np.concatenate([found[72:108], found[128:], found[:72]]), expected, tolerance=1e-5)


def test_what_bounces_bring_is_estimated_as_the_closed_form_has_it():
    shading = of_part(prt.Part("bowl", bowl(), Lambert(ALBEDO)))
    found = reflection.fractions([shading], [SKY])
    once = ALBEDO / 2
    np.testing.assert_allclose(found[:, 0], [once, once**2, once**3], rtol=0.03)
    assert [reflection.needed(found, each) for each in (0.5, 0.2, 0.1, 0.01)] == [0, 1, 2, "all"]


class Outside(eqx.Module):
    """GGX by a name of its own."""

    alpha: jax.Array

    def __call__(self, wi, wo):
        return prt.brdf.GGX(0.9, self.alpha**0.5)(wi, wo)

    def widened(self, width):
        return Outside(jnp.maximum(self.alpha, width))


def test_brdfs_of_users_say_what_they_are_with_wider_lobes():
    one, other = (np.asarray(paths.widened(Outside(jnp.asarray(alpha))).alpha) for alpha in (0.01, 0.3))
    np.testing.assert_allclose([one, other], [0.09, 0.3])
    both = paths.widened(Channels((Outside(jnp.asarray(0.01)), Lambert(0.5)), jnp.ones(2)))
    np.testing.assert_allclose(both.model[0].alpha, 0.09)


def test_what_parts_send_to_others_follows_their_roughness():
    """Albedo of each channel and roughness, and what it makes of the harmonics of light.

    Narrow lobes too, which are narrower than the texels of the maps of light paths.
    """
    narrow = of_part(prt.Part("metal", corner(), TexturedMaterial(metallic=0.4, roughness=0.05)))
    path = paths.factor(narrow)
    assert path.sent is not None
    assert narrow.blend is not None
    each = prt.Blend(jnp.eye(4)[..., None], (jnp.full(4, np.log(0.05)),))
    albedo = np.asarray(path.sent.weights(each))[..., 0] @ np.asarray(bounces.functions.albedo(path.brdf))
    np.testing.assert_allclose(albedo, paths.channels(paths.still(narrow)), rtol=0.03, atol=1e-3)
    assert 0.97 < np.sum(albedo @ np.asarray(narrow.blend.weight[0, :, 0])) < 1.05
    metal = prt.Part("metal", corner(), TexturedMaterial(0.8, metallic=1.0, roughness=0.4))
    shading = of_part(metal)
    path = paths.factor(shading)
    sent = path.sent
    assert sent is not None
    view = jnp.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [0.0, 0.8, 0.6]])
    met = np.asarray(bounces.functions.project(path.brdf, degree=3)) @ np.asarray(path.brdf.view(view))
    for roughness in (0.35, 0.9):
        blend = prt.Blend(jnp.ones((4, 4, 1)), (jnp.full(4, np.log(roughness)),))
        weight = np.asarray(sent.weights(blend))[0, :, 0]
        true = paths.channels(shading.brdf(jnp.log(roughness)))
        np.testing.assert_allclose(weight @ np.asarray(bounces.functions.albedo(path.brdf)), true.sum(), rtol=0.01)
        exact = harmonic.table.project(shading.brdf(jnp.log(roughness)), view, degree=3, rings=48, sectors=96)
        exact = np.moveaxis(np.sum(np.asarray(exact), 1), 1, 0)
        assert np.linalg.norm(met @ weight - exact) < MISSED * np.linalg.norm(exact)

    def of_roughness(logarithm):
        return jnp.sum(sent.weights(prt.Blend(jnp.ones((2, 4, 1)), (logarithm,))) ** 2)

    value, (place, step) = jax.jit(jax.value_and_grad(of_roughness)), np.float32([np.log([0.35, 0.62]), [0.01, 0.0]])
    numeric = (value(place + step)[0] - value(place - step)[0]) / 0.02
    np.testing.assert_allclose(value(place)[1][0], numeric, rtol=2e-3)


def test_weighted_channels_reflect_as_the_brdf_that_they_add_up_to(close):
    mesh, weight = corner(), np.array([[0.9, 0.2, 0.1], [0.3, 0.5, 0.8]], np.float32)
    channels = Channels((Lambert(1.0), GLOSSY), jnp.ones(2))
    count = len(mesh.position) // 2
    blend = prt.Blend(jnp.broadcast_to(jnp.asarray(weight), (count, 2, 3)))
    color = made(mesh, [channels] * 2).radiance(SKY, [blend] * 2)
    for each in (0, 2):
        whole = CookTorrance(
            diffuse=weight[0, each] + 0.3 * weight[1, each], specular=0.7 * weight[1, each], roughness=0.5, f0=0.5
        )
        close(color[:, each], made(mesh, [whole] * 2).radiance(SKY)[:, 0], tolerance=0.01)


def test_what_a_part_sends_to_others_has_its_mean_color_without_patches():
    mesh = corner()
    bare = eqx.tree_at(lambda each: (each.tensor.patches, each.strength), white().bounces, (None, (None, None)))
    system = Reflected(bare)
    count = len(mesh.position) // 2
    plain = prt.Blend(jnp.ones((count, 1, 3)))
    half = jnp.asarray(np.where(np.arange(count)[:, None] % 2 == 0, [1, 0, 0], [0, 0, 1]), jnp.float32)
    color = system.radiance(SKY, [prt.Blend(half[:, None]), plain])
    plain = system.radiance(SKY, [plain, plain])
    area = np.asarray(bare.tensor.area)[:count]
    mean = area @ np.asarray(half) / area.sum()
    np.testing.assert_allclose(color[count:], plain[count:] * mean, rtol=HALF, atol=HALF * np.max(plain))


@pytest.mark.usefixtures("unchecked")
def test_what_does_not_fit_is_refused():
    mesh, count = corner(), len(corner().position) // 2
    system = white().bounces
    with pytest.raises(ValueError, match=r"BRDF must have degree 3, that of reflected light, got 2"):
        ReflectingPart(mesh.position, system.group[0].frame, harmonic.tabulate(Lambert(1.0), degree=2))
    with pytest.raises(ValueError, match="must have a BRDF for each of 1 regions, got 2"):
        GroupBounces.make(system.tensor, system.group[:1], [np.arange(count)])
    shorter = ReflectingPart(mesh.position[:3], system.group[0].frame[:3], system.group[0].brdf)
    with pytest.raises(ValueError, match=rf"must have the tensor's {count} vertices, got 3"):
        GroupBounces.make(system.tensor, (system.group[0], shorter), [np.arange(count), count + np.arange(count)])
    with pytest.raises(TypeError, match=r"must be of class Environment, .* got one of class int"):
        system.light(3)
    with pytest.raises(ValueError, match="must be one environment"):
        system.light(Environment(SKY.radiance[None]))
    with pytest.raises(ValueError, match="the light's faces, 9, got 2"):
        system.light(Environment(jnp.ones((6, 9, 9, 3))))
    with pytest.raises(ValueError, match=rf"must have weights \[{count} vertices, 1 channels, c\]"):
        system.shade(system.light(SKY), [prt.Blend(jnp.ones((count, 2, 3))), None])
