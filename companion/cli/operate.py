"""What the commands to a running `companion serve` share: where it is, and how the outcome is shown."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated

import typer

from companion.cli.common import say

if TYPE_CHECKING:
    from companion.ground.client import Client

TO_DEFAULT = "udpout:127.0.0.1:14590"

ToOption = Annotated[
    str,
    typer.Option(
        "--to",
        metavar="CONNECTION",
        help="A ground link of `companion serve` (udpout:HOST:PORT), or where the autopilot's radio arrives"
        " (udpin:0.0.0.0:14550, serial:DEVICE:BAUD).",
    ),
]
KeyOption = Annotated[
    str | None,
    typer.Option("--key", metavar="FILE", help="The key of that link, where it is signed (`companion key new`)."),
]
TimeoutOption = Annotated[float, typer.Option("--timeout", metavar="S", help="How long to wait for the companion.")]


def operate(
    to: str, key: str | None, timeout_s: float, what: str, act: Callable[[Client], None], *, as_json: bool
) -> None:
    """Connects, gives one command, and shows what the companion says meanwhile and how things stand then.

    Raises:
        CompanionError: no companion, or it refuses.
    """
    from dataclasses import asdict

    from companion.errors import CompanionError
    from companion.ground.client import Client

    with Client(to, timeout_s, key) as client:
        refusal = ""
        try:
            act(client)
        except CompanionError as error:
            refusal = str(error)
            raise
        finally:
            for announcement in client.texts:
                if announcement.text != refusal:  # which is said by itself
                    say(f"  {announcement.text}", quiet=as_json)
        if as_json:
            print(json.dumps({"done": what, **asdict(client.status())}, indent=2))
        else:
            say(f"{what}: done")
