"""What do Tucker decompositions of tables of BRDFs cost, against TensorLy's, and how much memory?

    python -m benchmarks.tucker [--quick] [--output FILE]

The table is [material, view, light]: Cook-Torrance's BRDF without its diffuse part, for the 86 roughnesses and
reflectances that Ngan et al. fitted (from JAXPRT_DATA; random ones where that is not set, and with --quick), at the
texels of the 32 x 32 disk, times the square roots of both texels' areas, which are zero outside the disk. Materials are
scaled to the same norm, or the smoothest would be all that counts. Errors are relative, summed in float64.

TensorLy does as many sweeps, from its default start, LAPACK's SVD of each whole unfolding, or from a randomized SVD.
OpenBLAS, which both sides use, JAX for QR, has its threads wait by spinning: beside other work on the same cores, set
OPENBLAS_NUM_THREADS=1, or both take several times as long.

The larger table, of Blinn-Phong's BRDF, has no peer; each of its lines is measured in a process of its own, of which
`peak_bytes` is the most memory that it held, Python and JAX included, and `built_bytes` that before the decomposition.
"""

import importlib
import importlib.util
import multiprocessing
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import harness
from benchmarks.published import maps
from benchmarks.published.tensors import hooi
from jaxprt.brdf import BlinnPhong, CookTorrance
from jaxprt.decompose import tucker
from jaxprt.decompose.tucker import Tucker

RANKS = (4, 8, 8)
SWEEPS = 2
METHODS: dict[str, Callable[[jax.Array], Tucker]] = {
    "truncated": lambda tensor: tucker.truncated(tensor, ranks=RANKS),
    "hosvd": lambda tensor: tucker.hosvd(tensor, ranks=RANKS),
    "hooi": lambda tensor: hooi(tensor, ranks=RANKS, sweeps=SWEEPS)[0],
}
STARTS = ("truncated_svd", "randomized_svd")  # TensorLy's names, its default first
EXPONENTS = 200
RESOLUTION = 48  # of the larger table, which has the 1,804 texels inside the disk


def main(options: Sequence[str] | None = None) -> None:
    arguments = harness.parser(str(__doc__).splitlines()[0]).parse_args(options)
    for line in measure(arguments.quick):
        harness.report(line, arguments.output)


def measure(quick: bool) -> Iterator[dict]:
    """All lines, the larger table's first: a process starts with the peak of the one that starts it."""
    for name in () if quick else ("truncated", "hooi"):
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            yield pool.submit(alone, name).result()
    peer = importlib.util.find_spec("tensorly") is not None
    if not peer:
        print("TensorLy is not installed (the extra `bench` has it): the peer is skipped", file=sys.stderr)
    tensor = jax.block_until_ready(cook_torrance(quick))
    for name in METHODS:
        sweeps = SWEEPS if name == "hooi" else 0
        if not peer:
            timing = harness.measure(lambda name=name: METHODS[name](tensor), repeats=3)
            yield described(name, tensor) | timing.line()
            continue
        # What LAPACK does before the sweeps takes minutes, and is the same for all methods.
        for start in STARTS if quick or sweeps else STARTS[1:]:
            yield against(name, tensor, start, sweeps, 1 if start == STARTS[0] and not quick else 3)


def against(name: str, tensor: jax.Array, start: str, sweeps: int, repeats: int) -> dict:
    """The line of one method against TensorLy's."""
    array, found = np.asarray(tensor), []
    peer = tensorly(array, sweeps, start)
    mine, theirs = harness.compare(lambda: METHODS[name](tensor), lambda: found.append(peer()), repeats=repeats)
    return described(name, tensor) | {
        **mine.line(),
        "peer": f"TensorLy, {start}, {sweeps} sweeps",
        **theirs.peer(),
        "peer_error": relative_error(array, *found[-1]),
    }


def alone(name: str) -> dict:
    """The line of one method on the larger table; for a process of its own."""
    direction = maps.texel_direction(resolution=RESOLUTION).reshape(-1, 3)
    direction = direction[np.flatnonzero(maps.texel_area(resolution=RESOLUTION).ravel())]
    brdf = jax.vmap(lambda n: BlinnPhong(diffuse=0.0, specular=1.0, exponent=n))(1.0 + jnp.arange(EXPONENTS))
    tensor = jax.block_until_ready(tabulate(brdf, direction, jnp.ones(len(direction))))
    built = harness.peak_memory()
    timing = harness.measure(lambda: METHODS[name](tensor), repeats=3)
    memory = {"tensor_bytes": tensor.nbytes, "built_bytes": built, "peak_bytes": harness.peak_memory()}
    return described(name, tensor) | timing.line() | memory


def cook_torrance(quick: bool) -> jax.Array:
    """The table of many fitted materials, or of a few random ones."""
    path = harness.data() / "brdf/ngan2005_cooktorrance.csv"
    if path.exists() and not quick:
        roughness, f0 = np.loadtxt(path, np.float32, delimiter=",", skiprows=1, usecols=(7, 8), unpack=True)
    else:
        random = np.random.default_rng(0).uniform(size=(2, 10 if quick else 86)).astype(np.float32)
        roughness, f0 = 0.01 * 50 ** random[0], random[1]
    resolution = 8 if quick else 32
    direction = maps.texel_direction(resolution=resolution).reshape(-1, 3)
    weight = jnp.sqrt(maps.texel_area(resolution=resolution).ravel())
    brdf = jax.vmap(lambda m, f: CookTorrance(diffuse=0.0, specular=1.0, roughness=m, f0=f))(roughness, f0)
    return tabulate(brdf, direction, weight)


@jax.jit
def tabulate(brdf, direction: jax.Array, weight: jax.Array) -> jax.Array:
    """A stack of gray BRDFs at all pairs of directions, times the weights of both, each scaled to norm one."""

    def material(each):
        def row(wo):
            return each(direction, jnp.broadcast_to(wo, direction.shape))[:, 0]

        table = jax.lax.map(row, direction, batch_size=64) * weight * weight[:, None]
        return table / jnp.linalg.norm(table)

    return jax.lax.map(material, brdf)


def tensorly(array: np.ndarray, sweeps: int, start: str) -> Callable[[], tuple[np.ndarray, list[np.ndarray]]]:
    """The same by TensorLy: core and factors. A tolerance of zero never stops early."""
    importlib.import_module("tensorly").set_backend("numpy")
    decompose = importlib.import_module("tensorly.decomposition").tucker
    return lambda: tuple(decompose(array, RANKS, n_iter_max=sweeps, tol=0, svd=start, random_state=0))


def described(name: str, tensor: jax.Array) -> dict:
    """What lines of a method have in common."""
    found = METHODS[name](tensor)
    return {
        "benchmark": "tucker",
        "case": f"{name}, {' x '.join(map(str, tensor.shape))} to {' x '.join(map(str, RANKS))}",
        "error": relative_error(np.asarray(tensor), found.core, found.factor),
        "bytes": found.nbytes,
    }


def relative_error(tensor: np.ndarray, core, factor) -> float:
    """Of the reconstruction, one slice of the first mode after another."""
    core, first, second, third = (np.asarray(each, np.float64) for each in (core, *factor))
    left, whole = 0.0, 0.0
    for exact, small in zip(tensor, np.tensordot(first, core, 1), strict=True):
        left += np.sum((exact - second @ small @ third.T) ** 2)
        whole += np.sum(exact.astype(np.float64) ** 2)
    return float(np.sqrt(left / whole))


if __name__ == "__main__":
    main()
