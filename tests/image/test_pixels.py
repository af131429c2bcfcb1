"""Points that pictures shade, and what lies behind translucent surfaces.

Hidden backs, holes and translucent surfaces in pictures.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy
import trimesh

from jaxprt.image import interpolate, pixels, raster, resolve
from jaxprt.image.pixels import visible_points
from jaxprt.scene import Camera, Mesh, Part, Scene, Texture, TexturedMaterial
from jaxprt.scene.mesh import grid_face, join, make_mesh
from jaxprt.visibility import Occluder

# What the share of a pixel's samples on one side of a straight edge may be off from the area there: by a search over
# all directions and places of the edge, and of upright and level ones. Samples in two rows and columns are off by 1/4.
MOST_OFF, MOST_OFF_UPRIGHT = 0.302, 1 / 8
EXACT = 1e-5  # Rounding in float32.
RAMP = Texture(np.array([[[0.0], [1.0]]], np.float32), np.eye(2, 3, dtype=np.float32), 0, ("clamp", "clamp"))
CAMERA = Camera((0.1, 0.05, 3.0), (0.0, 0, 0), (0.0, 1, 0), 0.9, 33, 32)


def _camera(eye=(0, 0, 4), target=(0, 0, 0), angle=np.pi / 2, width=32, height=24):
    return Camera(jnp.asarray(eye, jnp.float32), target, [0.0, 1, 0], angle, width, height)


def _mesh(position, face, normal=(0, 0, 1), region=0, faces=512):
    """A mesh, padded by triangles without area so that most tests share what is compiled."""
    position, face = np.asarray(position, np.float32), np.asarray(face, np.int32)
    spare = 2 * faces - len(position)
    normal = np.broadcast_to(np.asarray(normal, np.float32), position.shape)
    region = np.broadcast_to(np.asarray(region, np.int32), len(position))
    position, normal = (np.concatenate([rows, np.repeat(rows[-1:], spare, 0)]) for rows in (position, normal))
    region = np.append(region, np.repeat(region[-1:], spare))
    face = np.concatenate([face, np.full((faces - len(face), 3), len(position) - 1, np.int32)])
    return Mesh(*(jnp.asarray(each) for each in (position, face, normal, normal[:, [1, 2, 0]], region)))


def _ball(subdivisions=2, faces=512):
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    return _mesh(ball.vertices, ball.faces, ball.vertices, faces=faces)


def _sphere(rows, columns):
    """Vertices of the unit sphere on circles of latitude."""
    i, j = (a.ravel() for a in np.meshgrid(np.arange(rows + 1), np.arange(columns), indexing="ij"))
    polar, around = np.pi * i / rows, 2 * np.pi * j / columns
    position = np.stack([np.sin(polar) * np.sin(around), np.cos(polar), np.sin(polar) * np.cos(around)], -1)
    i, j = i[:-columns], j[:-columns]
    a, b = i * columns + j, i * columns + (j + 1) % columns
    face = np.concatenate([np.stack([a, a + columns, b + columns], -1), np.stack([a, b + columns, b], -1)])
    return _mesh(position, face, position)


_points = jax.jit(pixels.shading_points)  # with as much padding for every mesh, so that it is compiled once


def _drawn(mesh, camera, samples=4):
    fragments = raster.rasterize(mesh, camera, samples=samples)
    return jax.tree.map(np.asarray, (fragments, _points(fragments, mesh, camera)))


def _coverage(points, camera):
    """Share of each pixel that its points have."""
    total = np.zeros(camera.height * camera.width)
    np.add.at(total, np.asarray(points.pixel), np.asarray(points.coverage))
    return total.reshape(camera.height, camera.width)


def _finer(camera, times):
    width, height = times * camera.width, times * camera.height
    return Camera(camera.eye, camera.target, camera.up, camera.field_of_view, width, height)


def _triangle_on_pixels(corner, camera):
    """One triangle in the plane z = 0 with corners [3, 2] at these pixel coordinates, for the camera at (0, 0, 4)."""
    unit = 8 / camera.height
    x, y = np.asarray(corner, float).T
    position = np.stack([(x - camera.width / 2) * unit, (camera.height / 2 - y) * unit, 0 * x], -1)
    return _mesh(position, [[0, 1, 2]])


def _half_plane(direction, distance, camera):
    """Corners of a triangle of which a camera sees one side, as far as this from the picture's middle."""
    along, across = np.array([np.cos(direction), np.sin(direction)]), np.array([-np.sin(direction), np.cos(direction)])
    middle = np.array([camera.width, camera.height]) / 2 + distance * across
    return np.array([middle - 500 * along, middle + 500 * along, middle + 500 * across])


def _area(direction, distance, camera):
    """Exact area of each pixel on the far side of the line of `_half_plane`."""
    area = np.zeros((camera.height, camera.width))
    for i, j in np.ndindex(area.shape):
        square = np.array([(j, i), (j + 1, i), (j + 1, i + 1), (j, i + 1)]) - [camera.width / 2, camera.height / 2]
        past = square @ [-np.sin(direction), np.cos(direction)] - distance
        polygon = []
        for k in range(4):
            if past[k - 1] * past[k] < 0:
                share = past[k - 1] / (past[k - 1] - past[k])
                polygon.append((1 - share) * square[k - 1] + share * square[k])
            if past[k] >= 0:
                polygon.append(square[k])
        if len(polygon) > 2:
            x, y = np.asarray(polygon).T
            area[i, j] = abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1))) / 2
    return area


def _off(direction, distance):
    camera = _camera()
    mesh = _triangle_on_pixels(_half_plane(direction, distance, camera), camera)
    return _coverage(_drawn(mesh, camera)[1], camera) - _area(direction, distance, camera)


def test_coverage_is_the_area_on_the_inside_of_an_edge_to_what_four_samples_tell():
    rng = np.random.default_rng(0)
    off = np.stack([_off(rng.uniform(0, 2 * np.pi), rng.uniform(-9, 9)) for _ in range(24)])
    cut = np.abs(off) > 1e-4
    assert cut.sum() > 500
    assert np.abs(off).max() < MOST_OFF
    assert np.sqrt(np.mean(off[cut] ** 2)) < 0.12
    assert abs(off[cut].mean()) < 0.01


@pytest.mark.parametrize("turns", [1, 2])
def test_coverage_at_upright_and_level_edges_is_within_an_eighth(turns):
    off = [np.abs(_off(turns * np.pi / 2, 3 + step / 16 + 1 / 64)).max() for step in range(16)]
    assert max(off) <= MOST_OFF_UPRIGHT
    assert max(off) > MOST_OFF_UPRIGHT / 2


def test_samples_are_centers_of_a_picture_four_times_as_fine():
    camera = _camera(eye=(0.5, 0.9, 2.6), target=(0.1, 0, 0.1))
    mesh = join([_ball(), _mesh(*_soup(0, 200))])
    drawn, fine = raster.rasterize(mesh, camera, samples=4), raster.rasterize(mesh, _finer(camera, 4))
    place = (4 * raster.SAMPLES[4] + 1.5).astype(int)
    assert sorted(place[:, 0]) == sorted(place[:, 1]) == [0, 1, 2, 3]
    for k, (x, y) in enumerate(place):
        np.testing.assert_array_equal(drawn.triangle[..., k], fine.triangle[y::4, x::4])
        np.testing.assert_array_equal(drawn.depth[..., k], fine.depth[y::4, x::4])


def _soup(seed, count):
    rng = np.random.default_rng(seed)
    position = rng.uniform(-2, 2, (count, 1, 3)) + 0.3 * rng.standard_normal((count, 3, 3))
    return position.reshape(-1, 3), np.arange(3 * count).reshape(count, 3)


def test_a_closed_mesh_covers_all_that_it_hides_and_a_constant_color_stays_constant():
    camera, mesh = _camera(eye=(0.3, 0.4, 2)), _ball()
    fragments, points = _drawn(mesh, camera)
    np.testing.assert_array_equal(_coverage(points, camera), np.mean(fragments.triangle >= 0, -1))
    np.testing.assert_array_equal(_coverage(points, camera) + points.background, 1)
    gray = jnp.full((len(mesh.position), 1), 0.7, jnp.float32)
    background = jnp.full((camera.height, camera.width, 1), 0.7, jnp.float32)
    np.testing.assert_allclose(pixels.render(mesh, gray, camera, background=background), 0.7, rtol=EXACT)


def _seen_at(mesh, camera, triangle, column, row):
    """Perspective-correct weights in triangles at places of the picture, by float64 rays through their planes."""
    eye, target, up = (np.asarray(each, float) for each in (camera.eye, camera.target, camera.up))
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up) / np.linalg.norm(np.cross(forward, up))
    focal = camera.height / 2 / np.tan(float(camera.field_of_view) / 2)
    x, y = (column - camera.width / 2) / focal, (camera.height / 2 - row) / focal
    ray = forward + x[:, None] * right + y[:, None] * np.cross(right, forward)
    corner = np.asarray(mesh.position, float)[np.asarray(mesh.face)[triangle]] - eye
    weight = np.linalg.solve(np.swapaxes(corner, 1, 2), ray[..., None])[..., 0]  # up to the ray's length
    return weight / weight.sum(-1, keepdims=True)


def _floor(reach=30.0):
    """A ground of two triangles that reaches behind the camera."""
    corner = [[-reach, -1, -reach], [reach, -1, -reach], [reach, -1, reach], [-reach, -1, reach]]
    return _mesh(corner, [[0, 2, 1], [0, 3, 2]], (0, 1, 0), region=1)


def _scene():
    return join([_ball(), _floor(), _mesh(*_soup(3, 60), region=0)]), _camera(eye=(0.3, 0.5, 2.6), target=(0, -0.2, 0))


def test_weights_are_those_at_the_mean_place_of_the_samples_of_one_triangle():
    mesh, camera = _scene()
    fragments, points = _drawn(mesh, camera)
    triangle, pixel = np.asarray(points.triangle), np.asarray(points.pixel)
    own = np.asarray(fragments.triangle).reshape(-1, 4)[pixel] == triangle[:, None]
    alone = (triangle >= 0) & (own.mean(1) == np.asarray(points.coverage))
    assert alone.sum() > 500
    assert np.sum(alone & (np.asarray(points.coverage) < 1)) > 50
    middle = (own @ raster.SAMPLES[4] / np.maximum(own.sum(1), 1)[:, None])[alone]
    column, row = pixel[alone] % camera.width + 0.5 + middle[:, 0], pixel[alone] // camera.width + 0.5 + middle[:, 1]
    expected = _seen_at(mesh, camera, triangle[alone], column, row)
    np.testing.assert_allclose(points.barycentric[alone], expected, atol=2e-4)


def test_slopes_are_differences_of_weights():
    mesh, camera = _scene()
    _, points = _drawn(mesh, camera)
    triangle, weight = np.asarray(points.triangle), np.asarray(points.barycentric, float)
    inside = (triangle >= 0) & (weight.min(1) > 1e-3)
    assert np.sum(triangle[inside] >= 320) > 100, "not only the ball"
    triangle, weight, slope = triangle[inside], weight[inside], np.asarray(points.slope, float)[inside]
    corner = np.asarray(mesh.position, float)[np.asarray(mesh.face)[triangle]]
    place = np.einsum("pk,pki->pi", weight, corner) - np.asarray(camera.eye, float)
    right, up, forward = np.asarray(raster.view_axes(camera), float) @ place.T
    focal = camera.height / 2 / np.tan(float(camera.field_of_view) / 2)
    column, row = camera.width / 2 + focal * right / forward, camera.height / 2 - focal * up / forward
    np.testing.assert_allclose(_seen_at(mesh, camera, triangle, column, row), weight, atol=2e-4)
    step = 1e-5
    for axis, (x, y) in enumerate(((step, 0), (0, step))):
        ahead, back = (_seen_at(mesh, camera, triangle, column + k * x, row + k * y) for k in (1, -1))
        expected = (ahead - back) / (2 * step)
        error = np.linalg.norm(slope[:, axis] - expected, axis=-1)
        assert np.all(error < 1e-3 * (1 + np.linalg.norm(expected, axis=-1)))
    np.testing.assert_allclose(slope.sum(-1), 0, atol=EXACT * np.abs(slope).max())


def test_a_smooth_mesh_finer_than_the_pixels_has_one_point_in_each_pixel_that_it_fills():
    camera, mesh = _camera(eye=(0.3, 0.4, 2), angle=0.9), _ball(4, faces=5120)
    fragments, points = _drawn(mesh, camera)
    triangle = np.asarray(fragments.triangle).reshape(-1, 4)
    filled = (triangle >= 0).all(1)
    several = filled & (triangle != triangle[:, :1]).any(1)
    assert several.sum() > 0.9 * filled.sum() > 300
    count = np.bincount(np.asarray(points.pixel), np.asarray(points.coverage) > 0, minlength=len(triangle))
    looking = np.abs(_facing(mesh, camera, points))[: np.sum(points.coverage > 0)]
    steep = np.unique(np.asarray(points.pixel)[: len(looking)][looking < 0.6])  # Normals differ within pixels there.
    assert np.all(np.delete(count, steep)[np.delete(filled, steep)] == 1)
    assert count[steep].mean() < 2
    inside = np.asarray(points.coverage) > 0
    assert np.asarray(points.barycentric)[inside].min() >= 0
    np.testing.assert_allclose(np.asarray(points.barycentric)[inside].sum(1), 1, rtol=EXACT)


def _facing(mesh, camera, points):
    """Cosines between normals and views of points."""
    normal, place = (np.asarray(pixels.interpolate(points, mesh.face, each)) for each in (mesh.normal, mesh.position))
    view = np.asarray(camera.eye) - place
    return np.sum(normal * view, -1) / np.linalg.norm(view, axis=-1)


def _square(height=0.0, low=(-2, -2), high=(2, 2)):
    (a, b), (c, d) = low, high
    return [[a, b, height], [c, b, height], [c, d, height], [a, d, height]], np.array([[0, 1, 2], [0, 2, 3]])


def _split(normal, region):
    """A tilted square of two triangles without common vertices, which differ in their normals or regions."""
    position, face = _square()
    position = np.asarray(position)[face.ravel()] @ trimesh.transformations.rotation_matrix(0.3, [1, 2, 0])[:3, :3].T
    return _mesh(position, np.arange(6).reshape(2, 3), np.repeat(normal, 3, 0), np.repeat(region, 3))


@pytest.mark.parametrize(
    ("normal", "region", "apart"),
    [
        ([[0, 0, 1], [0, 0, 1]], [0, 0], False),
        ([[0, 0, 1], [0, 0.1, 0.995]], [0, 0], False),
        ([[0, 0, 1], [0, 0.2, 0.98]], [0, 0], True),
        ([[0, 0, 1], [0, 0, 1]], [0, 1], True),
    ],
)
def test_triangles_share_points_only_where_they_are_one_smooth_surface(normal, region, apart):
    camera, mesh = _camera(), _split(normal, region)
    fragments, points = _drawn(mesh, camera)
    triangle = np.asarray(fragments.triangle).reshape(-1, 4)
    both = np.flatnonzero((triangle == 0).any(1) & (triangle == 1).any(1))
    assert len(both) > 5
    count = np.bincount(np.asarray(points.pixel), np.asarray(points.coverage) > 0, minlength=len(triangle))
    np.testing.assert_array_equal(count[both], 2 if apart else 1)


@pytest.mark.parametrize(("gap", "apart"), [(0.5, True), (0.02, True), (0.0, False)])
def test_a_step_in_depth_keeps_parallel_surfaces_apart(gap, apart):
    (first, face), (second, _) = _square(0, high=(0.11, 2)), _square(-gap, low=(0.11 - gap, -2))
    mesh = _mesh([*first, *second], [*face, *(face + 4)])
    camera = _camera()
    fragments, points = _drawn(mesh, camera)
    triangle = np.asarray(fragments.triangle).reshape(-1, 4)
    both = ((triangle >= 0) & (triangle < 2)).any(1) & (triangle >= 2).any(1)
    assert both.sum() > 10
    count = np.bincount(np.asarray(points.pixel), np.asarray(points.coverage) > 0, minlength=len(triangle))
    np.testing.assert_array_equal(count[both], 2 if apart else 1)


def test_what_is_seen_from_behind_is_black_and_hides_the_background():
    camera = _camera()
    position, face = _square(low=(-2.1, -2), high=(2, 2.1))
    mesh = _mesh(position, face, (0, 0, -1))
    fragments, points = _drawn(mesh, camera)
    assert not np.any(points.coverage)
    hidden = np.mean(fragments.triangle >= 0, -1)
    assert hidden.max() == 1
    assert np.any((hidden > 0) & (hidden < 1))
    white = jnp.ones((camera.height, camera.width, 1))
    picture = pixels.render(mesh, jnp.ones((len(mesh.position), 1)), camera, background=white)
    np.testing.assert_array_equal(picture[..., 0], 1 - hidden)


@pytest.mark.parametrize("eye", [(0.6, 0.3, 3.3), None])
def test_a_white_sphere_of_few_triangles_has_no_black_rim(eye):
    mesh = _sphere(10, 20)
    # Just outside of one triangle, below the horizons of all vertices.
    eye = 1.002 * np.mean(mesh.position[mesh.face[150]], 0) if eye is None else eye
    camera = _camera(eye=eye)
    fragments = raster.rasterize(mesh, camera, samples=4)
    picture = pixels.render(mesh, jnp.ones((len(mesh.position), 1)), camera)
    seen = np.mean(fragments.triangle >= 0, -1)
    np.testing.assert_allclose(picture[..., 0], seen, rtol=EXACT)
    looking = np.asarray(jnp.sum(mesh.normal * (camera.eye - mesh.position), -1))[np.asarray(mesh.face)]
    assert np.linalg.norm(eye) > 3 or (seen.min() == 1 and looking[np.unique(fragments.triangle)].max() < 0)


def test_resolve_adds_up_what_the_samples_see():
    mesh, camera = _scene()
    fragments, points = _drawn(mesh, camera)
    rng = np.random.default_rng(0)
    color = rng.random((len(points.pixel), 3)).astype(np.float32)
    background = rng.random((camera.height, camera.width, 3)).astype(np.float32)
    share = np.mean(np.asarray(fragments.triangle) < 0, -1)
    expected = (share[..., None] * background).reshape(-1, 3).astype(float)
    np.add.at(expected, np.asarray(points.pixel), np.asarray(points.coverage)[:, None] * color)
    picture = pixels.resolve(points, jnp.asarray(color), background=jnp.asarray(background))
    np.testing.assert_allclose(np.reshape(picture, (-1, 3)), expected, atol=EXACT)
    np.testing.assert_array_equal(points.background, share)
    assert np.all(np.diff(points.pixel) >= 0)
    # What padding holds, and a background that nothing shows, do not count, even NaN.
    color[np.asarray(points.coverage) == 0] = np.nan
    background[share == 0] = np.nan
    assert np.any(np.isnan(color))
    assert np.any(np.isnan(background))
    same = pixels.resolve(points, jnp.asarray(color), background=jnp.asarray(background))
    np.testing.assert_array_equal(same, picture)


@pytest.mark.parametrize("samples", [1, 4])
def test_inside_of_jit_are_the_same_points_and_more_padding(samples):
    mesh, camera = _scene()
    fragments, inside = _drawn(mesh, camera, samples)
    points = pixels.shading_points(fragments, mesh, camera)
    count = int(np.sum(points.coverage > 0))
    assert count <= len(points.pixel) <= 1.125 * count + 1
    assert len(inside.pixel) == samples * camera.height * camera.width
    for name in ("triangle", "pixel", "coverage"):
        np.testing.assert_array_equal(getattr(inside, name)[:count], getattr(points, name)[:count])
    np.testing.assert_allclose(inside.barycentric[:count], points.barycentric[:count], atol=EXACT)
    scale = 1 + np.abs(points.slope[:count])
    np.testing.assert_allclose(inside.slope[:count] / scale, points.slope[:count] / scale, atol=1e-3)
    for each in (inside, points):
        np.testing.assert_array_equal(each.triangle[count:], -1)
        assert not any(np.any(field[count:]) for field in (each.coverage, each.barycentric, each.slope))


def test_one_sample_is_the_pixels_center():
    mesh, camera = _scene()
    fragments, points = _drawn(mesh, camera, 1)
    shown = np.asarray(raster.front(fragments, mesh, camera))
    np.testing.assert_array_equal(points.pixel[: shown.sum()], np.flatnonzero(shown))
    np.testing.assert_array_equal(points.triangle[: shown.sum()], np.asarray(fragments.triangle)[shown])
    np.testing.assert_allclose(points.barycentric[: shown.sum()], fragments.barycentric[shown], atol=2e-4)
    np.testing.assert_array_equal(_coverage(points, camera), shown)


@pytest.mark.parametrize("samples", [1, 4])
def test_no_mesh_and_no_triangle_makes_a_picture_that_is_not_a_number(samples):
    camera = _camera()
    rng = np.random.default_rng(0)
    center = np.asarray(_triangle_on_pixels([[16.5, 12.5]] * 3, camera).position[0])
    thin = center + np.outer([-1, 1, 1], [1, 0.3, 0]) + [[0, 0, 0], [0, 0, 0], [0, 1e-9, 0]]
    eye = [[0, 0, 4], [1, 0, 4], [0, 1e-30, 4 - 1e-7]]
    huge = 1e18 * rng.standard_normal((3, 3))
    lost = [[np.nan, 0, 0], [0, np.inf, 0], [0, 0, 0]]
    corner = np.concatenate([np.repeat([center], 3, 0), thin, eye, huge, lost, *rng.standard_normal((60, 3, 3))])
    mesh = _mesh(corner, np.arange(len(corner)).reshape(-1, 3), corner)
    fragments, points = _drawn(mesh, camera, samples)
    assert not any(np.isnan(leaf).any() for leaf in jax.tree.leaves((fragments, points)))
    assert np.all(np.isfinite(points.slope))
    assert np.all(np.isfinite(pixels.render(mesh, jnp.ones((len(mesh.position), 1)), camera, samples=samples)))
    behind = _mesh([[0, 0, 9], [1, 0, 9], [0, 1, 9]] * (len(corner) // 3), mesh.face)
    nothing = _drawn(behind, camera, samples)[1]
    assert not np.any(nothing.coverage)
    sky = jnp.asarray(rng.random((camera.height, camera.width, 2)), jnp.float32)
    picture = pixels.render(behind, jnp.ones((len(behind.position), 2)), camera, background=sky, samples=samples)
    np.testing.assert_array_equal(picture, sky)


def test_pictures_that_do_not_fit_are_refused(unchecked):
    mesh, camera = _ball(), _camera()
    fragments, points = _drawn(mesh, camera)
    with pytest.raises(ValueError, match="samples must be 1 or 4, got 2"):
        raster.rasterize(mesh, camera, samples=2)
    with pytest.raises(ValueError, match=r"camera's 24 x 16 pixels, .* got \[24, 32, 4\]"):
        pixels.shading_points(fragments, mesh, _camera(width=16))
    with pytest.raises(ValueError, match="to the mesh's 2 triangles, got triangle"):
        pixels.shading_points(fragments, _mesh(*_soup(0, 1), faces=2), camera)
    with pytest.raises(ValueError, match="one per point, got"):
        pixels.resolve(points, jnp.ones((len(points.pixel) + 1, 3)))
    with pytest.raises(ValueError, match="interpolate at their shading_points"):
        pixels.interpolate(fragments, mesh.face, mesh.normal)
    with pytest.raises(ValueError, match=r"samples must be 1 or 4, got 4\.0"):
        raster.rasterize(mesh, camera, samples=4.0)


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


def test_four_points_of_a_sample_are_the_samples_of_a_picture_of_twice_the_size():
    ball, wall = _ball(), _mesh([[-3, -3, -2], [3, -3, -2], [3, 3, -2]], [[0, 1, 2]], region=1)
    mesh, eye = join([ball, wall]), (0, 0.3, 2)
    camera, twice = _camera(eye), _camera(eye, width=64, height=48)
    color = np.random.default_rng(0).uniform(size=(len(mesh.position), 3)).astype(np.float32)
    color[np.asarray(mesh.region) == 1] = 0

    def picture(camera, detail, occluder=None):
        detail = jnp.where(mesh.region[mesh.face[:, 0]] == 0, detail, 1).astype(jnp.uint8)
        points = visible_points(mesh, camera, samples=4, occluder=occluder, detail=detail)
        return points, np.asarray(resolve(points, interpolate(points, mesh.face, jnp.asarray(color))))

    (points, four), (_, one) = picture(camera, 2, Occluder(mesh)), picture(camera, 1)
    finer = picture(twice, 1)[1].reshape(24, 2, 32, 2, 3).mean((1, 3))
    on_ball = (mesh.region == 0).astype(jnp.float32)[:, None]
    inside = np.asarray(resolve(points, interpolate(points, mesh.face, on_ball)))[..., 0] > 1 - 1e-4
    inside = scipy.ndimage.binary_erosion(inside)
    assert inside.sum() > 50
    np.testing.assert_allclose(four[inside], finer[inside], atol=1e-4)
    assert np.abs(one - finer)[inside].max() > 5e-3
    assert np.all(np.diff(points.pixel[points.triangle >= 0]) >= 0)
    # As much of each surface as with one point a sample, also where rays beside the ball hit the wall or nothing.
    whole = [resolve(each, jnp.ones((len(each.triangle), 1))) for each in (points, picture(camera, 1)[0])]
    np.testing.assert_allclose(*whole, atol=1e-6)


PLAIN = TexturedMaterial()


@pytest.mark.parametrize("samples", [1, 4])
def test_a_hole_by_alpha_shows_what_a_hole_in_the_mesh_shows(samples):
    mask = TexturedMaterial(alpha_texture=RAMP, alpha_mode="mask")
    by_alpha = drawn((sheet(0.5), mask), (sheet(0.0), PLAIN), samples=samples)
    cut = drawn((sheet(0.5, (0.0, 1.0)), PLAIN), (sheet(0.0), PLAIN), samples=samples)
    np.testing.assert_allclose(by_alpha, cut, atol=1e-6)
    assert cut[..., 0].max() > 0.99


def test_samples_behind_translucent_surfaces_stay_one_point():
    glass = Part("glass", sheet(0.5, (0.0, 1.0)), TexturedMaterial(alpha=0.3, alpha_mode="blend"))
    mesh = Scene([glass, Part("wall", sheet(0.0), PLAIN)]).mesh
    detail = jnp.full(len(mesh.face), 2, jnp.uint8)
    points = visible_points(mesh, CAMERA, samples=4, occluder=Occluder(mesh), detail=detail)
    left, right = (np.flatnonzero(points.pixel == 16 * CAMERA.width + column) for column in (10, 20))
    np.testing.assert_array_equal(points.coverage[left], np.full(16, 1 / 16))
    np.testing.assert_allclose(points.coverage[right], [0.3 / 4] * 4 + [0.7 / 4] * 4, atol=1e-6)


def test_samples_seen_through_hidden_backs_stay_one_point():
    mesh = Scene([Part("back", sheet(0.5, turn=-1), PLAIN), Part("wall", sheet(0.0), PLAIN)]).mesh
    detail = jnp.full(len(mesh.face), 2, jnp.uint8)
    hidden = np.asarray(mesh.region)[np.asarray(mesh.face)[:, 0]] == 0
    points = visible_points(mesh, CAMERA, samples=4, hidden=hidden, occluder=Occluder(mesh), detail=detail)
    middle = np.flatnonzero(points.pixel == 16 * CAMERA.width + 16)
    np.testing.assert_array_equal(points.coverage[middle], [1 / 4] * 4)


def test_facets_with_sharp_reflections_share_no_point_and_meet_in_sixteen():
    """A ridge of two planes, five degrees apart, along the first quarter of a column of pixels."""
    slope, edge = np.tan(np.radians(2.5)), 0.25 * 2 * np.tan(0.25) / 8
    x = np.array([-9.0, edge, edge, 9.0])
    position = np.stack([np.repeat(x, 2), np.tile([-9.0, 9.0], 4), np.repeat(-slope * np.abs(x - edge), 2)], 1)
    normal = np.repeat([[-slope, 0, 1], [slope, 0, 1.0]], 4, 0)
    face = np.array([[0, 2, 1], [1, 2, 3], [4, 6, 5], [5, 6, 7]])
    mesh = Scene([Part("ridge", make_mesh(position, face, normal=normal), PLAIN)]).mesh
    camera = Camera((0.0, 0, 1), (0.0, 0, 0), (0.0, 1, 0), 0.5, 16, 8)

    def points(detail):
        detail = jnp.full(len(mesh.face), detail, jnp.uint8)
        found = visible_points(mesh, camera, samples=4, occluder=Occluder(mesh), detail=detail)
        seen = np.asarray(found.triangle) >= 0
        return np.asarray(found.pixel)[seen], np.asarray(found.triangle)[seen], np.asarray(found.coverage)[seen]

    smooth, _, _ = points(0)
    assert len(smooth) == 16 * 8
    pixel, triangle, coverage = points(pixels.FACET)
    ridge = pixel % 16 == 8
    np.testing.assert_array_equal(np.bincount(pixel), np.where(np.arange(16 * 8) % 16 == 8, 16, 1))
    np.testing.assert_allclose(coverage[ridge & (triangle < 2)].sum() / 8, 0.25, atol=0.07)


def test_pictures_of_one_pixel_have_sixteen_points():
    mesh = Scene([Part("wall", sheet(0.0, (-9.0, 9.0)), PLAIN)]).mesh
    camera = Camera((0.0, 0, 0.1), (0.0, 0, 0), (0.0, 1, 0), 0.1, 1, 1)
    detail = jnp.full(len(mesh.face), 2, jnp.uint8)
    points = visible_points(mesh, camera, samples=4, occluder=Occluder(mesh), detail=detail)
    np.testing.assert_array_equal(points.coverage[points.triangle >= 0], [1 / 16] * 16)


def test_samples_become_four_points_in_at_most_half_of_the_pixels():
    mesh = Scene([Part("wall", sheet(0.0, (-9.0, 9.0)), PLAIN)]).mesh
    camera = Camera((0.0, 0, 0.5), (0.0, 0, 0), (0.0, 1, 0), 0.9, 33, 32)
    detail = jnp.full(len(mesh.face), 2, jnp.uint8)
    points = visible_points(mesh, camera, samples=4, occluder=Occluder(mesh), detail=detail)
    assert np.count_nonzero(points.triangle >= 0) == 33 * 32 * (16 + 4) / 2
    sums = np.bincount(points.pixel, points.coverage)
    np.testing.assert_allclose(sums, 1, atol=1e-6)


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
