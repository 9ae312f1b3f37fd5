"""The accounts of steps by reflex: what is found to need no judging is what the guards find nothing about."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.config import load_vehicle
from companion.control import flat
from companion.control.output import RateSetpoint
from companion.flight import envelope, following, fused, reckoning, reflex
from companion.flight.envelope import is_inside
from companion.flight.following import Following, off_by
from companion.flight.guards import Guards
from companion.flight.phases import PHASE_INDEX, Phase
from companion.flight.reckoning import Reckoner
from companion.flight.rows import StepTiming, control_row
from companion.flight.tracker import Target, TrackerStep
from companion.link.telemetry import VehicleState
from companion.trajectory import curve

VEHICLE = load_vehicle("bundled")
LIMITS = VEHICLE.limits
RECKONER: list[Reckoner] = []
TARGET = Target((1.0, 2.0, -3.0), (0.1, 0.2, 0.3))
CURVE = np.zeros(curve.SHAPE + 3 * curve.WAVE)
"""A straight line, which begins at the target."""
CURVE[curve.KIND], CURVE[curve.SCALE], CURVE[curve.COS] = curve.WAVES, 1.0, 1.0
CURVE[curve.SHAPE :: curve.WAVE], CURVE[curve.SHAPE + 1 :: curve.WAVE] = TARGET
LEVEL = (1.0, 0.0, 0.0, 0.0)
pytestmark = pytest.mark.numba


class Case:
    """A flight that was calm until now, and the step after it."""

    def __init__(
        self,
        error: tuple[float, float, float],
        q: tuple[float, float, float, float] = LEVEL,
        rates: tuple[float, float, float] = (0.1, -0.1, 0.0),
        flags: int = 0,
        errors: tuple[float, ...] = (0.0,) * 12,
        now_s: float = 11.0,
    ) -> None:
        self.guards = Guards(VEHICLE, VEHICLE.parameters(), "numba")
        self.following = Following(VEHICLE.autopilot.rate_lag_s, "numba")
        calm = [0.0] * flat.RESULTS
        for i in range(10):
            t_s = 10.0 + 0.01 * i
            assert self.guards.step(LEVEL, (0.0, 0.0, 0.0), tuple(calm), t_s) is None
            self.following.error(t_s, (0.1, -0.1, 0.0), (0.1, -0.1, 0.0), 0.02)
        numbers = [0.01 * i for i in range(flat.RESULTS)]
        numbers[flat.ERRORS], numbers[flat.LIMITS], numbers[flat.RATES] = errors, float(flags), (0.1, -0.1, 0.3)
        self.numbers, self.now_s, self.error = tuple(numbers), now_s, error
        p = tuple(t + e for t, e in zip(TARGET.p, error, strict=True))
        self.error = tuple(a - b for a, b in zip(p, TARGET.p, strict=True))
        self.state = VehicleState(int(now_s * 1e6), p, (0.4, 0.5, 0.6), q, rates, 0)  # type: ignore[arg-type]
        self.z, self.m = np.zeros(reflex.SIZE, np.int64), np.zeros(fused.SIZE)
        f = self.z[reflex.FLOATS :].view(np.float64)
        f[reflex.SEEN : reflex.SEEN + 13] = *p, *self.state.v, *q, *rates
        self.m[fused.STAMP], self.m[fused.SENT] = self.state.t_vehicle_us * 1e-6, 0.45
        self.m[fused.SENT + 1 : fused.SENT + 4] = numbers[flat.RATES]
        self.m[fused.RESULTS : fused.RESULTS + flat.RESULTS] = numbers
        self.m[fused.BEGIN] = self.m[fused.STAMP]  # the curve begins at this moment

    def reckon(self) -> bytes | None:
        if not RECKONER:
            RECKONER.append(Reckoner())
        assert self.guards.calm is not None and self.guards.envelope is not None
        given_ = (3.0, PHASE_INDEX[Phase.TRACK], 20.5, 133.0, True, self.now_s, 0.02, *self.guards.calm)
        return RECKONER[0].step(self.z, self.m, CURVE, given_, self.guards.envelope.numbers, self.following.numbers)

    def judged(self, off: float) -> bool:
        """Whether the guards find nothing; to be asked last."""
        found = self.guards.step(self.state.q, self.error, self.numbers, self.now_s, off)  # type: ignore[arg-type]
        return found is None and self.guards.calm is not None

    def off(self) -> float:
        w = self.state.w
        return off_by(self.following.numbers, self.m[fused.STAMP], w[0], w[1])


def test_a_calm_step_gets_its_row_and_the_rates_go_on() -> None:
    case, same = Case((0.05, -0.02, 0.01)), Case((0.05, -0.02, 0.01))
    row = case.reckon()
    assert row is not None
    out = TrackerStep(RateSetpoint(0.45, (0.1, -0.1, 0.3)), case.numbers, TARGET)
    timing = StepTiming(20.5, 133.0, True, 0)
    usual = control_row(3.0, Phase.TRACK, case.state, TARGET, case.error, out, timing)  # type: ignore[arg-type]
    assert np.frombuffer(row).tolist() == list(usual)
    same.following.error(case.m[fused.STAMP], case.state.w, (0.1, -0.1, 0.3), 0.02)
    assert list(case.following.numbers) == list(same.following.numbers)


TILTED = math.cos(0.5 * (LIMITS.tilt_max_rad + 0.01)), math.sin(0.5 * (LIMITS.tilt_max_rad + 0.01)), 0.0, 0.0
BOUND = min(LIMITS.position_error_abort_m, VEHICLE.controller.position_error_max_m)


@pytest.mark.parametrize(
    "case",
    [
        Case((BOUND + 1e-6, 0.0, 0.0)),
        Case((math.nan, 0.0, 0.0)),
        Case((0.0, 0.0, 0.0), q=TILTED),
        Case((0.0, 0.0, 0.0), rates=(0.1 + 1.01 * LIMITS.rate_error_max_rad_s, -0.1, 0.0)),
        Case((0.0, 0.0, 0.0), flags=1),
        Case((0.0, 0.0, 0.0), errors=(0.0,) * 9 + (1e3, 0.0, 0.0)),
        Case((0.0, 0.0, 0.0), errors=(0.0,) * 11 + (1e3,)),
        Case((0.0, 0.0, 0.0), errors=(2.0 * BOUND,) + (0.0,) * 11),
    ],
    ids=["far", "no number", "tilted", "does not follow", "saturated", "horizontal", "vertical", "beyond the bound"],
)
def test_what_the_guards_have_to_look_at_changes_nothing(case: Case) -> None:
    before = list(case.following.numbers), case.guards.envelope.numbers.tolist()  # type: ignore[union-attr]
    assert case.reckon() is None
    assert list(case.following.numbers) == before[0]
    assert case.guards.envelope.numbers.tolist() == before[1]  # type: ignore[union-attr]


AROUND = st.floats(-1.5, 1.5)


@settings(deadline=None, max_examples=200)
@given(
    st.tuples(AROUND, AROUND, AROUND),
    st.floats(0.0, 1.6),
    st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3)),
    st.sampled_from([0, 0, 0, 1, 4]),
    st.tuples(*[st.floats(-2, 2)] * 12),
    st.floats(0.0, 1.0),
    st.floats(10.09, 30.0),
)
def test_nothing_is_passed_over_that_the_guards_would_find(error, tilt, rates, flags, errors, size, now_s) -> None:
    q = math.cos(0.5 * tilt), math.sin(0.5 * tilt), 0.0, 0.0
    case = Case(error, q, rates, flags, tuple(size * e for e in errors), now_s)
    off = case.off()
    assert case.guards.envelope is not None
    linear = is_inside(case.guards.envelope.numbers, case.numbers[flat.ERRORS], 0)  # beyond that the guards look anyway
    row = case.reckon()
    assert (row is not None) == (case.judged(off) and linear)


def test_the_layout_fits() -> None:
    assert reckoning.SIZE == reckoning.ROW + 63
    assert len(Following(VEHICLE.autopilot.rate_lag_s, "numba").numbers) == following.SIZE
    assert envelope.SIZE == envelope.DECAY + envelope.STRIDES + 1
