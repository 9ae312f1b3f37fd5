"""RotorPy's controller and vehicle, in a process with RotorPy's own Python; needs nothing of ours.

Reads lines "controller N", "vehicle N" or "loop N" and answers each with a JSON list: the durations of N calls of
`SE3Control.update` or of `Multirotor.step` [us], or [seconds] that N steps of both together at 100 Hz took.
"""

import json
import sys
import time

import numpy as np
from rotorpy.controllers.quadrotor_control import SE3Control
from rotorpy.vehicles.crazyflie_params import quad_params
from rotorpy.vehicles.multirotor import Multirotor

STEP_S = 0.01
HOVER = {"x": np.array([0.1, 0.2, 0.9]), "v": np.array([0.1, 0.5, 0.0]), "q": np.array([0.05, -0.05, 0.1, 0.99])}
HOVER |= {"w": np.array([0.1, 0.0, 0.1]), "wind": np.zeros(3), "rotor_speeds": np.full(4, 1788.53)}


def wanted(t):
    """A circle of 1 m radius."""
    c, s = np.cos(t), np.sin(t)
    names = ("x", "x_dot", "x_ddot", "x_dddot", "x_ddddot")
    vectors = ([c, s, 1.0], [-s, c, 0.0], [-c, -s, 0.0], [s, -c, 0.0], [c, s, 0.0])
    return {
        **{n: np.array(v) for n, v in zip(names, vectors, strict=True)},
        "yaw": 0.0,
        "yaw_dot": 0.0,
        "yaw_ddot": 0.0,
    }


def main():
    controller, vehicle = SE3Control(quad_params), Multirotor(quad_params)
    flat = wanted(0.0)
    control = controller.update(0.0, HOVER, flat)

    def timed(call, count):
        times = []
        for _ in range(count):
            begin = time.perf_counter_ns()
            call()
            times.append((time.perf_counter_ns() - begin) * 1e-3)
        return times

    def loop(count):
        begin, state = time.perf_counter(), dict(HOVER)
        for i in range(count):
            state = vehicle.step(state, controller.update(i * STEP_S, state, wanted(i * STEP_S)), STEP_S)
        return [time.perf_counter() - begin]

    kinds = {
        "controller": lambda n: timed(lambda: controller.update(0.0, HOVER, flat), n),
        "vehicle": lambda n: timed(lambda: vehicle.step(HOVER, control, STEP_S), n),
        "loop": loop,
    }
    print(json.dumps("ready"), flush=True)
    for line in sys.stdin:
        kind, count = line.split()
        print(json.dumps(kinds[kind](int(count))), flush=True)


if __name__ == "__main__":
    main()
