"""The harmonic system: degenerate input gives finite, bounded radiance."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from benchmarks.published.harmonics import unshadowed_radiance
from jaxprt import harmonic, reference
from jaxprt.brdf import CookTorrance, Lambert, Phong, Ward
from jaxprt.scene import Environment, builtin
from jaxprt.scene.mesh import join, make_mesh
from jaxprt.sphere import directions, harmonics, rotation
from jaxprt.systems.harmonic import (
    precompute,
    tabulate,
)
from jaxprt.systems.harmonic.table import project

SIZE = 16
EYE = jnp.array([1.0, 2.0, 3.0])
WHITE = Environment(jnp.ones((6, SIZE, SIZE, 1)))
DEEP = 4e-5  # Float32 sums over as many.


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
    return Environment(jnp.zeros((6, SIZE, SIZE, 1)).at[texel].set(1000.0))


def around(count, seed=0):
    direction = np.random.default_rng(seed).normal(size=(count, 3))
    return jnp.asarray(direction / np.linalg.norm(direction, axis=1, keepdims=True), jnp.float32)


HALF_TURNS = [np.diag([1.0, -1, -1]), np.diag([-1.0, 1, -1]), np.diag([-1.0, -1, 1])]
TURNS = [*HALF_TURNS, np.eye(3), np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]), np.eye(3)[[1, 2, 0]]]


@pytest.mark.parametrize("normal", [[0, 0, 1], [0, 0, -1], [0, 1, 0], [0, -1, 0], [1e-20, -1, 0], [1e-4, 0, -1.0]])
def test_polar_normals_are_lit_like_any_other(normal, lambert):
    """A lobe of light along the normal gives what it gives to a vertex that looks sideways."""
    normal = directions.normalize(jnp.array([normal, [0.6, 0.0, 0.8]], jnp.float32))
    mesh = make_mesh(np.array([[0, 0, 0], [0, 0, 0.0]]), np.array([[0, 1, 0]]), normal=normal)
    color = [
        unshadowed_radiance(mesh, lambert, harmonics.disc(axis, jnp.asarray(0.5), degree=4)[:, None], eye=5 * axis)[
            number, 0
        ]
        for number, axis in enumerate(normal)
    ]
    np.testing.assert_allclose(*color, rtol=1e-4)
    assert color[0] > 0.2


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


@pytest.mark.parametrize("roughness", [0.1, 0.03, 0.01, 0.003])
def test_mirror_like_brdfs_are_tabulated_as_the_harmonics_in_the_mirror_direction(roughness):
    """The narrower a lobe, the more its coefficients are those of a point, times what it reflects."""
    brdf = Ward(diffuse=0.0, specular=1.0, along=roughness, across=roughness)
    height = np.array([1.0, 0.9, 0.6, 0.4])
    radius = np.sqrt(1 - height**2)
    wo = jnp.asarray(np.stack([radius * 0.6, radius * 0.8, height], -1), jnp.float32)
    value = np.asarray(project(brdf, wo, degree=9, rings=64, sectors=640)[:, 0])
    point = np.asarray(harmonics.evaluate(wo * jnp.array([-1, -1, 1.0]), degree=9)).T
    reflected = value[0] / point[0]
    assert (reflected < 1.01).all()
    error = np.linalg.norm(value - reflected * point, axis=0) / np.linalg.norm(reflected * point, axis=0)
    # Spread by 2 (roughness / sqrt(2)) at normal incidence, and more beside: of second order in it times the degree.
    assert error.max() < 40 * (roughness * 3) ** 2 + 2e-3
    if roughness <= 0.03:
        np.testing.assert_allclose(reflected, 1, atol=0.02)


def test_mirrors_show_the_light_itself(mirror, close):
    """A table that is the mirror direction's harmonics gives the light that is reconstructed there."""
    mesh = sphere()
    light = harmonic.project(sun(), degree=4)
    frame = directions.frame(mesh.normal, mesh.tangent)
    wo = jnp.einsum("vij,vj->vi", frame, directions.normalize(EYE - mesh.position))
    point = harmonics.evaluate(wo * jnp.array([-1, -1, 1.0]), degree=4).T[:, None]
    color = harmonic.system.combine(harmonic.system.local_light(frame, light), point)
    away = directions.normalize(EYE - mesh.position)
    mirrored = 2 * jnp.sum(away * mesh.normal, -1, keepdims=True) * mesh.normal - away
    close(color, harmonics.reconstruct(light, mirrored), tolerance=DEEP)


def test_one_coefficient_is_the_mean_of_the_light():
    mesh = sphere()
    table = tabulate(Phong(diffuse=0.5, specular=0.3), degree=0, resolution=4)
    assert table.degree == 0
    light = harmonic.project(sun(), degree=0)
    transport = precompute(mesh, degree=0, size=8)
    np.testing.assert_allclose(transport.matrix, 1, atol=0.01)
    color = relight(transport, table, light, eye=EYE)
    assert np.isfinite(np.asarray(color)).all()
    assert np.asarray(color).any()


def test_black_brdfs_have_a_table_of_zeros_and_say_no_error():
    table = tabulate(Lambert(0.0), degree=1, resolution=2)
    np.testing.assert_array_equal(table.table, 0)
    assert float(table.error) == 0


def test_rotation_matrices_near_the_poles_keep_the_norm(close):
    """Frames that differ from the identity and from half turns by rounding and by a little."""
    light = jnp.asarray(np.random.default_rng(5).normal(size=(25, 1)), jnp.float32)
    axis = np.asarray(around(20, 1), float)
    for turn in TURNS:
        for angle in (1e-20, 1e-10, 1e-7, 1e-4, 1e-2):
            cross = np.cross(np.eye(3), axis[:, None])
            frame = np.linalg.qr(turn @ (np.eye(3) + angle * cross))[0]
            frame = frame * np.sign(np.einsum("vij,ij->vj", frame, turn))[:, None]
            frame = jnp.asarray(frame, jnp.float32)
            local = harmonic.system.local_light(frame, light)
            close(np.linalg.norm(local, axis=0)[0], np.full(20, np.linalg.norm(light)))
            back = rotation.rotate_each(local, jnp.asarray(np.asarray(frame).swapaxes(1, 2)))
            close(back, np.repeat(np.asarray(light)[..., None], 20, -1), tolerance=DEEP)
