"""The gates between connecting and flying: what must hold before anything moves, each with its figure and what to do.

Offline gates (`gates_before_connecting`) need only the files: certificate, delay margin, the reference within its
limits. `Preflight` asks the connected autopilot for its version, its parameters and the message rates that the flight
needs, and measures the state rate.
"""

from __future__ import annotations

from collections.abc import Sequence

from companion.config import Flight, Vehicle
from companion.control.certificate import certify, disturbance_overcome
from companion.control.sampled import DELAY_STRIDE_S, INTERVAL_STRIDE_S, Margins, Timing, margins
from companion.errors import RefusedError
from companion.flight.inspection import reference_problems
from companion.flight.phases import Autopilot, Cause, FlightEnded
from companion.flight.surroundings import Problem, place_problems
from companion.link import codec
from companion.link.operations import Operation, Operations
from companion.link.telemetry import VehicleState
from companion.trajectory.anchored import Trajectory, anchored

DELAY_MARGIN_MIN_S = 0.010
RATE_FLOOR = 0.8
"""Share of the vehicle file's state rate below which a flight is refused."""
MEASURE_S = 1.0
ASK_FASTER = 0.8
"""Asking for exactly the source's period loses messages: ask for a shorter interval."""
REQUEST_TIMEOUT_S = 8.0
FIRST_STATE_TIMEOUT_S = 5.0

PARAMETERS = ("COM_OBL_RC_ACT", "COM_OF_LOSS_T", "NAV_RCL_ACT", "MAV_TYPE", "THR_MDL_FAC")
NEEDED = ("COM_OBL_RC_ACT", "COM_OF_LOSS_T", "NAV_RCL_ACT", "MAV_TYPE")
"""What the gates and the loop's own silence go by."""
BASELINE_PARAMETERS = (
    *("MPC_XY_P", "MPC_Z_P", "MPC_XY_VEL_P_ACC", "MPC_XY_VEL_I_ACC", "MPC_XY_VEL_D_ACC"),
    *("MPC_Z_VEL_P_ACC", "MPC_Z_VEL_I_ACC", "MPC_Z_VEL_D_ACC", "MPC_XY_VEL_MAX", "MPC_Z_VEL_MAX_UP"),
    *("MPC_Z_VEL_MAX_DN", "MPC_TILTMAX_AIR", "MPC_THR_HOVER"),
)
"""Beside those, where PX4's own position controller flies: what its tracking goes by. For the summary; none is a
must."""

_STICK_ACTIONS = (0.0, 1.0, 2.0)
"""COM_OBL_RC_ACT: Position, Altitude, Stabilized; without sticks NAV_RCL_ACT acts instead."""
_NO_ACTIONS = (0.0, 7.0)
"""NAV_RCL_ACT: disabled, and "Hold, no failsafe"."""

CURRENT_MODE = 436
EXTENDED_SYS_STATE = 245
HOME_POSITION = 242
ATTITUDE_TARGET = 83

MESSAGE_RATES_HZ = {CURRENT_MODE: 10.0, EXTENDED_SYS_STATE: 5.0}
"""Beside ODOMETRY, which is asked for at the vehicle file's rate."""


def timing(vehicle: Vehicle) -> Timing:
    """The sampled loop of a vehicle file."""
    x, y, z = vehicle.autopilot.rate_lag_s
    return Timing(
        1.0 / vehicle.link.state_rate_hz,
        vehicle.delay_s,
        (x, y, z, vehicle.rotors.lag_s),
        vehicle.controller.prediction,
    )


def gate_gains(vehicle: Vehicle, *, allow_uncertified: bool = False, brief: bool = False) -> Margins:
    """The certificate and the delay margin; every flight passes here.

    Args:
        vehicle: the vehicle file.
        allow_uncertified: refuse nothing.
        brief: look at the margins no further than what is asked of them: the same verdict in a fraction of the time.

    Raises:
        RefusedError: with the figure that fails.
    """
    parameters = vehicle.parameters()
    failure = certify(parameters.gains, parameters.model.drag).failure()
    hint = "change [controller], see `companion certify`"
    if failure and not allow_uncertified:
        raise RefusedError(f"the gains of vehicle {vehicle.name!r} are not certified: {failure}; {hint}")
    overcome = disturbance_overcome(parameters.gains)
    ball = vehicle.limits.disturbance_max_m_s2
    if ball > overcome and not allow_uncertified:
        raise RefusedError(
            f"vehicle {vehicle.name!r}: limits.disturbance_max_m_s2 {ball:g} is more than the {overcome:.2f} m/s^2 that"
            " the bounded position error holds against while the estimator stands still; raise"
            " controller.position_error_max_m or lower the limit"
        )
    gap = vehicle.limits.state_gap_max_s
    if brief:
        found = margins(parameters, timing(vehicle), DELAY_MARGIN_MIN_S + DELAY_STRIDE_S, gap + 1.5 * INTERVAL_STRIDE_S)
    else:
        found = margins(parameters, timing(vehicle))
    if gap > found.interval_max_s > 0.0 and not allow_uncertified:
        raise RefusedError(
            f"vehicle {vehicle.name!r}: limits.state_gap_max_s {gap * 1e3:g} ms is longer than the"
            f" {found.interval_max_s * 1e3:.0f} ms that the sampled loop bears; lower it"
        )
    if found.delay_margin_s < DELAY_MARGIN_MIN_S and not allow_uncertified:
        raise RefusedError(
            f"the gains of vehicle {vehicle.name!r} leave a delay margin of {found.delay_margin_s * 1e3:.1f} ms,"
            f" {DELAY_MARGIN_MIN_S * 1e3:g} ms are required; {hint}"
        )
    return found


def gate_reference(trajectory: Trajectory, vehicle: Vehicle) -> None:
    """The trajectory is smooth and keeps the vehicle's limits; where it is anchored does not matter.

    Raises:
        RefusedError: with the first violation.
    """
    _refuse(trajectory, reference_problems(trajectory, vehicle))


def gate_place(trajectory: Trajectory, height_min_m: float) -> None:
    """The trajectory stays above the ground and within the fence that came with it, where its anchor says where it is.

    One that begins wherever the vehicle holds is looked at there (`surroundings.gate_ground`).

    Raises:
        RefusedError: with the first figure that fails.
    """
    if trajectory.anchor != "here":
        path = anchored(trajectory, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        _refuse(trajectory, place_problems(path, None, height_min_m)[2])


def _refuse(trajectory: Trajectory, problems: Sequence[Problem]) -> None:
    if problems:
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise RefusedError(f"trajectory {trajectory.name!r}: {problems[0].sentence}{more}")


class Preflight:
    """What is asked of and measured on the connected autopilot; PREFLIGHT lasts until `done`."""

    def __init__(self, flight: Flight, operations: Operations, autopilot: Autopilot) -> None:
        self._flight = flight
        self._ops = operations
        self._autopilot = autopilot
        self._begun_s: float | None = None
        self._pending: list[Operation] = []
        self._reads: dict[str, Operation] = {}
        self._first_s: float | None = None
        self._states = 0
        self._measuring_from_s: float | None = None

    def on_state(self, state: VehicleState) -> None:
        """Counts states once the rates have been asked for."""
        if self._measuring_from_s is not None:
            self._states += 1

    def done(self, now_s: float) -> bool:
        """Goes on asking; True when everything is known and fine.

        Raises:
            FlightEnded: a gate refuses.
        """
        if self._begun_s is None:
            self._begun_s = now_s
            self._ask(now_s)
        if any(operation.pending for operation in self._pending):
            if now_s - self._begun_s > REQUEST_TIMEOUT_S:
                waiting = ", ".join(o.what for o in self._pending if o.pending)
                raise FlightEnded(Cause.REFUSED, f"the autopilot did not answer: {waiting}")
            return False
        if self._measuring_from_s is None:
            self._measuring_from_s = now_s
            self._gate_answers()
        if self._first_s is None:
            if self._states > 0:
                self._first_s, self._states = now_s, 0
            elif now_s - self._measuring_from_s > FIRST_STATE_TIMEOUT_S:
                raise FlightEnded(
                    Cause.REFUSED,
                    "no usable ODOMETRY within 5 s: the estimator is not ready, or the link does not carry it",
                )
            return False
        if now_s - self._first_s < MEASURE_S:
            return False
        self._gate_rate(self._states / (now_s - self._first_s))
        return True

    def takeoff_amsl_m(self, state: VehicleState | None) -> float | None:
        """Altitude for NAV_TAKEOFF above mean sea level [m]: the flight file's height above where the vehicle stands.

        None, for the autopilot's own take-off height, while the home position is not known.
        """
        home, altitude = self._autopilot.home, self._autopilot.home_amsl_m
        if state is None or home is None or altitude is None:
            return None
        return altitude - (state.p[2] - home[2]) + self._flight.takeoff_altitude_m

    def _ask(self, now_s: float) -> None:
        ops = self._ops
        rate = self._flight.vehicle.link.state_rate_hz
        self._pending.append(ops.set_message_interval(codec.ODOMETRY, int(1e6 / rate * ASK_FASTER), now_s))
        for msgid, hz in MESSAGE_RATES_HZ.items():
            self._pending.append(ops.set_message_interval(msgid, int(1e6 / hz), now_s))
        for msgid in (codec.AUTOPILOT_VERSION, HOME_POSITION):
            self._pending.append(ops.request_message(msgid, now_s))
        law = self._flight.output.controller == "law"
        for name in PARAMETERS if law else (*PARAMETERS, *BASELINE_PARAMETERS):
            self._reads[name] = ops.read_parameter(name, now_s)
            self._pending.append(self._reads[name])

    def _gate_answers(self) -> None:
        for name, operation in self._reads.items():
            if operation.accepted and operation.value is not None:
                self._autopilot.parameters[name] = float(operation.value)
        odometry = self._pending[0]
        if not odometry.accepted:
            raise FlightEnded(Cause.REFUSED, f"{odometry.sentence}; the flight needs it as its one state")
        for name in NEEDED:
            if name not in self._autopilot.parameters:
                raise FlightEnded(Cause.REFUSED, f"{self._reads[name].sentence}; the flight must know it")
        sends = self._flight.output.sends
        if self._autopilot.parameters.get("MAV_TYPE") == 0.0 and sends in {"rates", "attitude"}:
            raise FlightEnded(
                Cause.REFUSED,
                "parameter MAV_TYPE is 0 (generic): PX4 then takes the thrust of SET_ATTITUDE_TARGET as zero; set it to"
                " the vehicle's type (2 for a quadrotor)",
            )
        self._gate_failsafe()
        version = self._ops.version
        if sends == "actuators" and (version is None or not version.accepts_actuator_control):
            label = "an unknown version" if version is None else f"version {version.label}"
            raise FlightEnded(
                Cause.REFUSED,
                f"output actuators: the autopilot is {label}, and PX4 ignores SET_ACTUATOR_CONTROL_TARGET since 1.14;"
                " use output rates",
            )

    def _gate_failsafe(self) -> None:
        """Something must happen when the setpoints cease: with these two there is nothing, PX4 holds the last one."""
        parameters = self._autopilot.parameters
        on_loss, without_sticks = parameters.get("COM_OBL_RC_ACT"), parameters.get("NAV_RCL_ACT")
        if on_loss in _STICK_ACTIONS and without_sticks in _NO_ACTIONS:
            raise FlightEnded(
                Cause.REFUSED,
                f"parameters COM_OBL_RC_ACT {on_loss:g} and NAV_RCL_ACT {without_sticks:g}: without sticks PX4 would go"
                " on with the last setpoint when setpoints cease; set COM_OBL_RC_ACT to 5 (Hold), 4 (Land) or 3"
                " (Return)",
            )

    def _gate_rate(self, rate: float) -> None:
        wanted = self._flight.vehicle.link.state_rate_hz
        floor = RATE_FLOOR * wanted
        if rate < floor:
            raise FlightEnded(
                Cause.REFUSED,
                f"ODOMETRY comes at {rate:.0f} Hz, {floor:.0f} Hz are required for the vehicle file's {wanted:.0f} Hz:"
                " check the link's data rate, or lower link.state_rate_hz and certify again",
            )
