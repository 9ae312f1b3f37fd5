"""What FTP requests ask of the folder itself: list, remove, rename, checksum; no session is needed for these."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from companion.ground.ftp import DATA_MAX, INDEX_NAME, SIZE, Failure, Opcode, Packet, ack, crc32
from companion.ground.names import checked_name, is_index, is_root
from companion.ground.sessions import Client
from companion.ground.store import TrajectoryStore

Operation = Callable[[Client, Packet, float], Packet | None]
"""Does what a request asks; returns the answer, or None when that comes later. Raises RequestError, StoreError or
OSError for what becomes a NAK."""


class RequestError(Exception):
    """A request that is answered with a NAK."""

    def __init__(self, failure: Failure) -> None:
        super().__init__(failure.name)
        self.data: Final = bytes([failure])


def folder_operations(store: TrajectoryStore) -> dict[int, Operation]:
    """The operations by opcode."""
    folder = _Folder(store)
    return {
        Opcode.LIST_DIRECTORY: folder.list,
        Opcode.LIST_DIRECTORY_WITH_TIME: folder.list,
        Opcode.REMOVE_FILE: folder.remove,
        Opcode.RENAME: folder.rename,
        Opcode.CALC_FILE_CRC32: folder.checksum,
        Opcode.CREATE_DIRECTORY: folder.refuse,
        Opcode.REMOVE_DIRECTORY: folder.refuse,
        Opcode.TRUNCATE_FILE: folder.refuse,
    }


class _Folder:
    """The one folder."""

    def __init__(self, store: TrajectoryStore) -> None:
        self._store = store

    def list(self, client: Client, request: Packet, now_s: float) -> Packet:
        """Entries from a number on, as many as fit: `Fname\\tsize[\\tseconds since 1970]`, each with a NUL behind."""
        if not is_root(request.path):
            raise RequestError(Failure.FILE_NOT_FOUND)
        with_time = request.opcode == Opcode.LIST_DIRECTORY_WITH_TIME
        entries = [(INDEX_NAME, len(self._store.index()), 0)]
        entries += [(e.name, e.size_bytes, e.mtime_ns // 10**9) for e in self._store.entries()]
        listed = b""
        for name, size, changed_s in entries[request.offset :]:
            item = f"F{name}\t{size}\t{changed_s}\0" if with_time else f"F{name}\t{size}\0"
            if len(listed) + len(item.encode()) > DATA_MAX:
                break
            listed += item.encode()
        if not listed:
            raise RequestError(Failure.END_OF_FILE)
        return ack(request, listed)

    def remove(self, client: Client, request: Packet, now_s: float) -> Packet:
        """Remove a file."""
        name = checked_name(request.path)
        again = self._done_already(client, request, name, now_s)
        if again is not None:
            return again
        self._store.remove(name)
        reply = ack(request)
        client.remember(request, reply, now_s)
        return reply

    def rename(self, client: Client, request: Packet, now_s: float) -> Packet:
        """Rename a file: `old NUL new`."""
        old, _, rest = request.data.partition(b"\0")
        name, new = checked_name(old), checked_name(rest.split(b"\0", 1)[0])
        again = self._done_already(client, request, name, now_s)
        if again is not None:
            return again
        self._store.rename(name, new)
        reply = ack(request)
        client.remember(request, reply, now_s)
        return reply

    def checksum(self, client: Client, request: Packet, now_s: float) -> Packet:
        """Checksum of a file."""
        if is_index(request.path):
            return ack(request, SIZE.pack(crc32(self._store.index())))
        return ack(request, SIZE.pack(self._store.entry(checked_name(request.path)).crc32))

    def refuse(self, client: Client, request: Packet, now_s: float) -> Packet:
        """There is one folder, without others in it, of files that only whole uploads change."""
        raise RequestError(Failure.FILE_PROTECTED)

    def _done_already(self, client: Client, request: Packet, name: str, now_s: float) -> Packet | None:
        """The answer to a repeated request; with a new sequence number only while the file is still gone."""
        again = client.answered(request, now_s)
        if again is None or client.last_seq(request) == request.seq:
            return again
        return again if all(entry.name != name for entry in self._store.entries()) else None
