"""Ask a vision policy for a command from keypoints of your own detector, and check their order.

python examples/fly_keypoints.py
"""

import numpy as np
import torch

from camera.fisheye import Fisheye
from visthrow.onboard.pilot import Pilot
from visthrow.throws.loading import load_policy

# What a detector found in one picture [px]: corners of the goal, and the box of the ball
CORNERS = [[293.5, 152.1], [313.5, 151.1], [313.1, 160.8], [291.8, 162.0]]
LEFT = 304.4
TOP = 318.1
RIGHT = 334.6
BOTTOM = 348.4
# The poses of that moment [m]
VEHICLE = [0.0, 0.0, 1.333]
BALL = [0.0, 0.0, 0.95]
GOAL = [2.0, 0.2, 0.0]
LEVEL = [0.0, 0.0, 0.0, 1.0]  # xyzw
MOST_OFF = 1.0  # between what was detected and what the poses say [px]


def main() -> None:
    loaded = load_policy("vision")
    lens = Fisheye(loaded.experiment.camera.fisheye)
    pilot = Pilot(loaded.policy, loaded.experiment.camera)

    u = (LEFT + RIGHT) / 2
    v = (TOP + BOTTOM) / 2
    pixels = torch.tensor([*CORNERS, [LEFT, v], [u, TOP], [RIGHT, v], [u, BOTTOM]])
    keypoints = lens.normalize(pixels)[None].numpy()  # shape (1, 8, 2)
    valid = np.ones((1, 8), dtype=bool)

    vehicle, attitude, ball, goal = (np.array([row]) for row in (VEHICLE, LEVEL, BALL, GOAL))
    still = np.zeros((1, 3))
    decision = pilot.act(vehicle, attitude, still, still, ball, goal, keypoints=(keypoints, valid))
    print("thrust [N] and body rates [rad/s]:", decision.command)

    projected, _ = pilot.see(vehicle, attitude, ball, goal)
    off = (lens.denormalize(torch.from_numpy(projected))[0] - pixels).abs().max()
    if off > MOST_OFF:
        raise SystemExit(f"{off:.1f} px off: check order, origin and lens")


if __name__ == "__main__":
    main()
