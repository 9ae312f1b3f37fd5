"""What becomes of a companion's setpoints: which are taken, which are dropped, and which controller follows them.

Follows PX4's receiver (mavlink_receiver.cpp) and its control mode (ModeUtil/control_mode.cpp), for 1.18 and, where it
differed, 1.13.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

from .codec import AUTOPILOT_COMPONENT, ActuatorControls, AttitudeTarget
from .geodesy import HOME_ALTITUDE_M, local_position
from .inner_loops import ATTITUDE, RATES, STOPPED, TORQUE, Setpoint
from .parameters import Parameters
from .position_loop import PositionSetpoint
from .rotation import Quat, Vec3, from_yaw, multiply, rotate, yaw_of

ROLL_RATE_IGNORE = 1
PITCH_RATE_IGNORE = 2
YAW_RATE_IGNORE = 4
THRUST_BODY_SET = 32
THROTTLE_IGNORE = 64
ATTITUDE_IGNORE = 128

FORCE_SET = 512
YAW_IGNORE = 1024
YAW_RATE_TARGET_IGNORE = 2048
FRAME_LOCAL_NED, FRAME_BODY_NED = 1, 8
FRAME_GLOBAL_INT, FRAME_RELATIVE_INT, FRAME_TERRAIN_INT = 5, 6, 11

# MAV_TYPEs whose scalar thrust PX4 points along -z: quad, coaxial, helicopter, hexa, octo, tri.
# Any other, 0 (generic, PX4's default) included, leaves the thrust at zero without a word.
_SCALAR_THRUST_TYPES = frozenset((2, 3, 4, 13, 14, 15))
TRAJECTORY = -1
"""What is followed when a position, velocity or acceleration came; the inner loops then get an attitude."""
_POSITION, _VELOCITY, _ACCELERATION = 1, 8, 64
"""Lowest of the three ignore bits of each vector."""
_KEPT_US = 200_000
"""So long a trajectory setpoint that the position controller cannot fly leaves the last good one in force."""
_REEVALUATION_US = 500_000
_NO_RATES = (0.0, 0.0, 0.0)
_LEVEL = (1.0, 0.0, 0.0, 0.0)


_NOTHING = (math.nan, math.nan, math.nan)


class PositionTarget(NamedTuple):
    """SET_POSITION_TARGET_LOCAL_NED (84) or _GLOBAL_INT (86) as received; nothing is checked but the length."""

    type_mask: int
    target_system: int
    target_component: int
    frame: int
    p: Vec3
    """Local NED [m]; or latitude and longitude [deg] and altitude [m]."""
    v: Vec3
    a: Vec3
    yaw: float
    yaw_rate: float


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
        self.follows = STOPPED
        """Mode of the setpoints of the controller in charge, or TRAJECTORY."""
        self.look_us = 0
        """Vehicle time from which on `choose` has something to do."""
        self._evaluated_us = 0
        self._delay_us = delay_us
        self.under_way: deque[tuple[int, Setpoint | PositionSetpoint]] = deque()
        """Delayed setpoints, and the vehicle times at which they reach the loops."""
        self._parameters_version = -1
        self._targets: frozenset[tuple[int, int]] = frozenset()
        """Systems and components whose setpoints are taken."""
        self._takes_scalar_thrust = False
        self._is_plain = False
        """Whether a scalar thrust is the thrust, whatever it is."""
        self._attitude: Setpoint | None = None
        self._rates: Setpoint | None = None
        self._torque: Setpoint | None = None
        self._trajectory: PositionSetpoint | None = None
        self._trajectory_us = 0
        self._flyable: PositionSetpoint | None = None
        self._flyable_us = 0
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
        return self.follows in (ATTITUDE, TRAJECTORY)

    @property
    def follows_trajectory(self) -> bool:
        """Whether the position controller is in charge."""
        return self.follows == TRAJECTORY

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
            thrust = message.thrust
            if not self._is_plain or mask & (THRUST_BODY_SET | THROTTLE_IGNORE):
                thrust = self._thrust(message)
            if attitude:
                yaw_rate = math.nan if mask & YAW_RATE_IGNORE else message.rates[2]
                self._publish(Setpoint(ATTITUDE, thrust, _NO_RATES, message.q, yaw_rate, _NO_RATES), now_us)
            if rates:
                p, q, r = message.rates
                body_rates = (p, q, math.nan if mask & YAW_RATE_IGNORE else r)
                setpoint: Setpoint = tuple.__new__(Setpoint, (RATES, thrust, body_rates, _LEVEL, math.nan, _NO_RATES))
                if self._delay_us > 0:
                    self._publish(setpoint, now_us)
                else:
                    self._rates, self._rates_fresh = setpoint, True
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

    def take_position_target(self, message: PositionTarget, now_us: int, active: bool, q: Quat) -> str | None:
        """Take a SET_POSITION_TARGET_LOCAL_NED at the attitude q. Returns what is wrong with it, if anything is."""
        if not self._is_for_us(message.target_system, message.target_component):
            return None
        mask = message.type_mask
        if message.frame == FRAME_LOCAL_NED:
            p = _given(message.p, mask, _POSITION)
            v = _given(message.v, mask, _VELOCITY)
            a = _given(message.a, mask, _ACCELERATION)
        elif message.frame == FRAME_BODY_NED:
            p = _NOTHING
            v = _whole_vector(message.v, mask, _VELOCITY)
            yaw = yaw_of(q)
            north, east = math.cos(yaw), math.sin(yaw)
            v = (v[0] * north - v[1] * east, v[0] * east + v[1] * north, v[2])
            a = rotate(q, _whole_vector(message.a, mask, _ACCELERATION))
        else:
            self.dropped += 1
            return f"SET_POSITION_TARGET_LOCAL_NED coordinate frame {message.frame} unsupported"
        return self._take_trajectory(message, p, v, a, now_us, active)

    def take_global_target(self, message: PositionTarget, now_us: int, active: bool, home: Vec3) -> str | None:
        """Take a SET_POSITION_TARGET_GLOBAL_INT. Returns what is wrong with it, if anything is."""
        if not self._is_for_us(message.target_system, message.target_component):
            return None
        if message.frame not in (FRAME_GLOBAL_INT, FRAME_RELATIVE_INT, FRAME_TERRAIN_INT):
            self.dropped += 1
            return f"SET_POSITION_TARGET_GLOBAL_INT invalid coordinate frame {message.frame}"
        p = _NOTHING
        if not message.type_mask & 7:
            latitude, longitude, altitude_m = message.p
            north, east, down = local_position(latitude, longitude, altitude_m)
            if message.frame == FRAME_RELATIVE_INT:
                # As PX4 computes it: wrong by twice the height of home above the local origin.
                down = (HOME_ALTITUDE_M - home[2]) - altitude_m - HOME_ALTITUDE_M
            elif message.frame == FRAME_TERRAIN_INT:
                down = -altitude_m
            p = (north, east, down)
        v = _given(message.v, message.type_mask, _VELOCITY)
        a = _given(message.a, message.type_mask, _ACCELERATION)
        return self._take_trajectory(message, p, v, a, now_us, active)

    def _take_trajectory(
        self, message: PositionTarget, p: Vec3, v: Vec3, a: Vec3, now_us: int, active: bool
    ) -> str | None:
        mask = message.type_mask
        if mask & FORCE_SET and not _is_empty(a):
            self.dropped += 1
            return "SET_POSITION_TARGET force not supported"
        if _is_empty(p) and _is_empty(v) and _is_empty(a):
            self.dropped += 1
            return "SET_POSITION_TARGET invalid"
        self.accepted += 1
        self.seen_us = now_us
        self._wants = TRAJECTORY
        if active:
            yaw = math.nan if mask & YAW_IGNORE or not math.isfinite(message.yaw) else message.yaw
            without_rate = mask & YAW_RATE_TARGET_IGNORE or not math.isfinite(message.yaw_rate)
            yaw_rate = math.nan if without_rate else message.yaw_rate
            self._publish(PositionSetpoint(p, v, a, yaw, yaw_rate), now_us)
        return None

    def trajectory(self, now_us: int) -> PositionSetpoint | None:
        """Give what the position controller shall fly; None: nothing came yet.

        A setpoint with an axis about which it says nothing, or with one of x and y alone, cannot be flown: the last
        good one stays in force for a moment, then the vehicle stops.
        """
        self._deliver(now_us)
        setpoint = self._trajectory
        if setpoint is None:
            return None
        if _is_flyable(setpoint):
            self._flyable, self._flyable_us = setpoint, now_us
            return setpoint
        if self._flyable is not None and now_us - self._flyable_us <= _KEPT_US:
            return self._flyable
        return PositionSetpoint(_NOTHING, (0.0, 0.0, 0.0), _NOTHING, math.nan, 0.0)

    @property
    def wants_trajectory(self) -> bool:
        """Whether the last message was one for the position controller: it needs an estimate of the position."""
        return self._wants == TRAJECTORY

    def shift(self, dp_m: Vec3, dv_m_s: Vec3, dyaw_rad: float) -> None:
        """Move the setpoints in force along with an estimate that has jumped, as PX4 does.

        Nothing moves for the jump until the next setpoint comes, which is meant in the new frame.
        """
        if self._trajectory is not None:
            self._trajectory = _shifted(self._trajectory, dp_m, dv_m_s, dyaw_rad)
        if self._flyable is not None:
            self._flyable = _shifted(self._flyable, dp_m, dv_m_s, dyaw_rad)
        if self._attitude is not None and dyaw_rad != 0.0:
            self._attitude = self._attitude._replace(q=multiply(from_yaw(dyaw_rad), self._attitude.q))

    def enter(self, now_us: int) -> None:
        """Start following: the vehicle has changed to OFFBOARD. What was held from earlier is not used again."""
        self.under_way.clear()
        self._attitude = self._rates = self._torque = None
        self._trajectory = self._flyable = None
        self._attitude_fresh = self._rates_fresh = self._torque_fresh = False
        self.evaluate(now_us)

    def evaluate(self, now_us: int) -> None:
        """Choose the controller from the last message's type, as PX4 does at 2 Hz and at any change of its status."""
        self.follows = self._wants
        self._evaluated_us = now_us
        self._set_look()

    def _set_look(self) -> None:
        """Set the time of the next look at what is under way, or at who is in charge."""
        self.look_us = self._evaluated_us + _REEVALUATION_US
        if self.under_way:
            self.look_us = min(self.look_us, self.under_way[0][0])

    def _deliver(self, now_us: int) -> None:
        """Let the delayed setpoints arrive whose time has come."""
        while self.under_way and self.under_way[0][0] <= now_us:
            self._arrive(self.under_way.popleft()[1])

    def choose(self, now_us: int) -> None:
        """Look at 2 Hz whether another controller shall be in charge; before `look_us` there is nothing to do."""
        self._deliver(now_us)
        if now_us - self._evaluated_us >= _REEVALUATION_US:
            self.evaluate(now_us)
        else:
            self._set_look()

    def order(self, held: Setpoint) -> Order:
        """Give the setpoint for the next tick, for which it is chosen (`choose`) who is in charge.

        `held` is what the loops follow already, and go on with when nothing came.

        A setpoint is held until it is replaced. One of another type than the controller in charge is either not looked
        at (rates are followed, an attitude comes) or overwritten at once by the controller in charge (an attitude is
        followed, rates come: mask 0, or the time until the next evaluation).
        """
        glimpse: Setpoint | None = None
        setpoint, fresh = self._rates, self._rates_fresh
        if self.follows == ATTITUDE:
            setpoint, fresh = self._attitude, self._attitude_fresh
            glimpse = self._rates if self._rates_fresh else None
        elif self.follows == TORQUE:
            setpoint, fresh = self._torque, self._torque_fresh
        self._attitude_fresh = self._rates_fresh = self._torque_fresh = False
        if setpoint is None:
            return Order(held, False, glimpse)
        return Order(setpoint, fresh, glimpse)

    def _publish(self, setpoint: Setpoint | PositionSetpoint, now_us: int) -> None:
        """Send a setpoint on its way to the loops."""
        if self._delay_us > 0:
            self._deliver(now_us)  # nobody asks for them while the rotors stand still, and they must not pile up
            self.under_way.append((now_us + self._delay_us, setpoint))
            self._set_look()
        else:
            self._arrive(setpoint)

    def _arrive(self, setpoint: Setpoint | PositionSetpoint) -> None:
        """Put a setpoint on its topic."""
        if isinstance(setpoint, PositionSetpoint):
            self._trajectory = setpoint
        elif setpoint.mode == RATES:
            self._rates, self._rates_fresh = setpoint, True
        elif setpoint.mode == ATTITUDE:
            self._attitude, self._attitude_fresh = setpoint, True
        else:
            self._torque, self._torque_fresh = setpoint, True

    def _is_for_us(self, system: int, component: int) -> bool:
        """Check the target as the receiver does; MAV_FWDEXTSP = 0 shuts external setpoints off altogether."""
        if self._parameters.version != self._parameters_version:
            self._obey_parameters()
        return (system, component) in self._targets

    def _obey_parameters(self) -> None:
        """Take over what the parameters say."""
        parameters = self._parameters
        self._parameters_version = parameters.version
        ours = ((system, component) for system in (0, self._system) for component in (0, AUTOPILOT_COMPONENT))
        self._targets = frozenset(ours if parameters.integer("MAV_FWDEXTSP") == 1 else ())
        self._takes_scalar_thrust = parameters.integer("MAV_TYPE") in _SCALAR_THRUST_TYPES
        self._is_plain = self._takes_scalar_thrust and not self._legacy

    def _thrust(self, message: AttitudeTarget) -> float:
        """Give the collective thrust; NaN goes through in 1.18, where it stops the rotors; in 1.13 it is no thrust."""
        if message.type_mask & THRUST_BODY_SET:
            thrust = -message.thrust_body[2]
        elif message.type_mask & THROTTLE_IGNORE:
            thrust = 0.0
        elif self._takes_scalar_thrust:
            thrust = message.thrust
        else:
            thrust = 0.0
        return 0.0 if self._legacy and math.isnan(thrust) else thrust


def _given(vector: Vec3, mask: int, first_bit: int) -> Vec3:
    """Give a vector with NaN on the axes that the mask ignores, or that hold no number."""
    nan, is_number = math.nan, math.isfinite
    x, y, z = vector
    return (
        nan if mask & first_bit or not is_number(x) else x,
        nan if mask & first_bit << 1 or not is_number(y) else y,
        nan if mask & first_bit << 2 or not is_number(z) else z,
    )


def _whole_vector(vector: Vec3, mask: int, first_bit: int) -> Vec3:
    """Give a vector, or nothing when the mask ignores any axis: so PX4 does in the body frame."""
    return _NOTHING if mask & 7 * first_bit or not all(map(math.isfinite, vector)) else vector


def _shifted(setpoint: PositionSetpoint, dp: Vec3, dv: Vec3, dyaw: float) -> PositionSetpoint:
    """Move a setpoint; what it says nothing about stays so."""
    p, v, a, yaw, yaw_rate = setpoint
    p = (p[0] + dp[0], p[1] + dp[1], p[2] + dp[2])
    return PositionSetpoint(p, (v[0] + dv[0], v[1] + dv[1], v[2] + dv[2]), a, yaw + dyaw, yaw_rate)


def _is_empty(vector: Vec3) -> bool:
    return all(map(math.isnan, vector))


def _is_flyable(setpoint: PositionSetpoint) -> bool:
    """Tell whether the position controller has something on every axis, and x only together with y."""
    is_number = math.isfinite
    north = east = down = False
    for x, y, z in (setpoint.p, setpoint.v, setpoint.a):
        has_x, has_y = is_number(x), is_number(y)
        if has_x is not has_y:
            return False
        north, east, down = north or has_x, east or has_y, down or is_number(z)
    return north and east and down
