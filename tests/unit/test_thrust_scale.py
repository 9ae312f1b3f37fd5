"""The thrust's scale in flight: found, bounded, slow, without a step in the command, and no rival of b_hat."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from companion.campaign import simulate
from companion.config import build_flight, find, load_vehicle, read_toml
from companion.control.types import GRAVITY_M_S2, State
from companion.control.vectors import quat_exp
from companion.flight import thrust_scale
from companion.flight.course import at_rest
from companion.flight.engines import kernels
from companion.flight.thrust_scale import ThrustScale
from companion.flight.tracker import Tracker
from companion.trajectory.load import embedded, of_flight

RATE_HZ = 100.0
LEVEL = (1.0, 0.0, 0.0, 0.0)


class Flown(NamedTuple):
    used: np.ndarray
    sent: np.ndarray
    b_hat: np.ndarray
    summary: dict


def fly(monkeypatch, factor: float, *, on: bool = True, speed: float = 1.0, duration_s: float = 25.0, **world) -> Flown:
    """The figure of eight by a vehicle whose rotors give `factor` times what its file says."""
    data = read_toml(find("eight", "flights"))
    vehicle = read_toml(find("bundled", "vehicles"))
    vehicle["link"]["state_rate_hz"] = RATE_HZ
    vehicle["controller"]["thrust_scale_estimate"] = on
    flight = embedded(
        build_flight({**data, "vehicle": vehicle, "world": world, "statistics_from_s": 4.0}, "test"), speed
    )
    true = simulate.simulated_vehicle(flight)
    true = replace(true, rotor_thrust_max_n=factor * true.rotor_thrust_max_n)
    monkeypatch.setattr(simulate, "simulated_vehicle", lambda flight: true)
    seen: list[tuple[float, ...]] = []

    class Watched(Tracker):
        def step(self, *arguments, **named):
            out = super().step(*arguments, **named)
            seen.append((self.thrust_scale or 1.0, out.setpoint.thrust, *out.b_hat))
            return out

    monkeypatch.setattr(simulate, "Tracker", Watched)
    trace = simulate.fly_sampled(flight, of_flight(flight), kernels("python"), duration_max_s=duration_s)
    table = np.array(seen)
    return Flown(table[:, 0], table[:, 1], table[:, 2:], trace.summary)


def test_weak_rotors_are_found_without_a_step_and_b_hat_is_left_with_nothing(monkeypatch) -> None:
    found = fly(monkeypatch, 0.9)
    assert found.used[-1] == pytest.approx(0.9, abs=0.01)
    assert abs(found.b_hat[-1][2]) < 0.1
    changed = np.flatnonzero(np.diff(found.used)) + 1
    assert len(changed) > 20
    change = np.diff(found.used)[changed - 1] / thrust_scale.WINDOW_S
    assert np.abs(change).max() <= thrust_scale.RATE_MAX_1_S * 1.1


@pytest.mark.parametrize("engine", ["python", pytest.param("numba", marks=pytest.mark.numba)])
def test_the_command_does_not_step_with_the_scale(engine: str) -> None:
    """The same states twice, tilted and turning; in one flight the scale changes by half a percent between two."""
    vehicle = load_vehicle("bundled", {"controller": {"thrust_scale_estimate": True, "heading": "commanded"}})
    sent: dict[float, list[tuple[float, ...]]] = {}
    for ratio in (1.0, 1.005):
        tracker = Tracker(vehicle, "rates", kernels(engine))
        tracker.begin(State((0.0,) * 3, (0.0,) * 3, LEVEL, (0.0,) * 3))
        sent[ratio] = []
        for i in range(60):
            t = 0.01 * i
            q = quat_exp((0.1 * math.sin(t), 0.2 * math.sin(2.0 * t), 0.0))
            state = State((0.05 * t, 0.0, 0.02 * t), (0.05, 0.0, 0.02), q, (0.1, 0.4, 0.0))
            assert tracker._scale is not None
            tracker._scale.on_state = lambda *seen, i=i, ratio=ratio: ratio if i == 40 else 1.0  # type: ignore[method-assign]
            out = tracker.step(t, state, lambda t: at_rest((0.0, 0.0, 0.0), 0.0))
            sent[ratio].append((out.setpoint.thrust, *out.setpoint.w))
        assert tracker.thrust_scale == pytest.approx(ratio)
    without, with_change = np.array(sent[1.0]), np.array(sent[1.005])
    assert np.array_equal(without[:40], with_change[:40])
    apart = np.abs(with_change[40] - without[40])
    assert apart[0] < 2e-5 * without[40][0]  # a change of the scale that is not made up for: 5e-3
    assert apart[1:].max() < 0.01  # what the thrust that turns with the vehicle is believed to be: as the noise


def test_a_fast_flight_with_a_wrong_scale_gets_better_by_it(monkeypatch) -> None:
    errors = {}
    for on in (False, True):
        with monkeypatch.context() as patch:
            errors[on] = fly(patch, 1.1, on=on, speed=2.5, duration_s=20.0).summary["position_rms_m"]
    assert errors[True] < 0.4 * errors[False]


def test_the_scale_stays_within_its_bounds(monkeypatch) -> None:
    monkeypatch.setattr(thrust_scale, "BOUND", 0.05)
    bounded = fly(monkeypatch, 0.86, duration_s=9.0)
    assert 0.95 - 1e-9 <= bounded.used.min() < 0.952


# ---- the estimate by itself ------------------------------------------------------------------------------------------


def shown(
    scale: ThrustScale, seconds: float, *, true: float = 0.9, lift=lambda t: 0.0, saturated: bool = False
) -> None:
    """A vehicle that rocks to and fro; `lift` is a vertical acceleration of the air's making."""
    mass, drag = 1.0, 1.0
    v = [0.0, 0.0, 0.0]
    dt = 1.0 / RATE_HZ
    for i in range(round(seconds * RATE_HZ)):
        t = i * dt
        q = quat_exp((0.0, 0.1 * math.sin(2.0 * t), 0.0))
        push = GRAVITY_M_S2 * (1.0 + 0.05 * math.sin(3.0 * t)) / true
        r3 = (2.0 * q[0] * q[2], 0.0, 1.0 - 2.0 * q[2] ** 2)
        if saturated:
            scale.interrupt()
        ratio = scale.on_state(t, State((0.0,) * 3, (v[0], v[1], v[2]), q, (0.0,) * 3), scale.used * push * mass)
        scale.take(ratio)
        for k in range(3):
            v[k] += dt * ((GRAVITY_M_S2 + lift(t) if k == 2 else 0.0) - true * push * r3[k] - drag * v[k])


def test_what_lasts_is_the_scale_and_what_comes_and_goes_is_the_air() -> None:
    vehicle = load_vehicle("bundled")
    calm, gusty = ThrustScale(vehicle), ThrustScale(vehicle)
    shown(calm, 15.0)
    assert calm.estimate == pytest.approx(0.9, abs=0.005)
    shown(gusty, 15.0, lift=lambda t: 0.5 * math.sin(2.0 * t))
    assert gusty.estimate == pytest.approx(0.9, abs=0.015)


def test_nothing_is_learnt_while_the_thrust_is_at_a_limit() -> None:
    scale = ThrustScale(load_vehicle("bundled"))
    shown(scale, 10.0, saturated=True)
    assert (scale.estimate, scale.used) == (1.0, 1.0)


def test_it_can_be_switched_off() -> None:
    vehicle = load_vehicle("bundled", {"controller": {"thrust_scale_estimate": False}})
    assert Tracker(vehicle, "rates", kernels("python")).thrust_scale is None
    vehicle = load_vehicle("bundled", {"controller": {"thrust_scale_estimate": True}})
    assert Tracker(vehicle, "rates", kernels("python")).thrust_scale == 1.0
