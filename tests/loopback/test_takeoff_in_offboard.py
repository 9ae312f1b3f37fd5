"""Take-off in Offboard: the point that rises, the way from the ground to Hold, and how it is given up."""

from __future__ import annotations

import itertools
import math

import pytest
from flight_cases import INDOOR, OFFBOARD, SET_POSITION_TARGET_LOCAL_NED, Stand, make_flight, set_mode_from_elsewhere

from companion.control.output import PositionSetpoint
from companion.flight.climb import SPEED_M_S, Climb
from companion.flight.phases import Cause
from companion.link.telemetry import VehicleState
from sim_link import codec
from sim_link.modes import Mode

QUICK = {"MPC_TKO_RAMP_T": 1.0}


def state(t_s: float, p: tuple[float, float, float]) -> VehicleState:
    return VehicleState(round(1e6 * t_s), p, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0)


def climb() -> Climb:
    return Climb(state(0.0, (1.0, 2.0, -0.1)), 3.0)


def at(point: PositionSetpoint) -> tuple[float, float, float]:
    assert point.p is not None
    return point.p


def test_the_point_rises_smoothly_and_stays_at_the_top() -> None:
    rising = climb()
    assert at(rising.setpoint(5.0)) == (1.0, 2.0, -0.1)
    rising.begin(10.0)
    points = [rising.setpoint(10.0 + 0.01 * i) for i in range(800)]
    heights = [-at(point)[2] for point in points]
    speeds = [-point.v[2] for point in points]
    assert heights[0] == pytest.approx(0.1) and heights[-1] == pytest.approx(3.1)
    assert max(speeds) == pytest.approx(SPEED_M_S) and speeds[-1] == 0.0
    assert max(abs(b - a) for a, b in itertools.pairwise(speeds)) < 0.006, "no step of the speed"
    slopes = [(b - a) / 0.01 for a, b in itertools.pairwise(heights)]
    assert slopes == pytest.approx([0.5 * (a + b) for a, b in itertools.pairwise(speeds)], abs=1e-3)


def test_a_climb_that_is_stopped_stays_where_it_is() -> None:
    rising = climb()
    rising.begin(0.0)
    rising.stop(2.5)
    assert rising.setpoint(2.5) == rising.setpoint(9.0)
    assert rising.setpoint(9.0).v == (0.0, 0.0, 0.0)
    assert -3.0 < at(rising.setpoint(9.0))[2] < -1.0


def test_a_climb_that_goes_astray_is_told() -> None:
    rising = climb()
    assert rising.astray(state(1.0, (1.5, 2.0, -2.0))) == ""
    assert rising.astray(state(1.0, (4.0, 2.0, -2.0))) == "the vehicle is 3.0 m aside of where it stood, limit 2 m"
    assert rising.astray(state(1.0, (1.0, 2.0, -6.0))) == "the vehicle is 2.9 m above the height asked for"


def test_from_the_ground_in_offboard(tmp_path) -> None:
    """No take-off of the autopilot's; position setpoints in the first Offboard, the law's in the second alone."""
    trajectory = dict(INDOOR) | {"duration_s": 2.0}
    flight = make_flight(trajectory=trajectory, takeoff_altitude_m=3.0, takeoff="offboard")
    with Stand(flight, tmp_path, start=None, parameters=QUICK) as stand:
        flown = stand.fly()
        assert stand.mode is Mode.HOLD
    assert flown.cause is Cause.COMPLETED, flown.outcome.sentence
    assert flown.phases == ["connect", "preflight", "takeoff", "join", "track", "hold"]
    assert flown.outcome.phases[3].reason == "the vehicle holds at its take-off height, climbed to in Offboard"
    assert flown.summary["position_max_m"] < 0.1
    assert flown.record.column("p_d")[0] == pytest.approx(-3.0, abs=0.4)
    kinds = [h.msg_id for h in stand.setpoints(-math.inf)]
    first = kinds.index(codec.ID_SET_ATTITUDE_TARGET)
    assert set(kinds[:first]) == {SET_POSITION_TARGET_LOCAL_NED}
    assert set(kinds[first:]) == {codec.ID_SET_ATTITUDE_TARGET}
    assert [mode for _, mode in stand.mode_requests(-math.inf)].count(OFFBOARD) == 2


def test_the_pilot_takes_over_during_the_climb(tmp_path) -> None:
    flight = make_flight(takeoff_altitude_m=8.0, takeoff="offboard")
    with Stand(flight, tmp_path, start=None, parameters=QUICK) as stand:
        stand.after_offboard(6.0, lambda: set_mode_from_elsewhere(stand, Mode.LAND))
        flown = stand.fly()
        assert stand.mode is Mode.LAND
        late = stand.setpoints(6.3)
    assert flown.cause is Cause.TAKEN_OVER
    assert late == []


def test_states_that_cease_during_the_climb_end_it_in_hold(tmp_path) -> None:
    flight = make_flight(takeoff_altitude_m=8.0, takeoff="offboard")

    def cease(stand: Stand, msg_id: int, raw: bytes) -> list[bytes]:
        return [] if msg_id == codec.ID_ODOMETRY and stand.offboard_s > 6.0 else [raw]

    with Stand(flight, tmp_path, start=None, parameters=QUICK, alter=cease) as stand:
        flown = stand.fly()
        assert stand.mode is Mode.HOLD
        last = stand.setpoints()[-1].message
    assert flown.cause is Cause.STATE_LOST
    assert (last.vx, last.vy, last.vz) == (0.0, 0.0, 0.0), "the one setpoint without a state stops it"
