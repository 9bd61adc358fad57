"""Plants, flights, the protocol on the reference plant, and the commands that fly and compare."""

import csv
import importlib.util
import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import torch
from numpy.linalg import norm
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, fixture, importorskip, mark, raises

from sim.params import GRAVITY
from tests.commands import run_command, run_python
from tests.configs import load_experiment
from visthrow import config
from visthrow.cli import compare
from visthrow.common.errors import ConfigError, MismatchError, PolicyError
from visthrow.common.rotations import rotate
from visthrow.logs.flightlog import STANDARD_CHANNELS, FlightLog
from visthrow.onboard.policy import Policy
from visthrow.task import contract_of, plant_of
from visthrow.task.measurement import Throws
from visthrow.throws import reference_protocol
from visthrow.throws.flight_loop import Flight
from visthrow.throws.loading import load_policy, unique_names
from visthrow.throws.loose_rope import LooseRope
from visthrow.throws.plants import HybridPlant, make_plant
from visthrow.throws.recorded import ThrowRecorder, fly
from visthrow.view.tables import csv_text, markdown

LINK_ERROR = 1e-5  # of a link's length [m]: Newton's last step
ENERGY_DRIFT = (
    0.02  # of a swinging rope in half a second: first-order velocity of Verlet steps of 1 ms
)
ROUNDED = 1e-5  # of places in single precision [m]
CHORD = 0.01  # of a slope over two periods [m/s]; that of the centre of mass is 0.13 off
JOIN = 2e-3  # [m]: what the ball moves at most between two samples beyond v dt, half g dt^2


def dropping_policy(name: str = "state", release: float = 1.0, overrides=()) -> Policy:
    """A policy that hovers with fixed thrust and requests the release at once."""
    experiment = load_experiment(name, overrides)
    contract = contract_of(experiment)
    weight = GRAVITY * plant_of(experiment).total_mass
    throttle = 2.0 * (weight / experiment.task.action.max_thrust) ** 0.5 - 1.0
    width = contract["observation"]["dimension"]
    bias = torch.tensor([throttle, 0.0, 0.0, 0.0, release])
    made_by = {"config": config.to_dict(experiment)}
    return Policy((torch.zeros(5, width),), (bias,), "relu", contract, made_by)


@fixture(scope="module")
def dropper(tmp_path_factory):
    path = tmp_path_factory.mktemp("policies") / "dropper.npz"
    dropping_policy().save(path)
    return path


@fixture(scope="module")
def flown(dropper) -> FlightLog:
    return fly(load_policy(dropper), [0.5, 0.1, 0.0])


def test_loose_rope_keeps_its_links_and_its_energy():
    rng = np.random.default_rng(0)
    links = np.column_stack((rng.normal(0, 0.3, 8), rng.normal(0, 0.3, 8), -np.ones(8)))
    links *= 0.03 / norm(links, axis=1, keepdims=True)
    points = np.vstack((np.zeros(3), np.cumsum(links, axis=0)))
    ball = points[-1] + links[-1]
    turn = np.cross([0.0, 6.0, 2.0], points - ball)  # a rigid turn stretches no link
    velocity = np.array([3.0, 0.0, 2.0])
    rope = LooseRope(points, velocity + turn, ball, velocity)
    energy = np.sum(rope.velocity_w**2)
    rope.fly(0.5)
    ends = rope.points_w(np.zeros(3))
    lengths = norm(np.diff(ends, axis=0), axis=1)
    assert np.abs(lengths - 0.03).max() < LINK_ERROR
    assert abs(np.sum(rope.velocity_w**2) / energy - 1.0) < ENERGY_DRIFT
    assert norm(ends[0] - (points[0] - ball)) > 0.1, "it must have turned"


def test_a_loose_rope_comes_to_rest_on_the_ground():
    points = np.column_stack((np.zeros(9), np.zeros(9), np.linspace(0.3, 0.07, 9)))
    ball = np.array([0.0, 0.0, 0.04])
    rope = LooseRope(points, np.tile([0.3, 0.0, -4.0], (9, 1)), ball, np.zeros(3))
    rope.sink(2.0, 0.003 - 0.04)
    height = rope.points_w(ball)[:-1, 2]
    assert 0.0 < height.min() <= height[0] < 0.02
    assert norm(rope.velocity_w, axis=1).max() < 0.2


def test_ball_and_rope_fly_on_from_the_hybrid_plants_release():
    experiment = load_experiment("state")
    plant = HybridPlant(experiment, 2)
    tilt = np.tile([0.5, 0.0, -0.866], (2, experiment.rope.segments, 1))
    plant.reset(np.tile([0.0, 0.0, 1.5], (2, 1)), tilt)
    hover = np.tile([2.668, 0.0, 0.0, 0.0], (2, 1))
    before = plant.state
    for _ in range(60):
        plant.step(hover, np.array([True, False]))
        now = plant.state
        expected = before.payload_pos_w + 0.02 * 0.5 * (before.payload_vel_w + now.payload_vel_w)
        airborne = ~plant.landing.landed
        assert np.abs(now.payload_pos_w - expected)[airborne].max() < JOIN
        gap = norm(now.cable_points_w[:, -1] - now.payload_pos_w, axis=1)
        assert np.abs(gap - experiment.rope.payload_offset).max() < JOIN
        before = now
    landing = plant.landing
    assert landing.landed.tolist() == [True, False]
    assert landing.separation_time[0] == approx(experiment.release.lag, abs=1e-6)
    assert_allclose(now.payload_pos_w[0], landing.point_w[0])
    assert landing.point_w[0, 2] == approx(experiment.release.landing_height, abs=1e-5)
    assert np.isnan(landing.time[1])
    assert now.attached.tolist() == [False, True]


def test_a_log_holds_the_origin_of_the_frame_wherever_the_centre_of_mass_lies(tmp_path):
    """The rope begins at its mount, which is stated from the origin, and moves with it."""
    aside = ["vehicle.body.com=[0.02,-0.01,0.005]", "rope.mount=[0.0,0.03,-0.02]"]
    path = tmp_path / "dropper.npz"
    dropping_policy(overrides=aside).save(path)
    log = fly(load_policy(path), [0.5, 0.1, 0.0])
    time, pos = log["pos_w"].samples()
    hangs = time < log.meta["times"]["separation"]
    quat, vel, points = (log[n].values for n in ("quat_wb", "vel_w", "cable_points_w"))
    mount = pos + rotate(quat, np.array([[0.0, 0.03, -0.02]]))
    assert np.abs(points[:, 0] - mount)[hangs].max() < ROUNDED
    off = np.abs(np.gradient(pos, time, axis=0) - vel)
    assert off[1:][hangs[1:]].max() < CHORD  # at its first end a slope is over one period


MEASURED_VECTORS = ("pos_w", "vel_w", "rate_b", "payload_pos_w")


def test_commands_of_the_hybrid_plant_have_the_tasks_bias():
    """Under a command of zero rates a vehicle turns at its bias."""
    experiment = load_experiment("state")
    quiet = replace(experiment.task.noise, command_bias=0.0, command_step=0.0)
    weight = GRAVITY * plant_of(experiment).total_mass
    still = replace(experiment.task.start, rate_deg=(0.0, 0.0, 0.0))
    spreads = []
    for bias in (0.0, 0.03):
        noise = replace(quiet, command_bias=bias)
        plant = HybridPlant(experiment, 400, noise=noise, start=still)
        for _ in range(15):
            plant.step(np.tile([weight, 0.0, 0.0, 0.0], (400, 1)))
        spreads.append(plant.state.rate_b[:, 2].std() / experiment.task.action.max_rate[2])
    assert spreads[0] < 0.005
    assert spreads[1] == approx(0.03, rel=0.15)


def test_measurements_of_the_hybrid_plant_have_the_tasks_noise():
    experiment = load_experiment("state")
    plant = make_plant("hybrid", experiment, 400)
    truth, measured = (
        plant.state,
        plant.measure(),
    )  # right after a reset nothing has moved yet, so nothing is late
    for name in MEASURED_VECTORS:
        spread = (getattr(measured, name) - getattr(truth, name)).std()
        assert spread == approx(experiment.task.noise.observation_step, rel=0.1)
    errors = [(getattr(measured, name) - getattr(truth, name)).ravel() for name in MEASURED_VECTORS]
    assert_allclose(np.corrcoef(errors), np.eye(4), atol=0.15)
    assert_allclose(norm(measured.quat_wb, axis=1), 1.0)
    angle = 2.0 * norm(measured.quat_wb[:, :3], axis=1)
    assert angle.mean() == approx(
        1.6 * 0.01, rel=0.1
    )  # mean length of three normal deviates: 1.596
    with raises(ConfigError, match="did you mean 'hybrid'"):
        make_plant("hybird", experiment)


def test_measurements_of_the_hybrid_plant_are_late():
    experiment = load_experiment("state")
    plant = HybridPlant(experiment, 2, latency=(0.01, 0.01))
    for _ in range(5):
        before = plant.state
        plant.step(np.tile([8.0, 2.0, 0.0, 0.0], (2, 1)))
    now, measured = plant.state, plant.measure()
    for name in MEASURED_VECTORS:
        middle = 0.5 * (getattr(before, name) + getattr(now, name))
        assert_allclose(getattr(measured, name), middle, atol=1e-12)
    assert_array_equal(
        HybridPlant(experiment, 2).measure().pos_w, HybridPlant(experiment, 2).state.pos_w
    )


def test_a_flight_goes_from_hover_to_hover(flown):
    times, result = flown.meta["times"], flown.meta["result"]
    assert result["success"]
    assert result["hovering_again"]
    assert times["latch"] == approx(times["policy_start"])
    assert times["separation"] - times["latch"] == approx(0.11, abs=1e-6)
    assert result["error"] == approx(np.hypot(*(np.array(result["landing_w"][:2]) - [0.5, 0.1])))
    fall = np.sqrt(2 * (flown["separation"].values[0, 2] - 0.04) / 9.81)
    assert result["duration"] == approx(times["landing"] - times["policy_start"])
    assert times["landing"] - times["separation"] == approx(fall, abs=0.05), (
        "it is dropped, nearly at rest"
    )
    of_others = {"flying", "neighbour_pos_w"}  # from an autopilot, or another vehicle's log
    assert set(STANDARD_CHANNELS) - of_others <= set(flown.channels)
    assert "measured_pos_w" in flown


def test_a_rope_keeps_its_speed_when_the_ball_lands():
    """A rope that stands on the ball and tips over goes on tipping for 10 ms."""
    recording, height = ThrowRecorder(None, {}), np.linspace(0.5, 0.1, 5)
    upright, leaning = (
        np.column_stack((lean * height, 0.0 * height, height)) for lean in (0, 0.02)
    )
    ball = np.array([[0.0, 0.0, 0.04]])
    recording._before = SimpleNamespace(time=1.0, cable_points_w=upright[None])
    now = SimpleNamespace(time=1.03, cable_points_w=leaning[None], payload_pos_w=ball)
    landing = SimpleNamespace(landed=[True], time=[1.02])
    plant = SimpleNamespace(landing=landing, period=0.02)
    moved = recording._rope(SimpleNamespace(now=now, plant=plant)) - leaning
    assert_allclose(moved[:-1, 0], 0.01 * height[:-1], rtol=0.15)


def test_a_flights_modes_and_commands(flown):
    times = flown.meta["times"]
    mode = flown["mode"]
    flying = (mode.time >= times["policy_start"] - 1e-9) & (mode.time < times["recovery"] - 1e-9)
    assert_array_equal(mode.values == 1, flying)
    assert len(flown["action"].time) == np.count_nonzero(flying)
    assert flown["command"].time[0] == 0.0
    assert np.abs(flown["pos_w"].values[-1] - [0, 0, 1.333]).max() < 0.1
    heights = flown["cable_points_w"].values[-1][:, 2]
    assert heights.max() < 0.03, "the rope lies on the ground at last"


def test_a_flight_without_release_fails_and_recovers(tmp_path):
    path, out = tmp_path / "holder.npz", tmp_path / "out"
    dropping_policy(release=-1.0, overrides=["task.bounds.time_limit=0.3"]).save(path)
    assert run_command(f"fly --policy {path} --target 1.0 --out {out}") == 1
    log = FlightLog.load(out / "flight.npz")
    assert not log.meta["result"]["success"]
    assert "no release within 0.3 s" in log.meta["result"]["failure"]
    assert "landing" not in log
    assert bool(log["attached"].values[-1])


def test_fly_writes_its_files(dropper, tmp_path, printed):
    out = tmp_path / "out"
    command = f"fly --policy {dropper} --target 0.5 0.3 --seed 4 --out {out} --json {out}/r.json"
    saved = f"--save {tmp_path}/saved.npz --export {tmp_path}/flight.csv"
    output = printed(f"{command} {saved}")
    assert "landing at x" in output
    assert {p.name for p in out.iterdir()} == {"flight.npz", "throw.rrd", "throw.png", "r.json"}
    figures = json.loads((out / "r.json").read_text())
    result = figures["result"]
    assert (figures["goal_w"], figures["seed"]) == ([0.5, 0.3, 0.0], 4)
    assert load_policy(tmp_path / "saved.npz").policy.obs_dim == load_policy(dropper).policy.obs_dim
    assert "pos_w" in (tmp_path / "flight.csv").read_text().splitlines()[0]
    assert f"{result['error']:.3f} m from the target" in output
    verified = run_python("-m", "rerun", "rrd", "verify", out / "throw.rrd")
    assert verified.returncode == 0, verified.stderr


def test_compare_flies_the_state_and_the_vision_policy_unless_others_are_named(monkeypatch):
    loaded = []

    def load(name, *args):
        loaded.append(name)
        if name != "state":
            raise ConfigError("enough")

    monkeypatch.setattr("visthrow.throws.loading.load_policy", load)
    assert run_command("compare") == run_command("compare vision_located") == 2
    assert loaded == ["state", "vision", "vision_located"]


def test_compare_prints_and_writes(dropper, tmp_path, printed):
    out = tmp_path / "out"
    command = f"compare {dropper} --targets 0.5 1.0 --throws 5 --out {out} --json {out}/c.json"
    output = printed(f"{command} --device cpu --seed 3")
    assert "`hybrid`, seed 3" in output
    assert "No vehicle was flown" in output
    rows = list(csv.DictReader((out / "compare-hybrid.csv").open()))
    assert len(rows) == 10
    assert {row["plant"] for row in rows} == {"hybrid"}
    first = [float(row["landing error [m]"]) for row in rows[:5]]
    summary = json.loads((out / "c.json").read_text())["rows"][0]
    assert summary["error_mean"] == approx(np.mean(first), rel=1e-4)
    assert f"{summary['error_mean']:.3f} ± {summary['error_std']:.3f}" in output
    assert (out / "compare-hybrid.png").read_bytes()[:4] == b"\x89PNG"


def test_a_policy_that_is_compared_with_itself_is_numbered(dropper):
    assert unique_names([load_policy(dropper)] * 2) == ["dropper 1", "dropper 2"]


def test_compare_throws_under_the_conditions_of_its_options(
    dropper, tmp_path, refused, monkeypatch
):
    def throw(loaded, *conditions):
        raise ConfigError(f"thrown {len(loaded)} {conditions}")

    monkeypatch.setattr("visthrow.cli.compare.throw_hybrid", throw)
    options = f"--targets 0.5 1 --throws 7 --seed 3 --device cpu --calibrate --out {tmp_path}"
    refused(
        f"compare {dropper} {dropper} {options}", message="thrown 2 ([0.5, 1.0], 7, 'cpu', 3, True)"
    )


def test_protocol_on_the_reference_plant(tmp_path, monkeypatch):
    """A drop from hover lands below the hover point, so far from the target as that is; in parts or
    as a whole.
    """
    importorskip("mujoco")
    monkeypatch.setattr(reference_protocol, "HOVER_TIME", 0.1)
    dropping_policy(overrides=["rope.segments=2"]).save(tmp_path / "dropper.npz")
    loaded = load_policy(tmp_path / "dropper.npz")
    got = reference_protocol.fly_batch(
        [loaded], "reference-realistic", reference_protocol.Job((0,), 1.0, 0, 2, 7)
    )
    assert got["success"].all()
    assert np.abs(got["landing_w"]).max() < 0.25
    assert_allclose(got["error"], norm(got["landing_w"] - [1.0, 0.0], axis=1))
    assert np.all((got["duration"] > 0.4) & (got["duration"] < 0.7))
    assert np.all(got["clearance"] > 0.2)
    assert np.all(got["smoothness"] < 0.6), (
        "one jump of the release does not count, the four commands stand still"
    )
    assert np.ptp(got["landing_w"][:, 0]) > 0.0


def test_demo_without_mujoco(tmp_path, monkeypatch, printed):
    monkeypatch.setattr("visthrow.onboard.shipped.SHIPPED", tmp_path)
    for name in compare.DEFAULT_POLICIES:
        dropping_policy(name).save(tmp_path / f"{name}.npz")
    find = importlib.util.find_spec
    monkeypatch.setattr(
        "importlib.util.find_spec",
        lambda name, *parent: None if name == "mujoco" else find(name, *parent),
    )
    output = printed(f"demo --throws 3 --out {tmp_path}/out")
    assert "needs MuJoCo" in output
    listed = [
        line.strip() for line in output.partition("Files:")[2].splitlines() if line.startswith("  ")
    ]
    assert sorted(listed) == sorted(str(path) for path in (tmp_path / "out").iterdir())
    assert len(listed) == 6


def test_failures_name_their_cause():
    experiment = load_experiment("state")
    plant = HybridPlant(experiment, 5)
    flight = Flight(plant, SimpleNamespace(experiment=experiment))
    flight.begin = plant.time - 0.1
    now = plant.state
    pos = now.pos_w.copy()
    pos[1, 2], pos[2, 0] = 3.5, 3.5
    payload = now.payload_pos_w.copy()
    payload[2, 0], payload[3] = 3.5, pos[3] + [0, 0, 0.05]
    quat = now.quat_wb.copy()
    quat[4] = [1.0, 0.0, 0.0, 0.0]
    now = replace(now, pos_w=pos, payload_pos_w=payload, quat_wb=quat)
    flight.flown[:] = True
    latched = replace(now, latched=np.ones(5, bool))
    flight.judge(latched)
    assert flight.failures[4] is None
    flight.judge(now)
    assert flight.failures[0] is None
    for message, cause in zip(
        flight.failures[1:], ("altitude", "further than", "hit", "tilted"), strict=True
    ):
        assert cause in message
    assert flight.open.tolist() == [True, False, False, False, False]
    assert flight.failed.tolist() == [False, True, True, True, True]


def throws(error: float, success: int = 4) -> Throws:
    good = np.arange(4) < success
    blank = np.where(good, 1.0, np.nan)
    landing = np.column_stack((np.full(4, 2.0 + error), np.zeros(4))) * blank[:, None]
    return Throws(2.0, good, landing, error * blank, 1.1 * blank, 0.4 * blank, 0.3 * blank)


def test_table_says_success_rate_and_leaves_failures_blank():
    rows = [
        {"policy": n, "layout": "state", **throws(0.1, s).summary()}
        for n, s in (("a", 4), ("b", 3), ("c", 0))
    ]
    text = markdown(rows, "title")
    lines = text.splitlines()
    assert len({len(line) for line in lines[2:]}) == 1, "columns line up"
    assert "75.0 %" in lines[5]
    assert "0.100 ± 0.000" in lines[5]
    assert "0.105 ± 0.099" in lines[4], "the paper's figure beside ours"
    assert "0.0 %" in lines[6]
    assert "nan" not in text
    assert csv_text([("b", "hybrid", throws(0.1, 3))]).splitlines()[-1] == "b,hybrid,2.0,3,0,,,,,,"


@mark.parametrize(
    ("words", "message"),
    [
        ("fly --policy visoin", "no policy 'visoin'"),
        ("fly --policy DROPPER --target 7", "the goal is 7 m away"),
        ("fly --policy DROPPER --target nan", "three finite numbers"),
        ("fly --policy DROPPER --target 1 2 3", "a distance, or x and y"),
        ("fly --policy DROPPER --plant real", "no plant 'real'"),
        ("fly --policy DROPPER --config vision", "trained under other conditions"),
        (
            "fly --policy DROPPER --set release.lag=0.2",
            "release.lag: trained with 0.11, here 0.2",
        ),
        ("compare DROPPER --targets 1 1", "twice"),
        ("compare DROPPER --plant real", "no plant 'real'"),
        (
            "compare DROPPER --calibrate --plant reference --throws 1",
            "--calibrate on plant",
        ),
    ],
)
def test_bad_input_is_refused_in_one_line(words, message, dropper, tmp_path, refused):
    refused(f"{words.replace('DROPPER', str(dropper))} --out {tmp_path}/out", message=message)
    assert not (tmp_path / "out").exists()


@mark.parametrize("command", ["fly --policy", "compare"])
def test_a_folder_that_cannot_be_made_is_refused_before_the_work(
    command, dropper, tmp_path, refused, monkeypatch
):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setattr("sim.hybrid.HybridSim.step", None)  # nothing may fly
    refused(f"{command} {dropper} --out {tmp_path}/file/out", message="cannot make the folder")


def test_a_policy_without_its_config_asks_for_one(tmp_path):
    policy = replace(dropping_policy(), made_by={})
    policy.save(tmp_path / "bare.npz")
    with raises(PolicyError, match="--config"):
        load_policy(tmp_path / "bare.npz")
    assert load_policy(tmp_path / "bare.npz", "state").experiment.task.observation.layout == "state"
    with raises(MismatchError):
        load_policy(tmp_path / "bare.npz", "state", ["vehicle.body.mass=0.3"])


def test_throws_are_within_an_error_only_where_nearly_all_land():
    error = np.full(100, 0.1)
    for failures, within in ((5, True), (6, False)):
        success = np.arange(100) >= failures
        throws = Throws(1.5, success, np.zeros((100, 2)), error, error, error, error)
        assert throws.land_within(0.11) is within
        assert not throws.land_within(0.09)
