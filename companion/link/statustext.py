"""What the autopilot says in words: STATUSTEXT, put together from its chunks and kept for a while to explain
refusals."""

from __future__ import annotations

from collections import deque
from typing import Final, NamedTuple

from companion.link.codec import StatusText

WARNING: Final = 4
"""MAV_SEVERITY_WARNING; smaller numbers are worse."""
CHUNKS_WAIT_S: Final = 1.0
"""How long the missing chunks of a text are waited for."""
KEPT: Final = 100
"""Texts kept; older ones are dropped."""


class Announcement(NamedTuple):
    """One whole text."""

    at_s: float
    """When its last part came, on the caller's clock."""
    severity: int
    """MAV_SEVERITY: 0 emergency ... 7 debug."""
    text: str


class _Partial:
    """The chunks of one text so far."""

    def __init__(self, started_s: float, severity: int) -> None:
        self.started_s = started_s
        self.severity = severity
        self.chunks: dict[int, bytes] = {}
        self.last_chunk: int | None = None

    def whole(self) -> bool:
        """Whether the last chunk and all before it are there."""
        return self.last_chunk is not None and all(index in self.chunks for index in range(self.last_chunk + 1))

    def text(self) -> str:
        """The text, with "..." where a chunk is missing."""
        last = max(self.chunks) if self.last_chunk is None else self.last_chunk
        missing_end = b"" if self.last_chunk is not None else b"..."
        return _readable(b"".join(self.chunks.get(index, b"...") for index in range(last + 1)) + missing_end)


class StatusTexts:
    """Collects the texts of one sender."""

    def __init__(self) -> None:
        self.texts: deque[Announcement] = deque(maxlen=KEPT)
        """Whole texts, oldest first."""
        self.partial: dict[int, _Partial] = {}
        """Texts of which chunks have not come yet, for `update`."""

    def add(self, message: StatusText, now_s: float) -> None:
        """Take one message."""
        if message.id == 0:
            self.texts.append(Announcement(now_s, message.severity, _readable(message.text)))
            return
        partial = self.partial.setdefault(message.id, _Partial(now_s, message.severity))
        partial.chunks[message.chunk_seq] = message.text
        if message.complete:
            partial.last_chunk = message.chunk_seq
        if partial.whole():
            self._finish(message.id, now_s)

    def update(self, now_s: float) -> None:
        """Give up on chunks that did not come."""
        late = [key for key, partial in self.partial.items() if not 0.0 <= now_s - partial.started_s <= CHUNKS_WAIT_S]
        for key in late:
            self._finish(key, now_s)

    def _finish(self, key: int, now_s: float) -> None:
        """Keep a text as far as it came."""
        partial = self.partial.pop(key)
        self.texts.append(Announcement(now_s, partial.severity, partial.text()))

    def complaints(self, from_s: float, to_s: float) -> list[str]:
        """Warnings and worse that came within this time, oldest first, each once."""
        found = [a.text for a in self.texts if from_s <= a.at_s <= to_s and a.severity <= WARNING and a.text]
        return list(dict.fromkeys(found))


def _readable(text: bytes) -> str:
    """A whole text; bytes that are none become replacement characters."""
    return text.decode("utf-8", errors="replace")
