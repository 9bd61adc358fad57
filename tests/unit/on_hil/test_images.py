"""Pictures as a source of keypoints: the runner flies on detections in a rendered flight, live and
recorded.
"""

import json
import math
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from numpy.linalg import norm
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, fixture, mark, raises

from camera.detectors.contours import BallSeen, Detector, FrameDetections, GoalSeen
from camera.keypoints import KeypointCamera, keypoints
from camera.mount import rotation_from_vector
from camera.params import FisheyeParams
from hil.control.recording.record import lines
from hil.errors import SourceError
from hil.poses.detection import Detection, Detections
from hil.poses.sources.images import (
    DETECTORS,
    STAMPS,
    Eyes,
    Hint,
    ImageParams,
    LiveImages,
    RecordedImages,
)
from tests.commands import run_command
from tests.configs import load_run
from tests.waiting import eventually
from visthrow.common.errors import ConfigError
from visthrow.detector_training.eyes import render_hall

SMALL = FisheyeParams(280, 280, 72.9, 72.9, 139.5, 139.5)
"""The lens of the pictures: the field of view of training's, a fifth of its pixels."""
GOAL = (0.9, 0.1)
PERIOD = 0.05
FRAMES = 4


def training():
    return load_run("dry_run").camera


def pose(i):
    """Vehicle and ball at a picture: pitching forward, the ball swinging."""
    t = PERIOD * i
    pos = np.array([0.05 + 0.2 * t, 0.0, 1.3])
    vector = torch.tensor([[0.02, 0.1 + 0.3 * t, 0.05]], dtype=torch.float64)
    ball = pos + [0.05 - 0.3 * t, 0.03, -0.42]
    return pos, vector, ball


def picture(i) -> np.ndarray:
    """BGR frame of a moment."""
    pos, vector, ball = (torch.as_tensor(part) for part in pose(i))
    camera = replace(training(), fisheye=SMALL)
    return render_hall(camera, pos, rotation_from_vector(vector)[0], ball, torch.tensor(GOAL), 4)


def quaternion(vector) -> tuple[float, ...]:
    v = vector[0].numpy()
    angle = norm(v)
    return (*(v / angle * math.sin(angle / 2)).tolist(), math.cos(angle / 2))


@fixture(scope="module")
def pictures():
    return [picture(i) for i in range(FRAMES)]


class Blind(Detector):
    """A user's detector that reports a ball on the axis in every image."""

    def detect(self, image, prior=None):
        self.check(image)
        return FrameDetections(BallSeen(np.array([0.0, 0.0, 1.0]), 0.1, 1.0), None)


def test_a_custom_detector_is_named_by_the_configuration(pictures, monkeypatch):
    params = ImageParams("camera", fisheye=SMALL, by="blind")
    with raises(ConfigError, match=r"images.by 'blind'; known: contours, learnt"):
        Eyes(params, training())
    monkeypatch.setitem(DETECTORS, "blind", Blind)
    detection = Eyes(params, training()).look(pictures[0], 1.5)
    assert (detection.stamp, detection.corners) == (1.5, None)
    assert detection.ball == approx((0.0, 0.0, 1.0, 0.1))


class Known(Blind):
    """A detector that reports the same ball and square of its camera in every image."""

    corners = np.array(
        [[0.1, 0.1, 1.0], [0.1, -0.1, 1.0], [-0.1, -0.1, 1.0], [-0.1, 0.1, 1.0]]
    ) / np.sqrt(1.02)

    def detect(self, image, prior=None):
        return replace(super().detect(image), goal=GoalSeen(self.corners, 1.0))


def test_what_a_camera_mounted_otherwise_sees_is_given_in_that_of_training(pictures, monkeypatch):
    """Pitched by 30 degrees its axis points forward and down: x of the body is up in the image of
    training.
    """
    monkeypatch.setitem(DETECTORS, "known", Known)
    mount = replace(training().mount, rpy_deg=(0.0, -30.0, 0.0))
    detection = Eyes(
        ImageParams("camera", fisheye=SMALL, mount=mount, by="known"), training()
    ).look(pictures[0], 0.0)
    sine, cosine = 0.5, math.sqrt(0.75)
    assert detection.ball == approx((0.0, -sine, cosine, 0.1))
    turn = np.array([[1.0, 0.0, 0.0], [0.0, cosine, -sine], [0.0, sine, cosine]])
    assert_allclose(detection.corners, Known.corners @ turn.T, atol=1e-12)


@fixture(scope="module")
def folder(tmp_path_factory, pictures):
    """A folder of pictures, and the poses of the same flight as CSV."""
    import cv2

    path = tmp_path_factory.mktemp("flight")
    names = [f"{i:03d}.png" for i in range(FRAMES)]
    for name, frame in zip(names, pictures):
        assert cv2.imwrite(str(path / name), frame)
    (path / STAMPS).write_text(
        "file,time_s\n" + "\n".join(f"{n},{PERIOD * i:.3f}" for i, n in enumerate(names)) + "\n"
    )
    rows = ["t,x,y,z,qx,qy,qz,qw,bx,by,bz"]
    for j in range(5 * FRAMES):
        pos, vector, ball = pose(j / 5)
        rows.append(
            ",".join(
                map(repr, (PERIOD * j / 5, *pos.tolist(), *quaternion(vector), *ball.tolist()))
            )
        )
    (path / "poses.csv").write_text("\n".join(rows) + "\n")
    return path


def params(path: Path, **more) -> ImageParams:
    return replace(ImageParams("folder", str(path), fisheye=SMALL), **more)


def true_keypoints(i):
    pos, vector, ball = pose(i)
    tensors = [torch.tensor(v)[None] for v in (pos, np.array([*GOAL, 0.0]), ball)]
    camera = KeypointCamera(training(), dtype=torch.float64)
    return keypoints(camera, tensors[0], rotation_from_vector(vector), tensors[1], tensors[2])[0][
        0
    ].numpy()


PIXEL = 1.0 / (SMALL.fx * math.radians(110))
"""A pixel of the pictures in normalised coordinates."""
WORST = 1.2 * PIXEL
"""Of any keypoint: the goal is a dozen pixels wide in pictures as small as these."""


def test_pictures_of_another_lens_give_the_keypoints_of_training(folder):
    source = RecordedImages(params(folder), training())
    camera = KeypointCamera(training())
    for i in range(FRAMES):
        pos, vector, _ = pose(i)
        quat = quaternion(vector)
        source.hint = Hint(tuple(pos.tolist()), quat, (0.2, 0.6))
        (detection,) = source.poll(PERIOD * i + 1e-9)
        assert detection.stamp == approx(PERIOD * i)
        again = Detection.of(json.loads(json.dumps(detection.values())))
        assert again == detection
        detections = Detections(camera, 0.1)
        detections.take(detection, quat)
        points, valid = detections.keypoints(detection.stamp)
        assert valid.all()
        assert np.abs(points[0] - true_keypoints(i)).max() < WORST
    assert source.poll(99.0) == []


def test_only_the_newest_of_several_pictures_is_looked_at(folder):
    source = RecordedImages(params(folder, delay=0.03), training())
    assert source.poll(0.02) == [], "it takes its time to arrive"
    (detection,) = source.poll(PERIOD * 2 + 0.031)
    assert detection.stamp == approx(PERIOD * 2)


SQUARE = tuple(
    tuple((np.array([x, y, 1.0]) / math.sqrt(x * x + y * y + 1.0)).tolist())
    for x, y in ((0.1, 0.1), (0.2, 0.1), (0.2, 0.2), (0.1, 0.2))
)
"""Rays to the corners of a goal below the vehicle."""


@mark.parametrize("reads", ["edge", "zero"])
def test_what_is_not_visible_any_more(reads):
    lens = training()
    camera = KeypointCamera(replace(lens, noise=replace(lens.noise, invalid_reads=reads)))
    detections, level = Detections(camera, 0.1), (0.0, 0.0, 0.0, 1.0)
    points, valid = detections.keypoints(0.0)
    assert not valid.any()
    assert not points.any()
    below = Detection(1.0, None, (0.0, 0.1, math.sqrt(0.99), 0.08))
    detections.take(below, level)
    assert detections.keypoints(1.09)[1].tolist() == [[False] * 4 + [True] * 4]
    points, valid = detections.keypoints(1.11)
    assert not valid.any()
    assert not points.any(), "gone from the middle: dropped out"
    ahead = Detection(2.0, None, (0.0, -math.sin(1.75), math.cos(1.75), 0.08))
    detections.take(ahead, level)
    points, valid = detections.keypoints(2.2)
    assert not valid.any()
    assert_allclose(norm(points[0, 4:], axis=-1), 1.0 if reads == "edge" else 0.0, atol=1e-6)
    assert bool((points[0, 4:, 1] < -0.9).all()) == (reads == "edge"), (
        "gone over the upper edge, it reads there by the rule of edges alone"
    )
    detections.take(Detection(3.0, SQUARE, below.ball), level)
    assert detections.keypoints(3.01)[1].all()
    detections.take(Detection(3.02, None, below.ball), level)
    points, valid = detections.keypoints(3.03)
    assert valid.tolist() == [[False] * 4 + [True] * 4], (
        "a goal that a frame lacks has dropped out with it"
    )
    assert not points[0, :4].any()
    detections.take(Detection(1.5, None, ahead.ball), level)
    again, _ = detections.keypoints(3.03)
    assert_array_equal(again, points, "an older frame changes nothing")


def test_a_live_camera_is_read_in_a_separate_thread(pictures):
    class Capture:
        def __init__(self):
            self.frames, self.released = iter(pictures[:2]), False

        def isOpened(self):
            return True

        def read(self):
            frame = next(self.frames, None)
            return frame is not None, frame

        def release(self):
            self.released = True

    capture = Capture()
    eyes = LiveImages(
        ImageParams("camera", fisheye=SMALL, delay=0.02), training(), lambda: 7.0, capture
    )
    eventually(lambda: eyes.failure is not None, 60.0)
    (detection,) = eyes.poll(0.0)
    assert detection.stamp == approx(6.98)
    assert detection.ball is not None
    assert eyes.poll(0.0) == []
    assert "gave no picture" in eyes.failure
    eyes.close()
    assert capture.released


def test_the_runner_flies_on_what_the_detector_saw(folder, tmp_path, capsys, refused, printed):
    """The vision policy's observations hold the detections, and a replay without the pictures gives
    the same actions.
    """
    fisheye = ", ".join(f"{key}={value}" for key, value in asdict(SMALL).items())
    columns = (
        '[{name="pos_w", columns=["x","y","z"], unit="m"}, '
        '{name="quat_wb", columns=["qx","qy","qz","qw"], unit="1", kind="quaternion"}, '
        '{name="payload_pos_w", columns=["bx","by","bz"], unit="m"}]'
    )
    frames = (
        '{axes="x,y,z", body_axes="x,y,z", quaternion="xyzw", yaw_offset_deg=0.0,'
        " marker_offset_b=[0.0, 0.0, 0.0]}"
    )
    settings = (
        "source.kind=csv",
        f"source.file={folder / 'poses.csv'}",
        'source.time={column="t"}',
        f"source.columns={columns}",
        "keypoints=detector",
        f'images={{kind="folder", path="{folder}", fisheye={{{fisheye}}}}}',
        f"frames.vehicle={frames}",
        f"frames.payload={frames}",
        f"goal_w=[{GOAL[0]}, {GOAL[1]}, 0.0]",
        "delay.source=0.0",
    )
    out = tmp_path / "run"
    assert run_command(f"hil record --out {out}", sets=settings) == 0
    ticks = list(lines(out / "ticks.jsonl"))
    looked = [line for line in ticks if line["detection"] is not None]
    assert len(looked) == FRAMES
    for line in looked[1:]:
        index = round(line["detection"][0] / PERIOD)
        assert all(line["valid"])
        off = np.abs(np.array(line["keypoints"]) - true_keypoints(index))
        assert off.max() < WORST
        assert np.array(line["keypoints"]).ravel()[:8].tolist() == line["observation"][20:28], (
            "the goal's part"
        )
    capsys.readouterr()
    (folder / STAMPS).rename(folder / "away")
    try:
        assert "all bit for bit the same" in printed(f"hil replay {out}")
        refused(
            f"hil record --out {tmp_path}/b", sets=settings, message="expected lines of file,time_s"
        )
    finally:
        (folder / "away").rename(folder / STAMPS)


def test_wrong_pictures(folder, tmp_path):
    import cv2

    with raises(SourceError, match="size is not that of images"):
        RecordedImages(params(folder, fisheye=None), training()).poll(1.0)
    mount = replace(training().mount, position_b=(0.07, 0.0, -0.02))
    with raises(ConfigError, match="40 mm from that of training"):
        Eyes(params(folder, mount=mount), training())
    with raises(ConfigError, match=r"images\.path is none"):
        ImageParams("folder")
    with raises(ConfigError, match=r"no table \[images\]"):
        load_run("dry_run", ["keypoints=detector"])
    (tmp_path / STAMPS).write_text("file,time_s\na.png,0.0\n")
    with raises(SourceError, match=r"names a\.png, which does not exist"):
        RecordedImages(params(tmp_path), training())
    (tmp_path / "a.png").write_bytes(b"none")
    with raises(SourceError, match="not a picture that OpenCV can read"):
        RecordedImages(params(tmp_path), training()).poll(1.0)
    (tmp_path / STAMPS).write_text("file,time_s\na.png,1.0\na.png,0.5\n")
    with raises(SourceError, match="ascending"):
        RecordedImages(params(tmp_path), training())
    with raises(SourceError, match="not a video that OpenCV can open"):
        RecordedImages(params(tmp_path / "a.mp4", kind="video"), training())
    assert cv2.imread(str(folder / "000.png")).shape == (280, 280, 3)


def test_a_video_with_stamps_beside_it(folder, pictures, tmp_path):
    import cv2

    path = tmp_path / "flight.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 20.0, (280, 280))
    assert writer.isOpened(), "OpenCV's wheel writes MJPG by itself"
    for frame in pictures:
        writer.write(frame)
    writer.release()
    source = RecordedImages(params(path, kind="video"), training())
    (detection,) = source.poll(PERIOD * 2 + 1e-6)
    assert detection.stamp == approx(PERIOD * 2), "by the video's own rate"
    path.with_suffix(f".{STAMPS}").write_text(
        "frame,time_s\n" + "\n".join(f"{i},{1.0 + i}" for i in range(FRAMES)) + "\n"
    )
    (detection,) = RecordedImages(params(path, kind="video"), training()).poll(3.5)
    assert detection.stamp == approx(3.0)
    assert detection.ball is not None
