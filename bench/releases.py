"""Release states of policies: ball and vehicle at the separation and the cable's shape, on the
training's plant and on the full one.

Shows whether a component of the simulator matters: a policy trained without it reaches another
release state on the full plant, or the same one.

    python -m bench.releases paper --units state-1,state_rigid_cable-1    at 2 m
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from bench import start
from bench.common_options import add_common
from sim.hybrid import rope_variants
from visthrow.common.compute_device import resolve
from visthrow.common.errors import ConfigError, suggest
from visthrow.paper.sweep.work_units import load_list
from visthrow.throws.loading import Loaded, load_policy
from visthrow.training.env import ThrowEnv
from visthrow.training.protocol import throw

TARGET = 2.0  # as the throws of the ablations [m]
COUNT = 200  # throws


@dataclass(frozen=True)
class Releases:
    """Releases of N throws; NaN where a throw did not come to it.

    Attributes:
        time: of the separation, from the policy's start [s], shape (N,).
        ball_w, ball_vel_w: of the payload then [m], [m/s], shape (N, 3).
        vehicle_w: [m], shape (N, 3).
        landing_w: [m], shape (N, 3).
        bow: greatest distance of a joint of the cable from the straight line between its ends while
            the payload hung on it [m], shape (N,).
        slack: greatest shortening of that line against the cable's length [m], shape (N,).
    """

    time: np.ndarray
    ball_w: np.ndarray
    ball_vel_w: np.ndarray
    vehicle_w: np.ndarray
    landing_w: np.ndarray
    bow: np.ndarray
    slack: np.ndarray


class _Watched(ThrowEnv):
    """Environment that keeps each first episode's release and cable; on the CPU or a device."""

    def reset(self) -> TensorDict:
        """See `ThrowEnv`; begins to keep."""
        ropes = rope_variants(self.cfg.rope, self.cfg.task.start)
        lengths = torch.tensor([rope.length for rope in ropes], device=self.device)
        self.lengths = lengths.repeat(-(-self.num_envs // len(ropes)))[: self.num_envs]
        self.open = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        blank = torch.full((self.num_envs, 3), torch.nan, device=self.device)
        self.kept = dict.fromkeys(("ball", "vel", "vehicle", "landing"), blank)
        self.time = blank[:, 0]
        self.bow, self.slack = (torch.zeros(self.num_envs, device=self.device) for _ in range(2))
        return super().reset()

    def _judge(self, action: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        reward, done = super()._judge(action)
        self._keep(done)
        return reward, done

    def _keep(self, done: torch.Tensor) -> None:
        state = self.views.state
        out = self.views.out
        lengths = self.lengths
        links = state["cable_dir_w"] * (lengths / len(state["cable_dir_w"]))[None, :, None]
        joints = torch.cat([torch.zeros_like(links[:1]), links.cumsum(0)])
        chord = joints[-1].norm(dim=-1)
        along = joints[-1] / chord[:, None]
        off = (joints - (joints * along).sum(-1, keepdim=True) * along).norm(dim=-1).amax(0)
        hanging = self.open & (state["attached"] != 0)
        self.bow = torch.where(hanging, torch.maximum(self.bow, off), self.bow)
        self.slack = torch.where(hanging, torch.maximum(self.slack, lengths - chord), self.slack)
        gone = self.open & self.last["released"]
        fields = {
            "ball": "payload_pos_w",
            "vel": "payload_vel_w",
            "vehicle": "release_pos_w",
            "landing": "landing_w",
        }
        for name, field in fields.items():
            self.kept[name] = torch.where(gone[:, None], out[field], self.kept[name])
        time = self.last["duration"] - out["time_to_impact"]
        self.time = torch.where(gone, time, self.time)
        self.open = self.open & ~done


def releases(loaded: Loaded, target: float, count: int, device: str, seed: int = 0) -> Releases:
    """Throw in the training simulator and keep the release states.

    Args:
        loaded: policy and the experiment that it is flown in.
        target: [m] along x.
        count: throws.
        device: "cpu" or "cuda:0".
        seed: of starts and noise.
    """
    built: list[_Watched] = []

    def build(*args: Any) -> _Watched:
        built.append(_Watched(*args))
        return built[0]

    throw(
        loaded.experiment, loaded.policy.to(device).actor(count), target, count, device, seed, build
    )
    env = built[0]
    parts = (
        env.time,
        env.kept["ball"],
        env.kept["vel"],
        env.kept["vehicle"],
        env.kept["landing"],
        env.bow,
        env.slack,
    )
    return Releases(*(part.cpu().numpy().astype(float) for part in parts))


def row(name: str, where: str, sample: Releases) -> str:
    """A line of the table of :data:`HEAD`."""
    points = (sample.ball_w, sample.ball_vel_w, sample.vehicle_w, sample.landing_w)
    ball, vel, vehicle, landing = (np.nanmean(point, axis=0) for point in points)
    bow = 1e3 * sample.bow
    slack = 1e3 * sample.slack
    return (
        f"| {name} | {where} | {np.nanmean(sample.time):.3f} s | {ball[0]:.3f}, {ball[2]:.3f} m |"
        f" {vel[0]:.2f}, {vel[2]:.2f} m/s | {vehicle[0]:.3f}, {vehicle[2]:.3f} m | {landing[0]:.3f}"
        f" m | {bow.mean():.1f}, {bow.max():.1f} mm | {slack.mean():.1f}, {slack.max():.1f} mm |"
    )


HEAD = (
    "| policy | flown in | separation | ball x, z | its velocity x, z | vehicle x, z | landing x |"
    " cable off straight, mean, most | shorter, mean, most |\n|---|---|---|---|---|---|---|---|---|"
)


def run(args: argparse.Namespace) -> None:
    """Throw with the policies of a list, where they were trained and on the full plant."""
    work = load_list(args.list, tuple(args.overrides))
    out = Path(args.out)
    device = resolve(args.device)
    known = {
        source.name: source for source in work.sources if source.config and source.is_done(out)
    }
    print(HEAD)
    for name in (args.units or ",".join(known)).split(","):
        if name not in known:
            raise ConfigError(f"no trained policy '{name}' in {out}; {suggest(name, known)}")
        source = known[name]
        layout = source.experiment().task.observation.layout
        vehicle = ("vehicle", "rope", "release", "observation.latency")
        for where, config_name, changes in (
            ("its own", source.config, source.changes),
            ("the full", layout, ()),
        ):
            if where == "its own" or source.config != layout:
                loaded = load_policy(source.policy(out), config_name, changes, vehicle)
                print(row(name, where, releases(loaded, TARGET, COUNT, device)), flush=True)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = start.parser_of(__doc__, record=False)
    parser.add_argument(
        "list", metavar="LIST", help="name of configs/sweep, or a TOML file of your own"
    )
    parser.add_argument(
        "--units",
        metavar="NAMES",
        help="which, with commas between (default: all that are trained)",
    )
    parser.add_argument(
        "--out",
        metavar="FOLDER",
        default="runs/sweep",
        help="of the sweep (default: %(default)s)",
    )
    add_common(parser, json=False)
    return start.main(parser, run, argv)


if __name__ == "__main__":
    sys.exit(main())
