"""The programs under examples/ run, in small."""

import runpy
import sys

import cv2
import numpy as np
import torch
from pytest import approx, mark, raises

from camera.fisheye import Fisheye
from camera.params import CameraParams
from hil.poses.sources import images
from tests import boards
from tests.places import DATA, ROOT
from visthrow import config
from visthrow.task import load_experiment, rewards
from visthrow.training import trainer

BALLS = DATA / "real" / "jugglebot_throws" / "session7.csv.gz"
SWING = DATA / "real" / "pendulum_single" / "single_pendulum_id.csv.gz"
FAULTS = DATA / "real" / "crazypad_faults"
VIEWS = DATA / "slungload_camera"
LONGEST = 60
"""Lines of a program."""

RUNS = {
    "train_mine": ("--minutes 1e-6 --environments 8 --out mine", "throws landed"),
    "compare_plants": ("state --throws 1 --plants hybrid", "hybrid     state"),
    "project_poses": ("--seconds 0.1 --port 14777", ""),
    "diagnose_csv": (f"{BALLS} --tracks 1", "tracks, 1 used"),
    "add_effect": ("--size 0.02", "the ball moves by"),
    "add_source": ("--seconds 0.5", "the policy's command is"),
    "fly_keypoints": ("", "thrust [N]"),
    "step_simulator": ("--count 2 --seconds 0.1", "the first ball at"),
    "pendulum/diagnose_swing": (f"{SWING}", "FOUND  dry friction"),
    "gimbal/diagnose_gimbal": (
        f"{VIEWS}/rosbag_16.csv.gz {VIEWS}/rosbag_17.csv.gz --test {VIEWS}/rosbag_17.csv.gz",
        "tested, marker_pos_c",
    ),
    "trim/diagnose_trim": (
        f"{FAULTS}/cut_propeller_M3_2.5mm_2.5mm_42mm__E8_log00.csv.gz --fit",
        "motor_rl = -0.3",
    ),
}
"""Program -> its arguments, and what it prints."""


def run(name: str, words: str, monkeypatch) -> None:
    program = ROOT / "examples" / f"{name}.py"
    monkeypatch.setattr(sys, "argv", [name, *words.split()])
    monkeypatch.syspath_prepend(program.parent)  # as Python does for a program that is a file
    runpy.run_path(str(program), run_name="__main__")


@mark.parametrize("name", RUNS)
def test_an_example_runs(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(trainer, "EVALUATED", 4)
    words, text = RUNS[name]
    run(name, words, monkeypatch)
    assert text in capsys.readouterr().out


def test_poses_are_projected_as_a_picture_shows_them(tmp_path, monkeypatch, capsys):
    """Its source is replaced by one whose vehicle sees the whole square of its goal."""
    program = runpy.run_path(str(ROOT / "examples" / "add_source.py"))
    still = program["Still"]()
    monkeypatch.setattr("hil.poses.sources.open_source.open_source", lambda *_: (still, None, None))
    run("project_poses", "--config ros2 --seconds 0.05", monkeypatch)
    assert "[True, True, True, True" in capsys.readouterr().out


def test_a_camera_is_calibrated(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for i, picture in enumerate(boards.pictures("chessboard")):
        cv2.imwrite(f"{i}.png", picture)
    words = (
        f"{' '.join(map(str, sorted(tmp_path.glob('*.png'))))} --columns 7 --rows 5 --square 0.04"
    )
    run("calibrate_camera", words, monkeypatch)
    made = config.load(CameraParams, tmp_path / "my_camera.toml").fisheye
    assert made.fx == approx(boards.LENS.fx, rel=0.01)


def test_a_flight_is_exported(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    run("fly_mine", "state --target 1.5", monkeypatch)
    assert "landed 0." in capsys.readouterr().out
    run("export_flight", "flight.npz --to flight.csv", monkeypatch)
    assert "payload_pos_w" in (tmp_path / "flight.csv").read_text().splitlines()[0]


def test_a_reward_term_is_trained_with(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(rewards, "kinetic", rewards.kinetic)
    monkeypatch.setattr(trainer, "EVALUATED", 4)
    with raises(SystemExit, match="0"):
        run(
            "add_reward",
            "train laptop --iterations 1 --set ppo.environments=8 --out calmer --device cpu",
            monkeypatch,
        )
    assert rewards.kinetic.__name__ == "calmer"
    assert (tmp_path / "calmer" / "policy.npz").exists()


def test_a_detector_finds_what_its_network_says(monkeypatch):
    monkeypatch.setattr(images, "DETECTORS", dict(images.DETECTORS))
    program = runpy.run_path(str(ROOT / "examples" / "add_detector.py"))
    camera = load_experiment("state").camera
    picture = np.zeros((camera.fisheye.height, camera.fisheye.width, 3), np.uint8)
    lens = Fisheye(camera.fisheye)
    detected = images.DETECTORS["mine"](lens, camera.payload_radius, camera.goal_side).detect(
        picture
    )
    left, right = program["network"](picture)[1][::2]
    (u, _), _ = lens.project(torch.tensor(detected.ball.ray_c))
    assert float(u) == approx((left + right) / 2, abs=0.5)
    assert detected.goal.rays_c.shape == (4, 3)


def test_every_example_is_short_and_run():
    """A model may stand beside its program, in a folder of the two."""
    examples = ROOT / "examples"
    paths = [p for p in examples.rglob("*.py") if not p.stem.endswith("_model")]
    programs = {path.relative_to(examples).with_suffix("").as_posix(): path for path in paths}
    assert set(programs) == {
        *RUNS,
        "calibrate_camera",
        "export_flight",
        "fly_mine",
        "add_detector",
        "add_reward",
    }
    for name, path in programs.items():
        assert len(path.read_text().splitlines()) <= LONGEST, name
    for model in examples.rglob("*_model.py"):
        assert any(program.parent == model.parent for program in programs.values())
        assert model.parent != examples
