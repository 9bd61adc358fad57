"""``visthrow demo``: throw once with the shipped vision policy and compare it with the state
policy.
"""

import argparse
import time
from pathlib import Path

from visthrow.cli import compare, fly
from visthrow.common.arguments import declare
from visthrow.common.storage import writable

# largest number of throws on the reference plant for each policy; one throw takes seconds
REFERENCE_THROWS = 6
REFERENCE_TARGETS = (2.0,)  # [m]

SEED = 0


add_arguments = declare(__file__)


def run(args: argparse.Namespace) -> int:
    """Fly one throw, compare the policies and list the files."""
    import importlib.util

    from visthrow.throws.loading import load_policy
    from visthrow.view.tables import PAPER_NOTE

    begin = time.perf_counter()
    count = min(args.throws, REFERENCE_THROWS)
    loaded = [load_policy(name) for name in compare.DEFAULT_POLICIES]
    folder = Path(args.out)
    writable(folder)
    if importlib.util.find_spec("mujoco") is None:
        paths = _throw_here(loaded, folder, args.throws)
        print("Without the reference plant: it needs MuJoCo, pip install 'visthrow[reference]'\n")
    else:
        from visthrow.throws.reference_protocol import Throwing

        # the throws on the reference plant run in a separate process at the same time
        throws = (loaded, REFERENCE_TARGETS, count, "reference-realistic", SEED, 1)
        with Throwing(*throws, together=True) as throwing:
            paths = _throw_here(loaded, folder, args.throws)
            print(
                f"{count} throws per policy on the reference plant, independent code with less"
                " noise than training ...",
                flush=True,
            )
            paths += _write_table(loaded, throwing.results(), "reference-realistic", folder)
    print(PAPER_NOTE + "\n\nFiles:")
    for path in paths:
        print(f"  {path}")
    print(f"\nTotal time: {time.perf_counter() - begin:.0f} s.")
    return 0


def _throw_here(loaded: list, folder: Path, throws: int) -> list[Path]:
    """Record one throw and compare many in the training simulator; return the files' paths."""
    from visthrow.throws.recorded import fly as throw_once

    print(
        "About a minute on two CPU cores.\nOne throw at a target 2 m ahead with the vision"
        " policy ...",
        flush=True,
    )
    log = throw_once(loaded[1], [2.0, 0.0, 0.0], "hybrid", SEED)
    paths = fly.write(folder, log, loaded[1].experiment)
    print(fly.summary_text(log) + "\n")
    print(f"{throws} throws per policy and target in the training simulator ...", flush=True)
    return paths + _write_table(
        loaded,
        compare.throw_hybrid(loaded, compare.DEFAULT_TARGETS, throws, "cpu", SEED),
        "hybrid",
        folder,
    )


def _write_table(loaded: list, throws: list, plant: str, folder: Path) -> list[Path]:
    """Print the table and write it with its plot; return the files' paths."""
    entries = compare.entries_of(loaded, compare.DEFAULT_POLICIES, throws)
    comparison = compare.label_throws(plant, SEED, entries)
    print(comparison.table(), flush=True)
    return comparison.write(folder)
