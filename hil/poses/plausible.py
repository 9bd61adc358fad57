"""Physics against wrong units of a recording's poses, by the one check of ``visthrow.logs.check``."""

from collections.abc import Iterable

import numpy as np

from hil.poses.frames import FrameParams, Frames
from hil.poses.pose import Pose
from hil.sources.player import CHANNELS
from visthrow.logs.check import physics
from visthrow.logs.flightlog import Channel, FlightLog

LEAST = 50  # poses below which nothing is said
_KINDS = {"pos": ("m", "world"), "quat": ("1", "world"), "vel": ("m/s", "world"), "rate": ("rad/s", "body")}


def unit_problems(poses: Iterable[Pose], frames: dict[str, FrameParams]) -> list[str]:
    """Return what in a recording's raw poses no vehicle does, by the frames of each body; each says which unit would make sense of it."""
    poses, channels = list(poses), {}
    for body, params in frames.items():
        channels |= _channels([pose for pose in poses if pose.body == body], Frames(params), CHANNELS[body])
    return [f"{row.channel}: {row.text}" for row in physics.look(FlightLog(channels)) if (row.topic, row.verdict) == ("units", "bad")]


def _channels(poses: list[Pose], frames: Frames, names: tuple[str, ...]) -> dict[str, Channel]:
    """Return poses of one body as channels in our frames; what some of them lack is left out."""
    ours = [frames.pose_from_source(p) for p in poses if np.all(np.isfinite((p.stamp, p.arrival, *p.pos)))]
    # A clock may be set in between: stamps that do not ascend are left to the gate.
    ours = [p for p, before in zip(ours, [None, *ours]) if before is None or p.stamp > before.stamp]
    times = np.array([p.stamp for p in ours])
    ahead = np.diff(np.maximum.accumulate(times), prepend=-np.inf) > 0.0 if len(times) else np.zeros(0, bool)
    if np.sum(ahead) < LEAST:
        return {}
    found = {}
    for name, (kind, (unit, frame)) in zip(names, _KINDS.items()):
        values = [getattr(p, kind) for p, good in zip(ours, ahead) if good]
        if all(value is not None and np.all(np.isfinite(value)) for value in values):
            found[name] = Channel(times[ahead], np.array(values), unit, frame)
    return found
