"""The simulated vehicle below its autopilot's modes: body, rotors, inner loops, world and estimator, in step."""

from __future__ import annotations

from typing import NamedTuple

from .beliefs import Beliefs
from .engines import Setup, make_engine
from .estimator import Estimate, age_steps
from .inner_loops import Setpoint, make_gains
from .loop_gains import LoopGains, hover_thrusts
from .physics import STANDARD_GRAVITY_M_S2, RigidState, at_rest, make_body
from .rotation import Quat, Vec3, Vec4
from .vehicle_file import VehicleFile
from .wind import Wind, World

START_US = 1_000_000
"""Vehicle time at start: some time after boot, so that the stamps of late samples are positive."""
_GUST_PERIOD_S = 0.01
"""At least so often the gusts change; on a fixed grid of steps, however the steps are asked for."""


def steps_per_gust(dt_us: int) -> int:
    """Return for how many steps of dt_us the air stays as it is."""
    return max(1, round(_GUST_PERIOD_S / (dt_us * 1.0e-6)))


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
        place_m: tuple[float, float] = (0.0, 0.0),
        px4: str = "1.18",
    ) -> None:
        """Put the vehicle on the ground, or in the air.

        Args:
            vehicle: what it is.
            world: what is around it; its seed is that of the gusts.
            seed: of the estimator's noise and bias walk.
            engine: "python", "numba" or "auto" (see `accelerate.choose`).
            start: position NED [m] and yaw [rad] at which to hover, level, the rotors carrying the vertical load;
                None = on the ground, rotors off.
            place_m: where on the ground, north and east [m].
            px4: "1.18" or "1.13", the version whose loops are simulated.
        """
        self.vehicle = vehicle
        self.world = world
        self.dt_us = round(1.0e6 / vehicle.loop_rate_hz)
        """One step."""
        self.t_us = START_US
        """Vehicle time."""
        self.age_steps = age_steps(vehicle, self.dt_us)
        """How old an estimate is when it is published."""
        gravity = STANDARD_GRAVITY_M_S2 * world.gravity_factor
        self._body = make_body(vehicle, gravity)
        self._steps_per_gust = steps_per_gust(self.dt_us)
        self._gust_phase = 0
        """Steps since the gusts changed last, or would have changed."""
        period_s = self._steps_per_gust * (self.dt_us * 1.0e-6)
        self._wind = Wind(world.wind_m_s, world.turbulence, seed=world.seed, period_s=period_s)
        self._engine = make_engine(
            engine,
            Setup(
                vehicle,
                self._start(start, place_m),
                self._body,
                make_gains(vehicle, px4),
                world.ground_d_m,
                start is None or start[0][2] >= world.ground_d_m,
                self.t_us,
                self.dt_us,
                seed,
            ),
        )
        self.rigid = self._engine.rigid
        """True mechanical state."""
        self._thrust_factor = 1.0
        self._rotor_shares: Vec4 = (1.0, 1.0, 1.0, 1.0)
        self._gust_m_s: Vec3 | None = None
        self._disturbance: Vec3 | None = None
        """What air and force come to; None: one of them has changed since."""
        self._engine.force_n = world.force_n
        self._engine.air_m_s = self._wind.air_m_s
        self.beliefs = Beliefs(
            self._engine,
            lambda: self.rigid,
            lambda: self.t_us,
            vehicle=vehicle,
            seed=seed,
            dt_us=self.dt_us,
            age_steps=self.age_steps,
        )
        """What goes wrong with the estimate."""

    def _start(self, start: tuple[Vec3, float] | None, place_m: tuple[float, float]) -> RigidState:
        if start is None:
            return at_rest((*place_m, self.world.ground_d_m), 0.0, (0.0, 0.0, 0.0, 0.0))
        p, yaw = start
        mass = self._body.mass_kg
        load = mass * (self._body.gravity_m_s2 + self._body.drag_1_s * self._wind.air_m_s[2])
        load += self.world.force_n[2]
        load = min(max(load, 0.0), 4.0 * self._body.rotor_thrust_max_n)
        return at_rest(p, yaw, hover_thrusts(self.vehicle, load))

    @property
    def on_ground(self) -> bool:
        """Whether the vehicle touches the ground."""
        return self._engine.on_ground

    @property
    def impact_speed_m_s(self) -> float:
        """Downward speed of the hardest touchdown so far."""
        return self._engine.impact_speed_m_s

    def advance(self, setpoint: Setpoint, fresh: bool, n_steps: int) -> None:
        """Run n_steps physics steps with one setpoint; `fresh`: it is a new one (acts on the first step).

        An attitude is meant in the frame that the vehicle believes in: its heading is off by what the estimate's is.
        """
        engine, wind, beliefs = self._engine, self._wind, self.beliefs
        if beliefs.active:
            setpoint = beliefs.in_truth(setpoint)
        gusty, recording = wind.gusty, beliefs.recording
        while n_steps > 0:
            steps = n_steps
            if recording:
                steps = 1
            elif gusty:
                steps = min(n_steps, self._steps_per_gust - self._gust_phase)
            engine.run(setpoint, fresh, steps)
            self.rigid = engine.rigid
            fresh = False
            n_steps -= steps
            self.t_us += steps * self.dt_us
            if recording:
                beliefs.record()
            self._gust_phase = (self._gust_phase + steps) % self._steps_per_gust
            if gusty and self._gust_phase == 0:
                wind.advance()
                self._blow()

    def believed(self, steps_ahead: int = 0) -> Estimate:
        """Return what the vehicle believes: late and noisy, stamped with the sample's time.

        With steps_ahead, at most `age_steps`: what it will believe in so many steps, which is the past already.
        """
        return self.beliefs.estimate(steps_ahead) if self.beliefs.active else self._engine.believed(steps_ahead)

    def foresee(self, steps_ahead: int) -> None:
        """Take note for how many steps ahead, at most `age_steps`, beliefs will be asked for after each `advance`."""
        self._engine.foresee(steps_ahead)

    def inner_state(self) -> RigidState:
        """Return the state without delay and noise that the autopilot's own modes use: the truth, but for `beliefs`."""
        return self.beliefs.inner(self.rigid) if self.beliefs.active else self.rigid

    def rates_followed(self) -> Vec3:
        """Return the body rates that the rate loop follows [rad/s]."""
        return self._engine.rates

    def set_gains(self, gains: LoopGains) -> None:
        """Change the constants of the inner loops from now on."""
        self._engine.gains = gains

    def set_thrust_factor(self, factor: float) -> None:
        """Change every rotor's thrust, as a share of the vehicle file's, from now on."""
        if factor != self._thrust_factor:
            self._thrust_factor = factor
            self._set_rotors()

    def set_rotor_shares(self, shares: Vec4) -> None:
        """Change what each rotor still gives of its thrust at a command, from now on; 0 = it stands still."""
        if shares != self._rotor_shares:
            self._rotor_shares = shares
            self._set_rotors()

    def _set_rotors(self) -> None:
        full_n = self._thrust_factor * self.vehicle.rotor_thrust_max_n
        self._engine.set_body(self._body._replace(rotor_thrust_max_n=full_n, rotor_share=self._rotor_shares))

    def truth(self) -> Truth:
        """Return the truth now; on the ground the disturbance leaves out what the ground does."""
        p, v, q, w, rotor_n = self.rigid
        return Truth(self.t_us, p, v, q, w, rotor_n, sum(rotor_n), self.disturbance())

    def disturbance(self) -> Vec3:
        """Return the disturbance now; the same object as long as nothing changes."""
        known = self._disturbance
        if known is None:
            air, force, body = self._engine.air_m_s, self._engine.force_n, self._body
            known = self._disturbance = (
                body.drag_1_s * air[0] + force[0] / body.mass_kg,
                body.drag_1_s * air[1] + force[1] / body.mass_kg,
                body.drag_1_s * air[2] + force[2] / body.mass_kg + (body.gravity_m_s2 - STANDARD_GRAVITY_M_S2),
            )
        return known

    def set_wind(self, wind_m_s: Vec3, turbulence: float) -> None:
        """Change the mean wind (NED) in a step, and its turbulence, from now on."""
        self._wind.set_wind(wind_m_s, turbulence)
        self._blow()

    def set_gust(self, gust_m_s: Vec3 | None) -> None:
        """Add a velocity (NED) to that of the air from now on, in the place of the one added before; None: nothing."""
        self._gust_m_s = gust_m_s
        self._blow()

    def _blow(self) -> None:
        """Let the air move as wind and gust say now."""
        air, gust = self._wind.air_m_s, self._gust_m_s
        self._engine.air_m_s = air if gust is None else (air[0] + gust[0], air[1] + gust[1], air[2] + gust[2])
        self._disturbance = None

    def set_force(self, force_n: Vec3) -> None:
        """Change the constant force (NED) from now on."""
        self._engine.force_n = force_n
        self._disturbance = None
