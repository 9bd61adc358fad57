"""Effects of the camera, seen in keypoints of a detector against motion capture."""

import numpy as np

from visthrow.diagnose.catalogue.entry import Entry, Key, entry

SEEN = ("keypoints", "pos_w", "quat_wb", "payload_pos_w")
F = "camera.fisheye."
VIEWS = ("vary distance and direction of the target",)
DYNAMICS = ("hover turned by 180 deg", "throws: the dynamics tell where thrust points")


def _looks(setting) -> bool:
    return setting.camera is not None


ENTRIES: tuple[Entry, ...] = (
    entry(
        "camera_focal",
        "The lens's focal length is another",
        "u - c = f (1 + theta) theta_d",
        "1",
        "camera",
        (-0.3, 0.3),
        1e-2,
        2e-3,
        SEEN,
        "Kannala and Brandt 2006; calibrations repeat to a per cent without a board",
        [Key(f"{F}fx", scale=True), Key(f"{F}fy", scale=True)],
        confused=("camera_k1", "keypoint_radius"),
        manoeuvres=VIEWS,
        applies=_looks,
    ),
    *(
        entry(
            f"camera_center_{axis}",
            f"The optical axis meets the image elsewhere along {axis}",
            "u = f theta_d + c + theta",
            "px",
            "camera",
            (-100.0, 100.0),
            4.0,
            0.5,
            SEEN,
            "Kannala and Brandt 2006; cheap lenses sit off by some pixels",
            [Key(f"{F}c{axis}")],
            confused=(f"camera_tilt_{'y' if axis == 'x' else 'x'}",),
            manoeuvres=VIEWS,
            applies=_looks,
        )
        for axis in "xy"
    ),
    *(
        entry(
            f"camera_k{i}",
            f"The lens's distortion of order {2 * i + 1} is another",
            f"theta_d += theta_k{i} theta^{2 * i + 1}",
            f"rad^-{2 * i}",
            "camera",
            (-10.0 * sd, 10.0 * sd),
            sd,
            0.1 * sd,
            SEEN,
            "Kannala and Brandt 2006, eq. 6",
            [Key(f"{F}k{i}")],
            confused=("camera_focal",),
            manoeuvres=VIEWS,
            applies=_looks,
        )
        for i, sd in ((1, 1e-2), (2, 5e-3), (3, 1e-3), (4, 3e-4))
    ),
    *(
        entry(
            f"camera_tilt_{axis}",
            f"The camera is turned about the body's {axis}",
            "R_bc = R(theta) R_bc0",
            "rad",
            "camera",
            (-0.5, 0.5),
            0.0175,
            6e-4,
            SEEN,
            "screwed on by hand; prior 1 deg, floor as of the markers' rotation",
            [Key("camera.mount.rpy_deg", index=i, factor=float(np.degrees(1.0)))],
            confused=(f"marker_rot_{axis}",),
            manoeuvres=DYNAMICS,
            applies=_looks,
        )
        for i, axis in enumerate("xyz")
    ),
    *(
        entry(
            f"camera_lever_{axis}",
            f"The lens sits elsewhere along {axis}",
            "p_c = R_cb (p_b - r - theta e)",
            "m",
            "camera",
            (-0.2, 0.2),
            0.010,
            2e-3,
            SEEN,
            "measured by hand; prior 10 mm",
            [Key("camera.mount.position_b", index=i)],
            confused=(f"marker_off_{axis}",),
            manoeuvres=VIEWS,
            applies=_looks,
        )
        for i, axis in enumerate("xyz")
    ),
    entry(
        "camera_latency",
        "Keypoints are older than their stamps",
        "y(t) = h(x(t - theta))",
        "s",
        "camera",
        (-1e-3, 0.3),
        0.02,
        2e-4,
        SEEN,
        "Kalibr, Furgale et al. 2013; exposure, transport and detection take 0 to 40 ms",
        [Key("sensing.camera_delay")],
        confused=("mocap_delay_quad",),
        manoeuvres=("rotation about hover",),
        applies=_looks,
        most=lambda s: s.sensing.camera_delay + 1e-3,
    ),
    entry(
        "camera_line_time",
        "Rows of the image are exposed one after the other",
        "t + theta row",
        "s",
        "camera",
        (-1e-4, 1e-4),
        1.5e-5,
        3e-6,
        SEEN,
        "Kalibr; rolling shutters take 0 to 30 us a row",
        [Key("sensing.camera_line_time")],
        confused=("camera_latency",),
        manoeuvres=("rotation about hover",),
        applies=_looks,
    ),
    entry(
        "keypoint_radius",
        "The detector's box is larger or smaller than the ball",
        "limb of a ball of radius r (1 + theta)",
        "1",
        "camera",
        (-0.8, 3.0),
        0.1,
        1e-2,
        SEEN,
        "detectors draw boxes a tenth too wide",
        [Key("camera.payload_radius", scale=True), Key("plant.rope.payload_radius", scale=True)],
        confused=("camera_focal",),
        manoeuvres=VIEWS,
        applies=_looks,
    ),
)
"""Priors are one standard deviation. Floors of tilt and latency are a tenth of a pixel, the latter at 3 rad/s; those of lens and
place what a calibration repeats to."""
