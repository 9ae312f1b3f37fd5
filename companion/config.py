"""Configuration: TOML files, validated as a whole before anything connects.

A vehicle file says what the vehicle is and how it is to be controlled; a flight file names a vehicle and a trajectory,
and may override the vehicle's [controller] and [limits] key by key. A name such as "paper" is looked up as a path
first, then among the bundled files. Errors name the file, the key path, the value and what is allowed; a syntax error
names the line.
"""

from __future__ import annotations

import datetime
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from companion.control import heading
from companion.control.law import Gains, Limits, Model, Parameters
from companion.control.types import GRAVITY_M_S2, Vec3
from companion.errors import InputError

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Gain = Annotated[float, Field(ge=0.01, le=100.0, allow_inf_nan=False)]
Vector = tuple[Finite, Finite, Finite]
PositiveVector = tuple[Positive, Positive, Positive]
NotNegativeVector = tuple[NotNegative, NotNegative, NotNegative]
FourNumbers = tuple[Finite, Finite, Finite, Finite]

STATE_AGE_ROOM_S = 0.05
"""States may be so much older than the vehicle file says, unless it says otherwise."""
HEADINGS = {"damping": heading.DAMPING, "sideslip": heading.SIDESLIP, "commanded": heading.COMMANDED}


class Section(BaseModel):
    """Base of all sections: unknown keys are errors, numbers are numbers, and nothing changes after reading."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class Body(Section):
    """[body]: the rigid body."""

    mass_kg: Positive
    inertia_kg_m2: PositiveVector
    drag_1_s: NotNegative


class Rotors(Section):
    """[rotors]: four rotors, in PX4's order front right, rear left, front left, rear right for an x."""

    x_m: FourNumbers
    y_m: FourNumbers
    yaw_moment_m: FourNumbers
    thrust_max_n: Positive
    lag_s: NotNegative
    curve_factor: Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)]


class Autopilot(Section):
    """[autopilot]: its loops, as seen from their setpoints."""

    rate_lag_s: PositiveVector
    rate_integral_1_s: NotNegativeVector
    attitude_gain_1_s: PositiveVector
    attitude_lag_s: NotNegative
    loop_rate_hz: Positive


class Link(Section):
    """[link]: rate and age of the state, delay of the commands, and who listens."""

    state_rate_hz: Annotated[float, Field(ge=10.0, le=1000.0)]
    state_age_s: Annotated[float, Field(ge=0.0, le=0.5)]
    command_delay_s: Annotated[float, Field(ge=0.0, le=0.5)]
    exclusive: bool = False
    """Nobody else listens on it: in flight the autopilot need not send what this program does not use."""


class Noise(Section):
    """[noise]: of the simulated vehicle's state, one sigma per axis; and the random walk of its bias."""

    position_m: NotNegative
    velocity_m_s: NotNegative
    attitude_rad: NotNegative
    rate_rad_s: NotNegative
    position_walk_m_per_sqrt_s: NotNegative = 0.0
    velocity_walk_m_s_per_sqrt_s: NotNegative = 0.0
    yaw_walk_rad_per_sqrt_s: NotNegative = 0.0
    rate_walk_rad_s_per_sqrt_s: NotNegative = 0.0
    walk_time_constant_s: NotNegative = 0.0


class Controller(Section):
    """[controller]: the gain set of docs/law.md."""

    k1_1_s: Gain
    k2: Gain
    k3_1_s: Gain
    k4_1_s: Gain
    gamma_1_s3: Annotated[float, Field(ge=0.0, le=1000.0, allow_inf_nan=False)]
    position_error_max_m: Positive
    heading: Literal["damping", "sideslip", "commanded"]
    heading_l1_1_s: Positive = 1.0
    heading_l2_1_s: Positive = 1.0
    heading_damping_1_s: Positive = 2.0
    heading_speed_min_m_s: Positive = 0.3
    disturbance_start: Literal["hover", "zero"] = "hover"
    # The known dynamics, each to be switched off by itself (docs/tracking.md shows what each brings).
    drag_feedforward: bool = True
    rate_lag_inversion: bool | tuple[bool, bool, bool] = True
    """One for all axes, or roll, pitch and yaw."""
    thrust_lag_compensation: bool = True
    thrust_scale_estimate: bool = False
    """Whether what a thrust command gives is followed in flight, within bounds (docs/tracking.md)."""
    prediction: bool = True
    measured_delay: bool = True
    """Whether the prediction goes by the measured age of the states; false where link.state_age_s and command_delay_s
    are only known together, as one delay."""


class FlightLimits(Section):
    """[limits]: every saturation and every bound that a flight is judged by."""

    thrust_min_n: Positive
    thrust_max_n: Positive
    rate_max_rad_s: PositiveVector
    tilt_max_rad: Annotated[float, Field(gt=0.0, lt=1.5708, allow_inf_nan=False)]
    disturbance_max_m_s2: Positive
    heading_rate_max_rad_s: Positive
    speed_max_m_s: Positive
    acceleration_max_m_s2: Positive
    state_gap_max_s: Positive = 0.1
    position_error_abort_m: Positive = 100.0
    # What follows are limits of the guards (docs/guards.md).
    estimate_jump_max_m: Positive = 2.0
    estimate_jump_max_m_s: Positive = 1.0
    estimate_jump_max_rad: Positive = 0.5
    disturbance_step_m_s2: NotNegative | None = None
    """Largest step of the horizontal disturbance that a flight is to bear; None: disturbance_max_m_s2."""
    disturbance_step_vertical_m_s2: NotNegative = 0.5
    rate_error_max_rad_s: Positive = 1.0
    """Roll and pitch rates together, against the commanded ones behind delay and lag."""
    state_rate_min: Annotated[float, Field(gt=0.0, le=1.0, allow_inf_nan=False)] = 0.6
    """Share of link.state_rate_hz."""
    state_age_max_s: Positive | None = None
    """None: link.state_age_s and 50 ms."""
    late_steps_max: Annotated[float, Field(gt=0.0, le=1.0, allow_inf_nan=False)] = 0.3
    """Share of the steps of a second."""
    battery_min: Annotated[float, Field(ge=0.0, lt=1.0, allow_inf_nan=False)] = 0.15
    link_silence_max_s: Positive = 2.0
    fence_radius_m: Positive | None = None
    """Horizontal distance from the vehicle's own home, wherever a trajectory was planned, or from where it held before
    the flight while home is not known; None: no fence."""
    fence_height_m: Positive | None = None
    """Above the same."""

    @model_validator(mode="after")
    def _ordered(self) -> FlightLimits:
        if self.thrust_min_n >= self.thrust_max_n:
            raise ValueError(f"thrust_min_n {self.thrust_min_n} must be below thrust_max_n {self.thrust_max_n}")
        return self


class Calibration(Section):
    """[calibration]: where a vehicle file's numbers come from; `companion calibrate` writes it. Only the date is used.

    Delays are from a setpoint's sending to its effect, residuals root mean squares of what the fitted model leaves.
    """

    date: str
    """Of the flight, YYYY-MM-DD."""
    autopilot: str = ""
    """Its version."""
    flight: str = ""
    """The flight's folder."""
    battery_v: Positive | None = None
    battery_share: Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)] | None = None
    mass_relative_error: NotNegative | None = None
    """How well the mass is known."""
    hover_thrust: Positive | None = None
    """Command that hovers, of full, by the fit to all that was flown in offboard."""
    hover_thrust_hold: Positive | None = None
    """The same as the autopilot's own Hold needed it."""
    rate_delay_s: Vector | None = None
    """Of roll, pitch and yaw rate, each fitted with a delay of its own."""
    rate_lag_own_s: Vector | None = None
    """The time constants that go with those."""
    thrust_delay_s: Finite | None = None
    rate_residual_rad_s: NotNegativeVector | None = None
    velocity_residual_m_s: NotNegative | None = None

    @field_validator("date")
    @classmethod
    def _is_a_date(cls, text: str) -> str:
        try:
            datetime.date.fromisoformat(text)
        except ValueError:
            raise ValueError("must be a date, YYYY-MM-DD") from None
        return text

    def days_old(self, today: datetime.date) -> int:
        """Days since."""
        return (today - datetime.date.fromisoformat(self.date)).days


class Vehicle(Section):
    """A vehicle file (config/vehicles/*.toml)."""

    name: str
    simulated: bool = False
    """Whether it is a simulator: it needs no calibration."""
    body: Body
    rotors: Rotors
    autopilot: Autopilot
    link: Link
    noise: Noise | None = None
    controller: Controller
    limits: FlightLimits
    calibration: Calibration | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Vehicle:
        weight = self.body.mass_kg * GRAVITY_M_S2
        most = 4.0 * self.rotors.thrust_max_n
        if not self.limits.thrust_min_n < weight < self.limits.thrust_max_n:
            raise ValueError(
                f"limits.thrust_min_n {self.limits.thrust_min_n} and limits.thrust_max_n {self.limits.thrust_max_n}"
                f" must enclose the weight {weight:.2f} N of body.mass_kg {self.body.mass_kg}"
            )
        if self.limits.thrust_max_n > most:
            raise ValueError(
                f"limits.thrust_max_n {self.limits.thrust_max_n} is more than four rotors give"
                f" ({most:.2f} N = 4 x rotors.thrust_max_n)"
            )
        return self

    @property
    def delay_s(self) -> float:
        """From the stamp of a state to the effect of the command computed from it [s]."""
        return self.link.state_age_s + self.link.command_delay_s

    @property
    def state_age_max_s(self) -> float:
        """Oldest that states may be when they arrive [s]."""
        most = self.limits.state_age_max_s
        return self.link.state_age_s + STATE_AGE_ROOM_S if most is None else most

    @property
    def thrust_full_n(self) -> float:
        """Collective thrust at a command of 1 [N]."""
        return 4.0 * self.rotors.thrust_max_n

    def parameters(self) -> Parameters:
        """The constants of the control step."""
        c, lim = self.controller, self.limits
        gains = Gains(
            c.k1_1_s,
            c.k2,
            c.k3_1_s,
            c.k4_1_s,
            c.gamma_1_s3,
            c.position_error_max_m,
            HEADINGS[c.heading],
            c.heading_l1_1_s,
            c.heading_l2_1_s,
            c.heading_damping_1_s,
        )
        inverts = c.rate_lag_inversion
        on = (inverts, inverts, inverts) if isinstance(inverts, bool) else inverts
        rate_lag, integral = _where(on, self.autopilot.rate_lag_s), _where(on, self.autopilot.rate_integral_1_s)
        thrust_lag = self.rotors.lag_s if c.thrust_lag_compensation else 0.0
        drag = self.body.drag_1_s if c.drag_feedforward else 0.0
        model = Model(self.body.mass_kg, GRAVITY_M_S2, drag, rate_lag, integral, thrust_lag)
        limits = Limits(
            lim.thrust_min_n,
            lim.thrust_max_n,
            lim.rate_max_rad_s,
            lim.disturbance_max_m_s2,
            lim.heading_rate_max_rad_s,
            c.heading_speed_min_m_s,
        )
        return Parameters(gains, model, limits)


def _where(on: tuple[bool, bool, bool], values: Vec3) -> Vec3:
    """The values of the axes that are switched on, 0 for the others."""
    return (values[0] if on[0] else 0.0, values[1] if on[1] else 0.0, values[2] if on[2] else 0.0)


class Start(Section):
    """[start]: where the simulated vehicle waits in Hold."""

    position_m: Vector
    yaw_deg: Finite = 0.0


class SimulatedWorld(Section):
    """[world]: what acts on the simulated vehicle; the law knows nothing of it."""

    force_n: Vector = (0.0, 0.0, 0.0)
    gravity_factor: Positive = 1.0
    wind_m_s: Vector = (0.0, 0.0, 0.0)
    turbulence: NotNegative = 0.0
    seed: Annotated[int, Field(ge=0)] = 1


class Output(Section):
    """[output]: who follows the reference, and which setpoints go to the autopilot."""

    controller: Literal["law", "px4", "calibration"] = "law"
    """"px4": the reference itself is sent and PX4's own position controller follows it; then `kind` means nothing.
    "calibration": a cautious hover and the manoeuvres of [calibration]; `companion calibrate` flies it."""
    kind: Literal["auto", "rates", "attitude", "actuators"] = "auto"
    """What the law sends. "auto": rates, or attitude where the loop as it is measured before the flight asks for it
    (`flight.schedule`)."""

    @property
    def by_law(self) -> Literal["rates", "attitude", "actuators"]:
        """What the law sends unless something else is chosen before the flight."""
        return "rates" if self.kind == "auto" else self.kind

    @property
    def sends(self) -> Literal["rates", "attitude", "actuators", "position"]:
        """The setpoints that go to the autopilot."""
        return "position" if self.controller == "px4" else self.by_law


class CalibrationFlight(Section):
    """[calibration] of a flight file: the manoeuvres by which a vehicle is identified (docs/calibration.md)."""

    hold_s: Annotated[float, Field(ge=2.0, le=60.0, allow_inf_nan=False)] = 6.0
    """For how long the autopilot's own Hold is watched before."""
    rate_step_rad_s: Annotated[float, Field(ge=0.1, le=2.0, allow_inf_nan=False)] = 0.8
    """Of roll and pitch; yaw gets a third of it."""
    thrust_step: Annotated[float, Field(ge=0.05, le=0.5, allow_inf_nan=False)] = 0.3
    """Share of the hover thrust."""
    run_speed_m_s: Annotated[float, Field(ge=0.5, le=6.0, allow_inf_nan=False)] = 2.5
    """Largest of the runs, to the north and to the east."""
    run_length_m: Annotated[float, Field(ge=1.0, le=20.0, allow_inf_nan=False)] = 5.0
    """From end to end of a run."""
    repeats: Annotated[int, Field(ge=1, le=5)] = 2


class Acceptance(Section):
    """[acceptance]: what the flight is judged by; a summary value above its threshold misses it."""

    position_rms_m: Positive | None = None
    position_p95_m: Positive | None = None
    position_max_m: Positive | None = None
    vertical_rms_m: Positive | None = None
    heading_rms_rad: Positive | None = None
    settled_at_s: Positive | None = None

    def thresholds(self) -> dict[str, float]:
        """The thresholds that are set, by their key in the summary."""
        return {key: value for key, value in self.model_dump().items() if value is not None}


class Flight(Section):
    """A flight file (config/flights/*.toml), complete: overrides are merged into `vehicle`."""

    name: str
    vehicle: Vehicle
    trajectory: str | dict[str, Any]
    start: Start | None = None
    world: SimulatedWorld = SimulatedWorld()
    output: Output = Output()
    acceptance: Acceptance = Acceptance()
    statistics_from_s: NotNegative | None = None
    takeoff_altitude_m: Positive = 5.0
    takeoff: Literal["autopilot", "offboard"] = "autopilot"
    """Who takes off: the autopilot's own take-off, which needs a global position, or position setpoints in Offboard."""
    height_min_m: Finite = 0.5
    """Lowest height above home that a trajectory may ask for; below zero where the ground falls off."""
    after: Literal["hold", "land"] = "hold"
    calibration: CalibrationFlight | None = None

    @model_validator(mode="after")
    def _calibration_goes_with_its_controller(self) -> Flight:
        if (self.output.controller == "calibration") is not (self.calibration is not None):
            raise ValueError('output.controller = "calibration" and the table [calibration] go together')
        return self


def bundled_root() -> Path:
    """The folder of the bundled configuration: `config/` of a checkout, `companion/_config` of an installed wheel."""
    installed = Path(__file__).parent / "_config"
    return installed if installed.is_dir() else Path(__file__).parent.parent / "config"


def with_paths(data: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The contents of a trajectory or flight file, with the paths of trajectory files in them made absolute."""
    out = dict(data)
    if isinstance(out.get("file"), str):
        out["file"] = str(folder.absolute() / out["file"])
    named = out.get("trajectory")
    if isinstance(named, dict):
        out["trajectory"] = with_paths(named, folder)
    elif isinstance(named, str) and "\0" not in named and not Path(named).is_file() and (folder / named).is_file():
        out["trajectory"] = str(folder.absolute() / named)
    return out


_SINGULAR = {
    "vehicles": "vehicle",
    "trajectories": "trajectory",
    "flights": "flight",
    "faults": "fault",
    "campaigns": "study",
}


def find(name: str, kind: str) -> Path:
    """A file by its path, or by the name of a bundled one.

    Args:
        name: a path, or a bundled file's name without ending.
        kind: "vehicles", "trajectories", "flights", "faults" or "campaigns".

    Raises:
        InputError: there is neither.
    """
    path = Path(name)
    try:
        if path.is_file():
            return path
    except (OSError, ValueError):
        raise InputError(f"{name!r} is not a usable path") from None
    folder = bundled_root() / kind
    bundled = folder / f"{name}.toml"
    if "/" not in name and bundled.is_file():
        return bundled
    if path.is_dir():
        raise InputError(f"{name}: is a folder; a {_SINGULAR[kind]} file is wanted")
    known = ", ".join(sorted(p.stem for p in folder.glob("*.toml")))
    raise InputError(f"no {_SINGULAR[kind]} file {name!r}: neither a path nor one of the bundled ones ({known})")


def read_toml(path: Path) -> dict[str, Any]:
    """The contents of a TOML file, or an InputError that names the line.

    A trajectory's file that it names counts from its own folder, wherever the contents go from here.
    """
    try:
        with path.open("rb") as file:
            return with_paths(tomllib.load(file), path.parent)
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a text file (UTF-8 expected): byte {error.start}") from None
    except ValueError as error:  # the decoder's own, and numbers with thousands of digits
        raise InputError(f"{path}: not valid TOML: {error}") from None
    except RecursionError:
        raise InputError(f"{path}: not valid TOML: nested too deeply") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None


SectionT = TypeVar("SectionT", bound=BaseModel)


def explain(error: ValidationError) -> str:
    """All findings of pydantic in one line: key path, value, and what is allowed."""
    parts = []
    for finding in error.errors():
        where = ".".join(str(x) for x in finding["loc"])
        message = finding["msg"].removeprefix("Value error, ")
        message = message[0].lower() + message[1:]
        if finding["type"] == "missing":
            parts.append(f"{where} is missing")
        elif finding["type"] == "extra_forbidden":
            parts.append(f"{where} = {finding['input']!r} is not a known key")
        elif where:
            shown = "" if isinstance(finding["input"], dict) else f" = {finding['input']!r}"
            parts.append(f"{where}{shown}: {message}")
        else:
            parts.append(message)
    return "; ".join(parts)


def _tuples(value: Any) -> Any:
    """TOML's lists as tuples and its integers as they are: strict validation wants tuples."""
    if isinstance(value, Mapping):
        return {key: _tuples(item) for key, item in value.items()}
    if isinstance(value, list):
        return tuple(_tuples(item) for item in value)
    return value


def validate(section: type[SectionT], data: Mapping[str, Any], source: str) -> SectionT:
    """The section built from data, or an InputError with all that is wrong with it."""
    try:
        return section.model_validate(_tuples(data))
    except ValidationError as error:
        raise InputError(f"{source}: {explain(error)}") from None


def load_vehicle(name: str, overrides: Mapping[str, Any] | None = None) -> Vehicle:
    """The vehicle file of that name or path, with sections of `overrides` merged key by key."""
    path = find(name, "vehicles")
    data = read_toml(path)
    return validate(Vehicle, merged(data, overrides or {}), str(path))


def merged(base: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """`base` with the values of `overrides` laid over it, tables merged recursively."""
    out = dict(base)
    for key, value in overrides.items():
        below = out.get(key)
        out[key] = merged(below, value) if isinstance(below, Mapping) and isinstance(value, Mapping) else value
    return out


def build_flight(
    data: Mapping[str, Any], source: str, adjust: Callable[[dict[str, Any]], None] | None = None
) -> Flight:
    """A flight from the contents of its file; [controller], [limits] and [link] override the vehicle's.

    Args:
        data: the file's contents; `vehicle` is a name, a path or a whole table (as in a flight folder's flight.toml).
        source: what to call the file in errors.
        adjust: may change the merged data before it is validated (options of the command line).
    """
    data = dict(data)
    overrides: dict[str, Any] = {key: data.pop(key) for key in ("controller", "limits", "link") if key in data}
    vehicle = data.get("vehicle")
    if vehicle is None:
        raise InputError(f"{source}: vehicle is missing (the name of a vehicle file)")
    if isinstance(vehicle, str):
        path = find(vehicle, "vehicles")
        base = read_toml(path)
        validate(Vehicle, base, str(path))  # the vehicle's own faults are reported against its own file
    elif isinstance(vehicle, Mapping):
        base = dict(vehicle)
    else:
        raise InputError(f"{source}: vehicle = {vehicle!r}: must be the name of a vehicle file")
    data["vehicle"] = merged(base, overrides)
    if adjust is not None:
        adjust(data)
    return validate(Flight, data, source)


def load_flight(name: str, adjust: Callable[[dict[str, Any]], None] | None = None) -> Flight:
    """The flight file of that name or path."""
    path = find(name, "flights")
    return build_flight(read_toml(path), str(path), adjust)
