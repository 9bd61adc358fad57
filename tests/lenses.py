"""Lenses that the tests of the fisheye model share, and a camera of any lens."""

from functools import partial

import torch
from pytest import mark

from camera.params import CameraParams, FisheyeParams, KeypointNoiseParams, MountParams

f64 = partial(torch.tensor, dtype=torch.float64)
EQUIDISTANT = FisheyeParams(640, 640, 166.6786, 166.6786, 319.5, 319.5)
BENT = FisheyeParams(640, 480, 160.0, 150.0, 310.0, 245.0, 0.02, -0.01, 0.002, -0.0002, 200.0)
NARROW = FisheyeParams(
    512, 512, 190.97, 190.99, 254.9, 256.9, 0.0035, 0.0007, -0.0021, 0.0002, 195.0
)  # a TUM-VI-like lens
LENSES = mark.parametrize(
    "params", [EQUIDISTANT, BENT, NARROW], ids=["equidistant", "bent", "narrow"]
)


def camera_of(lens: FisheyeParams) -> CameraParams:
    """Return a camera below and ahead of the vehicle's middle, with the paper's square and ball."""
    mount = MountParams(position_b=(0.03, 0.0, -0.02))
    return CameraParams(lens, mount, KeypointNoiseParams(), 0.25, 0.033)
