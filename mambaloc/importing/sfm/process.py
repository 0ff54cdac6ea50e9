"""Run :mod:`~mambaloc.importing.sfm.reconstruction` in a process of its own; pass on its progress and errors."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from rich.progress import Progress

from mambaloc.errors import InputError

_PROGRAM = Path(__file__).with_name("reconstruction.py")


@dataclass(frozen=True)
class Job:
    """What is to be reconstructed.

    Args:
        images: folder of the images.
        names: their files, in order.
        out: folder to write the largest model to, which is made.
        one_camera: whether the images share one; otherwise each has its own.
        neighbours: match each image with so many before and after it, and those 2, 4, 8, ... apart; None matches
            every pair.
        threads: that finding and matching features take; -1 for all.
        seed: of RANSAC.
    """

    images: Path
    names: Sequence[str]
    out: Path
    one_camera: bool
    neighbours: int | None
    threads: int
    seed: int


def reconstruct(job: Job, source: Path, remedy: str, progress: Progress) -> int:
    """Reconstruct in a new process, and show its steps.

    Args:
        job: what is to be done.
        source: of the images, for messages.
        remedy: what a user may do where COLMAP gives up.
        progress: gets a task for each step.

    Returns:
        How many images the largest model places; 0 without a model.

    Raises:
        InputError: where COLMAP gives up, or its process ends before its work.
    """
    placed, step, task = None, "Starting COLMAP", progress.add_task("Starting COLMAP", total=None)
    with TemporaryDirectory(dir=job.images.parent) as work:
        file, log = Path(work) / "job.json", Path(work) / "log.txt"
        fields = {**asdict(job), "database": Path(work) / "database.db"}
        file.write_text(json.dumps(fields, default=str), encoding="utf-8")
        with log.open("wb") as stderr, _started(file, stderr.fileno()) as process:
            try:
                for line in process.stdout or ():
                    message = json.loads(line)
                    if "error" in message:
                        raise InputError(f"{source}: COLMAP stopped ({message['error']}); {remedy}")
                    if "step" in message:
                        step = message["step"]
                        task = progress.add_task(step, total=message.get("of"))
                    progress.advance(task, message.get("advance", 0))
                    placed = message.get("placed", placed)
            except BaseException:  # Ctrl-C, too
                process.kill()
                raise
        if placed is None:
            reason = ", ".join([_ending(process.returncode), *_last_words(log)])
            raise InputError(
                f"{source}: the process of COLMAP ended at {step!r} ({reason}). Try again with more memory free, or "
                "pose the images with another tool and import what it exports."
            )
    return int(placed)


def _started(job: Path, stderr: int) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-P", str(_PROGRAM), str(job)],  # -P: the program's folder contains no modules for it
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=stderr,
        text=True,
        encoding="utf-8",
    )


def _ending(code: int) -> str:
    return f"exit code {code}" if code >= 0 else signal.Signals(-code).name


def _last_words(log: Path) -> list[str]:
    """The last line of a log, if there is one, that belongs to no stack trace of C++."""
    lines = [line.strip()[:200] for line in log.read_text(encoding="utf-8", errors="replace").splitlines()]
    return [line for line in lines if line and not line.startswith(("@", "***", "PC:"))][-1:]
