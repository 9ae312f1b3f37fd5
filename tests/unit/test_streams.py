"""A stream of attitudes is given up where none is newer than the state it comes with."""

from typing import Any

import pytest

from companion.flight.preflight import ATTITUDE_TARGET
from companion.flight.streams import STATES_JUDGED, Attitudes, Streams
from companion.link.codec import COMMAND_LONG_LAYOUT
from companion.link.operations import DEFAULT_INTERVAL, STOP_MESSAGE


def judged(attitudes: Attitudes, age_us: int, behind_ns: int, states: int = STATES_JUDGED + 10) -> list[int]:
    """Which of so many states, 10 ms apart, told that the stream is of no use.

    Args:
        attitudes: the judge.
        age_us: how much older than an attitude the state is that it comes with.
        behind_ns: how long after it the attitude comes; below zero: before it.
    """
    said = []
    for i in range(states):
        t_us, wall_ns = 10_000 * i, 10_000_000 * i
        if behind_ns < 0:
            attitudes.on_attitude(t_us + age_us, wall_ns + behind_ns)
        if attitudes.waste(t_us, wall_ns):
            said.append(i)
        if behind_ns >= 0:
            attitudes.on_attitude(t_us + age_us, wall_ns + behind_ns)
    return said


@pytest.mark.parametrize("behind_ns", [-3_000_000, -10_000, 10_000, 900_000])
def test_newer_ones_are_of_use(behind_ns: int) -> None:
    """As of PX4, whose states are 18 ms old and whose attitudes come right behind them."""
    assert judged(Attitudes(), 15_000, behind_ns) == []


@pytest.mark.parametrize("behind_ns", [-3_000_000, -10_000, 10_000, 900_000, 4_000_000])
def test_others_are_given_up_once(behind_ns: int) -> None:
    (state,) = judged(Attitudes(), 0, behind_ns)
    assert STATES_JUDGED <= state <= STATES_JUDGED + 2


def test_those_between_two_states_are_newer_than_neither_when_it_is_answered() -> None:
    """Of a simulated vehicle with 100 states and 250 attitudes per second, all of them without age."""
    assert len(judged(Attitudes(), 4_000, 4_000_000)) == 1


def test_without_attitudes_nothing_is_said() -> None:
    attitudes = Attitudes()
    assert not any(attitudes.waste(10_000 * i, 10_000_000 * i) for i in range(2 * STATES_JUDGED))


def test_a_few_accidents_do_not_keep_the_stream() -> None:
    attitudes = Attitudes()
    said = []
    for i in range(STATES_JUDGED + 10):
        attitudes.on_attitude(10_000 * i + (5_000 if i % 20 == 0 else 0), 10_000_000 * i - 1000)
        said.append(attitudes.waste(10_000 * i, 10_000_000 * i))
    assert sum(said) == 1


class Asked:
    """Requests to an autopilot, and a wire, that only remember."""

    def __init__(self) -> None:
        self.intervals_us: dict[int, int] = {}

    def set_message_interval(self, msgid: int, interval_us: int, now_s: float) -> None:
        self.intervals_us[msgid] = interval_us

    def send(self, msgid: int, payload: bytes) -> bool:
        number, interval_us, *_ = COMMAND_LONG_LAYOUT.unpack(payload)
        self.intervals_us[int(number)] = int(interval_us)
        return True


@pytest.mark.parametrize("exclusive", [True, False])
@pytest.mark.parametrize("paced", [True, False])
def test_all_that_was_left_out_is_there_for_the_next_flight(exclusive: bool, paced: bool) -> None:
    """At its end in real time, whose requests may be lost; in any case at the beginning, as far as it needs them."""
    asked: Any = Asked()
    first = Streams(exclusive=exclusive, paced=paced, predicts=True)
    first.on_engaged(asked, 1.0)
    assert (asked.intervals_us == {ATTITUDE_TARGET: STOP_MESSAGE}) == (exclusive or paced)
    following = Streams(exclusive=exclusive, paced=paced, predicts=True).intervals_us
    assert following.get(ATTITUDE_TARGET) == (DEFAULT_INTERVAL if exclusive or paced else None)
    asked.intervals_us |= first.intervals_us
    first.leave(asked, 1, 1)
    if exclusive and not paced:
        assert set(asked.intervals_us.values()) == {DEFAULT_INTERVAL}
