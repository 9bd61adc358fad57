"""Tests run on a copy of the checkout, in a process that branches off with the libraries loaded."""

import multiprocessing
import os
import re
import signal
import sys
from contextlib import suppress
from pathlib import Path

LIMIT = 900  # s, for one run of a file's or a room's tests
FAILED = re.compile(r"^(?:FAILED|ERROR) (\S+)", re.MULTILINE)
LISTS = "tests/contract/test_style.py::test_each_mutation_fits_the_code"
"""The test that detects every mutation by its text, whatever the other tests do."""
PYTEST = ["-x", "-q", "-p", "no:cacheprovider", "--deselect", LISTS]
HEAVY = ["numpy", "scipy.optimize", "torch", "tensordict", "warp", "cv2", "pytest"]
"""Imported once, before the processes that run tests branch off."""


def run_tests(folder: str, tests: tuple[str, ...], log: str) -> None:
    """Run pytest on a copy of the checkout, in this process; the exit status is pytest's."""
    os.setsid()
    os.chdir(folder)
    with open(log, "w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    for name in [n for n in sys.modules if n.split(".")[0] == "bench"]:
        del sys.modules[name]
    root = Path(__file__).resolve().parents[2]
    os.environ.update(PYTHONPATH=folder, OMP_NUM_THREADS="1")
    sys.path[:] = [folder, *(p for p in sys.path if p and Path(p).resolve() != root)]
    import pytest

    sys.exit(pytest.main([*PYTEST, *tests]))


def outcome(folder: Path, tests: tuple[str, ...], limit: float = LIMIT) -> tuple[str, str]:
    """Return whether tests fail on a copy of the checkout, and the first that does."""
    log = folder.parent / "log.txt"
    context = multiprocessing.get_context("forkserver")
    process = context.Process(target=run_tests, args=(str(folder), tests, str(log)))
    process.start()
    process.join(limit)
    late = process.is_alive()
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)  # and what the tests started
    process.join()
    if late:
        return "killed", "time limit"
    match = FAILED.search(log.read_text(errors="replace"))
    if process.exitcode == 0:
        return "survived", ""
    return ("killed", match[1]) if match else ("broken", "")
