"""A trajectory as numbers gives what the trajectory itself gives."""

import math
import random

import numpy as np
import pytest

from companion import accelerate
from companion.config import load_vehicle
from companion.control.types import Reference
from companion.flight.course import Course, Timed
from companion.trajectory.anchored import Trajectory, anchored
from companion.trajectory.curve import curve_of, on_curve
from companion.trajectory.piecewise import PathPiece, Piecewise, coefficients
from companion.trajectory.shapes import Circle, Heading, Helix, Hover, Lemniscate, Line, Lissajous, Shape


def polynomials(*, yaw: bool) -> Piecewise:
    rng = random.Random(int(yaw))
    knots = (0.0, 1.0, 2.5, 2.7, 6.0)
    pieces = [PathPiece(*[coefficients([rng.uniform(-1, 1) for _ in range(10)]) for _ in range(3)]) for _ in range(4)]
    turning = [coefficients([rng.uniform(-1, 1) for _ in range(6)]) for _ in range(2)] if yaw else []
    return Piecewise(
        knots_s=knots,
        pieces=tuple(pieces),
        yaw_knots_s=(0.0, 2.0, 5.0) if yaw else (),
        yaw_pieces=tuple(turning),
        heading=Heading(0.3, -0.2),
    )


SHAPES: dict[str, Shape] = {
    "hover": Hover(point_m=(1.0, 2.0, -3.0), heading=Heading(0.5, 0.1)),
    "circle": Circle(center_m=(1.0, 2.0, -3.0), radius_m=2.0, angular_rate_rad_s=-0.7, phase_rad=0.4),
    "helix": Helix(center_m=(1.0, 2.0, -3.0), radius_m=2.0, angular_rate_rad_s=0.7, climb_m_s=0.3),
    "lemniscate": Lemniscate(center_m=(1.0, 2.0, -3.0), amplitude_m=(5.0, 3.0), angular_rate_rad_s=0.6),
    "lissajous": Lissajous(
        center_m=(1.0, 2.0, -3.0),
        amplitude_m=(1.0, 2.0, 0.5),
        angular_rate_rad_s=(0.5, 0.75, 1.0),
        phase_rad=(0.1, 0.2, 0.3),
        heading=Heading(-1.0, 0.2),
    ),
    "polynomials": polynomials(yaw=False),
    "polynomials with a heading": polynomials(yaw=True),
}


def numbers(r: Reference) -> list[float]:
    return [*r.p, *r.v, *r.a, *r.j, *r.s, r.yaw, r.yaw_rate, r.yaw_acceleration]


@pytest.mark.parametrize("engine", ["python", pytest.param("numba", marks=pytest.mark.numba)])
@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("turned", [0.0, 0.7])
@pytest.mark.parametrize("scale", [1.0, 1.7])
def test_the_numbers_give_the_reference(engine: str, name: str, turned: float, scale: float) -> None:
    duration_s = 4.5  # beyond the polynomials' own time when scaled: they go straight on
    trajectory = Trajectory(
        name=name, shape=SHAPES[name], duration_s=duration_s, anchor_yaw_rad=turned, time_scale=scale, anchor="here"
    )
    path = anchored(trajectory, (10.0, -5.0, -20.0), None)
    row = curve_of(path)
    assert row is not None
    ask = accelerate.choose(on_curve, engine)
    r = np.array(row) if engine == "numba" else row
    knots = SHAPES[name].knots_s if isinstance(SHAPES[name], Piecewise) else ()
    at_knots = [k / scale for k in knots if k / scale <= duration_s]
    for t in (0.0, duration_s, *at_knots, *(duration_s * i / 97 for i in range(97))):
        exact = numbers(path.at(t))
        scales = [1e-13 * (1.0 + abs(x)) for x in exact]
        assert all(abs(a - b) <= 10 * s for a, b, s in zip(numbers(ask(r, t)), exact, scales, strict=True))


def test_a_shape_of_another_kind_has_no_numbers() -> None:
    line = Line(from_m=(0.0, 0.0, -5.0), to_m=(5.0, 0.0, -5.0), move_s=4.0)
    assert curve_of(anchored(Trajectory(name="line", shape=line, duration_s=4.0), (0.0, 0.0, -5.0), None)) is None


def test_a_course_has_a_curve_within_each_of_its_pieces_at_its_own_pace_only() -> None:
    vehicle = load_vehicle("bundled")
    trajectory = Trajectory(name="circle", shape=SHAPES["circle"], duration_s=10.0)
    course = Course(trajectory, vehicle, (0.0, 0.0, -10.0), 0.0, None)
    timed = Timed(course, 100.0)
    begin_s, end_s = 100.0 + course.join_s, 100.0 + course.join_s + 10.0
    assert course.join_s > 1.0
    stopped_s = end_s + course.stop_s
    for stamp_s, known in (
        (99.9, False),
        (100.0, True),
        (begin_s - 0.05, True),
        (begin_s - 0.01, False),
        (begin_s + 0.01, True),
        (end_s - 0.05, True),
        (end_s - 0.03, False),
        (end_s + 0.01, True),
        (stopped_s - 0.03, False),
        (stopped_s + 1.0, False),
    ):
        assert (timed.curve(stamp_s, 0.04) is not None) == known
    course.shift((1.0, 0.0, 0.0))
    for stamp_s in (100.0, 101.0, begin_s + 2.0, end_s + 0.5):
        curve = timed.curve(stamp_s, 0.04)
        assert curve is not None
        assert numbers(on_curve(curve.numbers, stamp_s - 100.0 - curve.begin_s)) == pytest.approx(
            numbers(timed(stamp_s)), abs=1e-12
        )
    plan = course.plan_pace(begin_s - 100.0 + 3.0, 0.0)
    ramp = plan.work(plan.samples_max)
    assert ramp is not None
    course.change_pace(ramp)
    change_s = begin_s + 3.0
    assert timed.curve(change_s - 0.05, 0.04) is not None  # until then the pace is its own, whoever knows of the change
    assert timed.curve(change_s - 0.03, 0.04) is None
    assert timed.curve(begin_s + 8.0, 0.04) is None
    assert math.dist(timed(begin_s + 9.0).p, timed(begin_s + 8.5).p) < 0.1
