"""What faults do to a vehicle: to its body and the air, to what it believes, to its autopilot, to its links."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from .airframe import Airframe
from .autopilot import Result
from .datagram_faults import ORDER as DATAGRAM_KINDS
from .datagram_faults import LinkFaults
from .fault_keys import mode_called
from .fault_kinds import Fault
from .rotation import Vec3

if TYPE_CHECKING:
    from .vehicle import Vehicle

BODY_KINDS = ("rotor", "thrust_scale", "wind", "force")
ESTIMATE_KINDS = (
    *("estimator_reset", "estimator_outage", "estimator_freeze", "estimator_bad_numbers", "estimator_noise"),
    *("estimator_delay", "estimator_rate", "estimator_drift"),
)
_STICKS_PERIOD_US = 100_000
"""So often the sticks of a pilot are told."""
_NEVER_US = 1 << 62


def apply_to_body(airframe: Airframe, active: Iterable[Fault]) -> None:
    """Give an airframe the rotors, the wind and the force that it has under these faults, in their order."""
    shares = [1.0, 1.0, 1.0, 1.0]
    gusts: list[Vec3] = []
    force = airframe.world.force_n
    for fault in active:
        if fault.kind == "rotor":
            shares[fault["rotor"] - 1] *= fault["share"]
        elif fault.kind == "thrust_scale":
            shares = [share * fault["factor"] for share in shares]
        elif fault.kind == "wind":
            gusts.append(fault["wind_m_s"])
        elif fault.kind == "force":
            force = _sum(force, fault["force_n"])
    airframe.set_rotor_shares((shares[0], shares[1], shares[2], shares[3]))
    gust: Vec3 | None = None
    for more in gusts:
        gust = more if gust is None else _sum(gust, more)
    airframe.set_gust(gust)
    airframe.set_force(force)


def apply_to_estimate(airframe: Airframe, fault: Fault, begins: bool) -> None:
    """Begin or end a fault of the estimator."""
    beliefs = airframe.beliefs
    match fault.kind:
        case "estimator_reset" if begins:
            beliefs.reset(fault["jump_m"], fault["jump_m_s"], math.radians(fault["yaw_deg"]))
        case "estimator_outage":
            beliefs.set_outage(begins)
        case "estimator_freeze":
            beliefs.set_frozen(begins)
        case "estimator_bad_numbers":
            beliefs.set_bad_numbers(fault["what"] if begins else None)
        case "estimator_noise":
            beliefs.set_noise_factor(fault["factor"] if begins else 1.0)
        case "estimator_delay":
            beliefs.set_delay_s(fault["delay_s"] if begins else None)
        case "estimator_rate":
            beliefs.set_rate_hz(fault["rate_hz"] if begins else None)
        case "estimator_drift" if begins:
            beliefs.set_drift(fault["drift_m_s"], math.radians(fault["yaw_deg_s"]))
        case "estimator_drift":
            beliefs.set_drift((0.0, 0.0, 0.0), 0.0)


class Effects:
    """Lets faults act on one vehicle. Times are those of its physics, which a reboot does not set back."""

    def __init__(self, vehicle: Vehicle, seed: int) -> None:
        self._vehicle = vehicle
        self._active: dict[int, Fault] = {}
        self._links = {name: LinkFaults(seed, name) for name in ("companion", "ground")}
        self._sticks: tuple[int, ...] | None = None
        """MANUAL_CONTROL's x, y, z, r of the pilot who holds the sticks."""
        self._sticks_us = 0
        self._before: dict[int, int | float] = {}
        """What parameters were before their faults."""
        self.refused: dict[int, Result] = {}
        """Commands that are refused, and how."""

    def set_lockstep(self) -> None:
        """Spare the TIMESYNC exchange with the companion, which the vehicle's clock waits for, from now on."""
        self._links["companion"].spares_exchange = True

    @property
    def links(self) -> Mapping[str, LinkFaults]:
        """What acts on the links, by their names."""
        return self._links

    @property
    def active(self) -> Mapping[int, Fault]:
        """The faults that act now."""
        return self._active

    def begin(self, number: int, fault: Fault) -> str:
        """Let a fault act; gives what there is to say about it."""
        self._active[number] = fault
        kind = fault.kind
        if kind in BODY_KINDS:
            apply_to_body(self._vehicle.airframe, self._active.values())
        elif kind in ESTIMATE_KINDS:
            apply_to_estimate(self._vehicle.airframe, fault, True)
        elif kind in DATAGRAM_KINDS:
            for link in self._links.values():
                link.begin(number, fault)
        elif kind == "timesync":
            self._set_answers()
        elif kind == "refuse":
            self.refused[fault["command"]] = Result[fault["result"]]
        elif kind == "parameter":
            self._before[number] = self._vehicle.parameters[fault["name"]]
            self._set_parameter(fault["name"], fault["value"])
        elif kind == "reboot":
            self._silence(number)
            self._vehicle.begin_boot()
        elif kind == "pilot_mode":
            return self._take_mode(fault)
        return ""

    def end(self, number: int) -> None:
        """Let a fault act no longer."""
        fault = self._active.pop(number)
        kind = fault.kind
        if kind in BODY_KINDS:
            apply_to_body(self._vehicle.airframe, self._active.values())
        elif kind in ESTIMATE_KINDS:
            apply_to_estimate(self._vehicle.airframe, fault, False)
        elif kind in DATAGRAM_KINDS:
            for link in self._links.values():
                link.end(number)
        elif kind == "timesync":
            self._set_answers()
        elif kind == "refuse":
            del self.refused[fault["command"]]
        elif kind == "parameter":
            self._set_parameter(fault["name"], self._before.pop(number))
        elif kind == "reboot":
            for link in self._links.values():
                link.end(number)
            self._vehicle.finish_boot(round(fault["boot_s"] * 1e6))
        elif kind == "pilot_mode":
            self._sticks = None

    def advance(self, now_us: int, period_us: int) -> int:
        """Go on with what takes time, before the state at now_us + period_us; gives when to be called again."""
        next_us = _NEVER_US
        if self._sticks is not None and not self._vehicle.booting:
            if now_us >= self._sticks_us:
                self._sticks_us = now_us + _STICKS_PERIOD_US
                self._vehicle.autopilot.manual_control(*self._sticks)
            next_us = self._sticks_us
        ends = {"companion": self._vehicle.companion, "ground": self._vehicle.ground}
        for name, link in self._links.items():
            link.now_us = now_us + period_us
            ends[name].faults = None if link.idle else link
            if not link.idle or self._vehicle.booting:
                next_us = now_us
        return next_us

    def _take_mode(self, fault: Fault) -> str:
        """Let the pilot, who holds the sticks from now on, choose a mode."""
        roll, pitch, yaw, throttle = (round(1000.0 * x) for x in fault["sticks"])
        self._sticks = (pitch, roll, (throttle + 1000) // 2, yaw)
        self._sticks_us = 0
        if self._vehicle.booting:
            return "the autopilot is down"
        self._vehicle.autopilot.manual_control(*self._sticks)
        result = self._vehicle.autopilot.set_mode(mode_called(fault["mode"]))
        return "" if result is Result.ACCEPTED else f"the autopilot did not take the mode: {result.name}"

    def _set_parameter(self, name: str, value: float) -> None:
        """Change a parameter; PX4 tells whoever listens."""
        self._vehicle.parameters.set(name, value)
        for link in self._vehicle.links:
            if not link.quiet:
                link.parameters_to_send.append(name)

    def _set_answers(self) -> None:
        """Make the answers to TIMESYNC requests as wrong as the faults say."""
        for name, link in self._links.items():
            link.answer_offset_ns = sum(
                round(f["offset_s"] * 1e9)
                for f in self._active.values()
                if f.kind == "timesync" and f["link"] in (name, "both")
            )

    def _silence(self, number: int) -> None:
        """Let nothing pass any more, either way; what was under way is lost."""
        silence = Fault("silence", values={"direction": "both", "link": "both"})
        for link in self._links.values():
            link.forget()
            link.begin(number, silence)


def _sum(a: Vec3, b: Vec3) -> Vec3:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])
