"""Whole flights over UDP, what is refused before one, and that the same seed gives the same flight."""

from __future__ import annotations

import math
import socket
import threading
from typing import Any

import numpy as np
import pytest
from flight_cases import COMMAND_LONG, HOVER, INDOOR, Stand, make_flight

from companion import accelerate, realtime
from companion.errors import ExitCode
from companion.flight import connect
from companion.flight.bundled import free_udp_port
from companion.flight.engines import kernels
from companion.flight.health import SystemHealth
from companion.flight.loop import FlightLoop
from companion.flight.phases import PHASE_NAMES, Cause
from companion.flight.reflex import ANSWERED, UNSENDABLE
from companion.flight.tracker import Tracker
from companion.link.wire import Wire
from companion.record.columns import COLUMNS
from companion.record.flight_record import FlightRecord
from companion.record.summary import without_wall_clock
from companion.trajectory.load import of_flight
from sim_link import codec
from sim_link.codec import mavlink
from sim_link.fault_kinds import fault
from sim_link.modes import Mode

WALL_COLUMNS = ("state_age_ms", "step_us", "late")
ARM, NAV_TAKEOFF, NAV_LAND = 400, 22, 21


def test_from_the_ground_and_back(tmp_path) -> None:
    """Take-off, a smooth join, the trajectory, a stop, a landing; every change of phase has its reason."""
    trajectory = dict(INDOOR) | {"duration_s": 2.0}
    flight = make_flight(trajectory=trajectory, takeoff_altitude_m=3.0, after="land")
    quick = {"MPC_LAND_SPEED": 1.4, "COM_DISARM_LAND": 0.5, "MPC_TKO_RAMP_T": 1.0}
    with Stand(flight, tmp_path, start=None, parameters=quick) as stand:
        flown = stand.fly()
        assert not stand.vehicle.autopilot.armed
        assert stand.vehicle.autopilot.land.landed
        assert stand.mode is Mode.LAND
    assert (flown.cause, flown.code) == (Cause.COMPLETED, ExitCode.DONE)
    assert flown.outcome.sentence.endswith("landed and disarmed")
    assert flown.phases == ["connect", "preflight", "takeoff", "join", "track", "hold", "land"]
    times = [phase.at_s for phase in flown.outcome.phases]
    assert times == sorted(times)
    assert all(len(phase.reason) > 10 for phase in flown.outcome.phases)
    assert [line for line in flown.lines if line.startswith("takeoff: ")] == [
        f"takeoff: {flown.outcome.phases[2].reason}"
    ]
    commands = [h.message.command for h in stand.heard if h.msg_id == COMMAND_LONG]
    order = [commands.index(number) for number in (NAV_TAKEOFF, ARM, NAV_LAND)]
    assert order == sorted(order)
    # The reference's clock starts at the hold point, 3 m up, and the flight keeps to it.
    track = flown.record.in_phase("track")
    assert flown.summary["position_max_m"] < 0.1
    assert flown.record.column("ref_d")[track][0] == pytest.approx(-3.0, abs=0.2)
    join = flown.record.in_phase("join")
    error = np.linalg.norm(flown.record.columns("error_n", "error_e", "error_d"), axis=1)
    assert error[join].max() < 0.1
    # The landing is the autopilot's: no setpoints any more.
    land_us = flown.outcome.phases[-1].at_s * 1e6
    assert max(h.t_us for h in stand.setpoints()) <= land_us + 50_000


@pytest.mark.parametrize(
    ("output", "px4", "mask"), [("attitude", "1.18", 3), ("rates", "1.13", 128), ("actuators", "1.13", None)]
)
def test_outputs(output: str, px4: str, mask: int | None, tmp_path) -> None:
    flight = make_flight(output__kind=output, world__force_n=[1.0, 0.5, 0.0])
    with Stand(flight, tmp_path, px4=px4) as stand:
        flown = stand.fly()
        assert stand.mode is Mode.HOLD
    assert flown.cause is Cause.COMPLETED
    assert flown.summary["position_max_m"] < 0.2
    kinds = {h.msg_id for h in stand.setpoints()}
    if mask is None:
        assert kinds == {codec.ID_SET_ACTUATOR_CONTROL_TARGET}
    else:
        assert kinds == {codec.ID_SET_ATTITUDE_TARGET}
        assert {h.message.type_mask for h in stand.setpoints()} == {mask}
    # One setpoint per state, none repeated: their stamps all differ.
    name = "time_boot_ms" if mask is not None else "time_usec"
    stamps = [getattr(h.message, name) for h in stand.setpoints(-math.inf)]
    assert len(stamps) == len(set(stamps)) > 400


REFUSALS = {
    "MAV_TYPE 0": (dict(parameters={"MAV_TYPE": 0}), {}, "MAV_TYPE is 0"),
    "a failsafe that does nothing": (
        dict(parameters={"COM_OBL_RC_ACT": 0, "NAV_RCL_ACT": 0}),
        {},
        "set COM_OBL_RC_ACT to 5",
    ),
    "actuators on 1.18": (dict(), dict(output__kind="actuators"), "since 1.14; use output rates"),
    "few states": (dict(), {}, "ODOMETRY comes at 33 Hz, 80 Hz are required"),
    "no parameters": (dict(), {}, "reading COM_OBL_RC_ACT got no answer"),
}


@pytest.mark.parametrize("what", REFUSALS)
def test_refused_before_anything_moves(what: str, tmp_path) -> None:
    options, changes, says = REFUSALS[what]
    every_third = [0]

    def thinned(stand, msg_id, raw):
        every_third[0] += msg_id == codec.ID_ODOMETRY
        return [] if msg_id == codec.ID_ODOMETRY and every_third[0] % 3 else [raw]

    def mute(stand, msg_id, raw):
        return [] if msg_id == mavlink.MAVLINK_MSG_ID_PARAM_VALUE else [raw]

    alter = {"few states": thinned, "no parameters": mute}.get(what)
    with Stand(make_flight(**changes), tmp_path, alter=alter, **options) as stand:
        flown = stand.fly()
        assert stand.mode is Mode.HOLD
    assert (flown.cause, flown.code) == (Cause.REFUSED, ExitCode.REFUSED)
    assert says in flown.outcome.sentence
    assert flown.phases == ["connect", "preflight"]
    assert stand.setpoints(-math.inf) == []
    assert stand.mode_requests(-math.inf) == []


def test_arming_denied(tmp_path, monkeypatch) -> None:
    """After the checks: the autopilot's own words are the reason, and the take-off mode does not stay selected."""
    later = fault("parameter", 1.0, name="COM_ARMABLE", value=0)
    health = SystemHealth(sticks=False, fence_kept=None, can_arm=True, battery=1.0)
    monkeypatch.setattr(SystemHealth, "from_message", classmethod(lambda cls, message: health))
    with Stand(make_flight(), tmp_path, start=None, faults=(later,)) as stand:
        flown = stand.fly()
        assert not stand.vehicle.autopilot.armed
        assert stand.mode is Mode.HOLD
    assert (flown.cause, flown.code) == (Cause.REFUSED, ExitCode.REFUSED)
    assert "Arming denied: COM_ARMABLE is 0" in flown.outcome.sentence


def engines() -> list[str]:
    return ["python", "numba"] if accelerate.available() else ["python"]


@pytest.mark.parametrize("engine", engines())
def test_same_seed_same_flight(engine: str, tmp_path) -> None:
    """Noise, gusts and all: to the last bit, but for what the wall clock says."""
    flight = make_flight(trajectory=dict(HOVER) | {"duration_s": 0.5}, world__force_n=[2.0, 0.0, 0.0])
    flights = []
    for seed in (1, 1, 2) if engine == "python" else (1, 1):
        with Stand(flight, tmp_path, seed=seed) as stand:
            flights.append(stand.fly(engine=engine))
    first, second, *others = flights
    assert first.cause is Cause.COMPLETED
    assert without_wall_clock(first.summary) == without_wall_clock(second.summary)
    kept = [name for name in COLUMNS if name not in WALL_COLUMNS]
    assert first.record.columns(*kept).tobytes() == second.record.columns(*kept).tobytes()
    assert all(without_wall_clock(first.summary) != without_wall_clock(other.summary) for other in others)


@pytest.mark.numba
def test_a_flight_does_not_show_which_states_were_answered_by_reflex(tmp_path, monkeypatch) -> None:
    """States that are answered in one call, and the same flight with all of them taking the usual way."""
    flight = make_flight(trajectory=dict(INDOOR) | {"duration_s": 2.0}, world__force_n=[2.0, 0.0, 0.0])
    answer, answered = FlightLoop._answer_at_once, []

    def counted(loop: FlightLoop, *given: Any) -> bool:
        answered.append(answer(loop, *given))
        return answered[-1]

    def never(loop: FlightLoop, *given: Any) -> bool:
        return False

    flights, setpoints = [], []
    monkeypatch.setattr(realtime, "make_way", lambda: pytest.fail("a vehicle in lockstep has a core of its own"))
    for way in (counted, never):
        monkeypatch.setattr(FlightLoop, "_answer_at_once", way)
        with Stand(flight, tmp_path) as stand:
            flights.append(stand.fly(engine="numba"))
            setpoints.append([(heard.t_us, heard.message.to_dict()) for heard in stand.setpoints()])
    by_reflex, usual = flights
    assert sum(answered) > 0.6 * len(by_reflex.record) > 200
    assert by_reflex.cause is usual.cause is Cause.COMPLETED
    assert without_wall_clock(by_reflex.summary) == without_wall_clock(usual.summary)
    kept = [name for name in COLUMNS if name not in WALL_COLUMNS]
    assert by_reflex.record.columns(*kept).tobytes() == usual.record.columns(*kept).tobytes()
    assert setpoints[0] == setpoints[1]


@pytest.mark.numba
def test_a_setpoint_by_reflex_that_cannot_be_sent_ends_the_flight(tmp_path, monkeypatch) -> None:
    answer, last_step, left = Tracker.answer, Tracker.last_step, [100]

    def count_down(tracker: Tracker, *given: Any) -> int:
        left[0] -= 1
        code = answer(tracker, *given)
        return UNSENDABLE if code == ANSWERED and left[0] <= 0 else code

    def spoilt(tracker: Tracker) -> Any:
        out = last_step(tracker)
        return out._replace(setpoint=out.setpoint._replace(thrust=math.nan)) if left[0] <= 0 else out

    monkeypatch.setattr(Tracker, "answer", count_down)
    monkeypatch.setattr(Tracker, "last_step", spoilt)
    with Stand(make_flight(trajectory=dict(INDOOR)), tmp_path) as stand:
        flown = stand.fly(engine="numba")
        assert stand.mode is Mode.HOLD
    assert flown.cause is Cause.UNSENDABLE
    assert "thrust nan" in flown.outcome.sentence


# ---- nobody there, or somebody else --------------------------------------------------------------------------------


class Caller:
    """Sends the same datagrams to a port every 20 ms, as somebody who is no vehicle of ours."""

    def __init__(self, port: int, datagrams: list[bytes]) -> None:
        self._sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sock.bind(("127.0.0.1", 0))
        self._port = port
        self._datagrams = datagrams
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Caller:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join(5.0)
        self._sock.close()

    def _run(self) -> None:
        while not self._ended.wait(0.02):
            for datagram in self._datagrams:
                self._sock.sendto(datagram, ("127.0.0.1", self._port))


def heartbeat(system: int, component: int, kind: int, autopilot: int) -> bytes:
    message = mavlink.MAVLink_heartbeat_message(kind, autopilot, 1, Mode.HOLD.custom_mode, 4, 3)
    return codec.Encoder(system, component).cold(message)


GROUND_STATION = heartbeat(255, 190, 6, 8)
ARDUPILOT = heartbeat(1, 1, 2, 3)
PX4 = heartbeat(1, 1, 2, 12)
CALLERS = {
    "nobody": ([], Cause.NO_VEHICLE, "nothing came at udpin:127.0.0.1:{port} within 0.4 s"),
    "a ground station": ([GROUND_STATION], Cause.NO_VEHICLE, "none of them an autopilot's heartbeat"),
    "another autopilot": ([GROUND_STATION, ARDUPILOT], Cause.REFUSED, "system 1 is not PX4 (MAV_AUTOPILOT 3)"),
    "a link without states": ([PX4], Cause.NO_VEHICLE, "neither TIMESYNC nor ODOMETRY within 0.4 s"),
}


@pytest.mark.parametrize("who", CALLERS)
def test_no_vehicle(who: str) -> None:
    datagrams, cause, says = CALLERS[who]
    flight = make_flight()
    port = free_udp_port()
    connection = f"udpin:127.0.0.1:{port}"
    record = FlightRecord(0, PHASE_NAMES)
    with Caller(port, datagrams), Wire.open(connection) as wire:
        flying = FlightLoop(
            *(flight, of_flight(flight), wire, record, kernels("python")),
            connect_timeout_s=0.4,
            connection=connection,
        )
        outcome = flying.run()
    assert outcome.cause is cause
    assert cause.value.exit_code == (ExitCode.LOST if cause is Cause.NO_VEHICLE else ExitCode.REFUSED)
    assert says.format(port=port) in outcome.sentence
    assert outcome.phases == []


def test_vehicle_is_found_behind_a_louder_sender(tmp_path, monkeypatch) -> None:
    """The link locks on to the first sender, but not for good when that one is no vehicle."""
    monkeypatch.setattr(connect, "PEER_PATIENCE_NS", 500_000_000)
    flight = make_flight(trajectory=dict(HOVER) | {"duration_s": 0.2})
    with Stand(flight, tmp_path) as stand, Caller(stand.port, [GROUND_STATION]):
        flown = stand.fly()
    assert flown.cause is Cause.COMPLETED


def test_companion_that_speaks_first(tmp_path) -> None:
    """udpout: the vehicle knows of nobody until it is spoken to."""
    flight = make_flight(trajectory=dict(HOVER) | {"duration_s": 0.2})
    with Stand(flight, tmp_path, speaks_first=False) as stand:
        record = FlightRecord(1000, PHASE_NAMES)
        with Wire.open(f"udpout:127.0.0.1:{stand.peer.companion.port}") as wire:
            outcome = FlightLoop(flight, of_flight(flight), wire, record, kernels("python")).run()
    assert outcome.cause is Cause.COMPLETED
