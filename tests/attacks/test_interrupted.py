"""Killed at each step, in the middle of a write, or out of space: nothing half-written is read, and nothing is lost.

A step is a file opened for writing, made, renamed or removed, which Python tells its audit hooks before it happens. The
middle of a write is where a file would outgrow a limit, at which the kernel ends the process; with that signal ignored,
as Python has it, the write fails as on a full disk.
"""

import contextlib
import io
import multiprocessing
import os
import resource
import signal
import sys
from functools import partial
from pathlib import Path

import pytest
import yaml
from subjects import SUBJECTS, Subject

from mambaloc.cli import main
from mambaloc.console import exits_cleanly, quieten

pytestmark = pytest.mark.slow

SERVER = multiprocessing.get_context("forkserver")
SERVER.set_forkserver_preload(["subjects"])


@pytest.fixture(scope="session")
def inputs(scenes, tmp_path_factory):
    """A scene, a recipe, and a training that it led to."""
    folder = tmp_path_factory.mktemp("inputs")
    (folder / "scenes").symlink_to(scenes)
    model = {"backbone": "resnet10t", "dim": 16, "heads": 2, "encoder_layers": 1, "feedforward": 16, "head_hidden": 16}
    data = {"root": str(scenes), "scene": "heads", "image_size": [32, 36], "short_side": 36, "validation": "sequences"}
    recipe = {
        "model": {"class_path": "LitMambaLoc", "init_args": {**model, "normalise_position": True}},
        "data": data,
        "trainer": {"max_epochs": 3, "accelerator": "cpu"},
        "onnx_export": {"enabled": False},
    }
    (folder / "recipe.yaml").write_text(yaml.safe_dump(recipe))
    main([str(folder / "recipe.yaml"), "--trainer.default_root_dir", str(folder / "run")])
    return folder


def audited(below: Path, deed) -> None:
    """Call ``deed(step)`` before each step of this process below a folder."""
    step = 0

    def hook(event, arguments):
        nonlocal step
        if event not in ("open", "os.mkdir", "os.rename", "os.remove", "os.rmdir"):
            return
        path, *rest = arguments
        writes = event != "open" or bool(rest[1] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))
        if writes and isinstance(path, str | bytes | os.PathLike) and os.fsdecode(path).startswith(str(below)):
            step += 1
            deed(step)

    sys.addaudithook(hook)


def run(subject: Subject, inputs: Path, out: Path, attack, said) -> None:
    """In a process of its own: attack it, and send what it said and the steps that it took."""
    quieten()
    steps: list[int] = []
    audited(out, steps.append)
    attack(out)
    stderr = io.StringIO()
    code = 0
    with contextlib.redirect_stderr(stderr), contextlib.redirect_stdout(io.StringIO()):
        try:
            exits_cleanly(subject.make)(inputs, out)
        except SystemExit as end:
            code = end.code
    said.send((code, stderr.getvalue(), len(steps)))


def outcome_of(subject, inputs, out, attack) -> tuple[int | None, str, int]:
    """Exit code, stderr and steps of an attacked process; None for the first where it was killed."""
    out.mkdir(exist_ok=True)
    told, said = SERVER.Pipe(duplex=False)
    process = SERVER.Process(target=run, args=(subject, inputs, out, attack, said))
    process.start()
    said.close()
    try:
        found = told.recv()
    except EOFError:
        found = (None, "", 0)
    process.join()
    if found[0] is None:
        assert process.exitcode in (-signal.SIGKILL, -signal.SIGXFSZ), f"exit code {process.exitcode}: a traceback"
    return found


def leave_alone(below: Path) -> None:
    """No attack."""


def kill_before(step: int, below: Path) -> None:
    audited(below, lambda at: os.kill(os.getpid(), signal.SIGKILL) if at == step else None)


def limit(size: int, how, below: Path) -> None:
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
    signal.signal(signal.SIGXFSZ, how)


def spread(count: int, tries: int) -> list[int]:
    """So many of 1..count, evenly spread: all of them where there are no more."""
    tries = min(count, tries)
    return [1 + int((n + 0.5) * count / tries) if tries < count else 1 + n for n in range(tries)]


def assert_goes_on(subject, inputs, out):
    """What lies there can be read, and the same command finishes it."""
    subject.check(out)
    code, stderr, _ = outcome_of(subject, inputs, out, leave_alone)
    assert (code, stderr.strip()) == (0, "")
    assert subject.check(out)


@pytest.mark.parametrize("name", SUBJECTS)
def test_killed_before_any_step(name, inputs, tmp_path, tries, tally):
    subject = SUBJECTS[name]
    code, _, steps = outcome_of(subject, inputs, tmp_path / "whole", leave_alone)
    assert code == 0
    assert subject.check(tmp_path / "whole")
    for step in spread(steps, tries):
        out = tmp_path / f"step {step}"
        assert outcome_of(subject, inputs, out, partial(kill_before, step))[0] is None
        finished = subject.check(out)
        tally(f"{name}: kill -9 before a step", "whole by then" if finished else "nothing to read, made anew")
        assert_goes_on(subject, inputs, out)


@pytest.mark.parametrize("name", SUBJECTS)
@pytest.mark.parametrize("how", ["killed", "full disk"])
def test_a_write_that_cannot_end(name, how, inputs, tmp_path, tries, tally):
    subject = SUBJECTS[name]
    assert outcome_of(subject, inputs, tmp_path / "whole", leave_alone)[0] == 0
    largest = max(path.stat().st_size for path in (tmp_path / "whole").rglob("*") if path.is_file())
    signals = {"killed": signal.SIG_DFL, "full disk": signal.SIG_IGN}
    for size in spread(largest, tries):
        out = tmp_path / f"{size} bytes"
        code, stderr, _ = outcome_of(subject, inputs, out, partial(limit, size - 1, signals[how]))
        assert code is None if how == "killed" else code == 2
        if how == "full disk":
            assert stderr.strip().startswith("error: ")
            assert stderr.strip().count("\n") == 0
        tally(f"{name}: {how} within a write", "one line, exit code 2" if code else "killed")
        assert_goes_on(subject, inputs, out)
