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
from pathlib import Path
from typing import Any

from companion.campaign.predict import gate_prediction
from companion.config import Flight
from companion.errors import CompanionError, ExitCode
from companion.flight.preflight import gate_gains, gate_reference
from companion.flight.tracker import kernels
from companion.record.folder import create_flight_folder, write_configuration
from companion.trajectory.load import of_flight

Listener = Callable[[Mapping[str, Any]], None]


@dataclass(frozen=True)
class Flown:
    """A flight that the control process has finished."""

    folder: Path
    exit_code: int
    sentence: str
    """How it ended, for people."""


def prepare(flight: Flight, out: Path | None) -> Path:
    """All gates that need no vehicle, then the flight folder with its flight.toml.

    Raises:
        CompanionError: a gate refuses, or the folder cannot be written; nothing has connected yet.
    """
    trajectory = of_flight(flight)
    gate_gains(flight.vehicle)
    gate_reference(trajectory, flight.vehicle)
    gate_prediction(flight, trajectory, kernels("python"))
    folder = create_flight_folder(flight.name, out)
    write_configuration(folder, flight.model_dump(exclude_none=True))
    return folder


def control(folder: Path, connection: str, engine: str, timeout_s: float, listen: Listener) -> Flown:
    """Runs the control process and follows its status; SIGINT and SIGTERM are passed on to it.

    Args:
        folder: prepared by `prepare`.
        connection: the vehicle link.
        engine: "auto", "python" or "numba".
        timeout_s: how long to wait for a vehicle.
        listen: gets every status message: {"line"}, {"progress"}, {"ready"}, {"error"} or {"outcome"}.
    """
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours:
        with theirs:
            process = subprocess.Popen(
                [
                    *(sys.executable, "-m", "companion.flight.process"),
                    *(str(folder), connection, engine, str(timeout_s), str(theirs.fileno())),
                ],
                pass_fds=(theirs.fileno(),),
                stdin=subprocess.DEVNULL,
                stdout=sys.stderr,
                start_new_session=True,  # Ctrl-C in the terminal reaches the flight once, through here
            )
        with _passing_on_signals(process):
            last = _follow(ours, listen)
            code = process.wait()
    if "error" in last:
        raise _failure(str(last["error"]), code)
    if code < 0:
        return Flown(folder, ExitCode.INTERNAL, f"the control process was ended by signal {-code}")
    return Flown(folder, code, str(last.get("outcome", "the control process ended without a word; see above")))


@contextlib.contextmanager
def _passing_on_signals(process: subprocess.Popen[bytes]) -> Any:
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def pass_on(number: int, _: object) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(process.pid, signal.SIGINT if number == signal.SIGINT else signal.SIGTERM)

    before = {number: signal.signal(number, pass_on) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _follow(channel: socket.socket, listen: Listener) -> dict[str, Any]:
    """Reads status until the control process closes its end; returns the messages merged, the latest of each kind."""
    merged: dict[str, Any] = {}
    with selectors.DefaultSelector() as selector:
        selector.register(channel, selectors.EVENT_READ)
        while True:
            selector.select()
            data = channel.recv(65536)
            if not data:
                return merged
            message = json.loads(data)
            merged.update(message)
            listen(message)


def _failure(text: str, code: int) -> CompanionError:
    error = CompanionError(text)
    error.exit_code = code
    return error
