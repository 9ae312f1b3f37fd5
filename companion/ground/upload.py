"""The file side of the Python client: upload a trajectory and get the vehicle's verdict, list and remove what is there.

    with Files("udpout:127.0.0.1:14590") as files:
        print(files.upload("lap.csv").verdict)

An upload that was cut off goes on where it ended when it is made again; what comes together is checked by its CRC-32.
"""

from __future__ import annotations

import builtins
import errno
import json
import random
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Final, NamedTuple

from companion.errors import CompanionError, InputError, LinkError, RefusedError
from companion.ground.exchange import OWN_COMPONENT, OWN_SYSTEM, Connection, Exchange, NakError, find_system
from companion.ground.ftp import DATA_MAX, EXPECTED, INDEX_NAME, RECEIVED, SIZE, Failure, Opcode, Packet, crc32
from companion.ground.names import StoreError, checked_name
from companion.link.wire import Wire

DEFAULT_CONNECTION: Final = "udpout:127.0.0.1:14590"
"""Where `companion serve` listens unless told otherwise."""
PATIENCE_S: Final = 10.0
VERDICT_PATIENCE_S: Final = 90.0
_POLL_S = 0.3
_RESUMES_MAX = 5
_UPLOAD_KEYS: Final = ("name", "size_bytes", "crc32", "state", "verdict", "id")

Progress = Callable[[int, int], object]
"""Told how many bytes of how many are there."""


class StoredFile(NamedTuple):
    """A trajectory on the vehicle."""

    id: int
    """Its number, which a start command carries."""
    name: str
    size_bytes: int
    crc32: int
    """As `ftp.crc32` computes it."""
    accepted: bool | None
    """What the vehicle's check said; None: not checked yet."""
    verdict: str
    """The same in words."""


class Verdict(NamedTuple):
    """How an upload ended."""

    name: str
    accepted: bool
    """Whether the vehicle stored the file; otherwise what had the name before is still there."""
    verdict: str
    """What the vehicle's check says, in words."""
    id: int | None
    """The stored file's number."""
    size_bytes: int
    crc32: int
    resumed_from: int
    """Bytes that were on the vehicle already from an upload that was cut off."""


class Files:
    """The trajectories on one vehicle."""

    def __init__(
        self,
        connection: str | Connection = DEFAULT_CONNECTION,
        *,
        system: int | None = None,
        key: str | None = None,
        patience_s: float = PATIENCE_S,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        """Find the vehicle.

        Args:
            connection: `udpout:HOST:PORT`, `udpin:HOST:PORT` or `serial:DEVICE:BAUD`, opened as system 254, component
                190; or a link that is open already, which stays the caller's.
            system: the vehicle's system id; by default that of the only one that answers.
            key: file with the key of that link, where it is signed.
            patience_s: how long nothing may come before the link counts as lost.
            clock: monotonic time [s].
            sleep: waits [s].

        Raises:
            InputError: the connection string is wrong, or several vehicles answer.
            LinkError: nobody answers.
        """
        self._own: Wire | None = None
        if isinstance(connection, str):
            self._own = Wire.open(connection, system_id=OWN_SYSTEM, component_id=OWN_COMPONENT, key=key)
        link: Connection = self._own or connection  # type: ignore[assignment]
        self._clock = clock
        self._sleep = sleep
        try:
            self.system = find_system(link, system, patience_s, clock)
        except BaseException:
            self.close()
            raise
        self._exchange = Exchange(link, self.system, patience_s, clock)
        self._session = random.randrange(1, 256)

    def list(self) -> list[StoredFile]:
        """What is stored, by number.

        Raises:
            LinkError: no answer.
        """
        return self._index()[0]

    def read(self, name: str) -> bytes:
        """The contents of a stored file, or of "index.json".

        Raises:
            InputError: there is none of that name.
            LinkError: no answer, or an incomplete one.
        """
        session = self._next_session()
        try:
            size = SIZE.unpack(self._exchange.ask(Opcode.OPEN_FILE_RO, name.encode(), session=session).data)[0]
            parts: dict[int, bytes] = {}
            requests = (
                Packet(0, session, Opcode.READ_FILE, min(DATA_MAX, size - at), 0, 0, at, b"")
                for at in range(0, size, DATA_MAX)
            )
            self._exchange.run(requests, lambda request, reply: parts.__setitem__(request.offset, reply.data))
            self._exchange.ask(Opcode.TERMINATE_SESSION, session=session)
        except NakError as nak:
            raise _explained(nak, name) from None
        data = b"".join(parts[at] for at in sorted(parts))
        if len(data) != size:
            raise LinkError(f"{name}: {len(data)} of {size} bytes came; try again")
        return data

    def remove(self, name: str) -> None:
        """Remove a stored file.

        Raises:
            InputError: there is none of that name.
            LinkError: no answer.
        """
        try:
            # the session means nothing here, but tells this wish from the same one a moment ago
            self._exchange.ask(Opcode.REMOVE_FILE, _checked(name).encode(), session=self._next_session())
        except NakError as nak:
            raise _explained(nak, name) from None

    def upload(
        self,
        path: str | Path,
        name: str | None = None,
        *,
        progress: Progress | None = None,
        verdict_patience_s: float = VERDICT_PATIENCE_S,
    ) -> Verdict:
        """Upload a file and wait for the vehicle's verdict.

        Args:
            path: a file of any trajectory format.
            name: what to call it on the vehicle; by default its own name.
            progress: told of every part that arrives.
            verdict_patience_s: how long the vehicle's check may take.

        Raises:
            InputError: the file cannot be read, or its name is none for the vehicle.
            RefusedError: the vehicle has no room, or somebody else uploads that file.
            LinkError: the link was lost; the same call goes on where this one ended.
        """
        from companion.trajectory.formats.reading import read_bytes

        return self.upload_bytes(
            read_bytes(Path(path)), name or Path(path).name, progress=progress, verdict_patience_s=verdict_patience_s
        )

    def upload_bytes(
        self,
        data: bytes,
        name: str,
        *,
        progress: Progress | None = None,
        verdict_patience_s: float = VERDICT_PATIENCE_S,
    ) -> Verdict:
        """Upload contents under a name; otherwise like `upload`."""
        name = _checked(name)
        checksum = crc32(data)
        resumed_from = 0
        for attempt in range(_RESUMES_MAX):
            try:
                session, begin = self._open(data, name)
                resumed_from = begin if attempt == 0 else resumed_from
                self._write(data, begin, session, progress)
                self._end(session, len(data), checksum)
                break
            except NakError as nak:
                if nak.failure != Failure.INVALID_SESSION:
                    raise _explained(nak, name) from None
        else:
            raise LinkError(f"{name}: the upload was broken off {_RESUMES_MAX} times; try again, it goes on from there")
        return self._verdict(name, len(data), checksum, resumed_from, verdict_patience_s)

    def close(self) -> None:
        """Close the link, if it was opened here."""
        if self._own is not None:
            self._own.close()

    def __enter__(self) -> Files:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # ---- the steps of an upload ------------------------------------------------------------------------------------

    def _open(self, data: bytes, name: str) -> tuple[int, int]:
        """A session for an upload, and how much of the file is there already."""
        session = self._next_session()
        reply = self._exchange.ask(Opcode.OPEN_FILE_WO, name.encode(), session=session)
        if len(reply.data) == RECEIVED.size:
            received, checksum = RECEIVED.unpack(reply.data)
            if received <= len(data) and checksum == crc32(data[:received]):
                return session, received
        self._exchange.ask(Opcode.CREATE_FILE, name.encode(), session=session)
        return session, 0

    def _write(self, data: bytes, begin: int, session: int, progress: Progress | None) -> None:
        """Bring the rest of the file over."""
        there = begin

        def blocks() -> Iterator[Packet]:
            for at in range(begin, len(data), DATA_MAX):
                block = data[at : at + DATA_MAX]
                yield Packet(0, session, Opcode.WRITE_FILE, len(block), 0, 0, at, block)

        def arrived(request: Packet, _: Packet) -> None:
            nonlocal there
            there += len(request.data)
            if progress is not None:
                progress(there, len(data))

        if progress is not None:
            progress(there, len(data))
        self._exchange.run(blocks(), arrived)

    def _end(self, session: int, size: int, checksum: int) -> None:
        """Say that this is the whole; a refusal is in the index, too."""
        try:
            self._exchange.ask(Opcode.TERMINATE_SESSION, EXPECTED.pack(size, checksum), session=session)
        except NakError as nak:
            if (nak.failure, nak.errno) != (Failure.FAIL_ERRNO, errno.EINVAL):
                raise

    def _verdict(self, name: str, size: int, checksum: int, resumed_from: int, patience_s: float) -> Verdict:
        """Wait for what the check says."""
        end_s = self._clock() + patience_s
        while True:
            for item in reversed(self._index()[1]):
                if (item["name"], item["size_bytes"], item["crc32"]) == (name, size, checksum):
                    break
            else:
                raise LinkError(f"{name}: arrived, but the vehicle knows no verdict (was it restarted?); try again")
            if item["state"] != "checking":
                accepted = item["state"] == "accepted"
                return Verdict(name, accepted, item["verdict"], item["id"], size, checksum, resumed_from)
            if self._clock() > end_s:
                raise LinkError(
                    f"{name}: arrived, but there is no verdict after {patience_s:.0f} s; see companion list"
                )
            self._sleep(_POLL_S)

    def _index(self) -> tuple[builtins.list[StoredFile], builtins.list[dict[str, Any]]]:
        """What is stored, and how the last uploads ended."""
        try:
            document = json.loads(self.read(INDEX_NAME))
            files = [StoredFile(*(item[key] for key in StoredFile._fields)) for item in document["trajectories"]]
            uploads = [{key: item[key] for key in _UPLOAD_KEYS} for item in document["uploads"]]
        except (ValueError, KeyError, TypeError, RecursionError):
            raise LinkError(
                f"system {self.system} sends an index that cannot be read; is it a companion of this version?"
            ) from None
        return files, uploads

    def _next_session(self) -> int:
        self._session = self._session % 255 + 1
        return self._session


def _checked(name: str) -> str:
    try:
        return checked_name(name.encode("utf-8", "surrogateescape"))
    except StoreError as error:
        raise InputError(f"{error}: choose another name") from None


_SENTENCES: Final[dict[int, tuple[type[CompanionError], str]]] = {
    errno.EDQUOT: (RefusedError, "the vehicle has no room for it: remove other files (companion list, remove)"),
    errno.ENOSPC: (RefusedError, "the vehicle's disk is full"),
    errno.EFBIG: (InputError, "is longer than what the vehicle takes"),
    errno.EBUSY: (RefusedError, "is being uploaded by somebody else; try again in a few seconds"),
    errno.EMFILE: (RefusedError, "the vehicle takes no more uploads at the same time; try again later"),
    errno.EAGAIN: (RefusedError, "did not arrive whole, or too many files wait to be checked; try again"),
}


def _explained(nak: NakError, name: str) -> CompanionError:
    """A refusal by the file server, for people."""
    if nak.failure == Failure.FILE_NOT_FOUND:
        return InputError(f"{name}: the vehicle has no such file; companion list shows what it has")
    if nak.failure == Failure.NO_SESSIONS_AVAILABLE:
        return RefusedError(f"{name}: the vehicle serves too many others; try again later")
    if nak.failure == Failure.FAIL_ERRNO and nak.errno in _SENTENCES:
        kind, sentence = _SENTENCES[nak.errno]
        return kind(f"{name}: {sentence}")
    what = Failure(nak.failure).name.lower().replace("_", " ") if nak.failure in set(Failure) else "no reason given"
    detail = f" ({errno.errorcode.get(nak.errno, nak.errno)})" if nak.errno else ""
    return RefusedError(f"{name}: the vehicle's file server refuses: {what}{detail}")
