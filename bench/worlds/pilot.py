"""Pilots of the worlds: references and a position controller that commands collective thrust and
body rates at 50 Hz.
"""

import numpy as np

PERIOD = 0.02
GRAVITY = 9.81
POSITION = np.array([3.0, 3.0, 6.0])
VELOCITY = np.array([2.8, 2.8, 4.0])
ATTITUDE = 4.5
"""Gains [1/s^2], [1/s], [1/s] of the tracking controller: calm with 20 ms more of delay or motor
lag, or 30 % less rate gain.
"""
LEAD = 0.06
"""Preview of the reference's attitude [s]: the known delay and the motors' lag."""
SHAKE = np.array([0.8, 0.8, 0.0])
"""Deviation of rates that are added to free flights, to excite the vehicle [rad/s]."""
TONES = 5
"""Sines that this sums, of 0.8 to 4 Hz."""
MOST_OFF = 1.0
"""Limit of the integral of the position's error [m s]."""
RATE_LIMIT = np.array([10.0, 10.0, 4.0])


def smooth(x: np.ndarray) -> np.ndarray:
    """Rise from 0 to 1 with zero slope and curvature at both ends."""
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10 + x * (-15 + 6 * x))


def gentle(t: float, rise: float = 2.0):
    """A clock that starts from rest, its rate and the change of its rate: cubic rate over ``rise``
    seconds, then 1.
    """
    x = min(t / rise, 1.0)
    return (
        rise * (x**3 - 0.5 * x**4) + max(t - rise, 0.0),
        x * x * (3 - 2 * x),
        6 * x * (1 - x) / rise,
    )


class FreeFlight:
    """Sums of sines about a hover point, slow at the start; reaches some 2.5 m/s."""

    def __init__(self, rng: np.random.Generator, height: float = 1.9, speed: float = 1.0):
        self.frequency = rng.uniform([0.18, 0.18, 0.15], [0.55, 0.55, 0.5], (3, 3)) * 2 * np.pi
        self.phase = rng.uniform(0, 2 * np.pi, (3, 3))
        self.size = speed * np.array([0.95, 0.95, 0.5]) * rng.uniform(0.25, 0.55, (3, 3))
        self.centre = np.array([0.0, 0.0, height])
        self.yaw = rng.uniform(-0.8, 0.8), rng.uniform(0.2, 0.6)
        self.release = np.inf
        self.tones = rng.uniform(0.8, 4.0, (TONES, 3)) * 2 * np.pi
        self.phases = rng.uniform(0, 2 * np.pi, (TONES, 3))

    def shaken(self, t: float) -> np.ndarray:
        """Rates that are added [rad/s]."""
        return (
            SHAKE * gentle(t)[1] * np.sqrt(2 / TONES) * np.sin(self.tones * t + self.phases).sum(0)
        )

    def at(self, t: float):
        tau, pace, change = gentle(t)
        arg = self.frequency * tau + self.phase
        p = self.centre + (self.size * np.sin(arg)).sum(0)
        slope = (self.size * self.frequency * np.cos(arg)).sum(0)
        bend = -(self.size * self.frequency**2 * np.sin(arg)).sum(0)
        return (
            p,
            slope * pace,
            bend * pace**2 + slope * change,
            self.yaw[0] * np.sin(self.yaw[1] * tau),
        )


class Throw:
    """Hover for a second, swing back, accelerate, release, brake; at ``push`` [m/s^2] for half a
    second.
    """

    def __init__(self, rng: np.random.Generator, push: float, heading: float):
        self.along = np.array([np.cos(heading), np.sin(heading), 0.0])
        self.back = rng.uniform(1.5, 3.0)
        self.push = push * rng.uniform(0.9, 1.1)
        self.lift = rng.uniform(0.3, 1.2)
        self.home = np.array(
            [rng.uniform(-0.3, 0.3), rng.uniform(-0.3, 0.3), rng.uniform(1.5, 2.0)]
        )
        self.release = 1.0 + 0.70 + rng.uniform(-0.04, 0.06)
        grid = np.arange(0.0, 4.0, 0.005)
        a = np.outer(self._push(grid), self.along) + np.outer(self._rise(grid), [0.0, 0.0, 1.0])
        v = np.cumsum(a, 0) * 0.005
        self.grid = grid
        self.a = a
        self.v = v
        self.p = self.home + np.cumsum(v, 0) * 0.005

    def shaken(self, t: float) -> np.ndarray:
        """Rates that are added [rad/s]: none, a throw excites by itself."""
        return np.zeros(3)

    def _bump(self, t, start, stop):
        return smooth((t - start) / 0.1) * (1 - smooth((t - stop) / 0.1))

    def _push(self, t):
        drive = -self.back * self._bump(t, 1.0, 1.2) + self.push * self._bump(t, 1.28, 1.75)
        total = np.cumsum(drive) * 0.005
        return drive - total[-1] / 0.45 * self._bump(t, 1.9, 2.25)

    def _rise(self, t):
        return self.lift * (self._bump(t, 1.25, 1.6) - self._bump(t, 1.85, 2.2))

    def at(self, t: float):
        i = min(round(t / 0.005), len(self.grid) - 1)
        return self.p[i], self.v[i], self.a[i], 0.0


def turn_rate(reference, t: float, step: float = 0.01) -> np.ndarray:
    """How fast the thrust that a reference asks for turns [rad/s], world frame."""
    before, after = (
        np.asarray(reference.at(t + h)[2]) + [0.0, 0.0, GRAVITY] for h in (-step, step)
    )
    before = before / np.linalg.norm(before)
    after = after / np.linalg.norm(after)
    return np.cross(before, after) / (2 * step)


class Tracker:
    """Flies lanes along their references from position, velocity, attitude with the noise of a
    tracking system.
    """

    gains = POSITION, VELOCITY, ATTITUDE
    patience = 0.0  # gain of the integral of what is left of the position [1/s^3]
    lead = LEAD

    def __init__(self, references: list, mass: float, ball_mass: float, rng: np.random.Generator):
        self.references = references
        self.rng = rng
        self.with_ball = mass + ball_mass
        self.alone = mass
        self.off = np.zeros((len(references), 3))  # integral of the position's error [m s]

    def command(self, t: float, x, v, q, hanging) -> np.ndarray:
        """Thrust [N] and body rates [rad/s], shape (E, 4), from position, velocity (world),
        attitude (wxyz).
        """
        want = [r.at(t) for r in self.references]
        p_r, v_r, a_r = (np.array([w[i] for w in want]) for i in range(3))
        yaw = np.array([w[3] for w in want])
        x = x + self.rng.normal(0, 1e-3, x.shape)
        v = v + self.rng.normal(0, 2e-2, v.shape)
        position, velocity, attitude = self.gains
        self.off = np.clip(self.off + PERIOD * (p_r - x), -MOST_OFF, MOST_OFF)
        a = a_r + position * (p_r - x) + velocity * (v_r - v) + self.patience * self.off
        a[:, 2] += GRAVITY
        a[:, 2] = np.maximum(a[:, 2], 2.0)
        mass = np.where(hanging, self.with_ball, self.alone)
        w, i, j, k = q.T
        body_x = np.stack([1 - 2 * (j * j + k * k), 2 * (i * j + w * k), 2 * (i * k - w * j)], -1)
        body_y = np.stack([2 * (i * j - w * k), 1 - 2 * (i * i + k * k), 2 * (j * k + w * i)], -1)
        body_z = np.stack([2 * (i * k + w * j), 2 * (j * k - w * i), 1 - 2 * (i * i + j * j)], -1)
        up = a / np.linalg.norm(a, axis=1, keepdims=True)
        ahead = np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], -1)
        side = np.cross(up, ahead)
        side /= np.linalg.norm(side, axis=1, keepdims=True)
        front = np.cross(side, up)
        error = 0.5 * (np.cross(body_x, front) + np.cross(body_y, side) + np.cross(body_z, up))
        in_body = np.stack(
            [(error * body_x).sum(1), (error * body_y).sum(1), (error * body_z).sum(1)], -1
        )
        rates = 2 * attitude * in_body * [1, 1, 0.5]
        if self.lead:
            turning = np.array([turn_rate(r, t + self.lead) for r in self.references])
            rates += np.stack([(turning * body).sum(1) for body in (body_x, body_y, body_z)], -1)
            rates += np.array([r.shaken(t) for r in self.references])
        rates = np.clip(rates, -RATE_LIMIT, RATE_LIMIT)
        thrust = np.clip(mass * (a * body_z).sum(1), 0.3, 13.0)
        return np.column_stack([thrust, rates])
