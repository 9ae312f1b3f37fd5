"""The bytes of a serial line: what is unfinished waits for the rest, but not for longer than the line is in use.

A line has no borders. Noise that looks like the beginning of a frame makes good frames behind it wait until its length
is there; when the line falls silent before that, they are used without it.
"""

from __future__ import annotations

import math
from typing import Final

from companion.link.framing import Frame, FrameParser

SILENCE_NS: Final = 50_000_000
"""After which a line counts as silent: adapters do not hold bytes back for so long, and a "land" may wait for it."""


class LineReader:
    """Turns what a line brings into frames.

    Args:
        parser: the line's.
    """

    def __init__(self, parser: FrameParser) -> None:
        self._parser = parser
        self._held = b""
        """Bytes that are not done with: two frames at most."""
        self._came_ns = 0
        self._looked = True
        """Whether nothing is to be had of `_held` until more comes."""

    def take(self, data: bytes, wall_ns: int, frames: list[Frame], unknown: list[bytes]) -> None:
        """Append the frames that end in `data`, which came at `wall_ns`; arguments as for `FrameParser.parse`."""
        held = self._held + data
        self._held = held[self._parser.parse(held, wall_ns, frames, unknown, final=False) :]
        self._came_ns = wall_ns
        self._looked = not self._held

    def rest(self, wall_ns: int, frames: list[Frame], unknown: list[bytes]) -> None:
        """Nothing is there to be read: after a silence, append what waits behind the beginning of a frame."""
        if self._looked or wall_ns - self._came_ns < SILENCE_NS:
            return
        self._looked = True
        self._held = self._held[self._parser.settle(self._held, self._came_ns, frames, unknown) :]

    def wait_s(self, wall_ns: int) -> float:
        """How long to wait for more at most before `rest` is due [s]."""
        return math.inf if self._looked else max(0, SILENCE_NS - (wall_ns - self._came_ns)) * 1e-9
