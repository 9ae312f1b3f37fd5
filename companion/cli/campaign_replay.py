"""`companion campaign replay`: one flight of a campaign again, alone."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from companion.cli.common import flight_display, report_flight, say
from companion.errors import ExitCode

CONNECT_TIMEOUT_S = 15.0
UNGUARDED = {
    "tilt_max_rad": 1.57,
    "position_error_abort_m": 1e6,
    "disturbance_step_m_s2": 1e3,
    "disturbance_step_vertical_m_s2": 1e3,
    "estimate_jump_max_m": 1e3,
    "estimate_jump_max_m_s": 1e3,
    "estimate_jump_max_rad": 3.0,
    "state_age_max_s": 1.0,
    "battery_min": 0.0,
}
"""What gates and guards judge by, moved out of the way."""
SHOWN = ("settled_at_s", "rms_m", "max_m", "error_max_m", "saturated_s", "thrust_min_n", "tilt_max_rad")


def replay(
    folder: Path, number: int, out: Path | None, *, mavlink: bool, guarded: bool, engine: str, as_json: bool
) -> int:
    """Fly it in this process, tell whether it is the campaign's flight to the bit, then over MAVLink.

    Returns:
        the exit code.
    """
    from companion import accelerate
    from companion.campaign.outcome import RAISED, as_row, fly_number
    from companion.campaign.store import open_folder, require_pyarrow

    require_pyarrow()
    study = open_folder(folder)
    study.values(number)  # there is such a flight
    outcome = fly_number(study, number, accelerate.resolve(engine))
    kept = _kept(folder, number)
    same = None if kept is None else _same(kept, outcome)
    row = as_row(outcome)
    if not as_json or mavlink:
        _say(row, same, quiet=as_json)
    if mavlink and outcome.ended == RAISED:
        say("it cannot be built, so there is nothing to fly over MAVLink", quiet=as_json)
        mavlink = False
    if not mavlink:
        if as_json:
            print(json.dumps({**row, "identical": same}, indent=2))
        return int(ExitCode.DONE)
    return _over_mavlink(study.case(number), number, out, guarded, engine, as_json)


def _over_mavlink(case: Any, number: int, out: Path | None, guarded: bool, engine: str, as_json: bool) -> int:
    from companion.flight.bundled import BundledVehicle
    from companion.flight.launch import control, prepare

    if not case.throw.still:
        say("over MAVLink a vehicle waits in Hold: it is flown from rest and level at the same place", quiet=as_json)
    known = case.flight.model_copy(update={"name": f"{case.flight.name}-{number}"})
    if not guarded:
        limits = known.vehicle.limits.model_copy(update=UNGUARDED)
        known = known.model_copy(update={"vehicle": known.vehicle.model_copy(update={"limits": limits})})
        say("unguarded: the limits of tilt, error, estimate and envelope are out of the way", quiet=as_json)
    real = known.model_copy(update={"vehicle": case.vehicle})
    with flight_display(quiet=as_json, live=False, rerun=False, rerun_file=None) as display:
        folder = prepare(known, out)
        with BundledVehicle(real, folder, px4="1.18", engine=engine, lockstep=True) as bundled:

            def listen(message: Any) -> None:
                display(message)
                if "flown" in message:
                    bundled.stop()

            flown = control(folder, bundled.connection, engine, CONNECT_TIMEOUT_S, listen)
    return report_flight(flown, as_json=as_json)


def _kept(folder: Path, number: int) -> dict[str, Any] | None:
    """The campaign's own row of a flight, if it is there."""
    from companion.campaign.store import read_flights
    from companion.errors import InputError

    try:
        table = read_flights(folder)
    except InputError:
        return None
    import pyarrow.compute as pc

    rows: list[dict[str, Any]] = table.filter(pc.equal(table["flight"], number)).to_pylist()
    return rows[0] if rows else None


def _same(kept: dict[str, Any], outcome: Any) -> bool:
    """Whether an outcome is the campaign's to the bit."""
    import numpy as np

    measures = all(np.array_equal(kept[name], value, equal_nan=True) for name, value in outcome.measures.items())
    error = np.array(kept["error_m"], dtype=np.float32)
    return bool(
        measures
        and kept["ended"] == outcome.ended
        and np.array_equal(error, outcome.error_m, equal_nan=True)
        and all(kept[name] == value for name, value in outcome.values.items())
    )


def _say(row: dict[str, Any], same: bool | None, *, quiet: bool) -> None:
    from companion.campaign.outcome import MEASURES

    verdict = {None: "which the campaign has not flown yet", True: "the campaign's to the bit"}.get(
        same, "NOT the campaign's: another engine, or another version of the program or of numba, flew it"
    )
    say(f"flight {row['flight']} (seed {row['seed']}), {verdict}", quiet=quiet)
    for name, value in row.items():
        if "." in name:
            say(f"  {name:32s} {value:.6g}" if isinstance(value, float) else f"  {name:32s} {value}", quiet=quiet)
    say(f"  {'outcome':32s} {'converged' if row['converged'] else row['reason']}", quiet=quiet)
    for name in SHOWN:
        value = row[name]
        shown = "-" if value is None else f"{value:.4f} {MEASURES[name].unit}"
        say(f"  {name.rpartition('_')[0]:32s} {shown}", quiet=quiet)
