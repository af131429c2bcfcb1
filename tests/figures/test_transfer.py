"""Shorter decompositions of a transfer tensor."""

import numpy as np
import pytest

from benchmarks.published.transfer import truncate
from jaxprt import bounces, separable
from jaxprt.brdf import Lambert
from jaxprt.systems.bounces import TransferTensor
from tests.systems.bounces.reflected import OPTIONS, bowl


@pytest.fixture(scope="module")
def whole() -> TransferTensor:
    """The light in a bowl."""
    white = separable.factor(Lambert(1.0), terms=1, resolution=8)
    return bounces.precompute(bowl(), [white], **OPTIONS)


def test_fewer_components_and_modes_err_as_those_that_were_precomputed(whole):
    cut = truncate(whole, 6, modes=8)
    assert cut.weight.shape[-1] == 6
    assert cut.patches is not None
    assert cut.patches.first.shape[1] == 6
    assert cut.nbytes < whole.nbytes
    first, second = (np.einsum("gmn,gensq->gmesq", each.weight, each.core) for each in (cut, whole))
    part = np.einsum("gle,gmesq->gmlsq", whole.mode, second)
    rest = part - np.einsum("gle,gmesq->gmlsq", cut.mode, first)
    assert 0.002 < np.linalg.norm(rest) / np.linalg.norm(part) < 0.5
    assert np.max(truncate(whole, 6, modes=4).error) > np.max(cut.error) > np.max(whole.error)


def test_numbers_out_of_range_are_refused(whole):
    with pytest.raises(ValueError, match=r"at least 1 and at most \(40, 24\), and lamps none, got 0, 3 and 0 lamps"):
        truncate(whole, 0, modes=3)
