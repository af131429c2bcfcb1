"""Reference pictures in direct light: some pixels to measure errors, or a whole picture.

The light of the environment is the sum over all its texels, that of lamps the sum over random places on them.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool, Float, Int
from threadpoolctl import threadpool_limits

from jaxprt import require
from jaxprt.brdf.varying import PerVertex
from jaxprt.compile import Between, finished
from jaxprt.image import Pixels, front, raster, relative_l2, resolve
from jaxprt.image.pixels import nearest_fragments, pixel_angle, sky, visible_points
from jaxprt.relit import exact_lamps
from jaxprt.relit.channels import Shading, exact_at
from jaxprt.scene import Camera, Environment, Mesh, Scene, environment, sides
from jaxprt.scene.points import Points, on_triangles
from jaxprt.scene.scene import centered
from jaxprt.systems import reference
from jaxprt.visibility import Occluder, blocks
from jaxprt.visibility.rays import BLOCK

_SIDE = 4  # number of coverage places along the edge of a pixel
_PER_PIXEL = 64  # points of a picture for each pixel at which its error is estimated
_FEWEST = 64  # such pixels


class ExactPixels(NamedTuple):
    """Reference values of some pixels of a picture in direct light.

    Attributes:
        pixel: Indices of the pixels, row * width + column.
        part: Index of the part at the center of each pixel.
        color: Linear radiance of each pixel under each light.
        weight: Number of pixels of the picture that each one represents.
        error: Estimated relative L2 error of the values under each light, due to the limited number of points. It is
            estimated from the difference between two halves of the points.
    """

    pixel: Int[np.ndarray, " n"]
    part: Int[np.ndarray, " n"]
    color: Float[np.ndarray, "l n c"]
    weight: Float[np.ndarray, " n"]
    error: Float[np.ndarray, " l"]

    def relative_l2(self, picture: Float[ArrayLike, "h w c"], *, light: int = 0) -> tuple[float, float]:
        """Relative L2 error of a picture under one light, and its standard error due to the random choice of pixels."""
        row = np.reshape(picture, (-1, self.color.shape[-1]))[self.pixel]
        right = self.color[light]
        scale = np.sqrt(self.weight)[:, None]
        error = float(relative_l2(scale * row, scale * right))
        if not 0 < error < np.inf:
            return error, 0.0
        off, size = (np.sum(color**2, 1) for color in (row - right, right))
        spread = np.sqrt(np.sum(self.weight * (self.weight - 1) * (off - error**2 * size) ** 2))
        return error, float(spread / np.sum(self.weight * size) / (2 * error))


class ExactPicture(NamedTuple):
    """A whole reference picture in direct light.

    Attributes:
        camera: The requested camera, or the same one with fewer pixels.
        color: Linear radiance of the picture under each light.
        surface: Linear radiance of the surfaces alone: the picture in front of black.
        alpha: Fraction of each pixel that shows surfaces.
        error: Estimated relative L2 error of `color` under each light, over the pixels that show surfaces. It is the
            difference from `exact_pixels` at some of them, which have other points: 16 places of coverage and up to 4
            points for each part, in place of 4 places and one point for each surface. It contains edges of surfaces and
            of shadows within a pixel and the noise of lamps, and the error of those pixels too, so that it is
            rather too large than too small. It does not contain that light is constant over each texel.
    """

    camera: Camera
    color: Float[np.ndarray, "l h w c"]
    surface: Float[np.ndarray, "l h w c"]
    alpha: Float[np.ndarray, "h w"]
    error: Float[np.ndarray, " l"]


def exact_pixels(
    scene: Scene,
    shadings: Sequence[Shading],
    environments: Sequence[Environment],
    camera: Camera,
    *,
    pixels: int | None = None,
    importance: Float[ArrayLike, "h w"] | None = None,
    points: int = 4,
    progress: bool = False,
    between: Between = None,
) -> ExactPixels:
    """Computes reference values of some pixels of a picture. Their only error is due to the number of points per pixel.

    Coverage is found on a grid of 4 x 4 places in each pixel. For each visible part, some of these are chosen at
    random, rays are traced from them, and their radiance is the exact sum over all texels.

    Args:
        scene: The scene.
        shadings: One `Shading` for each part: its mesh, BRDF and channel weights.
        environments: Environments of one size.
        camera: The camera.
        pixels: Number of pixels, chosen at random among those that show the scene; all if None.
        importance: Probability of choosing each pixel, up to a factor. If None, every part gets the same number of
            pixels.
        points: Number of points that are shaded for each pixel and part, chosen at random. One takes some milliseconds.
        progress: Whether to show progress bars.
        between: Function that is called after each stage and after each block of 64 points, by several threads. If it
            raises an exception, the computation stops.
    """
    check(scene, shadings, environments, camera)
    scene, camera = _near(scene, camera)
    mesh, lights = scene.mesh, Environment(jnp.stack([light.radiance for light in environments]))
    fine = dataclasses.replace(camera, width=_SIDE * camera.width, height=_SIDE * camera.height)
    shown = {"hidden": _hidden_faces(scene, mesh), "occluder": None if mesh.opacity is None else Occluder(mesh)}
    fragments = finished(nearest_fragments(mesh, fine, **shown), between)
    columns = fragments.triangle, fragments.barycentric, front(fragments, mesh, fine)
    triangle, barycentric, seen = (_squares(np.asarray(column)) for column in columns)
    region = np.asarray(mesh.region)[np.asarray(mesh.face)[:, 0]]
    owner = np.where(triangle >= 0, region[triangle], -1)
    shown = owner[:, owner.shape[1] // 2 + _SIDE // 2]
    pixel, weight = _choose_pixels(shown, len(scene.parts), pixels, importance)
    triangle, barycentric, seen, owner = triangle[pixel], barycentric[pixel], seen[pixel], owner[pixel]
    way = jnp.asarray(_squares(np.asarray(raster.ray_direction(fine)))[pixel])
    angle = _squares(pixel_angle(fine))[pixel]
    behind = np.stack([environment.sky(light, way, angle=angle) for light in environments])
    mean = np.where((owner < 0)[..., None], behind, 0).mean(2)
    lamps = exact_lamps.Lamps.of(scene, shadings)
    half = np.zeros_like(mean)
    first = 0
    for number, (part, shading) in enumerate(zip(scene.parts, shadings, strict=True)):
        covered = (owner == number) & seen
        row, place = np.nonzero(_choose_places(covered, points))
        face = np.asarray(mesh.face) - first
        first += len(part.mesh.position)
        if not len(row):
            continue
        where = on_triangles(face, triangle[row, place], barycentric[row, place])
        brdf, emitted, where = exact_at(part, shading, where)
        options = {"eye": camera.eye, "occluder": mesh, "progress": progress, "between": between}
        value = _sum(shading.mesh, brdf, lights, where, **options).astype(np.float64)
        value = value + lamps.at_points(shading.mesh, brdf, where, jnp.asarray(camera.eye))
        value = value if emitted is None else value + np.asarray(emitted)
        share = covered.mean(1)[:, None]
        half_of = _halves(row, place)
        both = [share * _mean(value[:, half_of == side], row[half_of == side], len(pixel)) for side in (0, 1)]
        whole = share * _mean(value, row, len(pixel))
        mean = mean + whole
        alone = np.bincount(row, minlength=len(pixel))[:, None] < 2
        half = half + np.where(alone, whole * (covered.sum(1) > 1)[:, None], (both[0] - both[1]) / 2)
    norm, error = (np.sqrt(np.einsum("lnc,n->l", color**2, weight)) for color in (mean, half))
    return ExactPixels(pixel, shown[pixel], mean, weight, error / np.where(norm > 0, norm, 1))


def check(scene: Any, shadings: Sequence[Any], environments: Sequence[Any], camera: Any) -> None:
    """Refuses what is not a scene with a shading for each part, one or more lights of one size, and a camera."""
    require.kind("the scene", scene, Scene, source="jaxprt.load_scene")
    require.kind("the camera", camera, Camera, source="jaxprt.Camera")
    if len(shadings) != len(scene.parts):
        raise ValueError(f"there must be a shading for each of {len(scene.parts)} parts, got {len(shadings)}")
    for light in environments:
        require.kind("a light", light, Environment, source="jaxprt.scene.load_environment")
    sizes = {light.radiance.shape for light in environments}
    if len(sizes) != 1:
        raise ValueError(f"there must be one or more lights of one size, got {sorted(sizes) or 'none'}")


def exact_picture(
    scene: Scene,
    shadings: Sequence[Shading],
    environments: Sequence[Environment],
    camera: Camera,
    *,
    most: int = 1 << 14,
    progress: bool = False,
    between: Between = None,
) -> ExactPicture:
    """Computes a whole reference picture: the exact sum over all texels, with rays traced from each shading point.

    Every surface that a pixel shows has one point, at the mean of those of 4 samples that see it. If there are more
    than `most` points, the width and height of the picture are divided by 2, 3 or more.

    Args:
        scene: The scene.
        shadings: One `Shading` for each part: its mesh, BRDF and channel weights.
        environments: Environments of one size.
        camera: The camera.
        most: Largest number of points, at least 1. A Lambertian one counts as a half, because it takes less than half
            of the time, which is nearly all for rays. The estimate of the error has about a sixteenth as many more.
        progress: Whether to show progress bars.
        between: Function that is called between steps of the work, as in `exact_pixels`.

    Raises:
        TypeError: An argument is of another kind.
        ValueError: `most` is below 1, there is no light, lights have different sizes, or a part has no shading.
    """
    check(scene, shadings, environments, camera)
    require.number("most", most, 1.0)
    whole, asked = scene, camera
    scene, camera = _near(scene, camera)
    shown = finished(_PicturePoints.of(scene, camera), between)
    cost = np.array([0.5 if shading.matte else 1.0 for shading in shadings] + [0.0])  # the last one of padding
    if (count := cost[shown.owner].sum()) > most:
        step = math.ceil(math.sqrt(count / most))
        size = {"width": max(camera.width // step, 1), "height": max(camera.height // step, 1)}
        camera, asked = (dataclasses.replace(view, **size) for view in (camera, asked))
        shown = _PicturePoints.of(scene, camera)
    lights = Environment(jnp.stack([light.radiance for light in environments]))
    lamps = exact_lamps.Lamps.of(scene, shadings)
    # Surfaces and lamps may have colors where the light is gray.
    color, colors = np.zeros((len(environments), len(shown.owner), 3), np.float32), lights.radiance.shape[-1]
    options = {"progress": progress, "between": between}
    for number, (part, shading) in enumerate(zip(scene.parts, shadings, strict=True)):
        index = np.flatnonzero(shown.owner == number)
        if not len(index):
            continue
        brdf, emitted, points = exact_at(part, shading, shown.points(index, number))
        value = _sum(shading.mesh, brdf, lights, points, eye=camera.eye, occluder=scene.mesh, **options)
        value = value + lamps.at_points(shading.mesh, brdf, points, jnp.asarray(camera.eye))
        value = value if emitted is None else value + emitted
        color[:, index], colors = value, max(colors, value.shape[-1])
    color = color[..., :colors]
    behind = [jnp.broadcast_to(sky(light, camera), (camera.height, camera.width, colors)) for light in environments]
    pictures = [resolve(shown.pixels, a, background=b) for a, b in zip(color, behind, strict=True)]
    surfaces, empty = [resolve(shown.pixels, light) for light in color], np.asarray(shown.pixels.background)
    alpha = 1 - (empty if empty.ndim == 2 else empty.mean(-1))
    few = max(_FEWEST, int(np.sum(shown.owner >= 0)) // _PER_PIXEL)
    if not alpha.any():
        return ExactPicture(asked, np.stack(pictures), np.stack(surfaces), alpha, np.zeros(len(pictures)))
    others = exact_pixels(whole, shadings, environments, asked, pixels=few, importance=importance(pictures), **options)
    error = [others.relative_l2(picture, light=light)[0] for light, picture in enumerate(pictures)]
    return ExactPicture(asked, np.stack(pictures), np.stack(surfaces), alpha, np.array(error))


def importance(pictures: Iterable[ArrayLike]) -> Float[np.ndarray, "h w"]:
    """Sampling density of pixels: larger where pictures are bright, and larger still where they vary."""
    total: Any = 0
    for picture in pictures:
        gray = np.asarray(picture, np.float64).mean(-1)
        around = np.stack([np.roll(gray, step, (0, 1)) for step in itertools.product((-1, 0, 1), repeat=2)])
        total = total + (around.var(0) + 0.01 * gray**2) / max(np.mean(gray**2), 1e-30)
    return np.sqrt(total) + 0.02


def _hidden_faces(scene: Scene, mesh: Mesh) -> Bool[np.ndarray, " f"]:
    """Triangles of the mesh of all parts that cameras do not see from behind."""
    return sides.hidden_backs(scene)[np.asarray(mesh.region)[np.asarray(mesh.face)[:, 0]]]


def _near(scene: Scene, camera: Camera) -> tuple[Scene, Camera]:
    """The scene and the camera relative to the scene's origin."""
    return centered(scene), camera.local(scene.parts[0].mesh.origin)


def _sum(
    mesh: Mesh, brdf: Callable, lights: Environment, points: Points, *, progress: bool, **options: Any
) -> np.ndarray:
    """`reference.radiance` at points, on all cores."""

    def radiance(number: int, index: np.ndarray) -> np.ndarray:
        some = jax.tree.map(lambda column: jnp.asarray(np.asarray(column)[..., index]), points)
        model = PerVertex(brdf.of(jnp.asarray(index))) if isinstance(brdf, PerVertex) else brdf
        shown = progress and number == 0
        return np.asarray(reference.radiance(mesh, model, lights, points=some, progress=shown, **options))

    count = len(points)
    cores = min(blocks.cores(), max(count // BLOCK, 1))
    length = BLOCK * -(-count // (BLOCK * cores))  # whole blocks: fewer programs for the same rays
    parts = np.resize(np.arange(count), (cores, length))
    # The threads of NumPy's matrix products would busy-wait.
    with threadpool_limits(limits=1, user_api="blas"), ThreadPoolExecutor(len(parts)) as pool:
        return np.concatenate(list(pool.map(radiance, range(len(parts)), parts)), 1)[:, :count]


class _PicturePoints(NamedTuple):
    """What a picture shows: its points, the part of each, and the triangles of the mesh of all parts."""

    pixels: Pixels
    owner: Int[np.ndarray, " p"]  # index of the part of each point; -1 in padding
    face: Int[np.ndarray, "f 3"]
    first: Int[np.ndarray, " n"]  # index of the first vertex of each part

    @classmethod
    def of(cls, scene: Scene, camera: Camera) -> "_PicturePoints":
        mesh = scene.mesh
        occluder = None if mesh.opacity is None else Occluder(mesh)
        pixels = visible_points(mesh, camera, samples=4, hidden=_hidden_faces(scene, mesh), occluder=occluder)
        region, face, triangle = (np.asarray(column) for column in (mesh.region, mesh.face, pixels.triangle))
        owner = np.where(triangle >= 0, region[face[triangle, 0]], -1)
        return cls(pixels, owner, face, np.cumsum([0, *scene.counts])[:-1])

    def points(self, index: Int[np.ndarray, " m"], part: int) -> Points:
        """The points of some indices, all of one part."""
        corner = self.face[np.asarray(self.pixels.triangle)[index]] - self.first[part]
        weight, slope = (np.asarray(column)[index] for column in (self.pixels.barycentric, self.pixels.slope))
        return Points(jnp.asarray(corner.T), jnp.asarray(weight.T), jnp.asarray(np.moveaxis(slope, 0, -1)))


def _choose_places(covered: np.ndarray, count: int) -> np.ndarray:
    """Chooses at most `count` covered places in each row at random, spread over the quarters of the pixel."""
    random = np.random.default_rng(1)
    half = _SIDE // 2
    turn = random.random((len(covered), 2, 2, half * half)).argsort(-1).reshape(len(covered), 2, 2, half, half)
    order = turn.swapaxes(2, 3).reshape(covered.shape) + random.random(covered.shape)
    order = np.where(covered, order, np.inf)
    least = np.sort(order, 1)[:, min(count, covered.shape[1]) - 1]
    return covered & (order <= least[:, None])


def _halves(row: Int[np.ndarray, " m"], place: Int[np.ndarray, " m"]) -> Int[np.ndarray, " m"]:
    """Divides the points of each row into two halves, along the diagonals of the pixel."""
    half = _SIDE // 2
    # Both halves have the same mean place: a linear change of radiance across the pixel is not taken for an error.
    side = (place // _SIDE // half + place % _SIDE // half) % 2
    apart = np.bincount(row, side) * np.bincount(row, 1 - side) > 0
    return np.where(apart[row], side, (np.arange(len(row)) - np.searchsorted(row, row)) % 2)


def _mean(value: Float[np.ndarray, "l m c"], row: np.ndarray, rows: int) -> Float[np.ndarray, "l n c"]:
    """Mean of the values of each row; zero for a row without values."""
    total = np.zeros((rows, value.shape[0], value.shape[2]))
    np.add.at(total, row, value.swapaxes(0, 1))
    return total.swapaxes(0, 1) / np.maximum(np.bincount(row, minlength=rows), 1)[:, None]


def _squares(fine: np.ndarray) -> np.ndarray:
    """Groups the values of a fine picture [h w *c] by coarse pixels: [pixel, place, *c]."""
    rows, columns = fine.shape[0] // _SIDE, fine.shape[1] // _SIDE
    squares = fine.reshape(rows, _SIDE, columns, _SIDE, *fine.shape[2:]).swapaxes(1, 2)
    return squares.reshape(rows * columns, _SIDE**2, *fine.shape[2:])


def _choose_pixels(
    shown: Int[np.ndarray, " p"], parts: int, count: int | None, importance: ArrayLike | None
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """The chosen pixels among those that show parts, and the number of pixels that each represents."""
    visible = np.flatnonzero(shown >= 0)
    if count is None or count >= len(visible):
        return visible, np.ones(len(visible))
    random = np.random.default_rng(0)
    if importance is None:
        of_part = [random.permutation(np.flatnonzero(shown == part))[: -(-count // parts)] for part in range(parts)]
        pixel = np.sort(np.concatenate(of_part))
        share = np.bincount(shown[visible], minlength=parts) / np.maximum(np.bincount(shown[pixel], minlength=parts), 1)
        return pixel, share[shown[pixel]]
    chance = np.ravel(importance).astype(np.float64)[visible]
    chance = chance * count / chance.sum()
    while np.any(chance > 1):
        sure = chance >= 1
        chance = np.where(sure, 1, chance * (count - sure.sum()) / chance[~sure].sum())
    chosen = random.random(len(visible)) < chance
    return visible[chosen], 1 / chance[chosen]
