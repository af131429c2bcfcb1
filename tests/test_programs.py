"""The counts of programs that hold what test files may compile."""

import json

import jax
import numpy as np
import pytest

from tests import programs


@pytest.fixture
def counted(request):
    plugins = request.config.pluginmanager.get_plugins()
    return next(plugin for plugin in plugins if isinstance(plugin, programs.Programs))


def _jitted():
    return jax.jit(lambda x: x * 7 + 11)


def test_a_program_is_counted_once_for_the_file_that_runs(counted):
    file = "tests/test_programs.py"
    assert counted.file == file
    before = len(counted.program.get(file, ()))
    _jitted()(np.ones(3, np.float32))
    _jitted()(np.ones(3, np.float32))  # another function with the same program
    assert len(counted.program[file]) == before + 1
    _jitted()(np.ones(4, np.float32))
    assert len(counted.program[file]) == before + 2


def test_counts_may_exceed_kept_ones_by_a_tenth_and_ten():
    assert programs.exceeding({"a": 120, "b": 3}, {"a": 100, "b": 50, "c": 7}) == []
    (line,) = programs.exceeding({"a": 121}, {"a": 100})
    assert line == "a asks for 121 programs, 100 are kept"


def test_files_without_a_kept_count_are_not_held():
    assert programs.exceeding({"a": 1000}, {}) == []


def test_every_kept_file_exists(counted):
    kept = json.loads(programs.KEPT.read_text())
    assert all((counted.root / file).is_file() for file in kept["file"])
