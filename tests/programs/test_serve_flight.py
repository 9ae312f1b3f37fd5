"""`companion serve` flies what it is told, by our client, our commands, plain pymavlink and through the radio; and goes
on when one of its processes is killed."""

from __future__ import annotations

import itertools
import json
import math
import re
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from flight_cases import Stand
from pymavlink.dialects.v20 import development as mavlink
from serve_cases import PlainTool, Serving, serving, until

from companion.cli import main
from companion.errors import InputError, RefusedError
from companion.ground.standing import PHASE_CODES
from sim_link.modes import Mode

README = Path(__file__).parents[2] / "README.md"
START, STOP, PAUSE_CONTINUE, LAND = 31010, 31011, 193, 21
ACCEPTED, REJECTED, DENIED, UNSUPPORTED, UNDER_WAY = 0, 1, 2, 3, 5


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Serving, Stand]]:
    """One companion for all tests here: it is a long-running program."""
    with serving(tmp_path_factory.mktemp("serve"), start=((0.0, 0.0, -6.0), 0.0)) as (serve, stand):
        with serve.client():
            pass
        yield serve, stand


def test_our_client(both: tuple[Serving, Stand]) -> None:
    serve, stand = both
    with serve.client() as client:
        assert [t.name for t in client.trajectories()] == ["circle.toml", "hover.toml"]
        assert client.status().phase == "idle"
        with pytest.raises(RefusedError, match="nothing is being flown"):
            client.pause()
        with pytest.raises(InputError, match=r"no trajectory is called 'nine'.*circle\.toml, hover\.toml"):
            client.start("nine")
        client.start("circle")
        assert stand.mode in {Mode.HOLD, Mode.OFFBOARD}
        assert client.wait_for("track").trajectory_id == 1
        with pytest.raises(RefusedError, match="under way"):
            client.start("hover")
        client.pause()
        paused = client.status()
        assert (paused.phase, paused.paused, paused.vehicle, paused.armed) == ("pause", True, True, True)
        assert paused.position_error_m is not None
        assert paused.position_error_m < 0.1
        assert paused.time_to_go_s is not None
        assert paused.disturbance_m_s2 is not None
        client.resume()
        assert client.status().phase == "track"
        client.stop()
        assert stand.mode is Mode.HOLD
        assert client.status().phase == "idle"
        said = " | ".join(text.text for text in client.texts)
    for words in ("start circle.toml: checking", "track: the join is done", "the operator asks for a pause"):
        assert words in said
    assert "stopped by the operator: the vehicle is in Hold" in said


def test_our_commands(both: tuple[Serving, Stand], capsys: pytest.CaptureFixture[str]) -> None:
    serve, stand = both

    def run(*arguments: str) -> tuple[int, Any]:
        code = main([*arguments, "--to", serve.to, "--json"])
        out, err = capsys.readouterr()
        return code, json.loads(out) if out else err

    code, document = run("start", "2")
    assert (code, document["done"], document["trajectory_id"]) == (0, "start 2", 2)
    status = run("status")[1]
    assert status["phase"] in {"join", "track"}
    assert (status["trajectory_id"], status["trajectory"]) == (2, "hover.toml")
    code, message = run("start", "9")
    assert (code, "no trajectory has the id 9" in message) == (3, True)
    assert main(["status", "--to", serve.to]) == 0
    screen = capsys.readouterr().out
    assert "position error" in screen
    assert "hover.toml" in screen
    assert run("stop")[0] == 0
    assert stand.mode is Mode.HOLD


@pytest.mark.parametrize("whole", [False, True], ids=["COMMAND_LONG", "COMMAND_INT"])
def test_plain_pymavlink(both: tuple[Serving, Stand], whole: bool) -> None:
    serve, stand = both
    with PlainTool(serve.port) as tool:
        assert tool.command(START, 77.0, whole=whole) == [DENIED]
        assert "no trajectory has the id 77" in tool.said()
        assert tool.command(PAUSE_CONTINUE, 0.0, whole=whole)[-1] == REJECTED
        assert tool.command(400, 1.0, whole=whole) == [UNSUPPORTED]
        results = tool.command(START, 2.0, whole=whole)
        assert results[-1] == ACCEPTED
        assert set(results[:-1]) == {UNDER_WAY}
        tool.command(START, 2.0, confirmation=1)  # a repetition starts nothing
        until(lambda: tool.phase() == PHASE_CODES["track"])
        assert tool.command(PAUSE_CONTINUE, 0.0, whole=whole)[-1] == ACCEPTED
        assert tool.command(PAUSE_CONTINUE, 1.0, whole=whole)[-1] == ACCEPTED
        tool.receive(1.2)
        kinds = {m.get_type() for m in tool.heard}
        assert {"HEARTBEAT", "NAMED_VALUE_FLOAT", "DEBUG_VECT"} <= kinds
        names = {m.name for m in tool.heard if m.get_type() in {"NAMED_VALUE_FLOAT", "DEBUG_VECT"}}
        assert names == {"pos_error", "lyapunov", "time_to_go", "track_time", "disturb", "refused"}
        assert {(m.get_srcSystem(), m.get_srcComponent()) for m in tool.heard} == {(1, 191)}
        assert tool.command(STOP, whole=whole)[-1] == ACCEPTED
        assert stand.mode is Mode.HOLD


def test_through_the_autopilots_radio(both: tuple[Serving, Stand]) -> None:
    """Frames of a ground station that the autopilot has passed on to us, and the answers back to it."""
    serve, stand = both
    station = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    passing: list[bytes] = []
    stand.alter = lambda stand, number, raw: [*(passing.pop() for _ in range(len(passing))), raw]

    def radio(command: int, *params: float) -> None:
        values = (*params, *(0.0,) * (7 - len(params)))
        message = mavlink.MAVLink_command_long_message(1, 191, command, 0, *values)
        passing.append(bytes(message.pack(station)))

    def answers(command: int) -> list[int]:
        heard = [h.message for h in list(stand.heard) if h.msg_id == 77]
        return [m.result for m in heard if m.command == command and m.target_system == 255]

    with serve.client() as client:
        radio(START, 2.0)
        until(lambda: ACCEPTED in answers(START), "start")
        client.wait_for("track")
        radio(STOP)
        until(lambda: ACCEPTED in answers(STOP), "stop")
        client.wait_for("idle")
    texts = [h.message for h in stand.heard if h.msg_id == 253]
    assert any("stopped by the operator" in message.text for message in texts)


def test_flights_leave_their_folders(both: tuple[Serving, Stand]) -> None:
    serve, _ = both
    until(lambda: len(serve.summaries()) >= 5)
    summaries = serve.summaries()
    assert {summary["trajectory"] for summary in summaries} == {"circle", "hover"}
    assert all(summary["ended"].startswith("stopped by the operator") for summary in summaries)
    assert all(math.isfinite(summary["control_rate_hz"]) for summary in summaries)
    names = [change["name"] for change in summaries[0]["phases"]]
    assert [name for name in names if name == "pause"] == ["pause"]


def test_ground_process_killed_in_flight(both: tuple[Serving, Stand]) -> None:
    """Nothing changes in the flight, and the next one takes its place."""
    serve, stand = both
    with serve.client() as client:
        client.start("hover")
        client.wait_for("track")
    before, control_pid = serve.ground_pid, serve.control_pid
    flights = len(serve.summaries())
    begun_us = stand.t_us
    serve.kill(before)
    until(lambda: serve.ground_pid not in {None, before})
    with serve.client() as client:
        now = client.wait_for("track")
        assert (now.trajectory_id, now.vehicle) == (2, True)
        client.pause()
        client.resume()
        client.stop()
    assert serve.control_pid == control_pid
    until(lambda: len(serve.summaries()) == flights + 1)
    summary = serve.summaries()[-1]
    assert summary["lost_setpoints"] == 0
    assert summary["rejected_states"] == {}
    setpoints = [h.t_us for h in stand.heard if h.msg_id == 82 and h.t_us > begun_us]
    assert max(b - a for a, b in itertools.pairwise(setpoints)) <= 20_000
    assert "the ground process was ended by signal 9; it is started again" in serve.log
    assert "the ground process is back" in serve.log


def test_control_process_killed_in_flight(both: tuple[Serving, Stand]) -> None:
    """The autopilot's own failsafe acts; what comes back leaves the vehicle in the mode that it finds."""
    serve, stand = both
    with serve.client() as client:
        client.start("hover")
        client.wait_for("track")
        before = serve.control_pid
        serve.kill(before)
        until(lambda: stand.mode is not Mode.OFFBOARD)
        killed_us = max(h.t_us for h in stand.heard if h.msg_id == 82)
        assert stand.vehicle.autopilot.in_failsafe
        failsafe_mode = stand.mode
        until(lambda: "the control process is back" in serve.log)
        until(lambda: client.status(5.0).vehicle and client.latest.phase == "idle")
        time.sleep(0.5)
        assert stand.mode is failsafe_mode
        assert not [h for h in stand.heard if h.msg_id == 82 and h.t_us > killed_us]
        client.start("hover")  # an operator's word is another matter
        client.wait_for("track")
        assert stand.mode is Mode.OFFBOARD
        client.stop()
        client.land()  # without a flight
        assert stand.mode is Mode.LAND
    assert "the control process was ended by signal 9; it is started again" in serve.log


def test_the_readmes_example_lands(both: tuple[Serving, Stand], capsys: pytest.CaptureFixture[str]) -> None:
    """Ten lines of Python; the flight is over when the vehicle is down."""
    serve, stand = both
    (example,) = re.findall(r"^```python\n(.*?)^```", README.read_text(encoding="utf-8"), re.M | re.S)
    assert len([line for line in example.splitlines() if line.strip()]) <= 10
    exec(example.replace("udpout:127.0.0.1:14590", serve.to), {})
    names, error = capsys.readouterr().out.splitlines()
    assert names == "['circle.toml', 'hover.toml']"
    assert 0.0 <= float(error) < 0.2
    assert stand.mode is Mode.LAND
    with serve.client() as client:
        client.wait_for("idle", timeout_s=60.0)
    assert not stand.vehicle.autopilot.armed


def test_ctrl_c_in_flight(both: tuple[Serving, Stand]) -> None:
    """After a take-off this time: hands over to Hold, writes the results, and ends with 130."""
    serve, stand = both
    with serve.client() as client:
        client.start("hover")
        client.wait_for("track")
    serve.process.send_signal(signal.SIGINT)
    assert serve.process.wait(60.0) == 130
    assert (stand.mode, stand.vehicle.autopilot.intended) == (Mode.HOLD, Mode.HOLD)
    assert not stand.vehicle.autopilot.in_failsafe
    assert serve.summaries()[-1]["ended"] == "interrupted by the operator: the vehicle is in Hold"
    assert (serve.control_pid, serve.ground_pid) == (None, None)
    assert "Traceback" not in serve.log
