"""Configuration of the camera: one frozen dataclass a file of ``configs/camera``."""

from dataclasses import dataclass

from camera.fisheye import FisheyeParams, check_fisheye
from camera.mount import MountParams
from camera.noise import KeypointNoiseParams, check_noise


@dataclass(frozen=True)
class CameraParams:
    """The whole camera as a policy is trained on it; an exported policy carries these values."""

    fisheye: FisheyeParams
    mount: MountParams
    noise: KeypointNoiseParams
    goal_side: float  # side of the ground square around the target whose corners are seen [m]
    payload_radius: float  # radius of the ball whose bounding box is seen [m]


def check_camera(params: CameraParams) -> None:
    """Refuse parameters that describe no camera.

    Raises:
        ValueError: See `check_fisheye` and `check_noise`; or a size that is not above 0.
    """
    check_fisheye(params.fisheye)
    check_noise(params.noise)
    for name in ("goal_side", "payload_radius"):
        if not getattr(params, name) > 0.0:
            raise ValueError(f"camera {name} is {getattr(params, name)}; expected a length above 0 m")
