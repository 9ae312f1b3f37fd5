"""One row of a flight's record from one control step, in the order of `record.columns`."""

from __future__ import annotations

from typing import NamedTuple

from companion.control import flat
from companion.control.output import thrust_of
from companion.control.types import Reference, Vec3
from companion.flight.phases import PHASE_INDEX, Phase
from companion.flight.tracker import Target, TrackerStep
from companion.link.telemetry import VehicleState


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
    return (
        (state.t_vehicle_us * 1e-6, track_s, PHASE_INDEX[phase], *state.p, *state.v, *state.q, *state.w)
        + (*target.p, *target.v, *error, n[flat.HEADING_ERROR], *n[flat.ERRORS], n[flat.LYAPUNOV])
        + (*n[flat.B_HAT], n[flat.TOTAL], n[flat.TOTAL_RATE], *n[flat.TAU], *n[flat.RATES])
        + (thrust_of(out.setpoint), timing.age_ms, timing.took_us, float(timing.late), float(timing.skipped))
        + (n[flat.LIMITS], *n[flat.PREDICTED_Q], *n[flat.PREDICTED_W])
    )
