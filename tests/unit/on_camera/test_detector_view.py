"""A detector's view with one error at a time, against numbers worked by hand."""

from dataclasses import replace

import torch
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx

from camera.keypoint_noise import DetectorView
from tests.configs import load_experiment
from tests.episodes import COUNT, FRESH, LIKE, OLD


def view_of(mount: dict | None = None, **noise) -> DetectorView:
    """A detector without errors but those that are named."""
    camera = load_experiment("vision_ideal").camera
    exact = {name: 0.0 for name in ("step_std", "bias_std", "scale_std", "latency")}
    exact |= {"drop_probability": 0.0, "wrong_probability": 0.0, "held_probability": 0.0}
    errors = {"rotation_error_std": 0.0, "position_error_std": 0.0} | (mount or {})
    camera = replace(
        camera,
        noise=replace(camera.noise, **exact | noise),
        mount=replace(camera.mount, **errors),
    )
    torch.manual_seed(3)
    view = DetectorView(camera, LIKE)
    view.begin(FRESH)
    return view


def look(view: DetectorView, goal_x=0.5, fresh=OLD, up=1.0):
    """Look from 1.5 m at a goal on the ground and a payload in between; ``up`` -1: upside down."""
    rot_wb = torch.diag(torch.tensor([1.0, up, up])).expand(COUNT, 3, 3)
    pos_w = torch.tensor([0.0, 0.0, 1.5]).expand(COUNT, 3)
    goal_w = torch.tensor([goal_x, 0.0, 0.0]).expand(COUNT, 3)
    payload_w = torch.tensor([0.05, 0.0, 1.0]).expand(COUNT, 3)
    return view.look(pos_w, rot_wb, goal_w, payload_w, fresh)


def test_an_error_of_the_focal_length_scales_all_keypoints_of_an_episode():
    exact, _ = look(view_of())
    points, _ = look(view_of(scale_std=0.05))
    ratio = points.norm(dim=-1) / exact.norm(dim=-1)
    assert_allclose(ratio.std(1).numpy(), 0.0, atol=1e-5)
    assert float(ratio[:, 0].std()) == approx(0.05, rel=0.05)


def test_mounts_are_off_by_the_configured_angles_and_lengths():
    view = view_of({"rotation_error_std": 0.02, "position_error_std": 0.005})
    assert float(view.buffers["extrinsic_rotation"].std()) == approx(0.02, rel=0.05)
    assert float(view.buffers["extrinsic_offset"].std()) == approx(0.005, rel=0.05)


def test_keypoints_beyond_the_radius_that_a_detector_sees_are_invalid():
    points, valid = look(view_of())
    assert bool(valid.all())
    radius = points.norm(dim=-1)[0]
    middle = float(radius.sort().values[3:5].mean())
    _, valid = look(view_of(visible_radius=middle))
    assert_array_equal(valid[0].numpy(), (radius <= middle).numpy())


def test_an_image_is_repeated_but_never_that_of_another_episode():
    view = view_of(held_probability=0.999999)
    first, _ = look(view, 0.5, FRESH)
    repeated, _ = look(view, 0.8)
    assert_array_equal(repeated.numpy(), first.numpy())
    new, _ = look(view, 0.8, FRESH)
    assert float((new - first)[:, :4].abs().min(1).values.mean()) > 0.01


def test_what_was_not_in_an_old_image_is_invalid_as_late_as_the_keypoints_are():
    view = view_of(latency=1.0)
    _, valid = look(view, 0.5, FRESH)
    assert bool(valid[:, :4].all())
    _, valid = look(view, up=-1.0)
    assert bool(valid[:, :4].all()), "the vehicle has just turned over: an image later it is seen"
    _, valid = look(view, up=-1.0)
    assert not bool(valid[:, :4].any())
