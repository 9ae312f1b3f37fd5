"""The parameter server at component 191: gains, limits and heading, seen and changed from any ground station.

A PARAM_SET goes through the gates of a flight (`trial`), then to the control process, which takes it or says why not,
then to the disk, and is answered by PARAM_VALUE to everybody who asks for parameters here. What is refused is answered
by PARAM_ERROR and by PARAM_VALUE with the value that stays; the reason goes out as STATUSTEXT. All of it is done within
half a second, in which most clients ask again. One change is dealt with at a time, the others wait.

Like PX4 the server is strict about types and bytewise about values. What is for every component is answered only as
far as the names are ours, so that nobody is told that the autopilot's parameters do not exist.
"""

from __future__ import annotations

import time
import traceback
import zlib
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Protocol

from companion.errors import InputError
from companion.ground.pacing import Pace
from companion.ground.parameter_file import save_tuning
from companion.ground.parameter_messages import (
    NO_INDEX,
    PARAM_REQUEST_LIST,
    PARAM_SET,
    ParameterError,
    ReadRequest,
    SetRequest,
    decode_list,
    decode_read,
    decode_set,
    encode_error,
    encode_value,
    name_of,
)
from companion.ground.service import GroundLink
from companion.ground.trial import Court, InThread, Trial
from companion.ground.tuning import ENTRIES, INT32, RAMPS, Entry, Tuning, find, pack, unpack
from companion.link import codec
from companion.link.framing import Frame
from companion.link.wire import COMPANION_COMPONENT

WHAT: Final = "parameters"
"""What a request to the control process is called; its content is `change`, a `ParameterChange`."""
RESET: Final = "OC_RESET"
"""Set to 1 it brings all values back to the vehicle file's, and is 0 again."""
HASH: Final = "_HASH_CHECK"
"""Pseudo parameter, as PX4's: a checksum of all names and values, read by name; setting it ends a list."""

TAKEN_TIMEOUT_S: Final = 0.25
"""For the control process to take a change."""
TELL_AGAIN_S: Final = 1.0
"""Between attempts to tell a control process, that did not answer or was busy, what holds."""
LIST_BURST: Final = 10
"""Values of a list that go out at a time; `pacing` may let fewer pass."""
WAITING_MAX: Final = 64
LINKS_MAX: Final = 16
"""Ways to ground tools that are told of changes; the one that was silent longest is forgotten."""

_UINT32 = 5
_RESET_INDEX = sum(entry.name < RESET for entry in ENTRIES)
_NAMES: Final = (*(e.name for e in ENTRIES[:_RESET_INDEX]), RESET, *(e.name for e in ENTRIES[_RESET_INDEX:]))
"""In the order of their indices."""
COUNT: Final = len(_NAMES)
_INDEX: Final = {name: index for index, name in enumerate(_NAMES)}


class Requests(Protocol):
    """The way to the control process."""

    def request(self, number: int, what: str, **content: Any) -> bool:
        """Hands over a request; False when it could not be."""
        ...


@dataclass(eq=False)
class _Job:
    """A PARAM_SET on its way."""

    name: str
    raw: bytes
    askers: dict[tuple[str, int, int], GroundLink] = field(default_factory=dict)
    """Who waits for the answer, by link, system and component."""
    wanted: Tuning | None = None
    trial: Trial | None = None
    number: int = 0
    """Of the request to the control process; 0 before it."""
    until_s: float = 0.0


class ParameterServer:
    """Implements `service.Service` for the parameter protocol.

    Args:
        tuning: what holds at the start.
        path: of the file that keeps changes.
        requests: the way to the control process.
        say: gets sentences for people, and whether they are good news.
        system: asked for the vehicle's system id.
        court: who judges changes.
    """

    def __init__(
        self,
        tuning: Tuning,
        path: Path,
        requests: Requests,
        say: Callable[[str, bool], None],
        system: Callable[[], int],
        court: Court | None = None,
    ) -> None:
        self.tuning = tuning
        """What holds now."""
        self._path = path
        self._requests = requests
        self._say = say
        self._system = system
        self._court: Court = InThread(tuning) if court is None else court
        self._pace = Pace()
        self._links: dict[str, GroundLink] = {}
        self._lists: dict[str, int] = {}
        """Index of the next value of the list that goes out, by link."""
        self._waiting: deque[_Job] = deque()
        self._job: _Job | None = None
        self._number = -time.monotonic_ns()  # no number of a command, and none of this process's predecessor
        self._told = 0
        """Number of the request that tells the control process what holds; 0: it knows."""
        self._tell_s: float | None = -1e9
        """When to tell it again; None: it knows. At the start it may know what a process before this one wanted."""

    # -- the service ----------------------------------------------------------------------------------------------

    def handle(self, frame: Frame, link: GroundLink, now_s: float) -> bool:
        """Takes a message of the parameter protocol that is for us or for everybody."""
        asker = (frame.sysid, frame.compid)
        if frame.msgid == codec.PARAM_REQUEST_READ:
            read = decode_read(frame.payload)
            if self._ours(read.system, read.component):
                self._remember(link)
                self._read(read, asker, link)
                return True
        elif frame.msgid == PARAM_REQUEST_LIST:
            if self._ours(*decode_list(frame.payload)):
                self._remember(link)
                self._lists[link.name] = 0
                self._go_on(link, now_s)
                return True
        elif frame.msgid == PARAM_SET:
            wanted = decode_set(frame.payload)
            if wanted.system == self._system() and self._ours(wanted.system, wanted.component):
                self._remember(link)
                self._set(wanted, asker, link, now_s)
                return True
        return False

    def tick(self, now_s: float) -> None:
        """Goes on with lists and with the change that is under way."""
        for name in list(self._lists):
            self._go_on(self._links[name], now_s)
        self._work(now_s)
        if self._job is None and self._tell_s is not None and now_s >= self._tell_s:
            self._tell_s = now_s + TELL_AGAIN_S
            self._told = self._next_number()
            self._requests.request(self._told, WHAT, change=self.tuning.change.as_note())

    def on_taken(self, number: int, refusal: str, now_s: float) -> bool:
        """The control process has a request, or refuses it with a sentence; False when the request was not ours."""
        job = self._job
        if job is not None and number == job.number:
            if refusal:
                self._refuse(job, ParameterError.PERMISSION_DENIED, refusal)
            else:
                self._keep(job, now_s)
            return True
        if number == self._told:
            self._told = 0
            if not refusal:
                self._tell_s = None
            return True
        return number < 0

    def close(self) -> None:
        """Ends what runs."""
        self._court.close()

    # -- reading --------------------------------------------------------------------------------------------------

    def _ours(self, system: int, component: int) -> bool:
        return component in {0, COMPANION_COMPONENT} and system in {0, self._system()}

    def _remember(self, link: GroundLink) -> None:
        self._links.pop(link.name, None)
        self._links[link.name] = link
        while len(self._links) > LINKS_MAX:
            silent = next(iter(self._links))
            del self._links[silent]
            self._lists.pop(silent, None)

    def _read(self, read: ReadRequest, asker: tuple[int, int], link: GroundLink) -> None:
        named = read.number < 0
        name = name_of(read.id) if named else (_NAMES[read.number] if read.number < COUNT else "")
        if not named and read.component == 0:
            return  # the index counts in another component's list
        if name == HASH and read.component == COMPANION_COMPONENT:
            link.send(codec.PARAM_VALUE, encode_value(HASH, self._hash(), _UINT32, NO_INDEX, COUNT))
        elif name in _INDEX:
            link.send(codec.PARAM_VALUE, self._value(name))
        elif read.component == COMPANION_COMPONENT:
            error = encode_error(asker, read.id, read.number, ParameterError.DOES_NOT_EXIST)
            link.send(codec.PARAM_ERROR, error)

    def _value(self, name: str) -> bytes:
        entry = find(name)
        raw, kind = (pack(0), INT32) if entry is None else (self.tuning.wire(entry), entry.type)
        return encode_value(name, raw, kind, _INDEX[name], COUNT)

    def _hash(self) -> bytes:
        crc = 0
        for entry in ENTRIES:
            crc = zlib.crc32(self.tuning.wire(entry), zlib.crc32(entry.name.encode(), crc))
        return crc.to_bytes(4, "little")

    def _go_on(self, link: GroundLink, now_s: float) -> None:
        """Sends of a list what the link takes now."""
        index = self._lists[link.name]
        for _ in range(LIST_BURST):
            if not self._pace.take(link.name, now_s):
                break
            link.send(codec.PARAM_VALUE, self._value(_NAMES[index]))
            index += 1
            if index == COUNT:
                del self._lists[link.name]
                return
        self._lists[link.name] = index

    # -- setting --------------------------------------------------------------------------------------------------

    def _set(self, request: SetRequest, asker: tuple[int, int], link: GroundLink, now_s: float) -> None:
        name = name_of(request.id)
        if name == HASH:
            self._lists.pop(link.name, None)  # the client has the list already
            return
        if name not in _INDEX:
            if request.component == COMPANION_COMPONENT:
                error = encode_error(asker, request.id, -1, ParameterError.DOES_NOT_EXIST)
                link.send(codec.PARAM_ERROR, error)
            return
        key = (link.name, *asker)
        for job in (self._job, *self._waiting):
            if job is not None and (job.name, job.raw) == (name, request.raw):
                job.askers[key] = link  # asked again, the answer is on its way
                return
        job = _Job(name, request.raw, {key: link})
        if request.type != self._type(name):
            self._refuse(job, ParameterError.TYPE_MISMATCH, "")
        elif len(self._waiting) < WAITING_MAX:
            self._waiting.append(job)
            self._work(now_s)

    def _type(self, name: str) -> int:
        entry = find(name)
        return INT32 if entry is None else entry.type

    def _work(self, now_s: float) -> None:
        """Goes on with the change that is under way, and begins with the next one."""
        job = self._job
        if job is not None and job.trial is not None:
            self._follow_trial(job, job.trial, now_s)
        elif job is not None and job.number and now_s >= job.until_s:
            self._refuse(job, ParameterError.PERMISSION_DENIED, "the control process does not answer; try again")
            self._tell_s = now_s  # it may have taken the change all the same
        while self._job is None and self._waiting:
            self._begin(self._waiting.popleft())

    def _begin(self, job: _Job) -> None:
        try:
            job.wanted = self._wanted(job)
        except InputError as error:
            self._refuse(job, ParameterError.VALUE_OUT_OF_RANGE, str(error))
            return
        if job.wanted.changes == self.tuning.changes:
            self._answer(job, [job.name])
            return
        self._job = job
        job.trial = self._court.begin(self.tuning, job.wanted)

    def _wanted(self, job: _Job) -> Tuning:
        """What holds after the change. Raises InputError when its value cannot be."""
        entry = find(job.name)
        if entry is not None:
            return self.tuning.changed(entry, unpack(entry.type, job.raw))
        value = unpack(INT32, job.raw)
        if value not in {0, 1}:
            raise InputError(f"{RESET} = {value} must be 1 to bring the vehicle file's values back")
        return Tuning(self.tuning.base) if value else self.tuning

    def _follow_trial(self, job: _Job, trial: Trial, now_s: float) -> None:
        try:
            refusal = trial.poll()
        except Exception as error:  # a fault of the arithmetic is a refusal, not the end of the service
            traceback.print_exc()
            refusal = f"a fault of the program: {type(error).__name__}: {error}"
        if refusal is None:
            return
        job.trial = None
        if refusal:
            self._refuse(job, ParameterError.VALUE_OUT_OF_RANGE, refusal)
            return
        assert job.wanted is not None
        job.number, job.until_s = self._next_number(), now_s + TAKEN_TIMEOUT_S
        if not self._requests.request(job.number, WHAT, change=job.wanted.change.as_note()):
            self._refuse(job, ParameterError.PERMISSION_DENIED, "the control process cannot be reached; try again")

    def _keep(self, job: _Job, now_s: float) -> None:
        """The control process has taken it: on the disk, it holds."""
        assert job.wanted is not None
        try:
            save_tuning(self._path, job.wanted)
        except OSError as error:
            self._tell_s = now_s
            self._refuse(
                job, ParameterError.PERMISSION_DENIED, f"{self._path.name} cannot be written ({error.strerror})"
            )
            return
        before, self.tuning = self.tuning, job.wanted
        self._tell_s = None
        changed = [entry for entry in ENTRIES if before.value(entry) != self.tuning.value(entry)]
        self._answer(job, [*(entry.name for entry in changed if entry.name != job.name), job.name])
        for entry in changed:
            self._say(self._sentence(entry, before), True)

    def _sentence(self, entry: Entry, before: Tuning) -> str:
        when = "" if entry.in_flight == RAMPS else ", from the next flight on"
        return f"{entry.name} = {self.tuning.value(entry):g} (was {before.value(entry):g}){when}"

    def _answer(self, job: _Job, names: list[str]) -> None:
        """Tells everybody the values of these parameters."""
        self._job = None if self._job is job else self._job
        askers = {link.name: link for link in job.askers.values()}
        for link in (askers | self._links).values():
            if job.name == RESET:  # the answer is the value that was set; then it is 0 again
                link.send(codec.PARAM_VALUE, encode_value(RESET, job.raw, INT32, _INDEX[RESET], COUNT))
            for name in names:
                link.send(codec.PARAM_VALUE, self._value(name))

    def _refuse(self, job: _Job, error: ParameterError, sentence: str) -> None:
        """Tells who asked that it stays as it is. The error goes first: some clients take any value for an answer."""
        self._job = None if self._job is job else self._job
        if sentence:
            self._say(f"{job.name} refused: {sentence}", False)
        for (_, *asker), link in job.askers.items():
            system, component = asker
            id_ = job.name.encode("ascii").ljust(16, b"\0")
            link.send(codec.PARAM_ERROR, encode_error((system, component), id_, -1, error))
            link.send(codec.PARAM_VALUE, self._value(job.name))

    def _next_number(self) -> int:
        self._number -= 1
        return self._number


__all__ = ["COUNT", "HASH", "RESET", "WHAT", "ParameterServer"]
