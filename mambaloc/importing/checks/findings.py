"""What checks of a capture found, and what that comes to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Finding:
    """One thing that was checked.

    Args:
        name: what.
        message: the result, in a line.
        concern: why care is needed, in a line; empty where none is.
        is_fatal: nothing can be trained because of it.
        figures: what was measured.
    """

    name: str
    message: str
    concern: str = ""
    is_fatal: bool = False
    figures: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class ImportStatus:
    """``usable``, ``usable, but ...`` or ``not usable: ...``."""

    is_usable: bool
    reasons: tuple[str, ...]

    def in_words(self) -> tuple[str, tuple[str, ...]]:
        """What leads, and the reasons after it."""
        lead = "usable" if self.is_usable else "not usable:"
        return lead + ", but" * (self.is_usable and bool(self.reasons)), self.reasons

    def __str__(self) -> str:
        lead, reasons = self.in_words()
        return f"{lead} {'; '.join(reasons)}".strip()


def verdict_of(findings: Sequence[Finding]) -> ImportStatus:
    """Sum up: what is fatal alone, where anything is."""
    fatal = tuple(finding.concern for finding in findings if finding.is_fatal)
    concerns = tuple(finding.concern for finding in findings if finding.concern)
    return ImportStatus(not fatal, fatal or concerns)
