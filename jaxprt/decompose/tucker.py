"""Tucker decomposition: a tensor as a small core, multiplied along each mode by a matrix with orthonormal columns.

    X ~ G x_1 U_1 x_2 U_2 ... x_d U_d

The columns are eigenvectors of each mode's n by n Gram matrix, not singular vectors of the unfolding, whose other
dimension is the product of all other modes. Gram matrices are summed over slices, so that the tensor is neither
transposed nor copied. Forming them squares the condition number: in float32, singular values below 3e-4 (the square
root of the precision) of the largest are lost to rounding. Smaller errors require float64.
"""

import math
from collections.abc import Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt.compile import jit
from jaxprt.decompose import eigen

_BLOCK = 4096  # columns per product


class Tucker(eqx.Module):
    """A tensor as a core and, for each mode, a matrix with orthonormal columns.

    Attributes:
        core: The core tensor. The size of each mode is its rank.
        factor: A matrix for each mode, of the mode's size by its rank.
    """

    core: Float[Array, "*r"]
    factor: tuple[Float[Array, "_ _"], ...]

    @property
    def ranks(self) -> tuple[int, ...]:
        """Rank of each mode."""
        return self.core.shape

    @property
    def nbytes(self) -> int:
        """Size of the core and all factors in bytes."""
        return self.core.nbytes + sum(matrix.nbytes for matrix in self.factor)

    def full(self) -> Float[Array, "*n"]:
        """The tensor that this decomposition represents."""
        result = self.core
        # The last mode comes first: its product is the cheapest while the other modes are small.
        for mode in range(self.core.ndim)[::-1]:
            result = multiply(result, self.factor[mode].T, mode=mode)
        return result


@partial(jit, static_argnames=("mode",))
def multiply(tensor: Float[Array, "*n"], matrix: Float[Array, "m r"], *, mode: int) -> Float[Array, "*k"]:
    """Mode product: the sum over one mode of the tensor times each column of the matrix.

    Reference: Kolda and Bader 2009, section 2.5, with the matrix transposed.
    """
    slices = _slices(tensor, mode)
    shape = (*tensor.shape[:mode], matrix.shape[1], *tensor.shape[mode + 1 :])
    if slices.shape[2] == 1:
        return (slices[..., 0] @ matrix).reshape(shape)
    if slices.shape[0] == 1:
        return (matrix.T @ slices[0]).reshape(shape)
    return jax.lax.map(lambda block: matrix.T @ block, slices).reshape(shape)


@partial(jit, static_argnames=("mode",))
def gram(tensor: Float[Array, "*n"], *, mode: int) -> Float[Array, "m m"]:
    """Gram matrix of a mode: the unfolding along it times its transpose."""
    slices = _slices(tensor, mode)
    if slices.shape[2] == 1:
        return slices[..., 0].T @ slices[..., 0]
    if slices.shape[0] == 1:
        return _square(slices[0])
    size = slices.shape[1]
    return jax.lax.scan(
        lambda sum, block: (sum + block @ block.T, None), jnp.zeros((size, size), tensor.dtype), slices
    )[0]


@partial(jit, static_argnames=("ranks",))
def hosvd(tensor: Float[Array, "*n"], *, ranks: tuple[int, ...]) -> Tucker:
    """Truncated higher-order singular value decomposition.

    Args:
        tensor: A tensor with at least two modes.
        ranks: Rank of each mode.

    Returns:
        The decomposition. Its squared error is at most the sum over modes of the squared singular values that are left
        out, so its error is at most sqrt(d) times that of the best approximation. The reconstruction is differentiable
        in the tensor. Derivatives of a single factor hold only up to rotations among its columns, so functions of it
        must not depend on such rotations. Where singular values on both sides of the truncation are equal, the subspace
        has no derivative and the result is zero.
    Reference: De Lathauwer, De Moor, Vandewalle 2000.
    """
    _check(tensor, ranks)
    factor = tuple(dominant(gram(tensor, mode=mode), rank) for mode, rank in enumerate(ranks))
    return Tucker(_core(tensor, factor), factor)


@partial(jit, static_argnames=("ranks",))
def truncated(tensor: Float[Array, "*n"], *, ranks: tuple[int, ...]) -> Tucker:
    """Sequentially truncated HOSVD: truncates the modes one after another, the smallest first.

    The error has the same bound as that of `hosvd`. Most of the cost is that of the first mode.

    Args:
        tensor: A tensor with at least two modes.
        ranks: Rank of each mode.

    Returns:
        The decomposition, differentiable in the same sense as that of `hosvd`.
    Reference: Vannieuwenhoven, Vandebril, Meerbergen 2012.
    """
    _check(tensor, ranks)
    factor, core = [jnp.zeros(0)] * tensor.ndim, tensor
    for mode in sorted(range(tensor.ndim), key=lambda mode: tensor.shape[mode]):
        factor[mode] = dominant(gram(core, mode=mode), ranks[mode])
        core = multiply(core, factor[mode], mode=mode)
    return Tucker(core, tuple(factor))


@jax.custom_jvp
def _square(matrix: Array) -> Array:
    """A wide matrix times its transpose, in blocks of columns: a single product would copy much of the matrix."""
    count = matrix.shape[1] // _BLOCK
    rest = matrix[:, count * _BLOCK :]

    def add(total, start):
        columns = jax.lax.dynamic_slice_in_dim(matrix, start, _BLOCK, 1)
        return total + columns @ columns.T, None

    return jax.lax.scan(add, rest @ rest.T, _BLOCK * jnp.arange(count))[0] if count else rest @ rest.T


@_square.defjvp
@jit
def _square_jvp(primal, tangent):
    # The transpose of the scan would add a whole matrix at each step.
    product = tangent[0] @ primal[0].T
    return _square(*primal), product + product.T


def _slices(tensor: Array, mode: int) -> Array:
    """The tensor reshaped to three axes: all modes before the given one, that mode, and all modes after it."""
    shape = tensor.shape
    return tensor.reshape(math.prod(shape[:mode]), shape[mode], math.prod(shape[mode + 1 :]))


def _core(tensor: Array, factor: Sequence[Array]) -> Array:
    """The tensor times all factors. Factors that shrink the tensor most come first."""
    for mode in sorted(range(len(factor)), key=lambda mode: factor[mode].shape[1] / factor[mode].shape[0]):
        tensor = multiply(tensor, factor[mode], mode=mode)
    return tensor


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def dominant(matrix: Float[Array, "m m"], rank: int) -> Float[Array, "m r"]:
    """Leading eigenvectors of a positive semidefinite matrix, as columns.

    Derivatives leave out rotations within the subspace that the vectors span.
    """
    return eigen.symmetric(matrix, terms=rank)[1]


@dominant.defjvp
@partial(jit, static_argnums=0)
def _dominant_jvp(rank, primal, tangent):
    (matrix,), (moved,) = primal, tangent
    vector = dominant(matrix, rank)
    value, basis = jnp.linalg.eigh(matrix)
    # Rotations within the subspace are left out. The change of the subspace is a sum over the other eigenvectors.
    other, low = basis[:, : len(value) - rank], value[: len(value) - rank]
    gap = jnp.einsum("ir,ij,jr->r", vector, matrix, vector) - low[:, None]
    least = len(value) * jnp.finfo(matrix.dtype).eps * jnp.abs(value[-1])
    open_gap = gap > least
    turned = jnp.where(open_gap, (other.T @ moved @ vector) / jnp.where(open_gap, gap, 1), 0)
    return vector, other @ turned


def _check(tensor: Array, ranks: tuple[int, ...]) -> None:
    if len(ranks) != tensor.ndim or any(not 1 <= r <= n for r, n in zip(ranks, tensor.shape, strict=False)):
        raise ValueError(f"ranks must be one for each mode, from 1 to its size in {list(tensor.shape)}, got {ranks}")


def orient(decomposition: Tucker) -> Tucker:
    """An equal decomposition whose factors are the same on every processor, up to rounding.

    Each factor is multiplied by the orthogonal matrix of `jaxprt.decompose.eigen.orientation`, and the core by its
    inverse, so the represented tensor does not change.
    """
    core, factor = np.asarray(decomposition.core), []
    for mode, matrix in enumerate(map(np.asarray, decomposition.factor)):
        unfolded = np.moveaxis(core, mode, 0).reshape(core.shape[mode], -1)
        turn = eigen.orientation(np.sum(unfolded**2, 1), matrix).astype(core.dtype)
        core = np.moveaxis(np.tensordot(turn, core, (0, mode)), 0, mode)
        factor.append(jax.device_put(matrix @ turn))
    return Tucker(jax.device_put(core), tuple(factor))
