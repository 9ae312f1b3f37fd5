"""The errors that end a command, each with the exit code that it ends with.

A message is one line: what, where, and what to do. The command line prints it without a traceback; anything that is not
one of these is a fault of the program itself (exit code 70).
"""

from __future__ import annotations

from enum import IntEnum


class ExitCode(IntEnum):
    """What the command line returns."""

    DONE = 0
    MISSED = 1
    """The flight missed the thresholds of [acceptance]."""
    BAD_INPUT = 2
    REFUSED = 3
    LOST = 4
    """The link or the vehicle was lost, or never found."""
    INTERNAL = 70
    INTERRUPTED = 130


class CompanionError(Exception):
    """Base of all errors that are explained to the user in one line."""

    exit_code: int = ExitCode.INTERNAL


class InputError(CompanionError):
    """A file, an option or a name that cannot be used as it is."""

    exit_code = ExitCode.BAD_INPUT


class RefusedError(CompanionError):
    """A gate that does not let the flight happen; the message names the figure that fails."""

    exit_code = ExitCode.REFUSED


class LinkError(CompanionError):
    """No vehicle, no port, or a vehicle that went silent."""

    exit_code = ExitCode.LOST
