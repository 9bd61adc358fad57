"""Hover calibration in a run: a still hover, a small sway of the runner's own, and what they show
of camera and thrust.

The runner hovers and sways and takes down what came; the sums are done elsewhere (`Solver`), so
that no tick waits for them. What they gave is recorded with the tick that it came in, so that a
replay decides alike. A throw waits for it, and is refused where it lies outside of what was trained
or is not known well enough."""

from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context
from typing import Any

import numpy as np

from camera.params import CameraParams
from hil.poses.pose import Vector
from hil.poses.track import BodyState
from visthrow.config.bounds import Bounded, Positive
from visthrow.onboard import calibration
from visthrow.onboard.calibration import Calibration, Hovered, Spreads


@dataclass(frozen=True)
class CalibrationParams(Bounded):
    """Parameters of the calibration, and limits of its results for a throw."""

    still: Positive = calibration.STILL  # of hover before the sway [s]
    sway: Positive = calibration.SWAY  # [s]
    rate: Positive = calibration.SWAY_RATE  # amplitude of the sway's body rates [rad/s]
    frequency: Positive = calibration.SWAY_FREQUENCY  # of the sway [Hz]
    most_tilt_deg: Positive = (
        10.0  # of the camera, which is corrected for; beyond it the field of view is another one
    )
    most_scale: Positive = (
        0.06  # of the focal length off the nominal one, which is corrected for [-]
    )
    most_latency: Positive = 0.06  # of the keypoints, which is made up for [s]
    thrust: Positive = 0.1  # off the commanded one: twice the spread of masses in training
    sure_tilt_deg: Positive = 0.5  # standard deviation at most
    sure_latency: Positive = 0.005  # likewise [s]
    spreads: Spreads = field(default_factory=Spreads)  # of poses and keypoints


class Solver:
    """Does the sums in a process of its own, which is started before the flight."""

    def __init__(self, camera: CameraParams, contract: dict[str, Any], spreads: Spreads) -> None:
        """Start the process; arguments as of `visthrow.onboard.calibration.solved`."""
        self._with = camera, contract, spreads
        self._pool = ProcessPoolExecutor(1, get_context("spawn"))
        self._pool.submit(_warm).result()
        self._coming: Future | None = None

    def submit(self, hovered: Hovered) -> None:
        """Begin; `poll` tells."""
        self._coming = self._pool.submit(calibration.solved, hovered, *self._with)

    def poll(self) -> Calibration | str | None:
        """Return what came of it, once; None while there is nothing new."""
        if self._coming is None or not self._coming.done():
            return None
        coming, self._coming = self._coming, None
        error = coming.exception()
        return coming.result() if error is None else f"{type(error).__name__}: {error}"

    def close(self) -> None:
        """End the process."""
        self._pool.shutdown(wait=False, cancel_futures=True)


def _warm() -> None:
    import scipy.sparse.linalg
    import torch

    torch.set_num_threads(1)
    _ = scipy.sparse.linalg


class Calibrating:
    """The hover and the sway of a run; ``found`` is the calibration, None before it came."""

    def __init__(self, params: CalibrationParams, goal: Callable[[], Vector | None]) -> None:
        """Begin with nothing; ``goal``: where the goal is [m]."""
        self.params, self._goal = params, goal
        self.found: Calibration | None = None
        self._why = ""
        self._begin: float | None = None
        self._rows: list[tuple] = []
        self._due: Hovered | None = None
        self._waits = False

    def rates(self, now: float, quiet: bool) -> tuple[float, float]:
        """Return roll and pitch rate to add to the hover's at a time [rad/s]; ``quiet``: the
        vehicle hovers and nothing swings.
        """
        p = self.params
        if self.found is not None or self._waits:
            return 0.0, 0.0
        if self._begin is None:
            if not quiet:
                return 0.0, 0.0
            self._begin = now
        since = now - self._begin - p.still
        if since < 0.0:
            return 0.0, 0.0
        if since >= p.sway:
            self._finish()
            return 0.0, 0.0
        return calibration.sway(since, p.rate, p.frequency)

    def note(
        self,
        now: float,
        vehicle: BodyState,
        thrust: float,
        points: np.ndarray,
        valid: np.ndarray,
        age: float,
    ) -> None:
        """Take down a tick: the vehicle as of the poses, the commanded thrust [N], normalised
        keypoints of a new frame, shape (8, 2), their validity, shape (8,), and their age by the
        frame's stamp beyond that of the poses [s].
        """
        if self._begin is not None and not self._waits and self.found is None:
            self._rows.append(
                (
                    now,
                    vehicle.pos,
                    vehicle.quat,
                    vehicle.vel,
                    vehicle.rate,
                    thrust,
                    points,
                    valid,
                    age,
                )
            )

    def stop(self) -> None:
        """Begin anew with the next quiet hover: the vehicle was not ours."""
        if self.found is None and not self._waits:
            self._begin, self._rows = None, []

    def _finish(self) -> None:
        goal, rows = self._goal(), self._rows
        self._begin, self._rows = None, []
        if goal is None or len(rows) < 3:
            self._why = "no picture came in the hover"
            return
        columns = [np.array(column) for column in zip(*rows)]
        self._due, self._waits = Hovered(*columns[:8], np.array(goal), columns[8]), True

    def due(self) -> Hovered | None:
        """Return a hover that is to be solved, once."""
        due, self._due = self._due, None
        return due

    def take(self, result: Calibration | str) -> None:
        """Take what a solver found; where it found nothing the hover and the sway come again."""
        self._waits = False
        if isinstance(result, Calibration):
            self.found, self._why = result, ""
        else:
            self._why = result

    def problems(self) -> list[str]:
        """Return why a throw has to wait, or is refused."""
        p, estimate = self.params, self.found
        if estimate is None:
            return ["calibrating in the hover" + (f" again: {self._why}" if self._why else "")]
        tilt, tilts = np.degrees(estimate.turn_b[:2]), np.degrees(estimate.turn_sigma[:2])
        limits = {
            f"camera tilted by {np.abs(tilt).max():.1f} deg, {p.most_tilt_deg:g} at most": (
                np.abs(tilt).max() > p.most_tilt_deg
            ),
            f"camera's tilt known to {tilts.max():.2f} deg, {p.sure_tilt_deg:g} at most": (
                tilts.max() > p.sure_tilt_deg
            ),
            (
                f"focal length off by {100 * abs(estimate.scale):.1f} %, "
                f"{100 * p.most_scale:g} at most"
            ): abs(estimate.scale) > p.most_scale,
            f"keypoints {1e3 * estimate.latency:.0f} ms late, {1e3 * p.most_latency:g} at most": (
                estimate.latency > p.most_latency
            ),
            (
                f"keypoints' latency known to {1e3 * estimate.latency_sigma:.1f} ms, "
                f"{1e3 * p.sure_latency:g} at most"
            ): estimate.latency_sigma > p.sure_latency,
            f"thrust {estimate.thrust:.2f} of the commanded, within {p.thrust:g} of 1 expected": (
                abs(estimate.thrust - 1.0) > p.thrust
            ),
        }
        return [f"{text}: outside of what was trained" for text, broken in limits.items() if broken]
