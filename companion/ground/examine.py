"""The vehicle's own check of a file that came, in a process of its own.

Planning through hundreds of waypoints takes seconds, and a hostile file may want to take hours and all the memory: the
check runs apart from the program that talks to the ground, with a limit on its time and its memory, at a low priority.
The file is on the disk (fsync) before the verdict is given.
"""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple, Protocol

from companion.errors import CompanionError

Check = Callable[[Path], str]
"""Takes a file; returns the verdict in words, or raises a CompanionError (a refusal, or what is wrong with it)."""

VERDICT_CHARACTERS_MAX: Final = 400
TIME_MAX_S: Final = 60.0
MEMORY_MAX_BYTES: Final = 4 << 30
"""Of address space, of which the numerical libraries take much and use little."""
_NICENESS = 10


class Finding(NamedTuple):
    """What a check found."""

    accepted: bool
    verdict: str


class Examination(Protocol):
    """One check that is under way."""

    def poll(self) -> Finding | None:
        """What was found, once it was. Never blocks."""

    def cancel(self) -> None:
        """Stops it."""


class Examiner(Protocol):
    """Who checks."""

    def begin(self, path: Path) -> Examination:
        """Begins to check a file; at most one check runs at a time."""


class Examined:
    """A check that is over."""

    def __init__(self, finding: Finding) -> None:
        self._finding = finding

    def poll(self) -> Finding:
        """What was found."""
        return self._finding

    def cancel(self) -> None:
        """Nothing is left to stop."""


class Here:
    """Checks in this process, at once: for checks that take no time."""

    def __init__(self, check: Check) -> None:
        self._check = check

    def begin(self, path: Path) -> Examination:
        """Checks."""
        return Examined(run_check(self._check, path))


class Apart:
    """Checks in a process of its own."""

    def __init__(self, check: Check, time_max_s: float = TIME_MAX_S, memory_max_bytes: int = MEMORY_MAX_BYTES) -> None:
        """Prepare it.

        Args:
            check: a function of a module, or a `functools.partial` of one (it is pickled).
            time_max_s: how long a check may take; a file that takes longer is refused.
            memory_max_bytes: address space that it may have.
        """
        self._order = pickle.dumps((check, memory_max_bytes, int(time_max_s) + 1))
        self._time_max_s = time_max_s

    def begin(self, path: Path) -> Examination:
        """Starts the process."""
        try:
            process = subprocess.Popen(
                [sys.executable, "-m", "companion.ground.examine"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
            )
        except OSError as error:
            return Examined(Finding(False, f"the check could not be started: {error.strerror}"))
        assert process.stdin is not None
        with contextlib.suppress(BrokenPipeError), process.stdin:
            process.stdin.write(self._order + os.fsencode(path))  # far less than a pipe holds
        return _Process(process, self._time_max_s)


class _Process:
    """A check in another process."""

    def __init__(self, process: subprocess.Popen[bytes], time_max_s: float) -> None:
        self._process = process
        self._time_max_s = time_max_s
        self._end_s = time.monotonic() + time_max_s

    def poll(self) -> Finding | None:
        """What was found, once it was."""
        code = self._process.poll()
        if code is None:
            if time.monotonic() < self._end_s:
                return None
            self.cancel()
            return Finding(False, f"the check did not end within {self._time_max_s:.0f} s")
        assert self._process.stdout is not None
        with self._process.stdout as out:
            said = out.read()
        try:
            accepted, verdict = json.loads(said)
        except ValueError:
            how = f"signal {-code}" if code < 0 else f"exit code {code}"
            return Finding(False, f"the check broke off ({how})")
        return Finding(bool(accepted), str(verdict))

    def cancel(self) -> None:
        """Kills it."""
        self._process.kill()
        self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()


def run_check(check: Check, path: Path) -> Finding:
    """Checks a file here and now; whatever goes wrong is a refusal."""
    try:
        with path.open("rb") as file:
            os.fsync(file.fileno())
        finding = Finding(True, check(path))
    except CompanionError as error:
        finding = Finding(False, str(error))
    except Exception as error:  # a fault of the check must not let a file pass, nor end the service
        finding = Finding(False, f"the check failed: {type(error).__name__}: {error}")
    words = " ".join(finding.verdict.split())
    if len(words) > VERDICT_CHARACTERS_MAX:
        words = words[: VERDICT_CHARACTERS_MAX - 3] + "..."
    return Finding(finding.accepted, words)


def _main() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    out = os.dup(1)
    os.dup2(2, 1)  # what a library prints is no verdict
    check, memory_max_bytes, cpu_max_s = pickle.load(sys.stdin.buffer)  # from the program that started this one
    path = Path(os.fsdecode(sys.stdin.buffer.read()))
    os.nice(max(0, _NICENESS - os.nice(0)))  # not on top of the ground process's own
    resource.setrlimit(resource.RLIMIT_AS, (memory_max_bytes, memory_max_bytes))
    resource.setrlimit(resource.RLIMIT_CPU, (cpu_max_s, cpu_max_s))
    with os.fdopen(out, "w") as result:
        json.dump(run_check(check, path), result)


if __name__ == "__main__":
    _main()
