"""Cameras in the files `transforms.json` of NeRF (Mildenhall et al. 2020) and of Blender's exporters.

A frame has a matrix from the camera to the world. The camera looks along -z, +x is to the right and +y up in its
picture, as in OpenGL and Blender. The world's +z is up, as in Blender: the point (x, y, z) of jaxprt is (x, -z, y)
there, which is also where Blender puts it when it imports glTF. Angles are in radians; `camera_angle_x` is the full
horizontal one.
"""

import math
import os
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxprt import require
from jaxprt.files import inputs
from jaxprt.scene.camera import Camera

_WORLD = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # from jaxprt's axes to those of the files
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_CLOSE = 1e-3  # relative difference of focal lengths, and distance of the principal point from the center
_ORTHONORMAL = 1e-3


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


def content(cameras: Sequence[Camera], frames: Sequence[dict[str, Any]], index: Sequence[int]) -> dict[str, Any]:
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

    Args:
        path: The file.
        width: Width of pictures in pixels, with the proportions of the file; that of the file if None, or 512.

    Raises:
        ValueError: The file has no frames, a frame has no matrix of a camera, or its lens is none of a pinhole camera
            with its axis through the center of the picture.
        OSError: The file cannot be read.
    """
    name = pathlib.Path(path).name
    file = inputs.json_object(pathlib.Path(path), "a file of cameras")
    frames = file.get("frames")
    if not isinstance(frames, list) or not frames:
        raise ValueError(f"{name} must have a list of frames, got {require.shown(frames)}")
    return [_camera(f"{name}, frame {number}", file, frame, width) for number, frame in enumerate(frames)]


def _camera(what: str, file: dict[str, Any], frame: Any, width: int | None) -> Camera:
    if not isinstance(frame, dict):
        raise ValueError(f"{what} must be an object with a transform_matrix, got {require.shown(frame)}")
    value = file | frame
    try:
        turn = np.asarray(value.get("transform_matrix"), np.float64)
    except (TypeError, ValueError):
        turn = np.zeros(0)
    if turn.shape not in ((4, 4), (3, 4)) or not np.isfinite(turn).all():
        raise ValueError(f"{what} must have a transform_matrix of 4 x 4 finite numbers, got {list(turn.shape)}")
    size = np.linalg.norm(turn[:3, :3], axis=0)
    axes = turn[:3, :3] / np.where(size > 0, size, 1)
    if np.abs(axes.T @ axes - np.eye(3)).max() > _ORTHONORMAL or np.linalg.det(axes) < 0:
        raise ValueError(f"{what} must have a transform_matrix that turns and moves, got axes that are not orthogonal")
    shape = [_number(what, value, key) for key in ("w", "h")]
    ratio = shape[1] / shape[0] if shape[0] and shape[1] else 1.0
    wide = width or int(shape[0] or 512)
    high = max(round(wide * ratio), 1)
    angle = _vertical_angle(what, value, shape, wide, high)
    _check_lens(what, value, shape)
    _, up, back = (_WORLD.T @ axes).T
    eye = _WORLD.T @ turn[:3, 3]
    return Camera(eye, eye - back * max(float(np.linalg.norm(eye)), 1.0), up, angle, wide, high)


def _number(what: str, value: dict[str, Any], key: str) -> float | None:
    number = value.get(key)
    if number is None:
        return None
    if isinstance(number, bool) or not isinstance(number, int | float) or not math.isfinite(number):
        raise ValueError(f"{what} must have a finite number as {key}, got {require.shown(number)}")
    return float(number)


def _vertical_angle(what: str, value: dict[str, Any], shape: Sequence[float | None], width: int, height: int) -> float:
    """The vertical angle of view of pictures of a size."""
    across, focal, up = (_number(what, value, key) for key in ("camera_angle_x", "fl_x", "fl_y"))
    if across is None and focal is not None and shape[0] is not None:
        across = 2 * math.atan(shape[0] / (2 * focal)) if focal > 0 else None
    if across is None or not 0 < across < math.pi:
        raise ValueError(f"{what} must have camera_angle_x between 0 and pi, or fl_x with w, got {across}")
    if focal is not None and up is not None and abs(up / focal - 1) > _CLOSE:
        raise ValueError(f"{what} must have square pixels, got focal lengths {focal} and {up}")
    return 2 * math.atan(math.tan(across / 2) * height / width)


def _check_lens(what: str, value: dict[str, Any], shape: Sequence[float | None]) -> None:
    """Refuses distortion and principal points beside the center."""
    bent = {key: number for key in _DISTORTION if (number := _number(what, value, key))}
    if bent:
        raise ValueError(f"{what} must be a pinhole camera, got the distortion {bent}: undistort its pictures")
    for key, edge in zip(("cx", "cy"), shape, strict=True):
        center = _number(what, value, key)
        if center is not None and edge and abs(center / edge - 0.5) > _CLOSE:
            raise ValueError(f"{what} must have its axis in the center, got {key} = {center} of {edge} pixels")
