"""The flight in the rerun viewer: path, reference, vehicle, the estimated force as an arrow, and curves.

The viewer's world is east, north, up. rerun is an extra, and imported only when it is asked for.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from companion.control.types import Quat, Vec3
from companion.control.vectors import quat_multiply
from companion.errors import InputError
from companion.frames import enu_from_ned

_NAME: Final = "offboard_companion"
_CHUNK: Final = 100
"""Points of a path that are sent again with every new one."""
_ARROW_M_PER_M_S2: Final = 1.0
_SIZE_M: Final = 0.25
_ENU_NED: Final[Quat] = (0.0, math.sqrt(0.5), math.sqrt(0.5), 0.0)
"""Turns a vector's coordinates from north, east, down to east, north, up."""
_FRD_FLU: Final[Quat] = (0.0, 1.0, 0.0, 0.0)
_SCALARS: Final = ("error_m", "lyapunov", "thrust_n", "state_age_ms", "battery")
_COLOURS: Final = {"flown": (11, 111, 184), "reference": (152, 162, 179)}


def attitude_enu(q: Quat) -> Quat:
    """The attitude of forward, left, up in east, north, up, from that of FRD in NED; w first."""
    return quat_multiply(quat_multiply(_ENU_NED, q), _FRD_FLU)


class RerunStream:
    """Sends a flight to the viewer or into a file; a context manager.

    Args:
        file: where to keep it (.rrd); None: the viewer is started and gets it.

    Raises:
        InputError: rerun is not installed, the viewer cannot be started, or the file cannot be written.
    """

    def __init__(self, file: Path | None = None) -> None:
        self._rr = _rerun()
        try:
            self._recording = self._rr.RecordingStream(_NAME)
            if file is None:
                self._recording.spawn()
            else:
                self._recording.save(str(file))
        except (OSError, RuntimeError, ValueError) as error:
            where = "the rerun viewer cannot be started" if file is None else f"{file}: cannot be written"
            raise InputError(f"{where} ({error}); --rerun-file FILE.rrd keeps the flight for later") from None
        self._paths: dict[str, list[Vec3]] = {name: [] for name in _COLOURS}
        self._chunks = dict.fromkeys(_COLOURS, 0)
        self._begun = False

    def __enter__(self) -> RerunStream:
        return self

    def __exit__(self, *_: object) -> None:
        self._recording.flush()
        self._recording.disconnect()

    def __call__(self, message: Mapping[str, Any]) -> None:
        """Sends one message of the control process."""
        if not self._begun:
            self._begun = True
            self._log("world", self._rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
            half = [[_SIZE_M, 0.7 * _SIZE_M, 0.2 * _SIZE_M]]
            self._log("world/vehicle/body", self._rr.Boxes3D(half_sizes=half), static=True)
            nose = self._rr.Arrows3D(vectors=[[2.0 * _SIZE_M, 0.0, 0.0]])
            self._log("world/vehicle/nose", nose, static=True)
        if "line" in message:
            self._log("events", self._rr.TextLog(str(message["line"])))
        progress = message.get("progress")
        if progress is not None:
            self._show(progress)

    def _log(self, entity: str, what: Any, **more: Any) -> None:
        self._recording.log(entity, what, **more)

    def _show(self, progress: Mapping[str, Any]) -> None:
        rr = self._rr
        self._recording.set_time("flight", duration=progress["t_s"])
        here = enu_from_ned(_vec3(progress["position_m"]))
        self._extend("flown", here)
        self._extend("reference", enu_from_ned(_vec3(progress["reference_m"])))
        w, x, y, z = attitude_enu(_quat(progress["attitude"]))
        self._log("world/vehicle", rr.Transform3D(translation=here, quaternion=rr.Quaternion(xyzw=[x, y, z, w])))
        force = enu_from_ned(_vec3(progress["disturbance_m_s2"]))
        if all(map(math.isfinite, force)):
            vector = [_ARROW_M_PER_M_S2 * f for f in force]
            self._log("world/disturbance", rr.Arrows3D(origins=[here], vectors=[vector], colors=[(217, 88, 13)]))
            for axis, value in zip(("north", "east", "down"), progress["disturbance_m_s2"], strict=True):
                self._log(f"disturbance_m_s2/{axis}", rr.Scalars(value))
        for name in _SCALARS:
            value = progress[name]
            if value is not None and math.isfinite(value):
                self._log(name, rr.Scalars(value))

    def _extend(self, name: str, point: Vec3) -> None:
        """Lines come in chunks, so that a long flight is not sent again and again."""
        chunk = self._paths[name]
        chunk.append(point)
        strip = self._rr.LineStrips3D([chunk], colors=[_COLOURS[name]])
        self._log(f"world/{name}/{self._chunks[name]:04d}", strip)
        if len(chunk) >= _CHUNK:
            self._paths[name] = [point]
            self._chunks[name] += 1


def _rerun() -> Any:
    try:
        import rerun
    except ImportError:
        raise InputError(
            "--rerun needs rerun, which is not installed: pip install 'offboard-companion[live]'"
        ) from None
    return rerun


def _vec3(numbers: Any) -> Vec3:
    x, y, z = numbers
    return float(x), float(y), float(z)


def _quat(numbers: Any) -> Quat:
    w, x, y, z = numbers
    return float(w), float(x), float(y), float(z)
