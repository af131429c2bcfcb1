"""Does precomputation cost much more than its rays, and is supersampling boundaries as good as supersampling all?

    python -m benchmarks.precompute_separable [--quick] [--output FILE]

The mesh is the Stanford bunny of JAXPRT_DATA on a ground of 22,000 vertices, or the embedded chess pieces without it.
The peer is embreex's query alone, ray by ray, on the very rays that precomputation traces, on as many threads: timed on
every 8th block, half of them before and half after, and scaled by the number of rays. The error is that of visibility
x cosine, which is what transport is made of, against 16 rays in every texel (6 x 256 x 256), on 64 vertices.
"""

import concurrent.futures
import os
import pathlib
import time
from collections.abc import Sequence

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from benchmarks import harness
from jaxprt import separable, visibility
from jaxprt.brdf import AshikhminShirley, Lambert
from jaxprt.scene import Mesh, builtin, load_mesh
from jaxprt.scene.mesh import ground_plane, join, split
from jaxprt.sphere import cubemap
from jaxprt.visibility import Run

SIZE = 64
EVERY = 8


class Recorder(visibility.Occluder):
    """An occluder that remembers the rays it was asked for, and can ask embreex itself for them."""

    def __init__(self, mesh: Mesh):
        super().__init__(mesh)
        self.rays = []
        self.embreex = EmbreeScene()
        TriangleMesh(self.embreex, self.position, self.face)

    def blocked(self, origin, direction, point, way):
        """Whether rays meet a triangle; keeps the rays."""
        self.rays.append((origin.take(point, axis=0), direction.take(way, axis=0)))
        return super().blocked(origin, direction, point, way)


def main(options: Sequence[str] | None = None) -> None:
    arguments = harness.parser(str(__doc__).splitlines()[0]).parse_args(options)
    name, parts = scene(arguments.quick)
    size = 16 if arguments.quick else SIZE
    whole = join([mesh for mesh, _, _ in parts])
    factored = [separable.factor(brdf, terms=terms) for _, brdf, terms in parts]
    recorder = Recorder(whole)
    starts = [visibility.start_points(mesh, recorder) for mesh, _, _ in parts]
    start = np.concatenate(starts)
    normal = np.asarray(whole.normal)
    # One block of each part compiles.
    for (mesh, _, _), brdf in zip(parts, factored, strict=True):
        separable.precompute(mesh, brdf, size=size, occluder=whole, vertex=np.arange(1), run=Run(progress=False))
    chosen = np.arange(0, len(start), visibility.rays.BLOCK)[:: 2 if arguments.quick else EVERY]
    counts = [embree_alone(recorder, start, normal, chosen[0::2], size)]
    began = time.perf_counter()
    result = [
        separable.precompute(mesh, brdf, keep=96, size=size, occluder=whole, run=Run(progress=not arguments.quick))
        for (mesh, _, _), brdf in zip(parts, factored, strict=True)
    ]
    seconds = time.perf_counter() - began
    counts.append(embree_alone(recorder, start, normal, chosen[1::2], size))
    before, after = counts
    count, embree_seconds, vertices = before[0] + after[0], before[1] + after[1], before[2] + after[2]
    rays = count.rays / vertices * len(start)
    error, plain_error = supersampling_error(recorder, start, normal, size)
    harness.report(
        {
            "benchmark": "precompute_separable",
            "case": name,
            "seconds": seconds,
            "compile_seconds": 0.0,
            "error": error,
            "bytes": sum(each.nbytes for each in result),
            "peer": "embree-rays",
            "peer_seconds": embree_seconds * rays / count.rays,
            "peer_error": error,
            "visibility_error": plain_error,
            "vertices": len(start),
            "rays_per_vertex": rays / len(start),
            "mrays_per_second": rays / seconds / 1e6,
            "embree_mrays_per_second": count.rays / embree_seconds / 1e6,
            "supersampled_fraction": count.supersampled / count.texels,
            "peak_bytes": harness.peak_memory(),
        },
        arguments.output,
    )


def scene(quick: bool) -> tuple[str, list]:
    """Meshes with their BRDFs and terms."""
    glossy = AshikhminShirley(diffuse=0.5, specular=0.75, nu=10, nv=100)
    path = pathlib.Path(os.environ.get("JAXPRT_DATA", "")) / "meshes" / "stanford_bunny.ply"
    if quick:
        ball = builtin.sphere(rings=12, sectors=24)
        return "ball + ground, 600 vertices", [(ball, glossy, 4), (ground_plane(ball, vertices=324), Lambert(0.5), 1)]
    if not path.exists():
        pieces, light, dark = split(builtin.chess())
        return "chess", [(pieces, glossy, 4), (light, Lambert(0.6), 1), (dark, Lambert(0.1), 1)]
    bunny = load_mesh(path)
    return "bunny + ground", [(bunny, glossy, 4), (ground_plane(bunny, vertices=22_000), Lambert(0.5), 1)]


def embree_alone(recorder: Recorder, start: np.ndarray, normal: np.ndarray, first: np.ndarray, size: int):
    """Rays of some blocks, the seconds that Embree takes for them on all threads, and the vertices in them."""
    threads = os.cpu_count() or 1
    count, seconds, vertices = visibility.rays.RayCount(0, 0, 0), 0.0, 0
    with concurrent.futures.ThreadPoolExecutor(threads) as pool:
        for group in np.array_split(first, max(1, len(first) // threads)):
            batches = []
            for begin in group:
                part = slice(begin, begin + visibility.rays.BLOCK)
                recorder.rays.clear()
                count += visibility.fractional(recorder, start[part], normal[part], size=size)[1]
                batches.append(list(recorder.rays))
                vertices += len(start[part])
            began = time.perf_counter()
            list(pool.map(lambda batch: [recorder.embreex.run(*rays, query="OCCLUDED") for rays in batch], batches))
            seconds += time.perf_counter() - began
    recorder.rays.clear()
    return count, seconds, vertices


def supersampling_error(recorder: Recorder, start: np.ndarray, normal: np.ndarray, size: int) -> tuple[float, float]:
    """Relative L2 errors with 16 rays on boundaries only: of visibility x cosine, and of visibility alone."""
    vertex = np.random.default_rng(0).choice(len(start), min(64, len(start)), replace=False)
    mine, _ = visibility.fractional(recorder, start[vertex], normal[vertex], size=size)
    exact = visibility.exhaustive(recorder, start[vertex], normal[vertex], size=size)
    recorder.rays.clear()
    cosine = np.maximum(normal[vertex] @ np.asarray(cubemap.vector_area(size=size)).reshape(-1, 3).T, 0)
    errors = []
    for weight in (cosine, 1.0):
        difference = (mine.astype(float) - exact) * weight
        errors.append(float(np.linalg.norm(difference) / np.linalg.norm(exact * weight)))
    return errors[0], errors[1]


if __name__ == "__main__":
    main()
