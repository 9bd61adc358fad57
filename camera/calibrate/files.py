"""Calibration files of the field: OpenCV YAML, Kalibr camchain, ROS camera_info and basalt JSON.

Convention: all four count pixels from the centre of the top left one and x right, y down, z forward, as `FisheyeParams`
does. None of them holds a field of view; it is read from an extra key ``fov_deg``, which their own readers ignore. A
file without it gets the ``fov_deg`` of the call or, that left out, the angle that the farthest corner of the image
sees.
"""

import json
import math
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
    """Read an OpenCV YAML (or XML, JSON) file of a fisheye calibration.

    Raises ValueError: the file is missing, cut short, lacks a key, or holds another model.

    Args:
        path: File with ``fisheye_model: 1``, ``image_width``, ``image_height``, ``camera_matrix`` and four
            ``distortion_coefficients``, as OpenCV's calibration sample writes them.
        fov_deg: Full field of view where the file has none [deg].
    """
    import cv2

    _text(path)
    numbers = ("fisheye_model", "image_width", "image_height", "fov_deg")
    tree: dict[str, Any] = {}
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        exists = sorted(storage.root().keys())
        for key in exists:
            node = storage.getNode(key)
            if key in numbers and (node.isInt() or node.isReal()):
                tree[key] = node.real()
            elif key in ("camera_matrix", "distortion_coefficients") and node.isMap():
                tree[key] = node.mat().ravel().tolist()
    except (cv2.error, SystemError, AttributeError) as error:
        raise ValueError(f"{path} cannot be read as an OpenCV file (cut short?): {str(error).strip()}") from error
    if _get(path, tree, "fisheye_model", exists) != 1:
        raise ValueError(f"{path}: fisheye_model is {tree['fisheye_model']}; expected 1, the Kannala-Brandt model")
    fx, cx, fy, cy = _from_matrix(path, _get(path, tree, "camera_matrix", exists))
    k = _floats(path, "distortion_coefficients", _get(path, tree, "distortion_coefficients", exists), 4)
    size = [_get(path, tree, key, exists) for key in ("image_width", "image_height")]
    return _params(path, size, (fx, fy, cx, cy, *k), tree.get("fov_deg"), fov_deg)


def read_kalibr(path: str | Path, camera: int = 0, fov_deg: float | None = None) -> FisheyeParams:
    """Read one camera of a Kalibr camchain (``pinhole`` + ``equidistant``, which is Kannala-Brandt).

    Raises ValueError: the file is missing, cut short, lacks a key, or holds another model.

    Args:
        path: The camchain YAML.
        camera: Number of the camera in it.
        fov_deg: Full field of view where the file has none [deg].
    """
    chain = _yaml(path)
    tree = _mapping(path, f"cam{camera}", _get(path, chain, f"cam{camera}"))
    _expect(path, tree, "camera_model", ("pinhole",))
    _expect(path, tree, "distortion_model", ("equidistant",))
    fx, fy, cx, cy = _floats(path, "intrinsics", _get(path, tree, "intrinsics"), 4)
    k = _floats(path, "distortion_coeffs", _get(path, tree, "distortion_coeffs"), 4)
    size = _floats(path, "resolution", _get(path, tree, "resolution"), 2)
    return _params(path, size, (fx, fy, cx, cy, *k), tree.get("fov_deg"), fov_deg)


def read_ros(path: str | Path, fov_deg: float | None = None) -> FisheyeParams:
    """Read a ROS camera_info YAML with the ``equidistant`` (ROS 2, REP 118) or ``fisheye`` distortion model.

    Raises ValueError: the file is missing, cut short, lacks a key, or holds another model.

    Args:
        path: The file.
        fov_deg: Full field of view where the file has none [deg].
    """
    tree = _yaml(path)
    _expect(path, tree, "distortion_model", ("equidistant", "fisheye"))
    matrix = _mapping(path, "camera_matrix", _get(path, tree, "camera_matrix"))
    fx, cx, fy, cy = _from_matrix(path, _get(path, matrix, "data"))
    node = _mapping(path, "distortion_coefficients", _get(path, tree, "distortion_coefficients"))
    k = _floats(path, "distortion_coefficients.data", _get(path, node, "data"), 4)
    for key, count in (
        ("rectification_matrix", 9),
        ("projection_matrix", 12),
    ):  # unused, but a file cut short lacks them
        _floats(path, f"{key}.data", _get(path, _mapping(path, key, _get(path, tree, key)), "data"), count)
    size = [_get(path, tree, key) for key in ("image_width", "image_height")]
    return _params(path, size, (fx, fy, cx, cy, *k), tree.get("fov_deg"), fov_deg)


def read_basalt(path: str | Path, camera: int = 0, fov_deg: float | None = None) -> tuple[FisheyeParams, FitReport]:
    """Read one camera of a basalt calibration: ``kb4`` as it is, ``ds`` and ``eucm`` through a fit.

    Raises ValueError: the file is missing, cut short, lacks a key, or holds another model.

    Args:
        path: The JSON file.
        camera: Number of the camera in it.
        fov_deg: Full field of view where the file has none [deg]; fitted models are fitted inside it.

    Returns:
        The fisheye and what the fit left over (all zero for ``kb4``).
    """
    try:
        tree = json.loads(_text(path, whole_lines=False))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is no complete JSON (cut short?): {error}") from error
    tree = _mapping(path, "value0", _get(path, _mapping(path, "the file", tree), "value0"))
    node = _mapping(path, "intrinsics", _item(path, "intrinsics", _get(path, tree, "intrinsics"), camera))
    size = _floats(path, "resolution", _item(path, "resolution", _get(path, tree, "resolution"), camera), 2)
    model = _get(path, node, "camera_type")
    if model != "kb4" and model not in FOREIGN_MODELS:
        raise ValueError(f"{path}: camera_type is {model!r}; expected one of {['kb4', *sorted(FOREIGN_MODELS)]}")
    given = _mapping(path, "intrinsics", _get(path, node, "intrinsics"))
    names = _KB4 if model == "kb4" else FOREIGN_MODELS[model][0]
    numbers = _floats(path, "intrinsics", [_get(path, given, name) for name in names], len(names))
    values = dict(zip(names, numbers, strict=True))
    if model == "kb4":
        return _params(path, size, tuple(values[n] for n in _KB4), node.get("fov_deg"), fov_deg), EXACT
    try:
        return fit_fisheye(model, values, int(size[0]), int(size[1]), fov_deg)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def image_fov_deg(fisheye: FisheyeParams) -> float:
    """Full field of view that the farthest corner of the image sees [deg], cut to where theta_d stops growing and to
    360."""
    limit = min(2.0 * math.degrees(monotonic_limit(fisheye.coefficients)), 360.0)
    widest = Fisheye(FisheyeParams(**{**vars(fisheye), "fov_deg": limit * (1.0 - 1e-9)}))
    right, low = fisheye.width - 0.5, fisheye.height - 0.5
    corners = torch.tensor([[-0.5, -0.5], [right, -0.5], [right, low], [-0.5, low]], dtype=torch.float64)
    rays, _ = widest.unproject(corners)
    return 2.0 * math.degrees(float(widest.angle(rays)[0].max()))


def _params(path: str | Path, size: list[Any], values: tuple[float, ...], own_fov: Any, asked_fov: float | None) -> FisheyeParams:
    """Assemble and check intrinsics; the message of a refusal names the file."""
    width, height = (int(s) for s in _floats(path, "image size", size, 2))
    named = dict(zip(_KB4, values, strict=True))
    try:
        fov = own_fov if own_fov is not None else asked_fov
        if fov is None:
            fov = image_fov_deg(FisheyeParams(width, height, **named, fov_deg=1.0))
        params = FisheyeParams(width, height, **named, fov_deg=_floats(path, "fov_deg", [fov], 1)[0])
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return params


def _from_matrix(path: str | Path, values: Any) -> tuple[float, float, float, float]:
    """fx, cx, fy, cy of a camera matrix without skew."""
    fx, skew, cx, _, fy, cy, *_ = _floats(path, "camera_matrix", values, 9)
    if abs(skew) > 1e-9 * abs(fx):
        raise ValueError(f"{path}: camera_matrix has a skew of {skew}; expected 0, which our model has")
    return fx, cx, fy, cy


def _text(path: str | Path, whole_lines: bool = True) -> str:
    """Text of a file that exists and, where the format has no closing bracket, does not end within a line."""
    if not Path(path).is_file():
        raise ValueError(f"{path} is not a file; expected a calibration file")
    text = Path(path).read_text()
    if whole_lines and not text.endswith("\n"):
        # "resolution: [640, 48" and "- 48" of 480 read as numbers too: only the missing line end tells.
        raise ValueError(f"{path} ends within a line (cut short?); expected a line end, which a complete file needs")
    return text


def _yaml(path: str | Path) -> dict[str, Any]:
    import yaml

    try:
        tree = yaml.safe_load(_text(path))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is no complete YAML (cut short?): {error}") from error
    return _mapping(path, "the file", tree)


def _mapping(path: str | Path, name: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{path}: {name} is {_short(value)}; expected a mapping of keys to values")
    return value


def _get(path: str | Path, tree: dict[str, Any], key: str, exists: list[str] | None = None) -> Any:
    if key not in tree:
        exists = sorted(map(str, tree)) if exists is None else exists
        raise ValueError(f"{path} lacks the key {key!r} (cut short?); it has {exists}")
    return tree[key]


def _item(path: str | Path, name: str, values: Any, index: int) -> Any:
    if not isinstance(values, list) or not 0 <= index < len(values):
        count = len(values) if isinstance(values, list) else 0
        raise ValueError(f"{path}: camera {index} asked for; expected below {count}, the number of {name} in the file")
    return values[index]


def _floats(path: str | Path, name: str, values: Any, count: int) -> list[float]:
    listed = isinstance(values, list | tuple) and len(values) == count
    if not listed or not all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
        raise ValueError(f"{path}: {name} is {_short(values)}; expected {count} numbers")
    return [float(v) for v in values]


def _expect(path: str | Path, tree: dict[str, Any], key: str, choices: tuple[str, ...]) -> None:
    value = _get(path, tree, key)
    if value not in choices:
        raise ValueError(f"{path}: {key} is {_short(value)}; expected one of {list(choices)}")


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."
