"""Writes what really happened to a CSV file, one row per state."""

from __future__ import annotations

import sys
from contextlib import suppress
from pathlib import Path

from .airframe import Airframe
from .rotation import Vec3

COLUMNS = (
    *("t_s", "p_n", "p_e", "p_d", "v_n", "v_e", "v_d", "q_w", "q_x", "q_y", "q_z", "w_x", "w_y", "w_z"),
    *("disturbance_n_m_s2", "disturbance_e_m_s2", "disturbance_d_m_s2"),
    *("thrust_1_n", "thrust_2_n", "thrust_3_n", "thrust_4_n"),
)
"""Vehicle time (as ODOMETRY.time_usec), NED [m, m/s], body to inertial, FRD [rad/s], NED [m/s^2], rotors [N]."""

_MOTION = "%d.%06d" + ",%.10g" * 13
_DISTURBANCE, _ROTORS = ",%.10g" * 3, ",%.10g" * 4
_ROWS_HELD = 500


class TruthLog:
    """A CSV file that is written in blocks; complete once closed."""

    def __init__(self, path: Path) -> None:
        """Create the file. Raises OSError when that is not possible."""
        self._file = path.open("wb", buffering=0)
        self._name = path.name
        self._full = False
        self._rows: list[str] = [",".join(COLUMNS)]
        self._disturbance: Vec3 | None = None
        self._disturbance_text = ""

    def row(self, airframe: Airframe) -> str:
        """Format the row of now. Half of what that takes are the digits, so that those of the same object are kept."""
        disturbance = airframe.disturbance()
        if disturbance is not self._disturbance:
            self._disturbance, self._disturbance_text = disturbance, _DISTURBANCE % disturbance
        p, v, q, w, rotor_n = airframe.rigid
        seconds, micros = divmod(airframe.t_us, 1_000_000)
        return _MOTION % (seconds, micros, *p, *v, *q, *w) + self._disturbance_text + _ROTORS % rotor_n

    def add(self, text: str) -> None:
        """Add one row that is formatted already."""
        self._rows.append(text)
        if len(self._rows) >= _ROWS_HELD:
            self._flush()

    def close(self) -> None:
        """Write what is left and close; doing so twice is harmless."""
        if not self._file.closed:
            self._flush()
            self._file.close()

    def _flush(self) -> None:
        text = "\n".join(self._rows) + "\n" if self._rows else ""
        self._rows.clear()
        content = memoryview(text.encode("ascii"))
        try:
            while content and not self._full:
                content = content[self._file.write(content) or 0 :]
        except OSError as error:  # a vehicle does not fall out of the air because a disk is full
            self._full = True
            with suppress(OSError):  # the console may be a file on the same disk
                print(
                    f"sim-link: {self._name}: {error.strerror}; nothing more is written, the flight goes on",
                    file=sys.stderr,
                )
