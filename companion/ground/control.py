"""The control process of `companion serve`: owns the vehicle link, flies when asked to, and waits otherwise.

While it waits it sends heartbeats, answers the vehicle's clock and never a setpoint: whatever mode it finds the vehicle
in after a restart, it leaves it there. A flight is the loop of `companion.flight`, with this process as its host: what
the ground process asks is looked at once per control turn, and takes microseconds when there is nothing.
"""

from __future__ import annotations

import contextlib
import math
import signal
import socket
import sys
import time
import traceback
from collections import deque
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from companion.config import build_flight
from companion.errors import CompanionError, ExitCode, InputError, LinkError
from companion.flight.accounting import Progress
from companion.flight.connect import AUTOPILOT_COMPONENT
from companion.flight.engines import kernels
from companion.flight.loop import FlightLoop
from companion.flight.phases import Cause, LandedState, Order, Phase
from companion.flight.process import Status, ask_the_system, warm_up
from companion.flight.retuning import ParameterChange
from companion.ground.channel import Channel, Copy, Outgoing
from companion.ground.filter import Gate
from companion.ground.hosting import tuned, tuning_of, vehicle_of
from companion.ground.messages import targets_of
from companion.ground.parameter_messages import PARAM_REQUEST_LIST
from companion.ground.parameters import WHAT as PARAMETERS
from companion.ground.preparation import Closing, Preparation
from companion.ground.report import Report
from companion.ground.settings import Settings
from companion.ground.standby import Standby
from companion.ground.standing import IDLE, PREPARING, Standing
from companion.ground.undertakings import Undertakings
from companion.link import codec, modes
from companion.link.framing import Frame, refused_since
from companion.link.operations import Operation
from companion.link.wire import COMPANION_COMPONENT
from companion.record.recorder import Recorder

STANDING_INTERVAL_NS: Final = 200_000_000
ITEMS_PER_TURN: Final = 4
"""Of the ground process, so that it cannot keep a control turn."""
CONNECT_TIMEOUT_S: Final = 15.0

COPIED: Final = frozenset({0, 1, 22, 24, 44, 47, 51, 73, 77, 110, 147, 148, 242, 245, 253, 345})
"""Of the autopilot's messages the ground process gets these: HEARTBEAT, SYS_STATUS, PARAM_VALUE, GPS_RAW_INT, the
mission protocol's answers, COMMAND_ACK, FTP, BATTERY_STATUS, AUTOPILOT_VERSION, HOME_POSITION, EXTENDED_SYS_STATE,
STATUSTEXT, PARAM_ERROR."""

_NOT_YET_FLYING: Final = {Phase.CONNECT, Phase.PREFLIGHT}
_ORDERS: Final = {order.value: order for order in Order}


class Control:
    """The program; implements `flight.host.Host`.

    Args:
        settings: of `companion serve`.
        channel: to the ground process.
        report: to the supervisor.

    Raises:
        InputError: the file with what was changed from the ground cannot be used.
    """

    def __init__(self, settings: Settings, channel: Channel, report: Report) -> None:
        self._settings = tuned(settings, tuning_of(settings).overrides)
        self._vehicle = vehicle_of(settings)
        """As its file has it, without what was changed from the ground."""
        self._channel = channel
        self._report = report
        self._gate = Gate()
        self._undertakings = Undertakings(self._on_end)
        self._lines: deque[str] = deque()
        self._recorder: Recorder | None = None
        self._landing: tuple[int, Operation] | None = None
        self._preparation: Preparation | None = None
        self._closing: Closing | None = None
        self._loop: FlightLoop | None = None
        self._standing = Standing()
        self._standing_ns = 0
        self._stopping = False
        self._abandoned = False
        """Whether the flight that is being prepared is not wanted any more."""

    # -- the program ----------------------------------------------------------------------------------------------

    def run(self) -> int:
        """Until told to stop.

        Raises:
            InputError, LinkError: the vehicle link cannot be had, or is gone.
        """
        self._warm_up()
        if self._settings.realtime:
            ask_the_system(self._say)
        with self._settings.link.open(self._tap) as wire:
            self._wire = wire
            self._standby = Standby(wire, self.on_frame, self._say)
            self._report.send(ready=True)
            while not self._stopping:
                self._idle_turn()
                preparation = self._preparation
                if preparation is not None and preparation.over and self._closed():
                    self._preparation = None
                    self._fly(preparation)
        if self._closing is not None:
            self._closing.wait()
        self._flush_lines()
        return int(ExitCode.DONE)

    def stop(self) -> None:
        """Ends the program, after handing a flight over; safe to call from a signal handler."""
        self._stopping = True
        if self._loop is not None:
            self._loop.interrupt()

    def _warm_up(self) -> None:
        """Compiles or loads the kernels before anything connects."""
        hover = {"name": "hover", "shape": "hover", "duration_s": 1.0, "hover": {"point_m": [0.0, 0.0, 0.0]}}
        flight = build_flight({**self._settings.flight, "name": "hover", "trajectory": hover}, "companion serve")
        warm_up(flight, kernels(self._settings.engine))
        targets_of(codec.HEARTBEAT, b"")  # its table is made at the first call

    def _tap(self, direction: int, raw: bytes, wall_ns: int) -> None:
        recorder = self._recorder
        if recorder is not None:
            recorder.offer(direction, raw, wall_ns)

    # -- waiting --------------------------------------------------------------------------------------------------

    def _idle_turn(self) -> None:
        self._standby.turn()
        self._stopping = self._stopping or self._report.closed
        self._follow_landing()
        self.turn()

    def _closed(self) -> bool:
        """Whether the results of the flight before are away: no thread may run beside a flight."""
        if self._closing is not None and self._closing.over:
            self._closing = None
        return self._closing is None

    # -- flying ---------------------------------------------------------------------------------------------------

    def _fly(self, preparation: Preparation) -> None:
        """Flies what is ready; returns when the vehicle is handed over or down."""
        ready, status = preparation.ready, _FlightStatus(self)
        if self._abandoned or self._stopping:
            self._abandoned = False
            if ready is not None:
                ready.close(status, None)
            self._standing = replace(self._standing, phase=IDLE, ended="stopped before it began")
            return
        if ready is None:
            self._say(f"refused: {preparation.refusal}", warning=True)
            self._standing = replace(self._standing, phase=IDLE, ended=f"refused: {preparation.refusal}")
            self._undertakings.fail(preparation.refusal)
            return
        self._recorder = ready.recorder
        self._loop = loop = ready.loop(
            self._wire,
            status,
            connection=self._settings.connection,
            timeout_s=CONNECT_TIMEOUT_S,
            system=self._standby.system,
            host=self,
        )
        refused_before = self._wire.refusals
        outcome = loop.run()
        outcome.refused_messages = refused_since(self._wire.refusals, refused_before)
        ready.note_outcome(outcome)
        self._wire.tell()
        self._recorder = None
        self._loop = None
        self._standby.autopilot = replace(loop.autopilot)
        well = outcome.cause in {Cause.COMPLETED, Cause.STOPPED}
        self._standing = replace(self._standing, phase=IDLE, paused=False, ended=outcome.sentence)
        self._flush_lines()
        self._say(outcome.sentence, warning=not well)
        self._undertakings.check()
        self._undertakings.fail(outcome.sentence)
        self._report.send(flight=str(ready.folder), outcome=outcome.sentence)
        self._closing = Closing(ready, outcome, status, report=self._settings.reports)

    def on_progress(self, progress: Progress) -> None:
        """How far the flight is."""
        north, east, down = progress.disturbance_m_s2
        by_law = math.isfinite(progress.lyapunov)
        self._standing = replace(
            self._standing,
            track_s=progress.t_s,
            duration_s=progress.duration_s,
            to_go_s=progress.to_go_s,
            error_m=progress.error_m,
            lyapunov=progress.lyapunov if by_law else None,
            disturbance_m_s2=(north, east, down) if by_law and math.isfinite(north) else None,
            steps=progress.steps,
        )

    # -- the host of a flight -------------------------------------------------------------------------------------

    def on_frame(self, frame: Frame) -> None:
        """Copies for the ground process what it can use: the autopilot's slow messages, and what is addressed to us."""
        if frame.sysid == self._standby.system and frame.compid == AUTOPILOT_COMPONENT:
            if frame.msgid == codec.HEARTBEAT:
                self._standby.on_heartbeat(frame)
            if frame.msgid not in COPIED:
                return
        else:
            targets = targets_of(frame.msgid, frame.payload)
            if targets is None:
                return
            listed = frame.msgid == PARAM_REQUEST_LIST and targets.component == 0  # ground stations ask everybody
            if targets.component != COMPANION_COMPONENT and not listed:
                return
        self._channel.copy(frame.raw)

    def turn(self) -> None:
        """What the ground process wants, and how things stand for it. Never raises."""
        try:
            for item in self._channel.receive(ITEMS_PER_TURN):
                if isinstance(item, Outgoing):
                    self._send_for_ground(item)
                elif not isinstance(item, Copy):
                    self._on_note(item)
            self._undertakings.check()
            self._flush_lines()
            wall_ns = time.monotonic_ns()
            if wall_ns - self._standing_ns > STANDING_INTERVAL_NS:
                self._standing_ns = wall_ns
                self._tell_standing()
        except Exception:  # whatever is wrong between the processes must not end a flight
            with contextlib.suppress(Exception):
                self._report.line("a fault of the program: " + traceback.format_exc(limit=3))

    def _send_for_ground(self, item: Outgoing) -> None:
        if self._gate.passes(item.msgid, item.payload, self._standby.system, time.monotonic()):
            self._wire.send(item.msgid, item.payload)

    def _tell_standing(self) -> None:
        loop = self._loop
        autopilot = self._standby.autopilot if loop is None else loop.autopilot
        mode = autopilot.mode
        phase = self._standing.phase
        if loop is not None:
            phase = loop.phase.value
        elif phase not in {IDLE, PREPARING}:
            phase = IDLE
        self._standing = replace(
            self._standing,
            system=self._standby.system,
            heard=self._standby.heard,
            mode=None if mode is None else mode.label,
            custom_mode=0 if mode is None else mode.custom_mode,
            armed=autopilot.armed,
            phase=phase,
            paused=loop is not None and loop.paused,
            refused=self._wire.refusals,
        )
        self._channel.note(standing=self._standing.as_note())

    # -- requests -------------------------------------------------------------------------------------------------

    def _on_note(self, note: dict[str, Any]) -> None:
        number, what = note.get("request"), note.get("what")
        if not isinstance(number, int) or not isinstance(what, str):
            return
        if what == "start":
            refusal = self._start(number, note)
        elif what == PARAMETERS:
            refusal = self._retune(note)
        elif what in _ORDERS:
            refusal = self._order(number, _ORDERS[what])
        else:
            refusal = f"{what}: this version does not know how"
        self._channel.note(taken=number, refusal=refusal)

    def _start(self, number: int, note: dict[str, Any]) -> str:
        name, path, identity = note.get("name"), note.get("path"), note.get("id")
        if not (isinstance(name, str) and isinstance(path, str) and isinstance(identity, int)):
            return "start: incomplete request"
        if self._loop is not None or self._preparation is not None:
            return f"start: {self._standing.trajectory} is under way; stop it first"
        if not self._standby.heard:
            return f"start: no autopilot is heard at {self._settings.connection}"
        before = self._standing
        self._standing = Standing(
            system=before.system,
            heard=before.heard,
            mode=before.mode,
            custom_mode=before.custom_mode,
            armed=before.armed,
            phase=PREPARING,
            trajectory=name,
            trajectory_id=identity,
        )
        self._undertakings.add(number, "start", self._begun)
        self._say(f"start {name}: checking")
        self._preparation = Preparation(self._settings, name, Path(path), self._lines.append)
        return ""

    def _retune(self, note: dict[str, Any]) -> str:
        """Other gains, limits or another heading: a flight that is under way goes over to them, later ones begin so."""
        if self._preparation is not None:
            return "a flight is being prepared; try again in a moment"
        try:
            change = ParameterChange.from_note(note.get("change"))
            if self._loop is None:
                change.applied(self._vehicle)
        except InputError as error:
            return str(error)
        refusal = "" if self._loop is None else self._loop.retune(change)
        if not refusal:
            self._settings = tuned(self._settings, change.overrides)
        return refusal

    def _begun(self) -> bool:
        return self._loop is not None and self._loop.phase not in _NOT_YET_FLYING

    def _order(self, number: int, order: Order) -> str:
        loop = self._loop
        if loop is None:
            return self._order_idle(number, order)
        refusal = loop.order(order)
        if not refusal:
            self._undertakings.replace(order.value)
            self._undertakings.add(number, order.value, lambda: self._followed(loop, order))
        return refusal and f"{order.value}: {refusal}"

    def _followed(self, loop: FlightLoop, order: Order) -> bool:
        """Whether the flight is where an order wanted it."""
        over = self._loop is not loop
        if order is Order.PAUSE:
            return loop.paused and not over
        if order is Order.RESUME:
            return loop.phase in {Phase.JOIN, Phase.TRACK, Phase.HOLD} and not over
        if order is Order.LAND:
            landing = loop.phase is Phase.LAND and loop.autopilot.mode == modes.LAND
            return landing or (over and loop.autopilot.landed is LandedState.ON_GROUND)
        return over

    def _order_idle(self, number: int, order: Order) -> str:
        """Without a flight there is nothing to pause; landing is asked of the autopilot."""
        if self._preparation is not None:
            if order is not Order.STOP:
                return f"{order.value}: the flight is being prepared; stop it, or try again in a moment"
            self._abandoned = True
            self._undertakings.fail("stopped by the operator")
            self._undertakings.add(number, order.value, lambda: self._preparation is None)
            return ""
        if order is not Order.LAND or self._standby.operations is None:
            return f"{order.value}: nothing is being flown"
        if self._landing is not None:
            return "land: a landing is being asked for already"
        self._landing = number, self._standby.operations.land(time.monotonic())
        return ""

    def _follow_landing(self) -> None:
        if self._landing is None or self._landing[1].pending:
            return
        number, operation = self._landing
        self._landing = None
        if not operation.accepted:
            self._say(operation.sentence, warning=True)
        self._on_end(number, operation.accepted, "" if operation.accepted else operation.sentence)

    def _on_end(self, number: int, done: bool, sentence: str) -> None:
        self._tell_standing()  # first: who hears that it is done must not find things as they were
        self._channel.note(done=number, well=done, sentence=sentence)

    # -- telling people -------------------------------------------------------------------------------------------

    def say_line(self, line: str) -> None:
        """A line of the flight for people."""
        self._say(line)

    def _say(self, line: str, *, warning: bool = False) -> None:
        self._channel.note(line=line, warning=warning)
        self._report.line(line)

    def _flush_lines(self) -> None:
        while self._lines:
            self._say(self._lines.popleft())


class _FlightStatus(Status):
    """What a flight says goes to the ground process and the supervisor; lines of other threads wait for their turn."""

    def __init__(self, control: Control) -> None:
        self._control = control

    def send(self, **content: Any) -> None:
        """The outcome is told by the control process itself."""

    def line(self, text: str) -> None:
        """A line for people."""
        self._control._lines.append(text)

    def progress(self, progress: Progress) -> None:
        """How far the flight is."""
        self._control.on_progress(progress)


def main() -> int:
    """Arguments: settings (JSON), file descriptors of the channel and of the supervisor's."""
    settings, channel_fd, report_fd = sys.argv[1:]
    report = Report(socket.socket(fileno=int(report_fd)))
    channel = Channel(socket.socket(fileno=int(channel_fd)))
    channel.discard()
    try:
        control = Control(Settings.from_json(settings), channel, report)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, lambda *_: control.stop())
        return control.run()
    except CompanionError as error:
        report.send(error=str(error))
        return int(error.exit_code) if not isinstance(error, LinkError) else int(ExitCode.LOST)
    except Exception as error:
        traceback.print_exc()
        report.send(error=f"a fault of the program: {type(error).__name__}: {error}")
        return int(ExitCode.INTERNAL)


if __name__ == "__main__":
    sys.exit(main())
