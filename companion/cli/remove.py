"""A flight that has begun with the trajectory goes on."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from companion.cli.common import JsonOption, say
from companion.cli.operate import TO_DEFAULT, KeyOption, ToOption
from companion.cli.upload import SystemOption

EXAMPLE = "Example: companion remove lap.csv --to udpout:192.168.1.10:14590"


def run(
    name: Annotated[str, typer.Argument(help="As companion list shows it.")],
    to: ToOption = TO_DEFAULT,
    key: KeyOption = None,
    system: SystemOption = None,
    as_json: JsonOption = False,
) -> None:
    """Removes a stored trajectory."""
    from companion.ground.upload import Files

    with Files(to, system=system, key=key) as files:
        files.remove(name)
    if as_json:
        print(json.dumps({"removed": name}))
    else:
        say(f"{name}: removed")
