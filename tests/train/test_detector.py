"""`visthrow detector`: a training of two steps, resumed; keypoints from rendered pictures in a
flight; what is refused.
"""

from types import SimpleNamespace

import cv2
import numpy as np
import torch
from numpy.linalg import norm
from pytest import mark

from camera.detectors.learnt import Networks
from camera.keypoints import KeypointCamera, keypoints
from tests.commands import run_command, set_words
from visthrow.cli.fly import _make_rendered_eyes
from visthrow.detector_training.eyes import RenderedEyes
from visthrow.detector_training.scenes.scene import Nuisances
from visthrow.task import load_experiment
from visthrow.throws.flight_loop import Flight, Policies, hover, throw
from visthrow.throws.loading import load_policy
from visthrow.throws.reference_protocol import Job, batch_plant, fly_batch, place_in_hover

SMALL = ["fresh=2", "pool=4", "reuse=1", "batch=2", "patches=8", "samples=1", "calibration=2"]
NEAR = {"contours": 0.01, "learnt": 0.015}
"""Errors of detected keypoints on a clean picture from their projections [-]: 3 and 5 px of 320."""


def train(folder, *words: str) -> int:
    return run_command(f"detector train --out {folder} --device cpu", *set_words(SMALL), *words)


def test_a_training_is_resumed_and_leaves_weights(tmp_path, capsys):
    folder = tmp_path / "run"
    assert train(folder, "--set", "steps=2", "--minutes", "1e-9") == 0
    assert "stopped at step 0" in capsys.readouterr().out
    assert train(folder, "--set", "steps=2") == 2
    assert "continue with --resume" in capsys.readouterr().err
    assert train(folder, "--set", "steps=2", "--resume") == 0
    assert "trained at step 2" in capsys.readouterr().out
    made = Networks.load(folder / "learnt.npz")
    assert made.made_by["steps"] == 2
    assert made.made_by["config"]["batch"] == 2
    assert (folder / "learnt.npz").stat().st_size < 500_000
    (folder / "checkpoint.pt").write_bytes(b"broken")
    assert train(folder, "--set", "steps=2", "--resume") == 2
    assert "not a checkpoint of this training" in capsys.readouterr().err
    assert train(tmp_path / "none", "--resume") == 2
    assert "no checkpoint to resume from" in capsys.readouterr().err


def hang_in_view():
    """A vehicle whose payload and goal are in view, and the goal."""
    zero = np.zeros((1, 3))
    now = SimpleNamespace(
        pos_w=np.array([[0.0, 0.0, 1.3]]),
        quat_wb=np.array([[0.0, 0.1, 0.0, 0.995]]),
        vel_w=zero,
        rate_b=zero,
        payload_pos_w=np.array([[0.05, -0.03, 0.93]]),
        payload_vel_w=zero,
        time=0.0,
    )
    return now, np.array([[1.0, 0.2, 0.0]])


@mark.parametrize("by", sorted(NEAR))
def test_keypoints_of_a_picture_are_those_that_poses_project_to(by):
    plain = load_experiment("state")
    eyes = RenderedEyes(
        plain.camera,
        plain.rope,
        1,
        3,
        method=by,
        nuisances=Nuisances(*(0.0,) * 8),
        keep=True,
    )
    now, goal = hang_in_view()
    points, valid = eyes.look(now, now, goal, np.array([True]))
    pilot = KeypointCamera(plain.camera, dtype=torch.float64)
    quat = torch.tensor(now.quat_wb / norm(now.quat_wb))
    from visthrow.onboard.observations import rotation_from_quat

    tensors = (
        torch.tensor(now.pos_w),
        rotation_from_quat(quat),
        torch.tensor(goal),
        torch.tensor(now.payload_pos_w),
    )
    true, _ = keypoints(pilot, *tensors)
    assert valid.all()
    assert np.abs(points - true.numpy()).max() < NEAR[by]
    assert eyes.found == {"ball": 1, "goal": 1, "frames": 1, "refused": 0}


def test_fly_draws_the_pictures_that_its_eyes_saw(tmp_path):
    loaded = load_policy("vision")
    eyes, (now, goal) = _make_rendered_eyes(loaded, "contours", 3), hang_in_view()
    eyes.look(now, now, goal, np.array([True]))
    sheet = cv2.imread(str(eyes.sheet(tmp_path / "pixels.png")))
    lens = loaded.experiment.camera.fisheye
    assert sheet.shape == (2 * lens.height, 3 * lens.width, 3)
    assert len(np.unique(sheet)) > 100


class Blind:
    """A detector that finds nothing, and reports so for some vehicles; counts its calls."""

    def __init__(self, lost=None) -> None:
        self.looks, self.last_keypoints, self._lost = 0, None, lost or {}

    def find_lost(self):
        return self._lost

    def look(self, now, measured, goal_w, carried):
        self.looks += 1
        assert now.pos_w.shape == measured.pos_w.shape == goal_w.shape
        self.last_keypoints = (
            np.zeros((len(goal_w), 8, 2), np.float32),
            np.zeros((len(goal_w), 8), bool),
        )
        return self.last_keypoints


def test_a_throw_flies_on_what_its_eyes_see_alone():
    """With a detector that finds nothing no throw comes near the goal; without one the same throws
    do.
    """
    loaded, job = load_policy("vision"), Job((0,), 2.0, 0, 2, 0)
    blind = Blind()
    without, seeing = fly_batch([loaded], "hybrid", job, blind), fly_batch([loaded], "hybrid", job)
    assert blind.looks > 20
    assert seeing["success"].all()
    assert seeing["error"].max() < 0.2
    assert not (without["success"] & (without["error"] < 0.5)).any()


@mark.parametrize("name", ["ball", "goal"])
def test_a_throw_is_refused_where_the_hover_does_not_see(name):
    loaded = load_policy("vision")
    plant, rng = batch_plant(loaded.experiment, "hybrid", 2.0, 0, 2, 0)
    home = place_in_hover(plant, loaded.experiment, rng)
    pilots = Policies([loaded], np.tile([2.0, 0.0, 0.0], (2, 1)), eyes=Blind({0: name}))
    flight = Flight(plant, pilots, home_w=home)
    flight.run([hover(0.5), throw(0.2)])
    assert flight.failures == [f"refused: the {name} is not seen in the hover", None]
    assert flight.open.tolist() == [False, True]
    off = norm(plant.state.pos_w - home, axis=1)
    assert off[0] < 0.3, "it hovers on"


@mark.parametrize(
    ("words", "message"),
    [
        (["throw", "--policy", "state"], "a vision policy"),
        (["throw", "--plant", "hal"], "no plant 'hal'"),
        (["train", "nothing"], "no detector config 'nothing'"),
    ],
)
def test_what_cannot_be_done_is_refused(refused, words, message):
    refused("detector", *words, message=message)
