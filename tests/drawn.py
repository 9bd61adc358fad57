"""A small renderer of fisheye frames in torch, which shares no code with
`visthrow.detector_training.scenes`: one ray a pixel, no noise.

Ground plane z = 0 with a chequered texture, goal square, ball.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch

from camera.fisheye import Fisheye
from camera.mount import rotate
from camera.params import FisheyeParams

GROUND_LIGHT, GROUND_DARK = 0.62, 0.50
YELLOW = (0.80, 0.88, 0.20)
TILE = 0.5
"""Side of the ground's tiles [m]."""

LIGHT_W = (0.35, 0.25, 0.9)
"""Direction towards the lamp, world frame; normalised where used."""


@dataclass(frozen=True)
class Mat:
    """A coloured rectangle on the ground that is no goal."""

    centre_w: tuple[float, float]  # [m], world frame
    size: tuple[float, float]  # half sides [m]
    yaw: float  # [rad]
    colour: tuple[float, float, float]  # RGB in [0, 1]


def pixel_rays(lens: Fisheye, supersample: int = 1) -> tuple[torch.Tensor, torch.Tensor]:
    """Rays through all pixels.

    Args:
        lens: The lens.
        supersample: Samples a pixel along each axis.

    Returns:
        Unit rays, float64, shape (H s, W s, 3), camera frame, and whether the sample is inside the
        field of view, shape (H s, W s).
    """
    return _pixel_rays(lens.params, supersample)


@lru_cache(maxsize=2)
def _pixel_rays(params: FisheyeParams, s: int) -> tuple[torch.Tensor, torch.Tensor]:
    """`pixel_rays`, kept from frame to frame: the inverse of the lens costs more than the rest of a
    frame.
    """
    u = (torch.arange(params.width * s, dtype=torch.float64) + 0.5) / s - 0.5
    v = (torch.arange(params.height * s, dtype=torch.float64) + 0.5) / s - 0.5
    grid = torch.stack([u[None, :].expand(len(v), -1), v[:, None].expand(-1, len(u))], -1)
    return Fisheye(params).unproject(grid)


def render_scene(
    lens: Fisheye,
    eye_w: torch.Tensor,
    rot_wc: torch.Tensor,
    goal_w: torch.Tensor,
    ball_w: torch.Tensor,
    ball_radius: float = 0.033,
    goal_side: float = 0.25,
    supersample: int = 2,
    mats: Sequence[Mat] = (),
    felt: tuple[float, float, float] = YELLOW,
) -> torch.Tensor:
    """Draw ball, goal square and ground as the camera sees them.

    Args:
        lens: The lens.
        eye_w: Lens position [m], shape (3,), world frame.
        rot_wc: Camera to world, shape (3, 3).
        goal_w: Goal [m], shape (2,) or (3,), world frame.
        ball_w: Centre of the ball [m], shape (3,), world frame.
        ball_radius: [m].
        goal_side: Side of the goal square, along the world's axes [m].
        supersample: Samples a pixel along each axis, averaged.
        mats: What else lies on the ground, below the goal square.
        felt: Colour of the ball, RGB in [0, 1].

    Returns:
        Colours in [0, 1], RGB, float32, shape (H, W, 3); black outside the field of view.
    """
    rays_c, seen = pixel_rays(lens, supersample)
    rays_w = rotate(rot_wc.double(), rays_c)
    eye_w = eye_w.double()
    colour = _sky(rays_w)
    down = rays_w[..., 2] < -1e-9
    depth = -eye_w[2] / torch.where(down, rays_w[..., 2], torch.full_like(rays_w[..., 2], -1.0))
    ground_w = eye_w + rays_w * depth.unsqueeze(-1)
    ground = _ground(ground_w, depth, goal_w, goal_side, ball_w, ball_radius, mats)
    colour = torch.where((down & (depth > 0.0)).unsqueeze(-1), ground, colour)
    hit, normal_w = _sphere(eye_w, rays_w, ball_w.double(), ball_radius)
    colour = torch.where(hit.unsqueeze(-1), _ball(normal_w, felt), colour)
    colour = colour * seen.unsqueeze(-1)
    return _average(colour, supersample)


def _average(colour: torch.Tensor, s: int) -> torch.Tensor:
    """Mean over blocks of s x s samples, float32."""
    height, width, channels = colour.shape
    return colour.reshape(height // s, s, width // s, s, channels).mean((1, 3)).float()


def _rgb(red: float, green: float, blue: float) -> torch.Tensor:
    return torch.tensor([red, green, blue], dtype=torch.float64)


def _sky(rays_w: torch.Tensor) -> torch.Tensor:
    """Walls and ceiling of a room: brighter towards the top."""
    height = rays_w[..., 2:3].clamp(0.0, 1.0)
    return _rgb(0.30, 0.33, 0.38) + height * _rgb(0.35, 0.36, 0.37)


def _ground(ground_w, depth, goal_w, goal_side, ball_w, ball_radius, mats) -> torch.Tensor:
    """Tiles that fade with the distance (no aliasing near the horizon), mats, the goal square
    with its rim, the ball's shadow.
    """
    tile = (ground_w[..., :2] / TILE).floor().sum(-1) % 2
    fade = (-depth / 6.0).exp()
    shade = GROUND_DARK + (GROUND_LIGHT - GROUND_DARK) * (0.5 + (tile - 0.5) * fade)
    colour = shade.unsqueeze(-1) * _rgb(1.0, 0.98, 0.94)
    for mat in mats:
        away = ground_w[..., :2] - torch.tensor(mat.centre_w, dtype=torch.float64)
        x, y = away.unbind(-1)
        c, s = math.cos(mat.yaw), math.sin(mat.yaw)
        across, along = (c * x + s * y) / mat.size[0], (c * y - s * x) / mat.size[1]
        covered = torch.maximum(across.abs(), along.abs()) < 1.0
        colour = torch.where(covered.unsqueeze(-1), _rgb(*mat.colour), colour)
    reach = (ground_w[..., :2] - goal_w[:2].double()).abs().amax(-1)
    colour = torch.where((reach < goal_side / 2).unsqueeze(-1), _rgb(0.93, 0.93, 0.90), colour)
    colour = torch.where(
        (reach < goal_side / 2 - 0.02).unsqueeze(-1), _rgb(0.16, 0.55, 0.26), colour
    )
    away = (ground_w[..., :2] - ball_w[:2].double()).norm(dim=-1)
    shadow = 1.0 - 0.45 * (-((away / (1.5 * ball_radius)) ** 2)).exp()
    return colour * shadow.unsqueeze(-1)


def _sphere(eye_w, rays_w, centre_w, radius) -> tuple[torch.Tensor, torch.Tensor]:
    """First hit of rays on a ball in front of the eye: whether, and the outward normal there."""
    to_centre = centre_w - eye_w
    along = (rays_w * to_centre).sum(-1)
    miss2 = to_centre.dot(to_centre) - along * along
    inside = radius * radius - miss2
    hit = (inside > 0.0) & (along > 0.0)
    depth = along - inside.clamp(min=0.0).sqrt()
    return hit, (rays_w * depth.unsqueeze(-1) - to_centre) / radius


def _ball(normal_w: torch.Tensor, felt: tuple[float, float, float]) -> torch.Tensor:
    """A tennis ball: felt with a seam, lit by one lamp."""
    turn = torch.atan2(normal_w[..., 1], normal_w[..., 0])
    seam = (normal_w[..., 2] - 0.45 * (2.0 * turn).sin()).abs() < math.sin(0.09)
    colour = torch.where(seam.unsqueeze(-1), _rgb(0.95, 0.95, 0.92), _rgb(*felt))
    return colour * _lit(normal_w)


def _lit(normal_w: torch.Tensor) -> torch.Tensor:
    """Share of the light that a surface sends back, shape (..., 1)."""
    light = torch.tensor(LIGHT_W, dtype=torch.float64)
    return (0.45 + 0.55 * (normal_w @ (light / light.norm())).clamp(min=0.0)).unsqueeze(-1)
