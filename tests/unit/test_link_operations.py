"""Asking the autopilot: repeats, refusals, waiting in line, and what it says about it."""

import math
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.link import codec, modes
from companion.link.commands import PROGRESS_S, QUIET_S, STALE_S
from companion.link.framing import Frame
from companion.link.operations import Command, Operations, Result, Retry
from companion.link.version import AutopilotVersion

ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED, FAILED, IN_PROGRESS = range(6)


class Autopilot:
    """Remembers what it was asked; answers when told to."""

    def __init__(self):
        self.commands = []
        self.names: list[str] = []
        self.targets = []
        self.operations = Operations(self._take, 1)

    def _take(self, msgid: int, payload: bytes) -> bool:
        if msgid == codec.COMMAND_LONG:
            fields = struct.unpack("<7fHBBB", payload)
            self.commands.append((fields[7], fields[10], fields[:7]))
            self.targets.append(fields[8:10])
        else:
            assert msgid == codec.PARAM_REQUEST_READ
            index, system, component, name = struct.unpack("<hBB16s", payload)
            assert index == -1
            self.names.append(name.rstrip(b"\0").decode())
            self.targets.append((system, component))
        return True

    def say(self, msgid: int, payload: bytes, now_s: float, system: int = 1, component: int = 1) -> bool:
        return self.operations.on_frame(Frame(msgid, system, component, 0, payload, b"", 0), now_s)

    def ack(self, command: int, result: int, now_s: float, progress: int = 0, to=(1, 191), **source) -> bool:
        return self.say(codec.COMMAND_ACK, struct.pack("<HBBiBB", command, result, progress, 0, *to), now_s, **source)

    def text(self, text: bytes, now_s: float, severity: int = 3, identity: int = 0, chunk: int = 0) -> None:
        self.say(codec.STATUSTEXT, struct.pack("<B50sHB", severity, text, identity, chunk), now_s)

    def value(self, name: bytes, kind: int, raw: bytes, now_s: float) -> None:
        self.say(codec.PARAM_VALUE, struct.pack("<4sHH16sB", raw, 900, 1, name, kind), now_s)


def test_arming_is_asked_for_and_accepted():
    px4 = Autopilot()
    operation = px4.operations.arm(10.0)
    assert px4.commands == [(400, 0, (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))]
    assert px4.targets == [(1, 1)]
    assert operation.pending
    assert operation.sentence == "arming is waiting for the autopilot's answer"
    assert px4.ack(400, ACCEPTED, 10.01)
    assert operation.accepted
    assert operation.ended_s == 10.01
    assert operation.sentence == "arming was accepted"


def test_what_each_request_says():
    px4 = Autopilot()
    operations = px4.operations
    operations.set_mode(modes.OFFBOARD, 0.0)
    operations.disarm(0.0)
    operations.takeoff(None, 0.0)
    operations.land(0.0)
    operations.set_message_interval(codec.ODOMETRY, 4000, 0.0)
    operations.request_message(codec.AUTOPILOT_VERSION, 0.0)
    asked = {command: params for command, _, params in px4.commands}
    assert asked[Command.DO_SET_MODE] == (1.0, 6.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    assert asked[Command.COMPONENT_ARM_DISARM] == (0.0,) * 7
    assert all(math.isnan(x) for x in asked[Command.NAV_TAKEOFF])
    assert all(math.isnan(x) for x in asked[Command.NAV_LAND])
    assert asked[Command.SET_MESSAGE_INTERVAL] == (331.0, 4000.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    assert asked[Command.REQUEST_MESSAGE] == (148.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def test_a_takeoff_altitude_is_the_seventh_parameter():
    px4 = Autopilot()
    px4.operations.takeoff(488.0, 0.0)
    assert px4.commands[0][2][6] == 488.0
    assert all(math.isnan(x) for x in px4.commands[0][2][:6])


def test_hold_is_auto_loiter():
    px4 = Autopilot()
    operation = px4.operations.set_mode(modes.HOLD, 0.0)
    assert px4.commands[0][2][:3] == (1.0, 4.0, 3.0)
    assert operation.what == "changing to Hold"


@pytest.mark.parametrize(
    ("answer", "result", "phrase"),
    [
        (TEMPORARILY_REJECTED, Result.TEMPORARILY_REJECTED, "arming was rejected for now"),
        (DENIED, Result.DENIED, "arming was denied"),
        (UNSUPPORTED, Result.UNSUPPORTED, "arming is not supported by the autopilot"),
        (FAILED, Result.FAILED, "arming failed"),
        (77, Result.FAILED, "arming failed: result 77"),
    ],
)
def test_refusals(answer, result, phrase):
    px4 = Autopilot()
    operation = px4.operations.arm(0.0)
    px4.ack(400, answer, 0.1)
    assert operation.result is result
    assert operation.sentence == phrase


def test_a_request_is_repeated_with_its_confirmation_counter_and_given_up():
    px4 = Autopilot()
    operation = px4.operations.arm(0.0, Retry(0.5, 3))
    for now_s in (0.1, 0.49, 0.5, 0.6, 0.99, 1.0, 1.4):
        px4.operations.update(now_s)
    assert [(command, confirmation) for command, confirmation, _ in px4.commands] == [(400, 0), (400, 1), (400, 2)]
    assert operation.pending
    px4.operations.update(1.5)
    assert operation.result is Result.TIMEOUT
    assert operation.sentence == "arming got no answer: asked 3 times"
    px4.operations.update(5.0)
    px4.ack(400, ACCEPTED, 5.1)
    assert len(px4.commands) == 3
    assert operation.result is Result.TIMEOUT


def test_in_progress_extends_and_stops_the_repeats():
    px4 = Autopilot()
    operation = px4.operations.takeoff(None, 0.0)
    px4.ack(22, IN_PROGRESS, 0.1, progress=30)
    assert (operation.result, operation.progress) == (Result.PENDING, 30)
    for i in range(40):
        px4.operations.update(0.1 + 0.1 * i)
    px4.ack(22, IN_PROGRESS, 4.5, progress=255)
    assert operation.progress is None
    px4.operations.update(4.4 + PROGRESS_S)
    assert operation.pending
    assert len(px4.commands) == 1
    px4.ack(22, ACCEPTED, 9.45)
    assert operation.accepted


def test_in_progress_forever_ends():
    px4 = Autopilot()
    operation = px4.operations.takeoff(None, 0.0)
    px4.ack(22, IN_PROGRESS, 0.1)
    px4.operations.update(0.1 + PROGRESS_S)
    assert operation.result is Result.TIMEOUT


@pytest.mark.parametrize(
    ("source", "to"),
    [({"system": 2}, (1, 191)), ({"component": 100}, (1, 191)), ({}, (255, 190)), ({}, (1, 190)), ({}, (2, 191))],
)
def test_answers_of_others_and_to_others_do_not_count(source, to):
    px4 = Autopilot()
    operation = px4.operations.arm(0.0)
    assert not px4.ack(400, ACCEPTED, 0.1, to=to, **source)
    assert operation.pending


def test_an_answer_to_everybody_counts():
    px4 = Autopilot()
    operation = px4.operations.arm(0.0)
    px4.ack(400, ACCEPTED, 0.1, to=(0, 0))
    assert operation.accepted


def test_answers_to_other_commands_do_not_count():
    px4 = Autopilot()
    operation = px4.operations.arm(0.0)
    px4.ack(176, ACCEPTED, 0.1)
    assert operation.pending


def test_message_rates_go_out_one_after_the_other():
    px4 = Autopilot()
    wanted = [(331, 3000), (31, 3000), (230, 100_000)]
    operations = [px4.operations.set_message_interval(msgid, us, 0.0) for msgid, us in wanted]
    sent = []
    for i in range(3):
        assert len(px4.commands) == i + 1
        sent.append(px4.commands[-1][2][:2])
        px4.ack(511, DENIED if i == 1 else ACCEPTED, 0.01 * (i + 1))
    assert sent == wanted
    assert [operation.result for operation in operations] == [Result.ACCEPTED, Result.DENIED, Result.ACCEPTED]
    assert operations[1].sentence == "setting the rate of ATTITUDE_QUATERNION was denied"


def test_a_second_answer_to_a_repeated_request_confirms_nobody_else():
    px4 = Autopilot()
    first = px4.operations.set_message_interval(331, 3000, 0.0)
    second = px4.operations.set_message_interval(31, 3000, 0.0)
    px4.operations.update(0.5)  # the answer is slow: asked again
    px4.ack(511, ACCEPTED, 0.6)
    assert first.accepted
    px4.ack(511, ACCEPTED, 0.7)  # the answer to the repetition
    assert second.pending
    px4.operations.update(0.6 + QUIET_S)
    assert px4.commands[-1][2][0] == 31.0
    px4.ack(511, DENIED, 0.85)
    assert second.result is Result.DENIED


def test_a_lost_request_does_not_cost_the_ones_behind_it_more_than_a_pause():
    px4 = Autopilot()
    operations = [px4.operations.set_message_interval(msgid, 3000, 0.0) for msgid in (331, 31, 32)]
    px4.operations.update(0.5)
    px4.ack(511, ACCEPTED, 0.51)
    px4.operations.update(0.72)
    px4.ack(511, ACCEPTED, 0.73)
    px4.ack(511, ACCEPTED, 0.74)
    assert all(operation.accepted for operation in operations)


def test_the_newest_mode_wins_at_once():
    px4 = Autopilot()
    offboard = px4.operations.set_mode(modes.OFFBOARD, 0.0)
    hold = px4.operations.set_mode(modes.HOLD, 0.05)
    assert offboard.result is Result.SUPERSEDED
    assert px4.commands[-1][2][:3] == (1.0, 4.0, 3.0)
    px4.ack(176, ACCEPTED, 0.06)  # the answer to OFFBOARD, still under way when Hold was asked for
    assert hold.pending
    px4.ack(176, ACCEPTED, 0.07)
    assert hold.accepted


def test_a_newest_mode_is_not_deaf_when_the_old_answer_was_lost():
    px4 = Autopilot()
    px4.operations.set_mode(modes.OFFBOARD, 0.0)
    hold = px4.operations.set_mode(modes.HOLD, 0.05, Retry(0.1, 100))
    px4.ack(176, ACCEPTED, 0.06)  # Hold's own answer, taken for the old one
    px4.operations.update(0.16)
    px4.ack(176, ACCEPTED, 0.17)
    assert hold.accepted
    assert len(px4.commands) == 3


def test_stale_answers_are_expected_for_a_while_only():
    px4 = Autopilot()
    px4.operations.set_mode(modes.OFFBOARD, 0.0)
    hold = px4.operations.set_mode(modes.HOLD, 0.05, Retry(10.0, 3))
    px4.ack(176, ACCEPTED, 0.05 + STALE_S)
    assert hold.accepted


def test_a_late_second_answer_does_not_confirm_the_next_mode():
    px4 = Autopilot()
    offboard = px4.operations.set_mode(modes.OFFBOARD, 0.0)
    px4.operations.update(0.5)
    px4.ack(176, ACCEPTED, 0.51)
    assert offboard.accepted
    hold = px4.operations.set_mode(modes.HOLD, 0.55)
    px4.ack(176, ACCEPTED, 0.56)
    assert hold.pending
    px4.ack(176, ACCEPTED, 0.57)
    assert hold.accepted


def test_the_same_mode_asked_for_again_is_the_same_request():
    px4 = Autopilot()
    first = px4.operations.set_mode(modes.HOLD, 0.0)
    for i in range(20):
        assert px4.operations.set_mode(modes.HOLD, 0.01 * i) is first
    assert len(px4.commands) == 1


def test_disarming_does_not_wait_for_arming():
    px4 = Autopilot()
    arming = px4.operations.arm(0.0)
    px4.operations.disarm(0.01)
    assert arming.result is Result.SUPERSEDED
    assert px4.commands[-1][2][0] == 0.0


def test_asking_every_eighth_of_a_second_until_acknowledged():
    px4 = Autopilot()
    hold = px4.operations.set_mode(modes.HOLD, 0.0, Retry(0.125, 1000))
    for i in range(1, 65):
        px4.operations.update(i / 64)
    assert len(px4.commands) == 9
    assert px4.commands[-1][1] == 8
    px4.ack(176, ACCEPTED, 1.01)
    assert hold.accepted
    for i in range(100):
        px4.operations.update(1.125 + i / 8)
    assert len(px4.commands) == 9


def test_the_confirmation_counter_stays_a_byte():
    px4 = Autopilot()
    px4.operations.set_mode(modes.HOLD, 0.0, Retry(0.1, 1000))
    for i in range(1, 400):
        px4.operations.update(0.1 * i + 1e-6)
    assert px4.commands[-1][1] == 255


def test_a_clock_that_is_set_back_does_not_stall_requests():
    px4 = Autopilot()
    px4.operations.arm(1000.0)
    px4.operations.read_parameter("A", 1000.0)
    px4.operations.update(3.0)
    px4.operations.update(3.5)
    assert len(px4.commands) == 2
    assert px4.names == ["A", "A"]


# ---- what the autopilot says ----


def test_a_refusal_is_explained_by_what_was_said_around_it():
    px4 = Autopilot()
    px4.text(b"Something old", 1.0)
    operation = px4.operations.arm(10.0)
    px4.text(b"Preflight Fail: ekf2 missing data", 10.01, severity=2)
    px4.text(b"by the way", 10.01, severity=6)
    px4.ack(400, DENIED, 10.02)
    px4.text(b"Arming denied: Resolve health failures first", 10.03, severity=2)
    px4.text(b"Something new", 12.0)
    assert operation.sentence == (
        "arming was denied: Preflight Fail: ekf2 missing data; Arming denied: Resolve health failures first"
    )


def test_an_acceptance_needs_no_explanation():
    px4 = Autopilot()
    operation = px4.operations.arm(10.0)
    px4.text(b"Low battery", 10.01, severity=2)
    px4.ack(400, ACCEPTED, 10.02)
    assert operation.sentence == "arming was accepted"


def test_long_texts_are_put_together_in_any_order():
    px4 = Autopilot()
    px4.text(b"c", 0.2, identity=5, chunk=2)
    px4.text(b"a" * 50, 0.0, identity=5, chunk=0)
    assert list(px4.operations.texts.texts) == []
    px4.text(b"b" * 50, 0.1, identity=5, chunk=1)
    (announcement,) = px4.operations.texts.texts
    assert announcement.text == "a" * 50 + "b" * 50 + "c"


def test_a_long_text_with_a_missing_chunk_is_kept_as_far_as_it_came():
    px4 = Autopilot()
    px4.text(b"a" * 50, 0.0, identity=5, chunk=0)
    px4.text(b"end", 0.1, identity=5, chunk=2)
    px4.operations.update(0.5)
    assert list(px4.operations.texts.texts) == []
    px4.operations.update(1.5)
    (announcement,) = px4.operations.texts.texts
    assert announcement.text == "a" * 50 + "..." + "end"


def test_a_long_text_without_its_end_says_so():
    px4 = Autopilot()
    px4.text(b"a" * 50, 0.0, identity=5, chunk=0)
    px4.operations.update(1.5)
    assert px4.operations.texts.texts[0].text == "a" * 50 + "..."


def test_texts_are_bounded():
    px4 = Autopilot()
    for i in range(1000):
        px4.text(str(i).encode(), 0.001 * i)
        px4.text(b"a" * 50, 0.001 * i, identity=1 + i, chunk=0)
        px4.operations.update(0.001 * i)
    assert len(px4.operations.texts.texts) <= 100


# ---- parameters ----


def test_an_integer_parameter():
    px4 = Autopilot()
    operation = px4.operations.read_parameter("COM_OBL_RC_ACT", 0.0)
    assert px4.names == ["COM_OBL_RC_ACT"]
    assert px4.targets == [(1, 1)]
    px4.value(b"COM_OBL_RC_ACT", 6, struct.pack("<i", -5), 0.1)
    assert operation.accepted
    assert operation.value == -5
    assert isinstance(operation.value, int)


def test_a_real_parameter():
    px4 = Autopilot()
    operation = px4.operations.read_parameter("COM_OF_LOSS_T", 0.0)
    px4.value(b"COM_OF_LOSS_T", 9, struct.pack("<f", 1.5), 0.1)
    assert operation.value == 1.5
    assert isinstance(operation.value, float)


def test_a_name_of_full_length_is_matched():
    px4 = Autopilot()
    operation = px4.operations.read_parameter("A234567890123456", 0.0)
    px4.value(b"A234567890123456", 6, struct.pack("<i", 1), 0.1)
    assert operation.accepted


def test_values_that_nobody_asked_for_are_ignored():
    px4 = Autopilot()
    operation = px4.operations.read_parameter("A", 0.0)
    px4.value(b"B", 6, struct.pack("<i", 1), 0.1)
    assert operation.pending
    assert operation.value is None


def test_a_parameter_of_unknown_type_fails():
    px4 = Autopilot()
    operation = px4.operations.read_parameter("A", 0.0)
    px4.value(b"A", 99, b"abcd", 0.1)
    assert operation.result is Result.FAILED


def test_a_parameter_that_does_not_exist():
    px4 = Autopilot()
    operation = px4.operations.read_parameter("NO_SUCH", 0.0)
    px4.say(codec.PARAM_ERROR, struct.pack("<hBB16sB", -1, 1, 191, b"NO_SUCH", 1), 0.1)
    assert operation.result is Result.UNSUPPORTED
    assert operation.sentence == (
        "reading NO_SUCH is not supported by the autopilot: there is no parameter of this name"
    )


def test_a_parameter_that_is_not_answered():
    px4 = Autopilot()
    operation = px4.operations.read_parameter("OLD_PX4", 0.0, Retry(0.5, 2))
    for now_s in (0.4, 0.5, 0.9, 1.0):
        px4.operations.update(now_s)
    assert px4.names == ["OLD_PX4", "OLD_PX4"]
    assert operation.result is Result.TIMEOUT
    assert "may not have it" in operation.sentence


def test_parameters_are_asked_a_few_at_a_time():
    px4 = Autopilot()
    names = [f"P{i}" for i in range(20)]
    operations = [px4.operations.read_parameter(name, 0.0) for name in names]
    assert px4.names == names[:8]
    for i, name in enumerate(names):
        px4.value(name.encode(), 6, struct.pack("<i", i), 0.01)
    assert px4.names == names
    assert [operation.value for operation in operations] == list(range(20))


def test_the_same_name_asked_again_is_the_same_request():
    px4 = Autopilot()
    assert px4.operations.read_parameter("A", 0.0) is px4.operations.read_parameter("A", 0.1)
    px4.value(b"A", 6, struct.pack("<i", 1), 0.2)
    assert px4.operations.read_parameter("A", 0.3).pending  # a new one after the answer


@pytest.mark.parametrize("name", ["", "A2345678901234567", "Ä"])
def test_names_that_cannot_be(name):
    with pytest.raises(ValueError, match="parameter name"):
        Autopilot().operations.read_parameter(name, 0.0)


# ---- version ----


@pytest.mark.parametrize(
    ("packed", "version", "label", "takes_actuators"),
    [
        (0x010D03FF, (1, 13, 3), "1.13.3", True),
        (0x010DFFFF, (1, 13, 255), "1.13.255", True),
        (0x010E00FF, (1, 14, 0), "1.14.0", False),
        (0x01120080, (1, 18, 0), "1.18.0 (beta)", False),
        (0x02000000, (2, 0, 0), "2.0.0 (dev)", False),
        (0, (0, 0, 0), "unknown version", False),
    ],
)
def test_the_version_decides_about_actuator_controls(packed, version, label, takes_actuators):
    px4 = Autopilot()
    assert px4.operations.version is None
    px4.say(codec.AUTOPILOT_VERSION, struct.pack("<QQIIIIHH", 0xFF, 42, packed, 0, 0, 0, 0, 0), 0.0)
    got = px4.operations.version
    assert isinstance(got, AutopilotVersion)
    assert got.version == version
    assert got.label == label
    assert got.accepts_actuator_control is takes_actuators
    assert (got.capabilities, got.uid) == (0xFF, 42)


# ---- anything ----


@settings(deadline=None)
@given(
    st.lists(
        st.tuples(
            st.sampled_from([codec.COMMAND_ACK, codec.PARAM_VALUE, codec.PARAM_ERROR, codec.STATUSTEXT, 148, 0]),
            st.binary(max_size=80),
        ),
        max_size=30,
    )
)
def test_random_messages_never_raise(messages):
    px4 = Autopilot()
    px4.operations.arm(0.0)
    px4.operations.set_mode(modes.HOLD, 0.0)
    px4.operations.read_parameter("A", 0.0)
    for i, (msgid, payload) in enumerate(messages):
        px4.say(msgid, payload, 0.1 * i)
        px4.operations.update(0.1 * i)


def test_other_messages_are_not_taken():
    assert not Autopilot().say(codec.HEARTBEAT, codec.encode_heartbeat(), 0.0)
