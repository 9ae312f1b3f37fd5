"""The certificate of a gain set (docs/law.md section 4): what can be said before the flight, without simulating it.

Inside |e1| <= p_max the closed loop is linear on every axis; V' = -e' Q e and, for all of space, V_H' <= -z' Qr z. Q >
0 and Qr > 0 certify global asymptotic stability while the thrust stays positive. Where the estimator is projected or
frozen the same must hold with the Gamma terms left out, so both forms of both matrices are asked for.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.control.law import Gains

FloatArray = NDArray[np.float64]


def inside_matrix(gains: Gains, drag: float, *, estimator: bool = True) -> FloatArray:
    """Q of V' = -e' Q e for |e1| <= p_max, with drag D; D = 0 gives (35). Shape (4, 4)."""
    k1, k2, k3, k4, d = gains.k1, gains.k2, gains.k3, gains.k4, drag
    g = gains.gamma / (k1 * k1 * k2) if estimator else 0.0
    return np.array(
        [
            [k1, -d / 2, (k1 - d) / 2, (k1 - d) / 2],
            [-d / 2, k1 * (k2 - 1) + d, (d - k1 - g) / 2, (d - k1) / 2],
            [(k1 - d) / 2, (d - k1 - g) / 2, k3 - g, -g / 2],
            [(k1 - d) / 2, (d - k1) / 2, -g / 2, k4],
        ]
    )


def outside_matrix(gains: Gains, drag: float, *, estimator: bool = True) -> FloatArray:
    """Qr of V_H' along e1 for |e1| > p_max, with |sigma| as first coordinate. Shape (4, 4)."""
    k1, k2, k3, k4, d = gains.k1, gains.k2, gains.k3, gains.k4, drag
    g = gains.gamma / (k1 * k1 * k2) if estimator else 0.0
    return np.array(
        [
            [k1, -(k1 + d) / 2, -d / 2, -d / 2],
            [-(k1 + d) / 2, k1 * k2 + d, (d - g) / 2, d / 2],
            [-d / 2, (d - g) / 2, k3 - g, -g / 2],
            [-d / 2, d / 2, -g / 2, k4],
        ]
    )


def linear_loop(gains: Gains, drag: float) -> FloatArray:
    """A of (e1, e2, e3, e4, b_tilde)' = A (...) on one axis, inside (docs/law.md section 3). Shape (5, 5)."""
    k1, k2, k3 = gains.k1, gains.k2, gains.k3
    c0 = 1.0 / (k1 * k1 * k2)
    kk, ks = k1 * k2, k1 * k2 + k3
    estimate = gains.gamma * np.array([0.0, 1.0, 1.0, 1.0, 0.0])
    a = np.zeros((5, 5))
    a[0] = [-k1, k1, 0, 0, 0]
    a[1] = [-(k1 - drag), k1 - drag - kk, kk, 0, 1.0 / k1]
    without_estimate = a[1] + np.array([0, 0, -ks, ks, 0])
    a[2] = without_estimate + c0 * estimate
    a[3] = without_estimate + np.array([0, kk, -kk, -(ks + gains.k4), 0])
    a[4] = -estimate
    return a


def poles(gains: Gains, drag: float) -> list[complex]:
    """The poles of the linear loop [1/s], slowest first; without the estimator's one when Gamma = 0."""
    a = linear_loop(gains, drag)
    if gains.gamma == 0.0:
        a = a[:4, :4]
    return sorted((complex(x) for x in np.linalg.eigvals(a)), key=lambda x: (-x.real, x.imag))


class Certificate(NamedTuple):
    """The eigenvalues that decide, ascending, and the poles."""

    inside: list[float]
    """Of Q with the estimator."""
    inside_frozen: list[float]
    """Of Q with the Gamma terms left out: projected or frozen."""
    outside: list[float]
    outside_frozen: list[float]
    poles: list[complex]

    def failure(self) -> str | None:
        """The first figure that fails, in words; None when the gain set is certified."""
        for name, values in (
            ("Q (inside p_max, estimator on)", self.inside),
            ("Q (inside p_max, estimator off)", self.inside_frozen),
            ("Qr (outside p_max, estimator on)", self.outside),
            ("Qr (outside p_max, estimator off)", self.outside_frozen),
        ):
            if not values[0] > 0.0:
                return f"the smallest eigenvalue of {name} is {values[0]:.4g}, it must be above 0"
        return None


def certify(gains: Gains, drag: float) -> Certificate:
    """The certificate of a gain set for a vehicle with linear drag `drag` [1/s]."""

    def eigenvalues(matrix: FloatArray) -> list[float]:
        return [float(x) for x in np.linalg.eigvalsh(matrix)]

    return Certificate(
        eigenvalues(inside_matrix(gains, drag)),
        eigenvalues(inside_matrix(gains, drag, estimator=False)),
        eigenvalues(outside_matrix(gains, drag)),
        eigenvalues(outside_matrix(gains, drag, estimator=False)),
        poles(gains, drag),
    )


def disturbance_overcome(gains: Gains) -> float:
    """The largest |b/m - b_hat| [m/s^2] that the bounded position error holds against while the estimator stands still.

    With e1 far outside the errors settle where e2' = e3' = e4' = 0; beyond this value they do so only with |sigma| >
    p_max, which does not exist: the vehicle drifts away. Inside the ball B of the estimate it must not come to that.
    """
    k1, k2, k3, k4 = gains.k1, gains.k2, gains.k3, gains.k4
    return gains.p_max / (1.0 / (k1 * k1 * k2) + 1.0 / (k1 * (k1 * k2 + k3 + k4)))


class ThrustBounds(NamedTuple):
    """What (38), corrected, promises of the thrust along a whole flight [N]; conservative, often silent.

    Infinite where it promises nothing, as with the estimator switched off.
    """

    low_n: float
    high_n: float


def thrust_bounds(
    gains: Gains,
    mass: float,
    gravity: float,
    q2_max: float,
    disturbance_max: float,
    lyapunov_start: float,
    b_hat_start: float,
) -> ThrustBounds:
    """The thrust bounds (38), with p_d'' and with k1 under the root.

    Args:
        gains: the gain set.
        mass: [kg].
        gravity: [m/s^2].
        q2_max: max |p_d'' + D p_d'| of the reference [m/s^2].
        disturbance_max: B, with |b/m| <= B [m/s^2].
        lyapunov_start: V_H without its b_tilde term at the start [m^2].
        b_hat_start: |b_hat(0)| [m/s^2].
    """
    k1, k2 = gains.k1, gains.k2
    if gains.gamma == 0.0:  # a disturbance that nobody estimates is not in V: only without one would a bound hold
        return ThrustBounds(-math.inf, math.inf)
    v = lyapunov_start + (disturbance_max + b_hat_start) ** 2 / (2.0 * k1 * gains.gamma)
    swing = q2_max + disturbance_max + math.sqrt((2.0 * k1 * gains.gamma + 4.0 * k1**4 * k2**2) * v)
    return ThrustBounds(mass * (gravity - swing), mass * (gravity + swing))
