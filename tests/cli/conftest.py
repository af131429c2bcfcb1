"""Commands keep the meshes of small files unless a test asks for their division."""

from typing import Any

import pytest

from jaxprt.cli import inputs
from jaxprt.relit import refinement


@pytest.fixture(scope="module", autouse=True)
def undivided():
    """Divides only where --refine has a number: divided by default, a tetrahedron has 5,000 vertices."""
    divided = refinement.divided

    def on_demand(scene: Any, wanted: bool | float, **options: Any) -> Any:
        return divided(scene, False if wanted is True else wanted, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(inputs.refinement, "divided", on_demand)
        yield
