"""Train the learnt detector on rendered frames, on the CPU or a GPU, and calibrate its confidences.

Frames are rendered during the training into a pool from which the oldest are dropped; each step
uses some frames of the pool. If rendering is cheap (on a GPU) every frame is new. In addition,
kornia varies colours and sharpness on the device."""

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from numpy import ndarray
from scipy.optimize import minimize
from tensordict import TensorDict
from torch import Tensor
from torch.nn import functional as F

from camera.detectors.learnt import (
    CELL,
    KINDS,
    LEAST_REACH,
    PATCH,
    REACH,
    Networks,
    Views,
    corners_of,
    halve,
    log_size,
    look_closely,
    patches_of,
    places_in,
    places_of,
    spread_of,
    views_about,
)
from camera.fisheye import Fisheye
from camera.params import CameraParams
from visthrow.config.bounds import Bound, Bounded, Positive, Share
from visthrow.detector_training.scenes.renderer import Renderer
from visthrow.detector_training.scenes.scene import Truth, lens_row, random_scenes, truth_of

Count = Annotated[int, Bound(1.0)]
STATES = ("networks", "optimizer", "rates")  # attributes of a `Fit` in its checkpoint
MATCH_RADIUS = 0.5  # largest distance of a correct detection, in sizes of the object


@dataclass(frozen=True)
class FitParams(Bounded):
    """Parameters of a training; a file of ``configs/detector``.

    Raises ValueError: a count below 1, or more fresh frames than the pool holds.
    """

    steps: Count
    batch: Count  # frames in a step
    patches: Count  # patches of each kind in a step
    fresh: Count  # frames in a rendered batch
    reuse: Count  # steps between rendered batches
    pool: Count  # capacity of the pool, in frames
    samples: Count  # rays for each pixel
    learning_rate: Positive  # the highest one, of a one-cycle schedule
    lenses: Share  # share of rendered batches with a different lens than the camera's
    calibration: Count  # frames for the calibration of confidences
    seed: int

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.fresh > self.pool:
            raise ValueError(
                f"detector: fresh is {self.fresh}; expected no more fresh frames than the pool"
                f" holds, {self.pool}"
            )


def labels_of(truth: Truth, things_c: Tensor, radius: float, device: str) -> TensorDict:
    """Return the labels of F frames, their true positions, float32 unless stated.

    ``rays`` by kind: unit ray to the centre, shape (F, 3); ``sizes`` by kind [rad], shape (F,);
    ``visible`` by kind: whether the whole object is in view, shape (F,), bool; ``corners``: unit
    rays, shape (F, 4, 3); ``north``: the world's x axis in the camera frame, shape (F, 3);
    ``distractor``: unit ray to another object, shape (F, 3).

    Args:
        truth: true positions in the scenes.
        things_c: position of another object [m], shape (F, 3), camera frame.
        radius: radius of the ball [m]. device: device of the labels.
    """
    corners = F.normalize(truth.corners_c, dim=-1)
    middle = F.normalize(corners.mean(1), dim=-1)
    sizes = {
        "ball": (radius / truth.ball_c.norm(dim=-1)).clamp(max=0.99).asin(),
        "goal": (corners @ middle[:, :, None])[..., 0].clamp(max=1.0).acos().mean(1),
    }
    places = {
        "rays": {"ball": truth.ball_ray, "goal": middle},
        "sizes": sizes,
        "corners": corners,
        "north": truth.rot_wc[:, 0],
        "distractor": F.normalize(things_c, dim=-1),
    }
    labels = TensorDict(places, batch_size=[len(corners)]).float()
    labels["visible"] = {"ball": truth.ball_visible, "goal": truth.goal_visible}
    return labels.to(device)


def draw_lens(lens, generator: torch.Generator):
    """Return a variant of a lens with random scale and distortion and the same picture size."""
    scale = (1.0 + 0.35 * torch.rand(1, generator=generator)).item()
    bend = (0.06 * torch.rand(1, generator=generator) - 0.04).item()
    reach = 0.98 * min(lens.width, lens.height) / 2.0 / (lens.fx * scale)
    half = min(lens.half_fov, 1.75)
    while half * (1.0 + bend * half * half) > reach:
        half *= 0.98
    return replace(
        lens, fx=lens.fx * scale, fy=lens.fy * scale, k1=bend, fov_deg=math.degrees(2.0 * half)
    )


def render_frames(
    camera: CameraParams, renderer: Renderer, count: int, seed: int
) -> tuple[Tensor, TensorDict, Fisheye]:
    """Render frames of random scenes; return frames, labels and lens."""
    lens = Fisheye(camera.fisheye)
    scenes = random_scenes(camera, renderer.textures, count, seed)
    row = lens_row(camera.fisheye)[:9].expand(count, -1)
    scenes = replace(scenes, lens=torch.cat([row, scenes.lens[:, 9:]], -1))
    truth = truth_of(scenes, lens)
    thing = scenes.things[:, 0, 1:4].double() - scenes.pose[:, :3].double()
    things_c = torch.einsum("eji,ej->ei", truth.rot_wc, thing)
    return (
        renderer.render(scenes, seed),
        labels_of(truth, things_c, camera.payload_radius, renderer.device),
        lens,
    )


def search_loss(grids: Tensor, labels: TensorDict, lens: Fisheye) -> Tensor:
    """Return the loss of the search: a focal loss around a soft peak, and errors of position and
    size in the peak's cell.

    Source: Zhou et al., "Objects as Points", 2019.
    """
    total = grids.new_zeros(())
    (height, width) = grids.shape[-2:]
    cells = torch.stack(
        torch.meshgrid(torch.arange(width), torch.arange(height), indexing="xy"), -1
    ).to(grids)
    for k, kind in enumerate(KINDS):
        pixels, visible = lens.project(labels["rays", kind])
        position = (pixels + 0.5) / CELL
        cell = position.floor().long()
        visible = visible & (cell >= 0).all(-1) & (cell[:, 0] < width) & (cell[:, 1] < height)
        cell = torch.where(visible[:, None], cell, 0)
        present = labels["visible", kind] & visible
        distance = (cells + 0.5 - position[:, None, None]).square().sum(-1)
        same_cell = (cells.long() == cell[:, None, None]).all(-1)
        soft = (
            torch.where(same_cell, 1.0, torch.exp(-distance / (2 * 0.7**2)))
            * present[:, None, None]
        )
        logits = grids[:, k, 0]
        probability = logits.sigmoid().clamp(1e-5, 1 - 1e-5)
        cut = visible & ~present  # partly in view: neither a positive nor a negative example
        counts = 1.0 - (cut[:, None, None] & (distance < 9.0)).float()
        negative = -((1 - soft) ** 4 * probability**2 * (1 - probability).log() * counts).sum(
            (1, 2)
        )
        rows = torch.arange(len(grids), device=grids.device)
        peak = grids[rows, k, :, cell[:, 1], cell[:, 0]]
        p = peak[:, 0].sigmoid().clamp(1e-5, 1 - 1e-5)
        positive = -((1 - p) ** 2 * p.log())
        off = (peak[:, 1:3] - (position - cell - 0.5)).abs().sum(-1)
        size_off = (peak[:, 3] - log_size(labels["sizes", kind], lens)).abs()
        total = total + (negative + present * (positive + off + 0.5 * size_off)).mean()
    return total


def looks(
    kind: str, labels: TensorDict, count: int, peaks: tuple[Tensor, Tensor], generator
) -> tuple[Tensor, ...]:
    """Return patches to examine, frame index, ray and size: half of them near the object, the
    others at other objects, at random, or at a peak of the search.

    Args:
        kind: kind of the object. labels: labels of the frames. count: number of patches.
        peaks: peaks of the search, rays (F, 3) and sizes (F,).
        generator: random generator on the labels' device.
    """
    device = labels["corners"].device
    draw = lambda *shape: torch.randn(*shape, generator=generator, device=device)  # noqa: E731
    index = torch.randint(len(labels["corners"]), (count,), generator=generator, device=device)
    size = labels["sizes", kind][index] * (0.25 * draw(count)).exp()
    ray = labels["rays", kind][index]
    ray = F.normalize(ray + 0.45 * size[:, None] * draw(count, 3), dim=-1)
    source = torch.randint(8, (count,), generator=generator, device=device)
    other_kind = "goal" if kind == "ball" else "ball"
    anywhere = F.normalize(draw(count, 3), dim=-1)
    anywhere[:, 2] = anywhere[:, 2].abs()
    peak, peak_size = (value[index] for value in peaks)
    candidates = (labels["distractor"][index], anywhere, labels["rays", other_kind][index], peak)
    for number, rays in enumerate(candidates, 4):
        ray = torch.where((source == number)[:, None], rays, ray)
    return index, ray, torch.where(source == 7, peak_size.clamp(5e-3, 0.5), size)


def offsets(
    kind: str, views: Views, detections: Tensor, labels: TensorDict, index: Tensor
) -> Tensor:
    """Return the errors of detections in half sides of the patch; for a ball the last column is the
    weighted error of the logarithm of its size.
    """
    if kind == "ball":
        size = (labels["sizes", "ball"][index] * REACH["ball"] / views.reach).log()
        point = views.points(labels["rays", "ball"][index, None])[:, 0]
        true = torch.cat([point, size[:, None]], -1)
        return (detections[:, 2:5] - true) * true.new_tensor([1.0, 1.0, 0.5])
    corners = views.points(labels["corners"][index])
    quadrants = corners.new_tensor([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    off = corners - corners.mean(1, keepdim=True)
    scores = [(off.roll(-k, 1) * quadrants).sum((1, 2)) for k in range(4)]
    match = torch.stack(scores, 1).argmax(1)
    order = (torch.arange(4, device=corners.device)[None] + match[:, None]) % 4
    corners = torch.gather(corners, 1, order[..., None].expand(-1, -1, 2))
    return detections[:, 2:] - corners.clamp(-3.0, 3.0).flatten(1)


class Fit:
    """A training of the detector.

    Attributes:
        step: number of finished steps. networks: the current networks.
    """

    def __init__(
        self,
        params: FitParams,
        camera: CameraParams,
        device: str,
        files: list[Path] | None,
    ):
        """Start with untrained networks.

        Args:
            params: parameters of the training. camera: the camera of the pictures.
            device: "cpu" or "cuda:0". files: photographs; default those for training.
        """
        import kornia.augmentation as augmentations

        torch.manual_seed(params.seed)
        self.params = params
        self.camera = camera
        self.device = device
        self.networks = Networks().to(device)
        self.renderer = Renderer(camera.fisheye, device, files, params.samples)
        # frames with labels and lens, the oldest first
        self.pool = deque(maxlen=max(params.pool // params.fresh, 1))
        self.optimizer = torch.optim.AdamW(
            self.networks.parameters(), params.learning_rate, weight_decay=1e-4
        )
        self.rates = torch.optim.lr_scheduler.OneCycleLR(
            self.optimizer, params.learning_rate, params.steps + 1, pct_start=0.1
        )
        self._vary = augmentations.AugmentationSequential(
            augmentations.ColorJiggle(0.25, 0.3, 0.3, 0.03, p=0.7),
            augmentations.RandomGaussianBlur((3, 3), (0.3, 1.0), p=0.2),
            augmentations.RandomGaussianNoise(std=0.03, p=0.3),
            data_keys=["input"],
        )
        self.step = 0

    def augment(self, pictures: Tensor) -> Tensor:
        """Return pictures, -1 to 1, with random changes of colour, blur and noise."""
        return self._vary((pictures + 1.0) * 0.5) * 2.0 - 1.0

    def advance(self) -> dict[str, float]:
        """Do one training step and return its losses."""
        p = self.params
        seed = p.seed * 7_000_003 + self.step
        generator = torch.Generator(self.device).manual_seed(seed)
        host = torch.Generator().manual_seed(seed)
        if self.step % p.reuse == 0 or not self.pool:
            self.pool.append(self._render())
        frames, labels, lens = self.pool[int(torch.randint(len(self.pool), (1,), generator=host))]
        chosen = torch.randperm(len(frames), generator=host)[: p.batch].to(self.device)
        frames = frames[chosen]
        labels = labels[chosen]
        grids = self.networks.search(self.augment(halve(frames)))
        losses = {"search": search_loss(grids, labels, lens)}
        for k, kind in enumerate(KINDS):
            peaks = _peaks(grids[:, k].detach(), lens)
            places = looks(kind, labels, p.patches, peaks, generator)
            losses[kind] = self.look_loss(kind, frames, labels, lens, places, generator)
        self.optimizer.zero_grad()
        sum(losses.values()).backward()
        torch.nn.utils.clip_grad_norm_(self.networks.parameters(), 1.0)
        self.optimizer.step()
        self.rates.step()
        self.step += 1
        return {name: float(value.detach()) for name, value in losses.items()}

    def _render(self) -> tuple[Tensor, TensorDict, Fisheye]:
        """Render new frames for the pool."""
        p = self.params
        seed = p.seed * 1_000_003 + self.step
        generator = torch.Generator().manual_seed(seed)
        lens = self.camera.fisheye
        if torch.rand(1, generator=generator).item() < p.lenses:
            lens = draw_lens(lens, generator)
        return render_frames(replace(self.camera, fisheye=lens), self.renderer, p.fresh, seed)

    def look_loss(
        self, kind: str, frames: Tensor, labels: TensorDict, lens: Fisheye, places, generator
    ) -> Tensor:
        """Return the loss of patches of one kind: presence of the object, position, size, and
        predicted accuracy.
        """
        index, ray, size = places
        north = labels["north"][index] + 0.15 * torch.randn(
            len(index), 3, generator=generator, device=ray.device
        )
        views = views_about(ray, (REACH[kind] * size).clamp(LEAST_REACH, 1.0), north)
        patches = patches_of(frames, index, views, lens, PATCH[kind])
        outputs = getattr(self.networks, kind)(self.augment(patches))
        true = labels["rays", kind][index]
        point = views.points(true[:, None])[:, 0]
        radius = point.norm(dim=-1)
        in_front = (views.axes[:, 2] * true).sum(-1) > 0.2
        ratio = (labels["sizes", kind][index] / size).log().abs()
        present = labels["visible", kind][index] & in_front & (radius < 0.75) & (ratio < 0.8)
        absent = ~in_front | (radius > 1.2)
        judged = present | absent
        loss = F.binary_cross_entropy_with_logits(outputs[:, 0], present.float(), reduction="none")
        loss = (loss * judged).sum() / judged.sum().clamp(min=1)
        off = offsets(kind, views, outputs, labels, index)
        where = off.abs().mean(1)
        if kind == "ball":
            error = off[:, :2].norm(dim=-1)
        else:
            error = off.unflatten(1, (4, 2)).norm(dim=-1).mean(1)
        spread = outputs[:, 1].clamp(-8.0, 3.0)
        # negative log likelihood of a Laplace distribution
        accuracy = (error.detach() / spread.exp()).clamp(max=50.0) + spread
        present = present.float()
        return loss + ((8.0 * where + 0.2 * accuracy) * present).sum() / present.sum().clamp(min=1)

    def run(
        self,
        tell: Callable[[int, dict[str, float]], None],
        until: float = math.inf,
        saved: Path | None = None,
    ) -> bool:
        """Train to the end or up to a time; return whether the training is finished.

        Args:
            tell: called with step and losses, periodically.
            until: time limit on `time.monotonic` [s].
            saved: checkpoint, written periodically and at the end.
        """
        begin = time.monotonic()
        while self.step < self.params.steps and time.monotonic() < until:
            losses = self.advance()
            if self.step % 50 == 0 or self.step == self.params.steps:
                tell(self.step, losses)
            if saved is not None and time.monotonic() - begin > 60.0:
                self.save(saved)
                begin = time.monotonic()
        if saved is not None:
            self.save(saved)
        return self.step >= self.params.steps

    def save(self, path: Path) -> None:
        """Write a checkpoint, whole or not at all."""
        states = {name: getattr(self, name).state_dict() for name in STATES}
        part = path.with_suffix(".part")
        torch.save(states | {"step": self.step}, part)
        part.replace(path)

    def load(self, path: Path) -> None:
        """Restore a checkpoint; the pool starts empty.

        Raises ValueError: the file is not a checkpoint of such a training.
        """
        try:
            saved = torch.load(path, map_location=self.device, weights_only=True)
            for name in STATES:
                getattr(self, name).load_state_dict(saved[name])
            self.step = saved["step"]
        except Exception as error:  # torch raises various errors for other files
            raise ValueError(f"{path}: not a checkpoint of this training: {error}") from error

    @torch.no_grad()
    def calibrate(self) -> dict[str, dict[str, float]]:
        """Calibrate probabilities and accuracies on detections in frames that were not used for
        training; return the figures.
        """
        self.networks.eval()
        samples = {kind: [] for kind in KINDS}
        total = self.params.calibration
        for first in range(0, total, 16):
            count = min(16, total - first)
            frames, labels, lens = render_frames(
                self.camera, self.renderer, count, 900_000_001 + first
            )
            for e in range(count):
                one = labels[e : e + 1]
                scores = findings(self.networks, frames[e : e + 1], one, lens)
                for kind, rows in scores.items():
                    samples[kind].append(rows)
        figures = {}
        for kind in KINDS:
            rows = torch.cat(samples[kind]).cpu().double()
            factor, offset = platt(rows[:, 0], rows[:, 1])
            hits = rows[rows[:, 1] > 0.5]
            if len(hits):
                scale = float((hits[:, 2] / hits[:, 3]).median() / math.log(2.0))
            else:
                scale = 1.0
            self.networks.calibration[kind] = (factor, offset, scale)
            figures[kind] = {
                "places": len(rows),
                "hits": len(hits),
                "factor": factor,
                "offset": offset,
                "accuracy": scale,
            }
        return figures


def findings(
    networks: Networks, frame: Tensor, labels: TensorDict, lens: Fisheye
) -> dict[str, Tensor]:
    """Score the detections in one frame, one row for each: logit, whether it is correct, error
    [rad], predicted accuracy [rad].
    """
    places = places_of(networks.search(halve(frame)), lens)
    scores = {}
    for kind in KINDS:
        rays, sizes = places[kind]
        views, out, rays, sizes = look_closely(
            networks, kind, frame, rays, sizes, lens, labels["north"]
        )
        error = _angle_between(rays, labels["rays", kind])
        size = labels["sizes", kind]
        visible = labels["visible", kind]
        hit = visible & (error < MATCH_RADIUS * size) & ((sizes / size).log().abs() < 0.5)
        # not near an object that may be partly in view
        clear = visible | (error > 2.0 * size)
        if kind == "goal":
            first = corners_of(views, out)[:, 0:1]
            error = _angle_between(first, labels["corners"]).amin(-1)
        rows = torch.stack([out[:, 0], hit.float(), error, spread_of(out, views)], -1)
        scores[kind] = rows[clear.expand(len(rows))]
    return scores


def platt(logits: Tensor, hits: Tensor) -> tuple[float, float]:
    """Return factor and offset that calibrate logits as probabilities.

    Source: Platt, "Probabilistic outputs for support vector machines", 1999, with a weak prior at 1
    and 0."""

    def loss(weights: ndarray) -> float:
        logit = weights[0] * logits.numpy() + weights[1]
        prior = 0.25 * ((weights - start) ** 2).sum()
        return (np.logaddexp(0.0, logit) - hits.numpy() * logit).sum() + prior

    start = np.array([1.0, 0.0])
    factor, offset = minimize(loss, start).x
    return float(factor), float(offset)


def _angle_between(rays: Tensor, references: Tensor) -> Tensor:
    """Return the angles between unit rays [rad], accurate for small angles."""
    sine = torch.linalg.cross(*torch.broadcast_tensors(rays, references)).norm(dim=-1)
    return torch.atan2(sine, (rays * references).sum(-1))


def _peaks(grids: Tensor, lens: Fisheye) -> tuple[Tensor, Tensor]:
    """Return ray and size of a random one of the three likeliest cells in each frame, for grids
    (F, 4, h, w) of one kind.
    """
    best = grids[:, 0].flatten(1).topk(3, dim=1).indices
    best = best.gather(1, torch.randint(3, (len(best), 1), device=best.device))[:, 0]
    return places_in(grids, torch.arange(len(grids), device=grids.device), best, lens)
