"""What is a user's to repair: errors, and warnings where the work can go on."""

from collections.abc import Collection
from difflib import get_close_matches

_MAX_LISTED = 50


class InputError(Exception):
    """A mistake in what the user gave: file, option or data.

    The message is one line that names the file or option, the rule it breaks and the remedy; tools print it and exit
    with code 2.
    """


class InputWarning(UserWarning):
    """Something that the user gave cannot be used, and the work goes on without it; tools print it as one line."""


def suggestion(name: str, known: Collection[str]) -> str:
    """What to write in place of an unknown name: a question for the closest, or all names where none is close.

    Of very many names none is listed.
    """
    by_lower = {each.lower(): each for each in known}
    close = get_close_matches(name.lower(), by_lower, n=1, cutoff=0.5)
    if close:
        return f"Did you mean {by_lower[close[0]]}?"
    if len(known) > _MAX_LISTED:
        return f"None of {len(known)} names is close to it."
    return f"Choose one of {', '.join(known)}."
