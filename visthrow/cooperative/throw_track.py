"""Record one throw as arrays over time, draw it, and write a recording for the rerun viewer."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy import ndarray

from visthrow.common.free_fall import free_flight
from visthrow.common.storage import savez
from visthrow.cooperative.team import TeamExperiment
from visthrow.cooperative.team_env import TeamEnv
from visthrow.cooperative.team_training import fly
from visthrow.onboard.observations import rotation_from_quat
from visthrow.view import style

DIAGONALS = 0.07 * np.array(
    [[[1.0, 1.0, 0.0], [-1.0, -1.0, 0.0]], [[1.0, -1.0, 0.0], [-1.0, 1.0, 0.0]]]
)
"""Ends of the two lines that represent a vehicle, body frame [m], shape (2, 2, 3)."""


@dataclass(frozen=True)
class ThrowTrack:
    """A throw of V vehicles whose cables have L segments, with T steps until the last separation;
    world frame, [m] and [s].
    """

    time: ndarray  # (T,)
    pos_w: ndarray  # (T, V, 3)
    frames_w: ndarray  # ends of :data:`DIAGONALS`, (T, V, 2, 2, 3)
    cables_w: ndarray  # joints, (T, V, L + 1, 3)
    attached: ndarray  # (T, V), bool
    load_w: ndarray  # (T, 3)
    flight_time: ndarray  # times after the last separation, (N,)
    flight_w: ndarray  # positions of the flying load, (N, 3)
    goal_w: ndarray  # (3,)
    landing_error: float
    released: bool


def record_throw(
    experiment: TeamExperiment, policy: Callable[[torch.Tensor], torch.Tensor], **options: Any
) -> ThrowTrack:
    """Fly one throw; options: see :func:`visthrow.cooperative.team_training.fly`."""
    rows: list[tuple[ndarray, ...]] = []

    def record(env: TeamEnv) -> None:
        state = env.views.state
        pos = state["pos_w"].numpy(force=True).copy()
        turn = rotation_from_quat(state["quat_wb"]).numpy(force=True)
        frames = pos[:, None, None] + np.einsum("vij,abj->vabi", turn, DIAGONALS)
        attached = state["attached"].numpy(force=True) != 0
        load = env.load_w[0].numpy(force=True)
        rows.append((pos, frames, env.sim.cable_points_w(), attached, load.copy()))

    values = fly(experiment, policy, count=1, record=record, **options)
    one = {name: value[0] for name, value in values.items()}
    time = experiment.sim.control_period * np.arange(len(rows) + 1)
    end = max(float(one["duration"]), time[-1])
    flight = np.linspace(0.0, end - time[-1], 30)[:, None]
    flight_w = free_flight(one["load_w"], one["load_vel_w"], flight)
    goal_w = np.array([options.get("target", 2.0), 0.0, 0.0])
    released = bool(one["released"])
    error = float(one["landing_error"]) if released else np.nan
    columns = [np.stack(column) for column in zip(*rows, strict=True)]
    flown = (time[-1] + flight[:, 0], flight_w, goal_w, error, released)
    return ThrowTrack(time[:-1], *columns, *flown)


HUES = (style.COLOURS[0], style.COLOURS[3], style.COLOURS[5])  # colours of vehicles


def picture(track: ThrowTrack, path: Path) -> None:
    """Write a picture of the throw from the side and from above."""
    style.use()
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9.2, 4.0), layout="constrained")
    # vehicles and cables are drawn at five times
    steps = np.unique(np.linspace(0, len(track.time) - 1, 5).round().astype(int))
    for axis, columns, name in zip(axes, ([0, 2], [0, 1]), "zy", strict=True):
        for v in range(track.pos_w.shape[1]):
            colour = HUES[v % len(HUES)]
            axis.plot(*track.pos_w[:, v, columns].T, color=colour, lw=0.8)
            for k in steps:
                axis.plot(*track.frames_w[k, v][..., columns].T, color=colour, lw=2.0)
                if track.attached[k, v]:
                    axis.plot(*track.cables_w[k, v][:, columns].T, color=style.ROPE, lw=0.8)
        load = track.load_w[:, columns].T
        axis.plot(*load, color=style.PAYLOAD, label="load")
        axis.plot(*load[:, steps], "o", color=style.PAYLOAD, ms=6.0)
        if track.released:
            axis.plot(*track.flight_w[:, columns].T, "--", color=style.PAYLOAD, label="its flight")
        axis.plot(*track.goal_w[columns], "x", color=style.GOAL, ms=9.0, label="target")
        axis.set(aspect="equal", xlabel="x [m]", ylabel=f"{name} [m]")
    axes[0].legend(loc="lower left")
    landed = f"Landed {100.0 * track.landing_error:.1f} cm from the target"
    figure.suptitle(landed if track.released else "Not released")
    figure.savefig(path, dpi=150)
    plt.close(figure)


def write_recording(track: ThrowTrack, path: Path, radius: float) -> None:
    """Write a recording for the rerun viewer; ``radius``: radius of the load [m]."""
    import rerun as rr

    from visthrow.view.rerun_view import TIMELINE, colour_code, open_recording

    def send(name: str, shape: type, places: Any, size: float, colour: str, **how: bool) -> None:
        thing = shape(places, radii=size, colors=[colour_code(colour)])
        stream.log(f"world/{name}", thing, **how)

    with open_recording(path) as stream:
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        send("goal", rr.Points3D, [track.goal_w], 0.03, style.GOAL, static=True)
        flight = zip(track.flight_time, track.flight_w, strict=True)
        for k, (time, load) in enumerate([*zip(track.time, track.load_w, strict=True), *flight]):
            stream.set_time(TIMELINE, duration=float(time))
            cables = track.cables_w[:0, 0]
            if k < len(track.time):
                vehicles = track.frames_w[k].reshape(-1, 2, 3)
                send("vehicles", rr.LineStrips3D, vehicles, 0.01, style.VEHICLE)
                cables = track.cables_w[k][track.attached[k]]
            send("cables", rr.LineStrips3D, cables, 0.003, style.ROPE)
            send("load", rr.Points3D, [load], radius, style.PAYLOAD)


def write(track: ThrowTrack, folder: Path, radius: float) -> list[Path]:
    """Write picture, arrays and, if rerun is installed, recording into a folder; return the paths;
    ``radius``: radius of the load [m].
    """
    import importlib.util

    paths = [folder / "throw.png", folder / "throw.npz"]
    picture(track, paths[0])
    savez(paths[1], {name: np.asarray(value) for name, value in vars(track).items()})
    if importlib.util.find_spec("rerun") is not None:
        paths.append(folder / "throw.rrd")
        write_recording(track, paths[-1], radius)
    return paths
