"""Lamps of scenes: parts that emit, and point lights, free in color and strength."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt import lobe
from jaxprt.brdf import Lambert
from jaxprt.image import automatic_exposure
from jaxprt.relit import Harmonics, RelitScene, exact, exact_lamps, probes, reflection
from jaxprt.relit.channels import of_part
from jaxprt.scene import Camera, Environment, Part, PointLight, Scene, TexturedMaterial, builtin
from jaxprt.scene.environment import background
from jaxprt.scene.mesh import make_mesh
from jaxprt.sphere import cubemap

EYE = jnp.array([0.4, 1.5, 2.0])
CAMERA = Camera(EYE, [0.0, 0.3, 0.0], [0.0, 1.0, 0.0], 1.0, 24, 16)
DARK = Environment(jnp.zeros((6, 8, 8, 3)))
PLANE = builtin.plane(cells=4)
BLACK = {"base_color": 0.0, "metallic": 0.0, "specular": 0.0}
WARM = (4.0, 3.0, 2.0)
BULB = PointLight("bulb", [-0.5, 0.8, 0.3], [0.5, 0.6, 0.7])


@pytest.fixture(scope="module", autouse=True)
def small(coarse, bound):
    """Small tables of lobes."""
    with pytest.MonkeyPatch.context() as patch:
        bound(patch, lobe.tabulate, resolution=12, lobes=2)
        yield


@functools.cache
def scene() -> Scene:
    place = np.asarray(PLANE.position)
    floor = make_mesh(place, PLANE.face, normal=PLANE.normal)
    panel = make_mesh(0.3 * place[:, [0, 2, 1]] + [0, 0.6, -0.8], PLANE.face, normal=np.tile([0.0, 0.0, 1.0], (25, 1)))
    clay = TexturedMaterial(base_color=(0.5, 0.6, 0.7), metallic=0.0, roughness=0.6)
    parts = [Part("floor", floor, clay), Part("panel", panel, TexturedMaterial(**BLACK, emissive=WARM))]
    return Scene(parts, [CAMERA], point_lights=[BULB])


OFF = {"panel": TexturedMaterial(**BLACK), "bulb": dataclasses.replace(BULB, intensity=np.zeros(3))}


@functools.cache
def around() -> Environment:
    return Environment(jnp.asarray(np.random.default_rng(0).uniform(size=(6, 8, 8, 3)).astype(np.float32)))


@functools.cache
def relit() -> RelitScene:
    return prt.precompute(scene(), refine=False, system=Harmonics(degree=2), size=8, progress=False)


def test_lamps_shine_and_light_others_and_add_to_the_light_around(close):
    color = np.asarray(relit().radiance(DARK, eye=EYE))
    np.testing.assert_array_equal(color[25:], np.broadcast_to(np.float32(WARM), (25, 3)))
    # What one lamp sends and what another sends add up, in each color by itself.
    red = {"panel": TexturedMaterial(**BLACK, emissive=(4.0, 0.0, 0.0)), "bulb": OFF["bulb"]}
    rest = {"panel": TexturedMaterial(**BLACK, emissive=(0.0, 3.0, 2.0))}
    close(sum(np.asarray(relit().radiance(DARK, eye=EYE, materials=each)) for each in (red, rest)), color)
    batch = Environment(jnp.stack([around().radiance, DARK.radiance]))
    whole, bare = (np.asarray(relit().radiance(batch, eye=EYE, materials=each)) for each in (None, OFF))
    close(whole[1], color)
    assert not np.any(bare[1])
    close(whole[0], bare[0] + color)


def test_exposure_is_not_of_lamps():
    camera = dataclasses.replace(CAMERA, target=np.array([0.0, 0.5, -0.8]), field_of_view=0.4)
    layers = relit().picture(DARK, camera, layers=["color", "part"])
    picture, panel = layers["color"], np.asarray(layers["part"]) == 1
    inside = np.all([np.roll(panel, step, axis) for axis in (0, 1) for step in (-1, 0, 1)], 0)
    assert inside.sum() > 5
    brighter = jnp.where(inside[..., None], 1e4, picture)
    stops = float(relit().exposure(picture, camera))
    assert float(relit().exposure(brighter, camera)) == pytest.approx(stops, abs=1e-5)
    assert float(automatic_exposure(brighter, coverage=relit().coverage(camera))) < stops - 2


def test_layers_by_light_are_pictures_of_their_light_alone_and_add_up(close):
    right = (np.asarray(cubemap.direction(size=8))[..., 0] > 0).astype(np.float32)
    traced = relit().picture_view()
    close(sum(traced.mix(around(), regions={"right": right}).values()), traced.picture(around()))
    layers = relit().picture_view(shadows="vertices").mix(around(), regions={"right": right})
    assert list(layers) == ["right", "panel", "bulb", "rest", "background"]
    alone = {
        "right": (Environment(around().radiance * right[..., None]), OFF),
        "panel": (DARK, {"bulb": OFF["bulb"]}),
        "bulb": (DARK, {"panel": OFF["panel"]}),
        "rest": (Environment(around().radiance * (1 - right[..., None])), OFF),
    }
    for name, (light, materials) in alone.items():
        picture = relit().picture(light, materials=materials, background=None, shadows="vertices")
        close(layers[name], picture[..., :3], tolerance=1e-4)


def test_pictures_have_the_derivatives_of_their_lamps():
    """By the light of the panel and by the color of the floor; a picture is linear in the first."""

    def brightness(emitted, base):
        panel = TexturedMaterial(**BLACK, emissive=emitted * jnp.array(WARM))
        clay = dataclasses.replace(scene().parts[0].material, base_color=base * jnp.array([0.5, 0.6, 0.7]))
        return jnp.mean(relit().picture(DARK, samples=1, materials={"panel": panel, "floor": clay}))

    slopes = jax.grad(brightness, (0, 1))(1.0, 1.0)
    steps = brightness(2.0, 1.0) - brightness(1.0, 1.0), (brightness(1.0, 1.1) - brightness(1.0, 0.9)) / 0.2
    np.testing.assert_allclose(slopes, steps, rtol=1e-3)


def test_shadows_between_vertices_are_at_their_pixels():
    """A board within one cell of the floor, under the bulb: the inverse square law outside of its shadow, 0 inside."""
    low, high, y = np.array([0.05, 0.05]), np.array([0.4, 0.4]), 0.4
    place = np.asarray(PLANE.position)[:, [0, 2]]
    place = (place - place.min(0)) / np.ptp(place, axis=0) * (high - low) + low
    place = np.stack([place[:, 0], 0 * place[:, 0] + y, place[:, 1]], 1)
    board = make_mesh(place, PLANE.face, normal=PLANE.normal)
    above = PointLight("bulb", [0.2, 0.8, 0.2], np.pi)
    floor = Part("floor", scene().parts[0].mesh, Lambert(0.5))
    parts = [floor, Part("board", board, TexturedMaterial(**BLACK))]
    lit = prt.precompute(
        Scene(parts, [CAMERA], point_lights=[above]), refine=False, system=Harmonics(degree=2), size=8, progress=False
    )
    view = lit.picture_view(samples=1)
    ray, eye = np.asarray(view.ray), np.asarray(EYE)
    on_floor, on_board = (eye + (height - eye[1]) / ray[..., 1:2] * ray for height in (0.0, y))
    way = np.asarray(above.position) - on_floor
    through = on_floor + way * y / 0.8

    def inside(where: np.ndarray, room: float) -> np.ndarray:
        return np.all((where[..., ::2] > low - room) & (where[..., ::2] < high + room), -1)

    shown = (np.abs(on_floor[..., ::2]).max(-1) < 0.95) & (ray[..., 1] < 0) & ~inside(on_board, 0.1)
    expected = 0.5 * way[..., 1] / np.sum(way**2, -1) ** 1.5 * ~inside(through, 0)
    clear = shown & (inside(through, 0.06) == inside(through, -0.06))
    assert np.sum(clear & inside(through, 0)) > 3
    got, interpolated = (
        np.asarray(lit.picture(DARK, samples=1, shadows=shadows))[..., 0] for shadows in ("rays", "vertices")
    )
    assert np.linalg.norm((got - expected)[clear]) < 0.01 * np.linalg.norm(expected[clear])
    assert np.linalg.norm((interpolated - expected)[clear]) > 0.1 * np.linalg.norm(expected[clear])
    np.testing.assert_allclose(np.asarray(view.picture(DARK))[..., 0], got, atol=1e-6)

    def total(intensity):
        dimmed = {"bulb": PointLight("bulb", above.position, intensity)}
        return jnp.sum(lit.picture(DARK, samples=1, materials=dimmed))

    np.testing.assert_allclose(jax.grad(total)(1.0), total(1.0), rtol=1e-4)


@functools.cache
def hollow(bounces: int | str) -> RelitScene:
    """A hollow sphere that glows inside."""
    ball = builtin.sphere(rings=10, sectors=16)
    inside = make_mesh(ball.position, ball.face[:, ::-1], normal=-ball.normal)
    glowing = TexturedMaterial(base_color=0.5, metallic=0.0, specular=0.0, emissive=1.0)
    options = {"refine": False, "system": Harmonics(degree=2), "size": 8, "progress": False}
    return prt.precompute(Scene([Part("hollow", inside, glowing)]), bounces=bounces, **options)


def test_lamps_are_reflected_any_number_of_times_in_proportion_to_their_color(close):
    """In a hollow sphere of albedo 1/2 each bounce has half of the light of the one before it."""
    eye = jnp.array([0.1, 0.2, 0.3])
    for bounces, share in ((2, 0.75), ("all", 1.0)):
        ready = hollow(bounces)
        whole, direct = (scene.radiance(DARK, eye=eye) for scene in (ready, ready.without_bounces()))
        np.testing.assert_allclose(direct, 1.5, rtol=0.02)  # 1 is the emission; the sphere has flat faces
        np.testing.assert_allclose(whole - direct, share * (direct.mean() - 1), rtol=0.01)
    red = TexturedMaterial(base_color=0.5, metallic=0.0, specular=0.0, emissive=(3.0, 0.0, 0.0))
    close(ready.radiance(DARK, eye=eye, materials={"hollow": red}), np.asarray(whole) * (3.0, 0.0, 0.0))
    shading = of_part(ready.scene.parts[0])
    np.testing.assert_allclose(reflection.fractions([shading], [DARK])[:, 0], [0.5, 0.25, 0.125], rtol=0.03)


def test_probes_see_the_light_and_the_parts_where_they_are(close):
    """Far above, a probe sees the environment alone; near the panel, the panel's radiance in its direction."""
    far, near = probes.sample(relit(), around(), [[0, 80.0, 0], [0.0, 0.6, -0.5]], size=4)
    close(np.asarray(far.radiance), np.asarray(background(around(), cubemap.direction(size=4))))
    # Faces are +x, -x, +y, -y, +z, -z: the panel fills most of the last, the floor most of the fourth.
    np.testing.assert_allclose(np.asarray(near.radiance)[5, 1:3, 1:3], np.broadcast_to(WARM, (2, 2, 3)), rtol=1e-5)
    behind = np.asarray(background(around(), cubemap.direction(size=4)))[4]
    close(np.asarray(near.radiance)[4, :2], behind[:2])


def test_reference_light_of_lamps_has_its_closed_forms():
    """Below the middle of a square lamp (Howell's configuration factor B-4, four times), and below a point light."""
    square, height = np.array([[-1, 1, -1], [1, 1, -1], [1, 1, 1], [-1, 1, 1]], float) * [0.4, 0.6, 0.4], 0.6
    panel = make_mesh(square, np.array([[0, 1, 2], [0, 2, 3]]))  # its normals point down
    matte = TexturedMaterial(base_color=0.5, metallic=0.0, specular=0.0)
    parts = [Part("floor", PLANE, matte), Part("panel", panel, TexturedMaterial(**BLACK, emissive=WARM))]
    bulb = PointLight("bulb", [0.0, 0.3, 0.0], 2.0)
    middle, eye = np.array([12]), jnp.array([0.5, 1.0, 0.2])
    np.testing.assert_allclose(PLANE.position[12], 0, atol=1e-6)

    def color(*part, **lights):
        case = Scene(part, **lights)
        shadings = [of_part(each) for each in case.parts]
        return exact_lamps.Lamps.of(case, shadings).at_vertices(PLANE, Lambert(0.5), middle, eye)[0]

    side = 0.4 / np.hypot(0.4, height)
    factor = 4 / np.pi * side * np.arctan(side)
    np.testing.assert_allclose(color(*parts), 0.5 * factor * np.array(WARM), rtol=5e-3)
    np.testing.assert_allclose(color(parts[0], point_lights=[bulb]), 0.5 / np.pi * 2 / 0.3**2, rtol=1e-3)


def test_reports_measure_lamps_too():
    """Parts that only lamps light have an error, which is that of the lamps."""
    report = relit().report([DARK])
    assert 0 < report.part[0].errors[0] < 0.2
    assert 0 < report.part[0].vertex_errors[0] < 0.2


def test_exact_pictures_under_gray_light_have_the_colors_of_lamps():
    gray = Environment(jnp.full((6, 8, 8, 1), 0.3))
    parts = scene().parts
    picture = exact.exact_picture(scene(), [of_part(part) for part in parts], [gray], CAMERA).color[0]
    close_to = np.asarray(relit().picture(gray, CAMERA))
    assert picture.shape == close_to.shape == (16, 24, 3)
    assert np.linalg.norm(picture - close_to) < 0.1 * np.linalg.norm(picture)


ONE = np.ones((6, 8, 8))
REGIONS = [
    ({"panel": ONE}, "other than panel, bulb, rest, background"),
    ({"a/b": ONE}, "a name of letters"),
    ({"one": ONE, "two": ONE}, "add up to at most 1 in each texel, got 2"),
    ({"sun": ONE[:, :4, :4]}, "must have the"),
    ({"sun": 2 * ONE}, "must be from 0 to 1, got 2 to 2"),
    ({"sun": np.nan * ONE}, "finite"),
]
GLOWING = {"floor": TexturedMaterial(roughness=0.6, metallic=0.0, emissive=1.0)}
TURNED = {"bulb": PointLight("bulb", BULB.position, 1.0, axis=[0, -1, 0])}
MATERIALS = [
    (GLOWING, "'floor' was precomputed without emis"),
    ({"bulb": PointLight("bulb", [0, 1, 0], 1.0)}, "point light 'bulb' was traced from"),
    (TURNED, r"traced with the axis and cone of all directions, got \[0.0, -1.0, 0.0\], \(0.0"),
    ({"sun": PointLight("sun", [0, 1, 0], 1.0)}, r"point lights must be among those of the scene, \['bulb'\]"),
]


def test_regions_that_are_none_and_lamps_that_were_not_precomputed_are_refused():
    view = relit().picture_view()
    for regions, words in REGIONS:
        with pytest.raises(ValueError, match=words):
            view.mix(DARK, regions=regions)
    for materials, words in MATERIALS:
        with pytest.raises(ValueError, match=words):
            relit().radiance(DARK, eye=EYE, materials=materials)
    with pytest.raises(ValueError, match="several named"):
        Scene(scene().parts, point_lights=[PointLight("floor", [0, 1, 0])])
    with pytest.raises(ValueError, match=r"positions must be \[p, 3\], got \[3\]"):
        probes.sample(relit(), DARK, np.zeros(3))
