"""Other lens models of the field (double sphere, extended unified, ocam) and their conversion into
ours by a fit.

NumPy, float64: this runs once, when a calibration file is read.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from camera.params import FisheyeParams, monotonic_limit

GRID = 64  # pixels along each side of the grid on which a foreign model is sampled


@dataclass(frozen=True)
class FitReport:
    """How well our model took over a foreign one, as a difference of pixels for the same ray."""

    model: str  # name of the foreign model
    rms_px: float  # over the grid [px]
    max_px: float  # over the grid [px]
    points: int  # rays compared


Unprojection = Callable[[dict[str, float], np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Of intrinsics (fx, fy, cx, cy [px], the model's own [-]) and pixels [px], shape (N, 2): unit
rays, shape (N, 3), and validity, (N,).
"""


def unproject_ds(values: dict[str, float], pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rays of the double-sphere model, as `Unprojection` says.

    Source: Usenko, Demmel, Cremers, "The Double Sphere Camera Model", 3DV 2018, eqs. 46 to 52.
    """
    xi, alpha = values["xi"], values["alpha"]
    m, radius2 = _plane(values, pixels)
    discriminant = 1.0 - (2.0 * alpha - 1.0) * radius2
    valid = discriminant >= 0.0
    mz = (1.0 - alpha**2 * radius2) / (alpha * np.sqrt(np.maximum(discriminant, 0.0)) + 1.0 - alpha)
    under = mz**2 + (1.0 - xi**2) * radius2
    valid &= under >= 0.0
    scale = (mz * xi + np.sqrt(np.maximum(under, 0.0))) / (mz**2 + radius2)
    return np.column_stack([scale[:, None] * m, scale * mz - xi]), valid


def unproject_eucm(values: dict[str, float], pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rays of the extended unified camera model, as `Unprojection` says.

    Source: Khomutenko, Garcia, Martinet, "An Enhanced Unified Camera Model", RA-L 1(1), 2016, eqs.
    5 and 8."""
    alpha, beta = values["alpha"], values["beta"]
    m, radius2 = _plane(values, pixels)
    discriminant = 1.0 - (2.0 * alpha - 1.0) * beta * radius2
    mz = (1.0 - beta * alpha**2 * radius2) / (
        alpha * np.sqrt(np.maximum(discriminant, 0.0)) + 1.0 - alpha
    )
    rays = np.column_stack([m, mz])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True), discriminant >= 0.0


FOREIGN_MODELS: dict[str, tuple[tuple[str, ...], Unprojection]] = {
    "ds": (("fx", "fy", "cx", "cy", "xi", "alpha"), unproject_ds),
    "eucm": (("fx", "fy", "cx", "cy", "alpha", "beta"), unproject_eucm),
}
"""Foreign model: its intrinsics and its unprojection."""


def fit_fisheye(
    model: str, values: dict[str, float], width: int, height: int, fov_deg: float | None = None
) -> tuple[FisheyeParams, FitReport]:
    """Fit our model to a foreign one on a grid of pixels, by least squares of the pixel difference.

    The principal point is taken over (all three models are symmetric about it); fx, fy and k1 to k4
    are fitted. Raises ValueError: the model is unknown, or no grid point lies in the field of view,
    or the fit describes no camera.

    Args:
        model: A key of `FOREIGN_MODELS`.
        values: Its intrinsics.
        width: Image width [px].
        height: Image height [px].
        fov_deg: Full field of view to fit in [deg]; by default all that the image sees.

    Returns:
        The fisheye and what the fit left over. Its field of view is the asked one, cut to what the
        image sees and to
        where theta_d stops growing: nothing is extrapolated.
    """
    if model not in FOREIGN_MODELS:
        raise ValueError(
            f"camera model {model!r} cannot be fitted; expected one of {sorted(FOREIGN_MODELS)}"
        )
    centre, focal = (values["cx"], values["cy"]), (values["fx"], values["fy"])
    return fit_rays(
        model,
        lambda pixels: FOREIGN_MODELS[model][1](values, pixels),
        centre,
        focal,
        width,
        height,
        fov_deg,
    )


def fit_rays(
    model: str,
    unproject: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    centre_px: tuple[float, float],
    focal_px: tuple[float, float],
    width: int,
    height: int,
    fov_deg: float | None = None,
) -> tuple[FisheyeParams, FitReport]:
    """Fit our model to any lens that turns pixels into rays; see :func:`fit_fisheye`.

    Raises ValueError: no grid point lies in the field of view, or the fit describes no camera.

    Args:
        model: What the report calls the lens.
        unproject: Rays, shape (N, 3), camera frame, and validity, shape (N,), of pixels [px], shape
            (N, 2).
        centre_px: Principal point, taken over.
        focal_px: fx and fy to start from.
        width: Image width [px].
        height: Image height [px].
        fov_deg: Full field of view to fit in [deg]; by default all that the image sees.
    """
    from scipy.optimize import least_squares

    u, v = np.meshgrid(np.linspace(-0.5, width - 0.5, GRID), np.linspace(-0.5, height - 0.5, GRID))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    rays, valid = unproject(pixels)
    theta = np.arctan2(np.linalg.norm(rays[:, :2], axis=1), rays[:, 2])
    seen_deg = 2.0 * math.degrees(theta[valid].max(initial=0.0))
    if fov_deg is not None:
        valid &= theta <= math.radians(fov_deg) / 2.0
    if np.count_nonzero(valid) < 50:
        raise ValueError(
            f"{model} model sees {np.count_nonzero(valid)} of {len(pixels)} pixels of the grid;"
            " expected 50"
        )
    theta, pixels = theta[valid], pixels[valid]
    centre = np.array(centre_px)
    direction = rays[valid, :2] / np.maximum(np.sin(theta), 1e-12)[:, None]
    powers = theta[:, None] ** (2 * np.arange(1, 5) + 1)

    def residual(unknown: np.ndarray) -> np.ndarray:
        radius = theta + powers @ unknown[2:]
        return (direction * radius[:, None] * unknown[:2] - (pixels - centre)).ravel()

    start = np.array([*focal_px, 0.0, 0.0, 0.0, 0.0])
    fit = least_squares(residual, start, x_scale="jac", method="lm", xtol=1e-14, ftol=1e-14)
    error = np.linalg.norm(fit.fun.reshape(-1, 2), axis=1)
    coefficients = tuple(float(k) for k in fit.x[2:])
    limit = 2.0 * math.degrees(monotonic_limit(coefficients))
    fov = min(seen_deg if fov_deg is None else fov_deg, seen_deg, limit * (1.0 - 1e-9))
    params = FisheyeParams(
        width, height, float(fit.x[0]), float(fit.x[1]), *map(float, centre), *coefficients, fov
    )
    return params, FitReport(
        model, float(np.sqrt(np.mean(error**2))), float(error.max()), len(theta)
    )


def _plane(values: dict[str, float], pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels on the model's image plane, shape (N, 2), and their squared radius, shape (N,)."""
    m = (pixels - [values["cx"], values["cy"]]) / [values["fx"], values["fy"]]
    return m, np.sum(m * m, axis=1)
