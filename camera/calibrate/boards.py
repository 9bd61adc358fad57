"""Calibration from pictures of a board by OpenCV's fisheye calibration, and check of a lens against
such pictures.
"""

from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import torch
from numpy import ndarray

from camera.fisheye import Fisheye
from camera.params import FisheyeParams, monotonic_limit

DETECTED_AT_LEAST = 3
"""Smallest number of pictures with a detected board that determines the intrinsics."""

BEFORE = 0.17
"""Cosine of the largest angle off the axis (80 deg) of points that initialise a pose's fit."""

WRONG_BOARD = 5.0
"""Ratio of a board's residual to the median of all boards above which its corners count as wrongly
detected.
"""

VIEW_AT_LEAST = 6
"""Smallest number of points of a partly visible board that determines its pose well."""


@dataclass(frozen=True)
class BoardParams:
    """A calibration board: a chessboard with its inner corners as points, a grid of circles with
    their centres, or ChArUco.

    Raises ValueError: an impossible size, or a dictionary that OpenCV does not have.

    Convention: point (i, j) is at ``(j, i, 0) square_size`` from the first, x along the columns, y
    along the rows."""

    columns: int  # points along x: inner corners, or circles
    rows: int  # points along y
    square_size: float  # side of a square, or distance of neighbouring circles [m]
    pattern: Literal["chessboard", "circles", "charuco"] = "chessboard"
    marker_size: float = 0.0  # side of a ChArUco marker [m]
    dictionary: str = "DICT_4X4_50"  # of the ChArUco markers, as OpenCV calls it

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 2 or not self.square_size > 0.0:
            raise ValueError(
                f"board of {self.columns} x {self.rows} points, {self.square_size} m apart;"
                " expected 2 or more each way, above 0 m apart"
            )
        if self.pattern == "charuco" and not 0.0 < self.marker_size < self.square_size:
            raise ValueError(
                f"ChArUco marker of {self.marker_size} m; expected a side above 0 and below the"
                f" square's {self.square_size} m"
            )

    def corners_m(self) -> ndarray:
        """Return the points row by row [m], float64, shape (rows * columns, 3), board frame."""
        x, y = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]) * self.square_size

    def charuco(self) -> Any:
        """Return OpenCV's ChArUco board, which counts squares: one more each way than corners."""
        import cv2

        names = sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_"))
        if self.dictionary not in names:
            raise ValueError(
                f"ChArUco dictionary {self.dictionary!r}; expected one of {', '.join(names)}"
            )
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        squares = (self.columns + 1, self.rows + 1)
        return cv2.aruco.CharucoBoard(squares, self.square_size, self.marker_size, markers)


@dataclass(frozen=True)
class View:
    """Detected points of a board in one picture: points [m], shape (N, 3), board frame, and their
    pixels [px], shape (N, 2).
    """

    points_m: ndarray
    pixels: ndarray


@dataclass(frozen=True)
class BoardReport:
    """Residuals of a calibration over its pictures.

    Attributes:
        rms_px: RMS distance between corners and their reprojections over all pictures [px].
        image_rms_px: RMS distance in each picture [px]; NaN if no board was found.
        points: Number of board points in all pictures.
        left_out: Index of a picture from 0 -> why its board was not used.
    """

    rms_px: float
    image_rms_px: tuple[float, ...]
    points: int
    left_out: dict[int, str] = field(default_factory=dict)


def find_board(image: ndarray, board: BoardParams) -> View | None:
    """Find a board in a picture.

    Args:
        image: Grey or colour picture, uint8, shape (H, W) or (H, W, 3).
        board: The board.

    Returns:
        Its points row by row; of a ChArUco board only the detected ones. None if no complete board
        (of a ChArUco board: fewer than six points) is found.
    """
    import cv2

    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    if board.pattern == "charuco":
        corners, ids, _, _ = cv2.aruco.CharucoDetector(board.charuco()).detectBoard(grey)
        if ids is None or len(ids) < VIEW_AT_LEAST:
            return None
        # half side of the window around a corner without markers, in squares
        margin = 0.5 * (1.0 - board.marker_size / board.square_size)
        points = board.corners_m()[ids.ravel()]
        return View(points, _refine(grey, corners.reshape(-1, 2), margin))
    if board.pattern == "circles":
        flags = cv2.CALIB_CB_SYMMETRIC_GRID
        success, centres = cv2.findCirclesGrid(grey, (board.columns, board.rows), flags=flags)
        if success:
            return View(board.corners_m(), centres.reshape(-1, 2).astype(np.float64))
        return None
    # Equalising the histogram helps in bad light but costs accuracy in good light, so it is tried
    # second.
    size = (board.columns, board.rows)
    for flags in (cv2.CALIB_CB_ACCURACY, cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE):
        success, corners = cv2.findChessboardCornersSB(grey, size, flags=flags)
        if success:
            return View(board.corners_m(), _refine(grey, corners.reshape(-1, 2)))
    return None


def _refine(grey: ndarray, corners: ndarray, share: float = 0.45) -> ndarray:
    """Refine corners to sub-pixel accuracy, in windows whose half side is a share of the distance
    to the nearest other corner.

    The detector's sub-pixel step assumes straight edges along a whole square, which a fisheye
    bends. On rendered boards the lens calibrated from it had an error of 0.76 px; with this step
    the error is 0.10 px."""
    import cv2

    distances = np.linalg.norm(corners[:, None] - corners[None], axis=-1)
    np.fill_diagonal(distances, np.inf)
    half = int(np.clip(share * distances.min(), 1, 8))
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-4)
    start = corners.astype(np.float32).reshape(-1, 1, 2).copy()
    refined = cv2.cornerSubPix(grey, start, (half, half), (-1, -1), criteria)
    return refined.reshape(-1, 2).astype(np.float64)


def calibrate_from_boards(
    images: list[ndarray], board: BoardParams, fov_deg: float = 180.0
) -> tuple[FisheyeParams, BoardReport]:
    """Calibrate a fisheye from pictures of a board.

    OpenCV's model ends 90 deg off the axis. Boards that reach beyond and boards that fit much worse
    than the others are left out; the report states the reasons. The resulting polynomial is used
    beyond 90 deg. Raises ValueError: pictures differ in size, or too few show a board that fits.

    Args:
        images: Pictures of one camera, uint8, shape (H, W) or (H, W, 3); at least three with the
            whole board in view.
        board: The board.
        fov_deg: Full field of view of the result [deg].

    Returns:
        The fisheye, and the residuals of all views together and of each.
    """
    (height, width), boards = find_boards(images, board)
    views = {i: view for i, view in enumerate(boards) if view is not None}
    left_out: dict[int, str] = {}
    while True:
        used = [i for i in views if i not in left_out]
        if len(used) < DETECTED_AT_LEAST:
            raise ValueError(
                f"no fisheye fits the boards of {DETECTED_AT_LEAST} pictures; left out: "
                + "; ".join(f"picture {i + 1}: {why}" for i, why in left_out.items())
            )
        try:
            lens, residuals = _fit([views[i] for i in used], width, height, fov_deg)
            break
        except _MisfitError as misfit:
            left_out[used[misfit.board]] = str(misfit)
    # A wrong board disturbs the first fits, so that a good one may have been left out instead: each
    # is tried again.
    for number in list(left_out):
        more = sorted([*used, number])
        try:
            lens, residuals = _fit([views[i] for i in more], width, height, fov_deg)
        except _MisfitError:
            continue
        used = more
        del left_out[number]
    estimates = dict(zip(used, residuals))
    report = _report([estimates.get(i) for i in range(len(boards))])
    return replace(lens, fov_deg=fov_deg), replace(report, left_out=left_out)


class _MisfitError(Exception):
    """No lens fits all boards; ``board`` is the index of the board to leave out."""

    def __init__(self, board: int, reason: str):
        super().__init__(reason)
        self.board = board


def _fit(
    views: list[View], width: int, height: int, fov_deg: float
) -> tuple[FisheyeParams, list[ndarray]]:
    """Fit a lens to boards. Returns the lens and the residuals of each board [px], shape (2 N,).

    Raises _MisfitError: OpenCV's model cannot be fitted, or a board fits far worse than the others.
    """
    import cv2

    try:
        lens = _solve(views, width, height, fov_deg)
        fisheye = Fisheye(lens)
        residuals = [_residual(fisheye, view, board_pose(fisheye, view)) for view in views]
    except (cv2.error, ValueError) as error:
        farthest, reach = _farthest(views, width, height)
        reason = str(error).strip().splitlines()[-1]
        raise _MisfitError(
            farthest,
            f"reaches {reach:.0f} px from the image's centre, and OpenCV's model, which ends 90 deg"
            f" off the axis, cannot be fitted with it ({reason})",
        ) from error
    sizes = [float(np.sqrt(2.0 * np.mean(residual**2))) for residual in residuals]
    usual = float(np.median(sizes))
    worst = int(np.argmax(sizes))
    if sizes[worst] > WRONG_BOARD * usual:
        raise _MisfitError(worst, f"is {sizes[worst]:.2f} px off, the others {usual:.2f} px")
    return lens, residuals


def _farthest(views: list[View], width: int, height: int) -> tuple[int, float]:
    """Return the index of the board with the point farthest from the image's centre, and its
    distance [px].
    """
    centre = np.array([width - 1.0, height - 1.0]) / 2.0
    reach = [float(np.linalg.norm(view.pixels - centre, axis=1).max()) for view in views]
    return int(np.argmax(reach)), max(reach)


def _solve(views: list[View], width: int, height: int, fov_deg: float) -> FisheyeParams:
    """Calibrate a fisheye by OpenCV; its field of view is limited to where theta_d increases."""
    import cv2

    # With the focal length at which 180 deg fill the width, OpenCV's first step stays valid.
    start = np.diag([width / np.pi, width / np.pi, 1.0])
    start[:2, 2] = (width / 2 - 0.5, height / 2 - 0.5)
    flags = cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW | cv2.CALIB_USE_INTRINSIC_GUESS
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-10)
    points = [v.points_m[None] for v in views]
    pixels = [v.pixels[None] for v in views]
    size = (width, height)
    how = (size, start, np.zeros((4, 1)))
    solution = cv2.fisheye.calibrate(points, pixels, *how, flags=flags, criteria=criteria)
    (fx, _, cx), (_, fy, cy), _ = np.asarray(solution[1]).tolist()
    k1, k2, k3, k4 = np.asarray(solution[2]).ravel().tolist()
    widest = 1.999 * float(np.degrees(monotonic_limit((k1, k2, k3, k4))))
    fov_deg = min(fov_deg, widest, 360.0)
    return FisheyeParams(*size, fx, fy, cx, cy, k1, k2, k3, k4, fov_deg)


def check_boards(images: list[ndarray], board: BoardParams, fisheye: FisheyeParams) -> BoardReport:
    """Return the reprojection error of a given lens on pictures of a board. Only the boards' poses
    are fitted.

    Raises ValueError: pictures are not of the lens's size, or too few show the board.

    Args:
        images: Pictures of one camera, uint8, shape (H, W) or (H, W, 3), of the lens's size.
        board: The board.
        fisheye: The lens.
    """
    size, views = find_boards(images, board)
    if size != (fisheye.height, fisheye.width):
        raise ValueError(
            f"pictures of {size[1]} x {size[0]} px came; expected {fisheye.width} x"
            f" {fisheye.height}, the lens's size"
        )
    lens = Fisheye(fisheye)
    return _report([None if v is None else _residual(lens, v, board_pose(lens, v)) for v in views])


def find_boards(
    images: list[ndarray], board: BoardParams
) -> tuple[tuple[int, int], list[View | None]]:
    """Return the size (height, width) of all pictures, and the detected board in each.

    Raises ValueError: pictures differ in size, or fewer than three show the board.
    """
    sizes = sorted({image.shape[:2] for image in images})
    if len(sizes) != 1:
        raise ValueError(
            f"pictures of sizes {sizes} came (height, width); expected one size, that of one camera"
        )
    views = [find_board(image, board) for image in images]
    count = sum(view is not None for view in views)
    if count < DETECTED_AT_LEAST:
        raise ValueError(
            f"a {board.pattern} of {board.columns} x {board.rows} points was found in {count} of "
            f"{len(images)} pictures; expected at least {DETECTED_AT_LEAST}"
        )
    return sizes[0], views


def board_pose(lens: Fisheye, view: View) -> ndarray:
    """Fit the pose of a board by least squares of its pixels: rotation vector [rad] and position of
    its first point [m], shape (6,), camera frame.
    """
    import cv2
    from scipy.optimize import least_squares

    rays = lens.unproject(torch.from_numpy(view.pixels))[0].numpy()
    before = rays[:, 2] > BEFORE
    if np.count_nonzero(before) < VIEW_AT_LEAST:
        raise ValueError(
            f"{np.count_nonzero(before)} points of a board lie within"
            f" {np.degrees(np.arccos(BEFORE)):.0f} deg of the axis; expected {VIEW_AT_LEAST}: is"
            " this the lens of these pictures?"
        )
    plane = rays[before, :2] / rays[before, 2:]
    points = view.points_m[before]
    lens_of_plane = (np.eye(3), np.zeros(4))
    _, turn, place = cv2.solvePnP(points, plane, *lens_of_plane, flags=cv2.SOLVEPNP_IPPE)

    def residual(pose: ndarray) -> ndarray:
        return _residual(lens, view, pose)

    start = np.concatenate([turn, place]).ravel()
    solution = least_squares(residual, start, x_scale="jac", method="lm")
    return np.asarray(solution.x)


def reproject(lens: Fisheye, view: View) -> ndarray:
    """Fit a board's pose and return the pixels of its reprojected points [px], shape (N, 2)."""
    residual = _residual(lens, view, board_pose(lens, view))
    return np.asarray(view.pixels + residual.reshape(-1, 2))


def _residual(lens: Fisheye, view: View, pose: ndarray) -> ndarray:
    """Return reprojected minus detected pixels [px], shape (2 N,), of a board at a pose (rotation
    vector, position).
    """
    import cv2

    turn, _ = cv2.Rodrigues(pose[:3])
    points_c = view.points_m @ np.asarray(turn).T + pose[3:]
    pixels, _ = lens.project(torch.from_numpy(points_c))
    return np.asarray(pixels.numpy() - view.pixels).ravel()


def _report(residuals: list[ndarray | None]) -> BoardReport:
    """Compute the report from the pictures' residuals, shape (2 N,) each; None without a board."""

    def rms(residual: ndarray) -> float:
        return float(np.sqrt(2.0 * np.mean(residual * residual)))

    together = np.concatenate([r for r in residuals if r is not None])
    errors = tuple(np.nan if r is None else rms(r) for r in residuals)
    return BoardReport(rms(together), errors, together.size // 2)
