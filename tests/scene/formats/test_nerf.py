"""Cameras in the convention of NeRF and Blender: round trips, known points, and files that are none."""

import json

import numpy as np
import pytest

from jaxprt.image import ray_direction
from jaxprt.scene import Camera
from jaxprt.scene.formats import nerf

CAMERA = Camera([1.0, 2.0, 3.0], [0.2, 0.4, -0.1], [0.0, 1.0, 0.0], 0.7, 40, 30)


def written(path, cameras=(CAMERA,), **more):
    frames = [{"file_path": f"./{number}.png"} for number in range(len(cameras))]
    path.write_text(json.dumps(nerf.content(cameras, frames, range(len(cameras))) | more))
    return path


def test_cameras_come_back_from_their_files(tmp_path):
    other = Camera([-1.0, 0.5, 2.0], [0.0, 0.0, 0.0], [0.1, 1.0, 0.0], 0.7, 40, 30)
    loaded = nerf.load(written(tmp_path / "transforms.json", (CAMERA, other)))
    for before, after in zip((CAMERA, other), loaded, strict=True):
        assert (after.width, after.height) == (40, 30)
        np.testing.assert_allclose(after.eye, before.eye, atol=1e-6)
        np.testing.assert_allclose(ray_direction(after), ray_direction(before), atol=1e-5)


def test_points_project_where_nerf_expects_them():
    """The projection of nerfstudio and instant-ngp: x = w / 2 + f X / -Z, y = h / 2 - f Y / -Z in camera space."""
    point = np.array([0.5, 0.1, -0.3])
    blender = np.array([point[0], -point[2], point[1]])  # Blender's import of glTF: +y becomes +z
    local = np.linalg.inv(nerf.matrix(CAMERA)) @ [*blender, 1]
    focal = 0.5 * CAMERA.width / np.tan(0.5 * nerf.horizontal_angle(CAMERA))
    x = CAMERA.width / 2 + focal * local[0] / -local[2]
    y = CAMERA.height / 2 - focal * local[1] / -local[2]
    way = point - np.asarray(CAMERA.eye)
    cosine = np.asarray(ray_direction(CAMERA)) @ (way / np.linalg.norm(way))
    row, column = np.unravel_index(np.argmax(cosine), cosine.shape)
    assert abs(x - column - 0.5) <= 0.5 + 1e-6
    assert abs(y - row - 0.5) <= 0.5 + 1e-6


def test_pictures_of_another_width_have_the_same_angle_and_proportions(tmp_path):
    (camera,) = nerf.load(written(tmp_path / "transforms.json"), width=80)
    assert (camera.width, camera.height) == (80, 60)
    np.testing.assert_allclose(camera.field_of_view, 0.7, rtol=1e-6)


def test_focal_lengths_stand_for_the_angle(tmp_path):
    focal = 0.5 * 40 / np.tan(0.5 * nerf.horizontal_angle(CAMERA))
    path = written(tmp_path / "transforms.json", camera_angle_x=None, fl_x=focal, fl_y=focal, cx=20, cy=15)
    np.testing.assert_allclose(nerf.load(path)[0].field_of_view, 0.7, rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"frames": []}, "must have a list of frames"),
        ({"frames": [{}]}, "frame 0 must have a transform_matrix of 4 x 4 finite numbers"),
        ({"frames": [{"transform_matrix": np.zeros((4, 4)).tolist()}]}, "axes that are not orthogonal"),
        ({"frames": [{"transform_matrix": np.diag([1.0, 1, -1, 1]).tolist()}]}, "axes that are not orthogonal"),
        ({"camera_angle_x": 4}, "camera_angle_x between 0 and pi"),
        ({"camera_angle_x": "wide"}, "a finite number as camera_angle_x"),
        ({"k1": 0.1}, "must be a pinhole camera"),
        ({"cx": 5}, "its axis in the center"),
        ({"fl_x": 30, "fl_y": 60}, "square pixels"),
    ],
    ids=str,
)
def test_files_that_are_none_are_refused(tmp_path, change, words):
    path = written(tmp_path / "transforms.json", **change)
    with pytest.raises(ValueError, match=words):
        nerf.load(path)
