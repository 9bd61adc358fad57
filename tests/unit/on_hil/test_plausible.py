"""Units by physics: recorded flights as they are, and with each unit of the mapping wrong."""

import re
import tomllib
from dataclasses import replace

import numpy as np
from pytest import mark, raises

from hil.errors import SourceError
from hil.links.clock import ManualClock, MonotonicClock
from hil.params import HilParams
from hil.poses.pose import Pose
from hil.poses.sources.open_source import open_source, read_poses, unit_problems
from tests.commands import run_command
from tests.configs import load_run
from tests.places import DATA
from visthrow.common import toml_text

FLIGHTS = {
    "crazyflie_log": "payload_cf_single/log201.csv.gz",
    "crazyflie_pair_log": "payload_cf_two_drones/coltrans_02_cf3.csv.gz",
    "slungload_log": "slungload_camera/rosbag_16.csv.gz",
}


def flight(name: str, **units: str) -> HilParams:
    """The config of a recorded flight, some units of its mapping replaced, by channel; ``time`` is
    its clock's.
    """
    params = load_run(name, [f'source.file="{DATA / FLIGHTS[name]}"'])
    columns = tuple(replace(c, unit=units.get(c.name, c.unit)) for c in params.source.columns)
    time = replace(params.source.time, unit=units.get("time", "s"))
    return replace(params, source=replace(params.source, columns=columns, time=time))


def problems(params: HilParams) -> str:
    return "; ".join(unit_problems(read_poses(params), params.frames))


@mark.parametrize("name", FLIGHTS)
def test_flights_as_they_are(name):
    assert problems(flight(name)) == ""


@mark.parametrize(
    ("name", "units", "message"),
    [
        (
            "crazyflie_log",
            {"pos_w": "m", "payload_pos_w": "m"},
            "pos_w: .* millimetres taken for metres",
        ),
        ("crazyflie_log", {"time": "ms"}, "is the unit of time wrong"),
        (
            "crazyflie_log",
            {"vel_w": "m/s"},
            r"d\(pos_w\)/dt, vel_w: the second is 1\d\d\d times the first: one is in thousandths",
        ),
        (
            "crazyflie_log",
            {"rate_b": "deg/s"},
            r"rate of quat_wb, rate_b: the second is 0.01\d+ times .* degrees",
        ),
        (
            "crazyflie_log",
            {"quat_wb": "deg"},
            r"rate of quat_wb, rate_b: the second is [56]\d.* times .* degrees",
        ),
        (
            "crazyflie_pair_log",
            {"pos_w": "m", "payload_pos_w": "m"},
            "pos_w: .* millimetres taken for metres",
        ),
        (
            "crazyflie_pair_log",
            {"rate_b": "rad/s"},
            r"rate of quat_wb, rate_b: the second is [56]\d.* times .* degrees",
        ),
        (
            "slungload_log",
            {"pos_w": "mm", "payload_pos_w": "mm"},
            "no cable; millimetres taken for metres, or metres for",
        ),
    ],
)
def test_each_wrong_unit_is_named(name, units, message):
    assert re.search(message, problems(flight(name, **units)))


def swing(angle: float) -> list[Pose]:
    """A vehicle that swings to and fro, tilting as it must, its angles multiplied by a factor."""
    poses = []
    for i in range(600):
        t = 0.01 * i
        x, push = 0.5 * np.cos(3 * t), -0.5 * 9 * np.cos(3 * t)
        half = 0.5 * angle * np.arctan2(push, 9.81)
        poses.append(
            Pose(
                t,
                t,
                "vehicle",
                (float(x), 0.0, 1.0),
                (0.0, float(np.sin(half)), 0.0, float(np.cos(half))),
            )
        )
    return poses


def test_a_multirotor_tilts_where_it_accelerates():
    frames = flight("slungload_log").frames
    assert unit_problems(swing(1.0), frames) == []
    assert "times the first: one is in degrees" in unit_problems(swing(np.pi / 180), frames)[0]
    assert "degrees taken for radians" in unit_problems(swing(180 / np.pi), frames)[0]


def test_little_data_and_a_still_vehicle_say_nothing():
    frames = flight("slungload_log").frames
    rng = np.random.default_rng(0)
    still = [
        Pose(
            0.01 * i,
            0.01 * i,
            "vehicle",
            tuple(1e-3 * rng.standard_normal(3)),
            (0.0, 0.0, 0.0, 1.0),
        )
        for i in range(300)
    ]
    assert unit_problems(still, frames) == []
    assert unit_problems(still[:5], frames) == []
    assert unit_problems([], frames) == []


def test_a_recording_in_wrong_units_is_refused_unless_they_are_named(tmp_path, refused):
    params = flight("crazyflie_log", vel_w="m/s")
    with raises(
        SourceError,
        match=r"vel_w: the second is 1\d\d\d times .* \(source\.check_units=false lets it pass\)",
    ):
        open_source(params, tmp_path, MonotonicClock())
    lax = replace(params, source=replace(params.source, check_units=False))
    assert isinstance(open_source(lax, tmp_path, MonotonicClock())[2], ManualClock)
    wrong = 'source.columns=[{name="pos_w", columns=["t_s", "t_s", "acc"], unit="mm"}]'
    file = f"source.file={DATA / FLIGHTS['crazyflie_log']}"
    refused(
        f"hil check --config crazyflie_log --set {file} --set", wrong, message="no column 'acc'; "
    )


def test_a_run_recorded_with_another_form_of_mapping_replays(tmp_path, printed):
    """Runs of earlier versions name a body's columns, and a camera's log; replaying needs neither,
    the poses are recorded.
    """
    file, out = f"source.file={DATA / FLIGHTS['crazyflie_log']}", tmp_path / "run"
    assert (
        run_command(
            f"hil record --config crazyflie_log --set {file} --seconds 1 --bare --out {out}"
        )
        == 0
    )
    tree = tomllib.loads((out / "config.toml").read_text())
    assert "time" in tree["source"]
    tree["against"] = "none"
    tree["source"]["columns"] = [
        {"body": "vehicle", "pos": {"names": ["x", "y", "z"], "unit": "mm"}, "row_period": 0.01}
    ]
    del tree["source"]["time"]
    (out / "config.toml").write_text(toml_text.dumps(tree))
    assert "all bit for bit the same" in printed(f"hil replay {out}")
