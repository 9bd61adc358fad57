"""Follow pages to the letter, as a new user does: every block as shown, nothing added, nothing
reused, in separate processes.

    python -m bench.follow docs/howto/rope.md docs/howto/camera.md    # from the root of a
    clone, its environment active

It prints wall and processor minutes of blocks and pages. Blocks marked with a reason of
:data:`LEFT` are skipped."""

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path

from tests.pages.blocks import Block, blocks_of

LEFT = {
    "a GPU",
    "a vehicle",
    "a motion-capture hall",
    "a camera",
    "an autopilot's firmware",
    "flights of yours",
    "hours",
    "a cluster",
    "it installs software",
    "it opens a window",
    "many minutes",
}
"""Reasons for which a new user with two cores and ten minutes skips a block, too."""


def follow(block: Block) -> bool:
    """Run a block in the working folder; returns whether all commands succeeded."""
    if block.title:
        Path(block.title).write_text(block.text, encoding="utf-8")
        return True
    if block.language == "python":
        return subprocess.run([sys.executable, "-c", block.text]).returncode == 0
    if block.language != "sh":
        return True
    lines = block.text.replace("\\\n", " ").splitlines() if block.terminals else [block.text]
    shells = [subprocess.Popen(["bash", "-ec", line]) for line in lines if line.strip()]
    return not any([shell.wait() for shell in shells])


def main() -> int:
    """Follow the named pages; returns 1 where a block fails."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("pages", nargs="+", type=Path)
    parser.add_argument(
        "--with",
        dest="reasons",
        action="append",
        default=[],
        choices=sorted(LEFT),
        help="follow these all the same",
    )
    args = parser.parse_args()
    rows = []
    for page in args.pages:
        begin = time.perf_counter()
        spent = sum(os.times()[2:4])
        stumbled = []
        for block in blocks_of(page.resolve(), Path.cwd()):
            start = time.perf_counter()
            if block.reason in LEFT - set(args.reasons):
                continue
            if not follow(block):
                stumbled.append(block.place)
            print(f"-- {block.place}: {time.perf_counter() - start:.1f} s", flush=True)
        wall = time.perf_counter() - begin
        processor = sum(os.times()[2:4]) - spent
        rows.append(
            f"{page}: {wall / 60:.1f} min, {processor / 60:.1f} of a processor; "
            + (f"STUMBLED at {stumbled}" if stumbled else "well")
        )
    print(*rows, sep="\n")
    return int("STUMBLED" in "".join(rows))


if __name__ == "__main__":
    sys.exit(main())
