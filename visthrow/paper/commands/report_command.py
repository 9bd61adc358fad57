"""``visthrow report``: one page with the paper's evidence and ours, from records or from throws
made now.
"""

import argparse
import sys
import time
from pathlib import Path

from visthrow.common.arguments import add_out
from visthrow.common.errors import StorageError, VisthrowError

TITLE = "Throwing with a quadrotor: the paper's evidence and ours"
UNITS = "throws"  # folder of single results, in the output folder

# list of ``configs/sweep`` for ``--quick``; the full report reads what the lists ``paper`` and
# ``gap`` made
QUICK_LIST = "quick"

NO_REFERENCE = (
    'runs.shipped.throws=["own"]',
)  # changes of the quick list where MuJoCo is not installed


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = (
        "examples:\n  visthrow report                                the page, from the committed"
        " records\n  visthrow report --quick                        few throws of the shipped"
        " policies and the baseline, made now\n  visthrow report --results runs/sweep/throws   "
        " with throws of your own sweep on top\n\nEverything is a unit of work that is kept when it"
        " is done: killed at any moment and started again, the command goes\non where it was."
        " Trainings and throws of policies are the matter of 'visthrow sweep run paper' and"
        " 'gap'.\n"
    )
    parser.add_argument(
        "--quick", action="store_true", help="throw now, few throws, instead of reading records"
    )
    parser.add_argument(
        "--results",
        nargs="+",
        action="extend",
        default=[],
        metavar="FOLDER",
        help="folders with further results of throws",
    )
    parser.add_argument(
        "--records", metavar="FOLDER", help="folder of records (default: those of the package)"
    )
    parser.add_argument(
        "--jobs", type=int, metavar="N", help="processes at once (default: one a core)"
    )
    add_out(parser, "out/report", "for page, tables and pictures")


def run(args: argparse.Namespace) -> int:
    """Throw if asked to, read, write."""
    from visthrow.common.storage import writable
    from visthrow.paper import RECORDS
    from visthrow.paper.report import result_set
    from visthrow.training import compute_device
    from visthrow.view import page

    begin = time.perf_counter()
    if args.jobs is not None and args.jobs < 1:
        raise VisthrowError(f"--jobs {args.jobs}; expected 1 or more")
    out = Path(args.out)
    jobs = args.jobs or compute_device.cores()
    records = _records(args.records) if args.records else RECORDS
    folders = [_folder(name) for name in args.results]
    writable(out)
    if args.quick:
        quick(out, jobs)
        thrown = result_set.read(
            (), [out / "quick" / UNITS, *folders], "quick: few throws, wide intervals"
        )
    else:
        thrown = result_set.read([records], folders)
    paths = page.write(out, TITLE, lead(thrown), sections(thrown))
    print(summary(thrown))
    for path in paths[:2]:
        print(path)
    print(
        f"{len(thrown.results)} sets of throws, {len(thrown.runs)} trainings,"
        f" {time.perf_counter() - begin:.0f} s"
    )
    return 0


def _records(name: str) -> Path:
    """Folder of records, as ``visthrow sweep collect`` makes one.

    Raises StorageError: there is none.
    """
    from visthrow.paper.report.result_set import PARTS

    if not any((Path(name) / part).is_dir() for part in PARTS):
        actual = "none of these in it" if Path(name).is_dir() else "no such folder"
        raise StorageError(
            f"--records {name}: {actual}; expected a folder of {', '.join(PARTS)},"
            " as 'visthrow sweep collect' makes it"
        )
    return Path(name)


def _folder(name: str) -> Path:
    """Folder or file of results of throws. Raises StorageError: there is none."""
    path = Path(name)
    if not path.is_file() and not any(path.glob("*.json")):
        actual = "no *.json in it" if path.is_dir() else "no such folder"
        raise StorageError(
            f"--results {name}: {actual}; expected one with results of throws, as runs/sweep/throws"
        )
    return path


def quick(out: Path, jobs: int) -> None:
    """Make the few throws of ``configs/sweep/quick.toml`` and of the baseline, as far as they are
    not there.

    Raises VisthrowError: throws that failed; the message names them.
    """
    from importlib.util import find_spec

    from visthrow.paper.sweep.pool import Local, ProcessPool
    from visthrow.paper.sweep.work_units import load_list
    from visthrow.throws import results

    folder = out / "quick"
    changes = ()
    if find_spec("mujoco") is None:
        changes = NO_REFERENCE
        _say("the reference plant is left out: it needs MuJoCo, pip install 'visthrow[reference]'")
    local = Local(QUICK_LIST, folder, ["cpu"], jobs, changes)
    outcome = ProcessPool(load_list(QUICK_LIST, changes), folder, local, _say).run(None)
    if outcome.failed:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in outcome.failed.items())
        raise VisthrowError(
            f"throws failed: {reasons}; all that was printed is in {folder / 'logs'}"
        )
    if outcome.stopped:
        raise KeyboardInterrupt
    if find_spec("piqp") is None:
        _say("the baseline is left out: it needs piqp, pip install 'visthrow[paper]'")
        return
    from visthrow.paper.baseline.thrower import fly_unit

    results.work(
        quick_units(), folder / UNITS, fly_unit, None, jobs, lambda text: _say(f"TO+MPC: {text}")
    )


def quick_units() -> list[dict]:
    """Few throws of the baseline, for a look within minutes."""
    from visthrow.paper.baseline.front import FRONT_TARGET
    from visthrow.paper.baseline.thrower import IDEAL, unit
    from visthrow.task.measurement import TARGETS

    units = [unit(IDEAL, "none", target, 5) for target in TARGETS]
    return units + [
        unit("hybrid", compensation, FRONT_TARGET, 10) for compensation in ("both", "delay")
    ]


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def lead(thrown) -> str:
    """Return the page's introduction."""
    note = f" **{thrown.note[0].upper() + thrown.note[1:]}.**" if thrown.note else ""
    return (
        "Zhai et al., Learning to Throw, table by table. Ours is simulated throughout: **no"
        " vehicle was flown for this project**, and the reference plants (MuJoCo, own code of"
        " every block, effects that the training lacks) stand in for one. Every row says on which"
        f" plant it was measured. Brackets are 95 % bootstrap intervals.{note}"
    )


def sections(thrown) -> list:
    """Return the sections, each followed by what somebody wrote beside its data."""
    from dataclasses import replace

    from visthrow.paper.report import ablations, beyond, gap, throws, trade
    from visthrow.view.parts import Text

    chapters = [
        throws.throws_section(thrown),
        throws.vision_section(thrown),
        ablations.section(thrown),
        trade.baseline_section(thrown),
        trade.front_section(thrown),
        gap.section(thrown),
        beyond.section(thrown),
        beyond.training_section(thrown),
        beyond.origin_section(thrown),
    ]
    return [
        replace(
            s,
            parts=(
                *s.parts,
                *(Text(p, "why") for p in thrown.findings.get(s.name, "").split("\n\n") if p),
            ),
        )
        for s in chapters
    ]


def summary(thrown) -> str:
    """Return the table that is printed."""
    from visthrow.paper.report.throws import throws_section
    from visthrow.view.parts import Grid

    grids = [part for part in throws_section(thrown).parts if isinstance(part, Grid)]
    if grids:
        return grids[0].markdown() + "\n"
    return "no throws of the shipped policies are recorded; see --quick\n"
