"""The vehicle link over real sockets on loopback and over a pseudo-terminal."""

import contextlib
import errno
import fcntl
import hashlib
import os
import pty
import socket
import termios
import time
from typing import ClassVar

import pytest

from companion.errors import InputError, LinkError
from companion.flight.bundled import free_udp_port
from companion.ground.links import GroundPort
from companion.link import codec
from companion.link.framing import Frame, FrameParser, LinkCounters, build_frame
from companion.link.transport import UdpTransport, parse_connection, port_holder
from companion.link.wire import TAP_IN, TAP_OUT, Wire

FORMATS = codec.message_formats()
STATES = frozenset((codec.ODOMETRY, codec.ATTITUDE_QUATERNION))


def heartbeat(seq: int, system: int = 1) -> bytes:
    return build_frame(0, codec.encode_heartbeat(2, 12), seq, system, 1, FORMATS[0].crc_extra)


def odometry(seq: int, t_us: int) -> bytes:
    payload = t_us.to_bytes(8, "little") + bytes(225)
    return build_frame(331, payload, seq, 1, 1, FORMATS[331].crc_extra)


def attitude(seq: int) -> bytes:
    return build_frame(31, bytes((1, *bytes(31))), seq, 1, 1, FORMATS[31].crc_extra)


def udp_socket() -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(("127.0.0.1", 0))
    sock.settimeout(2.0)
    return sock


@contextlib.contextmanager
def listening(**options):
    """A wire that waits, and where to send to."""
    port = free_udp_port()
    with Wire.open(f"udpin:127.0.0.1:{port}", **options) as wire:
        yield wire, ("127.0.0.1", port)


def test_what_is_behind_the_newest_state_waits_for_the_next_call():
    taps = []
    with (
        listening(tap=lambda *entry: taps.append(entry)) as (wire, there),
        udp_socket() as vehicle,
        udp_socket() as other,
    ):
        vehicle.sendto(heartbeat(0), there)
        assert len(wire.receive(2.0)) == 1
        for raw in (heartbeat(1), odometry(2, 1000), heartbeat(3), attitude(4), heartbeat(5), heartbeat(6)):
            vehicle.sendto(raw, there)
        other.sendto(odometry(9, 9000), there)  # of somebody else: nobody hurries for it
        first = wire.receive(2.0, until=STATES)
        assert [frame.seq for frame in first] == [1, 2, 3, 4]
        rest = wire.receive(60.0, until=STATES)  # at once: a minute is longer than a test may take
        assert [frame.seq for frame in rest] == [5, 6]
        assert wire.receive(0.0, until=STATES) == []
        assert wire.counters.foreign_address == 1
        assert wire.counters.lost == {(1, 1): 0}
        vehicle.sendto(odometry(7, 3000), there)
        vehicle.sendto(heartbeat(8), there)
        assert [frame.seq for frame in wire.receive(2.0)] == [7, 8]  # who does not ask for it gets all
        for raw in (b"", odometry(9, 4000), b"", heartbeat(10)):  # an empty datagram is one, too
            vehicle.sendto(raw, there)
        assert [frame.seq for frame in wire.receive(2.0, until=STATES)] == [9]
    # what was not used when the link was closed is in the log all the same
    assert [entry[1][4] for entry in taps] == list(range(11))


def collect(wire: Wire, count: int) -> list[Frame]:
    """Receive until this many frames have come, or two seconds are over."""
    frames: list[Frame] = []
    end_s = time.monotonic() + 2.0
    while len(frames) < count and time.monotonic() < end_s:
        frames += wire.receive(0.05)
    return frames


# ---- receiving ----


def test_nothing_comes():
    with listening() as (wire, _):
        assert wire.receive(0.01) == []
        assert wire.receive(0.0) == []
        assert wire.receive(-1.0) == []


def test_one_call_drains_everything_in_order():
    with listening() as (wire, address), udp_socket() as vehicle:
        for seq in range(50):
            vehicle.sendto(heartbeat(2 * seq) + heartbeat(2 * seq + 1), address)
        before_ns = time.monotonic_ns()
        frames = wire.receive(1.0)
        assert [frame.seq for frame in frames] == list(range(100))
        assert wire.counters.received == 100
        assert wire.counters.lost == {(1, 1): 0}
        stamps = [frame.arrival_wall_ns for frame in frames]
        assert stamps == sorted(stamps)
        assert before_ns <= stamps[0]
        assert stamps[-1] <= time.monotonic_ns()
        assert wire.receive(0.0) == []


def test_one_call_is_bounded():
    with listening() as (wire, address), udp_socket() as vehicle:
        for seq in range(300):
            vehicle.sendto(heartbeat(seq & 0xFF), address)
        first = wire.receive(1.0)
        assert len(first) == 256
        assert len(wire.receive(1.0)) == 44


def test_the_state_is_read_whole():
    with listening() as (wire, address), udp_socket() as vehicle:
        vehicle.sendto(odometry(1, 0x0102030405060708), address)
        (frame,) = collect(wire, 1)
        assert (frame.msgid, frame.sysid, frame.compid) == (331, 1, 1)
        assert len(frame.payload) == 233
        assert codec.decode_odometry(frame.payload).time_usec == 0x0102030405060708


def test_losses_are_counted():
    with listening() as (wire, address), udp_socket() as vehicle:
        for seq in (10, 11, 15, 16, 18):
            vehicle.sendto(heartbeat(seq), address)
        assert len(collect(wire, 5)) == 5
        assert wire.counters.lost == {(1, 1): 4}


def test_garbage_is_counted_and_harmless():
    with listening() as (wire, address), udp_socket() as vehicle:
        broken = bytearray(heartbeat(1))
        broken[12] ^= 0xFF
        for datagram in (b"", b"hello", b"\xfd", b"\xfd" * 300, bytes(range(200)), bytes(broken)):
            vehicle.sendto(datagram, address)
        vehicle.sendto(b"noise" + heartbeat(2), address)
        frames = collect(wire, 1)
        assert [frame.seq for frame in frames] == [2]
        assert wire.counters.bad_crc >= 1
        assert wire.counters.garbage_bytes > 300


# ---- peers ----


def test_the_first_valid_frame_decides_who_the_peer_is():
    with listening() as (wire, address), udp_socket() as stranger, udp_socket() as vehicle, udp_socket() as other:
        stranger.sendto(b"not MAVLink", address)
        wire.receive(0.5)
        assert wire.peer is None
        assert not wire.send(0, codec.encode_heartbeat())
        assert wire.counters.send_dropped == 1
        vehicle.sendto(heartbeat(1), address)
        assert len(collect(wire, 1)) == 1
        assert wire.peer == vehicle.getsockname()
        other.sendto(heartbeat(77, system=9), address)
        assert wire.receive(0.5) == []
        assert wire.counters.foreign_address == 1
        assert wire.last_foreign == other.getsockname()
        assert (9, 1) not in wire.counters.lost
        assert wire.send(0, codec.encode_heartbeat())
        assert vehicle.recv(300)[0] == 0xFD
        other.setblocking(False)
        with pytest.raises(BlockingIOError):
            other.recv(300)


def test_a_peer_can_be_released():
    with listening() as (wire, address), udp_socket() as first, udp_socket() as second:
        first.sendto(heartbeat(1), address)
        collect(wire, 1)
        wire.release_peer()
        second.sendto(heartbeat(1, system=2), address)
        assert [frame.sysid for frame in collect(wire, 1)] == [2]
        assert wire.peer == second.getsockname()


def test_udpout_speaks_first_and_hears_the_answer():
    with udp_socket() as vehicle:
        host, port = vehicle.getsockname()
        with Wire.open(f"udpout:{host}:{port}", system_id=7, component_id=191) as wire:
            assert wire.peer == (host, port)
            assert wire.send(0, codec.encode_heartbeat())
            data, address = vehicle.recvfrom(300)
            assert (data[5], data[6]) == (7, 191)
            vehicle.sendto(heartbeat(3), address)
            assert [frame.seq for frame in collect(wire, 1)] == [3]
            wire.release_peer()
            assert wire.peer == (host, port)


def test_udpout_survives_that_nobody_listens():
    # An address of its own: on the usual one somebody else's vehicle may be given the port meanwhile, and answers.
    host, port = "127.0.0.9", free_udp_port()
    with Wire.open(f"udpout:{host}:{port}") as wire:
        for _ in range(5):
            wire.send(0, codec.encode_heartbeat())
            assert wire.receive(0.02) == []
        assert wire.counters.unreachable > 0
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:
            vehicle.bind((host, port))
            vehicle.settimeout(2.0)
            assert wire.send(0, codec.encode_heartbeat())
            _, address = vehicle.recvfrom(300)
            vehicle.sendto(heartbeat(1), address)
            assert len(collect(wire, 1)) == 1


def test_udpin_survives_that_the_vehicle_goes():
    with listening() as (wire, address):
        with udp_socket() as vehicle:
            vehicle.sendto(heartbeat(1), address)
            collect(wire, 1)
        for _ in range(5):
            wire.send(0, codec.encode_heartbeat())
            assert wire.receive(0.01) == []


class Unreachable:
    """A transport whose network is down, with one datagram that had come before."""

    stream = False
    fixed_peer = ("127.0.0.1", 9)

    def __init__(self):
        self._reading, self._writing = os.pipe()
        os.write(self._writing, b"x")
        self._answers = [OSError(errno.EHOSTUNREACH, "no route"), (heartbeat(1), self.fixed_peer), None]

    def fileno(self):
        return self._reading

    def read(self):
        answer = self._answers.pop(0)
        if isinstance(answer, OSError):
            raise answer
        return answer

    def write(self, data, to):
        raise OSError(errno.ENETDOWN, "network is down")

    def close(self):
        os.close(self._reading)
        os.close(self._writing)


def test_a_network_that_is_down_ends_nothing():
    with Wire(Unreachable()) as wire:
        assert [frame.seq for frame in wire.receive(0.1)] == [1]
        assert not wire.send(0, codec.encode_heartbeat())
        assert wire.counters.unreachable == 3
        assert wire.counters.send_dropped == 1


# ---- sending ----


def test_what_is_sent_is_framed():
    with listening(system_id=4, component_id=191) as (wire, address), udp_socket() as vehicle:
        vehicle.sendto(heartbeat(1), address)
        collect(wire, 1)
        wire.system_id = 1  # learned from the vehicle
        library = codec.dialect()
        payload = codec.encode_set_attitude_target(5, 1, 1, 128, (1.0, 0.0, 0.0, 0.0), (0.1, 0.2, 0.3), 0.5)
        for seq in range(300):
            assert wire.send(82, payload)
            raw = vehicle.recv(300)
            message = library.MAVLink(None).decode(bytearray(raw))
            assert (message.get_type(), message.get_seq()) == ("SET_ATTITUDE_TARGET", seq & 0xFF)
            assert (message.get_srcSystem(), message.get_srcComponent()) == (1, 191)
        assert wire.counters.sent == 300
        assert wire.send(111, codec.encode_timesync(5, 6))
        assert len(vehicle.recv(300)) == 12 + 9  # the trailing zeros are left out


def test_a_message_that_does_not_exist_is_a_fault_of_the_caller():
    with listening() as (wire, _), pytest.raises(ValueError, match="40000"):
        wire.send(40000, b"")


def test_sending_never_blocks():
    """Nobody reads at the other end, and its buffer is small."""
    with udp_socket() as vehicle:
        vehicle.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        host, port = vehicle.getsockname()
        with Wire.open(f"udpout:{host}:{port}") as wire:
            for _ in range(2000):
                wire.send(0, codec.encode_heartbeat())
            assert wire.counters.sent + wire.counters.send_dropped == 2000


class ChecksumGuard:
    """A stand-in for signing."""

    outdated = 0
    refusals: ClassVar[dict[str, int]] = {}

    def sign(self, unsigned: bytes) -> bytes:
        return hashlib.sha256(unsigned).digest()[:13]

    def verify(self, raw: bytes, msgid: int, signed: bool) -> bool:
        return signed and self.sign(raw[:-13]) == raw[-13:]


def test_a_guarded_link_hears_and_speaks_signed_frames_only():
    guard = ChecksumGuard()
    with listening(guard=guard) as (wire, address), udp_socket() as vehicle, udp_socket() as stranger:
        stranger.sendto(heartbeat(1), address)
        assert wire.receive(0.5) == []
        assert wire.counters.bad_signature == 1
        assert wire.peer is None  # who cannot sign does not become the peer
        signed = build_frame(0, codec.encode_heartbeat(2, 12), 5, 1, 1, FORMATS[0].crc_extra, guard)
        vehicle.sendto(signed, address)
        assert [frame.seq for frame in collect(wire, 1)] == [5]
        assert wire.send(0, codec.encode_heartbeat())
        raw = vehicle.recv(300)
        assert raw[2] == 1
        assert guard.verify(raw, 0, True)


def test_the_tap_sees_both_directions():
    seen: list[tuple[int, bytes, int]] = []
    with listening(tap=lambda *entry: seen.append(entry)) as (wire, address), udp_socket() as vehicle:
        stranger = build_frame(40000, b"unknown", 3, 1, 1, 9)
        vehicle.sendto(heartbeat(1) + b"garbage" + heartbeat(2) + stranger, address)
        frames = collect(wire, 2)
        wire.send(0, codec.encode_heartbeat())
        sent = vehicle.recv(300)
        assert seen == []  # nobody's answer waits for the log
        wire.tell()
        assert [(direction, raw) for direction, raw, _ in seen] == [
            (TAP_IN, heartbeat(1)),
            (TAP_IN, heartbeat(2)),
            (TAP_IN, stranger),
            (TAP_OUT, sent),
        ]
        assert seen[0][2] == frames[0].arrival_wall_ns
        assert [stamp for *_, stamp in seen] == sorted(stamp for *_, stamp in seen)


def test_what_the_tap_was_not_told_it_is_told_at_the_next_look_and_at_the_end():
    seen: list[tuple[int, bytes, int]] = []
    with listening(tap=lambda *entry: seen.append(entry)) as (wire, address), udp_socket() as vehicle:
        vehicle.sendto(heartbeat(1), address)
        collect(wire, 1)
        wire.receive(0.0)
        assert [direction for direction, *_ in seen] == [TAP_IN]
        wire.send(0, codec.encode_heartbeat())
    assert [direction for direction, *_ in seen] == [TAP_IN, TAP_OUT]


# ---- opening ----


@pytest.mark.parametrize(
    ("connection", "says"),
    [
        ("", "udpin:127.0.0.1:14540"),
        ("14540", "udpin:127.0.0.1:14540"),
        ("tcp:127.0.0.1:5760", "udpout"),
        ("udpin:14540", "udpin:127.0.0.1:14540"),
        ("udpin:127.0.0.1", "udpin:127.0.0.1:14540"),
        ("udpin:127.0.0.1:", "is no port"),
        ("udpin:127.0.0.1:1e4", "is no port"),
        ("udpin:127.0.0.1:0", "1..65535"),
        ("udpin:127.0.0.1:65536", "1..65535"),
        ("udpin:127.0.0.1:\u0661\u0662", "is no port"),
        ("udpin:192.0.2.1:14540", "no address 192.0.2.1"),
        ("udpin:vehicle..lan:14540", "no IPv4 address"),
        ("serial:/dev/ttyAMA0", "serial:/dev/ttyAMA0:921600"),
        ("serial:/dev/ttyAMA0:fast", "is no baud rate"),
        ("serial:/dev/ttyAMA0:12345", "921600"),
        ("serial:/dev/no-such-line:921600", "no such serial device"),
        ("serial:/dev/null:921600", "not a serial device"),
    ],
)
def test_wrong_connections_are_explained(connection, says):
    with pytest.raises(InputError) as caught:
        Wire.open(connection)
    message = str(caught.value)
    assert says in message
    assert "\n" not in message


def test_connection_strings():
    assert parse_connection("udpin:0.0.0.0:14540") == ("udpin", "0.0.0.0", 14540)
    by_path = "/dev/serial/by-path/pci-0000:00:14.0-usb-0:1:1.0-port0"
    assert parse_connection(f"serial:{by_path}:57600") == ("serial", by_path, 57600)


def test_a_port_in_use_says_who_has_it():
    with udp_socket() as holder:
        port = holder.getsockname()[1]
        with pytest.raises(LinkError) as caught:
            Wire.open(f"udpin:127.0.0.1:{port}")
        message = str(caught.value)
        assert str(port) in message
        assert f"process {os.getpid()} (" in message
        assert "mavlink-router" in message
        assert "\n" not in message


def test_a_port_that_is_unused_has_no_holder():
    assert port_holder(free_udp_port()) is None


def test_a_closed_port_can_be_had_again():
    port = free_udp_port()
    for _ in range(3):
        Wire.open(f"udpin:127.0.0.1:{port}").close()
    transport = UdpTransport("127.0.0.1", port, listen=True)
    assert transport.local_address == ("127.0.0.1", port)
    transport.close()


# ---- serial ----


@contextlib.contextmanager
def line():
    """The autopilot's end of a pseudo-terminal and the wire at the other."""
    master, slave = pty.openpty()
    path = os.ttyname(slave)
    os.close(slave)
    try:
        with Wire.open(f"serial:{path}:921600") as wire:
            yield master, wire
    finally:
        with contextlib.suppress(OSError):
            os.close(master)


def test_a_line_carries_every_byte_both_ways():
    with line() as (master, wire):
        payload = bytes(range(1, 256))[:233]  # control characters, newlines and all
        os.write(master, build_frame(331, payload, 5, 1, 1, FORMATS[331].crc_extra))
        (frame,) = collect(wire, 1)
        assert frame.payload == payload
        assert wire.send(76, bytes(range(1, 34)))
        raw = os.read(master, 300)
        assert raw[10:43] == bytes(range(1, 34))
        assert raw == build_frame(76, bytes(range(1, 34)), 0, 1, 191, FORMATS[76].crc_extra)


@pytest.mark.parametrize("noise", [b"\xfd\xff\x00", b"\xfe\xff"])
def test_on_a_quiet_line_noise_holds_nothing_back(noise):
    with line() as (master, wire):
        os.write(master, noise + heartbeat(1) + heartbeat(2))
        begun_s = time.monotonic()
        frames = wire.receive(0.0) or wire.receive(1.5) or wire.receive(1.5)
        assert [frame.seq for frame in frames] == [1, 2]
        assert time.monotonic() - begun_s < 1.0
        assert wire.counters.garbage_bytes == len(noise)
        assert wire.receive(0.0) == []
        os.write(master, heartbeat(3))
        assert [frame.seq for frame in collect(wire, 1)] == [3]


def test_a_ground_line_delivers_what_noise_holds_back():
    master, slave = pty.openpty()
    with contextlib.ExitStack() as stack:
        stack.callback(os.close, master)
        port = GroundPort(f"serial:{os.ttyname(slave)}:57600", lambda: 1)
        port.open()
        stack.callback(port.close)
        os.close(slave)
        os.write(master, b"\xfd\xff\x00" + heartbeat(1, system=255) + heartbeat(2, system=255))
        found = []
        end_s = time.monotonic() + 2.0
        while not found and time.monotonic() < end_s:
            found = port.receive()
            time.sleep(0.01)
        assert [frame.seq for frame, _ in found] == [1, 2]


def test_frames_may_come_in_pieces():
    with line() as (master, wire):
        stream = b"boot noise\xfd" + b"".join(odometry(seq, 1000 + seq) for seq in range(6))
        frames: list[Frame] = []
        for at in range(0, len(stream), 7):
            os.write(master, stream[at : at + 7])
            frames += wire.receive(0.2)
        frames += wire.receive(0.05)
        assert [frame.seq for frame in frames] == list(range(6))
        assert wire.counters.garbage_bytes == len(b"boot noise\xfd")


def test_a_line_that_is_not_read_drops_whole_frames():
    with line() as (master, wire):
        for _ in range(5000):
            wire.send(82, bytes(range(1, 40)))
        assert wire.counters.send_dropped > 0
        fcntl.fcntl(master, fcntl.F_SETFL, os.O_NONBLOCK)
        received = b""
        end_s = time.monotonic() + 0.5
        while time.monotonic() < end_s:
            with contextlib.suppress(BlockingIOError):
                received += os.read(master, 65536)
                wire.send(0, codec.encode_heartbeat())  # lets the rest of a frame go
        counters = LinkCounters()
        frames: list[Frame] = []
        FrameParser(FORMATS, counters).parse(received, 0, frames, [], final=False)
        assert len(frames) > 10
        assert counters.garbage_bytes == 0
        assert counters.bad_crc == 0


def test_a_line_belongs_to_one_program():
    with line() as (_, wire):
        path = os.ttyname(wire.fileno())
        with pytest.raises(LinkError, match="another program has it open"):
            Wire.open(f"serial:{path}:921600")


def test_a_line_that_is_pulled_out_is_an_error():
    with line() as (master, wire):
        os.close(master)
        assert not wire.send(0, codec.encode_heartbeat())
        with pytest.raises(LinkError, match="plugged in"):
            wire.receive(0.5)


def test_a_line_is_raw():
    with line() as (_, wire):
        input_flags, output_flags, control_flags, local_flags, speed, _, _ = termios.tcgetattr(wire.fileno())
        assert (input_flags, output_flags, local_flags) == (0, 0, 0)
        assert control_flags & termios.CSIZE == termios.CS8
        assert speed == termios.B921600
