"""The reference against itself: batches, selections, closed forms. Mitsuba judges it elsewhere."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt import reference, visibility
from jaxprt.brdf import AshikhminShirley, Lambert
from jaxprt.brdf.varying import PerVertex
from jaxprt.scene import Environment
from jaxprt.scene.environment import rotate
from jaxprt.sphere import cubemap, directions

SIZE = 8
EYE = jnp.array([2.0, 3.0, 4.0])
HORIZON = 1e-2  # Texels of 8 x 8 faces that the horizon cuts: measured .7 % at worst.
GRADIENT = 1e-2  # Differences of sums in float32 over a step of a fortieth.
TURNED = 1e-4  # Rays along rotated directions meet edges on either side by rounding.
CENTERS = np.inf  # The error that leaves one point to each texel: sums are then equal, not close.
GLOSSY = AshikhminShirley(diffuse=[0.6, 0.2, 0.1], specular=0.3, nu=20, nv=60)


@pytest.fixture
def random():
    return np.random.default_rng(6)


@pytest.fixture(scope="module")
def mesh():
    """A ball over the ground: 121 vertices, two blocks."""
    ground = prt.scene.builtin.plane(cells=5)
    position = jnp.asarray(2 * np.asarray(ground.position) - np.float32([0, 1.2, 0]))
    ground = eqx.tree_at(lambda m: m.position, ground, position)
    return prt.scene.mesh.join([prt.scene.builtin.sphere(rings=8, sectors=12), ground])


def some_light(random, *batch):
    return Environment(jnp.asarray(random.uniform(0, 2, size=(*batch, 6, SIZE, SIZE, 3)), jnp.float32))


@jax.jit
def evaluate(brdf, wi, wo):
    return brdf(wi, jnp.asarray(wo))


def hemisphere(random, count=4):
    """Visibility, positions, frames."""
    normal = directions.normalize(random.normal(size=(count, 3)).astype(np.float32))
    seen = jnp.asarray(random.integers(17, size=(count, 6 * SIZE**2)), jnp.uint8)
    return (
        seen,
        jnp.asarray(random.normal(size=(count, 3)), jnp.float32),
        directions.frame(normal, np.zeros((count, 3), np.float32)),
    )


def test_white_furnace_leaves_a_convex_white_body_invisible():
    mesh = prt.scene.builtin.sphere(rings=8, sectors=12)
    color = reference.radiance(mesh, Lambert(1.0), Environment(jnp.ones((6, SIZE, SIZE, 3))), eye=EYE)
    np.testing.assert_allclose(color, 1, atol=HORIZON)


def test_integration_equals_the_sum_over_texels_in_float64(random, close):
    seen, position, frame = hemisphere(random)
    light = some_light(random)
    direction = np.asarray(cubemap.direction(size=SIZE), np.float64).reshape(-1, 3)
    area = np.asarray(cubemap.vector_area(size=SIZE), np.float64).reshape(-1, 3)
    table = np.asarray(light.radiance, np.float64).reshape(-1, 3)
    expected = []
    for vertex in range(4):
        axes = np.asarray(frame[vertex], np.float64)
        wo = axes @ np.asarray(EYE - position[vertex], np.float64)
        wo = wo / np.linalg.norm(wo)
        if wo[2] < 0.01:  # seen as grazing
            wo = np.append(wo[:2] / np.linalg.norm(wo[:2]) * np.sqrt(1 - 1e-4), 0.01)
        wo = np.asarray(wo, np.float32)
        wi = (direction @ axes.T).astype(np.float32)
        value = np.asarray(evaluate(GLOSSY, wi, np.broadcast_to(wo, wi.shape)))
        flux = np.maximum(area @ axes[2], 0) * np.asarray(seen[vertex], np.float64) / 16
        expected.append((flux[:, None] * table * value).sum(0))
    close(reference.integrate(seen, position, frame, GLOSSY, light, EYE, error=CENTERS), np.array(expected))


def test_lights_in_a_batch_equal_one_by_one(mesh, random, close):
    light = some_light(random, 2, 1)
    vertex = np.arange(0, 121, 2)
    together = reference.radiance(mesh, GLOSSY, light, eye=EYE, vertex=vertex, error=CENTERS)
    assert together.shape == (2, 1, len(vertex), 3)
    for i in range(2):
        one = Environment(jnp.asarray(np.asarray(light.radiance)[i, 0]))
        close(together[i, 0], reference.radiance(mesh, GLOSSY, one, eye=EYE, vertex=vertex, error=CENTERS))


@pytest.mark.parametrize("count", [1, 65])
def test_vertices_do_not_depend_on_who_else_is_asked_for(mesh, random, close, count):
    light = some_light(random)
    vertex = random.permutation(121)[:count]
    whole = np.asarray(reference.radiance(mesh, GLOSSY, light, eye=EYE))
    close(reference.radiance(mesh, GLOSSY, light, eye=EYE, vertex=vertex), whole[vertex])


def test_gray_brdfs_and_gray_lights_give_what_their_colors_would(random, close):
    arrays, light = hemisphere(random), some_light(random)
    close(
        reference.integrate(*arrays, Lambert(0.5), light, EYE, error=CENTERS),
        reference.integrate(*arrays, Lambert([0.5, 0.5, 0.5]), light, EYE, error=CENTERS),
    )
    gray = Environment(jnp.asarray(np.asarray(light.radiance)[..., :1]))
    colored = Environment(jnp.asarray(np.repeat(gray.radiance, 3, -1)))
    assert reference.integrate(*arrays, Lambert(0.5), gray, EYE, error=CENTERS).shape == (4, 1)
    close(
        reference.integrate(*arrays, GLOSSY, gray, EYE, error=CENTERS),
        reference.integrate(*arrays, GLOSSY, colored, EYE, error=CENTERS),
    )


@pytest.mark.parametrize("brdf", [Lambert(0.5), PerVertex(Lambert(np.full((122, 1), 0.5, np.float32)))], ids=type)
def test_texels_that_matter_less_than_the_error_have_one_ray_where_the_surface_is_matte(
    mesh, random, monkeypatch, brdf
):
    light, counts = some_light(random), []

    def traced(*argument, **options):
        seen, count = fractional(*argument, **options)
        counts.append(count.supersampled)
        return seen, count

    fractional = visibility.fractional
    monkeypatch.setattr(visibility, "fractional", traced)
    fine, coarse, none = (reference.radiance(mesh, brdf, light, eye=EYE, error=error) for error in (1e-3, 0.04, 10.0))
    fine_count, coarse_count, no_count = np.reshape(counts, (3, -1)).sum(1)
    assert no_count == 0 < coarse_count < 0.8 * fine_count
    assert 0 < np.linalg.norm(coarse - fine) < 0.02 * np.linalg.norm(fine)
    assert np.linalg.norm(coarse - fine) < np.linalg.norm(none - fine)


@pytest.mark.parametrize("brdf", [Lambert(0.5), GLOSSY], ids=["lambert", "glossy"])
def test_a_quarter_turn_of_everything_changes_nothing(mesh, brdf, random, close):
    light = some_light(random)
    turn = np.float32([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    fields = tuple(jnp.asarray(np.asarray(each) @ turn.T) for each in (mesh.position, mesh.normal, mesh.tangent))
    turned = eqx.tree_at(lambda m: (m.position, m.normal, m.tangent), mesh, fields)
    vertex = np.arange(0, 121, 2)
    light_turned, eye = rotate(light, jnp.asarray(turn)), jnp.asarray(turn @ np.asarray(EYE))
    close(
        reference.radiance(turned, brdf, light_turned, eye=eye, vertex=vertex, error=CENTERS),
        reference.radiance(mesh, brdf, light, eye=EYE, vertex=vertex, error=CENTERS),
        tolerance=TURNED,
    )


def test_any_function_of_two_directions_is_a_brdf(mesh, random, close):
    light, model = some_light(random), Lambert([0.2, 0.5, 0.9])
    options = {"eye": EYE, "error": CENTERS}  # as many rays for functions as for a matte model
    expected = reference.radiance(mesh, model, light, **options)
    close(reference.radiance(mesh, lambda wi, wo: model(wi, wo), light, **options), expected)
    close(reference.radiance(mesh, model.__call__, light, **options), expected)


def test_values_without_one_row_per_direction_and_faces_that_are_no_power_of_two_are_refused(mesh, random):
    for value in (lambda wi, wo: wi[..., 2], lambda wi, wo: 0.3, lambda wi, wo: jnp.ones(3)):
        with pytest.raises(ValueError, match=r"the BRDF must return \[384, c\] for 384 directions, got \["):
            reference.radiance(mesh, value, some_light(random), eye=EYE)
    with pytest.raises(ValueError, match="power of two"):
        reference.radiance(mesh, Lambert(0.5), Environment(jnp.ones((6, 6, 6, 3))), eye=EYE)


def test_the_gradient_in_parameters_of_a_brdf_equals_finite_differences(mesh, random):
    light = some_light(random)

    def total(nu):
        brdf = AshikhminShirley(diffuse=0.3, specular=0.5, nu=nu, nv=30)
        return jnp.sum(reference.radiance(mesh, brdf, light, eye=EYE))

    slope = float(jax.grad(total)(20.0))
    assert abs(slope - float(total(20.5) - total(19.5))) < GRADIENT * abs(slope)


def test_an_eye_and_a_light_that_are_not_finite_are_refused(mesh, random):
    light = some_light(random)
    with pytest.raises(ValueError, match="the eye must be finite, got 1 of 3"):
        reference.radiance(mesh, GLOSSY, light, eye=EYE.at[1].set(jnp.nan))
    with pytest.raises(ValueError, match="the light must be finite, got 1152 of 1152"):
        reference.radiance(mesh, GLOSSY, jax.tree.map(lambda x: x * jnp.nan, light), eye=EYE)
