"""Located keypoints: the truth without noise, one wrong point outvoted, no estimate without points,
the goal remembered.
"""

from dataclasses import replace

import torch
from torch.testing import assert_close

from camera.keypoints import KeypointCamera, keypoints
from camera.mount import rotation_from_vector
from tests.configs import load_experiment
from visthrow.onboard import goal_motion
from visthrow.onboard import observations as ob
from visthrow.onboard.goal_motion import update_goal_fit

EXACT = 2e-3
"""Of float32 at 2 m, and of the box's middle, which is not quite the image of the ball's centre
[m], [-].
"""


def scene():
    """Layout, camera, a frame of noise-free keypoints of eight poses, their validity, goal -
    vehicle and lens - payload's ray.
    """
    params = load_experiment("laptop_vision")
    layout, camera = ob.layout_of(params.task.observation), KeypointCamera(params.camera)
    torch.manual_seed(1)
    pos = torch.tensor([0.0, 0.0, 1.3]) + 0.2 * torch.randn(8, 3)
    rot = rotation_from_vector(0.2 * torch.randn(8, 3))
    goal = torch.cat([torch.randn(8, 2), torch.zeros(8, 1)], -1)
    load = pos + torch.tensor([0.0, 0.0, -0.38]) + 0.08 * torch.randn(8, 3)
    points, valid = keypoints(camera, pos, rot, goal, load)
    frame = torch.cat(
        [ob.vehicle_part(pos, torch.zeros(8, 3), torch.zeros(8, 3), rot), points.flatten(1)], -1
    )
    ray = load - pos - (rot @ camera.position_b)
    return layout, camera, frame, valid, (goal - pos)[:, :2], ray / ray.norm(dim=-1, keepdim=True)


def places(layout, frame, valid, camera):
    """Of a throw's first frame."""
    begin = torch.zeros(len(frame)), torch.ones(len(frame), dtype=torch.bool)
    return update_goal_fit(
        layout, frame, valid, camera, goal_motion.empty_sums(len(frame)), *begin
    )[2]


def follow(layout, frames, valid, camera):
    """Estimates of the goal over the frames of a throw."""
    count = len(frames[0])
    sums, fresh = goal_motion.empty_sums(count), torch.ones(count, dtype=torch.bool)
    for k, frame in enumerate(frames):
        time = torch.full((count,), 0.02 * k)
        estimate = update_goal_fit(layout, frame, valid, camera, sums, time, fresh)
        sums, fresh = estimate.sums, torch.zeros_like(fresh)
        yield estimate


def test_the_goal_is_the_mean_of_a_throw_and_stays_known_out_of_view():
    layout, camera, frame, valid, offset, _ = scene()
    off = []
    frames = [frame + 0.01 * torch.randn_like(frame) for _ in range(40)]
    for noisy, estimate in zip(frames, follow(layout, frames, valid, camera)):
        located = estimate.places
        off.append((located[:, :2] + noisy[:, :2] - frame[:, :2] - offset).norm(dim=-1))
    fresh = torch.zeros(8, dtype=torch.bool)
    assert torch.stack(off[-5:]).mean() < 0.4 * torch.stack(off[:1]).mean()
    _, _, blind, shown, counts = update_goal_fit(
        layout, frame, torch.zeros_like(valid), camera, estimate.sums, torch.full((8,), 0.8), fresh
    )
    assert_close(blind[:, :2] + frame[:, :2], located[:, :2] + noisy[:, :2], rtol=0, atol=1e-5)
    assert (blind[:, 5] == 1.0).all()
    assert counts[:, :4].all(), "corners read where the goal would appear"
    assert not counts[:, 4:].any(), "the payload does not"
    assert_close(shown[:, 15:23], frame[:, 15:23], rtol=0, atol=0.02)


def test_a_goal_that_moves_is_where_it_is_now():
    layout, camera, frame, valid, offset, _ = scene()
    layout = replace(layout, motion=2)
    speed = torch.tensor([0.5, -0.3])
    frames = frame.repeat(
        60, 1, 1
    )  # the vehicle moves with the goal: its observations do not change
    frames[:, :, :2] += 0.02 * torch.arange(60.0)[:, None, None] * speed
    *_, (_, velocity, located, _, _) = follow(layout, frames, valid, camera)
    assert_close(velocity, speed.expand(8, 2), rtol=0, atol=0.02)
    assert_close(located[:, :2], offset, rtol=0, atol=0.02)


def test_without_noise_it_is_the_truth():
    layout, camera, frame, valid, offset, ray = scene()
    assert valid.all()
    located = places(layout, frame, valid, camera)
    assert_close(located[:, :2], offset, rtol=0, atol=2e-4)
    measured, _ = goal_motion.measure_goal(layout, frame, valid, camera)
    assert_close(measured, offset + frame[:, :2], rtol=0, atol=2e-4)
    assert_close(located[:, 2:5], ray, rtol=0, atol=EXACT)
    assert (located[:, 5] == 1.0).all()


def test_one_wrong_point_of_each_is_outvoted():
    layout, camera, frame, valid, offset, ray = scene()
    for wrong in (15, 16, 25, 26):  # of the first corner, of the box's second side
        frame[:, wrong] = 0.4
    located = places(layout, frame, valid, camera)
    assert (
        located[:, :2] - offset
    ).abs().max() < 0.05  # the square's corners disagree by the middle's neighbours
    assert (located[:, 2:5] - ray).norm(dim=-1).max() < 0.1  # half of the ball's angle


def test_what_is_not_visible_is_zero():
    layout, camera, frame, valid, _, ray = scene()
    valid = valid.clone()
    valid[:4, :4] = False
    valid[4:, 4:] = False
    located = places(layout, frame, valid, camera)
    assert located[:4, [0, 1, 5]].abs().max() == 0.0
    _, weight = goal_motion.measure_goal(layout, frame, valid, camera)
    assert (weight > 0.0).tolist() == [False] * 4 + [True] * 4
    assert located[4:, 2:5].abs().max() == 0.0
    assert (located[4:, 5] == 1.0).all()
    assert_close(located[:4, 2:5], ray[:4], rtol=0, atol=EXACT)
