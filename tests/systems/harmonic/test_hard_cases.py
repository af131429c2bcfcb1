"""The harmonic system: degenerate input gives finite, bounded radiance."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from benchmarks.published.harmonics import unshadowed_radiance
from jaxprt import harmonic, reference
from jaxprt.brdf import CookTorrance, Lambert, Ward
from jaxprt.scene import Environment, builtin
from jaxprt.scene.mesh import join, make_mesh
from jaxprt.sphere import harmonics
from jaxprt.systems.harmonic import (
    precompute,
    tabulate,
)
from jaxprt.systems.harmonic.table import project

SIZE = 16
EYE = jnp.array([1.0, 2.0, 3.0])
WHITE = Environment(jnp.ones((6, SIZE, SIZE, 1)))


def relight(transport, table, light, *, eye):
    return prt.radiance(harmonic.HarmonicSystem(transport, table), light, eye=eye)


@pytest.fixture(scope="module")
def lambert():
    return tabulate(Lambert(1.0), resolution=8)


@pytest.fixture(scope="module")
def mirror():
    """Three degrees wide."""
    return tabulate(CookTorrance(diffuse=0.0, specular=0.7, roughness=0.03, f0=1.0), resolution=8, error=0.5)


def sphere():
    return builtin.sphere(rings=6, sectors=10)  # 52 vertices


def scene():
    ground = make_mesh(
        np.array([[-3, -1, -3], [-3, -1, 3], [3, -1, 3], [3, -1, -3.0]]), np.array([[0, 1, 2], [0, 2, 3]])
    )
    return join([sphere(), ground])


def sun(texel=(2, 3, 4)):
    radiance = np.zeros((6, SIZE, SIZE, 1), np.float32)
    radiance[texel] = 1000
    return Environment(jnp.asarray(radiance))


def test_constant_light_is_never_amplified(mirror, lambert):
    light = harmonic.project(WHITE, degree=4)
    transport = precompute(scene(), size=SIZE)
    for table in (mirror, lambert):
        for color in (
            relight(transport, table, light, eye=EYE),
            unshadowed_radiance(scene(), table, light, eye=EYE),
        ):
            # Shadows of degree 4 ring by so much.
            assert -0.1 < float(color.min()) <= float(color.max()) < 1.05


def test_diffuse_surfaces_under_a_sun_hardly_ring(lambert):
    mesh, light = sphere(), sun()
    color = np.asarray(unshadowed_radiance(mesh, lambert, harmonic.project(light, degree=4), eye=EYE))
    exact = np.asarray(reference.radiance(mesh, Lambert(1.0), light, eye=EYE))
    assert np.linalg.norm(color - exact) < 0.06 * np.linalg.norm(exact)
    assert color.min() > -0.06 * exact.max()


@pytest.mark.parametrize("roughness", [0.1, 0.01])
def test_mirror_like_brdfs_are_tabulated_as_the_harmonics_in_the_mirror_direction(roughness):
    """The narrower a lobe, the more its coefficients are those of a point, times what it reflects."""
    brdf = Ward(diffuse=0.0, specular=1.0, along=roughness, across=roughness)
    height = np.array([1.0, 0.9, 0.6, 0.4])
    radius = np.sqrt(1 - height**2)
    wo = np.stack([radius * 0.6, radius * 0.8, height], -1).astype(np.float32)
    value = np.asarray(project(brdf, wo, degree=9, rings=64, sectors=640)[:, 0])
    point = np.asarray(harmonics.evaluate(wo * np.float32([-1, -1, 1]), degree=9)).T
    reflected = value[0] / point[0]
    assert (reflected < 1.01).all()
    error = np.linalg.norm(value - reflected * point, axis=0) / np.linalg.norm(reflected * point, axis=0)
    # Spread by 2 (roughness / sqrt(2)) at normal incidence, and more beside: of second order in it times the degree.
    assert error.max() < 40 * (roughness * 3) ** 2 + 2e-3
    if roughness <= 0.03:
        np.testing.assert_allclose(reflected, 1, atol=0.02)


def test_black_brdfs_have_a_table_of_zeros_and_say_no_error():
    table = tabulate(Lambert(0.0), degree=1, resolution=2)
    np.testing.assert_array_equal(table.table, 0)
    assert float(table.error) == 0
