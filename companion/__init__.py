"""An offboard companion for PX4: flies a multirotor along a trajectory with an adaptive backstepping tracker.

`companion.Client` commands a running `companion serve`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from companion.ground.client import Client, Status, StoredTrajectory

__version__ = "0.1.0"
__all__ = ["Client", "Status", "StoredTrajectory", "__version__"]


def __getattr__(name: str) -> Any:
    """The client, imported when it is asked for: `companion --help` needs none of it."""
    if name in {"Client", "Status", "StoredTrajectory"}:
        from companion.ground import client

        return getattr(client, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
