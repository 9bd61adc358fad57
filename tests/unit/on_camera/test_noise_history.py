"""History ring and detector imperfections."""

import torch
from pytest import approx, mark

from camera.arrays import interpolate_at_latency
from camera.keypoint_noise import StepDraw, apply_latency, apply_noise
from camera.params import KeypointNoiseParams

SAMPLES = 20_000


def draw_step(environments, keypoints, generator):
    return StepDraw(
        torch.randn(environments, keypoints, 2, generator=generator),
        torch.rand(environments, keypoints, generator=generator),
    )


def test_latency_interpolates_between_whole_steps():
    history = torch.tensor([[0.0, 1.0, 4.0, 9.0]]).repeat(4, 1)
    latency = torch.tensor([0.0, 1.0, 1.25, 7.0])
    # 1 + 0.25 (4 - 1) = 1.75; beyond the history its oldest value.
    assert torch.allclose(
        interpolate_at_latency(history, latency), torch.tensor([0.0, 1.0, 1.75, 9.0])
    )
    assert torch.allclose(interpolate_at_latency(history, torch.tensor(2.5)), torch.full((4,), 6.5))


def test_latency_is_valid_only_where_all_that_it_used_was():
    points = torch.zeros(3, 3, 1, 2)
    valid = torch.tensor([[[True], [False], [True]]]).repeat(3, 1, 1)
    _, visible = apply_latency(points, valid, torch.tensor([0.0, 0.5, 2.0]))
    assert visible[:, 0].tolist() == [True, False, True]


def test_noise_has_the_stated_spread():
    params = KeypointNoiseParams(step_std=0.01, bias_std=0.002, drop_probability=0.2)
    generator = torch.Generator().manual_seed(0)
    bias = torch.randn(SAMPLES, 8, 2, generator=generator) * params.bias_std
    exact = torch.full((SAMPLES, 8, 2), 0.3)
    points, visible = apply_noise(
        params,
        exact,
        torch.ones(SAMPLES, 8, dtype=torch.bool),
        bias,
        draw_step(SAMPLES, 8, generator),
    )
    # 160,000 points: the spread is known to 0.2 %, the drop-out rate to 0.001 (one sigma); the
    # margins are five of them.
    assert points[visible].std() == approx((0.01**2 + 0.002**2) ** 0.5, rel=0.01)
    assert bias.std() == approx(0.002, rel=0.01)
    assert 1.0 - visible.float().mean() == approx(0.2, abs=0.005)
    assert (points[~visible] == 0.0).all()


@mark.parametrize(
    ("reads", "expected"), [("edge", [[0.6, 0.8], [0.0, 0.0]]), ("zero", [[0.0, 0.0], [0.0, 0.0]])]
)
def test_what_invalid_and_dropped_points_read(reads, expected):
    params = KeypointNoiseParams(step_std=0.01, drop_probability=0.5, invalid_reads=reads)
    exact = torch.tensor([[[0.6, 0.8], [0.1, 0.2], [0.1, 0.2]]])
    draw = StepDraw(torch.ones(1, 3, 2), torch.tensor([[0.9, 0.4, 0.5]]))
    points, visible = apply_noise(
        params, exact, torch.tensor([[False, True, True]]), torch.zeros(1, 3, 2), draw
    )
    assert visible.tolist() == [[False, False, True]]
    assert torch.allclose(points[0], torch.tensor([*expected, [0.11, 0.21]]))


def test_wrong_points_lie_anywhere_in_the_image_and_count_as_visible():
    params = KeypointNoiseParams(wrong_probability=0.25)
    generator = torch.Generator().manual_seed(1)
    wrong = torch.rand(SAMPLES, 8, 3, generator=generator)
    draw = draw_step(SAMPLES, 8, generator)._replace(wrong=wrong)
    exact, unseen = torch.full((SAMPLES, 8, 2), 0.3), torch.zeros(SAMPLES, 8, dtype=torch.bool)
    points, visible = apply_noise(params, exact, unseen, torch.zeros_like(exact), draw)
    assert visible.float().mean() == approx(0.25, abs=0.006)
    # Uniform in -1 to 1: mean 0, spread 1 / sqrt(3); 40,000 of them.
    assert points[visible].mean(0).abs().max() < 0.015
    assert points[visible].std(0) == approx([3**-0.5, 3**-0.5], rel=0.015)
