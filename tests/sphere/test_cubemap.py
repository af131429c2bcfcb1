import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt.sphere import cubemap

SIZES = [1, 2, 5]


def random_cubemap(size, *channels, seed=0):
    return np.random.default_rng(seed).random((6, size, size, *channels), np.float32)


def random_direction(count, seed=1):
    vector = np.random.default_rng(seed).normal(size=(count, 3))
    return (vector / np.linalg.norm(vector, axis=-1, keepdims=True)).astype(np.float32)


def opengl_coordinates(direction):
    """Table 8.19 of the OpenGL 4.6 specification, written out: face, s, t."""
    x, y, z = direction
    major = int(np.argmax(np.abs(direction)))
    positive = direction[major] > 0
    sc, tc = [(-z, -y) if positive else (z, -y), (x, z) if positive else (x, -z), (x, -y) if positive else (-x, -y)][
        major
    ]
    return 2 * major + (not positive), sc / abs(direction[major]), tc / abs(direction[major])


@pytest.mark.parametrize("size", SIZES)
def test_directions_are_unit_points_lie_on_the_cube_and_solid_angles_sum_to_the_sphere(size):
    direction = cubemap.direction(size=size)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=-1), 1, rtol=1e-6)
    point = np.asarray(cubemap.point(size=size))
    assert (np.abs(point).max(-1) == 1).all()
    np.testing.assert_allclose(point / np.linalg.norm(point, axis=-1, keepdims=True), direction, atol=1e-6)
    total = np.asarray(cubemap.solid_angle(size=size), np.float64).sum()
    assert total == pytest.approx(4 * np.pi, rel=1e-6)


def test_faces_rows_and_columns_are_those_of_opengl():
    size = 5
    direction = np.asarray(cubemap.direction(size=size), np.float64)
    for face, row, column in np.ndindex(6, size, size):
        expected = (face, (2 * column + 1) / size - 1, (2 * row + 1) / size - 1)
        assert opengl_coordinates(direction[face, row, column]) == pytest.approx(expected, abs=1e-6)
    face, place = cubemap.coordinates(jnp.asarray(direction, jnp.float32))
    assert (np.asarray(face) == np.arange(6)[:, None, None]).all()
    center = (2 * np.arange(size) + 1) / size - 1
    np.testing.assert_allclose(place[..., 0], np.broadcast_to(center, (6, size, size)), atol=1e-6)
    np.testing.assert_allclose(place[..., 1], np.broadcast_to(center[:, None], (6, size, size)), atol=1e-6)


@pytest.mark.parametrize("size", SIZES)
def test_solid_angle_and_vector_area_equal_fine_quadrature(size):
    fine = 120
    direction = np.asarray(cubemap.direction(size=size * fine), np.float64)
    weight = np.asarray(cubemap.solid_angle(size=size * fine), np.float64)
    block = (6, size, fine, size, fine, -1)
    expected = (weight[..., None] * direction).reshape(block).sum((2, 4))
    # The midpoint rule's own error is about (texel width)^2 / 24 of the whole.
    np.testing.assert_allclose(cubemap.vector_area(size=size), expected, atol=4e-5)
    np.testing.assert_allclose(cubemap.solid_angle(size=size), weight.reshape(block).sum((2, 4))[..., 0], rtol=1e-5)


@pytest.mark.parametrize("size", SIZES)
def test_lookup_at_texel_centers_returns_the_texels(size):
    texel = random_cubemap(size, 3)
    np.testing.assert_allclose(cubemap.lookup(texel, cubemap.point(size=size)), texel, atol=1e-5)


@pytest.mark.parametrize("sharpness", [1, 3])
@pytest.mark.parametrize("size", [1, 5])
def test_lookup_reproduces_constants_exactly(size, sharpness):
    constant = np.float32(0.1)
    value = cubemap.lookup(jnp.full((6, size, size), constant), random_direction(2000), sharpness=sharpness)
    assert (np.asarray(value) == constant).all()


@pytest.mark.parametrize("size", [1, 5])
def test_lookup_is_continuous_over_edges_and_corners(size):
    texel = random_cubemap(size)
    along = np.linspace(-1, 1, 201)
    edge = [
        np.insert(np.stack([np.full(201, a), np.full(201, b)], -1), i, along, axis=-1)
        for i in range(3)
        for a, b in itertools.product((-1, 1), repeat=2)
    ]
    edge = np.concatenate(edge)
    # Points a little to each side of every edge fall on different faces and must see the same values.
    nudge = np.random.default_rng(2).normal(size=(16, *edge.shape)) * 1e-5
    value = np.asarray(cubemap.lookup(texel, (edge + nudge).astype(np.float32)))
    slope = 2 * size
    assert (value.max(0) - value.min(0)).max() < 1e-4 * slope


def test_lookup_converges_to_a_smooth_function():
    def smooth(s):
        return 1 + s[..., 0] * s[..., 1] + s[..., 2] ** 3 + s[..., 1]

    direction = random_direction(2000)
    error = [
        np.asarray(cubemap.lookup(smooth(cubemap.direction(size=n)), direction) - smooth(direction)) for n in (8, 32)
    ]
    # Second order on the faces; first order in the strip of half a texel along the edges of the cube, where the
    # lines of texel centers have a bend.
    assert np.abs(error[1]).max() < np.abs(error[0]).max() / 3
    assert np.median(np.abs(error[1])) < np.median(np.abs(error[0])) / 12


def test_sharpness_narrows_the_transition_to_that_fraction_of_a_texel():
    texel = jnp.zeros((6, 4, 4)).at[4, :, 2:].set(1)  # A step at s = 0 on face +z.
    s = np.linspace(-0.5, 0.5, 101)
    direction = np.stack([s, 0 * s + 0.1, 0 * s + 1], -1).astype(np.float32)
    for sharpness in (1, 3):
        expected = np.clip(s * 2 * sharpness + 0.5, 0, 1)
        np.testing.assert_allclose(
            cubemap.lookup(texel, direction, sharpness=sharpness), expected, atol=1e-5 * sharpness
        )


def test_gradients_are_finite_everywhere_even_at_corners_and_zero():
    corner = np.array(list(itertools.product((-1, 0, 1), repeat=3)), np.float32)  # Corners, edges, axes and zero.
    direction = np.concatenate([corner, random_direction(100)])
    gradient = jax.grad(lambda m, d: cubemap.lookup(m, d, sharpness=3).sum(), argnums=(0, 1))
    for part in gradient(random_cubemap(4), direction):
        assert np.isfinite(part).all()


@pytest.mark.parametrize("size", SIZES)
def test_border_holds_the_texels_across_the_edges(size):
    index = cubemap.border_index(size=size)
    assert index.dtype == np.int32
    np.testing.assert_array_equal(index[:, 1:-1, 1:-1], np.arange(6 * size**2).reshape(6, size, size))
    direction = np.asarray(cubemap.direction(size=size)).reshape(-1, 3)
    center = (2 * np.arange(-1, size + 1) + 1) / size - 1
    t, s = np.meshgrid(center, center, indexing="ij")
    frame = np.asarray(cubemap.point(size=1))[:, 0, 0]
    for face in range(6):
        axis_s = np.array([[0, 0, -1], [0, 0, 1], [1, 0, 0], [1, 0, 0], [1, 0, 0], [-1, 0, 0]])[face]
        axis_t = np.array([[0, -1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [0, -1, 0], [0, -1, 0]])[face]
        beyond = s[..., None] * axis_s + t[..., None] * axis_t + frame[face]
        beyond /= np.linalg.norm(beyond, axis=-1, keepdims=True)
        # Across an edge stands one of the nearest texels to the padded center, from another face.
        dot = beyond @ direction.T
        nearest = direction[index[face].ravel()].reshape(*index[face].shape, 3)
        found = (nearest * beyond).sum(-1)
        other = np.abs(nearest @ frame[face]) < np.abs(nearest).max(-1)
        edge = np.zeros(index[face].shape, bool)
        edge[[0, -1], :] = edge[:, [0, -1]] = True
        corner = np.zeros_like(edge)
        corner[np.ix_([0, -1], [0, -1])] = True
        assert other[edge].all()
        outside = dot.copy()
        outside[..., face * size**2 : (face + 1) * size**2] = -1
        np.testing.assert_allclose(found[edge & ~corner], outside.max(-1)[edge & ~corner], atol=1e-6)


def test_sizes_below_one_are_refused():
    for function in (cubemap.direction, cubemap.point, cubemap.solid_angle, cubemap.vector_area, cubemap.border_index):
        with pytest.raises(ValueError, match="size must be at least 1, got 0"):
            function(size=0)
    with pytest.raises(ValueError, match="sharpness must be at least 1, got 0"):
        cubemap.lookup(random_cubemap(2), random_direction(1), sharpness=0)
