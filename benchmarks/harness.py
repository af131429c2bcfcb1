"""Times functions, alone or against a peer, and reports each measurement as one line of JSON.

    arguments = harness.parser("What the relighting of a frame costs.").parse_args()
    mine, peer = harness.compare(lambda: radiance(light), lambda: matrix @ vector, repeats=20)
    harness.report({"benchmark": "relight", "case": "bunny", **mine.line(), "error": 2e-2, "bytes": 10,
                    "peer": "scipy CSR", **peer.peer(), "peer_error": 0.0}, arguments.output)

An absolute time is a fact about a machine; a ratio and an error are facts about the program.
"""

import argparse
import concurrent.futures
import json
import math
import os
import pathlib
import resource
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

_THREADS = 2
_KEYS = ("benchmark", "case", "seconds", "compile_seconds", "error", "bytes")
_PEER_KEYS = ("peer", "peer_seconds", "peer_error")


class Timing(NamedTuple):
    """How long a function took.

    Attributes:
        seconds: Median over the repeated calls.
        compile_seconds: The first call, which traces and compiles, less that median; at least zero.
        repeats: How many calls the median is of.
        spread: Half the distance between the quartiles of these calls, relative to the median.
    """

    seconds: float
    compile_seconds: float
    repeats: int
    spread: float = 0.0

    def line(self) -> dict[str, float]:
        """The keys of a reported line."""
        return {"seconds": self.seconds, "compile_seconds": self.compile_seconds, "spread": self.spread}

    def peer(self) -> dict[str, float]:
        """The keys of a reported line, for the peer."""
        return {"peer_seconds": self.seconds, "peer_spread": self.spread}


def parser(description: str) -> argparse.ArgumentParser:
    """Command line that every benchmark shares; a benchmark may add options of its own."""
    result = argparse.ArgumentParser(description=description)
    result.add_argument("--quick", action="store_true", help="a small case, within 60 s on two cores")
    result.add_argument("--output", type=pathlib.Path, metavar="FILE", help="append the JSON lines to FILE")
    return result


def measure(function: Callable[[], Any], *, repeats: int) -> Timing:
    """Times a function of no arguments until its result is ready.

    Args:
        function: What to time. JAX work is waited for.
        repeats: Calls after the first, which is told apart since it compiles.

    Returns:
        The median, and what the first call took beyond it.

    Raises:
        ValueError: There are no repeats.
    """
    return alternate([function], repeats=repeats)[0]


def compare(function: Callable[[], Any], peer: Callable[[], Any], *, repeats: int) -> tuple[Timing, Timing]:
    """Times two functions alternately, so that whatever else the machine does meets both alike.

    Each is called once more before each call that is timed. Otherwise it would find the caches full of the other's
    data, which costs the faster one more: a light change of 83 MB took 14.7 ms beside scipy's, alone 10.6.

    Args:
        function: What to time.
        peer: What to time it against, on the same input.
        repeats: Calls of each after the first.

    Returns:
        Timings as from ``measure``.

    Raises:
        ValueError: There are no repeats.
    """
    mine, theirs = alternate([function, peer], repeats=repeats)
    return mine, theirs


def alternate(functions: Sequence[Callable[[], Any]], *, repeats: int) -> list[Timing]:
    """Times several functions in turn, as `compare` does two.

    Functions that are timed one after another differ by what the process and the machine do meanwhile: frames of
    drawing that were timed first took up to half as long again as the same frames later.

    Args:
        functions: What to time.
        repeats: Calls of each after the first.

    Returns:
        Timings as from ``measure``, in the same order.

    Raises:
        ValueError: There are no repeats.
    """
    if repeats < 1:
        raise ValueError(f"repeats must be at least 1, got {repeats}")
    first = [_seconds(function) for function in functions]
    times: list[list[float]] = [[] for _ in functions]
    for _ in range(repeats):
        for function, calls in zip(functions, times, strict=True):
            if len(functions) > 1:
                jax.block_until_ready(function())
            calls.append(_seconds(function))
    return [_timing(call, calls) for call, calls in zip(first, times, strict=True)]


def report(line: Mapping[str, Any], output: pathlib.Path | None = None) -> dict[str, Any]:
    """Prints a measurement as one line of JSON and appends it to a file.

    Args:
        line: ``benchmark`` and ``case`` (names), ``seconds``, ``compile_seconds``, ``error`` (relative) and
            ``bytes`` (of what is stored), None where the case has none; where there is a peer also ``peer``
            (its name), ``peer_seconds`` and ``peer_error``. Further keys are kept as they are.
        output: The file; None prints only.

    Returns:
        The line as reported: with ``ratio`` = peer_seconds / seconds where there is a peer.

    Raises:
        ValueError: A key is missing, or a number is NaN or infinite.
    """
    expected = _KEYS + (_PEER_KEYS if any(key in line for key in _PEER_KEYS) else ())
    missing = [key for key in expected if key not in line]
    if missing:
        raise ValueError(f"a line must have {', '.join(expected)}; {', '.join(missing)} is missing")
    line = {key: value.item() if hasattr(value, "item") else value for key, value in line.items()}
    wrong = [key for key, value in line.items() if isinstance(value, float) and not math.isfinite(value)]
    if wrong:
        raise ValueError(f"numbers must be finite, got {', '.join(f'{key} = {line[key]}' for key in wrong)}")
    if "peer" in line:
        line["ratio"] = line["peer_seconds"] / line["seconds"]
    text = json.dumps(line)
    print(text, flush=True)
    if output is not None:
        output.parent.mkdir(parents=True, exist_ok=True)
        with output.open("a", encoding="utf-8") as file:
            file.write(text + "\n")
    return line


def data() -> pathlib.Path:
    """The folder of real meshes and lights, JAXPRT_DATA; one that does not exist where it is not set."""
    return pathlib.Path(os.environ.get("JAXPRT_DATA", "missing"))


def reader(arrays: Sequence[np.ndarray]) -> Callable[[], Any]:
    """A function that reads every byte of some arrays once, on two threads."""
    words = [np.ascontiguousarray(array).ravel().view(np.uint8) for array in arrays]
    words = [flat[: len(flat) // 8 * 8].view(np.uint64) for flat in words]
    parts = [part for flat in words for part in np.array_split(flat, _THREADS)]
    pool = concurrent.futures.ThreadPoolExecutor(_THREADS)
    return lambda: list(pool.map(np.bitwise_xor.reduce, parts))


def peak_memory() -> int:
    """Largest resident set of this process so far, in bytes; what a GPU holds is not in it."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak  # macOS counts bytes, Linux KiB.


def _timing(first: float, times: list[float]) -> Timing:
    median = statistics.median(times)
    low, high = np.quantile(times, (0.25, 0.75)).tolist()
    spread = (high - low) / (2 * median) if median else 0.0
    return Timing(median, max(first - median, 0.0), len(times), spread)


def _seconds(function: Callable[[], Any]) -> float:
    start = time.perf_counter()
    jax.block_until_ready(function())
    return time.perf_counter() - start
