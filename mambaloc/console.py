"""What a tool shows a person: a user's mistake as one line, and no chatter."""

from __future__ import annotations

import argparse
import logging
import sys
import threading
import warnings
from collections.abc import Callable, Iterable
from functools import wraps
from typing import Any, NoReturn, TypeVar

import numpy as np
from numpy.typing import NDArray

from mambaloc.errors import InputError, InputWarning

_as_usual = warnings.formatwarning

T = TypeVar("T")


def exit_on_input_error(main: Callable[..., Any]) -> Callable[..., Any]:
    """Make a tool's ``main`` print an :class:`InputError` as one line on stderr and exit with code 2.

    An :class:`~mambaloc.errors.InputWarning` is one line there, too.
    """

    @wraps(main)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        warnings.formatwarning = _in_a_line
        try:
            return main(*args, **kwargs)
        except KeyboardInterrupt:
            print("interrupted", file=sys.stderr)
            raise SystemExit(130) from None
        except Exception as error:
            if mistake := _user_mistake(error):
                print(f"error: {mistake}", file=sys.stderr)
                raise SystemExit(2) from None
            raise

    return wrapper


def _in_a_line(message: Warning | str, category: type[Warning], *where: Any, **line: Any) -> str:
    if issubclass(category, InputWarning):
        return f"warning: {message}\n"
    return _as_usual(message, category, *where, **line)


def _user_mistake(error: BaseException | None) -> InputError | None:
    """Find an InputError that a library wrapped in an error of its own."""
    while error is not None and not isinstance(error, InputError):
        error = error.__cause__ or error.__context__
    return error


class OptionParser(argparse.ArgumentParser):
    """Answers a wrong option in one line, without the page of usage, which ``--help`` shows."""

    def error(self, message: str) -> NoReturn:
        """Raise what is wrong as an :class:`~mambaloc.errors.InputError`."""
        raise InputError(f"{message.removeprefix('argument ')}; --help lists the options")


def whole_number(minimum: int, maximum: int | None = None) -> Callable[[str], int]:
    """Make a reader of an option's whole number within bounds, for :mod:`argparse`."""

    def read(text: str) -> int:
        if not text.isdecimal() or not minimum <= int(text) <= (int(text) if maximum is None else maximum):
            bounds = f"of at least {minimum}" if maximum is None else f"from {minimum} to {maximum}"
            raise argparse.ArgumentTypeError(f"{text}: give a whole number {bounds}")
        return int(text)

    return read


thread_count = whole_number(1, 256)
"""Reads an option's number of threads."""


def pinhole_matrix(text: str) -> NDArray[np.float64]:
    """Read an option's ``FX,FY,CX,CY`` as a (3, 3) matrix, for :mod:`argparse`."""
    try:
        fx, fy, cx, cy = map(float, text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text}: give FX,FY,CX,CY in pixels") from None
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def black_and_white(text: str) -> tuple[int, int]:
    """Read an option's ``BLACK,WHITE``, counts of 16 bits, for :mod:`argparse`."""
    black, comma, white = text.partition(",")
    if not comma or not (black.isdecimal() and white.isdecimal()) or not int(black) < int(white) <= 65535:
        raise argparse.ArgumentTypeError(f"{text}: give BLACK,WHITE, two counts from 0 to 65535, the smaller one first")
    return int(black), int(white)


def progress(items: Iterable[T], name: str, count: int) -> Iterable[T]:
    """Pass items on, with a bar in a terminal that goes away at the end."""
    from rich import get_console  # only here: exported models run without it
    from rich.progress import track

    if not get_console().is_interactive:  # where Rich ends each bar with an empty line
        return items
    return track(items, f"{name:10}", count, transient=True)


class _StderrLines(logging.Handler):
    """Prints each message as a line on whatever ``sys.stderr`` is by then."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print it."""
        print(self.format(record), file=sys.stderr, flush=True)


def configure_logging() -> None:
    """Show the package's own log, and of libraries only what a user can act on: no hardware lists, no tips."""
    threading.excepthook = _show_unless_of_the_disk
    own = logging.getLogger("mambaloc")
    own.setLevel(logging.INFO)
    own.propagate = False  # ONNX Runtime's tools give the root logger a handler: each line would come twice
    if not any(isinstance(handler, _StderrLines) for handler in own.handlers):
        own.addHandler(_StderrLines())
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    logging.getLogger("lightning.fabric").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", "LightningCLI's args parameter is intended")  # ours are made from sys.argv
    warnings.filterwarnings("ignore", ".*treespec, LeafSpec")
    warnings.filterwarnings("ignore", "Checkpoint directory .* exists and is not empty")  # a resumed run's own
    warnings.filterwarnings("ignore", "Found .* in eval mode at the start")  # a teacher, or frozen groups
    warnings.filterwarnings("ignore", ".*does not have many workers")  # decoded frames need none
    warnings.filterwarnings("ignore", "Total length of `list` across ranks is zero")  # no validation was asked for


def _show_unless_of_the_disk(error: threading.ExceptHookArgs) -> None:
    """Leave out what TensorBoard's thread could not write: the thread that logs raises the same error."""
    if not issubclass(error.exc_type, OSError):
        threading.__excepthook__(error)
