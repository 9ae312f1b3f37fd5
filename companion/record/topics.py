"""The topics of `flight.ulg`: what is logged, under which names, in which units. docs/log.md is this table for people.

Where the meaning is PX4's, topic, field and type are PX4's own, so that the tools made for its logs find them; fields
that nobody here can know are left out instead of filled with something. The rest has topics of its own,
`companion_...`, with the record's numbers in full: they give back `record.npz` bit by bit.

Frames are PX4's: NED for positions and velocities, FRD for the body, quaternions Hamilton, w first, body to NED.
"""

from __future__ import annotations

from typing import Final

from companion.record.columns import DEFAULT_PHASE_NAMES, LIMIT_NAMES
from companion.record.ulog import Field, Topic

_SAMPLE = Field("timestamp_sample", "uint64_t", "us", "vehicle time of the state that it is of, or answers")
_THRUST_BODY = Field("thrust_body", "float[3]", "1", "share of full thrust along the body's axes: 0, 0, -thrust")


def _vector(name: str, unit: str, meaning: str, stem: str, axes: str = "ned") -> Field:
    """Three columns of the record under one name, in full."""
    return Field(name, "double[3]", unit, meaning, tuple(f"{stem}_{axis}" for axis in axes))


def _of(name: str, kind: str, unit: str, meaning: str, column: str | None = None) -> Field:
    """One column of the record, or a number derived from its row."""
    return Field(name, kind, unit, meaning, (column or name,))


# ---- with every state of the autopilot that is used, from the first to the last -------------------------------------

LOCAL_POSITION: Final = Topic(
    "vehicle_local_position",
    "position and velocity as received (ODOMETRY)",
    (
        _SAMPLE,
        Field("xy_valid", "bool", "", "x and y hold: always, other states are not used"),
        Field("z_valid", "bool", "", "z holds"),
        Field("v_xy_valid", "bool", "", "vx and vy hold"),
        Field("v_z_valid", "bool", "", "vz holds"),
        Field("x", "float", "m", "position north, in the local frame"),
        Field("y", "float", "m", "east"),
        Field("z", "float", "m", "down"),
        Field("vx", "float", "m/s", "velocity north"),
        Field("vy", "float", "m/s", "east"),
        Field("vz", "float", "m/s", "down"),
        Field("heading", "float", "rad", "yaw angle, -pi to pi"),
    ),
)
ATTITUDE: Final = Topic(
    "vehicle_attitude",
    "attitude as received (ODOMETRY)",
    (_SAMPLE, Field("q", "float[4]", "", "quaternion, w first, body to NED")),
)
ANGULAR_VELOCITY: Final = Topic(
    "vehicle_angular_velocity",
    "body rates as received (ODOMETRY)",
    (_SAMPLE, Field("xyz", "float[3]", "rad/s", "about forward, right, down")),
)

# ---- with every setpoint that is sent -------------------------------------------------------------------------------

RATES_SETPOINT: Final = Topic(
    "vehicle_rates_setpoint",
    "body rates that were sent (output = rates)",
    (
        Field("roll", "float", "rad/s", "about forward"),
        Field("pitch", "float", "rad/s", "about right"),
        Field("yaw", "float", "rad/s", "about down"),
        _THRUST_BODY,
    ),
)
ATTITUDE_SETPOINT: Final = Topic(
    "vehicle_attitude_setpoint",
    "attitude that was sent (output = attitude)",
    (
        Field("yaw_sp_move_rate", "float", "rad/s", "feed-forward about the vertical"),
        Field("q_d", "float[4]", "", "quaternion, w first, body to NED"),
        _THRUST_BODY,
    ),
)
THRUST_SETPOINT: Final = Topic(
    "vehicle_thrust_setpoint",
    "thrust that was sent, with every output but the reference itself",
    (_SAMPLE, Field("xyz", "float[3]", "1", "share of full thrust along the body's axes: 0, 0, -thrust")),
)
TORQUE_SETPOINT: Final = Topic(
    "vehicle_torque_setpoint",
    "torque that was sent (output = actuators)",
    (_SAMPLE, Field("xyz", "float[3]", "1", "share of full torque about the body's axes, -1 to 1")),
)
TRAJECTORY_SETPOINT: Final = Topic(
    "trajectory_setpoint",
    "reference that was sent (controller = px4), at its time of effect; NaN: not commanded",
    (
        Field("position", "float[3]", "m", "NED"),
        Field("velocity", "float[3]", "m/s", "NED"),
        Field("acceleration", "float[3]", "m/s^2", "NED"),
        Field("yaw", "float", "rad", "-pi to pi"),
        Field("yawspeed", "float", "rad/s", "about the vertical"),
    ),
)

# ---- when the autopilot reports it ----------------------------------------------------------------------------------

STATUS: Final = Topic(
    "vehicle_status",
    "mode and arming (HEARTBEAT, CURRENT_MODE)",
    (
        Field("arming_state", "uint8_t", "", "1 disarmed, 2 armed"),
        Field("nav_state_user_intention", "uint8_t", "", "mode that was asked for, as nav_state; 31 unknown"),
        Field("nav_state", "uint8_t", "", "mode that is flown, PX4's numbers: 4 Hold, 14 Offboard, 31 unknown"),
        Field("vehicle_type", "uint8_t", "", "1 rotary wing, 0 something else"),
        Field("is_vtol", "bool", "", "never"),
        Field("system_type", "uint8_t", "", "MAV_TYPE"),
        Field("system_id", "uint8_t", "", "of the autopilot"),
        Field("component_id", "uint8_t", "", "of the autopilot"),
    ),
)
BATTERY: Final = Topic(
    "battery_status",
    "the first battery (BATTERY_STATUS)",
    (
        Field("connected", "bool", "", "a voltage is known"),
        Field("voltage_v", "float", "V", "0 unknown"),
        Field("current_a", "float", "A", "-1 unknown"),
        Field("discharged_mah", "float", "mAh", "-1 unknown"),
        Field("remaining", "float", "1", "0 to 1, -1 unknown"),
        Field("time_remaining_s", "float", "s", "NaN unknown"),
        Field("temperature", "float", "°C", "NaN unknown"),
        Field("cell_count", "uint8_t", "", "0 unknown"),
        Field("id", "uint8_t", "", "from 1 on"),
        Field("warning", "uint8_t", "", "0 none, 1 low, 2 critical, 3 emergency, 4 failed, 6 unhealthy, 7 charging"),
    ),
)
LAND_DETECTED: Final = Topic(
    "vehicle_land_detected",
    "ground contact (EXTENDED_SYS_STATE)",
    (Field("landed", "bool", "", "the autopilot says that it stands on the ground"),),
)
HOME: Final = Topic(
    "home_position",
    "home (HOME_POSITION)",
    (
        Field("lat", "double", "deg", "latitude, WGS 84"),
        Field("lon", "double", "deg", "longitude, WGS 84"),
        Field("alt", "float", "m", "above mean sea level"),
        Field("x", "float", "m", "north, in the local frame"),
        Field("y", "float", "m", "east"),
        Field("z", "float", "m", "down"),
    ),
)
LINK: Final = Topic(
    "companion_link",
    "what the link carried since the beginning, once per second",
    (
        Field("time_utc_usec", "uint64_t", "us", "since 1970, UTC: what the companion's clock says at this moment"),
        Field("rx_message_count", "uint32_t", "", "messages received"),
        Field("rx_message_lost_count", "uint32_t", "", "missing by the autopilot's sequence numbers"),
        Field("rx_rate_avg", "float", "B/s", "received per second of vehicle time since the last record"),
        Field("tx_message_count", "uint32_t", "", "messages sent"),
        Field("tx_rate_avg", "float", "B/s", "sent per second of vehicle time since the last record"),
        Field("states", "uint32_t", "", "states used"),
        Field("states_rejected", "uint32_t", "", "states not used: repeated, late, not finite, ..."),
        Field("dropped", "uint32_t", "", "entries missing in this log: its writer was too slow"),
    ),
)

# ---- with every control step ----------------------------------------------------------------------------------------

POSITION_SETPOINT: Final = Topic(
    "vehicle_local_position_setpoint",
    "the reference at the state's stamp",
    (
        _of("x", "float", "m", "position north, in the local frame", "ref_n"),
        _of("y", "float", "m", "east", "ref_e"),
        _of("z", "float", "m", "down", "ref_d"),
        _of("vx", "float", "m/s", "velocity north", "ref_v_n"),
        _of("vy", "float", "m/s", "east", "ref_v_e"),
        _of("vz", "float", "m/s", "down", "ref_v_d"),
        _of("yaw", "float", "rad", "heading wanted at the step, -pi to pi; NaN: free", "yaw_wanted"),
    ),
)
STEP: Final = Topic(
    "companion_step",
    "where in the flight, and how the step went",
    (
        _of("t_s", "double", "s", "vehicle time of the state"),
        _of("track_s", "double", "s", "time on the trajectory; NaN outside of the track phase"),
        _of("phase", "double", "", ", ".join(f"{index} {name}" for index, name in enumerate(DEFAULT_PHASE_NAMES))),
        _of("state_age_ms", "double", "ms", "age of the state when it was answered"),
        _of("step_us", "double", "us", "wall time from the state's arrival to the setpoint's departure"),
        _of("late", "double", "", "1 when that took more than 20 % of the state period"),
        _of("skipped", "double", "", "states that were skipped before this one"),
        _of("limits", "double", "", "a sum: " + ", ".join(f"{bit} {name}" for bit, name in LIMIT_NAMES.items())),
    ),
)
STATE: Final = Topic(
    "companion_state",
    "the state that the step answered",
    (
        _vector("p", "m", "position, NED", "p"),
        _vector("v", "m/s", "velocity, NED", "v"),
        Field("q", "double[4]", "", "attitude, w first, body to NED", ("q_w", "q_x", "q_y", "q_z")),
        _vector("w", "rad/s", "body rates, FRD", "w", "xyz"),
    ),
)
REFERENCE: Final = Topic(
    "companion_reference",
    "the reference at the state's stamp, and what is left",
    (
        _vector("p", "m", "position, NED", "ref"),
        _vector("v", "m/s", "velocity, NED", "ref_v"),
        _vector("error", "m", "position less reference, NED", "error"),
        _of("heading_error", "double", "rad", "from the heading wanted to the actual; NaN: free", "heading_error_rad"),
    ),
)
ERRORS: Final = Topic(
    "companion_errors",
    "the law's four errors at the time that the state was predicted to, NED (docs/law.md section 2)",
    (
        _vector("e1", "m", "position error", "e1"),
        _vector("e2", "m", "velocity error", "e2"),
        _vector("e3", "m", "acceleration error", "e3"),
        _vector("e4", "m", "jerk error", "e4"),
    ),
)
LYAPUNOV: Final = Topic(
    "companion_lyapunov",
    "the Lyapunov function of the certificate (docs/law.md section 4)",
    (
        _of("value", "double", "m^2", "V_H without its b_tilde term, which nobody can measure", "lyapunov"),
        _of("envelope", "double", "m^2", "what V_H does not rise above by the proof, see docs/log.md; NaN: nothing is"
            " promised"),
    ),
)  # fmt: skip
DISTURBANCE: Final = Topic(
    "companion_disturbance",
    "the estimated disturbance",
    (_vector("b_hat", "m/s^2", "force over mass, NED", "b_hat"),),
)
COMMAND: Final = Topic(
    "companion_command",
    "what the law asked for, whatever was sent of it",
    (
        _of("thrust", "double", "N", "collective thrust, the law's T", "thrust_n"),
        _of("thrust_rate", "double", "N/s", "its derivative", "thrust_rate_n_s"),
        _vector("tau", "rad/s^2", "angular acceleration, FRD", "tau", "xyz"),
        _vector("rates", "rad/s", "body rates, FRD", "rate_cmd", "xyz"),
        _of("thrust_fraction", "double", "1", "share of full thrust that was sent", "thrust_cmd"),
    ),
)
PREDICTION: Final = Topic(
    "companion_prediction",
    "the state predicted to the time at which the command takes effect, as far as it is kept",
    (
        Field("q", "double[4]", "", "attitude, w first, body to NED", tuple(f"predicted_q_{i}" for i in "wxyz")),
        _vector("w", "rad/s", "body rates, FRD", "predicted_w", "xyz"),
    ),
)

STEP_TOPICS: Final = (
    POSITION_SETPOINT, STEP, STATE, REFERENCE, ERRORS, LYAPUNOV, DISTURBANCE, COMMAND, PREDICTION,
)  # fmt: skip
"""With every control step: as many records as `record.npz` has rows."""
STATE_TOPICS: Final = (LOCAL_POSITION, ATTITUDE, ANGULAR_VELOCITY)
SETPOINT_TOPICS: Final = (
    RATES_SETPOINT, ATTITUDE_SETPOINT, THRUST_SETPOINT, TORQUE_SETPOINT, TRAJECTORY_SETPOINT,
)  # fmt: skip
REPORT_TOPICS: Final = (STATUS, BATTERY, LAND_DETECTED, HOME, LINK)
TOPICS: Final = STATE_TOPICS + SETPOINT_TOPICS + STEP_TOPICS + REPORT_TOPICS
"""All, in the order of their numbers in the file."""

DERIVED: Final = ("yaw_wanted", "envelope")
"""Numbers of a step topic that are no column of the record."""
