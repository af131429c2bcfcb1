"""Hidden backs, holes and translucent surfaces in pictures."""

import jax
import numpy as np
import pytest

from jaxprt.image import interpolate, pixels, resolve
from jaxprt.image.pixels import visible_points
from jaxprt.scene import Camera, Part, Scene, Texture, TexturedMaterial
from jaxprt.scene.mesh import grid_face, make_mesh
from jaxprt.visibility import Occluder

RAMP = Texture(np.array([[[0.0], [1.0]]], np.float32), np.eye(2, 3, dtype=np.float32), 0, ("clamp", "clamp"))
CAMERA = Camera((0.1, 0.05, 3.0), (0.0, 0, 0), (0.0, 1, 0), 0.9, 33, 32)


def sheet(depth, across=(-1.0, 1.0), turn=1):
    """A square that looks to +z, or to -z; u runs along x."""
    x, y = np.meshgrid(across, (-1.0, 1.0))
    position = np.stack([x, y, np.full_like(x, depth)], -1).reshape(-1, 3)
    place = np.stack([(x + 1) / 2, (y + 1) / 2], -1).reshape(-1, 2)
    return make_mesh(position, grid_face(rows=2, columns=2)[:, ::-turn], texture=place)


def drawn(*pairs, samples=4, hidden=()):
    """A picture in which each sheet, given with its material, has a color of its own and the background has another."""
    scene = Scene([Part(str(number), *pair) for number, pair in enumerate(pairs)])
    mesh = scene.mesh
    region = np.asarray(mesh.region)
    options = {"hidden": np.isin(region[np.asarray(mesh.face)[:, 0]], hidden), "occluder": Occluder(mesh)}
    pixels = visible_points(mesh, CAMERA, samples=samples, **options)
    color = np.eye(len(pairs) + 1, dtype=np.float32)
    background = np.broadcast_to(color[-1], (CAMERA.height, CAMERA.width, len(pairs) + 1))
    return np.asarray(resolve(pixels, interpolate(pixels, mesh.face, color[region]), background=background))


PLAIN = TexturedMaterial()


@pytest.mark.parametrize("samples", [1, 4])
def test_a_hole_by_alpha_shows_what_a_hole_in_the_mesh_shows(samples):
    mask = TexturedMaterial(alpha_texture=RAMP, alpha_mode="mask")
    by_alpha = drawn((sheet(0.5), mask), (sheet(0.0), PLAIN), samples=samples)
    cut = drawn((sheet(0.5, (0.0, 1.0)), PLAIN), (sheet(0.0), PLAIN), samples=samples)
    np.testing.assert_allclose(by_alpha, cut, atol=1e-6)
    assert cut[..., 0].max() > 0.99


def test_translucent_surfaces_are_composited_from_front_to_back():
    third, half = (TexturedMaterial(alpha=alpha, alpha_mode="blend") for alpha in (0.3, 0.5))
    picture = drawn((sheet(0.0), half), (sheet(-0.5), PLAIN), (sheet(0.5), third))
    np.testing.assert_allclose(picture.sum(-1), 1, atol=1e-6)
    np.testing.assert_allclose(picture[16, 16], [0.7 * 0.5, 0.7 * 0.5, 0.3, 0], atol=1e-6)
    opaque = drawn((sheet(0.5), PLAIN))
    np.testing.assert_allclose(picture[..., 2], 0.3 * opaque[..., 0], atol=1e-6)


def test_eight_surfaces_are_composited_and_those_between_them_and_the_opaque_one_are_left_out():
    glass = TexturedMaterial(alpha=0.5, alpha_mode="blend")
    pairs = [(sheet(-0.1 * number), glass) for number in range(10)]
    expected = [*0.5 ** np.arange(1, 9), 0, 0, 0.5**8, 0]
    np.testing.assert_allclose(drawn(*pairs, (sheet(-2.0), PLAIN))[16, 16], expected, atol=1e-6)


def test_backs_are_black_or_hidden():
    back, front = (sheet(0.5, turn=-1), PLAIN), (sheet(0.0), PLAIN)
    middle = [drawn(back, front, hidden=hidden)[16, 16] for hidden in ((), (0,))]
    np.testing.assert_array_equal(middle, [[0, 0, 0], [0, 1, 0]])
    glass = sheet(0.5, turn=-1), TexturedMaterial(alpha=0.5, alpha_mode="blend")
    middle = [drawn(glass, front, hidden=hidden)[16, 16] for hidden in ((), (0,))]
    np.testing.assert_allclose(middle, [[0, 0.5, 0], [0, 1, 0]], atol=1e-6)


def test_a_part_that_is_not_there_is_not_drawn():
    nothing = TexturedMaterial(alpha=0.0, alpha_mode="blend")
    np.testing.assert_array_equal(drawn((sheet(0.5), nothing))[..., 1], 1)


def test_single_samples_choose_translucent_surfaces_by_their_opacity():
    glass = TexturedMaterial(alpha=0.3, alpha_mode="blend")
    mesh = Scene([Part("glass", sheet(0.5), glass), Part("wall", sheet(0.0), PLAIN)]).mesh
    seen = pixels.nearest_fragments(mesh, CAMERA, occluder=Occluder(mesh))
    triangle = np.asarray(seen.triangle)[10:22, 10:22]
    assert np.mean(triangle < 2) == pytest.approx(0.3, abs=0.1)
    np.testing.assert_allclose(np.asarray(seen.barycentric)[10:22, 10:22].sum(-1), 1, rtol=1e-5)


def test_cameras_that_jax_traces_are_refused_where_there_is_an_opacity():
    mesh = Scene([Part("glass", sheet(0.5), TexturedMaterial(alpha=0.3, alpha_mode="blend"))]).mesh
    rays = Occluder(mesh)
    with pytest.raises(ValueError, match="need concrete values, but the camera or the scene is traced by JAX"):
        jax.jit(lambda camera: visible_points(mesh, camera, samples=4, occluder=rays))(CAMERA)
