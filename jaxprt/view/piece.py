"""Scenes as one file of HTML that relights them without Python, in the browser's GPU."""

import base64
import json
import os
import pathlib
import zlib
from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxprt import require
from jaxprt.relit.scene import RelitScene
from jaxprt.scene import Environment, TexturedMaterial
from jaxprt.scene.material import Texture
from jaxprt.sphere import cubemap
from jaxprt.systems import bright_texels, harmonic, lobe
from jaxprt.systems.lobe import pyramid
from jaxprt.systems.lobe import relight as lobe_relight
from jaxprt.systems.protocol import Joined, System
from jaxprt.view import messages, stages
from jaxprt.view.server import MODULE
from jaxprt.view.session import Session

_LIGHT = 32  # texels along the edge of the light's faces that lobes are read from
_SKY = 64  # the same of the light that is seen behind the scene
_FIRST = 2  # scale of visibility that is the finest one in bytes
_VIEWS = 4  # from which the error is measured
_PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><title>{title}</title><link rel="icon" href="data:,">
<body style="margin:0;height:100vh;background:#1a1a1a"><div id="viewer" style="height:100%"></div>
<script type="text/plain" id="data">{data}</script>
<script type="module">
import {{ mount, unpack }} from "{viewer}";
import {{ answers }} from "{piece}";
const text = document.getElementById("data"), packed = Uint8Array.from(atob(text.textContent), (each) => each.charCodeAt(0));
text.remove();
const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
const {{ content, buffers }} = unpack(await new Response(stream).arrayBuffer());
mount(document.getElementById("viewer"), answers(content, buffers));
</script></body></html>
"""


class Piece(NamedTuple):
    """A scene in a file.

    Attributes:
        path: The file.
        nbytes: Its size.
        edge: Texels along the edge of the faces of the finest visibility in it; 0 without glossy parts.
        error: Relative L2 error of its radiance at the vertices against that of the scene, over four views, in the
            light where it is largest.
    """

    path: pathlib.Path
    nbytes: int
    edge: int
    error: float


class _Coarse(lobe.LobeTransport):
    """Visibility without its finest scales, read under a light of another size.

    Attributes:
        edge: Texels along the edge of visibility's faces.
        spread: That of the finest scale which is left.
    """

    edge: int = eqx.field(static=True)
    spread: float = eqx.field(static=True)

    def lobe_visibility(self, face, s, t, spread, points=None):
        whole = lobe.LobeTransport(self.pyramid, self.vector, self.position, self.frame, self.edge)
        return whole.lobe_visibility(face, s, t, jnp.maximum(spread, self.spread), points)


def export(
    scene: RelitScene,
    path: str | os.PathLike,
    *,
    environments: Mapping[str, Environment] | None = None,
    most: int = 32_000_000,
) -> Piece:
    """Writes a page that relights a scene without Python, by the browser's GPU: the viewer, and what it needs.

    Direct light alone: ideally diffuse parts by transfer vectors in bytes, others by lobes and by means of visibility,
    as fine as fit in the size that is asked for. What the viewer changes can be changed in it: light, turned or
    another, lamps, and materials that are one for all of a part. A Radiance HDR file that is dropped on it is a light.

    Args:
        scene: From `jaxprt.precompute`, with the systems "lobe", or with any for parts that are ideally diffuse.
        path: The file, `*.html`.
        environments: Lights by names; the scene's own or the two embedded ones if None.
        most: Largest size of the file in bytes.

    Returns:
        Its size, and its error against the scene, bounces included if the scene has them.

    Raises:
        TypeError: No relit scene, or no environments.
        ValueError: A file of another kind, a part that is of another system or anisotropic, or one that does not fit.
    """
    require.kind("the scene", scene, RelitScene, source="jaxprt.precompute")
    path = pathlib.Path(path)
    if path.suffix.lower() != ".html":
        raise ValueError(f"path must end in .html, got {path.name!r}")
    session = Session(scene, environments=environments)
    lights = dict(zip(session.stages.name, session.stages.lights, strict=True))
    systems = [_bare(each) for each in scene.direct.part]
    for part, system in zip(scene.scene.parts, systems, strict=True):
        _check(part.name, system)
    sizes = {each.transport.size for each in systems if isinstance(each, lobe.LobeSystem)}
    scales = pyramid.scales(max(sizes)) if sizes else None
    for level in range(_FIRST, len(scales.edge)) if scales else [0]:
        reduced = _reduced(scene, systems, level)
        error = max(_error(scene, reduced, each) for each in lights.values())
        page = _page(session, reduced, lights, level, error=error, title=path.stem)
        if len(page) <= most:
            path.write_bytes(page)
            return Piece(path, len(page), int(scales.edge[level]) if scales else 0, error)
    raise ValueError(f"the scene must fit in {most} bytes, got {len(page)} with its coarsest visibility")


def _bare(system: System) -> System:
    """A system without single texels."""
    return system.system if isinstance(system, bright_texels.BrightTexels) else system


def _check(name: str, system: System) -> None:
    if isinstance(system, lobe.LobeSystem):
        if not system.brdf.isotropic:
            raise ValueError(f"part {name!r} must have an isotropic BRDF to be exported, got an anisotropic one")
        if len(system.brdf.knot) > 1 or len(system.brdf.weight) > 4 or any(len(each) > 16 for each in system.brdf.knot):
            raise ValueError(f"part {name!r} must have a BRDF of one parameter and four channels at most")
    elif not isinstance(system, harmonic.DiffuseSystem):
        raise ValueError(
            f"part {name!r} must be ideally diffuse or made by the system 'lobe' to be exported, "
            f"got {type(system).__name__}"
        )


def _reduced(scene: RelitScene, systems: list[System], level: int) -> RelitScene:
    """The scene as the page has it."""
    vectors = [_vectors(each) for each in systems]
    scale = _vector_scale(vectors)
    made: list[System] = []
    for system, vector in zip(systems, vectors, strict=True):
        own = scale[: len(vector), None]
        rounded = jnp.asarray(np.round(vector / own) * own, jnp.result_type(float))
        if isinstance(system, harmonic.DiffuseSystem):
            made.append(eqx.tree_at(lambda each: each.transport.vector, system, rounded[:, None]))
            continue
        assert isinstance(system, lobe.LobeSystem)
        old = system.transport
        size, least = min(_LIGHT, old.size), float(pyramid.scales(old.size).spread[level])
        coarse = _Coarse(old.pyramid, rounded, old.position, old.frame, size, old.size, least)
        made.append(lobe.LobeSystem(coarse, system.brdf))
    return RelitScene(scene.scene, Joined(tuple(made)), scene.shading)


def _vectors(system: System) -> Float[np.ndarray, "lm v"]:
    """Transfer vectors of a part's vertices."""
    found = system.transport.vector
    if isinstance(system, harmonic.DiffuseSystem):
        if found.shape[1] != 1:
            raise ValueError(f"transfer vectors must be gray to be exported, got {found.shape[1]} colors")
        found = found[:, 0]
    return np.asarray(found, np.float64)


def _vector_scale(vectors: list[np.ndarray]) -> Float[np.ndarray, " lm"]:
    """What 1 of the signed bytes stands for, for each harmonic."""
    largest = np.zeros(max(map(len, vectors)))
    for each in vectors:
        largest[: len(each)] = np.maximum(largest[: len(each)], np.abs(each).max(1, initial=0))
    return np.maximum(largest, 1e-12) / 127


def _error(scene: RelitScene, reduced: RelitScene, light: Environment) -> float:
    """Relative error over some views around the scene."""
    size = {each.transport.size for each in reduced.direct.part if isinstance(each, lobe.LobeSystem)}
    coarse = _resized(light, size=min(size)) if size else light
    off = whole = 0.0
    for number in range(_VIEWS):
        turn = stages.about(2 * np.pi * number / _VIEWS)
        target = jnp.asarray(scene.camera.target)
        eye = target + turn @ (jnp.asarray(scene.camera.eye) - target)
        full, found = (np.asarray(each.radiance(lit, eye=eye)) for each, lit in ((scene, light), (reduced, coarse)))
        off, whole = off + float(np.sum((found - full) ** 2)), whole + float(np.sum(full**2) * found.shape[1] / full.shape[1])
    return float(np.sqrt(off / whole)) if whole else 0.0


def _page(
    session: Session, reduced: RelitScene, lights: Mapping[str, Environment], level: int, *, error: float, title: str
) -> bytes:
    """The file."""
    head, arrays = session.answer({"kind": "scene"})
    head |= {"systems": {"lobes" if level else "transfer vectors": {"bounces": False}}, "rests": []}
    head["note"] = f"without Python: {100 * error:.1f} % off the whole system"
    vectors = [_vectors(each) for each in reduced.direct.part]
    scale = _vector_scale(vectors)
    terms = -(-len(scale) // 4) * 4
    parts, table, weight, means, vector = [], [], [], [], []
    place = {"first": 0, "tableStart": 0, "weightStart": 0, "pyramidStart": 0}
    stride = 0
    for number, (part, system, own) in enumerate(zip(reduced.scene.parts, reduced.direct.part, vectors, strict=True)):
        entry, rows, seen = _table(system), _weights(reduced, number), _means(system, level)
        described = _described(part.material, reduced.shading[number])
        step = 0 if described else rows.shape[1]
        parts.append(
            {
                "name": part.name,
                "count": own.shape[1],
                "lobes": system.brdf.lobes if isinstance(system, lobe.LobeSystem) else 0,
                "channels": rows.shape[1] - 1,
                "nodes": entry.shape[1],
                "knots": entry.shape[0],
                "knot": np.asarray(system.brdf.knot[0]).tolist() if entry.shape[0] > 1 else [],
                "diffuseTerms": -(-len(own) // 4) * 4,
                "weightStep": step,
                **(described or {}),
                **place,
            }
        )
        head["parts"][number]["free"] = head["parts"][number]["free"] if described else None
        rows = rows[:1] if described else rows
        stride = max(stride, seen.shape[1])
        place["first"] += own.shape[1]
        place["tableStart"] += entry.size // 4
        place["weightStart"] += rows.size // 4
        place["pyramidStart"] += seen.size
        padded = np.zeros((terms, own.shape[1]))
        padded[: len(own)] = own / scale[: len(own), None]
        vector.append(np.round(padded.T).astype(np.int8).tobytes())
        table.append(entry.astype("<f4").tobytes())
        weight.append(rows.astype("<f4").tobytes())
        means.append(seen.tobytes())
    visible, shine, sizes = _scales(reduced, level, lights)
    content = {
        "scene": head,
        "parts": parts,
        "terms": terms,
        "vectorScale": scale.tolist(),
        "stride": stride,
        "environment": sizes[0],
        "rims": sizes,
        "light": shine,
        **visible,
    }
    normal = np.concatenate([np.asarray(each.mesh.normal) for each in reduced.shading])
    seen = b"".join(means)
    buffers = [
        *arrays,
        np.round(32767 * normal).astype("<i2").tobytes(),
        b"".join(vector),
        seen + bytes(-len(seen) % 4 or (0 if seen else 4)),
        b"".join(table),
        b"".join(weight),
        *(cubemap.border_index(size=edge).astype("<u4").tobytes() for edge in sizes),
        *(_colored(each, sizes[0]).astype("<f4").tobytes() for each in lights.values()),
    ]
    data = base64.b64encode(zlib.compress(messages.pack(content, buffers), 6)).decode()
    modules = {
        name: "data:text/javascript;base64," + base64.b64encode(MODULE.with_name(f"{name}.js").read_bytes()).decode()
        for name in ("viewer", "piece")
    }
    return _PAGE.format(title=title.replace("&", "&amp;").replace("<", "&lt;"), data=data, **modules).encode()


def _scales(reduced: RelitScene, level: int, lights: Mapping[str, Environment]) -> tuple[dict, dict, list[int]]:
    """Scales of visibility and of the light, and the sizes of all faces that have rims."""
    found = [each.transport for each in reduced.direct.part if isinstance(each, lobe.LobeSystem)]
    largest = next(iter(lights.values())).radiance.shape[-2]
    size = found[0].size if found else min(_LIGHT, largest)
    shine = _blurring(size)
    if found:
        scale = pyramid.scales(found[0].edge)
        first = scale.start[level]
        visible = {
            "edges": scale.edge[level:].tolist(),
            "spreads": scale.spread[level:].tolist(),
            "starts": (scale.start[level:] - first).tolist(),
        }
    else:
        visible = {"edges": [1], "spreads": [1.0], "starts": [0]}
    environment = min(largest, _SKY)
    edges = sorted({environment, *shine["edges"]}, reverse=True)
    return visible, shine, edges


def _blurring(size: int) -> dict[str, list]:
    """How the light is blurred to all widths: see `jaxprt.systems.lobe.relight.prefilter`."""
    scale = lobe_relight.scales(size)
    pairs = zip(scale.edge.tolist(), scale.spread.tolist(), strict=True)
    source, own, concentration = zip(*(lobe_relight.blur(*each, size=size) for each in pairs), strict=True)
    return {
        "edges": scale.edge.tolist(),
        "spreads": scale.spread.tolist(),
        "starts": scale.start.tolist(),
        "total": scale.total,
        "sources": source,
        "concentrations": concentration,
        "reaches": [min(np.pi, lobe_relight.REACH * np.sqrt(each)) for each in own],
    }


def _means(system: System, level: int) -> np.ndarray:
    if not isinstance(system, lobe.LobeSystem):
        return np.zeros((0, 0), np.uint8)
    transport = system.transport
    return np.ascontiguousarray(np.asarray(transport.pyramid)[:, pyramid.scales(transport.edge).start[level] :])


def _table(system: System) -> Float[np.ndarray, "h q e 4"]:
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


def _weights(reduced: RelitScene, number: int) -> Float[np.ndarray, "v k 4"]:
    """Weights of the channels at each vertex and, last, what it emits; with the first the logarithm of roughness."""
    shading, system = reduced.shading[number], reduced.direct.part[number]
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
    if shading.emitted is not None:
        result[:, -1, :3] = np.asarray(shading.emitted)
    return result


def _described(material: Any, shading: Any) -> dict[str, Any] | None:
    """A material that is one for all vertices, by its numbers; None for others."""
    if not isinstance(material, TexturedMaterial) or shading.scale is None:
        return None
    if any(isinstance(each, Texture) for each in jax.tree.leaves(material, is_leaf=lambda x: isinstance(x, Texture))):
        return None
    names = ("base_color", "metallic", "specular", "specular_color", "ior", "roughness")
    values = {name: np.asarray(getattr(material, name), float).tolist() for name in names}
    return {"material": values, "term": list(shading.term), "scale": np.asarray(shading.scale, float).tolist()}


def _resized(light: Environment, *, size: int) -> Environment:
    """A light with fewer texels: means over the sphere."""
    large = light.radiance.shape[-2]
    area = np.asarray(cubemap.solid_angle(size=large), np.float64)[..., None]
    folded = (6, size, large // size, size, large // size, -1)
    value, whole = (each.reshape(folded).sum((2, 4)) for each in (np.asarray(light.radiance) * area, area))
    return Environment(jnp.asarray(value / whole, light.radiance.dtype))


def _colored(light: Environment, size: int) -> Float[np.ndarray, "6 n n 3"]:
    radiance = np.asarray(_resized(light, size=size).radiance)
    return np.broadcast_to(radiance, (*radiance.shape[:-1], 3))
