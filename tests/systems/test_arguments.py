"""All systems: lights and BRDFs of another kind are refused by what is needed, before anything else is looked at."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt import bounces, bright_texels, harmonic, lobe, reference, separable
from jaxprt.brdf import Lambert
from jaxprt.scene import Environment, builtin
from jaxprt.systems.harmonic import HarmonicBrdf, TransferMatrix, TransferVector

MODEL, EYE = Lambert(0.5), jnp.ones(3)
LIGHT, COEFFICIENT = Environment(jnp.ones((6, 8, 8, 3))), jnp.ones((9, 3))
TABLE = HarmonicBrdf(jnp.ones((9, 1, 4)), (), jnp.zeros(()))
MATRIX = TransferMatrix(jnp.ones((2, 1, 9, 9)), jnp.zeros((2, 3)), jnp.stack([jnp.eye(3)] * 2))
VECTOR = TransferVector(jnp.ones((9, 1, 2)), jnp.zeros((2, 3)))
POINT = jnp.zeros((2, 3))
SYSTEM, MATTE = harmonic.HarmonicSystem(MATRIX, TABLE), harmonic.DiffuseSystem(VECTOR, jnp.ones(1))
SPARSE = separable.SparseTransport(
    jnp.zeros((1, 2, 1), jnp.uint16), jnp.ones((1, 2, 1, 1)), POINT, MATRIX.frame, jnp.ones(384)
)
MESH = builtin.plane(cells=1)
PYRAMID = lobe.LobeTransport(
    jnp.zeros((2, lobe.pyramid.scales(8).total), jnp.uint8),
    jnp.zeros((lobe.diffuse.count(8), 2), jnp.uint8),
    POINT,
    MATRIX.frame,
    8,
)
WANTED = {
    "jaxprt.harmonic.project": [
        lambda: harmonic.system.transferred_light(MATRIX, LIGHT),
        lambda: harmonic.system.local_light(MATRIX.frame, LIGHT),
        lambda: harmonic.system.combine(LIGHT, VECTOR.vector),
    ],
    "jaxprt.harmonic.tabulate": [
        lambda: prt.radiance(harmonic.HarmonicSystem(MATRIX, MODEL), COEFFICIENT, eye=EYE),
        lambda: harmonic.system.view_coefficients(MODEL, POINT, MATRIX.frame, eye=EYE),
    ],
    "jaxprt.harmonic.precompute": [lambda: prt.radiance(harmonic.HarmonicSystem(VECTOR, TABLE), COEFFICIENT, eye=EYE)],
    "jaxprt.separable.factor": [
        lambda: separable.SeparableSystem(SPARSE, MODEL),
        lambda: bounces.precompute(MESH, [MODEL]),
    ],
    "jaxprt.lobe.tabulate": [
        lambda: lobe.LobeSystem(PYRAMID, MODEL),
        lambda: lobe.system.view_lobes(PYRAMID, TABLE, eye=EYE),
    ],
    "jaxprt.scene.load_environment": [
        lambda: prt.radiance(SYSTEM, "sky", eye=EYE),
        lambda: prt.radiance(MATTE, COEFFICIENT[:, 0], eye=EYE),
        lambda: harmonic.project(COEFFICIENT, degree=2),
        lambda: separable.system.light_tuple(SPARSE, COEFFICIENT),
        lambda: separable.system.project(COEFFICIENT),
        lambda: lobe.blurred_light.prefilter(COEFFICIENT),
        lambda: reference.radiance(MESH, MODEL, COEFFICIENT, eye=EYE),
        lambda: bright_texels.split(COEFFICIENT, count=3),
    ],
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("source", WANTED)
def test_what_is_of_another_kind_is_refused_by_the_function_that_makes_what_is_needed(source):
    for refused in WANTED[source]:
        with pytest.raises(TypeError, match=f"must be .*{source}.* makes, got"):
            refused()


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    "refused",
    [
        lambda: reference.radiance(None, TABLE, LIGHT, eye=EYE),
        lambda: bright_texels.radiance(None, TABLE, None, None, eye=EYE),
        lambda: lobe.tabulate(TABLE, lobes=1),
    ],
)
def test_tables_whose_values_hold_the_cosine_do_not_pass_for_brdfs(refused):
    with pytest.raises(TypeError, match="got a HarmonicBrdf, whose values include the cosine"):
        refused()


BROKEN = jnp.ones((9, 3)).at[4, 1].set(jnp.nan)


@pytest.mark.parametrize(
    ("refused", "message"),
    [
        (lambda: prt.radiance(SYSTEM, BROKEN, eye=EYE), r"the light must be finite, .* first at \(4, 1\)"),
        (lambda: prt.radiance(SYSTEM, COEFFICIENT, eye=EYE.at[0].set(jnp.inf)), "the eye must be"),
        (
            lambda: harmonic.system.view_coefficients(TABLE, POINT, MATRIX.frame, eye=EYE * jnp.nan),
            "the eye must be finite",
        ),
        (lambda: prt.radiance(MATTE, BROKEN, eye=EYE), "the light must be finite"),
        (lambda: harmonic.system.transferred_light(MATRIX, BROKEN), "the light must be finite"),
        (lambda: harmonic.system.local_light(MATRIX.frame, BROKEN), "the light must be finite"),
        (lambda: harmonic.project(Environment(LIGHT.radiance * jnp.nan), degree=2), "radiance must be finite"),
        (lambda: harmonic.probe_light(POINT, POINT * jnp.nan, jnp.ones((2, 9, 3))), "probes must be finite"),
        (lambda: harmonic.probe_light(POINT, POINT, BROKEN[None]), "the light at the probes must be finite"),
        (lambda: harmonic.probe_light(POINT, POINT[:0], jnp.ones((0, 9, 3))), "there must be at least one probe"),
        (lambda: harmonic.probe_light(POINT, POINT, jnp.ones((3, 9, 3))), "each of the 2 probes, got light at 3"),
        (
            lambda: harmonic.system.combine(COEFFICIENT[:, 0], VECTOR.vector),
            r"\[lm, c\] or \[lm, c, v\], .* shape \[9\]",
        ),
        (lambda: harmonic.system.local_light(MATRIX.frame, COEFFICIENT[:, 0]), r"\[lm, c\] or .* shape \[9\]"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_harmonics_refuse_what_is_not_finite_or_has_other_axes(refused, message):
    with pytest.raises(ValueError, match=message):
        refused()


def test_inside_jit_a_light_that_is_not_finite_reaches_the_vertices():
    color = jax.jit(lambda light: prt.radiance(MATTE, light, eye=EYE))(BROKEN)
    np.testing.assert_array_equal(np.isnan(color), [[False, True, False]] * 2)
