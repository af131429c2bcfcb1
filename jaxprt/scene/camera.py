"""The pinhole camera."""

import dataclasses
import functools
import inspect
from collections.abc import Callable
from typing import TypeVar, cast

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.scene import origin as origins
from jaxprt.scene.mesh import Mesh, bounds, centered

Function = TypeVar("Function", bound=Callable)
_MOST = 2**29 - 1  # pixels whose four samples the rasterizer's 32-bit indices can count


def _whole(value):
    """NumPy's integers as Python's, which may be static."""
    return int(value) if isinstance(value, np.integer) else value


class Camera(eqx.Module):
    """A pinhole camera. Lists and NumPy arrays are converted to JAX arrays.

    Values that are not finite, angles out of range, an eye equal to the target, and pictures without pixels raise
    ValueError. Inside `jax.jit` values are not known and therefore not checked.

    Attributes:
        eye: Position in world units, in the coordinates of the scene's file. It stays a NumPy array in float64 if it is
            farther than 64 units from zero and float32 would round it.
        target: Point at the center of the picture, in world units. It is stored as the eye is.
        up: Direction that points up in the picture; not parallel to the view direction.
        field_of_view: Full vertical angle of view in radians, between 0 and pi.
        width: Picture width in pixels.
        height: Picture height in pixels.
    """

    eye: Float[Array | np.ndarray, "3"] = eqx.field(converter=origins.coordinates)
    target: Float[Array | np.ndarray, "3"] = eqx.field(converter=origins.coordinates)
    up: Float[Array, "3"] = eqx.field(converter=require.floating)
    field_of_view: Float[Array, ""] = eqx.field(converter=require.floating)
    width: int = eqx.field(static=True, converter=_whole)
    height: int = eqx.field(static=True, converter=_whole)

    def __check_init__(self):
        """Refuses places, directions and angles that are not finite."""
        for name in ("eye", "target", "up"):
            require.position(f"the camera's {name}", getattr(self, name))
        require.finite("the camera's field_of_view", self.field_of_view)
        if jnp.ndim(self.field_of_view):
            raise ValueError(f"the camera's field_of_view must be one number, got {self.field_of_view}")
        for name in ("width", "height"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
                raise ValueError(f"the camera's {name} must be a whole number of pixels, at least 1, got {value!r}")
        if self.width * self.height > _MOST:
            raise ValueError(f"a picture must have at most {_MOST} pixels, got {self.width} x {self.height}")
        known = [None if isinstance(x, Tracer) else np.asarray(x) for x in (self.field_of_view, self.eye, self.target)]
        angle, eye, target = known
        if angle is not None and not np.all((angle > 0) & (angle < np.pi)):
            raise ValueError(f"the camera's field_of_view must be between 0 and pi, in radians, got {angle}")
        if eye is not None and target is not None and np.array_equal(eye, target):
            raise ValueError(f"the camera's eye and target must be different points, got {eye} for both")

    def local(self, origin: origins.Origin) -> "Camera":
        """The same camera with eye and target relative to an origin, such as `mesh.origin`; moved in float64."""
        if origin == origins.ZERO:
            return self
        eye, target = (origins.local(f"the camera's {name}", getattr(self, name), origin) for name in ("eye", "target"))
        return dataclasses.replace(self, eye=eye, target=target)


def localize(mesh: Mesh, camera: Camera) -> tuple[Mesh, Camera]:
    """A mesh and a camera in common coordinates near zero.

    The mesh's origin becomes zero and the camera relative to it. A camera at large coordinates and a mesh without
    origin are in common coordinates already.
    """
    return centered(mesh), camera.local(mesh.origin)


def in_common_coordinates(function: Function) -> Function:
    """Decorates a function of a mesh and a camera: outside `jax.jit`, it moves both near zero.

    A function of a camera alone gets one whose eye is at zero if its coordinates are in float64, because directions are
    differences of positions, and those of large float32 numbers are rounded.
    """
    signature = inspect.signature(function)

    @functools.wraps(function)
    def moved(*argument, **named):
        bound = signature.bind(*argument, **named)
        arguments, camera = bound.arguments, bound.arguments["camera"]
        if not isinstance(camera, Camera):
            return function(*argument, **named)
        if "mesh" not in signature.parameters:
            exact = any(isinstance(position, np.ndarray) for position in (camera.eye, camera.target))
            arguments["camera"] = camera.local(tuple(np.asarray(camera.eye, float).tolist())) if exact else camera
        elif isinstance(arguments["mesh"], Mesh):
            mesh, arguments["camera"] = localize(arguments["mesh"], camera)
            # Opacity is for rays; programs for all scenes are the same.
            arguments["mesh"] = mesh if mesh.opacity is None else dataclasses.replace(mesh, opacity=None)
        return function(*bound.args, **bound.kwargs)

    return cast(Function, moved)


def orbit(
    mesh: Mesh,
    *,
    azimuth: float = 0.0,
    elevation: float = 0.0,
    field_of_view: float = 0.6,
    width: int = 512,
    height: int = 512,
) -> Camera:
    """A camera that sees the whole mesh from a given angle: the bounding sphere touches the picture's nearer edges.

    The camera looks at the center of the bounding box, which is also that of the bounding sphere. Vertices without
    faces are ignored. Straight above or below, the up direction of the picture is the limit for elevations approaching
    that angle.

    Args:
        mesh: The mesh to look at.
        azimuth: Angle about +y in radians; 0 is on the +z side, positive angles are towards +x.
        elevation: Angle above the horizon in radians, from -pi/2 to pi/2.
        field_of_view: Full vertical angle of view in radians.
        width: Picture width in pixels.
        height: Picture height in pixels.

    Returns:
        The camera.

    Raises:
        ValueError: The picture has no pixels, or an angle is out of its range.
    """
    require.kind("the mesh", mesh, Mesh, source="jaxprt.scene.mesh.make_mesh or jaxprt.load_mesh")
    for name, value in (("width", width), ("height", height)):
        require.count(name, value)
    if width < 1 or height < 1:
        raise ValueError(f"width and height must be at least 1, got {width} x {height}")
    for name, value in (("field_of_view", field_of_view), ("elevation", elevation), ("azimuth", azimuth)):
        require.number(name, value, -require.LARGEST)
    if not 0 < field_of_view < np.pi:
        raise ValueError(f"field_of_view must be between 0 and pi, got {field_of_view}")
    if not abs(elevation) <= np.pi / 2:
        raise ValueError(f"elevation must be from -pi/2 to pi/2, got {elevation}")
    low, high = bounds(mesh)
    center = (low + high) / 2
    corner = np.asarray(mesh.position, np.float64)[np.unique(mesh.face)] + mesh.origin
    radius = np.linalg.norm(corner - center, axis=1).max() or 1.0
    half = np.arctan(np.tan(field_of_view / 2) * min(1.0, width / height))
    around = np.array([np.sin(azimuth), np.cos(azimuth)])
    back = np.array([around[0] * np.cos(elevation), np.sin(elevation), around[1] * np.cos(elevation)])
    up = np.array([-around[0] * np.sin(elevation), np.cos(elevation), -around[1] * np.sin(elevation)])
    up, angle = (jnp.asarray(value, mesh.position.dtype) for value in (up, field_of_view))
    eye, target = center + radius / np.sin(half) * back, center
    if mesh.origin == origins.ZERO:
        eye, target = (jnp.asarray(value, mesh.position.dtype) for value in (eye, target))
    return Camera(eye, target, up, angle, width, height)
