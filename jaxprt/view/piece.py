"""Export of a scene as a single HTML file that relights it on the browser's GPU, without Python."""

import base64
import html
import itertools
import os
import pathlib
import zlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxprt import require
from jaxprt.files import outputs
from jaxprt.relit.scene import RelitScene
from jaxprt.scene import Environment
from jaxprt.sphere import cubemap
from jaxprt.systems import harmonic, lobe
from jaxprt.view import matrices, messages, parts, stages
from jaxprt.view.bases import without_layers
from jaxprt.view.messages import Reply
from jaxprt.view.reduced import bits_of, coarse, light_size, resized, scale_of, systems_of
from jaxprt.view.server import MODULE
from jaxprt.view.session import Session

_MOST_BITS = 2**27  # largest buffer for the visibility of single texels, in bytes, that graphics cards accept
_SKY_ROWS, _LEAST_SKY_ROWS = 1024, 128  # most rows of a picture of a light; at 128 texels are as good
_SPARE_OF_SKIES = 4096  # bytes for what the page says of them
_SPARE = 64  # bytes by which the page's size may change when another error is written into it
_FIRST = 2  # finest scale of visibility that is stored as bytes
_SMOOTHEST = 0.25  # least roughness that users of a page can choose: smoother materials vary over a bright texel
_VIEWS = 4  # views from which the error is measured
_PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><title>{title}</title><link rel="icon" href="data:,">
<body style="margin:0;height:100vh;background:#1a1a1a"><div id="viewer" style="height:100%"></div>
<script type="text/plain" id="data">{data}</script>
<script type="module">
import {{ mount, unpack }} from "{viewer}";
import {{ answers }} from "{piece}";
const text = document.getElementById("data");
const packed = Uint8Array.from(atob(text.textContent), (each) => each.charCodeAt(0));
text.remove();
const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
const {{ content, buffers }} = unpack(await new Response(stream).arrayBuffer());
mount(document.getElementById("viewer"), answers(content, buffers));
</script></body></html>
"""


class Piece(NamedTuple):
    """Description of an exported page.

    Attributes:
        path: The file.
        nbytes: Size of the file in bytes.
        edge: Texels along a face's edge of the finest visibility in the page; 0 without glossy parts.
        texels: Whether the brightest texels of the light are summed one by one, for sharp shadows of a small sun.
        degree: Highest degree of the transfer matrices in the page; None without parts of the harmonic system.
        error: Relative L2 error of the page's vertex radiance against that of the scene, over four views and for the
            light with the largest error.
    """

    path: pathlib.Path
    nbytes: int
    edge: int
    texels: bool
    degree: int | None
    error: float


def export(
    scene: RelitScene,
    path: str | os.PathLike,
    *,
    environments: Mapping[str, Environment] | None = None,
    most: int = 32_000_000,
) -> Piece:
    """Writes an HTML page that shows and relights a scene on the browser's GPU, without Python.

    The page contains the viewer and all data. It computes direct light only. Ideally diffuse parts use transfer vectors
    and parts of the system "harmonic" use transfer matrices, from harmonics of their visibility; both are stored as
    bytes. Other parts use lobes and averaged visibility. All are stored as finely as `most` permits. If they fit, the
    brightest texels of the light are summed one by one on the parts that support it. As in the viewer, the user can
    rotate or replace the light, add lamps, and change materials that are constant over a part. A Radiance HDR file that
    is dropped on the page becomes a light. Clear coats and sheens are left out, with a warning.

    Args:
        scene: The result of `jaxprt.precompute`, with the systems "lobe" and "harmonic".
        path: The file, `*.html`.
        environments: Dictionary from names to lights; the scene's own or the two embedded ones if None.
        most: Largest size of the file in bytes.

    Returns:
        A description of the page, with its size and its error against the scene. If the scene has bounces, the error
        includes that they are missing in the page, and so it does with clear coats and sheens.

    Raises:
        TypeError: `scene` is not a relit scene, `path` is not a path, `most` is not a number, or `environments` holds
            something other than lights.
        ValueError: The suffix of the file is not .html, a part has another system or is anisotropic, or the page does
            not fit into `most` bytes.
        OSError: The file cannot be written, found before the page is computed where possible.
    """
    require.kind("the scene", scene, RelitScene, source="jaxprt.precompute")
    require.number("most", most, 1.0)
    path = outputs.target(path, ".html")
    scene = scene.centered()
    session = Session(scene, environments=environments)
    lights = dict(zip(session.stages.name, session.stages.lights, strict=True))
    bare = without_layers(scene)
    bits = bits_of(bare)
    # Sharp shadows of a small sun matter more than finely averaged visibility.
    fits = bits is not None and sum(words.size for words in bits if words is not None) <= _MOST_BITS
    least = 0
    for texels, size in itertools.product([True, False] if fits else [False], _sizes(bare)):
        reduced = coarse(bare, size.level, texels=texels, degree=size.degree)
        contents = parts.content(reduced, size.level)
        least = len(_page(session, reduced, lights, contents, error=0.0, title=path.stem))
        if least > most + _SPARE:
            continue
        error = max(_error(scene, reduced, light) for light in lights.values())
        page = _page(session, reduced, lights, contents, error=error, title=path.stem)
        least = len(page)
        if least <= most:
            skies = _skies(session, most - least - _SPARE_OF_SKIES)
            if any(sky is not None for sky in skies):
                page = _page(session, reduced, lights, contents, skies, error=error, title=path.stem)
                least = len(page)
            outputs.write(path, page)
            return Piece(path, least, size.edge, texels, size.degree, error)
    raise ValueError(
        f"most must be at least about {least} bytes, the size of the page with the coarsest visibility, got {most}"
    )


class _Size(NamedTuple):
    """Resolution of a page: the finest scale of visibility, texels along its edge, and the degree of matrices."""

    level: int
    edge: int
    degree: int | None


def _sizes(scene: RelitScene) -> list[_Size]:
    """Resolutions from the finest to the coarsest. The data that takes more bytes is reduced first."""
    systems, scale = systems_of(scene), scale_of(scene)
    lobes = sum(system.vertices for system in systems if isinstance(system, lobe.LobeSystem))
    matrix = [system for system in systems if isinstance(system, harmonic.HarmonicSystem)]
    degree = max((system.degree for system in matrix), default=None)
    level = 0 if scale is None else _FIRST
    result = []
    while True:
        result.append(_Size(level, 0 if scale is None else int(scale.edge[level]), degree))
        means = 0 if scale is None or level == len(scale.edge) - 1 else lobes * int(scale.total - scale.start[level])
        bands = 0 if degree is None or degree <= 1 else sum(matrices.nbytes(system, degree) for system in matrix)
        if not means and not bands:
            return result
        if means >= bands:
            level += 1
        else:
            assert degree is not None
            degree -= 1


def _error(scene: RelitScene, reduced: RelitScene, light: Environment) -> float:
    """Relative L2 error over some views around the scene."""
    off = whole = 0.0
    for number in range(_VIEWS):
        turn = stages.about(2 * np.pi * number / _VIEWS)
        target = jnp.asarray(scene.camera.target)
        eye = target + turn @ (jnp.asarray(scene.camera.eye) - target)
        full, approximate = (np.asarray(variant.radiance(light, eye=eye)) for variant in (scene, reduced))
        full, approximate = np.broadcast_arrays(full, approximate)
        off, whole = off + float(np.sum((approximate - full) ** 2)), whole + float(np.sum(full**2))
    return float(np.sqrt(off / whole)) if whole else 0.0


def _page(
    session: Session,
    reduced: RelitScene,
    lights: Mapping[str, Environment],
    contents: tuple[dict[str, Any], list[bytes]],
    skies: Sequence[Reply | None] = (),
    *,
    error: float,
    title: str,
) -> bytes:
    """The content of the HTML file."""
    reply = session.answer({"kind": "scene"})
    content, arrays = contents
    mips = parts.mips(next(iter(lights.values())).radiance.shape[-2])
    size = light_size(reduced)
    blurring = parts.blur_parameters(size) if size else parts.NO_SCALES
    free = [
        part | {"free": _free_parameters(part["free"]) if "material" in entry else None}
        for part, entry in zip(reply.content["parts"], content["parts"], strict=True)
    ]
    head = reply.content | {
        "parts": free,
        "systems": {"lobes": {"bounces": False}},
        "rests": [],
        "note": f"no Python; {100 * error:.1f} % off the whole system",
    }
    rims = sorted({mips[0], *blurring["edges"]}, reverse=True)
    content = content | {"skies": [None if sky is None else sky.content for sky in skies]}
    content = content | {"scene": head, "light": blurring, "mips": mips, "rims": rims, "glossy": bool(size)}
    buffers = [
        *reply.buffers,
        *arrays,
        *(cubemap.border_index(size=edge).astype("<u4").tobytes() for edge in rims),
        *(_light_texels(light, mips[0]).astype("<f4").tobytes() for light in lights.values()),
        *(buffer for sky in skies if sky is not None for buffer in sky.buffers),
    ]
    data = base64.b64encode(zlib.compress(messages.pack(content, buffers), 6)).decode()
    modules = {
        name: "data:text/javascript;base64," + base64.b64encode(MODULE.with_name(f"{name}.js").read_bytes()).decode()
        for name in ("viewer", "piece")
    }
    return _PAGE.format(title=html.escape(title), data=data, **modules).encode()


def _skies(session: Session, room: int | float) -> list[Reply | None]:
    """Pictures of the lights for the background, as fine as their files and the room in the page permit.

    Args:
        session: The session of the page.
        room: Bytes of the page that the pictures may take.

    Returns:
        One for each light; None for a light without the pixels of a file, whose texels are shown.
    """
    shown = [light.panorama is not None for light in session.stages.lights]
    rows = _SKY_ROWS if any(shown) else 0
    while rows > _LEAST_SKY_ROWS:
        skies = [session.sky(number, rows=rows) if flag else None for number, flag in enumerate(shown)]
        data = b"".join(bytes(buffer) for sky in skies if sky is not None for buffer in sky.buffers)
        if 4 / 3 * len(zlib.compress(data, 6)) <= room:
            return skies
        rows //= 2
    return [None] * len(shown)


def _free_parameters(free: dict[str, Any]) -> dict[str, Any]:
    """What users of the page can change of a part, of what they can change in the viewer."""
    result = dict(free)
    if "roughness" in free:
        low, high = free["roughness_range"]
        result["roughness_range"] = [max(low, min(_SMOOTHEST, free["roughness"])), high]
    if "exponent" in free:
        low, high = free["exponent_range"]
        result["exponent_range"] = [low, min(high, max(2 / _SMOOTHEST**4 - 2, free["exponent"]))]
    return result


def _light_texels(light: Environment, size: int) -> Float[np.ndarray, "6 n n 3"]:
    radiance = np.asarray(resized(light, size=size).radiance)
    return np.broadcast_to(radiance, (*radiance.shape[:-1], 3))
