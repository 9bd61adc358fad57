"""Detect keypoints in rendered pictures from a camera on each vehicle of a plant."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy import ndarray
from torch import Tensor

from camera.detectors.contours import Detector, FrameDetections, convert_to_training_keypoints
from camera.detectors.following import BallGoalTracker
from camera.detectors.learnt import LearntDetector, Networks
from camera.fisheye import Fisheye
from camera.keypoints import KEYPOINTS, KeypointCamera
from camera.params import CameraParams
from sim.params import RopeParams
from visthrow.common.storage import atomic_write
from visthrow.detector_training.scenes.renderer import Renderer
from visthrow.detector_training.scenes.scene import (
    Draw,
    Nuisances,
    Scenes,
    draw_halls,
    make_plain_scenes,
)
from visthrow.detector_training.scenes.textures import HELD_OUT, photographs
from visthrow.onboard.observations import rotation_from_quat

HANGING = (0.2, 0.6)  # distance of a hanging ball from the lens [m]

# lowest share of the pictures in a hover in which ball and goal must be detected
LEAST_DETECTED = 0.5

OBJECTS = ("ball", "goal")  # objects to detect


def render_hall(
    params: CameraParams,
    pos_w: Tensor,
    rot_wb: Tensor,
    ball_w: Tensor,
    goal_w: Tensor,
    samples: int,
) -> ndarray:
    """Render a grey hall with vehicle, ball and goal square.

    Args:
        params: the camera.
        pos_w: position of the vehicle [m], shape (3,), world frame. rot_wb: its attitude, (3, 3).
        ball_w, goal_w: positions [m], shape (3,), world frame. samples: rays for each pixel.

    Returns a picture, BGR, uint8, shape (H, W, 3).
    """
    places = (place[None] for place in (pos_w, rot_wb, ball_w, goal_w))
    scenes = make_plain_scenes(params, *places, torch.tensor([True]))
    picture = Renderer(params.fisheye, files=[], samples=samples).render(scenes)[0].numpy()
    return np.ascontiguousarray(picture[..., ::-1])


class RenderedEyes:
    """A camera, a hall and a detector for each of E vehicles; the halls were not used in the
    detector's training.

    Attributes:
        frames: frames of the first vehicle with their detections: image, BGR; keypoints, (8, 2);
            validity, (8,).
        last_keypoints: keypoints and validity in the last pictures, (E, 8, 2) and (E, 8).
    """

    def __init__(
        self,
        params: CameraParams,
        rope: RopeParams,
        count: int,
        seed: int,
        device: str = "cpu",
        method: str = "learnt",
        samples: int = 4,
        nuisances: Nuisances | None = None,
        weights: str | None = None,
        keep: bool = False,
    ):
        """Prepare renderer and detector. Raises ValueError: no weights, or no photographs.

        Args:
            params: the camera. rope: the ball's rope.
            count: number E of vehicles. seed: seed of halls and sensors.
            device: device of the renderer.
            method: "learnt" or "contours".
            samples: rays for each pixel.
            nuisances: severity of nuisances; default all. weights: file of the learnt detector;
                default the shipped one. keep: whether to store frames.
        """
        self.params = params
        self.count = count
        self._keep = keep
        self._mount_b = np.array(rope.mount)
        self._below = rope.length + rope.payload_offset
        self.renderer = Renderer(params.fisheye, device, photographs(names=HELD_OUT), samples)
        self._draw = (count, seed)
        self._nuisances = nuisances or Nuisances()
        lens = Fisheye(params.fisheye)
        sizes = (params.payload_radius, params.goal_side)
        if method == "learnt":
            networks = Networks.load(weights) if weights else None
            self.detector: Detector = LearntDetector(lens, *sizes, networks=networks)
        else:
            self.detector = Detector(lens, *sizes)
        self.camera = KeypointCamera(params)
        self._looks = 0
        self._hall: Scenes | None = None
        self._followed: list[BallGoalTracker] = []
        self.frames: list[tuple[ndarray, Tensor, Tensor]] = []
        self.last_keypoints: tuple[ndarray, ndarray] | None = None
        # number of pictures of each vehicle in which the object was detected
        self._hits = {name: np.zeros(count, int) for name in OBJECTS}
        self._refused = 0

    @property
    def found(self) -> dict[str, int]:
        """Return the counts of detections of ball and goal, of frames, and of refused throws."""
        hits = {name: int(hits.sum()) for name, hits in self._hits.items()}
        return hits | {"frames": self.count * self._looks, "refused": self._refused}

    def look(
        self, snapshot: Any, measured: Any, goal_w: ndarray, carried: Sequence[bool] | ndarray
    ) -> tuple[ndarray, ndarray]:
        """Render and process a picture for each vehicle; return normalised keypoints, float32,
        shape (E, 8, 2), and validity, shape (E, 8).

        Args:
            snapshot: true state, a `visthrow.throws.plants.Snapshot`.
            measured: measured state, whose attitude and height support the detector.
            goal_w: goals [m], shape (E, 3). carried: whether a payload is attached, shape (E,).
        """
        scenes = self._scenes(snapshot, goal_w, np.asarray(carried))
        pictures = self.renderer.render(scenes, self._looks).cpu().numpy()
        self._looks += 1
        points = np.zeros((self.count, KEYPOINTS, 2), np.float32)
        valid = np.zeros((self.count, KEYPOINTS), bool)
        rots = rotation_from_quat(torch.from_numpy(np.array(measured.quat_wb, float))).numpy()
        if not self._followed:
            self._followed = [self._assume_hanging_ball(rot) for rot in rots]
        for e in range(self.count):
            picture = np.ascontiguousarray(pictures[e, ..., ::-1])
            detections = self._detect(
                picture, e, measured.pos_w[e], rots[e], bool(carried[e]), float(measured.time)
            )
            one, ok = convert_to_training_keypoints(self.camera, detections, rots[e])
            points[e] = one.numpy()
            valid[e] = ok.numpy()
            if e == 0 and self._keep:
                self.frames.append((picture, one, ok))
        self.last_keypoints = points, valid
        return points, valid

    def find_lost(self) -> dict[int, str]:
        """Return vehicle -> the object, ball or goal, that was detected too rarely for a throw;
        called in a hover.
        """
        lost = {
            int(e): name
            for name in OBJECTS
            for e in np.flatnonzero(self._hits[name] < LEAST_DETECTED * self._looks)
        }
        self._refused = len(lost)
        return lost

    def _assume_hanging_ball(self, rot_wb: ndarray) -> BallGoalTracker:
        """Return a tracker that starts with a ball at rest below the vehicle."""
        from_lens = rot_wb @ (self._mount_b - np.array(self.params.mount.position_b))
        return BallGoalTracker(
            self.params.payload_radius, self.params.goal_side, from_lens - [0.0, 0.0, self._below]
        )

    def _detect(
        self,
        picture: ndarray,
        e: int,
        pos_w: ndarray,
        rot_wb: ndarray,
        carried: bool,
        stamp: float,
    ) -> FrameDetections:
        """Return the detections of vehicle ``e``, with a missed ball at its predicted position; the
        pose is measured at the time ``stamp`` [s].
        """
        rot_wc = rot_wb @ self.camera.rot_cb.double().numpy().T
        eye_w = pos_w + rot_wb @ np.array(self.params.mount.position_b)
        distance = HANGING if carried else None
        prior = self._followed[e].prior(rot_wc, rot_wb[:, 2], eye_w, distance, stamp)
        detections = self.detector.detect(picture, prior)
        for name in OBJECTS:
            self._hits[name][e] += getattr(detections, name) is not None
        return self._followed[e].take(detections, rot_wc, stamp)

    def sheet(self, path: Path) -> Path:
        """Draw six of the stored frames, evenly spaced over the throw, with their detections;
        return the path.
        """
        import cv2

        from camera.overlay import draw_overlay

        chosen = [
            self.frames[i] for i in np.linspace(0, len(self.frames) - 1, 6).round().astype(int)
        ]
        tiles = [draw_overlay(self.camera, points, ok, image) for image, points, ok in chosen]
        sheet = np.vstack([np.hstack(tiles[:3]), np.hstack(tiles[3:])])
        atomic_write(path, cv2.imencode(".png", sheet)[1].tobytes())
        return path

    def _scenes(self, snapshot: Any, goal_w: ndarray, carried: ndarray) -> Scenes:
        """Return the halls with vehicles, balls and goal squares at their present positions."""
        tensor = lambda value: torch.from_numpy(np.array(value, float)).float()  # noqa: E731
        rot = rotation_from_quat(tensor(snapshot.quat_wb))
        plain = make_plain_scenes(
            self.params,
            tensor(snapshot.pos_w),
            rot,
            tensor(snapshot.payload_pos_w),
            tensor(goal_w),
            torch.from_numpy(carried),
        )
        hall = self._hall = self._hall or draw_halls(
            plain, Draw(*self._draw), self.renderer.textures, self._nuisances
        )
        rate = tensor(snapshot.rate_b)
        turned = rate @ self.camera.rot_cb.T
        lens = torch.linalg.cross(rate, self.camera.position_b.expand(self.count, 3))
        vel = tensor(snapshot.vel_w) + torch.einsum("eij,ej->ei", rot, lens)
        radius = hall.rope[:, 3:4] * torch.from_numpy(carried)[:, None]
        columns = {
            "pose": (plain.pose[:, :7], vel, turned),
            "ball": (plain.ball[:, :4], tensor(snapshot.payload_vel_w), hall.ball[:, 7:]),
            "rope": (plain.rope[:, :3], radius, hall.rope[:, 4:]),
            "goal": (plain.goal[:, :2], hall.goal[:, 2:]),
        }
        return replace(hall, **{name: torch.cat(parts, -1) for name, parts in columns.items()})
