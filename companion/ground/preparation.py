"""Getting a flight ready beside the idle control process, and putting its results away afterwards.

Both are done by a thread: while nothing is being flown, a busy thread costs nobody anything. No flight begins while one
is alive.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from companion.config import build_flight
from companion.errors import CompanionError
from companion.flight.launch import prepare
from companion.flight.phases import Outcome
from companion.flight.process import Ready, Status
from companion.ground.settings import Settings
from companion.trajectory.load import embedded, load

_NICE: Final = 10


class Preparation:
    """One flight on its way to being ready.

    Args:
        settings: vehicle and folders.
        name: of the trajectory.
        path: of its file.
        line: gets lines for people; called from the thread.
    """

    def __init__(self, settings: Settings, name: str, path: Path, line: Callable[[str], None]) -> None:
        self.ready: Ready | None = None
        self.refusal = ""
        """Why there will be no flight."""
        self._settings, self._name, self._path, self._line = settings, name, path, line
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def over(self) -> bool:
        """Whether `ready` or `refusal` is there."""
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            self.ready = self._prepared()
        except CompanionError as error:
            self.refusal = str(error)
        except Exception as error:
            traceback.print_exc()
            self.refusal = f"a fault of the program: {type(error).__name__}: {error}"

    def _prepared(self) -> Ready:
        stem = Path(self._name).stem
        data: dict[str, Any] = {**self._settings.flight, "name": stem, "trajectory": str(self._path)}
        flight = build_flight(data, "companion serve")
        load(self._path, vehicle=flight.vehicle, confined=True)  # a file that came from somewhere names none elsewhere
        stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
        folder = prepare(embedded(flight), Path(self._settings.flights) / f"{stamp}-{stem}")
        return Ready.made(folder, self._settings.engine, self._line)


class Closing:
    """The results of one flight on their way to the disk; the report is built by a process of its own."""

    def __init__(self, ready: Ready, outcome: Outcome, status: Status, *, report: bool) -> None:
        self._ready, self._outcome, self._status, self._report = ready, outcome, status, report
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    @property
    def over(self) -> bool:
        """Whether everything is written."""
        return not self._thread.is_alive()

    def wait(self) -> None:
        """Until everything is written."""
        self._thread.join()

    def _run(self) -> None:
        try:
            self._ready.close(self._status, self._outcome)
            if self._report and self._outcome.engagement is not None:
                _build_report(self._ready.folder)
        except Exception as error:
            traceback.print_exc()
            self._status.line(f"the results of the flight could not all be written: {error}")


def _build_report(folder: Path) -> None:
    """Starts `companion report` at a low priority; its failure costs only the report."""
    with contextlib.suppress(OSError):
        subprocess.Popen(
            [sys.executable, "-c", _REPORT, str(folder)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
            cwd=os.sep,
        )


_REPORT: Final = (
    f"import os, sys; os.nice({_NICE}); from companion.realtime import rejoin; rejoin(); "
    "from companion.cli import main; sys.exit(main(['report', sys.argv[1]]))"
)
