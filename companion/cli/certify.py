"""CONFIG is a flight file, whose trajectory and start are predicted too, or a vehicle file. Exit code 3: refused."""

from __future__ import annotations

import json
from math import isfinite
from typing import Annotated, Any

import typer

from companion.cli.common import FrameOption, JsonOption, TimeScaleOption, say, trajectory_changes

EXAMPLE = "Example: companion certify paper"


def run(
    config: Annotated[str, typer.Argument(help="Flight or vehicle file, or the name of a bundled one.")],
    trajectory: Annotated[
        str | None,
        typer.Option("--trajectory", metavar="NAME", help="Predict this trajectory instead of the flight's."),
    ] = None,
    frame: FrameOption = None,
    output: Annotated[
        str | None, typer.Option("--output", help='Over "rates" or "attitude" setpoints; default: the flight\'s.')
    ] = None,
    start: Annotated[
        str | None, typer.Option("--start", metavar="N,E,D", help="Predict from here instead of the flight's [start].")
    ] = None,
    time_scale: TimeScaleOption = None,
    as_json: JsonOption = False,
) -> None:
    """Prints certificate, margins and predicted extremes of a configuration."""
    from companion.campaign.predict import Extreme, bounds, gate_prediction
    from companion.control.certificate import certify, disturbance_overcome
    from companion.errors import CompanionError, ExitCode
    from companion.flight.engines import kernels
    from companion.flight.loop_margins import loop_margins, timing
    from companion.flight.preflight import gate_gains, gate_reference
    from companion.trajectory.load import of_flight

    flight = _flight(config, trajectory_changes(trajectory, frame), start, time_scale, output)
    vehicle = flight.vehicle
    parameters = vehicle.parameters()
    certificate = certify(parameters.gains, parameters.model.drag)
    found = loop_margins(vehicle, flight.output.by_law)
    document: dict[str, Any] = {
        "vehicle": vehicle.name,
        "drag_1_s": parameters.model.drag,
        "output": flight.output.by_law,
        "eigenvalues": {
            "q_estimator_on": certificate.inside,
            "q_estimator_off": certificate.inside_frozen,
            "qr_estimator_on": certificate.outside,
            "qr_estimator_off": certificate.outside_frozen,
        },
        "disturbance_overcome_m_s2": disturbance_overcome(parameters.gains),
        "poles_1_s": [[pole.real, pole.imag] for pole in certificate.poles],
        "sampled_loop": {
            "interval_s": timing(vehicle).interval_s,
            "delay_s": vehicle.delay_s,
            "spectral_radius": found.spectral_radius,
            "delay_margin_s": found.delay_margin_s,
            "interval_max_s": found.interval_max_s,
        },
    }
    refusals: list[str] = []
    try:
        gate_gains(vehicle, flight.output.by_law)
    except CompanionError as error:
        refusals.append(str(error))
    if flight.trajectory:
        path = of_flight(flight)
        low, high = bounds(flight, path)
        document["thrust_bounds_n"] = {"low": low, "high": high} if isfinite(low) else None
        try:
            gate_reference(path, vehicle)
            prediction = gate_prediction(flight, path, kernels("python"))
            document["predicted"] = {
                name: value._asdict() if isinstance(value, Extreme) else value
                for name, value in prediction._asdict().items()
            }
        except CompanionError as error:
            refusals.append(str(error))
    refusal = refusals[0] if refusals else None
    document["refused"] = refusal
    if as_json:
        print(json.dumps(document, indent=2))
    else:
        _print(document)
    if refusal is not None:
        raise typer.Exit(int(ExitCode.REFUSED))


def _flight(config: str, given: dict[str, Any], start: str | None, time_scale: float | None, output: str | None) -> Any:
    """The flight of a flight file; of a vehicle file one without a trajectory, unless one is given."""
    from pathlib import Path

    from companion.config import Start, build_flight, bundled_root, find, read_toml, validate
    from companion.errors import InputError
    from companion.trajectory.load import embedded

    is_flight = (bundled_root() / "flights" / f"{config}.toml").is_file() or Path(config).is_file()
    path = find(config, "flights" if is_flight else "vehicles")
    data = read_toml(path)
    if output is not None:
        given = {**given, "output": {**data.get("output", {}), "kind": output}}
    if "vehicle" in data:
        flight = build_flight({**data, **given}, str(path))
    else:
        flight = build_flight({"name": path.stem, "vehicle": data, "trajectory": "", **given}, str(path))
    given_for = {"--start": start, "--time-scale": time_scale}
    idle = next((name for name, value in given_for.items() if value is not None and not flight.trajectory), None)
    if idle is not None:
        raise InputError(f"{idle}: there is no flight to predict, {path.name} is a vehicle file; add --trajectory")
    if start is not None:
        try:
            numbers = tuple(float(x) for x in start.split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != 3:
            raise InputError(f"--start {start!r}: expected three numbers north,east,down in metres")
        flight = flight.model_copy(update={"start": validate(Start, {"position_m": numbers}, "--start")})
    return embedded(flight, time_scale) if flight.trajectory else flight


def _print(document: dict[str, Any]) -> None:
    say(f"vehicle {document['vehicle']}, drag {document['drag_1_s']:g} 1/s")
    say("eigenvalues (all must be above 0)")
    for key, name in (
        ("q_estimator_on", "Q   inside p_max, estimator on"),
        ("q_estimator_off", "Q   inside p_max, estimator off"),
        ("qr_estimator_on", "Qr  outside p_max, estimator on"),
        ("qr_estimator_off", "Qr  outside p_max, estimator off"),
    ):
        say(f"  {name:34s} " + "  ".join(f"{x:8.4f}" for x in document["eigenvalues"][key]))
    poles = ", ".join(f"{re:.3f}{im:+.3f}i" if im else f"{re:.3f}" for re, im in document["poles_1_s"])
    say(f"poles of the linear loop [1/s]: {poles}")
    overcome = document["disturbance_overcome_m_s2"]
    say(f"disturbance held against with the estimator still: {overcome:.2f} m/s^2 (the limit must be below)")
    loop = document["sampled_loop"]
    how = f"{1.0 / loop['interval_s']:.0f} Hz with {loop['delay_s'] * 1e3:.0f} ms of delay"
    say(f"sampled loop at {how}, output {document['output']}")
    say(f"  {'largest |eigenvalue|':34s} {loop['spectral_radius']:.5f} (below 1)")
    say(f"  {'margin in delay':34s} {loop['delay_margin_s'] * 1e3:.1f} ms (at least 10 ms)")
    say(f"  {'longest tolerable interval':34s} {loop['interval_max_s'] * 1e3:.0f} ms")
    if "thrust_bounds_n" in document:
        bound = document["thrust_bounds_n"]
        if bound is None:
            say("thrust bounds (38): none, the estimator is off")
        else:
            silent = "; it says nothing here, the prediction decides" if bound["low"] <= 0.0 else ""
            say(f"thrust bounds (38): {bound['low']:.1f} to {bound['high']:.1f} N{silent}")
    if "predicted" in document:
        say("predicted for this trajectory and start (nominal loop, first seconds)")
        names = {
            "thrust_min_n": ("least thrust", "N"),
            "thrust_max_n": ("greatest thrust", "N"),
            "tilt_max_rad": ("greatest tilt", "rad"),
            "rate_max_rad_s": ("greatest body rate", "rad/s"),
            "torque_max_n_m": ("greatest torque", "N m"),
            "error_max_m": ("greatest position error", "m"),
        }
        for key, (name, unit) in names.items():
            extreme = document["predicted"][key]
            say(f"  {name:34s} {extreme['value']:.2f} {unit} at {extreme['at_s']:.2f} s")
        say(f"  {'thrust at a limit for':34s} {document['predicted']['thrust_limited_s']:.2f} s")
        say(f"  {'a rate cut for':34s} {document['predicted']['rate_limited_s']:.2f} s")
    say("certified" if document["refused"] is None else f"REFUSED: {document['refused']}")
