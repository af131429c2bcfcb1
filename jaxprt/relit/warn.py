"""Warnings about scenes that are drawn as asked and yet look wrong: inside-out meshes, and BRDFs that create light."""

import dataclasses
import warnings
from collections.abc import Sequence

import numpy as np

from jaxprt.image import raster
from jaxprt.relit import paths
from jaxprt.relit.channels import Shading
from jaxprt.scene import Camera, Mesh, Scene, TexturedMaterial
from jaxprt.scene.camera import localized
from jaxprt.visibility import Occluder
from jaxprt.visibility.hits import front

_RAYS = 64  # along an edge of the picture
_SMALLEST = 0.01  # share of the picture's rays that a part must meet: at silhouettes, normals may face away
_GAIN = 1.02  # mean albedo up to which a BRDF may be 1 and rounded


def of_backs(scene: Scene, mesh: Mesh, camera: Camera) -> None:
    """Warns of parts of which a camera sees mostly the back, as in inside-out meshes. Backs are black.

    Parts that emit light are left out: lamps are often seen from behind.

    Args:
        scene: The scene.
        mesh: The mesh of all parts, `scene.mesh`.
        camera: The camera.
    """
    mesh, near = localized(mesh, camera)
    way = raster.ray_direction(dataclasses.replace(near, width=_RAYS, height=_RAYS))
    way, occluder = np.asarray(way, np.float32).reshape(-1, 3), Occluder(mesh)
    triangle, *_ = occluder.hit(np.tile(np.asarray(near.eye, np.float32), (len(way), 1)), way)
    met = np.flatnonzero(triangle >= 0)
    corner = occluder.facing(triangle[met], way[met])
    away = ~front(occluder, np.asarray(mesh.normal), corner, way[met])
    own = np.asarray(mesh.region)[corner[:, 0]]
    for number, part in enumerate(scene.parts):
        if isinstance(part.material, TexturedMaterial) and np.any(np.asarray(part.material.emissive)):
            continue
        seen = away[own == number]
        if len(seen) > _SMALLEST * len(way) and np.mean(seen) > 0.5:
            warnings.warn(
                f"a camera at {tuple(np.round(np.asarray(camera.eye, float), 3).tolist())} sees {np.mean(seen):.0%} of "
                f"part {part.name!r} from behind, and backs are black: if its mesh is inside out, with clockwise "
                "faces, reverse the corners of each face",
                stacklevel=3,
            )


def of_gain(scene: Scene, shadings: Sequence[Shading]) -> None:
    """Warns of BRDFs that reflect more light than they get. `TexturedMaterial` refuses such colors itself.

    Args:
        scene: The scene.
        shadings: The `Shading` of each part.
    """
    for part, shading in zip(scene.parts, shadings, strict=True):
        if isinstance(part.material, TexturedMaterial):
            continue
        gain = float(np.max(paths.channels(shading.exact)))
        if gain > _GAIN:
            warnings.warn(
                f"the BRDF of part {part.name!r} reflects {gain:.3g} times the light that it gets, averaged over "
                "directions: surfaces that do not emit reflect at most 1; colors are from 0 to 1",
                stacklevel=3,
            )
