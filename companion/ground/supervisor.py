"""Starts the two processes of `companion serve` and starts them again when they die; does nothing else.

It holds both ends of the pair of sockets between them, so that either process, killed and started again, finds the
other one at the same place. It is the only one that starts processes: a control turn never pays for that.
"""

from __future__ import annotations

import json
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any, Final

from companion.errors import CompanionError, ExitCode
from companion.ground.settings import Settings

POLL_MS: Final = 100
RESTART_S: Final = 0.2
RESTART_MAX_S: Final = 5.0
STEADY_S: Final = 10.0
"""A process that ran for so long gets the short delay again."""
END_TIMEOUT_S: Final = 30.0
"""For handing over and writing the results."""

CONTROL, GROUND = "companion.ground.control", "companion.ground.process"


class _Child:
    """One of the two processes."""

    def __init__(self, name: str, module: str, settings: Settings, end: socket.socket) -> None:
        self.name = name
        self.ready = False
        """Whether this one has said that it works."""
        self.ever_ready = False
        self.error = ""
        """What it said last before it ended by itself."""
        self.process: subprocess.Popen[bytes] | None = None
        self.report: socket.socket | None = None
        self.due_s = 0.0
        self._module, self._settings, self._end = module, settings, end
        self._delay_s = RESTART_S
        self._begun_s = 0.0

    def start(self) -> None:
        """Starts it."""
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        ours.setblocking(False)
        with theirs:
            descriptors = (self._end.fileno(), theirs.fileno())
            settings = replace(self._settings, again=self.ever_ready)
            self.process = subprocess.Popen(
                [sys.executable, "-m", self._module, settings.as_json(), *map(str, descriptors)],
                pass_fds=descriptors,
                stdin=subprocess.DEVNULL,
                stdout=sys.stderr,
                start_new_session=True,  # Ctrl-C in the terminal reaches it once, through here
            )
        self.report, self.ready, self.error = ours, False, ""
        self._begun_s = time.monotonic()

    def messages(self) -> list[dict[str, Any]]:
        """What it has said."""
        found: list[dict[str, Any]] = []
        while self.report is not None:
            try:
                data = self.report.recv(65536)
            except OSError:
                break
            if not data:
                break
            found.append(json.loads(data))
        return found

    def ended(self) -> int | None:
        """The exit code, once it has ended; then it is due again after a while."""
        if self.process is None:
            return None
        code = self.process.poll()
        if code is None:
            return None
        steady = time.monotonic() - self._begun_s > STEADY_S
        self._delay_s = RESTART_S if steady else min(2.0 * self._delay_s, RESTART_MAX_S)
        self.due_s = time.monotonic() + (RESTART_S if steady else self._delay_s)
        return code

    def forget(self) -> None:
        """After `ended`: nothing of it is left."""
        self.process = None
        if self.report is not None:
            self.report.close()
            self.report = None

    def signal(self, number: int) -> None:
        """Sends it a signal, if it is there."""
        if self.process is not None:
            with suppress(ProcessLookupError):
                self.process.send_signal(number)


class Supervisor:
    """The two processes.

    Args:
        settings: of `companion serve`.
        tell: gets lines for people; must neither raise nor wait, or it would end a flight or leave a process dead.
        ready: called once, when both work; with their process ids; no more than `tell` may it raise or wait.
    """

    def __init__(self, settings: Settings, tell: Callable[[str], None], ready: Callable[[int, int], None]) -> None:
        self._tell = tell
        self._on_ready = ready
        control_end, ground_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._control = _Child("control process", CONTROL, settings, control_end)
        self._ground = _Child("ground process", GROUND, settings, ground_end)
        self._children = (self._control, self._ground)
        self._signal = 0
        self._told_ready = False

    def stop(self, number: int) -> None:
        """Ends everything, after handing over; safe to call from a signal handler."""
        self._signal = number

    def run(self) -> int:
        """Until a signal comes. Returns the exit code.

        Raises:
            CompanionError: one of the processes cannot begin: a port in use, a wrong name.
        """
        try:
            for child in self._children:
                child.start()
            while not self._signal:
                self._turn()
        finally:
            self._end()
        return int(ExitCode.INTERRUPTED if self._signal == signal.SIGINT else ExitCode.DONE)

    def _turn(self) -> None:
        poll = select.poll()
        for child in self._children:
            if child.report is not None:
                poll.register(child.report.fileno(), select.POLLIN)
        with suppress(InterruptedError):
            poll.poll(POLL_MS)
        for child in self._children:
            self._listen(child)
            code = child.ended()
            if code is not None:
                self._listen(child)
                child.forget()
                self._bury(child, code)
            elif child.process is None and time.monotonic() >= child.due_s:
                child.start()
        if not self._told_ready and all(child.ready for child in self._children):
            self._told_ready = True
            pids = [child.process.pid for child in self._children if child.process is not None]
            self._on_ready(*pids)

    def _listen(self, child: _Child) -> None:
        for message in child.messages():
            if "line" in message:
                self._tell(str(message["line"]))
            if "flight" in message:
                self._tell(f"flight folder: {message['flight']}")
            if "error" in message:
                child.error = str(message["error"])
            if "ready" in message:
                if child.ever_ready:
                    self._tell(f"the {child.name} is back")
                child.ready = child.ever_ready = True

    def _bury(self, child: _Child, code: int) -> None:
        """One of the processes has ended by itself.

        Raises:
            CompanionError: it never worked: starting it again would not help.
        """
        how = f"was ended by signal {-code}" if code < 0 else f"ended with code {code}"
        why = f": {child.error}" if child.error else ""
        if not child.ever_ready:
            error = CompanionError(child.error or f"the {child.name} {how} before it was ready; see above")
            error.exit_code = code if code > 0 else int(ExitCode.INTERNAL)
            raise error
        self._tell(f"the {child.name} {how}{why}; it is started again")

    def _end(self) -> None:
        """The control process hands over first; the ground process is there until it has."""
        for child in self._children:
            child.signal(signal.SIGTERM)
            if child.process is not None:
                try:
                    child.process.wait(END_TIMEOUT_S)
                except subprocess.TimeoutExpired:
                    child.signal(signal.SIGKILL)
                    child.process.wait()
            self._listen(child)
            child.forget()
