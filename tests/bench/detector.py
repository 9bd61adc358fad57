"""Recall, precision and pixel error of the keypoint detector on rendered frames, by nuisance."""

import argparse
import functools
import math
import os
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from camera.detectors.contours import Detector, Known, Seen, detected_keypoints
from camera.keypoints import GOAL_KEYPOINTS, KeypointCamera, keypoints
from camera.mount import rotation_from_vector
from camera.params import CameraParams
from tests.bench import start
from tests.bench.nuisance import NuisanceParams, degrade
from tests.drawn import Clutter, render_scene
from visthrow import config
from visthrow.common.arguments import add_common
from visthrow.common.errors import VisthrowError
from visthrow.common.workers import done
from visthrow.evidence.bench.records import Report, Table, finish

LEVELS = {
    "clean": NuisanceParams(),
    "blur": NuisanceParams(blur=1.5, motion=5.0),
    "noise": NuisanceParams(noise=0.06),
    "light": NuisanceParams(gain=1.0, gradient=0.5, tint=0.1),
    "clutter": NuisanceParams(clutter=8),
    "occlusion": NuisanceParams(occlusion=0.6),
    "all, half": NuisanceParams(0.75, 2.5, 0.03, 0.5, 0.25, 0.05, 4, 0.3),
    "all": NuisanceParams(1.5, 5.0, 0.06, 1.0, 0.5, 0.1, 8, 0.6),
}
"""Nuisances one by one, and together."""

KNOWN = ("nothing", "pose", "pose and track")
"""What the detector is told: nothing; attitude and height, and how far the ball can be while it hangs; these and where the
ball was a frame ago, which is simulated by its true place some degrees off."""
TOLD = {"clutter": KNOWN, "all, half": KNOWN, "all": KNOWN}
"""Levels on which it matters; on the others all is told."""
HANGING = (0.25, 0.55)
"""Distances of a hanging ball from the lens [m]."""
TRACK_ERROR = math.radians(4.0)
"""Of the ball's direction by the frame before [rad]: 20 ms at 3.5 rad/s."""

HIT = 4.0
"""A detection whose keypoints are off by more than this on average found something else [px]."""
SUPERSAMPLE = 2
ROPE = 0.38
"""From the lens to the ball while it hangs, about [m]."""


@dataclass(frozen=True)
class Scene:
    """One random moment of a throw."""

    pos_w: torch.Tensor  # of the vehicle [m], shape (1, 3)
    rot_wb: torch.Tensor  # shape (1, 3, 3)
    goal_w: torch.Tensor  # [m], shape (1, 2)
    ball_w: torch.Tensor  # [m], shape (1, 3)
    hangs: bool
    clutter: tuple[Clutter, ...]


@dataclass
class Count:
    """What became of one kind of thing on one level."""

    there: int = 0
    hits: int = 0
    reports: int = 0
    errors: list[float] = field(default_factory=list)  # of each keypoint of the hits [px]

    def add(self, other: "Count") -> None:
        """Count what another one counted as well."""
        self.there += other.there
        self.hits += other.hits
        self.reports += other.reports
        self.errors += other.errors

    def figures(self) -> dict[str, float]:
        """Recall, precision, and RMS, median and 95th percentile of the pixel error."""
        errors = np.array(self.errors) if self.errors else np.array([math.nan])
        return {
            "recall": self.hits / max(self.there, 1), "precision": self.hits / max(self.reports, 1), "visible": self.there,
            "rms_px": float(np.sqrt(np.mean(errors**2))), "median_px": float(np.median(errors)),
            "p95_px": float(np.percentile(errors, 95)),
        }  # fmt: skip


Counts = dict[str, dict[str, Count]]
"""Of ball and goal by "level; told what"."""


def draw_scene(rng: np.random.Generator, clutter: int) -> Scene:
    """Draw a moment of a throw: hanging or thrown ball, level or steep vehicle, goal within 2.2 m."""
    height = rng.uniform(0.9, 2.2)
    pos = np.array([rng.uniform(-0.3, 0.8), rng.uniform(-0.3, 0.3), height])
    tilt = rng.uniform(0.0, math.radians(45.0)) * np.array([*_direction(rng), 0.0])
    rot = rotation_from_vector(torch.tensor([[tilt[0], tilt[1], rng.uniform(-0.35, 0.35)]], dtype=torch.float64))
    goal = pos[:2] + rng.uniform(0.0, 2.2) * _direction(rng)
    lean = rng.uniform(0.0, math.radians(60.0))
    way = np.array([*(math.sin(lean) * _direction(rng)), -math.cos(lean)])
    thrown = rng.random() < 0.3
    ball = pos + way * (rng.uniform(0.5, 1.5) if thrown else ROPE)
    ball[2] = max(ball[2], 0.05)
    things = tuple(_clutter(rng, pos, goal, ball, i % 2 == 0) for i in range(clutter))
    tensors = [torch.tensor(v[None], dtype=torch.float64) for v in (pos, goal, ball)]
    return Scene(tensors[0], rot, tensors[1], tensors[2], not thrown, things)


def _direction(rng: np.random.Generator) -> np.ndarray:
    angle = rng.uniform(0.0, 2.0 * math.pi)
    return np.array([math.cos(angle), math.sin(angle)])


def _clutter(rng: np.random.Generator, pos: np.ndarray, goal: np.ndarray, ball: np.ndarray, alike: bool) -> Clutter:
    """Something of any colour, or of one like the ball's or the goal's; not on the goal, and not before the ball."""
    similar = (np.array([0.75, 0.80, 0.25]), np.array([0.20, 0.50, 0.28]), np.array([0.85, 0.75, 0.20]))
    colour = similar[rng.integers(3)] + rng.uniform(-0.06, 0.06, 3) if alike else rng.uniform(0.05, 0.95, 3)
    shape = ("disc", "rectangle", "ball")[rng.integers(3)]
    while True:
        place = pos[:2] + rng.uniform(0.0, 3.0) * _direction(rng)
        if np.linalg.norm(place - goal) > 0.45:
            break
    if shape == "ball" and np.linalg.norm(pos - ball) > ROPE + 0.01:
        shape = "disc"  # it might stand before a ball in flight
    size = rng.uniform(0.03, 0.25, 2) if shape == "rectangle" else np.repeat(rng.uniform(0.02, 0.15), 2)
    height = float(rng.uniform(size[0], 0.4)) if shape == "ball" else 0.0
    return Clutter(shape, (*place.tolist(), height), tuple(size.tolist()), float(rng.uniform(0, math.pi)),
                   tuple(np.clip(colour, 0, 1).tolist()))  # fmt: skip


class Measure:
    """Renders, degrades, detects and counts."""

    def __init__(self, params: CameraParams, seed: int) -> None:
        """Take the camera of training."""
        self.camera, self.seed = KeypointCamera(params, dtype=torch.float64), seed
        self.detector = Detector(self.camera.fisheye, params.payload_radius, params.goal_side)
        self.spent: list[float] = []

    def scene(self, index: int, clutter: int) -> tuple[Scene, np.ndarray]:
        """A random scene and its picture, RGB in [0, 1]; the same index gives the same scene but for the clutter."""
        scene = draw_scene(np.random.default_rng([self.seed, index]), clutter)
        camera, p = self.camera, self.camera.params
        eye = scene.pos_w[0] + scene.rot_wb[0] @ camera.position_b
        picture = render_scene(
            camera.fisheye, eye, scene.rot_wb[0] @ camera.rot_cb.T, scene.goal_w[0], scene.ball_w[0], p.payload_radius,
            p.goal_side, SUPERSAMPLE, scene.clutter,
        )  # fmt: skip
        return scene, picture.numpy()

    def frames(self, index: int) -> Iterator[tuple[str, Scene, np.ndarray]]:
        """Name of each level, the scene of an index, and its frame on that level; rendered once for all that share it."""
        rendered: dict[int, tuple[Scene, np.ndarray]] = {}
        for name, level in LEVELS.items():
            if level.clutter not in rendered:
                rendered[level.clutter] = self.scene(index, level.clutter)
            scene, picture = rendered[level.clutter]
            box = self.pixels(self.truth(scene)[0])[GOAL_KEYPOINTS:]
            ball = (*box.mean(axis=0), 0.5 * (box[2, 0] - box[0, 0]))
            yield name, scene, degrade(picture, level, np.random.default_rng([self.seed, index, 1]), ball)

    def truth(self, scene: Scene) -> tuple[torch.Tensor, torch.Tensor]:
        """Keypoints of a scene, shape (8, 2), and validity."""
        points, valid = keypoints(self.camera, scene.pos_w, scene.rot_wb, scene.goal_w, scene.ball_w)
        return points[0], valid[0]

    def pixels(self, points: torch.Tensor) -> np.ndarray:
        """Pixels of normalised keypoints."""
        return self.camera.fisheye.denormalize(points.double()).numpy()

    def known(self, scene: Scene, told: str, index: int) -> Known:
        """What the detector is told of a scene; see `KNOWN`."""
        if told == KNOWN[0]:
            return Known()
        camera = self.camera
        rot_cw = camera.rot_cb @ scene.rot_wb[0].T
        eye = scene.pos_w[0] + scene.rot_wb[0] @ camera.position_b
        distance = HANGING if scene.hangs else None
        ray = None
        if told == KNOWN[2]:
            ball = (rot_cw @ (scene.ball_w[0] - eye)).numpy()
            off = TRACK_ERROR * np.random.default_rng([self.seed, index, 2]).standard_normal(3)
            ray = ball / np.linalg.norm(ball) + off / math.sqrt(2.0)
            ray = ray / np.linalg.norm(ray)
        return Known(rot_cw[:, 2].numpy(), float(eye[2]), distance, ray)

    def see(self, scene: Scene, frame: np.ndarray, known: Known) -> tuple[Seen, torch.Tensor, torch.Tensor]:
        """Detect; what was seen, its keypoints, shape (8, 2), and their validity."""
        begin = time.perf_counter()
        seen = self.detector.detect(frame, known)
        self.spent.append(time.perf_counter() - begin)
        return seen, *detected_keypoints(self.camera, seen, scene.rot_wb[0].numpy())

    def count(self, scene: Scene, frame: np.ndarray, known: Known, counts: dict[str, Count]) -> None:
        """Detect in one frame and count what became of ball and goal."""
        points, valid = self.truth(scene)
        seen, found, _ = self.see(scene, frame, known)
        off = np.linalg.norm(self.pixels(found) - self.pixels(points), axis=1)
        for name, part in (("ball", slice(GOAL_KEYPOINTS, None)), ("goal", slice(0, GOAL_KEYPOINTS))):
            tally, reported, visible = counts[name], getattr(seen, name) is not None, bool(valid[part].all())
            tally.there += visible
            tally.reports += reported
            if reported and visible and off[part].mean() < HIT:
                tally.hits += 1
                tally.errors += off[part].tolist()

    def counted(self, index: int) -> tuple[Counts, list[float]]:
        """What became of ball and goal of one scene on every level, and the times that its detections took [s]."""
        counts, before = {}, len(self.spent)
        for name, scene, frame in self.frames(index):
            for told in TOLD.get(name, KNOWN[-1:]):
                pair = counts.setdefault(f"{name}; {told}", {"ball": Count(), "goal": Count()})
                self.count(scene, frame, self.known(scene, told, index), pair)
        return counts, self.spent[before:]

    def sheet(self, path: Path, columns: int = 4) -> None:
        """Draw what was found on the first scenes of each level: true keypoints as white circles, found ones coloured."""
        import cv2

        from camera.imaging.overlay import draw_overlay

        pictures: dict[str, list[np.ndarray]] = {name: [] for name in LEVELS}
        for index in range(columns):
            for name, scene, frame in self.frames(index):
                points, valid = self.truth(scene)
                _, found, ok = self.see(scene, frame, self.known(scene, KNOWN[-1], index))
                picture = draw_overlay(self.camera, found, ok, frame, name)
                for (u, v), there in zip(self.pixels(points), valid):
                    if there:
                        cv2.circle(picture, (round(u), round(v)), 6, (255, 255, 255), 1, cv2.LINE_AA)
                pictures[name].append(picture)
        if not cv2.imwrite(str(path), np.vstack([np.hstack(row) for row in pictures.values()])):
            raise OSError(f"cannot write {path}")


def levels(measure: Measure, count: int, jobs: int = 1) -> dict[str, dict[str, dict[str, float]]]:
    """Figures of ball and goal on every level; keys as in `Counts`.

    Args:
        measure: the camera; takes the times of all detections.
        count: scenes a level. jobs: processes at once; the figures do not depend on it.
    """
    total: Counts = {}
    found = dict(done(functools.partial(_counted, measure.camera.params, measure.seed), range(count), jobs))
    for index in range(count):
        counts, spent = found[index]
        measure.spent += spent
        for name, pair in counts.items():
            for kind, tally in pair.items():
                total.setdefault(name, {}).setdefault(kind, Count()).add(tally)
    return {name: {kind: tally.figures() for kind, tally in pair.items()} for name, pair in total.items()}


def _counted(params: CameraParams, seed: int, index: int) -> tuple[Counts, list[float]]:
    return Measure(params, seed).counted(index)


def run(args: argparse.Namespace) -> int:
    """Measure on every level.

    Raises:
        VisthrowError: a number of scenes or processes below one, or nowhere to write to.
    """
    jobs = (os.cpu_count() or 1) if args.jobs is None else args.jobs
    if min(args.frames, jobs) < 1:
        raise VisthrowError(f"--frames {args.frames}, --jobs {jobs}; expected 1 or more of each")
    if args.out is not None:
        _require_place(Path(args.out))
    params = config.load(CameraParams, config.find("camera", "fisheye"), args.overrides)
    measure = Measure(params, args.seed)
    figures = levels(measure, args.frames, jobs)
    rows = [_row(name, kind, values) for name, pair in figures.items() for kind, values in pair.items()]
    table = Table(
        f"{args.frames} frames a level, {params.fisheye.width} x {params.fisheye.height} px",
        ("level", "known", "what", "visible", "recall", "precision", "median error", "rms", "p95"), tuple(rows),
    )  # fmt: skip
    if args.out is not None:
        measure.sheet(Path(args.out))
    pixel = 1.0 / (params.fisheye.fx * measure.camera.fisheye.edge_radius)
    notes = (
        f"a hit is off by less than {HIT:g} px on average; errors are of single keypoints of the hits",
        f"1 px is {pixel:.4f} of normalised coordinates; training adds noise of {params.noise.step_std:g}",
        f"detection took {1e3 * float(np.median(measure.spent)):.0f} ms a frame, median, on a CPU",
        "frames are rendered by the project's own projection: no real lens, no real light",
    )
    return finish(Report("detector", "Keypoint detector on rendered frames", (table,), notes, figures), args)


def _require_place(path: Path) -> None:
    """Refuse a picture that could not be written, before a quarter of an hour is spent on it.

    Raises:
        VisthrowError: no .png, or a folder that cannot be made or written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise VisthrowError(f"--out {path}: {error.strerror}; expected a .png in a folder that can be written") from error
    if path.suffix != ".png" or not os.access(path.parent, os.W_OK):
        raise VisthrowError(f"--out {path}; expected a .png in a folder that can be written")


def _row(level: str, kind: str, f: dict[str, float]) -> tuple[str, ...]:
    errors = (f"{f[key]:.2f} px" for key in ("median_px", "rms_px", "p95_px"))
    return (*level.split("; "), kind, f"{f['visible']:.0f}", f"{f['recall']:.3f}", f"{f['precision']:.3f}", *errors)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = start.parser_of(__doc__)
    parser.add_argument("--frames", type=int, default=100, metavar="N", help="scenes a level (default: 100)")
    parser.add_argument("--seed", type=int, default=0, help="of the scenes")
    parser.add_argument("--jobs", type=int, metavar="N", help="processes at once (default: one a core)")
    parser.add_argument("--out", metavar="FILE", help="write a contact sheet of the first scenes there, .png")
    add_common(parser, device=False, json=False)
    return start.main(parser, run, argv)


if __name__ == "__main__":
    sys.exit(main())
