"""The sensors of a vehicle whose autopilot is a real PX4: IMU, magnetometer, barometer and GPS, late and noisy.

Every sample goes out as HIL_SENSOR, some also as HIL_GPS. PX4 takes a group of HIL_SENSOR's fields only when all bits
of the group are set (its modules/mavlink/mavlink_receiver.h, SensorSource), so that a group is sent whole or not at
all. IMU values are means over the time since the sample before, as an IMU integrates; PX4 stores them as int16 and does
not check, so that they stay within the range of such a sensor.
"""

from __future__ import annotations

import math
import random
import struct
from collections import deque
from typing import NamedTuple

from .geodesy import HOME_ALTITUDE_M, global_position
from .physics import RigidState
from .rotation import Vec3, clip, conjugate, logarithm, multiply, normalised, rotate_back
from .sensors import FIELD_G, altitude_at_m, pressure_hpa

ID_HIL_SENSOR, ID_HIL_GPS = 107, 113
HIL_SENSOR = struct.Struct("<Q13fIB")
"""time_usec; accelerometer, gyro, magnetometer; abs_pressure, diff_pressure, pressure_alt, temperature; fields_updated,
id."""
HIL_GPS = struct.Struct("<Q3i3H3hH3BH")
"""time_usec; lat, lon, alt; eph, epv, vel; vn, ve, vd; cog; fix_type, satellites_visible, id; yaw."""
ACCELEROMETER, GYRO, MAGNETOMETER, BAROMETER = 0x007, 0x038, 0x1C0, 0x1A00
"""Bits of fields_updated; the barometer's are pressure, pressure altitude and temperature."""

SAMPLE_US = 4_000
"""Of the IMU: 250 Hz, to which PX4 sets IMU_INTEG_RATE for such a simulator."""
MAGNETOMETER_US, BAROMETER_US, GPS_US = 20_000, 20_000, 100_000
GPS_DELAY_US = 12_000
"""Age of a position. PX4 stamps it with the sample before, and expects it 10 ms old then (SENS_GPS0_DELAY of its
simulation scripts)."""

_ACCELERATION_MAX_M_S2 = 16.0 * 9.80665 * 0.999
_RATE_MAX_RAD_S = math.radians(2000.0) * 0.999
_PRIMARY, _TEMPERATURE_C = 0, 25.0
"""id of the sensors, the one that moves PX4's clock; temperature of the board."""
_FIX_3D, _SATELLITES = 3, 10
_EPH_CM, _EPV_CM = 50, 80
"""PX4 reads eph and epv as centimetres of accuracy."""
_UNKNOWN_COURSE = 65535
_SLOW_M_S = 0.5
"""Below this ground speed there is no course."""


class Noise(NamedTuple):
    """One sigma of everything; constant biases and white noise of one sample."""

    acceleration_m_s2: float = 0.05
    acceleration_bias_m_s2: float = 0.02
    rate_rad_s: float = 0.003
    rate_bias_rad_s: float = 0.002
    field_g: float = 0.003
    pressure_hpa: float = 0.01
    gps_horizontal_m: float = 0.05
    gps_vertical_m: float = 0.10
    gps_speed_m_s: float = 0.03
    wander_horizontal_m: float = 0.15
    """Of the GPS's slow error, a first-order Markov process."""
    wander_vertical_m: float = 0.30
    wander_time_constant_s: float = 60.0


class GpsFix(NamedTuple):
    """What the GPS measures at a moment, before noise."""

    p: Vec3
    v: Vec3


class Sensors:
    """Measures one vehicle; the noise follows from the seed and the number of the sample."""

    def __init__(self, seed: int, gravity_m_s2: float, start_us: int, noise: Noise | None = None) -> None:
        """Draw the biases.

        Args:
            seed: of biases and noise.
            gravity_m_s2: of the world.
            start_us: time of the first sample, which has everything.
            noise: sigmas; None: the usual ones.
        """
        self._start_us = start_us
        self.noise = Noise() if noise is None else noise
        self._draw = random.Random(f"hil sensors {seed}")
        self._gravity_m_s2 = gravity_m_s2
        self._bias_m_s2 = self._vector(self.noise.acceleration_bias_m_s2)
        self._bias_rad_s = self._vector(self.noise.rate_bias_rad_s)
        horizontal, vertical = self.noise.wander_horizontal_m, self.noise.wander_vertical_m
        self._wander_m = self._noisy((0.0, 0.0, 0.0), (horizontal, horizontal, vertical))
        self._fixes: deque[GpsFix] = deque(maxlen=GPS_DELAY_US // SAMPLE_US + 1)
        self._field_g: Vec3 = (0.0, 0.0, 0.0)
        self._pressure_hpa = 0.0

    def hil_sensor(self, t_us: int, before: RigidState, now: RigidState) -> bytes:
        """Measure as HIL_SENSOR: at t_us, with the states then and one sample period before."""
        since_us = t_us - self._start_us
        force, rates = self._inertial(before, now)
        updated = ACCELEROMETER | GYRO
        if since_us % MAGNETOMETER_US == 0:
            updated |= MAGNETOMETER
            sigma = self.noise.field_g
            self._field_g = self._noisy(rotate_back(now.q, FIELD_G), (sigma, sigma, sigma))
        if since_us % BAROMETER_US == 0:
            updated |= BAROMETER
            noise_hpa = self._draw.gauss(0.0, self.noise.pressure_hpa)
            self._pressure_hpa = pressure_hpa(HOME_ALTITUDE_M - now.p[2]) + noise_hpa
        pressure = self._pressure_hpa
        return HIL_SENSOR.pack(
            t_us, *force, *rates, *self._field_g,
            pressure, 0.0, altitude_at_m(pressure), _TEMPERATURE_C, updated, _PRIMARY,
        )  # fmt: skip

    def hil_gps(self, t_us: int, now: RigidState) -> bytes | None:
        """Measure as HIL_GPS when a fix is due, else None; to be called with every sample."""
        self._fixes.append(GpsFix(now.p, now.v))
        since_us = t_us - self._start_us
        if since_us == 0 or since_us % GPS_US != 0:
            return None  # before the first sample PX4 has no time to stamp it with
        self._wander()
        fix, noise = self._fixes[0], self.noise
        horizontal, vertical, speed = noise.gps_horizontal_m, noise.gps_vertical_m, noise.gps_speed_m_s
        p = self._noisy(_sum(fix.p, self._wander_m), (horizontal, horizontal, vertical))
        v = self._noisy(fix.v, (speed, speed, speed))
        latitude, longitude, altitude_m = global_position(p)
        ground_speed = math.hypot(v[0], v[1])
        course = round(100.0 * math.degrees(math.atan2(v[1], v[0]))) % 36000
        return HIL_GPS.pack(
            t_us, latitude, longitude, round(1000.0 * clip(altitude_m, -2.0e6, 2.0e6)),
            _EPH_CM, _EPV_CM, min(65534, round(100.0 * ground_speed)),
            *(round(clip(100.0 * x, -32767.0, 32767.0)) for x in v),
            course if ground_speed > _SLOW_M_S else _UNKNOWN_COURSE, _FIX_3D, _SATELLITES, _PRIMARY, 0,
        )  # fmt: skip

    def _inertial(self, before: RigidState, now: RigidState) -> tuple[Vec3, Vec3]:
        """Measure specific force and body rates, FRD, as means between two states one sample apart."""
        per_s = 1.0e6 / SAMPLE_US
        turn = logarithm(multiply(conjugate(before.q), now.q))
        middle = normalised(_sum4(before.q, now.q))
        force = rotate_back(
            middle,
            (
                per_s * (now.v[0] - before.v[0]),
                per_s * (now.v[1] - before.v[1]),
                per_s * (now.v[2] - before.v[2]) - self._gravity_m_s2,
            ),
        )
        rates = (per_s * turn[0], per_s * turn[1], per_s * turn[2])
        sigma, sigma_rate = self.noise.acceleration_m_s2, self.noise.rate_rad_s
        measured = self._noisy(_sum(force, self._bias_m_s2), (sigma, sigma, sigma))
        turning = self._noisy(_sum(rates, self._bias_rad_s), (sigma_rate, sigma_rate, sigma_rate))
        return _within(measured, _ACCELERATION_MAX_M_S2), _within(turning, _RATE_MAX_RAD_S)

    def _wander(self) -> None:
        """Go one GPS period on with the slow error."""
        noise = self.noise
        kept = math.exp(-GPS_US * 1.0e-6 / noise.wander_time_constant_s)
        added = math.sqrt(1.0 - kept * kept)
        n, e, d = self._wander_m
        horizontal, vertical = added * noise.wander_horizontal_m, added * noise.wander_vertical_m
        self._wander_m = self._noisy((kept * n, kept * e, kept * d), (horizontal, horizontal, vertical))

    def _vector(self, sigma: float) -> Vec3:
        return self._noisy((0.0, 0.0, 0.0), (sigma, sigma, sigma))

    def _noisy(self, value: Vec3, sigma: Vec3) -> Vec3:
        gauss = self._draw.gauss
        return gauss(value[0], sigma[0]), gauss(value[1], sigma[1]), gauss(value[2], sigma[2])


def _sum(a: Vec3, b: Vec3) -> Vec3:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _sum4(
    a: tuple[float, float, float, float], b: tuple[float, float, float, float]
) -> tuple[float, float, float, float]:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3]


def _within(value: Vec3, limit: float) -> Vec3:
    return clip(value[0], -limit, limit), clip(value[1], -limit, limit), clip(value[2], -limit, limit)
