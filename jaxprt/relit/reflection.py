"""Light that the parts of a scene reflect onto each other: estimates of its size, and its precomputation."""

import pathlib
from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxprt.brdf import Lambert
from jaxprt.relit import paths
from jaxprt.relit.channels import Shading
from jaxprt.relit.recipes import Target, harmonic_table, lobe_table
from jaxprt.scene import Environment, Mesh
from jaxprt.scene.mesh import join
from jaxprt.sphere import directions
from jaxprt.systems import bounces, harmonic
from jaxprt.systems.bounces import PartBounces, ReflectingPart, traced
from jaxprt.systems.bounces.jobs import DEGREE
from jaxprt.systems.bright_texels import BrightTexels
from jaxprt.systems.harmonic import TransferVector
from jaxprt.systems.lobe import LobeBrdf, LobeSystem
from jaxprt.systems.protocol import System

T = TypeVar("T")

ALL = bounces.build.ALL
_EACH = 3  # number of bounces that are estimated one by one; further ones are extrapolated as a geometric series
_EDGE = 8  # largest edge of the faces of light that is reflected
_DEGREE, _DIRECT, _REFLECTED = 4, 16, 8  # of the estimate: degree of harmonics, and edges of the faces of rays
_SLOWEST = 0.95  # largest ratio of a bounce to the previous one
_LOBES = 8  # number of lobes for sharp parts whose system has no table of lobes


def check(count: int | str | None) -> None:
    """Refuses invalid numbers of bounces.

    Raises:
        TypeError: `count` is not a whole number, "all" or None.
        ValueError: `count` is negative, or a word other than "all".
    """
    if count is None or (isinstance(count, str) and count == ALL):
        return
    if isinstance(count, str):
        raise ValueError(f"bounces must be a whole number or {ALL!r}, got {count!r}")
    if not (type(count) is int or isinstance(count, np.integer)):
        raise TypeError(f"bounces must be a whole number or {ALL!r}, got {count!r}")
    if not 0 <= count < 1 << 31:
        raise ValueError(f"bounces must be at least 0, and below 2^31, or {ALL!r}, got {count}")


def make(shadings: Sequence[Shading], count: int | str, target: Target) -> PartBounces:
    """Precomputes the light that all parts reflect onto each other and themselves.

    Args:
        shadings: One `Shading` for each part: its mesh, BRDF and channel weights.
        count: Number of bounces, at least 1; or "all".
        target: Size of the light, and where and how to compute. All parts occlude each other, and all vertices are lit.

    Returns:
        The system of reflected light alone.
    """
    mesh = _joined(shadings)
    sent = _alike(shadings, paths.factored)
    tables = _alike(shadings, partial(harmonic_table, degree=DEGREE))
    weights = [paths.typical(*each) for each in zip(shadings, sent, strict=True)]
    options = {"edge": min(_EDGE, target.size), **target.options("bounces")}
    # Omit nothing: the number of bounces is decided, and later materials may reflect more.
    tensor = bounces.precompute(mesh, [each.brdf for each in sent], weights=weights, bounces=count, **options)
    frame = [directions.frame(each.mesh.normal, each.mesh.tangent) for each in shadings]
    parts = [
        ReflectingPart(each.mesh.position, axes, table, sent=path.sent)
        for each, axes, table, path in zip(shadings, frame, tables, sent, strict=True)
    ]
    return PartBounces(tensor, tuple(parts))


def sharp(shadings: Sequence[Shading], systems: Sequence[System], folder: pathlib.Path | None) -> list[LobeBrdf | None]:
    """For each part, its lobes if its reflections are traced; None if harmonics represent its reflections well enough.

    Args:
        shadings: One `Shading` for each part: its mesh, BRDF and channel weights.
        systems: The systems of the parts. If one has a table of lobes, it is used.
        folder: Folder that stores tables that are made here; None stores nothing.
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
    """Estimates the fraction of each part's radiance that surfaces reflected at least once, twice and three times.

    The estimate treats all surfaces as diffuse, with the mean albedo of their parts.

    Args:
        shadings: One `Shading` for each part: its mesh, BRDF and channel weights.
        environments: Environments. The result is the largest fraction under any of them.

    Returns:
        Relative L2 fraction for each number of bounces (rows) and part (columns).
    """
    mesh, albedo = _joined(shadings), np.stack([paths.albedo(each) for each in shadings])
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
            # The ratio is taken over two bounces, because odd and even bounces between two surfaces differ.
            before, _, last = (float(np.linalg.norm(bounce)) for bounce in own[-3:])
            ratio = min((last / before) ** 0.5, _SLOWEST) if before > 0 else 0.0
            own = np.concatenate([own[:-1], own[-1:] / (1 - ratio)])
            whole = max(float(np.linalg.norm(own.sum(0))), 1e-30)
            left = [float(np.linalg.norm(own[number:].sum(0))) / whole for number in range(1, _EACH + 1)]
            result[:, part] = np.maximum(result[:, part], np.asarray(left))
    return result


def needed(reflected: Float[np.ndarray, "b p"], error: float) -> int | str:
    """Smallest number of bounces that omits at most `error` of each part's radiance; "all" if two omit more."""
    enough = np.flatnonzero(np.all(reflected <= error, 1))
    return int(enough[0]) if enough.size else ALL


def _joined(shadings: Sequence[Shading]) -> Mesh:
    """The meshes of all parts as one mesh, whose regions are the parts."""
    one = [eqx.tree_at(lambda mesh: mesh.region, each.mesh, jnp.zeros_like(each.mesh.region)) for each in shadings]
    return join(one)


def _alike(shadings: Sequence[Shading], make: Callable[[Shading], T]) -> list[T]:
    """The result of `make` for each part. Parts with equal BRDFs, apart from colors, share one result."""
    known: list[tuple[Shading, T]] = []
    for each in shadings:
        same = [made for other, made in known if paths.alike(each, other)]
        known.append((each, same[0] if same else make(each)))
    return [made for _, made in known]
