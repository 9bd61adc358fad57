"""Accuracy of a hover's camera calibration over many draws: ``python -m bench.hover_calibration
--count 100``.

Each draw hovers, sways and is calibrated as :mod:`visthrow.throws.calibrated` does it, with all the
training's noise; the estimates are compared with the drawn values. ``--plant reference-realistic``
does so on the reference plant: poses with its noise, keypoints with half a pixel of noise, as the
OpenCV detector has (``python -m bench.detector``)."""

import argparse
from functools import partial

import numpy as np
import torch

from camera.keypoints import KeypointCamera, keypoints
from sim.cores import cores
from sim.reference.reference_extras import ReferenceExtras
from visthrow import config
from visthrow.common.compute_device import resolve
from visthrow.common.workers import Workers
from visthrow.onboard import observations as ob
from visthrow.onboard.calibration import HOVER, SWAY, Hovered, Spreads, sway, try_calibration
from visthrow.onboard.hover import HoverController, HoverParams
from visthrow.task import Experiment, contract_of, load_experiment, plant_of
from visthrow.task.measurement import hover_start
from visthrow.throws.calibrated import start_calibrated
from visthrow.throws.reference_protocol import HOVER_TIME, batch_plant, place_in_hover
from visthrow.training.env import ThrowEnv

DRAWN = ["camera.mount.rotation_error_std=0.0524", "camera.noise.scale_std=0.03"]
TILT_DEG = 0.2
LATENCY = 0.004
SCALE = 0.005
"""Limits on the errors of tilt about each axis [deg], latency [s] and focal length [-]; the
reference plant's tilt limit is half of it.
"""

PIXEL = 0.5 / 320.0
"""Noise of a keypoint on the reference plant, half a pixel [-]."""

GOAL = (2.0, 0.0, 0.0)


def calibrate_in_training(
    flown: Experiment, count: int, seed: int, device: str
) -> tuple[list, np.ndarray, np.ndarray]:
    """Calibrations, or None, in the training simulator; the drawn turns [rad] and errors of the
    focal length [-].
    """
    calibrations: list = []
    torch.manual_seed(seed)
    with torch.inference_mode():
        env = ThrowEnv(flown, device, seed, count)
        env.fix_goal(torch.tensor(GOAL, device=device))
        start_calibrated(flown, calibrations)(env)
        return (
            calibrations,
            env.view.buffers["extrinsic_rotation"].cpu().numpy(),
            env.view.buffers["scale_error"].flatten().cpu().numpy(),
        )


def measure_on_reference(
    flown: Experiment, name: str, count: int, seed: int
) -> tuple[list, np.ndarray, np.ndarray]:
    """The same on a reference plant."""
    plant, rng = batch_plant(flown, name, GOAL[0], 0, count, seed)
    home = place_in_hover(plant, flown, rng)
    camera = KeypointCamera(flown.camera)
    goal = torch.tensor([GOAL]).expand(count, 3)
    turn = flown.camera.mount.rotation_error_std * rng.standard_normal((count, 3))
    scale = flown.camera.noise.scale_std * rng.standard_normal(count)
    mounts = camera.extrinsics(torch.from_numpy(turn).float(), torch.zeros(count, 3))
    controller = HoverController(HoverParams(), plant.period, count)
    rows = []
    for k in range(round((HOVER_TIME + HOVER + SWAY) / plant.period)):
        measured = plant.measure()
        now = plant.exposed
        command = controller.step(
            measured.pos_w, measured.quat_wb, measured.vel_w, home, plant_of(flown).total_mass
        )
        since = k * plant.period - HOVER_TIME - HOVER
        if since >= -1e-9:
            command[:, 1:3] += sway(since)
        pos, quat, payload = (
            torch.from_numpy(part).float() for part in (now.pos_w, now.quat_wb, now.payload_pos_w)
        )
        points, valid = keypoints(camera, pos, ob.rotation_from_quat(quat), goal, payload, mounts)
        points = points.numpy() * (1.0 + scale[:, None, None]) + PIXEL * rng.standard_normal(
            (count, 8, 2)
        )
        if since >= -HOVER - 1e-9:
            poses = measured.pos_w, measured.quat_wb, measured.vel_w, measured.rate_b
            rows.append((np.full(count, plant.time), *poses, command[:, 0], points, valid.numpy()))
        plant.step(command, np.zeros(count, bool))
    hovers = [
        Hovered(*parts, np.array(GOAL))
        for parts in zip(*(np.stack(column, 1) for column in zip(*rows)))
    ]
    extras = config.load(ReferenceExtras, config.find("vehicle", "reference_realistic"))
    spreads = Spreads(
        pos=extras.mocap_position_sigma,
        vel=extras.mocap_velocity_sigma,
        attitude=extras.mocap_angle_sigma,
        heading=1.0,
        rate=extras.gyro_sigma,
        keypoint=PIXEL,
        pose_bias=1e-4,
        keypoint_bias=1e-4,
    )
    solve = partial(
        try_calibration, camera=flown.camera, contract=contract_of(flown), spreads=spreads
    )
    with Workers(solve, hovers, cores(), "calibrations") as workers:
        calibrations = dict(workers)
    return (
        [None if isinstance(calibrations[i], str) else calibrations[i] for i in range(count)],
        turn,
        scale,
    )


def main() -> None:
    """Draw, hover, calibrate, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--plant", choices=("hybrid", "reference", "reference-realistic"), default="hybrid"
    )
    parser.add_argument("--device", default="cpu", help="of the training simulator (default: cpu)")
    args = parser.parse_args()
    torch.set_num_threads(1)
    flown = hover_start(load_experiment("vision_ideal", DRAWN))
    tilt_limit = TILT_DEG
    if args.plant == "hybrid":
        calibrations, turn, scale = calibrate_in_training(
            flown, args.count, args.seed, resolve(args.device)
        )
    else:
        calibrations, turn, scale = measure_on_reference(flown, args.plant, args.count, args.seed)
        tilt_limit = 0.5 * TILT_DEG
    known = [i for i, one in enumerate(calibrations) if one is not None]
    off = np.degrees([np.array(calibrations[i].turn_b) - turn[i] for i in known])
    sigma = np.degrees([calibrations[i].turn_sigma for i in known])
    late = np.array([calibrations[i].latency for i in known])
    scaled = np.array([calibrations[i].scale - scale[i] for i in known])
    print(f"{len(known)} of {args.count} hovers gave an answer")
    for axis, name in enumerate(("roll", "pitch", "yaw")):
        rms = np.sqrt(np.mean(off[:, axis] ** 2))
        held = np.mean(np.abs(off[:, axis]) < 2.0 * sigma[:, axis])
        within = np.sum(np.abs(off[:, axis]) < tilt_limit)
        print(
            f"{name}: {within} of {len(known)} within {tilt_limit} deg, rms {rms:.3f} deg,"
            f" {100 * held:.0f} % within two stated deviations"
        )
    print(
        f"roll and pitch both: {np.sum((np.abs(off[:, :2]) < tilt_limit).all(1))} of {len(known)}"
        f" within {tilt_limit} deg"
    )
    for name, unit, error, limit, scaling in (
        ("latency", "ms", late, LATENCY, 1e3),
        ("focal length", "%", scaled, SCALE, 1e2),
    ):
        rms = scaling * np.sqrt(np.mean(error**2))
        print(
            f"{name}: {np.sum(np.abs(error) < limit)} of {len(known)} within {scaling * limit:g}"
            f" {unit}, rms {rms:.2f} {unit}"
        )


if __name__ == "__main__":
    main()
