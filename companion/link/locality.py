"""Whether a link stays on this machine: what is sent on it cannot be read or written from elsewhere."""

from __future__ import annotations

import ipaddress
import socket

from companion.errors import InputError
from companion.link.transport import Connection


def is_loopback(host: str) -> bool:
    """Whether every address that a host name stands for is a loopback address.

    Raises:
        InputError: it stands for none.
    """
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_DGRAM)
    except (OSError, UnicodeError) as error:
        raise InputError(f'host "{host}": is not known ({error})') from None
    return all(ipaddress.ip_address(str(entry[4][0]).split("%")[0]).is_loopback for entry in found)


def is_local(connection: Connection) -> bool:
    """Whether a link ends in this machine, or in a cable that is plugged into it.

    Raises:
        InputError: the host is not known.
    """
    return connection.kind == "serial" or is_loopback(connection.target)
