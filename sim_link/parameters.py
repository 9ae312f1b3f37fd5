"""The parameters of the simulated autopilot: PX4's names, types and defaults.

`DEFAULTS` is PX4's multicopter set as far as this vehicle obeys it or a companion reads it before a flight. Values are
kept as the 32-bit types that MAVLink carries, so that what is read back is what was set.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping

INT32 = 6
"""MAV_PARAM_TYPE_INT32"""
REAL32 = 9
"""MAV_PARAM_TYPE_REAL32"""
UINT32 = 5
"""MAV_PARAM_TYPE_UINT32, of _HASH_CHECK only"""

HASH_CHECK = "_HASH_CHECK"

# An int literal makes an INT32, a float literal a REAL32.
DEFAULTS: dict[str, int | float] = {
    "CBRK_FLIGHTTERM": 121212,
    "CBRK_SUPPLY_CHK": 0,
    "COM_ARMABLE": 1,
    "COM_ARM_WO_GPS": 1,
    "COM_DISARM_LAND": 2.0,
    "COM_DISARM_PRFLT": 10.0,
    "COM_DLL_EXCEPT": 0,
    "COM_DL_LOSS_T": 10,
    "COM_FAIL_ACT_T": 5.0,
    "COM_FLTMODE_BOOT": 4,
    "COM_LOW_BAT_ACT": 0,
    "COM_OBL_RC_ACT": 0,
    "COM_OF_LOSS_T": 1.0,
    "COM_POS_FS_ACT": 0,
    "COM_POS_FS_EPH": 5.0,
    "COM_QC_ACT": 0,
    "COM_RCL_EXCEPT": 0,
    "COM_RC_IN_MODE": 1,
    "COM_RC_LOSS_T": 0.5,
    "COM_SPOOLUP_TIME": 1.0,
    "COM_VEL_FS_EVH": 1.0,
    "EKF2_HGT_REF": 1,
    "FD_ALT_LOSS": 0.0,
    "FD_FAIL_P": 60,
    "FD_FAIL_P_TTRI": 0.3,
    "FD_FAIL_R": 60,
    "FD_FAIL_R_TTRI": 0.3,
    "GF_ACTION": 2,
    "GF_MAX_HOR_DIST": 0.0,
    "GF_MAX_VER_DIST": 0.0,
    "GF_SOURCE": 0,
    "IMU_DGYRO_CUTOFF": 20.0,
    "IMU_GYRO_CUTOFF": 40.0,
    "MAN_OVERRIDE_SPD": 1.0,
    "MAV_COMP_ID": 1,
    "MAV_FWDEXTSP": 1,
    "MAV_SYS_ID": 1,
    "MAV_TYPE": 2,
    "MC_AIRMODE": 0,
    "MC_BAT_SCALE_EN": 0,
    "MC_PITCHRATE_D": 0.003,
    "MC_PITCHRATE_FF": 0.0,
    "MC_PITCHRATE_I": 0.2,
    "MC_PITCHRATE_K": 1.0,
    "MC_PITCHRATE_MAX": 220.0,
    "MC_PITCHRATE_P": 0.15,
    "MC_PITCH_P": 4.0,
    "MC_REF_FF": 0.0,
    "MC_REF_FF_MAX": 100.0,
    "MC_REF_W_N": 50.0,
    "MC_ROLLRATE_D": 0.003,
    "MC_ROLLRATE_FF": 0.0,
    "MC_ROLLRATE_I": 0.2,
    "MC_ROLLRATE_K": 1.0,
    "MC_ROLLRATE_MAX": 220.0,
    "MC_ROLLRATE_P": 0.15,
    "MC_ROLL_P": 4.0,
    "MC_YAWRATE_D": 0.0,
    "MC_YAWRATE_FF": 0.0,
    "MC_YAWRATE_I": 0.1,
    "MC_YAWRATE_K": 1.0,
    "MC_YAWRATE_MAX": 200.0,
    "MC_YAWRATE_P": 0.2,
    "MC_YAW_P": 2.8,
    "MC_YAW_WEIGHT": 0.4,
    "MIS_TAKEOFF_ALT": 2.5,
    "MPC_ACC_DOWN_MAX": 3.0,
    "MPC_ACC_HOR": 3.0,
    "MPC_ACC_HOR_MAX": 5.0,
    "MPC_ACC_UP_MAX": 4.0,
    "MPC_JERK_AUTO": 4.0,
    "MPC_LAND_SPEED": 0.7,
    "MPC_MANTHR_MIN": 0.08,
    "MPC_THR_HOVER": 0.5,
    "MPC_THR_MAX": 1.0,
    "MPC_THR_MIN": 0.12,
    "MPC_THR_XY_MARG": 0.3,
    "MPC_TILTMAX_AIR": 45.0,
    "MPC_TILTMAX_LND": 12.0,
    "MPC_TKO_RAMP_T": 3.0,
    "MPC_TKO_SPEED": 1.5,
    "MPC_VELD_LP": 5.0,
    "MPC_XY_CRUISE": 5.0,
    "MPC_XY_P": 0.95,
    "MPC_XY_VEL_D_ACC": 0.2,
    "MPC_XY_VEL_I_ACC": 0.4,
    "MPC_XY_VEL_MAX": 12.0,
    "MPC_XY_VEL_P_ACC": 1.8,
    "MPC_Z_P": 1.0,
    "MPC_Z_VEL_D_ACC": 0.0,
    "MPC_Z_VEL_I_ACC": 2.0,
    "MPC_Z_VEL_MAX_DN": 1.5,
    "MPC_Z_VEL_MAX_UP": 3.0,
    "MPC_Z_VEL_P_ACC": 4.0,
    "NAV_DLL_ACT": 0,
    "NAV_RCL_ACT": 2,
    "RTL_DESCEND_ALT": 10.0,
    "RTL_LAND_DELAY": 0.0,
    "RTL_RETURN_ALT": 30.0,
    "SYS_AUTOSTART": 10016,
    "SYS_FAILURE_EN": 1,
    "SYS_HITL": 0,
    "THR_MDL_FAC": 0.0,
}

_NOT_IN_1_13 = ("MAN_OVERRIDE_SPD", "MC_REF_FF", "MC_REF_FF_MAX", "MC_REF_W_N")
_ONLY_IN_1_13: dict[str, int | float] = {"COM_OBC_LOSS_T": 5.0, "COM_RC_OVERRIDE": 1, "MPC_USE_HTE": 1}


class ParameterError(ValueError):
    """A parameter that cannot be set; `code` is the MAV_PARAM_ERROR that says why."""

    DOES_NOT_EXIST = 1
    OUT_OF_RANGE = 2
    PERMISSION_DENIED = 3
    READ_ONLY = 5
    TYPE_MISMATCH = 7

    def __init__(self, code: int, sentence: str) -> None:
        super().__init__(sentence)
        self.code = code


class Parameters:
    """Named 32-bit values in the order of their names, as PX4 lists them."""

    def __init__(self, px4: str = "1.18", overrides: Mapping[str, int | float] | None = None) -> None:
        self.px4 = px4
        """The version whose set this is."""
        values = dict(DEFAULTS)
        if px4 == "1.13":
            for name in _NOT_IN_1_13:
                del values[name]
            values |= _ONLY_IN_1_13
        self._values = {name: _as_32_bit(values[name]) for name in sorted(values)}
        self._names = list(self._values)
        self._index = {name: index for index, name in enumerate(self._names)}
        self.version = 0
        """Counts the changes, so that users of a value can cache it."""
        for name, value in (overrides or {}).items():
            self.set(name, value)

    def __len__(self) -> int:
        return len(self._names)

    @property
    def names(self) -> list[str]:
        """All names, in the order of their indices."""
        return list(self._names)

    def __contains__(self, name: object) -> bool:
        return name in self._values

    def __getitem__(self, name: str) -> int | float:
        return self._values[name]

    def number(self, name: str) -> float:
        """Give a value as a float."""
        return float(self._values[name])

    def integer(self, name: str) -> int:
        """Give a value as an int."""
        return int(self._values[name])

    def name_at(self, index: int) -> str | None:
        """Give the name at a MAVLink parameter index; None beyond the end."""
        return self._names[index] if 0 <= index < len(self._names) else None

    def within(self, name: str, low: float, high: float) -> float:
        """Give a value as a float, limited as the module that uses it limits it; NaN becomes the lower limit."""
        value = self.number(name)
        return min(value, high) if value >= low else low

    def index_of(self, name: str) -> int:
        """Give the MAVLink parameter index of a name."""
        return self._index[name]

    def type_of(self, name: str) -> int:
        """Give INT32 or REAL32."""
        return INT32 if isinstance(self._values[name], int) else REAL32

    def set(self, name: str, value: int | float) -> None:
        """Set a value and keep its type. PX4 checks no range, and neither is one checked here.

        Raises:
            ParameterError: there is no such parameter, or a whole number was expected.
        """
        if name not in self._values:
            raise ParameterError(ParameterError.DOES_NOT_EXIST, f"there is no parameter {name}")
        if isinstance(self._values[name], int):
            if not float(value).is_integer() or not -(2**31) <= value < 2**31:
                raise ParameterError(ParameterError.TYPE_MISMATCH, f"{name} takes a whole number, not {value}")
            self._values[name] = int(value)
        else:
            self._values[name] = _as_32_bit(float(value))
        self.version += 1

    def set_text(self, name: str, text: str) -> None:
        """Set a value written as text (a command line's NAME=VALUE).

        Raises:
            ParameterError: no such parameter, or no number of its type.
        """
        try:
            value: int | float = int(text)
        except ValueError:
            try:
                value = float(text)
            except ValueError:
                raise ParameterError(ParameterError.TYPE_MISMATCH, f"{name} takes a number, not {text!r}") from None
        self.set(name, value)

    def set_wire(self, name: str, kind: int, value: bytes) -> None:
        """Set a value as PARAM_SET carries it: four little-endian bytes, and only with the right type.

        Raises:
            ParameterError: there is no such parameter, or its type is another.
        """
        if name not in self._values:
            raise ParameterError(ParameterError.DOES_NOT_EXIST, f"there is no parameter {name}")
        if kind != self.type_of(name):
            raise ParameterError(
                ParameterError.TYPE_MISMATCH, f"{name} is of MAVLink type {self.type_of(name)}, not {kind}"
            )
        self._values[name] = struct.unpack("<i" if kind == INT32 else "<f", value)[0]
        self.version += 1

    def wire(self, name: str) -> bytes:
        """Give a value as PARAM_VALUE carries it: the four bytes of its own type in the place of a float."""
        value = self._values[name]
        return struct.pack("<i" if isinstance(value, int) else "<f", value)

    def hash_wire(self) -> bytes:
        """Give the pseudo parameter _HASH_CHECK (uint32 over names and values) as PARAM_VALUE carries it."""
        crc = 0
        for name in self._names:
            crc = zlib.crc32(self.wire(name), zlib.crc32(name.encode(), crc))
        return crc.to_bytes(4, "little")


def _as_32_bit(value: int | float) -> int | float:
    """Round a float to what 32 bits hold; overflow becomes infinite as in C."""
    if isinstance(value, int):
        return value
    try:
        return float(struct.unpack("<f", struct.pack("<f", value))[0])
    except OverflowError:
        return float("inf") if value > 0.0 else float("-inf")
