"""Which links are open to others, and what is not opened without a key."""

from __future__ import annotations

from pathlib import Path

from companion.errors import InputError, RefusedError
from companion.link.key_file import load_key
from companion.link.locality import is_loopback
from companion.link.transport import parse_connection
from companion.link.vehicle_link import VehicleLink


def ground_keys(links: tuple[str, ...], files: tuple[str, ...]) -> tuple[str | None, ...]:
    """The key file of each ground link, as absolute path: one for all, or one for each; "" stands for none.

    Raises:
        InputError: another number, or a file that cannot be used.
    """
    if len(files) not in {0, 1, len(links)}:
        raise InputError(
            f"--ground-key is given {len(files)} times for {len(links)} ground links: once for all of them, or once for"
            ' each ("" for one without)'
        )
    named = files * len(links) if len(files) == 1 else files
    for file in named:
        if file:
            load_key(file)
    return tuple(str(Path(file).absolute()) if file else None for file in named) or (None,) * len(links)


def check_ground(links: tuple[str, ...], keys: tuple[str | None, ...], *, allow_unsigned: bool) -> None:
    """Whether the ground links may be opened.

    Raises:
        InputError: a connection string is wrong.
        RefusedError: one is open to others, has no key, and nobody has said that this is meant.
    """
    for connection, key in zip(links, keys, strict=True):
        parsed = parse_connection(connection)
        # A serial ground link is a radio as a rule.
        alone = parsed.kind != "serial" and is_loopback(parsed.target)
        if key is None and not alone and not allow_unsigned:
            raise RefusedError(
                f"--ground {connection}: everybody whom it reaches could start a flight: give it a key (--ground-key"
                " FILE, `companion key new FILE`), keep it on 127.0.0.1, or say --allow-unsigned"
            )


def open_vehicle_link(link: VehicleLink) -> str:
    """A warning when others than the autopilot could speak on the vehicle link; "" when they cannot."""
    parsed = parse_connection(link.connection)
    if link.key is not None or parsed.kind == "serial" or is_loopback(parsed.target):
        return ""
    return (
        f"--connect {link.connection} has no key: whoever sends there can pretend to be the vehicle; --key FILE, or"
        " udpin:127.0.0.1:PORT"
    )
