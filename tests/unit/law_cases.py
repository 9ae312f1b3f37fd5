"""Random but sensible inputs of the law, shared by its tests."""

import math

from hypothesis import strategies as st

from companion.control.heading import SIDESLIP, HeadingState
from companion.control.law import Gains, Limits, Model, Parameters
from companion.control.types import Reference, State
from companion.control.vectors import quat_normalise

PAPER_GAINS = Gains(0.7, 4.0, 3.0, 4.0, 2.0, 5.0, SIDESLIP, 1.0, 1.0, 2.0)
NO_LIMITS = Limits(1e-3, 1e9, (1e9, 1e9, 1e9), 1e9, 1e9, 1e-9)
MASS = 4.76
ZERO = (0.0, 0.0, 0.0)


def parameters(gains: Gains = PAPER_GAINS, drag: float = 0.0, limits: Limits = NO_LIMITS) -> Parameters:
    return Parameters(gains, Model(MASS, 9.81, drag, ZERO, ZERO, 0.0), limits)


def memory() -> HeadingState:
    return HeadingState((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), False)


def eight(t: float, rate: float = 0.2) -> Reference:
    """The paper's figure of eight, written down once more, by hand."""
    c, s = math.cos(rate * t), math.sin(rate * t)
    c2, s2 = math.cos(2 * rate * t), math.sin(2 * rate * t)
    n = rate
    return Reference(
        (5 * c - 5, 2.5 * s2, -10.0),
        (-5 * n * s, 5 * n * c2, 0.0),
        (-5 * n**2 * c, -10 * n**2 * s2, 0.0),
        (5 * n**3 * s, -20 * n**3 * c2, 0.0),
        (5 * n**4 * c, 40 * n**4 * s2, 0.0),
        0.3 + 0.1 * t,
        0.1,
        0.0,
    )


def rising(t: float) -> Reference:
    """The same, up and down as well: nothing of it is zero."""
    flat, n = eight(t), 0.3
    c, s = math.cos(n * t + 0.4), math.sin(n * t + 0.4)
    waves = (1.2 * s, 1.2 * n * c, -1.2 * n**2 * s, -1.2 * n**3 * c, 1.2 * n**4 * s)
    lifted = ((x, y, z + wave) for (x, y, z), wave in zip(flat[:5], waves, strict=True))
    return Reference(*lifted, *flat[5:])


def numbers(low: float, high: float):
    return st.floats(low, high, allow_nan=False, allow_infinity=False)


def vectors(size: float):
    return st.tuples(numbers(-size, size), numbers(-size, size), numbers(-size, size))


quaternions = st.tuples(numbers(0.3, 1.0), numbers(-0.4, 0.4), numbers(-0.4, 0.4), numbers(-1.0, 1.0)).map(
    quat_normalise
)
near_states = st.builds(State, vectors(1.5), vectors(1.0), quaternions, vectors(0.5))
far_states = st.builds(State, vectors(40.0), vectors(4.0), quaternions, vectors(1.0))
