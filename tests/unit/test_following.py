"""Commanded and measured body rates: what a lag and a delay explain, and what they do not."""

from __future__ import annotations

import math

import pytest

from companion.flight.following import Following

STEP_S = 0.01
LAG_S = (0.04, 0.05, 0.08)
DELAY_S = 0.03


def command(t_s: float) -> tuple[float, float, float]:
    return math.sin(5.0 * t_s), -0.7 * math.cos(3.0 * t_s), 9.0


def turning(late_s: float, lag_s=LAG_S, skip=()) -> list[float]:
    """Errors while a vehicle follows the commands behind a lag, each `late_s` after its state."""
    following, w, found = Following(LAG_S), [0.0, 0.0], []
    for i in range(300):
        t_s = STEP_S * i
        if i > 0:  # what acted since the state before
            since_s = t_s - STEP_S - late_s
            acting = command(since_s) if since_s > -1e-9 else (0.0, 0.0, 0.0)
            for axis in range(2):
                w[axis] = acting[axis] + (w[axis] - acting[axis]) * math.exp(-STEP_S / lag_s[axis])
        if i not in skip:
            found.append(following.error(t_s, (w[0], w[1], -3.0), command(t_s), DELAY_S))
    return found


def test_a_vehicle_that_follows_is_not_off() -> None:
    assert max(turning(DELAY_S)) < 1e-9


def test_a_vehicle_that_follows_late_or_not_at_all_is_off() -> None:
    assert max(turning(DELAY_S + 0.3)) > 1.0
    assert max(turning(1e9)) == pytest.approx(math.hypot(1.0, 0.7), abs=0.2)
    assert max(turning(DELAY_S, lag_s=(0.08, 0.1, 0.1))) < 0.25


def test_a_state_that_is_missing_costs_little() -> None:
    assert max(turning(DELAY_S, skip={100, 101, 150})) < 0.1


def test_it_begins_where_the_vehicle_turns() -> None:
    following = Following(LAG_S)
    assert following.error(1.0, (2.0, -1.0, 0.0), (2.0, -1.0, 0.0), DELAY_S) == 0.0
    for i in range(1, 20):
        assert following.error(1.0 + STEP_S * i, (2.0, -1.0, 0.0), (2.0, -1.0, 0.0), DELAY_S) < 1e-9
    following.begin()
    assert following.error(5.0, (0.5, 0.0, 0.0), (0.0, 0.0, 0.0), DELAY_S) == 0.0
