"""Project poses as they arrive onto a fisheye image: the keypoints a vision policy receives.

python examples/project_poses.py --seconds 10 --config vicon
python examples/project_poses.py --port 14560 --seconds 10   # MAVLink poses by UDP
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
import torch

from camera.fisheye import Fisheye
from camera.keypoints import KeypointCamera, keypoints
from camera.params import CameraParams
from hil.links.clock import MonotonicClock
from hil.params import HilParams
from hil.poses.frames import Frames
from hil.poses.sources.open_source import open_source
from visthrow import config
from visthrow.onboard.observations import rotation_from_quat


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--config", default="dry_run", help="a name in configs/hil, or a file")
    parser.add_argument("--port", type=int, default=14560, help="that MAVLink poses come to")
    parser.add_argument("--seconds", type=float, default=10.0)
    args = parser.parse_args()
    changes = [f'link.device="udp:127.0.0.1:{args.port}"']
    params = config.load(HilParams, config.find("hil", args.config), changes)
    camera_params = config.load(CameraParams, config.find("camera", "fisheye"))
    camera = KeypointCamera(camera_params)
    lens = Fisheye(camera_params.fisheye)
    frames = {body: Frames(of) for body, of in params.frames.items()}
    clock = MonotonicClock()
    newest = {}
    source, _, _ = open_source(params, Path(tempfile.mkdtemp()), clock)
    end = clock.now() + args.seconds
    while clock.now() < end:
        source.wait(clock, clock.now() + 0.02)
        for pose in source.poll(clock.now()):
            if pose.body in frames:
                newest[pose.body] = frames[pose.body].pose_from_source(pose)
        if frames.keys() <= newest.keys():
            position, ball = (torch.tensor([newest[b].pos]) for b in ("vehicle", "payload"))
            goal = torch.tensor([params.goal_w])
            attitude = rotation_from_quat(torch.tensor([newest["vehicle"].quat]))
            points, valid = keypoints(camera, position, attitude, goal, ball)
            print(np.round(lens.denormalize(points)[0].numpy(), 1).tolist(), valid[0].tolist())
    source.close()


if __name__ == "__main__":
    main()
