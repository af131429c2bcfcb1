"""Clear coats, sheens and transmission: the texts of the extensions, tables against the BRDF, and relit scenes."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt.brdf import Charlie, ClearCoat, MetallicRoughness, Sheen, sheen_albedo
from jaxprt.relit import channels, paths
from jaxprt.scene import Part, Scene, Texture, TexturedMaterial, builtin, material_table
from jaxprt.scene.mesh import make_mesh
from jaxprt.sphere import cubemap
from jaxprt.systems import bounces, standard
from jaxprt.systems.protocol import Blend
from jaxprt.view.reduced import PageScene

# Errors of the table of albedos of sheens: for views above three degrees over the horizon, and for views below.
ALBEDO, ALBEDO_AT_HORIZON = 0.004, 0.009
TABLE = 0.03  # error of 12 and 12 lobes, of light of medium width
EYE = np.array([0.0, 0.0, 5.0])
COATED = TexturedMaterial([0.6, 0.1, 0.1], 0.0, 0.5, clearcoat=0.8, clearcoat_roughness=0.2)
VELVET = TexturedMaterial([0.3, 0.03, 0.08], 0.0, 0.8, sheen_color=[0.9, 0.6, 0.7], sheen_roughness=0.5)


def upper(count: int, seed: int) -> np.ndarray:
    way = np.random.default_rng(seed).normal(size=(count, 3))
    way[:, 2] = np.abs(way[:, 2])
    return way / np.linalg.norm(way, axis=1, keepdims=True)


@jax.jit
def evaluated(brdf, wi, wo):
    """Values of a BRDF, by one program."""
    return brdf(wi, wo)


def test_a_coat_is_that_of_the_text_of_the_extension():
    """KHR_materials_clearcoat: mix(base, coat, clearcoat F), F by Schlick from n.v; the coat is the D V of glTF 2.0."""
    wi, wo = upper(50, 0), upper(50, 1)
    base, weight, rough = MetallicRoughness(jnp.asarray([0.8, 0.4, 0.2]), 0.3, 0.7), 0.6, 0.35
    half = (wi + wo) / np.linalg.norm(wi + wo, axis=1, keepdims=True)
    alpha2 = rough**4
    d = alpha2 / (np.pi * ((half[:, 2] ** 2) * (alpha2 - 1) + 1) ** 2)
    cos_i, cos_o = wi[:, 2], wo[:, 2]
    v = 0.5 / (cos_i * np.sqrt(alpha2 + (1 - alpha2) * cos_o**2) + cos_o * np.sqrt(alpha2 + (1 - alpha2) * cos_i**2))
    fresnel = weight * (0.04 + 0.96 * (1 - cos_o) ** 5)
    below = np.asarray(evaluated(base, wi, wo))
    expected = (1 - fresnel)[:, None] * below + (fresnel * d * v)[:, None]
    got = evaluated(ClearCoat(base, weight, rough), wi, wo)
    np.testing.assert_allclose(got, expected, rtol=2e-4)
    with pytest.raises(ValueError, match="clearcoat of ClearCoat must be"):
        ClearCoat(base, 1.5, rough)


def masking(x: np.ndarray, alpha: float) -> np.ndarray:
    """The extension's lambdaSheen."""
    mix = (1 - alpha) ** 2
    pairs = ((21.5473, 25.3245), (3.82987, 3.32435), (0.19823, 0.16801), (-1.9776, -1.27393), (-4.32054, -4.85967))
    a, b, c, d, e = (first + (second - first) * mix for first, second in pairs)

    def inner(x):
        return a / (1 + b * x**c) + d * x + e

    return np.where(x < 0.5, np.exp(inner(x)), np.exp(2 * inner(0.5) - inner(1 - x)))


def fibers(wi: np.ndarray, wo: np.ndarray, roughness: float) -> np.ndarray:
    """The extension's sheenDistribution times sheenVisibility."""
    alpha = roughness**2
    half = (wi + wo) / np.linalg.norm(wi + wo, axis=-1, keepdims=True)
    d = (2 + 1 / alpha) * (1 - half[..., 2] ** 2) ** (0.5 / alpha) / (2 * np.pi)
    cos_i, cos_o = wi[..., 2], wo[..., 2]
    return d / ((1 + masking(cos_o, alpha) + masking(cos_i, alpha)) * 4 * cos_o * cos_i)


@pytest.mark.parametrize("roughness", [0.15, 0.5, 1.0])
def test_a_sheen_is_that_of_the_text_of_the_extension(roughness):
    """KHR_materials_sheen: f_sheen + f_base (1 - max3(sheenColor) E(VdotN)), with E by quadrature."""
    wi, wo = upper(50, 0), upper(50, 1)
    wo[0] = [np.sqrt(1 - 0.06**2), 0, 0.06]
    base, color = MetallicRoughness(jnp.asarray([0.8, 0.4, 0.2]), 0.3, 0.7), np.array([0.2, 0.9, 0.5])
    middle, share = np.polynomial.legendre.leggauss(400)
    cosine, turn = ((middle + 1) / 2)[:, None] ** 2, np.linspace(0, 2 * np.pi, 400, endpoint=False)
    sine = np.sqrt(1 - cosine**2)
    each = np.stack(np.broadcast_arrays(sine * np.cos(turn), sine * np.sin(turn), cosine), -1)
    area = share * (middle + 1) / 2 * cosine[:, 0] * 2 * np.pi
    albedo = np.array([area @ fibers(each, view, roughness).mean(1) for view in wo])
    error = np.abs(np.asarray(sheen_albedo(wo[:, 2], roughness)) - np.minimum(albedo, 1))
    low = wo[:, 2] < 0.05
    assert error[~low].max() < ALBEDO
    assert error[low].max() < ALBEDO_AT_HORIZON
    value = fibers(wi, wo, roughness)[:, None]
    np.testing.assert_allclose(evaluated(Charlie(roughness), wi, wo), value, rtol=2e-4, atol=1e-7)
    kept = 1 - color.max() * np.asarray(sheen_albedo(wo[:, 2], roughness))
    expected = kept[:, None] * np.asarray(evaluated(base, wi, wo)) + color * value
    np.testing.assert_allclose(evaluated(Sheen(base, color, roughness), wi, wo), expected, rtol=2e-4)
    with pytest.raises(ValueError, match="sheen_color of Sheen must be"):
        Sheen(base, 1.5 * color, roughness)


BASE = MetallicRoughness(jnp.asarray([0.8, 0.3, 0.2]), 1.0, 0.5)
LAYERS = {
    "coat": (standard.COATED, 0.15, 0.7, np.full(3, 0.7), ClearCoat(BASE, 0.7, 0.15)),
    "sheen": (standard.SHEENED, 0.35, 0.8, np.array([0.8, 0.5, 0.6]), Sheen(BASE, [0.8, 0.5, 0.6], 0.35)),
}


@pytest.mark.parametrize("name", LAYERS)
def test_tables_of_materials_under_layers_are_the_brdf(name):
    table, roughness, share, above, brdf = LAYERS[name]
    wi, area = (
        np.asarray(each).reshape(6 * 32 * 32, -1) for each in (cubemap.direction(size=32), cubemap.solid_angle(size=32))
    )
    wi, area = wi[wi[:, 2] > 0], area[wi[:, 2] > 0, 0]
    middle = upper(6, 2)
    light = np.exp(np.array([3, 10, 30, 5, 20, 60]) * (wi @ middle.T - 1)) * area[:, None]
    term = np.asarray(BASE.coefficient())
    weight = np.concatenate([(1 - share) * term, share * term, above[None]]) / table.scale[:, None]
    log_base, log_layer = np.log(np.float32([0.5, roughness]))
    made, wi = table.lobes(12), jnp.asarray(wi)

    @jax.jit
    def both(wo):
        lobes = made.lookup(wo, jnp.asarray([log_base]), jnp.asarray([log_layer]))
        wide = [jnp.broadcast_to(each, (*each.shape[:-1], len(wi))) for each in vars(lobes).values()]
        return type(lobes)(*wide).evaluate(wi), brdf(wi, jnp.broadcast_to(wo, wi.shape)) * wi[:, 2:]

    for angle in (0.1, 0.6, 1.1, 1.4):
        value, exact = map(np.asarray, both(jnp.float32([[np.sin(angle), 0, np.cos(angle)]])))
        assert np.linalg.norm(light.T @ (value.T @ weight - exact)) < TABLE * np.linalg.norm(light.T @ exact)


@pytest.mark.parametrize("table", [standard.COATED, standard.SHEENED], ids=["coat", "sheen"])
def test_other_parts_receive_the_light_that_a_layer_reflects(table):
    """The albedo of the functions of light paths is that of the BRDF of each channel."""
    brdf, sent = table.paths()
    value = np.asarray(bounces.functions.albedo(brdf))
    place = jnp.log(jnp.asarray([0.5])), jnp.log(jnp.asarray([0.4]))
    found = value @ np.asarray(sent.weights(Blend(jnp.eye(9)[None], place)))[0]
    exact = paths.channels(table.family(place[0][0], place[1][0]))
    rim = 6  # under the layer: it is bright where the layer takes most, and the mean of the product is smaller
    np.testing.assert_allclose(np.delete(found, rim), np.delete(exact, rim), rtol=0.035)
    assert 1 < found[rim] / exact[rim] < 1.25


def test_harmonics_of_coated_materials_are_those_of_base_and_coat():
    tangent = 20 / standard.METALLIC_ROUGHNESS.harmonics(4).steps  # of half the angle of a view node
    cosine = (1 - tangent**2) / (1 + tangent**2)
    wo = jnp.asarray([[np.sqrt(1 - cosine**2), 0, cosine]], jnp.float32)
    log_base, log_layer = jnp.log(jnp.asarray([0.5])), jnp.log(jnp.asarray([0.15]))
    ours = np.asarray(standard.COATED.harmonics(4).coefficients(wo, log_base, log_layer))
    base, coat = (standard.METALLIC_ROUGHNESS.harmonics(4).coefficients(wo, each) for each in (log_base, log_layer))
    share = 0.04 + 0.96 * (1 - cosine) ** 5
    expected = np.concatenate([base, (1 - share) * base, share * coat[:, 1:2]], 1)
    np.testing.assert_allclose(ours, expected, atol=1e-5 * np.abs(expected).max())
    ours = np.asarray(standard.SHEENED.harmonics(4).coefficients(wo, log_base, log_layer))
    share = np.asarray(sheen_albedo(np.asarray(wo[:, 2]), 0.15))
    velvet = standard.SHEEN.harmonics(4).coefficients(wo, log_layer)
    np.testing.assert_allclose(ours[:, :4], base, atol=1e-5 * np.abs(expected).max())
    np.testing.assert_allclose(ours[:, 4:8], (1 - share) * base, atol=4e-4 * np.abs(base).max())
    np.testing.assert_allclose(ours[:, 8:], velvet, atol=1e-5)


def spheres(*materials: TexturedMaterial) -> Scene:
    ball = builtin.sphere(rings=6, sectors=8)
    place = np.random.default_rng(0).uniform(0, 1, (len(ball.position), 2))
    parts = [
        Part(f"ball {n}", make_mesh(np.asarray(ball.position) + [3 * n, 0, 0], ball.face, texture=place), material)
        for n, material in enumerate(materials)
    ]
    return Scene(parts)


MATERIALS = {
    "coat": COATED,
    "green": TexturedMaterial([0.2, 0.5, 0.3], 0.0, 0.5),
    "velvet": VELVET,
    "bare velvet": dataclasses.replace(VELVET, sheen_color=jnp.zeros(3)),
}


@functools.cache
def precomputed(*names: str) -> prt.RelitScene:
    scene = spheres(*(MATERIALS[name] for name in names))
    return prt.precompute(scene, refine=False, system=prt.relit.Lobes(12), size=16, progress=False)


def test_layers_cost_nothing_where_no_material_has_them():
    plain = material_table.of_parts(spheres(TexturedMaterial(0.5, 0.0, 0.4)).parts)
    assert (plain.layered, plain.image.shape[1], plain.factor.shape[1]) == (False, len(material_table.TEXTURES), 17)
    look = plain.at_vertices()
    assert look.coefficient.shape[1] == 4
    assert look.log_layer is None
    scene = spheres(COATED, dataclasses.replace(COATED, clearcoat=0.0))
    coated, bare = (channels.of_part(part) for part in scene.parts)
    assert coated.table is standard.COATED
    assert bare.table is standard.METALLIC_ROUGHNESS


def test_textures_of_sheens_multiply_their_factors():
    image = np.random.default_rng(0).uniform(0.1, 1, (1, 1, 3)).astype(np.float32)
    textures = {"sheen_color_texture": Texture(image), "sheen_roughness_texture": Texture(image[..., :1])}
    parts = spheres(dataclasses.replace(VELVET, **textures), COATED, TexturedMaterial(0.5, 0.0, 0.4)).parts
    count, color = len(parts[0].mesh.position), image[0, 0] * np.asarray(VELVET.sheen_color)
    look = material_table.of_parts(parts).at_vertices()
    bare = material_table.of_parts(spheres(dataclasses.replace(VELVET, sheen_color=jnp.zeros(3))).parts).at_vertices()
    np.testing.assert_allclose(look.coefficient[:count, 13], np.broadcast_to(color, (count, 3)), rtol=1e-5)
    np.testing.assert_allclose(
        look.coefficient[:count, 9:13], color.max() * bare.coefficient[:count], rtol=1e-4, atol=1e-7
    )
    np.testing.assert_allclose(np.exp(look.log_layer[:count]), max(0.5 * image[0, 0, 0], 0.1), rtol=1e-5)
    np.testing.assert_allclose(look.coefficient[count : 2 * count, 8], 0.8, rtol=1e-5)
    np.testing.assert_allclose(np.exp(look.log_layer[count : 2 * count]), 0.2, rtol=1e-5)
    assert not look.coefficient[2 * count :][:count, 4:].any()


def test_textures_of_layers_multiply_their_factors():
    image = np.random.default_rng(0).uniform(0.1, 1, (1, 1, 1))
    texture = Texture(jnp.asarray(image, jnp.float32))
    material = TexturedMaterial(0.5, 0.0, 0.4, clearcoat=0.5, clearcoat_roughness=0.8, transmission=0.6)
    layers = ("clearcoat_texture", "clearcoat_roughness_texture", "transmission_texture")
    textured = dataclasses.replace(material, **dict.fromkeys(layers, texture))
    plain = TexturedMaterial(0.5, 0.0, 0.4)
    parts = spheres(textured, plain).parts
    value, count = float(image[0, 0, 0]), len(parts[0].mesh.position)
    look = material_table.of_parts(parts).at_vertices()
    np.testing.assert_allclose(look.coefficient[:count, 8], 0.5 * value, rtol=1e-5)
    np.testing.assert_allclose(np.exp(look.log_layer[:count]), 0.8 * value, rtol=1e-5)
    bare = look.coefficient[count : 2 * count, :4]
    passing = np.array([1 - 0.6 * value, 1, 1, 1 - 0.6 * value])[:, None]
    np.testing.assert_allclose(look.coefficient[:count, :4], (1 - 0.5 * value) * passing * bare, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(look.coefficient[:count, 4:8], 0.5 * value * passing * bare, rtol=1e-4, atol=1e-7)
    assert not look.coefficient[count : 2 * count, 4:].any()


def test_relit_scenes_with_coats_are_the_exact_sum():
    light = builtin.studio(size=16)
    relit = precomputed("coat", "green")
    scene = relit.scene
    eye = np.array([1.5, 1.0, 6.0])
    ours = np.asarray(relit.radiance(light, eye=eye))
    count = len(scene.parts[0].mesh.position)
    for number, part in enumerate(scene.parts):
        shading = channels.of_part(part)
        exact = np.asarray(prt.reference.radiance(part.mesh, shading.exact, light, eye=eye, occluder=scene.mesh))
        seen = np.einsum("vc,vc->v", eye - np.asarray(part.mesh.position), np.asarray(part.mesh.normal)) > 0
        mine = ours[number * count : (number + 1) * count]
        assert np.linalg.norm((mine - exact)[seen]) < 0.03 * np.linalg.norm(exact[seen])
    # A coat can go and change; it cannot come where none was precomputed.
    bare = dataclasses.replace(COATED, clearcoat=0.0)
    changed = np.asarray(relit.radiance(light, eye=eye, materials={"ball 0": bare}))
    assert not np.allclose(changed[:count], ours[:count], rtol=0.01)

    def power(weight):
        new = dataclasses.replace(COATED, clearcoat=weight)
        return jnp.sum(relit.radiance(light, eye=eye, materials={"ball 0": new}))

    slope = float(jax.grad(power)(jnp.float32(0.8)))
    np.testing.assert_allclose(slope, (power(jnp.float32(1.0)) - power(jnp.float32(0.6))) / 0.4, rtol=0.01)
    with pytest.raises(ValueError, match="part 'ball 1' was precomputed without a clear coat"):
        relit.radiance(light, eye=eye, materials={"ball 1": COATED})


def test_relit_scenes_with_sheens_are_the_exact_sum():
    light = builtin.studio(size=16)
    relit = precomputed("velvet")
    scene = relit.scene
    (part,), eye = scene.parts, np.array([1.5, 1.0, 6.0])
    ours = np.asarray(relit.radiance(light, eye=eye))
    exact = np.asarray(prt.reference.radiance(part.mesh, relit.shading[0].exact, light, eye=eye, occluder=scene.mesh))
    way = eye - np.asarray(part.mesh.position)
    cosine = np.einsum("vc,vc->v", way, np.asarray(part.mesh.normal)) / np.linalg.norm(way, axis=1)
    assert np.linalg.norm((ours - exact)[cosine > 0.1]) < 0.033 * np.linalg.norm(exact[cosine > 0.1])
    bare, alone = MATERIALS["bare velvet"], precomputed("bare velvet")
    without = relit.radiance(light, eye=eye, materials={"ball 0": bare})
    np.testing.assert_allclose(without, alone.radiance(light, eye=eye), rtol=2e-4, atol=1e-5)

    def power(color):
        new = dataclasses.replace(VELVET, sheen_color=color * jnp.ones(3))
        return jnp.sum(relit.radiance(light, eye=eye, materials={"ball 0": new}))

    slope = float(jax.grad(power)(jnp.float32(0.5)))
    np.testing.assert_allclose(slope, (power(jnp.float32(0.6)) - power(jnp.float32(0.4))) / 0.2, rtol=0.01)
    slope = float(jax.jit(jax.grad(lambda size: jnp.sum(relit.radiance(light, eye=size * eye))))(jnp.float32(1.0)))
    assert np.isfinite(slope)
    with pytest.raises(ValueError, match=r"precomputed without a clear coat, got a material with clearcoat=0\.8"):
        relit.radiance(light, eye=eye, materials={"ball 0": COATED})
    with pytest.raises(ValueError, match="part 'ball 0' was precomputed without a sheen"):
        alone.radiance(light, eye=eye, materials={"ball 0": VELVET})


def test_layers_that_were_not_precomputed_are_nan_where_they_are_traced():
    bare, relit = MATERIALS["bare velvet"], precomputed("bare velvet")
    light = builtin.studio(size=16)

    @jax.jit
    def radiance(coat, color):
        new = dataclasses.replace(bare, clearcoat=coat, sheen_color=color * jnp.ones(3), sheen_roughness=0.4)
        return relit.radiance(light, eye=EYE, materials={"ball 0": new})

    plain = relit.radiance(light, eye=EYE)
    np.testing.assert_allclose(radiance(0.0, 0.0), plain, rtol=1e-4, atol=1e-6)
    assert np.isnan(radiance(0.5, 0.0)).all()
    assert np.isnan(radiance(0.0, 0.5)).all()


def test_relit_scenes_with_layers_can_be_saved(tmp_path):
    relit, light = precomputed("velvet"), builtin.studio(size=16)
    prt.files.save(tmp_path / "saved", relit)
    again, new = prt.files.load(tmp_path / "saved"), {"ball 0": dataclasses.replace(VELVET, roughness=0.3)}
    changed = again.radiance(light, eye=EYE, materials=new)
    np.testing.assert_array_equal(changed, relit.radiance(light, eye=EYE, materials=new))


def test_another_transmission_or_opacity_is_refused():
    glass = TexturedMaterial(0.5, 0.0, 0.4, transmission=0.5)
    part = spheres(glass).parts[0]
    opaque = dataclasses.replace(glass, transmission=0.0)
    hole = dataclasses.replace(glass, alpha_mode="blend", alpha=0.5)
    for new, text in (
        (opaque, r"a transmission of 0\.5, got a material of 0"),
        (hole, "the alpha mode 'opaque' and .*, got a material of 'blend'"),
    ):
        with pytest.raises(ValueError, match=f"part 'ball 0' was precomputed with {text}"):
            channels.appearance(part, channels.of_part(part), new)


BRUSHED = dataclasses.replace(COATED, anisotropy=0.5)
OMISSIONS = {
    "a coat hides a sheen": (
        dataclasses.replace(COATED, sheen_color=jnp.ones(3), sheen_roughness=0.3),
        "the sheen of part 'ball 0' is left out: it has a clear coat",
        COATED,
    ),
    "no standard table": (
        BRUSHED,
        "the clear coat of part 'ball 0' is left out",
        dataclasses.replace(BRUSHED, clearcoat=0.0),
    ),
}


@pytest.mark.parametrize("name", OMISSIONS)
def test_layers_are_left_out_with_a_warning(name):
    material, words, shown = OMISSIONS[name]
    with pytest.warns(UserWarning, match=words):
        shading = channels.of_part(spheres(material).parts[0])
    alone = channels.of_part(spheres(shown).parts[0])
    assert shading.table is alone.table
    np.testing.assert_allclose(shading.blend.weight, alone.blend.weight, rtol=1e-5)


def test_pictures_are_without_a_coat_that_is_left_out():
    light, scene = builtin.studio(size=16), spheres(COATED)
    camera = prt.scene.camera.orbit(scene.mesh, width=32, height=32)
    with pytest.warns(UserWarning, match="the clear coat of part 'ball 0' is left out"):
        relit = prt.precompute(scene, refine=False, system=prt.relit.Harmonics(5), size=16, progress=False)
    bare = {"ball 0": dataclasses.replace(COATED, clearcoat=0.0)}
    pictures = [relit.picture(light, camera, materials=materials) for materials in (None, bare)]
    np.testing.assert_allclose(*pictures, rtol=1e-3, atol=1e-4)


def test_pages_show_the_base_with_a_warning():
    relit = precomputed("coat", "green")
    with pytest.warns(UserWarning, match="shows these parts without their clear coats and sheens: 'ball 0'$"):
        page = PageScene.of(relit)
    bare = page.relit()
    alone = channels.of_part(spheres(dataclasses.replace(COATED, clearcoat=0.0)).parts[0])
    np.testing.assert_allclose(bare.shading[0].blend.weight, alone.blend.weight, rtol=1e-4, atol=1e-6)
    assert float(bare.scene.parts[0].material.clearcoat) == 0
    assert bare.shading[0].table is standard.METALLIC_ROUGHNESS
    assert bare.part_system(0).system.brdf.lobes == relit.part_system(0).system.brdf.lobes // 2


def test_materials_made_while_jax_traces_have_no_layers():
    parts = spheres(TexturedMaterial(0.5, 0.0, 0.4)).parts

    @jax.jit
    def columns(color):
        table = material_table.of_parts([dataclasses.replace(parts[0], material=TexturedMaterial(color, 0.0, 0.4))])
        assert not table.layered
        return table.at_vertices().coefficient

    assert columns(jnp.float32(0.5)).shape[1] == 4
