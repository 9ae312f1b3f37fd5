"""Reads a ULog, ours or PX4's, as far as it goes: what is missing is said, and only a file without any data is refused.

The bytes are pyulog's work. It ends silently at some kinds of damage, prints at others and raises at a few, so that
here it is watched: how far it came, and whether the last message was whole.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from companion.errors import InputError

Array = npt.NDArray[np.float64]
Columns = Mapping[str, npt.NDArray[Any]]
"""The numbers of a topic by field; of an array's by "field[0]", ..."""

_MAGIC: Final = b"ULog\x01\x12\x35"
_HEADER_BYTES: Final = 16
_HEAD_BYTES: Final = 3
_KINDS: Final = frozenset(b"BFIMPQARDLCSO")
_DATA, _ADD = b"DA"
_ATTEMPTS: Final = 4
_ROUNDS: Final = 8
_ROUNDS_BYTES: Final = 1 << 20


@dataclass(frozen=True)
class LogFile:
    """What could be read of a log."""

    path: Path
    topics: Mapping[str, Columns]
    """The first instance of each topic that has data."""
    info: Mapping[str, object]
    texts: Sequence[tuple[int, int, str]]
    """Severity (0 emergency to 7 debug), time [us], and what was said."""
    long_info: Mapping[str, Sequence[str]]
    """Texts of several messages, whole, by key; the latest last."""
    parameters: Mapping[str, float]
    """As they were at the end."""
    missing: tuple[str, ...]
    """What could not be read, a sentence each; empty for a whole log."""

    @property
    def is_ours(self) -> bool:
        """Whether this program wrote it."""
        return self.info.get("sys_name") == "companion"

    def column(self, topic: str, field: str) -> Array:
        """One field as float64, shape (len,). Raises KeyError."""
        return np.asarray(self.topics[topic][field], dtype=np.float64)

    def vector(self, topic: str, fields: Iterable[str]) -> Array:
        """Fields side by side, shape (len, fields). Raises KeyError."""
        return np.column_stack([self.column(topic, field) for field in fields])

    def time_s(self, topic: str) -> Array:
        """The topic's timestamps [s], shape (len,). Raises KeyError."""
        return 1e-6 * np.asarray(self.topics[topic]["timestamp"], dtype=np.float64)


class _LostError(Exception):
    """The reading goes round in circles."""


class _Watched(io.BufferedReader):
    """Knows how far it was read, also after it was closed, and whether the last message was whole.

    Reading more than a few times the file is ended by `_LostError`: damaged definitions can send pyulog back for ever.
    """

    end = 0
    torn = 0
    """Bytes of a last message that is not whole."""
    limit: int
    """Nothing behind this is shown."""

    def __init__(self, path: Path, size: int) -> None:
        super().__init__(io.FileIO(path, "rb"))
        self.limit = size
        self._left = _ROUNDS * size + _ROUNDS_BYTES

    def read(self, size: int | None = -1, /) -> bytes:
        """As a file's."""
        left = max(0, self.limit - self.tell())
        content = super().read(left if size is None or size < 0 else min(size, left))
        self._left -= len(content) + 1
        if self._left < 0:
            raise _LostError("it leads in circles")
        if size is not None and len(content) < size:
            # A message begins with three bytes; asking for them where nothing is left is how a whole log ends.
            self.torn = 0 if size == _HEAD_BYTES and not content else len(content) + _HEAD_BYTES * (size != _HEAD_BYTES)
        return content

    def close(self) -> None:
        """Remembers the place."""
        if not self.closed:
            self.end = self.tell()
        super().close()


def read_ulog(path: Path, topics: Sequence[str] | None = None) -> LogFile:
    """Read a log.

    Args:
        path: the file.
        topics: the topics that are wanted; None: all.

    Raises:
        InputError: there is no such file, it is no ULog, or it ends before its first data.
    """
    try:
        size = path.stat().st_size
        watched = _Watched(path, size)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give a flight's folder or a ULog") from None
    with watched:
        _check_head(path, watched, size)
        log, failure = _parsed(watched, topics)
    if log is None:
        raise InputError(f"{path}: cannot be read as a ULog ({failure}); it is damaged, try another copy of it")
    return _log_file(path, log, tuple(_missing(log, watched, size)))


def _log_file(path: Path, log: Any, missing: tuple[str, ...]) -> LogFile:
    return LogFile(
        path=path,
        topics={data.name: data.data for data in log.data_list if data.multi_id == 0 and "timestamp" in data.data},
        info=log.msg_info_dict,
        texts=[(said.log_level - ord("0"), said.timestamp, said.message) for said in log.logged_messages],
        long_info={key: [_joined(parts) for parts in entry] for key, entry in log.msg_info_multiple_dict.items()},
        parameters={**log.initial_parameters, **{name: value for _, name, value in log.changed_parameters}},
        missing=missing,
    )


def read_seldom(path: Path, topics: Sequence[str]) -> LogFile:
    """Read what comes seldom in a log, its texts and facts and a few topics, without looking at the rest of its data:
    ten times as fast as all of it.

    Raises:
        InputError: as of `read_ulog`.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give a flight's folder or a ULog") from None
    with io.BytesIO(content) as file:
        _check_head(path, file, len(content))
    kept, torn = _without_data(content, {name.encode() for name in topics})
    log, failure = None, ""
    try:
        from pyulog import ULog

        with contextlib.redirect_stdout(io.StringIO()):
            log = ULog(io.BytesIO(kept), list(topics))
    except Exception as error:
        failure = f"{type(error).__name__}: {error}"
    if log is None:
        raise InputError(f"{path}: cannot be read as a ULog ({failure}); it is damaged, try another copy of it")
    lost = (f"the log ends inside a message ({torn} bytes of it), or is damaged there",) if torn else ()
    return _log_file(path, log, lost)


def _without_data(content: bytes, topics: Collection[bytes]) -> tuple[bytes, int]:
    """A log without the data of other topics than these, and how many bytes are left behind its last whole message."""
    wanted: set[bytes] = set()
    kept, at, end, begin = bytearray(), _HEADER_BYTES, len(content), 0
    while at + _HEAD_BYTES <= end:
        after = at + _HEAD_BYTES + (content[at] | content[at + 1] << 8)
        kind = content[at + 2]
        if after > end or kind not in _KINDS:
            break
        if kind == _DATA:
            if content[at + 3 : at + 5] not in wanted:
                kept += content[begin:at]
                begin = after
        elif kind == _ADD and content[at + 6 : after] in topics:
            wanted.add(content[at + 4 : at + 6])
        at = after
    kept += content[begin:at]
    return bytes(kept), end - at


def _check_head(path: Path, file: io.BufferedIOBase, size: int) -> None:
    """Raises InputError for what is not the beginning of a ULog."""
    head = file.read(_HEADER_BYTES)
    file.seek(0)
    if not size:
        raise InputError(f"{path}: is empty; the flight ended before its log began")
    if not head.startswith(_MAGIC[: len(head)]) or len(head) < len(_MAGIC):
        raise InputError(f"{path}: is no ULog; give a flight's folder, its flight.ulg, or the autopilot's own log")
    if len(head) < _HEADER_BYTES:
        raise InputError(f"{path}: ends within its header; nothing of the flight is in it")


def _parsed(file: _Watched, topics: Sequence[str] | None) -> tuple[Any, str]:
    """The log, or None and why not. Where pyulog raises, the log ends for us: it is read again up to there."""
    from pyulog import ULog

    failure = ""
    for _ in range(_ATTEMPTS):
        try:
            with contextlib.redirect_stdout(io.StringIO()):
                return ULog(file, None if topics is None else list(topics)), ""
        except _LostError as error:
            return None, str(error)
        except Exception as error:
            failure = f"{type(error).__name__}: {error}"
            if file.closed:
                break
            file.limit = max(file.tell() - 1, _HEADER_BYTES)
            file.seek(0)
    return None, failure


def _missing(log: Any, file: _Watched, size: int) -> Iterator[str]:
    if log.file_corruption:
        yield "some of the log's bytes are damaged; what stood there is missing"
    if file.end < size:
        yield f"the log is damaged at {file.end} of its {size} bytes and was read up to there"
    elif file.torn and not log.file_corruption:
        yield f"the log ends inside a message ({file.torn} bytes of it): it was cut off, or its writer was killed"
    if log.dropouts:
        holes_s = 1e-3 * sum(hole.duration for hole in log.dropouts)
        yield f"{len(log.dropouts)} holes, {holes_s:.2f} s together: the log's writer was too slow"


def _joined(parts: Sequence[object]) -> str:
    return "".join(part for part in parts if isinstance(part, str))
