"""Measures the figures that the project promises, in one run, and prints a table, each row when it is measured.

    python tools/figures.py [--quick] [--only GROUP ...] [--out FOLDER]

Flights go over UDP in lockstep on the bundled vehicle. Speed is vehicle time over wall time between the first and the
last state of a flight's traffic log. Step times are medians over calls of the control step as the loop makes them. The
machine should be otherwise idle.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import random
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pymavlink.dialects.v20 import common as mavlink2

from companion import accelerate
from companion.config import load_flight
from companion.control.types import State
from companion.flight.course import Course, Timed
from companion.flight.engines import kernels
from companion.flight.tracker import Tracker
from companion.ground.exchange import OWN_COMPONENT, OWN_SYSTEM
from companion.ground.ftp import crc32
from companion.ground.upload import Files
from companion.link import codec
from companion.link.framing import Frame
from companion.link.wire import Wire
from companion.record.columns import COLUMNS
from companion.record.flight_record import FlightRecord
from companion.record.flight_source import FlightSource
from companion.record.recorder import Recorder
from companion.record.report import build_report
from companion.record.summary import FlightMeta, summarise, without_wall_clock
from companion.record.tlog import Direction, read_tlog
from companion.trajectory.anchored import Trajectory, anchored
from companion.trajectory.feasibility import check
from companion.trajectory.load import load
from companion.trajectory.waypoints import Waypoint, plan, plan_limits

Row = tuple[str, str, str]
"""What is measured, what it should be, what was seen."""


def demo(folder: Path, *options: str) -> dict[str, Any]:
    """Flies `companion demo` with these options and returns its summary."""
    command = [sys.executable, "-m", "companion", "demo", "--json", "--out", str(folder), *options]
    done = subprocess.run(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, timeout=300, check=False
    )
    if not done.stdout:
        raise SystemExit(f"{' '.join(command)} ended with {done.returncode}")
    summary: dict[str, Any] = json.loads(done.stdout)
    return summary


def speed(folder: Path) -> float:
    """Vehicle time over wall time from the first to the last state in the traffic log."""
    first: tuple[float, float] | None = None
    last = (0.0, 0.0)
    for logged in read_tlog(folder / "link.tlog"):
        raw = logged.raw
        if raw[0] == 0xFD and int.from_bytes(raw[7:10], "little") == codec.ODOMETRY:
            t_vehicle_s = int.from_bytes(raw[10:18], "little") * 1e-6
            last = (t_vehicle_s, logged.epoch_us * 1e-6)
            first = first or last
    assert first is not None
    return (last[0] - first[0]) / (last[1] - first[1])


def flights(base: Path, quick: bool) -> Iterator[Row]:
    """Accuracy: every row is a flight."""
    cases: list[tuple[str, float, tuple[str, ...]]] = [
        ("demo, state age 20 ms", 0.01, ()),
        ("demo, state age 30 ms", 0.03, ("--state-age", "0.03")),
        ("demo, state age 40 ms", 0.03, ("--state-age", "0.04")),
        ("demo, attitude output", 0.05, ("--output", "attitude")),
        ("demo, actuator output, PX4 1.13", 0.03, ("--output", "actuators", "--px4", "1.13")),
        ("bundled vehicle (1 kg, D = 1 1/s), paper's path", 0.03, ("--flight", "eight")),
        ("the same, 2.5 times as fast", 0.03, ("--flight", "eight", "--time-scale", "2.5")),
    ]
    for i, (name, limit, options) in enumerate(cases[: 1 if quick else None]):
        s = demo(base / f"flight-{i}", *options)
        rms = s["position_rms_m"]
        yield f"{name}: position_rms_m", f"<= {limit:g}", "not settled" if rms is None else f"{rms:.4f}"
        if i == 0:
            truth = (1.0, 0.0, 0.4905)
            off = max(abs(a - b) for a, b in zip(s["disturbance_m_s2"], truth, strict=True)) / 1.114
            yield "  disturbance, off the truth by", "<= 3 %", f"{100 * off:.2f} %"
            yield "  body v_y once settled, rms", "<= 0.05 m/s", f"{s['body_sideways_rms_m_s']:.4f} m/s"


def wind(base: Path) -> Iterator[Row]:
    """The published test in wind, by the law, and by PX4's own position controller for comparison."""
    for speed_m_s, limit in ((0.0, 0.050), (8.5, 0.077), (12.0, 0.123)):
        blows = f"{-speed_m_s:g},0,0" if speed_m_s else "0,0,0"
        by_law = f"figure of eight in {speed_m_s:g} m/s of wind"
        for controller, name, reach in (("law", by_law, f"<= {limit:g}"), ("px4", "  the same by PX4 itself", "")):
            folder = base / f"wind-{speed_m_s:g}-{controller}"
            s = demo(folder, "--flight", "windtest", "--wind", blows, "--controller", controller)
            rms, tilt = s["position_rms_m"], s["tilt_max_rad"]
            yield f"{name}: position_rms_m", reach, f"{rms:.4f} (tilt to {tilt:.2f} rad)"


def speeds(base: Path, repeats: int) -> Iterator[Row]:
    """Lockstep flights with either engine, in turn; and the same seed twice."""
    engines = ["python", *(["numba"] if accelerate.available() else [])]
    found: dict[str, list[float]] = {engine: [] for engine in engines}
    summaries = []
    for i in range(repeats):
        for engine in engines:
            folder = base / f"speed-{engine}-{i}"
            summary = demo(folder, "--engine", engine)
            found[engine].append(speed(folder))
            if engine == "python":
                summaries.append(without_wall_clock({k: v for k, v in summary.items() if k != "folder"}))
    for engine, reach in (("python", 10), ("numba", 20)):
        if engine in found:
            values = found[engine]
            text = f"{statistics.median(values):.1f} (of {len(values)}: {min(values):.1f} to {max(values):.1f})"
            yield f"lockstep at 250 Hz, times real time, {engine}", f">= {reach}", text
    if len(summaries) > 1:
        same = all(s == summaries[0] for s in summaries)
        yield "same seed, same summary", "identical", "identical" if same else "DIFFERENT"


def median_us(call: Callable[[int], object], count: int = 4000) -> float:
    """The median duration of a call [us]."""
    for i in range(200):
        call(i)
    times = []
    for i in range(count):
        begin = time.perf_counter_ns()
        call(200 + i)
        times.append(time.perf_counter_ns() - begin)
    return statistics.median(times) * 1e-3


def steps() -> Iterator[Row]:
    """The control step: the law with its prediction, and the whole step with reference and conversion around it."""
    vehicle = load_flight("paper").vehicle
    course = Course(load("paper"), vehicle, (0.0, 0.0, -10.0), 0.0, None)
    reference_at = Timed(course, 0.0)
    state = State((0.1, 0.2, -9.9), (0.1, 1.0, 0.0), (0.99, 0.05, -0.05, 0.1), (0.1, 0.0, 0.1))
    for engine, reach in (("python", 40), ("numba", 5)):
        if engine == "numba" and not accelerate.available():
            continue
        tracker = Tracker(vehicle, "rates", kernels(engine))
        tracker.begin(state)
        whole = median_us(lambda i, t=tracker: t.step(1.0 + 0.004 * i, state, reference_at))  # type: ignore[misc]
        reference, pieces = course.at(1.0), tracker._prediction.pieces(1.0 + 0.004 * 4300)
        arithmetic = tracker._engine

        def law_step(_: int, a: Any = arithmetic, r: Any = reference, p: Any = pieces) -> object:
            return a.step(state, r, 46.0, p, False, True, 0.004)

        law = median_us(law_step)
        yield f"control step with prediction, median, {engine}", f"< {reach} us", f"{law:.1f} us"
        yield "  with reference, history and conversion", "", f"{whole:.1f} us"


def machine() -> Iterator[Row]:
    """What times below can be put in relation to: pymavlink's parse of one ODOMETRY, and a loop of plain arithmetic."""
    library = codec.dialect()
    message = library.MAVLink_odometry_message(
        *(1, 1, 1, 1.0, 2.0, 3.0, [1.0, 0.0, 0.0, 0.0], 0.1, 0.2, 0.3, 0.01, 0.02, 0.03, [0.0] * 21, [0.0] * 21)
    )
    frame = message.pack(library.MAVLink(None, srcSystem=1, srcComponent=1))
    parser = library.MAVLink(None)

    def arithmetic(_: int) -> float:
        x = 0.0
        for i in range(100):
            x = 0.5 * x + i
        return x

    parsed = f"{median_us(lambda i: parser.parse_buffer(frame)):.1f} us"
    yield "this machine: pymavlink parses one ODOMETRY, median", "", parsed
    yield "this machine: 100 rounds of x = 0.5 x + i, median", "", f"{median_us(arithmetic):.1f} us"


def planning(repeats: int) -> Iterator[Row]:
    """A path through 500 waypoints, planned with its times and checked as before a flight."""
    vehicle = load_flight("eight").vehicle
    limits = plan_limits(vehicle, wind_m_s=1.0)
    rng = random.Random(1)
    at = [0.0, 0.0, -20.0]
    waypoints = []
    for _ in range(500):
        at = [x + rng.gauss(0.0, size) for x, size in zip(at, (6.0, 6.0, 1.5), strict=True)]
        waypoints.append(Waypoint((at[0], at[1], at[2])))
    planned, checked, violations = [], [], 0
    for _ in range(repeats):
        begin = time.perf_counter()
        shape = plan(waypoints, limits)
        middle = time.perf_counter()
        path = anchored(Trajectory(name="500", shape=shape, duration_s=shape.own_duration_s), (0.0, 0.0, 0.0), None)
        violations += len(check(path, limits.reference, limits.model))
        planned.append(middle - begin)
        checked.append(time.perf_counter() - middle)
    both = [a + b for a, b in zip(planned, checked, strict=True)]
    text = f"{statistics.median(both):.2f} s of {repeats} (plan alone {statistics.median(planned):.2f} s)"
    if violations:
        text += f", {violations} VIOLATIONS"
    yield "500 waypoints planned, timed and checked, median", "< 2 s", text


class Lossy:
    """A link that loses a share of what goes either way."""

    def __init__(self, wire: Wire, loss: float, seed: int) -> None:
        self._wire, self._loss, self._rng = wire, loss, random.Random(seed)

    def send(self, msgid: int, payload: bytes) -> bool:
        return self._rng.random() < self._loss or self._wire.send(msgid, payload)

    def receive(self, timeout_s: float) -> list[Frame]:
        return [frame for frame in self._wire.receive(timeout_s) if self._rng.random() >= self._loss]


def upload(port: int, content: bytes, loss: float, seed: int) -> tuple[float, bool]:
    """Brings 1 MB to a companion; returns the time until it had all of it [s], and whether it is what was sent."""
    arrived: list[float] = []
    with Wire.open(f"udpout:127.0.0.1:{port}", system_id=OWN_SYSTEM, component_id=OWN_COMPONENT) as wire:
        begin = time.perf_counter()
        files = Files(Lossy(wire, loss, seed))
        verdict = files.upload_bytes(
            content, "long.csv", progress=lambda there, _: arrived.append(time.perf_counter() - begin)
        )
    return arrived[-1], (verdict.size_bytes, verdict.crc32) == (len(content), crc32(content))


def transfers(base: Path, repeats: int) -> Iterator[Row]:
    """Uploads to `companion serve` over loopback; the file's check, which follows, is not counted."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ground,
    ):
        vehicle.bind(("127.0.0.1", 0))
        ground.bind(("127.0.0.1", 0))
        vehicle_port, port = int(vehicle.getsockname()[1]), int(ground.getsockname()[1])
    command = [sys.executable, "-m", "companion", "serve", "--vehicle", "paper", "--folder", str(base / "stored")]
    command += ["--connect", f"udpin:127.0.0.1:{vehicle_port}", "--ground", f"udpin:127.0.0.1:{port}"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=base)
    try:
        for loss, reach in ((0.0, "< 3 s, intact"), (0.1, "complete, intact")):
            taken, intact = [], True
            for i in range(repeats):
                content = random.Random(i).randbytes(500_000).hex().encode()
                time_s, same = upload(port, content, loss, i)
                taken.append(time_s)
                intact = intact and same
            text = f"{statistics.median(taken):.2f} s of {repeats}, {'intact' if intact else 'DAMAGED'}"
            yield f"1 MB uploaded over loopback, {100 * loss:.0f} % loss each way, median", reach, text
    finally:
        process.terminate()
        process.wait(timeout=20)


def recording(base: Path) -> Iterator[Row]:
    """What recording costs a control step (the datagrams to the recorder, the row to the record and to the recorder),
    and what an hour of flight leaves in memory."""
    row = np.random.default_rng(1).normal(size=len(COLUMNS))
    link = mavlink2.MAVLink(None, srcSystem=1, srcComponent=1)
    none = [0.0] * 21

    def state(t_us: int) -> bytes:
        return bytes(
            mavlink2.MAVLink_odometry_message(t_us, 1, 1, *[0.0] * 3, [1, 0, 0, 0], *[0.0] * 6, none, none).pack(link)
        )

    folder = base / "recording"
    folder.mkdir(parents=True)
    recorder = Recorder.start(folder)
    record = FlightRecord(10_000)
    record.sink = recorder.offer_row
    raw, numbers, offer = state(1_000_000), tuple(row.tolist()), recorder.offer

    def one_step(_: int) -> None:
        offer(0, raw, time.monotonic_ns())
        offer(3, raw, time.monotonic_ns())
        record.append(numbers)

    parser = codec.dialect().MAVLink(None)
    parse = median_us(lambda _: parser.parse_buffer(raw))
    cost, nothing = median_us(one_step), median_us(lambda _: None)
    recorder.close()
    taken = f"{cost - nothing:.2f} us, {(cost - nothing) / parse:.2f} of the parse of one ODOMETRY"
    yield "recording: state, setpoint and row of a step, median", "< 5 us", taken
    before, after = _an_hour(base / "hour", state, row)
    growth = [(b - a) / 1024.0 for a, b in zip(before, after, strict=True)]
    text = f"{growth[0]:+.1f} MB / {growth[1]:+.1f} MB"
    yield "memory after an hour of flight, control side / recorder", "< 10 MB more", text


def _an_hour(folder: Path, state: Callable[[int], bytes], row: Any) -> tuple[list[int], list[int]]:
    """Resident memory [kB] of this process and the recorder's after two minutes, when all of the ring was used, and
    after an hour of steps at 250 Hz, handed over as fast as the recorder takes them."""
    folder.mkdir(parents=True)
    recorder = Recorder.start(folder)
    link = mavlink2.MAVLink(None, srcSystem=1, srcComponent=1)
    recorder.offer(Direction.IN, mavlink2.MAVLink_heartbeat_message(2, 12, 81, 0, 4, 3).pack(link), 1)
    raw = state(1_000_000)
    found = []
    for index in range(3600 * 250 + 1):
        row[0] = 1.0 + 0.004 * index
        if index % 25 == 0:  # the vehicle's time goes on
            raw = state(1_000_000 + 4000 * index)
        recorder.offer(Direction.IN, raw, index)
        recorder.offer_row(row.tobytes())
        if index % 50 == 0:
            while recorder.behind > 400:
                time.sleep(0.01)
        if index in {120 * 250, 3600 * 250}:
            while recorder.behind:
                time.sleep(0.1)
            time.sleep(2.0)  # for the disk
            found.append([_resident_kb(os.getpid()), _resident_kb(recorder.pid)])
    recorder.close(120.0)
    if recorder.dropped:
        print(f"an hour of flight: {recorder.problem}", file=sys.stderr)
    (folder / "flight.ulg").unlink()
    (folder / "link.tlog").unlink()
    return found[0], found[1]


def _resident_kb(pid: int) -> int:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("VmRSS")).split()[1])


def opening(base: Path) -> Iterator[Row]:
    """How long a report of ten minutes takes to open in a real browser."""
    for tests in ("unit", "programs"):
        sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / tests))
    from chromium import Chromium, installed
    from record_cases import PHASES, synthetic_flight

    program = installed()
    if program is None:
        yield "report of a 10-minute flight, opened in chromium", "< 3 s", "chromium is not installed"
        return
    record = synthetic_flight(600.0)
    folder = base / "long"
    folder.mkdir(parents=True)
    page = build_report(FlightSource(folder, record, summarise(record, PHASES, FlightMeta("paper", "quad")), {}, ""))
    with Chromium(program) as browser:
        browser.size(1200, 900)
        seen = sorted(browser.open(page) for _ in range(3))
    size = f"{page.stat().st_size / 1e6:.1f} MB"
    yield "report of a 10-minute flight, opened in chromium", "< 3 s, < 8 MB", f"{seen[1]:.2f} s, {size}"


def steps_here() -> Iterator[Row]:
    """The control step, with what the machine was like then."""
    yield from steps()
    yield next(machine())


class Group(NamedTuple):
    """Figures that are measured together."""

    about_s: tuple[int, int]
    """How long it takes, roughly, with --quick and without [s]: on two cores on which a demo takes 8 s."""
    measure: Callable[[], Iterator[Row]]


def groups(base: Path, quick: bool) -> dict[str, Group]:
    """What can be measured, in the order in which it is."""
    return {
        "machine": Group((1, 1), machine),
        "steps": Group((5, 5), steps_here),
        "planning": Group((3, 10), lambda: planning(2 if quick else 7)),
        "transfers": Group((5, 15), lambda: transfers(base, 1 if quick else 5)),
        "speeds": Group((20, 60), lambda: speeds(base, 1 if quick else 3)),
        "flights": Group((10, 60), lambda: flights(base, quick)),
        "wind": Group((0, 60), lambda: iter(()) if quick else wind(base)),
        "recording": Group((90, 90), lambda: recording(base)),
        "opening": Group((15, 15), lambda: opening(base)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one flight per kind")
    parser.add_argument("--only", nargs="+", choices=groups(Path(), True), metavar="GROUP", help="%(choices)s")
    parser.add_argument("--out", type=Path, help="keep the flight folders here")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        base = arguments.out or Path(temporary)
        base.mkdir(parents=True, exist_ok=True)
        measured = groups(base, arguments.quick)
        wanted = {name: measured[name] for name in arguments.only or measured}
        times = {name: group.about_s[0 if arguments.quick else 1] for name, group in wanted.items()}
        print(f"Python {platform.python_version()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
        print(
            f"takes about {sum(times.values()) / 60.0:.1f} min where a demo takes 8 s, longer where it takes longer\n"
        )
        print("| figure | reach | seen |\n|---|---|---|", flush=True)
        for name, group in wanted.items():
            begin = time.monotonic()
            print(f"{name}: about {times[name]} s ...", file=sys.stderr, flush=True)
            for row in group.measure():
                print(f"| {' | '.join(row)} |", flush=True)
            print(f"{name}: {time.monotonic() - begin:.0f} s", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
