"""What the control process has been asked and not done yet, and how each of it ends."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

Tell = Callable[[int, bool, str], None]
"""Gets the number of a request, whether it was done, and a sentence for people ("" when there is nothing to say)."""


class _Undertaking(NamedTuple):
    number: int
    what: str
    done: Callable[[], bool]


class Undertakings:
    """The open requests.

    Args:
        tell: gets the end of each.
    """

    def __init__(self, tell: Tell) -> None:
        self._tell = tell
        self._open: list[_Undertaking] = []

    def add(self, number: int, what: str, done: Callable[[], bool]) -> None:
        """Takes a request.

        Args:
            number: of the request.
            what: what is to be done, in a word.
            done: asked at every turn whether it is; must take no time.
        """
        self._open.append(_Undertaking(number, what, done))

    def replace(self, what: str) -> None:
        """A newer request makes the open ones void."""
        self.fail(f"replaced by {what}")

    def check(self) -> None:
        """Tells what is done."""
        if not self._open:
            return
        still = []
        for entry in self._open:
            if entry.done():
                self._tell(entry.number, True, "")
            else:
                still.append(entry)
        self._open = still

    def fail(self, why: str) -> None:
        """None of the open ones will be done any more."""
        ended, self._open = self._open, []
        for entry in ended:
            self._tell(entry.number, False, f"{entry.what}: {why}")
