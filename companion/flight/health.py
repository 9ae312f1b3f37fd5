"""What the autopilot says about its own health: SYS_STATUS and ESTIMATOR_STATUS, as far as a flight depends on them.

PX4 fills SYS_STATUS from its arming checks: PREARM_CHECK says whether it would arm in its present mode, the radio is
"present" while manual control is live, whatever its source. ESTIMATOR_STATUS is of the estimator that is flown on.
"""

from __future__ import annotations

import math
from enum import IntFlag
from typing import Any, Final, NamedTuple

SYS_STATUS: Final = 1
ESTIMATOR_STATUS: Final = 230

_RC_RECEIVER = 1 << 16  # MAV_SYS_STATUS_SENSOR, as the next two
_GEOFENCE = 1 << 20
_PREARM_CHECK = 1 << 28


class SystemHealth(NamedTuple):
    """SYS_STATUS."""

    sticks: bool
    """Whether manual control is live."""
    fence_kept: bool | None
    """Whether the vehicle is within the autopilot's fence; None: it does not say."""
    can_arm: bool
    """Whether it would arm in its present mode."""
    battery: float | None
    """Share that is left in the emptiest battery; None: unknown."""

    @classmethod
    def from_message(cls, message: Any) -> SystemHealth:
        """Reads pymavlink's message."""
        present, healthy = message.onboard_control_sensors_present, message.onboard_control_sensors_health

        fence_kept = bool(healthy & _GEOFENCE) if present & _GEOFENCE else None
        remaining = message.battery_remaining
        battery = 1e-2 * remaining if remaining >= 0 else None
        # PX4 says of PREARM_CHECK that it is healthy, never that it is present.
        return cls(bool(present & _RC_RECEIVER), fence_kept, bool(healthy & _PREARM_CHECK), battery)


class EstimatorFlag(IntFlag):
    """ESTIMATOR_STATUS_FLAGS."""

    ATTITUDE = 1
    VELOCITY_HORIZONTAL = 2
    VELOCITY_VERTICAL = 4
    POSITION_HORIZONTAL_RELATIVE = 8
    POSITION_HORIZONTAL_ABSOLUTE = 16
    POSITION_VERTICAL_ABSOLUTE = 32
    POSITION_VERTICAL_ABOVE_GROUND = 64
    CONSTANT_POSITION_MODE = 128
    GPS_GLITCH = 1024
    ACCELEROMETER_ERROR = 2048


class EstimatorHealth(NamedTuple):
    """ESTIMATOR_STATUS."""

    flags: EstimatorFlag
    velocity_ratio: float
    """Innovation test ratio: at 1 and above measurements are rejected."""
    position_ratio: float
    """The same of the horizontal position."""
    height_ratio: float
    """The same of the height."""
    heading_ratio: float
    """The same of the heading."""
    accuracy_m: float
    """Of the horizontal position, one sigma [m]."""

    @classmethod
    def from_message(cls, message: Any) -> EstimatorHealth:
        """Reads pymavlink's message."""
        return cls(
            EstimatorFlag(message.flags & sum(EstimatorFlag)),
            message.vel_ratio,
            message.pos_horiz_ratio,
            message.pos_vert_ratio,
            message.mag_ratio,
            message.pos_horiz_accuracy,
        )

    def lacking(self, *, in_air: bool) -> list[str]:
        """What a flight needs of the estimate and does not have, for people.

        On the ground PX4's estimator may well go by the vehicle's being at rest.
        """
        flags, names = self.flags, []
        for needed, name in _NEEDED:
            if not flags & needed:
                names.append(f"no {name}")
        if in_air and flags & EstimatorFlag.CONSTANT_POSITION_MODE:
            names.append("it only holds a constant position")
        if flags & EstimatorFlag.ACCELEROMETER_ERROR:
            names.append("bad accelerometer data")
        return names

    @property
    def worst(self) -> tuple[str, float]:
        """The largest test ratio and what it is of; one that is no number counts as unbounded."""
        ratios = {
            "velocity": self.velocity_ratio,
            "position": self.position_ratio,
            "height": self.height_ratio,
            "heading": self.heading_ratio,
        }
        name = max(ratios, key=lambda of: math.inf if math.isnan(ratios[of]) else ratios[of])
        return name, math.inf if math.isnan(ratios[name]) else ratios[name]


_NEEDED = (
    (EstimatorFlag.ATTITUDE, "attitude"),
    (EstimatorFlag.VELOCITY_HORIZONTAL, "horizontal velocity"),
    (EstimatorFlag.VELOCITY_VERTICAL, "vertical velocity"),
    (EstimatorFlag.POSITION_HORIZONTAL_RELATIVE | EstimatorFlag.POSITION_HORIZONTAL_ABSOLUTE, "horizontal position"),
    (EstimatorFlag.POSITION_VERTICAL_ABSOLUTE | EstimatorFlag.POSITION_VERTICAL_ABOVE_GROUND, "height"),
)
"""One bit of each is needed."""
