"""What a flight amounted to, in one dictionary: the content of `summary.json`.

Everything is computed over the track phase. Times with `_s` in the settling entries are times on the trajectory;
`at_s` of a phase is vehicle time, the clock of the record's `t_s`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from companion.errors import InputError
from companion.record.columns import TRACK_PHASE
from companion.record.flight_record import FlightRecord

Array = npt.NDArray[np.float64]

SETTLED_BELOW_M: Final = 0.2
"""A flight has settled when its position error stays below this until the end of the track."""

SETTLING_MARGIN_S: Final = 10.0
"""Statistics begin this much later."""

WALL_CLOCK_KEYS: Final = ("state_age_ms", "step_us", "late_steps")
"""Entries that differ between equal flights."""

ACCEPTANCE_KEYS: Final = (
    "settled_at_s",
    "position_rms_m",
    "position_p95_m",
    "position_max_m",
    "vertical_rms_m",
    "heading_rms_rad",
    "body_sideways_rms_m_s",
    "thrust_max_n",
    "tilt_max_rad",
    "late_steps",
    "lost_setpoints",
)
"""What [acceptance] in a flight file may bound from above."""

PASSED: Final = "passed"
NOT_SETTLED: Final = "not settled"
DID_NOT_TRACK: Final = "did not track"
_TOO_SHORT: Final = "flown, too short for statistics"
COMPLETED: Final = "COMPLETED"
"""The cause of an end as planned."""


class PhaseChange(NamedTuple):
    """A phase of the flight, its begin, and why it began."""

    name: str
    at_s: float
    """Vehicle time, the clock of the record's `t_s`."""
    reason: str


@dataclass(frozen=True)
class FlightMeta:
    """What a summary says beyond the record."""

    trajectory: str
    """Name of the trajectory."""
    vehicle: str
    """Name of the vehicle."""
    lost_setpoints: int = 0
    """States due an answer that got none."""
    statistics_from_s: float | None = None
    """Begin of the statistics on the trajectory [s]; None: 10 s after settling."""
    acceptance: Mapping[str, float] = field(default_factory=dict)
    """Thresholds: the largest value that passes, by summary key (`ACCEPTANCE_KEYS`)."""
    controller: str = "law"
    """Who flew: "law", "px4" or "calibration"; the record of the last two has none of the law's numbers."""


def check_acceptance(acceptance: Mapping[str, object], where: str) -> None:
    """Refuse thresholds that no summary can be judged by, before the flight.

    Raises:
        InputError: an unknown key, or a value that is not a finite number; `where` names the file.
    """
    for key, value in acceptance.items():
        if key not in ACCEPTANCE_KEYS:
            raise InputError(f"{where}: acceptance.{key} is unknown; allowed are {', '.join(ACCEPTANCE_KEYS)}")
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise InputError(f"{where}: acceptance.{key} = {value!r} must be a finite number")


def summarise(record: FlightRecord, phases: Sequence[PhaseChange], meta: FlightMeta) -> dict[str, Any]:
    """Compute the summary of a flight.

    Args:
        record: all steps of the flight.
        phases: its phases in their order.
        meta: names, thresholds, and what only the loop counted.

    Returns:
        The entries of `summary.json` in a fixed order; numbers are not rounded, what does not exist is None.
    """
    on_track = np.flatnonzero(record.in_phase(TRACK_PHASE) & np.isfinite(record.column("track_s")))
    steps = record.select(on_track)
    settled_at_s = _settled_at_s(steps)
    from_s = _statistics_from_s(settled_at_s, meta.statistics_from_s)
    summary: dict[str, Any] = {
        "trajectory": meta.trajectory,
        "vehicle": meta.vehicle,
        "controller": meta.controller,
        **_extent(steps, on_track),
        "settled_at_s": settled_at_s,
        "statistics_from_s": from_s,
        **_tracking(steps, from_s),
        **_effort(steps),
        **_timing(steps),
        "lost_setpoints": int(meta.lost_setpoints),
        "phases": [{"name": name, "at_s": _number(at_s), "reason": reason} for name, at_s, reason in phases],
    }
    # the manoeuvres of a calibration are not there to stay near a reference
    summary["verdict"] = "passed" if meta.controller == "calibration" else _verdict(summary, meta.acceptance)
    return summary


def note_end(
    summary: dict[str, Any],
    outcome: Mapping[str, Any],
    engagement: Mapping[str, Any] | None,
    px4_parameters: Mapping[str, float],
) -> None:
    """Add how the flight ended.

    Args:
        summary: of `summarise`; changed.
        outcome: "sentence", "cause", "rejected_states" and, where there are any, "delay_s" and "vehicle_facts", as the
            flight's log keeps them.
        engagement: how the controller took over, if it did.
        px4_parameters: those of PX4's own controller, for a flight of its.
    """
    summary["ended"] = outcome["sentence"]
    if engagement is not None:
        summary["engagement"] = engagement
    summary["rejected_states"] = outcome["rejected_states"]
    summary["refused_messages"] = outcome.get("refused_messages", {})
    if outcome.get("delay_s"):
        summary["delay_s"] = outcome["delay_s"]
    if outcome.get("vehicle_facts"):
        summary["vehicle_facts"] = outcome["vehicle_facts"]
    if summary["controller"] == "px4":
        summary["px4_parameters"] = px4_parameters
    if outcome["cause"] != COMPLETED:
        summary["verdict"] = f"ended early: {outcome['sentence']}"


def without_wall_clock(summary: Mapping[str, Any]) -> dict[str, Any]:
    """The summary without the entries that differ between equal flights."""
    return {key: value for key, value in summary.items() if key not in WALL_CLOCK_KEYS}


def _settled_at_s(steps: FlightRecord) -> float | None:
    """First time on the track after which the error stays below the bound; NaN is not below it."""
    outside = np.flatnonzero(~(_norm(_errors(steps)) < SETTLED_BELOW_M))
    first = int(outside[-1]) + 1 if len(outside) else 0
    return float(steps.column("track_s")[first]) if first < len(steps) else None


def _statistics_from_s(settled_at_s: float | None, given_s: float | None) -> float | None:
    if given_s is not None:
        return float(given_s)
    return None if settled_at_s is None else settled_at_s + SETTLING_MARGIN_S


def _extent(steps: FlightRecord, rows: npt.NDArray[np.intp]) -> dict[str, Any]:
    """Length of the track, number of steps and their rate by vehicle time; `rows`: where they stand in the record."""
    track_s = steps.column("track_s")
    # Steps that do not follow each other in the record have a pause between them, which does not count.
    following = np.diff(rows) == 1
    span_s = float(np.diff(steps.column("t_s"))[following].sum())
    return {
        "duration_s": float(track_s[-1] - track_s[0]) if len(steps) else 0.0,
        "steps": len(steps),
        "control_rate_hz": int(following.sum()) / span_s if span_s > 0.0 else None,
    }


def _tracking(steps: FlightRecord, from_s: float | None) -> dict[str, Any]:
    """How well the reference was followed from a time on the track until its end; `track_rms_m`: from the track's
    begin, there for flights that never settle too."""
    window = np.zeros(len(steps), dtype=np.bool_) if from_s is None else steps.column("track_s") >= from_s
    errors = _errors(steps)[window]
    distance = _norm(errors)
    heading = steps.column("heading_error_rad")[window]
    return {
        "track_rms_m": _rms(_norm(_errors(steps))),
        "position_rms_m": _rms(distance),
        "position_p95_m": _percentile(distance, 95.0),
        "position_max_m": _largest(distance),
        "vertical_rms_m": _rms(errors[:, 2]),
        "heading_rms_rad": _rms(heading[np.isfinite(heading)]),
        "body_sideways_rms_m_s": _rms(body_velocity(steps)[window, 1]),
    }


def _effort(steps: FlightRecord) -> dict[str, Any]:
    """The last disturbance estimate, and the extremes of thrust and tilt."""
    estimate = [_number(value) for value in steps.columns("b_hat_n", "b_hat_e", "b_hat_d")[-1]] if len(steps) else []
    thrust = steps.column("thrust_n")
    return {
        "disturbance_m_s2": estimate if any(value is not None for value in estimate) else None,
        "thrust_min_n": _number(-value) if (value := _largest(-thrust)) is not None else None,
        "thrust_max_n": _largest(thrust),
        "tilt_max_rad": _largest(tilt(steps)),
    }


def _timing(steps: FlightRecord) -> dict[str, Any]:
    """Wall-clock figures."""
    return {
        **{
            name: {"p50": _percentile(steps.column(name), 50.0), "p99": _percentile(steps.column(name), 99.0)}
            for name in ("state_age_ms", "step_us")
        },
        "late_steps": int((steps.column("late") > 0.0).sum()),
    }


def body_velocity(record: FlightRecord) -> Array:
    """Velocity in the body frame R' v, FRD, shape (len, 3) [m/s], from the states as received."""
    w, x, y, z = record.columns("q_w", "q_x", "q_y", "q_z").T
    n, e, d = record.columns("v_n", "v_e", "v_d").T
    forward = (1 - 2 * (y * y + z * z)) * n + 2 * (x * y + w * z) * e + 2 * (x * z - w * y) * d
    right = 2 * (x * y - w * z) * n + (1 - 2 * (x * x + z * z)) * e + 2 * (y * z + w * x) * d
    down = 2 * (x * z + w * y) * n + 2 * (y * z - w * x) * e + (1 - 2 * (x * x + y * y)) * d
    return np.column_stack((forward, right, down))


def tilt(record: FlightRecord) -> Array:
    """Angle between the body's and the inertial vertical, shape (len,) [rad]."""
    _, x, y, _ = record.columns("q_w", "q_x", "q_y", "q_z").T
    return np.asarray(np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0)))


def _verdict(summary: Mapping[str, Any], acceptance: Mapping[str, float]) -> str:
    """One line: passed, or what was missed and by how much."""
    if summary["steps"] == 0:
        return DID_NOT_TRACK
    if summary["settled_at_s"] is None:
        return NOT_SETTLED
    if summary["position_max_m"] is None and not acceptance:
        return f"{_TOO_SHORT}, which begin at {summary['statistics_from_s']:.4g} s"
    if summary["position_max_m"] is None:
        return f"missed: the track ended before the statistics began at {summary['statistics_from_s']:.4g} s"
    missed = []
    for key, most in acceptance.items():
        value = summary.get(key)
        if not isinstance(value, int | float):
            missed.append(f"{key} is unknown, {most:.4g} allowed")
        elif not value <= most:
            # As many digits as it takes to see the difference.
            digits = next((digits for digits in (3, 4, 6) if f"{value:.{digits}g}" != f"{most:.{digits}g}"), 17)
            missed.append(f"{key} {value:.{digits}g} > {most:.6g}")
    return f"missed: {', '.join(missed)}" if missed else PASSED


def met(verdict: object) -> bool:
    """Whether this verdict is one of a flight that missed nothing which was asked of it."""
    return verdict == PASSED or str(verdict).startswith(_TOO_SHORT)


def _errors(record: FlightRecord) -> Array:
    return record.columns("error_n", "error_e", "error_d")


def _norm(vectors: Array) -> Array:
    return np.asarray(np.sqrt((vectors * vectors).sum(axis=1)))


def _number(value: float) -> float | None:
    """JSON has no NaN."""
    return float(value) if math.isfinite(value) else None


def _rms(values: Array) -> float | None:
    return _number(float(np.sqrt(np.mean(values * values)))) if len(values) else None


def _percentile(values: Array, percent: float) -> float | None:
    finite = values[np.isfinite(values)]
    return _number(float(np.percentile(finite, percent))) if len(finite) else None


def _largest(values: Array) -> float | None:
    finite = values[np.isfinite(values)]
    return float(finite.max()) if len(finite) else None
