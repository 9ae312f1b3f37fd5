"""pytest fixtures for programs that fly a PX4 vehicle: `vehicle` and `make_vehicle`; docs/testing.md shows their use.

Installed as a pytest plugin with the package. What it needs is imported when a test asks for a vehicle, not before.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from .running import RunningVehicle

_MARKER = (
    "vehicle(start=None, lockstep=False, speed=1.0, seed=1, faults=(), ...): "
    "options of the fixture 'vehicle', those of sim_link.running.RunningVehicle."
)


def pytest_configure(config: pytest.Config) -> None:
    """Make the marker known."""
    config.addinivalue_line("markers", _MARKER)


@pytest.fixture
def make_vehicle() -> Iterator[Callable[..., RunningVehicle]]:
    """Make simulated vehicles: `make_vehicle(start=(0, 0, -10), seed=3)`. They stop with the test.

    The options are those of `sim_link.running.RunningVehicle`.
    """
    from .running import RunningVehicle

    made: list[RunningVehicle] = []

    def make(**options: Any) -> RunningVehicle:
        made.append(RunningVehicle(**options))
        return made[-1]

    yield make
    failures = []
    for vehicle in made:
        # pytest shows this when the test has failed.
        print(f"vehicle {vehicle.system_id}: {vehicle.describe()}", *vehicle.notices, sep="\n  ")
        try:
            vehicle.stop()
        except RuntimeError as error:
            failures.append(error)
    if failures:
        raise failures[0]


@pytest.fixture
def vehicle(request: pytest.FixtureRequest, make_vehicle: Callable[..., RunningVehicle]) -> RunningVehicle:
    """Give one simulated vehicle; `@pytest.mark.vehicle(...)` on the test, class or module has its options."""
    options: dict[str, Any] = {}
    for marker in reversed(list(request.node.iter_markers("vehicle"))):
        if marker.args:
            raise pytest.UsageError("pytest.mark.vehicle takes options by name only, such as start=(0, 0, -10)")
        options.update(marker.kwargs)
    return make_vehicle(**options)
