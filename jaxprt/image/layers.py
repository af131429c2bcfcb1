"""What samples see of scenes with backs that are hidden, holes, and translucent surfaces.

Opaque surfaces are rasterized. Rays through the samples collect the surfaces with an opacity in front of them. Each
sample then sees a list of surfaces, from front to back, of which each hides the share `opacity` of the next ones. Glass
colors what it lets through, and is itself seen whole.
"""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxprt.compile import Between, finished, known
from jaxprt.image import pixels, raster
from jaxprt.image.pixels import Pixels
from jaxprt.image.raster import SAMPLES, Fragments
from jaxprt.scene.camera import Camera
from jaxprt.scene.mesh import Mesh
from jaxprt.visibility import Occluder

_RAYS = 1 << 16  # rays whose lists are held at once


def visible_points(
    mesh: Mesh,
    camera: Camera,
    *,
    samples: int,
    hidden: Bool[np.ndarray, " f"] | None = None,
    occluder: Occluder | None = None,
    uneven: Bool[Array, " f"] | None = None,
    between: Between = None,
) -> Pixels:
    """The shading points of a picture, and how much each adds to its pixel.

    A point on a translucent surface covers the share of its samples that it hides; what lies behind it covers the rest.
    Of more than eight translucent surfaces in front of an opaque one, those behind the eighth are left out.

    Args:
        mesh: The mesh, whose opacity is ignored.
        camera: The camera, in the coordinates of the mesh.
        samples: Samples of each pixel, 1 or 4.
        hidden: Triangles that cameras do not see from behind, without padding of the mesh; none if None.
        occluder: The same triangles with their opacity; None if all of them are opaque.
        uneven: Triangles of which each sample becomes a point; see `pixels.shading_points`.
        between: Function that is called between steps of the work.

    Raises:
        ValueError: The camera is traced by JAX, and there are surfaces with an opacity.
    """
    if occluder is None or occluder.opacity is None:
        shown = seen_from_front(mesh, camera, hidden)
        fragments = finished(raster.rasterize(shown, camera, samples=samples), between)
        return finished(pixels.shading_points(fragments, mesh, camera, uneven=uneven), between)
    slots = _slots(mesh, camera, samples, hidden, occluder)
    result = []
    for triangle, depth, share in slots:
        triangle, depth = (each[..., 0] if samples == 1 else each for each in (triangle, depth))
        fragments = Fragments(jnp.asarray(triangle), None, jnp.asarray(depth))
        found = pixels.shading_points(fragments, mesh, camera, uneven=uneven, share=jnp.asarray(share))
        result.append(finished(found, between))
    return _joined(result)


def coverage(
    mesh: Mesh, camera: Camera, *, samples: int, hidden: Bool[np.ndarray, " f"] | None, occluder: Occluder | None
) -> Float[Array, "h w"]:
    """Share of each pixel that surfaces hide of the background; `visible_points` has the arguments and errors."""
    if occluder is None or occluder.opacity is None:
        fragments = raster.rasterize(seen_from_front(mesh, camera, hidden), camera, samples=samples)
        seen = jnp.asarray(fragments.triangle >= 0, jnp.result_type(float))
        return seen if seen.ndim == 2 else jnp.mean(seen, -1)
    slots = _slots(mesh, camera, samples, hidden, occluder)
    empty = sum(np.mean(np.where(triangle < 0, _gray(share), 0), -1) for triangle, _, share in slots)
    return jnp.asarray(1 - empty, jnp.result_type(float))


def nearest_fragments(
    mesh: Mesh,
    camera: Camera,
    *,
    hidden: Bool[np.ndarray, " f"] | None = None,
    occluder: Occluder | None = None,
) -> Fragments:
    """What each pixel's center sees. A translucent surface is seen with the probability of its opacity.

    The choice is random and the same in every run. Means over pixels are those of translucent surfaces.
    The arguments are those of `visible_points`.
    """
    if occluder is None or occluder.opacity is None:
        return raster.rasterize(seen_from_front(mesh, camera, hidden), camera)
    slots = _slots(mesh, camera, 1, hidden, occluder)
    random = np.random.default_rng(0).random(slots[0][0].shape)
    triangle, depth, total = np.full(random.shape, -1, np.int32), np.full(random.shape, np.inf, np.float32), 0.0
    for one, where, share in slots:
        share = _gray(share)
        chosen = (random >= total) & (random < total + share)
        triangle, depth, total = np.where(chosen, one, triangle), np.where(chosen, where, depth), total + share
    triangle, depth = jnp.asarray(triangle[..., 0]), jnp.asarray(depth[..., 0])
    return Fragments(triangle, raster.barycentric(triangle, mesh, camera), depth)


def seen_from_front(mesh: Mesh, camera: Camera, hidden: Any) -> Mesh:
    """The mesh without the triangles that the camera sees from behind and that are hidden there, `hidden`."""
    if hidden is None or (known(hidden) and not np.any(hidden)):
        return mesh
    away = _hidden_now(mesh, camera, hidden)
    xp = np if known(away, mesh.face) else jnp
    return dataclasses.replace(mesh, face=xp.where(away[:, None], 0, xp.asarray(mesh.face)))


def _hidden_now(mesh: Mesh, camera: Camera, hidden: Any) -> Any:
    """Triangles of which the camera sees a back that is hidden. Padding of the mesh is not."""
    front = raster.front_faces(mesh, camera)
    xp = np if known(front, hidden) else jnp
    return xp.pad(hidden, (0, len(mesh.face) - len(hidden))) & ~xp.asarray(front)


def _slots(
    mesh: Mesh, camera: Camera, samples: int, hidden: Any, occluder: Occluder
) -> list[tuple[Int[np.ndarray, "h w s"], Float[np.ndarray, "h w s"], Float[np.ndarray, "h w s *c"]]]:
    """The surfaces that samples see, from front to back: triangles, depths, and the share that each sample sees.

    Shares are those of each color if there is colored glass. Where a sample has no more surfaces, the triangle is -1
    and the share that of the background.
    """
    if not known(camera, mesh):
        raise ValueError(
            "pictures of surfaces with holes or translucent ones need concrete values, but the camera or the scene is "
            "traced by JAX: make the picture outside of jax.jit, or close the jitted function over them"
        )
    assert occluder.opacity is not None
    count = len(occluder.face)
    clear = np.zeros(len(mesh.face), bool)
    layer = np.asarray(occluder.opacity.layer)[occluder.face[:, 0]]
    clear[:count] = layer > 0
    passing, glass = np.asarray(occluder.opacity.passing), np.asarray(occluder.opacity.glass)
    passing = passing[layer, : 1 if np.all(passing == 1) else 3]
    away = np.zeros(len(mesh.face), bool) if hidden is None else _hidden_now(mesh, camera, hidden)
    opaque = dataclasses.replace(mesh, face=np.where((clear | away)[:, None], 0, np.asarray(mesh.face)))
    base = raster.rasterize(opaque, camera, samples=samples)
    behind = [np.asarray(each).reshape(-1) for each in (base.triangle, base.depth)]
    shape = (camera.height, camera.width, samples)
    chunks = []
    for first in range(0, len(behind[0]), _RAYS):
        own = slice(first, first + _RAYS)
        direction = _directions(camera, samples, np.arange(len(behind[0]))[own])
        far = np.minimum(behind[1][own], 1e30).astype(np.float32)
        eye = np.asarray(camera.eye, np.float32)
        number, face, place, alpha = occluder.translucent.layers(eye, direction, far, away[:count])
        pair = np.where(glass[layer[face]], 1, alpha), (1 - alpha)[..., None] * passing[face]
        chunks.append(_chunk(number, face, place, *pair, behind[0][own], behind[1][own]))
    most = max(len(chunk[0]) for chunk in chunks)
    nothing = -1, np.inf, 0
    columns = []
    for value, rows in zip(nothing, zip(*chunks, strict=True), strict=True):
        wide = [((0, most - len(row)), *((0, 0),) * (row.ndim - 1)) for row in rows]
        filled = [np.pad(row, width, constant_values=value) for row, width in zip(rows, wide, strict=True)]
        columns.append(np.concatenate(filled, 1).reshape(most, *shape, *filled[0].shape[2:]))
    return list(zip(*columns, strict=True))


def _gray(share: Float[np.ndarray, "h w s *c"]) -> Float[np.ndarray, "h w s"]:
    """Shares without their colors."""
    return share if share.ndim == 3 else share.mean(-1)


def _chunk(count, face, place, cover, through, triangle, depth) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Triangles, depths and shares [k, n, c] of the surfaces on some rays, with those behind all layers.

    Args:
        count: Number of translucent layers on each ray.
        face: Triangle of each layer.
        place: Distance of each layer along the view axis.
        cover: Share of a view of each layer that shows the layer itself.
        through: Share that shows what is behind the layer, for each color.
        triangle: The opaque triangle behind the layers of each ray; -1 for none.
        depth: Distance of that triangle along the view axis.
    """
    listed = np.arange(face.shape[1]) < count[:, None]
    left = np.cumprod(np.where(listed[..., None], through, 1), 1)
    before = np.concatenate([np.ones_like(left[:, :1]), left[:, :-1]], 1)
    rows, ends = np.arange(len(count)), count.copy()
    width = face.shape[1] + 1
    triangles, depths = np.full((len(count), width), -1, np.int32), np.full((len(count), width), np.inf, np.float32)
    shares = np.zeros((len(count), width, left.shape[2]), np.float32)
    triangles[:, :-1], depths[:, :-1] = np.where(listed, face, -1), np.where(listed, place, np.inf)
    shares[:, :-1] = np.where(listed[..., None], before * cover[..., None], 0)
    triangles[rows, ends], depths[rows, ends] = triangle, depth
    shares[rows, ends] = np.where(count[:, None] > 0, left[rows, np.maximum(count - 1, 0)], 1)
    # Nothing is seen behind what hides everything.
    some = np.any(shares > 0, 2)
    triangles = np.where(some, triangles, -1)
    used = max(1, int(np.max(np.where(np.any(some, 0), np.arange(1, width + 1), 0))))
    shares = shares[..., 0] if left.shape[2] == 1 else shares
    return triangles.T[:used], depths.T[:used], np.swapaxes(shares, 0, 1)[:used]


def _directions(camera: Camera, samples: int, number: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """Directions from the eye through samples, as long as one unit along the view axis."""
    pixel, sample = np.divmod(number, samples)
    row, column = np.divmod(pixel, camera.width)
    offset = SAMPLES[samples][sample]
    focal = camera.height / (2 * np.tan(float(camera.field_of_view) / 2))
    x = (column + (1 - camera.width) / 2 + offset[:, 0]) / focal
    y = (row + (1 - camera.height) / 2 + offset[:, 1]) / focal
    right, up, forward = np.asarray(raster.view_axes(camera), np.float64)
    return (x[:, None] * right - y[:, None] * up + forward).astype(np.float32)


def _joined(layers: list[Pixels]) -> Pixels:
    """The points of all layers, ordered by pixel, with at most an eighth of padding."""
    fields = ("triangle", "barycentric", "slope", "pixel", "coverage")
    whole = {name: np.concatenate([np.asarray(getattr(layer, name)) for layer in layers]) for name in fields}
    used = np.flatnonzero(whole["triangle"] >= 0)
    order = used[np.argsort(whole["pixel"][used], kind="stable")]
    count = len(order)
    unit = 1 << max(count.bit_length() - 4, 0)
    room = max(-(-count // unit) * unit, 1) - count
    height, width = layers[0].background.shape[:2]
    value = {"triangle": -1, "pixel": height * width - 1}
    rows = {
        name: np.concatenate([field[order], np.full((room, *field.shape[1:]), value.get(name, 0), field.dtype)])
        for name, field in whole.items()
    }
    return Pixels(**rows, background=sum((layer.background for layer in layers[1:]), layers[0].background))
