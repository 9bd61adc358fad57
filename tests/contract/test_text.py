"""Tracked files hold no path or host of the machine that they were written on."""

import re
import subprocess
from pathlib import Path

from pytest import mark

from tests.places import ROOT

BINARY = {
    ".bbl",
    ".gz",
    ".png",
    ".jpg",
    ".gif",
    ".npz",
    ".rrd",
    ".parquet",
    ".onnx",
    ".ulg",
    ".pdf",
}

MACHINE_PATHS = re.compile(
    r"(?<![\w.:/-])/(?:home|root|Users|workspace|work|opt|mnt|scratch)/\w+"  # absolute folders
    r"|file://|\bindex-url\b|\bfind-links\b"
    r"|\b(?:pypi|pythonhosted)\.org\b",
    re.IGNORECASE,
)
EXEMPT = {"tests/contract/test_text.py", "tests/unit/on_visthrow/test_provenance.py"}
"""This file holds the pattern; the other one tests that such paths are left out."""


def list_tracked() -> list[Path]:
    """Return the tracked files; in a copy without history, every file of the source folders."""
    listed = subprocess.run(
        ["git", "-C", str(ROOT), "ls-files", "-z"], capture_output=True, text=True
    )
    if listed.returncode == 0 and listed.stdout:
        files = [ROOT / name for name in listed.stdout.split("\0") if name]
    else:
        files = [
            path
            for part in ("camera", "sim", "visthrow", "hil", "tests", "configs")
            for path in ROOT.joinpath(part).rglob("*")
        ]
    return [path for path in files if path.is_file() and path.suffix not in BINARY]


FILES = list_tracked()


def test_no_machine_paths():
    wrong = []
    assert ROOT / "pyproject.toml" in FILES or ROOT / "visthrow" / "cli" / "__init__.py" in FILES
    for path in FILES:
        name = path.relative_to(ROOT).as_posix()
        if name in EXEMPT:
            continue
        text = path.read_text(encoding="utf-8")
        wrong += [
            f"{name}: {text[match.start() :][:120]}" for match in MACHINE_PATHS.finditer(text)
        ]
    assert not wrong


@mark.parametrize(
    ("line", "caught"),
    [
        ("/home/me/x", True),
        ("see /root/x", True),
        ("--index-url x", True),
        ("https://pypi.org/simple", True),
        ("../shared", False),
        ("/dev/null", False),
        ("#!/usr/bin/env bash", False),
        ("N m/rad", False),
        ("/proc/cpuinfo", False),
    ],
)
def test_the_pattern_itself(line, caught):
    assert bool(MACHINE_PATHS.search(line)) == caught


def test_no_test_folder_shadows_a_package():
    folders = {path.name for path in (ROOT / "tests").iterdir() if path.is_dir()}
    assert folders.isdisjoint({"camera", "sim", "visthrow", "hil"})
