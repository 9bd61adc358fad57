"""A model of a pendulum on an encoder: natural frequency, friction of three kinds, and errors of
the encoder. Its effects stand in ``effects.toml``.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from visthrow.common.errors import LogError
from visthrow.config.bounds import Bounded, NotNegative, Positive
from visthrow.diagnose.models.numeric import (
    Lanes,
    NumericModel,
    Stretch,
    halves,
    integrate,
    sigma_of,
    take_samples,
)
from visthrow.logs.flightlog import FlightLog

CHANNEL = "angle"
FEWEST = 20  # samples of a window
# median distance from where the pendulum hangs [rad]: no free swing goes round and round most of
# the time
FARTHEST = 2.0 * np.pi
# dry friction changes its sign over this rate [rad/s]: narrower than any swing, wide enough for the
# integrator
SMOOTH = 0.02


@dataclass(frozen=True)
class PendulumParams(Bounded):
    """The pendulum that is assumed before anything is found."""

    gravity: Positive  # [m/s^2]
    # of the equivalent simple pendulum, inertia about the pivot over mass times lever [m]
    length: Positive
    hanging: float  # what the encoder says where it hangs [rad]
    viscous: NotNegative  # friction in proportion to the rate, per inertia [1/s]
    coulomb: NotNegative  # dry friction per inertia [rad/s^2]
    quadratic: NotNegative  # air drag per inertia [1/rad]
    window: Positive  # [s]
    step: Positive  # of the integration [s]
    every: int  # the samples taken: every n-th

    @property
    def stiffness(self) -> float:
        """Return the stiffness of small swings [1/s^2]."""
        return self.gravity / self.length


ENCODER = PendulumParams(
    gravity=9.81,  # at sea level in the middle latitudes
    length=0.17,  # the plain model's, from the period of the last swings
    hanging=3.141592653589793,  # the data's SOURCE.md
    viscous=0.0,  # the plain model has no friction
    coulomb=0.0,  # as above
    quadratic=0.0,  # as above
    window=2.0,  # about two swings
    step=0.01,  # a hundredth of a swing
    every=5,  # 100 Hz
)
"""The pendulum of dynamicslab (MultiArm-Pendulum)."""


class PendulumModel(NumericModel):
    """Free swings, cut into windows.

    Convention: the pendulum swings in the plane of world x and z; forces are those on a bob of 1 kg
    at the pendulum's length."""

    table = str(Path(__file__).with_name("effects.toml"))
    pushes = ((2, 0), (2, 2))
    knot_count = 11
    channels = needed = (CHANNEL,)
    latent_step = 0.1
    bends = True

    @property
    def _steps(self) -> int:
        return round(self.params.window / self.params.step)

    def windows_of(self, log: FlightLog, number: int) -> list[Stretch]:
        """See the base class.

        Raises LogError: the log holds angles that are no radians from where the pendulum hangs.
        """
        params = self.params
        time, angle = log[CHANNEL].samples()
        if len(time) < FEWEST:
            return []
        distance = np.median(np.abs(angle - params.hanging))
        if distance > FARTHEST:
            raise LogError(
                f"the pendulum is {distance:.3g} rad from where it hangs ({params.hanging:.3g}"
                " rad); expected radians within a turn: degrees, or another zero?"
            )
        sigma = sigma_of(log[CHANNEL], 1e-5)
        stretches = []
        for start in np.arange(time[0], time[-1] - 0.5 * params.window, params.window):
            t, y = take_samples(log[CHANNEL], params, start)
            if len(t) < FEWEST:
                continue
            away = y[:12, 0] - params.hanging
            guess = np.polynomial.polynomial.polyfit(t[:12] - start, away, 2)[:2]
            span = start, start + params.window
            table = t, y, sigma
            data = {"start": start}
            stretches.append(self.lay_out(number, "swing", [table], span, data, guess, [0.2, 1.0]))
        return stretches

    def simulate(self, lanes: Lanes) -> np.ndarray:
        """See the base class; the unknowns are angle from hanging and rate at the window's start.

        Returns them over the grid.
        """
        p = self.params
        length, viscous, coulomb, quadratic, _, _, clock, spring = lanes.theta.T
        stiffness = p.gravity / (p.length + length)
        viscous = p.viscous + viscous
        coulomb = p.coulomb + coulomb
        quadratic = p.quadratic + quadratic
        push = self.pushes_at(lanes, halves(self._steps))

        def slope(index: int, state: np.ndarray) -> np.ndarray:
            angle, rate = state.T
            sine = np.sin(angle)
            dry = coulomb * np.tanh(rate / SMOOTH)
            friction = viscous * rate + dry + quadratic * np.abs(rate) * rate
            force = push[index] + self.exert("payload force", state)[:, ::2]
            pull = (np.cos(angle) * force[:, 0] + sine * force[:, 1]) / p.length
            change = np.empty_like(state)
            change[:, 0] = rate
            change[:, 1] = -stiffness * sine - spring * angle - friction + pull
            return change

        step = p.window / self._steps * (1.0 + clock[:, None])
        return integrate(slope, lanes.nuisance, self._steps, step)

    def quantities(self, time: np.ndarray, state: np.ndarray) -> dict[str, np.ndarray]:
        """See the base class; the pivot stands upright and still."""
        length = self.params.length
        angle, rate = state.T
        zero = np.zeros(len(state))
        direction = np.stack([np.sin(angle), zero, -np.cos(angle)], axis=1)
        tangent = np.stack([np.cos(angle), zero, np.sin(angle)], axis=1)
        tension = length * rate**2 - self.params.gravity * direction[:, 2]
        return {
            "time": time,
            "payload_pos_w": length * direction,
            "payload_vel_w": length * rate[:, None] * tangent,
            "cable_dir_w": direction,
            "quat_wb": np.tile([0.0, 0.0, 0.0, 1.0], (len(state), 1)),
            "tension": np.maximum(tension, 0.0),
        }

    def measure(self, stretch: Stretch, path: np.ndarray, lanes: Lanes) -> np.ndarray:
        """See the base class."""
        offset, scale, clock = lanes.theta.T[4:7]
        rate = path[..., 1] * (1.0 + clock)[:, None]
        grid = stretch.data["start"] + np.linspace(0.0, self.params.window, path.shape[1])
        angle = CubicHermiteSpline(grid, path[..., 0], rate, axis=1)(stretch.time)
        return angle * (1.0 + scale)[:, None] + offset[:, None] + self.params.hanging
