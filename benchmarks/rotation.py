"""What does it cost to rotate SH coefficients by thousands of rotations, and with the gradient by the rotations?

    python -m benchmarks.rotation [--quick] [--output FILE]

Three channels of coefficients for every rotation, each library on its own layout: coefficients first here, one
chunk [w, 3 (2l + 1)] for each band in e3nn-jax. Of its routes that is the fastest, if by little: for 10,000 rotations
of 3 x 25, ``transform_by_matrix`` of chunks under ``vmap``, jitted, took 56 ms where matrices by ``D_from_matrix``
took 58 ms and one array for all bands 62 ms.
Above l = 11 it has no constants and takes matrix exponentials, which gave no result for 100 rotations within four
minutes; so of 225 coefficients it is given the first 144, while all 225 are rotated here.

Errors are against float64 here, of the same numbers in float32; a test compares that with e3nn-jax in float64.
The gradient is that of a random linear function of the result, by the rotations, together with the result itself,
and is timed against the result alone.
"""

import importlib.util
import sys
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks import harness
from jaxprt.sphere import rotation

CASES = ((4, 10_000), (4, 50_000), (14, 10_000))  # Degree, rotations.
QUICK = ((4, 2_000),)
PEER_DEGREE = 11


def main(options: Sequence[str] | None = None) -> None:
    arguments = harness.parser(str(__doc__).splitlines()[0]).parse_args(options)
    peer = importlib.util.find_spec("e3nn_jax") is not None
    if not peer:
        print("e3nn-jax is not installed (the extra `bench` has it): the peer is skipped", file=sys.stderr)
    repeats = 5 if arguments.quick else 21
    for degree, count in QUICK if arguments.quick else CASES:
        array = numbers(degree, count)
        exact = in_float64(with_gradient, *array)
        harness.report(rotating(*array[:2], exact[0], repeats, peer), arguments.output)
        harness.report(differentiating(*array, exact[1], repeats), arguments.output)


def numbers(degree: int, count: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Coefficients of three channels, rotations, and weights of the result."""
    random = np.random.default_rng(0)
    coefficient, weight = random.normal(size=(2, (degree + 1) ** 2, 3, count))
    matrix = Rotation.random(count, random).as_matrix()
    return jnp.asarray(coefficient, jnp.float32), jnp.asarray(matrix, jnp.float32), jnp.asarray(weight, jnp.float32)


@jax.jit
def with_gradient(coefficient: jax.Array, matrix: jax.Array, weight: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The rotated coefficients, and the gradient of their weighted sum by the rotations."""
    result, pull = jax.vjp(lambda r: rotation.rotate_each(coefficient, r), matrix)
    return result, pull(weight)[0]


def rotating(coefficient: jax.Array, matrix: jax.Array, exact: np.ndarray, repeats: int, peer: bool) -> dict:
    """Rotation alone, against e3nn-jax."""

    def call():
        return rotation.rotate_each(coefficient, matrix)

    theirs = e3nn_rotation(coefficient, matrix) if peer else call
    mine, other = harness.compare(call, theirs, repeats=repeats)
    line = {
        "benchmark": "rotation",
        "case": f"{matrix.shape[0]} rotations of 3 x {coefficient.shape[0]} coefficients",
        **mine.line(),
        "error": relative(call(), exact),
        "bytes": coefficient.nbytes + matrix.nbytes,
    }
    if not peer:
        return line
    found = np.concatenate([np.asarray(chunk) for chunk in theirs()], -1)  # [w, c, lm]
    return line | {
        "peer": "e3nn-jax",
        **other.peer(),
        "peer_error": relative(found.transpose(2, 1, 0), exact[: found.shape[-1]]),
        "peer_coefficients": found.shape[-1],
    }


def differentiating(
    coefficient: jax.Array, matrix: jax.Array, weight: jax.Array, exact: np.ndarray, repeats: int
) -> dict:
    """Rotation and its gradient, against rotation alone."""
    mine, forward = harness.compare(
        lambda: with_gradient(coefficient, matrix, weight),
        lambda: rotation.rotate_each(coefficient, matrix),
        repeats=repeats,
    )
    return {
        "benchmark": "rotation",
        "case": f"with gradient, {matrix.shape[0]} rotations of 3 x {coefficient.shape[0]} coefficients",
        **mine.line(),
        "error": relative(with_gradient(coefficient, matrix, weight)[1], exact),
        "bytes": coefficient.nbytes + matrix.nbytes + weight.nbytes,
        "peer": "forward",
        **forward.peer(),
        "peer_error": 0.0,
        "times_forward": mine.seconds / forward.seconds,
    }


def e3nn_rotation(coefficient: jax.Array, matrix: jax.Array) -> Callable[[], list[jax.Array]]:
    """The same by e3nn-jax, whose axes are ours in the order y, z, x."""
    import e3nn_jax as e3nn

    axis = np.array([1, 2, 0])
    permuted = matrix[:, axis[:, None], axis]
    degree = min(round(coefficient.shape[0] ** 0.5) - 1, PEER_DEGREE)
    irreps = e3nn.Irreps([(3, (l, 1)) for l in range(degree + 1)])
    chunks = [jnp.array(coefficient[l * l : (l + 1) ** 2].transpose(2, 1, 0)) for l in range(degree + 1)]

    def one(chunks, matrix):
        return e3nn.from_chunks(irreps, chunks, ()).transform_by_matrix(matrix).chunks

    every = jax.jit(jax.vmap(one))
    return lambda: every(chunks, permuted)


def in_float64(function: Callable, *array: jax.Array):
    """The function of the same numbers in double precision."""
    with jax.enable_x64(True):
        wide = [jnp.asarray(np.asarray(each), jnp.float64) for each in array]
        return jax.tree.map(np.asarray, function(*wide))


def relative(found, exact) -> float:
    """Error in the norm."""
    return float(np.linalg.norm(np.asarray(found, np.float64) - exact) / np.linalg.norm(exact))


if __name__ == "__main__":
    main()
