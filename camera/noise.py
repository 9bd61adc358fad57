"""Imperfections of a keypoint detector: noise, per-episode bias, drop-out, latency, and what an invalid point reads.

The randomness is an argument: the functions that apply it are pure, so that a CUDA graph can replay them on refilled buffers and the
HIL runner can pass zeros.
"""

from typing import NamedTuple

import torch

from camera.history import at_latency, latency_weights
from camera.params import KeypointNoiseParams


class StepDraw(NamedTuple):
    """Randomness of one step: standard normals, shape (E, K, 2), and uniforms in [0, 1), shape (E, K).

    ``wrong``: uniforms of wrong points, shape (E, K, 3): whether, and where; None where there are none.
    """

    normals: torch.Tensor
    uniforms: torch.Tensor
    wrong: torch.Tensor | None = None


def apply_noise(
    params: KeypointNoiseParams, keypoints: torch.Tensor, valid: torch.Tensor, bias: torch.Tensor, draw: StepDraw
) -> tuple[torch.Tensor, torch.Tensor]:
    """Add noise and bias, drop points out, and set what invalid points read: what the detector reports, and its validity bits.

    Keypoints, exact and normalised [-], with ``invalid_reads = "edge"`` clipped to the edge, and the episode's bias have shape (E, K,
    2), validity (E, K).
    """
    noisy = keypoints + bias + draw.normals * params.step_std
    kept = draw.uniforms >= params.drop_probability
    seen = valid & kept
    # Clipped points carry no noise: they are a rule, not a measurement.
    unseen = keypoints * kept.unsqueeze(-1) if params.invalid_reads == "edge" else torch.zeros_like(keypoints)
    points = torch.where(seen.unsqueeze(-1), noisy, unseen)
    if draw.wrong is None:
        return points, seen
    mistaken = draw.wrong[..., 0] < params.wrong_probability
    return torch.where(mistaken.unsqueeze(-1), 2.0 * draw.wrong[..., 1:] - 1.0, points), seen | mistaken


def apply_latency(history: torch.Tensor, valid_history: torch.Tensor, latency: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Keypoints as they were ``latency`` policy steps ago, shape (E, K, 2): valid where every entry that was used was.

    Histories are newest first (`camera.history.push`), shapes (E, H, K, 2) and (E, H, K); the latency has shape (E,) or is a scalar
    tensor.
    """
    used = latency_weights(history.shape[1], latency, history) > 0.0
    valid = (valid_history | ~used.unsqueeze(-1)).all(1)
    return at_latency(history, latency), valid
