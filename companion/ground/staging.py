"""A file that is being uploaded: blocks in any order, written to a hidden file, until the whole is there."""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from bisect import bisect_left, bisect_right
from pathlib import Path
from typing import Final

from companion.ground.ftp import crc32
from companion.ground.names import StoreError

HOLES_MAX: Final = 20_000
"""More pieces than this are nobody's honest upload: blocks of 80 bytes with 10 % loss make 1300 pieces of 1 MB."""
USUAL_BLOCKS: Final = (80, 239)
"""Bytes of a full block of the usual clients (MAVProxy, pymavlink, Mission Planner; QGroundControl, MAVSDK). A file in
one block of another length is shorter than its client's block, as far as can be known."""
CUT: Final = "it may be cut off, as it ends with a full block: add an empty line at its end, or use `companion upload`"
_CHUNK_BYTES = 1 << 16
_BLANK = b" \t\r\n"
_MARK = b"\xef\xbb\xbf"
"""Some programs begin a text in UTF-8 with it."""
_END_BYTES = 256


class Ranges:
    """Which bytes of a file are there: sorted pieces that neither overlap nor touch."""

    def __init__(self) -> None:
        self._begins: list[int] = []
        self._ends: list[int] = []

    def __len__(self) -> int:
        return len(self._begins)

    @property
    def prefix(self) -> int:
        """Bytes that are there from the beginning on without a hole."""
        return self._ends[0] if self._begins and self._begins[0] == 0 else 0

    @property
    def end(self) -> int:
        """Where the last byte that is there ends."""
        return self._ends[-1] if self._ends else 0

    def overlaps(self, begin: int, end: int) -> list[tuple[int, int]]:
        """The parts of [begin, end) that are there."""
        first = bisect_right(self._ends, begin)
        last = bisect_left(self._begins, end)
        return [(max(begin, self._begins[i]), min(end, self._ends[i])) for i in range(first, last)]

    def add(self, begin: int, end: int) -> None:
        """Bytes [begin, end) are there now."""
        first = bisect_left(self._ends, begin)
        last = bisect_right(self._begins, end)
        if first < last:
            begin = min(begin, self._begins[first])
            end = max(end, self._ends[last - 1])
        self._begins[first:last] = [begin]
        self._ends[first:last] = [end]


class Upload:
    """One upload on its way into a hidden file."""

    def __init__(self, name: str, path: Path, size_max: int, *, resume: bool) -> None:
        """Open the hidden file.

        Args:
            name: what the file is to be called.
            path: the hidden file.
            size_max: bytes that it may have.
            resume: go on with what is there of it; otherwise begin afresh.

        Raises:
            OSError: it cannot be opened.
        """
        self.name = name
        self.path = path
        self.failed = False
        """Whether a block could not be taken: then this is never the whole file."""
        self._size_max = size_max
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC | (0 if resume else os.O_TRUNC)
        self._fd = os.open(path, flags, 0o644)
        self._ranges = Ranges()
        self._crc = 0
        self._crc_end = 0
        self._block_max = 0
        self._written_begin = size_max
        self._written_end = 0
        """From where to where this sender has written."""
        self._last_block = (0, 0)
        """Begin and end of the block that reaches furthest."""
        size = os.fstat(self._fd).st_size
        if size:
            self._ranges.add(0, size)
            self._follow()

    @property
    def received(self) -> int:
        """Bytes that are there from the beginning on."""
        return self._ranges.prefix

    @property
    def extent(self) -> int:
        """Bytes that the hidden file has, holes included."""
        return self._ranges.end

    @property
    def crc32(self) -> int:
        """Checksum of the bytes that are there from the beginning on."""
        return self._crc

    def write(self, offset: int, data: bytes) -> None:
        """Take one block. The same block may come again; one that contradicts what is there begins the file afresh.

        Raises:
            StoreError: beyond the size that is allowed, or in too many pieces.
            OSError: the disk does not take it.
        """
        end = offset + len(data)
        try:
            if end > self._size_max:
                raise StoreError(errno.EFBIG, f"{self.name}: longer than {self._size_max} bytes, which is the most")
            if self._contradicts(offset, data):
                self._begin_afresh()
            os.pwrite(self._fd, data, offset)
            self._ranges.add(offset, end)
            if len(self._ranges) > HOLES_MAX:
                raise StoreError(errno.EINVAL, f"{self.name}: came in more than {HOLES_MAX} pieces")
        except (StoreError, OSError):
            self.failed = True
            raise
        self._block_max = max(self._block_max, len(data))
        self._written_begin = min(self._written_begin, offset)
        if end >= self._written_end:
            self._written_end = end
            self._last_block = (offset, end)
        self._follow()

    def missing(self, expected: tuple[int, int] | None) -> str | None:
        """Why this is not the whole file; None when it is.

        Args:
            expected: size and checksum of the whole, from a sender that says them. Without them a file is taken for
                whole that has no holes, ends where the writing ended, and either with a short block or as a JSON
                document: a client that gives up also ends its session, and its last block, a full one like those
                before, may well end with a line.
        """
        there, end = self._ranges.prefix, self._ranges.end
        if self.failed:
            return "a part of it could not be taken"
        if there < end:
            return f"bytes are missing from {there} on"
        if expected is not None:
            if there != expected[0]:
                return f"{there} of {expected[0]} bytes came"
            return None if self._crc == expected[1] else "its checksum is not the sender's"
        if end == 0:
            return "it is empty"
        if self._written_end != end:
            return "what was sent ends before what was there already"
        return None if self._ends_short() or self._closes_itself() else CUT

    def begins(self, path: Path) -> bool:
        """Whether this is the beginning of a longer file, as an upload of it that was cut off would be."""
        with contextlib.suppress(OSError):  # what is not there, or cannot be read, is not cut by anybody
            other = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
            try:
                state = os.fstat(other)
                if not stat.S_ISREG(state.st_mode) or state.st_size <= self.received:
                    return False
                return all(
                    os.pread(other, length, at) == os.pread(self._fd, length, at)
                    for at in range(0, self.received, _CHUNK_BYTES)
                    for length in [min(_CHUNK_BYTES, self.received - at)]
                )
            finally:
                os.close(other)
        return False

    def close(self, *, whole: bool = False) -> None:
        """Close the hidden file, cut to what can be gone on with; remove it when that is nothing.

        Args:
            whole: nothing is missing; then even an empty file stays.
        """
        if self._fd < 0:
            return
        there = self._ranges.prefix
        try:
            if there < self._ranges.end:
                os.ftruncate(self._fd, there)
        finally:
            os.close(self._fd)
            self._fd = -1
        if there == 0 and not whole:
            self.path.unlink(missing_ok=True)

    def _ends_short(self) -> bool:
        """Whether the last block is shorter than the sender's blocks are."""
        begin, end = self._last_block
        if end - begin < self._block_max:
            return True
        return begin == self._written_begin and end - begin not in USUAL_BLOCKS

    def _closes_itself(self) -> bool:
        """Whether it begins and ends as a JSON document, of which the check takes no beginning for the whole."""
        head = os.pread(self._fd, _END_BYTES, 0).removeprefix(_MARK).lstrip(_BLANK)
        tail = os.pread(self._fd, _END_BYTES, max(0, self.received - _END_BYTES)).rstrip(_BLANK)
        return head.startswith(b"{") and tail.endswith(b"}")

    def _contradicts(self, offset: int, data: bytes) -> bool:
        for begin, end in self._ranges.overlaps(offset, offset + len(data)):
            if os.pread(self._fd, end - begin, begin) != data[begin - offset : end - offset]:
                return True
        return False

    def _begin_afresh(self) -> None:
        os.ftruncate(self._fd, 0)
        self._ranges = Ranges()
        self._crc = self._crc_end = 0
        self._block_max = self._written_end = 0
        self._written_begin = self._size_max
        self._last_block = (0, 0)

    def _follow(self) -> None:
        """Bring the checksum up to the bytes that are there from the beginning on."""
        while self._crc_end < self._ranges.prefix:
            chunk = os.pread(self._fd, min(_CHUNK_BYTES, self._ranges.prefix - self._crc_end), self._crc_end)
            if not chunk:
                break  # somebody else cut the file; the check reads what there is
            self._crc = crc32(chunk, self._crc)
            self._crc_end += len(chunk)
