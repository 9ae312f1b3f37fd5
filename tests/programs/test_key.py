"""`companion key` against a vehicle: made, installed, replaced, removed, and refused."""

from __future__ import annotations

import json

import pytest

from companion.cli import main
from companion.link.key_file import load_key


@pytest.fixture(autouse=True)
def state(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)


def key(*arguments: object) -> int:
    return main(["key", *map(str, arguments)])


def test_made_installed_replaced_and_removed(tmp_path, make_vehicle, capsys):
    vehicle = make_vehicle(state_rate_hz=50.0)
    first, second = tmp_path / "first", tmp_path / "second"
    assert key("new", first, "--json") == 0
    made = json.loads(capsys.readouterr().out)
    assert made["fingerprint"] == load_key(first).fingerprint
    assert key("new", second) == 0
    capsys.readouterr()
    at = ("--connect", vehicle.connection)
    assert key("install", "--key", first, *at, "--json") == 0
    assert json.loads(capsys.readouterr().out)["system"] == 1
    assert vehicle.signing_key == load_key(first).secret

    assert key("install", "--key", second, *at, "--timeout", 2) == 4  # it has one already
    assert "--old" in capsys.readouterr().err
    assert key("install", "--key", second, "--old", second, *at, "--timeout", 2) == 4
    assert "wrong signature" in capsys.readouterr().err
    assert vehicle.signing_key == load_key(first).secret
    assert key("install", "--key", second, "--old", first, *at) == 0
    assert vehicle.signing_key == load_key(second).secret
    assert key("remove", "--key", second, *at) == 0
    assert vehicle.signing_key is None
    told = capsys.readouterr()
    for path in (first, second):
        secret = load_key(path).secret.hex()
        assert secret not in told.out + told.err
        kept = [found for found in (tmp_path / "state").rglob("*") if found.is_file()]
        assert kept
        assert not any(secret in found.read_text() for found in kept)


def test_by_a_link_that_speaks_first(tmp_path, make_vehicle):
    vehicle = make_vehicle(state_rate_hz=50.0)
    key("new", tmp_path / "key")
    assert key("install", "--key", tmp_path / "key", "--connect", f"udpout:127.0.0.1:{vehicle.port}") == 0
    assert vehicle.signing_key == load_key(tmp_path / "key").secret


def test_not_while_armed(tmp_path, make_vehicle, capsys):
    vehicle = make_vehicle(start=(0, 0, -10), state_rate_hz=50.0)
    key("new", tmp_path / "key")
    assert key("install", "--key", tmp_path / "key", "--connect", vehicle.connection) == 3
    assert "is armed" in capsys.readouterr().err
    assert vehicle.signing_key is None


def test_only_the_vehicle_that_is_meant(tmp_path, make_vehicle):
    vehicle = make_vehicle(state_rate_hz=50.0, instance=4)
    key("new", tmp_path / "key")
    at = ("--key", tmp_path / "key", "--connect", vehicle.connection)
    assert key("install", *at, "--system", 3, "--timeout", 1) == 4
    assert vehicle.signing_key is None
    assert key("install", *at, "--system", 5) == 0


@pytest.mark.parametrize("connection", ["udpin:0.0.0.0:14540", "udpout:192.0.2.1:14540"])
def test_only_over_a_local_link(tmp_path, capsys, connection):
    key("new", tmp_path / "key")
    assert key("install", "--key", tmp_path / "key", "--connect", connection) == 3
    assert "leaves this machine" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["new"], "which file"),
        (["make"], "new, install and remove"),
        (["install"], "--key FILE"),
        (["install", "file", "--key", "x"], "named by --key"),
        (["remove", "--key", "x", "--old", "y"], "--old"),
        (["install", "--key", "/nowhere/key"], "No such file"),
        (["install", "--key", "x", "--timeout", "nan"], "--timeout"),
    ],
)
def test_what_is_wrong_is_said(capsys, arguments, told):
    assert main(["key", *arguments]) == 2
    assert told in capsys.readouterr().err
