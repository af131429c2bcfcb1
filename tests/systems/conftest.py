"""Fixtures of the tests of relighting: ``few_samples``."""

from collections.abc import Iterator

import pytest

from jaxprt import lobe


@pytest.fixture(scope="module")
def few_samples() -> Iterator[None]:
    """For one file, lobes are fitted to BRDFs at fewer directions; the code that fits them is the same.

    The two programs that hold the number of directions are compiled anew at both ends. All others stay.
    """
    holders = (lobe.em.samples, lobe.table._natural_error)
    with pytest.MonkeyPatch.context() as patch:
        for each in holders:
            each.clear_cache()
        patch.setattr(lobe.em, "RINGS", 20)
        patch.setattr(lobe.em, "SECTORS", 28)
        yield
    for each in holders:
        each.clear_cache()
