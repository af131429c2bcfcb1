"""What do clusters of transfer cost and lose, by degree and components? And irradiance and products of harmonics?

    python -m benchmarks.low_frequency [--quick] [--output FILE] [--degree 4 9 14] [--part 26] [--tools]

Clustered transfer of the bunny (a sphere without JAXPRT_DATA). `error` is the relative L2 difference of radiance to
uncompressed matrices of the same degree, at vertices that face the eye, in the worst of the lights; `matrix_error` is
that of all matrices under light of natural spectrum. `seconds` are of a new light, `view_seconds` of a new view.
Precomputation has its seconds and the peak of the process's memory beyond what it had before, which is right for the
first degree that a process is asked for. Where the uncompressed matrices take at most 2 GB they are the peer.

--part N measures errors and precomputation on the first N of the mesh's clusters, which lie together; times are those
of the whole mesh all the same, with random numbers, on which they do not depend.

--tools measures irradiance by harmonics against sums over texels, and products, instead.
"""

import dataclasses
import time
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import harness
from jaxprt import harmonic, scene
from jaxprt.brdf import AshikhminShirley
from jaxprt.scene import Environment, Mesh, builtin, load_environment, load_mesh
from jaxprt.scene.mesh import join
from jaxprt.sphere import cubemap, directions, harmonics, products
from jaxprt.systems.harmonic import TransferMatrix
from jaxprt.visibility import members

LIGHTS = {"grace": "grace_cross.hdr", "eucalyptus": "eucalyptus_rnl_cross.hdr", "sunrise": "polyhaven_sunrise_1k.exr"}
BRDF = AshikhminShirley(nu=48, nv=16)
MOST = 2e9  # bytes of uncompressed matrices that are measured


def main(options: Sequence[str] | None = None) -> None:
    parser = harness.parser(str(__doc__).splitlines()[0])
    parser.add_argument("--degree", type=int, nargs="+", default=[4, 9, 14], help="degrees of the harmonics")
    parser.add_argument("--part", type=int, help="measure errors on so many clusters of the mesh")
    parser.add_argument("--tools", action="store_true", help="irradiance and products instead")
    arguments = parser.parse_args(options)
    if arguments.tools or arguments.quick:
        for line in (*irradiances(arguments.quick), multiplication(arguments.quick)):
            harness.report(line, arguments.output)
    if not arguments.tools:
        for degree in [3] if arguments.quick else arguments.degree:
            for line in clusters(degree, arguments.quick, arguments.part):
                harness.report(line, arguments.output)


def lights(quick: bool) -> dict[str, Environment]:
    """Real ones, or the built-in sky."""
    folder = harness.data() / "env"
    if quick or not folder.exists():
        return {"daylight": builtin.daylight(size=16)}
    return {name: load_environment(folder / file) for name, file in LIGHTS.items()}


def shape(quick: bool) -> Mesh:
    """The bunny, or a sphere on the ground."""
    path = harness.data() / "meshes" / "stanford_bunny.ply"
    if not quick and path.exists():
        return load_mesh(path)
    floor = builtin.plane(cells=8)
    below = dataclasses.replace(floor, position=2 * floor.position - jnp.array([0.0, 1.01, 0.0]))
    return join([builtin.sphere(rings=12, sectors=24), below])


def clusters(degree: int, quick: bool, part: int | None = None) -> list[dict]:
    """Components of one degree against uncompressed matrices."""
    mesh = shape(quick)
    count, terms = len(mesh.position), (degree + 1) ** 2
    every = members.cluster(mesh.position, mesh.normal, clusters=members.clusters_for(count))
    chosen = np.unique(every[:part]) if part else np.arange(count)
    numbers = (4, 8) if quick else (4, 8, 16, 32)
    before, began = harness.peak_memory(), time.perf_counter()
    sizes: dict[str, Any] = {"degree": degree, "components": max(numbers), "clusters": part or len(every)}
    whole = harmonic.precompute_clustered(mesh, **sizes, vertex=chosen if part else None, progress=not quick)
    seconds, peak = time.perf_counter() - began, harness.peak_memory() - before
    table = harmonic.tabulate(BRDF, degree=degree, resolution=32 if quick else 128)
    eye = mesh.position.mean(0) + jnp.array([0.5, 0.7, 2.0]) * jnp.linalg.norm(jnp.ptp(mesh.position, 0))
    facing = np.flatnonzero(np.sum(np.asarray(mesh.normal * (eye - mesh.position)), 1)[chosen] > 0)
    vertex = np.random.default_rng(0).permutation(facing)[: 50 if quick else 400]
    exact = harmonic.precompute(mesh, degree=degree, vertex=chosen[vertex], progress=False)
    size = count * terms**2 * 4
    peer = random_matrices(mesh, terms) if size <= MOST else None
    lines = []
    for number in numbers:
        few = whole.truncate(components=number)
        sized = random_clusters(mesh, every, degree, number) if part else few
        system = harmonic.ClusteredSystem(few, table)
        error = {name: off(system, exact, vertex, light, eye) for name, light in lights(quick).items()}
        coefficient = harmonic.project(next(iter(lights(quick).values())), degree=degree)
        call = lambda f=sized, c=coefficient: harmonic.clustered_light(f, c)  # noqa: E731
        repeats = 3 if quick else 9
        more: dict[str, Any] = {}
        if peer is None:
            mine = harness.measure(call, repeats=repeats)
        else:
            other = lambda c=coefficient: harmonic.transferred_light(peer, c)  # noqa: E731
            mine, theirs = harness.compare(call, other, repeats=repeats)
            more = {"peer": "matrices", **theirs.peer(), "peer_error": 0.0}
        view, timed = jax.jit(lambda s, e: s.view(e)), harmonic.ClusteredSystem(sized, table)
        lines.append(
            {
                "benchmark": "low_frequency",
                "case": f"clusters, degree {degree}, {number} components, {count} vertices",
                **mine.line(),
                "error": max(error.values()),
                "bytes": sized.nbytes,
                **more,
                "bytes_per_vertex": sized.nbytes / count,
                "uncompressed_bytes": size,
                "errors": error,
                "matrix_error": few.error,
                "view_seconds": harness.measure(lambda s=timed, v=view: v(s, eye), repeats=repeats).seconds,
                "clusters": len(sized.mean),
                "measured_vertices": len(chosen),
                "precompute_seconds": seconds,
                "precompute_bytes": peak,
            }
        )
    return lines


def off(system, exact: TransferMatrix, vertex: np.ndarray, light: Environment, eye) -> float:
    """Relative difference of radiance to uncompressed matrices."""
    color = system.combine(system.light(light), system.view(eye))[vertex]
    truth = harmonic.HarmonicSystem(exact, system.brdf)
    true = truth.combine(truth.light(light), truth.view(eye))
    return float(jnp.linalg.norm(color - true) / jnp.linalg.norm(true))


def random_matrices(mesh: Mesh, terms: int) -> TransferMatrix:
    """Uncompressed transfer of random numbers, on which times do not depend."""
    matrix = np.random.default_rng(1).random((len(mesh.position), 1, terms, terms), np.float32)
    return TransferMatrix(jax.device_put(matrix), mesh.position, jnp.broadcast_to(jnp.eye(3), (len(matrix), 3, 3)))


def random_clusters(mesh: Mesh, member: np.ndarray, degree: int, components: int) -> harmonic.ClusteredTransfer:
    """Clustered transfer of random numbers."""
    random, terms = np.random.default_rng(1), (2 * degree + 1) ** 2
    shapes = (len(member), terms), (len(member), components, terms), (*member.shape, components)
    mean, component, weight = (jnp.asarray(random.random(each, np.float32)) for each in shapes)
    frame = directions.frame(mesh.normal, mesh.tangent)
    ones = jnp.ones(len(member))
    place = jnp.asarray(members.places(member))
    return harmonic.ClusteredTransfer(mean, component, weight, mesh.position, frame, place, ones, ones)


def irradiances(quick: bool) -> list[dict]:
    """Irradiance by harmonics, environment given, at some thousand normals, against the sum over texels."""
    normal = np.random.default_rng(2).normal(size=(100 if quick else 2000, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    lines = []
    for name, light in lights(quick).items():
        size = light.radiance.shape[1]
        way = np.asarray(cubemap.direction(size=size), np.float64).reshape(-1, 3)
        flux = np.asarray(cubemap.solid_angle(size=size), np.float64).reshape(-1, 1) * np.asarray(
            light.radiance, np.float64
        ).reshape(-1, light.radiance.shape[-1])
        true = np.maximum(normal @ way.T, 0) @ flux
        for degree in (2,) if quick else (2, 4, 8, 16):
            call = lambda e=light, d=degree: scene.irradiance(e, normal, degree=d)  # noqa: E731
            lines.append(
                {
                    "benchmark": "low_frequency",
                    "case": f"irradiance, degree {degree}, {name}, {len(normal)} normals",
                    **harness.measure(call, repeats=5).line(),
                    "error": float(np.linalg.norm(np.asarray(call()) - true) / np.linalg.norm(true)),
                    "bytes": 4 * 3 * (degree + 1) ** 2,
                }
            )
    return lines


def multiplication(quick: bool, degree: int = 4) -> dict:
    """Products of many pairs of functions against the sums over integrals of three basis functions."""
    pairs, terms = (100 if quick else 100_000), (degree + 1) ** 2
    random = np.random.default_rng(3)
    first, second = (jnp.asarray(random.normal(size=(terms, pairs)), jnp.float32) for _ in range(2))
    node, weight = products.quadrature(3 * degree)
    basis = harmonics.basis(np, node, degree)
    gamma = np.einsum("iq,jq,kq,q->ijk", basis, basis, basis, weight)
    nonzero = np.argwhere(np.abs(gamma) > 1e-12)
    order = nonzero[np.argsort(nonzero[:, 2], kind="stable")]
    value = jnp.asarray(gamma[tuple(order.T)], jnp.float32)
    own = jax.jit(lambda a, b: products.product(a, b, degree=degree))
    sparse = jax.jit(
        lambda a, b: jax.ops.segment_sum(
            value[:, None] * a[order[:, 0]] * b[order[:, 1]], order[:, 2], terms, indices_are_sorted=True
        )
    )
    mine, theirs = harness.compare(lambda: own(first, second), lambda: sparse(first, second), repeats=3)
    wide = (np.asarray(each, np.float64) for each in (first, second))
    true = np.einsum("kq,qv->kv", basis * weight, np.prod([basis.T @ each for each in wide], 0))

    def error(made) -> float:
        return float(np.linalg.norm(np.asarray(made) - true) / np.linalg.norm(true))

    return {
        "benchmark": "low_frequency",
        "case": f"product, degree {degree}, {pairs} pairs, {len(order)} integrals that are not 0",
        **mine.line(),
        "error": error(own(first, second)),
        "bytes": 3 * first.nbytes,
        "peer": "sparse sums",
        **theirs.peer(),
        "peer_error": error(sparse(first, second)),
    }


if __name__ == "__main__":
    main()
