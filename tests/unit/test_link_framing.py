"""Finding, checking and building frames."""

import hashlib
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.link import codec
from companion.link.framing import Frame, FrameParser, LinkCounters, build_frame

LIBRARY = codec.dialect()
FORMATS = codec.message_formats()


def heartbeat(seq: int = 0, system: int = 1, component: int = 1, custom_mode: int = 0xFDFEFD) -> bytes:
    return build_frame(0, codec.encode_heartbeat(2, 12, 0, custom_mode), seq, system, component, FORMATS[0].crc_extra)


class Feed:
    """A parser with everything it hands out."""

    def __init__(self, guard=None):
        self.counters = LinkCounters()
        self.frames: list[Frame] = []
        self.unknown: list[bytes] = []
        self.parser = FrameParser(FORMATS, self.counters, guard)

    def __call__(self, data: bytes, final: bool = True) -> int:
        return self.parser.parse(data, 5, self.frames, self.unknown, final)


def test_several_frames_in_one_datagram():
    feed = Feed()
    feed(heartbeat(1) + heartbeat(2) + heartbeat(3))
    assert [frame.seq for frame in feed.frames] == [1, 2, 3]
    assert (feed.counters.received, feed.counters.garbage_bytes) == (3, 0)


def test_a_frame_carries_its_header_and_its_bytes():
    feed = Feed()
    raw = heartbeat(9, 17, 191)
    feed(raw)
    frame = feed.frames[0]
    assert (frame.msgid, frame.sysid, frame.compid, frame.seq, frame.raw, frame.arrival_wall_ns) == (
        0,
        17,
        191,
        9,
        raw,
        5,
    )
    assert frame.payload == codec.encode_heartbeat(2, 12, 0, 0xFDFEFD)


def test_a_version_1_frame_is_read():
    sender = LIBRARY.MAVLink(None, srcSystem=4, srcComponent=5)
    raw = bytes(LIBRARY.MAVLink_heartbeat_message(2, 12, 81, 7, 3, 3).pack(sender, force_mavlink1=True))
    assert raw[0] == 0xFE
    feed = Feed()
    feed(raw)
    assert (feed.frames[0].sysid, feed.frames[0].compid, feed.frames[0].msgid) == (4, 5, 0)
    assert codec.decode_heartbeat(feed.frames[0].payload).base_mode == 81


def test_truncated_zeros_are_restored():
    raw = build_frame(331, bytes(233), 0, 1, 1, FORMATS[331].crc_extra)
    assert len(raw) == 12 + 1  # one payload byte stays
    feed = Feed()
    feed(raw)
    assert feed.frames[0].payload == bytes(233)


@settings(deadline=None)
@given(st.binary(min_size=1, max_size=255), st.sampled_from(sorted(FORMATS)))
def test_what_is_built_is_read_with_its_extensions(payload, msgid):
    feed = Feed()
    feed(build_frame(msgid, payload, 0, 1, 1, FORMATS[msgid].crc_extra))
    assert len(feed.frames) == 1
    got = feed.frames[0].payload
    assert len(got) >= FORMATS[msgid].length
    assert got.rstrip(b"\0") == payload.rstrip(b"\0")


@pytest.mark.parametrize("at", range(12 + 9))
def test_one_wrong_byte_costs_one_frame(at):
    raw = bytearray(heartbeat(1))
    raw[at] ^= 0x11
    feed = Feed()
    feed(bytes(raw) + heartbeat(2) + heartbeat(3))
    assert [frame.seq for frame in feed.frames] == [2, 3]
    assert feed.counters.bad_crc + feed.counters.unknown + feed.counters.garbage_bytes > 0


def test_a_wrong_checksum_is_counted_once():
    raw = heartbeat(1, custom_mode=4)
    feed = Feed()
    feed(raw[:-1] + bytes([raw[-1] ^ 1]))
    assert (feed.counters.bad_crc, feed.counters.received, feed.frames) == (1, 0, [])


def test_unknown_messages_are_counted_and_kept_for_the_log():
    stranger = build_frame(40000, b"hello", 0, 1, 1, 99)
    feed = Feed()
    feed(stranger + heartbeat(1))
    assert feed.unknown == [stranger]
    assert feed.counters.unknown == 1
    assert len(feed.frames) == 1


def test_unknown_flags_are_not_read():
    raw = bytearray(heartbeat(1))
    raw[2] = 0x02
    feed = Feed()
    feed(bytes(raw))
    assert feed.frames == []
    assert feed.counters.garbage_bytes == len(raw)


@settings(deadline=None)
@given(st.binary(max_size=600))
def test_garbage_never_raises_and_never_stays(data):
    feed = Feed()
    assert feed(data) == len(data)


@settings(deadline=None)
@given(st.binary(max_size=300), st.integers(0, 255))
def test_a_frame_behind_garbage_is_found(noise, seq):
    garbage = noise.replace(b"\xfd", b"").replace(b"\xfe", b"")
    feed = Feed()
    feed(garbage + heartbeat(seq))
    assert [frame.seq for frame in feed.frames] == [seq]
    assert feed.counters.garbage_bytes == len(garbage)


@pytest.mark.parametrize(
    "start", [b"\xfd\xff\x00", b"\xfe\xff", b"\xfd", b"\xfd\x09\x00\x00", b"\xfe\x09\x00\x01\x01\x00"]
)
def test_the_start_of_a_frame_that_never_came_hides_nothing(start):
    feed = Feed()
    feed(start + heartbeat(1) + heartbeat(2))
    assert [frame.seq for frame in feed.frames] == [1, 2]


@settings(deadline=None)
@given(st.lists(st.integers(1, 40), max_size=60), st.randoms(use_true_random=False))
def test_a_stream_may_be_cut_anywhere(cuts, rng: random.Random):
    stream = b"".join(heartbeat(seq) for seq in range(20))
    feed = Feed()
    left = b""
    at = 0
    for cut in [*cuts, len(stream)]:
        left += stream[at : at + cut]
        at += cut
        left = left[feed(left, final=False) :]
    assert left == b""
    assert [frame.seq for frame in feed.frames] == list(range(20))
    assert feed.counters.garbage_bytes == 0


def test_losses_are_counted_per_sender():
    feed = Feed()
    for seq in (250, 251, 254, 255, 0, 3):
        feed(heartbeat(seq))
    for seq in (10, 11):
        feed(heartbeat(seq, 2, 1))
    assert feed.counters.lost == {(1, 1): 4, (2, 1): 0}


def test_duplicates_and_late_frames_are_no_losses():
    feed = Feed()
    for seq in (5, 5, 7, 6, 8):
        feed(heartbeat(seq))
    assert feed.counters.lost == {(1, 1): 1}  # 6 was missing when 7 came


class KeyedGuard:
    """A stand-in for signing: the signature is a hash with a key."""

    def __init__(self, key: bytes):
        self.key = key

    def sign(self, unsigned: bytes) -> bytes:
        return hashlib.sha256(self.key + unsigned).digest()[:13]

    def verify(self, raw: bytes, msgid: int, signed: bool) -> bool:
        return signed and self.sign(raw[:-13]) == raw[-13:]


def signed_heartbeat(seq: int, guard: KeyedGuard) -> bytes:
    return build_frame(0, codec.encode_heartbeat(2, 12), seq, 1, 1, FORMATS[0].crc_extra, guard)


def test_signed_frames_are_read_without_a_guard_too():
    feed = Feed()
    feed(signed_heartbeat(1, KeyedGuard(b"a")) + heartbeat(2))
    assert [frame.seq for frame in feed.frames] == [1, 2]
    assert feed.counters.garbage_bytes == 0


def test_the_guard_decides():
    guard = KeyedGuard(b"a")
    feed = Feed(guard)
    feed(signed_heartbeat(1, guard) + signed_heartbeat(2, KeyedGuard(b"b")) + heartbeat(3) + signed_heartbeat(4, guard))
    assert [frame.seq for frame in feed.frames] == [1, 4]
    assert feed.counters.bad_signature == 2


def test_a_signed_frame_is_one_to_pymavlink():
    raw = signed_heartbeat(1, KeyedGuard(b"a"))
    message = LIBRARY.MAVLink(None).decode(bytearray(raw))
    assert message.get_type() == "HEARTBEAT"
