"""The log of whole flights: the control process flies the bundled vehicle, and pyulog reads what is left."""

from __future__ import annotations

import itertools
import json
import math
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from flight_cases import HOVER, Stand, make_flight
from pyulog import ULog

from companion.campaign.replay import replay
from companion.flight.engines import kernels
from companion.flight.launch import control
from companion.flight.phases import PHASE_NAMES
from companion.link.vehicle_link import VehicleLink
from companion.record import topics
from companion.record.columns import COLUMN_INDEX, COLUMNS, DEFAULT_PHASE_NAMES
from companion.record.flight_record import FlightRecord
from companion.record.flight_source import read_source
from companion.record.folder import CONFIGURATION_FILE, read_summary, write_configuration

PATIENCE_S = 60.0


def until(condition: Callable[[], object]) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.02)


def table_of(log: ULog) -> np.ndarray:
    """The record as the log has it."""
    count = len(log.get_dataset("companion_step").data["timestamp"])
    table = np.full((count, len(COLUMNS)), np.nan)
    for topic in topics.STEP_TOPICS:
        data = log.get_dataset(topic.name).data
        assert len(data["timestamp"]) == count
        if topic.name.startswith("companion_"):
            for field in topic.fields:
                for index, name in enumerate(field.columns):
                    if name in COLUMN_INDEX:
                        table[:, COLUMN_INDEX[name]] = data[f"{field.name}[{index}]" if field.size > 1 else field.name]
    return table


@pytest.mark.parametrize("who", ["law", "px4"])
def test_a_flights_log_has_all_that_its_record_has(tmp_path: Path, who: str) -> None:
    flight = make_flight(trajectory=HOVER | {"duration_s": 1.0}, output__controller=who)
    folder = tmp_path / "out"
    folder.mkdir()
    write_configuration(folder, flight.model_dump(exclude_none=True))
    with Stand(flight, tmp_path) as stand:
        flown = control(folder, f"udpin:127.0.0.1:{stand.port}", "python", 30.0, lambda message: None)
    log, record = ULog(str(folder / "flight.ulg")), FlightRecord.load(folder)
    assert not log.file_corruption and not log.dropouts
    assert len(record) > 100
    assert table_of(log).tobytes() == record.rows.tobytes()

    written = {data.name for data in log.data_list}
    sent = {"vehicle_rates_setpoint", "vehicle_thrust_setpoint"} if who == "law" else {"trajectory_setpoint"}
    always = (*topics.STATE_TOPICS, *topics.STEP_TOPICS, topics.STATUS, topics.LAND_DETECTED, topics.LINK)
    assert written - {"battery_status", "home_position"} == sent | {topic.name for topic in always}
    states = log.get_dataset("vehicle_local_position").data
    stamps = np.round(record.column("t_s") * 1e6).astype(np.uint64)
    at = np.searchsorted(states["timestamp"], stamps)
    assert (states["timestamp"][at] == stamps).all()
    assert (states["z"][at] == record.column("p_d").astype(np.float32)).all()
    (setpoint,) = {"vehicle_rates_setpoint", "trajectory_setpoint"} & sent
    assert set(stamps) <= set(log.get_dataset(setpoint).data["timestamp"])
    if who == "law":
        data = log.get_dataset(setpoint).data
        at = np.searchsorted(data["timestamp"], stamps)
        assert (data["roll"][at] == record.column("rate_cmd_x").astype(np.float32)).all()
        law = log.get_dataset("companion_lyapunov").data
        assert (law["value"] <= law["envelope"]).all()
    else:
        assert math.isnan(log.get_dataset("companion_lyapunov").data["envelope"][0])

    assert "".join(*log.msg_info_multiple_dict["flight_toml"]) == (folder / CONFIGURATION_FILE).read_text()
    assert log.initial_parameters["limits/thrust_min_n"] == flight.vehicle.limits.thrust_min_n
    assert "COM_OF_LOSS_T" in {name for _, name, _ in log.changed_parameters}
    said = [message.message for message in log.logged_messages]
    for phase in read_summary(folder)["phases"]:
        assert f"{phase['name']}: {phase['reason']}" in said
    assert said[-1] == flown.sentence
    folder_summary, source = read_source(folder).summary, read_source(folder / "flight.ulg")
    assert source.missing == ()
    assert source.record.rows.tobytes() == record.rows.tobytes()
    assert json.loads(json.dumps(source.summary)) == folder_summary
    if who == "law":
        assert replay(folder / "flight.ulg", kernels("python")).identical
    status = log.get_dataset("vehicle_status").data
    assert [mode for mode, _ in itertools.groupby(status["nav_state"])] == [4, 14, 4]


def test_a_killed_control_process_leaves_its_log(tmp_path: Path) -> None:
    flight = make_flight(trajectory=HOVER | {"duration_s": 30.0})
    folder = tmp_path / "out"
    folder.mkdir()
    write_configuration(folder, flight.model_dump(exclude_none=True))
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs, Stand(flight, tmp_path) as stand:
        connection = f"udpin:127.0.0.1:{stand.port}"
        process = subprocess.Popen(
            [
                *(sys.executable, "-m", "companion.flight.process"),
                *(str(folder), VehicleLink(connection).as_json(), "python", "30", str(theirs.fileno())),
            ],
            pass_fds=(theirs.fileno(),),
        )
        until(lambda: stand.offboard_s > 0.5)
        process.kill()
        process.wait()
        answered_us = stand.setpoints()[-1].t_us

    def last_us() -> int:
        if not (folder / "flight.ulg").stat().st_size:
            return 0
        log = ULog(str(folder / "flight.ulg"))
        steps = [data for data in log.data_list if data.name == "companion_errors"]
        return int(steps[0].data["timestamp"][-1]) if steps else 0

    interval_us = 1e6 / flight.vehicle.link.state_rate_hz
    until(lambda: answered_us - last_us() <= flight.vehicle.link.state_age_s * 1e6 + 2 * interval_us)
    # the folder is as good as the log in it
    source = read_source(folder)
    assert source.summary["verdict"].startswith("incomplete")
    assert len(source.record) > 0.4 * flight.vehicle.link.state_rate_hz
    assert replay(folder, kernels("python")).identical


def test_the_phases_that_the_log_names_are_the_flights() -> None:
    assert PHASE_NAMES == DEFAULT_PHASE_NAMES
