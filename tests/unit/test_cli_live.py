"""The displays of a running flight: in the terminal, and in rerun, and what happens when one of them fails."""

from __future__ import annotations

import importlib.util
import math
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from companion.cli import common, main, rerun_stream
from companion.cli.live import LiveDisplay
from companion.cli.rerun_stream import RerunStream, attitude_enu
from companion.control.vectors import rotate_to_inertial
from companion.errors import InputError
from companion.flight.accounting import Progress
from companion.frames import enu_from_ned, quat_from_yaw


def progress(index: int = 0, **changes: Any) -> dict[str, Any]:
    """What the control process tells on the way around a circle."""
    angle = 0.05 * index
    told = Progress(
        phase="track",
        t_s=0.1 * index,
        duration_s=60.0,
        error_m=0.012,
        steps=25 * index,
        to_go_s=60.0 - 0.1 * index,
        lyapunov=2.5e-4,
        disturbance_m_s2=(1.0, -0.5, 0.25),
        position_m=(5.0 * math.cos(angle), 5.0 * math.sin(angle), -10.0),
        attitude=(1.0, 0.0, 0.0, 0.0),
        reference_m=(5.0 * math.cos(angle), 5.0 * math.sin(angle) + 0.1, -10.0),
        thrust_n=46.5,
        state_age_ms=20.4,
        battery=0.83,
    )
    return {"progress": told._asdict() | changes}


def shown(display: LiveDisplay, width: int = 100) -> str:
    console = Console(width=width, force_terminal=False, legacy_windows=False)
    with console.capture() as capture:
        console.print(display.screen())
    return capture.get()


def test_the_screen_has_figures_and_a_plan() -> None:
    console = Console(width=100, quiet=True)
    display = LiveDisplay(quiet=False, console=console)
    assert "starting" in shown(display)
    display({"line": "takeoff: standing on the ground"})
    assert "takeoff" in shown(display)
    for index in range(100):
        display(progress(index))
    text = shown(display)
    for part in ("track", "9.9 of 60 s", "0.012 m", "1.00, -0.50, 0.25 m/s^2", "46.5 N", "20.4 ms", "83 %", "10.00 m"):
        assert part in text
    assert "2.50e-04 m^2" in text
    assert sum(0x2800 < ord(character) < 0x2900 for character in text) > 20
    assert " o" in text or "o " in text
    assert max(map(len, text.splitlines())) <= 100
    assert max(map(len, shown(display, 80).splitlines())) <= 80


def test_what_is_not_known_is_a_dash() -> None:
    display = LiveDisplay(quiet=False, console=Console(width=100, quiet=True))
    nothing = {"lyapunov": math.nan, "disturbance_m_s2": (math.nan,) * 3, "thrust_n": math.nan, "battery": None}
    display(progress(1, **nothing))
    lines = [line[:47].split() for line in shown(display).splitlines()]
    for name in ("disturbance", "thrust", "Lyapunov", "battery"):
        assert next(line for line in lines if line and line[0] == name)[-1] == "-"


def test_a_display_that_fails_is_left_out_and_the_others_go_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    seen = []

    class Failing:
        def __init__(self, file: Path | None) -> None:
            pass

        def __enter__(self) -> Failing:
            return self

        def __exit__(self, *_: object) -> None:
            pass

        def __call__(self, message: Any) -> None:
            seen.append(message)
            raise OSError("the viewer is gone")

    monkeypatch.setattr(rerun_stream, "RerunStream", Failing)
    with common.flight_display(quiet=False, live=True, rerun=True, rerun_file=None) as display:
        display({"line": "track: one"})
        display({"line": "hold: two"})
    assert len(seen) == 1
    out, err = capsys.readouterr()
    assert "a display failed (the viewer is gone); the flight goes on" in err
    assert "--live needs a terminal" in out
    assert "track: one" in out and "hold: two" in out


def test_the_vehicle_stands_in_the_viewer_as_it_does_in_the_world() -> None:
    for q in ((1.0, 0.0, 0.0, 0.0), quat_from_yaw(1.1), (0.8, 0.36, -0.48, 0.0), (0.1, 0.5, 0.7, 0.5)):
        size = math.sqrt(sum(x * x for x in q))
        unit = (q[0] / size, q[1] / size, q[2] / size, q[3] / size)
        turned = attitude_enu(unit)
        for forward, right, down in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)):
            wanted = enu_from_ned(rotate_to_inertial(unit, (forward, right, down)))
            assert rotate_to_inertial(turned, (forward, -right, -down)) == pytest.approx(wanted, abs=1e-12)


class Recording:
    """What the stream uses of rerun's recording, written down."""

    def __init__(self, name: str) -> None:
        self.logged: list[tuple[str, Any]] = []
        self.calls: list[str] = []
        self.times_s: list[float] = []

    def save(self, path: str) -> None:
        if "missing" in path:
            raise RuntimeError("no such folder")
        self.calls.append(f"save {path}")

    def spawn(self) -> None:
        self.calls.append("spawn")

    def flush(self) -> None:
        self.calls.append("flush")

    def disconnect(self) -> None:
        self.calls.append("disconnect")

    def set_time(self, name: str, duration: float) -> None:
        self.times_s.append(duration)

    def log(self, entity: str, what: Any, *, static: bool = False) -> None:
        self.logged.append((entity, what))


@pytest.fixture
def rerun(monkeypatch: pytest.MonkeyPatch) -> list[Recording]:
    """A stand-in for the viewer's library."""
    made: list[Recording] = []

    def recording(name: str) -> Recording:
        made.append(Recording(name))
        return made[-1]

    def keep(*arguments: Any, **more: Any) -> SimpleNamespace:
        return SimpleNamespace(arguments=arguments, **more)

    module = ModuleType("rerun")
    names = ("Boxes3D", "Arrows3D", "TextLog", "Transform3D", "Quaternion", "Scalars", "LineStrips3D")
    vars(module).update(dict.fromkeys(names, keep))
    vars(module).update(RecordingStream=recording, ViewCoordinates=SimpleNamespace(RIGHT_HAND_Z_UP="z up"))
    monkeypatch.setitem(sys.modules, "rerun", module)
    return made


def test_the_stream_has_path_reference_pose_force_and_scalars(rerun: list[Recording]) -> None:
    with RerunStream() as stream:
        stream({"line": "track: begins"})
        for index in range(150):
            stream(progress(index))
        stream(progress(151, battery=None, disturbance_m_s2=(math.nan,) * 3))
    (recording,) = rerun
    assert recording.calls == ["spawn", "flush", "disconnect"]
    assert recording.times_s[-1] == pytest.approx(15.1)
    last = dict(recording.logged)
    assert {"world/vehicle", "world/flown/0000", "world/flown/0001", "world/reference/0001", "world/disturbance",
            "error_m", "battery", "state_age_ms", "events", "disturbance_m_s2/north"} <= set(last)  # fmt: skip
    ((strip,),) = last["world/flown/0000"].arguments
    assert len(strip) == 100
    assert strip[0] == pytest.approx((0.0, 5.0, 10.0))  # east, north, up
    assert last["world/disturbance"].vectors[0] == pytest.approx([-0.5, 1.0, -0.25])
    assert sum(entity == "battery" for entity, _ in recording.logged) == 150


def test_a_stream_that_cannot_begin_is_refused_in_one_line(
    rerun: list[Recording], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(InputError, match=r"missing.*cannot be written \(no such folder\); --rerun-file"):
        RerunStream(tmp_path / "missing" / "flight.rrd")
    assert main(["demo", "--rerun", "--rerun-file", "x.rrd", "--out", str(tmp_path / "out")]) == 2
    assert "leave one out" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_without_rerun_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(InputError, match=r"pip install 'offboard-companion\[live\]'"):
        RerunStream()


@pytest.mark.skipif(importlib.util.find_spec("rerun") is None, reason="rerun is not installed")
def test_rerun_itself_keeps_a_flight(tmp_path: Path) -> None:
    path = tmp_path / "flight.rrd"
    with RerunStream(path) as stream:
        for index in range(20):
            stream(progress(index))
    assert path.read_bytes()[:4] in {b"RRF2", b"RRIO"}
    assert path.stat().st_size > 1000
