"""Handing over to the autopilot's Hold when the ordinary way is gone.

The loop hands over on vehicle time, through its sequence. When the loop itself failed, the vehicle's clock stands still
or the autopilot restarted, this does the same with nothing but the link and the wall clock.
"""

from __future__ import annotations

import time

from companion.errors import LinkError
from companion.flight.connect import AUTOPILOT_COMPONENT
from companion.flight.preflight import CURRENT_MODE
from companion.link import codec, modes, timesync
from companion.link.framing import Frame
from companion.link.modes import Mode
from companion.link.operations import Command
from companion.link.wire import Wire

INTERVAL_NS = 100_000_000
TIMEOUT_NS = 3_000_000_000
"""Longer than COM_OF_LOSS_T: afterwards the autopilot's own failsafe has acted."""
WAIT_S = 0.02
_ACCEPTED = 0


def ask_for_hold(wire: Wire, system: int) -> bool:
    """Asks for Hold every 100 ms of wall time until it is acknowledged or seen, another mode is, or time is up.

    Args:
        wire: the link.
        system: the autopilot's system id.

    Returns:
        Whether the autopilot has taken Hold.
    """
    begun_ns = time.monotonic_ns()
    asked_ns = begun_ns - INTERVAL_NS
    params = (1.0, float(modes.HOLD.main), float(modes.HOLD.sub), 0.0, 0.0, 0.0, 0.0)
    asked = 0
    try:
        while (wall_ns := time.monotonic_ns()) - begun_ns < TIMEOUT_NS:
            if wall_ns - asked_ns >= INTERVAL_NS:
                asked_ns = wall_ns
                payload = codec.encode_command_long(
                    system, AUTOPILOT_COMPONENT, Command.DO_SET_MODE, min(asked, 255), params
                )
                wire.send(codec.COMMAND_LONG, payload)
                asked += 1
            for frame in wire.receive(WAIT_S):
                taken = _taken(frame, wire, system)
                if taken is not None:
                    return taken
    except LinkError:  # the line is gone: nothing can be asked for
        return False
    return False


def _taken(frame: Frame, wire: Wire, system: int) -> bool | None:
    """True: the autopilot is in Hold. False: somebody else chose another mode. None: not known yet."""
    if frame.sysid != system or frame.compid != AUTOPILOT_COMPONENT:
        return None
    if frame.msgid == codec.COMMAND_ACK:
        ack = codec.decode_command_ack(frame.payload)
        return True if ack.command == Command.DO_SET_MODE and ack.result == _ACCEPTED else None
    if frame.msgid == codec.TIMESYNC:  # a vehicle in lockstep would wait for the answer
        message = codec.decode_timesync(frame.payload)
        if timesync.is_request(message, wire.system_id, wire.component_id):
            wire.send(codec.TIMESYNC, timesync.answer(message, time.monotonic_ns(), frame.sysid, frame.compid))
        return None
    mode = reported_mode(frame)
    if mode is None or mode == modes.OFFBOARD:
        return None
    return mode == modes.HOLD


def reported_mode(frame: Frame) -> Mode | None:
    """The mode that a HEARTBEAT or CURRENT_MODE of the autopilot reports; None for other messages."""
    if frame.msgid == codec.HEARTBEAT:
        return Mode.from_custom_mode(codec.decode_heartbeat(frame.payload).custom_mode)
    if frame.msgid == CURRENT_MODE:
        message = codec.decode_cold(frame)
        if message is not None:
            return Mode.from_custom_mode(message.custom_mode)
    return None
