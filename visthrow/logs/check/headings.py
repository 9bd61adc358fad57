"""By which angle about z the frame of a path is turned beside that of an attitude."""

from dataclasses import dataclass

import numpy as np

from visthrow.logs.check import relations

# of a capture's frame after a wand calibration, deviation [rad]: the prior of frame_tilt_x
_ALIGNED = 0.0175


@dataclass(frozen=True)
class Turn:
    """The angle by which level accelerations are turned beside the push that makes them."""

    angle: float  # [rad]
    sd: float  # [rad]
    nats: float  # by which any angle explains them better than one of a calibrated frame
    alone: float  # share of the push's power that no delay, drag or wind makes as well


def turn_of(time: np.ndarray, acc: np.ndarray, pushed: np.ndarray, velocity: np.ndarray) -> Turn:
    """Return the angle by which a path is turned beside what pushes the vehicle.

    As complex numbers x + i y, accelerations are those of the push times one factor, whose angle is
    the turn. Beside it stand the push's derivative, for a stream may be late, the velocity, for
    drag, and a constant, for wind: on a circle drag turns as well. What other bodies pull is in the
    misfit: the factor's deviation is that by which stretches of the flight disagree.

    Args:
        time: of all samples [s], shape (N,).
        acc: of the path [m/s^2], shape (N, 3).
        pushed: acceleration that the attitude's push would make [m/s^2], shape (N, 3).
        velocity: of the path [m/s], shape (N, 3).
    """
    force, level, speed = (v[:, 0] + 1j * v[:, 1] for v in (pushed, acc, velocity))
    beside = np.column_stack([np.gradient(force, time), speed, np.ones_like(force)])
    # of the push, what no delay, drag or wind does as well
    alone = force - beside @ np.linalg.lstsq(beside, force, rcond=None)[0]
    power = np.vdot(alone, alone).real
    share = float(power / max(np.vdot(force, force).real, 1e-300))
    if power <= 0.0:
        return Turn(0.0, np.inf, 0.0, share)
    factor = complex(np.vdot(alone, level) / power)
    whole = np.column_stack([force, beside])
    misfit = level - whole @ np.linalg.lstsq(whole, level, rcond=None)[0]
    edges = np.linspace(0, len(time), relations.BLOCKS, endpoint=False).astype(int)
    scores = np.add.reduceat(np.conj(alone) * misfit, edges) / power
    sd = np.sqrt(0.5 * relations.variance_of_sum(scores))  # of each component
    across = abs(factor.imag) if factor.real > 0.0 else abs(factor)
    size = max(abs(factor), 1e-300)
    width = np.hypot(sd / size, _ALIGNED)
    nats = 0.5 * (across / (size * width)) ** 2 - max(np.log(np.sqrt(2.0 * np.pi) / width), 0.0)
    return Turn(float(np.angle(factor)), float(sd / size), float(nats), share)
