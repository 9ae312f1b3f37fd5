"""The simulated vehicle's body as the world of a real PX4 that runs in simulation.

PX4 (SITL with lockstep, an airframe that waits for an external simulator such as 10016) connects by TCP. Every 4 ms of
its time it gets HIL_SENSOR, and now and then HIL_GPS; it answers with HIL_ACTUATOR_CONTROLS, and only then the world
moves on. PX4's clock is the time in HIL_SENSOR (its modules/simulation/simulator_mavlink), which rises by exactly
4000 us from sample to sample.

The wait is bounded: PX4 gives no controls while it boots, and whenever its control allocation is off. After PATIENCE_S
without an answer the world goes on at real time with the last controls, until PX4 gives new ones.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from . import hil_sensors
from .airframe import START_US, Airframe
from .codec import ID_COMMAND_LONG, ID_HIL_STATE_QUATERNION, Decoder, Encoder, Frame
from .fault_kinds import Fault
from .hil_faults import HilFaults, check_kinds
from .hil_link import ID_HIL_ACTUATOR_CONTROLS, Controls, HilServer, Px4GoneError, Px4Link, controls_of
from .hil_sensors import SAMPLE_US, Noise, Sensors
from .inner_loops import ROTORS, Setpoint
from .messages import truth_payload
from .physics import STANDARD_GRAVITY_M_S2, RigidState
from .rotation import Quat, Vec3, Vec4
from .truth_log import TruthLog
from .vehicle_file import VehicleFile, VehicleFileError
from .wind import World

PATIENCE_S = 1.0
"""Wall time that the world waits for PX4's controls to a sample."""
_SYSTEM, _COMPONENT = 1, 200
"""Who the simulator says it is; PX4 does not look."""
_SET_MESSAGE_INTERVAL = 511
_LATE_MAX_S = 0.25
"""Of lateness so much is caught up with; the rest is let go."""
_SLICE_S = 0.1
"""Longest single wait, so that a stop is noticed."""


@dataclass(frozen=True)
class HilOptions:
    """What world PX4 gets."""

    vehicle: VehicleFile
    world: World = field(default_factory=World)
    seed: int = 1
    """Of the sensors' noise; the gusts' is the world's."""
    speed: float = 1.0
    """Vehicle time per wall time, at most."""
    engine: str = "auto"
    faults: tuple[Fault, ...] = ()
    """What goes wrong with the body and the air; their times count from PX4's connection."""
    noise: Noise | None = None
    """Of the sensors; None: the usual one."""
    patience_s: float = PATIENCE_S

    def check(self) -> None:
        """Raise VehicleFileError or FaultError for what cannot be simulated."""
        dt_us = round(1.0e6 / self.vehicle.loop_rate_hz)
        if SAMPLE_US % dt_us != 0:
            raise VehicleFileError(
                f"{self.vehicle.path}: autopilot.loop_rate_hz = {self.vehicle.loop_rate_hz:g}: "
                f"must be a multiple of the {1e6 / SAMPLE_US:g} samples a second that a PX4 in simulation gets"
            )
        check_kinds(self.faults)


def _silent(sentence: str) -> None:
    """Tell nobody."""


class HilWorld:
    """Body, air, ground and sensors: turns controls into samples. No sockets, no clock."""

    def __init__(self, options: HilOptions, tell: Callable[[str], None] = _silent) -> None:
        """Put the vehicle on the ground, its rotors off; `tell` gets a sentence when a fault begins or ends.

        Raises:
            VehicleFileError: the file's steps do not fit into a sample.
            FaultError: a fault that is PX4's own business, or faults that cannot be together.
            ImportError: numba is asked for and not installed.
        """
        options.check()
        self.airframe = Airframe(options.vehicle, options.world, seed=options.seed, engine=options.engine)
        self._steps = SAMPLE_US // self.airframe.dt_us
        gravity = STANDARD_GRAVITY_M_S2 * options.world.gravity_factor
        self._sensors = Sensors(options.seed, gravity, START_US, options.noise)
        self._faults = HilFaults(self.airframe, options.faults, tell)
        self._before: RigidState = self.airframe.rigid
        self._encoder = Encoder(_SYSTEM, _COMPONENT)
        self.truth_interval_us = 0
        """Between two HIL_STATE_QUATERNION, when PX4 has asked for them; 0: none."""
        self._truth_due_us = 0

    @property
    def t_us(self) -> int:
        """Time of the present sample."""
        return self.airframe.t_us

    def sample(self) -> bytes:
        """Measure now. HIL_SENSOR comes last: it moves PX4's clock, and with it PX4 begins to work."""
        t_us, now, hot = self.t_us, self.airframe.rigid, self._encoder.hot
        data = b""
        if self.truth_interval_us > 0 and t_us >= self._truth_due_us:
            self._truth_due_us = t_us + self.truth_interval_us
            data = hot(ID_HIL_STATE_QUATERNION, self._truth(t_us, now))
        gps = self._sensors.hil_gps(t_us, now)
        if gps is not None:
            data += hot(hil_sensors.ID_HIL_GPS, gps)
        return data + hot(hil_sensors.ID_HIL_SENSOR, self._sensors.hil_sensor(t_us, self._before, now))

    def advance(self, controls: Vec4) -> None:
        """Go on to the next sample with these rotor commands 0..1."""
        self._faults.advance()
        self._before = self.airframe.rigid
        self.airframe.advance(_rotors(controls), True, self._steps)

    def _truth(self, t_us: int, now: RigidState) -> bytes:
        per_s = 1.0e6 / SAMPLE_US
        a: Vec3 = (
            per_s * (now.v[0] - self._before.v[0]),
            per_s * (now.v[1] - self._before.v[1]),
            per_s * (now.v[2] - self._before.v[2]),
        )
        return truth_payload(t_us, now.p, now.v, now.q, now.w, a)


def _rotors(controls: Quat) -> Setpoint:
    return Setpoint(ROTORS, 0.0, (0.0, 0.0, 0.0), controls, 0.0, (0.0, 0.0, 0.0))


def _never() -> bool:
    return False


class Hil:
    """Runs the world for whichever PX4 connects, in the calling thread."""

    def __init__(
        self,
        options: HilOptions,
        server: HilServer,
        *,
        stopped: Callable[[], bool] = _never,
        notice: Callable[[str], None] = _silent,
    ) -> None:
        """Take a server that listens already, and that `close` closes.

        Args:
            options: the world.
            server: where PX4 connects.
            stopped: asked often; once it says yes, `run` returns.
            notice: gets a sentence when PX4 comes, leaves, gives no controls or gives them again, and when a fault
                begins or ends.

        Raises:
            VehicleFileError, FaultError, ImportError: as `HilWorld`.
        """
        self.options = options
        self.server = server
        self._stopped = stopped
        self._notice = notice
        self.world = HilWorld(options, notice)
        self._decoder = Decoder()
        self._log: TruthLog | None = None
        self._begin()

    def _begin(self) -> None:
        """Know nothing of PX4 yet."""
        self.controls = Controls(0, (0.0,) * 16, False)
        """The newest ones."""
        self.synchronous = False
        """Whether the world waits for PX4's controls."""
        self._heard_us = 0
        """Of the newest controls when it did not, the time."""
        self.misses = 0
        """Samples of which PX4's controls did not come in time."""
        self.samples = 0
        self._deadline_s = time.monotonic()

    def log_truth(self, log: TruthLog) -> None:
        """Write a row for every sample from now on, in the place of the log before; `close` completes the file."""
        if self._log is not None:
            self._log.close()
        self._log = log

    def close(self) -> None:
        """Give the port back and complete the truth file."""
        self.server.close()
        if self._log is not None:
            self._log.close()

    def run(self, duration_s: float | None = None) -> bool:
        """Wait for a PX4 and be its world until it leaves, a time of the vehicle's is over, or told to stop.

        Every call begins anew: on the ground, at the start of time. False: told to stop before PX4 was there, or a
        PX4 left; True: the time is over, or told to stop while it flew.
        """
        link = self.server.accept(self._stopped)
        if link is None:
            return False
        if self.samples:
            self.world = HilWorld(self.options, self._notice)
        self._begin()
        self._notice("PX4 is connected")
        end_us = None if duration_s is None else START_US + round(duration_s * 1e6)
        try:
            while not self._stopped() and (end_us is None or self.world.t_us < end_us):
                self.step(link)
        except Px4GoneError as gone:
            self._notice(f"PX4 has left: it {gone}, after {(self.world.t_us - START_US) * 1e-6:.3f} s")
            return False
        finally:
            link.close()
        return True

    def step(self, link: Px4Link) -> None:
        """Send one sample, wait for its controls as the kind of time asks, and move on. Raises Px4GoneError."""
        world = self.world
        link.send(world.sample())
        self.samples += 1
        if self._log is not None:
            self._log.add(self._log.row(world.airframe))
        if not self.synchronous:
            self._run_free(link)
        if self.synchronous:
            self._wait_for_controls(link)
        if self.synchronous:
            self._wait_for_time()
        if self.samples % 250 == 0:
            self._refuse_others()
        a, b, c, d = self.controls.controls[:4]
        world.advance((a, b, c, d))

    def _wait_for_controls(self, link: Px4Link) -> None:
        """Wait until the controls to the present sample are here, for a bounded time."""
        give_up_s = time.monotonic() + self.options.patience_s
        while self.controls.t_us < self.world.t_us:
            left_s = give_up_s - time.monotonic()
            if left_s <= 0.0:
                self.misses += 1
                self.synchronous = False
                self._heard_us = self.controls.t_us
                self._deadline_s = time.monotonic()
                self._notice(f"no controls from PX4 for {self.options.patience_s:g} s: going on at real time")
                return
            if self._stopped():
                return
            self._serve(link, min(left_s, _SLICE_S))

    def _wait_for_time(self) -> None:
        """Let the wall clock catch up."""
        self._set_deadline(self.options.speed)
        while (left_s := self._deadline_s - time.monotonic()) > 0.0 and not self._stopped():
            time.sleep(min(left_s, _SLICE_S))

    def _run_free(self, link: Px4Link) -> None:
        """Let a sample's time pass without controls. New ones, of whichever sample, show that PX4 is at work."""
        self._set_deadline(min(1.0, self.options.speed))
        while True:
            left_s = self._deadline_s - time.monotonic()
            self._serve(link, min(max(left_s, 0.0), _SLICE_S))
            if self.controls.t_us > self._heard_us:
                self.synchronous = True
                self._notice("PX4 gives controls: in lockstep")
                return
            if left_s <= 0.0 or self._stopped():
                return

    def _set_deadline(self, speed: float) -> None:
        """Set when the present sample is over."""
        self._deadline_s += SAMPLE_US * 1e-6 / speed
        now_s = time.monotonic()
        if now_s - self._deadline_s > _LATE_MAX_S:
            self._deadline_s = now_s

    def _serve(self, link: Px4Link, timeout_s: float) -> None:
        """Take in what PX4 sends."""
        for frame in link.receive(timeout_s):
            if frame.msg_id == ID_HIL_ACTUATOR_CONTROLS:
                self.controls = controls_of(frame)
            elif frame.msg_id == ID_COMMAND_LONG:
                self._obey(frame)

    def _obey(self, frame: Frame) -> None:
        """Obey the one command that PX4 gives its simulator: to send the truth, at an interval."""
        message = self._decoder.message(frame)
        if message is None or message.command != _SET_MESSAGE_INTERVAL or message.param1 != ID_HIL_STATE_QUATERNION:
            return
        asked_us = message.param2
        self.world.truth_interval_us = max(SAMPLE_US, round(asked_us)) if 0.0 < asked_us < math.inf else 0

    def _refuse_others(self) -> None:
        """Send a second PX4 away: there is one body."""
        other = self.server.accept_now()
        if other is not None:
            other.close()
            self._notice("a second PX4 was sent away; give it another instance (-i) and its own simulator")
