"""One row of a flight's record from one control step, in the order of `record.columns`."""

from __future__ import annotations

from typing import NamedTuple

from companion.control import flat
from companion.control.output import thrust_of
from companion.control.types import Reference, Vec3
from companion.flight.phases import PHASE_INDEX, Phase
from companion.flight.tracker import Target, TrackerStep
from companion.link.telemetry import VehicleState

_LAW, _LIMITS = flat.RECORDED


class StepTiming(NamedTuple):
    """How a step went; all but `skipped` are wall-clock measurements."""

    age_ms: float
    took_us: float
    late: bool
    skipped: int


def control_row(
    track_s: float,
    phase: Phase,
    state: VehicleState,
    target: Target | Reference,
    error: Vec3,
    out: TrackerStep,
    timing: StepTiming,
) -> tuple[float, ...]:
    """The row.

    Args:
        track_s: time on the trajectory [s], NaN outside of the track phase.
        phase: the phase of the step.
        state: as received.
        target: the reference at the state's stamp.
        error: position less reference, NED [m].
        out: what the step gave.
        timing: how it went.
    """
    n = out.numbers
    t_us, p, v, q, w, _ = state
    age_ms, took_us, late, skipped = timing
    return (
        *(t_us * 1e-6, track_s, PHASE_INDEX[phase], *p, *v, *q, *w, *target.p, *target.v, *error, *n[_LAW]),
        *(thrust_of(out.setpoint), age_ms, took_us, float(late), float(skipped), *n[_LIMITS]),
    )
