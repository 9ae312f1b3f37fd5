"""What goes wrong in the fault matrix: every kind of fault of the simulated vehicle, as strong as is to be survived.

A case is named, so that a run can be taken up again and any flight flown once more: `fault_matrix.py --only NAME`.
"""

from __future__ import annotations

import itertools
import os
import random
import socket
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from matrix_flight import Act, Happening, Stage
from pymavlink.dialects.v20 import development as mavlink

from companion.flight.phases import Phase
from sim_link.fault_kinds import KINDS

PHASES = (Phase.CONNECT, Phase.PREFLIGHT, Phase.TAKEOFF, Phase.JOIN, Phase.TRACK, Phase.HOLD, Phase.LAND)
LATEST_S = {
    Phase.CONNECT: 0.0,
    Phase.PREFLIGHT: 0.9,
    Phase.TAKEOFF: 5.0,
    Phase.JOIN: 8.0,
    Phase.TRACK: 7.0,
    Phase.HOLD: 2.5,
    Phase.LAND: 6.0,
}
"""The latest that a fault begins after its phase did [s]; drawn evenly up to it."""
SEEDS = (1, 2, 3)


@dataclass(frozen=True)
class Case:
    """One thing that goes wrong."""

    name: str
    kind: str
    """Of `sim_link.fault_kinds`; "setpoints": somebody else sends them; "socket": the companion's is closed."""
    values: dict[str, Any] = field(default_factory=dict)
    for_s: float | None = None
    """None: for good, or at one moment."""
    vehicle: str = "bundled"

    def act(self) -> Act:
        """What happens when it is time."""
        if self.kind == "setpoints":
            return lambda stage: _other_voice(stage, self.for_s, **self.values)
        if self.kind == "socket":
            return _close_socket
        return lambda stage: stage.inject(self.kind, for_s=self.for_s, **self.values)


def _other_voice(stage: Stage, for_s: float | None, *, system: int, component: int, where: str, thrust: float) -> None:
    """Somebody else sends SET_ATTITUDE_TARGET to the vehicle with every state."""
    port = stage.peer.companion.port if where == "companion" or stage.peer.ground is None else stage.peer.ground.port
    mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    end_s = stage.t_s + (1e9 if for_s is None else for_s)

    def send() -> None:
        if stage.t_s < end_s:
            zero = (0.0, 0.0, 0.0)
            message = mavlink.MAVLink_set_attitude_target_message(0, 1, 1, 128, (1.0, 0.0, 0.0, 0.0), *zero, thrust)
            sock.sendto(message.pack(mav), ("127.0.0.1", port))

    stage.every_state.append(send)


def _close_socket(stage: Stage) -> None:
    """The companion's socket is closed underneath it."""
    if stage.wire is not None:
        os.close(stage.wire.fileno())


def _case(name: str, kind: str, for_s: float | None = None, /, vehicle: str = "bundled", **values: Any) -> Case:
    return Case(name, kind, values, for_s, vehicle)


_OUT: dict[str, Any] = {"direction": "from_vehicle"}
_IN: dict[str, Any] = {"direction": "to_vehicle"}
_CASES = (
    # datagrams
    _case("loss 5 %", "loss", share=0.05),
    _case("loss 20 %", "loss", share=0.2),
    _case("loss 50 %", "loss", share=0.5),
    _case("loss 50 % of setpoints", "loss", share=0.5, **_IN),
    _case("bursts of loss to 2 s", "burst_loss", good_s=2.0, bad_s=0.7, bad_max_s=2.0),
    _case("delay 20 ms", "delay", delay_s=0.02),
    _case("delay 50 ms", "delay", delay_s=0.05),
    _case("delay 100 ms", "delay", delay_s=0.1),
    _case("delay 300 ms", "delay", delay_s=0.3),
    _case("delay 300 ms of setpoints", "delay", delay_s=0.3, **_IN),
    _case("delay 100 ms for 1 s", "delay", 1.0, delay_s=0.1),
    _case("jitter 20 ms", "jitter", jitter_s=0.02),
    _case("jitter 100 ms", "jitter", jitter_s=0.1),
    _case("duplicates 30 %", "duplicate", share=0.3, late_s=0.03),
    _case("reordering 20 %", "reorder", share=0.2, late_s=0.03),
    _case("corruption 10 %", "corrupt", share=0.1),
    _case("corruption 50 %, 1 bit", "corrupt", share=0.5, bits=1),
    _case("silence 40 ms", "silence", 0.04),
    _case("silence 0.5 s", "silence", 0.5),
    _case("silence 3 s", "silence", 3.0),
    _case("silence for good", "silence"),
    _case("deaf 0.5 s", "silence", 0.5, **_IN),
    _case("deaf 3 s", "silence", 3.0, **_IN),
    _case("deaf for good", "silence", **_IN),
    _case("silence both ways 2 s", "silence", 2.0, direction="both"),
    _case("wrong clock 0.3 s", "timesync", offset_s=0.3),
    _case("wrong clock an hour", "timesync", offset_s=-3600.0),
    # body and air
    _case("rotor at 70 %", "rotor", rotor=2, share=0.7),
    _case("another rotor at 70 %", "rotor", rotor=3, share=0.7),
    _case("thrust at 75 %", "thrust_scale", factor=0.75),
    _case("thrust at 125 %", "thrust_scale", factor=1.25),
    _case("wind 5 m/s", "wind", wind_m_s=(3.0, -4.0, 0.0)),
    _case("gust 8 m/s for 1 s", "wind", 1.0, wind_m_s=(0.0, 8.0, 0.0)),
    _case("wind 12 m/s", "wind", vehicle="windtest", wind_m_s=(-12.0, 0.0, 0.0)),
    _case("blow of 10 N", "force", 0.2, force_n=(8.0, 6.0, 0.0)),
    _case("blow of 10 N down", "force", 0.2, force_n=(0.0, 0.0, 10.0)),
    # the estimate
    _case("reset 0.5 m", "estimator_reset", jump_m=(0.4, -0.3, 0.0)),
    _case("reset 0.5 m up", "estimator_reset", jump_m=(0.0, 0.0, -0.5)),
    _case("reset 5 m", "estimator_reset", jump_m=(-3.0, 4.0, 0.0)),
    _case("reset 20 deg", "estimator_reset", yaw_deg=20.0),
    _case("reset 60 deg", "estimator_reset", yaw_deg=-60.0),
    _case("reset 0.5 m/s", "estimator_reset", jump_m_s=(0.0, 0.5, 0.0)),
    _case("reset 1.5 m/s", "estimator_reset", jump_m_s=(1.5, 0.0, 0.0)),
    _case("outage 0.3 s", "estimator_outage", 0.3),
    _case("outage 2 s", "estimator_outage", 2.0),
    _case("freeze 0.1 s", "estimator_freeze", 0.1),
    _case("freeze 1 s", "estimator_freeze", 1.0),
    _case("NaN 30 ms", "estimator_bad_numbers", 0.03, what="nan"),
    _case("NaN for good", "estimator_bad_numbers", what="nan"),
    _case("zero quaternion 1 s", "estimator_bad_numbers", 1.0, what="zero_quaternion"),
    _case("stamps back 1 s", "estimator_bad_numbers", 1.0, what="stamp_back"),
    _case("noise x 10", "estimator_noise", factor=10.0),
    _case("noise x 100", "estimator_noise", 3.0, factor=100.0),
    _case("estimate 30 ms later", "estimator_delay", delay_s=0.05),
    _case("estimate 0.2 s late", "estimator_delay", delay_s=0.2),
    _case("estimates at 50 Hz", "estimator_rate", rate_hz=50.0),
    _case("estimates at 10 Hz", "estimator_rate", rate_hz=10.0),
    _case("drift 0.3 m/s", "estimator_drift", 5.0, drift_m_s=(0.2, 0.2, 0.1)),
    _case("drift of heading", "estimator_drift", 5.0, yaw_deg_s=6.0),
    # autopilot and pilot
    _case("pilot: Position", "pilot_mode", mode="Position"),
    _case("pilot: Altitude", "pilot_mode", mode="Altitude"),
    _case("pilot: Hold", "pilot_mode", mode="Hold"),
    _case("pilot: Land", "pilot_mode", mode="Land"),
    _case("pilot: Return", "pilot_mode", mode="Return"),
    _case("arming refused", "refuse", command="COMPONENT_ARM_DISARM"),
    _case("take-off refused", "refuse", command="NAV_TAKEOFF", result="DENIED"),
    _case("modes refused", "refuse", command="DO_SET_MODE"),
    _case("landing refused", "refuse", command="NAV_LAND"),
    _case("intervals refused", "refuse", command="SET_MESSAGE_INTERVAL", result="DENIED"),
    _case("parameter: rates at 30 deg/s", "parameter", name="MC_PITCHRATE_MAX", value=30.0),
    _case("parameter: attitude gain 1", "parameter", name="MC_ROLL_P", value=1.0),
    _case("parameter: thrust curve", "parameter", name="THR_MDL_FAC", value=0.5),
    _case("parameter: deaf to setpoints", "parameter", name="MAV_FWDEXTSP", value=0),
    _case("parameter: loss time 0.1 s", "parameter", name="COM_OF_LOSS_T", value=0.1),
    _case("GCS sends setpoints", "setpoints", system=255, component=190, where="ground", thrust=0.3),
    _case("GCS sends setpoints for 0.5 s", "setpoints", 0.5, system=255, component=190, where="ground", thrust=0.0),
    _case("second companion", "setpoints", system=1, component=192, where="companion", thrust=0.6),
    _case("socket closed", "socket"),
    _case("reboot", "reboot", boot_s=3.0),
)
CASES: dict[str, Case] = {case.name: case for case in _CASES}


class Job(NamedTuple):
    """One flight of the matrix."""

    faults: tuple[str, ...]
    phase: str
    seed: int

    @property
    def name(self) -> str:
        """Of the flight: stable, so that a run can go on where another one ended."""
        return f"{' + '.join(self.faults)} | {self.phase} | {self.seed}"

    @property
    def vehicle(self) -> str:
        """The vehicle file that it is flown with."""
        return next((CASES[f].vehicle for f in self.faults if CASES[f].vehicle != "bundled"), "bundled")

    def happenings(self) -> tuple[Happening, ...]:
        """What happens when; the times are drawn from the flight's name."""
        draw = random.Random(self.name)
        phase = Phase(self.phase)
        return tuple(Happening(phase, draw.uniform(0.0, LATEST_S[phase]), CASES[name].act()) for name in self.faults)


def singles(seeds: tuple[int, ...] = SEEDS) -> Iterator[Job]:
    """Every fault alone, in every phase."""
    for case in CASES.values():
        for phase in PHASES:
            for seed in seeds:
                yield Job((case.name,), phase.value, seed)


def exclude_one_another(first: str, second: str) -> bool:
    """Whether the vehicle can have only one of two different kinds at a time."""
    groups = [KINDS[kind].group for kind in (first, second) if kind in KINDS]
    return len(groups) == 2 and groups[0] == groups[1] != ""


def pairs(seeds: tuple[int, ...] = SEEDS) -> Iterator[Job]:
    """Every pair of kinds once per seed, each with a drawn case of its kind, in a drawn phase.

    Pairs that the vehicle cannot have at once, as an estimator that is silent and one that stands still, are left out.
    """
    kinds: dict[str, list[str]] = {}
    for case in CASES.values():
        kinds.setdefault(case.kind, []).append(case.name)
    for first, second in itertools.combinations(sorted(kinds), 2):
        if exclude_one_another(first, second):
            continue
        for seed in seeds:
            draw = random.Random(f"{first} {second} {seed}")
            names = draw.choice(kinds[first]), draw.choice(kinds[second])
            yield Job(names, draw.choice(PHASES).value, seed)
