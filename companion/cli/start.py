"""The trajectory must be on the vehicle (`companion upload`, `companion list`). The vehicle checks it again, takes off
if it stands on the ground, and flies. This returns when the flight has begun; a refusal is printed (exit code 3).
"""

from __future__ import annotations

from typing import Annotated

import typer

from companion.cli.common import JsonOption
from companion.cli.operate import TO_DEFAULT, KeyOption, TimeoutOption, ToOption, operate

EXAMPLE = "Example: companion start circle --to udpout:192.168.1.20:14590"


def run(
    trajectory: Annotated[str, typer.Argument(help="Name or id of a trajectory on the vehicle.")],
    to: ToOption = TO_DEFAULT,
    key: KeyOption = None,
    timeout: TimeoutOption = 5.0,
    as_json: JsonOption = False,
) -> None:
    """Starts a trajectory."""
    operate(
        to,
        key,
        timeout,
        f"start {trajectory}",
        lambda client: client.start(int(trajectory) if trajectory.isdigit() else trajectory),
        as_json=as_json,
    )
