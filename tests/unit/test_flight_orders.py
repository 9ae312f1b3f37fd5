"""An operator's orders in every phase of a flight: what is done, what is refused, and how it ends."""

from __future__ import annotations

import pytest
from test_flight_sequence import Script

from companion.flight.phases import Cause, LandedState, Order, Phase
from companion.flight.sequence import Duty
from companion.link import modes


def on_course(hover_s: float = 30.0) -> Script:
    """A flight over a point that tracks."""
    script = Script(duration_s=hover_s)
    script.to_track()
    script.run(1.0)
    script.until(lambda: script.sequence.phase is Phase.TRACK)
    return script


def give(script: Script, order: Order) -> str:
    refusal = script.sequence.orders.give(order)
    script.run(0.01)
    return refusal


def test_pause_and_resume() -> None:
    script = on_course()
    assert give(script, Order.PAUSE) == ""
    assert script.sequence.phase is Phase.PAUSE
    assert not script.sequence.orders.resting
    script.run(5.0)
    assert script.sequence.orders.resting
    assert script.sequence.duty is Duty.TRACK
    track_s = script.sequence.track_time_s(script.now_s)
    script.run(5.0)
    assert script.sequence.track_time_s(script.now_s) == pytest.approx(track_s)
    assert give(script, Order.RESUME) == ""
    script.until(lambda: script.sequence.phase is Phase.TRACK)
    assert [change.name for change in script.sequence.changes][-3:] == ["track", "pause", "track"]
    script.run(1.0)
    assert script.sequence.track_time_s(script.now_s) > track_s + 1.0


def test_orders_given_twice_are_given_once() -> None:
    script = on_course()
    for order in (Order.PAUSE, Order.RESUME):
        assert give(script, order) == ""
        assert give(script, order) == ""
        script.run(5.0)
    names = [change.name for change in script.sequence.changes]
    assert (names.count("pause"), names[-1]) == (1, "track")
    assert script.sequence.course is not None
    assert len(script.sequence.course.ramps) == 2


def test_resume_while_slowing_down_and_pause_while_getting_faster() -> None:
    script = on_course()
    give(script, Order.PAUSE)
    script.run(1.2)
    give(script, Order.RESUME)
    script.run(1.0)
    give(script, Order.PAUSE)
    script.until(lambda: script.sequence.orders.resting)
    assert script.sequence.course is not None
    assert [ramp.rate for ramp in script.sequence.course.ramps] == [0.0, 1.0, 0.0]


def test_stop_ends_in_hold() -> None:
    script = on_course()
    assert give(script, Order.STOP) == ""
    assert script.sequence.phase is Phase.HOLD
    script.run(2.0)  # still slowing down
    assert script.sequence.ending is None
    script.until(lambda: script.sequence.ending is not None)
    script.run(0.01)
    assert script.ops.asked[-1].what == "changing to Hold"
    script.be(modes.HOLD)
    ended = script.ends()
    assert (ended.cause, ended.cause.value.exit_code) == (Cause.STOPPED, 0)
    assert script.sequence.orders.give(Order.STOP) == ""
    assert script.sequence.orders.give(Order.LAND) == "the flight is ending"


def test_land_out_of_a_pause() -> None:
    script = on_course()
    give(script, Order.PAUSE)
    script.run(5.0)
    assert give(script, Order.LAND) == ""
    assert "coming to its end" in give(script, Order.RESUME)
    script.until(lambda: script.sequence.phase is Phase.LAND)
    script.run(0.1)
    assert script.ops.asked[-1].what == "landing"
    script.be(modes.LAND)
    script.run(1.0)
    script.autopilot.armed, script.autopilot.landed = False, LandedState.ON_GROUND
    ended = script.ends()
    assert (ended.cause, ended.detail) == (Cause.STOPPED, "landed and disarmed")


@pytest.mark.parametrize("order", [Order.PAUSE, Order.RESUME])
def test_nothing_to_pause_before_and_after_the_course(order: Order) -> None:
    script = Script()
    assert give(script, order) == f"there is nothing to {order.value} in the phase preflight"
    script.to_stream()
    assert give(script, order) == f"there is nothing to {order.value} in the phase join"
    script.to_track()
    script.until(lambda: script.sequence.phase is Phase.HOLD)
    assert give(script, order) == f"there is nothing to {order.value} in the phase hold"


def test_resume_without_a_pause() -> None:
    assert give(on_course(), Order.RESUME) == "the flight is not paused"


def test_stop_before_anything_was_asked_for() -> None:
    script = Script()
    script.sequence.orders.give(Order.STOP)
    ended = script.ends(0.1)
    assert (ended.cause, script.sequence.owes_hold) == (Cause.STOPPED, False)


def test_stop_while_streaming_asks_for_hold() -> None:
    script = Script()
    script.to_stream()
    give(script, Order.STOP)
    assert (script.sequence.duty, script.sequence.ending) == (Duty.NOTHING, (Cause.STOPPED, ""))
    assert script.ops.asked[-1].what == "changing to Hold"
    assert script.engaged == []


def test_land_during_takeoff() -> None:
    script = Script(landed=LandedState.ON_GROUND, armed=False)
    script.until(lambda: script.sequence.phase is Phase.TAKEOFF)
    script.autopilot.armed, script.autopilot.landed = True, LandedState.TAKEOFF
    script.be(modes.TAKEOFF)
    script.run(2.0)
    assert give(script, Order.LAND) == ""
    assert script.sequence.phase is Phase.LAND
    assert script.ops.asked[-1].what == "landing"
    script.run(1.0)
    assert script.sequence.duty is Duty.NOTHING
    script.be(modes.LAND)
    script.run(1.0)
    script.autopilot.armed, script.autopilot.landed = False, LandedState.ON_GROUND
    assert script.ends().cause is Cause.STOPPED


def test_stop_and_land_on_the_ground_end_at_once() -> None:
    for order in (Order.STOP, Order.LAND):
        script = Script(landed=LandedState.ON_GROUND, armed=False)
        script.run(0.1)
        script.sequence.orders.give(order)
        ended = script.ends(0.1)
        assert (ended.cause, ended.detail) == (Cause.STOPPED, "the vehicle is on the ground")


@pytest.mark.parametrize("order", [Order.STOP, Order.LAND])
def test_once_arming_was_asked_for_the_ground_is_no_end(order: Order) -> None:
    """HEARTBEAT, which says armed, may be a second away: the autopilot is asked for Hold, or to land."""
    script = Script(landed=LandedState.ON_GROUND, armed=False)
    script.until(lambda: script.sequence.phase is Phase.TAKEOFF)
    script.run(0.1)
    assert script.ops.asked[-1].what == "arming"
    script.be(modes.TAKEOFF)
    assert give(script, order) == ""
    script.run(0.1)
    assert script.ops.asked[-1].what == {Order.STOP: "changing to Hold", Order.LAND: "landing"}[order]
    if order is Order.STOP:
        script.be(modes.HOLD)
        assert script.ends(0.1).detail == "the vehicle is in Hold"
        return
    script.be(modes.LAND)
    script.run(0.5)
    script.autopilot.armed = True  # as the next HEARTBEAT says
    script.run(5.0)
    assert script.sequence.phase is Phase.LAND
    script.autopilot.armed = False
    assert script.ends(0.1).detail == "landed and disarmed"


def test_another_hand_during_a_pause_ends_the_flight() -> None:
    script = on_course()
    give(script, Order.PAUSE)
    script.run(5.0)
    script.be(modes.POSITION)
    assert script.ends().cause is Cause.TAKEN_OVER
