"""An operation in a process of its own, attacked there, or with another beside it.

A step is a file opened for writing, made, renamed or removed, of which Python tells its audit hooks before it happens.
"""

import contextlib
import io
import multiprocessing
import os
import signal
import sys
from dataclasses import dataclass
from pathlib import Path

from subjects import Subject

from mambaloc.console import configure_logging, exit_on_input_error

SERVER = multiprocessing.get_context("forkserver")
# Not the subjects themselves: before Python 3.12.8 the server knows nothing of pytest's paths, and does not say so.
SERVER.set_forkserver_preload(["mambaloc.cli", "mambaloc.importing.importer", "mambaloc.sweep.report", "mambaloc.zoo"])


def audited(below: Path, deed) -> None:
    """Call ``deed(step)`` before each step of this process below a folder."""
    step = 0

    def hook(event, arguments):
        nonlocal step
        if event not in ("open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "sqlite3.connect"):
            return
        path, *rest = arguments
        writes = event != "open" or bool(rest[1] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))
        if writes and isinstance(path, str | bytes | os.PathLike) and os.fsdecode(path).startswith(str(below)):
            step += 1
            deed(step)

    sys.addaudithook(hook)


def run(subject: Subject, inputs: Path, out: Path, attack, said) -> None:
    """In a process of its own: attack it, and send what it said and the steps that it took."""
    configure_logging()
    steps: list[int] = []
    audited(out, steps.append)
    attack(out)
    stderr = io.StringIO()
    code = 0
    with contextlib.redirect_stderr(stderr), contextlib.redirect_stdout(io.StringIO()):
        try:
            exit_on_input_error(subject.make)(inputs, out)
        except SystemExit as end:
            code = end.code
    said.send((code, stderr.getvalue(), len(steps)))


class Attacked:
    """A process that works under an attack, from now on."""

    def __init__(self, subject: Subject, inputs: Path, out: Path, attack) -> None:
        out.mkdir(exist_ok=True)
        self._told, said = SERVER.Pipe(duplex=False)
        self._process = SERVER.Process(target=run, args=(subject, inputs, out, attack, said))
        self._process.start()
        said.close()

    def outcome(self) -> tuple[int | None, str, int]:
        """Exit code, stderr and steps, once it ends; None for the first where it was killed."""
        try:
            found = self._told.recv()
        except EOFError:
            found = (None, "", 0)
        self._process.join()
        if found[0] is None:
            code = self._process.exitcode
            assert code in (-signal.SIGKILL, -signal.SIGXFSZ), f"exit code {code}: a traceback"
        return found


def outcome_of(subject, inputs, out, attack) -> tuple[int | None, str, int]:
    """Exit code, stderr and steps of an attacked process; None for the first where it was killed."""
    return Attacked(subject, inputs, out, attack).outcome()


def leave_alone(below: Path) -> None:
    """No attack."""


@dataclass(frozen=True)
class Undisturbed:
    """An operation that nobody attacks.

    Args:
        steps: how many it takes.
        largest_bytes: size of the largest file that it leaves.
    """

    steps: int
    largest_bytes: int


def undisturbed_run(subject, inputs, out) -> Undisturbed:
    """Run an operation that nobody attacks, and check what it made."""
    code, stderr, steps = outcome_of(subject, inputs, out, leave_alone)
    assert code == 0, stderr
    assert subject.check(out)
    return Undisturbed(steps, max(path.stat().st_size for path in out.rglob("*") if path.is_file()))


def spread(count: int, tries: int) -> list[int]:
    """So many of 1..count, evenly spread: all of them where there are no more."""
    tries = min(count, tries)
    return [1 + int((n + 0.5) * count / tries) if tries < count else 1 + n for n in range(tries)]


def assert_one_line(stderr: str) -> None:
    """What was said is what is wrong, and what to do, in one line."""
    lines = [line for line in stderr.splitlines() if line.strip() and not line.startswith("failed: ")]  # of a cell
    assert len(lines) == 1, stderr
    assert lines[0].startswith("error: ")
    assert "; " in lines[0]


def assert_goes_on(subject, inputs, out):
    """What lies there can be read, and the same command finishes it."""
    subject.check(out)
    code, stderr, _ = outcome_of(subject, inputs, out, leave_alone)
    assert (code, stderr.strip()) == (0, "")
    assert subject.check(out)
