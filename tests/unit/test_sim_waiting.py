"""The simulated vehicle's wait: for sockets, and for less than a millisecond."""

import socket
from types import SimpleNamespace

import pytest

from sim_link import waiting
from sim_link.waiting import Waiter


def pair() -> tuple[socket.socket, socket.socket]:
    return socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)


@pytest.mark.parametrize("most", [1024, 0], ids=["exact", "many descriptors"])
@pytest.mark.parametrize("timeout_s", [0.0, 0.0004, 60.0])
def test_what_has_something_to_be_read_ends_the_wait(monkeypatch, most, timeout_s):
    monkeypatch.setattr(waiting, "_SELECT_MAX", most)
    (ours, theirs), (other, rest) = pair(), pair()
    with ours, theirs, other, rest:
        waiter = Waiter()
        waiter.register(ours.fileno())
        waiter.register(other.fileno())
        theirs.send(b"x")
        assert waiter.wait(timeout_s) == [ours.fileno()]
        waiter.unregister(ours.fileno())
        assert waiter.wait(0.0) == waiter.wait(0.0004) == waiter.wait(-1.0) == []
        waiter.register(ours.fileno())
        rest.send(b"y")
        assert sorted(waiter.wait(timeout_s)) == sorted([ours.fileno(), other.fileno()])


@pytest.mark.parametrize("most", [1024, 0], ids=["exact", "many descriptors"])
def test_a_time_is_waited_for_at_once_and_exactly_where_that_can_be(monkeypatch, most):
    monkeypatch.setattr(waiting, "_SELECT_MAX", most)
    exact, whole = [], []
    monkeypatch.setattr(waiting.select, "select", lambda *args: exact.append(args[3]) or ([], [], []))
    ours, theirs = pair()
    with ours, theirs:
        waiter = Waiter()
        waiter.register(ours.fileno())
        monkeypatch.setattr(waiter, "_poll", SimpleNamespace(poll=lambda ms: whole.append(ms) or []))
        for timeout_s in (0.0025, 0.0004, 0.1, 0.0, -1.0):
            assert waiter.wait(timeout_s) == []
    assert exact == ([0.0025, 0.0004, 0.1, 0.0, 0.0] if most else [])
    assert whole == ([] if most else [3, 1, 100, 0, 0])
