"""Which formats there are, and which one a source is in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mambaloc.errors import InputError
from mambaloc.importing import nerfstudio
from mambaloc.importing.capture import Capture


@dataclass(frozen=True)
class Format:
    """A kind of capture.

    Args:
        looks_like: what a person sees, for messages.
        matches: whether a source is in it, by the names of its files alone.
        read: read it; raises :class:`InputError` that names the file, the rule and the remedy.
    """

    looks_like: str
    matches: Callable[[Path], bool]
    read: Callable[[Path], Capture]


FORMATS: dict[str, Format] = {
    "nerfstudio": Format("transforms.json of nerfstudio or instant-ngp", nerfstudio.matches, nerfstudio.read),
}
"""By name, the most telling first: the first that matches a source is taken."""


def read_capture(source: Path, kind: str | None = None) -> Capture:
    """Read a capture, in the format that its files look like unless one is named.

    Raises:
        InputError: where there is no such source or format, or it cannot be read.
    """
    if not source.exists():
        raise InputError(f"{source}: there is no such file or folder; give a capture's")
    if kind is not None and kind not in FORMATS:
        raise InputError(f"--format {kind}: there is none; choose one of {', '.join(FORMATS)}")
    kind = kind or next((name for name, known in FORMATS.items() if known.matches(source)), None)
    if kind is None:
        known = "; ".join(f"{name}: {each.looks_like}" for name, each in FORMATS.items())
        raise InputError(f"{source}: looks like no format that is known ({known}); name it with --format")
    return FORMATS[kind].read(source)
