"""Frames on a serial line: noise costs what it hits, and a line that is silent holds nothing back."""

from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.link import codec
from companion.link.framing import Frame, FrameParser, LinkCounters, build_frame
from companion.link.line import SILENCE_NS, LineReader

FORMATS = codec.message_formats()
LAND = codec.encode_command_long(1, 1, 21, 0, (0.0,) * 7)
HEADERS = [b"\xfd\xff\x00", b"\xfe\xff"]


def land(seq: int) -> bytes:
    return build_frame(codec.COMMAND_LONG, LAND, seq, 255, 190, FORMATS[codec.COMMAND_LONG].crc_extra)


def stranger(content: bytes) -> bytes:
    return build_frame(40000, content, 0, 1, 1, 99)


class Line:
    """A reader with all that it handed out, and a clock."""

    def __init__(self):
        self.counters = LinkCounters()
        self.reader = LineReader(FrameParser(FORMATS, self.counters))
        self.frames: list[Frame] = []
        self.unknown: list[bytes] = []
        self.now_ns = 10**9

    def __call__(self, data: bytes) -> list[int]:
        """The sequence numbers of all frames so far."""
        self.reader.take(data, self.now_ns, self.frames, self.unknown)
        return self.seqs

    @property
    def seqs(self) -> list[int]:
        return [frame.seq for frame in self.frames]

    def silent(self) -> list[int]:
        self.now_ns += SILENCE_NS
        self.reader.rest(self.now_ns, self.frames, self.unknown)
        return self.seqs


@pytest.mark.parametrize("noise", HEADERS)
def test_commands_behind_noise_are_all_there_whatever_the_border(noise):
    """The made-up frame of `noise` ends with the sixth command, where the data end too."""
    whole = Line()
    for seq in range(6):
        whole((noise if seq == 0 else b"") + land(seq))
    assert whole.silent() == list(range(6))
    running = Line()
    for seq in range(12):  # with the seventh right behind
        running((noise if seq == 0 else b"") + land(seq))
    assert running.silent() == list(range(12))
    for line in (whole, running):
        assert line.unknown == []
        assert (line.counters.unknown, line.counters.garbage_bytes) == (0, len(noise))
        assert line.counters.lost == {(255, 190): 0}


@pytest.mark.parametrize("noise", HEADERS)
def test_a_command_behind_noise_waits_for_a_silence_and_not_longer(noise):
    line = Line()
    assert line(noise + land(1)) == []
    came_ns = line.now_ns
    line.now_ns += SILENCE_NS - 1
    assert line.reader.wait_s(line.now_ns) == pytest.approx(1e-9)
    line.reader.rest(line.now_ns, line.frames, line.unknown)
    assert line.seqs == []
    assert line.silent() == [1]
    assert line.frames[0].arrival_wall_ns == came_ns  # and not when it was found
    assert line.reader.wait_s(line.now_ns) == float("inf")
    assert line(land(2)) == [1, 2]


def test_the_rest_of_a_frame_may_come_after_a_silence():
    line, raw = Line(), land(1)
    line(raw[:20])
    assert line.reader.wait_s(line.now_ns) > 0.0
    assert line.silent() == []
    assert line.reader.wait_s(line.now_ns) == float("inf")  # nothing waits behind it: no need to look again
    assert line(raw[20:]) == [1]
    assert line.counters.garbage_bytes == 0


@pytest.mark.parametrize("content", [b"hello", b"\xfe\xfd\x00", b"\xfd" * 40])
def test_an_unknown_message_is_one_when_a_frame_or_silence_is_behind_it(content):
    first, second = stranger(content), stranger(content + b"!")
    line = Line()
    assert line(first + land(1)[:30]) == []
    assert line.unknown == []
    assert line(land(1)[30:] + first + second) == [1]
    assert line.silent() == [1]
    assert line.unknown == [first, first, second]
    assert (line.counters.unknown, line.counters.garbage_bytes) == (3, 0)


def test_noise_and_an_unknown_message_before_a_silence():
    line = Line()
    assert line(stranger(b"hello") + HEADERS[0] + land(1) + HEADERS[1] + land(2)) == []
    assert line.silent() == [1, 2]
    assert line.unknown == [stranger(b"hello")]
    assert line.counters.garbage_bytes == 5


GOOD = st.sampled_from(["land", "heartbeat", "odometry"])
PARTS = [*HEADERS, b"\xfd\x05\x00", b"\xfd", b"\xfe", b"\xfe\x04", b"\0", b"\x01\x01"]
NOISE = st.lists(st.sampled_from(PARTS) | st.binary(max_size=8), max_size=5)


def good(kind: str, seq: int) -> bytes:
    if kind == "land":
        return land(seq)
    if kind == "heartbeat":
        return build_frame(0, codec.encode_heartbeat(2, 12, 0, 0xFDFEFD), seq, 1, 1, FORMATS[0].crc_extra)
    return build_frame(331, bytes((0xFD, seq, 0, 0xFE)) * 58, seq, 1, 1, FORMATS[331].crc_extra)


@settings(deadline=None, max_examples=300)
@given(st.lists(st.tuples(NOISE.map(b"".join) | st.just(b""), GOOD), max_size=20), st.data())
def test_noise_loses_no_more_than_what_it_hits(pieces, data):
    stream = b"".join(noise + good(kind, seq) for seq, (noise, kind) in enumerate(pieces))
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=40)))
    line = Line()
    for begin, end in pairwise([0, *cuts, len(stream)]):
        line.now_ns += data.draw(st.sampled_from([0, 1_000_000, 2 * SILENCE_NS]), "wait [ns]")
        if data.draw(st.booleans(), "looked"):
            line.reader.rest(line.now_ns, line.frames, line.unknown)
        line(stream[begin:end])
    line.silent()
    missing = set(range(len(pieces))) - set(line.seqs)
    assert line.seqs == sorted(set(line.seqs))
    assert all(pieces[seq][0] for seq in missing)  # noise was right before it
    if not any(b"\xfd" in noise or b"\xfe" in noise for noise, _ in pieces):
        assert not missing
        assert line.counters.garbage_bytes == sum(len(noise) for noise, _ in pieces)


@settings(deadline=None)
@given(st.lists(st.binary(max_size=300), max_size=8))
def test_what_is_held_stays_small(reads):
    line = Line()
    for read in reads:
        line(read)
        assert len(line.reader._held) <= 2 * 280
        line.silent()
        assert len(line.reader._held) <= 2 * 280
