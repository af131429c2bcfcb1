"""Is drawing a mesh in JAX as fast as tracing its primary rays with Embree on two threads, and what do edges cost?

    python -m benchmarks.rasterize [--quick] [--output FILE]

The error is the part of the pixels, or of their samples, whose triangle differs from Embree's. Of pictures with four
samples in each pixel the peer is the picture with one, and the error is the relative L2 of the coverage from that of a
picture eight times as fine; `peer_error` is that of the picture with one.
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
from jaxprt.image import rasterize, ray_direction, render
from jaxprt.image.raster import SAMPLES
from jaxprt.scene import Camera, Mesh
from jaxprt.scene.mesh import make_mesh

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
            mesh = make_mesh(position.astype(np.float32), face.astype(np.int32))
            camera = facing(np.asarray(mesh.position), size)
            for samples in (1, 4):
                harness.report(compare(pool, name, mesh, camera, samples, repeats), arguments.output)
            harness.report(edges(name, mesh, camera, repeats), arguments.output)


def compare(pool, name: str, mesh: Mesh, camera: Camera, samples: int, repeats: int) -> dict:
    """Draws the same picture by both, and gives the line to report."""
    scene = EmbreeScene()
    TriangleMesh(scene, np.asarray(mesh.position), np.asarray(mesh.face))
    ray = rays(camera, samples).reshape(-1, 3)
    origin = np.broadcast_to(np.asarray(camera.eye, np.float32), ray.shape)
    parts = [tuple(x.copy() for x in p) for p in zip(np.split(origin, THREADS), np.split(ray, THREADS), strict=True)]

    def trace():
        return list(pool.map(lambda part: scene.run(*part, query="INTERSECT"), parts))

    mine, peer = harness.compare(lambda: rasterize(mesh, camera, samples=samples), trace, repeats=repeats)
    fragments = rasterize(mesh, camera, samples=samples)
    drawn, traced = np.asarray(fragments.triangle).ravel(), np.concatenate(trace())
    return {
        "benchmark": "rasterize",
        "case": f"{title(name, mesh, camera, samples)}, {100 * np.mean(drawn >= 0):.0f} % covered",
        **mine.line(),
        "error": float(np.mean(drawn != traced)),
        "bytes": sum(leaf.nbytes for leaf in jax.tree.leaves(fragments)),
        "peer": "embree-primary",
        **peer.peer(),
        "peer_error": 0.0,
        "pixels_that_differ": int(np.sum(drawn != traced)),
        "pixels_seen_by_one_only": int(np.sum((drawn < 0) != (traced < 0))),
    }


def title(name: str, mesh: Mesh, camera: Camera, samples: int) -> str:
    """What is drawn."""
    return f"{name}, {len(mesh.face)} triangles, {camera.height} x {camera.width}, samples {samples}"


def rays(camera: Camera, samples: int) -> np.ndarray:
    """Directions of the samples [h, w, s, 3]. Four are centers of pixels of a picture four times as fine."""
    if samples == 1:
        return np.asarray(ray_direction(camera), np.float32)[:, :, None]
    every = np.asarray(ray_direction(finer(camera, 4)), np.float32)
    return np.stack([every[y::4, x::4] for x, y in (4 * SAMPLES[4] + 1.5).astype(int)], 2)


def finer(camera: Camera, times: int) -> Camera:
    """A camera of the same view with more pixels."""
    width, height = times * camera.width, times * camera.height
    return Camera(camera.eye, camera.target, camera.up, camera.field_of_view, width, height)


def edges(name: str, mesh: Mesh, camera: Camera, repeats: int) -> dict:
    """A whole picture with four samples in each pixel beside that with one, and how they cover pixels."""
    color = jnp.ones((len(mesh.position), 3), jnp.float32)
    picture = {samples: lambda samples=samples: render(mesh, color, camera, samples=samples) for samples in (1, 4)}
    mine, peer = harness.compare(picture[4], picture[1], repeats=repeats)
    seen = np.asarray(rasterize(mesh, finer(camera, 8)).triangle) >= 0
    truth = seen.reshape(camera.height, 8, camera.width, 8).mean((1, 3))[..., None]
    four, one = (float(np.linalg.norm(picture[s]() - truth) / np.linalg.norm(np.tile(truth, 3))) for s in (4, 1))
    return {
        "benchmark": "rasterize",
        "case": f"{title(name, mesh, camera, 4)}, picture",
        **mine.line(),
        "error": four,
        "bytes": picture[4]().nbytes,
        "peer": "one sample",
        **peer.peer(),
        "peer_error": one,
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
