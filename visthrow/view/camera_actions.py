"""``visthrow camera calibrate``, ``check`` and ``show``."""

import argparse
import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy import ndarray

from camera.calibrate import BOARD
from camera.calibrate.boards import (
    BoardParams,
    BoardReport,
    calibrate_from_boards,
    check_boards,
    find_board,
    reproject,
)
from camera.calibrate.files import read, read_mount
from camera.calibrate.foreign import HOLDS_PX
from camera.fisheye import Fisheye
from camera.keypoints import KeypointCamera, keypoints
from camera.overlay import draw_overlay
from camera.params import CameraParams, FisheyeParams
from camera.rectify import ViewParams, rectify
from visthrow import config
from visthrow.common.errors import ConfigError
from visthrow.common.extras import load_extra
from visthrow.common.storage import atomic_write

BLUE = (230, 120, 40)
YELLOW = (60, 210, 240)
SAMPLES = 16  # rays for each pixel of a rendered frame

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
# significance level at which a lens's eight parameters fit better than by chance (F test)
SIGNIFICANT = 1e-3


def board_of(words: list[str] | None) -> BoardParams:
    """Parse the words after ``--board``. Raises ConfigError: they do not describe a board."""
    expected = f"--board {BOARD}, for instance: --board chessboard 7 5 0.04"
    if (
        not words
        or len(words) < 4
        or len(words) > 6
        or words[0] not in ("chessboard", "circles", "charuco")
    ):
        raise ConfigError(f"--board {' '.join(words or ['(missing)'])}; expected {expected}")
    try:
        sizes = (int(words[1]), int(words[2]), float(words[3]))
        marker = map(float, words[4:5])
        return BoardParams(*sizes, words[0], *marker, *words[5:])  # type: ignore[arg-type]
    except ValueError as error:
        raise ConfigError(f"--board {' '.join(words)}: {error}; expected {expected}") from error


def pictures_of(names: list[str]) -> tuple[list[Path], list[ndarray]]:
    """Read pictures from files and folders as BGR, uint8, shape (H, W, 3).

    Raises ConfigError: a file is not a picture, or there are no pictures.
    """
    paths: list[Path] = []
    for name in map(Path, names):
        if name.is_dir():
            paths += sorted(p for p in name.iterdir() if p.suffix.lower() in PICTURES)
        else:
            paths.append(name)
    images = [cv2.imread(str(path)) if path.is_file() else None for path in paths]
    for path, image in zip(paths, images, strict=True):
        if image is None:
            raise ConfigError(
                f"{path}: not a picture that can be read; expected one of {', '.join(PICTURES)}"
            )
    if not paths:
        raise ConfigError(
            f"no picture in {', '.join(names)}; expected one of {', '.join(PICTURES)}"
        )
    return paths, images  # type: ignore[return-value]


def calibrate(args: argparse.Namespace) -> int:
    """Calibrate from pictures or convert a calibration file, and write a camera config."""
    out = Path(args.out)
    if out.suffix != ".toml":
        raise ConfigError(
            f"--out {out}; expected a file that ends in .toml, like every configuration"
        )
    like = config.load(CameraParams, config.find("camera", args.like))
    first = Path(args.source[0])
    mount = None
    if args.board or first.is_dir() or first.suffix.lower() in PICTURES:
        board = board_of(args.board)
        paths, images = pictures_of(args.source)
        lens, report = calibrate_from_boards(images, board, args.fov_deg or 180.0)
        notes = (
            f"calibrated on {len(images)} pictures of a {board.pattern}, reprojection error"
            f" {report.rms_px:.3f} px rms"
        )
        print("\n".join(_list_by_picture(paths, report)))
    else:
        if len(args.source) != 1:
            raise ConfigError(
                f"{len(args.source)} calibration files came; expected one (or pictures with"
                " --board)"
            )
        name, lens, fit = read(first, args.camera, args.fov_deg, args.model)
        mount = read_mount(first, args.camera)
        notes = f"from {first.name} ({name})"
        if fit.points:
            notes += (
                f", its {fit.model} model fitted to {fit.rms_px:.4f} px rms, {fit.max_px:.3f} px at"
                f" most over the image, {HOLDS_PX:g} px out to {fit.holds_deg / 2.0:.1f} deg off"
                " the axis"
            )
        else:
            notes += ", the same model: nothing was fitted"
        notes = "; ".join([notes, *fit.remarks])
    note = "Mount, noise and sizes are"
    if mount is not None:
        place = {"position_b": mount.position_b, "rpy_deg": mount.rpy_deg}
        like = dataclasses.replace(like, mount=dataclasses.replace(like.mount, **place))
        notes += "; mount from the IMU's, taken to sit at the centre of mass, x forward, z up"
        note = "Noise and sizes are"
    text = f"# Camera {notes}.\n# {note} those of '{args.like}'; set your own.\n\n"
    params = dataclasses.replace(like, fisheye=lens)
    atomic_write(out, (text + config.dumps(params)).encode())
    print(
        f"{notes}\n{sentence(lens)}\n{out}  train with it: visthrow train vision --set camera={out}"
    )
    return 0


def check(args: argparse.Namespace) -> int:
    """Print reprojection errors and the verdict; return 1 if the lens does not fit."""
    camera = config.load(CameraParams, config.find("camera", args.config))
    board = board_of(args.board)
    paths, images = pictures_of(args.pictures)
    residuals = check_boards(images, board, camera.fisheye)
    _, best = calibrate_from_boards(images, board, camera.fisheye.fov_deg)
    print("\n".join(_list_by_picture(paths, residuals)))
    fits, why = verdict(camera, residuals, best)
    print(
        f"reprojection error {residuals.rms_px:.3f} px rms; of the lens that fits these pictures"
        f" best {best.rms_px:.3f} px\n{why}"
    )
    return 0 if fits else 1


def verdict(camera: CameraParams, report: BoardReport, best: BoardReport) -> tuple[bool, str]:
    """Return whether a configured lens fits pictures of a board, and a sentence with the reason.

    The excess of its reprojection error over that of the best lens is a systematic error. It is
    accepted if it is not significant (F test of eight parameters) or below the bias that training
    draws for each episode (``noise.bias_std``).

    Args:
        camera: the configuration. report: its reprojection errors. best: those of the lens that was
            calibrated on the same pictures.
    """
    from scipy.stats import f

    lens = camera.fisheye
    views = int(np.isfinite(report.image_rms_px).sum())
    freedom = max(2 * report.points - 8 - 6 * views, 1)
    excess = math.sqrt(max(report.rms_px**2 - best.rms_px**2, 0.0))
    noise = best.rms_px * math.sqrt(8.0 * float(f.isf(SIGNIFICANT, 8, freedom)) / freedom)
    learnt = camera.noise.bias_std * math.sqrt(lens.fx * lens.fy) * Fisheye(lens).edge_radius
    limit = max(noise, learnt)
    if learnt >= noise:
        reason = "the bias that training draws (noise.bias_std)"
    else:
        reason = "what noise of the corners explains"
    word = "fits" if excess <= limit else "does NOT fit; calibrate again"
    return (
        excess <= limit,
        (
            f"the configured lens {word}: systematic error {excess:.3f} px, accepted up to"
            f" {limit:.3f} px: {reason}"
        ),
    )


def _list_by_picture(paths: list[Path], report: BoardReport) -> Iterator[str]:
    for i, (path, rms) in enumerate(zip(paths, report.image_rms_px, strict=True)):
        missing = f"left out: {report.left_out[i]}" if i in report.left_out else "no board found"
        yield f"{path.name:24s} " + (missing if math.isnan(rms) else f"{rms:.3f} px")


def sentence(lens: FisheyeParams) -> str:
    k = ", ".join(f"{x:.5g}" for x in lens.coefficients)
    return (
        f"{lens.width} x {lens.height} px, fx {lens.fx:.2f}, fy {lens.fy:.2f}, cx {lens.cx:.2f}, cy"
        f" {lens.cy:.2f} px, k {k}, field of view {lens.fov_deg:.1f} deg"
    )


def show(args: argparse.Namespace) -> int:
    """Write a picture with the projected keypoints and print which of them are in view."""
    out = Path(args.out)
    if out.suffix.lower() not in PICTURES:
        raise ConfigError(f"--out {out}; expected a picture, one of {', '.join(PICTURES)}")
    params = config.load(CameraParams, config.find("camera", args.config))
    if args.hangs + params.payload_radius > args.height:
        raise ConfigError(
            f"--hangs {args.hangs:g} below --height {args.height:g}; expected a payload above the"
            " ground [m]"
        )
    camera = KeypointCamera(params)
    lens = Fisheye(params.fisheye)
    pos_w = torch.tensor([0.0, 0.0, args.height])
    rot_wb = torch.eye(3)
    ball_w = pos_w - torch.tensor([0.0, 0.0, args.hangs])
    goal_w = torch.tensor([*args.target, 0.0])
    if args.picture:
        image = pictures_of([args.picture])[1][0]
    else:
        image = _render(params, pos_w, rot_wb, ball_w, goal_w)
    points, valid = keypoints(camera, pos_w[None], rot_wb[None], goal_w[None], ball_w[None])
    image_out = draw_overlay(camera, points[0], valid[0], image)
    if args.board:
        _draw_board(image_out, image, lens, args)
    pictures = {out: image_out}
    if args.straight:
        pictures[out.with_name(f"{out.stem}_straight{out.suffix}")] = _straight(
            image_out, lens, args.straight
        )
    for path, picture in pictures.items():
        atomic_write(path, cv2.imencode(path.suffix, picture)[1].tobytes())
    visible = valid[0].tolist()
    print(sentence(params.fisheye))
    print(
        f"in view: {sum(visible[:4])} of 4 keypoints of the goal, {sum(visible[4:])} of 4 of the"
        " payload"
    )
    print("\n".join(map(str, pictures)))
    return 0


def _render(params: CameraParams, *places: torch.Tensor) -> ndarray:
    """Render a grey hall with vehicle, ball and goal square as BGR, uint8, shape (H, W, 3)."""
    eyes = load_extra("visthrow.detector_training.eyes", "detector", "a picture", ConfigError)
    return eyes.render_hall(params, *places, samples=SAMPLES)


def _draw_board(canvas: ndarray, image: ndarray, lens: Fisheye, args: argparse.Namespace) -> None:
    board = board_of(args.board)
    view = find_board(image, board)
    if view is None:
        raise ConfigError(
            f"{args.picture or 'the rendered scene'}: no {board.pattern} of {board.columns} x"
            f" {board.rows} points in it"
        )
    expected = reproject(lens, view)
    for pixels, colour, size in ((view.pixels, YELLOW, 5), (expected, BLUE, 2)):
        for u, v in pixels:
            cv2.circle(canvas, (round(u), round(v)), size, colour, 1, cv2.LINE_AA)
    squares = np.sum((expected - view.pixels) ** 2, axis=1)
    off = np.sqrt(np.mean(squares))
    print(f"corners found (yellow) and reprojected (blue): {off:.3f} px rms")


def _straight(canvas: ndarray, lens: Fisheye, fov_deg: float) -> ndarray:
    """Return the rectified view of a drawn picture, BGR, uint8, square."""
    size = min(lens.params.width, lens.params.height)
    frames = torch.from_numpy(canvas).permute(2, 0, 1)[None].float() / 255.0
    flat = rectify(frames, lens, ViewParams(size, size, fov_deg))[0].permute(1, 2, 0)
    return (flat * 255.0).round().to(torch.uint8).numpy()
