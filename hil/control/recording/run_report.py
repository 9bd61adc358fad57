"""Results made from a run's folder when the run is over: flight logs, pictures and the report."""

import importlib.util
from pathlib import Path
from typing import Any

from hil.control.recording.flightlogs import make_log, read, throws
from hil.control.recording.latency import Stages, describe_clock, draw, table
from visthrow.common.errors import VisthrowError
from visthrow.onboard.calibration import Calibration

LATENCY_PICTURE = "latency.png"
WHOLE = "flight.npz"
PICTURE_PACKAGES = ("matplotlib", "cv2")  # of the extra pictures


def summary_text(summary: dict[str, Any], folder: Path) -> str:
    """Return a summary of a run in a few lines."""
    lines = [
        f"{'ABORTED' if summary['aborted'] else 'ended in ' + summary['state']}:"
        f" {summary['reason']}"
    ]
    lines.append(
        f"throws {summary['throws']}, released {summary['latches']}, cancelled"
        f" {summary['cancelled']}"
    )
    if summary.get("calibration"):
        lines.append(f"calibration: {Calibration.of(summary['calibration'])}")
    if summary["stuck"]:
        lines.append(
            f"{summary['stuck']} released payload still hung on the vehicle: look at the mechanism"
        )
    if summary["left_fence"]:
        lines.append(f"after the throw the vehicle left its fence: {summary['left_fence']}")
    for landing in summary["landings"]:
        lines.append(
            f"landing at x {landing['landing_w'][0]:.3f} m, y {landing['landing_w'][1]:+.3f} m by"
            f" the payload's own poses: {landing['error']:.3f} m from the goal,"
            f" {landing['duration']:.2f} s after the throw began"
        )
        if landing["separation"] is not None:
            took = landing["separation"] - landing["latch"]
            lines.append(
                f"it let go {1e3 * took:.0f} ms after the latch; trained with"
                f" {1e3 * landing['lag']:.0f} ms"
            )
    for name, body in summary["bodies"].items():
        refused = ", ".join(f"{n} {why}" for why, n in body["refused"].items()) or "none"
        lines.append(f"{name}: {body['accepted']} poses taken; refused: {refused}")
    for link in summary["links"]:
        if link["refused"]:
            lines.append(
                f"refused on the link: {link['refused']} messages, most often"
                f" {link['refused_most'][0]['what']}"
            )
    ours = summary["missed_ours"]
    lines.append(
        f"ticks {summary['ticks']}, missed {summary['missed']}, {ours} of them by taking too long"
        " ourselves"
    )
    lines += table(summary["latency"], summary.get("speed", 1.0))
    lines += [f"error: {text.strip().splitlines()[-1]}" for text in summary["errors"]]
    return "\n".join([*lines, f"{folder}  the run; `visthrow hil replay {folder}` runs it again"])


def throw_path(folder: Path, number: int, ending: str) -> Path:
    """Return the path of a throw's file; throws are counted from 1."""
    return folder / f"throw-{number:02d}{ending}"


def finish(folder: str | Path, stages: Stages | None = None, speed: float = 1.0) -> list[str]:
    """Write the latency picture, and a flight log and picture for each throw, or one log of the
    whole run; return lines that list the files.
    """
    from visthrow.view import strip

    folder = Path(folder)
    lines = []
    missing = [name for name in PICTURE_PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        lines.append(
            f"no pictures without {' and '.join(missing)}: pip install 'visthrow[pictures]'"
        )
    try:
        if stages is not None and not missing:
            draw(
                folder / LATENCY_PICTURE,
                stages,
                f"Times of each stage, run {folder.name}{describe_clock(speed)}",
            )
            lines.append(f"{folder / LATENCY_PICTURE}  times of each stage")
        played = read(folder)
        if not played.throws:
            make_log(played).save(folder / WHOLE)
            lines.append(f"{folder / WHOLE}  flight log of the whole run")
        for number, log in enumerate(throws(played), start=1):
            path = throw_path(folder, number, ".npz")
            log.save(path)
            result = log.meta["result"]
            how = f"no landing counted: {result['failure']}"
            if result["success"]:
                how = f"{result['error']:.3f} m from the goal after {result['duration']:.2f} s"
            lines.append(f"{path}  throw {number}: {how}")
            if "landing" in log and not missing:
                strip.draw(throw_path(folder, number, ".png"), log, played.playback.params.camera)
    except VisthrowError as error:
        lines.append(f"not all could be written: {error}")
    return lines
