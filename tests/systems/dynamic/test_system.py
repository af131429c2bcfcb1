"""Radiance of the dynamic system against the exact sum over all texels, over the range of roughness."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt import bright_texels, dynamic, visibility
from jaxprt.brdf import MetallicRoughness
from jaxprt.scene import Environment, builtin
from jaxprt.scene.points import VERTICES, Points
from jaxprt.systems.lobe import widened
from jaxprt.systems.protocol import Blend
from jaxprt.systems.standard import METALLIC_ROUGHNESS

SIZE = 16
EYE = jnp.array([1.5, 2.0, 2.5])
ROUGHNESS = (0.3, 1.0, "varying")
# Relative L2 error against the sum over all texels, at each roughness. The lobe system errs by as much.
ERROR = {"with a tensor": 0.06, "with lobes alone": 0.06}


@pytest.fixture(scope="module")
def seen():
    """Visibility of a ball on a floor."""
    ball, floor = builtin.sphere(rings=10, sectors=16), builtin.plane(cells=6)
    position = jax.device_put(np.asarray(ball.position) + np.float32([0, 0.9, 0]))
    mesh = prt.scene.mesh.join([dataclasses.replace(ball, position=position), floor])
    return visibility.precompute(mesh, size=SIZE)


@pytest.fixture(scope="module")
def light():
    sky = np.random.default_rng(0).uniform(0.2, 0.6, (6, SIZE, SIZE, 3)).astype(np.float32)
    sky[2, 4:9, 5:10] += [4.0, 3.0, 2.0]
    return Environment(jnp.asarray(sky))


def materials(vertices, roughness):
    """A colored material, as a blend of the standard table's channels."""
    base = np.random.default_rng(1).uniform(0.2, 1, (vertices, 3)).astype(np.float32)
    model = MetallicRoughness(base_color=base, metallic=np.full(vertices, 0.4, np.float32))
    weight = np.asarray(model.coefficient()) / np.asarray(METALLIC_ROUGHNESS.scale, np.float32)[:, None]
    return Blend(jnp.asarray(weight), (jnp.asarray(np.log(np.broadcast_to(roughness, vertices)), jnp.float32),))


BRDFS = {
    "with a tensor": lambda: METALLIC_ROUGHNESS.tensor(),
    "with lobes alone": lambda: METALLIC_ROUGHNESS.tensor(12, None),
}


@pytest.fixture(scope="module", params=BRDFS)
def system(request, seen):
    brdf = BRDFS[request.param]()
    transport = dynamic.compress(seen, brdf, components=24, modes=128, keep=1024)
    return request.param, dynamic.DynamicSystem(transport, brdf)


def exact(seen, light, blend):
    """The sum over all texels, with the same visibility and the BRDF itself."""
    every = jnp.asarray(np.arange(6 * SIZE**2, dtype=np.int32))
    radiance = jnp.asarray(np.asarray(light.radiance).reshape(-1, 3))
    family = METALLIC_ROUGHNESS.family
    return np.asarray(bright_texels.radiance(seen, family, every, radiance, eye=EYE, samples=4, blend=blend))


def off(found, true):
    return float(np.linalg.norm(np.asarray(found) - true) / np.linalg.norm(true))


@pytest.mark.parametrize("roughness", ROUGHNESS)
def test_radiance_is_that_of_the_exact_sum(system, seen, light, roughness):
    name, dynamic_system = system
    if roughness == "varying":
        roughness = np.random.default_rng(2).uniform(0.3, 1, len(seen.position)).astype(np.float32)
    blend = materials(len(seen.position), roughness)
    assert off(prt.radiance(dynamic_system, light, eye=EYE, materials=blend), exact(seen, light, blend)) < ERROR[name]


def test_bright_texels_take_the_sun_over(seen, light, system):
    name, dynamic_system = system
    sky = np.array(light.radiance)
    sky[4, 3, 3] = 2000.0
    sun = Environment(jnp.asarray(sky))
    blend = materials(len(seen.position), 0.5)
    whole = bright_texels.BrightTexels(dynamic_system, seen, METALLIC_ROUGHNESS.family, count=8, samples=4)
    assert off(prt.radiance(whole, sun, eye=EYE, materials=blend), exact(seen, sun, blend)) < ERROR[name] / 2


def test_points_with_a_tilted_normal_reflect_around_it(seen, system):
    """Under a light from everywhere a tilt changes little; mirrored views follow the tilted normal."""
    _, dynamic_system = system
    count = len(seen.position)
    blend = materials(count, 0.5)
    sky = Environment(jnp.ones((6, SIZE, SIZE, 3)))
    corner = np.stack([np.arange(count)] * 3).astype(np.int32)
    weight = np.zeros((3, count), np.float32)
    weight[0] = 1
    points = Points(jnp.asarray(corner), jnp.asarray(weight))
    normal = np.asarray(seen.frame)[:, 2]
    straight = points.tilted(normal)
    lit = dynamic_system.shade(dynamic_system.light(sky))
    tilted = dynamic_system.tilted(lit, jnp.asarray(normal))
    found = dynamic_system.combine(tilted, dynamic_system.view(EYE, blend, straight), straight)
    np.testing.assert_allclose(
        found, dynamic_system.combine(lit, dynamic_system.view(EYE, blend)), rtol=2e-3, atol=2e-3
    )


def test_rays_read_its_lobes_widened_and_its_terms_as_they_are(seen, light, system):
    _, dynamic_system = system
    blend, options = materials(len(seen.position), 0.1), {"brdf": METALLIC_ROUGHNESS.family, "count": 8}
    whole, lobes = (
        bright_texels.BrightTexels(of, dynamic_system.transport.pyramid, **options)
        for of in (dynamic_system, dynamic_system.lobe_part)
    )
    radiance = np.zeros((6, SIZE, SIZE, 3), np.float32)
    radiance[2, 8, 8] = 100
    sun = Environment(jax.device_put(radiance))

    def read(of, environment, variance):
        lit = of.shade(of.light(environment))
        view = widened.view(of, EYE, blend, VERTICES, jnp.full(len(seen.position), variance))
        return np.asarray(widened.combine(of, lit, view, VERTICES))

    assert widened.can_widen(whole)
    plain = prt.radiance(dynamic_system, light, eye=EYE, materials=blend)
    np.testing.assert_allclose(read(dynamic_system, light, 0.0), plain, rtol=1e-4, atol=1e-4)
    wide = read(whole, sun, 0.3)
    assert off(wide, read(lobes, sun, 0.3)) < 0.1
    assert off(wide, read(whole, sun, 0.0)) > 0.3


def test_transport_of_another_brdf_is_refused(system):
    name, dynamic_system = system
    if name == "with lobes alone":
        pytest.skip("has no light factors")
    transport, brdf = dynamic_system.transport, dynamic_system.brdf
    turned = eqx.tree_at(lambda table: table.light_map, brdf, jnp.asarray(np.asarray(brdf.light_map)[::-1]))
    with pytest.raises(ValueError, match="light factors differ"):
        dynamic.DynamicSystem(transport, turned)
    with pytest.raises(ValueError, match=r"must have the transport's \d+ light factors, got 0"):
        dynamic.DynamicSystem(transport, dynamic.table.without_tensor(METALLIC_ROUGHNESS.lobes()))
