"""The control process: everything between a validated flight folder and its record, in a process of its own.

`fly` (the ground side: command line, display) starts it with `python -m companion.flight.process`, hands it a flight
folder that holds `flight.toml`, and reads status datagrams from a Unix socket pair. The control process owns the
vehicle link; if the ground side dies, the flight goes on and its results are written all the same.
"""

from __future__ import annotations

import contextlib
import json
import signal
import socket
import sys
import traceback
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from companion.config import Flight, build_flight, read_toml
from companion.errors import CompanionError, ExitCode
from companion.flight.accounting import Progress
from companion.flight.controller import controller_of
from companion.flight.engines import Kernels, kernels
from companion.flight.host import Host
from companion.flight.loop import FlightLoop
from companion.flight.phases import PHASE_NAMES, Cause, Outcome
from companion.flight.preflight import BASELINE_PARAMETERS, gate_gains
from companion.link.framing import refused_since
from companion.link.transport import parse_connection
from companion.link.vehicle_link import VehicleLink
from companion.link.wire import COMPANION_COMPONENT, Wire
from companion.realtime import prepare, take_core_of_two, take_priority
from companion.record.flight_record import RECORD_FILE, FlightRecord
from companion.record.folder import CONFIGURATION_FILE, SUMMARY_FILE, write_summary
from companion.record.recorder import Recorder
from companion.record.summary import FlightMeta, met, note_end, summarise
from companion.record.ulog import ULOG_FILE, Level
from companion.trajectory.anchored import Trajectory
from companion.trajectory.load import of_flight

MARGIN_S = 120.0
"""Time that the record has room for beside the trajectory: join, stop, handing over."""


class Status:
    """Sends what the ground side may show; never blocks, and does not mind when nobody listens."""

    def __init__(self, channel: socket.socket) -> None:
        self._channel = channel
        channel.setblocking(False)

    def send(self, **content: Any) -> None:
        """One JSON datagram."""
        with contextlib.suppress(OSError):
            self._channel.send(json.dumps(content).encode())

    def line(self, text: str) -> None:
        """A line for people."""
        self.send(line=text)

    def progress(self, progress: Progress) -> None:
        """How far the flight is."""
        self.send(progress=progress._asdict())


class Signals:
    """SIGINT, SIGTERM and SIGHUP: before there is a loop they end the process, afterwards they ask it to hand over."""

    def __init__(self) -> None:
        self._loop: FlightLoop | None = None
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, self._on_signal)

    def hand_to(self, loop: FlightLoop) -> None:
        """From now on the loop is told."""
        self._loop = loop

    def _on_signal(self, number: int, frame: object) -> None:
        if self._loop is None:
            raise KeyboardInterrupt
        self._loop.interrupt()


@dataclass
class Ready:
    """A flight that only the link is missing for."""

    folder: Path
    flight: Flight
    trajectory: Trajectory
    compiled: Kernels
    record: FlightRecord
    recorder: Recorder

    @classmethod
    def made(cls, folder: Path, engine: str, line: Callable[[str], None]) -> Ready:
        """Reads and gates the flight of a folder, compiles, reserves, and starts the recorder.

        Args:
            folder: holds flight.toml.
            engine: "auto", "python" or "numba".
            line: gets lines for people.

        Raises:
            CompanionError: the flight is not to be flown as it stands.
        """
        path = folder / CONFIGURATION_FILE
        flight = build_flight(read_toml(path), str(path))
        trajectory = of_flight(flight)
        compiled = kernels(engine)
        if flight.output.controller == "law":
            gate_gains(flight.vehicle, flight.output.by_law, brief=True)
            line(f"engine: {compiled.engine}")
        elif flight.output.controller == "px4":
            line("controller: PX4's own, it gets the reference as setpoints")
        else:
            line("controller: a cautious hover, with the manoeuvres of a calibration")
        warm_up(flight, compiled)
        capacity = int((trajectory.duration_s + MARGIN_S) * flight.vehicle.link.state_rate_hz * 1.1)
        record = FlightRecord(capacity, PHASE_NAMES)
        recorder = Recorder.start(folder)
        record.sink = recorder.offer_row
        return cls(folder, flight, trajectory, compiled, record, recorder)

    def loop(
        self,
        wire: Wire,
        status: Status,
        *,
        connection: str,
        timeout_s: float,
        system: int | None = None,
        host: Host | None = None,
    ) -> FlightLoop:
        """The loop that flies it over a link; arguments as of `FlightLoop`."""

        def notify(line: str) -> None:
            status.line(line)
            self.recorder.note(line)

        def pace(waits: bool) -> None:
            if waits:
                self.recorder.give_way()
                self.record.sink = self.recorder.offer_row_in_lockstep
                take_core_of_two(parse_connection(connection).number)
            else:  # in lockstep it would be taken from the vehicle, for which both wait
                take_priority()

        return FlightLoop(
            *(self.flight, self.trajectory, wire, self.record, self.compiled, notify, status.progress),
            connect_timeout_s=timeout_s,
            connection=connection,
            system=system,
            host=host,
            paced=pace,
            met=self.recorder.follow,
            engaged=lambda engagement: self.recorder.state("engagement", json.dumps(asdict(engagement))),
            delayed=lambda delays: self.recorder.state("delays", json.dumps(delays)),
        )

    def note_outcome(self, outcome: Outcome) -> None:
        """The last line of the log, and what a summary needs to know beyond it."""
        self.recorder.state("outcome", json.dumps(outcome.told()))
        ended_well = outcome.cause in {Cause.COMPLETED, Cause.STOPPED}
        self.recorder.note(outcome.sentence, Level.NOTICE if ended_well else Level.ERROR)

    def close(self, status: Status, outcome: Outcome | None) -> int:
        """Ends the recorder, writes record and summary into the folder, and returns the exit code.

        Args:
            status: gets what went wrong.
            outcome: how the flight ended; None: it never began.
        """
        self.recorder.close()
        if self.recorder.problem:
            status.line(self.recorder.problem)
        if outcome is None:
            return int(ExitCode.INTERNAL)
        if outcome.fault:
            print(outcome.fault, file=sys.stderr)
        whole = not self.recorder.problem
        return _finish(self.folder, self.flight, self.trajectory, self.record, outcome, status, log_whole=whole)


def fly(
    folder: Path,
    link: VehicleLink,
    engine: str,
    timeout_s: float,
    status: Status,
    signals: Signals,
    *,
    realtime: bool = False,
) -> int:
    """Flies the flight of a folder and writes record and summary into it. Returns the exit code."""
    ready = Ready.made(folder, engine, status.line)
    if realtime:
        ask_the_system(status.line)
    outcome = None
    connection = link.connection
    try:
        with link.open(ready.recorder.offer) as wire:
            loop = ready.loop(wire, status, connection=connection, timeout_s=timeout_s)
            signals.hand_to(loop)
            status.send(ready=True)
            outcome = loop.run()
            outcome.refused_messages = refused_since(wire.refusals, {})
            ready.note_outcome(outcome)
            status.send(flown=True)
    finally:
        code = ready.close(status, outcome)
    return code


def ask_the_system(line: Callable[[str], None]) -> None:
    """`--realtime`, with a line for people about each of its parts."""
    for measure in prepare():
        line(measure.sentence)


def warm_up(flight: Any, compiled: Any) -> None:
    """Compiles or loads what a control step needs, before anything connects: nothing is compiled in the air."""
    from companion.control.types import State
    from companion.flight.course import at_rest
    from companion.flight.following import Following
    from companion.flight.reckoning import Reckoner
    from companion.flight.reflex import Reflex

    tracker = controller_of(flight, compiled)
    zero = (0.0, 0.0, 0.0)
    state = State(zero, zero, (1.0, 0.0, 0.0, 0.0), zero)
    tracker.begin(state)
    for i in range(3):
        tracker.command(1.0 + i / flight.vehicle.link.state_rate_hz, state, lambda t: at_rest(zero, 0.0))
    if compiled.engine == "numba":
        Reflex(1, (1, COMPANION_COMPONENT))
        Reckoner()
        Following(flight.vehicle.autopilot.rate_lag_s, compiled.engine)


def _finish(
    folder: Path,
    flight: Any,
    trajectory: Any,
    record: FlightRecord,
    outcome: Outcome,
    status: Status,
    *,
    log_whole: bool,
) -> int:
    code = int(outcome.cause.value.exit_code)
    if outcome.phases:
        meta = FlightMeta(
            trajectory.name,
            flight.vehicle.name,
            outcome.lost_setpoints,
            flight.statistics_from_s,
            flight.acceptance.thresholds(),
            flight.output.controller,
        )
        summary = summarise(record, outcome.phases, meta)
        engagement = None if outcome.engagement is None else asdict(outcome.engagement)
        read = outcome.parameters
        px4_parameters = {name: read[name] for name in BASELINE_PARAMETERS if name in read}
        note_end(summary, outcome.told(), engagement, px4_parameters)
        if outcome.cause is Cause.COMPLETED and not met(summary["verdict"]):
            code = int(ExitCode.MISSED)
        if not _written(folder, record, summary, status, log_whole=log_whole):
            status.line(f"verdict: {summary['verdict']}")
    status.send(outcome=outcome.sentence, cause=outcome.cause.name)
    return code


def _written(folder: Path, record: FlightRecord, summary: dict[str, Any], status: Status, *, log_whole: bool) -> bool:
    """Whether record and summary are on the disk; one that did not take them is no fault of the program, and said."""
    parts: dict[str, Callable[[], object]] = {
        RECORD_FILE: lambda: record.save(folder),
        SUMMARY_FILE: lambda: write_summary(folder, summary),
    }
    done = True
    for name, write in parts.items():
        try:
            write()
        except OSError as error:
            done = False
            left = f"; {ULOG_FILE} holds the flight so far" if log_whole else ""
            status.line(f"{folder / name}: cannot be written ({error.strerror}){left}")
            with contextlib.suppress(OSError):
                (folder / f".{name}.part").unlink(missing_ok=True)
    return done


def main() -> int:
    """Arguments: folder, vehicle link (JSON), engine, connect timeout [s], file descriptor of the status channel, and
    "realtime" where that is wanted."""
    folder, link, engine, timeout, descriptor, *more = sys.argv[1:]
    realtime = more == ["realtime"]
    status = Status(socket.socket(fileno=int(descriptor)))
    try:
        signals, vehicle = Signals(), VehicleLink.from_json(link)
        return fly(Path(folder), vehicle, engine, float(timeout), status, signals, realtime=realtime)
    except CompanionError as error:
        status.send(error=str(error))
        return int(error.exit_code)
    except KeyboardInterrupt:
        status.send(outcome=f"{Cause.INTERRUPTED.value.sentence}: before anything connected")
        return int(ExitCode.INTERRUPTED)
    except Exception as error:
        traceback.print_exc()
        status.send(outcome=f"{Cause.FAULT.value.sentence}: {type(error).__name__}: {error}")
        return int(ExitCode.INTERNAL)


if __name__ == "__main__":
    sys.exit(main())
