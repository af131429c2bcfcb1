"""Mitsuba 3 judges pictures of scenes: textures, metallic-roughness materials, shadows between parts, and the light."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from benchmarks import scenes
from jaxprt.relit import Harmonics
from jaxprt.scene import Camera, Environment, Part, Scene, Texture, TexturedMaterial
from jaxprt.scene.mesh import ground_plane
from jaxprt.sphere import cubemap

pytest.importorskip("mitsuba")

# With 1,024 samples the picture is off by 0.9 %, as is the exact sum at the vertices. The rest is for noise.
TOLERANCE = 0.04
SAMPLES = 36


@pytest.fixture(scope="module")
def light():
    """Broad lobes of distinct colors."""
    axis = np.array([[1.0, 0.4, 0.1], [-0.5, 0.8, 0.3], [0.1, 0.3, 1.0]])
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    lobe = np.exp(5 * (np.asarray(cubemap.direction(size=16)) @ axis.T - 1))
    return Environment(jnp.asarray(lobe @ [[3.0, 0.2, 0.1], [0.1, 2.0, 0.3], [0.1, 0.4, 3.0]] + 0.1, jnp.float32))


@pytest.fixture(scope="module")
def scene():
    """A ball with smooth textures that no symmetry leaves as they are, half a metal, over a ground."""
    u, v = np.meshgrid((np.arange(32) + 0.5) / 32, (np.arange(16) + 0.5) / 16)
    wave = np.sin(2 * np.pi * u)
    base = np.stack([0.5 + 0.4 * wave, 0.2 + 0.6 * v, 0.5 - 0.3 * wave], -1).astype(np.float32)
    metal = (0.5 + 0.5 * np.cos(2 * np.pi * u) * np.sin(np.pi * v)).astype(np.float32)[..., None]
    material = TexturedMaterial(roughness=0.6, base_color_texture=Texture(base), metallic_texture=Texture(metal))
    mesh = scenes.ball(32, np.zeros(3))
    ground = Part("ground", ground_plane(mesh, vertices=400, extent=2.5), TexturedMaterial(0.5, 0.0, 1.0))
    return Scene(
        [Part("ball", mesh, material), ground], [Camera([1.5, 2, 4.5], [0.3, -0.3, 0], [0, 1, 0], 0.5, 24, 20)]
    )


@pytest.fixture(scope="module")
def relit(scene, coarse):
    return prt.precompute(scene, refine=False, system=Harmonics(degree=4), size=16, progress=False)


@pytest.fixture(scope="module")
def judge(scene, light):
    return scenes.Judge(scene, light, scene.cameras[0], SAMPLES)


def drawn(relit, light, **options):
    return scenes.averaged(relit.picture(light, scenes.finer(relit.camera), **options))


def test_picture_is_that_of_mitsuba(relit, judge, light):
    picture = drawn(relit, light)
    assert judge.inside.mean() > 0.4
    assert judge.error(picture) < TOLERANCE
    assert abs(judge.bias(picture)) < TOLERANCE / 2
    # The light behind the object is the same as well.
    behind = scenes.averaged(
        (np.asarray(prt.image.rasterize(relit.mesh, scenes.finer(relit.camera)).triangle) < 0)[..., None]
    )
    outside = behind[..., 0] == 1
    difference = np.linalg.norm(picture[outside] - judge.mean[outside])  # a silhouette may touch a pixel's corner
    assert difference < 0.02 * np.linalg.norm(judge.mean[outside])


@pytest.mark.parametrize("change", ["u mirrored", "v mirrored", "no metal"])
def test_another_material_would_be_noticed(relit, judge, light, change):
    material = relit.scene["ball"].material
    turn = {"u mirrored": (slice(None), slice(None, None, -1)), "v mirrored": (slice(None, None, -1),)}.get(change)
    if turn is None:
        material = eqx.tree_at(lambda each: each.metallic, material, jnp.asarray(0.0))
    else:
        image = material.base_color_texture.image[turn]
        material = eqx.tree_at(lambda each: each.base_color_texture.image, material, image)
    assert judge.error(drawn(relit, light, materials={"ball": material})) > 1.5 * TOLERANCE


@pytest.mark.parametrize("face", [[1, 0, 2, 3, 4, 5], [0, 1, 3, 2, 4, 5], [0, 1, 2, 3, 5, 4]])
def test_another_light_would_be_noticed(relit, judge, light, face):
    assert judge.error(drawn(relit, Environment(light.radiance[np.array(face)]))) > 1.5 * TOLERANCE
