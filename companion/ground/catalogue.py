"""What the store knows of its files beside their bytes: numbers that stay, checksums, verdicts.

It is a hidden file in the same folder, written as a whole. Files that somebody changed by hand are noticed by size and
time of change.
"""

from __future__ import annotations

import contextlib
import json
import os
from pathlib import Path
from typing import Any, Final, NamedTuple

from companion.ground.ftp import crc32

CATALOGUE_NAME: Final = ".catalogue.json"
_CHUNK_BYTES = 1 << 20
_ID_MAX = 1 << 24  # a command carries it as a float
_CATALOGUE_BYTES_MAX = 4 << 20


class Entry(NamedTuple):
    """One stored file."""

    id: int
    """Its number: given once, kept through restarts, new contents and a new name, never given again."""
    name: str
    size_bytes: int
    mtime_ns: int
    """Time of the last change, as the file system says it."""
    crc32: int
    """As CalcFileCRC32 gives it (`ftp.crc32`)."""
    accepted: bool | None
    """What the vehicle's check said; None: not checked yet."""
    verdict: str
    """The same in words."""
    checked_by: str
    """What the verdict depends on beside the file: vehicle, limits, version."""


class Catalogue:
    """The entries by name, and the next number."""

    def __init__(self, folder: Path) -> None:
        self.entries: dict[str, Entry] = {}
        """By name."""
        self._path = folder / CATALOGUE_NAME
        self._next_id = 1
        self._read()

    def number(self) -> int:
        """A number that no file had before."""
        number = self._next_id
        self._next_id += 1
        return number

    def write(self) -> None:
        """Write it as a whole: either the old or the new one is on the disk.

        Raises:
            OSError: the disk does not take it.
        """
        document = {"next_id": self._next_id, "files": [entry._asdict() for entry in self.entries.values()]}
        staged = self._path.with_suffix(".new")
        with staged.open("w", encoding="utf-8") as file:
            json.dump(document, file)
            file.flush()
            os.fsync(file.fileno())
        staged.replace(self._path)

    def _read(self) -> None:
        """Read what is there; a damaged catalogue counts as none: the files are numbered and checked anew."""
        with contextlib.suppress(OSError, ValueError, TypeError, KeyError, RecursionError):
            if self._path.stat().st_size > _CATALOGUE_BYTES_MAX:
                return
            document = json.loads(self._path.read_text(encoding="utf-8"))
            entries = [_entry(fields) for fields in document["files"]]
            highest = max((entry.id for entry in entries), default=0)
            self._next_id = max(int(document["next_id"]), highest + 1)
            self.entries = {entry.name: entry for entry in entries}


def _entry(fields: dict[str, Any]) -> Entry:
    entry = Entry(**fields)
    numbers = (entry.id, entry.size_bytes, entry.mtime_ns, entry.crc32)
    texts = (entry.name, entry.verdict, entry.checked_by)
    if not all(isinstance(x, int) for x in numbers) or not all(isinstance(x, str) for x in texts):
        raise TypeError
    if not 0 < entry.id < _ID_MAX or entry.accepted not in {None, True, False}:
        raise ValueError
    return entry


def file_crc32(path: Path) -> int:
    """Checksum of a file's contents.

    Raises:
        OSError: it cannot be read.
    """
    total = 0
    fd = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    with os.fdopen(fd, "rb") as file:
        while chunk := file.read(_CHUNK_BYTES):
            total = crc32(chunk, total)
    return total


def sync_folder(folder: Path) -> None:
    """Bring the folder's list of names to the disk.

    Raises:
        OSError: the disk does not take it.
    """
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
