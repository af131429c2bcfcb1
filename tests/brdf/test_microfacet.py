"""GGX and the metallic-roughness material, against formulas in NumPy, Mitsuba and closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate

from jaxprt.brdf import GGX, GGXInterface, Lambert, MetallicRoughness
from jaxprt.brdf.microfacet import values
from tests.upper import albedo, evaluate, highlights, pairs, unit

GOLD = np.array([1.0, 0.78, 0.34])
UP = np.array([0.0, 0, 1])
# Mitsuba's scalar variant computes in float32.
MITSUBA_TOLERANCE = 1e-5


def _dot(a, b):
    return np.sum(a * b, -1)


def _length(*component):
    return np.sqrt(sum(each**2 for each in component))


def _specular(wi, wo, along, across, axis):
    """KHR_materials_anisotropy's D and V, written with vectors as they are there, without its clamp of V to 1."""
    t = np.stack(np.broadcast_arrays(np.cos(axis), np.sin(axis), 0.0 * axis), -1)
    b = np.cross(UP, t)
    h = unit(wi + wo)
    product = along * across
    w2 = product / _length(across * _dot(t, h), along * _dot(b, h), product * h[..., 2]) ** 2
    d = product * w2 * w2 / np.pi
    v = wi[..., 2] * _length(along * _dot(t, wo), across * _dot(b, wo), wo[..., 2])
    v = v + wo[..., 2] * _length(along * _dot(t, wi), across * _dot(b, wi), wi[..., 2])
    return d * 0.5 / v, (1 - np.abs(_dot(wo, h))) ** 5


def _gltf(wi, wo, material):
    """Appendix B's full code with fresnel_mix of KHR_materials_specular, in float64."""
    color, metallic = np.asarray(material.base_color), np.asarray(material.metallic)[..., None]
    alpha, strength = np.asarray(material.roughness) ** 2, np.asarray(material.anisotropy)
    along = alpha * (1 - strength**2) + 1.0 * strength**2
    specular_brdf, fresnel_w = (
        each[..., None] for each in _specular(wi, wo, along, alpha, np.asarray(material.rotation))
    )
    diffuse_brdf = (1 / np.pi) * color
    ior, weight = np.asarray(material.ior)[..., None], np.asarray(material.specular)[..., None]
    f0 = np.minimum(((1 - ior) / (1 + ior)) ** 2 * np.asarray(material.specular_color), 1.0)
    fr = f0 + (1 - f0) * fresnel_w
    dielectric_brdf = (1 - weight * fr.max(-1, keepdims=True)) * diffuse_brdf + weight * fr * specular_brdf
    metal_brdf = (color + (1 - color) * fresnel_w) * specular_brdf
    return (1 - metallic) * dielectric_brdf + metallic * metal_brdf


def _textured(count=500, **fixed):
    """A material of its own for each pair of directions."""
    draw = np.random.default_rng(5).uniform
    material = {
        "base_color": draw(0, 1, (count, 3)),
        "metallic": draw(0, 1, count),
        "roughness": draw(0.1, 1, count),
        "ior": draw(1, 2.5, count),
        "specular": draw(0, 1, count),
        "specular_color": draw(0, 8, (count, 3)),
        "anisotropy": draw(0, 1, count),
        "rotation": draw(-4, 4, count),
    }
    return MetallicRoughness(**(material | fixed))


def test_each_vertex_has_the_material_of_the_gltf_specification(x64, close):
    wi, wo = pairs(500)
    material = jax.tree.map(np.asarray, _textured())
    expected = _gltf(wi, wo, material)
    close(evaluate(material, wi, wo), expected)
    clamped = ((1 - material.ior) / (1 + material.ior))[:, None] ** 2 * material.specular_color > 1
    assert 10 < clamped.sum() < 500  # The clamp of F0 is reached.
    # One material for all pairs, and one per vertex for several pairs each.
    first = jax.tree.map(lambda leaf: leaf[0], material)
    close(evaluate(first, wi[:1], wo[:1]), expected[:1])
    each = jax.tree.map(lambda leaf: leaf[:250, None], material)
    wi, wo = (w.reshape(2, 250, 3).swapaxes(0, 1) for w in (wi, wo))
    close(evaluate(each, wi, wo)[:, 0], expected[:250])


@pytest.mark.parametrize("metallic", [0.0, 0.3, 1.0])
def test_defaults_are_the_core_specification(metallic, x64, close):
    # Appendix B's isotropic D as it stands there, its mix, and F0 = 0.04; V in the height-correlated form.
    wi, wo = pairs(500)
    h, alpha = unit(wi + wo), 0.5**2
    d = alpha**2 / (np.pi * (h[:, 2] ** 2 * (alpha**2 - 1) + 1) ** 2)
    root = [np.sqrt(alpha**2 + (1 - alpha**2) * w[:, 2] ** 2) for w in (wi, wo)]
    v = 0.5 / (wo[:, 2] * root[0] + wi[:, 2] * root[1])
    w = (1 - _dot(wo, h)) ** 5
    specular, fresnel, w = (d * v)[:, None], (0.04 + 0.96 * w)[:, None], w[:, None]
    dielectric = GOLD / np.pi * (1 - fresnel) + specular * fresnel
    metal = specular * (GOLD + (1 - GOLD) * w)
    found = evaluate(MetallicRoughness(GOLD, metallic, 0.5), wi, wo)
    close(found, dielectric * (1 - metallic) + metal * metallic)
    # The published form loses digits for small alpha; here it agrees to rounding.
    if metallic == 1:
        close(evaluate(GGX(GOLD, 0.5), wi, wo), metal)


def test_anisotropic_metal_is_ggx_with_two_alphas(x64, close):
    wi, wo = pairs(500)
    along = np.sqrt(0.3**2 + (1 - 0.3**2) * 0.6**2)
    material = MetallicRoughness(GOLD, 1.0, 0.3, anisotropy=0.6, rotation=0.7)
    expected = evaluate(GGX(GOLD, [along, 0.3], 0.7), wi, wo)
    close(evaluate(material, wi, wo), expected)
    # A quarter turn exchanges the axes, and rotation turns the surface counterclockwise.
    close(evaluate(GGX(GOLD, [0.3, along], 0.7 + np.pi / 2), wi, wo), expected)
    cosine, sine = np.cos(0.7), np.sin(0.7)
    turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    close(evaluate(GGX(GOLD, [along, 0.3], 0.0), wi @ turn, wo @ turn), expected)


def test_fresnel_equals_the_complex_equations(x64, close):
    # Snell's law with a complex index, then the amplitudes; metals, dielectrics, total reflection and eta = 0.
    wi, wo = pairs(500)
    h = unit(wi + wo)
    cosine = _dot(wi, h)[:, None]
    for eta, k in (([0.2, 0.92, 1.1], [3.9, 2.45, 2.14]), (1.5, 0.0), (1 / 1.5, 0.0), (0.0, 1.0), (1.0, 0.0)):
        index = np.asarray(eta) + 1j * np.asarray(k)
        inner = np.sqrt(index**2 - 1 + cosine**2 + 0j)
        s = (cosine - inner) / (cosine + inner)
        p = (index**2 * cosine - inner) / (index**2 * cosine + inner)
        fresnel = (np.abs(s) ** 2 + np.abs(p) ** 2) / 2
        found = evaluate(GGXInterface(eta, k, 0.5), wi, wo)
        close(found, fresnel * np.asarray(evaluate(GGX(1.0, 0.5), wi, wo)))


def test_a_rough_mirror_reflects_one_minus_log_two(x64):
    # With alpha = 1 at normal incidence D = 1 / pi and G = 2 cos / (1 + cos): the integral of c / (1 + c) from 0 to 1.
    assert albedo(GGX(1.0, 1.0), 0.0) == pytest.approx(1 - np.log(2), rel=1e-4)


@pytest.mark.parametrize("roughness", [0.1, 0.5, 0.8])
def test_normal_incidence_reflects_what_one_integral_says(roughness, x64):
    # At normal incidence only the light is masked: the integral of D cos_h G1(2 theta_h) over theta_h up to 45 degrees.
    square = roughness**4

    def reflected(theta):
        c, distribution = np.cos(2 * theta), square / (np.pi * (np.cos(theta) ** 2 * (square - 1) + 1) ** 2)
        masking = 2 * c / (c + np.sqrt(square + (1 - square) * c**2))
        return 2 * np.pi * np.sin(theta) * np.cos(theta) * distribution * masking

    expected = integrate.quad(reflected, 0, np.pi / 4, points=[roughness**2 / 4])[0]
    assert albedo(GGX(1.0, roughness), 0.0) == pytest.approx(expected, rel=2e-4)


@pytest.fixture(scope="module")
def mitsuba():
    import mitsuba

    mitsuba.set_variant("scalar_rgb")
    return mitsuba


COMPLEX = {"type": "rgb", "value": [0.2, 0.92, 1.1]}, {"type": "rgb", "value": [3.9, 2.45, 2.14]}
ALPHAS = {"distribution": "ggx", "alpha_u": 0.36, "alpha_v": 0.09}
MITSUBA = {
    "mirror": ({"type": "roughconductor", "material": "none", **ALPHAS}, GGX(1.0, [0.6, 0.3])),
    "gold": (
        {"type": "roughconductor", "eta": COMPLEX[0], "k": COMPLEX[1], **ALPHAS},
        GGXInterface(COMPLEX[0]["value"], COMPLEX[1]["value"], [0.6, 0.3]),
    ),
    "glass": (
        {"type": "roughdielectric", "int_ior": 1.5, "ext_ior": 1.0, **ALPHAS},
        GGXInterface(1.5, 0.0, [0.6, 0.3]),
    ),
    "principled metal": (
        {"type": "principled", "metallic": 1.0, "roughness": 0.5, "base_color": {"type": "rgb", "value": [*GOLD]}},
        MetallicRoughness(GOLD, 1.0, 0.5),
    ),
}


@pytest.mark.parametrize("name", MITSUBA)
def test_mitsuba_reflects_the_same_but_for_correlated_heights(name, mitsuba):
    # Mitsuba multiplies the masking of both directions, G1 G1'. Its own G1 give G here: 1 / G = 1 / G1 + 1 / G1' - 1.
    description, model = MITSUBA[name]
    theirs, context = mitsuba.load_dict(description), mitsuba.BSDFContext()
    alphas = (0.25, 0.25) if description["type"] == "principled" else (0.36, 0.09)
    facets = mitsuba.MicrofacetDistribution(mitsuba.MicrofacetType.GGX, *alphas, False)
    wi, wo = np.concatenate([highlights(0.3, 60), np.asarray(pairs(60))], 1).astype(np.float32)
    expected = []
    for light, view in zip(wi, wo, strict=True):
        seen = mitsuba.SurfaceInteraction3f()
        seen.wi, half = mitsuba.Vector3f(view.tolist()), mitsuba.Vector3f(unit(light + view).tolist())
        light_masking, view_masking = (facets.smith_g1(mitsuba.Vector3f(w.tolist()), half) for w in (light, view))
        joint = 1 / (1 / light_masking + 1 / view_masking - 1)
        value = np.array(theirs.eval(context, seen, mitsuba.Vector3f(light.tolist()))) / light[2]
        expected.append(value * joint / (light_masking * view_masking))
    found = np.broadcast_to(evaluate(model, wi, wo), (len(wi), 3))
    np.testing.assert_allclose(found, expected, rtol=MITSUBA_TOLERANCE)


def test_the_split_equals_the_whole(x64, close):
    wi, wo = pairs(500)
    material = _textured(roughness=0.3, anisotropy=0.6, rotation=0.7)
    coefficient = np.asarray(material.coefficient())
    assert coefficient.shape == (500, 4, 3)
    assert np.all(coefficient >= 0)
    terms = material.terms()
    split = np.stack([evaluate(term, wi, wo) for term in terms], -2)
    assert split.shape == (500, 4, 1)
    close(np.sum(coefficient * split, -2), _gltf(wi, wo, material))
    # Where the specification has 0.04, with K1 to K3 as above but K1 = 0.96 (1 - w) / pi and K2 = D V (1 - w).
    base, metallic = np.asarray(material.base_color), np.asarray(material.metallic)[:, None]
    plain = MetallicRoughness(base, material.metallic, 0.3, anisotropy=0.6, rotation=0.7)
    under, lobe, rim, _ = np.moveaxis(split, 1, 0)
    expected = base * (1 - metallic) * 0.96 * under + ((1 - metallic) * 0.04 + metallic * base) * (lobe - rim) + rim
    close(evaluate(plain, wi, wo), expected)


def test_lobes_that_differ_in_f0_share_the_rest(x64, close):
    wi, wo = pairs(500)
    terms = _textured(roughness=0.3, anisotropy=0.6, rotation=0.7).terms()

    def together(wi, wo):
        return jnp.concatenate(values(terms, wi, wo), -1)

    apart = [evaluate(term, wi, wo) for term in terms]
    close(jax.jit(together)(wi, wo), np.concatenate(apart, -1))
    base, lobe, *_ = terms
    roots = [str(jax.make_jaxpr(function)(wi, wo)).count("sqrt") for function in (base, lobe, together)]
    assert roots[2] == roots[0] + roots[1] > 0


def test_terms_that_nothing_needs_are_left_out(x64, close):
    assert MetallicRoughness().needed() == (1,)
    assert MetallicRoughness(GOLD).needed() == (1, 2)
    assert MetallicRoughness(GOLD, 0.0).needed() == (0, 1, 2)
    assert MetallicRoughness(GOLD, [0.0, 1.0], specular=[1.0, 0.5]).needed() == (0, 1, 2)
    assert MetallicRoughness(GOLD, [0.5, 1.0], specular=[0.5, 1.0]).needed() == (0, 1, 2, 3)
    assert MetallicRoughness(GOLD, 0.0, specular=0.0).needed() == (3,)
    assert jax.eval_shape(lambda m: jnp.zeros(len(m.needed())), MetallicRoughness()).shape == (4,)
    wi, wo = pairs(500)
    matte = MetallicRoughness(GOLD, 0.0, specular=0.0)
    close(evaluate(matte, wi, wo), evaluate(Lambert(GOLD), wi, wo))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: GGX(roughness=-0.2), "roughness of GGX must be at least 0, got 2 of 2 values"),
        (lambda: GGXInterface(np.nan), "eta of GGXInterface must be finite"),
        (lambda: MetallicRoughness(metallic=1.5), "metallic of MetallicRoughness must be between 0 and 1, got 1 of 1"),
        (
            lambda: MetallicRoughness(metallic=[0, np.nan]),
            "metallic of MetallicRoughness must be between 0 and 1, got 1 of 2 .*nan",
        ),
        (
            lambda: MetallicRoughness(anisotropy=-1),
            "anisotropy of MetallicRoughness must be between 0 and 1, got .* -1",
        ),
        (lambda: MetallicRoughness(np.ones((7, 4))), r"base_color .* must have 1 or 3 channels, got shape \(7, 4\)"),
        (
            lambda: MetallicRoughness(0.5, roughness=[0.1, 0.2]).terms(),
            r"roughness .* must be one number .* shape \[2\]",
        ),
    ],
)
def test_parameters_that_no_surface_has_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_textures_of_different_lengths_are_refused(unchecked):
    with pytest.raises(ValueError, match=r"must broadcast, got base_color \(7,\), metallic \(6,\)"):
        MetallicRoughness(np.ones((7, 3)), np.ones(6))
