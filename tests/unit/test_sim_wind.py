"""Dryden turbulence: variance, correlation, steps of the mean, and the same gusts for the same seed."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sim_link.wind import Wind, World, dryden_scales

SPEED = 5.0


def gusts(
    period_s: float, count: int, *, seed: int = 1, wind: tuple[float, float, float] = (SPEED, 0.0, 0.0)
) -> np.ndarray:
    w = Wind(wind, 0.2, seed=seed, period_s=period_s, altitude_m=10.0)
    values = []
    for _ in range(count):
        values.append(w.air_m_s)
        w.advance()
    return np.array(values)


def test_scales_at_low_altitude() -> None:
    # MIL-F-8785C at 10 m = 32.81 ft: L_w = h, L_u = h/(0.177 + 0.000823 h)^1.2, sigma_w/sigma_u = (...)^0.4.
    horizontal, vertical, share = dryden_scales(10.0)
    assert vertical == pytest.approx(10.0)
    assert horizontal == pytest.approx(10.0 / 0.2040**1.2, rel=1e-3)
    assert share == pytest.approx(0.2040**0.4, rel=1e-3)
    assert dryden_scales(1.0) == dryden_scales(3.0)
    assert dryden_scales(304.8)[0] == pytest.approx(304.8, rel=0.01)


@pytest.mark.parametrize("period_s", [0.5, 30.0])
def test_mean_and_variance_do_not_depend_on_the_period(period_s: float) -> None:
    air = gusts(period_s, 40000)
    share = dryden_scales(10.0)[2]
    slow = 0.06 if period_s < 1.0 else 0.02  # few independent values lie in a short run
    assert air.std(axis=0) == pytest.approx([1.0, 1.0, share], rel=slow)
    assert air.mean(axis=0) == pytest.approx([SPEED, 0.0, 0.0], abs=2.0 * slow)


def test_correlation_over_distance_is_drydens() -> None:
    horizontal, vertical, share = dryden_scales(10.0)
    air = gusts(0.5, 60000) - np.array([SPEED, 0.0, 0.0])
    for steps in (2, 6, 14):
        along = SPEED * 0.5 * steps / horizontal
        down = SPEED * 0.5 * steps / vertical
        got = np.mean(air[steps:] * air[:-steps], axis=0)
        assert got[0] == pytest.approx(math.exp(-along), abs=0.06)
        assert got[1] == pytest.approx(math.exp(-along) * (1.0 - along / 2.0), abs=0.06)
        assert got[2] == pytest.approx(share**2 * math.exp(-down) * (1.0 - down / 2.0), abs=0.03)


def test_gusts_along_turn_with_the_wind() -> None:
    north = gusts(0.1, 500) - np.array([SPEED, 0.0, 0.0])
    east = gusts(0.1, 500, wind=(0.0, SPEED, 0.0)) - np.array([0.0, SPEED, 0.0])
    assert east[:, 1] == pytest.approx(north[:, 0])
    assert east[:, 0] == pytest.approx(-north[:, 1])
    assert east[:, 2] == pytest.approx(north[:, 2])


def test_same_seed_same_gusts() -> None:
    assert np.array_equal(gusts(0.01, 200), gusts(0.01, 200))
    assert not np.array_equal(gusts(0.01, 200), gusts(0.01, 200, seed=2))


def test_no_turbulence_is_the_mean_alone_and_still_air_has_none() -> None:
    steady = Wind((1.0, -2.0, 0.5), 0.0, seed=1, period_s=0.01)
    still = Wind((0.0, 0.0, 0.0), 0.5, seed=1, period_s=0.01)
    for _ in range(5):
        steady.advance()
        still.advance()
    assert steady.air_m_s == (1.0, -2.0, 0.5)
    assert still.air_m_s == (0.0, 0.0, 0.0)


def test_a_step_of_the_wind_acts_at_once() -> None:
    wind = Wind((0.0, 0.0, 0.0), 0.0, seed=1, period_s=0.01)
    wind.set_wind((0.0, 8.0, 0.0), 0.0)
    assert wind.air_m_s == (0.0, 8.0, 0.0)
    wind.set_wind((0.0, 8.0, 0.0), 0.3)
    assert wind.air_m_s != (0.0, 8.0, 0.0)
    assert all(math.isfinite(c) for c in wind.air_m_s)


def test_world_is_calm_by_default() -> None:
    assert World() == World((0.0, 0.0, 0.0), 1.0, (0.0, 0.0, 0.0), 0.0, 0.0, 1)
