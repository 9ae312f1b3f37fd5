"""The law's vectors and rotations against numpy and scipy."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from law_cases import numbers, quaternions, vectors
from scipy.spatial.transform import Rotation

from companion.control import vectors as v


def rotation(q):
    return Rotation.from_quat(q, scalar_first=True)


@given(a=vectors(3.0), b=vectors(3.0), s=numbers(-2.0, 2.0))
def test_sums_and_products(a, b, s):
    x, y = np.array(a), np.array(b)
    assert v.add(a, b) == tuple(x + y)
    assert v.sub(a, b) == tuple(x - y)
    assert v.scale(s, a) == tuple(s * x)
    assert v.dot(a, b) == pytest.approx(x @ y)
    assert v.cross(a, b) == pytest.approx(tuple(np.cross(x, y)))
    assert v.norm(a) == pytest.approx(np.linalg.norm(x))


@given(q=quaternions, a=vectors(3.0))
def test_rotations_between_body_and_world(q, a):
    matrix = rotation(q).as_matrix()
    columns = v.axes(q)
    assert np.array(columns) == pytest.approx(matrix.T)
    assert v.rotate_to_inertial(q, a) == pytest.approx(tuple(matrix @ np.array(a)), abs=1e-12)
    assert v.rotate_to_body(q, a) == pytest.approx(tuple(matrix.T @ np.array(a)), abs=1e-12)


@given(p=quaternions, q=quaternions)
def test_a_product_turns_by_the_second_then_by_the_first(p, q):
    assert rotation(v.quat_multiply(p, q)).as_matrix() == pytest.approx((rotation(p) * rotation(q)).as_matrix())


@given(
    direction=vectors(1.0), angle=st.one_of(numbers(0.0, 6.0), st.sampled_from([0.0, 1e-9, 1e-7, 1.9e-6, 2.1e-6, 1e-4]))
)
def test_a_rotation_vectors_quaternion_is_exact_also_where_it_hardly_turns(direction, angle):
    size = v.norm(direction)
    if size < 0.1:
        return
    unit = v.scale(1.0 / size, direction)
    found = v.quat_exp(v.scale(angle, unit))
    expected = (math.cos(angle / 2), *v.scale(math.sin(angle / 2), unit))
    assert found[0] == pytest.approx(expected[0], abs=1e-15)
    assert found[1:] == pytest.approx(expected[1:], rel=2e-14, abs=1e-24)


@given(q=quaternions, s=numbers(0.1, 9.0))
def test_a_normalised_quaternion_has_length_one_and_its_direction(q, s):
    assert v.quat_normalise(tuple(s * x for x in q)) == pytest.approx(q)


@given(x=numbers(-9.0, 9.0), low=numbers(-5.0, 0.0), high=numbers(0.0, 5.0))
def test_clip(x, low, high):
    assert v.clip(x, low, high) == float(np.clip(x, low, high))
