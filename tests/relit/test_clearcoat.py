"""Clear coats and transmission: the formula of the extension, tables against the BRDF, and relit scenes."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt.brdf import ClearCoat, MetallicRoughness
from jaxprt.relit import channels
from jaxprt.scene import Part, Scene, Texture, TexturedMaterial, builtin, material_table
from jaxprt.scene.mesh import make_mesh
from jaxprt.sphere import cubemap
from jaxprt.systems import standard
from jaxprt.view.uncoated import without_coats

TABLE = 0.03  # error of 12 and 12 lobes, of light of medium width
COATED = TexturedMaterial([0.6, 0.1, 0.1], 0.0, 0.5, clearcoat=0.8, clearcoat_roughness=0.2)


def upper(count: int, seed: int) -> np.ndarray:
    way = np.random.default_rng(seed).normal(size=(count, 3))
    way[:, 2] = np.abs(way[:, 2])
    return way / np.linalg.norm(way, axis=1, keepdims=True)


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
    below = np.asarray(base(jnp.asarray(wi), jnp.asarray(wo)))
    expected = (1 - fresnel)[:, None] * below + (fresnel * d * v)[:, None]
    got = ClearCoat(base, weight, rough)(jnp.asarray(wi), jnp.asarray(wo))
    np.testing.assert_allclose(got, expected, rtol=2e-4)
    with pytest.raises(ValueError, match="clearcoat of ClearCoat must be"):
        ClearCoat(base, 1.5, rough)


def test_tables_of_coated_materials_are_the_brdf():
    wi, area = (
        np.asarray(each).reshape(6 * 32 * 32, -1) for each in (cubemap.direction(size=32), cubemap.solid_angle(size=32))
    )
    wi, area = wi[wi[:, 2] > 0], area[wi[:, 2] > 0, 0]
    middle = upper(6, 2)
    light = np.exp(np.array([3, 10, 30, 5, 20, 60]) * (wi @ middle.T - 1)) * area[:, None]
    table, (log_base, log_coat) = standard.COATED.lobes(12), np.log(np.float32([0.5, 0.15]))
    base = MetallicRoughness(jnp.asarray([0.8, 0.3, 0.2]), 1.0, 0.5)
    term = np.asarray(base.coefficient())
    weight = np.concatenate([0.3 * term, 0.7 * term, np.full((1, 3), 0.7)]) / standard.COATED.scale[:, None]
    for angle in (0.1, 0.6, 1.1):
        wo = np.float32([[np.sin(angle), 0, np.cos(angle)]])
        exact = np.asarray(ClearCoat(base, 0.7, 0.15)(jnp.asarray(wi), jnp.broadcast_to(wo, wi.shape))) * wi[:, 2:]
        lobes = table.lookup(jnp.asarray(wo), jnp.asarray([log_base]), jnp.asarray([log_coat]))
        wide = [jnp.broadcast_to(each, (*each.shape[:-1], len(wi))) for each in vars(lobes).values()]
        ours = np.asarray(type(lobes)(*wide).evaluate(jnp.asarray(wi))).T @ weight
        assert np.linalg.norm(light.T @ (ours - exact)) < TABLE * np.linalg.norm(light.T @ exact)


def test_harmonics_of_coated_materials_are_those_of_base_and_coat():
    tangent = 20 / standard.METALLIC_ROUGHNESS.harmonics(4).steps  # of half the angle of a view node
    cosine = (1 - tangent**2) / (1 + tangent**2)
    wo = jnp.asarray([[np.sqrt(1 - cosine**2), 0, cosine]], jnp.float32)
    log_base, log_coat = jnp.log(jnp.asarray([0.5])), jnp.log(jnp.asarray([0.15]))
    ours = np.asarray(standard.COATED.harmonics(4).coefficients(wo, log_base, log_coat))
    base, coat = (standard.METALLIC_ROUGHNESS.harmonics(4).coefficients(wo, each) for each in (log_base, log_coat))
    share = 0.04 + 0.96 * (1 - cosine) ** 5
    expected = np.concatenate([base, (1 - share) * base, share * coat[:, 1:2]], 1)
    np.testing.assert_allclose(ours, expected, atol=1e-5 * np.abs(expected).max())


def spheres(*materials: TexturedMaterial) -> Scene:
    ball = builtin.sphere(rings=6, sectors=8)
    place = np.random.default_rng(0).uniform(0, 1, (len(ball.position), 2))
    parts = [
        Part(f"ball {n}", make_mesh(np.asarray(ball.position) + [3 * n, 0, 0], ball.face, texture=place), material)
        for n, material in enumerate(materials)
    ]
    return Scene(parts)


def test_layers_cost_nothing_where_no_material_has_them():
    plain = material_table.of_parts(spheres(TexturedMaterial(0.5, 0.0, 0.4)).parts)
    assert (plain.layered, plain.image.shape[1], plain.factor.shape[1]) == (False, len(material_table.TEXTURES), 14)
    look = plain.at_vertices()
    assert look.coefficient.shape[1] == 4
    assert look.log_coat is None
    scene = spheres(COATED, dataclasses.replace(COATED, clearcoat=0.0))
    coated, bare = (channels.of_part(part) for part in scene.parts)
    assert coated.table is standard.COATED
    assert bare.table is standard.METALLIC_ROUGHNESS


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
    np.testing.assert_allclose(look.coefficient[:count, -1], 0.5 * value, rtol=1e-5)
    np.testing.assert_allclose(np.exp(look.log_coat[:count]), 0.8 * value, rtol=1e-5)
    bare = look.coefficient[count : 2 * count, :4]
    passing = np.array([1 - 0.6 * value, 1, 1, 1 - 0.6 * value])[:, None]
    np.testing.assert_allclose(look.coefficient[:count, :4], (1 - 0.5 * value) * passing * bare, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(look.coefficient[:count, 4:8], 0.5 * value * passing * bare, rtol=1e-4, atol=1e-7)
    assert not look.coefficient[count : 2 * count, 4:].any()


def test_relit_scenes_with_coats_are_the_exact_sum():
    light = builtin.studio(size=16)
    scene = spheres(COATED, TexturedMaterial([0.2, 0.5, 0.3], 0.0, 0.5))
    relit = prt.precompute(scene, refine=False, system="lobe", size=16, progress=False)
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


def test_pages_show_the_base_with_a_warning():
    relit = prt.precompute(spheres(COATED), refine=False, system="lobe", size=16, progress=False)
    with pytest.warns(UserWarning, match="shows these parts without their clear coats: 'ball 0'"):
        bare = without_coats(relit)
    alone = channels.of_part(spheres(dataclasses.replace(COATED, clearcoat=0.0)).parts[0])
    np.testing.assert_allclose(bare.shading[0].blend.weight, alone.blend.weight, rtol=1e-4, atol=1e-6)
    assert float(bare.scene.parts[0].material.clearcoat) == 0
    assert bare.shading[0].table is standard.METALLIC_ROUGHNESS
    assert bare.part_system(0).system.brdf.lobes == relit.part_system(0).system.brdf.lobes // 2
    assert without_coats(bare) is bare


def test_materials_without_standard_tables_lose_their_coat_with_a_warning():
    brushed = dataclasses.replace(COATED, anisotropy=0.5)
    with pytest.warns(UserWarning, match="the clear coat of part 'ball 0' is left out"):
        shading = channels.of_part(spheres(brushed).parts[0])
    assert shading.table is None
    bare = channels.of_part(spheres(dataclasses.replace(brushed, clearcoat=0.0)).parts[0])
    np.testing.assert_allclose(shading.blend.weight, bare.blend.weight, rtol=1e-4)
