"""Reading parameters by name, a few at a time, tolerant of names that this autopilot does not have."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Final

from companion.link.codec import ParamError, ParamValue
from companion.link.requests import Operation, Result, Retry

AT_ONCE: Final = 8
"""Names asked for at the same time."""
NAME_MAX: Final = 16
_DOES_NOT_EXIST = 1  # MAV_PARAM_ERROR


class _Read:
    def __init__(self, name: str, operation: Operation, retry: Retry) -> None:
        self.name = name
        self.operation = operation
        self.retry = retry
        self.due_s = 0.0


class ParameterReader:
    """The parameter reads that are asked or wait to be."""

    def __init__(self, send: Callable[[str], object]) -> None:
        """`send` asks the autopilot for one name."""
        self._send = send
        self.asked: dict[str, _Read] = {}
        """What `update` has to look after; while it is empty nothing waits either."""
        self._waiting: deque[_Read] = deque()

    def ask(self, name: str, operation: Operation, retry: Retry) -> Operation:
        """Ask for a parameter; the operation that stands for it, an earlier one when the name is being asked for
        already.

        Raises:
            ValueError: no parameter can have this name (a fault of the caller).
        """
        if not name or len(name) > NAME_MAX or not name.isascii():
            raise ValueError(f'"{name}" is no parameter name: 1 to {NAME_MAX} ASCII characters')
        for read in (*self.asked.values(), *self._waiting):
            if read.name == name:
                return read.operation
        self._waiting.append(_Read(name, operation, retry))
        self._start(operation.asked_s)
        return operation

    def on_value(self, message: ParamValue, now_s: float) -> None:
        """Take a value; one that nobody asked for is ignored."""
        read = self.asked.pop(message.name, None)
        if read is None:
            return
        if message.value is None:
            read.operation.end(Result.FAILED, now_s, f"its type {message.type} is not known")
        else:
            read.operation.value = message.value
            read.operation.end(Result.ACCEPTED, now_s)
        self._start(now_s)

    def on_error(self, message: ParamError, now_s: float) -> None:
        """Take a refusal."""
        read = self.asked.pop(message.name, None)
        if read is None:
            return
        if message.error == _DOES_NOT_EXIST:
            read.operation.end(Result.UNSUPPORTED, now_s, "there is no parameter of this name")
        else:
            read.operation.end(Result.FAILED, now_s, f"parameter error {message.error}")
        self._start(now_s)

    def update(self, now_s: float) -> None:
        """Repeat, or give up."""
        for read in list(self.asked.values()):
            read.due_s = min(read.due_s, now_s + read.retry.interval_s)  # should the caller's clock have been set back
            if now_s < read.due_s:
                continue
            if read.operation.sends >= read.retry.tries:
                del self.asked[read.name]
                detail = f"asked {read.operation.sends} times; the autopilot may not have it"
                read.operation.end(Result.TIMEOUT, now_s, detail)
            else:
                self._transmit(read, now_s)
        self._start(now_s)

    def _start(self, now_s: float) -> None:
        """Ask for the next names while there is room."""
        while self._waiting and len(self.asked) < AT_ONCE:
            read = self._waiting.popleft()
            self.asked[read.name] = read
            self._transmit(read, now_s)

    def _transmit(self, read: _Read, now_s: float) -> None:
        """Ask once."""
        self._send(read.name)
        read.operation.sends += 1
        read.due_s = now_s + read.retry.interval_s
