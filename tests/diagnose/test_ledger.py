"""The statistics of ledgers, on worlds made up so that the answer is known."""

import json
from pathlib import Path

import numpy as np
from pytest import mark

from bench.diagnose import ledger, sealed
from visthrow.paper import measurements

SHIPPED = {
    name: [
        json.loads(line) for line in (Path(ledger.__file__).parent / name).read_text().splitlines()
    ]
    for name in ("ledger.jsonl", "ledger-earlier.jsonl")
}
RECORD = measurements.load(measurements.PAGES / "diagnosis-trust-page.json")
"""The figures of the ledgers, as `visthrow bench records` prints them."""
HIDDEN = [table for table in RECORD["tables"] if table["title"].startswith("Hidden worlds")]
ROWS = ["| " + " | ".join(row) + " |" for table in HIDDEN for row in table["rows"]]
TRUST = "\n".join([*ROWS, *(table["title"] for table in HIDDEN), *RECORD["notes"]])
KINDS = {
    "nothing; noise": "null",
    "one effect, 15": "1x15",
    "one effect, 10 floors |": "1x10",
    "one effect, 6": "1x6",
    "one effect, 3": "curve",
    "a delay": "limit:cmd_delay",
    "thrust, off": "limit:thrust_gain",
    "two effects": "2x12",
    "three effects": "3x12",
    "a law": "law",
    "1 to 15 floors": "sight",
    "nothing, and some": "null+dust",
    "one effect, 10 floors, and": "1x10+dust",
}


@mark.parametrize(("begins", "kind"), KINDS.items())
def test_the_record_says_what_the_shipped_ledger_says(begins, kind):
    """Worlds, found, names up to class, exact, more names than causes: cell by cell; none is left
    out of any row.
    """
    group = [w for w in ledger.answered(SHIPPED["ledger.jsonl"]) if w["kind"] == kind]
    (row,) = [line for line in TRUST.splitlines() if line.startswith(f"| {begins}")]
    cells = [cell.strip() for cell in row.strip("|").split("|")][1:]
    given, right, exact, found = np.sum([ledger.names(w) for w in group], axis=0)
    hidden = sum(len(ledger.truth_of(w)) for w in group)
    more = sum(ledger.names(w)[0] > len(ledger.truth_of(w)) for w in group)
    quiet = sum(w["overall"] == "NO EFFECT" for w in group)
    if kind == "law":
        ranks = [(w["laws"] + [None])[:3] for w in group]
        terms = [sealed.TERMS[next(iter(w["recipe"]["effects"]))] for w in group]
        first, among = (
            sum(r[0] == t for r, t in zip(ranks, terms)),
            sum(t in r for r, t in zip(ranks, terms)),
        )
        expected = [
            f"UNKNOWN in {len(group)}",
            f"true term first in {first}, among three in {among}",
            "-",
        ]
        expected += ["wrong names beside it in one [0, 5]"]
        assert [w.get("unknown") for w in group] == [True] * len(group)
        assert more == 1
    elif hidden:
        total = f" of {hidden}" if kind in ("2x12", "3x12") else ""
        expected = [f"{found}{total}", f"{right} of {given}", str(exact), str(more)]
    else:
        expected = ["-", f"NO EFFECT in {quiet}", "-", str(more)]
    assert cells[0] == str(len(group))
    assert [cell.replace(" [99, 100]", "") for cell in cells[1:]] == expected
