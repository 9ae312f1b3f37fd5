"""Records to test with: single rows by column name, and a made-up flight along the figure of eight."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from companion.record.columns import COLUMN_INDEX, COLUMNS, DEFAULT_PHASE_NAMES, LIMIT_THRUST_MAX
from companion.record.flight_record import FlightRecord
from companion.record.summary import PhaseChange

MASS_KG = 4.76
RATE_HZ = 100
TRACK = DEFAULT_PHASE_NAMES.index("track")
HOLD = DEFAULT_PHASE_NAMES.index("hold")
LEVEL = {
    "q_w": 1.0,
    "q_x": 0.0,
    "q_y": 0.0,
    "q_z": 0.0,
    "v_n": 0.0,
    "v_e": 0.0,
    "v_d": 0.0,
    "late": 0.0,
    "skipped": 0.0,
}
PHASES = [
    PhaseChange("connect", 100.0, "the command was given"),
    PhaseChange("preflight", 100.5, "the vehicle answers"),
    PhaseChange("join", 101.0, "all checks passed; already airborne in Hold"),
    PhaseChange("track", 104.0, "OFFBOARD confirmed, airborne, join done"),
    PhaseChange("hold", 164.0, "the trajectory is over"),
]
DISTURBANCE = (1.0, 0.0, 0.4905)


def row(**values: float) -> tuple[float, ...]:
    """A row with these columns, level and at rest, and NaN elsewhere."""
    numbers = [math.nan] * len(COLUMNS)
    for name, value in {**LEVEL, **values}.items():
        numbers[COLUMN_INDEX[name]] = float(value)
    return tuple(numbers)


def track_record(errors: list[tuple[float, float, float]], step_s: float = 1.0, **columns: list[float]) -> FlightRecord:
    """A record of nothing but the track phase, one row per error, starting at vehicle time 50 s and track time 0."""
    record = FlightRecord(len(errors))
    for index, (north, east, down) in enumerate(errors):
        more = {name: values[index] for name, values in columns.items()}
        at = {"t_s": 50.0 + step_s * index, "track_s": step_s * index, "phase": TRACK}
        record.append(row(**{**at, "error_n": north, "error_e": east, "error_d": down, **more}))
    return record


def eight(time_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position and two derivatives of the paper's path (section VI)."""
    a, b = 0.2 * time_s, 0.4 * time_s
    p = np.array([5 * math.cos(a) - 5, 2.5 * math.sin(b), -10.0])
    v = np.array([-math.sin(a), math.cos(b), 0.0])
    return p, v, np.array([-0.2 * math.cos(a), -0.4 * math.sin(b), 0.0])


def synthetic_flight(track_s: float = 60.0) -> FlightRecord:
    """Three seconds of joining, the figure of eight with a damped error and some noise, five seconds of holding."""
    noise = np.random.default_rng(7)
    count = round((3.0 + track_s + 5.0) * RATE_HZ)
    record = FlightRecord(count)
    for index in range(count):
        time = index / RATE_HZ - 3.0
        record.append(_row_at(time, track_s, noise))
    return record


def _row_at(time: float, track_s: float, noise: np.random.Generator) -> tuple[float, ...]:
    on_track = 0.0 <= time < track_s
    clock = min(max(time, 0.0), track_s)
    p_d, v_d, a_d = eight(clock)
    decay, swing = math.exp(-0.45 * clock), math.cos(0.6 * clock)
    error = np.array([30.0, -20.0, -10.0]) * decay * swing + noise.normal(0.0, 0.003, 3)
    e2 = error + np.array([-4.0, 3.0, 2.0]) * decay * math.sin(0.9 * clock)
    e3, e4 = 0.5 * e2 + noise.normal(0.0, 0.002, 3), 0.2 * e2 + noise.normal(0.0, 0.004, 3)
    v = v_d + np.array([-14.0, 9.0, 4.0]) * decay * swing * 0.4
    b_hat = np.array(DISTURBANCE) * (1 - math.exp(-0.5 * clock)) + noise.normal(0.0, 0.004, 3)
    thrust = MASS_KG * (10.3 + 4.0 * decay * math.cos(3 * clock))
    yaw = math.atan2(v_d[1], v_d[0])
    q = (math.cos(yaw / 2), 0.03 * decay, -0.05 * a_d[0], math.sin(yaw / 2))
    length = math.sqrt(sum(c * c for c in q))
    values = {
        **{"t_s": 104.0 + time, "track_s": clock if on_track else math.nan, "lyapunov": float(error @ error)},
        **{"phase": TRACK if on_track else DEFAULT_PHASE_NAMES.index("join") if time < 0 else HOLD},
        **dict(zip(("q_w", "q_x", "q_y", "q_z"), (c / length for c in q), strict=True)),
        **{"heading_error_rad": noise.normal(0, 0.004), "thrust_n": thrust, "thrust_cmd": thrust / 96.0},
        **{"thrust_rate_n_s": 0.0, "state_age_ms": 20.0 + noise.exponential(0.4), "step_us": 80 + noise.exponential(9)},
        **{"limits": LIMIT_THRUST_MAX if on_track and clock < 0.3 else 0, "late": 0, "skipped": 0},
    }
    vectors = {"p": p_d + error, "v": v, "ref": p_d, "ref_v": v_d, "error": error, "b_hat": b_hat}
    law = {"e1": error, "e2": e2, "e3": e3, "e4": e4} if on_track else {}
    for name, vector in {**vectors, **law}.items():
        values.update({f"{name}_{axis}": float(vector[at]) for at, axis in enumerate("ned")})
    for name, size in (("w", 0.5), ("rate_cmd", 0.6), ("tau", 4.0)):
        values.update({f"{name}_{axis}": size * decay * swing + noise.normal(0, 0.02) for axis in "xyz"})
    return row(**values)


def write_truth(path: Path, start_s: float = 101.0, seconds: float = 68.0) -> None:
    """A truth.csv as the simulated vehicle writes it, with the columns that the report reads and others."""
    names = ["t_s", "p_n", "disturbance_n_m_s2", "disturbance_e_m_s2", "disturbance_d_m_s2", "thrust_1_n"]
    lines = [",".join(names)]
    for index in range(round(seconds * 50)):
        time = start_s + index / 50
        lines.append(f"{time!r},0.0,{DISTURBANCE[0]},{0.05 * math.sin(time)!r},{DISTURBANCE[2]},11.7")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
