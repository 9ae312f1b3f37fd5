"""MAVLink 2 message signing: who wrote a frame, and that it is no recording.

A signed frame ends with a link id, a 48-bit time in units of 10 us since 2015, and the first six bytes of
SHA-256(key, frame, link id, time) (https://mavlink.io/en/guide/message_signing.html). A stream (system, component, link
id) must go forward in time; one that is new may be a minute behind at most. Times of others that are ahead are taken
over, as every implementation does: PX4 has no other clock for this than ours.

Nothing here touches files: `key_file` reads keys, `signing_times` keeps the times across restarts.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from hashlib import sha256
from hmac import compare_digest
from typing import Final

KEY_BYTES: Final = 32
UNITS_PER_S: Final = 100_000
"""Of signing time."""
NS_PER_UNIT: Final = 10_000
EPOCH_S: Final = 1_420_070_400
"""2015-01-01 00:00 UTC, the zero of signing time, in Unix time."""
NEW_STREAM_LATE: Final = 60 * UNITS_PER_S
"""How far behind the newest time the first frame of a stream may be."""
TIME_END: Final = 1 << 48
"""Signing times are below this, in the year 2104."""
TIME_LATEST: Final = TIME_END - 365 * 24 * 3600 * UNITS_PER_S
"""Nobody's time is taken over beyond this: a year must be left to sign in, or one broken clock would end the key."""
STREAMS_MAX: Final = 64
"""Senders that are kept apart; only who has the key can make one."""

RADIO_STATUS: Final = 109
UNSIGNED_ALLOWED: Final = frozenset({RADIO_STATUS})
"""What may come unsigned although there is a key: a telemetry radio writes this itself and has none. Nothing acts on
it. HEARTBEAT is not among them: mode and arming decide about a flight."""

SETUP_SIGNING: Final = 256
"""The message that carries a key: it is never logged and never passed on."""

_TIME_BYTES: Final = 6


class SigningKey:
    """The 32 bytes that both ends share. Not shown by `repr`, so that no log or traceback tells it."""

    def __init__(self, secret: bytes) -> None:
        if len(secret) != KEY_BYTES:
            raise ValueError(f"a signing key has {KEY_BYTES} bytes")
        self.secret = secret

    @property
    def fingerprint(self) -> str:
        """Tells this key from others and says nothing about it."""
        return sha256(b"offboard companion, name of a signing key" + self.secret).hexdigest()[:16]

    def __repr__(self) -> str:
        return f"SigningKey({self.fingerprint})"

    def __reduce__(self) -> str:
        raise TypeError("a signing key is not to be copied into other processes or files")


@dataclass
class SigningCounters:
    """What became of the frames that a guard saw."""

    accepted: int = 0
    """Signed, and new."""
    allowed_unsigned: int = 0
    """Unsigned, of the short list."""
    unsigned: int = 0
    """Refused: no signature."""
    wrong: int = 0
    """Refused: the signature is not that of our key."""
    replayed: int = 0
    """Refused: not newer than what its stream has sent before."""
    stale: int = 0
    """Refused: the first of its stream, and too old; or so late that hardly any time would be left to sign in."""
    too_many: int = 0
    """Refused: of one stream more than can be kept apart."""

    @property
    def outdated(self) -> int:
        """Refused for their time alone: the sender has the key, or somebody has recorded one who has."""
        return self.replayed + self.stale

    @property
    def refused(self) -> int:
        """All that was refused."""
        return self.unsigned + self.wrong + self.replayed + self.stale + self.too_many


@dataclass
class SigningTimes:
    """All that signing has to remember; `signing_times` keeps it across restarts."""

    newest: int
    """The latest time that was sent or accepted, or that may have been before these were loaded."""
    streams: dict[int, int]
    """Latest time of each stream, by `stream_of`."""
    floor: int = -1
    """Nothing up to this time is accepted of any stream: of what came just before a crash nothing is known."""
    used: int = 0
    """The latest time that is known to have been sent or accepted before these were loaded."""
    link_id: int = 0
    """Of what we send."""
    reserved: int = TIME_END
    """Times up to this one are known on the disk to be in use."""


def time_now() -> int:
    """Signing time by this machine's clock."""
    return max(0, time.time_ns() // NS_PER_UNIT - EPOCH_S * UNITS_PER_S)


def stream_of(system: int, component: int, link_id: int) -> int:
    """The number of a stream."""
    return link_id << 16 | component << 8 | system


class Signer:
    """Signs and verifies for one process; implements `framing.FrameGuard`. Not for several threads.

    Args:
        key: the secret.
        times: what is remembered; changed.
    """

    def __init__(self, key: SigningKey, times: SigningTimes) -> None:
        self.counters = SigningCounters()
        self.times = times
        self._hash = sha256(key.secret)
        self._link = bytes((times.link_id,))
        # From here on time passes by the monotonic clock: a step of the machine's clock must not reach a flight.
        # In ns, as two times that were rounded down to units may be one unit ahead of the clock together.
        self._zero_ns = time.time_ns() - EPOCH_S * UNITS_PER_S * NS_PER_UNIT - time.monotonic_ns()

    @property
    def outdated(self) -> int:
        """Authentic frames that were refused for their time."""
        return self.counters.outdated

    @property
    def refusals(self) -> dict[str, int]:
        """Frames that were refused, by reason."""
        counters = self.counters
        return {
            "unsigned": counters.unsigned,
            "wrong_signature": counters.wrong,
            "replayed": counters.replayed,
            "stale": counters.stale + counters.too_many,
        }

    def now(self) -> int:
        """Signing time: the clock, or what others have told, whichever is later."""
        return max(self.times.newest, (self._zero_ns + time.monotonic_ns()) // NS_PER_UNIT)

    def sign(self, unsigned: bytes) -> bytes:
        """The 13 bytes that end a frame which has the signed flag set.

        At the end of all times it goes on with the last one: others refuse that, and whoever sends lives on.
        """
        times = self.times
        newest = times.newest + 1
        clock = (self._zero_ns + time.monotonic_ns()) // NS_PER_UNIT
        newest = newest if newest > clock else clock
        times.newest = newest = newest if newest < TIME_END else TIME_END - 1
        tail = self._link + newest.to_bytes(_TIME_BYTES, "little")
        digest = self._hash.copy()
        digest.update(unsigned + tail)
        return tail + digest.digest()[:6]

    def verify(self, raw: bytes, msgid: int, signed: bool) -> bool:
        """Whether a frame, whose checksum is right, may be used."""
        counters = self.counters
        if not signed:
            if msgid in UNSIGNED_ALLOWED:
                counters.allowed_unsigned += 1
                return True
            counters.unsigned += 1
            return False
        digest = self._hash.copy()
        digest.update(raw[:-6])
        if not compare_digest(digest.digest()[:6], raw[-6:]):
            counters.wrong += 1
            return False
        times = self.times
        stream = raw[-13] << 16 | raw[6] << 8 | raw[5]
        at = int.from_bytes(raw[-12:-6], "little")
        if at > TIME_LATEST:
            counters.stale += 1
            return False
        last = times.streams.get(stream)
        if last is None:
            if not self._begins(at):
                return False
        elif at <= last:
            counters.replayed += 1
            return False
        elif at <= times.floor:
            counters.stale += 1
            return False
        times.streams[stream] = at
        if at > times.newest:
            times.newest = at
            if at > times.reserved:
                self._passed()
        counters.accepted += 1
        return True

    def _passed(self) -> None:
        """A time beyond those that are reserved was accepted."""

    def _begins(self, at: int) -> bool:
        """Whether a stream may begin at this time."""
        times = self.times
        oldest = self.now() - NEW_STREAM_LATE
        if at < oldest or at <= times.floor:
            self.counters.stale += 1
            return False
        if len(times.streams) >= STREAMS_MAX:
            # One that has been silent for longer than a minute could not begin anew with what it has sent before.
            stream, last = min(times.streams.items(), key=lambda item: item[1])
            if last >= oldest:
                self.counters.too_many += 1
                return False
            del times.streams[stream]
        return True
