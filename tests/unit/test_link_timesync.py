"""Clocks: answers, offsets, and vehicles that wait."""

import pytest

from companion.link import timesync
from companion.link.codec import Timesync, decode_timesync
from companion.link.timesync import PacedPeer


def test_an_answer_echoes_the_question():
    answer = decode_timesync(timesync.answer(Timesync(0, 123, 0, 0), 456, 1, 1))
    assert answer == Timesync(456, 123, 1, 1)


def test_an_answer_is_never_a_request():
    answer = decode_timesync(timesync.answer(Timesync(0, 123, 0, 0), 0, 1, 1))
    assert answer.tc1 > 0


@pytest.mark.parametrize(
    ("message", "request_", "response"),
    [
        (Timesync(0, 5, 0, 0), True, False),
        (Timesync(0, 5, 1, 191), True, False),
        (Timesync(0, 5, 1, 192), False, False),
        (Timesync(0, 5, 2, 191), False, False),
        (Timesync(9, 5, 0, 0), False, True),
        (Timesync(9, 5, 1, 191), False, True),
        (Timesync(9, 5, 2, 0), False, False),
        (Timesync(-1, 5, 0, 0), False, False),
    ],
)
def test_requests_and_responses(message, request_, response):
    assert timesync.is_request(message, 1, 191) is request_
    assert timesync.is_response(message, 1, 191) is response


def test_the_offset_is_taken_at_the_middle_of_the_round_trip():
    question = decode_timesync(timesync.request(1_000, 1, 1))
    assert question == Timesync(0, 1_000, 1, 1)
    response = Timesync(tc1=50_200, ts1=question.ts1, target_system=1, target_component=191)
    assert timesync.clock_offset(response, 1_400) == (49_000, 400)


def drive(peer: PacedPeer, count: int, every_us: int, request_every: int, start_us: int = 1_000_000) -> list[bool]:
    paced = []
    for i in range(count):
        peer.on_state(start_us + i * every_us)
        paced.append(peer.paced)
        if (i + 1) % request_every == 0:
            peer.on_request((start_us + i * every_us) * 1_000)
    return paced


def test_a_vehicle_in_lockstep_is_noticed_after_ten_states():
    assert drive(PacedPeer(), 15, 4_000, 1) == [False] * 10 + [True] * 5


@pytest.mark.parametrize("rate_hz", [50, 100, 125, 250])
def test_px4_asking_at_10_hz_never_looks_paced(rate_hz):
    assert not any(drive(PacedPeer(), 500, 1_000_000 // rate_hz, rate_hz // 10))


def test_px4_with_a_slow_state_never_looks_paced():
    assert not any(drive(PacedPeer(), 100, 100_000, 1))


def test_a_state_far_beyond_the_last_request_ends_it():
    peer = PacedPeer()
    drive(peer, 12, 4_000, 1)
    assert peer.paced
    peer.on_state(2_000_000)
    assert not peer.paced
    peer.on_request(2_000_000_000)
    assert not peer.paced


def test_states_of_a_paced_vehicle_may_be_lost_late_and_bunched():
    peer = PacedPeer()
    drive(peer, 12, 4_000, 1)
    for i in range(100):
        for late_us in (24_000, 20_000, 16_000) if i % 6 == 0 else ():
            peer.on_state(1_048_000 + i * 4_000 - late_us)
        peer.on_request((1_048_000 + i * 4_000) * 1_000)
        assert peer.paced


def test_a_vehicle_that_stops_asking_for_a_while_begins_anew():
    peer = PacedPeer()
    drive(peer, 12, 4_000, 1)
    peer.on_request(2_000_000_000)
    assert not peer.paced
    assert drive(peer, 15, 4_000, 1, start_us=2_004_000)[-1]


def test_requests_alone_are_not_enough():
    peer = PacedPeer()
    for i in range(50):
        peer.on_request((1_000_000 + i * 4_000) * 1_000)
    assert not peer.paced
