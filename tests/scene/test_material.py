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


@jax.jit
def at(material, *coordinates, **field):
    return material.at(*coordinates, **field)


def test_without_arguments_it_is_the_default_material_of_the_specification():
    material = TexturedMaterial()
    assert material.textures == ()
    found = at(material, np.zeros((2, 3, 2), np.float32))
    expected = [np.ones(3), 1, 1, np.zeros(3), 1.5, 1, np.ones(3), 0, [1, 0], [0, 0, 1]]
    for name, value in zip(FIELDS, expected, strict=True):
        np.testing.assert_array_equal(getattr(found, name), np.broadcast_to(value, (2, 3, *np.shape(value))), name)


def test_points_of_a_picture_are_evaluated_as_vertices_are(close):
    material, random = everything(), np.random.default_rng(0)
    place, second = np.float32(random.uniform(-1, 2, (2, 3, 4, 2)))
    color, side = np.float32(random.uniform(size=(3, 4, 3))), np.float32([[1.0, -1, 1, -1]] * 3)
    whole = at(material, place, second, color=color, handedness=side)
    single = at(material, place[2, 1], second[2, 1], color=color[2, 1], handedness=side[2, 1])
    for name in FIELDS:
        close(np.asarray(getattr(whole, name))[2, 1], getattr(single, name))
    np.testing.assert_allclose(np.linalg.norm(whole.normal, axis=-1), 1, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(whole.direction, axis=-1), 1, atol=1e-6)
    plain = jax.tree.map(np.asarray, at(material, place, second))
    close(whole.base_color, plain.base_color * color)
    for name in ("normal", "direction"):
        close(np.asarray(getattr(whole, name))[..., 1], getattr(plain, name)[..., 1] * side)
    # Without second coordinates the first ones take their place.
    close(at(material, place).base_color, at(material, place, place).base_color)


@pytest.mark.usefixtures("x64")
def test_gradients_are_central_differences_in_factors_images_and_coordinates(close):
    material, random = everything(), np.random.default_rng(1)
    place, second = (jnp.asarray(random.uniform(0.3, 0.4, (3, 2))) for _ in range(2))

    @jax.jit
    def total(material, place, second):
        found = jax.tree.leaves(material.at(place, second, color=jnp.full((3, 3), 0.7), handedness=jnp.full(3, -1.0)))
        return sum(jnp.sum(jnp.sin(each + i)) for i, each in enumerate(found))

    arguments = material, place, second
    leaf, structure = jax.tree.flatten(arguments)
    gradient = jax.tree.leaves(jax.jit(jax.grad(total, argnums=(0, 1, 2)))(*arguments))
    leaf = [np.asarray(each) for each in leaf]
    step = [random.normal(size=each.shape) for each in leaf]
    along = sum(np.sum(g * s) for g, s in zip(gradient, step, strict=True))
    ends = [
        float(total(*jax.tree.unflatten(structure, [x + sign * 1e-6 * s for x, s in zip(leaf, step, strict=True)])))
        for sign in (1, -1)
    ]
    assert along == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-6)
    assert all(each.dtype == np.float64 for each in jax.tree.leaves(at(material, place)))


def test_where_maps_are_zero_normals_are_the_surfaces_directions_the_tangent_and_gradients_finite():
    gray = Texture(jnp.full((1, 1, 3), 0.5))
    material = TexturedMaterial(anisotropy=0.5, anisotropy_texture=gray, normal_texture=gray)
    found = at(material, np.zeros((1, 2), np.float32))
    np.testing.assert_array_equal(found.normal, [[0, 0, 1]])
    np.testing.assert_array_equal(found.direction, [[1, 0]])
    total = jax.jit(jax.grad(lambda each: sum(jnp.sum(x) for x in jax.tree.leaves(each.at(jnp.zeros((1, 2)))))))
    gradient = total(material)
    assert all(np.isfinite(each).all() for each in jax.tree.leaves(gradient))


def test_gradients_pass_through_a_material_made_inside_jit():
    def shine(roughness):
        return TexturedMaterial(roughness=roughness, ior=1 + roughness).at(jnp.zeros((4, 2))).roughness.sum()

    assert float(jax.jit(jax.grad(shine))(0.5)) == 4
