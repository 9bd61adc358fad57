"""Measurements that are predicted without a simulation: where payloads landed, and what a camera
saw.

Each kind predicts its samples from what motion capture saw, taken back through the setting's
delays, frame and markers, so that it depends on sensors, camera and landing plane alone. Its
samples stand behind the simulated ones of their window."""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy import ndarray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from sim.effects.effect import SettingEffect
from sim.effects.setting import Setting
from sim.params import SensingParams
from visthrow.diagnose.models.model_interface import Window
from visthrow.diagnose.throw.cutting import Cut
from visthrow.diagnose.throw.initial_states import smoothed, without_frame, without_marker
from visthrow.diagnose.throw.recorded_flight import NEVER, RecordedFlight, measured
from visthrow.logs.check.signals import highpass_sigma
from visthrow.logs.flightlog import FlightLog

LANDING = "landing"
KEYPOINTS = "keypoints"
# of a logged landing's height [m]: a ball is pressed in, and samples lie milliseconds apart
LANDING_SIGMA = 2e-3
GRID = 0.02  # between the smoothed poses that a camera's views are predicted from [s]
# reach of that smoothing [s]: attitudes change within 50 ms, which a wider one would show late
SMOOTHING_SECONDS = 0.025
# over which the speed of a keypoint is taken [s]: its row differs from the others' by a few
# milliseconds at most
SHORT = 1e-3
LEAST_KEYPOINT_SIGMA = 2e-4  # normalised
MEASURED = np.array([(1, 1)] * 4 + [(1, 0), (0, 1), (1, 0), (0, 1)], dtype=bool)
"""Coordinates (8, 2) that a detector measures: corners, and where each side of a box is; the rest
are middles of sides.
"""
ACTS_ON = (
    "camera.",
    "plant.release.landing_height",
    "plant.rope.payload_radius",
    "sensing.camera_",
)
"""Numbers that nothing but these samples depends on: their effects need no simulation."""


@dataclass(frozen=True)
class DirectSamples:
    """Samples of one channel in one window, N of them."""

    channel: str
    time: ndarray  # stamps [s], shape (N,)
    values: ndarray  # shape (N,)
    sigma: float
    predicted: Callable[[Setting], ndarray]  # what a setting makes of them, shape (N,)


def direct_samples(
    logs: Sequence[FlightLog],
    flights: Sequence[RecordedFlight],
    cuts: Sequence[Cut],
    setting: Setting,
) -> dict[int, list[DirectSamples]]:
    """Return all that the logs hold of windows that count, by the windows' numbers.

    ``flights``: the logs as the replay takes them; ``setting``: the diagnosed one."""
    counting = [(w, c) for w, c in enumerate(cuts) if c.retained]
    last = {c.flight: w for w, c in counting}
    by_window = defaultdict(list)
    for n, w in last.items():
        flight = flights[n]
        if flight.landing_point is not None and flight.latch != NEVER:
            by_window[w].append(_landing(flight.landing, flight.landing_point))
    for w, c in counting if setting.camera is not None else ():
        flight = flights[c.flight]
        if flight.payload is not None and has_camera_keypoints(logs[c.flight]):
            by_window[w] += _camera_view(logs[c.flight], flight, c, setting)
    return by_window


def needs_no_flight(e: SettingEffect) -> bool:
    """Whether nothing but direct measurements shows an effect."""
    return bool(e.changes) and all(key.path.startswith(ACTS_ON) for key in e.changes)


def has_camera_keypoints(log: FlightLog) -> bool:
    """Whether a log holds keypoints that a camera saw: those that a policy's pilot projected from
    poses say nothing about it.
    """
    config = log.meta.get("config")
    source = config.get("keypoints", "") if isinstance(config, dict) else ""
    by_camera = source == "detector" or (source == "" and "policy" not in log.meta)
    return by_camera and measured(log, KEYPOINTS) is not None and "keypoints_valid" in log


def with_direct(
    window: Window,
    listed: Sequence[DirectSamples],
    channels: Sequence[str],
    settings: Sequence[Setting],
    steps: ndarray,
) -> Window:
    """A window with its direct measurements behind the simulated samples.

    Args:
        window: with a column for every effect.
        listed: its direct measurements.
        settings: the one that is linearised about, then one for each effect, a step away.
        steps: of the effects, 0 for those without a derivative here, shape (K,).
    """
    nominal, *perturbed = settings
    for direct in listed:
        plain = direct.predicted(nominal)
        count = len(plain)
        columns = np.zeros((count, len(steps)))
        for k in np.flatnonzero(steps):
            if not _predict_alike(nominal, perturbed[k]):
                columns[:, k] = (direct.predicted(perturbed[k]) - plain) / steps[k]
        channel = channels.index(direct.channel)
        padding = (0, count), (0, 0)
        window = replace(
            window,
            time=np.append(window.time, direct.time),
            residual=np.append(window.residual, direct.values - plain),
            channel=np.append(window.channel, [channel] * count),
            sigma=np.append(window.sigma, [direct.sigma] * count),
            effects=np.vstack((window.effects, columns)),
            nuisance=np.pad(window.nuisance, padding),
            latent=np.pad(window.latent, padding),
        )
    return window


def _predict_alike(a: Setting, b: Setting) -> bool:
    """Whether direct measurements are the same in two settings; the poses are measured ones."""
    height = a.plant.release.landing_height
    other_height = b.plant.release.landing_height
    return (a.sensing, a.camera, height) == (b.sensing, b.camera, other_height)


def _landing(time: float, point_w: ndarray) -> DirectSamples:
    """Return the height at which the payload's centre was when it came down [m]: one sample of a
    throw.
    """

    def predicted(setting: Setting) -> ndarray:
        x = setting.sensing
        point = without_frame(x, point_w)
        point[2] = setting.plant.release.landing_height + x.payload_offset[2]
        return (1.0 + x.scale) * Rotation.from_rotvec(x.frame_tilt).apply(point)[2:]

    return DirectSamples(LANDING, np.array([time]), point_w[2:], LANDING_SIGMA, predicted)


def _camera_view(
    log: FlightLog, flight: RecordedFlight, c: Cut, nominal: Setting
) -> list[DirectSamples]:
    """Return the keypoints that a camera saw in a window, normalised: payload's box, and the goal's
    corners where the log knows the goal; none without enough of them.
    """
    view = _view(log, flight, c, nominal.sensing)
    if view is None:
        return []
    time, points, valid = view["time"], view["points"], view["valid"]

    def predicted(setting: Setting) -> ndarray:
        """Return the keypoints' prediction; NaN where the lens is none."""
        x = setting.sensing
        try:
            lens = nominal.camera
            row = lens.fisheye.cy + points[..., 1] * _reach(lens)[1]
            middle = row.mean(axis=1)
            exposed = time - x.camera_delay + x.camera_line_time * middle
            keypoints = _visible_keypoints(view, setting, nominal, exposed)
            if x.camera_line_time != 0.0:
                later = _visible_keypoints(view, setting, nominal, exposed + SHORT)
                after = x.camera_line_time * (row - middle[:, None])
                keypoints = keypoints + (later - keypoints) / SHORT * after[..., None]
        except ValueError:
            return np.full(np.count_nonzero(valid), np.nan)
        return keypoints[valid].ravel()

    stamps = np.broadcast_to(time[:, None, None], points.shape)[valid]
    sigma = max(_noise(points, valid), LEAST_KEYPOINT_SIGMA)
    return [DirectSamples(KEYPOINTS, stamps, points[valid], sigma, predicted)]


def _reach(camera) -> ndarray:
    """Pixels of 1 in normalised coordinates along x and y."""
    from camera.fisheye import Fisheye

    lens = camera.fisheye
    return np.array([lens.fx, lens.fy]) * Fisheye(lens).edge_radius


def _view(log: FlightLog, flight: RecordedFlight, c: Cut, x: SensingParams) -> dict | None:
    """Views of one window: stamps, points, what is valid of them, goal, and splines through poses
    that are smoothed on a grid about them.
    """
    time, points = measured(log, KEYPOINTS)
    first, last = flight.payload.time[[0, -1]]
    during = (time >= c.start) & (time < c.end) & (time > first) & (time < last)
    if np.count_nonzero(during) < 5:
        return None
    valid = np.asarray(log["keypoints_valid"].values, dtype=bool)
    stamps = time[during]
    index = np.searchsorted(log["keypoints_valid"].time, stamps - 1e-9)
    points = points[during].reshape(-1, *MEASURED.shape)
    visible = valid[np.minimum(index, len(valid) - 1)]
    goal = log["goal_w"].values[0] if "goal_w" in log else log.meta.get("goal_w")
    if goal is None:
        goal = np.zeros(3)
        visible[:, :4] = False
    grid = np.arange(stamps[0] - 3 * GRID, stamps[-1] + 4 * GRID, GRID)
    view = {}
    for name, track, delay in (
        ("vehicle", flight.vehicle, x.vehicle_delay),
        ("attitude", flight.attitude, x.vehicle_delay),
        ("payload", flight.payload, x.payload_delay),
    ):
        stamped = replace(track, time=track.time - delay)  # at the times that they show
        fits = [smoothed(stamped, t, SMOOTHING_SECONDS, SMOOTHING_SECONDS) for t in grid]
        if any(fit is None for fit in fits):
            return None
        values = np.array([value for value, _ in fits])
        if name == "attitude":
            view[name] = RotationSpline(grid, Rotation.from_quat(values))
        else:
            view[name] = CubicSpline(grid, values)
    visible = visible[..., None] & MEASURED
    if not np.any(visible):
        return None
    return view | {
        "time": stamps,
        "points": points,
        "valid": visible,
        "goal": np.asarray(goal, dtype=float)[:3],
    }


def _noise(points: ndarray, visible: ndarray) -> float:
    """Estimate the noise of coordinates while they are seen: what stands in the log elsewhere is
    none.
    """
    sigmas = []
    for k, i in zip(*np.nonzero(MEASURED)):
        track = points[visible[:, k, i], k, i]
        if len(track) > 3:
            sigmas.append(highpass_sigma(track))
    return np.median(sigmas) if sigmas else 0.0


def _visible_keypoints(view: dict, setting: Setting, nominal: Setting, time: ndarray) -> ndarray:
    """Keypoints that the setting's camera sees at times, in the nominal lens's normalised
    coordinates, shape (T, 8, 2).
    """
    import torch

    from camera.keypoints import KeypointCamera, keypoints

    x = setting.sensing
    camera = setting.camera
    vehicle = time + (x.vehicle_delay - nominal.sensing.vehicle_delay)
    turned = without_marker(x, view["attitude"](vehicle))
    # The mount is stated from the centre of mass as it was believed: where the weight really lies
    # moves no lens.
    off = np.subtract(x.marker_offset, nominal.plant.vehicle.body.com)
    pos = without_frame(x, view["vehicle"](vehicle)) - turned.apply(off)
    payload = time + (x.payload_delay - nominal.sensing.payload_delay)
    ball = without_frame(x, view["payload"](payload)) - x.payload_offset
    # Smooth past the edge too: what was seen counts also where this predicts it out of view.
    smooth = replace(camera, noise=replace(camera.noise, invalid_reads="edge"))
    lens = KeypointCamera(smooth, dtype=torch.float64)
    goals = np.tile(view["goal"], (len(time), 1))
    arrays = map(torch.tensor, (pos, turned.as_matrix(), goals, ball))
    points, _ = keypoints(lens, *arrays)
    fisheye = camera.fisheye
    believed = nominal.camera.fisheye
    shift = np.array([fisheye.cx - believed.cx, fisheye.cy - believed.cy])
    return (points.numpy() * _reach(camera) + shift) / _reach(nominal.camera)
