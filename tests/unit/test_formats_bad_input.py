"""Whatever a trajectory file holds, the answer is a path or one line with file, place and reason: never a fault, and
nothing hangs."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path

import pytest
from format_cases import DATA, EIGHT, MAVSDK, POLYNOMIAL, RPG, SKYBRUSH, mavsdk, polynomial, rpg, samples, skybrush
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from companion.control.types import Reference
from companion.errors import InputError, RefusedError
from companion.frames import Frame
from companion.trajectory.files import Options, shape_of
from companion.trajectory.flatness import PointMass, ReferenceLimits
from companion.trajectory.formats import FORMATS, parse, reading
from companion.trajectory.formats.reading import decoded
from companion.trajectory.load import load
from companion.trajectory.waypoints import PlanLimits

LIMITS = PlanLimits(ReferenceLimits(5.0, 3.0, 0.5, 2.0, 17.0, 2.0), PointMass(1.0, 0.2))


def edited(text: str, line: int, column: int, cell: str) -> str:
    """A table with one cell replaced; lines count from 1, columns from 0."""
    lines = text.splitlines()
    cells = lines[line - 1].split(",")
    cells[column] = cell
    lines[line - 1] = ",".join(cells)
    return "\n".join(lines) + "\n"


def scaled_column(text: str, columns: range, factor: float) -> str:
    """A table with columns in another unit."""
    lines = text.splitlines()
    for i, line in enumerate(lines[1:], start=1):
        cells = line.split(",")
        for column in columns:
            cells[column] = f"{factor * float(cells[column]):.9f}"
        lines[i] = ",".join(cells)
    return "\n".join(lines) + "\n"


R = rpg(EIGHT.at, 3.0, 10.0, 17)
M = mavsdk(EIGHT.at, 3.0, 10.0)
S = skybrush(EIGHT.at, 6.0, 4.0)
P = polynomial(EIGHT.at, 20.0, 10)


def leaning_away() -> str:
    """Attitudes as in a frame with z down: the body's z axis leans away from where the path accelerates."""

    def mirrored(t: float) -> Reference:
        r = EIGHT.at(t)
        return r._replace(a=(-r.a[0], -r.a[1], r.a[2]))

    lines = [R.splitlines()[0]]
    for true, wrong in zip(R.splitlines()[1:], rpg(mirrored, 3.0, 10.0, 17).splitlines()[1:], strict=True):
        lines.append(",".join([*true.split(",")[:4], *wrong.split(",")[4:8], *true.split(",")[8:]]))
    return "\n".join(lines) + "\n"


CASES: dict[str, tuple[str, Frame | None, str]] = {
    # every sampled format: cut off, columns, numbers, time
    "rpg: header alone": (RPG + "\n", "enu", "has no rows"),
    "rpg: five samples": ("\n".join(R.splitlines()[:6]), "enu", "line 6: the file ends after 5 samples"),
    "rpg: cut off within a row": (R[: len(R) - 40], "enu", "line 32: 14 columns, 17 are expected"),
    "rpg: a column more": (
        R.replace("\n", ",0\n").replace(",0\n", "\n", 1),
        "enu",
        "line 2: 18 columns, 17 are expected",
    ),
    "rpg: header of no form": (R.replace(",a_lin_z", "", 1), "enu", "line 1: 16 columns in the header"),
    "rpg: not a number": (edited(R, 5, 2, "nan"), "enu", "line 5: p_y is 'nan'; it must be finite"),
    "rpg: infinite": (edited(R, 5, 2, "-inf"), "enu", "line 5: p_y is '-inf'; it must be finite"),
    "rpg: too large for a number": (edited(R, 5, 2, "1e400"), "enu", "line 5: p_y is '1e400'; it must be finite"),
    "rpg: letters": (edited(R, 5, 2, "abc"), "enu", "line 5: p_y is 'abc', not a number"),
    "rpg: nothing": (edited(R, 5, 2, ""), "enu", "line 5: p_y is '', not a number"),
    "rpg: digits of another script": (edited(R, 5, 2, "\u0664"), "enu", "line 5: p_y is '\u0664', not a number"),
    "rpg: underscores": (edited(R, 5, 2, "1_0"), "enu", "line 5: p_y is '1_0', not a number"),
    "rpg: time goes back": (edited(R, 5, 0, "0.1"), "enu", "line 5: the time 0.1 s goes back behind that in line 4"),
    "rpg: the same time": (edited(R, 5, 0, "0.2"), "enu", "line 5: the time 0.2 s is the same as in line 4"),
    "rpg: no attitude": (edited(R, 5, 4, "0.5"), "enu", "line 5: the attitude q_w .. q_z has the length"),
    "rpg: frame not declared": (R, None, "does not say which frame it is in; declare it with --frame"),
    "rpg: frame with z down": (R, "ned", "the frame ned does not fit"),
    "mavsdk: another frame": (M, "enu", "the frame enu does not fit: a MAVSDK CSV file is in ned"),
    "mavsdk: header cut": (M.replace(",mode", "", 1), None, "line 1: the header must be idx,t,px"),
    "mavsdk: time goes back": (edited(M, 9, 1, "0.05"), None, "line 9: the time 0.05 s goes back"),
    "skybrush: the same time": (edited(S, 9, 0, "1500"), None, "line 9: the time 1.5 s is the same as in line 8"),
    "skybrush: a column less": (S.replace(",0,255,0\n", ",0,255\n"), None, "line 2: 6 columns, 7 are expected"),
    # units
    "rpg: milliseconds": (scaled_column(R, range(1), 1000.0), "enu", "about 1e+03 times as large"),
    "rpg: millimetres": (scaled_column(R, range(1, 4), 1000.0), "enu", "a speed of 999.8 m/s is not believed"),
    "rpg: velocities of 1000 m/s": (edited(R, 5, 8, "1000.0"), "enu", "line 5: the velocity along x is 1000 m/s"),
    "mavsdk: centimetres": (scaled_column(M, range(2, 5), 100.0), None, "is in another unit"),
    "mavsdk: days": (scaled_column(M, range(1, 2), 1e5), None, "is it in another unit?"),
    "skybrush: seconds": (scaled_column(S, range(1), 1e-3), None, "is not believed; are time or position in another"),
    "mavsdk: heading of a compass gone mad": (edited(M, 5, 11, "36000"), None, "line 5: yaw is 36000 deg"),
    "mavsdk: far away": (edited(M, 2, 2, "1e6"), None, "line 2: the position along x is 1e+06 m"),
    # frames that contradict the file itself
    "rpg: written with z down": (leaning_away(), "enu", "lean away from where"),
    "mavsdk: velocities of another frame": (
        scaled_column(M, range(5, 8), -1.0),
        None,
        "the other way along north and east",
    ),
    # polynomials
    "polynomial: 32 columns": (P.replace(",yaw^7", "", 1), None, "line 1: 32 columns in the header, 33 are expected"),
    "polynomial: cut off": (P[: len(P) - 80], None, "columns, 33 are expected"),
    "polynomial: no time": (edited(P, 3, 0, "0.0"), None, "line 3: duration is 0 s; it must be above zero"),
    "polynomial: time goes back": (edited(P, 3, 0, "-1.0"), None, "line 3: duration is -1 s; it must be above zero"),
    "polynomial: not a number": (edited(P, 3, 8, "nan"), None, "line 3: x^7 is 'nan'; it must be finite"),
    "polynomial: 1000 m/s": (edited(P, 3, 2, "1000.0"), None, "line 3: the speed is"),
    "polynomial: milliseconds": (edited(P, 3, 0, "2000.0"), None, "line 3: the position is"),
    "polynomial: endless": (edited(P, 3, 0, "1e300"), None, "line 3: duration is 1e+300 s, more than 21600 s"),
    "polynomial: header alone": (POLYNOMIAL + "\n", None, "has no rows"),
    # waypoints
    "waypoints: one": ("1,2,3\n", "enu", "line 1: the file ends after one point"),
    "waypoints: the same twice": ("1,2,3\n1,2,3\n", "enu", "line 2: the same point as the one before"),
    "waypoints: two columns": ("1,2,3\n1,2\n", "enu", "line 2: 2 columns, 3 are expected"),
    "waypoints: frame not declared": ("1,2,3\n4,5,6\n", None, "does not say which frame it is in"),
    "waypoints: frame of the header": ("north,east,down\n1,2,3\n4,5,6\n", "enu", "the frame enu does not fit"),
    "waypoints: unknown column": ("x,y,z,speed\n1,2,3,4\n", "enu", "line 1: column 'speed' is not known"),
    "waypoints: a column twice": ("x,y,z,x\n1,2,3,4\n", "enu", "line 1: a column comes twice"),
    "waypoints: half a stop": ("x,y,z,stop\n1,2,3,0.5\n", "enu", "line 2: stop is 0.5; it must be 0 or 1"),
    "waypoints: faster than sound": ("x,y,z,speed_m_s\n1,2,3,400\n", "enu", "line 2: speed_m_s is 400 m/s"),
    "waypoints: too fast": (
        "x,y,z,speed_m_s\n0,0,5,0\n# here\n10,0,5,9\n20,0,5,0\n",
        "enu",
        "line 4: waypoint.1.speed_m_s = 9.0: faster than the limit of 5 m/s",
    ),
    # no format
    "prose": (
        "Dear vehicle, please fly a circle.\n",
        None,
        "line 1: 'Dear vehicle, please fly a circle.' does not begin",
    ),
    "comments alone": ("# x\n# y\n", None, "does not begin any known format"),
    "json of something else": ('{"a": 1}\n', None, "does not begin any known format"),
    "a plan that is no JSON": ('{"fileType": "Plan",\n "mission": }\n', None, "line 2: not valid JSON"),
    "a plan with NaN": ('{"fileType": "Plan", "version": NaN}\n', None, "holds NaN, which is no number of JSON"),
    "a plan without bottom": ('{"fileType": ' + "[" * 100_000 + "\n", None, "is nested too deeply"),
    "a number without end": ('{"fileType": ' + "1" * 10_000 + "}\n", None, "not valid JSON"),
}


@pytest.mark.parametrize("case", CASES)
def test_a_wrong_file_is_answered_in_one_line(tmp_path: Path, case: str) -> None:
    text, frame, part = CASES[case]
    path = tmp_path / "path.csv"
    path.write_text(text, encoding="utf-8")
    source = decoded(path.read_bytes(), str(path))
    with pytest.raises(InputError) as caught:
        shape_of(source, path.suffix, Options(frame=frame, limits=LIMITS))
    message = str(caught.value)
    assert part in message, message
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    assert len(message) < 700
    assert caught.value.exit_code == 2


BYTES = {
    "empty": (b"", "is empty"),
    "empty lines": (b"\n\n  \n", "is empty"),
    "zeros": (b"\0" * 1000, "line 1: not a text file (it holds a zero byte)"),
    "rubbish": (b"\x89PNG\r\n\x1a\n\xff\xfe" * 50, "not a text file (UTF-8 expected), byte 0"),
    "a later line": (b"1,2,3\n4,5,\xff\n", "line 2: not a text file (UTF-8 expected), byte 10"),
    "UTF-16": ("x,y,z\n".encode("utf-16"), "is UTF-16 text; save it as UTF-8"),
    "one endless line": (
        b"1,2,3\n" + b"1" * 30_000 + b",2,3\n",
        "line 2: 30004 characters long, at most 20000 are read",
    ),
}


@pytest.mark.parametrize("case", BYTES)
def test_bytes_that_are_no_text(tmp_path: Path, case: str) -> None:
    data, part = BYTES[case]
    path = tmp_path / "path.csv"
    path.write_bytes(data)
    with pytest.raises(InputError) as caught:
        load(path, frame="enu")
    assert part in str(caught.value), str(caught.value)
    assert str(path) in str(caught.value)


def test_a_byte_order_mark_and_windows_lines_do_no_harm(tmp_path: Path) -> None:
    path = tmp_path / "path.csv"
    path.write_bytes(b"\xef\xbb\xbf" + M.replace("\n", "\r\n").encode())
    assert load(path).duration_s == pytest.approx(3.0)


def test_a_gigabyte_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "path.csv"
    with path.open("wb") as file:
        file.write(MAVSDK.encode() + b"\n")
        file.truncate(2**30)  # takes no room on the disk
    with pytest.raises(InputError, match=r"longer than 32 MB, which is the most that is read"):
        load(path)
    os.replace(path, tmp_path / "path.toml")
    with pytest.raises(InputError, match=r"longer than 32 MB, which is the most that is read"):
        load(tmp_path / "path.toml")


def test_rows_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reading, "ROWS_MAX", 20)
    with pytest.raises(InputError, match=r"line 22: more than 20 rows, which are the most that are read"):
        parse(decoded(M.encode(), "a.csv"))


def test_a_pipe_does_not_block(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "path.csv")
    with pytest.raises(InputError):
        load(tmp_path / "path.csv")
    (tmp_path / "a.toml").write_text('file = "path.csv"\n')
    with pytest.raises(InputError, match="not a regular file"):
        load(tmp_path / "a.toml")


WRAPPERS = {
    "nothing": ("frame = 'enu'\n", ["unknown key 'frame'"]),
    "no such file": ("file = 'nothing.csv'\n", ["nothing.csv: cannot be read: No such file"]),
    "a folder": ("file = '.'\n", ["cannot be read: Is a directory"]),
    "file and text": ("file = 'a'\ntext = 'b'\n", ["give either file or text"]),
    "unknown frame": ("file = 'a'\nframe = 'flu'\n", ["frame = 'flu'", "'ned', 'enu' or 'nwu'"]),
    "unknown format": ("file = 'a'\nformat = 'xls'\n", ["format = 'xls'", "mavsdk-csv"]),
    "unknown key": ("file = 'a'\nfame = 'ned'\n", ["unknown key 'fame' = 'ned'", "frame"]),
    "no pace": ("file = 'a'\ntime_scale = 0.0\n", ["time_scale = 0.0", "greater than 0"]),
    "no smoothing": ("file = 'a'\nsmooth_m = -1.0\n", ["smooth_m = -1.0", "greater than 0"]),
    "no origin": ("file = 'a'\norigin = [91.0, 0.0, 0.0]\n", ["origin.0 = 91.0"]),
    "wrong checksum": ("text = 'a'\nsha256 = '12'\n", ["sha256 = '12'"]),
    "another file": ("file = 'real.csv'\nsha256 = '" + 64 * "0" + "'\n", ["real.csv: is not the file any more"]),
    "zero in the path": ("file = 'a\\u0000b'\n".replace("'", '"'), ["not a usable path"]),
    "nested without end": ("a = " + "[" * 100_000 + "\n", ["not valid TOML"]),
    "a number without end": ("a = " + "1" * 10_000 + "\n", ["not valid TOML"]),
}


@pytest.mark.parametrize("case", WRAPPERS)
def test_a_wrong_file_of_ours_around_it(tmp_path: Path, case: str) -> None:
    text, parts = WRAPPERS[case]
    (tmp_path / "real.csv").write_text(M)
    path = tmp_path / "a.toml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        load(path)
    assert all(part in str(caught.value) for part in parts), str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_from_elsewhere_names_only_its_neighbours(tmp_path: Path) -> None:
    inside = tmp_path / "inside"
    inside.mkdir()
    (tmp_path / "secret.csv").write_text(M)
    (inside / "near.csv").write_text(M)
    for name in ("../secret.csv", str(tmp_path / "secret.csv"), "../inside/../secret.csv"):
        (inside / "a.toml").write_text(f"file = '{name}'\n")
        with pytest.raises(InputError, match="must be the name of a file in the same folder"):
            load(inside / "a.toml", confined=True)
    (inside / "a.toml").write_text("file = 'near.csv'\n")
    assert load(inside / "a.toml", confined=True).duration_s == pytest.approx(3.0)


def test_names_that_no_terminal_likes(tmp_path: Path) -> None:
    path = tmp_path / os.fsdecode(b"\xff\x1b[31m\n.csv")
    path.write_text("rubbish\n")
    with pytest.raises(InputError) as caught:
        load(path)
    message = str(caught.value)
    assert message.isprintable()
    message.encode("utf-8")
    path.write_text(M)
    assert load(path).name.isprintable()


# Fuzzing: arbitrary bytes, and real files with parts of them changed.

SMALL = {
    "rpg": rpg(EIGHT.at, 2.0, 10.0, 17, digits=4),
    "mavsdk": mavsdk(EIGHT.at, 2.0, 10.0, digits=4),
    "skybrush": skybrush(EIGHT.at, 5.0, 4.0),
    "polynomial": polynomial(EIGHT.at, 6.0, 3),
    "waypoints": "x,y,z,yaw_deg,speed_m_s,stop\n0,0,5,0,0,0\n5,0,5,0,1,0\n5,5,6,90,0,1\n0,5,5,90,0,0\n",
    "plan": samples()["square.plan"],
    "wpl": samples()["square.waypoints"],
}
TOKENS = st.sampled_from(
    [
        "nan",
        "inf",
        "-1",
        "0",
        "1e308",
        "1e-308",
        "-1e400",
        "9" * 400,
        "",
        ",",
        "\n",
        "\r",
        "\t",
        "#",
        "1_0",
        "0x10",
        "null",
    ]
    + [
        "\x00",
        "\u0664",
        "true",
        "{",
        "}",
        "[",
        "]",
        '"',
        "e",
        ".",
        "QGC WPL 110",
        RPG,
        MAVSDK,
        SKYBRUSH,
        POLYNOMIAL,
        "x,y,z",
    ]
)


@st.composite
def damaged(draw: st.DrawFn) -> tuple[str, bytes]:
    """A file with a few parts of it cut, repeated or replaced."""
    kind = draw(st.sampled_from(sorted(SMALL)))
    text = SMALL[kind]
    for _ in range(draw(st.integers(1, 4))):
        begin = draw(st.integers(0, len(text)))
        end = min(len(text), begin + draw(st.integers(0, 40)))
        put = draw(st.one_of(TOKENS, st.text(max_size=8), st.just(text[begin:end] * 2)))
        text = text[:begin] + put + text[end:]
    return kind, text.encode("utf-8", "surrogatepass")


def attempt(data: bytes, limits: PlanLimits | None) -> None:
    """Load, with each way to declare a frame; only errors for people may come out of it."""
    for frame in (None, "enu", "ned"):
        try:
            made = shape_of(decoded(data, "fuzz"), ".csv", Options(frame=frame, limits=limits))  # type: ignore[arg-type]
        except (InputError, RefusedError) as error:
            assert "\n" not in str(error)
            assert len(str(error)) < 1000
        else:
            assert made.duration_s > 0.0
            for share in (0.0, 0.5, 1.0):
                made.shape.at(share * made.duration_s)


@settings(max_examples=120, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(damaged())
def test_damaged_files_never_cause_a_fault(case: tuple[str, bytes]) -> None:
    attempt(case[1], None)  # without limits nothing is planned: that is the planner's own test


@settings(max_examples=80, deadline=None)
@given(st.binary(max_size=300))
def test_bytes_never_cause_a_fault(data: bytes) -> None:
    attempt(data, None)


@settings(max_examples=60, deadline=None)
@given(st.sampled_from([entry.name for entry in FORMATS]), st.text(max_size=200))
def test_text_taken_for_any_format_never_causes_a_fault(name: str, text: str) -> None:
    for frame in (None, "enu", "ned"):
        try:
            source = decoded(text.encode("utf-8", "surrogatepass"), "fuzz")
            parse(source, name=name, frame=frame)  # type: ignore[arg-type]
        except InputError as error:
            assert "\n" not in str(error)


cells = st.sampled_from(["0", "1", "-1", "0.1", "1e-9", "1e5", "99999", "1e-300", "nan", "x", "0.30000000000000004"])


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(st.tuples(cells, cells, cells, cells), min_size=12, max_size=20))
def test_tables_of_odd_numbers_never_cause_a_fault(rows: list[tuple[str, str, str, str]]) -> None:
    text = SKYBRUSH + "\n" + "".join(",".join((*row, "0", "0", "0")) + "\n" for row in rows)
    attempt(text.encode(), None)


@settings(max_examples=20, deadline=None)
@given(st.lists(st.floats(1e-6, 1e3), min_size=12, max_size=30), st.floats(0.0, 1.0))
def test_uneven_clocks_never_cause_a_fault(steps: list[float], span: float) -> None:
    lines, t = [SKYBRUSH], 0.0
    for i, step in enumerate(steps):
        t += step
        lines.append(f"{1000.0 * t!r},{span * i * 1e-4!r},{(-1) ** i * 1e-5!r},5,0,0,0")
    attempt(("\n".join(lines) + "\n").encode(), None)


@settings(max_examples=60, deadline=None)
@given(st.text(alphabet="file=txrmnud.[]'\"#\n 019-", max_size=80))
def test_files_of_ours_never_cause_a_fault(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzz.toml"
    path.write_text(text)
    try:
        load(path)
    except InputError:
        pass
    else:
        assert tomllib.loads(text)


def test_every_sample_is_recognised_by_its_contents() -> None:
    suffixes = {name: Path(name).suffix for name in samples()}
    for name, suffix in suffixes.items():
        found = [entry.name for entry in FORMATS if entry.matches(decoded((DATA / name).read_bytes(), name))]
        assert len(found) == 1, (name, found)
        assert suffix in next(entry for entry in FORMATS if entry.name == found[0]).suffixes
