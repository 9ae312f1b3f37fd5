"""MAVLink 2 signing as PX4 does it: one key for all links, a signing time for each, streams that go forward in time.

PX4 has no clock for this. Its signing time is the one that came with the key, goes on by one with every message that it
sends, and jumps to that of whoever is ahead; a boot sets it back to the key's. Whoever talks to it must be ready for a
vehicle that begins in the past.

Not shared with the companion on purpose.
"""

from __future__ import annotations

import hashlib
import os
import stat
import struct
from collections import Counter
from pathlib import Path

from .codec import MAGIC_V2, SIGNED_FLAG, Frame

KEY_LENGTH = 32
ONE_MINUTE = 6_000_000
"""In units of 10 us: so far behind may the first message of a stream be."""
STREAMS_MAX = 16
UNSIGNED = frozenset((0, 109, 246, 247))
"""HEARTBEAT, RADIO_STATUS, ADSB_VEHICLE, COLLISION: accepted without a signature, as by PX4."""
SETUP_SIGNING = struct.Struct("<QBB32s")
"""initial_timestamp, target_system, target_component, secret_key."""
_SINCE_2015_S = 1_420_070_400
_TAIL = struct.Struct("<BIH")
"""Link id, and the time's low 32 and high 16 bits."""


class KeyFileError(ValueError):
    """A key file that cannot be used; the message is one line for people and says nothing of the key."""


class Keyring:
    """The key of a vehicle, and what all its links remember together."""

    def __init__(self, key: bytes | None = None, initial: int = 0) -> None:
        """Begin with a key, and the signing time that came with it; without a key nothing is signed."""
        self.key = key
        self.initial = initial
        self.streams: dict[tuple[int, int, int], int] = {}
        """Signing time of the latest message of each stream, by link id, system and component."""
        self.version = 0
        """Grows with every change of the key, and with every boot."""
        self.refused: Counter[str] = Counter()
        """Messages that were refused, by reason."""

    def change(self, key: bytes | None, initial: int) -> None:
        """Take another key, or none."""
        self.key, self.initial = key, initial
        self.version += 1

    def boot(self) -> None:
        """Forget what is not in the key's file."""
        self.streams.clear()
        self.version += 1


class LinkSigning:
    """The signatures of one link."""

    def __init__(self, keyring: Keyring, link_id: int) -> None:
        self.keyring = keyring
        self._link_id = link_id
        self._time = keyring.initial
        self._version = keyring.version

    def tail(self, frame: bytes) -> bytes:
        """Give the 13 bytes that end a frame which has the signed flag set."""
        self._follow()
        at = self._time
        self._time = at + 1
        stamp = _TAIL.pack(self._link_id, at & 0xFFFFFFFF, at >> 32 & 0xFFFF)
        assert self.keyring.key is not None
        return stamp + hashlib.sha256(self.keyring.key + frame + stamp).digest()[:6]

    def accepts(self, frame: Frame) -> bool:
        """Tell whether a message that was received may be acted on."""
        ring = self.keyring
        if ring.key is None:
            return True
        raw = frame.raw
        if not is_signed(frame):
            if frame.msg_id in UNSIGNED:
                return True
            ring.refused["unsigned"] += 1
            return False
        self._follow()
        if hashlib.sha256(ring.key + raw[:-6]).digest()[:6] != raw[-6:]:
            ring.refused["wrong signature"] += 1
            return False
        link_id, low, high = _TAIL.unpack(raw[-13:-6])
        at = low | high << 32
        stream = (link_id, frame.system, frame.component)
        last = ring.streams.get(stream)
        if last is not None and at <= last:
            ring.refused["repeated"] += 1
            return False
        if last is None and (at + ONE_MINUTE < self._time or len(ring.streams) >= STREAMS_MAX):
            ring.refused["too old"] += 1
            return False
        ring.streams[stream] = at
        self._time = max(self._time, at)
        return True

    def learn_time(self, frame: Frame) -> None:
        """Take over the time of a message that is to be acted on later, if its signature is right."""
        ring, raw = self.keyring, frame.raw
        if ring.key is None or not is_signed(frame):
            return
        self._follow()
        if hashlib.sha256(ring.key + raw[:-6]).digest()[:6] == raw[-6:]:
            self._time = max(self._time, int.from_bytes(raw[-12:-6], "little"))

    def _follow(self) -> None:
        """Begin anew after another key, or a boot."""
        if self._version != self.keyring.version:
            self._version = self.keyring.version
            self._time = self.keyring.initial


def is_signed(frame: Frame) -> bool:
    """Tell whether a frame has a signature."""
    return frame.raw[0] == MAGIC_V2 and bool(frame.raw[2] & SIGNED_FLAG)


def load_key(path: Path) -> tuple[bytes, int]:
    """Read a key file: 32 bytes, or as many in hexadecimal; gives the key and, as its signing time, the file's age.

    Raises:
        KeyFileError: it cannot be used, or others than its owner may read it.
    """
    try:
        with path.open("rb") as file:
            found = os.fstat(file.fileno())
            content = file.read(4 * KEY_LENGTH)
    except OSError as error:
        raise KeyFileError(f"--key {path}: {error.strerror}") from None
    if not stat.S_ISREG(found.st_mode) or found.st_uid != os.geteuid() or found.st_mode & 0o077:
        raise KeyFileError(f"--key {path}: must be a file of your own that nobody else may use: chmod 600 {path}")
    key = content
    if len(content) != KEY_LENGTH:
        try:
            key = bytes.fromhex(content.decode("ascii"))
        except ValueError:
            key = b""
    if len(key) != KEY_LENGTH or not any(key):
        raise KeyFileError(f"--key {path}: is no key; expected {KEY_LENGTH} bytes, raw or in hexadecimal, not all zero")
    return key, max(0, int((found.st_mtime - _SINCE_2015_S) * 100_000))
