"""`companion serve` with keys: who is heard, who is not, what is told of it, and what survives a restart."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import development as mavlink
from serve_cases import PATIENCE_S, PlainTool, Serving, until

from companion import Client
from companion.cli import main
from companion.errors import InputError, LinkError
from companion.ground.exposure import check_ground, ground_keys, open_vehicle_link
from companion.ground.refusals import RefusalWatch
from companion.ground.settings import GROUND_SYSTEMS, Settings
from companion.link.key_file import load_key, new_key
from companion.link.signing import time_now
from companion.link.vehicle_link import VehicleLink


@pytest.fixture(autouse=True)
def state(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)


def signed(tool: PlainTool, key: bytes, at: int | None = None, system: int = 255) -> PlainTool:
    tool.mav.srcSystem = system
    tool.mav.signing.secret_key = key
    tool.mav.signing.timestamp = time_now() if at is None else at
    tool.mav.signing.link_id = system
    tool.mav.signing.sign_outgoing = True
    return tool


def ask(tool: PlainTool) -> bytes:
    """REQUEST_MESSAGE of HEARTBEAT, as sent."""
    raw = bytes(mavlink.MAVLink_command_long_message(0, 191, 512, 0, *(0.0,) * 7).pack(tool.mav))
    tool.sock.sendto(raw, tool.companion)
    return raw


def test_with_keys_on_both_links(tmp_path: Path, make_vehicle) -> None:
    vehicle_key, ground_key = tmp_path / "vehicle.key", tmp_path / "ground.key"
    new_key(vehicle_key)
    new_key(ground_key)
    secret = load_key(ground_key).secret
    vehicle = make_vehicle(key=load_key(vehicle_key).secret, state_rate_hz=50.0)
    keys = ("--key", str(vehicle_key), "--ground-key", str(ground_key), "--ground-system", "254", "--system", "1")
    with (
        Serving(tmp_path, vehicle.remote_port, ("hover",), *keys) as serve,
        PlainTool(serve.port) as stranger,
        PlainTool(serve.port) as wrong_system,
        PlainTool(serve.port) as late,
        Client(serve.to, PATIENCE_S, ground_key) as client,
    ):
        until(lambda: client.status(5.0).vehicle, "the vehicle is not heard")
        assert [t.name for t in client.trajectories()] == ["hover.toml"]
        ask(stranger)
        ask(signed(wrong_system, secret, system=255))
        ask(signed(late, secret, at=1000, system=254))
        late.receive(0.5)
        assert [m.get_type() for m in late.heard][:1] == ["HEARTBEAT"]  # it learns the time
        ask(late)
        late.heard.clear()
        until(lambda: (late.receive(0.2), late.heard)[1], "a tool that has learned the time is not heard")
        until(lambda: (client.status(5.0).refused_messages or 0) >= 3, "the refusals are not told: ")
        for tool in (stranger, wrong_system):
            tool.receive(0.1)
            assert tool.heard == []
        raw = ask(late)
        until(lambda: (late.receive(0.1), late.heard)[1])
        # Another process, and after that a recording of what it has not seen.
        killed = serve.ground_pid
        serve.kill(killed)
        until(lambda: serve.ground_pid not in {None, killed})
        until(lambda: client.status(30.0).vehicle)
        until(lambda: client.status(30.0).refused_messages is not None)
        before = client.latest.refused_messages or 0
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as thief:
            thief.sendto(raw, late.companion)
        until(lambda: (client.status(5.0).refused_messages or 0) > before, "a recording was used after a restart")
        with pytest.raises(LinkError, match=r"signed \(--key\)"):
            Client(serve.to, 1.0)
        command_line = Path(f"/proc/{serve.control_pid}/cmdline").read_bytes()
        assert secret.hex().encode() not in command_line
        assert str(vehicle_key).encode() in command_line
    assert "refused at" in serve.log
    for path in tmp_path.rglob("*"):
        if path.is_file() and path not in {vehicle_key, ground_key}:
            content = path.read_bytes()
            for key in (load_key(vehicle_key).secret, secret):
                assert key not in content
                assert key.hex().encode() not in content


@pytest.mark.parametrize("link", ["udpin:0.0.0.0:14790", "udpout:192.0.2.1:14790", "serial:/dev/ttyUSB0:57600"])
def test_an_open_ground_link_needs_a_key_or_a_word(link: str, tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["serve", "--vehicle", "bundled", "--ground", link]) == 3
    told = capsys.readouterr().err
    assert "--allow-unsigned" in told
    assert told.count("\n") == 1
    check_ground((link,), (None,), allow_unsigned=True)
    check_ground((link,), ("key",), allow_unsigned=False)


def test_a_ground_link_of_this_machine_needs_none() -> None:
    check_ground(
        ("udpin:127.0.0.1:14590", "udpin:localhost:1", "udpout:127.0.0.2:1"), (None,) * 3, allow_unsigned=False
    )


def test_keys_go_to_the_ground_links_in_their_order(tmp_path: Path) -> None:
    new_key(tmp_path / "a")
    new_key(tmp_path / "b")
    a, b = str(tmp_path / "a"), str(tmp_path / "b")
    links = ("udpin:127.0.0.1:1", "udpin:127.0.0.1:2")
    assert ground_keys(links, ()) == (None, None)
    assert ground_keys(links, (a,)) == (a, a)
    assert ground_keys(links, ("", b)) == (None, b)
    with pytest.raises(InputError, match="3 times for 2"):
        ground_keys(links, (a, a, b))
    with pytest.raises(InputError, match="No such file"):
        ground_keys(links, (str(tmp_path / "c"),))
    settings = Settings("udpin:127.0.0.1:3", links, "t", "f", "auto", key=a, system=3, ground_keys=(None, b))
    again = Settings.from_json(settings.as_json())
    assert again == settings
    assert again.ground_links == ((links[0], None), (links[1], b))
    assert again.link == VehicleLink("udpin:127.0.0.1:3", a, 3)
    assert again.ground_systems == GROUND_SYSTEMS
    assert Settings("udpin:127.0.0.1:3", links, "t", "f", "auto").ground_links == ((links[0], None), (links[1], None))


def test_a_vehicle_link_that_others_reach_is_warned_of() -> None:
    assert "--key" in open_vehicle_link(VehicleLink("udpin:0.0.0.0:14540"))
    assert open_vehicle_link(VehicleLink("udpin:0.0.0.0:14540", key="key")) == ""
    assert open_vehicle_link(VehicleLink("udpin:127.0.0.1:14540")) == ""


def test_refusals_are_told_now_and_then() -> None:
    said: list[str] = []
    watch = RefusalWatch(said.append)
    watch.tick(0.0, {"a": {"unsigned": 0}})
    watch.tick(1.0, {"a": {"unsigned": 2, "wrong_signature": 1}})
    watch.tick(2.0, {"a": {"unsigned": 3, "wrong_signature": 1}})
    assert said == ["refused at a: 2 unsigned, 1 wrong signature"]
    watch.tick(12.0, {"a": {"unsigned": 3, "wrong_signature": 1}})
    watch.tick(30.0, {"a": {"unsigned": 1, "wrong_signature": 0}})  # counted by another process
    assert said[1:] == ["refused at a: 1 unsigned", "refused at a: 1 unsigned"]
