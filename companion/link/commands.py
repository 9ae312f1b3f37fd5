"""Commands on their way: repeated until acknowledged, one per command id at a time.

COMMAND_ACK names the command but not its parameters. So an acknowledgement can only be trusted while one request of
its command is in the air, and while none of an earlier one can still be under way.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Final, NamedTuple

from companion.link.codec import CommandAck
from companion.link.requests import Operation, Result, Retry, ack_result

Params = tuple[float, float, float, float, float, float, float]
SendCommand = Callable[[int, int, Params], object]
"""Sends a command: its id, the confirmation counter, its parameters."""

MAV_RESULT_IN_PROGRESS: Final = 5
PROGRESS_S: Final = 5.0
"""How long after "in progress" the end, or the next such answer, may take."""
QUIET_S: Final = 0.2
"""Pause after a request that had to be repeated: a second answer to it may follow, and is nobody else's."""
STALE_S: Final = 0.5
"""How long the answers to a request that was replaced are expected."""


class _Request(NamedTuple):
    operation: Operation
    params: Params
    retry: Retry


class _Lane:
    """The requests of one command id: one in the air, the others behind it."""

    def __init__(self, command: int, send: SendCommand) -> None:
        self._command = command
        self._send = send
        self._waiting: deque[_Request] = deque()
        self._current: _Request | None = None
        self._in_progress = False
        self._due_s = 0.0
        self._quiet_until_s = -math.inf
        self._stale_acks = 0
        self._stale_until_s = -math.inf

    def add(self, request: _Request, now_s: float) -> None:
        """Queue a request; it goes out at once when nothing is before it."""
        self._waiting.append(request)
        self.update(now_s)

    @property
    def idle(self) -> bool:
        """Whether nothing is in the air or waits."""
        return self._current is None and not self._waiting

    def find(self, params: Params) -> Operation | None:
        """The request in the air, if it asks for exactly this."""
        current = self._current
        return current.operation if current is not None and current.params == params else None

    def replace(self, request: _Request, now_s: float) -> None:
        """Send a request at once instead of everything before it."""
        self.drop(now_s)
        self._start(request, now_s)

    def drop(self, now_s: float) -> None:
        """Ask for nothing more; what is in the air may still be answered, and those answers are nobody's."""
        for old in self._waiting:
            old.operation.end(Result.SUPERSEDED, now_s)
        self._waiting.clear()
        if self._current is not None:
            if now_s >= self._stale_until_s:
                self._stale_acks = 0
            self._stale_acks += self._current.operation.sends
            self._stale_until_s = now_s + STALE_S
            self._current.operation.end(Result.SUPERSEDED, now_s)
            self._current = None

    def on_ack(self, ack: CommandAck, now_s: float) -> None:
        """Take an acknowledgement of this command."""
        in_progress = ack.result == MAV_RESULT_IN_PROGRESS
        if self._stale_acks > 0 and now_s < self._stale_until_s:
            self._stale_acks -= 0 if in_progress else 1
            return
        if self._current is None:
            return
        operation = self._current.operation
        if in_progress:
            self._in_progress = True
            self._due_s = now_s + PROGRESS_S
            operation.progress = ack.progress if ack.progress <= 100 else None  # 255: not known
        else:
            self._finish(*ack_result(ack.result), now_s)

    def update(self, now_s: float) -> None:
        """Repeat, give up, or start what waits."""
        if self._current is not None:
            _, _, retry = self._current
            # Never further ahead than a full wait, should the caller's clock have been set back.
            self._due_s = min(self._due_s, now_s + (PROGRESS_S if self._in_progress else retry.interval_s))
            if now_s >= self._due_s:
                self._overdue(self._current, now_s)
        self._quiet_until_s = min(self._quiet_until_s, now_s + QUIET_S)
        if self._current is None and self._waiting and now_s >= self._quiet_until_s:
            self._start(self._waiting.popleft(), now_s)

    def _overdue(self, current: _Request, now_s: float) -> None:
        """No answer in time: repeat, or give up."""
        if self._in_progress:
            self._finish(Result.TIMEOUT, f'nothing for {PROGRESS_S:g} s after "in progress"', now_s)
        elif current.operation.sends >= current.retry.tries:
            self._finish(Result.TIMEOUT, f"asked {current.operation.sends} times", now_s)
        else:
            self._transmit(current, now_s)

    def _start(self, request: _Request, now_s: float) -> None:
        """Put a request into the air."""
        self._current = request
        self._in_progress = False
        self._transmit(request, now_s)

    def _transmit(self, request: _Request, now_s: float) -> None:
        """Send once; the confirmation counter says how many times it was sent before."""
        self._send(self._command, min(request.operation.sends, 255), request.params)
        request.operation.sends += 1
        self._due_s = now_s + request.retry.interval_s

    def _finish(self, result: Result, detail: str, now_s: float) -> None:
        """End the request in the air and let the next one go."""
        assert self._current is not None
        operation = self._current.operation
        operation.end(result, now_s, detail)
        self._current = None
        if operation.sends > 1:
            self._quiet_until_s = self._stale_until_s = now_s + QUIET_S
            self._stale_acks = operation.sends - 1
        self.update(now_s)


class CommandQueue:
    """All commands that are asked or wait to be."""

    def __init__(self, send: SendCommand) -> None:
        self._send = send
        self._lanes: dict[int, _Lane] = {}
        self.busy: dict[int, _Lane] = {}
        """Lanes with something to do, for `update`: most commands are asked once."""

    def ask(self, command: int, params: Params, operation: Operation, retry: Retry, newest_wins: bool) -> Operation:
        """Ask for a command, from `operation.asked_s` on.

        Args:
            command: MAV_CMD.
            params: its seven parameters, NaN for "not given".
            operation: what to report to.
            retry: how often to repeat.
            newest_wins: this replaces what was asked of the same command before, instead of waiting for it; when
            exactly this is
                being asked already, that goes on.

        Returns:
            The operation that stands for the request, `operation` or the one that was there.
        """
        lane = self.busy[command] = self._lanes.setdefault(command, _Lane(command, self._send))
        request = _Request(operation, params, retry)
        if not newest_wins:
            lane.add(request, operation.asked_s)
            return operation
        same = lane.find(params)
        if same is not None:
            return same
        lane.replace(request, operation.asked_s)
        return operation

    def drop(self, command: int, now_s: float) -> None:
        """Ask for a command no more."""
        lane = self._lanes.get(command)
        if lane is not None:
            lane.drop(now_s)

    def on_ack(self, ack: CommandAck, now_s: float) -> None:
        """Take an acknowledgement that is meant for us."""
        lane = self._lanes.get(ack.command)
        if lane is not None:
            lane.on_ack(ack, now_s)

    def update(self, now_s: float) -> None:
        """Repeat, give up, go on."""
        for command, lane in tuple(self.busy.items()):
            lane.update(now_s)
            if lane.idle:
                del self.busy[command]
