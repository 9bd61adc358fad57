"""Lens models of other tools, and their conversion into our model by a fit.

A model such as ``omni-radtan`` is a core (projection of a ray to the image plane) and a distortion
of that plane. NumPy, float64: the conversion runs once, when a calibration file is read.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.linalg import norm
from numpy.polynomial.polynomial import polyder, polyval
from numpy.typing import NDArray

from camera.params import FisheyeParams, monotonic_limit

Array = NDArray[np.float64]
Values = Mapping[str, float]

HOLDS_PX = 0.05
"""Difference of pixels up to which a fitted lens counts as equal to the lens of the file [px]."""
ANGLES = 721
"""Number of angles off the axis, from 0 to 180 deg, at which a lens is sampled."""
TURNS = 48
"""Number of directions about the axis at which a lens is sampled."""
LARGEST_DECENTRING = 0.01
"""Tangential coefficient p1 or p2 that no real lens reaches; published calibrations are below
0.003.
"""


@dataclass(frozen=True)
class FitReport:
    """Error of our model when fitted to another: difference of pixels for the same ray."""

    model: str  # of the file
    rms_px: float = 0.0  # over all rays in the image [px]
    max_px: float = 0.0  # over all rays in the image [px]
    points: int = 0  # rays compared; 0: the file holds our model, nothing was fitted
    # full angle up to which the difference stays below `HOLDS_PX` [deg]
    holds_deg: float = 360.0
    remarks: tuple[str, ...] = ()  # warnings about the file's numbers


def _omni(values: Values, side2: Array, z: Array) -> Array:
    """Mei and Rives, "Single View Point Omnidirectional Camera Calibration from Planar Grids", ICRA
    2007, sec. III.
    """
    return z + values["xi"] * np.sqrt(side2 + z * z)


def _ucm(values: Values, side2: Array, z: Array) -> Array:
    """Geyer and Daniilidis' unified model with alpha = xi / (1 + xi)."""
    return values["alpha"] * np.sqrt(side2 + z * z) + (1.0 - values["alpha"]) * z


def _eucm(values: Values, side2: Array, z: Array) -> Array:
    """Khomutenko, Garcia, Martinet, "An Enhanced Unified Camera Model", RA-L 1(1), 2016, eq. 3."""
    alpha = values["alpha"]
    beta = values["beta"]
    return alpha * np.sqrt(beta * side2 + z * z) + (1.0 - alpha) * z


def _ds(values: Values, side2: Array, z: Array) -> Array:
    """Usenko, Demmel, Cremers, "The Double Sphere Camera Model", 3DV 2018, eqs. 40 to 42."""
    xi = values["xi"]
    alpha = values["alpha"]
    shifted = xi * np.sqrt(side2 + z * z) + z
    return alpha * np.sqrt(side2 + shifted**2) + (1.0 - alpha) * shifted


DENOMINATORS: dict[str, tuple[str, Callable[[Values, Array, Array], Array]]] = {
    "pinhole": ("", lambda values, side2, z: z),
    "omni": ("xi", _omni),
    "ucm": ("alpha", _ucm),
    "eucm": ("alpha beta", _eucm),
    "ds": ("xi alpha", _ds),
}
"""Core -> its parameters, and a function of ``x^2 + y^2`` and ``z`` that returns the divisor of a
ray's x and y on the image plane. A ray is imaged if the divisor is above 0.
"""


def _radtan(values: Values, plane: Array) -> Array:
    """Brown's radial and tangential distortion, with OpenCV's rational part."""
    k = [0.0] + [values.get(f"k{i}", 0.0) for i in range(1, 7)]
    p1 = values.get("p1", 0.0)
    p2 = values.get("p2", 0.0)
    x, y = plane.T
    r2 = x * x + y * y
    below = 1.0 + r2 * (k[4] + r2 * (k[5] + r2 * k[6]))
    radial = (1.0 + r2 * (k[1] + r2 * (k[2] + r2 * k[3]))) / np.where(below > 0.0, below, np.nan)
    u = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    v = y * radial + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y)
    return np.column_stack([u, v])


def _fov(values: Values, plane: Array) -> Array:
    """Devernay and Faugeras, "Straight lines have to be straight", MVA 13, 2001, eq. 13."""
    radius = np.maximum(norm(plane, axis=1), 1e-12)
    bent = np.arctan(2.0 * radius * math.tan(values["w"] / 2.0)) / values["w"]
    return plane * (bent / radius)[:, None]


DISTORTIONS: dict[str, tuple[str, Callable[[Values, Array], Array]]] = {
    "none": ("", lambda values, plane: plane),
    "radtan": ("k1 k2 p1 p2 k3 k4 k5 k6", _radtan),
    "fov": ("w", _fov),
}
"""Distortion -> its parameters in the usual order, and the function that distorts the image plane.
"""

ANGULAR = ("kb4", "polyfisheye", "ocam")
"""Models that give the radius as a function of the angle off the axis; the first is ours."""


def project(model: str, values: Values, rays: Array) -> Array:
    """Project unit rays, shape (N, 3), by another tool's model.

    Returns pixels [px], shape (N, 2); NaN for a ray that the model does not image.
    """
    core, _, distortion = model.partition("-")
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if core in ANGULAR:
            side = np.maximum(np.hypot(rays[:, 0], rays[:, 1]), 1e-300)
            radius = _RADII[core](values, np.arctan2(side, rays[:, 2]))
            plane = rays[:, :2] * (radius / side)[:, None]
        else:
            _, denominator = DENOMINATORS[core]
            side2 = np.sum(rays[:, :2] ** 2, axis=1)
            divisor = denominator(values, side2, rays[:, 2])
            plane = rays[:, :2] / np.where(divisor > 1e-9, divisor, np.nan)[:, None]
            plane = DISTORTIONS[distortion or "none"][1](values, plane)
    skew, shear = (values.get(name, 0.0) for name in ("skew", "shear"))
    stretch = np.array([[values["fx"], skew], [shear, values["fy"]]])
    return plane @ stretch.T + [values["cx"], values["cy"]]


def _kb4_radius(values: Values, theta: Array) -> Array:
    """Kannala and Brandt's model, see :class:`camera.params.FisheyeParams`."""
    powers = np.array([1.0, *[values[f"k{i}"] for i in range(1, 5)]])
    return np.asarray(theta * polyval(theta * theta, powers))


def _polyfisheye_radius(values: Values, theta: Array) -> Array:
    """Polynomial of camodocal's PolyFisheyeCamera: all powers of the angle from 1 to 7."""
    powers = np.array([0.0, 1.0] + [values.get(f"k{i}", 0.0) for i in range(2, 8)])
    return polyval(theta, powers)


def _ocam_radius(values: Values, theta: Array) -> Array:
    """Scaramuzza, Martinelli, Siegwart, "A Toolbox for Easily Calibrating Omnidirectional Cameras",
    IROS 2006, eq. 3: the direct polynomial a0 + a1 rho + ... is the ray's depth, inverted here.
    """
    count = sum(name[0] == "a" for name in values)
    powers = np.array([values[f"a{i}"] for i in range(count)])
    rho = np.linspace(0.0, values["farthest"], 4096)
    angles = np.arctan2(rho, -polyval(rho, powers))
    grows = int(np.argmin(np.append(np.diff(angles) > 0.0, False)))
    radius = np.interp(theta, angles[: grows + 1], rho[: grows + 1], right=np.nan)
    slope = polyder(powers)
    for _ in range(4):
        depth = polyval(radius, powers)
        off = radius * np.cos(theta) + depth * np.sin(theta)
        steepness = np.cos(theta) + np.sin(theta) * polyval(radius, slope)
        radius = radius - off / steepness
    return np.asarray(radius)


_RADII = {"kb4": _kb4_radius, "polyfisheye": _polyfisheye_radius, "ocam": _ocam_radius}


@dataclass(frozen=True)
class _Samples:
    """Sampled rays from the axis outwards, as far as the lens images them one-to-one."""

    theta: Array  # [rad], shape (N,)
    direction: Array  # unit vectors across the axis, shape (N, 2)
    pixels: Array  # shape (N, 2)
    fold: float  # angle at which the radius stops increasing inside the image; pi if nowhere


def _sample(model: str, values: Values, width: int, height: int) -> _Samples:
    theta = np.linspace(0.0, math.pi, ANGLES)
    turn = 2.0 * math.pi * np.arange(TURNS) / TURNS
    direction = np.column_stack([np.cos(turn), np.sin(turn)])
    lateral = np.sin(theta)[:, None, None] * direction
    axial = np.broadcast_to(np.cos(theta)[:, None, None], (ANGLES, TURNS, 1))
    rays = np.concatenate([lateral, axial], axis=2)
    pixels = project(model, values, rays.reshape(-1, 3)).reshape(ANGLES, TURNS, 2)
    radius = norm(pixels - pixels[:1], axis=2)
    with np.errstate(invalid="ignore"):
        grows = np.vstack([np.isfinite(radius[:1]), np.diff(radius, axis=0) > 0.0])
        on_image = np.all((pixels >= -0.5) & (pixels <= [width - 0.5, height - 0.5]), axis=2)
    one_to_one = np.logical_and.accumulate(grows, axis=0)
    visible = np.logical_and.accumulate(one_to_one & on_image, axis=0)
    last = np.sum(visible, axis=0)  # index of the first angle in each direction that is not visible
    last_angle = np.minimum(last, ANGLES - 1)
    folds = ~one_to_one[last_angle, np.arange(TURNS)] & (last < ANGLES)
    fold = float(theta[last_angle[folds]].min()) if np.any(folds) else math.pi
    index = np.nonzero(visible)
    return _Samples(theta[index[0]], direction[index[1]], pixels[index], fold)


def fit_fisheye(
    model: str, values: Values, width: int, height: int, fov_deg: float | None = None
) -> tuple[FisheyeParams, FitReport]:
    """Fit our model to another tool's, by least squares of the pixel difference over all rays in
    the image.

    fx, fy and k1 to k4 are fitted, and the principal point too if the other lens is not symmetric
    about its own. Raises ValueError: the image contains too few rays, or the fit is no valid lens.

    Args:
        model: A core of `DENOMINATORS`, a hyphen and one of `DISTORTIONS`; or one of `ANGULAR`.
        values: fx, fy, cx, cy [px], the model's parameters; ``skew``, ``shear`` of its pixels.
        width: Image width [px].
        height: Image height [px].
        fov_deg: Full field of view of the fit [deg]; by default the whole image.

    Returns:
        The fisheye and the error of the fit. The field of view is limited to the requested one, to
        the image and to the angle at which either model folds back: nothing is extrapolated.
    """
    samples = _sample(model, values, width, height)
    limit = samples.fold if fov_deg is None else min(math.radians(fov_deg) / 2.0, samples.fold)
    used = samples.theta <= limit
    theta = samples.theta[used]
    direction = samples.direction[used]
    pixels = samples.pixels[used]
    if len(theta) < 50 * TURNS / 8:
        raise ValueError(
            f"the image of this {model} lens shows {len(theta)} of {ANGLES * TURNS} rays that were"
            " tried; expected a principal point and focal lengths that lie in the image"
        )
    parameters = _fit_radial(
        theta, direction, pixels, np.array([values["cx"], values["cy"]]), values
    )
    error = norm(_project_ours(parameters, theta, direction) - pixels, axis=1)
    coefficients = tuple(float(k) for k in parameters[4:])
    folds = min(limit, monotonic_limit(coefficients) * (1.0 - 1e-9))
    lens = dict(zip(("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"), map(float, parameters)))
    narrow = FisheyeParams(width, height, **lens, fov_deg=2.0 * math.degrees(min(folds, 0.1)))
    fov = min(image_fov_deg(narrow), 2.0 * math.degrees(folds))
    off = theta[error > HOLDS_PX]
    step = math.pi / (ANGLES - 1)
    holds = 2.0 * math.degrees(max(float(off.min()) - step, 0.0)) if len(off) else fov
    remarks = []
    if samples.fold < math.pi and limit == samples.fold:
        remarks.append(
            f"its {model} numbers fold back {math.degrees(folds):.1f} deg off the axis, inside the"
            " image: the field of view ends there"
        )
    rms = float(np.sqrt(np.mean(error**2)))
    report = FitReport(model, rms, float(error.max()), len(theta), holds, tuple(remarks))
    return FisheyeParams(width, height, **lens, fov_deg=fov), report


def _project_ours(unknown: Array, theta: Array, direction: Array) -> Array:
    """Project by our model; ``unknown``: fx, fy, cx, cy, k1 to k4. Returns pixels [px]."""
    powers = theta[:, None] ** (2 * np.arange(1, 5) + 1)
    radius = theta + powers @ unknown[4:]
    return direction * radius[:, None] * unknown[:2] + unknown[2:4]


def _fit_radial(
    theta: Array, direction: Array, pixels: Array, centre: Array, values: Values
) -> Array:
    """Fit fx, fy, cx, cy, k1 to k4; all angles off the axis have equal weight."""
    from scipy.optimize import least_squares

    crooked = any(values.get(name, 0.0) for name in ("p1", "p2", "skew", "shear"))
    slope = norm(pixels - centre, axis=1)[theta > 0.0] / theta[theta > 0.0]
    focal = float(np.median(slope[theta[theta > 0.0] < 0.3 * theta.max()]))
    free = np.array([True, True, crooked, crooked, True, True, True, True])
    start = np.array([focal, focal, *centre, 0.0, 0.0, 0.0, 0.0])

    def residual(unknown: Array) -> Array:
        whole = start.copy()
        whole[free] = unknown
        return np.asarray((_project_ours(whole, theta, direction) - pixels).ravel())

    how = {"x_scale": "jac", "method": "lm", "xtol": 1e-14, "ftol": 1e-14, "max_nfev": 400}
    fit = least_squares(residual, start[free], **how)
    parameters = start.copy()
    parameters[free] = fit.x
    return parameters


def image_fov_deg(fisheye: FisheyeParams) -> float:
    """Return the full field of view up to the farthest corner of the image [deg], at most 360 and
    at most to the angle at which theta_d stops increasing.
    """
    limit = min(monotonic_limit(fisheye.coefficients), math.pi) * (1.0 - 1e-9)
    right = fisheye.width - 0.5
    low = fisheye.height - 0.5
    corners = np.array([[-0.5, -0.5], [right, -0.5], [right, low], [-0.5, low]])
    off = corners - [fisheye.cx, fisheye.cy]
    plane = off / [fisheye.fx, fisheye.fy]
    radius = norm(plane, axis=1).max()
    values = {f"k{i}": k for i, k in enumerate(fisheye.coefficients, start=1)}
    low_angle = 0.0
    high_angle = limit
    for _ in range(80):  # bisection, to the last bit
        middle = 0.5 * (low_angle + high_angle)
        below = float(_kb4_radius(values, np.array([middle]))[0]) < radius
        low_angle, high_angle = (middle, high_angle) if below else (low_angle, middle)
    return 2.0 * math.degrees(high_angle)
