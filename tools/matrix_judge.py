"""Judges a flight of the fault matrix by what really happened to the simulated vehicle.

What must hold: at the end the vehicle has flown its course, holds in the air, or stands on the ground; it never met the
ground faster than 2 m/s; it never was further beyond its fence than its way to brake from there; and the log names why
the flight ended.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

from matrix_flight import FENCE_HEIGHT_M, FENCE_RADIUS_M, Flown, Moment

from companion.flight.phases import Cause
from sim_link.modes import Mode

IMPACT_MAX_M_S = 2.0
REACTION_S = 1.0
"""From crossing the fence to the autopilot's braking: the guard's window, the order, and the attitude."""
BRAKE_M_S2 = 2.5
"""The autopilot's deceleration in Hold, at least."""
STILL_M_S = 0.7
"""One that holds is slower than this, on average over the last seconds."""
STILL_OVER_S = 3.0
_BY_HAND = {Mode.POSITION, Mode.ALTITUDE, Mode.STABILIZED, Mode.MANUAL, Mode.ACRO}


@dataclass(frozen=True)
class Verdict:
    """What became of a flight."""

    survived: bool
    how: str
    """"flown" (to the end of its course and down), "holding", "landed", "grounded" (it never took off), "pilot"; or
    what was lost."""
    cause: str
    """By the companion's log."""
    sentence: str
    impact_m_s: float
    beyond_fence_m: float
    """The furthest, less what the estimate was wrong by."""
    problems: tuple[str, ...]

    def told(self) -> dict[str, object]:
        """JSON types only."""
        return asdict(self) | {"problems": list(self.problems)}


def judge(flown: Flown) -> Verdict:
    """Judges one flight."""
    cause, sentence = flown.outcome.cause, flown.outcome.sentence
    named = cause is not Cause.FAULT and bool(sentence)
    return judged(flown.moments, flown.impact_m_s, cause.name, sentence, named=named)


def judged(moments: list[Moment], impact_m_s: float, cause: str, sentence: str, *, named: bool) -> Verdict:
    """Judges what a vehicle did.

    Args:
        moments: all of it.
        impact_m_s: of its hardest touchdown.
        cause: why the flight ended; "COMPLETED" for one that was flown to its end.
        sentence: the same for people.
        named: whether the log names the cause.
    """
    problems = []
    if impact_m_s > IMPACT_MAX_M_S:
        problems.append(f"hit the ground at {impact_m_s:.1f} m/s")
    beyond, allowed = _beyond_fence(moments)
    if beyond > allowed:
        problems.append(f"was {beyond:.1f} m beyond its fence, {allowed:.1f} m of it to brake")
    how = _end(moments, cause)
    if how is None:
        problems.append(_describe(moments))
    if not named:
        problems.append(f"no cause is named but: {sentence}")
    impact, away = round(impact_m_s, 2), round(beyond, 2)
    return Verdict(not problems, how or "lost", cause, sentence, impact, away, tuple(problems))


def _end(moments: list[Moment], cause: str) -> str | None:
    """The state that it ends in; None: none of those that are safe."""
    last = moments[-1]
    flew = any(not m.grounded for m in moments)
    if last.grounded and not last.armed:
        if cause == Cause.COMPLETED.name:
            return "flown"
        return "landed" if flew else "grounded"
    if last.grounded and not flew:
        return "grounded"
    since_s = last.t_s - STILL_OVER_S
    first = next(m for m in moments if m.t_s >= since_s)
    passed_s = max(last.t_s - first.t_s, 1e-3)
    moved_m_s = math.dist(first.p, last.p) / passed_s
    believed_m_s = math.dist(first.believed, last.believed) / passed_s
    if min(moved_m_s, believed_m_s) < STILL_M_S and last.armed:
        return "pilot" if last.mode in _BY_HAND else "holding"
    return None


def _beyond_fence(moments: list[Moment]) -> tuple[float, float]:
    """How far it was beyond the fence at most, and how far it may have been by its speed when it crossed it [m].

    Home is where it started. What the estimate was wrong by up to then does not count: the fence stands where the
    vehicle believes it to be.
    """
    home = moments[0].p if moments else (0.0, 0.0, 0.0)
    worst, allowed, wrong_m, speed_m_s = 0.0, 0.0, 0.0, 0.0
    outside = False
    for m in moments:
        wrong_m = max(wrong_m, math.dist(m.p, m.believed))
        away = math.hypot(m.p[0] - home[0], m.p[1] - home[1]) - FENCE_RADIUS_M
        beyond = max(away, home[2] - m.p[2] - FENCE_HEIGHT_M) - wrong_m
        if beyond > 0.0 and not outside:
            speed_m_s = math.hypot(*m.v)
        outside = beyond > 0.0
        if beyond > worst:
            worst, allowed = beyond, speed_m_s * REACTION_S + speed_m_s**2 / (2.0 * BRAKE_M_S2)
    return worst, allowed


def _describe(moments: list[Moment]) -> str:
    last = moments[-1]
    armed = "armed" if last.armed else "disarmed"
    return f"ends at {math.hypot(*last.v):.1f} m/s in {last.mode.label}, {armed}, {-last.p[2]:.1f} m up"
