"""One folder a run: config, policy, every raw pose, every tick, the link's .tlog; and what is made of it afterwards.

``poses.jsonl`` and ``ticks.jsonl`` hold a JSON value a line and survive a kill up to the last lines; floats are written so
that they read back to the same bits. Lines are written by a thread of their own, so that a slow disk delays no tick.
"""

import hashlib
import json
import queue
import threading
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hil.backends.base import Status
from hil.control.decision import Decision, OperatorInput
from hil.errors import RunError
from hil.params import HilParams
from hil.poses.pose import Pose
from visthrow import config
from visthrow.common import provenance
from visthrow.common.errors import ConfigError, StorageError
from visthrow.common.storage import atomic_write, write_json
from visthrow.common.toml_text import dumps
from visthrow.onboard.policy import Policy, find_policy

POLICY, CONFIG, POSES, TICKS, TLOG, SUMMARY, PROVENANCE = (
    "policy.npz", "config.toml", "poses.jsonl", "ticks.jsonl", "link.tlog", "summary.json", "provenance.json",
)  # fmt: skip


POSES_TLOG = "poses.tlog"
"""Log of poses that come on a port of their own."""

MOST_WAITING = 50_000
"""Lines that may wait for a slow disk, some minutes' worth; beyond them the recording has failed."""


class Recorder:
    """Writes a run's folder.

    Attributes:
        failed: why something could not be written, or None.
    """

    def __init__(self, folder: str | Path, params: HilParams) -> None:
        """Make the folder and write config, policy and provenance.

        Raises:
            StorageError: the folder holds a run already, or cannot be written.
        """
        self.folder = Path(folder)
        if (self.folder / CONFIG).exists():
            raise StorageError(f"{self.folder} holds a run already; name another folder with --out")
        source = find_policy(params.policy)
        data = source.read_bytes()
        provenance.write_run_folder(
            self.folder, config.dumps(params), policy=source.stem, policy_sha256=hashlib.sha256(data).hexdigest()
        )
        atomic_write(self.folder / POLICY, data)
        self.failed: str | None = None
        self._queue: queue.SimpleQueue[tuple[str, str] | None] = queue.SimpleQueue()
        try:
            self._files = {name: (self.folder / name).open("w", encoding="utf-8") for name in (POSES, TICKS)}
        except OSError as error:
            raise StorageError(f"cannot write to {self.folder}: {error.strerror}") from error
        self._thread = threading.Thread(target=self._write, name="recorder", daemon=True)
        self._thread.start()

    def tick(
        self, index: int, poses: list[Pose], status: Status, words: OperatorInput, recording: bool, decision: Decision,
        times: dict[str, float],
    ) -> None:  # fmt: skip
        """Record one tick; never raises and never waits."""
        if self._queue.qsize() > MOST_WAITING:
            self.failed = self.failed or "the disk is too slow"
            return
        for p in poses:
            values = (index, p.stamp, p.arrival, p.body, p.pos, p.quat, p.vel, p.rate, p.reset, p.measured)
            self._queue.put((POSES, json.dumps(values)))
        line = {
            "n": index, "status": list(vars(status).values()),
            "words": list(vars(words).values()), "recording": recording, **vars(decision), "times": times,
            "poses": len(poses),
        }  # fmt: skip
        self._queue.put((TICKS, json.dumps(line)))

    def _write(self) -> None:
        while (item := self._queue.get()) is not None:
            if self.failed is not None:
                continue
            try:
                self._files[item[0]].write(item[1] + "\n")
                if self._queue.empty():
                    for file in self._files.values():
                        file.flush()
            except (OSError, ValueError) as error:
                self.failed = f"cannot write {item[0]}: {error}"

    def close(self, summary: dict[str, Any]) -> None:
        """Write what is left and the summary.

        Raises:
            StorageError: the disk is full; the run itself is over by now.
        """
        self._queue.put(None)
        self._thread.join()
        for file in self._files.values():
            try:
                file.close()
            except OSError as error:
                self.failed = self.failed or f"cannot close: {error}"
        write_json(self.folder / SUMMARY, {**summary, "recording_failed": self.failed})


def lines(path: Path) -> Iterator[Any]:
    """Values of a file of lines; a last line that was cut short is left out.

    Raises:
        RunError: no such file, or a line before the last one is damaged.
    """
    try:
        rows = path.read_text(encoding="utf-8").split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise RunError(f"{path}: cannot be read: {error}; expected the folder of a run") from error
    for number, row in enumerate(rows, start=1):
        if not row:
            continue
        try:
            yield json.loads(row)
        except ValueError as error:
            if number < len(rows):
                raise RunError(f"{path}: line {number} is damaged: {error}") from error


def pose_of(row: list) -> tuple[int, Pose]:
    """Number of the tick and the raw pose of a line of :data:`POSES`."""
    index, stamp, arrival, body, *vectors, reset, measured = row
    pos, quat, vel, rate = (None if v is None else tuple(v) for v in vectors)
    return index, Pose(stamp, arrival, body, pos, quat, vel, rate, reset, measured)


def read_poses(folder: Path) -> dict[int, list[Pose]]:
    """Raw poses of a run by tick.

    Raises:
        RunError: the file is missing or damaged.
    """
    found: dict[int, list[Pose]] = {}
    try:
        for row in lines(folder / POSES):
            index, pose = pose_of(row)
            found.setdefault(index, []).append(pose)
    except (TypeError, ValueError) as error:
        raise RunError(f"{folder / POSES}: not a list of poses: {error}") from error
    return found


def require_run(folder: Path) -> None:
    """Refuse what is no folder of a run.

    Raises:
        RunError: with what was expected in it.
    """
    if not (folder / CONFIG).is_file() or not (folder / TICKS).is_file():
        raise RunError(f"{folder}: no folder of a run; expected {CONFIG}, {POLICY}, {POSES} and {TICKS} in it")


def _replayable(path: Path) -> str:
    """Config of a run without what only reads the recording's source: its poses are here, and its form has changed before.

    Raises:
        ConfigError: it cannot be read.
    """
    try:
        tree = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}; expected the config of a run") from error
    tree.pop("against", None)
    tree["source"] = {key: value for key, value in tree.get("source", {}).items() if key not in ("columns", "time")}
    return dumps(tree)


def load_run(folder: str | Path) -> tuple[HilParams, Policy, list[dict[str, Any]], dict[int, list[Pose]]]:
    """Config, policy, ticks and raw poses of a run.

    Raises:
        RunError: no folder of a run, or a damaged one.
        ConfigError, PolicyError: its config or policy cannot be read.
    """
    folder = Path(folder)
    require_run(folder)
    params, policy = config.loads(HilParams, _replayable(folder / CONFIG), name=str(folder / CONFIG)), Policy.load(folder / POLICY)
    ticks, poses = list(lines(folder / TICKS)), read_poses(folder)
    if not (folder / SUMMARY).is_file():  # killed: the two files may end at different ticks, with half of its poses
        ticks = [line for line in ticks if line["n"] < max(poses, default=0)]
    return params, policy, ticks, poses
