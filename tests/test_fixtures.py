"""The fixtures of tests/conftest.py that other tests rely on."""

import pytest

import jaxprt as prt
from jaxprt.brdf import Lambert
from jaxprt.relit import recipes
from jaxprt.systems import separable


def test_bounds_hold_for_what_callers_give_and_for_what_they_leave_open_under_every_name(bound):
    before = prt.separable.factor
    with pytest.MonkeyPatch.context() as patch:
        bound(patch, before, resolution=6)
        for place in (prt.separable, separable.factorization, recipes.separable):
            for options in ({}, {"resolution": 48}, {"resolution": None}):
                assert place.factor(Lambert(0.5), terms=1, **options).light_map.shape[1] == 6
        assert prt.separable.factor(Lambert(0.5), terms=1, resolution=4).light_map.shape[1] == 4
    assert prt.separable.factor is separable.factorization.factor is before


def test_errors_are_bounded_from_below(bound, monkeypatch):
    monkeypatch.setattr(prt.harmonic.table, "given", lambda *, error=None: error, raising=False)
    bound(monkeypatch, prt.harmonic.table.given, error=0.5)
    assert [prt.harmonic.table.given(error=each) for each in (None, 0.1, 0.7)] == [0.5, 0.5, 0.7]


def test_a_function_that_the_package_does_not_have_is_refused(bound, monkeypatch):
    with pytest.raises(AssertionError, match="no module of jaxprt has"):
        bound(monkeypatch, sorted, key=2)
