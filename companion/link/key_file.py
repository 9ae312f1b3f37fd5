"""Key files: 32 bytes, raw or as 64 hexadecimal digits, that nobody but their owner may read."""

from __future__ import annotations

import contextlib
import os
import stat
from pathlib import Path
from typing import Final

from companion.errors import InputError
from companion.link.signing import KEY_BYTES, SigningKey

_READ_MAX: Final = 1024
_OTHERS: Final = stat.S_IRWXG | stat.S_IRWXO


def load_key(path: str | Path) -> SigningKey:
    """Reads a key.

    Raises:
        InputError: there is none, others may read or change it, or it is no key. The message never tells its contents.
    """
    path = Path(path)
    try:
        # Not blocking: a named pipe in its place must not hang the program.
        with open(os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK), "rb") as file:
            _check(path, os.fstat(file.fileno()))
            content = file.read(_READ_MAX)
    except OSError as error:
        reason = error.strerror or "cannot be read"
        raise InputError(f"key file {path}: {reason}; `companion key new {path}` makes one") from None
    secret = _secret(content)
    if secret is None:
        raise InputError(
            f"key file {path}: {len(content)} bytes that are no key; expected {KEY_BYTES} bytes, or {2 * KEY_BYTES}"
            " hexadecimal digits"
        )
    if not any(secret):
        raise InputError(f"key file {path}: a key of zeros means no signing to an autopilot; make a new one")
    return SigningKey(secret)


def _check(path: Path, found: os.stat_result) -> None:
    """Whether the file is one that only we can have written and only we can read."""
    if not stat.S_ISREG(found.st_mode):
        raise InputError(f"key file {path}: is not a file")
    if found.st_uid != os.geteuid():
        raise InputError(
            f"key file {path}: belongs to user {found.st_uid}, this program runs as {os.geteuid()}; give it to"
            f" that user: chown {os.geteuid()} {path}"
        )
    if found.st_mode & _OTHERS:
        mode = stat.S_IMODE(found.st_mode)
        raise InputError(f"key file {path}: others may use it (mode {mode:04o}); chmod 600 {path}")


def _secret(content: bytes) -> bytes | None:
    if len(content) == KEY_BYTES:
        return content
    text = content.strip()
    if len(text) != 2 * KEY_BYTES:
        return None
    try:
        return bytes.fromhex(text.decode("ascii"))
    except ValueError:
        return None


def new_key(path: str | Path) -> SigningKey:
    """Makes a key and writes it into a new file, as hexadecimal digits, readable by its owner alone.

    Raises:
        InputError: the file is there already, or cannot be written.
    """
    path = Path(path)
    key = SigningKey(os.urandom(KEY_BYTES))
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    except FileExistsError:
        raise InputError(f"key file {path}: is there already; a key is never overwritten, name another file") from None
    except OSError as error:
        raise InputError(f"key file {path}: {error.strerror}") from None
    try:
        with open(descriptor, "wb") as file:
            os.fchmod(file.fileno(), 0o600)
            file.write(key.secret.hex().encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        with contextlib.suppress(OSError):
            path.unlink()
        raise InputError(f"key file {path}: {error.strerror}") from None
    return key
