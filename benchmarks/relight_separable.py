"""Is relighting a sparse transport faster than a sparse-matrix library, and how near to reading its arrays once?

    python -m benchmarks.relight_separable [--quick] [--output FILE]

Kept coefficients lie anywhere among all 24,576, which is harder on caches than real transport. The light change is
`SparseTransport.apply` on the light's coefficients and is measured against scipy's CSR product on the same numbers and
against reading the arrays once on two threads; the view change against the light change; both at growing mesh sizes.
Transport in whole numbers, gray and in color, is measured against the same transport in floating point.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse

from benchmarks import harness
from benchmarks.published.quantized import quantize
from jaxprt import separable
from jaxprt.brdf import AshikhminShirley
from jaxprt.sphere import directions
from jaxprt.systems.separable import SeparableSystem, SparseTransport

SIZE = 64
TERMS = 4
KEEP = 96
MOST_IN_COLOR = 36_000  # 200 MB in floating point.


def main(options: Sequence[str] | None = None) -> None:
    arguments = harness.parser(str(__doc__).splitlines()[0]).parse_args(options)
    repeats = 5 if arguments.quick else 31
    brdf = separable.factor(AshikhminShirley(), terms=TERMS)
    # The smaller sizes fit the cache more or less; the question is whether the larger ones pay for it.
    sizes = [2_000] if arguments.quick else [10_000, 36_000, 100_000, 300_000]
    for vertices in sizes:
        transport = synthetic(vertices)
        light = jax.random.normal(jax.random.key(1), (6 * SIZE * SIZE, 3))
        fewer = repeats if vertices < 100_000 else max(5, repeats // 3)
        lines = measure(transport, brdf, light, fewer)
        lines.append(measure_quantized(transport, light, fewer))
        if vertices <= MOST_IN_COLOR:
            lines.append(measure_quantized(synthetic(vertices, colors=3), light, fewer))
        for line in lines:
            harness.report(line, arguments.output)


def synthetic(vertices: int, *, colors: int = 1) -> SparseTransport:
    """Transport with random coefficients, on the vertices of a sphere."""
    rng = np.random.default_rng(0)
    shape = (KEEP, vertices, TERMS)
    index = rng.integers(0, 6 * SIZE * SIZE, shape, dtype=np.uint16)
    value = rng.standard_normal((*shape, colors), dtype=np.float32)
    normal = directions.normalize(jnp.asarray(rng.standard_normal((vertices, 3), dtype=np.float32)))
    frame = directions.frame(normal, directions.tangent(normal))
    return SparseTransport(jnp.asarray(index), jnp.asarray(value), normal, frame, jnp.ones(6 * SIZE * SIZE))


def measure(transport: SparseTransport, brdf, light: jax.Array, repeats: int) -> list[dict]:
    """The lines of one mesh size."""
    vertices = transport.index.shape[1]
    matrix = as_csr(transport)
    dense_light = np.asarray(light)
    exact = (matrix.astype(np.float64) @ dense_light.astype(np.float64)).reshape(vertices, TERMS, 3)
    mine = transport.apply(light)
    common = {
        "benchmark": "relight_separable",
        "error": float(np.linalg.norm(mine - exact) / np.linalg.norm(exact)),
        "bytes": transport.nbytes,
        "vertices": vertices,
    }
    lines = []
    peers = {
        "scipy-csr": lambda: matrix @ dense_light,
        "memory-read": harness.reader([np.asarray(x) for x in (transport.index, transport.value)]),
    }
    for name, peer in peers.items():
        first, second = harness.compare(lambda: transport.apply(light), peer, repeats=repeats)
        wrong = (
            0.0 if name == "memory-read" else float(np.linalg.norm((matrix @ dense_light).reshape(exact.shape) - exact))
        )
        case = {"case": f"light change, {vertices} vertices", "nanoseconds_per_vertex": first.seconds / vertices * 1e9}
        peer_line = {"peer": name, **second.peer(), "peer_error": wrong / float(np.linalg.norm(exact))}
        lines.append({**common, **case, **first.line(), **peer_line})
    eye = jnp.array([3.0, 1.0, 2.0])
    system = SeparableSystem(transport, brdf)
    view, change = harness.compare(
        lambda: system.combine(mine, system.view(eye)), lambda: transport.apply(light), repeats=repeats
    )
    case = {"case": f"view change, {vertices} vertices", "nanoseconds_per_vertex": view.seconds / vertices * 1e9}
    lines.append({**common, **case, **view.line(), "peer": "light change", **change.peer(), "peer_error": 0.0})
    return lines


def measure_quantized(transport: SparseTransport, light: jax.Array, repeats: int) -> dict:
    """The line of one transport in whole numbers."""
    _, vertices, _, colors = transport.value.shape
    quantized = quantize(transport)
    mine, theirs = harness.compare(lambda: quantized.apply(light), lambda: transport.apply(light), repeats=repeats)
    exact = transport.apply(light)
    return {
        "benchmark": "relight_separable",
        "case": f"light change, {vertices} vertices, quantized {'gray' if colors == 1 else 'color'}",
        **mine.line(),
        "nanoseconds_per_vertex": mine.seconds / vertices * 1e9,
        "error": float(jnp.linalg.norm(quantized.apply(light) - exact) / jnp.linalg.norm(exact)),
        "bytes": quantized.nbytes,
        "vertices": vertices,
        "peer": "floating point",
        **theirs.peer(),
        "peer_error": 0.0,
        "peer_bytes": transport.nbytes,
    }


def as_csr(transport: SparseTransport) -> scipy.sparse.csr_matrix:
    """The same numbers as a matrix with one row for each vertex and term."""
    index = np.moveaxis(np.asarray(transport.index), 0, -1).reshape(-1, KEEP)
    value = np.moveaxis(np.asarray(transport.value)[..., 0], 0, -1).reshape(-1, KEEP)
    start = np.arange(0, index.size + 1, KEEP)
    return scipy.sparse.csr_matrix(
        (value.ravel(), index.ravel().astype(np.int32), start), (len(index), 6 * SIZE * SIZE)
    )


if __name__ == "__main__":
    main()
