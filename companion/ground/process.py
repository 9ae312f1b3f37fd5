"""The ground process of `companion serve`: ground links, services, reports.

Nothing in it can hurt a flight: it has no way to the vehicle but through the control process, which lets harmless
messages pass and decides about requests itself. If it is killed, the supervisor starts another one.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import sys
import time
import traceback
from typing import Any, Final

from companion.errors import CompanionError, ExitCode, LinkError
from companion.ground.channel import Channel, Copy, Note
from companion.ground.commands import CommandServer
from companion.ground.hosting import Startable, file_server, open_store, parameter_server, tuned, tuning_of
from companion.ground.links import GroundPort
from companion.ground.messages import Severity, targets_of
from companion.ground.ports import Ports
from companion.ground.refusals import Guards, RefusalWatch
from companion.ground.report import Report
from companion.ground.reports import Reports
from companion.ground.service import GroundLink, Service
from companion.ground.settings import Settings
from companion.ground.standing import Standing
from companion.link.codec import message_formats
from companion.link.framing import Frame, FrameParser, LinkCounters
from companion.link.wire import COMPANION_COMPONENT

WAIT_MS: Final = 10
TICK_S: Final = 0.01
DEFAULT_SYSTEM: Final = 1
"""Ours while no vehicle was heard."""
_NICE: Final = 5
"""The control process goes first where both want a core."""
_ITEMS_MAX: Final = 64


class VehicleLink:
    """The way to ground tools through the autopilot's radio; implements `service.GroundLink`."""

    name = "vehicle"

    def __init__(self, channel: Channel) -> None:
        self._channel = channel

    def send(self, msgid: int, payload: bytes) -> None:
        """Asks the control process to send it; its filter decides."""
        self._channel.outgoing(msgid, payload)


class Ground:
    """The program.

    Args:
        settings: of `companion serve`.
        channel: to the control process; implements `commands.Requests` through `request`.
        report: to the supervisor.
        guards: the keys; they stay the caller's, who closes them however this ends.

    Raises:
        InputError, LinkError: a ground link or the folder cannot be used; after a restart a ground link is waited for.
    """

    def __init__(self, settings: Settings, channel: Channel, report: Report, guards: Guards) -> None:
        self._channel = channel
        self._report = report
        self._standing = Standing()
        self._systems = frozenset(settings.ground_systems)
        self._links = [
            GroundPort(connection, self._system, guards.of(key), self._systems)
            for connection, key in settings.ground_links
        ]
        self._vehicle = VehicleLink(channel)
        self._reports = Reports(self._links, self._vehicle, lambda: self._standing)
        self._reports.refused = lambda: sum(sum(reasons.values()) for reasons in self._refusals().values())
        for link in self._links:
            link.greeting = self._reports.heartbeat
        self._poll = select.poll()
        self._poll.register(channel.fileno(), select.POLLIN)
        self._ports = Ports(self._links, self._poll, self._say_verdict)
        self._ports.open(all_of_them=not settings.again)
        tuning = tuning_of(settings)
        store = open_store(tuned(settings, tuning.overrides))
        if store.problem:
            report.line(f"{store.problem}: see that no other `companion serve` uses it")
        self._commands = CommandServer(self, Startable(store), self._reports, self._system)
        self._files = file_server(store, self._say_verdict)
        self._parameters = parameter_server(settings, tuning, self, self._say_verdict, self._system)
        self._services: list[Service] = [self._commands, self._files, self._parameters]
        self._faults: set[str] = set()
        # What the control process has verified is verified again: what was used on another link is no news here.
        self._copied = LinkCounters()
        self._copies = FrameParser(message_formats(), self._copied, guards.of(settings.key))
        self._watch = RefusalWatch(self._report.line)
        self._stopping = False

    def request(self, number: int, what: str, **content: Any) -> bool:
        """Hands a request to the control process."""
        return self._channel.note(request=number, what=what, **content)

    def stop(self) -> None:
        """Ends the program; safe to call from a signal handler."""
        self._stopping = True

    def run(self) -> int:
        """Until told to stop, or until supervisor and control process are gone: a flight goes on without the one, and
        its operator must be able to end it."""
        self._report.send(ready=True)
        ticked_s = 0.0
        while not self._stopping:
            self._poll.poll(WAIT_MS)
            now_s = time.monotonic()
            for item in self._channel.receive(_ITEMS_MAX):
                if isinstance(item, Copy):
                    self._on_copy(item, now_s)
                elif isinstance(item, dict):
                    self._on_note(item, now_s)
            for frame, peer in self._ports.receive():
                self._dispatch(frame, peer, now_s)
            if now_s - ticked_s >= TICK_S:
                ticked_s = now_s
                self._tick(now_s)
        self._files.close()
        self._parameters.close()
        self._ports.close()
        return int(ExitCode.DONE)

    def _tick(self, now_s: float) -> None:
        for service in self._services:
            self._guarded(service, lambda service=service: service.tick(now_s))
        self._reports.tick(now_s)
        self._ports.tick(now_s)
        self._watch.tick(now_s, self._refusals())
        if self._channel.closed and self._report.closed:
            self._stopping = True

    def _on_copy(self, item: Copy, now_s: float) -> None:
        """A frame of the vehicle link: what is addressed to us came through the autopilot's radio."""
        frames: list[Frame] = []
        self._copies.parse(item.raw, time.monotonic_ns(), frames, [])
        for frame in frames:
            if frame.sysid == self._standing.system and frame.compid == 1:
                continue
            if frame.sysid in self._systems:
                self._dispatch(frame, self._vehicle, now_s)
            else:
                self._copied.other_system += 1

    def _refusals(self) -> dict[str, dict[str, int]]:
        """What was refused so far, by link and reason."""
        radio = {**self._standing.refused, "through_the_radio": self._copied.other_system + self._copied.bad_signature}
        return {"the vehicle link": radio, **{port.connection: port.refusals for port in self._links}}

    def _dispatch(self, frame: Frame, link: GroundLink, now_s: float) -> None:
        targets = targets_of(frame.msgid, frame.payload)
        if targets is None:
            return
        if targets.component not in {0, COMPANION_COMPONENT} or targets.system not in {0, self._system()}:
            return
        for service in self._services:
            if self._guarded(service, lambda service=service: service.handle(frame, link, now_s)):
                return

    def _guarded(self, service: Service, call: Any) -> Any:
        """A service that fails on some bytes goes on with the next ones, and the others do not notice."""
        try:
            return call()
        except Exception as error:
            where = f"{type(service).__name__}: {type(error).__name__}: {error}"
            if where not in self._faults:
                self._faults.add(where)
                traceback.print_exc()
                self._report.line(f"a fault of the program: {where}")
            return False

    def _on_note(self, note: Note, now_s: float) -> None:
        if "standing" in note:
            self._on_standing(note["standing"])
        elif "line" in note:
            severity = Severity.WARNING if note.get("warning") else Severity.INFO
            self._reports.say(severity, str(note["line"]))
        elif "taken" in note:
            number, refusal = int(note["taken"]), str(note.get("refusal", ""))
            if not self._parameters.on_taken(number, refusal, now_s):
                self._commands.on_taken(number, refusal, now_s)
        elif "done" in note:
            sentence = str(note.get("sentence", ""))
            self._commands.on_done(int(note["done"]), bool(note.get("well")), sentence, now_s)

    def _on_standing(self, content: Any) -> None:
        before = self._standing
        with contextlib.suppress(TypeError, ValueError):
            self._standing = Standing.from_note(content)
        if before.custom_code != self._standing.custom_code or before.system != self._standing.system:
            self._reports.beat()

    def _say_verdict(self, sentence: str, accepted: bool) -> None:
        self._reports.say(Severity.INFO if accepted else Severity.WARNING, sentence)
        self._report.line(sentence)

    def _system(self) -> int:
        return self._standing.system or DEFAULT_SYSTEM


def main() -> int:
    """Arguments: settings (JSON), file descriptors of the channel and of the supervisor's."""
    settings, channel_fd, report_fd = sys.argv[1:]
    report = Report(socket.socket(fileno=int(report_fd)))
    channel = Channel(socket.socket(fileno=int(channel_fd)))
    channel.discard()
    os.nice(_NICE)
    guards = Guards()
    try:
        ground = Ground(Settings.from_json(settings), channel, report, guards)
        for number in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, lambda *_: ground.stop())
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the supervisor says when
        return ground.run()
    except (CompanionError, LinkError) as error:
        report.send(error=str(error))
        return int(error.exit_code)
    except Exception as error:
        traceback.print_exc()
        report.send(error=f"a fault of the program: {type(error).__name__}: {error}")
        return int(ExitCode.INTERNAL)
    finally:
        guards.close()


if __name__ == "__main__":
    sys.exit(main())
