"""Opacity of the parts of a scene, from their materials, textures and vertices."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxprt.scene import texture
from jaxprt.scene.material import TexturedMaterial
from jaxprt.scene.opacity import BLEND, CLEAR, Opacity

_OPAQUE: tuple[Any, ...] = 0.0, (0, 0), -1, (1, 1)  # cutoff, wrap modes, and the place and shape of an image


def of_parts(parts: Sequence[Any]) -> Opacity | None:
    """The opacity of the vertices of some parts, one after another; None if all of them are opaque.

    Args:
        parts: Parts of a scene.
    """
    clear = [_lets_light_through(part) for part in parts]
    if not any(clear):
        return None
    total = sum(len(part.mesh.position) for part in parts)
    coordinate, factor = np.zeros((total, 2), np.float32), np.ones(total, np.float32)
    layer, rows, texels, first = np.zeros(total, np.int32), [_OPAQUE], [np.ones(1, np.float32)], 0
    place: dict[int, int] = {}
    for part, through in zip(parts, clear, strict=True):
        own = slice(first, first + len(part.mesh.position))
        first = own.stop
        if not through:
            continue
        material, wrap, start, shape = part.material, (0, 0), -1, (1, 1)
        layer[own] = len(rows)
        factor[own] = _factor(part)
        if material.alpha_texture is not None:
            image = np.asarray(material.alpha_texture.image, np.float32)[..., 0]
            if id(material.alpha_texture.image) not in place:
                place[id(material.alpha_texture.image)] = sum(map(len, texels))
                texels.append(image.ravel())
            start, shape = place[id(material.alpha_texture.image)], image.shape
            wrap = tuple(texture.WRAPS.index(mode) for mode in material.alpha_texture.wrap)
            sets = part.mesh.texture, part.mesh.texture if part.second is None else part.second
            move = np.asarray(material.alpha_texture.transform, np.float64)
            coordinate[own] = np.asarray(sets[material.alpha_texture.set], np.float64) @ move[:, :2].T + move[:, 2]
        cutoff = BLEND if material.alpha_mode == "blend" else float(material.alpha_cutoff)
        rows.append((cutoff, wrap, start, shape))
    cutoff, wrap, start, shape = (np.array(column) for column in zip(*rows, strict=True))
    columns = cutoff.astype(np.float32), wrap.astype(np.int32), start.astype(np.int64), shape.astype(np.int32)
    return Opacity(coordinate, factor, layer, *columns, np.concatenate(texels))


def _factor(part: Any) -> Float[np.ndarray, " v"]:
    """Opacity of the vertices of a part, without its image."""
    color = 1.0 if part.alpha is None else np.asarray(part.alpha, np.float32)
    return np.full(len(part.mesh.position), float(part.material.alpha), np.float32) * color


def _lets_light_through(part: Any) -> bool:
    """Whether a part stops less than all light somewhere. Many files name a mode for opaque materials too."""
    material = part.material
    if not isinstance(material, TexturedMaterial) or material.alpha_mode == "opaque":
        return False
    least = float(np.min(_factor(part)))
    if material.alpha_texture is not None:
        least *= float(np.min(np.asarray(material.alpha_texture.image)))
    return least < (1 - CLEAR if material.alpha_mode == "blend" else float(material.alpha_cutoff))
