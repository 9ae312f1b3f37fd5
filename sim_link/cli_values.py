"""What the commands of `sim-link` share: checking what was typed, refusing it, knowing when to stop."""

from __future__ import annotations

import os
import signal
from contextlib import suppress
from math import isfinite
from types import FrameType

import typer

from .rotation import Vec3

EXIT_DONE, EXIT_BAD_INPUT = 0, 2
ENGINES = ("auto", "python", "numba")
"""What --engine takes."""


class InputError(ValueError):
    """Something on the command line that cannot be used; the message is one line."""


class Stop:
    """Knows whether to stop: a signal came, or the parent process is gone."""

    def __init__(self, with_parent: bool) -> None:
        self._wanted = False
        self._parent = os.getppid() if with_parent else None
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self._wanted = True

    def __call__(self) -> bool:
        """Tell whether to stop."""
        return self._wanted or (self._parent is not None and os.getppid() != self._parent)


def refuse(sentence: str) -> None:
    """Say what is wrong in one line, and end."""
    typer.echo(f"sim-link: {sentence}", err=True)
    raise typer.Exit(EXIT_BAD_INPUT)


def tell(sentence: str) -> None:
    """Say something on the console. That nobody can read it there any more does not end a flight."""
    with suppress(OSError, ValueError):  # a closed pipe, a full disk; a stream that was never there
        typer.echo(f"sim-link: {sentence}", err=True)


def number(value: float, option: str, above: float | None = None) -> float:
    """Check a number: finite, not negative, or above a bound."""
    if not isfinite(value) or value < 0.0 or (above is not None and value <= above):
        allowed = "0 or more" if above is None else f"more than {above:g}"
        raise InputError(f"{option} {value:g}: allowed is {allowed}")
    return value


def numbers(text: str, option: str, counts: tuple[int, ...], form: str) -> list[float]:
    """Read comma-separated numbers, as many as one of `counts`; `form` tells people what is expected."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in counts or not all(map(isfinite, values)):
        raise InputError(f"{option} {text!r}: expected {form}")
    return values


def vector(text: str, option: str) -> Vec3:
    """Read three numbers."""
    n, e, d = numbers(text, option, (3,), "three numbers north,east,down")
    return n, e, d


def choice(value: str, allowed: tuple[str, ...], option: str) -> str:
    """Check a word."""
    if value not in allowed:
        raise InputError(f"{option} {value!r}: allowed are {', '.join(allowed)}")
    return value


def port_or(number: int | None, default: int, option: str) -> int:
    """Check a port; None is the default."""
    if number is None:
        return default
    if not 0 <= number <= 65535:
        raise InputError(f"{option} {number}: allowed are 0 to 65535")
    return number
