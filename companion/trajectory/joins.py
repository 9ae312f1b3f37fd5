"""Joins: polynomials of degree 9 from one reference to another, or to rest, continuous up to the fourth derivative.

Finding a join takes some ten milliseconds: that is for before the flight, or between its phases, not for within a
control step. A flight that must end at once can end along its own path instead (`Anchored.ending_at`), which takes no
search.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from math import hypot, inf, pi, remainder
from operator import truediv
from typing import NamedTuple

from companion.control.types import Reference
from companion.errors import RefusedError
from companion.trajectory.flatness import BOUNDS, PointMass, Quantities, ReferenceLimits, quantities, uses
from companion.trajectory.pieces import golden_maximum
from companion.trajectory.polynomial import Coefficients, Derivatives, evaluate, of_axes, through, travel_to_rest
from companion.trajectory.shapes import ZERO, Joint

DURATION_MIN_S = 0.5
DURATION_MAX_S = 120.0
DURATION_RATIO = 1.05
"""Durations are tried on a geometric grid: none is more than this factor longer than the shortest that fits."""

SHARE = 0.5
"""Of the limits of speed, acceleration, tilt and rates that joins keep to where they can: a join is not the flight's
task, and what disturbances and tracking take comes on top. Where an end of the join uses more, so may the join."""

END_ROOM = 1.1
"""How much more than its ends a join may use: a reference that is still accelerating gets a little faster before it
brakes."""

STOP_USE_MAX = 1.1
"""A stop may use this share of a limit when nothing within the limits is left: a reference that is still accelerating
at its speed limit cannot stop without exceeding it, and no stop at all would be worse."""

USE_TOLERANCE = 1e-6
"""Rounding that is let pass where an end of a join lies on a limit."""

COARSE_SAMPLES = 40
FINE_SAMPLES = 200


FULL_SHARES: Quantities = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0)


class _Gate(NamedTuple):
    """What a candidate is measured by."""

    limits: ReferenceLimits
    model: PointMass
    shares: Quantities

    def use(self, reference: Reference) -> float:
        """Return the largest use of any limit, relative to its share; above 1 does not pass."""
        found = uses(quantities(reference, self.model), self.limits)
        worst: float = max(map(truediv, found, self.shares))
        return worst


@dataclass(frozen=True, slots=True)
class Join:
    """A reference over [0, duration_s] that begins and ends as it was asked to."""

    duration_s: float
    north: Coefficients
    east: Coefficients
    down: Coefficients
    yaw: Coefficients
    use: float
    """Largest share of any limit that it uses; at most 1 but for stops (`STOP_USE_MAX`)."""

    @property
    def period_s(self) -> None:
        """A join does not repeat."""
        return

    def at(self, t_s: float) -> Reference:
        """Return the reference [s from the join's start]; outside of [0, duration_s] the values of the nearer end.

        An end that moves is therefore frozen beyond it, bounded but not flyable: put what follows behind it with
        `pieces.chain`.
        """
        d = self.duration_s
        t = min(max(t_s, 0.0), d)
        yaw, yaw_rate, yaw_acceleration, _, _ = evaluate(self.yaw, d, t)
        axes = evaluate(self.north, d, t), evaluate(self.east, d, t), evaluate(self.down, d, t)
        return of_axes(*axes, (yaw, yaw_rate, yaw_acceleration))

    def joints(self) -> tuple[Joint, ...]:
        """One polynomial has no joints."""
        return ()


def join(
    start: Reference,
    end: Reference,
    limits: ReferenceLimits,
    model: PointMass,
    share: float = SHARE,
    duration_max_s: float = DURATION_MAX_S,
) -> Join:
    """Return the shortest join from `start` to `end` (to a step of the grid) that keeps the limits.

    Position and its first four derivatives match at both ends, heading with its first two as well; the heading takes
    the shorter turn, so that at the end it may differ from `end.yaw` by whole turns.

    Args:
        start: where it begins.
        end: where it ends.
        limits: kept throughout.
        model: of the vehicle.
        share: of the limits that it keeps to (`SHARE`), unless only the whole of them leaves a way.
        duration_max_s: the longest that it may take.

    Raises:
        RefusedError: nothing up to `duration_max_s` keeps the limits; the message has the figure that comes closest.

    """
    turn = remainder(end.yaw - start.yaw, 2.0 * pi)
    goal = end._replace(yaw=start.yaw + turn)
    found = _search(lambda d: _between(start, goal, d), limits, model, share, duration_max_s)
    if found.use > 1.0 + USE_TOLERANCE:
        raise RefusedError(_no_fit("join", found, limits, model, duration_max_s))
    return found


def stop(
    start: Reference,
    limits: ReferenceLimits,
    model: PointMass,
    share: float = SHARE,
    duration_max_s: float = DURATION_MAX_S,
) -> Join:
    """Return the shortest stop from a moving reference: a join to rest at the point where braking smoothly ends.

    The point follows from the smoothest speed profile (`polynomial.travel_to_rest`): from a steady speed it brakes
    straight ahead and never turns back. A start that already uses a limit up, still accelerating, is let exceed it a
    little (`STOP_USE_MAX`).

    Args:
        start: where it begins.
        limits: kept throughout.
        model: of the vehicle.
        share: of the limits that it keeps to, as in `join`.
        duration_max_s: the longest that it may take.

    Raises:
        RefusedError: nothing up to `duration_max_s` keeps the limits by that much.

    """
    found = _search(lambda d: _between(start, _rest(start, d), d), limits, model, share, duration_max_s)
    if found.use > STOP_USE_MAX:
        raise RefusedError(_no_fit("stop", found, limits, model, duration_max_s))
    return found


def _rest(start: Reference, duration_s: float) -> Reference:
    """Where the smoothest braking over a duration ends, at rest."""
    north, east, down, yaw = (travel_to_rest(channel, duration_s) for channel in _channels(start))
    p = start.p
    return Reference((p[0] + north, p[1] + east, p[2] + down), ZERO, ZERO, ZERO, ZERO, start.yaw + yaw, 0.0, 0.0)


def _channels(r: Reference) -> tuple[Derivatives, Derivatives, Derivatives, Derivatives]:
    """North, east, down and heading, each with its derivatives; a heading's third and fourth are taken as zero."""
    north, east, down = ((r.p[i], r.v[i], r.a[i], r.j[i], r.s[i]) for i in range(3))
    return north, east, down, (r.yaw, r.yaw_rate, r.yaw_acceleration, 0.0, 0.0)


def _between(start: Reference, end: Reference, duration_s: float) -> Join:
    ends = zip(_channels(start), _channels(end), strict=True)
    north, east, down, yaw = (through(first, last, duration_s) for first, last in ends)
    return Join(duration_s, north, east, down, yaw, 0.0)


def _durations(duration_max_s: float) -> Iterator[float]:
    duration_s = DURATION_MIN_S
    while duration_s < duration_max_s:
        yield duration_s
        duration_s *= DURATION_RATIO
    yield duration_max_s


def _search(
    build: Callable[[float], Join], limits: ReferenceLimits, model: PointMass, share: float, duration_max_s: float
) -> Join:
    """Return the shortest candidate that keeps to a share of the limits, else to all, else the one that exceeds
    least."""
    full = _Gate(limits, model, FULL_SHARES)
    eased = _Gate(limits, model, _shares(build(duration_max_s), limits, model, share))
    found, passed = _shortest(build, eased, duration_max_s)
    if not passed:
        found, _ = _shortest(build, full, duration_max_s)
    return replace(found, use=_worst(found, full)[1])


def _shares(candidate: Join, limits: ReferenceLimits, model: PointMass, share: float) -> Quantities:
    """Return the share of each limit that may be used: more where the ends ask for it, all of it for thrust."""
    ends = [uses(quantities(candidate.at(t_s), model), limits) for t_s in (0.0, candidate.duration_s)]
    allowed = [min(1.0, max(share, END_ROOM * first, END_ROOM * last)) for first, last in zip(*ends, strict=True)]
    speed, acceleration, tilt, _, _, rate, heading_rate = allowed
    return speed, acceleration, tilt, 1.0, 1.0, rate, heading_rate


def _shortest(build: Callable[[float], Join], gate: _Gate, duration_max_s: float) -> tuple[Join, bool]:
    """Return the first candidate that passes the gate and True, or else the one that exceeds it least and False."""
    allowed = 1.0 + USE_TOLERANCE
    best, best_use = build(duration_max_s), inf
    for duration_s in _durations(duration_max_s):
        candidate = build(duration_s)
        use = _coarse_use(candidate, gate, max(allowed, best_use))
        if use <= allowed and _worst(candidate, gate)[1] <= allowed:
            return candidate, True
        if use < best_use:
            best, best_use = candidate, use
    return best, False


def _coarse_use(candidate: Join, gate: _Gate, enough: float) -> float:
    """Return a lower bound of the candidate's use, and stop looking where it is beyond `enough`."""
    use = 0.0
    for i in range(COARSE_SAMPLES + 1):
        use = max(use, gate.use(candidate.at(candidate.duration_s * i / COARSE_SAMPLES)))
        if use > enough:
            break
    return use


def _worst(candidate: Join, gate: _Gate) -> tuple[float, float]:
    """Return when the candidate uses the gate most [s], and how much, with the maximum between samples found."""
    d = candidate.duration_s
    values = [gate.use(candidate.at(d * i / FINE_SAMPLES)) for i in range(FINE_SAMPLES + 1)]
    at = max(range(FINE_SAMPLES + 1), key=values.__getitem__)
    low, high = d * max(at - 1, 0) / FINE_SAMPLES, d * min(at + 1, FINE_SAMPLES) / FINE_SAMPLES
    t_s, refined = golden_maximum(lambda t: gate.use(candidate.at(t)), low, high)
    return (t_s, refined) if refined > values[at] else (d * at / FINE_SAMPLES, values[at])


def _no_fit(kind: str, found: Join, limits: ReferenceLimits, model: PointMass, duration_max_s: float) -> str:
    """Say which limit the best candidate exceeds, when and by how much."""
    at_s, _ = _worst(found, _Gate(limits, model, FULL_SHARES))
    reference = found.at(at_s)
    values = quantities(reference, model)
    shares = uses(values, limits)
    index = max(range(len(shares)), key=shares.__getitem__)
    bound = BOUNDS[index]
    a, b = found.at(0.0).p, found.at(found.duration_s).p
    distance_m = hypot(b[0] - a[0], b[1] - a[1], b[2] - a[2])
    return (
        f"no {kind} of up to {duration_max_s:g} s keeps the limits over {distance_m:.1f} m: "
        f"at best, in {found.duration_s:.1f} s, "
        f"{bound.quantity} is {values[index]:.3g} {bound.unit}, limit {getattr(limits, bound.key):.3g} {bound.unit} "
        f"(limits.{bound.key})"
    )
