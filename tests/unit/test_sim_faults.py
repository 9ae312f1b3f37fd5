"""Faults of the simulated vehicle: files and what they refuse, the schedule, what each does, and orders by hand."""

from __future__ import annotations

import csv
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from sim_cases import noiseless

from sim_link import codec, fault_cli, fault_file
from sim_link.autopilot import Result
from sim_link.codec import Encoder, frames, mavlink
from sim_link.fault_keys import FaultError
from sim_link.fault_kinds import KINDS, Fault, check_together, collide, fault, from_table
from sim_link.fault_shell import FaultShell
from sim_link.modes import Mode
from sim_link.vehicle import Vehicle, VehicleOptions
from sim_link.wind import World

FILE = noiseless(state_rate_hz=50.0, drag_1_s=0.3)
IN_AIR = ((0.0, 0.0, -20.0), 0.0)


def make(*faults: Fault, **options: object) -> Vehicle:
    given = {"vehicle": FILE, "start": IN_AIR, "engine": "python", "faults": faults, **options}
    return Vehicle(VehicleOptions(**given))


def run(vehicle: Vehicle, seconds: float) -> None:
    end_s = vehicle.faults.elapsed_s + seconds
    while vehicle.faults.elapsed_s < end_s - 1e-9:
        vehicle.tick()
        for link in vehicle.links:
            link.outbox.clear()


# Files


BAD_TABLES = {
    "kind": ({"kind": "los", "share": 0.1}, "kind = 'los': unknown; allowed are loss, "),
    "no kind": ({"share": 0.1}, "kind: missing; allowed are loss, "),
    "kind that is none": ({"kind": 3}, "kind = 3: must be one of loss, "),
    "key": (
        {"kind": "loss", "share": 0.1, "shar": 1},
        "shar: unknown; allowed for loss are kind, start_s, end_s, share, ",
    ),
    "missing": ({"kind": "rotor"}, "rotor: missing; must be a whole number from 1 to 4"),
    "share": ({"kind": "loss", "share": 1.01}, "share = 1.01: must be a number from 0 to 1"),
    "bool": ({"kind": "loss", "share": True}, "share = True: must be a number"),
    "text": ({"kind": "loss", "share": "0.1"}, "share = '0.1': must be a number"),
    "nan": ({"kind": "loss", "share": math.nan}, "share = nan: must be a number"),
    "huge": ({"kind": "loss", "share": 10**400}, "share = 1000"),
    "start": ({"kind": "loss", "share": 0.1, "start_s": -1}, "start_s = -1: must be a number from 0"),
    "start text": ({"kind": "loss", "share": 0.1, "start_s": "now"}, "start_s = 'now': must be a number"),
    "end inf": ({"kind": "loss", "share": 0.1, "end_s": math.inf}, "end_s = inf: must be a number"),
    "end": ({"kind": "loss", "share": 0.1, "start_s": 5, "end_s": 5}, "end_s = 5: must be after start_s = 5"),
    "no end": ({"kind": "reboot", "end_s": 5}, "end_s: not allowed: reboot happens at start_s"),
    "rotor": ({"kind": "rotor", "rotor": 5}, "rotor = 5: must be a whole number from 1 to 4"),
    "half": ({"kind": "rotor", "rotor": 1.5}, "rotor = 1.5: must be a whole number"),
    "vector": ({"kind": "wind", "wind_m_s": [1, 2]}, "wind_m_s = [1, 2]: must be an array of 3 numbers"),
    "strong": ({"kind": "wind", "wind_m_s": [0, 0, 101]}, "wind_m_s = [0, 0, 101]: must be an array of 3 numbers"),
    "way": ({"kind": "loss", "share": 0.1, "direction": "up"}, "direction = 'up': must be one of to_vehicle, "),
    "message": ({"kind": "loss", "share": 0.1, "messages": ["ODO"]}, "messages = ['ODO']: must be an array of names"),
    "none": ({"kind": "loss", "share": 0.1, "messages": []}, "messages = []: must be an array of names"),
    "mode": ({"kind": "pilot_mode", "mode": "Loiter"}, "mode = 'Loiter': must be one of Manual, "),
    "command": ({"kind": "refuse", "command": "DO_NOTHING"}, "command = 'DO_NOTHING': must be the name or number"),
    "number": ({"kind": "refuse", "command": 70000}, "command = 70000: must be the name or number"),
    "result": ({"kind": "refuse", "command": 400, "result": "ACCEPTED"}, "result = 'ACCEPTED': must be one of TEMP"),
    "name": ({"kind": "parameter", "name": "", "value": 1}, "name = '': must be the name"),
    "table": (7, " = 7: must be a table"),
}


@pytest.mark.parametrize("what", BAD_TABLES)
def test_a_file_with_a_bad_fault_is_refused_with_the_path_of_the_key(what: str) -> None:
    table, message = BAD_TABLES[what]
    with pytest.raises(FaultError) as caught:
        fault_file.parse({"fault": [{"kind": "estimator_freeze"}, table]}, "f.toml")
    sentence = str(caught.value)
    path = "f.toml: fault[1]" if message.startswith(" ") else "f.toml: fault[1]."
    assert sentence.startswith(path + message)
    assert "\n" not in sentence


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ({}, "f.toml: fault: missing"),
        ({"fault": {}}, "f.toml: fault: missing"),
        ({"faults": []}, "f.toml: faults: unknown; allowed are description, fault"),
        ({"description": 3, "fault": []}, "f.toml: description = 3: must be a text"),
    ],
)
def test_a_file_without_faults_is_refused(document: dict, message: str) -> None:
    with pytest.raises(FaultError) as caught:
        fault_file.parse(document, "f.toml")
    assert str(caught.value).startswith(message)


ROTOR = {"kind": "rotor", "rotor": 2}
LOSS = {"kind": "loss", "share": 0.1}
IMPOSSIBLE = {
    "the same rotor": (ROTOR, {**ROTOR, "share": 0.5}),
    "two modes": ({"kind": "pilot_mode", "mode": "Hold"}, {"kind": "pilot_mode", "mode": "Land"}),
    "two delays one way": (
        {"kind": "delay", "delay_s": 0.1, "direction": "to_vehicle"},
        {"kind": "delay", "delay_s": 0.2, "direction": "both"},
    ),
    "loss of all and of one": (LOSS, {**LOSS, "messages": ["ODOMETRY"]}),
    "two estimates": ({"kind": "estimator_freeze"}, {"kind": "estimator_outage"}),
    "two broken estimates": (
        {"kind": "estimator_bad_numbers", "what": "nan"},
        {"kind": "estimator_bad_numbers", "what": "stamp_back"},
    ),
    "two factors": ({"kind": "estimator_noise", "factor": 2}, {"kind": "estimator_noise", "factor": 3}),
    "two scales": ({"kind": "thrust_scale", "factor": 0.9}, {"kind": "thrust_scale", "factor": 0.8}),
    "one command": ({"kind": "refuse", "command": "DO_SET_MODE"}, {"kind": "refuse", "command": 176}),
    "one parameter": (
        {"kind": "parameter", "name": "MC_ROLL_P", "value": 1},
        {"kind": "parameter", "name": "MC_ROLL_P", "value": 2},
    ),
    "two answers": ({"kind": "timesync", "offset_s": 1}, {"kind": "timesync", "offset_s": 2, "link": "both"}),
    "two reboots": ({"kind": "reboot", "boot_s": 5}, {"kind": "reboot"}),
    "two resets at once": ({"kind": "estimator_reset", "start_s": 2}, {"kind": "estimator_reset", "start_s": 2}),
}


@pytest.mark.parametrize("what", IMPOSSIBLE)
def test_faults_that_cannot_be_at_the_same_time_are_refused(what: str) -> None:
    first, second = (dict(table) for table in IMPOSSIBLE[what])
    second.setdefault("start_s", 4.0)
    with pytest.raises(FaultError) as caught:
        fault_file.parse({"fault": [{"kind": "silence"}, first, second]}, "f.toml")
    assert str(caught.value).startswith(f"f.toml: fault[2]: {first['kind'] if what == 'x' else second['kind']}")
    assert "overlaps fault[1]" in str(caught.value)
    if KINDS[first["kind"]].lasts:
        assert len(fault_file.parse({"fault": [{**first, "end_s": 4.0}, second]}, "f.toml")) == 2, "one after the other"


def test_what_can_be_at_the_same_time() -> None:
    check_together(
        [
            fault("rotor", rotor=1),
            fault("rotor", rotor=2, share=0.5),
            fault("thrust_scale", factor=0.9),
            fault("wind", wind_m_s=(1, 0, 0)),
            fault("wind", wind_m_s=(1, 0, 0)),
            fault("force", force_n=(1, 0, 0)),
            fault("force", force_n=(1, 0, 0)),
            fault("loss", share=0.1, direction="to_vehicle"),
            fault("loss", share=0.2, direction="from_vehicle"),
            fault("loss", share=0.2, link="ground"),
            fault("delay", delay_s=0.1, messages=["ODOMETRY"]),
            fault("delay", delay_s=0.1, messages=["TIMESYNC"]),
            fault("burst_loss", good_s=1, bad_s=1),
            fault("estimator_freeze"),
            fault("estimator_rate", rate_hz=10),
            fault("estimator_reset", 1.0, jump_m=(1, 0, 0)),
            fault("estimator_reset", 2.0, jump_m=(1, 0, 0)),
            fault("refuse", command="DO_SET_MODE"),
            fault("refuse", command="NAV_LAND"),
            fault("reboot", 1.0),
            fault("reboot", 5.0),
        ]
    )
    assert collide(fault("reboot", 1.0), fault("reboot", 3.9))


def test_values_left_out_are_filled_in_and_names_are_read() -> None:
    made = from_table({"kind": "refuse", "command": "MAV_CMD_do_set_mode"})
    assert (made["command"], made["result"], made.start_s, made.end_s) == (176, "TEMPORARILY_REJECTED", 0.0, math.inf)
    assert from_table({"kind": "pilot_mode", "mode": "POSITION"})["mode"] == "Position"
    assert str(fault("loss", share=0.05, messages=["ODOMETRY"])) == "loss share = 0.05, messages = [ODOMETRY]"


def test_a_fault_file_is_found_by_path_or_name(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('[[fault]]\nkind = "silence"\nstart_s = 1\n')
    assert fault_file.load(str(path)) == (fault("silence", 1.0),)
    assert len(fault_file.load("weak_rotor")) == 2
    with pytest.raises(FaultError, match=r"not one of the bundled ones .*windy_link"):
        fault_file.load("nothing")
    with pytest.raises(FaultError, match="not a usable path"):
        fault_file.load("a" * 5000)
    path.write_text("[[fault]\n")
    with pytest.raises(FaultError, match=r"mine\.toml: not valid TOML: .*line 1"):
        fault_file.load(str(path))


def test_the_command_line_refuses_a_bad_file_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('[[fault]]\nkind = "parameter"\nname = "NO_SUCH"\nvalue = 1\n')
    command = [sys.executable, "-m", "sim_link", "run", "--faults", str(path), "--port", "0", "--no-ground"]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=30)
    assert done.returncode == 2
    assert done.stderr == f"sim-link: {path}: fault[0].name = 'NO_SUCH': there is no parameter NO_SUCH (PX4 1.18)\n"


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("CA_ROTOR0_PX", 1.0, "fault[0].name = 'CA_ROTOR0_PX': is fixed by the vehicle file"),
        ("COM_OBL_RC_ACT", 1.5, "fault[0].value = 1.5: COM_OBL_RC_ACT takes a whole number"),
        ("COM_RC_OVERRIDE", 1.0, "fault[0].name = 'COM_RC_OVERRIDE': there is no parameter"),
    ],
)
def test_a_parameter_that_cannot_be_set_is_refused(name: str, value: float, message: str) -> None:
    with pytest.raises(FaultError) as caught:
        make(fault("parameter", name=name, value=value))
    assert str(caught.value).startswith(message)


# The schedule


def test_faults_begin_and_end_with_the_states_and_tell_it(tmp_path: Path) -> None:
    vehicle = make(fault("rotor", 0.1, 0.2, rotor=3, share=0.5), fault("force", 0.15, force_n=(1, 0, 0)))
    told: list[str] = []
    vehicle.faults.tell = told.append
    vehicle.faults.log_to(tmp_path / "truth.faults.csv")
    seen = {}
    while vehicle.faults.elapsed_s < 0.3:
        vehicle.tick()
        seen[round(vehicle.faults.elapsed_s, 6)] = sorted(vehicle.faults.active)
    assert (seen[0.1], seen[0.12], seen[0.16], seen[0.18], seen[0.2], seen[0.22]) == ([], [0], [0], [0, 1], [0, 1], [1])
    assert told == [
        "0.100 s: fault 0 begins: rotor rotor = 3, share = 0.5 (until 0.2 s)",
        "0.160 s: fault 1 begins: force force_n = [1, 0, 0] (for good)",
        "0.200 s: fault 0 ends: rotor rotor = 3, share = 0.5",
    ]
    vehicle.faults.close()
    with (tmp_path / "truth.faults.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["t_s"], row["number"], row["event"]) for row in rows] == [
        ("0.100000", "0", "begins"),
        ("0.160000", "1", "begins"),
        ("0.200000", "0", "ends"),
    ]
    assert rows[1]["fault"] == "force force_n = [1, 0, 0]"


@pytest.mark.parametrize("full", [True, False])
def test_a_vehicle_flies_on_when_its_faults_cannot_be_written_down(tmp_path: Path, full: bool) -> None:
    if full and not Path("/dev/full").exists():
        pytest.skip("there is no disk that is always full")
    vehicle = make(fault("rotor", 0.1, 0.2, rotor=3, share=0.5))
    told: list[str] = []
    vehicle.faults.tell = told.append
    path = tmp_path / "sub" / "truth.faults.csv"
    path.parent.mkdir()
    vehicle.faults.log_to(path)
    if full:
        path.symlink_to("/dev/full")
    else:
        path.parent.rmdir()
    run(vehicle, 0.3)
    assert vehicle.faults.elapsed_s >= 0.3 and not vehicle.faults.active
    assert [sentence for sentence in told if "the flight goes on" in sentence] == [told[1]]
    assert told[1].startswith("truth.faults.csv: No s")
    vehicle.faults.close()


def test_without_faults_nothing_is_asked_and_nothing_is_written(tmp_path: Path) -> None:
    vehicle = make()
    vehicle.faults.log_to(tmp_path / "truth.faults.csv")
    vehicle.faults.advance = None  # type: ignore[assignment,method-assign]
    run(vehicle, 0.2)
    assert not list(tmp_path.iterdir())
    assert all(link.faults is None for link in vehicle.links)


def test_faults_are_ordered_and_ended_while_it_runs() -> None:
    vehicle = make()
    run(vehicle, 0.1)
    number = vehicle.faults.inject("wind", for_s=0.1, wind_m_s=(2.0, 0.0, 0.0))
    later = vehicle.faults.inject("rotor", start_s=5.0, rotor=1)
    assert vehicle.faults.active == {}
    run(vehicle, 0.02)
    assert list(vehicle.faults.active) == [number]
    assert list(vehicle.faults.planned) == [number, later]
    run(vehicle, 0.1)
    assert vehicle.faults.active == {} and list(vehicle.faults.planned) == [later]
    with pytest.raises(FaultError, match=r"fault 2: rotor .* overlaps fault 1, rotor"):
        vehicle.faults.inject("rotor", start_s=6.0, rotor=1, share=0.5)
    vehicle.faults.end(later)
    again = vehicle.faults.inject("rotor", rotor=1, share=0.5)
    run(vehicle, 0.02)
    vehicle.faults.end(again)
    run(vehicle, 0.02)
    assert vehicle.faults.planned == {}
    for number in (later, again, 99, -1):
        with pytest.raises(FaultError, match="there is no fault"):
            vehicle.faults.end(number)
    for wrong in ({"for_s": 0.0}, {"for_s": 1.0, "end_s": 2.0}, {"for_s": True}):
        with pytest.raises(FaultError, match=r"for_s = .*: must be a number of seconds above 0"):
            vehicle.faults.inject("rotor", rotor=1, **wrong)
    with pytest.raises(FaultError, match=r"^name = 'NO': there is no parameter"):
        vehicle.faults.inject("parameter", name="NO", value=1)


# What they do


def truth(vehicle: Vehicle) -> list[float]:
    t = vehicle.airframe.truth()
    return [*t.p, *t.v, *t.q, *t.w, *t.rotor_n]


@pytest.mark.numba
def test_both_engines_fly_the_same_under_faults() -> None:
    faults = (
        fault("rotor", 0.2, 0.6, rotor=1, share=0.8),
        fault("thrust_scale", 0.4, factor=0.9),
        fault("wind", 0.1, 0.5, wind_m_s=(5.0, 1.0, 0.0)),
        fault("force", 0.3, force_n=(0.0, 3.0, -1.0)),
        fault("estimator_drift", 0.2, drift_m_s=(0.3, 0.0, 0.0)),
        fault("estimator_reset", 0.6, jump_m=(0.4, 0.0, 0.0)),
    )
    world = World(wind_m_s=(2.0, 0.0, 0.0), turbulence=0.2)
    plain, compiled = make(*faults, world=world), make(*faults, world=world, engine="numba")
    run(plain, 1.0)
    run(compiled, 1.0)
    assert truth(compiled) == pytest.approx(truth(plain), rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("share", [0.0, 0.6])
def test_a_rotor_gives_its_share_of_what_it_is_told(share: float) -> None:
    """In free fall the moment of the missing rotor turns the vehicle: the rear left one down, the nose up."""
    vehicle = make(fault("rotor", rotor=2, share=share))
    before = vehicle.airframe.truth().rotor_n[1]
    run(vehicle, 0.1)
    t = vehicle.airframe.truth()
    if share == 0.0:
        assert t.rotor_n[1] < 0.3 * before
    assert t.w[0] < -0.01, "the left side falls"
    assert t.w[1] > 0.01, "the tail falls"
    assert t.v[2] > 0.0


def test_a_thrust_scale_is_felt_by_all_rotors_and_ends() -> None:
    vehicle = make(fault("thrust_scale", 0.0, 0.5, factor=0.5))
    whole = make()
    run(vehicle, 0.1)
    run(whole, 0.1)
    assert vehicle.airframe.truth().thrust_n < 0.7 * whole.airframe.truth().thrust_n
    run(vehicle, 6.0)
    assert vehicle.airframe.truth().thrust_n == pytest.approx(whole.airframe.truth().thrust_n, rel=0.02)
    assert vehicle.airframe.truth().p[2] < -15.0


def test_winds_and_forces_add_up_to_the_worlds_and_go_again() -> None:
    world = World(force_n=(1.0, 0.0, 0.0), wind_m_s=(1.0, 0.0, 0.0), turbulence=0.3, seed=3)
    vehicle = make(
        fault("wind", 0.0, 0.2, wind_m_s=(0.0, 4.0, 0.0)),
        fault("wind", 0.0, 0.2, wind_m_s=(0.0, 2.0, 0.0)),
        fault("force", 0.0, 0.2, force_n=(0.0, 0.0, -3.0)),
        fault("force", 0.1, 0.2, force_n=(0.0, 0.0, -1.0)),
        world=world,
    )
    calm = make(world=world)
    for ticks, up, side in ((1, 3.0, 6.0), (6, 4.0, 6.0), (6, 0.0, 0.0)):
        for _ in range(ticks):
            vehicle.tick()
            calm.tick()
        felt, usual = vehicle.airframe.truth().disturbance_m_s2, calm.airframe.truth().disturbance_m_s2
        assert felt[1] - usual[1] == pytest.approx(FILE.drag_1_s * side), "the turbulence goes on as it was"
        assert felt[2] - usual[2] == pytest.approx(-up / FILE.mass_kg)


def test_faults_of_the_estimator_reach_what_is_believed() -> None:
    vehicle = make(fault("estimator_reset", 0.1, jump_m=(1.0, 2.0, 0.0), yaw_deg=10.0))
    counter = vehicle.telemetry.reset_counter
    run(vehicle, 0.2)
    error = [b - t for b, t in zip(vehicle.airframe.believed().p, vehicle.airframe.truth().p, strict=True)]
    assert error == pytest.approx([1.0, 2.0, 0.0], abs=1e-6)
    assert vehicle.telemetry.reset_counter == counter + 1
    assert vehicle.faults.planned == {}, "it has happened"


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        ("estimator_outage", {}),
        ("estimator_freeze", {}),
        ("estimator_bad_numbers", {"what": "nan"}),
        ("estimator_bad_numbers", {"what": "zero_quaternion"}),
        ("estimator_bad_numbers", {"what": "stamp_back"}),
        ("estimator_delay", {"delay_s": 0.1}),
        ("estimator_rate", {"rate_hz": 10.0}),
        ("estimator_drift", {"drift_m_s": (1.0, 0.0, 0.0)}),
    ],
)
def test_a_fault_of_the_estimator_begins_and_ends(kind: str, values: dict) -> None:
    vehicle = make(fault(kind, 0.1, 0.3, **values))
    beliefs = vehicle.airframe.beliefs
    run(vehicle, 0.1)
    assert not beliefs.active
    run(vehicle, 0.1)
    assert beliefs.active
    run(vehicle, 0.2)
    drifted = kind == "estimator_drift"
    assert beliefs.active is drifted, "a drift leaves its error"
    error = vehicle.airframe.believed().p[0] - vehicle.airframe.truth().p[0]
    assert error == pytest.approx(0.2 if drifted else 0.0, abs=1e-3)


def test_the_noise_of_the_estimator_rises() -> None:
    file = replace(FILE, noise_position_m=0.01)
    quiet, loud = (make(*faults, vehicle=file) for faults in ((), (fault("estimator_noise", factor=100.0),)))
    run(quiet, 0.1)
    run(loud, 0.1)
    error = [
        max(abs(b - t) for b, t in zip(v.airframe.believed().p, v.airframe.truth().p, strict=True))
        for v in (quiet, loud)
    ]
    assert error[1] == pytest.approx(100.0 * error[0], rel=1e-6)


def test_a_parameter_changes_and_comes_back() -> None:
    vehicle = make(fault("parameter", 0.1, 0.2, name="MPC_Z_P", value=0.5))
    before = vehicle.parameters["MPC_Z_P"]
    run(vehicle, 0.14)
    assert vehicle.parameters["MPC_Z_P"] == 0.5
    run(vehicle, 0.1)
    assert vehicle.parameters["MPC_Z_P"] == before


def test_a_mode_that_cannot_run_is_not_taken_and_that_is_told() -> None:
    vehicle = make(fault("pilot_mode", 0.1, mode="Mission"))
    told: list[str] = []
    vehicle.faults.tell = told.append
    run(vehicle, 0.2)
    assert vehicle.autopilot.mode is Mode.HOLD
    assert told == [
        "0.100 s: fault 0 begins: pilot_mode mode = Mission (the autopilot did not take the mode: TEMPORARILY_REJECTED)"
    ]


def test_the_pilot_holds_the_sticks_and_lets_go() -> None:
    vehicle = make(fault("pilot_mode", 0.1, 2.0, mode="Position", sticks=(0.0, 1.0, 0.0, 0.0)))
    run(vehicle, 1.9)
    assert vehicle.autopilot.mode is Mode.POSITION and vehicle.autopilot.sticks_ok
    assert vehicle.airframe.truth().v[0] > 0.5, "stick forward"
    run(vehicle, 0.8)
    assert not vehicle.autopilot.sticks_ok


def test_a_reboot_stops_the_rotors_and_sets_the_time_back() -> None:
    vehicle = make(fault("reboot", 1.0, boot_s=0.5), parameters={"MPC_Z_P": 0.7})
    vehicle.companion.set_interval(codec.ID_ODOMETRY, 1, vehicle.t_us)
    run(vehicle, 1.0)
    before_us = vehicle.t_us
    run(vehicle, 0.3)
    assert vehicle.booting
    assert max(vehicle.airframe.truth().rotor_n) < 0.1
    run(vehicle, 0.24)
    assert not vehicle.booting
    assert vehicle.t_us == 540_000 and before_us == 2_000_000
    assert vehicle.faults.elapsed_s == pytest.approx(1.54), "this time goes on"
    autopilot = vehicle.autopilot
    assert not autopilot.armed and autopilot.mode is Mode.HOLD and autopilot.land.landed
    assert vehicle.parameters["MPC_Z_P"] == pytest.approx(0.7)
    assert vehicle.companion.interval_us(codec.ID_ODOMETRY) == round(1e6 / 30)
    assert 0 <= vehicle.telemetry.sample_us <= vehicle.t_us
    assert autopilot.arm() is Result.ACCEPTED


def test_nothing_passes_while_the_autopilot_boots() -> None:
    vehicle = make(fault("reboot", 0.1, boot_s=0.2))
    run(vehicle, 0.2)
    for link in vehicle.links:
        assert link.faults is not None
        link.heartbeat = None  # type: ignore[attr-defined]
        outbox = [Encoder(1, 1).hot(codec.ID_ODOMETRY, b"\1")]
        heard = frames(outbox[0])
        link.faults.outgoing(outbox)
        assert outbox == [] and link.faults.incoming(heard) == []
    with pytest.raises(FaultError, match="a reboot cannot be ended"):
        vehicle.faults.end(0)
    run(vehicle, 0.2)
    assert all(link.faults is None for link in vehicle.links)


@pytest.mark.parametrize(
    ("unit", "kind", "instance", "result", "kinds"),
    [
        (101, 1, 2, Result.ACCEPTED, ["rotor"]),
        (101, 1, 0, Result.ACCEPTED, ["rotor"] * 4),
        (101, 2, 1, Result.ACCEPTED, []),
        (101, 1, 5, Result.UNSUPPORTED, []),
        (101, 3, 1, Result.UNSUPPORTED, []),
        (4, 1, 0, Result.ACCEPTED, ["estimator_drift"]),
        (4, 2, 0, Result.UNSUPPORTED, []),
        (0, 1, 0, Result.UNSUPPORTED, []),
    ],
)
def test_px4s_own_failure_injection(unit: int, kind: int, instance: int, result: Result, kinds: list[str]) -> None:
    vehicle = make()
    assert vehicle.faults.inject_failure(unit, kind, instance) is result
    run(vehicle, 0.04)
    assert [item.kind for item in vehicle.faults.active.values()] == kinds
    if kinds:
        vehicle.faults.inject_failure(unit, kind, instance)
        assert len(vehicle.faults.planned) == len(kinds), "failing twice is failing"
        vehicle.faults.inject_failure(unit, 0, instance)
        run(vehicle, 0.04)
        assert not vehicle.faults.active
    vehicle.parameters.set("SYS_FAILURE_EN", 0)
    assert vehicle.faults.inject_failure(101, 1, 1) is Result.UNSUPPORTED


# By hand


def test_the_shell_obeys_and_answers() -> None:
    vehicle = make()
    shell = FaultShell(vehicle.faults, vehicle.system)
    assert "kinds: loss" in shell.obey("help")
    assert shell.obey("fault list") == "no faults"
    assert shell.obey("fault wind, wind_m_s = [0, 8, 0], for_s = 0.1") == "fault 0"
    assert shell.obey("fault reboot") == "fault 1"
    assert shell.obey("failure motor off -i 3") == "ok"
    vehicle.tick()
    assert shell.obey("fault list").splitlines() == [
        "0 acts from 0 s until 0.1 s: wind wind_m_s = [0, 8, 0]",
        "1 acts from 0 s: reboot",
        "2 acts from 0 s for good: rotor rotor = 3",
    ]
    assert shell.obey("fault end 0") == "ended"
    for line, sentence in (
        ("fault", "error: kind = '': unknown"),
        ("fault wind wind_m_s = [0, 8, 0] for_s = 3", "error: 'wind_m_s = [0, 8, 0] for_s = 3': expected key = value"),
        ("fault wind, wind_m_s = [0, 8", "error: 'wind_m_s = [0, 8': expected key = value"),
        ("fault wind, wind_m_s = [0, 8]", "error: wind_m_s = [0, 8]: must be an array"),
        ("fault wind, kind = 'rotor'", "error: kind: given twice"),
        ("fault rotor, rotor = 3", "error: fault 3: rotor rotor = 3 from "),
        ("fault end x", "error: fault end: expected a number or all"),
        ("fault end 77", "error: there is no fault 77"),
        ("fault end 1", "error: fault 1: a reboot cannot be ended"),
        ("failure motor explode", "error: failure: expected motor|gps"),
        ("reboot", "error: reboot: no such order"),
        ("fault wind, x = " + "[" * 5000, "error: "),
    ):
        answer = shell.obey(line)
        assert answer.startswith(sentence), answer
        assert "\n" not in answer


def serial(text: bytes, flags: int = 0, device: int = 10) -> codec.Frame:
    data = list(text.ljust(70, b"\0"))
    return frames(Encoder(255, 190).cold(mavlink.MAVLink_serial_control_message(device, flags, 0, 0, len(text), data)))[
        0
    ]


def said(answers: list[bytes]) -> str:
    messages = [codec.Decoder().message(frames(raw)[0]) for raw in answers]
    assert all(m.flags == 1 and m.device == 10 for m in messages)
    return b"".join(bytes(m.data[: m.count]) for m in messages).decode()


def test_a_line_may_come_in_pieces_and_every_writer_has_his_own() -> None:
    vehicle = make()
    shell = FaultShell(vehicle.faults, vehicle.system)
    assert shell.take(serial(b"fault rotor, ro"), "a") == []
    assert said(shell.take(serial(b"fault list\r\n"), "b")) == "no faults\n"
    assert said(shell.take(serial(b"tor = 1\nfault rotor, rotor = 2\nfault "), "a")) == "fault 0\nfault 1\n"
    assert len(said(shell.take(serial(b"list\nhelp\n"), "a"))) > 210, "in several messages"
    assert shell.take(serial(b"help\n", flags=1), "a") == [], "an answer is no order"
    assert shell.take(serial(b"help\n", device=0), "a") == [], "not the shell"
    for _ in range(100):
        shell.take(serial(b"x" * 70), "long")
    assert said(shell.take(serial(b"\nhelp\n"), "long")).count("\n") >= 5, "a line without end is forgotten"
    for writer in range(100):
        shell.take(serial(b"half"), writer)
    assert len(shell._begun) <= 16


def test_words_of_a_command_line_become_an_order() -> None:
    assert fault_cli.line_of(["wind", "wind_m_s=[0,8,0]", "for_s=3"]) == "fault wind, wind_m_s = [0,8,0], for_s = 3"
    assert fault_cli.line_of(["pilot_mode", "mode=Hold"]) == 'fault pilot_mode, mode = "Hold"'
    assert fault_cli.line_of(["pilot_mode", 'mode="Hold"']) == 'fault pilot_mode, mode = "Hold"'
    assert fault_cli.line_of(["loss", 'messages=["ODOMETRY"]']) == 'fault loss, messages = ["ODOMETRY"]'
    assert fault_cli.line_of(["end", "all"]) == "fault end all"
    with pytest.raises(FaultError, match="expected KEY=VALUE"):
        fault_cli.line_of(["rotor", "3"])
