"""The gate for references: flatness, limits, and derivatives that are wrong or jump."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.control.types import Reference
from companion.trajectory.anchored import Trajectory, anchored
from companion.trajectory.feasibility import ViolationName, check
from companion.trajectory.flatness import PointMass, ReferenceLimits, demand
from companion.trajectory.pieces import chain
from companion.trajectory.shapes import Circle, Heading, Helix, Hover, Joint, Lemniscate, Line, Lissajous

LIMITS = ReferenceLimits(12.0, 10.0, 1.25, 9.0, 80.0, 6.0)
MODEL = PointMass(4.76)
ZERO = (0.0, 0.0, 0.0)


def circle(rate: float, radius_m: float = 5.0, time_scale: float = 1.0) -> Trajectory:
    shape = Circle(radius_m=radius_m, angular_rate_rad_s=rate)
    return Trajectory(name="c", shape=shape, duration_s=20.0, time_scale=time_scale)


def test_demand_of_a_hover_and_of_a_turn() -> None:
    assert demand(Hover().at(0.0), MODEL) == pytest.approx((4.76 * 9.81, 0.0, 0.0, 0.0))
    # A level circle without drag: the thrust vector turns about the vertical at the circle's rate and at a fixed tilt.
    tilt = math.atan2(5.0 * 0.8**2, 9.81)
    found = demand(circle(0.8).at(3.0), MODEL)
    assert found.thrust_n == pytest.approx(4.76 * 9.81 / math.cos(tilt))
    assert found.tilt_rad == pytest.approx(tilt)
    assert found.rate_rad_s == pytest.approx(0.8 * math.sin(tilt))
    # The body that does not turn about its thrust axis sees its rate vector turn at the rate about that axis.
    assert found.angular_acceleration_rad_s2 == pytest.approx(0.8 * math.sin(tilt) * 0.8 * math.cos(tilt))


def test_demand_with_drag() -> None:
    steady = Reference(ZERO, (3.0, 0.0, 0.0), ZERO, ZERO, ZERO, 0.0, 0.0, 0.0)
    found = demand(steady, PointMass(2.0, 0.5, 10.0))
    assert found.thrust_n == pytest.approx(2.0 * math.hypot(10.0, 1.5))
    assert found.tilt_rad == pytest.approx(math.atan2(1.5, 10.0))


def test_demand_in_free_fall_has_no_direction() -> None:
    falling = Reference(ZERO, ZERO, (0.0, 0.0, 9.81), (1.0, 0.0, 0.0), ZERO, 0.0, 0.0, 0.0)
    found = demand(falling, MODEL)
    assert found.thrust_n == pytest.approx(0.0)
    assert found.tilt_rad == math.pi
    assert found.rate_rad_s == math.inf


numbers = st.floats(-4.0, 4.0)
vectors = st.tuples(numbers, numbers, numbers)


@settings(max_examples=60, deadline=None)
@given(vectors, vectors, vectors, vectors, st.floats(0.0, 1.0))
def test_demand_against_differences_of_the_thrust_direction(
    v: tuple[float, float, float],
    a: tuple[float, float, float],
    j: tuple[float, float, float],
    s: tuple[float, float, float],
    drag: float,
) -> None:
    def direction(t: float) -> np.ndarray:
        acceleration = np.array(a) + t * np.array(j) + t * t / 2.0 * np.array(s)
        speed = np.array(v) + t * np.array(a) + t * t / 2.0 * np.array(j) + t**3 / 6.0 * np.array(s)
        f = np.array([0.0, 0.0, 12.0]) - acceleration - drag * speed
        return f / np.linalg.norm(f)

    found = demand(Reference(ZERO, v, a, j, s, 0.0, 0.0, 0.0), PointMass(1.0, drag, 12.0))
    h = 1e-3
    before, now, after = direction(-h), direction(0.0), direction(h)
    rate = (after - before) / (2.0 * h)
    curve = (after - 2.0 * now + before) / (h * h)
    normal = curve - now * (now @ curve)
    assert found.rate_rad_s == pytest.approx(np.linalg.norm(rate), abs=1e-3)
    assert found.angular_acceleration_rad_s2 == pytest.approx(np.linalg.norm(normal), rel=1e-3, abs=2e-2)


def test_speed_is_named_with_figure_time_limit_and_a_time_scale_that_fits() -> None:
    shape = Lissajous(amplitude_m=(20.0, 0.0, 0.0), angular_rate_rad_s=(0.71, 0.0, 0.0))
    found = check(Trajectory(name="x", shape=shape, duration_s=30.0), LIMITS, MODEL)
    speeds = [v for v in found if v.name is ViolationName.SPEED]
    assert len(speeds) == 1
    assert speeds[0].value == pytest.approx(14.2)
    assert speeds[0].limit == 12.0
    assert speeds[0].sentence.startswith("speed reaches 14.2 m/s at ")
    assert "limit 12 m/s (limits.speed_max_m_s); a time scale of 0.8" in speeds[0].sentence


@pytest.mark.parametrize(
    ("limits", "name", "value", "key"),
    [
        (replace(LIMITS, speed_max_m_s=3.0), "speed", 4.0, "speed_max_m_s"),
        (replace(LIMITS, acceleration_max_m_s2=3.0), "acceleration", 3.2, "acceleration_max_m_s2"),
        (replace(LIMITS, tilt_max_rad=0.2), "tilt", math.atan2(3.2, 9.81), "tilt_max_rad"),
        (replace(LIMITS, thrust_max_n=48.0), "thrust_high", 4.76 * math.hypot(3.2, 9.81), "thrust_max_n"),
        (replace(LIMITS, thrust_min_n=50.0), "thrust_low", 4.76 * math.hypot(3.2, 9.81), "thrust_min_n"),
        (replace(LIMITS, rate_max_rad_s=0.2), "body_rate", 0.8 * math.sin(math.atan2(3.2, 9.81)), "rate_max_rad_s"),
        (replace(LIMITS, heading_rate_max_rad_s=0.3), "heading_rate", 0.4, "heading_rate_max_rad_s"),
    ],
)
def test_every_limit_is_looked_at(limits: ReferenceLimits, name: str, value: float, key: str) -> None:
    shape = Circle(radius_m=5.0, angular_rate_rad_s=0.8, heading=Heading(0.0, -0.4))
    trajectory = Trajectory(name="c", shape=shape, duration_s=20.0)
    assert check(trajectory, LIMITS, MODEL) == []
    (found,) = check(trajectory, limits, MODEL)
    assert found.name == name
    assert found.value == pytest.approx(value)
    assert f"(limits.{key})" in found.sentence
    assert "\n" not in found.sentence


def test_limit_that_no_time_scale_meets_says_so() -> None:
    (found,) = check(circle(0.1), replace(LIMITS, thrust_max_n=40.0), MODEL)
    assert found.sentence.endswith("; no time scale would fit")


@settings(max_examples=8, deadline=None)
@given(st.floats(1.0, 4.0), st.floats(1.2, 3.0), st.floats(0.0, 1.0))
def test_the_advised_time_scale_fits(rate: float, time_scale: float, drag: float) -> None:
    model = PointMass(4.76, drag)
    shape = Lissajous(amplitude_m=(6.0, 4.0, 1.0), angular_rate_rad_s=(rate, 2.0 * rate, 3.0 * rate))
    trajectory = Trajectory(name="x", shape=shape, duration_s=10.0, time_scale=time_scale)
    found = check(trajectory, LIMITS, model)
    assert found
    (advised,) = {float(v.sentence.split("a time scale of ")[1].split()[0]) for v in found}
    assert check(replace(trajectory, time_scale=advised), LIMITS, model) == []
    assert check(replace(trajectory, time_scale=1.05 * advised + 0.02), LIMITS, model) != []


def test_reference_exactly_on_its_limit_passes() -> None:
    assert check(circle(0.8), replace(LIMITS, speed_max_m_s=4.0, acceleration_max_m_s2=3.2), MODEL) == []


def test_peak_between_the_samples_is_found() -> None:
    # The phase puts the top speed halfway between two of the 400 samples of a period: 0.89997 m/s is the most they see.
    shape = Lissajous(amplitude_m=(0.1, 0.0, 0.0), angular_rate_rad_s=(9.0, 0.0, 0.0), phase_rad=(0.1178, 0.0, 0.0))
    found = check(Trajectory(name="x", shape=shape, duration_s=600.0), replace(LIMITS, speed_max_m_s=0.89999), MODEL)
    (speed,) = [v for v in found if v.name is ViolationName.SPEED]
    assert speed.value == pytest.approx(0.9, rel=1e-9)


class Doctored:
    """A trajectory whose reference is falsified."""

    period_s = None

    def __init__(self, inner: Trajectory, change: Callable[[float, Reference], Reference]) -> None:
        self.inner, self.change, self.duration_s = inner, change, inner.duration_s

    def at(self, t_s: float) -> Reference:
        return self.change(t_s, self.inner.at(t_s))

    def joints(self) -> tuple[Joint, ...]:
        return ()


EIGHT = Trajectory(
    name="eight",
    shape=Lemniscate(amplitude_m=(5.0, 2.5), angular_rate_rad_s=0.4, heading=Heading(0.0, 0.2)),
    duration_s=15.0,
)


def jump_after(field: str, size: float) -> Callable[[float, Reference], Reference]:
    """Add a step and nothing else, so that the derivatives on either side stay true."""

    def change(t: float, r: Reference) -> Reference:
        if t < 6.4321:
            return r
        value = getattr(r, field)
        stepped = value + size if isinstance(value, float) else (value[0], value[1] + size, value[2])
        return r._replace(**{field: stepped})

    return change


@pytest.mark.parametrize(
    ("field", "name", "size"),
    [
        ("p", "position", 0.01),
        ("v", "velocity", 0.001),
        ("a", "acceleration", 0.001),
        ("j", "jerk", 0.001),
        ("yaw", "yaw", 0.01),
        ("yaw_rate", "yaw_rate", 0.01),
    ],
)
def test_undeclared_jump_is_found_and_placed(field: str, name: str, size: float) -> None:
    found = check(Doctored(EIGHT, jump_after(field, size)), LIMITS, MODEL)
    jumps = [v for v in found if v.name is ViolationName.JUMP and v.sentence.startswith(f"{name} jumps by")]
    assert len(jumps) == 1
    assert jumps[0].value == pytest.approx(size, rel=0.02)
    assert jumps[0].at_s == pytest.approx(6.4321, abs=0.001)


def test_turn_of_the_heading_by_a_whole_circle_is_no_jump() -> None:
    assert check(Doctored(EIGHT, jump_after("yaw", math.tau)), LIMITS, MODEL) == []


@pytest.mark.parametrize(
    ("field", "name"),
    [("v", "velocity"), ("a", "acceleration"), ("j", "jerk"), ("s", "snap"), ("yaw_rate", "yaw_rate")],
)
def test_wrong_derivative_is_found(field: str, name: str) -> None:
    def change(t: float, r: Reference) -> Reference:
        value = getattr(r, field)
        wrong = 1.01 * value if isinstance(value, float) else tuple(1.01 * x for x in value)
        return r._replace(**{field: wrong})

    found = [v for v in check(Doctored(EIGHT, change), LIMITS, MODEL) if v.name is ViolationName.DERIVATIVE]
    assert any(v.sentence.startswith(f"{name} is not the derivative of the one below") for v in found)


def test_number_that_is_not_finite_is_found() -> None:
    def change(t: float, r: Reference) -> Reference:
        return r._replace(a=(math.nan, 0.0, 0.0)) if t > 7.0 else r

    (found,) = check(Doctored(EIGHT, change), LIMITS, MODEL)
    assert found.name is ViolationName.NOT_FINITE
    assert found.at_s == pytest.approx(7.0, abs=0.05)


def test_pieces_that_do_not_meet_are_found_at_their_joint() -> None:
    hover = Trajectory(name="h", shape=Hover(point_m=(5.0, 0.0, 0.0)), duration_s=3.0)
    found = check(chain([hover, circle(0.5)]), LIMITS, MODEL)
    sentences = [v.sentence for v in found if v.name is ViolationName.JUMP]
    assert "velocity jumps by 2.5 m/s at 3.000 s; it must be continuous" in sentences
    assert "acceleration jumps by 1.25 m/s^2 at 3.000 s; it must be continuous" in sentences
    assert "jerk jumps by 0.625 m/s^3 at 3.000 s; it must be continuous" in sentences
    assert len(sentences) == 3


class Declared(Doctored):
    """A true reference that declares a joint at its end with values that do not meet, as a lap that does not close
    would."""

    def joints(self) -> tuple[Joint, ...]:
        end = self.inner.at(self.duration_s)
        return (Joint(self.duration_s, end, end._replace(a=(end.a[0] + 0.01, end.a[1], end.a[2]))),)


def test_declared_joint_is_judged_by_its_exact_values() -> None:
    (found,) = check(Declared(EIGHT, lambda t, r: r), LIMITS, MODEL)
    assert found.name is ViolationName.JUMP
    assert found.at_s == 15.0
    assert found.value == pytest.approx(0.01)
    assert found.sentence.startswith("acceleration jumps by 0.01 m/s^2 at 15.000 s")


@pytest.mark.parametrize(
    "shape",
    [
        Hover(),
        Line(from_m=ZERO, to_m=(10.0, 3.0, -2.0), move_s=8.0, back=True),
        Line(from_m=ZERO, to_m=(0.5, 0.0, 0.0), move_s=1.0),
        Lemniscate(amplitude_m=(0.5, 0.25), angular_rate_rad_s=2.0),
        Helix(radius_m=2.0, angular_rate_rad_s=-1.0, climb_m_s=-0.3),
        Lissajous(amplitude_m=(2.0, 1.0, 0.3), angular_rate_rad_s=(0.3, 1.1, 2.3)),
    ],
)
@pytest.mark.parametrize("time_scale", [0.3, 1.0])
def test_good_shapes_pass_far_from_the_origin_too(shape: Hover, time_scale: float) -> None:
    trajectory = Trajectory(name="x", shape=shape, duration_s=25.0, time_scale=time_scale, anchor_yaw_rad=0.7)
    assert check(anchored(trajectory, (3000.0, -2000.0, -500.0), None), LIMITS, MODEL) == []
