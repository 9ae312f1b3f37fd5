"""The simulated vehicle's wait: for sockets, and for less than a millisecond."""

import socket
import time

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


@pytest.mark.parametrize("most", [1024, 0])
def test_a_time_is_waited_for_and_never_exceeded_by_rounding(monkeypatch, most):
    """Milliseconds are rounded down, and the rest is waited for exactly: a loop around it ends, and not before."""
    monkeypatch.setattr(waiting, "_SELECT_MAX", most)
    asked = []
    real = waiting.select.select
    monkeypatch.setattr(waiting.select, "select", lambda *args: asked.append(args[3]) or real(*args))
    ours, theirs = pair()
    with ours, theirs:
        waiter = Waiter()
        waiter.register(ours.fileno())
        end_s = time.monotonic() + 0.0025
        while (left_s := end_s - time.monotonic()) > 0.0:
            assert waiter.wait(left_s) == []
        assert all(0.0 < timeout_s < 0.001 for timeout_s in asked)
        assert bool(asked) == (most > 0)
