"""Lines for people from a program that must go on, whatever becomes of whoever reads them.

A reader that has gone (`| head`), a full disk or a terminal that is held (Ctrl-S, `| less`) would end a `print`, or
keep it waiting, and with it the program. Here a thread of its own writes, and a bounded number of lines waits for it.
"""

from __future__ import annotations

import contextlib
import os
import select
import threading
import time
from collections import deque
from typing import Final, TextIO

LINES_MAX: Final = 1000
"""Lines that wait for the reader; what does not fit is dropped, and counted."""
CLOSE_S: Final = 1.0
"""How long the last lines are waited for."""


class SteadyOutput:
    """Says lines without ever raising or waiting; use it as a context manager, so that the last lines are seen.

    Args:
        stream: stdout or stderr, of which the file descriptor alone is used: a thread that waits inside a Python stream
            would hold its lock, and the interpreter could not end. None (it is closed): nothing is said.
    """

    def __init__(self, stream: TextIO | None) -> None:
        self._descriptor = None if stream is None else stream.fileno()
        self._changed = threading.Condition()
        self._lines: deque[str] = deque()
        self._dropped = 0
        self._writing = False
        self._closed = False
        threading.Thread(target=self._write_on, daemon=True, name="output").start()

    def __enter__(self) -> SteadyOutput:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def say(self, line: str) -> None:
        """One line, now or when the reader goes on."""
        with self._changed:
            if len(self._lines) >= LINES_MAX:
                self._dropped += 1
                return
            self._own_up()
            self._lines.append(line)
            self._changed.notify_all()

    def close(self) -> None:
        """Waits for the last lines, but not for a reader that stands still."""
        end_s = time.monotonic() + CLOSE_S
        with self._changed:
            self._closed = True
            self._changed.notify_all()
            while self._lines or self._dropped or self._writing:
                if not self._changed.wait(end_s - time.monotonic()):
                    break

    def _own_up(self) -> None:
        """Puts in the place of dropped lines how many they were."""
        if self._dropped:
            self._lines.append(f"({self._dropped} lines were dropped here: they were not read in time)")
            self._dropped = 0

    def _write_on(self) -> None:
        while True:
            with self._changed:
                self._writing = False
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._lines or self._dropped or self._closed)
                if not self._lines:
                    self._own_up()
                if not self._lines:
                    return
                line = self._lines.popleft()
                self._writing = True
            self._write(line)

    def _write(self, line: str) -> None:
        if self._descriptor is None:
            return
        data = f"{line}\n".encode("utf-8", "replace")
        try:
            while data:
                try:
                    data = data[os.write(self._descriptor, data) :]
                except BlockingIOError:  # somebody has made the terminal nonblocking; it is everybody's
                    select.select([], [self._descriptor], [])
        except (OSError, ValueError):
            speak_into_nothing(self._descriptor)


def speak_into_nothing(descriptor: int) -> None:
    """Whatever is still to be said there is lost, and nothing that says it fails any more."""
    with contextlib.suppress(OSError, ValueError):
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, descriptor)
        os.close(nothing)
