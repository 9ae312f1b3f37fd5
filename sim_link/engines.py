"""What moves the simulated vehicle: its physics steps, its loops and its estimator, plain or compiled.

Both engines run `inner_loops.advance_step` and `estimator.with_noise`, and give the same numbers. The plain one holds
tuples; the compiled one holds the array of `flat` and enters compiled code once per call, for all of its steps.
"""

from __future__ import annotations

import struct
from typing import Any, NamedTuple, Protocol

import numpy as np

from . import flat
from .accelerate import ENGINES, available, compile_kernel
from .estimator import Estimate, Estimator, NoiseBlocks, age_steps, noise_of
from .inner_loops import Setpoint, advance_step, initial_loops
from .loop_gains import LoopGains
from .physics import Body, RigidState
from .rotation import Vec3
from .vehicle_file import VehicleFile


class Setup(NamedTuple):
    """What an engine starts from."""

    vehicle: VehicleFile
    rigid: RigidState
    """State at the start, and for as long before as the estimator is late."""
    body: Body
    gains: LoopGains
    ground_d_m: float
    on_ground: bool
    t_us: int
    """Vehicle time at the start."""
    dt_us: int
    """One step."""
    seed: int
    """Of the estimator's noise."""


class Engine(Protocol):
    """The vehicle's motion."""

    air_m_s: Vec3
    """Velocity of the air, NED; may be changed between calls, as the next two."""
    force_n: Vec3
    """Force from outside, NED."""
    gains: LoopGains

    @property
    def rigid(self) -> RigidState:
        """True mechanical state."""

    @property
    def rates(self) -> Vec3:
        """Body rates that the rate loop follows [rad/s]."""

    @property
    def on_ground(self) -> bool:
        """Whether the vehicle touches the ground."""

    @property
    def impact_speed_m_s(self) -> float:
        """Downward speed of the hardest touchdown so far."""

    def set_body(self, body: Body) -> None:
        """Change the body's constants from now on."""

    def run(self, setpoint: Setpoint, fresh: bool, n_steps: int) -> None:
        """Run steps with one setpoint; `fresh`: it is a new one."""

    def set_noise_factor(self, factor: float) -> None:
        """Scale the vehicle file's noise, of the estimates that are asked for from now on."""

    def believed(self, steps_ahead: int) -> Estimate:
        """Return the estimate that is the newest in so many steps, at most its age; asking twice is free."""

    def foresee(self, steps_ahead: int) -> None:
        """Take note for how many steps ahead, at most its age, the estimate will be asked for after each `run`."""


def make_engine(name: str, setup: Setup) -> Engine:
    """Build an engine: "python", "numba", or "auto" (numba where it can be used).

    Raises:
        ImportError: "numba" is asked for and not installed.
        ValueError: there is no such engine.
    """
    if name not in ENGINES:
        raise ValueError(f"engine {name!r} is not one of {', '.join(ENGINES)}")
    if name == "numba" or (name == "auto" and available()):
        return CompiledEngine(setup)
    return PlainEngine(setup)


class PlainEngine:
    """The steps as plain Python."""

    def __init__(self, setup: Setup) -> None:
        self.rigid = setup.rigid
        self.on_ground = setup.on_ground
        self.impact_speed_m_s = 0.0
        self.air_m_s: Vec3 = (0.0, 0.0, 0.0)
        self.force_n: Vec3 = (0.0, 0.0, 0.0)
        self.gains = setup.gains
        self._body = setup.body
        self._ground_d_m = setup.ground_d_m
        self._dt_us = setup.dt_us
        self._dt_s = setup.dt_us * 1.0e-6
        self._t_us = setup.t_us
        self._loops = initial_loops(setup.rigid.w)
        self._vehicle = setup.vehicle
        self._estimator = Estimator(
            setup.vehicle, seed=setup.seed, t_us=setup.t_us, rigid=setup.rigid, dt_us=setup.dt_us
        )

    @property
    def rates(self) -> Vec3:
        """Body rates that the rate loop follows [rad/s]."""
        return self._loops.rates

    def set_body(self, body: Body) -> None:
        """Change the body (see Engine)."""
        self._body = body

    def run(self, setpoint: Setpoint, fresh: bool, n_steps: int) -> None:
        """Run steps (see Engine)."""
        rigid, loops = self.rigid, self._loops
        air, force, body, gains = self.air_m_s, self.force_n, self._body, self.gains
        ground, dt_s, dt_us = self._ground_d_m, self._dt_s, self._dt_us
        push = self._estimator.push
        sinking = -1.0
        for _ in range(n_steps):
            rigid, loops, sinking, hit = advance_step(
                rigid, loops, setpoint, fresh, air, force, body, gains, ground, dt_s
            )
            fresh = False
            self.impact_speed_m_s = max(self.impact_speed_m_s, hit)
            self._t_us += dt_us
            push(self._t_us, rigid)
        self.rigid, self._loops, self.on_ground = rigid, loops, sinking >= 0.0

    def set_noise_factor(self, factor: float) -> None:
        """Scale the noise (see Engine)."""
        self._estimator.set_noise(noise_of(self._vehicle, factor))

    def believed(self, steps_ahead: int) -> Estimate:
        """Return an estimate (see Engine)."""
        return self._estimator.believed(steps_ahead)

    def foresee(self, steps_ahead: int) -> None:
        """Do nothing: an estimate takes no longer when it is asked for (see Engine)."""


_ORDER = struct.Struct(f"{flat.ORDER_NUMBERS}d")
_PAIR, _FOUR = struct.Struct("2d"), struct.Struct("4d")
_RIGID = struct.Struct(f"{flat.RIGID_NUMBERS}d")
_ESTIMATE = struct.Struct(f"{flat.ESTIMATE_NUMBERS}d")
_VECTOR = struct.Struct("3d")
_FLOAT_BYTES = 8
_NEW = tuple.__new__
"""Makes a named tuple of a tuple without the call of its constructor."""


def _floats(value: Any) -> list[float]:
    """Give the numbers in nested tuples, in order."""
    if isinstance(value, tuple):
        return [number for part in value for number in _floats(part)]
    return [float(value)]


class CompiledEngine:
    """The steps compiled as one kernel over an array that is allocated once."""

    def __init__(self, setup: Setup) -> None:
        self._run: Any = compile_kernel(flat.run_steps)
        self._estimate: Any = compile_kernel(flat.estimate)
        age = age_steps(setup.vehicle, setup.dt_us)
        self._ring_rows = age + 1
        self._dt_us = setup.dt_us
        self._offset_us = setup.t_us % setup.dt_us
        x: Any = np.zeros(flat.length(age + 1))
        self._x = x
        self._bytes = x.data.cast("B")
        self._put(flat.RIGID, setup.rigid)
        self._put(flat.LOOPS, initial_loops(setup.rigid.w))
        self._put(flat.TOUCH, (setup.on_ground, 0.0))
        self._put(flat.WORLD, (setup.ground_d_m, setup.dt_us * 1.0e-6))
        self._put(flat.BODY, setup.body)
        self._put(flat.SIGMAS, (*noise_of(setup.vehicle), age + 1, 0.0))
        x[flat.RING :].reshape(age + 1, flat.RING_NUMBERS)[:] = _floats(setup.rigid)[: flat.RING_NUMBERS]
        self._sample = setup.t_us // setup.dt_us - age
        """Number of the oldest sample of the ring; `_row` is its place."""
        self._row = 0
        self._blocks = NoiseBlocks(setup.seed)
        self._vehicle = setup.vehicle
        self._set: Setpoint | None = None
        self.rigid = setup.rigid
        """True mechanical state (see Engine)."""
        self._last: Estimate | None = None
        self._last_sample = -1
        self._foresight = 0
        self._written = -1
        """Sample whose estimate is in the array."""
        self.gains = setup.gains
        self.air_m_s = (0.0, 0.0, 0.0)
        self.force_n = (0.0, 0.0, 0.0)

    def _put(self, at: int, value: Any) -> None:
        numbers = _floats(value)
        self._x[at : at + len(numbers)] = numbers

    def set_body(self, body: Body) -> None:
        """Change the body (see Engine)."""
        self._put(flat.BODY, body)

    @property
    def air_m_s(self) -> Vec3:
        """Velocity of the air, NED (see Engine)."""
        return self._air

    @air_m_s.setter
    def air_m_s(self, value: Vec3) -> None:
        self._air = value
        self._put(flat.AIR, value)

    @property
    def force_n(self) -> Vec3:
        """Force from outside, NED (see Engine)."""
        return self._force

    @force_n.setter
    def force_n(self, value: Vec3) -> None:
        self._force = value
        self._put(flat.FORCE, value)

    @property
    def gains(self) -> LoopGains:
        """Constants of the loops (see Engine)."""
        return self._gains

    @gains.setter
    def gains(self, value: LoopGains) -> None:
        self._gains = value
        self._put(flat.GAINS, value)

    @property
    def rates(self) -> Vec3:
        """Body rates that the rate loop follows [rad/s]."""
        x, y, z = _VECTOR.unpack_from(self._bytes, _FLOAT_BYTES * (flat.LOOPS + 6))
        return x, y, z

    @property
    def on_ground(self) -> bool:
        """Whether the vehicle touches the ground."""
        return bool(self._x[flat.TOUCH] > 0.5)

    @property
    def impact_speed_m_s(self) -> float:
        """Downward speed of the hardest touchdown so far."""
        return float(self._x[flat.TOUCH + 1])

    def run(self, setpoint: Setpoint, fresh: bool, n_steps: int) -> None:
        """Run steps (see Engine)."""
        self._sample += n_steps
        self._row = (self._row + n_steps) % self._ring_rows
        row, noise = self._place(self._foresight)
        if setpoint is self._set:
            _FOUR.pack_into(self._bytes, _FLOAT_BYTES * flat.FRESH, fresh, n_steps, row, noise)
        else:
            mode, thrust, rates, q, yaw_rate, torque = setpoint
            at = _FLOAT_BYTES * flat.ORDER
            _ORDER.pack_into(self._bytes, at, mode, thrust, *rates, *q, yaw_rate, *torque, fresh, n_steps, row, noise)
            self._set = setpoint
        self._run(self._x)
        a, b, c, d, e, f, q0, q1, q2, q3, g, h, i, r0, r1, r2, r3 = _RIGID.unpack_from(self._bytes, 0)
        self.rigid = _NEW(RigidState, ((a, b, c), (d, e, f), (q0, q1, q2, q3), (g, h, i), (r0, r1, r2, r3)))

    def _place(self, steps_ahead: int) -> tuple[int, int]:
        """Give the rows of the ring and of the noise that make an estimate, which is to be written."""
        self._written = sample = self._sample + steps_ahead
        blocks = self._blocks
        noise = sample - blocks.first
        if not 0 <= noise < blocks.count:
            blocks.move_to(sample)
            self._x[flat.NOISE : flat.RING] = blocks.rows.reshape(-1)
            noise = sample - blocks.first
        return (self._row + steps_ahead) % self._ring_rows, noise

    def foresee(self, steps_ahead: int) -> None:
        """Let `run` write that estimate as well (see Engine)."""
        self._foresight = steps_ahead

    def set_noise_factor(self, factor: float) -> None:
        """Scale the noise (see Engine)."""
        self._put(flat.SIGMAS, noise_of(self._vehicle, factor))
        self._last, self._written = None, -1

    def believed(self, steps_ahead: int) -> Estimate:
        """Return an estimate (see Engine)."""
        sample = self._sample + steps_ahead
        if self._last is None or self._last_sample != sample:
            if self._written != sample:
                _PAIR.pack_into(self._bytes, _FLOAT_BYTES * flat.ASK, *self._place(steps_ahead))
                self._estimate(self._x)
            a, b, c, d, e, f, q0, q1, q2, q3, g, h, i = _ESTIMATE.unpack_from(self._bytes, _FLOAT_BYTES * flat.ESTIMATE)
            t_us = sample * self._dt_us + self._offset_us
            self._last = _NEW(Estimate, (t_us, (a, b, c), (d, e, f), (q0, q1, q2, q3), (g, h, i)))
            self._last_sample = sample
        return self._last
