"""Scenes of throws, random or from a flight, and the true positions of their keypoints in the
picture.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn import functional as F

from camera.fisheye import Fisheye
from camera.keypoints import ball_extremes_c, goal_square
from camera.mount import nominal_rot_cb, rotation_from_vector
from camera.params import CameraParams, FisheyeParams
from visthrow.common.toml_text import tables_beside

THINGS = 10  # largest number of other objects in a hall

ALIKE = ((0.75, 0.80, 0.25), (0.20, 0.50, 0.28), (0.85, 0.75, 0.20), (0.9, 0.9, 0.88))
"""Colours of objects that resemble those of the ball or the square."""


def _table(name: str) -> dict[str, Any]:
    return tables_beside(__file__, name)


ROW_COLUMNS = _table("rows.toml")
"""Table of :class:`Scenes` -> its columns and their types; the last one is a row of ``things``."""

PLAIN = _table("plain.toml")
"""Rows of plain scenes in the tables of :class:`Scenes`, or the columns after the scene's
values.
"""


@dataclass(frozen=True)
class Scenes:
    """A batch of scenes, one row for each, float32; `rows.toml` describes the columns."""

    lens: Tensor
    pose: Tensor
    shutter: Tensor
    ball: Tensor
    goal: Tensor
    ground: Tensor
    walls: Tensor
    light: Tensor
    rope: Tensor
    sensor: Tensor
    things: Tensor  # shape (E, THINGS, 12)

    @property
    def count(self) -> int:
        """Return the number E of scenes."""
        return len(self.pose)

    def to(self, device: str | torch.device) -> "Scenes":
        """Return the scenes on another device."""
        return Scenes(*(table.to(device) for table in vars(self).values()))


def lens_row(lens: FisheyeParams, vignetting: float = 0.5) -> Tensor:
    """Return the row of a lens, shape (10,)."""
    return torch.tensor(
        [lens.fx, lens.fy, lens.cx, lens.cy, *lens.coefficients, lens.half_fov, vignetting]
    )


class Draw:
    """A source of random numbers for one batch, on the CPU, so that they are the same for all
    devices.
    """

    def __init__(self, count: int, seed: int):
        """Prepare for a batch of ``count`` scenes."""
        self.count = count
        self.generator = torch.Generator().manual_seed(seed)

    def uniform(self, low: float, high: float, *shape: int) -> Tensor:
        """Return uniform numbers, shape (E, ...)."""
        return low + (high - low) * torch.rand(self.count, *shape, generator=self.generator)

    def normal(self, std: float, *shape: int) -> Tensor:
        """Return normal numbers, shape (E, ...)."""
        return std * torch.randn(self.count, *shape, generator=self.generator)

    def one_of(self, count: int, *shape: int) -> Tensor:
        """Return whole numbers below ``count``, float, shape (E, ...)."""
        return torch.randint(0, count, (self.count, *shape), generator=self.generator).float()

    def chance(self, share: float, *shape: int) -> Tensor:
        """Return booleans that are true with a probability, shape (E, ...)."""
        return torch.rand(self.count, *shape, generator=self.generator) < share

    def way(self) -> Tensor:
        """Return horizontal unit vectors, shape (E, 2)."""
        angle = self.uniform(0.0, 2.0 * math.pi)
        return torch.stack([angle.cos(), angle.sin()], -1)


@dataclass(frozen=True)
class Nuisances:
    """The severity of nuisances, from 0 (none) to 1 (as in a hall with a cheap camera)."""

    blur: float = 1.0
    motion: float = 1.0  # exposure and rolling shutter
    noise: float = 1.0
    light: float = 1.0
    clutter: float = 1.0
    ground: float = 1.0  # textures instead of grey
    look: float = 1.0  # colours of ball and square
    parts: float = 1.0  # rope in front of the lens


def random_scenes(
    params: CameraParams, textures: int, count: int, seed: int, nuisances: Nuisances | None = None
) -> Scenes:
    """Draw random instants of throws: hanging or thrown ball, level or tilted vehicle, goal within
    2.3 m.

    Args:
        params: camera, with the sizes of ball and square.
        textures: number of photographs. count: number E of scenes. seed: seed of all draws.
        nuisances: severity of nuisances; default all.
    """
    d = Draw(count, seed)
    ahead = d.uniform(-0.4, 1.0, 1)
    lateral = d.uniform(-0.4, 0.4, 1)
    pos = torch.cat([ahead, lateral, d.uniform(0.8, 2.3, 1)], -1)
    lean = d.uniform(0.0, 1.0, 1).square() * math.radians(65.0)
    tilt = lean * d.way()
    rot_wb = rotation_from_vector(torch.cat([tilt, d.uniform(-0.5, 0.5, 1)], -1))
    distance = d.uniform(0.0, 2.3, 1)
    goal = pos[:, :2] + distance * d.way()
    swing = d.uniform(0.0, 1.0, 1).square() * math.radians(80.0)
    way = torch.cat([swing.sin() * d.way(), -swing.cos()], -1)
    thrown = d.chance(0.25, 1)
    flown = d.uniform(0.4, 2.0, 1)
    hanging = d.uniform(0.33, 0.42, 1)
    ball = pos + way * torch.where(thrown, flown, hanging)
    ball[:, 2].clamp_(min=params.payload_radius)
    scenes = make_plain_scenes(params, pos, rot_wb, ball, goal, ~thrown[:, 0])
    vel = d.normal(1.2, 3)
    rates = d.normal(2.5, 3)
    scenes.pose[:, 7:] = torch.cat([vel, rates], -1)
    scenes.ball[:, 4:7] = vel + d.normal(1.5, 3)
    scenes.goal[:, 3] = d.normal(0.05)
    return draw_halls(scenes, d, textures, nuisances or Nuisances())


def make_plain_scenes(
    params: CameraParams,
    pos_w: Tensor,
    rot_wb: Tensor,
    ball_w: Tensor,
    goal_w: Tensor,
    hangs: Tensor,
) -> Scenes:
    """Return plain scenes for given poses: grey ground, tennis ball, green square with a white rim,
    a sharp picture without noise.

    Args:
        params: camera.
        pos_w: position of the vehicle [m], shape (E, 3). rot_wb: attitude, shape (E, 3, 3).
        ball_w: [m], shape (E, 3). goal_w: [m], shape (E, 2) or (E, 3).
        hangs: whether the ball is attached to its rope, shape (E,).
    """
    count = len(pos_w)
    plain = {name: torch.tensor(row).float().repeat(count, 1) for name, row in PLAIN.items()}
    size = torch.ones(count, 1)
    rot_wb = rot_wb.float()
    lens_b = torch.tensor(params.mount.position_b)
    eye = pos_w.float() + rot_wb @ lens_b
    rot_wc = rot_wb @ nominal_rot_cb(params.mount).float().T
    mount = rot_wb @ (torch.tensor([0.0, 0.0, -0.02]) - lens_b)
    radius = 0.0012 * hangs.float()
    light = F.normalize(torch.tensor([0.35, 0.25, 0.9]), dim=0)
    plain["lens"] = lens_row(params.fisheye, 0.0).repeat(count, 1)
    plain["pose"] = _join_columns(eye, _quat(rot_wc), torch.zeros(count, 6))
    plain["shutter"] = torch.zeros(count, 3)
    plain["ball"] = _join_columns(ball_w.float(), params.payload_radius * size, plain["ball"])
    plain["goal"] = _join_columns(goal_w[:, :2].float(), params.goal_side * size, plain["goal"])
    plain["light"] = _join_columns(light.repeat(count, 1), plain["light"])
    plain["rope"] = _join_columns(mount, radius, plain["rope"])
    return Scenes(**plain, things=torch.zeros(count, THINGS, 12))


def _join_columns(*columns: Tensor) -> Tensor:
    """Concatenate columns, shape (F, ...) or (F, ..., n)."""
    rank = max(2, *(c.dim() for c in columns))
    return torch.cat([c if c.dim() == rank else c[..., None] for c in columns], -1)


def _draw_sensors(count: int, d: Draw, n: Nuisances) -> tuple[Tensor, Tensor]:
    """Return random sensors and shutters."""
    gain = torch.exp2(n.light * d.uniform(-1.2, 0.9))
    noise = n.noise * d.uniform(0.0, 1.0).square()
    seed = torch.arange(count) * 7919.0 + d.one_of(1000)
    gamma = 1.0 + n.light * d.uniform(-0.45, 0.1)
    sensor = _join_columns(gain, 0.06 * noise, 0.04 * noise, gamma, torch.zeros(count), seed)
    exposure = n.motion * d.uniform(0.0, 0.012)
    readout = n.motion * d.uniform(0.0, 0.012)
    defocus = n.blur * d.uniform(0.0, 1.0).square() * 1.6
    return sensor, _join_columns(exposure, readout, defocus)


def _draw_colours(scenes: Scenes, d: Draw, n: Nuisances) -> tuple[Tensor, Tensor]:
    """Return balls and goals with random colours, rims, marks and orientations."""
    ball = scenes.ball.clone()
    goal = scenes.goal.clone()
    ball[:, 7:11] = F.normalize(d.normal(1.0, 4), dim=-1)
    for table, first, shades, edges in (
        (ball, 11, (-0.18, 0.12), (-0.3, 0.05)),
        (goal, 6, (-0.08, 0.12), (-0.25, 0.07)),
    ):
        shade = d.uniform(*shades, 1)
        hue = shade + d.uniform(-0.08, 0.08, 3)
        edge = d.uniform(*edges, 1)  # brightness of the ball's seam or the square's rim
        change = torch.cat([hue, edge.expand(-1, 3)], -1)
        colours = table[:, first : first + 6]
        colours.copy_((colours + n.look * change).clamp(0.02, 1.0))
    goal[:, 4] = goal[:, 4] + n.look * d.uniform(-0.008, 0.012)
    marked = d.chance(0.6 * n.look)
    goal[:, 5] = torch.where(marked, d.one_of(4), goal[:, 5])
    return ball, goal


def _hall(scenes: Scenes, d: Draw, textures: int, n: Nuisances) -> tuple[Tensor, Tensor]:
    """Return grounds and walls, some of them plain, the others with random photographs."""
    pictured = d.chance(n.ground)[:, None]
    brightness = d.uniform(0.45, 1.1, 1)
    tint = brightness * (1.0 + d.uniform(-0.25, 0.25, 3) * n.light)
    texture = d.one_of(textures)
    tile = d.uniform(0.4, 3.0)
    yaw = d.uniform(0.0, 6.28)
    ground = _join_columns(texture, tile, yaw, d.uniform(0.0, 2.0, 2), tint)
    texture = d.one_of(textures)
    half = d.uniform(3.0, 9.0)
    height = d.uniform(3.0, 7.0)
    tile = d.uniform(1.5, 6.0)
    walls = _join_columns(texture, half, height, tile, d.uniform(0.3, 1.0))
    return torch.where(pictured, ground, scenes.ground), torch.where(pictured, walls, scenes.walls)


def _lit(scenes: Scenes, d: Draw, n: Nuisances) -> Tensor:
    """Return random lights."""
    slope = d.normal(0.5, 2)
    direction = _join_columns(slope, torch.ones(len(slope)))
    direction = F.normalize(direction, dim=-1)
    colour = 1.0 + n.light * d.uniform(-0.15, 0.15, 3)
    drawn = d.chance(n.light)[:, None]
    direction = torch.where(drawn, direction, scenes.light[:, :3])
    ambient = d.uniform(0.3, 0.7)
    return _join_columns(direction, ambient, colour, d.uniform(0.2, 0.8))


def draw_halls(scenes: Scenes, d: Draw, textures: int, n: Nuisances) -> Scenes:
    """Return the scenes with random halls, colours, lights, vignetting and sensors."""
    ground, walls = _hall(scenes, d, textures, n)
    ball, goal = _draw_colours(scenes, d, n)
    light = _lit(scenes, d, n)
    rope = scenes.rope.clone()
    rope[:, 3] = rope[:, 3] * d.chance(n.parts)
    rope[:, 3] = rope[:, 3] * d.uniform(0.6, 1.5)
    rope[:, 4:7] = d.uniform(0.05, 0.9, 1)
    lens = scenes.lens.clone()
    lens[:, 9] = n.light * d.uniform(0.0, 2.0)
    sensor, shutter = _draw_sensors(scenes.count, d, n)
    things = _things(scenes, d, n)
    return Scenes(
        lens, scenes.pose, shutter, ball, goal, ground, walls, light, rope, sensor, things
    )


def _things(scenes: Scenes, d: Draw, n: Nuisances) -> Tensor:
    """Return random other objects, half of them with colours that resemble those of ball or square;
    none is on the square, and other balls are not close to the ball.
    """
    kind = d.chance(0.6 * n.clutter, THINGS) * (1.0 + d.one_of(3, THINGS))
    angle = d.uniform(0.0, 6.28, THINGS)
    way = torch.stack([angle.cos(), angle.sin()], -1)
    place = scenes.pose[:, None, :2] + d.uniform(0.2, 3.5, THINGS, 1) * way
    rectangle = kind == 2
    size = torch.where(rectangle, d.uniform(0.03, 0.3, THINGS), d.uniform(0.02, 0.14, THINGS))
    breadth = torch.where(rectangle, d.uniform(0.03, 0.3, THINGS), size)
    alike = torch.tensor(ALIKE)[d.one_of(4, THINGS).long()]
    of_one = d.chance(0.5, THINGS, 1)
    alike = alike + d.uniform(-0.08, 0.08, THINGS, 3)
    colour = torch.where(of_one, alike, d.uniform(0.03, 0.97, THINGS, 3)).clamp(0.0, 1.0)
    raised = size + d.uniform(0.0, 0.4, THINGS)
    height = torch.where(kind == 3, raised, 0.0)
    off = (place - scenes.goal[:, None, :2]).norm(dim=-1)
    distance = (place - scenes.ball[:, None, :2]).norm(dim=-1)
    on_ground = off > 0.22 + torch.maximum(size, breadth)
    clear = (kind != 3) | (distance > 0.25 + size)
    rimmed = d.chance(0.3, THINGS)
    rim_from = torch.where(rimmed, d.uniform(0.6, 0.9, THINGS), 9.0)
    turn = d.uniform(0.0, 3.14, THINGS, 1)
    rim = d.uniform(0.0, 1.0, THINGS, 1)
    stays = kind * (on_ground & clear)
    return _join_columns(stays, place, height, size, breadth, turn, colour, rim_from, rim)


def _quat(rot: Tensor) -> Tensor:
    """Return the unit quaternions xyzw of rotation matrices, shape (E, 4)."""
    return torch.from_numpy(Rotation.from_matrix(rot.double().numpy()).as_quat()).float()


@dataclass(frozen=True)
class Truth:
    """The true positions of ball and square in the pictures, at the times at which their rows were
    exposed.
    """

    ball_c: Tensor  # centre [m], shape (E, 3), camera frame
    # corners of the square [m], shape (E, 4, 3), in the order of `camera.keypoints.goal_square`
    corners_c: Tensor
    rot_wc: Tensor  # camera to world, shape (E, 3, 3)
    ball_visible: Tensor  # whether the whole ball is in the field of view, shape (E,), bool
    goal_visible: Tensor  # whether the whole square is in the field of view, shape (E,), bool

    @property
    def ball_ray(self) -> Tensor:
        """Return unit rays to the ball, shape (E, 3)."""
        return F.normalize(self.ball_c, dim=-1)


def truth_of(scenes: Scenes, lens: Fisheye) -> Truth:
    """Return the true positions in scenes that all have this lens."""
    rot = torch.from_numpy(Rotation.from_quat(scenes.pose[:, 3:7].double().numpy()).as_matrix())
    goal = scenes.goal.double()
    ball = scenes.ball[:, None].double()
    c = goal[:, 3].cos()
    s = goal[:, 3].sin()
    turn = torch.stack([c, -s, s, c], -1).unflatten(-1, (2, 2))
    square = goal_square(1.0)[:, :2] * goal[:, 2, None, None]
    corners = F.pad(square @ turn.transpose(1, 2) + goal[:, None, :2], (0, 1))
    points = torch.cat([corners, ball[..., :3]], 1)
    speed = torch.cat([torch.zeros_like(corners), ball[..., 4:7]], 1)
    eye, _, vel, rate = scenes.pose[:, None].double().split((3, 4, 3, 3), -1)
    time = torch.zeros(*points.shape[:2], 1, dtype=torch.float64)
    for _ in range(3):
        world = points + speed * time - eye - vel * time
        static = world @ rot
        static_c = torch.einsum("ekji,ekj->eki", rotation_from_vector(rate * time), static)
        pixels, visible = lens.project(static_c)
        row = (pixels[..., 1:2] + 0.5) / lens.params.height - 0.5
        time = row * scenes.shutter[:, None, 1:2].double()
    visible = visible & lens.is_on_sensor(pixels)
    ball_c = static_c[:, 4]
    extremes_c = ball_extremes_c(lens, ball_c, float(scenes.ball[0, 3]))
    _, sides = lens.project_normalized(extremes_c)
    ball_visible = sides.all(1) & visible[:, 4]
    return Truth(ball_c, static_c[:, :4], rot, ball_visible, visible[:, :4].all(1))
