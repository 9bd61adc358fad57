"""Calibration files: fields of view, real basalt files, refusals; calibration from drawn boards."""

import json
import math

import numpy as np
import torch
from pytest import approx, mark, raises

from camera.calibrate import boards, files
from camera.calibrate.boards import BoardParams, calibrate_from_boards
from camera.fisheye import Fisheye
from camera.mount import nominal_rot_cb, rotation_from_vector
from camera.params import FisheyeParams, MountParams
from tests.boards import BOARDS, lens_of
from tests.boards import pictures as draw_boards
from tests.lens_files import LENSES, kalibr_text
from tests.places import DATA

BASALT = DATA / "basalt_calib"
FORMATS = {"opencv": "opencv", "kalibr": "kalibr", "ros": "ros file", "basalt": "basalt kb4"}
"""Tools of which every file is tried, with a file of each in `LENSES`."""

FIT_RMS_PX = 1e-3  # measured 5.5e-4 px on the worst of the four cameras over its whole image
FIT_MAX_PX = 0.02  # measured 0.015 px in the corners of the 512 px image, where ds and eucm end
MODELS_AGREE_PX = (
    0.05  # two published models of one camera, calibrated separately: measured 0.011 px in the mean
)


@mark.parametrize("tool", FORMATS)
def test_the_field_of_view_beside_a_lens_is_taken(tmp_path, tool):
    text = LENSES[FORMATS[tool]]["text"]
    path = tmp_path / "lens.yaml"
    if tool == "basalt":
        path.write_text(text.replace('"camera_type"', '"fov_deg": 170.0, "camera_type"'))
    else:
        path.write_text(f"{text.rstrip()}\n{'  ' * (tool == 'kalibr')}fov_deg: 170.0\n")
    named, lens, _ = files.read(path)
    assert tool in named
    assert lens.fov_deg == 170.0


@mark.parametrize("tool", FORMATS)
@mark.parametrize("share", [0.0, 0.1, 0.35, 0.6, 0.8])
def test_a_file_cut_short_is_refused_by_name(tmp_path, tool, share):
    path = tmp_path / "short.yaml"
    text = LENSES[FORMATS[tool]]["text"]
    path.write_text(text[: int(share * len(text))])
    with raises(ValueError, match=path.name):
        files.read(path)


def test_a_missing_file_is_refused(tmp_path):
    with raises(ValueError, match="not a file"):
        files.read(tmp_path / "lens.yaml")


@mark.parametrize(
    ("tool", "old", "new", "message"),
    [
        ("opencv", "camera_matrix:", "lens:", "lacks the key 'camera_matrix'.*'lens'"),
        ("kalibr", "camera_model: pinhole", "camera_model: omni", "intrinsics is.*5 numbers"),
        ("kalibr", "equidistant", "wavy", "'wavy'.*expected one of .'kb4'"),
        ("kalibr", "camera_model: pinhole", "camera_model: cube", "'cube'.*'omni'"),
        ("kalibr", "resolution", "fov_deg: wide\n  resolution", "fov_deg is.*wide"),
        ("ros", "[-0.0132", "[abc", "distortion_coefficients is.*expected some numbers"),
        ("ros", "[191.2", "[.nan", "fx is nan"),
        ("basalt", '"kb4"', '"hyperboloid"', "'hyperboloid'.*eucm.*ds"),
        ("basalt", '"k3"', '"k9"', "lacks the key 'k3'.*k9"),
    ],
)
def test_wrong_content_is_named(tmp_path, tool, old, new, message):
    path = tmp_path / "lens.yaml"
    text = LENSES[FORMATS[tool]]["text"]
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with raises(ValueError, match=message) as caught:
        files.read(path)
    assert path.name in str(caught.value)


def test_a_lens_that_folds_inside_its_field_of_view_is_refused(tmp_path):
    path = tmp_path / "kalibr.yaml"
    folding = FisheyeParams(640, 480, 160.0, 160.0, 320.0, 240.0, k1=-0.3, fov_deg=100.0)
    path.write_text(f"{kalibr_text(folding)}  fov_deg: 200.0\n")
    with raises(ValueError, match=r"kalibr\.yaml: theta_d"):
        files.read(path)


def test_field_of_view_without_the_key(tmp_path):
    path = tmp_path / "kalibr.yaml"
    path.write_text(kalibr_text(FisheyeParams(641, 481, 200.0, 200.0, 320.0, 240.0)))
    # Equidistant: the corner's outer edge, (320.5, 240.5) px from the centre, is seen at its
    # distance / fx.
    expected = 2.0 * math.degrees(math.hypot(320.5, 240.5) / 200.0)
    assert files.read(path)[1].fov_deg == approx(expected, abs=1e-9)
    assert files.read(path, fov_deg=150.0)[1].fov_deg == 150.0


@mark.parametrize("key", ["T_cam_imu", "T_imu_cam"])
def test_the_place_of_the_imu_is_the_mount(tmp_path, key):
    path, expected = tmp_path / "kalibr.yaml", MountParams((0.03, 0.01, -0.02), (3.0, -20.0, 40.0))
    text = LENSES["kalibr"]["text"]
    path.write_text(text)
    assert files.read_mount(path) is None
    matrix = np.eye(4)
    matrix[:3, :3] = nominal_rot_cb(expected).numpy()
    matrix[:3, 3] = -matrix[:3, :3] @ expected.position_b
    matrix = matrix if key == "T_cam_imu" else np.linalg.inv(matrix)
    path.write_text(f"{text}  {key}: {matrix.tolist()}\n")
    mount = files.read_mount(path)
    assert mount.position_b == approx(expected.position_b)
    assert mount.rpy_deg == approx(expected.rpy_deg)
    path.write_text(f"{text}  {key}: {(2.0 * matrix).tolist()}\n")
    with raises(ValueError, match="no rotation"):
        files.read_mount(path)


@mark.parametrize("camera", [0, 1])
@mark.parametrize("name", ["tumvi_512", "euroc"])
def test_real_basalt_files_fit(name, camera):
    lenses = []
    for model in ("ds", "eucm"):
        _, params, report = files.read(BASALT / f"{name}_{model}_calib.json", camera)
        assert report.model == model
        assert report.rms_px < FIT_RMS_PX
        assert report.max_px < FIT_MAX_PX
        lenses.append(Fisheye(params))
    # The two files hold the same camera: an oracle for both unprojections that our own code had no
    # part in.
    p = lenses[0].params
    grid = np.stack(
        np.meshgrid(np.linspace(0, p.width - 1, 40), np.linspace(0, p.height - 1, 40)), -1
    ).reshape(-1, 2)
    rays, visible = lenses[0].unproject(torch.from_numpy(grid))
    pixels, _ = lenses[1].project(rays)
    before = visible & (rays[:, 2] > 0.0)
    assert (pixels - torch.from_numpy(grid)).norm(dim=-1)[before].mean() < MODELS_AGREE_PX


def test_fit_is_not_stretched_past_what_the_image_sees():
    _, params, _ = files.read(BASALT / "euroc_ds_calib.json", fov_deg=190.0)
    assert params.fov_deg == approx(113.9, abs=0.1)
    _, narrower, _ = files.read(BASALT / "tumvi_512_ds_calib.json", fov_deg=180.0)
    assert narrower.fov_deg == 180.0


def test_basalt_refusals(tmp_path):
    with raises(ValueError, match=r"camera 2 was requested; expected a number below 2,"):
        files.read(BASALT / "euroc_ds_calib.json", 2)
    path = tmp_path / "short.json"
    path.write_text((BASALT / "euroc_ds_calib.json").read_text()[:900])
    with raises(ValueError, match=r"short\.json: is not complete YAML .cut short"):
        files.read(path)
    path.write_text(json.dumps([1, 2]))
    with raises(ValueError, match=r"holds no camera of a known tool"):
        files.read(path)


@mark.parametrize(
    ("name", "used", "rms_px", "lens_px"),
    [("chessboard", 8, 0.2, 0.25), ("circles", 5, 0.06, 0.3), ("charuco", 8, 0.4, 0.5)],
)
def test_calibration_from_rendered_boards(name, used, rms_px, lens_px):
    """Bounds leave room above what was measured with sharp edges in small pictures: 0.06, 0.03 and
    0.24 px of the points; within 54 deg lenses that are 0.10, 0.16 and 0.39 px off.
    """
    board, lens = BOARDS[name], Fisheye(lens_of(name))
    blank = np.full((lens.params.height, lens.params.width), 128, np.uint8)
    fisheye, report = calibrate_from_boards([*draw_boards(name), blank], board, fov_deg=160.0)
    assert math.isnan(report.image_rms_px[-1])
    assert np.isfinite(report.image_rms_px).sum() == used
    assert 0.1 * rms_px < report.rms_px < rms_px
    theta = torch.linspace(0.05, 0.95, 20, dtype=torch.float64)
    rays = torch.stack([theta.sin(), torch.zeros_like(theta), theta.cos()], -1)
    rays = torch.cat([rays, rays[:, [1, 0, 2]], -rays * torch.tensor([1.0, 1.0, -1.0])])
    error = (Fisheye(fisheye).project(rays)[0] - lens.project(rays)[0]).norm(dim=-1)
    assert error.max() < lens_px


@mark.parametrize("kind", ["past 90 deg", "past 90 deg, left", "wrong corners", "shifted corners"])
def test_one_board_that_does_not_fit_is_left_out_by_its_number(kind, monkeypatch):
    truth = FisheyeParams(
        640, 640, 191.2, 191.0, 319.6, 321.1, -0.0132, -0.0041, 0.0017, -0.0005, 200.0
    )
    lens, board = Fisheye(truth), BoardParams(7, 5, 0.04)
    rng = np.random.default_rng(0)

    def view(turn, place):
        rot_cb = rotation_from_vector(torch.tensor(turn, dtype=torch.float64)).numpy()
        pixels, _ = lens.project(torch.from_numpy(board.corners_m() @ rot_cb.T + place))
        return boards.View(board.corners_m(), pixels.numpy() + rng.normal(0.0, 0.1, (35, 2)))

    def place():
        return [rng.uniform(-0.4, 0.3), rng.uniform(-0.4, 0.3), rng.uniform(0.25, 0.5)]

    views = [view(rng.normal(0.0, 0.4, 3), place()) for _ in range(15)]
    bad = view([0.0, 1.3, 0.0], [0.35, 0.0, 0.02])  # 117 deg off the axis
    if kind == "past 90 deg, left":
        bad = view([0.0, -1.3, 0.0], [-0.41, 0.0, -0.21])
    elif kind == "wrong corners":
        pixels = views[0].pixels[::-1] + rng.normal(0.0, 30.0, (35, 2))
        bad = boards.View(board.corners_m(), pixels)
    elif kind == "shifted corners":
        bad = boards.View(board.corners_m(), np.roll(views[1].pixels, 7, axis=0))
    monkeypatch.setattr(
        boards, "find_boards", lambda *_: ((640, 640), [*views[:5], bad, *views[5:]])
    )
    fisheye, report = calibrate_from_boards([], board, 190.0)
    assert list(report.left_out) == [5]
    assert math.isnan(report.image_rms_px[5])
    assert fisheye.fx == approx(191.2, abs=0.6)
    assert report.rms_px < 0.2


def test_board_refusals():
    board = BoardParams(8, 6, 0.04)
    grey = np.full((100, 100), 128, np.uint8)
    with raises(ValueError, match="was found in 0 of 2 pictures"):
        calibrate_from_boards([grey, grey], board)
    with raises(ValueError, match="expected one size"):
        calibrate_from_boards([grey, grey[:50]], board)
