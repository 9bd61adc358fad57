"""Answer one half of a bank with each constant of the decision changed, one at a time.

    python -m bench.diagnose.constants answer --jobs 32 --ledger fix.jsonl
    python -m bench.diagnose.constants compare fix.jsonl

An answer that depends on a constant differs between the two values on either side of it. The other
half, ``banks/confirm.txt``, tests the chosen values.
"""

import argparse
import json
import shutil
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from bench.diagnose import two_checkouts

ROOT = Path(__file__).parents[2]
BANK = ROOT / "bench/diagnose/banks/fix.txt"
EVIDENCE = Path("visthrow/diagnose/likelihood/evidence.py")
BASE = "as it is"
VALUES = {
    "MODEL_ERROR_FLOOR = 0.1": (0.05, 0.2),
    "INEXACT = 0.3": (0.2, 0.45),
    "UNKNOWN_RATIO = 3.0": (2.5, 4.0),
    "LOST_SHARE = 0.15": (0.1, 0.25),
}
"""Statements of ``evidence``, and replacement values."""
LAST = 60.0  # no world begins in the last seconds


def copy_trees(folder: Path) -> dict[str, Path]:
    """Copy the project once for each value; return the copies by what was changed."""
    trees = {BASE: ROOT}
    for statement, values in VALUES.items():
        name = statement.partition(" = ")[0]
        for value in values:
            changed = f"{name} = {value}"
            tree = folder / changed.replace(" ", "")
            for part in ("visthrow", "sim", "camera", "hil", "configs"):
                shutil.copytree(ROOT / part, tree / part)
            source = tree / EVIDENCE
            text = source.read_text()
            if text.count(f"\n{statement}\n") != 1:
                raise ValueError(f"{EVIDENCE} does not hold '{statement}' once")
            source.write_text(text.replace(f"\n{statement}\n", f"\n{changed}\n"))
            trees[changed] = tree
    return trees


def answer_one(task: tuple) -> dict | None:
    """Answer one world with one copy; None where the time is over."""
    world, variant, tree, begin_until, until = task
    line = two_checkouts.one((world, [str(tree)], begin_until, until))
    return None if line is None else line | {"variant": variant}


def answer(args: argparse.Namespace) -> None:
    """Answer the bank with all copies, world after world."""
    worlds = two_checkouts.worlds_of([str(BANK)], [])
    until = time.time() + args.seconds
    with tempfile.TemporaryDirectory() as name:
        trees = copy_trees(Path(name))
        tasks = [(w, *item, until - LAST, until) for w in worlds for item in trees.items()]
        print(f"{len(worlds)} worlds, {len(trees)} answers each", flush=True)
        two_checkouts.write_answers(answer_one, tasks, args.jobs, args.ledger)


def right(line: dict) -> bool:
    """Tell whether an answer is right, by the test of its world's kind."""
    if line["new"]["error"]:
        return False
    if two_checkouts.is_null(line):
        return not line["new"]["named"]
    if two_checkouts.is_outside(line):
        return two_checkouts.judge_outside_law(line, "new")
    if two_checkouts.is_varying(line):
        return two_checkouts.varies_right(line, "new")
    return two_checkouts.names_right(line, "new")


def compare(args: argparse.Namespace) -> None:
    """Print how many worlds each copy has right, and the verdicts that differ."""
    answers: dict[str, dict] = defaultdict(dict)
    for text in args.ledger.read_text().splitlines():
        line = json.loads(text)
        if "failed" in line:
            print(f"not flown: {line}")
        else:
            answers[line["variant"]][line["kind"], line["recipe"]["seed"]] = line
    if BASE not in answers:
        raise SystemExit(f"{args.ledger} holds no answer with the constants as they are")
    worlds = set.intersection(*(set(lines) for lines in answers.values()))
    print(f"{len(worlds)} worlds answered by all")
    for variant, lines in answers.items():
        count = sum(right(lines[world]) for world in worlds)
        inside = two_checkouts.check_coverage([lines[world] for world in worlds], "new")
        print(f"{variant:20} {count} right, {sum(inside)} of {len(inside)} intervals hold")
        for world in sorted(worlds):
            before = answers[BASE][world]
            after = lines[world]
            if before["new"]["overall"] != after["new"]["overall"]:
                verdicts = f"{before['new']['overall']} -> {after['new']['overall']}"
                print(f"    {world[0]}: {verdicts}, right {right(before)} -> {right(after)}")


def main(argv: Sequence[str] | None = None) -> None:
    """Answer the half of the bank, or compare the answers of a ledger."""
    parser = argparse.ArgumentParser(description=__doc__)
    actions = parser.add_subparsers(dest="action", required=True)
    ask = actions.add_parser("answer", help=answer.__doc__)
    ask.add_argument("--jobs", type=int, default=2)
    ask.add_argument("--seconds", type=float, default=1e6, help="of wall clock, in all")
    ask.add_argument("--ledger", type=Path, required=True)
    judge = actions.add_parser("compare", help=compare.__doc__)
    judge.add_argument("ledger", type=Path)
    args = parser.parse_args(argv)
    {"answer": answer, "compare": compare}[args.action](args)


if __name__ == "__main__":
    main()
