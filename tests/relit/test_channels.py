"""Parts of scenes as systems take them: channels, weights, knots and frames, without any system.

Vertices lie at the centers of the textures' texels, one vertex to a texel, so that expected values are the images'.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt.brdf import AshikhminShirley, Lambert, MetallicRoughness
from jaxprt.brdf.varying import Channels, PerVertex
from jaxprt.relit import channels
from jaxprt.relit.channels import Appearance, RoughnessFamily, appearance, of_part
from jaxprt.scene import Part, TexturedMaterial
from jaxprt.scene.material import Texture
from jaxprt.scene.mesh import make_mesh

ROWS, COLUMNS = 3, 4
COUNT = ROWS * COLUMNS
RANDOM = np.random.default_rng(0)
TANGENT, BITANGENT, NORMAL = np.array([0.6, 0, 0.8]), np.array([0.8, 0, -0.6]), np.array([0, 1.0, 0])


def image(low: float = 0.05, high: float = 1.0, channels: int = 1) -> jax.Array:
    return jnp.asarray(RANDOM.uniform(low, high, (ROWS, COLUMNS, channels)), jnp.float32)


def patch(material, **more) -> Part:
    """A flat grid in the plane y = 0, vertices in the order of texels."""
    row, column = np.divmod(np.arange(COUNT), COLUMNS)
    position = np.stack([column, 0 * row, row], -1).astype(float)
    corner = (np.arange(ROWS - 1)[:, None] * COLUMNS + np.arange(COLUMNS - 1)).reshape(-1, 1)
    face = (corner + np.array([0, COLUMNS, 1, 1, COLUMNS, COLUMNS + 1])).reshape(-1, 3)
    texture = np.stack([(column + 0.5) / COLUMNS, 1 - (row + 0.5) / ROWS], -1)
    tangent = np.broadcast_to(TANGENT, (COUNT, 3))
    return Part("patch", make_mesh(position, face, tangent=tangent, texture=texture), material, **more)


def pairs(count: int = 3) -> jax.Array:
    """Pairs of directions above the horizon for every vertex, [2 count v 3]."""
    direction = RANDOM.normal(size=(2, count, COUNT, 3)).astype(np.float32)
    direction[..., 2] = np.abs(direction[..., 2]) + 0.05
    return jnp.asarray(direction / np.linalg.norm(direction, axis=-1, keepdims=True))


@jax.jit
def evaluated(model, wi, wo):
    """Values of a BRDF, [count v c]."""
    return model(wi, wo)


@jax.jit
def blended(shading, blend, wi, wo):
    """Weights times channels of each vertex, [count v c]."""
    if not shading.knot:
        return jnp.einsum("nvk,vkc->nvc", shading.brdf(wi, wo), blend.weight)
    assert isinstance(shading.brdf, RoughnessFamily)
    value = jax.vmap(lambda each, wi, wo: shading.brdf(each)(wi, wo), (0, 1, 1), 1)(*blend.parameter, wi, wo)
    return jnp.einsum("nvk,vkc->nvc", value, blend.weight)


COLOR, METALLIC, ROUGHNESS, SPECULAR, TINT = image(channels=3), image(), image(0.2), image(0.1), image(channels=3)
MATERIALS = {
    "color": ({"roughness": 0.4, "metallic": 0.0}, {"base_color": COLOR}),
    "metallic": ({"base_color": (0.9, 0.5, 0.2), "roughness": 0.3}, {"metallic": METALLIC}),
    "ior": ({"roughness": 0.5, "metallic": 0.2, "ior": 1.9}, {"base_color": COLOR}),
    "specular": ({"roughness": 0.5, "metallic": 0.0}, {"base_color": COLOR, "specular": SPECULAR}),
    "tint": ({"roughness": 0.6, "metallic": 0.3, "specular": 0.7}, {"specular_color": TINT, "base_color": COLOR}),
    "roughness": ({"metallic": 0.5, "anisotropy": 0.3}, {"roughness": ROUGHNESS, "base_color": COLOR}),
    "diffuse": ({"metallic": 0.0, "specular": 0.0}, {"base_color": COLOR, "roughness": ROUGHNESS}),
    "smooth": ({"roughness": 0.0, "metallic": 1.0}, {"base_color": COLOR}),
}


def textured(factor: dict, images: dict) -> TexturedMaterial:
    return TexturedMaterial(**factor, **{f"{name}_texture": Texture(each) for name, each in images.items()})


def at_vertices(factor: dict, images: dict) -> MetallicRoughness:
    """The material of each vertex, by NumPy."""
    value = {}
    for name in ("base_color", "metallic", "roughness", "ior", "specular", "specular_color", "anisotropy"):
        start = np.asarray(factor.get(name, {"ior": 1.5, "anisotropy": 0.0}.get(name, 1.0)), np.float32)
        colored = name.endswith("color")
        every = np.broadcast_to(start, (COUNT, 3) if colored else (COUNT,))
        value[name] = jnp.asarray(every * np.asarray(images[name]).reshape(every.shape) if name in images else every)
    return MetallicRoughness(**value, rotation=jnp.zeros(COUNT))


@pytest.mark.parametrize("name", MATERIALS)
def test_weights_times_channels_are_the_material_of_each_vertex(name, close):
    shading = of_part(patch(textured(*MATERIALS[name])))
    wi, wo = pairs()
    expected = evaluated(at_vertices(*MATERIALS[name]), wi, wo)
    close(blended(shading, shading.blend, wi, wo), expected, tolerance=2e-5)
    assert isinstance(shading.exact, PerVertex)
    close(evaluated(shading.exact, *jnp.swapaxes(jnp.stack([wi, wo]), 1, 2)), np.swapaxes(expected, 0, 1))


@pytest.mark.parametrize("name", MATERIALS)
def test_another_material_has_its_own_weights_whatever_the_scale(name, close):
    """The part is made for one material and shown with another; scales are those of the first."""
    factor, images = MATERIALS[name]
    first = patch(textured(factor, images))
    shading = of_part(first)
    other = {each: value if each == "roughness" else value[::-1, ::-1] * 0.5 for each, value in images.items()}
    shown = appearance(first, shading, textured(factor, other))
    wi, wo = pairs()
    expected = evaluated(at_vertices(factor, other), wi, wo)
    close(blended(shading, shown.blend, wi, wo), expected, tolerance=2e-5)


def test_materials_with_the_standard_tables_have_all_channels_and_others_those_that_they_need():
    terms = {name: of_part(patch(textured(*each))).term for name, each in MATERIALS.items()}
    assert all(terms[name] == (0, 1, 2, 3) for name in ("smooth", "color", "metallic", "ior", "specular", "tint"))
    assert terms["roughness"] == (0, 1, 2)  # anisotropic
    assert terms["diffuse"] == (3,)
    alone = {name: of_part(patch(textured(*each)), takes=lambda table: False) for name, each in MATERIALS.items()}
    assert alone["smooth"].term == (1, 2)
    assert alone["color"].term == alone["metallic"].term == alone["ior"].term == (0, 1, 2)
    assert alone["specular"].term == alone["tint"].term == (0, 1, 2, 3)
    # Weights are about one, except for rare channels: a fit of all channels together is then about what is seen.
    mean = np.mean(np.asarray(alone["metallic"].blend.weight), (0, 2))
    assert np.all((mean > 1e-3) & (mean < 1.001))
    assert np.any(mean > 0.99)


def test_diffuse_and_even_materials_need_no_knots_and_plain_brdfs_no_weights(close):
    diffuse = of_part(patch(textured(*MATERIALS["diffuse"])))
    assert isinstance(diffuse.brdf, Lambert)
    assert diffuse.knot == diffuse.blend.parameter == ()
    close(diffuse.blend.weight[:, 0], COLOR.reshape(-1, 3), tolerance=1e-6)
    tint = image(channels=3).reshape(COUNT, 3)  # colors of vertices multiply those of the texture
    tinted = of_part(patch(textured(*MATERIALS["diffuse"]), color=tint))
    close(tinted.blend.weight[:, 0], COLOR.reshape(-1, 3) * tint, tolerance=1e-6)
    even = textured({"roughness": 0.5}, {"roughness": jnp.full((ROWS, COLUMNS, 1), 0.8)})
    alike = of_part(patch(even), takes=lambda table: False)
    assert alike.knot == alike.blend.parameter == ()
    assert isinstance(alike.brdf, Channels)
    np.testing.assert_allclose(alike.brdf.model[0].roughness, 0.4, rtol=1e-6)
    plain = of_part(patch(model := AshikhminShirley()))
    assert plain.brdf is plain.exact is model
    assert plain.blend is None
    function = of_part(patch(lambda wi, wo: wi[..., :1] * 0 + 0.25))  # becomes what jitted functions take
    assert np.all(jax.jit(lambda each, wi, wo: each.brdf(wi, wo))(function, *pairs()) == 0.25)
    turned = patch(TexturedMaterial(rotation=0.7))  # without anisotropy
    assert of_part(turned).mesh is turned.mesh


def test_a_black_material_reflects_nothing_and_emits_what_it_emits():
    glow = image(channels=3)
    black = {"base_color": 0.0, "specular": 0.0, "metallic": 0.0, "emissive": (2.0, 3.0, 4.0)}
    shading = of_part(patch(textured(black, {"emissive": glow})))
    assert not np.any(shading.blend.weight)
    np.testing.assert_allclose(shading.emitted, np.asarray(glow).reshape(-1, 3) * [2, 3, 4], rtol=1e-6)
    assert of_part(patch(TexturedMaterial())).emitted is None


@pytest.mark.parametrize(("low", "high"), [(0.2, 1.0), (0.0, 0.5), (0.4, 0.41)])
def test_knots_cover_the_roughness_in_steps_of_less_than_one_and_a_half(low, high):
    rough = jnp.linspace(low, high, COUNT).reshape(ROWS, COLUMNS, 1)
    shading = of_part(patch(textured({"anisotropy": 0.2}, {"roughness": rough})))
    (knot,) = shading.knot
    (parameter,) = shading.blend.parameter
    np.testing.assert_allclose(np.exp(knot[[0, -1]]), [max(low, 1e-3**0.5), high], rtol=1e-6)
    np.testing.assert_allclose(np.exp(parameter), np.maximum(rough.ravel(), 1e-3**0.5), rtol=1e-5)
    assert np.all(np.diff(knot) > 0)
    assert np.diff(knot).max() <= np.log(1.5) + 1e-6


def test_a_part_with_the_standard_tables_takes_any_roughness():
    part = patch(TexturedMaterial(roughness=0.3, metallic=0.5))
    shading = of_part(part)
    np.testing.assert_allclose(shading.blend.parameter[0], np.log(0.3), rtol=1e-6)
    wi, wo = pairs()
    for roughness in (0.0, 0.1, 1.0):
        other = appearance(part, shading, TexturedMaterial(roughness=roughness, metallic=0.5)).blend
        np.testing.assert_allclose(other.parameter[0], np.log(max(roughness, 1e-3**0.5)), atol=1e-6)
        right = evaluated(at_vertices({"roughness": max(roughness, 1e-3**0.5), "metallic": 0.5}, {}), wi, wo)
        np.testing.assert_allclose(blended(shading, other, wi, wo), right, rtol=2e-4, atol=1e-5)


@pytest.mark.parametrize("hand", [1.0, -1.0])
def test_normal_maps_tilt_normals_at_points_and_leave_the_mesh_alone(hand, close):
    slope = RANDOM.uniform(-0.5, 0.5, (COUNT, 2))
    normal = np.concatenate([slope, np.ones((COUNT, 1))], 1)
    texel = ((normal / 1.5 + 1) / 2).reshape(ROWS, COLUMNS, 3).astype(np.float32)
    part = patch(
        TexturedMaterial(normal_scale=0.5, normal_texture=Texture(jnp.asarray(texel))), handedness=jnp.full(COUNT, hand)
    )
    x, y = 0.5 * slope.T[..., None]
    expected = x * TANGENT + hand * y * BITANGENT + NORMAL
    (look,) = channels.looks([part])
    close(look.normal, expected / np.linalg.norm(expected, axis=1, keepdims=True))
    assert of_part(part).mesh is part.mesh


@pytest.mark.parametrize("hand", [1.0, -1.0])
def test_tangents_lie_along_the_anisotropy_as_if_the_material_turned(hand, close):
    part = patch(TexturedMaterial(roughness=0.4, anisotropy=0.6, rotation=0.7), handedness=jnp.full(COUNT, hand))
    shading = of_part(part)
    expected = np.cos(0.7) * TANGENT + hand * np.sin(0.7) * BITANGENT
    close(shading.mesh.tangent, np.broadcast_to(expected, (COUNT, 3)))
    wi, wo = pairs()
    frame = np.stack([TANGENT, BITANGENT, NORMAL]).astype(np.float32)
    along = np.asarray(shading.mesh.tangent)[0]
    turned = np.stack([along, np.cross(NORMAL, along), NORMAL]).astype(np.float32)
    value = evaluated(MetallicRoughness(roughness=0.4, anisotropy=0.6, rotation=hand * 0.7), wi, wo)
    new = [each @ frame @ turned.T for each in (wi, wo)]
    close(blended(shading, shading.blend, *new), np.broadcast_to(value, (*value.shape[:2], 3)), tolerance=1e-4)


def test_a_texture_of_anisotropy_counts_as_its_mean_and_says_so():
    texel = np.full((ROWS, COLUMNS, 3), 0.5, np.float32)
    texel[..., 0], texel[..., 2] = 1.0, np.linspace(0, 1, COUNT).reshape(ROWS, COLUMNS)
    part = patch(TexturedMaterial(anisotropy=0.8, anisotropy_texture=Texture(jnp.asarray(texel))))
    with pytest.warns(UserWarning, match=r"anisotropy of part 'patch' varies from 0\.00 to 0\.80 .* its mean 0\.40"):
        shading = of_part(part)
    np.testing.assert_allclose(shading.exact.model.anisotropy, 0.4, rtol=1e-6)


NEW = {
    "color": ({"base_color": 0.5}, r"'patch' was precomputed without the terms that the new material needs \(rim\)"),
    "dielectric": ({"metallic": 0.0, "specular": 0.5}, r"\(diffuse, rim, bare diffuse\)"),
    "rough": (
        {"roughness": 0.6},
        r"for roughness from 0\.400 to 0\.500, got a material from 0\.480 to 0\.600: precomp",
    ),
    "smooth": ({"roughness": 0.4}, r"for roughness from 0\.400 to 0\.500, got a material from 0\.320 to 0\.400"),
    "anisotropy": (
        {"anisotropy": 0.3},
        r"'patch' was precomputed for an anisotropy of 0\.500, got a material of 0\.300",
    ),
    "direction": ({"rotation": 1.0}, r"'patch' was precomputed with another direction of anisotropy"),
    "normal": ({"normal_texture": Texture(image(channels=3))}, r"'patch' was precomputed without a normal map"),
}


def metal(**change) -> TexturedMaterial:
    rough = jnp.linspace(0.8, 1.0, COUNT).reshape(ROWS, COLUMNS, 1)
    return TexturedMaterial(**({"roughness": 0.5, "anisotropy": 0.5} | change), roughness_texture=Texture(rough))


def test_materials_that_need_what_was_not_precomputed_are_refused():
    part = patch(metal())
    for change, message in NEW.values():
        with pytest.raises(ValueError, match=message):
            appearance(part, of_part(part), metal(**change))
    bare = Part("patch", make_mesh(part.mesh.position, part.mesh.face), TexturedMaterial())
    with pytest.raises(ValueError, match=r"part 'patch' must have mesh\.texture for the textures of its"):
        appearance(bare, of_part(part), metal())
    with pytest.raises(TypeError, match="part 'patch' must be one BRDF for all vertices or a TexturedMaterial, got a"):
        of_part(patch(PerVertex(Lambert(jnp.ones((COUNT, 1))))))


def test_inside_a_program_vertices_that_need_what_was_not_precomputed_are_nan():
    part = patch(metal())
    shading = of_part(part)

    @jax.jit
    def weight(material) -> Appearance:
        return appearance(part, shading, material).blend.weight

    np.testing.assert_allclose(weight(metal()), shading.blend.weight, rtol=1e-5)
    assert np.isnan(weight(metal(metallic=0.5))).all()
    high = np.asarray(metal().roughness_texture.image).ravel() * 0.55 > 0.501
    np.testing.assert_array_equal(np.isnan(weight(metal(roughness=0.55))).all((1, 2)), high)
