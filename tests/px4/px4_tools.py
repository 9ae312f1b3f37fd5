"""A real PX4 for tests: found by its environment variable, started and stopped by its process id, spoken to by MAVLink.

OFFBOARD_PX4_BINARY names the executable that PX4's own build makes (build/px4_sitl_default/bin/px4). Beside its folder
lies `etc`, the start-up scripts. Everything that PX4 writes goes to a temporary folder.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import development as mavlink

from sim_link.hil import Hil, HilOptions
from sim_link.hil_link import HilServer

VARIABLE = "OFFBOARD_PX4_BINARY"
TAKEOFF, LAND, DO_SET_MODE, ARM, SET_INTERVAL = 22, 21, 176, 400, 511
_BOOT_S = 60.0
_ASK_S = 30.0


def binary() -> Path:
    """The executable; skips the test when there is none."""
    named = os.environ.get(VARIABLE)
    if not named:
        pytest.skip(f"{VARIABLE} does not name a PX4 (build/px4_sitl_default/bin/px4)")
    path = Path(named).resolve()
    if not os.access(path, os.X_OK):
        pytest.skip(f"{VARIABLE}: {named} is not an executable")
    if not (path.parent.parent / "etc" / "init.d-posix" / "rcS").is_file():
        pytest.skip(f"{VARIABLE}: {named} has no etc/init.d-posix/rcS beside its folder")
    return path


def free_instance() -> int:
    """An instance of PX4 of which no port and no lock is in use."""
    for instance in range(9, 0, -1):
        if Path(f"/tmp/px4_lock-{instance}").exists():
            continue
        ports = [(socket.SOCK_STREAM, 4560)] + [(socket.SOCK_DGRAM, p) for p in (14540, 14580, 18570, 14280, 13030)]
        with contextlib.ExitStack() as stack:
            try:
                for kind, first in ports:
                    probe = stack.enter_context(socket.socket(socket.AF_INET, kind))
                    probe.bind(("127.0.0.1", first + instance))
            except OSError:
                continue
            return instance
    pytest.skip("no instance of PX4 from 1 to 9 has all its ports free")


class Px4:
    """A running PX4."""

    def __init__(self, model: str, instance: int, folder: Path, **environment: str) -> None:
        path = binary()
        self.instance = instance
        self.log = folder / "px4.log"
        command = [str(path), "-d", "-i", str(instance), "-w", str(folder), str(path.parent.parent / "etc")]
        with self.log.open("wb") as out:
            self.process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=subprocess.STDOUT,
                cwd=folder,
                env=os.environ | {"PX4_SIM_MODEL": model} | environment,
                start_new_session=True,
            )

    def signal(self, number: int) -> None:
        self.process.send_signal(number)

    def stop(self) -> None:
        """End it and whatever it has started."""
        if self.process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait(10.0)
        for name in ("px4_lock", "px4-sock"):
            Path(f"/tmp/{name}-{self.instance}").unlink(missing_ok=True)


class Link:
    """The companion's side of PX4's onboard link."""

    def __init__(self, instance: int) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 14540 + instance))
        self.socket.settimeout(0.2)
        self.address = ("127.0.0.1", 14580 + instance)
        self.target = 1 + instance
        self.mav = mavlink.MAVLink(None, srcSystem=self.target, srcComponent=191)
        self.mav.robust_parsing = True
        self.last: dict[str, object] = {}
        self.texts: list[str] = []
        self._heartbeat_s = 0.0

    def poll(self) -> None:
        """Take in what comes for at most 0.2 s, and keep the heartbeat up."""
        if time.monotonic() - self._heartbeat_s > 1.0:
            self._heartbeat_s = time.monotonic()
            self.send(mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
        try:
            data = self.socket.recv(4096)
        except TimeoutError:
            return
        for message in self.mav.parse_buffer(data) or []:
            if message.get_type() == "HEARTBEAT" and message.get_srcComponent() != 1:
                continue
            self.last[message.get_type()] = message
            if message.get_type() == "STATUSTEXT":
                self.texts.append(message.text)

    def send(self, message) -> None:
        self.socket.sendto(message.pack(self.mav), self.address)
        self.mav.seq = (self.mav.seq + 1) % 256

    def command(self, number: int, *params: float) -> int:
        """Send a command until it is acknowledged; gives the result."""
        values = [*params, *(0.0,) * (7 - len(params))]
        end_s = time.monotonic() + _ASK_S
        while time.monotonic() < end_s:
            self.last.pop("COMMAND_ACK", None)
            self.send(mavlink.MAVLink_command_long_message(self.target, 1, number, 0, *values))
            again_s = time.monotonic() + 1.0
            while time.monotonic() < again_s:
                self.poll()
                ack = self.last.get("COMMAND_ACK")
                if ack is not None and ack.command == number:
                    return int(ack.result)
        raise AssertionError(f"no answer to command {number}; PX4 said {self.texts}")

    def until(self, predicate: Callable[[], bool], seconds: float, what: str) -> None:
        end_s = time.monotonic() + seconds
        while not predicate():
            assert time.monotonic() < end_s, f"{what}: not within {seconds:g} s; PX4 said {self.texts}"
            self.poll()

    def passed(self, seconds: float) -> None:
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            self.poll()

    def value(self, message: str, name: str, default: float = float("nan")) -> float:
        found = self.last.get(message)
        return default if found is None else float(getattr(found, name))

    @property
    def armed(self) -> bool:
        return bool(int(self.value("HEARTBEAT", "base_mode", 0)) & 128)

    @property
    def mode(self) -> tuple[int, int]:
        """PX4's main and sub mode."""
        custom = int(self.value("HEARTBEAT", "custom_mode", 0))
        return custom >> 16 & 0xFF, custom >> 24

    def healthy(self) -> bool:
        """Whether the EKF has everything, by its own word, and PX4 would arm."""
        status, estimator = self.last.get("SYS_STATUS"), self.last.get("ESTIMATOR_STATUS")
        prearm = 0x10000000
        good = 0x01 | 0x02 | 0x04 | 0x08 | 0x10 | 0x20  # attitude, velocities, position relative and absolute, height
        ready = status is not None and bool(status.onboard_control_sensors_health & prearm)
        return ready and estimator is not None and estimator.flags & good == good

    def close(self) -> None:
        self.socket.close()


class Flight:
    """A PX4 in our world, and the link to it, if wanted: else somebody else has its port."""

    def __init__(self, options: HilOptions, folder: Path, link: bool = True) -> None:
        self.instance = free_instance()
        binary()
        self.said: list[str] = []
        self.results: list[bool] = []
        self._stop = False
        self.hil = Hil(options, HilServer(4560 + self.instance), stopped=lambda: self._stop, notice=self.said.append)
        self.thread = threading.Thread(target=lambda: self.results.append(self.hil.run()))
        self.thread.start()
        self._link = Link(self.instance) if link else None
        environment = {"PX4_SIM_SPEED_FACTOR": f"{options.speed:g}", "PX4_PARAM_COM_OBL_RC_ACT": "5"}
        self.px4 = Px4("none_iris", self.instance, folder, **environment)

    def close(self) -> None:
        self.px4.stop()
        self._stop = True
        self.thread.join(10.0)
        self.hil.close()
        if self._link is not None:
            self._link.close()
        assert not self.thread.is_alive()

    @property
    def link(self) -> Link:
        assert self._link is not None
        return self._link

    @property
    def truth(self):
        return self.hil.world.airframe.rigid

    def boot(self) -> None:
        """Wait until PX4 flies in lockstep with our world and would arm."""
        self.link.until(lambda: self.hil.synchronous, _BOOT_S, "lockstep")
        assert self.link.command(SET_INTERVAL, 230, 200_000) == 0  # ESTIMATOR_STATUS
        self.link.until(self.link.healthy, _BOOT_S, "a healthy estimate")

    def take_off(self) -> None:
        """Arm, and rise to PX4's own takeoff altitude."""
        nan = float("nan")
        assert self.link.command(TAKEOFF, 0.0, 0.0, 0.0, nan, nan, nan, nan) == 0
        assert self.link.command(ARM, 1.0) == 0
        self.link.until(lambda: self.truth.p[2] < -2.0, 40.0, "2 m of height")
        self.link.until(lambda: self.link.mode == (4, 3), 40.0, "Hold after the takeoff")


@contextlib.contextmanager
def flying(options: HilOptions, folder: Path, link: bool = True) -> Iterator[Flight]:
    flight = Flight(options, folder, link)
    try:
        yield flight
    finally:
        flight.close()
