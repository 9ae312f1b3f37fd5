"""What a reset of the estimate does to the controller, the course and the prediction."""

from __future__ import annotations

import math

import pytest

from companion.config import FlightLimits, load_vehicle
from companion.control import flat
from companion.control.history import Attitude, refreshed
from companion.control.types import Reference, State
from companion.control.vectors import quat_exp, quat_multiply, rotate_to_inertial
from companion.flight.engines import kernels
from companion.flight.resets import Reset, Resets, about_vertical, jump
from companion.flight.tracker import Tracker
from companion.frames import quat_from_yaw

ZERO = (0.0, 0.0, 0.0)
STEP_S = 0.004


def limits(**changes: float) -> FlightLimits:
    return load_vehicle("bundled").limits.model_copy(update=changes)


def at(p, yaw: float = 0.0) -> Reference:
    return Reference(p, ZERO, ZERO, ZERO, ZERO, yaw, 0.0, 0.0)


class Carrier:
    """A controller and a course in one, that write down what they are told."""

    def __init__(self, foreseen: State) -> None:
        self.foreseen, self.resets, self.shifts = foreseen, [], []

    def foresee(self, stamp_s: float):
        return self.foreseen, 10.0

    def carry(self, reset: Reset) -> None:
        self.resets.append(reset)

    def shift(self, by_m) -> None:
        self.shifts.append(by_m)


def test_a_jump_is_what_the_model_did_not_foresee() -> None:
    lean = quat_exp((0.0, -0.3, 0.0))
    foreseen = State((1.0, 2.0, -3.0), (1.0, 0.0, 0.0), lean, ZERO)
    now = State((1.5, 2.0, -3.2), (1.0, 0.2, 0.0), quat_multiply(quat_from_yaw(0.2), lean), ZERO)
    found = jump(7.0, foreseen, now, 10.0)
    assert found.at_s == 7.0
    assert found.moved_m == pytest.approx((0.5, 0.0, -0.2))
    assert found.faster_m_s == pytest.approx((0.0, 0.2, 0.0))
    assert found.turned_rad == pytest.approx(0.2)
    # The acceleration that the law believes in, -thrust r3 + b_hat, is the same before and after.
    before = rotate_to_inertial(foreseen.q, (0.0, 0.0, -10.0))
    after = rotate_to_inertial(now.q, (0.0, 0.0, -10.0))
    assert [a + d for a, d in zip(after, found.disturbance_m_s2, strict=True)] == pytest.approx(before)


def test_small_jumps_move_the_reference_and_large_ones_do_not() -> None:
    here = State(ZERO, ZERO, (1.0, 0.0, 0.0, 0.0), ZERO)
    told: list[str] = []
    carrier, resets = Carrier(here), Resets(limits(), told.append)
    assert resets.follow(1.0, here._replace(p=(0.3, 0.4, 0.0)), carrier, carrier) == ""
    assert carrier.shifts == [pytest.approx((0.3, 0.4, 0.0))]
    assert "moved by 0.50 m" in told[0]
    for state, key in (
        (here._replace(p=(0.0, 0.0, 2.1)), "estimate_jump_max_m)"),
        (here._replace(v=(0.0, 1.1, 0.0)), "estimate_jump_max_m_s"),
        (here._replace(q=quat_from_yaw(0.6)), "estimate_jump_max_rad"),
        (here._replace(p=(math.nan, 0.0, 0.0)), "estimate_jump_max_m)"),
    ):
        assert key in resets.follow(2.0, state, carrier, carrier)
    assert len(carrier.shifts) == len(carrier.resets) == len(resets.carried) == 1
    assert Reset.from_numbers(resets.carried[0]._asdict()) == resets.carried[0]


@pytest.mark.parametrize("engine", ["python", pytest.param("numba", marks=pytest.mark.numba)])
@pytest.mark.parametrize(("moved", "turn"), [((0.5, -0.2, 0.1), 0.0), (ZERO, 0.3), ((0.5, 0.0, 0.0), -0.2)])
def test_the_command_after_a_carried_reset_is_the_one_without(engine: str, moved, turn: float) -> None:
    """At rest in wind, heading held: the estimate jumps, thrust and roll and pitch rates do not."""

    def commands(reset: bool) -> list[tuple[float, ...]]:
        vehicle = load_vehicle("bundled")
        tracker = Tracker(vehicle, "rates", kernels(engine))
        lean = quat_exp((0.02, -0.2, 0.0))
        state = State((0.02, 0.01, -10.0), (0.01, 0.0, 0.0), lean, (0.01, 0.02, 0.0))
        tracker.begin(state)
        place, out = (0.0, 0.0, -10.0), []
        for i in range(40):
            if reset and i == 20:
                foreseen = tracker.foresee(1.0 + STEP_S * i)
                assert foreseen is not None
                state = State(
                    tuple(a + b for a, b in zip(state.p, moved, strict=True)),
                    state.v,
                    quat_multiply(quat_from_yaw(turn), state.q),
                    state.w,
                )
                # velocity and attitude of this vehicle stay as they are: what is foreseen differs, but for the jump
                found = Reset(1.0 + STEP_S * i, moved, ZERO, turn, _estimate_change(tracker, lean, turn))
                tracker.carry(found)
                place = tuple(a + b for a, b in zip(place, moved, strict=True))
            n = tracker.step(1.0 + STEP_S * i, state, lambda t, place=place: at(place)).numbers
            out.append((n[flat.THRUST], *n[flat.RATES]))
        return out

    for plain, carried in zip(commands(False), commands(True), strict=True):
        # With a turn, velocity and error keep their direction in the world while the body seems turned: not the same
        # numbers, but no jump.
        assert carried == pytest.approx(plain, abs=1e-9 if turn == 0.0 else 0.12)


def _estimate_change(tracker: Tracker, q, turn: float):
    thrust = tracker._prediction.thrust / tracker.parameters.model.mass
    r3 = rotate_to_inertial(q, (0.0, 0.0, 1.0))
    after = about_vertical(turn, r3)
    return tuple(thrust * (a - b) for a, b in zip(after, r3, strict=True))


def test_the_model_foresees_its_own_prediction() -> None:
    """A vehicle that does what the model says has no jump, over one interval and over a gap."""
    tracker = Tracker(load_vehicle("bundled"), "rates", kernels("python"))
    state, at_s = State((0.3, 0.0, -10.0), (0.5, 0.0, 0.0), quat_exp((0.1, 0.0, 0.0)), ZERO), 1.0
    tracker.begin(state)
    assert tracker.foresee(1.0) is None
    for i in range(60):
        tracker.step(at_s, state, lambda t: at((0.0, 0.0, -10.0)))
        at_s += 0.06 if i == 40 else STEP_S
        foreseen = tracker.foresee(at_s)
        assert foreseen is not None
        assert jump(at_s, foreseen[0], foreseen[0], foreseen[1]) == Reset(at_s, ZERO, ZERO, 0.0, ZERO)
        assert math.dist(foreseen[0].p, state.p) < 0.06
        assert foreseen[0] != state
        state = foreseen[0]


# The prediction from a newer attitude


def test_the_rotation_starts_from_a_newer_attitude() -> None:
    """The model's own attitude of later gives the state back; position and velocity stay in any case."""
    lags = (0.04, 0.05, 0.08)
    pieces = [(9.81, (0.4, -0.3, 0.1), 0.01), (9.81, (-0.2, 0.5, 0.2), 0.01)]
    state = State((1.0, 2.0, 3.0), (4.0, 5.0, 6.0), quat_exp((0.1, 0.2, 0.3)), (0.5, -0.4, 0.3))
    q, w = state.q, list(state.w)
    for (_, rates, _), span in zip(pieces, (0.01, 0.004), strict=True):
        decay = [math.exp(-span / lag) for lag in lags]
        turned = [span * r + (x - r) * (1.0 - d) * lag for x, r, d, lag in zip(w, rates, decay, lags, strict=True)]
        q = quat_multiply(q, quat_exp(tuple(turned)))
        w = [r + (x - r) * d for x, r, d in zip(w, rates, decay, strict=True)]
    numbers = [x for thrust, rates, span in pieces for x in (thrust, *rates, span)]
    found, used = refreshed(state, 1.0, Attitude(1.014, q, tuple(w)), numbers, 0, 2, lags)
    assert used
    assert found.q == pytest.approx(state.q, abs=1e-12)
    assert found.w == pytest.approx(state.w, abs=1e-12)
    assert (found.p, found.v) == (state.p, state.v)
    # What is newly known reaches the state: 0.02 rad further round, 0.02 rad further round before.
    more = quat_multiply(q, quat_exp((0.02, 0.0, 0.0)))
    found, used = refreshed(state, 1.0, Attitude(1.014, more, tuple(w)), numbers, 0, 2, lags)
    assert used and found.q != pytest.approx(state.q, abs=1e-3)


def test_an_attitude_of_another_estimate_or_beyond_the_prediction_is_left_alone() -> None:
    pieces = [9.81, *ZERO, 0.01]
    state = State(ZERO, ZERO, (1.0, 0.0, 0.0, 0.0), ZERO)
    for at_s, q in ((1.005, quat_from_yaw(0.2)), (1.02, quat_from_yaw(0.01))):
        found = refreshed(state, 1.0, Attitude(at_s, q, ZERO), pieces, 0, 1, (0.04, 0.04, 0.08))
        assert found == (state, False)


def test_the_tracker_uses_only_attitudes_that_are_newer_than_the_state() -> None:
    def command(at_s: float) -> tuple[int, tuple[float, ...]]:
        tracker = Tracker(load_vehicle("bundled"), "rates", kernels("python"))
        state = State((0.0, 0.0, -10.0), ZERO, (1.0, 0.0, 0.0, 0.0), ZERO)
        tracker.begin(state)
        tracker.refresh(Attitude(at_s, quat_exp((0.01, 0.0, 0.0)), ZERO))
        n = tracker.step(1.0, state, lambda t: at((0.0, 0.0, -10.0))).numbers
        return tracker.refreshed, tuple(n[flat.RATES])

    count, rates = command(1.01)
    assert count == 1
    assert rates[0] < -0.01  # it rolls back
    assert command(0.99) == (0, pytest.approx(ZERO, abs=1e-9))


@pytest.mark.parametrize("engine", ["python", pytest.param("numba", marks=pytest.mark.numba)])
def test_another_delay_is_predicted_over_from_the_next_state_on(engine: str) -> None:
    tracker = Tracker(load_vehicle("bundled"), "rates", kernels(engine))
    state = State((0.0, 0.0, -10.0), ZERO, (1.0, 0.0, 0.0, 0.0), ZERO)
    tracker.begin(state)
    asked: list[float] = []

    def reference(t: float) -> Reference:
        asked.append(t)
        return at((0.0, 0.0, -10.0))

    tracker.step(1.0, state, reference)
    tracker.retime(0.021)
    tracker.step(1.004, state, reference)
    n = tracker.step(1.008, state, reference).numbers
    assert asked == pytest.approx([1.02, 1.025, 1.029])
    assert tracker.delays == [(1.004, 0.021)]
    assert n[flat.PREDICTED_Q.start] == pytest.approx(1.0)
    assert tracker._prediction.length_s == pytest.approx(0.007)
