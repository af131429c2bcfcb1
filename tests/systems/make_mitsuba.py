"""Renders by Mitsuba what the two comparison files beside this one hold jaxprt to.

Run ``python tests/systems/make_mitsuba.py`` again when the scene, the light or the models of a comparison change; a
live rendering in each file tells when that is due.
"""

import importlib.util
import pathlib
import sys

import numpy as np

FILES = ("test_reference_mitsuba", "test_harmonic_mitsuba")

if __name__ == "__main__":
    here = pathlib.Path(__file__).parent
    sys.path.insert(0, str(here.parents[1]))
    for name in FILES:
        spec = importlib.util.spec_from_file_location(name, here / f"{name}.py")
        test = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(test)
        mitsuba, scene, kept = test.load_mitsuba(), test.build_scene(), {}
        for key, case in test.cases().items():
            label = key if isinstance(key, str) else " ".join(map(str, key))
            kept[label] = test.render(mitsuba, scene, **case, seeds=range(test.RENDERINGS))
            kept[f"{label} live"] = test.render(mitsuba, scene, **case | {"samples": test.LIVE}, seeds=range(1))
        np.savez_compressed(test.KEPT, **{label: value.astype(np.float32) for label, value in kept.items()})
