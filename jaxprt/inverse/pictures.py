"""Pixels of pictures that show a mesh, and the residual of a scene's radiance at them."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxprt import require
from jaxprt.image import raster
from jaxprt.inverse import solve
from jaxprt.scene.camera import Camera
from jaxprt.scene.mesh import Mesh
from jaxprt.sphere import cubemap

_BENT = 0.25  # between corners' normals: about 14 degrees
_ALIKE = 1e-4  # relative difference of bends that are equal but for rounding


def _mask(value) -> Array | None:
    """A mask as booleans. Image files store 0 and 1, or 0 and 255."""
    if value is None or isinstance(value, Tracer):
        return value
    wrong = require.unreal(value)
    known = np.asarray(None if (wrong and wrong != "booleans") or np.ndim(value) == 0 else value)
    if known.dtype.kind not in "biuf":
        raise TypeError(f"a mask must be of booleans, or of numbers 0 and 1 or 0 and 255, got {known.dtype}")
    most = 255 if (known == 255).any() else 1
    wrong = known[(known != 0) & (known != most)] if known.dtype.kind != "b" else known[:0]
    if wrong.size:
        raise ValueError(
            f"a mask must be of booleans, or of numbers 0 and 1 or 0 and 255, got {wrong.size} others of {known.size}, "
            f"the first is {wrong.flat[0]}: compare with a threshold, mask > 127"
        )
    return jnp.asarray(known != 0)


def _image(value: Any) -> Any:
    """Numbers as an array. Integers stay, because `observe` refuses them: they are not linear."""
    if require.unreal(value) or isinstance(value, int):
        return value
    return require.floating(value) if jnp.issubdtype(jnp.asarray(value).dtype, jnp.floating) else jnp.asarray(value)


def _exposure(value: Any) -> Any:
    if not require.unreal(value) and np.ndim(value):
        raise TypeError(f"the exposure must be one number, got an array of shape {np.shape(value)}")
    return value if require.unreal(value) else float(value)


class Picture(eqx.Module):
    """A picture of the object. NumPy arrays become JAX arrays.

    Attributes:
        image: Linear pixel values: radiance times the exposure.
        camera: Camera of the picture, with the size of the image.
        mask: Which pixels count: booleans, or 0 where a pixel does not count and 1 or 255 where it does. None for all.
        exposure: Factor from radiance to pixel values.
        saturation: Value at which the camera clips. Pixels that reach it in any color do not count. None if no pixel is
            clipped.
    """

    image: Float[Array, "h w c"] = eqx.field(converter=_image)
    camera: Camera
    mask: Bool[Array, "_ _"] | None = eqx.field(converter=_mask, default=None)
    exposure: float = eqx.field(converter=_exposure, default=1.0)
    saturation: float | None = None

    def __check_init__(self):
        """Refuses values of other kinds; `observe` checks numbers."""
        require.real("the image of a picture", self.image)
        require.real("the exposure of a picture", self.exposure)
        if self.saturation is not None:
            require.real("the saturation of a picture", self.saturation)


class Observations(eqx.Module):
    """The pixels that count, and which vertices each of them shows.

    Attributes:
        eye: Position of the camera of each picture, relative to the mesh's origin, as systems take it.
        vertex: The three vertices of the triangle at each pixel. Indices of picture n start at n * vertices.
        weight: Their barycentric weights, times the exposure.
        value: Value of each pixel.
        vertices: Number of vertices of the mesh.
    """

    eye: Float[Array, "n 3"]
    vertex: Int[Array, "p 3"]
    weight: Float[Array, "p 3"]
    value: Float[Array, "p c"]
    vertices: int = eqx.field(static=True)


def observe(mesh: Mesh, pictures: Sequence[Picture]) -> Observations:
    """Finds the pixels that show the mesh and count in a fit.

    A pixel counts if it lies inside its mask, is not saturated and is not at the silhouette of the mesh. Pixels on
    triangles whose normals differ by more than 14 degrees between corners do not count either, because radiance
    interpolated between these vertices is wrong. If this excludes most pixels of a picture, the less curved half
    counts.

    Raises:
        TypeError: An argument is not a `Mesh`, `Picture` or `Camera`; or the call is inside `jax.jit`, `jax.vmap` or
            `jax.grad`.
        ValueError: There are no pictures; an image is not floating point with one or three colors; an image or a mask
            has another size than its camera; images have different numbers of colors; a pixel that counts is negative
            or not finite; an exposure or a saturation is not a positive number; all pictures are black; or no pixel
            counts.
    """
    if isinstance(pictures, Picture) or not isinstance(pictures, Iterable):
        raise TypeError(f"pictures must be a sequence of Picture, got one {type(pictures).__name__}")
    if not isinstance(mesh, Mesh):
        raise TypeError(f"the mesh must be a Mesh, got {type(mesh).__name__}")
    pictures = list(pictures)
    solve.outside(mesh, pictures)
    if not pictures:
        raise ValueError("at least one picture is needed, got none")
    parts = [_picture_rows(number, mesh, picture) for number, picture in enumerate(pictures)]
    colors = {picture.image.shape[2] for picture in pictures}
    if len(colors) > 1:
        raise ValueError(f"all pictures must have the same number of colors, got {sorted(colors)}")
    vertex, weight, value = (np.concatenate(rows) for rows in zip(*parts, strict=True))
    if not len(value):
        raise ValueError("pictures must show the mesh in a pixel that counts, got none")
    if not np.any(value):
        raise ValueError("pictures must not be black wherever they count")
    eye = jnp.stack([picture.camera.local(mesh.origin).eye for picture in pictures])
    return Observations(eye, jax.device_put(vertex), jax.device_put(weight), jax.device_put(value), len(mesh.position))


def _picture_rows(number: int, mesh: Mesh, picture: Picture) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, weights and values of a picture's pixels."""
    if not isinstance(picture, Picture):
        raise TypeError(f"picture {number} must be a Picture, got {type(picture).__name__}")
    image, camera = np.asarray(picture.image), picture.camera
    if not isinstance(camera, Camera):
        raise TypeError(f"the camera of picture {number} must be a Camera, got {type(camera).__name__}")
    size = (camera.height, camera.width)
    if image.ndim != 3 or image.shape[2] not in (1, 3) or not np.issubdtype(image.dtype, np.floating):
        raise ValueError(
            f"the image of picture {number} must be linear radiance [h, w, 1 or 3] of floating point, got "
            f"{image.dtype}{list(image.shape)}: alpha belongs to the mask, and `jaxprt.image.decode_srgb` decodes "
            "values / 255"
        )
    if picture.mask is not None and picture.mask.ndim != 2:
        raise ValueError(f"the mask of picture {number} must be [h, w], got {list(picture.mask.shape)}")
    for name, array in {"image": image, "mask": picture.mask}.items():
        if array is not None and array.shape[:2] != size:
            raise ValueError(
                f"the {name} of picture {number} must have its camera's size {size}, got {array.shape[:2]}"
            )
    if not (np.isfinite(picture.exposure) and picture.exposure > 0):
        raise ValueError(f"the exposure of picture {number} must be positive, got {picture.exposure}")
    if picture.saturation is not None and not (np.ndim(picture.saturation) == 0 and picture.saturation > 0):
        raise ValueError(f"the saturation of picture {number} must be a positive number, got {picture.saturation}")
    fragments = raster.rasterize(mesh, camera)
    seen = np.asarray(fragments.triangle)
    counts = _inside(seen >= 0) & np.asarray(raster.front(fragments, mesh, camera))
    if picture.mask is not None:
        counts &= np.asarray(picture.mask)
    if picture.saturation is not None:
        counts &= ~np.any(image >= picture.saturation, -1)
    value = image[counts]
    wrong = ~(np.isfinite(value) & (value >= 0)).all(-1)
    if wrong.any():
        raise ValueError(
            f"pixels that count must be finite and not negative, {wrong.sum()} of {len(value)} of picture {number} are "
            "not: mask them"
        )
    bent = _bent(mesh, seen[counts])
    # Triangles of regular meshes bend alike up to rounding, which must not decide which of their pixels count.
    counts[counts] = bent <= np.maximum(_BENT, (1 + _ALIKE) * np.median(bent) if bent.size else 0)
    vertex = np.asarray(mesh.face)[seen[counts]] + number * len(mesh.position)
    return vertex, np.asarray(fragments.barycentric)[counts] * picture.exposure, image[counts]


def _bent(mesh: Mesh, triangle: np.ndarray) -> np.ndarray:
    """Largest distance between the unit normals of each triangle's corners."""
    corner = np.asarray(mesh.normal)[np.asarray(mesh.face)[triangle]]
    return np.max(np.linalg.norm(corner - np.roll(corner, 1, 1), axis=-1), -1, initial=0)


def _inside(seen: np.ndarray) -> np.ndarray:
    """Seen pixels whose neighbors are seen too. At silhouettes a camera mixes the object with its background."""
    wide = np.pad(seen, 1)
    height, width = seen.shape
    return np.all([wide[i : i + height, j : j + width] for i in range(3) for j in range(3)], 0)


def residual(radiance: Callable, parameters: PyTree, pixels: Observations) -> Float[Array, " m"]:
    """Difference between the scene's pixels and the observed ones, relative to the norm of the observed ones.

    Args:
        radiance: Function (parameters, eye) -> radiance of every vertex. What does not depend on the eye is computed
            once.
        parameters: Parameters of the radiance.
        pixels: The observed pixels.
    """
    color = jax.vmap(lambda eye: radiance(parameters, eye))(pixels.eye)
    required = (len(pixels.eye), pixels.vertices, pixels.value.shape[1])
    if getattr(color, "shape", None) != required:
        got = list(color.shape[1:]) if hasattr(color, "shape") else type(color).__name__
        raise ValueError(f"the radiance must be {list(required[1:])}, vertices and colors of the pictures, got {got}")
    color = color.reshape(-1, color.shape[-1])
    predicted = sum(pixels.weight[:, i, None] * color[pixels.vertex[:, i]] for i in range(3))
    return ((predicted - pixels.value) / jnp.linalg.norm(pixels.value)).ravel()


class Residual(eqx.Module):
    """The `residual` as a function of the numbers of the parameters in a row.

    Attributes:
        radiance: Function (parameters, eye) -> radiance of every vertex.
        like: Parameters of the same structure and shapes.
        pixels: The observed pixels.
    """

    radiance: Callable
    like: PyTree
    pixels: Observations

    def __call__(self, row: Float[Array, " n"]) -> Float[Array, " m"]:
        """The residual of these numbers."""
        return residual(self.radiance, ravel_pytree(self.like)[1](row), self.pixels)


def smoothness(radiance: Float[Array, "6 n n c"]) -> Float[Array, ""]:
    """Mean squared difference between neighboring texels, across the edges of faces too: a prior of light."""
    wrong = require.unreal(radiance)
    if wrong or np.ndim(radiance) != 4 or np.shape(radiance)[0] != 6:
        got = list(np.shape(radiance)) if not wrong else type(radiance).__name__
        raise ValueError(
            f"the radiance must be that of texels, [6, n, n, c], got {got}: for an Environment, give its `.radiance`"
        )
    wide = cubemap.pad(jnp.asarray(radiance))
    down, right = wide[:, 1:, 1:-1] - wide[:, :-1, 1:-1], wide[:, 1:-1, 1:] - wide[:, 1:-1, :-1]
    return jnp.mean(down**2) + jnp.mean(right**2)
