"""What somebody does by hand to the folder that the store keeps: how a file is now, and when to look for new ones."""

from __future__ import annotations

import os
import stat
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

from companion.ground.names import usable

LOOK_EVERY_S: Final = 2.0
"""New files are looked for at most this often."""
_SETTLED_NS: Final = 3_000_000_000
"""Some file systems count the time of a change in steps of 2 s: of a younger change there may be a second half."""


class FileState(NamedTuple):
    """What tells one version of a file from another without reading it."""

    size_bytes: int
    mtime_ns: int
    """Time of the last change, as the file system says it."""


def file_state(path: str, size_max: int) -> FileState | None:
    """How a file is now; None when it is none of ours: gone, a link, a folder, or longer than `size_max` bytes."""
    try:
        found = os.lstat(path)
    except OSError:
        return None
    if not stat.S_ISREG(found.st_mode) or found.st_size > size_max:
        return None
    return FileState(found.st_size, found.st_mtime_ns)


class Newcomers:
    """Names in the folder that nobody told the store of.

    Args:
        folder: where to look.
        clock: seconds from anywhere.
    """

    def __init__(self, folder: Path, clock: Callable[[], float]) -> None:
        self._folder, self._clock = folder, clock
        self._next_s: float | None = None
        self._seen_ns: int | None = None

    def names(self) -> list[str]:
        """All usable names, when something may have come or gone since the last look; else none. At most every 2 s."""
        now_s = self._clock()
        if self._next_s is not None and now_s < self._next_s:
            return []
        self._next_s = now_s + LOOK_EVERY_S
        try:
            changed_ns = os.stat(self._folder).st_mtime_ns
            if changed_ns == self._seen_ns:
                return []
            self._seen_ns = changed_ns if time.time_ns() - changed_ns > _SETTLED_NS else None
            found = [name for name in os.listdir(self._folder) if usable(name)]
        except OSError:
            return []
        return sorted(found)

    def look_again(self) -> None:
        """Look the next time even if the folder does not change: a file there could not be read."""
        self._seen_ns = None
