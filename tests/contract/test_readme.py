"""What the README shows works: its Python runs, its commands parse, its files are there."""

import re
import shlex
from pathlib import Path

import pytest

from visthrow import cli

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / name for name in ("README.md", "docs/pilots/runner.md", "docs/pilots/betaflight.md", "docs/explanation/diagnosis.md")]
TEXT = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
BLOCKS = re.findall(r"```(\w*)\n(.*?)```", TEXT, re.DOTALL)
LINES = [line.split("#")[0].strip() for _, block in BLOCKS for line in block.splitlines() if line.startswith("visthrow ")]


def test_python_runs():
    programs = [block for language, block in BLOCKS if language == "python"]
    assert programs
    for program in programs:
        exec(compile(program, "README.md", "exec"), {})


@pytest.mark.parametrize("line", LINES)
def test_commands_parse(line):
    words = shlex.split(line)[1:]
    parsed = cli.build_parser().parse_args(words)
    assert parsed.command == words[0]


def test_links_lead_somewhere():
    targets = [(ROOT, t) for t in re.findall(r"`((?:configs|tests)/[\w./]+)`", TEXT)]
    for page in PAGES:
        targets += [(page.parent, t) for t in re.findall(r"\]\(([^)]+)\)", page.read_text(encoding="utf-8"))]
    assert len(targets) > len(PAGES)
    missing = [t for folder, t in targets if "://" not in t and not (folder / t).exists()]
    assert not missing
