"""``visthrow camera``: a config from every kind of calibration, which then trains and flies;
whether a lens fits its pictures.
"""

import re

import cv2
import numpy as np
import torch
from pytest import fixture, mark

from camera.calibrate.boards import BoardParams
from camera.calibrate.files import read
from camera.fisheye import Fisheye
from camera.mount import rotation_from_vector
from camera.params import FisheyeParams
from tests import lens_files
from tests.commands import run_command
from tests.drawn import pixel_rays
from visthrow.cli import main

LENS = FisheyeParams(320, 320, 96.0, 97.0, 161.0, 157.0, 0.01, -0.004, fov_deg=190.0)
LARGE = FisheyeParams(640, 640, 192.0, 194.0, 322.5, 314.5, 0.01, -0.004, fov_deg=190.0)
"""The same lens over twice the pixels: a ChArUco marker needs some."""
BOARDS = {
    "chessboard": BoardParams(7, 5, 0.04),
    "circles": BoardParams(7, 5, 0.04, "circles"),
    "charuco": BoardParams(7, 5, 0.04, "charuco", 0.03),
}
WRITERS = {
    name: getattr(lens_files, f"write_{name}") for name in ("opencv", "kalibr", "ros", "basalt")
}

OCAM = """#polynomial coefficients for the DIRECT mapping function (ocam_model.ss), for cam2world

5 -2.065170e+02 0.000000e+00 2.207161e-03 -4.879622e-06 1.865656e-08

#polynomial coefficients for the inverse mapping function (ocam_model.invpol). world2cam

12 294.182260 152.289570 -12.191217 27.959546 8.241525 -1.970397 10.689256 1.871609 -6.437684 \
0.430037 3.215544 0.921484

#center: "row" and "column", starting from 0 (C convention)

241.800066 394.552874

#affine parameters "c", "d", "e"

1.000330 0.000219 0.000257

#image size: "height" and "width"

480 752
"""
"""A published calibration of a 752 x 480 px fisheye by the toolbox itself (README of OCamCalib's
C++ port for VI-SLAM).
"""
# measured 0.28 px at most: the file's own two polynomials differ by as much, and our model has no
# shear
OCAM_PX = 0.5


def texture(board: BoardParams, scale: int) -> tuple[np.ndarray, float]:
    """A printed board, grey, ``scale`` pixels a square, and where its first point lies in it
    [squares].
    """
    if board.pattern == "charuco":
        return (
            board.charuco().generateImage((scale * (board.columns + 1), scale * (board.rows + 1))),
            1.0,
        )
    page = np.full((scale * (board.rows + 1), scale * (board.columns + 1)), 255, np.uint8)
    for j in range(board.rows + 1):
        for i in range(board.columns + 1):
            if board.pattern == "circles" and i < board.columns and j < board.rows:
                cv2.circle(page, ((i + 1) * scale, (j + 1) * scale), scale // 4, 0, -1, cv2.LINE_AA)
            elif board.pattern == "chessboard" and (i + j) % 2:
                page[j * scale : (j + 1) * scale, i * scale : (i + 1) * scale] = 0
    return page, 1.0


def pictures(board: BoardParams, lens: Fisheye) -> list[np.ndarray]:
    """Pictures of a board in eight poses, shape (H, W) of the lens."""
    tilts = [
        (0.1, 0.2, 0.0),
        (-0.5, 0.3, 0.2),
        (0.4, -0.5, -0.3),
        (0.4, 0.3, 0.1),
        (0.6, 0.1, 0.4),
        (-0.3, -0.6, 0.5),
        (0.0, 0.0, 0.7),
        (0.5, 0.5, 0.2),
    ]
    places = [
        (0.0, 0.0),
        (0.13, 0.1),
        (-0.14, 0.1),
        (-0.16, -0.1),
        (0.12, -0.13),
        (0.0, 0.14),
        (0.0, -0.14),
        (0.05, 0.0),
    ]
    samples, scale = 3, 60
    page, first = texture(board, scale)
    page = cv2.copyMakeBorder(page, scale, scale, scale, scale, cv2.BORDER_CONSTANT, value=255)
    rays, seen = pixel_rays(lens, samples)
    found = []
    for tilt, place in zip(tilts, places, strict=True):
        rot_cm = rotation_from_vector(torch.tensor(tilt, dtype=torch.float64))
        origin = torch.tensor([*place, 0.18], dtype=torch.float64) - rot_cm @ torch.from_numpy(
            board.corners_m().mean(0)
        )
        normal = rot_cm[:, 2]
        depth = (normal @ origin) / (rays @ normal)
        on_board = (rays * depth[..., None] - origin) @ rot_cm / board.square_size
        u, v = ((on_board[..., i] + first + 1.0) * scale - 0.5 for i in (0, 1))
        inside = (seen & (depth > 0.0)).numpy()
        drawn = cv2.remap(
            page,
            u.float().numpy(),
            v.float().numpy(),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=110,
        )
        drawn = np.where(inside, drawn, 0).astype(np.float32)
        mean = drawn.reshape(lens.params.height, samples, lens.params.width, samples).mean((1, 3))
        found.append(np.round(mean).astype(np.uint8))
    return found


@fixture(scope="module")
def boards(tmp_path_factory):
    """Give the folder of pictures of a kind of board, drawn when asked for."""
    root = tmp_path_factory.mktemp("boards")

    def folder(name: str):
        if not (root / name).exists():
            (root / name).mkdir()
            for i, image in enumerate(
                pictures(BOARDS[name], Fisheye(LARGE if name == "charuco" else LENS))
            ):
                cv2.imwrite(str(root / name / f"{i}.png"), image)
        return root / name

    return folder


def words(board: BoardParams) -> list[str]:
    marker = [str(board.marker_size)] if board.marker_size else []
    return [
        "--board",
        board.pattern,
        str(board.columns),
        str(board.rows),
        str(board.square_size),
        *marker,
    ]


def calibration(kind: str, folder, boards) -> list[str]:
    """Words after ``visthrow camera calibrate`` for a source of a kind."""
    if kind in BOARDS:
        return [str(boards(kind)), *words(BOARDS[kind]), "--fov-deg", "190"]
    path = folder / f"{kind}.calibration"
    if kind == "ocam":
        path.write_text(OCAM)
        return [str(path), "--fov-deg", "200"]
    WRITERS[kind](path.with_suffix(".json" if kind == "basalt" else ".yaml"), LENS)
    return [str(path.with_suffix(".json" if kind == "basalt" else ".yaml"))]


SLOW = {"opencv", "ros", "basalt", "ocam", "circles", "charuco"}
"""Kinds whose config trains and flies in the slow run alone; kalibr and chessboard do by default.
"""


def test_check_tells_a_lens_that_fits_from_one_that_does_not(tmp_path, boards, capsys):
    right = tmp_path / "kalibr.yaml"
    lens_files.write_kalibr(right, LENS)
    assert run_command(f"camera calibrate {right} --out {tmp_path}/right.toml") == 0
    asked = [str(boards("chessboard")), *words(BOARDS["chessboard"])]
    assert run_command(f"camera check {tmp_path}/right.toml", *asked) == 0
    said = capsys.readouterr().out
    assert "the configured lens fits" in said
    text = (tmp_path / "right.toml").read_text()
    (tmp_path / "wrong.toml").write_text(text.replace("fx = 96.0", "fx = 99.0"))
    assert run_command(f"camera check {tmp_path}/wrong.toml", *asked) == 1
    assert "does NOT fit" in capsys.readouterr().out
    assert run_command("camera check fisheye", *asked) == 2
    assert "320 x 320 px came; expected 640 x 640" in capsys.readouterr().err


def test_show_draws_corners_keypoints_and_a_straight_view(tmp_path, boards, capsys):
    lens_files.write_ros(tmp_path / "ros.yaml", LENS)
    camera, out = tmp_path / "camera.toml", tmp_path / "seen.png"
    assert run_command(f"camera calibrate {tmp_path}/ros.yaml --out {camera}") == 0
    frame = str(boards("chessboard") / "0.png")
    assert (
        run_command(
            f"camera show {camera} {frame} --straight 100 --out {out}", *words(BOARDS["chessboard"])
        )
        == 0
    )
    said = capsys.readouterr().out
    assert "4 of 4 keypoints of the goal, 4 of 4 of the payload" in said
    assert float(said.split("(blue): ")[1].split()[0]) < 0.2
    before, after = cv2.imread(frame), cv2.imread(str(out))
    coloured = np.ptp(after.astype(int), axis=-1) > 60
    assert coloured.sum() > 35 * 8, (
        "35 corners and the keypoints are drawn in colour on a grey picture"
    )
    assert np.ptp(before.astype(int), axis=-1).max() == 0
    assert cv2.imread(str(tmp_path / "seen_straight.png")).shape == (320, 320, 3)


def test_a_payload_below_the_ground_is_not_drawn(tmp_path, capsys):
    assert run_command(f"camera show fisheye --hangs 1.4 --out {tmp_path}/a.png") == 2
    assert (
        "--hangs 1.4 below --height 1.333; expected a payload above the ground"
        in capsys.readouterr().err
    )
    assert not (tmp_path / "a.png").exists()


def test_ocam_agrees_with_its_own_inverse_polynomial(tmp_path):
    """world2cam of the toolbox, which the reader does not use, is the oracle."""
    path = tmp_path / "calib_results.txt"
    path.write_text(OCAM)
    name, lens, _ = read(path)
    assert name == "ocam"
    inverse = np.array([float(x) for x in OCAM.splitlines()[6].split()[1:]])
    theta, turn = (
        x.ravel() for x in np.meshgrid(np.radians(np.linspace(5, 85, 17)), np.linspace(0, 6, 12))
    )
    down, right, ahead = np.sin(theta) * np.sin(turn), np.sin(theta) * np.cos(turn), np.cos(theta)
    rho = np.polyval(inverse[::-1], np.arctan2(-ahead, np.hypot(down, right))) / np.hypot(
        down, right
    )
    row = 241.800066 + 1.000330 * rho * down + 0.000219 * rho * right
    column = 394.552874 + 0.000257 * rho * down + rho * right
    pixels = (
        Fisheye(lens).project(torch.from_numpy(np.column_stack([right, down, ahead])))[0].numpy()
    )
    assert np.hypot(pixels[:, 0] - column, pixels[:, 1] - row).max() < OCAM_PX


@mark.parametrize("kind", [*WRITERS, "ocam"])
def test_the_tool_is_told_from_the_text(kind, tmp_path):
    assert kind in read(calibration(kind, tmp_path, None)[0])[0]


@mark.parametrize(
    ("words", "message"),
    [
        (
            ["{notes}", "--out", "{out}"],
            "no camera of a known tool; expected one of basalt, kalibr, camodocal, svo",
        ),
        (["{ocam}", "--out", "{out}"], "lines of numbers.*expected five"),
        (["{folder}", "--out", "{out}"], r"--board \(missing\); expected --board chessboard"),
        (
            ["{folder}", "--board", "charuco", "7", "5", "0.04", "--out", "{out}"],
            "marker of 0.0 m; expected a side above 0",
        ),
        (
            ["{folder}", "--board", "chessboard", "7", "5", "0.04", "--out", "{out}"],
            "no picture in",
        ),
        (["{ocam}", "--out", "{notes}"], r"notes\.txt; expected a file that ends in \.toml"),
    ],
)
def test_wrong_input_is_named(words, message, tmp_path, capsys):
    notes, ocam, folder = tmp_path / "notes.txt", tmp_path / "ocam.txt", tmp_path / "none"
    notes.write_text("not a calibration\n")
    ocam.write_text("\n".join(OCAM.splitlines()[:8]))
    folder.mkdir()
    filled = [
        w.format(notes=notes, ocam=ocam, folder=folder, out=tmp_path / "c.toml") for w in words
    ]
    assert main(["camera", "calibrate", *filled]) == 2
    assert re.search(message, capsys.readouterr().err)
    assert notes.read_text() == "not a calibration\n"
