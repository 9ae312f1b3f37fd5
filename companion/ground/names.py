"""Names of uploaded files: one folder, no way out of it, nothing hidden, nothing that a list or a screen chokes on."""

from __future__ import annotations

import errno
import unicodedata
from typing import Final

from companion.ground.ftp import INDEX_NAME

NAME_BYTES_MAX: Final = 100
"""In UTF-8. A list entry with size and time must fit into one message, and the path into a request."""


class StoreError(Exception):
    """Something that the store does not do, with an errno for machines and a sentence for people."""

    def __init__(self, number: int, sentence: str) -> None:
        super().__init__(sentence)
        self.errno = number
        """`errno.E...`; ENOENT, EEXIST and EPERM have error codes of their own in MAVLink FTP."""


def checked_name(path: bytes) -> str:
    """The name of a file at a path as it came over the link.

    Args:
        path: UTF-8; `/lap.csv`, `./lap.csv` and `lap.csv` are the same.

    Raises:
        StoreError: not a name of ours; EINVAL for one that cannot be, EPERM for the index.
    """
    name = _file_name(path)
    if name == INDEX_NAME:
        raise StoreError(errno.EPERM, f"{INDEX_NAME} is written by the companion itself")
    return name


def is_index(path: bytes) -> bool:
    """Whether a path names the index."""
    try:
        return _file_name(path) == INDEX_NAME
    except StoreError:
        return False


def is_root(path: bytes) -> bool:
    """Whether a path names the one folder that there is."""
    return all(part in {b"", b"."} for part in path.split(b"/"))


def usable(name: str) -> bool:
    """Whether a file that somebody put into the folder has a name of ours."""
    try:
        return checked_name(name.encode("utf-8", "surrogateescape")) == name
    except StoreError:
        return False


def _file_name(path: bytes) -> str:
    parts = [part for part in path.split(b"/") if part not in {b"", b"."}]
    if not parts:
        raise StoreError(errno.EINVAL, "a file needs a name")
    if len(parts) > 1 or parts[0] == b"..":
        raise StoreError(errno.EINVAL, f"{_shown(path)}: there are no folders here, only names")
    raw = parts[0]
    try:
        name = raw.decode("utf-8")
    except UnicodeDecodeError:
        raise StoreError(errno.EINVAL, f"{_shown(raw)}: a name must be UTF-8") from None
    if len(raw) > NAME_BYTES_MAX:
        raise StoreError(errno.ENAMETOOLONG, f"{_shown(raw)}: a name has at most {NAME_BYTES_MAX} bytes")
    if name.startswith("."):
        raise StoreError(errno.EINVAL, f"{_shown(raw)}: hidden files are not taken")
    if not name.isprintable() or name != name.strip() or "\\" in name or unicodedata.normalize("NFC", name) != name:
        raise StoreError(errno.EINVAL, f"{_shown(raw)}: a name consists of printable characters, without backslashes")
    return name


def _shown(raw: bytes) -> str:
    """A hostile name for a message: short and printable."""
    text = raw[:60].decode("utf-8", "backslashreplace")
    return "".join(c if c.isprintable() else "?" for c in text) + ("..." if len(raw) > 60 else "")
