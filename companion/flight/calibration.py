"""Flies the manoeuvres of a calibration: a `flight.controller.Controller` like the law, watched by the same guards.

Between manoeuvres it hovers at the point where it took over. One begins only when the vehicle is at rest there, and
ends early when the tilt gets large; both are told. What is identified from the record, and how, is `identification`.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from companion.config import Flight
from companion.control import flat
from companion.control.hover import hover
from companion.control.output import RateSetpoint, Setpoint, thrust_fraction
from companion.control.types import GRAVITY_M_S2, Reference, State, Vec3
from companion.control.vectors import axes, clip, norm, quat_exp, quat_multiply
from companion.flight.engines import ReferenceAt
from companion.flight.manoeuvres import Kind, Manoeuvre, Slot, plan
from companion.flight.phases import Autopilot
from companion.flight.resets import Reset
from companion.flight.tracker import Stepping, TrackerStep
from companion.frames import tilt_from_quat, wrap_angle, yaw_from_quat

ZERO: Vec3 = (0.0, 0.0, 0.0)
HOVER_LIMITS = (0.05, 0.85)
"""A command that hovers outside of these is not believed."""
THRUST_LIMITS = (0.05, 0.95)
"""Of what is commanded, as a share of full."""
REST_SPEED_M_S = 0.4
REST_ERROR_M = 1.0
REST_TILT_RAD = 0.2
"""Beyond any of these no manoeuvre begins."""
TILT_ABORT_RAD = 0.45
"""Beyond, a manoeuvre ends at once."""
INTEGRAL_GAP_S = 0.1
"""Over a longer time without a state nothing is integrated; where states are rarer, see INTEGRAL_GAP_INTERVALS."""
INTEGRAL_GAP_INTERVALS = 2.5
"""Up to so many nominal intervals without a state are no gap."""

_NOTHING = [math.nan] * flat.RESULTS
_NOTHING[flat.LIMITS] = 0.0
_NOTHING[flat.B_HAT] = [0.0, 0.0, 0.0]


class Calibrator(Stepping):
    """Hovers and excites.

    Args:
        flight: with its table [calibration].
        autopilot: what it says of itself: the thrust of its own hover is where this one begins.
        notify: gets lines for people.
    """

    def __init__(self, flight: Flight, autopilot: Autopilot, notify: Callable[[str], None]) -> None:
        assert flight.calibration is not None
        vehicle = flight.vehicle
        self._vehicle, self._autopilot, self._notify = vehicle, autopilot, notify
        self._interval_s = 1.0 / vehicle.link.state_rate_hz
        self._gap_s = max(INTEGRAL_GAP_S, INTEGRAL_GAP_INTERVALS * self._interval_s)
        self._slots = plan(flight.calibration)
        self.hover_share = self._of_file()
        """The command that hovers, of full."""
        self._begun_s: float | None = None
        self._last_s: float | None = None
        self._seen: State | None = None
        self._yaw = 0.0
        self._integral: Vec3 = ZERO
        self._at = 0
        self._running = False
        self._last: TrackerStep | None = None
        self.flown = 0
        """Manoeuvres that were begun and not ended early."""

    def begin(self, state: State, thrust_n: float | None = None) -> None:
        """Begins from a hover that the autopilot holds."""
        self.hover_share = self._measured()
        self._begun_s = self._last_s = None
        self._yaw = yaw_from_quat(state.q)
        r3 = axes(state.q)[2]
        # what the tilt of the hover makes up for, so that nothing steps
        self._integral = (-GRAVITY_M_S2 * r3[0] / max(r3[2], 0.5), -GRAVITY_M_S2 * r3[1] / max(r3[2], 0.5), 0.0)
        self._at, self._running, self.flown = 0, False, 0

    def command(self, stamp_s: float, state: State, reference_at: ReferenceAt, *, frozen: bool = False) -> Setpoint:
        """The setpoint for one state.

        Args:
            stamp_s: vehicle time of the state [s].
            state: as received.
            reference_at: where to hover.
            frozen: hold the integral still.
        """
        if self._begun_s is None:
            self._begun_s = stamp_s
        dt_s = self._interval_s if self._last_s is None else stamp_s - self._last_s
        integrates = 0.0 < dt_s <= self._gap_s and not frozen
        self._last_s, self._seen = stamp_s, state
        t_s = stamp_s - self._begun_s
        reference = reference_at(stamp_s)._replace(yaw=self._yaw)
        manoeuvre, since_s = self._due(t_s, state, reference)
        if manoeuvre is not None and manoeuvre.kind is Kind.RUN:
            reference = _moved(reference, manoeuvre.run(since_s))
        open_loop = manoeuvre is not None and manoeuvre.kind is Kind.THRUST
        command = hover(state, reference, self._integral, dt_s if integrates and manoeuvre is None else 0.0)
        self._integral = command.integral
        thrust, rates = command.thrust, list(command.rates)
        if manoeuvre is not None and manoeuvre.kind is Kind.RATE:
            rates[manoeuvre.axis] = manoeuvre.step(since_s)
        elif manoeuvre is not None and open_loop:
            thrust = (1.0 + manoeuvre.step(since_s)) / max(axes(state.q)[2][2], 0.8)
        share = clip(self.hover_share * thrust, *THRUST_LIMITS)
        self._last = self._out(share, (rates[0], rates[1], rates[2]), command.integral)
        return self._last.setpoint

    def last_step(self) -> TrackerStep:
        """The last step, for the record."""
        assert self._last is not None
        return self._last

    def foresee(self, stamp_s: float) -> tuple[State, float] | None:
        """The last state, moved on as it was; and the thrust of a hover over the mass [m/s^2]."""
        if self._last_s is None or self._seen is None:
            return None
        dt = stamp_s - self._last_s
        p, v, q, w = self._seen
        turned = quat_multiply(q, quat_exp((dt * w[0], dt * w[1], dt * w[2])))
        return State((p[0] + dt * v[0], p[1] + dt * v[1], p[2] + dt * v[2]), v, turned, w), GRAVITY_M_S2

    def carry(self, reset: Reset) -> None:
        """Goes on after a reset of the autopilot's estimate: the heading that is held turns along."""
        self._yaw = wrap_angle(self._yaw + reset.turned_rad)

    # -- what is due ----------------------------------------------------------------------------------------------

    def _due(self, t_s: float, state: State, reference: Reference) -> tuple[Manoeuvre | None, float]:
        """The manoeuvre of this moment and the time since its beginning."""
        slots = self._slots
        while self._at < len(slots) and t_s >= slots[self._at].end_s:
            self.flown += self._running
            self._at, self._running = self._at + 1, False
        if self._at >= len(slots):
            return None, 0.0
        slot = slots[self._at]
        since_s = t_s - slot.begin_s
        if since_s < 0.0:
            return None, 0.0
        if not self._running:
            late = since_s > 2.0 * self._interval_s
            if late:
                self._notify(
                    f"{slot.manoeuvre.told}: left out, for {since_s * 1e3:.0f} ms no state came to begin it by"
                )
            if late or not self._may_begin(slot, state, reference):
                self._at += 1
                return None, 0.0
            self._running = True
            self._notify(f"calibration {self._at + 1} of {len(slots)}: {slot.manoeuvre.told}")
        elif tilt_from_quat(state.q) > TILT_ABORT_RAD:
            self._notify(f"{slot.manoeuvre.told}: ended early, the tilt is {tilt_from_quat(state.q):.2f} rad")
            self._at, self._running = self._at + 1, False
            return None, 0.0
        return slot.manoeuvre, since_s

    def _may_begin(self, slot: Slot, state: State, reference: Reference) -> bool:
        """Whether the vehicle is at rest where it should be."""
        apart = math.dist(state.p, reference.p)
        speed, tilt = norm(state.v), tilt_from_quat(state.q)
        at_rest = speed < REST_SPEED_M_S and apart < REST_ERROR_M and tilt < REST_TILT_RAD + self._leaning
        if not at_rest:
            told = f"{speed:.2f} m/s, {apart:.2f} m away, tilt {tilt:.2f} rad"
            self._notify(f"{slot.manoeuvre.told}: left out, the vehicle is not at rest ({told})")
        return at_rest

    @property
    def _leaning(self) -> float:
        """The tilt that a steady wind asks for [rad]."""
        return math.atan2(math.hypot(self._integral[0], self._integral[1]), GRAVITY_M_S2)

    # -- thrust ---------------------------------------------------------------------------------------------------

    def _of_file(self) -> float:
        vehicle = self._vehicle
        weight = vehicle.body.mass_kg * GRAVITY_M_S2
        return thrust_fraction(weight, vehicle.thrust_full_n, vehicle.rotors.curve_factor)

    def _measured(self) -> float:
        """The command that hovers: as the autopilot's Hold needed it, as its parameters say, or by the file."""
        told = self._autopilot.hold_thrust, self._autopilot.parameters.get("MPC_THR_HOVER"), self._of_file()
        low, high = HOVER_LIMITS
        return next((share for share in told if share is not None and low < share < high), clip(told[2], low, high))

    def _out(self, share: float, rates: Vec3, integral: Vec3) -> TrackerStep:
        numbers = list(_NOTHING)
        numbers[flat.RATES] = rates
        numbers[flat.B_HAT] = (-integral[0], -integral[1], -integral[2])
        return TrackerStep(RateSetpoint(share, rates), tuple(numbers))


def _moved(reference: Reference, run: tuple[Vec3, Vec3, Vec3]) -> Reference:
    """The hover's reference, moved along a run."""
    (x, y, z), (dx, dy, dz) = reference.p, run[0]
    return reference._replace(p=(x + dx, y + dy, z + dz), v=run[1], a=run[2])
