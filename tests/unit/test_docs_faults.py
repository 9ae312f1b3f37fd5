"""docs/faults.md lists every kind of fault with its keys, their defaults and an example that can be flown."""

import re
import tomllib
from pathlib import Path

import pytest

from sim_link import fault_file, fault_keys
from sim_link.fault_kinds import KINDS
from sim_link.vehicle import Vehicle

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "faults.md").read_text(encoding="utf-8")
SECTIONS = dict(re.findall(r"^### `(\w+)`\n(.*?)(?=^##|\Z)", TEXT, re.MULTILINE | re.DOTALL))


def test_every_kind_has_its_section() -> None:
    assert list(SECTIONS) and set(SECTIONS) == set(KINDS)


@pytest.mark.parametrize("name", KINDS)
def test_the_table_of_a_kind_has_its_keys_and_defaults(name: str) -> None:
    rows = re.findall(r"^\| `(\w+)` \| (.*?) \| (.+) \|$", SECTIONS[name], re.MULTILINE)
    assert [row[0] for row in rows] == [key.name for key in KINDS[name].keys]
    for key, (_, told, _) in zip(KINDS[name].keys, rows, strict=True):
        if key.default is ...:
            assert told == "required"
        elif key.default is None:
            assert told == "none"
        elif key.default == ():
            assert told == "all"
        else:
            value = tomllib.loads(f"value = {told}")["value"]
            assert key.read(value) == key.default


@pytest.mark.parametrize("name", KINDS)
def test_the_example_of_a_kind_is_a_fault_file(name: str) -> None:
    (example,) = re.findall(r"```toml\n(.*?)```", SECTIONS[name], re.DOTALL)
    (fault,) = fault_file.parse(tomllib.loads(example), name)
    assert fault.kind == name
    fault_file.check_parameters([fault], "1.18")


def test_the_bundled_files_are_named_and_can_be_flown() -> None:
    (sentence,) = re.findall(r"Bundled files: (.*?)\n\n", TEXT, re.DOTALL)
    names = sorted(path.stem for path in (ROOT / "config" / "faults").glob("*.toml"))
    assert sorted(re.findall(r"`(\w+)`", sentence)) == names
    for name in names:
        assert fault_file.load(name)


def test_the_python_examples_run() -> None:
    """As written, but for the process whose port is not there."""
    connected, own = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    compile(connected, "docs/faults.md", "exec")
    names: dict[str, object] = {}
    exec(own, names)
    vehicle = names["vehicle"]
    assert isinstance(vehicle, Vehicle)
    vehicle.tick()
    assert {fault.kind for fault in vehicle.faults.active.values()} == {"loss", "wind"}


def test_what_the_text_says_of_numbers() -> None:
    from sim_link.datagram_faults import ORDER
    from sim_link.faults import GPS_LOST_DRIFT_M_S

    assert f"order {', '.join(ORDER)}" in " ".join(TEXT.split())
    assert str(GPS_LOST_DRIFT_M_S) in TEXT
    assert fault_keys.read_command("DO_SET_MODE") == fault_keys.read_command("MAV_CMD_DO_SET_MODE") == 176
