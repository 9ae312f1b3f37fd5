"""Plans through waypoints: what they pass, limits, near-shortest durations, headings, and what is refused."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from waypoint_cases import LIMITS, cost, dense_cost, points, turning_limits, with_demands

from companion.config import load_vehicle
from companion.control.types import Reference
from companion.errors import InputError, RefusedError
from companion.trajectory.allocation import Allocation
from companion.trajectory.anchored import Trajectory, anchored
from companion.trajectory.batch import Batch, batch, quantities, torque_uses, uses
from companion.trajectory.feasibility import check
from companion.trajectory.load import load
from companion.trajectory.minimum_snap import Knots, basis, solve
from companion.trajectory.piecewise import Piecewise
from companion.trajectory.planner import _knots, _refuse_excess
from companion.trajectory.waypoints import PlanLimits, Waypoint, plan, plan_limits

CALM = replace(LIMITS, wind_m_s=0.0)


def dense_times(shape: Piecewise, per_piece: int = 60) -> np.ndarray:
    knots = np.array(shape.knots_s)
    fractions = np.linspace(0.0, 1.0, per_piece, endpoint=False)
    return np.append((knots[:-1, None] + fractions * np.diff(knots)[:, None]).ravel(), knots[-1])


def largest_use(shape: Piecewise, limits: PlanLimits) -> float:
    """Of any limit at dense samples, torque included, in still air."""
    found = batch(shape, dense_times(shape).tolist())
    most = float(uses(quantities(found, limits.model), limits.reference).max())
    if limits.body is not None:
        most = max(most, float(torque_uses(found, limits.model, limits.body).max()))
    return most


@given(seed=st.integers(0, 10_000), count=st.integers(2, 10))
@settings(max_examples=6, deadline=None)
def test_plans_are_smooth_pass_the_check_and_cost_the_least(seed: int, count: int) -> None:
    waypoints = with_demands(seed, points(seed, count))
    shape = plan(waypoints, LIMITS)
    placed = anchored(Trajectory(name="plan", shape=shape, duration_s=shape.own_duration_s), (0.0, 0.0, -9.0), None)
    assert check(placed, LIMITS.reference, LIMITS.model) == []
    assert largest_use(shape, LIMITS) <= 1.0 + 1e-6
    rows = np.array([w.p_m for w in waypoints]).T
    assert cost(shape) == pytest.approx(dense_cost(_knots(waypoints, rows), np.diff(shape.knots_s)), rel=1e-8)
    largest = [max(abs(x) for joint in shape.joints() for x in joint.before[k]) if count > 2 else 1.0 for k in range(5)]
    for joint in shape.joints():
        for k in range(5):
            assert math.dist(joint.before[k], joint.after[k]) <= 1e-9 * max(largest[k], 1.0)
    for t_s, waypoint in zip(shape.knots_s, waypoints, strict=True):
        reference = shape.at(t_s)
        assert reference.p == pytest.approx(waypoint.p_m, abs=1e-9)
        if waypoint.speed_m_s is not None:
            assert math.hypot(*reference.v) == pytest.approx(waypoint.speed_m_s, rel=1e-9)
        if waypoint.stop or t_s in (0.0, shape.own_duration_s):
            assert [x for derivative in reference[1:5] for x in derivative] == pytest.approx([0.0] * 12, abs=1e-7)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_limits_just_hold(seed: int) -> None:
    assert 0.995 <= largest_use(plan(points(seed, 6), CALM), CALM) <= 1.0 + 1e-6


@pytest.mark.parametrize(
    "tighter",
    [
        {"speed_max_m_s": 1.0},
        {"acceleration_max_m_s2": 1.0},
        {"tilt_max_rad": 0.2},
        {"thrust_max_n": 10.5},
        {"thrust_min_n": 9.2},
        {"rate_max_rad_s": 0.3},
    ],
)
def test_every_limit_is_kept_and_reached(tighter: dict[str, float]) -> None:
    limits = replace(CALM, reference=replace(CALM.reference, **tighter))
    assert 0.995 <= largest_use(plan(points(4, 5), limits), limits) <= 1.0 + 1e-6


def test_torque_is_kept_where_it_is_what_there_is_least_of() -> None:
    assert CALM.body is not None
    weak = replace(CALM, body=CALM.body._replace(inertia_kg_m2=1.0))
    strong, slow = plan(points(4, 5), CALM), plan(points(4, 5), weak)
    assert largest_use(strong, weak) > 1.05
    assert largest_use(slow, weak) <= 1.0 + 1e-6
    assert strong.own_duration_s < slow.own_duration_s


def test_wind_from_any_side_is_left_room_for() -> None:
    windy = replace(CALM, reference=replace(CALM.reference, tilt_max_rad=0.4, thrust_max_n=13.0))
    limits = replace(windy, wind_m_s=3.0)
    shape = plan(points(5, 6), limits)
    times = dense_times(shape, 30).tolist()
    found = batch(shape, times)
    assert shape.own_duration_s > 1.05 * plan(points(5, 6), windy).own_duration_s
    rng = np.random.default_rng(0)
    worst = 0.0
    for _ in range(200):
        side = rng.normal(size=3)
        wind = 3.0 * side / np.linalg.norm(side)
        # Air that moves along drags along: v' = g u3 - (T/m) r3 - D (v - wind), so that T r3 / m gains D wind.
        pushed = found._replace(a=found.a - limits.model.drag_1_s * wind[:, None])
        rows = uses(quantities(pushed, limits.model), limits.reference)[2:6]
        worst = max(worst, float(rows.max()))
    assert 0.95 <= worst <= 1.0 + 1e-6


def scaled_total(durations_s: np.ndarray, knots: Knots) -> float:
    """The duration of these proportions, times the factor with which the limits just hold."""
    y = solve(knots, durations_s).local()
    v, a, j = ((basis(4).values(k, np.linspace(0.0, 1.0, 60)) @ y / durations_s**k).reshape(3, -1) for k in (1, 2, 3))
    zero = np.zeros_like(v)

    def too_fast(factor: float) -> bool:
        slower = Batch(zero, v / factor, a / factor**2, j / factor**3, zero, zero)
        return bool(uses(quantities(slower, CALM.model), CALM.reference).max() > 1.0)

    low, high = 0.01, 100.0
    for _ in range(20):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if too_fast(middle) else (low, middle)
    return float(durations_s.sum()) * high


@pytest.mark.parametrize(("seed", "count"), [(1, 3), (7, 4), (4, 5)])
def test_duration_is_near_that_of_a_direct_search(seed: int, count: int) -> None:
    waypoints = points(seed, count)
    shape = plan(waypoints, CALM)
    knots = _knots(waypoints, np.array([w.p_m for w in waypoints]).T)
    best = math.inf
    for start in (np.diff(shape.knots_s), np.linalg.norm(knots.steps, axis=0)):
        found = minimize(
            lambda z: scaled_total(np.exp(z), knots), np.log(start), method="Nelder-Mead", options={"maxfev": 100}
        )
        best = min(best, found.fun)
    assert shape.own_duration_s <= 1.02 * best


def test_a_close_pair_between_far_points_does_no_harm() -> None:
    waypoints = [
        Waypoint((0.0, 0.0, 0.0)),
        Waypoint((60.0, 0.0, 0.0)),
        Waypoint((60.02, 0.0, 0.0)),
        Waypoint((90.0, 9.0, 0.0)),
    ]
    shape = plan(waypoints, LIMITS)
    assert largest_use(shape, LIMITS) <= 1.0 + 1e-6
    rows = np.array([w.p_m for w in waypoints])
    assert np.array([shape.at(t).p for t in shape.knots_s]) == pytest.approx(rows, abs=1e-9)


def test_hundreds_of_waypoints() -> None:
    told: list[float] = []
    shape = plan(points(9, 300), LIMITS, progress=told.append)
    assert largest_use(shape, LIMITS) <= 1.0 + 1e-6
    assert told == sorted(told)
    assert (told[-1], len(shape.pieces)) == (1.0, 299)


def test_the_same_plan_again() -> None:
    waypoints = with_demands(6, points(6, 7))
    assert plan(waypoints, LIMITS) == plan(waypoints, LIMITS)


def test_velocity_is_kept_and_a_speed_goes_along_the_circle() -> None:
    waypoints = [
        Waypoint((0.0, 0.0, 0.0)),
        Waypoint((5.0, 0.0, -1.0), velocity_m_s=(1.0, 0.5, -0.25)),
        Waypoint((10.0, 5.0, 0.0), speed_m_s=1.2),
        Waypoint((10.0, 10.0, 0.0)),
    ]
    shape = plan(waypoints, LIMITS)
    assert shape.at(shape.knots_s[1]).v == pytest.approx((1.0, 0.5, -0.25), abs=1e-9)
    v = shape.at(shape.knots_s[2]).v
    assert math.hypot(*v) == pytest.approx(1.2, rel=1e-9)
    before, here, after = (np.array(w.p_m) for w in waypoints[1:])
    # The tangent makes the angle with each chord that the other chord is seen under.
    angle_in = math.acos(np.dot(here - before, v) / np.linalg.norm(here - before) / 1.2)
    angle_out = math.acos(np.dot(after - here, v) / np.linalg.norm(after - here) / 1.2)
    chord = after - before
    seen = math.acos(np.dot(after - here, chord) / np.linalg.norm(after - here) / np.linalg.norm(chord))
    assert angle_in == pytest.approx(seen, abs=1e-6)
    assert angle_in / angle_out == pytest.approx(
        seen / (math.acos(np.dot(here - before, after - here) / np.linalg.norm(here - before) / 5.0) - seen), rel=1e-6
    )


def turned(waypoints: list[Waypoint], degrees: list[float | None]) -> list[Waypoint]:
    pairs = zip(waypoints, degrees, strict=True)
    return [w if yaw is None else replace(w, yaw_rad=math.radians(yaw)) for w, yaw in pairs]


def test_headings_are_reached_by_the_shorter_turn_and_smooth() -> None:
    waypoints = turned(points(8, 6), [None, 170.0, None, -170.0, 0.0, None])
    limits = turning_limits(0.5)
    shape = plan(waypoints, limits)
    placed = anchored(Trajectory(name="plan", shape=shape, duration_s=shape.own_duration_s), (0.0, 0.0, 0.0), None)
    assert check(placed, limits.reference, limits.model) == []
    headings = [math.degrees(shape.at(t).yaw) for t in shape.knots_s]
    assert [headings[i] for i in (0, 1, 3, 4, 5)] == pytest.approx([170.0, 170.0, 190.0, 360.0, 360.0], abs=1e-6)
    times = dense_times(shape)
    yaw = batch(shape, times.tolist()).yaw
    assert 0.99 * 0.5 <= np.abs(yaw[1]).max() <= 0.5 * (1.0 + 1e-6)
    for knot in shape.yaw_knots_s:
        a, b = (shape.at(knot + side) for side in (-1e-9, 1e-9))
        assert (a.yaw, a.yaw_rate, a.yaw_acceleration) == pytest.approx(
            (b.yaw, b.yaw_rate, b.yaw_acceleration), abs=1e-6
        )
    assert plan(waypoints, LIMITS).own_duration_s < shape.own_duration_s


def test_one_heading_or_none_stays() -> None:
    waypoints = points(8, 4)
    assert plan(waypoints, LIMITS, yaw_rad=0.4).at(1.0)[5:] == (0.4, 0.0, 0.0)
    assert plan(turned(waypoints, [None, 20.0, None, None]), LIMITS).at(0.0).yaw == pytest.approx(math.radians(20.0))


def test_nose_along_the_path() -> None:
    angles = np.linspace(0.0, 2.0 * math.pi, 25)
    circle = [Waypoint((8.0 * math.cos(a), 8.0 * math.sin(a), -3.0)) for a in angles]
    limits = turning_limits(2.0)
    shape = plan(circle, limits, heading="path")
    off = []
    for t_s in np.linspace(0.15, 0.85, 200) * shape.own_duration_s:
        reference: Reference = shape.at(t_s)
        off.append(math.remainder(reference.yaw - math.atan2(reference.v[1], reference.v[0]), math.tau))
    assert max(map(abs, off)) < 0.05
    assert shape.at(shape.own_duration_s).yaw - shape.at(0.0).yaw == pytest.approx(math.tau, abs=0.5)  # never wrapped
    assert largest_use(shape, limits) <= 1.0 + 1e-6


def test_straight_up_along_the_path_keeps_the_heading() -> None:
    up = [Waypoint((0.0, 0.0, 0.0)), Waypoint((0.0, 0.0, -5.0))]
    assert plan(up, turning_limits(1.0), heading="path", yaw_rad=0.7).at(1.0)[5:] == (0.7, 0.0, 0.0)


A, B, C = Waypoint((0.0, 0.0, 0.0)), Waypoint((5.0, 0.0, 0.0)), Waypoint((5.0, 5.0, 0.0))


@pytest.mark.parametrize(
    ("waypoints", "limits", "message"),
    [
        ([], LIMITS, "waypoint: 0 given, a path takes at least 2"),
        ([A], LIMITS, "waypoint: 1 given"),
        ([A, B, B], LIMITS, "waypoint.2.p_m = [5.0, 0.0, 0.0]: the same point as waypoint.1"),
        (
            [A, replace(B, p_m=(math.nan, 0.0, 0.0)), C],
            LIMITS,
            "waypoint.1.p_m = [nan, 0.0, 0.0]: must be three numbers",
        ),
        ([A, replace(B, p_m=(0.0, 2e6, 0.0)), C], LIMITS, "waypoint.1.p_m"),
        ([A, replace(B, yaw_rad=math.inf), C], LIMITS, "waypoint.1.yaw_rad = inf: must be a number"),
        ([A, replace(B, speed_m_s=0.0), C], LIMITS, "waypoint.1.speed_m_s = 0.0: must be above zero"),
        ([A, replace(B, speed_m_s=7.0), C], LIMITS, "waypoint.1.speed_m_s = 7.0: faster than the limit of 6 m/s"),
        ([A, replace(B, velocity_m_s=(5.0, 5.0, 0.0)), C], LIMITS, "waypoint.1.velocity_m_s = [5.0, 5.0, 0.0]: faster"),
        ([A, replace(B, velocity_m_s=(math.nan, 0.0, 0.0)), C], LIMITS, "waypoint.1.velocity_m_s = [nan"),
        ([A, replace(B, speed_m_s=1.0, stop=True), C], LIMITS, "waypoint.1: speed_m_s and stop exclude each other"),
        ([replace(A, speed_m_s=1.0), B], LIMITS, "waypoint.0.speed_m_s = 1.0: a path begins and ends at rest"),
        ([A, replace(B, speed_m_s=1.0), A], LIMITS, "waypoint.1.speed_m_s: the path turns back there"),
        ([A, B], replace(LIMITS, wind_m_s=-1.0), "limits.wind_m_s = -1.0"),
    ],
)
def test_wrong_waypoints(waypoints: list[Waypoint], limits: PlanLimits, message: str) -> None:
    with pytest.raises(InputError) as caught:
        plan(waypoints, limits)
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)


def test_a_speed_that_no_durations_allow_is_refused() -> None:
    found = Allocation(np.ones(2), np.array([0.1, 0.2]))
    with pytest.raises(RefusedError, match=r"^waypoint\.1: no durations .* waypoint\.1 and waypoint\.2: .* by 20 %"):
        _refuse_excess(found, [A, replace(B, speed_m_s=5.0), C])
    _refuse_excess(Allocation(np.ones(2), np.array([-0.1, 1e-7])), [A, B, C])


def test_a_wind_in_which_it_cannot_rest_is_refused() -> None:
    with pytest.raises(RefusedError, match=r"resting in a wind of 30 m/s alone exceeds that of .*tilt.*wind_m_s"):
        plan([A, B], replace(LIMITS, wind_m_s=30.0))


def test_the_bundled_file() -> None:
    vehicle = load_vehicle("bundled")
    trajectory = load("waypoints", vehicle=vehicle)
    limits = plan_limits(vehicle)
    assert check(anchored(trajectory, (0.0, 0.0, -9.0), None), limits.reference, limits.model) == []
    assert trajectory.duration_s == pytest.approx(21.0, abs=1.0)
    shape = trajectory.shape
    assert isinstance(shape, Piecewise)
    assert math.hypot(*shape.at(shape.knots_s[1]).v) == pytest.approx(1.5)
    assert shape.at(shape.knots_s[3]).v == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    assert shape.at(shape.knots_s[4]).v == pytest.approx((-1.0, -1.0, 0.0))
