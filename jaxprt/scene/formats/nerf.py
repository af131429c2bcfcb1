"""Cameras in the files `transforms.json` of NeRF (Mildenhall et al. 2020) and of Blender's exporters.

A frame has a matrix from the camera to the world. The camera looks along -z, +x is to the right and +y up in its
picture, as in OpenGL and Blender. The world's +z is up, as in Blender: the point (x, y, z) of jaxprt is (x, -z, y)
there, which is also where Blender puts it when it imports glTF. Angles are in radians; `camera_angle_x` is the full
horizontal one.
"""

import math
import os
import pathlib
import re
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxprt import require
from jaxprt.files import inputs
from jaxprt.files.inputs import JsonObject
from jaxprt.scene.camera import Camera

_WORLD = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # from jaxprt's axes to those of the files
_CLOSE = 1e-3  # relative difference of focal lengths and of axes' lengths, and distance of the axis from the center
_ORTHONORMAL = 1e-3
_LAST_ROW = 1e-6
_AXIS = {"fl_x": 0, "fl_y": 1, "camera_angle_x": 0, "camera_angle_y": 1}  # fields with the focal length
_READ = {"frames", "transform_matrix", "w", "h", "cx", "cy", *_AXIS}
# Fields that name the lens or the axes of the camera, and the names of a pinhole's. Radial and OpenCV models are
# pinholes if their coefficients are zero.
_MODELS = {"PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "PERSP", "OPENCV", "FULL_OPENCV", "SIMPLE_RADIAL", "RADIAL"}
_NAMES = {"camera_model": _MODELS, "camera_type": _MODELS, "lens_type": _MODELS, "projection_type": _MODELS}
_NAMES |= {"camera_convention": {"OPENGL", "BLENDER"}}
# Fields that are false or zero for a pinhole with its axis through the center.
_BENT = re.compile(
    r"[kpsb]\d+|ftheta_.*|distortion.*|dist_coeffs|xi|skew.*|shift_[xy]|rolling_shutter.*|transform_matrix_(start|end)"
    r"|(is_)?(fisheye|ortho|equirect|spherical|panorama|omnidirectional|latlong|vr180).*"
)
# Fields that do not change what the camera sees: files, masks, training, and where NeRF's own volume lies.
_HARMLESS = {"file_path", "mask_path", "ply_file_path", "depth_path", "depth_file_path", "normal_path", "rotation"}
_HARMLESS |= {"colmap_im_id", "sharpness", "sharpen", "aabb", "aabb_scale", "render_aabb", "scale", "offset", "up"}
_HARMLESS |= {"white_transparent", "black_transparent", "importance_sampling", "n_extra_learnable_dims", "near", "far"}
_HARMLESS |= {"enable_depth_loading", "enable_ray_loading", "integer_depth_scale", "depth_unit_scale_factor"}
_HARMLESS |= {"train_filenames", "val_filenames", "test_filenames", "orientation_override", "auto_scale_poses_override"}
_HARMLESS |= {"light", "turn"}  # of `jaxprt dataset`
# nerfstudio's move of cameras away from the scene, which does nothing with these values.
_NEUTRAL = {"applied_scale": (1,), "applied_transform": (np.eye(4).tolist(), np.eye(4)[:3].tolist())}


def matrix(camera: Camera) -> Float[np.ndarray, "4 4"]:
    """The matrix from the camera to the world of a frame."""
    eye, target, up = (np.asarray(value, np.float64) for value in (camera.eye, camera.target, camera.up))
    back = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross(up, back)
    right = right / np.linalg.norm(right)
    result = np.eye(4)
    result[:3, :3] = _WORLD @ np.stack([right, np.cross(back, right), back], 1)
    result[:3, 3] = _WORLD @ eye
    return result


def horizontal_angle(camera: Camera) -> float:
    """Full horizontal angle of view, in radians."""
    return 2 * math.atan(math.tan(float(camera.field_of_view) / 2) * camera.width / camera.height)


def content(cameras: Sequence[Camera], frames: Sequence[JsonObject], index: Sequence[int]) -> JsonObject:
    """What `transforms.json` holds of frames.

    Args:
        cameras: Cameras of one size and angle.
        frames: What else each frame says, such as its `file_path`.
        index: Index of the camera of each frame.
    """
    first = cameras[0]
    return {
        "camera_angle_x": horizontal_angle(first),
        "w": first.width,
        "h": first.height,
        "frames": [
            frame | {"transform_matrix": matrix(cameras[number]).tolist()}
            for frame, number in zip(frames, index, strict=True)
        ],
    }


def load(path: str | os.PathLike, *, width: int | None = None) -> list[Camera]:
    """The cameras of a file, frame by frame.

    A frame's own fields replace those of the file; a focal length of its own, in pixels or as an angle, replaces all of
    the file's. A warning names fields that are not read and may change the picture.

    Args:
        path: The file.
        width: Width of pictures in pixels, with the proportions of the file; that of the file if None, or 512.

    Raises:
        ValueError: The file has no frames, a frame has no matrix of a camera, its lens is none of a pinhole camera with
            square pixels and its axis through the center of the picture, or its focal lengths differ.
        OSError: The file cannot be read.
    """
    name = pathlib.Path(path).name
    file = _without_null(inputs.json_object(pathlib.Path(path), "a file of cameras"))
    frames = file.get("frames")
    if not isinstance(frames, list) or not frames:
        raise ValueError(f"{name} must have a list of frames, got {require.shown(frames)}")
    cameras, unread = [], _unread(file)
    for number, frame in enumerate(frames):
        what = f"{name}, frame {number}"
        if not isinstance(frame, dict):
            raise ValueError(f"{what} must be an object with a transform_matrix, got {require.shown(frame)}")
        frame = _without_null(frame)
        cameras.append(_camera(what, file, frame, width))
        unread |= _unread(frame)
    if unread:
        warnings.warn(f"{name}: not supported and ignored are {', '.join(sorted(unread))}", stacklevel=2)
    return cameras


def _without_null(fields: JsonObject) -> JsonObject:
    return {key: value for key, value in fields.items() if value is not None}


def _is_zero(value: object) -> bool:
    """Whether a value is false, zero or empty, or a list of such values."""
    return not (any(value) if isinstance(value, list) else value)


def _unread(fields: JsonObject) -> set[str]:
    """Names of fields that are neither read nor harmless."""
    return {
        key[:80]
        for key, value in fields.items()
        if key not in _READ | _HARMLESS | _NAMES.keys()
        and not _BENT.fullmatch(key)
        and not _is_zero(value)
        and value not in _NEUTRAL.get(key, ())
    }


def _camera(what: str, file: JsonObject, frame: JsonObject, width: int | None) -> Camera:
    value = file | frame
    _check_pinhole(what, value)
    size = _size(what, value)
    wide, high = size or (1, 1)
    half = wide / (2 * _focal_length(what, frame, file, size))  # tangent of half the horizontal angle
    for key, edge in zip(("cx", "cy"), size or (None, None), strict=True):
        center = _number(what, value, key)
        if center is None:
            continue
        if edge is None:
            raise ValueError(f"{what} must have w and h beside the principal point, got {key} = {center:g} alone")
        if abs(center / edge - 0.5) > _CLOSE:
            raise ValueError(f"{what} must have its axis in the center, got {key} = {center:g} of {edge} pixels")
    axes, position = _axes_and_position(what, frame.get("transform_matrix"))
    width = width or (wide if size else 512)
    height = max(round(width * high / wide), 1)
    _, up, back = (_WORLD.T @ axes).T
    eye = _WORLD.T @ position
    target = eye - back * max(float(np.linalg.norm(eye)), 1.0)
    try:
        return Camera(eye, target, up, 2 * math.atan(half * height / width), width, height)
    except ValueError as error:
        raise ValueError(f"{what}: {error}") from error


def _axes_and_position(what: str, rows: Any) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """Unit axes of a camera, in columns, and its position."""
    if (
        not isinstance(rows, list)
        or len(rows) not in (3, 4)
        or not all(isinstance(row, list) and len(row) == 4 and all(map(_is_number, row)) for row in rows)
    ):
        raise ValueError(f"{what} must have a transform_matrix of 4 x 4 finite numbers, got {require.shown(rows)}")
    turn = np.array(rows, np.float64)
    if np.abs(turn[3:] - [0, 0, 0, 1]).max(initial=0) > _LAST_ROW:
        raise ValueError(f"{what} must have a transform_matrix with the last row 0 0 0 1, got {rows[3]}")
    size = np.linalg.norm(turn[:3, :3], axis=0)
    axes = turn[:3, :3] / np.where(size > 0, size, 1)
    if np.abs(axes.T @ axes - np.eye(3)).max() > _ORTHONORMAL or np.linalg.det(axes) < 0:
        raise ValueError(f"{what} must have a transform_matrix that turns and moves, got axes that are not orthogonal")
    if np.ptp(size) > _CLOSE * size.max():
        raise ValueError(
            f"{what} must have a transform_matrix that turns and moves, got axes of lengths {size.tolist()}"
        )
    return axes, turn[:3, 3]


def _is_number(value: object) -> bool:
    return not isinstance(value, bool) and isinstance(value, int | float) and abs(value) <= require.LARGEST


def _number(what: str, fields: JsonObject, key: str) -> float | None:
    number = fields.get(key)
    if number is None:
        return None
    if not _is_number(number):
        raise ValueError(f"{what} must have a finite number as {key}, got {require.shown(number)}")
    return float(number)


def _size(what: str, value: JsonObject) -> tuple[int, int] | None:
    """Width and height of the pictures in pixels; None if the file has none."""
    size = [_number(what, value, key) for key in ("w", "h")]
    for key, number in zip(("w", "h"), size, strict=True):
        if number is not None and (number < 1 or number != int(number)):
            raise ValueError(f"{what} must have a whole number of pixels, at least 1, as {key}, got {number:g}")
    wide, high = size
    if wide is None and high is None:
        return None
    if wide is None or high is None:
        raise ValueError(f"{what} must have both w and h or none, got {'w' if high is None else 'h'} alone")
    return int(wide), int(high)


def _focal_length(what: str, frame: JsonObject, file: JsonObject, size: tuple[int, int] | None) -> float:
    """Focal length in pixels, or in widths of a square picture if its size is not known."""
    level = frame if frame.keys() & _AXIS.keys() else file
    lengths = {}
    for key, axis in _AXIS.items():
        number = _number(what, level, key)
        if number is None:
            continue
        in_pixels = key in ("fl_x", "fl_y")
        if not 1 / require.LARGEST < number < (math.inf if in_pixels else math.pi):
            raise ValueError(f"{what} must have {key} {'above 0' if in_pixels else 'between 0 and pi'}, got {number:g}")
        if in_pixels and size is None:
            raise ValueError(f"{what} must have w and h beside a focal length in pixels, got {key} = {number:g} alone")
        lengths[key] = number if in_pixels else (size or (1, 1))[axis] / 2 / math.tan(number / 2)
    if not lengths:
        raise ValueError(f"{what} must have camera_angle_x between 0 and pi, or fl_x with w and h, got none")
    if max(lengths.values()) > (1 + _CLOSE) * min(lengths.values()):
        got = ", ".join(f"{length:.6g} by {key}" for key, length in lengths.items())
        unit = "pixels, which must be square" if size else "widths of a square picture, as it has no w and h"
        raise ValueError(f"{what} must have one focal length in {unit}, got {got}")
    return next(iter(lengths.values()))


def _check_pinhole(what: str, value: JsonObject) -> None:
    """Refuses lenses that are none of a pinhole, and axes of other conventions."""
    for key, names in _NAMES.items():
        if key in value and (not isinstance(value[key], str) or value[key].upper() not in names):
            raise ValueError(
                f"{what} must be a pinhole camera that looks along -z, with {key} one of {', '.join(sorted(names))}, "
                f"got {require.shown(value[key])}"
            )
    bent = [
        f"{key[:80]} = {require.shown(field)}"
        for key, field in value.items()
        if _BENT.fullmatch(key) and not _is_zero(field)
    ]
    if bent:
        raise ValueError(f"{what} must be a pinhole camera, got {', '.join(bent)}: undistort its pictures")
