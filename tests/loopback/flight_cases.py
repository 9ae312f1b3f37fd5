"""Flights of the control loop against the bundled vehicle for tests: real UDP sockets, lockstep, both in this process.

`Stand` holds the vehicle in a thread of its own. What it sends can be altered or dropped on its way out, what it hears
is written down with the vehicle's time, and things can be made to happen a time after OFFBOARD was entered.
"""

from __future__ import annotations

import contextlib
import math
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

import tomlkit
from pymavlink.dialects.v20 import development as mavlink

from companion.config import Flight, build_flight, find, read_toml
from companion.errors import ExitCode
from companion.flight import loop as loop_module
from companion.flight.bundled import free_udp_port
from companion.flight.engines import kernels
from companion.flight.loop import FlightLoop
from companion.flight.phases import PHASE_NAMES, Cause, Outcome
from companion.flight.process import warm_up
from companion.link.wire import Wire
from companion.record.flight_record import FlightRecord
from companion.record.summary import FlightMeta, summarise
from companion.trajectory.load import of_flight
from sim_link import codec
from sim_link import peer as peer_module
from sim_link.modes import Mode
from sim_link.peer import Peer, PeerOptions
from sim_link.vehicle import Vehicle, VehicleOptions
from sim_link.vehicle_file import load
from sim_link.wind import World

STATE_RATE_HZ = 100.0
IN_AIR = ((0.0, 0.0, -20.0), 0.0)
OFFBOARD, HOLD, LAND, TAKEOFF = (m.custom_mode for m in (Mode.OFFBOARD, Mode.HOLD, Mode.LAND, Mode.TAKEOFF))
DO_SET_MODE, COMMAND_LONG, COMMAND_ACK = 176, 76, 77
SET_POSITION_TARGET_LOCAL_NED = 84
SETPOINTS = {codec.ID_SET_ATTITUDE_TARGET, codec.ID_SET_ACTUATOR_CONTROL_TARGET, SET_POSITION_TARGET_LOCAL_NED}
HOVER = {"shape": "hover", "anchor": "here", "duration_s": 1.5, "name": "hover", "hover": {"point_m": [0.0, 0.0, 0.0]}}
INDOOR = {
    **{"shape": "lemniscate", "anchor": "here", "duration_s": 6.0, "name": "eight"},
    "lemniscate": {"amplitude_m": [0.75, 0.5], "angular_rate_rad_s": 0.5},
}


def flight_data(**changes: Any) -> dict[str, Any]:
    """The contents of a flight file: the paper's vehicle at 100 Hz over a point; keys with "__" reach into tables."""
    vehicle = read_toml(find("paper", "vehicles"))
    vehicle["link"]["state_rate_hz"] = STATE_RATE_HZ
    data: dict[str, Any] = {"name": "test", "vehicle": vehicle, "trajectory": dict(HOVER), "statistics_from_s": 0.5}
    for key, value in changes.items():
        *path, last = key.split("__")
        table = data
        for name in path:
            table = table.setdefault(name, {})
        table[last] = value
    return data


def make_flight(**changes: Any) -> Flight:
    return build_flight(flight_data(**changes), "test")


def write_vehicle(data: dict[str, Any], folder: Path) -> Path:
    path = folder / "vehicle.toml"
    path.write_text(tomlkit.dumps(data["vehicle"]))
    return path


@dataclass
class Flown:
    """What came of a flight."""

    outcome: Outcome
    record: FlightRecord
    lines: list[str]
    summary: dict[str, Any] = field(default_factory=dict)

    @property
    def cause(self) -> Cause:
        return self.outcome.cause

    @property
    def code(self) -> ExitCode:
        return ExitCode(self.cause.value.exit_code)

    @property
    def phases(self) -> list[str]:
        return [phase.name for phase in self.outcome.phases]


@dataclass
class Heard:
    """A message that the vehicle received."""

    t_us: int
    msg_id: int
    message: Any


Alter = Callable[["Stand", int, bytes], list[bytes]]


class Stand:
    """A vehicle on free ports, in lockstep, that a companion can fly; use it as a context manager."""

    def __init__(
        self,
        flight: Flight,
        folder: Path,
        *,
        start: Any = IN_AIR,
        alter: Alter | None = None,
        speaks_first: bool = True,
        **options: Any,
    ) -> None:
        """`alter` gives the frames that go out instead of one, `deaf` the frames that are not heard."""
        self.flight = flight
        path = folder / "vehicle.toml"
        path.write_text(tomlkit.dumps(_lists(flight.vehicle.model_dump(exclude_none=True))))
        acts = flight.world
        world = World(acts.force_n, acts.gravity_factor, acts.wind_m_s, acts.turbulence, seed=1)
        options.setdefault("engine", "auto")
        self.vehicle = Vehicle(VehicleOptions(vehicle=load(str(path)), world=world, start=start, **options))
        self.port = free_udp_port()
        self.peer = Peer(
            self.vehicle,
            PeerOptions(port=0, remote_port=self.port if speaks_first else 0, lockstep=True),
            stopped=lambda: self._stopping,
        )
        self.heard: list[Heard] = []
        self.offboard_us: int | None = None
        self.alter = alter
        self.deaf: Callable[[Stand, Any], bool] = lambda stand, frame: False
        self.idle_s = 0.0
        """Between two states outside of OFFBOARD: in lockstep a vehicle that waits would use up a processor."""
        self._things: list[tuple[float, Callable[[], object]]] = []
        self._decoder = codec.Decoder()
        self._stopping = False
        self._patches = contextlib.ExitStack()
        self._send, self._take = self.peer.companion.send, self.peer.companion.take
        self.peer.companion.send = self._sending  # type: ignore[method-assign]
        self.peer.companion.take = self._taking  # type: ignore[method-assign]
        self._thread = threading.Thread(target=self.peer.run, daemon=True)

    def __enter__(self) -> Stand:
        for module, name in ((loop_module, "LOCKSTEP_SPIN_S"), (peer_module, "_SPIN_S")):
            # Waiting without sleeping pays for processes, not for two threads that take turns.
            self._patches.enter_context(patch.object(module, name, 0.0))
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        self.peer.close()
        self._patches.close()

    def stop(self) -> None:
        """As if the vehicle's process had ended (its port stays)."""
        self._stopping = True
        if threading.current_thread() is not self._thread:
            self._thread.join(5.0)

    # What happens

    def after_offboard(self, seconds: float, thing: Callable[[], object]) -> None:
        """Makes something happen so long after OFFBOARD was entered first."""
        self._things.append((seconds, thing))

    @property
    def t_us(self) -> int:
        """Vehicle time of the last state sent, which the companion is answering."""
        return max(self.vehicle.start_us, self.peer._awaited_ns // 1000)

    @property
    def offboard_s(self) -> float:
        """Vehicle time since OFFBOARD was entered first; negative infinity before."""
        return -math.inf if self.offboard_us is None else (self.t_us - self.offboard_us) * 1e-6

    @property
    def mode(self) -> Mode:
        return self.vehicle.autopilot.mode

    def _sending(self, outbox: list[bytes]) -> None:
        if self.offboard_us is None and self.mode is Mode.OFFBOARD:
            self.offboard_us = self.t_us
        if self.idle_s and self.mode is not Mode.OFFBOARD:
            time.sleep(self.idle_s)
        due = [thing for thing in self._things if thing[0] <= self.offboard_s]
        for thing in due:
            self._things.remove(thing)
            thing[1]()
        if self.alter is not None:
            outbox[:] = [new for old in outbox for new in self.alter(self, message_id(old), old)]
        self._send(outbox)

    def _taking(self) -> Any:
        taken = self._take()
        if taken is None:
            return None
        found = codec.frames(taken[0])
        for frame in found:
            self.heard.append(Heard(self.t_us, frame.msg_id, self._decoder.message(frame)))
        return b"".join(frame.raw for frame in found if not self.deaf(self, frame)), taken[1]

    # What was heard

    def setpoints(self, from_s: float = 0.0) -> list[Heard]:
        """Setpoints received from a time after OFFBOARD on."""
        return [h for h in self.heard if h.msg_id in SETPOINTS and self._since(h) >= from_s]

    def mode_requests(self, from_s: float = 0.0) -> list[tuple[float, int]]:
        """DO_SET_MODEs received: time since OFFBOARD, custom mode."""
        return [
            (self._since(h), int(h.message.param2) << 16 | int(h.message.param3) << 24)
            for h in self.heard
            if h.msg_id == COMMAND_LONG and h.message.command == DO_SET_MODE and self._since(h) >= from_s
        ]

    def _since(self, heard: Heard) -> float:
        return -math.inf if self.offboard_us is None else (heard.t_us - self.offboard_us) * 1e-6

    # Flying

    @contextlib.contextmanager
    def loop(
        self, *, timeout_s: float = 5.0, engine: str = "python"
    ) -> Iterator[tuple[FlightLoop, FlightRecord, list]]:
        record = FlightRecord(20_000, PHASE_NAMES)
        lines: list[str] = []
        compiled = kernels(engine)
        warm_up(self.flight, compiled)  # as the control process does: nothing is compiled in the air
        with Wire.open(f"udpin:127.0.0.1:{self.port}") as wire:
            trajectory = of_flight(self.flight)
            yield (
                FlightLoop(
                    *(self.flight, trajectory, wire, record, compiled, lines.append),
                    connect_timeout_s=timeout_s,
                    connection=f"udpin:127.0.0.1:{self.port}",
                ),
                record,
                lines,
            )

    def fly(self, prepare: Callable[[FlightLoop], object] = lambda loop: None, **options: Any) -> Flown:
        """Flies the flight; `prepare` may change the loop before."""
        with self.loop(**options) as (loop, record, lines):
            prepare(loop)
            outcome = loop.run()
        flown = Flown(outcome, record, lines)
        if outcome.phases:
            who = self.flight.output.controller
            meta = FlightMeta("test", "paper", outcome.lost_setpoints, self.flight.statistics_from_s, controller=who)
            flown.summary = summarise(record, outcome.phases, meta)
        return flown


def message_id(raw: bytes) -> int:
    """Of a MAVLink 2 frame."""
    return raw[7] | raw[8] << 8 | raw[9] << 16


def changed_odometry(stand: Stand, raw: bytes, **changes: Any) -> bytes:
    """An ODOMETRY frame with other contents: t_us (added), q, reset_counter."""
    payload = bytearray(codec.frames(raw)[0].payload.ljust(233, b"\0"))
    if "t_us" in changes:
        t_us = struct.unpack_from("<Q", payload)[0] + changes["t_us"]
        struct.pack_into("<Q", payload, 0, t_us)
    if "p" in changes:
        struct.pack_into("<3f", payload, 8, *changes["p"])
    if "q" in changes:
        struct.pack_into("<4f", payload, 20, *changes["q"])
    if "reset_counter" in changes:
        payload[230] = changes["reset_counter"]
    encoder = codec.Encoder(stand.vehicle.system, changes.get("component", 1))
    return encoder.hot(codec.ID_ODOMETRY, bytes(payload))


def command_from_elsewhere(stand: Stand, command: int, *params: float) -> None:
    """A COMMAND_LONG from a third socket, as a ground station sends it."""
    mav = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    values = (*params, *(0.0,) * (7 - len(params)))
    message = mavlink.MAVLink_command_long_message(stand.vehicle.system, 1, command, 0, *values)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.sendto(message.pack(mav), ("127.0.0.1", stand.peer.companion.port))


def set_mode_from_elsewhere(stand: Stand, mode: Mode) -> None:
    command_from_elsewhere(stand, DO_SET_MODE, 1, mode.value.main, mode.value.sub)


def _lists(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _lists(item) for key, item in value.items()}
    return [_lists(item) for item in value] if isinstance(value, tuple) else value
