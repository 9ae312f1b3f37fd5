"""Files that wait for the vehicle's check: one at a time, uploads before what is stored already."""

from __future__ import annotations

import re
from collections import deque
from dataclasses import dataclass
from pathlib import Path

from companion.ground.examine import Examination, Examiner, Finding


@dataclass(eq=False)
class Submission:
    """An upload that is complete and waits for its verdict, or has it."""

    name: str
    size_bytes: int
    crc32: int
    finding: Finding | None = None
    """None while the check is under way."""
    id: int | None = None
    """Of the stored file, once it is accepted."""


@dataclass(eq=False)
class Job:
    """One file that is to be checked."""

    path: Path
    name: str
    """What people call it; the file may still have another name."""
    submission: Submission | None = None
    """None for a file that is stored already."""
    mtime_ns: int = 0
    """Of a stored file: which of its versions is checked."""
    void: bool = False
    """Whether what is found does not count any more: the file, or one that it names, has changed since it began."""


class Checks:
    """The queue, and the check that runs."""

    def __init__(self, examiner: Examiner) -> None:
        self._examiner = examiner
        self._uploads: deque[Job] = deque()
        self._stored: deque[Job] = deque()
        self._running: tuple[Job, Examination] | None = None

    def add(self, job: Job) -> None:
        """Have a file checked; a stored one waits once, as it was last, and a check of it that runs is void."""
        if job.submission is not None:
            self._uploads.append(job)
            return
        if self._running is not None and self._running[0].submission is None and self._running[0].name == job.name:
            self._running[0].void = True
        waiting = next((i for i, other in enumerate(self._stored) if other.name == job.name), None)
        if waiting is None:
            self._stored.append(job)
        else:
            self._stored[waiting] = job

    def submitted(self) -> list[Job]:
        """The uploads that have no verdict yet."""
        running = [] if self._running is None else [self._running[0]]
        return [job for job in [*running, *self._uploads] if job.submission is not None]

    def next(self) -> tuple[Job, Finding] | None:
        """The next file that has its verdict; None while there is none. Never waits."""
        while True:
            while self._running is None:
                if not self._uploads and not self._stored:
                    return None
                job = (self._uploads or self._stored).popleft()
                if job.path.exists():  # it may have been removed or renamed meanwhile
                    self._running = (job, self._examiner.begin(job.path))
            job, examination = self._running
            finding = examination.poll()
            if finding is None:
                return None
            self._running = None
            if not job.void:
                return job, finding._replace(verdict=_renamed(finding.verdict, job))

    def close(self) -> None:
        """Stop what runs, forget what waits."""
        if self._running is not None:
            self._running[1].cancel()
        self._running = None
        self._uploads.clear()
        self._stored.clear()


def _renamed(verdict: str, job: Job) -> str:
    """The verdict with the name that people know, without the folder."""
    return re.sub(r"(?:[^\s'\"]*/)?" + re.escape(job.path.name), lambda _: job.name, verdict)
