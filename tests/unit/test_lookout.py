"""When to look out for the next state: shortly before it is due, and not at all where nobody knows when that is."""

import random

import pytest

from companion.flight.lookout import LOOK_MAX_NS, LOOK_NS, SLEEP, Lookout

INTERVAL_NS = 4_000_000


def come(lookout: Lookout, count: int, unsteady_ns: float = 0.0, interval_ns: float = INTERVAL_NS) -> int:
    """States come; gives when the last one was due."""
    rng = random.Random(1)
    due = 0.0
    for i in range(count):
        due = 1e9 + i * interval_ns
        lookout.on_state(round(due + rng.gauss(0.0, unsteady_ns)))
    return round(due)


def test_steady_states_are_looked_out_for_shortly_before_they_are_due():
    lookout = Lookout(INTERVAL_NS * 1e-9)
    last = come(lookout, 200)
    due = last + INTERVAL_NS
    look = lookout.look(last + 300_000)
    begin = last + 300_000 + look.sleep_s * 1e9
    assert due - 1.2 * LOOK_NS < begin < due - 0.8 * LOOK_NS
    assert begin + look.spin_s * 1e9 == pytest.approx(due + LOOK_NS, rel=0.2, abs=0.2 * LOOK_NS)
    # what wakes the loop meanwhile changes nothing but the sleep
    later = lookout.look(due - 50_000)
    assert later.sleep_s == 0.0
    assert due - 50_000 + later.spin_s * 1e9 == pytest.approx(begin + look.spin_s * 1e9)
    assert lookout.look(due + LOOK_MAX_NS) == SLEEP  # it is overdue: nobody knows for how long


def test_an_interval_that_is_a_little_another_is_followed():
    lookout = Lookout(INTERVAL_NS * 1e-9)
    interval = 1.01 * INTERVAL_NS
    last = come(lookout, 2000, interval_ns=interval)
    look = lookout.look(last)
    middle = last + (look.sleep_s + 0.5 * look.spin_s) * 1e9
    assert abs(middle - (last + interval)) < 0.2 * LOOK_NS


def test_unsteady_states_are_looked_out_for_longer_and_very_unsteady_ones_are_slept_for():
    spins = []
    for unsteady_ns in (0.0, 60_000.0, 1_000_000.0):
        lookout = Lookout(INTERVAL_NS * 1e-9)
        last = come(lookout, 500, unsteady_ns)
        spins.append(lookout.look(last + 400_000).spin_s)
    assert 0.0 < spins[0] < spins[1] < 2e-9 * LOOK_MAX_NS
    assert spins[2] == 0.0


def test_nothing_is_known_before_some_states_and_a_gap_begins_anew():
    lookout = Lookout(INTERVAL_NS * 1e-9)
    assert lookout.look(1_000_000_000) == SLEEP
    lookout.on_state(1_000_000_000)
    assert lookout.look(1_000_000_001) == SLEEP  # one state says nothing of its steadiness
    last = come(lookout, 200)
    for missing in (1, 3):  # which come late is another matter: the next is due as before
        last += (1 + missing) * INTERVAL_NS
        lookout.on_state(last)
        look = lookout.look(last)
        assert abs((look.sleep_s + 0.5 * look.spin_s) * 1e9 - INTERVAL_NS) < 1e-6 * INTERVAL_NS
    resumed = last + 57 * INTERVAL_NS + INTERVAL_NS // 3
    lookout.on_state(resumed)
    look = lookout.look(resumed)
    assert abs(resumed + (look.sleep_s + 0.5 * look.spin_s) * 1e9 - (resumed + INTERVAL_NS)) < LOOK_NS


def test_a_state_too_many_moves_nothing():
    one, two = Lookout(INTERVAL_NS * 1e-9), Lookout(INTERVAL_NS * 1e-9)
    last = come(one, 200)
    come(two, 200)
    two.on_state(last + INTERVAL_NS // 4)
    assert one.look(last + INTERVAL_NS // 2) == two.look(last + INTERVAL_NS // 2)
