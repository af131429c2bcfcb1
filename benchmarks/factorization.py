"""What do the leading eigenvectors of a BRDF's matrix cost, against all of them by LAPACK and some by ARPACK?

    python -m benchmarks.factorization [--quick] [--output FILE] [--figure]

The matrix is that of Ashikhmin-Shirley's BRDF (0.5, 0.75, 10, 100) at the texels of the 48 x 48 disk, 1,804 of them.
Errors are by how much the Frobenius error of the approximation of that rank exceeds the optimum's, relative to it.
NumPy is given the matrix in float64, in which the optimum is computed; in float32 its `eigh` takes as long.

`--figure` prints instead the errors that figure 4 of Wang et al. plots, for five BRDFs: `sample_error`,
relative, of 1 to 16 terms on maps of 16 to 64 texels along an edge. It needs JAXPRT_DATA for clay and skin.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse.linalg

from benchmarks import harness
from benchmarks.published import maps
from benchmarks.published.factorization import brown_plastic, factor_symmetric, red_plastic, sample_error
from jaxprt import separable
from jaxprt.brdf import AshikhminShirley, load_lafortune
from jaxprt.decompose import eigen

TERMS = (4, 8, 16, 32, 64)
QUICK = (8,)
RESOLUTIONS = (16, 24, 32, 48, 64)
FIGURE_TERMS = (1, 2, 3, 4, 6, 8, 12, 16)


def main(options: Sequence[str] | None = None) -> None:
    parser = harness.parser(str(__doc__).splitlines()[0])
    parser.add_argument("--figure", action="store_true", help="print the table of figure 4 and measure nothing")
    arguments = parser.parse_args(options)
    if arguments.figure:
        figure()
        return
    matrix = brdf_matrix(24 if arguments.quick else 48)
    exact = np.asarray(matrix, np.float64)
    value = np.linalg.eigvalsh(exact)
    for terms in QUICK if arguments.quick else TERMS:
        for line in measure(matrix, exact, np.sort(value**2)[::-1], terms, 3 if arguments.quick else 7):
            harness.report(line, arguments.output)


def brdf_matrix(resolution: int) -> jax.Array:
    """The published BRDF at all pairs of texels inside the disk."""
    direction = maps.texel_direction(resolution=resolution).reshape(-1, 3)
    inside = np.flatnonzero(maps.texel_area(resolution=resolution).ravel())
    return separable.factorization.tabulate(AshikhminShirley(), direction[inside])[0]


def measure(matrix: jax.Array, exact: np.ndarray, square: np.ndarray, terms: int, repeats: int) -> list[dict]:
    """The lines of one number of terms: the block iteration against each peer, and the printed iteration's."""

    def block():
        return eigen.symmetric(matrix, terms=terms)

    optimum = np.sqrt(np.sum(square[terms:]))

    def excess(value, vector) -> float:
        value, vector = np.asarray(value, np.float64), np.asarray(vector, np.float64)
        return float(np.linalg.norm(exact - (vector * value) @ vector.T) / optimum - 1)

    size = len(exact)
    single = np.asarray(matrix)
    peers = {
        "numpy eigh, float64": lambda: np.linalg.eigh(exact),
        "jax eigh, float32": lambda: jnp.linalg.eigh(matrix),
        "scipy eigsh, float32": lambda: scipy.sparse.linalg.eigsh(single, terms, which="LM"),
        "power iteration as printed, 100 sweeps": lambda: eigen.power(matrix, terms=terms)[:2],
    }
    value, vector, residual = block()
    common = {
        "benchmark": "factorization",
        "case": f"{terms} eigenvectors of {size}",
        "error": excess(value, vector),
        "bytes": value.nbytes + vector.nbytes,
        "residual": float(residual[-1]),
        "optimum": float(optimum / np.linalg.norm(exact)),
    }
    lines = []
    for name, peer in peers.items():
        mine, theirs = harness.compare(block, peer, repeats=repeats)
        values, vectors = (np.asarray(array) for array in peer())
        kept = np.argsort(-np.abs(values))[:terms]
        peer_line = {
            "peer": name,
            **theirs.peer(),
            "peer_error": excess(values[kept], vectors[:, kept]),
        }
        lines.append({**common, **mine.line(), **peer_line})
    return lines


def figure() -> None:
    """Prints the errors of figure 4."""
    path = harness.data() / "brdf/lafortune_measured.json"
    brdfs = {
        "Ashikhmin-Shirley (10, 100)": AshikhminShirley(),
        "red plastic": red_plastic(),
        "light brown plastic": brown_plastic(),
        "Lafortune, clay": load_lafortune(path, "clay"),
        "Lafortune, skin": load_lafortune(path, "skin"),
    }
    for name, brdf in brdfs.items():
        print(f"{name}: terms down, texels along an edge across")
        print("     " + "".join(f"{resolution:>8}" for resolution in RESOLUTIONS))
        factored = [
            factor_symmetric(brdf, terms=max(FIGURE_TERMS), resolution=resolution) for resolution in RESOLUTIONS
        ]
        for terms in FIGURE_TERMS:
            errors = [float(sample_error(brdf, each.truncate(terms))[1]) for each in factored]
            print(f"{terms:>5}" + "".join(f"{error:8.3f}" for error in errors), flush=True)


if __name__ == "__main__":
    main()
