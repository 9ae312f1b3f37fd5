"""A PX4 with its own simulated vehicle (SIH) for measurements: started, spoken to and stopped by its process id.

The companion has the onboard link to itself. This program uses two others: PX4's ground link, for the wind and for the
mode, and the port on which SIH tells where its vehicle really is. Everything that PX4 writes goes to one folder.
"""

from __future__ import annotations

import contextlib
import math
import os
import signal
import socket
import struct
import subprocess
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from pymavlink.dialects.v20 import common as mavlink2

COMPANION_PORT, GROUND_PORT, TRUTH_PORT = 14540, 18570, 19410
INSTANCES = range(1, 10)
MODEL = "sihsim_quadx"
OFFBOARD = 6
"""Main mode in HEARTBEAT.custom_mode."""
READY_S = 60.0
EARTH_RADIUS_M = 6_371_000.0
FAILSAFE = {"COM_OBL_RC_ACT": "5", "COM_OF_LOSS_T": "0.5"}
"""What docs/px4.md asks for: Hold, half a second after the setpoints cease."""

Array = npt.NDArray[np.float64]


class Truth(NamedTuple):
    """Where the simulated vehicle really was."""

    t_s: Array
    """PX4's time [s], shape (n,)."""
    p_m: Array
    """North, east, down from where it stood first [m], shape (n, 3)."""


def start_scripts(binary: Path) -> Path:
    """The folder `etc` that belongs to a binary of PX4's build.

    Raises:
        FileNotFoundError: it is not there, or the binary is not executable.
    """
    etc = binary.resolve().parent.parent / "etc"
    if not os.access(binary, os.X_OK):
        raise FileNotFoundError(f"{binary}: not an executable; name build/px4_sitl_default/bin/px4")
    if not (etc / "init.d-posix" / "rcS").is_file():
        raise FileNotFoundError(f"{binary}: no etc/init.d-posix/rcS beside its folder; build PX4 with px4_sitl_default")
    return etc


def free_instance() -> int:
    """An instance of PX4 of which no port and no lock is in use.

    Raises:
        OSError: there is none from 1 to 9.
    """
    for instance in reversed(INSTANCES):
        if Path(f"/tmp/px4_lock-{instance}").exists():
            continue
        with contextlib.ExitStack() as stack:
            try:
                for first in (COMPANION_PORT, 14580, GROUND_PORT, TRUTH_PORT, 14280, 13030):
                    stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)).bind(
                        ("127.0.0.1", first + instance)
                    )
            except OSError:
                continue
            return instance
    raise OSError("no instance of PX4 from 1 to 9 has all its ports free")


class Session:
    """One run of PX4; a context manager.

    Args:
        binary: build/px4_sitl_default/bin/px4.
        folder: PX4's working folder; made when it is not there.
        parameters: PX4's, beside `FAILSAFE`, by name.
    """

    def __init__(self, binary: Path, folder: Path, parameters: dict[str, str] | None = None) -> None:
        self._etc = start_scripts(binary)
        folder.mkdir(parents=True, exist_ok=True)
        self.instance = free_instance()
        self.connection = f"udpin:127.0.0.1:{COMPANION_PORT + self.instance}"
        """What the companion connects to."""
        self._mode = 0
        self._armed = self._ready = False
        self._values: dict[str, float] = {}
        self._truth: list[tuple[float, ...]] = []
        self._running = True
        self._parser = mavlink2.MAVLink(None, srcSystem=254, srcComponent=190)
        self._parser.robust_parsing = True
        self._ground = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._ground.bind(("127.0.0.1", 0))
        self._truth_socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._truth_socket.bind(("127.0.0.1", TRUTH_PORT + self.instance))
        for link in (self._ground, self._truth_socket):
            link.settimeout(0.2)
        environment = {f"PX4_PARAM_{name}": value for name, value in (FAILSAFE | (parameters or {})).items()}
        self._log = (folder / "px4.log").open("wb")
        self._process = subprocess.Popen(
            [str(binary), "-d", "-i", str(self.instance), "-w", str(folder), str(self._etc)],
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=subprocess.STDOUT,
            cwd=folder,
            env=os.environ | {"PX4_SIM_MODEL": MODEL} | environment,
            start_new_session=True,
        )
        self._threads = [threading.Thread(target=run, daemon=True) for run in (self._listen, self._follow)]
        for thread in self._threads:
            thread.start()

    def __enter__(self) -> Session:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Ends PX4: asked first, then by force."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)
            try:
                self._process.wait(5.0)
            except subprocess.TimeoutExpired:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(self._process.pid, signal.SIGKILL)
                self._process.wait(5.0)
        self._running = False
        for thread in self._threads:
            thread.join(2.0)
        self._ground.close()
        self._truth_socket.close()
        self._log.close()
        for name in ("px4_lock", "px4-sock"):
            Path(f"/tmp/{name}-{self.instance}").unlink(missing_ok=True)

    # -- what it says ---------------------------------------------------------------------------------------------

    @property
    def offboard(self) -> bool:
        """Whether it is armed and in OFFBOARD, by its last heartbeat."""
        return self._armed and self._mode == OFFBOARD

    @property
    def now_s(self) -> float:
        """PX4's time, 40 ms old at most [s]; NaN before its vehicle has shown itself."""
        return self._truth[-1][0] if self._truth else math.nan

    def truth(self) -> Truth:
        """Where the vehicle was so far."""
        rows = np.array(self._truth, dtype=np.float64).reshape(-1, 4)
        return Truth(rows[:, 0], rows[:, 1:])

    def wait_until_ready(self) -> None:
        """Waits until PX4 would arm.

        Raises:
            TimeoutError: it would not within a minute.
        """
        end_s = time.monotonic() + READY_S
        while not self._ready:
            if self._process.poll() is not None:
                raise TimeoutError(f"PX4 ended with code {self._process.returncode}; see px4.log")
            if time.monotonic() > end_s:
                raise TimeoutError(f"PX4 was not ready to arm within {READY_S:g} s; see px4.log")
            time.sleep(0.1)

    # -- what it is told ------------------------------------------------------------------------------------------

    def set(self, **values: float) -> None:
        """Sets parameters (REAL32), and waits until PX4 confirms each.

        Raises:
            TimeoutError: it did not within 3 s.
        """
        for name, value in values.items():
            end_s = time.monotonic() + 3.0
            wanted = struct.unpack("f", struct.pack("f", value))[0]
            self._values.pop(name, None)
            while self._values.get(name) != wanted:
                if time.monotonic() > end_s:
                    raise TimeoutError(f"PX4 did not take {name} = {value:g}")
                self._send(
                    mavlink2.MAVLink_param_set_message(
                        1 + self.instance, 1, name.encode(), value, mavlink2.MAV_PARAM_TYPE_REAL32
                    )
                )
                time.sleep(0.1)

    def wind(self, north_m_s: float, east_m_s: float) -> None:
        """Changes the wind, live and at once."""
        self.set(SIH_WIND_N=north_m_s, SIH_WIND_E=east_m_s)

    # -- links ----------------------------------------------------------------------------------------------------

    def _send(self, message: Any) -> None:
        self._ground.sendto(message.pack(self._parser), ("127.0.0.1", GROUND_PORT + self.instance))

    def _listen(self) -> None:
        """The ground link. PX4 answers the first one who speaks to it there."""
        asked_s = -math.inf
        while self._running:
            if time.monotonic() - asked_s > 1.0:
                asked_s = time.monotonic()
                with contextlib.suppress(OSError):
                    self._send(mavlink2.MAVLink_ping_message(int(asked_s * 1e6), 0, 0, 0))
            try:
                data = self._ground.recv(4096)
            except OSError:
                continue
            for message in self._parser.parse_buffer(data) or []:
                self._take(message)

    def _take(self, message: Any) -> None:
        kind = message.get_type()
        if message.get_srcComponent() != 1:
            return
        if kind == "HEARTBEAT":
            self._mode, self._armed = message.custom_mode >> 16 & 0xFF, bool(message.base_mode & 128)
        elif kind == "PARAM_VALUE":
            self._values[message.param_id] = message.param_value
        elif kind == "SYS_STATUS":
            self._ready = bool(message.onboard_control_sensors_health & mavlink2.MAV_SYS_STATUS_PREARM_CHECK)

    def _follow(self) -> None:
        """HIL_STATE_QUATERNION."""
        parser = mavlink2.MAVLink(None)
        parser.robust_parsing = True
        home: tuple[int, int, int] | None = None
        while self._running:
            try:
                data = self._truth_socket.recv(4096)
            except OSError:
                continue
            for message in parser.parse_buffer(data) or []:
                if message.get_type() != "HIL_STATE_QUATERNION":
                    continue
                home = home or (message.lat, message.lon, message.alt)
                north = math.radians((message.lat - home[0]) * 1e-7) * EARTH_RADIUS_M
                east = math.radians((message.lon - home[1]) * 1e-7) * EARTH_RADIUS_M
                east *= math.cos(math.radians(home[0] * 1e-7))
                self._truth.append((message.time_usec * 1e-6, north, east, (home[2] - message.alt) * 1e-3))
