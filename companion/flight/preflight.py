"""What must hold before anything moves.

The first gates need only the files: certificate, delay margin, the reference within its limits. `Preflight` asks the
connected autopilot for its version, its parameters and the message rates that the flight needs, measures the link, and
lets the gates of `flight.gates` judge.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from datetime import UTC, datetime

from companion.config import Flight, Vehicle
from companion.control.certificate import certify, disturbance_overcome
from companion.control.sampled import DELAY_STRIDE_S, INTERVAL_STRIDE_S, Margins
from companion.errors import RefusedError
from companion.flight.adaptation import Adaptation, adapted
from companion.flight.findings import Finding, Gate, Measured, Verdict, passed, refusal, refused
from companion.flight.gates import DOWN, judge
from companion.flight.gates_setup import NEEDED, calibrated
from companion.flight.health import ESTIMATOR_STATUS, SYS_STATUS
from companion.flight.inspection import reference_problems
from companion.flight.loop_margins import DELAY_MARGIN_MIN_S, loop_margins
from companion.flight.measure import LinkMeter, silence_limit_s
from companion.flight.phases import Autopilot, Cause, FlightEnded, LandedState
from companion.flight.schedule import choose
from companion.flight.silence import Silence, when_silent
from companion.flight.surroundings import Problem, place_problems
from companion.link import codec
from companion.link.operations import Operation, Operations, Retry
from companion.link.telemetry import VehicleState
from companion.trajectory.anchored import Trajectory, anchored

MEASURE_S = 1.0
ASK_FASTER = 0.8
"""Asking for exactly the source's period loses messages: ask for a shorter interval."""
REQUEST_TIMEOUT_S = 8.0
FIRST_STATE_TIMEOUT_S = 5.0
REPORT_TIMEOUT_S = 2.5
"""Reports that do not come within this time after asking are judged as missing."""
ASK_TIME_INTERVAL_S = 0.05
WORDS_WAIT_S = 0.3
"""What the autopilot says against arming may come after its answer."""
OPTIONAL_RETRY = Retry(0.25, 3)
"""An autopilot may not have a parameter, and older ones then say nothing."""

PARAMETERS = (
    *("COM_OBL_RC_ACT", "COM_OF_LOSS_T", "NAV_RCL_ACT", "MAV_TYPE", "THR_MDL_FAC"),
    *("MAV_FWDEXTSP", "NAV_DLL_ACT", "COM_RCL_EXCEPT", "COM_DLL_EXCEPT", "COM_RC_IN_MODE", "COM_RC_LOSS_T"),
    *("COM_FAIL_ACT_T", "MAN_OVERRIDE_SPD", "COM_RC_OVERRIDE", "COM_LOW_BAT_ACT", "COM_QC_ACT", "BAT_LOW_THR"),
    *("COM_DISARM_PRFLT", "COM_DISARM_LAND", "COM_SPOOLUP_TIME", "COM_POS_FS_ACT", "COM_POS_FS_EPH"),
    *("COM_VEL_FS_EVH", "COM_ARM_WO_GPS", "COM_ARMABLE", "COM_FLTMODE_BOOT", "GF_ACTION", "GF_SOURCE"),
    *("GF_MAX_HOR_DIST", "GF_MAX_VER_DIST", "RTL_RETURN_ALT", "FD_FAIL_R", "FD_FAIL_P", "FD_FAIL_R_TTRI"),
    *("FD_FAIL_P_TTRI", "FD_ALT_LOSS", "CBRK_FLIGHTTERM", "CBRK_SUPPLY_CHK", "MC_ROLLRATE_MAX"),
    *("MC_PITCHRATE_MAX", "MC_YAWRATE_MAX", "MC_REF_W_N", "MC_REF_FF", "MC_AIRMODE", "MC_BAT_SCALE_EN"),
    *("MPC_THR_HOVER", "MPC_TILTMAX_AIR", "IMU_GYRO_CUTOFF", "IMU_DGYRO_CUTOFF", "EKF2_HGT_REF", "SYS_FAILURE_EN"),
)
"""What a flight depends on; the log keeps them all. Those of `gates_setup.NEEDED` come first and are a must."""
CALIBRATION_PARAMETERS = (
    *("MC_ROLLRATE_P", "MC_ROLLRATE_I", "MC_PITCHRATE_P", "MC_PITCHRATE_I", "MC_YAWRATE_P", "MC_YAWRATE_I"),
    *("MC_ROLL_P", "MC_PITCH_P", "MC_YAW_P"),
)
"""Beside those, where a vehicle is calibrated: what its file says of the loops. None is a must."""
BASELINE_PARAMETERS = (
    *("MPC_XY_P", "MPC_Z_P", "MPC_XY_VEL_P_ACC", "MPC_XY_VEL_I_ACC", "MPC_XY_VEL_D_ACC"),
    *("MPC_Z_VEL_P_ACC", "MPC_Z_VEL_I_ACC", "MPC_Z_VEL_D_ACC", "MPC_XY_VEL_MAX", "MPC_Z_VEL_MAX_UP"),
    *("MPC_Z_VEL_MAX_DN", "MPC_TILTMAX_AIR", "MPC_THR_HOVER"),
)
"""Beside those, where PX4's own position controller flies: what its tracking goes by. For the summary; none is a
must."""

MORE_PARAMETERS = {"law": (), "px4": BASELINE_PARAMETERS, "calibration": CALIBRATION_PARAMETERS}

CURRENT_MODE = 436
EXTENDED_SYS_STATE = 245
HOME_POSITION = 242
ATTITUDE_TARGET = 83
"""Tells the thrust of the autopilot's own hover."""

MESSAGE_RATES_HZ = {CURRENT_MODE: 10.0, EXTENDED_SYS_STATE: 5.0, SYS_STATUS: 5.0, ESTIMATOR_STATUS: 5.0}
"""Beside ODOMETRY, which is asked for at the vehicle file's rate."""
HOLD_THRUST_HZ = 20.0
"""ATTITUDE_TARGET, where the thrust of the autopilot's own hover is measured."""
RUN_PREARM_CHECKS = 401


def gate_gains(
    vehicle: Vehicle, output: str = "rates", *, allow_uncertified: bool = False, brief: bool = False
) -> Margins:
    """The certificate and the delay margin; every flight passes here.

    Args:
        vehicle: the vehicle file.
        output: what the law sends.
        allow_uncertified: refuse nothing.
        brief: look at the margins no further than what is asked of them: the same verdict in a fraction of the time.

    Raises:
        RefusedError: with the figure that fails.
    """
    parameters = vehicle.parameters()
    failure = certify(parameters.gains, parameters.model.drag).failure()
    over = " over attitude setpoints" if output == "attitude" else ""
    hint = "use output rates, or lower gains" if over else "change [controller], see `companion certify`"
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
        found = loop_margins(vehicle, output, DELAY_MARGIN_MIN_S + DELAY_STRIDE_S, gap + 1.5 * INTERVAL_STRIDE_S)
    else:
        found = loop_margins(vehicle, output)
    if gap > found.interval_max_s > 0.0 and not allow_uncertified:
        raise RefusedError(
            f"vehicle {vehicle.name!r}: limits.state_gap_max_s {gap * 1e3:g} ms is longer than the"
            f" {found.interval_max_s * 1e3:.0f} ms that the sampled loop{over} bears; lower it"
            + (f", or {hint}" if over else "")
        )
    if found.delay_margin_s < DELAY_MARGIN_MIN_S and not allow_uncertified:
        raise RefusedError(
            f"the gains of vehicle {vehicle.name!r}{over} leave a delay margin of {found.delay_margin_s * 1e3:.1f} ms,"
            f" {DELAY_MARGIN_MIN_S * 1e3:g} ms are required; {hint}"
        )
    return found


def gate_calibration(flight: Flight) -> None:
    """The vehicle was calibrated, or is a simulator.

    Raises:
        RefusedError: neither.
    """
    finding = calibrated(flight, datetime.now(UTC).date())
    if finding.verdict is Verdict.REFUSED:
        raise RefusedError(finding.told)


def gains_finding(vehicle: Vehicle, output: str = "rates") -> Finding:
    """`gate_gains` as a line of the table of gates."""
    limit = f"certified, {DELAY_MARGIN_MIN_S * 1e3:g} ms of delay margin"
    try:
        found = gate_gains(vehicle, output)
    except RefusedError as error:
        return refused(Gate.GAINS, "refused", limit, str(error), "")
    shown = f"{found.delay_margin_s * 1e3:.1f} ms"
    return passed(Gate.GAINS, shown, limit, f"the gains are certified, with a delay margin of {shown}")


def gate_reference(trajectory: Trajectory, vehicle: Vehicle) -> None:
    """The trajectory is smooth and keeps the vehicle's limits; where it is anchored does not matter.

    Raises:
        RefusedError: with the first violation.
    """
    _refuse(trajectory, reference_problems(trajectory, vehicle))


def gate_place(trajectory: Trajectory, height_min_m: float) -> None:
    """The trajectory stays above the ground and within the fence that came with it, where its anchor says where it is.

    One that begins wherever the vehicle holds is looked at there (`surroundings.gate_course`).

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
    """What is asked of and measured on the connected autopilot; PREFLIGHT lasts until `done`.

    Nothing is changed on the vehicle but the intervals of messages on this link.

    Args:
        flight: what is to be flown.
        operations: requests to the autopilot.
        autopilot: what it says of itself; gets the parameters that are read.
        notify: called with lines for people: warnings, and what happens when this program falls silent.
        adapt: called when all gates let it pass and the measured loop asks for other setpoints or gains.
    """

    def __init__(
        self,
        flight: Flight,
        operations: Operations,
        autopilot: Autopilot,
        notify: Callable[[str], None],
        adapt: Callable[[Adaptation], None] = lambda adaptation: None,
    ) -> None:
        self._adapt = adapt
        self._flight = flight
        self._ops = operations
        self._autopilot = autopilot
        self._notify = notify
        calibrates = flight.calibration is not None
        self.meter = LinkMeter(silence_limit_s(flight.vehicle.link.state_rate_hz, calibrates=calibrates))
        """Measures the link; the loop tells it what comes."""
        self.streams: dict[int, int] = {}
        """Intervals of further messages, asked for at the beginning [us] (`Operations.set_message_interval`)."""
        self.findings: list[Finding] = []
        """Of all gates, once they have judged."""
        self._begun_s: float | None = None
        self._measuring_from_s = 0.0
        self._asked_time_s = -math.inf
        self._rate: Operation | None = None
        self._version: Operation | None = None
        self._reads: dict[str, Operation] = {}
        self._words: Operation | None = None

    def done(self, now_s: float) -> bool:
        """Goes on asking; True when everything is known and fine.

        Raises:
            FlightEnded: a gate refuses.
        """
        if self._begun_s is None:
            self._begun_s = now_s
            self._ask(now_s)
        self._ask_time(now_s)
        if not self._known(now_s, self._begun_s) or not self._explained(now_s):
            return False
        self.meter.running = False
        self._judge(now_s)
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
        self._rate = ops.set_message_interval(codec.ODOMETRY, int(1e6 / rate * ASK_FASTER), now_s)
        for msgid, hz in MESSAGE_RATES_HZ.items():
            ops.set_message_interval(msgid, int(1e6 / hz), now_s)
        for msgid, interval_us in self.streams.items():
            ops.set_message_interval(msgid, interval_us, now_s)
        if self._flight.calibration is not None:
            ops.set_message_interval(ATTITUDE_TARGET, int(1e6 / HOLD_THRUST_HZ), now_s)
        self._version = ops.request_message(codec.AUTOPILOT_VERSION, now_s)
        ops.request_message(HOME_POSITION, now_s)
        more = MORE_PARAMETERS[self._flight.output.controller]
        for name in dict.fromkeys((*PARAMETERS, *more)):
            retry = Retry() if name in NEEDED else OPTIONAL_RETRY
            self._reads[name] = ops.read_parameter(name, now_s, retry)

    def _ask_time(self, now_s: float) -> None:
        """TIMESYNC requests while the link is measured."""
        own_ns = round(now_s * 1e9)
        if now_s - self._asked_time_s >= ASK_TIME_INTERVAL_S and self.meter.asks(own_ns):
            self._asked_time_s = now_s
            self._ops.ask_time(own_ns)

    def _known(self, now_s: float, begun_s: float) -> bool:
        """Whether the gates can judge: all was answered, or will not be.

        Raises:
            FlightEnded: the autopilot does not answer at all.
        """
        assert self._rate is not None and self._version is not None
        if self._rate.pending:
            if now_s - begun_s > REQUEST_TIMEOUT_S:
                raise FlightEnded(Cause.REFUSED, f"the autopilot did not answer: {self._rate.what}")
            return False
        if not self.meter.running:
            self.meter.start()
            self._measuring_from_s = now_s
        if not self._rate.accepted or self._unread():
            return True
        first_s = self.meter.first_s
        if first_s is None:
            return now_s - self._measuring_from_s > FIRST_STATE_TIMEOUT_S
        pending = [operation for operation in (self._version, *self._reads.values()) if operation.pending]
        if pending and now_s - begun_s <= REQUEST_TIMEOUT_S:
            return False
        reported = self._reported() or now_s - self._measuring_from_s > REPORT_TIMEOUT_S
        return reported and now_s - first_s >= MEASURE_S

    def _reported(self) -> bool:
        """Whether everything that the gates look at has been told."""
        a = self._autopilot
        heard = a.mode is not None and a.landed is not LandedState.UNDEFINED
        return heard and None not in (a.system_status, a.health, a.estimator)

    def _explained(self, now_s: float) -> bool:
        """Where the autopilot would not arm it is asked why, and has had the time to say it."""
        a = self._autopilot
        if a.armed or a.health is None or a.health.can_arm or a.mode in DOWN or self._unread():
            return True
        if self._words is None:
            self._words = self._ops.command(RUN_PREARM_CHECKS, (0.0,) * 7, "asking what prevents arming", now_s)
        return self._words.ended_s is not None and now_s - self._words.ended_s >= WORDS_WAIT_S

    def _unread(self) -> dict[str, str]:
        """The parameters that must be known and will not be, with the reasons."""
        reads = ((name, self._reads[name]) for name in NEEDED)
        return {name: read.sentence for name, read in reads if not read.pending and not read.accepted}

    def _judge(self, now_s: float) -> None:
        """Lets the gates judge, and tells what people must know.

        Raises:
            FlightEnded: a gate refuses.
        """
        for name, operation in self._reads.items():
            if operation.accepted and operation.value is not None:
                self._autopilot.parameters[name] = float(operation.value)
        assert self._rate is not None
        words = () if self._words is None else self._ops.texts.complaints(self._words.asked_s, now_s)
        figures = self.meter.figures(now_s)
        choice = choose(self._flight, figures)
        flown = adapted(self._flight, choice.adaptation)
        measured = Measured(
            *(flown, self._autopilot, self._ops.version, figures, self._unread()),
            rate_refusal="" if self._rate.accepted else self._rate.sentence,
            complaints=tuple(words),
        )
        self.findings = [choice.finding, *judge(measured)]
        for finding in self.findings:
            if finding.verdict is Verdict.WARNING:
                self._notify(f"warning: {finding.told}")
        against = refusal(self.findings)
        if against:
            raise FlightEnded(Cause.REFUSED, against)
        if choice.adaptation is not None:
            self._adapt(choice.adaptation)
        self._notify(self.silence.sentence)

    @property
    def silence(self) -> Silence:
        """What the autopilot does when this program falls silent."""
        health = self._autopilot.health
        return when_silent(self._autopilot.parameters, sticks=health is not None and health.sticks)
