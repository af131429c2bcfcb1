"""Pages that show a scene without Python and relight it on the browser's GPU."""

import base64
import functools
import hashlib
import html
import os
import pathlib
import warnings
import zlib
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxprt import require
from jaxprt.files import outputs
from jaxprt.files.inputs import JsonObject
from jaxprt.relit.scene import RelitScene
from jaxprt.scene import Environment
from jaxprt.view import browser, messages, page_error
from jaxprt.view.content import FIRST_IMAGE, page_content
from jaxprt.view.messages import Reply
from jaxprt.view.page_error import Cause
from jaxprt.view.reduced import FIRST, PageScene
from jaxprt.view.session import Session

_SKY_ROWS, _LEAST_SKY_ROWS = 1024, 128  # most rows of a picture of a light; at 128 texels are as good
_SPARE_OF_SKIES = 4096  # bytes for what the page says of them
_EFFORT = 9  # level of the compression of files that are written; sizes are tried with less
_RAW = 128  # texels along an edge up to which images are no files
_MOST_EXACT = 1 << 23  # bytes of exact files of images, above which those of colors are not exact
_QUALITY = 92  # of files of colors, from 0 to 100
_SPARE = 64  # bytes by which the page's size may change when another error is written into it
_SMOOTHEST = 0.05  # least roughness that users of a page can choose: smoother materials vary over a texel of 256
# The page loads nothing, and runs its own script alone.
_PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; script-src 'sha256-{digest}'; \
img-src data: blob:; base-uri 'none'; form-action 'none'">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title><link rel="icon" href="data:,">
<body><div id="viewer"></div>
<script type="text/plain" id="data">{data}</script>
<script type="module">{script}</script></body></html>
"""
_SCRIPT = """
{
  const text = document.getElementById("data");
  const packed = Uint8Array.from(atob(text.textContent), (byte) => byte.charCodeAt(0));
  text.remove();
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const { content, buffers } = unpack(await new Response(stream).arrayBuffer());
  fillPage(document);
  mount(document.getElementById("viewer"), answers(content, buffers), { addressed: true });
}
"""


class Piece(NamedTuple):
    """Description of an exported page.

    Attributes:
        path: The file.
        nbytes: Size of the file in bytes.
        edge: Texels along a face's edge of the finest visibility in the page; 0 without glossy parts.
        texels: Whether the brightest texels of the light are summed one by one, for sharp shadows of a small sun.
        degree: Highest degree of the transfer matrices in the page; None without parts of the harmonic system.
        error: Relative L2 error of the page's pictures against those of the scene, over four views and for the light
            with the largest error, at pixels that show surfaces.
        light: Name of this light.
        causes: What the page lacks, with the error that it causes, if `error` is above 5 %; largest first.
    """

    path: pathlib.Path
    nbytes: int
    edge: int
    texels: bool
    degree: int | None
    error: float
    light: str
    causes: tuple[Cause, ...]


def export(
    scene: RelitScene,
    path: str | os.PathLike,
    *,
    environments: Mapping[str, Environment] | None = None,
    most: int = 32_000_000,
    error: float | None = None,
) -> Piece:
    """Writes an HTML page that shows and relights a scene on the browser's GPU, without Python.

    The page contains the viewer and all data. Ideally diffuse parts use transfer vectors
    and parts of the system "harmonic" use transfer matrices, from harmonics of their visibility; both are stored as
    bytes. Other parts use lobes and averaged visibility. All are stored as finely as `most` permits. If they fit, the
    brightest texels of the light are summed one by one on the parts that support it. As in the viewer, the user can
    rotate or replace the light, add lamps, and change materials that are constant over a part. A Radiance HDR file that
    is dropped on the page becomes a light.

    Light of bounces and lamps is stored as what it adds to the irradiance of the vertices: that of bounces for lights
    of 25 harmonics, with the materials that the scene has, and that of lamps as it is. Other materials and strengths
    of lamps do not change it. Highlights of it, clear coats and sheens are left out, with a warning.

    Args:
        scene: The result of `jaxprt.precompute`, with systems that say what a page holds of them, such as "lobe".
        path: The file, `*.html`.
        environments: Dictionary from names to lights; the scene's own or the two embedded ones if None.
        most: Largest size of the file in bytes.
        error: Largest accepted relative L2 error of the page's pictures against those of `RelitScene.picture`; None
            accepts any.

    Returns:
        A description of the page, with its size and its error against the scene, which includes what is left out.

    Raises:
        TypeError: `scene` is not a relit scene, `path` is not a path, `most` or `error` is not a number, or
            `environments` holds something other than lights.
        ValueError: The suffix of the file is not .html, a part has another system or is anisotropic, the page does not
            fit into `most` bytes, or its error is larger than `error`. The message then has the causes.
        OSError: The file cannot be written, found before the page is computed where possible.
    """
    require.kind("the scene", scene, RelitScene, source="jaxprt.precompute")
    require.number("most", most, 1.0)
    if error is not None:
        require.number("error", error, 0.0)
    path = outputs.target(path, ".html")
    scene = scene.centered()
    session = Session(scene, environments=environments)
    lights = dict(zip(session.stages.name, session.stages.lights, strict=True))
    whole = PageScene.of(scene)
    _warn_of_reflections(scene, whole)
    # Sharp shadows of a small sun matter more than finely averaged visibility.
    least = 0
    for texels, size in _sizes(whole):
        reduced = whole.reduced(size.level, texels=texels, degree=size.degree)
        contents = page_content(reduced, list(lights.values()))
        least = len(_page(session, reduced, lights, contents, error=0.0, title=path.stem))
        if least > most + _SPARE:
            continue
        measured = page_error.measure(scene, reduced, lights)
        if error is not None and measured.error > error:
            raise ValueError(measured.refusal(error))
        page = _page(session, reduced, lights, contents, error=measured.error, title=path.stem)
        least = len(page)
        if least <= most:
            skies = _skies(session, most - least - _SPARE_OF_SKIES)
            options = {"error": measured.error, "title": path.stem, "effort": _EFFORT}
            page = _page(session, reduced, lights, contents, skies, **options)
            outputs.write(path, page)
            return Piece(path, len(page), size.edge, texels, size.degree, *measured)
    raise ValueError(
        f"most must be at least about {least} bytes, the size of the page with the coarsest visibility, got {most}"
    )


def _warn_of_reflections(scene: RelitScene, page: PageScene) -> None:
    """Warns of parts whose reflections of bounces and lamps the page leaves out in part."""
    if page.reflected is None:
        return
    what = " and ".join(name for name, light in (("bounces", scene.bounces), ("lamps", scene.lamps)) if light)
    none = [name for name, rows in zip(scene.scene.names, page.reflected, strict=True) if not len(rows)]
    glossy = [part.name for part, held in zip(scene.scene.parts, page.parts, strict=True) if held.brdf is not None]
    glossy = [name for name in glossy if name not in none]
    words = []
    if glossy:
        words.append(f"these parts reflect it diffusely, without highlights: {', '.join(map(repr, glossy))}")
    if none:
        words.append(f"these parts do not reflect it: {', '.join(map(repr, none))}")
    if words:
        warnings.warn(f"the page has light of {what} in part: {'; '.join(words)}", stacklevel=3)


class _Size(NamedTuple):
    """Resolution of a page: the finest scale of visibility, texels along its edge, and the degree of matrices."""

    level: int
    edge: int
    degree: int | None


def _sizes(page: PageScene) -> Iterator[tuple[bool, _Size]]:
    """Whether a page has the visibility of single texels, and its resolution, from the finest to the coarsest."""
    scale, counts = page.scales, [held.vector.shape[1] for held in page.parts]
    lobes = sum(count for count, held in zip(counts, page.parts, strict=True) if held.scales is not None)
    matrices = [(count, held.degree) for count, held in zip(counts, page.parts, strict=True) if held.degree is not None]
    for texels in [True, False] if page.holds_texels else [False]:
        degree = max((most for _, most in matrices), default=0)
        level = 0 if scale is None else FIRST
        while True:
            yield texels, _Size(level, 0 if scale is None else int(scale.edge[level]), degree if matrices else None)
            means = 0
            # From single texels the page makes averaged visibility, which then takes no bytes.
            if scale is not None and not texels and level < len(scale.edge) - 1:
                means = lobes * int(scale.total - scale.start[level])
            bands = sum(count * (2 * min(most, degree) + 1) ** 2 for count, most in matrices if degree > 1)
            if not means and not bands:
                break
            # The data that takes more bytes is reduced first.
            if means >= bands:
                level += 1
            else:
                degree -= 1


def _page(
    session: Session,
    reduced: PageScene,
    lights: Mapping[str, Environment],
    contents: tuple[JsonObject, list[bytes]],
    skies: Sequence[Reply | None] = (),
    *,
    error: float,
    title: str,
    effort: int = 6,
) -> bytes:
    """The content of the HTML file. `effort` is the level of its compression, from 1 to 9."""
    reply = session.answer({"kind": "scene"})
    content, arrays = _with_image_files(*contents)
    free = [
        part | {"free": _free_parameters(part["free"]) if "material" in entry else None}
        for part, entry in zip(reply.content["parts"], content["parts"], strict=True)
    ]
    head = reply.content | {
        "parts": free,
        "systems": {"lobes": {"bounces": False}},
        "rests": [],
        "note": f"no Python; {100 * error:.1f} % off pictures of the scene",
    }
    content = content | {"skies": [None if sky is None else sky.content for sky in skies]}
    content = content | {"scene": head}
    buffers = [
        *reply.buffers,
        *arrays,
        *(buffer for sky in skies if sky is not None for buffer in sky.buffers),
    ]
    data = base64.b64encode(zlib.compress(messages.pack(content, buffers), effort)).decode()
    script = browser.module() + _SCRIPT
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return _PAGE.format(title=html.escape(title), data=data, script=script, digest=digest).encode()


def _with_image_files(content: JsonObject, arrays: list[bytes]) -> tuple[JsonObject, list[bytes]]:
    """The content and arrays of a page with files in place of large images: exact ones if they are not too large."""
    described, held = content["images"], arrays[FIRST_IMAGE : FIRST_IMAGE + len(content["images"])]
    large = [min(image["width"], image["height"]) > _RAW for image in described]
    rows = list(zip(held, described, large, strict=True))
    files = [_webp(data, *image.values(), exact=True) if flag else data for data, image, flag in rows]
    if sum(map(len, files)) > _MOST_EXACT:
        files = [_webp(data, *image.values(), exact=False) if flag else data for data, image, flag in rows]
    described = [image | {"file": flag} for image, flag in zip(described, large, strict=True)]
    return content | {"images": described}, [*arrays[:FIRST_IMAGE], *files, *arrays[FIRST_IMAGE + len(files) :]]


@functools.lru_cache(maxsize=64)
def _webp(data: bytes, width: int, height: int, channels: int, colored: bool, *, exact: bool) -> bytes:
    """An image as a file for browsers. Other values than colors are kept as they are in any case."""
    rows = np.broadcast_to(np.frombuffer(data, np.uint8).reshape(height, width, channels), (height, width, 3))
    return outputs.webp(rows, quality=_QUALITY if colored and not exact else None)


def _skies(session: Session, room: int | float) -> list[Reply | None]:
    """Pictures of the lights for the background, as fine as files and `room` in bytes permit; None without a file."""
    shown = [light.panorama is not None for light in session.stages.lights]
    rows = _SKY_ROWS if any(shown) else 0
    while rows > _LEAST_SKY_ROWS:
        skies = [session.sky(number, rows=rows) if flag else None for number, flag in enumerate(shown)]
        data = b"".join(bytes(buffer) for sky in skies if sky is not None for buffer in sky.buffers)
        if 4 / 3 * len(zlib.compress(data, 6)) <= room:
            return skies
        rows //= 2
    return [None] * len(shown)


def _free_parameters(free: JsonObject) -> JsonObject:
    """What users of the page can change of a part, of what they can change in the viewer."""
    result = dict(free)
    if "roughness" in free:
        low, high = free["roughness_range"]
        result["roughness_range"] = [max(low, min(_SMOOTHEST, free["roughness"])), high]
    if "exponent" in free:
        low, high = free["exponent_range"]
        result["exponent_range"] = [low, min(high, max(2 / _SMOOTHEST**4 - 2, free["exponent"]))]
    return result
