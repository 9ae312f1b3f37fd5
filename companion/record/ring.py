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
from typing import Final, NamedTuple

_ENTRY = struct.Struct("=qIB")  # wall_ns, length, kind
_SKIP: Final = 0xFFFFFFFF
"""A length that says: the next entry is at the beginning again."""
_HEAD_BYTES: Final = 64
_WRITTEN, _READ, _TAKEN, _REFUSED = 0, 1, 2, 3  # the head's numbers, of 8 bytes each


class Entry(NamedTuple):
    """What was handed over."""

    wall_ns: int
    kind: int
    content: bytes


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
        self._written = 0
        self._at = 0
        self.put_count = 0
        """Entries put so far."""

    def put(self, kind: int, content: bytes | memoryview, wall_ns: int) -> bool:
        """Hand over an entry; False when there is no room for it. Never waits.

        Args:
            kind: 0 to 255.
            content: any bytes, less than the ring's size.
            wall_ns: a time that the entry keeps.
        """
        length = _ENTRY.size + len(content)
        at, skipped = self._at, 0
        if at + length > self._size:
            skipped = self._size - at
        if self._written + skipped + length - self._numbers[_READ] > self._size:
            self._numbers[_REFUSED] += 1
            return False
        if skipped:
            if skipped >= _ENTRY.size:
                _ENTRY.pack_into(self._bytes, at, 0, _SKIP, 0)
            at = 0
        _ENTRY.pack_into(self._bytes, at, wall_ns, len(content), kind)
        self._bytes[at + _ENTRY.size : at + length] = content
        self._at = at + length
        self._written += skipped + length
        self._numbers[_WRITTEN] = self._written
        self.put_count += 1
        return True


class RingReader(_Ring):
    """The reading side."""

    def __init__(self, descriptor: int) -> None:
        super().__init__(descriptor)
        self._done = 0
        self._seen = 0

    def take(self) -> Iterator[Entry]:
        """The entries that were there at the last look already."""
        limit, self._seen = self._seen, self._numbers[_WRITTEN]
        return self._take_until(limit)

    def take_rest(self) -> Iterator[Entry]:
        """Everything: the writer has ended."""
        self._seen = self._numbers[_WRITTEN]
        return self._take_until(self._seen)

    def _take_until(self, limit: int) -> Iterator[Entry]:
        while self._done < limit:
            at = self._done % self._size
            left = self._size - at
            if left < _ENTRY.size:
                self._done += left
                continue
            wall_ns, length, kind = _ENTRY.unpack_from(self._bytes, at)
            if length == _SKIP:
                self._done += left
                continue
            begin = at + _ENTRY.size
            entry = Entry(wall_ns, kind, bytes(self._bytes[begin : begin + length]))
            self._done += _ENTRY.size + length
            self._numbers[_READ] = self._done
            self._numbers[_TAKEN] += 1
            yield entry
