"""The file server at component 191: MAVLink FTP over the trajectory store.

What the usual clients rely on, beside the letter of the protocol (docs/ftp.md has the details):

- a client chooses the session's number (MAVProxy never looks at the answer's) or takes the one answered (the others);
- QGroundControl ends an upload with ResetSessions, the others with TerminateSession: both end it, and the answer waits
  for the vehicle's verdict as long as the client has patience;
- MAVSDK repeats a lost request with a new sequence number, the others with the same: neither does a thing twice;
- MAVProxy and pymavlink keep several writes under way and repeat lost ones later, so blocks come in any order.

A name that something is refused for is never taken for a path: the store has one folder and no way out of it.
"""

from __future__ import annotations

import errno
from collections.abc import Callable
from typing import Final

from companion.ground.checks import Submission
from companion.ground.folder import Operation, RequestError, folder_operations
from companion.ground.ftp import (
    DATA_MAX,
    EXPECTED,
    FILE_TRANSFER_PROTOCOL,
    OFFSET_MAX,
    RECEIVED,
    SIZE,
    Failure,
    Opcode,
    Packet,
    ack,
    decode,
    encode,
    errno_data,
    nak,
)
from companion.ground.names import StoreError, checked_name, is_index
from companion.ground.pacing import Pace
from companion.ground.service import GroundLink
from companion.ground.sessions import Burst, Client, Ending, Reading, Session, burst_packet, close_quietly
from companion.ground.store import TrajectoryStore
from companion.link.framing import Frame
from companion.link.wire import COMPANION_COMPONENT

Say = Callable[[str, bool], None]
"""Told when an upload has its verdict or is not taken: a sentence for people, and whether the file was accepted."""

SESSION_IDLE_MAX_S: Final = 30.0
UPLOAD_IDLE_MAX_S: Final = 3.0
"""After this another client may upload under the same name."""
CLIENTS_MAX: Final = 32
SESSIONS_MAX: Final = 4
"""Per client; the one that was idle longest makes room."""
BURST_PACKETS: Final = 16
"""Answers to one BurstReadFile; then the client asks again, which paces a transfer by what the link takes."""
TERMINATE_PATIENCE_S: Final = 3.0
"""MAVSDK waits 5 s, pymavlink 3.7 s."""
RESET_PATIENCE_S: Final = 0.8
"""QGroundControl waits 1 s and then takes the vehicle for lost."""
RESET_COMPLETES_S: Final = 5.0
"""ResetSessions this soon after the last block ends an upload; later it comes from a client that starts anew."""

_REQUESTS_MAX = 8


class FileServer:
    """The service; see `companion.ground.service.Service`."""

    def __init__(self, store: TrajectoryStore, say: Say | None = None) -> None:
        """Serve a store.

        Args:
            store: belongs to this server from now on.
            say: told of every verdict, for STATUSTEXT.
        """
        self._store = store
        self._say = say
        self._pace = Pace()
        self._clients: dict[tuple[str, int, int], Client] = {}
        self._unsaid: list[Submission] = []
        self._operations: dict[int, Operation] = {
            Opcode.NONE: lambda client, request, now_s: ack(request),
            Opcode.TERMINATE_SESSION: self._terminate,
            Opcode.RESET_SESSIONS: self._reset,
            Opcode.OPEN_FILE_RO: self._open_to_read,
            Opcode.READ_FILE: self._read,
            Opcode.BURST_READ_FILE: self._burst,
            Opcode.CREATE_FILE: self._open_to_write,
            Opcode.OPEN_FILE_WO: self._open_to_write,
            Opcode.WRITE_FILE: self._write,
            **folder_operations(store),
        }

    # ---- the service -----------------------------------------------------------------------------------------------

    def handle(self, frame: Frame, link: GroundLink, now_s: float) -> bool:
        """Take a frame; False when it is no FTP for component 191 (never answer for another component)."""
        if frame.msgid != FILE_TRANSFER_PROTOCOL:
            return False
        _, component, request = decode(frame.payload)
        if component != COMPANION_COMPONENT:
            return False
        if request.opcode in {Opcode.ACK, Opcode.NAK}:
            return True
        client = self._client(frame, link, now_s)
        if client is None:
            reply = nak(request, bytes([Failure.NO_SESSIONS_AVAILABLE]))
            link.send(FILE_TRANSFER_PROTOCOL, encode(frame.sysid, frame.compid, reply))
            return True
        answer = self._answer(client, request, now_s)
        if answer is not None:
            _send(client, answer)
        return True

    def tick(self, now_s: float) -> None:
        """Take in verdicts, answer who waits for them, go on with bursts, close what is idle."""
        self._store.update()
        self._tell()
        for key, client in list(self._clients.items()):
            for ending in list(client.endings):
                self._settle(client, ending, now_s)
            for session in list(client.sessions.values()):
                if now_s - session.last_s > SESSION_IDLE_MAX_S:
                    self._close(client, session)
                elif session.burst is not None:
                    self._go_on(client, session, session.burst, now_s)
            idle = now_s - client.last_s > SESSION_IDLE_MAX_S
            if idle and not client.sessions and not client.endings:
                del self._clients[key]

    def close(self) -> None:
        """End all sessions; uploads that are under way can be gone on with after a restart."""
        for client in self._clients.values():
            for session in list(client.sessions.values()):
                self._close(client, session)
        self._clients.clear()
        self._store.close()

    # ---- one request -----------------------------------------------------------------------------------------------

    def _client(self, frame: Frame, link: GroundLink, now_s: float) -> Client | None:
        """Who asks; None when too many others have something open."""
        key = (link.name, frame.sysid, frame.compid)
        client = self._clients.get(key)
        if client is None:
            if len(self._clients) >= CLIENTS_MAX:
                quiet = [(c.last_s, k) for k, c in self._clients.items() if not c.sessions and not c.endings]
                if not quiet:
                    return None
                del self._clients[min(quiet)[1]]
            client = self._clients[key] = Client(frame.sysid, frame.compid, link, now_s)
        client.link = link
        client.last_s = now_s
        return client

    def _answer(self, client: Client, request: Packet, now_s: float) -> Packet | None:
        """Do what is asked; None when the answer comes later."""
        operation = self._operations.get(request.opcode)
        try:
            if request.size > DATA_MAX:
                raise RequestError(Failure.INVALID_DATA_SIZE)
            if operation is None:
                raise RequestError(Failure.UNKNOWN_COMMAND)
            return operation(client, request, now_s)
        except RequestError as failure:
            return nak(request, failure.data)
        except StoreError as error:
            return nak(request, errno_data(error.errno))
        except OSError as error:
            return nak(request, errno_data(error.errno or errno.EIO))

    def _session(self, client: Client, request: Packet, now_s: float) -> Session:
        session = client.sessions.get(request.session)
        if session is None:
            raise RequestError(Failure.INVALID_SESSION)
        session.last_s = now_s
        session.used = True
        return session

    # ---- opening and closing ---------------------------------------------------------------------------------------

    def _open_to_read(self, client: Client, request: Packet, now_s: float) -> Packet:
        again = self._opened_already(client, request, now_s)
        if again is not None:
            return again
        if is_index(request.path):
            index = self._store.index()
            reading = Reading(None, index, len(index))
        else:
            fd, entry = self._store.open(checked_name(request.path))
            reading = Reading(fd, b"", entry.size_bytes)
        session = self._new_session(client, request, now_s)
        session.reading = reading
        reply = ack(request, SIZE.pack(min(reading.size, OFFSET_MAX)))
        client.remember(request, reply, now_s)
        return reply

    def _open_to_write(self, client: Client, request: Packet, now_s: float) -> Packet:
        again = self._opened_already(client, request, now_s)
        if again is not None:
            return again
        name = checked_name(request.path)
        for other in self._clients.values():  # the same client anew, or one that is long silent, gives way
            for session in list(other.sessions.values()):
                gives_way = other is client or now_s - session.last_s > UPLOAD_IDLE_MAX_S
                if gives_way and session.upload is not None and session.upload.name == name:
                    self._close(other, session)
        session = self._new_session(client, request, now_s)
        resume = request.opcode == Opcode.OPEN_FILE_WO
        try:
            session.upload = self._store.begin(name, resume=resume)
        except (StoreError, OSError):
            del client.sessions[session.number]
            raise
        received = RECEIVED.pack(session.upload.received, session.upload.crc32)
        reply = ack(request, received if resume else b"")
        client.remember(request, reply, now_s)
        return reply

    def _opened_already(self, client: Client, request: Packet, now_s: float) -> Packet | None:
        """The answer to a repeated open, as long as its session is open; with a new sequence number also unused."""
        session = client.sessions.get(request.session)
        if session is None or session.opened_by._replace(seq=0) != request._replace(seq=0):
            return None
        if session.used and session.opened_by.seq != request.seq:
            return None
        return client.answered(request, now_s)

    def _new_session(self, client: Client, request: Packet, now_s: float) -> Session:
        """A session with the number that the client has in its request; what it had open there is over."""
        old = client.sessions.get(request.session)
        if old is not None:
            self._close(client, old)
        if len(client.sessions) >= SESSIONS_MAX:
            self._close(client, min(client.sessions.values(), key=lambda s: s.last_s))
        client.forget(Opcode.TERMINATE_SESSION)
        session = client.sessions[request.session] = Session(request.session, request, now_s)
        return session

    def _close(self, client: Client, session: Session) -> None:
        """End a session; what came of an upload is kept."""
        del client.sessions[session.number]
        if session.reading is not None:
            close_quietly(session.reading)
        if session.upload is not None:
            self._store.leave(session.upload)

    def _terminate(self, client: Client, request: Packet, now_s: float) -> Packet | None:
        ending = client.pending(request)
        if ending is not None:
            _wait_too(ending, request)
            return None
        session = client.sessions.get(request.session)
        if session is None:
            again = client.answered(request, now_s)
            if again is None:
                raise RequestError(Failure.INVALID_SESSION)
            return again
        if session.upload is None:
            self._close(client, session)
            reply = ack(request)
            client.remember(request, reply, now_s)
            return reply
        given = len(request.data) == EXPECTED.size
        size, checksum = EXPECTED.unpack(request.data) if given else (0, 0)
        try:
            submission = self._submit(client, session, (size, checksum) if given else None)
        except (StoreError, OSError) as error:
            self._complain(f"{error}; not stored")
            reply = nak(request, errno_data(error.errno or errno.EIO))
            client.remember(request, reply, now_s)
            return reply
        ending = Ending(request.opcode, request.session, [submission], now_s + TERMINATE_PATIENCE_S, [request])
        client.endings.append(ending)
        self._settle(client, ending, now_s)
        return None

    def _reset(self, client: Client, request: Packet, now_s: float) -> Packet | None:
        ending = client.pending(request)
        if ending is not None:
            _wait_too(ending, request)
            return None
        submissions = []
        for session in list(client.sessions.values()):
            upload = session.upload
            fresh = now_s - session.last_s < RESET_COMPLETES_S
            if upload is None or not fresh:
                self._close(client, session)
                continue
            try:
                submissions.append(self._submit(client, session, None))
            except (StoreError, OSError) as error:  # kept; it can be gone on with, or ended again
                self._complain(f"{error}; not stored")
        client.forget(Opcode.TERMINATE_SESSION, Opcode.REMOVE_FILE, Opcode.RENAME)
        if not submissions:
            return ack(request)
        ending = Ending(request.opcode, request.session, submissions, now_s + RESET_PATIENCE_S, [request])
        client.endings.append(ending)
        self._settle(client, ending, now_s)
        return None

    def _submit(self, client: Client, session: Session, expected: tuple[int, int] | None) -> Submission:
        """End a session with an upload that is complete.

        Raises:
            StoreError, OSError: it is not, or cannot be stored; it is kept to be gone on with.
        """
        assert session.upload is not None
        del client.sessions[session.number]
        submission = self._store.submit(session.upload, expected)
        self._unsaid.append(submission)
        return submission

    def _settle(self, client: Client, ending: Ending, now_s: float) -> None:
        """Answer who waits for a verdict, when it is there or patience is over."""
        findings = [submission.finding for submission in ending.submissions]
        if None in findings and now_s < ending.answer_by_s:
            return
        client.endings.remove(ending)
        refused = any(finding is not None and not finding.accepted for finding in findings)
        for request in ending.requests:
            reply = nak(request, errno_data(errno.EINVAL)) if refused else ack(request)
            if request.opcode == Opcode.TERMINATE_SESSION:
                client.remember(request, reply, now_s)
            _send(client, reply)
        self._tell()

    def _complain(self, sentence: str) -> None:
        """Say what is wrong with an upload: some clients show no refusal at its end."""
        if self._say is not None:
            self._say(sentence, False)

    def _tell(self) -> None:
        """Say the verdicts that have come."""
        for submission in [s for s in self._unsaid if s.finding is not None]:
            self._unsaid.remove(submission)
            finding = submission.finding
            if self._say is not None and finding is not None:
                word = "stored" if finding.accepted else "refused"
                self._say(f"{submission.name} {word}: {finding.verdict}", finding.accepted)

    # ---- reading and writing ---------------------------------------------------------------------------------------

    def _read(self, client: Client, request: Packet, now_s: float) -> Packet:
        session = self._session(client, request, now_s)
        if session.reading is None:
            raise RequestError(Failure.FILE_PROTECTED)
        data = session.reading.read(request.offset, request.size or DATA_MAX)
        if not data:
            raise RequestError(Failure.END_OF_FILE)
        return ack(request, data)

    def _burst(self, client: Client, request: Packet, now_s: float) -> Packet | None:
        session = self._session(client, request, now_s)
        if session.reading is None:
            raise RequestError(Failure.FILE_PROTECTED)
        session.burst = None
        if request.offset >= session.reading.size:
            raise RequestError(Failure.END_OF_FILE)
        session.burst = Burst(request.seq + 1, request.offset, request.size or DATA_MAX, BURST_PACKETS)
        self._go_on(client, session, session.burst, now_s)
        return None

    def _go_on(self, client: Client, session: Session, burst: Burst, now_s: float) -> None:
        """Send of a burst what the link takes now."""
        reading = session.reading
        assert reading is not None
        session.last_s = now_s
        while burst.left > 0 and self._pace.take(client.link.name, now_s):
            try:
                data = reading.read(burst.offset, burst.size)
                failure = b"" if data else bytes([Failure.END_OF_FILE])
            except OSError as error:
                data, failure = b"", errno_data(error.errno or errno.EIO)
            end = burst.offset + len(data)
            burst.left = 0 if failure or end >= reading.size else burst.left - 1
            _send(client, burst_packet(session, burst, failure or data, failed=bool(failure)))
            burst.seq += 1
            burst.offset = end
        if burst.left == 0:
            session.burst = None

    def _write(self, client: Client, request: Packet, now_s: float) -> Packet:
        session = self._session(client, request, now_s)
        if session.upload is None:
            raise RequestError(Failure.FILE_PROTECTED)
        if not request.data:
            raise RequestError(Failure.INVALID_DATA_SIZE)
        self._store.write(session.upload, request.offset, request.data)
        return ack(request)


def _wait_too(ending: Ending, request: Packet) -> None:
    """Remember a repeated request; all are answered together, since a client may only take the newest's answer."""
    if request.seq not in [known.seq for known in ending.requests]:
        ending.requests = [*ending.requests[-(_REQUESTS_MAX - 1) :], request]


def _send(client: Client, packet: Packet) -> None:
    client.link.send(FILE_TRANSFER_PROTOCOL, encode(client.system, client.component, packet))
