"""Images of textures: channels of decoded files, and files that textures share."""

import pathlib

import jax
import numpy as np

from jaxprt import require
from jaxprt.files import images, inputs


class TextureImages:
    """Reads the image files of a scene. An image that several textures share is decoded and stored only once."""

    def __init__(self):
        self._image: dict[tuple[pathlib.Path, bool, tuple[int, ...]], jax.Array | ValueError] = {}

    def read(self, path: pathlib.Path, channels: tuple[int, ...], *, decoded: bool) -> jax.Array:
        """Some channels of an image.

        Args:
            path: The file.
            channels: Numbers of the channels. Of gray images, each is the gray.
            decoded: Whether integers are decoded from sRGB.

        Raises:
            FileNotFoundError: The file does not exist.
            ValueError: It is not a regular file, or damaged.
            MemoryError: The image does not fit into memory.
        """
        inputs.check(path, "an image file")
        key = path.resolve(), decoded, channels
        if key not in self._image:
            try:
                pixels = images.decode_image(inputs.content(path, "an image file"), name=str(path), decoded=decoded)
            except ValueError as error:
                self._image[key] = error
            else:
                self._image[key] = stored(pixels, channels, str(path))
        image = self._image[key]
        if isinstance(image, ValueError):
            raise ValueError(str(image)) from image
        return image


def stored(image: np.ndarray, channels: tuple[int, ...], name: str) -> jax.Array:
    """Some channels of a decoded image, on the device. They are copied only where the image has others too.

    Args:
        image: Pixels with 1 (gray), 2 (gray, alpha), 3 or 4 channels.
        channels: Numbers of the channels: 0 to 2 for colors, which are equal in gray images, or 3 alone for alpha,
            which is 1 in images without it.
        name: Name of the image in error messages.

    Raises:
        MemoryError: The channels do not fit into memory.
    """
    height, width, count = image.shape
    whole = channels == tuple(range(count))
    require.memory(
        f"{name}: {len(channels)} channels of {width} x {height} pixels (width x height)",
        (2 if whole else 3) * 4 * height * width * len(channels),  # one of these is for the check of the texture
        "free some memory, or reduce the size of the image in another program first",
    )
    if whole:
        return jax.device_put(image)
    if channels == (3,) and count % 2:
        return jax.device_put(np.ones((height, width, 1), image.dtype))
    place = (0, 0, 0, 1) if count < 3 else (0, 1, 2, 3)
    return jax.device_put(np.take(image, [place[channel] for channel in channels], -1))
