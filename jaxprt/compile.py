"""What a compiler is told beyond the mathematics: steps that are compiled apart, and transposes written by hand.

XLA's CPU code repeats a step for each of its uses where it fuses the two; gathers, and loops over vertices, are then
done many times over. JAX makes gradients of linear maps by transposing what it was given, step by step; that of a
gather is a scatter, which is five times as slow. `isolated` and `linear` are the cures, under all transformations.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial, reduce
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, PyTree

Fixed = TypeVar("Fixed", bound=PyTree)


def isolated(function: Callable, *, static: tuple[str, ...] = ()) -> Callable:
    """Decorates a step that is compiled by itself: like `jax.jit`, and also where another program holds it.

    Args:
        function: Of arrays and pytrees of them, and of static options by name.
        static: Names of the options.
    """
    compiled = jax.jit(function, static_argnames=static)

    def branched(*argument, **named):
        option = {name: named.pop(name) for name in static if name in named}

        def own(argument, named):
            return function(*argument, **named, **option)

        def never(argument, named):
            return jax.tree.map(lambda each: jnp.zeros(each.shape, each.dtype), shape)

        shape = jax.eval_shape(own, argument, named)
        first = next(each for each in jax.tree.leaves((argument, named)) if each.size)
        # Branches are not fused with what is around them. The compiler does not see that this one is always taken.
        taken = jax.lax.stop_gradient(first).ravel()[0].astype(jnp.int32) | 1
        return jax.lax.cond(taken != 0, own, never, argument, named)

    inside = jax.jit(branched, static_argnames=static)  # Traced once, also where derivatives are taken outside any jit.

    @functools.wraps(function)
    def step(*argument, **named):
        leaf = jax.tree.leaves((argument, {name: each for name, each in named.items() if name not in static}))
        traced = any(isinstance(each, Tracer) for each in leaf) and any(np.size(each) for each in leaf)
        return (inside if traced and jax.default_backend() == "cpu" else compiled)(*argument, **named)

    return step


def linear(
    forward: Callable[[Fixed, Array], Array], backward: Callable[[Fixed, Array], Array], fixed: Fixed, x: Array
) -> Array:
    """A linear map of an array, with its transpose.

    Args:
        forward: The map, (fixed, x) -> y, linear in x. Derivatives by `fixed` are taken of it, of those of the
            transpose too, by JAX.
        backward: Its transpose, (fixed, y) -> an array like x. That it is the transpose is not checked.
        fixed: What the map is made of. The transpose may read more of it than the map does.
        x: An array.

    Returns:
        The map of x. Its gradient in x is `backward`, that of the gradient `forward`, and so on.
    """
    leaf, tree = jax.tree.flatten(fixed)
    return _linear.bind(x, *leaf, pair=_Pair(forward, backward, tree, x.shape, x.dtype), back=False)


@dataclass(frozen=True)
class _Pair:
    """A map and its transpose, without their arrays."""

    forward: Callable
    backward: Callable
    tree: Any
    shape: tuple[int, ...]  # of x
    dtype: Any

    def run(self, x: Array, *leaf: Array, back: bool) -> Array:
        fixed = self.tree.unflatten(leaf)
        return self.backward(fixed, x).astype(self.dtype) if back else self.forward(fixed, x)

    def derived(self, x: Array, *leaf: Array, back: bool) -> Array:
        """The same by the map alone: what derivatives by the leaves are of."""
        if not back:
            return self.run(x, *leaf, back=False)
        shape = jax.ShapeDtypeStruct(self.shape, self.dtype)
        return jax.linear_transpose(lambda y: self.run(y, *leaf, back=False), shape)(x)[0]


@dataclass(frozen=True)
class _Batch:
    """A function of a batch, and of leaves with it or without."""

    function: Callable
    axis: tuple[int | None, ...]

    def __call__(self, fixed: PyTree, x: Array) -> Array:
        leaf, tree = jax.tree.flatten(fixed)
        return jax.vmap(lambda x, *leaf: self.function(tree.unflatten(leaf), x), (0, *self.axis))(x, *leaf)


def _run(x: Array, *leaf: Array, pair: _Pair, back: bool) -> Array:
    return pair.run(x, *leaf, back=back)


def _abstract(x, *leaf, pair: _Pair, back: bool):
    if back:
        return x.update(shape=pair.shape, dtype=pair.dtype)
    found = jax.eval_shape(partial(pair.run, back=False), *(jax.ShapeDtypeStruct(a.shape, a.dtype) for a in (x, *leaf)))
    return x.update(shape=found.shape, dtype=found.dtype)


def _jvp(primals, tangents, *, pair: _Pair, back: bool):
    (x, *leaf), (dx, *dleaf) = primals, tangents
    parts = [] if isinstance(dx, ad.Zero) else [_linear.bind(dx, *leaf, pair=pair, back=back)]
    moving = [n for n, each in enumerate(dleaf) if not isinstance(each, ad.Zero)]
    if moving:

        def at(*moved):
            every = dict(zip(moving, moved, strict=True))
            return pair.derived(x, *(every.get(n, each) for n, each in enumerate(leaf)), back=back)

        parts.append(jax.jvp(at, tuple(leaf[n] for n in moving), tuple(dleaf[n] for n in moving))[1])
    return _linear.bind(x, *leaf, pair=pair, back=back), reduce(jnp.add, parts)


def _transpose(cotangent, x, *leaf, pair: _Pair, back: bool):
    if isinstance(cotangent, ad.Zero):
        return (ad.Zero(x.aval), *(None for _ in leaf))
    return (_linear.bind(cotangent, *leaf, pair=pair, back=not back), *(None for _ in leaf))


def _batched(argument, axis, *, pair: _Pair, back: bool):
    size = next(each.shape[n] for each, n in zip(argument, axis, strict=True) if n is not None)
    x, *leaf = (each if n is None else jnp.moveaxis(each, n, 0) for each, n in zip(argument, axis, strict=True))
    if axis[0] is None:
        x = jnp.broadcast_to(x, (size, *x.shape))
    own = tuple(None if n is None else 0 for n in axis[1:])
    wide = _Pair(_Batch(pair.forward, own), _Batch(pair.backward, own), pair.tree, (size, *pair.shape), pair.dtype)
    return _linear.bind(x, *leaf, pair=wide, back=back), 0


_linear = Primitive("linear")
_linear.def_impl(partial(jax.jit, static_argnames=("pair", "back"))(_run))
_linear.def_abstract_eval(_abstract)
mlir.register_lowering(_linear, mlir.lower_fun(_run, multiple_results=False))
ad.primitive_jvps[_linear] = _jvp
ad.primitive_transposes[_linear] = _transpose
batching.primitive_batchers[_linear] = _batched
