"""The battery: what it still holds, what voltage is left under load, and how much thrust that costs.

With BAT1_CAPACITY set (mAh, PX4's default is -1: not set) it is a battery of that size: it drains with the power that
the rotors draw, its voltage falls with charge and current (BAT1_R_INTERNAL per cell), and the rotors' thrust falls with
the voltage squared. Without, it is the one of PX4's simulation: SIM_BAT_DRAIN is the time for all of its charge at
hover power, it never falls below SIM_BAT_MIN_PCT, and it costs no thrust.
"""

from __future__ import annotations

from .parameters import Parameters
from .rotation import Vec4

_HOVER_W_PER_KG = 170.0
"""Electrical power of a typical multirotor of this size in hover."""
_IDLE_W = 5.0
"""Of everything but the rotors."""
_STANDARD_G = 9.80665
_CELL_RESISTANCE_OHM = 0.005
"""What PX4 assumes where BAT1_R_INTERNAL is negative."""
_TIME_MAX_S = 1.0e9
_COMPENSATION_MAX = 1.3
"""MC_BAT_SCALE_EN never raises the thrust beyond this factor."""

CHARGE_OK, CHARGE_LOW, CHARGE_CRITICAL, CHARGE_EMERGENCY = 1, 2, 3, 4
"""MAV_BATTERY_CHARGE_STATE"""


class Battery:
    """State of charge and what follows from it."""

    def __init__(self, parameters: Parameters, mass_kg: float) -> None:
        self._parameters = parameters
        self._hover_w = _HOVER_W_PER_KG * mass_kg
        self._hover_n = mass_kg * _STANDARD_G / 4.0
        self.remaining = 1.0
        """Share of the charge."""
        self.consumed_mah = 0.0
        self.consumed_j = 0.0
        self.current_a = 0.0
        self.voltage_v = self._open_v()

    @property
    def cells(self) -> int:
        """In series."""
        return min(max(self._parameters.integer("BAT1_N_CELLS"), 1), 14)

    @property
    def is_sized(self) -> bool:
        """Whether it has a stated capacity, and with it sags."""
        return self._parameters.number("BAT1_CAPACITY") > 0.0

    @property
    def thrust_factor(self) -> float:
        """Thrust of a rotor at a given command, over that with a full battery."""
        if not self.is_sized:
            return 1.0
        full_v = max(self.cells * self._parameters.number("BAT1_V_CHARGED"), 1e-3)
        factor = min(1.0, max(0.05, self.voltage_v / full_v)) ** 2
        if self._parameters.integer("MC_BAT_SCALE_EN") == 1:
            factor *= min(1.0 / factor, _COMPENSATION_MAX)
        return factor

    @property
    def charge_state(self) -> int:
        """MAV_BATTERY_CHARGE_STATE by PX4's thresholds."""
        if self.remaining < self._parameters.number("BAT_EMERGEN_THR"):
            return CHARGE_EMERGENCY
        if self.remaining < self._parameters.number("BAT_CRIT_THR"):
            return CHARGE_CRITICAL
        if self.remaining < self._parameters.number("BAT_LOW_THR"):
            return CHARGE_LOW
        return CHARGE_OK

    @property
    def time_remaining_s(self) -> int:
        """At the present power; 0: not known."""
        if not self.is_sized or self.current_a <= 0.0:
            return 0
        left_mah = self.remaining * self._parameters.number("BAT1_CAPACITY")
        return max(1, round(min(_TIME_MAX_S, left_mah * 3.6 / self.current_a)))  # in this order NaN gives the limit

    def update(self, rotor_n: Vec4, armed: bool, dt_s: float) -> None:
        """Draw for dt_s the power that rotor thrusts [N] need: as thrust^(3/2), as a rotor in hover does."""
        share = sum((max(n, 0.0) / self._hover_n) ** 1.5 for n in rotor_n) / 4.0
        power_w = _IDLE_W + self._hover_w * share
        self.current_a = power_w / max(self.voltage_v, 1.0)
        drawn_mah = self.current_a * dt_s / 3.6
        self.consumed_mah += drawn_mah
        self.consumed_j += power_w * dt_s
        if self.is_sized:
            self.remaining = max(0.0, self.remaining - drawn_mah / self._parameters.number("BAT1_CAPACITY"))
        elif armed and self._parameters.integer("SIM_BAT_ENABLE") == 1:
            floor = min(1.0, max(0.0, self._parameters.number("SIM_BAT_MIN_PCT") / 100.0))
            step = share * dt_s / max(self._parameters.number("SIM_BAT_DRAIN"), 1.0)
            self.remaining = max(min(floor, self.remaining), self.remaining - step)
        drop_v = self.cells * self._cell_ohm() * self.current_a if self.is_sized else 0.0
        self.voltage_v = max(0.0, self._open_v() - drop_v)

    def _open_v(self) -> float:
        """Give the voltage without load: between BAT1_V_EMPTY and BAT1_V_CHARGED by the charge."""
        empty, full = self._parameters.number("BAT1_V_EMPTY"), self._parameters.number("BAT1_V_CHARGED")
        return self.cells * (empty + self.remaining * (full - empty))

    def _cell_ohm(self) -> float:
        value = self._parameters.number("BAT1_R_INTERNAL")
        return value if value >= 0.0 else _CELL_RESISTANCE_OHM
