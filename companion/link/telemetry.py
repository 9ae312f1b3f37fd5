"""From state messages to a state that may be flown on, or the reason why not.

ODOMETRY carries position, velocity, attitude and rates under one stamp. PX4 sends its velocity in NED (child frame
LOCAL_NED); others send it in body axes (BODY_FRD); every other frame is refused rather than guessed: the wrong one
flies well to the north and crashes to the south.
"""

from __future__ import annotations

import math
from enum import Enum
from typing import Final, NamedTuple

from companion.control.types import Quat, Vec3, new_record
from companion.control.vectors import rotate_to_inertial
from companion.link.codec import decode_attitude_quaternion, decode_odometry
from companion.link.framing import Frame

MAV_FRAME_LOCAL_NED: Final = 1
MAV_FRAME_BODY_FRD: Final = 12

_VELOCITY_FRAMES: Final = frozenset((MAV_FRAME_LOCAL_NED, MAV_FRAME_BODY_FRD))

QUATERNION_LENGTH: Final = (0.9, 1.1)
"""Within, a quaternion is normalised; outside it is no attitude."""
POSITION_MAX_M: Final = 1e6
SPEED_MAX_M_S: Final = 200.0
RATE_MAX_RAD_S: Final = 100.0  # gyros end at 35 rad/s

REBOOT_UPTIME_US: Final = 10_000_000
"""A stamp below this after one beyond it is a clock that started again."""
FAR_BACK_US: Final = 2_000_000
"""Stamps further back than any network delays them: a reboot too, once several in a row say so."""
FAR_AHEAD_US: Final = 10_000_000
"""A stamp further ahead must be confirmed by the next one: a single wrong one would shut out all that follow."""
CONFIRMATIONS: Final = 3
FROZEN_ABOVE: Final = 1e-3
"""A vehicle that says it moves or turns faster than this [m/s, rad/s] is somewhere else in the next state."""


class StateRejection(Enum):
    """Why a state message was not used; the value is the sentence for people."""

    NOT_FROM_AUTOPILOT = "the state came from another system or component than the autopilot"
    UNKNOWN_FRAME = "the state is in a frame that is not supported (position LOCAL_NED, velocity LOCAL_NED or BODY_FRD)"
    NO_STAMP = "the state has no time stamp"
    REPEATED = "the state has the same time stamp as the one before"
    FROZEN = "the state is number for number the one before, though the vehicle moves: the estimate stands still"
    BACK_IN_TIME = "the state is older than the one before"
    FAR_AHEAD = "the state's time stamp jumped ahead by more than 10 s"
    REBOOTED = "the autopilot's clock started again: it was rebooted"
    ESTIMATOR_FAILED = "the autopilot says that its estimate has failed"
    NOT_FINITE = "the state holds numbers that are not finite"
    ZERO_QUATERNION = "the attitude quaternion does not have unit length"
    ABSURD_MAGNITUDE = "the state is beyond anything a multirotor does (1000 km, 200 m/s or 100 rad/s)"

    @property
    def sentence(self) -> str:
        """The reason for people."""
        return self.value


class VehicleState(NamedTuple):
    """What the autopilot says about the vehicle at one instant."""

    t_vehicle_us: int
    """The autopilot's clock [us since its boot]."""
    p: Vec3
    """Position, local NED [m]."""
    v: Vec3
    """Velocity, NED [m/s]."""
    q: Quat
    """Attitude, body to NED, unit length."""
    w: Vec3
    """Body rates, FRD [rad/s]."""
    reset_counter: int
    """Changes (mod 256) when the estimator jumps."""


class AttitudeSample(NamedTuple):
    """What ATTITUDE_QUATERNION says: newer than the last state, but only half of one."""

    t_vehicle_us: int
    """The autopilot's clock, with the millisecond's resolution of the message [us]."""
    q: Quat
    """Attitude, body to NED, unit length."""
    w: Vec3
    """Body rates, FRD [rad/s]."""


class Telemetry:
    """Judges the autopilot's state messages, and counts."""

    def __init__(self, system_id: int, component_id: int = 1) -> None:
        """The ids are the autopilot's."""
        self.system_id = system_id
        self.component_id = component_id
        self.accepted = 0
        """States taken."""
        self.rejected: dict[StateRejection, int] = dict.fromkeys(StateRejection, 0)
        """Messages not taken, by reason."""
        self._last_us: int | None = None
        self.numbers: tuple[Vec3, Vec3, Quat, Vec3] | None = None
        """Of the last ODOMETRY whose stamp was sound, as they came."""
        self._ahead_us: int | None = None
        self._back_us: int | None = None
        self._back_count = 0
        self._rebooted = False
        self._attitude_us = -1

    @property
    def last_t_vehicle_us(self) -> int | None:
        """Stamp of the newest accepted state."""
        return self._last_us

    def on_odometry(self, frame: Frame) -> VehicleState | StateRejection:
        """Judge an ODOMETRY frame."""
        state = self._read_odometry(frame)
        if isinstance(state, StateRejection):
            self.rejected[state] += 1
        else:
            self._last_us = state.t_vehicle_us
            self.accepted += 1
        return state

    def took(self, t_us: int, numbers: tuple[Vec3, Vec3, Quat, Vec3]) -> None:
        """A state was judged elsewhere by the same rules, and taken.

        Args:
            t_us: its stamp [us].
            numbers: of its message, as they came.
        """
        self._last_us, self.numbers = t_us, numbers
        self._back_us, self._back_count, self._ahead_us = None, 0, None
        self.accepted += 1

    @property
    def sound(self) -> bool:
        """Whether states have come, and no reboot is known."""
        return self._last_us is not None and not self._rebooted

    def _read_odometry(self, frame: Frame) -> VehicleState | StateRejection:
        """The state in the message, or what is wrong with it."""
        if frame.sysid != self.system_id or frame.compid != self.component_id:
            return StateRejection.NOT_FROM_AUTOPILOT
        t_us, frame_id, child, p, attitude, v, w, reset_counter, _, quality = decode_odometry(frame.payload)
        if frame_id != MAV_FRAME_LOCAL_NED or child not in _VELOCITY_FRAMES:
            return StateRejection.UNKNOWN_FRAME
        late = self._judge_stamp(t_us)
        if late is not None:
            return late
        numbers, before = (p, v, attitude, w), self.numbers
        self.numbers = numbers
        if numbers == before and max(map(abs, (*v, *w))) > FROZEN_ABOVE:
            return StateRejection.FROZEN
        if quality < 0:
            return StateRejection.ESTIMATOR_FAILED
        q = _unit(attitude)
        if isinstance(q, StateRejection):
            return q
        if not (within(p, POSITION_MAX_M) and within(v, SPEED_MAX_M_S)):
            return _unusable(p, v)
        if not within(w, RATE_MAX_RAD_S):
            return _unusable(w)
        if child == MAV_FRAME_BODY_FRD:
            v = rotate_to_inertial(q, v)
        return new_record(VehicleState, (t_us, p, v, q, w, reset_counter))

    def _judge_stamp(self, t_us: int) -> StateRejection | None:
        """Whether time goes on as it should. A recognised reboot stays until `restart`."""
        last_us = self._last_us
        if self._rebooted:
            return StateRejection.REBOOTED
        if t_us == 0:
            return StateRejection.NO_STAMP
        if last_us is None:
            return None
        if t_us <= last_us:
            return self._judge_old_stamp(t_us, last_us)
        self._back_us, self._back_count = None, 0
        if t_us - last_us > FAR_AHEAD_US:
            ahead_us, self._ahead_us = self._ahead_us, t_us
            if ahead_us is None or not 0 < t_us - ahead_us <= FAR_AHEAD_US:
                return StateRejection.FAR_AHEAD
        self._ahead_us = None
        return None

    def _judge_old_stamp(self, t_us: int, last_us: int) -> StateRejection:
        """Tell a late datagram from a clock that started again."""
        if t_us == last_us:
            return StateRejection.REPEATED
        if last_us - t_us > FAR_BACK_US:
            advancing = self._back_us is not None and t_us > self._back_us
            self._back_us = t_us
            self._back_count = self._back_count + 1 if advancing else 1
            if (t_us < REBOOT_UPTIME_US <= last_us) or self._back_count >= CONFIRMATIONS:
                self._rebooted = True
                return StateRejection.REBOOTED
        return StateRejection.BACK_IN_TIME

    def on_attitude(self, frame: Frame) -> AttitudeSample | StateRejection:
        """Judge an ATTITUDE_QUATERNION frame; its stamps are compared with its own kind's."""
        sample = self.read_attitude(frame)
        if isinstance(sample, StateRejection):
            self.rejected[sample] += 1
        elif self._last_us is not None:  # before the first state nothing says whether the stamp is sound
            self._attitude_us = sample.t_vehicle_us
        return sample

    def read_attitude(self, frame: Frame) -> AttitudeSample | StateRejection:
        """The attitude in an ATTITUDE_QUATERNION frame, or what is wrong with it; nothing is counted or remembered."""
        if frame.sysid != self.system_id or frame.compid != self.component_id:
            return StateRejection.NOT_FROM_AUTOPILOT
        message = decode_attitude_quaternion(frame.payload)
        t_us = message.time_boot_ms * 1000
        if self._rebooted:
            return StateRejection.REBOOTED
        if t_us <= self._attitude_us:
            return StateRejection.REPEATED if t_us == self._attitude_us else StateRejection.BACK_IN_TIME
        if self._last_us is not None and t_us - self._last_us > FAR_AHEAD_US:
            return StateRejection.FAR_AHEAD
        q = _unit(message.q)
        if isinstance(q, StateRejection):
            return q
        if not within(message.w, RATE_MAX_RAD_S):
            return _unusable(message.w)
        return AttitudeSample(t_us, q, message.w)

    def restart(self) -> None:
        """Forget the past (not the counts): after a recognised reboot, before a new flight."""
        self._last_us = self._ahead_us = self._back_us = None
        self.numbers = None
        self._back_count = 0
        self._rebooted = False
        self._attitude_us = -1


def within(a: Vec3, bound: float) -> bool:
    """Whether every component is within +-bound; NaN is not."""
    x, y, z = a
    return -bound <= x <= bound and -bound <= y <= bound and -bound <= z <= bound


def _unusable(*vectors: Vec3) -> StateRejection:
    """Why vectors are out of bounds."""
    finite = all(math.isfinite(part) for vector in vectors for part in vector)
    return StateRejection.ABSURD_MAGNITUDE if finite else StateRejection.NOT_FINITE


def _unit(q: Quat) -> Quat | StateRejection:
    """The quaternion at unit length, or why it is no attitude."""
    w, x, y, z = q
    length = math.sqrt(w * w + x * x + y * y + z * z)
    least, most = QUATERNION_LENGTH
    if least <= length <= most:
        return (w / length, x / length, y / length, z / length)
    return StateRejection.ZERO_QUATERNION if math.isfinite(length) else StateRejection.NOT_FINITE
