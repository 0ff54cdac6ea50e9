"""The one way in which a user's mistake is reported: a line, and exit code 2."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import wraps
from typing import Any


class InputError(Exception):
    """A mistake in what the user gave: file, option or data.

    The message is one line that names the file or option, the rule it breaks and the remedy.
    """


def exits_cleanly(main: Callable[..., Any]) -> Callable[..., Any]:
    """Make a tool's ``main`` print an :class:`InputError` as one line on stderr and exit with code 2."""

    @wraps(main)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        try:
            return main(*args, **kwargs)
        except InputError as error:
            print(f"error: {error}", file=sys.stderr)
            raise SystemExit(2) from None

    return wrapper
