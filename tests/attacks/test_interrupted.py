"""Killed at each step, in the middle of a write, or out of space: nothing half-written is read, and nothing is lost.

The middle of a write is where a file would outgrow a limit, at which the kernel ends the process; with that signal
ignored, as Python has it, the write fails as on a full disk.
"""

import os
import resource
import signal
from functools import partial
from pathlib import Path

import pytest
from attacked import assert_goes_on, assert_one_line, audited, outcome_of, spread
from subjects import CONVERSION, SUBJECTS

pytestmark = pytest.mark.slow


def kill_before(step: int, below: Path) -> None:
    audited(below, lambda at: os.kill(os.getpid(), signal.SIGKILL) if at == step else None)


def limit(size: int, how, below: Path) -> None:
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
    signal.signal(signal.SIGXFSZ, how)


def sizes(largest: int, tries: int) -> list[int]:
    """In the middle of the largest file, then ever smaller: of most files no byte is written past the last."""
    return sorted({int(largest ** (1 - n / tries) / 2) for n in range(tries)}, reverse=True)


@pytest.mark.parametrize("name", SUBJECTS)
def test_killed_before_any_step(name, inputs, undisturbed, tmp_path, tries, tally):
    subject = SUBJECTS[name]
    for step in spread(undisturbed(name).steps, tries):
        out = tmp_path / f"step {step}"
        assert outcome_of(subject, inputs, out, partial(kill_before, step))[0] is None
        finished = subject.check(out)
        tally(f"{name}: kill -9 before a step", "whole by then" if finished else "nothing to read, made again")
        assert_goes_on(subject, inputs, out)


@pytest.mark.parametrize("name", SUBJECTS)
@pytest.mark.parametrize("how", ["killed", "full disk"])
def test_a_write_that_cannot_end(name, how, inputs, undisturbed, tmp_path, tries, tally):
    subject = SUBJECTS[name]
    signals = {"killed": signal.SIG_DFL, "full disk": signal.SIG_IGN}
    for size in sizes(undisturbed(name).largest_bytes, tries):
        out = tmp_path / f"{size} bytes"
        code, stderr, _ = outcome_of(subject, inputs, out, partial(limit, size, signals[how]))
        if code is None:
            assert how == "killed"
        else:  # a sweep also where one of its trainings was killed
            assert code == 2
            assert_one_line(stderr)
        tally(f"{name}: {how} within a write", "one line, exit code 2" if code else "killed")
        assert_goes_on(subject, inputs, out)


def test_a_conversion_is_killed_within_its_write(inputs, undisturbed, tmp_path):
    """The file that other exports are given here is written as the exporter itself writes it."""
    half = partial(limit, undisturbed("export").largest_bytes // 2, signal.SIG_DFL)
    assert outcome_of(CONVERSION, inputs, tmp_path, half)[0] is None
    assert not (tmp_path / "model.onnx").exists()
    assert_goes_on(SUBJECTS["export"], inputs, tmp_path)
