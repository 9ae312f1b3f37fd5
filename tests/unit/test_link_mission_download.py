"""The mission that is in the autopilot: the protocol over a bad link, and the file that comes of it."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from typing import Any

import pytest
from format_cases import FENCE, HOME, SQUARE, place
from pymavlink.dialects.v20 import common as mavlink

from companion.frames import GeoPoint
from companion.link.framing import Frame
from companion.link.mission_download import ACK, REQUEST_INT, REQUEST_LIST, Download, MissionType, StoredItem
from companion.trajectory.formats import parse
from companion.trajectory.formats.contents import Route
from companion.trajectory.formats.reading import decoded
from companion.trajectory.formats.wpl import text_of

NAN = math.nan


def item_int(
    sequence: int, command: int, params: tuple[float, ...], where: tuple[float, float, float], kind: int
) -> Any:
    north, east, up = where
    latitude, longitude = place(north, east)
    return mavlink.MAVLink_mission_item_int_message(
        *(255, 190, sequence, 6, command, 0, 1, *params),
        *(round(latitude * 1e7), round(longitude * 1e7), up, kind),
    )


MISSION = [
    item_int(0, 22, (0.0, 0.0, 0.0, NAN), SQUARE[0], 0),
    item_int(1, 16, (0.0, 0.0, 0.0, NAN), SQUARE[1], 0),
    item_int(2, 16, (0.0, 0.0, 0.0, 0.0), SQUARE[2], 0),
]
FENCE_ITEMS = [item_int(i, 5001, (4.0, 0.0, 0.0, 0.0), (*corner, 0.0), 1) for i, corner in enumerate(FENCE)]


class FakeAutopilot:
    """Answers as PX4 does; `loses` says of every message, in order, whether it gets lost."""

    def __init__(self, items: list[Any], loses: Callable[[], bool] = lambda: False) -> None:
        self._items = items
        self._loses = loses
        self._parser = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self.out: list[Frame] = []
        self.asked: list[int] = []

    def send(self, msgid: int, payload: bytes) -> bool:
        self.asked.append(msgid)
        kind = payload[-1]
        if self._loses():
            return True
        if msgid == REQUEST_LIST:
            self.answer(mavlink.MAVLink_mission_count_message(255, 190, len(self._items), kind))
        elif msgid == REQUEST_INT:
            self.answer(self._items[int.from_bytes(payload[:2], "little")])
        return True

    def answer(self, message: Any, system: int = 1, component: int = 1) -> None:
        raw = bytes(message.pack(self._parser))
        if not self._loses():
            self.out.append(Frame(message.get_msgId(), system, component, 0, raw[10:-2], raw, 0))


def fetched(autopilot: FakeAutopilot, kind: MissionType = MissionType.MISSION) -> Download:
    now_s = 0.0
    download = Download(autopilot.send, 1, kind, now_s)
    for _ in range(400):
        now_s += 0.1
        frames, autopilot.out = autopilot.out, []
        for frame in frames:
            download.on_frame(frame, now_s)
        download.update(now_s)
        if download.done or download.failure:
            break
    return download


def test_all_items_in_order() -> None:
    autopilot = FakeAutopilot(MISSION)
    download = fetched(autopilot)
    assert download.done
    assert [item.command for item in download.items] == [22, 16, 16]
    latitude, longitude = place(*SQUARE[1][:2])
    assert download.items[1].latitude_deg == pytest.approx(latitude, abs=1e-7)
    assert download.items[1].longitude_deg == pytest.approx(longitude, abs=1e-7)
    assert autopilot.asked == [REQUEST_LIST, REQUEST_INT, REQUEST_INT, REQUEST_INT, ACK]


@pytest.mark.parametrize("seed", range(5))
def test_half_of_the_messages_get_lost(seed: int) -> None:
    chance = random.Random(seed)
    download = fetched(FakeAutopilot(MISSION, lambda: chance.random() < 0.5))
    assert download.done
    assert len(download.items) == 3


def test_an_empty_list() -> None:
    download = fetched(FakeAutopilot([]))
    assert download.done
    assert download.items == ()


def test_silence_is_given_up_on() -> None:
    download = fetched(FakeAutopilot(MISSION, lambda: True))
    assert download.failure == "the autopilot does not send its mission (list)"
    assert not download.done


def test_a_refusal() -> None:
    autopilot = FakeAutopilot(MISSION, lambda: True)
    download = Download(autopilot.send, 1, MissionType.FENCE, 0.0)
    autopilot._loses = lambda: False
    autopilot.answer(mavlink.MAVLink_mission_ack_message(255, 190, 3, 1))
    download.on_frame(autopilot.out[0], 0.1)
    assert download.failure == "the autopilot refuses to give its fence (MAV_MISSION_RESULT 3)"


def test_what_others_say_and_what_was_not_asked_for_changes_nothing() -> None:
    autopilot = FakeAutopilot(MISSION)
    download = Download(autopilot.send, 1, MissionType.MISSION, 0.0)
    autopilot.out.clear()
    autopilot.answer(mavlink.MAVLink_mission_count_message(255, 190, 7, 0), system=2)
    autopilot.answer(mavlink.MAVLink_mission_count_message(255, 190, 7, 1))
    autopilot.answer(MISSION[0])
    for frame in autopilot.out:
        download.on_frame(frame, 0.1)
    assert download.items == ()
    assert not download.done
    autopilot.answer(mavlink.MAVLink_mission_count_message(255, 190, 6000, 0))
    download.on_frame(autopilot.out[-1], 0.2)
    assert "6000 items" in download.failure


def written(items: tuple[StoredItem, ...]) -> str:
    return text_of(
        GeoPoint(*HOME),
        [(i.command, i.frame, i.params, GeoPoint(i.latitude_deg, i.longitude_deg, i.altitude_m)) for i in items],
    )


def test_the_file_holds_the_same_mission() -> None:
    items = fetched(FakeAutopilot(MISSION)).items + fetched(FakeAutopilot(FENCE_ITEMS), MissionType.FENCE).items
    route = parse(decoded(written(items).encode(), "a.waypoints"))
    assert isinstance(route, Route)
    for leg, (north, east, up) in zip(route.legs, SQUARE, strict=False):
        assert leg.waypoint.p_m == pytest.approx((north, east, -up), abs=0.02)
    # Open stays open; north, which these files write as 360 degrees, stays north.
    assert [leg.waypoint.yaw_rad for leg in route.legs] == [None, None, pytest.approx(2.0 * math.pi)]
    assert route.altitude_above_home
    assert route.fence is not None
    assert len(route.fence.parts[0].corners_m) == 4  # type: ignore[union-attr]
