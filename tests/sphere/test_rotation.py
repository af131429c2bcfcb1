import e3nn_jax as e3nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from scipy.spatial.transform import Rotation

from jaxprt.sphere import harmonics, rotation

FIRST_DIFFERENCE = 1e-9  # Five points at a step of 5e-4: h^4 / 30 times the fifth derivative, 7^4 of the first.
SECOND_DIFFERENCE = 1e-7  # Rounding over the square of a step of 2e-3.

QUARTER_TURN = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # About x; takes z to y.
SPECIAL = {
    "identity": Rotation.identity(),
    "half turn about x": Rotation.from_rotvec([np.pi, 0, 0]),
    "half turn about y": Rotation.from_rotvec([0, np.pi, 0]),
    "half turn about z": Rotation.from_rotvec([0, 0, np.pi]),
    "pole fixed": Rotation.from_euler("z", 0.7),
    "poles exchanged": Rotation.from_euler("zx", [0.7, np.pi]),
    "pole all but fixed": Rotation.from_euler("ZYZ", [0.4, 1e-7, 1.1]),
    "quarter turn about x": Rotation.from_rotvec([np.pi / 2, 0, 0]),
    "random": Rotation.random(random_state=3),
}
# The half turns exact to the last bit, where a cosine is 0 and not 1e-16.
MATRIX = {name: np.where(abs(r.as_matrix()) < 1e-15, 0.0, r.as_matrix()) for name, r in SPECIAL.items()}
MIRROR = {
    "mirror": -MATRIX["random"],
    "mirror of y": np.diag([1.0, -1, 1]),
    "mirror of z": np.diag([1.0, 1, -1]),
    "inversion": -np.eye(3),
}
EVERY = np.stack(list(MATRIX.values()))


def rotations(seed, count, dtype=np.float64):
    return jnp.asarray(Rotation.random(count, random_state=seed).as_matrix(), dtype)


def unit(seed, count, dtype=np.float64):
    vector = np.random.default_rng(seed).normal(size=(count, 3))
    return jnp.asarray(vector / np.linalg.norm(vector, axis=1, keepdims=True), dtype)


def normal(seed, *shape, dtype=np.float64):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), dtype)


def cross_matrix(w):
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def turned(turn, t, matrix):
    return scipy.linalg.expm(t * cross_matrix(turn)) @ matrix


def first_difference(function, h=5e-4):
    return (8 * (function(h) - function(-h)) - (function(2 * h) - function(-2 * h))) / (12 * h)


def second_difference(function, h=2e-3):
    near, far = function(h) + function(-h), function(2 * h) + function(-2 * h)
    return (16 * near - far - 30 * function(0.0)) / (12 * h * h)


@pytest.mark.parametrize("degree", [0, 3, 7])
def test_rotating_the_basis_is_evaluating_it_in_rotated_directions(degree, x64, close):
    direction = np.asarray(unit(0, 40))
    basis = np.asarray(harmonics.evaluate(direction, degree=degree))
    for name, turn in (MATRIX | MIRROR).items():
        expected = np.asarray(harmonics.evaluate(direction @ turn.T, degree=degree))
        close(rotation.rotate(basis.T, turn), expected.T)
        close(basis @ np.asarray(rotation.matrix(turn, degree=degree)).T, expected)
        single = rotation.rotate(basis.T.astype(np.float32), turn.astype(np.float32))
        assert single.dtype == np.float32
        close(single, expected.T)
        if name == "pole fixed":
            close(rotation.about_z(basis.T, turn[0, 0], turn[1, 0]), expected.T)


def test_degree_50_rotates_in_float32(x64, close):
    # By NumPy's copy of the basis, which another test compares with SciPy's, as it need not be compiled.
    direction = np.asarray(unit(4, 100))
    basis = harmonics.basis(np, direction, 50)
    for name in ("random", "half turn about x", "pole all but fixed"):
        turn = jnp.asarray(MATRIX[name], jnp.float32)
        actual = rotation.rotate(jnp.asarray(basis, jnp.float32), turn)
        expected = harmonics.basis(np, direction @ MATRIX[name].T, 50)
        close(actual, expected)


def test_the_quarter_turn_about_x_takes_z_to_y_and_y_to_minus_z(x64, close):
    # Band 1 holds y, z, x. The functions z, y and x become y, -z and x.
    expected = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    close(rotation.matrix(jnp.asarray(QUARTER_TURN), degree=1)[1:, 1:], expected)
    close(rotation._quarter_turn(1), expected)
    matrix = rotation.matrix(jnp.asarray(QUARTER_TURN), degree=8)
    for l in range(9):
        close(rotation._quarter_turn(l), matrix[l * l : (l + 1) ** 2, l * l : (l + 1) ** 2])


def test_the_matrix_is_that_of_e3nn_with_its_axes_in_the_order_y_z_x(x64, close):
    degree = 11
    # Its polar axis is the second and its first m the first axis; our (y, z, x) are its (x, y, z).
    axis = np.array([1, 2, 0])
    # Next to its pole it loses half the digits, as it takes an arc cosine there.
    turn = jnp.asarray([matrix for name, matrix in MATRIX.items() if name != "pole all but fixed"])
    actual = np.asarray(jax.vmap(lambda turn: rotation.matrix(turn, degree=degree))(turn))
    outside = np.array(actual)
    for l in range(degree + 1):
        outside[:, l * l : (l + 1) ** 2, l * l : (l + 1) ** 2] = 0
    np.testing.assert_array_equal(outside, 0)
    for l in {1, degree}:
        block = slice(l * l, (l + 1) ** 2)
        expected = jax.jit(e3nn.Irrep(l, 1).D_from_matrix)(np.asarray(turn)[:, axis[:, None], axis])
        close(actual[:, block, block], expected)


def test_many_rotations_at_once_are_each_alone(x64, close):
    turn, count = EVERY, len(EVERY)
    shared, own = np.asarray(normal(10, 16, 2)), np.asarray(normal(11, 16, 2, count))
    close(rotation.rotate_each(shared, turn), np.stack([rotation.rotate(shared, r) for r in turn], -1))
    close(rotation.rotate_each(own, turn), np.stack([rotation.rotate(own[..., i], turn[i]) for i in range(count)], -1))


@jax.jit
def slope(matrix, coefficient, weight):
    """Gradient, in the rotation, of a weighted sum."""
    return jax.grad(lambda r: jnp.sum(weight * rotation.rotate(coefficient, r)))(matrix)


@jax.jit
def along_tangent(matrix, tangent, coefficient):
    """Derivative of the rotated function along a tangent."""
    return jax.jvp(lambda r: rotation.rotate(coefficient, r), (matrix,), (tangent,))[1]


@pytest.mark.parametrize("name", [*MATRIX, "mirror"])
def test_derivatives_by_the_rotation_are_those_of_finite_differences_along_rotations(name, x64, close):
    matrix, coefficient, weight = (MATRIX | MIRROR)[name], np.asarray(normal(12, 16, 2)), np.asarray(normal(13, 16, 2))
    gradient = np.asarray(slope(matrix, coefficient, weight))
    slopes, expected_slopes = [], []
    for turn in [*np.eye(3), np.array([0.3, -1.2, 0.7])]:
        expected = first_difference(lambda t, w=turn: np.asarray(rotation.rotate(coefficient, turned(w, t, matrix))))
        tangent = cross_matrix(turn) @ matrix
        close(along_tangent(matrix, tangent, coefficient), expected, tolerance=FIRST_DIFFERENCE)
        slopes.append(np.sum(gradient * tangent))
        expected_slopes.append(np.sum(weight * expected))
    close(np.array(slopes), np.array(expected_slopes), tolerance=FIRST_DIFFERENCE)
    # No part of it leads away from the rotations.
    along = gradient @ matrix.T
    close(along, -along.T, tolerance=1e-12)


def test_second_derivatives_along_a_turn_are_those_of_finite_differences(x64, close):
    turn, coefficient, weight = np.array([0.3, -0.8, 0.5]), normal(17, 16, 2), normal(18, 16, 2)
    size, w = np.linalg.norm(turn), cross_matrix(turn)

    def along(t, matrix):  # Rodrigues' formula, which is smooth at t = 0.
        r = jnp.eye(3) + jnp.sin(size * t) / size * w + (1 - jnp.cos(size * t)) / size**2 * (w @ w)
        return rotation.rotate(coefficient, r @ matrix)

    forward = jax.jit(jax.jacfwd(jax.jacfwd(along)))
    reverse = jax.jit(jax.grad(jax.grad(lambda t, matrix: jnp.sum(weight * along(t, matrix)))))
    for matrix in EVERY:
        expected = second_difference(lambda t, r=matrix: np.asarray(rotation.rotate(coefficient, turned(turn, t, r))))
        close(forward(0.0, matrix), expected, tolerance=SECOND_DIFFERENCE)
        close(reverse(0.0, matrix), np.sum(weight * expected), tolerance=SECOND_DIFFERENCE)


def test_gradients_of_many_at_once_are_those_of_each_alone_in_either_precision(x64, close):
    coefficient, weight = normal(22, 16, 2), normal(23, 16, 2, len(EVERY))
    coefficient, weight = np.asarray(coefficient), np.asarray(weight)
    gradient = jax.jit(jax.grad(lambda r, c, g: jnp.sum(g * rotation.rotate_each(c, r))))
    expected = gradient(EVERY, coefficient, weight)
    close(expected, np.stack([slope(matrix, coefficient, weight[..., i]) for i, matrix in enumerate(EVERY)]))
    single = (array.astype(np.float32) for array in (EVERY, coefficient, weight))
    close(gradient(*single), expected)


def test_wrong_numbers_are_refused_by_what_was_required_and_what_came(unchecked):
    with pytest.raises(ValueError, match="square number, got 7"):
        rotation.rotate(jnp.zeros((7, 3)), jnp.eye(3))
    with pytest.raises(ValueError, match="square number, got 8"):
        rotation.rotate_each(jnp.zeros((8, 3)), jnp.zeros((5, 3, 3)))
    with pytest.raises(ValueError, match=r"the 5 rotations, got the shape \(9, 3, 4\)"):
        rotation.rotate_each(jnp.zeros((9, 3, 4)), jnp.zeros((5, 3, 3)))
