"""Twenty bundled vehicles in one process and twenty companions, every one a control process with its recorder, at real
time: how many of their steps are late."""

from __future__ import annotations

import json
import os
import subprocess
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from companion.accelerate import available
from companion.cli.common import adjustments
from companion.config import build_flight, find
from companion.flight.launch import control, prepare
from companion.record.flight_record import FlightRecord
from companion.trajectory.load import embedded

from .common import PYTHON, NotHereError, Row, Setting, running, verdict

COUNT, RATE_HZ = 20, 100.0
FIRST_PORT = 27540
APART_S = 6.0
"""Between the starts of two companions."""
REACH = "late steps <= 1 %"
TRAJECTORY = """shape = "circle"
anchor = "here"
duration_s = {seconds}

[circle]
radius_m = 1.0
angular_rate_rad_s = 0.5
phase_deg = 0.0
"""


class Fleet(NamedTuple):
    """How twenty flights went while all of them flew."""

    flying: int
    refused: str
    """What one said whose own gates did not let it fly: the machine does not carry so many."""
    steps: int
    late: int
    skipped: int
    """States that a newer one overtook before they were answered."""
    window_s: float
    vehicles_share: float
    """Of a core, that the vehicles' process took while all of them flew."""
    step_us: tuple[float, float]


def fly(seconds: float, setting: Setting) -> Fleet:
    """Flies them; counts over the time in which all of them are in the air on their controllers."""
    vehicle_file = setting.folder / "vehicle-100-hz.toml"
    text = find("bundled", "vehicles").read_text(encoding="utf-8")
    vehicle_file.write_text(text.replace("state_rate_hz = 250.0", f"state_rate_hz = {RATE_HZ}"), encoding="utf-8")
    trajectory = setting.folder / "small-circle.toml"
    trajectory.write_text(TRAJECTORY.format(seconds=seconds + COUNT * APART_S), encoding="utf-8")
    flight = {"name": "fleet", "vehicle": str(vehicle_file), "trajectory": str(trajectory)}
    configured = embedded(build_flight(flight, "tools/bench.py", adjustments()), None)
    folders = [prepare(configured, setting.folder / f"fleet-{i}-{time.monotonic_ns()}") for i in range(COUNT)]
    command = [
        PYTHON,
        "-m",
        "sim_link",
        "run",
        "--vehicle",
        str(vehicle_file),
        "--count",
        str(COUNT),
        "--spacing",
        "10",
    ]
    command += ["--start", "0,0,-20", "--port", "0", "--remote-port", str(FIRST_PORT), "--no-ground"]
    command += ["--no-truth-stream", "--json-ready", "--with-parent"]
    engine = "numba" if available() else "python"
    threads = []
    lines: list[list[Mapping[str, object]]] = [[] for _ in folders]
    with running(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        if not json.loads(process.stdout.readline() or "{}").get("ready"):
            raise NotHereError("the vehicles did not start")
        # One after the other: twenty programs that start, and twenty courses that are planned, are no measure of
        # twenty that fly.
        for i, folder in enumerate(folders):
            arguments = (folder, f"udpin:127.0.0.1:{FIRST_PORT + i}", engine, 120.0, lines[i].append)
            threads.append(threading.Thread(target=control, args=arguments, daemon=True))
            threads[-1].start()
            time.sleep(APART_S)
        setting.say("all companions are started")
        begin_s, begin_cpu_s = time.monotonic(), _cpu_s(process.pid)
        time.sleep(0.5 * seconds)
        share = (_cpu_s(process.pid) - begin_cpu_s) / (time.monotonic() - begin_s)
        for thread in threads:
            thread.join(timeout=240.0)
    short = [told[-2:] for folder, told in zip(folders, lines, strict=True) if not _steps(folder)]
    said = next((str(told["outcome"]) for told in short[0] if "outcome" in told), "nothing") if short else ""
    return _counted([folder for folder in folders if _steps(folder)], said, share)


def _steps(folder: Path) -> int:
    return len(FlightRecord.load(folder)) if (folder / "record.npz").exists() else 0


def _cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / float(os.sysconf("SC_CLK_TCK"))


def _counted(folders: list[Path], refused: str, share: float) -> Fleet:
    records = [FlightRecord.load(folder) for folder in folders]
    if not records:
        return Fleet(0, refused, 0, 0, 0, 0.0, share, (0.0, 0.0))
    # All vehicles live in one process and began together: their time is the same.
    times = [record.column("t_s") for record in records]
    begin_s, end_s = max(t[0] for t in times), min(t[-1] for t in times)
    masks = [(t >= begin_s) & (t <= end_s) for t in times]
    both = list(zip(records, masks, strict=True))
    late = sum(int((r.column("late")[m] > 0.0).sum()) for r, m in both)
    skipped = sum(int(r.column("skipped")[m].sum()) for r, m in both)
    step_us = np.concatenate([r.column("step_us")[m] for r, m in both])
    p50, p99 = (float(np.percentile(step_us, p)) for p in (50, 99)) if len(step_us) else (0.0, 0.0)
    return Fleet(len(records), refused, len(step_us), late, skipped, end_s - begin_s, share, (p50, p99))


def rows(setting: Setting) -> list[Row]:
    """The fleet row."""
    setting.say(f"fleet: {COUNT} vehicles, {COUNT} companions")
    what = f"{COUNT} bundled vehicles + {COUNT} companions, {RATE_HZ:.0f} Hz"
    fleet = fly(25.0 if setting.quick else 60.0, setting)
    if fleet.steps == 0:
        seen = f"there was no time in which they flew together; one said: {fleet.refused}"
        return [Row(what, "real time", REACH, seen, verdict(False))]
    bad = (fleet.late + fleet.skipped) / (fleet.steps + fleet.skipped)
    share = f"{100 * fleet.late / fleet.steps:.2f} % of {fleet.steps} late, {fleet.skipped} states overtaken"
    if fleet.refused:
        share = f"{COUNT - fleet.flying} did not fly, one said: {fleet.refused}; of the {fleet.flying} others {share}"
    row = Row(
        what,
        "real time",
        REACH,
        f"{share} in {fleet.window_s:.0f} s",
        verdict(bad <= 0.01 and not fleet.refused),
    )
    row.notes.append(
        f"Fleet: the vehicles' process took {100 * fleet.vehicles_share:.0f} % of a core; control step p50 / p99"
        f" {fleet.step_us[0]:.0f} / {fleet.step_us[1]:.0f} us. Late: the setpoint went out more than 20 % of the state"
        " period after the state's arrival. States that were overtaken count against the reach."
    )
    return [row]
