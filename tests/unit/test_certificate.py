"""The certificate against docs/law.md section 4, and the sampled loop against the flight that it speaks of."""

import numpy as np
import pytest
from law_cases import MASS, NO_LIMITS, PAPER_GAINS, ZERO, memory, parameters

from companion.campaign.ideal import World, fly
from companion.config import load_flight, load_vehicle
from companion.control.certificate import (
    certify,
    disturbance_overcome,
    inside_matrix,
    linear_loop,
    outside_matrix,
    poles,
    thrust_bounds,
)
from companion.control.law import ControllerState, Model, Parameters
from companion.control.sampled import Timing, loop_matrix, margins, spectral_radius
from companion.control.types import State
from companion.errors import RefusedError
from companion.flight.course import at_rest
from companion.flight.preflight import gate_gains


def test_values_of_the_paper_gains():
    c = certify(PAPER_GAINS, 0.0)
    assert c.inside == pytest.approx([0.4712, 1.228, 2.925, 4.156], abs=1e-3)
    assert c.outside[0] == pytest.approx(0.637, abs=1e-3)
    assert [p.real for p in c.poles] == pytest.approx([-0.607, -1.210, -1.210, -2.877, -2.877], abs=1e-3)
    assert sorted(abs(p.imag) for p in c.poles) == pytest.approx([0, 2.280, 2.280, 6.630, 6.630], abs=1e-3)
    assert (c.inside_frozen[0], c.outside_frozen[0]) == (pytest.approx(0.607, abs=1e-3), pytest.approx(0.643, abs=1e-3))
    assert c.failure() is None


@pytest.mark.parametrize(("drag", "inside", "outside"), [(1.0, 0.554, 0.268), (2.0, 0.123, -0.251)])
def test_drag_costs_margin_and_two_per_second_is_refused(drag, inside, outside):
    c = certify(PAPER_GAINS, drag)
    assert c.inside[0] == pytest.approx(inside, abs=1e-3)
    assert c.outside[0] == pytest.approx(outside, abs=1e-3)
    assert (c.failure() is None) == (outside > 0)


def test_without_drag_the_estimator_gain_is_bounded():
    assert certify(PAPER_GAINS._replace(gamma=3.37), 0.0).failure() is None
    assert "-0.0" in (certify(PAPER_GAINS._replace(gamma=3.38), 0.0).failure() or "")


def test_q_is_the_derivative_of_v_along_the_linear_loop():
    """V' = -e' Q e must follow from A: an independent derivation of every entry of Q."""
    g, drag = PAPER_GAINS, 0.7
    a = linear_loop(g, drag)
    p = np.diag([1, 1, 1, 1, 1 / (g.k1 * g.gamma)]) / 2
    derivative = a.T @ p + p @ a
    assert derivative[:4, :4] == pytest.approx(-inside_matrix(g, drag))
    assert derivative[:4, 4] == pytest.approx(np.zeros(4), abs=1e-12)


@pytest.mark.parametrize("drag", [0.0, 0.7])
def test_both_matrices_are_symmetric_as_eigenvalues_of_one_half_of_them_want_it(drag):
    for matrix in (inside_matrix(PAPER_GAINS, drag), outside_matrix(PAPER_GAINS, drag)):
        assert (matrix == matrix.T).all()


def test_thrust_bounds_are_symmetric_about_the_weight_and_grow_with_the_start():
    near = thrust_bounds(PAPER_GAINS, MASS, 9.81, 0.3, 1.2, 0.01, 0.0)
    far = thrust_bounds(PAPER_GAINS, MASS, 9.81, 0.3, 1.2, 10.0, 0.0)
    assert near.low_n + near.high_n == pytest.approx(2 * MASS * 9.81)
    assert far.low_n < near.low_n
    g, v = PAPER_GAINS, 0.01 + 1.2**2 / (2 * 0.7 * 2.0)
    assert (g.k1, g.k2, g.gamma) == (0.7, 4.0, 2.0)
    assert near.high_n == pytest.approx(
        MASS * (9.81 + 0.3 + 1.2 + np.sqrt((2 * 0.7 * 2.0 + (2 * 0.7**2 * 4.0) ** 2) * v))
    )
    known = thrust_bounds(PAPER_GAINS, MASS, 9.81, 0.3, 1.0, 0.01, 0.2)  # of the same ball, a part known at the start
    assert known.high_n == pytest.approx(near.high_n - MASS * 0.2)
    nothing = thrust_bounds(PAPER_GAINS._replace(gamma=0.0), MASS, 9.81, 0.3, 1.2, 0.0, 0.0)
    assert nothing == (-np.inf, np.inf)


@pytest.mark.parametrize(("share", "drifts"), [(0.95, False), (1.05, True)])
def test_without_the_estimator_only_so_much_disturbance_is_overcome(share, drifts):
    gains = PAPER_GAINS._replace(gamma=0.0, p_max=1.0)
    force = share * disturbance_overcome(gains)
    start = State((0.0, 0.0, -10.0), ZERO, (1.0, 0.0, 0.0, 0.0), ZERO)
    hover = at_rest((0.0, 0.0, -10.0), 0.0)
    ctrl = ControllerState(MASS * 9.81, 0.0, ZERO, memory(), ZERO)
    world = World((force * MASS, 0.0, 0.0), 9.81, 0.0)
    flight = fly(lambda t: hover, start, ctrl, parameters(gains), world, np.array([0.0, 30.0, 60.0]))
    speed = abs(flight[-1].state.v[0])
    assert (speed > 0.01) == drifts


def test_without_the_estimator_its_pole_is_gone_and_the_others_stay():
    """A hardly working estimator has a pole close to zero; the four others are those of the errors alone."""
    slowest, *others = poles(PAPER_GAINS._replace(gamma=1e-7), 0.3)
    assert abs(slowest) < 1e-5
    assert poles(PAPER_GAINS._replace(gamma=0.0), 0.3) == [pytest.approx(pole, abs=1e-5) for pole in others]


def test_fast_sampling_without_lags_gives_the_poles_of_the_continuous_loop():
    dt = 2e-4
    p = Parameters(PAPER_GAINS, Model(MASS, 9.81, 0.0, ZERO, ZERO, 0.0), NO_LIMITS)
    values = np.linalg.eigvals(loop_matrix(p, Timing(dt, 0.0, (0.0,) * 4, False)))
    rates = np.log(values[np.abs(values) > 0.5].astype(complex)) / dt
    for pole in certify(PAPER_GAINS, 0.0).poles:
        assert np.abs(rates - pole).min() < 0.02 * abs(pole)


def test_prediction_buys_delay_margin():
    vehicle = load_vehicle("paper")
    p, lags = vehicle.parameters(), (*vehicle.autopilot.rate_lag_s, vehicle.rotors.lag_s)
    with_it = margins(p, Timing(0.004, 0.03, lags, True))
    without = margins(p, Timing(0.004, 0.03, lags, False))
    assert with_it.delay_margin_s > without.delay_margin_s + 0.02
    assert without.delay_margin_s < 0.010


def test_margins_are_where_the_loop_becomes_unstable():
    p = parameters()
    timing = Timing(0.01, 0.02, (0.04, 0.04, 0.08, 0.05), True)
    p = p._replace(model=p.model._replace(rate_lag=(0.04, 0.04, 0.08), thrust_lag=0.05))
    found = margins(p, timing)
    assert spectral_radius(p, timing, found.delay_margin_s - 0.001) < 1.0
    assert spectral_radius(p, timing, found.delay_margin_s + 0.002) > 1.0
    assert spectral_radius(p, timing._replace(interval_s=found.interval_max_s - 0.002)) < 1.0
    assert spectral_radius(p, timing._replace(interval_s=found.interval_max_s + 0.003)) > 1.0


def test_gates_name_the_figure_that_fails():
    with pytest.raises(RefusedError, match=r"smallest eigenvalue of Q .* is -"):
        gate_gains(load_vehicle("paper", {"controller": {"gamma_1_s3": 4.0}}))
    with pytest.raises(RefusedError, match=r"delay margin of \d+\.\d ms, 10 ms are required"):
        gate_gains(load_vehicle("paper", {"controller": {"prediction": False}, "link": {"state_age_s": 0.03}}))
    gate_gains(load_vehicle("paper", {"controller": {"gamma_1_s3": 4.0}}), allow_uncertified=True)


@pytest.mark.parametrize(("extra_s", "flies"), [(0.030, True), (0.060, False)])
def test_the_delay_margin_holds_on_the_simulated_vehicle(extra_s, flies):
    """The margin says 43 ms: 30 ms of delay that nobody knows of are flown through, 60 ms are not."""
    from companion.campaign import simulate
    from companion.config import Start
    from companion.flight.engines import kernels
    from companion.trajectory.load import build

    def older(flight):
        known = simulated(flight)
        return known.__class__(**{**known.__dict__, "state_age_s": known.state_age_s + extra_s})

    simulated = simulate.simulated_vehicle
    flight = load_flight("paper").model_copy(update={"start": Start(position_m=(0.3, 0.0, -10.0))})
    hover = {"shape": "hover", "anchor": "local", "join": "law", "duration_s": 8.0, "hover": {"point_m": [0, 0, -10]}}
    simulate.simulated_vehicle = older
    try:
        trace = simulate.fly_sampled(flight, build(hover, "hover", "test"), kernels("python"))
    except RefusedError:
        assert not flies
        return
    finally:
        simulate.simulated_vehicle = simulated
    late = [np.linalg.norm(row.errors[0]) for row in trace.rows if row.t_s > 6.0]
    assert (max(late) < 0.15) == flies
