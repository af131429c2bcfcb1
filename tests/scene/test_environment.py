"""Environments.

Suns in environments: flux, place, and what is refused.
"""

import tracemalloc

import jax
import jax.numpy as jnp
import numpy as np
import OpenEXR
import pytest

from jaxprt import require
from jaxprt.files import write_exr, write_png
from jaxprt.scene import environment
from jaxprt.scene.environment import Environment, Sun, with_suns
from jaxprt.sphere import cubemap

AXIS = np.concatenate([np.eye(3), -np.eye(3)])
COLOR = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 1, 1], [1, 0, 1], [1, 1, 0]], np.float32)
# A corner of the cube where x, y and z differ, with its mirror images: only the first is gray.
OCTANT = np.array([0.5, 0.75, 0.45])
# Share of the integral that the parts' areas may be off by before the global scale puts it right (measured: 0.0023).
SCALE_BOUND = 0.005
# Two pictures of one light on different grids, each resampled (measured: 0.008).
GRACE_BOUND = 0.02
SUNS = [Sun("low", [0.9, 0.2, -0.3], [1.0, 0.5, 0.25]), Sun("high", [0, 3, 0], 2.0)]


def labeled(direction):
    """Six colors around the world's axes, and a gray spot that no mirror image of the scene has at its place."""
    direction = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    color = COLOR[(direction @ AXIS.T).argmax(-1)]
    spot = direction @ (OCTANT / np.linalg.norm(OCTANT)) > np.cos(0.15)
    return np.where(spot[..., None], np.float32(0.5), color)


def latlong_direction(height, width, *, on_edge=False):
    """OpenEXR's formula, written out for pixel centers and for samples on the edges."""
    row, column = np.arange(height)[:, None], np.arange(width)[None]
    v = row / (height - 1) if on_edge else (row + 0.5) / height
    u = column / (width - 1) if on_edge else (column + 0.5) / width
    latitude, longitude = np.pi * (0.5 - v), 2 * np.pi * (0.5 - u)
    return np.stack(
        [np.sin(longitude) * np.cos(latitude), np.sin(latitude) + 0 * longitude, np.cos(longitude) * np.cos(latitude)],
        -1,
    )


def openexr_cube_direction(n):
    """The functions pixelPosition and direction of OpenEXR's ImfEnvmap.cpp, inverted by hand."""
    top, left = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    right, bottom = n - 1 - left, n - 1 - top
    unit = lambda position: position / (n - 1) * 2 - 1  # noqa: E731
    one = np.ones((n, n))
    face = [
        (one, unit(bottom), unit(left)),
        (-one, unit(bottom), unit(right)),
        (unit(left), one, unit(bottom)),
        (unit(left), -one, unit(top)),
        (unit(right), unit(bottom), one),
        (unit(left), unit(bottom), -one),
    ]
    return np.concatenate([np.stack(f, -1) for f in face])


def vertical_cross_direction(n):
    """A camera in the middle that looks at -z with +y up, turned to each face; the back hangs below the bottom."""
    v, u = np.meshgrid(*[(2 * np.arange(n) + 1) / n - 1] * 2, indexing="ij")
    one = np.ones((n, n))
    blank = np.full((n, n, 3), np.nan)
    top = np.stack([u, one, -v], -1)
    left, front, right = np.stack([-one, -v, -u], -1), np.stack([u, -v, -one], -1), np.stack([one, -v, u], -1)
    bottom, back = np.stack([u, -one, v], -1), np.stack([u, v, one], -1)
    rows = [[blank, top, blank], [left, front, right], [blank, bottom, blank], [blank, back, blank]]
    return np.concatenate([np.concatenate(row, 1) for row in rows])


def picture(layout, n):
    direction = {
        "latlong": lambda: latlong_direction(2 * n, 4 * n),
        "openexr-latlong": lambda: latlong_direction(2 * n, 4 * n, on_edge=True),
        "openexr-cube": lambda: openexr_cube_direction(n),
        "vertical-cross": lambda: vertical_cross_direction(n),
        "vertical-strip": lambda: np.concatenate(np.asarray(cubemap.direction(size=n))),
        "horizontal-strip": lambda: np.concatenate(np.asarray(cubemap.direction(size=n)), 1),
    }[layout]()
    return np.where(np.isnan(direction).any(-1, keepdims=True), 0, labeled(np.nan_to_num(direction, nan=1.0)))


def integral(radiance):
    size = radiance.shape[-2]
    area = np.asarray(cubemap.solid_angle(size=size), np.float64)
    return (area[..., None] * np.asarray(radiance, np.float64)).sum((-4, -3, -2))


def latlong_integral(image):
    edge = np.cos(np.linspace(0, np.pi, image.shape[0] + 1))
    area = (edge[:-1] - edge[1:]) * 2 * np.pi / image.shape[1]
    return (area[:, None, None] * image.astype(np.float64)).sum((0, 1))


def random_light(size, *, seed=0, channels=3):
    radiance = np.exp(2 * np.random.default_rng(seed).normal(size=(6, size, size, channels)))
    return Environment(jnp.asarray(radiance, jnp.float32))


def turn(vector):
    """Rodrigues' formula, in float64 NumPy."""
    angle = np.linalg.norm(vector)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


@pytest.fixture
def few_parts(monkeypatch):
    """Pictures are dealt out in as many parts as their texels need, where users get at least 4096 around."""
    monkeypatch.setattr(environment, "_AROUND", 512)


@pytest.mark.usefixtures("few_parts")
@pytest.mark.parametrize("layout", environment.LAYOUTS)
def test_every_layout_puts_each_color_on_its_axis_and_mirrors_nothing(layout):
    light = environment.environment_from_image(picture(layout, 128), layout=layout, size=32)
    direction = np.concatenate([AXIS, OCTANT[None], OCTANT * [[-1, 1, 1], [1, -1, 1], [1, 1, -1], [-1, -1, -1]]])
    seen = environment.background(light, jnp.asarray(direction, jnp.float32))
    np.testing.assert_allclose(seen, labeled(direction), atol=1e-4)  # The global scale of latlong pictures.
    # Not only there: everywhere but on the lines where colors meet.
    everywhere = np.asarray(cubemap.direction(size=32), np.float64)
    wrong = np.abs(np.asarray(light.radiance) - labeled(everywhere)).max(-1) > 0.5
    assert wrong.mean() < 0.03


@pytest.mark.usefixtures("few_parts")
def test_layouts_are_told_from_the_shape_and_the_envmap_attribute(tmp_path):
    expected = np.asarray(environment.environment_from_image(picture("vertical-cross", 64), size=16).radiance)
    for layout in environment.LAYOUTS:
        path = tmp_path / f"{layout}.exr"
        image = picture(layout, 64)
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        if layout.startswith("openexr"):
            header["envmap"] = OpenEXR.ENVMAP_CUBE if layout.endswith("cube") else OpenEXR.ENVMAP_LATLONG
        channels = {name: np.ascontiguousarray(image[..., i]) for i, name in enumerate("RGB")}
        with OpenEXR.File(header, channels) as file:
            file.write(str(path))
        found = np.asarray(environment.load_environment(path, size=16).radiance)
        np.testing.assert_array_equal(found, environment.load_environment(path, size=16, layout=layout).radiance)
        assert (np.abs(found - expected).max(-1) > 0.3).mean() < 0.08


@pytest.mark.usefixtures("few_parts")
@pytest.mark.parametrize(
    ("layout", "height", "width", "size"),
    [
        ("latlong", 1, 1, 3),
        ("openexr-latlong", 3, 5, 1),
        ("vertical-cross", 400, 300, 64),
        ("openexr-cube", 6, 1, 64),
        ("horizontal-strip", 2, 12, 3),
    ],
)
def test_constants_are_reproduced_exactly(layout, height, width, size):
    color = np.array([0.1, 7.7, 3e4], np.float32)
    light = environment.environment_from_image(np.broadcast_to(color, (height, width, 3)), layout=layout, size=size)
    np.testing.assert_array_equal(light.radiance, np.broadcast_to(color, (6, size, size, 3)))


@pytest.mark.parametrize("size", [8, 64])
def test_the_integral_of_a_latlong_picture_is_conserved_and_nearly_so_before_the_scale(size):
    image = np.exp(np.random.default_rng(0).normal(size=(128, 256, 2)))
    image[50, 70, 1] += 3e5  # A sun that holds nearly all the light.
    result = environment.resample(image, layout="latlong", size=size)
    np.testing.assert_allclose(
        integral(result) / integral(np.ones((6, size, size, 1))), latlong_integral(image) / (4 * np.pi), rtol=1e-6
    )
    # Sky texels far from the sun tell the scale: the first channel has the same noise but no sun.
    quiet = environment.resample(image - [0, 3e5] * (image > 1e5), layout="latlong", size=size)
    assert np.abs(np.median(result[..., 1] / quiet[..., 1]) - 1) < 2 * SCALE_BOUND


def test_the_integral_of_a_cube_is_conserved():
    face = random_light(10).radiance
    for size in (1, 7, 64):
        result = environment.resample(np.concatenate(np.asarray(face)), layout="vertical-strip", size=size)
        np.testing.assert_allclose(integral(result), integral(face), rtol=1e-6)


def test_cubes_of_a_multiple_of_the_size_are_box_filtered_exactly():
    face = np.asarray(random_light(32).radiance, np.float64)
    result = environment.resample(np.concatenate(face), layout="vertical-strip", size=8)
    area = np.asarray(cubemap.solid_angle(size=32), np.float64)[..., None]
    block = (6, 8, 4, 8, 4, -1)
    expected = (face * area).reshape(block).sum((2, 4)) / area.reshape(block).sum((2, 4))
    np.testing.assert_allclose(result, expected, rtol=1e-6)
    same = environment.resample(np.concatenate(face), layout="vertical-strip", size=32)
    np.testing.assert_allclose(same, face, rtol=1e-14)


@pytest.mark.usefixtures("few_parts")
def test_gray_and_alpha_become_three_colors():
    gray = np.random.default_rng(0).random((8, 16, 1)).astype(np.float32)
    alpha = np.full_like(gray, 0.25)
    expected = environment.environment_from_image(gray.repeat(3, -1), size=4).radiance
    for image in (gray, np.concatenate([gray, alpha], -1), np.concatenate([gray, gray, gray, alpha], -1)):
        np.testing.assert_array_equal(environment.environment_from_image(image, size=4).radiance, expected)


def test_values_that_are_not_finite_are_refused_with_the_first_place(tmp_path):
    image = np.ones((8, 16, 3), np.float32)
    image[3, 5, 1], image[6, 0, 2] = np.inf, np.nan
    write_exr(tmp_path / "sky.exr", image)
    with pytest.raises(ValueError, match=r"sky\.exr .* in 2 pixels, the first at row 3, column 5"):
        environment.load_environment(tmp_path / "sky.exr")


@pytest.mark.usefixtures("few_parts")
def test_negative_values_are_set_to_zero_with_one_warning():
    image = np.ones((8, 16, 3), np.float32)
    image[3, 5] = [-0.25, -0.1, 1]
    with pytest.warns(UserWarning, match=r"image: 1 of 128 pixels are negative, the lowest -0\.25") as record:
        light = environment.environment_from_image(image, size=4)
    assert len(record) == 1
    assert np.asarray(light.radiance).min() >= 0
    clamped = environment.environment_from_image(np.maximum(image, 0), size=4)
    np.testing.assert_array_equal(light.radiance, clamped.radiance)


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_lights_made_by_hand_are_refused_where_they_are_not_finite_and_known(wrong):
    radiance = jnp.ones((6, 2, 2, 3)).at[3, 1, 0, 2].set(wrong)
    message = (
        r"the light's radiance must be finite, got 1 of 72 values that are not, first at \(3, 1, 0, 2\): (nan|inf)"
    )
    with pytest.raises(ValueError, match=message):
        Environment(radiance)
    assert jax.eval_shape(Environment, radiance).radiance.shape == (6, 2, 2, 3)
    assert jax.jit(Environment)(radiance).radiance[3, 1, 0, 2] != 1


def test_unknown_layouts_and_impossible_shapes_are_refused_with_what_is_possible(tmp_path):
    image = np.ones((10, 17, 3), np.float32)
    with pytest.raises(ValueError, match=r"one of latlong, openexr-latlong, .* got 'angular'"):
        environment.environment_from_image(image, layout="angular")
    with pytest.raises(ValueError, match=r"3 n x 4 n pixels .* layout vertical-cross, got 17 x 10"):
        environment.environment_from_image(image, layout="vertical-cross")
    write_png(tmp_path / "photo.png", image)
    with pytest.raises(ValueError, match=r"photo\.png must be 2 : 1 .* got 17 x 10 .* latlong, openexr-latlong"):
        environment.load_environment(tmp_path / "photo.png")
    with pytest.raises(ValueError, match="1 to 4 channels, got 5"):
        environment.environment_from_image(np.ones((2, 4, 5), np.float32))
    with pytest.raises(ValueError, match=r"must have pixels, got the shape \(0, 0, 3\)"):
        environment.environment_from_image(np.ones((0, 0, 3), np.float32), layout="latlong")
    with pytest.raises(ValueError, match="size must be at least 1, got 0"):
        environment.environment_from_image(np.ones((2, 4, 3), np.float32), size=0)
    with pytest.raises(ValueError, match="size must be at least 1, got -3"):
        environment.load_environment(tmp_path / "photo.png", size=-3)
    with pytest.raises(FileNotFoundError, match="missing"):
        environment.load_environment(tmp_path / "missing.exr")


@pytest.mark.parametrize("size", [100_000, 2**30])
def test_cubemaps_that_do_not_fit_into_memory_are_refused_before_anything_is_made(tmp_path, size):
    image = np.ones((2, 4, 3), np.float32)
    write_exr(tmp_path / "sky.exr", image)
    message = rf"a cubemap of 6 x {size} x {size} texels take \d+\.\d GB, and .* are free; choose a smaller size"
    with pytest.raises(MemoryError, match=message):
        environment.load_environment(tmp_path / "sky.exr", size=size)
    for layout, shape in (("latlong", (2, 4, 3)), ("openexr-latlong", (3, 5, 3)), ("vertical-cross", (4, 3, 3))):
        with pytest.raises(MemoryError, match=message):
            environment.environment_from_image(np.ones(shape, np.float32), layout=layout, size=size)
        with pytest.raises(MemoryError, match=message):
            environment.resample(np.ones(shape, np.float32), layout=layout, size=size)


@pytest.mark.usefixtures("few_parts")
@pytest.mark.parametrize(("layout", "shape"), [("latlong", (300, 600)), ("vertical-strip", (1800, 300))])
def test_resampling_takes_no_more_memory_than_is_asked_for(monkeypatch, layout, shape):
    """NumPy reports its arrays to tracemalloc."""
    asked = []
    monkeypatch.setattr(require, "memory", lambda what, needed, *_, **__: asked.append(needed))
    image = np.random.default_rng(0).random((*shape, 3)).astype(np.float32)
    tracemalloc.start()
    try:
        environment.resample(image, layout=layout, size=64)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert 0.1 * asked[0] < peak < asked[0]


@pytest.mark.usefixtures("few_parts")
def test_light_from_files_is_radiance_in_rec709_whatever_the_file_states(tmp_path):
    """White of 1/4 at an exposure of 1/2 is radiance of 1/2; red of ACES is more than red."""
    pixel = bytes([64, 64, 64, 129, 1, 1, 1, 127])
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=2\nEXPOSURE=0.5\nCOLORCORR=1 .5 1\n\n-Y 64 +X 128\n"
    (tmp_path / "sky.hdr").write_bytes(head + 64 * pixel)
    light = environment.load_environment(tmp_path / "sky.hdr", size=2)
    np.testing.assert_allclose(light.radiance, np.broadcast_to([0.5, 1.0, 0.5], (6, 2, 2, 3)), rtol=1e-6)

    chromaticities = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.0770, 0.32168, 0.33767)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "chromaticities": chromaticities}
    part = OpenEXR.Part(
        dict(header),
        {name: np.full((4, 8), value, np.float32) for name, value in zip("RGB", (1.0, 0.5, 0.5), strict=True)},
        "beauty",
    )
    depth = OpenEXR.Part(dict(header), {"Y": np.full((4, 8), 9.0, np.float32)}, "depth")
    with OpenEXR.File([depth, part]) as file:
        file.write(str(tmp_path / "aces.exr"))
    light = environment.load_environment(tmp_path / "aces.exr", size=2)
    # ACES2065-1 to linear sRGB, from the OpenColorIO configuration of ACES.
    expected = [2.52168619 - 0.5 * (1.13413099 + 0.38755520), -0.27647991 + 0.5 * (1.37271909 - 0.09623917)]
    expected.append(-0.01537807 + 0.5 * (1.16835340 - 0.15297534))
    np.testing.assert_allclose(light.radiance, np.broadcast_to(expected, (6, 2, 2, 3)), rtol=1e-4)


@pytest.mark.parametrize("axis", range(3))
def test_quarter_turns_permute_the_texels(axis):
    size = 16
    light = random_light(size)
    vector = np.zeros(3)
    vector[axis] = np.pi / 2
    turned = environment.rotate(light, jnp.asarray(turn(vector), jnp.float32))
    # The texel seen at R s is the one that was at s.
    destination = np.asarray(cubemap.point(size=size)) @ np.round(turn(vector)).astype(np.float32).T
    found = cubemap.lookup(turned.radiance, destination, sharpness=100)
    # Relative to the brightest texel: rounding lets a trace of the neighbors in.
    np.testing.assert_allclose(found, light.radiance, atol=1e-5 * float(light.radiance.max()))


def test_rotation_moves_light_from_s_to_r_s():
    direction = np.array([0.3, 0.8, -0.5]) / np.linalg.norm([0.3, 0.8, -0.5])
    center = np.asarray(cubemap.direction(size=32), np.float64)
    light = Environment(jnp.asarray(np.exp(20 * (center @ direction - 1))[..., None], jnp.float32))
    rotation = turn(np.array([0.5, -1.2, 2.0]))
    expected = np.exp(20 * (center @ (rotation @ direction) - 1))[..., None]
    turned = environment.rotate(light, jnp.asarray(rotation, jnp.float32))
    # The box filter's blur of a lobe some ten texels wide.
    assert np.linalg.norm(turned.radiance - expected) < 0.02 * np.linalg.norm(expected)


def test_rotation_conserves_the_integral_of_each_color_and_constant_light():
    light, even = random_light(16), Environment(np.full((6, 16, 16, 3), 0.7, np.float32))
    for seed in range(3):
        rotation = turn(np.random.default_rng(seed).normal(size=3)).astype(np.float32)
        np.testing.assert_allclose(
            integral(environment.rotate(light, rotation).radiance), integral(light.radiance), rtol=2e-6
        )
        np.testing.assert_allclose(environment.rotate(even, rotation).radiance, 0.7, rtol=1e-6)


@pytest.mark.parametrize("place", [(4, 0, 0), (2, 5, 30)])
def test_a_turning_sun_of_one_texel_neither_vanishes_nor_flickers_nor_lags(place):
    size = 32
    radiance = np.full((6, size, size, 1), 1e-3, np.float32)
    area = np.asarray(cubemap.solid_angle(size=size), np.float64)[..., None]
    radiance[place] = 1 / area[place[0], place[1], place[2]]  # About 80 times the light of the sky.
    center = np.asarray(cubemap.direction(size=size), np.float64)
    sky = []
    for step in range(12):
        rotation = turn(np.array([0.02, 0.05, 0.11]) * (step + 1))
        turned = np.asarray(
            environment.rotate(Environment(jnp.asarray(radiance)), jnp.asarray(rotation, jnp.float32)).radiance
        )
        sky.append(np.median(turned))
        sun = (area * (turned - sky[-1]))[..., 0]
        centroid = (sun[..., None] * center).sum((0, 1, 2))
        angle = np.arccos(centroid @ (rotation @ center[place]) / np.linalg.norm(centroid))
        assert angle < 0.6 * 2 / size  # Well below a texel's width.
        assert (sun > 0.02).sum() <= 16
    # What the sky takes over when the sun's parts are counted a few too many or too few.
    assert np.std(sky) / np.mean(sky) < 0.15


def test_batches_of_lights_turn_like_each_light():
    lights = [random_light(16, seed=seed) for seed in range(3)]
    rotation = jnp.asarray(turn(np.array([1.0, 0.2, -0.4])), jnp.float32)
    batch = environment.rotate(Environment(jnp.stack([light.radiance for light in lights])), rotation)
    for i, light in enumerate(lights):
        np.testing.assert_allclose(batch.radiance[i], environment.rotate(light, rotation).radiance, rtol=1e-5)


@pytest.mark.usefixtures("x64")
def test_the_gradient_of_a_rotation_by_nothing_equals_the_central_difference():
    light = Environment(jnp.asarray(np.exp(np.random.default_rng(0).normal(size=(6, 8, 8, 1)))))
    probe = np.random.default_rng(1).normal(size=(6, 8, 8, 1))
    generator = np.array([[0, -0.3, 0.5], [0.3, 0, -0.9], [-0.5, 0.9, 0]])

    @jax.jit
    def measured(matrix):
        return (probe * environment.rotate(light, matrix).radiance).sum()

    start = turn(np.array([1e-30, 0, 0]))
    slope = (np.asarray(jax.grad(measured)(start)) * (generator @ start)).sum()
    step = 1e-6
    forward, backward = (measured(start + sign * step * generator @ start) for sign in (1, -1))
    assert float(slope) == pytest.approx(float((forward - backward) / (2 * step)), rel=1e-4)


def test_the_two_kerner_files_hold_the_same_light(data):
    cube, latlong = (
        np.asarray(environment.load_environment(data / "env" / f"KernerEnv{name}.exr", size=32).radiance)
        for name in ("Cube", "LatLong")
    )
    np.testing.assert_allclose(integral(cube), integral(latlong), rtol=2e-4)
    # Measured 0.0013, most of it around the sun; one wrong sample at the edge would give a hundred times that.
    assert np.linalg.norm(cube - latlong) < 0.004 * np.linalg.norm(latlong)


def test_the_cross_and_the_latlong_copy_of_grace_are_inversions_of_each_other(data):
    # pbrt's copy is the cross with its rows upside down, half a turn further and scaled: copy(-s) = cross(s) / 127.3.
    cross, copy = (
        environment.load_environment(data / "env" / name, size=32)
        for name in ("grace_cross.hdr", "grace_latlong_pbrt.exr")
    )
    factor = integral(cross.radiance) / integral(copy.radiance)
    np.testing.assert_allclose(factor, 127.3, rtol=0.003)
    inverted = 127.3 * environment.background(copy, -cubemap.direction(size=32))
    assert np.linalg.norm(inverted - cross.radiance) < GRACE_BOUND * np.linalg.norm(cross.radiance)


def test_a_sunrise_keeps_its_sun(data):
    with pytest.warns(UserWarning, match=r"polyhaven_sunrise_1k\.exr: .* pixels are negative"):
        light = environment.load_environment(data / "env" / "polyhaven_sunrise_1k.exr")
    radiance = np.asarray(light.radiance, np.float64)
    assert radiance.max() > 5000
    area = np.asarray(cubemap.solid_angle(size=64))[..., None]
    brightest = np.sort((area * radiance).sum(-1).ravel())[::-1]
    assert 0.4 < brightest[:10].sum() / brightest.sum() < 0.7


def test_light_of_lists_and_whole_numbers_is_floating_point():
    """Whole numbers gave wrong radiance in every system."""
    for radiance in (np.full((6, 2, 2, 3), 200, np.uint8), np.full((6, 2, 2, 3), 200).tolist()):
        light = Environment(radiance)
        assert jnp.issubdtype(light.radiance.dtype, jnp.floating)
        np.testing.assert_array_equal(light.radiance, 200)


def test_a_header_line_that_names_no_layout_leaves_the_shape_to_decide(tmp_path):
    pixels = np.full((4, 8, 4), [128, 128, 128, 129], np.uint8)
    path = tmp_path / "sky.hdr"
    path.write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\nenvmap=dome\n\n-Y 4 +X 8\n" + pixels.tobytes())
    light = environment.load_environment(path, size=2)
    np.testing.assert_allclose(light.radiance, 1.0, rtol=0.01)


def test_a_sun_is_a_texel_with_its_irradiance():
    light = Environment(jnp.full((6, 64, 64, 1), 0.1))
    lit = with_suns(light, SUNS)
    more = np.asarray(lit.radiance, np.float64) - 0.1
    area, way = (np.asarray(each, np.float64) for each in (cubemap.solid_angle(size=64), cubemap.direction(size=64)))
    np.testing.assert_allclose((more * area[..., None]).sum((0, 1, 2)), [3, 2.5, 2.25], rtol=1e-4)
    normal = np.array([0.6, 0.8, 0])
    facing = [max(normal @ np.asarray(sun.direction) / np.linalg.norm(sun.direction), 0) for sun in SUNS]
    expected = sum(cosine * np.asarray(sun.irradiance) for cosine, sun in zip(facing, SUNS, strict=True))
    irradiance = (more * (area * np.maximum(way @ normal, 0))[..., None]).sum((0, 1, 2))
    np.testing.assert_allclose(irradiance, expected, rtol=0.02)  # half a texel is 0.7 degrees
    assert np.count_nonzero(more.max(-1) > 1e-3) == 2
    np.testing.assert_allclose(with_suns(light, []).radiance, np.full((6, 64, 64, 3), 0.1, np.float32))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Sun("a", [0, 0, 0]), "the direction of sun 'a' must not be zero"),
        (lambda: Sun("a", [0, 1]), r"the direction of sun 'a' must be three numbers, got an array \[2\]"),
        (lambda: Sun("a", [0, np.nan, 0]), "the direction of sun 'a' must be finite"),
        (lambda: Sun("a", [0, 1, 0], -1), "the irradiance of sun 'a' must be"),
        (lambda: with_suns(Environment(np.ones((6, 2, 2, 2))), SUNS), "one color or three for suns, got 2"),
    ],
)
def test_wrong_suns_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("angle", [0.05, 0.6])
def test_the_share_of_a_disk_has_its_solid_angle_around_its_direction(angle):
    share = environment.disk_share([2.0, 1.0, -0.5], angle=angle, size=16)
    area = share * np.asarray(cubemap.solid_angle(size=16))
    np.testing.assert_allclose(area.sum(), 2 * np.pi * (1 - np.cos(angle)), rtol=0.02)
    center = np.einsum("fij,fijc->c", area, np.asarray(cubemap.direction(size=16)))
    toward = np.array([2.0, 1.0, -0.5]) / np.linalg.norm([2.0, 1.0, -0.5])
    assert center @ toward / np.linalg.norm(center) > 0.998
    assert share.max() <= 1


def test_lights_of_another_size_have_the_same_flux():
    light = Environment(np.random.default_rng(0).uniform(size=(6, 8, 8, 3)).astype(np.float32))
    for size in (2, 8, 32):
        flux = integral(environment.resized(light, size=size).radiance).sum()
        np.testing.assert_allclose(flux, integral(light.radiance).sum(), rtol=0.03)
    with pytest.raises(ValueError, match="must divide 12 or be a multiple"):
        environment.resized(light, size=12)
