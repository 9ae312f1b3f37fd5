"""Faults of processes and of the machine: `companion serve` and the vehicle at real time, once per phase.

The vehicle runs in this process; the companion's two processes and their supervisor are what they are in use. What is
done to them is done from outside: signals, a clock that is stepped, a full disk, floods, a line that is pulled.
"""

from __future__ import annotations

import contextlib
import os
import pty
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import tty
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import tomlkit
from matrix_flight import PARAMETERS, Moment, flight_of
from matrix_judge import Verdict, judged
from pymavlink.dialects.v20 import development as mavlink

from companion.flight.bundled import free_udp_port
from companion.flight.phases import Phase
from companion.ground.client import Client
from companion.ground.upload import Files
from sim_link.modes import Mode
from sim_link.peer import Peer, PeerOptions
from sim_link.vehicle import Vehicle, VehicleOptions
from sim_link.vehicle_file import load

PATIENCE_S: Final = 60.0
SETTLE_S: Final = 5.0
"""How long a vehicle must hold, and a companion have nothing to say, until that is taken for the end."""
DISK_BYTES: Final = 700_000
FLOOD_S, FLOOD_DATAGRAMS = 4.0, 40_000
FAKETIME: Final = Path("/usr/lib/x86_64-linux-gnu/faketime/libfaketimeMT.so.1")
"""Debian's package libfaketime; without it the clock cannot be stepped, and its flights are left out."""
_PHASE_LINES = {f"{phase.value}:": phase for phase in Phase}


class RealVehicle:
    """The simulated vehicle at real time in a thread, and what it did."""

    def __init__(self, folder: Path, flight: Any, remote_port: int) -> None:
        path = folder / "vehicle.toml"
        path.write_text(tomlkit.dumps(flight.vehicle.model_dump(mode="json", exclude_none=True)))
        self.path = path
        options = VehicleOptions(vehicle=load(str(path)), engine="python", parameters=PARAMETERS)
        self.vehicle = Vehicle(options)
        self.moments: list[Moment] = []
        self._stopping = False
        self.peer = Peer(self.vehicle, PeerOptions(port=0, remote_port=remote_port), stopped=self._look)
        self._thread = threading.Thread(target=self.peer.run, daemon=True)
        self._thread.start()

    def _look(self) -> bool:
        vehicle = self.vehicle
        t_s = vehicle.faults.elapsed_s
        if not self.moments or self.moments[-1].t_s != t_s:
            truth, pilot = vehicle.airframe.truth(), vehicle.autopilot
            believed = vehicle.airframe.inner_state().p
            grounded = vehicle.airframe.on_ground
            self.moments.append(Moment(t_s, truth.p, truth.v, believed, pilot.mode, pilot.armed, grounded))
        return self._stopping

    def close(self) -> None:
        self._stopping = True
        self._thread.join(5.0)
        self.peer.close()


class Serve:
    """`companion serve` with its log, and the phase that the log says it is in."""

    def __init__(
        self, folder: Path, vehicle: Path, connection: str, flights: Path, environment: dict[str, str]
    ) -> None:
        self.lines: list[str] = []
        self.phase: Phase | None = None
        self.over = False
        """Whether a flight has ended, with its folder written."""
        self.ready = threading.Event()
        self.port = free_udp_port()
        self.to = f"udpout:127.0.0.1:{self.port}"
        flight = folder / "flight.toml"
        table = {"name": "matrix", "vehicle": str(vehicle), "takeoff_altitude_m": 3.0, "after": "land"}
        flight.write_text(tomlkit.dumps(table | {"trajectory": "hover"}))
        trajectories = folder / "trajectories"
        trajectories.mkdir()
        circle = {"radius_m": 1.0, "angular_rate_rad_s": 0.75, "phase_deg": 0.0}
        (trajectories / "circle.toml").write_text(
            tomlkit.dumps({"shape": "circle", "anchor": "here", "duration_s": 7.0, "circle": circle})
        )
        command = [
            *(sys.executable, "-m", "companion", "serve", "--flight", str(flight), "--vehicle", str(vehicle)),
            *("--connect", connection, "--ground", f"udpin:127.0.0.1:{self.port}", "--folder", str(trajectories)),
            *("--flights", str(flights), "--engine", "python", "--no-reports"),
        ]
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env={**os.environ, **environment, "PYTHONUNBUFFERED": "1"},
            start_new_session=True,
        )
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            text = line.strip()
            self.lines.append(text)
            if text.startswith("ready:"):
                self.ready.set()
            word = text.split(" ", 1)[0]
            if word in _PHASE_LINES:
                self.phase = _PHASE_LINES[word]
            self.over = self.over or "flight folder:" in text

    def pid(self, module: str) -> int | None:
        """Of one of its two processes."""
        for folder in Path("/proc").iterdir():
            if folder.name.isdigit():
                with contextlib.suppress(OSError):
                    parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
                    if parent == self.process.pid and module.encode() in (folder / "cmdline").read_bytes():
                        return int(folder.name)
        return None

    def signal(self, module: str, number: int) -> None:
        """Sends a signal to one of its two processes."""
        pid = self.pid(module)
        if pid is not None:
            os.kill(pid, number)

    def close(self) -> None:
        for module in (CONTROL, GROUND):
            self.signal(module, signal.SIGCONT)
        if self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(35.0)
            except subprocess.TimeoutExpired:
                os.killpg(self.process.pid, signal.SIGKILL)
                self.process.wait()
        self._thread.join(5.0)


CONTROL, GROUND = "companion.ground.control", "companion.ground.process"


@dataclass
class Scene:
    """What a fault may act on."""

    serve: Serve
    vehicle: RealVehicle
    folder: Path
    flights: Path
    line: Line | None = None


class Line:
    """A serial line to the vehicle: a pseudo terminal, and a thread that carries bytes to and from its UDP port."""

    def __init__(self, port: int) -> None:
        self.master, slave = pty.openpty()
        tty.setraw(self.master)
        tty.setraw(slave)
        self.name = os.ttyname(slave)
        os.close(slave)
        self._sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sock.bind(("127.0.0.1", port))
        self._vehicle: tuple[str, int] | None = None
        self._pulled = threading.Event()
        self._thread = threading.Thread(target=self._carry, daemon=True)
        self._thread.start()

    def _carry(self) -> None:
        os.set_blocking(self.master, False)
        while not self._pulled.is_set():
            for fd in select.select([self.master, self._sock], [], [], 0.05)[0]:
                if fd is self._sock:
                    data, self._vehicle = self._sock.recvfrom(4096)
                    with contextlib.suppress(OSError):
                        os.write(self.master, data)
                    continue
                try:
                    data = os.read(self.master, 4096)
                except OSError:  # nobody has it open yet
                    time.sleep(0.02)
                    continue
                if self._vehicle is not None:
                    for frame in _frames(data):
                        self._sock.sendto(frame, self._vehicle)
        os.close(self.master)
        self._sock.close()

    def pull(self) -> None:
        """Pulls the plug."""
        self._pulled.set()
        self._thread.join(2.0)


def _frames(data: bytes) -> Iterator[bytes]:
    """Whole MAVLink 2 frames, as a vehicle's serial port would find them."""
    while len(data) >= 12 and data[0] == 0xFD:
        length = data[1] + 12
        yield data[:length]
        data = data[length:]


# -- what is done -----------------------------------------------------------------------------------------------------


def _pause(module: str, seconds: float) -> Callable[[Scene], None]:
    def act(scene: Scene) -> None:
        scene.serve.signal(module, signal.SIGSTOP)
        time.sleep(seconds)
        scene.serve.signal(module, signal.SIGCONT)

    return act


def _kill(module: str) -> Callable[[Scene], None]:
    return lambda scene: scene.serve.signal(module, signal.SIGKILL)


def _step_clock(offset: str) -> Callable[[Scene], None]:
    def act(scene: Scene) -> None:
        (scene.folder / "faketime").write_text(offset + "\n")

    return act


def _fill_disk(scene: Scene) -> None:
    with contextlib.suppress(OSError), (scene.flights / "junk").open("wb", buffering=0) as junk:
        while True:
            junk.write(bytes(4096))


def _flood(scene: Scene) -> None:
    """Requests, commands and rubbish, as fast as they go, for a bounded time."""
    mav = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    frames = [
        mavlink.MAVLink_param_request_list_message(1, 191).pack(mav),
        mavlink.MAVLink_command_long_message(1, 191, 512, 0, 148, 0, 0, 0, 0, 0, 0).pack(mav),
        mavlink.MAVLink_file_transfer_protocol_message(0, 1, 191, list(os.urandom(251))).pack(mav),
        mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(mav),
        os.urandom(200),
    ]
    end_s = time.monotonic() + FLOOD_S
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        for i in range(FLOOD_DATAGRAMS):
            if time.monotonic() > end_s:
                break
            sock.sendto(frames[i % len(frames)], ("127.0.0.1", scene.serve.port))
            if i % 50 == 49:
                time.sleep(0.004)


def _upload_twice(scene: Scene) -> None:
    """Two tools upload under one name at once, and two files that are no trajectories."""

    def upload(number: int) -> None:
        lines = "\n".join(f"{0.1 * i:.2f},{0.3 * i:.3f},0,-3" for i in range(300 + number))
        with contextlib.suppress(Exception), Files(scene.serve.to) as files:
            files.upload_bytes(f"t,x,y,z\n{lines}\n".encode(), "lap.csv", verdict_patience_s=20.0)

    threads = [threading.Thread(target=upload, args=(i,), daemon=True) for i in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(25.0)


def _second_companion(scene: Scene) -> None:
    """Another companion is started on the same link: it must not get it."""
    port = scene.vehicle.peer.options.remote_port
    command = [sys.executable, "-m", "companion", "doctor", "--vehicle", str(scene.vehicle.path)]
    done = subprocess.run(
        [*command, "--connect", f"udpin:127.0.0.1:{port}"], capture_output=True, text=True, timeout=60, check=False
    )
    scene.serve.lines.append(f"(the second one: exit code {done.returncode}: {done.stderr.strip()[-200:]})")


def _pull(scene: Scene) -> None:
    assert scene.line is not None
    scene.line.pull()


@dataclass(frozen=True)
class RealCase:
    """One thing that goes wrong at real time."""

    name: str
    act: Callable[[Scene], None]
    says: tuple[str, ...] = ()
    """One of these is in the log, unless the flight was flown to its end."""
    serial: bool = False
    clock: bool = False
    disk: bool = False


_ENDED = ("ending:", "no setpoint went out", "another hand", "failsafe", "no usable state", "refused", "interrupted")
_CASES = (
    RealCase("control process paused 0.1 s", _pause(CONTROL, 0.1), _ENDED),
    RealCase("control process paused 0.4 s", _pause(CONTROL, 0.4), _ENDED),
    RealCase("control process paused 1.5 s", _pause(CONTROL, 1.5), _ENDED),
    RealCase("control process paused 5 s", _pause(CONTROL, 5.0), _ENDED),
    RealCase("ground process paused 5 s", _pause(GROUND, 5.0)),
    RealCase("control process killed", _kill(CONTROL), ("was ended by signal 9",)),
    RealCase("ground process killed", _kill(GROUND), ("was ended by signal 9",)),
    RealCase("machine's clock 5 h ahead", _step_clock("+5h"), clock=True),
    RealCase("machine's clock 5 h back", _step_clock("-5h"), clock=True),
    RealCase("disk full", _fill_disk, disk=True),
    RealCase("ground link flooded", _flood),
    RealCase("two uploads at once", _upload_twice),
    RealCase("second companion on the link", _second_companion),
    RealCase("serial line unplugged", _pull, ("the line is gone", "the line was hung up"), serial=True),
)
REAL_CASES: dict[str, RealCase] = {case.name: case for case in _CASES}


def possible(case: RealCase) -> str:
    """Why a case cannot be flown here; "" when it can."""
    if case.clock and not FAKETIME.exists():
        return f"{FAKETIME} is missing (Debian: libfaketime)"
    if case.disk and os.geteuid() != 0:
        return "a small disk can be mounted by root only"
    return ""


@contextlib.contextmanager
def _small_disk(folder: Path, wanted: bool) -> Iterator[Path]:
    """The folder for flights; when wanted, on a disk of its own that is soon full."""
    flights = folder / "flights"
    flights.mkdir()
    if not wanted:
        yield flights
        return
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "tmpfs", str(flights)], check=True)
    try:
        yield flights
    finally:
        subprocess.run(["umount", "-l", str(flights)], check=False)


def fly_real(name: str, phase: Phase) -> tuple[Verdict, list[str]]:
    """Flies once at real time with one fault in one phase; gives the verdict and the companion's log."""
    case = REAL_CASES[name]
    with tempfile.TemporaryDirectory(prefix="matrix-real-") as text, contextlib.ExitStack() as stack:
        folder = Path(text)
        flights = stack.enter_context(_small_disk(folder, case.disk))
        flight, port = flight_of(), free_udp_port()
        vehicle = RealVehicle(folder, flight, port)
        stack.callback(vehicle.close)
        line = Line(port) if case.serial else None
        if line is not None:
            stack.callback(line.pull)
        connection = f"udpin:127.0.0.1:{port}" if line is None else f"serial:{line.name}:921600"
        environment = {}
        if case.clock:
            (folder / "faketime").write_text("+0\n")
            environment = {
                **{"LD_PRELOAD": str(FAKETIME), "FAKETIME_TIMESTAMP_FILE": str(folder / "faketime")},
                **{"FAKETIME_NO_CACHE": "1", "DONT_FAKE_MONOTONIC": "1", "FAKETIME_DONT_FAKE_MONOTONIC": "1"},
            }
        serve = Serve(folder, vehicle.path, connection, flights, environment)
        stack.callback(serve.close)
        scene = Scene(serve, vehicle, folder, flights, line)
        acted = _fly(scene, case, phase)
        serve.close()
        _wait(lambda: _calm(vehicle), SETTLE_S)
        time.sleep(SETTLE_S)
        vehicle.close()
        return _verdict(scene, case, acted), serve.lines


def _fly(scene: Scene, case: RealCase, phase: Phase) -> bool:
    """Starts the flight and lets the fault act in its phase; whether it did."""
    serve, vehicle = scene.serve, scene.vehicle
    if not serve.ready.wait(PATIENCE_S):
        raise RuntimeError("the companion did not begin: " + " / ".join(serve.lines[-3:]))
    _wait_for_vehicle(serve)
    if phase is Phase.CONNECT:
        case.act(scene)
        _start(serve)
        _wait(lambda: serve.phase is not None or serve.over, 15.0)
        acted = True
    else:
        _start(serve)
        acted = _wait(lambda: serve.phase is phase or serve.over, PATIENCE_S) and serve.phase is phase
        time.sleep(0.3)
        case.act(scene)
    begin_s = time.monotonic()
    while time.monotonic() - begin_s < PATIENCE_S:
        if serve.over and _calm(vehicle):
            break
        if _calm(vehicle) and time.monotonic() - begin_s > 12.0 and _rests(vehicle, 2.0 * SETTLE_S):
            break
        time.sleep(0.1)
    return acted


def _wait_for_vehicle(serve: Serve) -> None:
    """Until the companion hears its vehicle and has checked the trajectory."""
    with Client(serve.to, PATIENCE_S) as client:
        end_s = time.monotonic() + PATIENCE_S
        while not (client.status(10.0).vehicle and all(t.accepted for t in client.trajectories())):
            if time.monotonic() > end_s:
                raise RuntimeError("the companion does not hear its vehicle: " + " / ".join(serve.lines[-3:]))
            time.sleep(0.2)


def _start(serve: Serve) -> None:
    """Gives the order, from another thread: the client waits for the flight to begin."""

    def order() -> None:
        for _ in range(3):
            try:
                with Client(serve.to, 10.0) as client:
                    client.start("circle")
                return
            except Exception as error:
                serve.lines.append(f"(start: {error})")
                if serve.phase is not None:
                    return

    threading.Thread(target=order, daemon=True).start()


def _wait(condition: Callable[[], bool], seconds: float) -> bool:
    end_s = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end_s:
            return False
        time.sleep(0.01)
    return True


def _calm(vehicle: RealVehicle) -> bool:
    """Whether the vehicle is down and disarmed, or in a mode in which the autopilot holds it."""
    last = vehicle.moments[-1]
    return (last.grounded and not last.armed) or (last.mode is Mode.HOLD and not last.grounded)


def _rests(vehicle: RealVehicle, seconds: float) -> bool:
    """Whether it has been calm for so long, in one mode."""
    count = int(seconds * 100)
    recent = vehicle.moments[-count::20]
    return all(m.mode is recent[0].mode and m.armed == recent[0].armed for m in recent)


def _verdict(scene: Scene, case: RealCase, acted: bool) -> Verdict:
    lines, vehicle = scene.serve.lines, scene.vehicle
    log = "\n".join(lines)
    completed = "landed and disarmed" in log
    says = case.says
    named = completed or not says or any(word in log for word in says)
    last = vehicle.moments[-1]
    if last.grounded and not last.armed and completed:
        cause = "COMPLETED"
    else:
        cause = next((word for word in says if word in log), "COMPLETED" if completed else "ended")
    telling = [line for line in lines if any(word in line for word in (*says, "ending:", "ended", "refused"))]
    sentence = (telling or lines[-1:] or [""])[-1]
    verdict = judged(vehicle.moments, vehicle.vehicle.airframe.impact_speed_m_s, cause, sentence, named=named)
    return verdict if acted else Verdict(False, "not flown", cause, sentence, 0.0, 0.0, ("the phase never came",))


def tidy() -> None:
    """Removes what a run that was killed has left behind."""
    for folder in Path(tempfile.gettempdir()).glob("matrix-real-*"):
        subprocess.run(["umount", "-l", str(folder / "flights")], check=False, stderr=subprocess.DEVNULL)
        shutil.rmtree(folder, ignore_errors=True)
