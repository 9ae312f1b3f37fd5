"""The vehicle slows down on its path until it rests; then the autopilot lands it where it is. Without a flight it lands
at once. This returns when the autopilot is landing.
"""

from __future__ import annotations

from companion.cli.common import JsonOption
from companion.cli.operate import TO_DEFAULT, KeyOption, TimeoutOption, ToOption, operate

EXAMPLE = "Example: companion land"


def run(
    to: ToOption = TO_DEFAULT, key: KeyOption = None, timeout: TimeoutOption = 5.0, as_json: JsonOption = False
) -> None:
    """Lands."""
    operate(to, key, timeout, "land", lambda client: client.land(), as_json=as_json)
