"""What people write today instead: a loop on mavutil, and a MAVSDK callback; both answer a state with body rates.

    python -m benchmarks.peers mavutil PORT
    python -m benchmarks.peers mavsdk PORT

They run until SIGTERM, in a process of their own, at a vehicle that flies in the air.
"""

from __future__ import annotations

import os
import signal
import sys
import threading

os.environ["MAVLINK20"] = "1"
RATES_AND_THRUST = 0x80
"""Type mask of SET_ATTITUDE_TARGET: without the attitude."""
HOVER = 0.5


def mavutil_loop(port: int) -> None:
    from pymavlink import mavutil

    link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}", source_system=1, source_component=191)
    link.wait_heartbeat()
    level = [1.0, 0.0, 0.0, 0.0]
    while True:
        state = link.recv_match(type="ODOMETRY", blocking=True)
        t_ms = state.time_usec // 1000
        link.mav.set_attitude_target_send(t_ms, 1, 1, RATES_AND_THRUST, level, 0.0, 0.0, 0.0, HOVER)


def mavsdk_callback(port: int) -> None:
    import mavsdk
    from mavsdk.component_type import ComponentType
    from mavsdk.mavsdk import Configuration, Mavsdk
    from mavsdk.plugins.offboard import AttitudeRate, Offboard
    from mavsdk.plugins.telemetry import Telemetry

    mavsdk.log_subscribe(lambda *_: True)
    sdk = Mavsdk(Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER))
    sdk.add_any_connection(f"udpin://127.0.0.1:{port}")
    system = sdk.first_autopilot(timeout_s=20.0)
    if system is None:
        raise SystemExit("MAVSDK found no vehicle")
    offboard, telemetry = Offboard(system), Telemetry(system)
    rates = AttitudeRate(0.0, 0.0, 0.0, HOVER)
    offboard.set_attitude_rate(rates)
    offboard.start()
    telemetry.subscribe_odometry(lambda state, _: offboard.set_attitude_rate(rates))
    threading.Event().wait()


def main() -> None:
    signal.signal(signal.SIGTERM, lambda *_: os._exit(0))
    {"mavutil": mavutil_loop, "mavsdk": mavsdk_callback}[sys.argv[1]](int(sys.argv[2]))


if __name__ == "__main__":
    main()
