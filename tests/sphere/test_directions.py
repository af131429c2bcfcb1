import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt.sphere import directions

SINGULAR = [0.0, -1.0, 0.0]


def sample(seed, count=200, dtype=np.float32):
    vector = np.random.default_rng(seed).normal(size=(count, 3))
    return jnp.asarray(vector / np.linalg.norm(vector, axis=1, keepdims=True), dtype)


def near_singular(dtype=np.float64):
    """Normals at angles of 1e-1 to 1e-9 from (0, -1, 0), in several azimuths."""
    angle, azimuth = np.meshgrid(10.0 ** -np.arange(1, 10), np.linspace(0, 6, 7), indexing="ij")
    normal = np.stack([np.sin(angle) * np.cos(azimuth), -np.cos(angle), np.sin(angle) * np.sin(azimuth)], -1)
    return normal.reshape(-1, 3).astype(dtype)


def equation_7(n):
    s = np.stack(
        [(n[:, 1] + 1) ** 2 + n[:, 2] ** 2 - n[:, 0] ** 2, -2 * (n[:, 1] + 1) * n[:, 0], -2 * n[:, 0] * n[:, 2]], -1
    )
    return s / np.linalg.norm(s, axis=1, keepdims=True)


@pytest.mark.parametrize("scale", [1e-35, 1e-20, 1.0, 1e20, 3e38])
def test_normalized_vectors_are_unit_and_keep_their_direction_at_any_scale(scale, close):
    unit = sample(0)
    close(directions.normalize(unit * np.float32(scale)), np.asarray(unit), tolerance=1e-6)


def test_the_zero_vector_becomes_up_with_zero_gradient():
    vector = jnp.zeros((2, 3)).at[0, 2].set(2)
    np.testing.assert_array_equal(directions.normalize(vector), [[0, 0, 1], [0, 1, 0]])
    for jacobian in (jax.jacrev, jax.jacfwd):
        np.testing.assert_array_equal(jacobian(directions.normalize)(vector[1]), np.zeros((3, 3)))


def test_the_gradient_of_normalize_is_the_projection_over_the_length(x64, close):
    for vector in (np.array([3.0, -1.0, 2.0]), np.array([1e-200, 0.0, 2e-200])):
        length = np.linalg.norm(vector / 1e-200) * 1e-200 if abs(vector).max() < 1e-100 else np.linalg.norm(vector)
        unit = vector / length
        expected = (np.eye(3) - np.outer(unit, unit)) / length
        close(jax.jacrev(directions.normalize)(jnp.asarray(vector)) * length, expected * length)


def test_the_tangent_is_wangs_equation_7(x64, close):
    normal = sample(1, dtype=np.float64)
    close(directions.tangent(normal), equation_7(np.asarray(normal)))


def test_float32_tangents_are_accurate_next_to_the_singular_normal():
    normal = near_singular()
    around = normal[:, [0, 2]] / np.linalg.norm(normal[:, [0, 2]], axis=1, keepdims=True)
    limit = np.stack([1 - 2 * around[:, 0] ** 2, 0 * around[:, 0], -2 * around[:, 0] * around[:, 1]], -1)
    tangent = np.asarray(directions.tangent(jnp.asarray(normal, jnp.float32)))
    single = normal.astype(np.float32).astype(np.float64)
    assert np.abs(np.linalg.norm(tangent, axis=1) - 1).max() < 1e-6
    assert np.abs((tangent * single).sum(1)).max() < 1e-6
    closest = np.abs(normal[:, [0, 2]]).max(1) < 1e-4
    assert np.abs(tangent - limit)[closest].max() < 2e-4  # The distance of the limit itself.


def test_the_singular_normal_has_the_x_axis_and_zero_gradient():
    normal = jnp.array(SINGULAR)
    np.testing.assert_array_equal(directions.tangent(normal), [1, 0, 0])
    for jacobian in (jax.jacrev, jax.jacfwd):
        np.testing.assert_array_equal(jacobian(directions.tangent)(normal), np.zeros((3, 3)))


def test_gradients_of_tangent_and_frame_are_finite_at_and_near_the_singular_normal():
    normal = jnp.asarray(np.concatenate([near_singular(np.float32), [SINGULAR, [0, 1, 0], [0, 0, 1]]]), jnp.float32)
    for function in (directions.tangent, lambda n: directions.frame(n, n), lambda n: directions.frame(n, 0 * n)):
        assert np.isfinite(jax.vmap(jax.jacrev(function))(normal)).all()


@pytest.mark.parametrize("kind", ["any", "near parallel", "parallel", "opposite", "zero", "short", "long"])
def test_frames_are_proper_rotations_whatever_the_tangent(kind):
    normal = jnp.concatenate([sample(5), jnp.asarray(near_singular(np.float32)), jnp.array([SINGULAR, [0, 1, 0]])])
    other = jnp.concatenate([sample(6), sample(7, len(normal) - 200)])
    tangent = {
        "any": other,
        "near parallel": normal + 1e-4 * other,
        "parallel": normal,
        "opposite": -3 * normal,
        "zero": 0 * normal,
        "short": 1e-30 * other,
        "long": 1e30 * other,
    }[kind]
    frame = np.asarray(directions.frame(normal, tangent), np.float64)
    assert np.abs(frame @ frame.swapaxes(1, 2) - np.eye(3)).max() < 1e-6
    assert np.abs(np.linalg.det(frame) - 1).max() < 1e-6
    np.testing.assert_array_equal(frame[:, 2], normal)


def test_a_frame_takes_the_world_to_the_local_axes_with_the_tangent_in_the_half_plane_of_x(close):
    normal, tangent = sample(8), sample(9)
    frame = directions.frame(normal, tangent)
    close((frame @ normal[..., None])[..., 0], np.tile([0.0, 0.0, 1.0], (len(normal), 1)))
    local = np.asarray((frame @ tangent[..., None])[..., 0])
    assert (local[:, 0] > 0).all()
    assert np.abs(local[:, 1]).max() < 1e-6


def test_a_tangent_parallel_to_the_normal_is_replaced_by_the_normals_own(close):
    normal = sample(10)
    close(directions.frame(normal, 2 * normal)[:, 0], np.asarray(directions.tangent(normal)))
    close(directions.frame(normal, 0 * normal)[:, 0], np.asarray(directions.tangent(normal)))
