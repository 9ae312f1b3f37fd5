"""What a vehicle with changed parameters must pass before anything flies with it: the gates of a flight, and the way
there for a flight that is under way. It takes about a tenth of a second, in a thread of the ground process."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from typing import Final, Protocol

from companion.control.sampled import spectral_radius
from companion.errors import CompanionError
from companion.flight.loop_margins import DELAY_MARGIN_MIN_S, timing
from companion.flight.preflight import gate_gains
from companion.flight.retuning import flown, points, unsound
from companion.ground.tuning import Tuning

SAMPLED_EVERY: Final = 3
"""Of the points on the way every so many is looked at as a sampled loop too: that takes longer than the certificate."""


def judge(old: Tuning, new: Tuning) -> str:
    """Why a change is refused, in words for people; "" when it is not.

    Args:
        old: what is flown now.
        new: what is wanted.
    """
    try:
        vehicle = new.vehicle
        gate_gains(vehicle, brief=True)
        return _way_refused(old, new)
    except CompanionError as error:
        return str(error)


def warm_up(tuning: Tuning) -> None:
    """Computes what all later trials share, so that the first one takes no longer than the others."""
    with suppress(CompanionError):
        vehicle = tuning.vehicle
        spectral_radius(vehicle.parameters(), timing(vehicle), DELAY_MARGIN_MIN_S)
        gate_gains(vehicle, brief=True)


def _way_refused(old: Tuning, new: Tuning) -> str:
    """The same for the way there, as a flight would take it (`flight.retuning`)."""
    before = old.vehicle
    flying = before.parameters()
    wanted = flown(new.vehicle.parameters(), flying)
    if wanted == flying:
        return ""
    clockwork = timing(before)
    for number, parameters in enumerate(points(flying, wanted)):
        refusal = unsound(parameters)
        if not refusal and number % SAMPLED_EVERY == 0:
            radius = spectral_radius(parameters, clockwork, DELAY_MARGIN_MIN_S)
            if radius >= 1.0:
                refusal = f"the sampled loop is unstable with {DELAY_MARGIN_MIN_S * 1e3:g} ms of unknown delay"
        if refusal:
            return f"on the way from the present values {refusal}; change another parameter first, or in smaller parts"
    return ""


class Trial(Protocol):
    """A judgement that is under way."""

    def poll(self) -> str | None:
        """Why the change is refused, "" when it is not; None while that is not known. Never blocks."""
        ...


class Court(Protocol):
    """Who judges."""

    def begin(self, old: Tuning, new: Tuning) -> Trial:
        """Begins; at most one trial is under way at a time."""
        ...

    def close(self) -> None:
        """No trial will begin any more."""
        ...


class _Threaded:
    def __init__(self, future: Future[str]) -> None:
        self._future = future

    def poll(self) -> str | None:
        """See `Trial`; an exception of the judge comes out here."""
        return self._future.result() if self._future.done() else None


class InThread:
    """Judges in a thread; others wait for the interpreter no longer than milliseconds.

    Args:
        tuning: what holds at first.
    """

    def __init__(self, tuning: Tuning) -> None:
        self._pool = ThreadPoolExecutor(1, "parameters")
        self._pool.submit(warm_up, tuning)

    def begin(self, old: Tuning, new: Tuning) -> Trial:
        """Begins."""
        return _Threaded(self._pool.submit(judge, old, new))

    def close(self) -> None:
        """Ends the thread when it is done."""
        self._pool.shutdown(wait=False, cancel_futures=True)


class _Judged:
    def __init__(self, judged: Callable[[], str]) -> None:
        self._judged = judged

    def poll(self) -> str:
        """See `Trial`."""
        return self._judged()


class AtOnce:
    """Judges while the caller waits: for tests, and where nobody minds."""

    def __init__(self, judge_: Callable[[Tuning, Tuning], str] = judge) -> None:
        self._judge = judge_

    def begin(self, old: Tuning, new: Tuning) -> Trial:
        """Judges when asked for the verdict."""
        return _Judged(lambda: self._judge(old, new))

    def close(self) -> None:
        """Nothing is left."""
