"""Radiance of light that has been reflected: what BRDFs make of what arrives, and all of it in a white world."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from benchmarks.published.interreflection import interreflect_diffuse
from jaxprt import bounces, dynamic, harmonic, lobe, separable
from jaxprt.brdf import CookTorrance, Lambert
from jaxprt.scene import Environment, builtin
from jaxprt.scene.mesh import ground_plane, join
from jaxprt.sphere import harmonics, hemisphere
from jaxprt.systems.dynamic import Material

pytestmark = pytest.mark.usefixtures("few_samples")
SIZE = 8
EYE = jnp.array([1.0, 2.5, 3.0])
MEMBERS = [CookTorrance(diffuse=0.0, specular=1.0, roughness=m, f0=0.3) for m in (0.3, 0.5)]


@pytest.fixture(scope="module")
def mesh():
    ball = builtin.sphere(rings=8, sectors=10)
    return join([ball, ground_plane(ball, vertices=64)])


@pytest.fixture(scope="module")
def brdfs():
    """A set with lobes, and one BRDF for good."""
    glossy = dynamic.factor(
        MEMBERS, dynamic.separate(MEMBERS, separator=lambda each: lobe.tabulate(each, lobes=2, resolution=16))
    )
    return [glossy, separable.factor(Lambert([0.6, 0.4, 0.2]), terms=1, resolution=4)]


@pytest.fixture(scope="module")
def transport(mesh, brdfs):
    return dynamic.precompute_sets(mesh, brdfs, size=SIZE, progress=False)


@pytest.fixture(scope="module")
def tensor(mesh, brdfs):
    along = bounces.factor(MEMBERS, functions=2, terms=8, resolution=12)
    options = {"components": 10**6, "modes": 10**6, "edge": 4, "size": 8}
    return bounces.precompute(mesh, [along, brdfs[1]], **options)


def material(diffuse=0.4, specular=0.6):
    return Material(*(jnp.asarray(each, jnp.float32) for each in ([0.3, 0.7], diffuse, specular)))


def light(seed=0):
    value = np.random.default_rng(seed).uniform(size=(6, SIZE, SIZE, 3))
    return Environment(jnp.asarray(value, jnp.float32))


def relative(value, exact):
    return float(np.linalg.norm(value - exact) / np.linalg.norm(exact))


def towards_eye(region):
    """Directions from the rows of a region to the eye, in their frames."""
    way = np.einsum("qij,qj->qi", region.seen.frame, np.asarray(EYE) - np.asarray(region.seen.position))
    return (way / np.linalg.norm(way, axis=1, keepdims=True)).astype(np.float32)


def test_what_lobes_send_of_harmonics_is_their_integral(transport, brdfs, tensor):
    """Free lobes of a mixed material over their whole sphere, the diffuse part over the hemisphere."""
    surfaces = dynamic.mix(transport, brdfs, [material(0.4, [0.6, 0.5, 0.3]), None])
    seen = bounces.view_side(transport, surfaces, eye=EYE)[0]
    own = transport.region[0]
    random = np.random.default_rng(1).normal(size=(16, 3)).astype(np.float32)
    coefficient, specular, diffuse = (np.asarray(each) for each in (seen.coefficient, seen.specular, seen.diffuse))
    found = np.sum(random[..., None] * coefficient, 0) * specular + 0.7 * diffuse
    table = surfaces[0].brdf.lobe
    wo = towards_eye(own)
    facing = np.flatnonzero(wo[:, 2] > 0.2)[::9]
    nodes, area = map(np.asarray, hemisphere.arcs(jnp.array([0.0, 0.0, 1.0]), rings=96, sectors=192))
    both = np.concatenate([nodes, nodes * np.array([1.0, 1.0, -1.0], np.float32)])
    radiance = np.asarray(harmonics.evaluate(jnp.asarray(both), degree=3)) @ random
    look = jax.jit(lambda wo: table.lookup(wo))
    for row in facing:
        lobes = jax.tree.map(np.asarray, look(wo[row][None]))
        means = lobes.mean[..., 0].T
        density = [
            mass * k / (2 * np.pi * -np.expm1(-2 * k)) * np.exp(k * (both @ mean - 1))
            for mass, k, mean in zip(lobes.weight[0, :, 0], lobes.concentration[:, 0], means, strict=True)
        ]
        glossy = (np.sum(density, 0) * np.tile(area, 2)) @ radiance
        exact = (glossy + 0.7 * lobes.diffuse[0, 0]) * np.array([0.6, 0.5, 0.3]) + 0.4 * 0.7
        np.testing.assert_allclose(found[:, row], exact, rtol=2e-4, atol=2e-5)


def test_what_a_factored_brdf_sends_of_harmonics_is_its_integral(mesh):
    glossy = separable.factor(CookTorrance(diffuse=0.3, specular=0.5, roughness=0.5, f0=0.3), terms=6, resolution=16)
    transport = dynamic.precompute_sets(mesh, [glossy, glossy], size=8, progress=False)
    seen = bounces.view_side(transport, dynamic.mix(transport, [glossy, glossy], [None, None]), eye=EYE)[0]
    own = transport.region[0]
    wo, coefficient, value = towards_eye(own), np.asarray(seen.coefficient), jax.jit(lambda wi, wo: glossy(wi, wo))
    nodes, area = hemisphere.arcs(jnp.array([0.0, 0.0, 1.0]), rings=96, sectors=192)
    basis = np.asarray(harmonics.evaluate(nodes, degree=3)) * (np.asarray(nodes)[:, 2] * np.asarray(area))[:, None]
    for row in np.flatnonzero(wo[:, 2] > 0.1)[::9]:
        exact = basis.T @ np.asarray(value(nodes, np.broadcast_to(wo[row], nodes.shape)))
        assert relative(coefficient[:, :, row], exact) < 3e-3  # The quadrature of bilinear maps.


def test_a_white_world_is_that_of_the_harmonic_system_and_nearly_invisible(mesh):
    """White surfaces under constant light: what two bounces leave of radiance one is little."""
    white = separable.factor(Lambert(1.0), terms=1, resolution=4)
    transport = dynamic.precompute_sets(mesh, [white, white], size=SIZE, progress=False)
    tensor = bounces.precompute(mesh, [white, white], edge=4, components=136, modes=96, size=8)
    ones = Environment(jnp.ones((6, SIZE, SIZE, 1)))
    eye = jnp.array([0.0, 50.0, 0.0])
    facing = np.asarray(mesh.normal)[:, 1] > 0.1
    arguments = ([white, white], [None, None], ones)
    first = np.asarray(dynamic.radiance(transport, *arguments, eye=eye, texels=0))[facing, 0]
    both = np.asarray(bounces.radiance(transport, tensor, *arguments, eye=eye, texels=0))[facing, 0]
    plain = harmonic.precompute_diffuse(mesh, degree=0, size=SIZE)
    albedo = np.ones((2, 1), np.float32)
    exact = interreflect_diffuse(mesh, plain, albedo, bounces=2, size=SIZE)
    exact = np.asarray(exact.vector)[0, 0, facing] * np.sqrt(4 * np.pi)
    without, left = 1 - first, 1 - both
    assert without.max() > 0.4
    assert relative(both, exact) < 0.004
    assert left.min() > -0.02  # Harmonics of the first bounce ring.
    assert np.mean(left) < 0.4 * np.mean(without)


def test_stages_make_the_radiance(transport, tensor, brdfs):
    now, lamp = [material(), None], light()
    view = dynamic.view_side(transport, brdfs, now, eye=EYE)
    lit = bounces.light_side(tensor, lamp)
    arrived = bounces.arriving(transport, tensor, lit, now)
    color = dynamic.combine(transport, dynamic.light_side(transport, lamp), view)
    color = color + bounces.combine(
        transport, arrived, bounces.view_side(transport, dynamic.mix(transport, brdfs, now), eye=EYE)
    )
    whole = bounces.radiance(transport, tensor, brdfs, now, lamp, eye=EYE)
    np.testing.assert_allclose(color, whole, rtol=1e-6, atol=1e-7)


def test_reflected_light_has_the_color_of_what_it_met(transport, tensor, brdfs):
    """A red ball reddens the ground beside it, and does not redden what is direct."""
    gray = Environment(jnp.ones((6, SIZE, SIZE, 1)))
    red, blue = (material(each, 0.0) for each in ([0.9, 0.1, 0.1], [0.1, 0.1, 0.9]))
    near = np.argmin(np.linalg.norm(np.asarray(transport.region[1].seen.position) - [0, -1, 1.1], axis=1))
    vertex = int(transport.region[1].vertex[near])
    color = [
        np.asarray(bounces.radiance(transport, tensor, brdfs, [each, None], gray, eye=EYE))[vertex] / [0.6, 0.4, 0.2]
        for each in (red, blue)
    ]
    plain = np.asarray(dynamic.radiance(transport, brdfs, [red, None], gray, eye=EYE))[vertex] / [0.6, 0.4, 0.2]
    np.testing.assert_allclose(plain, plain[0], rtol=1e-3)
    assert color[0][0] > 1.1 * color[0][2]
    assert color[1][2] > 1.1 * color[1][0]
    np.testing.assert_allclose(color[0][1], color[1][1], rtol=0.05)  # They differ by the other colors' rounding alone.


def test_without_patches_a_texture_sends_its_mean_over_the_surface_to_others(transport, tensor, mesh):
    """Bright poles, where the ball has many vertices and little surface; the mean is that of trimesh's triangles."""
    texture = np.asarray(mesh.position[:, 1:2] ** 2)
    face = np.asarray(mesh.face)[np.asarray(mesh.region)[mesh.face[:, 0]] == 0]
    area = trimesh.Trimesh(np.asarray(mesh.position), face, process=False).area_faces
    mean = np.atleast_1d(area @ texture[face].mean((1, 2)) / area.sum()).astype(np.float32)
    assert texture[np.asarray(mesh.region) == 0].mean() > 1.1 * mean
    tensor = eqx.tree_at(lambda each: each.patches, tensor, None)
    lit = bounces.light_side(tensor, light())
    found, plain = (
        bounces.arriving(transport, tensor, lit, [material(each), None])[1].local for each in (texture, mean)
    )
    np.testing.assert_allclose(found, plain, rtol=1e-5, atol=1e-6)


def test_reflected_radiance_by_light_and_material_is_finite_differences(transport, tensor, brdfs):
    """What the view and the direct light add is differentiated in `test_dynamic` and, with this, in `test_contract`."""
    lamp, direction = light(), light(1).radiance - 0.5
    view = bounces.view_side(transport, dynamic.mix(transport, brdfs, [material(), None]), eye=EYE)

    def mean(step, color, weight):
        now, lights = [Material(weight, color, 0.6), None], Environment(lamp.radiance + step * direction)
        arrived = bounces.arriving(transport, tensor, bounces.light_side(tensor, lights), now)
        return jnp.mean(bounces.combine(transport, arrived, view))

    at = (jnp.array(0.0), jnp.array([0.4, 0.3, 0.2]), jnp.array([0.3, 0.7]))
    both = jax.jit(jax.value_and_grad(mean, (0, 1, 2)))
    slope = both(*at)[1]
    for number, step in ((0, jnp.array(0.05)), (1, jnp.array([0.02, 0.0, 0.01]))):
        moved = [tuple(x + sign * step if i == number else x for i, x in enumerate(at)) for sign in (1, -1)]
        change = (both(*moved[0])[0] - both(*moved[1])[0]) / 2
        np.testing.assert_allclose(jnp.vdot(slope[number], step), change, rtol=5e-3)
    assert np.isfinite(slope[2]).all()


def test_what_does_not_fit_is_refused(transport, tensor, brdfs, unchecked):
    now, lamp = [material(), None], light()
    with pytest.raises(ValueError, match="a material for each of 2 regions, got 1"):
        bounces.relight.weights(tensor, now[:1])
    with pytest.raises(ValueError, match="region 0 needs a material"):
        bounces.relight.weights(tensor, [None, None])
    with pytest.raises(ValueError, match="region 1 has a BRDF that cannot change"):
        bounces.relight.weights(tensor, [material(), material()])
    with pytest.raises(ValueError, match=r"one for each of its 2 BRDFs, got \[3\]"):
        bounces.relight.weights(tensor, [Material(jnp.array([0.2, 0.3, 0.5]), 0.4, 0.6), None])
    with pytest.raises(TypeError, match=r"must be of class Environment, .* got one of class int"):
        bounces.light_side(tensor, 3)
    with pytest.raises(ValueError, match=r"diffuse of region 0 must be gray .* each of 136 vertices"):
        bounces.relight.weights(tensor, [material(np.ones((135, 1))), None])
    with pytest.raises(ValueError, match="weights of region 0 must sum to 1"):
        bounces.relight.weights(tensor, [Material(jnp.array([3.0, 3.0]), 0.4, 0.6), None])
    with pytest.raises(ValueError, match="must be one environment"):
        bounces.light_side(tensor, Environment(lamp.radiance[None]))
    with pytest.raises(ValueError, match="the light's faces, 18, got 4"):
        bounces.light_side(tensor, Environment(jnp.ones((6, 18, 18, 3))))
    other = eqx.tree_at(lambda x: x.place, tensor, tensor.place[:-1])
    with pytest.raises(ValueError, match="have the transport's 136 vertices, got 135"):
        bounces.arriving(transport, other, bounces.light_side(tensor, lamp), now)
    moved = dynamic.SetTransport(transport.region, transport.place, "another mesh")
    with pytest.raises(ValueError, match="for the transport's mesh and regions, got one for others"):
        bounces.arriving(moved, tensor, bounces.light_side(tensor, lamp), now)
