"""Reading and writing files."""

from jaxprt.files.images import read_image, write_exr, write_png

__all__ = ["read_image", "write_exr", "write_png"]
