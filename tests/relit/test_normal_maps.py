"""Normal maps in pictures: a map of one texel, against the sum over all texels of the light with the tilted normal."""

import functools
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt import lobe
from jaxprt.relit import Clusters, Dynamic, Harmonics, Lobes, RelitScene, Terms, build, canvas, warn
from jaxprt.relit.exact import exact_pixels
from jaxprt.scene import Camera, Environment, Part, Scene, TexturedMaterial
from jaxprt.scene.material import Texture
from jaxprt.scene.mesh import make_mesh
from jaxprt.sphere import cubemap

SIZE = 8
CAMERA = Camera([0.6, 2.2, 1.6], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0], 0.3, 8, 8)  # sees nothing but the square
SQUARE = np.array([[-1.0, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]])
CORNERS = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
TILT = np.array([0.3, 0.25, 0.92])  # along u, which is x, along v, which is -z, and up
MATTE = {"base_color": 0.8, "metallic": 0.0, "specular": 0.0}
GLOSSY = {"base_color": 0.8, "metallic": 1.0, "roughness": 0.6}
# Of hat functions with one direction each, and of four lobes with 8 texels along an edge. Flat surfaces are .19 and
# .13 off.
MATTE_ERROR, GLOSSY_ERROR = 0.03, 0.03


@pytest.fixture(scope="module", autouse=True)
def small(coarse, bound):
    """Small maps and rows."""
    with pytest.MonkeyPatch.context() as patch:
        bound(patch, lobe.tabulate, resolution=12)
        patch.setattr(canvas, "ROW", 64)
        yield


def tilted(normal=TILT) -> Texture:
    normal = np.asarray(normal)
    return Texture(np.float32((normal / max(np.linalg.norm(normal), 1) + 1) / 2)[None, None])


def square(hand: float = 1.0, **material) -> Scene:
    tangent = np.broadcast_to([1.0, 0, 0], (4, 3))
    mesh = make_mesh(SQUARE, np.array([[0, 1, 2], [0, 2, 3]]), tangent=tangent, texture=CORNERS)
    return Scene([Part("square", mesh, TexturedMaterial(**material), handedness=np.full(4, hand, np.float32))])


@functools.cache
def glossy() -> RelitScene:
    scene = square(normal_texture=tilted(), **GLOSSY)
    return prt.precompute(scene, system=Lobes(lobes=4, texels=8), size=SIZE, progress=False)


def light() -> Environment:
    """A sky with a gradient, and a sun that is traced."""
    way = np.asarray(cubemap.direction(size=SIZE))
    radiance = 0.3 + np.maximum(way @ [0.8, 0.5, 0.2], 0)[..., None] * [1.0, 0.8, 0.6]
    radiance.reshape(-1, 3)[np.argmax(way.reshape(-1, 3) @ [0.7, 0.6, -0.2])] = 40.0
    return Environment(jnp.asarray(radiance, jnp.float32))


def irradiance(normal: np.ndarray) -> np.ndarray:
    """Irradiance / pi of the square with another normal: its own horizon hides what is below."""
    way, area = (np.asarray(each(size=SIZE), np.float64) for each in (cubemap.direction, cubemap.solid_angle))
    cosine = np.where(way[..., 1] > 0, np.maximum(way @ normal, 0), 0)
    return np.einsum("frt,frtc->c", cosine * area, np.asarray(light().radiance, np.float64)) / np.pi


@pytest.mark.parametrize("hand", [1.0, -1.0])
def test_matte_surfaces_reflect_by_the_normal_of_the_map(hand):
    ready = prt.precompute(square(hand, normal_texture=tilted(), **MATTE), system="lobe", size=SIZE, progress=False)
    normal = np.array([TILT[0], TILT[2], -hand * TILT[1]])
    expected = 0.8 * irradiance(normal / np.linalg.norm(normal))
    assert np.linalg.norm(0.8 * irradiance(np.array([0, 1.0, 0])) / expected - 1) > 0.15
    picture = np.asarray(ready.picture(light(), CAMERA, samples=1)).reshape(-1, 3)
    np.testing.assert_allclose(picture, np.broadcast_to(expected, picture.shape), rtol=MATTE_ERROR)
    vertices = ready.radiance(light(), eye=CAMERA.eye)
    np.testing.assert_allclose(vertices, np.broadcast_to(expected, (4, 3)), rtol=MATTE_ERROR)
    kept = ready.picture_view(CAMERA, samples=1).picture(light())
    np.testing.assert_allclose(kept.reshape(-1, 3), picture, rtol=1e-5)


def test_matte_harmonics_reflect_linear_light_by_the_normal_of_the_map():
    scene = square(-1.0, normal_texture=tilted(), **MATTE)
    ready = prt.precompute(scene, system=Harmonics(degree=2), size=SIZE, progress=False)
    linear = Environment(1 + cubemap.direction(size=SIZE))
    expected = 0.8 * (1 + 2 / 3 * np.array([TILT[0], TILT[2], TILT[1]]) / np.linalg.norm(TILT))
    picture = np.asarray(ready.picture(linear, CAMERA, samples=1)).reshape(-1, 3)
    np.testing.assert_allclose(picture, np.broadcast_to(expected, picture.shape), rtol=0.01)
    np.testing.assert_allclose(ready.radiance(linear, eye=CAMERA.eye), np.broadcast_to(expected, (4, 3)), rtol=0.01)


@pytest.mark.parametrize(
    ("recipe", "material", "said"),
    [
        (Terms(), MATTE, "Terms does not show the normal_texture of the parts ['square'] as it is: they look flat"),
        (Clusters(), MATTE, "Clusters .*: they look flat; use the lobe or the dynamic system"),
        (Terms(), GLOSSY, "Terms .*: they turn highlights by half of its angle"),
        (Clusters(), GLOSSY, "Clusters .*: they turn highlights by half of its angle"),
        (Harmonics(), GLOSSY, "Harmonics .*: they turn highlights by half of its angle"),
        (Harmonics(), MATTE, None),
        (Lobes(), MATTE, None),
        (Lobes(), GLOSSY, None),
        (Dynamic(), MATTE, None),
        (Dynamic(), GLOSSY, None),
    ],
)
def test_systems_that_do_not_show_normal_maps_say_so(recipe, material, said):
    parts = square(normal_texture=tilted(), **material).parts
    shading = build.shaded(parts, [recipe])
    with warnings.catch_warnings() if said is None else pytest.warns(UserWarning, match=said.replace("[", r"\[")):
        warn.of_omissions(parts, shading, [recipe])
        warn.of_omissions(square(**material).parts, shading, [recipe])


def test_one_warning_names_all_parts_of_a_system():
    parts = square(normal_texture=tilted(), **MATTE).parts * 6
    with pytest.warns(UserWarning, match="and 2 more") as said:
        warn.of_omissions(parts, build.shaded(parts, [Terms()] * 6), [Terms()] * 6)
    assert len(said) == 1


def test_lobes_are_turned_by_the_map_as_exact_pixels_are():
    ready = glossy()
    exact = exact_pixels(ready.scene, ready.shading, [light()], CAMERA, points=1)
    flat = prt.precompute(square(**GLOSSY), system=Lobes(lobes=4, texels=8), size=SIZE, progress=False)
    assert exact.relative_l2(ready.picture(light(), CAMERA, samples=1))[0] < GLOSSY_ERROR
    assert exact.relative_l2(flat.picture(light(), CAMERA, samples=1))[0] > 3 * GLOSSY_ERROR


def test_another_map_is_a_new_material_and_its_scale_has_gradients(close):
    ready, weight = glossy(), np.random.default_rng(1).uniform(0.5, 1.5, (8, 8, 3)).astype(np.float32)

    def picture(scale, normal=(-0.2, 0.1, 0.9)):
        new = TexturedMaterial(normal_texture=tilted(normal), normal_scale=scale, **GLOSSY)
        return ready.picture(light(), CAMERA, samples=1, materials={"square": new}, shadows="vertices")

    other = prt.precompute(
        square(normal_texture=tilted((-0.2, 0.1, 0.9)), **GLOSSY), system=Lobes(4, 8), size=SIZE, progress=False
    )
    close(picture(1.0), other.picture(light(), CAMERA, samples=1, shadows="vertices"), tolerance=1e-5)
    slope = jax.grad(lambda scale: jnp.vdot(weight, picture(scale)))(jnp.float32(0.7))
    step = 0.02
    difference = (np.vdot(weight, picture(0.7 + step)) - np.vdot(weight, picture(0.7 - step))) / (2 * step)
    np.testing.assert_allclose(slope, difference, rtol=0.03)


def test_a_scene_without_normal_maps_has_none_at_its_points():
    flat = prt.precompute(square(**GLOSSY), system=Lobes(lobes=4, texels=8), size=SIZE, progress=False)
    assert flat.stage.table.frame is None
    view = flat.picture_view(CAMERA, samples=1)
    assert all(row.viewed.points.normal is row.viewed.sight.above is None for row in view.rows)
    with pytest.raises(ValueError, match="normal maps only in scenes that were precomputed with one"):
        flat.picture(light(), CAMERA, materials={"square": TexturedMaterial(normal_texture=tilted(), **GLOSSY)})
