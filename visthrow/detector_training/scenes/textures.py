"""Load photographs as textures, from scikit-image or from a folder.

scikit-image's wheel contains them, and ``skimage.data`` states their licences: brick, grass,
gravel, coffee and chelsea are CC0, rocket and astronaut are NASA's (public domain), motorcycle is
from the Middlebury stereo data, and color and cell are from its contributors."""

from importlib.util import find_spec
from pathlib import Path

import numpy as np

SIZE = 512  # side of the finest level [px]
MIPS = 7  # number of levels, each half as large as the previous one

TRAINING = ("brick", "gravel", "coffee", "motorcycle_left", "rocket", "color", "coins")
HELD_OUT = ("grass", "chelsea", "motorcycle_right", "astronaut", "moon")
"""Photographs of scikit-image for the training of a detector, and for its evaluation."""


def photographs(folder: str | Path | None = None, names: tuple[str, ...] = TRAINING) -> list[Path]:
    """Return the files of photographs.

    Raises ValueError: there are no photographs, or scikit-image is not installed.

    Args:
        folder: folder whose PNG and JPEG files are used; None for scikit-image's photographs.
        names: names of scikit-image's photographs.
    """
    if folder is None:
        spec = find_spec("skimage")
        if spec is None or spec.origin is None:
            raise ValueError(
                "textures: scikit-image is not installed; install visthrow[detector], or name a"
                " folder of photographs"
            )
        folder = Path(spec.origin).parent / "data"
        files = [
            path
            for name in names
            for path in sorted(folder.glob(f"{name}.*"))
            if path.suffix in (".png", ".jpg")
        ]
    else:
        files = sorted(
            path
            for path in Path(folder).iterdir()
            if path.suffix.lower() in (".png", ".jpg", ".jpeg")
        )
    if not files:
        raise ValueError(f"textures: no photograph in {folder}; expected PNG or JPEG files")
    return files


def pyramid(files: list[Path]) -> np.ndarray:
    """Return textures with their coarser levels for the renderer, RGB, uint8, shape (T, bytes of a
    pyramid).

    Raises ValueError: a file is not a picture.
    """
    import cv2

    rows = []
    for path in files:
        picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if picture is None:
            raise ValueError(f"{path}: not a picture that OpenCV can read")
        side = min(picture.shape[:2])
        top = (picture.shape[0] - side) // 2
        margin = (picture.shape[1] - side) // 2
        level = picture[top : top + side, margin : margin + side, ::-1]
        levels = []
        for k in range(MIPS):
            level = cv2.resize(level, (SIZE >> k, SIZE >> k), interpolation=cv2.INTER_AREA)
            levels.append(level.ravel())
        rows.append(np.concatenate(levels))
    if rows:
        return np.stack(rows)
    return np.zeros((0, 1), np.uint8)
