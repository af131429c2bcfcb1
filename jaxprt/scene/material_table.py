"""Materials of many parts as columns, evaluated at points of all parts by one program.

The texels of all textures stand in one array. Which image a part reads, and how, are numbers and not types, so that the
program depends on the number of points only, and not on the parts or their textures.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int

from jaxprt.brdf import BlinnPhong, CookTorrance, MetallicRoughness, sheen
from jaxprt.compile import compile_time, kept, known, put, shared_size
from jaxprt.scene import texture
from jaxprt.scene.material import Texture, TexturedMaterial
from jaxprt.scene.points import Points
from jaxprt.scene.scene import Part
from jaxprt.sphere import directions

# Textures, in the order of their columns.
TEXTURES = (
    "base_color_texture",
    "metallic_texture",
    "roughness_texture",
    "emissive_texture",
    "specular_texture",
    "specular_color_texture",
    "anisotropy_texture",
    "normal_texture",
)
# Textures of materials with further layers, which only scenes with such materials have columns for.
LAYER_TEXTURES = (
    "clearcoat_texture",
    "clearcoat_roughness_texture",
    "transmission_texture",
    "sheen_color_texture",
    "sheen_roughness_texture",
)
COLORS = 6  # of these determine the colors and the roughness of points; the others turn their frames
_NORMAL = TEXTURES.index("normal_texture")
_FACTORS = (
    ("base_color", 3),
    ("metallic", 1),
    ("roughness", 1),
    ("emissive", 3),
    ("specular", 1),
    ("specular_color", 3),
    ("ior", 1),
)
# Column after these: 1 for `BlinnPhong` and 2 for `CookTorrance`, whose F0 follows in three more.
_MODEL = sum(width for _, width in _FACTORS)
_METALLIC_ROUGHNESS, _BLINN_PHONG, _COOK_TORRANCE = range(3)
_F0 = slice(_MODEL + 1, _MODEL + 4)
_LAYER = _F0.stop  # first column of layers
# Columns of layers, in scenes that have them, in the order of their textures.
_LAYERS = (
    ("clearcoat", 1),
    ("clearcoat_roughness", 1),
    ("transmission", 1),
    ("sheen_color", 3),
    ("sheen_roughness", 1),
)
ROW = 1 << 12  # number of points that are evaluated together
SMOOTHEST = 1e-3**0.5  # smaller roughness is treated as this one
# Edge of what a look-up averages, in pixels: mip maps and interpolation within and between them average about as much
# again. Against the mean over the pixel: 1 leaves 5.2, 3.5 and 2.2 % of three textures, this 2.9, 1.5 and 1.0 %. Probes
# along a footprint are as far apart as the pixel is long.
SHARPER = 0.64
Images = Mapping[tuple[int, bool], Array | np.ndarray]  # by the identity of the image, and whether it is a normal map
_LEVELS = 16  # of a mip map at most: images of up to 32,768 texels along an edge
_PROBES = 4  # lookups along an elongated footprint
_SMALL = 1 << 16  # values of all textures up to which padding to coarser sizes is not worth avoiding
_LONG = 1.5  # ratio of length to width above which one lookup is not enough


class Values(NamedTuple):
    """Material parameters at points; `jaxprt.scene.material.MaterialValues` explains them."""

    base_color: Float[Array | np.ndarray, "p 3"]
    metallic: Float[Array | np.ndarray, " p"]
    roughness: Float[Array | np.ndarray, " p"]
    emissive: Float[Array | np.ndarray, "p 3"]
    specular: Float[Array | np.ndarray, " p"]
    specular_color: Float[Array | np.ndarray, "p 3"]
    ior: Float[Array | np.ndarray, " p"]


class Layers(NamedTuple):
    """Parameters of layers at points; `jaxprt.scene.TexturedMaterial` explains them."""

    clearcoat: Float[Array, " p"]
    clearcoat_roughness: Float[Array, " p"]
    transmission: Float[Array, " p"]
    sheen_color: Float[Array, "p 3"]
    sheen_roughness: Float[Array, " p"]


class MaterialLook(NamedTuple):
    """What systems need of the materials at points.

    Attributes:
        coefficient: Weights of the four terms of `jaxprt.brdf.MetallicRoughness`. Those of `BlinnPhong` are its colors:
            diffuse, specular, 0 and 0; those of `CookTorrance` are diffuse, specular x F0, specular x (1 - F0) and 0.
            In scenes with layers these are followed by the weights under a clear coat and by that of the coat, and by
            those under a sheen and that of the sheen; without a layer the first four are those of the material. See
            `jaxprt.systems.standard.layered`.
        log_roughness: Logarithm of the roughness; that of metallic-roughness materials is at least `SMOOTHEST`.
        emitted: Radiance that the surface emits.
        values: The parameters themselves.
        log_layer: Logarithm of the roughness of the layer; None in scenes without layers.
        normal: Unit shading normals in world space, tilted by normal maps; None in scenes without such maps. Roughness
            includes the variance of the map's normals over a pixel.
    """

    coefficient: Float[Array | np.ndarray, "p k 3"]
    log_roughness: Float[Array | np.ndarray, " p"]
    emitted: Float[Array | np.ndarray, "p 3"]
    values: Values
    log_layer: Float[Array | np.ndarray, " p"] | None = None
    normal: Float[Array | np.ndarray, "p 3"] | None = None


class Texels(eqx.Module):
    """The mip maps of several images, one after another in one array.

    Attributes:
        value: Channels of the texels, texel by texel, row by row, level by level, image by image.
        start: Index of the first value of each level of each image.
        shape: Height and width of each image; 0 in padding.
        channels: Number of channels of each image.
    """

    value: Float[Array | np.ndarray, " t"]
    start: Int[Array | np.ndarray, "i n"]
    shape: Int[Array | np.ndarray, "i 2"]
    channels: Int[Array | np.ndarray, " i"]


class MaterialTable(eqx.Module):
    """Materials of several parts, and what the vertices of these parts hold for them.

    Attributes:
        factor: Factors of each material.
        image: Index of the image of each texture of each material; -1 for none.
        transform: Transform of the texture coordinates of each texture.
        set: Index of the set of texture coordinates of each texture.
        wrap: Wrap mode of each texture along u and v, as an index into `texture.WRAPS`.
        texels: The images.
        part: Index of the material of each vertex.
        coordinate: Both sets of texture coordinates of each vertex.
        color: Color of each vertex, which multiplies the base color.
        frame: Normal, tangent and handedness of each vertex; None in scenes without normal maps.
        normal_scale: Factor of the slopes of each material's normal map; None in scenes without.
        rough: Materials of the same roughness, which is known, where JAX traces other parameters; else None.
    """

    factor: Float[Array | np.ndarray, "m f"]
    image: Int[Array | np.ndarray, "m s"]
    transform: Float[Array | np.ndarray, "m s 2 3"]
    set: Int[Array | np.ndarray, "m s"]
    wrap: Int[Array | np.ndarray, "m s 2"]
    texels: Texels
    part: Int[Array | np.ndarray, " v"]
    coordinate: Float[Array | np.ndarray, "v 4"]
    color: Float[Array | np.ndarray, "v 3"]
    frame: Float[Array | np.ndarray, "v 7"] | None = None
    normal_scale: Float[Array | np.ndarray, " m"] | None = None
    rough: "MaterialTable | None" = None

    @property
    def tilted(self) -> Bool[np.ndarray, " m"]:
        """Whether each material has a normal map."""
        return np.asarray(self.image)[:, _NORMAL] >= 0

    @property
    def layered(self) -> bool:
        """Whether it has columns for layers: clear coats, sheens and transmission."""
        return self.image.shape[1] > len(TEXTURES)

    def at(self, points: Points) -> MaterialLook:
        """The materials at points. Textures are averaged over the pixels of points that have slopes.

        Outside of `jax.jit` any number of points runs one program, and the result of other numbers than `ROW` is in
        NumPy.
        """
        if self.rough is not None:
            look, plain = dataclasses.replace(self, rough=None).at(points), self.rough.at(points)
            return look._replace(log_roughness=plain.log_roughness, log_layer=plain.log_layer)
        with compile_time(self, points):
            count = len(points)
            if count == ROW or not count or not known(points) or points.corner.shape[0] != 3:
                return _evaluate(self, points)
            index = np.minimum(np.arange(-(-count // ROW) * ROW), count - 1).reshape(-1, ROW)
            host = jax.tree.map(np.asarray, points)
            slope = np.zeros((2, *host.weight.shape), host.weight.dtype) if host.slope is None else host.slope
            rows = [_evaluate(self, put(Points(host.corner[:, n], host.weight[:, n], slope[..., n]))) for n in index]
            xp = np if known(rows) else jnp
            return jax.tree.map(lambda *row: xp.concatenate(row)[:count], *rows)

    def at_vertices(self) -> MaterialLook:
        """The materials at all vertices; in NumPy unless JAX traces the table."""
        return self.at(at_vertices(np.arange(len(self.part), dtype=np.int32)))


def at_vertices(vertex: Int[np.ndarray, " p"]) -> Points:
    """Vertices as points, at which textures are read sharply."""
    weight = np.zeros((3, len(vertex)), jnp.result_type(float))
    weight[0] = 1
    return put(Points(np.stack([vertex] * 3), weight, np.zeros((2, *weight.shape), weight.dtype)))


@partial(kept, quick=True)
def _evaluate(table: MaterialTable, points: Points) -> MaterialLook:
    values, layers = _values(table, points)
    normal = None
    if table.frame is not None and table.normal_scale is not None:
        normal, variance = _normals(table, table.frame, table.normal_scale, points)
        values = values._replace(roughness=texture.widen_roughness(values.roughness, variance))
        layers = layers and layers._replace(
            clearcoat_roughness=texture.widen_roughness(layers.clearcoat_roughness, variance)
        )
    row = table.factor[table.part[points.corner[0]]]
    grooves, f0 = row[:, _MODEL, None] == _COOK_TORRANCE, row[:, _F0]
    none, specular = jnp.zeros_like(values.base_color), values.specular_color
    mirror, rim = specular * jnp.where(grooves, f0, 1), specular * jnp.where(grooves, 1 - f0, 0)
    shiny, colors = row[:, _MODEL] > 0, jnp.stack([values.base_color, mirror, rim, none], 1)
    material = MetallicRoughness(**{name: value for name, value in values._asdict().items() if name != "emissive"})
    coefficient = jnp.where(shiny[:, None, None], colors, material.coefficient())
    least = jnp.where(shiny, 0, SMOOTHEST)
    look = MaterialLook(
        coefficient, jnp.log(jnp.maximum(values.roughness, least)), values.emissive, values, normal=normal
    )
    if layers is None:
        return look
    coated = row[:, _LAYER] > 0
    return _under_layers(look, layers, coated)


def _under_layers(look: MaterialLook, layers: Layers, coated: Bool[Array, " p"]) -> MaterialLook:
    """The materials with their layers: what is under a coat or a sheen, and less diffuse light where light passes."""
    coat, passing = layers.clearcoat, 1 - layers.transmission
    base = look.coefficient * jnp.stack([passing, jnp.ones_like(coat), jnp.ones_like(coat), passing], 1)[..., None]
    color = jnp.where(coated[:, None], 0, layers.sheen_color)
    weight, most = coat[:, None, None], jnp.max(color, 1)[:, None, None]
    gray = jnp.broadcast_to(weight, (len(coat), 1, 3))
    rows = (1 - weight - most) * base, weight * base, gray, most * base, color[:, None]
    coefficient = jnp.concatenate(rows, 1)
    roughness = jnp.where(
        jnp.any(color > 0, 1),
        jnp.maximum(layers.sheen_roughness, sheen.SMOOTHEST),
        jnp.maximum(layers.clearcoat_roughness, SMOOTHEST),
    )
    return look._replace(coefficient=coefficient, log_layer=jnp.log(roughness))


def _values(table: MaterialTable, points: Points) -> tuple[Values, Layers | None]:
    """The parameters at points, and those of their layers; None in scenes without."""
    factor = table.factor[table.part[points.corner[0]]]
    read = partial(_read, table, points, _coordinates(table, points))
    base, metallic, roughness, emissive, specular, tint = jax.lax.map(read, jnp.arange(COLORS))
    layers = None
    if table.layered:
        scale = jax.lax.map(read, len(TEXTURES) + jnp.arange(len(_LAYERS)))
        begin, columns = _LAYER, []
        for texel, (_, width) in zip(scale, _LAYERS, strict=True):
            value = factor[:, begin : begin + width] * texel[:, :width]
            columns.append(value if width > 1 else value[:, 0])
            begin += width
        layers = Layers(*columns)
    color = points.carry(table.color)
    first = np.cumsum([0, *(width for _, width in _FACTORS)])
    factors = {name: factor[:, begin : begin + width] for (name, width), begin in zip(_FACTORS, first, strict=False)}
    values = Values(
        factors["base_color"] * base * color,
        factors["metallic"][:, 0] * metallic[:, 0],
        factors["roughness"][:, 0] * roughness[:, 0],
        factors["emissive"] * emissive,
        factors["specular"][:, 0] * specular[:, 0],
        factors["specular_color"] * tint,
        factors["ior"][:, 0],
    )
    return values, layers


def _normals(
    table: MaterialTable,
    frame: Float[Array | np.ndarray, "v 7"],
    scale: Float[Array | np.ndarray, " m"],
    points: Points,
) -> tuple[Float[Array, "p 3"], Float[Array, " p"]]:
    """Shading normals at points, and the variance of the normals that a pixel averages; see `normal_maps`."""
    part, base = table.part[points.corner[0]], points.carry(frame)
    has, scale = table.image[part, _NORMAL] >= 0, scale[part]
    frame = directions.frame(directions.normalize(base[:, :3]), base[:, 3:6])
    coordinate, slope = _coordinates(table, points)
    place = coordinate, slope
    mean = 2 * _read(table, points, place, _NORMAL) - 1
    normal = texture.tilt_normals(frame, jnp.where(base[:, 6] < 0, -1, 1), mean, scale)
    _, moving = _in_image(table, part, place, _NORMAL)
    shape = table.texels.shape[jnp.maximum(table.image[part, _NORMAL], 0)]
    footprint = SHARPER * jnp.sqrt(jnp.max(jnp.sum((moving * shape[:, ::-1]) ** 2, -1), 0))
    variance = texture.normal_variance(mean, scale, jax.lax.stop_gradient(footprint))
    return jnp.where(has[:, None], normal, frame[:, 2]), jnp.where(has, variance, 0)


def _coordinates(table: MaterialTable, points: Points) -> tuple[Float[Array, "p 4"], Float[Array, "2 p 4"]]:
    """Both sets of texture coordinates at points, and their change from pixel to pixel."""
    return points.carry(table.coordinate), points.slopes(table.coordinate)


def _in_image(
    table: MaterialTable, part: Array, place: tuple[Array, Array], texture: Array | int
) -> tuple[Float[Array, "p 2"], Float[Array, "2 p 2"]]:
    """Coordinates of points in the image of a texture, and their change from pixel to pixel."""
    second = table.set[part, texture][:, None] > 0
    turn = table.transform[part, texture]
    coordinate, change = (jnp.where(second, value[..., 2:], value[..., :2]) for value in place)
    moved = jnp.einsum("pij,pj->pi", turn[..., :2], coordinate, precision="highest") + turn[..., 2]
    return moved, jnp.einsum("pij,kpj->kpi", turn[..., :2], change, precision="highest")


def _read(
    table: MaterialTable, points: Points, place: tuple[Array, Array], texture: Array | int
) -> Float[Array, "p 3"]:
    """Values of a texture at points with coordinates `place`, from `_coordinates`; 1 where the material has none."""
    part = table.part[points.corner[0]]
    image = table.image[part, texture]

    def image_values() -> Array:
        moved, moving = _in_image(table, part, place, texture)
        value = _look_up(table.texels, jnp.maximum(image, 0), moved, moving, table.wrap[part, texture])
        return jnp.where(image[:, None] >= 0, value, 1)

    return jax.lax.cond(jnp.any(image >= 0), image_values, lambda: jnp.ones((len(points), 3), table.texels.value.dtype))


def _look_up(
    texels: Texels,
    image: Int[Array, " p"],
    coordinate: Float[Array, "p 2"],
    slope: Float[Array, "2 p 2"],
    wrap: Int[Array, "p 2"],
) -> Float[Array, "p 3"]:
    """Values of images at points that each read an image of their own, averaged over the pixel."""
    shape = texels.shape[image]
    scaled = SHARPER * jax.lax.stop_gradient(slope) * shape[:, ::-1].astype(slope.dtype)
    length = jnp.sqrt(jnp.sum(scaled**2, -1))
    long, short = jnp.maximum(length[0], length[1]), jnp.minimum(length[0], length[1])
    along = jnp.where((length[0] > length[1])[:, None], slope[0], slope[1])

    def probes(count: int) -> Array:
        level = jnp.log2(jnp.maximum(jnp.maximum(short, long / count), 1.0))
        offset = (np.arange(count) + 0.5) / count - 0.5
        if count == 1:
            return _trilinear(texels, image, shape, coordinate, level, wrap)

        def one(total: Array, step: Array) -> tuple[Array, None]:
            return total + _trilinear(texels, image, shape, coordinate + step * along, level, wrap), None

        start = jnp.zeros((len(image), 3), texels.value.dtype)
        return jax.lax.scan(one, start, jnp.asarray(offset, slope.dtype))[0] / count

    flat = jnp.any((long > _LONG * short) & (long > _LONG))
    return jax.lax.cond(flat, lambda: probes(_PROBES), lambda: probes(1))


def _trilinear(texels: Texels, image: Array, shape: Array, coordinate: Array, level: Array, wrap: Array) -> Array:
    most = jnp.sum(texels.start[image] >= 0, 1) - 1  # the coarsest level
    low = jnp.minimum(jnp.floor(level).astype(jnp.int32), jnp.maximum(most - 1, 0))
    upper = jnp.clip(level - low, 0, 1)
    channels = texels.channels[image]
    channel = jnp.minimum(jnp.arange(3), channels[:, None] - 1)

    def one(total: Array, step: Array) -> tuple[Array, None]:
        number = jnp.minimum(low + step, most)
        height, width = (-(-shape[:, axis] >> number) for axis in (0, 1))
        start = texels.start[image, number]
        weight = jnp.where(step > 0, upper, 1 - upper)
        for (row, column), part in _bilinear(coordinate, height, width, wrap):
            place = start + (row * width + column) * channels
            total = total + texels.value[place[:, None] + channel] * (part * weight)[:, None]
        return total, None

    return jax.lax.scan(one, jnp.zeros((len(image), 3), texels.value.dtype), jnp.arange(2))[0]


def _bilinear(coordinate: Array, height: Array, width: Array, wrap: Array) -> list:
    """`jaxprt.scene.texture.bilinear` with a size and wrap modes for each point."""
    clamp, mirror = texture.WRAPS.index("clamp"), texture.WRAPS.index("mirror")

    def reduced(place: Array, mode: Array) -> Array:
        period = jnp.where(mode == mirror, 2, 1)
        return jnp.where(mode == clamp, jnp.clip(place, 0, 1), place - period * jnp.floor(place / period))

    def inside(index: Array, size: Array, mode: Array) -> Array:
        """The texel that an index of at most one period further shows. Comparisons are faster than remainders."""
        period = jnp.where(mode == mirror, 2 * size, size)
        turned = jnp.where(index < 0, index + period, jnp.where(index >= period, index - period, index))
        turned = jnp.where(mode == mirror, jnp.minimum(turned, 2 * size - 1 - turned), turned)
        return jnp.clip(jnp.where(mode == clamp, index, turned), 0, size - 1)

    x = reduced(coordinate[:, 0], wrap[:, 0]) * width - 0.5
    y = (1 - reduced(coordinate[:, 1], wrap[:, 1])) * height - 0.5
    column, row = jnp.floor(x), jnp.floor(y)
    right, down = x - column, y - row
    lines, columns = (
        [inside(first.astype(jnp.int32) + step, size, wrap[:, axis]) for step in (0, 1)]
        for first, size, axis in ((row, height, 1), (column, width, 0))
    )
    weights = [(1 - down, down), (1 - right, right)]
    return [((lines[i], columns[j]), weights[0][i] * weights[1][j]) for i in (0, 1) for j in (0, 1)]


def of_parts(parts: Sequence[Part]) -> MaterialTable:
    """The materials of some parts, in the order of the vertices of all of them.

    A part whose material is a BRDF has the values of a white material, which nobody reads.
    """
    materials = [part.material for part in parts]
    count = [len(part.mesh.position) for part in parts]
    dtype, room = jnp.result_type(float), shared_size(sum(count)) - sum(count)

    def column(values, otherwise, width):
        pairs = zip(count, values, strict=True)
        rows = [np.full((n, width), otherwise, dtype) if value is None else value for n, value in pairs]
        return _concatenate([*rows, np.full((room, width), otherwise, dtype)], dtype)

    first = column([part.mesh.texture for part in parts], 0.0, 2)
    second = column([part.mesh.texture if part.second is None else part.second for part in parts], 0.0, 2)
    both = jnp.concatenate([first, second], 1) if not known(first, second) else np.concatenate([first, second], 1)
    part = np.repeat(np.arange(len(parts), dtype=np.int32), count)
    columns = np.pad(part, (0, room)), both, column([item.color for item in parts], 1.0, 3)
    held: dict[str, Any] = dict(zip(("part", "coordinate", "color"), columns, strict=True))
    layered = any(has_layers(material) for material in materials)
    if any(_has_map(material) for material in materials):
        hand = column(
            [item.handedness if item.handedness is None else item.handedness[:, None] for item in parts], 1.0, 1
        )
        rows = [column([getattr(item.mesh, name) for item in parts], 1.0, 3) for name in ("normal", "tangent")]
        held["frame"] = (np if known(rows, hand) else jnp).concatenate([*rows, hand], 1)
    return MaterialTable(**_rows(materials, dtype, layered=layered, tilted="frame" in held), **held)


def _has_map(material: object) -> bool:
    return isinstance(material, TexturedMaterial) and material.normal_texture is not None


def with_materials(
    table: MaterialTable,
    materials: Sequence[TexturedMaterial | Callable],
    before: Sequence[TexturedMaterial | Callable],
) -> MaterialTable:
    """The table with other materials of the same parts.

    Its arrays are at least as large as before, so that materials with fewer or smaller textures run the same programs.
    Texels are copied only where there are new images.

    Args:
        table: The table.
        materials: The new materials.
        before: Those of the table.
    """
    if table.frame is None and any(_has_map(material) for material in materials):
        raise ValueError(
            "materials may have normal maps only in scenes that were precomputed with one, got a new map: precompute "
            "the scene with it"
        )
    held: dict[str, Any] = {name: getattr(table, name) for name in ("part", "coordinate", "color", "frame")}
    old = _images(before)
    layered = table.layered or any(has_layers(material) for material in materials)
    tilted = table.frame is not None
    rows = _rows(materials, table.factor.dtype, layered=layered, tilted=tilted, old=old, texels=table.texels)
    return MaterialTable(**rows, **held)


def has_layers(material: object) -> bool:
    """Whether a material has a clear coat or a sheen or lets light pass. Values that JAX traces may be anything."""
    if not isinstance(material, TexturedMaterial):
        return False
    return any(may_be(factor) for factor in (material.clearcoat, material.transmission, material.sheen_color))


def may_be(value: object) -> bool:
    """Whether a factor is not 0; true for one that JAX traces."""
    return isinstance(value, Tracer) or bool(np.any(np.asarray(value) != 0))


def _key(name: str, source: Texture) -> tuple[int, bool]:
    """Key of the image of a texture of some name. An image that is a normal map and another texture has two."""
    return id(source.image), name == TEXTURES[_NORMAL]


def _images(materials: Sequence[TexturedMaterial | Callable]) -> Images:
    """The images of the textures of some materials, each once."""
    names = (*TEXTURES, *LAYER_TEXTURES)
    pairs = [(name, getattr(material, name, None)) for material in materials for name in names]
    return {_key(name, source): source.image for name, source in pairs if source is not None}


def _rows(
    materials: Sequence[TexturedMaterial | Callable],
    dtype: DTypeLike,
    *,
    layered: bool,
    tilted: bool,
    old: Images | None = None,
    texels: Texels | None = None,
) -> dict[str, Array | np.ndarray | Texels]:
    """Factors, textures and images of some materials, padded to a number of materials that scenes share."""
    rows, images = shared_size(len(materials)), _images(materials)
    # `texels` holds the images `old` already, and serves again if there are no others.
    if texels is None or old is None or set(images) - set(old):
        texels = _texels(images, dtype, texels)
    else:
        images = old
    names = (*TEXTURES, *LAYER_TEXTURES) if layered else TEXTURES
    number, image = {key: n for n, key in enumerate(images)}, np.full((rows, len(names)), -1, np.int32)
    transform: Array | np.ndarray = np.zeros((*image.shape, 2, 3), dtype)
    sets, wrap = np.zeros(image.shape, np.int32), np.zeros((*image.shape, 2), np.int32)
    for row, material in enumerate(materials):
        for column, name in enumerate(names):
            source: Texture | None = getattr(material, name, None)
            if source is None:
                continue
            image[row, column] = number[_key(name, source)]
            sets[row, column] = source.set
            wrap[row, column] = [texture.WRAPS.index(mode) for mode in source.wrap]
            transform = _set_at(transform, (row, column), source.transform)
    factor = _concatenate([_factors(material, layered)[None] for material in materials], dtype)
    padding = np.zeros((rows - len(materials), factor.shape[1]), dtype)
    columns = {"image": image, "transform": transform, "set": sets, "wrap": wrap, "texels": texels}
    if tilted:
        scale = [np.reshape(getattr(material, "normal_scale", 1.0), 1) for material in materials]
        columns["normal_scale"] = _concatenate([*scale, np.ones(rows - len(materials))], dtype)
    return {"factor": _concatenate([factor, padding], dtype), **columns}


def _set_at(array: Array | np.ndarray, place: tuple[int, int], value: Array | np.ndarray) -> Array | np.ndarray:
    """The array with another value at a place."""
    if isinstance(value, Tracer) or isinstance(array, Tracer):
        return jnp.asarray(array).at[place].set(value)
    array = np.array(array)
    array[place] = value
    return array


def _factors(material: TexturedMaterial | Callable, layered: bool) -> Array | np.ndarray:
    """The factors of a material as one row: `_FACTORS`, the kind of model, its F0, and those of layers."""
    textured = material if isinstance(material, TexturedMaterial) else TexturedMaterial()
    xp = np if known(material, textured) else jnp  # a material that is made while JAX traces has traced factors
    layers = [getattr(textured, name) for name, _ in _LAYERS] if layered else []
    factor: dict[str, Any] = dict(vars(textured))
    model, f0 = _METALLIC_ROUGHNESS, xp.zeros(3)
    if isinstance(material, BlinnPhong | CookTorrance):
        factor |= {"base_color": material.diffuse, "specular_color": material.specular}
        layers = [0] * sum(width for _, width in _LAYERS) if layered else []
    if isinstance(material, BlinnPhong):
        model, factor["roughness"] = _BLINN_PHONG, xp.sqrt(2 / (material.exponent + 2))
    elif isinstance(material, CookTorrance):
        model, factor["roughness"], f0 = _COOK_TORRANCE, material.roughness, xp.broadcast_to(material.f0, (3,))
    return xp.hstack([*(xp.broadcast_to(factor[name], (width,)) for name, width in _FACTORS), model, *f0, *layers])


def _concatenate(rows: Sequence[Array | np.ndarray], dtype: DTypeLike) -> Array | np.ndarray:
    return jnp.concatenate(rows).astype(dtype) if not known(rows) else np.concatenate(rows).astype(dtype)


def _texels(images: Images, dtype: DTypeLike, least: Texels | None = None) -> Texels:
    """The mip maps of some images in one array, padded to a size that scenes share, or to that of other texels."""
    rows, room = (1, 4) if least is None else (len(least.shape), len(least.value))
    rows = max(shared_size(len(images)), rows)
    start, shape, channels = np.full((rows, _LEVELS), -1), np.ones((rows, 2), np.int32), np.ones(rows, np.int32)
    start[:, 0], values, total = 0, [], 0
    for row, ((_, normals), image) in enumerate(images.items()):
        image = texture.unit_normals(image) if normals else image
        for level, pixels in enumerate(texture.mipmap(image)):
            start[row, level] = total
            total += pixels.size
            values.append(pixels.reshape(-1))
        shape[row], channels[row] = image.shape[:2], image.shape[2]
    if total >= 1 << 31:
        raise ValueError(f"textures must have fewer than 2^31 values with their mip maps, got {total}")
    size = max(shared_size(total, fine=total > _SMALL), room)
    value = _concatenate([*values, np.ones(size - total, dtype)], dtype)
    return Texels(value, start.astype(np.int32), shape, channels)
