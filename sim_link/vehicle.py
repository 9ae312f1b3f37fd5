"""One simulated vehicle as an object: airframe, autopilot, services and links, advanced by `tick`.

No sockets, no clock, no threads: what is received is handed in with `receive`, what is to be sent gathers in the links'
outboxes. `peer` gives it sockets and time; tests may step it directly.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from .airframe import Airframe
from .autopilot import Autopilot
from .codec import (
    ID_ATTITUDE_QUATERNION,
    ID_GLOBAL_POSITION_INT,
    ID_HEARTBEAT,
    ID_HIL_STATE_QUATERNION,
    ID_LOCAL_POSITION_NED,
    ID_ODOMETRY,
    ID_TIMESYNC,
    TIMESYNC,
    Frame,
)
from .link import GROUND_HZ, ONBOARD_HZ, Link
from .loop_gains import LoopGains, make_gains
from .messages import Telemetry, truth_payload
from .messages_slow import SlowTelemetry
from .offboard import Order
from .parameters import Parameters
from .rotation import Vec3
from .services import Services
from .vehicle_file import VehicleFile
from .wind import World

ID_ATTITUDE, ID_MISSION_CURRENT = 30, 42
PX4_VERSIONS = ("1.18", "1.13")
_STANDARD_G = 9.80665
_CONTROL_PERIOD_S = 0.01
"""The autopilot's own loops run at least this often, however slow the state messages are (PX4: 100 Hz and faster)."""
_PARAMETERS_PER_S = 2000
_TRUTH_PERIOD_US = 40_000


_OF_THE_PAST = frozenset(
    (ID_HEARTBEAT, ID_TIMESYNC, ID_ODOMETRY, ID_ATTITUDE, ID_ATTITUDE_QUATERNION, ID_LOCAL_POSITION_NED)
    + (ID_GLOBAL_POSITION_INT,)
)
"""Messages of what was estimated of the past, and of what the autopilot has decided already."""

_LOOP_PARAMETERS = {
    "MC_ROLL_P": (0.0, 20.0),
    "MC_PITCH_P": (0.0, 20.0),
    "MC_YAW_P": (0.0, 20.0),
    "MC_YAW_WEIGHT": (0.0, 1.0),
    "MC_ROLLRATE_MAX": (0.0, 1800.0),
    "MC_PITCHRATE_MAX": (0.0, 1800.0),
    "MC_YAWRATE_MAX": (0.0, 1800.0),
    "MC_REF_W_N": (1.0, 200.0),
    "THR_MDL_FAC": (0.0, 1.0),
}
"""What of the inner loops can be set, and its range; the rate loop's own gains follow from the vehicle file alone."""


def _nobody(t_us: int) -> None:
    """Wait for nothing."""


def _gains(file: VehicleFile, parameters: Parameters, untouched: Parameters) -> LoopGains:
    """Give the inner loops' constants as the parameters ask; while all are `untouched`, the file's exact ones."""
    gains = make_gains(file, parameters.px4)
    known = [name for name in _LOOP_PARAMETERS if name in parameters]
    if all(parameters[name] == untouched[name] for name in known):
        return gains
    value = {name: parameters.within(name, *_LOOP_PARAMETERS[name]) for name in known}
    limits = [math.radians(value[f"MC_{axis}RATE_MAX"]) for axis in ("ROLL", "PITCH", "YAW")]
    weight = value["MC_YAW_WEIGHT"]
    return gains._replace(
        attitude_p=(value["MC_ROLL_P"], value["MC_PITCH_P"], value["MC_YAW_P"] / max(weight, 0.01)),
        yaw_weight=weight,
        rate_max=(limits[0], limits[1], limits[2]),
        reference_rad_s=value.get("MC_REF_W_N", 0.0),
        curve_factor=value["THR_MDL_FAC"],
    )


class VehicleError(ValueError):
    """A vehicle that cannot be built; the message is one line for people."""


@dataclass(frozen=True)
class VehicleOptions:
    """What to simulate."""

    vehicle: VehicleFile
    world: World = field(default_factory=World)
    instance: int = 0
    """System id is 1 + instance."""
    start: tuple[Vec3, float] | None = None
    """Position NED [m] and yaw [rad] at which it waits in the air, armed, in Hold; None: on the ground, disarmed."""
    seed: int = 1
    """Of everything random in it."""
    px4: str = "1.18"
    engine: str = "auto"
    parameters: Mapping[str, int | float] = field(default_factory=dict)
    """Set before the start, over the defaults and what follows from the vehicle file."""


class Vehicle:
    """A vehicle with two links: `companion` and `ground`."""

    def __init__(self, options: VehicleOptions) -> None:
        """Build the vehicle.

        Raises:
            VehicleError: no whole number of loop steps fits between two states, or a choice is unknown.
            ParameterError: a parameter that does not exist.
        """
        if options.px4 not in PX4_VERSIONS:
            raise VehicleError(f"px4 version {options.px4!r}: allowed are {', '.join(PX4_VERSIONS)}")
        self.options = options
        self.system = 1 + options.instance
        file = options.vehicle
        self.steps_per_tick = _steps_per_tick(file)
        from_file = _from_vehicle_file(file, self.system)
        self._untouched = Parameters(options.px4, from_file)
        self.parameters = Parameters(options.px4, from_file | dict(options.parameters))
        self.airframe = Airframe(
            file, options.world, seed=options.seed, engine=options.engine, start=options.start, px4=options.px4
        )
        self._steps_per_control = max(1, int(_CONTROL_PERIOD_S / (self.airframe.dt_us * 1e-6)))
        self.period_us = self.steps_per_tick * self.airframe.dt_us
        """Time between two states."""
        self.start_us = self.airframe.t_us
        rigid = self.airframe.inner_state()
        self.autopilot = Autopilot(
            self.parameters,
            px4=options.px4,
            system=self.system,
            rigid=rigid,
            in_air=options.start is not None,
            now_us=self.airframe.t_us,
            setpoint_delay_us=round(file.command_delay_s * 1e6),
            home=(rigid.p[0], rigid.p[1], options.world.ground_d_m),
        )
        self.telemetry = Telemetry(
            file, self.autopilot, self.parameters, instance=options.instance, now=self.airframe.believed()
        )
        self.slow = SlowTelemetry(
            file, self.autopilot, self.parameters, now=self.airframe.believed(), rigid=rigid, seed=options.seed
        )
        self.telemetry.add(self.slow.builders)
        self.services = Services(self.autopilot, self.parameters, self.telemetry, system=self.system)
        self.telemetry.add({ID_MISSION_CURRENT: self.services.mission_current})
        self.companion = Link(self.system, ONBOARD_HZ, self.airframe.t_us)
        self.ground = Link(self.system, GROUND_HZ, self.airframe.t_us, quiet=True)
        self.links = [self.companion, self.ground]
        self.truth_outbox: list[bytes] = []
        """HIL_STATE_QUATERNION frames with the truth."""
        self.asks_time = True
        """Whether TIMESYNC requests go out with the other messages (in lockstep the peer asks after each state)."""
        self._truth_link = Link(self.system, {}, self.airframe.t_us)
        self._truth_us = self.airframe.t_us
        self._truth_v = rigid.v
        self._texts = 0
        self._parameters_version = -1

    @property
    def t_us(self) -> int:
        """Vehicle time."""
        return self.airframe.t_us

    def receive(self, frame: Frame, link: Link) -> None:
        """Act on a message that came on a link, at the present vehicle time."""
        self.services.handle(frame, link, self.airframe.t_us)

    def tick(self, queued: Callable[[int], None] = _nobody) -> None:
        """Advance by one state period and queue what is due after it.

        `queued` is called once, with the vehicle time after the period, as soon as the messages are queued. That is
        before the physics of the period is computed where they tell nothing but the past: an estimate that is old
        enough is known already, and the companion can work on it while the vehicle moves.
        """
        airframe = self.airframe
        now_us = airframe.t_us + self.period_us
        due = [link.due(now_us, self.period_us) for link in self.links]
        order, steps = self._decide(self.steps_per_tick)
        early = steps == self.steps_per_tick <= airframe.age_steps and self._tell_the_past(due)
        if early:
            self.telemetry.update(now_us, airframe.believed(steps), self.telemetry.rates)
            self._publish(due, now_us)
            queued(now_us)
        self._move(order, steps)
        left = self.steps_per_tick - steps
        while left > 0:
            order, steps = self._decide(left)
            self._move(order, steps)
            left -= steps
        self.telemetry.update(now_us, airframe.believed(), airframe.rates_followed())
        if self.slow.update(now_us, airframe.believed(), airframe.rigid):
            airframe.set_thrust_factor(self.slow.battery.thrust_factor)
        self.services.update(self.links, now_us)
        if not early:
            self._publish(due, now_us)
            queued(now_us)
        if now_us >= self._truth_us:
            self._publish_truth(now_us)

    def look_ahead(self) -> None:
        """Prepare the next state's estimate, as far as it is known: done while there is nothing else to do."""
        if self.steps_per_tick <= self.airframe.age_steps:
            self.airframe.believed(self.steps_per_tick)

    def _tell_the_past(self, due: list[Sequence[int]]) -> bool:
        """Tell whether the messages that are due hold nothing of the present motion."""
        return all(_OF_THE_PAST.issuperset(ids) for ids in due)

    def _publish(self, due: list[Sequence[int]], now_us: int) -> None:
        """Queue the messages that are due on each link, parameters that were asked for, and texts."""
        for link, ids in zip(self.links, due, strict=True):
            for msg_id in ids:
                self._publish_one(link, msg_id, now_us)
            if link.parameters_to_send:
                self.services.send_parameters(link, max(1, _PARAMETERS_PER_S * self.period_us // 1_000_000))
        if self.autopilot.texts:
            self._publish_texts()

    def heartbeat(self) -> None:
        """Queue a HEARTBEAT on every link now, whatever its interval."""
        for link in self.links:
            link.send(self.telemetry.heartbeat())

    def _publish_one(self, link: Link, msg_id: int, now_us: int) -> None:
        """Queue one message of a stream."""
        if msg_id == ID_TIMESYNC:
            if self.asks_time:
                link.send_hot(msg_id, TIMESYNC.pack(0, now_us * 1000, 0, 0))
            return
        content = self.telemetry.build(msg_id)
        if content is None:
            return
        if isinstance(content, bytes):
            link.send_hot(msg_id, content)
        else:
            link.send(content)

    def _publish_texts(self) -> None:
        """Queue the autopilot's sentences on every link."""
        for severity, sentence in self.autopilot.texts:
            self._texts = self._texts % 0xFFFF + 1
            for message in self.telemetry.status_texts(severity, sentence, self._texts):
                for link in self.links:
                    link.send(message)
        self.autopilot.texts.clear()

    def _publish_truth(self, now_us: int) -> None:
        """Queue the truth as HIL_STATE_QUATERNION, 25 times a second."""
        rigid = self.airframe.rigid
        passed_s = max(now_us - self._truth_us + _TRUTH_PERIOD_US, 1) * 1e-6
        before = self._truth_v
        acceleration = tuple((after - v) / passed_s for after, v in zip(rigid.v, before, strict=True))
        self._truth_v = rigid.v
        self._truth_us += _TRUTH_PERIOD_US
        payload = truth_payload(
            now_us, rigid.p, rigid.v, rigid.q, rigid.w, (acceleration[0], acceleration[1], acceleration[2])
        )
        self._truth_link.send_hot(ID_HIL_STATE_QUATERNION, payload)
        self.truth_outbox.append(self._truth_link.outbox.pop())

    def _decide(self, left: int) -> tuple[Order, int]:
        """Run the autopilot once; gives its order and for how many steps, at most `left`, it holds.

        Fewer when a delayed setpoint arrives on the way, or when the autopilot's own period ends.
        """
        airframe, autopilot = self.airframe, self.autopilot
        steps = min(left, self._steps_per_control)
        next_us = autopilot.offboard.next_us
        if next_us is not None and next_us > airframe.t_us:
            steps = min(steps, -(-(next_us - airframe.t_us) // airframe.dt_us))
        if self.parameters.version != self._parameters_version:
            self._obey_parameters()
        return autopilot.update(airframe.t_us, airframe.rigid, steps * airframe.dt_us * 1e-6), steps

    def _move(self, order: Order, steps: int) -> None:
        """Run the airframe with an order."""
        airframe = self.airframe
        if order.glimpse is not None:
            airframe.advance(order.glimpse, True, 1)
            steps -= 1
        if steps > 0:
            airframe.advance(order.setpoint, order.fresh, steps)
        self.autopilot.observe(airframe.t_us, airframe.rigid)

    def _obey_parameters(self) -> None:
        """Hand changed parameters of the inner loops over to them."""
        self._parameters_version = self.parameters.version
        self.airframe.set_gains(_gains(self.options.vehicle, self.parameters, self._untouched))


def _steps_per_tick(file: VehicleFile) -> int:
    """Give the number of loop steps between two states."""
    steps = file.loop_rate_hz / file.state_rate_hz
    whole = round(steps)
    if whole < 1 or abs(steps - whole) > 1e-9 * steps:
        raise VehicleError(
            f"{file.path}: link.state_rate_hz = {file.state_rate_hz:g}: "
            f"autopilot.loop_rate_hz = {file.loop_rate_hz:g} must be a whole multiple of it"
        )
    return whole


def _from_vehicle_file(file: VehicleFile, system: int) -> dict[str, int | float]:
    """Give the parameters that whoever set this vehicle up would have set."""
    return {
        "MAV_SYS_ID": system,
        "MPC_THR_HOVER": file.mass_kg * _STANDARD_G / (4.0 * file.rotor_thrust_max_n),
        "THR_MDL_FAC": file.curve_factor,
        "MC_ROLL_P": file.attitude_gain_1_s[0],
        "MC_PITCH_P": file.attitude_gain_1_s[1],
        "MC_YAW_P": file.attitude_gain_1_s[2],
        **{f"CA_ROTOR{k}_PX": x for k, x in enumerate(file.rotor_x_m)},
        **{f"CA_ROTOR{k}_PY": y for k, y in enumerate(file.rotor_y_m)},
        **{f"CA_ROTOR{k}_KM": m for k, m in enumerate(file.rotor_yaw_m)},
    }
