"""What stands between a scene and its picture: blur, light, occlusion, sensor noise.

To test and measure a detector with.
"""

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class NuisanceParams:
    """Spreads of one level of difficulty; each picture draws its own values."""

    blur: float = 0.0  # largest standard deviation of the Gaussian blur [px]
    motion: float = 0.0  # longest smear in one direction [px]
    # of the sensor at full scale: half of it shot noise, the rest there in the dark too [-]
    noise: float = 0.0
    gain: float = 0.0  # exposure off by up to this, as a power of two [-]
    gradient: float = (
        0.0  # of the light from one side of the picture to the other, up to this share [-]
    )
    tint: float = 0.0  # red against blue off by up to this share [-]
    clutter: int = 0  # things in the room, half of them of colours like those of goal and payload
    occlusion: float = 0.0  # width of a bar across the ball against its diameter, up to this [-]


def degrade(
    image: np.ndarray,
    params: NuisanceParams,
    rng: np.random.Generator,
    ball: tuple[float, float, float] | None = None,
) -> np.ndarray:
    """Make a camera's picture of a rendered one.

    Args:
        image: RGB in [0, 1], float, shape (H, W, 3).
        params: how bad.
        rng: of this picture.
        ball: its centre and radius [px], for the occlusion.

    Returns:
        BGR, uint8, shape (H, W, 3).
    """
    import cv2

    image = np.ascontiguousarray(image, np.float32)
    height, width = image.shape[:2]
    angle = rng.uniform(0.0, 2.0 * math.pi)
    if ball is not None and params.occlusion > 0.0:
        u, v, radius = ball
        offset, half = rng.uniform(-0.6, 0.6) * radius, radius * rng.uniform(0.0, params.occlusion)
        across = np.array([math.cos(angle), math.sin(angle)])
        middle, along = (
            np.array([u, v]) + offset * across,
            2.0 * radius * np.array([-across[1], across[0]]),
        )
        bar = np.array(
            [
                middle + along - half * across,
                middle + along + half * across,
                middle - along + half * across,
                middle - along - half * across,
            ]
        )
        cv2.fillConvexPoly(
            image, np.round(bar * 16).astype(np.int32), (0.12, 0.12, 0.13), cv2.LINE_AA, 4
        )
    sigma = rng.uniform(0.0, params.blur)
    if sigma > 0.05:
        image = cv2.GaussianBlur(image, (0, 0), sigma)
    length = rng.uniform(0.0, params.motion)
    if length > 1.0:
        image = cv2.filter2D(
            image, -1, _smear(length, rng.uniform(0.0, math.pi)), borderType=cv2.BORDER_REPLICATE
        )
    u, v = np.meshgrid(
        np.linspace(-1, 1, width, dtype=np.float32), np.linspace(-1, 1, height, dtype=np.float32)
    )
    direction = rng.uniform(0.0, 2.0 * math.pi)
    slope = rng.uniform(0.0, params.gradient)
    light = 2.0 ** rng.uniform(-params.gain, params.gain) * (
        1.0 + slope * (math.cos(direction) * u + math.sin(direction) * v)
    )
    tint = rng.uniform(-params.tint, params.tint)
    image = image * light[..., None] * np.array([1.0 + tint, 1.0, 1.0 - tint], np.float32)
    shot = np.sqrt(np.clip(image, 0.0, 1.0)) * rng.standard_normal(image.shape, np.float32)
    image = image + params.noise * math.sqrt(0.5) * (
        shot + rng.standard_normal(image.shape, np.float32)
    )
    return np.round(np.clip(image[..., ::-1], 0.0, 1.0) * 255.0).astype(np.uint8)


def _smear(length: float, angle: float) -> np.ndarray:
    """Kernel of a smear of a length [px] in a direction [rad]; its mass lies symmetric about the
    middle.
    """
    size = 2 * math.ceil(length / 2.0) + 3
    kernel = np.zeros((size, size), np.float32)
    for step in np.linspace(-0.5, 0.5, 8 * size):
        u, v = (
            size // 2 + step * length * math.cos(angle),
            size // 2 + step * length * math.sin(angle),
        )
        a, b = math.floor(u), math.floor(v)
        for i, part_u in ((a, 1 - (u - a)), (a + 1, u - a)):
            for j, part_v in ((b, 1 - (v - b)), (b + 1, v - b)):
                kernel[j, i] += part_u * part_v
    return kernel / kernel.sum()
