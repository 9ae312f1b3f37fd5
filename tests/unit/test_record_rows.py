"""The messages of a row in one piece: byte by byte those of each topic by itself, whatever the row holds."""

import math
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.record import rows, topics
from companion.record.columns import COLUMN_INDEX, COLUMNS
from companion.record.rows import RowSeries
from companion.record.ulog import Series

SIZE = 8 * len(COLUMNS)
NUMBERS = st.one_of(
    st.floats(),
    st.floats(width=32),
    st.sampled_from([math.nan, math.inf, -math.inf, -0.0, 1e300, -1e300, 3.4028235e38, 3.4028236e38, 5e-324]),
)
ROWS = st.one_of(
    st.lists(NUMBERS, min_size=len(COLUMNS), max_size=len(COLUMNS)).map(lambda row: struct.pack(f"={len(row)}d", *row)),
    st.binary(min_size=SIZE, max_size=SIZE),  # NaN of every kind among them
)


def series() -> list[Series]:
    return [Series(topic, 5 + index) for index, topic in enumerate(topics.STEP_TOPICS)]


class OneByOne:
    """What RowSeries is to give, from the numbers of each topic."""

    def __init__(self) -> None:
        self._series = series()

    def encode(self, t_us: int, row: bytes, derived: tuple[float, float]) -> bytes:
        numbers = dict(zip(COLUMNS, struct.unpack(f"={len(COLUMNS)}d", row), strict=True))
        numbers |= dict(zip(topics.DERIVED, derived, strict=True))
        return b"".join(
            one.encode(t_us, [numbers[name] for field in one.topic.fields for name in field.columns])
            for one in self._series
        )


@pytest.mark.parametrize("little_endian", [True, False])
def test_they_are_the_messages_of_each_topic_by_itself(monkeypatch, little_endian: bool) -> None:
    monkeypatch.setattr(rows, "_LITTLE_ENDIAN", little_endian)

    @settings(max_examples=150, deadline=None)
    @given(st.lists(st.tuples(st.integers(-5, 2**63), ROWS, st.tuples(NUMBERS, NUMBERS)), min_size=1, max_size=4))
    def check(steps: list[tuple[int, bytes, tuple[float, float]]]) -> None:
        together, each = RowSeries(series(), topics.DERIVED), OneByOne()
        for step in steps:
            assert together.encode(*step) == each.encode(*step)

    check()


def test_most_of_a_row_is_copied_and_never_a_number(monkeypatch) -> None:
    """Or it would be right and slow: only what is too large for its type takes the long way."""
    together, each = RowSeries(series(), topics.DERIVED), OneByOne()
    fitting = list(map(float, range(len(COLUMNS))))
    large = list(fitting)
    large[COLUMN_INDEX["ref_v_e"]] = -1e39
    step = (7, struct.pack(f"={len(COLUMNS)}d", *large), (0.5, 0.25))
    assert together.encode(*step) == each.encode(*step)
    monkeypatch.setattr(together, "_one_by_one", None)
    step = (8, struct.pack(f"={len(COLUMNS)}d", *fitting), (0.5, 0.25))
    assert together.encode(*step) == each.encode(*step)


@pytest.mark.parametrize("step", [(1, b""), (1, bytes(SIZE - 1)), (1, bytes(SIZE + 8)), (2**64, bytes(SIZE))])
def test_what_is_no_row_raises_and_leaves_the_next_one_as_it_is(step: tuple[int, bytes]) -> None:
    together, each = RowSeries(series(), topics.DERIVED), OneByOne()
    with pytest.raises(struct.error):
        together.encode(*step, (0.0, 0.0))
    following = (1, bytes(range(252)) * 2, (0.0, 0.0))
    assert together.encode(*following) == each.encode(*following)
