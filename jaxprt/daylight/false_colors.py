"""Pictures of what sensors receive, in false colors over the model, with a legend."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from jaxprt.files import captions
from jaxprt.image.pixels import render
from jaxprt.scene import Camera, Scene
from jaxprt.scene.camera import orbit
from jaxprt.scene.mesh import Mesh, join, make_mesh

# Anchors of a scale from dark blue over green to yellow, whose luminance rises evenly; display values.
_SCALE = np.array([[0.27, 0.0, 0.33], [0.23, 0.32, 0.55], [0.13, 0.57, 0.55], [0.37, 0.79, 0.38], [0.99, 0.91, 0.14]])
_LEGEND, _STEPS = 28, 5  # rows of each of its two lines, and numbers on it
_TILE = 0.46  # edge of a tile, in distances to the nearest sensor, from the middle


def scale(share: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """Display colors of shares from 0 to 1."""
    place = np.linspace(0, 1, len(_SCALE))
    return np.stack([np.interp(share, place, column) for column in _SCALE.T], -1)


def picture(
    scene: Scene,
    position: Float[np.ndarray, "p 3"],
    normal: Float[np.ndarray, "p 3"],
    value: Float[np.ndarray, " p"],
    *,
    title: str = "",
    camera: Camera | None = None,
) -> Float[np.ndarray, "_ w 3"]:
    """The scene in gray with a tile for each sensor, and a legend below, without walls that would hide the sensors.

    Args:
        scene: The scene.
        position: Positions of the sensors.
        normal: Directions that they face.
        value: What the tiles show; the legend goes from 0 to the largest.
        title: Name of the quantity with its unit, on the legend.
        camera: The camera; one from the south-east above if None.

    Returns:
        A picture in display values.
    """
    mesh, zero = scene.mesh, np.mean(position, 0)
    position = position - zero  # near zero, where single precision has triangles
    square = _squares(position, normal)
    if camera is None:
        around = make_mesh(np.concatenate([_places(mesh) - zero, square.reshape(-1, 3)]), _both(mesh, len(position)))
        camera = orbit(around, azimuth=0.5, elevation=0.9, width=640, height=480)
    else:
        camera = camera.local((float(zero[0]), float(zero[1]), float(zero[2])))
    most = float(np.max(value)) or 1.0
    place, eye = _places(mesh) - zero, np.asarray(camera.eye, np.float64)
    face = np.asarray(mesh.face)
    a, b, c = (place[face[:, corner]] for corner in range(3))
    across = np.cross(b - a, c - a)
    toward, inward = (np.sum(across * (goal - a), 1) for goal in (eye, np.zeros(3)))
    shown = toward * inward >= 0
    face = np.where((toward < 0)[:, None], face[:, ::-1], face)[shown]
    lean = np.abs(across[shown, 1]) / np.maximum(np.linalg.norm(across[shown], axis=1), 1e-30)
    flat, gray = place[face].reshape(-1, 3), np.repeat(0.35 + 0.35 * lean, 3)[:, None].repeat(3, 1)
    away = np.sum(normal * (eye - position), 1) < 0
    tile = np.where(away[:, None, None], square[:, ::-1], square).reshape(-1, 3)
    color = scale(np.asarray(value) / most).repeat(4, 0) ** 2.2
    parts = [make_mesh(tile, _pairs(len(position)))]
    colors = [color]
    if len(face):
        parts.append(make_mesh(flat, np.arange(len(flat)).reshape(-1, 3)))
        colors.append(gray)
    whole = join(parts)
    seen = render(whole, jnp.asarray(np.concatenate(colors), jnp.float32), camera.local(whole.origin))
    image = np.clip(np.asarray(seen), 0, 1) ** (1 / 2.2)
    empty = np.all(image == 0, -1, keepdims=True)
    return np.concatenate([np.where(empty, 1, image), _legend(title, most, camera.width)])


def _places(mesh: Mesh) -> Float[np.ndarray, "v 3"]:
    """Positions of vertices in the coordinates of the file."""
    return np.asarray(mesh.position, np.float64) + np.asarray(mesh.origin)


def _pairs(count: int) -> Int[np.ndarray, "t 3"]:
    """The triangles of some squares."""
    first = 4 * np.arange(count)[:, None]
    return np.concatenate([first + [0, 1, 2], first + [0, 2, 3]])


def _both(mesh: Mesh, count: int) -> Int[np.ndarray, "t 3"]:
    """The triangles of a mesh and of some squares after it."""
    return np.concatenate([np.asarray(mesh.face, np.int64), _pairs(count) + len(mesh.position)])


def _squares(position: np.ndarray, normal: np.ndarray) -> Float[np.ndarray, "p 4 3"]:
    """Corners of a square around each sensor, counterclockwise as seen from where it faces."""
    distance = cKDTree(position).query(position, k=2)[0][:, 1] if len(position) > 1 else np.ones(1)
    half = _TILE * np.median(distance)
    side = np.where(np.abs(normal[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]])
    tangent = side - np.sum(side * normal, 1, keepdims=True) * normal
    tangent = half * tangent / np.linalg.norm(tangent, axis=1, keepdims=True)
    bitangent = np.cross(normal, tangent)
    ring = (-tangent - bitangent, tangent - bitangent, tangent + bitangent, bitangent - tangent)
    return position[:, None] + np.stack(ring, 1)


def _legend(title: str, most: float, width: int) -> Float[np.ndarray, "h w 3"]:
    """A bar of the scale with its numbers, and the title."""
    bar = np.broadcast_to(scale(np.linspace(0, 1, width)), (_LEGEND // 2, width, 3))
    edges = np.linspace(0, width, _STEPS + 1).astype(int)
    numbers = most * (np.arange(_STEPS) + 0.5) / _STEPS
    cells = [
        captions.line(f"{number:.3g}", width=int(right - left), height=_LEGEND)
        for number, left, right in zip(numbers, edges[:-1], edges[1:], strict=True)
    ]
    return np.concatenate([bar, np.concatenate(cells, 1), captions.line(title, width=width, height=_LEGEND)])
