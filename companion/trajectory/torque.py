"""The torque that a reference takes, and what the rotors have left for it beside the thrust."""

from __future__ import annotations

from math import dist, hypot, inf
from typing import NamedTuple

from companion.config import Vehicle
from companion.control.types import Reference
from companion.trajectory.flatness import SPECIFIC_THRUST_MIN_M_S2, Demand, PointMass, demand
from companion.trajectory.shapes import Joint


class Body(NamedTuple):
    """What torque depends on."""

    inertia_kg_m2: float
    """The larger one of roll and pitch: which of them a turn is about depends on the heading."""
    lever_m: float
    """Torque about the worst level axis per newton that rotors are moved from their share of the thrust."""
    rotor_max_n: float
    """Thrust of one rotor at full command."""


def body(vehicle: Vehicle) -> Body:
    """Return what torque depends on, of a vehicle file.

    With each rotor moved by at most h, rolling takes |tau_x| / sum |y_i|, pitching |tau_y| / sum |x_i|, together at
    most h: the worst direction is diagonal to both.
    """
    roll, pitch = sum(map(abs, vehicle.rotors.y_m)), sum(map(abs, vehicle.rotors.x_m))
    lever = 1.0 / hypot(1.0 / roll, 1.0 / pitch) if roll > 0.0 and pitch > 0.0 else 0.0
    return Body(max(vehicle.body.inertia_kg_m2[:2]), lever, vehicle.rotors.thrust_max_n)


def torque_n_m(needs: Demand, of: Body) -> float:
    """Return the roll and pitch torque that a reference takes [N m]."""
    return of.inertia_kg_m2 * needs.angular_acceleration_rad_s2


def limit_n_m(needs: Demand, of: Body) -> float:
    """Return what the rotors have for it at the reference's thrust [N m]; none where the thrust is all they have."""
    share_n = needs.thrust_n / 4.0
    return of.lever_m * max(0.0, min(share_n, of.rotor_max_n - share_n))


def use(reference: Reference, model: PointMass, of: Body) -> float:
    """Return the share of the torque there is that a reference takes: above 1 it cannot be flown."""
    needs = demand(reference, model)
    taken, limit = torque_n_m(needs, of), limit_n_m(needs, of)
    if taken == 0.0:
        return 0.0
    return taken / limit if limit > 0.0 else inf


class Step(NamedTuple):
    """A jump of the fourth derivative, and what it does."""

    at_s: float
    snap_m_s4: float
    angular_acceleration_rad_s2: float
    """By which the angular acceleration that the reference asks for jumps (roll and pitch part)."""
    torque_n_m: float


def step(joint: Joint, model: PointMass, of: Body) -> Step:
    """Return the jump at a joint whose position, velocity, acceleration and jerk are continuous."""
    at_s, before, after = joint
    d, v, a = model.drag_1_s, after.v, after.a
    f = (-a[0] - d * v[0], -a[1] - d * v[1], model.gravity_m_s2 - a[2] - d * v[2])
    length = hypot(*f)
    jump = (after.s[0] - before.s[0], after.s[1] - before.s[1], after.s[2] - before.s[2])
    if length < SPECIFIC_THRUST_MIN_M_S2:
        return Step(at_s, hypot(*jump), inf, inf)
    r = (f[0] / length, f[1] / length, f[2] / length)
    along = jump[0] * r[0] + jump[1] * r[1] + jump[2] * r[2]
    across = dist(jump, (along * r[0], along * r[1], along * r[2])) / length
    return Step(at_s, hypot(*jump), across, of.inertia_kg_m2 * across)
