"""`visthrow diagnose map`: mappings proposed for real tables, tables of odd forms, logs of one
flight joined, throttles as commands.
"""

import numpy as np
import pytest
from pytest import approx, raises
from scipy.spatial.transform import Rotation

from tests.flightlogs import asks, flight, log_at, log_of
from tests.places import DATA
from tests.plants import paper_plant
from visthrow.common.errors import DiagnoseError, LogError
from visthrow.diagnose.inputs import setup
from visthrow.diagnose.inputs.map_cli import toml_of
from visthrow.diagnose.inputs.proposal import propose, propose_model
from visthrow.diagnose.throw.command_mistakes import derive_commands
from visthrow.diagnose.throw.recorded_flight import record_of
from visthrow.logs import read, table_of
from visthrow.logs.check.run import check, contradictions
from visthrow.logs.flightlog import Channel, FlightLog
from visthrow.logs.joining import join, offset_of
from visthrow.logs.readers.table_to_log import logs_of
from visthrow.logs.unit_names import UNITS

REAL = DATA / "real"
SETS = {
    "payload_cf_single/log204": "cf_payload",
    "payload_cf_two_drones/coltrans_02_cf3": "cf_payload_pair",
    "nanobench_cf21/B3_figure8_fast_rep1": "nanobench_cf21",
    "pendulum_single/single_pendulum_id": "pendulum_encoder",
}
SLOPE = 0.15
"""Tolerance of a slope from 20 s of an accelerometer with 0.1 m/s^2 of noise, averaged over 0.1 s.
"""
FREE = {"est_vel_w", "motor_command", "current", "angle_rate", "torque_command_b"}
"""Channels whose order or kind the proposal asks about, or that it leaves out."""


def hang(time: np.ndarray) -> np.ndarray:
    """Where a payload swings below its vehicle [m]."""
    swing = 0.2 * np.sin(3.0 * time)
    return 0.5 * np.column_stack([np.sin(swing), 0.0 * swing, -np.cos(swing)])


def units_of(proposal) -> dict[str, str]:
    return {c.name: c.unit for c in proposal.mapping.channels}


@pytest.mark.parametrize("path", SETS)
def test_a_proposal_names_the_columns_that_the_shipped_mapping_names(path, tmp_path):
    """Columns and units of every channel that both have are the same, and the file loads."""
    file = REAL / f"{path}.csv.gz"
    proposal = propose(table_of(file), str(file))
    (tmp_path / "mine.toml").write_text(toml_of(proposal, file.name))
    mine, shipped = (setup.load(name).table for name in (tmp_path / "mine.toml", SETS[path]))
    ours = {c.name: c for c in shipped.channels}
    common = [c for c in mine.channels if c.name in ours and c.name not in FREE]
    assert len(common) >= min(len(set(ours) - FREE) - 1, 8)
    for channel in common:
        positions = [
            c for c in shipped.channels if c.name in ("pos_w", "est_pos_w")
        ]  # captured, and estimated on board
        others = positions if channel.name == "pos_w" else [ours[channel.name]]
        if channel.name != "rate_b":  # several columns hold rates
            assert (channel.columns, channel.unit, channel.kind) in [
                (c.columns, c.unit, c.kind) for c in others
            ]
    assert (mine.time.column, mine.time.unit) == (shipped.time.column, shipped.time.unit)
    log = read(file, mine)[0]
    assert not contradictions(check([log], setup.describe_vehicle(tmp_path / "mine.toml")))


@pytest.mark.parametrize("seed", range(6))
def test_a_table_in_drawn_units_and_axes_is_read_as_it_was_flown(seed):
    rng = np.random.default_rng([2611, seed])
    columns = flight(15.0, seed=seed, scale=float(rng.choice([0.1, 0.5, 1.0])))
    flip = np.array([1.0, -1.0, -1.0]) if rng.random() < 0.5 else np.ones(3)
    quat = columns["quat_wb"] * [*flip, 1.0]
    first = ["q0", "q1", "q2", "q3"], quat[:, [3, 0, 1, 2]]
    names, attitude = first if rng.random() < 0.5 else (["qx", "qy", "qz", "qw"], quat)
    table = {"time": columns["time"] / UNITS[rng.choice(["s", "ms", "us"])][1]}
    table |= dict(zip(names, attitude.T))
    drawn = {"pos_w": ("m", "mm", "cm"), "rate_b": ("rad/s", "deg/s"), "acc_b": ("m/s^2", "g")}
    for stem, (name, units) in zip(("p", "gyro", "acc"), drawn.items()):
        table |= named(stem, columns[name] * flip / UNITS[rng.choice(units)][1])
    proposal = propose(table, "a.csv")
    assert not proposal.questions
    (log,) = logs_of(table, proposal.mapping, "a.csv")
    for name in drawn:
        assert log[name].values == approx(columns[name], rel=1e-6, abs=1e-6)
    assert np.abs((log["quat_wb"].values * columns["quat_wb"]).sum(1)) == approx(1.0)
    assert np.ptp(log["pos_w"].time) == approx(np.ptp(columns["time"]))


def test_the_input_that_the_force_follows_drives_the_vehicle():
    columns = flight(20.0)
    thrust = columns["command"][:, 0]
    table = fly_by_motors(columns, thrust, "motor") | named("acc", columns["acc_b"])
    other = thrust[::-1] + 0.1 * np.sin(7.0 * columns["time"])
    proposal = propose(table | {"thrust": other}, "a.csv")
    assert proposal.flyer["input"] == "motor_command"
    hover = 0.01 * np.median(thrust)  # read as per cent; four of them carry the vehicle
    lift = 4.0 * proposal.flyer["thrust_map"][1] * hover
    assert lift == approx(9.81 * proposal.flyer["mass"], rel=0.1)
    assert proposal.flyer["drag_xy"] == approx(
        0.3 * proposal.flyer["mass"], rel=0.05
    )  # or no wind acts
    assert asks(proposal, "The force follows 'motor_command' best")


def test_a_marker_in_millimetres_is_no_velocity_of_another():
    """On a turning body, a quarter of a turn apart, one goes as the other's derivative."""
    time = 0.01 * np.arange(500)
    table = {"time [s]": time}
    for body, phase in (("drone", 0.0), ("ball", 0.5 * np.pi)):
        turn = 3.0 * time + phase
        path = np.column_stack([np.cos(turn), np.sin(turn), 1.0 + 0.0 * turn])
        table |= {f"{body}.{axis} [mm]": 500.0 * c for axis, c in zip("XYZ", path.T)}
    assert [c.name for c in propose(table, "a.csv").mapping.channels] == ["pos_w"]


def test_a_payload_belongs_to_the_path_that_it_hangs_below():
    """The first of three paths is another vehicle's."""
    time = np.arange(0.0, 20.0, 0.01)
    path = np.column_stack([np.sin(0.9 * time), np.cos(1.7 * time), 2.0 + 0.2 * np.sin(time)])
    below = hang(time)
    columns = {"time": time} | named("pos_a", 0.7 * path[::-1] + 1.0)
    columns |= named("pos_b", path) | named("pos_c", path + below)
    made = {entry.name: entry.columns[0] for entry in propose(columns, "a").mapping.channels}
    assert made == {"pos_w": "pos_b_x", "payload_pos_w": "pos_c_x"}


@pytest.mark.parametrize(
    ("thrust", "load", "names"),
    [
        ("thrust_cmd", "ball_", "px py pz phi theta psi gx gy gz ax ay az vx vy vz"),
        (
            "cmd_thrust",
            "slung_",
            "px py pz phi_deg theta_deg psi_deg p q r acc_x acc_y acc_z vx vy vz",
        ),
        (
            "T",
            "obj_",
            "px py pz roll pitch yaw gyr_x gyr_y gyr_z ax_mps2 ay_mps2 az_mps2 vx vy vz",
        ),
        (
            "collective_des",
            "payload_",
            "px py pz phi theta psi gx_dps gy_dps gz_dps ax ay az vx vy vz",
        ),
        (
            "T",
            "ball_",
            "x_estimate y_estimate z_estimate roll_estimate pitch_estimate yaw_estimate"
            " roll_rate_dps pitch_rate_dps yaw_rate_dps ax ay az x_velocity y_velocity z_velocity",
        ),
    ],
)
def test_a_column_is_found_under_another_laboratorys_name(thrust, load, names):
    columns = flight(20.0)
    lean = Rotation.from_quat(columns["quat_wb"]).as_euler("ZYX", degrees=True)[:, ::-1]
    below = hang(columns["time"])
    table = {"utc_ms": 1.7e12 + 1e3 * columns["time"], thrust: columns["command"][:, 0]}
    path, speed = 1e3 * columns["pos_w"], 1e3 * columns["vel_w"]
    flown = np.hstack([path, lean, np.degrees(columns["rate_b"]), columns["acc_b"], speed])
    table |= dict(zip(names.split(), flown.T))
    table |= {f"{a}_sp": 100.0 + c for a, c in zip("xyz", path.T)}
    pos, angles, rates, acc, vel = (" ".join(part) for part in np.reshape(names.split(), (5, 3)))
    hung = {f"{load}{a}": c for a, c in zip("xyz", 1e3 * (columns["pos_w"] + below).T)}
    proposal = propose(table | hung, "a.csv", mass=0.15)
    made = {c.name: (" ".join(c.columns), c.unit) for c in proposal.mapping.channels}
    assert made == {
        "pos_w": (pos, "mm"),
        "vel_w": (vel, "mm/s"),
        "payload_pos_w": (" ".join(hung), "mm"),
        "quat_wb": (angles, "deg"),
        "rate_b": (rates, "deg/s"),
        "acc_b": (acc, "m/s^2"),
        "thrust_command": (thrust, "N"),
    }
    assert proposal.flyer["cable"]["length"] == approx(0.5, abs=0.01)
    (question,) = propose(table, "a.csv", mass=0.15).questions
    assert "does a load hang below?" in question


def test_a_thrust_goes_before_a_temperature_and_a_vehicle_before_its_ball():
    columns = flight(20.0)
    time = columns["time"]
    gone = np.outer(np.clip(time - 8.0, 0.0, 1.0), [1.5, 0.0, 1.2])
    table = {"time": time, "T": 31.0 + 0.5 * np.sin(0.1 * time)}
    table |= {f"ball_{a}": c for a, c in zip("xyz", (columns["pos_w"] - [0, 0, 0.5] - gone).T)}
    table |= dict(zip("xyz", columns["pos_w"].T)) | {"thrust": columns["command"][:, 0]}
    made = {c.name: c.columns for c in propose(table, "a.csv").mapping.channels}
    assert made["thrust_command"] == ("thrust",)
    assert made["pos_w"] == ("x", "y", "z")


@pytest.mark.parametrize(("reach", "unit"), [(40.0, "deg"), (0.6, "rad")])
def test_an_angle_is_in_the_unit_of_its_reach(reach, unit):
    time = 0.01 * np.arange(500)
    proposal = propose({"time": time, "theta": reach * np.sin(time)}, "a.csv")
    assert [(c.name, c.unit) for c in proposal.mapping.channels] == [("angle", unit)]
    assert "deg or rad?" in proposal.questions[0]


def test_the_imu_of_euroc_is_proposed():
    columns = flight(2.0)
    table = {"timestamp [ns]": 1e9 * columns["time"]}
    for stem, unit, name in (("w", "rad s^-1", "rate_b"), ("a", "m s^-2", "acc_b")):
        axes = zip("xyz", columns[name].T)
        table |= {f"{stem}_RS_S_{axis} [{unit}]": column for axis, column in axes}
    proposal = propose(table, "data.csv").mapping
    assert {"rate_b", "acc_b"} <= {channel.name for channel in proposal.channels}


def test_rows_that_share_a_stamp_have_a_clock():
    time = np.repeat(0.01 * np.arange(200), 3)
    table = {"time": time, "x": np.sin(time), "y": np.cos(time), "z": 1.0 + 0.1 * time}
    assert propose(table, "a.csv").why["time"].endswith("100 Hz")


def test_a_counter_in_a_table_without_a_header_is_no_place():
    time = 0.01 * np.arange(500)
    columns = 1e6 * time, np.arange(500.0), np.sin(time), np.cos(time), 1.0 + np.sin(2.0 * time)
    table = {f"column {i}": cells for i, cells in enumerate(columns, start=1)}
    assert propose(table, "a.log").mapping.entry("pos_w").columns[0] == "column 3"


def test_an_unknown_number_becomes_a_question(tmp_path):
    columns = flight(20.0)
    proposal = propose(named("pos", columns["pos_w"]) | named("acc", columns["acc_b"]), "a.csv")
    assert asks(proposal, "how far are the rows apart")
    with raises(LogError, match="none of its 2 columns holds numbers that change"):
        propose({"a": np.zeros(9), "b": np.array(["x"] * 9)}, "b.csv")
    with raises(LogError, match=r"a\.ulg: describes its own contents"):
        table_of(tmp_path / "a.ulg")
    (tmp_path / "a.csv").write_text("t,x\n")
    with raises(LogError, match="2 files; expected one: a mapping describes one table"):
        table_of(f"{tmp_path}/a.csv+{tmp_path}/b.csv")


def make_unnamed(
    columns: dict[str, np.ndarray], length: str, angle: str, above: float = 0.0
) -> dict[str, np.ndarray]:
    """Position, over a point so far above the floor, and angles, in units that no name says."""
    angles = Rotation.from_quat(columns["quat_wb"]).as_euler("ZYX")[:, :0:-1] / UNITS[angle][1]
    path = (columns["pos_w"] - [0.0, 0.0, above]) / UNITS[length][1]
    return {
        "time": columns["time"],
        **named("pos", path),
        "roll": angles[:, 0],
        "pitch": angles[:, 1],
        "yaw": 0.0 * angles[:, 0],
    }


@pytest.mark.parametrize("seed", range(6))
def test_metres_with_radians_differ_from_centimetres_with_degrees_or_become_a_question(seed):
    """About the origin both stay in a hall, and a hundredth of the path is near a 57th
    of the lean.
    """
    for units in (("cm", "deg"), ("m", "rad")):
        proposal = propose(
            make_unnamed(flight(20.0, seed=seed, scale=0.05), *units, above=2.9), "a.csv"
        )
        made = units_of(proposal)
        questions = "".join(proposal.questions)
        assert made == {"pos_w": units[0], "quat_wb": units[1]} or "with deg would do" in questions


def test_angles_that_would_turn_a_flight_over_are_in_degrees():
    proposal = propose(make_unnamed(flight(20.0, scale=0.2), "mm", "deg"), "a.csv")
    assert units_of(proposal) == {"pos_w": "mm", "quat_wb": "deg"}
    assert "deg, axes x,y,z by gravity" in proposal.why["quat_wb"]
    assert not proposal.questions


def test_a_pitch_that_counts_up_with_the_nose_is_negated_and_read_back():
    """A Crazyflie's; no turn of axes does that. A path that no lean makes says no unit."""
    columns = flight(20.0, scale=0.1)
    angles = Rotation.from_quat(columns["quat_wb"]).as_euler("ZYX")[:, ::-1] * [1.0, -1.0, 1.0]
    names = ("roll [rad]", "pitch [rad]", "yaw [rad]")
    table = {"time": columns["time"]} | named("pos", columns["pos_w"]) | dict(zip(names, angles.T))
    proposal = propose(table, "a.csv")
    assert proposal.mapping.entry("quat_wb").columns == (names[0], f"-{names[1]}", names[2])
    assert not proposal.left_out
    quat = logs_of(table, proposal.mapping, "a.csv")[0]["quat_wb"].values
    assert np.abs((quat * columns["quat_wb"]).sum(1)) == approx(1.0)
    other = flight(20.0, seed=4, scale=0.1)["pos_w"] - [0.0, 0.0, 2.9]
    assert asks(propose(table | named("pos", 1e2 * other), "a.csv"), "'m' with axes")


def test_what_falls_says_its_unit_and_a_hall_what_it_can():
    throws = table_of(REAL / "jugglebot_throws" / "session7.csv.gz")
    bare = {name.removesuffix("_mm"): cells for name, cells in throws.items()}
    proposal = propose(bare, "a.csv")
    assert [(c.name, c.unit) for c in proposal.mapping.channels] == [("pos_w", "mm")]
    assert "falls freely" in proposal.why["pos_w"]
    slow = {"time": 0.01 * np.arange(2000)}
    for reach, unit, is_question in (
        (3.0, "m", False),
        (15.0, "m", True),
        (400.0, "mm", True),
        (3e6, "m", True),
    ):
        sway = reach * np.sin(0.2 * slow["time"])
        proposal = propose(
            slow | named("pos", np.column_stack([sway, 0.5 * sway, 0.2 * sway])), "a.csv"
        )
        assert proposal.mapping.channels[0].unit == unit
        assert asks(proposal, f"'{unit}' is a guess") == is_question


def test_a_unit_of_time_that_no_log_has_is_doubted_unless_it_is_stated():
    """Stamps of 10,000 a row, headed milliseconds, are microseconds."""
    rows = np.arange(2000.0)
    path = 0.5 * np.sin(np.outer(0.01 * rows, [1.9, 2.3, 1.1]))
    speed = np.gradient(path, 0.01, axis=0)
    columns = {"time[ms]": 1e4 * rows, **named("pos", path), **named("vel", speed)}
    proposal = propose(columns, "a.csv")
    assert proposal.mapping.time.unit == "us"
    assert proposal.mapping.entry("vel_w").unit == "m/s"
    assert asks(proposal, "fits the units us; 'us' is a guess")
    assert propose(columns, "a.csv", time_unit="ms").mapping.time.unit == "ms"


def test_a_thrust_doubts_a_mass_in_grams_and_a_mass_says_the_unit_of_a_thrust():
    file = REAL / "payload_cf_single" / "log206.csv.gz"
    with raises(
        LogError,
        match=(
            r"36\.9 is 36\.9 kg, but .* carries 0\.0408 kg in N: grams\? Expected kilograms: --mass"
            r" 0\.0369"
        ),
    ):
        propose(table_of(file), file.name, mass=36.9)
    proposal = propose(table_of(file), file.name, mass=0.0369)
    assert "N by the mass: it carries 0.04077 kg" in proposal.why["thrust_command"]
    assert not asks(proposal, "thrust")
    grams = table_of(file)
    grams["ctrlLee.thrustSI"] = grams["ctrlLee.thrustSI"] / UNITS["gf"][1]
    proposal = propose(grams, file.name, mass=0.0369)
    assert units_of(proposal)["thrust_command"] == "gf"
    assert proposal.flyer["thrust_map"] == [0.0, 1.0, 0.0]
    both = propose(grams, file.name, mass=36.9)  # 41 kgf carry it as well as 41 gf carry 36.9 g
    assert asks(both, "36.9 kg and 'ctrlLee.thrustSI' is in kgf, or 36.9 g and gf?")
    apart = {name: cells for name, cells in table_of(file).items() if not name.startswith("acc")}
    assert propose(apart, file.name, mass=0.05).flyer["thrust_map"] == [0.0, 1.0, 0.0]
    apart["ctrlLee.thrustSI"] = 1e3 * apart["ctrlLee.thrustSI"]
    strange = propose(apart, file.name, mass=4.0)
    assert asks(strange, "no unit explains that")


def test_a_mass_that_no_data_contradicts_becomes_a_question():
    file = REAL / "nanobench_cf21" / "B3_figure8_fast_rep1.csv.gz"
    proposal = propose(table_of(file), file.name, mass=27.0)
    assert asks(proposal, "the vehicle weighs 27 kg? Nothing in the log is in newtons")
    ball = REAL / "jugglebot_throws" / "session7.csv.gz"
    assert asks(propose(table_of(ball), ball.name, mass=0.1), "--mass is not used")


def named(stem: str, values: np.ndarray) -> dict[str, np.ndarray]:
    return {f"{stem}_{letter}": column for letter, column in zip("xyz", values.T)}


def test_logs_of_one_flight_are_joined_on_one_clock(tmp_path):
    """Motion capture 37.42 s behind the vehicle's log; rates by gyro and by attitude show it."""
    columns = flight(20.0)
    whole = log_of(columns)
    onboard = FlightLog(
        {name: whole[name] for name in ("rate_b", "acc_b", "command")}, {"source": "a.npz"}
    )
    late = {name: columns[name][300:] for name in ("pos_w", "quat_wb")}
    captured = log_at(whole["pos_w"].time[300:] + 37.42, **late)
    captured.meta["source"] = "b.npz"
    offset, correlation, by = offset_of(onboard, captured)
    assert offset == approx(-37.42, abs=0.01)
    assert correlation > 0.9
    assert by == "body rates"
    onboard.save(tmp_path / "a.npz")
    captured.save(tmp_path / "b.npz")
    (log,) = read(f"{tmp_path}/a.npz+{tmp_path}/b.npz")
    assert log["pos_w"].time == approx(whole["pos_w"].time[300:], abs=0.01)
    assert set(log.channels) == {"rate_b", "acc_b", "command", "pos_w", "quat_wb"}
    stranger = log_of(flight(20.0, seed=9))
    with raises(LogError, match="not the same flight"):
        join([onboard, FlightLog({"quat_wb": stranger["quat_wb"]}, {"source": "c.npz"})])
    with raises(LogError, match="no quantity in common with the other logs"):
        join([onboard, log_at(np.arange(9.0), battery_voltage=np.ones(9))])


NEAR = 1e-3
"""Of an offset by gyro and attitudes of 0.2 deg; 0.15 ms is the standard deviation of ten flights
of 10 s, 0.38 ms the largest [s].
"""


@pytest.mark.parametrize("seed", range(3))
def test_a_gyro_joins_by_attitudes_and_takes_the_place_of_estimated_rates(seed):
    """As `hil` writes its log: rates that it worked out of poses come 6 ms late.

    They do not set the offset, and are dropped.
    """
    columns = flight(10.0, seed=seed)
    time, rng = columns["time"][::2], np.random.default_rng(seed)
    noise = Rotation.from_rotvec(np.radians(0.2) * rng.standard_normal((len(time), 3)))
    turned = Rotation.from_euler("z", 0.5)  # markers glued on askew
    quat = (Rotation.from_quat(columns["quat_wb"][::2]) * turned * noise).as_quat()
    rate = np.stack(
        [np.interp(time - 0.006, columns["time"], x) for x in columns["rate_b"].T], axis=1
    )
    run = log_at(time, quat_wb=quat, rate_b=rate)
    run.meta.update(estimated=["vel_w", "rate_b"], ingest={"rate_b": {}, "quat_wb": {}})
    gyro = np.round(
        np.degrees(columns["rate_b"])
    )  # whole degrees a second, as Betaflight's blackbox has them
    box = log_at(columns["time"] + 5.0, rate_b=np.radians(gyro))
    box.meta.update(source="box", ingest={"rate_b": {}})
    log = join([run, box])
    assert log.meta["joined"][0]["offset_s"] == approx(-5.0, abs=NEAR)
    assert np.array_equal(log["rate_b"].values, box["rate_b"].values)
    assert log.meta["estimated"] == ["vel_w"]
    assert log.meta["ingest"]["rate_b"]["clock"] == "box"
    assert "rate_b" in log.without_estimates()
    again = join([box, run])
    assert again["rate_b"] is box["rate_b"]
    assert "estimated" not in again.meta


def test_a_throttle_becomes_a_command_in_newtons():
    """A log of PX4 holds a throttle and rates; hover is at 0.37 of full, with a slope of 0.8 about
    it; attitudes come 3 ms after positions.
    """
    columns, plant = flight(20.0), paper_plant()
    weight = 9.81 * plant.total_mass
    force = np.linalg.norm(columns["acc_b"], axis=1) / 9.81
    smooth = np.convolve(np.pad(force, 5, mode="edge"), np.ones(11) / 11, "valid")
    share = 0.37 * (1.0 + (smooth - 1.0) / 0.8)
    ahead = np.interp(columns["time"] + 0.05, columns["time"], share)
    late = Channel(columns["time"] + 0.003, columns.pop("quat_wb"), "1", "world")
    rates = columns.pop("command")[:, 1:]
    log = log_of(columns | {"throttle": ahead, "rate_setpoint_b": rates}, quat_wb=late)
    (made,), (mistake,) = derive_commands([log], plant)
    assert mistake.name == "throttle"
    assert "throttle / 0.37" in mistake.equation
    command = made["command"]
    true = weight * np.interp(command.time + 0.05, columns["time"], smooth)
    assert np.mean(command.values[:, 0]) == approx(np.mean(true), rel=0.02)
    assert np.polyfit(true, command.values[:, 0], 1)[0] == approx(1.0, abs=SLOPE)
    recorded = record_of(made)
    assert len(recorded.vehicle.time) == len(recorded.attitude.time) > 1000, (
        "attitudes lie between the positions"
    )


def test_an_accelerometer_says_which_column_of_a_quaternion_is_w():
    """Numbered columns in an autopilot's axes, without a position, beside angular accelerations."""
    columns = flight()
    down = np.array([1.0, -1.0, -1.0])
    x, y, z, w = columns["quat_wb"].T
    acc = columns["acc_b"] * down
    rates = columns["rate_b"] * down
    table = {"time": columns["time"], "q0": w, "q1": x, "q2": -y, "q3": -z}
    table |= named("acc_b", acc) | named("ang_acc_b", np.gradient(rates, axis=0))
    table |= named("angular_velocity", rates)
    channels = {channel.name: channel for channel in propose(table, "a.csv").mapping.channels}
    attitude = channels["quat_wb"]
    assert (attitude.order, attitude.axes, attitude.body_axes) == ("wxyz", "x,-y,-z", "x,-y,-z")
    assert channels["acc_b"].axes == channels["rate_b"].axes == "x,-y,-z"
    assert "pos_w" not in channels
    assert channels["rate_b"].unit == "rad/s"


def test_an_attitude_that_comes_too_seldom_is_refused_by_its_period():
    columns = flight(20.0)
    whole = log_of(columns)
    attitude = Channel(columns["time"][3::6] + 0.003, columns["quat_wb"][3::6], "1", "world")
    log = FlightLog(whole.channels | {"quat_wb": attitude}, {"source": "a.ulg"})
    with raises(DiagnoseError, match="the attitude comes every 60 ms"):
        record_of(log)


def fly_by_motors(columns: dict[str, np.ndarray], motors: np.ndarray, name: str) -> dict:
    """Table of a flight whose four motors have the same numbers."""
    table = {"time": columns["time"]} | named("pos", columns["pos_w"])
    table |= {f"q{a}": c for a, c in zip("xyzw", columns["quat_wb"].T)}
    return table | {f"{name}{i}": motors for i in range(1, 5)}


@pytest.mark.parametrize(
    ("name", "counts", "tau"),
    [
        ("rpm", lambda share: 9000.0 * np.sqrt(share), 0.0),
        ("pwm", lambda share: 1000.0 + 900.0 * share, 0.03),
    ],
)
def test_a_proposed_map_of_motors_carries_the_vehicle(name, counts, tau):
    """By the speeds of the rotors, which have no lag; by pulses, which begin at 1000 us."""
    columns = flight(20.0)
    true = columns["command"][:, 0]
    motors = counts(true / np.max(true))
    table = fly_by_motors(columns, motors, name)
    proposal = propose(table, "a.csv", mass=0.2)
    (log,) = logs_of(table, proposal.mapping, "a.csv")
    assert model_thrust(log, proposal) == approx(true, rel=0.02)
    assert proposal.flyer["motor_time_constant"] == tau
    del columns["command"]
    outputs = Channel(columns["time"], np.tile(motors, (4, 1)).T, "1", "none")
    log = log_of(columns, motor_output=outputs)  # of an autopilot, which needs no mapping
    thrust = model_thrust(log, propose_model(log, 0.2))
    assert np.mean(thrust) == approx(np.mean(true), rel=0.02)
    with raises(LogError, match="needs pos_w, quat_wb and one of"):
        propose_model(log_of(columns))


def model_thrust(log: FlightLog, proposal) -> np.ndarray:
    """Thrust of four motors by a proposed model [N], shape (T,)."""
    inputs = log[proposal.flyer["input"]].values
    return np.polynomial.polynomial.polyval(inputs, proposal.flyer["thrust_map"]).sum(1)


def test_outputs_without_a_motor_are_left_out_and_a_flaps_output_becomes_a_question():
    columns = flight(20.0)
    outputs = np.tile(1000.0 + 400.0 * columns["command"][:, :1] / 2.0, (1, 6))
    outputs[:, 4:] = 900.0
    table = {"time": columns["time"]} | named("pos", columns["pos_w"])
    table |= {f"actuator_outputs[{i}]": c for i, c in enumerate(outputs.T)}
    entry = propose(table, "a.csv").mapping.entry("motor_command")
    assert entry.columns == tuple(f"actuator_outputs[{i}]" for i in range(4))
    for i in (4, 5):
        table[f"actuator_outputs[{i}]"] = 1500.0 + 100.0 * np.sin(i * columns["time"])
    proposal = propose(table, "a.csv")
    assert proposal.mapping.entry("motor_command") is None
    assert asks(proposal, "which four of actuator_outputs[0]")


def test_a_flag_is_no_number_of_a_flight():
    columns = flight(20.0)
    table = {"time": columns["time"]} | named("pos", columns["pos_w"])
    half = np.arange(len(columns["time"])) % 7 == 0
    table |= {"data_valid": half.astype(float), "tracking_valid": half.astype(float)}
    assert not asks(propose(table, "a.csv"), "[table.split]")
    proposal = propose(table | {"flight_id": half.astype(float)}, "a.csv")
    assert asks(proposal, "'flight_id' has 2 values")


def test_a_thrust_in_shares_of_the_full_one_is_doubted():
    """Kilograms of thrust fit it to 20 %."""
    columns = flight(20.0)
    table = fly_by_motors(columns, 0.7 + 0.0 * columns["time"], "motor")
    table["hover_thrust"] = 0.32 * columns["command"][:, 0]
    proposal = propose(table, "a.csv", mass=0.9)
    assert asks(proposal, "or a share of the full thrust?")
