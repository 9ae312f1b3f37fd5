"""Who flies: the law, PX4's own position controller, or a calibration. A flight chooses one of them on the ground."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from companion.config import Flight
from companion.control.types import State
from companion.flight.baseline import Px4Baseline
from companion.flight.calibration import Calibrator
from companion.flight.engines import Kernels
from companion.flight.phases import Autopilot
from companion.flight.resets import Reset
from companion.flight.tracker import Stepping, Tracker


class Controller(Stepping, Protocol):
    """Answers every state with one setpoint; its time is the vehicle's, and it knows nothing of sockets."""

    def begin(self, state: State, thrust_n: float | None = None) -> None:
        """Starts from a hover.

        Args:
            state: the vehicle now.
            thrust_n: the thrust that acts [N]; None: unknown.
        """
        ...

    def foresee(self, stamp_s: float) -> tuple[State, float] | None:
        """The state at a stamp, from the last one and the commands since, and the thrust over the mass [m/s^2]; None
        before the first state."""
        ...

    def carry(self, reset: Reset) -> None:
        """Goes on after a reset of the autopilot's estimate as if nothing had happened."""
        ...


def _silent(line: str) -> None:
    """Tells nobody."""


def controller_of(
    flight: Flight,
    compiled: Kernels,
    autopilot: Autopilot | None = None,
    notify: Callable[[str], None] = _silent,
) -> Controller:
    """The controller that a flight asks for ([output] controller).

    Args:
        flight: the configuration.
        compiled: the law's arithmetic.
        autopilot: what it says of itself, kept up to date.
        notify: gets lines for people.
    """
    if flight.output.controller == "calibration":
        return Calibrator(flight, Autopilot() if autopilot is None else autopilot, notify)
    if flight.output.controller == "px4":
        return Px4Baseline(flight.vehicle)
    return Tracker(flight.vehicle, flight.output.by_law, compiled)
