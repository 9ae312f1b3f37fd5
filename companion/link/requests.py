"""One thing asked of the autopilot, and how it ended."""

from __future__ import annotations

from enum import Enum
from typing import Final, NamedTuple

from companion.link.statustext import StatusTexts

TEXT_BEFORE_S: Final = 0.5
TEXT_AFTER_S: Final = 1.0
"""What the autopilot says within this time around a refusal is taken as its reason."""


class Result(Enum):
    """How a request ended; the value is the phrase for people."""

    PENDING = "is waiting for the autopilot's answer"
    ACCEPTED = "was accepted"
    DENIED = "was denied"
    TEMPORARILY_REJECTED = "was rejected for now"
    UNSUPPORTED = "is not supported by the autopilot"
    FAILED = "failed"
    TIMEOUT = "got no answer"
    SUPERSEDED = "was replaced by a newer request"


_BY_MAV_RESULT: Final = {
    0: Result.ACCEPTED,
    1: Result.TEMPORARILY_REJECTED,
    2: Result.DENIED,
    3: Result.UNSUPPORTED,
    4: Result.FAILED,
    10: Result.DENIED,  # not in control of the vehicle
}
_REFUSALS: Final = {Result.DENIED, Result.TEMPORARILY_REJECTED, Result.UNSUPPORTED, Result.FAILED}


class Retry(NamedTuple):
    """How often a request is repeated until it is answered."""

    interval_s: float = 0.5
    tries: int = 4


class Operation:
    """A request and its fate. It ends once; only a `PENDING` one can still change."""

    def __init__(self, what: str, now_s: float, texts: StatusTexts) -> None:
        self.what = what
        """What was asked, for people: "arming"."""
        self.asked_s = now_s
        """When, on the caller's clock."""
        self.ended_s: float | None = None
        """When it ended."""
        self.result = Result.PENDING
        """How it stands."""
        self.progress: int | None = None
        """Percent, when the autopilot reports any."""
        self.value: int | float | None = None
        """The value of a parameter that was read."""
        self.sends = 0
        """How often it was sent."""
        self._detail = ""
        self._texts = texts

    @property
    def pending(self) -> bool:
        """Whether it has not ended yet."""
        return self.result is Result.PENDING

    @property
    def accepted(self) -> bool:
        """Whether it ended well."""
        return self.result is Result.ACCEPTED

    @property
    def refused(self) -> bool:
        """Whether the autopilot answered that it will not."""
        return self.result in _REFUSALS

    @property
    def sentence(self) -> str:
        """How it stands, in words; a refusal with what the autopilot said around it (its reason may come after its
        answer)."""
        reasons = [self._detail] if self._detail else []
        if self.result in _REFUSALS and self.ended_s is not None:
            reasons += self._texts.complaints(self.asked_s - TEXT_BEFORE_S, self.ended_s + TEXT_AFTER_S)
        return f"{self.what} {self.result.value}" + (f": {'; '.join(reasons)}" if reasons else "")

    def end(self, result: Result, now_s: float, detail: str = "") -> None:
        """Settle it; later answers change nothing."""
        if self.pending:
            self.result = result
            self.ended_s = now_s
            self._detail = detail


def ack_result(mav_result: int) -> tuple[Result, str]:
    """What a COMMAND_ACK's MAV_RESULT stands for, with a detail when it is none of the usual ones."""
    known = _BY_MAV_RESULT.get(mav_result)
    return (Result.FAILED, f"result {mav_result}") if known is None else (known, "")
