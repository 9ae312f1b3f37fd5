"""New parameters in flight: the way there is smooth, sound at every point, the same in both engines, and ends there."""

import itertools
import json
import math
import random
from dataclasses import asdict

import pytest

from companion.campaign import simulate
from companion.config import Acceptance, build_flight, load_vehicle
from companion.control import flat
from companion.control.types import State
from companion.control.vectors import quat_normalise
from companion.errors import InputError, RefusedError
from companion.flight.adaptation import Adaptation
from companion.flight.course import Course, at_rest
from companion.flight.engines import kernels
from companion.flight.loop import FlightLoop
from companion.flight.phases import Engagement, Phase
from companion.flight.preflight import gate_gains
from companion.flight.retuning import POINTS, ParameterChange, Retuning, Transition, between, flown, points, unsound
from companion.flight.tracker import Tracker
from companion.record.flight_record import FlightRecord
from companion.trajectory.load import load, of_flight

ZERO = (0.0, 0.0, 0.0)
LEVEL = (1.0, 0.0, 0.0, 0.0)
STIFFER = {"k1_1_s": 2.2, "k2": 3.2, "k3_1_s": 3.5, "gamma_1_s3": 5.0, "position_error_max_m": 0.9}


def hover(tracker, steps=1, begin=0, dt=0.004, state=None):
    """Some steps at rest; gives their numbers."""
    state = State(ZERO, ZERO, LEVEL, ZERO) if state is None else state
    return [tracker.step(1.0 + (begin + i) * dt, state, lambda t: at_rest(ZERO, 0.3)).numbers for i in range(steps)]


def begun(vehicle, engine="python"):
    tracker = Tracker(vehicle, "rates", kernels(engine))
    tracker.begin(State(ZERO, ZERO, LEVEL, ZERO))
    return tracker


def changed(vehicle, **controller):
    return ParameterChange(controller).applied(vehicle).parameters()


def test_the_way_ends_at_the_parameters_of_a_fresh_tracker_and_is_linear():
    vehicle = load_vehicle("bundled")
    tracker = begun(vehicle)
    new = changed(vehicle, **STIFFER)
    hover(tracker, 5)
    old = tracker.parameters
    tracker.retune(new, 1.0)
    assert tracker.changing
    hover(tracker, 126, 5)
    assert tracker.parameters.gains.k1 == pytest.approx(2.1, abs=1e-9)
    assert tracker.parameters.gains.p_max == pytest.approx(0.825, abs=1e-9)
    assert tracker.parameters == between(old, new, 0.5)
    hover(tracker, 126, 131)
    assert not tracker.changing
    assert (
        tracker.parameters == Tracker(ParameterChange(STIFFER).applied(vehicle), "rates", kernels("python")).parameters
    )
    assert [way[1:] for way in tracker.transitions] == [(1.0, old, new)]


def test_a_settled_tracker_gives_the_numbers_of_a_fresh_one_in_the_same_state():
    vehicle = load_vehicle("bundled")
    tracker, fresh = begun(vehicle), begun(ParameterChange(STIFFER).applied(vehicle))
    tracker.retune(changed(vehicle, **STIFFER), 0.02)
    hover(tracker, 10)
    state = State((0.1, -0.2, 0.05), (0.1, 0.0, 0.2), LEVEL, (0.1, 0.0, 0.0))
    for each in (tracker, fresh):
        each.begin(state)
    assert hover(tracker, 20, 20, state=state) == hover(fresh, 20, 20, state=state)


@pytest.mark.numba
@pytest.mark.parametrize("kinds", [("sideslip", "commanded"), ("damping", "sideslip"), ("commanded", "damping")])
def test_both_engines_stay_equal_all_the_way(kinds):
    vehicle = load_vehicle("bundled", {"controller": {"heading": kinds[0]}})
    course = Course(load("indoor"), vehicle, ZERO, 0.0, None)
    trackers = [begun(vehicle, engine) for engine in ("python", "numba")]
    new = flown(changed(vehicle, **STIFFER, heading=kinds[1]), trackers[0].parameters)
    rng = random.Random(kinds[0])
    stamp = 1.0
    for i in range(300):
        if i == 50:
            for tracker in trackers:
                tracker.retune(new, 0.6)
        q = quat_normalise((1.0, rng.uniform(-0.2, 0.2), rng.uniform(-0.2, 0.2), rng.uniform(-1, 1)))
        state = State(*(tuple(rng.uniform(-x, x) for _ in range(3)) for x in (0.5, 1.0)), q, (0.1, -0.1, 0.2))
        one, two = (t.step(stamp, state, lambda s: course.at(s - 1.0), frozen=i % 7 == 0).numbers for t in trackers)
        assert one == pytest.approx(two, rel=1e-12, abs=1e-12, nan_ok=True)
        stamp += rng.choice((0.004, 0.004, 0.008))
    assert trackers[0].parameters == trackers[1].parameters == new
    assert not trackers[0].changing


@pytest.mark.parametrize("kinds", [("sideslip", "sideslip"), ("damping", "commanded"), ("commanded", "damping")])
def test_no_command_steps_when_the_way_begins_and_on_it_they_part_slowly(kinds):
    vehicle = load_vehicle("bundled", {"controller": {"heading": kinds[0]}})
    plain, ramped, jumped = (begun(vehicle) for _ in range(3))
    new = flown(changed(vehicle, **STIFFER, heading=kinds[1]), ramped.parameters)
    q = quat_normalise((1.0, 0.05, -0.05, 0.3))
    state = State((0.2, -0.2, 0.1), (0.3, 0.1, -0.2), q, (0.2, -0.1, 0.3))
    for tracker in (plain, ramped, jumped):
        hover(tracker, 3, state=state)
    ramped.retune(new, 2.0)
    jumped.retune(new, 1e-9)
    a, b, c = (hover(tracker, 3, 3, state=state) for tracker in (plain, ramped, jumped))

    def apart(x, y):
        return max(
            abs(p - q)
            for p, q in zip(x[flat.RATES] + (x[flat.THRUST],), y[flat.RATES] + (y[flat.THRUST],), strict=True)
        )

    assert b[0] == pytest.approx(a[0], abs=1e-12, nan_ok=True) or kinds[0] != kinds[1]
    assert apart(a[0], b[0]) < 1e-12
    whole = apart(a[1], c[1])
    assert whole > 1e-3
    assert 0.0 < apart(a[1], b[1]) < 3.0 * whole * 0.004 / 2.0


def test_a_heading_of_another_kind_takes_over_little_by_little():
    vehicle = load_vehicle("bundled", {"controller": {"heading": "damping"}})
    tracker = begun(vehicle)
    tracker.retune(flown(changed(vehicle, heading="commanded"), tracker.parameters), 0.4)
    rows = hover(tracker, 130)
    yaw = [n[flat.TAU][2] for n in rows]  # at rest with a commanded heading of 0.3 rad
    assert yaw[0] == 0.0
    other = begun(load_vehicle("bundled", {"controller": {"heading": "commanded"}}))
    assert yaw[-1] == pytest.approx(hover(other, 130)[-1][flat.TAU][2], rel=1e-8) and yaw[-1] > 0.25
    steps = [b - a for a, b in itertools.pairwise(yaw)]
    assert max(steps) < 1.3 * yaw[-1] / 100.0


def test_what_is_no_change_of_the_law_is_refused():
    vehicle = load_vehicle("bundled")
    tracker = begun(vehicle)
    new = changed(vehicle, **STIFFER)
    with pytest.raises(ValueError, match="model"):
        tracker.retune(new._replace(model=new.model._replace(mass=2.0)), 1.0)
    with pytest.raises(ValueError, match="no time"):
        tracker.retune(new, 0.0)
    tracker.retune(new, 1.0)
    with pytest.raises(ValueError, match="on their way"):
        tracker.retune(new, 1.0)


def test_a_flight_under_way_keeps_the_limits_that_its_reference_was_checked_by():
    vehicle = load_vehicle("bundled")
    change = ParameterChange({"k1_1_s": 2.2}, {"thrust_max_n": 15.0, "disturbance_max_m_s2": 5.0})
    now = vehicle.parameters()
    taken = flown(change.applied(vehicle).parameters(), now)
    assert taken.gains.k1 == 2.2
    assert taken.limits == now.limits._replace(disturbance_max=5.0)


# -- several changes --------------------------------------------------------------------------------------------------


def fly_on(tracker, retuning, steps, begin):
    for i in range(steps):
        hover(tracker, 1, begin + i)
        retuning.tick()


def test_changes_follow_one_another_and_the_newest_one_that_can_be_reached_is_taken():
    tracker = begun(load_vehicle("bundled"))
    lines = []
    retuning = Retuning(tracker, lines.append)
    for k1 in (2.1, 2.2, 2.3):
        assert retuning.want(ParameterChange({"k1_1_s": k1}, {}, 0.2)) == ""
    fly_on(tracker, retuning, 20, 0)
    assert tracker.changing and tracker.transitions[-1].new.gains.k1 == 2.3
    assert retuning.want(ParameterChange({"k1_1_s": 2.0}, {}, 0.2)) == ""
    fly_on(tracker, retuning, 200, 20)
    assert tracker.parameters.gains.k1 == 2.0
    assert len(tracker.transitions) == 2 and len(lines) == 2
    assert retuning.want(ParameterChange({"k1_1_s": 2.0}, {}, 0.2)) == ""
    fly_on(tracker, retuning, 20, 220)
    assert not tracker.changing and len(tracker.transitions) == 2


def test_what_the_certificate_refuses_is_not_followed():
    tracker = begun(load_vehicle("bundled"))
    retuning = Retuning(tracker, lambda line: None)
    assert "Q (inside p_max" in retuning.want(ParameterChange({"gamma_1_s3": 500.0}))
    assert "disturbance_max 6" in retuning.want(ParameterChange({"position_error_max_m": 0.01}))
    assert "controller.k1_1_s" in retuning.want(ParameterChange({"k1_1_s": math.nan}))
    assert "thrust_max" in retuning.want(ParameterChange({}, {"thrust_max_n": 3.0}))
    fly_on(tracker, retuning, 30, 0)
    assert tracker.parameters == load_vehicle("bundled").parameters()


def gain_sets():
    """Two sound sets with unsound ones on the straight way between them, and one by which the way is sound.

    c0 Gamma, which k3 must exceed, falls with the cube of the other gains: half of both is too much.
    """
    base = load_vehicle("paper", {"limits": {"disturbance_max_m_s2": 0.5}})
    low, high = (0.7, 4.0, 3.0, 4.0, 0.0), (4.0, 4.0, 9.0, 9.0, 200.0)
    sets = []
    for k1, k2, k3, k4, gamma in (low, (*high[:4], 0.0), high):
        gains = base.parameters().gains._replace(k1=k1, k2=k2, k3=k3, k4=k4, gamma=gamma)
        sets.append(base.parameters()._replace(gains=gains))
    return base, *sets


def test_the_way_that_is_not_sound_exists():
    _, low, middle, high = gain_sets()
    assert not unsound(low) and not unsound(high)
    assert any(unsound(point) for point in points(low, high))
    assert not any(unsound(point) for point in [*points(low, middle), *points(middle, high)])


def as_change(parameters, ramp_s=0.1):
    g = parameters.gains
    keys = ("k1_1_s", "k2", "k3_1_s", "k4_1_s", "gamma_1_s3", "position_error_max_m")
    return ParameterChange(dict(zip(keys, g[:6], strict=True)), {}, ramp_s)


def test_a_way_through_unsound_parameters_is_never_taken():
    vehicle, a, c, b = gain_sets()
    tracker = begun(as_change(a).applied(vehicle))
    lines = []
    retuning = Retuning(tracker, lines.append)
    assert retuning.want(as_change(b)) == ""
    fly_on(tracker, retuning, 30, 0)
    assert tracker.parameters.gains == a.gains and not tracker.transitions
    assert "stay as they are" in lines[0]
    assert retuning.want(as_change(c)) == retuning.want(as_change(b)) == ""
    fly_on(tracker, retuning, 200, 30)
    assert tracker.parameters.gains == b.gains
    assert [way.new.gains for way in tracker.transitions] == [c.gains, b.gains]


def test_points_end_with_the_new_parameters():
    vehicle = load_vehicle("bundled")
    new = changed(vehicle, **STIFFER)
    way = points(vehicle.parameters(), new)
    assert len(way) == POINTS and way[-1] == new


# -- across processes and files ---------------------------------------------------------------------------------------


def test_a_change_survives_the_way_between_processes():
    change = ParameterChange({"k1_1_s": 2.2, "heading": "damping"}, {"rate_max_rad_s": (5.0, 5.0, 2.0)}, 3.0)
    back = ParameterChange.from_note(json.loads(json.dumps(change.as_note())))
    vehicle = load_vehicle("bundled")
    assert back.applied(vehicle) == change.applied(vehicle)
    assert back.ramp_s == 3.0


@pytest.mark.parametrize(
    "note", [None, 3, {}, {"controller": {}, "limits": {}}, {"controller": [], "limits": {}, "ramp_s": 1.0},
             {"controller": {}, "limits": {}, "ramp_s": -1.0}, {"controller": {}, "limits": {}, "ramp_s": math.nan}]
)  # fmt: skip
def test_a_note_that_is_no_change_says_so(note):
    with pytest.raises(InputError, match="change of parameters"):
        ParameterChange.from_note(note)


def test_how_a_flight_was_retuned_is_in_its_summary_to_the_last_bit():
    vehicle = load_vehicle("bundled")
    way = Transition(12.3456789, 2.0, vehicle.parameters(), changed(vehicle, **STIFFER, heading="damping"))
    engagement = Engagement(10.0, ZERO, 0.5, None, LEVEL, None, (), (way,))
    assert Engagement.from_numbers(json.loads(json.dumps(asdict(engagement)))) == engagement


# -- a whole flight ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("change", [STIFFER, {"heading": "damping"}])
def test_a_flight_with_a_change_in_the_middle_stays_as_close_to_its_path(change, monkeypatch):
    flight = build_flight(
        {
            "name": "retuned", "vehicle": "bundled", "trajectory": "indoor", "world": {"wind_m_s": [2.0, 0.0, 0.0]},
            "start": {"position_m": [0.0, 0.0, -5.0]}, "link": {"state_rate_hz": 100.0},
        },
        "test",
    ).model_copy(update={"acceptance": Acceptance()})  # fmt: skip
    made = []

    class Retuned(Tracker):
        def step(self, stamp_s, state, reference_at, *, frozen=False):
            if not made and stamp_s > 6.0:
                made.append(self)
                self.retune(flown(changed(flight.vehicle, **change), self.parameters), 2.0)
            return super().step(stamp_s, state, reference_at, frozen=frozen)

    def fly():
        trace = simulate.fly_sampled(flight, of_flight(flight), kernels("auto"), duration_max_s=10.0)
        rates = trace.record.columns("rate_cmd_x", "rate_cmd_y", "rate_cmd_z")
        late = [math.hypot(*row.errors[0]) for row in trace.rows if row.t_s > 4.0]
        return max(late), abs(rates[401:] - rates[400:-1]).max(axis=0)

    error, steps = fly()
    monkeypatch.setattr(simulate, "Tracker", Retuned)
    retuned_error, retuned_steps = fly()
    assert made and not made[0].changing
    assert made[0].parameters.gains == changed(flight.vehicle, **change).gains
    assert retuned_error < 1.2 * error + 0.005
    assert all(retuned_steps < 1.5 * steps + 0.01)


# -- the gates, in brief ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes",
    [
        {}, {"controller": {"k4_1_s": 60.0}}, {"controller": {"k1_1_s": 4.0}}, {"limits": {"state_gap_max_s": 0.13}},
        {"controller": {"k4_1_s": 14.0}, "limits": {"state_gap_max_s": 0.02}}, {"link": {"state_rate_hz": 20.0}},
        {"controller": {"prediction": False}}, {"limits": {"state_gap_max_s": 0.104}},
    ],
)  # fmt: skip
def test_the_gates_in_brief_give_the_same_verdict(changes):
    def verdict(brief):
        try:
            gate_gains(vehicle, brief=brief)
        except RefusedError as error:
            return str(error)
        return ""

    vehicle = load_vehicle("bundled", changes)
    assert verdict(True) == verdict(False)


class NoWire:
    """A link on which nothing happens."""

    system_id, component_id = 1, 191


def test_a_flight_takes_changes_only_for_gains_that_the_ground_could_judge(monkeypatch):
    """Not before the loop is measured, as that may ask for other gains; and not where it did."""
    hover_ = {"name": "hover", "shape": "hover", "duration_s": 1.0, "hover": {"point_m": [0.0, 0.0, 0.0]}}
    flight = build_flight({"name": "test", "vehicle": "bundled", "trajectory": hover_}, "test")
    loop = FlightLoop(flight, of_flight(flight), NoWire(), FlightRecord(0, ()), kernels("python"))
    change = ParameterChange({"heading_damping_1_s": 2.2})
    assert loop.retune(change) == "the flight is being prepared; try again in a moment"
    monkeypatch.setattr(FlightLoop, "phase", Phase.TRACK)
    assert loop.retune(change) == ""
    loop._adapt(Adaptation("rates", 0.7, 112.5, 0.034))
    lowered = loop._tracker.parameters
    assert loop.retune(change).startswith("this flight has 70% of the gains")
    assert lowered.gains.k1 == pytest.approx(0.7 * flight.vehicle.parameters().gains.k1)
    loop._retuning.tick()
    assert not loop._tracker.changing and loop._tracker.parameters == lowered
