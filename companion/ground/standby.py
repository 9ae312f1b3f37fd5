"""The vehicle link while nothing is flown: hearing the autopilot, answering its clock, never a setpoint."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Final

from companion.flight.connect import AUTOPILOT_COMPONENT, autopilot_system, send_heartbeat
from companion.flight.phases import Autopilot, FlightEnded
from companion.flight.reports import take_heartbeat, take_report
from companion.link import codec, modes, timesync
from companion.link.framing import Frame
from companion.link.operations import Operations
from companion.link.wire import Wire

WAIT_S: Final = 0.02
HEARTBEAT_INTERVAL_S: Final = 1.0
UNHEARD_S: Final = 3.0
"""Without a heartbeat of the autopilot for this long, there is none."""
PEER_PATIENCE_S: Final = 5.0
"""A peer that is no autopilot, or is silent, is given up after this time."""


class Standby:
    """What is known of the autopilot between flights.

    Args:
        wire: the vehicle link.
        pass_on: gets every frame but states and clock.
        say: gets lines for people.
    """

    def __init__(self, wire: Wire, pass_on: Callable[[Frame], None], say: Callable[[str], None]) -> None:
        self.autopilot = Autopilot()
        """What it has said of itself."""
        self.system: int | None = None
        """Its system id, once one was heard."""
        self.operations: Operations | None = None
        """Requests to it, on wall time."""
        self._wire = wire
        self._pass_on = pass_on
        self._say = say
        self._heard_s = self._spoken_s = -math.inf
        self._peer_since_s = time.monotonic()
        self._unusable = ""

    @property
    def heard(self) -> bool:
        """Whether the autopilot is being heard now."""
        return time.monotonic() - self._heard_s < UNHEARD_S

    def on_heartbeat(self, frame: Frame) -> None:
        """A heartbeat of the autopilot, in flight or not."""
        self._heard_s = frame.arrival_wall_ns * 1e-9

    def turn(self) -> None:
        """Waits a little, takes what comes, sends what is due.

        Raises:
            LinkError: the line is gone.
        """
        for frame in self._wire.receive(WAIT_S):
            self._on_frame(frame)
        now_s = time.monotonic()
        if now_s - self._spoken_s >= HEARTBEAT_INTERVAL_S:
            self._spoken_s = now_s
            send_heartbeat(self._wire)  # goes nowhere while there is no peer
        self._watch_peer(now_s)
        if self.operations is not None:
            self.operations.update(now_s)

    def _watch_peer(self, now_s: float) -> None:
        """The first sender at the port is not always the vehicle, and a restarted one may come from another port."""
        if now_s - max(self._heard_s, self._peer_since_s) < PEER_PATIENCE_S:
            return
        self._peer_since_s = now_s
        if not self._wire.try_another_peer():
            self._wire.release_peer()

    def _on_frame(self, frame: Frame) -> None:
        if frame.msgid == codec.HEARTBEAT and frame.compid == AUTOPILOT_COMPONENT:
            self._meet(frame)
        if frame.sysid != self.system or frame.compid != AUTOPILOT_COMPONENT:
            self._wire.counters.other_system += 1
            self._pass_on(frame)
            return
        if frame.msgid == codec.TIMESYNC:
            self._answer_time(frame)
            return
        if frame.msgid == codec.ODOMETRY:
            return
        if frame.msgid == codec.HEARTBEAT:
            take_heartbeat(self.autopilot, frame)
        elif self.operations is None or not self.operations.on_frame(frame, time.monotonic()):
            take_report(self.autopilot, frame)
        self._pass_on(frame)

    def _meet(self, frame: Frame) -> None:
        """An autopilot's heartbeat: the first one, or another vehicle's, which only counts when ours has gone.

        Where the vehicle is named, no other counts ever.
        """
        if self._wire.only_system not in {None, frame.sysid}:
            return
        if frame.sysid == self.system:
            self.on_heartbeat(frame)
            return
        if self.heard:
            return
        try:
            system = autopilot_system(frame)
        except FlightEnded as unusable:
            if unusable.detail != self._unusable:
                self._unusable = unusable.detail
                self._say(unusable.detail)
            return
        if system is None:
            return
        self.system = self._wire.system_id = system
        self.autopilot = Autopilot()
        self.operations = Operations(self._wire.send, system)
        self._spoken_s = -math.inf
        self.on_heartbeat(frame)
        take_heartbeat(self.autopilot, frame)
        mode = self.autopilot.mode
        self._say(f"heard the autopilot: system {system}, mode {'unknown' if mode is None else mode.label}")
        if mode == modes.OFFBOARD:
            self._say("the vehicle is in Offboard and nothing here flies it: the autopilot's own failsafe acts")

    def _answer_time(self, frame: Frame) -> None:
        message = codec.decode_timesync(frame.payload)
        if timesync.is_request(message, self._wire.system_id, self._wire.component_id):
            answer = timesync.answer(message, time.monotonic_ns(), frame.sysid, frame.compid)
            self._wire.send(codec.TIMESYNC, answer)
