"""docs/log.md has every topic of flight.ulg with its fields, types, units and meanings, and its examples work."""

import re
from pathlib import Path

import pytest

from companion.config import build_flight, find, read_toml
from companion.record import topics
from companion.record.flight_log import _numbers

TEXT = (Path(__file__).parents[2] / "docs" / "log.md").read_text(encoding="utf-8")
SECTIONS = dict(re.findall(r"^### `(\w+)`\n\n(.*?)(?=^##|\Z)", TEXT, re.MULTILINE | re.DOTALL))


def test_the_topics_are_there_in_their_groups() -> None:
    wanted = [
        ("With every state", topics.STATE_TOPICS),
        ("With every setpoint", topics.SETPOINT_TOPICS),
        ("With every control step", topics.STEP_TOPICS),
        ("When the autopilot reports it", topics.REPORT_TOPICS),
    ]
    for title, group in wanted:
        (part,) = re.findall(rf"^## {title}\n(.*?)(?=^## )", TEXT, re.MULTILINE | re.DOTALL)
        assert re.findall(r"^### `(\w+)`", part, re.MULTILINE) == [topic.name for topic in group]
    assert set(SECTIONS) == {topic.name for topic in topics.TOPICS}


@pytest.mark.parametrize("topic", topics.TOPICS, ids=lambda topic: topic.name)
def test_the_table_of_a_topic_is_the_topics(topic: topics.Topic) -> None:
    section = SECTIONS[topic.name]
    assert section.splitlines()[0] == f"{topic.meaning[0].upper()}{topic.meaning[1:]}."
    rows = re.findall(r"^\| `(\w+)` \| `([\w\[\]]+)` \| (.*?) ?\| (.+) \|$", section, re.MULTILINE)
    assert rows == [(field.name, field.type, field.unit, field.meaning) for field in topic.fields]


def test_the_parameters_that_are_named_exist() -> None:
    (item,) = re.findall(r"^- \*\*Parameters\*\*:(.*?)(?=^- )", TEXT, re.MULTILINE | re.DOTALL)
    flight = build_flight(read_toml(find("paper", "flights")), "paper").model_dump(exclude_none=True)
    known = {key for key, _ in _numbers(_lists(flight))}
    named = [name for name in re.findall(r"`([a-z]\w*(?:/\w+)*)`", item)]
    assert len(named) == 4
    assert set(named) <= known


def _lists(value: object) -> object:
    if isinstance(value, dict):
        return {key: _lists(below) for key, below in value.items()}
    return list(value) if isinstance(value, tuple) else value


def test_the_examples_name_what_exists() -> None:
    (names,) = re.findall(r"ulog2csv -m (\S+)", TEXT)
    assert set(names.split(",")) <= set(SECTIONS)
    topic, field = re.findall(r'get_dataset\("(\w+)"\)\.data\["(\w+)\[0\]"\]', TEXT)[0]
    assert f"| `{field}` | `double[3]`" in SECTIONS[topic]
