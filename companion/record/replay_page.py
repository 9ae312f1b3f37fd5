"""A page with the recorded commands of a flight and the replayed ones, one above the other."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np

from companion.errors import InputError
from companion.record.charts import AXES, Array, add_level, lines, thin, time_layout
from companion.record.flight_record import FlightRecord
from companion.record.folder import write_whole
from companion.record.page import compose

_HEIGHT_PX: Final = 520
_PLOTS: Final = (
    ("thrust", "Thrust", "N", ("thrust_n",), ("thrust",)),
    ("rates", "Body rate setpoints", "rad/s", ("rate_cmd_x", "rate_cmd_y", "rate_cmd_z"), ("roll", "pitch", "yaw")),
    ("tau", "Angular acceleration", "rad/s²", ("tau_x", "tau_y", "tau_z"), ("roll", "pitch", "yaw")),
    ("b_hat", "Disturbance estimate", "m/s²", ("b_hat_n", "b_hat_e", "b_hat_d"), ("north", "east", "down")),
)


class Found(Protocol):
    """A difference, as `campaign.replay.Difference` is one."""

    @property
    def name(self) -> str:
        """The command."""

    @property
    def unit(self) -> str:
        """Its unit."""

    @property
    def largest(self) -> float:
        """Largest distance."""

    @property
    def rms(self) -> float:
        """Root mean square of the distance."""

    @property
    def first_s(self) -> float | None:
        """When it differs first; None: never."""


def write_page(
    time_s: Array,
    recorded: FlightRecord,
    replayed: Mapping[str, Array],
    differences: Sequence[Found],
    name: str,
    path: Path,
) -> None:
    """Write the page.

    Args:
        time_s: since the flight was engaged, shape (rows,).
        recorded: the flight's record.
        replayed: the same columns as the replay gave them.
        differences: what the table says.
        name: the flight's.
        path: the file; it is replaced.

    Raises:
        InputError: it cannot be written.
    """
    figures, sections = [], []
    for key, title, unit, columns, axes in _PLOTS:
        before = recorded.columns(*columns)
        after = np.column_stack([replayed[column] for column in columns])
        figures.append({"key": key, **_figure(time_s, before, after, unit, axes)})
        sections.append(
            f'<section class="figure"><h2>{title}</h2><p class="caption">Above: recorded, and replayed in dashes. '
            f'Below: replayed less recorded.</p><div class="plots"><div class="plot" id="{key}" '
            f'style="height:{_HEIGHT_PX}px"></div></div></section>\n'
        )
    identical = all(found.first_s is None for found in differences)
    parts = {
        "TITLE": f"{html.escape(name)}, replayed",
        "SUBTITLE": f"{len(time_s)} recorded states given to the controller again",
        "VERDICT": "identical" if identical else "the commands differ",
        "VERDICT_CLASS": "passed" if identical else "missed",
        "THRESHOLDS": _table(differences),
        "TILES": "",
        "FIGURES": "".join(sections),
        "TABLES": "",
    }
    try:
        write_whole(path, compose(parts, figures))
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); choose another with --page") from None


def _figure(time_s: Array, before: Array, after: Array, unit: str, axes: Sequence[str]) -> dict[str, Any]:
    colours = AXES[: len(axes)]
    layout = time_layout(time_s, [], [f"[{unit}]", f"difference [{unit}]"])
    data = lines(time_s, before, [f"{axis}, recorded" for axis in axes], colours)
    dashed = lines(time_s, after, [f"{axis}, replayed" for axis in axes], colours)
    for line in dashed:
        line["line"] = line["line"] | {"dash": "dash"}
    rows = thin(after - before)
    data += dashed + lines(time_s[rows], (after - before)[rows], axes, colours, row=2)
    add_level(layout, 0.0, "", row=2)
    return {"data": data, "layout": layout}


def _table(differences: Sequence[Found]) -> str:
    rows = []
    for found in differences:
        begin = "never" if found.first_s is None else f"{found.first_s:.3f} s"
        cells = (found.name, f"{found.largest:.3g}", f"{found.rms:.3g}", found.unit, begin)
        rows.append("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in cells) + "</tr>")
    head = "<tr><th>Command</th><th>largest</th><th>rms</th><th></th><th>differs first at</th></tr>"
    return f'<table class="numbers">{head}{"".join(rows)}</table>'
