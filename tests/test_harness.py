"""The helpers that judge everything else are judged here: ``close`` and the benchmark harness."""

import json
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import harness

LINE = {"benchmark": "b", "case": "c", "seconds": 2.0, "compile_seconds": 1.0, "error": 1e-3, "bytes": 8}


@pytest.mark.parametrize(
    ("actual", "expected", "options"),
    [
        (np.float32([3.0, 4.0, 1e-9]) * np.float32(1 + 0.5e-5), [3.0, 4.0, 1e-9], {}),
        (np.array([3.0, 4.0, 1e-9]) * (1 + 0.5e-12), [3.0, 4.0, 1e-9], {}),
        (np.float32([1.01]), [1.0], {"tolerance": 0.02}),
        ([1.0, 1e-14], [1.0, 0.0], {}),  # relative to the norm, not to each element
        ([0.0, 1e-13], [0.0, 0.0], {}),  # absolute where zero is expected
        ([1, 2], [1, 2], {}),
        (np.zeros((0, 3)), np.zeros((0, 3)), {}),
    ],
)
def test_close_passes_within_the_tolerance(close, actual, expected, options):
    close(actual, expected, **options)
    close(jnp.asarray(actual), jnp.asarray(actual), **options)


@pytest.mark.parametrize(
    ("actual", "expected", "options", "message"),
    [
        (np.float32([3.0, 4.0]) * np.float32(1 + 2e-5), [3.0, 4.0], {}, "relative error"),
        (np.array([3.0, 4.0]) * (1 + 2e-12), [3.0, 4.0], {}, "relative error"),
        (np.float32([1.01]), [1.0], {"tolerance": 0.005}, "relative error"),
        ([1e-6, 2e-6], [1e-6, 1e-6], {}, r"largest difference at \(1,\)"),
        ([0.0, 1e-11], [0.0, 0.0], {}, "relative error"),
        (np.array([1000000, 2]), np.array([1000001, 2]), {}, "relative error"),
        (np.ones(3), 1.0, {}, "shape"),
    ],
)
def test_close_fails_beyond_the_tolerance(close, actual, expected, options, message):
    with pytest.raises(AssertionError, match=message):
        close(actual, expected, **options)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_close_never_accepts_values_that_are_not_finite(close, value):
    with pytest.raises(AssertionError, match="not finite"):
        close([1.0, value], [1.0, 1.0], tolerance=np.inf)
    with pytest.raises(AssertionError, match="must be finite"):
        close([1.0, value], [1.0, value], tolerance=np.inf)


def test_x64_is_on_for_a_test_that_asks_for_it(x64):
    assert jnp.zeros(1).dtype == jnp.float64


def test_x64_is_off_for_a_test_that_does_not():
    assert jnp.zeros(1).dtype == jnp.float32


@pytest.fixture
def clock(monkeypatch):
    """A clock that stands until a call lets it go on: what is measured depends on no machine."""
    now = [0.0]
    monkeypatch.setattr(harness, "time", types.SimpleNamespace(perf_counter=lambda: now[0]))

    def taking(*seconds):
        """A function whose calls take so long, one after another."""
        each = iter(seconds)

        def function():
            now[0] += next(each)

        return function

    return taking


def test_compiling_is_measured_apart(clock):
    timing = harness.measure(clock(8.0, 1.0, 1.0, 1.0), repeats=3)
    assert timing.seconds == 1.0
    assert timing.compile_seconds == 7.0


def test_median_ignores_one_slow_call(clock):
    assert harness.measure(clock(1.0, 2.0, 64.0, 2.0), repeats=3).seconds == 2.0


def test_measure_waits_for_the_result(monkeypatch):
    waited = []
    monkeypatch.setattr(jax, "block_until_ready", waited.append)
    harness.measure(lambda: "result", repeats=2)
    assert waited == ["result"] * 3


def test_spread_is_half_the_distance_between_quartiles(clock):
    timing = harness.measure(clock(1.0, 8.0, 9.0, 10.0, 11.0, 12.0), repeats=5)
    assert timing.spread == pytest.approx(0.1)
    assert timing.peer() == {"peer_seconds": 10.0, "peer_spread": timing.spread}


def test_compare_alternates_and_warms_each():
    order = []
    harness.compare(lambda: order.append("a"), lambda: order.append("b"), repeats=3)
    assert "".join(order) == "ab" + 3 * "aabb"


def test_several_functions_are_timed_in_turn():
    order = []
    timings = harness.alternate([lambda name=name: order.append(name) for name in "abc"], repeats=2)
    assert "".join(order) == "abc" + 2 * "aabbcc"
    assert [timing.repeats for timing in timings] == [2, 2, 2]


def test_repeats_must_be_positive():
    with pytest.raises(ValueError, match="at least 1, got 0"):
        harness.measure(lambda: None, repeats=0)


def test_report_appends_lines_of_json_and_prints_them(tmp_path, capsys):
    output = tmp_path / "folder" / "lines.jsonl"
    harness.report(LINE, output)
    harness.report({**LINE, "error": np.float32(0.5), "bytes": jnp.int32(4)}, output)
    lines = [json.loads(text) for text in output.read_text().splitlines()]
    assert lines == [LINE, {**LINE, "error": 0.5, "bytes": 4}]
    assert capsys.readouterr().out == output.read_text()


def test_ratio_is_how_many_times_slower_the_peer_is():
    line = harness.report({**LINE, "peer": "p", "peer_seconds": 6.0, "peer_error": 0.0})
    assert line["ratio"] == 3.0


def test_report_names_what_is_missing():
    with pytest.raises(ValueError, match="bytes is missing"):
        harness.report({key: value for key, value in LINE.items() if key != "bytes"})
    with pytest.raises(ValueError, match="peer_error is missing"):
        harness.report({**LINE, "peer": "p", "peer_seconds": 6.0})


def test_report_refuses_nan():
    with pytest.raises(ValueError, match="error = nan"):
        harness.report({**LINE, "error": float("nan")})


def test_parser_reads_the_two_shared_options(tmp_path):
    arguments = harness.parser("d").parse_args(["--quick", "--output", str(tmp_path / "o")])
    assert arguments.quick
    assert arguments.output == tmp_path / "o"
    assert harness.parser("d").parse_args([]).output is None


def test_peak_memory_is_in_bytes():
    assert 1e7 < harness.peak_memory() < 1e12  # Python with JAX, on a machine of less than a terabyte
