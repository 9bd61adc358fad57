"""Load throws of HIL runs from the flight logs in their folders, in the form of simulated
throws.
"""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from visthrow.common.errors import LogError
from visthrow.logs import RUN_TICKS
from visthrow.logs.flightlog import FlightLog
from visthrow.onboard.observations import VEHICLE
from visthrow.task.measurement import Entry, Throws

PATTERN = "throw-*.npz"

MOST_NAMES = 10  # largest number of files listed in an error


def logs_of(folders: Iterable[str | Path]) -> list[FlightLog]:
    """Return the logs of all throws of some runs.

    Raises LogError: a folder has no throws, or a log is damaged.
    """
    logs: list[FlightLog] = []
    for folder in map(Path, folders):
        paths = sorted(folder.glob(PATTERN))
        if not paths:
            if folder.is_dir():
                names = sorted(path.name for path in folder.iterdir())
                hint = ", ".join(names[:MOST_NAMES]) + ", ..." * (len(names) > MOST_NAMES)
            else:
                hint = "no such folder"
            ticks = folder / RUN_TICKS
            advice = f"If the run was killed, create them with: visthrow hil view {folder}"
            if ticks.is_file() and '"state": "throw"' not in ticks.read_text(errors="replace"):
                advice = "No throw was started in this run"
            raise LogError(
                f"{folder}: no {PATTERN} in it ({hint or 'empty'}); expected the folder of a run"
                f" with throws. {advice}"
            )
        logs += map(FlightLog.load, paths)
    return logs


def note(logs: list[FlightLog]) -> str:
    """Return a note for tables: whether the paper's throws and these were flown by real or
    simulated vehicles, as far as their folders state it.
    """
    text = "The paper's figures are ten throws a target of its vehicle."
    simulated = sum(bool(log.meta.get("provenance", {}).get("simulated")) for log in logs)
    if simulated == len(logs):
        return text + " A simulated vehicle flew these throws."
    throws = "these throws"
    if simulated:
        text += f" A simulated vehicle flew {simulated} of these {len(logs)} throws."
        throws = "the others"
    return text + f" Whether a vehicle or a fake autopilot flew {throws}, the folders do not say."


def entries(logs: list[FlightLog]) -> list[Entry]:
    """Return one entry for each policy, with its throws by distance of the goal. Policies with the
    same name but different content are separate.
    """
    groups: dict[tuple[str, str, str], dict[float, list[FlightLog]]] = {}
    for log in logs:
        try:
            key = (log.meta["policy"], log.meta["policy_sha256"] or "", log.meta["layout"])
            distance = round(float(np.linalg.norm(_offset(log))), 2)
        except (KeyError, TypeError) as error:
            raise LogError(
                f"a log does not hold a throw of a run: {error!r}; it has {', '.join(log.meta)}"
            ) from error
        groups.setdefault(key, {}).setdefault(distance, []).append(log)
    targets = sorted({distance for by_distance in groups.values() for distance in by_distance})
    names = [name for name, _, _ in groups]
    entries = []
    for (name, sha, layout), by_distance in sorted(groups.items()):
        title = name if names.count(name) == 1 else f"{name} {sha[:8]}"
        throws = [_throws(target, by_distance.get(target, [])) for target in targets]
        entries.append(Entry(title, layout, throws))
    return entries


def _offset(log: FlightLog) -> np.ndarray:
    """Return the offset from the hover point to the goal [m], shape (2,)."""
    return np.array(log.meta["goal_w"][:2]) - np.array(log.meta["home_w"][:2])


def _throws(target: float, logs: list[FlightLog]) -> Throws:
    """Return the throws at one distance, with landing points along and across the direction of the
    throw, relative to the hover point.
    """
    columns = np.array([_row(log) for log in logs], dtype=float).reshape(-1, 5)
    error, duration, smooth = columns.T[2:]
    clearance = np.full(len(logs), np.nan)
    success = np.isfinite(error)
    return Throws(target, success, columns[:, :2], error, duration, clearance, smooth)


def _row(log: FlightLog) -> tuple[float, ...]:
    """Return landing point along and across, error, duration and smoothness; NaN if the throw
    failed.
    """
    result = log.meta["result"]
    if not result["success"]:
        return (np.nan,) * 5
    offset = _offset(log)
    distance = np.linalg.norm(offset)
    direction = offset / distance if distance > 0.0 else np.array([1.0, 0.0])
    landed = np.array(result["landing_w"][:2]) - np.array(log.meta["home_w"][:2])
    side = direction[0] * landed[1] - direction[1] * landed[0]
    return (
        float(landed @ direction),
        float(side),
        result["error"],
        result["duration"],
        smoothness(log),
    )


def smoothness(log: FlightLog) -> float:
    """Return the root mean square change of a throw's normalised commands from step to step,
    defined as in `visthrow.training.protocol`.
    """
    times = log.meta["times"]
    actions = log["action"]
    observation = log["observation"]
    during = (actions.time >= times["policy_start"] - 1e-9) & (
        actions.time < times["recovery"] - 1e-9
    )
    action = actions.values[during, :4]
    before = observation.values[during, VEHICLE : VEHICLE + 4]
    return float(np.sqrt(np.mean(np.square(action - before))))
