"""Finding the autopilot on a link: its first heartbeat, and the explanation when none comes."""

from __future__ import annotations

import time
from collections.abc import Callable

from companion.flight.phases import Cause, FlightEnded
from companion.link import codec
from companion.link.framing import Frame
from companion.link.wire import Wire

AUTOPILOT_COMPONENT = codec.AUTOPILOT_COMPONENT
WAIT_S = 0.1
HEARTBEAT_INTERVAL_NS = 1_000_000_000
PEER_PATIENCE_NS = 2_000_000_000
"""A peer that sends no autopilot's heartbeat for this long (they come every second) is no vehicle; then the other
sender at the port, if there is one, gets its turn."""


def send_heartbeat(wire: Wire) -> None:
    """A companion's heartbeat; PX4 locks on to the first sender of anything."""
    wire.send(
        codec.HEARTBEAT,
        codec.encode_heartbeat(
            codec.MAV_TYPE_ONBOARD_CONTROLLER, codec.MAV_AUTOPILOT_INVALID, 0, 0, codec.MAV_STATE_ACTIVE
        ),
    )


def find_autopilot(wire: Wire, connection: str, timeout_s: float, interrupted: Callable[[], bool]) -> int:
    """Waits for a heartbeat of PX4 and answers it.

    Args:
        wire: the open link.
        connection: what to call it.
        timeout_s: how long to wait [s, wall time].
        interrupted: whether the operator wants to stop.

    Returns:
        The vehicle's system id.

    Raises:
        FlightEnded: none came, another autopilot answered, or the operator stopped.
        LinkError: the line is gone.
    """
    begun_ns = time.monotonic_ns()
    speaks_first = wire.peer is not None  # udpout: nobody knows of us before we say something
    spoken_ns: int | None = None
    peer_since_ns = begun_ns
    while True:
        wall_ns = time.monotonic_ns()
        if interrupted():
            raise FlightEnded(Cause.INTERRUPTED, "before a vehicle was found")
        if wall_ns - begun_ns > timeout_s * 1e9:
            raise FlightEnded(Cause.NO_VEHICLE, _explain_silence(wire, connection, timeout_s))
        if speaks_first and (spoken_ns is None or wall_ns - spoken_ns > HEARTBEAT_INTERVAL_NS):
            spoken_ns = wall_ns
            send_heartbeat(wire)
        frames = wire.receive(WAIT_S)
        for number, frame in enumerate(frames):
            system = None if wire.only_system not in {None, frame.sysid} else autopilot_system(frame)
            if system is not None:
                wire.system_id = system
                send_heartbeat(wire)
                if wire.signed:  # a vehicle in lockstep that was told the time waits for the answer to one of them
                    wire.keep(frames[:number] + frames[number + 1 :])
                return system
        if wall_ns - peer_since_ns > PEER_PATIENCE_NS:
            peer_since_ns = wall_ns
            wire.try_another_peer()


def autopilot_system(frame: Frame) -> int | None:
    """The system id of an autopilot whose heartbeat this is.

    Raises:
        FlightEnded: it is an autopilot, but not PX4.
    """
    if frame.msgid != codec.HEARTBEAT or frame.compid != AUTOPILOT_COMPONENT:
        return None
    autopilot = codec.decode_heartbeat(frame.payload).autopilot
    if autopilot == codec.MAV_AUTOPILOT_INVALID:
        return None
    if autopilot != codec.MAV_AUTOPILOT_PX4:
        raise FlightEnded(
            Cause.REFUSED,
            f"the autopilot of system {frame.sysid} is not PX4 (MAV_AUTOPILOT {autopilot}): modes and setpoints mean"
            " other things there",
        )
    return frame.sysid


def _explain_silence(wire: Wire, connection: str, timeout_s: float) -> str:
    received = wire.counters.received
    seen = f"{received} MAVLink frames came, none of them an autopilot's heartbeat," if received else "nothing came"
    others = f"; {wire.last_foreign[0]}:{wire.last_foreign[1]} sends there as well" if wire.last_foreign else ""
    refused = {reason.replace("_", " "): count for reason, count in wire.refusals.items() if count}
    if refused and wire.signed:
        told = ", ".join(f"{count} {reason}" for reason, count in refused.items())
        others += f"; refused: {told} (has the autopilot this key? `companion key install`)"
    if wire.only_system is not None:
        others += f"; only system {wire.only_system} is listened to"
    return (
        f"{seen} at {connection} within {timeout_s:g} s{others}: check that the vehicle sends to this port (PX4 SITL:"
        " 14540; the bundled one: `sim-link run`), or name another with --connect"
    )


def explain_no_time(connection: str, timeout_s: float) -> str:
    """An autopilot is there but tells nothing that a flight could begin with."""
    return (
        f"an autopilot's heartbeat came at {connection} but neither TIMESYNC nor ODOMETRY within {timeout_s:g} s: is"
        " this its onboard link (PX4: MAV_x_MODE 2)?"
    )
