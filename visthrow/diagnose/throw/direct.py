"""Measurements that are predicted without a simulation: heights of landings, and keypoints.

They are predicted from motion-capture poses, from which the setting's delays, frame and marker
offsets are removed. So they depend on sensors, camera and landing plane alone. Their samples follow
the simulated ones in each window."""

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
from visthrow.diagnose.throw.initial_states import smooth, without_frame, without_marker
from visthrow.diagnose.throw.recorded_flight import NEVER, RecordedFlight, find_measured
from visthrow.logs.check.signals import highpass_sigma
from visthrow.logs.flightlog import FlightLog

LANDING = "landing"
KEYPOINTS = "keypoints"
# noise of a logged landing's height [m]: a ball is compressed, and samples are milliseconds apart
LANDING_SIGMA = 2e-3
GRID = 0.02  # spacing of the smoothed poses from which keypoints are predicted [s]
# half width of that smoothing [s]: attitudes change within 50 ms, which a wider one would delay
SMOOTHING_SECONDS = 0.025
# time over which the speed of a keypoint is taken [s]; rows are exposed within a few milliseconds
SHORT = 1e-3
LEAST_KEYPOINT_SIGMA = 2e-4  # normalised
MEASURED = np.array([(1, 1)] * 4 + [(1, 0), (0, 1), (1, 0), (0, 1)], dtype=bool)
"""Coordinates (8, 2) that a detector measures: both of a corner, and one of a side of the ball's
box. The other coordinate of a side is its middle.
"""
ACTS_ON = (
    "camera.",
    "plant.release.landing_height",
    "plant.rope.payload_radius",
    "sensing.camera_",
)
"""Parameters on which only these samples depend: effects on them need no simulation."""


@dataclass(frozen=True)
class DirectSamples:
    """Samples of one channel in one window, N of them."""

    channel: str
    time: ndarray  # stamps [s], shape (N,)
    values: ndarray  # shape (N,)
    sigma: float
    predict: Callable[[Setting], ndarray]  # prediction in a setting, shape (N,)


def direct_samples(
    logs: Sequence[FlightLog],
    flights: Sequence[RecordedFlight],
    cuts: Sequence[Cut],
    setting: Setting,
) -> dict[int, list[DirectSamples]]:
    """Return the direct measurements of retained windows, by index of the window.

    ``flights``: the logs as prepared for the replay; ``setting``: the diagnosed one."""
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
    """Return whether only direct measurements show an effect."""
    return bool(e.changes) and all(key.path.startswith(ACTS_ON) for key in e.changes)


def has_camera_keypoints(log: FlightLog) -> bool:
    """Return whether a log holds keypoints detected in images, rather than projected from poses by
    a policy's pilot.
    """
    config = log.meta.get("config")
    source = config.get("keypoints", "") if isinstance(config, dict) else ""
    by_camera = source == "detector" or (source == "" and "policy" not in log.meta)
    return by_camera and find_measured(log, KEYPOINTS) is not None and "keypoints_valid" in log


def with_direct(
    window: Window,
    listed: Sequence[DirectSamples],
    channels: Sequence[str],
    settings: Sequence[Setting],
    steps: ndarray,
) -> Window:
    """Append direct measurements to the simulated samples of a window.

    Args:
        window: with a column for every effect.
        listed: its direct measurements.
        settings: the setting of the linearisation, then one for each effect, a step away.
        steps: finite differences of the effects, 0 for those without a derivative, shape (K,).
    """
    nominal, *perturbed = settings
    for direct in listed:
        plain = direct.predict(nominal)
        count = len(plain)
        columns = np.zeros((count, len(steps)))
        for k in np.flatnonzero(steps):
            if not _predict_alike(nominal, perturbed[k]):
                columns[:, k] = (direct.predict(perturbed[k]) - plain) / steps[k]
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
    """Return whether direct measurements are predicted alike in two settings."""
    height = a.plant.release.landing_height
    other_height = b.plant.release.landing_height
    return (a.sensing, a.camera, height) == (b.sensing, b.camera, other_height)


def _landing(time: float, point_w: ndarray) -> DirectSamples:
    """Return the height of the payload's centre at its landing [m], as one sample."""

    def predict(setting: Setting) -> ndarray:
        x = setting.sensing
        point = without_frame(x, point_w)
        point[2] = setting.plant.release.landing_height + x.payload_offset[2]
        return (1.0 + x.scale) * Rotation.from_rotvec(x.frame_tilt).apply(point)[2:]

    return DirectSamples(LANDING, np.array([time]), point_w[2:], LANDING_SIGMA, predict)


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

    def predict(setting: Setting) -> ndarray:
        """Return the predicted keypoints; NaN if the setting's lens is invalid."""
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
    return [DirectSamples(KEYPOINTS, stamps, points[valid], sigma, predict)]


def _reach(camera) -> ndarray:
    """Return the pixels per normalised unit along x and y."""
    from camera.fisheye import Fisheye

    lens = camera.fisheye
    return np.array([lens.fx, lens.fy]) * Fisheye(lens).edge_radius


def _view(log: FlightLog, flight: RecordedFlight, c: Cut, x: SensingParams) -> dict | None:
    """Collect the keypoints of one window: stamps, points, their validity, the goal, and splines
    through smoothed poses.
    """
    time, points = find_measured(log, KEYPOINTS)
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
        stamped = replace(track, time=track.time - delay)  # times of measurement
        fits = [smooth(stamped, t, SMOOTHING_SECONDS, SMOOTHING_SECONDS) for t in grid]
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
    """Estimate the noise of coordinates from valid samples alone."""
    sigmas = []
    for k, i in zip(*np.nonzero(MEASURED)):
        track = points[visible[:, k, i], k, i]
        if len(track) > 3:
            sigmas.append(highpass_sigma(track))
    return np.median(sigmas) if sigmas else 0.0


def _visible_keypoints(view: dict, setting: Setting, nominal: Setting, time: ndarray) -> ndarray:
    """Project the keypoints at some times by the setting's camera, in normalised coordinates of the
    nominal lens, shape (T, 8, 2).
    """
    import torch

    from camera.keypoints import KeypointCamera, keypoints

    x = setting.sensing
    camera = setting.camera
    vehicle = time + (x.vehicle_delay - nominal.sensing.vehicle_delay)
    turned = without_marker(x, view["attitude"](vehicle))
    # The mount is stated relative to the nominal centre of mass: an error of that centre does not
    # move the lens.
    off = np.subtract(x.marker_offset, nominal.plant.vehicle.body.com)
    pos = without_frame(x, view["vehicle"](vehicle)) - turned.apply(off)
    payload = time + (x.payload_delay - nominal.sensing.payload_delay)
    ball = without_frame(x, view["payload"](payload)) - x.payload_offset
    # Predict beyond the image's edge too: a point may be visible although it is predicted outside.
    smooth = replace(camera, noise=replace(camera.noise, invalid_reads="edge"))
    lens = KeypointCamera(smooth, dtype=torch.float64)
    goals = np.tile(view["goal"], (len(time), 1))
    arrays = map(torch.tensor, (pos, turned.as_matrix(), goals, ball))
    points, _ = keypoints(lens, *arrays)
    fisheye = camera.fisheye
    believed = nominal.camera.fisheye
    shift = np.array([fisheye.cx - believed.cx, fisheye.cy - believed.cy])
    return (points.numpy() * _reach(camera) + shift) / _reach(nominal.camera)
