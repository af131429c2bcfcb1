"""Shadows of bright texels by rays from the points of pictures, beside closed forms."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt.relit import Lobes, shadows
from jaxprt.relit.exact import exact_pixels
from jaxprt.scene import Camera, Environment, Part, Scene, TexturedMaterial, builtin
from jaxprt.scene.mesh import make_mesh
from jaxprt.sphere import cubemap

SIZE = 8
CAMERA = Camera([0.0, 4.0, 0.001], [0.0, 0.0, 0.0], [0.0, 0.0, -1.0], 0.9, 64, 64)
SQUARE = np.array([[-1.0, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]])
FACE = np.array([[0, 1, 2], [0, 2, 3]])
SUN = 2 * SIZE**2 + (SIZE // 2) * SIZE + SIZE - 1  # a texel near +y
HEIGHT = 0.6  # of the lid


def sunny(strength: float = 50.0, texel: int = SUN) -> Environment:
    radiance = jnp.full((6 * SIZE**2, 3), 0.2).at[texel].set(strength)
    return Environment(radiance.reshape(6, SIZE, SIZE, 3))


@pytest.fixture(scope="module")
def relit():
    """A floor of four vertices, all of them in the sun, and a small lid above its middle."""
    floor = Part("floor", make_mesh(1.5 * SQUARE, FACE), TexturedMaterial(metallic=0.0, specular=0.0))
    lid = make_mesh(0.4 * SQUARE + [0, HEIGHT, 0], FACE)
    scene = Scene([floor, Part("lid", lid, TexturedMaterial(metallic=0.0, specular=0.0))], [CAMERA])
    return prt.precompute(scene, refine=False, system=Lobes(lobes=12, texels=4), size=SIZE, progress=False)


def test_the_shadow_of_a_sun_is_where_it_belongs_on_a_floor_of_four_vertices(relit):
    traced = np.asarray(relit.picture(sunny(), samples=1))[..., 0]
    without = np.asarray(relit.picture(sunny(), samples=1, shadows="vertices"))[..., 0]
    ray = np.asarray(prt.image.raster.ray_direction(CAMERA), float)
    place = np.asarray(CAMERA.eye) - ray * (np.asarray(CAMERA.eye)[1] / ray[..., 1])[..., None]
    way = np.asarray(cubemap.direction(size=SIZE)).reshape(-1, 3)[SUN]
    high = (place + HEIGHT / way[1] * way)[..., [0, 2]]  # where the ray to the sun's middle passes the lid
    blur = HEIGHT * 2 / SIZE  # penumbra of the texel
    shown = np.any(np.abs(place[..., [0, 2]]) > 0.4 * 4 / (4 - HEIGHT) + 0.06, -1)  # not behind the lid
    dark = np.all(np.abs(high) < 0.4 - blur, -1) & shown
    bright = np.any(np.abs(high) > 0.4 + blur, -1) & shown & np.all(np.abs(place[..., [0, 2]]) < 1.4, -1)
    assert bright.sum() > 200
    sun = 50.0 * np.asarray(cubemap.vector_area(size=SIZE)).reshape(-1, 3)[SUN, 1] / np.pi
    assert np.all(traced[bright] > 0.95 * sun)
    assert np.all(without[bright] > 0.95 * sun)
    assert dark.sum() >= 4
    assert np.all(traced[dark] < 0.4)
    assert np.all(without[dark] > 0.9 * sun)  # Interpolation between the corners knows nothing of the lid.


def test_a_low_sun_shines_from_its_place_in_the_file(relit, tmp_path):
    """It is a tenth of a texel wide, and the middle of its texel is half as high again."""
    path, height, width = tmp_path / "low.exr", 128, 256
    image = np.zeros((height, width, 3), np.float32)
    row, column = height // 2 - 7, 5 * width // 8
    image[row, column] = 1e4
    prt.files.write_exr(path, image)
    edge = np.cos(np.pi * np.array([row, row + 1]) / height)
    irradiance = 1e4 * (edge[0] - edge[1]) * 2 * np.pi / width * edge.mean()
    light = prt.load_environment(path, size=SIZE)
    way = np.asarray(cubemap.direction(size=SIZE)).reshape(-1, 3)[int(jnp.argmax(jnp.sum(light.radiance, -1)))]
    assert abs(way[1] / edge.mean() - 1) > 0.2
    found = np.asarray(relit.picture(light, samples=1))
    np.testing.assert_allclose(found[10:16, 10:16], irradiance / np.pi, rtol=0.02)


def test_lights_without_bright_texels_trace_nothing(relit):
    even = Environment(jnp.full((6, SIZE, SIZE, 3), 0.7))
    view = relit.picture_view()
    assert shadows.trace(relit.mesh, view.pixels, CAMERA.width, even, keep=False) is None
    np.testing.assert_array_equal(view.picture(even), relit.picture_view(shadows="vertices").picture(even))


def test_what_exceeds_the_next_brightest_texels_is_taken_out_of_the_light():
    rest = shadows.untraced(sunny())
    taken = np.asarray(sunny().radiance - rest.radiance).reshape(-1, 3)
    area = np.asarray(cubemap.solid_angle(size=SIZE), np.float64).ravel()
    level = np.sort(0.2 * np.delete(area, SUN))[-32]  # flux of the 33rd brightest texel
    np.testing.assert_allclose(taken[SUN], 50 - level / area[SUN], rtol=1e-5)
    assert np.all(np.delete(taken, SUN, 0) == 0)


def test_a_kept_view_traces_new_texels_alone(relit, monkeypatch):
    view, cast = relit.picture_view(), shadows._cast
    traced = []
    monkeypatch.setattr(shadows, "_cast", lambda *given: traced.append(len(given[3].per_texel)) or cast(*given))
    brighter = Environment(1.6 * sunny().radiance)
    for light, count in ((sunny(), 1), (sunny(51.0), None), (brighter, None), (sunny(texel=SUN + 3), 1)):
        color = view.picture(light)
        assert traced == ([] if count is None else [count])
        traced.clear()
        np.testing.assert_allclose(color, relit.picture(light), rtol=1e-5, atol=1e-6)
        traced.clear()


def below_a_bar(material: TexturedMaterial) -> tuple[prt.relit.RelitScene, Environment]:
    """A floor of few vertices below a bar, and three soft boxes of more texels than are traced one by one."""
    grid = builtin.plane(cells=5)
    bar = make_mesh(SQUARE * [0.15, 0, 1.2] + [0, 0.35, 0], FACE)
    parts = [Part("floor", grid, material), Part("bar", bar, material)]
    ready = prt.precompute(Scene(parts, [CAMERA]), refine=False, system=Lobes(4, 4), size=16, progress=False)
    radiance = np.full((6, 16, 16, 3), 0.05)
    for face, row, column in ((2, 6, 10), (2, 8, 2), (0, 4, 6)):
        radiance[face, row : row + 4, column : column + 4] = 20, 15, 10
    return ready, Environment(jnp.asarray(radiance, jnp.float32))


def measure_of(ready: prt.relit.RelitScene, light: Environment):
    """The error of a picture of the floor in the soft boxes, relative to the norm."""
    exact = exact_pixels(ready.scene, ready.shading, [light], CAMERA, pixels=300)
    assert exact.error[0] < 0.004

    def measure(picture):
        there = exact.part == 0
        wrong = np.asarray(picture).reshape(-1, 3)[exact.pixel] - exact.color[0]
        return np.linalg.norm(wrong[there]) / np.linalg.norm(exact.color[0][there])

    return measure


@pytest.fixture(scope="module")
def glossy():
    return below_a_bar(TexturedMaterial(metallic=1.0, roughness=0.9))


@pytest.fixture(scope="module")
def off(glossy):
    return measure_of(*glossy)


def test_soft_boxes_are_hidden_between_vertices_of_matte_parts_too():
    ready, light = below_a_bar(TexturedMaterial(metallic=0.0, specular=0.0))
    assert all(surface.matte for surface in ready.surfaces)
    off = measure_of(ready, light)
    assert off(ready.picture(light)) < 0.025  # 48 of the bright texels and cells are traced.
    assert off(ready.picture(light, shadows="vertices")) > 0.07
    np.testing.assert_allclose(ready.picture_view().picture(light), ready.picture(light), rtol=1e-5, atol=1e-6)


def test_soft_boxes_are_hidden_where_they_are_between_vertices(glossy, off):
    ready, light = glossy
    rays, vertices = (ready.picture(light, shadows=way) for way in ("rays", "vertices"))
    assert off(rays) < 0.015
    assert off(vertices) > 0.07
    view = ready.picture_view()
    for of_light in (light, Environment(light.radiance[..., ::-1]), light):
        np.testing.assert_allclose(view.picture(of_light), ready.picture(of_light), rtol=1e-5, atol=1e-6)
    # What JAX traces, and a view for one light, interpolates the shares of cells.
    fixed = ready.picture_view(shadows=light)
    assert off(fixed.picture(light)) > 0.07
    np.testing.assert_allclose(
        jax.jit(lambda light: fixed.picture(light))(light), fixed.picture(light), rtol=1e-4, atol=1e-5
    )


def test_pictures_with_rays_to_cells_have_derivatives_by_materials(glossy):
    ready, light = glossy

    def total(roughness):
        materials = {"floor": TexturedMaterial(metallic=1.0, roughness=roughness)}
        return jnp.sum(ready.picture(light, materials=materials) ** 2)

    step = 1e-2
    difference = (total(0.8 + step) - total(0.8 - step)) / (2 * step)
    np.testing.assert_allclose(jax.grad(total)(0.8), difference, rtol=1e-2)


def test_rough_parts_have_cells_also_beside_smooth_ones_but_these_alone_have_none(glossy, off):
    ready, light = glossy
    floor, bar = ready.scene.parts
    assert [(group.system.cells, group.system.by_lobes) for group in ready.surfaces] == [(True, False)]

    def made(*parts):
        return prt.precompute(Scene(list(parts)), refine=False, system=Lobes(12, 4), size=16, progress=False)

    smooth = TexturedMaterial(metallic=1.0, roughness=0.1)
    mixed = made(floor, dataclasses.replace(bar, material=smooth))
    assert [(group.system.cells, group.system.by_lobes) for group in mixed.surfaces] == [(True, True)]
    assert off(mixed.picture(light, CAMERA)) < 0.02
    alone = made(dataclasses.replace(floor, material=smooth))
    assert [group.system.cells for group in alone.surfaces] == [False]
    (group,) = mixed.surfaces
    without = dataclasses.replace(group.system, cells=False, by_lobes=False)
    plain = prt.RelitScene(mixed.scene, mixed.shading, mixed.layout, [without])
    assert off(plain.picture(light, CAMERA)) > 0.06


@pytest.mark.usefixtures("unchecked")
def test_other_words_are_refused(relit):
    with pytest.raises(ValueError, match='shadows must be "rays", "vertices" or an Environment, got \'soft\''):
        relit.picture(sunny(), shadows="soft")
    with pytest.raises(TypeError, match='shadows must be "rays" or "vertices"'):
        relit.picture(sunny(), shadows=sunny())
