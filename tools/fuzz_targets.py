"""What is fuzzed: each target takes bytes as they could come from anywhere, and must come back without a fault.

What it may raise is what a caller expects: an error that is explained in one line. Anything else is a finding, as are a
hang and memory that grows. `tools/fuzz.py` runs them for long, tests/unit/test_fuzz.py for a moment.
"""

from __future__ import annotations

import contextlib
import os
import struct
import tempfile
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from companion.config import build_flight, bundled_root, load_flight, load_vehicle, read_toml
from companion.errors import CompanionError, RefusedError
from companion.flight.health import ESTIMATOR_STATUS, SYS_STATUS
from companion.flight.phases import Autopilot
from companion.flight.preflight import ATTITUDE_TARGET, CURRENT_MODE, EXTENDED_SYS_STATE, HOME_POSITION
from companion.flight.reports import BATTERY_STATUS, take_heartbeat, take_report
from companion.flight.retuning import ParameterChange
from companion.frames import FRAMES
from companion.ground.channel import _read as read_datagram
from companion.ground.commands import CommandServer
from companion.ground.examine import Here
from companion.ground.files import FileServer
from companion.ground.ftp import FILE_TRANSFER_PROTOCOL
from companion.ground.messages import COMMAND_INT, targets_of
from companion.ground.parameter_file import load_tuning
from companion.ground.parameters import ParameterServer
from companion.ground.standing import Standing
from companion.ground.store import TrajectoryStore
from companion.ground.trial import AtOnce
from companion.ground.tuning import Tuning
from companion.link import codec, timesync
from companion.link.framing import Frame, FrameParser, LinkCounters, build_frame
from companion.link.key_file import load_key
from companion.link.mission_download import Download, MissionType
from companion.link.operations import Operations
from companion.link.signing import Signer, SigningKey, SigningTimes
from companion.link.signing_times import Place
from companion.link.statustext import StatusTexts
from companion.link.telemetry import Telemetry
from companion.record.flight_source import read_source
from companion.record.tlog import Direction, read_tlog, split_frames
from companion.record.traffic import Traffic
from companion.record.ulog_file import read_seldom, read_ulog
from companion.trajectory.files import Options, shape_of
from companion.trajectory.flatness import PointMass, ReferenceLimits
from companion.trajectory.formats.reading import decoded
from companion.trajectory.load import load
from companion.trajectory.waypoints import PlanLimits
from sim_link import fault_file, vehicle_file
from sim_link.codec import frames as vehicle_frames
from sim_link.fault_keys import FaultError
from sim_link.fault_shell import FaultShell
from sim_link.vehicle import Vehicle, VehicleOptions
from sim_link.vehicle_file import VehicleFileError

Target = Callable[[bytes], None]
DATA = Path(__file__).parents[1] / "tests" / "data" / "fuzz"
"""A folder for each target with inputs that once were findings."""
ANEW = 2_000
"""Inputs after which what has a memory begins anew, so that a finding can be repeated from few of them."""

_FORMATS = codec.message_formats()
_IDS = sorted(_FORMATS)
_FOLDER = Path("/dev/shm") if os.access("/dev/shm", os.W_OK) else Path(tempfile.gettempdir())


@dataclass
class _Surroundings:
    """Stands for everything around a server: requests, trajectories, reports and links."""

    name: str = "udpin:127.0.0.1:14590"
    sent: int = 0
    asked: list[int] = field(default_factory=list)

    def send(self, msgid: int, payload: bytes) -> None:
        build_frame(msgid, payload, 0, 1, 191, _FORMATS[msgid].crc_extra)
        self.sent += 1

    def request(self, number: int, what: str, **content: Any) -> bool:
        self.asked = [*self.asked[-3:], number]
        return True

    def find(self, identity: int) -> tuple[str, str]:
        if identity % 2:
            raise LookupError(f"no trajectory has the id {identity}")
        return "eight.toml", "/nowhere/eight.toml"

    def say(self, severity: object, text: object) -> None:
        self.sent += 1

    def send_message(self, msgid: int, link: object) -> bool:
        return msgid == codec.HEARTBEAT


@contextlib.contextmanager
def _file(name: str, content: bytes) -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir=_FOLDER, prefix="fuzz-") as folder:
        path = Path(folder) / name
        path.write_bytes(content)
        yield path


def _pieces(data: bytes) -> Iterator[bytes]:
    """Several messages out of one input: a byte of length before each."""
    at = 0
    while at < len(data):
        length = data[at]
        yield data[at + 1 : at + 1 + length]
        at += 1 + length


def _message(piece: bytes, ids: list[int]) -> Frame:
    """A message that passed all checks, whatever it holds: the first bytes choose kind and sender."""
    head = piece[:3].ljust(3, b"\0")
    msgid = ids[head[0] % len(ids)]
    system, component = (1, 2, 254, 255)[head[1] & 3], (1, 190, 191, 0)[head[2] & 3]
    payload = piece[3:] or b"\0"
    raw = build_frame(msgid, payload, head[1], system, component, _FORMATS[msgid].crc_extra)
    return Frame(msgid, system, component, head[1], payload.ljust(_FORMATS[msgid].length, b"\0"), raw, 1)


# -- links -----------------------------------------------------------------------------------------------------------


def wire() -> Target:
    """Datagrams and pieces of a serial line, without and with signatures."""
    key = SigningKey(bytes(range(32)))

    def run(data: bytes) -> None:
        frames: list[Frame] = []
        unknown: list[bytes] = []
        counters = LinkCounters()
        FrameParser(_FORMATS, counters).parse(data, 1, frames, unknown)
        used = sum(len(frame.raw) for frame in frames) + sum(map(len, unknown)) + counters.garbage_bytes
        assert used == len(data), "bytes that are neither used nor counted"
        stream = FrameParser(_FORMATS, LinkCounters(), Signer(key, SigningTimes(0, {})))
        rest = b""
        for at in range(0, len(data), 61):
            rest += data[at : at + 61]
            rest = rest[stream.parse(rest, 1, frames, unknown, final=False) :]
        assert len(rest) < 600, "more is kept than two frames"
        rest = rest[stream.settle(rest, 1, frames, unknown) :]
        assert len(rest) < 300, "more is kept than one frame when the line is silent"
        for frame in frames:
            targets_of(frame.msgid, frame.payload)
            codec.decode_cold(frame)

    return run


def messages() -> Target:
    """Everything that the flight reads of the autopilot."""
    ids = [codec.HEARTBEAT, codec.ODOMETRY, codec.TIMESYNC, codec.ATTITUDE_QUATERNION, codec.STATUSTEXT]
    ids += [codec.COMMAND_ACK, codec.PARAM_VALUE, codec.AUTOPILOT_VERSION, CURRENT_MODE, EXTENDED_SYS_STATE]
    ids += [HOME_POSITION, ATTITUDE_TARGET, BATTERY_STATUS, SYS_STATUS, ESTIMATOR_STATUS, 44, 47, 73]

    def begin() -> tuple[Any, ...]:
        sent = _Surroundings()

        def send(msgid: int, payload: bytes) -> bool:
            sent.send(msgid, payload)
            return True

        operations = Operations(send, 1)
        operations.land(0.0)
        operations.request_message(148, 0.0)
        download = Download(send, 1, MissionType.MISSION, 0.0)
        return Telemetry(1), operations, Autopilot(), StatusTexts(), download

    def run(data: bytes) -> None:
        telemetry, operations, autopilot, texts, download = begin()
        for number, piece in enumerate(_pieces(data)):
            frame, now_s = _message(piece, ids), 0.01 * number
            if frame.msgid == codec.ODOMETRY:
                telemetry.on_odometry(frame)
            elif frame.msgid == codec.ATTITUDE_QUATERNION:
                telemetry.on_attitude(frame)
            elif frame.msgid == codec.TIMESYNC:
                message = codec.decode_timesync(frame.payload)
                if timesync.is_request(message, 1, 191):
                    timesync.answer(message, 5, frame.sysid, frame.compid)
            elif frame.msgid == codec.HEARTBEAT:
                take_heartbeat(autopilot, frame)
            elif frame.msgid == codec.STATUSTEXT:
                texts.add(codec.decode_statustext(frame.payload), now_s)
            elif not operations.on_frame(frame, now_s):
                take_report(autopilot, frame)
            download.on_frame(frame, now_s)
            operations.update(now_s)
            texts.update(now_s)

    return run


def ftp() -> Target:
    """Requests of file transfer, several at a time."""

    def accepts(path: Path) -> str:
        if b"bad" in path.read_bytes():
            raise RefusedError(f"{path.name}: asks for too much")
        return "may be flown"

    folder = tempfile.TemporaryDirectory(dir=_FOLDER, prefix="fuzz-ftp-")
    outside = set(_FOLDER.glob("fuzz-escaped*"))
    state: dict[str, Any] = {"left": 0}

    def run(data: bytes) -> None:
        if state["left"] == 0:
            state["left"] = ANEW
            if "server" in state:
                state["server"].close()
            for path in Path(folder.name).iterdir():
                path.unlink()
            state["server"] = FileServer(TrajectoryStore(Path(folder.name), Here(accepts)), lambda *_: None)
            state["now"] = 0.0
        state["left"] -= 1
        server, link = state["server"], _Surroundings()
        for piece in _pieces(data):
            state["now"] += 0.01
            sender = (1, 254, 255)[piece[0] % 3] if piece else 255
            payload = b"\0\1\xbf" + piece[1:]
            server.handle(
                Frame(FILE_TRANSFER_PROTOCOL, sender, 190, 0, payload.ljust(254, b"\0"), b"", 0), link, state["now"]
            )
            server.tick(state["now"])
        assert set(_FOLDER.glob("fuzz-escaped*")) == outside
        assert all(path.is_file() for path in Path(folder.name).iterdir()), "something else than files was made"

    return run


def commands() -> Target:
    """COMMAND_LONG and COMMAND_INT, repeated and while others are under way, and what the control process answers."""
    state: dict[str, Any] = {"left": 0}

    def run(data: bytes) -> None:
        if state["left"] == 0:
            around = _Surroundings()
            state.update(left=ANEW, around=around, server=CommandServer(around, around, around, lambda: 1), now=0.0)
        state["left"] -= 1
        server, around = state["server"], state["around"]
        for piece in _pieces(data):
            state["now"] += 0.05
            server.handle(_message(piece, [codec.COMMAND_LONG, COMMAND_INT]), around, state["now"])
            if around.asked and piece and piece[0] & 64:
                server.on_taken(around.asked[-1], "no" if piece[0] & 32 else "", state["now"])
                server.on_done(around.asked[-1], bool(piece[0] & 16), "over", state["now"])
            server.tick(state["now"])

    return run


def parameters() -> Target:
    """The parameter protocol of ground tools."""
    folder = tempfile.TemporaryDirectory(dir=_FOLDER, prefix="fuzz-parameters-")
    state: dict[str, Any] = {"left": 0}
    base = load_vehicle("bundled")
    ids = [codec.PARAM_REQUEST_READ, 21, 23]

    def run(data: bytes) -> None:
        if state["left"] == 0:
            around = _Surroundings()
            path = Path(folder.name) / "parameters.toml"
            path.unlink(missing_ok=True)
            refuse_odd = AtOnce(lambda old, new: "no" if hash(str(new)) % 2 else "")
            server = ParameterServer(Tuning(base), path, around, around.say, lambda: 1, refuse_odd)
            state.update(left=ANEW, around=around, server=server, now=0.0)
        state["left"] -= 1
        server, around = state["server"], state["around"]
        for piece in _pieces(data):
            state["now"] += 0.05
            server.handle(_message(piece, ids), around, state["now"])
            server.tick(state["now"])
            if around.asked:
                server.on_taken(around.asked[-1], "", state["now"])

    return run


def channel() -> Target:
    """What one process of `serve` gets of the other one."""

    def run(data: bytes) -> None:
        for kind in (b"", b"N", b"C", b"S"):
            item = read_datagram(kind + data)
            if isinstance(item, dict):
                with contextlib.suppress(TypeError, ValueError):
                    Standing.from_note(item)
                with contextlib.suppress(CompanionError):
                    ParameterChange.from_note(item)

    return run


# -- files -----------------------------------------------------------------------------------------------------------

_SUFFIXES = (".csv", ".plan", ".waypoints", ".txt", ".json", "")


def trajectory() -> Target:
    """Other programs' trajectory files, whatever they are called."""
    limits = PlanLimits(ReferenceLimits(5.0, 3.0, 0.5, 2.0, 17.0, 2.0), PointMass(1.0, 0.2))
    frames = [None, *FRAMES]

    def run(data: bytes) -> None:
        first, content = data[:1] or b"\0", data[1:]
        suffix, frame = _SUFFIXES[first[0] % len(_SUFFIXES)], frames[first[0] // 8 % len(frames)]
        with contextlib.suppress(CompanionError):
            made = shape_of(decoded(content, "file"), suffix, Options(frame=frame, limits=limits))
            made.shape.at(0.0)

    return run


def own_trajectory() -> Target:
    """Trajectory files of ours, as they are uploaded."""
    vehicle = load_vehicle("bundled")

    def run(data: bytes) -> None:
        with _file("file.toml", data) as path, contextlib.suppress(CompanionError):
            load(path, vehicle=vehicle, confined=True)

    return run


def configuration() -> Target:
    """Vehicle and flight files, and what is kept of changed parameters."""
    base = load_vehicle("bundled")

    def run(data: bytes) -> None:
        with _file("file.toml", data) as path:
            with contextlib.suppress(CompanionError):
                load_vehicle(str(path))
            with contextlib.suppress(CompanionError):
                load_flight(str(path))
            with contextlib.suppress(CompanionError):
                table = read_toml(path)
                build_flight({"name": "fuzz", "vehicle": "bundled", "trajectory": "circle", **table}, "fuzz")
            with contextlib.suppress(CompanionError):
                load_tuning(path, base)

    return run


def simulator_files() -> Target:
    """Vehicle and fault files of the simulated vehicle."""

    def run(data: bytes) -> None:
        try:
            document = tomllib.loads(data.decode())
        except (ValueError, RecursionError):
            return
        with contextlib.suppress(VehicleFileError):
            vehicle_file.parse(document, "file")
        with contextlib.suppress(FaultError):
            fault_file.parse(document, "file")

    return run


def keys() -> Target:
    """Key files, and the times that are kept for a key."""

    def run(data: bytes) -> None:
        with _file("0.json", data) as path:
            path.chmod(0o600)
            with contextlib.suppress(CompanionError):
                load_key(path)
            place = Place(path.parent)
            try:
                with contextlib.suppress(CompanionError):
                    place.load()
            finally:
                place.release()

    return run


# -- logs ------------------------------------------------------------------------------------------------------------


def ulog() -> Target:
    """ULog files, cut off, damaged or made up."""

    def run(data: bytes) -> None:
        with _file("flight.ulg", data) as path:
            with contextlib.suppress(CompanionError):
                read_ulog(path)
            with contextlib.suppress(CompanionError):
                read_seldom(path, ("vehicle_status",))
            with contextlib.suppress(CompanionError):
                read_source(path)

    return run


def tlog() -> Target:
    """Traffic logs, and traffic on its way into a log."""

    def run(data: bytes) -> None:
        with _file("link.tlog", data) as path:
            entries = list(read_tlog(path))
        traffic = Traffic(lambda *_: lambda *_: None, lambda *_: None, lambda *_: None, 0)
        for number, entry in enumerate(entries):
            traffic.take(entry.direction, split_frames(entry.raw), number)
        for number, piece in enumerate(_pieces(data)):
            raw = _message(piece, _IDS).raw
            traffic.take(Direction.IN if number % 3 else Direction.OUT, split_frames(raw), number)

    return run


# -- the simulated vehicle -------------------------------------------------------------------------------------------


def vehicle() -> Target:
    """Messages to the simulated vehicle, and the console of its faults."""
    options = VehicleOptions(vehicle=vehicle_file.load("paper"), engine="python", start=((0.0, 0.0, -20.0), 0.0))
    state: dict[str, Any] = {"left": 0}

    def run(data: bytes) -> None:
        if state["left"] == 0:
            made = Vehicle(options)
            state.update(left=ANEW, vehicle=made, shell=FaultShell(made.faults, made.system))
        state["left"] -= 1
        made, shell = state["vehicle"], state["shell"]
        for found in vehicle_frames(data):
            made.companion.signing.accepts(found)
        for piece in _pieces(data):
            message = _message(piece, _IDS)
            for found in vehicle_frames(message.raw):
                if found.msg_id == 126:
                    shell.take(found, 1)
                else:
                    made.receive(found, made.companion if len(piece) % 2 else made.ground)
        if state["left"] % 64 == 0:
            made.tick()
        for link in made.links:
            link.outbox.clear()
        made.truth_outbox.clear()

    return run


TARGETS: dict[str, Callable[[], Target]] = {
    "wire": wire,
    "messages": messages,
    "ftp": ftp,
    "commands": commands,
    "parameters": parameters,
    "channel": channel,
    "trajectory": trajectory,
    "own_trajectory": own_trajectory,
    "configuration": configuration,
    "simulator_files": simulator_files,
    "keys": keys,
    "ulog": ulog,
    "tlog": tlog,
    "vehicle": vehicle,
}


def seeds(name: str) -> list[bytes]:
    """Good inputs to begin with, and those that were findings."""
    found = [path.read_bytes() for path in sorted((DATA / name).glob("*"))] if (DATA / name).is_dir() else []
    if name in {"wire", "tlog", "vehicle"}:
        beat = build_frame(0, codec.encode_heartbeat(2, 12), 0, 1, 1, _FORMATS[0].crc_extra)
        signer = Signer(SigningKey(bytes(range(32))), SigningTimes(0, {}))
        signed = build_frame(0, codec.encode_heartbeat(2, 12), 0, 1, 1, _FORMATS[0].crc_extra, signer)
        found += [beat, signed, beat + signed, struct.pack(">Q", 8) + beat]
    if name in {"own_trajectory"}:
        found += [path.read_bytes() for path in sorted((bundled_root() / "trajectories").glob("*.toml"))]
    if name in {"configuration", "simulator_files"}:
        for folder in ("vehicles", "flights", "faults"):
            found += [path.read_bytes() for path in sorted((bundled_root() / folder).glob("*.toml"))]
    if name == "trajectory":
        for path in sorted((DATA.parent / "trajectories").rglob("*")):
            if path.is_file() and path.stat().st_size < 20_000:
                number = _SUFFIXES.index(path.suffix) if path.suffix in _SUFFIXES else len(_SUFFIXES) - 1
                found.append(bytes((number,)) + path.read_bytes())
    if name == "channel":
        found += [b'{"request": 1, "what": "start"}', b'{"standing": {"phase": "track"}}']
    if name == "keys":
        found += [bytes(range(32)), b"00" * 31 + b"01\n"]
        found.append(b'{"newest": 1, "reserved": 2, "ended": true, "link_id": 3, "streams": {"65793": 1}}')
    return found
