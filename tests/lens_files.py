"""Calibration files of other tools, as they write them, with a field of view beside; for tests of
`camera.calibrate.files`.
"""

import json
from pathlib import Path
from typing import Any

from camera.params import FisheyeParams


def write_opencv(path: str | Path, fisheye: FisheyeParams) -> None:
    """Write an OpenCV YAML file."""
    import cv2
    import numpy as np

    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_FORMAT_YAML)
    assert storage.isOpened()
    storage.write("fisheye_model", 1)
    storage.write("fov_deg", float(fisheye.fov_deg))
    storage.write("image_width", fisheye.width)
    storage.write("image_height", fisheye.height)
    storage.write("camera_matrix", np.array(_matrix(fisheye)).reshape(3, 3))
    storage.write("distortion_coefficients", np.array(fisheye.coefficients).reshape(4, 1))
    storage.release()


def write_kalibr(path: str | Path, fisheye: FisheyeParams) -> None:
    """Write a Kalibr camchain of one camera."""
    tree = {
        "cam0": {
            "fov_deg": fisheye.fov_deg,
            "camera_model": "pinhole",
            "intrinsics": [fisheye.fx, fisheye.fy, fisheye.cx, fisheye.cy],
            "distortion_model": "equidistant",
            "distortion_coeffs": list(fisheye.coefficients),
            "resolution": [fisheye.width, fisheye.height],
            "rostopic": "/cam0/image_raw",
        }
    }
    _dump_yaml(path, tree)


def write_ros(path: str | Path, fisheye: FisheyeParams) -> None:
    """Write a ROS camera_info YAML."""
    fx, _, cx, _, fy, cy, *_ = _matrix(fisheye)
    tree = {
        "fov_deg": fisheye.fov_deg,
        "image_width": fisheye.width,
        "image_height": fisheye.height,
        "camera_name": "camera",
        "camera_matrix": {"rows": 3, "cols": 3, "data": _matrix(fisheye)},
        "distortion_model": "equidistant",
        "distortion_coefficients": {"rows": 1, "cols": 4, "data": list(fisheye.coefficients)},
        "rectification_matrix": {
            "rows": 3,
            "cols": 3,
            "data": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        },
        "projection_matrix": {
            "rows": 3,
            "cols": 4,
            "data": [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
        },
    }
    _dump_yaml(path, tree)


def write_basalt(path: str | Path, fisheye: FisheyeParams) -> None:
    """Write a basalt JSON of one ``kb4`` camera at the IMU; sensor noise is left zero for its owner
    to fill in.
    """
    pose = {"px": 0.0, "py": 0.0, "pz": 0.0, "qx": 0.0, "qy": 0.0, "qz": 0.0, "qw": 1.0}
    values = {
        name: getattr(fisheye, name) for name in ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")
    }
    tree = {
        "T_imu_cam": [pose],
        "intrinsics": [{"camera_type": "kb4", "intrinsics": values, "fov_deg": fisheye.fov_deg}],
        "resolution": [[fisheye.width, fisheye.height]],
        "calib_accel_bias": [0.0] * 9,
        "calib_gyro_bias": [0.0] * 12,
        "imu_update_rate": 200.0,
        **{
            f"{sensor}_{kind}_std": [0.0] * 3
            for sensor in ("accel", "gyro")
            for kind in ("noise", "bias")
        },
        "cam_time_offset_ns": 0,
        "vignette": [],
    }
    Path(path).write_text(json.dumps({"value0": tree}, indent=4) + "\n")


def _matrix(fisheye: FisheyeParams) -> list[float]:
    """Camera matrix, row by row."""
    return [fisheye.fx, 0.0, fisheye.cx, 0.0, fisheye.fy, fisheye.cy, 0.0, 0.0, 1.0]


def _dump_yaml(path: str | Path, tree: dict[str, Any]) -> None:
    import yaml

    Path(path).write_text(yaml.safe_dump(tree, sort_keys=False))
