"""The commands that ground tools give to the companion: decoded, answered, and handed to the control process.

A command is answered IN_PROGRESS as soon as it is taken and again while it lasts, and once with how it ended. What a
tool repeats because an answer was lost is answered again and not done again. The reason of a refusal goes out as
STATUSTEXT before the answer.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, Final, Protocol

from companion.flight.phases import Order
from companion.ground.messages import (
    COMMAND_INT,
    AckResult,
    CommandMessage,
    Severity,
    decode_command,
    encode_ack,
)
from companion.ground.service import GroundLink
from companion.link import codec
from companion.link.framing import Frame
from companion.link.wire import COMPANION_COMPONENT

PROGRESS_INTERVAL_S: Final = 0.4
"""A client that waits for an answer gives up after half a second without a word."""
TAKEN_TIMEOUT_S: Final = 5.0
"""For the control process to say that it has the request: it may be starting again."""
DONE_TIMEOUT_S: Final = 180.0
"""For the request itself: a take-off and a long path to plan are within this."""
REPEAT_S: Final = 10.0
"""For so long the end of a command is remembered, to answer a repetition."""
REMEMBERED_MAX: Final = 64


class UserCommand(IntEnum):
    """MAV_CMD, the ones that the companion takes."""

    NAV_LAND = 21
    DO_PAUSE_CONTINUE = 193
    REQUEST_MESSAGE = 512
    REQUEST_AUTOPILOT_CAPABILITIES = 520
    START = 31010  # MAV_CMD_USER_1
    STOP = 31011  # MAV_CMD_USER_2


class Trajectories(Protocol):
    """Where trajectories are found by their id."""

    def find(self, identity: int) -> tuple[str, str]:
        """Name and path of a trajectory that may be flown.

        Raises:
            LookupError: there is none of this id, or it may not be flown; with a sentence.
        """
        ...


class Requests(Protocol):
    """The way to the control process."""

    def request(self, number: int, what: str, **content: Any) -> bool:
        """Hands over a request; False when it could not be."""
        ...


class Reporter(Protocol):
    """What a ground tool is told without having asked."""

    def say(self, severity: Severity, text: str) -> None:
        """A text to everybody."""
        ...

    def send_message(self, msgid: int, link: GroundLink) -> bool:
        """Sends one of the companion's own messages on request; False for one that it does not have."""
        ...


class Refused(Exception):  # noqa: N818 - the answer to a command, not a fault
    """A command that is not taken."""

    def __init__(self, result: AckResult, sentence: str) -> None:
        super().__init__(sentence)
        self.result = result


@dataclass
class _Job:
    """A command on its way, or one that has ended and may be asked for again."""

    command: CommandMessage
    number: int
    begun_s: float
    askers: dict[tuple[int, int], GroundLink] = field(default_factory=dict)
    """Who waits for the answer: system and component, and the way there."""
    told_s: float = -math.inf
    taken: bool = False
    result: AckResult | None = None
    ended_s: float = 0.0


class CommandServer:
    """Implements `service.Service` for COMMAND_LONG and COMMAND_INT.

    Args:
        requests: the way to the control process.
        trajectories: finds trajectories by id.
        reporter: tells people.
        system: asked for the vehicle's system id.
    """

    def __init__(
        self, requests: Requests, trajectories: Trajectories, reporter: Reporter, system: Callable[[], int]
    ) -> None:
        self._requests = requests
        self._trajectories = trajectories
        self._reporter = reporter
        self._system = system
        self._jobs: list[_Job] = []
        self._next = time.monotonic_ns()  # a process that follows after a crash uses other numbers

    def handle(self, frame: Frame, link: GroundLink, now_s: float) -> bool:
        """Takes a command that is addressed to the companion itself; what is for every component is not for us: a
        landing asked of everybody is the autopilot's."""
        if frame.msgid not in {codec.COMMAND_LONG, COMMAND_INT}:
            return False
        command = decode_command(frame.msgid, frame.payload)
        assert command is not None
        if command.target_component != COMPANION_COMPONENT or command.target_system not in {0, self._system()}:
            return False
        asker = (frame.sysid, frame.compid)
        known = self._known(command, asker, now_s)
        if known is not None:
            known.askers[asker] = link
            self._answer(known, now_s)
            return True
        try:
            self._take(command, asker, link, now_s)
        except Refused as refused:
            if str(refused):
                self._reporter.say(Severity.WARNING, str(refused))
            link.send(codec.COMMAND_ACK, encode_ack(command.command, refused.result, *asker))
        return True

    def tick(self, now_s: float) -> None:
        """Tells how it goes, and gives up what got no answer."""
        for job in self._jobs:
            if job.result is not None:
                continue
            if not job.taken and now_s - job.begun_s > TAKEN_TIMEOUT_S:
                self._end(job, AckResult.FAILED, "the control process does not answer; it may be starting", now_s)
            elif now_s - job.begun_s > DONE_TIMEOUT_S:
                self._end(job, AckResult.FAILED, f"not done within {DONE_TIMEOUT_S:g} s", now_s)
            elif now_s - job.told_s >= PROGRESS_INTERVAL_S:
                self._answer(job, now_s)
        self._jobs = [job for job in self._jobs if job.result is None or now_s - job.ended_s < REPEAT_S]
        del self._jobs[:-REMEMBERED_MAX]

    def on_taken(self, number: int, refusal: str, now_s: float) -> None:
        """The control process has a request, or refuses it with a sentence."""
        job = self._job(number)
        if job is None:
            return
        job.taken = True
        if refusal:
            self._end(job, AckResult.TEMPORARILY_REJECTED, refusal, now_s)

    def on_done(self, number: int, done: bool, sentence: str, now_s: float) -> None:
        """A request has come to its end; the control process has said the sentence to everybody if there is one."""
        job = self._job(number)
        if job is not None:
            del sentence
            self._end(job, AckResult.ACCEPTED if done else AckResult.FAILED, "", now_s)

    # -- inside ---------------------------------------------------------------------------------------------------

    def _known(self, command: CommandMessage, asker: tuple[int, int], now_s: float) -> _Job | None:
        """The same command from the same tool: still under way, or marked as a repetition of one that has ended."""
        for job in reversed(self._jobs):
            same = job.command.command == command.command and _equal(job.command.params, command.params)
            if not same or asker not in job.askers:
                continue
            if job.result is None or (command.confirmation > 0 and now_s - job.ended_s < REPEAT_S):
                return job
        return None

    def _take(self, command: CommandMessage, asker: tuple[int, int], link: GroundLink, now_s: float) -> None:
        number = command.command
        if number in {UserCommand.REQUEST_MESSAGE, UserCommand.REQUEST_AUTOPILOT_CAPABILITIES}:
            self._send_requested(command, asker, link)
            return
        what, content = self._meaning(command)
        self._next += 1
        job = _Job(command, self._next, now_s, {asker: link})
        if not self._requests.request(job.number, what, **content):
            raise Refused(AckResult.TEMPORARILY_REJECTED, f"{what}: the control process cannot be reached")
        self._jobs.append(job)
        self._answer(job, now_s)

    def _meaning(self, command: CommandMessage) -> tuple[str, dict[str, Any]]:
        """What is asked of the control process.

        Raises:
            Refused: nothing can be.
        """
        number, first = command.command, command.params[0]
        if number == UserCommand.START:
            if not (math.isfinite(first) and first == int(first) and first >= 0.0):
                raise Refused(AckResult.DENIED, f"start: {first} is no trajectory id")
            try:
                found = self._trajectories.find(int(first))
            except LookupError as error:
                raise Refused(AckResult.DENIED, f"start: {error.args[0]}") from None
            return "start", {"id": int(first), "name": found[0], "path": found[1]}
        if number == UserCommand.DO_PAUSE_CONTINUE:
            if first not in {0.0, 1.0}:
                raise Refused(AckResult.DENIED, f"pause: param1 {first} must be 0 (pause) or 1 (resume)")
            return (Order.RESUME.value if first == 1.0 else Order.PAUSE.value), {}
        if number == UserCommand.STOP:
            return Order.STOP.value, {}
        if number == UserCommand.NAV_LAND:
            return Order.LAND.value, {}
        raise Refused(AckResult.UNSUPPORTED, "")

    def _send_requested(self, command: CommandMessage, asker: tuple[int, int], link: GroundLink) -> None:
        wanted = codec.AUTOPILOT_VERSION
        if command.command == UserCommand.REQUEST_MESSAGE:
            first = command.params[0]
            wanted = int(first) if math.isfinite(first) else -1
        result = AckResult.ACCEPTED if self._reporter.send_message(wanted, link) else AckResult.UNSUPPORTED
        link.send(codec.COMMAND_ACK, encode_ack(command.command, result, *asker))

    def _job(self, number: int) -> _Job | None:
        return next((job for job in self._jobs if job.number == number and job.result is None), None)

    def _end(self, job: _Job, result: AckResult, sentence: str, now_s: float) -> None:
        job.result, job.ended_s = result, now_s
        if sentence:
            self._reporter.say(Severity.WARNING, sentence)
        self._answer(job, now_s)

    def _answer(self, job: _Job, now_s: float) -> None:
        result = AckResult.IN_PROGRESS if job.result is None else job.result
        job.told_s = now_s
        for asker, link in job.askers.items():
            link.send(codec.COMMAND_ACK, encode_ack(job.command.command, result, *asker))


def _equal(first: tuple[float, ...], second: tuple[float, ...]) -> bool:
    """Whether two commands have the same parameters; NaN, which says "not given", equals itself."""
    return all(a == b or (math.isnan(a) and math.isnan(b)) for a, b in zip(first, second, strict=True))
