"""Is drawing a mesh in JAX as fast as tracing its primary rays with Embree on two threads?

    python -m benchmarks.rasterize [--quick] [--output FILE]

The error is the part of the pixels whose triangle differs from Embree's.
"""

import concurrent.futures
import os
import pathlib
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from benchmarks import harness
from jaxprt.image import rasterize, ray_direction
from jaxprt.scene import Camera, Mesh

THREADS = 2


def main(options: Sequence[str] | None = None) -> None:
    arguments = harness.parser(str(__doc__).splitlines()[0]).parse_args(options)
    n, m = (50, 40) if arguments.quick else (250, 200)
    cases = {"torus": torus(n, m)}
    folder = pathlib.Path(os.environ.get("JAXPRT_DATA", "")) / "meshes"
    if not arguments.quick and (folder / "dragon_100k.ply").exists():
        loaded = trimesh.load_mesh(folder / "dragon_100k.ply", process=False)
        cases = {"dragon": (np.asarray(loaded.vertices), np.asarray(loaded.faces)), **cases}
    size = 128 if arguments.quick else 512
    repeats = 5 if arguments.quick else 30
    with concurrent.futures.ThreadPoolExecutor(THREADS) as pool:
        for name, (position, face) in cases.items():
            harness.report(compare(pool, name, position, face, size, repeats), arguments.output)


def compare(pool, name: str, position: np.ndarray, face: np.ndarray, size: int, repeats: int) -> dict:
    """Draws the same picture by both, and gives the line to report."""
    position, face = position.astype(np.float32), face.astype(np.int32)
    zero = jnp.zeros(position.shape, jnp.float32)
    mesh = Mesh(jnp.asarray(position), jnp.asarray(face), zero, zero, jnp.zeros(len(position), jnp.int32))
    camera = facing(position, size)
    scene = EmbreeScene()
    TriangleMesh(scene, position, face)
    ray = np.asarray(ray_direction(camera), np.float32).reshape(-1, 3)
    origin = np.broadcast_to(np.asarray(camera.eye, np.float32), ray.shape)
    parts = [tuple(x.copy() for x in p) for p in zip(np.split(origin, THREADS), np.split(ray, THREADS), strict=True)]

    def trace():
        return list(pool.map(lambda part: scene.run(*part, query="INTERSECT"), parts))

    mine, peer = harness.compare(lambda: rasterize(mesh, camera), trace, repeats=repeats)
    fragments = rasterize(mesh, camera)
    drawn, traced = np.asarray(fragments.triangle).ravel(), np.concatenate(trace())
    return {
        "benchmark": "rasterize",
        "case": f"{name}, {len(face)} triangles, {size} x {size}, {100 * np.mean(drawn >= 0):.0f} % covered",
        **mine.line(),
        "error": float(np.mean(drawn != traced)),
        "bytes": sum(leaf.nbytes for leaf in jax.tree.leaves(fragments)),
        "peer": "embree-primary",
        "peer_seconds": peer.seconds,
        "peer_error": 0.0,
        "pixels_that_differ": int(np.sum(drawn != traced)),
        "pixels_seen_by_one_only": int(np.sum((drawn < 0) != (traced < 0))),
    }


def facing(position: np.ndarray, size: int) -> Camera:
    """A camera on the +z side that the mesh just fills, across or upwards."""
    low, high = position.min(0), position.max(0)
    center, extent = (low + high) / 2, (high - low)[:2].max()
    angle = 0.7
    away = extent / 2 / np.tan(angle / 2) + (high - low)[2] / 4
    eye = center + np.array([0, 0, away])
    eye, target, up = (jnp.asarray(x, jnp.float32) for x in (eye, center, (0, 1, 0)))
    return Camera(eye, target, up, jnp.float32(angle), size, size)


def torus(n: int, m: int) -> tuple[np.ndarray, np.ndarray]:
    """A bumpy torus of 2 n m triangles, tilted towards +z."""
    i, j = (a.ravel() for a in np.meshgrid(np.arange(n), np.arange(m), indexing="ij"))
    u, v = 2 * np.pi * i / n, 2 * np.pi * j / m
    tube = 0.45 + 0.03 * np.sin(9 * u) * np.cos(7 * v)
    ring = 1 + tube * np.cos(v)
    position = np.stack([ring * np.cos(u), ring * np.sin(u), tube * np.sin(v)], -1)
    a, b, c, d = i * m + j, (i + 1) % n * m + j, (i + 1) % n * m + (j + 1) % m, i * m + (j + 1) % m
    return position, np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])


if __name__ == "__main__":
    main()
