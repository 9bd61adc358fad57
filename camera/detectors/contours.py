"""Detection of ball and goal square on fisheye frames by colour and shape, with OpenCV.

Colour gives candidates, which geometry accepts or rejects. A blob of the ball's hue is a ball if
its edge is on a circular cone of rays, which is the shape of a ball's outline in every direction
and for every lens. A blob of the goal's hue is the goal if its edges are four straight lines in the
tangent plane of the rays, with a bright rim outside. Edges are located to a fraction of a pixel at
about half of the colour's level inside, so that blur hardly moves them.

The results are rays, not pixels. `convert_to_training_keypoints` projects them by the training
lens, with the functions of training."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy import ndarray

from camera.detectors.edges import (
    circles_of,
    colour_maps,
    colours_of,
    cone_fit,
    fit_goal,
    outlines_of,
    polar_edge,
    rays_of,
)
from camera.field_bounds import BoundedFields, Positive, Share
from camera.fisheye import Fisheye
from camera.keypoints import (
    GOAL_KEYPOINTS,
    PAYLOAD_KEYPOINTS,
    KeypointCamera,
    apply_invalid_rule,
    payload_keypoints,
)

ABOVE = 0.5
"""Level of the background's colour relative to the level at the ball's expected position, for
backgrounds of the ball's hue.
"""

GATE = 4.0
"""Radius of the search region around an expected position, in standard deviations about each axis.
"""

DISTANCE_ERROR = 0.15
"""Relative error of a distant, blurred ball's distance as computed from the size of its cone
[-].
"""


@dataclass(frozen=True)
class DetectorParams(BoundedFields):
    """Appearance of ball and goal, and limits of the detector."""

    # tennis ball: 62 to 68, with a tolerance for the white balance
    ball_hue_deg: tuple[float, float] = (46.0, 88.0)
    goal_hue_deg: tuple[float, float] = (105.0, 165.0)  # the green field of the square; as above
    saturation: Share = 0.3  # least share of colour in a pixel [-]
    brightness: Share = 0.06  # least value of a pixel [-]
    ball_distance: tuple[Positive, Positive] = (0.15, 4.0)  # of the ball from the lens [m]
    field_share: Positive = (
        0.84  # side of the goal's coloured field over that of the square with its rim [-]
    )
    coverage: Share = 0.35  # share of the ball's outline that must be visible
    misfit: Positive = 0.1  # largest RMS distance of the outline from its cone, in half-angles
    side_tolerance: Positive = (
        0.3  # relative error of the goal's sides, tested if height and attitude are known [-]
    )


@dataclass(frozen=True)
class BallSeen:
    """A detected ball as a cone of rays."""

    ray_c: ndarray  # unit, to the centre, shape (3,), camera frame
    half_angle: float  # [rad]
    # visible share of the outline minus the misfit, minus a penalty for the distance from where it
    # was expected
    score: float


@dataclass(frozen=True)
class GoalSeen:
    """A detected goal square by its corners."""

    # unit, to the outer corners, clockwise in the image, shape (4, 3), camera frame
    rays_c: ndarray
    score: float


@dataclass(frozen=True)
class FrameDetections:
    """Detections in a frame; None for what was not detected."""

    ball: BallSeen | None
    goal: GoalSeen | None
    squares: tuple[GoalSeen, ...] = ()  # all candidates for the goal, the likeliest first


@dataclass(frozen=True)
class Prior:
    """Prior knowledge about a frame; each part may be missing."""

    up_c: ndarray | None = None  # the world's up in the camera frame, unit, shape (3,)
    height: float | None = (
        None  # of the lens above the ground [m]; with up_c the goal's size is checked
    )
    ball_distance: tuple[float, float] | None = (
        None  # of the ball from the lens [m], instead of the parameters'
    )
    ball_ray_c: ndarray | None = None  # to where the ball is expected, unit, shape (3,)
    ball_within: float = math.radians(12.0)  # of ball_ray_c, `GATE` standard deviations [rad]
    goal_ray_c: ndarray | None = None  # to where the goal's middle is expected, unit, shape (3,)
    goal_within: float = math.radians(12.0)  # of goal_ray_c, likewise [rad]
    north_c: ndarray | None = None  # the world's x in the camera frame, unit, shape (3,)


class Detector:
    """Detector of ball and goal in the frames of a lens."""

    def __init__(
        self,
        lens: Fisheye,
        payload_radius: float,
        goal_side: float,
        params: DetectorParams | None = None,
    ):
        """Create a detector.

        Args:
            lens: of the frames.
            payload_radius: [m]. goal_side: with the rim [m].
            params: colours and limits.
        """
        self.lens = lens
        self.params = params or DetectorParams()
        self.radius = payload_radius
        self.side = goal_side
        p = lens.params
        v, u = np.mgrid[: p.height, : p.width]
        plane = np.hypot((u - p.cx) / p.fx, (v - p.cy) / p.fy)
        self._in_view = (plane < lens.edge_radius).astype(np.uint8)

    def detect(self, image: ndarray, prior: Prior | None = None) -> FrameDetections:
        """Detect ball and goal. Raises ValueError: an image of another size or type.

        Args:
            image: BGR, uint8, shape (H, W, 3) of the lens.
            prior: restricts the search.
        """
        self.check(image)
        p = self.params
        prior = prior or Prior()
        colours = colours_of(image)
        limits = (p.saturation, p.brightness, self._in_view)
        ball = colour_maps(colours, p.ball_hue_deg, *limits, "yellow")
        goal = colour_maps(colours, p.goal_hue_deg, *limits, "green")
        squares = self._squares(*goal, colours.bright, prior)
        return FrameDetections(self._ball(*ball, prior), squares[0] if squares else None, squares)

    def check(self, image: ndarray) -> None:
        """Raise ValueError if an image has another size or type."""
        shape = (*self._in_view.shape, 3)
        if image.shape != shape or image.dtype != np.uint8:
            raise ValueError(
                f"image of shape {image.shape} and type {image.dtype} came; expected {shape} and"
                " uint8"
            )

    def _ball(self, mask: ndarray, level: ndarray, prior: Prior) -> BallSeen | None:
        """Return the blob whose edge fits a cone best. If there is none, search for a distinct
        colour at the ball's expected position.
        """
        best = self._best_cone(circles_of(mask), level, prior)
        if best is None and prior.ball_ray_c is not None:
            return self._find_expected_ball(level, prior)
        return best

    def _best_cone(
        self, circles: list[tuple[ndarray, float]], level: ndarray, prior: Prior
    ) -> BallSeen | None:
        best: BallSeen | None = None
        for centre, radius in circles:
            cone = self._cone(level, centre, radius)
            if cone is None or not self._is_in_place(cone.ray_c, cone.half_angle, prior):
                continue
            score = cone.score
            if prior.ball_ray_c is not None:
                turn = math.acos(min(1.0, float(cone.ray_c @ prior.ball_ray_c)))
                score -= 0.5 * turn / prior.ball_within
            if best is None or score > best.score:
                best = BallSeen(cone.ray_c, cone.half_angle, score)
        return best

    def _find_expected_ball(self, level: ndarray, prior: Prior) -> BallSeen | None:
        """Search near the expected position for a ball in front of a background of its colour."""
        import cv2

        ray_c = np.ascontiguousarray(prior.ball_ray_c, np.float64)
        middle, visible = self.lens.project(torch.from_numpy(ray_c[None]))
        if not bool(visible):
            return None
        low, high = prior.ball_distance or self.params.ball_distance
        radius = self.lens.params.fx * self.radius / math.sqrt(low * high)
        u, v = (int(x) for x in middle[0].round())
        patch = level[max(v - 3, 0) : v + 4, max(u - 3, 0) : u + 4]
        ground = ABOVE * float(np.median(patch)) if patch.size else 0.0
        # OpenCV's type annotations lack scalars
        distinct = cv2.subtract(level, ground)  # type: ignore[call-overload]
        mask = ((distinct > 0.0) & (self._in_view > 0)).astype(np.uint8)
        circles = [(centre, size) for centre, size in circles_of(mask) if size < 2.0 * radius]
        return self._best_cone([(middle[0].numpy(), radius), *circles], distinct, prior)

    def _cone(self, level: ndarray, centre: ndarray, radius: float) -> BallSeen | None:
        """Fit the cone of a ball around a circle [px]. The search is repeated from the result,
        because part of the ball may be occluded.
        """
        best = None
        for _ in range(2):
            points, coverage = polar_edge(level, centre, radius)
            if len(points) < 8:
                return None
            ray, half_angle, misfit, share = cone_fit(rays_of(self.lens, points))
            score = coverage * share
            if score < 0.5 * self.params.coverage or not half_angle > 0.0:
                return None
            if score >= self.params.coverage:
                best = BallSeen(ray, half_angle, score - misfit)
            else:
                best = None
            middle, visible = self.lens.project(torch.from_numpy(ray[None]))
            if misfit > self.params.misfit or not bool(visible):
                return None
            centre = middle[0].numpy()
            radius = float(np.median(np.linalg.norm(points - centre, axis=1)))
        return best

    def _is_in_place(self, ray: ndarray, half_angle: float, prior: Prior) -> bool:
        """Return whether a cone is a possible ball, with the distance that its true radius
        implies.
        """
        distance = self.radius / max(math.sin(half_angle), 1e-9)
        low, high = prior.ball_distance or self.params.ball_distance
        if not low <= distance <= high:
            return False
        if prior.ball_ray_c is not None and float(ray @ prior.ball_ray_c) < math.cos(
            prior.ball_within
        ):
            return False
        if prior.up_c is None or prior.height is None:
            return True
        # A smaller object on the ground would be below the ground if it had the ball's size.
        return prior.height + distance * float(ray @ prior.up_c) > -DISTANCE_ERROR * distance

    def _squares(
        self, mask: ndarray, level: ndarray, bright: ndarray, prior: Prior
    ) -> tuple[GoalSeen, ...]:
        """Return the blobs that are squares with a rim, the best first."""
        squares = []
        for contour in outlines_of(mask):
            fit = fit_goal(self.lens, self.params.field_share, contour, level, bright)
            if fit is not None and self._right_size(fit[0], prior):
                squares.append(GoalSeen(*fit))
        return tuple(sorted(squares, key=lambda square: -square.score))

    def _right_size(self, rays_c: ndarray, prior: Prior) -> bool:
        """Return whether the corners, projected to the ground, are a goal's side apart; true if
        attitude or height is unknown.
        """
        if prior.up_c is None or prior.height is None:
            return True
        down = -rays_c @ prior.up_c
        if down.min() < 0.02:
            return False
        corners = rays_c * (prior.height / down)[:, None]
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
        return bool(np.all(np.abs(sides / self.side - 1.0) < self.params.side_tolerance))


def order_corners(rays_c: ndarray, rot_wc: ndarray) -> ndarray:
    """Sort corners in the order of `camera.keypoints.goal_square`, by their positions on the
    ground.

    Args:
        rays_c: to the corners, in order around the square, shape (4, 3), camera frame; all below
            the horizon.
        rot_wc: camera to world, shape (3, 3).

    Returns:
        The sorted rays, shape (4, 3).
    """
    rays_w = rays_c @ rot_wc.T
    ground = rays_w[:, :2] / np.maximum(-rays_w[:, 2:], 1e-3)
    off = ground - ground.mean(axis=0)
    quadrants = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]])
    orders = []
    for base in (np.arange(4), np.arange(4)[::-1]):
        orders += [np.roll(base, shift) for shift in range(4)]
    best = max(orders, key=lambda order: float(np.sum(off[order] * quadrants)))
    return rays_c[best]


def convert_to_training_keypoints(
    camera: KeypointCamera, detections: FrameDetections, rot_wb: ndarray
) -> tuple[torch.Tensor, torch.Tensor]:
    """Compute the training camera's keypoints from detections, with the functions of training.

    The ball's distance follows from its cone and its true radius. The box is then computed as in
    training, with the same error: extremes are accurate to second order in the half-angle, 2.2e-4
    in normalised coordinates at a rope's length. So if an outline is detected too large by a share
    s, each side of the box moves by s half-angles.

    Args:
        camera: of training.
        detections: in the camera frame of training.
        rot_wb: attitude of the vehicle, body to world, shape (3, 3), which identifies the corners.

    Returns:
        Normalised keypoints [-], shape (8, 2), and validity, shape (8,); zero and invalid where
        nothing was detected.
    """
    points = torch.zeros(GOAL_KEYPOINTS + PAYLOAD_KEYPOINTS, 2)
    valid = torch.zeros(GOAL_KEYPOINTS + PAYLOAD_KEYPOINTS, dtype=torch.bool)
    if detections.goal is not None:
        rot_wc = rot_wb @ camera.rot_cb.double().numpy().T
        rays = order_corners(detections.goal.rays_c, rot_wc)
        corners, ok = camera.fisheye.project_normalized(torch.from_numpy(rays).float(), clip=True)
        points[:GOAL_KEYPOINTS] = corners
        valid[:GOAL_KEYPOINTS] = ok
    if detections.ball is not None:
        distance = camera.params.payload_radius / math.sin(detections.ball.half_angle)
        ball_c = detections.ball.ray_c * distance
        box, ok = payload_keypoints(camera, torch.from_numpy(ball_c[None]).float())
        points[GOAL_KEYPOINTS:] = box[0]
        valid[GOAL_KEYPOINTS:] = ok[0]
    points, valid = apply_invalid_rule(camera, points[None], valid[None])
    return points[0], valid[0]
