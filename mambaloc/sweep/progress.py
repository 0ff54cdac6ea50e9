"""What a running sweep shows: counts, what runs, what failed, and how long it may take."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from datetime import timedelta
from types import TracebackType
from typing import Self

from rich import box
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from mambaloc.sweep.store import StoredTrial
from mambaloc.sweep.trials import Sweep, Trial

_FAILURES = 5  # shown at most


def print_plan(sweep: Sweep, ended: Mapping[str, StoredTrial]) -> None:
    """Print a row a trial: its place, whether it ended, and the seconds it took, or trials of its system on average.

    Args:
        sweep: to run.
        ended: trials that the store holds, by key.
    """
    first = next(iter(sweep.trials[0].labels))
    seconds: dict[str, list[float]] = {}
    for kept in ended.values():
        if kept.error is None:
            seconds.setdefault(kept.labels.get(first, ""), []).append(kept.seconds)
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    for axis in (*sweep.trials[0].labels, "state"):
        table.add_column(axis)
    table.add_column("seconds", justify="right")
    due = 0.0
    for trial in sweep.trials:
        before, like = ended.get(trial.key), seconds.get(trial.labels[first])
        expected = before.seconds if before else sum(like) / len(like) if like else None
        state = "to run" if before is None else "done" if before.error is None else f"failed: {before.error}"
        due += 0.0 if before or expected is None else expected
        table.add_row(*trial.labels.values(), state, "" if expected is None else f"{expected:.0f}")
    console = Console(highlight=False)
    console.print(table)
    known = "" if not seconds else f", about {timedelta(seconds=int(due))} one after another, as far as is known"
    console.print(f"{len(sweep.trials)} trials, {sum(trial.key not in ended for trial in sweep.trials)} to run{known}")


class SweepProgress:
    """A live table on stderr; a context manager.

    Args:
        sweep: that runs.
        kept: its trials that had ended before.
    """

    def __init__(self, sweep: Sweep, kept: Sequence[StoredTrial]) -> None:
        self._total = len(sweep.trials)
        self._seconds = [trial.seconds for trial in kept if trial.error is None]
        self._failures = [" ".join(trial.labels.values()) + f": {trial.error}" for trial in kept if trial.error]
        self._ended = len(kept)
        self._running: dict[str, tuple[str, float]] = {}
        self._console = Console(stderr=True)
        self._live = Live(get_renderable=self._draw, console=self._console, transient=True, refresh_per_second=1)

    def __enter__(self) -> Self:
        self._live.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._live.__exit__(kind, error, traceback)

    def started(self, trial: Trial) -> None:
        """A trial's turn came."""
        self._running[trial.key] = (trial.name, time.monotonic())

    def ended(self, trial: Trial, seconds: float, error: str | None) -> None:
        """A trial is done, or failed."""
        self._running.pop(trial.key, None)
        self._ended += 1
        if error is None:
            self._seconds.append(seconds)
        else:
            self._failures.append(f"{trial.name}: {error}")
            self._console.print(f"failed: {self._failures[-1]}", highlight=False, soft_wrap=True)

    def seconds_left(self) -> float | None:
        """As the trials so far took on average, shared by those that run at once; None before the first ended."""
        if not self._seconds:
            return None
        mean = sum(self._seconds) / len(self._seconds)
        return mean * (self._total - self._ended) / max(1, len(self._running))

    def _draw(self) -> Group:
        table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
        table.add_column("running")
        table.add_column("for", justify="right")
        for name, since in self._running.values():
            table.add_row(name, str(timedelta(seconds=int(time.monotonic() - since))))
        left = self.seconds_left()
        soon = "" if left is None else f", about {timedelta(seconds=int(left))} left"
        counts = f"{self._ended} of {self._total} trials ended, {len(self._failures)} failed{soon}"
        return Group(Text(counts), table, *map(Text, self._failures[-_FAILURES:]))
