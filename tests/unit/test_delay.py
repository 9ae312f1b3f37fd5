"""The clocks and the delay: offset from round trips, age of the states, and what the prediction makes of both."""

from __future__ import annotations

import random
from itertools import pairwise

import pytest

from companion.config import load_vehicle
from companion.flight.delay import CHANGE_MAX_S, Delay
from companion.link.codec import Timesync
from companion.link.offset import OffsetFilter

OFFSET_NS = 5_000_000_000
MS = 1_000_000


def exchange(clocks: OffsetFilter, at_ns: int, out_ns: int, back_ns: int, offset_ns: int = OFFSET_NS) -> bool:
    clocks.asked(at_ns)
    answer = Timesync(at_ns + out_ns + offset_ns, at_ns, 1, 191)
    return clocks.on_answer(answer, at_ns + out_ns + back_ns)


def test_the_exchange_with_the_shortest_round_trip_counts() -> None:
    clocks, rng = OffsetFilter(), random.Random(1)
    assert clocks.offset_ns(0) is None
    for i in range(60):
        exchange(clocks, i * 100 * MS, MS + rng.randrange(8 * MS), MS + rng.randrange(8 * MS))
        clocks.settle()
    exchange(clocks, 6_000 * MS, MS, MS)
    clocks.settle()
    assert clocks.round_trip_ns == 2 * MS
    assert clocks.offset_ns(6_002 * MS) == OFFSET_NS
    exchange(clocks, 6_100 * MS, 9 * MS, MS)  # held up on the way out: worth nothing
    assert clocks.offset_ns(6_110 * MS) == OFFSET_NS


def test_the_offset_follows_slowly_and_never_steps() -> None:
    clocks = OffsetFilter()
    exchange(clocks, 0, MS, MS)
    used, last_ns = [], 0
    for i in range(1, 400):
        at_ns = i * 100 * MS
        exchange(clocks, at_ns, MS, MS, OFFSET_NS + 20 * MS)
        last_ns = at_ns + 2 * MS
        used.append(clocks.offset_ns(last_ns))
    steps = [abs(b - a) for a, b in pairwise(used)]
    assert max(steps) <= 0.1 * MS + 1
    assert used[0] < OFFSET_NS + MS
    assert used[-1] == OFFSET_NS + 20 * MS
    # What states are judged by knows at once.
    exchange(clocks, last_ns + 2_000 * MS, MS, MS, OFFSET_NS - 100 * MS)
    assert clocks.recent_ns == OFFSET_NS - 100 * MS
    assert clocks.offset_ns(last_ns + 2_002 * MS) > OFFSET_NS + 17 * MS


def test_answers_that_nobody_asked_for_change_nothing() -> None:
    clocks = OffsetFilter()
    assert not clocks.on_answer(Timesync(7, 123, 1, 191), 456)
    assert exchange(clocks, 1_000, MS, MS)
    assert not clocks.on_answer(Timesync(7, 1_000, 1, 191), 2 * MS)  # twice
    assert clocks.answered_ns == 1_000 + 2 * MS


def follow(delay: Delay, age_s: float, for_s: float, begin_s: float) -> list[tuple[float, float]]:
    changes = []
    for i in range(round(100 * for_s)):
        now_s = begin_s + 0.01 * i
        found = delay.on_age(age_s, now_s)
        if found is not None:
            changes.append((now_s, found))
    return changes


def test_the_delay_follows_the_age_in_small_steps_within_bounds() -> None:
    vehicle = load_vehicle("bundled")
    delay = Delay(vehicle)
    assert follow(delay, 0.020, 5.0, 0.0) == []
    changes = follow(delay, 0.030, 30.0, 5.0)
    assert delay.used_s == pytest.approx(0.030, abs=0.0011)
    values = [0.020, *(value for _, value in changes)]
    assert max(abs(b - a) for a, b in pairwise(values)) <= 0.0002 + 1e-12
    assert min(b[0] - a[0] for a, b in pairwise(changes)) >= 0.1 - 1e-9
    follow(delay, 0.3, 60.0, 40.0)
    assert delay.used_s == pytest.approx(vehicle.delay_s + CHANGE_MAX_S, abs=0.0011)
    follow(delay, 0.0, 60.0, 100.0)
    assert delay.used_s == pytest.approx(max(0.0, vehicle.delay_s - CHANGE_MAX_S), abs=0.0011)


def test_absurd_ages_are_not_followed() -> None:
    delay = Delay(load_vehicle("bundled"))
    for age_s in (-0.01, 5.0, float("nan")):
        assert delay.on_age(age_s, 1.0) is None
    assert delay.age_s is None


def test_a_file_that_knows_the_delay_as_a_whole_keeps_it() -> None:
    delay = Delay(load_vehicle("px4_sih"))
    assert follow(delay, 0.008, 20.0, 0.0) == []
    assert delay.age_s == pytest.approx(0.008)
