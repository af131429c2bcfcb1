"""Suns in environments: flux, place, and what is refused."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt.scene import Environment, Sun, with_suns
from jaxprt.sphere import cubemap

SUNS = [Sun("low", [0.9, 0.2, -0.3], [1.0, 0.5, 0.25]), Sun("high", [0, 3, 0], 2.0)]


def test_a_sun_is_a_texel_with_its_irradiance():
    light = Environment(jnp.full((6, 64, 64, 1), 0.1))
    lit = with_suns(light, SUNS)
    more = np.asarray(lit.radiance, np.float64) - 0.1
    area, way = (np.asarray(each, np.float64) for each in (cubemap.solid_angle(size=64), cubemap.direction(size=64)))
    np.testing.assert_allclose((more * area[..., None]).sum((0, 1, 2)), [3, 2.5, 2.25], rtol=1e-4)
    normal = np.array([0.6, 0.8, 0])
    facing = [max(normal @ np.asarray(sun.direction) / np.linalg.norm(sun.direction), 0) for sun in SUNS]
    expected = sum(cosine * np.asarray(sun.irradiance) for cosine, sun in zip(facing, SUNS, strict=True))
    irradiance = (more * (area * np.maximum(way @ normal, 0))[..., None]).sum((0, 1, 2))
    np.testing.assert_allclose(irradiance, expected, rtol=0.02)  # half a texel is 0.7 degrees
    assert np.count_nonzero(more.max(-1) > 1e-3) == 2
    np.testing.assert_allclose(with_suns(light, []).radiance, np.full((6, 64, 64, 3), 0.1, np.float32))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Sun("a", [0, 0, 0]), "the direction of sun 'a' must not be zero"),
        (lambda: Sun("a", [0, 1]), r"the direction of sun 'a' must be three numbers, got an array \[2\]"),
        (lambda: Sun("a", [0, np.nan, 0]), "the direction of sun 'a' must be finite"),
        (lambda: Sun("a", [0, 1, 0], -1), "the irradiance of sun 'a' must be"),
        (lambda: with_suns(Environment(np.ones((6, 2, 2, 2))), SUNS), "one color or three for suns, got 2"),
    ],
)
def test_wrong_suns_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_what_is_no_sun_is_refused():
    with pytest.raises(TypeError, match="suns must be a list of suns"):
        with_suns(Environment(np.ones((6, 2, 2, 3))), SUNS[0])
