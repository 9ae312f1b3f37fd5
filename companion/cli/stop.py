"""The vehicle slows down on its path until it rests; then the autopilot holds it. This returns when it does."""

from __future__ import annotations

from companion.cli.common import JsonOption
from companion.cli.operate import TO_DEFAULT, KeyOption, TimeoutOption, ToOption, operate

EXAMPLE = "Example: companion stop"


def run(
    to: ToOption = TO_DEFAULT, key: KeyOption = None, timeout: TimeoutOption = 5.0, as_json: JsonOption = False
) -> None:
    """Ends the flight."""
    operate(to, key, timeout, "stop", lambda client: client.stop(), as_json=as_json)
