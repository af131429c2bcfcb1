import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt import image
from jaxprt.files import read_image
from jaxprt.scene import Camera, environment, panorama
from jaxprt.sphere import cubemap

RANDOM = np.random.default_rng(3)
HALF = 2.0**-11  # rounding of half precision
# The flux of a pixel that lies across an edge of texels, cut into eight pieces along its edge (measured: 0.03).
SUN_BOUND = 0.04
# Mip maps are a little softer than the mean over each pixel (measured: 0.063, at the nadir 0.02).
MIP_BOUND = 0.08
TURN = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0], [0.48, 0.64, 0.6]])


def smooth(direction):
    """A function that a mip map reproduces: low in frequency and positive."""
    x, y, z = np.moveaxis(direction / np.linalg.norm(direction, axis=-1, keepdims=True), -1, 0)
    return np.stack([2 + x + y * z, 2 + y - x * z, 3 + z + x * y], -1)


def latlong(height, *, width=None, of=smooth):
    width = 2 * height if width is None else width
    latitude = np.pi * (0.5 - (np.arange(height)[:, None] + 0.5) / height)
    longitude = 2 * np.pi * (0.5 - (np.arange(width) + 0.5) / width)
    ring = np.cos(latitude)
    axes = ring * np.sin(longitude), np.sin(latitude) + 0 * longitude, ring * np.cos(longitude)
    return of(np.stack(axes, -1)).astype(np.float32)


def faces(size):
    return smooth(np.asarray(cubemap.direction(size=size), np.float64)).astype(np.float32)


def directions(count):
    poles = np.concatenate([np.eye(3), -np.eye(3), [[1e-5, 1, 1e-5], [-1, 1, 1], [1, -1, 0], [0, 1e-8, -1]]])
    return np.concatenate([poles, RANDOM.normal(size=(count, 3))]).astype(np.float32)


SMOOTH = {
    "latlong": panorama.from_latlong(latlong(128), on_edge=False),
    "odd": panorama.from_latlong(latlong(101, width=203), on_edge=False),
    "cube": panorama.from_faces(faces(48), on_edge=False),
    "odd cube": panorama.from_faces(faces(37), on_edge=False),
}


@pytest.mark.parametrize("kind", SMOOTH)
@pytest.mark.parametrize("angle", [0.0, 0.15])
def test_a_smooth_sky_is_seen_without_seams_at_edges_and_poles(kind, angle):
    direction = directions(2000)
    found = SMOOTH[kind].sampled(direction, angle)
    # Means over a pixel differ from its center by its square; half a pixel at edges of a cube counts to first order.
    np.testing.assert_allclose(found, smooth(direction), atol=0.02 + 0.6 * angle)


@pytest.mark.parametrize("kind", SMOOTH)
def test_a_turned_panorama_is_seen_where_it_turned_to(kind):
    direction = directions(500)
    turned = SMOOTH[kind].rotated(TURN)
    found = turned.sampled((direction @ TURN.T).astype(np.float32), 0.0)
    # Edges of a cube may round to either face, which differ to first order; elsewhere single precision of positions.
    off = np.abs(found - SMOOTH[kind].sampled(direction, 0.0)).max(1)
    assert np.sort(off)[-10] < 1e-3
    assert off.max() < 0.03
    np.testing.assert_allclose(turned.cubemap(16), smooth(np.asarray(cubemap.direction(size=16)) @ TURN), atol=0.02)


def test_a_wide_pixel_sees_the_mean_of_a_noise_and_not_one_pixel_of_it():
    noise = np.exp(RANDOM.normal(size=(128, 256, 3))).astype(np.float32)
    sky = panorama.from_latlong(noise, on_edge=False)
    direction = directions(3000)
    step = np.pi / 128
    spread = [np.std(sky.sampled(direction, step * wide)) / np.std(noise) for wide in (1, 4, 16)]
    # The standard deviation of the mean of n^2 pixels falls like 1 / n; a trilinear look-up is not quite a mean.
    assert spread[0] > 0.5
    assert spread[1] < 0.3
    assert spread[2] < 0.09


def test_pixels_keep_eleven_bits_over_eight_orders_of_magnitude():
    values = np.geomspace(3e-4, 1e5, 6 * 64**2 * 3).reshape(6, 64, 64, 3).astype(np.float32)
    sky = panorama.from_faces(values, on_edge=False)
    stored = sky.radiance[sky.half[: 6 * 64**2].astype(int)].reshape(values.shape)
    np.testing.assert_allclose(stored, values, rtol=HALF)


@pytest.mark.parametrize("on_edge", [False, True])
@pytest.mark.parametrize("make", [panorama.from_latlong, panorama.from_faces])
def test_cubemaps_conserve_the_integral_and_constants_at_every_turn(make, on_edge):
    shape = (20, 40, 3) if make is panorama.from_latlong else (6, 12, 12, 3)
    area = np.asarray(cubemap.solid_angle(size=8), np.float64)[..., None]
    sky = make(np.exp(3 * RANDOM.normal(size=shape)).astype(np.float32), on_edge=on_edge).rotated(TURN)
    np.testing.assert_allclose((area * sky.cubemap(8)).sum((0, 1, 2)), sky.integral, rtol=1e-6)
    constant = make(np.full(shape, 0.375, np.float32), on_edge=on_edge).rotated(TURN)
    np.testing.assert_allclose(constant.cubemap(8), 0.375, rtol=1e-6)
    np.testing.assert_allclose(constant.sampled(directions(50), 0.1), 0.375, rtol=1e-6)


@pytest.mark.parametrize("shape", [(1, 1, 3), (3, 5, 3)])
@pytest.mark.parametrize("on_edge", [False, True])
def test_pictures_of_a_few_pixels_have_every_size(shape, on_edge):
    sky = panorama.from_latlong(np.full(shape, 2.0, np.float32), on_edge=on_edge)
    np.testing.assert_allclose(sky.sampled(directions(20), 0.5), 2.0, rtol=1e-6)
    np.testing.assert_allclose(sky.cubemap(3), 2.0, rtol=1e-6)
    black = panorama.from_latlong(np.zeros(shape, np.float32), on_edge=on_edge)
    assert not black.sampled(directions(20), 0.0).any()
    assert not black.cubemap(2).any()


def test_wide_pictures_are_halved_to_the_widest_that_is_kept(monkeypatch):
    monkeypatch.setattr(panorama, "WIDEST", 64)
    for sky in (panorama.from_latlong(latlong(128), on_edge=False), panorama.from_faces(faces(64), on_edge=False)):
        assert sky.width[0] == (16 if sky.cube else 64)
        direction = directions(200)
        np.testing.assert_allclose(sky.sampled(direction, 0.0), smooth(direction), atol=0.15)
        assert sky.half.nbytes < 8 * 64 * 32 * 1.01


def sunny(size=16):
    """Light of a file with a sun of a few pixels."""
    pixels = latlong(64)
    pixels[20:22, 30:32] = 5e4
    return environment.environment_from_image(pixels, size=size)


def test_turned_lights_are_made_of_the_pixels_of_the_file():
    light = sunny()
    turned = environment.rotate(light, jnp.asarray(TURN, jnp.float32))
    there = environment.rotate(turned, jnp.asarray(TURN.T, jnp.float32))
    # There and back the sun is as small as before; texels alone would spread it twice.
    np.testing.assert_allclose(there.radiance, light.radiance, atol=0.02 * float(light.radiance.max()))
    texels = environment.Environment(light.radiance)
    for step in (TURN, TURN.T):
        texels = environment.rotate(texels, jnp.asarray(step, jnp.float32))
    assert float(texels.radiance.max()) < 0.7 * float(light.radiance.max())
    assert turned.panorama is not None
    assert texels.panorama is None


def test_finer_texels_hold_the_same_light():
    light = environment.rotate(sunny(), jnp.asarray(TURN, jnp.float32))
    fine = environment.finer(light, size=64)
    assert fine.radiance.shape == (6, 64, 64, 3)
    area = np.asarray(cubemap.solid_angle(size=64), np.float64)[..., None]
    block = (6, 16, 4, 16, 4, 3)
    mean = (area * np.asarray(fine.radiance)).reshape(block).sum((2, 4))
    mean /= np.broadcast_to(area, (6, 64, 64, 3)).reshape(block).sum((2, 4))
    np.testing.assert_allclose(mean, light.radiance, atol=SUN_BOUND * float(light.radiance.max()))
    sun = int(np.argmax(fine.radiance[..., 0]))
    latitude, longitude = np.pi * (0.5 - 21 / 64), 2 * np.pi * (0.5 - 31 / 128)
    expected = TURN @ [np.cos(latitude) * np.sin(longitude), np.sin(latitude), np.cos(latitude) * np.cos(longitude)]
    assert np.asarray(cubemap.direction(size=64)).reshape(-1, 3)[sun] @ expected > np.cos(0.05)  # within the sun
    assert environment.finer(light, size=16) is light


def test_a_disk_adds_its_flux_and_is_seen_where_it_turned_to():
    light, direction, angle = sunny(), np.array([0.6, 0.64, -0.48]), 0.2
    with_disk = environment.add_disk(light, 3 * direction, angle=angle, radiance=[1.0, 2.0, 3.0])
    area = np.asarray(cubemap.solid_angle(size=16), np.float64)[..., None]
    flux = (area * (np.asarray(with_disk.radiance, np.float64) - light.radiance)).sum((0, 1, 2))
    np.testing.assert_allclose(flux, 2 * np.pi * (1 - np.cos(angle)) * np.array([1, 2, 3]), rtol=1e-3)
    turned = environment.rotate(with_disk, jnp.asarray(TURN, jnp.float32))
    place = jnp.asarray(np.stack([TURN @ direction, -TURN @ direction]), jnp.float32)
    without = environment.sky(environment.rotate(light, jnp.asarray(TURN, jnp.float32)), place)
    difference = environment.sky(turned, place, angle=0.01) - without
    np.testing.assert_allclose(difference, [[1, 2, 3], [0, 0, 0]], atol=1e-2)
    fine = (
        environment.finer(turned, size=32).radiance
        - environment.finer(environment.rotate(light, jnp.asarray(TURN, jnp.float32)), size=32).radiance
    )
    area = np.asarray(cubemap.solid_angle(size=32), np.float64)[..., None]
    np.testing.assert_allclose((area * np.asarray(fine)).sum((0, 1, 2)), flux, rtol=2e-3)


def test_the_pixels_of_a_file_are_no_part_of_the_pytree():
    light, made = sunny(), environment.Environment(jnp.ones((6, 16, 16, 3)))
    assert jax.tree.structure(light) == jax.tree.structure(made)
    assert len(jax.tree.leaves(light)) == 1
    brighter = jax.tree.map(lambda each: 2 * each, light)
    assert brighter.panorama is None
    assert jax.jit(lambda each: each)(light).panorama is None

    def seen(light):
        return jnp.sum(environment.sky(light, jnp.ones((1, 3)), angle=0.1))

    # Inside of a derivative the texels are seen.
    assert float(jnp.sum(jax.grad(seen)(light).radiance)) == pytest.approx(3, rel=1e-5)


def test_the_sky_of_a_camera_is_mitsubas(data):
    """Mitsuba 3 looks the original file up bilinearly, at 64 places in each pixel."""
    mitsuba = pytest.importorskip("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    size, field, pixels = 96, 1.2, np.maximum(read_image(data / "env" / "polyhaven_courtyard_1k.exr")[0], 0)
    light, bitmap = environment.environment_from_image(pixels, size=2), mitsuba.Bitmap(np.ascontiguousarray(pixels))
    for target, up in (((0.9, 0.1, 1.0), (0, 1, 0)), ((0.05, -1.0, 0.02), (0, 0, 1))):
        camera = Camera([0.0, 0, 0], target, up, field, size, size)
        ours = np.asarray(image.sky(light, camera))
        look = mitsuba.ScalarTransform4f().look_at([0, 0, 0], list(target), list(up))
        film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
        scene = {
            "type": "scene",
            "integrator": {"type": "path"},
            "light": {"type": "envmap", "bitmap": bitmap},
            "sensor": {
                "type": "perspective",
                "fov": float(np.degrees(field)),
                "fov_axis": "y",
                "to_world": look,
                "film": film,
                "sampler": {"type": "stratified", "sample_count": 64},
            },
        }
        theirs = np.array(mitsuba.render(mitsuba.load_dict(scene)))[..., :3]
        assert np.linalg.norm(ours - theirs) < MIP_BOUND * np.linalg.norm(theirs)
