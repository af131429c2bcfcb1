"""Renders by Mitsuba what `test_reflections_mitsuba.py` holds reflected light to.

Run ``python tests/relit/make_reflections.py`` again when its scene, its lights or its materials change.
"""

import importlib.util
import pathlib
import sys

import numpy as np

if __name__ == "__main__":
    here = pathlib.Path(__file__).parent
    sys.path.insert(0, str(here.parents[1]))
    spec = importlib.util.spec_from_file_location("test_reflections_mitsuba", here / "test_reflections_mitsuba.py")
    assert spec is not None
    assert spec.loader is not None
    test = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(test)
    kept = {str(roughness): test.rendered(triple) for roughness, triple in test.triples().items()}
    np.savez_compressed(test.KEPT, **{name: value.astype(np.float16) for name, value in kept.items()})
