"""Every gate by itself: what it passes, warns of and refuses, in which words; and what is measured of a link."""

from __future__ import annotations

import math
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import pytest

from companion.config import Flight, build_flight, bundled_root
from companion.flight.findings import Gate, Measured, Verdict, refusal
from companion.flight.gates import GATES, judge
from companion.flight.gates_setup import NEEDED
from companion.flight.health import EstimatorFlag, EstimatorHealth, SystemHealth
from companion.flight.measure import LinkFigures, LinkMeter, silence_limit_s
from companion.flight.phases import Autopilot, LandedState
from companion.flight.preflight import PARAMETERS, gains_finding
from companion.flight.silence import Reaction, when_silent
from companion.link import modes
from companion.link.codec import Timesync
from companion.link.telemetry import StateRejection, VehicleState
from companion.link.version import AutopilotVersion

HEALTHY = {
    "COM_OBL_RC_ACT": 5.0, "COM_OF_LOSS_T": 0.5, "NAV_RCL_ACT": 2.0, "MAV_TYPE": 2.0, "MAV_FWDEXTSP": 1.0,
    "NAV_DLL_ACT": 0.0, "THR_MDL_FAC": 0.0, "MC_BAT_SCALE_EN": 0.0, "MPC_THR_HOVER": 0.49, "BAT_LOW_THR": 0.15,
    "COM_POS_FS_EPH": 5.0, "GF_ACTION": 2.0, "CBRK_FLIGHTTERM": 121212.0, "FD_FAIL_R": 60.0, "FD_FAIL_P": 60.0,
    "MAN_OVERRIDE_SPD": 1.0, "COM_RC_IN_MODE": 1.0, "RTL_RETURN_ALT": 30.0,
}  # fmt: skip
LINK = LinkFigures(250, 250.0, 0.020, 0.001, 0.005, 0, (), 0, 0, 0.002, 0.0005, False)
VERSION = AutopilotVersion((1, 18, 0), 255, 1 << 6 | 1 << 7, 0)
SYSTEM = SystemHealth(sticks=False, fence_kept=True, can_arm=True, battery=0.9)
ESTIMATOR = EstimatorHealth(EstimatorFlag(63), 0.1, 0.1, 0.1, 0.1, 0.3)


def flight(**changes: Any) -> Flight:
    hover = {"name": "hover", "shape": "hover", "duration_s": 1.0, "hover": {"point_m": [0.0, 0.0, 0.0]}}

    def adjust(data: dict[str, Any]) -> None:
        for key, value in changes.items():
            *path, last = key.split("__")
            table = data
            for name in path:
                table = table.setdefault(name, {})
            table[last] = value

    return build_flight({"name": "test", "vehicle": "bundled", "trajectory": hover}, "test", adjust)


def measured(
    parameters: dict[str, float | None] | None = None,
    *,
    link: dict[str, Any] | None = None,
    system: dict[str, Any] | None = None,
    estimator: dict[str, Any] | None = None,
    autopilot: dict[str, Any] | None = None,
    settings: dict[str, Any] | None = None,
    **others: Any,
) -> Measured:
    """A healthy vehicle on the ground, with changes."""
    read = {name: value for name, value in (HEALTHY | (parameters or {})).items() if value is not None}
    said = Autopilot(modes.HOLD, modes.HOLD, False, LandedState.ON_GROUND, battery=0.9, system_status=3)
    told = {"health": SYSTEM._replace(**(system or {})), "estimator": ESTIMATOR._replace(**(estimator or {}))}
    said = replace(said, parameters=read, **(told | (autopilot or {})))
    values: dict[str, Any] = {"version": VERSION, "link": LINK._replace(**(link or {}))} | others
    return Measured(flight=flight(**(settings or {})), autopilot=said, **values)


IN_AIR = {"armed": True, "landed": LandedState.IN_AIR}
REAL = {"vehicle__simulated": False}
CURVED = {"vehicle__rotors__curve_factor": 0.6}
STICKS = {"sticks": True}
OLD = AutopilotVersion((1, 12, 3), 255, 0, 0)
NOT_FINITE = StateRejection.NOT_FINITE


def calibrated_on(day: str) -> dict[str, Any]:
    return REAL | {"vehicle__calibration": {"date": day}}


TODAY = datetime.now(UTC).date()
CASES: list[tuple[Gate, str, dict[str, Any], str]] = [
    (Gate.CALIBRATION, "refused", dict(settings=REAL), "never calibrated: its file has no [calibration]; fly"),
    (Gate.CALIBRATION, "passed", dict(), "a simulator"),
    (Gate.CALIBRATION, "passed", dict(settings=REAL | {"output__controller": "px4"}), "nothing that flies needs"),
    (Gate.CALIBRATION, "passed", dict(settings=calibrated_on(TODAY.isoformat())), f"calibrated on {TODAY}"),
    (Gate.CALIBRATION, "warning", dict(settings=calibrated_on("2020-02-29")), "days old; fly `companion calibrate`"),
    (Gate.CALIBRATION, "warning", dict(settings=calibrated_on("2999-01-01")), "has not come yet"),
    (Gate.PARAMETERS, "refused", dict(unread={"NAV_RCL_ACT": "reading NAV_RCL_ACT got no answer"}), "got no answer"),
    (Gate.VERSION, "warning", dict(version=OLD), "PX4 1.12.3 is older"),
    (Gate.VERSION, "warning", dict(version=None, settings=REAL), "does not tell its version"),
    (Gate.VERSION, "passed", dict(version=None), "does not tell its version"),
    (Gate.OUTPUT, "refused", dict(settings={"output__kind": "actuators"}), "since 1.14; use output rates"),
    (Gate.OUTPUT, "passed", dict(settings={"output__kind": "actuators"}, version=OLD), "SET_ACTUATOR_CONTROL_TARGET"),
    (Gate.OUTPUT, "refused", dict(version=VERSION._replace(capabilities=1 << 7)), "does not take SET_ATTITUDE_TARGET"),
    (
        Gate.OUTPUT,
        "refused",
        dict(version=VERSION._replace(capabilities=1 << 6), settings={"output__controller": "px4"}),
        "does not take SET_POSITION_TARGET_LOCAL_NED",
    ),
    (Gate.SETPOINTS, "refused", dict(parameters={"MAV_FWDEXTSP": 0.0}), "set MAV_FWDEXTSP to 1"),
    (Gate.SETPOINTS, "passed", dict(parameters={"MAV_FWDEXTSP": None}), "listens"),
    (Gate.VEHICLE_TYPE, "refused", dict(parameters={"MAV_TYPE": 0.0}), "MAV_TYPE is 0 (generic)"),
    (Gate.VEHICLE_TYPE, "refused", dict(parameters={"MAV_TYPE": 29.0}), "thrust of SET_ATTITUDE_TARGET as zero"),
    (Gate.VEHICLE_TYPE, "passed", dict(parameters={"MAV_TYPE": 22.0}), "VTOL"),
    (Gate.LOSS_TIME, "refused", dict(parameters={"COM_OF_LOSS_T": 1.01}), "COM_OF_LOSS_T is 1.01 s"),
    (Gate.LOSS_TIME, "refused", dict(parameters={"COM_OF_LOSS_T": math.nan}), "set COM_OF_LOSS_T to 0.5"),
    (Gate.LOSS_TIME, "warning", dict(parameters={"COM_OF_LOSS_T": 1.0}), "0.5 is safer"),
    (Gate.LOSS_TIME, "warning", dict(parameters={"COM_OF_LOSS_T": 0.51}), "0.5 is safer"),
    (Gate.LOSS_ACTION, "refused", dict(parameters={"COM_OBL_RC_ACT": 0.0}), "no live manual control; set"),
    (Gate.LOSS_ACTION, "refused", dict(parameters={"COM_OBL_RC_ACT": 2.0}), "needs a pilot"),
    (Gate.LOSS_ACTION, "warning", dict(parameters={"COM_OBL_RC_ACT": 1.0}, system=STICKS), "changes to Altitude"),
    (
        Gate.LOSS_ACTION,
        "refused",
        dict(parameters={"COM_OBL_RC_ACT": 0.0, "NAV_RCL_ACT": 7.0}, system=STICKS),
        "NAV_RCL_ACT 7: without sticks PX4 would go on with the last setpoint",
    ),
    (Gate.LOSS_ACTION, "refused", dict(parameters={"COM_OBL_RC_ACT": 0.0, "NAV_RCL_ACT": 6.0}, system=STICKS), "stop"),
    (Gate.LOSS_ACTION, "refused", dict(parameters={"COM_OBL_RC_ACT": 7.0}), "the motors stop in the air"),
    (Gate.LOSS_ACTION, "refused", dict(parameters={"COM_OBL_RC_ACT": 9.0}), "none that this program knows"),
    (Gate.LOSS_ACTION, "passed", dict(parameters={"COM_OBL_RC_ACT": 4.0}), "for 0.5 s, then changes to Land"),
    (Gate.PILOT, "warning", dict(settings=REAL), "no live manual control"),
    (Gate.PILOT, "warning", dict(settings=REAL, parameters={"COM_RC_IN_MODE": 4.0}), "COM_RC_IN_MODE 4 disables it"),
    (Gate.PILOT, "warning", dict(system=STICKS, parameters={"MAN_OVERRIDE_SPD": -1.0}), "does not take over"),
    (
        Gate.PILOT,
        "warning",
        dict(system=STICKS, parameters={"MAN_OVERRIDE_SPD": None, "COM_RC_OVERRIDE": 1.0}),
        "COM_RC_OVERRIDE 1",
    ),
    (Gate.PILOT, "passed", dict(system=STICKS), "takes over"),
    (Gate.GROUND_LINK, "passed", dict(parameters={"NAV_DLL_ACT": 2.0}), "losing it ends Offboard"),
    (Gate.GROUND_LINK, "passed", dict(parameters={"NAV_DLL_ACT": 2.0, "COM_DLL_EXCEPT": 4.0}), "does not end Offboard"),
    (
        Gate.TERMINATION,
        "refused",
        dict(
            parameters={"CBRK_FLIGHTTERM": 0.0},
            settings={"output__kind": "attitude", "vehicle__limits__tilt_max_rad": 1.2},
        ),
        "PX4 stops the motors from 60 deg",
    ),
    (Gate.TERMINATION, "passed", dict(parameters={"CBRK_FLIGHTTERM": 0.0}), "no tilt"),
    (
        Gate.THRUST_CURVE,
        "refused",
        dict(parameters={"THR_MDL_FAC": 0.3}, settings={"vehicle__rotors__curve_factor": 0.3}),
        "undone twice",
    ),
    (Gate.THRUST_CURVE, "passed", dict(parameters={"THR_MDL_FAC": 0.3}), "at most once"),
    (Gate.THRUST_SCALING, "warning", dict(parameters={"MC_BAT_SCALE_EN": 1.0}), "battery's voltage"),
    (Gate.HOVER_THRUST, "warning", dict(parameters={"MPC_THR_HOVER": 0.7}), "by the vehicle file it is 0.49"),
    (Gate.HOVER_THRUST, "passed", dict(parameters={"MPC_THR_HOVER": 0.63}, settings=CURVED), "agree"),
    (
        Gate.HOVER_THRUST,
        "warning",
        dict(parameters={"MPC_THR_HOVER": 0.45}, settings=CURVED),
        "0.45, by the vehicle file it is 0.63",
    ),
    (Gate.STATE_RATE, "refused", dict(link={"rate_hz": 189.0}), "ODOMETRY comes at 189 Hz, 200 Hz are required"),
    (Gate.STATE_RATE, "refused", dict(link={"rate_hz": None}), "no usable ODOMETRY within 5 s"),
    (
        Gate.STATE_RATE,
        "refused",
        dict(link={"rate_hz": None, "rejected": (NOT_FINITE,), "rejections": 9}),
        "not finite",
    ),
    (Gate.STATE_RATE, "refused", dict(rate_refusal="setting the rate of ODOMETRY failed"), "as its one state"),
    (Gate.STATE_AGE, "refused", dict(link={"age_s": 0.0301}), "the vehicle file says 20 ms"),
    (Gate.STATE_AGE, "passed", dict(link={"age_s": 0.0299}), "29.9 ms"),
    (Gate.STATE_AGE, "warning", dict(link={"age_s": None}), "nothing came to judge it by"),
    (Gate.STATE_JITTER, "warning", dict(link={"jitter_s": 0.011}), "11.0 ms later than the promptest"),
    (Gate.STATE_JITTER, "refused", dict(link={"jitter_s": 0.051}), "look for what holds datagrams up"),
    (Gate.STATE_GAPS, "warning", dict(link={"gaps": 1, "longest_gap_s": 0.08}), "a flight ends after 50 ms"),
    (Gate.STATE_GAPS, "refused", dict(link={"gaps": 3, "longest_gap_s": 0.08}), "was 80 ms"),
    (Gate.STATE_GAPS, "refused", dict(link={"gaps": 1, "longest_gap_s": 0.26}), "was 260 ms"),
    (Gate.STATE_SOUND, "refused", dict(link={"rejections": 6, "rejected": (NOT_FINITE,)}), "2% of the states"),
    (Gate.STATE_SOUND, "passed", dict(link={"rejections": 1, "rejected": (NOT_FINITE,)}), "0% of the states"),
    (Gate.ROUND_TRIP, "refused", dict(link={"round_trip_s": 0.021}), "set link.command_delay_s to half of it"),
    (Gate.ROUND_TRIP, "passed", dict(link={"round_trip_s": 0.023, "paced": True}), "take 23.0 ms"),
    (Gate.ROUND_TRIP, "warning", dict(link={"round_trip_s": None}), "does not answer TIMESYNC"),
    (Gate.CLOCK, "refused", dict(link={"clock_error_s": -0.3}), "differ by -300.0 ms; look for a second program"),
    (Gate.CLOCK, "warning", dict(link={"clock_error_s": None}), "its own requests and states alone"),
    (Gate.ESTIMATOR, "refused", dict(autopilot={"estimator": None}), "does not tell its estimator's health"),
    (
        Gate.ESTIMATOR,
        "refused",
        dict(estimator={"flags": EstimatorFlag(1 | 2 | 4)}),
        "not ready: no horizontal position, no height",
    ),
    (Gate.ESTIMATOR, "refused", dict(estimator={"flags": EstimatorFlag(63 | 2048)}), "bad accelerometer data"),
    (Gate.ESTIMATOR, "passed", dict(estimator={"flags": EstimatorFlag(63 | 128)}), "has attitude"),
    (
        Gate.ESTIMATOR,
        "refused",
        dict(estimator={"flags": EstimatorFlag(63 | 128)}, autopilot=IN_AIR),
        "only holds a constant position",
    ),
    (Gate.ESTIMATOR_TESTS, "warning", dict(estimator={"height_ratio": 0.6}), "0.60, of the height"),
    (Gate.ESTIMATOR_TESTS, "refused", dict(estimator={"velocity_ratio": 1.0}), "rejects this measurement"),
    (Gate.ESTIMATOR_TESTS, "refused", dict(estimator={"position_ratio": math.nan}), "of the position"),
    (Gate.ESTIMATOR_ACCURACY, "refused", dict(estimator={"accuracy_m": 5.1}), "to 5.10 m"),
    (Gate.ESTIMATOR_ACCURACY, "refused", dict(estimator={"accuracy_m": math.nan}), "wait for a better fix"),
    (Gate.ESTIMATOR_RESETS, "refused", dict(link={"resets": 1}), "its reset counter changed"),
    (Gate.BATTERY, "refused", dict(system={"battery": 0.15}), "15% left; charge it"),
    (Gate.BATTERY, "warning", dict(system={"battery": 0.2}), "20% left"),
    (Gate.BATTERY, "warning", dict(system={"battery": None}, settings=REAL), "not known"),
    (Gate.BATTERY, "passed", dict(system={"battery": None}), "not known"),
    (Gate.FENCE, "refused", dict(system={"fence_kept": False}), "outside of the autopilot's fence"),
    (Gate.FENCE, "warning", dict(system={"fence_kept": False}, parameters={"GF_ACTION": 1.0}), "outside"),
    (Gate.FENCE, "warning", dict(parameters={"GF_ACTION": 4.0}), "stops the motors in the air"),
    (Gate.FENCE, "passed", dict(system={"fence_kept": None}), "or there is none"),
    (Gate.LANDED_STATE, "refused", dict(autopilot={"landed": LandedState.UNDEFINED}), "stands on the ground or flies"),
    (Gate.MODE, "refused", dict(autopilot={"mode": None}), "does not tell its mode"),
    (Gate.MODE, "refused", dict(autopilot={"system_status": 8}), "terminated"),
    (Gate.MODE, "refused", dict(autopilot=IN_AIR | {"mode": modes.RETURN}), "failsafe of the autopilot flies Return"),
    (
        Gate.MODE,
        "warning",
        dict(autopilot=IN_AIR | {"mode": modes.RETURN, "intended": modes.OFFBOARD}),
        "setpoints have ceased before",
    ),
    (
        Gate.MODE,
        "warning",
        dict(autopilot=IN_AIR | {"mode": modes.LAND, "intended": modes.LAND}),
        "somebody wanted it down; Hold will be asked for first",
    ),
    (
        Gate.MODE,
        "warning",
        dict(autopilot=IN_AIR | {"mode": modes.POSITION, "intended": modes.POSITION}),
        "Hold will be asked for first",
    ),
    (Gate.MODE, "passed", dict(autopilot=IN_AIR), "holds in the air"),
    (Gate.ARMING, "refused", dict(system={"can_arm": False}, complaints=("Preflight Fail: low battery",)), "low batt"),
    (Gate.ARMING, "refused", dict(system={"can_arm": False}), "it does not say why"),
    (Gate.ARMING, "passed", dict(system={"can_arm": False}, autopilot=IN_AIR), "is armed"),
    (Gate.ARMING, "passed", dict(system={"can_arm": False}, autopilot={"mode": modes.LAND}), "take-off leaves it"),
    (Gate.ARMING, "warning", dict(autopilot={"health": None}), "does not tell"),
]


@pytest.mark.parametrize(("gate", "verdict", "changes", "says"), CASES, ids=[f"{c[0].name}-{c[3][:20]}" for c in CASES])
def test_gate(gate: Gate, verdict: str, changes: dict[str, Any], says: str) -> None:
    found = GATES[gate](measured(**changes))
    assert (found.gate, found.verdict) == (gate, verdict), found.told
    assert says in found.told
    assert bool(found.fix) is (verdict != "passed")
    assert found.value
    assert "\n" not in found.told


def test_every_gate_is_in_the_table_and_can_fire() -> None:
    assert set(GATES) == set(Gate) - {Gate.GAINS, Gate.LOOP_HEALTH}
    told_only = {Gate.GROUND_LINK}
    assert {gate for gate, verdict, _, _ in CASES if verdict != "passed"} == set(GATES) - told_only


def test_every_gate_is_documented() -> None:
    lines = (bundled_root().parent / "docs" / "preflight.md").read_text(encoding="utf-8").splitlines()
    assert [line.split("|")[1].strip() for line in lines if line.startswith("| ")][1:] == [g.value for g in Gate]


def test_healthy_vehicle_passes_all() -> None:
    findings = judge(measured())
    assert [f.gate for f in findings] == list(GATES)
    assert {f.verdict for f in findings} == {Verdict.PASSED}
    assert refusal(findings) == ""


def test_refusal_tells_the_first_and_how_many_more() -> None:
    findings = judge(measured({"MAV_TYPE": 0.0}, link={"resets": 2}, system={"battery": 0.1}))
    said = refusal(findings)
    assert said.startswith("parameter MAV_TYPE is 0")
    assert said.endswith("(and 2 more: `companion doctor` shows all)")
    assert refusal(judge(measured({"MAV_TYPE": 0.0}))).endswith("(2 for a quadrotor)")


def test_gains_are_a_line_of_the_table() -> None:
    assert gains_finding(flight().vehicle).verdict is Verdict.PASSED
    late = {"vehicle__controller__prediction": False, "vehicle__link__state_age_s": 0.2}
    bad = gains_finding(flight(**late).vehicle)
    assert (bad.gate, bad.verdict) == (Gate.GAINS, Verdict.REFUSED)
    assert "ms" in bad.sentence


def test_parameters_that_must_be_known_are_read_first() -> None:
    assert set(PARAMETERS[: len(NEEDED)]) == set(NEEDED)
    assert len(set(PARAMETERS)) == len(PARAMETERS)
    assert all(len(name) <= 16 for name in PARAMETERS)


@pytest.mark.parametrize(
    ("action", "fallback", "sticks", "reaction", "says"),
    [
        (5, 2, False, Reaction.HOLD, "for 0.5 s, then changes to Hold, until setpoints come again"),
        (3, 2, True, Reaction.RETURN, "then changes to Return, climbing to 30 m"),
        (0, 2, True, Reaction.POSITION, "changes to Position, under the pilot's sticks"),
        (0, 2, False, Reaction.RETURN, "changes to Return"),
        (1, 3, False, Reaction.LAND, "changes to Land"),
        (2, 0, False, Reaction.NOTHING, "goes on with the last setpoint for good"),
        (0, 7, False, Reaction.NOTHING, "goes on with the last setpoint for good"),
        (7, 2, True, Reaction.DISARM, "the motors stop in the air"),
        (0, 42, False, Reaction.UNKNOWN, "does something that this program does not know"),
    ],
)
def test_what_happens_in_silence(action: int, fallback: int, sticks: bool, reaction: Reaction, says: str) -> None:
    """Facts of PX4's failsafe: the first three need sticks, without them NAV_RCL_ACT acts."""
    read = {"COM_OBL_RC_ACT": action, "NAV_RCL_ACT": fallback, "COM_OF_LOSS_T": 0.5, "RTL_RETURN_ALT": 30.0}
    found = when_silent(read, sticks=sticks)
    assert found.reaction is reaction
    assert says in found.sentence


# ---- measuring -----------------------------------------------------------------------------------------------------


def state(t_us: int, resets: int = 0) -> VehicleState:
    return VehicleState(t_us, (0.0,) * 3, (0.0,) * 3, (1.0, 0.0, 0.0, 0.0), (0.0,) * 3, resets)


def metered(lateness_s: list[float], period_s: float = 0.004, *, gap_limit_s: float = 0.05) -> LinkFigures:
    meter = LinkMeter(gap_limit_s)
    meter.start()
    now_s = 0.0
    for i, late_s in enumerate(lateness_s):
        now_s = max(now_s, 10.0 + i * period_s + late_s)
        meter.on_state(state(10_000_000 + round(i * period_s * 1e6)), now_s, paced=False)
    return meter.figures(now_s)


def test_bunched_states_are_not_missing_ones() -> None:
    """Two states of 4 ms come together every 8 ms: the rate is theirs all the same, the jitter is told apart."""
    found = metered([0.006 if i % 2 == 0 else 0.002 for i in range(250)])
    assert found.rate_hz == pytest.approx(250.0, rel=1e-3)
    assert found.jitter_s == pytest.approx(0.004, abs=1e-6)
    assert found.age_s == pytest.approx(0.004, abs=0.0021)
    assert (found.states, found.gaps) == (250, 0)


def test_one_stall_is_a_gap_and_neither_jitter_nor_age() -> None:
    found = metered([0.001] * 100 + [0.09] + [0.001] * 150)
    assert found.gaps == 1
    assert found.longest_gap_s == pytest.approx(0.093)
    assert found.jitter_s == pytest.approx(0.0, abs=0.09)
    assert found.age_s == pytest.approx(0.001)


def test_states_that_cease_lower_the_rate() -> None:
    meter = LinkMeter(0.05)
    meter.start()
    for i in range(51):
        meter.on_state(state(1_000_000 + 10_000 * i), 1.0 + 0.01 * i, paced=False)
    found = meter.figures(2.05)
    assert found.rate_hz == pytest.approx(50.0)
    assert (found.gaps, found.longest_gap_s) == (1, pytest.approx(0.55))


def test_in_lockstep_the_vehicle_says_when_it_sent() -> None:
    meter = LinkMeter(0.05)
    meter.start()
    for i in range(10):
        t_us = 1_000_000 + 10_000 * i
        meter.on_state(state(t_us, resets=i // 4), 99.0, paced=True)
        meter.on_paced_request((t_us + 20_000) * 1000)
    found = meter.figures(1.11)
    assert found.age_s == pytest.approx(0.020)
    assert (found.jitter_s, found.resets) == (pytest.approx(0.0, abs=1e-9), 2)


def test_clock_by_the_shorter_round_trips() -> None:
    """Slow answers say little; unasked, late and repeated ones nothing. The clock's error belongs to the age."""
    meter = LinkMeter(0.05)
    assert not meter.asks(5)
    meter.start()
    trips = (0.002, 0.040, 0.002, 0.030, 0.002)
    for i, trip_s in enumerate(trips):
        sent_s = 10.0 + 0.05 * i
        meter.on_state(state(round((sent_s - 0.010) * 1e6)), sent_s, paced=False)
        sent_ns = round(sent_s * 1e9)
        assert meter.asks(sent_ns)
        answer = Timesync(sent_ns + 1_000_000 + 3_000_000, sent_ns, 1, 191)
        meter.on_answer(answer, sent_s + trip_s)
        meter.on_answer(answer, sent_s + 9.0)
    meter.on_answer(Timesync(1, 12345, 1, 191), 11.0)
    found = meter.figures(10.2)
    assert found.clock_error_s == pytest.approx(0.003)
    assert found.round_trip_s == pytest.approx(0.002)
    assert found.age_s == pytest.approx(0.013)


def test_nothing_came() -> None:
    meter = LinkMeter(0.05)
    meter.on_state(state(1), 1.0, paced=False)
    meter.on_rejection(NOT_FINITE)
    assert meter.figures(2.0) == LinkFigures()
    meter.start()
    meter.on_rejection(NOT_FINITE)
    assert meter.figures(2.0) == LinkFigures(rejected=(NOT_FINITE,), rejections=1)


def test_limit_on_silence() -> None:
    assert silence_limit_s(250.0) == 0.05
    assert silence_limit_s(30.0) == pytest.approx(0.1)
