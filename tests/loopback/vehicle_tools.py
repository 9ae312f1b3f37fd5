"""A plain companion for tests of the simulated vehicle: pymavlink, one UDP socket, lockstep."""

from __future__ import annotations

import math
import socket
import struct
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import replace

from pymavlink.dialects.v20 import development as mavlink
from pymavlink.generator.mavcrc import x25crc

from sim_link.peer import Peer, PeerOptions
from sim_link.vehicle import Vehicle, VehicleOptions
from sim_link.vehicle_file import VehicleFile, load

OFFBOARD = 6 << 16
HOLD = 4 << 16 | 3 << 24
TAKEOFF = 4 << 16 | 2 << 24
RETURN = 4 << 16 | 5 << 24
LAND = 4 << 16 | 6 << 24
TERMINATION = 10 << 16
IN_AIR = ((0.0, 0.0, -20.0), 0.0)
RATES = 128
ATTITUDE = 7
LEVEL = (1.0, 0.0, 0.0, 0.0)
ZERO = (0.0, 0.0, 0.0)


def vehicle_file(state_rate_hz: float = 50.0, state_age_s: float = 0.0, **changes) -> VehicleFile:
    """The paper's vehicle with few states a second, so that tests are quick, and without noise."""
    quiet = {f"noise_{name}": 0.0 for name in ("position_m", "velocity_m_s", "attitude_rad", "rate_rad_s")}
    return replace(load("paper"), state_rate_hz=state_rate_hz, state_age_s=state_age_s, **(quiet | changes))


def free_socket() -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(("127.0.0.1", 0))
    sock.settimeout(5.0)
    return sock


def framed(msg_id: int, payload: bytes, crc_extra: int, mav) -> bytes:
    """Frame a payload by hand."""
    numbers = (len(payload), 0, 0, mav.seq, mav.srcSystem, mav.srcComponent, msg_id & 0xFFFF, msg_id >> 16)
    head = struct.pack("<BBBBBBHB", *numbers)
    return b"\xfd" + head + payload + struct.pack("<H", x25crc(head + payload + bytes((crc_extra,))).crc)


class Companion:
    """Answers the vehicle's clock, and sends what a test wants before each answer."""

    def __init__(self, sock: socket.socket, port: int, system: int = 1) -> None:
        self.sock = sock
        self.vehicle = ("127.0.0.1", port)
        self.mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=191)
        self.target = 1
        self.last: dict[str, object] = {}
        self.log: list[object] = []
        self.waiting: deque[bytes] = deque()
        self.raw: list[bytes] = []
        self.bad_frames = False
        """Whether frames may be broken on their way."""
        self.t_us = 0
        self.each: Callable[[], None] | None = None
        self.send(self.heartbeat())

    def heartbeat(self):
        return mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_ONBOARD_CONTROLLER, 8, 0, 0, 4, 3)

    def send(self, message) -> None:
        self.sock.sendto(message.pack(self.mav), self.vehicle)
        self.mav.seq = (self.mav.seq + 1) % 256

    def receive(self):
        """One message from the vehicle, kept in `last` and `log`."""
        if not self.waiting:
            data = self.sock.recv(2048)
            while data:  # in lockstep several frames come in one datagram
                length = data[1] + (8 if data[0] == 0xFE else 12) if len(data) > 1 else 1
                self.waiting.append(data[:length])
                data = data[length:]
        raw = self.waiting.popleft()
        self.raw.append(raw)
        try:
            message = self.mav.decode(bytearray(raw))
        except mavlink.MAVError:
            if not self.bad_frames:
                raise
            return mavlink.MAVLink_bad_data(raw, "broken on its way")
        self.last[message.get_type()] = message
        self.log.append(message)
        return message

    def step(self) -> None:
        """Let the vehicle go on by one state."""
        while True:
            message = self.receive()
            if message.get_type() == "TIMESYNC" and message.tc1 == 0:
                break
        self.t_us = message.ts1 // 1000
        if self.each is not None:
            self.each()
        self.send(mavlink.MAVLink_timesync_message(message.ts1 + 1, message.ts1))

    def run(self, seconds: float) -> None:
        end = self.t_us + round(seconds * 1e6)
        while self.t_us < end:
            self.step()

    def until(self, predicate: Callable[[], bool], seconds: float = 30.0) -> float:
        """Go on until something is so; gives how long that took [s of the vehicle]."""
        begin = self.t_us
        while not predicate():
            assert self.t_us - begin < seconds * 1e6, f"not within {seconds} s; texts: {self.texts()}"
            self.step()
        return (self.t_us - begin) * 1e-6

    def of_type(self, name: str) -> list:
        return [m for m in self.log if m.get_type() == name]

    def texts(self) -> list[str]:
        return [m.text for m in self.of_type("STATUSTEXT")]

    def count(self, name: str, seconds: float) -> int:
        """How many messages of a type come in a time."""
        self.log.clear()
        self.run(seconds)
        return len(self.of_type(name))

    # Requests

    def command(self, number: int, *params: float, target=None) -> int | None:
        """Send a COMMAND_LONG; gives the result acknowledged, None when there is no answer within 0.2 s."""
        values = (*params, *(0.0,) * (7 - len(params)))
        target = target or (self.target, 1)
        self.send(mavlink.MAVLink_command_long_message(*target, number, 0, *values))
        return self.acknowledged(number)

    def acknowledged(self, number: int) -> int | None:
        self.last.pop("COMMAND_ACK", None)
        end = self.t_us + 200_000
        while self.t_us < end:
            self.step()
            ack = self.last.get("COMMAND_ACK")
            if ack is not None and ack.command == number:
                return ack.result
        return None

    def set_mode(self, custom_mode: int) -> int | None:
        main, sub = custom_mode >> 16 & 0xFF, custom_mode >> 24
        return self.command(mavlink.MAV_CMD_DO_SET_MODE, 1, main, sub)

    def arm(self) -> int | None:
        return self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)

    def interval(self, name: str, interval_us: float, *more: float) -> int | None:
        number = getattr(mavlink, f"MAVLINK_MSG_ID_{name}")
        return self.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, number, interval_us, *more)

    def request(self, name: str) -> int | None:
        return self.command(mavlink.MAV_CMD_REQUEST_MESSAGE, getattr(mavlink, f"MAVLINK_MSG_ID_{name}"))

    def set_param(self, name: str, value: float) -> None:
        """Set a parameter bytewise: a float as REAL32, an int as INT32; waits for the echo."""
        whole = isinstance(value, int)
        field = struct.unpack("<f", struct.pack("<i", value))[0] if whole else value
        self.last.pop("PARAM_VALUE", None)
        self.send(mavlink.MAVLink_param_set_message(1, 1, name.encode(), field, 6 if whole else 9))
        self.until(lambda: "PARAM_VALUE" in self.last, 1.0)
        assert self.last["PARAM_VALUE"].param_id == name

    def attitude_target(self, mask: int, *, q=LEVEL, rates=ZERO, thrust=0.49, body=ZERO, target=(1, 1)) -> None:
        message = mavlink.MAVLink_set_attitude_target_message(0, *target, mask, q, *rates, thrust)
        if body == ZERO:
            self.send(message)
        else:  # thrust_body is an extension that pymavlink does not know
            payload = message.unpacker.pack(0, *q, *rates, thrust, *target, mask) + struct.pack("<3f", *body)
            self.sock.sendto(framed(82, payload, message.crc_extra, self.mav), self.vehicle)

    def stream(self, mask: int = RATES, **fields) -> None:
        """Send a setpoint with every state from now on."""
        self.each = lambda: self.attitude_target(mask, **fields)

    def silence(self) -> None:
        self.each = None

    # What the vehicle does

    @property
    def mode(self) -> int:
        return self.last["CURRENT_MODE"].custom_mode

    @property
    def intended(self) -> int:
        return self.last["CURRENT_MODE"].intended_custom_mode

    @property
    def armed(self) -> bool:
        return bool(self.last["HEARTBEAT"].base_mode & 128)

    @property
    def position(self) -> tuple[float, float, float]:
        m = self.last["ODOMETRY"]
        return m.x, m.y, m.z

    @property
    def rates(self) -> tuple[float, float, float]:
        m = self.last["ODOMETRY"]
        return m.rollspeed, m.pitchspeed, m.yawspeed

    @property
    def tilt(self) -> float:
        """Angle between body z and down [rad]."""
        _, x, y, _ = self.last["ODOMETRY"].q
        return math.acos(max(-1.0, min(1.0, 1.0 - 2.0 * (x * x + y * y))))

    def enter_offboard(self, mask: int = RATES, **fields) -> None:
        """From Hold in the air to OFFBOARD with a stream."""
        self.stream(mask, **fields)
        self.step()
        self.step()
        assert self.set_mode(OFFBOARD) == 0
        self.until(lambda: self.mode == OFFBOARD, 1.0)


class Flight:
    """A vehicle in a thread of its own, on free ports, in lockstep; `with` gives its companion."""

    def __init__(self, *, file: VehicleFile | None = None, parameters=None, ground: bool = False, **options) -> None:
        self.sock = free_socket()
        options.setdefault("engine", "auto")
        self.vehicle = Vehicle(VehicleOptions(vehicle=file or vehicle_file(), parameters=parameters or {}, **options))
        self._stopping = False
        self.ground_sock = free_socket() if ground else None
        peer_options = PeerOptions(
            port=0,
            remote_port=self.sock.getsockname()[1],
            ground_port=0 if ground else None,
            ground_remote_port=self.ground_sock.getsockname()[1] if self.ground_sock else 0,
            lockstep=True,
        )
        self.peer = Peer(self.vehicle, peer_options, stopped=lambda: self._stopping)
        self.failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _run(self) -> None:
        try:
            self.peer.run()
        except BaseException as error:
            self.failure = error

    def __enter__(self) -> Companion:
        self._thread.start()
        companion = Companion(self.sock, self.peer.companion.port)
        companion.target = self.vehicle.system
        companion.step()
        # The whole state and both modes with every state: what the tests look at.
        assert companion.interval("ODOMETRY", 1) == 0
        assert companion.interval("CURRENT_MODE", 1) == 0
        assert companion.interval("EXTENDED_SYS_STATE", 1) == 0
        companion.until(lambda: {"HEARTBEAT", "ODOMETRY", "CURRENT_MODE"} <= companion.last.keys(), 2.0)
        return companion

    def __exit__(self, *exc) -> None:
        self._stopping = True
        self._thread.join(5.0)
        self.peer.close()
        self.sock.close()
        if self.ground_sock is not None:
            self.ground_sock.close()
        assert not self._thread.is_alive()
        if self.failure is not None and exc[0] is None:
            raise self.failure
