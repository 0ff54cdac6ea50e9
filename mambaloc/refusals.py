"""What jsonargparse and Lightning refuse of a command, in one line."""

from __future__ import annotations

import re
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

from lightning.pytorch.cli import LightningArgumentParser

from mambaloc.errors import InputError, suggestion
from mambaloc.models import list_models
from mambaloc.models.registry import model_class


class OneLineErrorParser(LightningArgumentParser):
    """Parser that answers a wrong option in one line, without its page of usage."""

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        """Raise what is wrong as an :class:`~mambaloc.errors.InputError`."""
        reason = _without_chatter(str(message))
        unknown = re.search(r"Expected a dot import path string: (\w+)", reason)
        if unknown and '"model' in reason:
            systems = [model_class(name).__name__ for name in list_models()]
            closest = suggestion(unknown[1], systems)
            raise InputError(f"model.class_path {unknown[1]}: no such class. {closest}")
        remedy = "; --help lists the options"  # a subcommand's parser reports to its parent, which reports again
        raise InputError(reason.replace("typing.", "").removesuffix(remedy) + remedy)


def _without_chatter(message: str) -> str:
    """What is wrong, of a message of jsonargparse, in one line."""
    chatter = (
        *("Does not validate", "Subtypes:", "Errors:", "- Expected a <class 'NoneType'>", "Given value"),
        *("Subclass types expect", "- a class path", "- a dict "),
    )
    lines = [line.strip() for line in message.splitlines()]
    return " ".join(line.removeprefix("- ") for line in lines if line and not line.startswith(chatter))


_REFUSING = ("lightning", "lightning_utilities", "jsonargparse")  # this for what a recipe's class raises when built


def _our_refusal(error: BaseException | None) -> InputError | None:
    """Return the InputError that an error was raised from: jsonargparse makes a ValueError of what a class raises."""
    while error is not None and not isinstance(error, InputError):
        error = error.__cause__ or error.__context__
    return error


@contextmanager
def report_refusals(argv: list[str]) -> Iterator[None]:
    """Raise what Lightning itself refuses in the block, such as a trainer's option, in one line.

    Args:
        argv: the command's words, of which the option is named.

    Raises:
        InputError: for an error that Lightning's own code raises, and our own where jsonargparse wrapped it. What looks
            like a mistake in a program is raised as it is.
    """
    try:
        yield
    except (LookupError, AttributeError, AssertionError, NameError):
        raise
    except Exception as error:
        *_, (frame, _) = traceback.walk_tb(error.__traceback__)
        if frame.f_globals.get("__name__", "").partition(".")[0] not in _REFUSING:
            raise
        if ours := _our_refusal(error):
            raise ours from error
        reason, line = _without_chatter(str(error)), traceback.extract_tb(error.__traceback__)[-1].line
        options = [word[2:].partition("=")[0] for word in argv if word.startswith("--") and "." in word]
        named = [name for name in options if name.partition(".")[2].rstrip("+") in f"{reason} {line}"]
        raise InputError(
            f"{', '.join(named) or 'trainer'}: Lightning refuses it ({type(error).__name__}: {reason[:400]}). "
            "Correct it, or leave it out."
        ) from error
