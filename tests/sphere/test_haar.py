import jax.numpy as jnp
import numpy as np
import pytest
import pywt

from jaxprt.sphere import haar


def _image(*shape):
    return np.random.default_rng(0).standard_normal(shape).astype(np.float32)


@pytest.mark.parametrize("n", [1, 2, 8])
def test_forward_equals_pywavelets(n):
    image = _image(n, n, 1)
    if n == 1:
        expected = image[..., 0]
    else:
        expected, _ = pywt.coeffs_to_array(pywt.wavedec2(image[..., 0], "haar", mode="periodization"))
    np.testing.assert_allclose(haar.forward(image)[..., 0], expected, atol=1e-5)


def test_inverse_undoes_forward_in_both_orders():
    image = _image(2, 6, 16, 16, 3)
    np.testing.assert_allclose(haar.inverse(haar.forward(image)), image, atol=1e-5)
    np.testing.assert_allclose(haar.forward(haar.inverse(image)), image, atol=1e-5)


@pytest.mark.parametrize("n", [0, 3, 48])
def test_edge_that_is_no_power_of_two_is_refused(n):
    with pytest.raises(ValueError, match="power of two"):
        haar.forward(jnp.zeros((n, n, 1)))


def test_area_is_the_support_of_each_basis_function():
    size = 8
    function = haar.inverse(np.eye(size**2, dtype=np.float32).reshape(-1, size, size, 1))
    support = np.mean(np.asarray(function) != 0, (1, 2, 3)).reshape(size, size)
    np.testing.assert_array_equal(support, haar.area(size=size))


def test_face_edge_inverts_the_count_and_refuses_others():
    assert [haar.face_edge(6 * n * n) for n in (1, 2, 64)] == [1, 2, 64]
    for count in (0, 5, 7, 6 * 9, -6):
        with pytest.raises(ValueError, match="power of two"):
            haar.face_edge(count)
