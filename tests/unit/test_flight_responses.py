"""The ladder of responses on a scripted vehicle: slower, to rest, Hold, Land where Hold is refused, silence."""

from __future__ import annotations

import pytest
from test_flight_orders import on_course
from test_flight_sequence import Script

from companion.config import build_flight
from companion.control import flat
from companion.control.output import RateSetpoint
from companion.flight.controller import controller_of
from companion.flight.course import Course
from companion.flight.engines import kernels
from companion.flight.guards import Finding, Guard, Response
from companion.flight.phases import Autopilot, Cause, LandedState, Order, Phase
from companion.flight.responses import respond
from companion.flight.sequence import Duty
from companion.flight.tracker import TrackerStep
from companion.flight.watch import Seen, Watch
from companion.link import modes
from companion.link.codec import Timesync
from companion.link.operations import Result
from companion.link.telemetry import VehicleState
from companion.trajectory.load import of_flight


def find(script: Script, guard: Guard | None, response: Response) -> None:
    respond(script.sequence, Finding(guard, response, "figures"), script.now_s)


def pace(script: Script) -> float:
    course, sequence = script.sequence.course, script.sequence
    assert course is not None
    t_s = sequence.stamp_s - sequence.engaged_at_s
    return (course.course_s(t_s + 1e-3) - course.course_s(t_s)) / 1e-3


def test_slower_and_back() -> None:
    script = on_course()
    find(script, Guard.THRUST, Response.SLOW)
    script.run(4.0)
    assert pace(script) == pytest.approx(0.5, abs=1e-6)
    assert script.sequence.phase is Phase.TRACK
    assert any("slows down to 50%" in line for line in script.lines)
    find(script, Guard.RATES, Response.SLOW)  # it is slow already
    find(script, None, Response.RESUME)
    script.run(4.0)
    assert pace(script) == pytest.approx(1.0, abs=1e-6)
    assert sum("the reference" in line for line in script.lines) == 2


def test_a_pause_goes_before_and_going_on_is_as_slow_as_it_must_be() -> None:
    script = on_course()
    assert script.sequence.orders.give(Order.PAUSE) == ""
    script.run(4.0)
    find(script, Guard.THRUST, Response.SLOW)
    script.run(3.0)
    assert pace(script) == pytest.approx(0.0, abs=1e-9)
    assert script.sequence.orders.give(Order.RESUME) == ""
    script.run(4.0)
    assert pace(script) == pytest.approx(0.5, abs=1e-6)
    assert script.sequence.phase is Phase.TRACK


def test_a_flight_that_is_slowed_down_to_its_end_rests_before_it_hands_over() -> None:
    script = on_course(6.0)
    find(script, Guard.THRUST, Response.SLOW)
    script.until(lambda: script.sequence.phase is Phase.HOLD)
    script.until(lambda: script.sequence.ending is not None)
    course = script.sequence.course
    assert course is not None
    t_s = script.sequence.stamp_s - script.sequence.engaged_at_s
    assert course.course_s(t_s) >= course.duration_s
    assert script.sequence.ending == (Cause.COMPLETED, "")


def test_to_rest_and_then_hold() -> None:
    script = on_course()
    find(script, Guard.LYAPUNOV, Response.REST)
    assert script.sequence.phase is Phase.HOLD
    assert script.sequence.duty is Duty.TRACK
    find(script, Guard.BATTERY, Response.REST)  # the first cause stays
    script.until(lambda: script.sequence.ending is not None)
    assert pace(script) == pytest.approx(0.0, abs=1e-9)
    script.be(modes.HOLD)
    ended = script.ends()
    assert (ended.cause, ended.detail) == (Cause.LYAPUNOV, "figures; the vehicle is in Hold")


def test_a_harder_response_does_not_wait_for_the_rest() -> None:
    script = on_course()
    find(script, Guard.LYAPUNOV, Response.REST)
    script.run(0.1)
    find(script, Guard.TILT, Response.HOLD)
    assert script.sequence.ending == (Cause.TILT, "figures")
    script.run(0.01)
    assert script.ops.asked[-1].what == "changing to Hold"
    find(script, Guard.BATTERY_CRITICAL, Response.LAND)  # the hand-over goes on as it is
    script.run(0.2)
    assert script.ops.asked[-1].what == "changing to Hold"


def test_an_operator_who_wants_to_land_gets_that() -> None:
    script = on_course()
    find(script, Guard.LYAPUNOV, Response.REST)
    assert script.sequence.orders.give(Order.LAND) == ""
    script.until(lambda: script.sequence.phase is Phase.LAND)
    script.run(0.1)
    assert script.ops.asked[-1].what == "landing"


def test_land_at_once() -> None:
    script = on_course()
    find(script, Guard.BATTERY_CRITICAL, Response.LAND)
    script.run(0.01)
    assert script.ops.asked[-1].what == "changing to Land"
    script.be(modes.LAND)
    ended = script.ends()
    assert (ended.cause, ended.detail) == (Cause.BATTERY, "figures; the vehicle is in Land")


@pytest.mark.parametrize(
    ("action", "rungs"), [(5.0, ["Hold", "Land"]), (3.0, ["Hold", "Return", "Land"])], ids=["hold", "return"]
)
def test_where_hold_is_refused_the_next_rung_is_asked_for_and_then_nothing(action: float, rungs: list[str]) -> None:
    """Return is a rung where the autopilot's owner wants it when setpoints cease (COM_OBL_RC_ACT 3)."""
    script = on_course()
    script.autopilot.parameters["COM_OBL_RC_ACT"] = action
    script.ops.at_once = False
    begun_s, before = script.now_s, len(script.ops.asked)
    find(script, Guard.ESTIMATOR, Response.HOLD)
    for _ in range(300):
        script.run(0.02)
        for operation in script.ops.asked:
            operation.end(Result.TEMPORARILY_REJECTED, script.now_s)
        if script.sequence.duty is Duty.NOTHING or script.now_s - begun_s > 1.5:
            break
    asked = script.ops.since(before)
    for index, rung in enumerate(rungs[:-1]):
        assert asked[3 * index : 3 * index + 3] == [f"changing to {rung}"] * 3
        said = f"changing to {rung} was rejected for now; asking for {rungs[index + 1]}"
        assert any(said in line for line in script.lines)
    assert set(asked[3 * len(rungs) - 3 :]) == {"changing to Land"}
    ended = script.ends()
    assert ended.cause is Cause.ESTIMATOR
    assert ended.detail.endswith("Land was not acknowledged, the autopilot's own failsafe acts")
    assert script.sequence.duty is Duty.NOTHING


def test_return_that_is_taken_ends_the_flight() -> None:
    script = on_course()
    script.autopilot.parameters["COM_OBL_RC_ACT"] = 3.0
    script.ops.at_once = False
    find(script, Guard.ESTIMATOR, Response.HOLD)
    for _ in range(200):
        script.run(0.02)
        returns = [operation for operation in script.ops.asked if operation.what == "changing to Return"]
        if returns:
            returns[0].end(Result.ACCEPTED, script.now_s)
            break
        for operation in script.ops.asked:
            operation.end(Result.TEMPORARILY_REJECTED, script.now_s)
    script.be(modes.RETURN)
    ended = script.ends()
    assert (ended.cause, ended.detail) == (Cause.ESTIMATOR, "figures; the vehicle is in Return")
    assert script.sequence.duty is Duty.NOTHING


def test_a_failsafe_is_told_from_another_hand() -> None:
    """CURRENT_MODE says what is meant; it may come after HEARTBEAT, and no setpoint waits for it."""
    for meant, cause in ((modes.OFFBOARD, Cause.FAILSAFE), (modes.RETURN, Cause.TAKEN_OVER)):
        script = on_course()
        asked = len(script.ops.asked)
        script.autopilot.mode = modes.RETURN
        script.run(0.01)
        assert script.sequence.duty is Duty.NOTHING
        script.autopilot.intended = meant
        assert script.ends(1.0).cause is cause
        assert script.ops.since(asked) == []


def test_a_failsafe_that_clears_itself_does_not_bring_the_flight_back() -> None:
    script = on_course()
    script.autopilot.mode = modes.RETURN
    script.run(0.1)
    script.autopilot.mode = modes.OFFBOARD
    script.run(0.1)
    assert script.sequence.duty is Duty.NOTHING
    assert script.ends(1.0).cause is Cause.FAILSAFE


def test_no_setpoint_for_a_vehicle_that_was_disarmed() -> None:
    script = on_course()
    script.autopilot.armed = False
    ended = script.ends(0.1)
    assert ended.cause is Cause.DISARMED
    assert script.sequence.duty is Duty.NOTHING


def test_nothing_comes_to_rest_in_a_landing() -> None:
    script = Script(after="land")
    script.to_track()
    script.until(lambda: script.sequence.phase is Phase.LAND)
    find(script, Guard.LYAPUNOV, Response.REST)
    assert script.sequence.ending is None
    assert script.autopilot.landed is LandedState.IN_AIR


# What the wall clock alone knows is not in lockstep's tests


class Flying:
    """The watch of a hover at real time."""

    def __init__(self) -> None:
        hover = {"name": "hover", "shape": "hover", "duration_s": 5.0, "hover": {"point_m": [0.0, 0.0, 0.0]}}
        flight = build_flight({"name": "test", "vehicle": "bundled", "trajectory": hover}, "test")
        self.watch = Watch(flight, controller_of(flight, kernels("python")), Autopilot(), lambda line: None)
        self.course = Course(of_flight(flight), flight.vehicle, (0.0, 0.0, -5.0), 0.0, None)
        self.now_s = 10.0

    def step(self, *, late: bool = False, paced: bool = False, age_s: float | None = None) -> Finding | None:
        self.now_s += 0.004
        level = (1.0, 0.0, 0.0, 0.0)
        state = VehicleState(round(1e6 * self.now_s), (0.0, 0.0, -5.0), (0.0,) * 3, level, (0.0,) * 3, 0)
        out = TrackerStep(RateSetpoint(0.5, (0.0, 0.0, 0.0)), (0.0,) * flat.RESULTS)
        seen = Seen(state, (0.0, 0.0, 0.0), out, 0, late, age_s, 0, paced)
        return self.watch.on_step(seen, self.course, self.now_s)

    def steps(self, count: int, late_every: int = 0, **how: bool) -> list[Finding]:
        found = [self.step(late=bool(late_every) and i % late_every == 0, **how) for i in range(count)]
        return [finding for finding in found if finding is not None]


def test_late_steps() -> None:
    flying = Flying()
    assert flying.steps(2000, 4) == []
    found = flying.steps(2000, 2)
    assert [f.guard for f in found] == [Guard.LATE_STEPS] * 2
    assert [f.response for f in found] == [Response.SLOW, Response.REST]
    assert Flying().steps(2000, 2, paced=True) == []


def test_an_autopilot_that_does_not_answer_any_more() -> None:
    flying, ns = Flying(), 0
    for i in range(60):
        ns = 100_000_000 * (i + 1)
        assert flying.watch.asks_time(ns)
        assert not flying.watch.asks_time(ns + 50_000_000)
        if i < 20:
            assert flying.watch.offset.on_answer(Timesync(ns + 7, ns, 1, 191), ns + 2_000_000)
        found = flying.steps(25)
        if found:
            break
    assert [f.guard for f in found] == [Guard.LINK]
    assert found[0].response is Response.HOLD
    assert 2.0 < 1e-9 * ns - 2.0 < 2.2
    # One that never answered is not missed.
    never = Flying()
    for i in range(60):
        never.watch.asks_time(100_000_000 * (i + 1))
        assert never.steps(25) == []


def test_states_are_aged_by_the_offset() -> None:
    flying = Flying()
    assert flying.watch.age_s(1_000_000, 5) is None
    flying.watch.asks_time(200_000_000)
    flying.watch.offset.on_answer(Timesync(200_000_000 + 1_000_000 + 3_000_000_000, 200_000_000, 1, 191), 202_000_000)
    # The vehicle's clock is 3 s ahead of ours: a state of 3.300 s that comes at 0.320 s is 20 ms old.
    assert flying.watch.age_s(3_300_000, 320_000_000) == pytest.approx(0.020)
