"""The guards one by one: which figures break them, when they answer, and with what."""

from __future__ import annotations

import math

import pytest

from companion.config import Vehicle, load_vehicle
from companion.control import flat
from companion.control.certificate import linear_loop
from companion.control.law import LIMIT_DISTURBANCE, LIMIT_ROLL_PITCH_RATE, LIMIT_THRUST_MAX
from companion.flight.envelope import Envelope
from companion.flight.guards import RUNAWAY, Guard, Guards, Response, Slow, disturbance_step
from companion.flight.phases import Cause

LEVEL = (1.0, 0.0, 0.0, 0.0)
STEP_S = 0.01
VEHICLE = load_vehicle("bundled")
PARAMETERS = VEHICLE.parameters()
VEHICLE_ENVELOPE = Envelope(PARAMETERS.gains, PARAMETERS.model.drag, disturbance_step(VEHICLE.limits))


def numbers(flags: int = 0, b_hat: float = 0.0, errors: tuple[float, ...] = (0.0,) * 12) -> tuple[float, ...]:
    n = [0.0] * flat.RESULTS
    n[flat.LIMITS], n[flat.THRUST], n[flat.B_HAT.start] = float(flags), 9.81, b_hat
    n[flat.ERRORS] = errors
    n[flat.LYAPUNOV] = 0.5 * sum(x * x for x in errors)
    return tuple(n)


class Watched:
    """Guards that are shown the same step again and again."""

    def __init__(self, vehicle: Vehicle = VEHICLE) -> None:
        self.guards = Guards(vehicle, vehicle.parameters())
        self.now_s = 0.0

    def steps(self, for_s: float, q=LEVEL, error=(0.0, 0.0, 0.0), n=None) -> list[tuple[float, Guard, Response]]:
        begun_s, found = self.now_s, []
        for _ in range(round(for_s / STEP_S)):
            self.now_s += STEP_S
            finding = self.guards.step(q, error, n or numbers(), self.now_s)
            if finding is not None:
                found.append((round(self.now_s - begun_s - STEP_S, 6), finding.guard, finding.response))
        return found

    def looks(self, for_s: float, seen: Slow) -> list[tuple[float, Guard | None, Response]]:
        begun_s, found = self.now_s, []
        for _ in range(round(for_s / 0.1)):
            self.now_s += 0.1
            finding = self.guards.slowly(seen, self.now_s)
            if finding is not None:
                found.append((round(self.now_s - begun_s - 0.1, 6), finding.guard, finding.response))
        return found


def tilted(angle: float, by_pitch: bool = False):
    cosine, sine = math.cos(angle / 2), math.sin(angle / 2)
    return (cosine, 0.0, sine, 0.0) if by_pitch else (cosine, sine, 0.0, 0.0)


def stages(guard: Guard) -> list[tuple[float, Guard, Response]]:
    return [(stage.after_s, guard, stage.response) for stage in guard.value.stages]


@pytest.mark.parametrize(
    ("guard", "shown"),
    [
        (Guard.POSITION_ERROR, {"error": (0.0, 101.0, 0.0), "q": LEVEL}),
        (Guard.TILT, {"q": tilted(1.01)}),
        (Guard.TILT, {"q": tilted(1.01, by_pitch=True)}),
        (Guard.DISTURBANCE, {"n": numbers(LIMIT_DISTURBANCE, 5.9)}),
        (Guard.THRUST, {"n": numbers(LIMIT_THRUST_MAX)}),
        (Guard.RATES, {"n": numbers(LIMIT_ROLL_PITCH_RATE)}),
    ],
)
def test_a_guard_answers_with_each_of_its_stages_once(guard: Guard, shown) -> None:
    watched = Watched()
    found = [f for f in watched.steps(8.0, **shown) if f[1] is guard]
    wanted = stages(guard)
    assert [f[1:] for f in found] == [w[1:] for w in wanted]
    assert [f[0] for f in found] == pytest.approx([w[0] for w in wanted], abs=1.5 * STEP_S)
    # What has passed begins anew.
    watched.steps(0.05)
    again = [f for f in watched.steps(8.0, **shown) if f[1] is guard]
    assert [f[1:] for f in again] == [w[1:] for w in wanted]


@pytest.mark.parametrize(
    ("guard", "seen"),
    [
        (Guard.STATE_RATE, Slow(state_rate_hz=0.59 * 250)),
        (Guard.STATE_AGE, Slow(state_age_s=0.071)),
        (Guard.LATE_STEPS, Slow(late_share=0.31)),
        (Guard.ESTIMATOR, Slow(estimator=("no horizontal velocity",))),
        (Guard.FENCE, Slow(fence="12 m from home")),
        (Guard.BATTERY, Slow(battery=0.14)),
        (Guard.LINK, Slow(unanswered_s=2.1)),
        (Guard.FAILSAFE, Slow(failsafe="its HEARTBEAT says critical")),
    ],
)
def test_what_changes_slowly(guard: Guard, seen: Slow) -> None:
    found = Watched().looks(7.0, seen)
    assert [f[1:] for f in found] == [w[1:] for w in stages(guard)]
    assert [f[0] for f in found] == pytest.approx([w[0] for w in stages(guard)], abs=0.11)


def test_nothing_is_wrong_within_the_limits_or_without_figures() -> None:
    fine = Slow(0.61 * 250, 0.069, 0.29, battery=0.16, unanswered_s=1.9)
    watched = Watched()
    assert watched.looks(10.0, fine) == watched.looks(10.0, Slow()) == []
    assert watched.steps(5.0, q=tilted(0.99), error=(0.7, 0.0, 0.0)) == []


def test_an_empty_battery_lands() -> None:
    found = Watched().looks(3.0, Slow(battery=0.05))
    assert found == [(pytest.approx(1.0, abs=0.11), Guard.BATTERY_CRITICAL, Response.LAND)]
    assert Guard.BATTERY_CRITICAL.value.cause is Cause.BATTERY


def test_short_saturation_and_a_start_from_afar_are_nothing() -> None:
    watched = Watched()
    assert watched.steps(3.0, error=(20.0, 0.0, 0.0)) == []
    for _ in range(20):
        assert watched.steps(0.4, n=numbers(LIMIT_THRUST_MAX)) == []
        assert watched.steps(0.02) == []
    # Once it has been there, an error beyond the law's bound is another matter.
    assert watched.steps(3.0, error=(1.0, 0.0, 0.0)) == [(pytest.approx(0.5, abs=0.011), Guard.BEHIND, Response.SLOW)]


def test_what_was_retuned_is_what_the_bounds_of_the_law_are_judged_by() -> None:
    watched = Watched()
    gains = PARAMETERS.gains._replace(p_max=2.0)
    watched.guards.retune(PARAMETERS._replace(gains=gains, limits=PARAMETERS.limits._replace(disturbance_max=1.5)))
    watched.steps(0.02)
    assert watched.steps(3.0, error=(1.9, 0.0, 0.0)) == []
    assert [guard for _, guard, _ in watched.steps(3.0, error=(2.1, 0.0, 0.0))] == [Guard.BEHIND]
    found = []
    for _ in range(round(2.2 / STEP_S)):
        found.append(watched.guards.step(LEVEL, (0.0, 0.0, 0.0), numbers(LIMIT_DISTURBANCE, 1.5), watched.now_s))
        watched.now_s += STEP_S
    assert ["limit 1.5 (limits.disturbance_max" in finding.detail for finding in found if finding is not None] == [True]


def test_the_pace_comes_back_when_nothing_is_wrong_any_more() -> None:
    watched = Watched()
    watched.steps(1.0, n=numbers(LIMIT_THRUST_MAX))
    watched.steps(0.02)
    assert watched.looks(6.0, Slow()) == [(pytest.approx(3.0, abs=0.11), None, Response.RESUME)]


def test_the_hardest_response_of_several_is_given() -> None:
    found = Watched().steps(0.02, error=(101.0, 0.0, 0.0), n=numbers(LIMIT_THRUST_MAX))
    assert found == [(0.0, Guard.POSITION_ERROR, Response.HOLD)]


def test_every_guard_has_a_sentence_a_limit_and_a_response() -> None:
    for guard in Guard:
        assert guard.value.cause.value.sentence
        assert guard.value.key
        times = [stage.after_s for stage in guard.value.stages]
        assert times == sorted(times)
        assert times
        responses = [stage.response for stage in guard.value.stages]
        assert responses == sorted(set(responses))
        assert Response.RESUME not in responses


# The envelope


def spread(level: float, axis: int) -> tuple[float, ...]:
    """Errors on one axis with V = level."""
    e = [0.0] * 12
    for i in range(4):
        e[3 * i + axis] = math.sqrt(level / 2.0)
    return tuple(e)


def linear(b: float, start: tuple[float, ...], until_s: float):
    """V over time of the linear loop on one axis, by small steps."""
    a = linear_loop(VEHICLE.parameters().gains, VEHICLE.body.drag_1_s)
    x = [*start, b]
    dt, t = 1e-3, 0.0
    while t < until_s:
        yield t, tuple(x[:4])
        rate = [sum(a[i][j] * x[j] for j in range(5)) for i in range(5)]
        x = [x[i] + dt * rate[i] for i in range(5)]
        t += dt


@pytest.mark.parametrize(("axis", "step"), [(0, 6.0), (1, 6.0), (2, 0.5)])
def test_the_linear_loop_stays_within_its_envelope_with_the_configured_step_and_leaves_it_with_twice(
    axis: int, step: float
) -> None:
    def excesses(b: float, start: tuple[float, ...]) -> int:
        envelope = Envelope(VEHICLE.parameters().gains, VEHICLE.body.drag_1_s, (6.0, 0.5))
        count = 0
        for t, x in linear(b, start, 2.0):
            e = [0.0] * 12
            for i in range(4):
                e[3 * i + axis] = x[i]
            if math.sqrt(e[axis] ** 2) < 0.75:
                count += envelope.excess(numbers(errors=tuple(e)), t) is not None
        return count

    assert excesses(step, (0.0,) * 4) == excesses(step, (0.3, 0.2, -0.1, 0.1)) == 0
    assert excesses(0.0, (0.5, -0.4, 0.3, -0.3)) == 0
    assert excesses(2.0 * step, (0.0,) * 4) > 100


def test_the_guard_answers_what_stays_above_the_envelope() -> None:
    watched = Watched()
    watched.steps(0.1)
    assert watched.steps(0.25, n=numbers(errors=spread(0.01, 2))) == []
    watched.steps(0.02)
    assert watched.steps(3.0, n=numbers(errors=spread(0.01, 2))) == [
        (pytest.approx(0.3, abs=0.011), Guard.LYAPUNOV, Response.REST),
        (pytest.approx(2.5, abs=0.011), Guard.LYAPUNOV, Response.HOLD),
    ]
    # The same from the side is wind.
    watched.steps(0.02)
    assert watched.steps(3.0, n=numbers(errors=spread(0.3, 0))) == []


def test_what_is_far_above_the_envelope_is_answered_at_once() -> None:
    root = VEHICLE_ENVELOPE.step_roots[1]
    for share, expected in ((1.02, [(0.1, Guard.RUNAWAY, Response.HOLD)]), (0.98, [])):
        watched = Watched()
        watched.steps(6.5)  # what was there at the start has decayed
        errors = (0.0, 0.0, math.sqrt(2.0 * RUNAWAY * share) * root, *(0.0,) * 9)
        found = watched.steps(0.2, n=numbers(errors=errors))
        assert found == [(pytest.approx(at, abs=0.011), guard, response) for at, guard, response in expected]
        # It has to last: back under it for a moment, and it begins anew.
        watched.steps(0.02)
        assert watched.steps(0.09, n=numbers(errors=errors)) == []


def test_rates_that_are_not_followed() -> None:
    watched = Watched()
    limit = VEHICLE.limits.rate_error_max_rad_s
    step = lambda off: watched.guards.step(LEVEL, (0.0, 0.0, 0.0), numbers(), watched.now_s, off)  # noqa: E731
    again = ((0.99 * limit, None), (1.01 * limit, Guard.FOLLOWING))
    for off, expected in (*again, *again):
        found = []
        for _ in range(12):
            watched.now_s += STEP_S
            found.append(step(off))
        guards = [finding.guard for finding in found if finding is not None]
        assert guards == ([] if expected is None else [expected])
    assert found[-2] is not None or found[-1] is not None


def test_errors_at_the_start_and_after_a_reset_are_not_held_against_the_vehicle() -> None:
    far = (*(20.0, 3.0, 5.0), *(1.0, 0.2, 0.3), *(0.5, 0.1, 0.2), *(0.1, 0.1, 0.1))
    watched = Watched()
    assert [f for f in watched.steps(1.0, n=numbers(errors=far)) if f[1] is Guard.LYAPUNOV] == []
    near = tuple(0.1 * x if i % 3 == 2 else 0.0 for i, x in enumerate(far))
    assert watched.steps(0.2, n=numbers(errors=near)) == []
    watched.steps(0.5)
    found = watched.steps(0.5, n=numbers(errors=near))  # by now they should be gone
    assert [guard for _, guard, _ in found] == [Guard.RUNAWAY, Guard.LYAPUNOV]
    watched.steps(0.5)
    watched.guards.restart()
    assert watched.steps(0.2, n=numbers(errors=near)) == []


def test_where_the_law_does_not_fly_its_envelope_is_nobodys_business() -> None:
    guards = Guards(VEHICLE, None)
    guards.restart()
    far = numbers(errors=(20.0,) * 12)
    assert all(guards.step(LEVEL, (20.0, 0.0, 0.0), far, STEP_S * i) is None for i in range(500))


def test_what_it_says_has_the_figure_the_limit_and_how_long_it_lasted() -> None:
    guards, limits = Guards(VEHICLE, PARAMETERS), VEHICLE.limits
    finding = guards.step(LEVEL, (0.0, 123.4, 0.0), numbers(), 0.0)
    assert finding is not None
    limit = f"limit {limits.position_error_abort_m:.3g} (limits.position_error_abort_m)"
    assert finding.detail == f"123 m, {limit}"
    least = f"limit {limits.state_rate_min * 250:.3g} (limits.state_rate_min)"
    for rate_hz, told in ((100.0, "100 Hz"), (0.0, "0 Hz")):
        guards = Guards(VEHICLE, PARAMETERS)
        slow = [guards.slowly(Slow(state_rate_hz=rate_hz), 0.1 * i) for i in range(7)]
        assert [finding.detail for finding in slow if finding is not None] == [f"{told}, {least} for 0.5 s"]


def test_of_two_guards_that_ask_for_the_same_the_first_is_named() -> None:
    found = Watched().steps(6.1, n=numbers(LIMIT_THRUST_MAX | LIMIT_ROLL_PITCH_RATE))
    assert found[-1] == (pytest.approx(6.0, abs=0.011), Guard.THRUST, Response.HOLD)
