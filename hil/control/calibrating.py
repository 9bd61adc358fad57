"""Calibration of camera and thrust in a run, from a still hover and a small sway.

The runner hovers, sways and records; another process estimates (`CalibrationSolver`), so that no
tick waits. The result is recorded with the tick in which it arrives, so that a replay repeats it. A
throw waits for the result, and is refused if the result is uncertain or outside the range of the
training."""

from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context
from typing import Any

import numpy as np
import torch

from camera.params import CameraParams
from hil.poses.body_track import BodyState
from hil.poses.pose import Vector
from visthrow.config.bounds import Bounded, Positive
from visthrow.onboard import calibration
from visthrow.onboard.calibration import Calibration, Hovered, Spreads


@dataclass(frozen=True)
class CalibrationParams(Bounded):
    """Parameters of the calibration, and limits of its results before a throw."""

    still: Positive = calibration.HOVER  # of hover before the sway [s]
    sway: Positive = calibration.SWAY  # [s]
    rate: Positive = calibration.SWAY_RATE  # amplitude of the sway's body rates [rad/s]
    frequency: Positive = calibration.SWAY_FREQUENCY  # of the sway [Hz]
    # of the camera, which is corrected; beyond this tilt the field of view differs too much
    most_tilt_deg: Positive = 10.0
    most_scale: Positive = 0.06  # error of the focal length, which is corrected [-]
    most_latency: Positive = 0.06  # of the keypoints, which is compensated [s]
    thrust: Positive = 0.1  # relative error; twice the spread of the mass in training
    sure_tilt_deg: Positive = 0.5  # largest standard deviation
    sure_latency: Positive = 0.005  # likewise [s]
    spreads: Spreads = field(default_factory=Spreads)  # of poses and keypoints


class CalibrationSolver:
    """Estimates calibrations in a separate process, which starts before the flight."""

    def __init__(self, camera: CameraParams, contract: dict[str, Any], spreads: Spreads):
        """Start the process; arguments as of `visthrow.onboard.calibration.try_calibration`."""
        self._conditions = camera, contract, spreads
        self._pool = ProcessPoolExecutor(1, get_context("spawn"))
        self._pool.submit(_warm).result()
        self._result: Future | None = None

    def submit(self, hovered: Hovered) -> None:
        """Start an estimation; `poll` returns its result."""
        self._result = self._pool.submit(calibration.try_calibration, hovered, *self._conditions)

    def poll(self) -> Calibration | str | None:
        """Return a new result once, or why the estimation failed; None while there is no new
        result.
        """
        if self._result is None or not self._result.done():
            return None
        result = self._result
        self._result = None
        error = result.exception()
        return result.result() if error is None else f"{type(error).__name__}: {error}"

    def close(self) -> None:
        """End the process."""
        self._pool.shutdown(wait=False, cancel_futures=True)


def _warm() -> None:
    """Load the modules that a calibration needs, in the worker; use one core."""
    torch.set_num_threads(1)


@dataclass
class Calibrating:
    """The still hover and sway of a calibration, from the first calm hover on."""

    params: CalibrationParams
    calibration: Calibration | None = None  # the result; None before it
    _problem: str = ""  # of the last attempt
    _begin: float | None = None
    _rows: list[tuple] = field(default_factory=list)
    _due: Hovered | None = None
    _solving: bool = False

    def rates(self, time: float, calm: bool, goal_w: Vector) -> tuple[float, float]:
        """Return the roll and pitch rate to add to the hover's at a time [rad/s]; ``calm``: whether
        the vehicle hovers without swing; ``goal_w``: position of the goal [m].
        """
        p = self.params
        if self.calibration is not None or self._solving:
            return 0.0, 0.0
        if self._begin is None and calm:
            self._begin = time
        if self._begin is None or time - self._begin < p.still:
            return 0.0, 0.0
        swayed = time - self._begin - p.still
        if swayed >= p.sway:
            self._finish(goal_w)
            return 0.0, 0.0
        return calibration.sway(swayed, p.rate, p.frequency)

    def note(
        self,
        time: float,
        vehicle: BodyState,
        thrust: float,
        points: np.ndarray,
        valid: np.ndarray,
        age: float,
    ) -> None:
        """Record a tick: the vehicle's state by its poses, the commanded thrust [N], the normalised
        keypoints of a new frame, shape (8, 2), their validity, shape (8,), and by how much the
        frame is older than the poses [s].
        """
        if self._begin is not None and not self._solving and self.calibration is None:
            state = (vehicle.pos, vehicle.quat, vehicle.vel, vehicle.rate)
            self._rows.append((time, *state, thrust, points, valid, age))

    def stop(self) -> None:
        """Discard the recording, because the vehicle did not follow; start again with the next calm
        hover.
        """
        if self.calibration is None and not self._solving:
            self._begin = None
            self._rows = []

    def _finish(self, goal_w: Vector) -> None:
        rows = self._rows
        self._begin = None
        self._rows = []
        if len(rows) < 3:
            self._problem = "no picture arrived in the hover"
            return
        *columns, ages = (np.array(column) for column in zip(*rows))
        self._due = Hovered(*columns, np.array(goal_w), ages)
        self._solving = True

    def due(self) -> Hovered | None:
        """Return a complete recording once, to be passed to the solver; else None."""
        due = self._due
        self._due = None
        return due

    def take(self, result: Calibration | str) -> None:
        """Store the solver's result; if it failed, hover and sway are repeated."""
        self._solving = False
        if isinstance(result, Calibration):
            self.calibration = result
        else:
            self._problem = result

    def problems(self) -> list[str]:
        """Return the reasons why a throw has to wait or is refused."""
        p = self.params
        estimate = self.calibration
        if estimate is None:
            repeated = f" again: {self._problem}" if self._problem else ""
            return [f"calibrating in the hover{repeated}"]
        tilt = np.abs(np.degrees(estimate.turn_b[:2])).max()
        tilt_sigma = np.degrees(estimate.turn_sigma[:2]).max()
        thrust = f"thrust {estimate.thrust:.2f} of the commanded, within {p.thrust:g} of 1 expected"
        limits = (
            (tilt, p.most_tilt_deg, 1.0, "camera tilted by {:.1f} deg, {:g} at most"),
            (tilt_sigma, p.sure_tilt_deg, 1.0, "camera's tilt known to {:.2f} deg, {:g} at most"),
            (
                abs(estimate.scale),
                p.most_scale,
                100.0,
                "focal length off by {:.1f} %, {:g} at most",
            ),
            (estimate.latency, p.most_latency, 1e3, "keypoints {:.0f} ms late, {:g} at most"),
            (
                estimate.latency_sigma,
                p.sure_latency,
                1e3,
                "keypoints' latency known to {:.1f} ms, {:g} at most",
            ),
            (abs(estimate.thrust - 1.0), p.thrust, 1.0, thrust),
        )
        return [
            f"{text.format(unit * value, unit * limit)}: outside of what was trained"
            for value, limit, unit, text in limits
            if value > limit
        ]
