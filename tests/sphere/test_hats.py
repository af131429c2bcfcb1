"""Hat functions against piecewise linear interpolation by SciPy, and exact integrals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy

from jaxprt.sphere import cubemap, hats

SIZE, CELLS = 16, 4


def test_hats_are_a_partition_of_unity_that_is_not_negative():
    table = hats.table(size=SIZE, cells=CELLS)
    assert table.shape == (6 * SIZE**2, hats.count(cells=CELLS))
    assert table.min() >= 0
    np.testing.assert_allclose(table.sum(1), 1, rtol=1e-12)
    np.testing.assert_array_equal(table.getnnz(1), 4)


def test_a_combination_of_hats_is_bilinear_on_each_face_and_continuous_over_edges():
    def smooth(point):  # bilinear on every face of the cube, and one function on its surface
        return 1 + point @ [0.3, -0.2, 0.5] + 0.7 * point[..., 0] * point[..., 1] * point[..., 2]

    along = np.linspace(-1, 1, CELLS + 1)
    corner = np.stack(np.meshgrid(along, along, along, indexing="ij"), -1)
    interpolated = scipy.interpolate.RegularGridInterpolator((along, along, along), smooth(corner))
    table = hats.table(size=SIZE, cells=CELLS)
    texel = np.asarray(cubemap.point(size=SIZE), np.float64).reshape(-1, 3)
    # The coefficients of the combination that is equal to the function at all texels; any other has a residual.
    coefficient, *_ = np.linalg.lstsq(table.toarray(), smooth(texel), rcond=None)
    np.testing.assert_allclose(table @ coefficient, interpolated(texel), atol=1e-12)


def test_integrals_are_those_of_the_table(close):
    value = np.random.default_rng(0).normal(size=(6, SIZE, SIZE, 3)).astype(np.float32)
    area = np.asarray(cubemap.solid_angle(size=SIZE), np.float64).ravel()
    expected = hats.table(size=SIZE, cells=CELLS).T @ (value.reshape(-1, 3) * area[:, None])
    close(hats.integrals(jnp.asarray(value), cells=CELLS), expected)


def test_projection_is_the_solution_of_least_squares(close):
    value = np.random.default_rng(1).normal(size=(6, SIZE, SIZE, 2)).astype(np.float32)
    root = np.sqrt(np.asarray(cubemap.solid_angle(size=SIZE), np.float64).reshape(-1, 1))
    table = hats.table(size=SIZE, cells=CELLS).toarray()
    expected, *_ = np.linalg.lstsq(root * table, root * value.reshape(-1, 2), rcond=None)
    found = hats.project(jnp.asarray(value), cells=CELLS)
    close(found, expected)
    close(jax.jit(lambda value: hats.project(value, cells=CELLS))(value), found)


@pytest.mark.parametrize(("cells", "message"), [(3, "must divide the 16"), (0, "must divide"), (16, "at most 8")])
def test_cells_that_texels_cannot_resolve_are_refused(cells, message):
    with pytest.raises(ValueError, match=message):
        hats.project(jnp.ones((6, SIZE, SIZE)), cells=cells)


def test_centers_are_where_the_hat_functions_are():
    size, cells = 32, 4
    moment = hats.table(size=size, cells=cells).T @ np.asarray(cubemap.vector_area(size=size)).reshape(-1, 3)
    mean = moment / np.linalg.norm(moment, axis=1, keepdims=True)
    center = hats.centers(cells=cells)
    assert len(center) == hats.count(cells=cells)
    assert np.min(np.sum(mean * center, 1)) > np.cos(np.radians(3))
