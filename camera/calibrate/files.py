"""Calibration files of the field: OpenCV YAML, Kalibr camchain, ROS camera_info and basalt JSON.

Convention: all four count pixels from the centre of the top left one and x right, y down, z
forward, as `FisheyeParams` does. None of them holds a field of view; it is read from an extra key
``fov_deg``, which their own readers ignore. A file without it gets the ``fov_deg`` of the call
[deg] or, that left out, the angle that the farthest corner of the image sees. A file that is
missing, cut short, lacks a key, or holds another model is a ValueError; ``camera`` is the number of
one in a file that holds several."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from camera.calibrate.foreign import FOREIGN_MODELS, FitReport, fit_fisheye
from camera.fisheye import Fisheye
from camera.params import FisheyeParams, monotonic_limit

EXACT = FitReport("kb4", 0.0, 0.0, 0)
"""Report of a file that holds our own model: nothing was fitted."""

_KB4 = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")


def read_opencv(path: str | Path, fov_deg: float | None = None) -> FisheyeParams:
    """Read an OpenCV YAML (or XML, JSON) file of a fisheye calibration, ``fisheye_model: 1``, as
    OpenCV's calibration sample writes it.
    """
    import cv2

    text_of(path)
    tree: dict[str, Any] = {}
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        for key in sorted(storage.root().keys()):
            node = storage.getNode(key)
            tree[key] = node.real() if node.isInt() or node.isReal() else None
            if key in ("camera_matrix", "distortion_coefficients") and node.isMap():
                tree[key] = node.mat().ravel().tolist()
    except (cv2.error, SystemError, AttributeError) as error:
        raise ValueError(
            f"{path} cannot be read as an OpenCV file (cut short?): {str(error).strip()}"
        ) from error
    file = _Entry(path, tree)
    file["fisheye_model"].among(1)  # the Kannala-Brandt model
    size = [file[key].value for key in ("image_width", "image_height")]
    return _params(
        file,
        size,
        (*file["camera_matrix"].focal_and_centre(), *file["distortion_coefficients"].floats(4)),
        fov_deg,
    )


def read_kalibr(path: str | Path, camera: int = 0, fov_deg: float | None = None) -> FisheyeParams:
    """Read one camera of a Kalibr camchain (``pinhole`` + ``equidistant``, which is
    Kannala-Brandt).
    """
    file = _yaml(path)[f"cam{camera}"]
    file["camera_model"].among("pinhole")
    file["distortion_model"].among("equidistant")
    values = (*file["intrinsics"].floats(4), *file["distortion_coeffs"].floats(4))
    return _params(file, file["resolution"].value, values, fov_deg)


def read_ros(path: str | Path, fov_deg: float | None = None) -> FisheyeParams:
    """Read a ROS camera_info YAML with the ``equidistant`` (ROS 2, REP 118) or ``fisheye``
    distortion model.
    """
    file = _yaml(path)
    file["distortion_model"].among("equidistant", "fisheye")
    values = (
        *file["camera_matrix"]["data"].focal_and_centre(),
        *file["distortion_coefficients"]["data"].floats(4),
    )
    for key, count in (
        ("rectification_matrix", 9),
        ("projection_matrix", 12),
    ):  # unused, but a file cut short lacks them
        file[key]["data"].floats(count)
    return _params(
        file, [file[key].value for key in ("image_width", "image_height")], values, fov_deg
    )


def read_basalt(
    path: str | Path, camera: int = 0, fov_deg: float | None = None
) -> tuple[FisheyeParams, FitReport]:
    """Read one camera of a basalt calibration:

    ``kb4`` as it is, ``ds`` and ``eucm`` through a fit inside the field of view.

    Returns the fisheye and what the fit left over (all zero for ``kb4``).
    """
    try:
        tree = json.loads(text_of(path, whole_lines=False))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is no complete JSON (cut short?): {error}") from error
    file = _Entry(path, tree)["value0"]
    node = file["intrinsics"][camera]
    model = node["camera_type"].among("kb4", *sorted(FOREIGN_MODELS))
    names = _KB4 if model == "kb4" else FOREIGN_MODELS[model][0]
    values = _Entry(path, [node["intrinsics"][name].value for name in names], "intrinsics").floats(
        len(names)
    )
    size = file["resolution"][camera]
    if model == "kb4":
        return _params(node, size.value, tuple(values), fov_deg), EXACT
    width, height = map(int, size.floats(2))
    try:
        return fit_fisheye(model, dict(zip(names, values, strict=True)), width, height, fov_deg)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def image_fov_deg(fisheye: FisheyeParams) -> float:
    """Full field of view that the farthest corner of the image sees [deg], cut to where theta_d
    stops growing and to 360.
    """
    limit = min(2.0 * math.degrees(monotonic_limit(fisheye.coefficients)), 360.0)
    widest = Fisheye(FisheyeParams(**{**vars(fisheye), "fov_deg": limit * (1.0 - 1e-9)}))
    right, low = fisheye.width - 0.5, fisheye.height - 0.5
    corners = torch.tensor(
        [[-0.5, -0.5], [right, -0.5], [right, low], [-0.5, low]], dtype=torch.float64
    )
    rays, _ = widest.unproject(corners)
    return 2.0 * math.degrees(float(widest.angle(rays)[0].max()))


@dataclass(frozen=True)
class _Entry:
    """What stands in a file under a name; where it is not what is asked for, the ValueError names
    both.
    """

    path: str | Path
    value: Any
    name: str = ""

    def _refused(self, expected: str) -> ValueError:
        text = repr(self.value)
        shown = text if len(text) <= 80 else text[:77] + "..."
        return ValueError(f"{self.path}: {self.name or 'the file'} is {shown}; expected {expected}")

    def __getitem__(self, key: str | int) -> "_Entry":
        """Entry of a mapping by its key, of a list by the number of the camera."""
        if isinstance(key, int):
            count = len(self.value) if isinstance(self.value, list) else 0
            if not 0 <= key < count:
                raise ValueError(
                    f"{self.path}: camera {key} asked for; expected below {count}, the number of"
                    f" {self.name} in the file"
                )
        elif not isinstance(self.value, dict):
            raise self._refused("a mapping of keys to values")
        elif key not in self.value:
            raise ValueError(
                f"{self.path} lacks the key {key!r} (cut short?); it has"
                f" {sorted(map(str, self.value))}"
            )
        return _Entry(self.path, self.value[key], f"{self.name}.{key}".lstrip("."))

    def among(self, *choices: Any) -> Any:
        """The value, which must be one of these."""
        if self.value not in choices:
            raise self._refused(f"one of {list(choices)}")
        return self.value

    def floats(self, count: int) -> list[float]:
        """So many numbers."""
        values = self.value
        good = isinstance(values, list | tuple) and len(values) == count
        if not good or not all(
            isinstance(v, int | float) and not isinstance(v, bool) for v in values
        ):
            raise self._refused(f"{count} numbers")
        return [float(v) for v in values]

    def focal_and_centre(self) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy of a camera matrix without skew."""
        fx, skew, cx, _, fy, cy, *_ = self.floats(9)
        if abs(skew) > 1e-9 * abs(fx):
            raise self._refused("a matrix without skew, which our model has not")
        return fx, fy, cx, cy


def _params(
    entry: _Entry, size: Any, values: tuple[float, ...], asked_fov: float | None
) -> FisheyeParams:
    """Intrinsics in the order of `_KB4`; the field of view is the entry's own, the asked one, or
    what the farthest corner sees.
    """
    width, height = map(int, _Entry(entry.path, size, "image size").floats(2))
    lens = dict(zip(_KB4, values, strict=True))
    fov = asked_fov if entry.value.get("fov_deg") is None else entry.value["fov_deg"]
    try:
        if fov is None:
            fov = image_fov_deg(FisheyeParams(width, height, **lens, fov_deg=1.0))
        return FisheyeParams(
            width, height, **lens, fov_deg=_Entry(entry.path, [fov], "fov_deg").floats(1)[0]
        )
    except ValueError as error:
        raise ValueError(f"{entry.path}: {error}") from error


def text_of(path: str | Path, whole_lines: bool = True) -> str:
    """Text of a file that exists and, where the format has no closing bracket, does not end within
    a line.
    """
    if not Path(path).is_file():
        raise ValueError(f"{path} is not a file; expected a calibration file")
    text = Path(path).read_text()
    if whole_lines and not text.endswith("\n"):
        # "resolution: [640, 48" and "- 48" of 480 read as numbers too: only the missing line end
        # tells.
        raise ValueError(
            f"{path} ends within a line (cut short?); expected a line end, which a complete file"
            " needs"
        )
    return text


def _yaml(path: str | Path) -> _Entry:
    import yaml

    try:
        return _Entry(path, yaml.safe_load(text_of(path)))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is no complete YAML (cut short?): {error}") from error
