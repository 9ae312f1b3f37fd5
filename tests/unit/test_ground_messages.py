"""The ground side's bytes against pymavlink's, and the talk between the two processes."""

from __future__ import annotations

import math
import socket
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.ground.channel import Channel, Copy, Outgoing
from companion.ground.messages import (
    AckResult,
    Severity,
    Targets,
    decode_command,
    decode_debug_vect,
    decode_named_value,
    encode_ack,
    encode_autopilot_version,
    encode_debug_vect,
    encode_named_value,
    encode_texts,
    targets_of,
)
from companion.ground.standing import PHASE_CODES, Standing, phase_of_code, trajectory_of_code
from companion.ground.undertakings import Undertakings
from companion.link import codec
from companion.link.framing import build_frame
from companion.link.statustext import StatusTexts

LIBRARY: Any = codec.dialect()


def decoded(msgid: int, payload: bytes) -> Any:
    raw = build_frame(msgid, payload, 0, 1, 191, codec.message_formats()[msgid].crc_extra)
    return LIBRARY.MAVLink(None).decode(bytearray(raw))


def payload_of(message: Any) -> bytes:
    return bytes(message.pack(LIBRARY.MAVLink(None))[10:-2])


def test_acknowledgements() -> None:
    message = decoded(codec.COMMAND_ACK, encode_ack(31010, AckResult.IN_PROGRESS, 255, 190, 40))
    assert (message.command, message.result, message.progress) == (31010, 5, 40)
    assert (message.target_system, message.target_component) == (255, 190)
    assert decoded(codec.COMMAND_ACK, encode_ack(21, AckResult.DENIED, 255, 190)).progress == 0


def test_values() -> None:
    message = decoded(251, encode_named_value(1234, "time_to_go", 5.5))
    assert (message.time_boot_ms, message.name, message.value) == (1234, "time_to_go", 5.5)
    assert decode_named_value(payload_of(message)) == ("time_to_go", 5.5)
    message = decoded(250, encode_debug_vect(987, "disturb", (1.0, -2.0, 0.5)))
    assert (message.time_usec, message.name, message.x, message.y, message.z) == (987, "disturb", 1.0, -2.0, 0.5)
    assert decode_debug_vect(payload_of(message)) == ("disturb", (1.0, -2.0, 0.5))


def test_version() -> None:
    message = decoded(codec.AUTOPILOT_VERSION, encode_autopilot_version((1, 2, 3)))
    assert message.flight_sw_version == 0x01020300
    assert message.capabilities & LIBRARY.MAV_PROTOCOL_CAPABILITY_FTP


@pytest.mark.parametrize("text", ["short", "x" * 50, "x" * 51, "y" * 100, "z" * 149, "å" * 60, "å" * 25])
def test_texts_of_any_length_arrive_whole(text: str) -> None:
    texts = StatusTexts()
    for payload in encode_texts(Severity.WARNING, text, 9):
        decoded(codec.STATUSTEXT, payload)
        texts.add(codec.decode_statustext(payload), 0.0)
    assert [said.text for said in texts.texts] == [text]
    assert [said.severity for said in texts.texts] == [4]


@pytest.mark.parametrize(
    ("text", "arrives"),
    [
        ("a file " + "x" * 42 + "å is refused", "a file  " + "x" * 42 + "å is refused"),
        ("a file " + "x" * 41 + "→ is refused", "a file   " + "x" * 41 + "→ is refused"),
        ("x" * 49 + "å is refused", "x" * 49 + "? is refused"),
        ("x" * 49 + "å", "x" * 49 + "?"),
        ("x" * 48 + "→→ refused", "x" * 48 + "?? refused"),
    ],
)
def test_a_character_on_the_border_of_two_chunks_is_moved_or_given_up(text: str, arrives: str) -> None:
    texts = StatusTexts()
    for payload in encode_texts(Severity.WARNING, text, 9):
        texts.add(codec.decode_statustext(payload), 0.0)
    assert [said.text for said in texts.texts] == [arrives]


@settings(deadline=None)
@given(st.text(st.sampled_from("ab å→🚁"), max_size=400))
def test_every_chunk_of_a_text_can_be_read_by_itself(text: str) -> None:
    """As pymavlink and ground stations do; only the last one may say that the text ends."""
    chunks = [codec.decode_statustext(payload) for payload in encode_texts(Severity.INFO, text, 9)]
    read = "".join(chunk.text.decode("utf-8", "strict") for chunk in chunks)
    assert [chunk.complete for chunk in chunks] == [False] * (len(chunks) - 1) + [True]
    given_up = [wanted if found == "?" else found for found, wanted in zip(*squeezed(read, text), strict=True)]
    assert "".join(given_up) == squeezed(text)[0]


def squeezed(*texts: str) -> list[str]:
    """Without blanks."""
    return [text.replace(" ", "") for text in texts]


def test_commands_are_read_as_pymavlink_writes_them() -> None:
    long = LIBRARY.MAVLink_command_long_message(1, 191, 31010, 2, 3.0, *(math.nan,) * 6)
    command = decode_command(codec.COMMAND_LONG, payload_of(long))
    assert command is not None
    assert (command.command, command.params[0], command.confirmation) == (31010, 3.0, 2)
    assert (command.target_system, command.target_component) == (1, 191)
    whole = LIBRARY.MAVLink_command_int_message(1, 191, 0, 193, 0, 0, 1.0, 0.0, 0.0, 0.0, 5, 6, 7.0)
    command = decode_command(75, payload_of(whole))
    assert command is not None
    assert (command.command, command.params) == (193, (1.0, 0.0, 0.0, 0.0, 5, 6, 7.0))
    assert (command.target_system, command.target_component) == (1, 191)


def test_whom_messages_are_for() -> None:
    assert targets_of(
        codec.COMMAND_LONG, payload_of(LIBRARY.MAVLink_command_long_message(7, 8, 1, 0, *(0.0,) * 7))
    ) == (Targets(7, 8))
    file = LIBRARY.MAVLink_file_transfer_protocol_message(0, 7, 8, bytes(251))
    assert targets_of(110, payload_of(file)) == Targets(7, 8)
    asked = LIBRARY.MAVLink_param_request_read_message(7, 8, b"NAME", -1)
    assert targets_of(codec.PARAM_REQUEST_READ, payload_of(asked)) == Targets(7, 8)
    assert targets_of(codec.COMMAND_LONG, b"") == Targets(0, 0)
    assert targets_of(codec.HEARTBEAT, bytes(9)) is None


def test_standing_in_a_heartbeat_and_in_a_note() -> None:
    standing = Standing(
        3, True, "Hold", 5, True, "pause", True, "eight", 300, error_m=0.1, disturbance_m_s2=(1.0, 2.0, 3.0)
    )
    assert Standing.from_note(standing.as_note()) == standing
    assert (phase_of_code(standing.custom_code), trajectory_of_code(standing.custom_code)) == ("pause", 300)
    assert standing.custom_code >> 8 & 0b111 == 0b111
    assert phase_of_code(200) == "unknown"
    assert all(phase_of_code(Standing(phase=phase).custom_code) == phase for phase in PHASE_CODES)
    assert len(set(PHASE_CODES.values())) == len(PHASE_CODES)


@pytest.fixture
def ends() -> Iterator[tuple[Channel, Channel, socket.socket]]:
    first, second = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with first, second:
        yield Channel(first), Channel(second), second


def test_what_is_said_arrives(ends: tuple[Channel, Channel, socket.socket]) -> None:
    one, other, _ = ends
    assert one.note(request=1, what="start", name="ä")
    assert one.copy(b"\xfd raw")
    assert one.outgoing(253, b"payload")
    assert other.receive(2) == [{"request": 1, "what": "start", "name": "ä"}, Copy(b"\xfd raw")]
    assert other.receive(2) == [Outgoing(253, b"payload")]
    assert other.receive(2) == []


def test_rubbish_is_left_out_and_a_full_pair_never_blocks(ends: tuple[Channel, Channel, socket.socket]) -> None:
    one, other, raw = ends
    for datagram in (b"?", b"N{", b"N[1]", b"S\1", b"N" + b"[" * 5000, b"N\xff\xff"):
        raw.send(datagram)
    assert one.receive(10) == []
    assert one.unreadable == 6
    while one.copy(bytes(1000)):
        pass
    assert one.dropped == 1
    other.discard()
    assert other.receive(5) == []
    assert one.copy(b"again")
    assert other.receive(5) == [Copy(b"again")]


def test_nobody_at_the_other_end() -> None:
    first, second = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with first:
        second.close()
        channel = Channel(first)
        assert not channel.note(line="anybody?")
        assert channel.receive(3) == []
        channel.discard()


def test_undertakings_end_once() -> None:
    ended: list[tuple[int, bool, str]] = []
    undertakings, flags = Undertakings(lambda *end: ended.append(end)), {1: False, 2: True}
    for number in flags:
        undertakings.add(number, f"thing {number}", lambda number=number: flags[number])  # type: ignore[misc]
    undertakings.check()
    undertakings.check()
    assert ended == [(2, True, "")]
    undertakings.replace("stop")
    undertakings.fail("nothing is left")
    assert ended[1:] == [(1, False, "thing 1: replaced by stop")]
