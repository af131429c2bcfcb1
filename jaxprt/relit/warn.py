"""Warnings about scenes that are drawn as asked and yet look wrong.

Meshes may be inside out, a part may enclose the others and hide the light, and BRDFs may create light.
"""

import dataclasses
import warnings
from collections.abc import Sequence

import numpy as np

from jaxprt.image import raster
from jaxprt.relit import paths
from jaxprt.relit.channels import Shading
from jaxprt.relit.recipes import Recipe
from jaxprt.scene import Camera, Mesh, Part, Scene, TexturedMaterial
from jaxprt.scene.camera import localize
from jaxprt.scene.mesh import bounds
from jaxprt.visibility import Occluder
from jaxprt.visibility.rays import hits_front

_RAYS = 64  # along an edge of the picture
_SMALLEST = 0.01  # share of the picture's rays that a part must meet: at silhouettes, normals may face away
_POINTS = 64  # vertices of other parts that tell whether a part encloses them
_SHELLS = 4  # parts with the extent of the whole scene that are looked at
_HIDDEN = 0.99  # share of the upper hemisphere that an enclosing part hides
_NAMED = 4  # parts that a warning names
_GAIN = 1.02  # mean albedo up to which a BRDF may be 1 and rounded


def of_backs(scene: Scene, mesh: Mesh, camera: Camera) -> None:
    """Warns of parts of which a camera sees mostly the back, as in inside-out meshes. Backs are black.

    Parts that emit light are left out: lamps are often seen from behind.

    Args:
        scene: The scene.
        mesh: The mesh of all parts, `scene.mesh`.
        camera: The camera.
    """
    mesh, near = localize(mesh, camera)
    way = raster.ray_direction(dataclasses.replace(near, width=_RAYS, height=_RAYS))
    way, occluder = np.asarray(way, np.float32).reshape(-1, 3), Occluder(mesh)
    triangle, *_ = occluder.hit(np.tile(np.asarray(near.eye, np.float32), (len(way), 1)), way)
    hit = np.flatnonzero(triangle >= 0)
    corner = occluder.facing(triangle[hit], way[hit])
    away = ~hits_front(occluder, np.asarray(mesh.normal), corner, way[hit])
    owner = np.asarray(mesh.region)[corner[:, 0]]
    shells = enclosing(scene)
    for number, part in enumerate(scene.parts):
        seen = away[owner == number]
        if _emits(part) or _lit_behind(part) or len(seen) <= _SMALLEST * len(way) or np.mean(seen) <= 0.5:
            continue
        if number in shells and not _has_lamps(scene):
            continue  # `of_shells` says more
        remedy = "if its mesh is inside out, negate its normals; without normals, reverse the corners of each face"
        if number in shells:
            remedy = "it encloses the scene, so give a camera inside of it"
        warnings.warn(
            f"a camera at {tuple(np.round(np.asarray(camera.eye, float), 3).tolist())} sees {np.mean(seen):.0%} of "
            f"part {part.name!r} from behind, and {_backs(part)}: {remedy}",
            stacklevel=3,
        )


def of_shells(scene: Scene) -> None:
    """Warns of parts that enclose all others, such as a sky dome: no light of the environment gets in.

    Scenes with lamps are left out, because these may be inside.

    Args:
        scene: The scene.
    """
    if _has_lamps(scene):
        return
    for number in enclosing(scene):
        warnings.warn(
            f"part {scene.parts[number].name!r} encloses the scene and hides the light of the environment from it, so "
            "everything inside is black: remove this part from the scene, and if it is a sky dome, load its picture as "
            "the environment",
            stacklevel=3,
        )


def enclosing(scene: Scene) -> list[int]:
    """Indices of the parts that hide the upper hemisphere from the other parts, however their faces are turned."""
    meshes = [part.mesh for part in scene.parts]
    low, high = (np.stack(corner) for corner in zip(*map(bounds, meshes), strict=True))
    around = (low <= low.min(0))[:, ::2].all(1) & (high >= high.max(0)).all(1)
    result = []
    for number in np.flatnonzero(around)[:_SHELLS].tolist() if len(meshes) > 1 else []:
        mesh, rest = meshes[number], [other for other in range(len(meshes)) if other != number]
        step = max(1, sum(len(meshes[other].position) for other in rest) // _POINTS)
        start = np.concatenate([np.asarray(meshes[other].position) for other in rest])[::step]
        way = _upper(_RAYS)
        point, ray = (index.ravel() for index in np.indices((len(start), len(way))))
        if np.mean(Occluder(mesh).blocked(start.astype(np.float32), way, point, ray)) > _HIDDEN:
            result.append(number)
    return result


def _has_lamps(scene: Scene) -> bool:
    return bool(scene.point_lights) or any(_emits(part) for part in scene.parts)


def _backs(part: Part) -> str:
    """What cameras see of the backs of a part."""
    hidden = isinstance(part.material, TexturedMaterial) and part.material.back != "black"
    return "its material hides backs" if hidden else "backs are black"


def _lit_behind(part: Part) -> bool:
    return isinstance(part.material, TexturedMaterial) and part.material.back == "lit"


def _emits(part: Part) -> bool:
    return isinstance(part.material, TexturedMaterial) and bool(np.any(np.asarray(part.material.emissive)))


def _upper(count: int) -> np.ndarray:
    """Directions that are spread evenly over the upper hemisphere, on a spiral."""
    height = (np.arange(count) + 0.5) / count
    turn = np.pi * (1 + np.sqrt(5)) * np.arange(count)
    ring = np.sqrt(1 - height**2)
    return np.stack([ring * np.cos(turn), height, ring * np.sin(turn)], 1).astype(np.float32)


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


def of_omissions(parts: Sequence[Part], shadings: Sequence[Shading], recipes: Sequence[Recipe]) -> None:
    """Warns once of each feature of materials that the systems of some parts do not show, as `Recipe.omits` says.

    Args:
        parts: The parts of the scene.
        shadings: The `Shading` of each part.
        recipes: The recipe of each part.
    """
    names: dict[tuple[str, str, str], list[str]] = {}
    for part, shading, recipe in zip(parts, shadings, recipes, strict=True):
        for field, shown in recipe.omits(shading).items():
            if getattr(part.material, field, None) is not None:
                names.setdefault((type(recipe).__name__, field, shown), []).append(part.name)
    for (recipe, field, shown), owners in names.items():
        more = f" and {len(owners) - _NAMED} more" if len(owners) > _NAMED else ""
        warnings.warn(
            f"the system {recipe} does not show the {field} of the parts {owners[:_NAMED]}{more} as it is: they "
            f"{shown}; use the lobe or the dynamic system for them",
            stacklevel=3,
        )
