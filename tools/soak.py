"""Flies for long, with mild faults, and looks for what grows: memory, descriptors, threads, the time of a step.

    python tools/soak.py --seconds 3600                # an hour of vehicle time in lockstep
    python tools/soak.py --seconds 600 --real-time     # ten minutes

The flight is `companion fly`'s: control process, recorder, and the simulated vehicle, each a process of its own. Every
second or so /proc tells what they hold. Growth is the median of the last quarter less that of the second one: the first
quarter is left out, in which buffers are filled and pages are touched for the first time. With --json one document.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any, NamedTuple

from companion.config import build_flight, find, read_toml
from companion.flight.bundled import BundledVehicle
from companion.flight.launch import control, prepare
from companion.record.flight_record import RECORD_FILE, FlightRecord

WHOLE = 0.9
"""Of the steps that a flight should have: with fewer it was none of that length."""
CONTROL, RECORDER = "companion.flight.process", "companion.record"
FAULTS = """description = "mild"
[[fault]]
kind = "loss"
share = 0.01
[[fault]]
kind = "duplicate"
share = 0.01
late_s = 0.012
[[fault]]
kind = "corrupt"
share = 0.005
[[fault]]
kind = "reorder"
share = 0.005
late_s = 0.015
"""
MEMORY_MAX_MB, COUNT_MAX, STEP_MAX = 2.0, 0.0, 1.25
"""What may grow: memory of a process [MB], descriptors and threads, and the step's time as a ratio."""


class Sample(NamedTuple):
    """What a process holds."""

    memory_mb: float
    """Resident and its own, or shared with a file (statm: resident)."""
    descriptors: int
    threads: int


def sample(pid: int) -> Sample | None:
    """What a process holds now; None: it is gone."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
        fields = dict(line.split(":", 1) for line in status.splitlines() if ":" in line)
        count = len(list(Path(f"/proc/{pid}/fd").iterdir()))
        return Sample(int(fields["RssAnon"].split()[0]) / 1024.0, count, int(fields["Threads"]))
    except (OSError, KeyError, ValueError):
        return None


def children(parent: int) -> dict[int, str]:
    """Process ids of children, and of theirs, with their command lines."""
    parents, words = {}, {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                stat = (folder / "stat").read_text().rpartition(")")[2].split()
                words[int(folder.name)] = (
                    (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
                )
                parents[int(folder.name)] = int(stat[1])
            except OSError:
                continue
    found: dict[int, str] = {}
    wanted = {parent}
    while wanted:
        below = {pid for pid, above in parents.items() if above in wanted and pid not in found}
        found.update({pid: words[pid] for pid in below})
        wanted = below
    return found


class Watcher(threading.Thread):
    """Samples the processes of a flight until it is over."""

    def __init__(self, own: int) -> None:
        super().__init__(daemon=True)
        self.samples: dict[str, list[Sample]] = {}
        self.over = threading.Event()
        self._own = own

    def run(self) -> None:
        """Looks once per second."""
        names: dict[int, str] = {}
        while not self.over.wait(1.0):
            for pid, words in children(self._own).items():
                if "sim_link" in words:
                    names.setdefault(pid, "vehicle")
                elif CONTROL in words and "control process" not in names.values():
                    names[pid] = "control process"
                else:
                    names.setdefault(pid, "recorder")
            for pid, name in names.items():
                seen = sample(pid)
                if seen is not None:
                    self.samples.setdefault(name, []).append(seen)


def quarters(values: list[float]) -> tuple[float, float]:
    """Medians of the second and the last quarter."""
    n = len(values) // 4
    return statistics.median(values[n : 2 * n]), statistics.median(values[-n:])


def soak(seconds: float, *, real_time: bool, rate_hz: float, engine: str, out: Path) -> dict[str, Any]:
    """Flies, and gives what grew."""
    vehicle = read_toml(find("bundled", "vehicles"))
    vehicle["link"]["state_rate_hz"] = rate_hz
    circle = {"radius_m": 2.0, "angular_rate_rad_s": 0.5, "phase_deg": 0.0}
    trajectory = {"name": "circle", "shape": "circle", "anchor": "here", "duration_s": seconds, "circle": circle}
    world = {"turbulence": 0.1, "wind_m_s": [1.0, 0.5, 0.0]}
    start = {"position_m": [0.0, 0.0, -10.0], "yaw_deg": 0.0}
    data = {"name": "soak", "vehicle": vehicle, "trajectory": trajectory, "world": world, "start": start}
    flight = build_flight(data, "soak")
    faults = out / "mild.toml"
    faults.write_text(FAULTS)
    begin_s = time.monotonic()
    shown = [0.0]

    def show(message: Any) -> None:
        progress = message.get("progress")
        if progress and time.monotonic() - shown[0] > 2.0:
            shown[0] = time.monotonic()
            print(f"\r{progress['t_s']:.0f} of {seconds:.0f} s flown ", end="", file=sys.stderr, flush=True)

    watcher = Watcher(os.getpid())
    folder = prepare(flight, out / "flight")
    with BundledVehicle(flight, folder, px4="1.18", engine=engine, lockstep=not real_time, faults=faults) as running:
        watcher.start()
        flown = control(folder, running.connection, engine, 15.0, show)
        watcher.over.set()
        watcher.join()
    print(file=sys.stderr)
    wall_s = time.monotonic() - begin_s
    record = FlightRecord.load(folder / RECORD_FILE)
    steps = [float(x) for x in record.column("step_us")]
    if len(steps) < WHOLE * seconds * rate_hz:
        raise SystemExit(f"soak: only {len(steps)} steps were flown, nothing can be said: {flown.sentence}")
    before, after = quarters(steps)
    found: dict[str, Any] = {
        **{"sentence": flown.sentence, "seconds": seconds, "real_time": real_time, "wall_s": round(wall_s, 1)},
        **{"steps": len(steps), "step_us": [round(before, 2), round(after, 2)], "step_ratio": round(after / before, 3)},
        "processes": {},
    }
    for name, samples in watcher.samples.items():
        if len(samples) >= 8:
            rows = {field: quarters([float(getattr(s, field)) for s in samples]) for field in Sample._fields}
            found["processes"][name] = {key: [round(x, 2) for x in pair] for key, pair in rows.items()}
    found["flat"] = flat(found)
    return found


def flat(found: dict[str, Any]) -> bool:
    """Whether nothing grew by more than it may."""
    for held in found["processes"].values():
        growth = {key: pair[1] - pair[0] for key, pair in held.items()}
        if growth["memory_mb"] > MEMORY_MAX_MB or max(growth["descriptors"], growth["threads"]) > COUNT_MAX:
            return False
    return bool(found["step_ratio"] <= STEP_MAX) and "control process" in found["processes"]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=3600.0, help="of the trajectory, vehicle time")
    parser.add_argument("--real-time", action="store_true")
    parser.add_argument("--rate", type=float, default=100.0, help="states per second")
    parser.add_argument("--engine", default="auto")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="soak-") as folder:
        found = soak(
            arguments.seconds,
            real_time=arguments.real_time,
            rate_hz=arguments.rate,
            engine=arguments.engine,
            out=Path(folder),
        )
    if arguments.json:
        print(json.dumps(found, indent=2))
        return int(not found["flat"])
    print(f"{found['sentence']}\n{found['steps']} steps in {found['wall_s']:.0f} s of wall time")
    print(f"step: {found['step_us'][0]:.1f} -> {found['step_us'][1]:.1f} us (median; second and last quarter)")
    for name, held in found["processes"].items():
        told = ", ".join(f"{key} {a:g} -> {b:g} ({b - a:+.2g})" for key, (a, b) in held.items())
        print(f"{name}: {told}")
    print("flat" if found["flat"] else "something grew")
    return int(not found["flat"])


if __name__ == "__main__":
    sys.exit(main())
