"""One throw as arrays over time, a picture of it, and a recording for the rerun viewer."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sim.params import GRAVITY
from visthrow.common import style
from visthrow.common.storage import savez
from visthrow.cooperative.team import TeamExperiment
from visthrow.cooperative.team_env import TeamEnv
from visthrow.cooperative.team_training import fly
from visthrow.onboard.observations import rotation_from_quat


@dataclass(frozen=True)
class ThrowTrack:
    """A throw of V vehicles whose cables have L segments, T steps until the last separation.

    World frame, [m] and [s].
    """

    time: np.ndarray  # (T,)
    pos_w: np.ndarray  # (T, V, 3)
    rot_wb: np.ndarray  # (T, V, 3, 3)
    cables_w: np.ndarray  # joints, (T, V, L + 1, 3)
    attached: np.ndarray  # (T, V), bool
    load_w: np.ndarray  # (T, 3)
    flight_time: np.ndarray  # after the last separation, (N,)
    flight_w: np.ndarray  # of the load, (N, 3)
    goal_w: np.ndarray  # (3,)
    landing_error: float
    released: bool


def record_throw(
    experiment: TeamExperiment, policy: Callable[[torch.Tensor], torch.Tensor], **options: Any
) -> ThrowTrack:
    """Fly one throw; options as of :func:`visthrow.cooperative.team_training.fly`."""
    rows: list[dict[str, np.ndarray]] = []

    def record(env: TeamEnv) -> None:
        state = env.views.state
        row = {
            "pos_w": state["pos_w"],
            "rot_wb": rotation_from_quat(state["quat_wb"]),
            "attached": state["attached"] != 0,
            "load_w": env.load_w[0],
        }
        rows.append({name: value.cpu().numpy().copy() for name, value in row.items()})
        rows[-1]["cables_w"] = env.sim.cable_points_w()

    values = fly(experiment, policy, count=1, record=record, **options)
    period = experiment.sim.control_period
    arrays = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    flight = np.linspace(0.0, max(float(values["time_to_impact"][0]), 0.0), 30)[:, None]
    fall = np.array([0.0, 0.0, -0.5 * GRAVITY]) * flight**2
    released = bool(values["released"][0])
    return ThrowTrack(
        time=period * np.arange(len(rows)),
        flight_time=period * len(rows) + flight[:, 0],
        flight_w=values["load_w"][0] + flight * values["load_vel_w"][0] + fall,
        goal_w=np.array([options.get("target", 2.0), 0.0, 0.0]),
        landing_error=float(values["landing_error"][0]) if released else np.nan,
        released=released,
        **arrays,
    )


HUES = (style.COLOURS[0], style.COLOURS[3], style.COLOURS[5])  # of vehicles
GHOSTS = 5
"""Times at which the picture shows vehicles and cables."""


def picture(track: ThrowTrack, path: Path) -> None:
    """Write a picture: from the side, and from above."""
    style.use()
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9.2, 4.0), layout="constrained")
    steps = np.unique(np.linspace(0, len(track.time) - 1, GHOSTS).round().astype(int))
    for axis, columns in zip(axes, ((0, 2), (0, 1)), strict=True):
        for v in range(track.pos_w.shape[1]):
            colour = HUES[v % len(HUES)]
            axis.plot(*track.pos_w[:, v][:, columns].T, color=colour, lw=0.8)
            for k in steps:
                nose = track.rot_wb[k, v] @ np.array([[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0]]).T
                wing = track.rot_wb[k, v] @ np.array([[0.0, 0.1, 0.0], [0.0, -0.1, 0.0]]).T
                for arm in (nose.T, wing.T):
                    axis.plot(*(track.pos_w[k, v] + arm)[:, columns].T, color=colour, lw=2.0)
                if track.attached[k, v]:
                    axis.plot(*track.cables_w[k, v][:, columns].T, color=style.ROPE, lw=0.8)
        axis.plot(*track.load_w[:, columns].T, color=style.PAYLOAD, label="load")
        axis.plot(*track.load_w[steps][:, columns].T, "o", color=style.PAYLOAD, ms=6.0)
        if track.released:
            axis.plot(*track.flight_w[:, columns].T, "--", color=style.PAYLOAD, label="its flight")
        axis.plot(*track.goal_w[list(columns)], "x", color=style.GOAL, ms=9.0, label="target")
        axis.set_aspect("equal")
        axis.set_xlabel("x [m]")
    axes[0].set_ylabel("z [m]")
    axes[1].set_ylabel("y [m]")
    axes[0].legend(loc="lower left")
    landed = f"Landed {100.0 * track.landing_error:.1f} cm from the target"
    figure.suptitle(landed if track.released else "Not released")
    figure.savefig(path, dpi=150)
    plt.close(figure)


def write_recording(track: ThrowTrack, path: Path, radius: float) -> None:
    """Write a recording for the rerun viewer; ``radius``: of the load [m]."""
    import rerun as rr

    from visthrow.view.rerun_view import colour_code, recording

    vehicle, rope, load = (
        colour_code(colour) for colour in (style.VEHICLE, style.ROPE, style.PAYLOAD)
    )
    arms = np.array(
        [[0.07, 0.07, 0.0], [-0.07, -0.07, 0.0], [0.07, -0.07, 0.0], [-0.07, 0.07, 0.0]]
    )
    with recording(path) as stream:
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        goal = rr.Points3D([track.goal_w], radii=0.03, colors=[colour_code(style.GOAL)])
        stream.log("world/goal", goal, static=True)
        for k, time in enumerate(track.time):
            stream.set_time("throw_time", duration=float(time))
            tips = np.einsum("vij,aj->vai", track.rot_wb[k], arms) + track.pos_w[k][:, None]
            frames = tips.reshape(-1, 2, 3)
            stream.log("world/vehicles", rr.LineStrips3D(frames, radii=0.01, colors=[vehicle]))
            cables = track.cables_w[k][track.attached[k]]
            stream.log("world/cables", rr.LineStrips3D(cables, radii=0.003, colors=[rope]))
            ball = rr.Points3D([track.load_w[k]], radii=radius, colors=[load])
            stream.log("world/load", ball)
        for time, place in zip(track.flight_time, track.flight_w, strict=True):
            stream.set_time("throw_time", duration=float(time))
            stream.log("world/cables", rr.Clear(recursive=False))
            stream.log("world/load", rr.Points3D([place], radii=radius, colors=[load]))


def write(track: ThrowTrack, folder: Path, radius: float) -> list[Path]:
    """Write picture, recording and arrays into a folder; the recording where rerun is there."""
    import importlib.util

    paths = [folder / "throw.png", folder / "throw.npz"]
    picture(track, paths[0])
    savez(paths[1], {name: np.asarray(value) for name, value in vars(track).items()})
    if importlib.util.find_spec("rerun") is not None:
        paths.append(folder / "throw.rrd")
        write_recording(track, paths[-1], radius)
    return paths
