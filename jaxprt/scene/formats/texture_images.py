"""Images of textures in files of their own."""

import pathlib

import jax
import numpy as np

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
                present = channels if pixels.shape[-1] > 2 else (0,) * len(channels)
                self._image[key] = jax.device_put(np.take(pixels, present, -1))
        image = self._image[key]
        if isinstance(image, ValueError):
            raise ValueError(str(image)) from image
        return image
