"""Scenes from dictionaries in the form of `mitsuba.load_dict` (Mitsuba 3). Mitsuba itself is not needed.

BSDFs become equal or similar metallic-roughness materials. `diffuse` is converted exactly. `conductor` and
`roughconductor` (GGX) differ only by Schlick's approximation of Fresnel's equations. `principled` (without its further
lobes) is approximated, because its diffuse part is not Lambertian. `plastic` and `roughplastic` are approximated,
because Mitsuba includes multiple scattering below the surface.

References in comments are to the plugin reference of Mitsuba 3, https://mitsuba.readthedocs.io.
"""

import math
import os
import pathlib
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxprt import require
from jaxprt.files import images, inputs
from jaxprt.scene import environment
from jaxprt.scene.camera import Camera
from jaxprt.scene.environment import Environment
from jaxprt.scene.formats import mesh_file
from jaxprt.scene.formats.file_parts import FLIP, split_parts, warn_of_ignored
from jaxprt.scene.formats.geometry import Geometry, place
from jaxprt.scene.material import Fields, Texture, TexturedMaterial
from jaxprt.scene.mesh import grid_face
from jaxprt.scene.scene import Part, Scene

Plugin = Mapping[str, Any]  # a dictionary of `mitsuba.load_dict`, whose values are parameters and other plugins

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
_DISTRIBUTIONS = ("beckmann", "ggx")
_WRAPS = ("repeat", "mirror", "clamp")
_AXES = ("x", "y", "diagonal", "smaller", "larger")  # of a field of view
_DEEPEST = 16  # BSDFs that hold each other
_LAST_ROW = 1e-6
_AREA = 1e-12  # of the largest triangle, relative to the square of the extent of a shape
# Parameters that are read, or do not change the picture, by plugin. Others are recorded as ignored.
_OF_SHAPES = {"to_world", "flip_normals", "silhouette_sampling_weight"}
_OF_MESHES = _OF_SHAPES | {"filename", "face_normals", "flip_tex_coords"}
_OF_METALS = {"eta", "k", "specular_reflectance", "material"}
_OF_PLASTICS = {"diffuse_reflectance", "int_ior", "ext_ior"}
_OF_SENSORS = {"fov", "fov_axis", "focal_length", "to_world", "near_clip", "far_clip", "shutter_open", "shutter_close"}
_PARAMETERS = {
    "obj": _OF_MESHES,
    "ply": _OF_MESHES,
    "sphere": _OF_SHAPES | {"center", "radius"},
    "rectangle": _OF_SHAPES,
    "cube": _OF_SHAPES,
    "area": {"radiance"},
    "diffuse": {"reflectance"},
    "principled": {"base_color", "metallic", "roughness", "specular", "eta", "anisotropic"},
    "conductor": _OF_METALS,
    "roughconductor": _OF_METALS | {"alpha", "alpha_u", "alpha_v", "distribution"},
    "plastic": _OF_PLASTICS,
    "roughplastic": _OF_PLASTICS | {"alpha", "distribution"},
    "mask": {"opacity"},
    "bumpmap": {"scale"},
    "bitmap": {"filename", "raw", "filter_type", "wrap_mode", "to_uv", "accel", "format"},
    "perspective": _OF_SENSORS,
    "thinlens": _OF_SENSORS | {"aperture_radius", "focus_distance"},
    "envmap": {"filename", "scale", "to_world", "mis_compensation"},
    "constant": {"radiance", "to_world"},
    "film": {"width", "height", "file_format", "pixel_format", "component_format", "banner", "compensate"}
    | {"sample_border", "high_quality_edges"},
}
_SENSORS = {"perspective", "thinlens"}
_EMITTERS = {"envmap", "constant"}
_HOLDERS = {*_SHAPES, *_WRAPPERS, *_SENSORS, "film"}  # Names that are not in the table are those of plugins,
_NUMBERS = ("principal_point_offset_", "crop_")  # or start like these.
# Plugins that control how a picture is computed, not what it shows.
_SILENT = {"path", "direct", "volpath", "volpathmis", "ptracer", "aov", "prb", "prb_basic", "direct_projective"}
_SILENT |= {"prb_projective", "independent", "multijitter", "orthogonal", "stratified", "ldsampler", "moment", "depth"}


def rgb(value: object, name: str) -> np.ndarray:
    """A color [3] from a number, three numbers, or a dictionary of type rgb, srgb, uniform or spectrum."""
    if isinstance(value, Mapping):
        inner = value.get("value", value.get("color"))
        if value.get("type") not in ("rgb", "srgb", "uniform", "spectrum") or isinstance(inner, Mapping | str):
            raise ValueError(
                f"{name} must be a number, a color, or a texture of the type bitmap, got {require.shown(value)}"
            )
        if value.keys() - {"type", "id", "value"} - ({"color"} if "value" not in value else set()):
            raise ValueError(f"{name} must have a type and a value alone, got {', '.join(map(str, value))}")
        value = inner
    color = _array(value)
    if color is None or color.shape not in ((), (3,)):
        raise ValueError(f"{name} must be a finite number or color, got {require.shown(value)}")
    return np.broadcast_to(color, (3,))


def _array(value: object) -> np.ndarray | None:
    """Finite numbers as an array without axes of length 1; None for other values."""
    if require.unreal(value):
        return None
    array = np.squeeze(np.asarray(value))
    return array.astype(np.float64) if np.all(np.abs(array) <= require.LARGEST) else None


def _refused(check: Callable, *arguments: Any, **options: Any) -> None:
    """A check of arguments, for values of a dictionary: those of a wrong type raise ValueError too."""
    try:
        check(*arguments, **options)
    except TypeError as error:
        raise ValueError(str(error)) from error


def _number(item: Plugin, key: str, default: float, name: str, low: float, **options: Any) -> float:
    """A parameter that is one number, within the range of `require.number`."""
    value = item.get(key, default)
    _refused(require.number, f"{key} of {name}", value, low, **options)
    return float(value)


def _flag(item: Plugin, key: str, default: bool, name: str) -> bool:
    value = item.get(key, default)
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{key} of {name} must be True or False, got {require.shown(value)}")
    return bool(value)


def _word(item: Plugin, key: str, name: str, words: tuple[str, ...]) -> str:
    """A parameter that is one of some words, the first by default."""
    value = item.get(key, words[0])
    if not isinstance(value, str) or value not in words:
        raise ValueError(f"{key} of {name} must be one of {', '.join(words)}, got {require.shown(value)}")
    return value


def _file(item: Plugin, name: str) -> pathlib.Path:
    if "filename" not in item:
        raise ValueError(f"{name} must have a filename, got {', '.join(map(str, item))}")
    _refused(require.path, f"filename of {name}", item["filename"])
    return pathlib.Path(os.fspath(item["filename"]))


def _kind(item: Plugin, name: str) -> str:
    """The type of a plugin."""
    kind = item.get("type")
    if not isinstance(kind, str):
        raise ValueError(f"{name} must have a type, as text, got {require.shown(kind)}")
    return kind


class MaterialMaker:
    """Converts BSDFs in the dictionary of a scene to materials. Records unsupported parameters."""

    def __init__(self, scene: Plugin, ignored: set[str]):
        self._scene, self._ignored = scene, ignored

    @staticmethod
    def knows(kind: str) -> bool:
        """Whether a plugin type is a BSDF or texture, which is read only if a shape refers to it."""
        return kind in _MAKERS | _WRAPPERS | {"bitmap", "rgb", "ref"}

    def of_shape(self, name: str, item: Plugin) -> TexturedMaterial:
        """The material of a shape, including its emission. Without a BSDF it is Mitsuba's default gray of 0.5."""
        emitted, fields = [], []
        for key, plugin in self.plugins(item, name).items():
            if plugin["type"] == "area":
                self.rest(plugin, f"{key} of {name}")
                emitted.append({"emissive": rgb(plugin.get("radiance", 1.0), f"radiance of {name}")})
            else:
                fields.append(self._field(plugin, f"{key} of {name}"))
        if len(emitted) > 1 or len(fields) > 1:
            raise ValueError(f"{name} must have at most one BSDF and one emitter, got {len(fields)} and {len(emitted)}")
        plain = {"base_color": 0.5, "metallic": 0.0, "specular": 0.0}
        try:
            return TexturedMaterial(**(fields or [plain])[0], **(emitted or [{}])[0])
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error

    def plugins(self, item: Plugin, name: str, kind: str = "") -> dict[str, Plugin]:
        """Plugins that a plugin holds. Records its parameters that are not read, unless they are zero.

        `kind` is the entry of the table of parameters, if it is not the type.
        """
        kind, result = kind or item["type"], {}
        for key, value in item.items():
            if key in _PARAMETERS.get(kind, ()) or key in ("type", "id"):
                continue
            plugin = self._resolved(value, f"{key} of {name}")
            numbers = isinstance(value, bool | np.bool_) or not require.unreal(value)
            if plugin is not None:
                result[key] = plugin
            elif not numbers or (kind in _HOLDERS and not str(key).startswith(_NUMBERS)):
                raise ValueError(f"{key} of {name} must be a dictionary with a type, got {require.shown(value)}")
            elif np.any(np.asarray(value) != 0):
                self._ignored.add(f"{key} of {name}")
        return result

    def rest(self, item: Plugin, name: str) -> None:
        """Records all that is not read of a plugin that holds no others."""
        self._ignored |= {f"{key} of {name}" for key in self.plugins(item, name)}

    def _resolved(self, item: Any, name: str) -> Plugin | None:
        """A nested dictionary, or the dictionary of the scene that it refers to; None for other values."""
        if not isinstance(item, Mapping):
            return None
        if _kind(item, name) != "ref":
            return item
        target = self._scene.get(str(item.get("id")))
        if not isinstance(target, Mapping) or _kind(target, str(item.get("id"))) == "ref":
            raise ValueError(f"{name} must refer to something in the scene, got {require.shown(item.get('id'))}")
        return target

    def _field(self, item: Plugin, name: str, depth: int = 1) -> Fields:
        """Factors and textures of the material for a BSDF, which `depth - 1` others hold."""
        kind = item["type"]
        if depth > _DEEPEST:
            raise ValueError(
                f"{name} must hold at most {_DEEPEST} BSDFs in each other, got more, or one that holds itself"
            )
        if kind in _WRAPPERS:
            return self._wrapped(item, name, depth)
        if kind not in _MAKERS:
            raise ValueError(f"{name} must be one of {', '.join(sorted(_MAKERS | _WRAPPERS))}, got {kind!r}")
        self.rest(item, name)
        return {
            "diffuse": self._diffuse,
            "principled": self._principled,
            "conductor": self._conductor,
            "roughconductor": self._conductor,
            "plastic": self._plastic,
            "roughplastic": self._plastic,
        }[kind](item, name)

    def _wrapped(self, item: Plugin, name: str, depth: int) -> Fields:
        """Factors and textures for a BSDF that holds another."""
        kind, inner = item["type"], []
        for key, plugin in self.plugins(item, name).items():
            if plugin["type"] in _MAKERS | _WRAPPERS:
                inner.append(plugin)
            elif kind in ("twosided", "mask"):
                self._ignored.add(f"{key} of {name}")
        if not inner:
            raise ValueError(f"{name} must hold a BSDF, got {', '.join(map(str, item))}")
        if len(inner) > 1:
            self._ignored.add(f"the second BSDF of {name}")
        wrapped: Fields = {}
        if kind == "twosided":
            wrapped = {"back": "lit"}
        elif kind == "mask":
            wrapped = {"alpha_mode": "blend"} | self._opacity(item, name)
        else:
            self._ignored.add(f"{kind} in {name}")
        field = self._field(inner[0], name, depth + 1)
        if kind == "mask" and "alpha_mode" in field:  # a mask in a mask: opacities multiply
            if "alpha_texture" in field and "alpha_texture" in wrapped:
                raise ValueError(f"{name} must have one opacity with a bitmap, got one in another")
            wrapped["alpha"] = wrapped.get("alpha", 1.0) * field.get("alpha", 1.0)
        return field | wrapped

    def _opacity(self, item: Plugin, name: str) -> Fields:
        """The share of light that a `mask` stops. Colors count by their mean, bitmaps by their luminance."""
        value = self._resolved(item.get("opacity"), f"opacity of {name}")
        if value is not None and value.get("type") == "bitmap":
            return {"alpha_texture": self._texture(value, f"opacity of {name}", colors=False)}
        return {
            "alpha": float(np.mean(rgb(item.get("opacity", 0.5) if value is None else value, f"opacity of {name}")))
        }

    def _diffuse(self, item: Plugin, name: str) -> Fields:
        return {"metallic": 0.0, "specular": 0.0} | self._color(item, "reflectance", 0.5, name)

    def _principled(self, item: Plugin, name: str) -> Fields:
        """Converts `principled`. Alpha along and across the tangent equals Mitsuba's, including anisotropy."""
        field = self._color(item, "base_color", 0.5, name)
        field |= self._scalar(item, "metallic", 0.0, name) | self._scalar(item, "roughness", 0.5, name)
        field["ior"] = _number(item, "eta", 1.5, name, 1.0)
        if "specular" in item:
            if "eta" in item:
                raise ValueError(f"{name} must have specular or eta, got both")
            field["ior"] = 2 / (1 - math.sqrt(0.08 * _number(item, "specular", 0.5, name, 0.0, high=1.0))) - 1
        stretch = _number(item, "anisotropic", 0.0, name, 0.0, high=1.0)
        if stretch and "roughness_texture" in field:
            self._ignored.add(f"anisotropic of {name}, whose roughness has a texture")
        elif stretch:
            aspect = math.sqrt(1 - 0.9 * stretch)
            field |= _roughness_and_anisotropy(field["roughness"] ** 2 / aspect, field["roughness"] ** 2 * aspect)
        return field

    def _conductor(self, item: Plugin, name: str) -> Fields:
        material = item.get("material", "Cu")
        if "eta" in item and "k" in item and "material" not in item:
            eta, k = rgb(item["eta"], f"eta of {name}"), rgb(item["k"], f"k of {name}")
            if min(eta.min(), k.min()) < 0:
                raise ValueError(f"{name} must have eta and k of at least 0, got {eta.tolist()} and {k.tolist()}")
            reflectance = ((eta - 1) ** 2 + k**2) / ((eta + 1) ** 2 + k**2)
        elif {"eta", "k"}.isdisjoint(item) and isinstance(material, str) and material == "none":
            reflectance = np.ones(3)
        else:
            raise ValueError(f"{name} must have eta and k or the material 'none', got {material!r}")
        field = self._color(item, "specular_reflectance", 1.0, name)
        field["base_color"] = field["base_color"] * reflectance
        if item["type"] == "conductor":
            return field | {"metallic": 1.0, "roughness": 0.0}
        if _word(item, "distribution", name, _DISTRIBUTIONS) != "ggx":
            self._ignored.add(f"distribution beckmann of {name}")
        both = _number(item, "alpha", 0.1, name, 0.0, high=1.0)
        alpha = [_number(item, key, both, name, 0.0, high=1.0) for key in ("alpha_u", "alpha_v")]
        if alpha[0] < alpha[1]:  # the direction of anisotropy is that of the larger alpha
            return field | {"metallic": 1.0, "rotation": math.pi / 2} | _roughness_and_anisotropy(alpha[1], alpha[0])
        return field | {"metallic": 1.0} | _roughness_and_anisotropy(*alpha)

    def _plastic(self, item: Plugin, name: str) -> Fields:
        outer = _number(item, "ext_ior", 1.000277, name, 0.0, above=True)
        ratio = _number(item, "int_ior", 1.49, name, 0.0, above=True) / outer
        alpha = 0.0
        if item["type"] == "roughplastic":
            alpha = _number(item, "alpha", 0.1, name, 0.0, high=1.0)
            if _word(item, "distribution", name, _DISTRIBUTIONS) != "ggx":
                self._ignored.add(f"distribution beckmann of {name}")
        field = self._color(item, "diffuse_reflectance", 0.5, name)
        return field | {"metallic": 0.0, "roughness": math.sqrt(alpha), "ior": ratio}

    def _color(self, item: Plugin, key: str, default: float, name: str) -> Fields:
        value = self._resolved(item.get(key), f"{key} of {name}")
        if value is not None and value.get("type") == "bitmap":
            return {
                "base_color": np.ones(3),
                "base_color_texture": self._texture(value, f"{key} of {name}", colors=True),
            }
        return {"base_color": rgb(item.get(key, default) if value is None else value, f"{key} of {name}")}

    def _scalar(self, item: Plugin, key: str, default: float, name: str) -> Fields:
        value = self._resolved(item.get(key), f"{key} of {name}")
        if value is not None and value.get("type") == "bitmap":
            return {key: 1.0, f"{key}_texture": self._texture(value, f"{key} of {name}", colors=False)}
        color = rgb(item.get(key, default) if value is None else value, f"{key} of {name}")
        if np.ptp(color):
            raise ValueError(f"{key} of {name} must be one number or a bitmap, got the color {color.tolist()}")
        return {key: float(color[0])}

    def _texture(self, item: Plugin, name: str, *, colors: bool) -> Texture:
        """A texture from a bitmap. Unless `colors`, its luminance is used."""
        self.rest(item, name)
        path, decoded = _file(item, name), not _flag(item, "raw", False, name)
        wrap = _word(item, "wrap_mode", name, _WRAPS)
        if _word(item, "filter_type", name, ("bilinear", "nearest")) != "bilinear":
            self._ignored.add("filter_type nearest (textures are interpolated)")
        matrix = transform(item.get("to_uv"), f"to_uv of {name}", sizes=(3, 4))
        if matrix.shape == (4, 4):
            matrix = matrix[np.ix_([0, 1, 3], [0, 1, 3])]
        image = images.decode_image(inputs.content(path, f"the bitmap of {name}"), name=str(path), decoded=decoded)
        image = image[..., :3] if image.shape[-1] > 2 else np.repeat(image[..., :1], 3, -1)
        if not colors:
            image = (image @ _LUMINANCE)[..., None].astype(np.float32)
        moved = (FLIP @ matrix @ FLIP)[:2].astype(np.float32)
        return Texture(jnp.asarray(image), moved, 0, (wrap, wrap))


def _roughness_and_anisotropy(along: float, across: float) -> dict[str, float]:
    """Roughness and anisotropy from alpha along and across the direction of anisotropy; along >= across."""
    along = min(along, 1.0)
    # KHR_materials_anisotropy defines alpha_t = mix(alpha, 1, anisotropy^2) along and alpha_b = alpha across.
    square = (along - across) / (1 - across) if across < 1 else 0.0
    return {"roughness": math.sqrt(across), "anisotropy": math.sqrt(max(square, 0.0))}


def read(scene: Plugin) -> Scene:
    """Reads the scene of a dictionary, as `load_scene` documents.

    It may refer to files in any folder: unlike a scene file, a dictionary is written by the caller.
    """
    if scene.get("type") != "scene":
        raise ValueError(f"a dictionary of Mitsuba must have the type 'scene', got {scene.get('type')!r}")
    ignored: set[str] = set()
    materials = MaterialMaker(scene, ignored)
    parts, cameras, lights = [], [], []
    for name, item in scene.items():
        if not isinstance(name, str):
            raise ValueError(f"names in a scene must be text, got {require.shown(name)}")
        if not isinstance(item, Mapping):
            if name != "type":
                raise ValueError(f"{name} must be a dictionary, got one of class {type(item).__name__}")
            continue
        kind = _kind(item, name)
        if kind in _SHAPES:
            parts.append(_part(name, item, materials))
        elif kind in _SENSORS:
            cameras.append(_camera(name, item, materials, ignored))
        elif kind in _EMITTERS:
            materials.rest(item, name)
            lights.append(_environment(name, item))
        elif kind in _SILENT:
            ignored |= {f"hide_emitters of {name}"} if item.get("hide_emitters") else set()
        elif not MaterialMaker.knows(kind):
            ignored.add(f"{name} ({kind})")
    warn_of_ignored("the dictionary", ignored, stacklevel=3)
    return Scene(parts, cameras, lights)


def transform(value: object, name: str, *, sizes: tuple[int, ...] = (4,)) -> np.ndarray:
    """A transform, [4 4] or of another size, from an array, lists or an object with a `matrix`; None: the identity."""
    if value is None:
        return np.eye(4)
    matrix = _array(getattr(value, "matrix", value))
    if matrix is None or matrix.shape not in [(size, size) for size in sizes]:
        required = " or ".join(f"{size} x {size}" for size in sizes)
        raise ValueError(
            f"{name} must be a finite {required} matrix or have one as its `matrix`, got {require.shown(value)}"
        )
    if np.abs(matrix[-1] - np.eye(len(matrix))[-1]).max() > _LAST_ROW:
        raise ValueError(f"the last row of {name} must be zeros and 1, got {matrix[-1].tolist()}")
    return matrix


def _rotation(matrix: np.ndarray, name: str) -> np.ndarray:
    """The linear part of a transform that turns and moves."""
    turned = matrix[:3, :3]
    if not np.allclose(turned @ turned.T, np.eye(3), rtol=0, atol=1e-4) or np.linalg.det(turned) < 0:
        raise ValueError(f"{name} must be a pure rotation, apart from its position, got {turned.tolist()}")
    return turned


def _part(name: str, item: Plugin, materials: MaterialMaker) -> Part:
    """A shape with its material."""
    kind = item["type"]
    path = pathlib.Path(name)
    if kind in _MESHES:
        path = _file(item, name)
        if path.suffix.lower() != _MESHES[kind]:
            raise ValueError(f"the filename of {name} must end in {_MESHES[kind]}, got {str(path)!r}")
        geometry = mesh_file.read(path, groups=False)
        # OBJ files have v up, images v down. Mitsuba flips v for OBJ files, but not for PLY files.
        if not _flag(item, "flip_tex_coords", kind == "obj", name) and geometry.texture is not None:
            geometry = geometry._replace(texture=[[0, 1]] + geometry.texture * [[1, -1]])
        if _flag(item, "face_normals", False, name):
            geometry = _flat(geometry)
    else:
        geometry = {"rectangle": _rectangle, "cube": _cube, "sphere": _sphere}[kind](name, item)
    matrix = transform(item.get("to_world"), f"to_world of {name}")
    geometry = place(geometry, matrix)
    area = np.linalg.norm(_normals(geometry.position[geometry.face]), axis=1).max(initial=0)
    if item.get("to_world") is not None and area <= _AREA * np.ptp(geometry.position, axis=0).max() ** 2:
        raise ValueError(f"to_world of {name} must leave the shape an area, got {matrix.tolist()}")
    if _flag(item, "flip_normals", False, name):
        normal = None if geometry.normal is None else -geometry.normal
        geometry = geometry._replace(face=geometry.face[:, ::-1], normal=normal)
    geometry = geometry._replace(region=np.zeros(len(geometry.position), int))
    return split_parts(geometry, [name], [materials.of_shape(name, item)], path)[0]


def _normals(corner: np.ndarray) -> np.ndarray:
    """Normals of triangles, [f 3 3], twice as long as the area."""
    return np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])


def _flat(geometry: Geometry) -> Geometry:
    """Separate triangles with flat normals."""
    corner = geometry.position[geometry.face]
    normal = _normals(corner)
    texture = None if geometry.texture is None else geometry.texture[geometry.face.ravel()]
    face = np.arange(geometry.face.size).reshape(-1, 3)
    return Geometry(corner.reshape(-1, 3), face, np.repeat(normal, 3, 0), texture=texture)


def _grid(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coordinates u and v [n 1] of a grid, and faces whose front is the side to which u x v points."""
    v, u = np.meshgrid(np.linspace(0, 1, rows + 1), np.linspace(0, 1, columns + 1), indexing="ij")
    return u.reshape(-1, 1), v.reshape(-1, 1), grid_face(rows=rows + 1, columns=columns + 1)[:, ::-1]


def _rectangle(name: str, item: Plugin) -> Geometry:
    """A rectangle from -1 to 1 in the plane z = 0, facing +z. As in Mitsuba, the image's first row is at the bottom."""
    u, v, face = _grid(_CELLS, _CELLS)
    position = np.concatenate([2 * u - 1, 2 * v - 1, 0 * u], 1)
    return Geometry(position, face, np.tile([0.0, 0, 1], (len(u), 1)), texture=np.concatenate([u, 1 - v], 1))


def _cube(name: str, item: Plugin) -> Geometry:
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


def _sphere(name: str, item: Plugin) -> Geometry:
    """A sphere around a center. The pole of its texture coordinates is at +z."""
    u, v, face = _grid(_RINGS, 2 * _RINGS)
    sine = np.sin(np.pi * v)
    normal = np.concatenate([np.cos(2 * np.pi * u) * sine, np.sin(2 * np.pi * u) * sine, np.cos(np.pi * v)], 1)
    center, radius = _array(item.get("center", [0, 0, 0])), _number(item, "radius", 1.0, name, 0.0, above=True)
    if center is None or center.shape != (3,):
        raise ValueError(f"center of {name} must be three finite numbers, got {require.shown(item.get('center'))}")
    face = face[np.linalg.norm(_normals(normal[face]), axis=1) > 1e-9][:, ::-1]
    return Geometry(center + radius * normal, face, normal, texture=np.concatenate([u, 1 - v], 1))


def _camera(name: str, item: Plugin, materials: MaterialMaker, ignored: set[str]) -> Camera:
    """A camera from a perspective sensor, which looks along its +z axis."""
    if item["type"] == "thinlens":
        ignored.add(f"the aperture of {name}")
    film: Plugin = {}
    for key, plugin in materials.plugins(item, name).items():
        if "film" in plugin["type"]:
            if film:
                raise ValueError(f"{name} must have one film, got two")
            film = plugin
            materials.plugins(film, f"{key} of {name}", "film")
        elif plugin["type"] not in _SILENT:
            ignored.add(f"{key} of {name}")
    width, height = (film.get(key, default) for key, default in (("width", 768), ("height", 576)))
    for key, value in (("width", width), ("height", height)):
        _refused(require.count, f"{key} of the film of {name}", value, least=1)
    if "fov" not in item or "focal_length" in item:
        raise ValueError(f"{name} must have fov, and no focal_length, got {', '.join(map(str, item))}")
    fov = _number(item, "fov", 0.0, name, 0.0, high=180.0, above=True)
    half, axis = math.tan(math.radians(fov) / 2), _word(item, "fov_axis", name, _AXES)
    extent = {"x": width, "y": height, "diagonal": math.hypot(width, height)}
    extent |= {"smaller": min(width, height), "larger": max(width, height)}
    angle = 2 * math.atan(half * height / extent[axis])
    matrix = transform(item.get("to_world"), f"to_world of {name}")
    eye, (_, up, forward) = matrix[:3, 3], _rotation(matrix, f"to_world of {name}").T
    target = eye + forward * (np.linalg.norm(eye) or 1.0)
    try:
        return Camera(eye, target, up, angle, width, height)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def _environment(name: str, item: Plugin) -> Environment:
    """Distant light from an emitter."""
    turned = transform(item.get("to_world"), f"to_world of {name}")
    if item["type"] == "constant":
        color = rgb(item.get("radiance", 1.0), f"radiance of {name}")
        if color.min() < 0:
            raise ValueError(f"radiance of {name} must be at least 0, got {color.tolist()}")
        return Environment(jnp.asarray(np.broadcast_to(color, (6, 1, 1, 3)), jnp.float32))
    scale = _number(item, "scale", 1.0, name, 0.0)
    turned = _rotation(turned, f"to_world of {name}")
    light = environment.load_environment(_file(item, name))
    if not np.allclose(turned, np.eye(3), rtol=0, atol=1e-7):
        light = environment.rotate(light, jnp.asarray(turned, jnp.float32))
    return eqx.tree_at(lambda e: e.radiance, light, light.radiance * scale)
