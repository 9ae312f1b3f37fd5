"""What passes from the ground process to the vehicle: nothing that steers it, and not too much."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.ground import filter as gate_module
from companion.ground.filter import BURST, FILE_TRANSFER_PROTOCOL, PASSING, RATE_1_S, Bucket, Gate, harmless
from companion.ground.messages import COMMAND_INT, Severity, encode_ack, encode_texts
from companion.link import codec
from companion.link.operations import Command

STEERING = {
    "SET_MODE": 11,
    "PARAM_SET": 23,
    "MISSION_SET_CURRENT": 41,
    "MISSION_COUNT": 44,
    "MISSION_CLEAR_ALL": 45,
    "MANUAL_CONTROL": 69,
    "RC_CHANNELS_OVERRIDE": 70,
    "MISSION_ITEM_INT": 73,
    "COMMAND_INT": COMMAND_INT,
    "SET_ATTITUDE_TARGET": 82,
    "SET_POSITION_TARGET_LOCAL_NED": 84,
    "SET_POSITION_TARGET_GLOBAL_INT": 86,
    "HIL_STATE_QUATERNION": 115,
    "SERIAL_CONTROL": 126,
    "SET_ACTUATOR_CONTROL_TARGET": 139,
    "SETUP_SIGNING": 256,
    "PARAM_EXT_SET": 323,
    "ODOMETRY": 331,
    "HEARTBEAT": 0,
    "TIMESYNC": 111,
}


def command(number: int) -> bytes:
    return codec.encode_command_long(1, 1, number, 0, (0.0,) * 7)


def test_the_names_are_those_of_the_numbers() -> None:
    assert {codec.message_name(number): number for number in STEERING.values()} == STEERING


@pytest.mark.parametrize("number", STEERING.values(), ids=STEERING.keys())
def test_what_steers_or_deceives_the_vehicle_does_not_pass(number: int) -> None:
    assert not harmless(number, bytes(40), 1)
    assert number not in PASSING


def test_no_command_passes_but_a_question() -> None:
    passing = [number for number in range(65536) if harmless(codec.COMMAND_LONG, command(number), 1)]
    assert passing == [Command.REQUEST_MESSAGE]
    for number in (Command.DO_SET_MODE, Command.COMPONENT_ARM_DISARM, Command.NAV_LAND, Command.SET_MESSAGE_INTERVAL):
        assert not harmless(codec.COMMAND_LONG, command(number), 1)


def test_a_command_is_read_from_a_shortened_payload() -> None:
    """What is cut off its end counts as zeros, as it does in a frame."""
    payload = codec.encode_command_long(0, 0, Command.REQUEST_MESSAGE, 0, (148.0, *(0.0,) * 6))
    assert harmless(codec.COMMAND_LONG, payload.rstrip(b"\0"), 1)
    assert not harmless(codec.COMMAND_LONG, b"", 1)


def test_answers_and_reports_pass() -> None:
    gate = Gate()
    texts = list(encode_texts(Severity.INFO, "x" * 120, 7))
    for payload in texts:
        assert gate.passes(codec.STATUSTEXT, payload, 1, 0.0)
    assert gate.passes(codec.COMMAND_ACK, encode_ack(31010, 0, 255, 190), 1, 0.0)  # type: ignore[arg-type]
    assert (gate.refused, gate.too_many) == (0, 0)


@pytest.mark.parametrize(
    ("target", "passes"), [((255, 190), True), ((1, 1), False), ((0, 0), False), ((1, 0), False), ((1, 25), True)]
)
def test_files_are_not_the_autopilots(target: tuple[int, int], passes: bool) -> None:
    payload = bytes((0, *target)) + bytes(251)
    assert harmless(FILE_TRANSFER_PROTOCOL, payload, 1) is passes
    assert harmless(FILE_TRANSFER_PROTOCOL, payload.rstrip(b"\0"), 1) is passes


@given(st.integers(0, 1 << 24), st.binary(max_size=255))
def test_anything_at_all_is_judged_and_only_the_list_passes(number: int, payload: bytes) -> None:
    if harmless(number, payload, 1):
        assert number in PASSING | {FILE_TRANSFER_PROTOCOL, codec.COMMAND_LONG}
        assert number in codec.message_formats()


def test_a_flood_is_cut_to_the_rate() -> None:
    gate, payload = Gate(), encode_ack(1, 0, 255, 190)  # type: ignore[arg-type]
    passed = sum(gate.passes(codec.COMMAND_ACK, payload, 1, i * 1e-4) for i in range(20_000))  # 2 s at 10 kHz
    assert passed == pytest.approx(BURST + 2.0 * RATE_1_S, abs=2)
    assert gate.too_many == 20_000 - passed


def test_large_messages_are_counted_by_their_bytes() -> None:
    gate, payload = Gate(), next(encode_texts(Severity.INFO, "y" * 50, 1)) + bytes(190)
    passed = sum(gate.passes(codec.STATUSTEXT, payload, 1, i * 1e-3) for i in range(1000))
    size = len(payload) + 12
    assert passed * size < gate_module.BYTES_BURST + gate_module.BYTES_1_S + size
    assert passed < BURST + RATE_1_S


def test_a_bucket_never_holds_more_than_its_burst_and_takes_no_time_back() -> None:
    bucket = Bucket(10.0, 5.0)
    assert bucket.fill(100.0) == 5.0
    bucket.take(5.0)
    assert bucket.fill(99.0) == 0.0
    assert bucket.fill(99.2) == pytest.approx(2.0)
    assert bucket.fill(500.0) == 5.0
