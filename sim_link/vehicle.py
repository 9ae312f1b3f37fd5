"""One simulated vehicle as an object: airframe, autopilot, services and links, advanced by `tick`.

No sockets, no clock, no threads: what is received is handed in with `receive`, what is to be sent gathers in the links'
outboxes. `peer` gives it sockets and time; tests may step it directly.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

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
from .estimator import Estimate
from .fault_kinds import Fault
from .faults import Faults
from .inner_loops import STOPPED_SETPOINT
from .link import GROUND_HZ, ONBOARD_HZ, Link
from .loop_gains import LoopGains, make_gains
from .messages import Telemetry, truth_payload
from .messages_slow import SlowTelemetry
from .missions import Plans
from .modes import Mode
from .parameter_set import DEFAULTS, READ_ONLY
from .parameters import Parameters
from .rotation import Vec3
from .services import Services
from .signing import Keyring
from .vehicle_file import VehicleFile
from .wind import World

ID_ATTITUDE, ID_MISSION_CURRENT = 30, 42
PX4_VERSIONS = ("1.18", "1.13")
_STANDARD_G = 9.80665
_CONTROL_PERIOD_S = 0.01
"""The autopilot's own loops run at least this often, however slow the state messages are (PX4: 100 Hz and faster)."""
_PARAMETERS_PER_S = 2000
_TEXTS_MAX = 8
"""Sentences of one state that are sent: a flood of requests that are refused must not become one of texts."""
_TRUTH_PERIOD_US = 40_000
# Far beyond what anybody means, and far from what 32 bits hold.
_PLACE_MAX_M, _FORCE_MAX_N, _WIND_MAX_M_S, _TURBULENCE_MAX, _GRAVITY_FACTOR_MAX = 1.0e6, 1.0e5, 1.0e3, 100.0, 100.0
_SEED_MAX = 2**62


_OF_THE_PAST = frozenset(
    (ID_HEARTBEAT, ID_TIMESYNC, ID_ODOMETRY, ID_ATTITUDE, ID_ATTITUDE_QUATERNION, ID_LOCAL_POSITION_NED)
    + (ID_GLOBAL_POSITION_INT,)
)
"""Messages of what was estimated of the past, and of what the autopilot has decided already."""
_OF_THE_ESTIMATE = _OF_THE_PAST - {ID_HEARTBEAT, ID_TIMESYNC}
"""Messages that go out with a new estimate only."""
_STATE_ALONE = [ID_ODOMETRY]
"""What goes out with nearly every state while a companion flies."""

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
    place_m: tuple[float, float] = (0.0, 0.0)
    """Where it stands on the ground, north and east [m], unless it starts in the air."""
    seed: int = 1
    """Of everything random in it."""
    px4: str = "1.18"
    engine: str = "auto"
    parameters: Mapping[str, int | float] = field(default_factory=dict)
    """Set before the start, over the defaults and what follows from the vehicle file."""
    faults: tuple[Fault, ...] = ()
    """What goes wrong, and when; their seed is `seed`."""
    signing_key: bytes | None = field(default=None, repr=False)
    """Messages are signed with it; 32 bytes."""
    signing_time: int = 0
    """The signing time that came with the key, in units of 10 us since 2015."""


class Foretold(NamedTuple):
    """A state's messages, built before it, and the question for the companion's answer to it."""

    t_us: int
    """Its vehicle time."""
    sequence: int
    """Number of the first of the frames: they are void once another one has gone out with it."""
    estimate: Estimate
    """What they tell."""
    frames: list[bytes]
    """For the companion link."""


class Vehicle:
    """A vehicle with two links: `companion` and `ground`."""

    def __init__(self, options: VehicleOptions) -> None:
        """Build the vehicle.

        Raises:
            VehicleError: no whole number of loop steps fits between two states, a choice is unknown, a number is beyond
                what can be simulated, or a parameter is not to be chosen.
            ParameterError: a parameter that does not exist.
            FaultError: faults that cannot be at the same time, or of a parameter that does not exist.
        """
        if options.px4 not in PX4_VERSIONS:
            raise VehicleError(f"px4 version {options.px4!r}: allowed are {', '.join(PX4_VERSIONS)}")
        if options.signing_key is not None and options.px4 == "1.13":
            raise VehicleError("PX4 1.13 does not sign messages: leave the key out, or be 1.18")
        _check_numbers(options)
        self.keyring = Keyring(options.signing_key, options.signing_time)
        """The key of its links."""
        self.options = options
        self.system = 1 + options.instance
        file = options.vehicle
        self.steps_per_tick = _steps_per_tick(file)
        from_file = _from_vehicle_file(file, self.system, options.px4)
        self._untouched = Parameters(options.px4, from_file)
        self.parameters = Parameters(options.px4, from_file | dict(options.parameters))
        _check_fixed(self.parameters, self._untouched)
        self.airframe = Airframe(
            file,
            options.world,
            seed=options.seed,
            engine=options.engine,
            start=options.start,
            place_m=options.place_m,
            px4=options.px4,
        )
        self._steps_per_control = max(1, int(_CONTROL_PERIOD_S / (self.airframe.dt_us * 1e-6)))
        self.period_us = self.steps_per_tick * self.airframe.dt_us
        """Time between two states."""
        if self.steps_per_tick <= self.airframe.age_steps:
            self.airframe.foresee(self.steps_per_tick)
        self.start_us = self.airframe.t_us
        self._boot_us = 0
        """Time of the physics at which the vehicle's is zero."""
        self.booting = False
        """Whether the autopilot is down."""
        self.faults = Faults(self, options.faults, seed=options.seed)
        self._start_autopilot(in_air=options.start is not None, ground_home=True)
        self.truth_outbox: list[bytes] = []
        """HIL_STATE_QUATERNION frames with the truth."""
        self.asks_time = True
        """Whether TIMESYNC requests go out with the other messages (in lockstep the peer asks after each state)."""
        self.tells_truth = True
        """Whether anybody wants what gathers in `truth_outbox`."""
        self._foretold: Foretold | None = None
        self._told_ahead: Foretold | None = None
        """The state whose messages went out before its `tick`."""
        self._truth_link = Link(self.system, {}, self.airframe.t_us)
        self._truth_us = self.airframe.t_us
        self._truth_v = self.airframe.rigid.v

    def _start_autopilot(self, *, in_air: bool, ground_home: bool = False, plans: Plans | None = None) -> None:
        """Do what a boot does: autopilot, messages, services, links. `ground_home`: home is on the ground below."""
        options, file, now_us = self.options, self.options.vehicle, self.t_us
        rigid = self.airframe.inner_state()
        home = (rigid.p[0], rigid.p[1], options.world.ground_d_m) if ground_home else rigid.p
        believed = self._dated(self.airframe.believed())
        self.autopilot = Autopilot(
            self.parameters,
            px4=options.px4,
            system=self.system,
            rigid=rigid,
            in_air=in_air,
            now_us=now_us,
            setpoint_delay_us=round(file.command_delay_s * 1e6),
            home=home,
            plans=plans,
        )
        self.telemetry = Telemetry(
            file,
            self.autopilot,
            self.parameters,
            instance=options.instance,
            now=believed,
            rates=self.airframe.rates_followed,
        )
        self.slow = SlowTelemetry(file, self.autopilot, self.parameters, now=believed, rigid=rigid, seed=options.seed)
        self.telemetry.add(self.slow.builders)
        self.services = Services(
            self.autopilot,
            self.parameters,
            self.telemetry,
            system=self.system,
            failures=self.faults,
            keyring=self.keyring,
        )
        self.telemetry.add({ID_MISSION_CURRENT: self.services.mission_current})
        self.companion = Link(self.system, ONBOARD_HZ, now_us, keyring=self.keyring, link_id=0)
        self.ground = Link(self.system, GROUND_HZ, now_us, quiet=True, keyring=self.keyring, link_id=1)
        self.links = [self.companion, self.ground]
        self._texts = 0
        self._parameters_version = -1
        self._beliefs_version = self.airframe.beliefs.version
        self._told_us = self.telemetry.sample_us
        """Stamp of the estimate that was told last, while estimates may repeat themselves."""
        self._held_back: list[dict[int, None]] = [{} for _ in self.links]
        """Messages of each link that wait for a new estimate, in order."""

    @property
    def t_us(self) -> int:
        """Vehicle time: since boot, so that a reboot sets it back."""
        return self.airframe.t_us - self._boot_us

    def begin_boot(self) -> None:
        """Let the autopilot be down: its rotors stop, it hears and says nothing, until `finish_boot`."""
        self.booting = True
        self.autopilot.armed = False

    def finish_boot(self, passed_us: int) -> None:
        """Let the autopilot be there again, disarmed, passed_us after it went down; parameters and plans are kept."""
        plans, battery, was_quiet = self.autopilot.plans, self.slow.battery, self.ground.quiet
        self.keyring.boot()
        self.booting = False
        self._told_ahead = self._foretold = None
        self._boot_us = self.airframe.t_us - passed_us
        self._start_autopilot(in_air=False, plans=plans)
        self.slow.battery = battery
        self.ground.quiet = was_quiet
        self._truth_us = self.t_us
        self._obey_beliefs()

    def _dated(self, estimate: Estimate) -> Estimate:
        """Give an estimate of the physics the stamp of the vehicle's time."""
        return estimate if self._boot_us == 0 else estimate._replace(t_us=max(0, estimate.t_us - self._boot_us))

    def forget_foretold(self) -> None:
        """Tell the next state when its time has come: something was heard that may concern it."""
        self._foretold = None

    def receive(self, frame: Frame, link: Link) -> None:
        """Act on a message that came on a link, at the present vehicle time."""
        self.forget_foretold()
        self.services.handle(frame, link, self.t_us)

    def tick(self, queued: Callable[[int], None] = _nobody) -> None:
        """Advance by one state period and queue what is due after it.

        `queued` is called once, with the vehicle time after the period, as soon as the messages are queued. That is
        before anything of the period is computed where they tell nothing but the past: an estimate that is old enough
        is known already, and the companion can work on it while the vehicle decides and moves.
        """
        airframe = self.airframe
        if airframe.t_us >= self.faults.next_us:
            self.faults.advance(airframe.t_us, self.period_us)
            if self.booting:
                self._wait_for_boot(queued)
                return
        disturbed = airframe.beliefs.version != self._beliefs_version
        if disturbed:
            self._obey_beliefs()
        telemetry, period_us, left = self.telemetry, self.period_us, self.steps_per_tick
        now_us = airframe.t_us - self._boot_us + period_us
        companion, ground = self.companion, self.ground
        due: list[Sequence[int]] = [
            companion.every_state if now_us < companion.next_us else companion.due(now_us, period_us),
            ground.every_state if now_us < ground.next_us else ground.due(now_us, period_us),
        ]
        told, self._told_ahead = self._told_ahead, None
        if told is not None and not due[1]:
            early = True
            believed = self._dated(airframe.believed(left)) if disturbed else told.estimate
            telemetry.update(now_us, believed)
            queued(now_us)
        elif early := left <= airframe.age_steps and self._tell_the_past(due):
            believed = self._dated(airframe.believed(left))
            telemetry.update(now_us, believed)
            self._publish(due if told is None else [[], due[1]], now_us)
            queued(now_us)
        while left > 0:
            left -= self._fly(left)
        if not early:
            believed = self._dated(airframe.believed())
            telemetry.update(now_us, believed)
        if self.slow.update(now_us, believed, airframe.rigid):
            airframe.set_thrust_factor(self.slow.battery.thrust_factor)
        self.services.update(self.links, now_us)
        if not early:
            self._publish(due if told is None else [[], due[1]], now_us)
            queued(now_us)
        if self.tells_truth and now_us >= self._truth_us:
            self._publish_truth(now_us)

    def _wait_for_boot(self, queued: Callable[[int], None]) -> None:
        """Advance by one state period while the autopilot is down; vehicle time is that of before still."""
        self.airframe.advance(STOPPED_SETPOINT, True, self.steps_per_tick)
        queued(self.t_us)
        if self.tells_truth and self.t_us >= self._truth_us:
            self._publish_truth(self.t_us)

    def look_ahead(self) -> None:
        """Prepare the next state, as far as it is known, for `tell_ahead`: done while there is nothing else to do."""
        self._foretold = None
        if not self.asks_time and self.steps_per_tick <= self.airframe.age_steps and self._undisturbed():
            estimate = self._dated(self.airframe.believed(self.steps_per_tick))
            now_us = self.airframe.t_us - self._boot_us + self.period_us
            companion, ground = self.companion, self.ground
            usual = now_us < companion.next_us and now_us < ground.next_us and not ground.every_state
            if usual and _OF_THE_PAST.issuperset(companion.every_state):
                self._foretold = self._foretell(companion.every_state, estimate, now_us)

    def _undisturbed(self) -> bool:
        """Whether only the companion's setpoints can still change anything before the next state.

        That is so while it flies the vehicle and nothing else goes on, and frames are believed as they come (not
        signed).
        """
        autopilot, airframe = self.autopilot, self.airframe
        beliefs = airframe.beliefs
        if autopilot.mode is not Mode.OFFBOARD or not (autopilot.armed and autopilot.offboard_ok):
            return False
        if self.booting or autopilot.texts or beliefs.active or beliefs.version != self._beliefs_version:
            return False
        for link in self.links:
            if link.outbox or link.parameters_to_send or link.faults is not None:
                return False
        return airframe.t_us < self.faults.next_us and self.keyring.key is None

    def _foretell(self, ids: Sequence[int], estimate: Estimate, now_us: int) -> Foretold | None:
        """Build the messages of the next state; what is told to whoever asks before it stays as it is."""
        telemetry, encoder = self.telemetry, self.companion.encoder
        sequence, hot = encoder.sequence, encoder.hot
        if ids == _STATE_ALONE and self.autopilot.has_estimate:
            built = [hot(ID_ODOMETRY, telemetry.odometry_of(estimate))]
        else:
            built = []
            for msg_id, content in telemetry.build_ahead(now_us, estimate, ids):
                if not isinstance(content, bytes):
                    encoder.sequence = sequence
                    return None
                built.append(hot(msg_id, content))
        built.append(hot(ID_TIMESYNC, TIMESYNC.pack(0, now_us * 1000, 0, 0)))
        encoder.sequence = sequence  # nothing is sent yet
        return Foretold(now_us, sequence, estimate, built)

    def tell_ahead(self) -> Foretold | None:
        """Give the messages of the next state to be sent now, if nothing that may still happen can change them.

        The companion's setpoint acts on the motion, and what is told is the past. None: the state must wait for `tick`.
        """
        foretold, encoder = self._foretold, self.companion.encoder
        if foretold is None or encoder.sequence != foretold.sequence or self.companion.outbox:
            return None
        if self.airframe.t_us >= self.faults.next_us:
            return None
        encoder.sequence = (foretold.sequence + len(foretold.frames)) & 0xFF
        self._told_ahead, self._foretold = foretold, None
        return foretold

    def _tell_the_past(self, due: list[Sequence[int]]) -> bool:
        """Tell whether the messages that are due hold nothing of the present motion."""
        for ids in due:  # noqa: SIM110 (in the place of `all`: this is asked for every state)
            if not _OF_THE_PAST.issuperset(ids):
                return False
        return True

    def _publish(self, due: list[Sequence[int]], now_us: int) -> None:
        """Queue the messages that are due on each link, parameters that were asked for, and texts."""
        if self.airframe.beliefs.active:
            due = self._without_repeats(due)
        builders = self.telemetry.builders
        for link, ids in zip(self.links, due, strict=True):
            frame, queue = link.encoder.hot, link.outbox.append
            for msg_id in ids:
                if msg_id == ID_TIMESYNC:
                    if self.asks_time:
                        queue(frame(msg_id, TIMESYNC.pack(0, now_us * 1000, 0, 0)))
                elif msg_id in builders:
                    content = builders[msg_id]()
                    if isinstance(content, bytes):
                        queue(frame(msg_id, content))
                    elif content is not None:
                        link.send(content)
            if link.parameters_to_send:
                self.services.send_parameters(link, max(1, _PARAMETERS_PER_S * self.period_us // 1_000_000))
        if self.autopilot.texts:
            self._publish_texts()

    def _without_repeats(self, due: list[Sequence[int]]) -> list[Sequence[int]]:
        """Hold messages back that would tell the same estimate again; they go out with the next one, as PX4's do."""
        repeated = self.telemetry.sample_us == self._told_us
        self._told_us = self.telemetry.sample_us
        kept: list[Sequence[int]] = []
        for held, ids in zip(self._held_back, due, strict=True):
            if repeated:
                held.update(dict.fromkeys(i for i in ids if i in _OF_THE_ESTIMATE))
                kept.append([i for i in ids if i not in _OF_THE_ESTIMATE])
            else:
                kept.append([*ids, *(i for i in held if i not in ids)])
                held.clear()
        return kept

    def heartbeat(self) -> None:
        """Queue a HEARTBEAT on every link now, whatever its interval."""
        for link in self.links:
            link.send(self.telemetry.heartbeat())

    def _publish_texts(self) -> None:
        """Queue the autopilot's sentences on every link; of too many at once the last are lost, as PX4's are."""
        for severity, sentence in self.autopilot.texts[:_TEXTS_MAX]:
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

    def _fly(self, left: int) -> int:
        """Run the autopilot once, and the airframe with its order; gives for how many steps, at most `left`, it holds.

        Fewer when a delayed setpoint arrives on the way, or when the autopilot's own period ends.
        """
        airframe, autopilot = self.airframe, self.autopilot
        now_us = airframe.t_us - self._boot_us
        steps = left if left < self._steps_per_control else self._steps_per_control
        if autopilot.offboard.under_way:
            next_us = autopilot.offboard.under_way[0][0]
            if next_us > now_us:
                steps = min(steps, -(-(next_us - now_us) // airframe.dt_us))
        if self.parameters.version != self._parameters_version:
            self._obey_parameters()
        beliefs = airframe.beliefs
        here = airframe.inner_state() if beliefs.active else airframe.rigid
        setpoint, fresh, glimpse = autopilot.update(now_us, here, steps * airframe.dt_us * 1e-6)
        if glimpse is not None:
            airframe.advance(glimpse, True, 1)
        if glimpse is None or steps > 1:
            airframe.advance(setpoint, fresh, steps if glimpse is None else steps - 1)
        here = airframe.inner_state() if beliefs.active else airframe.rigid
        autopilot.observe(airframe.t_us - self._boot_us, here)
        return steps

    def _obey_beliefs(self) -> None:
        """Let the autopilot and the messages know what has happened to the estimate."""
        beliefs = self.airframe.beliefs
        self._beliefs_version = beliefs.version
        self._told_us = self.telemetry.sample_us
        self.telemetry.reset_counter = beliefs.reset_counter
        self.telemetry.stamp_shift_us = beliefs.stamp_shift_us
        for reset in beliefs.take_resets():
            self.autopilot.estimate_reset(*reset)
        self.autopilot.see_estimate(beliefs.available)

    def _obey_parameters(self) -> None:
        """Hand changed parameters of the inner loops over to them."""
        self._parameters_version = self.parameters.version
        self.airframe.set_gains(_gains(self.options.vehicle, self.parameters, self._untouched))


def _check_numbers(options: VehicleOptions) -> None:
    """Refuse what would outgrow the numbers of the messages. Raises VehicleError."""
    world, start = options.world, options.start
    for what, vector in (("force", world.force_n), ("wind", world.wind_m_s)):
        if len(vector) != 3:
            raise VehicleError(f"{what} {vector!r}: must be three numbers north, east, down")
    limits = (
        ("start [m]", (*start[0], start[1]) if start is not None else (), _PLACE_MAX_M),
        ("place [m]", options.place_m, _PLACE_MAX_M),
        ("force [N]", world.force_n, _FORCE_MAX_N),
        ("wind [m/s]", world.wind_m_s, _WIND_MAX_M_S),
        ("turbulence", (world.turbulence,), _TURBULENCE_MAX),
        ("gravity factor", (world.gravity_factor,), _GRAVITY_FACTOR_MAX),
        ("seed", (options.seed, world.seed), _SEED_MAX),
    )
    for what, numbers, limit in limits:
        for number in numbers:
            if not -limit <= number <= limit:
                raise VehicleError(f"{what} {number!r:.30}: allowed is up to {limit:g}")


def _check_fixed(parameters: Parameters, untouched: Parameters) -> None:
    """Refuse parameters whose value would not be what is flown. Raises VehicleError."""
    for name in sorted(READ_ONLY | {"MAV_SYS_ID", "MAV_COMP_ID"}):
        if parameters[name] != untouched[name]:
            why = "the vehicle file says it" if name in READ_ONLY else "the instance says who the vehicle is"
            raise VehicleError(f"{name} = {parameters[name]:g}: must be {untouched[name]:g}, {why}")


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


def _from_vehicle_file(file: VehicleFile, system: int, px4: str) -> dict[str, int | float]:
    """Give the parameters that whoever set this vehicle up would have set."""
    return {
        "MAV_SYS_ID": system,
        "COM_OBL_RC_ACT": 5,  # Hold: PX4's own 0 needs a pilot with sticks
        "MPC_THR_HOVER": file.mass_kg * _STANDARD_G / (4.0 * file.rotor_thrust_max_n),
        "THR_MDL_FAC": file.curve_factor,
        "MC_ROLL_P": file.attitude_gain_1_s[0],
        "MC_PITCH_P": file.attitude_gain_1_s[1],
        "MC_YAW_P": file.attitude_gain_1_s[2],
        **{
            f"MC_{axis}RATE_I": ratio * float(DEFAULTS[f"MC_{axis}RATE_P"])
            for axis, ratio in zip(("ROLL", "PITCH", "YAW"), file.rate_integral_1_s, strict=True)
        },
        **({"MC_REF_W_N": 2.0 / file.attitude_lag_s} if px4 != "1.13" and file.attitude_lag_s > 0.0 else {}),
        **{f"CA_ROTOR{k}_PX": x for k, x in enumerate(file.rotor_x_m)},
        **{f"CA_ROTOR{k}_PY": y for k, y in enumerate(file.rotor_y_m)},
        **{f"CA_ROTOR{k}_KM": m for k, m in enumerate(file.rotor_yaw_m)},
    }
