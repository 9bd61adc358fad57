"""Detection of ball and goal square on fisheye frames by small neural networks, with the interface
of `camera.detectors.contours`.

One network searches the whole frame at half resolution. For each cell of a grid it predicts whether
a ball (a square) has its centre there, its position in the cell and its size. Two other networks
refine these places, each in a patch that is rectified around its ray and therefore free of the
lens's distortion. They predict confidence, exact position and size, and their accuracy. The results
are rays. Confidences are calibrated on pictures outside the training set, and returned as
probabilities."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from camera.detectors.contours import GATE, BallSeen, Detector, FrameDetections, GoalSeen, Prior
from camera.fisheye import Fisheye

SHIPPED = Path(__file__).parent / "learnt.npz"
FORMAT = 1

CELL = 16  # side of a cell of the grid [px of the frame]

KINDS = ("ball", "goal")
PATCH = {"ball": 40, "goal": 56}  # side of a patch [px]

REACH = {"ball": 2.2, "goal": 1.9}
"""Half side of a patch over the object's size: the ball's half-angle, or the mean angle from the
square's centre to its corners.
"""

LEAST_REACH = 0.05
"""Smallest half side of a patch, as a tangent, so that patches of distant objects include their
surroundings.
"""

PLACES = 3  # number of places of each kind that are refined

LEAST_PROBABILITY = 0.5


def _block(inward: int, outward: int, stride: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inward, outward, 3, stride, 1), nn.SiLU())


class FrameNetwork(nn.Module):
    """Network from whole frames at half resolution, (B, 3, H / 2, W / 2), to (B, 2, 4, H / 16, W /
    16): logit, position relative to the cell's centre [cells] and log size [cells].
    """

    def __init__(self) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(3, 12, 5, 2, 2),
            nn.SiLU(),
            _block(12, 24, 2),
            _block(24, 40, 2),
            _block(40, 40, 1),
            _block(40, 40, 1),
            nn.Conv2d(40, 8, 1),
        )
        with torch.no_grad():
            self.body[-1].bias[0::4] = -5.0  # few cells of a frame contain an object

    def forward(self, frames: Tensor) -> Tensor:
        return self.body(frames).unflatten(1, (2, 4))


class PatchNetwork(nn.Module):
    """Network from patches (B, 3, S, S) to (B, outputs): logit, log accuracy, and the object's
    geometry in half sides of the patch.
    """

    def __init__(self, side: int, outputs: int):
        super().__init__()
        last = -(-side // 8)
        self.body = nn.Sequential(
            _block(3, 16, 1),
            _block(16, 24, 2),
            _block(24, 32, 2),
            _block(32, 24, 2),
            nn.Flatten(),
            nn.Linear(24 * last * last, 48),
            nn.SiLU(),
            nn.Linear(48, outputs),
        )

    def forward(self, patches: Tensor) -> Tensor:
        return self.body(patches)


class Networks(nn.Module):
    """The three networks, and the calibration of their confidences.

    Attributes:
        calibration: kind -> factor and offset of the logits, and factor of the accuracies.
        made_by: provenance of the training.
    """

    def __init__(self) -> None:
        super().__init__()
        self.search = FrameNetwork()
        self.ball = PatchNetwork(PATCH["ball"], 5)
        self.goal = PatchNetwork(PATCH["goal"], 10)
        self.calibration = dict.fromkeys(KINDS, (1.0, 0.0, 1.0))
        self.made_by: dict = {}

    def save(self, path: str | Path) -> None:
        """Write an ``.npz`` without pickle: the weights in half precision, and a JSON text
        ``header``.
        """
        header = {
            "format_version": FORMAT,
            "calibration": self.calibration,
            "made_by": self.made_by,
        }
        arrays = {}
        for name, value in self.state_dict().items():
            arrays[name] = value.numpy(force=True).astype(np.float16)
        with open(path, "wb") as file:
            text = np.frombuffer(json.dumps(header).encode(), np.uint8)
            np.savez_compressed(file, header=text, **arrays)

    @staticmethod
    def load(path: str | Path = SHIPPED) -> "Networks":
        """Read a file of `save`. Raises ValueError: no such file, or another format."""
        networks = Networks()
        try:
            with np.load(path, allow_pickle=False) as arrays:
                header = json.loads(arrays["header"].tobytes())
                if header["format_version"] != FORMAT:
                    raise ValueError(
                        f"format version {header['format_version']}, this program reads {FORMAT}"
                    )
                names = [name for name in arrays.files if name != "header"]
                numbers = {name: arrays[name].astype(np.float32) for name in names}
                networks.load_state_dict({n: torch.from_numpy(x) for n, x in numbers.items()})
        except (OSError, EOFError, KeyError, ValueError, RuntimeError, BadZipFile) as error:
            raise ValueError(
                f"{path}: not a detector written by `visthrow detector train`: {error}"
            ) from error
        networks.calibration = {kind: tuple(header["calibration"][kind]) for kind in KINDS}
        networks.made_by = header["made_by"]
        return networks.eval()


def halve(frames: Tensor) -> Tensor:
    """Convert frames, uint8, (B, H, W, 3), to the input of the search:

    RGB in -1 to 1, (B, 3, H / 2, W / 2).
    """
    return F.avg_pool2d(frames.permute(0, 3, 1, 2).float(), 2) / 127.5 - 1.0


@dataclass(frozen=True)
class Views:
    """Rectified patches around rays, each with an orthonormal frame and a half side."""

    axes: Tensor  # rows right, down, ahead, shape (B, 3, 3), camera frame
    reach: Tensor  # half side as a tangent, shape (B,)

    def rays(self, points: Tensor) -> Tensor:
        """Return the unit rays (B, K, 3) of points in half sides (B, K, 2)."""
        lateral = points * self.reach[:, None, None]
        axial = torch.cat([lateral, torch.ones_like(lateral[..., :1])], -1)
        return F.normalize(axial @ self.axes, dim=-1)

    def points(self, rays: Tensor) -> Tensor:
        """Invert `rays` for rays (B, K, 3) less than 90 deg off the axis."""
        local = rays @ self.axes.transpose(1, 2)
        depth = local[..., 2:].clamp(min=1e-3)
        return local[..., :2] / (depth * self.reach[:, None, None])


def views_about(rays: Tensor, reach: Tensor, north_c: Tensor) -> Views:
    """Return patches around unit rays, shape (B, 3), whose up direction is ``north_c``, camera
    frame, shape (B, 3).

    If the attitude is known, this is the world's x axis, so that the corners of a square parallel
    to the world's axes are always in the same order."""

    def perpendicular(vector: Tensor) -> Tensor:
        return vector - (vector * rays).sum(-1, keepdim=True) * rays

    up = perpendicular(north_c)
    spare = perpendicular(rays.new_tensor([[0.0, -1.0, 0.0]]))
    up = torch.where(up.norm(dim=-1, keepdim=True) > 0.1, up, spare)
    down = -F.normalize(up, dim=-1)
    right = torch.linalg.cross(down, rays)
    return Views(torch.stack([right, down, rays], 1), reach)


def patches_of(frames: Tensor, index: Tensor, views: Views, lens: Fisheye, side: int) -> Tensor:
    """Return rectified patches, RGB in -1 to 1, shape (B, 3, S, S).

    Args:
        frames: RGB, uint8, shape (F, H, W, 3). index: frame of each patch, shape (B,).
        views: of the patches. lens: of the frames. side: S.
    """
    centres = (torch.arange(side, device=frames.device) + 0.5) * (2.0 / side) - 1.0
    axes = torch.meshgrid(centres, centres, indexing="xy")
    grid = torch.stack(axes, -1).reshape(1, -1, 2)
    rays = views.rays(grid.expand(len(index), -1, -1))
    pixels, _ = lens.project(rays)
    height, width = frames.shape[1:3]
    u = pixels[..., 0].clamp(0.0, width - 1.001)
    v = pixels[..., 1].clamp(0.0, height - 1.001)
    i = u.long()
    j = v.long()
    a = (u - i)[..., None]
    b = (v - j)[..., None]
    e = index[:, None]
    top = frames[e, j, i] * (1 - a) + frames[e, j, i + 1] * a
    low = frames[e, j + 1, i] * (1 - a) + frames[e, j + 1, i + 1] * a
    patches = (top * (1 - b) + low * b) / 127.5 - 1.0
    return patches.unflatten(1, (side, side)).permute(0, 3, 1, 2)


class LearntDetector(Detector):
    """Detector of ball and goal in the frames of a lens by the networks. Prior knowledge restricts
    the search as in the OpenCV detector.
    """

    def __init__(
        self,
        lens: Fisheye,
        payload_radius: float,
        goal_side: float,
        params=None,
        networks: Networks | None = None,
    ):
        """Create a detector from lens, true sizes and networks, by default the shipped ones.

        Raises ValueError: the sides of the frame are not multiples of a cell.
        """
        super().__init__(lens, payload_radius, goal_side, params)
        if lens.params.height % CELL or lens.params.width % CELL:
            raise ValueError(
                f"frames of {lens.params.width} x {lens.params.height} px; expected multiples of"
                f" {CELL} px for the networks"
            )
        self.networks = networks or Networks.load()

    @torch.inference_mode()
    def detect(self, image: np.ndarray, prior: Prior | None = None) -> FrameDetections:
        """Detect ball and goal; see `camera.detectors.contours.Detector.detect`."""
        self.check(image)
        prior = prior or Prior()
        frames = torch.from_numpy(np.ascontiguousarray(image[..., ::-1]))[None]
        places = places_of(self.networks.search(halve(frames)), self.lens)
        north_c = (0.0, -1.0, 0.0) if prior.north_c is None else prior.north_c
        north = torch.tensor(north_c, dtype=torch.float32)
        ball, goal = (self._closest(kind, frames, *places[kind], north) for kind in KINDS)
        squares = self._squares(*goal, prior)
        best = squares[0] if squares else None
        return FrameDetections(self._best_ball(*ball, prior), best, squares)

    def _closest(
        self, kind: str, frames: Tensor, rays: Tensor, sizes: Tensor, north: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Refine places: return probabilities and balls or corners."""
        factor, offset, _ = self.networks.calibration[kind]
        places = (rays, sizes, self.lens, north)
        views, outputs, _, _ = look_closely(self.networks, kind, frames, *places)
        probability = torch.sigmoid(factor * outputs[:, 0] + offset)
        if kind == "ball":
            things = ball_of(views, outputs)
        else:
            things = corners_of(views, outputs)
        return probability, things

    def _best_ball(self, probability: Tensor, things: Tensor, prior: Prior) -> BallSeen | None:
        expected = (prior.ball_ray_c, prior.ball_within)
        probability = self._raise_near(probability, things[:, :3], *expected)
        for i in probability.argsort(descending=True).tolist():
            ray = things[i, :3].double().numpy()
            half_angle = float(things[i, 3])
            if probability[i] >= LEAST_PROBABILITY and self._is_in_place(ray, half_angle, prior):
                return BallSeen(ray, half_angle, float(probability[i]))
        return None

    def _squares(self, probability: Tensor, things: Tensor, prior: Prior) -> tuple[GoalSeen, ...]:
        """Return the squares that are certain, alone or near the expected position, the likeliest
        first. Their scores are the networks' probabilities, because the tracker accumulates frames.
        """
        middles = F.normalize(things.mean(1), dim=-1)
        expected = (prior.goal_ray_c, prior.goal_within)
        raised = self._raise_near(probability, middles, *expected)
        squares = []
        for i in probability.argsort(descending=True).tolist():
            rays = things[i].double().numpy()
            certain = max(probability[i], raised[i]) >= LEAST_PROBABILITY
            if certain and self._right_size(rays, prior):
                squares.append(GoalSeen(rays, float(probability[i])))
        return tuple(squares)

    def _raise_near(
        self, probability: Tensor, rays: Tensor, expected_c: np.ndarray | None, tolerance: float
    ) -> Tensor:
        """Update the networks' probabilities, which assume any position in the view, with an
        expected position.

        Bayes' rule: the odds are multiplied by the ratio of the normal density around the expected
        position to the uniform density over the view's solid angle."""
        if expected_c is None:
            return probability
        cosine = rays @ torch.from_numpy(expected_c).float()
        variance = (tolerance / GATE) ** 2
        angle = cosine.clamp(-1.0, 1.0).acos()
        density = (-0.5 / variance * angle**2).exp() / variance
        likelier = (1.0 - math.cos(self.lens.params.half_fov)) * density
        odds = probability / (1.0 - probability).clamp(min=1e-6) * likelier
        return odds / (1.0 + odds)


def look_closely(
    networks: Networks,
    kind: str,
    frame: Tensor,
    rays: Tensor,
    sizes: Tensor,
    lens: Fisheye,
    north: Tensor,
) -> tuple[Views, Tensor, Tensor, Tensor]:
    """Refine places of one frame. Return the patches, the outputs of the kind's network, shape (B,
    outputs), and the rays and sizes of `middle_of`.

    This is done twice: the second patch is centred on the object found in the first.
    """
    index = torch.zeros(len(rays), dtype=torch.long, device=rays.device)
    for _ in range(2):
        reach = (REACH[kind] * sizes).clamp(LEAST_REACH, 1.0)
        views = views_about(rays, reach, north.expand_as(rays))
        patches = patches_of(frame, index, views, lens, PATCH[kind])
        outputs = getattr(networks, kind)(patches)
        rays, sizes = middle_of(kind, views, outputs)
    return views, outputs, rays, sizes


def middle_of(kind: str, views: Views, outputs: Tensor) -> tuple[Tensor, Tensor]:
    """Return the rays to the objects' centres, shape (B, 3), and their sizes [rad], shape (B,)."""
    if kind == "ball":
        thing = ball_of(views, outputs)
        return thing[:, :3], thing[:, 3]
    corners = corners_of(views, outputs)
    middle = F.normalize(corners.mean(1), dim=-1)
    cosines = (corners @ middle[:, :, None])[..., 0]
    return middle, cosines.clamp(max=1.0 - 1e-7).acos().mean(1)


def corners_of(views: Views, outputs: Tensor) -> Tensor:
    """Return unit rays to the corners of squares, shape (B, 4, 3)."""
    return views.rays(outputs[:, 2:].unflatten(1, (4, 2)))


def ball_of(views: Views, outputs: Tensor) -> Tensor:
    """Return unit rays and half-angles [rad] of balls, shape (B, 4)."""
    ray = views.rays(outputs[:, None, 2:4])[:, 0]
    half_angle = views.reach / REACH["ball"] * outputs[:, 4].clamp(-3.0, 1.5).exp()
    return torch.cat([ray, half_angle[:, None].clamp(1e-3, 1.2)], -1)


def places_of(grids: Tensor, lens: Fisheye) -> dict[str, tuple[Tensor, Tensor]]:
    """Return kind -> likeliest places in one frame: rays (PLACES, 3), and sizes [rad] (PLACES,).

    Args:
        grids: of `FrameNetwork`, shape (1, 2, 4, h, w). lens: of the frame.
    """
    places = {}
    for k, kind in enumerate(KINDS):
        logits = grids[0, k, 0]
        peak = F.max_pool2d(logits[None, None], 3, 1, 1)[0, 0]
        peaks = torch.where(logits == peak, logits, -1e3)
        best = peaks.flatten().topk(PLACES).indices
        places[kind] = places_in(grids[:, k], torch.zeros_like(best), best, lens)
    return places


def places_in(grids: Tensor, frames: Tensor, cells: Tensor, lens: Fisheye) -> tuple[Tensor, Tensor]:
    """Return the unit rays (B, 3) and sizes [rad] (B,) that cells predict.

    Args:
        grids: of one kind, shape (F, 4, h, w). frames, cells: indices of the frame and of its cell,
            counted row by row, shape (B,).
        lens: of the frames.
    """
    width = grids.shape[-1]
    j = cells // width
    i = cells % width
    numbers = grids[frames, :, j, i]
    offset = numbers[:, 1:3].clamp(-1, 1)
    position = torch.stack([i, j], -1) + 0.5 + offset
    rays, _ = lens.unproject(position * CELL - 0.5)
    extent = numbers[:, 3].clamp(-6.0, 3.0).exp()  # in cells
    sizes = extent * (CELL / lens.params.fx)
    return F.normalize(rays, dim=-1), sizes


def log_size(angle: Tensor, lens: Fisheye) -> Tensor:
    """Convert sizes [rad] to the log sizes of `FrameNetwork`."""
    return (angle.clamp(min=1e-4) * (lens.params.fx / CELL)).log()


def spread_of(outputs: Tensor, views: Views) -> Tensor:
    """Return the standard deviation of a direction [rad], before calibration, shape (B,)."""
    return outputs[:, 1].clamp(-8.0, 3.0).exp() * views.reach
