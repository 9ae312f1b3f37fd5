"""Trajectory files of every format, written from closed forms: what is loaded can be compared with what is true.

`python tests/unit/format_cases.py` writes the samples in tests/data/trajectories again.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path

from companion.control.types import Reference, Vec3
from companion.trajectory.polynomial import evaluate
from companion.trajectory.shapes import Lemniscate

DATA = Path(__file__).parents[1] / "data" / "trajectories"

EIGHT = Lemniscate(center_m=(-5.0, 0.0, -10.0), amplitude_m=(5.0, 2.5), angular_rate_rad_s=0.2)
"""The paper's path."""
SWIFT = Lemniscate(center_m=(0.0, 0.0, -10.0), amplitude_m=(5.0, 2.5), angular_rate_rad_s=0.5)

HOME = (47.397742, 8.545594, 488.0)
"""Latitude, longitude [deg], altitude above sea level [m]."""
EARTH_RADIUS_M = 6371000.0

RPG = (
    "t,p_x,p_y,p_z,q_w,q_x,q_y,q_z,v_x,v_y,v_z,w_x,w_y,w_z,a_lin_x,a_lin_y,a_lin_z,a_rot_x,a_rot_y,a_rot_z,"
    "u_1,u_2,u_3,u_4,jerk_x,jerk_y,jerk_z,snap_x,snap_y,snap_z"
)
MAVSDK = "idx,t,px,py,pz,vx,vy,vz,ax,ay,az,yaw,mode"
SKYBRUSH = "Time [msec],x [m],y [m],z [m],Red,Green,Blue"
POLYNOMIAL = "duration," + ",".join(f"{axis}^{k}" for axis in ("x", "y", "z", "yaw") for k in range(8)) + ","

Path3 = Callable[[float], Reference]


def times(duration_s: float, rate_hz: float) -> Iterator[float]:
    for i in range(round(duration_s * rate_hz) + 1):
        yield i / rate_hz


def enu(v: Vec3) -> Vec3:
    """Worked out here and not taken from the program: a wrong sign must not cancel itself."""
    return v[1], v[0], -v[2]


def nwu(v: Vec3) -> Vec3:
    return v[0], -v[1], -v[2]


def rpg(at: Path3, duration_s: float, rate_hz: float, columns: int = 30, digits: int = 9) -> str:
    """An attitude that leans to where it accelerates, nose at a constant 30 degrees counter-clockwise from east."""
    lines = [",".join(RPG.split(",")[:columns])]
    for t in times(duration_s, rate_hz):
        r = at(t)
        p, v, a, j, s = (enu(x) for x in (r.p, r.v, r.a, r.j, r.s))
        row = [
            t,
            *p,
            *_leaning(a, math.radians(30.0)),
            *v,
            0.0,
            0.0,
            0.0,
            *a,
            0.0,
            0.0,
            0.0,
            2.0,
            2.0,
            2.0,
            2.0,
            *j,
            *s,
        ]
        lines.append(",".join(f"{x:.{digits}f}" for x in row[:columns]))
    return "\n".join(lines) + "\n"


def _leaning(a: Vec3, yaw: float) -> tuple[float, float, float, float]:
    """The quaternion whose z axis is along a + g up and whose x axis is at that yaw."""
    f = (a[0], a[1], a[2] + 9.81)
    n = math.hypot(*f)
    z = (f[0] / n, f[1] / n, f[2] / n)
    # First the yaw, then the shortest turn of the vertical to z.
    half = math.sqrt(0.5 * (1.0 + z[2]))
    turn = (half, -z[1] / (2.0 * half), z[0] / (2.0 * half), 0.0)
    spin = (math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw))
    w1, x1, y1, z1 = turn
    w2, x2, y2, z2 = spin
    return (
        w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
        w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
        w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
        w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
    )


def mavsdk(at: Path3, duration_s: float, rate_hz: float, leds: bool = False, digits: int = 6) -> str:
    lines = [MAVSDK + (",ledr,ledg,ledb" if leds else "")]
    for i, t in enumerate(times(duration_s, rate_hz)):
        r = at(t)
        yaw_deg = math.degrees(math.remainder(r.yaw, math.tau))
        numbers = ",".join(f"{x:.{digits}f}" for x in (t, *r.p, *r.v, *r.a, yaw_deg))
        lines.append(f"{i},{numbers},70" + (",255,0,128" if leds else ""))
    return "\n".join(lines) + "\n"


def skybrush(at: Path3, duration_s: float, rate_hz: float, digits: int = 3) -> str:
    lines = [SKYBRUSH]
    for t in times(duration_s, rate_hz):
        x, y, z = nwu(at(t).p)
        lines.append(f"{round(1000.0 * t)},{x:.{digits}f},{y:.{digits}f},{z:.{digits}f},0,255,0")
    return "\n".join(lines) + "\n"


def septic(start: tuple[float, ...], end: tuple[float, ...], d: float) -> list[float]:
    """Ascending powers of the time, degree 7, from a value and three derivatives to others over d seconds."""
    c = [start[0], start[1] * d, start[2] * d**2 / 2.0, start[3] * d**3 / 6.0]
    r0 = end[0] - sum(c)
    r1 = end[1] * d - (c[1] + 2.0 * c[2] + 3.0 * c[3])
    r2 = end[2] * d**2 - (2.0 * c[2] + 6.0 * c[3])
    r3 = end[3] * d**3 - 6.0 * c[3]
    c += [
        35.0 * r0 - 15.0 * r1 + 2.5 * r2 - r3 / 6.0,
        -84.0 * r0 + 39.0 * r1 - 7.0 * r2 + 0.5 * r3,
        70.0 * r0 - 34.0 * r1 + 6.5 * r2 - 0.5 * r3,
        -20.0 * r0 + 10.0 * r1 - 2.0 * r2 + r3 / 6.0,
    ]
    return [value / d**k for k, value in enumerate(c)]


def polynomial(at: Path3, duration_s: float, pieces: int, digits: int = 6) -> str:
    """Pieces of degree 7 that have the path's value and first three derivatives where they meet."""
    lines = [POLYNOMIAL]
    d = duration_s / pieces
    for i in range(pieces):
        ends = [[enu(x) for x in at(t)[:4]] for t in (i * d, (i + 1) * d)]  # type: ignore[arg-type]
        row = [d]
        for axis in range(3):
            start, end = (tuple(x[axis] for x in side) for side in ends)
            row += septic(start, end, d)
        yaw0, yaw1 = (math.pi / 2.0 - at(t).yaw for t in (i * d, (i + 1) * d))
        row += septic((yaw0, 0.0, 0.0, 0.0), (yaw1, 0.0, 0.0, 0.0), d)
        lines.append(",".join(f"{x:.{digits}f}" for x in row) + ",")
    return "\n".join(lines) + "\n"


def rest_to_rest(length_m: float, duration_s: float) -> Path3:
    """North and back to rest by a polynomial of degree 7: its fourth derivative jumps at both ends."""
    c = septic((0.0, 0.0, 0.0, 0.0), (length_m, 0.0, 0.0, 0.0), 1.0)

    def at(t: float) -> Reference:
        x = evaluate((*c, 0.0, 0.0), 1.0, min(max(t / duration_s, 0.0), 1.0))  # type: ignore[arg-type]
        p, v, a, j, s = ((x[k] / duration_s**k, 0.0, 0.0) for k in range(5))
        return Reference((p[0], 0.0, -5.0), v, a, j, s, 0.0, 0.0, 0.0)

    return at


def place(north_m: float, east_m: float) -> tuple[float, float]:
    """Latitude and longitude of a point seen from HOME, on the sphere: north along the meridian, then along the great
    circle of the azimuth."""
    arc, azimuth = math.hypot(north_m, east_m) / EARTH_RADIUS_M, math.atan2(east_m, north_m)
    lat0, lon0 = math.radians(HOME[0]), math.radians(HOME[1])
    lat = math.asin(math.sin(lat0) * math.cos(arc) + math.cos(lat0) * math.sin(arc) * math.cos(azimuth))
    lon = lon0 + math.atan2(
        math.sin(azimuth) * math.sin(arc) * math.cos(lat0), math.cos(arc) - math.sin(lat0) * math.sin(lat)
    )
    return math.degrees(lat), math.degrees(lon)


SQUARE = ((0.0, 0.0, 10.0), (30.0, 0.0, 10.0), (30.0, 20.0, 15.0), (0.0, 20.0, 10.0))
"""North, east, up of a small mission [m]."""
FENCE = ((-20.0, -20.0), (60.0, -20.0), (60.0, 50.0), (-20.0, 50.0))
"""North, east of the corners of its fence [m]."""


def item(command: int, params: list[float | None], frame: int = 3) -> dict[str, object]:
    return {"type": "SimpleItem", "autoContinue": True, "command": command, "frame": frame, "params": params}


def plan() -> dict[str, object]:
    """A mission as QGroundControl saves it: take-off, three waypoints, one of them with a wait, return."""
    first, *others = SQUARE
    items = [item(22, [15, 0, 0, None, *place(*first[:2]), first[2]])]
    items.append(item(530, [0, 2, None, None, None, None, None], frame=2))
    for index, (north, east, up) in enumerate(others):
        items.append(item(16, [2.0 if index == 1 else 0, 0, 0, None, *place(north, east), up]))
    items.append(item(20, [0, 0, 0, 0, 0, 0, 0], frame=2))
    return {
        "fileType": "Plan",
        "version": 1,
        "groundStation": "QGroundControl",
        "mission": {
            "version": 2,
            "firmwareType": 12,
            "vehicleType": 2,
            "cruiseSpeed": 15,
            "hoverSpeed": 5,
            "plannedHomePosition": list(HOME),
            "items": items,
        },
        "geoFence": {
            "version": 2,
            "polygons": [{"version": 1, "inclusion": True, "polygon": [list(place(*corner)) for corner in FENCE]}],
            "circles": [
                {"version": 1, "inclusion": False, "circle": {"center": list(place(15.0, 45.0)), "radius": 5.0}}
            ],
        },
        "rallyPoints": {"version": 2, "points": []},
    }


def wpl() -> str:
    """The same mission as text, without its wait."""
    lines = ["QGC WPL 110", f"0\t1\t0\t16\t0\t0\t0\t0\t{HOME[0]:.8f}\t{HOME[1]:.8f}\t{HOME[2]:.6f}\t1"]
    for index, (north, east, up) in enumerate(SQUARE):
        latitude, longitude = place(north, east)
        command = 16 if index else 22
        lines.append(f"{index + 1}\t0\t3\t{command}\t0\t0\t0\t0\t{latitude:.8f}\t{longitude:.8f}\t{up:.6f}\t1")
    lines.append(f"{len(SQUARE) + 1}\t0\t3\t20\t0\t0\t0\t0\t0\t0\t0\t1")
    return "\n".join(lines) + "\n"


def waypoints() -> str:
    """East, north, up without a header."""
    return "".join(f"{east},{north},{up}\n" for north, east, up in SQUARE)


def samples() -> dict[str, str]:
    """Every file of tests/data/trajectories with its text."""
    lap_s = 62.0
    return {
        "eight-rpg.csv": rpg(EIGHT.at, 20.0, 10.0, columns=17),
        "eight-mavsdk.csv": mavsdk(EIGHT.at, 30.0, 10.0, leds=True),
        "eight-skybrush.csv": skybrush(EIGHT.at, lap_s, 4.0),
        "eight-polynomial.csv": polynomial(EIGHT.at, lap_s, 31),
        "square.csv": waypoints(),
        "square.plan": json.dumps(plan(), indent=4) + "\n",
        "square.waypoints": wpl(),
    }


if __name__ == "__main__":
    for name, text in samples().items():
        (DATA / name).write_text(text, encoding="utf-8")
