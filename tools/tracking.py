"""What each known dynamic of the law brings: the bundled vehicle's figure of eight, with one switched off at a time.

    python tools/tracking.py            the tables of docs/tracking.md
    python tools/tracking.py --json     the same for programs

The very controller that flies, against the bundled physics without sockets (`companion simulate`); errors from 10 s
after the beginning of the track on, seed 1, states at 100 Hz. It takes about a minute.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from companion.campaign.simulate import fly_sampled, simulated_vehicle
from companion.config import Flight, build_flight, find, read_toml
from companion.errors import RefusedError
from companion.flight.engines import kernels
from companion.trajectory.load import embedded, of_flight

SPEEDS = (1.0, 2.5, 3.5)
BEFORE_S, COUNTED_S = 12.0, 30.0
SWITCHES: dict[str, dict[str, Any]] = {
    "everything": {},
    "without drag_feedforward": {"drag_feedforward": False},
    "without rate_lag_inversion": {"rate_lag_inversion": False},
    "... of roll and pitch": {"rate_lag_inversion": [False, False, True]},
    "... of yaw": {"rate_lag_inversion": [True, True, False]},
    "without thrust_lag_compensation": {"thrust_lag_compensation": False},
    "without prediction": {"prediction": False},
    "without any of them": {
        **{"drag_feedforward": False, "rate_lag_inversion": False, "thrust_lag_compensation": False},
        "prediction": False,
    },
}
LOST_M = 3.0
"""A larger error is no tracking."""
SCALES = (0.9, 1.1)
"""Of the rotors' thrust, over what the vehicle file says."""


def flight(speed: float, controller: Mapping[str, Any]) -> Flight:
    """The figure of eight, so many times as fast."""
    vehicle = read_toml(find("bundled", "vehicles"))
    vehicle["link"]["state_rate_hz"] = 100.0
    vehicle["controller"] |= controller
    data = read_toml(find("eight", "flights")) | {"vehicle": vehicle, "statistics_from_s": 10.0}
    return embedded(build_flight(data, "tracking"), speed)


def flown(speed: float, controller: Mapping[str, Any], scale: float = 1.0) -> dict[str, float] | None:
    """Errors [m] of a flight; None: it diverges."""
    configured = flight(speed, controller)
    real = simulated_vehicle(configured)
    real = replace(real, rotor_thrust_max_n=scale * real.rotor_thrust_max_n)
    try:
        trace = fly_sampled(
            *(configured, of_flight(configured), kernels("auto")),
            duration_max_s=BEFORE_S + COUNTED_S / min(speed, 2.0) + 8.0,
            real=real,
        )
    except RefusedError:
        return None
    summary = trace.summary
    keys = ("position_rms_m", "position_max_m", "vertical_rms_m", "heading_rms_rad")
    if any(summary[key] is None for key in keys):
        return None
    return {key: float(summary[key]) for key in keys}


def told(found: dict[str, float] | None) -> str:
    """One cell: horizontal and vertical together, largest, heading."""
    if found is None or found["position_max_m"] > LOST_M:
        return "lost"
    rms, most, heading = found["position_rms_m"], found["position_max_m"], found["heading_rms_rad"]
    return f"{1e3 * rms:.1f} / {1e3 * most:.0f} mm, {1e3 * heading:.0f} mrad"


def main(arguments: list[str]) -> int:
    table = {name: {f"{speed:g}": flown(speed, switches) for speed in SPEEDS} for name, switches in SWITCHES.items()}
    scales = {
        f"{scale:g} times the thrust, {'followed' if on else 'not followed'}": {
            f"{speed:g}": flown(speed, {"thrust_scale_estimate": on}, scale) for speed in SPEEDS
        }
        for scale in SCALES
        for on in (False, True)
    }
    if "--json" in arguments:
        print(json.dumps({"switches": table, "thrust_scale": scales}, indent=2))
        return 0
    for title, rows in (("known dynamics", table), ("thrust scale", scales)):
        print(f"| {title} | " + " | ".join(f"{speed:g} x" for speed in SPEEDS) + " |")
        print("|---" * (1 + len(SPEEDS)) + "|")
        for name, cells in rows.items():
            print(f"| {name} | " + " | ".join(told(cell) for cell in cells.values()) + " |")
        print()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
