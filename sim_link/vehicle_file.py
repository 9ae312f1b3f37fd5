"""Reads the vehicle TOML: the sections from which the simulated vehicle is built.

The companion reads the same file for what it must know ([controller], [limits], `simulated`); those and any other
sections are none of the simulated vehicle's business and are passed over. Within its own sections every key is
required, but for the bias walk's in [noise], and no other is allowed.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .rotation import Vec3, Vec4

_STEPS_PER_RATE_LAG = 4.0
"""Loop steps that fit at least into a rate lag: quicker rate loops are not stable at the loop's own rate."""
_ROTOR_LAG_PER_RATE_LAG = 3.0
"""A rate loop cannot be much quicker than the rotors behind it."""
_LEAST_LEVER = 1.0e-3
"""Smallest singular value of the scaled rotor geometry that counts as controllable."""


class VehicleFileError(ValueError):
    """A vehicle file that cannot be used; the message is one line: file, key path, value, what is allowed."""


@dataclass(frozen=True)
class VehicleFile:
    """What the simulated vehicle is made of, as one vehicle file states it (SI; body frame FRD)."""

    name: str
    path: str
    """The file that was read."""
    mass_kg: float
    inertia_kg_m2: Vec3
    """Principal moments about body x, y, z."""
    drag_1_s: float
    """Linear drag D of v' = ... - D (v - air)."""
    rotor_x_m: Vec4
    """Forward; PX4's order front right, rear left, front left, rear right."""
    rotor_y_m: Vec4
    """Right."""
    rotor_yaw_m: Vec4
    """Yaw moment per newton of thrust; positive turns the nose right."""
    rotor_thrust_max_n: float
    """Of one rotor."""
    rotor_lag_s: float
    curve_factor: float
    """f of thrust/thrust_max = f u^2 + (1 - f) u."""
    rate_lag_s: Vec3
    """First-order equivalent of the closed rate loop per axis."""
    rate_integral_1_s: Vec3
    """Integral over proportional gain of the rate loop."""
    attitude_gain_1_s: Vec3
    attitude_lag_s: float
    """Lag of the reference model on attitude setpoints, 2 / MC_REF_W_N; 0 = none."""
    loop_rate_hz: float
    """Rate loop and physics step."""
    state_rate_hz: float
    """Messages with the state."""
    state_age_s: float
    """Age of a state when it is sent."""
    command_delay_s: float
    """From the arrival of a setpoint until the loops use it."""
    noise_position_m: float
    """One sigma per axis, as for the other three."""
    noise_velocity_m_s: float
    noise_attitude_rad: float
    noise_rate_rad_s: float
    walk_position_m: float = 0.0
    """Random walk of the position's bias: sigma per axis of what a second adds, as for the other three."""
    walk_velocity_m_s: float = 0.0
    walk_yaw_rad: float = 0.0
    walk_rate_rad_s: float = 0.0
    walk_time_constant_s: float = 0.0
    """With which the biases are drawn back to zero; 0: never."""


class _Key(NamedTuple):
    """One key of the file: where it goes and what it may be."""

    section: str
    key: str
    field: str
    length: int
    """0 = one number, else the length of an array of numbers."""
    allowed: str
    check: Callable[[float], bool]
    default: float | None = None
    """Of a key that may be left out."""


def _positive(value: float) -> bool:
    return value > 0.0


def _not_negative(value: float) -> bool:
    return value >= 0.0


def _share(value: float) -> bool:
    return 0.0 <= value <= 1.0


def _any(value: float) -> bool:
    return True


def _loop_rate(value: float) -> bool:
    return 50.0 <= value <= 8000.0 and abs(1.0e6 / value - round(1.0e6 / value)) < 1.0e-6


_KEYS = (
    _Key("body", "mass_kg", "mass_kg", 0, "greater than 0", _positive),
    _Key("body", "inertia_kg_m2", "inertia_kg_m2", 3, "greater than 0", _positive),
    _Key("body", "drag_1_s", "drag_1_s", 0, "0 or more", _not_negative),
    _Key("rotors", "x_m", "rotor_x_m", 4, "finite", _any),
    _Key("rotors", "y_m", "rotor_y_m", 4, "finite", _any),
    _Key("rotors", "yaw_moment_m", "rotor_yaw_m", 4, "finite", _any),
    _Key("rotors", "thrust_max_n", "rotor_thrust_max_n", 0, "greater than 0", _positive),
    _Key("rotors", "lag_s", "rotor_lag_s", 0, "0 to 1", _share),
    _Key("rotors", "curve_factor", "curve_factor", 0, "0 to 1", _share),
    _Key("autopilot", "rate_lag_s", "rate_lag_s", 3, "greater than 0", _positive),
    _Key("autopilot", "rate_integral_1_s", "rate_integral_1_s", 3, "0 or more", _not_negative),
    _Key("autopilot", "attitude_gain_1_s", "attitude_gain_1_s", 3, "greater than 0", _positive),
    _Key("autopilot", "attitude_lag_s", "attitude_lag_s", 0, "0 to 1", _share),
    _Key("autopilot", "loop_rate_hz", "loop_rate_hz", 0, "50 to 8000 with a period of whole microseconds", _loop_rate),
    _Key("link", "state_rate_hz", "state_rate_hz", 0, "greater than 0", _positive),
    _Key("link", "state_age_s", "state_age_s", 0, "0 to 1", _share),
    _Key("link", "command_delay_s", "command_delay_s", 0, "0 to 1", _share),
    _Key("noise", "position_m", "noise_position_m", 0, "0 or more", _not_negative),
    _Key("noise", "velocity_m_s", "noise_velocity_m_s", 0, "0 or more", _not_negative),
    _Key("noise", "attitude_rad", "noise_attitude_rad", 0, "0 or more", _not_negative),
    _Key("noise", "rate_rad_s", "noise_rate_rad_s", 0, "0 or more", _not_negative),
    _Key("noise", "position_walk_m_per_sqrt_s", "walk_position_m", 0, "0 or more", _not_negative, 0.0),
    _Key("noise", "velocity_walk_m_s_per_sqrt_s", "walk_velocity_m_s", 0, "0 or more", _not_negative, 0.0),
    _Key("noise", "yaw_walk_rad_per_sqrt_s", "walk_yaw_rad", 0, "0 or more", _not_negative, 0.0),
    _Key("noise", "rate_walk_rad_s_per_sqrt_s", "walk_rate_rad_s", 0, "0 or more", _not_negative, 0.0),
    _Key("noise", "walk_time_constant_s", "walk_time_constant_s", 0, "0 or more", _not_negative, 0.0),
)
_COMPANIONS = {"link": ("exclusive",)}
"""Keys of these sections that only the companion reads."""
_SECTIONS = tuple(dict.fromkeys(k.section for k in _KEYS))


def bundled_folder() -> Path:
    """Return the folder of the bundled vehicle files: inside the installed companion, or in the source tree."""
    beside = Path(__file__).resolve().parent.parent
    installed = beside / "companion" / "_config" / "vehicles"
    return installed if installed.is_dir() else beside / "config" / "vehicles"


def find(name_or_path: str) -> Path:
    """Return the file for a path or for the name of a bundled vehicle. Raises VehicleFileError without either."""
    path = Path(name_or_path)
    if path.is_file():
        return path
    folder = bundled_folder()
    bundled = folder / f"{name_or_path}.toml"
    if path.name == name_or_path and bundled.is_file():
        return bundled
    names = ", ".join(sorted(p.stem for p in folder.glob("*.toml"))) or "none"
    raise VehicleFileError(f"{name_or_path}: no such vehicle file, and not one of the bundled vehicles ({names})")


def load(name_or_path: str) -> VehicleFile:
    """Read and validate a vehicle file: a path first, then a bundled name such as "paper". Raises VehicleFileError."""
    path = find(name_or_path)
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise VehicleFileError(f"{path}: cannot be read: {error}") from error
    except tomllib.TOMLDecodeError as error:
        raise VehicleFileError(f"{path}: not valid TOML: {error}") from error
    return parse(document, str(path))


def parse(document: Mapping[str, Any], path: str) -> VehicleFile:
    """Validate a vehicle file's content; `path` is for messages. Raises VehicleFileError."""
    name = document.get("name")
    if not isinstance(name, str) or not name:
        raise VehicleFileError(f"{path}: name = {name!r}: must be a text that is not empty")
    for section in _SECTIONS:
        _check_section(document, section, path)
    fields: dict[str, Any] = {k.field: _value(document[k.section], k, path) for k in _KEYS}
    vehicle = VehicleFile(name=name, path=path, **fields)
    _check_whole(vehicle)
    return vehicle


def _check_section(document: Mapping[str, Any], section: str, path: str) -> None:
    """Raise VehicleFileError unless a section is there, a table, and holds exactly its keys."""
    keys = [*(k.key for k in _KEYS if k.section == section), *_COMPANIONS.get(section, ())]
    required = [k.key for k in _KEYS if k.section == section and k.default is None]
    must = ", ".join(required)
    if section not in document:
        raise VehicleFileError(f"{path}: {section}: missing; the section must hold {must}")
    table = document[section]
    if not isinstance(table, Mapping):
        raise VehicleFileError(f"{path}: {section} = {table!r}: must be a section [{section}] with {must}")
    for key in table:
        if key not in keys:
            raise VehicleFileError(f"{path}: {section}.{key}: unknown; allowed are {', '.join(keys)}")
    for key in required:
        if key not in table:
            raise VehicleFileError(f"{path}: {section}.{key}: missing; [{section}] must hold {must}")


def _value(table: Mapping[str, Any], key: _Key, path: str) -> float | tuple[float, ...]:
    """Return the number or the array of numbers of a key. Raises VehicleFileError."""
    raw = table.get(key.key, key.default)
    where = f"{path}: {key.section}.{key.key}"
    if key.length == 0:
        return _number(raw, where, key)
    if not isinstance(raw, list) or len(raw) != key.length:
        raise VehicleFileError(f"{where} = {raw!r}: must be an array of {key.length} numbers")
    return tuple(_number(item, f"{where}[{index}]", key) for index, item in enumerate(raw))


def _number(raw: Any, where: str, key: _Key) -> float:
    if isinstance(raw, bool) or not isinstance(raw, int | float):
        raise VehicleFileError(f"{where} = {raw!r}: must be a number")
    value = float(raw)
    if not math.isfinite(value):
        raise VehicleFileError(f"{where} = {raw!r}: must be finite")
    if not key.check(value):
        raise VehicleFileError(f"{where} = {raw!r}: must be {key.allowed}")
    return value


def _check_whole(vehicle: VehicleFile) -> None:
    """Raise VehicleFileError where values that are allowed each do not make a vehicle together."""
    path = vehicle.path
    x, y, z = vehicle.inertia_kg_m2
    if x > y + z or y > z + x or z > x + y:
        raise VehicleFileError(
            f"{path}: body.inertia_kg_m2 = [{x:g}, {y:g}, {z:g}]: "
            "must be that of a rigid body, none above the sum of the others"
        )
    weight = vehicle.mass_kg * 9.81
    if 4.0 * vehicle.rotor_thrust_max_n <= weight:
        raise VehicleFileError(
            f"{path}: rotors.thrust_max_n = {vehicle.rotor_thrust_max_n:g}: "
            f"must be above a quarter of the weight, {weight / 4:.3g} N"
        )
    _check_geometry(vehicle)
    shortest = max(_STEPS_PER_RATE_LAG / vehicle.loop_rate_hz, vehicle.rotor_lag_s / _ROTOR_LAG_PER_RATE_LAG)
    for axis, lag in enumerate(vehicle.rate_lag_s):
        if lag < shortest * (1.0 - 1.0e-9):
            raise VehicleFileError(
                f"{path}: autopilot.rate_lag_s[{axis}] = {lag:g}: must be at least {shortest:.4g} s, "
                f"{_STEPS_PER_RATE_LAG:g} loop steps and a third of rotors.lag_s"
            )
    if vehicle.state_rate_hz > vehicle.loop_rate_hz:
        raise VehicleFileError(
            f"{path}: link.state_rate_hz = {vehicle.state_rate_hz:g}: must be at most "
            f"autopilot.loop_rate_hz, {vehicle.loop_rate_hz:g}"
        )


def _check_geometry(vehicle: VehicleFile) -> None:
    """Raise VehicleFileError unless the rotors can make roll, pitch, yaw and thrust independently of one another."""
    rows = []
    for key, arms in (("y_m", vehicle.rotor_y_m), ("x_m", vehicle.rotor_x_m), ("yaw_moment_m", vehicle.rotor_yaw_m)):
        longest = max(abs(a) for a in arms)
        if longest <= 0.0:
            raise VehicleFileError(f"{vehicle.path}: rotors.{key} = {list(arms)!r}: must not be all zero")
        rows.append([a / longest for a in arms])
    rows.append([1.0, 1.0, 1.0, 1.0])
    inverse_ok = bool(np.linalg.svd(np.array(rows), compute_uv=False)[-1] > _LEAST_LEVER)
    hover = np.linalg.inv(np.array(rows))[:, 3] if inverse_ok else np.zeros(4)
    if not inverse_ok or not bool(np.all(hover > 0.0)):
        raise VehicleFileError(
            f"{vehicle.path}: rotors.x_m, y_m, yaw_moment_m = {list(vehicle.rotor_x_m)!r}, "
            f"{list(vehicle.rotor_y_m)!r}, "
            f"{list(vehicle.rotor_yaw_m)!r}: must give roll, pitch, yaw and hover independently of one another"
        )
