"""Flies the paths of docs/px4.md on a real PX4 in real time, the law and PX4's own position controller in turn, and
prints how well they were tracked.

    python tools/px4_figures.py --px4 BINARY [--rows ROW ...] [--controllers law px4] [--set KEY=VALUE ...]
    python tools/px4_figures.py --px4 BINARY --calibrate KG     the same with what `companion calibrate` finds first

BINARY is what PX4's own build makes: build/px4_sitl_default/bin/px4. PX4 is started once, with its simulated vehicle
SIH, and flies all rows one after the other; it is stopped at the end. Errors are against PX4's own estimate, from 20 s
of the trajectory on. Beside them stands what SIH itself knows (HIL_STATE_QUATERNION, 25 Hz): the error of the estimate,
and the tracking error against the truth, both horizontal and without their means. The machine should be otherwise idle:
PX4 does not wait for the companion.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import signal
import subprocess
import sys
import time
from datetime import UTC, datetime
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

import numpy as np
from px4_session import Session, Truth

from companion.config import find, merged, read_toml
from companion.record.flight_source import read_source

STATISTICS_FROM_S = 20.0
STEP_AT_S = 8.0
"""The wind changes so long after OFFBOARD."""
STEP_M_S = 5.0
BACK_WITHIN_M = 0.10
FLIGHT_S = 240.0
TAKEOFF_M = 8.0
TRIES = 3
"""Of a flight that a gate refuses or that ends for want of states: the machine may have been busy once. Every try keeps
its folder, and the table says which it was."""
MACHINE = ("refused by a gate", "no usable state")
"""How a flight's end begins that may be the machine's."""
SETTLE_S = 4.0
"""Between a change of the wind and the next flight."""
EIGHT = {
    "shape": "lemniscate",
    "anchor": "local",
    "join": "smooth",
    "lemniscate": {"center_m": [-5.0, 0.0, -10.0], "amplitude_m": [5.0, 2.5], "angular_rate_rad_s": 0.2},
}
CIRCLE = {
    **{"shape": "circle", "anchor": "here", "join": "smooth"},
    "circle": {"radius_m": 5.0, "angular_rate_rad_s": 1.0},
}
HOVER = {"shape": "hover", "anchor": "here", "hover": {"point_m": [0.0, 0.0, 0.0]}}


class Row(NamedTuple):
    """A row of the table."""

    title: str
    trajectory: dict[str, Any]
    track_s: float
    """How long the path is flown [s]."""
    rms_m: float | None
    """What is to be reached."""
    max_m: float | None = None
    time_scale: float = 1.0
    wind_m_s: float = 0.0
    """From the south."""
    step_m_s: float = 0.0
    """Of the wind, after `STEP_AT_S`."""


ROWS = {
    "eight": Row("paper's eight", EIGHT, 52.0, 0.02, 0.06),
    "eight2.5": Row("the same 2.5 times faster", EIGHT, 46.0, 0.02, time_scale=2.5),
    "eight3.5": Row("the same 3.5 times faster", EIGHT, 40.0, 0.025, time_scale=3.5),
    "wind": Row("paper's eight, wind 5 m/s", EIGHT, 52.0, 0.02, wind_m_s=5.0),
    "circle": Row("circle of 5 m at 5 m/s", CIRCLE, 40.0, 0.03),
    "step": Row("hover, wind step of 5 m/s", HOVER, 22.0, None, 0.45, step_m_s=STEP_M_S),
}
VERTICAL_RMS_M = 0.02
BACK_IN_S = 3.0


def toml(table: dict[str, Any], prefix: str = "") -> str:
    """A table as TOML: numbers, strings, lists and tables of them."""
    plain = [f"{key} = {json.dumps(value)}" for key, value in table.items() if not isinstance(value, dict)]
    inner = [
        f"\n[{prefix}{key}]\n" + toml(value, f"{prefix}{key}.")
        for key, value in table.items()
        if isinstance(value, dict)
    ]
    return "\n".join([*plain, *inner])


def flight_files(folder: Path, name: str, row: Row, vehicle: dict[str, Any], output: dict[str, Any]) -> list[str]:
    """Writes the trajectory and the flight of a row; returns the words for `companion fly` that name them."""
    path, flight = folder / f"{name}-trajectory.toml", folder / f"{name}-flight.toml"
    duration_s = row.track_s * row.time_scale
    path.write_text(toml({**row.trajectory, "time_scale": row.time_scale, "duration_s": duration_s}))
    settings: dict[str, Any] = {"name": name, "trajectory": str(path), "takeoff_altitude_m": TAKEOFF_M}
    settings |= {"statistics_from_s": 0.0 if row.step_m_s else STATISTICS_FROM_S, "output": output, "vehicle": vehicle}
    flight.write_text(toml(settings))
    return [str(path), "--flight", str(flight)]


def nested(settings: list[str]) -> dict[str, Any]:
    """ "controller.k2=3" and the like as tables; values as TOML has them."""
    out: dict[str, Any] = {}
    for setting in settings:
        path, _, value = setting.partition("=")
        *tables, key = path.split(".")
        at = out
        for table in tables:
            at = at.setdefault(table, {})
        at[key] = json.loads(value)
    return out


def against_truth(folder: Path, truth: Truth, from_s: float) -> dict[str, float]:
    """Errors of the estimate and of the flight against the truth; horizontal rms without the mean [m]."""
    record = read_source(folder).record
    t, track = record.column("t_s"), record.column("track_s")
    on = np.flatnonzero(track >= from_s)
    used = (truth.t_s >= t[on[0]]) & (truth.t_s <= t[on[-1]]) if len(on) else np.zeros(0, dtype=bool)
    if not used.any():
        return {}
    at, real = truth.t_s[used], truth.p_m[used, :2]
    seen = np.stack([np.interp(at, t[on], record.column(name)[on]) for name in ("p_n", "p_e")], axis=1)
    wanted = np.stack([np.interp(at, t[on], record.column(name)[on]) for name in ("ref_n", "ref_e")], axis=1)

    def spread(values: Any) -> float:
        return float(np.sqrt(np.mean(np.sum((values - values.mean(axis=0)) ** 2, axis=1))))

    return {"estimate_error_rms_m": spread(seen - real), "true_rms_m": spread(real - wanted)}


def step_response(folder: Path, at_s: float) -> dict[str, float | None]:
    """Peak of the error after the wind's step [m], and when it is back for good [s]."""
    record = read_source(folder).record
    t = record.column("t_s") - at_s
    error = np.sqrt(sum(record.column(name) ** 2 for name in ("error_n", "error_e", "error_d")))
    after = (t >= 0.0) & np.isfinite(record.column("track_s"))
    if not after.any():
        return {"peak_m": None, "back_s": None}
    beyond = np.flatnonzero(after & (error > BACK_WITHIN_M))
    return {"peak_m": float(error[after].max()), "back_s": float(t[beyond[-1]]) if len(beyond) else 0.0}


def calibrate(session: Session, vehicle: str, mass_kg: float, out: Path) -> Path:
    """Calibrates the vehicle with a mass that is entered; returns the vehicle file that was found.

    Raises:
        RuntimeError: nothing was found.
    """
    found = out / "found.toml"
    command = [*(sys.executable, "-m", "companion", "calibrate", "--mass", f"{mass_kg:g}", "--vehicle", vehicle)]
    command += [*("--simulator", "--connect", session.connection, "--timeout", "30")]
    command += [*("--out", str(out / "calibration"), "--save", str(found))]
    with (out / "calibration.log").open("wb") as log:
        code = subprocess.run(command, stdout=log, stderr=log, check=False, timeout=FLIGHT_S + 60.0).returncode
    if code != 0 or not found.is_file():
        raise RuntimeError(f"no calibration: {out}/calibration.log")
    return found


class Stalls:
    """Stops the control process of a flight for a while, again and again, as a starved machine does.

    Args:
        seconds: shortest and longest stall, and the mean time from one to the next.
        seed: of all three.
    """

    def __init__(self, seconds: list[float], seed: int = 1) -> None:
        self._shortest, self._longest, self._every = seconds
        self._random = Random(seed)
        self._next_s = math.nan

    def turn(self, flight: int, now_s: float) -> None:
        """Called often while the flight is in OFFBOARD; stalls when it is due.

        Args:
            flight: process id of `companion fly`.
            now_s: any clock.
        """
        if math.isnan(self._next_s):
            self._next_s = now_s + self._random.expovariate(1.0 / self._every)
        if now_s < self._next_s:
            return
        children = Path(f"/proc/{flight}/task/{flight}/children").read_text().split()
        stopped = [
            int(pid) for pid in children if b"companion.flight.process" in Path(f"/proc/{pid}/cmdline").read_bytes()
        ]
        for pid in stopped:
            os.kill(pid, signal.SIGSTOP)
        time.sleep(self._random.uniform(self._shortest, self._longest))
        for pid in stopped:
            os.kill(pid, signal.SIGCONT)
        self._next_s = math.nan


def fly(session: Session, row: Row, words: list[str], folder: Path, stalls: Stalls | None = None) -> dict[str, Any]:
    """One flight, from wherever the vehicle is; returns its summary with what the simulator knows."""
    session.wind(row.wind_m_s, 0.0)
    time.sleep(SETTLE_S)
    command = [
        sys.executable,
        "-m",
        "companion",
        "fly",
        *words,
        "--simulator",
        "--json",
        "--timeout",
        "30",
        "--out",
        str(folder),
    ]
    step_s = math.nan
    with (folder.parent / f"{folder.name}.log").open("wb") as log:
        flight = subprocess.Popen([*command, "--connect", session.connection], stdout=log, stderr=log)
        try:
            begun_s, engaged_s = time.monotonic(), math.nan
            while flight.poll() is None and time.monotonic() - begun_s < FLIGHT_S:
                time.sleep(0.05)
                if math.isnan(engaged_s) and session.offboard:
                    engaged_s = session.now_s
                if stalls is not None and session.offboard:
                    with contextlib.suppress(OSError):  # it may end at any moment
                        stalls.turn(flight.pid, time.monotonic())
                if row.step_m_s and math.isnan(step_s) and session.now_s - engaged_s >= STEP_AT_S:
                    session.wind(0.0, row.step_m_s)
                    step_s = session.now_s
        finally:
            if flight.poll() is None:
                flight.send_signal(signal.SIGINT)
                flight.wait(20.0)
    try:
        summary: dict[str, Any] = json.loads((folder / "summary.json").read_text())
    except FileNotFoundError:
        return {"verdict": f"no flight; see {folder}.log"}
    summary |= against_truth(folder, session.truth(), 0.0 if row.step_m_s else STATISTICS_FROM_S)
    if row.step_m_s:
        summary |= step_response(folder, step_s)
    return summary


def tried(
    session: Session,
    row: Row,
    name: str,
    out: Path,
    vehicle: dict[str, Any],
    output: dict[str, str],
    stall: list[float] | None,
) -> dict[str, Any]:
    """The summary of a flight, tried again while its end may be the machine's; each try has a folder of its own."""
    for number in range(1, TRIES + 1):
        folder = out / (name if number == 1 else f"{name}-{number}")
        words = flight_files(out, folder.name, row, vehicle, output)
        summary = fly(session, row, words, folder, Stalls(stall) if stall else None)
        if not str(summary.get("ended", "")).startswith(MACHINE):
            break
    if summary.get("steps"):
        summary["flown_peak_m_s"] = flown_peak(folder)
    return summary | {"tries": number}


def flown_peak(folder: Path) -> float:
    """Largest speed in the statistics [m/s]."""
    record = read_source(folder).record
    on = record.column("track_s") >= STATISTICS_FROM_S
    speed = np.sqrt(sum(record.column(name)[on] ** 2 for name in ("v_n", "v_e", "v_d")))
    return float(speed.max()) if on.any() else math.nan


# -- the table -----------------------------------------------------------------------------------------------------


def misses(row: Row, summary: dict[str, Any]) -> list[str]:
    """What falls short, for people."""
    out = []

    def judge(key: str, limit: float | None, what: str) -> None:
        value = summary.get(key)
        if limit is not None and (value is None or not value <= limit):
            out.append(what)

    if not str(summary.get("ended", "")).startswith("the flight was completed"):
        out.append("ended early")
    if row.step_m_s:
        judge("peak_m", row.max_m, "peak")
        judge("back_s", BACK_IN_S, "back")
    else:
        judge("position_rms_m", row.rms_m, "rms")
        judge("position_max_m", row.max_m, "max")
        judge("vertical_rms_m", VERTICAL_RMS_M, "vertical")
    return out


def reach(row: Row) -> str:
    """What is to be reached, for people."""
    if row.step_m_s:
        assert row.max_m is not None
        return f"peak {100 * row.max_m:g}, 10 cm in {BACK_IN_S:g} s"
    assert row.rms_m is not None
    most = "" if row.max_m is None else f", max {100 * row.max_m:g}"
    return f"rms {100 * row.rms_m:g}{most}"


def line(row: Row, controller: str, summary: dict[str, Any]) -> str:
    """A row of the table."""

    def cm(key: str) -> str:
        value = summary.get(key)
        return "     -" if value is None else f"{100 * value:6.2f}"

    numbers = [cm(key) for key in ("position_rms_m", "position_max_m", "vertical_rms_m")]
    numbers += [cm(key) for key in ("estimate_error_rms_m", "true_rms_m")]
    short = misses(row, summary)
    said = "" if controller == "px4" else ("met" if not short else "MISSED: " + ", ".join(short))
    if row.step_m_s and summary.get("peak_m") is not None:
        said += f" (peak {100 * summary['peak_m']:.1f} cm, back in {summary['back_s']:.2f} s)"
    if short and "ended" in short[0]:
        said += f" [{summary.get('ended') or summary['verdict']}]"
    if summary["tries"] > 1:
        said += f" (try {summary['tries']})"
    peak = summary.get("flown_peak_m_s")
    speed = "   -" if peak is None or math.isnan(peak) else f"{peak:4.1f}"
    return f"{row.title:28} {controller:4} {speed}  {'  '.join(numbers)}   {reach(row):28} {said}"


HEAD = f"{'path':28} {'by':4} {'m/s':>4}  {'rms cm':>6}  {'max':>6}  {'vert.':>6}  {'estim.':>6}  {'true':>6}   reach"


def arguments() -> argparse.Namespace:
    """Of the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--px4", type=Path, required=True, help="PX4's executable, build/px4_sitl_default/bin/px4")
    parser.add_argument("--rows", nargs="+", choices=list(ROWS), default=list(ROWS))
    parser.add_argument("--controllers", nargs="+", choices=["law", "px4"], default=["law", "px4"])
    parser.add_argument("--vehicle", default="px4_sih", help="vehicle file; the same for all rows")
    parser.add_argument("--calibrate", type=float, metavar="KG", help="first, with this mass; then fly what was found")
    parser.add_argument("--output", default="rates", choices=["rates", "attitude"])
    parser.add_argument(
        "--set", nargs="+", default=[], metavar="KEY=VALUE", help="of the vehicle file, for experiments"
    )
    parser.add_argument("--px4-set", nargs="+", default=[], metavar="NAME=VALUE", help="PX4's parameters")
    parser.add_argument(
        "--stall",
        nargs=3,
        type=float,
        metavar="S",
        help="stop the control process in flight: for at least and at most so long, every so often on average",
    )
    parser.add_argument("--out", type=Path, help="folder for the flights; default ./flights/px4-<UTC>")
    parser.add_argument("--json", action="store_true", help="print one JSON document at the end instead")
    return parser.parse_args()


def main() -> int:
    """Exit code 0: everything was reached."""
    options = arguments()
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))  # PX4 is stopped on the way out
    out = options.out or Path("flights") / datetime.now(UTC).strftime("px4-%Y%m%dT%H%M%SZ")
    out = out.absolute()
    parameters = dict(setting.split("=", 1) for setting in options.px4_set)
    results: list[dict[str, Any]] = []
    short = False
    with Session(options.px4.absolute(), out / "px4", parameters) as session:
        session.wait_until_ready()
        file = options.vehicle
        if options.calibrate is not None:
            file = str(calibrate(session, file, options.calibrate, out))
        vehicle = merged(read_toml(find(file, "vehicles")), nested(options.set))
        print(HEAD, file=sys.stderr if options.json else sys.stdout, flush=True)
        for name in options.rows:
            row = ROWS[name]
            for controller in options.controllers:
                output = {"controller": controller} | ({"kind": options.output} if controller == "law" else {})
                summary = tried(session, row, f"{name}-{controller}", out, vehicle, output, options.stall)
                short = short or (controller == "law" and bool(misses(row, summary)))
                results.append({"row": name, "controller": controller, "misses": misses(row, summary), **summary})
                print(line(row, controller, summary), file=sys.stderr if options.json else sys.stdout, flush=True)
    (out / "figures.json").write_text(json.dumps(results, indent=1))
    if options.json:
        print(json.dumps(results))
    return int(short)


if __name__ == "__main__":
    sys.exit(main())
