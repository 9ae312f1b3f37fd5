"""Signing against pymavlink's, both ways, and what a guard refuses."""

import copy
import pickle
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.link import codec
from companion.link.framing import Frame, FrameParser, LinkCounters, build_frame
from companion.link.signing import (
    EPOCH_S,
    NEW_STREAM_LATE,
    RADIO_STATUS,
    SETUP_SIGNING,
    STREAMS_MAX,
    TIME_END,
    TIME_LATEST,
    UNITS_PER_S,
    UNSIGNED_ALLOWED,
    Signer,
    SigningKey,
    SigningTimes,
    stream_of,
    time_now,
)

LIBRARY = codec.dialect()
FORMATS = codec.message_formats()
KEY = SigningKey(bytes(range(32)))
OTHER = SigningKey(bytes(range(1, 33)))
TIMES = st.integers(0, 1 << 47)


class At(Signer):
    """A signer whose clock stands still, at a time of ours."""

    def __init__(self, key=KEY, at=0, link_id=0, **times):
        super().__init__(key, SigningTimes(newest=at, streams={}, link_id=link_id, **times))
        self._zero_ns = -(10**19)  # the clock is in the far past: only `newest` counts


def library_signer(at, link_id=0, system=1, component=1, key=KEY):
    sender = LIBRARY.MAVLink(None, srcSystem=system, srcComponent=component)
    sender.signing.secret_key = key.secret
    sender.signing.timestamp = at
    sender.signing.link_id = link_id
    sender.signing.sign_outgoing = True
    return sender


def parsed(raw, guard) -> list[Frame]:
    frames: list[Frame] = []
    FrameParser(FORMATS, LinkCounters(), guard).parse(raw, 1, frames, [])
    return frames


def signed(signer, seq=0, system=1, component=1, mode=5):
    payload = codec.encode_heartbeat(2, 12, 0, mode)
    return build_frame(0, payload, seq, system, component, FORMATS[0].crc_extra, signer)


@settings(deadline=None)
@given(
    secret=st.binary(min_size=32, max_size=32),
    payload=st.binary(min_size=36, max_size=36),
    at=TIMES,
    link_id=st.integers(0, 255),
    system=st.integers(1, 255),
    component=st.integers(0, 255),
    seq=st.integers(0, 255),
)
def test_signs_byte_for_byte_as_the_library(secret, payload, at, link_id, system, component, seq):
    key = SigningKey(secret)
    sender = library_signer(at + 1, link_id, system, component, key)
    sender.seq = seq
    message = LIBRARY.MAVLink_attitude_target_message(*_attitude_target(payload))
    theirs = bytes(message.pack(sender))
    plain = message._payload
    ours = build_frame(83, bytes(plain), seq, system, component, FORMATS[83].crc_extra, At(key, at, link_id))
    assert ours == theirs


def _attitude_target(payload):
    import struct

    t, *rest = struct.unpack("<I8f", payload)
    q, rates, thrust = rest[:4], rest[4:7], rest[7]
    return t, payload[0], q, *rates, thrust


@settings(deadline=None)
@given(at=TIMES, link_id=st.integers(0, 255), system=st.integers(1, 255), mode=st.integers(0, 2**32 - 1))
def test_the_library_reads_what_is_signed_here(at, link_id, system, mode):
    receiver = library_signer(at)
    raw = signed(At(KEY, at, link_id), 3, system, 191, mode)
    message = receiver.decode(bytearray(raw))
    assert (message.custom_mode, message.get_srcSystem()) == (mode, system)
    assert message.get_signed()
    wrong = bytearray(raw)
    wrong[-1] ^= 1
    with pytest.raises(LIBRARY.MAVError):
        library_signer(at).decode(wrong)


@settings(deadline=None)
@given(at=TIMES, link_id=st.integers(0, 255), system=st.integers(1, 255), mode=st.integers(0, 2**32 - 1))
def test_what_the_library_signs_is_read_here(at, link_id, system, mode):
    sender = library_signer(at, link_id, system, 7)
    raw = bytes(LIBRARY.MAVLink_heartbeat_message(2, 12, 0, mode, 3, 3).pack(sender))
    guard = At(KEY, at)
    (frame,) = parsed(raw, guard)
    assert codec.decode_heartbeat(frame.payload).custom_mode == mode
    assert guard.times.streams == {stream_of(system, 7, link_id): at}
    assert guard.counters.accepted == 1


@settings(deadline=None)
@given(at=st.integers(NEW_STREAM_LATE, 1 << 47), ago=st.integers(-(10**8), 10**8), again=st.integers(-3, 3))
def test_agrees_with_the_library_on_what_is_too_old(at, ago, again):
    """New streams and known ones, at the borders of the rule too."""
    first, second = max(0, at - ago), max(0, at - ago + again)
    theirs, ours = library_signer(at), At(KEY, at)
    for when in (first, second):
        raw = bytes(LIBRARY.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3).pack(library_signer(when)))
        try:
            accepted = theirs.decode(bytearray(raw)) is not None
        except LIBRARY.MAVError:
            accepted = False
        assert bool(parsed(raw, ours)) == accepted
    assert ours.now() == theirs.signing.timestamp


@settings(deadline=None)
@given(st.integers(0, 1000), st.integers(1, 255))
def test_one_changed_byte_anywhere_is_one_too_many(where, change):
    sender = At(KEY, 10**12)
    raw = bytearray(signed(sender))
    raw[where % len(raw)] ^= change
    guard = At(KEY, 10**12)
    assert parsed(bytes(raw), guard) == []
    assert guard.times.streams == {}


def test_a_changed_signature_is_refused_though_the_checksum_is_right():
    guard = At(KEY, 10**12)
    for byte in range(1, 14):
        raw = bytearray(signed(At(KEY, 10**12)))
        raw[-byte] ^= 0x40
        assert parsed(bytes(raw), guard) == []
    assert guard.counters.wrong == 13
    assert guard.counters.refused == 13


def test_another_key_is_refused_and_leaves_no_trace():
    guard = At(KEY, 10**12)
    assert parsed(signed(At(OTHER, 10**13)), guard) == []
    assert guard.counters.wrong == 1
    assert (guard.times.streams, guard.now()) == ({}, 10**12)


def test_unsigned_is_refused_but_for_the_short_list():
    guard = At(KEY, 10**12)
    assert parsed(build_frame(0, bytes(9), 0, 1, 1, FORMATS[0].crc_extra), guard) == []
    sender = LIBRARY.MAVLink(None, srcSystem=51, srcComponent=68)
    version_1 = bytes(LIBRARY.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3).pack(sender, force_mavlink1=True))
    assert parsed(version_1, guard) == []
    radio = bytes(LIBRARY.MAVLink_radio_status_message(1, 2, 3, 4, 5, 6, 7).pack(sender))
    assert [frame.msgid for frame in parsed(radio, guard)] == [RADIO_STATUS]
    assert (guard.counters.unsigned, guard.counters.allowed_unsigned) == (2, 1)
    assert {RADIO_STATUS} == UNSIGNED_ALLOWED


def test_every_message_needs_a_signature_but_for_the_short_list():
    guard = At(KEY, 10**12)
    for msgid, known in FORMATS.items():
        raw = build_frame(msgid, bytes(known.length) or b"\0", 0, 1, 1, known.crc_extra)
        assert bool(parsed(raw, guard)) == (msgid == RADIO_STATUS)


def test_a_repeated_frame_counts_as_a_recording():
    guard, raw = At(KEY, 10**12), signed(At(KEY, 10**12))
    assert len(parsed(raw, guard)) == 1
    assert parsed(raw, guard) == []
    assert (guard.counters.replayed, guard.outdated) == (1, 1)


def test_streams_are_kept_apart_by_system_component_and_link():
    guard = At(KEY, 10**12)
    for system, component, link in ((1, 1, 0), (2, 1, 0), (1, 2, 0), (1, 1, 1)):
        raw = signed(At(KEY, 10**12, link), 0, system, component)
        assert len(parsed(raw, guard)) == 1
        assert parsed(raw, guard) == []
    assert len(guard.times.streams) == 4


def test_nothing_up_to_the_floor_is_accepted():
    guard = At(KEY, 10**12, floor=10**12 + 50)
    sender = At(KEY, 10**12 + 49)
    assert parsed(signed(sender), guard) == []  # at 10**12 + 50
    assert guard.counters.stale == 1
    assert len(parsed(signed(sender), guard)) == 1
    known = At(KEY, 10**12, floor=10**12 + 50)
    known.times.streams[stream_of(1, 1, 0)] = 10**12
    assert parsed(signed(At(KEY, 10**12 + 48)), known) == []


def test_a_time_that_is_ahead_is_taken_over():
    guard = At(KEY, 10**12)
    parsed(signed(At(KEY, 2 * 10**12)), guard)
    assert guard.now() == 2 * 10**12 + 1
    assert int.from_bytes(guard.sign(b"x")[1:7], "little") == 2 * 10**12 + 2


def test_a_time_near_the_end_of_all_times_is_not_taken_over():
    guard = At(KEY, 10**12)
    for known in (False, True):  # a new stream, and one that was heard
        before = guard.now()
        assert not parsed(signed(At(KEY, TIME_END - 3)), guard)
        assert not parsed(signed(At(KEY, TIME_LATEST)), guard)  # signs with the time after that
        assert (guard.now(), bool(guard.times.streams)) == (before, known)
        assert parsed(signed(At(KEY, 10**12 + known)), guard)
    assert (guard.counters.stale, guard.outdated) == (4, 4)
    assert parsed(signed(At(KEY, TIME_LATEST - 1)), guard)


def test_at_the_end_of_all_times_signing_goes_on():
    signer = At(KEY, TIME_END - 2)
    times = [int.from_bytes(signer.sign(b"x")[1:7], "little") for _ in range(3)]
    assert times == [TIME_END - 1] * 3


def test_many_streams_forget_the_silent_ones_only():
    guard = At(KEY, 10**12)
    for link in range(STREAMS_MAX):
        assert parsed(signed(At(KEY, 10**12, link)), guard)
    assert parsed(signed(At(KEY, 10**12, 200)), guard) == []
    assert guard.counters.too_many == 1
    guard.times.newest += NEW_STREAM_LATE + 2
    late = signed(At(KEY, 10**12 + NEW_STREAM_LATE, 200))
    assert parsed(late, guard)
    assert len(guard.times.streams) == STREAMS_MAX
    for link in range(STREAMS_MAX):  # what was forgotten cannot come back
        assert parsed(signed(At(KEY, 10**12, link)), guard) == []


def test_the_clock_is_read_in_units_of_ten_microseconds_since_2015():
    before = time.time()
    unix_s = EPOCH_S + time_now() / UNITS_PER_S
    assert before - 0.001 <= unix_s <= time.time()
    assert time.gmtime(EPOCH_S)[:6] == (2015, 1, 1, 0, 0, 0)
    signer = Signer(KEY, SigningTimes(0, {}))
    first = int.from_bytes(signer.sign(b"")[1:7], "little")
    assert time_now() - UNITS_PER_S < first <= time_now()
    times = [int.from_bytes(signer.sign(b"")[1:7], "little") for _ in range(1000)]
    assert times == sorted(set(times))
    assert times[0] > first


def test_a_step_of_the_clock_does_not_reach_a_running_signer(monkeypatch):
    signer = Signer(KEY, SigningTimes(0, {}))
    before = signer.now()
    monkeypatch.setattr(time, "time_ns", lambda: 0)
    assert before <= signer.now() < before + 60 * UNITS_PER_S


def test_a_key_is_not_shown_and_not_copied():
    secret = bytes(range(32))
    for text in (repr(KEY), str(KEY), f"{KEY!r}", KEY.fingerprint):
        assert secret.hex() not in text
        assert repr(secret) not in text
    with pytest.raises(TypeError):
        pickle.dumps(KEY)
    with pytest.raises(TypeError):
        copy.copy(KEY)
    with pytest.raises(ValueError, match="32"):
        SigningKey(b"short")
    assert KEY.fingerprint != OTHER.fingerprint
    assert SETUP_SIGNING not in UNSIGNED_ALLOWED
