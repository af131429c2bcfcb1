"""Precomputed radiance transfer in JAX.

Conventions, everywhere in this package:

* Positions, eyes, cameras and lights are in world units and in the coordinates of the scene's file. Meshes far from
  zero store positions relative to `Mesh.origin`, because float32 would round them. Systems that were precomputed for
  a mesh take eyes relative to it too; scenes, pictures and `reference.radiance` take those of the file.
* The world is right-handed and +y is up. Latitude-longitude images have +y in the top row, +z in the
  center column and +x a quarter of the width from the left.
* The local frame of a surface point is (tangent, bitangent, normal) = (x, y, z).
* ``wi`` points to the light and ``wo`` to the viewer: unit vectors away from the surface, in the local frame;
  a name that ends in ``_world`` is in the world's frame. Angles are in radians.
* Radiance is linear Rec. 709 RGB. A BRDF is in 1/sr and holds its own 1/pi; the cosine and the solid angle live
  in the transport. Nothing is clamped inside a linear operator; only display clamps.
* Cubemaps are ``[6, n, n]``: faces +x, -x, +y, -y, +z, -z, rows and columns as OpenGL has them.
* Images are ``[h, w, c]``, first row on top.
* Axis letters: v vertices, f faces, d directions, b basis functions, k kept coefficients, r BRDF terms,
  c colors, h w image, n texels along an edge.
* Arrays are float32, or float64 where the caller has enabled it. The package never touches ``jax.config``, with one
  exception: where the caller has not configured JAX's cache of compiled programs, programs of any compile time are
  kept, in the user's cache folder. The environment variable JAXPRT_KEEP_PROGRAMS=0 turns this off.
* Lights, eyes and materials may have any float type. Half precision is converted to float32 where it enters, and
  integers and lists too. Results have the widest type of the system and these. Gradients have the type of the argument.
* Numbers that enter are at most 1e32 in magnitude, so that products and sums over all directions fit into float32.
  Masked arrays, text, booleans and complex numbers are refused. Light in memory may be negative: relighting is linear.
"""

import importlib.util
from typing import TYPE_CHECKING, Any

from jaxprt.programs import xla_flags

if TYPE_CHECKING:
    from jaxprt.public import *  # noqa: F403

__version__ = "0.3.0"
xla_flags.set_up()


def __getattr__(name: str) -> Any:
    """A module of the package, or a name of `jaxprt.public`: imported when it is used, which takes a second."""
    if name == "__all__" or not name.startswith("_"):
        if importlib.util.find_spec(f"{__name__}.{name}"):
            return importlib.import_module(f"{__name__}.{name}")
        public = importlib.import_module(f"{__name__}.public")
        if hasattr(public, name):
            return globals().setdefault(name, getattr(public, name))
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__getattr__("__all__")})
