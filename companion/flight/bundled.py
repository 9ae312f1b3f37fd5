"""Starts the bundled vehicle (`sim-link run`) as a process of its own, as the demo does."""

from __future__ import annotations

import contextlib
import json
import random
import socket
import subprocess
import sys
from pathlib import Path
from types import TracebackType
from typing import Any

import tomlkit

from companion.config import Flight, Start
from companion.errors import ExitCode, InputError, LinkError

TRUTH_FILE = "truth.csv"
VEHICLE_FILE = "vehicle.toml"
FAULTS_FILE = "faults.toml"
PX4_VERSIONS = ("1.13", "1.18")
"""Which PX4 the vehicle can behave like."""
_PORTS = range(20_000, 32_000)
"""Below those that systems give to whoever asks for any: of those another program may get the same one right after."""


def free_udp_port() -> int:
    """A UDP port of the loopback interface that nobody has just now.

    Raises:
        LinkError: there is none.
    """
    chance = random.SystemRandom()  # programs that begin together must not try the same ones
    for port in chance.sample(_PORTS, 100):
        with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", port))
            return port
    raise LinkError(f"no UDP port between {_PORTS.start} and {_PORTS.stop} is free: stop programs that hold them")


def start_of(flight: Flight) -> Start:
    """Where the vehicle waits.

    Raises:
        InputError: the flight does not say.
    """
    if flight.start is None:
        raise InputError(f"flight {flight.name!r} has no [start]: the bundled vehicle waits at start.position_m")
    return flight.start


class BundledVehicle:
    """The simulated vehicle of a flight, waiting in Hold at its [start], or on the ground; a context manager.

    Args:
        flight: gives the vehicle, [start] and [world].
        folder: gets the vehicle's file and the truth.
        px4: "1.13" or "1.18".
        engine: of the physics.
        lockstep: the vehicle's clock waits for the companion; else real time.
        faults: file with what goes wrong; a copy goes into the folder.
        key: file with the key that it signs with.

    Raises:
        InputError, LinkError: on entering, when the vehicle does not start; it has said why on stderr.
    """

    def __init__(
        self,
        flight: Flight,
        folder: Path,
        *,
        px4: str,
        engine: str,
        lockstep: bool,
        faults: Path | None = None,
        key: str | None = None,
    ) -> None:
        start = flight.start
        self._port = free_udp_port()
        self.connection = f"udpin:127.0.0.1:{self._port}"
        """Where the companion listens for it."""
        vehicle_file = folder / VEHICLE_FILE
        vehicle_file.write_text(tomlkit.dumps(_plain(flight.vehicle.model_dump(exclude_none=True))), encoding="utf-8")
        self._command = [
            *(sys.executable, "-m", "sim_link", "run", "--vehicle", str(vehicle_file)),
            *((f"--start={_joined(*start.position_m, start.yaw_deg)}",) if start is not None else ()),
            *("--px4", px4, "--engine", engine, *(("--faults", str(faults)) if faults is not None else ())),
            *(f"--force={_joined(*flight.world.force_n)}", f"--wind={_joined(*flight.world.wind_m_s)}"),
            *(f"--gravity-factor={flight.world.gravity_factor!r}", f"--turbulence={flight.world.turbulence!r}"),
            *("--seed", str(flight.world.seed), "--truth", str(folder / TRUTH_FILE)),
            *("--port", "0", "--remote-port", str(self._port), "--no-ground", "--no-truth-stream"),
            *("--json-ready", "--with-parent", *(("--lockstep",) if lockstep else ())),
            *(("--key", key) if key is not None else ()),
        ]
        if faults is not None:
            (folder / FAULTS_FILE).write_bytes(faults.read_bytes())
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> BundledVehicle:
        self._process = subprocess.Popen(
            self._command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True, start_new_session=True
        )
        assert self._process.stdout is not None
        try:
            line = self._process.stdout.readline()
            with contextlib.suppress(ValueError):
                if json.loads(line).get("ready"):
                    return self
            code = self._process.wait(10.0)
        except BaseException:
            self.stop()
            raise
        self.stop()
        kind = InputError if code == ExitCode.BAD_INPUT else LinkError
        raise kind("the bundled vehicle did not start; see the line above")

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    @property
    def pid(self) -> int:
        """Process id of the vehicle."""
        assert self._process is not None
        return self._process.pid

    def stop(self) -> None:
        """Ends the vehicle; its truth file is complete afterwards."""
        process, self._process = self._process, None
        if process is None:
            return
        process.terminate()
        try:
            process.wait(10.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stdout is not None:
            process.stdout.close()


def _joined(*numbers: float) -> str:
    return ",".join(repr(float(x)) for x in numbers)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return value
