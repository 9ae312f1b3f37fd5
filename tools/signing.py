"""What signing keeps out, and what it costs:

    python tools/signing.py                      100,000 messages that must not be used, and the times
    python tools/signing.py --messages 5000

Messages go through UDP sockets of this machine to a vehicle link with what listens to it between flights, to a ground
link and, without a socket, to the bundled vehicle. Between them come good ones, of which every one must be used. Exit
code 1: a bad one was used, or a good one was not.
"""

from __future__ import annotations

import argparse
import os
import random
import socket
import statistics
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

from companion.flight.bundled import free_udp_port
from companion.ground.links import GroundPort
from companion.ground.standby import Standby
from companion.link import codec
from companion.link.framing import MAGIC_V2, Frame, FrameGuard, FrameParser, LinkCounters, build_frame
from companion.link.key_file import new_key
from companion.link.signing import NEW_STREAM_LATE, Signer, SigningKey, SigningTimes, time_now
from companion.link.signing_times import open_signer
from companion.link.wire import Wire
from sim_link.codec import frames as vehicle_frames
from sim_link.signing import UNSIGNED, Keyring, LinkSigning

FORMATS = codec.message_formats()
EVERY = 50
"""Of so many messages one is good."""
ARMED = 0x80
GROUND_SYSTEMS = frozenset({254})
COMMAND = codec.COMMAND_LONG


class Tally(NamedTuple):
    """What became of the messages of one receiver."""

    tried: Counter[str]
    """Bad ones, by kind."""
    used: Counter[str]
    good: int
    good_used: int


class Forger:
    """Makes messages that must not be used, for a receiver of a key.

    Args:
        key: the receiver's.
        system: whom the good sender is.
        component: the same.
        msgid, payload: what the bad messages say.
        chance: of everything random.
        others: systems that have no say there; none: all have.
    """

    def __init__(
        self,
        key: SigningKey,
        system: int,
        component: int,
        msgid: int,
        payload: bytes,
        chance: random.Random,
        others: tuple[int, ...],
    ) -> None:
        self.system, self.component, self.msgid, self.payload = system, component, msgid, payload
        self.recorded: list[bytes] = []
        """Good ones, as they were sent."""
        self._key, self._chance, self._others = key, chance, others
        self._thief = Signer(SigningKey(chance.randbytes(32)), SigningTimes(time_now(), {}))
        self._ahead = Signer(key, SigningTimes(time_now(), {}, link_id=200))
        self.kinds: dict[str, Callable[[], bytes]] = {
            "unsigned": lambda: self.made(None),
            "unsigned, MAVLink 1": self._version_1,
            "signed with another key": lambda: self.made(self._thief),
            "signature changed": lambda: self._changed(range(-6, 0)),
            "time or link id changed": lambda: self._changed(range(-13, -6)),
            "contents changed": self._contents_changed,
            "replayed": lambda: self._chance.choice(self.recorded),
            "too old for a new stream": self._old,
            "random bytes behind a good frame": lambda: self.made(self._thief)[:-13] + chance.randbytes(13),
        }
        if others:
            self.kinds["wrong system"] = lambda: self.made(self._ahead, self._chance.choice(self._others))

    def made(self, guard: FrameGuard | None, system: int | None = None, payload: bytes | None = None) -> bytes:
        """A frame."""
        payload = self.payload if payload is None else payload
        system = self.system if system is None else system
        seq = self._chance.randrange(256)
        return build_frame(self.msgid, payload, seq, system, self.component, FORMATS[self.msgid].crc_extra, guard)

    def _version_1(self) -> bytes:
        sender = codec.dialect().MAVLink(None, srcSystem=self.system, srcComponent=self.component)
        frame = Frame(self.msgid, self.system, self.component, 0, self.payload, self.made(None), 0)
        return bytes(codec.decode_cold(frame).pack(sender, force_mavlink1=True))

    def _changed(self, where: range) -> bytes:
        raw = bytearray(self._chance.choice(self.recorded))
        raw[self._chance.choice(where)] ^= self._chance.randrange(1, 256)
        return bytes(raw)

    def _contents_changed(self) -> bytes:
        """Other contents with a right checksum under the signature of what was sent."""
        tail = self._chance.choice(self.recorded)[-13:]
        return self.made(self._thief, payload=self.payload[:-1] + bytes((self._chance.randrange(256),)))[:-13] + tail

    def _old(self) -> bytes:
        at = time_now() - NEW_STREAM_LATE - self._chance.randrange(100_000, 10**10)
        late = Signer(self._key, SigningTimes(0, {}, link_id=self._chance.randrange(201, 256)))
        late.now = lambda: at  # type: ignore[method-assign]
        late._zero_ns = -(10**19)
        late.times.newest = at
        return self.made(late)


def run(forger: Forger, good: Callable[[], bytes], give: Callable[[bytes, bool], bool], messages: int) -> Tally:
    """Gives a receiver so many bad messages, and good ones between them.

    Args:
        forger: makes the bad ones.
        good: makes a good one.
        give: hands one over, and tells whether it was used; the second argument: whether it is a good one.
        messages: how many bad ones.
    """
    tried: Counter[str] = Counter()
    used: Counter[str] = Counter()
    sent = accepted = 0
    kinds = list(forger.kinds)
    for number in range(messages):
        if number % EVERY == 0:
            raw = good()
            forger.recorded = [*forger.recorded[-50:], raw]
            sent += 1
            accepted += give(raw, True)
        kind = kinds[number % len(kinds)]
        tried[kind] += 1
        used[kind] += give(forger.kinds[kind](), False)
    return Tally(tried, used, sent, accepted)


def vehicle_link(key_file: str, key: SigningKey, messages: int, chance: random.Random) -> Tally:
    """Heartbeats that say the vehicle is armed, from its own address; good ones say that it is not."""
    port = free_udp_port()
    sender = Signer(key, SigningTimes(time_now(), {}))
    with (
        Wire.open(f"udpin:127.0.0.1:{port}", key=key_file) as wire,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as voice,
    ):
        voice.bind(("127.0.0.1", 0))
        standby = Standby(wire, lambda frame: None, lambda line: None)
        forger = Forger(key, 1, 1, codec.HEARTBEAT, codec.encode_heartbeat(2, 12, ARMED, 5), chance, (2, 3, 254))
        counted = 0

        def good() -> bytes:
            nonlocal counted
            counted += 1
            return forger.made(sender, payload=codec.encode_heartbeat(2, 12, 0, 4 << 16 | counted % 3 << 24))

        def give(raw: bytes, well: bool) -> bool:
            accepted = wire.counters.received
            standby.autopilot.armed = False
            voice.sendto(raw, ("127.0.0.1", port))
            standby.turn()
            ours = well or (raw[5] if raw[0] == MAGIC_V2 else raw[3]) == forger.system
            return wire.counters.received > accepted if ours else standby.autopilot.armed

        return run(forger, good, give, messages)


def ground_link(key_file: str, key: SigningKey, messages: int, chance: random.Random) -> Tally:
    """Commands to start a trajectory."""
    port = free_udp_port()
    sender = Signer(key, SigningTimes(time_now(), {}))
    guard = open_signer(key_file)
    assert guard is not None
    place = GroundPort(f"udpin:127.0.0.1:{port}", lambda: 1, guard, GROUND_SYSTEMS)
    place.open()
    payload = codec.encode_command_long(1, 191, 31010, 0, (1.0, *(0.0,) * 6))
    forger = Forger(key, 254, 190, COMMAND, payload, chance, (1, 7, 245, 255))
    with guard, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as voice:

        def give(raw: bytes, well: bool) -> bool:
            voice.sendto(raw, ("127.0.0.1", port))
            return bool(place.receive())

        try:
            return run(forger, lambda: forger.made(sender), give, messages)
        finally:
            place.close()


def bundled_vehicle(key: SigningKey, messages: int, chance: random.Random) -> Tally:
    """Commands to arm; of systems PX4 knows no wrong ones."""
    signing = LinkSigning(Keyring(key.secret), 0)
    sender = Signer(key, SigningTimes(time_now(), {}))
    payload = codec.encode_command_long(1, 1, 400, 0, (1.0, *(0.0,) * 6))
    assert COMMAND not in UNSIGNED
    forger = Forger(key, 254, 190, COMMAND, payload, chance, ())
    return run(
        forger, lambda: forger.made(sender), lambda raw, well: any(map(signing.accepts, vehicle_frames(raw))), messages
    )


def refused(messages: int, seed: int = 1) -> dict[str, Tally]:
    """All receivers; two fifths of the messages each to the links, one to the vehicle."""
    chance = random.Random(seed)
    with tempfile.TemporaryDirectory() as folder:
        state, os.environ["XDG_STATE_HOME"] = os.environ.get("XDG_STATE_HOME"), folder
        systemd = os.environ.pop("STATE_DIRECTORY", None)
        try:
            key_file = f"{folder}/key"
            key = new_key(key_file)
            return {
                "vehicle link": vehicle_link(key_file, key, messages * 2 // 5, chance),
                "ground link": ground_link(key_file, key, messages * 2 // 5, chance),
                "bundled vehicle": bundled_vehicle(key, messages - 2 * (messages * 2 // 5), chance),
            }
        finally:
            os.environ.pop("XDG_STATE_HOME")
            if state is not None:
                os.environ["XDG_STATE_HOME"] = state
            if systemd is not None:
                os.environ["STATE_DIRECTORY"] = systemd


def costs(rounds: int = 30, each: int = 1000) -> dict[str, float]:
    """Median times [us] of a frame: parsed and built, without and with a key, and what that adds."""
    key = SigningKey(bytes(range(32)))
    found: dict[str, float] = {}
    for name, msgid in (("ODOMETRY", codec.ODOMETRY), ("SET_ATTITUDE_TARGET", codec.SET_ATTITUDE_TARGET)):
        known = FORMATS[msgid]
        payload = bytes(range(1, 1 + min(known.length, 233)))
        sums: dict[str, list[float]] = {"parse": [], "parse signed": [], "build": [], "build signed": []}
        sender, receiver = (Signer(key, SigningTimes(time_now(), {})) for _ in range(2))
        plain, guarded = FrameParser(FORMATS, LinkCounters()), FrameParser(FORMATS, LinkCounters(), receiver)
        for _ in range(rounds):
            for suffix, guard, parser in (("", None, plain), (" signed", sender, guarded)):
                begun_ns = time.perf_counter_ns()
                made = [build_frame(msgid, payload, i & 255, 1, 1, known.crc_extra, guard) for i in range(each)]
                between_ns = time.perf_counter_ns()
                for raw in made:
                    parser.parse(raw, 1, [], [])
                sums[f"build{suffix}"].append((between_ns - begun_ns) / each * 1e-3)
                sums[f"parse{suffix}"].append((time.perf_counter_ns() - between_ns) / each * 1e-3)
        assert receiver.counters.accepted == rounds * each
        for step in ("parse", "build"):
            before, after = (statistics.median(sums[f"{step}{suffix}"]) for suffix in ("", " signed"))
            found |= {f"{name} {step}": before, f"{name} {step} signed": after, f"{name} {step} added": after - before}
    return found


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--messages", type=int, default=100_000, help="that must not be used")
    arguments = parser.parse_args()
    wrong = tried = 0
    for name, tally in refused(arguments.messages).items():
        print(f"{name}: {tally.good_used} of {tally.good} good messages used; of bad ones:")
        for kind, count in tally.tried.items():
            print(f"    {kind:34s} {tally.used[kind]} of {count} used")
        tried += tally.tried.total()
        wrong += tally.used.total() + (tally.good_used != tally.good)
    print(f"together: {tried} messages that must not be used, {wrong} faults")
    for name, value_us in costs().items():
        print(f"    {name:34s} {value_us:6.2f} us")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
