"""Transfer matrices and vectors: closed forms with visibility made by hand, and what precomputation stores."""

import itertools
from functools import partial

import jax
import numpy as np
import pytest

from jaxprt.scene import builtin
from jaxprt.sphere import cubemap, directions, harmonics, rotation
from jaxprt.systems.harmonic import precompute, precompute_diffuse
from jaxprt.systems.harmonic.transfer import from_visibility, to_visibility, transfer, transfer_diffuse

SIZE = 8
UP = directions.frame(np.float32([[0, 1, 0]]), np.float32([[1, 0, 0]]))
# A float32 projection to degree 8 and a quadrature of hundreds of nodes.
EXACT = 2e-5
# Texels that the horizon cuts are counted by sixteenths, and rays through them fall on either side.
HORIZON = 0.01


@pytest.fixture
def random():
    return np.random.default_rng(7)


def frames(random, count):
    normal = directions.normalize(random.normal(size=(count, 3)).astype(np.float32))
    return directions.frame(normal, random.normal(size=(count, 3)).astype(np.float32))


def visible(random, count):
    return random.integers(17, size=(count, 6 * SIZE**2)).astype(np.uint8)


@partial(jax.jit, static_argnames="degree")
def open_matrices(frame, degree):
    return jax.vmap(lambda axes: rotation.matrix(axes, degree=degree))(frame)


def grid(function, *, above):
    """Integral of function(wi) [d, ...] over a quarter of the sphere, x < 0 and y of the given sign, in float64."""
    node, weight = np.polynomial.legendre.leggauss(60)
    height, angle = (node + 1) / 2, np.pi / 2 + np.pi * (node + 1) / 2
    height, angle = (each.ravel() for each in np.meshgrid(height, angle, indexing="ij"))
    radius = np.sqrt(1 - height**2)
    wi = np.stack([radius * np.cos(angle), height if above else -height, radius * np.sin(angle)], -1)
    return np.tensordot(np.outer(weight / 2, weight * np.pi / 2).ravel(), function(wi), 1)


def above(frame):
    """What is above the horizon of some vertices."""
    area = np.asarray(cubemap.vector_area(size=SIZE)).reshape(-1, 3)
    return np.where(np.asarray(frame)[:, 2] @ area.T > 0, 16, 0).astype(np.uint8)


def test_open_vertices_have_the_rotation_to_their_frame_dimmed_ones_their_share_and_blocked_ones_none(random, close):
    frame = frames(random, 4)
    expected = np.asarray(open_matrices(frame, 4))
    levels = *(np.full((4, 384), level, np.uint8) for level in (16, 8, 0)), above(frame)
    whole, half, none, upper = (transfer(seen, frame, degree=4) for seen in levels)
    close(whole, expected, tolerance=EXACT)
    close(upper, expected, tolerance=EXACT)
    close(2 * np.asarray(half), whole)
    np.testing.assert_array_equal(none, 0)
    np.testing.assert_array_equal(transfer_diffuse(levels[2], frame, degree=4), 0)


def left_half(size):
    """Visibility of what is at x < 0."""
    return np.where(np.asarray(cubemap.direction(size=size)).reshape(1, -1, 3)[..., 0] < 0, 16, 0).astype(np.uint8)


def test_half_blocked_planes_have_the_integral_of_two_harmonics_over_the_open_quarter(close):

    def product(wi):
        here, there = (harmonics.basis(np, way, 4).T for way in (wi @ np.asarray(UP[0], float).T, wi))
        return here[:, :, None] * there[:, None]

    # Below the horizon half of the light counts as seen, on either side.
    quarter = grid(product, above=True)
    below = 0.5 * (grid(product, above=False) + grid(lambda wi: product(wi * [-1, 1, 1]), above=False))
    close(transfer(left_half(SIZE), UP, degree=4)[0], quarter + below, tolerance=EXACT)


def test_half_blocked_planes_have_diffuse_transfer_in_closed_form():
    vector = np.asarray(transfer_diffuse(left_half(SIZE), UP, degree=1))[:, 0]
    band = np.sqrt(3 / (4 * np.pi))
    expected = [np.sqrt(1 / (4 * np.pi)) / 2, band / 3, 0, -band * 2 / (3 * np.pi)]
    # The cosine counts as its mean over each texel: of second order in its edge.
    np.testing.assert_allclose(vector, expected, atol=2e-3)
    fine = np.asarray(transfer_diffuse(left_half(64), UP, degree=1))[:, 0]
    np.testing.assert_allclose(fine, expected, atol=2e-5)


def test_open_diffuse_vertices_have_the_cosine_kernel_in_closed_form(random, close):
    frame = frames(random, 5)
    vector = transfer_diffuse(np.full((5, 6 * 32**2), 16, np.uint8), frame, degree=4)
    cosine = np.repeat(np.array([np.pi, 2 * np.pi / 3, np.pi / 4, 0, -np.pi / 24]), [1, 3, 5, 7, 9])[:, None]
    close(vector, harmonics.basis(np, np.asarray(frame, float)[:, 2], 4) * cosine / np.pi, tolerance=1e-3)


def test_any_visibility_gives_the_sum_over_fine_texels(random, close):
    seen, frame, fine = visible(random, 2), frames(random, 2), 16
    frame = np.asarray(frame)
    flux = np.maximum(frame[:, 2] @ np.asarray(cubemap.vector_area(size=SIZE)).reshape(-1, 3).T, 0)
    fraction = np.asarray(seen) / 16
    fraction = np.where(flux > 0, fraction, np.sum(fraction * flux, 1, keepdims=True) / np.sum(flux, 1, keepdims=True))
    fraction = fraction.reshape(-1, 6, SIZE, 1, SIZE, 1) * np.ones((fine, 1, fine))
    wi = np.asarray(cubemap.direction(size=SIZE * fine)).reshape(-1, 3)
    weight = fraction.reshape(2, -1) * np.asarray(cubemap.solid_angle(size=SIZE * fine)).reshape(-1)
    world = harmonics.basis(np, wi.astype(float), 3).T
    local = np.stack([harmonics.basis(np, wi.astype(float) @ axes.T, 3).T for axes in frame])
    expected = np.einsum("bd,bdo,di->boi", weight, local, world, optimize=True)
    close(transfer(seen, frame, degree=3), expected, tolerance=1e-4)


def test_matrices_hold_the_harmonics_of_the_visibility_and_no_more(random, close):
    frame, degree = frames(random, 4), 4
    coefficient = random.normal(size=((2 * degree + 1) ** 2, 4)).astype(np.float32)
    matrix = from_visibility(coefficient, frame, degree=degree)
    close(to_visibility(matrix, frame), coefficient, tolerance=EXACT)
    traced = transfer(visible(random, 4), frame, degree=degree)
    close(from_visibility(to_visibility(traced, frame), frame, degree=degree), traced, tolerance=EXACT)


def test_precomputed_open_vertices_have_the_rotation_to_their_frame(close):
    mesh = builtin.sphere(rings=5, sectors=8)
    transport = precompute(mesh, degree=4, size=16)
    close(transport.frame, directions.frame(mesh.normal, mesh.tangent))
    close(np.asarray(transport.matrix)[:, 0], open_matrices(transport.frame, 4), tolerance=HORIZON)
    assert transport.nbytes == len(mesh.position) * 25**2 * 4


def test_degrees_and_sizes_out_of_range_are_refused():
    for made, options in itertools.product((precompute, precompute_diffuse), ({"degree": -1}, {"degree": 26})):
        with pytest.raises(ValueError, match="degree must be 0 to 25 and size a power of two, got"):
            made(builtin.plane(cells=1), **options)
    for made, count in itertools.product((transfer, transfer_diffuse), (0, 5, 6 * 9)):
        with pytest.raises(ValueError, match="power of two"):
            made(np.zeros((1, count), np.uint8), UP, degree=1)
