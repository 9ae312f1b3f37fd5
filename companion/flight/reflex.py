"""The answer to an ordinary state in one call: datagram in, setpoint datagram out, all of it compiled.

In flight almost every state is like the one before: sound, in time, of the same estimate, on the trajectory. For these
everything between the socket's two calls is one kernel: frames are checked, the state is judged as `link.telemetry`
judges it, the control step is `flight.fused`, the setpoint is checked as `link.setpoint` checks it, and framed. What
the rest of the program wants to know of it is told afterwards (`FlightLoop`), while the vehicle acts already.

Whatever is not ordinary in any way is declined before anything was changed, and takes the usual way through the
program: other messages, lost frames, rejected states, resets of the estimate, gaps, joins and stops, changes of pace
or parameters, signed links, another output than body rates, plain Python. Both ways give the same setpoints, to the
bit, so a flight does not show which way its states took.
"""

from __future__ import annotations

import math
import struct
from collections.abc import MutableSequence, Sequence
from typing import Any

import numpy as np

from companion import accelerate
from companion.control import history
from companion.control.types import Quat, Vec3, new_record
from companion.control.vectors import rotate_to_inertial
from companion.flight import fused
from companion.flight.fused import flight_step
from companion.link.codec import AUTOPILOT_COMPONENT, MAV_FRAME_LOCAL_NED, ODOMETRY, SET_ATTITUDE_TARGET, TIMESYNC
from companion.link.direct import (
    AT,
    CHILD_FRAME_ID,
    FRAME_ID,
    ODOMETRY_EXTRA,
    ODOMETRY_FLOATS,
    ODOMETRY_MIN,
    PAYLOAD,
    QUALITY,
    RESET_COUNTER,
    SET_ATTITUDE_TARGET_BYTES,
    SET_ATTITUDE_TARGET_EXTRA,
    TIMESYNC_BYTES,
    TIMESYNC_EXTRA,
    byte_at,
    close_frame,
    frame_end,
    long_at,
    write_rates,
    write_time,
)
from companion.link.setpoint import MASK_RATES, RATE_BOUND_RAD_S
from companion.link.telemetry import (
    FAR_AHEAD_US,
    FROZEN_ABOVE,
    MAV_FRAME_BODY_FRD,
    POSITION_MAX_M,
    QUATERNION_LENGTH,
    RATE_MAX_RAD_S,
    SPEED_MAX_M_S,
    VehicleState,
    within,
)
from companion.link.timesync import PACED_INTERVAL_MAX_US

Numbers = tuple[Vec3, Vec3, Quat, Vec3]
"""Position, velocity, quaternion and rates of a message as they came (`link.telemetry`)."""

DECLINED, ANSWERED, UNSENDABLE = 0, 1, 2
"""What `reflex` returns: nothing was done; a setpoint stands in the output; a step was made that gave none."""

# where things stand in the memory, counted in numbers of eight bytes
DATAGRAM = 0
"""The datagram, its first byte at `direct.AT`."""
OUTPUT = 256
"""What is sent, its first byte at `direct.AT`."""
GIVEN = OUTPUT + 16
"""Integers."""
(
    BYTES,  # of the datagram
    IN_SEQ,  # the sequence number that is due from the autopilot
    OUT_SEQ,  # our own next one
    OWN_NS,  # our clock
    LAST_US,  # stamp of the last sound state
    SENT_US,  # stamp of the last state that was answered
    ASKED_US,  # vehicle time of the last request in lockstep; -1 elsewhere
    RESETS,  # the reset counter of the last state
    SILENCE_US,  # a state that comes so long after the last answered one is not answered
    SYSTEM,  # the autopilot's system id
    OWN_SYSTEM,
    OWN_COMPONENT,
) = range(GIVEN, GIVEN + 12)
STAMP_US, OUT_BYTES, ASKED_NS = range(GIVEN + 12, GIVEN + 15)
"""What is told: stamp of the state, length of what is sent, the request in lockstep [ns]."""
FLOATS = GIVEN + 15
"""Floats."""
BEFORE = 0
"""The 13 numbers of the message before, as they came."""
SEEN = BEFORE + 13
"""The 13 numbers of the state: position, velocity, quaternion, rates."""
SIZE = FLOATS + SEEN + 13
DATAGRAM_MAX = 8 * (OUTPUT - DATAGRAM) - AT

_UINT32 = 0xFFFFFFFF
_ODOMETRY_BYTES = ODOMETRY_MIN + 12
_ODOMETRY_LOW = ODOMETRY & 0xFF
_STAMP = slice(10, 18)


def reflex(z: Any, m: Any, h: Any, r: Any) -> int:
    """Answers the state in a datagram, if everything about it is ordinary.

    In lockstep the vehicle's request for our time follows in the same datagram, and our answer follows the setpoint.

    Args:
        z: SIZE integers of eight bytes, laid out as above.
        m: of `fused.flight_step`; knows the reference.
        h: the history (`control.history`).
        r: the curve (`trajectory.curve`); not read where the reference is given.

    Returns:
        DECLINED, ANSWERED or UNSENDABLE.
    """
    bytes_in, floats_in = z[DATAGRAM:OUTPUT].view(np.uint8), z[DATAGRAM:OUTPUT].view(np.float32)
    f = z[FLOATS:SIZE].view(np.float64)
    end, system = AT + z[BYTES], z[SYSTEM]
    stop = frame_end(bytes_in, AT, end, system, ODOMETRY, ODOMETRY_EXTRA)
    if stop == 0 or bytes_in[AT + 4] != z[IN_SEQ]:
        return DECLINED
    if z[ASKED_US] < 0:
        if stop != end:
            return DECLINED
    elif not _asks(z, bytes_in, stop, end):
        return DECLINED
    if not (_sound_message(z, bytes_in) and _sound_state(f, floats_in, bytes_in[PAYLOAD + CHILD_FRAME_ID])):
        return DECLINED
    stamp_s = z[STAMP_US] * 1e-6
    if not 0.0 < stamp_s - m[fused.LAST] <= m[fused.GAP_MAX]:
        return DECLINED
    m[fused.STAMP], m[fused.WHOLE], m[fused.FREEZE] = stamp_s, 1.0, 0.0
    _remember(f, m, floats_in)
    flight_step(m, h, r)
    if not _sendable(m):
        return UNSENDABLE
    _write(z, m, system)
    return ANSWERED


def _asks(z: MutableSequence[int], d: Sequence[int], at: int, end: int) -> bool:
    """Whether the rest of the datagram is the next request of a vehicle in lockstep."""
    if frame_end(d, at, end, z[SYSTEM], TIMESYNC, TIMESYNC_EXTRA) != end or d[at + 4] != (z[IN_SEQ] + 1) & 0xFF:
        return False
    begin = at + 10
    stop = begin + d[at + 1]
    system, component = byte_at(d, begin + 16, stop), byte_at(d, begin + 17, stop)
    if system not in (0, z[OWN_SYSTEM]) or component not in (0, z[OWN_COMPONENT]) or long_at(d, begin, stop) != 0:
        return False
    z[ASKED_NS] = asked_ns = long_at(d, begin + 8, stop)
    return 0 < asked_ns // 1000 - z[ASKED_US] <= PACED_INTERVAL_MAX_US


def _sound_message(z: MutableSequence[int], d: Sequence[int]) -> bool:
    """Whether frames of reference, stamp, quality and reset counter of ODOMETRY are those of an ordinary state."""
    stop = PAYLOAD + d[AT + 1]
    child = d[PAYLOAD + CHILD_FRAME_ID]
    if stop < PAYLOAD + ODOMETRY_MIN or d[PAYLOAD + FRAME_ID] != MAV_FRAME_LOCAL_NED:
        return False
    if child not in (MAV_FRAME_LOCAL_NED, MAV_FRAME_BODY_FRD):
        return False
    if byte_at(d, PAYLOAD + QUALITY, stop) > 0x7F or byte_at(d, PAYLOAD + RESET_COUNTER, stop) != z[RESETS]:
        return False
    z[STAMP_US] = t_us = long_at(d, PAYLOAD, stop)
    if not 0 < t_us - z[LAST_US] <= FAR_AHEAD_US or t_us - z[SENT_US] > z[SILENCE_US]:
        return False
    return z[ASKED_US] < 0 or t_us - z[ASKED_US] <= PACED_INTERVAL_MAX_US


def _sound_state(f: MutableSequence[float], floats: Sequence[float], child: int) -> bool:
    """Takes the state out of the message; whether it can be flown on. Comparisons are such that NaN fails them."""
    i, moves, same = ODOMETRY_FLOATS, 0.0, True
    for k in range(13):
        value = float(floats[i + k])
        f[SEEN + k] = value
        same = same and value == f[BEFORE + k]
        if k >= 7:
            moves = max(moves, abs(value))
    if same and moves > FROZEN_ABOVE:
        return False
    p, v = (f[SEEN], f[SEEN + 1], f[SEEN + 2]), (f[SEEN + 7], f[SEEN + 8], f[SEEN + 9])
    a, b, c, e = f[SEEN + 3], f[SEEN + 4], f[SEEN + 5], f[SEEN + 6]
    w = (f[SEEN + 10], f[SEEN + 11], f[SEEN + 12])
    length = math.sqrt(a * a + b * b + c * c + e * e)
    if not QUATERNION_LENGTH[0] <= length <= QUATERNION_LENGTH[1]:
        return False
    if not (within(p, POSITION_MAX_M) and within(v, SPEED_MAX_M_S) and within(w, RATE_MAX_RAD_S)):
        return False
    q = (a / length, b / length, c / length, e / length)
    if child == MAV_FRAME_BODY_FRD:
        v = rotate_to_inertial(q, v)
    for k in range(3):
        f[SEEN + 3 + k] = v[k]
    for k in range(4):
        f[SEEN + 6 + k] = q[k]
    return True


def _remember(f: MutableSequence[float], m: MutableSequence[float], floats: Sequence[float]) -> None:
    """Gives the step its state, and keeps the message as it came for the next one."""
    for k in range(13):
        m[fused.INPUT + k] = f[SEEN + k]
        f[BEFORE + k] = float(floats[ODOMETRY_FLOATS + k])


def _sendable(m: Sequence[float]) -> bool:
    """The last check before the vehicle, as `setpoint.check` makes it."""
    i = fused.SENT
    return 0.0 <= m[i] <= 1.0 and within((m[i + 1], m[i + 2], m[i + 3]), RATE_BOUND_RAD_S)


def _write(z: Any, m: Sequence[float], system: int) -> None:
    """Frames the setpoint, and in lockstep the answer behind it."""
    o, floats = z[OUTPUT:GIVEN].view(np.uint8), z[OUTPUT:GIVEN].view(np.float32)
    own, target, seq = (z[OWN_SYSTEM], z[OWN_COMPONENT]), (system, AUTOPILOT_COMPONENT), z[OUT_SEQ]
    i = fused.SENT
    rates = (m[i + 1], m[i + 2], m[i + 3])
    write_rates(o, floats, z[STAMP_US] // 1000 & _UINT32, rates, m[i], target, MASK_RATES)
    length, message, extra = SET_ATTITUDE_TARGET_BYTES, SET_ATTITUDE_TARGET, SET_ATTITUDE_TARGET_EXTRA
    stop = close_frame(o, AT, length, seq, own, message, extra)
    if z[ASKED_US] >= 0:
        write_time(o, stop, z[OWN_NS], z[ASKED_NS], target)
        stop = close_frame(o, stop, TIMESYNC_BYTES, (seq + 1) & 0xFF, own, TIMESYNC, TIMESYNC_EXTRA)
    z[OUT_BYTES] = stop - AT


class Reflex:
    """Answers the ordinary states of one flight.

    Args:
        system: the autopilot's system id.
        own: our system and component id.
    """

    def __init__(self, system: int, own: tuple[int, int]) -> None:
        self._z = np.zeros(SIZE, np.int64)
        nothing = (np.zeros(fused.SIZE), np.zeros(history.CAPACITY), np.zeros(fused.NO_CURVE))
        self._kernel = accelerate.compile_for(reflex, self._z, *nothing)
        self._longs = self._z.data
        self._bytes = self._longs.cast("B")
        self._datagram = self._bytes[AT : AT + DATAGRAM_MAX]
        self._output = self._bytes[8 * OUTPUT + AT : 8 * GIVEN]
        self._give = struct.Struct("=9q").pack_into
        self._give_numbers = struct.Struct("=13d").pack_into
        self._told = struct.Struct("=26d").unpack_from
        self._numbers: Numbers | None = None
        """Of the message before, as the memory has them."""
        self._longs[SYSTEM], self._longs[OWN_SYSTEM], self._longs[OWN_COMPONENT] = system, *own

    def take(self, datagram: bytes, given: tuple[int, ...], before: Numbers) -> bool:
        """Takes a datagram that may hold an ordinary state.

        Args:
            datagram: as it came.
            given: what it is judged by: IN_SEQ to SILENCE_US.
            before: the numbers of the message before, as they came.

        Returns:
            Whether it may be one.
        """
        length = len(datagram)
        if not _ODOMETRY_BYTES <= length <= DATAGRAM_MAX or datagram[7] != _ODOMETRY_LOW:
            return False
        t_us = int.from_bytes(datagram[_STAMP], "little")
        if not 0 < t_us - given[LAST_US - IN_SEQ] <= FAR_AHEAD_US:
            return False
        self._datagram[:length] = datagram
        self._give(self._bytes, 8 * GIVEN, length, *given)
        self._longs[STAMP_US] = t_us
        if before is not self._numbers:
            p, v, q, w = before
            self._give_numbers(self._bytes, 8 * (FLOATS + BEFORE), *p, *q, *v, *w)
        return True

    @property
    def stamp_us(self) -> int:
        """Of the state in the datagram that was taken, if it is one [us]."""
        return self._longs[STAMP_US]

    def run(self, m: Any, h: Any, r: Any) -> int:
        """Answers what was taken; see `reflex`.

        Args:
            m: of the step's engine.
            h: the history.
            r: the curve.
        """
        return int(self._kernel(self._z, m, h, r))

    def told(self) -> tuple[VehicleState, Numbers]:
        """The state that was answered, and the numbers of its message as they came."""
        told = self._told(self._bytes, 8 * (FLOATS + BEFORE))
        px, py, pz, qw, qx, qy, qz, vx, vy, vz, wx, wy, wz, x, y, z, v_n, v_e, v_d, a, b, c, d, roll, pitch, yaw = told
        self._numbers = numbers = (px, py, pz), (vx, vy, vz), (qw, qx, qy, qz), (wx, wy, wz)
        t_us, resets = self._longs[STAMP_US], self._longs[RESETS]
        state = (t_us, (x, y, z), (v_n, v_e, v_d), (a, b, c, d), (roll, pitch, yaw), resets)
        return new_record(VehicleState, state), numbers

    @property
    def numbers(self) -> Any:
        """What `reflex` works on."""
        return self._z

    @property
    def output(self) -> memoryview:
        """What is to be sent: the setpoint's frame, in lockstep with the answer's behind it."""
        return self._output[: self._longs[OUT_BYTES]]

    @property
    def asked_ns(self) -> int:
        """The request that was answered, in lockstep [ns]."""
        return self._longs[ASKED_NS]
