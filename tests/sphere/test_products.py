"""Products of functions in harmonics against SciPy's integrals, e3nn's, and multiplication itself."""

import e3nn_jax as e3nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt.sphere import low_frequency
from jaxprt.systems.harmonic import transfer
from tests.sphere.basis import scipy_basis

RNG = np.random.default_rng(2)


def dense_rule(count=48):
    """Another rule than the package's: Gauss points in z, many azimuths, none of them on an axis."""
    height, weight = np.polynomial.legendre.leggauss(count)
    angle = 0.1 + 2 * np.pi * np.arange(2 * count) / (2 * count)
    radius = np.sqrt(1 - height**2)[:, None]
    node = np.stack([radius * np.cos(angle), radius * np.sin(angle), height[:, None] + 0 * angle], -1)
    return node.reshape(-1, 3), np.repeat(weight * np.pi / count, 2 * count)


def test_products_are_projections_of_the_product_of_values(x64, close):
    node, weight = dense_rule()
    first, second = RNG.normal(size=(25, 3)), RNG.normal(size=(16, 1))
    value = (scipy_basis(node, 4) @ first) * (scipy_basis(node, 3) @ second)
    for degree in (4, 7):
        expected = scipy_basis(node, degree).T @ (weight[:, None] * value)
        close(low_frequency.product(jnp.asarray(first), jnp.asarray(second), degree=degree), expected)
    # Degree 7 holds all of it, so that values multiply.
    whole = low_frequency.product(jnp.asarray(first), jnp.asarray(second), degree=7)
    close(scipy_basis(node, 7) @ np.asarray(whole), value)


def test_integrals_of_three_basis_functions_are_e3nns_coefficients_up_to_one_factor_per_bands(x64, close):
    # e3nn's axes have other names, in the same cyclic order, on which integrals do not depend.
    for bands in ((1, 1, 2), (2, 2, 2), (1, 2, 3), (2, 2, 4)):
        sizes = [2 * l + 1 for l in bands]
        part = []
        for axis, l in enumerate(bands):
            shape = [1, 1, 1]
            shape[axis] = 2 * l + 1
            own = np.eye((l + 1) ** 2)[:, l * l :].reshape(-1, *shape)
            part.append(jnp.asarray(np.broadcast_to(own, (len(own), *sizes))))
        found = low_frequency.triple(*part)
        theirs = np.asarray(e3nn.clebsch_gordan(*bands))
        factor = np.vdot(np.asarray(found), theirs) / np.vdot(theirs, theirs)
        assert abs(factor) > 0.01
        # e3nn takes its coefficients from tables in single precision.
        close(found, factor * theirs, tolerance=1e-6)


def test_an_operator_multiplies_and_is_symmetric(x64, close):
    first, second = jnp.asarray(RNG.normal(size=(49, 2))), jnp.asarray(RNG.normal(size=16))
    matrix = low_frequency.operator(first, degree=3)
    assert matrix.shape == (16, 16, 2)
    close(jnp.einsum("kjc,j->kc", matrix, second), low_frequency.product(first, second[:, None], degree=3))
    close(matrix, matrix.swapaxes(0, 1))
    close(low_frequency.operator(jnp.zeros(1).at[0].set(np.sqrt(4 * np.pi)), degree=3), np.eye(16))


def test_the_operator_of_visibility_is_the_transfer_matrix_in_the_world(close):
    visible = jnp.asarray(RNG.normal(size=(25, 2)), jnp.float32)
    frame = jnp.broadcast_to(jnp.eye(3), (2, 3, 3))
    matrix = transfer.from_visibility(visible, frame, degree=2)
    close(jnp.moveaxis(low_frequency.operator(visible, degree=2), -1, 0), matrix, tolerance=1e-5)


def test_triple_integrals_are_symmetric_and_differentiable(x64, close):
    node, weight = dense_rule()
    parts = [jnp.asarray(RNG.normal(size=n)) for n in (9, 16, 25)]
    values = [scipy_basis(node, d) @ np.asarray(p) for d, p in zip((2, 3, 4), parts, strict=True)]
    close(low_frequency.triple(*parts), np.sum(weight * np.prod(values, 0)))
    close(low_frequency.triple(*parts), low_frequency.triple(*parts[::-1]))
    slope = jax.grad(low_frequency.triple)(*parts)
    close(slope, scipy_basis(node, 2).T @ (weight * values[1] * values[2]))


def test_what_are_no_coefficients_is_refused():
    with pytest.raises(ValueError, match="must be a square number, got 8"):
        low_frequency.product(jnp.ones(8), jnp.ones(9), degree=2)
    with pytest.raises(ValueError, match="degree must be at least 0, got -1"):
        low_frequency.operator(jnp.ones(9), degree=-1)
