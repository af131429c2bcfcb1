"""Scenes from dictionaries in the form of `mitsuba.load_dict` (Mitsuba 3). Mitsuba itself is not needed.

References in comments are to the plugin reference of Mitsuba 3, https://mitsuba.readthedocs.io.
"""

import math
import pathlib
import warnings
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxprt.scene import environment
from jaxprt.scene.camera import Camera
from jaxprt.scene.environment import Environment
from jaxprt.scene.formats import mesh_file
from jaxprt.scene.formats.file_parts import split_parts
from jaxprt.scene.formats.geometry import Geometry, placed
from jaxprt.scene.formats.mitsuba_material import MaterialMaker, rgb
from jaxprt.scene.mesh import grid_face
from jaxprt.scene.scene import Part, Scene

_CELLS, _RINGS = 32, 64  # subdivision of flat sides and of spheres, because light is computed at vertices
# Sides of a cube: normal, and directions of u and v.
_SIDES = (
    ((0, -1, 0), (0, 0, 1), (1, 0, 0)),
    ((0, 1, 0), (-1, 0, 0), (0, 0, -1)),
    ((1, 0, 0), (0, 1, 0), (0, 0, -1)),
    ((0, 0, 1), (0, 1, 0), (1, 0, 0)),
    ((-1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ((0, 0, -1), (0, -1, 0), (1, 0, 0)),
)
_MESHES = {"obj": ".obj", "ply": ".ply"}
_SHAPES = {*_MESHES, "rectangle", "cube", "sphere"}
_SENSORS = {"perspective", "thinlens"}
_EMITTERS = {"envmap", "constant"}
# Plugins that control how a picture is computed, not what it shows.
_SILENT = {"path", "direct", "volpath", "volpathmis", "ptracer", "aov", "prb", "prb_basic", "direct_projective"}
_SILENT |= {"prb_projective", "independent", "multijitter", "orthogonal", "stratified", "ldsampler", "moment", "depth"}


def read(scene: Mapping[str, Any]) -> Scene:
    """Reads the scene of a dictionary, as `load_scene` documents.

    It may refer to files in any folder: unlike a scene file, a dictionary is written by the caller.
    """
    if scene.get("type") != "scene":
        raise ValueError(f"a dictionary of Mitsuba must have the type 'scene', got {scene.get('type')!r}")
    ignored: set[str] = set()
    materials = MaterialMaker(scene, ignored)
    parts, cameras, lights = [], [], []
    for name, item in scene.items():
        if not isinstance(item, Mapping):
            if name != "type":
                raise ValueError(f"{name} must be a dictionary, got one of class {type(item).__name__}")
            continue
        kind = str(item.get("type"))
        if kind in _SHAPES:
            parts.append(_part(name, item, materials))
        elif kind in _SENSORS:
            cameras.append(_camera(name, item, ignored))
        elif kind in _EMITTERS:
            lights.append(_environment(name, item))
        elif not MaterialMaker.knows(kind) and kind not in _SILENT:
            ignored.add(f"{name} ({kind})")
    if ignored:
        warnings.warn(f"the dictionary: not supported and ignored are {', '.join(sorted(ignored))}", stacklevel=3)
    return Scene(parts, cameras, lights)


def transform(value: Any, name: str) -> np.ndarray:
    """A transform [4 4] from an array, nested lists or an object with a `matrix`; the identity for None.

    Raises:
        ValueError: The value has another form or is not finite.
    """
    if value is None:
        return np.eye(4)
    matrix = np.squeeze(np.asarray(getattr(value, "matrix", value)))
    if matrix.shape != (4, 4) or matrix.dtype.kind not in "iuf" or not np.isfinite(matrix).all():
        raise ValueError(f"{name} must be a finite 4 x 4 matrix or have one as its `matrix`, got {value!r}")
    return matrix.astype(np.float64)


def _part(name: str, item: Mapping[str, Any], materials: MaterialMaker) -> Part:
    """A shape with its material."""
    kind = item["type"]
    path = pathlib.Path(name)
    if kind in _MESHES:
        path = pathlib.Path(str(item.get("filename", "")))
        if path.suffix.lower() != _MESHES[kind]:
            raise ValueError(f"the filename of {name} must end in {_MESHES[kind]}, got {str(path)!r}")
        geometry = mesh_file.read(path, groups=False)
        # OBJ files have v up, images v down. Mitsuba flips v for OBJ files, but not for PLY files.
        if not item.get("flip_tex_coords", kind == "obj") and geometry.texture is not None:
            geometry = geometry._replace(texture=[[0, 1]] + geometry.texture * [[1, -1]])
        if item.get("face_normals", False):
            geometry = _flat(geometry)
    else:
        geometry = {"rectangle": _rectangle, "cube": _cube, "sphere": _sphere}[kind](item)
    geometry = placed(geometry, transform(item.get("to_world"), f"to_world of {name}"))
    if item.get("flip_normals", False):
        normal = None if geometry.normal is None else -geometry.normal
        geometry = geometry._replace(face=geometry.face[:, ::-1], normal=normal)
    geometry = geometry._replace(region=np.zeros(len(geometry.position), int))
    return split_parts(geometry, [name], [materials.of_shape(name, item)], path)[0]


def _flat(geometry: Geometry) -> Geometry:
    """Separate triangles with flat normals."""
    corner = geometry.position[geometry.face]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    texture = None if geometry.texture is None else geometry.texture[geometry.face.ravel()]
    face = np.arange(geometry.face.size).reshape(-1, 3)
    return Geometry(corner.reshape(-1, 3), face, np.repeat(normal, 3, 0), texture=texture)


def _grid(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coordinates u and v [n 1] of a grid, and faces whose front is the side to which u x v points."""
    v, u = np.meshgrid(np.linspace(0, 1, rows + 1), np.linspace(0, 1, columns + 1), indexing="ij")
    return u.reshape(-1, 1), v.reshape(-1, 1), grid_face(rows=rows + 1, columns=columns + 1)[:, ::-1]


def _rectangle(item: Mapping[str, Any]) -> Geometry:
    """A rectangle from -1 to 1 in the plane z = 0, facing +z. As in Mitsuba, the image's first row is at the bottom."""
    u, v, face = _grid(_CELLS, _CELLS)
    position = np.concatenate([2 * u - 1, 2 * v - 1, 0 * u], 1)
    return Geometry(position, face, np.tile([0.0, 0, 1], (len(u), 1)), texture=np.concatenate([u, 1 - v], 1))


def _cube(item: Mapping[str, Any]) -> Geometry:
    """A cube from -1 to 1 along all axes."""
    u, v, face = _grid(_CELLS, _CELLS)
    position, normal, texture, faces = [], [], [], []
    for number, (front, across, along) in enumerate(np.array(_SIDES, float)):
        position.append(front + (2 * u - 1) * across + (2 * v - 1) * along)
        normal.append(np.tile(front, (len(u), 1)))
        texture.append(np.concatenate([u, 1 - v], 1))
        side = 1 if np.cross(across, along) @ front > 0 else -1
        faces.append(face[:, ::side] + number * len(u))
    return Geometry(*(np.concatenate(each) for each in (position, faces, normal)), texture=np.concatenate(texture))


def _sphere(item: Mapping[str, Any]) -> Geometry:
    """A sphere around a center. The pole of its texture coordinates is at +z."""
    u, v, face = _grid(_RINGS, 2 * _RINGS)
    sine = np.sin(np.pi * v)
    normal = np.concatenate([np.cos(2 * np.pi * u) * sine, np.sin(2 * np.pi * u) * sine, np.cos(np.pi * v)], 1)
    center, radius = np.asarray(item.get("center", [0, 0, 0]), float).reshape(3), float(item.get("radius", 1.0))
    corner = normal[face]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    face = face[area > 1e-9][:, ::-1]
    return Geometry(center + radius * normal, face, normal, texture=np.concatenate([u, 1 - v], 1))


def _camera(name: str, item: Mapping[str, Any], ignored: set[str]) -> Camera:
    """A camera from a perspective sensor, which looks along its +z axis."""
    if item["type"] == "thinlens":
        ignored.add(f"the aperture of {name}")
    ignored |= {f"{key} of {name}" for key in item if key.startswith("principal_point_offset") and item[key]}
    film = next((each for each in item.values() if isinstance(each, Mapping) and "film" in str(each.get("type"))), {})
    ignored |= {f"{key} of {name}" for key in film if key.startswith("crop_")}
    width, height = int(film.get("width", 768)), int(film.get("height", 576))
    if "fov" not in item:
        raise ValueError(f"{name} must have fov, got {', '.join(item)}")
    half, axis = math.tan(math.radians(float(item["fov"])) / 2), item.get("fov_axis", "x")
    if axis not in ("x", "y", "diagonal", "smaller", "larger") or not half > 0:
        raise ValueError(f"{name} must have a positive fov and a known fov_axis, got {item['fov']} and {axis!r}")
    extent = {"x": width, "y": height, "diagonal": math.hypot(width, height)}
    extent |= {"smaller": min(width, height), "larger": max(width, height)}
    angle = 2 * math.atan(half * height / extent[axis])
    matrix = transform(item.get("to_world"), f"to_world of {name}")
    eye, up, forward = matrix[:3, 3], matrix[:3, 1], matrix[:3, 2]
    target = eye + forward / (np.linalg.norm(forward) or 1.0) * (np.linalg.norm(eye) or 1.0)
    return Camera(eye, target, up, angle, width, height)


def _environment(name: str, item: Mapping[str, Any]) -> Environment:
    """Distant light from an emitter."""
    if item["type"] == "constant":
        color = rgb(item.get("radiance", 1.0), f"radiance of {name}")
        return Environment(jnp.asarray(np.broadcast_to(color, (6, 1, 1, 3)), jnp.float32))
    if "filename" not in item:
        raise ValueError(f"{name} must have a filename, got {', '.join(item)}")
    light = environment.load_environment(item["filename"])
    turned = transform(item.get("to_world"), f"to_world of {name}")[:3, :3]
    if not np.allclose(turned @ turned.T, np.eye(3), rtol=0, atol=1e-4) or np.linalg.det(turned) < 0:
        raise ValueError(f"to_world of {name} must be a pure rotation, got {turned.tolist()}")
    if not np.allclose(turned, np.eye(3), rtol=0, atol=1e-7):
        light = environment.rotate(light, jnp.asarray(turned, jnp.float32))
    return eqx.tree_at(lambda each: each.radiance, light, light.radiance * float(item.get("scale", 1.0)))
