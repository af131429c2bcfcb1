"""Counts the programs that each test file asks the compiler for, and holds the counts to kept ones.

Compiling is most of the time of the tests, so a file that asks for more programs makes every run longer. A program is
counted by the key that it has in JAX's persistent cache, once for each file, whether it is compiled or found there.
What an earlier file of the same process has asked for may still be in its memory; such programs reach no compiler and
are not counted. A count is therefore at most that of the file alone, which is kept in `programs.json`, and files that
run alone, in part, or without data never exceed it. The distinct programs of a whole run do not depend on how files
share processes; their number is kept for each selection by markers. Processor seconds of files are printed only.

`pytest --keep-programs` forgets what is compiled before each file and writes the counts of the files that run.
"""

import json
import pathlib
import time
from collections.abc import Callable
from typing import Any

import jax
import pytest

KEPT = pathlib.Path(__file__).with_suffix(".json")
MORE, ALWAYS = 0.1, 10  # of a kept count, and programs beyond that, which a file may have more
SHOWN = 10  # files with the most programs


class Programs:
    """A plugin of pytest, in the process that reports and in each worker.

    Attributes:
        root: Folder that names of files start from.
        keep: Whether to write the counts.
        forget: Forgets what is compiled.
        file: The file that runs.
        program: Programs of each file, as parts of their keys.
        seconds: Processor seconds of each file, with all threads, without other processes.
        excess: Files, and runs, that have more programs than kept; they fail the run.
        unknown: Files without a kept count; they are only named.
    """

    def __init__(self, config: pytest.Config, forget: Callable[[], None]):
        self.root, self.keep, self.forget = config.rootpath, config.getoption("--keep-programs"), forget
        self.file = ""
        self.program: dict[str, set[str]] = {}
        self.seconds: dict[str, float] = {}
        self._start = time.process_time()
        self.excess: list[str] = []
        self.unknown: list[str] = []

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> None:
        """Counts what is compiled from here on for the file of the next test."""
        file = item.path.relative_to(self.root).as_posix()
        if self.keep and file != self.file:
            self.forget()
        self._switch(file)

    def _switch(self, file: str) -> None:
        """Adds the time since the last test started to its file."""
        now = time.process_time()
        if self.file:
            self.seconds[self.file] = self.seconds.get(self.file, 0.0) + now - self._start
        self.file, self._start = file, now

    def count(self, key: str) -> None:
        """Counts a program for the file that runs; what importing files compiles counts for none."""
        if self.file:
            self.program.setdefault(self.file, set()).add(key[-12:])

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node: Any) -> None:
        """Takes over what a worker has counted."""
        output = getattr(node, "workeroutput", {})
        for file, keys in output.get("programs", {}).items():
            self.program.setdefault(file, set()).update(keys)
        for file, seconds in output.get("seconds", {}).items():
            self.seconds[file] = self.seconds.get(file, 0.0) + seconds

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Hands a worker's counts over; elsewhere compares them, and fails the run where they exceed the kept ones."""
        config = session.config
        self._switch("")
        if hasattr(config, "workeroutput"):
            config.workeroutput["programs"] = {file: sorted(keys) for file, keys in self.program.items()}
            config.workeroutput["seconds"] = self.seconds
            return
        counts = {file: len(keys) for file, keys in sorted(self.program.items())}
        distinct = len(set().union(*self.program.values()))
        kept = json.loads(KEPT.read_text()) if KEPT.exists() else {"jax": "", "run": {}, "file": {}}
        if self.keep:
            whole = config.args_source is config.ArgsSource.TESTPATHS and not config.option.keyword
            kept["jax"] = jax.__version__
            kept["run"] |= {config.option.markexpr: distinct} if whole else {}
            every = kept["file"] | counts
            kept["file"] = {file: every[file] for file in sorted(every) if (self.root / file).exists()}
            KEPT.write_text(json.dumps(kept, indent=2) + "\n")
        elif kept["jax"] == jax.__version__:  # Another version divides the same work into other programs.
            self.excess = exceeding(counts, kept["file"])
            self.excess += exceeding({config.option.markexpr: distinct}, kept["run"])
            self.unknown = [file for file in counts if file not in kept["file"]]
        if self.excess and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Prints the files with the most programs, and those with too many."""
        if not self.program:
            return
        terminalreporter.section("programs and processor seconds of test files")
        most = sorted(self.program, key=lambda file: -len(self.program[file]))
        for file in most[: len(most) if self.keep else SHOWN]:
            terminalreporter.write_line(f"{len(self.program[file]):6,} {self.seconds[file]:8.1f} {file}")
        distinct, seconds = len(set().union(*self.program.values())), sum(self.seconds.values())
        terminalreporter.write_line(f"{distinct:6,} {seconds:8.1f} in all, each program once")
        for line in self.excess:
            terminalreporter.write_line(f"FAILED {line}", red=True)
        if self.excess:
            terminalreporter.write_line("Share programs, or keep the counts: pytest --keep-programs FILES", red=True)
        if self.unknown:
            more = f" and {len(self.unknown) - SHOWN} more" if len(self.unknown) > SHOWN else ""
            terminalreporter.write_line(f"without kept counts: {', '.join(self.unknown[:SHOWN])}{more}")


def exceeding(counts: dict[str, int], kept: dict[str, int]) -> list[str]:
    """Names whose counts are noticeably above the kept ones, with both numbers."""
    return [
        f"{name} asks for {count:,} programs, {kept[name]:,} are kept"
        for name, count in counts.items()
        if name in kept and count > kept[name] * (1 + MORE) + ALWAYS
    ]


def watch(count: Callable[[str], None]) -> None:
    """Calls `count` with the cache key of every program that is compiled or found in the persistent cache.

    JAX reports no keys, so this wraps one of its internal functions. Where a version has no such function, nothing is
    counted and nothing can exceed a kept count.
    """
    from jax._src import compilation_cache

    original = getattr(compilation_cache, "get_cache_key", None)
    if original is None:
        return

    def get_cache_key(*arguments: Any, **options: Any) -> str:
        key = original(*arguments, **options)
        count(key)
        return key

    compilation_cache.get_cache_key = get_cache_key
