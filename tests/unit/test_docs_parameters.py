"""docs/parameters.md shows the parameters as they are, and their bounds are none that the vehicle file refuses."""

from pathlib import Path

import pytest
from pydantic import ValidationError

from companion.config import Controller, FlightLimits, load_vehicle
from companion.ground.parameters import RESET
from companion.ground.tuning import ENTRIES, NAME_MAX, NEXT, RAMPS, Tuning, find, pack, unpack

PAGE = (Path(__file__).parents[2] / "docs" / "parameters.md").read_text()
VEHICLES = [load_vehicle(name) for name in ("paper", "bundled", "px4_sih", "px4_iris", "windtest")]


def rows():
    table = PAGE.split("## The table", 1)[1]
    cells = [
        [cell.strip().strip("`") for cell in line.strip("|").split("|")] for line in table.splitlines() if "|" in line
    ]
    return {row[0]: row[1:] for row in cells[2:]}


def test_the_table_is_complete_and_true():
    shown = rows()
    assert shown.pop(RESET)[1] == "INT32"
    assert list(shown) == [entry.name for entry in ENTRIES]
    for entry in ENTRIES:
        kind = "INT32" if entry.words else "REAL32"
        bounds = f"{entry.low:g} to {entry.high:g}"
        assert shown[entry.name] == [entry.path, kind, entry.unit or "-", bounds, entry.in_flight, entry.meaning]


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: entry.name)
def test_an_entry_fits_the_protocol_and_the_vehicle_file(entry):
    assert len(entry.name) <= NAME_MAX and entry.name.startswith("OC_") and entry.name.isascii()
    assert entry.in_flight in {RAMPS, NEXT}
    section = {"controller": Controller, "limits": FlightLimits}[entry.section]
    for vehicle in VEHICLES:
        value = Tuning(vehicle).value(entry)
        assert entry.low <= value <= entry.high, vehicle.name
        for bound in (entry.low, entry.high):
            table = Tuning(vehicle).changed(entry, int(bound) if entry.words else bound).overrides[entry.section]
            data = {**getattr(vehicle, entry.section).model_dump(), **table}
            try:
                section.model_validate(data)
            except ValidationError as error:  # only ever for what another limit says
                assert all(finding["loc"] == () for finding in error.errors())
            back = unpack(entry.type, pack(bound if not entry.words else int(bound)))
            assert back == bound, "the bound itself can be set over the link"


def test_all_gains_and_the_heading_can_be_set():
    settable = {entry.key for entry in ENTRIES}
    switches = {"disturbance_start", "rate_lag_inversion", "thrust_lag_compensation", "prediction", "state_gap_max_s"}
    switches |= {"drag_feedforward", "thrust_scale_estimate"}
    # What ends a flight is set in the vehicle file alone.
    guards = {
        "battery_min",
        "disturbance_step_m_s2",
        "disturbance_step_vertical_m_s2",
        "estimate_jump_max_m",
        "estimate_jump_max_m_s",
        "estimate_jump_max_rad",
        "fence_height_m",
        "fence_radius_m",
        "late_steps_max",
        "link_silence_max_s",
        "measured_delay",
        "rate_error_max_rad_s",
        "state_age_max_s",
        "state_rate_min",
    }
    assert set(Controller.model_fields) | set(FlightLimits.model_fields) == settable | switches | guards


@pytest.mark.parametrize("value", [0.7, 0.1, 2.0, 9.81, 1.5708, 100.0, 1e-3, 0.30000001192092896])
def test_a_value_comes_back_from_the_link_as_people_wrote_it(value):
    assert unpack(9, pack(value)) == pytest.approx(value, rel=1e-7)
    assert unpack(9, pack(0.7)) == 0.7
    assert unpack(9, pack(unpack(9, pack(value)))) == unpack(9, pack(value))


def test_the_unknown_is_not_found():
    assert find("MC_ROLL_P") is None and find("") is None and find(RESET) is None
