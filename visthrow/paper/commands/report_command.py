"""``visthrow report``: write one page with the paper's results and ours, from records."""

import argparse
import time
from pathlib import Path

from visthrow.common.arguments import declare
from visthrow.common.errors import StorageError

TITLE = "Throwing with a quadrotor: the paper's evidence and ours"

LEAD = (
    "Zhai et al., Learning to Throw, table by table. Ours is simulated throughout: **no"
    " vehicle was flown for this project**, and the reference plants (MuJoCo, own code of"
    " every block, effects that the training lacks) stand in for one. Every row says on which"
    " plant it was measured. Brackets are 95 % bootstrap intervals."
)
"""The page's introduction."""


add_arguments = declare(__file__)


def run(args: argparse.Namespace) -> int:
    """Read the records and write the page."""
    from visthrow.common.storage import writable
    from visthrow.paper import RECORDS
    from visthrow.paper.report import result_set
    from visthrow.view import page

    begin = time.perf_counter()
    out = Path(args.out)
    records = _records(args.records) if args.records else RECORDS
    folders = [_folder(name) for name in args.results]
    writable(out)
    thrown = result_set.read([records], folders)
    chapters = sections(thrown)
    paths = page.write(out, TITLE, LEAD, chapters)
    print(summary(chapters[0]))
    for path in paths[:2]:
        print(path)
    print(
        f"{len(thrown.results)} sets of throws, {len(thrown.runs)} trainings,"
        f" {time.perf_counter() - begin:.0f} s"
    )
    return 0


def _records(name: str) -> Path:
    """Return the folder of records that ``visthrow sweep collect`` wrote.

    Raises StorageError: it does not exist or holds no records.
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
    """Return the folder or file with results of throws. Raises StorageError: there are none."""
    path = Path(name)
    if not path.is_file() and not any(path.glob("*.json")):
        actual = "no *.json in it" if path.is_dir() else "no such folder"
        raise StorageError(
            f"--results {name}: {actual}; expected one with results of throws, as runs/sweep/throws"
        )
    return path


def sections(thrown) -> list:
    """Return the sections, each followed by the recorded text on its data."""
    from dataclasses import replace

    from visthrow.common.workers import status
    from visthrow.paper.report import ablations, beyond, gap, throws, trade
    from visthrow.view.parts import Text

    makers = (
        throws.throws_section,
        throws.vision_section,
        ablations.section,
        trade.baseline_section,
        trade.front_section,
        gap.section,
        beyond.section,
        beyond.training_section,
        beyond.origin_section,
    )
    chapters = []
    for make in makers:
        status(f"section {len(chapters) + 1} of {len(makers)}")
        chapter = make(thrown)
        findings = thrown.findings.get(chapter.name, "").split("\n\n")
        reasons = tuple(Text(text, "why") for text in findings if text)
        chapters.append(replace(chapter, parts=chapter.parts + reasons))
    status("")
    return chapters


def summary(chapter) -> str:
    """Return the table of the policies' throws, which is printed."""
    from visthrow.view.parts import Grid

    grids = [part for part in chapter.parts if isinstance(part, Grid)]
    if grids:
        return grids[0].markdown() + "\n"
    return "no throws of the shipped policies are recorded; see visthrow sweep run quick\n"
