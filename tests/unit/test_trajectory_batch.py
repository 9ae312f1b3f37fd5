"""References at many instants at once: the same numbers as one by one."""

import math
from dataclasses import replace

import numpy as np
import pytest
from waypoint_cases import LIMITS, points, turning_limits

from companion.trajectory import flatness, torque
from companion.trajectory.anchored import Trajectory, anchored
from companion.trajectory.batch import batch, demands, finite, quantities, torque_uses, uses
from companion.trajectory.demands import Excess, Gauge
from companion.trajectory.pieces import Piece
from companion.trajectory.piecewise import Piecewise
from companion.trajectory.shapes import Helix
from companion.trajectory.waypoints import plan

SHAPE = plan([replace(w, yaw_rad=0.7 * i) for i, w in enumerate(points(3, 8))], turning_limits(1.0))
PLAIN = Trajectory(name="plan", shape=SHAPE, duration_s=SHAPE.own_duration_s)
TRACK = Trajectory(name="plan", shape=SHAPE, duration_s=SHAPE.own_duration_s / 1.3, time_scale=1.3, anchor_yaw_rad=0.6)
HELIX = Trajectory(
    name="helix", shape=Helix(radius_m=4.0, angular_rate_rad_s=0.7, climb_m_s=0.4), duration_s=20.0, time_scale=1.2
)


@pytest.mark.parametrize(
    "piece", [PLAIN, TRACK, anchored(TRACK, (1.0, 2.0, -3.0), None), HELIX, anchored(HELIX, (0.0, 1.0, -2.0), None)]
)
def test_batch_is_what_at_gives(piece: Piece) -> None:
    times = [piece.duration_s * i / 500 for i in range(501)]
    found = batch(piece, times)
    references = [piece.at(t) for t in times]
    for k in range(5):
        one_by_one = np.array([reference[k] for reference in references]).T
        assert found[k] == pytest.approx(one_by_one, rel=1e-9, abs=1e-9 * np.abs(one_by_one).max())
    yaw = np.array([reference[5:] for reference in references]).T
    assert found.yaw == pytest.approx(yaw, rel=1e-9, abs=1e-9)
    assert finite(found).all()


def test_demands_uses_and_torque_are_those_of_single_references() -> None:
    assert LIMITS.body is not None
    times = [TRACK.duration_s * i / 200 for i in range(201)]
    found, model, limits = batch(TRACK, times), LIMITS.model, turning_limits(1.0).reference
    references = [TRACK.at(t) for t in times]
    needs = np.array([flatness.demand(reference, model) for reference in references]).T
    assert np.stack(demands(found, model)) == pytest.approx(needs, rel=1e-6, abs=1e-6)
    values = np.array([flatness.quantities(reference, model) for reference in references]).T
    assert quantities(found, model) == pytest.approx(values, rel=1e-6, abs=1e-6)
    shares = np.array([flatness.uses(flatness.quantities(r, model), limits) for r in references]).T
    assert uses(quantities(found, model), limits) == pytest.approx(shares, rel=1e-6, abs=1e-6)
    torques = [torque.use(reference, model, LIMITS.body) for reference in references]
    assert torque_uses(found, model, LIMITS.body) == pytest.approx(torques, rel=1e-6, abs=1e-6)


def test_free_fall_has_no_direction() -> None:
    found = batch(SHAPE, [1.0, 2.0])
    found.v[:], found.a[:] = 0.0, [[0.0, 0.0], [0.0, 0.0], [9.81, 0.0]]
    needs = demands(found, LIMITS.model)
    assert (needs.thrust_n[0], needs.tilt_rad[0], needs.rate_rad_s[0]) == (0.0, math.pi, math.inf)
    assert needs.tilt_rad[1] == 0.0
    assert uses(quantities(found, LIMITS.model), LIMITS.reference)[3, 0] == math.inf
    found.a[0, 0] = math.nan
    assert finite(found).tolist() == [False, True]


def test_beyond_its_ends_a_piecewise_path_goes_on_straight() -> None:
    cut = Piecewise(knots_s=SHAPE.knots_s[:3], pieces=SHAPE.pieces[:2])
    end, past = cut.at(cut.own_duration_s), cut.at(cut.own_duration_s + 2.0)
    assert past.p == pytest.approx(tuple(p + 2.0 * v for p, v in zip(end.p, end.v, strict=True)))
    assert (past.v, past.a, past.s) == (end.v, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert cut.at(-1.0).p == pytest.approx(cut.at(0.0).p, abs=1e-9)
    assert SHAPE.at(-1.0)[5:] == (SHAPE.at(0.0).yaw, 0.0, 0.0)


@pytest.mark.parametrize("room", [0.0, 0.8])
def test_excess_is_use_less_one_and_its_gradient(room: float) -> None:
    rng = np.random.default_rng(2)
    v, a, j, s = (rng.normal(size=(3, 40)) * size for size in (3.0, 3.0, 8.0, 20.0))
    gauge = Gauge(LIMITS.reference, LIMITS.model, room, LIMITS.body)
    excess, parts = gauge.excess(v, a, j)
    if room == 0.0:
        found = batch(SHAPE, [0.0] * 40)._replace(v=v, a=a, j=j, s=s)
        shares = uses(quantities(found, LIMITS.model), LIMITS.reference)
        for index, row in enumerate(excess):
            assert ((row > 0.0) == (shares[index] > 1.0)).all()
        assert LIMITS.body is not None
        torques = torque_uses(found, LIMITS.model, LIMITS.body)
        assert gauge.torque_excess(v, a, j, s) == pytest.approx(torques - 1.0, rel=1e-6)
    weights = Excess(*rng.normal(size=(6, 40)))
    gradients = gauge.gradient(parts, weights)

    def total(*derivatives: np.ndarray) -> float:
        return float(sum((w * e).sum() for w, e in zip(weights, gauge.excess(*derivatives)[0], strict=True)))

    for k in range(3):
        for axis in range(3):
            step = np.zeros((3, 3, 40))
            step[k, axis, 7] = 1e-5
            up, down = (total(v + sign * step[0], a + sign * step[1], j + sign * step[2]) for sign in (1.0, -1.0))
            assert gradients[k][axis, 7] == pytest.approx((up - down) / 2e-5, rel=1e-5, abs=1e-7)
