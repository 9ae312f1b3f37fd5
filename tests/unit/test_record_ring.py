"""The ring between the control process and its recorder: nothing is lost that was taken, nothing is invented."""

import os
from collections.abc import Iterable
from unittest import mock

from hypothesis import given, settings
from hypothesis import strategies as st

from companion.record import ring
from companion.record.ring import Entry, RingReader, RingWriter


def flat(batches: Iterable[list[Entry]]) -> list[Entry]:
    return [entry for batch in batches for entry in batch]


def contents(batches: Iterable[list[Entry]]) -> list[bytes]:
    return [content for _, _, content in flat(batches)]


def make(size_bytes: int) -> tuple[RingWriter, RingReader]:
    descriptor = ring.create(size_bytes)
    try:
        return RingWriter(descriptor), RingReader(descriptor)
    finally:
        os.close(descriptor)


@settings(max_examples=60, deadline=None)
@given(
    size=st.integers(64, 600),
    batch=st.sampled_from([1, 3, 256]),
    steps=st.lists(st.one_of(st.binary(max_size=90), st.sampled_from(["take", "rest"])), max_size=120),
)
def test_what_was_put_comes_out_once_and_in_order(size, batch, steps):
    with mock.patch.object(ring, "_BATCH", batch):
        _put_and_take(size, steps)


def _put_and_take(size: int, steps: list[bytes | str]) -> None:
    writer, reader = make(size)
    put: list[Entry] = []
    got: list[Entry] = []
    for number, step in enumerate(steps):
        if isinstance(step, bytes):
            if writer.put(number % 256, step, number):
                put.append((number, number % 256, step))
        else:
            got.extend(flat(reader.take() if step == "take" else reader.take_rest()))
            assert got == put[: len(got)]
        assert writer.waiting == len(put) - len(got)
    got.extend(flat(reader.take_rest()))
    assert got == put
    assert (writer.taken, writer.waiting) == (len(put), 0)


def test_an_entry_is_taken_only_at_the_look_after_the_one_that_saw_it_announced():
    writer, reader = make(1000)
    assert writer.put(0, b"one", 1)
    assert flat(reader.take()) == []
    assert writer.put(0, b"two", 2)
    assert contents(reader.take()) == [b"one"]
    assert contents(reader.take_rest()) == [b"two"]


def test_a_full_ring_refuses_and_goes_on_once_there_is_room():
    writer, reader = make(100)
    taken = 0
    while writer.put(0, b"0123456789", 0):
        taken += 1
    assert taken == 4  # 23 bytes each
    assert not writer.put(0, b"0123456789", 0)
    assert len(flat(reader.take_rest())) == 4
    assert writer.put(0, b"0123456789", 0)
    assert not writer.put(0, bytes(101), 0)  # never fits


def test_an_entry_may_end_where_the_ring_ends():
    writer, reader = make(2 * 26)
    for round_ in range(5):
        for number in range(2):  # 13 bytes of head, 13 of content: two fill the ring to its last byte
            assert writer.put(number, bytes(13), round_)
        assert not writer.put(9, b"", 0)
        assert flat(reader.take_rest()) == [(round_, 0, bytes(13)), (round_, 1, bytes(13))]
    assert (writer.refused, writer.waiting) == (5, 0)


def test_what_is_no_entry_is_refused_and_does_not_raise():
    writer, reader = make(100)
    assert not writer.put(300, b"kinds have one byte", 0)
    assert not writer.put(1, "text", 0)
    assert writer.put(1, b"content", 0)
    assert writer.refused == 2
    assert contents(reader.take_rest()) == [b"content"]


def test_a_closed_ring_refuses_and_counts():
    writer, reader = make(100)
    assert writer.put(0, b"0123456789", 0)
    writer.close()
    assert not writer.put(0, b"", 0)
    assert not writer.put(0, b"0", 0)
    assert (writer.refused, writer.waiting) == (2, 1)
    assert contents(reader.take_rest()) == [b"0123456789"]


def test_entries_of_any_size_keep_their_content():
    writer, reader = make(10_000)
    for length in (0, 1, 639, 640, 641, 5000):
        content = (bytes(range(256)) * 20)[:length]
        assert writer.put(7, content, -5)
        assert flat(reader.take_rest()) == [(-5, 7, content)]


def test_a_patient_writer_lets_the_reader_wait_until_three_quarters_of_the_ring_are_full():
    writer, reader = make(184)
    assert writer.put(0, b"0123456789", 0)
    assert not reader.may_wait  # nobody said so
    writer.be_patient()
    assert reader.may_wait
    for _ in range(4):
        assert reader.may_wait
        assert writer.put(0, b"0123456789", 0)  # 23 bytes each
    assert reader.may_wait
    assert writer.put(0, b"0123456789", 0)  # three quarters of it
    assert not reader.may_wait
    assert len(flat(reader.take_rest())) == 6
    assert reader.may_wait
