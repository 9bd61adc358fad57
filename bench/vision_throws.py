"""Vision against state under like conditions: eight evaluation seeds of 200 throws each, in the
training simulator.

    python -m bench.vision_throws state vision vision_located --record vision-throws
    python -m bench.vision_throws rival          # the estimator in front of the state policy
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bench import start
from bench.report import Report, Table, finish
from camera.arrays import push
from camera.keypoints import KeypointCamera
from camera.mount import rotate
from visthrow.common import statistics
from visthrow.common.workers import status
from visthrow.onboard import observations as ob
from visthrow.onboard.policy import Policy, find_policy
from visthrow.task import Experiment
from visthrow.throws.loading import load_policy
from visthrow.training import protocol

TARGETS = (1.5, 2.0, 2.5)  # [m]
FAULT_TARGET = 2.0  # [m]
THROWS = 200
SEEDS = 8
RIVAL = "rival"
LOCATED = "vision_located"
STATE = "state"
"""The plain rival, the policy whose estimator it has, and the one that it flies."""

FAULTS = {
    "20 % lost": ("camera.noise.drop_probability=0.2",),
    "40 ms late": ("task.observation.latency=[0.04,0.04]",),
    "2 % wrong": ("camera.noise.wrong_probability=0.02",),
}
"""Fault of the camera -> the override that causes it."""


def noise(factor: float, layout: str) -> tuple[str, ...]:
    """Overrides that make all measurement noise ``factor`` times the paper's."""
    sizes = {"task.noise.observation_step": 0.01, "task.noise.observation_bias": 0.001}
    if layout == "vision":
        sizes |= {"camera.noise.step_std": 0.01, "camera.noise.bias_std": 0.001}
    return tuple(f"{key}={factor * size}" for key, size in sizes.items())


class Rival:
    """The state policy behind the estimator of located vision policies: no network has learnt to
    see.

    The goal is the mean of the throw's frames. The payload is on its ray, a cable's length from the
    mount; where no keypoint shows it, it stays where it was.
    """

    def __init__(self, experiment: Experiment, policy: Policy, count: int) -> None:
        self.policy = policy
        self.layout = ob.layout_of(experiment.task.observation)
        self.camera = KeypointCamera(experiment.camera)
        rope = experiment.rope
        self.lens_b = self.camera.position_b.reshape(1, 1, 3)
        self.mount_b = torch.tensor(rope.mount).reshape(1, 1, 3)
        self.reach = rope.length + rope.payload_offset
        self.history = torch.zeros(count, 4, 3)
        self.fresh = torch.ones(count, dtype=torch.bool)

    def __call__(self, obs: Tensor) -> Tensor:
        """Action, shape (E, 5), for observations of the located layout, shape (E, D)."""
        at = self.layout.dimension - self.layout.response * ob.RESPONSE - self.layout.located
        goal = obs[:, at : at + 2]
        ray = obs[:, at + 2 : at + 5]
        attached = obs[:, at - 9]
        rot_wb = ob.rotation_in(obs)
        lens = rotate(rot_wb, self.lens_b.expand(len(obs), -1, -1))[:, 0]
        mount = rotate(rot_wb, self.mount_b.expand(len(obs), -1, -1))[:, 0]
        off = lens - mount
        along = (off * ray).sum(-1)
        square = (along**2 - off.square().sum(-1) + self.reach**2).clamp(min=0.0)
        payload = lens + ray * (square.sqrt() - along)[:, None]
        shown = ray.square().sum(-1, keepdim=True) > 0.0
        payload = torch.where(shown, payload, self.history[:, 0])
        known = obs[:, at + 5 : at + 6] > 0.0
        offset = torch.where(known, goal - payload[:, :2], 0.0)
        self.history = push(self.history, payload, self.fresh)
        self.fresh = torch.zeros_like(self.fresh)
        parts = [obs[:, : ob.VEHICLE + 5], offset, self.history.flatten(1), attached[:, None]]
        return self.policy.act(torch.cat(parts, dim=-1))


def throw_row(
    name: str, overrides: Sequence[str], target: float, calibrate: bool = False
) -> dict[str, float]:
    """Throws of a row under one condition: mean and 95 % interval of the error, lowest and highest
    of the seeds, shares.
    """
    from visthrow.throws.calibrated import start_calibrated
    from visthrow.training.env import ThrowEnv

    loaded = load_policy(LOCATED if name == RIVAL else name, None, overrides)
    experiment = loaded.experiment
    flown = loaded.policy
    if name == RIVAL:
        flown = Policy.load(find_policy(STATE))
    begin: Callable = start_calibrated(experiment) if calibrate else ThrowEnv.reset
    each = []
    for seed in range(SEEDS):
        actor = Rival(experiment, flown, THROWS) if name == RIVAL else flown.actor(THROWS)
        each.append(protocol.throw(experiment, actor, target, THROWS, "cpu", seed, begin=begin))
    error = np.concatenate([throws.error[throws.success] for throws in each])
    means = [float(throws.error[throws.success].mean()) for throws in each]
    landed = float(np.mean([throws.success.mean() for throws in each]))
    mean = statistics.mean(error)
    return {
        **{"error": mean.value, "low": mean.low, "high": mean.high, "deviation": error.std()},
        **{"lowest_seed": min(means), "highest_seed": max(means), "landed": landed},
        "duration": float(np.nanmean(np.concatenate([throws.duration for throws in each]))),
    }


def conditions(layout: str, calibrated: bool = False) -> dict[str, tuple[float, tuple[str, ...]]]:
    """Name of a condition -> target and overrides."""
    rows: dict[str, tuple[float, tuple[str, ...]]] = {f"{t} m": (t, ()) for t in TARGETS}
    if layout == "vision":
        rows |= {name: (FAULT_TARGET, change) for name, change in FAULTS.items()}
        if calibrated:
            rows["1 deg, calibrated"] = (FAULT_TARGET, ("camera.mount.rotation_error_std=0.01745",))
    rows["no noise"] = (FAULT_TARGET, noise(0.0, layout))
    rows["4 x noise"] = (FAULT_TARGET, noise(4.0, layout))
    return rows


def run(args: argparse.Namespace) -> int:
    """Throw, print, write."""
    torch.set_num_threads(1)
    figures: dict[str, dict[str, Any]] = {}
    for name in args.policies:
        label = name if name == RIVAL or not Path(name).is_file() else Path(name).parent.name
        policy = Policy.load(find_policy(LOCATED if name == RIVAL else name))
        layout = policy.contract["observation"]["layout"]
        figures[label] = {}
        for condition, (target, change) in conditions(layout, args.calibrated).items():
            status(f"{label}: {condition}")
            calibrate = "calibrated" in condition
            figures[label][condition] = throw_row(name, change, target, calibrate)
    status("")
    return finish(_report(figures), args)


def _report(figures: dict[str, dict[str, Any]]) -> Report:
    names = list(dict.fromkeys(c for row in figures.values() for c in row))
    rows = [(label, *(_cell(row.get(name)) for name in names)) for label, row in figures.items()]
    title = "Vision against state in the training simulator"
    note = (
        f"Mean landing error [m] and 95 % interval of {SEEDS} x {THROWS} throws, seeds 0 to"
        f" {SEEDS - 1}; faults and noise at {FAULT_TARGET:.1f} m. Noise: of all measurements."
    )
    return Report(
        "vision_throws", title, (Table(title, ("policy", *names), tuple(rows)),), (note,), figures
    )


def _cell(figures: dict[str, float] | None) -> str:
    if figures is None:
        return "-"
    text = f"{figures['error']:.4f} [{figures['low']:.4f}, {figures['high']:.4f}]"
    return text if figures["landed"] == 1.0 else f"{text}, {100 * figures['landed']:.0f} % landed"


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    parser = start.parser_of(__doc__)
    parser.add_argument("policies", nargs="+", help=f"shipped names, files, or {RIVAL}")
    parser.add_argument("--calibrated", action="store_true", help="a turned camera too (minutes)")
    return start.main(parser, run, argv)


if __name__ == "__main__":
    sys.exit(main())
