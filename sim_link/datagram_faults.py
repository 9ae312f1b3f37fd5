"""What happens to datagrams on their way: lost, in bursts, late, twice, in another order, with wrong bits, not at all.

One `LinkFaults` per link, one `Channel` per direction. Times are vehicle time. What a datagram meets is drawn from the
seed, the fault's number, the vehicle time and the datagram's place among those of this time: nothing else, so that one
datagram more or less changes nothing at other times. A datagram that is late comes with the first state at or after its
time; without a `reorder` fault none overtakes another.
"""

from __future__ import annotations

import hashlib
import heapq
import random
import struct
from dataclasses import dataclass, replace
from typing import NamedTuple

from .codec import ID_SERIAL_CONTROL, ID_TIMESYNC, Frame, frames, timesync
from .fault_keys import message_ids
from .fault_kinds import Fault

ORDER = ("silence", "loss", "burst_loss", "corrupt", "duplicate", "delay", "jitter", "reorder")
"""The kinds that act here, in the order in which a datagram meets them."""
_PLACE = struct.Struct("<qqq")
_DIGEST_BYTES = 8
_MSG_ID = slice(7, 10)
_V1_MSG_ID = 5
_V2 = 0xFD


@dataclass(frozen=True)
class Counts:
    """What became of the datagrams of a channel: taken + duplicated = delivered + lost + held."""

    taken: int = 0
    delivered: int = 0
    lost: int = 0
    duplicated: int = 0
    corrupted: int = 0
    """Delivered with wrong bits, or still held."""
    late: int = 0
    """Held for a time."""
    held: int = 0
    """Under way now."""


class _Active(NamedTuple):
    """A fault that acts on a channel."""

    number: int
    fault: Fault
    messages: frozenset[int]
    """Those that it acts on; empty: all."""
    key: bytes
    """Of its draws."""
    bursts: _Bursts | None


class _Bursts:
    """The Gilbert-Elliott channel: good and bad times take turns, each exponentially distributed."""

    def __init__(self, fault: Fault, key: bytes, now_us: int) -> None:
        self._draw = random.Random(int.from_bytes(key, "little"))
        self._fault = fault
        self._bad = False
        self._turn_us = now_us + self._span_us()

    def _span_us(self) -> int:
        mean_s = self._fault["bad_s" if self._bad else "good_s"]
        span_s = self._draw.expovariate(1.0 / mean_s)
        longest_s = self._fault["bad_max_s"]
        if self._bad and longest_s is not None:
            span_s = min(span_s, longest_s)
        return max(1, round(span_s * 1e6))

    def share(self, now_us: int) -> float:
        """Give the probability of a loss at a time; times must not go back."""
        while now_us >= self._turn_us:
            self._bad = not self._bad
            self._turn_us += self._span_us()
        return float(self._fault["loss_bad" if self._bad else "loss_good"])


class Channel:
    """One direction of a link."""

    def __init__(self, seed: int, name: str) -> None:
        """Begin without faults; `name` tells this channel's draws from those of the others."""
        self._seed = f"{seed} {name}"
        self._active: list[_Active] = []
        self._held: list[tuple[int, int, bytes]] = []
        self._order = 0
        self._last_us: dict[int | None, int] = {}
        """When the last datagram comes that others must not overtake: of all, or of one message."""
        self._now_us = -1
        self._place = 0
        self._counts = Counts()

    @property
    def counts(self) -> Counts:
        """What became of the datagrams so far."""
        return replace(self._counts, held=len(self._held))

    @property
    def idle(self) -> bool:
        """Whether nothing acts here and nothing is under way."""
        return not self._active and not self._held

    def begin(self, number: int, fault: Fault, now_us: int) -> None:
        """Let a fault act from now on; `number` is its own."""
        key = hashlib.blake2b(f"{self._seed} {number}".encode(), digest_size=32).digest()
        bursts = _Bursts(fault, key, now_us) if fault.kind == "burst_loss" else None
        self._active.append(_Active(number, fault, message_ids(fault["messages"]), key, bursts))
        self._active.sort(key=lambda active: (ORDER.index(active.fault.kind), active.number))

    def end(self, number: int) -> None:
        """Let a fault act no longer; what it holds still comes in its time."""
        self._active = [active for active in self._active if active.number != number]

    def forget(self) -> None:
        """Lose what is under way."""
        self._count(lost=len(self._held))
        self._held.clear()
        self._last_us.clear()

    def take(self, raw: bytes, now_us: int) -> list[bytes]:
        """Take a datagram; gives what goes on at once. The rest is lost, or comes with `released`."""
        if now_us != self._now_us:
            self._now_us, self._place = now_us, 0
        self._place += 1
        self._count(taken=1)
        copies = [(raw, 0)]
        msg_id = message_number(raw)
        held_us = late_us = 0
        queue: int | None = None
        for active in self._active:
            if active.messages and msg_id not in active.messages:
                continue
            kind, fault = active.fault.kind, active.fault
            if kind in ("silence", "loss", "burst_loss"):
                if kind == "silence" or self._is_lost(active, now_us):
                    self._count(lost=1)
                    return []
            elif kind == "delay":
                held_us += round(fault["delay_s"] * 1e6)
            elif kind == "jitter":
                held_us += round(fault["jitter_s"] * self._drawn(active) * 1e6)
            elif self._drawn(active) >= fault["share"]:
                continue
            elif kind == "corrupt":
                copies = [(self._corrupted(active, copies[0][0]), 0)]
                self._count(corrupted=1)
            elif kind == "duplicate":
                copies.append((copies[0][0], round(fault["late_s"] * 1e6)))
                self._count(duplicated=1)
            elif kind == "reorder":
                late_us += round(fault["late_s"] * 1e6)
            if active.messages and kind in ("delay", "jitter"):
                queue = msg_id
        due_us = now_us + held_us
        if held_us or self._last_us:
            due_us = self._last_us[queue] = max(due_us, self._last_us.get(queue, 0))
        return [out for copy, extra_us in copies for out in self._go_on(copy, due_us + late_us + extra_us, now_us)]

    def released(self, now_us: int) -> list[bytes]:
        """Give what was held until now, in the order in which it is due."""
        out = []
        while self._held and self._held[0][0] <= now_us:
            out.append(heapq.heappop(self._held)[2])
        if not self._held:
            self._last_us.clear()
        if out:
            self._count(delivered=len(out))
        return out

    def _go_on(self, raw: bytes, due_us: int, now_us: int) -> list[bytes]:
        """Give a datagram that is due now; hold one that is due later."""
        if due_us <= now_us:
            self._count(delivered=1)
            return [raw]
        self._order += 1
        heapq.heappush(self._held, (due_us, self._order, raw))
        self._count(late=1)
        return []

    def _is_lost(self, active: _Active, now_us: int) -> bool:
        share = active.fault["share"] if active.bursts is None else active.bursts.share(now_us)
        return self._drawn(active) < share

    def _drawn(self, active: _Active) -> float:
        """Draw a number from 0 up to 1."""
        return self._digest(active, 0) / float(1 << 8 * _DIGEST_BYTES)

    def _digest(self, active: _Active, purpose: int) -> int:
        place = _PLACE.pack(self._now_us, self._place, purpose)
        return int.from_bytes(hashlib.blake2b(place, key=active.key, digest_size=_DIGEST_BYTES).digest(), "little")

    def _corrupted(self, active: _Active, raw: bytes) -> bytes:
        """Turn some bits of a datagram over."""
        count = min(active.fault["bits"], 8 * len(raw))
        bad = bytearray(raw)
        for bit in random.Random(self._digest(active, 1)).sample(range(8 * len(raw)), count):
            bad[bit >> 3] ^= 1 << (bit & 7)
        return bytes(bad)

    def _count(self, **more: int) -> None:
        self._counts = replace(self._counts, **{name: getattr(self._counts, name) + n for name, n in more.items()})


class LinkFaults:
    """Both directions of one link. `now_us` is the vehicle time of the state whose datagrams come and go."""

    def __init__(self, seed: int, name: str, *, spares_exchange: bool = False) -> None:
        self.name = name
        self.now_us = 0
        self.spares_exchange = spares_exchange
        """Whether the TIMESYNC exchange that moves a vehicle in lockstep passes whatever acts here."""
        self.answer_offset_ns = 0
        """By so much the vehicle's answers to TIMESYNC requests are wrong."""
        self.channels = {way: Channel(seed, f"{name} {way}") for way in ("to_vehicle", "from_vehicle")}

    @property
    def idle(self) -> bool:
        """Whether nothing acts here and nothing is under way."""
        return self.answer_offset_ns == 0 and all(channel.idle for channel in self.channels.values())

    def begin(self, number: int, fault: Fault) -> None:
        """Let a fault act from now on, if it is for this link."""
        if fault["link"] in (self.name, "both"):
            for way, channel in self.channels.items():
                if fault["direction"] in (way, "both"):
                    channel.begin(number, fault, self.now_us)

    def end(self, number: int) -> None:
        """Let a fault act no longer."""
        for channel in self.channels.values():
            channel.end(number)

    def forget(self) -> None:
        """Lose what is under way."""
        for channel in self.channels.values():
            channel.forget()

    def outgoing(self, outbox: list[bytes]) -> None:
        """Put what really goes out now in the place of what the vehicle wants to send."""
        channel = self.channels["from_vehicle"]
        out = channel.released(self.now_us)
        for raw in outbox:
            if self._is_exchange(message_number(raw), raw):
                out.append(raw)
            else:
                out += channel.take(raw, self.now_us)
        outbox[:] = out

    def incoming(self, found: list[Frame]) -> list[Frame]:
        """Give what the vehicle hears now of what has come."""
        channel = self.channels["to_vehicle"]
        out: list[Frame] = []
        for frame in found:
            if frame.msg_id == ID_SERIAL_CONTROL or self._is_exchange(frame.msg_id, frame.raw, frame.payload):
                out.append(frame)
                continue
            for raw in channel.take(frame.raw, self.now_us):
                out += [frame] if raw is frame.raw else frames(raw)
        return out

    def released(self) -> list[Frame]:
        """Give what came earlier and reaches the vehicle now."""
        return [frame for raw in self.channels["to_vehicle"].released(self.now_us) for frame in frames(raw)]

    def _is_exchange(self, msg_id: int, raw: bytes, payload: bytes | None = None) -> bool:
        """Tell whether this is the vehicle's question, or the companion's answer, of the lockstep exchange."""
        if not self.spares_exchange or msg_id != ID_TIMESYNC:
            return False
        if payload is not None:
            return timesync(payload)[0] != 0
        return timesync(raw[10:-2])[0] == 0


def message_number(raw: bytes) -> int:
    """Give a frame's message id, of MAVLink 2 or 1."""
    if raw[0] == _V2:
        return int.from_bytes(raw[_MSG_ID], "little")
    return raw[_V1_MSG_ID]
