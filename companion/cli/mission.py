"""FILE gets the mission and the geofence that are in the autopilot, with its home position, as QGC WPL 110: for
`companion check FILE` and `companion fly FILE`. An existing file is not overwritten.
"""

from __future__ import annotations

import json
import time
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from companion.cli.common import JsonOption, VehicleKeyOption, VehicleSystemOption, say

if TYPE_CHECKING:
    from companion.flight.phases import Autopilot
    from companion.link.mission_download import MissionType, StoredItem
    from companion.link.wire import Wire

EXAMPLE = "Example: companion mission field.waypoints --connect udpin:127.0.0.1:14540"

HOME_POSITION = 242
HOME_RETRY_S = 1.0
WAIT_S = 0.05


def run(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="File to write, such as field.waypoints.")],
    connect: Annotated[
        str, typer.Option("--connect", help="udpin:HOST:PORT, udpout:HOST:PORT or serial:DEVICE:BAUD.")
    ] = "udpin:127.0.0.1:14540",
    key: VehicleKeyOption = None,
    system: VehicleSystemOption = None,
    timeout: Annotated[float, typer.Option("--timeout", metavar="S", help="How long to wait for the vehicle.")] = 15.0,
    as_json: JsonOption = False,
) -> None:
    """Downloads and writes."""
    from companion.errors import InputError, LinkError
    from companion.flight.connect import find_autopilot
    from companion.flight.phases import Autopilot, FlightEnded
    from companion.frames import GeoPoint
    from companion.link.mission_download import MissionType
    from companion.link.vehicle_link import VehicleLink
    from companion.trajectory.formats.wpl import text_of

    if not (isfinite(timeout) and timeout > 0.0):
        raise InputError(f"--timeout {timeout:g}: must be a number of seconds above 0")
    if file.exists():
        raise InputError(f"{file}: is there already; name another file")
    with VehicleLink(connect, key, system).open() as wire:
        try:
            system = find_autopilot(wire, connect, timeout, lambda: False)
        except FlightEnded as error:
            raise LinkError(error.detail) from None
        autopilot = Autopilot()
        mission = _download(wire, system, MissionType.MISSION, autopilot)
        fence = _download(wire, system, MissionType.FENCE, autopilot)
        home = _home(wire, autopilot, timeout)
    items = [
        (item.command, item.frame, item.params, GeoPoint(item.latitude_deg, item.longitude_deg, item.altitude_m))
        for item in (*mission, *fence)
    ]
    try:
        with file.open("x", encoding="utf-8") as out:
            out.write(text_of(home, items))
    except OSError as error:
        raise InputError(f"{file}: cannot be written: {error.strerror}") from None
    document = {"file": str(file), "mission_items": len(mission), "fence_items": len(fence), "home": home._asdict()}
    if as_json:
        print(json.dumps(document, indent=2))
        return
    say(f"{file}: {len(mission)} mission items, {len(fence)} of the fence; look at it with `companion check`")


def _download(wire: Wire, system: int, kind: MissionType, autopilot: Autopilot) -> tuple[StoredItem, ...]:
    """One of the autopilot's lists; hears where home is meanwhile."""
    from companion.errors import LinkError
    from companion.flight.reports import take_report
    from companion.link.mission_download import Download

    download = Download(wire.send, system, kind, time.monotonic())
    while not download.done:
        for frame in wire.receive(WAIT_S):
            download.on_frame(frame, time.monotonic())
            take_report(autopilot, frame)
        download.update(time.monotonic())
        if download.failure:
            raise LinkError(download.failure)
    return download.items


def _home(wire: Wire, autopilot: Autopilot, timeout_s: float) -> Any:
    """Where the vehicle's home is on the Earth."""
    from companion.errors import LinkError
    from companion.flight.reports import take_report
    from companion.link.operations import Operations

    operations = Operations(wire.send, wire.system_id)
    begun_s = asked_s = time.monotonic()
    operations.request_message(HOME_POSITION, begun_s)
    while autopilot.home_global is None:
        now_s = time.monotonic()
        if now_s - begun_s > timeout_s:
            raise LinkError("the vehicle does not say where on the Earth its home is; has it a global position yet?")
        if now_s - asked_s >= HOME_RETRY_S:
            asked_s = now_s
            operations = Operations(wire.send, wire.system_id)  # asks anew: it may have refused while it had none
            operations.request_message(HOME_POSITION, now_s)
        for frame in wire.receive(WAIT_S):
            operations.on_frame(frame, now_s)
            take_report(autopilot, frame)
        operations.update(time.monotonic())
    return autopilot.home_global
