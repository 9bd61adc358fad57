"""Calibration from pictures of a chessboard, through OpenCV's fisheye calibration."""

from dataclasses import dataclass

import numpy as np
import torch

from camera.fisheye import Fisheye
from camera.params import FisheyeParams

DETECTED_AT_LEAST = 3
"""Views with a found board below which the intrinsics are not determined."""


@dataclass(frozen=True)
class BoardParams:
    """A chessboard: inner corners (where four squares meet) and size of a square.

    Convention: corner (i, j) lies at ``(j, i, 0) square_size`` from the first, x along the columns, y along the rows.
    """

    columns: int  # inner corners along x
    rows: int  # inner corners along y
    square_size: float  # [m]

    def corners_m(self) -> np.ndarray:
        """Inner corners row by row [m], float64, shape (rows * columns, 3), board frame."""
        x, y = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]) * self.square_size


@dataclass(frozen=True)
class BoardReport:
    """How well a calibration explains its pictures.

    Attributes:
        rms_px: Root mean square distance of corners and their reprojections over all views [px].
        image_rms_px: The same for each picture [px]; NaN where no board was found.
    """

    rms_px: float
    image_rms_px: tuple[float, ...]


def find_corners(image: np.ndarray, board: BoardParams) -> np.ndarray | None:
    """Inner corners of a board in a picture.

    Args:
        image: Grey or colour picture, uint8, shape (H, W) or (H, W, 3).
        board: The board.

    Returns:
        Corners row by row [px], shape (rows * columns, 2), or None where no whole board is found.
    """
    import cv2

    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    # Equalising the histogram helps in bad light and costs accuracy in good light, so it comes second.
    for flags in (cv2.CALIB_CB_ACCURACY, cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE):
        found, corners = cv2.findChessboardCornersSB(grey, (board.columns, board.rows), flags=flags)
        if found:
            return _refine(grey, corners.reshape(-1, 2))
    return None


def _refine(grey: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Corners at sub-pixel accuracy, from windows that reach almost half-way to the nearest other corner.

    The detector's own sub-pixel step assumes straight edges over a whole square, which a fisheye bends: on rendered
    boards the lens calibrated from it was 0.76 px off, with this step 0.10 px.
    """
    import cv2

    apart = np.linalg.norm(corners[:, None] - corners[None], axis=-1) + np.diag(np.full(len(corners), np.inf))
    half = int(np.clip(0.45 * apart.min(), 1, 8))
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-4)
    start = corners.astype(np.float32).reshape(-1, 1, 2).copy()
    return cv2.cornerSubPix(grey, start, (half, half), (-1, -1), criteria).reshape(-1, 2).astype(np.float64)


def calibrate_from_boards(
    images: list[np.ndarray], board: BoardParams, fov_deg: float = 180.0
) -> tuple[FisheyeParams, BoardReport]:
    """Calibrate a fisheye from pictures of a chessboard.

    OpenCV's model folds past 90 deg off the axis, so every board must lie before the lens; the polynomial found there
    goes on past 90 deg.

    Args:
        images: Pictures of one camera, uint8, shape (H, W) or (H, W, 3); at least three with the whole board in view.
        board: The board.
        fov_deg: Full field of view of the result [deg].

    Returns:
        The fisheye and the residuals, for all views and for each.

    Raises:
        ValueError: Pictures differ in size, too few show the board, or OpenCV finds no solution.
    """
    import cv2

    sizes = sorted({image.shape[:2] for image in images})
    if len(sizes) != 1:
        raise ValueError(f"pictures of sizes {sizes} came (height, width); expected one size, that of one camera")
    corners = [find_corners(image, board) for image in images]
    views = [c for c in corners if c is not None]
    if len(views) < DETECTED_AT_LEAST:
        raise ValueError(
            f"a board of {board.columns} x {board.rows} inner corners was found in {len(views)} of "
            f"{len(images)} pictures; expected at least {DETECTED_AT_LEAST}"
        )
    height, width = sizes[0]
    points_m = board.corners_m()
    # The focal length that lets 180 deg fill the width: a start that keeps OpenCV's first step inside the model.
    start = np.array([[width / np.pi, 0.0, width / 2 - 0.5], [0.0, width / np.pi, height / 2 - 0.5], [0.0, 0.0, 1.0]])
    flags = cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW | cv2.CALIB_USE_INTRINSIC_GUESS
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-10)
    try:
        _, matrix, k, rotations, translations = cv2.fisheye.calibrate(
            [points_m[None]] * len(views), [v[None] for v in views], (width, height), start, np.zeros((4, 1)),
            flags=flags, criteria=criteria,
        )  # fmt: skip
    except cv2.error as error:
        raise ValueError(f"OpenCV found no fisheye for {len(views)} boards: {str(error).strip()}") from error
    values = [float(x) for x in (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *k.ravel())]
    params = FisheyeParams(width, height, *values, fov_deg=fov_deg)
    lens = Fisheye(params)
    poses = iter(zip(rotations, translations, strict=True))
    squares = [np.nan if c is None else _mean_square(lens, points_m, c, *next(poses)) for c in corners]
    return params, BoardReport(float(np.sqrt(np.nanmean(squares))), tuple(float(s) for s in np.sqrt(squares)))


def _mean_square(
    lens: Fisheye, points_m: np.ndarray, corners: np.ndarray, rotation: np.ndarray, translation: np.ndarray
) -> float:
    """Mean squared distance of corners from their reprojections in one view [px^2]."""
    import cv2

    points_c = points_m @ cv2.Rodrigues(rotation)[0].T + translation.ravel()
    pixels = lens.project(torch.from_numpy(points_c))[0].numpy()
    return float(np.mean(np.sum((pixels - corners) ** 2, axis=1)))
