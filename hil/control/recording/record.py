"""The folder of a run: config, policy, every tick with its raw poses, the link's .tlog, and the
results made from them.

``ticks.jsonl`` holds one tick on each line. If the run is killed, at most the last tenth of a
second is lost. Floats are written so that they are read back bit for bit. A separate thread writes
the lines, so that a slow disk delays no tick."""

import hashlib
import json
import shutil
import tempfile
import tomllib
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hil.control.state_machine import OperatorInput, TickRecord
from hil.errors import RunError
from hil.links.backends.base import Status
from hil.links.writer import Writer
from hil.params import HilParams
from hil.poses.pose import Pose
from visthrow import config
from visthrow.common import provenance
from visthrow.common.errors import ConfigError
from visthrow.common.storage import atomic_write, write_json
from visthrow.onboard.policy import Policy, find_policy

POLICY = "policy.npz"
CONFIG = "config.toml"
TICKS = "ticks.jsonl"
BASE = "hil/dry_run.toml"  # base of the config of a recorded run
FORMER_POSES = "poses.jsonl"  # of older runs, with the poses in a separate file
SUMMARY = "summary.json"
PROVENANCE = "provenance.json"


EXPECTED = f"expected {CONFIG}, {POLICY} and {TICKS} in it"


@contextmanager
def begin_folder(folder: Path) -> Iterator[None]:
    """Remove a new folder again if the run cannot start. Raises `StorageError`: the folder already
    holds a run.

    Links write their files before a recorder exists.
    """
    provenance.check_free(folder)
    new = not folder.exists()
    try:
        yield
    except BaseException:
        if new:
            shutil.rmtree(folder, ignore_errors=True)
        raise


class RunRecorder:
    """Writes a run's folder."""

    def __init__(self, folder: str | Path, params: HilParams):
        """Create the folder with config, policy and provenance. Raises `StorageError`: it
        already holds a run, or cannot be written.
        """
        self.folder = Path(folder)
        source = find_policy(params.policy)
        data = source.read_bytes()
        provenance.write_run_folder(
            self.folder,
            config.dumps(params),
            policy=source.stem,
            policy_sha256=hashlib.sha256(data).hexdigest(),
        )
        atomic_write(self.folder / POLICY, data)
        self._writer = Writer(self.folder / TICKS)

    @property
    def failed(self) -> str | None:
        """Reason why something could not be written, or None."""
        return self._writer.why

    def tick(
        self,
        index: int,
        poses: list[Pose],
        status: Status,
        words: OperatorInput,
        recording: bool,
        decision: TickRecord,
        times: dict[str, float],
    ) -> None:
        """Record one tick; never raises and never waits.

        Once a line was lost, no more are written.
        """
        if self.failed is not None:
            return
        line = {
            "n": index,
            "status": list(vars(status).values()),
            "words": list(vars(words).values()),
            "recording": recording,
            **vars(decision),
            "times": times,
            "poses": [list(vars(pose).values()) for pose in poses],
        }
        self._writer.put(json.dumps(line).encode() + b"\n")

    def close(self, summary: dict[str, Any]) -> None:
        """Write the remaining lines and the summary. Raises `StorageError`: the disk is full;
        the run itself is over then.
        """
        self._writer.close()
        write_json(self.folder / SUMMARY, {**summary, "recording_failed": self.failed})


def lines(path: Path) -> Iterator[Any]:
    """Yield the value of each line of a file; an incomplete last line is left out.

    Raises `RunError`: no such file, or a damaged line.
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


def restore_poses(line: dict[str, Any]) -> dict[str, Any]:
    """Return the line of a tick with its raw poses as `Pose` objects."""
    poses = []
    for stamp, arrival, body, *values in line["poses"]:
        pos, quat, vel, rate = (None if v is None else tuple(v) for v in values[:4])
        poses.append(Pose(stamp, arrival, body, pos, quat, vel, rate, *values[4:]))
    return line | {"poses": poses}


def require_run(folder: Path, parts: tuple[str, ...] = (CONFIG, TICKS)) -> None:
    """Raise `RunError` unless a folder is that of a run; the message lists the expected files."""
    if not is_run(folder, parts):
        raise RunError(f"{folder}: not the folder of a run; {EXPECTED}")


def is_run(folder: Path, parts: tuple[str, ...] = (CONFIG, TICKS)) -> bool:
    """Return whether a folder holds these files of a run."""
    return all((folder / name).is_file() for name in parts)


def _replayable(path: Path) -> dict[str, Any]:
    """Return the config of a run without the keys that only describe the format of its source,
    which a replay does not read. Keys newer than the run get their shipped values, except that a
    run without `aim` refuses no release, and a run without `probe` commands no doublets.
    """
    try:
        tree = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"{path}: cannot be read: {error}; expected the config of a run"
        ) from error
    tree.pop("against", None)
    noise = tree.get("camera", {}).get("noise", {})
    if "seen_radius" in noise:
        noise["visible_radius"] = noise.pop("seen_radius")
    tree["source"] = {
        key: value
        for key, value in tree.get("source", {}).items()
        if key not in ("columns", "time")
    }
    check = {"probe": 0.0} | tree.get("check", {})
    return {"aim": None} | tree | {"check": check, "base": BASE}


def load_run(folder: str | Path) -> tuple[HilParams, Policy, list[dict[str, Any]]]:
    """Return config, policy and ticks of a run. Raises `RunError`: not a run, or a damaged one."""
    folder = Path(folder)
    require_run(folder)
    setup = load_setup(folder)
    ticks = list(lines(folder / TICKS))
    try:
        if (folder / FORMER_POSES).is_file():
            poses: dict[int, list] = {}
            for number, *row in lines(folder / FORMER_POSES):
                poses.setdefault(number, []).append(row)
            # After a kill the two files may end at different ticks.
            if not (folder / SUMMARY).is_file():
                ticks = [line for line in ticks if line["n"] < max(poses, default=0)]
            ticks = [line | {"poses": poses.get(line["n"], [])} for line in ticks]
        return *setup, [restore_poses(line) for line in ticks]
    except (KeyError, TypeError, ValueError) as error:
        raise RunError(f"{folder}: ticks or poses are damaged: {error!r}") from error


def load_setup(folder: Path) -> tuple[HilParams, Policy]:
    """Return config and policy of a run, also of one that goes on."""
    params = config.load_dict(HilParams, _replayable(folder / CONFIG), name=str(folder / CONFIG))
    return params, Policy.load(folder / POLICY)


# files of a bundle, beside the links' records
PARTS = (CONFIG, POLICY, TICKS, FORMER_POSES, SUMMARY, PROVENANCE)

RECORDS = ("*.tlog", "*.msp")

ENDING = ".zip"
MOST_BYTES = 2 << 30  # most bytes that a bundle may unpack to, ten times a run of an hour


def pack(folder: str | Path) -> Path:
    """Write the bundle of a run beside its folder and return its path. Raises `RunError`: it
    cannot be written.
    """
    folder = Path(folder).resolve()
    require_run(folder)
    path = folder.with_name(folder.name + ENDING)
    paths = [folder / name for name in PARTS if (folder / name).is_file()]
    paths += sorted(file for pattern in RECORDS for file in folder.glob(pattern))
    part = path.with_name(f".{path.name}.tmp")
    try:
        with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as bundle:
            for file in paths:
                bundle.write(file, file.name)
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise RunError(f"{path}: cannot be written: {error.strerror}") from error
    return path


@contextmanager
def open_folder(path: str | Path) -> Iterator[Path]:
    """Yield the folder of a run: the given one, or a temporary one with a bundle's files. Raises
    `RunError`: the file is not a bundle.
    """
    path = Path(path)
    if path.is_dir() or not path.exists():
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        try:
            with zipfile.ZipFile(path) as bundle:
                entries = [
                    entry
                    for entry in bundle.infolist()
                    if Path(entry.filename).name == entry.filename
                ]
                if sum(entry.file_size for entry in entries) > MOST_BYTES:
                    raise RunError(
                        f"{path}: unpacks to more than {MOST_BYTES >> 30} GiB; expected the"
                        " bundle of a run"
                    )
                for entry in entries:
                    bundle.extract(entry, folder)
        except (
            zipfile.BadZipFile,
            zlib.error,
            RuntimeError,
            OSError,
        ) as error:  # RuntimeError: password or unknown compression
            raise RunError(
                f"{path}: {error}; expected a folder of a run, or the bundle of one"
            ) from error
        if not is_run(Path(folder)):
            names = ", ".join(entry.filename for entry in entries) or "nothing"
            raise RunError(f"{path}: not the bundle of a run, it holds {names}; {EXPECTED}")
        yield Path(folder)
