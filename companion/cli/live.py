"""The flight in the terminal while it lasts: figures, how far it is, and a small plan of the path.

It lives in the process of the command line and shows what the control process tells ten times per second; nothing that
happens here reaches the flight.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any, Final

from companion.cli.sketch import sketch
from companion.record.columns import DEFAULT_PHASE_NAMES

_RATE_HZ: Final = 10
_TRAIL: Final = 600
"""Positions in the plan: a minute."""
_FIGURES_COLUMNS: Final = 47
_PLAN_COLUMNS: Final = (12, 60)
_PLAN_ROWS: Final = 10
_BAR: Final = 8
_RMS_POINTS: Final = 50


class LiveDisplay:
    """A screen part that changes in place below the lines of the flight; a context manager.

    Args:
        quiet: stdout belongs to JSON; the display goes to stderr.
        console: where to show it instead.
    """

    def __init__(self, quiet: bool, console: Any = None) -> None:
        from rich.console import Console
        from rich.live import Live

        self._console = console or Console(stderr=quiet, highlight=False)
        self._phase = "starting"
        self._progress: Mapping[str, Any] | None = None
        self._path: deque[tuple[float, float]] = deque(maxlen=_TRAIL)
        self._wanted: deque[tuple[float, float]] = deque(maxlen=_TRAIL)
        self._errors: deque[float] = deque(maxlen=_RMS_POINTS)
        self._live = Live(
            get_renderable=self.screen, console=self._console, refresh_per_second=_RATE_HZ, transient=True
        )

    def __enter__(self) -> LiveDisplay:
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def __call__(self, message: Mapping[str, Any]) -> None:
        """Shows one message of the control process."""
        line = message.get("line")
        if line is not None:
            self._console.print(f"  {line}", markup=False, soft_wrap=True)
            phase = str(line).partition(":")[0]
            if phase in DEFAULT_PHASE_NAMES:
                self._phase = phase
        progress = message.get("progress")
        if progress is not None:
            self._progress, self._phase = progress, progress["phase"]
            self._errors.append(progress["error_m"])
            north, east, _ = progress["position_m"]
            self._path.append((east, north))
            north, east, _ = progress["reference_m"]
            self._wanted.append((east, north))

    def screen(self) -> Any:
        """What is shown now."""
        from rich.panel import Panel
        from rich.table import Table
        from rich.text import Text

        figures = Table.grid(padding=(0, 1))
        figures.add_column(min_width=20, style="dim")
        figures.add_column(no_wrap=True)
        for name, value in self._rows():
            figures.add_row(name, value)
        columns = min(max(self._console.width - _FIGURES_COLUMNS - 5, _PLAN_COLUMNS[0]), _PLAN_COLUMNS[1])
        plan = Panel(Text("\n".join(self._plan(columns)), no_wrap=True), title="plan, north up", width=columns + 4)
        both = Table.grid(padding=(0, 1))
        both.add_column(width=_FIGURES_COLUMNS - 1)
        both.add_column()
        both.add_row(figures, plan)
        return both

    def _rows(self) -> list[tuple[str, str]]:
        p = self._progress
        if p is None:
            return [("phase", self._phase)]
        rms = math.sqrt(sum(error * error for error in self._errors) / len(self._errors))
        return [
            ("phase", self._phase),
            ("track", _track(p["t_s"], p["duration_s"])),
            ("to go", _figure(p["to_go_s"], "s", 1)),
            ("position error", _figure(p["error_m"], "m", 3)),
            ("  last 5 s, rms", _figure(rms, "m", 3)),
            ("height", _figure(-p["position_m"][2], "m", 2)),
            ("disturbance N, E, D", _vector(p["disturbance_m_s2"], "m/s^2")),
            ("thrust", _figure(p["thrust_n"], "N", 1)),
            ("Lyapunov function", _small(p["lyapunov"])),
            ("state age", _figure(p["state_age_ms"], "ms", 1)),
            ("battery", "-" if p["battery"] is None else f"{100.0 * p['battery']:.0f} %"),
            ("control steps", str(p["steps"])),
        ]

    def _plan(self, columns: int) -> list[str]:
        points = [*self._wanted, *self._path]
        if not points:
            return [""] * _PLAN_ROWS
        plain = self._console.encoding.lower().replace("-", "") not in {"utf8", "utf16", "utf32"}
        lines = sketch(
            [x for x, _ in points],
            [y for _, y in points],
            columns=columns,
            rows=_PLAN_ROWS,
            same_scale=True,
            plain=plain,
            mark=len(points) - 1,
        )
        return [""] * (_PLAN_ROWS - len(lines)) + lines


def _track(t_s: float, duration_s: float) -> str:
    share = min(max(t_s / duration_s, 0.0), 1.0) if duration_s > 0.0 else 0.0
    filled = round(share * _BAR)
    return f"{'#' * filled}{'.' * (_BAR - filled)} {t_s:.1f} of {duration_s:.0f} s"


def _figure(value: float, unit: str, digits: int) -> str:
    return "-" if not math.isfinite(value) else f"{value:.{digits}f} {unit}"


def _small(value: float) -> str:
    return "-" if not math.isfinite(value) else f"{value:.2e} m^2"


def _vector(values: Any, unit: str) -> str:
    return "-" if not all(map(math.isfinite, values)) else ", ".join(f"{x:.2f}" for x in values) + f" {unit}"
