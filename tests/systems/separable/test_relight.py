"""Relighting with transport made by hand, and with traced transport under symmetries."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt import separable
from jaxprt.brdf import AshikhminShirley, Lambert
from jaxprt.scene import Environment
from jaxprt.scene.environment import rotate
from jaxprt.sphere import haar
from jaxprt.systems.separable import SeparableBrdf, SparseTransport, factor, join, precompute
from jaxprt.systems.separable.factorization import marked
from jaxprt.systems.separable.quantized import dequantize, quantize
from jaxprt.systems.separable.wavelets import compress

SIZE = 8
EYE = jnp.array([2.0, 3.0, 4.0])
TURNED = 1e-4  # Rays along rotated directions meet edges on either side by rounding.
RIM = 1e-4  # A texel's center may lie below the horizon where its mean direction does not: .00002 in all.
COLORED = AshikhminShirley(diffuse=[0.6, 0.2, 0.1], specular=[0.2, 0.3, 0.7], nu=20, nv=60)


@pytest.fixture
def random():
    return np.random.default_rng(5)


@pytest.fixture(scope="module")
def factored():
    return factor(COLORED, terms=3, resolution=12)


@pytest.fixture(scope="module")
def transport(factored):
    """Of seven vertices with random frames and visibility."""
    random = np.random.default_rng(4)
    frame, _ = np.linalg.qr(random.normal(size=(7, 3, 3)))
    frame = array(frame * np.linalg.det(frame)[:, None, None])
    seen = jnp.asarray(random.integers(17, size=(7, 6 * SIZE**2)), jnp.uint8)
    index, value = compress(seen, frame, factored, keep=40)
    position = array(random.normal(size=(7, 3)))
    return SparseTransport(index, value, position, frame, separable.sparse.rms(index, value, 6 * SIZE**2))


def array(value):
    """Values of NumPy in float32; operations of JAX outside of `jit` would be a program each."""
    return jnp.asarray(np.asarray(value), jnp.float32)


def some_light(random, colors=3):
    return Environment(array(random.uniform(0, 2, size=(6, SIZE, SIZE, colors))))


def white_light(*shape):
    return Environment(array(np.ones(shape or (6, SIZE, SIZE, 3))))


def unit(random):
    """Forty unit vectors."""
    vector = random.normal(size=(40, 3))
    return array(vector / np.linalg.norm(vector, axis=1, keepdims=True))


def grounded(*, shift=(0.0, 0.0, 0.0)):
    """A sphere and a ground that shadow each other, 26 vertices."""
    ground, ball = prt.scene.builtin.plane(cells=3), prt.scene.builtin.sphere(rings=3, sectors=4)
    position = np.concatenate([ball.position, 2 * np.asarray(ground.position) - 1]) + np.asarray(shift, np.float32)
    mesh = prt.scene.mesh.join([ball, ground])
    return eqx.tree_at(lambda m: m.position, mesh, array(position))


def relight(transport, factored, light, **options):
    return separable.radiance(transport, factored, light, **({"eye": EYE} | options))


def test_gray_light_serves_a_brdf_in_color(transport, factored, close, random):
    gray = some_light(random, colors=1)
    color = Environment(array(np.repeat(gray.radiance, 3, axis=-1)))
    close(relight(transport, factored, gray), relight(transport, factored, color))


def test_the_distance_of_the_eye_does_not_matter(transport, factored, close, random):
    light = some_light(random)
    one = eqx.tree_at(lambda t: t.position, transport, array(np.zeros((7, 3))))
    expected = relight(one, factored, light)
    for distance in (1e-30, 1e-3, 1e3, 1e12, 1e20, 1e30):
        close(relight(one, factored, light, eye=array(distance * np.asarray(EYE))), expected)


def test_light_tuple_times_view_tuple_is_radiance(transport, factored, close, random):
    light = some_light(random)
    lit, view = separable.light_tuple(transport, light), separable.view_tuple(transport, factored, EYE)
    assert lit.shape == view.shape == (7, 3, 3)
    close(separable.combine(lit, view), relight(transport, factored, light))
    close(np.sum(np.asarray(lit) * np.asarray(view), 1), relight(transport, factored, light))


def test_view_tuples_are_the_view_maps_at_the_direction_to_the_eye(transport, factored, close):
    offset = np.asarray(EYE, np.float64) - np.asarray(transport.position, np.float64)
    local = np.einsum("vij,vj->vi", transport.frame, offset / np.linalg.norm(offset, axis=1, keepdims=True))
    above = local[:, 2] > 0.01
    expected = np.asarray(factored.view(array(local)))
    close(np.asarray(separable.view_tuple(transport, factored, EYE))[above], expected[above])


def test_projection_keeps_energy_and_transforms_each_face_by_itself(random, close):
    light = some_light(random)
    coefficient = np.asarray(separable.project(light))
    close(np.sum(coefficient**2), np.sum(np.asarray(light.radiance) ** 2))
    only = np.asarray(light.radiance) * (np.arange(6) == 3)[:, None, None, None]
    face = np.asarray(separable.project(Environment(array(only)))).reshape(6, -1, 3)
    close(face[3], coefficient.reshape(6, -1, 3)[3])
    assert not np.delete(face, 3, axis=0).any()


def test_dropped_coefficients_of_the_light_have_no_part_in_the_gradient(transport, factored, random):
    light = some_light(random)
    gradient = jax.grad(lambda e: jnp.sum(relight(transport, factored, e, light_keep=9)))(light)
    coefficient = np.asarray(separable.project(gradient))
    assert np.count_nonzero(np.abs(coefficient).max(1) > 1e-4 * np.abs(coefficient).max()) <= 9


def coefficients(random):
    value = random.normal(size=(6 * SIZE**2, 3)) * random.uniform(size=(6 * SIZE**2, 1)) ** 4
    return array(value)


def kept(coefficient, chosen):
    """Rows that were kept, after a check that they are unchanged and all others are zero."""
    chosen = np.asarray(chosen)
    assert not chosen[chosen != np.asarray(coefficient)].any()
    return np.flatnonzero(chosen.any(1))


@pytest.mark.parametrize("count", [1, 17, 384])
def test_choosing_by_transport_keeps_the_largest_products_with_its_rms(random, count):
    coefficient, rms = coefficients(random), array(random.uniform(0.1, 1, size=384))
    chosen = separable.choose_by_transport(coefficient, rms, count=count)
    order = np.argsort(-np.linalg.norm(np.asarray(coefficient, np.float64), axis=1) * np.asarray(rms, np.float64))
    np.testing.assert_array_equal(kept(coefficient, chosen), np.sort(order[:count]))


@pytest.mark.parametrize("count", [1, 17, 384])
def test_choosing_by_area_keeps_the_largest_products_with_it(random, count):
    coefficient = coefficients(random)
    chosen = separable.choose_by_area(coefficient, count=count)
    # What a basis function covers, from the function itself.
    impulse = haar.inverse(array(np.eye(SIZE**2).reshape(SIZE**2, SIZE, SIZE, 1)))
    area = np.tile(np.mean(np.abs(np.asarray(impulse)) > 1e-6, axis=(1, 2, 3)), 6)
    weight = np.linalg.norm(np.asarray(coefficient, np.float64), axis=1) * area
    np.testing.assert_array_equal(kept(coefficient, chosen), np.sort(np.argsort(-weight)[:count]))


def test_choosing_by_magnitude_drops_each_color_below_the_threshold(random):
    coefficient = array(np.asarray(coefficients(random)) * [1.0, 10.0, 0.0])
    chosen = np.asarray(separable.choose_by_magnitude(coefficient, threshold=1024))
    size = np.abs(np.asarray(coefficient, np.float64))
    level = np.round(size / size.max(0).clip(1e-30) * 32767)
    np.testing.assert_array_equal(chosen, np.where(level >= 1024, coefficient, 0))
    assert 1 < np.count_nonzero(chosen[:, 0]) < 384
    np.testing.assert_array_equal(separable.choose_by_magnitude(coefficient, threshold=0), coefficient)
    # A threshold is relative: it does not know the light's units.
    larger = array(np.asarray(coefficient) * 1024)
    np.testing.assert_array_equal(separable.choose_by_magnitude(larger, threshold=1024), chosen * 1024)


def test_quantizing_rounds_each_color_to_multiples_of_its_largest(random, close):
    coefficient = array(np.asarray(coefficients(random)) * [1.0, 1e6, 0.0])
    wide = np.asarray(coefficient, np.float64)
    quantum = np.abs(wide).max(0) / 32767
    rounded = np.asarray(separable.quantize(coefficient), np.float64)
    level = rounded[:, :2] / quantum[:2]
    np.testing.assert_allclose(level, np.round(level), atol=0.004)
    assert np.all(np.abs(rounded - wide)[:, :2].max(0) > 0.4 * quantum[:2])
    assert np.all(np.abs(rounded - wide) <= 0.504 * quantum)
    assert not rounded[:, 2].any()
    close(separable.quantize(rounded.astype(np.float32)), rounded)
    # Twice the light is twice the levels' worth: a quantum is relative.
    larger = array(np.asarray(coefficient) * 1024)
    np.testing.assert_array_equal(separable.quantize(larger), np.asarray(separable.quantize(coefficient)) * 1024)


def test_choosing_as_many_as_there_are_drops_none(transport, factored, close, random):
    light = some_light(random)
    expected = relight(transport, factored, light)
    np.testing.assert_array_equal(relight(transport, factored, light, light_keep=384), expected)
    # Nor does it matter to drop what no vertex keeps.
    used = int(np.count_nonzero(np.asarray(transport.rms)))
    close(relight(transport, factored, light, light_keep=used), expected)


def test_the_error_falls_with_the_number_of_coefficients_of_the_light(transport, factored, random):
    light = some_light(random)
    whole, *fewer = (np.asarray(relight(transport, factored, light, light_keep=k)) for k in (384, 6, 30, 100, 200))
    error = [np.linalg.norm(color - whole) for color in fewer]
    assert error[0] > error[1] > error[2] > error[3]


@pytest.mark.parametrize("count", [0, 385, -1])
def test_impossible_numbers_to_choose_are_refused(transport, random, count):
    coefficient = coefficients(random)
    with pytest.raises(ValueError, match=f"count must be between 1 and 384, got {count}"):
        separable.choose_by_transport(coefficient, array(np.ones(384)), count=count)
    with pytest.raises(ValueError, match=f"count must be between 1 and 384, got {count}"):
        separable.choose_by_area(coefficient, count=count)
    with pytest.raises(ValueError, match=f"count must be between 1 and 384, got {count}"):
        separable.light_tuple(transport, some_light(random), light_keep=count)


def test_lights_of_another_size_are_refused(transport, factored):
    message = r"the light must be one environment \[6, 8, 8, c\], got \[6, 4, 4, 3\]"
    with pytest.raises(ValueError, match=message):
        relight(transport, factored, white_light(6, 4, 4, 3))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("shape", [(5, 8, 8, 3), (7, 8, 8, 3), (6, 8, 4, 3), (6, 4, 8, 3), (2, 6, 8, 8, 3), (384, 3)])
def test_only_one_light_of_six_square_faces_is_taken(transport, factored, shape):
    needed = r"(must be one environment \[6, (8, 8|n, n), c\]|'s radiance must be \[\.\.\., 6, n, n, c\]), got"
    with pytest.raises(ValueError, match="the light ?" + needed):
        relight(transport, factored, white_light(*shape))


def test_transport_in_whole_numbers_relights_like_transport_in_floating_point(transport, factored, close, random):
    light, whole = some_light(random), quantize(transport)
    # Rounding to 32,767 levels of the largest coefficient of each row.
    close(relight(whole, factored, light), relight(transport, factored, light), tolerance=1e-4)
    close(
        relight(whole, factored, light, light_keep=30),
        relight(transport, factored, light, light_keep=30),
        tolerance=1e-4,
    )
    with pytest.raises(ValueError, match="the BRDF must have the transport's 3 terms, got 2"):
        relight(whole, factored.truncate(2), light)


@pytest.fixture(scope="module")
def basis():
    """Three BRDFs on maps of one kind, of 1, 3 and 2 terms."""
    sharp = AshikhminShirley(diffuse=0.0, specular=0.4, nu=30, nv=30)
    models = ((Lambert(1.0), 1), (COLORED, 3), (sharp, 2))
    return [factor(model, terms=terms, resolution=12) for model, terms in models]


TERMS = (1, 3, 2)


def test_joined_brdfs_are_the_sum_of_their_parts(basis, random, close):
    wi, wo = unit(random), unit(random)
    joined = join(basis)
    assert joined.terms == sum(TERMS)
    assert joined.coordinates is basis[0].coordinates
    close(joined(wi, wo), sum(np.asarray(each(wi, wo)) for each in basis))
    close(join(basis[1:2])(wi, wo), basis[1](wi, wo))


def test_two_lamberts_joined_are_the_lambert_of_their_summed_albedos(random, close):
    wi, wo = unit(random), unit(random)
    parts = [factor(Lambert(albedo), terms=1, resolution=12) for albedo in ([0.1, 0.2, 0.3], [0.25] * 3)]
    expected = np.array([0.35, 0.45, 0.55]) / np.pi * ((np.asarray(wi)[:, 2:] > 0) & (np.asarray(wo)[:, 2:] > 0))
    close(join(parts)(wi, wo), expected, tolerance=1e-4)  # One term of a factorization in float32.


def test_brdfs_on_other_maps_are_not_joined(basis):
    maps, error = (basis[1].light_map, basis[1].view_map), array(0.0)
    smaller = (array(np.asarray(each)[:, :10, :10]) for each in maps)
    for other in (SeparableBrdf(*smaller, error), SeparableBrdf(*maps, error)):
        with pytest.raises(
            ValueError, match="brdfs must be at least one, all with maps of the same resolution and coordinates, got"
        ):
            join([basis[0], other])
    with pytest.raises(ValueError, match="got none"):
        join([])


@pytest.fixture(scope="module")
def spotted(basis):
    """A mesh that shadows itself, its vertices' own weights of the basis, and their radiance by each BRDF alone."""
    mesh = grounded()
    random = np.random.default_rng(8)
    weight = array(random.uniform(0, 1, size=(len(mesh.position), 3, 3)))
    light = some_light(random)
    alone = [precompute(mesh, each, keep=6 * SIZE**2, size=SIZE, progress=False) for each in basis]
    part = [np.asarray(relight(own, each, light), np.float64) for own, each in zip(alone, basis, strict=True)]
    return mesh, weight, light, sum(np.asarray(weight)[:, n] * each for n, each in enumerate(part))


def modulated(transport, brdf, light, weight, terms=TERMS):
    view = separable.modulate(separable.view_tuple(transport, brdf, EYE), weight, terms=terms)
    return separable.combine(separable.light_tuple(transport, light), view)


def test_weights_per_vertex_give_every_vertex_its_own_brdf(basis, spotted, close):
    mesh, weight, light, expected = spotted
    joined = join(basis)
    transport = precompute(mesh, joined, keep=6 * SIZE**2, size=SIZE, progress=False)
    assert np.count_nonzero(expected.any(1)) > 9
    close(modulated(transport, joined, light, weight), expected, tolerance=RIM)
    # Equal weights are a BRDF for all; a single one is that BRDF alone.
    ones = array(np.ones(weight.shape))
    close(modulated(transport, joined, light, ones), relight(transport, joined, light))
    one = precompute(mesh, basis[1], keep=6 * SIZE**2, size=SIZE, progress=False)
    alone = array(np.asarray(ones) * (np.arange(3) == 1)[:, None])
    close(modulated(transport, joined, light, alone), relight(one, basis[1], light))
    # Linear, hence the derivative along any change is the radiance of that change.
    change = array(np.random.default_rng(3).normal(size=weight.shape))
    _, slope = jax.jvp(lambda w: modulated(transport, joined, light, w), (weight,), (change,))
    close(slope, modulated(transport, joined, light, change))


def test_a_texture_on_one_brdf_multiplies_the_radiance(transport, factored, close, random):
    light, texture = some_light(random), random.uniform(size=(7, 1, 3)).astype(np.float32)
    plain = np.asarray(relight(transport, factored, light))
    close(modulated(transport, factored, light, array(texture), (3,)), plain * texture[:, 0])
    # A gray texture, and gray view maps under a texture in color.
    gray = texture[..., :1]
    close(modulated(transport, factored, light, array(gray), (3,)), plain * gray[:, 0])
    single = eqx.tree_at(lambda b: b.view_map, factored, array(np.asarray(factored.view_map)[..., :1]))
    plain = np.asarray(relight(transport, single, light))
    close(modulated(transport, single, light, array(texture), (3,)), plain * texture[:, 0])


@pytest.mark.parametrize("terms", [(3,), (1, 1), (2, 2), (1, 1, 1)])
def test_weights_that_do_not_fit_the_terms_are_refused(terms):
    with pytest.raises(ValueError, match="terms must hold one number for each of 2 weights and sum to the 3 terms"):
        separable.modulate(array(np.ones((7, 3, 3))), array(np.ones((7, 2, 1))), terms=terms)


def test_brdfs_with_another_number_of_terms_are_refused(transport, factored):
    with pytest.raises(ValueError, match="the BRDF must have the transport's 3 terms, got 2"):
        relight(transport, factored.truncate(2), white_light())


@pytest.mark.parametrize("brdf", [Lambert([0.2, 0.5, 0.9]), COLORED], ids=["lambert", "glossy"])
def test_a_quarter_turn_of_everything_changes_nothing(brdf, random, close):
    mesh = grounded(shift=(0.1, 1.2, 0.2))
    factored = factor(brdf, terms=1 if isinstance(brdf, Lambert) else 3, resolution=12)
    light = some_light(random)
    turn = jnp.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])

    def of(mesh, light, eye):
        # All coefficients: wavelets of a turned face are other wavelets, their span is the same.
        transport = precompute(mesh, factored, keep=6 * SIZE**2, size=SIZE, progress=False)
        return relight(transport, factored, light, eye=eye)

    turned = eqx.tree_at(
        lambda m: (m.position, m.normal, m.tangent),
        mesh,
        tuple(array(np.asarray(each) @ np.asarray(turn).T) for each in (mesh.position, mesh.normal, mesh.tangent)),
    )
    close(
        of(turned, rotate(light, turn), array(np.asarray(turn) @ np.asarray(EYE))),
        of(mesh, light, EYE),
        tolerance=TURNED,
    )


def test_transport_refuses_factors_that_it_was_not_made_of_wherever_values_are_known(transport, factored, random):
    known = eqx.tree_at(
        lambda t: t.mark, transport, jnp.asarray(marked(factored.light_map)), is_leaf=lambda x: x is None
    )
    light = some_light(random)
    expected = relight(transport, factored, light)
    maps = np.asarray(factored.light_map)
    rounded, turned = (
        eqx.tree_at(lambda b: b.light_map, factored, array(each))
        for each in (np.nextafter(maps, np.float32(np.inf)), maps * np.array([1, -1, 1])[:, None, None, None])
    )
    wrong = [turned, factor(Lambert(0.5), terms=3, resolution=12), join([factored.truncate(1), factored.truncate(2)])]
    for each in (known, dequantize(quantize(known)), quantize(known), known.with_transpose(), known.truncate(40)):
        assert each.mark is not None
        for right in (factored, rounded):
            np.testing.assert_allclose(relight(each, right, light), expected, rtol=0.1, atol=0.1)
        for other in wrong:
            with pytest.raises(ValueError, match=r"the BRDF must be the one that .* differ from the transport's by \d"):
                relight(each, other, light)
            with pytest.raises(ValueError, match="the BRDF must be the one that"):
                separable.view_tuple(each, other, EYE)
    np.testing.assert_array_equal(
        relight(known.truncate(40, terms=2), factored.truncate(2), light).shape, expected.shape
    )
    traced = jax.jit(lambda brdf: relight(known, brdf, light))(turned)
    np.testing.assert_array_equal(traced.shape, expected.shape)
    slope = jax.grad(lambda value: jnp.sum(relight(eqx.tree_at(lambda t: t.value, known, value), factored, light)))
    assert np.isfinite(slope(known.value)).all()
