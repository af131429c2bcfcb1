"""KTX 2 images with a payload of Basis Universal (ETC1S or UASTC), as KHR_texture_basisu allows in glTF files."""

from typing import Any

import numpy as np
from jaxtyping import Float32

from jaxprt.files import pixels

MAGIC = b"\xabKTX 20\xbb\r\n\x1a\n"
_TEXELS = 8  # bytes of a pixel while it is transcoded: RGBA, and the file's blocks at most


def read_ktx2(
    content: bytes, name: str, *, decoded: bool | None
) -> tuple[Float32[np.ndarray, "h w c"], dict[str, Any]]:
    """The finest level of a KTX 2 image.

    Args:
        content: The bytes of the file.
        name: Name of the image in error messages.
        decoded: Whether colors are decoded from sRGB; None does what the file states.

    Returns:
        The pixels with 3 (RGB) or 4 (RGBA) channels, and no attributes.

    Raises:
        ImportError: The package opengl_basisu is missing.
        ValueError: The file is damaged, has several faces or layers, or holds no Basis Universal payload.
        MemoryError: The pixels do not fit into memory.
    """
    try:
        import opengl_basisu
    except ImportError as error:
        raise ImportError(
            f"{name} is a KTX 2 texture, which needs the package opengl_basisu: pip install 'jaxprt[web]'"
        ) from error
    must = f"{name} must be an undamaged KTX 2 texture of Basis Universal, ETC1S or UASTC"
    try:
        file = opengl_basisu.open(content)
        pixels.check_size(name, file.height, file.width)
        if file.faces != 1 or file.layers != 1:
            raise ValueError(f"{name} must be one image, got {file.layers} layers of {file.faces} faces")
        channels = 4 if file.has_alpha else 3
        pixels.check_memory(name, file.height, file.width, channels, decoder=_TEXELS * file.height * file.width)
        texel = file.transcode(opengl_basisu.Target.RGBA8).data
    except (opengl_basisu.BasisuError, opengl_basisu.UnsupportedError) as error:
        raise ValueError(f"{must}, got: {error}") from error
    image = np.asarray(texel[..., :channels], np.float32) / np.float32(255)
    if file.srgb if decoded is None else decoded:
        pixels.decode_srgb(image[..., :3])
    return image, {}
