"""The vehicle slows down on its path until it rests, and stays there. This returns when it does."""

from __future__ import annotations

from companion.cli.common import JsonOption
from companion.cli.operate import TO_DEFAULT, KeyOption, TimeoutOption, ToOption, operate

EXAMPLE = "Example: companion pause"


def run(
    to: ToOption = TO_DEFAULT, key: KeyOption = None, timeout: TimeoutOption = 5.0, as_json: JsonOption = False
) -> None:
    """Pauses the flight."""
    operate(to, key, timeout, "pause", lambda client: client.pause(), as_json=as_json)
