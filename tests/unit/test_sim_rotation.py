"""Rotation maths against matrices and scipy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sim_link import rotation as r

VECTORS = [
    (0.3, -1.2, 2.0),
    (1e-5, 2e-5, -1e-5),
    (0.0, 0.0, 0.0),
    (0.0, 3.0, 0.5),
    (1e-4, 0.0, 0.0),
    (9.9e-5, 0.0, 0.0),
]


def matrix(q: r.Quat) -> np.ndarray:
    return Rotation.from_quat([q[1], q[2], q[3], q[0]]).as_matrix()


@pytest.mark.parametrize("a", VECTORS)
def test_exponential_and_logarithm_agree_with_scipy(a: r.Vec3) -> None:
    q = r.exponential(a)
    assert np.allclose(matrix(q), Rotation.from_rotvec(a).as_matrix(), atol=1e-15)
    assert sum(c * c for c in q) == pytest.approx(1.0, abs=1e-15)
    assert r.logarithm(q) == pytest.approx(a, abs=1e-14)
    assert r.logarithm((-q[0], -q[1], -q[2], -q[3])) == pytest.approx(a, abs=1e-14)


def test_rotations_agree_with_the_matrix() -> None:
    q = r.normalised((0.4, -0.3, 0.8, 0.1))
    p = r.normalised((-0.2, 0.5, 0.1, 0.9))
    a = (0.3, -2.0, 1.5)
    assert r.rotate(q, a) == pytest.approx(tuple(matrix(q) @ a), abs=1e-14)
    assert r.rotate_back(q, a) == pytest.approx(tuple(matrix(q).T @ a), abs=1e-14)
    assert np.allclose(matrix(r.multiply(q, p)), matrix(q) @ matrix(p), atol=1e-14)
    assert r.body_z(q) == pytest.approx(tuple(matrix(q)[:, 2]), abs=1e-14)
    assert r.inertial_z_in_body(q) == pytest.approx(tuple(matrix(q)[2]), abs=1e-14)
    assert r.multiply(q, r.conjugate(q)) == pytest.approx((1.0, 0.0, 0.0, 0.0), abs=1e-15)


def test_yaw_is_clockwise_from_north() -> None:
    east = r.from_yaw(math.pi / 2)
    assert r.rotate(east, (1.0, 0.0, 0.0)) == pytest.approx((0.0, 1.0, 0.0), abs=1e-15)
    assert r.yaw_of(r.multiply(r.from_yaw(2.5), r.exponential((0.0, 0.4, 0.0)))) == pytest.approx(2.5)


def test_no_attitude_is_nan_and_not_an_exception() -> None:
    for q in ((0.0, 0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 1.0), (math.inf, 0.0, 0.0, 0.0)):
        assert all(math.isnan(c) for c in r.normalised(q))
    assert r.normalised((0.0, 0.0, 3.0, 4.0)) == pytest.approx((0.0, 0.0, 0.6, 0.8))


def test_clip_keeps_nan() -> None:
    assert r.clip(2.0, -1.0, 1.0) == 1.0
    assert r.clip(-2.0, -1.0, 1.0) == -1.0
    assert math.isnan(r.clip(math.nan, -1.0, 1.0))
