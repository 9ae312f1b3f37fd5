"""The mission protocol: upload, download and clearing of missions, geofences and rally points (mavlink_mission.cpp).

One transfer per link; an upload on one link keeps those of the others out. The vehicle asks for items again after
250 ms and gives a transfer up after 5 s without a word.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from enum import Enum
from typing import Any

from . import missions
from .codec import AUTOPILOT_COMPONENT, Frame, mavlink
from .link import Link
from .missions import Item, Plans

RETRY_US = 250_000
TIMEOUT_US = 5_000_000
_MISSION_PLANNER = 190
"""MAV_COMP_ID_MISSIONPLANNER: PX4 answers for it too."""
# With opaque ids, which pymavlink's dialect leaves out.
_COUNT = struct.Struct("<HBBBI")
_ACK = struct.Struct("<BBBBI")
_FLOAT_FRAMES = {missions.FRAME_GLOBAL_INT: missions.FRAME_GLOBAL, missions.FRAME_RELATIVE_INT: missions.FRAME_RELATIVE}

Say = Callable[[int, str], None]


class _State(Enum):
    IDLE = 0
    SENDING = 1
    RECEIVING = 2


class _Transfer:
    """What one link's transfer is at."""

    def __init__(self, link: Link) -> None:
        self.link = link
        self.state = _State.IDLE
        self.partner = (0, 0)
        self.kind = missions.MISSION
        self.sequence = 0
        """Of the item that is expected next, or was not asked for yet."""
        self.count = 0
        self.items: list[Item] = []
        self.whole_numbers = True
        """Whether items go as MISSION_ITEM_INT."""
        self.heard_us = 0
        self.sent_us = 0


class MissionProtocol:
    """Serves all links of a vehicle."""

    def __init__(self, plans: Plans, say: Say, *, system: int, select: Callable[[int], bool]) -> None:
        """Serve `plans`; `say` sends a STATUSTEXT, `select` makes an item of the mission the current one."""
        self._plans = plans
        self._say = say
        self._system = system
        self._select = select
        self._transfers: list[_Transfer] = []
        self.is_busy = False
        """Whether a transfer may be under way, so that `update` has something to do."""
        self.current: Callable[[], int] = lambda: 0
        """Gives the mission's current item."""
        self._handlers: dict[int, Callable[[_Transfer, Any, tuple[int, int], int], None]] = {
            mavlink.MAVLINK_MSG_ID_MISSION_COUNT: self._count,
            mavlink.MAVLINK_MSG_ID_MISSION_ITEM_INT: self._item,
            mavlink.MAVLINK_MSG_ID_MISSION_ITEM: self._item,
            mavlink.MAVLINK_MSG_ID_MISSION_REQUEST_LIST: self._request_list,
            mavlink.MAVLINK_MSG_ID_MISSION_REQUEST_INT: self._request,
            mavlink.MAVLINK_MSG_ID_MISSION_REQUEST: self._request,
            mavlink.MAVLINK_MSG_ID_MISSION_ACK: self._ack,
            mavlink.MAVLINK_MSG_ID_MISSION_CLEAR_ALL: self._clear,
            mavlink.MAVLINK_MSG_ID_MISSION_SET_CURRENT: self._set_current,
        }

    @property
    def message_ids(self) -> Iterable[int]:
        """The messages that `handle` takes."""
        return self._handlers.keys()

    def handle(self, frame: Frame, message: Any, link: Link, now_us: int) -> None:
        """Act on a message of the protocol; one for another target is passed over."""
        if message.target_system != self._system:
            return
        if message.target_component not in (0, AUTOPILOT_COMPONENT, _MISSION_PLANNER):
            return
        transfer = next((t for t in self._transfers if t.link is link), None)
        if transfer is None:
            transfer = _Transfer(link)
            self._transfers.append(transfer)
        self.is_busy = True
        self._handlers[frame.msg_id](transfer, message, (frame.system, frame.component), now_us)

    def update(self, now_us: int) -> None:
        """Ask again for what did not come, and give up what takes too long."""
        idle = _State.IDLE
        for transfer in self._transfers:
            if transfer.state is idle:
                continue
            if now_us - transfer.heard_us > TIMEOUT_US:
                self._say(mavlink.MAV_SEVERITY_CRITICAL, "Operation timeout")
                transfer.state = _State.IDLE
            elif transfer.state is _State.RECEIVING and now_us - transfer.sent_us > RETRY_US:
                self._ask(transfer, now_us)
        self.is_busy = any(transfer.state is not idle for transfer in self._transfers)

    # Upload

    def _count(self, transfer: _Transfer, message: Any, sender: tuple[int, int], now_us: int) -> None:
        """MISSION_COUNT: begin an upload. Zero clears."""
        if transfer.state is _State.RECEIVING:
            transfer.heard_us = now_us
            if sender == transfer.partner and transfer.sequence == 0:
                self._ask(transfer, now_us)  # our request was lost
                return
        if transfer.state is not _State.IDLE or any(t.state is _State.RECEIVING for t in self._transfers):
            self._answer(transfer, sender, message.mission_type, missions.ERROR)
            return
        kind, count = message.mission_type, message.count
        if kind not in missions.MAX_ITEMS:
            self._answer(transfer, sender, kind, missions.INVALID)
        elif count > missions.MAX_ITEMS[kind]:
            self._answer(transfer, sender, kind, missions.NO_SPACE)
        elif count == 0:
            self._plans.clear(kind)
            self._answer(transfer, sender, kind, missions.ACCEPTED)
        else:
            transfer.state, transfer.partner, transfer.kind = _State.RECEIVING, sender, kind
            transfer.sequence, transfer.count, transfer.items = 0, count, []
            transfer.whole_numbers = True
            transfer.heard_us = now_us
            self._ask(transfer, now_us)

    def _item(self, transfer: _Transfer, message: Any, sender: tuple[int, int], now_us: int) -> None:
        """MISSION_ITEM_INT or MISSION_ITEM: take it if it is the expected one."""
        if sender != transfer.partner:
            self._say(mavlink.MAV_SEVERITY_CRITICAL, "REJ. MIS ITEM: partner id mismatch")
            return
        if transfer.state is not _State.RECEIVING or message.mission_type != transfer.kind:
            self._stray_item(transfer, message, sender)
            return
        transfer.heard_us = now_us
        transfer.whole_numbers = message.get_type() == "MISSION_ITEM_INT"
        if message.seq != transfer.sequence:
            return
        item = missions.from_message(message)
        reason = missions.refusal(transfer.kind, item)
        if reason != missions.ACCEPTED:
            self._say(mavlink.MAV_SEVERITY_CRITICAL, "IGN MISSION_ITEM: Invalid item")
            self._end(transfer, reason)
            return
        transfer.items.append(item)
        transfer.sequence += 1
        if transfer.sequence < transfer.count:
            self._ask(transfer, now_us)
        elif missions.consistent(transfer.kind, transfer.items):
            self._plans.replace(transfer.kind, transfer.items)
            self._end(transfer, missions.ACCEPTED)
        else:
            self._end(transfer, missions.INVALID)

    def _stray_item(self, transfer: _Transfer, message: Any, sender: tuple[int, int]) -> None:
        """Answer an item that nobody asked for: the last one again means that our acknowledgement was lost."""
        again = transfer.state is _State.IDLE and transfer.items and message.seq + 1 == transfer.sequence
        if again and message.mission_type == transfer.kind:
            self._answer(transfer, sender, transfer.kind, missions.ACCEPTED, self._plans.ids[transfer.kind])
        else:
            self._say(mavlink.MAV_SEVERITY_CRITICAL, "IGN MISSION_ITEM: No transfer")
            self._answer(transfer, sender, message.mission_type, missions.ERROR)

    def _ask(self, transfer: _Transfer, now_us: int) -> None:
        """Ask for the next item."""
        transfer.sent_us = now_us
        fields = (*transfer.partner, transfer.sequence, transfer.kind)
        if transfer.whole_numbers:
            transfer.link.send(mavlink.MAVLink_mission_request_int_message(*fields))
        else:
            transfer.link.send(mavlink.MAVLink_mission_request_message(*fields))

    def _end(self, transfer: _Transfer, result: int) -> None:
        """End an upload."""
        transfer.state = _State.IDLE
        number = self._plans.ids[transfer.kind] if result == missions.ACCEPTED else 0
        if result != missions.ACCEPTED:
            transfer.items = []
        self._answer(transfer, transfer.partner, transfer.kind, result, number)

    # Download

    def _request_list(self, transfer: _Transfer, message: Any, sender: tuple[int, int], now_us: int) -> None:
        """MISSION_REQUEST_LIST: begin a download."""
        kind = message.mission_type
        done = transfer.state is _State.SENDING and transfer.sequence == transfer.count
        again = transfer.state is _State.SENDING and sender == transfer.partner and kind == transfer.kind
        if transfer.state is not _State.IDLE and not done and not again:
            self._say(mavlink.MAV_SEVERITY_INFO, "Mission download request ignored, already active")
            return
        if kind not in missions.MAX_ITEMS:
            self._answer(transfer, sender, kind, missions.UNSUPPORTED)
            return
        transfer.state, transfer.partner, transfer.kind = _State.SENDING, sender, kind
        transfer.items = list(self._plans.items[kind])
        transfer.sequence, transfer.count = 0, len(transfer.items)
        transfer.heard_us = now_us
        payload = _COUNT.pack(transfer.count, *sender, kind, self._plans.ids[kind])
        transfer.link.send_hot(mavlink.MAVLINK_MSG_ID_MISSION_COUNT, payload)

    def _request(self, transfer: _Transfer, message: Any, sender: tuple[int, int], now_us: int) -> None:
        """MISSION_REQUEST_INT or MISSION_REQUEST: give the next item, or the last one again."""
        if sender != transfer.partner or transfer.state is _State.RECEIVING:
            reason = "partner id mismatch" if sender != transfer.partner else "Busy"
            self._say(mavlink.MAV_SEVERITY_CRITICAL, f"WPM: REJ. CMD: {reason}")
            return
        if transfer.state is _State.IDLE or message.mission_type != transfer.kind:
            return
        transfer.heard_us = now_us
        sequence = message.seq
        if sequence >= transfer.count or sequence not in (transfer.sequence, transfer.sequence - 1):
            transfer.state = _State.IDLE
            self._answer(transfer, sender, transfer.kind, missions.ERROR)
            self._say(mavlink.MAV_SEVERITY_CRITICAL, "WPM: REJ. CMD: Req. WP was unexpected")
            return
        transfer.sequence = sequence + 1
        self._send_item(transfer, sequence, message.get_type() == "MISSION_REQUEST_INT")

    def _send_item(self, transfer: _Transfer, sequence: int, whole_numbers: bool) -> None:
        item = transfer.items[sequence]
        current = int(transfer.kind == missions.MISSION and sequence == self.current())
        rest = (item.command, current, item.autocontinue, *item.params)
        if whole_numbers:
            message = mavlink.MAVLink_mission_item_int_message(
                *transfer.partner, sequence, item.frame, *rest, item.x, item.y, item.z, transfer.kind
            )
        else:
            frame = _FLOAT_FRAMES.get(item.frame, item.frame)
            scale = 1.0 if frame == missions.FRAME_MISSION else 1e-7
            message = mavlink.MAVLink_mission_item_message(
                *transfer.partner, sequence, frame, *rest, scale * item.x, scale * item.y, item.z, transfer.kind
            )
        transfer.link.send(message)

    # Both

    def _ack(self, transfer: _Transfer, message: Any, sender: tuple[int, int], now_us: int) -> None:
        """MISSION_ACK: the partner has what it wanted, cannot take a form of the items, or gives up."""
        if sender != transfer.partner:
            self._say(mavlink.MAV_SEVERITY_CRITICAL, "REJ. WP CMD: partner id mismatch")
            return
        transfer.heard_us = now_us
        if transfer.state is _State.SENDING and message.mission_type == transfer.kind:
            transfer.state = _State.IDLE
        elif transfer.state is _State.RECEIVING and message.type == missions.UNSUPPORTED:
            transfer.whole_numbers = not transfer.whole_numbers
            self._ask(transfer, now_us)
        elif transfer.state is _State.RECEIVING and message.type == missions.OPERATION_CANCELLED:
            transfer.state = _State.IDLE

    def _clear(self, transfer: _Transfer, message: Any, sender: tuple[int, int], now_us: int) -> None:
        """MISSION_CLEAR_ALL."""
        if transfer.state is not _State.IDLE:
            self._say(mavlink.MAV_SEVERITY_CRITICAL, "WPM: IGN CLEAR CMD: Busy")
            return
        result = missions.ACCEPTED if self._plans.clear(message.mission_type) else missions.ERROR
        self._answer(transfer, sender, message.mission_type, result)

    def _set_current(self, transfer: _Transfer, message: Any, sender: tuple[int, int], now_us: int) -> None:
        """MISSION_SET_CURRENT; the answer is MISSION_CURRENT."""
        if transfer.state is not _State.IDLE:
            self._say(mavlink.MAV_SEVERITY_CRITICAL, "WPM: IGN WP CURR CMD: Busy")
        elif not self._select(message.seq):
            self._say(mavlink.MAV_SEVERITY_CRITICAL, "WPM: WP CURR CMD: Not in list")

    @staticmethod
    def _answer(transfer: _Transfer, to: tuple[int, int], kind: int, result: int, number: int = 0) -> None:
        """Queue a MISSION_ACK."""
        transfer.link.send_hot(mavlink.MAVLINK_MSG_ID_MISSION_ACK, _ACK.pack(*to, result, kind, number))
