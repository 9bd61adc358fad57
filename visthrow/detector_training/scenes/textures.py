"""Photographs as textures: those that scikit-image ships, or a folder of one's own.

scikit-image's wheel holds them with their licences named in ``skimage.data``: brick, grass, gravel
and coffee are CC0, rocket and astronaut NASA's (public domain), motorcycle of the Middlebury stereo
data, chelsea CC0, color and cell of its contributors."""

from importlib.util import find_spec
from pathlib import Path

import numpy as np

SIZE = 512  # side of the finest level [px]
MIPS = 7  # levels, each half as large as the one before

TRAINING = ("brick", "gravel", "coffee", "motorcycle_left", "rocket", "color", "coins")
HELD_OUT = ("grass", "chelsea", "motorcycle_right", "astronaut", "moon")
"""Photographs of scikit-image that a detector is trained on, and that it is measured on."""


def photographs(folder: str | Path | None = None, names: tuple[str, ...] = TRAINING) -> list[Path]:
    """Files of photographs.

    Raises ValueError: no photograph there, or scikit-image is not installed.

    Args:
        folder: of one's own, all its PNG and JPEG files; None: scikit-image's.
        names: of scikit-image's.
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
    """Textures with their coarser levels, RGB, uint8, shape (T, bytes of a pyramid): what the
    renderer reads.

    Raises ValueError: a file that is no picture.
    """
    import cv2

    rows = []
    for path in files:
        picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if picture is None:
            raise ValueError(f"{path}: no picture that OpenCV can read")
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
