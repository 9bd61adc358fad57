"""Sub-pixel edges of coloured objects on a frame, and fits of shapes to them.

Used by `camera.detectors.contours`.
"""

import math
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np
import torch
from numpy import ndarray
from numpy.linalg import norm

from camera.fisheye import Fisheye

LEAST_AREA = 14  # blobs smaller than this are noise [px]
MOST_PAIRED = 12  # number of the largest blobs that are combined in pairs
SEARCH_MARGIN = 3.0  # least reach of the search beyond a side of the goal [px]
ANGLES = 64  # number of directions in which a ball's edge is searched
STEP = 0.25  # distance of samples across an edge [px]
MOST_BENT = 0.12  # largest RMS distance of the goal's edge from a line, over the side
# least relative excess of the rim's brightness over its surroundings; low, because the rim is
# blurred in distant frames
LEAST_RIM = 0.05
OVEREXPOSED = 245.0  # level, of 255, above which a pixel counts as overexposed
OUTER = 0.65  # quantile of the points' distances from a cone's axis around which points are kept
RIM_LEVEL = 0.42
"""Relative level of a ball's edge between outside and inside. It is below 0.5, because a ball is
darker towards its edge. With it, the mean error of the half-angle on rendered balls is zero.
"""
BLUR_WIDTH = 1.75  # half of the widest edge in a usable frame [px]
SIDE_SAMPLES = 24  # samples along a side of the goal
LEAST_LEVEL = 8.0  # least level of the colour inside an edge, of 255


@dataclass(frozen=True)
class Colours:
    """A frame smoothed against the sensor's noise, in several representations."""

    bgr: tuple[ndarray, ndarray, ndarray]  # uint8, shape (H, W) each
    hsv: ndarray  # uint8, hue from 0 to 255 for a full turn, shape (H, W, 3)
    bright: ndarray  # greatest channel, uint8, shape (H, W)


def colours_of(image: ndarray) -> Colours:
    """Smooth a frame, BGR, uint8, shape (H, W, 3)."""
    import cv2

    smooth = cv2.GaussianBlur(image, (0, 0), 0.8)
    blue, green, red = cv2.split(smooth)
    hsv = cv2.cvtColor(smooth, cv2.COLOR_BGR2HSV_FULL)
    bright = cv2.max(cv2.max(blue, green), red)
    return Colours((blue, green, red), hsv, bright)


def colour_maps(
    colours: Colours,
    hue_deg: tuple[float, float],
    saturation: float,
    brightness: float,
    in_view: ndarray,
    kind: Literal["yellow", "green"],
) -> tuple[ndarray, ndarray]:
    """Return the mask and the level of a colour in an image.

    Args:
        colours: of the frame.
        hue_deg: range of the hue [deg]. saturation, brightness: least values, 0 to 1.
        in_view: 1 inside the field of view, uint8, shape (H, W).
        kind: definition of the level: the excess of the lesser of red and green over blue
            ("yellow"), or of green over red and blue ("green").

    Returns:
        Mask, uint8, shape (H, W), and level, of 255, float32, shape (H, W). The level is linear in
        the pixel values, so that at an edge blurred by the lens it is half of that inside.
    """
    import cv2

    blue, green, red = colours.bgr
    low, high = (round(hue * 256.0 / 360.0) for hue in hue_deg)
    lowest = (low, 255.0 * saturation, 255.0 * brightness)
    selected = cv2.inRange(colours.hsv, lowest, (high, 255, 255))
    selected = cv2.bitwise_and(selected, in_view)
    mask = cv2.morphologyEx(selected, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    pair = (cv2.min(red, green), blue) if kind == "yellow" else (green, cv2.max(red, blue))
    return mask, cv2.subtract(*pair, dtype=cv2.CV_32F)


def outlines_of(mask: ndarray) -> list[ndarray]:
    """Return the outlines of a mask's blobs [px], shape (N, 2) each."""
    import cv2

    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    outlines = []
    for contour in contours:
        if max(cv2.contourArea(contour), len(contour)) >= LEAST_AREA:
            outlines.append(contour[:, 0].astype(np.float64))
    return outlines


def circles_of(mask: ndarray) -> list[tuple[ndarray, float]]:
    """Return circles around the blobs of a mask, and around pairs of near blobs, which may be one
    object that is partly occluded.

    Returns the centre [px], shape (2,), and radius [px] of each.
    """
    import cv2

    outlines = sorted(outlines_of(mask), key=len, reverse=True)
    circles = [cv2.minEnclosingCircle(outline.astype(np.float32)) for outline in outlines]
    single = [(np.array(centre), float(radius)) for centre, radius in circles]
    pairs = []
    for i, j in combinations(range(min(len(single), MOST_PAIRED)), 2):
        first, one = single[i]
        second, two = single[j]
        if norm(first - second) < one + two:
            joined = np.concatenate([outlines[i], outlines[j]]).astype(np.float32)
            centre, radius = cv2.minEnclosingCircle(joined)
            pairs.append((np.array(centre), float(radius)))
    return single + pairs


def polar_edge(level: ndarray, centre: ndarray, radius: float) -> tuple[ndarray, float]:
    """Find the edge of a disc along rays from its centre.

    Args:
        level: of the colour, shape (H, W).
        centre: approximate [px]. radius: approximate [px].

    Returns:
        Points on the edge [px], shape (N, 2), and the share of directions with a point.
    """
    reach = np.arange(0.3 * radius, 1.5 * radius + 4.0, STEP)
    angle = 2.0 * math.pi * np.arange(ANGLES) / ANGLES
    way = np.column_stack([np.cos(angle), np.sin(angle)])
    u, v = (centre[i] + way[:, i, None] * reach for i in range(2))
    hit, distance = _find_last_crossing(_sample(level, u, v), reach)
    points = centre + way * distance[:, None]
    return points[hit], float(hit.mean())


def cone_fit(rays: ndarray) -> tuple[ndarray, float, float, float]:
    """Fit a circular cone to unit rays, which satisfy ``ray . n = 1`` with n the axis over the
    cosine of the half-angle.

    Args:
        rays: unit, shape (N, 3).

    Returns:
        Axis, shape (3,), half-angle [rad], RMS misfit of the inliers in half-angles, and the share
        of inliers.
    """
    good = np.ones(len(rays), bool)
    axis = rays.mean(axis=0)
    half_angle = 0.0
    off = np.zeros(len(rays))
    for width in (0.4, 0.2, 0.1, 0.07, 0.07):
        # The plane is nearly perpendicular to the mean ray, so that the least-squares problem is
        # well conditioned in this basis.
        mean = rays[good].mean(axis=0)
        frame = _basis(mean / norm(mean))
        local = rays[good] @ frame
        plane = local[:, :2] / local[:, 2:]
        columns = np.column_stack([plane, np.ones(len(plane))])
        normal = frame @ np.linalg.lstsq(columns, 1.0 / local[:, 2], rcond=None)[0]
        size = float(norm(normal))
        if not size > 1.0:
            return axis / norm(axis), 0.0, math.inf, 0.0
        axis = normal / size
        half_angle = math.acos(1.0 / size)
        sine = norm(np.cross(rays, axis), axis=1)
        off = np.arctan2(sine, rays @ axis) / half_angle - 1.0
        # Seams and occlusions only move points of the outline inwards, so the outer points are the
        # inliers.
        inner = off[np.abs(off) < 0.5]
        outer = np.quantile(inner, OUTER) if len(inner) else 0.0
        good = np.abs(off - outer) < width
        if good.sum() < 6:
            return axis, half_angle, math.inf, 0.0
    misfit = np.sqrt(np.mean(off[good] ** 2))
    return axis, half_angle, float(misfit), float(good.mean())


def fit_goal(
    lens: Fisheye, field_share: float, outline: ndarray, level: ndarray, bright: ndarray
) -> tuple[ndarray, float] | None:
    """Fit the goal square to a blob's outline.

    Args:
        lens: of the frame.
        field_share: side of the coloured field over that of the square with its rim [-].
        outline: of the blob [px], shape (N, 2).
        level: of the colour, shape (H, W).
        bright: greatest channel, uint8, shape (H, W).

    Returns:
        Unit rays to the outer corners, clockwise in the image, shape (4, 3), and a score of at most
        1; None if the blob is not a square with a rim.
    """
    rays = rays_of(lens, outline)
    centre = rays.mean(axis=0)
    frame = _basis(centre / norm(centre))
    local = rays @ frame
    if local[:, 2].min() < 0.3:
        return None  # too wide for a tangent plane
    corners = _quadrangle((local[:, :2] / local[:, 2:]).astype(np.float32))
    for _ in range(2):  # the second time from better corners
        refined = None if corners is None else _refine_corners(lens, corners, frame, level)
        if refined is None:
            return None
        corners, misfit, share = refined
    outer = _scale_square(corners, 1.0 / field_share)
    rim = _rim_contrast(lens, corners, frame, bright, field_share)
    if misfit > MOST_BENT or share < 0.5 or rim < LEAST_RIM:
        return None
    rays_c = np.column_stack([outer, np.ones(4)]) @ frame.T
    rays_c = rays_c / norm(rays_c, axis=1, keepdims=True)
    return rays_c, (share - misfit + min(rim, 0.5)) / 1.5


def _quadrangle(points: ndarray) -> ndarray | None:
    """Return the corners of a quadrangle around points of the tangent plane, clockwise in the
    image, shape (4, 2).
    """
    import cv2

    scale = float(np.abs(points).max())
    hull = cv2.convexHull(points / scale)
    length = cv2.arcLength(hull, True)
    selected = cv2.boxPoints(cv2.minAreaRect(hull))
    for share in np.arange(0.02, 0.16, 0.01):
        polygon = cv2.approxPolyDP(hull, share * length, True)
        if len(polygon) == 4:
            selected = polygon[:, 0]
            break
        if len(polygon) < 4:
            break
    corners = selected.astype(np.float64) * scale
    if cv2.contourArea((corners / scale).astype(np.float32)) < 1e-3:
        return None
    off = corners - corners.mean(axis=0)
    return corners[np.argsort(np.arctan2(off[:, 1], off[:, 0]))]


def _refine_corners(
    lens: Fisheye, corners: ndarray, frame: ndarray, level: ndarray
) -> tuple[ndarray, float, float] | None:
    """Refine corners by lines through the edges near each side. Returns the corners, the lines'
    misfit over the side's length, and the share of samples with an edge.
    """
    lines = []
    misfit = []
    share = []
    middle = corners.mean(axis=0)
    for first, second in zip(corners, np.roll(corners, -1, axis=0)):
        side = second - first
        part = np.linspace(0.12, 0.88, SIDE_SAMPLES)[:, None]
        on_side = first + part * side
        inwards = middle - 0.5 * (first + second)
        start, end = (_pixels(lens, on_side + share * inwards, frame) for share in (0.4, -0.35))
        if start is None or end is None:
            return None
        way = end - start
        length = norm(way, axis=1)
        lacking = SEARCH_MARGIN / np.maximum(length, 1e-9) - 0.35 / 0.75
        way *= 1.0 + np.maximum(0.0, lacking)[:, None]
        length = norm(way, axis=1)
        steps = math.ceil(float(length.max()) / STEP)
        reach = np.linspace(0.0, 1.0, max(8, steps))
        u, v = (start[:, i, None] + way[:, i, None] * reach for i in range(2))
        values = _sample(level, u, v)
        hit, distance = _find_first_crossing(values, reach)
        if hit.sum() < SIDE_SAMPLES // 3:
            return None
        edge = rays_of(lens, start[hit] + way[hit] * distance[hit, None]) @ frame
        line, off = _line(edge[:, :2] / edge[:, 2:])
        lines.append(line)
        misfit.append(off / norm(side))
        share.append(hit.mean())
    met = np.array([_meet(lines[i - 1], lines[i]) for i in range(4)])
    reach = 0.6 * np.abs(corners - middle).max()
    if not np.isfinite(met).all() or np.abs(met - corners).max() > reach:
        return None
    return met, float(np.max(misfit)), float(np.mean(share))


def _line(points: ndarray) -> tuple[ndarray, float]:
    """Fit a line ``a x + b y = c`` (unit normal) robustly. Returns a, b, c and the RMS distance."""
    weights = np.ones(len(points))
    for _ in range(6):
        mean = np.average(points, axis=0, weights=weights)
        off = points - mean
        normal = np.linalg.eigh((off * weights[:, None]).T @ off)[1][:, 0]
        distance = off @ normal
        scale = max(1.5 * float(np.median(np.abs(distance))), 1e-9)
        weights = 1.0 / (1.0 + (distance / scale) ** 2)
    line = np.array([*normal, normal @ mean])
    rms = np.sqrt(np.average(distance**2, weights=weights))
    return line, float(rms)


def _meet(first: ndarray, second: ndarray) -> ndarray:
    """Return the intersection of two lines; NaN if they are parallel."""
    matrix = np.array([first[:2], second[:2]])
    if abs(np.linalg.det(matrix)) < 1e-3:
        return np.full(2, math.nan)
    return np.linalg.solve(matrix, [first[2], second[2]])


def _scale_square(corners: ndarray, factor: float) -> ndarray:
    """Scale a square about its centre by ``factor``, under the perspective of its corners."""
    import cv2

    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], np.float32)
    size = float(np.abs(corners).max())  # cv2 works in float32
    view = cv2.getPerspectiveTransform(square, (corners / size).astype(np.float32))
    return cv2.perspectiveTransform((factor * square)[None], view)[0].astype(np.float64) * size


def _rim_contrast(
    lens: Fisheye, corners: ndarray, frame: ndarray, bright: ndarray, share: float
) -> float:
    """Return the rim's brightness relative to its surroundings, minus one; the median along all
    sides.

    If the surroundings are overexposed, a rim is assumed.
    """
    part = np.linspace(0.15, 0.85, 8)[:, None]

    def around(factor: float) -> ndarray:
        ring = _scale_square(corners, factor)
        sides = np.roll(ring, -1, axis=0) - ring
        points = (ring[:, None] + part * sides[:, None]).reshape(-1, 2)
        pixels = _pixels(lens, points, frame)
        if pixels is None:
            return np.full(len(points), math.nan)
        return _sample(bright, pixels[:, 0], pixels[:, 1])

    rim = around(0.5 * (1.0 + 1.0 / share))
    surroundings = around(1.0 / share + 0.25)
    if np.isnan(rim).any() or np.isnan(surroundings).any():
        return 0.0
    readable = surroundings < OVEREXPOSED
    if readable.mean() < 0.25:
        return LEAST_RIM
    return float(np.median(rim[readable] / np.maximum(surroundings[readable], 1.0) - 1.0))


def _pixels(lens: Fisheye, plane: ndarray, frame: ndarray) -> ndarray | None:
    """Project points of a tangent plane to pixels, shape (N, 2); None if one is not visible."""
    rays = np.column_stack([plane, np.ones(len(plane))]) @ frame.T
    pixels, valid = lens.project(torch.from_numpy(rays))
    if bool((valid & lens.is_on_sensor(pixels)).all()):
        return pixels.numpy()
    return None


def rays_of(lens: Fisheye, pixels: ndarray) -> ndarray:
    """Return the unit rays, shape (N, 3), camera frame, of pixels [px], shape (N, 2)."""
    return lens.unproject(torch.from_numpy(np.ascontiguousarray(pixels, np.float64)))[0].numpy()


def _basis(ray: ndarray) -> ndarray:
    """Return the rotation from the tangent plane of a unit ray to the camera frame, shape (3, 3);
    its last column is the ray.
    """
    helper = np.array([1.0, 0.0, 0.0]) if abs(ray[0]) < 0.7 else np.array([0.0, 1.0, 0.0])
    x = helper - ray * (helper @ ray)
    x /= norm(x)
    return np.column_stack([x, np.cross(ray, x), ray])


def _sample(picture: ndarray, u: ndarray, v: ndarray) -> ndarray:
    """Interpolate a picture bilinearly at pixels; returns the shape of u."""
    import cv2

    u, v = (np.ascontiguousarray(a, np.float32) for a in (u, v))
    flat = np.atleast_2d(u), np.atleast_2d(v)
    picture = picture.astype(np.float32, copy=False)
    values = cv2.remap(picture, *flat, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return values.reshape(u.shape)


def _find_last_crossing(values: ndarray, reach: ndarray) -> tuple[ndarray, ndarray]:
    """Find the outermost falling edge of each row: return whether there is one, and its position.

    A ball is darker towards its edge. The levels inside and outside are therefore measured close to
    the edge, at the blur's width."""
    plateau = np.quantile(values, 0.75, axis=1)
    threshold = 0.4 * plateau
    falls = _falls(values, threshold)
    last = _index_of_last(falls)
    hit = falls.any(axis=1) & (plateau > LEAST_LEVEL) & (values[:, -1] <= threshold)
    start = round(BLUR_WIDTH / STEP)
    rows = np.arange(len(values))[:, None]
    peak = values.shape[1] - 1
    last = last[:, None]
    distances = np.arange(start, 2 * start)
    inner, outer = (np.clip(last + sign * distances, 0, peak) for sign in (-1, 1))
    high = np.quantile(values[rows, inner], 0.75, axis=1)
    low = np.median(values[rows, outer], axis=1)
    window = np.clip(last + np.arange(-2 * start, 2 * start + 1), 0, peak)
    level = low + RIM_LEVEL * (high - low)
    falls = _falls(values[rows, window], level)
    index = _index_of_last(falls)
    hit &= falls.any(axis=1) & (high - low > LEAST_LEVEL)
    place = np.minimum(window[rows[:, 0], index], peak - 1)
    return hit, _interpolate_crossing(values, reach, place, level)


def _find_first_crossing(values: ndarray, reach: ndarray) -> tuple[ndarray, ndarray]:
    """Find where each row first falls below half of its level at the start: return whether it does,
    and the position.
    """
    plateau = np.median(values[:, : max(2, len(reach) // 5)], axis=1)
    level = 0.5 * plateau
    falls = _falls(values, level)
    hit = falls.any(axis=1) & (plateau > LEAST_LEVEL)
    return hit, _interpolate_crossing(values, reach, np.argmax(falls, axis=1), level)


def _falls(values: ndarray, level: ndarray) -> ndarray:
    """Return whether each row falls below its level between a sample and the next one."""
    above = values > level[:, None]
    return above[:, :-1] & ~above[:, 1:]


def _index_of_last(marks: ndarray) -> ndarray:
    """Return the index of the last true value of each row."""
    return marks.shape[1] - 1 - np.argmax(marks[:, ::-1], axis=1)


def _interpolate_crossing(
    values: ndarray, reach: ndarray, index: ndarray, level: ndarray
) -> ndarray:
    """Return the position between two samples at which a level is crossed."""
    rows = np.arange(len(values))
    high = values[rows, index]
    low = values[rows, index + 1]
    part = np.clip((high - level) / np.maximum(high - low, 1e-9), 0.0, 1.0)
    return reach[index] + part * (reach[index + 1] - reach[index])
