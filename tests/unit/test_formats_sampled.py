"""Sampled files and polynomial files: what is loaded is the path that they were written from."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from format_cases import DATA, EIGHT, SWIFT, mavsdk, polynomial, rest_to_rest, rpg, samples, skybrush

from companion.control.types import Reference
from companion.errors import InputError
from companion.frames import Frame
from companion.trajectory.anchored import Trajectory
from companion.trajectory.batch import batch
from companion.trajectory.continuity import findings
from companion.trajectory.feasibility import grid
from companion.trajectory.fit import fit
from companion.trajectory.load import load
from companion.trajectory.shapes import Heading, Lemniscate, Shape


def written(folder: Path, text: str, name: str = "path.csv") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def errors(trajectory: Trajectory, shape: Shape) -> list[float]:
    """Largest distance of position and of each derivative from the truth."""
    times = [trajectory.duration_s * i / 1000 for i in range(1001)]
    pairs = [(trajectory.at(t), shape.at(t)) for t in times]
    return [max(math.dist(a[k], b[k]) for a, b in pairs) for k in range(5)]  # type: ignore[arg-type]


def assert_continuous(trajectory: Trajectory) -> None:
    """Up to the fourth derivative: no joint jumps, and each derivative is that of the one below."""
    times = grid(trajectory)
    assert findings(trajectory, times, batch(trajectory, times)) == []
    snap = max(math.hypot(*trajectory.at(t).s) for t in times)
    assert all(math.dist(before.s, after.s) < 1e-5 * max(snap, 1.0) for _, before, after in trajectory.joints())


@pytest.mark.parametrize("name", sorted(samples()))
def test_the_samples_are_what_the_closed_forms_give(name: str) -> None:
    assert (DATA / name).read_text(encoding="utf-8") == samples()[name]


@pytest.mark.parametrize(
    ("name", "frame", "bounds"),
    [
        ("eight-rpg.csv", "enu", (1e-8, 1e-7, 1e-6, 1e-5, 1e-4)),
        ("eight-mavsdk.csv", None, (2e-6, 2e-5, 1e-4, 5e-4, 2e-3)),
        ("eight-skybrush.csv", None, (1e-3, 5e-3, 1e-2, 2e-2, 3e-2)),
        ("eight-polynomial.csv", None, (3e-4, 5e-4, 2e-3, 1e-2, 3e-2)),
    ],
)
def test_the_papers_path_from_every_format(name: str, frame: Frame | None, bounds: tuple[float, ...]) -> None:
    trajectory = load(DATA / name, frame=frame)
    found = errors(trajectory, EIGHT)
    assert all(error < bound for error, bound in zip(found, bounds, strict=True)), found
    assert (trajectory.anchor, trajectory.join) == ("here", "smooth")
    assert trajectory.notes


@pytest.mark.parametrize("name", ["eight-mavsdk.csv", "eight-skybrush.csv"])
def test_sampled_paths_are_continuous_to_the_fourth_derivative(name: str) -> None:
    assert_continuous(load(DATA / name))


@pytest.mark.parametrize("columns", [8, 11, 14, 17, 20, 24, 27, 30])
def test_every_form_of_the_rpg_format(tmp_path: Path, columns: int) -> None:
    trajectory = load(written(tmp_path, rpg(SWIFT.at, 6.0, 50.0, columns)), frame="enu")
    assert errors(trajectory, SWIFT)[0] < 1e-6
    # 30 degrees counter-clockwise from east are 60 degrees clockwise from north; leaning turns it a little.
    assert trajectory.at(3.0).yaw == pytest.approx(math.radians(60.0), abs=0.01)
    assert any("velocities differ" in note for note in trajectory.notes) == (columns >= 11)
    assert any("accelerations differ" in note for note in trajectory.notes) == (columns >= 17)


def test_the_declared_frame_counts(tmp_path: Path) -> None:
    path = written(tmp_path, rpg(SWIFT.at, 6.0, 50.0, 8))
    east_first, north_first = load(path, frame="enu"), load(path, frame="nwu")
    for t in (0.0, 2.0, 5.0):
        n, e, d = east_first.at(t).p
        assert north_first.at(t).p == pytest.approx((e, -n, d))


def test_heading_of_a_mavsdk_file_goes_on_through_a_turn(tmp_path: Path) -> None:
    shape = replace(SWIFT, heading=Heading(1.0, 0.7))
    trajectory = load(written(tmp_path, mavsdk(shape.at, 20.0, 10.0)))
    for t in (0.5, 7.0, 19.0):
        assert math.remainder(trajectory.at(t).yaw - shape.at(t).yaw, math.tau) == pytest.approx(0.0, abs=1e-6)
        assert trajectory.at(t).yaw_rate == pytest.approx(0.7, abs=1e-5)


def test_rounded_samples_are_smoothed_and_the_distance_is_reported(tmp_path: Path) -> None:
    trajectory = load(written(tmp_path, skybrush(SWIFT.at, 30.0, 20.0, digits=2)))
    found = errors(trajectory, SWIFT)
    # Through every sample, a centimetre at 20 Hz would be some ten thousand m/s^4.
    assert found[0] < 0.01
    assert found[4] < 2.0
    note = trajectory.notes[0]
    assert note.startswith("601 samples at 20 Hz became a spline of degree 9 with ")
    assert "m of the samples" in note


def test_noise_is_not_followed() -> None:
    rng = np.random.default_rng(7)
    t = np.arange(0.0, 20.0, 0.02)
    true = np.stack([np.cos(t), np.sin(t), 0.0 * t], axis=1)
    curve = fit(t, true + 0.005 * rng.standard_normal(true.shape))
    inner = t[50:-50]
    assert not curve.through
    assert curve.rms == pytest.approx(0.005 * math.sqrt(3.0), rel=0.1)
    assert np.abs(curve.spline(inner) - true[50:-50]).max() < 0.005
    assert np.abs(curve.spline(inner, 2) + true[50:-50]).max() < 0.1


def test_samples_far_apart_are_gone_through() -> None:
    t = np.arange(0.0, 60.0, 0.5)
    p = np.stack([5.0 * np.cos(t), 2.5 * np.sin(2.0 * t)], axis=1)
    curve = fit(t, p)
    assert curve.through
    assert curve.largest < 1e-9
    assert 0.0 < curve.left_out < 5.0


def test_smooth_m_trades_distance_for_smoothness(tmp_path: Path) -> None:
    path = written(tmp_path, skybrush(SWIFT.at, 30.0, 20.0), "exact.csv")
    (tmp_path / "a.toml").write_text('file = "exact.csv"\nsmooth_m = 0.5\n')
    smooth, close = load(tmp_path / "a.toml"), load(path)
    assert len(smooth.joints()) < len(close.joints())
    assert errors(close, SWIFT)[0] < 2e-3
    # Within half a metre of every sample, and between them not much farther away.
    assert 0.01 < errors(smooth, SWIFT)[0] < 0.6


@pytest.mark.parametrize("rate_hz", [10.0, 100.0])
def test_an_end_at_rest_is_at_rest(tmp_path: Path, rate_hz: float) -> None:
    at = rest_to_rest(10.0, 6.0)
    trajectory = load(written(tmp_path, mavsdk(at, 6.0, rate_hz)))
    for t in (0.0, 6.0):
        reference = trajectory.at(t)
        assert all(math.hypot(*reference[k]) < 1e-6 for k in range(1, 5))  # type: ignore[misc]
        assert reference.p == pytest.approx(at(t).p, abs=1e-5)
    assert_continuous(trajectory)


def test_a_file_that_waits_before_it_moves(tmp_path: Path) -> None:
    moved = rest_to_rest(10.0, 6.0)
    trajectory = load(written(tmp_path, skybrush(lambda t: moved(t - 2.0), 10.0, 10.0)))
    assert max(math.dist(trajectory.at(0.1 * i).p, moved(0.1 * i - 2.0).p) for i in range(101)) < 2e-3
    assert math.hypot(*trajectory.at(0.0).v) < 1e-9


def test_a_clock_that_does_not_begin_at_zero(tmp_path: Path) -> None:
    lines = rpg(SWIFT.at, 6.0, 50.0, 11).splitlines()
    shifted = [lines[0]]
    for line in lines[1:]:
        t, _, rest = line.partition(",")
        shifted.append(f"{float(t) + 1.7e9:.2f},{rest}")
    trajectory = load(written(tmp_path, "\n".join(shifted)), frame="enu")
    assert trajectory.duration_s == pytest.approx(6.0, abs=1e-6)
    assert errors(trajectory, SWIFT)[0] < 1e-4


def test_time_scale_and_anchor_of_a_wrapping_file(tmp_path: Path) -> None:
    (tmp_path / "eight.csv").write_text((DATA / "eight-mavsdk.csv").read_text())
    (tmp_path / "slow.toml").write_text('file = "eight.csv"\ntime_scale = 0.5\nanchor = "local"\njoin = "law"\n')
    trajectory = load(tmp_path / "slow.toml")
    assert (trajectory.duration_s, trajectory.anchor, trajectory.join) == (60.0, "local", "law")
    assert trajectory.at(10.0).v == pytest.approx(tuple(0.5 * x for x in EIGHT.at(5.0).v), abs=1e-4)


def test_a_gap_is_named(tmp_path: Path) -> None:
    lines = mavsdk(EIGHT.at, 30.0, 10.0).splitlines()
    del lines[100:130]
    notes = load(written(tmp_path, "\n".join(lines))).notes
    assert any("between lines 100 and 101 3.1 s pass" in note for note in notes)


def test_polynomials_are_taken_as_they_are(tmp_path: Path) -> None:
    shape = Lemniscate(amplitude_m=(5.0, 2.5), angular_rate_rad_s=0.4, heading=Heading(0.3))
    trajectory = load(written(tmp_path, polynomial(shape.at, 15.0, 10, digits=15)))
    pieces = trajectory.joints()
    assert len(pieces) == 9
    for t_s, before, after in pieces:
        true = shape.at(t_s)
        for side in (before, after):
            assert all(side[k] == pytest.approx(true[k], abs=1e-9) for k in range(4))
            assert side.yaw == pytest.approx(0.3)
        # Hermite pieces of degree 7: the fourth derivative jumps, and stays as the file has it.
        assert math.dist(before.s, after.s) > 1e-4


def test_pieces_that_meet_but_for_rounding_are_joined(tmp_path: Path) -> None:
    trajectory = load(written(tmp_path, polynomial(EIGHT.at, 62.0, 31, digits=6)))
    assert any("but for rounding" in note for note in trajectory.notes)
    for _, before, after in trajectory.joints():
        assert all(math.dist(before[k], after[k]) < 1e-9 for k in range(4))  # type: ignore[arg-type]


def test_a_jump_that_rounding_does_not_explain_stays(tmp_path: Path) -> None:
    lines = polynomial(EIGHT.at, 62.0, 31).splitlines()
    cells = lines[5].split(",")
    cells[1] = f"{float(cells[1]) + 0.01:.6f}"
    lines[5] = ",".join(cells)
    jumps = [math.dist(b.p, a.p) for _, b, a in load(written(tmp_path, "\n".join(lines))).joints()]
    assert sorted(jumps)[-2:] == pytest.approx([0.01, 0.01], abs=1e-3)


def test_velocities_are_compared() -> None:
    note = next(note for note in load(DATA / "eight-mavsdk.csv").notes if "velocities" in note)
    assert float(note.split(" m/s rms")[0].rsplit(" ", 1)[1]) < 1e-5


def at_rest(t: float) -> Reference:
    zero = (0.0, 0.0, 0.0)
    return Reference((1.0, 2.0, -3.0), zero, zero, zero, zero, 0.0, 0.0, 0.0)


def test_a_file_that_does_not_move(tmp_path: Path) -> None:
    trajectory = load(written(tmp_path, skybrush(at_rest, 5.0, 10.0)))
    assert trajectory.at(2.5).p == pytest.approx((1.0, 2.0, -3.0), abs=1e-9)
    assert math.hypot(*trajectory.at(2.5).v) < 1e-9


def test_the_format_can_be_named(tmp_path: Path) -> None:
    (tmp_path / "eight.csv").write_text((DATA / "eight-mavsdk.csv").read_text())
    (tmp_path / "a.toml").write_text('file = "eight.csv"\nformat = "rpg-csv"\n')
    with pytest.raises(InputError, match="does not begin a file of the format rpg-csv"):
        load(tmp_path / "a.toml")
