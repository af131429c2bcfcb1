"""Pictures of scenes: radiance and textures at pixels, against exact pixels, closed forms and the vertices."""

import contextlib
import dataclasses
import functools
from collections.abc import Iterator
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax._src import monitoring

import jaxprt as prt
from jaxprt import bounces, lobe, visibility
from jaxprt.brdf import CookTorrance, Lambert
from jaxprt.image import rasterize
from jaxprt.relit import Harmonics, Lobes, RelitScene, canvas, channels, probes, shadows, tracing
from jaxprt.relit.exact import exact_picture, exact_pixels
from jaxprt.scene import Camera, Environment, Part, Scene, TexturedMaterial, builtin
from jaxprt.scene.environment import environment_from_image
from jaxprt.scene.material import Texture
from jaxprt.scene.mesh import make_mesh
from jaxprt.scene.points import Points, on_triangles

SIZE = 8
CAMERA = Camera([0.6, 2.2, 2.6], [0.0, 0.4, 0.0], [0.0, 1.0, 0.0], 0.9, 20, 16)
SHARP = CookTorrance(diffuse=0.3, specular=0.7, roughness=0.3, f0=0.6)
SQUARE = np.array([[-1.0, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]])
CORNERS = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])


@pytest.fixture(scope="module", autouse=True)
def small(coarse, bound):
    """Small maps, and rows of few points, so that parts have several."""
    with pytest.MonkeyPatch.context() as patch:
        bound(patch, lobe.tabulate, resolution=12)
        bound(patch, bounces.precompute, edge=2, size=8, components=8, modes=8)
        patch.setattr(canvas, "ROW", 64)
        yield


def image(edge: int = 8) -> np.ndarray:
    return np.random.default_rng(0).uniform(0.1, 0.9, (edge, edge, 3)).astype(np.float32)


def matte() -> TexturedMaterial:
    """What reflects diffusely alone, with a texture of color."""
    return TexturedMaterial(metallic=0.0, specular=0.0, base_color_texture=Texture(image()))


def scene(*, floor=None, ball=SHARP) -> Scene:
    sphere = builtin.sphere(rings=5, sectors=8)
    raised = make_mesh(0.6 * sphere.position + jnp.array([0.0, 0.7, 0.0]), sphere.face, normal=sphere.normal)
    flat = make_mesh(1.5 * SQUARE, np.array([[0, 1, 2], [0, 2, 3]]), texture=CORNERS)
    return Scene([Part("floor", flat, matte() if floor is None else floor), Part("ball", raised, ball)])


def light(seed: int = 1) -> Environment:
    radiance = np.random.default_rng(seed).uniform(0.2, 1.0, (6, SIZE, SIZE, 3))
    return Environment(jnp.asarray(radiance, jnp.float32))


@functools.cache
def relit(system=None, bounces: int = 0) -> RelitScene:
    system = Lobes(lobes=4, texels=0) if system is None else system
    return prt.precompute(scene(), refine=False, system=system, size=SIZE, bounces=bounces, progress=False)


def test_pixels_are_nearer_to_the_exact_ones_than_vertices_are():
    ready = relit()
    camera = dataclasses.replace(CAMERA, width=40, height=32)
    exact = exact_pixels(ready.scene, ready.shading, [light()], camera, pixels=120)
    on_ball = exact.part == 1
    assert exact.color.shape == (1, len(exact.pixel), 3)
    assert 0 < exact.error[0] < 0.05

    def wrong(picture):
        off = np.asarray(picture).reshape(-1, 3)[exact.pixel] - exact.color[0]
        return np.linalg.norm(off[on_ball]) / np.linalg.norm(exact.color[0][on_ball])

    vertices = prt.image.render(ready.mesh, ready.radiance(light(), eye=camera.eye), camera)
    assert wrong(ready.picture(light(), camera)) < 0.06 < wrong(vertices)


def square(material: TexturedMaterial | Lambert) -> Scene:
    """Two triangles."""
    mesh = make_mesh(SQUARE, np.array([[0, 1, 2], [0, 2, 3]]), texture=CORNERS)
    return Scene([Part("square", mesh, material)])


def above(width: int) -> Camera:
    """A camera whose height, of 16 pixels, the square fills."""
    return Camera([0.0, 2.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, -1.0], 2 * np.arctan(0.5), width, 16)


def white(strength: float = 1.0) -> Environment:
    return Environment(jnp.full((6, SIZE, SIZE, 3), strength))


def test_textures_are_read_at_the_pixels_and_averaged_where_they_are_far():
    """In a light that is the same from everywhere the picture is the texture."""
    ready = prt.precompute(square(matte()), refine=False, system=Lobes(4, texels=0), size=SIZE, progress=False)
    picture = ready.picture(white(), above(16), samples=1)
    row = (np.arange(16) + 0.5) / 16
    place = np.stack(np.meshgrid(row, 1 - row), -1)
    np.testing.assert_allclose(picture, Texture(image()).at(jnp.asarray(place, jnp.float32)), atol=0.01)
    checks = np.kron(np.indices((8, 8)).sum(0) % 2, np.ones((4, 4)))[..., None] * np.ones(3)
    far = dataclasses.replace(matte(), base_color_texture=Texture(checks, 8 * np.eye(2, 3)))
    np.testing.assert_allclose(ready.picture(white(), above(16), materials={"square": far}), 0.5, atol=0.02)


def test_more_samples_are_nearer_to_a_picture_of_eight_times_the_size():
    ready = relit()
    fine = dataclasses.replace(CAMERA, width=8 * CAMERA.width, height=8 * CAMERA.height)
    # From 64 pixels, and not from their own samples, which lie elsewhere in the pixel.
    true = np.asarray(ready.picture(light(), fine, samples=1))
    true = true.reshape(CAMERA.height, 8, CAMERA.width, 8, -1).mean((1, 3))
    found = [np.asarray(ready.picture(light(), CAMERA, samples=each)) for each in (1, 4, 16)]
    assert {each.shape for each in found} == {true.shape}
    one, four, sixteen = (np.linalg.norm(each - true) / np.linalg.norm(true) for each in found)
    assert 2 * sixteen < 1.2 * four < one


def test_highlights_of_smooth_metals_are_means_over_their_pixels():
    metal = TexturedMaterial(metallic=1.0, roughness=0.15)
    ball = Scene([Part("ball", builtin.sphere(rings=24, sectors=32), metal)])
    ready = prt.precompute(ball, refine=False, system=Lobes(4, 0), size=16, progress=False)
    camera, studio = Camera([0.0, 0.5, 6.0], [0, 0, 0], [0, 1, 0], 0.6, 24, 20), builtin.studio(size=16)
    fine = dataclasses.replace(camera, width=8 * 24, height=8 * 20)
    true, filled = ready.picture(studio, fine, samples=1), ready.coverage(fine, samples=1)
    true, filled = (np.asarray(each).reshape(20, 8, 24, 8, -1).mean((1, 3)) for each in (true, filled))
    inside = filled[..., 0] == 1
    off = np.linalg.norm((np.asarray(ready.picture(studio, camera)) - true)[inside])
    assert inside.sum() > 40
    assert off < 0.02 * np.linalg.norm(true[inside])  # 0.01; with four points a pixel 0.1


def test_smooth_metals_show_light_that_is_finer_than_the_texels_of_their_scene():
    """Stripes of one texel of 6 x 32 x 32 in a floor, for which visibility has four times as wide texels."""
    row, column = np.indices((64, 128))
    stripes = np.float32(1 + np.sin(2 * np.pi * column / 8) * (row < 32))[..., None] * np.ones(3, np.float32)
    floor = Scene([Part("floor", builtin.plane(cells=1), TexturedMaterial(metallic=1.0, roughness=0.1))])
    camera = Camera([0.0, 0.9, 1.2], [0, 0, 0], [0.0, 1, 0], 0.8, 16, 16)
    colors = []
    for size in (SIZE, 4 * SIZE):
        made = prt.precompute(floor, refine=False, system=Lobes(texels=4), size=size, progress=False)
        known = environment_from_image(stripes, size=size)
        colors.append(np.asarray(made.picture(known, camera, background=None))[..., 0])
        colors.append(np.asarray(made.picture(Environment(known.radiance), camera, background=None))[..., 0])
    fine, coarse, right = colors[:3]
    assert np.linalg.norm(coarse - right) > 0.4 * np.linalg.norm(right)
    assert np.linalg.norm(fine - right) < 0.06 * np.linalg.norm(right)
    traced = jax.jit(lambda eye: made.picture(known, dataclasses.replace(camera, eye=eye), samples=1, background=None))
    one = np.asarray(made.picture(known, camera, samples=1, shadows="vertices", background=None))
    np.testing.assert_allclose(traced(jnp.asarray(camera.eye)), one, atol=1e-4)


def test_pictures_go_through_programs_and_have_gradients(close):
    ready = relit(Harmonics(degree=2))

    def picture(radiance, eye, samples=4):
        camera = dataclasses.replace(CAMERA, eye=eye)
        return ready.picture(Environment(radiance), camera, shadows="vertices", samples=samples)

    radiance = light().radiance
    whole = picture(radiance, CAMERA.eye)
    jitted = jax.jit(picture)(radiance, CAMERA.eye)
    close(jitted, whole, tolerance=0.01)  # JAX traces the camera, so that samples at the rim of the ball are one point
    single = partial(picture, samples=1)
    close(jax.jit(single)(radiance, CAMERA.eye), single(radiance, CAMERA.eye), tolerance=1e-4)
    weight = np.random.default_rng(2).normal(size=whole.shape).astype(np.float32)
    slope = jax.grad(lambda each: jnp.vdot(weight, picture(each, CAMERA.eye)))(radiance)
    close(jnp.vdot(slope, light(2).radiance), np.vdot(weight, picture(light(2).radiance, CAMERA.eye)), tolerance=1e-4)
    turned = jax.jit(jax.vmap(picture, (None, 0)))(radiance, jnp.stack([CAMERA.eye, CAMERA.eye + 0.1]))
    close(turned[0], jitted, tolerance=1e-4)
    for each, tolerance in ((single, 1e-3), (picture, 0.1)):
        by_eye = jax.grad(lambda eye, each=each: jnp.sum(each(radiance, eye)))
        assert np.isfinite(jax.jit(by_eye)(CAMERA.eye)).all()
        close(by_eye(CAMERA.eye), jax.jit(by_eye)(CAMERA.eye), tolerance=tolerance)
    view = ready.picture_view(CAMERA, shadows=light())
    traced = jax.jit(lambda view, light: view.picture(light))(view, light())
    close(traced, view.picture(light()), tolerance=1e-4)
    close(traced, ready.picture(light(), CAMERA), tolerance=1e-4)


def test_scenes_laid_over_devices_give_the_same_pictures(close):
    if len(jax.devices()) < 4:
        pytest.skip("XLA_FLAGS asks for four devices")
    ready = relit()
    laid = prt.shard(ready, jax.devices()[:4])
    assert laid.vertices == ready.vertices
    assert all(len(leaf.devices()) == 4 for leaf in jax.tree.leaves(laid) if isinstance(leaf, jax.Array))
    picture = laid.picture(light(), CAMERA)
    assert len(picture.devices()) == 4
    close(picture, ready.picture(light(), CAMERA), tolerance=2e-5)


def test_exact_pixels_of_a_bare_square_are_closed_forms():
    bare = square(Lambert(0.5))
    exact = exact_pixels(bare, [channels.of_part(bare.parts[0])], [white(), white(3.0)], CAMERA, pixels=40)
    inside = np.isclose(exact.color[0, :, 0], 0.5, atol=1e-3)
    assert inside.mean() > 0.5
    assert np.all((exact.color[0] > 0.5 - 1e-3) & (exact.color[0] < 1 + 1e-3))
    np.testing.assert_allclose(exact.color[1], 3 * exact.color[0], rtol=1e-5)


def test_exact_pixels_count_for_the_pixels_of_their_part():
    ready = relit()
    found = exact_pixels(ready.scene, ready.shading, [light()], CAMERA, pixels=30)
    # The middle of a pixel is a corner of four places; the one below and to the right of it is looked at.
    fine = dataclasses.replace(CAMERA, width=4 * CAMERA.width, height=4 * CAMERA.height)
    triangle = np.asarray(rasterize(ready.mesh, fine).triangle)[2::4, 2::4].ravel()
    part = np.where(triangle < 0, -1, triangle >= 2)
    np.testing.assert_array_equal(found.part, part[found.pixel])
    for number in (0, 1):
        assert np.isclose(found.weight[found.part == number].sum(), np.sum(part == number))
    picture = np.zeros((len(part), 3))
    picture[found.pixel] = found.color[0]
    assert found.relative_l2(picture.reshape(CAMERA.height, CAMERA.width, 3))[0] < 1e-6
    picture[part == 1] = 0
    square = found.weight * np.sum(found.color[0] ** 2, 1)
    expected = np.sqrt(square[found.part == 1].sum() / square.sum())
    measured, spread = found.relative_l2(picture.reshape(CAMERA.height, CAMERA.width, 3))
    np.testing.assert_allclose(measured, expected, rtol=1e-5)
    assert 0 < spread < 0.3 * measured


def test_important_pixels_are_measured_more_often_and_count_for_less():
    ready = relit()
    random = np.random.default_rng(3)
    importance = random.uniform(0.1, 1, (CAMERA.height, CAMERA.width))
    importance[8, 10] = 100  # More often than always.
    found = exact_pixels(ready.scene, ready.shading, [light()], CAMERA, pixels=100, importance=importance, points=1)
    every = exact_pixels(ready.scene, ready.shading, [light()], CAMERA, points=1)
    assert found.weight.min() == 1
    assert 8 * CAMERA.width + 10 in found.pixel
    rest = found.weight > 1
    product = (found.weight * importance.ravel()[found.pixel])[rest]
    np.testing.assert_allclose(product, product[0], rtol=1e-6)
    assert abs(found.weight.sum() / len(every.pixel) - 1) < 0.2
    np.testing.assert_array_equal(every.weight, 1)


def test_exact_pixels_and_pictures_know_how_exact_they_are():
    ready = relit()
    few, many = (exact_pixels(ready.scene, ready.shading, [light()], CAMERA, pixels=80, points=n) for n in (4, 16))
    off = np.sqrt(few.weight @ np.sum((few.color[0] - many.color[0]) ** 2, 1))
    off = off / np.sqrt(many.weight @ np.sum(many.color[0] ** 2, 1))
    assert 0.7 < few.error[0] / off < 2
    picture = exact_picture(ready.scene, ready.shading, [light()], CAMERA)
    assert 0.7 < picture.error[0] / many.relative_l2(picture.color[0])[0] < 2


def test_the_exact_picture_of_a_texture_in_a_white_light_is_the_texture():
    camera, textured = above(CAMERA.width), square(matte())
    found = exact_picture(textured, [channels.of_part(textured.parts[0])], [white(), white(2.0)], camera)
    edge = (np.arange(256) + 0.5) / 256
    fine = Texture(image()).at(jnp.asarray(np.stack(np.meshgrid(edge, 1 - edge), -1), jnp.float32))
    mean = np.asarray(fine).reshape(16, 16, 16, 16, 3).mean((1, 3))
    assert found.camera is camera
    # The square fills all but two columns on either side.
    assert np.linalg.norm(found.color[0][:, 2:-2] - mean) < 0.08 * np.linalg.norm(mean)
    np.testing.assert_allclose(found.color[1], 2 * found.color[0], rtol=1e-4)


def test_the_exact_picture_has_rays_from_its_own_points_on_matte_parts_too():
    matted, floor = scene(floor=Lambert(0.5)), Lambert(0.5)
    shadings = [channels.of_part(part) for part in matted.parts]
    camera = dataclasses.replace(CAMERA, width=2 * CAMERA.width, height=2 * CAMERA.height)
    lights = [light()]
    for arguments, most, message in (
        ((matted, shadings, lights, camera), 0, "most must be at least 1 and at most .*, got 0"),
        ((matted, shadings, [], camera), 400, "there must be one or more lights of one size, got none"),
        (
            (matted, shadings, [*lights, Environment(jnp.ones((6, 4, 4, 3)))], camera),
            400,
            "one or more lights of one size, got .*, ",
        ),
        ((matted, shadings[:1], lights, camera), 400, "a shading for each of 2 parts, got 1"),
    ):
        with pytest.raises(ValueError, match=message):
            exact_picture(*arguments, most=most)
    away = dataclasses.replace(camera, target=2 * np.asarray(camera.eye) - np.asarray(camera.target))
    empty = exact_picture(matted, shadings, lights, away)
    assert (empty.alpha.max(), empty.error.max()) == (0, 0)
    found = exact_picture(matted, shadings, [light()], camera, most=400)
    height, width = found.color.shape[1:3]
    assert (found.camera.width, found.camera.height) == (width, height)
    assert (width, height) == (CAMERA.width, CAMERA.height)
    # A pixel in the shadow of the ball, where its ray meets the floor.
    pixel = height - 2, width // 2
    way = np.asarray(prt.image.ray_direction(found.camera), np.float64)[pixel]
    place = np.asarray(camera.eye) - way * (float(camera.eye[1]) / way[1])
    weight = np.linalg.solve(np.vstack([1.5 * SQUARE[[0, 1, 2]].T[[0, 2]], np.ones(3)]), [place[0], place[2], 1])
    triangle, corner = (0, [0, 1, 2]) if weight.min() >= 0 else (1, [0, 2, 3])
    weight = np.linalg.solve(np.vstack([1.5 * SQUARE[corner].T[[0, 2]], np.ones(3)]), [place[0], place[2], 1])
    points = on_triangles(matted.parts[0].mesh.face, np.array([triangle]), weight[None].astype(np.float32))
    expected = prt.reference.radiance(
        matted.parts[0].mesh, floor, light(), eye=camera.eye, occluder=matted.mesh, points=points
    )
    np.testing.assert_allclose(found.color[0][pixel], expected[0], rtol=0.01)


@contextlib.contextmanager
def compiled() -> Iterator[list[str]]:
    """The programs that are compiled, or loaded from a cache, in a block."""
    events: list[str] = []

    def listen(event: str, *_, **more) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            events.append(str(more))

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield events
    finally:
        monitoring.unregister_event_duration_listener(listen)


def balls(parts: int = 2, *, seed: int = 0) -> Scene:
    """A scene of several parts of one kind and a matte ground, of sizes that do not depend on the seed."""
    random = np.random.default_rng(seed)
    sphere, flat = builtin.sphere(rings=5, sectors=8), scene().parts[0]
    made = [flat]
    for number in range(parts):
        position = 0.3 * np.asarray(sphere.position) + random.uniform(-1, 1, 3) + [0, 1.2, 0]
        own = TexturedMaterial(random.uniform(0.2, 0.9, 3), metallic=number % 2, roughness=random.uniform(0.65, 0.9))
        made.append(Part(f"ball {seed} {number}", make_mesh(position, sphere.face, normal=sphere.normal), own))
    return Scene(made)


def made(scene: Scene) -> RelitScene:
    return prt.precompute(scene, refine=False, system=Lobes(texels=8), size=SIZE, progress=False)


def test_new_cameras_lights_materials_and_scenes_of_the_same_sizes_compile_nothing():
    ready, another = made(balls()), balls(seed=1)
    eyes = [np.asarray(CAMERA.eye) * np.float32(1 + 0.1 * k) for k in range(1, 4)]
    red = TexturedMaterial((0.8, 0.1, 0.1), metallic=0.0, roughness=0.7)
    ready.picture(light(), CAMERA)
    ready.picture(light(), CAMERA, materials={"ball 0 0": red})
    with compiled() as events:
        points = set()
        for k, eye in enumerate(eyes):
            camera = dataclasses.replace(CAMERA, eye=eye)
            ready.picture(light(k), camera)
            points.add(int(np.sum(ready.picture_view(camera).pixels.triangle >= 0)))
        assert len(points) == 3
        blue = TexturedMaterial((0.1, 0.1, 0.8), metallic=1.0, roughness=0.7)
        ready.picture(light(), CAMERA, materials={"ball 0 0": blue, "ball 0 1": red})
        made(another).picture(light(2), CAMERA)
    assert not events


def test_color_without_a_background_is_direct_plus_reflected_light(close):
    ready, names = relit(bounces=1), ["color", "direct", "reflected", "alpha"]
    layers = ready.picture(light(), CAMERA, background=None, layers=names)
    assert list(layers) == names
    close(layers["direct"] + layers["reflected"], layers["color"], tolerance=1e-6)
    bare = relit().picture(light(), CAMERA, background=None)[..., :3]
    close(layers["direct"], bare, tolerance=5e-4)  # Rays show what hides the light from narrow lobes.
    close(ready.with_rays(0).picture(light(), CAMERA, layers=["direct"])["direct"], bare, tolerance=1e-5)
    assert float(jnp.max(layers["reflected"])) > 0.01
    close(layers["alpha"], ready.coverage(CAMERA), tolerance=1e-6)


def test_the_background_is_what_the_picture_adds_to_its_surfaces(close):
    ready, sky = relit(), light(3)
    bare = ready.picture(light(), CAMERA, background=None)
    behind = ready.picture(light(), CAMERA, background=sky) - bare[..., :3]
    close(ready.picture(light(), CAMERA, background=light()), ready.picture(light(), CAMERA), tolerance=1e-6)
    added = ready.picture(light(), CAMERA, background=white()) - bare[..., :3]
    close(added, jnp.broadcast_to(1 - bare[..., 3:], added.shape), tolerance=1e-5)
    assert float(jnp.max(jnp.abs(behind[bare[..., 3] == 1]))) < 1e-6


def test_geometric_layers_lie_on_the_rays_of_their_pixels():
    ready = relit()
    layers = ready.picture(light(), CAMERA, layers=["position", "depth", "normal", "part"])
    layers = {name: np.asarray(layer) for name, layer in layers.items()}
    eye, target = np.array(CAMERA.eye), np.array(CAMERA.target)
    ahead = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(ahead, [0, 1, 0])
    right = right / np.linalg.norm(right)
    seen = layers["part"] >= 0
    away = layers["position"][seen] - eye
    forward = away @ ahead
    np.testing.assert_allclose(layers["depth"][seen], forward, rtol=1e-5)
    assert np.all(np.isinf(layers["depth"][~seen]))
    focal = CAMERA.height / 2 / np.tan(CAMERA.field_of_view / 2)
    row, column = np.nonzero(seen)
    across = CAMERA.width / 2 + focal * (away @ right) / forward
    down = CAMERA.height / 2 - focal * (away @ np.cross(right, ahead)) / forward
    assert np.max(np.abs(across - column - 0.5)) <= 0.5 + 1e-4
    assert np.max(np.abs(down - row - 0.5)) <= 0.5 + 1e-4
    ball, floor = layers["part"] == 1, layers["part"] == 0
    np.testing.assert_allclose(layers["position"][floor][:, 1], 0, atol=1e-5)
    outward = layers["position"] - [0, 0.7, 0]
    length = np.linalg.norm(layers["normal"], axis=-1)
    inside = ball & (length > 0.9)  # means over pixels that the ball fills
    assert np.count_nonzero(inside) > 10
    cosine = np.sum(layers["normal"] * outward, -1)[inside] / (length * np.linalg.norm(outward, axis=-1))[inside]
    assert np.min(cosine) > 0.95
    assert np.median(cosine) > 0.98


def test_albedo_is_the_texture_and_roughness_that_of_the_material():
    layers = relit().picture(light(), CAMERA, layers=["albedo", "roughness", "part", "alpha"])
    layers = {name: np.asarray(layer) for name, layer in layers.items()}
    texels = image().reshape(-1, 3)
    floor = (layers["part"] == 0) & (layers["alpha"] == 1)
    assert np.all(layers["albedo"][floor] >= texels.min(0) - 1e-5)
    assert np.all(layers["albedo"][floor] <= texels.max(0) + 1e-5)
    assert np.std(layers["albedo"][floor], axis=0).min() > 0.01
    assert np.all(layers["albedo"][layers["alpha"] == 0] == 0)


def test_pictures_of_lights_and_cameras_are_those_of_a_loop(close):
    ready, cameras = relit(bounces=1), [CAMERA, dataclasses.replace(CAMERA, eye=[-1.0, 1.8, 2.4])]
    lights = [light(1), light(2), light(3)]
    together = ready.pictures(lights, cameras)
    assert together.shape == (3, 2, CAMERA.height, CAMERA.width, 3)
    for number, one in enumerate(lights):
        for view, camera in enumerate(cameras):
            close(together[number, view], ready.picture(one, camera), tolerance=1e-6)
    few = list(ready.picture_blocks(lights, cameras, memory=1, layers=["color", "depth"]))
    assert [(block.view, list(block.lights)) for block in few] == [(v, [n]) for v in range(2) for n in range(3)]
    for block in few:
        close(block.pictures["color"][0], together[block.lights[0], block.view], tolerance=1e-6)
        assert block.pictures["depth"].shape == (1, CAMERA.height, CAMERA.width)


def test_lights_of_other_sizes_are_resampled_with_a_warning(close):
    ready, fine = relit(), light()
    twice = Environment(jnp.repeat(jnp.repeat(fine.radiance, 2, 1), 2, 2))
    with pytest.warns(UserWarning, match="1 of 2 lights have faces of 16 texels"):
        color = ready.pictures([fine, twice], [CAMERA], background=None)
    close(color[0], color[1], tolerance=1e-5)


DOORS = {
    "light": lambda ready, view, wrong: ready.light(wrong),
    "radiance": lambda ready, view, wrong: ready.radiance(wrong, eye=CAMERA.eye),
    "radiance of a system": lambda ready, view, wrong: prt.radiance(ready, wrong, eye=CAMERA.eye),
    "batch": lambda ready, view, wrong: ready.radiance(Environment(np.asarray(wrong.radiance)[None]), eye=CAMERA.eye),
    "picture": lambda ready, view, wrong: ready.picture(wrong, CAMERA),
    "layers": lambda ready, view, wrong: ready.picture(wrong, CAMERA, layers=["depth"]),
    "traced view": lambda ready, view, wrong: ready.picture_view(CAMERA, shadows=wrong),
    "kept view": lambda ready, view, wrong: view.picture(wrong),
    "mix": lambda ready, view, wrong: view.mix(wrong),
    "report": lambda ready, view, wrong: ready.report([wrong]),
    "probes": lambda ready, view, wrong: probes.sample(ready, wrong, np.zeros((1, 3))),
}


@pytest.mark.parametrize("door", DOORS)
def test_lights_of_another_size_are_refused_before_rays_and_programs(door, monkeypatch):
    ready = relit()
    view = ready.picture_view(CAMERA)

    def rays(*_, **__):
        pytest.fail("rays before the light was refused")

    for module in (shadows, tracing):
        monkeypatch.setattr(module, "trace", rays)
    wrong = Environment(np.ones((6, 16, 16, 3), np.float32))
    words = r"must be one environment \[6, 8, 8, c\], got .*16, 16, 3\]: load it with"
    with compiled() as events, pytest.raises(ValueError, match=words):
        DOORS[door](ready, view, wrong)
    assert not events


def shown(**options):
    """A picture with other options."""
    return relit().picture(light(), CAMERA, **options)


def point(triangle: int, weight: np.ndarray) -> Points:
    return on_triangles(np.array([[0, 1, 2]]), np.array([triangle]), weight)


INSIDE = np.full((1, 3), 1 / 3, np.float32)
WRONG = [
    (lambda: shown(layers="color"), TypeError, "layers must be a list"),
    (lambda: shown(layers=[]), ValueError, "layers must be different ones of color"),
    (lambda: shown(layers=["color", "color"]), ValueError, "layers must be different"),
    (lambda: shown(layers=["beauty"]), ValueError, "got 'beauty'"),
    (lambda: shown(background="sky"), ValueError, 'background must be "light"'),
    (lambda: relit().picture_view(CAMERA, samples=9), ValueError, "samples must be 1, 4 or 16, got 9"),
    (lambda: relit().pictures([], [CAMERA]), ValueError, "environments must be at least one"),
    (lambda: relit().pictures([light()], []), ValueError, "cameras must be at least one"),
    (
        lambda: relit().pictures([light()], [CAMERA, dataclasses.replace(CAMERA, width=9)]),
        ValueError,
        "one size for one array, got 9 x 16",
    ),
    (lambda: point(1, INSIDE), ValueError, "triangles must be from 0 to 0, got 1 to 1"),
    (
        lambda: point(0, np.array([[1.2, -0.2, 0]])),
        ValueError,
        "points must be at least 0 and sum to 1, got .* at point 0",
    ),
    (lambda: point(0, np.array([[np.nan, 0.5, 0.5]])), ValueError, "points must be at least 0 and sum to 1, got .*nan"),
    (lambda: point(0, np.ones(3)), ValueError, r"points must be triangles \[p\] and weights \[p, 3\]"),
    (
        lambda: prt.reference.radiance(
            relit().mesh, SHARP, light(), eye=CAMERA.eye, vertex=np.array([0]), points=point(0, INSIDE)
        ),
        ValueError,
        "either vertices or points",
    ),
    (
        lambda: visibility.point_starts(relit().mesh, Points(jnp.zeros((1, 1), int), jnp.ones((1, 1)))),
        ValueError,
        "three corners",
    ),
]


@pytest.mark.usefixtures("unchecked")
def test_layers_backgrounds_lights_cameras_and_points_that_are_none_are_refused():
    for call, error, words in WRONG:
        with pytest.raises(error, match=words):
            call()


def test_the_number_of_programs_does_not_depend_on_the_number_of_parts():
    counts = []
    for parts in (3, 30):
        scene = balls(parts)
        jax.clear_caches()
        with compiled() as events:
            made(scene).picture(light(), CAMERA)
        counts.append(len(events))
    assert counts[1] <= counts[0] + 2
    assert counts[1] <= 62  # with some small ones of the test's own cubemaps
