"""From normalised torque and thrust to four rotor commands: PX4's sequential desaturation with MC_AIRMODE = 0.

Priorities, first to last: no rotor beyond its range; roll and pitch over collective thrust at the upper limit;
collective thrust over roll and pitch at the lower limit (torque is reduced, thrust never raised); everything over
yaw, except that yaw may ask for 15 % beyond the upper limit, which the collective then pays for.

Scalar code on tuples: runs as plain Python, compiles with numba unchanged.
"""

from __future__ import annotations

import math

from .loop_gains import LoopGains
from .rotation import Vec3, Vec4, clip

_YAW_HEADROOM = 0.15
"""Share of the range by which yaw may exceed it before the collective is reduced for it."""
_TINY = 1.0e-9
_STOPPED: Vec4 = (0.0, 0.0, 0.0, 0.0)


def _scaled(direction: Vec4, amount: float) -> Vec4:
    return (direction[0] * amount, direction[1] * amount, direction[2] * amount, direction[3] * amount)


def _sum(a: Vec4, b: Vec4) -> Vec4:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3])


def _thrust_reduction(shares: Vec4, mix_thrust: Vec4) -> float:
    """Return by how much collective to go down so that no rotor exceeds 1.

    Where going all that way would push a rotor below 0, the excess is split evenly between both ends. Never negative.
    """
    excess = max(
        (shares[0] - 1.0) / mix_thrust[0],
        (shares[1] - 1.0) / mix_thrust[1],
        (shares[2] - 1.0) / mix_thrust[2],
        (shares[3] - 1.0) / mix_thrust[3],
    )
    if excess <= 0.0:
        return 0.0
    slack = min(
        shares[0] / mix_thrust[0],
        shares[1] / mix_thrust[1],
        shares[2] / mix_thrust[2],
        shares[3] / mix_thrust[3],
    )
    if excess <= slack:
        return excess
    return max(0.0, 0.5 * (excess + slack))


def _room(base: float, added: float, upper: float) -> float:
    """Return the largest factor within 0..1 on `added` that keeps base + factor added within 0..upper."""
    total = base + added
    if total > upper and added > _TINY:
        return max(0.0, (upper - base) / added)
    if total < 0.0 and added < -_TINY:
        return max(0.0, base / -added)
    return 1.0


def _fitting(base: Vec4, added: Vec4, upper: float) -> float:
    """Return the largest factor within 0..1 on `added` that keeps all four of base + factor added within 0..upper."""
    return min(
        _room(base[0], added[0], upper),
        _room(base[1], added[1], upper),
        _room(base[2], added[2], upper),
        _room(base[3], added[3], upper),
    )


def _within_range(shares: Vec4) -> bool:
    """Return whether no rotor is beyond its range: then there is nothing to desaturate."""
    a, b, c, d = shares
    return 0.0 <= a <= 1.0 and 0.0 <= b <= 1.0 and 0.0 <= c <= 1.0 and 0.0 <= d <= 1.0


def allocate(torque: Vec3, thrust: float, gains: LoopGains) -> tuple[Vec4, Vec3]:
    """Return each rotor's share of its full thrust, and the share of each torque that was delivered.

    Args:
        torque: normalised roll, pitch, yaw torque (`loop_gains.normalisation`), finite.
        thrust: collective thrust as a share of the maximum; below 0 is idle, above 1 is full; NaN stops all rotors
            (PX4's control_allocator disarms the outputs while it lasts).
        gains: holds the mix.

    Returns:
        Rotor thrust shares 0..1, and the factors 0..1 by which (roll, pitch, yaw) were scaled.
    """
    if math.isnan(thrust):
        return _STOPPED, (0.0, 0.0, 0.0)
    lift = _scaled(gains.mix_thrust, clip(thrust, 0.0, 1.0))
    tilt = _sum(_scaled(gains.mix_roll, torque[0]), _scaled(gains.mix_pitch, torque[1]))
    turn = _scaled(gains.mix_yaw, torque[2])
    shares = _sum(lift, tilt)
    turned = _sum(shares, turn)
    if _within_range(shares) and _within_range(turned):
        return turned, (1.0, 1.0, 1.0)
    lift = _sum(lift, _scaled(gains.mix_thrust, -_thrust_reduction(shares, gains.mix_thrust)))
    tilt_share = _fitting(lift, tilt, 1.0)
    shares = _sum(lift, _scaled(tilt, tilt_share))
    turn_share = _fitting(shares, turn, 1.0 + _YAW_HEADROOM)
    shares = _sum(shares, _scaled(turn, turn_share))
    shares = _sum(shares, _scaled(gains.mix_thrust, -_thrust_reduction(shares, gains.mix_thrust)))
    limited = (
        clip(shares[0], 0.0, 1.0),
        clip(shares[1], 0.0, 1.0),
        clip(shares[2], 0.0, 1.0),
        clip(shares[3], 0.0, 1.0),
    )
    return limited, (tilt_share, tilt_share, turn_share)


def rotor_command(share: float, curve_factor: float) -> float:
    """Return the command u 0..1 for a share of full thrust 0..1: the root of f u^2 + (1 - f) u = share."""
    if share <= 0.0:
        return 0.0
    linear = 1.0 - curve_factor
    return 2.0 * share / (linear + math.sqrt(linear * linear + 4.0 * curve_factor * share))
