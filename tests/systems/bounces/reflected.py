"""Reflected light of meshes whose regions are groups of their own."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxprt import harmonic
from jaxprt.scene import Environment, Mesh
from jaxprt.sphere import directions
from jaxprt.systems.bounces import GroupBounces, ReflectingPart, TransferTensor


def of_regions(mesh: Mesh, brdfs: Sequence[Callable], tensor: TransferTensor) -> GroupBounces:
    """The bounces of a mesh with one BRDF for each region."""
    frame = directions.frame(mesh.normal, mesh.tangent)
    region = [np.asarray(mesh.region) == number for number in range(len(brdfs))]
    tables = {id(brdf): harmonic.tabulate(brdf, degree=3, error=0.5) for brdf in brdfs}
    pairs = zip(region, brdfs, strict=True)
    groups = [ReflectingPart(mesh.position[at], frame[at], tables[id(brdf)]) for at, brdf in pairs]
    return GroupBounces.make(tensor, groups, [np.flatnonzero(at) for at in region])


def radiance(system: GroupBounces, light: Environment, eye, materials: Sequence | None = None) -> jax.Array:
    """Reflected radiance of all vertices, region after region."""
    blends = [None] * len(system.group) if materials is None else materials
    arriving = system.shade(system.light(light), blends)
    rows = zip(system.group, arriving, blends, strict=True)
    colors = [part.combine(lit, part.view(eye, blend)) for part, lit, blend in rows]
    most = max(color.shape[1] for color in colors)
    return jnp.concatenate([jnp.broadcast_to(color, (len(color), most)) for color in colors])
