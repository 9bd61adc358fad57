"""Source of keypoints from a real camera's pictures: a folder, a video or a live camera, processed
by one of `camera.detectors`.

Times of recorded pictures are on the clock of the recorded poses, counted from their first arrival.
Only the newest frame that has arrived is processed; a live camera has a separate thread."""

import csv
import math
import sys
import threading
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy import ndarray

from camera.detectors.contours import Detector, DetectorParams, Prior
from camera.detectors.following import BallGoalTracker
from camera.detectors.learnt import LearntDetector
from camera.fisheye import Fisheye
from camera.mount import nominal_rot_cb
from camera.params import CameraParams, FisheyeParams, MountParams
from hil.errors import SourceError
from hil.poses.detection import Detection
from hil.poses.pose import Quaternion, Vector
from visthrow.common.errors import ConfigError, suggest
from visthrow.common.rotations import matrix_of_quat
from visthrow.config.bounds import Bound, Bounded

STAMPS = "stamps.csv"
"""Name of the file of time stamps in a folder of pictures; for a video, the ending of its name. It
has a line ``file,time_s`` (for a video ``frame,time_s``) for each picture.
"""

DETECTORS: dict[str, type[Detector]] = {"contours": Detector, "learnt": LearntDetector}
"""Name -> detector class. A program adds its own before it calls `visthrow.cli.main`."""

# between the lens of the pictures and that of training [m]: directions of near things would differ
# by more than a degree
SAME_PLACE = 0.01


@dataclass(frozen=True)
class ImageParams(Bounded):
    """Parameters of the source of pictures and its camera."""

    kind: Literal["folder", "video", "camera"]
    path: str | None = None  # of the folder or video
    device: int = 0  # number of a live camera
    # from the exposure to the arrival of a picture [s]
    delay: Annotated[float, Bound(0.0, 0.5)] = 0.0
    hold: Annotated[float, Bound(0.0, 0.5, "(]")] = 0.1  # for which a picture is used [s]
    fisheye: FisheyeParams | None = None  # lens of the pictures; None: that of training
    mount: MountParams | None = None  # None: that of training
    detector: DetectorParams = field(default_factory=DetectorParams)
    # of DETECTORS: colour and shape with OpenCV, the learnt networks, or one that a program added
    by: str = "contours"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kind != "camera" and self.path is None:
            raise ConfigError(f"images.path is none; expected the {self.kind} of the pictures")


@dataclass(frozen=True)
class Hint:
    """The runner's estimate at the time of a picture, in our frames."""

    pos_w: Vector  # of the vehicle [m]
    quat: Quaternion  # body to world, xyzw
    ball_distance: tuple[float, float] | None  # of the payload from the lens, while it hangs [m]


class Eyes:
    """A source of detections; ``hint``: the runner's current estimate."""

    hint: Hint | None = None

    def __init__(self, params: ImageParams, training: CameraParams):
        """Set lens and mount of the pictures. Raises `ConfigError`: the detector is unknown, or
        the lens is not where it was in training.
        """
        if params.by not in DETECTORS:
            raise ConfigError(f"images.by '{params.by}'; {suggest(params.by, DETECTORS)}")
        self._params = params
        lens = params.fisheye or training.fisheye
        mount = params.mount or training.mount
        distance = math.dist(mount.position_b, training.mount.position_b)
        if distance > SAME_PLACE:
            raise ConfigError(
                f"images.mount.position_b is {1e3 * distance:.0f} mm from that of training;"
                f" expected {1e3 * SAME_PLACE:g} at most: another lens at the same place can be"
                " converted, another place cannot"
            )
        self.detector = DETECTORS[params.by](
            Fisheye(lens), training.payload_radius, training.goal_side, params.detector
        )
        self._rot_cb = nominal_rot_cb(mount).numpy()
        self._position_b = np.array(mount.position_b)
        # From the camera of the pictures to that of training.
        self._turn = nominal_rot_cb(training.mount).numpy() @ self._rot_cb.T
        self._followed = BallGoalTracker(training.payload_radius, training.goal_side)

    def look(self, picture: ndarray, stamp: float) -> Detection:
        """Detect ball and goal in a picture, BGR, uint8, exposed at a time [s]. Raises
        `SourceError`: the picture has another size.
        """
        prior = Prior()
        rot_wc = None
        hint = self.hint
        if hint is not None:
            rot_wb = matrix_of_quat(np.array(hint.quat))
            rot_wc = rot_wb @ self._rot_cb.T
            eye_w = np.array(hint.pos_w) + rot_wb @ self._position_b
            prior = self._followed.prior(rot_wc, rot_wb[:, 2], eye_w, hint.ball_distance, stamp)
        try:
            frame = self._followed.take(self.detector.detect(picture, prior), rot_wc, stamp)
        except ValueError as error:
            raise SourceError(
                f"{error}: the pictures' size is not that of images.fisheye"
            ) from error
        corners = (
            None
            if frame.goal is None
            else tuple(map(tuple, (frame.goal.rays_c @ self._turn.T).tolist()))
        )
        ball = (
            None
            if frame.ball is None
            else (*(self._turn @ frame.ball.ray_c).tolist(), frame.ball.half_angle)
        )
        return Detection(stamp, corners, ball)

    def poll(self, time: float) -> list[Detection]:
        """Return the detections that have arrived by a time [s]; never waits."""
        raise NotImplementedError

    def close(self) -> None:
        """Close the camera."""


class RecordedImages(Eyes):
    """Pictures of a folder or a video, each processed when the runner's clock reaches its
    arrival.
    """

    def __init__(self, params: ImageParams, training: CameraParams):
        """Read the time stamps. Raises `SourceError`: no pictures, no stamps, or a video that
        cannot be opened.
        """
        super().__init__(params, training)
        self._read, times = (_folder if params.kind == "folder" else _video)(
            Path(params.path or "")
        )
        self._times = [time + params.delay for time in times]
        self._next = 0

    def poll(self, time: float) -> list[Detection]:
        """Return detections that have come, of several pictures the newest; raises `SourceError`
        for one that cannot be read.
        """
        first = self._next
        self._next = bisect_right(self._times, time, self._next)
        if self._next == first:
            return []
        index = self._next - 1
        return [self.look(self._read(index), self._times[index] - self._params.delay)]


class LiveImages(Eyes):
    """A live camera, read and processed in a separate thread; ``failure`` is the error that
    ended it, after which the keypoints go stale.
    """

    def __init__(
        self,
        params: ImageParams,
        training: CameraParams,
        clock: Callable[[], float],
        capture: Any = None,
    ):
        """Open the camera, or take anything with OpenCV's ``read``; raises `SourceError` where
        there is none of this number.
        """
        import cv2

        super().__init__(params, training)
        self._clock = clock
        self._capture = cv2.VideoCapture(params.device) if capture is None else capture
        if not self._capture.isOpened():
            raise SourceError(
                f"camera {params.device} cannot be opened; expected the number of a camera, such"
                " as 0"
            )
        self._newest: Detection | None = None
        self.failure: str | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="camera", daemon=True)
        self._thread.start()

    def _watch(self) -> None:
        try:
            while not self._stop.is_set():
                good, picture = self._capture.read()
                arrival = self._clock()
                if not good:
                    raise SourceError(f"camera {self._params.device} gave no picture")
                self._newest = self.look(picture, arrival - self._params.delay)
        except Exception as error:  # of the driver, or a picture of another size
            self.failure = f"{type(error).__name__}: {error}"
            print(f"camera stopped: {self.failure}", file=sys.stderr, flush=True)

    def poll(self, time: float) -> list[Detection]:
        detection = self._newest
        self._newest = None
        return [] if detection is None else [detection]

    def close(self) -> None:
        self._stop.set()
        self._thread.join(timeout=2.0)
        self._capture.release()


def open_images(params: ImageParams, training: CameraParams, clock: Callable[[], float]) -> Eyes:
    """Open the source of pictures; see the classes for the errors."""
    return (
        LiveImages(params, training, clock)
        if params.kind == "camera"
        else RecordedImages(params, training)
    )


def _folder(path: Path) -> tuple[Callable[[int], ndarray], list[float]]:
    """Return the reader of the pictures of a folder, and their times [s]."""
    rows = _stamps(path / STAMPS, ("file", "time_s"))
    missing = [name for name, _ in rows if not (path / name).is_file()]
    if missing:
        raise SourceError(f"{path / STAMPS} names {missing[0]}, which does not exist")

    def read(index: int) -> ndarray:
        import cv2

        picture = cv2.imread(str(path / rows[index][0]), cv2.IMREAD_COLOR)
        if picture is None:
            raise SourceError(f"{path / rows[index][0]}: not a picture that OpenCV can read")
        return picture

    return read, [time for _, time in rows]


def _video(path: Path) -> tuple[Callable[[int], ndarray], list[float]]:
    """Return the reader of the frames of a video, and their times [s]; by its own rate where no
    stamps stand beside it.
    """
    import cv2

    video = cv2.VideoCapture(str(path))
    if not path.is_file() or not video.isOpened():
        raise SourceError(f"{path}: not a video that OpenCV can open")
    stamps = path.with_suffix(f".{STAMPS}")
    if stamps.is_file():
        times = [time for _, time in _stamps(stamps, ("frame", "time_s"))]
    else:
        rate = video.get(cv2.CAP_PROP_FPS)
        if not rate > 0.0:
            raise SourceError(
                f"{path}: the video states no frame rate; expected one, or {stamps.name} beside it"
            )
        times = [i / rate for i in range(int(video.get(cv2.CAP_PROP_FRAME_COUNT)))]
    position = -1

    def read(index: int) -> ndarray:
        nonlocal position
        good = True
        picture = None
        while position < index and good:  # seeking would land on key frames
            good, picture = video.read()
            position += 1
        if not good or picture is None:
            raise SourceError(f"{path}: frame {index} cannot be read; it has {position}")
        return picture

    return read, times


def _stamps(path: Path, header: tuple[str, str]) -> list[tuple[str, float]]:
    """Return rows of a file of stamps, times ascending; raises `SourceError` where it is missing,
    empty, or not as it must be.
    """
    try:
        rows = list(csv.reader(path.read_text(encoding="utf-8").splitlines()))
        stamps = [(name.strip(), float(time)) for name, time in rows[1:]]
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise SourceError(
            f"{path}: cannot be read: {error}; expected lines of {','.join(header)}"
        ) from error
    times = [time for _, time in stamps]
    if not stamps or [cell.strip() for cell in rows[0]] != list(header) or times != sorted(times):
        raise SourceError(
            f"{path}; expected a first line {','.join(header)}, then a picture a line, times [s]"
            " ascending"
        )
    return stamps
