"""A study: the TOML file of a campaign, validated as a whole, and the flights that it makes.

A flight's numbers follow from the study's seed and the flight's number alone, each variable from its own stream: any
flight can be made again by itself, and a variable that is added leaves the values of the others as they were.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationError

from companion.campaign.variables import NAMES, VARIABLES, Spread, problem
from companion.campaign.whole import Case, Throw, check_vehicle, simulated
from companion.config import (
    Controller,
    Flight,
    NotNegative,
    Positive,
    Section,
    Start,
    Vehicle,
    explain,
    find,
    load_flight,
    read_toml,
    validate,
)
from companion.errors import InputError
from companion.frames import radians
from companion.trajectory.anchored import Trajectory
from companion.trajectory.load import embedded, of_flight

FLIGHTS_MAX = 10_000_000
SEED_BITS = 31
Value = float | str


class Convergence(Section):
    """[converged]: when a flight counts as converged."""

    below_m: Positive = 0.2
    """The position error must stay below this until the end."""
    statistics_after_s: NotNegative = 10.0
    """So long after that rms and largest error begin to count."""


class Slice(Section):
    """[[slices]]: a picture of the outcome over two variables."""

    x: str
    y: str


class StudyFile(Section):
    """The contents of a study file."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,64}$")]
    flight: str
    """Flight file, or the name of a bundled one: all that is not varied."""
    count: Annotated[int, Field(ge=1, le=FLIGHTS_MAX)] = 1
    """Flights; with grids: flights of every combination."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 1
    duration_s: Positive | None = None
    """Of the course (join, trajectory, stop); None: all of it."""
    ground: bool = True
    """Whether there is a ground at down = 0, which ends a flight."""
    diverged_m: Positive = 1000.0
    """Position error at which a flight counts as diverged."""
    vary: dict[str, dict[str, Spread]] = Field(default_factory=dict)
    converged: Convergence = Convergence()
    slices: tuple[Slice, ...] = ()
    pareto: Literal["gains", "none"] = "gains"
    """Whether to draw error against actuation where gains are varied."""


@dataclass(frozen=True)
class Study:
    """A study that can be flown."""

    source: str
    """What to call it in errors."""
    data: Mapping[str, Any]
    """The file's contents."""
    flight_data: Mapping[str, Any]
    """The flight's contents, complete: a study goes on as it began although a file changes."""
    file: StudyFile
    flight: Flight
    tables: Mapping[str, Any]
    """Trajectories that are named in it, as tables."""
    trajectories: Mapping[str, Trajectory]
    """By name; "" is the flight's own."""

    @property
    def name(self) -> str:
        """The study's name."""
        return self.file.name

    @cached_property
    def spreads(self) -> dict[str, Spread]:
        """By key path, in alphabetical order."""
        pairs = ((f"{a}.{b}", s) for a, table in self.file.vary.items() for b, s in table.items())
        return dict(sorted(pairs))

    @cached_property
    def grid(self) -> dict[str, list[float]]:
        """Variables on a grid with their values."""
        return {name: s.grid_values() for name, s in self.spreads.items() if s.kind == "grid"}

    @property
    def total(self) -> int:
        """Number of flights."""
        return self.file.count * math.prod(len(values) for values in self.grid.values())

    @property
    def varied(self) -> list[str]:
        """Variables that differ from flight to flight."""
        return [name for name, s in self.spreads.items() if s.kind != "constant"]

    def values(self, number: int) -> dict[str, Value]:
        """The variables of a flight. Raises InputError when there is no such flight."""
        if not 0 <= number < self.total:
            raise InputError(f"{self.source}: there is no flight {number}; they are 0 to {self.total - 1}")
        sizes = [len(values) for values in self.grid.values()]
        place = np.unravel_index(number // self.file.count, sizes) if sizes else ()
        found: dict[str, Value] = {n: v[int(i)] for (n, v), i in zip(self.grid.items(), place, strict=True)}
        for name, spread in self.spreads.items():
            if name in found:
                continue
            stream = np.random.SeedSequence(self.file.seed, spawn_key=(number, zlib.crc32(name.encode())))
            random = np.random.Generator(np.random.PCG64(stream))
            found[name] = spread.draw_name(random) if name in NAMES else spread.draw(random, VARIABLES[name])
        return found

    def flight_seed(self, number: int) -> int:
        """The seed of a flight's noise and gusts."""
        words = np.random.SeedSequence(self.file.seed, spawn_key=(number,)).generate_state(1)
        return int(words[0]) & ((1 << SEED_BITS) - 1)

    def case(self, number: int) -> Case:
        """A flight, complete.

        Raises:
            InputError: the values make no flight together.
        """
        return self.case_with(number, {})

    def case_with(self, number: int, changes: Mapping[str, Value]) -> Case:
        """A flight with other values of some variables, its noise and gusts the same. Raises InputError."""
        values = {**self.values(number), **changes}
        return _case(self, values, self.flight_seed(number), f"{self.source}: flight {number}")

    def to_json(self) -> str:
        """All of it as text, for workers and for the folder: `from_json` makes the same study of it."""
        return json.dumps({"source": self.source, **self._whole}, sort_keys=True)

    @property
    def _whole(self) -> dict[str, Any]:
        return {"study": self.data, "flight": self.flight_data, "tables": self.tables}

    @property
    def digest(self) -> str:
        """Tells this study from every other, wherever its file is."""
        return hashlib.sha256(json.dumps(self._whole, sort_keys=True).encode()).hexdigest()[:16]


def load_study(name: str, changes: Mapping[str, Any] | None = None, vehicle: str | None = None) -> Study:
    """The study file of that name or path.

    Args:
        name: path or bundled name.
        changes: replace keys of it (options of the command line).
        vehicle: flies in the place of the flight's.

    Raises:
        InputError: naming file, key path, value and what is allowed.
    """
    path = find(name, "campaigns")
    data = {**read_toml(path), **(changes or {})}
    file = validate(StudyFile, data, str(path))
    flight_name = _beside(file.flight, path)
    flight = embedded(load_flight(flight_name, _with_vehicle(vehicle)))
    tables = {name: _table_of(flight, name, str(path)) for name in _trajectory_names(file, str(path))}
    return _study(str(path), data, json.loads(flight.model_dump_json(exclude_none=True)), file, flight, tables)


@lru_cache(maxsize=4)
def from_json(text: str) -> Study:
    """The study that `Study.to_json` wrote."""
    from companion.config import build_flight

    whole = json.loads(text)
    file = validate(StudyFile, whole["study"], whole["source"])
    flight = build_flight(whole["flight"], whole["source"])
    return _study(whole["source"], whole["study"], whole["flight"], file, flight, whole["tables"])


def _table_of(flight: Flight, name: str, source: str) -> Any:
    try:
        return embedded(_of(flight, name)).trajectory
    except InputError as error:
        raise InputError(f"{source}: vary.trajectory.name: {error}") from None


def _of(flight: Flight, trajectory: Any) -> Flight:
    return flight.model_copy(update={"trajectory": trajectory})


def _trajectory_names(file: StudyFile, source: str) -> list[str]:
    """The trajectories that a study names."""
    spread = file.vary.get("trajectory", {}).get("name")
    if spread is None:
        return []
    wrong = problem("trajectory.name", spread)
    if wrong is not None:
        raise InputError(f"{source}: vary.trajectory.name: {wrong}")
    return [str(name) for name in (spread.choice if spread.choice is not None else (spread.constant,))]


def _with_vehicle(name: str | None) -> Callable[[dict[str, Any]], None] | None:
    if name is None:
        return None
    contents = read_toml(find(name, "vehicles"))
    return lambda data: data.update(vehicle=contents)


def _beside(name: str, study: Path) -> str:
    """A flight file that is named counts from the study's folder as well."""
    beside = study.parent / name
    return str(beside) if not Path(name).is_file() and beside.is_file() else name


def _study(
    source: str,
    data: Mapping[str, Any],
    flight_data: Mapping[str, Any],
    file: StudyFile,
    flight: Flight,
    tables: Mapping[str, Any],
) -> Study:
    for section, table in file.vary.items():
        for key, spread in table.items():
            name = f"{section}.{key}"
            if name not in VARIABLES and name not in NAMES:
                known = [n for n in (*VARIABLES, *NAMES) if n.startswith(section + ".")] or [*VARIABLES, *NAMES]
                raise InputError(f"{source}: vary.{name}: is not known; allowed are {', '.join(known)}")
            wrong = problem(name, spread)
            if wrong is not None:
                raise InputError(f"{source}: vary.{name}: {wrong}")
    trajectories = {"": of_flight(flight), **{name: of_flight(_of(flight, table)) for name, table in tables.items()}}
    found = Study(source, data, flight_data, file, flight, tables, trajectories)
    _check_whole(found)
    return found


def _check_whole(study: Study) -> None:
    """Raise InputError where keys that are allowed each do not go together."""
    source, file = study.source, study.file
    if study.total > FLIGHTS_MAX:
        raise InputError(
            f"{source}: count = {file.count} times the grids are {study.total} flights; at most {FLIGHTS_MAX}"
        )
    for index, picture in enumerate(file.slices):
        for axis in ("x", "y"):
            name = getattr(picture, axis)
            if name not in study.varied or name in NAMES:
                numbers = [n for n in study.varied if n not in NAMES]
                raise InputError(
                    f"{source}: slices[{index}].{axis} = {name!r}: must be a number that is varied"
                    f" ({', '.join(numbers) or 'none is'})"
                )
    if study.flight.output.controller != "law" or study.flight.output.by_law == "actuators":
        raise InputError(
            f"{source}: flight = {file.flight!r}: campaigns and the search for gains fly the law with output.kind"
            ' = "auto", "rates" or "attitude", and this flight does not'
        )
    case = study.case(0)
    try:
        check_vehicle(case, simulated(study.flight.vehicle))  # what is varied may make one that is none: a result
    except InputError as error:
        raise InputError(f"{source}: {error}") from None


def _case(study: Study, values: Mapping[str, Value], seed: int, where: str) -> Case:
    def number(name: str, default: float) -> float:
        return float(values.get(name, default))

    flight = study.flight
    if flight.start is None:
        raise InputError(f"{study.source}: flight = {study.file.flight!r}: has no [start], which a campaign needs")
    n, e, d = flight.start.position_m
    position = (number("start.north_m", n), number("start.east_m", e), number("start.down_m", d))
    if study.file.ground and position[2] >= 0.0:
        raise InputError(
            f"{where}: start.down_m = {position[2]:g}: must be below 0, the ground is there (ground = true)"
        )
    world = flight.world
    north, east, down = world.wind_m_s
    if "world.wind_m_s" in values or "world.wind_towards_deg" in values:
        speed = number("world.wind_m_s", math.hypot(north, east))
        towards = radians(number("world.wind_towards_deg", math.degrees(math.atan2(east, north))))
        north, east = speed * math.cos(towards), speed * math.sin(towards)
    fn, fe, fd = world.force_n
    world = world.model_copy(
        update={
            "wind_m_s": (north, east, number("world.wind_down_m_s", down)),
            "turbulence": number("world.turbulence", world.turbulence),
            "force_n": (
                number("world.force_north_n", fn),
                number("world.force_east_n", fe),
                number("world.force_down_n", fd),
            ),
            "gravity_factor": number("world.gravity_factor", world.gravity_factor),
            "seed": seed,
        }
    )
    known = _known(flight.vehicle, values, where)
    start = Start(position_m=position, yaw_deg=number("start.yaw_deg", flight.start.yaw_deg))
    name, scale = str(values.get("trajectory.name", "")), number("trajectory.time_scale", 0.0)
    trajectory = study.trajectories[name]
    table: Any = study.tables[name] if name else flight.trajectory
    if scale > 0.0:
        trajectory, table = _scaled(trajectory, scale), {**table, "time_scale": scale}
    throw = Throw(
        (
            number("start.velocity_north_m_s", 0.0),
            number("start.velocity_east_m_s", 0.0),
            number("start.velocity_down_m_s", 0.0),
        ),
        radians(number("start.tilt_deg", 0.0)),
        radians(number("start.tilt_towards_deg", 0.0)),
        (
            number("start.roll_rate_rad_s", 0.0),
            number("start.pitch_rate_rad_s", 0.0),
            number("start.yaw_rate_rad_s", 0.0),
        ),
    )
    return Case(
        flight.model_copy(update={"start": start, "world": world, "vehicle": known, "trajectory": table}),
        _true(known, values),
        trajectory,
        throw,
        study.file.ground,
        math.inf if study.file.duration_s is None else study.file.duration_s,
        study.file.diverged_m,
    )


def _scaled(trajectory: Trajectory, scale: float) -> Trajectory:
    ratio = scale / trajectory.time_scale
    return replace(trajectory, time_scale=scale, duration_s=trajectory.duration_s / ratio)


def _known(vehicle: Vehicle, values: Mapping[str, Value], where: str) -> Vehicle:
    """The vehicle as the companion knows it: gains, and the age of the states, which it measures."""
    gains = {name.partition(".")[2]: value for name, value in values.items() if name.startswith("controller.")}
    changes: dict[str, Any] = {}
    if gains:
        try:
            changes["controller"] = Controller.model_validate({**vehicle.controller.model_dump(), **gains})
        except ValidationError as error:
            raise InputError(f"{where}: controller: {explain(error)}") from None
    if "vehicle.state_age_s" in values:
        changes["link"] = vehicle.link.model_copy(update={"state_age_s": float(values["vehicle.state_age_s"])})
    return vehicle.model_copy(update=changes) if changes else vehicle


def _true(vehicle: Vehicle, values: Mapping[str, Value]) -> Vehicle:
    """The vehicle as it really is."""

    def factor(name: str) -> float:
        return float(values.get(f"vehicle.{name}", 1.0))

    body, rotors, autopilot, link, noise = (
        vehicle.body,
        vehicle.rotors,
        vehicle.autopilot,
        vehicle.link,
        vehicle.noise,
    )
    inertia, lag = factor("inertia_factor"), factor("rate_lag_factor")
    changes: dict[str, Any] = {
        "body": body.model_copy(
            update={
                "mass_kg": body.mass_kg * factor("mass_factor"),
                "inertia_kg_m2": tuple(inertia * x for x in body.inertia_kg_m2),
                "drag_1_s": body.drag_1_s * factor("drag_factor"),
            }
        ),
        "rotors": rotors.model_copy(
            update={
                "thrust_max_n": rotors.thrust_max_n * factor("thrust_factor"),
                "lag_s": rotors.lag_s * factor("rotor_lag_factor"),
            }
        ),
        "autopilot": autopilot.model_copy(update={"rate_lag_s": tuple(lag * x for x in autopilot.rate_lag_s)}),
        "link": link.model_copy(
            update={"command_delay_s": link.command_delay_s + float(values.get("vehicle.unknown_delay_s", 0.0))}
        ),
    }
    if noise is not None:
        keys = ("position_m", "velocity_m_s", "attitude_rad", "rate_rad_s")
        scale = factor("noise_factor")
        changes["noise"] = noise.model_copy(update={key: scale * getattr(noise, key) for key in keys})
    return vehicle.model_copy(update=changes)


def combinations(study: Study) -> list[dict[str, float]]:
    """The points of the grids, in the order of the flights."""
    names = list(study.grid)
    return [dict(zip(names, point, strict=True)) for point in itertools.product(*study.grid.values())]
