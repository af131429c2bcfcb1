"""Light that the parts of a scene reflect onto each other: what it is worth, and how it is precomputed."""

import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxprt.brdf import CookTorrance, Lambert
from jaxprt.relit.channels import Shading
from jaxprt.relit.recipes import Target, harmonic_table, lobe_table
from jaxprt.scene import Environment, Mesh
from jaxprt.scene.mesh import join
from jaxprt.sphere import directions
from jaxprt.systems import bounces, harmonic, separable
from jaxprt.systems.bounces import PartBounces, ReflectingPart, traced
from jaxprt.systems.bounces.jobs import DEGREE
from jaxprt.systems.bright_texels import BrightTexels
from jaxprt.systems.harmonic import TransferVector
from jaxprt.systems.lobe import LobeBrdf, LobeSystem
from jaxprt.systems.protocol import System

ALL = bounces.build.ALL
_EACH = 3  # bounces that are estimated one by one; those that follow fall as these do
_EDGE = 8  # of the faces of light that is reflected, at most
_TERMS, _RESOLUTION = 24, 32  # of BRDFs on the way of reflected light
_DEGREE, _DIRECT, _REFLECTED = 4, 16, 8  # where bounces are judged: harmonics, and edges of the faces of rays
_WIDTH = 0.09  # of lobes on the way of reflected light, at least: alpha of GGX, or m of Beckmann's distribution
_DARK = 1e-6  # albedo of what reflects nothing
_SLOWEST = 0.95  # share of a bounce that the next one has, at most
_LOBES = 8  # of parts whose systems have none, for the rays of sharp ones
_VIEWS = 16  # over whose angles albedo is averaged
_RINGS, _SECTORS = 48, 320  # of the quadrature of each: of roughness .1 and more within a few per cent


def check(count: int | str | None) -> None:
    """Refuses numbers of bounces that are none.

    Raises:
        TypeError: It is no whole number, nor "all" nor None.
        ValueError: It is less than 0, or another word.
    """
    if count is None or (isinstance(count, str) and count == ALL):
        return
    if isinstance(count, str):
        raise ValueError(f"bounces must be a whole number or {ALL!r}, got {count!r}")
    if not (type(count) is int or isinstance(count, np.integer)):
        raise TypeError(f"bounces must be a whole number or {ALL!r}, got {count!r}")
    if count < 0:
        raise ValueError(f"bounces must be at least 0, got {count}")


def make(shadings: Sequence[Shading], count: int | str, target: Target) -> PartBounces:
    """Precomputes reflected light between all parts.

    Args:
        shadings: What the parts are to systems.
        count: How many times light is reflected, at least once; or "all".
        target: The light's size, and where that is done; the parts occlude each other, and all vertices are lit.

    Returns:
        The system of reflected light alone.
    """
    mesh = _joined(shadings)
    paths = [_factored(each) for each in shadings]
    weights = [None if each.blend is None else jnp.mean(each.blend.weight, 0) for each in shadings]
    options = {"edge": min(_EDGE, target.size), **target.options("bounces")}
    # Nothing is left out: how many bounces there are is decided, and materials may change to what brings more.
    tensor = bounces.precompute(mesh, paths, weights=weights, bounces=count, **options)
    frame = [directions.frame(each.mesh.normal, each.mesh.tangent) for each in shadings]
    parts = [
        ReflectingPart(each.mesh.position, axes, harmonic_table(each, degree=DEGREE))
        for each, axes in zip(shadings, frame, strict=True)
    ]
    return PartBounces(tensor, tuple(parts))


def sharp(shadings: Sequence[Shading], systems: Sequence[System], folder: pathlib.Path | None) -> list[LobeBrdf | None]:
    """Lobes of the parts whose reflections are traced; None for those that harmonics are enough for.

    Args:
        shadings: What the parts are to systems.
        systems: The systems of the parts, whose tables of lobes are taken where they have some.
        folder: What keeps tables that are made here; None keeps nothing.
    """
    result: list[LobeBrdf | None] = []
    for number, (shading, system) in enumerate(zip(shadings, systems, strict=True)):
        if isinstance(shading.brdf, Lambert):
            result.append(None)
            continue
        inner = system.system if isinstance(system, BrightTexels) else system
        table = inner.brdf if isinstance(inner, LobeSystem) else None
        if table is None:
            path = None if folder is None else folder / f"{number}_sharp_{_LOBES}.prt"
            table = lobe_table(shading, _LOBES, path)
        result.append(table if traced.is_sharp(table) else None)
    return result


def fractions(shadings: Sequence[Shading], environments: Sequence[Environment]) -> Float[np.ndarray, "b p"]:
    """Fraction of each part's radiance that other surfaces reflected at least once, twice, and three times.

    An estimate: surfaces count as matte, with the mean albedo of their parts.

    Args:
        shadings: What the parts are to systems.
        environments: Lights; the largest fraction under any of them counts.

    Returns:
        Relative L2, by bounces and parts.
    """
    mesh, albedo = _joined(shadings), np.stack([_albedo(each) for each in shadings])
    options = {"size": _REFLECTED, "progress": False}
    direct = harmonic.precompute_diffuse(mesh, degree=_DEGREE, size=_DIRECT, progress=False)
    each = [direct.vector]
    for _ in range(_EACH):
        last = TransferVector(each[-1], direct.position)
        both = harmonic.interreflect_diffuse(mesh, last, albedo, bounces=1, **options)
        each.append(both.vector - each[-1])
    region, result = np.asarray(mesh.region), np.zeros((_EACH, len(shadings)))
    for light in environments:
        coefficient = harmonic.project(light, degree=_DEGREE)
        lit = np.stack([np.asarray(harmonic.combine(coefficient, vector)) for vector in each])
        for part in range(len(shadings)):
            own = lit[:, region == part]
            # Over two bounces: between two surfaces, odd ones and even ones are not alike.
            before, _, last = (float(np.linalg.norm(bounce)) for bounce in own[-3:])
            ratio = min((last / before) ** 0.5, _SLOWEST) if before > 0 else 0.0
            own = np.concatenate([own[:-1], own[-1:] / (1 - ratio)])
            whole = max(float(np.linalg.norm(own.sum(0))), 1e-30)
            left = [float(np.linalg.norm(own[number:].sum(0))) / whole for number in range(1, _EACH + 1)]
            result[:, part] = np.maximum(result[:, part], np.asarray(left))
    return result


def needed(reflected: Float[np.ndarray, "b p"], error: float) -> int | str:
    """How many bounces leave no more than an error of any part's light out; all if two leave out more."""
    enough = np.flatnonzero(np.all(reflected <= error, 1))
    return int(enough[0]) if enough.size else ALL


def _joined(shadings: Sequence[Shading]) -> Mesh:
    """The meshes of all parts as one, whose regions are the parts."""
    one = [eqx.tree_at(lambda mesh: mesh.region, each.mesh, jnp.zeros_like(each.mesh.region)) for each in shadings]
    return join(one)


def _factored(shading: Shading) -> separable.SeparableBrdf:
    """What a part reflects light with on its way to others.

    Lobes that are too narrow for the maps are widened: a mirror of roughness .05 would send 235 times the light that it
    gets. Each channel then has the albedo that it has in truth. What arrives elsewhere is a few harmonics, and wider.
    """
    brdf = _still(shading)
    wide = _widened(brdf)
    made = separable.factor(wide, terms=1 if isinstance(brdf, Lambert) else _TERMS, resolution=_RESOLUTION)
    kept = np.atleast_1d(bounces.functions.albedo(made))
    scale = np.where(kept > _DARK, _channels(brdf) / np.maximum(kept, _DARK), 1)
    return eqx.tree_at(lambda each: each.view_map, made, made.view_map * jnp.asarray(scale, made.view_map.dtype))


def _widened(brdf: Callable) -> Callable:
    """A BRDF whose roughness is enough for maps of light paths; one without a roughness stays as it is."""

    def wider(path: tuple, leaf: Any) -> Any:
        name = getattr(path[-1], "name", None) if path else None
        if name == "roughness":
            # Cook-Torrance's is the width itself, that of metallic-roughness materials its root.
            return jnp.maximum(leaf, _WIDTH if isinstance(_owner(brdf, path), CookTorrance) else _WIDTH**0.5)
        return jnp.minimum(leaf, 2 / _WIDTH**2 - 2) if name in ("nu", "nv", "exponent") else leaf

    return jax.tree_util.tree_map_with_path(wider, brdf)


def _owner(tree: Any, path: tuple) -> Any:
    """What holds a leaf."""
    for key in path[:-1]:
        tree = getattr(tree, key.name) if hasattr(key, "name") else tree[key.idx if hasattr(key, "idx") else key.key]
    return tree


def _albedo(shading: Shading) -> Float[np.ndarray, "3"]:
    """Mean albedo of a part, over its vertices and over views from above."""
    channel = _channels(_still(shading))
    color = channel if shading.blend is None else channel @ np.mean(shading.blend.weight, 0)
    return np.clip(np.broadcast_to(color, 3), 0, 1)


def _channels(brdf: Callable) -> Float[np.ndarray, " k"]:
    """Mean albedo of each channel of a BRDF, over views from above."""
    cosine = np.sqrt((np.arange(_VIEWS) + 0.5) / _VIEWS)  # Evenly spread in projected solid angle.
    wo = np.stack([np.sqrt(1 - cosine**2), 0 * cosine, cosine], -1).astype(np.float32)
    sent = harmonic.table.project(brdf, jnp.asarray(wo), degree=0, rings=_RINGS, sectors=_SECTORS)
    return np.asarray(np.sqrt(4 * np.pi) * np.mean(sent[0], -1))


def _still(shading: Shading) -> Callable:
    """The BRDF of a part, at the mean roughness if that varies."""
    if not shading.knot:
        return shading.brdf
    assert shading.blend is not None
    return shading.brdf(jnp.asarray(np.mean(shading.blend.parameter[0])))
