"""Binary glTF: scenes with transfer in vertex attributes, and scenes with the radiance of one light as colors."""

import json
import os
import pathlib
import struct
import tempfile
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxprt import require
from jaxprt.brdf import BlinnPhong, CookTorrance
from jaxprt.compile import put
from jaxprt.files import outputs, write_png
from jaxprt.files.inputs import JsonObject
from jaxprt.image.tonemap import encode_srgb
from jaxprt.relit.channels import Shading
from jaxprt.relit.scene import RelitScene
from jaxprt.scene import Environment, Part, TexturedMaterial
from jaxprt.scene.material import Texture
from jaxprt.sphere import harmonics
from jaxprt.systems import axes, protocol
from jaxprt.view.stages import counterclockwise

DEGREE = 3  # of the transfer: 16 harmonics in four attributes
MOST_DEGREE = 5  # up to which coefficients are below 1, and attributes at most nine
_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_KINDS = {"<f4": 5126, "<u4": 5125, "<i2": 5122}
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_VERTICES, _INDICES = 34962, 34963
_WRAPS = {"repeat": 10497, "mirror": 33648, "clamp": 33071}
_GRAY = 0.5  # base color of materials that glTF does not have
_SHORT = 32767


class _File:
    """A GLB file under construction: one buffer, and the arrays of objects that refer to it and to each other."""

    def __init__(self):
        """Starts an empty file."""
        self.data = bytearray()
        self.objects: dict[str, list[JsonObject]] = {}
        self.extensions: set[str] = set()
        self._textures: dict[tuple, int] = {}

    def add(self, kind: str, value: JsonObject) -> int:
        """Adds an object and returns its index."""
        self.objects.setdefault(kind, []).append(value)
        return len(self.objects[kind]) - 1

    def view(self, content: bytes, **fields: Any) -> int:
        """Adds bytes to the buffer, aligned to words."""
        self.data += bytes(-len(self.data) % 4)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content), **fields}
        self.data += content
        return self.add("bufferViews", view)

    def array(self, value: ArrayLike, kind: str, *, target: int = _VERTICES, **fields: Any) -> int:
        """Adds an accessor of rows of a type of numbers, such as "<f4"."""
        array = np.ascontiguousarray(np.asarray(value).astype(kind))
        rows = array.reshape(len(array), -1)
        accessor = {"bufferView": self.view(rows.tobytes(), target=target), "componentType": _KINDS[kind]}
        return self.add("accessors", accessor | {"count": len(rows), "type": _TYPES[rows.shape[1]], **fields})

    def positions(self, value: ArrayLike) -> int:
        """Adds the accessor of positions, with the bounds that the format requires."""
        rows = np.asarray(value, "<f4")
        return self.array(rows, "<f4", min=rows.min(0).tolist(), max=rows.max(0).tolist())

    def texture(self, image: Float[np.ndarray, "h w c"], wrap: tuple[str, str]) -> int:
        """Adds a texture with its image as PNG, or returns the index of an equal one."""
        key = wrap, image.shape, image.tobytes()
        if key not in self._textures:
            with tempfile.TemporaryDirectory() as folder:
                path = pathlib.Path(folder) / "image.png"
                write_png(path, image)
                source = self.add("images", {"mimeType": "image/png", "bufferView": self.view(path.read_bytes())})
            sampler = {"magFilter": 9729, "minFilter": 9987, "wrapS": _WRAPS[wrap[0]], "wrapT": _WRAPS[wrap[1]]}
            self._textures[key] = self.add("textures", {"source": source, "sampler": self.add("samplers", sampler)})
        return self._textures[key]

    def content(self, asset: JsonObject, scene: str) -> bytes:
        """The complete file, whose scene has all nodes."""
        self.data += bytes(-len(self.data) % 4)
        nodes = list(range(len(self.objects["nodes"])))
        head: JsonObject = {"asset": {"version": "2.0", "generator": "jaxprt", "extras": asset}, "scene": 0}
        if self.extensions:
            head["extensionsUsed"] = sorted(self.extensions)
        head |= {"scenes": [{"name": scene, "nodes": nodes}], **self.objects}
        head["buffers"] = [{"byteLength": len(self.data)}]
        text = json.dumps(head, allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        parts = struct.pack("<II", len(text), _JSON), text, struct.pack("<II", len(self.data), _BIN), bytes(self.data)
        return struct.pack("<III", _MAGIC, 2, 12 + sum(map(len, parts))) + b"".join(parts)


def export_gltf(
    scene: RelitScene,
    path: str | os.PathLike,
    *,
    environments: Mapping[str, Environment] | None = None,
    degree: int | None = DEGREE,
) -> None:
    """Writes a scene as binary glTF with its shadowed transfer in vertex attributes, for shaders of other programs.

    The diffuse radiance of a vertex is its diffuse color times the sum over k of T_k L_k. T_k are the numbers of its
    attributes _PRT_0, _PRT_1, ..., four in each, padded by zeros. L_k are the coefficients of the light,

        L_k = ∫ L(w) Y_k(w) dw,        T_k = 1/π ∫ Y_k(w) V(x, w) max(w · n, 0) dw

    in real orthonormal spherical harmonics without the Condon-Shortley phase, in the order k = l (l + 1) + m, with z as
    the polar axis: those of `jaxprt.harmonic.project`, and of three.js. Axes are those of the file, with y up. Numbers
    are normalized 16-bit integers. `asset.extras.prt` in the file repeats this, and has the coefficients of lights.

    Materials are metallic-roughness materials with their textures. Clear coats, sheens, transmission and anisotropy are
    left out. Transfer is of direct light.

    Args:
        scene: The result of `jaxprt.precompute`, with systems that pages can show, such as "lobe" and "harmonic".
        path: The file, `*.glb`.
        environments: Dictionary from names to lights whose coefficients are stored in the file; none if None.
        degree: Highest degree of the harmonics, from 0 to 5: 2 has 9 coefficients, 3 has 16. Systems of pages have at
            most the degree of their transport. None writes the scene alone, without transfer, of any system.

    Raises:
        TypeError: `scene` is not a relit scene, or `environments` holds something other than lights.
        ValueError: The suffix of the file is not .glb, the degree is out of its range, or a part has another system or
            transfer of a lower degree.
        OSError: The file cannot be written, found before anything is computed where possible.

    Reference: Khronos, glTF 2.0 specification, section 3.7.2.1 on attributes of applications; Kautz et al. 2002.
    """
    require.kind("the scene", scene, RelitScene, source="jaxprt.precompute")
    if degree is not None:
        require.count("degree", degree, least=0, most=MOST_DEGREE)
    path = outputs.target(path, ".glb")
    if environments is not None and not isinstance(environments, Mapping):
        got = require.shown(environments)
        raise TypeError(f"environments must be a dictionary from names to lights, got {got}")
    lights = {} if environments is None else dict(environments)
    for name, light in lights.items():
        protocol.one_light(light)
        require.colors(f"the light {name!r}", light.radiance)
    file = _File()
    for number, (part, shading) in enumerate(zip(scene.scene.parts, scene.shading, strict=True)):
        attributes, material = _attributes(file, part), _material(file, part, shading)
        if degree is not None:
            transfer = _transfer(scene, number, degree)
            for first in range(0, transfer.shape[1], 4):
                column = np.round(_SHORT * transfer[:, first : first + 4])
                attributes[f"_PRT_{first // 4}"] = file.array(column, "<i2", normalized=True)
        attributes |= material.pop("coordinates")
        _add_node(file, part, part.name, attributes, file.add("materials", material | {"name": part.name}))
    if degree is None:
        outputs.write(path, file.content({}, "scene"))
        return
    coefficients = {name: _light(light, degree).tolist() for name, light in lights.items()}
    prt = {
        "degree": degree,
        "attributes": [f"_PRT_{number}" for number in range(-(-((degree + 1) ** 2) // 4))],
        "radiance": "diffuse color times the sum of attributes times coefficients of the light",
        "basis": "real orthonormal spherical harmonics without Condon-Shortley phase, k = l (l + 1) + m, polar axis +z",
        "axes": "those of this file",
        "lights": coefficients,
    }
    outputs.write(path, file.content({"prt": prt}, "with transfer in the attributes _PRT_0 and following"))


def write_lightmap(path: str | os.PathLike, part: Part, image: Float[np.ndarray, "n n 3"]) -> None:
    """Writes a part whose radiance any viewer shows as it is: black, with an emissive texture.

    Args:
        path: The file, *.glb.
        part: The part that `jaxprt.sensors.lightmap` was made of.
        image: Linear radiance, from `Lightmap.image`; values above 1 are white.
    """
    path, file, mesh = outputs.target(path, ".glb"), _File(), part.mesh
    place = np.asarray(mesh.texture if part.second is None else part.second) * [1, -1] + [0, 1]
    attributes = {"POSITION": file.positions(mesh.position), "NORMAL": file.array(mesh.normal, "<f4")}
    attributes["TEXCOORD_0"] = file.array(place, "<f4")
    shown = np.asarray(encode_srgb(jnp.clip(jnp.asarray(image), 0, 1)))
    black = {"baseColorFactor": [0, 0, 0, 1], "metallicFactor": 0, "roughnessFactor": 1}
    texture = {"index": file.texture(shown, ("clamp", "clamp"))}
    material = {"pbrMetallicRoughness": black, "emissiveFactor": [1, 1, 1], "emissiveTexture": texture}
    _add_node(file, part, part.name, attributes, file.add("materials", material | {"name": part.name}))
    outputs.write(path, file.content({}, "lightmap"))


def _light(light: Environment, degree: int) -> Float[np.ndarray, "lm 3"]:
    coefficient = np.asarray(harmonics.project(jnp.asarray(light.radiance), degree=degree), np.float64)
    return np.broadcast_to(coefficient, (len(coefficient), 3))


def _transfer(scene: RelitScene, number: int, degree: int) -> Float[np.ndarray, "v k"]:
    """Transfer of the diffuse response of a part's vertices, padded to whole attributes."""
    name, count = scene.scene.names[number], (degree + 1) ** 2
    system = axes.map_leaves(scene.part_system(number), lambda _, leaf: put(leaf))
    vector = system.exported(f"part {name!r}").diffuse
    if len(vector) < count:
        most = harmonics.degree_of(len(vector))
        raise ValueError(f"degree must be at most {most}, that of the transfer of part {name!r}, got {degree}")
    return np.pad(vector[:count].T, ((0, 0), (0, -count % 4)))


def _attributes(file: _File, part: Part) -> dict[str, int]:
    """Positions, normals, and vertex colors where the part has them."""
    mesh = part.mesh
    attributes = {"POSITION": file.positions(mesh.position), "NORMAL": file.array(mesh.normal, "<f4")}
    if part.color is not None or part.alpha is not None:
        count = len(mesh.position)
        color = np.ones((count, 3)) if part.color is None else np.asarray(part.color)
        alpha = np.ones(count) if part.alpha is None else np.asarray(part.alpha)
        attributes["COLOR_0"] = file.array(np.clip(np.column_stack([color, alpha]), 0, 1), "<f4")
    return attributes


def _add_node(file: _File, part: Part, name: str, attributes: dict[str, int], material: int) -> None:
    """Adds a part at the origin of its mesh."""
    face = counterclockwise(part.mesh).reshape(-1)
    primitive = {"attributes": attributes, "indices": file.array(face, "<u4", target=_INDICES), "material": material}
    place = {"translation": list(part.mesh.origin)} if any(part.mesh.origin) else {}
    file.add("nodes", {"name": name, "mesh": file.add("meshes", {"name": name, "primitives": [primitive]}), **place})


def _material(file: _File, part: Part, shading: Shading) -> JsonObject:
    """The material of a part. `coordinates` has the attributes that its textures need."""
    material = part.material
    if not isinstance(material, TexturedMaterial):
        color, roughness = _plain(material, shading)
        factors = {"baseColorFactor": [*color, 1.0], "metallicFactor": 0.0, "roughnessFactor": roughness}
        return {"pbrMetallicRoughness": factors, "coordinates": {}}
    factor = {name: np.asarray(getattr(material, name), float) for name in ("base_color", "metallic", "roughness")}
    opaque = material.alpha_mode == "opaque"
    pbr: JsonObject = {
        "baseColorFactor": [*factor["base_color"].tolist(), 1.0 if opaque else float(material.alpha)],
        "metallicFactor": float(factor["metallic"]),
        "roughnessFactor": float(factor["roughness"]),
    }
    result: JsonObject = {"pbrMetallicRoughness": pbr, "doubleSided": material.back == "lit"}
    if not opaque:
        result["alphaMode"] = material.alpha_mode.upper()
    if material.alpha_mode == "mask":
        result["alphaCutoff"] = float(material.alpha_cutoff)
    _add_emission(file, material, result)
    _add_reflectance(file, material, result)
    _add_textures(file, part, material, result)
    return result


def _plain(material: object, shading: Shading) -> tuple[list[float], float]:
    """Diffuse color and roughness of a BRDF that glTF does not have: gray for one that has no diffuse color."""
    if isinstance(material, BlinnPhong):
        roughness = float((2 / (float(material.exponent) + 2)) ** 0.25)
        return np.clip(np.broadcast_to(np.asarray(material.diffuse, float), 3), 0, 1).tolist(), roughness
    if isinstance(material, CookTorrance):
        roughness = float(np.sqrt(np.clip(float(material.roughness), 0, 1)))
        return np.clip(np.broadcast_to(np.asarray(material.diffuse, float), 3), 0, 1).tolist(), roughness
    albedo = np.asarray(shading.albedo, float) if shading.matte else np.full(3, _GRAY)
    return np.clip(np.broadcast_to(albedo, 3), 0, 1).tolist(), 1.0


def _add_emission(file: _File, material: TexturedMaterial, result: JsonObject) -> None:
    emissive = np.asarray(material.emissive, float)
    strength = max(float(emissive.max()), 1.0)
    if emissive.any():
        result["emissiveFactor"] = (emissive / strength).tolist()
    if strength > 1:
        file.extensions.add("KHR_materials_emissive_strength")
        result.setdefault("extensions", {})["KHR_materials_emissive_strength"] = {"emissiveStrength": strength}


def _add_reflectance(file: _File, material: TexturedMaterial, result: JsonObject) -> None:
    color, weight = np.asarray(material.specular_color, float), float(material.specular)
    if weight != 1 or np.any(color != 1):
        file.extensions.add("KHR_materials_specular")
        specular = {"specularFactor": weight, "specularColorFactor": color.tolist()}
        result.setdefault("extensions", {})["KHR_materials_specular"] = specular
    if float(material.ior) != 1.5:
        file.extensions.add("KHR_materials_ior")
        result.setdefault("extensions", {})["KHR_materials_ior"] = {"ior": float(material.ior)}


def _add_textures(file: _File, part: Part, material: TexturedMaterial, result: JsonObject) -> None:
    """Adds the textures of base color, metal, roughness, normals and emission, with coordinates for each transform."""
    attributes: dict[str, int] = {}
    numbers: dict[tuple, int] = {}

    def reference(texture: Texture, image: np.ndarray) -> dict[str, int]:
        key = texture.set, np.asarray(texture.transform).tobytes()
        if key not in numbers:
            numbers[key] = len(numbers)
            attributes[f"TEXCOORD_{numbers[key]}"] = file.array(_coordinates(part, texture), "<f4")
        return {"index": file.texture(image, texture.wrap), "texCoord": numbers[key]}

    pbr, color = result["pbrMetallicRoughness"], material.base_color_texture
    alpha = None if material.alpha_mode == "opaque" else material.alpha_texture
    if color is not None:
        image = _encoded(color)
        if alpha is not None and alpha.image.shape[:2] == image.shape[:2]:
            image = np.concatenate([image, np.asarray(alpha.image, float)], 2)
        pbr["baseColorTexture"] = reference(color, image)
    elif alpha is not None:
        image = np.asarray(alpha.image, float)
        pbr["baseColorTexture"] = reference(alpha, np.concatenate([np.ones_like(image).repeat(3, 2), image], 2))
    shiny = material.roughness_texture, material.metallic_texture
    first = next((texture for texture in shiny if texture is not None), None)
    if first is not None:
        blank = np.ones((*first.image.shape[:2], 1))
        channels = [blank, *(blank if texture is None else np.asarray(texture.image, float) for texture in shiny)]
        if all(channel.shape == blank.shape for channel in channels):
            pbr["metallicRoughnessTexture"] = reference(first, np.concatenate(channels, 2))
    if material.normal_texture is not None:
        scale = {"scale": float(material.normal_scale)}
        normal = reference(material.normal_texture, np.asarray(material.normal_texture.image, float))
        result["normalTexture"] = normal | scale
        hand = np.ones(len(part.mesh.position)) if part.handedness is None else np.asarray(part.handedness)
        attributes["TANGENT"] = file.array(np.column_stack([np.asarray(part.mesh.tangent), hand]), "<f4")
    if material.emissive_texture is not None:
        result["emissiveTexture"] = reference(material.emissive_texture, _encoded(material.emissive_texture))
    result["coordinates"] = attributes


def _encoded(texture: Texture) -> Float[np.ndarray, "h w 3"]:
    return np.asarray(encode_srgb(texture.image), float)


def _coordinates(part: Part, texture: Texture) -> Float[np.ndarray, "v 2"]:
    """Texture coordinates with the texture's transform, and v down as in glTF."""
    coordinate = np.asarray(part.mesh.texture if texture.set == 0 else part.second, float)
    transform = np.asarray(texture.transform, float)
    moved = coordinate @ transform[:, :2].T + transform[:, 2]
    return np.stack([moved[:, 0], 1 - moved[:, 1]], 1)


def export_baked(
    scene: RelitScene,
    path: str | os.PathLike,
    environment: Environment,
    *,
    eye: Float[Array | np.ndarray, "3"] | None = None,
    materials: Mapping[str, Any] | None = None,
) -> float:
    """Writes a scene as binary glTF with baked lighting: radiance under one light towards one eye position.

    Each part becomes a mesh with radiance in COLOR_0 and an unlit material (KHR_materials_unlit). From other eye
    positions the file shows the same radiance. Colors in glTF are linear and at most 1, so all are divided by the
    largest radiance, which is stored as `exposure` in `extras`. Negative radiance becomes 0. Names in the file state
    that it is baked.

    Args:
        scene: The result of `jaxprt.precompute`.
        path: The file, `*.glb`.
        environment: The light.
        eye: Position of the viewer in world units; that of the scene's camera if None.
        materials: Dictionary from names of parts to materials that replace their own.

    Returns:
        The factor by which the colors in the file must be multiplied to give radiance.

    Raises:
        TypeError: `scene` is not a relit scene, or `environment` is not an `Environment`.
        ValueError: The suffix of the file is not .glb, or `RelitScene.radiance` refuses the light, eye or materials.
        OSError: The file cannot be written, found before the radiance is computed where possible.

    Reference: Khronos, glTF 2.0 specification, sections 3.7.2 and 4.4; KHR_materials_unlit.
    """
    require.kind("the scene", scene, RelitScene, source="jaxprt.precompute")
    require.kind("the light", environment, Environment, source="jaxprt.load_environment")
    path = outputs.target(path, ".glb")
    eye = scene.camera.eye if eye is None else eye
    color = np.asarray(scene.radiance(environment, eye=eye, materials=materials), np.float32)
    if color.ndim != 2:
        raise ValueError(f"the light must be one environment, got a batch of {len(color)}")
    color = np.maximum(np.broadcast_to(color, (len(color), 3)), 0)
    exposure = max(float(color.max(initial=0)), 1e-30)
    file, words = _File(), "baked for one light and one view"
    file.extensions.add("KHR_materials_unlit")
    unlit = {"baseColorFactor": [1.0, 1.0, 1.0, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0}
    material = file.add(
        "materials", {"name": "baked", "pbrMetallicRoughness": unlit, "extensions": {"KHR_materials_unlit": {}}}
    )
    counts = [len(part.mesh.position) for part in scene.scene.parts]
    of_parts = np.split(np.clip(color / np.float32(exposure), 0, 1), np.cumsum(counts)[:-1])
    for part, rows in zip(scene.scene.parts, of_parts, strict=True):
        attributes = {"POSITION": file.positions(part.mesh.position), "COLOR_0": file.array(rows, "<f4")}
        _add_node(file, part, f"{part.name}, {words}", attributes, material)
    asset = {"baked": True, "eye": np.asarray(eye, float).tolist(), "exposure": exposure}
    outputs.write(path, file.content(asset, words))
    return exposure
