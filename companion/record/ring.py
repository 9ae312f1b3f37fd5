"""A ring in shared memory between one writer and one reader, of which the writer never waits.

Entries are handed over without a system call, so that recording costs the control loop about a microsecond, and what
was handed over outlives the writer: the reader still has the memory when the writer was killed. An entry that finds no
room is refused. Each side owns its numbers of the head: the writer how far it has written and what it refused, the
reader how far it has read, counted in bytes since the start.

A reader on another core may see the writer's number before the bytes (processors with weak ordering do that), so it
takes an entry only when it has already seen it announced at an earlier look; `take_rest` is for when the writer has
ended.
"""

from __future__ import annotations

import mmap
import os
import struct
import tempfile
from collections.abc import Iterator
from typing import Final

_ENTRY = struct.Struct("=qIB")  # wall_ns, length, kind
_HEAD: Final = _ENTRY.size
_USUAL_BYTES: Final = 640
"""Entries below this (frames, rows of a record) are written in one call."""
_PACK: Final = tuple(struct.Struct(f"{_ENTRY.format}{length}s").pack_into for length in range(_USUAL_BYTES))
_SKIP: Final = 0xFFFFFFFF
"""A length that says: the next entry is at the beginning again."""
_BATCH: Final = 256
"""Entries that are taken at once, at most: some 60 kB of a usual link."""
_HEAD_BYTES: Final = 64
_WRITTEN, _READ, _TAKEN, _REFUSED, _PATIENT = 0, 1, 2, 3, 4  # the head's numbers, of 8 bytes each


Entry = tuple[int, int, bytes]
"""What was handed over: wall_ns, kind, content."""


def create(size_bytes: int) -> int:
    """Make the memory of a ring and return its file descriptor; both sides open the ring with it."""
    if hasattr(os, "memfd_create"):
        descriptor = os.memfd_create("ring", os.MFD_CLOEXEC)
    else:  # not on Linux: an unnamed file does the same
        with tempfile.TemporaryFile() as file:
            descriptor = os.dup(file.fileno())
    os.truncate(descriptor, _HEAD_BYTES + size_bytes)
    return descriptor


class _Ring:
    """The mapped memory."""

    def __init__(self, descriptor: int) -> None:
        self._map = mmap.mmap(descriptor, 0)
        self._size = len(self._map) - _HEAD_BYTES
        whole = memoryview(self._map)
        self._numbers = whole[:_HEAD_BYTES].cast("Q")
        self._bytes = whole[_HEAD_BYTES:]

    @property
    def taken(self) -> int:
        """Entries that the reader has taken."""
        return self._numbers[_TAKEN]

    @property
    def refused(self) -> int:
        """Entries that found no room."""
        return self._numbers[_REFUSED]


class RingWriter(_Ring):
    """The writing side. Touches all memory at the start: no page fault waits for it later."""

    def __init__(self, descriptor: int) -> None:
        super().__init__(descriptor)
        page = mmap.PAGESIZE
        for at in range(0, self._size, page):
            self._bytes[at] = 0
        self._at = 0
        self._until = self._size
        """Up to where there is room, as far as that was looked at."""
        self._before = 0
        """Bytes before the ring's beginning was passed last; `_at` more are written altogether."""
        self._closed = False

    def put(self, kind: int, content: bytes, wall_ns: int) -> bool:
        """Hand over an entry; False when it was refused: no room. Never waits, never raises: no log is worth a flight.

        Args:
            kind: 0 to 255.
            content: any bytes, less than the ring's size.
            wall_ns: a time that the entry keeps.
        """
        length = len(content)
        end = self._at + _HEAD + length
        if end > self._until:
            if not self._make_room(_HEAD + length):
                self._numbers[_REFUSED] += 1
                return False
            end = self._at + _HEAD + length
        try:
            if length < _USUAL_BYTES:  # head and content in one call
                _PACK[length](self._bytes, self._at, wall_ns, length, kind, content)
            else:
                _ENTRY.pack_into(self._bytes, self._at, wall_ns, length, kind)
                self._bytes[end - length : end] = content
        except (struct.error, ValueError, TypeError):  # no entry, or a fault of ours
            self._numbers[_REFUSED] += 1
            return False
        self._at = end
        self._numbers[_WRITTEN] = self._before + end
        return True

    def _make_room(self, wanted: int) -> bool:
        """Look how far the reader is, and pass the ring's end where an entry does not fit before it."""
        if self._closed:
            return False
        at, free = self._at, self._size - (self._before + self._at - self._numbers[_READ])
        passes = at + wanted > self._size
        skipped = self._size - at if passes else 0  # 0 too where the last entry ended with the ring
        if skipped + wanted > free:
            return False
        if passes:
            if skipped >= _HEAD:
                _ENTRY.pack_into(self._bytes, at, 0, _SKIP, 0)
            self._before += self._size
            self._at, free = 0, free - skipped
        self._until = min(self._size, self._at + free)
        return True

    def be_patient(self) -> None:
        """Let the reader wait until three quarters of the ring are full: its work takes the writer's processor."""
        self._numbers[_PATIENT] = 1

    def close(self) -> None:
        """Refuse what still comes, and count it: nobody reads any more."""
        self._closed = True
        self._until = 0

    @property
    def used(self) -> float:
        """Share of the ring that the reader has not taken."""
        return (self._before + self._at - self._numbers[_READ]) / self._size

    @property
    def waiting(self) -> int:
        """Entries that the reader has not taken."""
        done, end, count = self._numbers[_READ], self._before + self._at, 0
        while done < end:
            at = done % self._size
            length = _ENTRY.unpack_from(self._bytes, at)[1] if self._size - at >= _HEAD else _SKIP
            done += self._size - at if length == _SKIP else _HEAD + length
            count += length != _SKIP
        return count


class RingReader(_Ring):
    """The reading side."""

    def __init__(self, descriptor: int) -> None:
        super().__init__(descriptor)
        self._done = 0
        self._seen = 0

    @property
    def may_wait(self) -> bool:
        """Whether the writer wants its processor for itself, and there is room enough for that."""
        numbers = self._numbers
        return bool(numbers[_PATIENT]) and 4 * (numbers[_WRITTEN] - numbers[_READ]) < 3 * self._size

    def take(self) -> Iterator[list[Entry]]:
        """The entries that were there at the last look already, some hundred at a time."""
        limit, self._seen = self._seen, self._numbers[_WRITTEN]
        return self._take_until(limit)

    def take_rest(self) -> Iterator[list[Entry]]:
        """Everything: the writer has ended."""
        self._seen = self._numbers[_WRITTEN]
        return self._take_until(self._seen)

    def _take_until(self, limit: int) -> Iterator[list[Entry]]:
        while self._done < limit:
            yield self._take_batch(limit)

    def _take_batch(self, limit: int) -> list[Entry]:
        """Copies entries out, and gives their room back."""
        memory, head_of = self._map, _ENTRY.unpack_from
        entries: list[Entry] = []
        start = at = _HEAD_BYTES + self._done % self._size
        stop, last = at + limit - self._done, len(memory) - _HEAD  # no entry begins behind
        while at < stop and at <= last and len(entries) < _BATCH:
            wall_ns, length, kind = head_of(memory, at)
            if length == _SKIP:
                at = len(memory)
                break
            begin = at + _HEAD
            at = begin + length
            entries.append((wall_ns, kind, memory[begin:at]))
        if last < at < stop:
            at = len(memory)  # too little for a head: the next one is at the beginning
        self._done = self._numbers[_READ] = self._done + at - start
        self._numbers[_TAKEN] += len(entries)
        return entries
