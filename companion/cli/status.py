"""Shows one screen that changes as the flight does, until Ctrl-C; with --json, or when the output is no terminal, how
things stand once.
"""

from __future__ import annotations

import contextlib
import json
import sys
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from companion.cli.common import JsonOption
from companion.cli.operate import TO_DEFAULT, KeyOption, TimeoutOption, ToOption
from companion.errors import CompanionError

if TYPE_CHECKING:
    from companion.ground.client import Client, Status

EXAMPLE = "Example: companion status --to udpout:192.168.1.20:14590"

_TEXTS_SHOWN = 8
_SILENT_S = 3.0


def run(
    to: ToOption = TO_DEFAULT, key: KeyOption = None, timeout: TimeoutOption = 5.0, as_json: JsonOption = False
) -> None:
    """Shows how things stand."""
    from rich.console import Console

    from companion.ground.client import Client

    with Client(to, timeout, key) as client:
        status, names = client.status(), _Names(client)
        if as_json:
            print(json.dumps({**asdict(status), "trajectory": names.of(status.trajectory_id)}, indent=2))
        elif not sys.stdout.isatty():
            Console(highlight=False).print(_screen(client, status, names))
        else:
            _follow(client, names)


class _Names:
    """What the trajectories are called: the vehicle tells the id of the one that is flown, the list of them is asked
    once for each that was not seen before."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._known: dict[int, str | None] = {0: None}

    def of(self, identity: int) -> str | None:
        """None: nothing was flown yet, it was removed since, or the list does not come."""
        if identity not in self._known:
            self._known[identity] = None
            with contextlib.suppress(CompanionError):
                self._known |= {stored.id: stored.name for stored in self._client.trajectories()}
        return self._known[identity]


def _follow(client: Client, names: _Names) -> None:
    """The screen, until Ctrl-C. A companion that falls silent is shown as silent: it may be back."""
    from rich.live import Live

    with Live(_screen(client, client.latest, names), refresh_per_second=4, screen=True) as live:
        while True:
            client.update(0.25)
            live.update(_screen(client, client.latest, names))


def _screen(client: Client, status: Status, names: _Names) -> Any:
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(min_width=22)
    for name, value in _rows(client, status, names):
        table.add_row(name, value)
    texts = [Text(f"  {said.text}") for said in client.texts[-_TEXTS_SHOWN:]]
    return Group(table, Text(""), *texts)


def _rows(client: Client, status: Status, names: _Names) -> list[tuple[str, str]]:
    identity = status.trajectory_id
    vehicle = "no autopilot is heard" if not status.vehicle else "armed" if status.armed else "disarmed"
    phase = f"{status.phase}, at rest" if status.paused else status.phase
    silent = f" (silent for {client.silent_s:.0f} s)" if client.silent_s > _SILENT_S else ""
    disturbance = status.disturbance_m_s2
    return [
        ("vehicle", f"system {status.system}, {vehicle}{silent}"),
        ("phase", phase),
        ("trajectory", names.of(identity) or f"id {identity}" if identity else "-"),
        ("time on trajectory", _figure(status.track_time_s, "s", 1)),
        ("time to go", _figure(status.time_to_go_s, "s", 1)),
        ("position error", _figure(status.position_error_m, "m", 3)),
        ("Lyapunov function", _figure(status.lyapunov, "", 4)),
        (
            "disturbance (N, E, D)",
            "-" if disturbance is None else ", ".join(f"{x:.3f}" for x in disturbance) + " m/s^2",
        ),
        ("messages refused", "-" if status.refused_messages is None else str(status.refused_messages)),
    ]


def _figure(value: float | None, unit: str, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f} {unit}".rstrip()
