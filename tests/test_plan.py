"""Plans against the error that carrying them out has, on views that they did not see."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt import lobe, plan, reference
from jaxprt.brdf import AshikhminShirley
from jaxprt.scene import Environment, builtin

BRDF = AshikhminShirley(nu=8, nv=20)
ASKED = 0.3


@pytest.fixture(scope="module", autouse=True)
def small():
    """Few steps, small maps, and lobes fitted to few samples without their error, which no plan reads."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plan, "_LADDER", tuple(step._replace(resolution=12) for step in plan._LADDER[:3]))
        patch.setattr(plan, "_LOBES", plan._LOBES[:2])
        patch.setattr(lobe.table, "_natural_error", lambda brdf, table: 0.0)
        patch.setattr(lobe.table, "tabulate", functools.partial(lobe.tabulate, resolution=12))
        patch.setattr(lobe.em, "RINGS", 24)
        patch.setattr(lobe.em, "SECTORS", 32)
        lobe.em.samples.clear_cache()  # which both are compiled into
        yield
    lobe.em.samples.clear_cache()


@pytest.fixture(scope="module")
def mesh():
    return builtin.sphere(rings=6, sectors=8)


@pytest.fixture(scope="module")
def sky():
    return builtin.daylight(size=8)


@pytest.fixture(scope="module")
def planned(mesh, sky):
    return plan.separable(mesh, BRDF, [sky], error=ASKED, progress=False)


@pytest.fixture(scope="module")
def ready(mesh, planned):
    return plan.precompute(mesh, BRDF, planned, progress=False)


def test_the_error_asked_for_holds_from_other_views(mesh, sky, planned, ready):
    assert planned.error * plan.MARGIN <= ASKED
    _check_other_views(mesh, sky, ready)


def _check_other_views(mesh, sky, ready):
    now, exact = [], []
    for eye in jnp.array([[0.5, 3.0, 1.0], [-2.0, 0.5, 2.5]]):
        now.append(plan.radiance(ready, sky, eye=eye))
        exact.append(reference.radiance(mesh, BRDF, sky, eye=eye, progress=False))
    assert np.linalg.norm(np.subtract(now, exact)) < ASKED * np.linalg.norm(exact)


def test_bytes_are_those_of_what_is_made(mesh, planned, ready):
    made = ready.transport.nbytes + ready.visible.nbytes
    assert planned.nbytes == pytest.approx(made, rel=0.2)
    assert planned.seconds > 0
    assert planned.precompute_seconds > 0


def test_a_plan_of_lobes_holds_from_other_views_and_stores_what_it_says(mesh, sky):
    wanted = plan.lobe(mesh, BRDF, [sky], error=ASKED, progress=False)
    assert wanted.error * plan.MARGIN <= ASKED
    ready = plan.precompute(mesh, BRDF, wanted, progress=False)
    assert ready.table.lobes == wanted.lobes
    assert wanted.nbytes == ready.transport.nbytes
    _check_other_views(mesh, sky, ready)


def test_an_error_that_no_number_of_lobes_reaches_is_refused(mesh, sky, monkeypatch):
    monkeypatch.setattr(plan, "_LOBES", plan._LOBES[:1])
    with pytest.raises(ValueError, match=r"error must be at least 0\.\d+, which the most lobes reach; got 1e-05"):
        plan.lobe(mesh, BRDF, [sky], error=1e-5, progress=False)


@pytest.mark.parametrize("make", [plan.separable, plan.lobe])
@pytest.mark.parametrize(
    ("lights", "error", "message"),
    [
        ([], 0.1, "environments must be at least one, got none"),
        ([4, 8], 0.1, "must be of one size"),
        ([8], 0.0, "error must be positive and finite, got 0"),
        ([8], np.nan, "error must be positive and finite, got nan"),
        ([8], np.inf, "error must be positive and finite, got inf"),
    ],
)
def test_impossible_plans_are_refused(mesh, make, lights, error, message):
    lights = [Environment(jnp.ones((6, size, size, 3))) for size in lights]
    with pytest.raises(ValueError, match=message):
        make(mesh, BRDF, lights, error=error, progress=False)


@pytest.mark.parametrize("make", [plan.separable, plan.lobe])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_light_that_is_not_finite_is_refused_by_its_number_among_others(mesh, make, value):
    sky = np.ones((6, 8, 8, 3), np.float32)
    damaged = sky.copy()
    damaged[2, 3, 4, 1] = value
    whole = Environment(jnp.asarray(sky))
    lights = [whole, jax.tree.map(lambda _: jnp.asarray(damaged), whole)]  # as a computation that went wrong makes it
    with pytest.raises(ValueError, match=r"environment 1 must be finite, got 1 of 1152 .* first at \(2, 3, 4, 1\)"):
        make(mesh, BRDF, lights, error=ASKED, progress=False)


def test_a_brdf_that_is_not_finite_has_no_plan(mesh, sky):
    """It had one of error 0."""
    broken = eqx.tree_at(lambda brdf: brdf.diffuse, AshikhminShirley(), jnp.array([jnp.nan]))
    with pytest.raises(ValueError, match=r"what the BRDF makes of the lights, .* must be finite, got"):
        plan.separable(mesh, broken, [sky], error=ASKED, progress=False)


@pytest.mark.parametrize(
    "planned",
    [
        plan.Plan(1, 2, 8, 1, 1, 1, 1, ASKED, 0.0, 0, 0.0, 110, 32),
        plan.LobePlan(2, 1, ASKED, 0.0, 0, 0.0, 110, 32),
    ],
    ids=["separable", "lobe"],
)
def test_a_plan_is_for_its_own_mesh(mesh, planned):
    with pytest.raises(ValueError, match="the mesh must have the plan's 110 vertices, got 9"):
        plan.precompute(builtin.plane(cells=2), BRDF, planned, progress=False)
