"""How many simulated seconds per second one core flies in a closed loop without sockets, and what RotorPy does.

    python tools/closed_loop.py --rotorpy /path/to/a/python/that/has/rotorpy

Ours: the bundled vehicle at 1 kHz physics and inner loops, 4 ms control, noise; one compiled loop, and everything
that a campaign does for a flight besides. RotorPy: its vehicle and its SE3Control at 100 Hz. Both take turns; the
median of the processor time counts: it bears other work on the machine. `measure` is for tools/bench.py.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import time
from typing import Any

ROTORPY = """
import sys, time
import numpy as np
from rotorpy.vehicles.multirotor import Multirotor
from rotorpy.vehicles.crazyflie_params import quad_params
from rotorpy.controllers.quadrotor_control import SE3Control
from rotorpy.trajectories.circular_traj import ThreeDCircularTraj

seconds = float(sys.argv[1])
vehicle, control = Multirotor(quad_params), SE3Control(quad_params)
path = ThreeDCircularTraj(center=np.array([0, 0, 0]), radius=np.array([1, 1, 0]), freq=np.array([0.1, 0.1, 0]))
hover = 1788.53
state = {"x": np.array([1.0, 0, 0]), "v": np.zeros(3), "q": np.array([0, 0, 0, 1.0]), "w": np.zeros(3),
         "wind": np.zeros(3), "rotor_speeds": np.full(4, hover)}
count = int(100 * seconds)
begin = time.process_time()
for i in range(count):
    state = vehicle.step(state, control.update(0.01 * i, state, path.update(0.01 * i)), 0.01)
print(count * 0.01 / (time.process_time() - begin))
"""


def fly(seconds: float, hz: float = 1000.0) -> float:
    """Simulated seconds per second of processor time of one flight, the campaign's bookkeeping included."""
    from companion.campaign.outcome import measured
    from companion.campaign.study import load_study
    from companion.campaign.whole import Case
    from companion.campaign.whole import fly as fly_case

    study = load_study("robustness", {"duration_s": seconds})
    case = study.case(0)
    quick = case.flight.vehicle.autopilot.model_copy(update={"loop_rate_hz": hz})
    vehicle = case.flight.vehicle.model_copy(update={"autopilot": quick})
    still = case.flight.world.model_copy(update={"wind_m_s": (0.0, 0.0, 0.0), "turbulence": 0.0})
    flight = case.flight.model_copy(update={"vehicle": vehicle, "world": still})
    case = Case(flight, vehicle, case.trajectory, ground=False, duration_s=seconds)
    begin = time.process_time()
    flown = fly_case(case, "numba")
    measured(study, 0, case, flown, True)
    return float(flown.time_s[-1]) / (time.process_time() - begin)


def measure(rotorpy: str | None = None, rounds: int = 7, seconds: float = 60.0) -> dict[str, Any]:
    """Medians of simulated seconds per second, ours and RotorPy's, interleaved.

    Args:
        rotorpy: a Python that has RotorPy; None: only ours.
        rounds: how often.
        seconds: length of our flights; RotorPy's are a twentieth.
    """
    fly(2.0)  # compiles, or loads what was compiled
    ours, theirs = [], []
    for _ in range(rounds):
        ours.append(fly(seconds))
        if rotorpy is not None:
            command = [rotorpy, "-c", ROTORPY, str(seconds / 20.0)]
            done = subprocess.run(command, check=True, capture_output=True, text=True)
            theirs.append(float(done.stdout.split()[-1]))
    found: dict[str, Any] = {"simulated_s_per_s": statistics.median(ours), "least": min(ours), "most": max(ours)}
    if theirs:
        found["rotorpy_simulated_s_per_s"] = statistics.median(theirs)
        found["ratio"] = statistics.median(a / b for a, b in zip(ours, theirs, strict=True))
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--rotorpy", metavar="PYTHON", help="a Python interpreter that has RotorPy")
    parser.add_argument("--rounds", type=int, default=7)
    options = parser.parse_args()
    for name, value in measure(options.rotorpy, options.rounds).items():
        print(f"{name:28s} {value:10.1f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
