"""What a control loop does for a program around it, between its own duties."""

from __future__ import annotations

from typing import Protocol

from companion.link.framing import Frame


class Host(Protocol):
    """The program that a flight's loop runs in, when it does more than fly one flight (`companion serve`).

    Both are called within control turns, after what the turn owes the vehicle: they must return within a fraction of a
    millisecond, never block and never raise.
    """

    def on_frame(self, frame: Frame) -> None:
        """A frame that came on the vehicle link, other than the states and the clock."""
        ...

    def turn(self) -> None:
        """Called at every turn."""
        ...


class Alone:
    """The host of a flight that is all that its process does."""

    def on_frame(self, frame: Frame) -> None:
        """Nobody else wants it."""

    def turn(self) -> None:
        """Nothing else is to be done."""
