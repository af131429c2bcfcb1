"""BRDFs that vary over a surface: one model per vertex, and several gray BRDFs as channels."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxprt import require
from jaxprt.brdf.microfacet import values
from jaxprt.compile import jit


class PerVertex(eqx.Module):
    """A BRDF for each vertex: a model in which every parameter has a leading axis of vertices.

    Attributes:
        model: The model, such as `MetallicRoughness` with textured parameters.
    """

    model: Callable

    def __check_init__(self):
        """Refuses parameters with different numbers of vertices."""
        leaves = jax.tree.leaves(self.model)
        if not leaves or any(not leaf.ndim for leaf in leaves):
            raise ValueError("every parameter of the model must have a leading axis of vertices, got one without")
        for leaf in leaves:
            require.length("rows of each parameter of the model", leaf, len(leaves[0]))

    @property
    def vertices(self) -> int:
        """Number of vertices."""
        return len(jax.tree.leaves(self.model)[0])

    def of(self, vertex: Int[Array, "*b"]) -> Callable:
        """The model at some vertices. For a single vertex index its parameters have no leading axis."""
        return _rows(self.model, vertex)

    def __call__(self, wi: Float[Array, "v *b 3"], wo: Float[Array, "v *b 3"]) -> Float[Array, "v *b c"]:
        """Value in 1/sr at each vertex, for that vertex's directions."""
        return jax.vmap(lambda model, wi, wo: model(wi, wo))(self.model, wi, wo)


@jit
def _rows(model: Callable, vertex: Array) -> Callable:
    return jax.tree.map(lambda leaf: leaf[vertex], model)


class Channels(eqx.Module):
    """Several gray BRDFs as the channels of one BRDF, so that one table or factorization holds them all.

    Attributes:
        model: The gray BRDFs.
        scale: Factor of each BRDF. Fits to all channels minimize their summed error, so the factors should be typical
            weights; weights of a `Blend` are then relative to them.
    """

    model: tuple[Any, ...]
    scale: Float[Array, " k"]

    def __call__(self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> Float[Array, "*b k"]:
        """Values in 1/sr, times the scales."""
        value = values(self.model, wi, wo)
        return jnp.concatenate([part * jnp.asarray(self.scale)[k] for k, part in enumerate(value)], -1)
