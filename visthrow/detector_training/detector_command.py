"""``visthrow detector``: train the learnt keypoint detector on rendered frames, and throw with
keypoints from rendered pictures.
"""

import argparse
import math
import time
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from visthrow import config
from visthrow.common.arguments import declare
from visthrow.common.compute_device import resolve
from visthrow.common.errors import VisthrowError

TOGETHER = 20  # throws in a batch, which runs in one process

CHECKPOINT = "checkpoint.pt"
WEIGHTS = "learnt.npz"


add_arguments = declare(__file__)


def run(args: argparse.Namespace) -> int:
    """Train or throw."""
    return {"train": train, "throw": throw}[args.action](args)


def throw(args: argparse.Namespace) -> int:
    """Throw with rendered pictures and print the landing errors.

    Raises VisthrowError: the plant does not exist, or the policy is not a vision policy.
    """
    from visthrow.common.workers import run_tasks
    from visthrow.task.measurement import Throws
    from visthrow.throws.loading import load_policy
    from visthrow.throws.plants import check_plant
    from visthrow.throws.reference_protocol import plan

    check_plant(args.plant)
    loaded = load_policy(args.policy, None, args.overrides)
    if loaded.policy.contract["observation"]["layout"] != "vision":
        raise VisthrowError(f"policy '{loaded.name}' sees states; expected a vision policy")
    looks = {
        "device": resolve(args.device),
        "method": args.by,
        "weights": args.weights,
        "nuisances": args.nuisances,
    }
    jobs = plan(1, (args.target,), args.throws, args.seed, size=TOGETHER)
    flown = dict(run_tasks(partial(_throw_batch, loaded, args.plant, looks), jobs, args.jobs))
    throws, counters = zip(*(flown[i] for i in range(len(jobs))))
    columns = {name: np.concatenate([part[name] for part in throws]) for name in throws[0]}
    counts = {name: sum(part[name] for part in counters) for name in counters[0]}
    share = {name: counts[name] / max(counts["frames"], 1) for name in ("ball", "goal")}
    figures = Throws(args.target, **columns).summary() | share | {"refused": counts["refused"]}
    error = columns["error"][np.isfinite(columns["error"])]
    if len(error) > 1:
        width = 1.96 * float(error.std(ddof=1)) / math.sqrt(len(error))
    else:
        width = math.nan
    print(
        f"{loaded.name} by {args.by} on {args.plant}, {args.target:g} m: {len(error)} of"
        f" {args.throws} landed, {counts['refused']} refused, error"
        f" {error.mean() if len(error) else math.nan:.3f} +- {width:.3f} m (95 %), ball found in"
        f" {100 * figures['ball']:.1f} %, goal in {100 * figures['goal']:.1f} % of"
        f" {counts['frames']} frames"
    )
    if args.json is not None:
        from visthrow.common.storage import write_json

        write_json(args.json, figures | {"errors": error.tolist()})
    return 0


def _throw_batch(
    loaded, plant: str, looks: dict[str, Any], job
) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """Return the throws of one batch, each in its own hall, and the counts of detections."""
    from visthrow.detector_training.eyes import RenderedEyes
    from visthrow.detector_training.scenes.scene import Nuisances
    from visthrow.throws.reference_protocol import fly_batch

    bad = Nuisances(*(looks["nuisances"],) * len(fields(Nuisances)))
    camera = loaded.experiment.camera
    halls = 1000 * job.seed + job.batch
    eyes = RenderedEyes(
        camera,
        loaded.experiment.rope,
        job.count,
        halls,
        **looks | {"nuisances": bad},
    )
    return fly_batch([loaded], plant, job, eyes), eyes.found


def train(args: argparse.Namespace) -> int:
    """Train and write the weights.

    Raises VisthrowError: the folder holds a training already, or none to resume.
    """
    from camera.params import CameraParams
    from visthrow.detector_training.fit_detector import Fit, FitParams
    from visthrow.detector_training.scenes.textures import photographs

    params = config.load(FitParams, config.find("detector", args.name), args.overrides)
    folder = Path(args.out)
    saved = folder / CHECKPOINT
    if saved.exists() != args.resume:
        if saved.exists():
            present = "holds a training; continue with --resume, or give another folder"
        else:
            present = "no checkpoint to resume from"
        raise VisthrowError(f"{folder}: {present}")
    files = photographs(args.textures) if args.textures else None
    fit = Fit(
        params,
        config.load(CameraParams, config.find("camera", "fisheye")),
        resolve(args.device),
        files,
    )
    if args.resume:
        fit.load(saved)
    folder.mkdir(parents=True, exist_ok=True)
    print("rendering the first frames ...", flush=True)
    begin = time.monotonic()
    first = fit.step

    def tell(step: int, losses: dict[str, float]) -> None:
        spent = time.monotonic() - begin
        words = ", ".join(f"{name} {value:.3f}" for name, value in losses.items())
        print(
            f"step {step} of {params.steps}, {spent:.0f} s, {1e3 * spent / (step - first):.0f} ms a"
            f" step: {words}",
            flush=True,
        )

    done = fit.run(
        tell, begin + 60.0 * args.minutes if args.minutes is not None else math.inf, saved
    )
    figures = fit.calibrate()
    fit.networks.made_by = {
        "config": config.to_dict(params),
        "steps": fit.step,
        "calibration": figures,
    }
    fit.networks.save(folder / WEIGHTS)
    print(
        f"{'trained' if done else 'stopped'} at step {fit.step}; calibration"
        f" {figures}\n{folder / WEIGHTS}"
    )
    return 0
