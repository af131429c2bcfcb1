"""The published tensor of a set of BRDFs, with and without the published lobes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.published import maps
from benchmarks.published.lobes import mirror_lobes
from benchmarks.published.tensors import factor_tensor
from jaxprt import dynamic
from jaxprt.brdf import CookTorrance

RESOLUTION = 8
SET = [CookTorrance(diffuse=0.0, specular=1.0, roughness=m, f0=0.3) for m in (0.25, 0.4, 0.6)]


@jax.jit
def value(brdf, wi, wo):
    return brdf(wi, wo)


@jax.jit
def mixed_value(table, weight, wi, wo):
    """Value of a set's BRDF at some place."""
    return table.at(weight)(wi, wo)


def relative(value, exact):
    return float(np.linalg.norm(np.asarray(value) - exact) / np.linalg.norm(exact))


def test_published_tensor_is_exact_at_full_rank():
    table = factor_tensor(SET, ranks=(3, 40, 40), resolution=8)
    direction = np.asarray(maps.texel_direction(resolution=8)).reshape(-1, 3)
    inside = np.flatnonzero(maps.texel_area(resolution=8))[8:30]
    wi = np.broadcast_to(direction[inside][:, None], (22, 22, 3))
    for number, brdf in enumerate(SET):
        found = mixed_value(table, np.eye(3, dtype=np.float32)[number], wi, wi.swapaxes(0, 1))
        assert relative(found, value(brdf, wi, wi.swapaxes(0, 1))) < 0.013
    assert table.error < 6e-3


def test_published_lobes_leave_what_a_tensor_can_carry():
    lobes = dynamic.separate(SET, separator=lambda b: mirror_lobes(b, resolution=4))
    assert lobes.scale.shape[:2] == (4, 3)
    with_lobes = dynamic.factor(SET, lobes, ranks=(3, 16, 16), resolution=RESOLUTION)
    without = dynamic.factor(SET, None, ranks=(3, 16, 16), resolution=RESOLUTION)
    assert with_lobes.error < without.error


def test_maps_that_are_too_small_and_brdfs_that_are_not_finite_are_refused():
    with pytest.raises(ValueError, match="resolution must be at least 4"):
        factor_tensor(SET, ranks=(1, 1, 1), resolution=0)
    with pytest.raises(ValueError, match="finite"):
        factor_tensor([SET[0], lambda wi, wo: wi[:, 2:] * jnp.nan], ranks=(1, 1, 1), resolution=8)
