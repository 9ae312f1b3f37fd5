"""Minimum-snap paths: the least cost, continuity, degree, and how they change with the durations."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from waypoint_cases import dense_cost

from companion.trajectory.descent import minimise
from companion.trajectory.minimum_snap import REFINEMENTS, Knots, Solution, basis, solve


def random_knots(seed: int, pieces: int, order: int = 4, axes: int = 3) -> tuple[Knots, np.ndarray]:
    """Rest at the ends, stops and velocities here and there, durations that differ up to fivefold."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(size=(axes, pieces)) * 5.0
    pinned = np.zeros((order, pieces + 1), dtype=bool)
    values = np.zeros((axes, order, pieces + 1))
    pinned[:, [0, -1]] = True
    for i in range(1, pieces):
        kind = rng.integers(4)
        if kind == 0:
            pinned[:, i] = True
        elif kind == 1:
            pinned[0, i] = True
            values[:, 0, i] = rng.normal(size=axes) * 2.0
    return Knots(order, steps, pinned, values), np.exp(rng.uniform(0.0, np.log(5.0), pieces))


@given(seed=st.integers(0, 10_000), pieces=st.integers(1, 9), order=st.sampled_from([2, 4]))
@settings(max_examples=40, deadline=None)
def test_cost_is_that_of_a_dense_quadratic_program(seed: int, pieces: int, order: int) -> None:
    knots, durations_s = random_knots(seed, pieces, order)
    assert solve(knots, durations_s).cost() == pytest.approx(dense_cost(knots, durations_s), rel=1e-8)


def derivatives_at(solution: Solution, derivative: int, x: float) -> np.ndarray:
    """Of all pieces, over time, by the coefficients; shape (axes, pieces)."""
    c = solution.coefficients(np.zeros_like(solution.knots.steps))
    powers = np.arange(c.shape[1])
    factors = np.array([np.prod(np.arange(k - derivative + 1, k + 1)) if k >= derivative else 0 for k in powers])
    terms = factors * np.where(powers >= derivative, x ** np.maximum(powers - derivative, 0), 0.0)
    return np.einsum("k,akn->an", terms, c) / solution.durations_s**derivative


@pytest.mark.parametrize("seed", range(6))
def test_pieces_meet_up_to_the_fourth_derivative_and_keep_what_is_pinned(seed: int) -> None:
    knots, durations_s = random_knots(seed, 9)
    solution = solve(knots, durations_s, REFINEMENTS)
    for k in range(1, 5):
        before, after = derivatives_at(solution, k, 1.0), derivatives_at(solution, k, 0.0)
        largest = max(np.abs(before).max(), np.abs(after).max())
        assert np.abs(before[:, :-1] - after[:, 1:]).max() <= 1e-9 * largest
        ends = np.concatenate([after, before[:, -1:]], axis=1)
        pinned = knots.pinned[k - 1]
        assert np.abs(ends[:, pinned] - knots.values[:, k - 1][:, pinned]).max() <= 1e-9 * largest
    assert derivatives_at(solution, 0, 1.0) == pytest.approx(knots.steps, abs=1e-9)


def test_degree_is_seven_where_no_fourth_derivative_is_pinned_and_nine_where_one_is() -> None:
    knots, durations_s = random_knots(3, 6)
    knots.pinned[:, 1:-1] = False
    knots.values[:] = 0.0
    c = solve(knots, durations_s, REFINEMENTS).coefficients(np.zeros_like(knots.steps))
    assert np.abs(c[:, 9, 0]).max() > 1.0  # beside the rest
    knots.pinned[3] = False
    c = solve(knots, durations_s, REFINEMENTS).coefficients(np.zeros_like(knots.steps))
    assert np.abs(c[:, 8:]).max() <= 1e-8 * np.abs(c).max()


def test_one_move_from_rest_to_rest_is_the_known_polynomial() -> None:
    pinned = np.ones((4, 2), dtype=bool)
    solution = solve(Knots(4, np.array([[3.0]]), pinned, np.zeros((1, 4, 2))), np.array([2.0]))
    assert solution.coefficients(np.zeros((1, 1)))[0, :, 0] == pytest.approx(
        [0.0, 0.0, 0.0, 0.0, 0.0, 378.0, -1260.0, 1620.0, -945.0, 210.0], rel=1e-12
    )


def test_refinement_holds_where_durations_differ_much() -> None:
    """More rounds change nothing any more."""
    knots, _ = random_knots(7, 8)
    durations_s = np.array([5.0, 0.2, 4.0, 0.15, 3.0, 5.0, 0.2, 1.0])
    refined, more = (solve(knots, durations_s, rounds) for rounds in (REFINEMENTS, 3 * REFINEMENTS))
    scale = np.abs(more.derivatives).max((0, 2), keepdims=True)
    assert np.abs((refined.derivatives - more.derivatives) / scale).max() <= 1e-10


@pytest.mark.parametrize("order", [2, 4])
def test_rates_of_change_with_the_durations(order: int) -> None:
    knots, durations_s = random_knots(11, 6, order)
    rng = np.random.default_rng(5)
    weights = rng.normal(size=(3, 2 * order + 1, 6))

    def quantity(t: np.ndarray) -> float:
        return float((weights * solve(knots, t).local()).sum())

    solution = solve(knots, durations_s)
    rates = solution.rates(weights)
    for i in range(6):
        step = np.zeros(6)
        step[i] = 1e-5 * durations_s[i]
        slope = (quantity(durations_s + step) - quantity(durations_s - step)) / (2.0 * step[i])
        assert rates[i] == pytest.approx(slope, rel=1e-5, abs=1e-5 * np.abs(rates).max())


def test_basis_gives_ends_and_integral() -> None:
    b = basis(4)
    y = np.random.default_rng(0).normal(size=9)
    for k in range(1, 5):
        assert b.values(k, np.array([0.0, 1.0])) @ y == pytest.approx([y[k], y[4 + k]])
    assert b.values(0, np.array([0.0, 1.0])) @ y == pytest.approx([0.0, y[0]])
    x, weights = np.polynomial.legendre.leggauss(10)
    snap = b.values(4, (x + 1.0) / 2.0) @ y
    assert y @ b.energy @ y == pytest.approx((weights * snap**2).sum() / 2.0)


def test_minimise_finds_a_curved_valley_and_keeps_bounds() -> None:
    def valley(x: np.ndarray) -> tuple[float, np.ndarray]:
        a, b = 1.0 - x[0], x[1] - x[0] ** 2
        return a * a + 100.0 * b * b, np.array([-2.0 * a - 400.0 * x[0] * b, 200.0 * b])

    wide = np.full(2, 5.0)
    assert minimise(valley, -wide, wide, np.array([-1.2, 1.0]), 200) == pytest.approx([1.0, 1.0], abs=1e-5)
    found = minimise(valley, -wide, np.array([0.5, 5.0]), np.array([-1.2, 1.0]), 200)
    assert found == pytest.approx([0.5, 0.25], abs=1e-6)
