"""What moves the vehicle: the flat kernels give the plain engine's numbers, and the past is known ahead of time."""

from __future__ import annotations

import math
import re

import pytest
from sim_cases import LEVEL, NOTHING, rates, vehicle

from sim_link import engines, flat
from sim_link.airframe import Airframe
from sim_link.engines import CompiledEngine, PlainEngine
from sim_link.estimator import NOISE_ROWS, Noise
from sim_link.inner_loops import ATTITUDE, STOPPED_SETPOINT, TORQUE, LoopState, Setpoint
from sim_link.loop_gains import LoopGains
from sim_link.physics import Body, RigidState
from sim_link.rotation import exponential
from sim_link.vehicle_file import VehicleFile
from sim_link.wind import World

WINDY = World(force_n=(4.76, -2.0, 1.0), gravity_factor=1.05, wind_m_s=(4.0, 3.0, 0.0), turbulence=0.3, seed=9)
DRAGGY = vehicle(drag_1_s=0.6)
PLAN = [
    (rates((1.0, -0.5, 0.3)), 60),
    (rates((6.0, math.nan, -3.0), 0.9), 80),
    (Setpoint(ATTITUDE, 0.55, NOTHING, exponential((0.3, -0.2, 2.0)), 0.2, NOTHING), 120),
    (Setpoint(TORQUE, 0.5, NOTHING, LEVEL, 0.0, (0.05, -0.05, 0.1)), 40),
    (STOPPED_SETPOINT, 800),
]


def airframe(engine: str = "python", craft: VehicleFile = DRAGGY) -> Airframe:
    return Airframe(craft, WINDY, seed=5, engine=engine, start=((1.0, 2.0, -10.0), 0.8))


def fly(a: Airframe, per_call: int = 4) -> list[object]:
    """Fly the plan and change the world on the way; return all that can be seen."""
    seen: list[object] = []
    for setpoint, steps in PLAN:
        if setpoint.mode == TORQUE:
            a.set_wind((0.0, 6.0, 1.0), 0.4)
            a.set_force((0.0, 1.0, 0.0))
        for i in range(steps // per_call):
            a.advance(setpoint, i % 2 == 0, per_call)
            seen.append((a.t_us, a.rigid, a.truth(), a.believed(), a.rates_followed(), a.on_ground))
    return [*seen, a.impact_speed_m_s]


def flattened(value: object) -> list[float]:
    if isinstance(value, tuple | list):
        return [x for part in value for x in flattened(part)]
    assert isinstance(value, int | float)
    return [float(value)]


def test_flat_kernels_in_plain_python_are_the_plain_engine_to_the_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = airframe()
    monkeypatch.setattr(engines, "compile_kernel", lambda function: function)
    monkeypatch.setattr(engines, "available", lambda: True)
    by_array = airframe("auto")
    seen = fly(by_array)
    assert seen == fly(plain)
    assert by_array.on_ground
    assert by_array.impact_speed_m_s > 5.0


@pytest.mark.numba
def test_compiled_engine_gives_the_same_numbers_beliefs_included() -> None:
    plain, compiled = flattened(fly(airframe())), flattened(fly(airframe("numba")))
    assert compiled == pytest.approx(plain, rel=1e-12, abs=1e-12, nan_ok=True)


def test_the_array_has_room_for_every_field() -> None:
    def size(kind: type, **lengths: int) -> int:
        return sum(lengths.get(name, 1) for name in kind.__annotations__)

    assert size(RigidState, p=3, v=3, q=4, w=3, rotor_n=4) == flat.LOOPS - flat.RIGID
    assert size(LoopState, integral=3, w_previous=3, rates=3, q_ref=4, w_ref=3) == flat.ORDER - flat.LOOPS
    assert size(Setpoint, rates=3, q=4, torque=3) == flat.FRESH - flat.ORDER
    rotors = {name: 4 for name in Body._fields if re.match("rotor_((x|y|yaw)_m|share)$", name)}
    assert size(Body, inertia_kg_m2=3, **rotors) == flat.GAINS - flat.BODY
    vectors = dict.fromkeys(("rate_p", "rate_i", "rate_d", "attitude_p", "rate_max"), 3)
    mixes = {name: 4 for name in LoopGains._fields if name.startswith("mix_")}
    assert size(LoopGains, **vectors, **mixes) == flat.SIGMAS - flat.GAINS
    assert size(Noise) == flat.RING_ROWS - flat.SIGMAS
    assert flat.length(1) - flat.NOISE == 12 * NOISE_ROWS + 13


@pytest.mark.parametrize("by_array", [False, True])
def test_the_next_estimates_are_known_while_they_are_the_past(by_array: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engines, "compile_kernel", lambda function: function)
    monkeypatch.setattr(engines, "available", lambda: by_array)
    a, b, foreseeing = airframe("auto"), airframe("auto"), airframe("auto")
    assert isinstance(a._engine, CompiledEngine) is by_array
    assert a.age_steps == 10
    foreseeing.foresee(2)
    for i in range(300):
        ahead = [a.believed(steps) for steps in (10, 2, 0, 2)]
        assert ahead[1] == ahead[3]
        assert ahead[0].t_us == a.t_us
        a.advance(rates((0.3, 0.1, -0.2)), i == 0, 2)
        b.advance(rates((0.3, 0.1, -0.2)), i == 0, 2)
        foreseeing.advance(rates((0.3, 0.1, -0.2)), i == 0, 2)
        assert a.believed() == ahead[1] == b.believed() == foreseeing.believed()
        assert a.believed() is a.believed()
        assert a.believed(2) == foreseeing.believed(2)


@pytest.mark.parametrize("per_call", [1, 2, 5, 20])
def test_gusts_come_on_the_same_grid_however_the_steps_are_asked_for(per_call: int) -> None:
    by_four, other = airframe(), airframe()
    by_four.set_wind((0.0, 0.0, 0.0), 0.0)
    other.set_wind((0.0, 0.0, 0.0), 0.0)
    for _ in range(3):
        by_four.advance(PLAN[0][0], False, 4)
    other.advance(PLAN[0][0], False, 12)
    for a in (by_four, other):
        a.set_wind((5.0, 0.0, 0.0), 0.3)
    for _ in range(20):
        by_four.advance(PLAN[0][0], False, 4)
    for _ in range(80 // per_call):
        other.advance(PLAN[0][0], False, per_call)
    assert by_four.truth() == other.truth()


def test_engines_by_name() -> None:
    with pytest.raises(ValueError, match="engine 'gpu' is not one of auto, python, numba"):
        airframe("gpu")
    assert isinstance(airframe("python")._engine, PlainEngine)


def test_steps_that_do_not_divide_the_start_keep_the_stamps(monkeypatch: pytest.MonkeyPatch) -> None:
    craft = vehicle(loop_rate_hz=1.0e6 / 3000.0, rate_lag_s=(0.05, 0.05, 0.1))
    plain = Airframe(craft, World(), seed=1, engine="python", start=(NOTHING, 0.0))
    monkeypatch.setattr(engines, "compile_kernel", lambda function: function)
    monkeypatch.setattr(engines, "available", lambda: True)
    by_array = Airframe(craft, World(), seed=1, engine="auto", start=(NOTHING, 0.0))
    for a in (plain, by_array):
        a.advance(STOPPED_SETPOINT, True, 7)
    assert by_array.believed() == plain.believed()
    assert plain.believed().t_us == plain.t_us - plain.age_steps * 3000
