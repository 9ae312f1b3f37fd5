"""A ground link that goes away takes no other one along, and is there again when it is back."""

from __future__ import annotations

import os
from pathlib import Path

from pymavlink.dialects.v20 import development as mavlink
from serve_cases import PATIENCE_S, Serving, until

from companion import Client
from companion.flight.bundled import free_udp_port


def plugged_in(device: Path) -> int:
    """A pseudo-terminal under this name; closing what is returned unplugs it."""
    master, slave = os.openpty()
    name = os.ttyname(slave)
    os.close(slave)
    device.unlink(missing_ok=True)
    device.symlink_to(name)
    return master


def heard_on(master: int) -> list[str]:
    """What a radio at the other end of the line gets within one read."""
    return [m.get_type() for m in mavlink.MAVLink(None).parse_buffer(os.read(master, 4096)) or []]


def test_an_adapter_that_is_unplugged(tmp_path: Path) -> None:
    device = tmp_path / "adapter"
    master = plugged_in(device)
    line = f"serial:{device}:57600"
    options = ("--ground", line, "--allow-unsigned")
    with Serving(tmp_path, free_udp_port(), ("hover",), *options) as serve:
        ground = serve.ground_pid
        until(lambda: "HEARTBEAT" in heard_on(master))
        with Client(serve.to, PATIENCE_S) as client:
            os.close(master)
            until(lambda: f"the ground link {line} is gone" in serve.log, serve.log)
            assert [stored.name for stored in client.trajectories()] == ["hover.toml"]
            until(lambda: any("is gone" in text.text for text in (client.status(5.0), client)[1].texts))
        with Client(serve.to, PATIENCE_S) as client:
            assert client.status().phase == "idle"
        assert serve.ground_pid == ground
        master = plugged_in(device)
        until(lambda: f"the ground link {line} is back" in serve.log, serve.log)
        until(lambda: "HEARTBEAT" in heard_on(master))
        # Another process while it is away.
        os.close(master)
        until(lambda: serve.log.count("is gone") == 2, serve.log)
        serve.kill(ground)
        until(lambda: serve.ground_pid not in {None, ground})
        with Client(serve.to, PATIENCE_S) as client:
            assert client.status().phase == "idle"
        until(lambda: serve.log.count("is gone") == 3, serve.log)
        master = plugged_in(device)
        until(lambda: serve.log.count("is back") == 3, serve.log)  # the process, and twice the line
        until(lambda: "HEARTBEAT" in heard_on(master))
        assert serve.log.count("it is started again") == 1
        os.close(master)
