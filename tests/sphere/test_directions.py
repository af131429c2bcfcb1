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


@pytest.mark.parametrize("scale", [1e-35, 1.0, 3e38])
def test_normalized_vectors_are_unit_and_keep_their_direction_at_any_scale(scale, close):
    unit = sample(0)
    close(directions.normalize(unit * np.float32(scale)), np.asarray(unit), tolerance=1e-6)


def test_the_zero_vector_becomes_up_with_zero_gradient():
    vector = jnp.zeros((2, 3)).at[0, 2].set(2)
    np.testing.assert_array_equal(directions.normalize(vector), [[0, 0, 1], [0, 1, 0]])
    np.testing.assert_array_equal(jax.jacfwd(directions.normalize)(vector[1]), np.zeros((3, 3)))


def test_the_gradient_of_normalize_is_the_projection_over_the_length(x64, close):
    slope = jax.jit(jax.jacrev(directions.normalize))
    for direction, scale in (([3.0, -1.0, 2.0], 1.0), ([1.0, 0.0, 2.0], 1e-200)):
        length = np.linalg.norm(direction)
        unit = direction / length
        close(slope(np.array(direction) * scale) * scale, (np.eye(3) - np.outer(unit, unit)) / length)


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


def test_the_singular_normal_has_the_x_axis_a_tangent_of_zero_gradient_and_frames_of_finite_ones():
    normal = jnp.array(SINGULAR)
    np.testing.assert_array_equal(directions.tangent(normal), [1, 0, 0])
    np.testing.assert_array_equal(jax.jacfwd(directions.tangent)(normal), np.zeros((3, 3)))
    around = np.concatenate([near_singular(np.float32), [SINGULAR, [0, 1, 0], [0, 0, 1]]]).astype(np.float32)
    for other in (1.0, 0.0):  # tangents along the normal, and none
        slope = jax.jit(jax.vmap(jax.jacrev(lambda n, other=other: directions.frame(n, other * n))))
        assert np.isfinite(slope(around)).all()


@pytest.mark.parametrize("kind", ["any", "near parallel", "parallel", "opposite", "zero", "short", "long"])
def test_frames_are_proper_rotations_whatever_the_tangent(kind):
    normal = np.concatenate([sample(5), near_singular(np.float32), np.float32([SINGULAR, [0, 1, 0]])])
    other = np.asarray(sample(6, len(normal)))
    tangent = {
        "any": other,
        "near parallel": normal + np.float32(1e-4) * other,
        "parallel": normal,
        "opposite": -3 * normal,
        "zero": 0 * normal,
        "short": np.float32(1e-30) * other,
        "long": np.float32(1e30) * other,
    }[kind]
    frame = np.asarray(directions.frame(normal, tangent), np.float64)
    if kind in ("parallel", "zero"):
        np.testing.assert_allclose(frame[:, 0], directions.tangent(normal), atol=1e-6)
    assert np.abs(frame @ frame.swapaxes(1, 2) - np.eye(3)).max() < 1e-6
    assert np.abs(np.linalg.det(frame) - 1).max() < 1e-6
    np.testing.assert_array_equal(frame[:, 2], normal)


def test_a_frame_takes_the_world_to_the_local_axes_with_the_tangent_in_the_half_plane_of_x(close):
    normal, tangent = (np.asarray(sample(seed)) for seed in (8, 9))
    frame = np.asarray(directions.frame(normal, tangent))
    close((frame @ normal[..., None])[..., 0], np.tile([0.0, 0.0, 1.0], (len(normal), 1)))
    local = np.asarray((frame @ tangent[..., None])[..., 0])
    assert (local[:, 0] > 0).all()
    assert np.abs(local[:, 1]).max() < 1e-6
