"""Relighting with materials that change, against the sum over all texels with the BRDF itself."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt import dynamic, lobe, reference, separable
from jaxprt.brdf import CookTorrance, Lambert, navigation
from jaxprt.scene import Environment, builtin
from jaxprt.scene.mesh import ground_plane, join

pytestmark = pytest.mark.usefixtures("few_samples")
SIZE = 8
EYE = jnp.array([1.2, 1.5, 2.5])
ROUGH = [0.25, 0.4, 0.6]
ALBEDO = jnp.array([0.5, 0.4, 0.3])
# Relative errors: half as much again as measured, which was .0125, .0056 and .0071.
GLOSSY = 0.018
GROUND = 0.0085
TENSOR = 0.0105


@pytest.fixture(scope="module")
def mesh():
    """A ball over the ground."""
    ball = builtin.sphere(rings=8, sectors=10)
    return join([ball, ground_plane(ball, vertices=36)])


@pytest.fixture(scope="module")
def line():
    return navigation.Line(jnp.log(jnp.array(ROUGH)))


@pytest.fixture(scope="module")
def family():
    members = [CookTorrance(diffuse=0.0, specular=1.0, roughness=m, f0=0.3) for m in ROUGH]
    lobes = dynamic.separate(members, separator=lambda each: lobe.tabulate(each, lobes=4, resolution=16))
    return dynamic.factor(members, lobes)


@pytest.fixture(scope="module")
def fixed():
    return separable.factor(Lambert(ALBEDO), terms=1, resolution=4)


@pytest.fixture(scope="module")
def transport(mesh, family, fixed):
    return dynamic.precompute_sets(mesh, [family, fixed], size=SIZE, progress=False)


@pytest.fixture(scope="module")
def light():
    return builtin.daylight(size=SIZE)


def material(line, roughness, diffuse=(0.3, 0.2, 0.1), specular=(0.5, 0.5, 0.4)):
    weight = line.weight(jnp.log(jnp.asarray(roughness)))
    return dynamic.Material(weight, jnp.asarray(diffuse), jnp.asarray(specular))


def by_region(mesh, value, other):
    return np.where((np.asarray(mesh.region) == 0)[:, None], value, other)


def ball_in_view(mesh):
    """Vertices of the ball that the eye sees from above their horizon."""
    facing = np.sum(np.asarray(mesh.normal * (EYE - mesh.position)), 1) > 0
    return facing & (np.asarray(mesh.region) == 0)


def relative(value, exact):
    return float(np.linalg.norm(value - exact) / np.linalg.norm(exact))


@pytest.mark.parametrize("roughness", [0.25, 0.3, 0.4, 0.6])
def test_radiance_is_the_sum_over_all_texels(mesh, transport, family, fixed, line, light, roughness):
    color = dynamic.radiance(transport, [family, fixed], [material(line, roughness), None], light, eye=EYE)
    model = CookTorrance(
        diffuse=jnp.array([0.3, 0.2, 0.1]), specular=jnp.array([0.5, 0.5, 0.4]), roughness=roughness, f0=0.3
    )
    matte = CookTorrance(diffuse=ALBEDO, specular=jnp.zeros(3), roughness=roughness, f0=0.3)  # shares its program
    exact = by_region(
        mesh,
        reference.radiance(mesh, model, light, eye=EYE),
        reference.radiance(mesh, matte, light, eye=EYE),
    )
    ball, ground = ball_in_view(mesh), np.asarray(mesh.region) == 1
    assert relative(np.asarray(color)[ball], exact[ball]) < GLOSSY
    assert relative(np.asarray(color)[ground], exact[ground]) < GROUND


def test_terms_carry_what_there_are_no_lobes_for(mesh, fixed, light):
    """A rough set by its tensor alone."""
    members = [CookTorrance(diffuse=0.0, specular=1.0, roughness=m, f0=0.9) for m in (0.6, 0.8)]
    tensor = dynamic.factor(members, None, ranks=(2, 24, 24), resolution=24)
    transport = dynamic.precompute_sets(mesh, [tensor, fixed], size=SIZE, progress=False)
    assert transport.region[0].seen.pyramid.shape[1] == 6 * SIZE**2 // 8  # Bits alone.
    matter = dynamic.Material(jnp.array([1.0, 0.0]), jnp.zeros(1), jnp.ones(1))
    color = dynamic.radiance(transport, [tensor, fixed], [matter, None], light, eye=EYE)
    ball = ball_in_view(mesh)
    model = CookTorrance(diffuse=jnp.zeros(3), specular=jnp.ones(3), roughness=0.6, f0=0.9)
    exact = np.asarray(reference.radiance(mesh, model, light, eye=EYE))
    assert relative(np.asarray(color)[ball], exact[ball]) < TENSOR


def test_terms_of_the_remainder_change_little(mesh, transport, family, fixed, light):
    """They are by a wavelet transport what lobes leave by their own: the error was 0.83 times that of lobes alone."""
    members = [CookTorrance(diffuse=0.0, specular=1.0, roughness=m, f0=0.3) for m in ROUGH]
    more = dynamic.factor(members, family.lobe, ranks=(3, 12, 12), resolution=16)
    matter = dynamic.Material(jnp.array([0.0, 1.0, 0.0]), jnp.zeros(1), jnp.ones(1))
    ball = ball_in_view(mesh)
    model = CookTorrance(diffuse=jnp.zeros(3), specular=jnp.ones(3), roughness=ROUGH[1], f0=0.3)
    exact = np.asarray(reference.radiance(mesh, model, light, eye=EYE))[ball]
    error = []
    for each, made in (
        (family, transport),
        (more, dynamic.precompute_sets(mesh, [more, fixed], size=SIZE, progress=False)),
    ):
        color = np.asarray(dynamic.radiance(made, [each, fixed], [matter, None], light, eye=EYE))
        error.append(relative(color[ball], exact))
    assert 0.82 * error[0] < error[1] < 1.15 * error[0]


def test_a_texture_on_the_diffuse_part(mesh, transport, family, fixed, line, light):
    texture = np.random.default_rng(0).uniform(size=(len(mesh.position), 3)).astype(np.float32)
    both = [
        dynamic.radiance(transport, [family, fixed], [material(line, 0.4, diffuse), None], light, eye=EYE)
        for diffuse in (texture, np.zeros(3, np.float32), np.ones(3, np.float32))
    ]
    ball = np.asarray(mesh.region) == 0
    textured, black, white = (np.asarray(each)[ball] for each in both)
    np.testing.assert_allclose(textured, black + texture[ball] * (white - black), rtol=1e-5, atol=1e-6)


def test_light_and_weights_are_linear(transport, family, fixed, line, light):
    def color(light, scale):
        matter = material(line, 0.4, scale * np.array([0.3, 0.2, 0.1]), scale * np.array([0.5, 0.5, 0.4]))
        return dynamic.radiance(transport, [family, fixed], [matter, None], light, eye=EYE)

    np.testing.assert_allclose(color(Environment(2 * light.radiance), 1.0), 2 * color(light, 1.0), rtol=1e-5)
    ball = slice(0, 20)
    np.testing.assert_allclose(color(light, 0.5)[ball], 0.5 * color(light, 1.0)[ball], rtol=1e-5)


def test_staged_calls_equal_the_whole(transport, family, fixed, line, light):
    materials = [material(line, 0.3), None]
    lit = dynamic.light_side(transport, light)
    seen = dynamic.view_side(transport, [family, fixed], materials, eye=EYE)
    whole = dynamic.radiance(transport, [family, fixed], materials, light, eye=EYE)
    np.testing.assert_allclose(dynamic.combine(transport, lit, seen), whole, rtol=1e-6)


def test_gradients_by_roughness_and_weight_add_up_to_differences(transport, family, fixed, line, light):
    """`test_contract` holds those by the light, the eye and the weights to finite differences in float64."""
    there = [material(line, 0.6, 0.9 * np.ones(3)), None]
    target = dynamic.radiance(transport, [family, fixed], there, light, eye=EYE)
    lit = dynamic.light_side(transport, light)

    def loss(roughness, weight):
        now = [material(line, roughness, weight * jnp.ones(3)), None]
        color = dynamic.combine(transport, lit, dynamic.view_side(transport, [family, fixed], now, eye=EYE))
        return jnp.mean((color - target) ** 2)

    # Lookups are linear from texel to texel: integrals of derivatives, and not single ones, are differences.
    count = 15
    rough, weight = np.full((2, 2 * count), [[0.33], [0.4]], np.float32)
    rough[:count], weight[count:] = np.linspace(0.26, 0.39, count), np.linspace(0.2, 0.6, count)
    both = jax.value_and_grad(loss, (0, 1))
    found = jax.jit(lambda *way: jax.lax.map(lambda at: both(*at), way))(rough, weight)
    value, slope = jax.tree.map(np.asarray, found)
    for way, along, part in ((rough, slope[0], slice(count)), (weight, slope[1], slice(count, None))):
        whole = value[part][-1] - value[part][0]
        np.testing.assert_allclose(np.trapezoid(along[part], way[part]), whole, rtol=0.05)


def test_a_region_that_does_not_change_has_no_machinery(transport):
    changing, static = transport.region
    assert static.terms.terms == 1
    assert changing.terms.terms == 1  # Lobes, and the diffuse part.
    assert static.seen.pyramid.shape[1] == 6 * SIZE**2 // 8 < changing.seen.pyramid.shape[1]
    assert transport.nbytes == changing.nbytes + static.nbytes


def test_a_stopped_precomputation_goes_on(mesh, family, fixed, transport, light, line, tmp_path):
    for _ in range(2):
        again = dynamic.precompute_sets(mesh, [family, fixed], size=SIZE, path=tmp_path, progress=False)
    materials = [material(line, 0.3), None]
    color, same = (dynamic.radiance(each, [family, fixed], materials, light, eye=EYE) for each in (transport, again))
    np.testing.assert_allclose(color, same, rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t, b, m: (t, b[:1], m), "for each of 2 regions, got 1 and 2"),
        (lambda t, b, m: (t, b, m[:1]), "for each of 2 regions, got 2 and 1"),
        (lambda t, b, m: (t, b, [None, None]), "region 0 needs a material"),
        (lambda t, b, m: (t, b, [m[0], m[0]]), "region 1 has a BRDF that cannot change"),
        (lambda t, b, m: (t, [b[1], b[0]], [None, m[0]]), "must be the one that its transport was made for"),
        (
            lambda t, b, m: (t, [b[0], eqx.tree_at(lambda x: x.light_map, b[1], 2 * b[1].light_map)], m),
            "BRDF of region 1 must be the one that the transport was made for, got another",
        ),
        (
            lambda t, b, m: (t, b, [eqx.tree_at(lambda x: x.weight, m[0], jnp.ones(2)), None]),
            r"of its 3 BRDFs, got \[2\]",
        ),
        (
            lambda t, b, m: (t, b, [eqx.tree_at(lambda x: x.diffuse, m[0], jnp.ones((5, 3))), None]),
            "one of either for each of .* vertices",
        ),
        (lambda t, b, m: (t, b, [eqx.tree_at(lambda x: x.specular, m[0], jnp.ones(2)), None]), "a color "),
    ],
)
def test_what_does_not_fit_is_refused(transport, family, fixed, line, light, change, message):
    with pytest.raises(ValueError, match=message):
        dynamic.radiance(*change(transport, [family, fixed], [material(line, 0.3), None]), light, eye=EYE)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (([3, 3], 0.5, 1), r"weights of region 4 must sum to 1, got \[3. 3.\], whose sum is 6.0"),
        (([0.3, 0.6], 0.5, 1), "weights of region 4 must sum to 1, got "),
        (
            ([2, -1], 0.5, 1),
            r"weights of region 4 must be at least 0, got 1 of 2 values that are not, first at \(1,\): -1",
        ),
        (([np.nan, 1], 0.5, 1), "weights of region 4 must be finite, got 1 of 2 values"),
        (([1, 0], -1, 1), "diffuse of region 4 must be at least 0, got 1 of 1 values"),
        (([1, 0], [0.1, np.inf, 0.2], 1), "diffuse of region 4 must be finite, got 1 of 3 values"),
        (([1, 0], 0.5, -np.ones((3, 1))), "specular of region 4 must be at least 0, got 3 of 3 values"),
        (([1, 0], 0.5, np.nan), "specular of region 4 must be finite, got 1 of 1 values"),
    ],
)
def test_values_that_no_material_has_are_refused_with_the_region_and_the_field(values, message, unchecked):
    with pytest.raises(ValueError, match=message):
        dynamic.set_relight.check_material(4, dynamic.Material(*values), 2, 3)


def test_weights_of_a_navigation_and_traced_materials_pass(unchecked):
    dynamic.set_relight.check_material(0, dynamic.Material([1 / 3 - 2e-6, 2 / 3 + 3e-6, -1e-6], 0, [0.2, 2, 0]), 3, 3)
    plane = navigation.triangulate(np.random.default_rng(0).uniform(size=(5, 2)))
    for spot in np.random.default_rng(1).uniform(-0.5, 1.5, (8, 2)).astype(np.float32):
        dynamic.set_relight.check_material(0, dynamic.Material(plane.weight(spot), 0.5, 0.5), 5, 3)

    def slope(value):
        matter = dynamic.Material(jnp.stack([value, -value]), value, -value)
        dynamic.set_relight.check_material(0, matter, 2, 3)
        return matter.weight[0]

    assert jax.grad(slope)(3.0) == 1


def test_a_light_of_another_size_is_refused(transport):
    with pytest.raises(ValueError, match=r"one environment \[6, 8, 8, c\]"):
        dynamic.light_side(transport, Environment(jnp.ones((6, 16, 16, 3))))


def test_arguments_of_other_kinds_are_refused(transport, family, fixed, line, light, unchecked):
    materials = [material(line, 0.3), None]
    with pytest.raises(ValueError, match=r"the eye must be one position, \[3\], got an array of shape \[2, 3\]"):
        dynamic.view_side(transport, [family, fixed], materials, eye=jnp.ones((2, 3)))
    with pytest.raises(TypeError, match=r"the light must be of class Environment, which .* makes, got"):
        dynamic.light_side(transport, light.radiance)
    with pytest.raises(TypeError, match="the material of region 0 must be a Material, got list"):
        dynamic.view_side(transport, [family, fixed], [[0.3, 0.1], None], eye=EYE)


def test_numbers_and_lists_make_a_material(transport, family, fixed, line, light, unchecked):
    gray, plain = dynamic.Material([0, 1, 0], 0.3, 1), dynamic.Material(jnp.eye(3)[1], jnp.full(3, 0.3), jnp.ones(3))
    color, same = (
        dynamic.radiance(transport, [family, fixed], [each, None], light, eye=EYE.tolist()) for each in (gray, plain)
    )
    np.testing.assert_allclose(color, same, rtol=1e-6)


def test_regions_without_a_brdf_are_refused(mesh, family):
    with pytest.raises(ValueError, match=r"one for each of the regions \[0, 1\], got 1"):
        dynamic.precompute_sets(mesh, [family], size=SIZE, progress=False)
    with pytest.raises(TypeError, match=r"must be made by|Type-check"):
        dynamic.precompute_sets(mesh, [family, Lambert(0.5)], size=SIZE, progress=False)
