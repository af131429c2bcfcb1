import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh
from scipy.spatial import Delaunay

from jaxprt.image import pixels, raster
from jaxprt.scene import Camera, Mesh

POSITION_TOLERANCE = 2e-5  # Relative to the scene: float32 rounding, times the slope of what is seen at grazing angles.

_project, _view_axes = jax.jit(raster.project), jax.jit(raster.view_axes)


def _mesh(position, face):
    """A mesh, padded by triangles without area so that most tests share one compilation."""
    position = np.pad(np.asarray(position, np.float32), ((0, -len(position) % 1024), (0, 0)))
    face = np.pad(np.asarray(face, np.int32), ((0, -len(face) % 512), (0, 0)))
    zero = jnp.zeros(position.shape, jnp.float32)
    return Mesh(jnp.asarray(position), jnp.asarray(face), zero, zero, jnp.zeros(len(position), jnp.int32))


def _camera(eye=(0, 0, 4), target=(0, 0, 0), up=(0, 1, 0), angle=np.pi / 2, width=64, height=48):
    eye, target, up = (jnp.asarray(x, jnp.float32) for x in (eye, target, up))
    return Camera(eye, target, up, jnp.float32(angle), width, height)


def _on_pixels(x, y, camera):
    """Positions in the plane z = 0 that the camera at (0, 0, 4) sees at these pixel coordinates, without rounding."""
    unit = 8 / camera.height
    return np.stack([(x - camera.width / 2) * unit, (camera.height / 2 - y) * unit, 0 * x], axis=-1)


def _torus(n, m):
    """A bumpy torus of 2 n m triangles."""
    u, v = (a.ravel() for a in np.meshgrid(np.arange(n) / n, np.arange(m) / m, indexing="ij"))
    u, v = 2 * np.pi * u, 2 * np.pi * v
    tube = 0.45 + 0.05 * np.sin(9 * u) * np.cos(7 * v)
    ring = 1 + tube * np.cos(v)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(n), np.arange(m), indexing="ij"))
    a, b, c, d = i * m + j, (i + 1) % n * m + j, (i + 1) % n * m + (j + 1) % m, i * m + (j + 1) % m
    face = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    return np.stack([ring * np.cos(u), tube * np.sin(v), ring * np.sin(u)], -1), face


def _box():
    corner = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
    quad = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return corner, [t for a, b, c, d in quad for t in ((a, b, c), (a, c, d))]


def _soup(seed, n, reach=3.0):
    """Triangles anywhere around the origin, of very different sizes."""
    rng = np.random.default_rng(seed)
    size = np.exp(rng.uniform(-4, 1.5, (n, 1, 1)))
    position = rng.uniform(-reach, reach, (n, 1, 3)) + size * rng.standard_normal((n, 3, 3))
    return position.reshape(-1, 3), np.arange(3 * n).reshape(n, 3)


def _traced(position, face, camera):
    """Nearest triangle and its depth by float64 ray tracing of every pixel against every triangle, and the margin.

    The margin is how far the closest decision of the pixel (inside an edge, in front of the next) is from a tie.
    """
    ray = np.asarray(raster.ray_direction(camera), np.float64).reshape(-1, 1, 3)
    eye = np.asarray(camera.eye, np.float64)
    a, b, c = np.moveaxis(np.asarray(position, np.float32).astype(np.float64)[np.asarray(face)], 1, 0)
    normal = np.cross(b - a, c - a)
    slope = np.sum(ray * normal, -1)
    t = np.sum((a - eye) * normal, -1) / slope
    hit = eye + t[..., None] * ray - a
    square = np.sum(normal**2, -1)
    v = np.sum(np.cross(hit, c - a) * normal, -1) / square
    w = np.sum(np.cross(b - a, hit) * normal, -1) / square
    edge = np.minimum(np.minimum(v, w), 1 - v - w)
    forward = np.asarray(_view_axes(camera), np.float64)[2]
    depth = np.where((edge > 0) & (t > 0), t * (ray[..., 0, :] @ forward)[:, None], np.inf)
    two = np.sort(depth, -1)[:, :2]
    with np.errstate(invalid="ignore"):
        gap = np.where(np.isfinite(two[:, 1]), (two[:, 1] - two[:, 0]) / two[:, 0], np.inf)
    margin = np.minimum(np.min(np.abs(edge), -1), gap)
    shape = (camera.height, camera.width)
    triangle = np.where(np.isfinite(two[:, 0]), np.argmin(depth, -1), -1)
    return triangle.reshape(shape), two[:, 0].reshape(shape), margin.reshape(shape)


def test_each_pixel_of_a_tessellated_square_belongs_to_exactly_one_triangle():
    camera = _camera()
    rng = np.random.default_rng(0)
    x, y = rng.integers(0, 97, (2, 150)) / 2  # Many vertices lie on pixels' centers, many edges run through them.
    x, y = np.append(x, [0, 0, 64, 64]), np.append(y, [0, 48, 0, 48])
    face = Delaunay(np.stack([x, y], -1)).simplices
    position = _on_pixels(x, y, camera)
    np.testing.assert_array_equal(np.asarray(_project(jnp.asarray(position, jnp.float32), camera)[0]) + 32, x)
    flipped = np.where(rng.random((len(face), 1)) < 0.5, face, face[:, ::-1])
    count = sum(np.asarray(raster.rasterize(_mesh(position, t[None]), camera).triangle == 0, int) for t in flipped)
    np.testing.assert_array_equal(count, 1)


def test_each_pixel_of_a_tessellated_square_belongs_to_exactly_one_triangle_without_exact_coordinates():
    rng = np.random.default_rng(1)
    point = rng.uniform(-1, 1, (60, 2))
    point = np.concatenate([point, [[-9, -9], [-9, 9], [9, -9], [9, 9]]])
    face = Delaunay(point).simplices
    position = np.append(point, 0.2 * point[:, :1], axis=-1)
    camera = _camera(eye=(0.3, -0.2, 2.1), target=(0.1, 0.2, 0))
    count = sum(np.asarray(raster.rasterize(_mesh(position, t[None]), camera).triangle == 0, int) for t in face)
    np.testing.assert_array_equal(count, 1)


def test_a_center_on_an_edge_belongs_to_the_side_right_of_it_or_below():
    camera = _camera()
    x, y = np.array([0, 1.5, 64, 0, 1.5, 64, 0, 1.5, 64]), np.array([0, 0, 0, 1.5, 1.5, 1.5, 48, 48, 48])
    quads = [[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4], [3, 4, 7], [3, 7, 6], [4, 5, 8], [4, 8, 7]]
    quad = np.asarray(raster.rasterize(_mesh(_on_pixels(x, y, camera), quads), camera).triangle) // 2
    expected = np.where(np.arange(48)[:, None] < 1, [0] + [1] * 63, [2] + [3] * 63)
    np.testing.assert_array_equal(quad, expected)


@pytest.mark.parametrize("seed", range(2))
def test_triangles_of_all_sizes_around_the_camera_are_seen_as_ray_tracing_sees_them(seed):
    position, face = _soup(seed, 300)
    camera = _camera(eye=(0.1, 0.2, 0.3), target=(1, 0.4, -1))
    fragments = raster.rasterize(_mesh(position, face), camera)
    triangle, depth, margin = _traced(position, face, camera)
    clear = margin > 1e-5
    assert clear.mean() > 0.98
    np.testing.assert_array_equal(np.asarray(fragments.triangle)[clear], triangle[clear])
    np.testing.assert_allclose(np.asarray(fragments.depth)[clear], depth[clear], rtol=2e-4)


def test_primary_hits_equal_embree():
    position, face = _torus(160, 80)
    camera = _camera(eye=(0.5, 1.8, 2.2), angle=0.9, width=256, height=192)
    triangle = np.asarray(raster.rasterize(_mesh(position, face), camera).triangle)
    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, position.astype(np.float32), face.astype(np.int32))
    ray = np.asarray(raster.ray_direction(camera), np.float32).reshape(-1, 3)
    origin = np.broadcast_to(np.asarray(camera.eye, np.float32), ray.shape).copy()
    traced = np.asarray(scene.run(origin, ray, query="INTERSECT")).reshape(triangle.shape)
    assert (traced >= 0).mean() > 0.25
    # The rays' directions are rounded, by 1e-7: a pixel in a million times its edges' length may differ.
    assert np.sum(triangle != traced) <= 3
    different = np.argwhere(triangle != traced)
    for i, j in different:
        assert len(set(face[triangle[i, j]]) & set(face[traced[i, j]])) >= 1


def test_the_ground_ends_at_the_horizon_though_it_reaches_behind_the_camera():
    camera = _camera(eye=(0, 1, 0), target=(0, 1, -1))
    mesh = _mesh([[-300, 0, -300], [300, 0, -300], [0, 0, 600]], [[0, 1, 2]])
    fragments = raster.rasterize(mesh, camera)
    np.testing.assert_array_equal(fragments.triangle[:24], -1)
    np.testing.assert_array_equal(fragments.triangle[24:], 0)
    row = np.arange(24, 48) + 0.5
    expected = np.broadcast_to((24 / (row - 24))[:, None], (24, 64))
    np.testing.assert_allclose(fragments.depth[24:], expected, rtol=1e-4)


@pytest.mark.parametrize("target", [(1, 0, 0), (-1, -1, -1), (0, 1, 0)])
def test_inside_a_box_every_pixel_sees_the_wall_that_its_ray_meets(target):
    position, face = _box()
    camera = _camera(eye=(0.1, -0.2, 0.3), target=np.add(target, (0.1, -0.2, 0.3)))
    mesh = _mesh(position, face)
    fragments = raster.rasterize(mesh, camera)
    assert np.all(fragments.triangle >= 0)
    point = pixels.interpolate(fragments, mesh.face, mesh.position)
    ray, eye = np.asarray(raster.ray_direction(camera)), np.asarray(camera.eye)
    with np.errstate(divide="ignore"):
        reach = np.min(np.where(ray > 0, (1 - eye) / ray, (-1 - eye) / ray), axis=-1, where=ray != 0, initial=np.inf)
    np.testing.assert_allclose(point, eye + reach[..., None] * ray, atol=POSITION_TOLERANCE)


def test_triangles_without_area_draw_nothing():
    position = [[-1, 0, 0], [1, 0, 0], [0, 0, 0], [0, 0, 4], [np.nan, 1, 0], [0, np.inf, 0], [0, 2, 4]]
    face = [[0, 0, 0], [0, 1, 1], [0, 1, 2], [3, 0, 1], [3, 3, 0], [4, 0, 1], [5, 0, 1], [0, 2, 3], [3, 6, 2]]
    mesh, camera = _mesh(position, face), _camera()
    fragments = raster.rasterize(mesh, camera)
    np.testing.assert_array_equal(fragments.triangle, -1)
    assert not any(np.isnan(leaf).any() for leaf in jax.tree.leaves(fragments))
    assert np.all(pixels.render(mesh, mesh.position, camera) == 0)


def test_more_patches_than_a_chunk_are_all_drawn(monkeypatch):
    position, face = _soup(5, 300)
    position[-3:] = [[-1, -1, 3.5], [1, -1, 3.5], [0, 0.2, 3.5]]  # The last alone has more patches than a chunk.
    mesh, camera = _mesh(position, face), _camera()
    whole = raster.rasterize(mesh, camera)
    assert np.any(whole.triangle == 299)
    expected, _, margin = _traced(position, face, camera)
    np.testing.assert_array_equal(whole.triangle[margin > 1e-5], expected[margin > 1e-5])
    monkeypatch.setattr(raster, "CHUNK", 64)
    pieces = jax.jit(lambda mesh, camera: raster.rasterize.__wrapped__(mesh, camera))(mesh, camera)
    np.testing.assert_array_equal(pieces.triangle, whole.triangle)
    np.testing.assert_allclose(pieces.depth, whole.depth, rtol=1e-5)


def test_the_camera_has_up_above_and_right_at_the_right():
    camera = _camera()
    mesh = _mesh([[1, 1, 0], [1.5, 1, 0], [1, 1.5, 0]], [[0, 1, 2]])
    row, column = np.nonzero(np.asarray(raster.rasterize(mesh, camera).triangle) == 0)
    assert row.max() < 24
    assert column.min() > 32
    ray = raster.ray_direction(camera)
    np.testing.assert_allclose(np.linalg.norm(ray, axis=-1), 1, atol=1e-6)
    np.testing.assert_allclose(ray[0, 0] / -ray[0, 0, 2], [-63 / 48, 47 / 48, -1], atol=1e-6)


@pytest.mark.parametrize("up", [(0, 0, -3), (0, 0, 0)])
def test_an_up_along_the_view_still_gives_a_picture(up):
    camera = _camera(up=up)
    axes = _view_axes(camera)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-6)
    position, face = _box()
    assert np.any(raster.rasterize(_mesh(position, face), camera).triangle >= 0)


def _scene():
    position, face = _torus(12, 8)
    mesh = _mesh(position, face)
    color = jnp.asarray(np.random.default_rng(0).random(mesh.position.shape), jnp.float32)
    return mesh, color, _camera(eye=(0, 2, 2))


def test_render_is_constant_in_geometry_and_camera():
    mesh, color, camera = _scene()
    gradient = eqx.filter_grad(lambda both: jnp.sum(pixels.render(both[0], color, both[1])))((mesh, camera))
    assert all(np.all(leaf == 0) for leaf in jax.tree.leaves(gradient))


def test_the_background_is_seen_where_nothing_is():
    mesh, color, camera = _scene()
    background = raster.ray_direction(camera)
    image = pixels.render(mesh, color, camera, background=background)
    triangle = np.asarray(raster.rasterize(mesh, camera, samples=4).triangle)
    np.testing.assert_array_equal(image[(triangle < 0).all(-1)], background[(triangle < 0).all(-1)])
    seen = (triangle >= 0).all(-1)
    assert seen.any()
    np.testing.assert_allclose(image[seen], pixels.render(mesh, color, camera)[seen], rtol=1e-6)


def test_an_attribute_may_have_any_trailing_shape():
    mesh, color, camera = _scene()
    fragments = raster.rasterize(mesh, camera)
    image = pixels.interpolate(fragments, mesh.face, color)
    np.testing.assert_allclose(pixels.interpolate(fragments, mesh.face, color[:, 0]), image[..., 0], atol=1e-6)
    deep = pixels.interpolate(fragments, mesh.face, color[:, None, :] * jnp.ones((1, 2, 1)))
    np.testing.assert_allclose(deep, jnp.stack([image, image], axis=2), atol=1e-6)


@pytest.mark.parametrize("shape", [(3, 3), (4, 0, 3)])
@pytest.mark.usefixtures("unchecked")
def test_another_number_of_colors_than_vertices_is_refused(shape):
    mesh = Mesh(jnp.zeros((4, 3)), jnp.zeros((2, 3), jnp.int32), *[jnp.zeros((4, 3))] * 2, jnp.zeros(4, jnp.int32))
    with pytest.raises(ValueError, match=r"color must be \[4, c\], one per vertex, got"):
        pixels.render(mesh, jnp.ones(shape), _camera())


def test_a_mesh_without_triangles_is_refused():
    with pytest.raises(ValueError, match="got 0 triangles"):
        raster.rasterize(_mesh(np.zeros((3, 3)), np.zeros((0, 3), int)), _camera())


def test_colors_of_whole_numbers_are_drawn(unchecked):
    mesh, color, camera = _scene()
    whole = jnp.full(color.shape, 200, jnp.uint8)
    seen = np.all(raster.rasterize(mesh, camera, samples=4).triangle >= 0, -1)
    np.testing.assert_allclose(pixels.render(mesh, whole, camera)[seen], 200, rtol=1e-5)


# The last test here: it forgets all programs, twice.
def test_gpus_draw_what_cpus_draw(elsewhere, monkeypatch):
    position, face = _soup(6, 12, reach=1.5)
    face = np.concatenate([face, face[:6], [[0, 0, 1]]])  # Of equal triangles the first is seen; some have no area.
    mesh, camera = _mesh(position, face), _camera()
    wide = raster.rasterize(mesh, camera, samples=4)
    monkeypatch.setattr(raster, "WIDE", 64)  # Several steps, some within a triangle.
    steps = raster.rasterize.__wrapped__(mesh, camera, samples=4)
    monkeypatch.setattr(jax.lax, "platform_dependent", lambda *arguments, cpu, **forms: cpu(*arguments))
    narrow = raster.rasterize.__wrapped__(mesh, camera, samples=4)
    assert 0 < np.mean(np.asarray(narrow.triangle) >= 0) < 1
    for other in (wide, steps):
        np.testing.assert_array_equal(other.triangle, narrow.triangle)
        np.testing.assert_allclose(other.depth, narrow.depth, rtol=1e-5)
