"""What the control loop does when states are bad, the link or the autopilot fails, or somebody else takes over."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
from flight_cases import (
    COMMAND_ACK,
    COMMAND_LONG,
    HOLD,
    OFFBOARD,
    Stand,
    changed_odometry,
    make_flight,
    set_mode_from_elsewhere,
)

from companion.control.output import RateSetpoint
from companion.errors import ExitCode
from companion.flight import last_resort, loop
from companion.flight.phases import Cause
from sim_link import codec
from sim_link.fault_kinds import fault
from sim_link.modes import Mode

ODOMETRY = codec.ID_ODOMETRY
FAULT_S = 0.8
"""Faults begin so long after OFFBOARD, in the middle of the join or the track."""
SILENCE_S = 0.05
STEP_S = 0.01
NAN = math.nan


def broken(**changes):
    """Every ODOMETRY from FAULT_S on has these contents."""

    def alter(stand, msg_id, raw):
        if msg_id != ODOMETRY or stand.offboard_s < FAULT_S:
            return [raw]
        return [changed_odometry(stand, raw, **changes)]

    return alter


def stopped(stand, msg_id, raw):
    return [] if msg_id == ODOMETRY and stand.offboard_s >= FAULT_S else [raw]


class Repeated:
    """The last good ODOMETRY again and again."""

    def __init__(self):
        self.last = b""

    def __call__(self, stand, msg_id, raw):
        if msg_id != ODOMETRY:
            return [raw]
        if stand.offboard_s < FAULT_S:
            self.last = raw
        return [self.last]


BAD_STATES = {
    "stop": (stopped, "rates", None),
    "go back": (broken(t_us=-500_000), "rates", "BACK_IN_TIME"),
    "repeat": (Repeated(), "attitude", "REPEATED"),
    "hold NaN": (broken(p=(0.0, NAN, 0.0)), "rates", "NOT_FINITE"),
    "hold a zero quaternion": (broken(q=(0.0, 0.0, 0.0, 0.0)), "actuators", "ZERO_QUATERNION"),
}


@pytest.mark.parametrize("what", BAD_STATES)
def test_states_that(what: str, tmp_path) -> None:
    """No setpoint is computed from them: one coast setpoint, Hold until acknowledged, then silence."""
    alter, output, rejection = BAD_STATES[what]
    flight = make_flight(output__kind=output)
    with Stand(flight, tmp_path, alter=alter, px4="1.13" if output == "actuators" else "1.18") as stand:
        flown = stand.fly()
        assert (flown.cause, flown.code) == (Cause.STATE_LOST, ExitCode.LOST), flown.outcome.sentence
        assert stand.mode is Mode.HOLD
        assert stand.vehicle.autopilot.intended is Mode.HOLD
    assert flown.outcome.sentence.endswith("the vehicle is in Hold")
    assert set(flown.outcome.rejected_states) == ({rejection} if rejection else set())
    # One setpoint per state before, one after the limit on silence, none any more.
    *_, last, coast = stand.setpoints()
    at_s = (coast.t_us - stand.offboard_us) * 1e-6
    assert (coast.t_us - last.t_us) * 1e-6 == pytest.approx(SILENCE_S + STEP_S, abs=1.5 * STEP_S)
    assert stand.setpoints(FAULT_S) == [coast]
    body = flight.vehicle.body.mass_kg * 9.81 / flight.vehicle.thrust_full_n
    if output == "actuators":
        assert coast.message.controls == pytest.approx([0.0, 0.0, 0.0, body, 0, 0, 0, 0], abs=1e-3)
    else:
        m = coast.message
        assert m.thrust == pytest.approx(body, abs=1e-3)
        assert (m.body_roll_rate, m.body_pitch_rate, m.body_yaw_rate) == (0.0, 0.0, 0.0)
        assert m.q == ([1.0, 0.0, 0.0, 0.0] if output == "rates" else pytest.approx([1, 0, 0, 0], abs=0.05))
    # Hold is asked for at once, and no more when it was acknowledged.
    (asked,) = stand.mode_requests(0.1)
    assert asked == (pytest.approx(at_s, abs=STEP_S), HOLD)
    # The record ends with the last good state, and holds nothing of the bad ones.
    assert bool((flown.record.rows[:, 0] > 0).all())
    assert flown.record.column("t_s")[-1] * 1e6 <= last.t_us
    assert flown.summary["position_max_m"] is None or flown.summary["position_max_m"] < 0.1


def test_hold_is_asked_for_until_it_is_acknowledged(tmp_path) -> None:
    """Every 100 ms; when nothing comes back the flight ends all the same, and the vehicle fails safe."""

    def deaf(stand, frame):
        return stand.offboard_s > FAULT_S and frame.msg_id == COMMAND_LONG

    with Stand(make_flight(), tmp_path, alter=stopped, parameters={"COM_OBL_RC_ACT": 5}) as stand:
        stand.deaf = deaf
        flown = stand.fly()
        # Setpoints ceased: Hold is flown as a failsafe, OFFBOARD is still what was asked for.
        assert (stand.mode, stand.vehicle.autopilot.intended) == (Mode.HOLD, Mode.OFFBOARD)
    assert flown.cause is Cause.STATE_LOST
    assert "Hold was not acknowledged" in flown.outcome.sentence
    asked = stand.mode_requests(0.1)
    times = [t for t, mode in asked]
    assert {mode for _, mode in asked} == {HOLD}
    assert len(times) >= 25
    assert all(b - a == pytest.approx(0.1, abs=0.011) for a, b in pairwise(times))
    assert len(stand.setpoints(FAULT_S)) == 1


def test_lost_acknowledgement_is_made_up_for_by_the_reported_mode(tmp_path) -> None:
    def alter(stand, msg_id, raw):
        gone = msg_id == COMMAND_ACK and stand.offboard_s > FAULT_S
        return [] if gone else stopped(stand, msg_id, raw)

    with Stand(make_flight(), tmp_path, alter=alter) as stand:
        flown = stand.fly()
        assert stand.vehicle.autopilot.intended is Mode.HOLD
    assert flown.outcome.sentence.endswith("the vehicle is in Hold")
    assert 1 <= len(stand.mode_requests(0.1)) <= 3


def test_estimate_that_jumps_far_is_not_flown_on(tmp_path) -> None:
    with Stand(make_flight(), tmp_path, alter=broken(reset_counter=7, p=(3.0, 0.0, -20.0))) as stand:
        flown = stand.fly()
        assert stand.mode is Mode.HOLD
    assert (flown.cause, flown.code) == (Cause.ESTIMATE_JUMPED, ExitCode.LOST)
    assert "moved by 3.00 m" in flown.outcome.sentence
    assert "(limits.estimate_jump_max_m), reset counter 7" in flown.outcome.sentence
    (coast,) = stand.setpoints(FAULT_S)
    assert coast.message.body_pitch_rate == 0.0


def test_rebooted_autopilot(tmp_path) -> None:
    """Its clock starts again; the old flight ends, whatever the new one reports."""
    with Stand(make_flight(), tmp_path, alter=broken(t_us=-3_000_000)) as stand:
        flown = stand.fly()
        assert stand.mode is Mode.HOLD
    assert (flown.cause, flown.code) == (Cause.REBOOTED, ExitCode.LOST)
    assert flown.outcome.rejected_states["REBOOTED"] == 1
    assert flown.outcome.sentence.endswith("handed over to Hold")
    assert len(stand.setpoints(FAULT_S + 0.02)) <= 1


def test_time_that_jumps_ahead(tmp_path) -> None:
    """More than half of COM_OF_LOSS_T without a setpoint: PX4 is about to leave, or has left; nothing more is sent."""
    with Stand(make_flight(), tmp_path, alter=broken(t_us=600_000)) as stand:
        flown = stand.fly()
        assert stand.mode is Mode.HOLD
    assert (flown.cause, flown.code) == (Cause.OWN_SILENCE, ExitCode.LOST)
    assert stand.setpoints(FAULT_S) == []


def test_vehicle_that_goes_silent(tmp_path, monkeypatch) -> None:
    """Its process was killed: a last coast setpoint, Hold for a while, and an end in bounded time."""
    monkeypatch.setattr(loop, "PACED_SILENCE_S", 0.3)
    monkeypatch.setattr(last_resort, "TIMEOUT_NS", 400_000_000)
    with Stand(make_flight(), tmp_path) as stand:
        stand.after_offboard(FAULT_S, stand.stop)
        flown = stand.fly()
        late = []
        while (datagram := stand.peer.companion.receive()) is not None:  # what came when nobody listened any more
            late += [codec.attitude_target(f.payload) for f in datagram[0] if f.msg_id == codec.ID_SET_ATTITUDE_TARGET]
    assert (flown.cause, flown.code) == (Cause.LINK_LOST, ExitCode.LOST)
    assert "Hold was not acknowledged" in flown.outcome.sentence
    assert [s.rates for s in late][-1:] == [(0.0, 0.0, 0.0)]
    assert len(late) <= 2
    holds = [t for t, mode in stand.mode_requests() if mode == HOLD]
    assert 3 <= len(holds) <= 5


@pytest.mark.parametrize("mode", [Mode.HOLD, Mode.LAND, Mode.POSITION])
def test_pilot_takes_over(mode: Mode, tmp_path) -> None:
    """The companion stops sending for good, says so, and asks for nothing."""

    def take_over():
        stand.vehicle.autopilot.manual_control()  # Position needs sticks
        set_mode_from_elsewhere(stand, mode)

    with Stand(make_flight(), tmp_path) as stand:
        stand.after_offboard(FAULT_S, take_over)
        flown = stand.fly()
        assert (stand.mode, stand.vehicle.autopilot.intended) == (mode, mode)
    assert (flown.cause, flown.code) == (Cause.TAKEN_OVER, ExitCode.LOST)
    assert mode.label in flown.outcome.sentence
    assert any("nothing more is sent" in line for line in flown.lines)
    # CURRENT_MODE comes at 10 Hz: so long the loop cannot know.
    assert stand.setpoints(FAULT_S + 0.15) == []
    assert [m for t, m in stand.mode_requests(0.1) if m != mode.custom_mode] == []
    assert len(stand.mode_requests(0.1)) == 1  # the pilot's own


def test_pilot_takes_over_while_the_companion_hands_over(tmp_path) -> None:
    """Hold is not forced on a pilot who was quicker."""

    def deaf(stand, frame):
        mine = frame.msg_id == COMMAND_LONG and frame.component == 191
        return mine and stand.offboard_s > FAULT_S

    def take_over():
        stand.vehicle.autopilot.manual_control()
        set_mode_from_elsewhere(stand, Mode.POSITION)

    with Stand(make_flight(), tmp_path, alter=stopped) as stand:
        stand.deaf = deaf
        stand.after_offboard(FAULT_S + 0.5, take_over)
        flown = stand.fly()
        assert stand.mode is Mode.POSITION
    assert flown.cause is Cause.STATE_LOST
    assert "Position by another hand" in flown.outcome.sentence
    assert [t for t, mode in stand.mode_requests(FAULT_S + 0.7)] == []


def test_other_systems_and_components_are_not_listened_to(tmp_path) -> None:
    """A second autopilot's heartbeat, and another component's states, change nothing."""
    mav = codec.mavlink

    def alter(stand, msg_id, raw):
        if msg_id != ODOMETRY:
            return [raw]
        foreign = changed_odometry(stand, raw, p=(100.0, 0.0, 0.0), component=195)
        other = codec.Encoder(9, 1)
        heartbeat = other.cold(mav.MAVLink_heartbeat_message(2, 12, 1, Mode.POSITION.custom_mode, 4, 3))
        mode = other.cold(mav.MAVLink_current_mode_message(0, Mode.POSITION.custom_mode, 0))
        return [foreign, heartbeat, raw, mode, foreign]

    with Stand(make_flight(), tmp_path, alter=alter) as stand:
        flown = stand.fly()
    assert flown.cause is Cause.COMPLETED
    assert flown.outcome.rejected_states == {}
    assert flown.summary["position_max_m"] < 0.05


def test_operator_interrupts(tmp_path) -> None:
    """In flight: Hold, and setpoints until it is acknowledged."""
    with Stand(make_flight(), tmp_path) as stand:
        flown = stand.fly(lambda loop: stand.after_offboard(FAULT_S, loop.interrupt))
        assert (stand.mode, stand.vehicle.autopilot.intended) == (Mode.HOLD, Mode.HOLD)
    assert (flown.cause, flown.code) == (Cause.INTERRUPTED, ExitCode.INTERRUPTED)
    assert flown.outcome.sentence.endswith("the vehicle is in Hold")
    ((asked_s, mode),) = stand.mode_requests(0.1)
    assert mode == HOLD
    assert FAULT_S <= asked_s <= FAULT_S + 0.15
    last_s = (stand.setpoints()[-1].t_us - stand.offboard_us) * 1e-6
    assert asked_s - STEP_S <= last_s <= asked_s + 2 * STEP_S


def test_operator_interrupts_before_anything_was_asked_for(tmp_path) -> None:
    """Whoever flies the vehicle meanwhile is not disturbed."""
    with Stand(make_flight(), tmp_path) as stand:
        stand.vehicle.autopilot.intended = stand.vehicle.autopilot.mode = Mode.RETURN
        flown = stand.fly(lambda flying: stop_at(stand, COMMAND_LONG, flying.interrupt))
    assert (flown.cause, flown.code) == (Cause.INTERRUPTED, ExitCode.INTERRUPTED)
    assert flown.phases == ["connect", "preflight"]
    assert stand.mode_requests(-math.inf) == []
    assert stand.setpoints(-math.inf) == []


def stop_at(stand: Stand, msg_id: int, thing) -> None:
    def deaf(stand, frame):
        if frame.msg_id == msg_id:
            thing()
        return False

    stand.deaf = deaf


@pytest.mark.parametrize("limit", ["position_error_abort_m", "tilt_max_rad"])
def test_guards(limit: str, tmp_path) -> None:
    """Beyond a bound the flight goes to Hold; the law flies on until the autopilot has it."""
    flight = make_flight(**{f"vehicle__limits__{limit}": 0.004, "world__force_n": [1.0, 0.0, 0.0]})
    with Stand(flight, tmp_path) as stand:
        flown = stand.fly()
        assert stand.mode is Mode.HOLD
    assert flown.code is ExitCode.LOST
    assert f"limits.{limit}" in flown.outcome.sentence
    ((asked_s, mode),) = stand.mode_requests(0.05)
    assert mode == HOLD
    assert len(stand.setpoints(asked_s - 1.5 * STEP_S)) in {1, 2, 3}


def raises(flying):
    step, count = flying._tracker.command, [0]

    def broken_step(*args, **options):
        count[0] += 1
        if count[0] > 150:
            raise ZeroDivisionError("float division by zero")
        return step(*args, **options)

    flying._tracker.command = broken_step


def gives_nan(flying):
    step, count = flying._tracker.command, [0]

    def broken_step(*args, **options):
        count[0] += 1
        setpoint = step(*args, **options)
        return RateSetpoint(0.5, (0.0, NAN, 0.0)) if count[0] > 150 else setpoint

    flying._tracker.command = broken_step


def breaks_the_log(flying):
    """What sees all traffic raises, from the middle of the flight on."""
    step, count = flying._tracker.command, [0]

    def broken_step_of_the_log(*args):
        raise BufferError("the log is broken")

    def counted(*args, **options):
        count[0] += 1
        if count[0] == 150:
            flying._wire._tap = broken_step_of_the_log
        return step(*args, **options)

    flying._tracker.command = counted


@pytest.mark.parametrize(
    ("damage", "cause", "says"),
    [
        (raises, Cause.FAULT, "ZeroDivisionError: float division by zero"),
        (gives_nan, Cause.UNSENDABLE, "nan is not"),
        (breaks_the_log, Cause.FAULT, "BufferError: the log is broken; handed over to Hold"),
    ],
)
def test_fault_of_the_program_still_hands_over(damage, cause: Cause, says: str, tmp_path) -> None:
    with Stand(make_flight(), tmp_path) as stand:
        flown = stand.fly(damage)
        assert (stand.mode, stand.vehicle.autopilot.intended) == (Mode.HOLD, Mode.HOLD)
    assert (flown.cause, flown.code) == (cause, ExitCode.INTERNAL)
    assert says in flown.outcome.sentence
    assert ("broken_step" in flown.outcome.fault) is (cause is Cause.FAULT)
    rates = [(s.message.body_roll_rate, s.message.body_pitch_rate, s.message.body_yaw_rate) for s in stand.setpoints()]
    assert all(math.isfinite(x) for w in rates for x in w)
    assert rates[-1] == (0.0, 0.0, 0.0)  # the coast setpoint
    assert rates[-2] != (0.0, 0.0, 0.0)
    modes = [mode for _, mode in stand.mode_requests(0.1)]
    assert set(modes) == {HOLD}
    assert len(modes) <= 3


def test_offboard_refused(tmp_path) -> None:
    """MAV_FWDEXTSP 0 makes PX4 deaf to setpoints: set after it was read, OFFBOARD is refused, the vehicle holds."""
    deaf = fault("parameter", 0.8, name="MAV_FWDEXTSP", value=0)
    with Stand(make_flight(), tmp_path, faults=(deaf,)) as stand:
        flown = stand.fly()
        assert stand.mode is Mode.HOLD
    assert (flown.cause, flown.code) == (Cause.REFUSED, ExitCode.REFUSED)
    assert "changing to Offboard was rejected for now" in flown.outcome.sentence
    assert "Switching to mode 'Offboard' is currently not possible" in flown.outcome.sentence
    assert [mode for _, mode in stand.mode_requests(-math.inf)] == [OFFBOARD, HOLD]


def test_vehicle_left_in_offboard_by_a_dead_companion(tmp_path) -> None:
    """PX4 would go back to OFFBOARD at the first setpoint: Hold is asked for before anything is sent."""
    with Stand(make_flight(), tmp_path) as stand:
        stand.vehicle.autopilot.intended = Mode.OFFBOARD
        flown = stand.fly()
    assert flown.cause is Cause.COMPLETED
    requests = [h for h in stand.heard if h.msg_id == COMMAND_LONG and h.message.command == 176]
    assert int(requests[0].message.param3) == 3  # Hold
    assert requests[0].t_us < stand.setpoints(-math.inf)[0].t_us
    assert requests[1].t_us <= stand.offboard_us  # OFFBOARD came when it was asked for, not before


def test_silent_vehicle_while_nothing_is_due(tmp_path, monkeypatch) -> None:
    """Also where no setpoints go out a vehicle that is gone is noticed."""
    monkeypatch.setattr(loop, "PACED_SILENCE_S", 0.3)
    with Stand(make_flight(), tmp_path) as stand:
        flown = stand.fly(lambda flying: stop_at(stand, COMMAND_LONG, stand.stop))
    assert flown.cause is Cause.LINK_LOST
    assert flown.phases == ["connect", "preflight"]
