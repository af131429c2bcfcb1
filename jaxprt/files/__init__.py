"""Reading and writing of image files, of arrays in blocks, and of this package's objects."""

from jaxprt.files.images import decode_image, read_image
from jaxprt.files.objects import load, save
from jaxprt.files.outputs import write_exr, write_png

__all__ = ["decode_image", "load", "read_image", "save", "write_exr", "write_png"]
