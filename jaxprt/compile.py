"""Control of compilation: precision, separately compiled steps, loops, and transposes of linear maps.

`jit` requests full precision, because GPUs otherwise round the factors of float32 products to ten bits. `kept` lets
later processes load a large program without tracing it. `isolated` compiles a step separately, because XLA on CPUs may
fuse a step into each of its uses and repeat it there, gathers and loops over vertices included. `linear` takes the
transpose of a linear map explicitly, because JAX would otherwise derive gradients by transposing each operation, and
the transpose of a gather is a scatter, which is slower. All of these work under all JAX transformations. `total` and
`mapped` are loops in the form that suits the device: CPUs prefer steps that stay in the cache, GPUs few large kernels.
"""

import contextlib
import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial, reduce
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax._src.core import trace_state_clean
from jax.core import Tracer
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Bool, PyTree

from jaxprt.programs import executables, jax_cache

Between = Callable[[], None] | None  # called between the steps of a long computation
Fixed = TypeVar("Fixed", bound=PyTree)
Function = TypeVar("Function", bound=Callable)

TOGETHER = 16  # rows of a sum that CPUs skip together
_ROOM = 1 << 28  # bytes of results that loops compute at once on GPUs

_CANARIES = (32_769, 40_000)  # numbers of rows at which jaxlib 0.10.2 is wrong: `xla_flags`; at 10,000 it is right
jax_cache.install()


def jit(function: Callable, **options: Any) -> Any:
    """`jax.jit` with matrix products that have the full precision of their dtype on every device.

    This applies to everything that the function calls while it is traced, including user-defined BRDFs, and to its
    derivatives. Types are promoted as in NumPy, also where the caller has set `jax_numpy_dtype_promotion` to "strict".

    Args:
        function: A function whose arguments are arrays and pytrees of arrays.
        options: Options of `jax.jit`.
    """
    return jax.jit(_exact(function), **options)


def kept(function: Callable, *, static: tuple[str, ...] = (), quick: bool = False) -> Any:
    """Decorates a function like `jit`. Later processes load its executables and need not trace it either.

    Use it for the few programs that take long to trace or to compile; a call takes 20 us longer than with `jit`. Calls
    inside other programs, derivatives, and arguments of classes that users define are compiled as with `jit`.

    Args:
        function: A function at the top level of a module of this package, whose arguments are arrays and pytrees of
            arrays. Static options are passed by name.
        static: Names of the static options.
        quick: Whether to compile in two thirds of the time, for programs that run as fast so. Long expressions over
            many points, such as BRDFs, would take three times as long.
    """
    return executables.StoredFunction(function, jit(function, static_argnames=static), static, quick=quick)


def _exact(function: Callable) -> Callable:
    @functools.wraps(function)
    def traced(*argument, **named):
        with jax.default_matmul_precision("highest"), jax.numpy_dtype_promotion("standard"):
            return function(*argument, **named)

    return traced


def promoted(function: Function) -> Function:
    """Decorates a function that computes outside of `jit`: types are promoted as in NumPy, as `jit` does."""

    @functools.wraps(function)
    def called(*argument, **named):
        with jax.numpy_dtype_promotion("standard"):
            return function(*argument, **named)

    return cast(Function, called)


def wrong_sums() -> int:
    """Number of rows in which the default device's compiler gets a small sum wrong; 0 from a correct compiler.

    For each row vector r it is the squared norm of M r with a 3 x 3 matrix M, at numbers of rows where a compiler was
    wrong in silence. It compiles two programs.
    """
    matrix = np.random.default_rng(0).normal(size=(3, 3)).astype(np.float32)
    squares = jit(jax.vmap(lambda row: jnp.sum((matrix @ row) ** 2)))
    wrong = 0
    for count in _CANARIES:
        row = np.random.default_rng(1).normal(size=(count, 3)).astype(np.float32)
        expected = np.sum((row.astype(np.float64) @ matrix.astype(np.float64).T) ** 2, 1)
        wrong += int(np.sum(~(np.abs(np.asarray(squares(row)) - expected) <= 1e-3 * expected)))
    return wrong


def isolated(function: Callable, *, static: tuple[str, ...] = ()) -> Callable:
    """Decorates a function like `jit`. On CPUs it is not fused with the rest when another program calls it.

    Args:
        function: A function whose arguments are arrays and pytrees of arrays. Static options are passed by name.
        static: Names of the static options.
    """
    compiled = jit(function, static_argnames=static)

    def branched(*argument, **named):
        option = {name: named.pop(name) for name in static if name in named}

        def whole(argument, named):
            return function(*argument, **named, **option)

        def never(argument, named):
            return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shape)

        shape = jax.eval_shape(whole, argument, named)
        first = next(leaf for leaf in jax.tree.leaves((argument, named)) if leaf.size)
        first = _any_of_batch.bind(jax.lax.stop_gradient(first).ravel()[0].astype(jnp.int32))
        # A branch is not fused with its surroundings. The CPU compiler does not detect that this branch is always
        # taken;
        # other compilers do, and remove the branch.
        taken = jax.lax.platform_dependent(first, cpu=lambda x: (x | 1) != 0, default=_always)
        return jax.lax.cond(taken, whole, never, argument, named)

    inside = jit(branched, static_argnames=static)  # traced once, also for derivatives outside of any jit

    @functools.wraps(function)
    def step(*argument, **named):
        leaf = jax.tree.leaves((argument, {name: value for name, value in named.items() if name not in static}))
        traced = any(isinstance(value, Tracer) for value in leaf) and any(np.size(value) for value in leaf)
        return (inside if traced else compiled)(*argument, **named)

    return step


def numba_loop(function: Callable, **options: Any) -> Callable:
    """Compiles a loop by numba. Later processes load what this one has compiled.

    Args:
        function: The loop. It releases the global interpreter lock.
        options: Further options of `numba.njit`.
    """
    import numba  # takes half a second

    from jaxprt.programs import loops

    # Run-time checks of types wrap functions, and numba compiles no such wrapper.
    return loops.keep(numba.njit(nogil=True, **options)(inspect.unwrap(function)))


def finished(result: PyTree, between: Between) -> PyTree:
    """Waits until the device has computed the result of a step, calls `between`, and returns the result.

    `between` may raise to abort the computation. If it is None, the result is returned immediately, while the device
    may still be computing it. Do not use this inside `jax.jit`.
    """
    if between is not None:
        jax.block_until_ready(result)
        between()
    return result


def _always(_: Array) -> Array:
    return jnp.asarray(True)


def total(
    term: Callable[[PyTree], Array],
    rows: PyTree,
    *,
    counts: Callable[[PyTree], Bool[Array, ""]] | None = None,
    together: int = 1,
) -> Array:
    """Sums a function over rows: on CPUs one row after another, elsewhere as many rows at once as memory permits.

    Args:
        term: Function of one row.
        rows: Arrays with the rows along the first axis.
        counts: Whether any of `TOGETHER` rows counts, of which there must be a multiple. CPUs skip those of which none
            does, whose terms must be zero. A branch for each row would take longer than many terms.
        together: Rows that CPUs add in one pass over the result, where terms are so simple that passes take the time.
    """
    shape = jax.eval_shape(term, _first(rows))
    start = jnp.zeros(shape.shape, shape.dtype)

    def added(carry, rows):
        return jax.lax.scan(lambda carry, row: (carry + term(row), None), carry, rows, unroll=together)[0]

    def by_row(rows):
        if counts is None:
            return added(start, rows)

        def some(carry, rows, counts=counts):
            return jax.lax.cond(counts(rows), added, lambda carry, _: carry, carry, rows), None

        blocks = jax.tree.map(lambda leaf: leaf.reshape(-1, TOGETHER, *leaf.shape[1:]), rows)
        return jax.lax.scan(some, start, blocks)[0]

    def at_once(rows):
        return jnp.sum(jax.vmap(term)(rows), 0, dtype=shape.dtype)

    def by_block(rows):
        block, rest = _blocks(rows, shape.size * shape.dtype.itemsize)
        if block is None:
            return at_once(rest)
        return jax.lax.scan(lambda carry, rows: (carry + at_once(rows), None), at_once(rest), block)[0]

    return jax.lax.platform_dependent(rows, cpu=by_row, default=by_block)


def mapped(function: Callable[[PyTree], PyTree], rows: PyTree) -> PyTree:
    """`jax.lax.map`: on CPUs one row after another, elsewhere as many rows at once as memory permits.

    Args:
        function: Function of one row.
        rows: Arrays with the rows along the first axis.
    """
    one = _first(rows)
    size = sum(leaf.size for leaf in jax.tree.leaves((one, jax.eval_shape(function, one))))
    count = len(jax.tree.leaves(rows)[0])
    most = _at_once(count, 8 * size)

    def by_block(rows):
        return jax.vmap(function)(rows) if most >= count else jax.lax.map(function, rows, batch_size=most)

    return jax.lax.platform_dependent(rows, cpu=partial(jax.lax.map, function), default=by_block)


def _first(rows: PyTree) -> PyTree:
    """Shapes and types of one row."""
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), rows)


def _at_once(count: int, size: int) -> int:
    """Number of rows to compute at once, if each takes `size` bytes."""
    return max(1, min(count, _ROOM // max(1, size)))


def _blocks(rows: PyTree, size: int) -> tuple[PyTree | None, PyTree]:
    """Rows in full blocks, and the remaining rows. If all rows fit into one block, all of them remain."""
    count = len(jax.tree.leaves(rows)[0])
    most = _at_once(count, size)
    whole = max(0, (count - 1) // most)
    rest = jax.tree.map(lambda leaf: leaf[whole * most :], rows)
    if not whole:
        return None, rest
    return jax.tree.map(lambda leaf: leaf[: whole * most].reshape(whole, most, *leaf.shape[1:]), rows), rest


def linear(
    forward: Callable[[Fixed, Array], Array],
    backward: Callable[[Fixed, Array], Array] | None,
    fixed: Fixed,
    x: Array,
    *,
    in_turn: bool = False,
) -> Array:
    """Applies a linear map whose transpose is given explicitly, or whose batches are mapped one by one.

    Args:
        forward: Function (fixed, x) -> y, linear in x. JAX differentiates it with respect to `fixed`, also for the
            derivatives of the transpose.
        backward: Transpose of `forward`, (fixed, y) -> array like x. It is not checked to be the transpose. None to
            derive it.
        fixed: Parameters of the map. The transpose may use more of them than the map.
        x: An array.
        in_turn: Whether CPUs map a batch of x one by one, where the parameters are the same for all.

    Returns:
        The map applied to x. Its gradient in x uses `backward`, the gradient of that uses `forward`, and so on.
    """
    leaf, tree = jax.tree.flatten(fixed)
    return _linear.bind(x, *leaf, pair=_Pair(forward, backward, tree, x.shape, x.dtype, in_turn), back=False)


@dataclass(frozen=True)
class _Pair:
    """A linear map and its transpose, without their arrays."""

    forward: Callable
    backward: Callable | None
    tree: Any
    shape: tuple[int, ...]  # of x
    dtype: Any
    in_turn: bool = False

    def run(self, x: Array, *leaf: Array, back: bool) -> Array:
        fixed = self.tree.unflatten(leaf)
        if not back:
            return self.forward(fixed, x)
        if self.backward is None:
            return self.derived(x, *leaf, back=True)
        return self.backward(fixed, x).astype(self.dtype)

    def derived(self, x: Array, *leaf: Array, back: bool) -> Array:
        """The same result, computed by the map only. Derivatives with respect to the leaves use it."""
        if not back:
            return self.run(x, *leaf, back=False)
        shape = jax.ShapeDtypeStruct(self.shape, self.dtype)
        return jax.linear_transpose(lambda y: self.run(y, *leaf, back=False), shape)(x)[0]


@dataclass(frozen=True)
class _Batch:
    """A function applied to a batch. Leaves may have the batch axis or not."""

    function: Callable
    axis: tuple[int | None, ...]
    in_turn: bool

    def __call__(self, fixed: PyTree, x: Array) -> Array:
        if self.in_turn:
            return mapped(partial(self.function, fixed), x)
        leaf, tree = jax.tree.flatten(fixed)
        return jax.vmap(lambda x, *leaf: self.function(tree.unflatten(leaf), x), (0, *self.axis))(x, *leaf)


def _run(x: Array, *leaf: Array, pair: _Pair, back: bool) -> Array:
    return pair.run(x, *leaf, back=back)


def _abstract(x, *leaf, pair: _Pair, back: bool):
    if back:
        return x.update(shape=pair.shape, dtype=pair.dtype)
    form = jax.eval_shape(partial(pair.run, back=False), *(jax.ShapeDtypeStruct(a.shape, a.dtype) for a in (x, *leaf)))
    return x.update(shape=form.shape, dtype=form.dtype)


def _jvp(primals, tangents, *, pair: _Pair, back: bool):
    (x, *leaf), (dx, *dleaf) = primals, tangents
    parts = [] if isinstance(dx, ad.Zero) else [_linear.bind(dx, *leaf, pair=pair, back=back)]
    moving = [n for n, slope in enumerate(dleaf) if not isinstance(slope, ad.Zero)]
    if moving:

        def at(*moved):
            change = dict(zip(moving, moved, strict=True))
            return pair.derived(x, *(change.get(n, value) for n, value in enumerate(leaf)), back=back)

        parts.append(jax.jvp(at, tuple(leaf[n] for n in moving), tuple(dleaf[n] for n in moving))[1])
    return _linear.bind(x, *leaf, pair=pair, back=back), reduce(jnp.add, parts)


def _transpose(cotangent, x, *leaf, pair: _Pair, back: bool):
    if isinstance(cotangent, ad.Zero):
        return (ad.Zero(x.aval), *(None for _ in leaf))
    return (_linear.bind(cotangent, *leaf, pair=pair, back=not back), *(None for _ in leaf))


def _batched(argument, axis, *, pair: _Pair, back: bool):
    size = next(array.shape[n] for array, n in zip(argument, axis, strict=True) if n is not None)
    x, *leaf = (array if n is None else jnp.moveaxis(array, n, 0) for array, n in zip(argument, axis, strict=True))
    if axis[0] is None:
        x = jnp.broadcast_to(x, (size, *x.shape))
    axes = tuple(None if n is None else 0 for n in axis[1:])
    kind = partial(_Batch, axis=axes, in_turn=pair.in_turn and not any(n is not None for n in axes))
    backward = None if pair.backward is None else kind(pair.backward)
    wide = replace(pair, forward=kind(pair.forward), backward=backward, shape=(size, *pair.shape))
    return _linear.bind(x, *leaf, pair=wide, back=back), 0


_linear = Primitive("linear")
_stepwise = jit(_run, static_argnames=("pair", "back"))
_linear.def_impl(_stepwise)
_linear.def_abstract_eval(_abstract)
mlir.register_lowering(_linear, mlir.lower_fun(_stepwise, multiple_results=False))
ad.primitive_jvps[_linear] = _jvp
ad.primitive_transposes[_linear] = _transpose
batching.primitive_batchers[_linear] = _batched


# A number, of which a batch has one too: a branch on it remains a branch in batches, which choose by one.
_any_of_batch = Primitive("any_of_batch")
_any_of_batch.def_impl(lambda x: x)
_any_of_batch.def_abstract_eval(lambda x: x)
mlir.register_lowering(_any_of_batch, lambda _, x: [x])
batching.primitive_batchers[_any_of_batch] = lambda argument, axis: (jnp.take(argument[0], 0, axis[0]), None)


def shared_size(count: int, *, fine: bool = False) -> int:
    """The smallest size of at least `count` that scenes share: m 2^k with m from 4 to 7, or with `fine` from 16 to 31.

    Arrays of vertices, faces and texels are padded to such sizes, so that scenes of about the same size run the same
    programs. Padding is 12 % on average and 25 % at most, or 3 % and 6 %.
    """
    shift = max(count.bit_length() - (5 if fine else 3), 0)
    return -(-count >> shift) << shift


def put(value: PyTree) -> PyTree:
    """Arrays of the host on the device, without a program, and also while JAX traces a function."""
    with compile_time():
        return jax.tree.map(lambda leaf: jax.device_put(leaf) if isinstance(leaf, np.ndarray) else leaf, value)


def compile_time(*value: PyTree) -> contextlib.AbstractContextManager:
    """A context in which operations on known arrays are executed at once, even while JAX traces a function.

    Nothing changes if JAX traces one of the given values.
    """
    if trace_state_clean() or not known(*value):  # Programs are compiled again inside of such a context.
        return contextlib.nullcontext()
    return jax.ensure_compile_time_eval()


def known(*value: PyTree) -> bool:
    """Whether JAX traces none of the arrays."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(value))
