"""Parameters of materials at points; glTF's channels and extensions are in test_gltf.py."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt.scene import Texture, TexturedMaterial

FIELDS = ("base_color", "metallic", "roughness", "emissive", "ior", "specular", "specular_color", "anisotropy")
FIELDS += ("direction", "normal")


def image(*channels, seed=0, dtype=None):
    return jnp.asarray(
        np.random.default_rng(seed).uniform(0.2, 0.8, (4, 5, *channels)), dtype or jnp.result_type(float)
    )


def everything():
    """A material with all textures, one of which takes the second coordinates."""
    one, three = Texture(image(1)), Texture(image(3, seed=1), [[0.5, 0.2, 0.1], [-0.3, 0.7, 0]], 1, ("clamp", "mirror"))
    return TexturedMaterial(
        *(0.9, 0.6, 0.7, 0.3, 1.4, 0.8, 0.5, 0.4, 0.2, 0.7),
        **dict.fromkeys(("base_color_texture", "emissive_texture", "specular_color_texture"), three),
        **dict.fromkeys(("metallic_texture", "roughness_texture", "specular_texture"), one),
        **dict.fromkeys(("anisotropy_texture", "normal_texture"), three),
    )


def test_without_arguments_it_is_the_default_material_of_the_specification():
    material = TexturedMaterial()
    assert material.textures == ()
    found = material.at(jnp.zeros((2, 3, 2)))
    expected = [np.ones(3), 1, 1, np.zeros(3), 1.5, 1, np.ones(3), 0, [1, 0], [0, 0, 1]]
    for name, value in zip(FIELDS, expected, strict=True):
        np.testing.assert_array_equal(getattr(found, name), np.broadcast_to(value, (2, 3, *np.shape(value))), name)


def test_points_of_a_picture_are_evaluated_as_vertices_are(close):
    material, random = everything(), np.random.default_rng(0)
    place, second = (jnp.asarray(random.uniform(-1, 2, (3, 4, 2)), jnp.float32) for _ in range(2))
    color, side = jnp.asarray(random.uniform(size=(3, 4, 3)), jnp.float32), jnp.asarray([[1.0, -1, 1, -1]] * 3)
    whole = material.at(place, second, color=color, handedness=side)
    single = material.at(place[2, 1], second[2, 1], color=color[2, 1], handedness=side[2, 1])
    for name in FIELDS:
        close(getattr(whole, name)[2, 1], getattr(single, name))
    np.testing.assert_allclose(np.linalg.norm(whole.normal, axis=-1), 1, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(whole.direction, axis=-1), 1, atol=1e-6)
    plain = material.at(place, second)
    close(whole.base_color, plain.base_color * color)
    close(whole.normal[..., 1], plain.normal[..., 1] * side)
    close(whole.direction[..., 1], plain.direction[..., 1] * side)
    # Without second coordinates the first ones take their place.
    close(material.at(place).base_color, material.at(place, place).base_color)


@pytest.mark.usefixtures("x64")
def test_gradients_are_central_differences_in_factors_images_and_coordinates(close):
    material, random = everything(), np.random.default_rng(1)
    place, second = (jnp.asarray(random.uniform(0.3, 0.4, (3, 2))) for _ in range(2))

    def total(material, place, second):
        found = jax.tree.leaves(material.at(place, second, color=jnp.full((3, 3), 0.7), handedness=jnp.full(3, -1.0)))
        return sum(jnp.sum(jnp.sin(each + i)) for i, each in enumerate(found))

    arguments = material, place, second
    leaf, structure = jax.tree.flatten(arguments)
    gradient = jax.tree.leaves(jax.grad(total, argnums=(0, 1, 2))(*arguments))
    step = [jnp.asarray(random.normal(size=each.shape)) for each in leaf]
    along = sum(float(jnp.sum(g * s)) for g, s in zip(gradient, step, strict=True))
    ends = [
        float(total(*jax.tree.unflatten(structure, [x + sign * 1e-6 * s for x, s in zip(leaf, step, strict=True)])))
        for sign in (1, -1)
    ]
    assert along == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-6)
    assert all(each.dtype == np.float64 for each in jax.tree.leaves(material.at(place)))


def test_where_maps_are_zero_normals_are_the_surfaces_directions_the_tangent_and_gradients_finite():
    gray = Texture(jnp.full((1, 1, 3), 0.5))
    material = TexturedMaterial(anisotropy=0.5, anisotropy_texture=gray, normal_texture=gray)
    found = material.at(jnp.zeros((1, 2)))
    np.testing.assert_array_equal(found.normal, [[0, 0, 1]])
    np.testing.assert_array_equal(found.direction, [[1, 0]])
    gradient = jax.grad(lambda each: sum(jnp.sum(x) for x in jax.tree.leaves(each.at(jnp.zeros((1, 2))))))(material)
    assert all(np.isfinite(each).all() for each in jax.tree.leaves(gradient))


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ({"metallic": 1.1}, "metallic of TexturedMaterial must be between 0 and 1, got 1 of 1 .*: 1.1"),
        ({"roughness": float("nan")}, "roughness of TexturedMaterial must be between 0 and 1"),
        ({"base_color": [0.5, -0.1, 0]}, "base_color of TexturedMaterial must be between 0 and 1, got 1 of 3"),
        ({"emissive": -1.0}, "emissive of TexturedMaterial must be at least 0"),
        ({"specular_color": float("inf")}, "specular_color of TexturedMaterial must be finite"),
        ({"ior": 0.5}, "ior of TexturedMaterial must be 0 or at least 1, got 0.5"),
        ({"rotation": float("inf")}, "rotation of TexturedMaterial must be finite"),
    ],
)
def test_factors_out_of_range_are_refused(field, message):
    with pytest.raises(ValueError, match=message):
        TexturedMaterial(**field)


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ({"image": jnp.full((1, 1, 3), jnp.nan)}, "the texture's image must be finite"),
        ({"transform": jnp.full((2, 3), jnp.inf)}, "the texture's transform must be finite"),
        ({"set": 2}, "set must be between 0 and 1, got 2"),
        ({"wrap": ("repeat", "tile")}, "wrap must be two of repeat, mirror, clamp, got"),
    ],
)
def test_impossible_textures_are_refused(field, message):
    with pytest.raises(ValueError, match=message):
        Texture(**{"image": image(3)} | field)


def test_gradients_pass_through_a_material_made_inside_jit():
    def shine(roughness):
        return TexturedMaterial(roughness=roughness, ior=1 + roughness).at(jnp.zeros((4, 2))).roughness.sum()

    assert float(jax.jit(jax.grad(shine))(0.5)) == 4
