"""The gates against the bundled vehicle: everything that can be wrong with it before a flight, and what is then said.

One run shows many gates: each judges by itself. Nothing is flown here.
"""

from __future__ import annotations

import ast
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from flight_cases import COMMAND_LONG, SETPOINTS, Stand, make_flight, write_vehicle

from companion.cli import main
from companion.config import Flight
from companion.errors import ExitCode
from companion.flight.bundled import free_udp_port
from companion.flight.engines import kernels
from companion.flight.findings import Finding, Gate, Verdict
from companion.flight.loop import FlightLoop
from companion.flight.phases import PHASE_NAMES, Cause, Outcome
from companion.link.wire import Wire
from companion.record.flight_record import FlightRecord
from companion.trajectory.load import of_flight
from sim_link import codec
from sim_link.codec import mavlink
from sim_link.fault_kinds import fault
from sim_link.modes import Mode

SET_MESSAGE_INTERVAL, REQUEST_MESSAGE, RUN_PREARM_CHECKS = 511, 512, 401
PARAM_SET = 23
MESSAGES = ["ODOMETRY"]


class Look:
    """What the gates found, by name."""

    def __init__(self, outcome: Outcome, findings: list[Finding], lines: list[str]) -> None:
        self.outcome, self.lines = outcome, lines
        self.by_gate = {finding.gate: finding for finding in findings}

    def against(self) -> set[Gate]:
        return {gate for gate, finding in self.by_gate.items() if finding.verdict is Verdict.REFUSED}

    def warned(self) -> set[Gate]:
        return {gate for gate, finding in self.by_gate.items() if finding.verdict is Verdict.WARNING}


def look(stand: Stand, flight: Flight | None = None, prepare: Callable[[], object] = lambda: None) -> Look:
    """Lets the gates judge the vehicle of a stand; checks that nothing was changed but message intervals."""
    flight = stand.flight if flight is None else flight
    lines: list[str] = []
    with Wire.open(f"udpin:127.0.0.1:{stand.port}") as wire:
        record = FlightRecord(0, PHASE_NAMES)
        loop = FlightLoop(
            *(flight, of_flight(flight), wire, record, kernels("python"), lines.append),
            connect_timeout_s=5.0,
            only_gates=True,
        )
        prepare()
        outcome = loop.run()
    assert loop.preflight is not None
    nothing_changed(stand)
    return Look(outcome, loop.preflight.findings, lines)


def says(found: Look, what: dict[Gate, tuple[str, str]]) -> None:
    """Checks verdict and words of gates."""
    for gate, (verdict, words) in what.items():
        finding = found.by_gate[gate]
        assert finding.verdict == verdict, finding.told
        assert words in finding.told, finding.told


def nothing_changed(stand: Stand) -> None:
    commands = {h.message.command for h in stand.heard if h.msg_id == COMMAND_LONG}
    assert commands <= {SET_MESSAGE_INTERVAL, REQUEST_MESSAGE, RUN_PREARM_CHECKS}
    assert not {h.msg_id for h in stand.heard} & (SETPOINTS | {PARAM_SET})


def test_setup_that_is_wrong_in_many_ways(tmp_path) -> None:
    """Parameters, thrust curve, tilt, arming: each told by its own gate, the first one refuses."""
    wrong = {
        **{"MAV_FWDEXTSP": 0, "MAV_TYPE": 0, "COM_OF_LOSS_T": 1.5, "COM_OBL_RC_ACT": 0, "CBRK_FLIGHTTERM": 0},
        **{"MC_BAT_SCALE_EN": 1, "MPC_THR_HOVER": 0.8, "NAV_DLL_ACT": 2, "THR_MDL_FAC": 0.3, "GF_ACTION": 4},
    }
    flight = make_flight(output__kind="attitude", vehicle__rotors__curve_factor=0.3, vehicle__limits__tilt_max_rad=1.25)
    with Stand(flight, tmp_path, start=None, parameters=wrong) as stand:
        found = look(stand)
        assert not stand.vehicle.autopilot.armed
    refused = {Gate.SETPOINTS, Gate.VEHICLE_TYPE, Gate.LOSS_TIME, Gate.LOSS_ACTION, Gate.TERMINATION, Gate.THRUST_CURVE}
    assert found.against() == refused | {Gate.ARMING}
    assert found.warned() == {Gate.THRUST_SCALING, Gate.HOVER_THRUST, Gate.FENCE}
    says(
        found,
        {
            Gate.SETPOINTS: ("refused", "MAV_FWDEXTSP is 0: PX4 does not listen to setpoints"),
            Gate.VEHICLE_TYPE: ("refused", "MAV_TYPE is 0 (generic)"),
            Gate.LOSS_TIME: ("refused", "COM_OF_LOSS_T is 1.5 s"),
            Gate.LOSS_ACTION: ("refused", "there is no live manual control; set COM_OBL_RC_ACT to 5"),
            Gate.GROUND_LINK: ("passed", "losing it ends Offboard"),
            Gate.TERMINATION: ("refused", "PX4 stops the motors from 60 deg of tilt, limits.tilt_max_rad is 72 deg"),
            Gate.THRUST_CURVE: ("refused", "the thrust curve is undone twice; set rotors.curve_factor to 0"),
            Gate.THRUST_SCALING: ("warning", "PX4 scales the thrust with the battery's voltage"),
            Gate.HOVER_THRUST: ("warning", "PX4 hovers with a thrust of 0.80, by the vehicle file it is 0.56"),
            Gate.FENCE: ("warning", "leaving the autopilot's fence stops the motors in the air"),
            Gate.ARMING: ("refused", "no connection to the ground control station"),
        },
    )
    told = {gate: finding.told for gate, finding in found.by_gate.items()}
    assert (found.outcome.cause, found.outcome.detail) == (
        Cause.REFUSED,
        "parameter MAV_FWDEXTSP is 0: PX4 does not listen to setpoints; set MAV_FWDEXTSP to 1"
        " (and 6 more: `companion doctor` shows all)",
    )
    assert f"warning: {told[Gate.HOVER_THRUST]}" in found.lines


def test_link_that_is_wrong_in_many_ways(tmp_path) -> None:
    """Late, uneven and missing states, three gaps, slow commands, a second time."""
    faults = (
        fault("delay", delay_s=0.03, direction="from_vehicle", messages=MESSAGES),
        fault("jitter", jitter_s=0.03, direction="from_vehicle", messages=MESSAGES),
        fault("loss", share=0.65, direction="from_vehicle", messages=MESSAGES),
        *(fault("silence", t, t + 0.1, messages=MESSAGES) for t in (0.6, 0.8, 1.0)),
        fault("delay", delay_s=0.05, direction="to_vehicle", messages=["TIMESYNC"]),
        fault("timesync", offset_s=0.3),
    )
    with Stand(make_flight(), tmp_path, faults=faults) as stand:
        found = look(stand)
    gates = {Gate.STATE_RATE, Gate.STATE_AGE, Gate.STATE_GAPS, Gate.ROUND_TRIP, Gate.CLOCK}
    assert found.against() == gates
    assert found.warned() == {Gate.LOSS_TIME, Gate.STATE_JITTER}
    says(
        found,
        {
            Gate.STATE_RATE: ("refused", "80 Hz are required for the vehicle file's 100 Hz, 40 Hz with lower gains"),
            Gate.STATE_AGE: ("refused", "the vehicle file says 20 ms; set link.state_age_s"),
            Gate.STATE_JITTER: ("warning", "later than the promptest; look for what holds datagrams up"),
            Gate.STATE_GAPS: ("refused", "a flight ends after 50 ms"),
            Gate.ROUND_TRIP: ("refused", "set link.command_delay_s to half of it"),
            Gate.CLOCK: ("refused", "look for a second program"),
        },
    )


def test_a_loop_that_is_worse_than_the_vehicle_file_says(tmp_path) -> None:
    """Half of the states: they are enough with what is certified for them."""
    count = [0]

    def thinned(stand: Stand, msg_id: int, raw: bytes) -> list[bytes]:
        count[0] += msg_id == codec.ID_ODOMETRY
        return [] if msg_id == codec.ID_ODOMETRY and count[0] % 2 else [raw]

    with Stand(make_flight(), tmp_path, alter=thinned) as stand:
        found = look(stand)
    assert found.outcome.cause is Cause.INSPECTED
    says(found, {Gate.LOOP_HEALTH: ("warning", "(states at 50 Hz, not 100): output rates, 100% of its gains")})


def test_bunched_states_count(tmp_path) -> None:
    """8 ms of jitter on states every 4 ms: they come in bunches, and none is missing."""
    flight = make_flight(vehicle__link__state_rate_hz=250.0)
    jitter = fault("jitter", jitter_s=0.008, direction="from_vehicle", messages=MESSAGES)
    with Stand(flight, tmp_path, faults=(jitter,)) as stand:
        found = look(stand)
    assert found.outcome.cause is Cause.INSPECTED
    assert found.by_gate[Gate.STATE_RATE].value in {"249 Hz", "250 Hz", "251 Hz"}
    assert 3.0 < float(found.by_gate[Gate.STATE_JITTER].value.split()[0]) <= 8.0


def changed_estimator(**changes: Any) -> Callable[[Stand, int, bytes], list[bytes]]:
    """ESTIMATOR_STATUS with other contents, given as functions of its class's fields."""

    def alter(stand: Stand, msg_id: int, raw: bytes) -> list[bytes]:
        if msg_id != mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS:
            return [raw]
        values = {"time_usec": 1, "flags": 63, "vel_ratio": 0.0, "pos_horiz_ratio": 0.0, "pos_vert_ratio": 0.0}
        values |= {"mag_ratio": 0.0, "hagl_ratio": 0.0, "tas_ratio": 0.0}
        values |= {"pos_horiz_accuracy": 0.1, "pos_vert_accuracy": 0.1} | changes
        message = mavlink.MAVLink_estimator_status_message(**values)
        return [codec.Encoder(stand.vehicle.system, 1).cold(message)]

    return alter


def test_estimate_and_vehicle_that_are_wrong_in_many_ways(tmp_path) -> None:
    """An estimator in trouble, an empty battery, a breached fence, somebody's Return."""
    faults = (
        fault("estimator_reset", 0.7, jump_m=[0.1, 0.0, 0.0]),
        fault("estimator_bad_numbers", 0.8, 0.9, what="nan"),
    )
    parameters = {
        **{"SIM_BAT_DRAIN": 1.0, "SIM_BAT_MIN_PCT": 5.0, "GF_MAX_HOR_DIST": 10.0, "GF_ACTION": 3},
        **{"COM_LOW_BAT_ACT": 0, "NAV_RCL_ACT": 0},
    }
    alter = changed_estimator(flags=7 | 32, pos_horiz_ratio=1.3, pos_horiz_accuracy=9.0)

    def somebody() -> None:
        autopilot = stand.vehicle.autopilot
        autopilot.guidance.home = (30.0, 0.0, 0.0)
        autopilot.intended = autopilot.mode = Mode.RETURN

    with Stand(make_flight(), tmp_path, faults=faults, parameters=parameters, alter=alter) as stand:
        found = look(stand, prepare=somebody)
    gates = {Gate.STATE_SOUND, Gate.ESTIMATOR, Gate.ESTIMATOR_TESTS, Gate.ESTIMATOR_ACCURACY, Gate.ESTIMATOR_RESETS}
    assert found.against() == gates | {Gate.BATTERY, Gate.FENCE}
    assert Gate.MODE in found.warned()
    says(
        found,
        {
            Gate.STATE_SOUND: ("refused", "not finite"),
            Gate.ESTIMATOR: ("refused", "not ready: no horizontal position"),
            Gate.ESTIMATOR_TESTS: ("refused", "1.30, of the position: it rejects this measurement"),
            Gate.ESTIMATOR_ACCURACY: ("refused", "to 9.00 m"),
            Gate.ESTIMATOR_RESETS: ("refused", "its reset counter changed); wait until the estimator has settled"),
            Gate.BATTERY: ("refused", "charge it"),
            Gate.FENCE: ("refused", "outside of the autopilot's fence"),
            Gate.MODE: ("warning", "somebody wanted it down"),
        },
    )


def test_autopilot_that_tells_nothing(tmp_path) -> None:
    """No version, health, landed state or answers to TIMESYNC: told as missing, in bounded time."""
    silent = {1, 148, 230, 245}

    def alter(stand: Stand, msg_id: int, raw: bytes) -> list[bytes]:
        answers_us = msg_id == codec.ID_TIMESYNC and codec.timesync(codec.frames(raw)[0].payload)[0] != 0
        return [] if msg_id in silent or answers_us else [raw]

    flight = make_flight(vehicle__simulated=False)
    with Stand(flight, tmp_path, alter=alter) as stand:
        found = look(stand)
        assert stand.vehicle.t_us - stand.vehicle.start_us < 6_000_000
    assert found.against() == {Gate.ESTIMATOR, Gate.LANDED_STATE, Gate.CALIBRATION}
    says(
        found,
        {
            Gate.CALIBRATION: ("refused", "never calibrated: its file has no [calibration]; fly `companion calibrate`"),
            Gate.VERSION: ("warning", "does not tell its version; find out which PX4 this is"),
            Gate.PILOT: ("warning", "no live manual control; only a change of mode takes over"),
            Gate.LANDED_STATE: ("refused", "does not say whether it stands on the ground or flies"),
            Gate.ROUND_TRIP: ("warning", "does not answer TIMESYNC"),
        },
    )
    unknown = {Gate.VERSION, Gate.PILOT, Gate.ROUND_TRIP, Gate.CLOCK, Gate.BATTERY, Gate.ESTIMATOR_TESTS}
    assert found.warned() >= unknown | {Gate.ESTIMATOR_ACCURACY}


def test_no_estimate_at_all(tmp_path) -> None:
    with Stand(make_flight(), tmp_path, start=None, faults=(fault("estimator_outage", 0.3),)) as stand:
        found = look(stand)
    assert found.against() == {Gate.STATE_RATE, Gate.STATE_GAPS, Gate.ESTIMATOR}
    assert "not ready: no attitude, no horizontal velocity" in found.by_gate[Gate.ESTIMATOR].told


def test_parameters_that_cannot_be_read(tmp_path) -> None:
    def alter(stand: Stand, msg_id: int, raw: bytes) -> list[bytes]:
        return [] if msg_id == mavlink.MAVLINK_MSG_ID_PARAM_VALUE else [raw]

    with Stand(make_flight(), tmp_path, alter=alter) as stand:
        found = look(stand)
    says(found, {Gate.PARAMETERS: ("refused", "reading COM_OBL_RC_ACT got no answer: asked 4 times")})
    assert found.outcome.detail.startswith("reading COM_OBL_RC_ACT got no answer")


def test_older_px4_and_its_parameters(tmp_path) -> None:
    """Names that it does not have cost no flight, whether it says so or is silent; it takes actuator controls."""
    flight = make_flight(output__kind="actuators")
    with Stand(flight, tmp_path, px4="1.13") as stand:
        found = look(stand)
    assert found.outcome.cause is Cause.INSPECTED
    assert found.by_gate[Gate.VERSION].value.startswith("1.13")
    with Stand(flight, tmp_path) as stand:
        found = look(stand)
    assert found.against() == {Gate.OUTPUT}
    says(found, {Gate.OUTPUT: ("refused", "PX4 ignores SET_ACTUATOR_CONTROL_TARGET since 1.14; use output rates")})


def test_a_failsafe_in_the_air_must_end_first(tmp_path) -> None:
    def failsafe() -> None:
        autopilot = stand.vehicle.autopilot
        autopilot.intended = Mode.POSITION

    with Stand(make_flight(), tmp_path) as stand:
        found = look(stand, prepare=failsafe)
    says(found, {Gate.MODE: ("refused", "a failsafe of the autopilot flies Hold instead of Position; find out why")})


def test_every_gate_fires_on_the_bundled_vehicle_in_a_test_that_checks_its_words() -> None:
    """The gates that the tests above give to `says`; the gains need no vehicle, and doctor tells them below."""
    calls = [node for node in ast.walk(ast.parse(Path(__file__).read_text())) if isinstance(node, ast.Call)]
    tables = [c.args[1] for c in calls if isinstance(c.func, ast.Name) and c.func.id == "says"]
    shown = {key.attr for table in tables if isinstance(table, ast.Dict) for key in table.keys if key is not None}
    assert shown == {gate.name for gate in Gate} - {"GAINS"}


def test_pilot_with_sticks(tmp_path) -> None:
    """With live manual control a stick mode may follow, and people are told."""
    parameters = {"COM_OBL_RC_ACT": 0, "MAN_OVERRIDE_SPD": -1.0}
    holding = fault("pilot_mode", 0.05, mode="Hold")
    with Stand(make_flight(), tmp_path, parameters=parameters, faults=(holding,)) as stand:
        found = look(stand)
    assert found.outcome.cause is Cause.INSPECTED
    assert found.warned() == {Gate.LOSS_TIME, Gate.LOSS_ACTION, Gate.PILOT}
    assert found.lines[-1].endswith("then changes to Position, under the pilot's sticks, until setpoints come again")


def test_same_seed_same_findings(tmp_path) -> None:
    """In lockstep nothing that the gates look at depends on the machine; no more than a second is measured."""
    faults = (fault("jitter", jitter_s=0.015), fault("loss", share=0.05, messages=MESSAGES))
    found = []
    for _ in range(2):
        with Stand(make_flight(), tmp_path, faults=faults) as stand:
            found.append(look(stand))
    assert found[0].by_gate == found[1].by_gate
    assert [p.at_s for p in found[0].outcome.phases] == [p.at_s for p in found[1].outcome.phases]


# ---- the command ---------------------------------------------------------------------------------------------------


def doctor(stand: Stand, tmp_path: Path, *arguments: str) -> int:
    vehicle = write_vehicle({"vehicle": json.loads(stand.flight.vehicle.model_dump_json(exclude_none=True))}, tmp_path)
    connection = f"udpin:127.0.0.1:{stand.port}"
    return main(["doctor", "--vehicle", str(vehicle), "--connect", connection, "--timeout", "5", *arguments])


def test_doctor_of_a_healthy_vehicle(tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    with Stand(make_flight(), tmp_path, start=None, parameters={"COM_OF_LOSS_T": 0.5}) as stand:
        assert doctor(stand, tmp_path) == ExitCode.DONE
        nothing_changed(stand)
        assert not stand.vehicle.autopilot.armed
    printed = capsys.readouterr().out
    lines = printed.splitlines()
    for gate in Gate:
        assert any(line.startswith(f"{gate.value} ") and "passed" in line for line in lines), gate
    assert "100 Hz" in printed
    assert lines[-1] == f"a flight would not be refused: {len(Gate)} gates, 0 of them warn"
    assert lines[-2].endswith("keeps the last setpoint for 0.5 s, then changes to Hold, until setpoints come again")


def test_doctor_of_a_vehicle_that_would_be_refused(tmp_path, capsys) -> None:
    with Stand(make_flight(), tmp_path, parameters={"MAV_TYPE": 0}) as stand:
        assert doctor(stand, tmp_path, "--json") == ExitCode.REFUSED
        nothing_changed(stand)
    document = json.loads(capsys.readouterr().out)
    assert document["exit_code"] == ExitCode.REFUSED
    assert document["refused"].startswith("parameter MAV_TYPE is 0 (generic)")
    gates = {entry["gate"]: entry for entry in document["gates"]}
    assert set(gates) == {gate.name for gate in Gate}
    assert (gates["VEHICLE_TYPE"]["verdict"], gates["VEHICLE_TYPE"]["value"]) == ("refused", "MAV_TYPE 0")
    assert gates["LOSS_TIME"]["fix"] == "0.5 is safer"
    assert document["parameters"]["COM_OBL_RC_ACT"] == 5.0
    assert document["autopilot"]["version"] == "1.18.0"
    assert "then changes to Hold" in document["when_silent"]


def test_doctor_tells_of_gains_that_are_not_certified(tmp_path, capsys) -> None:
    flight = make_flight(vehicle__controller__gamma_1_s3=20.0)
    with Stand(flight, tmp_path) as stand:
        assert doctor(stand, tmp_path, "--json") == ExitCode.REFUSED
    document = json.loads(capsys.readouterr().out)
    (gains,) = (entry for entry in document["gates"] if entry["gate"] == "GAINS")
    assert gains["verdict"] == "refused"
    assert "are not certified: " in gains["sentence"]
    assert document["refused"].startswith(gains["sentence"])


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        ([], ExitCode.BAD_INPUT, "--vehicle NAME"),
        (["--vehicle", "bundled", "--timeout", "0"], ExitCode.BAD_INPUT, "above 0"),
        (["--vehicle", "bundled", "--connect", "tcp:1"], ExitCode.BAD_INPUT, "tcp:1"),
        (["--vehicle", "bundled", "--connect", "udpin:127.0.0.1:{port}", "--timeout", "0.3"], 4, "nothing came"),
    ],
)
def test_doctor_without_a_vehicle(arguments: list[str], code: ExitCode, says: str, capsys) -> None:
    port = free_udp_port()
    assert main(["doctor", *(word.format(port=port) for word in arguments)]) == code
    assert says in capsys.readouterr().err
