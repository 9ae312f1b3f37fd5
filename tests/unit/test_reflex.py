"""The answer by reflex is the answer of the usual way, to the bit, and what is not ordinary takes the usual way."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import pytest
from fastcrc.crc16 import mcrf4xx
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.config import load_vehicle
from companion.control.history import Attitude
from companion.control.types import State
from companion.flight.course import Course, Timed
from companion.flight.engines import kernels
from companion.flight.reflex import ANSWERED, DECLINED, UNSENDABLE, Reflex
from companion.flight.tracker import Tracker
from companion.link import codec, direct, timesync
from companion.link.framing import Frame, FrameParser, LinkCounters, build_frame
from companion.link.setpoint import Setpoint, SetpointSender, UnsendableSetpoint
from companion.link.telemetry import Telemetry, VehicleState
from companion.trajectory.anchored import Trajectory
from companion.trajectory.shapes import Circle, Line

FORMATS = codec.message_formats()
OWN = (1, 191)
OWN_NS = 123_456_789_012
BEGIN_US = 20_000_000
UNFIT = b"a setpoint that cannot be sent"
CIRCLE = Circle(center_m=(0.0, 0.0, 0.0), radius_m=2.0, angular_rate_rad_s=0.5, phase_rad=0.0)
LINE = Line(from_m=(0.0, 0.0, 0.0), to_m=(3.0, 0.0, 0.0), move_s=8.0)


def test_the_seeds_are_those_of_the_messages() -> None:
    assert FORMATS[codec.ODOMETRY].crc_extra == direct.ODOMETRY_EXTRA
    assert FORMATS[codec.TIMESYNC].crc_extra == direct.TIMESYNC_EXTRA
    assert FORMATS[codec.SET_ATTITUDE_TARGET].crc_extra == direct.SET_ATTITUDE_TARGET_EXTRA


@given(st.binary(max_size=300), st.integers(0, 255))
def test_the_checksum_is_that_of_mavlink(content: bytes, extra: int) -> None:
    assert direct.checksum(content, 0, len(content), extra) == mcrf4xx(content + bytes((extra,)))


@dataclass
class Message:
    """An ODOMETRY message, and what is done to its datagram."""

    step_us: int = 4000
    p: tuple[float, float, float] = (0.0, 0.0, -10.0)
    q: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    v: tuple[float, float, float] = (0.1, 0.2, 0.0)
    w: tuple[float, float, float] = (0.0, 0.1, 0.0)
    frames: tuple[int, int] = (1, 1)
    resets: int = 0
    quality: int = 50
    system: int = 1
    lost: int = 0
    """Frames that are missing before it."""
    spoilt: int | None = None
    """A byte that is wrong."""
    short: int = 0
    """Bytes that are missing at the end."""
    behind: bytes = b""
    request: tuple[int, int, int, int] | None = None
    """What follows in lockstep: TIMESYNC's times [ns] and targets; the second is added to the state's stamp."""
    attitude_s: float | None = None
    """When a newer attitude came, after this state's stamp."""


VEHICLE = load_vehicle("bundled")


@cache
def course(shape: Any) -> Course:
    """Planned once."""
    trajectory = Trajectory(name="t", shape=shape, duration_s=20.0)
    return Course(trajectory, VEHICLE, (0.0, 0.0, -10.0), 0.0, None)


@dataclass
class Way:
    """One companion's half of a link."""

    at_once: bool
    lockstep: bool
    shape: Any = CIRCLE
    sent: list[bytes] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.timed = Timed(course(self.shape), BEGIN_US * 1e-6)
        self.counters = LinkCounters()
        self.parser = FrameParser(FORMATS, self.counters)
        self.telemetry = Telemetry(1)
        self.tracker = Tracker(VEHICLE, "rates", kernels("numba"))
        self.tracker.begin(State((0.0, 0.0, -10.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
        self.sender = SetpointSender(self.frame, 1)
        self.reflex = Reflex(1, OWN)
        self.seq = 0
        self.sent_us = self.asked_us = BEGIN_US - 4000
        self.last: VehicleState | None = None
        self.answers = 0

    def frame(self, msgid: int, payload: bytes) -> bool:
        self.sent.append(build_frame(msgid, payload, self.seq, *OWN, FORMATS[msgid].crc_extra))
        self.seq = (self.seq + 1) & 0xFF
        return True

    def take(self, datagram: bytes, attitude: Attitude | None) -> None:
        if attitude is not None:
            self.tracker.refresh(attitude)
        if not (self.at_once and self._by_reflex(datagram)):
            self._usual(datagram)

    def _by_reflex(self, datagram: bytes) -> bool:
        numbers, last_us = self.telemetry.numbers, self.telemetry.last_t_vehicle_us
        if self.last is None or numbers is None or last_us is None or not self.telemetry.sound:
            return False
        asked_us = self.asked_us if self.lockstep else -1
        given = (self.parser.due(1, 1), self.seq, OWN_NS, last_us, self.sent_us, asked_us, self.last.reset_counter)
        if not self.reflex.take(datagram, (*given, 500_000), numbers):
            return False
        code = self.tracker.answer(self.reflex, self.timed)
        if code == DECLINED:
            return False
        self.answers += 1
        content, count = bytes(self.reflex.output) if code == ANSWERED else b"", 2 if self.lockstep else 1
        self.parser.took(1, 1, count)
        found: list[Frame] = []
        FrameParser(FORMATS, LinkCounters()).parse(content, 0, found, [])
        self.sent += [frame.raw for frame in found] or [UNFIT]
        self.seq = (self.seq + len(found)) & 0xFF
        self.last, numbers = self.reflex.told()
        self.telemetry.took(self.last.t_vehicle_us, numbers)
        self.tracker.answered(self.last.t_vehicle_us * 1e-6, State(*self.last[1:5]))
        self.sent_us = self.last.t_vehicle_us
        if self.lockstep:
            self.asked_us = self.reflex.asked_ns // 1000
        return True

    def _usual(self, datagram: bytes) -> None:
        frames: list[Frame] = []
        self.parser.parse(datagram, 0, frames, [])
        for frame in frames:
            if frame.msgid == codec.TIMESYNC:
                self._answer_time(frame)
                continue
            state = self.telemetry.on_odometry(frame)
            if not isinstance(state, VehicleState):
                continue
            silent = state.t_vehicle_us - self.sent_us > 500_000
            reset = self.last is not None and self.last.reset_counter != state.reset_counter
            self.last = state
            if not (silent or reset):  # there, a flight does something else
                out = self.tracker.step(state.t_vehicle_us * 1e-6, State(*state[1:5]), self.timed)
                self._send(out.setpoint, state.t_vehicle_us)
            self.sent_us = state.t_vehicle_us

    def _send(self, setpoint: Setpoint, t_us: int) -> None:
        try:
            self.sender.send(setpoint, t_us)
        except UnsendableSetpoint:
            self.sent.append(UNFIT)

    def _answer_time(self, frame: Frame) -> None:
        message = codec.decode_timesync(frame.payload)
        if self.lockstep and frame.sysid == 1 and timesync.is_request(message, *OWN):
            self.asked_us = message.ts1 // 1000
            self.frame(codec.TIMESYNC, timesync.answer(message, OWN_NS, 1, 1))


def datagrams(messages: list[Message]) -> Iterator[tuple[bytes, Attitude | None]]:
    t_us, seq = BEGIN_US, 0
    for m in messages:
        t_us, seq = max(t_us + m.step_us, 0), (seq + m.lost) & 0xFF
        payload = struct.pack("<Q13f168xBBBBb", t_us, *m.p, *m.q, *m.v, *m.w, *m.frames, m.resets, 8, m.quality)
        content = bytearray(build_frame(codec.ODOMETRY, payload, seq, m.system, 1, FORMATS[codec.ODOMETRY].crc_extra))
        seq = (seq + 1) & 0xFF
        if m.request is not None:
            tc1, later_ns, system, component = m.request
            told = codec.encode_timesync(tc1, max(t_us * 1000 + later_ns, 0), system, component)
            content += build_frame(codec.TIMESYNC, told, seq, m.system, 1, FORMATS[codec.TIMESYNC].crc_extra)
            seq = (seq + 1) & 0xFF
        if m.spoilt is not None:
            content[m.spoilt % len(content)] ^= 0x55
        attitude = (
            None
            if m.attitude_s is None
            else Attitude(t_us * 1e-6 + m.attitude_s, (1.0, 0.0, 0.0, 0.0), (0.1, 0.0, -0.1))
        )
        yield bytes(content[: len(content) - m.short]) + m.behind, attitude


def both(messages: list[Message], shape: Any = CIRCLE) -> int:
    """Flies messages both ways, compares all that comes of them, and tells how many were answered by reflex."""
    lockstep = any(m.request is not None for m in messages)
    usual, quick = Way(at_once=False, lockstep=lockstep, shape=shape), Way(at_once=True, lockstep=lockstep, shape=shape)
    for datagram, attitude in datagrams(messages):
        usual.take(datagram, attitude)
        quick.take(datagram, attitude)
        assert quick.sent == usual.sent
        assert quick.last == usual.last
    assert quick.counters == usual.counters
    assert repr(quick.telemetry.__dict__) == repr(usual.telemetry.__dict__)
    assert quick.tracker.refreshed == usual.tracker.refreshed
    return quick.answers


def moving(i: int, **changes: Any) -> Message:
    x = 0.01 * i
    return Message(p=(x, -x, -10.0), q=(0.999, 0.02, -0.01, 0.04), v=(0.3, 0.2, x), w=(0.1, x, -0.2), **changes)


@pytest.mark.numba
@pytest.mark.parametrize("shape", [CIRCLE, LINE], ids=["curve", "no curve"])
@pytest.mark.parametrize("request_", [None, (0, 1_000_000, 0, 0), (0, 1_000_000, 1, 191)])
def test_ordinary_states_are_answered_by_reflex(shape: Any, request_: Any) -> None:
    messages = [moving(i, request=request_, frames=(1, 12 if i % 2 else 1)) for i in range(300)]
    assert both(messages, shape) == 299  # the first one has nothing before it


@pytest.mark.numba
def test_a_newer_attitude_refreshes_the_prediction() -> None:
    assert both([moving(i, attitude_s=0.003 if i % 3 else None) for i in range(40)]) == 39


@pytest.mark.numba
@pytest.mark.parametrize(
    "odd",
    [
        {"step_us": 0},
        {"step_us": -4000},
        {"step_us": 600_000},
        {"step_us": 11_000_000},
        {"p": (math.nan, 0.0, 0.0)},
        {"p": (2e6, 0.0, 0.0)},
        {"v": (0.0, 201.0, 0.0)},
        {"w": (0.0, 0.0, math.inf)},
        {"q": (0.0, 0.0, 0.0, 0.0)},
        {"q": (1.2, 0.0, 0.0, 0.0)},
        {"frames": (2, 1)},
        {"frames": (1, 8)},
        {"resets": 1},
        {"quality": -1},
        {"system": 2},
        {"lost": 1},
        {"spoilt": 40},
        {"short": 1},
        {"behind": b"\0"},
        {"behind": b"\xfd"},
        {"request": (0, 1_000_000, 0, 0)},
        {"request": (5, 1_000_000, 1, 191)},
    ],
    ids=str,
)
def test_what_is_not_ordinary_takes_the_usual_way(odd: dict[str, Any]) -> None:
    messages = [moving(i) for i in range(6)]
    for name, value in odd.items():
        setattr(messages[3], name, value)
    lockstep = messages[3].request is not None
    for m in messages if lockstep else ():
        m.request = m.request or (0, 1_000_000, 0, 0)
    answered = both(messages)
    assert answered == (5 if odd.get("request") == (0, 1_000_000, 0, 0) else answered)
    assert answered < 5 or lockstep


@pytest.mark.numba
def test_a_state_that_repeats_its_numbers_is_frozen_for_both() -> None:
    messages = [moving(i) for i in range(4)] + [moving(3), moving(3), moving(4), moving(5)]
    assert both(messages) == 5


FLOATS = st.sampled_from([0.0, 0.5, -3.0, 1e3, 1e7, math.nan, math.inf]) | st.floats(-10, 10, width=32)
VECTOR = st.tuples(FLOATS, FLOATS, FLOATS)
QUATERNION = st.tuples(*[st.floats(-1, 1, width=32)] * 4)
REQUEST = st.tuples(
    st.sampled_from([0, 0, 0, 7]),
    st.sampled_from([1_000_000, 0, -30_000_000, 60_000_000]),
    st.sampled_from([0, 1, 2]),
    st.sampled_from([0, 191, 5]),
)
MESSAGE = st.builds(
    Message,
    step_us=st.sampled_from([4000, 4000, 4000, 4001, 0, -4000, 20_000, 60_000, 600_000, 11_000_000, -21_000_000]),
    p=VECTOR,
    q=st.just((1.0, 0.0, 0.0, 0.0)) | QUATERNION,
    v=VECTOR,
    w=VECTOR,
    frames=st.sampled_from([(1, 1), (1, 1), (1, 12), (20, 1), (1, 8)]),
    resets=st.sampled_from([0, 0, 0, 0, 1]),
    quality=st.sampled_from([0, 50, -1]),
    system=st.sampled_from([1, 1, 1, 2]),
    lost=st.sampled_from([0, 0, 0, 1, 200]),
    spoilt=st.none() | st.integers(0, 400),
    short=st.sampled_from([0, 0, 0, 1, 30]),
    behind=st.sampled_from([b"", b"", b"\0", b"\xfd\x00"]),
    attitude_s=st.none() | st.sampled_from([0.001, 0.02, 1.0]),
)


@pytest.mark.numba
@settings(deadline=None, max_examples=300)
@given(st.data())
def test_whatever_comes_both_ways_do_the_same(data: st.DataObject) -> None:
    lockstep = data.draw(st.booleans(), "lockstep")
    odd = MESSAGE if not lockstep else st.builds(lambda m, r: _with(m, request=r), MESSAGE, st.none() | REQUEST)
    usual = st.integers(0, 50).map(lambda i: moving(i, request=(0, 1_000_000, 0, 0) if lockstep else None))
    both(data.draw(st.lists(usual | usual | odd, max_size=12), "messages"))


def _with(message: Message, **changes: Any) -> Message:
    for name, value in changes.items():
        setattr(message, name, value)
    return message


@pytest.mark.numba
def test_a_step_that_gives_no_setpoint_is_told_as_such() -> None:
    """What the law commands is checked once more before it is framed."""
    way = Way(at_once=True, lockstep=False)
    stream = datagrams([moving(i) for i in range(3)])
    for _ in range(2):
        way.take(*next(stream))
    vehicle = way.tracker.vehicle
    huge = vehicle.parameters()
    wide = huge._replace(limits=huge.limits._replace(rate_max=(1e9, 1e9, 1e9)))
    assert way.tracker._whole is not None
    way.tracker._whole.retune(wide._replace(gains=wide.gains._replace(k3=1e9, k4=1e9)))
    datagram, _ = next(stream)
    numbers, last_us, last = way.telemetry.numbers, way.telemetry.last_t_vehicle_us, way.last
    assert numbers is not None and last_us is not None and last is not None
    given = (way.parser.due(1, 1), way.seq, OWN_NS, last_us, way.sent_us, -1, last.reset_counter, 500_000)
    assert way.reflex.take(datagram, given, numbers)
    assert way.tracker.answer(way.reflex, way.timed) == UNSENDABLE
