"""The phases step by step, without link and vehicle: what is asked of the autopilot, and when nothing is."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from companion.config import build_flight
from companion.flight.health import EstimatorFlag, EstimatorHealth, SystemHealth
from companion.flight.phases import Autopilot, Cause, FlightEnded, LandedState, Phase
from companion.flight.sequence import Duty, Sequence
from companion.link import codec, modes
from companion.link.operations import Operation, Result
from companion.link.statustext import StatusTexts
from companion.link.telemetry import VehicleState
from companion.link.version import AutopilotVersion
from companion.trajectory.anchored import Trajectory
from companion.trajectory.load import of_flight

PARAMETERS = {"COM_OBL_RC_ACT": 5, "COM_OF_LOSS_T": 1.0, "NAV_RCL_ACT": 2, "MAV_TYPE": 2, "THR_MDL_FAC": 0.0}
RATE_HZ = 250.0


class FakeOperations:
    """Takes the requests; the test decides how they end."""

    def __init__(self) -> None:
        self.texts = StatusTexts()
        self.version = AutopilotVersion((1, 18, 0), 255, 0, 0)
        self.asked: list[Operation] = []
        self.at_once = True
        """Whether requests are accepted at once."""

    def _ask(self, what: str, now_s: float, value: float | None = None) -> Operation:
        operation = Operation(what, now_s, self.texts)
        operation.value = value
        if self.at_once:
            operation.end(Result.ACCEPTED, now_s)
        self.asked.append(operation)
        return operation

    def set_mode(self, mode: modes.Mode, now_s: float, retry: Any = None) -> Operation:
        return self._ask(f"changing to {mode.label}", now_s)

    def arm(self, now_s: float) -> Operation:
        return self._ask("arming", now_s)

    def takeoff(self, altitude_amsl_m: float | None, now_s: float) -> Operation:
        return self._ask("take-off", now_s, altitude_amsl_m)

    def land(self, now_s: float) -> Operation:
        return self._ask("landing", now_s)

    def set_message_interval(self, msgid: int, interval_us: int, now_s: float) -> Operation:
        return self._ask(f"rate of {msgid}", now_s)

    def request_message(self, msgid: int, now_s: float) -> Operation:
        return self._ask(f"message {msgid}", now_s)

    def read_parameter(self, name: str, now_s: float, retry: Any = None) -> Operation:
        return self._ask(f"reading {name}", now_s, PARAMETERS.get(name))

    def drop_moving(self, now_s: float) -> None:
        for operation in self.asked:
            if operation.pending:
                operation.end(Result.SUPERSEDED, now_s)

    def ask_time(self, own_ns: int) -> None:
        """Nobody answers here."""

    def update(self, now_s: float) -> None:
        """Nothing is repeated here."""

    def since(self, count: int) -> list[str]:
        return [operation.what for operation in self.asked[count:]]


class Script:
    """A sequence with its surroundings, past the preflight checks."""

    def __init__(
        self,
        *,
        landed: LandedState = LandedState.IN_AIR,
        armed: bool = True,
        after: str = "hold",
        duration_s: float = 1.0,
        limits: dict[str, float] | None = None,
        trajectory: Trajectory | None = None,
    ) -> None:
        hover = {"point_m": [0.0, 0.0, 0.0]}
        over_a_point = {"name": "hover", "shape": "hover", "duration_s": duration_s, "hover": hover}
        data = {"name": "test", "vehicle": "paper", "trajectory": over_a_point, "after": after, "limits": limits or {}}
        self.flight = flight = build_flight(data, "test")
        self.ops = FakeOperations()
        self.autopilot = Autopilot(modes.HOLD, modes.HOLD, armed, landed, system_status=4)
        self.autopilot.health = SystemHealth(sticks=False, fence_kept=None, can_arm=True, battery=1.0)
        self.autopilot.estimator = EstimatorHealth(EstimatorFlag(63), 0.0, 0.0, 0.0, 0.0, 0.1)
        self.autopilot.home, self.autopilot.home_amsl_m = (0.0, 0.0, 0.0), 488.0
        self.engaged: list[VehicleState] = []
        self.speed = 0.0
        self.lines: list[str] = []
        self.sequence = Sequence(
            *(flight, trajectory or of_flight(flight), self.ops, self.autopilot),  # type: ignore[arg-type]
            self.engaged.append,
            self.lines.append,
        )
        self.now_s = 10.0
        self.sequence.enter(Phase.PREFLIGHT, self.now_s, "the test begins")

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * RATE_HZ)):
            self.now_s += 1.0 / RATE_HZ
            t_us = round(self.now_s * 1e6)
            state = VehicleState(t_us, (0.0, 0.0, -5.0), (self.speed, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0,) * 3, 0)
            self.sequence.preflight.meter.on_state(state, self.now_s, paced=False)
            self.sequence.on_state(state, self.now_s)
            self.sequence.tick(self.now_s)

    def until(self, condition: Callable[[], bool], seconds: float = 20.0) -> None:
        end_s = self.now_s + seconds
        while not condition():
            assert self.now_s < end_s
            self.run(1.0 / RATE_HZ)

    def ends(self, seconds: float = 200.0) -> FlightEnded:
        with pytest.raises(FlightEnded) as ended:
            self.run(seconds)
        return ended.value

    def be(self, mode: modes.Mode) -> None:
        self.autopilot.mode = self.autopilot.intended = mode

    def to_stream(self) -> None:
        self.until(lambda: self.sequence.duty is Duty.STREAM)

    def to_track(self) -> None:
        self.to_stream()
        self.until(lambda: self.ops.asked[-1].what == "changing to Offboard")
        self.be(modes.OFFBOARD)
        self.until(lambda: self.sequence.duty is Duty.TRACK)


def test_setpoints_are_streamed_before_offboard_is_asked_for() -> None:
    script = Script()
    script.to_stream()
    begun_s = script.now_s
    script.until(lambda: script.ops.asked[-1].what == "changing to Offboard")
    assert script.now_s - begun_s == pytest.approx(1.0, abs=0.01)
    assert script.engaged == []
    script.be(modes.OFFBOARD)
    script.run(0.01)
    assert len(script.engaged) == 1


def test_mode_other_than_hold_is_left_first() -> None:
    script = Script()
    script.be(modes.POSITION)
    script.until(lambda: script.sequence.phase is Phase.JOIN)
    asked = len(script.ops.asked)
    assert script.ops.asked[-1].what == "changing to Hold"
    script.run(1.0)
    assert script.sequence.duty is Duty.NOTHING
    script.be(modes.HOLD)
    script.run(0.01)
    assert script.sequence.duty is Duty.STREAM
    assert script.ops.since(asked) == []


def test_vehicle_that_does_not_hold_still_is_refused() -> None:
    script = Script()
    script.speed = 3.0
    script.until(lambda: script.sequence.ending is not None, 40.0)
    assert script.ends().cause is Cause.REFUSED
    assert script.engaged == []


def test_autopilot_that_does_not_say_whether_it_flies_is_refused() -> None:
    ended = Script(landed=LandedState.UNDEFINED).ends()
    assert ended.cause is Cause.REFUSED
    assert "does not say" in ended.detail


def test_pilot_takes_over_before_offboard() -> None:
    """Then OFFBOARD is never asked for."""
    script = Script()
    script.to_stream()
    script.run(0.5)
    asked = len(script.ops.asked)
    script.be(modes.POSITION)
    ended = script.ends()
    assert (ended.cause, script.sequence.duty) == (Cause.TAKEN_OVER, Duty.NOTHING)
    assert script.ops.since(asked) == []
    assert not script.sequence.owes_hold


def test_takeoff_in_its_order_and_pilot_takes_over_during_it() -> None:
    script = Script(landed=LandedState.ON_GROUND, armed=False)
    script.until(lambda: script.sequence.phase is Phase.TAKEOFF)
    asked = len(script.ops.asked)
    script.run(0.1)
    assert script.ops.since(asked) == ["take-off", "arming"]
    assert script.ops.asked[asked].value == pytest.approx(488.0 + 5.0 + 5.0)  # 5 m above where it is: 5 m above home
    script.autopilot.armed = True
    script.be(modes.TAKEOFF)
    script.run(1.0)
    script.be(modes.POSITION)
    ended = script.ends()
    assert (ended.cause, script.sequence.owes_hold) == (Cause.TAKEN_OVER, False)
    assert len(script.ops.since(asked)) == 2


def test_hold_after_takeoff_must_last() -> None:
    script = Script(landed=LandedState.ON_GROUND, armed=True)
    script.until(lambda: script.sequence.phase is Phase.TAKEOFF)
    script.be(modes.TAKEOFF)
    script.run(3.0)
    script.be(modes.HOLD)
    script.autopilot.landed = LandedState.IN_AIR
    script.speed = 0.5
    script.run(3.0)
    assert script.sequence.phase is Phase.TAKEOFF
    script.speed = 0.1
    begun_s = script.now_s
    script.until(lambda: script.sequence.phase is Phase.JOIN)
    assert script.now_s - begun_s == pytest.approx(1.0, abs=0.02)


def test_refusal_waits_for_the_autopilots_words() -> None:
    script = Script(landed=LandedState.ON_GROUND, armed=False)
    script.until(lambda: script.sequence.phase is Phase.TAKEOFF)
    script.ops.at_once = False
    script.run(0.02)
    script.ops.asked[-1].end(Result.ACCEPTED, script.now_s)  # the take-off
    script.run(0.02)
    assert script.ops.asked[-1].what == "arming"
    script.ops.asked[-1].end(Result.TEMPORARILY_REJECTED, script.now_s)
    script.run(0.1)
    assert script.sequence.ending is None
    script.ops.texts.add(codec.StatusText(2, b"Arming denied: high wind", True, 0, 0), script.now_s)
    script.ops.at_once = True
    ended = script.ends()
    assert ended.cause is Cause.REFUSED
    assert "Arming denied: high wind" in ended.detail
    assert script.ops.asked[-1].what == "changing to Hold"  # the take-off mode does not stay selected


def landing() -> Script:
    script = Script(after="land")
    script.to_track()
    script.until(lambda: script.sequence.phase is Phase.LAND)
    script.run(0.1)
    assert script.ops.asked[-1].what == "landing"
    assert script.sequence.duty is Duty.NOTHING
    script.be(modes.LAND)
    script.run(1.0)
    return script


def test_landing_ends_on_the_ground() -> None:
    script = landing()
    script.autopilot.landed = LandedState.ON_GROUND
    script.run(1.0)
    script.autopilot.armed = False
    ended = script.ends()
    assert (ended.cause, ended.detail) == (Cause.COMPLETED, "landed and disarmed")


def test_landing_whose_acknowledgement_is_lost_is_known_by_the_mode() -> None:
    script = Script(after="land", duration_s=0.5)
    script.to_track()
    script.ops.at_once = False
    script.until(lambda: script.ops.asked[-1].what == "landing")
    script.run(0.1)
    assert script.sequence.duty is Duty.TRACK, "nothing says yet that the autopilot has taken over"
    script.be(modes.LAND)
    script.run(0.01)
    assert script.sequence.duty is Duty.NOTHING
    script.autopilot.landed, script.autopilot.armed = LandedState.ON_GROUND, False
    assert script.ends().cause is Cause.COMPLETED


def test_px4_goes_back_to_offboard_on_the_ground_before_it_says_disarmed() -> None:
    script = landing()
    script.autopilot.landed = LandedState.ON_GROUND
    script.run(0.5)
    script.be(modes.OFFBOARD)
    script.run(0.9)
    script.autopilot.armed = False
    assert script.ends().cause is Cause.COMPLETED


def test_pilot_takes_over_during_the_landing() -> None:
    script = landing()
    asked = len(script.ops.asked)
    script.be(modes.POSITION)
    assert script.ends().cause is Cause.TAKEN_OVER
    assert script.ops.since(asked) == []


def test_landing_is_interrupted_to_hold() -> None:
    script = landing()
    script.sequence.interrupt(script.now_s)
    script.run(0.01)
    assert script.ops.asked[-1].what == "changing to Hold"
    script.be(modes.HOLD)
    assert script.ends().cause is Cause.INTERRUPTED


def test_interrupt_after_touchdown_leaves_the_autopilot_alone() -> None:
    script = landing()
    script.autopilot.landed = LandedState.ON_GROUND
    asked = len(script.ops.asked)
    with pytest.raises(FlightEnded) as ended:
        script.sequence.interrupt(script.now_s)
    assert ended.value.cause is Cause.INTERRUPTED
    assert script.ops.since(asked) == []


def test_the_first_cause_stays_and_setpoints_go_on_until_hold_is_acknowledged() -> None:
    script = Script()
    script.to_track()
    script.ops.at_once = False
    script.sequence.end(Cause.POSITION_ERROR, "9 m", script.now_s)
    script.sequence.end(Cause.TILT, "2 rad", script.now_s)
    script.run(0.25)
    assert script.sequence.duty is Duty.TRACK
    assert script.ops.since(-3) == ["changing to Hold"] * 3
    script.ops.asked[-1].end(Result.ACCEPTED, script.now_s)
    script.run(0.01)
    assert script.sequence.duty is Duty.NOTHING
    assert not script.sequence.owes_hold
    script.be(modes.HOLD)
    ended = script.ends()
    assert (ended.cause, ended.detail) == (Cause.POSITION_ERROR, "9 m; the vehicle is in Hold")


def test_hand_over_that_is_not_acknowledged_ends() -> None:
    script = Script()
    script.to_track()
    script.ops.at_once = False
    script.sequence.duty = Duty.NOTHING
    script.sequence.end(Cause.STATE_LOST, "", script.now_s)
    begun_s, asked = script.now_s, len(script.ops.asked)
    ended = script.ends()
    assert ended.cause is Cause.STATE_LOST
    assert ended.detail == "Hold was not acknowledged, the autopilot's own failsafe acts"
    assert script.now_s - begun_s == pytest.approx(3.0, abs=0.02)
    assert len(script.ops.since(asked)) in {30, 31}


# -- other hands before the setpoints


def test_pilot_takes_the_vehicle_back_while_the_course_is_planned() -> None:
    """Hold was seen: no mode that comes after it is asked to be left again."""
    script = Script()
    script.be(modes.POSITION)
    script.until(lambda: script.sequence.phase is Phase.JOIN)
    script.speed = 2.0  # still braking: nothing is planned
    script.be(modes.HOLD)
    script.run(0.5)
    asked = len(script.ops.asked)
    script.be(modes.POSITION)
    ended = script.ends()
    assert (ended.cause, script.sequence.owes_hold) == (Cause.TAKEN_OVER, False)
    assert script.ops.since(asked) == []


def test_another_mode_than_the_one_that_it_was_found_in_is_another_hands() -> None:
    script = Script()
    script.be(modes.POSITION)
    script.until(lambda: script.sequence.phase is Phase.JOIN)
    asked = len(script.ops.asked)
    script.be(modes.RETURN)
    assert script.ends().cause is Cause.TAKEN_OVER
    assert script.ops.since(asked) == []


@pytest.mark.parametrize("waits_s", [0.0, 0.1])
def test_ctrl_c_just_when_the_pilot_has_taken_over_leaves_the_vehicle_to_the_pilot(waits_s: float) -> None:
    script = Script()
    script.to_track()
    asked = len(script.ops.asked)
    script.autopilot.mode = modes.POSITION
    script.run(waits_s)
    script.sequence.interrupt(script.now_s)
    assert "by another hand" in script.ends().detail
    assert script.ops.since(asked) == []
    assert not script.sequence.owes_hold


# -- requests that were replaced


def test_what_a_landing_replaces_is_asked_for_no_more() -> None:
    script = Script()
    script.ops.at_once = True
    script.to_stream()
    script.ops.at_once = False
    script.until(lambda: script.ops.asked[-1].what == "changing to Offboard")
    offboard = script.ops.asked[-1]
    script.sequence.land_from_here(script.now_s)
    assert offboard.result is Result.SUPERSEDED
    script.run(0.01)
    assert script.ops.asked[-1].what == "landing" and script.ops.asked[-1].pending


def test_an_end_asks_for_arming_no_more() -> None:
    script = Script(landed=LandedState.ON_GROUND, armed=False)
    script.until(lambda: script.sequence.phase is Phase.TAKEOFF)
    script.ops.at_once = False
    script.run(0.01)
    script.ops.asked[-1].end(Result.ACCEPTED, script.now_s)
    script.run(0.01)
    arming = script.ops.asked[-1]
    script.sequence.interrupt(script.now_s)
    assert (arming.what, arming.result) == ("arming", Result.SUPERSEDED)


# -- take-off and landing by the clock


def test_arming_that_was_acknowledged_late_is_given_its_heartbeats() -> None:
    script = Script(landed=LandedState.ON_GROUND, armed=False)
    script.until(lambda: script.sequence.phase is Phase.TAKEOFF)
    script.ops.at_once = False
    for acknowledged_s in (1.1, 1.7):
        script.run(acknowledged_s)
        script.ops.asked[-1].end(Result.ACCEPTED, script.now_s)
    script.be(modes.TAKEOFF)
    script.run(3.4)
    assert script.sequence.ending is None
    script.run(0.2)
    assert script.sequence.ending == (Cause.REFUSED, "the autopilot disarmed before it took off")


def test_a_high_take_off_may_last_longer() -> None:
    script = Script(landed=LandedState.ON_GROUND, armed=True)
    script.sequence._flight = script.sequence._flight.model_copy(update={"takeoff_altitude_m": 100.0})
    script.until(lambda: script.sequence.phase is Phase.TAKEOFF)
    script.be(modes.TAKEOFF)
    script.autopilot.landed = LandedState.IN_AIR
    script.speed = 1.5
    script.run(159.0)
    assert script.sequence.ending is None
    script.run(2.0)
    assert script.sequence.ending is not None
    assert "within 160 s" in script.sequence.ending[1]


def test_landing_as_the_take_off_ends_by_itself() -> None:
    script = Script(landed=LandedState.ON_GROUND, armed=False)
    script.until(lambda: script.sequence.phase is Phase.TAKEOFF)
    script.autopilot.armed, script.autopilot.landed = True, LandedState.IN_AIR
    script.be(modes.TAKEOFF)
    script.run(1.0)
    script.ops.at_once = False
    script.sequence.land_from_here(script.now_s)
    script.run(0.02)
    script.be(modes.HOLD)
    script.run(1.0)
    assert script.sequence.phase is Phase.LAND
    script.ops.asked[-1].end(Result.ACCEPTED, script.now_s)
    script.be(modes.LAND)
    script.run(1.0)
    script.autopilot.armed, script.autopilot.landed = False, LandedState.ON_GROUND
    script.run(0.1)
    assert script.ends().detail == "landed and disarmed"
