"""Scenes from dictionaries in the form of `mitsuba.load_dict` (Mitsuba 3). Mitsuba itself is not needed.

BSDFs become equal or similar metallic-roughness materials. `diffuse` is converted exactly. `conductor` and
`roughconductor` (GGX) differ only by Schlick's approximation of Fresnel's equations. `principled` (without its further
lobes) is approximated, because its diffuse part is not Lambertian. `plastic` and `roughplastic` are approximated,
because Mitsuba includes multiple scattering below the surface.

References in comments are to the plugin reference of Mitsuba 3, https://mitsuba.readthedocs.io.
"""

import math
import pathlib
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxprt.files import images
from jaxprt.scene import environment
from jaxprt.scene.camera import Camera
from jaxprt.scene.environment import Environment
from jaxprt.scene.formats import mesh_file
from jaxprt.scene.formats.file_parts import split_parts, warn_of_ignored
from jaxprt.scene.formats.geometry import Geometry, place
from jaxprt.scene.material import Texture, TexturedMaterial
from jaxprt.scene.mesh import grid_face
from jaxprt.scene.scene import Part, Scene

FLIP = np.array([[1.0, 0, 0], [0, -1, 1], [0, 0, 1]])  # converts between v up and v down
_LUMINANCE = np.array([0.212671, 0.715160, 0.072169])  # Rec. 709 weights of Mitsuba's textures
_WRAPPERS = {"twosided", "mask", "bumpmap", "normalmap"}
_MAKERS = {"diffuse", "principled", "conductor", "roughconductor", "plastic", "roughplastic"}
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


def rgb(value: Any, name: str) -> np.ndarray:
    """A color [3] from a number, three numbers, or a dictionary of type rgb, srgb, uniform or spectrum.

    Raises:
        ValueError: The value has another form or is not finite.
    """
    if isinstance(value, Mapping):
        inner = value.get("value", value.get("color"))
        if value.get("type") not in ("rgb", "srgb", "uniform", "spectrum") or isinstance(inner, Mapping | str):
            raise ValueError(f"{name} must be a number, a color, or a texture of the type bitmap, got {dict(value)}")
        value = inner
    color = np.asarray(value).squeeze()
    if color.dtype.kind not in "iuf" or color.shape not in ((), (3,)) or not np.isfinite(color).all():
        raise ValueError(f"{name} must be a finite number or color, got {value!r}")
    return np.broadcast_to(color.astype(np.float64), (3,))


class MaterialMaker:
    """Converts BSDFs in the dictionary of a scene to materials. Records unsupported parameters."""

    def __init__(self, scene: Mapping[str, Any], ignored: set[str]):
        self._scene, self._ignored = scene, ignored

    @staticmethod
    def knows(kind: str) -> bool:
        """Whether a plugin type is a BSDF or texture, which is read only if a shape refers to it."""
        return kind in _MAKERS | _WRAPPERS | {"bitmap", "rgb", "ref"}

    def of_shape(self, name: str, item: Mapping[str, Any]) -> TexturedMaterial:
        """The material of a shape, including its emission. Without a BSDF it is Mitsuba's default gray of 0.5.

        Raises:
            ValueError: The BSDF has an unsupported type, or a reference is missing.
        """
        field: dict[str, Any] = {"base_color": 0.5, "metallic": 0.0, "specular": 0.0}
        for key, value in item.items():
            plugin = self._resolved(value, name)
            if plugin is None:
                continue
            if plugin.get("type") == "area":
                field["emissive"] = rgb(plugin.get("radiance", 1.0), f"radiance of {name}")
            elif key != "to_world":
                emissive = {"emissive": field["emissive"]} if "emissive" in field else {}
                field = self._field(plugin, f"{key} of {name}") | emissive
        try:
            return TexturedMaterial(**field)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error

    def _resolved(self, item: Any, name: str) -> Mapping[str, Any] | None:
        """A nested dictionary, or the dictionary of the scene that it refers to."""
        if not isinstance(item, Mapping):
            return None
        if item.get("type") != "ref":
            return item
        target = self._scene.get(str(item.get("id")))
        if not isinstance(target, Mapping):
            raise ValueError(f"{name} must refer to something in the scene, got {item.get('id')!r}")
        return target

    def _field(self, item: Mapping[str, Any], name: str) -> dict[str, Any]:
        """Factors and textures of the material for a BSDF."""
        kind = str(item.get("type"))
        if kind in _WRAPPERS:
            wrapped: dict[str, Any] = {}
            if kind == "twosided":
                wrapped = {"back": "lit"}
            elif kind == "mask":
                wrapped = {"alpha_mode": "blend"} | self._opacity(item, name)
            else:
                self._ignored.add(f"{kind} in {name}")
            for value in item.values():
                inner = self._resolved(value, name)
                if inner is not None and inner.get("type") in _MAKERS | _WRAPPERS:
                    return self._field(inner, name) | wrapped
        if kind not in _MAKERS:
            raise ValueError(f"{name} must be one of {', '.join(sorted(_MAKERS | _WRAPPERS))}, got {kind!r}")
        return {
            "diffuse": self._diffuse,
            "principled": self._principled,
            "conductor": self._conductor,
            "roughconductor": self._conductor,
            "plastic": self._plastic,
            "roughplastic": self._plastic,
        }[kind](item, name)

    def _opacity(self, item: Mapping[str, Any], name: str) -> dict[str, Any]:
        """The share of light that a `mask` stops. Colors count by their mean, bitmaps by their luminance."""
        value = self._resolved(item.get("opacity"), name)
        if value is not None and value.get("type") == "bitmap":
            return {"alpha_texture": self._texture(value, f"opacity of {name}", colors=False)}
        return {
            "alpha": float(np.mean(rgb(item.get("opacity", 0.5) if value is None else value, f"opacity of {name}")))
        }

    def _diffuse(self, item: Mapping[str, Any], name: str) -> dict[str, Any]:
        self._rest(item, name, {"reflectance"})
        return {"metallic": 0.0, "specular": 0.0} | self._color(item, "reflectance", 0.5, name)

    def _principled(self, item: Mapping[str, Any], name: str) -> dict[str, Any]:
        """Converts `principled`. Alpha along and across the tangent equals Mitsuba's, including anisotropy."""
        self._rest(item, name, {"base_color", "metallic", "roughness", "specular", "eta", "anisotropic"})
        field = self._color(item, "base_color", 0.5, name)
        field |= self._scalar(item, "metallic", 0.0, name) | self._scalar(item, "roughness", 0.5, name)
        field["ior"] = float(item.get("eta", 1.5))
        if "specular" in item:
            field["ior"] = 2 / (1 - math.sqrt(0.08 * float(item["specular"]))) - 1
        stretch = float(item.get("anisotropic", 0.0))
        if stretch and "roughness_texture" in field:
            self._ignored.add(f"anisotropic of {name}, whose roughness has a texture")
        elif stretch:
            aspect = math.sqrt(1 - 0.9 * stretch)
            field |= _roughness_and_anisotropy(field["roughness"] ** 2 / aspect, field["roughness"] ** 2 * aspect)
        return field

    def _conductor(self, item: Mapping[str, Any], name: str) -> dict[str, Any]:
        self._rest(
            item, name, {"eta", "k", "specular_reflectance", "alpha", "alpha_u", "alpha_v", "distribution", "material"}
        )
        if "eta" in item and "k" in item:
            eta, k = rgb(item["eta"], f"eta of {name}"), rgb(item["k"], f"k of {name}")
            reflectance = ((eta - 1) ** 2 + k**2) / ((eta + 1) ** 2 + k**2)
        elif item.get("material") == "none":
            reflectance = np.ones(3)
        else:
            raise ValueError(f"{name} must have eta and k or the material 'none', got {item.get('material', 'Cu')!r}")
        field = self._color(item, "specular_reflectance", 1.0, name)
        field["base_color"] = np.minimum(field["base_color"] * reflectance, 1)
        if item["type"] == "conductor":
            return field | {"metallic": 1.0, "roughness": 0.0}
        if item.get("distribution", "beckmann") != "ggx":
            self._ignored.add(f"distribution beckmann of {name}")
        alpha = [self._alpha(item.get(key, item.get("alpha", 0.1)), name) for key in ("alpha_u", "alpha_v")]
        if alpha[0] < alpha[1]:  # the direction of anisotropy is that of the larger alpha
            return field | {"metallic": 1.0, "rotation": math.pi / 2} | _roughness_and_anisotropy(alpha[1], alpha[0])
        return field | {"metallic": 1.0} | _roughness_and_anisotropy(*alpha)

    def _plastic(self, item: Mapping[str, Any], name: str) -> dict[str, Any]:
        known = {"diffuse_reflectance", "int_ior", "ext_ior", "alpha", "distribution", "nonlinear"}
        self._rest(item, name, known)
        ratio = [float(item.get(key, default)) for key, default in (("int_ior", 1.49), ("ext_ior", 1.000277))]
        alpha = self._alpha(item.get("alpha", 0.1), name) if item["type"] == "roughplastic" else 0.0
        field = self._color(item, "diffuse_reflectance", 0.5, name)
        return field | {"metallic": 0.0, "roughness": math.sqrt(alpha), "ior": ratio[0] / ratio[1]}

    def _rest(self, item: Mapping[str, Any], name: str, known: set[str]) -> None:
        """Records unsupported parameters, unless they are zero."""
        for key in item.keys() - known - {"type", "id"}:
            value = item[key]
            if isinstance(value, Mapping | str) or np.any(np.asarray(value) != 0):
                self._ignored.add(f"{key} of {name}")

    def _alpha(self, value: Any, name: str) -> float:
        if isinstance(value, Mapping) or not 0 <= float(value) <= 1:
            raise ValueError(f"alpha of {name} must be a number between 0 and 1, got {value!r}")
        return float(value)

    def _color(self, item: Mapping[str, Any], key: str, default: float, name: str) -> dict[str, Any]:
        value = self._resolved(item.get(key), name)
        if value is not None and value.get("type") == "bitmap":
            return {
                "base_color": np.ones(3),
                "base_color_texture": self._texture(value, f"{key} of {name}", colors=True),
            }
        return {"base_color": rgb(item.get(key, default) if value is None else value, f"{key} of {name}")}

    def _scalar(self, item: Mapping[str, Any], key: str, default: float, name: str) -> dict[str, Any]:
        value = self._resolved(item.get(key), name)
        if value is not None and value.get("type") == "bitmap":
            return {key: 1.0, f"{key}_texture": self._texture(value, f"{key} of {name}", colors=False)}
        return {key: float(rgb(item.get(key, default) if value is None else value, f"{key} of {name}")[0])}

    def _texture(self, item: Mapping[str, Any], name: str, *, colors: bool) -> Texture:
        """A texture from a bitmap. Unless `colors`, its luminance is used."""
        if "filename" not in item:
            raise ValueError(f"{name} must have a filename, got {', '.join(item)}")
        with open(item["filename"], "rb") as file:
            content = file.read()
        decoded = not item.get("raw", False)
        image = images.decode_image(content, name=str(item["filename"]), decoded=decoded)
        image = image[..., :3] if image.shape[-1] > 2 else np.repeat(image[..., :1], 3, -1)
        if not colors:
            image = (image @ _LUMINANCE)[..., None].astype(np.float32)
        if item.get("filter_type", "bilinear") != "bilinear":
            self._ignored.add(f"filter_type {item['filter_type']} (textures are interpolated)")
        matrix = np.eye(3)
        if item.get("to_uv") is not None:
            matrix = np.squeeze(np.asarray(getattr(item["to_uv"], "matrix", item["to_uv"]), np.float64))
            if matrix.shape == (4, 4):
                matrix = matrix[np.ix_([0, 1, 3], [0, 1, 3])]
            if matrix.shape != (3, 3):
                raise ValueError(f"to_uv of {name} must be a 3 x 3 matrix, got {item['to_uv']!r}")
        moved = (FLIP @ matrix @ FLIP)[:2].astype(np.float32)
        wrap = item.get("wrap_mode", "repeat")
        return Texture(jnp.asarray(image), moved, 0, (wrap, wrap))


def _roughness_and_anisotropy(along: float, across: float) -> dict[str, float]:
    """Roughness and anisotropy from alpha along and across the direction of anisotropy; along >= across.

    KHR_materials_anisotropy defines alpha_t = mix(alpha, 1, anisotropy^2) along and alpha_b = alpha across.
    """
    along = min(along, 1.0)
    square = (along - across) / (1 - across) if across < 1 else 0.0
    return {"roughness": math.sqrt(across), "anisotropy": math.sqrt(max(square, 0.0))}


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
    warn_of_ignored("the dictionary", ignored, stacklevel=3)
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
    geometry = place(geometry, transform(item.get("to_world"), f"to_world of {name}"))
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
    return Geometry(*(np.concatenate(rows) for rows in (position, faces, normal)), texture=np.concatenate(texture))


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
    film = next(
        (value for value in item.values() if isinstance(value, Mapping) and "film" in str(value.get("type"))), {}
    )
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
    return eqx.tree_at(lambda e: e.radiance, light, light.radiance * float(item.get("scale", 1.0)))
