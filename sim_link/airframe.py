"""The simulated vehicle below its autopilot's modes: body, rotors, inner loops, world and estimator, in step."""

from __future__ import annotations

from typing import NamedTuple

from .accelerate import choose
from .estimator import Estimate, Estimator
from .inner_loops import Setpoint, advance, initial_loops, make_gains
from .loop_gains import hover_thrusts
from .physics import STANDARD_GRAVITY_M_S2, RigidState, at_rest, make_body
from .rotation import Quat, Vec3, Vec4
from .vehicle_file import VehicleFile
from .wind import Wind, World

START_US = 1_000_000
"""Vehicle time at start: some time after boot, so that the stamps of late samples are positive."""
_GUST_PERIOD_S = 0.01
"""At least so often the gusts change; on a fixed grid of steps, however the steps are asked for."""


class Truth(NamedTuple):
    """What really happens."""

    t_us: int
    """Vehicle time."""
    p: Vec3
    """Position NED [m]."""
    v: Vec3
    """Velocity NED [m/s]."""
    q: Quat
    """Attitude, body to inertial."""
    w: Vec3
    """Body rates FRD [rad/s]."""
    rotor_n: Vec4
    """Thrust of each rotor [N]."""
    thrust_n: float
    """Their sum [N]."""
    disturbance_m_s2: Vec3
    """Acceleration NED that comes neither from thrust, nor from a gravity of 9.81 m/s^2, nor from drag in still air."""


class Airframe:
    """One simulated vehicle.

    Deterministic: the same vehicle, world, seed and setpoints give the same numbers, however the steps are divided
    among calls, and to 1e-12 with both engines.
    """

    def __init__(
        self,
        vehicle: VehicleFile,
        world: World,
        *,
        seed: int,
        engine: str = "auto",
        start: tuple[Vec3, float] | None = None,
        px4: str = "1.18",
    ) -> None:
        """Put the vehicle on the ground at the local origin, or in the air.

        Args:
            vehicle: what it is.
            world: what is around it; its seed is that of the gusts.
            seed: of the estimator's noise.
            engine: "python", "numba" or "auto" (see `accelerate.choose`).
            start: position NED [m] and yaw [rad] at which to hover, level, the rotors carrying the vertical load;
                None = on the ground, rotors off.
            px4: "1.18" or "1.13", the version whose loops are simulated.
        """
        self.vehicle = vehicle
        self.world = world
        self.dt_us = round(1.0e6 / vehicle.loop_rate_hz)
        """One step."""
        self.t_us = START_US
        """Vehicle time."""
        self.on_ground = start is None or start[0][2] >= world.ground_d_m
        self.impact_speed_m_s = 0.0
        """Downward speed of the hardest touchdown so far."""
        gravity = STANDARD_GRAVITY_M_S2 * world.gravity_factor
        self._body = make_body(vehicle, gravity)
        self._gains = make_gains(vehicle, px4)
        self._advance = choose(advance, engine)
        self._force_n = world.force_n
        self._dt_s = self.dt_us * 1.0e-6
        self._steps_per_gust = max(1, round(_GUST_PERIOD_S / self._dt_s))
        self._steps_to_gust = self._steps_per_gust
        period_s = self._steps_per_gust * self._dt_s
        self._wind = Wind(world.wind_m_s, world.turbulence, seed=world.seed, period_s=period_s)
        self.rigid = self._start(start)
        """True mechanical state."""
        self._loops = initial_loops(self.rigid.w)
        self._estimator = Estimator(vehicle, seed=seed, t_us=self.t_us, rigid=self.rigid, dt_us=self.dt_us)

    def _start(self, start: tuple[Vec3, float] | None) -> RigidState:
        if start is None:
            return at_rest((0.0, 0.0, self.world.ground_d_m), 0.0, (0.0, 0.0, 0.0, 0.0))
        p, yaw = start
        mass = self._body.mass_kg
        load = mass * (self._body.gravity_m_s2 + self._body.drag_1_s * self._wind.air_m_s[2]) + self._force_n[2]
        load = min(max(load, 0.0), 4.0 * self._body.rotor_thrust_max_n)
        return at_rest(p, yaw, hover_thrusts(self.vehicle, load))

    def advance(self, setpoint: Setpoint, fresh: bool, n_steps: int) -> None:
        """Run n_steps physics steps with one setpoint; `fresh`: it is a new one (acts on the first step)."""
        for _ in range(n_steps):
            self.rigid, self._loops, touch = self._advance(
                self.rigid,
                self._loops,
                setpoint,
                fresh,
                self._wind.air_m_s,
                self._force_n,
                self._body,
                self._gains,
                self.world.ground_d_m,
                self._dt_s,
                1,
            )
            fresh = False
            self.t_us += self.dt_us
            self.on_ground = touch.on_ground
            self.impact_speed_m_s = max(self.impact_speed_m_s, touch.impact_m_s)
            self._estimator.push(self.t_us, self.rigid)
            self._steps_to_gust -= 1
            if self._steps_to_gust == 0:
                self._steps_to_gust = self._steps_per_gust
                self._wind.advance()

    def believed(self) -> Estimate:
        """Return what the vehicle believes: late and noisy, stamped with the sample's time."""
        return self._estimator.believed()

    def inner_state(self) -> RigidState:
        """Return the state without delay and noise that the autopilot's own loops use."""
        return self.rigid

    def truth(self) -> Truth:
        """Return the truth now; on the ground the disturbance leaves out what the ground does."""
        r = self.rigid
        air, force, body = self._wind.air_m_s, self._force_n, self._body
        disturbance = (
            body.drag_1_s * air[0] + force[0] / body.mass_kg,
            body.drag_1_s * air[1] + force[1] / body.mass_kg,
            body.drag_1_s * air[2] + force[2] / body.mass_kg + (body.gravity_m_s2 - STANDARD_GRAVITY_M_S2),
        )
        return Truth(self.t_us, r.p, r.v, r.q, r.w, r.rotor_n, sum(r.rotor_n), disturbance)

    def set_wind(self, wind_m_s: Vec3, turbulence: float) -> None:
        """Change the mean wind (NED) in a step, and its turbulence, from now on."""
        self._wind.set_wind(wind_m_s, turbulence)

    def set_force(self, force_n: Vec3) -> None:
        """Change the constant force (NED) from now on."""
        self._force_n = force_n
