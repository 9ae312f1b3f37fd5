"""A real PX4 takes a key, signs, believes nobody else, and is met again after it began in the past. See px4_tools."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from px4_tools import Link, Px4, binary, free_instance

from companion.cli import main
from companion.flight.connect import find_autopilot
from companion.link.framing import Frame
from companion.link.operations import Operations
from companion.link.wire import Wire

pytestmark = pytest.mark.timeout(300)
BOOT_S = 60.0
VERSION = 148


@pytest.fixture
def instance(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> int:
    binary()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    return free_instance()


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    made = tmp_path / "px4"
    made.mkdir()
    yield made


def answers(connection: str, key: str | None, seconds: float) -> bool:
    """Whether PX4 is heard and answers a request."""
    with Wire.open(connection, key=key) as wire:
        system = find_autopilot(wire, connection, BOOT_S, lambda: False)
        operations = Operations(wire.send, system)
        end_s = time.monotonic() + seconds
        asked_s = 0.0
        while time.monotonic() < end_s:
            if time.monotonic() - asked_s > 1.0:
                asked_s = time.monotonic()
                operations = Operations(wire.send, system)
                operations.request_message(VERSION, asked_s)
            for frame in wire.receive(0.1):
                operations.on_frame(frame, time.monotonic())
                if frame.msgid == VERSION:
                    return signed(frame) == (key is not None)
        return False


def signed(frame: Frame) -> bool:
    return frame.raw[0] == 0xFD and bool(frame.raw[2] & 1)


def test_a_key_in_a_real_px4(instance: int, folder: Path, tmp_path: Path) -> None:
    connection, key = f"udpin:127.0.0.1:{14540 + instance}", str(tmp_path / "key")
    px4 = Px4("sihsim_quadx", instance, folder)
    try:
        assert answers(connection, None, BOOT_S)
        assert main(["key", "new", key]) == 0
        assert main(["key", "install", "--key", key, "--connect", connection]) == 0
        assert answers(connection, key, BOOT_S)
        link = Link(instance)
        try:
            link.passed(1.0)  # an answer to what was asked with the key may still be under way
            with pytest.raises(AssertionError, match="no answer"):
                link.command(512, VERSION)
        finally:
            link.close()
        assert answers(connection, key, BOOT_S)
    finally:
        px4.stop()
    px4 = Px4("sihsim_quadx", instance, folder)  # its time is that of the key again, which is long over here
    try:
        with Wire.open(connection, key=key) as wire:
            assert find_autopilot(wire, connection, BOOT_S, lambda: False) == 1 + instance
            assert wire.refusals["replayed"] + wire.refusals["stale"] > 0
        assert answers(connection, key, BOOT_S)
        assert main(["key", "remove", "--key", key, "--connect", connection]) == 0
        assert answers(connection, None, BOOT_S)
    finally:
        px4.stop()
