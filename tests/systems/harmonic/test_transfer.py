"""Transfer matrices and vectors: closed forms with visibility made by hand, and what precomputation stores."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt.scene import builtin
from jaxprt.scene.mesh import join, make_mesh
from jaxprt.sphere import cubemap, directions, harmonics, rotation
from jaxprt.systems.harmonic import precompute, precompute_diffuse
from jaxprt.systems.harmonic.transfer import from_visibility, to_visibility, transfer, transfer_diffuse

SIZE = 8
UP = directions.frame(jnp.array([[0.0, 1, 0]]), jnp.array([[1.0, 0, 0]]))
# A float32 projection to degree 8 and a quadrature of hundreds of nodes.
EXACT = 2e-5
# Texels that the horizon cuts are counted by sixteenths, and rays through them fall on either side.
HORIZON = 0.01


@pytest.fixture
def random():
    return np.random.default_rng(7)


def frames(random, count):
    normal = directions.normalize(jnp.asarray(random.normal(size=(count, 3)), jnp.float32))
    return directions.frame(normal, jnp.asarray(random.normal(size=(count, 3)), jnp.float32))


def visible(random, count):
    return jnp.asarray(random.integers(17, size=(count, 6 * SIZE**2)), jnp.uint8)


def open_matrices(frame, degree):
    return jax.vmap(lambda axes: rotation.matrix(axes, degree=degree))(frame)


def scene():
    """A sphere of unit radius that touches a ground."""
    ground = make_mesh(
        np.array([[-3, -1, -3], [-3, -1, 3], [3, -1, 3], [3, -1, -3.0]]), np.array([[0, 1, 2], [0, 2, 3]])
    )
    return join([builtin.sphere(rings=5, sectors=8), ground])


def grid(function, *, above):
    """Integral of function(wi) [d, ...] over a quarter of the sphere, x < 0 and y of the given sign, in float64."""
    node, weight = np.polynomial.legendre.leggauss(60)
    height, angle = (node + 1) / 2, np.pi / 2 + np.pi * (node + 1) / 2
    height, angle = (each.ravel() for each in np.meshgrid(height, angle, indexing="ij"))
    radius = np.sqrt(1 - height**2)
    wi = np.stack([radius * np.cos(angle), height if above else -height, radius * np.sin(angle)], -1)
    return np.tensordot(np.outer(weight / 2, weight * np.pi / 2).ravel(), function(wi), 1)


@pytest.mark.parametrize("degree", [1, 4])
def test_open_vertices_have_the_rotation_to_their_frame(random, close, degree):
    frame = frames(random, 4)
    expected = open_matrices(frame, degree)
    close(transfer(jnp.full((4, 384), 16, jnp.uint8), frame, degree=degree), expected, tolerance=EXACT)
    above = directions.to_local(frame, cubemap.vector_area(size=SIZE).reshape(-1, 3))[..., 2] > 0
    close(transfer(jnp.where(above, 16, 0).astype(jnp.uint8), frame, degree=degree), expected, tolerance=EXACT)


def test_blocked_vertices_have_no_transfer_and_dimmed_ones_their_share(random, close):
    frame = frames(random, 3)
    whole, half, none = (transfer(jnp.full((3, 384), level, jnp.uint8), frame, degree=4) for level in (16, 8, 0))
    np.testing.assert_array_equal(none, 0)
    close(half * 2, whole)
    np.testing.assert_array_equal(transfer_diffuse(jnp.zeros((3, 384), jnp.uint8), frame, degree=4), 0)


def test_half_blocked_planes_have_the_integral_of_two_harmonics_over_the_open_quarter(close):
    seen = jnp.where(cubemap.direction(size=SIZE).reshape(1, -1, 3)[..., 0] < 0, 16, 0).astype(jnp.uint8)

    def product(wi):
        wi = jnp.asarray(wi)
        local = directions.to_local(UP.astype(wi.dtype), wi)[0]
        here, there = (np.asarray(harmonics.evaluate(each, degree=4)) for each in (local, wi))
        return here[:, :, None] * there[:, None]

    with jax.enable_x64(True):
        # Below the horizon half of the light counts as seen, on either side.
        quarter = grid(product, above=True)
        below = 0.5 * (grid(product, above=False) + grid(lambda wi: product(wi * [-1, 1, 1]), above=False))
    close(transfer(seen, UP, degree=4)[0], quarter + below, tolerance=EXACT)


def test_half_blocked_planes_have_diffuse_transfer_in_closed_form():
    seen = jnp.where(cubemap.direction(size=SIZE).reshape(1, -1, 3)[..., 0] < 0, 16, 0).astype(jnp.uint8)
    vector = transfer_diffuse(seen, UP, degree=1)[:, 0]
    band = np.sqrt(3 / (4 * np.pi))
    expected = [np.sqrt(1 / (4 * np.pi)) / 2, band / 3, 0, -band * 2 / (3 * np.pi)]
    # The cosine counts as its mean over each texel: of second order in its edge.
    np.testing.assert_allclose(vector, expected, atol=2e-3)
    fine = jnp.where(cubemap.direction(size=64).reshape(1, -1, 3)[..., 0] < 0, 16, 0).astype(jnp.uint8)
    np.testing.assert_allclose(transfer_diffuse(fine, UP, degree=1)[:, 0], expected, atol=2e-5)


def test_open_diffuse_vertices_have_the_cosine_kernel_in_closed_form(random, close):
    frame = frames(random, 5)
    vector = transfer_diffuse(jnp.full((5, 6 * 32**2), 16, jnp.uint8), frame, degree=4)
    expected = harmonics.convolve(harmonics.evaluate(frame[:, 2], degree=4).T, harmonics.cosine(degree=4) / jnp.pi)
    close(vector, expected, tolerance=1e-3)


def test_any_visibility_gives_the_sum_over_fine_texels(random, close):
    seen, frame, fine = visible(random, 2), frames(random, 2), 16
    flux = np.maximum(directions.to_local(frame, cubemap.vector_area(size=SIZE).reshape(-1, 3))[..., 2], 0)
    fraction = np.asarray(seen) / 16
    fraction = np.where(flux > 0, fraction, np.sum(fraction * flux, 1, keepdims=True) / np.sum(flux, 1, keepdims=True))
    fraction = fraction.reshape(-1, 6, SIZE, 1, SIZE, 1) * np.ones((fine, 1, fine))
    wi = cubemap.direction(size=SIZE * fine).reshape(-1, 3)
    weight = fraction.reshape(2, -1) * np.asarray(cubemap.solid_angle(size=SIZE * fine)).reshape(-1)
    world = np.asarray(harmonics.evaluate(wi, degree=3), float)
    local = np.asarray(harmonics.evaluate(directions.to_local(frame, wi), degree=3), float)
    expected = np.einsum("bd,bdo,di->boi", weight, local, world, optimize=True)
    close(transfer(seen, frame, degree=3), expected, tolerance=1e-4)


@pytest.mark.parametrize("degree", [1, 4])
def test_matrices_hold_the_harmonics_of_the_visibility_and_no_more(random, close, degree):
    frame = frames(random, 3)
    coefficient = jnp.asarray(random.normal(size=((2 * degree + 1) ** 2, 3)), jnp.float32)
    matrix = from_visibility(coefficient, frame, degree=degree)
    close(to_visibility(matrix, frame), coefficient, tolerance=EXACT)
    traced = transfer(visible(random, 3), frame, degree=degree)
    close(from_visibility(to_visibility(traced, frame), frame, degree=degree), traced, tolerance=EXACT)


def test_precomputed_open_vertices_have_the_rotation_to_their_frame(close):
    mesh = builtin.sphere(rings=5, sectors=8)
    transport = precompute(mesh, degree=3, size=16)
    close(transport.frame, directions.frame(mesh.normal, mesh.tangent))
    close(transport.matrix[:, 0], open_matrices(transport.frame, 3), tolerance=HORIZON)
    assert transport.nbytes == len(mesh.position) * 16**2 * 4


@pytest.mark.parametrize("made", [precompute, precompute_diffuse])
@pytest.mark.parametrize("options", [{"degree": -1}, {"degree": 26}, {"size": 0}, {"size": 12}])
def test_degrees_and_sizes_out_of_range_are_refused(made, options):
    with pytest.raises(ValueError, match="degree must be 0 to 25 and size a power of two, got"):
        made(builtin.plane(cells=1), **options)


@pytest.mark.parametrize("count", [0, 5, 24 + 6, 6 * 9])
def test_numbers_of_texels_that_make_no_cubemap_are_refused(count):
    for made in (transfer, transfer_diffuse):
        with pytest.raises(ValueError, match="power of two"):
            made(jnp.zeros((1, count), jnp.uint8), UP, degree=1)
