"""Hover calibration: the camera's tilt, scale and latency and the thrust, from seconds of hover
that end in a small sway. Onboard-safe.

A hanging ball shows where down is; a sway turns the camera against it. One least-squares problem
holds it all: the vehicle's path, its attitude and the swing as unknowns at every step, tied by the
momentum of both bodies, the pendulum and the gyro, and what calibration asks for as constants: the
maximum a posteriori, as a Kalman smoother would find it, with the constants' covariance. What a run
cannot tell (a lens out of place, biases of motion capture and keypoints) are constants too, each
with its own spread, so that the answer's uncertainty has them in it.

Source: Gauss-Newton on a Markov chain, Bell, "The iterated Kalman smoother as a Gauss-Newton
method", SIAM J. Optim. 4(3), 1994.
Convention: the latency is the keypoints' age beyond that of the poses that come with them. The
camera's turn is a rotation vector in the body frame, ``rot_bc = exp(turn) rot_bc_nominal``, as in
`camera.keypoints.KeypointCamera.extrinsics`."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy import ndarray
from torch import Tensor

from camera.keypoints import (
    GOAL_KEYPOINTS,
    KeypointCamera,
    ball_extremes_c,
    box_midpoints,
    goal_corners_w,
)
from camera.mount import rotation_from_vector
from camera.params import CameraParams
from visthrow import config
from visthrow.common.errors import VisthrowError
from visthrow.common.free_fall import GRAVITY
from visthrow.config.bounds import Bounded, Positive, Vector
from visthrow.onboard.observations import rotation_from_quat

STATE = {"pos": 3, "vel": 3, "turn": 3, "swing": 2, "swing_rate": 2}
"""Unknowns of each step: vehicle [m, m/s], attitude from the measured one [rad], horizontal part of
the rope's direction and its rate.
"""

CONSTANTS = {
    "camera": 3,
    "scale": 1,
    "latency": 1,
    "thrust": 1,
    "length": 1,
    "drag": 1,
    "attitude": 3,
    "gyro": 3,
    "wind": 2,
    "ball": 3,
    "corners": 2,
    "lens": 3,
    "goal": 2,
}
"""Unknowns that stay the same; see `Spreads`."""

LEAST_STEPS = 75  # of a calibration
LEAST_VISIBLE = 0.5  # share of the steps in which the ball is detected
ROUNDS = 12  # of Gauss-Newton at most
SETTLED = 1e-3  # step of a constant in its spreads below which it has settled
OUTLIER = 3.0  # standard deviations beyond which a sighting counts less (Huber)


@dataclass(frozen=True)
class Spreads(Bounded):
    """Standard deviations.

    Of what is measured, each axis and step; of constants that are not asked for; of the model.
    """

    pos: Positive = 0.01  # [m]
    vel: Positive = 0.01  # [m/s]
    attitude: Positive = 0.01  # [rad]
    # of attitude about the body's z over that about x and y, bias too [-]: two columns of the
    # rotation tell it
    heading: Positive = 0.7071
    rate: Positive = 0.01  # [rad/s]
    keypoint: Positive = 0.01  # normalised [-]
    pose_bias: Positive = 0.001  # of attitude and gyro [rad, rad/s]
    keypoint_bias: Positive = 0.001  # each keypoint [-]
    lens: Positive = 0.0003  # place of the lens on the body [m]
    goal: Positive = 0.001  # place of the goal [m]
    length: Positive = 0.03  # of the rope, relative [-]
    drag: Positive = 0.3  # of the rotors, over the mass [1/s]
    wind: Positive = 0.01  # steady horizontal push [m/s^2]
    push: Positive = 0.1  # unsteady one on both bodies, each step [m/s^2]
    lift: Positive = 0.5  # likewise along the body's z, where thrust is late and unsteady
    pendulum: Positive = 0.05  # of the ball's equation of motion, each step [m/s^2]
    tilt: Positive = 0.2  # before anything is known [rad]
    scale: Positive = 0.03  # of the focal length, likewise, relative [-]
    latency: Positive = 0.05  # likewise [s]
    thrust: Positive = 0.3  # likewise, relative [-]


@dataclass(frozen=True)
class Hovered:
    """The measurements of a hover, a row for each step, on one clock."""

    time: ndarray  # [s], shape (N,)
    pos_w: ndarray  # [m], shape (N, 3)
    quat_wb: ndarray  # xyzw, shape (N, 4)
    vel_w: ndarray  # [m/s], shape (N, 3)
    rate_b: ndarray  # [rad/s], shape (N, 3)
    thrust: ndarray  # commanded, collective [N], shape (N,)
    keypoints: ndarray  # normalised [-], shape (N, 8, 2)
    valid: ndarray  # shape (N, 8), bool
    goal_w: ndarray  # [m], shape (3,)
    # of the keypoints beyond the poses', as far as it is stated [s], shape (N,); None: 0
    age: ndarray | None = None


@dataclass(frozen=True)
class Calibration:
    """The estimates from a hover, each with its standard deviation."""

    # of the camera from its nominal pose: roll, pitch, yaw [rad]
    turn_b: Vector
    turn_sigma: Vector  # [rad]
    latency: float  # of the keypoints beyond the poses' and beyond what is stated [s]
    latency_sigma: float  # [s]
    thrust: float  # that acts, over what is commanded [-]
    thrust_sigma: float  # [-]
    misfit: float  # RMS of the sightings over their spread [-]
    steps: int
    scale: float = 0.0  # of the focal length over the nominal one, less 1 [-]
    scale_sigma: float = 0.0  # [-]

    def values(self) -> dict[str, Any]:
        """Return the estimates for JSON."""
        return config.to_dict(self)

    @classmethod
    def of(cls, values: dict[str, Any]) -> "Calibration":
        """Return the inverse of `values`."""
        fields = {}
        for name, value in values.items():
            fields[name] = tuple(value) if isinstance(value, list) else value
        return cls(**fields)

    def __str__(self) -> str:
        """For the pilot."""
        turns = [
            (
                f"{name} {np.degrees(x):+.2f} +- {np.degrees(sigma):.2f} deg"
                if name != "yaw" or sigma < UNKNOWN_YAW
                else "yaw unknown"
            )
            for name, x, sigma in zip(("roll", "pitch", "yaw"), self.turn_b, self.turn_sigma)
        ]
        return (
            f"camera {', '.join(turns)}; scale {1.0 + self.scale:.3f} +- {self.scale_sigma:.3f}; "
            f"latency {1e3 * self.latency:.0f} +- {1e3 * self.latency_sigma:.0f} ms; "
            f"thrust {self.thrust:.3f} +- {self.thrust_sigma:.3f} of the commanded"
        )


# standard deviation of the camera's yaw above which it counts as unknown [rad]
UNKNOWN_YAW = math.radians(2.0)


class CalibrationError(VisthrowError):
    """A hover shows too little to calibrate by."""


NO_ANSWER = "calibration found no finite answer; expected finite poses, thrusts and keypoints"

HOVER = 1.5  # duration of a hover before the sway [s]
SWAY = 1.5  # duration of the sway [s]

SWAY_RATE = 1.0
SWAY_FREQUENCY = 4.0 / 3.0
"""Amplitude of roll and pitch rate, 7 deg of tilt about either axis [rad/s]; above the swing's
frequency: the rope does not follow [Hz].
"""


def sway(
    since: float, rate: float = SWAY_RATE, frequency: float = SWAY_FREQUENCY
) -> tuple[float, float]:
    """Roll and pitch rate of the sway [rad/s], so long after its begin [s]: once to and fro along a
    diagonal, then along the other one.

    A camera's yaw turns the path that the ball takes in the image, latency puts it off along
    itself. On a circle the two are the same; the sum of their products is the area that a path
    encloses, and lines enclose none."""
    swung = rate * math.cos(2.0 * math.pi * frequency * since)
    return swung, swung if int(frequency * since + 1e-9) % 2 == 0 else -swung


class CalibrationProblem:
    """Residuals of a hover, over their spreads; all arguments carry a batch axis B in front, for
    differences.
    """

    def __init__(
        self, hovered: Hovered, camera: KeypointCamera, contract: dict[str, Any], spreads: Spreads
    ):
        """Take the measurements, the nominal camera, float64, and of the policy's contract masses
        and rope.

        Raises CalibrationError: too few steps, or too few that show the ball.
        """
        count = len(hovered.time)
        visible = hovered.valid[:, GOAL_KEYPOINTS:].all(1)
        if count < LEAST_STEPS or visible.mean() < LEAST_VISIBLE:
            raise CalibrationError(
                f"calibration from {count} steps, the ball seen in {100 * visible.mean():.0f} % of"
                f" them; expected {LEAST_STEPS} or more, and {100 * LEAST_VISIBLE:.0f} %"
            )
        tensor = lambda value: torch.tensor(np.asarray(value), dtype=torch.float64)  # noqa: E731
        rope = contract["rope"]
        body = contract["vehicle"]["body"]
        self.camera = camera
        self.spreads = spreads
        self.vehicle = body["mass"]
        self.load = rope["payload_mass"] + 0.5 * rope["rope_mass"]
        self.length = rope["length"] + rope["payload_offset"]
        self.mount = tensor(rope["mount"])
        moment = rope["payload_mass"] * self.length + 0.5 * rope["rope_mass"] * rope["length"]
        inertia = (
            rope["payload_mass"] * self.length**2
            + rope["payload_inertia"]
            + rope["rope_mass"] * rope["length"] ** 2 / 3.0
        )
        self.swung = inertia / moment  # to the centre of oscillation [m]
        self.time = tensor(hovered.time)
        self.goal = tensor(hovered.goal_w)
        self.dt = self.time.diff()
        self.age = tensor(np.zeros(count) if hovered.age is None else hovered.age)
        self.pos, self.vel, self.rate, self.thrust = (
            tensor(getattr(hovered, n)) for n in ("pos_w", "vel_w", "rate_b", "thrust")
        )
        self.base, self.mean_rate = rotation_from_quat(tensor(hovered.quat_wb)), _means(self.rate)
        points = tensor(hovered.keypoints)
        self.ball = _box(points[:, GOAL_KEYPOINTS:])
        self.corners = points[:, :GOAL_KEYPOINTS].mean(1)
        self.ball_visible = torch.from_numpy(visible)
        self.corners_visible = torch.from_numpy(hovered.valid[:, :GOAL_KEYPOINTS].all(1))
        self._set_priors()

    def _set_priors(self) -> None:
        """Set the deviations of constants, pushes and attitudes from the spreads."""
        s = self.spreads
        make = {"dtype": torch.float64}
        named = {"camera": "tilt", "attitude": "pose_bias", "gyro": "pose_bias"}
        named |= dict.fromkeys(("ball", "corners"), "keypoint_bias")
        spreads = [max(getattr(s, named.get(name, name)), 1e-9) for name in CONSTANTS]
        widths = torch.tensor(list(CONSTANTS.values()))
        self.prior = torch.tensor(spreads, **make).repeat_interleave(widths)
        self.push = torch.tensor([s.push, s.push, s.lift], **make)
        self.attitude = torch.tensor([s.attitude, s.attitude, s.heading * s.attitude])
        parts = self.split(self.prior[None])
        parts["attitude"][0, 2] *= s.heading
        for name in ("ball", "corners"):
            parts[name] *= 0.5

    def start(self) -> tuple[Tensor, Tensor]:
        """Unknowns to begin from: what was measured and a rope at rest, shape (N, 13); constants,
        shape (C,).
        """
        zeros = self.pos.new_zeros(len(self.time), 7)
        return torch.cat([self.pos, self.vel, zeros], -1), torch.zeros_like(self.prior)

    def split(self, constants: Tensor) -> dict[str, Tensor]:
        """Constants by name, each (B, n)."""
        return dict(zip(CONSTANTS, constants.split(list(CONSTANTS.values()), -1)))

    def steps(self, x: Tensor, constants: Tensor) -> Tensor:
        """Residuals of steps k to k + 1 and of what was measured at k, (B, N - 1, 20), of unknowns,
        (B, N, 13), and constants, (B, C).
        """
        c = self.split(constants)
        s = self.spreads
        dt = self.dt[:, None]
        pos, vel, turn, swing, swing_rate = x.split(list(STATE.values()), -1)
        rot = self.base @ rotation_from_vector(turn)
        rate = self.rate - c["gyro"][:, None]
        rope, rope_rate = _rope(swing, swing_rate)
        hung = vel + _rotate(rot, torch.linalg.cross(rate, self.mount.expand_as(rate)))
        longer = 1.0 + c["length"][:, None]
        ball, swung = (hung + size * longer * rope_rate for size in (self.length, self.swung))
        mean = lambda value: 0.5 * (value[:, :-1] + value[:, 1:])  # noqa: E731
        jump = lambda value: value[:, 1:] - value[:, :-1]  # noqa: E731
        total = self.vehicle + self.load
        lift = (1.0 + c["thrust"][:, None]) * self.thrust[:-1, None] / total
        up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        wind = torch.nn.functional.pad(c["wind"], (0, 1))[:, None]
        pushed = wind - c["drag"][:, None] * mean(vel)
        momentum = (
            (self.vehicle * jump(vel) + self.load * jump(ball)) / (total * dt)
            - lift * mean(rot[..., 2])
            + GRAVITY * up
            - pushed
        )
        falling = jump(swung) / dt + GRAVITY * up
        direction = mean(rope)
        perpendicular = falling - direction * (falling * direction).sum(-1, keepdim=True)
        # Magnus: of a rate that is linear in a step
        coning = torch.linalg.cross(rate[:, :-1], rate[:, 1:]) * dt * dt / 12.0
        inverse = rot[:, :-1].mT
        turned = _vector(inverse @ rot[:, 1:]) - (self.mean_rate - c["gyro"][:, None]) * dt - coning
        off = (
            _rotate(inverse, momentum) / self.push,
            perpendicular[..., :2] / s.pendulum,
            (jump(pos) - mean(vel) * dt) / 1e-4,
            (jump(swing) - mean(swing_rate) * dt) / 2e-4,
            turned / (s.rate * dt + 1e-4),
            (pos - self.pos)[:, :-1] / s.pos,
            (vel - self.vel)[:, :-1] / s.vel,
            (turn + c["attitude"][:, None])[:, :-1] / self.attitude,
        )
        return torch.cat(off, -1)

    def places(self, latency: Tensor) -> tuple[Tensor, Tensor]:
        """Return the steps j that sightings fall behind, and the share of the way to j + 1, each
        (N,).
        """
        time = self.time
        when = (time - self.age - latency).clamp(min=time[0], max=time[-1] - 1e-9)
        j = (torch.searchsorted(time, when, right=True) - 1).clamp(0, len(time) - 2)
        return j, (when - time[j]) / self.dt[j]

    def sightings(self, x: Tensor, constants: Tensor, j: Tensor) -> Tensor:
        """Residuals of ball, its size and goal in the image, over their spreads, shape (B, N, 5);
        zero where not seen. Arguments as of `steps`; j: steps that the sightings fall behind, shape
        (N,), held while differences are taken.
        """
        camera = self.camera
        c = self.split(constants)
        s = self.spreads
        dt = self.dt[j][:, None]
        u = ((self.time - self.age - self.time[j]) - c["latency"])[..., None] / dt
        pos, vel, turn, swing, swing_rate = x.split(list(STATE.values()), -1)
        rate = self.rate - c["gyro"][:, None]
        rot = self.base @ rotation_from_vector(turn)
        chord = _vector(rot[:, j].mT @ rot[:, j + 1])
        attitude = rot[:, j] @ rotation_from_vector(_hermite(chord, rate, j, u, dt))
        body_w = _cubic(pos, vel, j, u, dt)
        leaning = _cubic(swing, swing_rate, j, u, dt)
        rope, _ = _rope(leaning, torch.zeros_like(leaning))
        length = self.length * (1.0 + c["length"][:, None])
        ball_w = body_w + _rotate(attitude, self.mount.expand_as(body_w)) + length * rope
        goal_w = self.goal + torch.nn.functional.pad(c["goal"], (0, 1))
        corners_w = goal_corners_w(goal_w, camera.square_w)
        corners_w = corners_w[:, None].expand(-1, body_w.shape[1], -1, -1)
        offsets = torch.cat([corners_w, ball_w[:, :, None]], 2) - body_w[:, :, None]
        place = camera.position_b + c["lens"]
        in_body = torch.einsum("bnji,bnkj->bnki", attitude, offsets) - place[:, None, None]
        rot_bc = rotation_from_vector(c["camera"]) @ camera.rot_cb.T
        in_camera = torch.einsum("bji,bnkj->bnki", rot_bc, in_body)
        flat = in_camera.flatten(0, 1)
        lens = camera.fisheye
        rays = ball_extremes_c(lens, flat[:, 4], camera.params.payload_radius)
        points, _ = lens.project_normalized(torch.cat([flat[:, :4], rays], -2), clip=True)
        size = 1.0 + c["scale"][:, None]
        middle = points[:, :4].mean(1).unflatten(0, body_w.shape[:2])
        box = _box(box_midpoints(points[:, 4:])).unflatten(0, body_w.shape[:2])
        ball = size * box + c["ball"][:, None] - self.ball
        corners = size * middle + c["corners"][:, None] - self.corners
        visible = (ball * self.ball_visible[:, None], corners * self.corners_visible[:, None])
        return torch.cat(visible, -1) / (0.5 * s.keypoint + 1e-4)


def _box(points: Tensor) -> Tensor:
    """Middle and mean half side of boxes by their edges' midpoints, shape (N, 4, 2):
    shape (N, 3).
    """
    x = points[:, 0, 0]
    top = points[:, 1, 1]
    right = points[:, 2, 0]
    bottom = points[:, 3, 1]
    return torch.cat([points.mean(1), 0.25 * (right - x + bottom - top)[:, None]], -1)


def _means(values: Tensor) -> Tensor:
    """Mean over each step between values that are evenly apart, shape (N, 3): by the cubic through
    four of them, at the ends by the chord.

    A chord is short by (frequency dt)^2 / 12 of a swing, 0.2 % of the sway, which would pass for
    another focal length."""
    chord = 0.5 * (values[1:] + values[:-1])
    inner = (13.0 * (values[1:-2] + values[2:-1]) - values[:-3] - values[3:]) / 24.0
    return torch.cat([chord[:1], inner, chord[-1:]])


def _rotate(rot: Tensor, vector: Tensor) -> Tensor:
    """Vectors turned by rotations of the same batch."""
    return (rot @ vector.unsqueeze(-1)).squeeze(-1)


def _rope(swing: Tensor, rate: Tensor) -> tuple[Tensor, Tensor]:
    """Direction of a hanging rope and its rate, from their horizontal parts."""
    down = (1.0 - (swing * swing).sum(-1, keepdim=True)).clamp(min=1e-2).sqrt()
    fall = (swing * rate).sum(-1, keepdim=True) / down
    return torch.cat([swing, -down], -1), torch.cat([rate, fall], -1)


def _vector(rot: Tensor) -> Tensor:
    """Rotation vectors of small rotations."""
    twice = rot - rot.mT
    skew = 0.5 * torch.stack([twice[..., 2, 1], twice[..., 0, 2], twice[..., 1, 0]], -1)
    sine2 = (skew * skew).sum(-1, keepdim=True)
    return skew * (1.0 + sine2 / 6.0 + 3.0 * sine2 * sine2 / 40.0)  # arcsin(s) / s


def _cubic(value: Tensor, slope: Tensor, j: Tensor, u: Tensor, dt: Tensor) -> Tensor:
    """Cubic through values and slopes of steps j and j + 1 at a share u of the way."""
    chord = value[:, j + 1] - value[:, j]
    return value[:, j] + _hermite(chord, slope, j, u, dt)


def _hermite(chord: Tensor, slope: Tensor, j: Tensor, u: Tensor, dt: Tensor) -> Tensor:
    """Rise of a cubic from step j to a share u of its chord to j + 1, by the slopes of both."""
    bend = (1 - u) * (slope[:, j] * dt - chord) - u * (slope[:, j + 1] * dt - chord)
    return u * chord + u * (1 - u) * bend


def calibrate(
    hovered: Hovered,
    camera: KeypointCamera,
    contract: dict[str, Any],
    spreads: Spreads | None = None,
) -> Calibration:
    """Find the camera's turn and latency and the thrust, with the policy's nominal camera, float64,
    and contract.

    Raises CalibrationError: it shows too little, or nothing fits.

    Args:
        hovered: a hover of some 3 s that ends in a sway. camera, contract: see above.
        spreads: of noise and of what is known; left out, those of the training.
    """
    problem = CalibrationProblem(hovered, camera, contract, spreads or Spreads())
    x, c = problem.start()
    for _ in range(ROUNDS):
        try:
            factor, gradient, misfit = _linearise(problem, x, c)
        except RuntimeError as error:  # of a factorisation
            raise CalibrationError(f"{NO_ANSWER}: {error}") from error
        step = torch.cholesky_solve(-gradient[:, None], factor)[:, 0]
        width = x.numel()
        x = x + step[:width].reshape(x.shape)
        moved = step[width:]
        c = c + moved
        if not bool(torch.isfinite(c).all()):
            raise CalibrationError(NO_ANSWER)
        if float((moved / problem.prior).abs().max()) < SETTLED:
            break
    else:
        raise CalibrationError(
            f"calibration did not settle in {ROUNDS} rounds; expected a hover that ends in a sway,"
            " its ball in view"
        )
    covariance = torch.cholesky_inverse(factor[width:, width:])  # the constants stand last
    sigma = problem.split(covariance.diagonal().sqrt()[None])
    estimates = problem.split(c[None])
    row = lambda table, name: tuple(table[name][0].tolist())  # noqa: E731
    return Calibration(
        row(estimates, "camera"),
        row(sigma, "camera"),
        estimates["latency"].item(),
        sigma["latency"].item(),
        1.0 + estimates["thrust"].item(),
        sigma["thrust"].item(),
        misfit,
        len(problem.time),
        estimates["scale"].item(),
        sigma["scale"].item(),
    )


def try_calibration(
    hovered: Hovered, camera: CameraParams, contract: dict[str, Any], spreads: Spreads | None = None
) -> Calibration | str:
    """Return the calibration of a hover by :func:`calibrate`, or the reason of its failure: a task
    for another process.
    """
    try:
        return calibrate(hovered, KeypointCamera(camera, dtype=torch.float64), contract, spreads)
    except CalibrationError as error:
        return str(error)


def _linearise(problem: CalibrationProblem, x: Tensor, c: Tensor) -> tuple[Tensor, Tensor, float]:
    """Cholesky factor of the normal equations about unknowns, the gradient there, and the misfit of
    the sightings.

    A residual hangs on two neighbouring steps at most, so two perturbations give a derivative for
    all of them."""
    count, width = x.shape
    h = 1e-5
    j, _ = problem.places(problem.split(c[None])["latency"][0, 0])
    xs = x.repeat(1 + 2 * width + len(c), 1, 1)
    cs = c.repeat(1 + 2 * width + len(c), 1)
    for i in range(width):
        for parity in (0, 1):
            xs[1 + 2 * i + parity, parity::2, i] += h
    cs[1 + 2 * width :] += h * torch.eye(len(c), dtype=c.dtype)
    flat = torch.zeros_like(x).flatten()
    prior = torch.cat([flat, 1.0 / problem.prior**2])
    normal = torch.diag(prior + 1e-9)
    gradient = prior * torch.cat([flat, c])
    for values, step in (
        (problem.steps(xs, cs), torch.arange(count - 1)),
        (problem.sightings(xs, cs, j), j),
    ):
        base = values[0]
        off = (values[1:] - values[:1]) / h
        if step is j:
            terms = max(int((base != 0.0).sum()), 1)
            misfit = float(base.square().sum().sqrt() / terms**0.5)
            ball, goal = (part.norm(dim=-1, keepdim=True) for part in base.split((3, 2), -1))
            sizes = torch.cat([ball.expand(-1, 3), goal.expand(-1, 2)], -1)
            weight = (OUTLIER / sizes.clamp(min=1e-9)).clamp(max=1.0).sqrt()
            base = base * weight
            off = off * weight
        even = off[: 2 * width : 2]
        odd = off[1 : 2 * width : 2]
        is_even = (step % 2 == 0)[:, None]
        at_step = torch.where(is_even, even, odd)
        at_next = torch.where(is_even, odd, even)
        slopes = torch.cat([at_step, at_next, off[2 * width :]]).permute(1, 2, 0)
        first = step[:, None] * width + torch.arange(2 * width)
        shared = count * width + torch.arange(len(c)).expand(len(step), -1)
        unknowns = torch.cat([first, shared], 1)
        blocks = slopes.mT @ slopes
        normal.index_put_((unknowns[:, :, None], unknowns[:, None]), blocks, accumulate=True)
        gradient.index_put_((unknowns,), (slopes.mT @ base[..., None])[..., 0], accumulate=True)
    return torch.linalg.cholesky(normal), gradient, misfit
