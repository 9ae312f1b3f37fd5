"""What is flown instead of what the files say, where the loop that was measured asks for it (`flight.schedule`)."""

from __future__ import annotations

from typing import Any, NamedTuple

from companion.config import Flight, Vehicle, merged, validate


class Adaptation(NamedTuple):
    """What is flown instead of what the files say; with it a flight can be computed again."""

    output: str
    """ "rates", "attitude" or "actuators"."""
    gains_share: float
    state_rate_hz: float
    """That the loop goes by."""
    state_age_s: float


def slower(vehicle: Vehicle, share: float) -> Vehicle:
    """The vehicle with its law on a slower clock.

    Raises:
        InputError: such gains are none.
    """
    c = vehicle.controller
    scaled: dict[str, Any] = {
        "k1_1_s": share * c.k1_1_s,
        "k3_1_s": share * c.k3_1_s,
        "k4_1_s": share * c.k4_1_s,
        "gamma_1_s3": share**3 * c.gamma_1_s3,
        "position_error_max_m": c.position_error_max_m / share**2,
        "heading_l1_1_s": share * c.heading_l1_1_s,
        "heading_l2_1_s": share * c.heading_l2_1_s,
        "heading_damping_1_s": share * c.heading_damping_1_s,
    }
    return validate(Vehicle, merged(vehicle.model_dump(), {"controller": scaled}), f"{share:.0%} of the gains")


def adapted(flight: Flight, adaptation: Adaptation | None) -> Flight:
    """The flight as it is flown."""
    if adaptation is None:
        return flight
    vehicle = flight.vehicle if adaptation.gains_share == 1.0 else slower(flight.vehicle, adaptation.gains_share)
    link = vehicle.link.model_copy(
        update={"state_rate_hz": adaptation.state_rate_hz, "state_age_s": adaptation.state_age_s}
    )
    return flight.model_copy(
        update={
            "vehicle": vehicle.model_copy(update={"link": link}),
            "output": flight.output.model_copy(update={"kind": adaptation.output}),
        }
    )
