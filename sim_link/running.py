"""A simulated vehicle in a thread of its own, on free ports, for whoever tests a program against it.

The pytest fixtures of `pytest_plugin` are made of it; with another test runner, or in a notebook:

    with RunningVehicle(start=(0.0, 0.0, -10.0)) as vehicle:
        subprocess.run([sys.executable, "my_program.py", vehicle.connection], check=True, timeout=60)
        print(vehicle.truth.p)
"""

from __future__ import annotations

import math
import socket
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType

from .airframe import Truth
from .fault_file import load as load_faults
from .fault_kinds import Fault
from .faults import Faults
from .peer import Peer, PeerOptions
from .signing import KEY_LENGTH
from .udp import LOOPBACK
from .vehicle import Vehicle, VehicleOptions
from .vehicle_file import load
from .wind import World

_STOP_WITHIN_S = 5.0
_LOOK_EVERY_S = 0.005


class VehicleBrokeError(RuntimeError):
    """The vehicle's own program broke, or does not end."""


class RunningVehicle:
    """A vehicle that runs from the moment it is made until `stop`, or to the end of a `with`."""

    def __init__(
        self,
        *,
        vehicle: str | Path = "bundled",
        start: Sequence[float] | None = None,
        lockstep: bool = False,
        speed: float = 1.0,
        seed: int = 1,
        faults: str | Path | Sequence[Fault] = (),
        parameters: Mapping[str, int | float] | None = None,
        wind_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0),
        turbulence: float = 0.0,
        force_n: tuple[float, float, float] = (0.0, 0.0, 0.0),
        gravity_factor: float = 1.0,
        state_rate_hz: float | None = None,
        state_age_s: float | None = None,
        instance: int = 0,
        px4: str = "1.18",
        engine: str = "python",
        key: bytes | None = None,
    ) -> None:
        """Start a vehicle on free ports.

        Args:
            vehicle: a vehicle file, or the name of a bundled one.
            start: north, east, down [m] and, if wanted, a yaw [deg]: it waits there in the air, armed, in Hold. None:
                on the ground, disarmed.
            lockstep: its clock waits for the program's answer to every state (TIMESYNC), in the place of real time.
            speed: vehicle time per wall time, without lockstep.
            seed: of noise, gusts and faults.
            faults: a fault file, the name of a bundled one, or faults (`sim_link.fault_kinds.fault`).
            parameters: the autopilot's, by name.
            wind_m_s: where it blows to, NED.
            turbulence: standard deviation of the gusts over the mean wind.
            force_n: constant force, NED.
            gravity_factor: gravity over 9.81 m/s^2.
            state_rate_hz: states per second; None: the vehicle file's.
            state_age_s: age of a state when it is sent; None: the vehicle file's.
            instance: its system id is 1 + instance.
            px4: whose behaviour: "1.18" or "1.13".
            engine: "python", "numba" or "auto".
            key: 32 bytes: it signs what it sends, and believes only who does the same (MAVLink 2 signing).

        Raises:
            ValueError: one of these cannot be; the message says which.
            ImportError: the engine "numba" is asked for and not installed.
        """
        file = load(str(vehicle))
        if state_rate_hz is not None:
            file = replace(file, state_rate_hz=_within("state_rate_hz", state_rate_hz, 0.1, 10_000.0))
        if state_age_s is not None:
            file = replace(file, state_age_s=_within("state_age_s", state_age_s, 0.0, 1.0))
        _within("speed", speed, 0.001, 1e6)
        self._vehicle = Vehicle(
            VehicleOptions(
                vehicle=file,
                world=World(
                    force_n=force_n,
                    gravity_factor=gravity_factor,
                    wind_m_s=wind_m_s,
                    turbulence=turbulence,
                    seed=seed,
                ),
                instance=instance,
                start=_pose(start),
                seed=seed,
                px4=px4,
                engine=engine,
                parameters=parameters or {},
                faults=load_faults(str(faults), px4) if isinstance(faults, str | Path) else tuple(faults),
                signing_key=_key(key),
            )
        )
        self.remote_port, self.ground_remote_port = _free_ports(2)
        """Where the vehicle sends to: companion link, ground link."""
        options = PeerOptions(
            port=0,
            remote_port=self.remote_port,
            ground_port=0,
            ground_remote_port=self.ground_remote_port,
            lockstep=lockstep,
            speed=speed,
        )
        self.notices: list[str] = []
        """What the vehicle's console says: faults that begin and end, a companion that falls silent in lockstep."""
        self.track: list[Truth] = []
        """What really happened: a row for every state so far, which the vehicle's thread goes on appending to."""
        self._peer = Peer(self._vehicle, options, stopped=self._observe, notice=self.notices.append)
        self._stopping = False
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name=f"simulated vehicle {self.system_id}", daemon=True)
        self._thread.start()

    # Where it is

    @property
    def system_id(self) -> int:
        """Its MAVLink system id."""
        return self._vehicle.system

    @property
    def connection(self) -> str:
        """Companion link as pymavlink's mavutil takes it: the port where the program under test has to listen."""
        return f"udpin:{LOOPBACK}:{self.remote_port}"

    @property
    def mavsdk_connection(self) -> str:
        """The same for MAVSDK."""
        return f"udpin://{LOOPBACK}:{self.remote_port}"

    @property
    def ground_connection(self) -> str:
        """Ground link, as pymavlink's mavutil takes it."""
        return f"udpin:{LOOPBACK}:{self.ground_remote_port}"

    @property
    def mavsdk_ground_connection(self) -> str:
        """The same for MAVSDK."""
        return f"udpin://{LOOPBACK}:{self.ground_remote_port}"

    @property
    def port(self) -> int:
        """The vehicle's own port of the companion link, for programs that speak first (`udpout`)."""
        return self._peer.companion.port

    # What really is

    @property
    def truth(self) -> Truth:
        """What really happens now: position, velocity, attitude, rates, rotors (see `Truth`)."""
        return self._vehicle.airframe.truth()

    @property
    def t_s(self) -> float:
        """Vehicle time since its start [s]."""
        return (self._vehicle.airframe.t_us - self._vehicle.start_us) * 1e-6

    @property
    def mode(self) -> str:
        """The flight mode: Hold, Offboard, Land, ..."""
        return self._vehicle.autopilot.mode.label

    @property
    def armed(self) -> bool:
        """Whether it is armed."""
        return self._vehicle.autopilot.armed

    @property
    def landed(self) -> bool:
        """Whether its land detector says that it stands on the ground."""
        return self._vehicle.autopilot.land.landed

    @property
    def signing_key(self) -> bytes | None:
        """The key that it signs with now; None: it signs nothing."""
        return self._vehicle.keyring.key

    @property
    def signing_refused(self) -> Mapping[str, int]:
        """Messages that were refused for their signature, by reason; what never was is 0."""
        return self._vehicle.keyring.refused

    @property
    def faults(self) -> Faults:
        """What goes wrong: `faults.inject("wind", for_s=3.0, wind_m_s=(0.0, 8.0, 0.0))`, `faults.end(number)`."""
        return self._vehicle.faults

    def wait_until(self, condition: Callable[[], bool], timeout_s: float = 30.0) -> None:
        """Wait until something is so, for a wall time.

        Raises:
            TimeoutError: it is not so by then.
            VehicleBrokeError: the vehicle's own program broke.
        """
        end_s = time.monotonic() + timeout_s
        while not condition():
            self._check()
            if time.monotonic() >= end_s:
                raise TimeoutError(f"not within {timeout_s:g} s; the vehicle: {self.describe()}")
            time.sleep(_LOOK_EVERY_S)

    def describe(self) -> str:
        """Say in a line how the vehicle is."""
        n, e, d = self.truth.p
        armed = "armed" if self.armed else "disarmed"
        return f"{self.t_s:.1f} s, {self.mode}, {armed}, at {n:.2f} m north, {e:.2f} east, {d:.2f} down"

    # Its end

    def stop(self) -> None:
        """End the vehicle and give its ports back; doing so twice is harmless.

        Raises:
            VehicleBrokeError: its own program broke, or does not end.
        """
        self._stopping = True
        self._thread.join(_STOP_WITHIN_S)
        if self._thread.is_alive():
            raise VehicleBrokeError(f"the vehicle does not end within {_STOP_WITHIN_S:g} s")
        self._peer.close()
        self._check()

    def __enter__(self) -> RunningVehicle:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _check(self) -> None:
        if self._failure is not None:
            raise VehicleBrokeError(f"the vehicle's own program broke: {self._failure!r}") from self._failure

    def _run(self) -> None:
        try:
            self._peer.run()
        except Exception as error:
            self._failure = error

    def _observe(self) -> bool:
        """Note every state; called in the vehicle's thread before each of them. Gives whether to stop."""
        t_us = self._vehicle.airframe.t_us
        if not self.track or self.track[-1].t_us != t_us:
            self.track.append(self._vehicle.airframe.truth())
        return self._stopping


def _pose(start: Sequence[float] | None) -> tuple[tuple[float, float, float], float] | None:
    """Read a start in the air."""
    if start is None:
        return None
    values = [float(value) for value in start]
    if len(values) not in (3, 4) or not all(map(math.isfinite, values)) or values[2] >= 0.0:
        raise ValueError(
            f"start = {start!r}: must be north, east, down (below 0: in the air) and, if wanted, a yaw [deg]"
        )
    return (values[0], values[1], values[2]), math.radians(values[3] if len(values) > 3 else 0.0)


def _key(key: bytes | None) -> bytes | None:
    """Check a signing key; the message does not show it."""
    if key is not None and (len(key) != KEY_LENGTH or not any(key)):
        raise ValueError(f"key: must be {KEY_LENGTH} bytes, not all of them zero")
    return key


def _within(name: str, value: float, low: float, high: float) -> float:
    """Check an option."""
    if not low <= value <= high:
        raise ValueError(f"{name} = {value!r}: must be {low:g} to {high:g}")
    return value


def _free_ports(count: int) -> list[int]:
    """Give ports that nobody uses."""
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    try:
        for sock in sockets:
            sock.bind((LOOPBACK, 0))
        return [int(sock.getsockname()[1]) for sock in sockets]
    finally:
        for sock in sockets:
            sock.close()
