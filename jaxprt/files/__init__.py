"""Reading and writing files: images, and objects of this package."""

from jaxprt.files.images import decode_image, read_image, write_exr, write_png
from jaxprt.files.objects import load, save

__all__ = ["decode_image", "load", "read_image", "save", "write_exr", "write_png"]
