"""Conventions of other tools against their own code, and their published formulas up to l = 2."""

import drjit
import e3nn_jax as e3nn
import mitsuba
import numpy as np
import pytest

from jaxprt.sphere import harmonics
from jaxprt.sphere.low_frequency import ORDERS, TOOLS, Convention

RNG = np.random.default_rng(6)
WAY = RNG.normal(size=(40, 3))
WAY /= np.linalg.norm(WAY, axis=1, keepdims=True)


def ours(degree):
    return harmonics.basis(np, WAY, degree)


def three(way):
    """`getBasisAt` of three.js r187, src/math/SphericalHarmonics3.js."""
    x, y, z = way.T
    return np.stack(
        [
            0.282095 + 0 * x,
            0.488603 * y,
            0.488603 * z,
            0.488603 * x,
            1.092548 * x * y,
            1.092548 * y * z,
            0.315392 * (3 * z**2 - 1),
            1.092548 * x * z,
            0.546274 * (x**2 - y**2),
        ]
    )


def signed(way):
    """With the Condon-Shortley phase, as Sloan 2013 and DirectXMath have them: odd m are negative."""
    return three(way) * np.array([1, -1, 1, -1, 1, -1, 1, -1, 1])[:, None]


@pytest.mark.parametrize(("tool", "basis"), [("three.js", three), ("jaxprt", three), ("Mitsuba 3", signed)])
def test_published_formulas_up_to_two(tool, basis, close):
    close(TOOLS[tool].write(ours(2)), basis(WAY), tolerance=2e-6)  # They have six digits.


def test_mitsubas_own_basis(close):
    mitsuba.set_variant("scalar_rgb")
    theirs = [drjit.sh_eval(mitsuba.ScalarVector3f(each.tolist()), 5) for each in WAY]
    close(TOOLS["Mitsuba 3"].write(ours(5)), np.array(theirs).T, tolerance=1e-5)


def test_e3nns_own_basis(close):
    way = e3nn.IrrepsArray("1o", WAY.astype(np.float32))
    theirs = e3nn.spherical_harmonics("0e+1o+2e+3o+4e", way, normalize=True, normalization="integral").array
    close(TOOLS["e3nn"].write(ours(4)), np.asarray(theirs).T, tolerance=1e-5)


def test_axes_of_a_world_with_z_up_and_of_left_handed_ones():
    up, east = np.array([[0.0, 1, 0]]), np.array([[1.0, 0, 0]])
    for axes, of_up, of_east in (("+x-z+y", [0, 1, 0], [0, 0, 1]), ("-x+y+z", [1, 0, 0], [0, 0, -1])):
        for way, linear in ((up, of_up), (east, of_east)):
            written = Convention(axes=axes).write(harmonics.basis(np, way, 1))
            np.testing.assert_allclose(written[1:, 0], np.sqrt(3 / 4 / np.pi) * np.array(linear), atol=1e-12)
    assert np.linalg.det(Convention(axes="-x+y+z").turn) == -1
    assert np.linalg.det(TOOLS["Blender axes"].turn) == 1


def test_orders_are_as_named():
    number = np.arange(9.0)
    band = {"rising": [4, 5, 6, 7, 8], "falling": [8, 7, 6, 5, 4], "alternating": [6, 7, 5, 8, 4]}
    for order in ORDERS:
        np.testing.assert_array_equal(Convention(order=order).write(number)[4:], band[order])


@pytest.mark.parametrize(("order", "axes"), list(zip(ORDERS, ["+x+y+z", "-z+x-y", "+x+y-z"], strict=True)))
@pytest.mark.parametrize("condon_shortley", [False, True])
def test_what_is_written_and_read_is_the_same_and_dot_products_stay(condon_shortley, order, axes, close):
    convention = Convention(condon_shortley=condon_shortley, order=order, axes=axes)
    value, other = RNG.normal(size=(2, 36, 3))
    written = convention.write(value)
    close(convention.read(written), value)
    close(np.sum(written * convention.write(other), 0), np.sum(value * other, 0))
    close(convention.write(value.T, axis=1), written.T)
    local = convention.write(value, world=False)
    close(convention.read(local, world=False), value)
    # A function keeps its values: in the tool's coordinates, by the tool's basis.
    theirs = convention.write(harmonics.basis(np, WAY, 5))
    close(theirs.T @ written, ours(5).T @ value)


def test_what_is_no_convention_is_refused():
    with pytest.raises(ValueError, match="order must be one of rising, falling, alternating, got 'FuMa'"):
        Convention(order="FuMa")
    for axes in ("xyz", "+x+x+y", "+x+y", "+x+y+w"):
        with pytest.raises(ValueError, match="each letter once, got"):
            Convention(axes=axes)
    with pytest.raises(ValueError, match="must be a square number, got 5"):
        Convention().write(np.ones(5))
