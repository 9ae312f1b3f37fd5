"""Whatever comes in, the vehicle goes on, stays finite, and sends every state."""

from __future__ import annotations

import math
import re
import socket
import struct
from dataclasses import replace

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sim_link import codec, missions, peer
from sim_link.codec import Encoder, frames, mavlink
from sim_link.fault_keys import FaultError
from sim_link.fault_kinds import fault
from sim_link.faults import AT_ONCE_MAX
from sim_link.intake import ALLOWANCE_LEAST, allowance
from sim_link.modes import Mode
from sim_link.peer import Peer, PeerOptions
from sim_link.vehicle import Vehicle, VehicleOptions
from sim_link.vehicle_file import load

FILE = replace(load("paper"), state_rate_hz=100.0)
IN_AIR = ((0.0, 0.0, -20.0), 0.0)
HEARD = re.findall(  # what the vehicle acts on
    r"\w+",
    "HEARTBEAT SET_MODE MANUAL_CONTROL RC_CHANNELS_OVERRIDE PING TIMESYNC COMMAND_LONG COMMAND_INT PARAM_REQUEST_READ "
    "PARAM_REQUEST_LIST PARAM_SET SET_ATTITUDE_TARGET SET_ACTUATOR_CONTROL_TARGET SET_POSITION_TARGET_LOCAL_NED "
    "SET_POSITION_TARGET_GLOBAL_INT MISSION_COUNT MISSION_ITEM_INT MISSION_ITEM MISSION_REQUEST_LIST "
    "MISSION_REQUEST_INT MISSION_ACK MISSION_CLEAR_ALL MISSION_SET_CURRENT FILE_TRANSFER_PROTOCOL SERIAL_CONTROL",
)
COMMANDS = re.findall(
    r"\w+",
    "COMPONENT_ARM_DISARM DO_SET_MODE NAV_TAKEOFF NAV_LAND NAV_RETURN_TO_LAUNCH DO_REPOSITION DO_CHANGE_SPEED "
    "DO_SET_HOME DO_SET_STANDARD_MODE MISSION_START DO_SET_MISSION_CURRENT PREFLIGHT_STORAGE INJECT_FAILURE "
    "SET_MESSAGE_INTERVAL GET_MESSAGE_INTERVAL REQUEST_MESSAGE DO_AUTOTUNE_ENABLE RUN_PREARM_CHECKS",
)
ODDITIES = (math.nan, math.inf, -math.inf, 0.0, -1.0, 1.0, 6.0, 0.5, 1e-38, 3e38, -3e38, 1e9, 331.0)
NUMBERS = st.sampled_from(ODDITIES) | st.floats(width=32)
SIZES = {"b": 1, "B": 1, "h": 2, "H": 2, "i": 4, "I": 4, "q": 8, "Q": 8}


def vehicle(**options) -> Vehicle:
    options.setdefault("start", IN_AIR)
    return Vehicle(VehicleOptions(vehicle=FILE, engine="python", **options))


# What may come in


def fields(layout: str) -> st.SearchStrategy[bytes]:
    """Any content of a message with a struct layout: strange numbers, small whole ones, any bytes."""
    parts = []
    for count, kind in re.findall(r"(\d*)([a-zA-Z])", layout):
        many = int(count or 1)
        if kind == "s":
            parts.append(st.binary(min_size=many, max_size=many))
        elif kind in "fd":
            parts += [NUMBERS.map(lambda x, k=kind: struct.pack(f"<{k}", x))] * many
        else:
            size = SIZES[kind]
            small = st.integers(0, 8).map(lambda x, s=size: x.to_bytes(s, "little"))
            parts += [small | st.binary(min_size=size, max_size=size)] * many
    return st.tuples(*parts).map(b"".join)


def framed(number: int, payload: bytes, system: int = 1) -> bytes:
    return Encoder(system, 191).hot(number, payload or b"\0")


@st.composite
def messages(draw) -> bytes:
    """A valid frame with any content, of any sender; mostly of a kind that the vehicle acts on."""
    name = draw(st.sampled_from(HEARD))
    number = getattr(mavlink, f"MAVLINK_MSG_ID_{name}")
    if draw(st.integers(0, 9)) == 0:
        number = draw(st.sampled_from(sorted(mavlink.mavlink_map)))
    layout = mavlink.mavlink_map[number].unpacker.format
    return framed(number, draw(fields(layout)), draw(st.sampled_from((1, 1, 1, 0, 255, 77))))


@st.composite
def commands(draw) -> bytes:
    """A command that there is, for this vehicle, with any parameters."""
    number = getattr(mavlink, f"MAV_CMD_{draw(st.sampled_from(COMMANDS))}")
    params = draw(st.lists(NUMBERS, min_size=7, max_size=7))
    if draw(st.booleans()):
        return framed(76, struct.pack("<7fHBBB", *params, number, 1, 1, 0))
    places = draw(st.lists(st.integers(-(2**31), 2**31 - 1), min_size=2, max_size=2))
    frame = draw(st.sampled_from((0, 1, 3, 5, 6, 8, 255)))
    return framed(75, struct.pack("<4fiifHBBBBB", *params[:4], *places, params[6], number, 1, 1, frame, 0, 0))


@st.composite
def settings_of_parameters(draw) -> bytes:
    """Any value for a parameter that there is."""
    known = PARAMETERS
    name = draw(st.sampled_from(known.names))
    kind = known.type_of(name)
    whole = st.integers(-(2**31), 2**31 - 1) | st.integers(-1, 8)
    value = struct.pack("<i", draw(whole)) if kind == 6 else struct.pack("<f", draw(NUMBERS))
    return framed(23, struct.pack("<4sBB16sB", value, 1, 1, name.encode(), kind))


@st.composite
def broken(draw) -> bytes:
    """A frame that was cut off, or of which a byte is wrong, alone or between others."""
    whole = draw(messages())
    cut = draw(st.integers(0, len(whole)))
    if draw(st.booleans()):
        return whole[:cut] + draw(st.sampled_from((b"", whole)))
    at = draw(st.integers(0, len(whole) - 1))
    return whole[:at] + bytes((whole[at] ^ draw(st.integers(1, 255)),)) + whole[at + 1 :]


PARAMETERS = vehicle().parameters
ANYTHING = st.binary(max_size=300) | messages() | commands() | settings_of_parameters() | broken()


def is_finite(v: Vehicle) -> bool:
    truth = v.airframe.truth()
    return all(map(math.isfinite, (*truth.p, *truth.v, *truth.q, *truth.w, *truth.rotor_n)))


def numbers_in(sock: socket.socket) -> list[int]:
    """The numbers of all messages that wait in a socket."""
    found = []
    while True:
        try:
            found += [frame.msg_id for frame in frames(sock.recv(2048))]
        except BlockingIOError:
            return found


class Lines:
    """A peer that does not wait for the clock, and a socket on each of its links."""

    def __init__(self, v: Vehicle, **options) -> None:
        self.companion, self.ground = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        for sock in (self.companion, self.ground):
            sock.bind(("127.0.0.1", 0))
            sock.setblocking(False)
        ports = {"port": 0, "remote_port": self.companion.getsockname()[1], "ground_port": 0, "ground_remote_port": 0}
        self.peer = Peer(v, PeerOptions(**{"speed": 1e6, **ports, **options}))

    def __enter__(self) -> Lines:
        return self

    def __exit__(self, *exc) -> None:
        for closes in (self.peer, self.companion, self.ground):
            closes.close()

    def to_companion_link(self, datagram: bytes) -> None:
        self.companion.sendto(datagram, ("127.0.0.1", self.peer.companion.port))

    def to_ground_link(self, datagram: bytes) -> None:
        assert self.peer.ground is not None
        self.ground.sendto(datagram, ("127.0.0.1", self.peer.ground.port))

    def heard(self) -> list[int]:
        """The numbers of all messages that have come from the companion link since the last time."""
        return numbers_in(self.companion)


@settings(max_examples=80, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(
    st.lists(st.tuples(st.booleans(), ANYTHING), min_size=1, max_size=12),
    st.booleans(),
    st.sampled_from(("1.18", "1.13")),
)
def test_nothing_that_comes_in_stops_the_vehicle(datagrams: list[tuple[bool, bytes]], in_air: bool, px4: str) -> None:
    v = vehicle(start=IN_AIR if in_air else None, px4=px4)
    with Lines(v) as lines:
        v.companion.set_interval(codec.ID_ODOMETRY, 1, v.t_us)
        start_us, states, steps = v.airframe.t_us, 0, 0
        for to_ground, datagram in datagrams:
            (lines.to_ground_link if to_ground else lines.to_companion_link)(datagram)
            for _ in range(3):
                lines.peer.step()
                steps += 1
                states += lines.heard().count(codec.ID_ODOMETRY)
                assert is_finite(v)
        assert v.airframe.t_us == start_us + steps * v.period_us
        link = v.companion.interval_us(codec.ID_ODOMETRY)
        assert states == steps or link != 1, "every state was sent, unless somebody has asked for fewer"


@settings(max_examples=40, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(st.lists(settings_of_parameters(), min_size=1, max_size=30), st.sampled_from(("hold", "go", "land", "return")))
def test_absurd_parameters_do_not_stop_a_flight(values: list[bytes], what: str) -> None:
    v = vehicle()
    for value in values:
        v.receive(frames(value)[0], v.companion)
    numbers = {"go": 192, "land": 21, "return": 20}
    if what != "hold":
        params = (-1.0, 1.0, 0.0, math.nan, 47.3978, 8.5457, 520.0) if what == "go" else (0.0,) * 7
        v.receive(frames(framed(76, struct.pack("<7fHBBB", *params, numbers[what], 1, 1, 0)))[0], v.companion)
    for _ in range(25):
        v.tick()
        assert is_finite(v)


# What has stopped it once


def test_a_turn_to_an_infinite_heading_is_none() -> None:
    v = vehicle()
    params = (-1.0, 1.0, 0.0, math.inf, 47.3978, 8.5457, 520.0)
    v.receive(frames(framed(76, struct.pack("<7fHBBB", *params, 192, 1, 1, 0)))[0], v.companion)
    for _ in range(5):
        v.tick()
    assert is_finite(v)


@pytest.mark.parametrize("repeats", [math.inf, math.nan])
def test_a_jump_without_a_number_of_times_is_refused(repeats: float) -> None:
    item = missions.Item(2, missions.JUMP, 0, 1, (0.0, repeats, 0.0, 0.0), 0, 0, 0.0)
    assert missions.refusal(missions.MISSION, item) == missions.INVALID_PARAM2


@pytest.mark.parametrize("capacity", [math.inf, 3e38])
def test_a_battery_of_any_capacity_lasts_for_a_time(capacity: float) -> None:
    v = vehicle(parameters={"BAT1_CAPACITY": capacity})
    for _ in range(30):
        v.tick()
    assert 0 <= v.slow.battery.time_remaining_s < 2**31


def test_the_velocity_integral_stays_finite_whatever_the_gains() -> None:
    gains = {"MPC_XY_VEL_I_ACC": 1000.0, "MPC_XY_VEL_P_ACC": 0.1, "MPC_THR_MAX": 0.5}
    v = vehicle(parameters=gains)
    payload = mavlink.MAVLink_set_position_target_local_ned_message.unpacker.pack(
        0, 3e38, -3e38, -20.0, *(0.0,) * 8, 0b110111111000, 1, 1, 1
    )
    mode = framed(76, struct.pack("<7fHBBB", 1.0, 6.0, *(0.0,) * 5, 176, 1, 1, 0))
    for k in range(400):
        for raw in (framed(84, payload), *((mode,) if k == 2 else ())):
            v.receive(frames(raw)[0], v.companion)
        v.tick()
        assert is_finite(v)
    assert v.autopilot.mode.name == "OFFBOARD"


def test_a_polygon_with_something_else_between_its_corners_is_none() -> None:
    corner = missions.Item(0, missions.POLYGON_IN, 0, 1, (3.0, 0.0, 0.0, 0.0), 473977420, 85455940, 0.0)
    for number in (math.nan, math.inf):
        stranger = corner._replace(command=missions.RETURN_POINT, params=(number, 0.0, 0.0, 0.0))
        assert missions.refusal(missions.FENCE, stranger) == missions.ACCEPTED
        assert not missions.consistent(missions.FENCE, [corner, stranger, corner])
        assert not missions.consistent(missions.FENCE, [corner, corner, stranger])


def test_home_does_not_rise_beyond_what_messages_can_tell() -> None:
    v = vehicle()
    home = v.autopilot.guidance.home
    above_the_last = struct.pack("<4fiifHBBBBB", 0, 0, 0, 0, 473977420, 85455940, 3e38, 179, 1, 1, 6, 0, 0)
    for _ in range(3):
        v.receive(frames(framed(75, above_the_last))[0], v.companion)
        for _ in range(60):
            v.tick()
    assert v.autopilot.guidance.home == home
    assert all(v.telemetry.build(number) for number in (codec.ID_GLOBAL_POSITION_INT, 141, 242))


@pytest.mark.parametrize("name", ["MPC_MANTHR_MIN", "MPC_THR_HOVER", "MPC_THR_MAX"])
@pytest.mark.parametrize("value", [3.4e38, -3.4e38, math.inf, math.nan])
@pytest.mark.parametrize("throttle", [0, 1000])
def test_sticks_give_a_thrust_that_messages_can_tell(name: str, value: float, throttle: int) -> None:
    v = vehicle(parameters={name: value})
    for k in range(30):
        v.autopilot.manual_control(z=throttle)
        if k == 0:
            v.autopilot.set_mode(Mode.MANUAL)
        v.tick()
        assert v.telemetry.build(codec.ID_ATTITUDE_TARGET)
        assert 0.0 <= v.autopilot.held.thrust <= 1.0
    assert v.autopilot.mode is Mode.MANUAL


def test_setpoints_on_their_way_do_not_pile_up_while_nobody_flies_them() -> None:
    v = Vehicle(VehicleOptions(vehicle=replace(FILE, command_delay_s=0.05), engine="python"))
    setpoint = framed(82, struct.pack("<I4f3ffBBB", 0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.1, 1, 1, 7))
    for k in range(300):
        v.receive(frames(setpoint)[0], v.companion)
        if k == 0:
            v.autopilot.set_mode(Mode.OFFBOARD)
        v.tick()
    assert v.autopilot.mode is Mode.OFFBOARD and not v.autopilot.armed
    assert len(v.autopilot.offboard.under_way) <= 6


def test_faults_that_are_ordered_have_an_end() -> None:
    v = vehicle()
    for _ in range(AT_ONCE_MAX):
        v.faults.inject("wind", wind_m_s=(0.01, 0.0, 0.0))
    with pytest.raises(FaultError, match="too many faults"):
        v.faults.add(fault("force", force_n=(0.0, 0.0, 0.0)))


# Floods


def request(number: int, answer: int = 0) -> bytes:
    """A REQUEST_MESSAGE."""
    return framed(76, struct.pack("<7fHBBB", number, answer, 0, 0, 0, 0, 0, 512, 1, 1, 0))


def shell(line: str) -> bytes:
    data = f"{line}\n".encode()
    message = mavlink.MAVLink_serial_control_message(10, 0, 0, 0, len(data), list(data.ljust(70, b"\0")))
    return Encoder(255, 190).cold(message)


FLOODS = {
    "noise": bytes(range(256)) * 4,
    "beginnings": b"\xfe" * 2000,
    "beginnings of MAVLink 2": b"\xfd" * 2000,
    "requests": request(148),
    "requests with many answers": request(435),
    "many requests in one datagram": request(148) * 40,
    "parameter lists": framed(21, b"\1\1"),
    "unknown commands": framed(76, struct.pack("<7fHBBB", *(1.0,) * 7, 9999, 1, 1, 0)),
    "refused modes": framed(76, struct.pack("<7fHBBB", 1, 6, 0, 0, 0, 0, 0, 176, 1, 1, 0)),
    "commands for another system": framed(76, struct.pack("<7fHBBB", *(1.0,) * 7, 512, 77, 1, 0)),
    "time requests": framed(111, struct.pack("<qqBB", 0, 1, 0, 0)),
    "faults": shell("fault wind, wind_m_s = [0.0, 0.0, 0.001], for_s = 0.1"),
    "help": shell("help"),
}
STATES = 20
EACH = 60
"""Datagrams to each link per state, more than a state's allowance."""


@pytest.mark.parametrize("name", FLOODS)
def test_a_flood_is_heard_in_bounded_portions(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every state comes, with all its messages; of the flood each state takes so much and no more."""
    v = vehicle()
    work = {"datagrams": 0, "messages": 0, "answers": 0}
    with Lines(v) as lines:
        for endpoint in (lines.peer.companion, lines.peer.ground):
            assert endpoint is not None
            take_datagram = endpoint.take

            def counted(take_datagram=take_datagram):
                taken = take_datagram()
                work["datagrams"] += taken is not None
                return taken

            monkeypatch.setattr(endpoint, "take", counted)
        take = v.receive

        def taken(frame, link):
            queued = len(link.outbox)
            take(frame, link)
            work["messages"] += 1
            work["answers"] += len(link.outbox) - queued

        monkeypatch.setattr(v, "receive", taken)
        v.companion.set_interval(codec.ID_ODOMETRY, 1, v.t_us)
        start_us = v.t_us
        states = 0
        for _ in range(STATES):
            for _ in range(EACH):
                lines.to_companion_link(FLOODS[name])
                lines.to_ground_link(FLOODS[name])
            work.update(datagrams=0, messages=0, answers=0)
            lines.peer.step()
            # Both links have the same allowance; the last message of each may bring more answers than are left.
            assert sum(work.values()) <= 2 * (ALLOWANCE_LEAST + 20), work
            assert work["datagrams"] <= 2 * ALLOWANCE_LEAST
            assert work["datagrams"] + work["messages"] > 0
            states += lines.heard().count(codec.ID_ODOMETRY)
        assert v.t_us == start_us + STATES * v.period_us
        assert states == STATES
        assert is_finite(v)


def test_a_flood_passes_and_the_vehicle_obeys_again() -> None:
    v = vehicle()
    with Lines(v) as lines:
        for _ in range(300):
            lines.to_companion_link(FLOODS["unknown commands"])
        for _ in range(300):
            lines.peer.step()
        lines.heard()
        lines.to_companion_link(request(148))
        for _ in range(3):
            lines.peer.step()
        assert mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION in lines.heard()


def test_a_flood_of_one_link_does_not_silence_the_other() -> None:
    v = vehicle()
    with Lines(v) as lines:
        lines.to_companion_link(framed(0, struct.pack("<IBBBBB", 0, 18, 8, 0, 4, 3)))
        for _ in range(5):
            for _ in range(EACH):
                lines.to_ground_link(FLOODS["requests"])
            lines.to_companion_link(request(148))
            lines.heard()
            lines.peer.step()
            lines.peer.step()
            assert mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION in lines.heard()


def test_an_endless_flood_does_not_hold_the_clock_in_lockstep(monkeypatch: pytest.MonkeyPatch) -> None:
    """The companion's answer is lost in it: the vehicle gives up after its patience, and goes on."""
    v = vehicle()
    monkeypatch.setattr(peer, "PATIENCE_S", 0.05)
    with Lines(v, lockstep=True) as lines:
        sender = ("127.0.0.1", 9)
        for endpoint in (lines.peer.companion, lines.peer.ground):
            monkeypatch.setattr(endpoint, "receive", lambda: ([], sender))
        lines.peer.step()
        assert not lines.peer.synchronous
        before_us = v.t_us
        lines.peer.step()
        assert v.t_us == before_us + v.period_us


def test_of_too_many_texts_a_few_are_sent() -> None:
    v = vehicle()
    v.autopilot.texts.extend((2, f"text {k}") for k in range(100))
    v.tick()
    sent = [frames(raw)[0].msg_id for raw in v.companion.outbox].count(mavlink.MAVLINK_MSG_ID_STATUSTEXT)
    assert 1 <= sent <= 10
    assert not v.autopilot.texts


def test_a_companion_that_answers_at_once_does_not_keep_the_ground_link_from_being_heard(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    v = vehicle()
    with Lines(v, lockstep=True) as lines:
        endpoint = lines.peer.companion
        sender = endpoint.partner = lines.companion.getsockname()

        def answer():
            return framed(111, struct.pack("<qqBB", 1, lines.peer._awaited_ns, 0, 0)), sender

        monkeypatch.setattr(endpoint, "take", answer)
        lines.peer.step()
        lines.to_ground_link(request(148))
        for _ in range(2):
            lines.peer.step()
        assert lines.peer.synchronous
        assert mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION in numbers_in(lines.ground)


def test_what_a_state_is_allowed() -> None:
    assert allowance(0.004) == 20
    assert allowance(0.01, 20) == allowance(1e-6) == ALLOWANCE_LEAST


def test_looking_for_messages_in_nonsense_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = 0
    begin = codec._frame_at

    def counted(*place):
        nonlocal tried
        tried += 1
        return begin(*place)

    monkeypatch.setattr(codec, "_frame_at", counted)
    valid = framed(0, struct.pack("<IBBBBB", 0, 6, 8, 0, 4, 3))
    assert codec.frames(b"\xfe" * 2000) == []
    assert 0 < tried < 50
    assert [f.msg_id for f in codec.frames(b"\xfd\x01\xfe" * 5 + valid + b"\0\xfe" + valid)] == [0, 0]
