"""What `hil check --against-camera` prints, writes and draws."""

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from hil.errors import RunError
from hil.params import HilParams
from hil.recording import camera_log as log
from hil.recording.camera_log import CameraLog, CameraLogParams, Mounting, OffsetProfile
from visthrow.common.storage import atomic_write, write_json

BEST = "camera turned, rows offset"
DATA, PICTURE = "against_camera.json", "against_camera.png"


def against_camera(params: HilParams, files: Sequence[str], out: str | Path) -> dict[str, Any]:
    """Fit the mounting on the first recording, judge it on the others, and write figures and a picture.

    Args:
        params: with a table ``against``.
        files: CSV recordings; one alone is halved.
        out: folder for the results.

    Returns:
        The figures, as they are written.

    Raises:
        RunError: the config says nothing of a camera's log.
        SourceError: a file cannot be read.
    """
    if params.against is None:
        raise RunError("this config has no table [against] for a camera's log; configs/hil/slungload_log.toml has one")
    logs = [log.read_log(file, params.against, params.source.columns, params.frames) for file in files]
    fitted, held_out = log.split(logs)
    mountings, profile = log.fit(fitted, params.against)
    spread = log.turn_spread(fitted, params.against, profile.best)
    others = [log.profile(other, params.against) for other in held_out]
    figures = {
        "fitted_on": fitted.name,
        "held_out": [other.name for other in held_out],
        "causes": {
            name: {
                "turn_deg": np.degrees(mounting.turn_g).tolist(),
                "shift_m": mounting.shift_g.tolist(),
                "rows": mounting.rows,
                "fitted": asdict(log.residual(fitted, params.against, mounting)),
                "held_out": [asdict(log.residual(other, params.against, mounting)) for other in held_out],
            }
            for name, mounting in mountings.items()
        },
        "turn_std_deg": np.degrees(spread).tolist(),
        "offset": {name: _offset(found, params.against) for name, found in
                   zip([fitted.name, *(other.name for other in held_out)], [profile, *others])},
        "distance_m": float(np.median(np.linalg.norm(fitted.seen, axis=1))),
    }  # fmt: skip
    write_json(Path(out) / DATA, figures)
    atomic_write(Path(out) / PICTURE, _picture(held_out[0], params.against, mountings, profile))
    return figures


def _offset(found: OffsetProfile, params: CameraLogParams) -> dict[str, Any]:
    low, high = np.percentile(found.pieces, (5, 95))
    return {
        "rows": found.best,
        "seconds_if_no_frame_is_lost": found.best * params.row_period,
        "interval_rows": list(found.interval),
        "pieces_5_to_95_rows": [float(low), float(high)],
        "pieces": len(found.pieces),
    }


def story(figures: dict[str, Any], out: str | Path) -> str:
    """The figures in words and a table."""
    lines = [f"fitted on {figures['fitted_on']}; every figure below is of {', '.join(figures['held_out'])}, not fitted", ""]
    lines.append(f"{'explanation':28} {'rms':>8} {'median':>8} {'p95':>8} {'angle rms':>10} {'explains':>9}")
    before = _rms(figures["causes"]["as stated"])
    for name, cause in figures["causes"].items():
        rms, found = _rms(cause), cause["held_out"]
        median, p95 = (float(np.mean([r[key] for r in found])) for key in ("median", "p95"))
        angle = math.degrees(math.sqrt(np.mean([r["angle_rms"] ** 2 for r in found])))
        share = 1.0 - rms**2 / before**2
        lines.append(f"{name:28} {rms:6.3f} m {median:6.3f} m {p95:6.3f} m {angle:6.2f} deg {100 * share:8.1f}%")
    best = figures["causes"][BEST]
    turn, spread = best["turn_deg"], figures["turn_std_deg"]
    size = float(np.linalg.norm(turn))
    shift = float(np.linalg.norm(figures["causes"]["lens shifted instead"]["shift_m"]))
    lines += [
        "",
        f"the camera is turned by {size:.2f} deg against its stated mounting: "
        + ", ".join(f"{axis} {value:+.2f} +- {s:.2f} deg" for axis, value, s in zip("xyz", turn, spread))
        + " in gimbal axes (vehicle's axes at gimbal zero)",
        f"at the load's {figures['distance_m']:.1f} m this is {math.radians(size) * figures['distance_m']:.2f} m. A lens "
        f"shifted by {shift:.2f} m would look much alike: the load is always about as far away, so the recordings cannot tell the "
        "two apart; a tape measure can",
    ]
    for name, offset in figures["offset"].items():
        low, high = offset["interval_rows"]
        first, last = offset["pieces_5_to_95_rows"]
        lines.append(
            f"{name}: poses of {offset['rows']:+.2f} rows from the image's fit best, {low:+.2f} to {high:+.2f} (5 to 95 %, pieces "
            f"drawn anew); single pieces of {log.PIECE} rows {first:+.2f} to {last:+.2f}"
        )
    lines += [
        "there are no time stamps and frames are lost: an offset is known in rows, and in seconds only where none is lost",
        f"{Path(out) / PICTURE}  residual before and after, offset, pieces",
        f"{Path(out) / DATA}",
    ]
    return "\n".join(lines)


def _rms(cause: dict[str, Any]) -> float:
    rows = [(r["rms"], r["rows"]) for r in cause["held_out"]]
    return math.sqrt(sum(n * rms * rms for rms, n in rows) / sum(n for _, n in rows))


def _picture(held_out: CameraLog, params: CameraLogParams, mountings: dict[str, Mounting], profile: OffsetProfile) -> bytes:
    """Residual on a held-out recording before and after, and how well the offset is known; a PNG."""
    import io

    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 8.5), layout="constrained")
    FigureCanvasAgg(figure)
    image, track, offset, pieces = figure.subplots(2, 2).ravel()
    for name, colour in (("as stated", "#c0392b"), (BEST, "#2471a3")):
        where, seen = log.projected(held_out, params, mountings[name])
        right, down = (np.degrees(np.arctan2(seen[:, i], seen[:, 2]) - np.arctan2(where[:, i], where[:, 2])) for i in (0, 1))
        image.scatter(right, down, s=3, alpha=0.25, color=colour, label=name, linewidths=0)
        size = np.linalg.norm(seen - where, axis=1)
        rows = np.arange(min(600, len(size)))
        track.plot(rows, size[rows], color=colour, lw=1, label=name)
    image.set(xlim=(-10, 10), ylim=(10, -10), xlabel="seen right of projected [deg]", ylabel="seen below projected [deg]",
              title=f"Direction of the load in the camera, {held_out.name} (not fitted)", aspect="equal")  # fmt: skip
    image.axhline(0, color="0.6", lw=0.8)
    image.axvline(0, color="0.6", lw=0.8)
    legend = image.legend(loc="lower right")
    for handle in legend.legend_handles:
        handle.set_alpha(1)
        handle.set_sizes([25])
    track.set(xlabel="row", ylabel="distance between seen and projected [m]", title="The same, the first rows", ylim=(0, None))
    track.legend()
    offset.plot(log.OFFSETS, np.sqrt(profile.cost), ".-", color="#2471a3")
    offset.axvspan(*profile.interval, color="#2471a3", alpha=0.25, label="5 to 95 %")
    offset.set(xlabel="poses taken this many rows later than the image", ylabel="root of the robust cost [m]", ylim=(0, None),
               title=f"Offset: {profile.best:+.2f} rows, turn fitted anew at each")  # fmt: skip
    offset.legend()
    pieces.plot(profile.pieces, "o", color="#2471a3", ms=4)
    pieces.axhline(profile.best, color="0.4", lw=0.8)
    pieces.set(xlabel=f"piece of {log.PIECE} rows", ylabel="best offset [rows]", title="Offset piece by piece")
    for axes in (track, offset, pieces):
        axes.grid(alpha=0.3)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()
