"""The services that the ground process hosts, built from the settings."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final
from zlib import crc32

from companion import __version__
from companion.config import Vehicle, build_flight, validate
from companion.errors import InputError
from companion.ground.examine import Apart
from companion.ground.files import FileServer
from companion.ground.parameter_file import file_for, load_tuning
from companion.ground.parameters import ParameterServer, Requests
from companion.ground.settings import Settings
from companion.ground.store import TrajectoryStore
from companion.ground.tuning import Tuning

VERDICT: Final = "may be flown"


def judge(flight: dict[str, Any], path: Path) -> str:
    """The vehicle's own check of a trajectory file: what a start would refuse, as far as it can be known before.

    Args:
        flight: contents of a flight file but for name and trajectory.
        path: of the trajectory's file.

    Returns:
        The verdict in words.

    Raises:
        CompanionError: what is wrong.
    """
    from companion.flight.preflight import gate_place, gate_reference
    from companion.trajectory.load import load

    whole = build_flight({**flight, "name": "check", "trajectory": str(path)}, "companion serve")
    trajectory = load(path, vehicle=whole.vehicle, confined=True)
    gate_reference(trajectory, whole.vehicle)
    gate_place(trajectory, whole.height_min_m)
    return f"{VERDICT}: {trajectory.duration_s:.1f} s"


def vehicle_of(settings: Settings) -> Vehicle:
    """The vehicle as the command line gave it."""
    return validate(Vehicle, settings.flight["vehicle"], "companion serve: vehicle")


def tuning_of(settings: Settings) -> Tuning:
    """The vehicle with what was changed of it from the ground before.

    Raises:
        InputError: the file that keeps it cannot be used.
    """
    vehicle = vehicle_of(settings)
    return load_tuning(file_for(Path(settings.trajectories), vehicle.name), vehicle)


def tuned(settings: Settings, overrides: dict[str, Any]) -> Settings:
    """The settings with other gains and limits: they override the vehicle's in every flight."""
    return replace(settings, flight={**settings.flight, **overrides})


def parameter_server(
    settings: Settings, tuning: Tuning, requests: Requests, say: Callable[[str, bool], None], system: Callable[[], int]
) -> ParameterServer:
    """The service for gains, limits and heading."""
    path = file_for(Path(settings.trajectories), tuning.base.name)
    return ParameterServer(tuning, path, requests, say, system)


def open_store(settings: Settings) -> TrajectoryStore:
    """The trajectories that may be started.

    Raises:
        InputError: the folder cannot be used, or another `companion serve` uses it.
    """
    folder = Path(settings.trajectories)
    depends = crc32(json.dumps(settings.flight, sort_keys=True).encode())
    try:
        return TrajectoryStore(
            folder, Apart(partial(judge, settings.flight)), checked_by=f"{__version__}-{depends:08x}"
        )
    except OSError as error:
        raise InputError(f"{folder}: cannot be used for trajectories ({error.strerror}); see --folder") from None


def file_server(store: TrajectoryStore, say: Callable[[str, bool], None]) -> FileServer:
    """The service for uploads."""
    return FileServer(store, say)


class Startable:
    """Implements `commands.Trajectories` over the store."""

    def __init__(self, store: TrajectoryStore) -> None:
        self._store = store

    def find(self, identity: int) -> tuple[str, str]:
        """Name and path of a trajectory that the vehicle's check has accepted. Raises LookupError."""
        entry = self._store.numbered(identity)
        if entry is None:
            raise LookupError(f"no trajectory has the id {identity}")
        if not entry.accepted:
            raise LookupError(f"{entry.name}: {entry.verdict}")
        return entry.name, str((self._store.folder / entry.name).absolute())
