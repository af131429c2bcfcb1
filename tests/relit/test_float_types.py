"""Scenes where float64 is enabled and types are promoted strictly, under lights of every float type."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt.scene import builtin

SIZE = 4
EYE = [0.0, 1.0, 4.0]


@pytest.fixture
def strict(x64):
    with jax.numpy_dtype_promotion("strict"):
        yield


def scene():
    """A glossy, a matte and an emitting part."""
    glossy = prt.scene.TexturedMaterial(base_color=0.5, metallic=0.0, roughness=0.4)
    bright = prt.scene.TexturedMaterial(base_color=0.5, metallic=0.0, roughness=0.4, emissive=2.0)
    ball = builtin.sphere(rings=5, sectors=7)
    parts = [
        prt.Part("glossy", ball, glossy),
        prt.Part("matte", builtin.plane(cells=2), prt.brdf.Lambert(0.5)),
        prt.Part("bright", builtin.sphere(rings=4, sectors=5), bright),
    ]
    return prt.Scene(parts, [prt.scene.camera.orbit(ball, width=8, height=8)])


@pytest.mark.long
@pytest.mark.usefixtures("strict", "coarse", "unchecked")
def test_verbs_of_scenes_take_every_float_type_under_strict_promotion(close):
    relit = prt.precompute(scene(), refine=False, system="harmonic", size=SIZE, bounces=1, progress=False)
    radiance = np.random.default_rng(0).uniform(0.2, 1.0, (6, SIZE, SIZE, 3)).astype(jnp.bfloat16)
    exact = relit.radiance(prt.Environment(jnp.asarray(radiance, "float64")), eye=EYE)
    for dtype in ("bfloat16", "float32"):
        light = prt.Environment(jnp.asarray(radiance, dtype))
        color = relit.radiance(light, eye=jnp.asarray(EYE, dtype))
        close(color, exact, tolerance=1e-5)
        close(prt.radiance(prt.total(relit, relit), light, eye=EYE), 2 * exact, tolerance=1e-5)
