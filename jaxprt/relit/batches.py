"""Pictures of a scene under many lights, seen by many cameras."""

import itertools
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxprt import require
from jaxprt.relit import groups
from jaxprt.relit.groups import Arriving, Stage
from jaxprt.relit.pictures import PictureView
from jaxprt.relit.surface import under_lights
from jaxprt.scene import Camera, Environment
from jaxprt.scene.environment import resized
from jaxprt.systems.bounces import GroupBounces

_HELD = 3  # arrays of the size of a picture that are held for each picture while it is made
_BYTES = 16  # of a pixel of four channels
_REMEMBERED = 64  # most lights whose arriving light is held for all views


class PictureBlock(NamedTuple):
    """Pictures of one view under some lights.

    Attributes:
        view: Index of the camera.
        lights: Indices of the lights.
        pictures: What `RelitScene.picture` returns, as arrays in NumPy with a leading axis for the lights.
    """

    view: int
    lights: Int[np.ndarray, " m"]
    pictures: Any


def check(environments: Any, cameras: Any) -> None:
    """Refuses values that are not lists of lights and cameras.

    Raises:
        TypeError: An argument is not a list, or holds something else.
        ValueError: A list is empty.
    """
    pairs = (
        ("environments", environments, Environment, "jaxprt.load_environment"),
        ("cameras", cameras, Camera, "jaxprt.scene.camera.orbit"),
    )
    for name, values, kind, source in pairs:
        if isinstance(values, str | kind) or not isinstance(values, Sequence):
            raise TypeError(f"{name} must be a list, got {require.shown(values)}")
        if not values:
            raise ValueError(f"{name} must be at least one, got none")
        for number, value in enumerate(values):
            require.kind(f"{name}[{number}]", value, kind, source=source)


def check_array(environments: Any, cameras: Any, layers: Sequence[str] | None) -> None:
    """Refuses lights and cameras whose pictures are not one array, or do not fit into memory."""
    check(environments, cameras)
    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    if len(sizes) > 1:
        got = ", ".join(f"{width} x {height}" for width, height in sizes)
        raise ValueError(f"cameras must have one size for one array, got {got}: use picture_blocks")
    lights, views = len(environments), len(cameras)
    size = lights * views * nbytes(cameras[0], layers)
    require.memory(f"{lights} x {views} pictures", size, "take picture_blocks instead")


def of_one_size(environments: Sequence[Environment], size: int | None) -> list[Environment]:
    """The lights with faces of the size that a scene was precomputed for; the first light's if it takes any.

    Warns of the lights that are resampled.
    """
    size = environments[0].radiance.shape[-2] if size is None else size
    others = [number for number, light in enumerate(environments) if light.radiance.shape[-2] != size]
    if others:
        sizes = sorted({environments[number].radiance.shape[-2] for number in others})
        warnings.warn(
            f"{len(others)} of {len(environments)} lights have faces of {', '.join(map(str, sizes))} texels along an "
            f"edge, and are resampled to the scene's {size}",
            stacklevel=4,
        )
    return [resized(light, size=size) for light in environments]


def blocks(
    view_of: Callable[[Camera], PictureView],
    environments: Sequence[Environment],
    cameras: Sequence[Camera],
    *,
    memory: int,
    background: str | Environment | None,
    layers: Sequence[str] | None,
) -> Iterator[PictureBlock]:
    """Pictures block by block: all lights of a view, as far as they fit into memory, then the next view.

    Args:
        view_of: Function from a camera to the picture without its light. The next view is made while one is lit.
        environments: The lights.
        cameras: The cameras.
        memory: Bytes that the pictures of a block may take.
        background: As for `RelitScene.picture`.
        layers: As for `RelitScene.picture`.
    """
    remembered: dict[tuple[int, bool], Arriving] = {}

    with ThreadPoolExecutor(1, thread_name_prefix="jaxprt-views") as pool:
        following: Future[PictureView] = pool.submit(view_of, cameras[0])
        for number, camera in enumerate(cameras):
            view = following.result()
            if number + 1 < len(cameras):
                following = pool.submit(view_of, cameras[number + 1])
            count = lights_at_once(camera, memory=memory, layers=layers)
            keeps = len(environments) <= min(count, _REMEMBERED)
            for first in range(0, len(environments), count):
                lit = view.remembering(remembered if keeps else {})
                chosen = environments[first : first + count]
                pictures = lit.pictures(chosen, background=background, layers=layers)
                lights = np.arange(first, first + len(chosen))
                yield PictureBlock(number, lights, jax.tree.map(lambda *images: np.stack(images), *pictures))


def lights_at_once(camera: Camera, *, memory: int, layers: Sequence[str] | None) -> int:
    """Number of lights whose pictures fit into memory; 1 at least."""
    return max(1, memory // (_HELD * nbytes(camera, layers)))


def nbytes(camera: Camera, layers: Sequence[str] | None) -> int:
    """Bytes of a picture with its layers, at most."""
    return _BYTES * camera.width * camera.height * (1 if layers is None else len(layers))


def stacked(pictures: Iterator[PictureBlock], lights: int, views: int) -> Any:
    """All pictures in one array for each layer, [lights, views, h, w, c]."""
    first = next(pictures)
    result = jax.tree.map(lambda image: np.zeros((lights, views, *image.shape[1:]), image.dtype), first.pictures)
    for block in itertools.chain([first], pictures):
        for whole, part in zip(jax.tree.leaves(result), jax.tree.leaves(block.pictures), strict=True):
            whole[block.lights, block.view] = part
    return result


def radiance(
    stage: Stage,
    bounces: GroupBounces | None,
    lights: Float[Array, "l 6 n n c"],
    view: Any,
    order: Int[Array | np.ndarray, " v"],
) -> Float[Array, "l v c"]:
    """Radiance of the vertices of a scene, or of points on it, under several lights.

    Args:
        stage: The scene and its materials.
        bounces: The system of reflected light; None without bounces.
        lights: Radiance of the environments.
        view: The view of the scene, without traced reflections.
        order: Index of each vertex or point among those of all groups.
    """
    reflected: Sequence[Any] = (None,) * len(stage.surfaces)
    if bounces is not None:

        def arriving(radiance: Float[Array, "6 n n c"]) -> tuple[Array, ...]:
            return bounces.shade(bounces.light(Environment(radiance)), stage.blends, stage.radiance)

        reflected = jax.vmap(arriving)(lights)
    tilts, result = stage.table.frame is not None, []
    direct = groups.projected(stage.surfaces, lights)
    parts = zip(stage.surfaces, direct, reflected, stage.blends, view.group, strict=True)
    for group, (surface, *rows, blend, viewed) in enumerate(parts):
        surface = groups.sampled(surface, max(stage.layout.of_group(group, view.stage.samples)))
        result.append(under_lights(surface, tuple(rows), stage.radiance, blend, viewed, tilts=tilts))
    return jax.vmap(groups.ordered, (0, None))(tuple(result), jnp.asarray(order))
