"""One reader for calibration files of every tool: the format is told from the text, or named."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from camera.calibrate import files
from camera.calibrate.foreign import FitReport, fit_rays
from camera.params import FisheyeParams

Reading = tuple[FisheyeParams, FitReport]

READERS: dict[str, Callable[[Path, int, float | None], Reading]] = {
    "opencv": lambda path, camera, fov: (files.read_opencv(path, fov), files.EXACT),
    "kalibr": lambda path, camera, fov: (files.read_kalibr(path, camera, fov), files.EXACT),
    "ros": lambda path, camera, fov: (files.read_ros(path, fov), files.EXACT),
    "basalt": lambda path, camera, fov: files.read_basalt(path, camera, fov),
    "ocam": lambda path, camera, fov: read_ocam(path, fov),
}
"""Format -> reader of (path, number of the camera in the file, field of view where the file has
none [deg]).
"""

_MARKS = {
    "basalt": ('"value0"',),
    "kalibr": ("distortion_coeffs", "cam0"),
    "opencv": ("fisheye_model", "opencv-matrix"),
    "ros": ("distortion_model",),
    "ocam": ("cam2world", "polynomial coefficients"),
}
"""Words of which one shows the format, asked in this order."""


def format_of(path: str | Path) -> str:
    """Tell the format of a calibration file from its text.

    Raises ValueError: the file is missing, no text, or of none of the formats.
    """
    try:
        text = files.text_of(path, whole_lines=False)
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path} is no text; expected a calibration of {', '.join(READERS)}"
        ) from error
    for name, marks in _MARKS.items():
        if any(mark in text for mark in marks):
            return name
    raise ValueError(
        f"{path} is of no known format; expected a calibration of {', '.join(READERS)}"
    )


def read(
    path: str | Path, format: str = "auto", camera: int = 0, fov_deg: float | None = None
) -> tuple[str, FisheyeParams, FitReport]:
    """Read a calibration file.

    Raises ValueError: the format is unknown, or its reader refuses the file.

    Args:
        path: The file.
        format: A key of `READERS`, or "auto".
        camera: Number of the camera in a file that holds several.
        fov_deg: Full field of view where the file has none [deg]; by default what the farthest
            corner of the image sees.

    Returns:
        The format, the fisheye, and what a fit of another lens model left over (zero where the file
        holds ours).
    """
    name = format_of(path) if format == "auto" else format
    if name not in READERS:
        raise ValueError(f"calibration format {name!r}; expected one of {['auto', *READERS]}")
    return name, *READERS[name](Path(path), camera, fov_deg)


def read_ocam(path: str | Path, fov_deg: float | None = None) -> Reading:
    """Read the text file that OCamCalib's "export data" writes, and fit our model to its direct
    polynomial.

    Raises ValueError: the file is missing, cut short, or describes no lens.

    Convention: the file counts rows before columns, from 0 at the centre of the top left pixel; its
    z axis points away from the scene. An affine part (c, d, e) that shears the image is beyond our
    model and shows in the report.

    Source: Scaramuzza, Martinelli, Siegwart, "A Toolbox for Easily Calibrating Omnidirectional
    Cameras", IROS 2006, eq. 3.

    Args:
        path: The file: direct polynomial, inverse polynomial (unused), centre, affine part, image
            size (height, width).
        fov_deg: Full field of view to fit in [deg]; by default all that the image sees.
    """
    lines = [
        line.split()
        for line in files.text_of(path, whole_lines=False).splitlines()
        if line.strip() and not line.startswith("#")
    ]
    try:
        direct, _, centre, affine, size = ([float(word) for word in line] for line in lines[:5])
        row, column = centre
        c, d, e = affine
        height, width = (int(x) for x in size)
    except ValueError as error:
        raise ValueError(
            f"{path}: {len(lines)} lines of numbers ({error}); expected five: direct polynomial,"
            " inverse polynomial, centre, affine part c d e, height and width"
        ) from error
    powers = np.array(direct[1:])
    if (
        len(powers) != int(direct[0])
        or len(powers) < 1
        or not powers[0] < 0.0
        or not math.isfinite(sum(direct))
        or c == d * e
    ):
        raise ValueError(
            f"{path}: direct polynomial {direct}; expected the number of its coefficients, then"
            " those, finite, the first below 0"
        )
    stretch = np.linalg.inv(np.array([[c, d], [e, 1.0]]))

    def unproject(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        down, right = stretch @ (pixels[:, ::-1] - [row, column]).T
        rays = np.column_stack([right, down, -np.polyval(powers[::-1], np.hypot(down, right))])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        return rays, np.ones(len(rays), bool)

    focal = -float(powers[0])
    try:
        return fit_rays(
            "ocam", unproject, (column, row), (focal, c * focal), width, height, fov_deg
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
