"""Hover calibration: estimate the camera's rotation, scale and latency and the thrust from a few
seconds of hover that end in a small sway. Onboard-safe.

The hanging ball shows the vertical, and the sway rotates the camera relative to it. A single
least-squares problem is solved. Its unknowns at each step are the vehicle's position, velocity and
attitude and the swing; momentum of both bodies, the pendulum and the gyro relate them. Its constant
unknowns are the parameters to calibrate. The solution is the maximum a posteriori, as of a Kalman
smoother, with the constants' covariance. Errors that a run does not determine (a shifted lens,
biases of motion capture and keypoints) are constants with priors too, so that the covariance
includes them.

Source: Gauss-Newton on a Markov chain, Bell, "The iterated Kalman smoother as a Gauss-Newton
method", SIAM J. Optim. 4(3), 1994.
Convention: the latency is the keypoints' age minus the age of the poses that come with them. The
camera's rotation is a rotation vector in the body frame, ``rot_bc = exp(turn) rot_bc_nominal``, as
in `camera.keypoints.KeypointCamera.extrinsics`."""

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
"""Unknowns of each step: vehicle [m, m/s], rotation from the measured attitude [rad], horizontal
components of the rope's direction and their rates.
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
"""Constant unknown -> number of its components; see `Spreads`."""

LEAST_STEPS = 75  # lowest number of steps for a calibration
LEAST_VISIBLE = 0.5  # lowest share of the steps in which the ball is detected
ROUNDS = 12  # largest number of Gauss-Newton iterations
SETTLED = 1e-3  # convergence: largest change of a constant, in prior standard deviations
OUTLIER = 3.0  # standard deviations above which a detection is down-weighted (Huber)


@dataclass(frozen=True)
class Spreads(Bounded):
    """Standard deviations of measurements, for each axis and step, of constants and of the model's
    errors.
    """

    pos: Positive = 0.01  # [m]
    vel: Positive = 0.01  # [m/s]
    attitude: Positive = 0.01  # [rad]
    # ratio of the attitude's error about body z to that about x and y, also for the bias [-]: the
    # yaw is measured twice, by two columns of the rotation
    heading: Positive = 0.7071
    rate: Positive = 0.01  # [rad/s]
    keypoint: Positive = 0.01  # normalised [-]
    pose_bias: Positive = 0.001  # bias of attitude and gyro [rad, rad/s]
    keypoint_bias: Positive = 0.001  # bias of each keypoint [-]
    lens: Positive = 0.0003  # position of the lens on the body [m]
    goal: Positive = 0.001  # position of the goal [m]
    length: Positive = 0.03  # length of the rope, relative [-]
    drag: Positive = 0.3  # drag of the rotors, over the mass [1/s]
    wind: Positive = 0.01  # constant horizontal acceleration [m/s^2]
    push: Positive = 0.1  # random acceleration of both bodies, each step [m/s^2]
    lift: Positive = 0.5  # the same along body z, where thrust is delayed and varies
    pendulum: Positive = 0.05  # error of the ball's equation of motion, each step [m/s^2]
    tilt: Positive = 0.2  # prior of the camera's rotation [rad]
    scale: Positive = 0.03  # prior of the focal length, relative [-]
    latency: Positive = 0.05  # prior of the latency [s]
    thrust: Positive = 0.3  # prior of the thrust, relative [-]


@dataclass(frozen=True)
class Hovered:
    """The measurements of a hover, one row for each step, on one clock."""

    time: ndarray  # [s], shape (N,)
    pos_w: ndarray  # [m], shape (N, 3)
    quat_wb: ndarray  # xyzw, shape (N, 4)
    vel_w: ndarray  # [m/s], shape (N, 3)
    rate_b: ndarray  # [rad/s], shape (N, 3)
    thrust: ndarray  # commanded, collective [N], shape (N,)
    keypoints: ndarray  # normalised [-], shape (N, 8, 2)
    valid: ndarray  # shape (N, 8), bool
    goal_w: ndarray  # [m], shape (3,)
    # stated age of the keypoints minus that of the poses [s], shape (N,); None: 0
    age: ndarray | None = None


@dataclass(frozen=True)
class Calibration:
    """The estimates from a hover with their standard deviations."""

    # rotation of the camera from its nominal pose: roll, pitch, yaw [rad]
    turn_b: Vector
    turn_sigma: Vector  # [rad]
    latency: float  # age of the keypoints minus that of the poses and the stated age [s]
    latency_sigma: float  # [s]
    thrust: float  # ratio of actual to commanded thrust [-]
    thrust_sigma: float  # [-]
    misfit: float  # RMS of the detections' residuals, in standard deviations [-]
    steps: int
    scale: float = 0.0  # ratio of the focal length to the nominal one, minus 1 [-]
    scale_sigma: float = 0.0  # [-]

    def values(self) -> dict[str, Any]:
        """Return the estimates as a dictionary for JSON."""
        return config.to_dict(self)

    @classmethod
    def of(cls, values: dict[str, Any]) -> "Calibration":
        """Build a calibration from the dictionary of `values`."""
        fields = {}
        for name, value in values.items():
            fields[name] = tuple(value) if isinstance(value, list) else value
        return cls(**fields)

    def __str__(self) -> str:
        """Return a line of text for the pilot."""
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
    """A hover whose data do not suffice for a calibration."""


NO_ANSWER = "calibration found no finite solution; expected finite poses, thrusts and keypoints"

HOVER = 1.5  # duration of a hover before the sway [s]
SWAY = 1.5  # duration of the sway [s]

SWAY_RATE = 1.0
SWAY_FREQUENCY = 4.0 / 3.0
"""Amplitude of roll and pitch rate, which yields 7 deg of tilt about either axis [rad/s], and a
frequency above the swing's, so that the rope does not follow [Hz].
"""


def sway(
    since: float, rate: float = SWAY_RATE, frequency: float = SWAY_FREQUENCY
) -> tuple[float, float]:
    """Return roll and pitch rate of the sway [rad/s] at a time since its start [s]: one period
    along a diagonal, then one along the other.

    An error of the camera's yaw rotates the ball's path in the image; latency shifts the ball along
    its path. On a circle these effects are the same: their correlation is proportional to the area
    that a path encloses, which is zero for lines."""
    swung = rate * math.cos(2.0 * math.pi * frequency * since)
    return swung, swung if int(frequency * since + 1e-9) % 2 == 0 else -swung


class CalibrationProblem:
    """Residuals of a hover in standard deviations; all arguments have a leading batch axis B, for
    finite differences.
    """

    def __init__(
        self, hovered: Hovered, camera: KeypointCamera, contract: dict[str, Any], spreads: Spreads
    ):
        """Prepare the problem from the measurements, the nominal camera, float64, and the masses
        and the rope in the policy's contract.

        Raises CalibrationError: too few steps, or too few with a detected ball.
        """
        count = len(hovered.time)
        visible = hovered.valid[:, GOAL_KEYPOINTS:].all(1)
        if count < LEAST_STEPS or visible.mean() < LEAST_VISIBLE:
            raise CalibrationError(
                f"calibration from {count} steps, the ball detected in {100 * visible.mean():.0f} %"
                f" of them; expected {LEAST_STEPS} or more, and {100 * LEAST_VISIBLE:.0f} %"
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
        self.swung = inertia / moment  # distance to the centre of oscillation [m]
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
        """Set the standard deviations of constants, accelerations and attitudes."""
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
        """Return initial unknowns, the measurements and a rope at rest, shape (N, 13), and
        constants, shape (C,).
        """
        zeros = self.pos.new_zeros(len(self.time), 7)
        return torch.cat([self.pos, self.vel, zeros], -1), torch.zeros_like(self.prior)

    def split(self, constants: Tensor) -> dict[str, Tensor]:
        """Return the constants by name, each of shape (B, n)."""
        return dict(zip(CONSTANTS, constants.split(list(CONSTANTS.values()), -1)))

    def steps(self, x: Tensor, constants: Tensor) -> Tensor:
        """Return the residuals of the dynamics from step k to k + 1 and of the measurements at k,
        shape (B, N - 1, 20), for unknowns, shape (B, N, 13), and constants, shape (B, C).
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
        # Magnus expansion for a rate that is linear over a step
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
        """Return the last step j before each detection's time, and the share of the way to j + 1,
        each of shape (N,).
        """
        time = self.time
        when = (time - self.age - latency).clamp(min=time[0], max=time[-1] - 1e-9)
        j = (torch.searchsorted(time, when, right=True) - 1).clamp(0, len(time) - 2)
        return j, (when - time[j]) / self.dt[j]

    def sightings(self, x: Tensor, constants: Tensor, j: Tensor) -> Tensor:
        """Return the residuals of the ball's position and size and the goal's position in the
        image, in standard deviations, shape (B, N, 5); zero where not detected.

        Arguments: see `steps`. ``j``: last steps before the detections, shape (N,), constant during
        finite differences.
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
    """Return centre and mean half side, shape (N, 3), of boxes given by their edges' midpoints,
    shape (N, 4, 2).
    """
    x = points[:, 0, 0]
    top = points[:, 1, 1]
    right = points[:, 2, 0]
    bottom = points[:, 3, 1]
    return torch.cat([points.mean(1), 0.25 * (right - x + bottom - top)[:, None]], -1)


def _means(values: Tensor) -> Tensor:
    """Return the mean over each step between equidistant values, shape (N, 3), by a cubic through
    four of them, at the ends by the chord.

    The chord underestimates an oscillation by (frequency dt)^2 / 12, 0.2 % of the sway, which would
    appear as an error of the focal length."""
    chord = 0.5 * (values[1:] + values[:-1])
    inner = (13.0 * (values[1:-2] + values[2:-1]) - values[:-3] - values[3:]) / 24.0
    return torch.cat([chord[:1], inner, chord[-1:]])


def _rotate(rot: Tensor, vector: Tensor) -> Tensor:
    """Return vectors rotated by rotations of the same batch."""
    return (rot @ vector.unsqueeze(-1)).squeeze(-1)


def _rope(swing: Tensor, rate: Tensor) -> tuple[Tensor, Tensor]:
    """Return the direction of a hanging rope and its rate, from their horizontal components."""
    down = (1.0 - (swing * swing).sum(-1, keepdim=True)).clamp(min=1e-2).sqrt()
    fall = (swing * rate).sum(-1, keepdim=True) / down
    return torch.cat([swing, -down], -1), torch.cat([rate, fall], -1)


def _vector(rot: Tensor) -> Tensor:
    """Return the rotation vectors of small rotations."""
    twice = rot - rot.mT
    skew = 0.5 * torch.stack([twice[..., 2, 1], twice[..., 0, 2], twice[..., 1, 0]], -1)
    sine2 = (skew * skew).sum(-1, keepdim=True)
    return skew * (1.0 + sine2 / 6.0 + 3.0 * sine2 * sine2 / 40.0)  # arcsin(s) / s


def _cubic(value: Tensor, slope: Tensor, j: Tensor, u: Tensor, dt: Tensor) -> Tensor:
    """Return the cubic through values and slopes of steps j and j + 1 at a share u of the way."""
    chord = value[:, j + 1] - value[:, j]
    return value[:, j] + _hermite(chord, slope, j, u, dt)


def _hermite(chord: Tensor, slope: Tensor, j: Tensor, u: Tensor, dt: Tensor) -> Tensor:
    """Return the increment from step j to a share u of the way to j + 1 of the cubic with this
    chord and the slopes at both steps.
    """
    bend = (1 - u) * (slope[:, j] * dt - chord) - u * (slope[:, j + 1] * dt - chord)
    return u * chord + u * (1 - u) * bend


def calibrate(
    hovered: Hovered,
    camera: KeypointCamera,
    contract: dict[str, Any],
    spreads: Spreads | None = None,
) -> Calibration:
    """Estimate the camera's rotation, scale and latency and the thrust from a hover.

    Raises CalibrationError: the data do not suffice, or the fit does not converge.

    Args:
        hovered: a hover of about 3 s that ends in a sway.
        camera: the policy's nominal camera, float64. contract: the policy's contract.
        spreads: standard deviations of noise and priors; default those of the training.
    """
    problem = CalibrationProblem(hovered, camera, contract, spreads or Spreads())
    x, c = problem.start()
    for _ in range(ROUNDS):
        try:
            factor, gradient, misfit = _linearise(problem, x, c)
        except RuntimeError as error:  # the factorisation failed
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
            f"calibration did not converge in {ROUNDS} iterations; expected a hover that ends in a"
            " sway, with the ball in view"
        )
    covariance = torch.cholesky_inverse(factor[width:, width:])  # the constants are last
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
    """Return the calibration of a hover by :func:`calibrate`, or the reason of its failure; meant
    for a separate process.
    """
    try:
        return calibrate(hovered, KeypointCamera(camera, dtype=torch.float64), contract, spreads)
    except CalibrationError as error:
        return str(error)


def _linearise(problem: CalibrationProblem, x: Tensor, c: Tensor) -> tuple[Tensor, Tensor, float]:
    """Return the Cholesky factor of the normal equations at the unknowns, the gradient there, and
    the RMS residual of the detections.

    A residual depends on at most two neighbouring steps, so two perturbations, of the even and of
    the odd steps, yield a derivative for all steps."""
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
