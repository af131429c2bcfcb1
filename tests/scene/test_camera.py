import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt.image import rasterize, ray_direction
from jaxprt.scene.builtin import sphere
from jaxprt.scene.camera import Camera, orbit
from jaxprt.scene.mesh import make_mesh


def basis(camera):
    eye, target, up = (np.asarray(value, np.float64) for value in (camera.eye, camera.target, camera.up))
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up)
    return right, up, forward


def project(camera, point):
    """Coordinates on the picture, -1 to 1 from edge to edge."""
    right, up, forward = basis(camera)
    away = point - np.asarray(camera.eye, np.float64)
    scale = np.tan(float(camera.field_of_view) / 2) * (away @ forward)
    return np.stack([away @ right / scale * camera.height / camera.width, away @ up / scale], -1)


def offset_ball():
    ball = sphere()
    return make_mesh(3 * np.asarray(ball.position) + [5, -2, 7], ball.face)


@pytest.mark.parametrize(("width", "height"), [(512, 512), (800, 300), (300, 800)])
@pytest.mark.parametrize(("azimuth", "elevation"), [(0.0, 0.0), (2.0, 0.7), (-1.0, -1.4)])
def test_the_bounding_sphere_touches_the_nearer_edges_of_the_picture(azimuth, elevation, width, height):
    mesh = offset_ball()
    camera = orbit(mesh, azimuth=azimuth, elevation=elevation, field_of_view=0.8, width=width, height=height)
    # The outline of a tessellated sphere is within half a percent of the sphere's.
    extent = np.abs(project(camera, np.asarray(mesh.position, np.float64))).max(0)
    assert extent.max() == pytest.approx(1, abs=0.005)
    assert extent.max() == extent[0 if width <= height else 1] or width == height


@pytest.mark.parametrize(
    ("azimuth", "elevation", "direction"),
    [
        (0.0, 0.0, [0, 0, 1]),
        (np.pi / 2, 0.0, [1, 0, 0]),
        (-np.pi / 2, 0.0, [-1, 0, 0]),
        (0.0, np.pi / 2, [0, 1, 0]),
        (np.pi / 4, np.pi / 6, [np.sqrt(3 / 8), 0.5, np.sqrt(3 / 8)]),
    ],
)
def test_the_camera_is_in_the_direction_of_its_angles(azimuth, elevation, direction, close):
    camera = orbit(offset_ball(), azimuth=azimuth, elevation=elevation)
    away = np.asarray(camera.eye - camera.target)
    close(away / np.linalg.norm(away), np.array(direction, float), tolerance=1e-5)
    close(camera.target, np.array([5.0, -2.0, 7.0]))


@pytest.mark.parametrize("elevation", [-np.pi / 2, -1.0, 0.0, 1.0, np.pi / 2])
def test_up_is_unit_and_orthogonal_to_the_view_even_at_the_poles(elevation):
    camera = orbit(offset_ball(), azimuth=0.3, elevation=elevation)
    right, up, forward = basis(camera)
    assert np.linalg.norm(up) == pytest.approx(1, abs=1e-6)
    assert up @ forward == pytest.approx(0, abs=1e-6)
    assert right[1] == pytest.approx(0, abs=1e-6)


def test_vertices_without_faces_do_not_count():
    ball = sphere()
    stray = make_mesh(np.concatenate([ball.position, [[1e6, 0, 0]]]), ball.face)
    np.testing.assert_allclose(orbit(stray).eye, orbit(ball).eye, rtol=1e-6)


def test_a_mesh_without_extent_is_seen_from_a_distance():
    point = make_mesh(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    camera = orbit(point)
    assert np.isfinite(camera.eye).all()
    assert np.linalg.norm(camera.eye) > 0


@pytest.mark.parametrize("kind", [list, tuple, np.array])
def test_a_camera_may_be_made_of_lists_and_whole_numbers(kind):
    camera = Camera(kind([0, 0, 4]), target=kind([0, 0, 0]), up=kind([0, 1, 0]), field_of_view=1, width=8, height=6)
    arrays = Camera(jnp.array([0.0, 0, 4]), jnp.zeros(3), jnp.array([0.0, 1, 0]), jnp.float32(1), 8, 6)
    np.testing.assert_array_equal(ray_direction(camera), ray_direction(arrays))
    assert camera.eye.dtype == camera.field_of_view.dtype == jnp.float32
    np.testing.assert_array_equal(rasterize(sphere(), camera).triangle, rasterize(sphere(), arrays).triangle)


def test_a_camera_keeps_double_precision(x64):
    assert Camera(np.array([0.1, 0, 4]), np.zeros(3), [0, 1, 0], 1, 8, 6).eye.dtype == jnp.float64


def test_positions_of_two_numbers_and_pictures_that_cannot_be_counted_are_refused(unchecked):
    with pytest.raises(ValueError, match=r"the camera's target must be one position, \[3\], got .* \[2\]"):
        Camera([1.0, 2, 3], [0.0, 0], [0.0, 1, 0], 0.6, 8, 6)
    with pytest.raises(ValueError, match="at most 536870911 pixels, got 100000 x 100000"):
        Camera([1.0, 2, 3], [0.0, 0, 0], [0.0, 1, 0], 0.6, 100000, 100000)


def test_cameras_that_see_nothing_are_refused(unchecked):
    place = {"eye": [1.0, 2, 3], "target": [0.0, 0, 0], "up": [0.0, 1, 0], "width": 8, "height": 6}
    with pytest.raises(ValueError, match="the camera's field_of_view must be between 0 and pi, in radians, got 45"):
        Camera(**place, field_of_view=45.0)
    with pytest.raises(ValueError, match="the camera's eye and target must be different points"):
        Camera(**place | {"target": [1.0, 2, 3]}, field_of_view=0.6)
