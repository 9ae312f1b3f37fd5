"""Commands of ground tools: taken once, answered as often as asked, refused with a reason."""

from __future__ import annotations

import math
import struct
from typing import Any

import pytest

from companion.ground.commands import (
    DONE_TIMEOUT_S,
    PROGRESS_INTERVAL_S,
    REPEAT_S,
    TAKEN_TIMEOUT_S,
    CommandServer,
    UserCommand,
)
from companion.ground.messages import COMMAND_INT, AckResult, Severity
from companion.ground.service import GroundLink
from companion.link import codec
from companion.link.framing import Frame

TOOL = (255, 190)
ACCEPTED, REJECTED, DENIED, UNSUPPORTED, FAILED, UNDER_WAY = (AckResult(n) for n in range(6))


class Tool:
    """A ground tool, as its link."""

    def __init__(self) -> None:
        self.name = "test"
        self.sent: list[tuple[int, bytes]] = []

    def send(self, msgid: int, payload: bytes) -> None:
        self.sent.append((msgid, payload))

    def acks(self) -> list[AckResult]:
        """Results since the last look."""
        found = [codec.decode_command_ack(p) for msgid, p in self.sent if msgid == codec.COMMAND_ACK]
        assert all((ack.target_system, ack.target_component) == TOOL for ack in found)
        self.sent.clear()
        return [AckResult(ack.result) for ack in found]


class Bench:
    """A command server with its surroundings."""

    def __init__(self) -> None:
        self.asked: list[tuple[int, str, dict[str, Any]]] = []
        self.said: list[tuple[Severity, str]] = []
        self.reachable = True
        self.now_s = 100.0
        self.tool = Tool()
        self.server = CommandServer(self, self, self, lambda: 1)

    def request(self, number: int, what: str, **content: Any) -> bool:
        self.asked.append((number, what, content))
        return self.reachable

    def find(self, identity: int) -> tuple[str, str]:
        if identity != 3:
            raise LookupError(f"no trajectory has the id {identity}")
        return "eight.toml", "/somewhere/eight.toml"

    def say(self, severity: Severity, text: str) -> None:
        self.said.append((severity, text))

    def send_message(self, msgid: int, link: GroundLink) -> bool:
        if msgid not in {codec.HEARTBEAT, codec.AUTOPILOT_VERSION}:
            return False
        link.send(msgid, b"")
        return True

    def give(
        self,
        command: int,
        *params: float,
        confirmation: int = 0,
        target: tuple[int, int] = (1, 191),
        tool: Tool | None = None,
    ) -> bool:
        values = (*params, *(0.0,) * (7 - len(params)))
        payload = codec.encode_command_long(*target, command, confirmation, values)
        return self._hand(codec.COMMAND_LONG, payload, tool)

    def give_int(self, command: int, *params: float) -> bool:
        values = (*params, *(0.0,) * (4 - len(params)))
        payload = struct.pack("<4fiifHBBBBB", *values, 0, 0, 0.0, command, 1, 191, 0, 0, 0)
        return self._hand(COMMAND_INT, payload, None)

    def _hand(self, msgid: int, payload: bytes, tool: Tool | None) -> bool:
        return self.server.handle(Frame(msgid, *TOOL, 0, payload, b"", 0), tool or self.tool, self.now_s)

    def wait(self, seconds: float, step_s: float = 0.02) -> None:
        for _ in range(round(seconds / step_s)):
            self.now_s += step_s
            self.server.tick(self.now_s)

    def done(self, well: bool = True) -> None:
        number = self.asked[-1][0]
        self.server.on_taken(number, "", self.now_s)
        self.server.on_done(number, well, "", self.now_s)


def test_start_from_the_first_word_to_the_last() -> None:
    bench = Bench()
    assert bench.give(UserCommand.START, 3.0)
    assert bench.tool.acks() == [UNDER_WAY]
    ((number, what, content),) = bench.asked
    assert (what, content) == ("start", {"id": 3, "name": "eight.toml", "path": "/somewhere/eight.toml"})
    bench.server.on_taken(number, "", bench.now_s)
    bench.wait(2.0)
    assert bench.tool.acks() == [UNDER_WAY] * int(2.0 / PROGRESS_INTERVAL_S - 0.1)
    bench.server.on_done(number, True, "", bench.now_s)
    assert bench.tool.acks() == [ACCEPTED]
    bench.wait(2.0)
    assert bench.tool.acks() == []
    assert bench.said == []


@pytest.mark.parametrize(
    ("command", "params", "what"),
    [
        (UserCommand.DO_PAUSE_CONTINUE, (0.0,), "pause"),
        (UserCommand.DO_PAUSE_CONTINUE, (1.0,), "resume"),
        (UserCommand.STOP, (), "stop"),
        (UserCommand.NAV_LAND, (math.nan,) * 7, "land"),
    ],
)
def test_each_command_has_its_meaning(command: int, params: tuple[float, ...], what: str) -> None:
    bench = Bench()
    bench.give(command, *params)
    assert bench.asked[0][1:] == (what, {})
    bench.done()
    assert bench.tool.acks() == [UNDER_WAY, ACCEPTED]


def test_command_int_means_the_same() -> None:
    bench = Bench()
    bench.give_int(UserCommand.START, 3.0)
    bench.give_int(UserCommand.START, 3.0)  # it has no confirmation: while it is under way it is the same one
    bench.done()
    assert [what for _, what, _ in bench.asked] == ["start"]
    assert bench.tool.acks() == [UNDER_WAY, UNDER_WAY, ACCEPTED]


def test_repetitions_are_answered_and_not_done_again() -> None:
    bench = Bench()
    bench.give(UserCommand.STOP)
    bench.give(UserCommand.STOP, confirmation=1)
    bench.done()
    bench.give(UserCommand.STOP, confirmation=2)
    assert len(bench.asked) == 1
    assert bench.tool.acks() == [UNDER_WAY, UNDER_WAY, ACCEPTED, ACCEPTED]


def test_nan_parameters_are_the_same_when_they_are_repeated() -> None:
    bench = Bench()
    bench.give(UserCommand.NAV_LAND, *(math.nan,) * 7)
    bench.give(UserCommand.NAV_LAND, *(math.nan,) * 7, confirmation=1)
    assert len(bench.asked) == 1


def test_a_new_command_is_no_repetition() -> None:
    bench = Bench()
    bench.give(UserCommand.STOP)
    bench.done()
    bench.give(UserCommand.STOP)
    assert len(bench.asked) == 2
    bench.done()
    bench.wait(REPEAT_S + 1.0)
    bench.give(UserCommand.STOP, confirmation=1)  # of something that is forgotten
    assert len(bench.asked) == 3


def test_another_tool_asks_for_itself() -> None:
    bench, other = Bench(), Tool()
    bench.give(UserCommand.DO_PAUSE_CONTINUE, 0.0)
    bench.give(UserCommand.DO_PAUSE_CONTINUE, 1.0, tool=other)
    assert [what for _, what, _ in bench.asked] == ["pause", "resume"]
    for number, _, _ in bench.asked:
        bench.server.on_done(number, True, "", bench.now_s)
    assert bench.tool.acks() == other.acks() == [UNDER_WAY, ACCEPTED]


def test_refusals_say_why() -> None:
    bench = Bench()
    for first in (7.0, 2.5, math.nan, math.inf, -1.0):
        bench.give(UserCommand.START, first)
    bench.give(UserCommand.DO_PAUSE_CONTINUE, 2.0)
    assert bench.tool.acks() == [DENIED] * 6
    assert bench.asked == []
    assert [severity for severity, _ in bench.said] == [Severity.WARNING] * 6
    assert "no trajectory has the id 7" in bench.said[0][1]


def test_the_control_process_refuses() -> None:
    bench = Bench()
    bench.give(UserCommand.DO_PAUSE_CONTINUE, 0.0)
    bench.server.on_taken(bench.asked[0][0], "pause: nothing is being flown", bench.now_s)
    assert bench.said == [(Severity.WARNING, "pause: nothing is being flown")]
    assert bench.tool.acks() == [UNDER_WAY, REJECTED]


def test_it_fails() -> None:
    bench = Bench()
    bench.give(UserCommand.START, 3.0)
    bench.done(well=False)
    assert bench.tool.acks() == [UNDER_WAY, FAILED]


def test_no_control_process() -> None:
    bench = Bench()
    bench.give(UserCommand.STOP)
    bench.wait(TAKEN_TIMEOUT_S + 0.1)
    assert bench.tool.acks()[-1] is FAILED
    bench.reachable = False
    bench.give(UserCommand.NAV_LAND)
    assert bench.tool.acks() == [REJECTED]
    assert "cannot be reached" in bench.said[-1][1]


def test_a_request_that_never_ends_fails_at_last() -> None:
    bench = Bench()
    bench.give(UserCommand.START, 3.0)
    bench.server.on_taken(bench.asked[0][0], "", bench.now_s)
    bench.wait(DONE_TIMEOUT_S + 1.0, 0.5)
    assert bench.tool.acks()[-1] is FAILED


def test_what_is_not_supported_is_answered_so() -> None:
    bench = Bench()
    for command in (400, 176, 22, 31012, 65535):
        assert bench.give(command, 1.0)
    assert bench.tool.acks() == [UNSUPPORTED] * 5
    assert bench.asked == bench.said == []


def test_messages_on_request() -> None:
    bench = Bench()
    for first in (0.0, 148.0, 331.0, math.nan, math.inf):
        bench.give(UserCommand.REQUEST_MESSAGE, first)
    assert [msgid for msgid, _ in bench.tool.sent if msgid != codec.COMMAND_ACK] == [0, 148]
    assert bench.tool.acks() == [ACCEPTED, ACCEPTED, UNSUPPORTED, UNSUPPORTED, UNSUPPORTED]


@pytest.mark.parametrize("target", [(1, 1), (1, 0), (0, 0), (2, 191), (255, 191)])
def test_commands_to_others_are_not_ours(target: tuple[int, int]) -> None:
    """A landing that is asked of every component is the autopilot's."""
    bench = Bench()
    assert not bench.give(UserCommand.NAV_LAND, target=target)
    assert bench.tool.sent == bench.asked == []


def test_a_tool_that_does_not_know_the_system_yet() -> None:
    bench = Bench()
    assert bench.give(UserCommand.REQUEST_MESSAGE, 0.0, target=(0, 191))
    assert bench.tool.acks() == [ACCEPTED]
