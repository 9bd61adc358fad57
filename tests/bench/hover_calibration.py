"""How well a hover's calibration knows the camera, over many draws: ``python -m tests.bench.hover_calibration --count 100``.

Each draw hovers, sways and is calibrated as :mod:`visthrow.throws.calibrated` does it, with all the training's noise; then what was found
is compared with what was drawn.
"""

import argparse

import numpy as np
import torch

from visthrow import config
from visthrow.task import Experiment
from visthrow.throws.calibrated import calibrated_start
from visthrow.training.env import ThrowEnv
from visthrow.training.protocol import hover_start

DRAWN = ["camera.mount.rotation_error_std=0.0524", "camera.noise.scale_std=0.03"]
TILT_DEG, LATENCY, SCALE = 0.2, 0.004, 0.005
"""What is asked of tilt about each axis [deg], latency [s] and focal length [-]."""


def main() -> None:
    """Draw, hover, calibrate, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(args.seed)
    flown = hover_start(config.load(Experiment, config.find("train", "vision_ideal"), DRAWN))
    found: list = []
    with torch.inference_mode():
        env = ThrowEnv(flown, "cpu", args.seed, args.count)
        env.fix_goal(torch.tensor([2.0, 0.0, 0.0]))
        calibrated_start(flown, found)(env)
        turn, scale = env._memory["extrinsic_rotation"].numpy(), env._memory["scale_error"].flatten().numpy()
    known = [i for i, one in enumerate(found) if one is not None]
    off = np.degrees([np.array(found[i].turn_b) - turn[i] for i in known])
    sigma = np.degrees([found[i].turn_sigma for i in known])
    late = np.array([found[i].latency for i in known])
    scaled = np.array([found[i].scale - scale[i] for i in known])
    print(f"{len(known)} of {args.count} hovers gave an answer")
    for axis, name in enumerate(("roll", "pitch", "yaw")):
        rms, held = np.sqrt(np.mean(off[:, axis] ** 2)), np.mean(np.abs(off[:, axis]) < 2.0 * sigma[:, axis])
        within = np.sum(np.abs(off[:, axis]) < TILT_DEG)
        print(f"{name}: {within} of {len(known)} within {TILT_DEG} deg, rms {rms:.3f} deg, {100 * held:.0f} % within two stated deviations")
    print(f"roll and pitch both: {np.sum((np.abs(off[:, :2]) < TILT_DEG).all(1))} of {len(known)} within {TILT_DEG} deg")
    for name, unit, error, limit, scaling in (("latency", "ms", late, LATENCY, 1e3), ("focal length", "%", scaled, SCALE, 1e2)):
        rms = scaling * np.sqrt(np.mean(error**2))
        print(f"{name}: {np.sum(np.abs(error) < limit)} of {len(known)} within {scaling * limit:g} {unit}, rms {rms:.2f} {unit}")


if __name__ == "__main__":
    main()
