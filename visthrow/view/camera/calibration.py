"""``visthrow camera calibrate`` and ``check``."""

import argparse
import dataclasses
import math
from pathlib import Path

import numpy as np

from camera.calibrate.boards import BoardParams, BoardReport, calibrate_from_boards, check_boards
from camera.calibrate.formats import read
from camera.fisheye import Fisheye
from camera.params import CameraParams, FisheyeParams
from visthrow import config
from visthrow.common.errors import ConfigError
from visthrow.common.storage import atomic_write
from visthrow.view.camera import BOARD

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
SIGNIFICANT = 1e-3
"""Chance at which a better fit by the eight free numbers of a lens counts as noise (F test)."""


def board_of(words: list[str] | None) -> BoardParams:
    """Board of the words after ``--board``; ConfigError where they name none."""
    expected = f"--board {BOARD}, for instance: --board chessboard 7 5 0.04"
    if not words or len(words) < 4 or len(words) > 6 or words[0] not in ("chessboard", "circles", "charuco"):
        raise ConfigError(f"--board {' '.join(words or ['(missing)'])}; expected {expected}")
    try:
        return BoardParams(int(words[1]), int(words[2]), float(words[3]), words[0], *map(float, words[4:5]), *words[5:])  # type: ignore[arg-type]
    except ValueError as error:
        raise ConfigError(f"--board {' '.join(words)}: {error}; expected {expected}") from error


def pictures_of(names: list[str]) -> tuple[list[Path], list[np.ndarray]]:
    """Read pictures, and those of folders, as BGR, uint8, shape (H, W, 3); ConfigError where a file is none, or there is none."""
    import cv2

    paths: list[Path] = []
    for name in map(Path, names):
        paths += sorted(p for p in name.iterdir() if p.suffix.lower() in PICTURES) if name.is_dir() else [name]
    images = [cv2.imread(str(path)) if path.is_file() else None for path in paths]
    for path, image in zip(paths, images, strict=True):
        if image is None:
            raise ConfigError(f"{path}: not a picture that can be read; expected one of {', '.join(PICTURES)}")
    if not paths:
        raise ConfigError(f"no picture in {', '.join(names)}; expected one of {', '.join(PICTURES)}")
    return paths, images  # type: ignore[return-value]


def calibrate(args: argparse.Namespace) -> int:
    """Write a camera config."""
    like = config.load(CameraParams, config.find("camera", args.like))
    first = Path(args.source[0])
    if args.board or first.is_dir() or first.suffix.lower() in PICTURES:
        board = board_of(args.board)
        paths, images = pictures_of(args.source)
        lens, report = calibrate_from_boards(images, board, args.fov_deg or 180.0)
        said = f"calibrated on {len(images)} pictures of a {board.pattern}, reprojection error {report.rms_px:.3f} px rms"
        print("\n".join(_by_picture(paths, report)))
    else:
        if len(args.source) != 1:
            raise ConfigError(f"{len(args.source)} calibration files came; expected one (or pictures with --board)")
        name, lens, fit = read(first, args.format, args.camera, args.fov_deg)
        said = f"from {first.name} ({name})"
        if fit.points:
            said += f", its {fit.model} model fitted to {fit.rms_px:.4f} px rms, {fit.max_px:.3f} px at most over the image"
        else:
            said += ", the same model: nothing was fitted"
    text = f"# Camera {said}.\n# Mount, noise and sizes are those of '{args.like}'; set your own.\n\n"
    params = dataclasses.replace(like, fisheye=lens)
    out = Path(args.out)
    atomic_write(out, (text + config.dumps(params)).encode())
    print(f"{said}\n{sentence(lens)}\n{out}  train with it: visthrow train vision --set camera={out}")
    return 0


def check(args: argparse.Namespace) -> int:
    """Print reprojection errors and the verdict; 1 where the lens does not fit."""
    camera = config.load(CameraParams, config.find("camera", args.config))
    board = board_of(args.board)
    paths, images = pictures_of(args.pictures)
    given = check_boards(images, board, camera.fisheye)
    _, best = calibrate_from_boards(images, board, camera.fisheye.fov_deg)
    print("\n".join(_by_picture(paths, given)))
    fits, why = verdict(camera, given, best)
    print(f"reprojection error {given.rms_px:.3f} px rms; of the lens that fits these pictures best {best.rms_px:.3f} px\n{why}")
    return 0 if fits else 1


def verdict(camera: CameraParams, given: BoardReport, best: BoardReport) -> tuple[bool, str]:
    """Tell whether a configured lens fits pictures of a board.

    What the configured lens leaves beyond the best lens is a systematic error. It is accepted where it is not significant
    (F test of eight free numbers), or below the bias that training draws for each episode (``noise.bias_std``).

    Args:
        camera: the configuration. given: its reprojection errors. best: those of the lens calibrated on the same pictures.
    """
    from scipy.stats import f

    lens = camera.fisheye
    views = int(np.isfinite(given.image_rms_px).sum())
    left = max(2 * given.points - 8 - 6 * views, 1)
    excess = math.sqrt(max(given.rms_px**2 - best.rms_px**2, 0.0))
    noise = best.rms_px * math.sqrt(8.0 * float(f.isf(SIGNIFICANT, 8, left)) / left)
    learnt = camera.noise.bias_std * math.sqrt(lens.fx * lens.fy) * Fisheye(lens).edge_radius
    limit = max(noise, learnt)
    reason = "the bias that training draws (noise.bias_std)" if learnt >= noise else "what noise of the corners explains"
    word = "fits" if excess <= limit else "does NOT fit; calibrate anew"
    return excess <= limit, f"the configured lens {word}: systematic error {excess:.3f} px, accepted up to {limit:.3f} px: {reason}"


def _by_picture(paths: list[Path], report: BoardReport) -> list[str]:
    lines = zip(paths, report.image_rms_px, strict=True)
    return [f"{path.name:24s} " + ("no board found" if math.isnan(rms) else f"{rms:.3f} px") for path, rms in lines]


def sentence(lens: FisheyeParams) -> str:
    k = ", ".join(f"{x:.5g}" for x in lens.coefficients)
    return (
        f"{lens.width} x {lens.height} px, fx {lens.fx:.2f}, fy {lens.fy:.2f}, cx {lens.cx:.2f}, cy {lens.cy:.2f} px, "
        f"k {k}, field of view {lens.fov_deg:.1f} deg"
    )
