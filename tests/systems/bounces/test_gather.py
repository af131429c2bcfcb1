"""Light that has been reflected: against loops over rays, and in a furnace."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt import bounces, separable, visibility
from jaxprt.brdf import AshikhminShirley, Lambert
from jaxprt.scene import builtin
from jaxprt.scene.mesh import ground_plane, join, make_mesh
from jaxprt.sphere import cubemap, directions, harmonics

SIZE = 16
EDGE = 4


@pytest.fixture(scope="module")
def mesh():
    """A ball over the ground, two regions that light each other."""
    ball = builtin.sphere(rings=8, sectors=10)
    return join([ball, ground_plane(ball, vertices=64)])


@pytest.fixture(scope="module")
def frame(mesh):
    return directions.frame(mesh.normal, mesh.tangent)


@pytest.fixture(scope="module")
def seen(mesh):
    visible = visibility.precompute(mesh, size=SIZE)
    return jnp.asarray(visible.seen(np.arange(len(mesh.position))))


@pytest.fixture(scope="module")
def met(mesh, frame):
    """Rays of all vertices."""
    occluder = visibility.Occluder(mesh)
    start = visibility.start_points(mesh, occluder)
    region = np.asarray(mesh.region)
    return bounces.gather.rays(occluder, start, np.asarray(mesh.normal), np.asarray(frame), region, size=SIZE)


def arrived(response, frame, basis, rays, measure):
    """What arrives by some measure of all texels, [d s] of all points or [v d s] of each."""
    way = np.asarray(cubemap.direction(size=SIZE)).reshape(-1, 3)[rays.texel]
    each = measure[rays.texel] if measure.ndim == 2 else measure[rays.owner[:, None], rays.texel]
    fixed = (rays.owner, rays.corner, rays.weight, way, each)
    none = np.zeros((len(frame), each.shape[-1], basis.view_map.shape[-1], response.shape[1]), np.float32)
    return np.asarray(bounces.gather.arrive(none, jnp.asarray(np.swapaxes(response, 1, 2)), frame, basis, *fixed))


def flux(mesh):
    """Cosine times solid angle over pi."""
    area = np.asarray(cubemap.vector_area(size=SIZE)).reshape(-1, 3)
    return np.maximum(np.asarray(mesh.normal) @ area.T, 0)[..., None] / np.pi


def shining(degree):
    """Harmonics times solid angle."""
    area = np.asarray(cubemap.solid_angle(size=SIZE)).reshape(-1, 1)
    return np.asarray(harmonics.evaluate(cubemap.direction(size=SIZE).reshape(-1, 3), degree=degree)) * area


def relative(value, exact):
    return float(np.linalg.norm(value - exact) / np.linalg.norm(exact))


def test_what_arrives_is_a_loop_over_rays(mesh, seen, frame, met):
    """Of a glossy BRDF in three colors, one of which is a multiple of another."""
    glossy = separable.factor(
        AshikhminShirley(diffuse=[0.5, 0.2, 0.4], specular=0.3, nu=5, nv=9), terms=6, resolution=12
    )
    basis, weight = bounces.functions.basis(glossy), bounces.functions.fixed_weights(glossy)
    response = bounces.gather.respond(seen, frame, basis, edge=EDGE)
    rays, basis_2 = met[1], shining(2)
    hit = rays.weight.sum(-1) > 0
    count = np.bincount(rays.owner, hit.sum(1))
    vertex = int(np.argmin(np.where(count < 16, np.inf, count)))  # The fewest rays, but some.
    colored = np.einsum("spl,pc->slc", arrived(response, frame, basis, rays, basis_2)[vertex], weight)
    light, axis = (np.asarray(each) for each in (cubemap.direction(size=SIZE).reshape(-1, 3), frame))
    value = jax.jit(lambda axes, wo: glossy(directions.to_local(axes, light), jnp.broadcast_to(wo, light.shape)))
    area = np.asarray(cubemap.vector_area(size=SIZE)).reshape(-1, 3)
    exact = np.zeros_like(colored)
    for group, ray in zip(*np.nonzero((rays.owner == vertex)[:, None] & hit), strict=True):
        texel = rays.texel[group, ray]
        for place, part in zip(rays.corner[group, ray], rays.weight[group, ray], strict=True):
            axes = axis[place]
            met_by = np.maximum(area @ axes[2], 0) * np.asarray(seen)[place] / 16
            wo = axes @ -light[texel]
            wo[2] = max(wo[2], 1e-3)
            sent = np.asarray(value(axes, wo / np.linalg.norm(wo))) * met_by[:, None]
            sent = sent.reshape(6, EDGE, 4, EDGE, 4, 3).sum((2, 4)).reshape(-1, 3)
            exact += part * basis_2[texel][:, None, None] * sent
    assert relative(colored, exact) < 1e-5


def test_in_a_closed_furnace_light_falls_as_the_geometric_series():
    """A hollow sphere, seen from inside: after n bounces of albedo .7 light is .7^n of what shone at first."""
    ball = builtin.sphere(rings=16, sectors=24)
    hollow = make_mesh(ball.position, np.asarray(ball.face)[:, ::-1], normal=-np.asarray(ball.normal))
    axes = directions.frame(hollow.normal, hollow.tangent)
    occluder = visibility.Occluder(hollow)
    start, inside = visibility.start_points(hollow, occluder), np.zeros(len(axes), int)
    (rays,) = bounces.gather.rays(
        occluder, start, np.asarray(hollow.normal), np.asarray(axes), inside, size=SIZE
    ).values()
    grey = separable.factor(Lambert(0.7), terms=1, resolution=8)
    basis, weight = bounces.functions.basis(grey), float(bounces.functions.fixed_weights(grey)[0, 0])
    arriving = np.zeros((16, 1, len(axes)), np.float32)
    arriving[0] = np.sqrt(4 * np.pi)
    for number in (1, 2):
        response = bounces.gather.respond_again(jnp.asarray(arriving), axes, basis)
        irradiance = weight * arrived(response, axes, basis, rays, flux(hollow))[:, 0, 0, 0]
        np.testing.assert_allclose(irradiance, 0.7**number, rtol=3e-3)
        arriving = weight * arrived(response, axes, basis, rays, shining(3)).transpose(1, 2, 3, 0)[:, 0]


def test_triangles_between_regions_send_what_each_corner_does(mesh, seen, frame, met):
    """Every third vertex of another region of the same material: together they send what they did."""
    white = bounces.functions.basis(separable.factor(Lambert(1.0), terms=1, resolution=8))
    response = bounces.gather.respond(seen, frame, white, edge=EDGE)
    whole = sum(arrived(response, frame, white, met[r], flux(mesh)) for r in (0, 1))
    occluder = visibility.Occluder(mesh)
    start, mixed = visibility.start_points(mesh, occluder), np.arange(len(mesh.position)) % 3
    found = bounces.gather.rays(occluder, start, np.asarray(mesh.normal), np.asarray(frame), mixed, size=SIZE)
    parts = [arrived(response, frame, white, found[r], flux(mesh)) for r in (0, 1, 2)]
    assert min(np.abs(part).max() for part in parts) > 0.01
    np.testing.assert_allclose(sum(parts), whole, rtol=1e-5, atol=1e-7)
