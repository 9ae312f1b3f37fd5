"""The operator's side of `companion serve`: the calls of the command line as a typed Python class.

It talks to component 191 as system 254, component 190, over a ground link of the companion or through the autopilot's
radio. It sends no heartbeat: the autopilot would take it for a ground station's and not notice that the pilot's is
gone.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Final

from companion.control.types import Vec3
from companion.errors import InputError, LinkError, RefusedError
from companion.ground.commands import UserCommand
from companion.ground.fetch import Reader
from companion.ground.ftp import INDEX_NAME
from companion.ground.messages import (
    DEBUG_VECT,
    NAMED_VALUE_FLOAT,
    AckResult,
    decode_debug_vect,
    decode_named_value,
)
from companion.ground.reports import DISTURBANCE, ERROR, LYAPUNOV, REFUSED, TO_GO, TRACK_TIME
from companion.ground.standing import (
    ARMED_BIT,
    IDLE,
    PAUSED_BIT,
    PREPARING,
    VEHICLE_BIT,
    phase_of_code,
    trajectory_of_code,
)
from companion.link import codec
from companion.link.framing import Frame
from companion.link.statustext import Announcement, StatusTexts
from companion.link.wire import COMPANION_COMPONENT, Wire

SYSTEM: Final = 254
COMPONENT: Final = 190
DEFAULT_CONNECTION: Final = "udpout:127.0.0.1:14590"

REPEAT_S: Final = 0.5
ANSWER_TIMEOUT_S: Final = 5.0
"""Without any word about a command for this long, the companion counts as lost."""
FRESH_S: Final = 3.0
"""Older figures are not shown."""
_WAIT_S = 0.05


@dataclass(frozen=True)
class StoredTrajectory:
    """A trajectory on the vehicle."""

    id: int
    name: str
    crc32: int
    accepted: bool | None
    """Whether the vehicle's check lets it be flown; None: not checked yet."""
    verdict: str


@dataclass(frozen=True)
class Status:
    """What the companion says of itself; None where it says nothing (any more)."""

    system: int
    """The vehicle's system id."""
    vehicle: bool
    """Whether the companion hears an autopilot."""
    armed: bool
    phase: str
    """ "idle", "prepare", or the phase of the flight."""
    paused: bool
    trajectory_id: int
    """What is flown, or was flown last; 0: nothing yet."""
    track_time_s: float | None = None
    time_to_go_s: float | None = None
    """Of the whole course, at its own pace."""
    position_error_m: float | None = None
    lyapunov: float | None = None
    disturbance_m_s2: Vec3 | None = None
    """As estimated, NED."""
    refused_messages: int | None = None
    """Messages that it has not used because of who sent them: not signed with its key, replayed, of other systems."""

    @property
    def flying(self) -> bool:
        """Whether a flight is under way."""
        return self.phase not in {IDLE, PREPARING}


class Client:
    """Commands one companion. Not thread-safe; a context manager.

    Args:
        to: `udpout:HOST:PORT` of a ground link (default: this machine's), `udpin:0.0.0.0:14550` where the autopilot's
            radio arrives, or `serial:DEVICE:BAUD`.
        timeout_s: how long to wait for the companion.
        key: file with the key of that link, where it is signed.

    Raises:
        InputError, LinkError: the connection cannot be opened, or no companion answers.
    """

    def __init__(self, to: str = DEFAULT_CONNECTION, timeout_s: float = 5.0, key: str | Path | None = None) -> None:
        self._to = to
        self._wire = Wire.open(to, system_id=SYSTEM, component_id=COMPONENT, key=None if key is None else str(key))
        self._texts = StatusTexts()
        self._system: int | None = None
        self._code = 0
        self._beat_s = -math.inf
        self._figures: dict[str, tuple[float, float]] = {}
        self._disturbance: tuple[float, Vec3] | None = None
        try:
            self._find(timeout_s)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Closes the connection; a flight goes on."""
        self._wire.close()

    # -- commands -------------------------------------------------------------------------------------------------

    def start(self, trajectory: str | int) -> None:
        """Starts a trajectory by its name or id; returns once all gates have passed and the flight has begun.

        Raises:
            InputError: there is none of this name.
            RefusedError: a gate refuses, or something is being flown.
            LinkError: no answer came.
        """
        identity = trajectory if isinstance(trajectory, int) else self._identity(trajectory)
        self._command(UserCommand.START, float(identity), f"start {trajectory}")

    def pause(self) -> None:
        """Slows down to rest on the course and stays there; returns at rest. Raises as `start`."""
        self._command(UserCommand.DO_PAUSE_CONTINUE, 0.0, "pause")

    def resume(self) -> None:
        """Goes on after a pause; returns at the course's own pace. Raises as `start`."""
        self._command(UserCommand.DO_PAUSE_CONTINUE, 1.0, "resume")

    def stop(self) -> None:
        """Ends the flight: to rest on the course, then Hold; returns in Hold. Raises as `start`."""
        self._command(UserCommand.STOP, 0.0, "stop")

    def land(self) -> None:
        """Ends the flight, if there is one, and lands; returns when the autopilot is landing. Raises as `start`."""
        self._command(UserCommand.NAV_LAND, 0.0, "land")

    # -- questions ------------------------------------------------------------------------------------------------

    @property
    def system(self) -> int:
        """The vehicle's system id."""
        assert self._system is not None
        return self._system

    @property
    def texts(self) -> list[Announcement]:
        """What the companion has said so far, oldest first."""
        return list(self._texts.texts)

    def trajectories(self) -> list[StoredTrajectory]:
        """What is on the vehicle.

        Raises:
            LinkError: no answer came.
            InputError: the companion has no list.
        """
        reader = Reader(self._exchange, self.system, COMPANION_COMPONENT, (SYSTEM, COMPONENT))
        try:
            entries = json.loads(reader.read(f"/{INDEX_NAME}"))["trajectories"]
            return [
                StoredTrajectory(e["id"], e["name"], e["crc32"], e.get("accepted"), e.get("verdict", ""))
                for e in entries
            ]
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f"the companion's list of trajectories cannot be read: {error}") from None

    def status(self, timeout_s: float = 1.5) -> Status:
        """How things stand now: waits for a fresh heartbeat, and for the figures while something is flown.

        Raises:
            LinkError: the companion is silent.
        """
        asked_s = time.monotonic()
        self._ask_for_heartbeat()
        while self._beat_s < asked_s:
            if time.monotonic() - asked_s > max(timeout_s, ANSWER_TIMEOUT_S):
                raise LinkError(f"the companion at {self._to} has fallen silent")
            self.update(_WAIT_S)
            if time.monotonic() - asked_s > REPEAT_S:
                self._ask_for_heartbeat()
        while self.latest.flying and self._age_s(ERROR) > timeout_s and time.monotonic() - asked_s < timeout_s:
            self.update(_WAIT_S)
        return self.latest

    @property
    def latest(self) -> Status:
        """How things stood when something last came."""
        disturbance = self._disturbance
        fresh = disturbance is not None and time.monotonic() - disturbance[0] < FRESH_S
        return Status(
            system=self.system,
            vehicle=bool(self._code & VEHICLE_BIT),
            armed=bool(self._code & ARMED_BIT),
            phase=phase_of_code(self._code),
            paused=bool(self._code & PAUSED_BIT),
            trajectory_id=trajectory_of_code(self._code),
            track_time_s=self._figure(TRACK_TIME),
            time_to_go_s=self._figure(TO_GO),
            position_error_m=self._figure(ERROR),
            lyapunov=self._figure(LYAPUNOV),
            disturbance_m_s2=disturbance[1] if fresh and disturbance is not None else None,
            refused_messages=round(self._figures[REFUSED][1]) if self._age_s(REFUSED) < FRESH_S else None,
        )

    @property
    def silent_s(self) -> float:
        """Time since the companion's last heartbeat [s]."""
        return time.monotonic() - self._beat_s

    def wait_for(self, *phases: str, timeout_s: float = 120.0) -> Status:
        """Waits until the flight is in one of these phases ("track", "hold", "idle", ...).

        Raises:
            LinkError: it did not come to that in time, or the companion fell silent.
        """
        end_s = time.monotonic() + timeout_s
        while True:
            self.update(_WAIT_S)
            now = self.latest
            if now.phase in phases:
                return now
            if self.silent_s > ANSWER_TIMEOUT_S:
                raise LinkError(f"the companion at {self._to} has fallen silent")
            if time.monotonic() > end_s:
                raise LinkError(f"the flight is in the phase {now.phase} and not {' or '.join(phases)}")

    def update(self, timeout_s: float) -> None:
        """Takes in what comes, waiting for this long at most.

        Raises:
            LinkError: the line is gone.
        """
        for frame in self._wire.receive(timeout_s):
            self._take(frame)
        self._texts.update(time.monotonic())

    # -- inside ---------------------------------------------------------------------------------------------------

    def _find(self, timeout_s: float) -> None:
        """Waits for a companion's heartbeat, asking for it: a `udpin` port learns of us that way."""
        begun_s = asked_s = time.monotonic()
        self._ask_for_heartbeat()
        while self._system is None:
            now_s = time.monotonic()
            if now_s - begun_s > timeout_s:
                raise LinkError(
                    f"no companion answers at {self._to} within {timeout_s:g} s: is `companion serve` running there,"
                    f" with this ground link (--ground)?{self._refusal()}"
                )
            if now_s - asked_s > REPEAT_S:
                asked_s = now_s
                self._ask_for_heartbeat()
            self.update(_WAIT_S)

    def _refusal(self) -> str:
        """Whether somebody answers whom we do not believe, or may not believe us."""
        if not self._wire.signed:
            return " Is the link signed (--key)?"
        told = ", ".join(f"{n} {reason.replace('_', ' ')}" for reason, n in self._wire.refusals.items() if n)
        return f" Refused here: {told}" if told else " Has it this key (--ground-key)?"

    def _ask_for_heartbeat(self) -> None:
        params = (float(codec.HEARTBEAT), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        payload = codec.encode_command_long(
            self._system or 0, COMPANION_COMPONENT, UserCommand.REQUEST_MESSAGE, 0, params
        )
        self._wire.send(codec.COMMAND_LONG, payload)

    def _identity(self, name: str) -> int:
        known = self.trajectories()
        found = [t for t in known if t.name == name] or [t for t in known if t.name.rsplit(".", 1)[0] == name]
        if len(found) == 1:
            return found[0].id
        names = ", ".join(t.name for t in (found or known)) or "none"
        problem = "more than one trajectory is" if found else "no trajectory is"
        raise InputError(f"{problem} called {name!r} on the vehicle; there are: {names}")

    def _command(self, command: UserCommand, first: float, what: str) -> None:
        """One command until its end."""
        asked_s = heard_s = time.monotonic()
        sent_s, tries, begun = -math.inf, 0, False

        def ours(frame: Frame) -> AckResult | None:
            if frame.msgid != codec.COMMAND_ACK or frame.compid != COMPANION_COMPONENT or frame.sysid != self.system:
                return None
            ack = codec.decode_command_ack(frame.payload)
            mine = (ack.target_system, ack.target_component) == (SYSTEM, COMPONENT)
            known = ack.result in AckResult.__members__.values()
            return AckResult(ack.result) if mine and ack.command == command and known else None

        while True:
            now_s = time.monotonic()
            if now_s - heard_s > ANSWER_TIMEOUT_S:
                raise LinkError(f"{what}: no answer from the companion at {self._to} within {ANSWER_TIMEOUT_S:g} s")
            if now_s - sent_s > (2.0 if begun else REPEAT_S):
                params = (first, *(math.nan,) * 6) if command == UserCommand.NAV_LAND else (first, *(0.0,) * 6)
                payload = codec.encode_command_long(self.system, COMPANION_COMPONENT, command, min(tries, 255), params)
                self._wire.send(codec.COMMAND_LONG, payload)
                sent_s, tries = now_s, tries + 1
            for frame in self._wire.receive(_WAIT_S):
                self._take(frame)
                result = ours(frame)
                if result is AckResult.IN_PROGRESS:
                    heard_s, sent_s, begun = time.monotonic(), time.monotonic(), True
                elif result is not None:
                    self._settle(result, what, asked_s)
                    return

    def _settle(self, result: AckResult, what: str, asked_s: float) -> None:
        """Raises RefusedError with the companion's reason, unless the command was accepted."""
        if result is AckResult.ACCEPTED:
            return
        reasons = self._texts.complaints(asked_s, time.monotonic())
        why = reasons[-1] if reasons else result.name.lower().replace("_", " ")
        raise RefusedError(why if why.startswith(what.split(maxsplit=1)[0]) else f"{what}: {why}")

    def _exchange(
        self, msgid: int, payload: bytes, answers: Callable[[Frame], bytes | None], timeout_s: float
    ) -> bytes | None:
        self._wire.send(msgid, payload)
        end_s = time.monotonic() + timeout_s
        while (left_s := end_s - time.monotonic()) > 0.0:
            for frame in self._wire.receive(left_s):
                self._take(frame)
                answer = answers(frame)
                if answer is not None:
                    return answer
        return None

    def _take(self, frame: Frame) -> None:
        known = bool(self._code & VEHICLE_BIT)  # before it has heard its vehicle, the companion only guesses its id
        if frame.compid != COMPANION_COMPONENT or (known and frame.sysid != self._system):
            return
        now_s = time.monotonic()
        if frame.msgid == codec.HEARTBEAT:
            heartbeat = codec.decode_heartbeat(frame.payload)
            if heartbeat.type == codec.MAV_TYPE_ONBOARD_CONTROLLER:
                self._system, self._code, self._beat_s = frame.sysid, heartbeat.custom_mode, now_s
        elif frame.msgid == codec.STATUSTEXT:
            self._texts.add(codec.decode_statustext(frame.payload), now_s)
        elif frame.msgid == NAMED_VALUE_FLOAT:
            name, value = decode_named_value(frame.payload)
            self._figures[name] = now_s, value
        elif frame.msgid == DEBUG_VECT:
            name, vector = decode_debug_vect(frame.payload)
            if name == DISTURBANCE:
                self._disturbance = now_s, vector

    def _age_s(self, name: str) -> float:
        return time.monotonic() - self._figures[name][0] if name in self._figures else math.inf

    def _figure(self, name: str) -> float | None:
        return self._figures[name][1] if self._age_s(name) < FRESH_S and self._flying else None

    @property
    def _flying(self) -> bool:
        return phase_of_code(self._code) not in {IDLE, PREPARING}
