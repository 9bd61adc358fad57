"""Imperfections of a keypoint detector: noise, per-episode bias, drop-out, latency, and what an
invalid point reads.

The randomness is an argument: the functions that apply it are pure, so that a CUDA graph can replay
them on refilled buffers and the HIL runner can pass zeros."""

from typing import NamedTuple

import torch
from torch import Tensor

from camera.arrays import at_latency, latency_weights
from camera.params import KeypointNoiseParams


class StepDraw(NamedTuple):
    """Randomness of one step: standard normals, shape (E, K, 2), and uniforms in [0, 1), shape (E,
    K).

    ``wrong``: uniforms of wrong points, shape (E, K, 3): whether, and where; None where there are
    none."""

    normals: Tensor
    uniforms: Tensor
    wrong: Tensor | None = None


def apply_noise(
    params: KeypointNoiseParams,
    keypoints: Tensor,
    valid: Tensor,
    bias: Tensor,
    draw: StepDraw,
) -> tuple[Tensor, Tensor]:
    """Add noise and bias, drop points out, and set what invalid points read.

    Args:
        params: Spreads and the rule for invalid points.
        keypoints: Exact keypoints [-], shape (E, K, 2), normalised; with ``invalid_reads = "edge"``
            clipped to the edge.
        valid: Shape (E, K), bool.
        bias: Of this episode [-], shape (E, K, 2).
        draw: Randomness of this step.

    Returns:
        What the detector reports [-], shape (E, K, 2), and its validity bits, shape (E, K).
    """
    noisy = keypoints + bias + draw.normals * params.step_std
    detected = draw.uniforms >= params.drop_probability
    visible = valid & detected
    # Clipped points carry no noise: they are a rule, not a measurement.
    if params.invalid_reads == "edge":
        unseen = keypoints * detected.unsqueeze(-1)
    else:
        unseen = torch.zeros_like(keypoints)
    points = torch.where(visible.unsqueeze(-1), noisy, unseen)
    if draw.wrong is None:
        return points, visible
    mistaken = draw.wrong[..., 0] < params.wrong_probability
    places = 2.0 * draw.wrong[..., 1:] - 1.0
    return torch.where(mistaken.unsqueeze(-1), places, points), visible | mistaken


def apply_latency(history: Tensor, valid_history: Tensor, latency: Tensor) -> tuple[Tensor, Tensor]:
    """Keypoints as they were ``latency`` steps ago.

    Args:
        history: Keypoints [-], shape (E, H, K, 2), newest first (`camera.arrays.push`).
        valid_history: Shape (E, H, K), bool.
        latency: Age [policy steps], shape (E,) or scalar tensor.

    Returns:
        Keypoints [-], shape (E, K, 2), and validity, shape (E, K): every entry that the
        interpolation used was valid.
    """
    used = latency_weights(history.shape[1], latency, history) > 0.0
    valid = (valid_history | ~used.unsqueeze(-1)).all(1)
    return at_latency(history, latency), valid
