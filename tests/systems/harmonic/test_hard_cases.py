"""The harmonic system: degenerate input gives finite, bounded radiance."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import jaxprt as prt
from benchmarks.published.harmonics import unshadowed_radiance
from benchmarks.published.interreflection import interreflect, interreflect_diffuse
from jaxprt import harmonic, reference
from jaxprt.brdf import CookTorrance, Lambert, Phong, Ward
from jaxprt.scene import Environment, builtin
from jaxprt.scene.mesh import join, make_mesh
from jaxprt.sphere import cubemap, directions, harmonics, rotation
from jaxprt.systems.harmonic import (
    precompute,
    precompute_diffuse,
    tabulate,
)
from jaxprt.systems.harmonic.table import project

SIZE = 16
EYE = jnp.array([1.0, 2.0, 3.0])
WHITE = Environment(jnp.ones((6, SIZE, SIZE, 1)))
HIGH = 15  # 256 coefficients; the published system goes to 225.
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


def box():
    """Seen from inside: no light comes in."""
    outside = trimesh.creation.box()
    return make_mesh(np.array(outside.vertices), np.array(outside.faces)[:, ::-1])


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


@pytest.mark.parametrize("turn", TURNS)
def test_high_degrees_and_half_turns_give_the_light_that_comes_from_there(turn, close):
    frame = jnp.asarray(turn[None], jnp.float32)
    light = jnp.asarray(np.random.default_rng(1).normal(size=((HIGH + 1) ** 2, 1)), jnp.float32)
    local = harmonic.system.local_light(frame, light)[..., 0]
    wi = jnp.concatenate([around(30), jnp.eye(3), -jnp.eye(3)])  # The poles too.
    close(harmonics.reconstruct(local, wi), harmonics.reconstruct(light, wi @ frame[0]), tolerance=DEEP)


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


def test_radiance_and_gradients_are_finite_for_polar_views_and_normals(mirror):
    mesh = builtin.sphere(rings=6, sectors=4)  # Its poles look along +y and -y; others along the axes.
    light = harmonic.project(sun(), degree=4)
    whole = jax.jit(jax.value_and_grad(lambda eye: jnp.sum(unshadowed_radiance(mesh, mirror, light, eye=eye) ** 2)))
    for eye in (jnp.array([0.0, 2, 0]), jnp.array([0.0, -2, 0]), jnp.array([0.0, 0, 1e6]), mesh.position[0]):
        color, gradient = whole(eye)
        assert np.isfinite(color)
        assert np.isfinite(np.asarray(gradient)).all()


def test_gradients_by_frames_are_those_of_turns_at_half_turns():
    light = jnp.asarray(np.random.default_rng(3).normal(size=(25, 1)), jnp.float32)
    frame = jnp.asarray(np.stack(TURNS), jnp.float32)
    axis = jnp.array([0.3, -0.5, 0.8]) / jnp.sqrt(0.98)
    cross = jnp.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])

    @jax.jit
    def value(angle):  # Rodrigues' formula.
        turn = jnp.eye(3) + jnp.sin(angle) * cross + 2 * jnp.sin(angle / 2) ** 2 * cross @ cross
        return harmonic.system.local_light(turn @ frame, light)[:, 0]

    _, tangent = jax.jvp(value, (jnp.zeros(()),), (jnp.ones(()),))
    step = 1e-2
    numeric = (8 * (value(step) - value(-step)) - value(2 * step) + value(-2 * step)) / (12 * step)
    error = np.linalg.norm(tangent - numeric, axis=0) / np.linalg.norm(numeric, axis=0)
    assert error.max() < 2e-3


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


def test_vertices_that_see_nothing_are_black(lambert, mirror):
    mesh, light = box(), jnp.asarray(np.random.default_rng(0).normal(size=(25, 3)), jnp.float32)
    transport = precompute(mesh, size=8)
    np.testing.assert_array_equal(transport.matrix, 0)
    for table in (lambert, mirror):
        color = relight(transport, table, light, eye=jnp.array([0.1, 0.2, 0.1]))
        np.testing.assert_array_equal(color, 0)
        np.testing.assert_array_equal(interreflect(mesh, transport, [table], bounces=2, size=8).matrix, 0)
    vector = precompute_diffuse(mesh, size=8)
    np.testing.assert_array_equal(vector.vector, 0)
    bounced = interreflect_diffuse(mesh, vector, np.ones((1, 1)), bounces=2, size=8)
    np.testing.assert_array_equal(bounced.vector, 0)


def test_a_lone_triangle_has_nothing_to_bounce(lambert):
    mesh = make_mesh(np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0.0]]), np.array([[0, 1, 2]]))
    transport = precompute(mesh, size=8)
    same = interreflect(mesh, transport, [lambert], bounces=2, size=8)
    np.testing.assert_array_equal(same.matrix, transport.matrix)


def negative(coefficient):
    """Share of the absolute light that is negative, and the lowest over the highest value."""
    value = np.asarray(harmonics.reconstruct(coefficient, cubemap.direction(size=32)))[..., 0]
    weight = np.asarray(cubemap.solid_angle(size=32))
    return np.sum(weight * np.maximum(-value, 0)) / np.sum(weight * np.abs(value)), -value.min() / value.max()


@pytest.mark.parametrize("degree", [2, 4, 9, 14])
def test_a_sun_in_one_texel_rings_and_windows_calm_it(degree):
    light = harmonic.project(sun(), degree=degree)
    area = float(cubemap.solid_angle(size=SIZE)[2, 3, 4])
    center = cubemap.direction(size=SIZE)[2, 3, 4]
    np.testing.assert_allclose(light[0, 0], 1000 * area * np.sqrt(1 / (4 * np.pi)), rtol=1e-5)
    fraction, depth = negative(light)
    assert fraction > 0.25
    assert depth > 0.1
    softest = harmonics.least_laplacian(light, jnp.asarray(0.05))
    for window, bound in (
        (harmonics.lanczos(degree=degree), 0.75),
        (harmonics.hann(degree=degree), 0.6),
        (softest, 0.75),
    ):
        calmed = harmonics.convolve(light, window)
        less, lower = negative(calmed)
        assert less < bound * fraction
        assert lower < bound * depth
        np.testing.assert_allclose(calmed[0], light[0], rtol=1e-6)  # No energy is lost.
        brightest = cubemap.direction(size=32).reshape(-1, 3)
        value = harmonics.reconstruct(calmed, brightest)[:, 0]
        assert brightest[np.argmax(value)] @ center > 0.99


def test_negative_radiance_is_returned_and_windows_lessen_it(mirror):
    mesh = builtin.sphere(rings=12, sectors=20)
    facing = np.sum(np.asarray(mesh.normal * (EYE - mesh.position)), 1) > 0
    light = harmonic.project(sun(), degree=4)
    counts, energies = [], []
    for factor in (jnp.ones(5), harmonics.lanczos(degree=4), harmonics.hann(degree=4)):
        color = np.asarray(unshadowed_radiance(mesh, mirror, harmonics.convolve(light, factor), eye=EYE))
        color = color[facing]
        assert np.isfinite(color).all()
        counts.append(int((color < -1e-3 * color.max()).sum()))
        energies.append(float(-color[color < 0].sum() / np.abs(color).sum()))
    assert counts[0] > 20, "nothing is clamped"
    assert energies[0] > 1.3 * energies[1] > 1.3 * energies[2]
    assert counts[0] >= counts[1] >= counts[2]


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
