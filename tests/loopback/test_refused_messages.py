"""Unsigned, wrongly signed, replayed and wrong-system messages, through sockets: none is used, the good ones all are.

The same with 100,000: `python tools/signing.py`.
"""

from __future__ import annotations

from signing import costs, refused

from companion.link.signing import Signer


def test_none_is_used_that_must_not_be() -> None:
    found = refused(2000, seed=3)
    assert set(found) == {"vehicle link", "ground link", "bundled vehicle"}
    for receiver, tally in found.items():
        assert tally.used.total() == 0, (receiver, tally.used)
        assert tally.good_used == tally.good > 0, receiver
        assert ("wrong system" in tally.tried) == (receiver != "bundled vehicle")
        assert min(tally.tried.values()) >= 40
    assert sum(tally.tried.total() for tally in found.values()) == 2000


def test_a_guard_that_believes_everybody_would_be_found_out(monkeypatch) -> None:
    monkeypatch.setattr(Signer, "verify", lambda *_: True)
    found = refused(200)
    # a ground link uses nothing unsigned, whatever its guard believes: a radio's own reports are of no use there
    for receiver, without in (("vehicle link", set()), ("ground link", {"unsigned", "unsigned, MAVLink 1"})):
        kinds = {kind for kind, count in found[receiver].used.items() if count}
        assert kinds == set(found[receiver].tried) - {"wrong system"} - without


def test_costs_are_measured_for_both_ways() -> None:
    found = costs(rounds=2, each=20)
    assert len(found) == 12
    assert all(value > 0.0 for name, value in found.items() if not name.endswith("added"))
