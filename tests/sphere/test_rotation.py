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
    return jnp.asarray(scipy.linalg.expm(t * cross_matrix(turn)) @ matrix)


def first_difference(function, h=5e-4):
    return (8 * (function(h) - function(-h)) - (function(2 * h) - function(-2 * h))) / (12 * h)


def second_difference(function, h=2e-3):
    near, far = function(h) + function(-h), function(2 * h) + function(-2 * h)
    return (16 * near - far - 30 * function(0.0)) / (12 * h * h)


@pytest.mark.parametrize("degree", [0, 3, 7])
def test_rotating_the_basis_is_evaluating_it_in_rotated_directions(degree, x64, close):
    direction = unit(0, 40)
    basis = harmonics.evaluate(direction, degree=degree)
    for turn in map(jnp.asarray, (MATRIX | MIRROR).values()):
        expected = harmonics.evaluate(direction @ turn.T, degree=degree)
        close(rotation.rotate(basis.T, turn).T, expected)
        close(basis @ rotation.matrix(turn, degree=degree).T, expected)


def test_in_float32_every_special_rotation_keeps_the_theorem(close):
    direction = unit(0, 40, np.float32)
    for turn in jnp.asarray(EVERY, jnp.float32):
        basis = harmonics.evaluate(direction, degree=6)
        close(rotation.rotate(basis.T, turn).T, harmonics.evaluate(direction @ turn.T, degree=6))


def test_degree_50_rotates_in_float32(x64, close):
    # By NumPy's copy of the basis, which another test compares with SciPy's, as it need not be compiled.
    direction = np.asarray(unit(4, 100))
    basis = harmonics.basis(np, direction, 50)
    for name in ("random", "half turn about x", "pole all but fixed"):
        turn = jnp.asarray(MATRIX[name], jnp.float32)
        actual = rotation.rotate(jnp.asarray(basis, jnp.float32), turn)
        expected = harmonics.basis(np, direction @ MATRIX[name].T, 50)
        close(actual, expected)


def test_turns_about_z_are_the_rotations_about_z(x64, close):
    coefficient, angle = normal(25, 64, 2), 0.9
    turn = jnp.asarray(Rotation.from_euler("z", angle).as_matrix())
    actual = rotation.about_z(coefficient, jnp.asarray(np.cos(angle)), jnp.asarray(np.sin(angle)))
    close(actual, rotation.rotate(coefficient, turn))


def test_bands_do_not_mix(x64):
    matrix = np.array(rotation.matrix(rotations(6, 1)[0], degree=8))
    for l in range(9):
        matrix[l * l : (l + 1) ** 2, l * l : (l + 1) ** 2] = 0
    np.testing.assert_array_equal(matrix, 0)


def test_the_quarter_turn_about_x_takes_z_to_y_and_y_to_minus_z(x64, close):
    # Band 1 holds y, z, x. The functions z, y and x become y, -z and x.
    expected = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    close(rotation.matrix(jnp.asarray(QUARTER_TURN), degree=1)[1:, 1:], expected)
    close(rotation._quarter_turn(1), expected)
    matrix = rotation.matrix(jnp.asarray(QUARTER_TURN), degree=8)
    for l in range(9):
        close(rotation._quarter_turn(l), matrix[l * l : (l + 1) ** 2, l * l : (l + 1) ** 2])
    pole, side = (harmonics.evaluate(jnp.array(axis), degree=8) for axis in ([0.0, 0, 1], [0.0, 1, 0]))
    close(matrix @ pole, side)


def test_the_matrix_is_that_of_e3nn_with_its_axes_in_the_order_y_z_x(x64, close):
    degree = 11
    # Its polar axis is the second and its first m the first axis; our (y, z, x) are its (x, y, z).
    axis = np.array([1, 2, 0])
    # Next to its pole it loses half the digits, as it takes an arc cosine there.
    turn = jnp.asarray([matrix for name, matrix in MATRIX.items() if name != "pole all but fixed"])
    actual = jax.vmap(lambda turn: rotation.matrix(turn, degree=degree))(turn)
    for l in {1, 2, degree}:
        block = slice(l * l, (l + 1) ** 2)
        expected = jax.jit(e3nn.Irrep(l, 1).D_from_matrix)(turn[:, axis[:, None], axis])
        close(actual[:, block, block], expected)


def test_many_rotations_at_once_are_each_alone(x64, close):
    degree = 7
    turn = rotations(9, 6)
    shared, own = normal(10, (degree + 1) ** 2, 2), normal(11, (degree + 1) ** 2, 2, 6)
    expected = np.stack([rotation.rotate(shared, r) for r in turn], -1)
    close(rotation.rotate_each(shared, turn), expected)
    expected = np.stack([rotation.rotate(own[..., i], r) for i, r in enumerate(turn)], -1)
    close(rotation.rotate_each(own, turn), expected)


@pytest.mark.parametrize("name", [*MATRIX, "mirror"])
def test_derivatives_by_the_rotation_are_those_of_finite_differences_along_rotations(name, x64, close):
    degree = 3
    matrix, coefficient = (MATRIX | MIRROR)[name], normal(12, (degree + 1) ** 2, 2)
    weight = normal(13, (degree + 1) ** 2, 2)
    gradient = jax.grad(lambda r: jnp.sum(weight * rotation.rotate(coefficient, r)))(jnp.asarray(matrix))
    slopes, expected_slopes = [], []
    for turn in [*np.eye(3), np.array([0.3, -1.2, 0.7])]:
        expected = first_difference(lambda t, w=turn: rotation.rotate(coefficient, turned(w, t, matrix)))
        tangent = jnp.asarray(cross_matrix(turn) @ matrix)
        _, change = jax.jvp(lambda r: rotation.rotate(coefficient, r), (jnp.asarray(matrix),), (tangent,))
        close(change, expected, tolerance=FIRST_DIFFERENCE)
        slopes.append(jnp.sum(gradient * tangent))
        expected_slopes.append(np.sum(weight * expected))
    close(np.array(slopes), np.array(expected_slopes), tolerance=FIRST_DIFFERENCE)
    # No part of it leads away from the rotations.
    along = gradient @ matrix.T
    close(along, -along.T, tolerance=1e-12)


def test_derivatives_under_vmap_are_those_of_finite_differences_along_rotations(x64, close):
    degree = 7
    every, turn = jnp.asarray(EVERY), normal(14, len(EVERY), 3)
    coefficient, weight = normal(15, (degree + 1) ** 2, 2), normal(16, (degree + 1) ** 2, 2)
    tangent = jnp.stack([cross_matrix(w) @ r for w, r in zip(turn, EVERY, strict=True)])

    def along(t):
        moved = jnp.stack([turned(w, t, r) for w, r in zip(turn, EVERY, strict=True)])
        return jax.vmap(rotation.rotate, (None, 0))(coefficient, moved)

    expected = first_difference(along)
    change = jax.vmap(lambda r, dr: jax.jvp(lambda r: rotation.rotate(coefficient, r), (r,), (dr,))[1])
    close(change(every, tangent), expected, tolerance=FIRST_DIFFERENCE)
    gradient = jax.vmap(jax.grad(lambda r: jnp.sum(weight * rotation.rotate(coefficient, r))))(every)
    close((gradient * tangent).sum((1, 2)), np.sum(weight * expected, (1, 2)), tolerance=FIRST_DIFFERENCE)


def test_second_derivatives_along_a_turn_are_those_of_finite_differences(x64, close):
    turn, coefficient, weight = np.array([0.3, -0.8, 0.5]), normal(17, 16, 2), normal(18, 16, 2)
    size, w = np.linalg.norm(turn), cross_matrix(turn)

    def along(t, matrix):  # Rodrigues' formula, which is smooth at t = 0.
        r = jnp.eye(3) + jnp.sin(size * t) / size * w + (1 - jnp.cos(size * t)) / size**2 * (w @ w)
        return rotation.rotate(coefficient, r @ matrix)

    forward = jax.jit(jax.jacfwd(jax.jacfwd(along)))
    reverse = jax.jit(jax.grad(jax.grad(lambda t, matrix: jnp.sum(weight * along(t, matrix)))))
    for matrix in EVERY:
        expected = second_difference(lambda t, r=matrix: rotation.rotate(coefficient, turned(turn, t, r)))
        close(forward(0.0, matrix), expected, tolerance=SECOND_DIFFERENCE)
        close(reverse(0.0, matrix), np.sum(weight * expected), tolerance=SECOND_DIFFERENCE)


def test_gradients_of_many_at_once_are_those_of_each_alone_in_either_precision(x64, close):
    coefficient, weight = normal(22, 16, 2), normal(23, 16, 2, len(EVERY))
    gradient = jax.jit(jax.grad(lambda r, c, g: jnp.sum(g * rotation.rotate_each(c, r))))
    expected = gradient(jnp.asarray(EVERY), coefficient, weight)
    alone = jax.jit(jax.vmap(jax.grad(lambda r, g: jnp.sum(g * rotation.rotate(coefficient, r))), (0, -1)))
    close(expected, alone(jnp.asarray(EVERY), weight))
    single = (jnp.asarray(array, jnp.float32) for array in (EVERY, coefficient, weight))
    close(gradient(*single), expected)


def test_wrong_numbers_are_refused_by_what_was_required_and_what_came(unchecked):
    with pytest.raises(ValueError, match="square number, got 7"):
        rotation.rotate(jnp.zeros((7, 3)), jnp.eye(3))
    with pytest.raises(ValueError, match="square number, got 8"):
        rotation.rotate_each(jnp.zeros((8, 3)), jnp.zeros((5, 3, 3)))
    with pytest.raises(ValueError, match=r"the 5 rotations, got the shape \(9, 3, 4\)"):
        rotation.rotate_each(jnp.zeros((9, 3, 4)), jnp.zeros((5, 3, 3)))
