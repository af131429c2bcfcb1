"""What a page that relights without Python holds of the parts of a scene, as arrays."""

import math
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jaxprt.brdf import GGX
from jaxprt.brdf.varying import Channels
from jaxprt.relit.channels import Shading
from jaxprt.relit.scene import RelitScene
from jaxprt.scene import TexturedMaterial
from jaxprt.scene.material import Texture
from jaxprt.systems import harmonic, lobe
from jaxprt.systems.lobe import pyramid, relight
from jaxprt.view.reduced import (
    Exported,
    bits_of,
    edge_of,
    scale_of,
    systems_of,
    texels_of,
    vector_unit,
    vectors_of,
)

NO_SCALES = {"edges": [1], "spreads": [1.0], "starts": [0]}  # of scenes without glossy parts
_SKY = 64  # texels along the edge of a light's faces, at most


def content(reduced: RelitScene, level: int) -> tuple[dict[str, Any], list[bytes]]:
    """What the page's module reads of the parts, and normals, vectors, visibility, tables and weights of all."""
    systems = systems_of(reduced)
    vectors = [vectors_of(each) for each in systems]
    unit = vector_unit(vectors)
    terms = -(-len(unit) // 4) * 4
    place = {"first": 0, "tableStart": 0, "weightStart": 0, "pyramidStart": 0}
    parts, stride = [], 0
    arrays: list[list[np.ndarray]] = [[], [], [], [], []]
    for number, (part, system, vector) in enumerate(zip(reduced.scene.parts, systems, vectors, strict=True)):
        shading, table = reduced.shading[number], _table(system)
        weight, seen, described = _weights(shading, system), _means(system, level), _described(part.material, shading)
        parts.append(
            {
                "name": part.name,
                "count": vector.shape[1],
                "lobes": system.brdf.lobes if isinstance(system, lobe.LobeSystem) else 0,
                "channels": weight.shape[1] - 1,
                "nodes": table.shape[1],
                "knot": [] if isinstance(system, harmonic.DiffuseSystem) else _knot(system.brdf),
                "terms": -(-len(vector) // 4) * 4,
                "family": _family(shading),
                "weightStep": 0 if described else weight.shape[1],
                **(described or {}),
                **place,
            }
        )
        weight = weight[:1] if described else weight
        stride = max(stride, seen.shape[1])
        padded = np.zeros((vector.shape[1], terms))
        padded[:, : len(vector)] = (vector / unit[: len(vector), None]).T
        every = np.round(32767 * np.asarray(shading.mesh.normal)), np.round(padded), seen, table, weight
        for kept, array, kind in zip(arrays, every, ("<i2", "i1", "u1", "<f4", "<f4"), strict=True):
            kept.append(array.astype(kind).reshape(-1))
        sizes = vector.shape[1], table.size // 4, weight.size // 4, seen.size
        place = {name: start + size for (name, start), size in zip(place.items(), sizes, strict=True)}
    scale = scale_of(reduced)
    visible: dict[str, Any] = NO_SCALES
    if scale is not None:
        starts = scale.start[level:] - scale.start[level]
        visible = {"edges": scale.edge[level:].tolist(), "spreads": scale.spread[level:].tolist()}
        visible["starts"] = starts.tolist()
    bits = bits_of(reduced)
    joined = [np.concatenate(each) for each in arrays]
    joined.append(np.zeros(0, np.uint8) if bits is None else np.concatenate([each.reshape(-1) for each in bits]))
    texel_edge = 0 if bits is None else math.isqrt(8 * bits[0].shape[1] // 6)
    content = {"parts": parts, "terms": terms, "vectorUnit": unit.tolist(), "stride": stride, **visible}
    content |= {"texelEdge": texel_edge, "texels": texels_of(texel_edge) if texel_edge else 0}
    joined[2] = np.append(joined[2], np.zeros(4 - len(joined[2]) % 4, np.uint8))  # whole words
    return content, [each.tobytes() for each in joined]


def mips(size: int) -> list[int]:
    """Edges of the faces that the page makes of a light."""
    while size > _SKY and size % 2 == 0:
        size //= 2
    result = [size]
    while result[-1] % 2 == 0 and result[-1] > 4:
        result.append(result[-1] // 2)
    return result


def blurring(size: int) -> dict[str, Any]:
    """How the light is blurred to all widths: see `jaxprt.systems.lobe.relight.prefilter`."""
    scale = relight.scales(size)
    pairs = zip(scale.edge.tolist(), scale.spread.tolist(), strict=True)
    source, own, concentration = zip(*(relight.blur(*each, size=size) for each in pairs), strict=True)
    return {
        "edges": scale.edge.tolist(),
        "spreads": scale.spread.tolist(),
        "starts": scale.start.tolist(),
        "total": scale.total,
        "sources": source,
        "concentrations": concentration,
        "reaches": [min(np.pi, relight.REACH * np.sqrt(each)) for each in own],
    }


def _family(shading: Shading) -> dict[str, list]:
    """Terms of `MetallicRoughness` that the channels are, and their factors; empty for other BRDFs."""
    if shading.blend is None or shading.scale is None:
        return {"terms": [], "scale": []}
    return {"terms": list(shading.term), "scale": np.asarray(shading.scale, float).tolist()}


def _knot(brdf: lobe.LobeBrdf) -> list[float]:
    return np.asarray(brdf.knot[0]).tolist() if brdf.knot else []


def _means(system: Exported, level: int) -> np.ndarray:
    if not isinstance(system, lobe.LobeSystem):
        return np.zeros((0, 0), np.uint8)
    transport = system.transport
    return np.ascontiguousarray(np.asarray(transport.pyramid)[:, pyramid.scales(edge_of(transport)).start[level] :])


def _table(system: Exported) -> Float[np.ndarray, "h q e 4"]:
    """A table of lobes: for each knot and node the mean and log concentration of each lobe, its weights; albedos."""
    if not isinstance(system, lobe.LobeSystem):
        return np.ones((1, 1, 1, 4))
    brdf = system.brdf
    mean, scale, weight, albedo = (np.asarray(each) for each in (brdf.mean, brdf.scale, brdf.weight, brdf.diffuse))
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
    """Weights of the channels at each vertex and, last, what it emits; with the first the logarithm of roughness."""
    count = len(shading.mesh.position)
    if shading.blend is not None:
        weight = np.asarray(shading.blend.weight)
    elif isinstance(system, harmonic.DiffuseSystem):
        weight = np.broadcast_to(np.asarray(system.albedo), (count, 1, len(system.albedo)))
    else:
        channels = len(system.brdf.weight)
        weight = np.broadcast_to(np.eye(channels) if channels > 1 else np.ones((1, 3)), (count, channels, 3))
    result = np.zeros((count, weight.shape[1] + 1, 4))
    result[:, :-1, :3] = weight
    if shading.blend is not None and shading.blend.parameter:
        result[:, 0, 3] = np.asarray(shading.blend.parameter[0])
    elif isinstance(shading.brdf, Channels):  # GGX of one roughness, whose axes are alike
        result[:, 0, 3] = np.log(next(float(each.roughness[0]) for each in shading.brdf.model if isinstance(each, GGX)))
    if shading.emitted is not None:
        result[:, -1, :3] = np.asarray(shading.emitted)
    return result


def _described(material: Any, shading: Shading) -> dict[str, Any] | None:
    """A material that is one for all vertices, by its numbers; None for others."""
    if not isinstance(material, TexturedMaterial) or shading.scale is None:
        return None
    if any(isinstance(each, Texture) for each in jax.tree.leaves(material, is_leaf=lambda x: isinstance(x, Texture))):
        return None
    names = ("base_color", "metallic", "specular", "specular_color", "ior", "roughness")
    values = {name: np.asarray(getattr(material, name), float).tolist() for name in names}
    return {"material": values}
