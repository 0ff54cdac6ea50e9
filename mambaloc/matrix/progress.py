"""What a running matrix shows: counts, what runs, what failed, and how long it may take."""

from __future__ import annotations

import time
from collections.abc import Sequence
from datetime import timedelta
from types import TracebackType
from typing import Self

from rich import box
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from mambaloc.matrix.cells import Cell, Matrix
from mambaloc.matrix.store import StoredCell

_FAILURES = 5  # shown at most


class MatrixProgress:
    """A live table on stderr; a context manager.

    Args:
        matrix: that runs.
        kept: its cells that had ended before.
    """

    def __init__(self, matrix: Matrix, kept: Sequence[StoredCell]) -> None:
        self._total = len(matrix.cells)
        self._seconds = [cell.seconds for cell in kept if cell.error is None]
        self._failures = [" ".join(cell.labels.values()) + f": {cell.error}" for cell in kept if cell.error]
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

    def started(self, cell: Cell) -> None:
        """A cell's turn came."""
        self._running[cell.key] = (cell.name, time.monotonic())

    def ended(self, cell: Cell, seconds: float, error: str | None) -> None:
        """A cell is done, or failed."""
        self._running.pop(cell.key, None)
        self._ended += 1
        if error is None:
            self._seconds.append(seconds)
        else:
            self._failures.append(f"{cell.name}: {error}")
            self._console.print(f"failed: {self._failures[-1]}", highlight=False, soft_wrap=True)

    def seconds_left(self) -> float | None:
        """As the cells so far took on average, shared by those that run at once; None before the first ended."""
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
        counts = f"{self._ended} of {self._total} cells ended, {len(self._failures)} of them failed{soon}"
        return Group(Text(counts), table, *map(Text, self._failures[-_FAILURES:]))
