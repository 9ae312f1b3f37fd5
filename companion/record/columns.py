"""The columns of a flight's record: one row per control step, in this order.

SI, NED and FRD, radians; quaternions Hamilton, w first, body to inertial. A value that does not exist in a phase is
NaN. `t_s` is vehicle time; `state_age_ms`, `step_us` and `late` are wall-clock measurements and differ between equal
flights.
"""

from __future__ import annotations

from typing import Final

COLUMNS: Final[tuple[str, ...]] = (
    "t_s",  # vehicle time of the state's stamp
    "track_s",  # time on the trajectory, NaN outside of the track phase
    "phase",  # index into the record's phase names
    # The state as received.
    *("p_n", "p_e", "p_d"),  # m
    *("v_n", "v_e", "v_d"),  # m/s
    *("q_w", "q_x", "q_y", "q_z"),
    *("w_x", "w_y", "w_z"),  # rad/s
    # The reference at the state's stamp, and what is left: p - ref.
    *("ref_n", "ref_e", "ref_d"),  # m
    *("ref_v_n", "ref_v_e", "ref_v_d"),  # m/s
    *("error_n", "error_e", "error_d"),  # m
    "heading_error_rad",  # NaN when the heading is free
    # The law's errors, equations (8), (25), (30), (15), at the time that the state was predicted to.
    *("e1_n", "e1_e", "e1_d"),  # m
    *("e2_n", "e2_e", "e2_d"),  # m
    *("e3_n", "e3_e", "e3_d"),  # m
    *("e4_n", "e4_e", "e4_d"),  # m
    "lyapunov",  # V_H of the certificate, m^2
    *("b_hat_n", "b_hat_e", "b_hat_d"),  # disturbance estimate, m/s^2
    # What the law asked for, and what was sent.
    "thrust_n",  # N
    "thrust_rate_n_s",  # N/s
    *("tau_x", "tau_y", "tau_z"),  # angular acceleration, rad/s^2
    *("rate_cmd_x", "rate_cmd_y", "rate_cmd_z"),  # rad/s
    "thrust_cmd",  # fraction of full thrust, 0 to 1
    # How the step went.
    "state_age_ms",  # wall: age of the state when it was answered
    "step_us",  # wall: from the state's arrival to the setpoint's departure
    "late",  # wall: 1 when that took more than 20 % of the state period
    "skipped",  # states that were skipped before this one
    "limits",  # bit mask of LIMIT_*
    # The state predicted to the time at which the command takes effect.
    *("predicted_q_w", "predicted_q_x", "predicted_q_y", "predicted_q_z"),
    *("predicted_w_x", "predicted_w_y", "predicted_w_z"),  # rad/s
)
"""Names of the columns, in the order of a row."""

COLUMN_INDEX: Final[dict[str, int]] = {name: index for index, name in enumerate(COLUMNS)}
"""Where a column stands in a row."""

LIMIT_THRUST_MIN: Final = 1
"""The thrust stands at its lower limit."""
LIMIT_THRUST_MAX: Final = 2
"""The thrust stands at its upper limit."""
LIMIT_RATE_ROLL_PITCH: Final = 4
"""A commanded roll or pitch rate was clipped."""
LIMIT_RATE_YAW: Final = 8
"""The commanded yaw rate was clipped."""
LIMIT_DISTURBANCE: Final = 16
"""The disturbance estimate is held inside its bound."""
LIMIT_ESTIMATOR_FROZEN: Final = 32
"""The disturbance estimator does not integrate."""
LIMIT_HEADING_HELD: Final = 64
"""The heading is undefined and the last one is held."""

LIMIT_NAMES: Final[dict[int, str]] = {
    LIMIT_THRUST_MIN: "thrust at its minimum",
    LIMIT_THRUST_MAX: "thrust at its maximum",
    LIMIT_RATE_ROLL_PITCH: "roll or pitch rate clipped",
    LIMIT_RATE_YAW: "yaw rate clipped",
    LIMIT_DISTURBANCE: "disturbance estimate at its bound",
    LIMIT_ESTIMATOR_FROZEN: "estimator frozen",
    LIMIT_HEADING_HELD: "heading held",
}
"""What a bit of the column `limits` says to people."""

TRACK_PHASE: Final = "track"
"""The phase that the statistics are made of."""

DEFAULT_PHASE_NAMES: Final[tuple[str, ...]] = (
    *("connect", "preflight", "takeoff", "join", "track", "hold", "land", "pause"),
)
"""The phases of a flight, in the order of their numbers."""
