"""What the vehicle believes: the right sample, its stamp, and noise that depends on seed and time alone."""

from __future__ import annotations

import numpy as np
import pytest
from sim_cases import LEVEL, NOTHING, OFF, PAPER, noiseless

from sim_link.estimator import NOISE_ROWS, Estimator, Noise, NoiseBlocks, noise_block, noise_of
from sim_link.physics import RigidState
from sim_link.rotation import exponential, logarithm, multiply
from sim_link.vehicle_file import VehicleFile


def at(i: int) -> RigidState:
    return RigidState(
        (float(i), 0.0, 0.0), (0.0, float(i), 0.0), exponential((0.0, 0.0, 0.01 * i)), (0.0, 0.0, float(i)), OFF
    )


def estimator(craft: VehicleFile, seed: int = 3) -> Estimator:
    return Estimator(craft, seed=seed, t_us=1_000_000, rigid=at(0), dt_us=2000)


@pytest.mark.parametrize(("age_s", "steps"), [(0.0, 0), (0.002, 1), (0.020, 10), (0.030, 15), (0.0209, 10)])
def test_belief_is_the_state_of_some_time_ago_with_the_stamp_of_then(age_s: float, steps: int) -> None:
    e = estimator(noiseless(state_age_s=age_s))
    assert e.age_us == 2000 * steps
    for i in range(1, 40):
        e.push(1_000_000 + 2000 * i, at(i))
        sample = max(0, i - steps)
        b = e.believed()
        assert b.t_us == 1_000_000 + 2000 * (i - steps)
        assert (b.p, b.v, b.w) == (at(sample).p, at(sample).v, at(sample).w)
        assert b.q == pytest.approx(at(sample).q, abs=1e-15)


def test_noise_has_the_stated_sigmas() -> None:
    e = estimator(PAPER)
    turned = multiply(LEVEL, exponential((0.3, -0.2, 1.0)))
    errors = []
    for i in range(1, 4000):
        e.push(1_000_000 + 2000 * i, RigidState(NOTHING, NOTHING, turned, NOTHING, OFF))
        if i <= 10:
            continue
        b = e.believed()
        tilt = logarithm(multiply((turned[0], -turned[1], -turned[2], -turned[3]), b.q))
        errors.append([*b.p, *b.v, *tilt, *b.w])
        assert sum(c * c for c in b.q) == pytest.approx(1.0, abs=1e-15)
    sigma = np.repeat([0.002, 0.005, 0.0005, 0.002], 3)
    scaled = np.array(errors) / sigma
    assert scaled.std(axis=0) == pytest.approx(np.ones(12), rel=0.05)
    assert np.abs(scaled.mean(axis=0)).max() < 0.06
    assert np.abs(np.corrcoef(scaled.T) - np.eye(12)).max() < 0.07
    assert abs(np.mean(scaled[1:] * scaled[:-1])) < 0.02


def test_noise_does_not_depend_on_who_asks_when() -> None:
    often, seldom, other = estimator(PAPER), estimator(PAPER), estimator(PAPER, seed=4)
    for i in range(1, 50):
        for e in (often, seldom, other):
            e.push(1_000_000 + 2000 * i, at(i))
        assert often.believed() is often.believed()
    assert often.believed() == seldom.believed()
    assert often.believed() != other.believed()


def test_noise_can_be_scaled_and_the_same_numbers_are_drawn() -> None:
    assert noise_of(PAPER) == (0.002, 0.005, 0.0005, 0.002)
    assert noise_of(PAPER, 3.0) == pytest.approx((0.006, 0.015, 0.0015, 0.006))
    one, three, none = estimator(PAPER), estimator(PAPER), estimator(PAPER)
    before = three.believed()
    three.set_noise(noise_of(PAPER, 3.0))
    none.set_noise(Noise(0.0, 0.0, 0.0, 0.0))
    assert three.believed().t_us == before.t_us
    for small, large in zip(one.believed().v, three.believed().v, strict=True):
        assert large == pytest.approx(3.0 * small)
    assert (none.believed().p, none.believed().v) == (NOTHING, NOTHING)


def test_noise_blocks_are_a_fixed_function_of_seed_and_number() -> None:
    assert np.array_equal(noise_block(1, 2), noise_block(1, 2))
    assert len({noise_block(s, i).tobytes() for s in range(-5, 5) for i in range(10)}) == 100


def test_noise_is_the_row_of_the_sample_whoever_asked_before() -> None:
    blocks = NoiseBlocks(7)
    for sample in (3 * NOISE_ROWS, 0, NOISE_ROWS - 1, NOISE_ROWS, 5):
        blocks.move_to(sample)
        expected = noise_block(7, sample // NOISE_ROWS)[sample % NOISE_ROWS]
        assert np.array_equal(blocks.rows[sample - blocks.first], expected)
