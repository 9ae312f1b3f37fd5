"""What goes wrong with what the vehicle believes: jumps, drift, walk, outage, freeze, delay, rate, bad numbers."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from sim_cases import LEVEL, NOTHING, noiseless, rates, vehicle

from sim_link import engines
from sim_link.airframe import START_US, Airframe
from sim_link.autopilot import Autopilot, Result
from sim_link.beliefs import STAMP_BACK_US, Beliefs
from sim_link.bias_walk import BLOCK_KNOTS, KNOT_US, BiasWalk, WalkSigmas
from sim_link.codec import ID_ODOMETRY, ODOMETRY_REST, ODOMETRY_STATE, frames
from sim_link.estimator import Estimate
from sim_link.inner_loops import ATTITUDE, Setpoint
from sim_link.modes import Mode
from sim_link.rotation import Vec3, exponential, multiply, yaw_of
from sim_link.vehicle import Vehicle, VehicleOptions
from sim_link.vehicle_file import VehicleFile, load
from sim_link.wind import World

WALKING = {
    "walk_position_m": 0.2,
    "walk_velocity_m_s": 0.1,
    "walk_yaw_rad": 0.05,
    "walk_rate_rad_s": 0.01,
    "walk_time_constant_s": 20.0,
}
AT = (1.0, 2.0, -10.0)


def airframe(craft: VehicleFile | None = None, engine: str = "python", seed: int = 5) -> Airframe:
    craft = noiseless(state_age_s=0.02) if craft is None else craft
    return Airframe(craft, World(), seed=seed, engine=engine, start=(AT, 0.8))


def advance(a: Airframe, steps: int, per_call: int = 5) -> None:
    for _ in range(steps // per_call):
        a.advance(rates((0.2, -0.1, 0.3)), False, per_call)


def moved(a: Vec3, b: Vec3) -> Vec3:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


# The layer


def test_nothing_is_touched_while_nothing_is_wrong() -> None:
    a = airframe(vehicle())
    advance(a, 100)
    assert not a.beliefs.active
    assert a.inner_state() is a.rigid
    assert a.believed() is a._engine.believed(0)
    a.beliefs.set_drift(NOTHING, 0.0)
    a.beliefs.set_delay_s(0.0)
    a.beliefs.set_noise_factor(1.0)
    assert not a.beliefs.active


def test_a_reset_jumps_estimate_and_autopilot_alike_and_counts() -> None:
    a, plain = airframe(), airframe()
    advance(a, 100)
    advance(plain, 100)
    a.beliefs.reset((1.0, -2.0, 0.5), (0.1, 0.2, 0.3), 0.4)
    assert a.beliefs.reset_counter == 1
    for steps in (0, 50):
        advance(a, steps)
        advance(plain, steps)
        b, c = a.believed(), plain.believed()
        assert (b.t_us, b.w) == (c.t_us, c.w)
        assert moved(b.p, c.p) == pytest.approx((1.0, -2.0, 0.5))
        assert moved(b.v, c.v) == pytest.approx((0.1, 0.2, 0.3))
        assert b.q == pytest.approx(multiply((math.cos(0.2), 0.0, 0.0, math.sin(0.2)), c.q))
        inner, true = a.inner_state(), a.rigid
        assert moved(inner.p, true.p) == pytest.approx((1.0, -2.0, 0.5))
        assert moved(inner.v, true.v) == pytest.approx((0.1, 0.2, 0.3))
        assert math.remainder(yaw_of(inner.q) - yaw_of(true.q), math.tau) == pytest.approx(0.4)
        assert (inner.w, inner.rotor_n) == (true.w, true.rotor_n)
        assert a.truth() == plain.truth()
    a.beliefs.reset((-1.0, 2.0, -0.5), (-0.1, -0.2, -0.3), -0.4)
    assert a.believed().p == pytest.approx(plain.believed().p)
    for _ in range(254):
        a.beliefs.reset(NOTHING, NOTHING, 0.0)
    assert a.beliefs.reset_counter == 0
    assert len(a.beliefs.take_resets()) == 256
    assert a.beliefs.take_resets() == []


def test_drift_grows_while_it_is_set_and_stays() -> None:
    a, plain = airframe(), airframe()
    a.beliefs.set_drift((0.5, 0.0, -0.1), 0.02)
    for now, expected in ((500, 1.0), (1000, 2.0)):
        advance(a, 500)
        advance(plain, 500)
        assert a.t_us == START_US + now * a.dt_us
        assert moved(a.believed().p, plain.believed().p) == pytest.approx((0.5 * expected, 0.0, -0.1 * expected))
        turned = yaw_of(a.believed().q) - yaw_of(plain.believed().q)
        assert math.remainder(turned, math.tau) == pytest.approx(0.02 * expected)
    a.beliefs.set_drift(NOTHING, 0.0)
    advance(a, 300)
    advance(plain, 300)
    assert moved(a.believed().p, plain.believed().p) == pytest.approx((1.0, 0.0, -0.2))
    assert moved(a.inner_state().p, plain.rigid.p) == pytest.approx((1.0, 0.0, -0.2))


def test_a_freeze_holds_the_numbers_and_lets_the_stamps_go_on() -> None:
    a = airframe(vehicle(**WALKING))
    advance(a, 100)
    before, inner = a.believed(), a.inner_state()
    a.beliefs.set_frozen(True)
    assert a.believed() == before
    for _ in range(5):
        stamp = a.believed().t_us
        advance(a, 50)
        frozen = a.believed()
        assert frozen.t_us == stamp + 50 * a.dt_us
        assert frozen[1:] == before[1:]
        assert a.inner_state()[:3] == inner[:3]
        assert a.inner_state().w == a.rigid.w
    a.beliefs.reset((1.0, 0.0, 0.0), NOTHING, 0.0)
    assert moved(a.believed().p, before.p) == pytest.approx((1.0, 0.0, 0.0))
    a.beliefs.set_frozen(False)
    assert a.believed().w != before.w


def test_an_outage_keeps_the_last_belief_and_ends() -> None:
    a, plain = airframe(), airframe()
    advance(a, 100)
    last, inner = a.believed(), a.inner_state()
    a.beliefs.set_outage(True)
    assert not a.beliefs.available
    advance(a, 100)
    assert a.believed() == last
    assert a.inner_state()[:3] == inner[:3]
    a.beliefs.set_outage(False)
    assert a.beliefs.available
    advance(plain, 200)
    assert a.believed() == plain.believed()
    assert a.truth() == plain.truth()


@pytest.mark.parametrize("factor", [0.0, 1.0, 30.0])
def test_noise_is_scaled(factor: float) -> None:
    noisy, silent = airframe(vehicle()), airframe()
    noisy.beliefs.set_noise_factor(factor)
    errors = []
    for _ in range(1500):
        advance(noisy, 5)
        advance(silent, 5)
        errors.append(moved(noisy.believed().p, silent.believed().p))
    assert np.array(errors).std() == pytest.approx(0.002 * factor, rel=0.05)


def stamps(a: Airframe, steps: int) -> list[int]:
    seen = []
    for _ in range(steps):
        a.advance(rates(NOTHING), False, 1)
        seen.append(a.believed().t_us)
    return seen


def test_a_delay_holds_the_stamps_for_as_long_as_it_rose_and_they_never_go_back() -> None:
    a, plain = airframe(), airframe()
    advance(a, 100)
    first = a.believed()
    a.beliefs.set_delay_s(0.1)
    assert a.believed() == first
    seen = stamps(a, 50)
    assert seen == [first.t_us] * 50
    assert stamps(a, 10) == [first.t_us + 2000 * (k + 1) for k in range(10)]
    # The numbers are those of the stamp.
    late = a.believed()
    advance(plain, 110)
    assert late.t_us == plain.believed().t_us
    assert late.p == pytest.approx(plain.believed().p, abs=1e-3)
    a.beliefs.set_delay_s(0.05)
    assert a.believed().t_us == a.t_us - 70_000
    a.beliefs.set_delay_s(0.2)
    assert a.believed().t_us == a.t_us - 70_000
    a.beliefs.set_delay_s(None)
    assert a.believed().t_us == a.t_us - 20_000
    assert not a.beliefs.active


@pytest.mark.parametrize(("rate_hz", "period_us"), [(50.0, 20_000), (30.0, 34_000), (1000.0, 2000)])
def test_a_lower_rate_repeats_estimates_on_its_own_grid(rate_hz: float, period_us: int) -> None:
    a = airframe()
    advance(a, 100)
    first = a.believed().t_us
    a.beliefs.set_rate_hz(rate_hz)
    assert a.believed().t_us == first
    seen = stamps(a, 1000)
    changes = [t for t, before in zip(seen, [first, *seen[:-1]], strict=True) if t != before]
    assert changes[0] == first + period_us
    assert len(changes) == pytest.approx(2.0 * min(rate_hz, 500.0), abs=1.0)
    assert seen == sorted(seen)
    a.beliefs.set_rate_hz(None)
    assert a.believed().t_us == a.t_us - 20_000


@pytest.mark.parametrize("steps_ahead", [0, 3])
def test_a_repeated_estimate_is_the_same_and_the_walk_is_that_of_its_stamp(steps_ahead: int) -> None:
    a = airframe(noiseless(state_age_s=0.02, **WALKING))
    advance(a, 100)
    a.beliefs.set_rate_hz(2.0)
    advance(a, 300)
    seen = {a.believed(steps_ahead)}
    for _ in range(20):
        advance(a, 5)
        seen.add(a.believed(steps_ahead))
    assert len(seen) == 1


@pytest.mark.parametrize("steps_ahead", [0, 5])
def test_bad_numbers_are_sent_but_not_flown_on(steps_ahead: int) -> None:
    a = airframe()
    advance(a, 100)
    whole = a.believed(steps_ahead)
    a.beliefs.set_bad_numbers("nan")
    b = a.believed(steps_ahead)
    assert b.t_us == whole.t_us
    assert all(math.isnan(x) for part in b[1:] for x in part)
    assert a.inner_state() == a.rigid
    a.beliefs.set_bad_numbers("zero_quaternion")
    assert a.believed(steps_ahead) == whole._replace(q=(0.0, 0.0, 0.0, 0.0))
    a.beliefs.set_bad_numbers("stamp_back")
    assert a.believed(steps_ahead) == whole._replace(t_us=whole.t_us - STAMP_BACK_US)
    a.beliefs.set_bad_numbers(None)
    assert a.believed(steps_ahead) == whole


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda b: b.reset((math.nan, 0.0, 0.0), NOTHING, 0.0), "reset: nan"),
        (lambda b: b.set_noise_factor(-1.0), "noise factor -1.0: must be 0 or more"),
        (lambda b: b.set_noise_factor(math.inf), "noise factor: inf: must be finite"),
        (lambda b: b.set_delay_s(11.0), "delay 11.0 s: must be 0 to 10"),
        (lambda b: b.set_delay_s(math.nan), "delay nan s"),
        (lambda b: b.set_rate_hz(0.0), "rate 0.0 Hz: must be 0.1 or more"),
        (lambda b: b.set_drift(NOTHING, math.inf), "drift: .*inf"),
        (lambda b: b.set_bad_numbers("odd"), "'odd': must be one of nan, zero_quaternion, stamp_back"),
    ],
)
def test_what_cannot_be_is_refused(call: Callable[[Beliefs], None], words: str) -> None:
    a = airframe()
    with pytest.raises(ValueError, match=words):
        call(a.beliefs)
    assert not a.beliefs.active
    assert a.beliefs.version == 0


# Determinism


LEANING = Setpoint(ATTITUDE, 0.5, NOTHING, exponential((0.1, -0.05, 1.5)), 0.0, NOTHING)


def everything(a: Airframe, per_call: int, asks: bool, setpoint: Setpoint = LEANING) -> list[Estimate]:
    """Set everything at its time; return what is believed every tenth step."""
    b = a.beliefs
    plan: dict[int, Callable[[], None]] = {
        50: lambda: b.set_drift((0.3, 0.2, -0.1), 0.05),
        100: lambda: b.set_delay_s(0.03),
        150: lambda: b.reset((1.0, 0.0, -1.0), (0.1, 0.0, 0.0), 0.2),
        200: lambda: b.set_rate_hz(40.0),
        300: lambda: b.set_noise_factor(5.0),
        350: lambda: b.set_delay_s(None),
        400: lambda: b.set_frozen(True),
        450: lambda: b.set_rate_hz(None),
        500: lambda: b.set_frozen(False),
        550: lambda: b.set_outage(True),
        600: lambda: b.set_outage(False),
    }
    seen = []
    for step in range(0, 800, per_call):
        if step in plan:
            plan[step]()
        a.advance(setpoint, setpoint is LEANING, per_call)
        if asks:
            a.believed()
            a.believed(min(3, a.age_steps))
            a.inner_state()
        if (step + per_call) % 10 == 0:
            seen.append(a.believed())
    return seen


def test_beliefs_do_not_depend_on_who_asks_or_how_the_steps_are_divided() -> None:
    craft = vehicle(**WALKING)
    often = everything(airframe(craft), 2, True)
    assert often == everything(airframe(craft), 2, False)
    assert often == everything(airframe(craft), 2, True)
    assert often != everything(airframe(craft, seed=6), 2, True)
    turning = rates((0.2, -0.1, 0.3))
    assert everything(airframe(craft), 1, True, turning) == everything(airframe(craft), 10, False, turning)


def test_the_array_engine_gives_the_same_beliefs_to_the_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    craft = vehicle(**WALKING)
    plain = everything(airframe(craft), 5, False)
    monkeypatch.setattr(engines, "compile_kernel", lambda function: function)
    monkeypatch.setattr(engines, "available", lambda: True)
    assert everything(airframe(craft, "auto"), 5, False) == plain


@pytest.mark.numba
def test_the_compiled_engine_gives_the_same_beliefs() -> None:
    craft = vehicle(**WALKING)
    plain, compiled = (everything(airframe(craft, engine), 5, False) for engine in ("python", "numba"))
    flat = [[x for e in seen for part in e[1:] for x in part] for seen in (plain, compiled)]
    assert flat[1] == pytest.approx(flat[0], rel=1e-12, abs=1e-12)
    assert [e.t_us for e in plain] == [e.t_us for e in compiled]


def test_what_is_ahead_is_what_comes() -> None:
    a = airframe(vehicle(**WALKING))
    a.beliefs.set_drift((0.3, 0.2, -0.1), 0.05)
    a.beliefs.set_delay_s(0.014)
    a.beliefs.set_rate_hz(70.0)
    for _ in range(100):
        ahead = a.believed(5)
        advance(a, 5)
        assert a.believed() == ahead


# The walk


def walk(seed: int = 1, constant_s: float = 0.0) -> BiasWalk:
    return BiasWalk(WalkSigmas(0.5, 0.2, 0.03, 0.001, constant_s), seed=seed, start_us=1_000_000)


def test_walk_has_the_stated_intensity() -> None:
    ends = [w.at(1_000_000 + 4_000_000) for w in map(walk, range(400))]
    scaled = np.array([[*b.p, *b.v, b.yaw, *b.w] for b in ends]) / [0.5] * 1.0
    sigma = 2.0 * np.array([0.5] * 3 + [0.2] * 3 + [0.03] + [0.001] * 3) / 0.5
    assert scaled.std(axis=0) == pytest.approx(sigma, rel=0.12)
    assert (np.abs(scaled.mean(axis=0)) / sigma).max() < 0.16


def test_walk_with_a_time_constant_stays_near_zero() -> None:
    w = walk(constant_s=0.5)
    p = np.array([w.at(1_000_000 + KNOT_US * k).p for k in range(20, 6000)])
    assert p.std() == pytest.approx(0.5 * math.sqrt(0.5 / 2.0), rel=0.06)
    lag = round(0.5e6 / KNOT_US)
    assert np.mean(p[lag:] * p[:-lag]) / np.mean(p * p) == pytest.approx(math.exp(-1.0), abs=0.06)


def test_walk_is_a_function_of_seed_and_time_alone() -> None:
    times = [1_000_000 + 37_000 * k for k in range(0, 3000, 7)]
    forward = walk()
    expected = [forward.at(t) for t in times]
    backward = walk()
    assert [backward.at(t) for t in reversed(times)] == expected[::-1]
    assert walk().at(times[-1]) == expected[-1] != walk(seed=2).at(times[-1])
    assert walk().at(0) == walk().at(1_000_000) == (NOTHING, NOTHING, 0.0, NOTHING)


def test_walk_is_continuous_over_knots_and_blocks() -> None:
    w = walk()
    for knot in (1, BLOCK_KNOTS, 3 * BLOCK_KNOTS):
        t = 1_000_000 + KNOT_US * knot
        before, at, after = w.at(t - 1), w.at(t), w.at(t + 1)
        assert before.p == pytest.approx(at.p, abs=1e-4)
        assert after.p == pytest.approx(at.p, abs=1e-4)


def test_the_vehicle_file_s_walk_is_believed_and_flown_on() -> None:
    craft = noiseless(state_age_s=0.02, **WALKING)
    a, plain = airframe(craft), airframe()
    advance(a, 1000)
    advance(plain, 1000)
    error = moved(a.believed().p, plain.believed().p)
    assert 0.01 < math.hypot(*error) < 3.0
    assert moved(a.inner_state().p, plain.rigid.p) == pytest.approx(error, abs=0.1)
    assert a.believed().w != plain.believed().w
    assert a.rigid == plain.rigid


# What the autopilot makes of it


def test_an_attitude_is_meant_in_the_believed_frame() -> None:
    turned, plain = airframe(), airframe()
    turned.beliefs.reset(NOTHING, NOTHING, 0.5)
    wanted = exponential((0.0, -0.2, 0.0))
    for a in (turned, plain):
        for _ in range(400):
            a.advance(Setpoint(ATTITUDE, 0.5, NOTHING, wanted, 0.0, NOTHING), True, 5)
    assert turned.believed().q == pytest.approx(plain.believed().q, abs=2e-3)
    assert math.remainder(yaw_of(turned.rigid.q) - yaw_of(plain.rigid.q), math.tau) == pytest.approx(-0.5, abs=0.01)


def in_air(**options: object) -> Vehicle:
    quiet = {f"noise_{n}": 0.0 for n in ("position_m", "velocity_m_s", "attitude_rad", "rate_rad_s")}
    file = load("paper").__class__(**{**vars(load("paper")), "state_rate_hz": 50.0, **quiet})
    made = Vehicle(VehicleOptions(vehicle=file, start=((0.0, 0.0, -20.0), 0.3), engine="python", **options))  # type: ignore[arg-type]
    made.companion.set_interval(ID_ODOMETRY, 1, made.t_us)
    return made


def run(v: Vehicle, seconds: float) -> None:
    for _ in range(round(seconds * 1e6 / v.period_us)):
        v.tick()
        v.ground.outbox.clear()


def test_hold_flies_smoothly_to_where_it_now_believes_its_point_to_be() -> None:
    v = in_air()
    run(v, 1.0)
    v.airframe.beliefs.reset((3.0, 0.0, 1.0), NOTHING, 0.0)
    fastest = 0.0
    for _ in range(60):
        run(v, 0.2)
        fastest = max(fastest, math.hypot(*v.airframe.rigid.v))
    assert v.airframe.rigid.p == pytest.approx((-3.0, 0.0, -21.0), abs=0.15)
    assert v.airframe.believed().p == pytest.approx((0.0, 0.0, -20.0), abs=0.15)
    assert 0.5 < fastest < 3.0


def test_hold_does_not_turn_for_a_heading_reset_nor_jerk_for_a_velocity_reset() -> None:
    v = in_air()
    run(v, 1.0)
    yaw = yaw_of(v.airframe.rigid.q)
    v.airframe.beliefs.reset(NOTHING, NOTHING, 0.6)
    run(v, 4.0)
    assert yaw_of(v.airframe.rigid.q) == pytest.approx(yaw, abs=0.01)
    assert v.airframe.rigid.p == pytest.approx((0.0, 0.0, -20.0), abs=0.05)
    # A velocity that is off by as much makes it fly off until the point it holds calls it back.
    v.airframe.beliefs.reset(NOTHING, (0.5, 0.0, 0.0), 0.0)
    run(v, 0.02)
    w, x, y, z = v.autopilot.held.q
    assert 0.05 < math.acos(w * w - x * x - y * y + z * z) < 0.12, "the jump is no acceleration"
    run(v, 1.0)
    assert v.airframe.rigid.v[0] < -0.1


def test_hold_follows_a_drift() -> None:
    v = in_air()
    v.airframe.beliefs.set_drift((0.0, 0.4, 0.0), 0.0)
    run(v, 10.0)
    assert v.airframe.rigid.p[1] == pytest.approx(-4.0, abs=0.6)
    assert v.airframe.inner_state().p[1] == pytest.approx(0.0, abs=0.6)


def test_an_outage_is_bridged_for_a_second_then_the_vehicle_descends_blindly_and_comes_back() -> None:
    v = in_air()
    run(v, 1.0)
    v.airframe.beliefs.set_outage(True)
    run(v, 0.9)
    assert v.autopilot.mode is Mode.HOLD
    assert v.autopilot.set_mode(Mode.RETURN) is Result.ACCEPTED
    assert v.autopilot.set_mode(Mode.HOLD) is Result.ACCEPTED
    run(v, 0.4)
    assert v.autopilot.mode is Mode.DESCEND
    assert v.autopilot.in_failsafe
    assert v.autopilot.intended is Mode.HOLD
    assert v.autopilot.set_mode(Mode.RETURN) is Result.TEMPORARILY_REJECTED
    run(v, 2.0)
    assert v.airframe.rigid.v[2] == pytest.approx(0.6, abs=0.3)
    assert abs(v.airframe.rigid.q[1]) + abs(v.airframe.rigid.q[2]) < 0.01
    v.airframe.beliefs.set_outage(False)
    run(v, 0.2)
    assert v.autopilot.mode is Mode.HOLD
    assert not v.autopilot.in_failsafe
    run(v, 6.0)
    assert math.hypot(*v.airframe.rigid.v) < 0.1


def test_a_short_outage_is_no_failsafe() -> None:
    v = in_air()
    for _ in range(3):
        v.airframe.beliefs.set_outage(True)
        run(v, 0.8)
        v.airframe.beliefs.set_outage(False)
        run(v, 0.4)
        assert v.autopilot.mode is Mode.HOLD
    assert v.airframe.rigid.p == pytest.approx((0.0, 0.0, -20.0), abs=0.1)


def test_with_sticks_position_falls_back_to_stabilized_and_sticks_take_over_into_it() -> None:
    v = in_air()
    autopilot: Autopilot = v.autopilot
    autopilot.manual_control()
    assert autopilot.set_mode(Mode.POSITION) is Result.ACCEPTED
    v.airframe.beliefs.set_outage(True)
    for _ in range(7):
        run(v, 0.2)
        autopilot.manual_control()
    assert autopilot.mode is Mode.STABILIZED
    assert autopilot.set_mode(Mode.STABILIZED) is Result.ACCEPTED
    assert autopilot.set_mode(Mode.POSITION) is Result.TEMPORARILY_REJECTED


def test_no_arming_without_an_estimate() -> None:
    v = Vehicle(VehicleOptions(vehicle=load("paper"), engine="python"))
    assert v.autopilot.ready_to_arm
    v.airframe.beliefs.set_outage(True)
    run(v, 1.2)
    assert not v.autopilot.ready_to_arm
    assert v.autopilot.arm() is Result.TEMPORARILY_REJECTED
    v.airframe.beliefs.set_outage(False)
    run(v, 0.1)
    assert v.autopilot.arm() is Result.ACCEPTED


# What is sent


def fields(payload: bytes) -> tuple[object, ...]:
    """Return the fields of an ODOMETRY message."""
    size = ODOMETRY_STATE.size
    rest = payload[size:].ljust(ODOMETRY_REST.size, b"\0")
    return ODOMETRY_STATE.unpack(payload[:size]) + ODOMETRY_REST.unpack(rest)


def odometry(v: Vehicle, ticks: int) -> list[list[tuple[object, ...]]]:
    """Return the fields of the ODOMETRY messages of each tick."""
    out = []
    for _ in range(ticks):
        v.companion.outbox.clear()
        v.tick()
        found = [frame for raw in v.companion.outbox for frame in frames(raw) if frame.msg_id == ID_ODOMETRY]
        out.append([fields(frame.payload) for frame in found])
    return out


def test_repeated_estimates_are_not_sent_again_and_slower_streams_lose_nothing() -> None:
    v = in_air()
    run(v, 0.2)
    v.airframe.beliefs.set_rate_hz(5.0)
    sent = [m for tick in odometry(v, 100) for m in tick]
    times = [m[0] for m in sent]
    assert len(times) == len(set(times)) == 10
    # A stream that is due between two estimates comes with the next one.
    v.companion.set_interval(ID_ODOMETRY, 90_000, v.t_us)
    assert sum(map(len, odometry(v, 100))) == 10
    v.airframe.beliefs.set_rate_hz(None)
    v.companion.set_interval(ID_ODOMETRY, 1, v.t_us)
    assert sum(map(len, odometry(v, 20))) == 20


def test_the_state_message_carries_jump_and_counter_together_and_nothing_in_an_outage() -> None:
    v = in_air()
    run(v, 0.2)
    before = odometry(v, 3)[-1][0]
    v.airframe.beliefs.reset((2.0, 0.0, 0.0), NOTHING, 0.0)
    after = odometry(v, 1)[0][0]
    assert after[-3] == before[-3] + 1  # type: ignore[operator]
    assert after[1] == pytest.approx(before[1] + 2.0, abs=0.01)  # type: ignore[operator]
    v.airframe.beliefs.set_outage(True)
    assert odometry(v, 5) == [[]] * 5
    v.airframe.beliefs.set_outage(False)
    assert all(len(tick) == 1 for tick in odometry(v, 5))


def test_every_message_can_be_built_with_bad_numbers_and_in_an_outage() -> None:
    v = in_air()
    run(v, 0.2)
    for kind in ("nan", "zero_quaternion", "stamp_back", None):
        v.airframe.beliefs.set_bad_numbers(kind)
        v.airframe.beliefs.set_outage(kind is None)
        run(v, 0.1)
        for msg_id in list(v.telemetry.builders):
            content = v.telemetry.build(msg_id)
            assert content is None or isinstance(content, bytes) or content.pack(v.companion.encoder._mav)


def test_level_is_level_for_a_vehicle_that_starts_level() -> None:
    assert airframe().inner_state().q == pytest.approx(multiply(exponential((0.0, 0.0, 0.8)), LEVEL))
