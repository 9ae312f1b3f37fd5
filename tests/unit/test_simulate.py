"""`companion simulate` and the prediction gate: flights without sockets."""

import csv
import math

import numpy as np
import pytest

from companion.campaign.predict import gate_prediction, predict
from companion.campaign.simulate import CSV_COLUMNS, fly_ideal, fly_sampled, write_csv
from companion.config import Flight, SimulatedWorld, Start, load_flight, load_vehicle
from companion.errors import InputError, RefusedError
from companion.flight.engines import kernels
from companion.frames import degrees
from companion.trajectory.load import build, load

PLAIN = kernels("python")


def short(duration_s=4.0, **changes):
    flight = load_flight("paper").model_copy(update={"start": Start(position_m=(0.5, 0.0, -10.0)), **changes})
    data = {
        "shape": "lemniscate",
        "anchor": "local",
        "join": "law",
        "duration_s": duration_s,
        "lemniscate": {"center_m": [-5, 0, -10], "amplitude_m": [5, 2.5], "angular_rate_rad_s": 0.2},
    }
    return flight, build(data, "eight", "test")


def read(path):
    with path.open() as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name]) for row in rows]) for name in CSV_COLUMNS}


def test_the_csv_has_the_promised_columns_and_one_row_per_control_step(tmp_path):
    flight, trajectory = short()
    trace = fly_sampled(flight, trajectory, PLAIN)
    write_csv(trace, tmp_path / "flight.csv")
    header = (tmp_path / "flight.csv").read_text().splitlines()[0]
    assert header == (
        "t_s,p_n,p_e,p_d,v_n,v_e,v_d,q_w,q_x,q_y,q_z,w_x,w_y,w_z,thrust_n,thrust_rate_n_s,tau_x,tau_y,tau_z,"
        "b_hat_n,b_hat_e,b_hat_d,e1_n,e1_e,e1_d,e2_n,e2_e,e2_d,e3_n,e3_e,e3_d,e4_n,e4_e,e4_d"
    )
    columns = read(tmp_path / "flight.csv")
    assert np.diff(columns["t_s"]) == pytest.approx(0.004, abs=1e-9)
    assert len(columns["t_s"]) == len(trace.rows) > 4.0 / 0.004 - 10
    q = np.stack([columns[f"q_{x}"] for x in "wxyz"])
    assert np.linalg.norm(q, axis=0) == pytest.approx(1.0, abs=1e-9)


def test_ideal_and_sampled_flights_agree_to_the_lags(tmp_path):
    """The same law on the same start: the sampled flight with its lags stays within centimetres of the ideal one."""
    world = SimulatedWorld(force_n=(4.76, 0.0, 0.0), gravity_factor=1.02)
    flight, trajectory = short(6.0, world=world)
    ideal, sampled = fly_ideal(flight, trajectory), fly_sampled(flight, trajectory, PLAIN)
    write_csv(ideal, tmp_path / "ideal.csv")
    assert set(read(tmp_path / "ideal.csv")) == set(CSV_COLUMNS)
    end_ideal, end_sampled = ideal.rows[-1], sampled.rows[-1]
    assert math.dist(end_ideal.errors[0], end_sampled.errors[0]) < 0.1
    assert end_ideal.b_hat == pytest.approx(ideal.truth_disturbance_m_s2, abs=0.15)
    assert sampled.truth_disturbance_m_s2 == pytest.approx(ideal.truth_disturbance_m_s2)


def test_the_same_seed_gives_the_same_flight_and_another_does_not():
    flight, trajectory = short(1.0)
    a, b = (fly_sampled(flight, trajectory, PLAIN).rows[-1] for _ in range(2))
    assert a == b
    other = flight.model_copy(update={"world": SimulatedWorld(seed=2)})
    assert fly_sampled(other, trajectory, PLAIN).rows[-1] != a


@pytest.mark.parametrize("command_s", [0.0, 0.005, 0.02])
def test_a_delay_counts_the_same_on_either_side_of_the_companion(command_s):
    """States come every 50 ms: a command that needs a part of it acts within the interval, not at its end."""
    vehicle = load_vehicle("bundled")
    link = vehicle.link.model_copy(
        update={"state_rate_hz": 20.0, "state_age_s": 0.02 - command_s, "command_delay_s": command_s}
    )
    slow = vehicle.model_copy(update={"link": link})
    flight = Flight(name="test", vehicle=slow, trajectory="circle")
    found = predict(flight, load("circle"), PLAIN, 10.0)
    assert found.error_max_m.value < 0.05 and found.tilt_max_rad.value < 0.3


def test_prediction_names_time_and_size_of_the_worst_violation():
    flight, trajectory = short()
    found = gate_prediction(flight, trajectory, PLAIN)
    assert found.thrust_min_n.value < 4.76 * 9.81 < found.thrust_max_n.value
    tight = flight.vehicle.limits.model_copy(update={"tilt_max_rad": 0.1})
    vehicle = flight.vehicle.model_copy(update={"limits": tight})
    with pytest.raises(RefusedError, match=r"tilt 0\.\d+ rad at \d\.\d+ s, limit 0\.1 rad \(limits\.tilt_max_rad\)"):
        gate_prediction(flight.model_copy(update={"vehicle": vehicle}), trajectory, PLAIN)


def test_a_flight_that_its_guard_would_end_is_refused_with_the_guards_words(tmp_path):
    """Gains that turn the nose as fast as they can, while the vehicle leans into a path that begins abeam."""
    points = tmp_path / "points.toml"
    lines = "".join(f"[[waypoint]]\np_m = {p}\n" for p in ([0.0, 0.0, -9.0], [4.0, 0.0, -9.0], [4.0, 3.0, -9.0]))
    points.write_text(f'shape = "waypoints"\nanchor = "local"\n{lines}')
    vehicle = load_vehicle("bundled")
    trajectory = load(points, vehicle=vehicle)
    begin_deg = degrees(trajectory.at(0.5).yaw)
    flight = Flight(name="test", vehicle=vehicle, trajectory="points")
    abeam = flight.model_copy(update={"start": Start(position_m=(0.0, 0.0, -9.0), yaw_deg=begin_deg + 90.0)})
    assert gate_prediction(abeam, trajectory, PLAIN).excess is None
    quick = vehicle.controller.model_copy(update={"heading_l1_1_s": 2.0, "heading_l2_1_s": 4.0})
    hasty = abeam.model_copy(update={"vehicle": vehicle.model_copy(update={"controller": quick})})
    with pytest.raises(RefusedError, match=r"ended by its guard LYAPUNOV at [12]\.\d+ s: V_H \(vertical\) 0\.0\d+ m"):
        gate_prediction(hasty, trajectory, PLAIN)


def test_a_flight_without_start_is_predicted_from_the_trajectory_and_not_simulated():
    flight = load_flight("paper").model_copy(update={"start": None})
    found = predict(flight, load("paper"), PLAIN, 1.0)
    assert found.error_max_m.value < 0.5
    with pytest.raises(InputError, match="has no \\[start\\]"):
        fly_sampled(flight, load("paper"), PLAIN)


def test_a_csv_that_cannot_be_written_says_so(tmp_path):
    flight, trajectory = short(0.2)
    with pytest.raises(InputError, match="cannot be written"):
        write_csv(fly_sampled(flight, trajectory, PLAIN), tmp_path / "nowhere" / "flight.csv")
