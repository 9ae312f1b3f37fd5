"""One program at a time uses a folder: a lock on a file in it, which the system takes back however a process ends.

The descriptor is not inherited (O_CLOEXEC), so a check that still runs does not hold the lock of a process that was
killed. The file stays where it is: a lock on one that was removed would keep nobody out.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from pathlib import Path
from typing import Final

from companion.errors import InputError

LOCK_NAME: Final = ".lock"
PATIENCE_S: Final = 2.0
"""For a process that is just ending: the one that follows it may come sooner than it is gone."""
_RETRY_S = 0.05


class FolderLock:
    """The lock of one folder, held until `release`."""

    def __init__(self, folder: Path, patience_s: float = PATIENCE_S) -> None:
        """Take it; waits for at most `patience_s` while another process has it.

        Args:
            folder: must be there.
            patience_s: how long to wait.

        Raises:
            InputError: another process has it.
            OSError: the file cannot be opened or made.
        """
        self.problem = ""
        """Why nobody is kept out; "" where the file system has locks."""
        self._fd = _opened(folder / LOCK_NAME)
        end_s = time.monotonic() + patience_s
        while True:
            try:
                fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return
            except BlockingIOError:
                if time.monotonic() >= end_s:
                    self.release()
                    raise InputError(
                        f"--folder {folder}: another `companion serve` uses it; give each its own (--folder)"
                    ) from None
            except OSError as error:
                self.problem = f"{folder}: the file system has no locks ({error.strerror})"
                return
            time.sleep(_RETRY_S)

    def release(self) -> None:
        """Let others have the folder."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


def _opened(path: Path) -> int:
    flags = os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT | flags, 0o644)  # network file systems lock what is open to write
    except PermissionError:
        with contextlib.suppress(OSError):
            return os.open(path, os.O_RDONLY | flags)  # another user's, from an earlier run
        raise
