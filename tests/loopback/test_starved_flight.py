"""A loop that is worse than the vehicle file says: lower gains from the start, said, kept, and replayed."""

from __future__ import annotations

from dataclasses import asdict

from flight_cases import INDOOR, Stand, make_flight

from companion.campaign.replay import replay
from companion.flight.engines import kernels
from companion.flight.phases import Cause
from companion.flight.tracker import Tracker
from companion.record.folder import write_configuration, write_summary
from sim_link import codec


class EverySecond:
    """Lets only every second state out."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, stand: Stand, msg_id: int, raw: bytes) -> list[bytes]:
        self.count += msg_id == codec.ID_ODOMETRY
        return [] if msg_id == codec.ID_ODOMETRY and self.count % 2 else [raw]


def test_half_of_the_states_are_flown_with_what_is_certified_for_them(tmp_path) -> None:
    flight = make_flight(trajectory=dict(INDOOR) | {"duration_s": 2.0}, vehicle__controller__gamma_1_s3=1.9)
    with Stand(flight, tmp_path, alter=EverySecond()) as stand, stand.loop() as (loop, record, lines):
        outcome = loop.run()
        tracker = loop._tracker
    assert isinstance(tracker, Tracker)
    assert outcome.cause is Cause.COMPLETED, outcome.sentence
    said = next(line for line in lines if line.startswith("warning: the loop is worse"))
    assert "states at 50 Hz, not 100): output rates, 100% of its gains" in said
    assert outcome.engagement is not None and outcome.engagement.adaptation is not None
    assert outcome.engagement.adaptation.state_rate_hz < 55.0
    assert tracker.vehicle.link.state_rate_hz == outcome.engagement.adaptation.state_rate_hz
    assert "states come too rarely" not in " ".join(lines), "the guards go by what was found before the flight"
    record.save(tmp_path)
    write_configuration(tmp_path, flight.model_dump(exclude_none=True))
    write_summary(tmp_path, {"engagement": asdict(outcome.engagement)})
    assert replay(tmp_path, kernels("python")).identical


def test_the_output_does_not_change_in_flight(tmp_path) -> None:
    """States get rare after the flight has begun: the guards answer, the setpoints stay what they are."""
    flight = make_flight(trajectory=dict(INDOOR) | {"duration_s": 2.0})
    drop = EverySecond()
    with Stand(flight, tmp_path, alter=lambda s, i, raw: drop(s, i, raw) if s.offboard_s > 0.5 else [raw]) as stand:
        flown = stand.fly()
        kinds = {h.message.type_mask for h in stand.setpoints()}
    assert kinds == {128}
    assert any("states come too rarely" in line for line in flown.lines)
