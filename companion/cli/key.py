"""`new` makes a key file that nobody but you may read. `install` gives its key to an autopilot: from then on that
believes nobody else (but for a few harmless messages), and signs what it sends. It must be disarmed, and on a local
link (serial, or UDP on this machine): the message that carries the key is not encrypted. `remove` ends signing there.

All links of the autopilot are concerned, that of the pilot's ground station too: give it the same key.
"""

from __future__ import annotations

import json
from math import isfinite
from typing import Annotated

import typer

from companion.cli.common import JsonOption, VehicleSystemOption, say

EXAMPLE = "Example: companion key install --key vehicle.key --connect serial:/dev/ttyAMA0:921600"


def run(
    action: Annotated[str, typer.Argument(metavar="ACTION", help="new, install or remove.")],
    file: Annotated[str | None, typer.Argument(metavar="[FILE]", help="With new: the file to make.")] = None,
    connect: Annotated[
        str, typer.Option("--connect", help="serial:DEVICE:BAUD, or udpin/udpout on this machine.")
    ] = "udpin:127.0.0.1:14540",
    key: Annotated[
        str | None, typer.Option("--key", metavar="FILE", help="The key to install, or the one to remove.")
    ] = None,
    old: Annotated[
        str | None,
        typer.Option("--old", metavar="FILE", help="With install: the key that the autopilot has now, if it has one."),
    ] = None,
    system: VehicleSystemOption = None,
    timeout: Annotated[float, typer.Option("--timeout", metavar="S", help="How long to wait for the vehicle.")] = 15.0,
    as_json: JsonOption = False,
) -> None:
    """Makes, installs or removes a key."""
    from companion.errors import InputError

    if action == "new":
        _new(file, as_json)
        return
    if action not in {"install", "remove"}:
        raise InputError(f"companion key {action}: there are new, install and remove")
    if file is not None:
        raise InputError(f"companion key {action} {file}: the key file is named by --key {file}")
    if key is None:
        raise InputError(f"companion key {action}: say which key: --key FILE (`companion key new FILE` makes one)")
    if not (isfinite(timeout) and timeout > 0.0):
        raise InputError(f"--timeout {timeout:g}: must be a number of seconds above 0")
    if action == "remove" and old is not None:
        raise InputError("--old: only for install; remove takes the key that the autopilot has by --key")
    _setup(action, key, old, connect, system, timeout, as_json)


def _new(file: str | None, as_json: bool) -> None:
    from companion.errors import InputError
    from companion.link.key_file import new_key

    if file is None:
        raise InputError("companion key new: say which file to make: companion key new vehicle.key")
    made = new_key(file)
    if as_json:
        print(json.dumps({"key_file": file, "fingerprint": made.fingerprint}))
    else:
        say(f"{file}: a new key, fingerprint {made.fingerprint}; keep it secret, and copy it by a secure way only")


def _setup(
    action: str, key: str, old: str | None, connect: str, system: int | None, timeout_s: float, as_json: bool
) -> None:
    from companion.link.key_setup import Setup

    setup = Setup(connect, system, timeout_s)
    say(f"looking for the autopilot at {connect}", quiet=as_json)
    found = setup.install(key, old) if action == "install" else setup.remove(key)
    if as_json:
        print(json.dumps({"done": action, "system": found, "key_file": key, "connect": connect}))
    elif action == "install":
        say(f"system {found} has the key {key} and signs with it; give --key {key} to what talks to it from now on")
    else:
        say(f"system {found} signs no more: whoever reaches its links can command it")
