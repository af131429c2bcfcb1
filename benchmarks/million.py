"""What do a million vertices take: memory and time of precomputation, and of new light out of core?

    python -m benchmarks.million [--quick] [--output FILE]

The mesh is two scans of JAXPRT_DATA beside each other, simplified and then subdivided to 10,000, 100,000 and 1,000,000
vertices, or a sphere without them. Each count has a process of its own, whose `peak_bytes` are those beyond the mesh's
`mesh_bytes`, JAX and all else included that was there before. Precomputation is that of the separable system into a
store, at 6 x 4 x 4 texels so that it ends in minutes; memory depends on the texels by a block alone, as the last case
shows: a two-hundredth of the visibility of the largest mesh at 6 x 64 x 64. The error of precomputation is against
some vertices computed alone, without a store.

New light is met by ranges of vertices of the saved transport, mapped from its files; the peer reads the same bytes on
two threads, and the error is against all vertices at once.
"""

import concurrent.futures
import contextlib
import functools
import itertools
import multiprocessing
import pathlib
import tempfile
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import harness
from jaxprt import files, separable, visibility
from jaxprt.brdf import AshikhminShirley
from jaxprt.scene import Mesh, builtin, load_mesh, occluder, subdivision
from jaxprt.scene.mesh import join, make_mesh
from jaxprt.systems import ranges
from jaxprt.visibility import Run

SCANS = "dragon_100k", "happy_buddha_100k"
COUNTS = 10_000, 100_000, 1_000_000
SIZE, FINE, TERMS, KEEP = 4, 64, 4, 16
RANGE = 1 << 16
PARTS = 200
SAMPLE = 64


def main(options: Sequence[str] | None = None) -> None:
    arguments = harness.parser(str(__doc__).splitlines()[0]).parse_args(options)
    counts = (500, 1_000) if arguments.quick else COUNTS
    cases: list[Callable[[], list[dict[str, Any]]]] = [
        functools.partial(relit, count, arguments.quick) for count in counts
    ]
    cases.append(functools.partial(fine_part, counts[-1], arguments.quick))
    for case in cases:
        for line in case() if arguments.quick else alone(case):
            harness.report(line, arguments.output)


def alone(case: Callable[[], list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Runs a case in a process of its own, whose memory is its own."""
    with concurrent.futures.ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(case).result()


def scene(count: int, quick: bool) -> Mesh:
    """A mesh of about so many vertices."""
    paths = [harness.data() / "meshes" / f"{name}.ply" for name in SCANS]
    if quick or not all(path.exists() for path in paths):
        rings = max(4, round((count / 2) ** 0.5))
        return builtin.sphere(rings=rings, sectors=2 * rings)
    scans = [load_mesh(path) for path in paths]
    beside = np.ptp(np.asarray(scans[0].position), axis=0) * [1, 0, 0]
    moved = make_mesh(np.asarray(scans[1].position) + 1.2 * beside, np.asarray(scans[1].face))
    mesh, times = join([scans[0], moved]), 0
    while count / 4**times > len(mesh.position):
        times += 1
    mesh = occluder.simplify(mesh, faces=2 * count // 4**times)
    for _ in range(times):
        edges = subdivision.Edges(mesh.position, mesh.face)
        mesh = subdivision.subdivide(mesh, [edges.divide(np.ones(len(edges.length), bool))])
    return mesh


def relit(count: int, quick: bool) -> list[dict[str, Any]]:
    """Precomputes a mesh, and meets new light by ranges of its vertices."""
    mesh = scene(count, quick)
    brdf = separable.factor(AshikhminShirley(), terms=TERMS, resolution=24)
    separable.precompute(builtin.plane(cells=1), brdf, keep=KEEP, size=SIZE, run=Run(progress=False))  # compiles
    vertices, before = len(mesh.position), harness.peak_memory()
    with tempfile.TemporaryDirectory() as folder:
        store, saved = pathlib.Path(folder) / "store", pathlib.Path(folder) / "saved"
        began = time.perf_counter()
        made = separable.precompute(mesh, brdf, keep=KEEP, size=SIZE, run=Run(store, progress=False))
        seconds, peak = time.perf_counter() - began, harness.peak_memory()
        sample = np.linspace(0, vertices - 1, SAMPLE).astype(int)
        some = separable.precompute(mesh, brdf, keep=KEEP, size=SIZE, vertex=sample, run=Run(progress=False))
        case = {"benchmark": "million", "vertices": vertices}
        line = {
            **case,
            "case": f"{count} vertices, precompute",
            "seconds": seconds,
            "compile_seconds": 0.0,
            "seconds_per_vertex": seconds / vertices,
            "error": _relative(made.value[:, sample], some.value),
            "bytes": made.nbytes,
            "peak_bytes": peak - before,
            "mesh_bytes": sum(each.nbytes for each in jax.tree.leaves(mesh)),
            "files": sum(1 for _ in store.iterdir()),
        }
        files.save(saved, made)
        del made
        return [line, {**case, **new_light(files.load(saved), count)}]


def new_light(transport: separable.SparseTransport, count: int) -> dict[str, Any]:
    """Meets light by ranges of vertices, beside reading the bytes."""
    light = jnp.asarray(np.random.default_rng(0).normal(size=(6 * SIZE**2, 3)), jnp.float32)
    vertices = len(transport.position)
    cuts = list(range(0, vertices, RANGE)) + [vertices]

    def met() -> list[np.ndarray]:
        return [np.asarray(ranges.take(transport, *each).apply(light)) for each in itertools.pairwise(cuts)]

    read = harness.reader([np.asarray(transport.index), np.asarray(transport.value)])
    mine, peer = harness.compare(met, read, repeats=5)
    return {
        "case": f"{count} vertices, light",
        **mine.line(),
        "seconds_per_vertex": mine.seconds / vertices,
        "error": _relative(np.concatenate(met()), transport.apply(light)),
        "bytes": transport.nbytes,
        "peer": "reading the bytes",
        "peer_seconds": peer.seconds,
        "peer_error": 0.0,
    }


def fine_part(count: int, quick: bool) -> list[dict[str, Any]]:
    """A part of the visibility at all texels."""
    mesh, size = scene(count, quick), SIZE if quick else FINE
    visibility.precompute(builtin.plane(cells=1), size=size, run=Run(progress=False))
    before, parts = harness.peak_memory(), 2 if quick else PARTS
    with tempfile.TemporaryDirectory() as folder, visibility.Shard(1, parts) as part:
        path, began = pathlib.Path(folder) / "store", time.perf_counter()
        with contextlib.suppress(visibility.UnfinishedError):
            visibility.precompute(mesh, size=size, run=Run(path, part, progress=False))
        seconds, done = time.perf_counter() - began, part.of(-(-len(mesh.position) // visibility.rays.BLOCK))
    return [
        {
            "benchmark": "million",
            "case": f"{count} vertices, part 1/{parts} of the visibility at 6 x {size} x {size}",
            "vertices": len(done) * visibility.rays.BLOCK,
            "seconds": seconds,
            "compile_seconds": 0.0,
            "error": 0.0,
            "bytes": len(done) * visibility.rays.BLOCK * 3 * size**2,
            "peak_bytes": harness.peak_memory() - before,
            "mesh_bytes": sum(each.nbytes for each in jax.tree.leaves(mesh)),
        }
    ]


def _relative(found: Any, expected: Any) -> float:
    return float(np.linalg.norm(np.asarray(found) - np.asarray(expected)) / np.linalg.norm(np.asarray(expected)))


if __name__ == "__main__":
    main()
