"""The learnt keypoint detector beside OpenCV's: recall and pixel error by nuisance, in rendered
frames.

``python -m bench.detector --frames 24 --device cpu``."""

import argparse
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bench import start
from bench.common_options import add_common
from camera.detectors.contours import Detector, Prior, convert_to_training_keypoints
from camera.detectors.learnt import SHIPPED, LearntDetector, Networks
from camera.fisheye import Fisheye
from camera.keypoints import GOAL_KEYPOINTS, KeypointCamera, payload_keypoints
from camera.mount import nominal_rot_cb
from camera.overlay import draw_overlay
from camera.params import CameraParams
from visthrow import config
from visthrow.common.arguments import WHOLE
from visthrow.common.compute_device import resolve
from visthrow.common.errors import VisthrowError
from visthrow.common.storage import atomic_write, write_json
from visthrow.detector_training.eyes import HANGING
from visthrow.detector_training.scenes.renderer import Renderer
from visthrow.detector_training.scenes.scene import Nuisances, random_scenes, truth_of
from visthrow.detector_training.scenes.textures import HELD_OUT, TRAINING, photographs

LEVELS = {
    "clean": {},
    "blur": {"blur": 1.0},
    "motion": {"motion": 1.0},
    "noise": {"noise": 1.0},
    "light": {"light": 1.0},
    "colours": {"look": 1.0},
    "photographs": {"ground": 1.0},
    "clutter": {"clutter": 1.0},
    "rope": {"parts": 1.0},
    "all, half": dict.fromkeys(
        ("blur", "motion", "noise", "light", "look", "ground", "clutter", "parts"), 0.5
    ),
    "all": dict.fromkeys(
        ("blur", "motion", "noise", "light", "look", "ground", "clutter", "parts"), 1.0
    ),
}
"""Nuisances one by one, and together."""

OTHER_LENS = "all, half; another lens"
LEVELS[OTHER_LENS] = LEVELS["all, half"]
BENT = {"fx": 232.0, "fy": 232.0, "k1": 0.05, "k2": -0.006, "fov_deg": 145.0}
"""A lens outside the training's range: focal length 1.4 times (training: up to 1.35), distortion
0.05 outwards (training: up to 0.02).
"""

HIT = 4.0  # a detection whose points are off by more than this on average is of something else [px]

PRIORS = ("nothing", "pose", "track")
"""Inputs of the detectors besides the image: none; attitude and height; also the ball's position in
the last frame, and its distance limit while it hangs. The runner passes all of them.
"""

# change of the ball's direction since the last frame [rad]: 20 ms at 3.5 rad/s
TRACK_ERROR = math.radians(4.0)


def run(args: argparse.Namespace) -> None:
    """Detect in frames of each nuisance with both detectors and print what became of them;
    VisthrowError for numbers that make no sense.
    """

    if args.frames < 1 or Path(args.out or "sheet.png").suffix != ".png":
        raise VisthrowError(
            f"--frames {args.frames}, --out {args.out}; expected 1 or more, and a .png"
        )
    camera = config.load(CameraParams, config.find("camera", "fisheye"), args.overrides)
    renderer = Renderer(camera.fisheye, resolve(args.device), photographs(args.textures, HELD_OUT))
    networks = Networks.load(args.weights or SHIPPED)
    table = {}
    rows = []

    def detectors_of(camera: CameraParams) -> dict[str, Detector]:
        parts = Fisheye(camera.fisheye), camera.payload_radius, camera.goal_side
        return {"learnt": LearntDetector(*parts, networks=networks), "opencv": Detector(*parts)}

    detectors = detectors_of(camera)
    for level, nuisances in LEVELS.items():
        if level == OTHER_LENS:
            camera = replace(camera, fisheye=replace(camera.fisheye, **BENT))
            detectors = detectors_of(camera)
        table[level], pictures = count_detections(
            camera, renderer, detectors, nuisances, args.frames, args.seed, args.known
        )
        rows.append(pictures)
        _print(level, table[level], first=len(rows) == 1)
    table["neither"] = find_mistakes(detectors)
    print(
        f"of {table['neither']['looks']} looks at photographs with neither: "
        + ", ".join(
            f"{name} reported {table['neither'][name]['ball']} balls and"
            f" {table['neither'][name]['goal']} squares"
            for name in detectors
        )
    )
    if args.out is not None:
        atomic_write(
            args.out, cv2.imencode(".png", np.vstack([np.hstack(row) for row in rows]))[1].tobytes()
        )
    if args.json is not None:
        write_json(args.json, table)


def find_mistakes(detectors: dict) -> dict[str, Any]:
    """Balls and squares that detectors report in photographs that show neither, nine crops of each;
    without any prior input.
    """

    counts: dict[str, Any] = {"looks": 0} | {name: {"ball": 0, "goal": 0} for name in detectors}
    for path in photographs(names=TRAINING + HELD_OUT):
        picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
        height = picture.shape[0] * 2 // 3
        width = picture.shape[1] * 2 // 3
        for k in range(9):
            top = (picture.shape[0] - height) * (k // 3) // 2
            column = (picture.shape[1] - width) * (k % 3) // 2
            cut = cv2.resize(
                picture[top : top + height, column : column + width],
                (640, 640),
                interpolation=cv2.INTER_AREA,
            )
            counts["looks"] += 1
            for name, detector in detectors.items():
                detection = detector.detect(np.ascontiguousarray(cut))
                for kind in ("ball", "goal"):
                    counts[name][kind] += getattr(detection, kind) is not None
    return counts


def figures_of(
    rows: list[tuple[str, bool, bool, float, float]], spent: list[float]
) -> dict[str, float]:
    """Recall, precision, median and 95th percentile of the pixel error by kind; median time [s];
    mean probability less the hits.

    Args:
        rows: of each frame and kind: the kind, whether it was in view, whether it was reported, the
            mean error of its points [px], and the reported probability.
        spent: times of the frames [s].
    """
    figures: dict[str, float] = {}
    hits = np.array([visible and reported and off < HIT for _, visible, reported, off, _ in rows])
    _, presence, reports, errors, probabilities = map(np.array, zip(*rows))
    for kind in ("ball", "goal"):
        of_kind = np.array([row[0] == kind for row in rows])
        off = errors[of_kind & hits] if np.any(of_kind & hits) else np.array([math.nan])
        visible, reported, hit = (
            int(np.sum(of_kind & selected)) for selected in (presence, reports, hits)
        )
        figures |= {
            f"{kind}_there": visible,
            f"{kind}_recall": hit / max(visible, 1),
            f"{kind}_precision": hit / max(reported, 1),
            f"{kind}_median_px": float(np.median(off)),
            f"{kind}_p95_px": float(np.percentile(off, 95)),
        }
    if np.any(reports):
        ratio = float(probabilities[reports].mean() - hits[reports].mean())
    else:
        ratio = math.nan
    return figures | {"seconds": float(np.median(spent)), "overconfidence": ratio}


def prior_of(prior: str, truth, height: float, e: int, rng: np.random.Generator):
    """Return a detector's prior knowledge of scene e; see :data:`PRIORS`."""

    rot_wc = truth.rot_wc[e].numpy()
    distance = float(truth.ball_c[e].norm())
    pose = {"up_c": rot_wc[2], "height": height, "north_c": rot_wc[0]} if prior != "nothing" else {}
    if prior != "track":
        return Prior(**pose)
    ray = truth.ball_ray[e].numpy() + TRACK_ERROR / math.sqrt(2.0) * rng.standard_normal(3)
    return Prior(
        **pose,
        ball_ray_c=ray / np.linalg.norm(ray),
        ball_distance=HANGING if distance < HANGING[1] else None,
    )


def count_detections(
    camera,
    renderer,
    detectors: dict,
    nuisances: dict[str, float],
    frames: int,
    seed: int,
    prior: str,
) -> tuple[dict[str, dict[str, float]], list]:
    """Figures of each detector in random frames, and pictures of the first four with what the first
    detector found.
    """

    lens = Fisheye(camera.fisheye)
    eyes = KeypointCamera(replace(camera, noise=replace(camera.noise, invalid_reads="edge")))
    none = dict.fromkeys(Nuisances.__dataclass_fields__, 0.0)
    rows = {name: [] for name in detectors}
    spent = {name: [] for name in detectors}
    pictures = []
    for first in range(0, frames, 8):
        number = 7_000_000 + 1000 * seed + first
        scenes = random_scenes(
            camera, renderer.textures, min(8, frames - first), number, Nuisances(**none | nuisances)
        )
        truth = truth_of(scenes, lens)
        images = renderer.render(scenes, seed).cpu().numpy()
        corners, _ = lens.project(truth.corners_c)
        box, _ = payload_keypoints(eyes, truth.ball_c.float())
        true = np.concatenate([corners.numpy(), lens.denormalize(box).numpy()], 1)
        for e, image in enumerate(images[..., ::-1]):
            rot_wc = truth.rot_wc[e].numpy()
            knows = prior_of(
                prior, truth, float(scenes.pose[e, 2]), e, np.random.default_rng([number, e])
            )
            for name, detector in detectors.items():
                begin = time.perf_counter()
                detection = detector.detect(image, knows)
                spent[name].append(time.perf_counter() - begin)
                points, valid = convert_to_training_keypoints(
                    eyes, detection, rot_wc @ nominal_rot_cb(camera.mount).numpy()
                )
                off = np.linalg.norm(lens.denormalize(points).numpy() - true[e], axis=1)
                rows[name] += _rows_of(detection, truth, e, off)
                if name == next(iter(detectors)) and len(pictures) < 4:
                    pictures.append(draw_overlay(eyes, points, valid, np.ascontiguousarray(image)))
    return {name: figures_of(rows[name], spent[name]) for name in detectors}, pictures


def _rows_of(detection, truth, frame: int, off: np.ndarray) -> list[tuple]:
    """Return kind, visible, detected, error [px] and score of ball and goal in a frame.

    ``off``: errors of all keypoints [px], shape (K,).
    """

    parts = {"ball": off[GOAL_KEYPOINTS:], "goal": off[:GOAL_KEYPOINTS]}
    rows = []
    for kind, errors in parts.items():
        thing = getattr(detection, kind)
        visible = bool(getattr(truth, f"{kind}_seen")[frame])
        score = getattr(thing, "score", 0.0)
        rows.append((kind, visible, thing is not None, float(errors.mean()), score))
    return rows


def _print(level: str, figures: dict[str, dict[str, float]], first: bool) -> None:
    """A line a detector."""
    if first:
        print(
            "| nuisance | detector | ball: recall, precision | error: median, p95 | goal: recall,"
            " precision | error | a frame |"
        )
        print("|---|---|---|---|---|---|---|")
    for name, f in figures.items():
        parts = [
            f"{f[f'{kind}_recall']:.3f}, {f[f'{kind}_precision']:.3f} |"
            f" {f[f'{kind}_median_px']:.2f}, {f[f'{kind}_p95_px']:.2f} px"
            for kind in ("ball", "goal")
        ]
        print(f"| {level} | {name} | {' | '.join(parts)} | {1e3 * f['seconds']:.0f} ms |")
    sys.stdout.flush()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program."""
    parser = start.parser_of(__doc__, record=False)
    add = parser.add_argument
    add(
        "--weights",
        metavar="FILE",
        help="of visthrow detector train (default: those that are shipped)",
    )
    add("--frames", type=int, default=100, metavar="N", help="a nuisance (default: 100)")
    add(
        "--known",
        default="pose",
        choices=PRIORS,
        help="prior input of the detectors; track: as in flight (default: pose)",
    )
    add(
        "--textures",
        metavar="FOLDER",
        help="photographs (default: those of scikit-image that were not trained on)",
    )
    add("--seed", type=WHOLE, default=0, help="of the scenes")
    add(
        "--out",
        metavar="FILE",
        help="picture of the first frames of each nuisance with what was found, .png",
    )
    add_common(parser)
    return start.main(parser, run, argv)


if __name__ == "__main__":
    sys.exit(main())
