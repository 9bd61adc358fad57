"""What a model must give to be diagnosed: effects that could be missing from it, and its residuals
linearised in them.

The selection of causes (:mod:`visthrow.diagnose.select`) knows nothing of vehicles or ropes.
It sees windows of residuals

    r = S theta + X b + G a + e

with theta the sizes of the effects, b what is not known at the start of the window, a the latent
forces, e sensor noise. The whole throw, a vehicle without payload, a ball in flight, a pendulum, a
motor on a stand and a camera against motion capture are models of this one kind."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy import ndarray

from sim.effects.effect import Effect
from sim.params import LawParams


def _no_indices() -> ndarray:
    return np.zeros(0, dtype=int)


@dataclass(frozen=True)
class Window:
    """Residuals of one stretch of a flight, about a linearisation point theta.

    N samples (every component of every channel is a sample of its own), K effects in the model's
    order, D nuisances, G latent-force coefficients."""

    flight: int  # number of the flight it was cut from
    phase: str  # hover, flight, throw or ballistic; free text for other models
    time: ndarray  # of the samples, in the flight's clock [s], shape (N,)
    channel: ndarray  # index into Model.channels, shape (N,)
    # measured minus simulated, from b = 0 along the derivatives, in the channel's unit, shape (N,)
    residual: ndarray
    sigma: ndarray  # standard deviation of the sensor noise, same unit, shape (N,)
    effects: ndarray  # S: derivative of the simulated sample by theta, shape (N, K)
    nuisance: ndarray  # X, shape (N, D)
    nuisance_sd: ndarray  # vague prior of b, about 0, shape (D,)
    latent: ndarray = field(default_factory=lambda: np.zeros((0, 0)))  # G, shape (N, G)
    # index into LATENT_BLOCKS, shape (G,)
    latent_block: ndarray = field(default_factory=_no_indices)
    latent_axis: ndarray = field(default_factory=_no_indices)  # 0, 1, 2 for x, y, z, shape (G,)
    # of the knot [s], shape (G,): each block and axis has the same ones, in order
    latent_time: ndarray = field(default_factory=lambda: np.zeros(0))
    knots: Mapping[str, ndarray] = field(default_factory=dict)
    """Simulated quantities at the knots of the latent forces, shape (knots, ...), for laws outside
    the catalogue: ``time``, ``pos_w``, ``vel_w``, ``quat_wb``, ``rate_b``, ``thrust`` [N],
    ``payload_pos_w``, ``payload_vel_w``, ``cable_dir_w``, ``tension`` [N], ``mount_b`` (of the
    rope, from the centre of mass) [m, body frame].
    """
    # whether it begins in a motion that nobody can know, such as a rope's that has just come taut
    shaken: bool = False
    correlated: tuple[tuple[ndarray, ndarray], ...] = ()
    """Of channels whose noise is not white: rows of their samples, shape (stamps, components), and
    the lower Cholesky factor of the correlation of a component's noise, shape (stamps, stamps).
    """


@dataclass(frozen=True)
class Linearised:
    """The point at which derivatives were taken, with the derivatives, so that initial states can
    follow the effects from there.

    A window whose state stays behind begins with a transient that no derivative tells of, such as
    rotors out of balance."""

    theta: Mapping[str, float]  # given to :meth:`Model.windows`
    windows: Mapping[int, Window]  # what came, by number


LATENT_BLOCKS = ("vehicle force", "vehicle torque", "payload force")
"""Latent forces [N, world frame], torques [N m, body frame] and forces on the payload [N, world
frame].
"""


class Model(Protocol):
    """A simulation of measured flights that can be linearised about any sizes of its effects.

    A model is a subclass that gives effects, channels, windows and residuals. What else some models
    can do has a default here that says that this one cannot."""

    effects: Sequence[Effect]
    # names, such as "pos_w"; units are those of visthrow.logs.flightlog.STANDARD_CHANNELS
    channels: Sequence[str]
    device: str = "cpu"  # where it simulates, and the algebra of its windows with it
    days: Sequence[int] = ()  # of each flight, by its number; none where the logs do not say
    mistakes: Sequence[Any] = ()  # of the interface, which were corrected in its logs
    cheap: bool = False  # derivatives are taken anew wherever the search goes
    # whether what a law does to a window is far from its share at the knots, so that the search
    # must simulate it
    bends: bool = False
    middle_speed: float = 0.0  # median speed of the rotors [rad/s]; 0 where none is measured
    lawless: str = ""  # why no law outside the catalogue can act in it
    notes: Sequence[str] = ()  # what it does not take of the flights, and why, in sentences
    not_offered: int = 0  # effects that concern the flights, but were not chosen

    def windows(self, theta: Mapping[str, float]) -> list[Window]:
        """Simulate all windows with the effects at ``theta`` (those not named at 0) and linearise
        there.
        """
        ...

    def residuals(self, theta: Mapping[str, float], linearised: Linearised) -> list[ndarray]:
        """Only the residuals of :meth:`windows`, one array of shape (N,) a window; cheaper.

        Args:
            theta: sizes of the effects.
            linearised: where the caller's derivatives were taken, with the same kinds of blocks.
                Initial states begin with those of that place and follow the effects; what that does
                by the derivatives is added to the residuals again, which so are those of b = 0. A
                model that fits initial states in every simulation has no need of it.
        """
        ...

    def possible(self, theta: Mapping[str, float]) -> Mapping[str, float]:
        """Return the sizes, each within its bounds, cut to what the effects can have together."""
        return theta

    def plain(self) -> "Model":
        """Return the model without its extensions."""
        return self

    def with_laws(self, laws: Sequence[LawParams]) -> "Model":
        """Return the model with further laws; itself where none can act in it."""
        return self

    def without_commands(self, theta: Mapping[str, float], windows: Sequence[int]) -> list[ndarray]:
        """Return the change of some windows' samples by each command that does not come, shape
        (N, T) each; none where the model has no commands.

        Args:
            theta: sizes of the effects, at which :meth:`windows` was called before.
            windows: numbers among those that it returned.
        """
        return []

    def step_error(self) -> dict[str, float] | None:
        """Return the largest change of any sample of each channel by a finer step, in its noise;
        None where the step is no approximation.
        """
        return None

    def landings(
        self, theta: Mapping[str, float], flights: Sequence[int] | None = None
    ) -> Any | None:
        """Return predicted and measured landings (``PredictedLandings``); None where no throw's
        landing was measured.
        """
        return None
