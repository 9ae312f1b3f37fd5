"""One flight of the fault matrix: the control loop and the simulated vehicle take turns in this process, over UDP.

Both have their own sockets, as in two processes, and the vehicle is in lockstep; but nobody ever waits: when the
companion asks its link for messages, the vehicle has its turn first. So a flight costs nothing but the computing, and
is the same for the same seed whatever else the machine does. When the companion has ended its flight its program is
taken to be gone: the vehicle flies on alone, and where it ends then is looked at.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tomlkit

from companion.config import Flight, build_flight, find, read_toml
from companion.flight import loop as loop_module
from companion.flight.bundled import free_udp_port
from companion.flight.engines import Kernels, kernels
from companion.flight.loop import FlightLoop
from companion.flight.phases import PHASE_NAMES, Outcome, Phase
from companion.flight.process import warm_up
from companion.link.framing import Frame
from companion.link.transport import open_transport
from companion.link.wire import Wire
from companion.record.flight_record import FlightRecord
from companion.trajectory.load import of_flight
from sim_link.modes import Mode
from sim_link.peer import Peer, PeerOptions
from sim_link.rotation import Vec3
from sim_link.vehicle import Vehicle, VehicleOptions
from sim_link.vehicle_file import load
from sim_link.wind import World

STATE_RATE_HZ = 100.0
FENCE_RADIUS_M, FENCE_HEIGHT_M = 10.0, 10.0
TAKEOFF_M = 4.0
RADIUS_M, RATE_RAD_S = 2.0, 0.75
LAPS_S = 8.4
"""One turn of the circle, nearly: 1.5 m/s."""
ALONE_S = 20.0
"""The vehicle flies on for so long after the companion is gone; one that lands, until it has."""
ALONE_MAX_S = 60.0
DOWN_S = 4.0
"""One that is down and disarmed is watched for so long: longer than a reboot takes."""
SILENCE_WALL_S = 60.0
"""In the place of the loop's limit on a silent vehicle in lockstep: here the machine may be as busy as it likes."""
UNANSWERED_MAX = 50
"""Turns of the companion without an answer to the vehicle's clock, after which the clock moves all the same."""
PARAMETERS: dict[str, int | float] = {"COM_OBL_RC_ACT": 5}
"""Hold when setpoints cease: what the documentation asks for."""


class Moment:
    """What the vehicle really did in a state, and what it believed."""

    __slots__ = ("armed", "believed", "grounded", "mode", "p", "t_s", "v")

    def __init__(self, t_s: float, p: Vec3, v: Vec3, believed: Vec3, mode: Mode, armed: bool, grounded: bool) -> None:
        self.t_s, self.p, self.v, self.believed = t_s, p, v, believed
        self.mode, self.armed, self.grounded = mode, armed, grounded


@dataclass
class Flown:
    """What came of a flight."""

    outcome: Outcome
    lines: list[str]
    notices: list[str]
    moments: list[Moment]
    impact_m_s: float
    """Downward speed of the hardest touchdown."""
    injected: list[str] = field(default_factory=list)
    """Phases in which the faults began."""
    gone_s: float = 0.0
    """When the companion's program was over [s since the start]."""
    setpoints_after_end: int = 0
    """Setpoints that reached the vehicle after the companion had said that it ends."""


Act = Callable[["Stage"], None]
"""Something that happens to the flight."""


@dataclass(frozen=True)
class Happening:
    """Something that happens at a time after a phase began."""

    phase: Phase
    after_s: float
    act: Act


class Stage:
    """A vehicle, a companion, and what happens to them.

    Args:
        flight: the configuration.
        folder: for the vehicle's file.
        seed: of noise and faults.
        happenings: what goes wrong.
        engine: of the vehicle's physics and the law.
        compiled: the law's kernels, where they are there already.
        parameters: of the autopilot, beyond the usual.
        start: where the vehicle waits in the air, position NED [m] and yaw [rad]; None: on the ground.
    """

    def __init__(
        self,
        flight: Flight,
        folder: Path,
        *,
        seed: int,
        happenings: tuple[Happening, ...] = (),
        engine: str = "auto",
        compiled: Kernels | None = None,
        parameters: dict[str, int | float] | None = None,
        start: tuple[Vec3, float] | None = None,
    ) -> None:
        self.flight = flight
        path = folder / "vehicle.toml"
        path.write_text(tomlkit.dumps(_plain(flight.vehicle.model_dump(exclude_none=True))), encoding="utf-8")
        acts = flight.world
        world = World(acts.force_n, acts.gravity_factor, acts.wind_m_s, acts.turbulence, seed=seed)
        self.vehicle = Vehicle(
            VehicleOptions(
                vehicle=load(str(path)),
                world=world,
                start=start,
                seed=seed,
                engine=engine,
                parameters=PARAMETERS | (parameters or {}),
            )
        )
        self.port = free_udp_port()
        self.notices: list[str] = []
        self.peer = Peer(
            self.vehicle,
            PeerOptions(port=0, remote_port=self.port, ground_port=0, ground_remote_port=0, lockstep=True),
            notice=self.notices.append,
        )
        self.loop: FlightLoop | None = None
        self.wire: TurnWire | None = None
        self.moments: list[Moment] = []
        self.every_state: list[Callable[[], None]] = []
        """Called before each state of the vehicle."""
        self.injected: list[str] = []
        loop_module.PACED_SILENCE_S = SILENCE_WALL_S
        self._compiled = kernels(engine) if compiled is None else compiled
        self._waiting = list(happenings)
        self._phase: Phase = Phase.CONNECT
        self._phase_s = 0.0
        self._unanswered = 0
        self._clock_runs = False

    # -- what happens ---------------------------------------------------------------------------------------------

    def inject(self, kind: str, *, for_s: float | None = None, **values: Any) -> None:
        """A fault of the vehicle, from the next state on."""
        self.vehicle.faults.inject(kind, for_s=for_s, **values)

    @property
    def t_s(self) -> float:
        """Vehicle time since the start [s]; goes on through a reboot."""
        return self.vehicle.faults.elapsed_s

    def _happen(self) -> None:
        phase = self._phase if self.loop is None else self.loop.phase
        if phase is not self._phase:
            self._phase, self._phase_s = phase, self.t_s
        for thing in list(self._waiting):
            if thing.phase is phase and self.t_s - self._phase_s >= thing.after_s:
                self._waiting.remove(thing)
                self.injected.append(phase.value)
                thing.act(self)
        for call in self.every_state:
            call()

    # -- turns ----------------------------------------------------------------------------------------------------

    def turn(self) -> None:
        """The vehicle's turn: hears what was sent, and moves on when its last state was answered."""
        peer = self.peer
        if not self._clock_runs:
            self._happen()  # what is there from the start on
            self.vehicle.heartbeat()
            peer._flush()
            self._clock_runs = peer._hear_first()
            return
        while peer._waiting and not peer._answered:
            peer._act(*peer._waiting.popleft())
        peer._hear_until_answer()
        peer._hear_ground()
        self._unanswered += 1
        if peer._answered or peer._awaited_ns < 0 or self._unanswered > UNANSWERED_MAX:
            self._advance()

    def _advance(self) -> None:
        self._unanswered = 0
        self._happen()
        self.peer._advance()
        self._look()

    def _look(self) -> None:
        truth, pilot = self.vehicle.airframe.truth(), self.vehicle.autopilot
        believed = self.vehicle.airframe.inner_state().p
        self.moments.append(
            Moment(self.t_s, truth.p, truth.v, believed, pilot.mode, pilot.armed, self.vehicle.airframe.on_ground)
        )

    def fly(self) -> Flown:
        """Flies the flight, then lets the vehicle go on alone; closes everything."""
        record, lines = FlightRecord(30_000, PHASE_NAMES), list[str]()
        warm_up(self.flight, self._compiled)
        try:
            with TurnWire(self) as wire:
                self.wire = wire
                self.loop = FlightLoop(
                    *(self.flight, of_flight(self.flight), wire, record, self._compiled, lines.append),
                    connect_timeout_s=3.0,
                    connection=f"udpin:127.0.0.1:{self.port}",
                )
                outcome = self.loop.run()
            gone_s = self.t_s
            self._go_on_alone()
        finally:
            self.peer.close()
        impact = self.vehicle.airframe.impact_speed_m_s
        return Flown(outcome, lines, self.notices, self.moments, impact, self.injected, gone_s)

    def _go_on_alone(self) -> None:
        """No companion answers any more: the vehicle's time goes on all the same."""
        self.loop = None
        self._waiting.clear()
        self.peer.synchronous = False
        begin_s = self.t_s
        while self.t_s - begin_s < ALONE_MAX_S:
            self.every_state.clear()
            self.peer._hear_ground()
            self.peer._advance()
            self._look()
            pilot, on_ground = self.vehicle.autopilot, self.vehicle.airframe.on_ground
            lands = pilot.mode in {Mode.LAND, Mode.RETURN} and pilot.armed
            down = on_ground and not pilot.armed and self.t_s - begin_s >= DOWN_S
            if down or (self.t_s - begin_s >= ALONE_S and not lands):
                break


class TurnWire(Wire):
    """The companion's link, which lets the vehicle have its turn whenever the companion wants to hear something."""

    def __init__(self, stage: Stage) -> None:
        super().__init__(open_transport(f"udpin:127.0.0.1:{stage.port}"))
        self._stage = stage

    def receive(self, timeout_s: float, spin_s: float = 0.0, until: frozenset[int] = frozenset()) -> list[Frame]:
        """What is there after the vehicle's turn."""
        self._stage.turn()
        return super().receive(0.0, 0.0)


def flight_of(vehicle: str = "bundled", **changes: Any) -> Flight:
    """The matrix's flight: take-off, one turn of a circle at 1.5 m/s, landing, within a fence.

    Args:
        vehicle: a vehicle file's name.
        **changes: keys of the flight file; "__" reaches into tables.
    """
    data = read_toml(find(vehicle, "vehicles"))
    data["link"]["state_rate_hz"] = STATE_RATE_HZ
    data["limits"]["fence_radius_m"], data["limits"]["fence_height_m"] = FENCE_RADIUS_M, FENCE_HEIGHT_M
    circle = {"radius_m": RADIUS_M, "angular_rate_rad_s": RATE_RAD_S, "phase_deg": 0.0}
    trajectory = {"name": "circle", "shape": "circle", "anchor": "here", "duration_s": LAPS_S, "circle": circle}
    flight: dict[str, Any] = {
        **{"name": "matrix", "vehicle": data, "trajectory": trajectory, "statistics_from_s": 0.5},
        **{"takeoff_altitude_m": TAKEOFF_M, "after": "land"},
    }
    for key, value in changes.items():
        *path, last = key.split("__")
        table = flight
        for name in path:
            table = table.setdefault(name, {})
        table[last] = value
    return build_flight(flight, "fault matrix")


def fly(
    flight: Flight,
    happenings: tuple[Happening, ...],
    *,
    seed: int,
    engine: str = "auto",
    compiled: Kernels | None = None,
) -> Flown:
    """Flies once, in a folder that is gone afterwards."""
    with tempfile.TemporaryDirectory(prefix="matrix-") as folder:
        stage = Stage(flight, Path(folder), seed=seed, happenings=happenings, engine=engine, compiled=compiled)
        return stage.fly()


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, tuple) else value
