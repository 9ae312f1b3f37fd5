"""The control loop with a vehicle that does not wait: no lockstep, no sockets, and a wall clock that the test turns.

`VirtualWire` stands for the link. Waiting on it lets the clock go on; the simulated vehicle moves and sends when its
time has come, as it would in real time, and a stall of the companion is a jump of the clock.
"""

from __future__ import annotations

import math
import socket
import struct
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import tomlkit
from fastcrc.crc16 import mcrf4xx

from companion import realtime
from companion.config import Flight, build_flight, find, read_toml
from companion.flight.engines import kernels
from companion.flight.loop import FlightLoop
from companion.flight.phases import PHASE_NAMES, Cause, Outcome
from companion.flight.planning import Planning
from companion.link.codec import message_formats
from companion.link.framing import Frame, FrameParser, LinkCounters, build_frame
from companion.link.wire import Wire
from companion.record.flight_record import FlightRecord
from companion.trajectory.load import of_flight
from sim_link import codec
from sim_link.modes import Mode
from sim_link.vehicle import Vehicle, VehicleOptions
from sim_link.vehicle_file import load

START_NS = 5_000_000_000
STATE_PERIOD_NS = 10_000_000
ODOMETRY, TIMESYNC = codec.ID_ODOMETRY, codec.ID_TIMESYNC
COMMAND_LONG, GPS_RAW_INT, ATTITUDE_QUATERNION, SET_MESSAGE_INTERVAL = 76, 24, 31, 511


class VirtualWire:
    """The vehicle link as the loop sees it, with time of its own."""

    component_id = 191
    last_foreign = None
    only_system = None
    signed = False

    def __init__(self, vehicle: Vehicle) -> None:
        self.vehicle = vehicle
        self.now_ns = START_NS
        self.system_id = 1
        self.peer = ("virtual", 1)
        self.counters = LinkCounters()
        self.sent: list[tuple[int, int, Any]] = []
        """Vehicle time [us], message id, message."""
        self.alter: Callable[[int, bytes], list[bytes]] = lambda msg_id, raw: [raw]
        self.offboard_us: int | None = None
        self.stall: tuple[float, float] | None = None
        """When after OFFBOARD the companion is stopped, and for how long [s]."""
        self.dead = False
        self.later: list[bytes] = []
        """What arrives on its own, after the rest."""
        self._parser = FrameParser(message_formats(), self.counters, None)
        self._decoder = codec.Decoder()
        self._next_ns = START_NS
        self._waiting: list[bytes] = []

    @property
    def offboard_s(self) -> float:
        return -math.inf if self.offboard_us is None else (self.vehicle.t_us - self.offboard_us) * 1e-6

    def receive(self, timeout_s: float, spin_s: float = 0.0, until: frozenset[int] = frozenset()) -> list[Frame]:
        frames: list[Frame] = []
        for raw in self.pass_time(timeout_s):
            self._parser.parse(raw, self.now_ns, frames, [])
        return frames

    def pass_time(self, timeout_s: float) -> list[bytes]:
        """Waits for the next datagrams, at most this long, and takes them."""
        if self.stall is not None and self.offboard_s >= self.stall[0]:
            self._advance_to(self.now_ns + int(self.stall[1] * 1e9))
            self.stall = None
        elif self.later:
            self._waiting, self.later = self.later, []
        else:
            end_ns = self.now_ns + int(timeout_s * 1e9)
            self._advance_to(end_ns if self.dead else min(end_ns, max(self._next_ns, self.now_ns)))
        taken, self._waiting = self._waiting, []
        return taken

    def _advance_to(self, wall_ns: int) -> None:
        while self._next_ns <= wall_ns and not self.dead:
            self.now_ns = max(self.now_ns, self._next_ns)
            self._next_ns += STATE_PERIOD_NS
            self.vehicle.tick()
            if self.offboard_us is None and self.vehicle.autopilot.mode is Mode.OFFBOARD:
                self.offboard_us = self.vehicle.t_us
            for raw in self.vehicle.companion.outbox:
                self._waiting += self.alter(raw[7] | raw[8] << 8 | raw[9] << 16, raw)
            self.vehicle.companion.outbox.clear()
        self.now_ns = max(self.now_ns, wall_ns)

    def send(self, msgid: int, payload: bytes) -> bool:
        formats = message_formats()
        raw = build_frame(msgid, payload, 0, self.system_id, self.component_id, formats[msgid].crc_extra, None)
        for frame in codec.frames(raw):
            self.hear(frame)
        return True

    def hear(self, frame: Any) -> None:
        """The vehicle gets a frame of the companion's."""
        self.sent.append((self.vehicle.t_us, frame.msg_id, self._decoder.message(frame)))
        if not self.dead:
            self.vehicle.receive(frame, self.vehicle.companion)

    def tell(self) -> None:
        """Nobody keeps a log."""

    def try_another_peer(self) -> bool:
        return False

    def release_peer(self) -> None:
        """There is only one."""

    def setpoints(self, from_s: float = 0.0) -> list[tuple[float, Any]]:
        return self._of(codec.ID_SET_ATTITUDE_TARGET, from_s)

    def holds(self, from_s: float = 0.0) -> list[float]:
        commands = self._of(codec.ID_COMMAND_LONG, from_s)
        return [t for t, m in commands if m.command == 176 and (m.param2, m.param3) == (4.0, 3.0)]

    def _of(self, msg_id: int, from_s: float) -> list[tuple[float, Any]]:
        begun = math.inf if self.offboard_us is None else self.offboard_us
        found = [((t - begun) * 1e-6, m) for t, number, m in self.sent if number == msg_id]
        return [(t, m) for t, m in found if t >= from_s]


def restamped(raw: bytes, by_us: int) -> bytes:
    """An ODOMETRY frame with another time."""
    payload = bytearray(codec.frames(raw)[0].payload)
    payload[0:8] = (int.from_bytes(payload[0:8], "little") + by_us).to_bytes(8, "little")
    return codec.Encoder(1, 1).hot(ODOMETRY, bytes(payload))


class VirtualTransport:
    """Datagrams from and to a vehicle with a `VirtualWire`'s time, for the program's own wire."""

    stream = False
    fixed_peer = ("virtual", 1)

    def __init__(self, stage: VirtualWire) -> None:
        self._stage = stage
        self._readable, self._other = socket.socketpair()
        self._other.send(b"x")  # there may always be something
        self.waiting: list[bytes] = []

    def fileno(self) -> int:
        return self._readable.fileno()

    def read(self) -> tuple[bytes, tuple[str, int]] | None:
        return (self.waiting.pop(0), self.fixed_peer) if self.waiting else None

    def write(self, data: bytes, to: object) -> bool:
        for frame in codec.frames(data):
            self._stage.hear(frame)
        return True

    def close(self) -> None:
        self._readable.close()
        self._other.close()


class QuickWire(Wire):
    """The program's own wire, with that time."""

    def __init__(self, stage: VirtualWire, behind: Callable[[list[bytes]], list[bytes]]) -> None:
        self._stage, self._behind = stage, behind
        self._carrier = VirtualTransport(stage)
        super().__init__(self._carrier)

    def receive(self, timeout_s: float, spin_s: float = 0.0, until: frozenset[int] = frozenset()) -> list[Frame]:
        self._carrier.waiting += self._behind(self._stage.pass_time(timeout_s))
        return super().receive(0.0, 0.0, until)


def plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    return [plain(item) for item in value] if isinstance(value, tuple) else value


def hovering(duration_s: float, **limits: float) -> Flight:
    vehicle = read_toml(find("paper", "vehicles"))
    vehicle["link"]["state_rate_hz"] = 100.0
    vehicle["limits"] |= limits
    hover = {"name": "hover", "shape": "hover", "duration_s": duration_s, "hover": {"point_m": [0.0, 0.0, 0.0]}}
    return build_flight({"name": "test", "vehicle": vehicle, "trajectory": hover}, "test")


@pytest.fixture
def flight() -> Flight:
    return hovering(1.0)


@pytest.fixture
def make_wire(
    flight: Flight, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[tuple[Any, float] | None], VirtualWire]:
    path = tmp_path / "vehicle.toml"
    path.write_text(tomlkit.dumps(plain(flight.vehicle.model_dump(exclude_none=True))))

    def make(start: tuple[Any, float] | None) -> VirtualWire:
        wire = VirtualWire(Vehicle(VehicleOptions(vehicle=load(str(path)), start=start, engine="python")))
        monkeypatch.setattr(time, "monotonic_ns", lambda: wire.now_ns)
        # a thread's time is not the wire's: planned at once, the same flight comes out every time
        monkeypatch.setattr("companion.flight.sequence.Planning", lambda plan, aside: Planning(plan, aside=False))
        return wire

    return make


@pytest.fixture
def wire(make_wire: Callable[..., VirtualWire]) -> VirtualWire:
    return make_wire(((0.0, 0.0, -20.0), 0.0))


def fly(flight: Flight, wire: VirtualWire) -> tuple[Outcome, FlightRecord]:
    record = FlightRecord(2000, PHASE_NAMES)
    loop = FlightLoop(flight, of_flight(flight), wire, record, kernels("python"))  # type: ignore[arg-type]
    return loop.run(), record


def test_whole_flight(flight: Flight, wire: VirtualWire) -> None:
    outcome, record = fly(flight, wire)
    assert outcome.cause is Cause.COMPLETED, outcome.sentence
    assert wire.vehicle.autopilot.mode is Mode.HOLD
    assert outcome.phases[0].reason == "heard the autopilot (system 1)"  # not in lockstep
    errors = record.columns("error_n", "error_e", "error_d")
    assert abs(errors).max() < 0.1
    # Every state is answered once, and PX4's 10 Hz of TIMESYNC requests give the states their age.
    assert outcome.lost_setpoints == 0
    stamps = [m.time_boot_ms for _, m in wire.setpoints(-math.inf)]
    assert len(stamps) == len(set(stamps))
    age = record.column("state_age_ms")
    assert 15.0 < age.min() <= age.max() < 45.0  # 20 ms old, and up to a period of the grid


def intervals(wire: VirtualWire, msgid: int) -> list[float]:
    """What was asked for as the interval of a message [us], one after the other."""
    asked = (m for _, number, m in wire.sent if number == COMMAND_LONG and m.command == SET_MESSAGE_INTERVAL)
    return [m.param2 for m in asked if m.param1 == msgid]


@pytest.mark.parametrize("exclusive", [True, False])
def test_what_is_not_used_is_not_sent_where_nobody_else_listens(
    flight: Flight, wire: VirtualWire, exclusive: bool
) -> None:
    """In flight; afterwards all is as it was."""
    link = flight.vehicle.link.model_copy(update={"exclusive": exclusive})
    alone = flight.model_copy(update={"vehicle": flight.vehicle.model_copy(update={"link": link})})
    outcome, _ = fly(alone, wire)
    assert outcome.cause is Cause.COMPLETED, outcome.sentence
    assert intervals(wire, GPS_RAW_INT) == ([-1.0, 0.0] if exclusive else [])
    # the attitudes of this vehicle are never newer than its states
    assert intervals(wire, ATTITUDE_QUATERNION) == ([3200.0, -1.0, 0.0] if exclusive else [3200.0, 0.0])


def test_timesync_is_answered_after_the_setpoint(flight: Flight, wire: VirtualWire) -> None:
    """A vehicle that waits for the answer then has the setpoint, whether it was recognised or not."""
    fly(flight, wire)
    kinds = [number for t, number, _ in wire.sent if wire.offboard_us and t >= wire.offboard_us + 200_000]
    answers = [i for i, number in enumerate(kinds) if number == TIMESYNC and i > 0]
    assert len(answers) > 10
    assert all(codec.ID_SET_ATTITUDE_TARGET in kinds[i - 2 : i] for i in answers[:10])


def test_short_stall_is_bridged_and_counted(flight: Flight, wire: VirtualWire) -> None:
    """The newest of the states that gathered is answered, the others are accounted for."""
    wire.stall = (0.8, 0.040)
    outcome, record = fly(flight, wire)
    assert outcome.cause is Cause.COMPLETED
    assert record.column("skipped").max() == outcome.lost_setpoints == 3
    assert abs(record.columns("error_n", "error_e", "error_d")).max() < 0.1


def test_long_stall_ends_the_flight(flight: Flight, wire: VirtualWire) -> None:
    """After half of COM_OF_LOSS_T without a setpoint none follows: PX4 would come back to OFFBOARD at any time."""
    wire.stall = (0.8, 0.7)
    outcome, _ = fly(flight, wire)
    assert outcome.cause is Cause.OWN_SILENCE
    assert wire.setpoints(0.82) == []
    assert len(wire.holds(0.8)) >= 1
    assert wire.vehicle.autopilot.mode is wire.vehicle.autopilot.intended is Mode.HOLD


def test_better_estimate_of_the_clock_is_no_silence(flight: Flight, wire: VirtualWire) -> None:
    """States are old, and the first TIMESYNC requests came 80 ms late; the next ones do not."""

    def alter(msg_id: int, raw: bytes) -> list[bytes]:
        if msg_id == ODOMETRY:
            return [restamped(raw, -60_000)]
        if msg_id != TIMESYNC:
            return [raw]
        tc1, ts1 = codec.timesync(codec.frames(raw)[0].payload)
        late_ns = 0 if wire.offboard_s >= 0.5 else 80_000_000
        wire.later.append(codec.Encoder(1, 1).hot(TIMESYNC, codec.TIMESYNC.pack(tc1, ts1 - late_ns, 0, 0)))
        return []

    wire.alter = alter
    outcome, _ = fly(flight, wire)
    assert outcome.cause is Cause.COMPLETED, outcome.sentence


def test_states_that_cease(flight: Flight, wire: VirtualWire) -> None:
    """The companion's own clock tells; nothing else needs to come from the vehicle."""
    wire.alter = lambda msg_id, raw: [] if wire.offboard_s >= 0.8 and msg_id in {ODOMETRY, TIMESYNC} else [raw]
    outcome, _ = fly(flight, wire)
    assert outcome.cause is Cause.STATE_LOST
    ((coast_s, coast),) = wire.setpoints(0.8)
    assert coast_s == pytest.approx(0.85, abs=0.03)
    assert (coast.body_roll_rate, coast.body_pitch_rate, coast.body_yaw_rate) == (0.0, 0.0, 0.0)
    assert wire.holds(0.8)[0] == pytest.approx(coast_s, abs=0.001)
    assert wire.vehicle.autopilot.mode is Mode.HOLD


def test_a_process_that_was_stopped_looks_at_what_waits_before_it_judges_the_link(
    flight: Flight, wire: VirtualWire
) -> None:
    """Stopped for 150 ms between a setpoint and the look at the clock: states have come, they are only not read."""
    send, stopped = wire.send, []

    def sending(msgid: int, payload: bytes) -> bool:
        done = send(msgid, payload)
        if msgid == codec.ID_SET_ATTITUDE_TARGET and wire.offboard_s >= 0.8 and not stopped:
            stopped.append(wire.offboard_s)
            wire._advance_to(wire.now_ns + 150_000_000)
        return done

    wire.send = sending  # type: ignore[method-assign]
    outcome, _ = fly(flight, wire)
    assert stopped
    assert outcome.cause is Cause.COMPLETED, outcome.sentence


def test_vehicle_that_is_gone(flight: Flight, wire: VirtualWire) -> None:
    """Nothing answers any more: the same, and an end after the hand-over has been tried for 3 s."""

    def alter(msg_id: int, raw: bytes) -> list[bytes]:
        wire.dead = wire.dead or wire.offboard_s >= 0.8
        return [raw]

    wire.alter = alter
    outcome, _ = fly(flight, wire)
    assert outcome.cause is Cause.STATE_LOST
    assert "Hold was not acknowledged" in outcome.sentence
    assert 25 <= len(wire.holds(0.8)) <= 32
    assert len(wire.setpoints(0.8)) <= 2  # for the last state, and the coast setpoint


def test_vehicle_that_is_gone_during_takeoff(flight: Flight, make_wire: Callable[..., VirtualWire]) -> None:
    """Where no setpoints are due its silence ends the flight as well."""
    wire = make_wire(None)

    def alter(msg_id: int, raw: bytes) -> list[bytes]:
        wire.dead = wire.dead or wire.vehicle.t_us > 4_000_000
        return [raw]

    wire.alter = alter
    outcome, _ = fly(flight, wire)
    assert [phase.name for phase in outcome.phases] == ["connect", "preflight", "takeoff"]
    assert (outcome.cause, outcome.detail) == (Cause.LINK_LOST, "no message for 5 s")
    assert wire.setpoints(-math.inf) == []


def test_states_that_cease_during_the_checks(flight: Flight, wire: VirtualWire) -> None:
    """What was measured must hold until the end of the measurement."""
    wire.alter = lambda msg_id, raw: [] if wire.vehicle.t_us > 2_000_000 and msg_id == ODOMETRY else [raw]
    outcome, _ = fly(flight, wire)
    assert outcome.cause is Cause.REFUSED
    assert "the longest time without a state was" in outcome.sentence
    assert wire.setpoints(-math.inf) == []


def test_rebooted_autopilot_is_asked_for_hold_on_the_wall_clock(flight: Flight, wire: VirtualWire) -> None:
    """Its clock runs anew and far behind: what is timed must not wait for it."""

    def alter(msg_id: int, raw: bytes) -> list[bytes]:
        if wire.offboard_s < 0.8 or msg_id not in {ODOMETRY, TIMESYNC}:
            return [raw]
        if msg_id == TIMESYNC:
            return []
        return [restamped(raw, -3_000_000)]

    wire.alter = alter
    outcome, _ = fly(flight, wire)
    assert outcome.cause is Cause.REBOOTED
    assert wire.vehicle.autopilot.mode is Mode.HOLD
    assert len(wire.setpoints(0.85)) <= 1


def test_an_autopilot_that_answers_no_more_is_left(wire: VirtualWire) -> None:
    """States go on, answers to our TIMESYNC do not: what we send may not arrive either."""
    send = wire.send

    def answered(msgid: int, payload: bytes) -> bool:
        """What the vehicle's link does: every request is answered with its time, until it hears us no more."""
        if msgid == TIMESYNC:
            tc1, ts1 = codec.timesync(payload)
            if tc1 == 0 and wire.offboard_s < 0.5:
                reply = codec.TIMESYNC.pack(wire.vehicle.t_us * 1000, ts1, 1, 191)
                wire.later.append(codec.Encoder(1, 1).hot(TIMESYNC, reply))
        return send(msgid, payload)

    wire.send = answered  # type: ignore[method-assign]
    outcome, _ = fly(hovering(6.0, link_silence_max_s=1.0), wire)
    assert outcome.cause is Cause.LINK_ONE_WAY
    assert "s without an answer, limit 1 (limits.link_silence_max_s)" in outcome.sentence
    assert wire.vehicle.autopilot.mode is Mode.HOLD
    assert wire.holds(0.5)[0] == pytest.approx(1.6, abs=0.2)


def test_steps_that_go_out_late_bring_the_flight_to_rest(wire: VirtualWire) -> None:
    """A machine that is too slow: every setpoint leaves 4 ms after its state, of 10 ms between two."""
    send, told = wire.send, []

    def slowly(msgid: int, payload: bytes) -> bool:
        if msgid == codec.ID_SET_ATTITUDE_TARGET and wire.offboard_s >= 0.5:
            wire.now_ns += 4_000_000
        return send(msgid, payload)

    wire.send = slowly  # type: ignore[method-assign]
    flight = hovering(20.0)
    record = FlightRecord(4000, PHASE_NAMES)
    outcome = FlightLoop(flight, of_flight(flight), wire, record, kernels("python"), told.append).run()  # type: ignore[arg-type]
    assert outcome.cause is Cause.LATE_STEPS
    assert "of the steps, limit 0.3 (limits.late_steps_max) for 5.0 s" in outcome.sentence
    assert any("the reference slows down" in line and "late_steps_max" in line for line in told), told
    assert wire.vehicle.autopilot.mode is Mode.HOLD


def numbered(raw: bytes, seq: int) -> bytes:
    """A frame with another sequence number."""
    body = raw[1:4] + bytes((seq & 0xFF,)) + raw[5:-2]
    extra = message_formats()[raw[7] | raw[8] << 8 | raw[9] << 16].crc_extra
    return raw[:1] + body + mcrf4xx(body + bytes((extra,))).to_bytes(2, "little")


def attitudes_behind(age_us: int, older_us: int) -> Callable[[list[bytes]], list[bytes]]:
    """Behind every state comes an attitude that is so much newer, as on PX4; the vehicle's own do not come.

    Where `older_us` is not 0 another one overtaken on its way follows, so much older.
    """
    count, encoder = [0], codec.Encoder(1, 1)

    def add(datagrams: list[bytes]) -> list[bytes]:
        out = []
        for raw in datagrams:
            number = raw[7] | raw[8] << 8 | raw[9] << 16
            if number != ATTITUDE_QUATERNION:
                out.append(raw)
            if number == ODOMETRY:
                payload = codec.frames(raw)[0].payload
                t_ms = (int.from_bytes(payload[:8], "little") + age_us) // 1000
                for older_ms in (0, older_us // 1000) if older_us else (0,):
                    told = struct.pack("<I", t_ms - older_ms) + payload[20:36] + payload[48:60] + bytes(16)
                    out.append(encoder.hot(ATTITUDE_QUATERNION, told))
        count[0] += len(out)
        return [numbered(raw, count[0] - len(out) + i) for i, raw in enumerate(out)]

    return add


@pytest.mark.numba
@pytest.mark.parametrize(("age_us", "older_us"), [(0, 0), (15_000, 0), (15_000, 4_000)])
def test_states_with_attitudes_behind_them_are_answered_by_reflex(
    make_wire: Callable[..., VirtualWire], age_us: int, older_us: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same setpoints as the usual way gives, and the same figures."""
    flight, flown, by_reflex = hovering(1.0), [], [0]
    answer = FlightLoop._answer_at_once

    def counted(loop: FlightLoop, *given: Any) -> bool:
        done = answer(loop, *given)
        by_reflex[0] += done
        return done

    out: list[int] = []
    monkeypatch.setattr(realtime, "make_way", lambda: out.append(len(stage.setpoints(-math.inf))))
    for way in (counted, lambda loop, *given: False):
        monkeypatch.setattr(FlightLoop, "_answer_at_once", way)
        stage = make_wire(((0.0, 0.0, -20.0), 0.0))
        record = FlightRecord(2000, PHASE_NAMES)
        with QuickWire(stage, attitudes_behind(age_us, older_us)) as wire:
            outcome = FlightLoop(flight, of_flight(flight), wire, record, kernels("numba")).run()
        assert outcome.cause is Cause.COMPLETED, outcome.sentence
        setpoints = [(t, m.to_dict()) for t, m in stage.setpoints(-math.inf)]
        flown.append((setpoints, record.rows.tobytes(), outcome.vehicle, str(wire.counters), outcome.rejected_states))
        # whoever waits for a setpoint goes before what is left to do with its step
        assert len(out) >= len(record) and out == sorted(set(out)), "one more was out each time"
        out.clear()
    assert by_reflex[0] > 0.4 * len(record)  # at the others something else came before the state
    assert flown[0] == flown[1]
    assert (flown[0][2]["refreshed_states"] > 0.8 * len(record)) == (age_us > 0)
