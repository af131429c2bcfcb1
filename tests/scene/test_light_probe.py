"""Light probes, read as each tool's own code reads them, are the irradiance of the environment."""

import numpy as np
import pytest

from jaxprt.scene import Environment, light_probe
from jaxprt.sphere import cubemap

RNG = np.random.default_rng(3)


def smooth_light():
    """Radiance of the bands up to two, of which a probe holds all."""
    x, y, z = np.moveaxis(np.asarray(cubemap.direction(size=32)), -1, 0)
    part = [np.ones_like(x), y, z, x, x * y, y * z, 3 * z**2 - 1, x * z, x**2 - y**2]
    return Environment(np.einsum("k...,kc->...c", part, RNG.normal(size=(9, 3))))


def irradiance(light, normal):
    """By the sum over all texels."""
    way = np.asarray(cubemap.direction(size=32)).reshape(-1, 3)
    area = np.asarray(cubemap.solid_angle(size=32)).reshape(-1, 1)
    return (np.maximum(normal @ way.T, 0)[..., None] * area * np.asarray(light.radiance).reshape(-1, 3)).sum(1)


def three(sh, normal):
    """`getIrradianceAt` of three.js r187, src/math/SphericalHarmonics3.js: its numbers."""
    x, y, z = normal.T[..., None]
    return (
        0.886227 * sh[0]
        + 2 * 0.511664 * (y * sh[1] + z * sh[2] + x * sh[3])
        + 2 * 0.429043 * (x * y * sh[4] + y * z * sh[5] + x * z * sh[7])
        + (0.743125 * z**2 - 0.247708) * sh[6]
        + 0.429043 * (x**2 - y**2) * sh[8]
    )


def filament(sh, normal):
    """Its shader's sum is irradiance over pi, by which the albedo is multiplied."""
    x, y, z = normal.T[..., None]
    part = [1, y, z, x, y * x, y * z, 3 * z**2 - 1, z * x, x**2 - y**2]
    return np.pi * sum(p * each for p, each in zip(part, sh, strict=True))


def unity(sh, normal):
    """Packed for its shaders as its render pipelines do, then SHEvalLinearL0L1 and SHEvalLinearL2; x is mirrored."""
    normal = normal * [-1, 1, 1]
    first = np.stack([sh[3], sh[1], sh[2], sh[0] - sh[6]])  # unity_SHAr and its like
    second = np.stack([sh[4], sh[5], 3 * sh[6], sh[7]])  # unity_SHBr
    quadratic = normal[:, [0, 1, 2, 2]] * normal[:, [1, 2, 2, 0]]
    last = (normal[:, :1] ** 2 - normal[:, 1:2] ** 2) * sh[8]
    return np.pi * (np.append(normal, np.ones((len(normal), 1)), 1) @ first + quadratic @ second + last)


@pytest.mark.parametrize(("tool", "read"), [("three.js", three), ("Filament", filament), ("Unity", unity)])
def test_each_tool_reads_the_irradiance(tool, read):
    light = smooth_light()
    normal = RNG.normal(size=(20, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    true = irradiance(light, normal)
    found = read(np.asarray(light_probe(light, tool=tool)), normal)
    assert np.abs(found - true).max() < 5e-3 * np.abs(true).max()


def test_gray_light_has_three_alike_colors():
    probe = np.asarray(light_probe(Environment(np.full((6, 4, 4, 1), 2.0)), tool="Filament"))
    np.testing.assert_allclose(probe[0], 2.0, rtol=1e-6)
    np.testing.assert_allclose(probe[1:], 0, atol=1e-6)


def test_other_tools_and_lights_are_refused():
    light = Environment(np.ones((6, 4, 4, 3)))
    with pytest.raises(ValueError, match=r"one of three\.js, Filament, Unity, got 'Unreal'"):
        light_probe(light, tool="Unreal")
    with pytest.raises(ValueError, match=r"got \[2, 6, 4, 4, 3\]"):
        light_probe(Environment(np.ones((2, 6, 4, 4, 3))), tool="Unity")
