"""The control step and the physics step against RotorPy's, in turn; how cost grows; instruction counts.

RotorPy runs in its own process, with its own Python (`--rotorpy-python`); both sides time their calls themselves.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import struct
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from companion import accelerate
from companion.campaign.simulate import fly_sampled, start_of
from companion.config import find, load_flight
from companion.control.types import State
from companion.flight.course import Course, Timed
from companion.flight.engines import kernels
from companion.flight.reflex import ANSWERED, Reflex
from companion.flight.tracker import Tracker
from companion.link import codec
from companion.link.framing import build_frame
from companion.link.telemetry import Telemetry
from companion.trajectory.load import load
from sim_link import vehicle_file
from sim_link.airframe import Airframe
from sim_link.inner_loops import RATES, Setpoint
from sim_link.wind import World

from .common import PYTHON, NotHereError, Row, Setting, median, module_environment, p50_p99, times_us, verdict

ROUNDS, CALLS = 15, 200
FLOWN_S = 1000.0
"""Longer than any figure takes: all steps are on the trajectory."""
MARGIN = 20
"""States that are still under way at the end of a simulation."""
SETTLED_S = 20.0
"""After which the paper's flight, begun 37 m away, is on its trajectory."""
HOW_TO_GET_ROTORPY = "RotorPy is not importable: install it somewhere and name that Python with --rotorpy-python"


class RotorPy:
    """RotorPy in its process."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process
        if self._answer() != "ready":
            raise NotHereError(HOW_TO_GET_ROTORPY)

    def _answer(self) -> object:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        return json.loads(line) if line else None

    def ask(self, kind: str, count: int) -> list[float]:
        """The durations of so many calls."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{kind} {count}\n")
        self._process.stdin.flush()
        answer = self._answer()
        if not isinstance(answer, list):
            raise NotHereError("RotorPy ended without an answer")
        return answer


@contextlib.contextmanager
def rotorpy(setting: Setting) -> Iterator[RotorPy]:
    """RotorPy, ready.

    Raises:
        NotHereError: it cannot be imported there.
    """
    worker = Path(__file__).with_name("rotorpy_worker.py")
    one_thread = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    try:
        process = subprocess.Popen(
            [setting.rotorpy_python, str(worker)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env={**os.environ, **one_thread},
        )
    except OSError as error:
        raise NotHereError(f"--rotorpy-python {setting.rotorpy_python}: {error.strerror}") from None
    try:
        yield RotorPy(process)
    finally:
        process.kill()
        process.communicate()


class Flown:
    """States of the paper's flight as it is simulated, with all limits, delays and noise, once it is on its trajectory.

    A controller that is given states of another one's flight does not close the loop and drifts away from it: it begins
    anew every CALLS states.

    Args:
        count: so many states, rounded up to whole CALLS; after them they come again.
        kept: a file in which another process keeps the states of as many; simulated anew without.
    """

    def __init__(self, count: int, kept: Path | None = None) -> None:
        self.count = count = CALLS * -(-count // CALLS)
        flight = load_flight("paper")
        self.vehicle = flight.vehicle
        start, yaw = start_of(flight)
        trajectory = replace(load("paper"), duration_s=FLOWN_S)
        self.course = Course(trajectory, self.vehicle, start, yaw, (0.0, 0.0, 0.0), flight.height_min_m)
        if kept is not None:
            told = json.loads(kept.read_text())
            self.states = [(t_s, State(*(tuple(vector) for vector in state))) for t_s, state in told]
            return
        most_s = SETTLED_S + (count + MARGIN) / self.vehicle.link.state_rate_hz
        rows = fly_sampled(flight, trajectory, kernels(engines()[-1]), duration_max_s=most_s).rows
        self.states = [(row.t_s, row.state) for row in rows if row.t_s >= SETTLED_S]

    def keep(self, file: Path) -> None:
        """Writes the states for another process."""
        file.write_text(json.dumps(self.states))

    def begin(self, tracker: Tracker, timed: Timed, i: int) -> tuple[int, State]:
        """Begins anew with a state; gives its stamp [us], and the state."""
        t_s, state = self.states[i]
        tracker.begin(state)
        tracker.command(t_s, state, timed)
        return round(1e6 * t_s), state


class Steps(NamedTuple):
    """Control steps through the states of a flight."""

    begin: Callable[[int], object]
    """Begins anew with the state of this index."""
    step: Callable[[int], object]
    """The step for the state behind the one of this index."""

    def times_us(self, count: int, of: int) -> list[float]:
        """How long each of so many steps takes [us], from the first one on, through `of` states over and over."""
        times: list[float] = []
        while len(times) < count:
            i = len(times) % of
            self.begin(i)
            times += times_us(self.step, min(CALLS, count - len(times)), i)
        return times


def control_steps(engine: str, flown: Flown) -> Steps:
    """The control step as the loop calls it: history, prediction, reference, law, conversion into a setpoint."""
    tracker, timed = Tracker(flown.vehicle, "rates", kernels(engine)), Timed(flown.course, 0.0)
    states, command = flown.states, tracker.command

    def step(i: int) -> object:
        t_s, state = states[i + 1]
        return command(t_s, state, timed)

    return Steps(lambda i: flown.begin(tracker, timed, i), step)


def reflex_steps(flown: Flown) -> Steps:
    """Answers by reflex: from a state's datagram to the setpoint's, checks and frames included; compiled."""
    tracker, telemetry = Tracker(flown.vehicle, "rates", kernels("numba")), Telemetry(1)
    reflex, timed = Reflex(1, (1, 191)), Timed(flown.course, 0.0)
    extra = codec.message_formats()[codec.ODOMETRY].crc_extra
    layout = struct.Struct("<Q13f168x4Bb")
    datagrams = []
    for i, (t_s, (p, v, q, w)) in enumerate(flown.states):
        payload = layout.pack(round(1e6 * t_s), *p, *q, *v, *w, 1, 1, 0, 8, 50)
        datagrams.append(build_frame(codec.ODOMETRY, payload, i & 0xFF, 1, 1, extra))

    def answer(i: int) -> bytes:
        last_us, before, seq = telemetry.last_t_vehicle_us, telemetry.numbers, (i + 1) & 0xFF
        assert last_us is not None and before is not None
        given = (seq, seq, 1, last_us, last_us, -1, 0, 500_000)
        if not reflex.take(datagrams[i + 1], given, before) or tracker.answer(reflex, timed) != ANSWERED:
            raise RuntimeError("not answered by reflex")
        state, numbers = reflex.told()
        telemetry.took(state.t_vehicle_us, numbers)
        tracker.answered(state.t_vehicle_us * 1e-6, State(*state[1:5]))
        return reflex.output.tobytes()

    return Steps(lambda i: telemetry.took(*flown.begin(tracker, timed, i)), answer)


def physics_steps(engine: str, count: int) -> Callable[[int], object]:
    """So many physics steps of the bundled vehicle with its inner loops, as the simulated vehicle runs them."""
    vehicle = vehicle_file.load(str(find("bundled", "vehicles")))
    airframe = Airframe(vehicle, World(force_n=(0.5, 0.0, 0.0)), seed=1, engine=engine, start=((0.0, 0.0, -10.0), 0.0))
    setpoint = Setpoint(RATES, 0.5, (0.01, 0.0, 0.02), (1.0, 0.0, 0.0, 0.0), 0.0, (0.0, 0.0, 0.0))
    return lambda _: airframe.advance(setpoint, True, count)


def engines() -> list[str]:
    return ["python", *(["numba"] if accelerate.available() else [])]


def control_rows(setting: Setting) -> list[Row]:
    """The control step against SE3Control.update."""
    flown = Flown(CALLS)  # few, so that they stay in the cache, where a state that has just come is
    steps = {engine: control_steps(engine, flown) for engine in engines()}
    if "numba" in steps:
        steps["reflex"] = reflex_steps(flown)
    ours: dict[str, list[float]] = {engine: [] for engine in steps}
    theirs: list[float] = []
    with rotorpy(setting) as other:
        other.ask("controller", 100)
        for i in range(3 if setting.quick else ROUNDS):
            setting.say(f"control step, round {i + 1}")
            theirs += other.ask("controller", CALLS)
            for engine, of in steps.items():
                # As long as the other's turn, roughly: 200 calls would be over before the processor is warm again.
                ours[engine] += of.times_us(CALLS * (5 if engine == "python" else 25), flown.count)
    a, b = p50_p99(theirs)
    rows = []
    for engine, reach in (("python", 10.0), ("numba", 80.0)):
        if engine not in ours:
            continue
        p50, p99 = p50_p99(ours[engine])
        seen = f"{p50:.1f} / {p99:.1f} us: {a / p50:.1f} / {b / p99:.1f} times faster"
        against = f"RotorPy SE3Control.update, p50 / p99 {a:.0f} / {b:.0f} us"
        what = f"control step as the loop calls it, {engine}"
        rows.append(Row(what, against, f">= {reach:.0f} times faster", seen, verdict(a / p50 >= reach)))
    if "reflex" in ours:
        p50, p99 = p50_p99(ours["reflex"])
        what = "state datagram to setpoint datagram by reflex, checks and frames included, numba"
        seen = f"{p50:.1f} / {p99:.1f} us: {a / p50:.1f} / {b / p99:.1f} times faster"
        rows.append(Row(what, against, "", seen, ""))
    return rows


def physics_rows(setting: Setting) -> list[Row]:
    """The physics step against Multirotor.step; ours come 20 at a time, as a state at 50 Hz asks for them."""
    per_call = 20
    theirs: list[float] = []
    calls = {engine: physics_steps(engine, per_call) for engine in engines()}
    for call in calls.values():
        times_us(call, 50)
    ours: dict[str, list[float]] = {engine: [] for engine in calls}
    with rotorpy(setting) as other:
        other.ask("vehicle", 20)
        for i in range(3 if setting.quick else ROUNDS):
            setting.say(f"physics step, round {i + 1}")
            theirs += other.ask("vehicle", CALLS // 2)
            for engine, call in calls.items():
                ours[engine] += [t / per_call for t in times_us(call, CALLS // 2)]
    a, b = p50_p99(theirs)
    rows = []
    for engine in calls:
        p50, p99 = p50_p99(ours[engine])
        reach = ">= 500 times faster" if engine == "numba" else ""
        rows.append(
            Row(
                f"physics step of the bundled vehicle with its inner loops, {engine}",
                f"RotorPy Multirotor.step, p50 / p99 {a:.0f} / {b:.0f} us",
                reach,
                f"{p50:.2f} / {p99:.2f} us: {a / p50:.0f} / {b / p99:.0f} times faster",
                verdict(a / p50 >= 500.0) if reach else "",
            )
        )
    rows[-1].notes.append("Physics: a call runs 20 steps of 2 ms, rotors, rate loop and drag among them.")
    return rows


def instruction_rows(setting: Setting) -> list[Row]:
    """Instructions per control step, counted by callgrind: they do not depend on what else the machine does.

    Callgrind shows the program a processor of its own, for which the compiled engine would be compiled anew, for many
    minutes there: both sides of it are told to be any processor, and the code is compiled outside.
    """
    if shutil.which("valgrind") is None:
        raise NotHereError("needs valgrind")
    rows = []
    kept = setting.folder / "states.json"
    Flown(CALLS).keep(kept)  # what is counted must be steps, and no simulation
    environment = {**module_environment(), "PYTHONHASHSEED": "0", "NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
    for engine in engines():
        counts = []
        steps_of = [PYTHON, "-m", "benchmarks.arithmetic", engine]
        subprocess.run([*steps_of, "1", str(kept)], env=environment, timeout=900, check=True)
        out = f"--callgrind-out-file={setting.folder / 'callgrind.out'}"
        for steps in (200, 700):
            setting.say(f"instructions of {steps} control steps, {engine}")
            command = ["valgrind", "--tool=callgrind", out, *steps_of, str(steps), str(kept)]
            done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=900, check=False)
            found = re.search(r"Collected : (\d+)", done.stderr)
            if found is None:
                raise NotHereError(f"callgrind counted nothing: {done.stderr.strip()[-200:]}")
            counts.append(int(found.group(1)))
        per_step = (counts[-1] - counts[-2]) / 500
        rows.append(Row(f"instructions per control step, {engine}", "", "", f"{per_step:,.0f}", ""))
    return rows


def growth_rows(setting: Setting) -> list[Row]:
    """Cost over the number of vehicles and over the time flown: a share of 1 is linear."""
    engine, rounds = engines()[-1], 60 if setting.quick else 400
    flown = Flown(40_000)
    per_vehicle, per_second = [], []
    for count in (1, 4, 16):
        setting.say(f"growth: {count} vehicles")
        calls = [physics_steps(engine, 4) for _ in range(count)]
        steps = [control_steps(engine, flown) for _ in range(count)]
        for of in steps:
            of.begin(0)
        for i in range(20):
            for call, of in zip(calls, steps, strict=True):
                call(i), of.step(i)
        one_round = times_us(
            lambda i, c=calls, s=steps: [(call(i), of.step(i)) for call, of in zip(c, s, strict=True)],  # type: ignore[misc]
            rounds,
            20,
        )
        per_vehicle.append(median(one_round) / count)
    times = control_steps(engine, flown).times_us(40_000, flown.count)
    for begin in range(0, 40_000, 10_000):
        per_second.append(median(times[begin : begin + 10_000]))
    vehicles = ", ".join(f"{x / per_vehicle[0]:.2f}" for x in per_vehicle)
    time_flown = ", ".join(f"{x / per_second[0]:.2f}" for x in per_second)
    return [
        Row("cost per vehicle and state: 1, 4, 16 vehicles in one process", "1 vehicle", "linear: 1", vehicles, ""),
        Row("cost per control step: 1st, 2nd, 3rd, 4th 10,000 of a flight", "the 1st", "linear: 1", time_flown, ""),
    ]


if __name__ == "__main__":
    import sys

    control_steps(sys.argv[1], Flown(CALLS, Path(sys.argv[3]))).times_us(int(sys.argv[2]), CALLS)
