"""Angle about z between the frame of a path and the frame of an attitude."""

from dataclasses import dataclass

import numpy as np

from visthrow.logs.check import relations

# sd of a capture frame's angle after a wand calibration [rad], as in the prior of frame_tilt_x
_ALIGNED = 0.0175


@dataclass(frozen=True)
class Turn:
    """Angle about z from the thrust's horizontal acceleration to the measured one."""

    angle: float  # [rad]
    sd: float  # [rad]
    nats: float  # evidence for a free angle over the angle of a calibrated frame
    alone: float  # share of the thrust's power that delay, drag and wind cannot explain


def turn_of(time: np.ndarray, acc: np.ndarray, pushed: np.ndarray, velocity: np.ndarray) -> Turn:
    """Return the angle about z by which a path is turned relative to the thrust's direction.

    Horizontal accelerations, written as complex numbers x + i y, are the thrust's acceleration
    times one factor, whose angle is the turn. Further regressors are the thrust's derivative (a
    delayed stream), the velocity (drag, which on a circle looks like a turn) and a constant (wind).
    Forces of other bodies stay in the residual. So the factor's standard deviation is derived from
    the scatter between blocks of the flight.

    Args:
        time: of all samples [s], shape (N,).
        acc: of the path [m/s^2], shape (N, 3).
        pushed: acceleration by the thrust, along the attitude's axis [m/s^2], shape (N, 3).
        velocity: of the path [m/s], shape (N, 3).
    """
    force, level, speed = (v[:, 0] + 1j * v[:, 1] for v in (pushed, acc, velocity))
    beside = np.column_stack([np.gradient(force, time), speed, np.ones_like(force)])
    # part of the thrust's acceleration that is orthogonal to the other regressors
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
