"""Gains changed from the ground while `companion serve` flies: they ramp, the flight stays on its path, and outlive the
program; what the certificate refuses changes nothing."""

from __future__ import annotations

import struct
import time
from collections.abc import Iterator
from typing import Any

import pytest
from flight_cases import Stand
from pymavlink.dialects.v20 import development as mavlink
from pyulog import ULog
from serve_cases import PlainTool, Serving, serving, until

from companion.campaign.replay import replay
from companion.config import build_flight, load_vehicle
from companion.flight.engines import kernels
from companion.ground.hosting import tuned, tuning_of
from companion.ground.parameter_file import file_for, save_tuning
from companion.ground.settings import Settings
from companion.ground.tuning import find

INT32, REAL32 = 6, 9


@pytest.fixture
def both(tmp_path: Any) -> Iterator[tuple[Serving, Stand]]:
    with serving(tmp_path, ("circle",)) as (serve, stand):
        yield serve, stand


def set_parameter(tool: PlainTool, name: str, value: float) -> tuple[float, bool]:
    """Sets one; gives the value that is answered, and whether an error was."""
    raw = struct.unpack("<f", struct.pack("<i", value))[0] if isinstance(value, int) else value
    kind = INT32 if isinstance(value, int) else REAL32
    tool.heard.clear()
    tool.send(mavlink.MAVLink_param_set_message(1, 191, name.encode(), raw, kind))
    end_s = time.monotonic() + 10.0
    while time.monotonic() < end_s:
        tool.receive(0.02)
        for m in tool.heard:
            if m.get_type() == "PARAM_VALUE" and m.param_id == name:
                return m.param_value, any(x.get_type() == "PARAM_ERROR" for x in tool.heard)
    raise AssertionError(f"{name} was not answered")


def test_a_change_in_flight_ramps_is_recorded_and_outlives_the_program(
    both: tuple[Serving, Stand], tmp_path: Any
) -> None:
    serve, _ = both
    with PlainTool(serve.port) as tool, serve.client() as client:
        client.start("circle")
        client.wait_for("track")
        assert set_parameter(tool, "OC_K1", 0.8) == (pytest.approx(0.8), False)
        assert set_parameter(tool, "OC_GAMMA", 90.0) == (2.0, True)
        assert "OC_GAMMA refused" in tool.said()
        until(lambda: "change over 2 s" in serve.log)
        at_s = client.status().track_time_s or 0.0
        until(lambda: (client.status().track_time_s or 0.0) > at_s + 3.0)
        status = client.status()
        assert status.position_error_m is not None and status.position_error_m < 0.1
        client.stop()
    until(lambda: len(serve.summaries()) == 1)
    (summary,) = serve.summaries()
    ((begin_s, duration_s, old, new),) = summary["engagement"]["transitions"]
    assert (old[0][0], new[0][0], duration_s) == (0.7, 0.8, 2.0)
    assert begin_s > summary["engagement"]["at_s"]
    folder = next((tmp_path / "flights").iterdir())
    assert replay(folder, kernels("python")).identical
    log = ULog(str(folder / "flight.ulg"))
    assert "COM_OF_LOSS_T" in {name for _, name, _ in log.changed_parameters}  # though read before any heartbeat
    assert (tmp_path / "trajectories" / ".parameters-paper.toml").read_text().endswith("[controller]\nk1_1_s = 0.8\n")
    serve.kill(serve.ground_pid)
    until(lambda: "the ground process is back" in serve.log)
    with PlainTool(serve.port) as tool:
        tool.send(mavlink.MAVLink_param_request_read_message(1, 191, b"OC_K1", -1))
        tool.receive(0.5)
        assert [m.param_value for m in tool.heard if m.get_type() == "PARAM_VALUE"] == [pytest.approx(0.8)]


def test_the_control_process_begins_with_what_was_changed(tmp_path: Any) -> None:
    vehicle = load_vehicle("paper")
    flight = {"vehicle": vehicle.model_dump(mode="json", exclude_none=True)}
    settings = Settings(
        connection="udpin:127.0.0.1:1",
        ground=(),
        trajectories=str(tmp_path),
        flights=str(tmp_path),
        engine="python",
        flight=flight,
    )
    tuning = tuning_of(settings)
    assert tuning.vehicle == vehicle
    for name, value in (("OC_K1", 0.8), ("OC_RATE_MAX_Y", 5.0), ("OC_HDG_KIND", 0)):
        tuning = tuning.changed(find(name), value)  # type: ignore[arg-type]
    save_tuning(file_for(tmp_path, vehicle.name), tuning)
    data = {**tuned(settings, tuning_of(settings).overrides).flight, "name": "x", "trajectory": "hover"}
    flown = build_flight(data, "test").vehicle
    assert flown == tuning.vehicle
    assert (flown.controller.k1_1_s, flown.limits.rate_max_rad_s, flown.controller.heading) == (
        *(0.8, (6.0, 5.0, 3.0)),
        "damping",
    )
