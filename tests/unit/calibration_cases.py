"""Calibration flights without sockets: the calibrator against the bundled physics."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from companion.campaign.simulate import loop_setpoint, simulated_vehicle, simulated_world
from companion.config import CalibrationFlight, Flight, build_flight, find, read_toml
from companion.control.output import RateSetpoint
from companion.control.types import Quat, State
from companion.control.vectors import quat_exp
from companion.flight.calibration import Calibrator
from companion.flight.course import at_rest
from companion.flight.manoeuvres import length_s, plan
from companion.flight.phases import PHASE_NAMES, Autopilot, Phase
from companion.flight.rows import StepTiming, control_row
from companion.link.telemetry import VehicleState
from companion.record.flight_record import FlightRecord
from companion.record.flight_source import FlightSource
from sim_link.airframe import Airframe
from sim_link.inner_loops import make_gains

HOVER_M = (0.0, 0.0, -20.0)


def calibration_flight(settings: dict[str, Any], **changes: Any) -> Flight:
    """Of the bundled vehicle at 100 Hz; keys of its file with "__"."""
    vehicle = read_toml(find("bundled", "vehicles"))
    vehicle["link"]["state_rate_hz"] = 100.0
    world = changes.pop("world", {})
    for key, value in changes.items():
        section, name = key.split("__")
        vehicle[section][name] = value
    hover = {"point_m": [0.0, 0.0, 0.0]}
    duration_s = length_s(plan(CalibrationFlight(**settings)))
    data = {
        **{"name": "calibration", "vehicle": vehicle, "calibration": settings, "world": world},
        "trajectory": {"name": "hover", "shape": "hover", "duration_s": duration_s, "hover": hover},
        "output": {"controller": "calibration"},
    }
    return build_flight(data, "test")


def fly(
    flight: Flight, *, hover_share: float, undone_curve: float | None = None, seed: int = 1
) -> tuple[FlightSource, Calibrator, list[str]]:
    """The record of a calibration flight.

    Args:
        flight: `calibration_flight`.
        hover_share: what the autopilot's own hover needed, as the calibrator is told.
        undone_curve: THR_MDL_FAC of the autopilot; None: the vehicle's own.
        seed: of the noise.
    """
    vehicle, sim = flight.vehicle, simulated_vehicle(flight)
    air = Airframe(sim, simulated_world(flight), seed=seed, engine="auto", start=(HOVER_M, 0.0), px4="1.18")
    if undone_curve is not None:
        air.set_gains(make_gains(sim, "1.18")._replace(curve_factor=undone_curve))
    told: list[str] = []
    calibrator = Calibrator(flight, Autopilot(hold_thrust=hover_share), told.append)
    calibrator.begin(State(HOVER_M, (0.0, 0.0, 0.0), leaning(flight), (0.0, 0.0, 0.0)))
    steps = round(sim.loop_rate_hz / vehicle.link.state_rate_hz)
    assert flight.calibration is not None
    count = int(length_s(plan(flight.calibration)) * vehicle.link.state_rate_hz)
    record = FlightRecord(count, PHASE_NAMES)
    reference = at_rest(HOVER_M, 0.0)
    begin_s, acting = 1e-6 * air.t_us, loop_setpoint(RateSetpoint(hover_share, (0.0, 0.0, 0.0)))
    under_way: list[tuple[int, Any]] = []
    for _ in range(count):
        believed = air.believed()
        stamp_s, fresh = 1e-6 * believed.t_us, False
        if stamp_s >= begin_s:
            state = State(believed.p, believed.v, believed.q, believed.w)
            out = calibrator.step(stamp_s, state, lambda t: reference)
            under_way.append((air.t_us + round(1e6 * vehicle.link.command_delay_s), loop_setpoint(out.setpoint)))
            error = tuple(a - b for a, b in zip(state.p, HOVER_M, strict=True))
            timing = StepTiming(1e-3 * (air.t_us - believed.t_us), 1.0, False, 0)
            seen = VehicleState(believed.t_us, *state, 0)
            record.append(control_row(stamp_s - begin_s, Phase.TRACK, seen, reference, error, out, timing))
        while under_way and under_way[0][0] <= air.t_us:
            acting, fresh = under_way.pop(0)[1], True
        air.advance(acting, fresh, steps)
    configuration = flight.model_dump(exclude_none=True)
    return FlightSource(Path("flown"), record, {}, configuration, "flown"), calibrator, told


def leaning(flight: Flight) -> Quat:
    """The attitude in which the autopilot's own Hold had the vehicle: it leans against a steady wind."""
    north, east, _ = (flight.vehicle.body.drag_1_s * speed / 9.81 for speed in flight.world.wind_m_s)
    return quat_exp((-east, north, 0.0))


def hover_share(flight: Flight, curve: float = 0.0) -> float:
    """The command that really hovers."""
    share = flight.vehicle.body.mass_kg * 9.81 * flight.world.gravity_factor / flight.vehicle.thrust_full_n
    if curve == 0.0:
        return share
    half = 0.5 * (1.0 - curve) / curve
    return math.sqrt(half * half + share / curve) - half
