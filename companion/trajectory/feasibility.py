"""The gate for references: everything that a reference asks for, against the vehicle's limits and the law's needs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import StrEnum
from math import copysign, floor, log10
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.control.types import Reference
from companion.trajectory.batch import Batch, batch, finite
from companion.trajectory.batch import quantities as array_quantities
from companion.trajectory.batch import uses as array_uses
from companion.trajectory.continuity import Finding, findings
from companion.trajectory.flatness import (
    BOUNDS,
    Bound,
    Demand,
    PointMass,
    ReferenceLimits,
    demand,
    quantities,
    uses,
    worst_use,
)
from companion.trajectory.pieces import Piece, golden_maximum
from companion.trajectory.timing import scaled

__all__ = ["Demand", "PointMass", "ReferenceLimits", "Violation", "ViolationName", "check", "demand"]

STEP_S = 0.02
"""Longest step of the scan [s]."""

SAMPLES_MIN = 400
SAMPLES_MAX = 50_000
PEAKS_REFINED = 3
USE_TOLERANCE = 1e-6
"""A limit may be exceeded by this share: a reference may lie exactly on it."""

TIME_SCALE_MIN = 1e-3
ADVICE_SAMPLES = 1000
ADVICE_MARGIN = 0.999
"""For what lies between the samples that the advised time scale is worked out from."""


class ViolationName(StrEnum):
    """What a reference can do wrong."""

    SPEED = "speed"
    ACCELERATION = "acceleration"
    TILT = "tilt"
    THRUST_LOW = "thrust_low"
    THRUST_HIGH = "thrust_high"
    BODY_RATE = "body_rate"
    HEADING_RATE = "heading_rate"
    JUMP = "jump"
    """A derivative up to the third (of the heading: up to the first) is not continuous."""
    DERIVATIVE = "derivative"
    """A derivative is not that of the one below."""
    NOT_FINITE = "not_finite"


BOUND_NAMES = (
    ViolationName.SPEED,
    ViolationName.ACCELERATION,
    ViolationName.TILT,
    ViolationName.THRUST_LOW,
    ViolationName.THRUST_HIGH,
    ViolationName.BODY_RATE,
    ViolationName.HEADING_RATE,
)
"""In the order of `flatness.BOUNDS`."""


class Violation(NamedTuple):
    """One reason to refuse a reference."""

    name: ViolationName
    value: float
    limit: float
    at_s: float
    """When it is worst; of a jump or a wrong derivative when it is first seen [s]."""
    sentence: str
    """For people, without the trajectory's name."""


def check(piece: Piece, limits: ReferenceLimits, model: PointMass) -> list[Violation]:
    """Scan a reference over its duration (a closed one over one period) and return all that speaks against flying it.

    Speed, acceleration, tilt, thrust and body rate are those of the reference itself, flown exactly, without
    disturbance: what the vehicle does while it settles is for a prediction to show.
    """
    times_s = grid(piece)
    found = batch(piece, times_s)
    good = finite(found)
    if not good.all():
        t_s = times_s[int(good.argmin())]
        sentence = f"the reference is not a finite number at {t_s:.2f} s"
        return [Violation(ViolationName.NOT_FINITE, float("nan"), 0.0, t_s, sentence)]
    violations = _bound_violations(piece, times_s, found, limits, model)
    return violations + [_wrong_derivative(finding) for finding in findings(piece, times_s, found)]


def grid(piece: Piece) -> list[float]:
    """Return the instants at which a piece is looked at, over its duration; of a closed one over one period [s]."""
    span_s = piece.duration_s if piece.period_s is None else min(piece.duration_s, piece.period_s)
    count = max(SAMPLES_MIN, min(SAMPLES_MAX, round(span_s / STEP_S)))
    return [span_s * i / count for i in range(count + 1)]


def _bound_violations(
    piece: Piece,
    times_s: Sequence[float],
    found: Batch,
    limits: ReferenceLimits,
    model: PointMass,
) -> list[Violation]:
    """Compare each limit with the worst of its quantity, found between the samples as well."""
    rows = array_uses(array_quantities(found, model), limits)
    exceeded = []
    for index in range(len(BOUNDS)):
        at_s, use = _worst(piece, times_s, rows[index], index, limits, model)
        if use > 1.0 + USE_TOLERANCE:
            exceeded.append((index, at_s))
    if not exceeded:
        return []
    peaks = [piece.at(at_s) for _, at_s in exceeded]
    some = [piece.at(t_s) for t_s in times_s[:: len(times_s) // ADVICE_SAMPLES + 1]]
    advice = _advice(piece, [*some, *peaks], limits, model)
    return [
        _exceeded(index, at_s, quantities(reference, model)[index], limits, advice)
        for (index, at_s), reference in zip(exceeded, peaks, strict=True)
    ]


def _worst(
    piece: Piece,
    times_s: Sequence[float],
    values: NDArray[np.float64],
    index: int,
    limits: ReferenceLimits,
    model: PointMass,
) -> tuple[float, float]:
    """Return when a limit is used most [s] and how much, refining the highest peaks of the scan."""

    def use(t_s: float) -> float:
        return uses(quantities(piece.at(t_s), model), limits)[index]

    return highest(times_s, values, use)


def highest(
    times_s: Sequence[float], values: Sequence[float] | NDArray[np.float64], f: Callable[[float], float]
) -> tuple[float, float]:
    """Return when a function of time is largest [s], and its value there.

    Args:
        times_s: the instants of a scan.
        values: the function there.
        f: the function, for the highest peaks to be found between the instants.

    """
    v = np.asarray(values, dtype=float)
    last = len(v) - 1
    before, after = np.concatenate([v[:1], v[:-1]]), np.concatenate([v[1:], v[-1:]])
    peaks = np.flatnonzero((v >= before) & (v >= after))
    top = v.max() * (1.0 - copysign(1e-9, v.max()))  # infinite stays infinite
    best = int((v >= top).argmax())
    worst = (times_s[best], float(v[best]))
    if v.min() >= top:
        return worst
    for i in peaks[np.argsort(-v[peaks], kind="stable")][:PEAKS_REFINED].tolist():
        refined = golden_maximum(f, times_s[max(i - 1, 0)], times_s[min(i + 1, last)])
        worst = max(worst, refined, key=lambda found: found[1])
    return worst


def _exceeded(index: int, at_s: float, value: float, limits: ReferenceLimits, advice: str) -> Violation:
    bound: Bound = BOUNDS[index]
    limit: float = getattr(limits, bound.key)
    verb = "reaches" if bound.upper else "falls to"
    sentence = (
        f"{bound.quantity} {verb} {_figure(value, limit)} {bound.unit} at {at_s:.2f} s, "
        f"limit {limit:g} {bound.unit} (limits.{bound.key}){advice}"
    )
    return Violation(BOUND_NAMES[index], value, limit, at_s, sentence)


def _figure(value: float, limit: float) -> str:
    """Write a value with three digits, or as many as show that it is not the limit."""
    for digits in range(3, 12):
        text = f"{value:.{digits}g}"
        if float(text) != float(f"{limit:.{digits}g}"):
            return text
    return f"{value!r}"


def _advice(piece: Piece, references: Sequence[Reference], limits: ReferenceLimits, model: PointMass) -> str:
    """Say which time scale would keep all limits; nothing where a piece has no such setting or none helps."""
    time_scale: float | None = getattr(piece, "time_scale", None)
    if time_scale is None:
        return ""
    if not _fits(TIME_SCALE_MIN, references, limits, model):
        return "; no time scale would fit"
    low, high = TIME_SCALE_MIN, 1.0
    for _ in range(12):
        mid = (low + high) / 2.0
        if _fits(mid, references, limits, model):
            low = mid
        else:
            high = mid
    fitting = ADVICE_MARGIN * low * time_scale
    digits = max(2, 1 - floor(log10(fitting)))
    return f"; a time scale of {floor(fitting * 10**digits) / 10**digits:g} would fit"


def _fits(scale: float, references: Sequence[Reference], limits: ReferenceLimits, model: PointMass) -> bool:
    return all(worst_use(scaled(reference, scale), limits, model) <= 1.0 for reference in references)


def _wrong_derivative(finding: Finding) -> Violation:
    if finding.jump:
        sentence = (
            f"{finding.name} jumps by {finding.value:.3g} {finding.unit} at {finding.at_s:.3f} s; it must be continuous"
        )
        name = ViolationName.JUMP
    else:
        sentence = (
            f"{finding.name} is not the derivative of the one below: it differs by {finding.value:.3g} {finding.unit} "
            f"at {finding.at_s:.3f} s"
        )
        name = ViolationName.DERIVATIVE
    return Violation(name, finding.value, finding.limit, finding.at_s, sentence)
