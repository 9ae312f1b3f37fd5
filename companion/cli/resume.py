"""The vehicle gets back to the pace of its path. This returns when it has."""

from __future__ import annotations

from companion.cli.common import JsonOption
from companion.cli.operate import TO_DEFAULT, KeyOption, TimeoutOption, ToOption, operate

EXAMPLE = "Example: companion resume"


def run(
    to: ToOption = TO_DEFAULT, key: KeyOption = None, timeout: TimeoutOption = 5.0, as_json: JsonOption = False
) -> None:
    """Goes on after a pause."""
    operate(to, key, timeout, "resume", lambda client: client.resume(), as_json=as_json)
