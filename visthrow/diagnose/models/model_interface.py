"""The interface between models and the selection of effects.

The selection (:mod:`visthrow.diagnose.select`) does not depend on vehicles or ropes. It works on
windows of residuals

    r = S theta + X b + G a + e

with the sizes theta of the effects, the unknown initial state b of the window, latent forces a and
sensor noise e. The whole throw, a vehicle without payload, a ball in flight, a pendulum, a motor on
a stand and a camera compared with motion capture are such models."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy import ndarray

from sim.effects.effect import Effect
from sim.params import LawParams

Indices = Sequence[int]
"""Indices of effects, windows or flights, from 0."""
Sizes = Mapping[str, float]
"""Sizes of effects by their names, in their units; an effect that is not among them has size 0."""


def _no_indices() -> ndarray:
    return np.zeros(0, dtype=int)


@dataclass(frozen=True)
class Window:
    """Residuals and derivatives of a part of a flight at a linearisation point theta.

    N samples (every component of a channel is a separate sample), K effects in the model's order,
    D nuisances, G latent-force coefficients."""

    flight: int  # index of the flight
    phase: str  # hover, flight, throw or ballistic; free text for other models
    time: ndarray  # of the samples, in the flight's clock [s], shape (N,)
    channel: ndarray  # index into Model.channels, shape (N,)
    # measured minus simulated, extrapolated to b = 0, in the channel's unit, shape (N,)
    residual: ndarray
    sigma: ndarray  # standard deviation of the sensor noise, same unit, shape (N,)
    effects: ndarray  # S: derivatives of the simulated samples by theta, shape (N, K)
    nuisance: ndarray  # X, shape (N, D)
    nuisance_sd: ndarray  # standard deviation of the vague prior of b, shape (D,)
    latent: ndarray = field(default_factory=lambda: np.zeros((0, 0)))  # G, shape (N, G)
    # index into LATENT_BLOCKS, shape (G,)
    latent_block: ndarray = field(default_factory=_no_indices)
    latent_axis: ndarray = field(default_factory=_no_indices)  # 0, 1, 2 for x, y, z, shape (G,)
    # time of the knot [s], shape (G,); each block and axis has the same knots, in order
    latent_time: ndarray = field(default_factory=lambda: np.zeros(0))
    knots: Mapping[str, ndarray] = field(default_factory=dict)
    """Simulated quantities at the knots of the latent forces, shape (knots, ...), for laws outside
    the catalogue: ``time``, ``pos_w``, ``vel_w``, ``quat_wb``, ``rate_b``, ``thrust`` [N],
    ``payload_pos_w``, ``payload_vel_w``, ``cable_dir_w``, ``tension`` [N], ``mount_b`` (of the
    rope, from the centre of mass) [m, body frame].
    """
    # whether its initial motion is unknowable, such as that of a rope that has just become taut
    shaken: bool = False
    correlated: tuple[tuple[ndarray, ndarray], ...] = ()
    """For each channel with correlated noise: rows of its samples, shape (stamps, components), and
    the lower Cholesky factor of the correlation of a component's noise, shape (stamps, stamps).
    """


@dataclass(frozen=True)
class Linearised:
    """The point at which derivatives were taken, with the derivatives, from which initial states
    are adjusted to other sizes of the effects.

    Without the adjustment, a window would begin with a transient that the derivatives do not
    contain, such as unbalanced rotors."""

    theta: Sizes  # argument of :meth:`Model.windows`
    windows: Mapping[int, Window]  # returned windows, by index


LATENT_BLOCKS = ("vehicle force", "vehicle torque", "payload force")
"""Latent forces [N, world frame], torques [N m, body frame] and forces on the payload [N, world
frame].
"""


class Model(Protocol):
    """A simulation of measured flights that can be linearised at any sizes of its effects.

    A model is a subclass with effects, channels, windows and residuals. The defaults of all other
    methods mean that the model lacks that capability."""

    effects: Sequence[Effect]
    # names, such as "pos_w"; units are those of visthrow.logs.flightlog.STANDARD_CHANNELS
    channels: Sequence[str]
    device: str = "cpu"  # of the simulation
    days: Indices = ()  # day of each flight, by index; empty if the logs do not state it
    mistakes: Sequence[Any] = ()  # mistakes of the logs that were corrected
    cheap: bool = False  # whether derivatives are taken again at each step of the search
    bends: bool = False  # whether laws are so nonlinear that the search must simulate them
    middle_speed: float = 0.0  # median speed of the rotors [rad/s]; 0 if not measured
    lawless: str = ""  # why no law outside the catalogue can act in the model
    notes: Sequence[str] = ()  # sentences about parts of the flights that are not used
    not_offered: int = 0  # number of applicable effects that the user excluded

    def windows(self, theta: Sizes) -> list[Window]:
        """Simulate all windows with the effects at ``theta`` (0 by default), and linearise
        there.
        """
        ...

    def residuals(self, theta: Sizes, linearised: Linearised) -> list[ndarray]:
        """Return the residuals of :meth:`windows` alone, one array of shape (N,) for each window.

        Args:
            theta: sizes of the effects.
            linearised: where the caller's derivatives were taken, with the same kinds of blocks.
                Initial states start from those at that point and are adjusted to the effects. The
                linear effect of the adjustment is added to the residuals, which then belong to
                b = 0. A model that fits initial states in every simulation ignores it.
        """
        ...

    def possible(self, theta: Sizes) -> Sizes:
        """Limit sizes, each within its bounds, to what is possible together."""
        return theta

    def plain(self) -> "Model":
        """Return the model without its extensions."""
        return self

    def with_laws(self, laws: Sequence[LawParams]) -> "Model":
        """Return the model with further laws; itself if none can act in it."""
        return self

    def without_commands(self, theta: Sizes, windows: Indices) -> list[ndarray]:
        """Return the change of some windows' samples if a command is lost, for each command, shape
        (N, T) each; empty if the model has no commands.

        Args:
            theta: sizes of the effects, with which :meth:`windows` was called before.
            windows: indices of the windows that it returned.
        """
        return []

    def step_error(self) -> dict[str, float] | None:
        """Return the largest change of any sample of each channel by a finer integration step,
        relative to its noise; None if the model has no step.
        """
        return None

    def landings(self, theta: Sizes, flights: Indices | None = None) -> Any | None:
        """Return predicted and measured landings (``PredictedLandings``); None if no landing was
        measured.
        """
        return None
