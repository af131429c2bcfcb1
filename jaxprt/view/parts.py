"""Data of a scene's parts in exported pages, which relight in the browser without Python."""

import math
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jaxprt.brdf import GGX, BlinnPhong, CookTorrance
from jaxprt.brdf.varying import Channels
from jaxprt.relit.channels import Shading
from jaxprt.relit.scene import RelitScene
from jaxprt.scene import TexturedMaterial
from jaxprt.scene.material import Texture
from jaxprt.systems import harmonic, lobe, standard
from jaxprt.systems.lobe import blurred_light, pyramid
from jaxprt.view import matrices
from jaxprt.view.reduced import (
    Exported,
    bits_of,
    edge_of,
    scale_of,
    systems_of,
    texels_of,
    vector_unit,
    vectors_of,
    visibility_of,
)

NO_SCALES = {"edges": [1], "spreads": [1.0], "starts": [0]}  # for scenes without glossy parts
_STARTS = ("first", "weightStart", "pyramidStart", "visibleStart", "arrivedStart", "bitStart")
# Terms by which the page's module represents `ShininessFamily` and `SlopeFamily`.
_TERMS = {standard.BLINN_PHONG: [3, 4], standard.COOK_TORRANCE: [3, 5, 6]}
_SKY = 64  # most texels along the edge of a light's faces


def content(reduced: RelitScene, level: int) -> tuple[dict[str, Any], list[bytes]]:
    """JSON description and arrays of all parts. `Piece` in the page's module defines their order."""
    systems, bits = systems_of(reduced), bits_of(reduced)
    vectors, visible = [vectors_of(exported) for exported in systems], visibility_of(reduced)
    unit, visible_unit = vector_unit(vectors), vector_unit(visible)
    terms = max(-(-len(unit) // 4) * 4, 4)
    place: dict[str, int] = dict.fromkeys(_STARTS, 0)
    tables, tilted = _Tables(), reduced.table.at_vertices().normal
    parts, stride = [], 0
    arrays: list[list[np.ndarray]] = [[] for _ in range(6)]
    for number, (part, system, vector) in enumerate(zip(reduced.scene.parts, systems, vectors, strict=True)):
        shading, (start, table) = reduced.shading[number], tables.add(part.name, system)
        weight, seen, described = (
            _weights(shading, system),
            _means(system, level),
            _material_json(part.material, shading),
        )
        words = None if bits is None else bits[number]
        bit = np.zeros((0, 0), np.uint8) if words is None else words
        about = _system_json(system) | {"family": _family(shading), "texels": bool(bit.size)}
        about |= {"name": part.name, "count": vector.shape[1], "channels": weight.shape[1] - 1}
        about |= {"nodes": table.shape[1], "entries": table.shape[2], "terms": -(-len(vector) // 4) * 4}
        about |= {"weightStep": 0 if described else weight.shape[1], **(described or {})}
        parts.append(about | place | {"tableStart": start})
        weight = weight[:1] if described else weight
        stride = max(stride, seen.shape[1])
        rows = _bytes(vector, unit, terms), _bytes(visible[number], visible_unit, 4 * about["words"])
        first = int(reduced.place.first[number])
        direction = shading.mesh.normal if tilted is None else tilted[first : first + len(shading.mesh.normal)]
        normal = np.round(32767 * np.asarray(direction))
        kinds = "<i2", "i1", "u1", "<f4", "i1", "u1"
        for column, array, kind in zip(arrays, (normal, rows[0], seen, weight, rows[1], bit), kinds, strict=True):
            column.append(array.astype(kind).reshape(-1))
        pairs = len(vector.T) * -(-(about["bands"] ** 2) // 2)
        sizes = vector.shape[1], weight.size // 4, seen.size, rows[1].size // 4, pairs, bit.size
        place = {name: start + size for (name, start), size in zip(place.items(), sizes, strict=True)}
    content = {"parts": parts, "terms": terms, "vectorUnit": unit.tolist(), "stride": stride, **_scales(reduced, level)}
    content |= {"visibleUnit": visible_unit.tolist(), "arrived": place["arrivedStart"]}
    edge = 0 if bits is None else math.isqrt(8 * next(words.shape[1] for words in bits if words is not None) // 6)
    content |= {"texelEdge": edge, "texels": texels_of(edge) if edge else 0}
    joined = [np.concatenate(column) for column in arrays]
    joined.insert(3, tables.joined())
    joined[2] = np.append(joined[2], np.zeros(4 - len(joined[2]) % 4, np.uint8))  # whole words
    return content, [array.tobytes() for array in joined]


class _Tables:
    """The tables of a page. Parts with one BRDF share one table."""

    def __init__(self):
        """Starts without tables."""
        self._made: dict[Any, tuple[int, Float[np.ndarray, "h q e 4"]]] = {}
        self._end = 0

    def add(self, name: str, system: Exported) -> tuple[int, Float[np.ndarray, "h q e 4"]]:
        """The table of a part's system, and where its texels start among those of all tables."""
        key = _key(system)
        if key not in self._made:
            table = _table(name, system)
            self._made[key] = self._end, table
            self._end += table.size // 4
        return self._made[key]

    def joined(self) -> Float[np.ndarray, " n"]:
        """The texels of all tables."""
        return np.concatenate([table.astype("<f4").reshape(-1) for _, table in self._made.values()])


def _key(system: Exported) -> Any:
    """Equal for systems with equal tables."""
    if isinstance(system, harmonic.DiffuseSystem):
        return None
    leaves, kind = jax.tree.flatten(system.brdf)
    return kind, *((np.shape(leaf), np.asarray(leaf).tobytes()) for leaf in leaves)


def _system_json(system: Exported) -> dict[str, Any]:
    """JSON description of a part's system for the page's module."""
    about = {"lobes": 0, "bands": 0, "words": 0, "steps": 0.0, "knot": [], "laplacian": 1.0}
    if isinstance(system, lobe.LobeSystem):
        return about | {"lobes": system.brdf.lobes, "steps": float(system.brdf.weight.shape[-1] - 1), **_knot(system)}
    if isinstance(system, harmonic.HarmonicSystem):
        fields = {"bands": system.degree + 1, "words": matrices.words(system), "laplacian": float(system.laplacian)}
        return about | fields | {"steps": system.brdf.steps, **_knot(system)}
    return about


def _knot(system: lobe.LobeSystem | harmonic.HarmonicSystem) -> dict[str, list[float]]:
    return {"knot": np.asarray(system.brdf.knot[0], float).tolist() if system.brdf.knot else []}


def _bytes(value: Float[np.ndarray, "k v"], unit: Float[np.ndarray, " m"], length: int) -> Float[np.ndarray, "v l"]:
    """Values quantized to integer multiples of the units, in rows of a given length."""
    padded = np.zeros((value.shape[1], length))
    padded[:, : len(value)] = np.round(value / unit[: len(value), None]).T
    return padded


def _scales(reduced: RelitScene, level: int) -> dict[str, Any]:
    """The scales of visibility that the page keeps."""
    scale = scale_of(reduced)
    if scale is None:
        return NO_SCALES
    starts = scale.start[level:] - scale.start[level]
    return {"edges": scale.edge[level:].tolist(), "spreads": scale.spread[level:].tolist(), "starts": starts.tolist()}


def mips(size: int) -> list[int]:
    """Sizes of the cubemaps in the mip chain that the page computes from a light."""
    while size > _SKY and size % 2 == 0:
        size //= 2
    result = [size]
    while result[-1] % 2 == 0 and result[-1] > 4:
        result.append(result[-1] // 2)
    return result


def blur_parameters(size: int) -> dict[str, Any]:
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


def _family(shading: Shading) -> dict[str, list]:
    """Numbers of the BRDF terms of a part's channels in the page's module, and their factors; empty if unknown."""
    if shading.blend is None or shading.scale is None:
        return {"terms": [], "scale": []}
    terms = list(shading.term) if shading.table is None else _TERMS.get(shading.table, list(shading.term))
    return {"terms": terms, "scale": np.asarray(shading.scale, float).tolist()}


def _means(system: Exported, level: int) -> np.ndarray:
    if not isinstance(system, lobe.LobeSystem):
        return np.zeros((0, 0), np.uint8)
    transport = system.transport
    return np.ascontiguousarray(np.asarray(transport.pyramid)[:, pyramid.scales(edge_of(transport)).start[level] :])


def _table(name: str, system: Exported) -> Float[np.ndarray, "h q e 4"]:
    """Table of a part's BRDF. Parts with transfer matrices use `jaxprt.view.matrices.plane_table`.

    For lobes it holds, for each knot and view node, the mean, log concentration and weights of each lobe, and albedos.
    """
    if isinstance(system, harmonic.HarmonicSystem):
        return matrices.plane_table(name, system.brdf)
    if not isinstance(system, lobe.LobeSystem):
        return np.ones((1, 1, 1, 4))
    brdf = system.brdf
    mean, scale, weight, albedo = (np.asarray(array) for array in (brdf.mean, brdf.scale, brdf.weight, brdf.diffuse))
    if not brdf.knot:
        mean, scale, weight, albedo = mean[:, :, None], scale[:, None], weight[:, :, None], albedo[:, None]
    lobes, knots, nodes = scale.shape
    result = np.zeros((knots, nodes, 2 * lobes + 1, 4))
    result[:, :, 0:-1:2, :3] = mean.transpose(2, 3, 1, 0)
    result[:, :, 0:-1:2, 3] = scale.transpose(1, 2, 0)
    result[:, :, 1::2, : len(weight)] = weight.transpose(2, 3, 1, 0)
    result[:, :, -1, : len(albedo)] = albedo.transpose(1, 2, 0)
    return result


def _weights(shading: Shading, system: Exported) -> Float[np.ndarray, "v k 4"]:
    """Channel weights at each vertex, followed by its emission. The first row also holds the logarithm of roughness."""
    count = len(shading.mesh.position)
    if shading.blend is not None:
        weight = np.asarray(shading.blend.weight)
    elif isinstance(system, harmonic.DiffuseSystem):
        weight = np.broadcast_to(np.asarray(system.albedo), (count, 1, len(system.albedo)))
    else:
        brdf = system.brdf
        channels = len(brdf.weight) if isinstance(brdf, lobe.LobeBrdf) else brdf.table.shape[1]
        weight = np.broadcast_to(np.eye(channels) if channels > 1 else np.ones((1, 3)), (count, channels, 3))
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


def _colors(material: Any, *names: str) -> dict[str, list[float]]:
    """Parameters of a material in three colors."""
    return {name: np.broadcast_to(np.asarray(getattr(material, name), float), 3).tolist() for name in names}


def _material_json(material: Any, shading: Shading) -> dict[str, Any] | None:
    """Parameters of a material that is the same at all vertices; None for other materials."""
    if isinstance(material, BlinnPhong) and shading.table == standard.BLINN_PHONG:
        return {"material": _colors(material, "diffuse", "specular") | {"exponent": float(material.exponent)}}
    if isinstance(material, CookTorrance) and shading.table == standard.COOK_TORRANCE:
        return {"material": _colors(material, "diffuse", "specular", "f0") | {"slope": float(material.roughness)}}
    if not isinstance(material, TexturedMaterial) or shading.scale is None:
        return None
    if any(isinstance(leaf, Texture) for leaf in jax.tree.leaves(material, is_leaf=lambda x: isinstance(x, Texture))):
        return None
    names = ("base_color", "metallic", "specular", "specular_color", "ior", "roughness")
    values = {name: np.asarray(getattr(material, name), float).tolist() for name in names}
    return {"material": values}
