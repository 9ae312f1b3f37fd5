"""What a study can vary, and how: the variables with their allowed ranges, and the distributions and grids."""

from __future__ import annotations

import math
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field, model_validator

from companion.config import Section

Number = Annotated[float, Field(allow_inf_nan=False)]
Pair = tuple[Number, Number]
REDRAWS_MAX = 1000
GRID_MAX = 10_000


class Variable(NamedTuple):
    """One quantity that may differ from flight to flight."""

    low: float
    high: float
    meaning: str
    """For people, with what it counts from."""
    open_low: bool = False
    """Whether `low` itself is not allowed."""

    @property
    def allowed(self) -> str:
        """The range in words."""
        if math.isinf(self.low) and math.isinf(self.high):
            return "any number"
        if math.isinf(self.high):
            return f"{'above' if self.open_low else 'at least'} {self.low:g}"
        return f"{'above ' if self.open_low else ''}{self.low:g} to {self.high:g}"

    def admits(self, value: float) -> bool:
        """Whether a value is in the range."""
        return (value > self.low if self.open_low else value >= self.low) and value <= self.high


_ANY = (-math.inf, math.inf)
_GAIN = (0.01, 100.0)

VARIABLES: dict[str, Variable] = {
    "start.north_m": Variable(-1e4, 1e4, "start position, NED"),
    "start.east_m": Variable(-1e4, 1e4, "start position, NED"),
    "start.down_m": Variable(-1e4, 1e4, "start position, NED; below 0 where there is a ground"),
    "start.yaw_deg": Variable(*_ANY, "heading at the start, clockwise from north"),
    "start.velocity_north_m_s": Variable(-100.0, 100.0, "velocity at the start"),
    "start.velocity_east_m_s": Variable(-100.0, 100.0, "velocity at the start"),
    "start.velocity_down_m_s": Variable(-100.0, 100.0, "velocity at the start"),
    "start.tilt_deg": Variable(0.0, 180.0, "tilt at the start; above 90 the vehicle is upside down"),
    "start.tilt_towards_deg": Variable(*_ANY, "where the thrust leans to, clockwise from north"),
    "start.roll_rate_rad_s": Variable(-50.0, 50.0, "body rate at the start"),
    "start.pitch_rate_rad_s": Variable(-50.0, 50.0, "body rate at the start"),
    "start.yaw_rate_rad_s": Variable(-50.0, 50.0, "body rate at the start"),
    "world.wind_m_s": Variable(0.0, 100.0, "mean speed of the air, horizontal"),
    "world.wind_towards_deg": Variable(*_ANY, "where it blows to, clockwise from north"),
    "world.wind_down_m_s": Variable(-50.0, 50.0, "vertical speed of the air, positive downwards"),
    "world.turbulence": Variable(0.0, 10.0, "Dryden gusts: standard deviation as a share of the mean wind"),
    "world.force_north_n": Variable(-1e4, 1e4, "constant force"),
    "world.force_east_n": Variable(-1e4, 1e4, "constant force"),
    "world.force_down_n": Variable(-1e4, 1e4, "constant force"),
    "world.gravity_factor": Variable(0.0, 10.0, "gravity over 9.81 m/s^2", open_low=True),
    "vehicle.mass_factor": Variable(0.0, 10.0, "true mass over the vehicle file's", open_low=True),
    "vehicle.thrust_factor": Variable(0.0, 10.0, "true thrust of the rotors over the vehicle file's", open_low=True),
    "vehicle.drag_factor": Variable(0.0, 100.0, "true drag over the vehicle file's"),
    "vehicle.inertia_factor": Variable(0.0, 100.0, "true inertia over the vehicle file's", open_low=True),
    "vehicle.rate_lag_factor": Variable(0.0, 100.0, "true lag of the rate loops over the file's", open_low=True),
    "vehicle.rotor_lag_factor": Variable(0.0, 100.0, "true lag of the rotors over the file's"),
    "vehicle.state_age_s": Variable(0.0, 0.5, "age of the states; the companion knows it, for it measures it"),
    "vehicle.unknown_delay_s": Variable(0.0, 0.5, "delay of the commands that the companion does not know of"),
    "vehicle.noise_factor": Variable(0.0, 1e3, "noise of the states over the vehicle file's"),
    "controller.k1_1_s": Variable(*_GAIN, "gain"),
    "controller.k2": Variable(*_GAIN, "gain"),
    "controller.k3_1_s": Variable(*_GAIN, "gain"),
    "controller.k4_1_s": Variable(*_GAIN, "gain"),
    "controller.gamma_1_s3": Variable(0.0, 1000.0, "gain of the estimator; 0 switches it off"),
    "controller.position_error_max_m": Variable(0.0, 1e4, "p_max", open_low=True),
    "controller.heading_l1_1_s": Variable(0.0, 100.0, "heading gain", open_low=True),
    "controller.heading_l2_1_s": Variable(0.0, 100.0, "heading gain", open_low=True),
    "controller.heading_damping_1_s": Variable(0.0, 100.0, "heading gain", open_low=True),
    "trajectory.time_scale": Variable(0.0, 100.0, "how many times as fast", open_low=True),
}
"""Every variable by its key path below [vary]."""
NAMES = {"trajectory.name": "trajectory files or bundled names"}
"""Variables whose values are texts: only `choice` and `constant` go with them."""


class Spread(Section):
    """How one variable is spread over the flights; exactly one of the keys."""

    constant: Number | str | None = None
    """The same in every flight."""
    uniform: Pair | None = None
    """From low to high."""
    normal: Pair | None = None
    """Mean and standard deviation; what falls out of the variable's range is drawn again."""
    log_uniform: Pair | None = None
    """From low to high, uniform in the logarithm."""
    choice: tuple[Number | str, ...] | None = None
    """One of these, equally likely."""
    grid: tuple[Number, Number, int] | None = None
    """From low to high in so many values: all combinations of all grids are flown."""

    @model_validator(mode="after")
    def _one(self) -> Spread:
        kinds = [name for name in type(self).model_fields if getattr(self, name) is not None]
        if len(kinds) != 1:
            allowed = ", ".join(type(self).model_fields)
            raise ValueError(f"must have exactly one of the keys {allowed}, has {', '.join(kinds) or 'none'}")
        return self

    @property
    def kind(self) -> str:
        """The key that is set."""
        return next(name for name in type(self).model_fields if getattr(self, name) is not None)

    def grid_values(self) -> list[float]:
        """The values of a grid."""
        assert self.grid is not None
        low, high, count = self.grid
        return [float(x) for x in np.linspace(low, high, count)]

    def draw(self, random: np.random.Generator, variable: Variable) -> float:
        """A value of a variable that is a number; not for grids."""
        if self.uniform is not None:
            low, high = self.uniform
            return low + (high - low) * float(random.random())
        if self.log_uniform is not None:
            low, high = (math.log(x) for x in self.log_uniform)
            return math.exp(low + (high - low) * float(random.random()))
        if self.normal is not None:
            mean, sigma = self.normal
            for _ in range(REDRAWS_MAX):
                value = mean + sigma * float(random.standard_normal())
                if variable.admits(value):
                    return value
            return mean
        if self.choice is not None:
            return float(self.choice[int(random.integers(len(self.choice)))])
        assert self.constant is not None
        return float(self.constant)

    def draw_name(self, random: np.random.Generator) -> str:
        """A value of a variable that is a text."""
        if self.choice is not None:
            return str(self.choice[int(random.integers(len(self.choice)))])
        return str(self.constant)


def problem(name: str, spread: Spread) -> str | None:
    """What is wrong with a variable's spread, in words, after its key path; None: nothing."""
    value: Any = getattr(spread, spread.kind)
    shown = f"{spread.kind} = {list(value) if isinstance(value, tuple) else value!r}"
    if name in NAMES:
        texts = value if isinstance(value, tuple) else (value,)
        if spread.kind in ("choice", "constant") and texts and all(isinstance(x, str) for x in texts):
            return None
        return f"{shown}: must be a constant or a choice of {NAMES[name]}"
    variable = VARIABLES[name]
    numbers = value if isinstance(value, tuple) else (value,)
    if not numbers or not all(isinstance(x, int | float) for x in numbers):
        return f"{shown}: must be numbers"
    if spread.kind in ("uniform", "log_uniform", "grid") and not value[0] <= value[1]:
        return f"{shown}: the first number must not be above the second"
    if spread.kind == "log_uniform" and not value[0] > 0.0:
        return f"{shown}: both must be above 0"
    if spread.kind == "grid":
        count = value[2]
        if not 1 <= count <= GRID_MAX:
            return f"{shown}: the third number is how many values, 1 to {GRID_MAX}"
        numbers = value[:2]
    if spread.kind == "normal":
        if value[1] < 0.0:
            return f"{shown}: the standard deviation must be 0 or more"
        numbers = value[:1]
    for number in numbers:
        if not variable.admits(number):
            return f"{shown}: {number:g} is impossible, allowed is {variable.allowed} ({variable.meaning})"
    return None
