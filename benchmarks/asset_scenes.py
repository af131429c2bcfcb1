"""Mitsuba 3 scenes from the surfaces of `benchmarks.asset_files`, in the light of an environment file.

There are two models of a material. "gltf" is the formula of appendix B of the glTF 2.0 specification, by
`benchmarks.plugins`: a Lambertian base under a GGX layer. "principled" is Mitsuba's own BSDF of that name, whose base
is brighter at grazing angles. Both leave the back of a surface black, unless the file says that it has two sides.
Normal maps are Mitsuba's `normalmap`, in the frame of the texture coordinates. Alpha lets light and view through.
"""

import dataclasses
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks import path_tracing, plugins
from benchmarks.asset_files import Map, Material, Surface

MODELS = "gltf", "principled"
_HEIGHT = 1024  # rows of the light, about: texels of the file are boxes
_COLOR = "vertex_color"  # attributes of shapes
_ALPHA = "vertex_alpha"
_PLACES = 4  # along the edge of a pixel, at which sides are looked at


class View:
    """Surfaces that Mitsuba sees from one camera."""

    def __init__(self, surfaces: Sequence[Surface], light: pathlib.Path, camera: Any, *, model: str, bounces: int = 0):
        """Loads the scene.

        Args:
            surfaces: The surfaces.
            light: The environment file.
            camera: A `jaxprt.Camera`.
            model: One of `MODELS`.
            bounces: How often surfaces reflect light onto each other.
        """
        import mitsuba

        mitsuba.set_variant("llvm_ad_rgb" if path_tracing.available() else "scalar_rgb")
        self._mitsuba = mitsuba
        sensor = path_tracing.sensor(mitsuba, camera)
        sensor["film"]["pixel_format"] = "rgba"
        world = {"type": "scene", "sensor": sensor} | emitter(mitsuba, light)
        self._world = mitsuba.load_dict(world | _shapes(mitsuba, surfaces, model))
        covering = all(surface.material.opaque for surface in surfaces)
        paths = {"max_depth": 2 + bounces, "rr_depth": 1000}
        direct = {"type": "volpath", **paths}
        if covering:
            direct = {"type": "path", **paths} if bounces else {"type": "direct"}
        self._hidden = mitsuba.load_dict({**direct, "hide_emitters": True})
        self._dark = None
        if any(surface.material.emissive.any() for surface in surfaces):
            # Where the light is hidden, surfaces that emit are hidden too. Coverage is that of the same surfaces, dark.
            self._dark = mitsuba.load_dict(world | _shapes(mitsuba, [_unlit(surface) for surface in surfaces], model))
            self._shown = mitsuba.load_dict(direct)

    def picture(self, samples: int, seed: int) -> np.ndarray:
        """Radiance and the share that surfaces cover [h w 4]; seeds give independent noise."""
        if self._dark is None:
            return self._render(self._world, self._hidden, samples, seed)
        picture = self._render(self._world, self._shown, samples, seed)
        picture[..., 3] = self._render(self._dark, self._hidden, samples, seed)[..., 3]
        return picture

    def _render(self, world: Any, integrator: Any, samples: int, seed: int) -> np.ndarray:
        number = self._mitsuba.UInt32(seed)
        return np.array(self._mitsuba.render(world, integrator=integrator, spp=samples, seed=number))

    def sides(self) -> tuple[np.ndarray, np.ndarray]:
        """Pixels [h w] that show the back of a surface of one side, and pixels whose radiance is not defined.

        Interpolated normals may look away from an eye that sees the front of a triangle, at silhouettes of smooth
        meshes. There BRDFs are not defined, and Mitsuba is black.
        """
        mitsuba, sensor = self._mitsuba, self._world.sensors()[0]
        width, height = (int(size) for size in sensor.film().size())
        row, column = (np.indices((_PLACES * height, _PLACES * width)).reshape(2, -1) + 0.5) / _PLACES
        place = mitsuba.Point2f(np.float32(column / width), np.float32(row / height))
        ray, _ = sensor.sample_ray(0.0, 0.5, place, mitsuba.Point2f(0.5))
        met = self._world.ray_intersect(ray)
        away, behind = met.wi.z < 0, plugins.modules()[0].dot(met.n, ray.d) > 0
        two_sided = mitsuba.has_flag(met.bsdf().flags(), mitsuba.BSDFFlags.BackSide)
        both = met.is_valid() & away & behind & ~two_sided, met.is_valid() & (away != behind)
        shape = height, _PLACES, width, _PLACES
        back, undefined = (np.asarray(np.array(each).reshape(shape).any((1, 3))) for each in both)
        return back, undefined


def _shapes(mitsuba: Any, surfaces: Sequence[Surface], model: str) -> dict[str, Any]:
    materials: dict[tuple, Any] = {}
    sides = [side for surface in surfaces for side in _sides(surface)]
    return {f"surface{number}": _shape(mitsuba, side, model, materials) for number, side in enumerate(sides)}


def _unlit(surface: Surface) -> Surface:
    """The surface without its light, and nothing of its material but alpha."""
    given = surface.material
    kept = {name: getattr(given, name) for name in ("alpha", "alpha_map", "cutoff", "opaque", "double_sided")}
    return dataclasses.replace(surface, material=Material(**kept))


def emitter(mitsuba: Any, path: pathlib.Path) -> dict[str, Any]:
    """The light of a latitude-longitude file, constant over each of its texels; none if it is black.

    Mitsuba interpolates between texels, and its first and last rows are the poles. Therefore texels are repeated.
    """
    import OpenImageIO

    pixels = OpenImageIO.ImageBuf(str(path)).get_pixels(OpenImageIO.FLOAT)
    if pixels is None:
        raise ValueError(f"the light must be an image that OpenImageIO reads, got {path}")
    pixels = np.maximum(pixels, 0)
    if not pixels.any():
        return {}
    pixels = np.repeat(pixels, 3, -1) if pixels.shape[-1] == 1 else pixels[..., :3]
    height, width = pixels.shape[:2]
    if width != 2 * height:
        raise ValueError(f"the light must be twice as wide as high, got {width} x {height} in {path}")
    rows = max(_HEIGHT, 2 * height)
    row = np.minimum(np.linspace(0, height, rows).astype(int), height - 1)
    column = ((np.arange(2 * rows) + 0.5) / (2 * rows) * width).astype(int)
    bitmap = mitsuba.Bitmap(np.ascontiguousarray(pixels[row][:, column]))
    return {"light": {"type": "envmap", "bitmap": bitmap}}


def _sides(surface: Surface) -> list[Surface]:
    """Triangles whose bitangents are mirrored apart from the others, if there is a normal map.

    Mitsuba's `normalmap` has the bitangent to the left of the tangent. A mirrored triangle has it to the right, so its
    map is read with the opposite green. The file's tangents say which (section 3.7.2.1), or the texture coordinates.
    """
    normal = surface.material.normal_map
    if normal is None or normal.coordinates not in surface.texture:
        return [surface]
    if surface.tangent is not None:
        mirrored = surface.tangent[surface.face[:, 0], 3] < 0
    else:
        a, b, c = (surface.texture[normal.coordinates][surface.face[:, corner]].astype(float) for corner in range(3))
        one, other = b - a, c - a
        mirrored = one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0] > 0  # v is down
    flipped = dataclasses.replace(normal, image=normal.image[..., :3] * [1, -1, 1] + [0, 1, 0])
    material = dataclasses.replace(surface.material, normal_map=flipped)
    parts = [
        dataclasses.replace(surface, face=surface.face[~mirrored]),
        dataclasses.replace(surface, face=surface.face[mirrored], material=material),
    ]
    return [part for part in parts if len(part.face)]


def _shape(mitsuba: Any, surface: Surface, model: str, materials: dict[tuple, Any]) -> Any:
    """Mitsuba's mesh with its material, which surfaces share: Dr.Jit traces each of them."""
    material, normal = surface.material, surface.normal
    key = id(material), surface.color is None, surface.tangent is None, tuple(sorted(surface.texture))
    if key not in materials:
        material_of = _bsdf(mitsuba, surface, model)
        materials[key] = mitsuba.load_dict(material_of) if isinstance(material_of, dict) else material_of
    props = mitsuba.Properties()
    props["bsdf"] = materials[key]
    if material.emissive.any():
        props["emitter"] = mitsuba.load_dict({"type": "area", "radiance": _glow(mitsuba, surface)})
    count, uv = len(surface.position), _coordinates(surface)
    options = {"has_vertex_normals": normal is not None, "has_vertex_texcoords": uv is not None, "props": props}
    if normal is None:
        props["face_normals"] = True
    mesh = mitsuba.Mesh("mesh", count, len(surface.face), **options)
    parameters = mitsuba.traverse(mesh)
    parameters["vertex_positions"] = surface.position.astype(np.float32).ravel()
    parameters["faces"] = surface.face.astype(np.uint32).ravel()
    if normal is not None:
        parameters["vertex_normals"] = normal.astype(np.float32).ravel()
    if uv is not None:
        parameters["vertex_texcoords"] = uv.astype(np.float32).ravel()
    attributes = {plugins.TANGENT: np.zeros((count, 3)) if surface.tangent is None else surface.tangent[:, :3]}
    if surface.color is not None:
        attributes |= {_COLOR: surface.color[:, :3], _ALPHA: surface.color[:, 3:]}
    for name, value in attributes.items():
        mesh.add_attribute(name, value.shape[1], value.astype(np.float32).ravel())
    parameters.update()
    return mesh


def _coordinates(surface: Surface) -> np.ndarray | None:
    """The texture coordinates that most maps take."""
    wanted = [each.coordinates for each in surface.material.maps()]
    known = [number for number in wanted if number in surface.texture]
    return surface.texture[max(set(known), key=known.count)] if known else None


def unjudged(surface: Surface) -> set[str]:
    """What a scene leaves out of a surface."""
    maps = surface.material.maps()
    missing = {"textures without coordinates" for each in maps if each.coordinates not in surface.texture}
    mixed = {"two sets of texture coordinates"} if len({each.coordinates for each in maps}) > 1 else set()
    return {*surface.material.unjudged, *missing, *mixed}


def _bsdf(mitsuba: Any, surface: Surface, model: str) -> Any:
    """Mitsuba's material, or what loads as one."""
    material = surface.material
    if material.brdf is not None:
        return plugins.bsdf(material.brdf)
    base = _product(mitsuba, surface, material.base_color, material.base_map, _COLOR)
    metallic = _product(mitsuba, surface, material.metallic, material.metallic_map)
    roughness = _product(mitsuba, surface, material.roughness, material.roughness_map)
    if model == "principled":
        # Reflectance at normal incidence is .08 times `specular`.
        level = float(np.mean(material.f0) * material.specular / 0.08)
        core = {"type": "principled", "base_color": base, "metallic": metallic, "roughness": roughness}
        core["specular"] = min(level, 1.0)
    else:
        parameters = {
            **{"base_color": base, "metallic": metallic, "roughness": roughness},
            "f0": _product(mitsuba, surface, material.f0, material.f0_map),
            "specular": _product(mitsuba, surface, material.specular, material.specular_map),
            **{name: {"type": "uniform", "value": 0.0} for name in ("anisotropy", "rotation")},
        }
        core = plugins.metallic_roughness(parameters)
    normal = material.normal_map
    if normal is not None and normal.coordinates in surface.texture:
        # Mitsuba's softened terminator is not part of the format.
        options = {"use_shadowing_function": False}
        core = {
            "type": "normalmap",
            "normalmap": _normal(mitsuba, normal, material.normal_scale),
            "inner": core,
            **options,
        }
        if surface.tangent is not None:
            core = plugins.along_tangents(mitsuba.load_dict(core))
    if material.double_sided:
        core = {"type": "twosided", "inner": core}
    if not material.opaque:
        core = {"type": "mask", "opacity": _opacity(mitsuba, surface), "inner": core}
    return core


def _constant(mitsuba: Any, value: np.ndarray | float) -> Any:
    if np.ndim(value):
        return mitsuba.load_dict({"type": "srgb", "color": np.asarray(value, float).tolist(), "unbounded": True})
    return mitsuba.load_dict({"type": "uniform", "value": float(value)})


def _bitmap(mitsuba: Any, each: Map, image: np.ndarray | None = None) -> Any:
    """A map as Mitsuba's texture, which has v down too."""
    transform = np.eye(4)
    transform[:2, :2], transform[:2, 3] = each.transform[:2, :2], each.transform[:2, 2]
    pixels = np.ascontiguousarray(each.image if image is None else image, np.float32)
    return mitsuba.load_dict(
        {
            **{"type": "bitmap", "bitmap": mitsuba.Bitmap(pixels), "raw": True},
            **{"wrap_mode": each.wrap, "filter_type": "nearest" if each.nearest else "bilinear"},
            "to_uv": mitsuba.ScalarTransform4f(transform),
        }
    )


def _product(mitsuba: Any, surface: Surface, factor: Any, map: Map | None, attribute: str | None = None) -> Any:
    """A factor times a map times the colors of the vertices, as far as the surface has them."""
    parts = []
    if map is not None and map.coordinates in surface.texture:
        image = map.image * np.asarray(factor, np.float32)
        parts.append(_bitmap(mitsuba, map, image))
    else:
        parts.append(_constant(mitsuba, factor))
    if attribute is not None and surface.color is not None:
        parts.append(mitsuba.load_dict({"type": "mesh_attribute", "name": attribute}))
    return parts[0] if len(parts) == 1 else _texture()(parts)


def _opacity(mitsuba: Any, surface: Surface) -> Any:
    material = surface.material
    alpha = _product(mitsuba, surface, material.alpha, material.alpha_map, _ALPHA)
    return alpha if material.cutoff is None else _texture()([alpha], cutoff=material.cutoff)


def _glow(mitsuba: Any, surface: Surface) -> Any:
    """Radiance of an emitter. Places on textured ones are drawn evenly: texture coordinates may overlap."""
    glow = _product(mitsuba, surface, surface.material.emissive, surface.material.emissive_map)
    return _texture()([glow], varying=False) if surface.material.emissive_map is not None else glow


def _normal(mitsuba: Any, map: Map, scale: float) -> Any:
    """A normal map with its scale (section 3.9.3)."""
    way = (2 * map.image[..., :3] - 1) * [scale, scale, 1]
    way /= np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), 1e-6)
    return _bitmap(mitsuba, map, (way + 1) / 2)


@plugins.per_variant
def _texture() -> Any:
    """The class of products of textures."""
    drjit, mitsuba = plugins.modules()

    class Product(mitsuba.Texture):
        """A product of textures, or whether it reaches a cutoff."""

        def __init__(self, parts: Sequence[Any], *, cutoff: float | None = None, varying: bool = True):
            super().__init__(mitsuba.Properties())
            self.parts, self.cutoff, self.varying = list(parts), cutoff, varying

        def eval(self, si, active=True):
            result = self.parts[0].eval(si, active)
            for part in self.parts[1:]:
                result = result * part.eval(si, active)
            return result

        def eval_1(self, si, active=True):
            result = self.parts[0].eval_1(si, active)
            for part in self.parts[1:]:
                result = result * part.eval_1(si, active)
            return result if self.cutoff is None else drjit.select(result >= self.cutoff, mitsuba.Float(1.0), 0.0)

        def eval_3(self, si, active=True):
            return mitsuba.Color3f(self.eval(si, active))

        def is_spatially_varying(self):
            return self.varying

        def to_string(self):
            return "Product"

    return Product
