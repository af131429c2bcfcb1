"""Opacity of the parts of a scene, from their materials, textures and vertices."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxprt.compile import known
from jaxprt.scene import texture
from jaxprt.scene.material import Texture, TexturedMaterial
from jaxprt.scene.opacity import BLEND, CLEAR, Opacity

# Cutoff, wrap modes, place and shape of an image, color of what passes, and whether it is glass.
_OPAQUE: tuple[Any, ...] = 0.0, (0, 0), -1, (1, 1), (1.0, 1.0, 1.0), False
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of Rec. 709


class _Glass(NamedTuple):
    """Light that passes a thin transmitting surface: its luminance without the texture, and its color."""

    luminance: float
    color: Float[np.ndarray, " 3"]


def of_parts(parts: Sequence[Any]) -> Opacity | None:
    """The opacity of the vertices of some parts, one after another; None if all of them are opaque.

    Parts that transmit light are thin glass: light and views pass straight through, in the mean base color, less what
    is reflected at normal incidence. Alpha comes first: a material whose alpha counts is not glass.

    Args:
        parts: Parts of a scene.
    """
    glasses = [_glass(part) for part in parts]
    clear = [glass is not None or _lets_light_through(part) for part, glass in zip(parts, glasses, strict=True)]
    if not any(clear):
        return None
    total = sum(len(part.mesh.position) for part in parts)
    coordinate, factor = np.zeros((total, 2), np.float32), np.ones(total, np.float32)
    layer, rows, texels, first = np.zeros(total, np.int32), [_OPAQUE], [np.ones(1, np.float32)], 0
    place: dict[Any, int] = {}
    for part, glass, through in zip(parts, glasses, clear, strict=True):
        own = slice(first, first + len(part.mesh.position))
        first = own.stop
        if not through:
            continue
        material, wrap, start, shape = part.material, (0, 0), -1, (1, 1)
        layer[own] = len(rows)
        source = material.alpha_texture if glass is None else material.transmission_texture
        factor[own] = _factor(part) if glass is None else 1 - glass.luminance if source is None else 1
        if source is not None:
            key = id(source.image), glass and glass.luminance
            image = np.asarray(source.image, np.float32)[..., 0]
            if key not in place:
                place[key] = sum(map(len, texels))
                texels.append((image if glass is None else 1 - np.float32(glass.luminance) * image).ravel())
            start, shape = place[key], image.shape
            wrap = tuple(texture.WRAPS.index(mode) for mode in source.wrap)
            sets = part.mesh.texture, part.mesh.texture if part.second is None else part.second
            move = np.asarray(source.transform, np.float64)
            coordinate[own] = np.asarray(sets[source.set], np.float64) @ move[:, :2].T + move[:, 2]
        cutoff = BLEND if glass is not None or material.alpha_mode == "blend" else float(material.alpha_cutoff)
        rows.append((cutoff, wrap, start, shape, (1, 1, 1) if glass is None else tuple(glass.color), glass is not None))
    cutoff, wrap, start, shape, passing, clean = (np.array(column) for column in zip(*rows, strict=True))
    columns = cutoff.astype(np.float32), wrap.astype(np.int32), start.astype(np.int64), shape.astype(np.int32)
    return Opacity(coordinate, factor, layer, *columns, np.concatenate(texels), passing.astype(np.float32), clean)


def _glass(part: Any) -> _Glass | None:
    """Light that passes the material of a part; None where it transmits none that pictures show, or has an alpha."""
    material = part.material
    if not isinstance(material, TexturedMaterial) or _lets_light_through(part) or not known(material.transmission):
        return None
    if float(material.transmission) < CLEAR:
        return None
    color = _mean(material.base_color, material.base_color_texture)
    ior = float(material.ior)
    reflected = np.clip(((ior - 1) / (ior + 1)) ** 2 * _mean(material.specular, material.specular_texture), 0, 1)
    metallic = _mean(material.metallic, material.metallic_texture)
    share = float(material.transmission) * float(1 - reflected[0]) * float(1 - metallic[0])
    luminance = float(color @ _LUMINANCE)
    return _Glass(share * luminance, color / luminance) if share * luminance > CLEAR else None


def _mean(factor: Any, image: Texture | None) -> Float[np.ndarray, " _"]:
    value = np.atleast_1d(np.asarray(factor, np.float64))
    return value if image is None else value * np.asarray(image.image, np.float64).mean((0, 1))


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
