"""Record the provenance of a result: commit, package versions, command line and processor.

It never contains host names, users or paths.
"""

import os
import platform
import re
import shlex
import subprocess
import sys
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from visthrow import __version__
from visthrow.common.errors import StorageError
from visthrow.common.storage import atomic_write, writable, write_json

PACKAGES = (
    "numpy",
    "torch",
    "warp-lang",
    "rsl-rl-lib",
    "tensordict",
    "kornia",
    "opencv-python-headless",
    "rerun-sdk",
    "scipy",
    "mujoco-core",
)
"""Distributions whose version can affect results."""

# variable that states the commit of a copy without history (on a cluster node, in a container)
COMMIT_VARIABLE = "VISTHROW_COMMIT"

_FOLDERS = re.compile(r"(?<![\w.~-])(?:~|[A-Za-z]:)?[/\\](?:[^\s/\\=,;:]+[/\\])*")


def commit() -> str:
    """Return the commit of the running checkout, with ``-dirty`` if tracked files were changed;
    without a checkout :data:`COMMIT_VARIABLE`, or "unknown".
    """
    root = Path(__file__).resolve().parents[2]
    variable = os.environ.get(COMMIT_VARIABLE, "unknown")
    if not (root / ".git").exists():  # installed, or inside another repository
        return variable
    try:
        head = _git(root, "rev-parse", "HEAD")
        if _git(root, "status", "--porcelain", "--untracked-files=no"):
            return f"{head}-dirty"
        return head
    except (OSError, subprocess.SubprocessError):
        return variable


def command() -> str:
    """Return the command line in shell syntax without absolute folders, such as
    ``visthrow train`` or ``python -m bench.train``.
    """
    program, *words = (_FOLDERS.sub("", argument) for argument in sys.argv)
    module = getattr(sys.modules["__main__"], "__spec__", None)
    if program.endswith(".py"):
        name = module.name.removesuffix(".__main__") if module else ""
        program = f"python -m {name}" if name else f"python {program}"
    return " ".join([program, *map(shlex.quote, words)])


@cache
def versions() -> dict[str, str]:
    """Return the installed version of each of :data:`PACKAGES`; cached, because a process may
    record many runs.
    """
    versions = {"visthrow": __version__, "python": platform.python_version()}
    for name in PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return versions


def processors() -> dict[str, Any]:
    """Return the CPU's model and core count, and the GPUs' models if torch is already imported."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        text = ""
    model = re.search(r"^model name\s*:\s*(.+)$", text, re.MULTILINE)
    machine = {"cpu": model[1].strip() if model else platform.machine(), "cores": os.cpu_count()}
    torch = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_available():
        machine["gpu"] = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    return machine


def collect() -> dict[str, Any]:
    """Return the complete provenance with the time [UTC]."""
    return {
        "commit": commit(),
        "command": command(),
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": versions(),
        "processors": processors(),
    }


def write_run_folder(
    folder: str | Path, config_text: str, *, resume: bool = False, **extra: Any
) -> dict[str, Any]:
    """Write the resolved config, TOML, and the provenance with ``extra`` into the folder of a run;
    return the provenance.

    If a run is resumed, its config is kept, and the provenance is written to the next free
    ``provenance_<n>.json``. Raises StorageError: the folder holds a run and ``resume`` is not set,
    or it cannot be written."""
    folder = Path(folder)
    config = folder / "config.toml"
    record = {**collect(), **extra}
    writable(folder)
    if not resume:
        try:
            config.touch(exist_ok=False)  # if two runs start at once, only one succeeds
        except FileExistsError:
            check_free(folder)
    elif config.exists():
        count = len(list(folder.glob("provenance*.json")))
        write_json(folder / f"provenance_{count}.json", record)
        return record
    try:
        atomic_write(config, config_text)
    except StorageError:
        config.unlink(missing_ok=True)  # an empty one would count as a run
        raise
    write_json(folder / "provenance.json", record)
    return record


def check_free(folder: str | Path) -> None:
    """Raise StorageError if a folder holds a run."""
    if (Path(folder) / "config.toml").exists():
        raise StorageError(f"{folder} holds a run already; name another with --out, or resume it")


def _git(root: Path, *arguments: str) -> str:
    words = ["git", "-C", str(root), *arguments]
    return subprocess.run(
        words, capture_output=True, text=True, check=True, timeout=10
    ).stdout.strip()
