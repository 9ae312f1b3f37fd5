"""The ground side of a flight: gates, folder, control process, status; used by `companion fly` and `companion demo`."""

from __future__ import annotations

import contextlib
import json
import os
import selectors
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from companion.campaign.predict import gate_prediction
from companion.config import Flight
from companion.errors import CompanionError, ExitCode
from companion.flight.course import Course
from companion.flight.engines import kernels
from companion.flight.preflight import gate_calibration, gate_gains, gate_place, gate_reference
from companion.flight.surroundings import gate_course
from companion.frames import radians
from companion.link.vehicle_link import VehicleLink
from companion.record.folder import create_flight_folder, write_configuration
from companion.trajectory.load import of_flight, stored

Listener = Callable[[Mapping[str, Any]], None]


@dataclass(frozen=True)
class Flown:
    """A flight that the control process has finished."""

    folder: Path
    exit_code: int
    sentence: str
    """How it ended, for people."""


_PASSED_MAX = 32
_passed: dict[str, None] = {}
"""Flights that passed all gates in this process, oldest first: the same flight again needs not wait for them."""


def gate(flight: Flight) -> None:
    """All gates that need no vehicle.

    Raises:
        CompanionError: a gate refuses.
    """
    trajectory = of_flight(flight)
    by_law = flight.output.controller == "law"  # the gains, and what is predicted with them, are the law's
    gate_calibration(flight)
    if by_law:
        gate_gains(flight.vehicle, flight.output.by_law, brief=True)
    gate_reference(trajectory, flight.vehicle)
    gate_place(trajectory, flight.height_min_m)
    if flight.start is not None:  # of any other it shows when the vehicle holds
        home, start = (0.0, 0.0, 0.0), flight.start
        where = start.position_m, radians(start.yaw_deg)
        gate_course(Course(trajectory, flight.vehicle, *where, home, flight.height_min_m))
    if by_law:
        gate_prediction(flight, trajectory, kernels("python"))


def prepare(flight: Flight, out: Path | None) -> Path:
    """All gates that need no vehicle, then the flight folder with its flight.toml.

    Raises:
        CompanionError: a gate refuses, or the folder cannot be written; nothing has connected yet.
    """
    identity = _identity(flight)
    if identity is None or identity not in _passed:
        gate(flight)
    if identity is not None:
        _passed[identity] = None
        while len(_passed) > _PASSED_MAX:
            del _passed[next(iter(_passed))]
    folder = create_flight_folder(flight.name, out)
    write_configuration(folder, stored(flight, folder).model_dump(exclude_none=True))
    return folder


def _identity(flight: Flight) -> str | None:
    """What tells this flight from every other; None where a file outside of it may change unnoticed."""
    table = flight.trajectory
    if isinstance(table, str) or ("file" in table and "sha256" not in table):
        return None
    return sha256(flight.model_dump_json().encode()).hexdigest()


def control(
    folder: Path, link: VehicleLink | str, engine: str, timeout_s: float, listen: Listener, *, realtime: bool = False
) -> Flown:
    """Runs the control process and follows its status; SIGINT and SIGTERM are passed on to it.

    Args:
        folder: prepared by `prepare`.
        link: to the vehicle; a connection string stands for one without a key.
        engine: "auto", "python" or "numba".
        timeout_s: how long to wait for a vehicle.
        listen: gets every status message: {"line"}, {"progress"}, {"ready"}, {"flown"}, {"error"} or {"outcome"}. One
            that raises is not called again: a broken display does not end a flight.
        realtime: ask the system for what `companion.realtime` names.

    Raises:
        CompanionError: the control process could not begin.
    """
    link = VehicleLink(link) if isinstance(link, str) else link
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, _Relay() as relay:
        with theirs:
            process = subprocess.Popen(
                [
                    *(sys.executable, "-m", "companion.flight.process"),
                    *(str(folder), link.as_json(), engine, str(timeout_s), str(theirs.fileno())),
                    *(("realtime",) if realtime else ()),
                ],
                pass_fds=(theirs.fileno(),),
                stdin=subprocess.DEVNULL,
                stdout=sys.stderr,
                start_new_session=True,  # Ctrl-C in the terminal reaches the flight once, through here
            )
        relay.to(process.pid)
        last = _follow(ours, listen)
        code = process.wait()
        relay.to(None)
    if "error" in last:
        raise _failure(str(last["error"]), code)
    if code < 0 and relay.came and "ready" not in last:
        return Flown(folder, ExitCode.INTERRUPTED, "interrupted by the operator: before anything connected")
    if code < 0:
        return Flown(
            folder,
            ExitCode.INTERNAL,
            f"the control process was ended by signal {-code}; the autopilot's own failsafe acts (COM_OBL_RC_ACT)",
        )
    return Flown(folder, code, str(last.get("outcome", "the control process ended without a word; see above")))


class _Relay:
    """While it lasts, signals that end a command go to the control process instead; a context manager.

    They arrive there as SIGTERM: a process that is still starting ends at it without a word, one that flies hands over.
    Other threads than the main one cannot have signals: there it does nothing.
    """

    _NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

    def __init__(self) -> None:
        self.came = False
        """Whether a signal came."""
        self._pid: int | None = None
        self._before: dict[int, Any] = {}

    def __enter__(self) -> _Relay:
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._pass_on) for number in self._NUMBERS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def to(self, pid: int | None) -> None:
        """Names the process; one that came before is passed on now."""
        self._pid = pid
        if self.came:
            self._send()

    def _pass_on(self, number: int, frame: object) -> None:
        self.came = True
        self._send()

    def _send(self) -> None:
        if self._pid is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._pid, signal.SIGTERM)


def _follow(channel: socket.socket, listen: Listener) -> dict[str, Any]:
    """Reads status until the control process closes its end; returns the messages merged, the latest of each kind."""
    merged: dict[str, Any] = {}
    shown = True
    with selectors.DefaultSelector() as selector:
        selector.register(channel, selectors.EVENT_READ)
        while True:
            selector.select()
            data = channel.recv(65536)
            if not data:
                return merged
            message = json.loads(data)
            merged.update(message)
            try:
                if shown:
                    listen(message)
            except Exception as error:
                shown = False
                with contextlib.suppress(OSError):
                    print(f"companion: the display failed ({error}); the flight goes on", file=sys.stderr)


def _failure(text: str, code: int) -> CompanionError:
    error = CompanionError(text)
    error.exit_code = code
    return error
