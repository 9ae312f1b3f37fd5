"""What a starved companion flies: body rates and attitude setpoints, with the vehicle file's gains and with lower ones.

    python tools/starved.py                 the table of docs/tracking.md: both vehicles, about five minutes
    python tools/starved.py --vehicle bundled --speeds 1 --seeds 2 --json

The very controller that flies and its guards against the bundled physics, on vehicle time (`campaign.starved`): the
same on any machine. Steps 30 % late, 40 to 60 of them a second instead of 100, and gaps of 100 to 400 ms every five
seconds on average; COM_OF_LOSS_T is 1 s, so that only gaps above 0.5 s would end a flight. Errors are of the figure of
eight from 12 s on, as if nobody watched; "handed over" counts the flights that the guards would have ended, and how far
off the worst was then.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from typing import Any

from companion.campaign.starved import Starvation, Starved, fly_starved
from companion.config import Flight, build_flight, find, read_toml
from companion.flight.adaptation import slower
from companion.flight.engines import kernels
from companion.trajectory.load import embedded, of_flight

STARVATIONS = {
    "well fed": Starvation((1e4, 1e4), 0.0, gap_every_s=0.0),
    "40 to 60 Hz": Starvation(late_share=0.0, gap_every_s=0.0),
    "and 30 % late": Starvation(gap_every_s=0.0),
    "and gaps": Starvation(loss_s=1.0),
}
WAYS = tuple((output, share) for output in ("rates", "attitude") for share in (1.0, 0.7, 0.5))
FROM_S, UNTIL_S = 12.0, 45.0
STATE_RATE_HZ = 100.0


def flight(vehicle: str, speed: float, output: str, share: float) -> Flight:
    """The figure of eight, so many times as fast, with a share of the gains."""
    table = read_toml(find(vehicle, "vehicles"))
    table["link"]["state_rate_hz"] = STATE_RATE_HZ
    data = read_toml(find("eight", "flights")) | {"vehicle": table, "output": {"kind": output}}
    made = embedded(build_flight(data, "starved"), speed)
    return made if share == 1.0 else made.model_copy(update={"vehicle": slower(made.vehicle, share)})


def flown(made: Flight, how: Starvation, seeds: int) -> list[Starved]:
    """The same flight under some draws of the starvation."""
    compiled, path = kernels("auto"), of_flight(made)
    return [
        fly_starved(made, path, compiled, how, duration_max_s=UNTIL_S, from_s=FROM_S, seed=1 + i) for i in range(seeds)
    ]


def cell(flights: list[Starved]) -> dict[str, Any]:
    """What is told of some flights."""
    ended = [one for one in flights if one.handed_over_s is not None]
    rms = sorted(one.rms_m for one in flights if not math.isnan(one.rms_m))
    return {
        "rms_median_m": rms[len(rms) // 2] if rms else None,
        "max_m": max(one.max_m for one in flights),
        "lost": sum(math.isnan(one.rms_m) for one in flights),
        "flights": len(flights),
        "handed_over": len(ended),
        "error_then_max_m": max((one.error_then_m for one in ended), default=None),
        "why": ended[0].why if ended else "",
    }


def told(found: dict[str, Any]) -> str:
    """One cell of the table."""
    if found["lost"]:
        text = f"{found['lost']} of {found['flights']} lost"
    else:
        text = f"{1e3 * found['rms_median_m']:.0f} / {1e3 * found['max_m']:.0f} mm"
    if found["handed_over"]:
        text += f"; {found['handed_over']} handed over, {1e3 * found['error_then_max_m']:.0f} mm off"
    return text


def main() -> int:
    """Prints a table for each vehicle and speed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n", maxsplit=1)[0])
    parser.add_argument("--vehicle", nargs="+", default=["bundled", "px4_sih"])
    parser.add_argument("--speeds", nargs="+", type=float, default=[1.0, 2.5])
    parser.add_argument("--seeds", type=int, default=5, help="flights per cell")
    parser.add_argument("--json", action="store_true", help="print one JSON document instead")
    options = parser.parse_args()
    document: dict[str, Any] = {}
    for vehicle in options.vehicle:
        for speed in options.speeds:
            table = document[f"{vehicle} at {speed:g} x"] = {}
            if not options.json:
                print(f"| {vehicle}, {speed:g} x | " + " | ".join(STARVATIONS) + " |")
                print("|---" * (1 + len(STARVATIONS)) + "|")
            for output, share in WAYS:
                made = flight(vehicle, speed, output, share)
                row = {
                    name: cell(flown(made, how, 1 if name == "well fed" else options.seeds))
                    for name, how in STARVATIONS.items()
                }
                table[f"{output}, {share:.0%} of the gains"] = row
                if not options.json:
                    cells = " | ".join(map(told, row.values()))
                    print(f"| {output}, {share:.0%} of the gains | {cells} |", flush=True)
            if not options.json:
                print()
    if options.json:
        print(json.dumps(document, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
