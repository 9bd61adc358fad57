"""Throws that begin with a calibration in the hover: the errors of each camera are estimated and
corrected.
"""

import numpy as np
import torch
from pytest import mark, raises
from torch.testing import assert_close

from camera.keypoints import KeypointCamera, correct_keypoints, keypoints
from camera.mount import rotation_from_vector
from tests.configs import load_experiment, quiet
from visthrow.common.errors import ConfigError
from visthrow.task.measurement import hover_start
from visthrow.throws.calibrated import start_calibrated
from visthrow.training.env import ThrowEnv


def experiment(*changes):
    return load_experiment("vision", changes)


def test_corrected_keypoints_are_those_of_the_nominal_camera():
    torch.manual_seed(1)
    camera = KeypointCamera(experiment().camera)
    pos = torch.tensor([0.0, 0.0, 1.3]) + 0.1 * torch.randn(8, 3)
    rot, load = rotation_from_vector(0.2 * torch.randn(8, 3)), pos + torch.tensor([0.0, 0.0, -0.38])
    turn, scale = 0.05 * torch.randn(8, 3), 0.03 * torch.randn(8)
    goal = torch.randn(8, 3)
    nominal, _ = keypoints(camera, pos, rot, goal, load)
    observed, valid = keypoints(
        camera, pos, rot, goal, load, camera.extrinsics(turn, torch.zeros(8, 3))
    )
    got, left = correct_keypoints(
        camera, observed * (1.0 + scale[:, None, None]), valid, turn, scale
    )
    assert left.all()
    assert_close(got[:, :4], nominal[:, :4], rtol=0, atol=1e-4)
    assert_close(got[:, 4:], nominal[:, 4:], rtol=0, atol=5e-3)  # a box is upright in each image
    assert_close(got[:, 4:].mean(1), nominal[:, 4:].mean(1), rtol=0, atol=1e-3)


@mark.parametrize("change", ['task.observation.layout="state"', "task.target.speed=[0.1,0.2]"])
def test_what_cannot_be_calibrated_is_refused(change):
    with raises(ConfigError, match="calibration in hover"):
        start_calibrated(experiment(change))


def test_without_noise_nothing_of_the_vehicle_passes_for_the_camera():
    """Rotor drag, the motors' lag and unsteady thrust are in the sway: taken for the ball's motion
    they turned the pitch by 0.06 deg.
    """
    errors = ("camera.mount.rotation_error_std=0.05", "camera.noise.scale_std=0.03")
    flown = hover_start(quiet("vision_ideal", *errors))
    torch.manual_seed(0)
    with torch.inference_mode():
        env, calibrations = ThrowEnv(flown, "cpu", 0, 4), []
        env.fix_goal(torch.tensor([2.0, 0.0, 0.0]))
        start_calibrated(flown, calibrations)(env)
        turn, scale = (
            env.view.buffers["extrinsic_rotation"].numpy(),
            env.view.buffers["scale_error"].flatten().numpy(),
        )
    off = np.degrees([one.turn_b for one in calibrations]) - np.degrees(turn)
    assert np.abs(off.mean(0)).max() < 0.025
    assert np.abs(off).max() < 0.06
    assert np.abs(np.array([one.scale for one in calibrations]) - scale).max() < 1.5e-3
