"""Add a detector of your own: run this program in place of `visthrow`.

python examples/add_detector.py config hil detector --set images.by=mine
python examples/add_detector.py hil record --config detector --set images.by=mine --seconds 10
"""

import sys

import numpy as np
import torch

from camera.detectors.contours import BallSeen, Detector, FrameDetections, GoalSeen
from hil.poses.sources import images
from visthrow.cli import main


def network(picture: np.ndarray) -> tuple[list[list[float]] | None, tuple[float, ...] | None]:
    """Return the goal's corners and the ball's box (left, top, right, bottom) [px], or None where
    one is not seen.

    Yours goes here. Corners may begin anywhere, as long as they go round the square.
    """
    corners = [[293.5, 152.1], [313.5, 151.1], [313.1, 160.8], [291.8, 162.0]]
    return corners, (304.4, 318.1, 334.6, 348.4)


class Mine(Detector):
    """A detector that returns rays in the camera's frame: x right, y down, z along the axis."""

    def rays(self, pixels: list[list[float]]) -> np.ndarray:
        return self.lens.unproject(torch.tensor(pixels, dtype=torch.float64))[0].numpy()

    def detect(self, image: np.ndarray, prior: object = None) -> FrameDetections:
        self.check(image)  # size and type; BGR
        corners, box = network(image)
        goal = ball = None
        if corners is not None:
            goal = GoalSeen(self.rays(corners), score=1.0)
        if box is not None:
            left, top, right, bottom = box
            u = (left + right) / 2
            v = (top + bottom) / 2
            sides = self.rays([[left, v], [u, top], [right, v], [u, bottom]])
            middle = sides.sum(axis=0) / np.linalg.norm(sides.sum(axis=0))
            half_angle = float(np.arccos(sides @ middle).mean())
            ball = BallSeen(middle, half_angle=half_angle, score=1.0)
        return FrameDetections(ball, goal)


images.DETECTORS["mine"] = Mine

if __name__ == "__main__":
    sys.exit(main())
