"""Reflected light of meshes whose regions are groups of their own."""

import functools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxprt import harmonic
from jaxprt.scene import Environment, Mesh, builtin
from jaxprt.scene.mesh import make_mesh
from jaxprt.sphere import directions
from jaxprt.systems.bounces import GroupBounces, ReflectingPart, TransferTensor

EYE = jnp.array([0.3, 3.0, 0.2])
SKY = Environment(jax.device_put(np.ones((6, 8, 8, 3), np.float32)))
OPTIONS = {"components": 40, "modes": 24, "edge": 2, "size": 16}


@functools.cache
def bowl() -> Mesh:
    """Half a sphere of 225 vertices, seen from inside: each point sees it over half of its horizon, by the cosine."""
    ball = builtin.sphere(rings=16, sectors=28)
    low = np.all(np.asarray(ball.position)[np.asarray(ball.face), 1] < 1e-3, 1)
    used, face = np.unique(np.asarray(ball.face)[low][:, ::-1], return_inverse=True)
    return make_mesh(np.asarray(ball.position)[used], face.reshape(-1, 3), normal=-np.asarray(ball.normal)[used])


def repeated(mesh: Mesh, count: int) -> Mesh:
    """The mesh with its first vertex again and again, up to a number that scenes share."""
    index = np.pad(np.arange(len(mesh.position)), (0, count - len(mesh.position)))
    return make_mesh(np.asarray(mesh.position)[index], mesh.face, normal=np.asarray(mesh.normal)[index])


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
