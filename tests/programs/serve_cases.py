"""`companion serve` as a process for tests, with the bundled vehicle in lockstep in this one."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import tomlkit
from flight_cases import HOVER, Stand, make_flight
from pymavlink.dialects.v20 import development as mavlink

from companion.config import find, read_toml
from companion.flight.bundled import free_udp_port
from companion.ground.client import Client

PATIENCE_S = 60.0
LONG_HOVER = dict(HOVER) | {"duration_s": 200.0}
SLOW = {"radius_m": 1.0, "angular_rate_rad_s": 0.5}
"""The way to a slow circle is short."""
LONG_CIRCLE = read_toml(find("circle", "trajectories")) | {"laps": 12, "circle": SLOW}
SHORT_HOVER = dict(HOVER) | {"duration_s": 15.0}
TRAJECTORIES: dict[str, dict[str, Any]] = {"circle": LONG_CIRCLE, "hover": LONG_HOVER, "short": SHORT_HOVER}


def until(condition: Callable[[], object], what: str = "") -> None:
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end_s, what
        time.sleep(0.01)


class Serving:
    """One `companion serve`; use it as a context manager."""

    def __init__(
        self, folder: Path, vehicle_port: int, names: tuple[str, ...] = ("circle", "hover"), *options: str
    ) -> None:
        self.folder = folder
        self.port = free_udp_port()
        self.to = f"udpout:127.0.0.1:{self.port}"
        self.lines: list[str] = []
        trajectories = folder / "trajectories"
        trajectories.mkdir(parents=True, exist_ok=True)
        for name in names:
            text = tomlkit.dumps({key: value for key, value in TRAJECTORIES[name].items() if key != "name"})
            (trajectories / f"{name}.toml").write_text(text)
        vehicle = folder / "serve_vehicle.toml"
        vehicle.write_text(tomlkit.dumps(make_flight().vehicle.model_dump(mode="json", exclude_none=True)))
        self.command = [
            *(sys.executable, "-m", "companion", "serve", "--vehicle", str(vehicle), "--engine", "python"),
            *("--connect", f"udpin:127.0.0.1:{vehicle_port}", "--ground", f"udpin:127.0.0.1:{self.port}"),
            *("--folder", str(trajectories), "--flights", str(folder / "flights"), "--json"),
            *("--no-reports", *options),
        ]
        self._log = folder / "serve.log"

    def __enter__(self) -> Serving:
        with self._log.open("w") as log:
            self.process = subprocess.Popen(
                self.command, stdout=subprocess.PIPE, stderr=log, text=True, start_new_session=True
            )
        assert self.process.stdout is not None
        self.facts = json.loads(self.process.stdout.readline() or "{}")
        assert self.facts.get("ready"), self.log
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            try:
                self.process.wait(20.0)
            except subprocess.TimeoutExpired:
                self.process.kill()
        self.process.communicate()

    @property
    def log(self) -> str:
        return self._log.read_text()

    def pid(self, module: str) -> int | None:
        """Of a child that is there now."""
        for folder in Path("/proc").iterdir():
            if not folder.name.isdigit():
                continue
            with contextlib.suppress(OSError):
                parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
                if parent == self.process.pid and module.encode() in (folder / "cmdline").read_bytes():
                    return int(folder.name)
        return None

    @property
    def control_pid(self) -> int | None:
        return self.pid("companion.ground.control")

    @property
    def ground_pid(self) -> int | None:
        return self.pid("companion.ground.process")

    def kill(self, pid: int | None) -> None:
        assert pid is not None
        os.kill(pid, signal.SIGKILL)

    @contextlib.contextmanager
    def client(self) -> Iterator[Client]:
        """A client of a companion that hears its vehicle and has checked its trajectories."""
        with Client(self.to, PATIENCE_S) as client:
            until(lambda: client.status(5.0).vehicle, "the vehicle is not heard")
            until(lambda: all(t.accepted for t in client.trajectories()), str(client.trajectories()))
            yield client

    def summaries(self) -> list[dict[str, Any]]:
        """Of the flights so far, in their order."""
        return [json.loads(path.read_text()) for path in sorted((self.folder / "flights").glob("*/summary.json"))]


@contextlib.contextmanager
def serving(
    folder: Path, names: tuple[str, ...] = ("circle", "hover"), **stand_options: Any
) -> Iterator[tuple[Serving, Stand]]:
    """A vehicle in the air and the companion that serves it.

    The vehicle comes when the trajectories are checked: in lockstep both would use up the processors meanwhile.
    """
    stand = Stand(make_flight(), folder, **stand_options)
    stand.idle_s = 0.002
    with contextlib.ExitStack() as stack:
        stack.callback(stand.peer.close)
        serve = stack.enter_context(Serving(folder, stand.port, names))
        with Client(serve.to, PATIENCE_S) as client:
            until(lambda: all(t.accepted for t in client.trajectories()), "the trajectories are not checked")
        stack.enter_context(stand)
        yield serve, stand


class PlainTool:
    """A ground tool made of pymavlink and a socket, as anybody would write it."""

    def __init__(self, port: int) -> None:
        self.sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.sock.settimeout(0.2)
        self.companion = ("127.0.0.1", port)
        self.mav = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        self.heard: list[Any] = []

    def __enter__(self) -> PlainTool:
        return self

    def __exit__(self, *_: object) -> None:
        self.sock.close()

    def send(self, message: Any) -> None:
        self.sock.sendto(message.pack(self.mav), self.companion)

    def receive(self, seconds: float = 0.2) -> None:
        """Hear the companion, and not the one of another test that still speaks to whoever had this port before."""
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            with contextlib.suppress(TimeoutError):
                datagram, sender = self.sock.recvfrom(2048)
                if sender == self.companion:
                    self.heard += self.mav.parse_buffer(bytearray(datagram)) or []

    def command(self, command: int, *params: float, whole: bool = False, confirmation: int = 0) -> list[int]:
        """Gives a command; returns the results of its acknowledgements, the last one final."""
        values = (*params, *(0.0,) * (7 - len(params)))
        if whole:
            x, y, z = int(values[4]), int(values[5]), values[6]
            message = mavlink.MAVLink_command_int_message(1, 191, 0, command, 0, 0, *values[:4], x, y, z)
        else:
            message = mavlink.MAVLink_command_long_message(1, 191, command, confirmation, *values)
        self.heard.clear()
        self.send(message)
        end_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < end_s:
            self.receive(0.05)
            acks = [m for m in self.heard if m.get_type() == "COMMAND_ACK" and m.command == command]
            if acks and acks[-1].result != mavlink.MAV_RESULT_IN_PROGRESS:
                assert {(ack.target_system, ack.target_component) for ack in acks} == {(255, 190)}
                return [ack.result for ack in acks]
        raise AssertionError(f"command {command} was not answered")

    def phase(self) -> int | None:
        """Of the companion's heartbeats since the last command, after listening a little."""
        self.receive(0.05)
        codes = [m.custom_mode & 0xFF for m in self.heard if m.get_type() == "HEARTBEAT"]
        return codes[-1] if codes else None

    def said(self) -> str:
        """All texts so far."""
        return "".join(m.text for m in self.heard if m.get_type() == "STATUSTEXT")
