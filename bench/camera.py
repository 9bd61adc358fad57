"""The camera: keypoints of many environments against kornia's and OpenCV's fisheye projection."""

import argparse
import math
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from bench import start
from bench.common_options import add_common
from bench.report import Report, Table, device_name, finish, rate
from bench.sim import pin_to_one_core
from camera.keypoints import KEYPOINTS, KeypointCamera, keypoints
from camera.mount import points_c_from_w
from visthrow import config
from visthrow.common.errors import VisthrowError

STRETCH = 0.2  # [s], wall time of one measurement, about
SAFE_ANGLE = math.radians(85.0)
"""Up to here [rad, off the axis] kornia and OpenCV are right and well conditioned: accuracy is
compared there.
"""


class Views:
    """Random views: vehicles up to 60 deg tilted and 1 to 2 m high, goals within 2.5 m, balls a
    rope's length away.
    """

    def __init__(self, params: Any, count: int, device: str, seed: int = 0):
        draw = torch.Generator().manual_seed(seed)

        def uniform(*shape: int, low: float = -1.0, high: float = 1.0) -> torch.Tensor:
            return low + (high - low) * torch.rand(*shape, generator=draw)

        def convert(x: torch.Tensor) -> torch.Tensor:
            return x.to(device=device, dtype=torch.float32)

        axis = torch.nn.functional.normalize(uniform(count, 3), dim=-1)
        skew = torch.linalg.cross(
            torch.eye(3).expand(count, 3, 3), axis[:, None].expand(count, 3, 3), dim=-1
        )
        angle = uniform(count, 1, 1, high=math.radians(60.0), low=0.0)
        rope = torch.nn.functional.normalize(
            uniform(count, 3) - torch.tensor([0.0, 0.0, 1.0]), dim=-1
        )
        pos_w = uniform(count, 3) * torch.tensor([0.5, 0.5, 0.5]) + torch.tensor([0.0, 0.0, 1.5])
        self.camera = KeypointCamera(params, device)
        self.pos_w = convert(pos_w)
        self.rot_wb = convert(torch.linalg.matrix_exp(angle * skew))
        self.goal_w = convert(uniform(count, 2) * 2.5)
        self.payload_w = convert(pos_w + 0.38 * rope)
        corners = self.goal_w.new_zeros(count, 4, 3)
        corners[..., :2] = self.goal_w[:, None]
        around = torch.cat(
            [corners + self.camera.square_w, self.payload_w[:, None].expand(-1, 4, -1)], 1
        )
        self.points_c = points_c_from_w(
            around, self.pos_w, self.rot_wb, self.camera.rot_cb, self.camera.position_b
        ).contiguous()

    def keypoints(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Our whole computation: frames, ball's outline, projection, box, validity."""
        return keypoints(self.camera, self.pos_w, self.rot_wb, self.goal_w, self.payload_w)


def ours(points_c: torch.Tensor, fisheye: Any) -> torch.Tensor:
    """Our projection alone, pixels."""
    return fisheye.project(points_c)[0]


def kornia_projection(points_c: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """kornia's projection, pixels, shape (E, K, 2)."""
    from kornia.geometry.camera import distort_points_kannala_brandt

    return distort_points_kannala_brandt(points_c[..., :2] / points_c[..., 2:], values)


def opencv_projection(
    points_c: np.ndarray, matrix: np.ndarray, coefficients: np.ndarray
) -> np.ndarray:
    """OpenCV's projection, pixels, shape (E K, 1, 2)."""
    import cv2

    still = np.zeros(3)
    return cv2.fisheye.projectPoints(
        points_c.reshape(-1, 1, 3), still, still, matrix, coefficients
    )[0]


def intrinsics(f: Any) -> tuple[list[float], np.ndarray, np.ndarray]:
    """kornia's parameter row, OpenCV's camera matrix and coefficients."""
    matrix = np.array([[f.fx, 0.0, f.cx], [0.0, f.fy, f.cy], [0.0, 0.0, 1.0]])
    return [f.fx, f.fy, f.cx, f.cy, *f.coefficients], matrix, np.array(f.coefficients)


def median_time(
    function: Callable[[], Any], device: str, repeats: int, stretch: float = STRETCH
) -> float:
    """Median wall time of a call [s]."""

    def stretch_of(calls: int) -> float:
        _settle(device)
        start = time.perf_counter()
        for _ in range(calls):
            function()
        _settle(device)
        return (time.perf_counter() - start) / calls

    stretch_of(3)
    calls = max(1, int(stretch / stretch_of(3)))
    return statistics.median(stretch_of(calls) for _ in range(repeats))


def _settle(device: str) -> None:
    if device.startswith("cuda"):
        torch.cuda.synchronize(device)


def capture_graph(function: Callable[[], Any], device: str) -> Callable[[], None]:
    """The function from a CUDA graph, as training replays it."""
    with torch.cuda.device(device):
        function()
        torch.cuda.synchronize()
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            function()
    return graph.replay


def time_on_device(
    params: Any, count: int, device: str, repeats: int, stretch: float = STRETCH
) -> dict[str, float]:
    """Seconds a call of each contender that runs on a device."""
    views = Views(params, count, device)
    row, matrix, coefficients = intrinsics(params.fisheye)
    values = torch.tensor(row, device=device)[None, None]
    calls: dict[str, Callable[[], Any]] = {"keypoints": views.keypoints}
    if device.startswith("cuda"):
        calls["keypoints, CUDA graph"] = capture_graph(views.keypoints, device)
    calls["projection alone"] = lambda: ours(views.points_c, views.camera.fisheye)
    calls["kornia"] = lambda: kornia_projection(views.points_c, values)
    if device.startswith("cuda"):
        calls["kornia, CUDA graph"] = capture_graph(calls["kornia"], device)
    if device == "cpu":
        points = views.points_c.numpy()
        calls["OpenCV"] = lambda: opencv_projection(points, matrix, coefficients)
    with torch.inference_mode():
        return {name: median_time(call, device, repeats, stretch) for name, call in calls.items()}


def accuracy(params: Any, count: int) -> dict[str, float]:
    """Largest distance [px] from kornia and OpenCV in float64 up to ``SAFE_ANGLE``; share of points
    past 90 deg.
    """
    points = Views(params, count, "cpu").points_c.double().reshape(-1, 3)
    angle = torch.atan2(points[:, :2].norm(dim=-1), points[:, 2])
    safe = points[angle < SAFE_ANGLE][None]
    row, matrix, coefficients = intrinsics(params.fisheye)
    from camera.fisheye import Fisheye

    mine = ours(safe, Fisheye(params.fisheye))
    theirs = kornia_projection(safe, torch.tensor(row, dtype=torch.float64)[None, None])
    cv = torch.from_numpy(opencv_projection(safe.numpy(), matrix, coefficients)).reshape(1, -1, 2)
    return {
        "kornia_px": float((mine - theirs).abs().max()),
        "opencv_px": float((mine - cv).abs().max()),
        "past_90_deg": float((angle > math.pi / 2).double().mean()),
    }


def run(args: argparse.Namespace) -> int:
    """Measure the camera."""
    if args.environments < 1 or args.repeats < 1:
        raise VisthrowError(
            f"--environments {args.environments}, --repeats {args.repeats}: expected positive"
            " numbers"
        )
    from camera.params import CameraParams
    from visthrow.common.compute_device import resolve

    params = config.load(CameraParams, config.find("camera", "fisheye"), args.overrides)
    return finish(measure(params, args.environments, resolve(args.device), args.repeats), args)


def measure(params: Any, count: int, device: str, repeats: int, stretch: float = STRETCH) -> Report:
    """Measure on one CPU core, and on the GPU if that is the device, and report."""
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        with pin_to_one_core():
            import cv2

            cv2.setNumThreads(1)
            times = {"cpu": time_on_device(params, count, "cpu", repeats, stretch)}
    finally:
        torch.set_num_threads(threads)
    if device != "cpu":
        times[device] = time_on_device(params, count, device, repeats, stretch)
    exact = accuracy(params, min(count, 4096))
    header = ("what", "time", "points/s", "time over our keypoints")
    tables = []
    for place, row in times.items():
        baseline = row.get("keypoints, CUDA graph", row["keypoints"])
        cells = tuple(
            (
                _LABELS[n],
                f"{t * 1e3:.3f} ms",
                f"{rate(count * KEYPOINTS / t)}",
                f"{t / baseline:.2f}",
            )
            for n, t in row.items()
        )
        where = "one CPU core" if place == "cpu" else device_name(place)
        tables.append(
            Table(f"{count:,} environments, {count * KEYPOINTS:,} points, {where}", header, cells)
        )
    notes = (
        (
            "Keypoints are the whole function of the training environment: frames, the ball's"
            " outline, projection, its box and validity. The other rows only project as many ready"
            " points. float32, medians."
        ),
        (
            f"In float64 our pixels differ from kornia's by at most {exact['kornia_px']:.1e} px and"
            f" from OpenCV's by {exact['opencv_px']:.1e} px below {math.degrees(SAFE_ANGLE):.0f}"
            f" deg off the axis. {100 * exact['past_90_deg']:.0f} % of these points lie past 90"
            " deg, where both mirror them into the image without a flag; ours projects them."
        ),
    )
    figures = {
        "environments": count,
        "points": count * KEYPOINTS,
        "seconds": times,
        "accuracy": exact,
        "repeats": repeats,
    }
    return Report("camera", f"Keypoints of {count:,} environments", tuple(tables), notes, figures)


_LABELS = {
    "keypoints": "visthrow, keypoints",
    "keypoints, CUDA graph": "visthrow, keypoints, CUDA graph",
    "projection alone": "visthrow, projection alone",
    "kornia": "kornia, projection alone",
    "kornia, CUDA graph": "kornia, projection alone, CUDA graph",
    "OpenCV": "OpenCV, projection alone",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = start.parser_of(__doc__)
    parser.add_argument(
        "--environments", type=int, default=16384, metavar="N", help="batch size (default: 16384)"
    )
    parser.add_argument(
        "--repeats",
        type=int,
        default=5,
        metavar="N",
        help="measurements; the median counts (default: 5)",
    )
    add_common(parser, json=False)
    return start.main(parser, run, argv)


if __name__ == "__main__":
    sys.exit(main())
