"""Where results are kept: one SQLite file, to which a finished trial is written in one transaction."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from mambaloc.errors import InputError
from mambaloc.sweep.trials import Trial

STORE_FILE = "results.sqlite"
_TABLE = """
CREATE TABLE IF NOT EXISTS trials (
    key TEXT PRIMARY KEY,
    labels TEXT NOT NULL,
    args TEXT NOT NULL,
    error TEXT,
    results TEXT NOT NULL,
    seconds REAL NOT NULL,
    ended TEXT NOT NULL
)
"""
_RENAMES = ("ALTER TABLE cells RENAME TO trials", "ALTER TABLE trials RENAME COLUMN words TO args")
"""For a store written when trials were called cells, and their arguments words."""


@dataclass(frozen=True)
class StoredTrial:
    """A trial that ended.

    Args:
        key: of the trial.
        labels: its place on each axis.
        args: of the command.
        error: why it failed; None where it did not.
        results: what each evaluation says, by epoch (``best``, ``last``): ``metrics.json``, and each frame's errors.
        seconds: from its process's start to its end.
        ended: when, ISO 8601, UTC.
    """

    key: str
    labels: dict[str, str]
    args: list[str]
    error: str | None
    results: dict[str, dict[str, Any]]
    seconds: float
    ended: str


class Store:
    """The results of a sweep in a folder; a context manager.

    Args:
        folder: holds ``results.sqlite``, and is made if missing.

    Raises:
        InputError: where it cannot be written, or holds another kind of file of that name.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / STORE_FILE
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._database = sqlite3.connect(self.path)
            if self._is_old():
                with self._database:
                    self._database.execute("BEGIN IMMEDIATE")
                    for rename in _RENAMES if self._is_old() else ():  # another process may have done it meanwhile
                        self._database.execute(rename)
            with self._database:
                self._database.execute(_TABLE)
        except OSError as error:
            raise InputError(f"{folder}: cannot be written ({error.strerror}); choose another --out") from None
        except sqlite3.OperationalError as error:
            raise InputError(f"{self.path}: cannot be written ({error}); choose another --out") from None
        except sqlite3.Error as error:
            raise InputError(f"{self.path}: is not a store of results ({error}); choose another --out") from None

    def _is_old(self) -> bool:
        return bool(self._database.execute("SELECT 1 FROM sqlite_master WHERE name = 'cells'").fetchone())

    @classmethod
    def ended(cls, folder: Path) -> dict[str, StoredTrial]:
        """Return :meth:`read` of a folder's store; empty without one, which is not made."""
        if not (folder / STORE_FILE).is_file():
            return {}
        with cls(folder) as store:
            return store.read()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._database.close()

    def write(self, trial: Trial, results: dict[str, dict[str, Any]], seconds: float, error: str | None = None) -> None:
        """Keep how a trial ended; what was kept of an earlier try is replaced.

        Raises:
            InputError: where it cannot be written; what it held, it holds.
        """
        ended = datetime.now(UTC).isoformat(timespec="seconds")
        row = (
            trial.key,
            json.dumps(dict(trial.labels)),
            json.dumps(trial.args),
            error,
            json.dumps(results),
            seconds,
            ended,
        )
        with self._report_errors("free some space, and run the sweep again"), self._database:
            self._database.execute("INSERT OR REPLACE INTO trials VALUES (?, ?, ?, ?, ?, ?, ?)", row)

    def read(self) -> dict[str, StoredTrial]:
        """Every trial that ended, by key, in the order they did.

        Raises:
            InputError: where the file is damaged.
        """
        with self._report_errors("put a copy in its place, or choose another --out"):
            rows = self._database.execute(
                "SELECT key, labels, args, error, results, seconds, ended FROM trials ORDER BY rowid"
            ).fetchall()
            return {
                key: StoredTrial(key, json.loads(labels), json.loads(args), error, json.loads(results), seconds, ended)
                for key, labels, args, error, results, seconds, ended in rows
            }

    @contextmanager
    def _report_errors(self, remedy: str) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, ValueError, TypeError, RecursionError) as error:  # a damaged row is not JSON, or no text
            raise InputError(f"{self.path}: cannot be used ({str(error).splitlines()[0]}); {remedy}") from None
