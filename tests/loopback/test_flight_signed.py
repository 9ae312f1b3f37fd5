"""Flights over a signed link: the same flight to the number, whatever is recorded, repeated or pretended beside it."""

from __future__ import annotations

import numpy as np
import pytest
from flight_cases import HOVER, Stand, make_flight

from companion.flight.engines import kernels
from companion.flight.loop import FlightLoop
from companion.flight.phases import PHASE_NAMES, Cause
from companion.link import codec
from companion.link.framing import build_frame
from companion.link.key_file import load_key, new_key
from companion.link.vehicle_link import VehicleLink
from companion.record.flight_record import FlightRecord
from companion.trajectory.load import of_flight
from sim_link.codec import ID_ODOMETRY

SHORT = dict(HOVER) | {"duration_s": 0.5}


@pytest.fixture(autouse=True)
def state(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)


def flown(stand: Stand, key: str | None) -> tuple:
    record = FlightRecord(2000, PHASE_NAMES)
    with VehicleLink(f"udpin:127.0.0.1:{stand.port}", key).open() as wire:
        outcome = FlightLoop(
            *(stand.flight, of_flight(stand.flight), wire, record, kernels("python")), connect_timeout_s=15.0
        ).run()
        return outcome, record, wire.refusals


def test_signed_flights_are_the_same_flight(tmp_path) -> None:
    """Twice the same to the last bit. Without a key one thing differs: when the first requests are acted on."""
    new_key(tmp_path / "key")
    flight = make_flight(trajectory=SHORT)
    with Stand(flight, tmp_path) as stand:
        plain, plain_record, _ = flown(stand, None)
    found = []
    for _ in range(2):
        with Stand(flight, tmp_path, signing_key=load_key(tmp_path / "key").secret, signing_time=77) as stand:
            signed, record, refused = flown(stand, str(tmp_path / "key"))
            assert stand.vehicle.keyring.refused.total() == 0
        assert (plain.cause, signed.cause) == (Cause.COMPLETED, Cause.COMPLETED)
        assert refused["stale"] + refused["replayed"] == 1  # the vehicle began in the past
        assert refused["unsigned"] == refused["wrong_signature"] == 0
        found.append(record)
    assert len(found[0]) == len(found[1]) == len(plain_record) > 20
    for name in ("t_s", "track_s", "error_n", "error_d", "thrust_n"):
        np.testing.assert_array_equal(found[0].column(name), found[1].column(name), name)
        np.testing.assert_allclose(found[0].column(name), plain_record.column(name), rtol=1e-3, atol=1e-3)


def test_recordings_and_forgeries_from_the_vehicles_own_port_do_not_reach_the_flight(tmp_path) -> None:
    """With every state come the one of before again, and others that tell of a vehicle a kilometre away."""
    new_key(tmp_path / "key")
    flight = make_flight(trajectory=SHORT)
    far = bytes(8) + b"\0\0\x7a\x44" * 3 + bytes(213)
    last: list[bytes] = []

    def beside(stand: Stand, msg_id: int, raw: bytes) -> list[bytes]:
        if msg_id != ID_ODOMETRY:
            return [raw]
        forged = build_frame(codec.ODOMETRY, far, 0, 1, 1, codec.message_formats()[codec.ODOMETRY].crc_extra)
        before, last[:] = last[:], [raw]
        return [*before, forged, raw]

    with Stand(flight, tmp_path, signing_key=load_key(tmp_path / "key").secret, alter=beside) as stand:
        outcome, record, refused = flown(stand, str(tmp_path / "key"))
    assert outcome.cause is Cause.COMPLETED
    assert outcome.rejected_states == {}
    assert refused["unsigned"] > 20
    assert refused["replayed"] > 20
    assert max(abs(record.column(name)).max() for name in ("error_n", "error_e", "error_d")) < 1.0


def test_without_the_key_no_vehicle_is_found(tmp_path) -> None:
    new_key(tmp_path / "key")
    flight = make_flight(trajectory=SHORT)
    with Stand(flight, tmp_path) as stand:
        record = FlightRecord(0, PHASE_NAMES)
        with VehicleLink(f"udpin:127.0.0.1:{stand.port}", str(tmp_path / "key")).open() as wire:
            outcome = FlightLoop(
                *(flight, of_flight(flight), wire, record, kernels("python")), connect_timeout_s=0.6
            ).run()
    assert outcome.cause is Cause.NO_VEHICLE
    assert "unsigned" in outcome.sentence
    assert "companion key install" in outcome.sentence


def test_only_the_named_vehicle_is_flown(tmp_path) -> None:
    flight = make_flight(trajectory=SHORT)
    with Stand(flight, tmp_path) as stand, VehicleLink(f"udpin:127.0.0.1:{stand.port}", None, 9).open() as wire:
        record = FlightRecord(0, PHASE_NAMES)
        outcome = FlightLoop(*(flight, of_flight(flight), wire, record, kernels("python")), connect_timeout_s=0.5).run()
    assert outcome.cause is Cause.NO_VEHICLE
    assert "only system 9 is listened to" in outcome.sentence
