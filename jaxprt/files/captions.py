"""Lines of text as pictures."""

import numpy as np
import OpenImageIO
from jaxtyping import Float

_LARGEST, _SMALLEST = 16, 9  # pixels of letters
_MARGIN = 4  # pixels


def line(text: str, *, width: int, height: int) -> Float[np.ndarray, "h w 3"]:
    """Draws a line of black text in the middle of a white picture. Long text gets smaller letters, or loses its middle.

    Args:
        text: The text.
        width: Columns of the picture in pixels.
        height: Rows of the picture in pixels.

    Raises:
        OSError: The text cannot be drawn.
    """
    shown, size = fitting(text, width - _MARGIN)
    drawn = OpenImageIO.ImageBuf(OpenImageIO.ImageSpec(width, height, 3, "float"))
    OpenImageIO.ImageBufAlgo.fill(drawn, (1.0, 1.0, 1.0))
    place = {"alignx": "center", "aligny": "center", "textcolor": (0.0, 0.0, 0.0)}
    if not OpenImageIO.ImageBufAlgo.render_text(drawn, width // 2, height // 2, shown, size, **place):
        raise OSError(f"the text {text!r} could not be drawn: {drawn.geterror()}")
    return np.asarray(drawn.get_pixels(OpenImageIO.FLOAT))


def fitting(text: str, width: int) -> tuple[str, int]:
    """A text that fits into a width in pixels, and the height of its letters in pixels."""
    for size in range(_LARGEST, _SMALLEST - 1, -1):
        if OpenImageIO.ImageBufAlgo.text_size(text, size).width <= width:
            return text, size
    for count in range(len(text) - 2, 1, -1):
        short = f"{text[: (count + 1) // 2]}…{text[-(count // 2) :]}"
        if OpenImageIO.ImageBufAlgo.text_size(short, _SMALLEST).width <= width:
            return short, _SMALLEST
    return "", _SMALLEST
