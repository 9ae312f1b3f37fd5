"""Whole flights: lockstep over UDP against real time, busy cores against idle ones."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

from companion.link import codec
from companion.record.flight_record import FlightRecord
from companion.record.tlog import read_tlog

from . import latency
from .arithmetic import engines
from .common import PYTHON, ROOT, Row, Setting, median, p50_p99, verdict


def speed(folder: Path) -> float:
    """Vehicle time over wall time from the first to the last state in a flight's traffic log."""
    times = [
        (int.from_bytes(logged.raw[10:18], "little"), logged.epoch_us)
        for logged in read_tlog(folder / "link.tlog")
        if logged.raw[0] == 0xFD and int.from_bytes(logged.raw[7:10], "little") == codec.ODOMETRY
    ]
    return (times[-1][0] - times[0][0]) / (times[-1][1] - times[0][1])


def lockstep_rows(setting: Setting) -> list[Row]:
    """The demo, with either engine in turn."""
    found: dict[str, list[float]] = {engine: [] for engine in engines()}
    for i in range(1 if setting.quick else 3):
        for engine, speeds in found.items():
            setting.say(f"lockstep flight {i + 1}, {engine}")
            folder = setting.folder / f"lockstep-{engine}-{i}"
            command = [PYTHON, "-m", "companion", "demo", "--json", "--engine", engine, "--out", str(folder)]
            subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False, cwd=ROOT)
            speeds.append(speed(folder))
    return [
        Row(
            f"lockstep flight over UDP at 250 Hz, {engine}",
            "real time",
            ">= 50 times" if engine == "numba" else "",
            f"{median(speeds):.1f} times (of {len(speeds)}: {min(speeds):.1f} to {max(speeds):.1f})",
            verdict(median(speeds) >= 50.0) if engine == "numba" else "",
        )
        for engine, speeds in found.items()
    ]


def hog_rows(setting: Setting) -> list[Row]:
    """The control step with and without a busy process for every core, with and without --realtime."""
    seconds, rounds = (4.0, 1) if setting.quick else (8.0, 3)
    found: dict[tuple[bool, bool], list[tuple[float, float]]] = {}
    for i in range(rounds):
        for realtime in (True, False):
            for hogs in (False, True):
                setting.say(f"hogs, round {i + 1} of {rounds}: {'with' if hogs else 'without'}, realtime {realtime}")
                options = ("--realtime",) if realtime else ()
                busy = [
                    subprocess.Popen([PYTHON, "-c", "while True: pass"])
                    for _ in range(len(os.sched_getaffinity(0)) if hogs else 0)
                ]
                try:
                    done = latency.turn(latency.COMPANION, seconds, setting, options)
                finally:
                    for process in busy:
                        process.kill()
                        process.wait()
                # Of all the steps of the flight: the summary's begin when it has settled.
                record = FlightRecord.load(Path(json.loads(done.said)["folder"]))
                found.setdefault((realtime, hogs), []).append(p50_p99(record.column("step_us").tolist()))
    rows = []
    for realtime in (True, False):
        without, with_hogs = found[realtime, False], found[realtime, True]
        factor = median([b / a for (_, a), (_, b) in zip(without, with_hogs, strict=True)])
        figures = [
            f"{median([x for x, _ in of]):.0f} / {median([y for _, y in of]):.0f}" for of in (with_hogs, without)
        ]
        rows.append(
            Row(
                f"control step with a CPU hog per core, {'--realtime' if realtime else 'as it is'}, p50 / p99",
                f"without hogs, {figures[1]} us",
                "p99 <= 2 times" if realtime else "",
                f"{figures[0]} us: p99 {factor:.2f} times",
                verdict(factor <= 2.0) if realtime else "",
            )
        )
    return rows
