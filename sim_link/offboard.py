"""What becomes of a companion's setpoints: which are taken, which are dropped, and which controller follows them.

Follows PX4's receiver (mavlink_receiver.cpp) and its control mode (ModeUtil/control_mode.cpp), for 1.18 and, where it
differed, 1.13.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

from .codec import AUTOPILOT_COMPONENT, ActuatorControls, AttitudeTarget
from .inner_loops import ATTITUDE, RATES, STOPPED, TORQUE, Setpoint
from .parameters import Parameters

ROLL_RATE_IGNORE = 1
PITCH_RATE_IGNORE = 2
YAW_RATE_IGNORE = 4
THRUST_BODY_SET = 32
THROTTLE_IGNORE = 64
ATTITUDE_IGNORE = 128

# MAV_TYPEs whose scalar thrust PX4 points along -z: quad, coaxial, helicopter, hexa, octo, tri.
# Any other, 0 (generic, PX4's default) included, leaves the thrust at zero without a word.
_SCALAR_THRUST_TYPES = frozenset((2, 3, 4, 13, 14, 15))
_REEVALUATION_US = 500_000
_NO_RATES = (0.0, 0.0, 0.0)
_LEVEL = (1.0, 0.0, 0.0, 0.0)


class Order(NamedTuple):
    """What the inner loops get for one tick."""

    setpoint: Setpoint
    fresh: bool
    """Whether `setpoint` arrived since the last tick."""
    glimpse: Setpoint | None = None
    """A setpoint that another publisher overwrites after one step of the loops."""


class Offboard:
    """The offboard inputs: the sign of life (PX4's offboard_control_mode) and the setpoint topics behind it."""

    def __init__(self, parameters: Parameters, px4: str, system: int, delay_us: int = 0) -> None:
        """Begin without any setpoint; delay_us: from a setpoint's arrival until the loops get it."""
        self._parameters = parameters
        self._system = system
        self._legacy = px4 == "1.13"
        self.seen_us: int | None = None
        """Vehicle time of the last accepted setpoint message; it counts in every flight mode."""
        self.accepted = 0
        self.dropped = 0
        self._wants = STOPPED
        self._follows = STOPPED
        self._evaluated_us = 0
        self._delay_us = delay_us
        self._under_way: deque[tuple[int, Setpoint]] = deque()
        self._attitude: Setpoint | None = None
        self._rates: Setpoint | None = None
        self._torque: Setpoint | None = None
        self._attitude_fresh = False
        self._rates_fresh = False
        self._torque_fresh = False

    def signal_ok(self, now_us: int) -> bool:
        """Tell whether the last accepted setpoint is younger than COM_OF_LOSS_T."""
        if self.seen_us is None:
            return False
        return (now_us - self.seen_us) * 1e-6 <= self._parameters.number("COM_OF_LOSS_T")

    @property
    def controls_attitude(self) -> bool:
        """Whether the attitude controller runs: PX4's failure detector looks at the tilt only then."""
        return self._follows == ATTITUDE

    def take_attitude_target(self, message: AttitudeTarget, now_us: int, active: bool) -> bool:
        """Take a SET_ATTITUDE_TARGET; `active`: the vehicle is in OFFBOARD. Returns whether it was accepted.

        time_boot_ms and the sender are not looked at, values are not checked: PX4 does neither.
        """
        if not self._is_for_us(message.target_system, message.target_component):
            return False
        mask = message.type_mask
        attitude = not mask & ATTITUDE_IGNORE
        rates = not mask & ROLL_RATE_IGNORE and not mask & PITCH_RATE_IGNORE
        has_thrust = not mask & THROTTLE_IGNORE or bool(mask & THRUST_BODY_SET)
        if self._legacy:
            rates = rates and not attitude  # attitude had exclusive priority, and thrust was not mandatory
            has_thrust = True
        if not ((attitude or rates) and has_thrust):
            self.dropped += 1
            return False
        self.accepted += 1
        self.seen_us = now_us
        self._wants = ATTITUDE if attitude else RATES
        if active:
            thrust = self._thrust(message)
            if attitude:
                yaw_rate = math.nan if mask & YAW_RATE_IGNORE else message.rates[2]
                self._publish(Setpoint(ATTITUDE, thrust, _NO_RATES, message.q, yaw_rate, _NO_RATES), now_us)
            if rates:
                p, q, r = message.rates
                body_rates = (p, q, math.nan if mask & YAW_RATE_IGNORE else r)
                self._publish(Setpoint(RATES, thrust, body_rates, _LEVEL, math.nan, _NO_RATES), now_us)
        return True

    def take_actuator_controls(self, message: ActuatorControls, now_us: int, active: bool) -> bool:
        """Take a SET_ACTUATOR_CONTROL_TARGET: PX4 up to 1.13 obeys group 0, later ones do not know the message."""
        if not self._legacy or not self._is_for_us(message.target_system, message.target_component):
            return False
        if message.group != 0:
            return False
        self.accepted += 1
        self.seen_us = now_us
        self._wants = TORQUE
        if active:
            roll, pitch, yaw, thrust = (x if math.isfinite(x) else 0.0 for x in message.controls[:4])
            self._publish(Setpoint(TORQUE, thrust, _NO_RATES, _LEVEL, math.nan, (roll, pitch, yaw)), now_us)
        return True

    def enter(self, now_us: int) -> None:
        """Start following: the vehicle has changed to OFFBOARD. What was held from earlier is not used again."""
        self._under_way.clear()
        self._attitude = self._rates = self._torque = None
        self._attitude_fresh = self._rates_fresh = self._torque_fresh = False
        self.evaluate(now_us)

    def evaluate(self, now_us: int) -> None:
        """Choose the controller from the last message's type, as PX4 does at 2 Hz and at any change of its status."""
        self._follows = self._wants
        self._evaluated_us = now_us

    def order(self, now_us: int, held: Setpoint) -> Order:
        """Give the setpoint for the next tick; `held`: what the loops follow already, and go on with when nothing came.

        A setpoint is held until it is replaced. One of another type than the controller in charge is either not looked
        at (rates are followed, an attitude comes) or overwritten at once by the controller in charge (an attitude is
        followed, rates come: mask 0, or the time until the next evaluation).
        """
        while self._under_way and self._under_way[0][0] <= now_us:
            self._arrive(self._under_way.popleft()[1])
        if now_us - self._evaluated_us >= _REEVALUATION_US:
            self.evaluate(now_us)
        glimpse: Setpoint | None = None
        setpoint, fresh = self._rates, self._rates_fresh
        if self._follows == ATTITUDE:
            setpoint, fresh = self._attitude, self._attitude_fresh
            glimpse = self._rates if self._rates_fresh else None
        elif self._follows == TORQUE:
            setpoint, fresh = self._torque, self._torque_fresh
        self._attitude_fresh = self._rates_fresh = self._torque_fresh = False
        if setpoint is None:
            return Order(held, False, glimpse)
        return Order(setpoint, fresh, glimpse)

    @property
    def next_us(self) -> int | None:
        """Vehicle time at which the next delayed setpoint reaches the loops."""
        return self._under_way[0][0] if self._under_way else None

    def _publish(self, setpoint: Setpoint, now_us: int) -> None:
        """Send a setpoint on its way to the loops."""
        if self._delay_us > 0:
            self._under_way.append((now_us + self._delay_us, setpoint))
        else:
            self._arrive(setpoint)

    def _arrive(self, setpoint: Setpoint) -> None:
        """Put a setpoint on its topic."""
        if setpoint.mode == ATTITUDE:
            self._attitude, self._attitude_fresh = setpoint, True
        elif setpoint.mode == RATES:
            self._rates, self._rates_fresh = setpoint, True
        else:
            self._torque, self._torque_fresh = setpoint, True

    def _is_for_us(self, system: int, component: int) -> bool:
        """Check the target as the receiver does; MAV_FWDEXTSP = 0 shuts external setpoints off altogether."""
        return (
            system in (0, self._system)
            and component in (0, AUTOPILOT_COMPONENT)
            and self._parameters.integer("MAV_FWDEXTSP") == 1
        )

    def _thrust(self, message: AttitudeTarget) -> float:
        """Give the collective thrust; NaN goes through in 1.18, where it stops the rotors; in 1.13 it is no thrust."""
        if message.type_mask & THRUST_BODY_SET:
            thrust = -message.thrust_body[2]
        elif message.type_mask & THROTTLE_IGNORE:
            thrust = 0.0
        elif self._parameters.integer("MAV_TYPE") in _SCALAR_THRUST_TYPES:
            thrust = message.thrust
        else:
            thrust = 0.0
        return 0.0 if self._legacy and math.isnan(thrust) else thrust
