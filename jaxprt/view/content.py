"""What the browser's GPU needs of a scene and its lights: a description as JSON, and arrays.

Exported pages hold it, and viewers that run Python send it to their page once.
"""

import dataclasses
from collections.abc import Hashable, Sequence

import jax
import numpy as np
from jaxtyping import Float, Int8

from jaxprt.brdf import GGX, BlinnPhong, CookTorrance
from jaxprt.brdf.varying import Channels
from jaxprt.files.inputs import JsonObject
from jaxprt.relit.channels import Shading
from jaxprt.scene import Environment, Part, TexturedMaterial, material_table
from jaxprt.scene.material import Texture, opacity_of_parts
from jaxprt.scene.material_table import MaterialTable
from jaxprt.scene.mesh import Opacity
from jaxprt.scene.texture import WRAPS, unit_normals
from jaxprt.sphere import cubemap
from jaxprt.systems import standard
from jaxprt.systems.lobe import blurred_light
from jaxprt.systems.protocol import Exported
from jaxprt.view.reduced import PageScene, texels_of, unit_of

NO_SCALES = {"edges": [1], "spreads": [1.0], "starts": [0]}  # for scenes without glossy parts
_STARTS = ("first", "weightStart", "pyramidStart", "visibleStart", "arrivedStart", "bitStart")
# Terms by which the page's module represents `ShininessFamily` and `SlopeFamily`.
_TERMS = {standard.BLINN_PHONG: [3, 4], standard.COOK_TORRANCE: [3, 5, 6]}
_LIGHT = 32  # most texels along the edge of the faces of the light that lobes read without visibility
FIRST_IMAGE = 10  # of the arrays of a page that hold images
_EDGES = 2048, 1024, 512  # most texels along an edge of images
_MOST_IMAGES = 1 << 27  # bytes of all images, above which they are smaller
_STENCIL = 2048  # of the opacity of a surface, whose holes may be as fine as a texel
_IMAGES = ("base_color", "roughness", "metallic", "emissive", "normal")  # textures that pages read at pixels
_COLORED = ("base_color", "emissive")  # of these, those that are encoded by sRGB
_SKY = 64  # most texels along the edge of a light's faces


def page_content(page: PageScene, lights: Sequence[Environment]) -> tuple[JsonObject, list[bytes]]:
    """JSON description and arrays of a scene and its lights, without positions and faces.

    `Piece` in the page's module defines the order of the arrays: those of `scene_content`, borders of cubemaps, and
    texels of the lights.
    """
    content, arrays = scene_content(page)
    mips, size = mip_edges(lights[0].radiance.shape[-2]), page.light_size
    blurring = blur_parameters(size) if size else NO_SCALES
    rims = sorted({mips[0], *blurring["edges"], *content["edges"]}, reverse=True)
    content |= {"light": blurring, "mips": mips, "rims": rims, "lights": len(lights), "glossy": bool(size)}
    content |= {"finer": _finer(size)}
    arrays += [cubemap.border_index(size=edge).astype("<u4").tobytes() for edge in rims]
    return content, arrays + [light_texels(light, mips[0]) for light in lights]


def unshadowed_content(
    parts: Sequence[Part], shadings: Sequence[Shading], lights: Sequence[Environment]
) -> tuple[JsonObject, list[bytes]]:
    """`page_content` of a scene of which no visibility is known: the page shows it without shadows.

    Args:
        parts: The parts of the scene.
        shadings: Their shading, from `jaxprt.relit.build.shaded`. BRDFs without a standard table are shown as gray
            diffuse surfaces, and layers are left out.
        lights: The lights.
    """
    page = PageScene.without_visibility(parts, shadings, min(_LIGHT, lights[0].radiance.shape[-2]))
    return page_content(page, lights)


def scene_content(page: PageScene) -> tuple[JsonObject, list[bytes]]:
    """JSON description and arrays of all parts. `Piece` in the page's module defines their order."""
    bits = page.bits or [np.zeros((0, 0), np.uint8)] * len(page.parts)
    unit, visible_unit = unit_of([held.vector for held in page.parts]), unit_of([held.visible for held in page.parts])
    terms = max(-(-len(unit) // 4) * 4, 4)
    place: dict[str, int] = dict.fromkeys(_STARTS, 0)
    materials = material_table.of_parts(page.scene.parts)
    tables, images = _Tables(), _Images(_edge_of_images(page.scene.parts))
    parts, scale = [], page.scales
    stride = 0 if scale is None else int(scale.total - scale.start[page.level])
    arrays: list[list[np.ndarray]] = [[] for _ in range(6)]
    tilted, mapped = _tilted_normals(page, materials), False
    opacity = opacity_of_parts(page.scene.parts)
    rows = zip(page.scene.parts, page.shading, page.parts, bits, tilted, strict=True)
    for part, shading, held, bit, direction in rows:
        start, table = tables.add(f"part {part.name!r}", held)
        weight, seen, described = _weights(shading, held), held.means, _material_json(part, shading, images)
        if described and "normal" in described.get("textures", {}):
            direction, mapped = shading.mesh.normal, True
        count = held.vector.shape[1]
        about = held.description | {"family": _family(shading), "texels": bool(bit.size) or bool(page.unshadowed)}
        about |= {"name": part.name, "count": count, "channels": weight.shape[1] - 1}
        about |= {"nodes": table.shape[1], "entries": table.shape[2], "terms": -(-len(held.vector) // 4) * 4}
        about |= {"weightStep": 0 if described else weight.shape[1], **(described or {})}
        if opacity is not None and opacity.layer[place["first"]]:
            about["opacity"] = images.opacity(opacity, int(opacity.layer[place["first"]]))
        parts.append(about | place | {"tableStart": start})
        weight = weight[:1] if described else weight
        vector = _bytes(held.vector, unit, terms)
        visible = _bytes(held.visible, visible_unit, 4 * about["words"])
        normal = np.round(32767 * np.asarray(direction))
        kinds = "<i2", "i1", "u1", "<f4", "i1", "u1"
        for column, array, kind in zip(arrays, (normal, vector, seen, weight, visible, bit.T), kinds, strict=True):
            column.append(array.astype(kind).reshape(-1))
        means = 0 if held.scales is None else count * stride
        pairs = count * -(-(about["bands"] ** 2) // 2)
        sizes = count, weight.size // 4, means, visible.size // 4, pairs, bit.size
        place = {name: start + size for (name, start), size in zip(place.items(), sizes, strict=True)}
    content = {"parts": parts, "terms": terms, "vectorUnit": unit.tolist(), "stride": stride, **_scales(page)}
    content |= {"visibleUnit": visible_unit.tolist(), "arrived": place["arrivedStart"]}
    content |= {"means": place["pyramidStart"]}
    edge = page.texel_edge
    content |= {"texelEdge": edge, "texels": texels_of(edge) if edge else 0, "visibility": not page.unshadowed}
    joined = [np.concatenate(column) for column in arrays]
    joined.insert(3, tables.joined())
    count = place["first"]
    coordinate = np.asarray(materials.coordinate)[:count] if images.described else np.zeros((0, 4))
    tangent = np.asarray(materials.frame)[:count, 3:7] if mapped else np.zeros((0, 4))
    tangent = np.round(127 * np.clip(tangent, -1, 1)).astype("i1")
    clear = np.zeros((0, 3)) if opacity is None else np.column_stack([opacity.coordinate, opacity.factor])
    assert len(joined) + 3 == FIRST_IMAGE
    joined += [coordinate.astype("<f4"), tangent.reshape(-1), clear.astype("<f4"), *images.data]
    content["images"] = images.described
    joined[2] = np.append(joined[2], np.zeros(4 - len(joined[2]) % 4, np.uint8))  # whole words
    added, reflected = _reflected(page)
    return content | added, [array.tobytes() for array in (*joined, reflected)]


def _reflected(page: PageScene) -> tuple[JsonObject, Int8[np.ndarray, " n"]]:
    """What bounces and lamps add at each vertex: units of the rows, and for each row three colors in a word."""
    if page.reflected is None:
        return {"reflectedUnit": []}, np.zeros(0, np.int8)
    unit = unit_of(page.reflected)
    columns = []
    for rows, part in zip(page.reflected, page.parts, strict=True):
        column = np.zeros((part.vector.shape[1], len(unit), 4), np.int8)
        column[:, : len(rows), :3] = np.round(rows / unit[: len(rows), None, None]).transpose(2, 0, 1)
        columns.append(column.reshape(-1))
    return {"reflectedUnit": unit.tolist()}, np.concatenate(columns)


def _tilted_normals(page: PageScene, materials: MaterialTable) -> list[Float[np.ndarray, "v 3"]]:
    """Normals at the vertices of each part, with those of normal maps."""
    tilted = materials.at_vertices().normal
    if tilted is None:
        return [np.asarray(shading.mesh.normal) for shading in page.shading]
    counts = [len(shading.mesh.normal) for shading in page.shading]
    return np.split(np.asarray(tilted), np.cumsum(counts)[:-1])


class _Tables:
    """The tables of a page. Parts with one BRDF share one table."""

    def __init__(self):
        """Starts without tables."""
        self._made: dict[Hashable, tuple[int, Float[np.ndarray, "h q e 4"]]] = {}
        self._end = 0

    def add(self, what: str, held: Exported) -> tuple[int, Float[np.ndarray, "h q e 4"]]:
        """The table of a part, which messages call `what`, and where its texels start among those of all tables."""
        leaves, kind = jax.tree.flatten(held.brdf)
        key = kind, *((np.shape(leaf), np.asarray(leaf).tobytes()) for leaf in leaves)
        if key not in self._made:
            table = held.table(what)
            self._made[key] = self._end, table
            self._end += table.size // 4
        return self._made[key]

    def joined(self) -> Float[np.ndarray, " n"]:
        """The texels of all tables."""
        return np.concatenate([table.astype("<f4").reshape(-1) for _, table in self._made.values()])


class _Images:
    """The images of a page's textures. Textures of one image share it."""

    def __init__(self, most: int):
        """Starts without images, of which none will have more than so many texels along an edge."""
        self._most = most
        # Size and number of channels of each image, and whether it is of colors.
        self.described: list[dict[str, int]] = []
        self.data: list[np.ndarray] = []  # first row on top; colors are encoded by sRGB
        self._number: dict[tuple[int, str], int] = {}

    def add(self, texture: Texture, name: str) -> JsonObject:
        """How a texture reads its image, which is added where it is new."""
        colored, normal = name in _COLORED, name == "normal"
        key = id(texture.image), "color" if colored else "normal" if normal else "value"
        if key not in self._number:
            value = unit_normals(texture.image) if normal else texture.image
            value = np.clip(_halved(np.asarray(value), most=self._most), 0, 1)
            if colored:
                value = np.broadcast_to(value, (*value.shape[:2], 3))
                value = np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)
            # Normals are 127 (normal + 1), so that their zeros and ones are exact.
            self._append(key, (254 if normal else 255) * value, colored=colored)
        how = {"transform": np.asarray(texture.transform, float).tolist(), "set": texture.set, "wrap": texture.wrap}
        return {"image": self._number[key], **how}

    def opacity(self, opacity: Opacity, layer: int) -> JsonObject:
        """Where a part with holes or of translucent material is there, and how it reads the image of its opacity."""
        about: JsonObject = {"cutoff": float(opacity.cutoff[layer]), "glass": bool(opacity.glass[layer])}
        start, (height, width) = int(opacity.start[layer]), opacity.shape[layer]
        if start < 0:
            return about
        key = start, "opacity"
        if key not in self._number:
            image = np.asarray(opacity.texel[start : start + height * width]).reshape(height, width, 1)
            self._append(key, 255 * np.clip(_halved(image, most=_STENCIL), 0, 1))
        return about | {"image": self._number[key], "wrap": [WRAPS[number] for number in opacity.wrap[layer]]}

    def _append(self, key: tuple[int, str], value: Float[np.ndarray, "h w c"], *, colored: bool = False) -> None:
        height, width, channels = value.shape
        self._number[key] = len(self.data)
        self.described.append({"width": width, "height": height, "channels": channels, "colored": colored})
        self.data.append(np.round(value).astype(np.uint8))


def _edge_of_images(parts: Sequence[Part]) -> int:
    """Most texels along an edge, so that the images of all textures are not too many bytes."""
    images = {}
    for part in parts:
        fields = vars(part.material).values() if isinstance(part.material, TexturedMaterial) else ()
        images |= {id(field.image): field.image.shape for field in fields if isinstance(field, Texture)}
    for edge in _EDGES:
        if sum(min(h, edge) * min(w, edge) * 3 for h, w, *_ in images.values()) <= _MOST_IMAGES:
            return edge
    return _EDGES[-1]


def _halved(value: Float[np.ndarray, "h w c"], *, most: int) -> Float[np.ndarray, "_ _ c"]:
    """An image with half as many rows and columns, as often as an edge has more texels than `most`."""
    value = np.asarray(value, np.float64)
    while max(value.shape[:2]) > most and not (value.shape[0] % 2 or value.shape[1] % 2):
        value = value.reshape(value.shape[0] // 2, 2, value.shape[1] // 2, 2, -1).mean((1, 3))
    return value


def _bytes(value: Float[np.ndarray, "k v"], unit: Float[np.ndarray, " m"], length: int) -> Float[np.ndarray, "v l"]:
    """Values quantized to integer multiples of the units, in rows of a given length."""
    padded = np.zeros((value.shape[1], length))
    padded[:, : len(value)] = np.round(value / unit[: len(value), None]).T
    return padded


def _scales(page: PageScene) -> JsonObject:
    """The scales of visibility that the page keeps."""
    scale, level = page.scales, page.level
    if scale is None:
        return NO_SCALES
    starts = scale.start[level:] - scale.start[level]
    return {"edges": scale.edge[level:].tolist(), "spreads": scale.spread[level:].tolist(), "starts": starts.tolist()}


def mip_edges(size: int) -> list[int]:
    """Sizes of the cubemaps in the mip chain that the page computes from a light."""
    while size > _SKY and size % 2 == 0:
        size //= 2
    result = [size]
    while result[-1] % 2 == 0 and result[-1] > 4:
        result.append(result[-1] // 2)
    return result


def blur_parameters(size: int) -> JsonObject:
    """Parameters for blurring the light to all lobe widths, as `jaxprt.systems.lobe.blurred_light.prefilter` does."""
    scale = blurred_light.scales(size)
    pairs = zip(scale.edge.tolist(), scale.spread.tolist(), strict=True)
    source, variances, concentration = zip(*(blurred_light.blur(*pair, size=size) for pair in pairs), strict=True)
    return {
        "edges": scale.edge.tolist(),
        "spreads": scale.spread.tolist(),
        "starts": scale.start.tolist(),
        "total": scale.total,
        "sources": source,
        "concentrations": concentration,
        "reaches": [min(np.pi, blurred_light.REACH * np.sqrt(variance)) for variance in variances],
    }


def _finer(size: int) -> JsonObject:
    """Scales of the texels that the page makes of the picture of a light, for very narrow lobes."""
    if not size:
        return {"edges": [], "spreads": [], "starts": [], "total": 0}
    before = blurred_light.scales(size)
    scale, count = blurred_light.finer_scales(size, before=before.total), -len(before.edge)
    edge, start, spread = (values[:count].tolist() for values in (scale.edge, scale.start, scale.spread))
    return {"edges": edge, "spreads": spread, "starts": start, "total": scale.total - before.total}


def _family(shading: Shading) -> dict[str, list]:
    """Numbers of the BRDF terms of a part's channels in the page's module, and their factors; empty if unknown."""
    if shading.blend is None or shading.scale is None:
        return {"terms": [], "scale": []}
    terms = list(shading.term) if shading.table is None else _TERMS.get(shading.table, list(shading.term))
    return {"terms": terms, "scale": np.asarray(shading.scale, float).tolist()}


def _weights(shading: Shading, held: Exported) -> Float[np.ndarray, "v k 4"]:
    """Channel weights at each vertex, followed by its emission. The first row also holds the logarithm of roughness."""
    count = len(shading.mesh.position)
    weight = held.weight if shading.blend is None else np.asarray(shading.blend.weight)
    weight = np.broadcast_to(weight, (count, *weight.shape[-2:]))
    result = np.zeros((count, weight.shape[1] + 1, 4))
    result[:, :-1, :3] = weight
    if shading.blend is not None and shading.blend.parameter:
        result[:, 0, 3] = np.asarray(shading.blend.parameter[0])
    elif isinstance(shading.brdf, Channels):  # isotropic GGX with a constant roughness
        result[:, 0, 3] = np.log(
            next(float(model.roughness[0]) for model in shading.brdf.model if isinstance(model, GGX))
        )
    if shading.emitted is not None:
        result[:, -1, :3] = np.asarray(shading.emitted)
    return result


def _colors(material: object, *names: str) -> dict[str, list[float]]:
    """Parameters of a material in three colors."""
    return {name: np.broadcast_to(np.asarray(getattr(material, name), float), 3).tolist() for name in names}


def _material_json(part: Part, shading: Shading, images: _Images) -> JsonObject | None:
    """Parameters of a material without attributes of vertices, with its textures; None for other materials."""
    material = part.material
    if isinstance(material, BlinnPhong) and shading.table == standard.BLINN_PHONG:
        return {"material": _colors(material, "diffuse", "specular") | {"exponent": float(material.exponent)}}
    if isinstance(material, CookTorrance) and shading.table == standard.COOK_TORRANCE:
        return {"material": _colors(material, "diffuse", "specular", "f0") | {"slope": float(material.roughness)}}
    if not isinstance(material, TexturedMaterial) or shading.scale is None or part.color is not None:
        return None
    names = ("base_color", "metallic", "specular", "specular_color", "ior", "roughness", "emissive", "normal_scale")
    names += ("transmission",)
    values: JsonObject = {name: np.asarray(getattr(material, name), float).tolist() for name in names}
    fields = {
        field.name.removesuffix("_texture"): getattr(material, field.name) for field in dataclasses.fields(material)
    }
    textures = {name: value for name, value in fields.items() if isinstance(value, Texture)}
    if set(textures) - {*_IMAGES, "alpha"}:
        return None
    read = {name: images.add(textures[name], name) for name in _IMAGES if name in textures}
    return {"material": values, "textures": read}


def light_texels(light: Environment, size: int) -> bytes:
    """The texels of a light for the page, at lower resolution."""
    radiance = np.asarray(light.radiance, np.float64)
    fold = radiance.shape[-2] // size
    if fold > 1:
        area = np.asarray(cubemap.solid_angle(size=radiance.shape[-2]), np.float64)[..., None]
        shape = 6, size, fold, size, fold, -1
        radiance, whole = (values.reshape(shape).sum((2, 4)) for values in (radiance * area, area))
        radiance = radiance / whole
    return np.broadcast_to(radiance, (*radiance.shape[:-1], 3)).astype("<f4").tobytes()
