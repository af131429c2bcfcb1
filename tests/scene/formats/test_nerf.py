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


FOCAL = 0.5 * 40 / np.tan(0.5 * nerf.horizontal_angle(CAMERA))
MATRIX = nerf.matrix(CAMERA).tolist()
SMALLER = 2 * np.arctan(0.5 * np.tan(0.35))  # the vertical angle of twice the focal length


@pytest.mark.parametrize("of_frame", [{"fl_x": 2 * FOCAL}, {"fl_y": 2 * FOCAL}, {"camera_angle_y": SMALLER}], ids=str)
@pytest.mark.parametrize("of_file", [{}, {"fl_x": FOCAL, "fl_y": FOCAL}, {"camera_angle_y": 0.7}], ids=str)
def test_a_focal_length_of_a_frame_replaces_all_of_the_file(tmp_path, of_file, of_frame):
    frames = [{"transform_matrix": MATRIX}, {"transform_matrix": MATRIX} | of_frame]
    whole, own = nerf.load(written(tmp_path / "transforms.json", frames=frames, **of_file))
    np.testing.assert_allclose([whole.field_of_view, own.field_of_view], [0.7, SMALLER], rtol=1e-6)


def test_fields_of_a_pinhole_and_of_training_are_read_in_silence(tmp_path):
    plain = {"camera_model": "OPENCV", "is_fisheye": False, "k1": 0, "k6": 0.0, "distortion_params": [0, 0], "w": 40.0}
    plain |= {"fl_x": None, "aabb_scale": 16, "applied_transform": np.eye(4)[:3].tolist(), "applied_scale": 1.0}
    frame = {"transform_matrix": MATRIX[:3], "file_path": "a.png", "rotation": 0.01, "sharpness": 30.0, "w": None}
    (camera,) = nerf.load(written(tmp_path / "transforms.json", frames=[frame], **plain))
    assert (camera.width, camera.height) == (40, 30)
    np.testing.assert_allclose(camera.eye, CAMERA.eye, atol=1e-6)
    np.testing.assert_allclose(camera.field_of_view, 0.7, rtol=1e-6)


def test_one_warning_names_all_fields_that_are_not_read(tmp_path):
    moved = {"applied_transform": [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]], "applied_scale": 0.5, "empty": []}
    path = written(tmp_path / "transforms.json", frames=[{"transform_matrix": MATRIX, "time": 0.5}] * 2, **moved)
    with pytest.warns(UserWarning, match="not supported") as caught:
        nerf.load(path)
    (message,) = [str(warning.message) for warning in caught]
    assert message == "transforms.json: not supported and ignored are applied_scale, applied_transform, time"


def framed(*rows):
    return {"frames": [{"transform_matrix": [*rows, *MATRIX[len(rows) :]]}]}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"frames": []}, "must have a list of frames"),
        ({"frames": [[]]}, "frame 0 must be an object with a transform_matrix, got"),
        ({"frames": [{}]}, "frame 0 must have a transform_matrix of 4 x 4 finite numbers"),
        (framed(["1", 0, 0, 0]), "a transform_matrix of 4 x 4 finite numbers, got"),
        (framed([1, 0, 0, 10**400]), "a transform_matrix of 4 x 4 finite numbers, got"),
        (framed(*MATRIX[:3], [0, 0, 0, 2]), r"the last row 0 0 0 1, got \[0, 0, 0, 2\]"),
        (framed(*np.diag([1.0, 1, -1, 1]).tolist()), "axes that are not orthogonal"),
        (framed(*np.diag([1.0, 1, 2, 1]).tolist()), r"got axes of lengths \[1.0, 1.0, 2.0\]"),
        *[({"camera_angle_x": angle}, "camera_angle_x between 0 and pi, got") for angle in (4, 0)],
        *[({"camera_angle_x": x}, "a finite number as camera_angle_x, got") for x in ("1", True, np.inf)],
        ({"camera_angle_x": None}, "camera_angle_x between 0 and pi, or fl_x with w and h, got none"),
        ({"camera_angle_x": 3.14159265}, "frame 0: the camera's field_of_view must be between"),
        *[({"w": size}, "a whole number of pixels, at least 1, as w, got") for size in (0, 32.5)],
        ({"w": 10**400}, "a finite number as w, got 1000"),
        ({"w": None}, "both w and h or none, got h alone"),
        ({"w": 1e30}, "frame 0: a picture must have at most .* pixels"),
        ({"fl_x": 2 * FOCAL}, "one focal length in pixels, .*square, got .* by fl_x, .* by camera_angle_x"),
        (
            {"camera_angle_y": 0.8},
            "one focal length in pixels, .*square, got .* by camera_angle_x, .* by camera_angle_y",
        ),
        ({"w": None, "h": None, "camera_angle_y": 0.7}, "one focal length in widths of a square picture"),
        ({"w": None, "h": None, "fl_x": FOCAL}, "w and h beside a focal length in pixels, got fl_x"),
        ({"fl_y": 0}, "must have fl_y above 0, got 0"),
        ({"cx": 5}, "its axis in the center, got cx = 5 of 40 pixels"),
        ({"shift_x": 0.1}, "must be a pinhole camera, got shift_x = 0.1"),
        *[({key: 0.1}, f"must be a pinhole camera, got {key} = 0.1") for key in ("k1", "k6", "p2", "b2")],
        *[({"k1": k}, "must be a pinhole camera, got k1") for k in ("0", np.nan, True, [[0.1]])],
        *[({key: True}, f"must be a pinhole camera, got {key}") for key in ("is_fisheye", "ortho", "latlong")],
        *[({"camera_model": x}, "with camera_model one of") for x in ("OPENCV_FISHEYE", 3)],
        ({"camera_convention": "opencv"}, "with camera_convention one of BLENDER, OPENGL, got 'opencv'"),
    ],
    ids=str,
)
def test_files_that_are_none_are_refused(tmp_path, change, words):
    path = written(tmp_path / "transforms.json", **change)
    with pytest.raises(ValueError, match=words):
        nerf.load(path)
