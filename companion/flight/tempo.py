"""The pace of a course: at its own speed, slowing to rest on its own path, and getting back to speed.

A pause, a resume and an early stop change when a point of the course is reached, never where the course goes: what was
checked before the flight (fence, ground, other vehicles) stays true. Between two paces the course's time is a
polynomial of the flight's time, so that the reference stays continuous up to its fourth derivative; its duration is the
shortest of a grid that keeps the vehicle's limits. Finding it is divided among control turns.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

from companion.control.types import Reference
from companion.trajectory.flatness import PointMass, ReferenceLimits, worst_use
from companion.trajectory.polynomial import Coefficients, evaluate, through, travel_to_rest
from companion.trajectory.timing import RUN_OUT_ACCELERATION_M_S2, RUN_OUT_MIN_S, Pace, paced

DURATION_RATIO = 1.25
DURATIONS = 12
"""From 2 s to 23 s."""
SAMPLES = 24
"""Instants at which a candidate is judged."""
PACE_ROOM = 0.05
"""How far the pace may leave the range between rest and the course's own on the way."""
LEAD_S = 0.5
"""A change begins this long after it was asked for: the time in which it is planned."""
PLANNING_S = 0.25
"""Of that, what the planning itself is spread over."""


class Ramp(NamedTuple):
    """A change of pace: with these three numbers and the ones before it, it can be computed again."""

    begin_s: float
    """Time since engaging [s]."""
    duration_s: float
    rate: float
    """Of the course's time afterwards: 0 at rest, 1 at its own pace."""


class _Span(NamedTuple):
    ramp: Ramp
    course: Coefficients
    """Time on the course during the ramp [s]."""
    end_s: float
    """Time on the course when it is over."""


class Tempo:
    """The time on the course [s] over the time since engaging, with four derivatives."""

    def __init__(self) -> None:
        self._spans: list[_Span] = []

    @property
    def ramps(self) -> tuple[Ramp, ...]:
        """All changes so far, in their order."""
        return tuple(span.ramp for span in self._spans)

    @property
    def steady(self) -> bool:
        """Whether the pace was never changed."""
        return not self._spans

    @property
    def changes_s(self) -> float:
        """Time since engaging at which the pace changes first [s]; infinity: it was never changed."""
        return self._spans[0].ramp.begin_s if self._spans else math.inf

    def at(self, t_s: float) -> Pace:
        """The pace at a time since engaging [s]."""
        for span in reversed(self._spans):
            begin_s, duration_s, rate = span.ramp
            past_s = t_s - begin_s
            if past_s >= duration_s:
                return span.end_s + rate * (past_s - duration_s), rate, 0.0, 0.0, 0.0
            if past_s >= 0.0:
                return evaluate(span.course, duration_s, past_s)
        return t_s, 1.0, 0.0, 0.0, 0.0

    def resting(self, t_s: float) -> bool:
        """Whether the pace is zero from this time on."""
        return bool(self._spans) and self._spans[-1].ramp.rate == 0.0 and t_s >= self.settled_s

    @property
    def settled_s(self) -> float:
        """Time since engaging at which the last change is over [s]; 0 when there was none."""
        return self._spans[-1].ramp.begin_s + self._spans[-1].ramp.duration_s if self._spans else 0.0

    @property
    def rate(self) -> float:
        """The pace when the last change is over."""
        return self._spans[-1].ramp.rate if self._spans else 1.0

    def add(self, ramp: Ramp) -> None:
        """Changes the pace; the ramp must not begin before those that are there have begun, nor in the past."""
        self._spans.append(_span(self.at(ramp.begin_s), ramp))


def _span(start: Pace, ramp: Ramp) -> _Span:
    """The smoothest way from a pace to a steady one: the deviation from the latter runs out to rest."""
    duration_s, rate = ramp.duration_s, ramp.rate
    deviation = (0.0, start[1] - rate, start[2], start[3], start[4])
    end_s = start[0] + rate * duration_s + travel_to_rest(deviation, duration_s)
    course = through(start, (end_s, rate, 0.0, 0.0, 0.0), duration_s)
    return _Span(ramp, course, end_s)


class Path(Protocol):
    """The course at its own pace."""

    def at(self, t_s: float) -> Reference:
        """The reference at a time on the course [s]."""
        ...


class RampPlan:
    """Looks for the shortest change of pace that keeps the limits, a few samples at a time.

    A candidate keeps them when every sample uses no limit beyond its whole, changes the speed along the path no faster
    than `RUN_OUT_ACCELERATION_M_S2`, and the pace stays between rest and the course's own. Where the course itself
    uses a limit up, no candidate may: then the one that exceeds the limits least is taken.

    Args:
        tempo: the pace so far.
        path: the course at its own pace.
        begin_s: when the change is to begin, time since engaging [s].
        rate: the pace afterwards, 0 to 1.
        limits: of the vehicle.
        model: of the vehicle.
    """

    def __init__(
        self, tempo: Tempo, path: Path, begin_s: float, rate: float, limits: ReferenceLimits, model: PointMass
    ) -> None:
        self.begin_s = begin_s
        self.rate = rate
        self._start = tempo.at(begin_s)
        self._path, self._limits, self._model = path, limits, model
        self._tried = 0
        self._sample = 0
        self._use = 0.0
        self._best: tuple[float, Ramp] | None = None
        self._span = self._candidate()

    @property
    def samples_max(self) -> int:
        """Samples that the whole search takes at most."""
        return DURATIONS * (SAMPLES + 1)

    def work(self, samples: int) -> Ramp | None:
        """Goes on; the ramp once it is found."""
        for _ in range(samples):
            self._use = max(self._use, self._judge(self._span.ramp.duration_s * self._sample / SAMPLES))
            enough = 1.0 + 1e-6 if self._best is None else max(1.0 + 1e-6, self._best[0])
            if self._use > enough and self._best is not None:
                self._sample = SAMPLES
            if self._sample < SAMPLES:
                self._sample += 1
                continue
            found = self._next()
            if found is not None:
                return found
        return None

    def _next(self) -> Ramp | None:
        """The candidate is judged: take it, or go on to the next one."""
        if self._use <= 1.0 + 1e-6:
            return self._span.ramp
        if self._best is None or self._use < self._best[0]:
            self._best = self._use, self._span.ramp
        self._tried += 1
        if self._tried == DURATIONS:
            return self._best[1]
        self._sample, self._use = 0, 0.0
        self._span = self._candidate()
        return None

    def _candidate(self) -> _Span:
        duration_s = RUN_OUT_MIN_S * DURATION_RATIO**self._tried
        return _span(self._start, Ramp(self.begin_s, duration_s, self.rate))

    def _judge(self, past_s: float) -> float:
        """The use of the limits at an instant of the ramp; above 1 does not pass."""
        pace = evaluate(self._span.course, self._span.ramp.duration_s, past_s)
        plain = self._path.at(pace[0])
        use = worst_use(paced(plain, pace), self._limits, self._model)
        along = abs(pace[2]) * math.hypot(*plain.v) / RUN_OUT_ACCELERATION_M_S2
        outside = (abs(pace[1] - 0.5) - 0.5) / PACE_ROOM
        return max(use, along, outside)
